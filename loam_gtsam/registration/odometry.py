"""The predicted pose of a sweep: by constant velocity, from scan to scan, or by an IMU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.config import OdometryConfig, SolverConfig
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.geometry import (
    as_vector,
    checked_pose,
    move_points,
)
from loam_gtsam.imu.preintegration import InertialPrediction
from loam_gtsam.registration.solvers import MotionPrior
from loam_gtsam.types import BoolArray, Features, FloatArray, IntArray, MapUpdate, check_kind

_NODES = 41  # of the path between the middle of the last sweep and the end of this one
_BENT = 1.0  # longest time over which accelerations are integrated for that, seconds
LONGEST = 10.0  # seconds of extrapolation: after more the pose would be anywhere
ANYWHERE: FloatArray = np.repeat([np.pi / 3.0**0.5, 1e4], 3)
"""rad and m: standard deviations of a pose of which nothing is known, as far as digits allow."""
_SHORTEST = 1e-3  # least seconds between the middles of two sweeps
_REASSOCIATE_EVERY = 5  # gauss-Newton iterations per association of scan to scan (LOAM)
_WEIGHT_SLOPE = 1.8  # weight 1 - 1.8 |d| after the first association of scan to scan (LOAM)
_MIN_MATCHES = 10  # least matches of the scan-to-scan odometry; with fewer the twist stays (LOAM)
_CONVERGED = 1e-5  # change over a sweep, rad and m, below which scan to scan stops
_RING_SPACING = 1e4  # metres between rings in the 4D search; more than the width of any sweep


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """The predicted pose and (6,) body velocity, rad/s and m/s, at a sweep's reference time."""

    map_T_lidar: gtsam.Pose3
    twist: FloatArray


def checked_guess(value: Guess) -> Guess:
    """The guess itself; InputError for anything else."""
    check_kind(value, Guess, "what guess returns", "Guess(map_T_lidar, twist) makes one")
    checked_pose(value.map_T_lidar, "what guess returns")
    return value


class Odometry(Protocol):
    """A method that predicts the pose of each sweep."""

    def guess(self, features: Features, last: MapUpdate | None) -> Guess:
        """Predict the pose of a sweep, without any change of the odometry.

        ``last`` is the result of the mapper for the last sweep, None at the start.
        """
        ...

    def remember(self, features: Features) -> None:
        """Store the features of a sweep that the mapper has used."""
        return

    def reset(self) -> None:
        """Forget all sweeps."""
        return


def advance(map_T_lidar: gtsam.Pose3, twist: FloatArray, seconds: float) -> gtsam.Pose3:
    """The pose after moving with a constant body velocity."""
    return map_T_lidar.compose(gtsam.Pose3.Expmap(twist * seconds))


class Turns(Protocol):
    """A source of rotations: an :class:`~loam_gtsam.ImuBuffer` or the IMU of the mapper."""

    def rotation_between(self, first: int, second: int) -> gtsam.Rot3 | None:
        """The rotation ``first_R_second`` between two stamps, None if unknown."""
        ...


class ConstantVelocity(Odometry):
    """Prediction with the velocity of the last sweep, and with the rotation of an IMU if known."""

    def __init__(self, imu: Turns | None = None) -> None:
        self.imu = imu

    def guess(self, features: Features, last: MapUpdate | None) -> Guess:
        """See :meth:`Odometry.guess`."""
        return self.at(features.stamp, last)

    def at(self, stamp: int, last: MapUpdate | None) -> Guess:
        """The guess for a stamp, nanoseconds."""
        if last is None:
            return Guess(gtsam.Pose3(), np.zeros(6))
        seconds = min((stamp - last.stamp) * 1e-9, LONGEST)
        turned = None if self.imu is None else self.imu.rotation_between(last.stamp, stamp)
        if turned is None:
            return Guess(advance(last.map_T_lidar, last.twist, seconds), last.twist)
        # With a known rotation, the velocity in the map is constant, not the body velocity.
        moved = last.map_T_lidar.compose(gtsam.Pose3(turned, last.twist[3:] * seconds))
        velocity = turned.matrix().T @ last.twist[3:]
        return Guess(moved, np.concatenate([last.twist[:3], velocity]))


