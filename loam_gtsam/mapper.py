"""The mapper: registers one sweep after another with the cube map.

Within a frame, poses belong to the middle of the sweep (see
:mod:`loam_gtsam.frontend.deskew`); the result is handed out at the reference time of the features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam

from loam_gtsam.config import Config, SolverConfig, as_config
from loam_gtsam.errors import check_kind, check_part, own_code
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.frontend.stamp_check import StampCheck
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.io.rollback import whole
from loam_gtsam.registration.frame_matcher import Frame, FrameMatcher, MapPair
from loam_gtsam.registration.imu_tracker import ImuTracker, with_imu
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.odometry import ConstantVelocity, Moment, Prediction, predict
from loam_gtsam.registration.point_times import PointTimes
from loam_gtsam.registration.relocalization import (
    FitMonitor,
    Found,
    NextPiece,
    accept,
    goes_on,
    placed,
    unplaced,
)
from loam_gtsam.registration.report import Clock, checksum, make_update, problem_of, status_of
from loam_gtsam.registration.solvers import (
    POSE_KEY,
    MotionPrior,
    ScanSolver,
    Solution,
    make_solver,
)
from loam_gtsam.registration.solvers.own_factors import (
    ExtraFactors,
    NamedSolver,
    OwnFactors,
    PoseContext,
    own_factors,
    own_priors,
)
from loam_gtsam.registration.solvers.scan_error import ScanError
from loam_gtsam.registration.start import Start
from loam_gtsam.registration.uncertainty import PoseErrors
from loam_gtsam.types import (
    ConfigError,
    Features,
    FloatArray,
    FrameStatus,
    InputError,
    MapUpdate,
    SweepFault,
    TiltPrior,
)


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """A sweep as it went into the map, to be looked at.

    Attributes
    ----------
    edges, planes : (E, 3) and (P, 3) metres, de-skewed, seen from the middle of the sweep
    map_T_middle : pose of that moment
    matches : that the pose was solved with; None if it was not solved
    """

    edges: FloatArray
    planes: FloatArray
    map_T_middle: gtsam.Pose3
    matches: ScanMatches | None


class Mapper:
    """LOAM's mapping stage.

    Parameters
    ----------
    config : sections on odometry, loops and files are not used, nor how features are found
    solver : anything with :meth:`~loam_gtsam.registration.solvers.ScanSolver.solve`; its settings,
        ``solver.config``, replace ``config.solver``. If None, :func:`make_solver` makes it
    imu : samples may be added to it while the mapper runs
    extra_factors : a user's own factors for every sweep: GPS, ground level, wheels, ...

    Attributes
    ----------
    last, registered : the last update, and its sweep as it went into the map; None if it did not
    imu : what the mapper makes of the IMU; None without one
    monitor : tells whether sweeps fit the map
    errors, point_times : calibrate the covariances, and ask whether points move as the lidar does
    maps, start : the maps of edges and planes, and their first sweeps; None once all are there

    Raises
    ------
    InputError, ConfigError
        If a part is none, the IMU was made for other settings, or the solver takes no factors.
    """

    def __init__(
        self, config: Config | None = None, solver: ScanSolver | None = None, *,
        imu: ImuBuffer | None = None, extra_factors: ExtraFactors | None = None,
    ) -> None:  # fmt: skip
        self.config = _with_settings_of(solver, as_config(config))
        self.solver = make_solver(self.config.solver) if solver is None else solver
        imu = None if self.config.imu.coupling == "off" else imu
        _check_parts(self.config, solver, imu, extra_factors)
        self.imu = None if imu is None else ImuTracker(self.config.imu, imu)
        self.extra_factors = extra_factors
        self._forget()

    def _forget(self) -> None:
        self.maps = MapPair(self.config)
        self.last: MapUpdate | None = None
        self.registered: Registered | None = None
        self.monitor, self.errors = FitMonitor(self.config.relocalization), PoseErrors(self.config)
        self._stamps, self.point_times = StampCheck(), PointTimes(self.config)
        self.start: Start | None = None
        self._moment: Moment | None = None
        self._next: NextPiece | None = None
        self._seen: int | None = None  # checksum of the last sweep

    def __getstate__(self) -> dict[str, Any]:
        # For checkpoints: no frame depends on what is only there to be looked at.
        return vars(self) | {"registered": None}

    def reset(self) -> None:
        """Forget the map and what was learnt of the IMU: the next sweep is the first of a new map.

        A pipeline has more to forget: use :meth:`loam_gtsam.Pipeline.reset` there.
        """
        if self.imu is not None:
            self.imu.reset()
        self._forget()

    @whole
    def register(
        self,
        features: Features,
        guess: gtsam.Pose3 | None = None,
        twist: FloatArray | None = None,
        priors: Sequence[gtsam.NonlinearFactor] = (),
    ) -> MapUpdate:
        """Find the pose of a sweep and add the sweep to the map.

        Parameters
        ----------
        features : of the sweep
        guess : ``map_T_lidar`` at ``features.stamp``, where the solve starts; if None, predicted by
            the last motion and the IMU, and for the first sweep the origin, levelled by the IMU
        twist : (6,) predicted body velocity during the sweep, rad/s and m/s; predicted if None
        priors : further factors on :data:`~loam_gtsam.registration.solvers.POSE_KEY`, the pose at
            the middle of the sweep; what they raise is a PartError like that of ``extra_factors``

        Returns
        -------
        MapUpdate
            Never raises for what a sweep contains: see its ``status``. What a part of a user's own
            raises is a PartError, and the mapper is as before the call.
        """
        clock, self.registered = Clock(), None
        if (refused := self._check(features)) is not None:
            return refused
        if self.last is None and self.imu is not None:
            guess = self.imu.first_pose(features.stamp, guess)
        sweep = MovingSweep(features, self.config, self.imu.trusted_gyro if self.imu else None)
        last, imu = self._moment, self.imu
        expected = self.errors.expected(sweep.stamp, last, imu) if guess is None else None
        predicted = predict(sweep, self.last, last, imu, self.config.solver, guess, twist, expected)
        try:
            self.maps.recenter(predicted.map_T_middle, features.reach)
        except InputError as error:
            return self._unused(features.stamp, str(error), None)
        clock.lap("prepare")
        expected_at = predicted.posed, predicted.map_T_lidar
        can_go_on = goes_on(self, features)
        if self.last is None:
            self.start = Start.of_map(predicted, self.maps)
            update = self._insert(*expected_at, FrameStatus.FIRST, "the map starts here", clock)
        elif not (can_go_on or self.monitor.lost) and (sparse := self.maps.too_sparse(predicted)):
            self.start = None
            update = self._insert(*expected_at, FrameStatus.SPARSE_MAP, sparse, clock)
        else:
            with own_priors(priors, predicted.map_T_middle) as factors:
                frame = self._frame(predicted, factors, clock)
                apart = features, self.config, self.last, self._named
                first = None if self.start is None else self.start.first_motion
                frame, outcome = placed(frame, apart, self.monitor, self.imu, first)
                clock.lap("solve")
                if isinstance(outcome, Found) and outcome.solution.solved:
                    update = self._with_pose(frame, outcome, clock)
                else:
                    self._moment = Moment(frame.sweep.stamp, frame.predicted.map_T_middle, False)
                    update = unplaced(frame, outcome, self.monitor)
                    few = update.status is FrameStatus.FEW_MATCHES
                    if few and self.config.map.insert_unmatched:
                        self.start = None
                        self._insert(*expected_at, update.status, update.message, clock)
                    elif self.monitor.lost and can_go_on:
                        self._next = self._next or NextPiece(self.errors.gap)
                        if found := self._next.add(self, features, predicted):
                            update = found
                            self._go_on(self._next.mapper)
                        clock.lap("relocalize")
        if not update.status.solved:
            self.errors.skipped(predicted.posed, predicted.motion if self.registered else None)
        self.last = replace(update, timings=clock.seconds)
        return self.last

    def skip(
        self, stamp: int, message: str, fault: SweepFault | None = SweepFault.UNREADABLE
    ) -> MapUpdate:
        """Account for a sweep that cannot be used, for a reason: the pose is predicted.

        The status is ``UNUSABLE_SCAN``, or ``BAD_STAMP`` if the stamp cannot be used either.
        """
        self.registered = None
        return self._refused(stamp) or self._unused(stamp, message, fault)

    def map_points(self) -> tuple[FloatArray, FloatArray]:
        """Edge and plane points of the whole map, archive included, (E, 3) and (P, 3), metres."""
        return self.maps.points()

    _named = property(lambda self: NamedSolver(self.solver, self.extra_factors))

    def _check(self, features: Features) -> MapUpdate | None:
        """The update of a sweep that cannot be used; None if it can."""
        check_kind(features, Features, "features", "extract_features makes them of a Scan")
        before, self._seen = self._seen, checksum(features)
        problem = problem_of(features, self.last if self._seen == before else None)
        refused = self._refused(features.stamp, features.span[1] - features.span[0])
        return refused or (problem and self._unused(features.stamp, *problem))

    def _refused(self, stamp: int, seconds: float = 0.0) -> MapUpdate | None:
        """The update of a sweep whose stamp cannot be used; None if it can."""
        last = self.last
        refusal = None if last is None else self._stamps.refuse(stamp, last.stamp, seconds)
        if last is None or refusal is None:
            return None
        if refusal.clock_step:
            self.last = replace(last, stamp=last.stamp + refusal.clock_step)
            self._moment = self._moment and self._moment.later(refusal.clock_step)
            self.start, self._next = self.start and self.start.later(refusal.clock_step), None
            self.errors.cut(refusal.clock_step)
        bad, message, fault = FrameStatus.BAD_STAMP, refusal.message, refusal.fault
        return MapUpdate(stamp, last.map_T_lidar, bad, message, twist=last.twist, fault=fault)

    def _unused(self, stamp: int, message: str, fault: SweepFault | None) -> MapUpdate:
        """The update of a sweep that says nothing: the pose is predicted."""
        guess, bad = ConstantVelocity(self.imu).at(stamp, self.last), FrameStatus.UNUSABLE_SCAN
        update = MapUpdate(stamp, guess.map_T_lidar, bad, message, twist=guess.twist, fault=fault)
        self.last = None if self.last is None else update
        return update

    def _frame(
        self, predicted: Prediction, priors: Sequence[gtsam.NonlinearFactor], clock: Clock
    ) -> Frame:
        """What the solve starts from: matches, the caller's factors, the IMU's and the user's."""
        stamp, last = predicted.posed.sweep.stamp, self._moment
        predicted, own = _beside_own(
            predicted, priors, self.extra_factors, last, self.config.solver
        )
        factors = [*priors, *(self.imu.factors(stamp) if self.imu else ()), *own.alone]
        matcher = FrameMatcher.of(
            predicted.posed, self.maps, self.maps.config, last, clock, expected=self.start is None,
            inertial=predicted.inertial, accelerations=self.errors.accelerations,
        )  # fmt: skip
        return Frame(matcher, predicted, factors, own.since_last)

    def _with_pose(self, frame: Frame, found: Found, clock: Clock) -> MapUpdate:
        """The update of a sweep that was found: it goes into the map."""
        if self.start is not None:
            frame, found = self.start.add(frame, found, self.maps.keyframe, self._named, self.imu)
            self.start = None if self.start.complete else self.start
        solution, posed, last = found.solution, found.posed, frame.matcher.last
        accept(frame, found, self.monitor)
        between = self._named.told(frame.since_last, solution.map_T_lidar)
        scan = self.errors.of_scan(solution, posed.sweep, between, small=self.maps.small)
        with own_code("extra_factors", self.extra_factors):
            posed, solution, pose, tilt, fused, unlike, said, more, other = with_imu(
                self.imu, posed, last, solution, scan, frame.priors, found.beside_imu
            )
        if found.message or found.in_vain or unlike:
            self.errors.jumped(
                frame.predicted, posed, solution.map_T_lidar, unlike=unlike, searched=found.searched
            )
        self.errors.disputed(solution.map_T_lidar, other)
        if self.start is None and not found.message:
            self.point_times.add(posed, solution)
        status, message = status_of(solution, found.saying(self.point_times.problem or said))
        update = self._insert(posed, pose, status, message, clock, solution, tilt, scan)
        last = None if found.message else last
        update = self.errors.calibrated(
            update, posed.sweep, solution, scan, last, fused, found.doubt, found.parting, more
        )
        clock.lap("covariance")
        self._next = None
        return update

    def _go_on(self, piece: Mapper) -> None:
        """Go on in another piece of map."""
        piece.maps.begin_after(self.maps)
        self.maps, self.start, self.monitor = piece.maps, piece.start, piece.monitor
        self.errors, self.registered, self._moment = piece.errors, piece.registered, piece._moment
        self._next = None
        if self.imu and piece.imu:
            self.imu.learn_from(piece.imu)

    def _insert(
        self, posed: PosedSweep, map_T_lidar: gtsam.Pose3, status: FrameStatus, message: str,
        clock: Clock, solution: Solution | None = None, tilt: TiltPrior = TiltPrior.NONE,
        scan: ScanError | None = None,
    ) -> MapUpdate:  # fmt: skip
        """Add the sweep to the map; its update."""
        clock.lap("solve")
        middle = posed.map_T_middle(map_T_lidar)
        matches = None if solution is None else solution.matches
        self.maps.insert(posed, middle, self.maps.keyframe, matches)
        known = status.solved or status is FrameStatus.FIRST
        error = None if scan is None or solution is None else scan.seen(solution.weak)
        self._moment = Moment(posed.sweep.stamp, middle, known, error)
        self.registered = Registered(*posed.points, middle, matches)
        clock.lap("insert")
        return make_update(posed, map_T_lidar, status, message, solution, tilt)


