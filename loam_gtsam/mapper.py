"""The mapper: registers one sweep after another with the cube map.

Within a frame, poses belong to the middle of the sweep (see
:mod:`loam_gtsam.frontend.deskew`); the result is handed out at the reference time of the features.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.config import Config, MatchingConfig, SolverConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.geometry import transform
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.registration.association import (
    ScanMatches,
    at_rows,
    chosen_rows,
    match_features,
    moved,
    renew,
    trial,
)
from loam_gtsam.registration.classical import ALoamSolver, ClassicalSolver
from loam_gtsam.registration.imu_tracker import ImuTracker
from loam_gtsam.registration.odometry import ConstantVelocity, Guess, advance
from loam_gtsam.registration.pose_errors import PoseErrors
from loam_gtsam.registration.relocalization import Fit, Watch, places, some
from loam_gtsam.registration.report import Clock, named, report, way
from loam_gtsam.registration.solvers import (
    POSE_KEY,
    Associate,
    GtsamSolver,
    MotionPrior,
    ScanSolver,
    Solution,
)
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

_START_ROUNDS = 2
"""Times the first two sweeps are registered anew while their motion becomes known."""
_PLACES = 6
"""Places tried at most when a sweep does not fit where it was solved."""
_CLEARLY = 1.02
"""By how much another motion within a sweep must fit better than the one before."""
_SHORTEST = 1e-3
"""Seconds between the middles of two sweeps at least; those of unlike length may even coincide."""


@dataclass(frozen=True, slots=True)
class PoseContext:
    """What the mapper knows when it asks for a user's own factors.

    Attributes
    ----------
    key : of the unknown pose, for the factors
    stamp : nanoseconds of that pose: the middle of the sweep
    guess : predicted ``map_T_lidar`` of that moment
    last : stamp and pose of the middle of the last sweep; None if there is none
    """

    key: int
    stamp: int
    guess: gtsam.Pose3
    last: tuple[int, gtsam.Pose3] | None


ExtraFactors = Callable[[PoseContext], Sequence[gtsam.NonlinearFactor]]
"""Called once for every sweep that is solved; returns factors on ``context.key``."""


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
    solver : anything with :meth:`loam_gtsam.registration.solvers.ScanSolver.solve`;
        :func:`make_solver` makes it from the configuration if None
    imu : samples may be added to it while the mapper runs
    extra_factors : a user's own factors for every sweep: GPS, ground level, wheels, ...

    Attributes
    ----------
    last : the last update
    registered : the last sweep as it went into the map; None if it did not
    imu : what the mapper makes of the IMU; None without one
    watch : tells whether sweeps fit the map
    edge_map, plane_map : the map
    keyframe : to which the points of the frames to come belong, see :meth:`move_map`

    Raises
    ------
    ConfigError
        If the solver has no place for the configured use of the IMU.
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
        method, prior = self.config.solver.method, self.config.imu.prior
        if imu is not None and method != "gtsam" and prior in ("equivalent", "sigma"):
            raise ConfigError(
                f"imu.prior: {prior} is a factor, and solver.method {method} has no graph to put "
                "it in; use imu.prior blend or off, or solver.method gtsam"
            )
        self.imu = None if imu is None else ImuTracker(self.config.imu, imu)
        self.extra_factors = extra_factors
        self.keyframe = 0
        self.reset()

    def __getstate__(self) -> dict[str, Any]:
        # For checkpoints: no frame depends on what is only there to be looked at.
        return vars(self) | {"registered": None}

    def reset(self) -> None:
        """Forget the map: the next sweep is the first of a new one."""
        self.last: MapUpdate | None = None
        self.registered: Registered | None = None
        self.watch = Watch(self.config.relocalization)
        self._errors = PoseErrors(self.config)
        self._stamps = StampCheck()
        self._new_map()
        self._first: tuple[MovingSweep, gtsam.Pose3] | None = None
        self._last_middle: tuple[int, gtsam.Pose3] | None = None

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
        guess : predicted ``map_T_lidar`` at ``features.stamp``; constant velocity if None, and for
            the first sweep the origin, levelled by the IMU
        twist : (6,) predicted body velocity during the sweep, rad/s and m/s; that of the last
            sweep if None
        priors : further factors on :data:`loam_gtsam.registration.solvers.POSE_KEY`, the
            pose at the middle of the sweep

        Returns
        -------
        MapUpdate
            Never raises for what a sweep contains: see its ``status``.
        """
        clock = Clock()
        self.registered = None
        refused = self._refused(features.stamp)
        if refused is not None:
            return refused
        points = features.edges, features.planes, features.edge_times, features.plane_times
        if not all(np.isfinite(part).all() for part in points):
            message = "features of the sweep are NaN or infinite"
            return self._unused(features.stamp, message, SweepFault.NOT_FINITE)
        aid, last = self.imu, self.last
        if last is None and aid is not None:
            guess = aid.first_pose(features.stamp, guess)
        if guess is None or twist is None:
            predicted = ConstantVelocity(aid).guess(features, last)
            guess = predicted.map_T_lidar if guess is None else guess
            twist = predicted.twist if twist is None else twist
        start = Guess(guess, np.asarray(twist, np.float64))
        sweep = MovingSweep(features, self.config, None if aid is None else aid.trusted_gyro)
        if sweep.is_empty:
            message = "the sweep has no features"
            return self._unused(features.stamp, message, SweepFault.NO_FEATURES)
        sweep.deskew(start.twist)
        clock.lap("prepare")

        if last is None:
            try:
                self._recenter(_to_middle(sweep, start))
            except InputError as error:
                return self._unused(features.stamp, str(error), None)
            if self.config.deskew.refine:
                self._first = sweep, start.map_T_lidar
            update = self._insert(sweep, start, FrameStatus.FIRST, "the map starts here", clock)
        else:
            update = self._solve(sweep, start, priors, clock)
        self.last = update
        return update

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

    def _refused(self, stamp: int) -> MapUpdate | None:
        """What is said about a sweep whose stamp cannot be used; None if it can."""
        last = self.last
        refusal = None if last is None else self._stamps.refuse(stamp, last.stamp)
        if last is None or refusal is None:
            return None
        if refusal.clock_step:
            self.last = replace(last, stamp=last.stamp + refusal.clock_step)
            if self._last_middle is not None:
                before, pose = self._last_middle
                self._last_middle = before + refusal.clock_step, pose
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
        """What is said about a sweep that says nothing: the pose is predicted."""
        last, status = self.last, FrameStatus.UNUSABLE_SCAN
        if last is None:
            return MapUpdate(stamp, gtsam.Pose3(), status, message, fault=fault)
        guess = ConstantVelocity(self.imu).at(stamp, last)
        self.last = MapUpdate(
            stamp, guess.map_T_lidar, status, message, twist=guess.twist, fault=fault
        )
        return self.last

    def _solve(
        self,
        sweep: MovingSweep,
        guess: Guess,
        priors: Sequence[gtsam.NonlinearFactor],
        clock: Clock,
    ) -> MapUpdate:
        """Match the sweep with the map around the guess, solve, insert."""
        guess, motion = self._expected(sweep, guess)
        middle = _to_middle(sweep, guess)
        maps = self.edge_map, self.plane_map
        try:
            self._recenter(middle)
        except InputError as error:
            return self._unused(sweep.reference_stamp, str(error), None)
        around = [cubes.neighbourhood(middle.matrix()) for cubes in maps]
        sizes = [cubes.count(near) for cubes, near in zip(maps, around, strict=True)]
        config = self.config.solver
        sparse = sizes[0] < config.min_map_edges or sizes[1] < config.min_map_planes
        if sparse and not self.watch.lost:
            self._first = None
            message = (
                f"the local map has {sizes[0]} edge and {sizes[1]} plane points; at least "
                f"{config.min_map_edges} and {config.min_map_planes} are needed"
            )
            return self._insert(sweep, guess, FrameStatus.SPARSE_MAP, message, clock)

        matches_at = _Association(self, sweep, guess, clock)
        priors = [*priors, *self._factors(sweep.stamp, middle)]
        solution = self.solver.solve(matches_at, middle, priors, motion)
        clock.lap("solve")
        relocalized, twist = "", guess.twist
        if self._doubtful(sweep, solution, matches_at):
            found = self._search(sweep, guess, solution, matches_at, priors, motion, clock)
            if isinstance(found, str):
                self._last_middle = sweep.stamp, middle
                nothing = Solution.unsolved(middle, solution.matches, solution.iterations, 0)
                return report(sweep, guess, FrameStatus.LOST, found, clock, nothing)
            solution, twist, relocalized = found
        if not solution.solved:
            # Once may be chance; a sweep that has plenty to match is searched for the next time.
            self.watch.lost += matches_at.offered >= 2 * config.min_matches
            message = f"{len(solution.matches)} matches; {config.min_matches} are needed"
            self._last_middle = sweep.stamp, middle
            return report(sweep, guess, FrameStatus.FEW_MATCHES, message, clock, solution)
        if not relocalized:
            twist = self._twist(sweep, solution.map_T_lidar, guess.twist)
        if self._first is not None:
            solution, twist = self._start_again(sweep, solution, twist, matches_at, priors, motion)
        if not matches_at.wide:
            fit = Fit.of(solution.matches, matches_at.offered)
            self.watch.accept(fit, solution.map_T_lidar)
        solution, result, tilt = self._finish(sweep, solution, twist)
        status, message = FrameStatus.OK, relocalized
        if not solution.converged:
            status = FrameStatus.NOT_CONVERGED
            message = f"the pose still moved after {solution.iterations} associations"
        if solution.weak is not None:
            status = FrameStatus.DEGENERATE
            message = f"the scan does not tell {named(solution)}; the expected motion was kept"
        if relocalized and message is not relocalized:
            message = f"{relocalized}; {message}"
        update = self._insert(sweep, result, status, message, clock, solution, tilt)
        update = self._errors.calibrated(update, sweep, solution)
        clock.lap("covariance")
        return update

    def _doubtful(self, sweep: MovingSweep, solution: Solution, matches_at: _Association) -> bool:
        """Whether the sweep is to be searched for, instead of believing the solve."""
        watch = self.watch
        if not self.config.relocalization.enabled or self._last_middle is None:
            return False
        if watch.lost or not solution.solved:
            return watch.lost > 0
        assert self.last is not None
        seconds = max((sweep.stamp - self._last_middle[0]) * 1e-9, _SHORTEST)
        # Not from the guess, which may be a user's.
        expected = advance(self._last_middle[1], self.last.twist, seconds)
        if watch.jumped(expected.localCoordinates(solution.map_T_lidar), seconds):
            return True
        # Matches of a wide search are unlike the usual ones.
        fit = Fit.of(solution.matches, matches_at.offered)
        return not matches_at.wide and watch.misfit(fit)

    def _search(
        self,
        sweep: MovingSweep,
        guess: Guess,
        solution: Solution,
        matches_at: _Association,
        priors: Sequence[gtsam.NonlinearFactor],
        motion: MotionPrior,
        clock: Clock,
    ) -> tuple[Solution, FloatArray, str] | str:
        """The solution that fits best, its twist and what happened; or why the sweep is lost.

        A lidar that was moved between two sweeps did not move like that within them: its velocity
        is that from before, or none, or, if it was turned on its vehicle, that of the vehicle.
        """
        watch, middle = self.watch, _to_middle(sweep, guess)
        usual, before = watch.usual, Fit.of(solution.matches, matches_at.offered)
        lost = watch.lost > 0 or watch.misfit(before)
        matches_at.stay()
        start: gtsam.Pose3 | None = solution.map_T_lidar
        moving = self._twist(sweep, solution.map_T_lidar, guess.twist)
        twists = [guess.twist, np.zeros(6) if lost else moving]
        if lost:
            sweep.deskew(guess.twist)
            start = self._place(sweep, middle, solution, matches_at, priors, clock)
            if start is not None:
                twists.append(_turned(guess.twist, start.rotation().between(middle.rotation())))
        best: tuple[Fit, Solution, FloatArray] | None = None
        for twist in twists:
            if start is None:
                break
            sweep.deskew(twist)
            matches_at.use(self.config.matching)
            here = MotionPrior(start, motion.information)
            found = self.solver.solve(matches_at, start, priors, here)
            fit = Fit.of(found.matches, matches_at.offered)
            if not (found.solved and watch.fits_again(fit)):
                continue
            if best is None or fit.total > _CLEARLY * best[0].total:
                best = fit, found, twist
        clock.lap("relocalize")
        if best is not None and best[2] is not moving:
            moved = f"moved by {way(middle, best[1].map_T_lidar)}"
            after = f" after {watch.lost} lost sweeps" if watch.lost else ""
            return best[1], best[2], f"relocalised{after}, {moved}" if lost else moved
        if not lost:
            return solution, moving, ""
        radius = watch.radius
        watch.lost += 1
        return (
            f"{before.agreement:.0%} of the matches agree with the map, {usual.agreement:.0%} is "
            f"usual; nothing fits within {radius:g} m; lost for {watch.lost} sweeps"
        )

    def _place(
        self,
        sweep: MovingSweep,
        predicted: gtsam.Pose3,
        solution: Solution,
        matches_at: _Association,
        priors: Sequence[gtsam.NonlinearFactor],
        clock: Clock,
    ) -> gtsam.Pose3 | None:
        """Where around the prediction a few matches fit best; None if nowhere."""
        around = self.watch.around(predicted)
        known = [
            cubes.points(cubes.neighbourhood(pose.matrix()))
            for pose in around
            for cubes in (self.edge_map, self.plane_map)
        ]
        points = some(sweep.edges, sweep.planes)
        starts = [solution.map_T_lidar] if solution.solved else []
        starts += places(points, np.concatenate(known), around, self.watch.radius, _PLACES)
        clock.lap("relocalize")
        best: tuple[float, gtsam.Pose3] | None = None
        for start in starts:
            matches_at.use(trial(self.config.matching))
            tried = self.solver.solve(matches_at, start, priors)
            total = Fit.of(tried.matches, matches_at.offered).total
            if tried.solved and (best is None or total > best[0]):
                best = total, tried.map_T_lidar
        return None if best is None else best[1]

    def _factors(self, stamp: int, guess: gtsam.Pose3) -> Sequence[gtsam.NonlinearFactor]:
        """The IMU's factors and the user's, on the pose of a moment."""
        factors = [] if self.imu is None else [*self.imu.factors(stamp)]
        if self.extra_factors is not None:
            context = PoseContext(POSE_KEY, stamp, guess, self._last_middle)
            factors += _checked(self.extra_factors(context))
        return factors

    def _expected(self, sweep: MovingSweep, guess: Guess) -> tuple[Guess, MotionPrior]:
        """The motion that takes over where the scan says nothing: pre-integrated, or constant."""
        aid = self.imu
        predicted = None if aid is None else aid.predict(sweep.stamp)
        if predicted is not None:
            velocity = predicted.map_T_lidar.rotation().matrix().T @ predicted.velocity
            twist = sweep.twist_at_reference(guess.twist[:3], velocity)
            sweep.deskew(twist)
            pose = predicted.map_T_lidar.compose(sweep.middle_T_reference(twist))
            information: FloatArray = np.linalg.inv(predicted.covariance).astype(np.float64)
            return Guess(pose, twist), MotionPrior(predicted.map_T_lidar, information)
        assert self._last_middle is not None
        seconds = max((sweep.stamp - self._last_middle[0]) * 1e-9, _SHORTEST)
        config = self.config.solver
        away = 0.5 * seconds**2 * np.repeat([config.turn_sigma, config.acceleration_sigma], 3)
        return guess, MotionPrior(_to_middle(sweep, guess), np.diag(away**-2.0))

    def _finish(
        self, sweep: MovingSweep, solution: Solution, twist: FloatArray
    ) -> tuple[Solution, Guess, TiltPrior]:
        """The pose at the reference time, with the IMU's roll and pitch."""
        aid, to_reference = self.imu, sweep.middle_T_reference(twist)
        if aid is None:
            pose = solution.map_T_lidar.compose(to_reference)
            return solution, Guess(pose, twist), TiltPrior.NONE
        if self._last_middle is not None:
            now = sweep.stamp, solution.map_T_lidar
            aid.compare_gyro(self._last_middle, now)
            aid.observe(self._last_middle, now, solution.scan_information)
        solution, tilt = aid.add_tilt(sweep.stamp, solution)
        pose = solution.map_T_lidar.compose(to_reference)
        if tilt is TiltPrior.NONE:
            pose, tilt = aid.blend_tilt(sweep.reference_stamp, pose)
        aid.find_level(sweep.reference_stamp, pose)  # for the frames to come
        return solution, Guess(pose, twist), tilt

    def _twist(self, sweep: MovingSweep, middle: gtsam.Pose3, otherwise: FloatArray) -> FloatArray:
        """Body velocity from the middle of the last sweep to that of this one."""
        last = self._last_middle
        if last is None or sweep.stamp <= last[0]:  # sweeps of unlike length
            return otherwise
        return sweep.twist_since(last, middle)

    def _start_again(
        self,
        sweep: MovingSweep,
        solution: Solution,
        twist: FloatArray,
        matches_at: Associate,
        priors: Sequence[gtsam.NonlinearFactor],
        motion: MotionPrior,
    ) -> tuple[Solution, FloatArray]:
        """Rebuild the map of the first sweep, now that its motion is known.

        Without this a run that starts in motion keeps a distorted first sweep in its map for ever.
        """
        assert self._first is not None
        first, pose = self._first
        self._first = None
        for _ in range(_START_ROUNDS):
            first.deskew(twist)
            sweep.deskew(twist)
            self._new_map()
            self._recenter(pose)
            self._add_to_map(first, _to_middle(first, Guess(pose, twist)))
            again = self.solver.solve(matches_at, solution.map_T_lidar, priors, motion)
            if not again.solved:
                break
            solution = again
            twist = self._twist(sweep, solution.map_T_lidar, twist)
        return solution, twist

    def _insert(
        self,
        sweep: MovingSweep,
        result: Guess,
        status: FrameStatus,
        message: str,
        clock: Clock,
        solution: Solution | None = None,
        tilt: TiltPrior = TiltPrior.NONE,
    ) -> MapUpdate:
        """De-skew with the final motion, add to the map, report."""
        clock.lap("solve")
        sweep.deskew(result.twist)
        middle = _to_middle(sweep, result)
        self._add_to_map(sweep, middle)
        matches = None if solution is None else solution.matches
        self.registered = Registered(sweep.edges, sweep.planes, middle, matches)
        clock.lap("insert")
        return report(sweep, result, status, message, clock, solution, tilt)

    def _new_map(self) -> None:
        self.edge_map = CubeMap(self.config.map, self.config.map.edge_voxel)
        self.plane_map = CubeMap(self.config.map, self.config.map.plane_voxel)

    def _recenter(self, middle: gtsam.Pose3) -> None:
        """Let the windows follow; InputError if a pose is not finite or beyond the voxel grid."""
        for cubes in (self.edge_map, self.plane_map):
            cubes.recenter(middle.translation())

    def _add_to_map(self, sweep: MovingSweep, middle: gtsam.Pose3) -> None:
        self.edge_map.owner = self.plane_map.owner = self.keyframe
        self.edge_map.insert(transform(middle.matrix(), sweep.edges))
        self.plane_map.insert(transform(middle.matrix(), sweep.planes))
        self._last_middle = sweep.stamp, middle


