"""The mapper: registers one sweep after another with the cube map.

Within a frame, poses belong to the *middle* of the sweep: there an error of the motion used for
the de-skew cancels to first order, while at the start or the end it would shift the whole sweep.
The result is handed out at the reference time of the features.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from loam_gtsam.classical import ALoamSolver, ClassicalSolver
from loam_gtsam.config import Config, SolverConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.geometry import move_points, transform, voxel_filter
from loam_gtsam.matching import ScanMatches, associate, renew
from loam_gtsam.odometry import ConstantVelocity, Guess, advance
from loam_gtsam.solvers import Associate, GtsamSolver, ScanSolver, Solution
from loam_gtsam.types import Features, FloatArray, FrameStatus, MapUpdate

_START_ROUNDS = 2
"""Times the first two sweeps are registered anew while their motion becomes known."""


class Mapper:
    """LOAM's mapping stage.

    Parameters
    ----------
    config : the whole configuration; ``map``, ``matching``, ``solver`` and ``deskew`` are used
    solver : anything with :meth:`loam_gtsam.solvers.ScanSolver.solve`; :func:`make_solver` makes
        it from the configuration if None
    """

    def __init__(self, config: Config | None = None, solver: ScanSolver | None = None) -> None:
        self.config = config or Config()
        self.solver = solver or make_solver(self.config.solver)
        self.last: MapUpdate | None = None
        self._new_map()
        self._first: tuple[_Sweep, gtsam.Pose3] | None = None
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
        guess : predicted ``map_T_lidar`` at ``features.stamp``; constant velocity if None
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
        predicted = ConstantVelocity().guess(features, last)
        start = Guess(
            predicted.map_T_lidar if guess is None else guess,
            predicted.twist if twist is None else np.asarray(twist, np.float64),
        )
        sweep = _Sweep(features, self.config)
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
        pose = advance(last.map_T_lidar, last.twist, (stamp - last.stamp) * 1e-9)
        self.last = MapUpdate(stamp, pose, FrameStatus.UNUSABLE_SCAN, message, twist=last.twist)
        return self.last

    def map_points(self) -> tuple[FloatArray, FloatArray]:
        """Edge and plane points of the whole map, archive included, (E, 3) and (P, 3), metres."""
        return self.edge_map.points(archived=True), self.plane_map.points(archived=True)

    # -- the steps of a frame ----------------------------------------------------------------

    def _solve(
        self,
        sweep: _Sweep,
        guess: Guess,
        priors: Sequence[gtsam.NonlinearFactor],
        clock: _Clock,
    ) -> MapUpdate:
        """Match the sweep with the map around the guess, solve, insert."""
        middle = advance(guess.map_T_lidar, guess.twist, sweep.middle)
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

        associations = 0
        found: tuple[CubeMap, gtsam.Pose3, ScanMatches] | None = None

        def matches_at(map_T_lidar: gtsam.Pose3) -> ScanMatches:
            nonlocal associations, found
            clock.lap("solve")
            associations += 1
            if associations == 2 and self._first is None and self.config.deskew.refine:
                # The first solve knows the motion better than the guess. Once is enough: further
                # rounds cost associations and change nothing that can be measured.
                sweep.deskew(self._twist(sweep, map_T_lidar, guess.twist))
                found = None
            if (
                found is not None
                and found[0] is self.plane_map
                and self._near(found[1], map_T_lidar)
            ):
                matches = renew(found[2], map_T_lidar, self.config.matching)
            else:
                matches = associate(
                    sweep.edges,
                    sweep.planes,
                    map_T_lidar,
                    self.edge_map,
                    self.plane_map,
                    self.config.matching,
                )
                found = self.plane_map, map_T_lidar, matches
            clock.lap("match")
            return matches

        solution = self.solver.solve(matches_at, middle, priors)
        clock.lap("solve")
        if not solution.solved:
            message = f"{len(solution.matches)} matches; {config.min_matches} are needed"
            self._last_middle = sweep.stamp, middle
            return _report(sweep, guess, FrameStatus.FEW_MATCHES, message, clock, solution)
        twist = self._twist(sweep, solution.map_T_lidar, guess.twist)
        if self._first is not None:
            solution, twist = self._start_again(sweep, solution, twist, matches_at, priors)
        result = Guess(advance(solution.map_T_lidar, twist, -sweep.middle), twist)
        status, message = FrameStatus.OK, ""
        if not solution.converged:
            status = FrameStatus.NOT_CONVERGED
            message = f"the pose still moved after {solution.iterations} associations"
        return self._insert(sweep, result, status, message, clock, solution)

    def _near(self, searched: gtsam.Pose3, map_T_lidar: gtsam.Pose3) -> bool:
        """Whether matches found at one pose may be kept at another."""
        moved = searched.localCoordinates(map_T_lidar)
        config = self.config.matching
        return bool(
            np.degrees(np.linalg.norm(moved[:3])) < config.keep_rotation_deg
            and np.linalg.norm(moved[3:]) < config.keep_translation
        )

    def _twist(self, sweep: _Sweep, middle: gtsam.Pose3, otherwise: FloatArray) -> FloatArray:
        """Body velocity from the middle of the last sweep to that of this one."""
        if self._last_middle is None:
            return otherwise
        stamp, last_middle = self._last_middle
        moved = gtsam.Pose3.Logmap(last_middle.between(middle))
        twist: FloatArray = moved / ((sweep.stamp - stamp) * 1e-9)
        return twist

    def _start_again(
        self,
        sweep: _Sweep,
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
            middle = advance(pose, twist, first.middle)
            self._new_map()
            self._add_to_map(first, middle)
            again = self.solver.solve(matches_at, solution.map_T_lidar, priors)
            if not again.solved:
                break
            solution = again
            twist = self._twist(sweep, solution.map_T_lidar, twist)
        return solution, twist

    def _insert(
        self,
        sweep: _Sweep,
        result: Guess,
        status: FrameStatus,
        message: str,
        clock: _Clock,
        solution: Solution | None = None,
    ) -> MapUpdate:
        """De-skew with the final motion, add to the map, report."""
        clock.lap("solve")
        sweep.deskew(result.twist)
        middle = advance(result.map_T_lidar, result.twist, sweep.middle)
        self._add_to_map(sweep, middle)
        clock.lap("insert")
        return _report(sweep, result, status, message, clock, solution)

    def _new_map(self) -> None:
        self.edge_map = CubeMap(self.config.map, self.config.map.edge_voxel)
        self.plane_map = CubeMap(self.config.map, self.config.map.plane_voxel)

    def _add_to_map(self, sweep: _Sweep, middle: gtsam.Pose3) -> None:
        self.edge_map.insert(transform(middle.matrix(), sweep.edges))
        self.plane_map.insert(transform(middle.matrix(), sweep.planes))
        self._last_middle = sweep.stamp, middle


def make_solver(config: SolverConfig) -> ScanSolver:
    """The solver that ``config.method`` names."""
    solvers: dict[str, type[GtsamSolver | ClassicalSolver | ALoamSolver]] = {
        "gtsam": GtsamSolver,
        "loam": ClassicalSolver,
        "aloam": ALoamSolver,
    }
    return solvers[config.method](config)


class _Sweep:
    """The voxel-filtered features of a sweep, de-skewed to its middle."""

    def __init__(self, features: Features, config: Config) -> None:
        first, end = features.span
        self._moving = config.deskew.enabled and end > first
        self.middle = 0.5 * (first + end) if self._moving else 0.0
        self.reference_stamp = features.stamp
        self.stamp = features.stamp + round(self.middle * 1e9)
        self._edges, self._planes = (
            voxel_filter(np.column_stack([points, times]), size)
            for points, times, size in (
                (features.edges, features.edge_times, config.map.edge_voxel),
                (features.planes, features.plane_times, config.map.plane_voxel),
            )
        )
        self.edges, self.planes = self._edges[:, :3], self._planes[:, :3]

    @property
    def is_empty(self) -> bool:
        return len(self.edges) + len(self.planes) == 0

    def deskew(self, twist: FloatArray) -> None:
        """Set ``edges`` and ``planes`` to their positions seen from the middle of the sweep."""
        if self._moving:
            self.edges, self.planes = (
                move_points(features[:, :3], twist, features[:, 3] - self.middle)
                for features in (self._edges, self._planes)
            )


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


def _report(
    sweep: _Sweep,
    result: Guess,
    status: FrameStatus,
    message: str,
    clock: _Clock,
    solution: Solution | None,
) -> MapUpdate:
    update = MapUpdate(
        stamp=sweep.reference_stamp,
        map_T_lidar=result.map_T_lidar,
        status=status,
        message=message,
        n_edges=len(sweep.edges),
        n_planes=len(sweep.planes),
        twist=result.twist,
        timings=clock.seconds,
    )
    if solution is None:
        return update
    # The solve is about the middle of the sweep; a right perturbation there is, at the reference
    # time, the same one seen through the motion between the two.
    to_middle = gtsam.Pose3.Expmap(-result.twist * sweep.middle).AdjointMap()
    return replace(
        update,
        n_edge_matches=len(solution.matches.edges),
        n_plane_matches=len(solution.matches.planes),
        iterations=solution.iterations,
        solver_iterations=solution.solver_iterations,
        error_before=solution.error_before,
        error_after=solution.error_after,
        information=to_middle.T @ solution.information @ to_middle,
    )
