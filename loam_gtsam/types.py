"""The values that travel through the package, and its errors.

Conventions (the same everywhere):

* Frames: ``lidar`` is x forward, y left, z up; ``map`` is fixed. A name says which frames it
  relates: ``map_T_lidar`` maps lidar coordinates into map coordinates.
* Poses are :class:`gtsam.Pose3`; tangent vectors are ordered ``[rotation (rad), translation (m)]``
  and perturb on the right (body frame), as in GTSAM.
* Stamps are integer nanoseconds; offsets inside a sweep are float seconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum

import gtsam
import numpy as np
from numpy.typing import NDArray

from loam_gtsam.errors import ConfigError as ConfigError
from loam_gtsam.errors import DatasetError as DatasetError
from loam_gtsam.errors import InputError as InputError
from loam_gtsam.errors import LoamError as LoamError
from loam_gtsam.errors import OutputError as OutputError
from loam_gtsam.errors import PartError as PartError
from loam_gtsam.errors import SweepError as SweepError
from loam_gtsam.errors import SweepFault as SweepFault
from loam_gtsam.errors import are_two_numbers, as_stamps
from loam_gtsam.errors import check_array as check_array
from loam_gtsam.errors import check_kind as check_kind
from loam_gtsam.trajectory import Trajectory as Trajectory
from loam_gtsam.trajectory import checked_pose
from loam_gtsam.trajectory import stack_poses as stack_poses

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
TANGENT = ("rx", "ry", "rz", "x", "y", "z")
"""Names of the six components of a tangent vector of a pose: rad, then metres."""
MAX_STAMP = 1 << 62
"""Nanoseconds up to which a stamp makes sense: the year 2116, and differences fit 64 bits."""
_FARTHEST = 1e5
"""Metres, of a feature; far beyond any lidar, and within the grid of voxels."""


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One sweep of the sensor, as it was measured (not de-skewed).

    Parameters
    ----------
    points : (N, 3) floats, metres, lidar frame. NaN and infinite rows are allowed.
    stamp : nanoseconds; ``times`` count from here.
    times : (N,) seconds from ``stamp`` at which each point was measured, or None if unknown.
    rings : (N,) integer beam number of each point, or None if unknown. Any consistent order.
    span : (first, last) seconds from ``stamp`` covered by the whole sweep. When None, the
        smallest and largest of ``times`` are used.
    rows : number of rows if the points are a full row-major range image (``rows`` x columns),
        else 0.

    Raises
    ------
    InputError
        If a shape or a dtype is wrong.
    """

    points: NDArray[np.floating]
    stamp: int
    times: NDArray[np.floating] | None = None
    rings: NDArray[np.integer] | None = None
    span: tuple[float, float] | None = None
    rows: int = 0

    def __post_init__(self) -> None:
        for name in ("points", "times", "rings"):
            if isinstance(given := getattr(self, name), (list, tuple)):
                object.__setattr__(self, name, np.array(given))
        check_array(self.points, "Scan.points", ("N", 3))
        _check_stamp(self)
        for name, numbers in (("times", "floats"), ("rings", "integers")):
            column = getattr(self, name)
            if column is not None:
                check_array(column, f"Scan.{name}", (len(self.points),), numbers)
        if self.span is not None:
            if not are_two_numbers(self.span):
                raise InputError(f"Scan.span: expected (first, last) seconds, got {self.span!r}")
            object.__setattr__(self, "span", tuple(map(float, self.span)))
        if not (_is_integer(self.rows) and self.rows >= 0):
            raise InputError(f"Scan.rows: expected a number of rows, or 0, got {self.rows!r}")
        if self.rows and len(self.points) % self.rows:
            raise InputError(
                f"Scan.rows: {len(self.points)} points do not divide into {self.rows} rows"
            )