class _Association:
    """The matches of a sweep at a pose, as a solver asks for them."""

    def __init__(self, mapper: Mapper, sweep: MovingSweep, guess: Guess, clock: Clock) -> None:
        self._mapper, self._sweep, self._guess, self._clock = mapper, sweep, guess, clock
        self._calls = 0
        self.wide = False
        self.use(mapper.config.matching)

    @property
    def offered(self) -> int:
        """Features to match."""
        return sum(map(len, self._rows))

    def stay(self) -> None:
        """Take the sweep as it is de-skewed now."""
        self._calls = 2

    def use(self, matching: MatchingConfig) -> None:
        """Go on with another configuration, and without the matches found so far."""
        sweep = self._sweep
        self._matching = matching
        counts = sweep.n_edges, sweep.n_planes
        edges, planes, self._distinct = chosen_rows(*counts, matching, sweep.distinct)
        self._rows = edges, planes
        self._found: tuple[CubeMap, gtsam.Pose3, ScanMatches] | None = None

    def __call__(self, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        mapper, sweep = self._mapper, self._sweep
        self._clock.lap("solve")
        self._calls += 1
        if self._calls == 2 and mapper._first is None and mapper.config.deskew.refine:
            # The first solve knows the motion better than the guess. Once is enough: further
            # rounds cost associations and change nothing that can be measured.
            sweep.deskew(mapper._twist(sweep, map_T_lidar, self._guess.twist))
            if self._found is not None:
                cubes, searched, found = self._found
                points = sweep.some(found.edges.indices, found.planes.indices)
                self._found = cubes, searched, moved(found, *points)
        matches = self._kept(map_T_lidar)
        if matches is None:
            features = *sweep.some(*self._rows), map_T_lidar
            maps = mapper.edge_map, mapper.plane_map
            matches = match_features(*features, *maps, self._matching, self._distinct)
            wide = self._matching.wide_search
            self.wide = len(matches) < mapper.config.solver.min_matches and wide > 1.0
            if self.wide:
                # One sweep alone on open ground: five neighbours lie on one ring. Seen more
                # coarsely, there are others among them.
                reach = wide * self._matching.max_distance
                maps = mapper.edge_map.thinned(wide), mapper.plane_map.thinned(wide)
                matching = self._matching.changed(max_distance=reach)
                matches = match_features(*features, *maps, matching, self._distinct)
            matches = at_rows(matches, *self._rows)
            self._found = mapper.plane_map, map_T_lidar, matches
        self._clock.lap("match")
        return matches

    def _kept(self, map_T_lidar: gtsam.Pose3) -> ScanMatches | None:
        """The matches found before, if the map is the same and the pose has hardly moved."""
        if self._found is None or self._found[0] is not self._mapper.plane_map:
            return None
        _, searched, matches = self._found
        step = searched.localCoordinates(map_T_lidar)
        turned, shifted = np.degrees(np.linalg.norm(step[:3])), np.linalg.norm(step[3:])
        config = self._matching
        if turned < config.keep_rotation_deg and shifted < config.keep_translation:
            return renew(matches, map_T_lidar, config)
        return None


def make_solver(config: SolverConfig) -> ScanSolver:
    """The solver that ``config.method`` names."""
    solvers: dict[str, type[GtsamSolver | ClassicalSolver | ALoamSolver]] = {
        "gtsam": GtsamSolver,
        "loam": ClassicalSolver,
        "aloam": ALoamSolver,
    }
    return solvers[config.method](config)


def _checked(factors: object) -> Sequence[gtsam.NonlinearFactor]:
    """What ``extra_factors`` gave, if it can be used: GTSAM's own errors name no cause."""
    if not isinstance(factors, Sequence):
        raise InputError(
            "extra_factors: expected a list of factors, empty if there are none; got "
            f"{type(factors).__name__}"
        )
    for factor in factors:
        keys = list(factor.keys()) if isinstance(factor, gtsam.NonlinearFactor) else []
        if keys != [POSE_KEY]:
            raise InputError(
                "extra_factors: expected GTSAM factors whose one key is context.key, "
                f"{POSE_KEY}; got {type(factor).__name__} on the keys {keys}"
            )
    return factors


def _turned(twist: FloatArray, a_R_b: gtsam.Rot3) -> FloatArray:
    """A (6,) body velocity in the axes of ``a``, if it is given in those of ``b``."""
    return (a_R_b.matrix() @ twist.reshape(2, 3).T).T.reshape(6)


def _to_middle(sweep: MovingSweep, result: Guess) -> gtsam.Pose3:
    """The pose at the middle of a sweep, from that at its reference time."""
    back = sweep.middle_T_reference(result.twist).inverse()
    return result.map_T_lidar.compose(back)
