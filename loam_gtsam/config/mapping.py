"""The map of cubes, and sweeps that do not fit it."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Count, Section, parameter


class MapConfig(Section):
    """The map of edge and plane points, in cubes of which those in a window are in memory."""

    in_order = (("edge_voxel", "cube_size"), ("plane_voxel", "cube_size"))

    cube_size: float = parameter(50.0, unit="m", source="LOAM", low=1.0)
    """Every cube of the map has this edge length."""
    window: tuple[Count, Count, Count] = parameter((21, 21, 11), source="LOAM")
    """The window holds this many cubes along x, y and z."""
    window_margin: int = parameter(3, unit="cubes", source="LOAM", low=0)
    """The window shifts when the cube of the sensor is this near the edge of the window."""
    neighbourhood: tuple[Count, Count, Count] = parameter((5, 5, 5), source="LOAM")
    """A sweep is matched with this many cubes around the sensor, along x, y and z."""
    field_of_view: bool = parameter(True, source="LOAM")
    """A sweep is matched only with cubes that have a corner 30 to 150 degrees off the up axis."""
    edge_voxel: float = parameter(0.2, unit="m", source="LOAM", low=0.01)
    """The edge map keeps one point per voxel of this size."""
    plane_voxel: float = parameter(0.4, unit="m", source="LOAM", low=0.01)
    """The plane map keeps one point per voxel of this size."""
    insertion: Literal["settled", "centroid"] = parameter("settled")
    """New points enter a cube in this way: settled keeps the first point of a voxel; centroid
    filters the cube again with its new points, as LOAM does."""
    archive_megabytes: float = parameter(512.0, unit="MB", low=0.0)
    """Cubes that left the window take at most this much memory. Beyond it, the oldest go to
    archive_dir, or are dropped and counted if archive_dir is not set."""
    archive_dir: str | None = parameter(None)
    """Archived cubes go to this folder; null keeps them in memory."""


class RelocalizationConfig(Section):
    """The test whether a sweep is lost, and the search for its place."""

    in_order = (
        ("min_agreement", "found_agreement"),
        ("min_share", "found_share"),
        ("radius", "max_radius"),
    )

    enabled: bool = parameter(True, source="LOAM believes every solve")
    """Every sweep is tested, and is lost if it fits the map less well than the sweeps before it;
    false believes every solve."""
    memory: int = parameter(10, low=1)
    """The usual shares are medians over this many earlier sweeps; no sweep is lost before them."""
    min_agreement: float = parameter(
        0.8, source="at least 0.88 was seen in the built-in scenes and KITTI, at most 0.75 when "
        "kidnapped", low=0.0, high=1.0,
    )  # fmt: skip
    """A sweep is lost if the share of its matches within three standard deviations is below this
    times the usual share."""
    min_share: float = parameter(0.4, low=0.0, high=1.0)
    """A sweep is lost as well if the share of its features that are matched and agree is below this
    times the usual share."""
    found_agreement: float = parameter(0.9, low=0.0, high=1.0)
    """A lost sweep is found again only if the share of its matches within three standard deviations
    is at least this times the usual share."""
    found_share: float = parameter(0.6, low=0.0, high=1.0)
    """A lost sweep is found again only if the share of its features that are matched and agree is
    at least this times the usual share."""
    max_acceleration: float = parameter(60.0, unit="m/s^2", low=0.0)
    """A pose is a jump if it is farther from the predicted one than this acceleration explains. It
    is handed out without a motion, and the velocity from before stays."""
    max_turn_acceleration: float = parameter(60.0, unit="rad/s^2", low=0.0)
    """A pose is a jump as well if its rotation differs from the predicted one by more than this
    angular acceleration explains."""
    radius: float = parameter(10.0, unit="m", low=0.0)
    """The search begins within this radius about the predicted pose."""
    radius_growth: float = parameter(1.0, unit="m", low=0.0)
    """The radius of the search grows by this with every lost sweep."""
    max_radius: float = parameter(30.0, unit="m", low=0.0, high=100.0)
    """The radius of the search does not grow beyond this."""