def _is_integer(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _check_stamp(sweep: Scan | Features | BadSweep) -> None:
    """InputError unless the stamp makes sense, which becomes an int; any may do for a bad sweep."""
    stamp = sweep.stamp
    bounded = not isinstance(sweep, BadSweep)
    if not _is_integer(stamp) or (bounded and abs(int(stamp)) > MAX_STAMP):
        raise InputError(
            f"{type(sweep).__name__}.stamp: expected integer nanoseconds up to 2^62 (the year "
            f"2116), got {stamp!r}; round(seconds * 1e9) makes them of seconds"
        )
    object.__setattr__(sweep, "stamp", int(stamp))


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Edge and plane points of one sweep, at the positions they were measured (not de-skewed).

    Attributes
    ----------
    stamp : nanoseconds of the reference time, the time the pose of this frame belongs to.
    edges, planes : (E, 3) and (P, 3) float64, metres, lidar frame at each point's own time.
    edge_times, plane_times : seconds from ``stamp``; all zero if already de-skewed.
    edge_rings, plane_rings : integer beam numbers.
    level_rings : whether beams sweep rings about the lidar's z axis, which edges cross. Those of a
        Livox swing up and down, and a lidar that is mounted askew has others
    sharp, flat : indices of the most pronounced edges and planes, for scan-to-scan odometry.
    span : (first, last) seconds from ``stamp`` covered by the sweep.
    edge_prominence : (E,) metres by which an edge stands out of its ring, scaled so that range
        noise alone gives it the standard deviation of the noise
        (:func:`loam_gtsam.frontend.curvature.prominence`); None if unknown: all edges are real
    edge_sigmas : (E,) metres, standard deviation of the place of an edge along its ring, for beams
        are apart, and pass beside the edge itself; None if unknown: edges are where they were met
    not_finite : points of the sweep that were NaN or infinite
    voxel_sizes : edge lengths in metres of the voxels of which ``edges`` and ``planes`` hold one
        point each (:func:`loam_gtsam.frontend.features.thinned`). None if they hold all points.
    reach : metres; three quarters of the points of the sweep are nearer, which tells whether the
        place is small (``map.small_below``). Infinite if unknown: the place then counts as open.
    ring_elevations : (R,) rad, mean elevations of rings about the lidar's z axis; None if unknown
    """

    stamp: int
    edges: FloatArray
    planes: FloatArray
    edge_times: FloatArray
    plane_times: FloatArray
    edge_rings: IntArray
    plane_rings: IntArray
    sharp: IntArray
    flat: IntArray
    span: tuple[float, float] = (0.0, 0.0)
    edge_prominence: FloatArray | None = None
    edge_sigmas: FloatArray | None = None
    level_rings: bool = True
    not_finite: int = 0
    voxel_sizes: tuple[float, float] | None = None
    reach: float = np.inf
    ring_elevations: FloatArray | None = None

    def __post_init__(self) -> None:
        _check_stamp(self)

    @classmethod
    def from_points(
        cls, stamp: int, edges: NDArray[np.floating], planes: NDArray[np.floating]
    ) -> Features:
        """Features, (E, 3) and (P, 3) floats, that are de-skewed already, by another front end.

        Raises
        ------
        InputError
            If a shape, a dtype or the stamp is wrong, or a point is not finite or farther than any
            lidar sees.
        """
        for name, points in {"edges": edges, "planes": planes}.items():
            check_array(points, name, ("N", 3))
            wild = int(np.count_nonzero(~(np.abs(points) < _FARTHEST).all(axis=1)))
            if wild:
                raise InputError(
                    f"{name}: expected metres below {_FARTHEST:g}, got {wild} points of "
                    f"{len(points)} that are NaN, infinite or farther; remove them first"
                )
        edge_numbers, plane_numbers = np.arange(len(edges)), np.arange(len(planes))
        return cls(
            stamp,
            edges.astype(np.float64),
            planes.astype(np.float64),
            edge_times=np.zeros(len(edges)),
            plane_times=np.zeros(len(planes)),
            edge_rings=np.zeros_like(edge_numbers),
            plane_rings=np.zeros_like(plane_numbers),
            sharp=edge_numbers,
            flat=plane_numbers,
        )


@dataclass(frozen=True, slots=True, eq=False)
class FeatureSweep:
    """Features and odometry of one sweep made by another front end (e.g. LOAM's own topics).

    Attributes
    ----------
    features : de-skewed features
    odom_T_lidar : pose of the same moment in that front end's drifting frame
    cloud : (N, 3) de-skewed full-resolution points of the same moment, or None
    """

    features: Features
    odom_T_lidar: gtsam.Pose3
    cloud: NDArray[np.floating] | None = None

    def __post_init__(self) -> None:
        check_kind(self.features, Features, "FeatureSweep.features", "from_points makes them")
        checked_pose(self.odom_T_lidar, "FeatureSweep.odom_T_lidar")

    @property
    def stamp(self) -> int:
        """Of the features."""
        return self.features.stamp


@dataclass(frozen=True, slots=True)
class BadSweep:
    """A sweep its loader could not read; the run goes on with a predicted pose."""

    stamp: int
    message: str

    def __post_init__(self) -> None:
        _check_stamp(self)


Sweep = Scan | FeatureSweep | BadSweep
"""What a data set yields."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """A stretch of IMU data.

    Attributes
    ----------
    stamps : (N,) int64 nanoseconds
    orientation : (N, 4) quaternions x y z w of ``world_R_imu`` (world z up), NaN where unknown, or
        None if the IMU has no attitude output
    gyro : (N, 3) rad/s, imu frame
    acceleration : (N, 3) m/s^2, imu frame, reads +9.8 upwards at rest; zero for an IMU without an
        accelerometer, which None or nothing stands for

    Raises
    ------
    InputError
        If a shape or a dtype is wrong.
    """

    stamps: IntArray
    orientation: FloatArray | None
    gyro: FloatArray
    acceleration: FloatArray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        stamps = as_stamps(self.stamps, "ImuSamples.stamps")
        object.__setattr__(self, "stamps", stamps)
        if self.acceleration is None:
            object.__setattr__(self, "acceleration", np.zeros((len(stamps), 3)))
        columns = {"orientation": 4, "gyro": 3, "acceleration": 3}
        if self.orientation is None:
            del columns["orientation"]
        for name, width in columns.items():
            column = np.asanyarray(getattr(self, name))
            check_array(column, f"ImuSamples.{name}", (len(stamps), width), "numbers")
            object.__setattr__(self, name, np.asarray(column))


class FrameStatus(StrEnum):
    """What happened to one frame; see :attr:`solved` for which poses come from a solve."""

    OK = "ok"
    NOT_CONVERGED = "not_converged"
    """Solved, but the last step was still above the stop rule at the iteration limit."""
    DEGENERATE = "degenerate"
    """Solved, but the scan leaves a direction free; the expected motion decided it."""
    FIRST = "first"
    """Nothing to match against yet: the guess is the pose, and the map starts here."""
    SPARSE_MAP = "sparse_map"
    """The local map has too few points to solve; the guess is the pose, the sweep is inserted."""
    FEW_MATCHES = "few_matches"
    """Too few matches: the guess is the pose and the sweep is not inserted."""
    LOST = "lost"
    """The sweep fits the map neither where it was solved nor around: the pose is predicted, the
    sweep is not inserted, and the next sweep is searched for again."""
    UNUSABLE_SCAN = "unusable_scan"
    """The sweep has no usable points or features; the pose is predicted."""
    BAD_STAMP = "bad_stamp"
    """The stamp is not later than the last one, or far ahead; the last pose is repeated."""

    @property
    def solved(self) -> bool:
        """Whether the pose comes from a solve."""
        return self in (FrameStatus.OK, FrameStatus.NOT_CONVERGED, FrameStatus.DEGENERATE)

    @property
    def has_pose(self) -> bool:
        """Whether the frame has a pose of its own time: all but those with a bad stamp."""
        return self is not FrameStatus.BAD_STAMP

    @property
    def usable(self) -> bool:
        """Whether the sweep had a valid stamp and usable points, whatever came of it."""
        return self not in (FrameStatus.UNUSABLE_SCAN, FrameStatus.BAD_STAMP)


class SweepMotion(StrEnum):
    """Where the rotation within a sweep came from; its translation is a constant velocity."""

    NONE = "none"
    """Not de-skewed: the points have no times of their own, or ``deskew.enabled`` is off."""
    CONSTANT_VELOCITY = "constant_velocity"
    GYRO = "gyro"
    ORIENTATION = "orientation"


class TiltPrior(StrEnum):
    """How the IMU's roll and pitch acted on a pose (``imu.prior``)."""

    NONE = "none"
    """No IMU, not asked for, or the frame was not solved."""
    BLEND = "blend"
    EQUIVALENT = "equivalent"
    GRAVITY = "gravity"
    """The gravity direction: mode ``sigma``, or stepping in near a pitch of 90 degrees, and for
    ``equivalent`` where the scan knows less of the tilt than the IMU does."""
    DROPPED = "dropped"
    """Asked for, but there is no orientation of that moment (a gap, or the end of the stream)."""


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """The parts of a solved pose's error (:mod:`loam_gtsam.registration.uncertainty`).

    Attributes
    ----------
    own : (6, 6) covariance of the error of this frame alone, tangent order of the package
    shared : (6, 6) covariance of that error (rows) with the own error of the frame before
        (columns); zero if there is none
    follows : stamp of that frame before; None if there is none
    drift : (6, 6) covariance of the map's error since the start, as a perturbation on the *left*:
        along the axes of the map, about its origin. It never shrinks.
    residual_variance : of the whitened residuals; 1 if their standard deviations are right
    effective_matches : independent rows that would know as much as the correlated ones do
    blind : (6, 10) further drift to which scans are blind: ``blind @ u``, u of unit variance. Nine
        are of velocity and linear acceleration where no scan saw, the last of an offset of ranges
    forgotten : (10,) what was passed on of each u from frame to frame since the start, as the
        negative logarithm of the correlation; of the ranges, that of the offset's deviation, m
    in_doubt : whether several places explain the sweep, of the first ones or of a search; ``own``
        has what they differ by
    """

    own: FloatArray
    shared: FloatArray
    follows: int | None
    drift: FloatArray
    residual_variance: float
    effective_matches: float
    blind: FloatArray = field(default_factory=lambda: np.zeros((6, 10)))
    forgotten: FloatArray = field(default_factory=lambda: np.zeros(10))
    in_doubt: bool = False


class Timings(Mapping[str, float]):
    """Seconds per stage; they cannot be changed."""

    __slots__ = ("_seconds",)

    def __init__(self, seconds: Mapping[str, float]) -> None:
        self._seconds = dict(seconds)

    def __getitem__(self, stage: str) -> float:
        return self._seconds[stage]

    def __iter__(self) -> Iterator[str]:
        return iter(self._seconds)

    def __len__(self) -> int:
        return len(self._seconds)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MapUpdate:
    """What :meth:`loam_gtsam.Mapper.register` says about one frame.

    Attributes
    ----------
    stamp : nanoseconds the pose belongs to (the reference time of the sweep)
    map_T_lidar : the pose
    status, message : what happened, and a sentence for people when it was not ``OK``
    n_edges, n_planes : features offered, after the voxel filter
    n_edge_matches, n_plane_matches : matches in the last association
    iterations : associations made
    solver_iterations : Levenberg-Marquardt iterations, over all associations
    error_before, error_after : cost (half the weighted, whitened squared residuals plus priors)
        at the guess and at the solution, each with its own matches
    information : (6, 6) of scan matches and priors at the solution; zero if not solved
    covariance : (6, 6) of the pose in the map, calibrated: the error of this frame and what the map
        has drifted since its start; NaN if not solved. For the motion between two frames see
        :func:`loam_gtsam.relative_covariance`.
    uncertainty : the parts of the covariance; None if not solved
    twist : (6,) body velocity in the middle of the sweep (rad/s, m/s) used for its de-skew; where
        an IMU gives the rotation within the sweep, its mean
    acceleration : (6,) rad/s^2 and m/s^2, by which the de-skew let that velocity change; zero where
        it was constant
    sweep_motion : where that rotation came from
    tilt_prior : how the IMU's roll and pitch acted
    localizability : (6,) how many matches fix each of ``directions``, counted as if their normals
        pointed that way, the weakest first; NaN where it was not looked at
    directions : (6, 6) rows, tangent vectors that move the matched points by 1 m; NaN likewise
    direction_information : (6,) 1 / m^2, of the matches along each of them, noise included; NaN
        likewise
    axis_localizability : (6,) how many matches, at least 1, fix each axis of the lidar (rx, ry, rz,
        x, y, z) if the others are free; unreliable below ``solver.min_aligned``; NaN likewise
    timings : seconds per stage
    fault : what was wrong with the sweep, if the status is ``UNUSABLE_SCAN`` or ``BAD_STAMP``
    n_not_finite : points of the sweep that were NaN or infinite, if it was used
    map_T_middle, middle_stamp : pose and nanoseconds of the middle of the sweep, to which matches,
        priors and own factors belong; None and 0 if nothing was matched
    """

    stamp: int
    map_T_lidar: gtsam.Pose3
    status: FrameStatus
    message: str = ""
    n_edges: int = 0
    n_planes: int = 0
    n_edge_matches: int = 0
    n_plane_matches: int = 0
    iterations: int = 0
    solver_iterations: int = 0
    error_before: float = 0.0
    error_after: float = 0.0
    information: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    covariance: FloatArray = field(default_factory=lambda: np.full((6, 6), np.nan))
    uncertainty: Uncertainty | None = None
    twist: FloatArray = field(default_factory=lambda: np.zeros(6))
    acceleration: FloatArray = field(default_factory=lambda: np.zeros(6))
    sweep_motion: SweepMotion = SweepMotion.NONE
    tilt_prior: TiltPrior = TiltPrior.NONE
    localizability: FloatArray = field(default_factory=lambda: np.full(6, np.nan))
    directions: FloatArray = field(default_factory=lambda: np.full((6, 6), np.nan))
    direction_information: FloatArray = field(default_factory=lambda: np.full(6, np.nan))
    axis_localizability: FloatArray = field(default_factory=lambda: np.full(6, np.nan))
    timings: Mapping[str, float] = field(default_factory=dict)
    fault: SweepFault | None = None
    n_not_finite: int = 0
    map_T_middle: gtsam.Pose3 | None = None
    middle_stamp: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "timings", Timings(self.timings))
        twist = self.twist.copy()  # by which the next frame is predicted
        twist.setflags(write=False)
        object.__setattr__(self, "twist", twist)

    def __repr__(self) -> str:
        position = self.map_T_lidar.translation().round(3).tolist()
        matches = f"{self.n_edge_matches} edge and {self.n_plane_matches} plane matches"
        said = f": {self.message}" if self.message else ""
        return f"MapUpdate({self.status} at {self.stamp} ns, {position} m, {matches}{said})"

    @property
    def raw_covariance(self) -> FloatArray:
        """(6, 6) inverse of ``information``; NaN if the frame was not solved or is singular.

        Unlike ``covariance`` it takes every match as independent and the map as exact. Multiply
        that of a classical solver (``solver.method`` loam or aloam) by the variance of a residual
        in m^2: its rows count as measured to 1 m.
        """
        if self.status.solved:
            with suppress(np.linalg.LinAlgError):
                return np.asarray(np.linalg.inv(self.information), np.float64)
        return np.full((6, 6), np.nan)
