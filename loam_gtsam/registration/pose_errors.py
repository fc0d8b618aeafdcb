"""How wrong a pose may be: covariances of poses in the map, and of the motion between two poses.

Unlike in the inverse of the information, the scatter is that of the residuals, matches close
together count as one, and two errors are added: docs/maths/covariance.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.geometry import nearest_positive, positive_root, symmetric, transform
from loam_gtsam.imu.preintegration import Fused
from loam_gtsam.registration.acceleration import Accelerations, Expected
from loam_gtsam.registration.odometry import Moment, Prediction, Turns
from loam_gtsam.registration.relocalization import same
from loam_gtsam.registration.solvers import MotionFilter, Solution
from loam_gtsam.registration.solvers.scan_error import ScanError, SeenGround, scan_error
from loam_gtsam.types import (
    FloatArray,
    FrameStatus,
    InputError,
    MapUpdate,
    SweepMotion,
    Uncertainty,
)

_LASTING = 0.3
"""Share of a scan's covariance that stays for some frames and that no filter averages: consecutive
innovations correlate by 0 to 0.5, by axis and place (street, park, room, garage, trees)."""
_LEAST_KEPT = 1e-4  # below that correlation all is forgotten
_PAUSE = 1.0
"""Seconds for which a velocity may have changed where a clock was set: nothing tells how long the
sweeps took that were on neither clock."""


def relative_covariance(earlier: MapUpdate, later: MapUpdate) -> FloatArray:
    """Covariance of ``earlier.map_T_lidar.between(later.map_T_lidar)``.

    The covariance for a factor between two poses: the own errors of both frames and the drift of
    the map between them. The drift before is common to both poses and cancels.

    Both are frames of one run, the later one solved, the earlier one too or the first: the map
    begins there, and its pose has no error in it. Returns (6, 6), tangent order of the package,
    perturbation on the right: along the axes of the later frame.

    Raises
    ------
    InputError
        If a frame was not solved, or ``later`` is not later than ``earlier``.
    """
    begins = earlier.status is FrameStatus.FIRST
    for name, update in (("earlier", earlier), ("later", later)):
        if update.uncertainty is None and not (begins and update is earlier):
            raise InputError(
                f"{name}: expected a frame that was solved, got one with status {update.status}; "
                "choose another one"
            )
    if later.stamp <= earlier.stamp:
        raise InputError(
            f"later: expected a stamp after {earlier.stamp}, got {later.stamp}; swap the two"
        )
    if begins:
        return later.covariance.copy()
    first, second = earlier.uncertainty, later.uncertainty
    assert first is not None
    assert second is not None
    to_later = later.map_T_lidar.between(earlier.map_T_lidar).AdjointMap()
    from_map = later.map_T_lidar.inverse().AdjointMap()
    covariance = second.own + to_later @ first.own @ to_later.T
    # The error of the velocity was the same in both, but for what was forgotten in between.
    blind = second.blind - first.blind * np.exp(first.forgotten - second.forgotten)
    covariance += from_map @ (second.drift - first.drift + blind @ blind.T) @ from_map.T
    if second.follows == earlier.stamp:
        common = second.shared @ to_later.T
        covariance -= common + common.T
    return symmetric(covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _Middle:
    """A solved frame at the middle of its sweep."""

    stamp: int  # nanoseconds of the middle
    map_T_lidar: gtsam.Pose3
    covariance: FloatArray  # (6, 6) of the scan's own error
    kept: FloatArray  # (6,) share of the scan's own error in the pose at the reference time
    to_reference: FloatArray  # (6, 6) adjoint from the middle to the reference time
    reference_stamp: int
    of_state: FloatArray | None = None  # (6, 9) by which errors of pose and velocity get there
    lasting: FloatArray | None = None  # (6, 6) root of what its scan shares with the next one's


class PoseErrors:
    """Calibrates the covariances of a run, frame by frame.

    Of ``config``, ``covariance``, ``solver``, ``deskew.model`` and parts of ``imu`` are used.
    """

    def __init__(self, config: Config) -> None:
        self._places = [
            (place.covariance, SeenGround(place.covariance.ground_cell))
            for place in (config, config.of_small_places())
        ]
        self._drift_factor = config.covariance.drift
        self._small, self._scans = False, 0  # scans that :meth:`of_scan` was given
        self._kernel, graph = config.solver.kernel, config.solver.method == "gtsam"
        self._kernel_width = config.solver.kernel_width if graph else np.inf
        # Rows of the classical solvers count as measured to 1 m; they have no priors to find.
        self._with_priors = graph
        self._gyro_noise, self._lag = config.imu.gyro_noise, config.imu.lag
        expected = [config.solver.turn_sigma, config.solver.acceleration_sigma]
        self._motion = Accelerations(config.covariance.window, np.repeat(expected, 3) ** 2)
        self._expected = MotionFilter(config.solver)
        self._drift, self._blind, self._forgotten = np.zeros((6, 6)), np.zeros((6, 9)), np.zeros(9)
        self._rivals, self._moved = _Rivals(), np.zeros((6, 6))
        self._first: PosedSweep | None = None
        self._searches = config.deskew.model != "predicted"  # for the first motion
        self._origin, self._paused = _Origin(), False
        self._last: _Middle | None = None

    @property
    def accelerations(self) -> Expected | None:
        """What the poses so far tell of the next acceleration; None at first."""
        return self._motion.next

    def of_scan(self, solution: Solution, *, small: bool = False) -> ScanError | None:
        """The error of a solved scan; to be called once for each, in order.

        ``small`` tells whether the place is small.
        """
        self._scans += 1
        config, seen = self._places[small]
        if small != self._small and self._scans > 1:
            # The ground is the same, only in other cells.
            found = solution.matches
            points = np.concatenate([found.edges.points, found.planes.points])
            seen.cells(transform(solution.map_T_lidar.matrix(), points))
        self._small = small
        return scan_error(
            solution, self._kernel_width, seen, config,
            kernel=self._kernel, with_priors=self._with_priors,
        )  # fmt: skip

    def calibrated(
        self,
        update: MapUpdate,
        sweep: MovingSweep,
        solution: Solution,
        scan: ScanError | None,
        last: Moment | None,
        fused: Fused | None = None,
        doubt: FloatArray | None = None,
        parting: FloatArray | None = None,
    ) -> MapUpdate:
        """The update of a solved frame with its covariance; to be called after :meth:`of_scan`.

        The sweep has the motion of the solution, which is at its middle; ``last`` is the middle of
        the last sweep, None if the sweep did not get here from there; ``fused`` is the pose by scan
        and IMU together; ``doubt`` is a further covariance (6, 6) of the pose, map frame, until the
        start of the run is over, and None from then on; ``parting`` is the mean square (6, 6) of a
        velocity at which the pose may go on elsewhere, rad/s and m/s, told with these.
        """
        first = self._scans == 1
        if scan is None:
            self._last = None
            return update
        middle = solution.map_T_lidar
        to_reference = update.map_T_lidar.between(middle).AdjointMap()
        to_map = middle.AdjointMap()
        # At the first solve all ground is new but replaces none, which makes half the drift.
        factor = 0.5 * self._drift_factor if first else self._drift_factor
        by_imu = None if solution.weak is not None else fused
        known = scan.covariance if by_imu is None else by_imu.covariance[:6, :6]
        settled = None if self._scans <= self._lag or by_imu is None else known
        self._add_drift(sweep, solution, scan, last, scan.drift(factor, settled))
        if fused is not None:
            self._expected.told(middle.rotation().unrotate(fused.velocity))
        # A pose in doubt tells no acceleration; that of the very first sweep does.
        before = None if self._rivals.doubt.any() else last if first else self._last
        if before is not None and sweep.stamp > before.stamp:
            self._motion.add(before.stamp, before.map_T_lidar, sweep.stamp, middle, known)
        if by_imu is None:
            own, shared, now = self._own(update.stamp, sweep, middle, scan.covariance, to_reference)
            if self._paused:
                own = own + _changed(update.twist, sweep, self._motion.variances)
        else:
            lasting = symmetric(to_reference @ scan.covariance @ to_reference.T)
            root = np.sqrt(_LASTING) * positive_root(lasting)
            own, shared, now = self._own_of(update, sweep, middle, by_imu, to_reference, root)
        if first and self._first is not None:
            velocity = None if self._searches else update.twist
            self._origin = _Origin.of(self._first, sweep, to_map, scan.covariance, velocity)
        drifted = to_reference @ (np.eye(6) - scan.user) @ middle.inverse().AdjointMap()
        self._drift = self._drift + self._rivals.told(self._first, sweep.stamp, doubt, parting)
        own = own + drifted @ self._rivals.doubt @ drifted.T
        uncertainty = Uncertainty(
            own=own,
            shared=shared,
            follows=None if self._last is None else self._last.reference_stamp,
            drift=self._drift,
            blind=self._blind,
            forgotten=self._forgotten,
            residual_variance=scan.residual_variance,
            effective_matches=scan.effective_matches,
            in_doubt=bool(self._rivals.doubt.any()),
        )
        self._last, self._paused = now, False
        total = self._drift + self._blind @ self._blind.T + self._moved
        total = total + self._origin.error(self._motion.at_first)
        covariance = symmetric(own + drifted @ total @ drifted.T)
        return replace(update, covariance=covariance, uncertainty=uncertainty)

    def expected(self, stamp: int, last: Moment | None, imu: Turns | None) -> gtsam.Pose3 | None:
        """The pose at a stamp, by the velocity of all frames before; None after unsolved ones.

        ``last`` is the middle of the last sweep; ``imu`` tells the rotation since, if it can.
        """
        if last is None or not self._follows(last):
            return None
        turned = None if imu is None else imu.rotation_between(last.stamp, stamp)
        return self._expected.expected(stamp, last.map_T_lidar, turned)

    def _follows(self, last: Moment | None) -> bool:
        """Whether the velocity is that at the middle of the last sweep."""
        return last is not None and last.solved and last.stamp == self._expected.stamp

    def jumped(self, expected: Prediction, pose: gtsam.Pose3, *, unlike: bool) -> None:
        """Account for a pose elsewhere than the motion had led to expect the middle of a sweep.

        If no usual acceleration leads there, it may only look alike: the mean squared error is half
        the square of the step, along each axis. An IMU to which it is ``unlike`` knew better.
        """
        before, now = expected.map_T_middle, expected.posed.sweep.stamp
        step = before.localCoordinates(pose)
        if unlike or not (same(before, pose) or self._motion.explains(step, now)):
            in_map = pose.AdjointMap() * step
            self._drift = self._drift + 0.5 * in_map @ in_map.T

    def moved(self, step: gtsam.Pose3) -> None:
        """Account for points of the map that a loop closure moved by a step, in map axes.

        The frames to come follow them, the first pose does not. No motion is the worse for it.
        """
        in_map = gtsam.Pose3.Logmap(step)
        self._moved = self._moved + np.outer(in_map, in_map)

    def cut(self) -> None:
        """Start anew in time: the next frame is on another clock."""
        self._last, self._paused = None, True
        self._expected.cut()

    def _add_drift(
        self, sweep: MovingSweep, solution: Solution, scan: ScanError, last: Moment | None,
        renewed: FloatArray,
    ) -> None:  # fmt: skip
        """What new ground adds to the map's error, and the expected motion where it is alone."""
        to_map, share, seen = solution.map_T_lidar.AdjointMap(), scan.expected, None
        if solution.weak is not None and share.any():
            seen = solution.localizability
        if seen is not None:
            rows = len(solution.matches) / max(scan.effective_matches, 1.0)
            share = seen.without_noise(share, rows)
        before = last.map_T_lidar if last is not None and self._follows(last) else None
        found = before, solution.map_T_lidar, share, scan.raw
        step = self._expected.observe(sweep.stamp, *found, turned=_turned(sweep))
        by_chance = renewed + step.by_chance
        if seen is not None:
            moved = step.by_velocity @ step.by_velocity.T + step.by_chance
            by_chance = by_chance + rows * seen.wander(moved)
        blind = self._blind + to_map @ step.by_velocity
        faded = nearest_positive(np.eye(9) - step.kept.T @ step.kept)
        self._drift = self._drift + symmetric(
            to_map @ by_chance @ to_map.T + blind @ faded @ blind.T
        )
        self._blind = blind @ step.kept.T
        self._forgotten = self._forgotten - np.log(np.clip(np.diag(step.kept), _LEAST_KEPT, 1.0))

    def skipped(self, posed: PosedSweep) -> None:
        """Account for a sweep whose pose is the expected one; the very first begins the map."""
        if self._first is None and not self._scans:
            self._first = PosedSweep(posed.sweep, posed.twist)  # without the points it has made
            self._expected.begin(posed.sweep.stamp)

    def _own_of(
        self, update: MapUpdate, sweep: MovingSweep, middle: gtsam.Pose3,
        fused: Fused, to_reference: FloatArray, lasting: FloatArray,
    ) -> tuple[FloatArray, FloatArray, _Middle]:  # fmt: skip
        """As :meth:`_own`, of a frame whose velocity is known too.

        ``lasting`` (6, 6) is the root of the covariance of what consecutive scans have in common.
        """
        last = self._last
        back = -sweep.middle * update.map_T_lidar.rotation().matrix().T
        of_state = np.hstack([to_reference, np.vstack([np.zeros((3, 3)), back])])
        turned = np.concatenate([self._missed(sweep)[:3], np.zeros(3)])
        own = of_state @ fused.covariance @ of_state.T + np.diag(turned) + lasting @ lasting.T
        shared = np.zeros((6, 6))
        if last is not None and last.of_state is not None and last.lasting is not None:
            shared = of_state @ fused.across @ last.of_state.T + lasting @ last.lasting.T
        parts = middle, fused.covariance[:6, :6], np.ones(6), to_reference, update.stamp
        now = _Middle(sweep.stamp, *parts, of_state, lasting)
        return symmetric(own), shared, now

    def _own(
        self, reference_stamp: int, sweep: MovingSweep, middle: gtsam.Pose3,
        covariance: FloatArray, to_reference: FloatArray,
    ) -> tuple[FloatArray, FloatArray, _Middle]:  # fmt: skip
        """The frame's own error at the reference time, and what it shares with the last frame's."""
        # The pose at the reference time follows from that at the middle by the velocity since the
        # last middle, and so has a share in the errors of both.
        last = self._last
        if last is not None and sweep.stamp <= last.stamp:  # sweeps of different length
            last = None
        seconds = np.inf if last is None else (sweep.stamp - last.stamp) * 1e-9
        share = np.full(6, sweep.middle / seconds)
        if _turned(sweep):  # the rotation within the sweep is measured
            share[:3] = 0.0
        kept = 1.0 - share
        own = kept[:, None] * covariance * kept
        shared = np.zeros((6, 6))
        if last is not None:
            across = share[:, None] * middle.between(last.map_T_lidar).AdjointMap()
            own = own + across @ last.covariance @ across.T
            shared = to_reference @ across @ (last.covariance * last.kept) @ last.to_reference.T
        own = to_reference @ (own + np.diag(self._missed(sweep))) @ to_reference.T
        now = _Middle(sweep.stamp, middle, covariance, kept, to_reference, reference_stamp)
        return symmetric(own), shared, now

    def _missed(self, sweep: MovingSweep) -> FloatArray:
        """(6,) variances of what the mean velocity misses from the middle to the reference time."""
        # The acceleration times this is the distance of an arc from its chord: at the reference
        # time, between the last two middles, and in the mean over the sweep.
        bend = sweep.duration**2 / 24.0
        if self._last is not None and sweep.stamp > self._last.stamp:
            seconds = (sweep.stamp - self._last.stamp) * 1e-9
            bend += 0.5 * sweep.middle * (seconds - sweep.middle)
        missed = bend**2 * self._motion.missed(steady=sweep.acceleration is None)
        if _turned(sweep):
            missed[:3] = 0.0
        if sweep.motion is SweepMotion.GYRO:
            missed[:3] = self._gyro_noise**2 * abs(sweep.middle)
        return missed


