"""Every number of the estimator: named, with unit, meaning and source.

The configuration is a tree of frozen dataclasses. ``Config()`` is the default; :func:`preset`
returns a named one; :func:`load_config` reads YAML (a file may name a preset and override part of
it); :func:`dump_config` writes YAML with the meaning of every key as a comment.
"""

from __future__ import annotations

import dataclasses
import difflib
import io
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.scalarbool import ScalarBoolean

from loam_gtsam.types import ConfigError

_LONGEST = 200
"""Characters of a value in an error message."""


def _param(
    default: Any,
    doc: str,
    *,
    unit: str = "",
    source: str = "",
    low: float | None = None,
    high: float | None = None,
) -> Any:
    """A dataclass field with its meaning; ``low`` and ``high`` bound a number (inclusive)."""
    return field(
        default=default,
        metadata={"doc": doc, "unit": unit, "source": source, "low": low, "high": high},
    )


def _check(where: str, value: Any, hint: Any, meta: Mapping[str, Any]) -> None:
    """Raise ConfigError unless ``value`` has type ``hint`` and lies in its bounds."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        if value not in args:
            raise ConfigError(
                f"{where}: expected one of {', '.join(args)}; got {_shown(value)}"
                f"{_nearest(value, args, listing=False)}"
            )
        return
    if origin in (types.UnionType, typing.Union):
        if value is None:
            return
        hint = next(arg for arg in args if arg is not type(None))
    if origin is tuple:
        if not isinstance(value, tuple) or len(value) != len(args):
            raise ConfigError(f"{where}: expected {len(args)} values, got {_shown(value)}")
        for entry in value:
            _check(where, entry, args[0], meta)
        return
    wanted: Any = (int, float) if hint is float else hint
    if not isinstance(value, wanted) or (isinstance(value, bool) and hint is not bool):
        raise ConfigError(f"{where}: expected {hint.__name__}, got {_shown(value)}")
    if hint is int and abs(value) >= 1 << 63:
        raise ConfigError(f"{where}: the number is too large")
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        low, high = meta.get("low"), meta.get("high")
        if (
            value != value
            or (low is not None and value < low)
            or (high is not None and value > high)
        ):
            bounds = [f"at least {low}"] * (low is not None) + [f"at most {high}"] * (
                high is not None
            )
            raise ConfigError(
                f"{where}: expected {' and '.join(bounds) or 'a number'}, got {_shown(value)}"
            )


def _shown(value: Any) -> str:
    """A value in an error message: short, for aliases in YAML can make one of any length."""
    if isinstance(value, Mapping):
        return f"a mapping of {len(value)} keys"
    if isinstance(value, (list, tuple)) and any(
        isinstance(entry, (list, tuple, Mapping)) for entry in value
    ):
        return f"a list of {len(value)} lists or mappings"
    try:
        text = repr(value)
    except ValueError:  # Python refuses to write integers of thousands of digits
        return "a number that is too long"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def _plain(value: Any) -> Any:
    """A number or text without what the parser keeps of its looks (quotes, base, anchor)."""
    if isinstance(value, list):
        return [_plain_scalar(entry) for entry in value]
    return _plain_scalar(value)


def _plain_scalar(value: Any) -> Any:
    if isinstance(value, bool):
        return value
    for kind, plain in ((ScalarBoolean, bool), (int, int), (float, float), (str, str)):
        if isinstance(value, kind):
            return plain(value)
    return value


def _where(source: str, located: Any, key: str) -> str:
    """``file:line`` of a key if the parser kept it."""
    try:
        return f"{source}:{located.lc.key(key)[0] + 1}"
    except (AttributeError, KeyError, TypeError):
        return source


def _nearest(name: object, known: Any, listing: bool = True) -> str:
    asked = name[:_LONGEST] if isinstance(name, str) else ""
    close = difflib.get_close_matches(asked, [str(entry) for entry in known], n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return hint + (f" (known: {', '.join(sorted(map(str, known)))})" if listing else "")


_known_hints: dict[type, dict[str, Any]] = {}


def _hints(section: type) -> dict[str, Any]:
    """The types of its fields, looked up once: a mapper makes a variant of one for every sweep."""
    if section not in _known_hints:
        _known_hints[section] = typing.get_type_hints(section)
    return _known_hints[section]


class _Section:
    """Checks bounds and choices of every field at construction."""

    __slots__ = ()

    def __post_init__(self) -> None:
        hints = _hints(type(self))
        for item in dataclasses.fields(self):  # type: ignore[arg-type]
            where = f"{type(self).__name__}.{item.name}"
            _check(where, getattr(self, item.name), hints[item.name], item.metadata)


@dataclass(frozen=True, slots=True)
class SensorConfig(_Section):
    """What the sweep looks like, where the data does not say it itself."""

    model: Literal["auto", "vlp16", "hdl32", "hdl64", "os1-16", "os1-32", "os1-64", "os1-128"] = (
        _param("auto", "elevation table for rings from elevation; auto detects it from the data")
    )
    rings: Literal["auto", "field", "rows", "elevation"] = _param(
        "auto", "where beam numbers come from; auto tries the three in this order"
    )
    times: Literal["auto", "field", "azimuth", "none"] = _param(
        "auto", "where per-point times come from; none runs without de-skew"
    )
    spin: Literal["auto", "clockwise", "counterclockwise"] = _param(
        "auto", "sense of rotation seen from above, for times from azimuth"
    )
    start_azimuth_deg: float = _param(
        180.0,
        "azimuth (from x towards y) at which a sweep starts",
        unit="degrees",
        low=-360.0,
        high=360.0,
    )
    period: float = _param(0.1, "duration of a sweep, for times from azimuth", unit="s", low=1e-4)
    stamp: Literal["auto", "start", "middle", "end"] = _param(
        "auto",
        "which moment of the sweep its stamp is, for times from azimuth; auto is what the data "
        "set's layout implies (KITTI: middle), else start",
    )
    min_range: float = _param(
        0.5, "nearer points are dropped", unit="m", source="A-LOAM uses 0.3 to 5", low=0.0
    )
    max_range: float = _param(120.0, "farther points are dropped", unit="m", low=0.0)


@dataclass(frozen=True, slots=True)
class FeatureConfig(_Section):
    """Scan registration: which points become edge and plane features."""

    sectors: int = _param(6, "sectors per ring", source="LOAM", low=1)
    half_window: int = _param(5, "neighbours on either side in the curvature", source="LOAM", low=1)
    edge_curvature: float = _param(
        0.1, "least curvature |sum of differences|^2 of an edge", unit="m^2", source="LOAM", low=0.0
    )
    range_noise: float = _param(
        0.02,
        "standard deviation of the sensor's ranges: a plane point must lie where its ring scatters "
        "about a smooth surface by less than four times this, which foliage does not; 0 turns the "
        "test off",
        unit="m",
        source="LOAM takes all points that are not edges",
        low=0.0,
    )
    post_depth: float = _param(
        0.5,
        "a run of a ring too short for the curvature (a pole, a trunk) is an edge where it stands "
        "before what is on both sides of it by more than this; 0: no such edges",
        unit="m",
        source="LOAM takes what its curvature finds",
        low=0.0,
    )
    post_width: float = _param(0.5, "and is narrower than this", unit="m", low=0.0)
    plane_curvature: float = _param(
        0.1, "largest curvature of a plane point", unit="m^2", source="LOAM", low=0.0
    )
    sharp_per_sector: int = _param(2, "sharp edges a sector", source="LOAM", low=0)
    edges_per_sector: int = _param(20, "edges a sector", source="LOAM", low=0)
    flat_per_sector: int = _param(4, "flat plane points a sector", source="LOAM", low=0)
    max_gap: float = _param(
        0.05,
        "squared distance between neighbours at which suppression stops",
        unit="m^2",
        source="LOAM",
        low=0.0,
    )
    occlusion_gap: float = _param(
        0.1,
        "squared distance between neighbours that may be an occlusion",
        unit="m^2",
        source="LOAM",
        low=0.0,
    )
    occlusion_ratio: float = _param(
        0.1,
        "the two are on one ray if their scaled distance over range is below this",
        source="LOAM",
        low=0.0,
    )
    grazing_ratio: float = _param(
        0.0002,
        "a point is grazing if both squared gaps exceed this times its squared range",
        source="LOAM",
        low=0.0,
    )
    plane_voxel: float = _param(
        0.2, "voxel for the plane points of one ring", unit="m", source="LOAM", low=0.0
    )


@dataclass(frozen=True, slots=True)
class DeskewConfig(_Section):
    """Removal of the motion distortion."""

    enabled: bool = _param(True, "de-skew with the guess, and again with the solution")
    refine: bool = _param(
        True,
        "de-skew again with the solution, and register the first two sweeps anew when their motion "
        "is known; false de-skews once, with the guess",
        source="LOAM de-skews once",
    )
    rotation: Literal["auto", "orientation", "constant_velocity"] = _param(
        "auto",
        "rotation within a sweep: auto takes the gyro of an IMU if it covers the sweep, else a "
        "constant velocity; orientation takes the IMU's attitude instead of its gyro",
    )
    reference: Literal["start", "middle", "end", "stamp"] = _param(
        "start", "the moment of the sweep the pose belongs to"
    )


@dataclass(frozen=True, slots=True)
class OdometryConfig(_Section):
    """The guess the mapper starts from."""

    method: Literal["constant_velocity", "scan_to_scan"] = _param(
        "constant_velocity", "where the guess comes from"
    )
    iterations: int = _param(25, "scan-to-scan iterations", source="LOAM", low=1)
    max_distance: float = _param(5.0, "scan-to-scan match distance", unit="m", source="LOAM", low=0)
    ring_gap: int = _param(2, "rings searched above and below", source="LOAM", low=1)


@dataclass(frozen=True, slots=True)
class MapConfig(_Section):
    """The cube map."""

    cube_size: float = _param(50.0, "edge length of a cube", unit="m", source="LOAM", low=1.0)
    window: tuple[int, int, int] = _param(
        (21, 21, 11), "cubes kept in memory along x, y, z", source="LOAM", low=1
    )
    window_margin: int = _param(
        3,
        "the window shifts when the sensor's cube is this near its edge",
        unit="cubes",
        source="LOAM",
        low=0,
    )
    neighbourhood: tuple[int, int, int] = _param(
        (5, 5, 5), "cubes around the sensor's that are matched against", source="LOAM", low=1
    )
    field_of_view: bool = _param(
        True, "match only cubes with a corner 30 to 150 degrees off the up axis", source="LOAM"
    )
    edge_voxel: float = _param(0.2, "voxel of the edge map", unit="m", source="LOAM", low=0.01)
    plane_voxel: float = _param(0.4, "voxel of the plane map", unit="m", source="LOAM", low=0.01)
    insertion: Literal["settled", "centroid"] = _param(
        "settled",
        "centroid re-filters a cube with its new points as LOAM does; settled keeps the first "
        "point of a voxel",
    )
    archive_megabytes: float = _param(
        512.0,
        "memory for cubes that left the window; beyond it the oldest go to archive_dir, "
        "or are dropped and counted if that is not set",
        unit="MB",
        low=0.0,
    )
    archive_dir: str | None = _param(None, "folder for archived cubes; null keeps them in memory")


@dataclass(frozen=True, slots=True)
class MatchingConfig(_Section):
    """Association of features with the map."""

    max_edges: int = _param(
        500,
        "edge features matched at most, evenly spread over the sweep; 0: all. All enter the map",
        source="LOAM matches all",
        low=0,
    )
    max_planes: int = _param(2000, "and plane features", source="LOAM matches all", low=0)
    trial_edges: int = _param(
        150, "edge features matched at most where many poses are tried: a search, a loop", low=1
    )
    trial_planes: int = _param(500, "and plane features", low=1)
    neighbours: int = _param(5, "map points a feature is matched with", source="LOAM", low=3)
    max_distance: float = _param(
        1.0, "distance of the farthest of them", unit="m", source="LOAM", low=0.0
    )
    wide_search: float = _param(
        4.0,
        "with fewer matches than solver.min_matches, search again with this times max_distance in "
        "a map of this times as large voxels, as at the start on open ground, where the rings of "
        "one sweep are too far apart; 1: no such search",
        source="LOAM has none",
        low=1.0,
    )
    wide_below: float = _param(
        8.0,
        "search for lines, too, by wide_search times max_distance, if fewer planes than this fix a "
        "translation, counted as if they lay across it",
        low=0.0,
    )
    line_ratio: float = _param(
        10.0,
        "a line needs its largest eigenvalue above this times the second",
        source="LOAM uses 3",
        low=1.0,
    )
    plane_fit: Literal["centroid", "unit_offset"] = _param(
        "centroid",
        "the plane is fitted about the centroid, or by A n = -1, which cannot represent a plane "
        "through the map origin",
        source="LOAM and A-LOAM use unit_offset",
    )
    plane_tolerance: float = _param(
        0.2, "farthest of the five from the plane", unit="m", source="LOAM", low=0.0
    )
    plane_ratio: float = _param(
        0.2,
        "a plane needs its second eigenvalue above this times the largest: five points along one "
        "ring of a sparse sensor have no normal",
        low=0.0,
        high=1.0,
    )
    max_ring_cosine: float = _param(
        0.5, "an edge line may not run along the ring: largest cosine between the two", low=0.0
    )
    min_incidence_sine: float = _param(
        0.05,
        "a plane may not contain the viewing ray: least sine of the angle between the two",
        low=0.0,
        high=1.0,
    )
    keep_translation: float = _param(
        0.05,
        "lines and planes are kept, and only distances and weights renewed, while the pose has "
        "moved less than this since the search",
        unit="m",
        source="LOAM searches anew each time: 0",
        low=0.0,
    )
    keep_rotation_deg: float = _param(
        0.3, "and has turned less than this", unit="degrees", source="LOAM: 0", low=0.0
    )
    point_sigma: float = _param(
        0.03, "standard deviation of a measured point about a surface", unit="m", low=1e-6
    )
    fit_uncertainty: bool = _param(
        True,
        "a match's variance includes that of the line or plane at the point (regression leverage); "
        "false gives every match point_sigma",
    )
    weight_slope: float = _param(
        0.9,
        "weight = 1 - slope * |distance| (over sqrt(range) for planes); 0 turns it off",
        source="LOAM",
        low=0.0,
    )
    weight_range: Literal["lidar", "map"] = _param(
        "lidar",
        "whether the range in a plane's weight is that from the sensor or from the map origin",
        source="LIO-SAM uses lidar, LOAM map",
    )
    min_weight: float = _param(
        0.1, "a match with a smaller weight is dropped", source="LOAM", low=0.0, high=1.0
    )


@dataclass(frozen=True, slots=True)
class SolverConfig(_Section):
    """The per-frame solve."""

    method: Literal["gtsam", "loam", "aloam"] = _param(
        "gtsam",
        "factor graph; LOAM's Gauss-Newton on Euler angles; A-LOAM's robust Levenberg-Marquardt",
    )
    iterations: int = _param(10, "associations of a solve at most", source="LOAM", low=1)
    inner_iterations: int = _param(
        2, "Levenberg-Marquardt iterations per association", source="A-LOAM uses 4", low=1
    )
    rotation_tolerance_deg: float = _param(
        0.05,
        "stop when an association moves the pose less than this",
        unit="degrees",
        source="LOAM",
        low=0.0,
    )
    translation_tolerance: float = _param(
        0.0005, "and less than this", unit="m", source="LOAM", low=0.0
    )
    kernel: Literal["huber", "geman_mcclure"] = _param(
        "huber",
        "method gtsam: robust kernel on the matches; geman_mcclure all but ignores what is far "
        "off: for traffic and crowds",
    )
    kernel_width: float = _param(
        1.345,
        "width of the Huber kernel on the matches, in units of their scatter; .inf turns it off. "
        "That of the other is 2.816 times as wide, which makes them alike on normal noise",
        source="95 % efficiency on normal noise",
        low=0.1,
    )
    step_sigmas: float = _param(
        0.5,
        "or when it moves the pose less than this many of its standard deviations; 0 turns it off",
        low=0.0,
    )
    min_matches: int = _param(50, "fewer matches: no solve", source="LOAM", low=6)
    min_map_edges: int = _param(
        0, "least edge points of the local map for a solve", source="LOAM uses 11", low=0
    )
    min_map_planes: int = _param(
        50, "least plane points of the local map", source="A-LOAM uses 51, LOAM 101", low=0
    )
    degeneracy: Literal["prior", "project", "off"] = _param(
        "prior",
        "method gtsam, along directions that a scan does not fix: the expected motion takes over "
        "with its own covariance; it is kept exactly, as LOAM does; or the scan is believed",
        source="LOAM projects",
    )
    min_aligned: float = _param(
        8.0,
        "a direction is weak if fewer matches than this fix it, counted as if their normals "
        "pointed that way",
        low=0.0,
    )
    acceleration_sigma: float = _param(
        2.0,
        "what the constant-velocity motion is believed to within, along weak directions",
        unit="m/s^2",
        low=1e-6,
    )
    turn_sigma: float = _param(2.0, "and for the rotation", unit="rad/s^2", low=1e-6)
    degeneracy_threshold: float = _param(
        100.0,
        "method loam: the step is projected out of eigenvectors of A^T A with smaller eigenvalues "
        "(mixed rad and m); 0 turns it off",
        source="LOAM",
        low=0.0,
    )
    degeneracy_projector: Literal["correct", "published"] = _param(
        "correct",
        "method loam: V^-1 V2 with eigenvectors as rows, or with columns as in the published Eigen "
        "port, which is no projection onto the good directions; only to study it",
    )
    huber_delta: float = _param(
        0.1,
        "method aloam: residual at which the loss turns linear; 0 turns it off",
        unit="m",
        source="A-LOAM",
        low=0.0,
    )
    cost_tolerance: float = _param(
        1e-6,
        "method aloam: a step that changes the cost by less than this share ends the inner "
        "iterations and is not taken",
        source="Ceres default",
        low=0.0,
    )


@dataclass(frozen=True, slots=True)
class RelocalizationConfig(_Section):
    """When a sweep counts as lost, and where its place is searched for."""

    enabled: bool = _param(
        True,
        "watch whether sweeps fit the map as the ones before did; false believes every solve",
        source="LOAM believes",
    )
    memory: int = _param(
        10, "sweeps before, whose median is what is usual; as many must come first", low=1
    )
    min_agreement: float = _param(
        0.8,
        "lost if the share of matches within three standard deviations is below this times the "
        "usual one",
        source="at least 0.88 in the built-in scenes and KITTI, at most 0.75 when kidnapped",
        low=0.0,
        high=1.0,
    )
    min_share: float = _param(
        0.4,
        "or if the share of features that are matched and agree is below this times the usual one",
        low=0.0,
        high=1.0,
    )
    found_agreement: float = _param(
        0.9, "found again if the first is above this times the usual one", low=0.0, high=1.0
    )
    found_share: float = _param(0.6, "and the second above this", low=0.0, high=1.0)
    max_acceleration: float = _param(
        60.0,
        "a pose farther from the predicted one than this explains is a jump: it goes without "
        "motion, and the velocity from before stays",
        unit="m/s^2",
        low=0.0,
    )
    max_turn_acceleration: float = _param(
        60.0, "the same for the rotation", unit="rad/s^2", low=0.0
    )
    radius: float = _param(
        10.0, "around the prediction that is searched at first", unit="m", low=0.0
    )
    radius_growth: float = _param(
        1.0, "by which the radius grows with every lost sweep", unit="m", low=0.0
    )
    max_radius: float = _param(30.0, "and its limit", unit="m", low=0.0, high=100.0)


@dataclass(frozen=True, slots=True)
class ImuConfig(_Section):
    """Use of an inertial measurement unit; nothing here matters without one."""

    enabled: bool = _param(True, "false: as if there were no IMU")
    prior: Literal["off", "blend", "equivalent", "sigma"] = _param(
        "equivalent",
        "how roll and pitch of the IMU act on the pose: not at all; mixed in after the solve; by a "
        "factor of the weight's share of what the scan knows, which gives the same mean; by a "
        "gravity direction of the given sigma",
        source="LOAM blends",
    )
    weight: float = _param(
        0.01,
        "share of the IMU's roll and pitch (blend, equivalent)",
        source="LOAM uses 0.002; on slopes that is too little to be seen",
        low=0.0,
        high=0.999,
    )
    sigma_deg: float = _param(
        0.5,
        "standard deviation of the IMU's gravity direction, its slow errors included (sigma; and "
        "equivalent where the scan or the angles cannot do it)",
        unit="degrees",
        low=1e-4,
    )
    level: bool = _param(
        True, "the map's z axis points up from the start; false: the map is the first pose's frame"
    )
    still_seconds: float = _param(
        0.5, "window before the first sweep in which the platform may be at rest", unit="s", low=0.0
    )
    average_seconds: float = _param(
        0.1,
        "roll and pitch of a frame are the mean over this, brought to its moment by the gyro; 0: "
        "those of the moment",
        unit="s",
        source="one sweep, so that no sample counts twice; LOAM: 0",
        low=0.0,
    )
    max_gap: float = _param(0.1, "a longer gap between samples is not bridged", unit="s", low=1e-3)
    lidar_R_imu_deg: tuple[float, float, float] = _param(
        (0.0, 0.0, 0.0),
        "roll, pitch, yaw of the rotation Rz Ry Rx that takes IMU vectors into the lidar frame",
        unit="degrees",
    )
    lidar_t_imu: tuple[float, float, float] = _param(
        (0.0, 0.0, 0.0), "position of the IMU in the lidar frame (pre-integration)", unit="m"
    )
    filter_seconds: float = _param(
        60.0,
        "time constant of the gravity filter that stands in for a missing orientation",
        unit="s",
        low=0.1,
    )
    preintegration: bool = _param(
        False,
        "predict every pose from gyro and accelerometer, with velocity and biases estimated over "
        "the last frames, and let the prediction take over where the scan says nothing",
    )
    lag: int = _param(20, "frames in the pre-integration's graph", low=2)
    gravity: float = _param(9.81, "of the place", unit="m/s^2", low=0.0)
    gyro_noise: float = _param(
        2e-4, "white noise density of the gyro", unit="rad/s/sqrt(Hz)", low=1e-9
    )
    acceleration_noise: float = _param(
        2e-3, "white noise density of the accelerometer", unit="m/s^2/sqrt(Hz)", low=1e-9
    )
    gyro_bias_walk: float = _param(
        2e-5, "random walk of the gyro's bias", unit="rad/s^2/sqrt(Hz)", low=1e-12
    )
    acceleration_bias_walk: float = _param(
        2e-4, "random walk of the accelerometer's bias", unit="m/s^3/sqrt(Hz)", low=1e-12
    )


@dataclass(frozen=True, slots=True)
class CovarianceConfig(_Section):
    """Calibration of the covariances that are handed out; no pose depends on it."""

    match_cell: float = _param(
        1.6,
        "residuals of matches in one cell of this size count as one error: they share map points",
        unit="m",
        source="neighbours lie within matching.max_distance",
        low=0.01,
    )
    ground_cell: float = _param(
        0.8, "a cell of this size is new ground when it is matched for the first time", unit="m",
        low=0.01,
    )  # fmt: skip
    drift: float = _param(
        6.0,
        "the map's error grows by this many times the share of new ground in a frame's covariance",
        source="fitted on seeds 100-103 of built-in scenes, see docs/consistency.md",
        low=0.0,
    )
    window: int = _param(
        10,
        "frames over which the acceleration, which the constant velocity misses, is averaged",
        low=1,
    )


@dataclass(frozen=True, slots=True)
class PoseGraphConfig(_Section):
    """Keyframes and the graph of their poses."""

    keyframe_distance: float = _param(
        4.0, "a frame is a keyframe if it is as far as this from the last one", unit="m", low=0.0
    )
    keyframe_angle_deg: float = _param(
        30.0, "or has turned as much as this", unit="degrees", low=0.0
    )
    walk: float = _param(
        0.02,
        "drift of the odometry beside what its covariances know, as a random walk: so many times "
        "the square root of the way between two keyframes",
        unit="m/sqrt(m)",
        low=0.0,
    )
    turn_walk_deg: float = _param(0.02, "and of its rotation", unit="degrees/sqrt(m)", low=0.0)
    max_chi2: float = _param(
        40.0,
        "a loop is used if its squared Mahalanobis distance (6 freedoms) from what all the others "
        "say is not above",
        source="28 is exceeded by one of 10,000 right ones, were all covariances exact",
        low=0.0,
    )
    kernel_width: float = _param(
        5.0,
        "width of the Huber kernel on the whitened norm of a loop, in iSAM2; .inf turns it off",
        source="far above sqrt(6), the norm of a right one",
        low=0.1,
    )
    believed_loops: int = _param(
        6, "so many loops that agree pairwise are used although the odometry contradicts", low=2
    )
    follow_distance: float = _param(
        0.05,
        "map points follow their keyframe once a loop has moved it by more than this, seen from "
        "the newest one, from which it may be off by the angle below as well",
        unit="m",
        low=0.0,
    )
    follow_angle_deg: float = _param(0.2, "or turned it by more than this", unit="degrees", low=0.0)


@dataclass(frozen=True, slots=True)
class LoopConfig(_Section):
    """Where loops are looked for, and when one is believed."""

    enabled: bool = _param(False, "look for loops during a run, and let the map follow")
    min_way: float = _param(
        30.0, "keyframes that are not as far as this back on the way are no loop", unit="m", low=0.0
    )
    gate: float = _param(10.0, "candidates are within this of the keyframe, and", unit="m", low=0.0)
    gate_sigmas: float = _param(
        3.0, "so many standard deviations of both their positions farther, and", low=0.0
    )
    gate_drift: float = _param(
        0.02, "this share of the way between them: drift that the covariances do not know", low=0.0
    )
    rings: int = _param(20, "of the place descriptor", source="Scan Context", low=1)
    sectors: int = _param(60, "of it", source="Scan Context", low=4)
    reach: float = _param(
        60.0,
        "of it; what is farther away is not in it",
        unit="m",
        source="Scan Context: 80",
        low=1.0,
    )
    max_unlike: float = _param(
        0.6,
        "distance of two descriptors, 0 for equal ones, above which a candidate is not tried",
        source="Scan Context: 0.2 to 0.6, but there nothing is verified",
        low=0.0,
    )
    tries: int = _param(2, "candidates that are verified for a keyframe at most", low=1)
    neighbours: int = _param(
        6, "keyframes on either side of a candidate whose features make up the submap", low=0
    )
    search: float = _param(
        8.0, "around the candidate in which the keyframe is searched for", unit="m", low=1.0
    )
    min_share: float = _param(
        0.5,
        "share of the features off level ground that must find a match in the submap",
        low=0.0,
        high=1.0,
    )
    min_agreement: float = _param(
        0.9,
        "share of their matches that must lie within three standard deviations",
        source="right ones 0.97 or more, 3 m along a street 0.75, other wrong ones below 0.5",
        low=0.0,
        high=1.0,
    )
    min_aligned: float = _param(
        30.0,
        "every direction must be fixed by as many matches, counted as for solver.min_aligned",
        low=0.0,
    )


@dataclass(frozen=True, slots=True)
class BagConfig(_Section):
    """What a run writes into a bag."""

    map_frame: str = _param(
        "camera_init",
        "frame_id of poses and clouds; whatever its name, its axes are those of the map",
        source="LOAM",
    )
    lidar_frame: str = _param("aft_mapped", "child_frame_id of the poses", source="LOAM")
    registered: bool = _param(
        True, "write /velodyne_cloud_registered, which makes up most of a bag"
    )
    surround_every: int = _param(
        5,
        "frames from one /laser_cloud_surround to the next; 0 writes none",
        source="LOAM",
        low=0,
    )


@dataclass(frozen=True, slots=True)
class LiveConfig(_Section):
    """How sweeps wait, and which are dropped, when they come as they are measured."""

    queue: int = _param(
        20, "sweeps that may wait while another one is mapped; see when_full", low=1
    )
    when_full: Literal["drop_oldest", "keep_newest", "never"] = _param(
        "drop_oldest",
        "what makes room for a new sweep: the one that has waited longest is dropped, or all that "
        "wait are, or nothing is and the queue grows",
    )
    imu_queue: int = _param(
        20_000, "IMU samples that may wait for the next sweep; the oldest are dropped", low=1
    )
    imu_wait: float = _param(
        0.2,
        "a sweep waits for the IMU samples up to its end, but not longer than this after it was "
        "received; until the map is levelled, imu.still_seconds more",
        unit="s",
        low=0.0,
    )


@dataclass(frozen=True, slots=True)
class Config(_Section):
    """The whole configuration."""

    sensor: SensorConfig = _param(SensorConfig(), "the sweep, where the data does not say it")
    features: FeatureConfig = _param(FeatureConfig(), "edge and plane features")
    deskew: DeskewConfig = _param(DeskewConfig(), "motion distortion")
    odometry: OdometryConfig = _param(OdometryConfig(), "the guess")
    map: MapConfig = _param(MapConfig(), "the cube map")
    matching: MatchingConfig = _param(MatchingConfig(), "association with the map")
    solver: SolverConfig = _param(SolverConfig(), "the per-frame solve")
    imu: ImuConfig = _param(ImuConfig(), "roll, pitch and rotation from an IMU")
    relocalization: RelocalizationConfig = _param(
        RelocalizationConfig(), "sweeps that do not fit the map"
    )
    covariance: CovarianceConfig = _param(CovarianceConfig(), "calibrated covariances")
    pose_graph: PoseGraphConfig = _param(PoseGraphConfig(), "keyframes and their graph")
    loops: LoopConfig = _param(LoopConfig(), "how loops are found and verified")
    bag: BagConfig = _param(BagConfig(), "what is written into a bag, or published")
    live: LiveConfig = _param(LiveConfig(), "queues of a live run")


_CLASSICAL_FEATURES = FeatureConfig(range_noise=0.0, post_depth=0.0)
_CLASSICAL_MATCHING = MatchingConfig(
    max_edges=0,
    max_planes=0,
    wide_search=1.0,
    line_ratio=3.0,
    plane_fit="unit_offset",
    plane_ratio=0.0,
    max_ring_cosine=1.0,
    min_incidence_sine=0.0,
    fit_uncertainty=False,
    weight_range="map",
    keep_translation=0.0,
)

PRESETS: dict[str, Config] = {
    "default": Config(),
    # Zhang and Singh, LOAM (RSS 2014), constants of the published laserMapping.
    "loam": Config(
        features=_CLASSICAL_FEATURES,
        deskew=DeskewConfig(refine=False, rotation="constant_velocity"),
        odometry=OdometryConfig(method="scan_to_scan"),
        map=MapConfig(insertion="centroid"),
        matching=_CLASSICAL_MATCHING,
        solver=SolverConfig(method="loam", step_sigmas=0.0, min_map_edges=11, min_map_planes=101),
        imu=ImuConfig(prior="blend", weight=0.002, average_seconds=0.0),
        relocalization=RelocalizationConfig(enabled=False),
    ),
    # A-LOAM's laserMapping with the voxel sizes of its VLP-16 settings.
    "aloam": Config(
        features=_CLASSICAL_FEATURES,
        deskew=DeskewConfig(refine=False, rotation="constant_velocity"),
        odometry=OdometryConfig(method="scan_to_scan"),
        map=MapConfig(neighbourhood=(5, 5, 3), field_of_view=False, insertion="centroid"),
        matching=dataclasses.replace(_CLASSICAL_MATCHING, weight_slope=0.0),
        solver=SolverConfig(
            method="aloam",
            iterations=2,
            inner_iterations=4,
            step_sigmas=0.0,
            min_matches=6,  # A-LOAM has no minimum; fewer cannot fix a pose
            min_map_edges=11,
            min_map_planes=51,
        ),
        imu=ImuConfig(enabled=False),
        relocalization=RelocalizationConfig(enabled=False),
    ),
}


def preset(name: str) -> Config:
    """The configuration called ``name``.

    Raises
    ------
    ConfigError
        If there is no such preset.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}{_nearest(name, PRESETS)}")
    return PRESETS[name]


