"""The map of cubes, and what happens to sweeps that do not fit it."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Count, Section, parameter


class MapConfig(Section):
    """The cube map."""

    in_order = (("edge_voxel", "cube_size"), ("plane_voxel", "cube_size"))

    cube_size: float = parameter(50.0, "edge length of a cube", unit="m", source="LOAM", low=1.0)
    window: tuple[Count, Count, Count] = parameter(
        (21, 21, 11), "cubes kept in memory along x, y, z", source="LOAM"
    )
    window_margin: int = parameter(
        3,
        "the window shifts when the sensor's cube is this near its edge",
        unit="cubes",
        source="LOAM",
        low=0,
    )
    neighbourhood: tuple[Count, Count, Count] = parameter(
        (5, 5, 5), "cubes around the sensor's that are matched against", source="LOAM"
    )
    field_of_view: bool = parameter(
        True, "match only cubes with a corner 30 to 150 degrees off the up axis", source="LOAM"
    )
    edge_voxel: float = parameter(0.2, "voxel of the edge map", unit="m", source="LOAM", low=0.01)
    plane_voxel: float = parameter(0.4, "voxel of the plane map", unit="m", source="LOAM", low=0.01)
    insertion: Literal["settled", "centroid"] = parameter(
        "settled",
        "centroid re-filters a cube with its new points as LOAM does; settled keeps the first "
        "point of a voxel",
    )
    archive_megabytes: float = parameter(
        512.0,
        "memory for cubes that left the window; beyond it the oldest go to archive_dir, "
        "or are dropped and counted if that is not set",
        unit="MB",
        low=0.0,
    )
    archive_dir: str | None = parameter(
        None, "folder for archived cubes; null keeps them in memory"
    )


class RelocalizationConfig(Section):
    """When a sweep counts as lost, and where its place is searched for."""

    in_order = (
        ("min_agreement", "found_agreement"),
        ("min_share", "found_share"),
        ("radius", "max_radius"),
    )

    enabled: bool = parameter(
        True,
        "watch whether sweeps fit the map as the ones before did; false believes every solve",
        source="LOAM believes",
    )
    memory: int = parameter(
        10, "sweeps before, whose median is what is usual; as many must come first", low=1
    )
    min_agreement: float = parameter(
        0.8,
        "lost if the share of matches within three standard deviations is below this times the "
        "usual one",
        source="at least 0.88 in the built-in scenes and KITTI, at most 0.75 when kidnapped",
        low=0.0,
        high=1.0,
    )
    min_share: float = parameter(
        0.4,
        "or if the share of features that are matched and agree is below this times the usual one",
        low=0.0,
        high=1.0,
    )
    found_agreement: float = parameter(
        0.9, "found again if the first is above this times the usual one", low=0.0, high=1.0
    )
    found_share: float = parameter(0.6, "and the second above this", low=0.0, high=1.0)
    max_acceleration: float = parameter(
        60.0,
        "a pose farther from the predicted one than this explains is a jump: it goes without "
        "motion, and the velocity from before stays",
        unit="m/s^2",
        low=0.0,
    )
    max_turn_acceleration: float = parameter(
        60.0, "the same for the rotation", unit="rad/s^2", low=0.0
    )
    radius: float = parameter(
        10.0, "around the prediction that is searched at first", unit="m", low=0.0
    )
    radius_growth: float = parameter(
        1.0, "by which the radius grows with every lost sweep", unit="m", low=0.0
    )
    max_radius: float = parameter(30.0, "and its limit", unit="m", low=0.0, high=100.0)