class Moment(NamedTuple):
    """The middle of a registered sweep."""

    stamp: int  # nanoseconds
    map_T_lidar: gtsam.Pose3
    solved: bool  # or given for the first sweep; else the pose was predicted
    error: FloatArray | None = None  # (6, 6) covariance in the map as the scans see it, if known

    def seconds_to(self, stamp: int) -> float:
        """Seconds to the middle of a later sweep."""
        # The middles of two sweeps of different length may coincide.
        return max((stamp - self.stamp) * 1e-9, _SHORTEST)

    def later(self, nanoseconds: int) -> Moment:
        """The same on a clock that was set ahead by so much."""
        return self._replace(stamp=self.stamp + nanoseconds)

    def twist_to(self, stamp: int, map_T_lidar: gtsam.Pose3) -> FloatArray:
        """(6,) mean body velocity, rad/s and m/s, that leads to the middle of a later sweep."""
        way = gtsam.Pose3.Logmap(self.map_T_lidar.between(map_T_lidar))
        twist: FloatArray = way / self.seconds_to(stamp)
        return twist


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The predicted pose of a sweep.

    Attributes
    ----------
    posed : the sweep, de-skewed with the predicted motion
    map_T_lidar, map_T_middle : pose at the reference time and at the middle of the sweep
    motion : the expected pose at the middle, for directions that the scan does not fix
    inertial : what gyro and accelerometer predict; None without
    """

    posed: PosedSweep
    map_T_lidar: gtsam.Pose3
    map_T_middle: gtsam.Pose3
    motion: MotionPrior
    inertial: InertialPrediction | None = None


class InertialPredictor(Turns, Protocol):
    """The part of the mapper's IMU that predictions need."""

    def predict(self, stamp: int) -> InertialPrediction | None:
        """The pose, velocity and covariance by gyro and accelerometer; None if not available."""
        ...

    def bend(self, stamp: int, seconds: FloatArray, map_R_lidar: FloatArray) -> FloatArray | None:
        """(K, 3) metres: the lidar's way from a straight line; None if unknown."""
        ...


def predict(
    sweep: MovingSweep,
    last: MapUpdate | None,
    moment: Moment | None,
    imu: InertialPredictor | None,
    config: SolverConfig,
    guess: gtsam.Pose3 | None = None,
    twist: FloatArray | None = None,
    expected: gtsam.Pose3 | None = None,
) -> Prediction:
    """Predict the pose of a sweep: by gyro and accelerometer if known, else by constant velocity.

    Parameters
    ----------
    last, moment : update and middle of the last sweep; None for the first sweep
    imu : source of the rotation, or of all of the motion
    config : ``turn_sigma`` and ``acceleration_sigma`` are the uncertainty of a constant velocity
    guess : ``map_T_lidar`` at the reference time, which replaces the predicted pose
    twist : (6,) body velocity at the reference time, which replaces the predicted velocity
    expected : pose at the middle by the velocity of all sweeps before, for directions that the
        scan does not fix; the predicted pose if None
    """
    if guess is not None:
        checked_pose(guess, "guess")
    steady = ConstantVelocity(imu).at(sweep.reference_stamp, last)
    inertial = None if last is None or imu is None else imu.predict(sweep.stamp)
    if imu is not None:
        around = (steady.map_T_lidar if guess is None else guess).rotation()
        sweep = _bent(sweep, moment, imu, around)
    if twist is None and inertial is not None:
        velocity = inertial.map_T_lidar.rotation().matrix().T @ inertial.velocity
        twist = sweep.twist_at_reference(steady.twist[:3], velocity)
    posed = sweep.at(steady.twist if twist is None else as_vector(twist, "twist", 6))
    if guess is None and inertial is not None:
        guess = inertial.map_T_lidar.compose(posed.middle_T_reference)
    guess = steady.map_T_lidar if guess is None else guess
    middle = posed.map_T_middle(guess)
    motion = MotionPrior(middle, np.zeros((6, 6)))
    if inertial is not None:
        information = np.linalg.inv(inertial.covariance).astype(np.float64)
        motion = MotionPrior(inertial.map_T_lidar, information, measured=True)
    elif moment is not None:
        seconds = moment.seconds_to(sweep.stamp)
        sigmas = np.repeat([config.turn_sigma, config.acceleration_sigma], 3)
        motion = MotionPrior(expected or middle, np.diag((0.5 * seconds**2 * sigmas) ** -2.0))
    return Prediction(posed, guess, middle, motion, inertial)


