"""The sweep and its features: sensor, feature extraction, de-skewing, predicted motion."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Section, parameter


class SensorConfig(Section):
    """The properties of the lidar and of its sweeps that the data itself does not tell."""

    in_order = (("min_range", "max_range"),)

    model: Literal["auto", "vlp16", "hdl32", "hdl64", "os1-16", "os1-32", "os1-64", "os1-128"] = (
        parameter("auto")
    )
    """The model of the lidar selects the table of beam elevations for rings from elevations; auto
    detects the model from the data."""
    rings: Literal["auto", "field", "rows", "elevation"] = parameter("auto")
    """Ring numbers of the points come from a field of the cloud, from its rows or from the
    elevations of the points; auto tries the three in this order."""
    times: Literal["auto", "field", "azimuth", "none"] = parameter("auto")
    """Times of the points come from a field of the cloud or from the azimuths of the points; auto
    tries the two in this order, and none maps the sweeps without de-skewing."""
    spin: Literal["auto", "clockwise", "counterclockwise"] = parameter("auto")
    """The lidar rotates in this sense, seen from above; it is used for times from azimuths."""
    start_azimuth_deg: float = parameter(180.0, unit="degrees", low=-360.0, high=360.0)
    """A sweep starts at this azimuth, counted from x towards y."""
    period: float = parameter(0.1, unit="s", low=1e-4)
    """A sweep lasts this long; the duration is used for times from azimuths."""
    stamp: Literal["auto", "start", "middle", "end"] = parameter("auto")
    """The stamp of a sweep is this moment of it, for times from azimuths; auto takes what the
    layout of the data set implies (KITTI: middle), else the start."""
    min_range: float = parameter(0.5, unit="m", source="A-LOAM uses 0.3 to 5", low=0.0)
    """Points nearer to the lidar than this are dropped."""
    max_range: float = parameter(120.0, unit="m", low=0.0)
    """Points farther from the lidar than this are dropped."""


class FeatureConfig(Section):
    """Scan registration: the choice of edge and plane features among the points of a sweep."""

    in_order = (("sharp_per_sector", "edges_per_sector"),)

    sectors: int = parameter(6, source="LOAM", low=1)
    """Every ring is divided into this many sectors, which each give their own features."""
    half_window: int = parameter(5, source="LOAM", low=1)
    """The curvature at a point takes this many neighbours on either side of it in its ring."""
    edge_curvature: float = parameter(0.1, unit="m^2", source="LOAM", low=0.0)
    """An edge point needs at least this curvature, the squared norm of the sum of differences."""
    range_noise: float = parameter(
        0.02, unit="m", source="LOAM takes all points that are not edges", low=0.0
    )
    """The ranges of the sensor have this standard deviation. A plane point is taken only where its
    ring scatters about a smooth surface by less than four times this value, which foliage does
    not; 0 turns the test off."""
    post_depth: float = parameter(
        0.5, unit="m", source="LOAM takes only what its curvature finds", low=0.0
    )
    """A pole, a run of a ring too short for the curvature, is an edge where it stands in front of
    what is on both sides of it by more than this; 0 turns the search for poles off."""
    post_width: float = parameter(0.5, unit="m", low=0.0)
    """A run of a ring counts as a pole only if it is narrower than this."""
    plane_curvature: float = parameter(0.1, unit="m^2", source="LOAM", low=0.0)
    """A plane point has at most this curvature."""
    sharp_per_sector: int = parameter(2, source="LOAM", low=0)
    """At most this many edge points of a sector count as sharp; scan-to-scan odometry uses them."""
    edges_per_sector: int = parameter(20, source="LOAM", low=0)
    """At most this many edge points are taken from a sector, the sharp ones included."""
    flat_per_sector: int = parameter(4, source="LOAM", low=0)
    """At most this many plane points of a sector count as flat; scan-to-scan odometry uses them."""
    max_gap: float = parameter(0.05, unit="m^2", source="LOAM", low=0.0)
    """The suppression of points beside a chosen one stops at a gap with a squared width above
    this."""
    occlusion_gap: float = parameter(0.1, unit="m^2", source="LOAM", low=0.0)
    """Two neighbours with a squared distance above this may be the rim of an occlusion."""
    occlusion_ratio: float = parameter(0.1, source="LOAM", low=0.0)
    """Two neighbours are on one ray if their distance, scaled to one range and divided by the
    range, is below this."""
    grazing_ratio: float = parameter(0.0002, source="LOAM", low=0.0)
    """A beam grazes the surface if both squared gaps beside its point exceed this times the squared
    range of the point."""
    plane_voxel: float = parameter(0.2, unit="m", source="LOAM", low=0.0)
    """The plane points of one ring are thinned to one per voxel of this size."""


class DeskewConfig(Section):
    """De-skewing: the removal of the motion distortion from a sweep."""

    enabled: bool = parameter(True)
    """Sweeps are de-skewed with the predicted motion, and again with the solution."""
    refine: bool = parameter(True, source="LOAM de-skews once")
    """Sweeps are de-skewed again with the solution, and the first two are registered anew when
    their motion is known; false de-skews once, with the prediction."""
    rotation: Literal["auto", "orientation", "constant_velocity"] = parameter("auto")
    """The rotation within a sweep comes from here: auto takes the gyro of an IMU where it covers
    the sweep, else a constant velocity; orientation takes the attitude of the IMU in place of its
    gyro."""
    reference: Literal["start", "middle", "end", "stamp"] = parameter("start")
    """The pose of a sweep is that of the lidar at this moment of the sweep."""


class OdometryConfig(Section):
    """The prediction of the motion, from which the mapper starts."""

    method: Literal["constant_velocity", "scan_to_scan"] = parameter("constant_velocity")
    """The predicted motion repeats the last one, or comes from scan-to-scan registration."""
    iterations: int = parameter(25, source="LOAM", low=1)
    """Scan-to-scan registration takes at most this many iterations."""
    max_distance: float = parameter(5.0, unit="m", source="LOAM", low=0)
    """Scan-to-scan registration matches no points farther apart than this."""
    ring_gap: int = parameter(2, source="LOAM", low=1)
    """Scan-to-scan registration searches this many rings above and below the ring of a match."""