def config_from_dict(data: Mapping[str, Any], source: str = "config") -> Config:
    """Build a configuration from nested mappings; absent keys keep the preset's value.

    Parameters
    ----------
    data : as in the YAML file; the optional key ``preset`` names what is overridden
    source : what to call the input in error messages

    Raises
    ------
    ConfigError
        Naming the key, its line if known, what was expected and what came.
    """
    if not isinstance(data, Mapping):
        raise ConfigError(f"{source}: expected a mapping of sections, got {type(data).__name__}")
    name = data.get("preset", "default")
    if not isinstance(name, str) or name not in PRESETS:
        raise ConfigError(
            f"{_where(source, data, 'preset')}: unknown preset {_shown(name)}"
            f"{_nearest(name, PRESETS)}"
        )
    rest = {key: value for key, value in data.items() if key != "preset"}
    config: Config = _override(PRESETS[name], rest, data, source, "")
    return config


def config_to_dict(config: Config) -> dict[str, Any]:
    """Nested plain dictionaries; the inverse of :func:`config_from_dict`."""
    return dataclasses.asdict(config)


def with_value(config: Config, key: str, value: Any, source: str) -> Config:
    """``config`` with one value changed.

    Parameters
    ----------
    key : as ``solver.iterations``
    value : as YAML gives it
    source : what to call the input in error messages

    Raises
    ------
    ConfigError
        If there is no such key, or the value does not fit.
    """
    tree = config_to_dict(config)
    *sections, last = key.split(".")
    branch = tree
    for section in sections:
        below = branch.get(section)
        if not isinstance(below, dict):
            below = branch[section] = {}
        branch = below
    branch[last] = value
    return config_from_dict(tree, source)


