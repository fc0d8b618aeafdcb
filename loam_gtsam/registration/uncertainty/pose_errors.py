"""How wrong a pose may be: covariances of poses in the map, and of the motion between two poses.

Unlike in the inverse of the information, the scatter is that of the residuals, matches close
together count as one, and two errors are added: docs/maths/covariance.md.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.geometry import symmetric, transform
from loam_gtsam.imu.coupling import OtherPose
from loam_gtsam.imu.preintegration import Fused
from loam_gtsam.registration.acceleration import Accelerations, Expected
from loam_gtsam.registration.degeneracy import tells_motion
from loam_gtsam.registration.odometry import Moment, Prediction, Turns
from loam_gtsam.registration.relocalization import Gap, same, spread_in_map
from loam_gtsam.registration.solvers import MotionPrior, Solution
from loam_gtsam.registration.solvers.gtsam_solver import match_rows
from loam_gtsam.registration.solvers.scan_error import GyroNoise, ScanError, scan_error
from loam_gtsam.registration.solvers.seen_ground import SeenGround, facings
from loam_gtsam.registration.solvers.sweep_velocity import ToldVelocity, row_seconds, timed_rows
from loam_gtsam.registration.uncertainty.beam_errors import BeamErrors
from loam_gtsam.registration.uncertainty.frame_errors import FrameErrors
from loam_gtsam.registration.uncertainty.map_error import MapError
from loam_gtsam.registration.uncertainty.range_offset import RangeOffset
from loam_gtsam.types import (
    FloatArray,
    FrameStatus,
    InputError,
    MapUpdate,
    SweepMotion,
    Uncertainty,
    check_kind,
)


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
    both = ("earlier", earlier), ("later", later)
    for name, update in both:
        check_kind(update, MapUpdate, name, "the updates of a run are such")
    begins = earlier.status is FrameStatus.FIRST
    for name, update in both:
        if update.uncertainty is None and not (begins and update is earlier):
            raise InputError(
                f"{name}: expected a frame that was solved, got one with status {update.status}; "
                "choose another one"
            )
    if later.stamp <= earlier.stamp:
        how = "swap the two" if later.stamp < earlier.stamp else "give two frames"
        raise InputError(f"later: expected a stamp after {earlier.stamp}, got {later.stamp}; {how}")
    if begins:
        return later.covariance.copy()
    first, second = earlier.uncertainty, later.uncertainty
    assert first is not None
    assert second is not None
    to_later = later.map_T_lidar.between(earlier.map_T_lidar).AdjointMap()
    from_map = later.map_T_lidar.inverse().AdjointMap()
    covariance = second.own + to_later @ first.own @ to_later.T
    # The errors of velocity and ranges were the same in both, but for what was forgotten since.
    blind = second.blind - first.blind * np.exp(first.forgotten - second.forgotten)
    covariance += from_map @ (second.drift - first.drift + blind @ blind.T) @ from_map.T
    if second.follows == earlier.stamp:
        common = second.shared @ to_later.T
        covariance -= common + common.T
    return symmetric(covariance)


class PoseErrors:
    """Calibrates the covariances of a run, frame by frame.

    Of ``config``, ``covariance``, ``solver``, ``deskew.model``, ``sensor.beams`` and parts of
    ``imu`` are used.

    Attributes
    ----------
    beam_errors : by how much the points of each beam look off
    """

    def __init__(self, config: Config) -> None:
        self._places = config.covariance, config.of_small_places().covariance
        self._seen = SeenGround()
        self._small, self._scans = False, 0  # scans that :meth:`of_scan` was given
        self._kernel, graph = config.solver.kernel, config.solver.method == "gtsam"
        self._kernel_width = config.solver.kernel_width if graph else np.inf
        # Rows of the classical solvers count as measured to 1 m; they have no priors to find.
        self._with_priors = graph
        expected = [config.solver.turn_sigma, config.solver.acceleration_sigma]
        self._motion = Accelerations(config.covariance.window, np.repeat(expected, 3) ** 2)
        self._config, self._gyro_noise = config, config.imu.gyro_noise
        self._map, self._frames = MapError(config), FrameErrors(self._gyro_noise)
        self.beam_errors = BeamErrors(config)
        self._found: MapUpdate | None = None  # the last update of a sweep that was found

    @property
    def accelerations(self) -> Expected | None:
        """What the poses so far tell of the next acceleration; None at first."""
        return self._motion.next

    @property
    def range_offset(self) -> RangeOffset:
        """By how much all ranges look too long."""
        return self._map.offset

    @property
    def gap(self) -> Gap | None:
        """The time since the last sweep that was found; None before the first."""
        return None if self._found is None else Gap.since(self._found, self._motion.variances)

    def begin_after(self, before: PoseErrors, uncertain: FloatArray) -> None:
        """Begin another map, so uncertain, (6, 6) on the left, beside what ``before`` holds."""
        self._map.begin_after(before._map, before._motion.at_first, uncertain)

    def expected(self, stamp: int, last: Moment | None, imu: Turns | None) -> gtsam.Pose3 | None:
        """As :meth:`MapError.expected`."""
        return self._map.expected(stamp, last, imu)

    def of_scan(
        self, solution: Solution, sweep: MovingSweep, between: MotionPrior | None = None,
        *, small: bool = False,
    ) -> ScanError | None:  # fmt: skip
        """The error of a solved sweep; to be called once for each, in order.

        ``between`` is what a user's factors between the last pose and this one tell; ``small``
        tells whether the place is small.
        """
        self._scans += 1
        config, seen = self._places[small], self._seen
        if small != self._small and self._scans > 1:
            # The ground is the same as that of the last scan, only in other cells.
            rows, lines = match_rows(solution.matches), 2 * len(solution.matches.edges)
            points = transform(solution.map_T_lidar.matrix(), rows.points)
            facing, last = facings(rows.normals, lines), max(seen.scans - 1, 0)
            seen.cells(points, facing, config.ground_cell, new=last)
        self._small, by_gyro = small, sweep.motion is SweepMotion.GYRO
        error = scan_error(
            solution, self._kernel_width, seen, config, kernel=self._kernel,
            with_priors=self._with_priors, seconds=row_seconds(solution.matches, sweep),
            between=between,
            gyro=GyroNoise(self._gyro_noise, -sweep.middle) if by_gyro else None,
        )  # fmt: skip
        return error and replace(error, told=self._told(solution, sweep))

    def _told(self, solution: Solution, sweep: MovingSweep) -> ToldVelocity | None:
        """What the matches have told of the velocity in the middle; None if they had no say."""
        last, seen, config = self._frames.last, solution.localizability, self._config
        had_a_say = sweep.acceleration is not None and seen and tells_motion(seen, config.solver)
        if last is None or sweep.stamp <= last[0] or not had_a_say:
            return None
        rows, seconds = timed_rows(solution.matches, sweep, config.solver)
        span = max((sweep.stamp - last[0]) * 1e-9, sweep.duration)
        tilts, noise = solution.matches.tilts, config.features.range_noise
        return ToldVelocity.of(
            rows, tilts, seconds, solution.map_T_lidar, noise, span, with_jerk=True
        )

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
        turned: FloatArray | None = None,
    ) -> MapUpdate:
        """The update of a solved frame with its covariance; to be called after :meth:`of_scan`.

        The sweep has the motion of the solution, which is at its middle; ``last`` is the middle of
        the last sweep, None if the sweep did not get here from there; ``fused`` is the pose by scan
        and IMU together; ``doubt`` is a further covariance (6, 6) of the pose, map frame, until the
        start of the run is over, and None from then on; ``parting`` is the mean square (6, 6) of a
        velocity at which the pose may go on elsewhere, rad/s and m/s, told with these; ``turned``
        is what a gyro has turned more than the scans, (3,) rad/s.
        """
        self._found = update
        if scan is None:
            self._frames.cut()
            return update
        middle = solution.map_T_lidar
        by_imu = fused if solution.weak is None else None
        known = scan.covariance if by_imu is None else by_imu.covariance[:6, :6]
        settled = None if by_imu is None else known
        self._map.add_scan(self._scans, sweep, solution, scan, last, settled)
        if fused is not None:
            self._map.set_velocity(middle.rotation().unrotate(fused.velocity))
        self._add_acceleration(sweep, middle, known, last)
        frame = self._frames.of(update, sweep, middle, scan, self._motion, by_imu, turned)
        if self._scans == 1:
            self._map.set_origin(sweep, scan, middle, update.twist)
        self._map.add_rivals(sweep.stamp, doubt, parting)
        if last is not None and doubt is None:
            self.beam_errors.add(sweep, solution, scan)
        # A pose that own factors tell shares less of the map's error.
        from_map = frame.to_reference @ (np.eye(6) - scan.user) @ middle.inverse().AdjointMap()
        covariance = frame.covariance + from_map @ self._map.doubt @ from_map.T
        blind, forgotten = self._map.blind
        uncertainty = Uncertainty(
            own=covariance,
            shared=frame.shared,
            follows=frame.follows,
            drift=self._map.drift,
            blind=blind,
            forgotten=forgotten,
            residual_variance=scan.residual_variance,
            effective_matches=scan.effective_matches,
            in_doubt=bool(self._map.doubt.any()),
        )
        total = self._map.total(self._motion.at_first)
        covariance = symmetric(covariance + from_map @ total @ from_map.T)
        return replace(update, covariance=covariance, uncertainty=uncertainty)

    def _add_acceleration(
        self, sweep: MovingSweep, middle: gtsam.Pose3, known: FloatArray, last: Moment | None
    ) -> None:
        """What the pose of a sweep, of covariance ``known`` (6, 6), tells of the acceleration."""
        before = self._frames.last
        if self._scans == 1 and last is not None:
            before = last.stamp, last.map_T_lidar
        # A pose in doubt tells no acceleration; that of the very first sweep does.
        if before is not None and not self._map.doubt.any() and sweep.stamp > before[0]:
            self._motion.add(*before, sweep.stamp, middle, known)

    def jumped(
        self, expected: Prediction, posed: PosedSweep, pose: gtsam.Pose3, *, unlike: bool,
        searched: float = 0.0,
    ) -> None:  # fmt: skip
        """Account for a pose elsewhere than the motion had led to expect the middle of a sweep.

        If no usual acceleration leads there, it may only look alike. An IMU to which it is
        ``unlike`` knew better; a user's guess that led away from it did not. A sweep that is
        ``posed`` with the expected motion was hardly taken in that. One to which no acceleration
        leads, and that fits unusually little, may be farther off than it was ``searched``, metres.
        """
        before, now = expected.map_T_middle, expected.posed.sweep.stamp
        step, gap = before.localCoordinates(pose), self.gap
        usual = same(before, pose) or self._motion.explains(step, now)
        if unlike or searched > 0.0 or not usual:
            missed, inertial = np.zeros((6, 6)), None if unlike else expected.inertial
            if inertial is not None:
                missed = inertial.covariance_in_map
            elif gap is not None:
                near = spread_in_map(pose, np.repeat([0.0, searched], 3))
                missed = gap.bridged(now, posed.twist)[1] + near
                if expected.inertial is None:
                    steady = gap.steady(now).localCoordinates(pose)
                    step = min(step, steady, key=lambda way: float(np.linalg.norm(way[3:])))
            self._map.add_jump(pose, step, missed)
        elif np.array_equal(posed.twist, expected.posed.twist):
            self._frames.stray(step)

    def disputed(self, pose: gtsam.Pose3, other: OtherPose | None) -> None:
        """Account for another pose to which an IMU alone leads; None if there is none."""
        if other is None:
            return
        to_map = other.map_T_lidar.AdjointMap()
        step = pose.localCoordinates(other.map_T_lidar)
        self._map.add_dispute(pose, step, to_map @ other.covariance @ to_map.T, other.since)

    def moved(self, step: gtsam.Pose3) -> None:
        """As :meth:`MapError.add_move`."""
        self._map.add_move(step)

    def skipped(self, posed: PosedSweep, motion: MotionPrior | None = None) -> None:
        """Account for a sweep whose pose is the expected one; the very first begins the map.

        ``motion`` is what led to that pose, if the sweep went into the map.
        """
        if motion is not None:
            self._map.add_expected(motion)
        if not self._scans:
            self._map.begin(posed)

    def cut(self, ahead: int) -> None:
        """Start anew in time: the next frame is on a clock that was set ahead, nanoseconds."""
        self._frames.cut(paused=True)
        self._map.cut(ahead)
