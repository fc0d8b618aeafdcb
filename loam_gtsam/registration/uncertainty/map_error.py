"""The error of the map around the lidar, which all its poses share: docs/maths/covariance.md."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.geometry import nearest_positive, symmetric
from loam_gtsam.registration.odometry import ANYWHERE, Moment, Turns
from loam_gtsam.registration.solvers import MotionFilter, MotionPrior, Solution
from loam_gtsam.registration.solvers.scan_error import ScanError
from loam_gtsam.registration.uncertainty.missed_motion import rotation_is_known, unresolved
from loam_gtsam.registration.uncertainty.range_offset import RangeOffset
from loam_gtsam.types import FloatArray

_LEAST_KEPT = 1e-4  # below that correlation all is forgotten


class MapError:
    """What was added to the error of the map, sweep by sweep, since the map began.

    Attributes
    ----------
    drift : (6, 6) that came by new ground, blind ways, jumps and rivals
    offset : that all ranges have, as the scans tell it
    """

    def __init__(self, config: Config) -> None:
        self._drift_factor, self._lag = config.covariance.drift, config.imu.lag
        self._velocity = MotionFilter(config.solver)
        self.drift, self._blind, self._forgotten = np.zeros((6, 6)), np.zeros((6, 9)), np.zeros(9)
        self._rivals, self._moved = _Rivals(), np.zeros((6, 6))
        self._disputed: tuple[int | None, FloatArray] = None, np.zeros((6, 6))
        self._first: PosedSweep | None = None
        self._searches = config.deskew.model != "predicted"  # for the first motion
        self._origin = _Origin()
        self.offset = RangeOffset(config.matching.point_sigma, config.sensor.range_offset)
        self._by_offset = np.zeros(6)

    @property
    def doubt(self) -> FloatArray:
        """(6, 6) of the pose in the map, while other first motions may be the true one."""
        return self._rivals.doubt

    @property
    def blind(self) -> tuple[FloatArray, FloatArray]:
        """``blind`` and ``forgotten`` of :class:`~loam_gtsam.types.Uncertainty`."""
        sigma = self.offset.mean_square**0.5
        blind = np.column_stack([self._blind, sigma * self._by_offset])
        return blind, np.append(self._forgotten, -np.log(sigma))

    def begin(self, posed: PosedSweep) -> None:
        """The map begins with a sweep, if it has not begun yet."""
        if self._first is None:
            self._first = PosedSweep(posed.sweep, posed.twist)  # without the points it has made
            self._velocity.begin(posed.sweep.stamp)

    def begin_after(
        self, before: MapError, first_accelerations: FloatArray, uncertain: FloatArray
    ) -> None:
        """Begin another map, so uncertain, (6, 6) on the left, beside what ``before`` holds.

        ``first_accelerations`` are those of :meth:`total` there.
        """
        self.drift = before.total(first_accelerations) + uncertain
        self._forgotten = before._forgotten - np.log(_LEAST_KEPT)
        self.offset = deepcopy(before.offset)

    def total(self, first_accelerations: FloatArray) -> FloatArray:
        """(6, 6) the error of the map now, seen from the first pose; map axes, as all in here.

        ``first_accelerations`` (6,) are mean squares of those with which the run began.
        """
        blind = self.blind[0]
        total = self.drift + blind @ blind.T + self._moved
        return total + self._origin.error(first_accelerations)

    def expected(self, stamp: int, last: Moment | None, imu: Turns | None) -> gtsam.Pose3 | None:
        """The pose at a stamp, by the velocity of all frames before; None after unsolved ones.

        ``last`` is the middle of the last sweep; ``imu`` tells the rotation since, if it can.
        """
        if last is None or not self._follows(last):
            return None
        turned = None if imu is None else imu.rotation_between(last.stamp, stamp)
        return self._velocity.expected(stamp, last.map_T_lidar, turned)

    def _follows(self, last: Moment | None) -> bool:
        """Whether the velocity is that at the middle of the last sweep."""
        return last is not None and last.solved and last.stamp == self._velocity.stamp

    def add_scan(
        self, number: int, sweep: MovingSweep, solution: Solution, scan: ScanError,
        last: Moment | None, settled: FloatArray | None,
    ) -> None:  # fmt: skip
        """What the new ground of a scan adds, and the expected motion where it is alone.

        The scans are numbered from 1. ``settled`` (6, 6) is the covariance of the pose in the map
        if an IMU helped to find it.
        """
        renewed = scan.drift(self._drift_factor, settled if number > self._lag else None)
        if solution.weak is None:
            self.offset.add(scan)
        to_map, share, seen = solution.map_T_lidar.AdjointMap(), scan.expected, None
        if solution.weak is not None and share.any():
            seen = solution.localizability
        if seen is not None:
            rows = len(solution.matches) / max(scan.effective_matches, 1.0)
            share = seen.without_noise(share, rows)
        self._by_offset = to_map @ scan.by_offset
        before = last.map_T_lidar if last is not None and self._follows(last) else None
        step = self._velocity.observe(
            sweep.stamp, before, solution.map_T_lidar, share, scan.raw,
            turned=rotation_is_known(sweep),
        )  # fmt: skip
        by_chance = renewed + step.by_chance + scan.since_last
        if seen is not None:
            moved = step.by_velocity @ step.by_velocity.T + step.by_chance
            by_chance = by_chance + rows * seen.wander(moved)
        blind = self._blind + to_map @ step.by_velocity
        faded = nearest_positive(np.eye(9) - step.kept.T @ step.kept)
        self.drift = self.drift + symmetric(to_map @ by_chance @ to_map.T + blind @ faded @ blind.T)
        self._blind = blind @ step.kept.T
        self._forgotten = self._forgotten - np.log(np.clip(np.diag(step.kept), _LEAST_KEPT, 1.0))

    def set_velocity(self, velocity: FloatArray) -> None:
        """The velocity (3,) by scan and IMU together, m/s in lidar axes."""
        self._velocity.told(velocity)

    def set_origin(
        self, second: MovingSweep, scan: ScanError, middle: gtsam.Pose3, twist: FloatArray
    ) -> None:
        """The second sweep tells the first motion, by which the points of the first were placed.

        ``scan`` is the error of the second, about its pose in the ``middle``, and ``twist`` (6,)
        its velocity, rad/s and m/s.
        """
        if self._first is not None:
            velocity = None if self._searches else twist
            self._origin = _Origin.of(self._first, second, scan, middle, velocity)

    def add_rivals(self, stamp: int, doubt: FloatArray | None, parting: FloatArray | None) -> None:
        """What other first motions add: see :meth:`_Rivals.told`."""
        self.drift = self.drift + self._rivals.told(self._first, stamp, doubt, parting)

    def add_jump(self, pose: gtsam.Pose3, step: FloatArray, expected: FloatArray) -> None:
        """A pose was found a ``step`` (6,) from the expected one, and may only look alike.

        The other one is as likely, with its covariance (6, 6) on the left, in map axes. The mean
        squared error is half the square of the step, along each axis, and half of that.
        """
        in_map = pose.AdjointMap() * step
        self.drift = self.drift + 0.5 * (in_map @ in_map.T + expected)

    def add_dispute(
        self, pose: gtsam.Pose3, step: FloatArray, expected: FloatArray, since: int
    ) -> None:
        """As :meth:`add_jump`, of all frames ``since`` an IMU began to lead elsewhere, nanoseconds.

        The error grows as the two part, and stays when the dispute is over.
        """
        known = self._disputed[1] if self._disputed[0] == since else np.zeros((6, 6))
        in_map = pose.AdjointMap() @ step
        more = nearest_positive(0.5 * (np.outer(in_map, in_map) + expected) - known)
        self._disputed = since, known + more
        self.drift = self.drift + more

    def add_expected(self, motion: MotionPrior) -> None:
        """A sweep went into the map where it was expected, which nothing else tells."""
        if motion.information.any():
            unknown = np.linalg.inv(motion.information + np.diag(ANYWHERE**-2.0))
            to_map = motion.map_T_lidar.AdjointMap()
            self.drift = self.drift + symmetric(to_map @ unknown @ to_map.T)

    def add_move(self, step: gtsam.Pose3) -> None:
        """A loop closure moved points of the map by a step, in map axes.

        The frames to come follow them, the first pose does not. No motion is the worse for it.
        """
        in_map = gtsam.Pose3.Logmap(step)
        self._moved = self._moved + np.outer(in_map, in_map)

    def cut(self, ahead: int) -> None:
        """The next sweep is on a clock that was set ahead by so many nanoseconds."""
        self._velocity.cut()
        if self._first is not None:
            self._first = self._first.later(ahead)


class _Rivals:
    """What other motions that may be the true ones add to the error of the map.

    While the start lasts, the pose is in ``doubt``. What is left of it afterwards is an error of
    the map, and goes on growing if a rival parts from the motion that was chosen: as where what
    passes was taken for what stands.
    """

    def __init__(self) -> None:
        self.doubt, self._parting = np.zeros((2, 6, 6))
        self._told = 0.0  # seconds after the first sweep

    def told(
        self, first: PosedSweep | None, stamp: int,
        doubt: FloatArray | None, parting: FloatArray | None,
    ) -> FloatArray:  # fmt: skip
        """What the map's error (6, 6) grows by, with a frame of this stamp of the middle.

        ``doubt`` is the covariance (6, 6) of the pose, map frame, until the start of the run is
        over, and None from then on; ``parting`` is the mean square (6, 6) of a velocity at which
        the pose may go on elsewhere, rad/s and m/s, told with these.
        """
        seconds = 0.0 if first is None else (stamp - first.sweep.stamp) * 1e-9
        if parting is not None:  # still in doubt: nothing has grown since
            self._parting, self._told = parting, seconds
        grown = max(seconds**2 - self._told**2, 0.0) * self._parting
        if doubt is None:
            grown, doubt = grown + self.doubt, np.zeros((6, 6))
        self.doubt, self._told = doubt, seconds
        return grown


@dataclass(frozen=True, slots=True, eq=False)
class _Origin:
    """The error of the first pose, which is where the map is: all later poses have it in common.

    The pose at the reference time of the first sweep is held; the points of that sweep are where
    they are by the motion within it, which is that from its middle to that of the second sweep.

    Attributes
    ----------
    to_map : (6, 6) adjoint
    velocity : (6, 6) covariance by the error of that velocity
    bend : (6, 6) s^2, by which an acceleration moves what is seen
    """

    to_map: FloatArray = field(default_factory=lambda: np.eye(6))
    velocity: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    bend: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @classmethod
    def of(
        cls, first: PosedSweep, second: MovingSweep, scan: ScanError, middle: gtsam.Pose3,
        velocity: FloatArray | None,
    ) -> _Origin:  # fmt: skip
        """Of :meth:`MapError.set_origin`.

        ``velocity`` (6,) is that of the second sweep, rad/s and m/s, if the first one stays
        de-skewed for its own; None if it is de-skewed anew.
        """
        seconds, start = (second.stamp - first.sweep.stamp) * 1e-9, first.sweep.middle
        if seconds <= 0.0:  # sweeps of different length
            return cls()
        # A point seen t after the middle is where t + start times the velocity has put it, from the
        # reference, which is held. By an acceleration the velocity between both middles misses
        # (t^2 - start^2) / 2 - between (t + start) / 2. Each side is seen at its own time.
        between, faster = unresolved(seconds, first.sweep.duration)
        by_velocity = scan.by_velocity + start * np.eye(6)
        bend = scan.by_acceleration - 0.5 * between * scan.by_velocity
        # Along one axis the two might cancel each other, which a stamp that is late does not.
        np.fill_diagonal(bend, -0.5 * start * (between + start))
        bend *= faster
        if rotation_is_known(first.sweep):
            by_velocity[:, :3] = bend[:, :3] = 0.0
        covariance = by_velocity @ scan.covariance @ by_velocity.T / seconds**2
        if velocity is not None:
            aside = by_velocity @ (velocity - first.twist)
            covariance = covariance + np.outer(aside, aside)
        return cls(middle.AdjointMap(), covariance, bend)

    def error(self, accelerations: FloatArray) -> FloatArray:
        """(6, 6) in the map, from the (6,) mean squared accelerations."""
        covariance = self.velocity + self.bend * accelerations @ self.bend.T
        in_map: FloatArray = self.to_map @ covariance @ self.to_map.T
        return in_map