def _bent(
    sweep: MovingSweep, last: Moment | None, imu: InertialPredictor, map_R_lidar: gtsam.Rot3
) -> MovingSweep:
    """The sweep on the bent path that the accelerometer felt, if it felt one."""
    since = 0.0 if last is None else last.seconds_to(sweep.stamp)
    end = 0.5 * sweep.duration
    if not 0.0 < max(since, end) < _BENT:
        return sweep
    seconds = np.linspace(-max(since, end), end, _NODES)
    middle_R_reference = sweep.middle_T_reference(np.zeros(6)).rotation()
    map_R_middle = map_R_lidar.compose(middle_R_reference.inverse()).matrix()
    path = imu.bend(sweep.stamp, seconds, map_R_middle)
    return sweep if path is None else sweep.bent(seconds, path)


def twist_to(
    sweep: MovingSweep,
    last: Moment | None,
    inertial: InertialPrediction | None,
    map_T_middle: gtsam.Pose3,
    otherwise: FloatArray,
    range_noise: float,
) -> FloatArray:
    """(6,) body velocity that belongs to a pose at the middle of a sweep.

    It is the mean one between the middles of the last sweep and of this one; ``otherwise`` without
    a last sweep, or if its middle is not earlier (sweeps of unlike length). The translation is that
    of the IMU's prediction, if there is one, and if its error moves no point by more than a quarter
    of ``range_noise``, metres; if it may, its expectation given that this is the pose.
    """
    twist = otherwise
    if last is not None and sweep.stamp > last.stamp:
        twist = sweep.twist_since(last[:2], map_T_middle)
    if inertial is None:
        return twist
    known = 0.5 * range_noise / max(sweep.duration, _SHORTEST)
    velocity = map_T_middle.rotation().matrix().T @ inertial.velocity_at(map_T_middle, known)
    return sweep.twist_at_reference(twist[:3], velocity)


class ScanToScan(Odometry):
    """LOAM's odometry: the motion within a sweep from matches with the last sweep.

    The last sweep, de-skewed with its solved motion, is moved to the start of the new sweep. Sharp
    points of the new sweep are matched with lines through edge points of two neighbouring rings,
    flat points with planes through three plane points of two rings. The unknown is the constant
    body velocity over the sweep (Zhang and Singh, LOAM, RSS 2014, Section V).
    """

    def __init__(self, config: OdometryConfig, imu: Turns | None = None) -> None:
        self.config = config
        self._start = ConstantVelocity(imu)
        self._previous: Features | None = None

    def guess(self, features: Features, last: MapUpdate | None) -> Guess:
        """See :meth:`Odometry.guess`."""
        guess = self._start.guess(features, last)
        previous = self._previous
        first, end = features.span
        if previous is None or last is None or end <= first:
            return guess
        gap = (features.stamp - previous.stamp) * 1e-9 + first
        twist = self._solve(features, previous, last.twist, gap)
        start = advance(guess.map_T_lidar, guess.twist, first)
        return Guess(advance(start, twist, -first), twist)

    def remember(self, features: Features) -> None:
        """See :meth:`Odometry.remember`."""
        self._previous = features

    def reset(self) -> None:
        """See :meth:`Odometry.reset`."""
        self._previous = None

    def _solve(
        self, features: Features, previous: Features, twist: FloatArray, gap: float
    ) -> FloatArray:
        """The twist that aligns the sharp and flat points with the last sweep."""
        limit, rings = self.config.max_distance, self.config.ring_gap
        first, end = features.span
        edges = _RingSearch(
            move_points(previous.edges, twist, previous.edge_times - gap), previous.edge_rings
        )
        planes = _RingSearch(
            move_points(previous.planes, twist, previous.plane_times - gap), previous.plane_rings
        )
        sharp, flat = features.sharp, features.flat
        points = np.concatenate([features.edges[sharp], features.planes[flat]])
        times = np.concatenate([features.edge_times[sharp], features.plane_times[flat]]) - first
        for iteration in range(self.config.iterations):
            moved = move_points(points, twist, times)
            if iteration % _REASSOCIATE_EVERY == 0:
                on_line, centres, directions = edges.lines(moved[: len(sharp)], limit, rings)
                on_plane, normals, offsets = planes.planes(moved[len(sharp) :], limit, rings)
                index = np.concatenate([on_line, len(sharp) + on_plane])
                if len(index) < _MIN_MATCHES:
                    break
            away = moved[on_line] - centres
            away -= np.einsum("ij,ij->i", away, directions)[:, None] * directions
            distance = np.linalg.norm(away, axis=1)
            rows = np.concatenate([away / np.maximum(distance, 1e-9)[:, None], normals])
            height = np.einsum("ij,ij->i", normals, moved[len(sharp) + on_plane]) + offsets
            residual = np.concatenate([distance, height])
            weight = np.ones(len(residual))
            if iteration >= _REASSOCIATE_EVERY:
                weight = np.maximum(1.0 - _WEIGHT_SLOPE * np.abs(residual), 0.0)
            # A small change d of the twist moves q = Exp(twist t) p by t (d_rot x q + d_trans).
            scale = (weight * times[index])[:, None]
            jacobian = scale * np.hstack([np.cross(moved[index], rows), rows])
            step = np.linalg.lstsq(jacobian, -weight * residual, rcond=1e-6)[0]
            twist = twist + step
            if np.abs(step).max() * (end - first) < _CONVERGED:
                break
        return twist