def _beside_own(
    predicted: Prediction, priors: Sequence[gtsam.NonlinearFactor], extra: ExtraFactors | None,
    last: Moment | None, config: SolverConfig,
) -> tuple[Prediction, OwnFactors]:  # fmt: skip
    """The prediction beside a user's factors, and those that ``extra`` gives; no more if none."""
    own, stamp = OwnFactors(), predicted.posed.sweep.stamp
    if last is None:
        return predicted, own
    if extra is not None:
        context = PoseContext(POSE_KEY, stamp, predicted.map_T_middle, last[:2])
        own = own_factors(extra, context, last.error)
    with own_code("extra_factors", extra):
        others = MotionPrior.of_factors(
            [*priors, *own.alone, *own.since_last], predicted.map_T_middle
        )
    if others is not None:
        motion = predicted.motion.beside(others, last.seconds_to(stamp), config)
        predicted = replace(predicted, motion=motion)
    return predicted, own


def _with_settings_of(solver: ScanSolver | None, config: Config) -> Config:
    """The configuration with the settings that a solver brings, by which its results are judged.

    A classical solver has no graph for the IMU's tilt: the blend does the same to the pose
    (docs/maths/imu_prior.md).
    """
    settings = getattr(solver, "config", None)
    if isinstance(settings, SolverConfig):
        return config.changed(solver=settings)
    classical = solver is None and config.solver.method != "gtsam"
    blended = classical and config.imu.coupling != "off" and config.imu.prior == "equivalent"
    return config.changed("imu.prior=blend") if blended else config


def _check_parts(
    config: Config, solver: ScanSolver | None, imu: ImuBuffer | None, extra: ExtraFactors | None
) -> None:
    """InputError for a part that is none; ConfigError if a classical solver is to get factors."""
    check_part(solver, "solver", "a solver, as make_solver(config.solver)", "solve")
    check_part(extra, "extra_factors", "a function", "__call__")
    method = config.solver.method
    if solver is not None or method == "gtsam":
        return
    if imu is not None and config.imu.prior == "sigma":
        raise ConfigError(
            f"imu.prior: sigma is a factor, and solver.method {method} has no graph to put "
            "it in; use imu.prior blend or off, or solver.method gtsam"
        )
    if extra is not None:
        raise ConfigError(
            f"extra_factors: solver.method {method} has no graph to put them in; use "
            "solver.method gtsam"
        )
