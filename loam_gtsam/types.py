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
from loam_gtsam.errors import check_all
from loam_gtsam.errors import check_array as check_array
from loam_gtsam.errors import check_kind as check_kind
from loam_gtsam.sweeps import MAX_STAMP as MAX_STAMP
from loam_gtsam.sweeps import BadSweep as BadSweep
from loam_gtsam.sweeps import Features as Features
from loam_gtsam.sweeps import FeatureSweep as FeatureSweep
from loam_gtsam.sweeps import ImuSamples as ImuSamples
from loam_gtsam.sweeps import Scan as Scan
from loam_gtsam.sweeps import Sweep as Sweep
from loam_gtsam.trajectory import FloatArray as FloatArray
from loam_gtsam.trajectory import IntArray as IntArray
from loam_gtsam.trajectory import Trajectory as Trajectory
from loam_gtsam.trajectory import stack_poses as stack_poses

BoolArray = NDArray[np.bool_]
TANGENT = ("rx", "ry", "rz", "x", "y", "z")
"""Names of the six components of a tangent vector of a pose: rad, then metres."""


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
        priors and own factors belong; None and 0 if the sweep was not used
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


def check_updates(updates: object, name: str = "updates") -> None:
    """InputError for anything but a sequence of :class:`MapUpdate`."""
    check_all(updates, MapUpdate, name, "result.updates of a run are such")
