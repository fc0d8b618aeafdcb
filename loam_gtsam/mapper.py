"""The mapper: registers one sweep after another with the cube map.

Within a frame, poses belong to the middle of the sweep (see
:mod:`loam_gtsam.frontend.deskew`); the result is handed out at the reference time of the features.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.registration.frame_matcher import Frame, FrameMatcher, MapPair, rows_to_match
from loam_gtsam.registration.imu_tracker import ImuTracker
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.odometry import ConstantVelocity, Moment, Prediction, predict
from loam_gtsam.registration.pose_errors import PoseErrors
from loam_gtsam.registration.relocalization import (
    Fit,
    FitMonitor,
    Found,
    Lost,
    doubtful,
    rebuild_start,
    search,
)
from loam_gtsam.registration.report import Clock, make_update, status_of
from loam_gtsam.registration.solvers import POSE_KEY, ScanSolver, Solution, make_solver
from loam_gtsam.registration.solvers.own_factors import ExtraFactors, PoseContext, own_factors
from loam_gtsam.registration.stamp_check import StampCheck
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
    config : the whole configuration; ``map``, ``matching``, ``solver``, ``deskew`` and ``imu``
        are used
    solver : anything with :meth:`~loam_gtsam.registration.solvers.ScanSolver.solve`;
        :func:`make_solver` makes it from the configuration if None
    imu : samples may be added to it while the mapper runs
    extra_factors : a user's own factors for every sweep: GPS, ground level, wheels, ...

    Attributes
    ----------
    last : the last update
    registered : the last sweep as it went into the map; None if it did not
    imu : what the mapper makes of the IMU; None without one
    monitor : tells whether sweeps fit the map
    maps : the map of edges and that of planes
    keyframe : to which the points of the frames to come belong, see :meth:`move_map`

    Raises
    ------
    ConfigError
        If the configured solver has no place for the configured use of the IMU, or for factors of
        a user's own.
    """

    def __init__(
        self,
        config: Config | None = None,
        solver: ScanSolver | None = None,
        *,
        imu: ImuBuffer | None = None,
        extra_factors: ExtraFactors | None = None,
    ) -> None:
        self.config = config or Config()
        self.solver = solver or make_solver(self.config.solver)
        _check_factors_have_a_place(self.config, imu, extra_factors, own_solver=solver is not None)
        self.imu = None if imu is None else ImuTracker(self.config.imu, imu)
        self.extra_factors = extra_factors
        self._forget()

    def _forget(self) -> None:
        self.keyframe = 0
        self.last: MapUpdate | None = None
        self.registered: Registered | None = None
        self.monitor = FitMonitor(self.config.relocalization)
        self._errors = PoseErrors(self.config)
        self._stamps = StampCheck()
        self._first: Prediction | None = None
        self._moment: Moment | None = None
        self.maps = MapPair(self.config.map)

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
        guess : predicted ``map_T_lidar`` at ``features.stamp``, where the solve starts; predicted
            from the last motion and the IMU if None, and for the first sweep the origin, levelled
            by the IMU
        twist : (6,) predicted body velocity during the sweep, rad/s and m/s; predicted if None
        priors : further factors on :data:`~loam_gtsam.registration.solvers.POSE_KEY`, the pose at
            the middle of the sweep

        Returns
        -------
        MapUpdate
            Never raises for what a sweep contains: see its ``status``.
        """
        clock = Clock()
        self.registered = None
        refused = self._check(features)
        if refused is not None:
            return refused
        if self.last is None and self.imu is not None:
            guess = self.imu.first_pose(features.stamp, guess)
        gyro = None if self.imu is None else self.imu.trusted_gyro
        sweep = MovingSweep(features, self.config, gyro)
        before = self.last, self._moment, self.imu
        predicted = predict(sweep, *before, self.config.solver, guess, twist)
        try:
            self.maps.recenter(predicted.map_T_middle)
        except InputError as error:
            return self._unused(features.stamp, str(error), None)
        clock.lap("prepare")
        if self.last is None:
            self._first = predicted if self.config.deskew.refine else None
            update = self._insert(predicted, FrameStatus.FIRST, "the map starts here", clock)
        elif sparse := self._too_sparse(predicted):
            self._first = None
            update = self._insert(predicted, FrameStatus.SPARSE_MAP, sparse, clock)
        else:
            frame = self._frame(predicted, priors, clock)
            solution = frame.solve(self.solver)
            clock.lap("solve")
            outcome: Found | Lost = Found(solution, frame.twist_to(solution.map_T_lidar))
            if doubtful(frame, solution, self.monitor, self.last.twist):
                outcome = search(frame, solution, self.monitor, self.solver)
            if isinstance(outcome, Lost) or not outcome.solution.solved:
                update = self._without_pose(frame, predicted, solution, outcome)
            else:
                if self._first is not None:
                    first, self._first = self._first, None
                    frame, outcome = rebuild_start(first, frame, outcome, self.solver)
                update = self._with_pose(frame, outcome, clock)
        self.last = replace(update, timings=clock.seconds)
        return self.last

    def skip(
        self, stamp: int, message: str, fault: SweepFault | None = SweepFault.UNREADABLE
    ) -> MapUpdate:
        """Account for a sweep that cannot be used: the pose is predicted, the map unchanged.

        Parameters
        ----------
        stamp : nanoseconds
        message, fault : why

        Returns
        -------
        MapUpdate
            With status ``UNUSABLE_SCAN``, or ``BAD_STAMP`` if the stamp cannot be used either.
        """
        self.registered = None
        return self._refused(stamp) or self._unused(stamp, message, fault)

    def map_points(
        self, moves: Mapping[int, FloatArray] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Edge and plane points of the whole map, archive included, (E, 3) and (P, 3), metres.

        Parameters
        ----------
        moves : what :meth:`move_map` would do to the points first; the map does not change
        """
        if moves:
            return self.edge_map.moved_points(moves), self.plane_map.moved_points(moves)
        return self.edge_map.points(archived=True), self.plane_map.points(archived=True)

    @property
    def edge_map(self) -> CubeMap:
        """The map of edges."""
        return self.maps.edges

    @property
    def plane_map(self) -> CubeMap:
        """The map of planes."""
        return self.maps.planes

    def move_map(self, moves: Mapping[int, FloatArray]) -> int:
        """Move map points with the keyframes they belong to, after a loop closure.

        The mapper's own pose stays; keep the newest keyframes where they are.

        Parameters
        ----------
        moves : (4, 4) rigid transforms in the frame of the map, by keyframe

        Returns
        -------
        Points moved.
        """
        return sum(cubes.move(moves) for cubes in (self.edge_map, self.plane_map))

    # -- the steps of a frame ----------------------------------------------------------------

    def _check(self, features: Features) -> MapUpdate | None:
        """The update of a sweep that cannot be used; None if it can."""
        refused = self._refused(features.stamp)
        if refused is not None:
            return refused
        points = features.edges, features.planes, features.edge_times, features.plane_times
        if not all(np.isfinite(part).all() for part in points):
            message = "features of the sweep are NaN or infinite"
            return self._unused(features.stamp, message, SweepFault.NOT_FINITE)
        if not len(features.edges) + len(features.planes):
            message = "the sweep has no features"
            return self._unused(features.stamp, message, SweepFault.NO_FEATURES)
        return None

    def _refused(self, stamp: int) -> MapUpdate | None:
        """The update of a sweep whose stamp cannot be used; None if it can."""
        last = self.last
        refusal = None if last is None else self._stamps.refuse(stamp, last.stamp)
        if last is None or refusal is None:
            return None
        if refusal.clock_step:
            self.last = replace(last, stamp=last.stamp + refusal.clock_step)
            if self._moment is not None:
                self._moment = self._moment._replace(stamp=self._moment.stamp + refusal.clock_step)
            self._errors.cut()
        return MapUpdate(
            stamp,
            last.map_T_lidar,
            FrameStatus.BAD_STAMP,
            refusal.message,
            twist=last.twist,
            fault=refusal.fault,
        )

    def _unused(self, stamp: int, message: str, fault: SweepFault | None) -> MapUpdate:
        """The update of a sweep that says nothing: the pose is predicted."""
        last, status = self.last, FrameStatus.UNUSABLE_SCAN
        if last is None:
            return MapUpdate(stamp, gtsam.Pose3(), status, message, fault=fault)
        guess = ConstantVelocity(self.imu).at(stamp, last)
        self.last = MapUpdate(
            stamp, guess.map_T_lidar, status, message, twist=guess.twist, fault=fault
        )
        return self.last

    def _too_sparse(self, predicted: Prediction) -> str:
        """Why there is too little map around to solve in; empty if there is enough."""
        edges, planes = self.maps.counts_around(predicted.map_T_middle)
        config = self.config.solver
        enough = edges >= config.min_map_edges and planes >= config.min_map_planes
        if enough or self.monitor.lost:
            return ""
        return (
            f"the local map has {edges} edge and {planes} plane points; at least "
            f"{config.min_map_edges} and {config.min_map_planes} are needed"
        )

    def _frame(
        self, predicted: Prediction, priors: Sequence[gtsam.NonlinearFactor], clock: Clock
    ) -> Frame:
        """What the solve starts from."""
        sweep, middle = predicted.posed.sweep, predicted.map_T_middle
        factors = [*priors]
        if self.imu is not None:
            factors += self.imu.factors(sweep.stamp)
        if self.extra_factors is not None and self._moment is not None:
            context = PoseContext(POSE_KEY, sweep.stamp, middle, self._moment[:2])
            factors += own_factors(self.extra_factors, context)
        matching, refine = self.config.matching, self.config.deskew.refine and self._first is None
        matcher = FrameMatcher(
            predicted.posed,
            self.maps,
            self.config,
            matching,
            rows_to_match(sweep, matching),
            self._moment,
            refine,
            clock,
        )
        return Frame(matcher, middle, factors, predicted.motion)

    def _without_pose(
        self, frame: Frame, predicted: Prediction, solution: Solution, outcome: Found | Lost
    ) -> MapUpdate:
        """The update of a sweep that is lost, or that matches too little: the map is unchanged."""
        self._moment = Moment(frame.sweep.stamp, frame.middle, False)
        posed, pose = predicted.posed, predicted.map_T_lidar
        if isinstance(outcome, Lost):
            self.monitor.lost += 1
            nothing = Solution.unsolved(frame.middle, solution.matches, solution.iterations, 0)
            return make_update(posed, pose, FrameStatus.LOST, outcome.message, nothing)
        # Once may be chance; a sweep that has plenty to match is searched for the next time.
        least, found = self.config.solver.min_matches, outcome.solution
        self.monitor.lost += frame.matcher.offered >= 2 * least
        message = f"{len(found.matches)} matches; {least} are needed"
        return make_update(posed, pose, FrameStatus.FEW_MATCHES, message, found)

    def _with_pose(self, frame: Frame, found: Found, clock: Clock) -> MapUpdate:
        """The update of a sweep that was found: it goes into the map."""
        solution = found.solution
        if not solution.matches.wide:
            fit = Fit.of(solution.matches, frame.matcher.offered)
            self.monitor.accept(fit, solution.map_T_lidar)
        posed, tilt = frame.sweep.at(found.twist), TiltPrior.NONE
        if self.imu is None:
            pose = solution.map_T_lidar.compose(posed.middle_T_reference)
        else:
            solution, pose, tilt = self.imu.add_scan(posed, frame.matcher.last, solution)
        status, message = status_of(solution, found.message)
        result = Prediction(posed, pose, posed.map_T_middle(pose), frame.expected)
        update = self._insert(result, status, message, clock, solution, tilt)
        update = self._errors.calibrated(update, frame.sweep, solution)
        clock.lap("covariance")
        return update

    def _insert(
        self,
        result: Prediction,
        status: FrameStatus,
        message: str,
        clock: Clock,
        solution: Solution | None = None,
        tilt: TiltPrior = TiltPrior.NONE,
    ) -> MapUpdate:
        """Add the sweep to the map; its update."""
        clock.lap("solve")
        posed, middle = result.posed, result.map_T_middle
        solved = solution is not None or status is FrameStatus.FIRST
        self.maps.insert(posed, middle, self.keyframe)
        self._moment = Moment(posed.sweep.stamp, middle, solved)
        matches = None if solution is None else solution.matches
        self.registered = Registered(*posed.points, middle, matches)
        clock.lap("insert")
        return make_update(posed, result.map_T_lidar, status, message, solution, tilt)


def _check_factors_have_a_place(
    config: Config, imu: ImuBuffer | None, extra: ExtraFactors | None, *, own_solver: bool
) -> None:
    """ConfigError if a classical solver is to be given factors."""
    method, prior = config.solver.method, config.imu.prior
    if own_solver or method == "gtsam":
        return
    if imu is not None and prior in ("equivalent", "sigma"):
        raise ConfigError(
            f"imu.prior: {prior} is a factor, and solver.method {method} has no graph to put "
            "it in; use imu.prior blend or off, or solver.method gtsam"
        )
    if extra is not None:
        raise ConfigError(
            f"extra_factors: solver.method {method} has no graph to put them in; use "
            "solver.method gtsam"
        )
