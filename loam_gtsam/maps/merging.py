"""Saved maps become one: one frame, one pose graph, one file.

The maps are tied by places that they have in common (:mod:`.common_places`), then all motions and
loop closures are solved at once, and the points follow their places.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.aiding.placed_fixes import MAP_KEY, PlacedFixes
from loam_gtsam.config import Config
from loam_gtsam.datasets.decode.geodesy import GeoReference, east_north_up, geodetic_of
from loam_gtsam.errors import check_all
from loam_gtsam.geometry import symmetric, transform_each
from loam_gtsam.loops.batch import OptimizedGraph, SavedGraph, optimize_graph
from loam_gtsam.loops.keyframes import LoopClosure, pose_key
from loam_gtsam.loops.places import Place
from loam_gtsam.loops.pose_graph import corrected_trajectory
from loam_gtsam.maps.common_places import CommonPlaces, are_tied, walked
from loam_gtsam.maps.linear_factors import LinearFactors
from loam_gtsam.maps.map_file import SavedMap, grids, write_map
from loam_gtsam.maps.map_graph import MapGraph
from loam_gtsam.types import (
    DatasetError,
    InputError,
    MapUpdate,
    Trajectory,
    stack_poses,
)
from loam_gtsam.voxels.archive import Archive
from loam_gtsam.voxels.cubes import CubePoints, joined
from loam_gtsam.voxels.grid import CubeIndex
from loam_gtsam.voxels.tags import turn

_LIKELY = 12.0
"""Mean squared Mahalanobis distance of the loops from all other motions, up to which the runs have
drifted as their covariances say: twice the six freedoms."""
_ASIDE = 100.0  # metres that fixes of one map may all be wrong by

Pair = tuple[int, int]
"""Numbers of two maps, the lower one first."""


@dataclass(frozen=True, slots=True, eq=False)
class MergedMaps:
    """Maps in one frame, that of the first of them.

    Attributes
    ----------
    graph : places of all maps, one map after the other, where all motions have them
    starts : number of the first place of each map
    before : the places as they were in their maps
    ties : loop closures between the maps, by pair
    unused : of these, how many contradicted the others
    earth : where the whole is on the earth; None if no map was tied to it
    """

    graph: MapGraph
    starts: tuple[int, ...]
    before: Sequence[Place]
    ties: Mapping[Pair, int]
    unused: int
    earth: GeoReference | None = None

    def places(self, number: int) -> Sequence[Place]:
        """Places of a map."""
        return self.graph.places[self._rows(number)]

    def trajectory(self, number: int, updates: Sequence[MapUpdate] | None = None) -> Trajectory:
        """The way of the run that made a map, corrected.

        Parameters
        ----------
        number : of the map
        updates : frames of that run; without them the poses are those of the places
        """
        places = self.places(number)
        if updates is None:
            return Trajectory.from_poses(
                [p.stamp for p in places], [p.map_T_middle for p in places]
            )
        then = {update.stamp: update for update in updates if update.map_T_middle is not None}
        known = []
        for place in places:
            middle = then[place.stamp].map_T_middle if place.stamp in then else None
            if middle is not None:
                known.append((place.stamp, place.map_T_middle.compose(middle.inverse())))
        if not known:
            raise InputError(f"updates: expected the frames of the run of map {number}, got others")
        return corrected_trajectory(updates, known)

    def _rows(self, number: int) -> slice:
        return slice(*(*self.starts, len(self.graph.places))[number : number + 2])


def merge_maps(
    maps: Sequence[SavedMap],
    path: str | Path,
    config: Config | None = None,
    on_place: Callable[[int, int], None] | None = None,
) -> MergedMaps:
    """Join maps that have places in common, and write them as one.

    Parameters
    ----------
    maps : two or more; the frame and the configuration of the first are those of the whole
    path : of the new file
    config : of the registration; that of the first map if None
    on_place : called with how many places were looked for, and of how many

    Raises
    ------
    InputError
        If there are less than two maps.
    DatasetError
        If a map has no place in common with the others or is one of them, its descriptors are of
        another shape, or its fixes are somewhere else on the earth.
    OutputError
        If the file cannot be written.
    """
    if len(maps) < 2:
        raise InputError(f"merge: expected two maps or more, got {len(maps)}")
    check_all(maps, SavedMap, "maps", "SavedMap(path) opens one")
    config = config or maps[0].config
    _check(maps)
    common = CommonPlaces(maps, config)
    ties = _tied(maps, common, on_place or (lambda done, total: None))
    starts = np.cumsum([0, *(len(saved.places) for saved in maps[:-1])]).tolist()
    whole = _Whole(maps, starts, common, config)
    sure = [loop for loops in ties.values() for loop in loops]
    first = whole.solve(sure)
    whole.take_fixes(first, sure)
    loops = [loop for pair, held in ties.items() for loop in whole.more(pair, held, first)]
    solved = whole.solve(loops, walk=False)
    if not (_agree(solved) and whole.fixes_agree(solved)):
        solved = whole.solve(loops)
    used = [report.active for report in solved.loops[-len(loops) :]]
    merged = whole.merged(solved, [loop for loop, on in zip(loops, used, strict=True) if on])
    _connected(maps, list(merged.ties), common.stretch)
    contents = _moved(maps, merged)
    frame = replace(maps[0].frame, earth=merged.earth)
    write_map(path, contents, merged.graph, maps[0].config, frame)
    return replace(merged, unused=len(used) - sum(used))


def _check(maps: Sequence[SavedMap]) -> None:
    shapes = [(loops.rings, loops.sectors, loops.reach) for loops in (m.config.loops for m in maps)]
    for saved, shape in zip(maps, shapes, strict=True):
        if shape != shapes[0]:
            raise DatasetError(
                f"{saved.path}: expected place descriptors as those of {maps[0].path}, with "
                f"loops.rings, sectors and reach {shapes[0]}, got {shape}; map one of the two again"
            )
        if not saved.places:
            raise DatasetError(f"{saved.path}: the map has no places; map more of the ground")
    for one, other in combinations(maps, 2):
        if _are_one(one, other):
            raise DatasetError(
                f"{other.path}: expected another map, got that of {one.path} once more; its drift "
                "would count as confirmed"
            )


def _are_one(one: SavedMap, other: SavedMap) -> bool:
    """Whether two maps are of the same sweeps at the same places."""
    if [place.stamp for place in one.places] != [place.stamp for place in other.places]:
        return False
    ours, theirs = (stack_poses(p.map_T_middle for p in m.places) for m in (one, other))
    return np.array_equal(ours, theirs) and one.layers == other.layers


def _tied(
    maps: Sequence[SavedMap], common: CommonPlaces, on_place: Callable[[int, int], None]
) -> dict[Pair, list[LoopClosure]]:
    """Loop closures between the maps, by pair, of pairs that have common places for sure."""
    found: dict[Pair, list[LoopClosure]] = {}
    wanted = common.looked_for()
    for done, number in enumerate(wanted, 1):
        for loop in common.find(number):
            pair = int(common.map_of[loop.earlier]), int(common.map_of[number])
            found.setdefault(pair, []).append(loop)
        on_place(done, len(wanted))
    ties, doubtful = {}, {}
    for pair, loops in sorted(found.items()):
        most, otherwise = common.agreeing(loops)
        doubtful[pair] = len(most), otherwise
        if are_tied(*doubtful[pair]):
            ties[pair] = most
    _connected(maps, list(ties), common.stretch, doubtful)
    return ties


def _agree(solved: OptimizedGraph) -> bool:
    """Whether all loops agree, and are off by no more than their covariances say."""
    distances = [report.chi_squared for report in solved.loops]
    return all(report.active for report in solved.loops) and float(np.mean(distances)) <= _LIKELY


def _connected(
    maps: Sequence[SavedMap], pairs: Sequence[Pair], stretch: float,
    found: Mapping[Pair, Pair] | None = None,
) -> None:  # fmt: skip
    """Raise a DatasetError if some map is not tied to the first one, by way of others or not."""
    reached = _order(pairs)
    for number in range(len(maps)):
        if number in reached:
            continue
        tried = [
            f"{maps[sum(pair) - number].path}: {most} loops agree, {others} lead elsewhere"
            for pair, (most, others) in (found or {}).items()
            if number in pair
        ]
        raise DatasetError(
            f"{maps[number].path}: no place of it is for sure in the other maps"
            + (f" ({'; '.join(tried)})" if tried else "")
            + f"; the drives must have a stretch in common, of some {stretch:.0f} metres or more"
        )


def _order(pairs: Sequence[Pair]) -> dict[int, Pair | None]:
    """Maps in an order in which each is tied to one before it, by which pair."""
    reached: dict[int, Pair | None] = {0: None}
    for _ in pairs:
        for pair in pairs:
            for one, two in (pair, pair[::-1]):
                if one in reached and two not in reached:
                    reached[two] = pair
    return reached


class _Whole:
    """The pose graphs of all maps as one."""

    def __init__(
        self, maps: Sequence[SavedMap], starts: Sequence[int], common: CommonPlaces, config: Config
    ) -> None:
        self._maps, self._starts, self._common, self._config = maps, starts, common, config
        of_map = zip(maps, starts, strict=True)
        found = [
            ([_numbered(link, start) for link in saved.graph.links],
             [_numbered(link, start) for link in walked(saved)],
             [_numbered(loop, start) for loop in saved.graph.loops])
            for saved, start in of_map
        ]  # fmt: skip
        self._links, self._walked, self._loops = (
            [one for motions in kind for one in motions] for kind in zip(*found, strict=True)
        )
        self._before = common.places
        self._fixes: PlacedFixes | None = None

    def solve(self, ties: Sequence[LoopClosure], *, walk: bool = True) -> OptimizedGraph:
        """All places where links, loop closures of the maps, and those between them have them.

        ``walk`` allows for drift that the runs did not know of.
        """
        links = self._walked if walk else self._links
        frames = self._frames(ties)
        of_map = zip(self._common.map_of.tolist(), self._before, strict=True)
        places = [replace(p, map_T_middle=frames[of].compose(p.map_T_middle)) for of, p in of_map]
        loops = [*self._loops, *ties]
        graph = MapGraph(places, links, loops, own=self._own(frames)).held()
        if self._fixes is not None:
            self._add(self._fixes, graph, frames)
        return optimize_graph(graph, max_chi2=self._config.pose_graph.max_chi2)

    def take_fixes(self, solved: OptimizedGraph, ties: Sequence[LoopClosure]) -> None:
        """Use the fixes from now on, with offsets of receivers that contradict each other.

        Such fixes would else outvote the loops between their maps. A DatasetError if they are
        farther apart than receivers are wrong.
        """
        fixes = _fixes_of(self._maps, self._starts)
        if fixes is None:
            return
        factors = gtsam.NonlinearFactorGraph(solved.factors)
        graph = SavedGraph(factors, gtsam.Values(solved.poses), closures=())
        self._add(fixes, graph, self._frames(ties))
        offsets = fixes.offsets(optimize_graph(graph).poses)
        metres = np.linalg.norm(offsets, axis=1)
        if metres.max() > _ASIDE:
            pose = fixes.poses[fixes.receivers == metres.argmax()][0]
            raise DatasetError(
                f"{self._maps[self._common.map_of[pose]].path}: its fixes lie {metres.max():.0f} m "
                "beside those of the other maps, as the places that they have in common tell; is "
                "it somewhere else that looks the same? If not, map it again without aiding.gnss"
            )
        self._fixes = fixes.allowing_for(offsets)

    def _add(
        self, fixes: PlacedFixes, graph: SavedGraph, frames: Mapping[int, gtsam.Pose3]
    ) -> None:
        """Add fixes to a graph, and where the first map is on the earth by those of one map."""
        number, earth = _on_earth(self._maps)[0]
        enu_T_map = gtsam.Pose3(earth.enu_T_map).compose(frames[number].inverse())
        graph.factors.push_back(fixes.factors(self._maps[0].frame.up))
        graph.poses.insert(fixes.start(enu_T_map))

    def _own(self, frames: Mapping[int, gtsam.Pose3]) -> LinearFactors | None:
        """A user's own factors in all maps, whose frames are about there in that of the first."""
        found = [
            own if number == 0 else own.within(frames[number], saved.places, start)
            for number, (saved, start) in enumerate(zip(self._maps, self._starts, strict=True))
            if (own := saved.graph.own) is not None
        ]
        return LinearFactors.joined(found) if found else None

    def fixes_agree(self, solved: OptimizedGraph) -> bool:
        """Whether the fixes, if there are any, are off by no more than their covariances say."""
        squared = np.zeros(1) if self._fixes is None else self._fixes.squared(solved.poses)
        return float(np.mean(squared)) <= 0.5 * _LIKELY  # with half of the freedoms of a loop

    def _frames(self, ties: Sequence[LoopClosure]) -> dict[int, gtsam.Pose3]:
        """Frames of all maps in that of the first, by one tie for each of the others."""
        map_of, before = self._common.map_of, self._before
        by_pair: dict[Pair, LoopClosure] = {}
        for tie in ties:
            by_pair.setdefault((int(map_of[tie.earlier]), int(map_of[tie.later])), tie)
        frames = {0: gtsam.Pose3()}
        for number, pair in _order(list(by_pair)).items():
            if pair is None:
                continue
            tie = by_pair[pair]
            one, two = before[tie.earlier].map_T_middle, before[tie.later].map_T_middle
            motion = one.compose(tie.earlier_T_later).compose(two.inverse())
            known = pair[0] if number == pair[1] else pair[1]
            motion = motion if number == pair[1] else motion.inverse()
            frames[number] = frames[known].compose(motion)
        return frames

    def more(
        self, pair: Pair, held: Sequence[LoopClosure], solved: OptimizedGraph
    ) -> list[LoopClosure]:
        """Loop closures of all places that two maps have in common, now that it is known where."""
        rows = [np.flatnonzero(self._common.map_of == number).tolist() for number in pair]
        poses = [[solved.poses.atPose3(pose_key(n)) for n in numbers] for numbers in rows]
        tree = cKDTree([pose.translation() for pose in poses[0]])
        loops, tied = list(held), {loop.later for loop in held}
        for number, pose in zip(rows[1], poses[1], strict=True):
            away, at = tree.query(pose.translation())
            if number in tied or away > self._config.loops.search:
                continue
            motion = poses[0][int(at)].between(pose)
            loop = self._common.register(number, rows[0][int(at)], motion)
            loops += [] if loop is None else [loop]
        return loops

    def merged(self, solved: OptimizedGraph, ties: Sequence[LoopClosure]) -> MergedMaps:
        """The places where they were solved to be, and the ties that were used."""
        marginals = gtsam.Marginals(solved.factors, solved.poses)
        places = []
        for number, place in enumerate(self._before):
            pose = solved.poses.atPose3(pose_key(number))
            to_map = pose.AdjointMap()
            covariance = to_map @ marginals.marginalCovariance(pose_key(number)) @ to_map.T
            placed = replace(place, map_T_middle=pose, covariance=symmetric(covariance))
            places.append(placed)
        active = [report.active for report in solved.loops[: len(self._loops)]]
        loops = [loop for loop, on in zip(self._loops, active, strict=True) if on]
        map_of = self._common.map_of
        counts: dict[Pair, int] = {}
        for tie in ties:
            pair = int(map_of[tie.earlier]), int(map_of[tie.later])
            counts[pair] = counts.get(pair, 0) + 1
        frames = {
            number: places[start].map_T_middle.compose(self._before[start].map_T_middle.inverse())
            for number, start in enumerate(self._starts)
        }
        graph = MapGraph(places, self._links, [*loops, *ties], self._fixes, self._own(frames))
        earth = None
        if self._fixes is not None:
            origin, enu_T_map = _on_earth(self._maps)[0][1].origin, solved.poses.atPose3(MAP_KEY)
            covariance = np.asarray(marginals.marginalCovariance(MAP_KEY))
            earth = GeoReference(origin, enu_T_map.matrix(), covariance)
        return MergedMaps(graph, tuple(self._starts), self._before, counts, 0, earth)


