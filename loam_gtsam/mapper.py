"""The mapper: registers one sweep after another with the cube map.

Within a frame, poses belong to the middle of the sweep (see :mod:`loam_gtsam.deskew`); the result
is handed out at the reference time of the features.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from loam_gtsam.classical import ALoamSolver, ClassicalSolver
from loam_gtsam.config import Config, MatchingConfig, SolverConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.deskew import MovingSweep
from loam_gtsam.geometry import transform
from loam_gtsam.imu import ImuBuffer
from loam_gtsam.imu_aid import ImuAid
from loam_gtsam.matching import ScanMatches, associate, renew, rough
from loam_gtsam.odometry import ConstantVelocity, Guess
from loam_gtsam.solvers import (
    POSE_KEY,
    Associate,
    GtsamSolver,
    MotionPrior,
    ScanSolver,
    Solution,
)
from loam_gtsam.types import (
    ConfigError,
    Features,
    FloatArray,
    FrameStatus,
    InputError,
    MapUpdate,
    TiltPrior,
)

_START_ROUNDS = 2
"""Times the first two sweeps are registered anew while their motion becomes known."""
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


class Mapper:
    """LOAM's mapping stage.

    Parameters
    ----------
    config : the whole configuration; ``map``, ``matching``, ``solver``, ``deskew`` and ``imu``
        are used
    solver : anything with :meth:`loam_gtsam.solvers.ScanSolver.solve`; :func:`make_solver` makes
        it from the configuration if None
    imu : samples may be added to it while the mapper runs
    extra_factors : a user's own factors for every sweep: GPS, ground level, wheels, ...

    Attributes
    ----------
    last : the last update
    imu_aid : what the mapper makes of the IMU; None without one
    edge_map, plane_map : the map

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
        self.imu_aid = None if imu is None else ImuAid(self.config.imu, imu)
        self.extra_factors = extra_factors
        self.last: MapUpdate | None = None
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
        priors : further factors on :data:`loam_gtsam.solvers.POSE_KEY`, the pose at the middle of
            the sweep

        Returns
        -------
        MapUpdate
            Never raises for what a sweep contains: see its ``status``.
        """
        clock = _Clock()
        last = self.last
        if last is not None and features.stamp <= last.stamp:
            return self.skip(features.stamp, "")
        aid = self.imu_aid
        if last is None and aid is not None:
            guess = aid.start(features.stamp, guess)
        if guess is None or twist is None:
            predicted = ConstantVelocity(aid).guess(features, last)
            guess = predicted.map_T_lidar if guess is None else guess
            twist = predicted.twist if twist is None else twist
        start = Guess(guess, np.asarray(twist, np.float64))
        sweep = MovingSweep(features, self.config, None if aid is None else aid.gyro)
        if sweep.is_empty:
            return self.skip(features.stamp, "the sweep has no features")
        sweep.deskew(start.twist)
        clock.lap("prepare")

        if last is None:
            if self.config.deskew.refine:
                self._first = sweep, start.map_T_lidar
            update = self._insert(sweep, start, FrameStatus.FIRST, "the map starts here", clock)
        else:
            update = self._solve(sweep, start, priors, clock)
        self.last = update
        return update

    def skip(self, stamp: int, message: str) -> MapUpdate:
        """Account for a sweep that cannot be used: the pose is predicted, the map unchanged.

        Parameters
        ----------
        stamp : nanoseconds
        message : why

        Returns
        -------
        MapUpdate
            With status ``UNUSABLE_SCAN``, or ``BAD_STAMP`` if the stamp is not later than the last
            one.
        """
        last = self.last
        if last is None:
            return MapUpdate(stamp, gtsam.Pose3(), FrameStatus.UNUSABLE_SCAN, message)
        if stamp <= last.stamp:
            message = f"stamp {stamp} ns is not later than the last one, {last.stamp} ns"
            return MapUpdate(
                stamp, last.map_T_lidar, FrameStatus.BAD_STAMP, message, twist=last.twist
            )
        guess = ConstantVelocity(self.imu_aid).at(stamp, last)
        self.last = MapUpdate(
            stamp, guess.map_T_lidar, FrameStatus.UNUSABLE_SCAN, message, twist=guess.twist
        )
        return self.last

    def map_points(self) -> tuple[FloatArray, FloatArray]:
        """Edge and plane points of the whole map, archive included, (E, 3) and (P, 3), metres."""
        return self.edge_map.points(archived=True), self.plane_map.points(archived=True)

    # -- the steps of a frame ----------------------------------------------------------------

    def _solve(
        self,
        sweep: MovingSweep,
        guess: Guess,
        priors: Sequence[gtsam.NonlinearFactor],
        clock: _Clock,
    ) -> MapUpdate:
        """Match the sweep with the map around the guess, solve, insert."""
        guess, motion = self._expected(sweep, guess)
        middle = _to_middle(sweep, guess)
        sizes = []
        for cubes in (self.edge_map, self.plane_map):
            cubes.recenter(middle.translation())
            sizes.append(cubes.count(cubes.neighbourhood(middle.matrix())))
        config = self.config.solver
        if sizes[0] < config.min_map_edges or sizes[1] < config.min_map_planes:
            self._first = None
            message = (
                f"the local map has {sizes[0]} edge and {sizes[1]} plane points; at least "
                f"{config.min_map_edges} and {config.min_map_planes} are needed"
            )
            return self._insert(sweep, guess, FrameStatus.SPARSE_MAP, message, clock)

        matches_at = _Association(self, sweep, guess, clock)
        priors = [*priors, *self._factors(sweep.stamp, middle)]
        start, rough_iterations = middle, 0
        if self._first is None and 0 < self.config.matching.rough_planes < len(sweep.planes):
            # Few matches get as near as many do; all of them are then searched for but once.
            matches_at.use(rough(self.config.matching))
            first = self.solver.solve(matches_at, middle, priors)
            matches_at.use(self.config.matching)
            rough_iterations = first.iterations
            start = first.map_T_lidar
        solution = self.solver.solve(matches_at, start, priors, motion)
        solution = replace(solution, iterations=solution.iterations + rough_iterations)
        clock.lap("solve")
        if not solution.solved:
            message = f"{len(solution.matches)} matches; {config.min_matches} are needed"
            self._last_middle = sweep.stamp, middle
            return _report(sweep, guess, FrameStatus.FEW_MATCHES, message, clock, solution)
        twist = self._twist(sweep, solution.map_T_lidar, guess.twist)
        if self._first is not None:
            solution, twist = self._start_again(sweep, solution, twist, matches_at, priors)
        solution, result, tilt = self._finish(sweep, solution, twist)
        status, message = FrameStatus.OK, ""
        if not solution.converged:
            status = FrameStatus.NOT_CONVERGED
            message = f"the pose still moved after {solution.iterations} associations"
        if solution.weak is not None:
            status = FrameStatus.DEGENERATE
            message = f"the scan does not tell {_named(solution)}; the expected motion was kept"
        return self._insert(sweep, result, status, message, clock, solution, tilt)

    def _factors(self, stamp: int, guess: gtsam.Pose3) -> Sequence[gtsam.NonlinearFactor]:
        """The IMU's factors and the user's, on the pose of a moment."""
        factors = [] if self.imu_aid is None else [*self.imu_aid.factors(stamp)]
        if self.extra_factors is not None:
            context = PoseContext(POSE_KEY, stamp, guess, self._last_middle)
            factors += _checked(self.extra_factors(context))
        return factors

    def _expected(self, sweep: MovingSweep, guess: Guess) -> tuple[Guess, MotionPrior]:
        """The motion that takes over where the scan says nothing: pre-integrated, or constant."""
        aid = self.imu_aid
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
        aid, to_reference = self.imu_aid, sweep.middle_T_reference(twist)
        if aid is None:
            pose = solution.map_T_lidar.compose(to_reference)
            return solution, Guess(pose, twist), TiltPrior.NONE
        if self._last_middle is not None:
            now = sweep.stamp, solution.map_T_lidar
            aid.compare_gyro(self._last_middle, now)
            aid.observe(self._last_middle, now, solution.scan_information)
        solution, tilt = aid.tilted(sweep.stamp, solution)
        pose = solution.map_T_lidar.compose(to_reference)
        if tilt is TiltPrior.NONE:
            pose, tilt = aid.blended(sweep.reference_stamp, pose)
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
            self._add_to_map(first, _to_middle(first, Guess(pose, twist)))
            again = self.solver.solve(matches_at, solution.map_T_lidar, priors)
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
        clock: _Clock,
        solution: Solution | None = None,
        tilt: TiltPrior = TiltPrior.NONE,
    ) -> MapUpdate:
        """De-skew with the final motion, add to the map, report."""
        clock.lap("solve")
        sweep.deskew(result.twist)
        self._add_to_map(sweep, _to_middle(sweep, result))
        clock.lap("insert")
        return _report(sweep, result, status, message, clock, solution, tilt)

    def _new_map(self) -> None:
        self.edge_map = CubeMap(self.config.map, self.config.map.edge_voxel)
        self.plane_map = CubeMap(self.config.map, self.config.map.plane_voxel)

    def _add_to_map(self, sweep: MovingSweep, middle: gtsam.Pose3) -> None:
        self.edge_map.insert(transform(middle.matrix(), sweep.edges))
        self.plane_map.insert(transform(middle.matrix(), sweep.planes))
        self._last_middle = sweep.stamp, middle


class _Association:
    """The matches of a sweep at a pose, as a solver asks for them."""

    def __init__(self, mapper: Mapper, sweep: MovingSweep, guess: Guess, clock: _Clock) -> None:
        self._mapper, self._sweep, self._guess, self._clock = mapper, sweep, guess, clock
        self._calls = 0
        self.use(mapper.config.matching)

    def use(self, matching: MatchingConfig) -> None:
        """Go on with another configuration, and without the matches found so far."""
        self._matching = matching
        self._found: tuple[CubeMap, gtsam.Pose3, ScanMatches] | None = None

    def __call__(self, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        mapper, sweep = self._mapper, self._sweep
        self._clock.lap("solve")
        self._calls += 1
        if self._calls == 2 and mapper._first is None and mapper.config.deskew.refine:
            # The first solve knows the motion better than the guess. Once is enough: further
            # rounds cost associations and change nothing that can be measured.
            sweep.deskew(mapper._twist(sweep, map_T_lidar, self._guess.twist))
            self._found = None
        matches = self._kept(map_T_lidar)
        if matches is None:
            matches = associate(
                sweep.edges,
                sweep.planes,
                map_T_lidar,
                mapper.edge_map,
                mapper.plane_map,
                self._matching,
                sweep.distinct,
            )
            self._found = mapper.plane_map, map_T_lidar, matches
        self._clock.lap("match")
        return matches

    def _kept(self, map_T_lidar: gtsam.Pose3) -> ScanMatches | None:
        """The matches found before, if the map is the same and the pose has hardly moved."""
        if self._found is None or self._found[0] is not self._mapper.plane_map:
            return None
        _, searched, matches = self._found
        moved = searched.localCoordinates(map_T_lidar)
        turned, shifted = np.degrees(np.linalg.norm(moved[:3])), np.linalg.norm(moved[3:])
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


def _named(solution: Solution) -> str:
    """The weak directions in words: metres and rad in lidar axes."""
    assert solution.localizability is not None
    names = []
    for direction in solution.localizability.directions[: solution.n_weak]:
        unit = direction / direction[np.abs(direction).argmax()]  # its sign means nothing
        parts = zip(unit, ("rx", "ry", "rz", "x", "y", "z"), strict=True)
        names.append(" ".join(f"{value:+.2f} {axis}" for value, axis in parts if abs(value) > 0.05))
    return " or ".join(names)


class _Clock:
    """Adds up seconds per stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Book the time since the last lap on a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._since
        self._since = now


