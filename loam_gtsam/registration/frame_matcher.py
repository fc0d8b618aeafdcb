"""The matches of a de-skewed sweep with the cube maps, as a solver asks for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.config import Config, MatchingConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.geometry import transform
from loam_gtsam.imu.preintegration import InertialPrediction
from loam_gtsam.registration.acceleration import Expected
from loam_gtsam.registration.association import match_features, rematched
from loam_gtsam.registration.degeneracy import localizability, tells_motion
from loam_gtsam.registration.matches import (
    ChosenRows,
    ScanMatches,
    Search,
    chosen_rows,
    joined,
    trial_matching,
)
from loam_gtsam.registration.odometry import Moment, Prediction, twist_to
from loam_gtsam.registration.planes import match_wide_surfaces, translations_fixed
from loam_gtsam.registration.report import Clock
from loam_gtsam.registration.solvers import Matcher, ScanSolver, Solution
from loam_gtsam.registration.solvers.sweep_velocity import solved_twist, timed_rows
from loam_gtsam.types import FloatArray, SweepMotion
from loam_gtsam.voxels.cubes import CubePoints, SortedPoints, any_order
from loam_gtsam.voxels.tags import look, tags_of

_FEW = 0.5  # share of the plane features with planes near by below which wider ones are looked for
_THIN = 50_000  # plane points of a map that is thin, and quickly made coarser: some twenty sweeps
_OPEN = 1.5
"""A place that is small stays so until the reach of a sweep is above the limit by this factor, so
that not every open door changes the maps in use."""

TrialPoints = tuple[SortedPoints | None, SortedPoints | None]
"""Edge and plane points of several sweeps; the owner of a point is the number of its sweep."""


class MapPair:
    """The map of edges and the map of planes, each with large voxels and once more with small ones.

    All sweeps go into the maps with large voxels, those from small places into both. Where a small
    place begins, the maps with small voxels take over what was mapped of it before.

    Attributes
    ----------
    small : whether the place is small, so that the maps with small voxels are in use
    keyframe : number of the keyframe to which the points of the next sweeps belong
    given : whether the maps were there before the first sweep
    earlier : the piece of map in which the run was before it went on in this one
    """

    given = False

    def __init__(self, config: Config) -> None:
        self._configs = config, config.of_small_places()
        self.earlier: MapPair | None = None
        self._keyframe, self._owned = 0, True
        self.small = False
        self.clear()

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_thinned": None}

    def clear(self) -> None:
        """Forget all points."""
        grids = [config.map for config in self._configs]
        self._open, self._small = (
            (CubeMap(grid, grid.edge_voxel), CubeMap(grid, grid.plane_voxel)) for grid in grids
        )
        self._thinned: CubeMap | None = None

    def begin_after(self, earlier: MapPair) -> None:
        """Continue a run from an earlier piece of map; the next keyframe is the first of this one.

        Until then the points of this piece belong to the last keyframe of the earlier one.
        """
        self.earlier, self._keyframe, self._owned = earlier, earlier.keyframe, False

    @property
    def keyframe(self) -> int:
        """See the class."""
        return self._keyframe

    @keyframe.setter
    def keyframe(self, number: int) -> None:
        if not self._owned:
            for cubes in (*self._open, *self._small):
                cubes.give_to(number)
        self._keyframe, self._owned = number, True

    @property
    def config(self) -> Config:
        """The configuration of the place."""
        return self._configs[self.small]

    @property
    def edges(self) -> CubeMap:
        """The map of edges in use."""
        return (self._small if self.small else self._open)[0]

    @property
    def planes(self) -> CubeMap:
        """The map of planes in use."""
        return (self._small if self.small else self._open)[1]

    def recenter(self, map_T_lidar: gtsam.Pose3, reach: float | None = None) -> None:
        """Let the windows follow, and choose the maps by the reach of a sweep, metres.

        Raises
        ------
        InputError
            If the pose is not finite, or beyond the voxel grid.
        """
        self._thinned = None  # of other cubes, after a sweep that was not inserted
        for cubes in (*self._open, *self._small):
            cubes.recenter(map_T_lidar.translation())
        if reach is None:
            return
        was_small, limit = self.small, self.config.map.small_below
        self.small = reach < (_OPEN * limit if was_small else limit)
        if self.small and not was_small:
            for small, cubes in zip(self._small, self._open, strict=True):
                small.fill(cubes)

    def insert(
        self,
        posed: PosedSweep,
        map_T_middle: gtsam.Pose3,
        keyframe: int,
        matches: ScanMatches | None = None,
    ) -> None:
        """Add a sweep as points of a keyframe; its last matches tell both sides of walls apart."""
        edges, planes = (transform(map_T_middle.matrix(), points) for points in posed.points)
        order, faces = any_order(len(planes)), None if matches is None else matches.faces
        edges, planes = edges[any_order(len(edges))], planes[order]
        if faces is not None:
            faces = faces._replace(rows=order.argsort()[faces.rows])
        kept = (self._open, self._small)[: 1 + self.small]
        for edge_map, plane_map in kept:
            edge_map.owner = plane_map.owner = keyframe
            edge_map.insert(edges)  # which has no side: a corner shows from both
            plane_map.insert(planes, map_T_middle.translation(), faces)
        self._thinned = None

    def sorted_on_trial(self, sweeps: Sequence[tuple[PosedSweep, gtsam.Pose3]]) -> TrialPoints:
        """Points of sweeps at their poses, sorted once for several :meth:`insert_on_trial`."""
        moved = [
            [transform(pose.matrix(), points) for points in posed.points] for posed, pose in sweeps
        ]
        origins = np.array([pose.translation() for _, pose in sweeps])
        edges, planes = zip(*moved, strict=True)
        viewed = origins if self.config.map.insertion == "settled" else None
        return _owned(self.edges, edges), _owned(self.planes, planes, viewed)

    def insert_on_trial(self, points: TrialPoints, without: int | None = None) -> None:
        """Add sweeps, ``without`` one of them, to maps that serve one solve and are not kept."""
        for cubes, new in zip((self.edges, self.planes), points, strict=True):
            if new is not None and without is not None:
                new = new.without(without)
            cubes.insert_sorted(new)
        self._thinned = None

    def too_sparse(self, predicted: Prediction) -> str:
        """Why there are too few points around a sweep to solve in; empty if there are enough."""
        pose, solver = predicted.map_T_middle.matrix(), self.config.solver
        maps = self.edges, self.planes
        edges, planes = (cubes.count(cubes.neighbourhood(pose)) for cubes in maps)
        if edges >= solver.min_map_edges and planes >= solver.min_map_planes:
            return ""
        return (
            f"the local map has {edges} edge and {planes} plane points; at least "
            f"{solver.min_map_edges} and {solver.min_map_planes} are needed"
        )

    def points(
        self, moves: Mapping[int, FloatArray] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """All edge and plane points, archived ones included, (E, 3) and (P, 3) metres.

        They are where :meth:`move` would bring them with ``moves``; the map does not change.
        """
        maps = self
        if moves or self.earlier is not None:
            maps = deepcopy(self)
            maps.move(moves or {})
            maps = maps._with_earlier()
        edges, planes = (_points(*pair) for pair in zip(maps._open, maps._small, strict=True))
        return edges, planes

    def layers(self) -> dict[str, CubeMap]:
        """All maps: edges and planes of the open, and of small places; to be looked at."""
        maps = self if self.earlier is None else deepcopy(self)._with_earlier()
        (edges, planes), (small_edges, small_planes) = maps._open, maps._small
        return {
            "edges": edges,
            "planes": planes,
            "small_edges": small_edges,
            "small_planes": small_planes,
        }

    def move(self, moves: Mapping[int, FloatArray]) -> int:
        """Move points with the keyframes they belong to; returns the number of points moved.

        ``moves`` holds (4, 4) rigid transforms in the frame of the map, by number of the keyframe.
        """
        self._thinned = None
        for cubes in self._small:
            cubes.move(moves)
        earlier = 0 if self.earlier is None else self.earlier.move(moves)
        return earlier + sum(cubes.move(moves) for cubes in self._open)

    def _with_earlier(self) -> MapPair:
        """These maps themselves, with the points of earlier pieces in voxels that are free."""
        if self.earlier is not None:
            earlier, self.earlier = self.earlier._with_earlier(), None
            kinds = zip((*self._open, *self._small), (*earlier._open, *earlier._small), strict=True)
            for cubes, before in kinds:
                cubes.fill(before, archived=True)
        return self

    def thinned(self, factor: float) -> CubeMap:
        """The planes with voxels larger by a factor, the same at every call; made once a sweep."""
        if self._thinned is None:
            self._thinned = self.planes.thinned(factor)
        return self._thinned


def _owned(
    cubes: CubeMap, sweeps: Sequence[FloatArray], origins: FloatArray | None = None
) -> SortedPoints | None:
    """Points of sweeps, each owned by the number of its sweep, and seen from its origin."""
    counts = [len(sweep) for sweep in sweeps]
    points = np.concatenate([sweep[any_order(len(sweep))] for sweep in sweeps])
    owners = np.arange(len(sweeps)).repeat(counts)
    tags = tags_of(len(points), owners)
    if origins is not None:
        look(tags, points, origins[owners])
    return cubes.sorted(CubePoints(points, tags))


def _points(cubes: CubeMap, small: CubeMap) -> FloatArray:
    """(N, 3) all points of small places, and those that only the map of the open holds."""
    if small.count() or small.stats.archived:
        whole = deepcopy(small)
        whole.fill(cubes, archived=True)
        cubes = whole
    return cubes.points(archived=True)


@dataclass(frozen=True, eq=False)
class FrameMatcher(Matcher):
    """The matches of one sweep, de-skewed for one motion, with the maps as they are."""

    posed: PosedSweep
    maps: MapPair  # which must not change while the matcher is in use
    config: Config
    matching: MatchingConfig
    rows: ChosenRows
    last: Moment | None  # middle of the last sweep, from which ``deskewed`` takes the motion
    inertial: InertialPrediction | None  # from which it takes the velocity instead
    refine: bool  # whether ``deskewed`` changes anything
    accelerations: Expected | None  # that change the velocity; None if it is constant
    clock: Clock  # books the time of every call on the stage ``match``
    expected: bool = False  # whether poses are where the last motion leads, and not on trial
    told: bool | None = None  # whether the matches tell the motion, if it is free; None: not known

    @classmethod
    def of(
        cls, posed: PosedSweep, maps: MapPair, config: Config, last: Moment | None, clock: Clock,
        *, refine: bool = True, expected: bool = False,
        inertial: InertialPrediction | None = None, accelerations: Expected | None = None,
    ) -> FrameMatcher:  # fmt: skip
        """The matcher with the configured matching and, if it is to ``refine``, de-skew."""
        rows, model = _rows_to_match(posed.sweep, config.matching), config.deskew.model
        refine = refine and model != "predicted"
        steady, matching = accelerations if model == "linear" else None, config.matching
        return cls(
            posed, maps, config, matching, rows, last, inertial, refine, steady, clock, expected
        )

    @property
    def offered(self) -> int:
        """Number of features that are matched if all find a match."""
        return len(self.rows)

    def __call__(self, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        """Search for the matches at a pose."""
        self.clock.lap("solve")
        matches = self._search(map_T_lidar)
        self.clock.lap("match")
        return matches

    def again(self, matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        """The matches at a further pose: those of the last search, if it was near by."""
        search = matches.search
        if search is None:
            return self(map_T_lidar)
        self.clock.lap("solve")
        step = search.map_T_lidar.localCoordinates(map_T_lidar)
        turned, shifted = np.degrees(np.linalg.norm(step[:3])), np.linalg.norm(step[3:])
        config = self.matching
        if turned < config.keep_rotation_deg and shifted < config.keep_translation:
            search = self._brought(search)
            found = replace(rematched(search.found, map_T_lidar, config), search=search)
        else:
            found = self._search(map_T_lidar)
        self.clock.lap("match")
        return found

    @property
    def motion_is_free(self) -> bool:
        """Whether the motion within the sweep is solved for, because no IMU tells it."""
        sweep, last = self.posed.sweep, self.last
        alone = self.inertial is None and sweep.motion is SweepMotion.CONSTANT_VELOCITY
        known = self.accelerations is not None and last is not None and sweep.stamp > last.stamp
        return self.refine and alone and known

    def deskewed(self, map_T_lidar: gtsam.Pose3, matches: ScanMatches) -> FrameMatcher:
        """The matcher of the sweep de-skewed with the motion that leads to a pose."""
        if not self.refine:
            return self
        matcher = replace(self, told=self._tells(matches, map_T_lidar))
        return replace(matcher, posed=matcher.posed_at(map_T_lidar, matches))

    def posed_at(self, map_T_lidar: gtsam.Pose3, matches: ScanMatches | None) -> PosedSweep:
        """The sweep, de-skewed with the motion that leads to a pose; matches may tell of it.

        The path through the last middle and this one is a parabola if the motion is free.
        """
        twist, sweep = self.twist_to(map_T_lidar), self.posed.sweep
        if not self.motion_is_free:
            return sweep.at(twist)
        assert self.last is not None
        assert self.accelerations is not None
        interval = self.last.seconds_to(sweep.stamp)
        usual = self.accelerations.at(self.last.stamp, interval, twist)
        solved = twist + 0.5 * interval * usual
        # Middles closer than a sweep is long tell little of the path within it.
        span = max(interval, sweep.duration)
        if matches is not None and self._tells(matches, map_T_lidar):
            solved = self._solved_twist(map_T_lidar, matches, solved, span)
        return sweep.accelerated(2.0 / span * (solved - twist)).at(solved)

    def twist_to(self, map_T_lidar: gtsam.Pose3) -> FloatArray:
        """(6,) mean body velocity that leads to a pose."""
        posed, noise = self.posed, self.config.features.range_noise
        return twist_to(posed.sweep, self.last, self.inertial, map_T_lidar, posed.twist, noise)

    def _tells(self, matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> bool:
        """Whether the matches tell the motion within the sweep."""
        if matches.search is None or not self.motion_is_free:
            return False
        if self.told is not None:
            return self.told
        return tells_motion(localizability(matches, map_T_lidar), self.config.solver)

    def _solved_twist(
        self, map_T_lidar: gtsam.Pose3, matches: ScanMatches, expected: FloatArray, span: float
    ) -> FloatArray:
        """(6,) body velocity in the middle of the sweep, by the matches and the expected one.

        ``span`` is the seconds in which the velocity changes by twice what it is above the mean.
        """
        assert self.last is not None
        assert self.accelerations is not None
        assert matches.search is not None
        config, sweep = self.config, self.posed.sweep
        rows, seconds = timed_rows(matches, sweep, config.solver)
        missed = 0.5 * self.last.seconds_to(sweep.stamp) * np.sqrt(self.accelerations.variances)
        twist, noise = matches.search.posed.twist, config.features.range_noise
        return solved_twist(
            rows, matches.tilts, seconds, map_T_lidar, twist, expected, missed, noise, span=span
        )

    def moving_at(self, twist: FloatArray) -> FrameMatcher:
        """The matcher of the sweep de-skewed for a (6,) body velocity, and for no other."""
        return replace(self, posed=self.posed.sweep.at(twist), refine=False)

    def with_few_matches(self) -> FrameMatcher:
        """The matcher that tries a pose quickly."""
        matching = trial_matching(self.config.matching)
        return replace(self, matching=matching, rows=_rows_to_match(self.posed.sweep, matching))

    def _brought(self, search: Search) -> Search:
        """The search with its points de-skewed as those of this matcher."""
        if search.posed is self.posed:
            return search
        e, p = search.found.edges, search.found.planes
        edges, planes = self.posed.rows(e.indices, p.indices)
        e, p = replace(e, points=edges), replace(p, points=planes)
        found = ScanMatches(e, p, faces=search.found.faces)
        return replace(search, posed=self.posed, found=found)

    def _search(self, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        features = *self.posed.rows(self.rows.edges, self.rows.planes), map_T_lidar
        maps, config = (self.maps.edges, self.maps.planes), self.matching
        matches = match_features(*features, *maps, config, self.rows, expected=self.expected)
        if config.wide_search > 1.0 and self.maps.planes.count() < _THIN:
            matches = self._with_wide_planes(matches, map_T_lidar)
        return replace(matches, search=Search(map_T_lidar, self.posed, matches))

    def _with_wide_planes(self, matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        """The matches, and wider planes for the plane features that have none near by.

        In a map of a few sweeps the five points nearest to a point of the ground lie on one ring,
        and make no plane. Seen more coarsely, there are others among them. They are of use where
        planes near by are few, or where they tell of a translation that these leave open.
        """
        config, near = self.matching, matches.planes
        few, fixed = len(near) < _FEW * len(self.rows.planes), translations_fixed(near)
        if not few and (fixed >= config.wide_below).all():
            return matches
        left = np.setdiff1d(self.rows.planes, near.indices, assume_unique=True)
        _, points = self.posed.rows(self.rows.edges[:0], left)
        coarse = self.maps.thinned(config.wide_search)
        pose, planes = map_T_lidar.matrix(), self.maps.planes
        wide = match_wide_surfaces(points, pose, coarse, planes, config)
        both = joined(near, replace(wide, indices=left[wide.indices]))
        closed = (translations_fixed(both) >= config.wide_below) > (fixed >= config.wide_below)
        return replace(matches, planes=both) if few or closed.any() else matches


def _rows_to_match(sweep: MovingSweep, matching: MatchingConfig) -> ChosenRows:
    known = sweep.distinct, sweep.alone, sweep.edge_sigmas, sweep.level_rings
    return chosen_rows(sweep.n_edges, sweep.n_planes, matching, *known)


@dataclass(frozen=True, eq=False)
class Frame:
    """A sweep that is to be solved for."""

    matcher: FrameMatcher  # de-skewed with the predicted motion
    predicted: Prediction
    lasting: Sequence[gtsam.NonlinearFactor] = ()
    """On the pose at the middle of the sweep, wherever the sweep before was."""
    since_last: Sequence[gtsam.NonlinearFactor] = ()
    """On the same pose, by that of the sweep before."""

    @property
    def priors(self) -> list[gtsam.NonlinearFactor]:
        """All factors on the pose at the middle of the sweep."""
        return [*self.lasting, *self.since_last]

    @property
    def sweep(self) -> MovingSweep:
        """The sweep."""
        return self.matcher.posed.sweep

    def solve(self, solver: ScanSolver, more: Sequence[gtsam.NonlinearFactor] = ()) -> Solution:
        """The pose at the middle of the sweep, from the predicted one, with more factors on it."""
        start, factors = self.predicted.map_T_middle, [*self.priors, *more]
        return solver.solve(self.matcher, start, factors, self.predicted.motion)

    def posed_for(self, solution: Solution) -> PosedSweep:
        """The sweep, de-skewed with the motion that belongs to a solution."""
        matcher, seen = self.matcher, solution.localizability
        if seen is not None and matcher.motion_is_free:  # saves looking again
            matcher = replace(matcher, told=tells_motion(seen, matcher.config.solver))
        matches = solution.matches if solution.solved else None
        return matcher.posed_at(solution.map_T_lidar, matches)