def _changed(twist: FloatArray, sweep: MovingSweep, accelerations: FloatArray) -> FloatArray:
    """(6, 6) covariance of what a velocity from before a pause misses at the reference time.

    ``twist`` (6,) is that velocity, rad/s and m/s, which may have turned as well;
    ``accelerations`` are (6,) mean squares.
    """
    squares = accelerations.copy()
    squares[:3] *= not _turned(sweep)
    squares[3:] += np.sum(np.cross(twist[:3], twist[3:]) ** 2)
    return np.diag((sweep.middle * _PAUSE) ** 2 * squares)


def _turned(sweep: MovingSweep) -> bool:
    """Whether an IMU knows the rotation of a sweep."""
    return sweep.motion in (SweepMotion.GYRO, SweepMotion.ORIENTATION)


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

        ``doubt`` and ``parting`` are as in :meth:`PoseErrors.calibrated`.
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
    they are by the motion from its middle, which is that to the middle of the second sweep.
    """

    to_map: FloatArray = field(default_factory=lambda: np.eye(6))
    velocity: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    bend: FloatArray = field(default_factory=lambda: np.zeros(6))  # s^2, by axis

    @classmethod
    def of(
        cls, first: PosedSweep, second: MovingSweep, to_map: FloatArray, covariance: FloatArray,
        velocity: FloatArray | None,
    ) -> _Origin:  # fmt: skip
        """``covariance`` (6, 6) is that of the second sweep, ``to_map`` its adjoint to the map.

        ``velocity`` (6,) is that of the second sweep, rad/s and m/s, if the first one stays
        de-skewed for its own; None if it is de-skewed anew.
        """
        seconds, middle = (second.stamp - first.sweep.stamp) * 1e-9, first.sweep.middle
        if seconds <= 0.0:  # sweeps of different length
            return cls()
        # From the middle between both sweeps back to the reference time.
        bend = np.full(6, 0.5 * abs(middle) * (seconds + middle))
        back = np.full(6, middle)
        if _turned(first.sweep):
            back[:3] = bend[:3] = 0.0
        own = (back / seconds)[:, None] * covariance * (back / seconds)
        if velocity is not None:
            aside = back * (velocity - first.twist)
            own = own + np.outer(aside, aside)
        return cls(to_map, own, bend)

    def error(self, accelerations: FloatArray) -> FloatArray:
        """(6, 6) in the map, from the (6,) mean squared accelerations."""
        own = self.velocity + np.diag(self.bend**2 * accelerations)
        in_map: FloatArray = self.to_map @ own @ self.to_map.T
        return in_map