def load_config(path: str | Path) -> Config:
    """Read a YAML file.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML, or does not fit.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error  # without the path again
        raise ConfigError(f"{path}: cannot read the configuration: {reason}") from error
    return parse_config(text, str(path))


def parse_config(text: str, source: str = "config") -> Config:
    """As :func:`load_config`, from text."""
    try:
        data = YAML(typ="rt").load(text)
    # A day 32, an endless number and deep nesting surface as whatever the parser stumbles over.
    except Exception as error:
        raise ConfigError(f"{source}: not valid YAML: {error}") from error
    return config_from_dict({} if data is None else data, source)


def dump_config(config: Config) -> str:
    """YAML text in which every key is explained by a comment."""
    yaml = YAML()
    yaml.width = 100
    out = io.StringIO()
    yaml.dump(_commented(config, 0), out)
    return out.getvalue()


def _commented(section: Any, indent: int) -> CommentedMap:
    result = CommentedMap()
    for item in dataclasses.fields(section):
        value = getattr(section, item.name)
        if dataclasses.is_dataclass(value):
            result[item.name] = _commented(value, indent + 2)
        elif isinstance(value, tuple):
            sequence = CommentedSeq(value)
            sequence.fa.set_flow_style()
            result[item.name] = sequence
        else:
            result[item.name] = value
        meta = item.metadata
        text = meta["doc"]
        if meta["unit"]:
            text += f" [{meta['unit']}]"
        if meta["source"]:
            text += f" ({meta['source']})"
        hint = _hints(type(section))[item.name]
        if typing.get_origin(hint) is Literal:
            text += "; one of: " + ", ".join(typing.get_args(hint))
        result.yaml_set_comment_before_after_key(item.name, before=text, indent=indent)
    return result


def _override(section: Any, data: Mapping[str, Any], located: Any, source: str, prefix: str) -> Any:
    names = {item.name: item for item in dataclasses.fields(section)}
    hints = _hints(type(section))
    changes: dict[str, Any] = {}
    for key, value in data.items():
        full = f"{prefix}{key}" if isinstance(key, str) else _shown(key)
        where = _where(source, located, key)
        if key not in names:
            raise ConfigError(f"{where}: unknown key {_shown(full)}{_nearest(key, names)}")
        current = getattr(section, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ConfigError(
                    f"{where}: {full} is a section, expected a mapping, got {_shown(value)}"
                )
            changes[key] = _override(current, value, value, source, f"{full}.")
            continue
        hint, value = hints[key], _plain(value)
        if hint is float and isinstance(value, int) and not isinstance(value, bool):
            try:
                value = float(value)
            except OverflowError:
                raise ConfigError(f"{where}: {full}: the number is too large") from None
        elif typing.get_origin(hint) is tuple and isinstance(value, list):
            value = tuple(value)
        _check(f"{where}: {full}", value, hint, names[key].metadata)
        changes[key] = value
    return dataclasses.replace(section, **changes)