def _to_middle(sweep: MovingSweep, result: Guess) -> gtsam.Pose3:
    """The pose at the middle of a sweep, from that at its reference time."""
    back = sweep.middle_T_reference(result.twist).inverse()
    return result.map_T_lidar.compose(back)


def _report(
    sweep: MovingSweep,
    result: Guess,
    status: FrameStatus,
    message: str,
    clock: _Clock,
    solution: Solution | None,
    tilt: TiltPrior = TiltPrior.NONE,
) -> MapUpdate:
    update = MapUpdate(
        stamp=sweep.reference_stamp,
        map_T_lidar=result.map_T_lidar,
        status=status,
        message=message,
        n_edges=len(sweep.edges),
        n_planes=len(sweep.planes),
        twist=result.twist,
        sweep_motion=sweep.motion,
        tilt_prior=tilt,
        timings=clock.seconds,
    )
    if solution is None:
        return update
    # The solve is about the middle of the sweep; a right perturbation there is, at the reference
    # time, the same one seen through the motion between the two.
    to_middle = sweep.middle_T_reference(result.twist).AdjointMap()
    update = replace(
        update,
        n_edge_matches=len(solution.matches.edges),
        n_plane_matches=len(solution.matches.planes),
        iterations=solution.iterations,
        solver_iterations=solution.solver_iterations,
        error_before=solution.error_before,
        error_after=solution.error_after,
        information=to_middle.T @ solution.information @ to_middle,
    )
    seen = solution.localizability
    if seen is None:
        return update
    to_reference = sweep.middle_T_reference(result.twist).inverse().AdjointMap()
    return replace(update, localizability=seen.aligned, directions=seen.directions @ to_reference.T)
