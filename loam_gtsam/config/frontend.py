"""The sweep and its features: sensor, feature extraction, de-skewing, predicted motion."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Section, parameter


class SensorConfig(Section):
    """What the sweep looks like, where the data does not say it itself."""

    in_order = (("min_range", "max_range"),)

    model: Literal["auto", "vlp16", "hdl32", "hdl64", "os1-16", "os1-32", "os1-64", "os1-128"] = (
        parameter("auto", "elevation table for rings from elevation; auto detects it from the data")
    )
    rings: Literal["auto", "field", "rows", "elevation"] = parameter(
        "auto", "where beam numbers come from; auto tries the three in this order"
    )
    times: Literal["auto", "field", "azimuth", "none"] = parameter(
        "auto", "where per-point times come from; none runs without de-skew"
    )
    spin: Literal["auto", "clockwise", "counterclockwise"] = parameter(
        "auto", "sense of rotation seen from above, for times from azimuth"
    )
    start_azimuth_deg: float = parameter(
        180.0,
        "azimuth (from x towards y) at which a sweep starts",
        unit="degrees",
        low=-360.0,
        high=360.0,
    )
    period: float = parameter(
        0.1, "duration of a sweep, for times from azimuth", unit="s", low=1e-4
    )
    stamp: Literal["auto", "start", "middle", "end"] = parameter(
        "auto",
        "which moment of the sweep its stamp is, for times from azimuth; auto is what the data "
        "set's layout implies (KITTI: middle), else start",
    )
    min_range: float = parameter(
        0.5, "nearer points are dropped", unit="m", source="A-LOAM uses 0.3 to 5", low=0.0
    )
    max_range: float = parameter(120.0, "farther points are dropped", unit="m", low=0.0)


class FeatureConfig(Section):
    """Scan registration: which points become edge and plane features."""

    in_order = (("sharp_per_sector", "edges_per_sector"),)

    sectors: int = parameter(6, "sectors per ring", source="LOAM", low=1)
    half_window: int = parameter(
        5, "neighbours on either side in the curvature", source="LOAM", low=1
    )
    edge_curvature: float = parameter(
        0.1, "least curvature |sum of differences|^2 of an edge", unit="m^2", source="LOAM", low=0.0
    )
    range_noise: float = parameter(
        0.02,
        "standard deviation of the sensor's ranges: a plane point must lie where its ring scatters "
        "about a smooth surface by less than four times this, which foliage does not; 0 turns the "
        "test off",
        unit="m",
        source="LOAM takes all points that are not edges",
        low=0.0,
    )
    post_depth: float = parameter(
        0.5,
        "a run of a ring too short for the curvature (a pole, a trunk) is an edge where it stands "
        "before what is on both sides of it by more than this; 0: no such edges",
        unit="m",
        source="LOAM takes what its curvature finds",
        low=0.0,
    )
    post_width: float = parameter(0.5, "and is narrower than this", unit="m", low=0.0)
    plane_curvature: float = parameter(
        0.1, "largest curvature of a plane point", unit="m^2", source="LOAM", low=0.0
    )
    sharp_per_sector: int = parameter(2, "sharp edges a sector", source="LOAM", low=0)
    edges_per_sector: int = parameter(20, "edges a sector", source="LOAM", low=0)
    flat_per_sector: int = parameter(4, "flat plane points a sector", source="LOAM", low=0)
    max_gap: float = parameter(
        0.05,
        "squared distance between neighbours at which suppression stops",
        unit="m^2",
        source="LOAM",
        low=0.0,
    )
    occlusion_gap: float = parameter(
        0.1,
        "squared distance between neighbours that may be an occlusion",
        unit="m^2",
        source="LOAM",
        low=0.0,
    )
    occlusion_ratio: float = parameter(
        0.1,
        "the two are on one ray if their scaled distance over range is below this",
        source="LOAM",
        low=0.0,
    )
    grazing_ratio: float = parameter(
        0.0002,
        "a point is grazing if both squared gaps exceed this times its squared range",
        source="LOAM",
        low=0.0,
    )
    plane_voxel: float = parameter(
        0.2, "voxel for the plane points of one ring", unit="m", source="LOAM", low=0.0
    )


class DeskewConfig(Section):
    """Removal of the motion distortion."""

    enabled: bool = parameter(True, "de-skew with the guess, and again with the solution")
    refine: bool = parameter(
        True,
        "de-skew again with the solution, and register the first two sweeps anew when their motion "
        "is known; false de-skews once, with the guess",
        source="LOAM de-skews once",
    )
    rotation: Literal["auto", "orientation", "constant_velocity"] = parameter(
        "auto",
        "rotation within a sweep: auto takes the gyro of an IMU if it covers the sweep, else a "
        "constant velocity; orientation takes the IMU's attitude instead of its gyro",
    )
    reference: Literal["start", "middle", "end", "stamp"] = parameter(
        "start", "the moment of the sweep the pose belongs to"
    )


class OdometryConfig(Section):
    """The guess the mapper starts from."""

    method: Literal["constant_velocity", "scan_to_scan"] = parameter(
        "constant_velocity", "where the guess comes from"
    )
    iterations: int = parameter(25, "scan-to-scan iterations", source="LOAM", low=1)
    max_distance: float = parameter(
        5.0, "scan-to-scan match distance", unit="m", source="LOAM", low=0
    )
    ring_gap: int = parameter(2, "rings searched above and below", source="LOAM", low=1)