class _RingSearch:
    """Lines and planes through the points of a sweep that are nearest to a query."""

    def __init__(self, points: FloatArray, rings: IntArray) -> None:
        self.points, self.rings = points, rings
        self._tree = cKDTree(points)
        # Rings are so far apart along the fourth axis that the nearest is of exactly that ring.
        self._ring_tree = cKDTree(np.column_stack([points, rings * _RING_SPACING]))

    def lines(
        self, queries: FloatArray, limit: float, gap: int
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Rows of the queries that have a line; a point of the line and its unit direction."""
        index, first, other = self._pairs(queries, limit, gap)
        centres = self.points[first]
        directions, proper = _normalised(self.points[other] - centres)
        return index[proper], centres[proper], directions[proper]

    def planes(
        self, queries: FloatArray, limit: float, gap: int
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Rows of the queries that have a plane ``n . q + d = 0``; its unit normal and offset."""
        index, first, other = self._pairs(queries, limit, gap)
        two = self._in_ring(queries[index], self.rings[first], limit, 2)
        same = np.where(two[:, 0] == first, two[:, 1], two[:, 0])
        found = same >= 0
        a, b, c = (self.points[ids[found]] for ids in (first, same, other))
        normals, proper = _normalised(np.cross(b - a, c - a))
        normals = normals[proper]
        return index[found][proper], normals, -np.einsum("ij,ij->i", normals, a[proper])

    def _pairs(
        self, queries: FloatArray, limit: float, gap: int
    ) -> tuple[IntArray, IntArray, IntArray]:
        """Rows of queries, their nearest points, and the nearest of at most ``gap`` rings away."""
        _, first = self._tree.query(queries, distance_upper_bound=limit)
        index = np.flatnonzero(first < len(self.points))
        first, queries = first[index], queries[index]
        steps = [step for step in range(-gap, gap + 1) if step]
        rings = self.rings[first]
        candidates = np.hstack([self._in_ring(queries, rings + step, limit, 1) for step in steps])
        away = self.points[candidates] - queries[:, None, :]
        squared = np.where(candidates < 0, np.inf, np.einsum("nki,nki->nk", away, away))
        other = candidates[np.arange(len(queries)), squared.argmin(axis=1)]
        found = other >= 0
        return index[found], first[found], other[found]

    def _in_ring(self, queries: FloatArray, rings: IntArray, limit: float, k: int) -> IntArray:
        """(N, k) nearest points of the given rings, -1 where missing."""
        query = np.column_stack([queries, rings * _RING_SPACING])
        _, nearest = self._ring_tree.query(query, k=range(1, k + 1), distance_upper_bound=limit)
        return np.where(nearest < len(self.points), nearest, -1)


def _normalised(vectors: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Unit vectors, and a mask of the vectors that are long enough to have a direction."""
    length = np.linalg.norm(vectors, axis=1)
    proper = length > 1e-6
    return vectors / np.where(proper, length, 1.0)[:, None], proper


def make_odometry(config: OdometryConfig, imu: Turns | None = None) -> Odometry | None:
    """Make the odometry that the configuration names; None if the mapper predicts by itself."""
    return ScanToScan(config, imu) if config.method == "scan_to_scan" else None