def _on_earth(maps: Sequence[SavedMap]) -> list[tuple[int, GeoReference]]:
    """Numbers of the maps that have fixes, and where each is by them."""
    frames = [(n, saved.frame.earth) for n, saved in enumerate(maps) if saved.graph.fixes]
    return [(number, earth) for number, earth in frames if earth is not None]


def _fixes_of(maps: Sequence[SavedMap], starts: Sequence[int]) -> PlacedFixes | None:
    """The fixes of all maps, east, north and up of the origin of the first that has some."""
    parts: list[PlacedFixes] = []
    receivers = 0
    tied = _on_earth(maps)
    for number, earth in tied:
        fixes = maps[number].graph.fixes
        assert fixes is not None
        enu = east_north_up(geodetic_of(fixes.enu, earth.origin), tied[0][1].origin)
        poses, owners = fixes.poses + starts[number], fixes.receivers + receivers
        parts.append(replace(fixes, poses=poses, enu=enu, receivers=owners))
        receivers += len(fixes.antennas)
    return PlacedFixes.joined(parts) if parts else None


def _numbered(motion: LoopClosure, start: int) -> LoopClosure:
    return replace(motion, earlier=motion.earlier + start, later=motion.later + start)


def _moved(maps: Sequence[SavedMap], merged: MergedMaps) -> dict[str, dict[CubeIndex, CubePoints]]:
    """Points of all maps, which follow their places; a voxel keeps the point of an earlier map."""
    after = [place.map_T_middle for place in merged.graph.places]
    before = [place.map_T_middle for place in merged.before]
    pairs = zip(after, before, strict=True)
    moves = np.array([to.compose(at.inverse()).matrix() for to, at in pairs])
    contents = {}
    for layer, grid in grids(maps[0].config).items():
        archive = Archive(grid, np.inf, None)
        for saved, start in zip(maps, merged.starts, strict=True):
            content = joined([saved.cube(layer, index) for index in saved.layers[layer]])
            content.tags[:, 0] += start
            order = np.argsort(content.tags[:, 0], kind="stable")
            archive.settle(_carried(content.chosen(order), moves))
        contents[layer] = dict(sorted(archive.contents()))
    return contents


def _carried(content: CubePoints, moves: np.ndarray) -> CubePoints:
    """Points where the moves (N, 4, 4) of their owners bring them."""
    move = moves[content.tags[:, 0]]
    tags = content.tags.copy()
    turn(tags, move[:, :3, :3])
    return CubePoints(transform_each(move, content.points), tags)
