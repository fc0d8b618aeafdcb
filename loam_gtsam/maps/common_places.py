"""Common places of saved maps: what is seen from a place of one, found in the others.

No sweeps are read: what a lidar would see at a place is cut out of the map around it, and
registered with what is around a place of another map that looks alike.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import astuple, replace
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.config import Config
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.geometry import inverse_pose, squared_norm, symmetric, transform
from loam_gtsam.loops.closure import Rejection, Verifier, empty_submap
from loam_gtsam.loops.keyframes import Keyframe, LoopClosure, walk
from loam_gtsam.loops.loop_selection import consistent, consistent_set
from loam_gtsam.loops.places import Place
from loam_gtsam.loops.scan_context import compare_descriptors, heading_free_key
from loam_gtsam.maps.map_file import LAYERS, SavedMap
from loam_gtsam.registration.relocalization import same
from loam_gtsam.types import FloatArray, FrameStatus, IntArray, MapUpdate, Uncertainty
from loam_gtsam.voxels.cubes import CubePoints, joined
from loam_gtsam.voxels.tags import views

LEAST = 4
"""Loop closures that agree with each other, below which two maps have no place in common."""
_RIVAL = 0.5
"""Share of these that loop closures which lead elsewhere may reach."""
_APART = 3.0  # keyframe distances between the places that are looked for
_ALIKE = 40  # number of places with the most similar heading-free keys that are compared in full
_CHANGED = 0.75  # share of the matches that agree at a place that is known, and may have changed
_TWINS = 4  # places of its own map at which a place is tried, which must not fit there
_SIGHT = 0.5  # of the reach of the descriptors: what is looked for around a place
_SAME_SIDE = 0.5  # cosine between the views of a point from where it was seen and from a place
_CUBES, _SUBMAPS = 64, 32  # that are kept


class Sight(NamedTuple):
    """Edges (E, 3) and planes (P, 3) of a map around a place, seen from it, in its frame."""

    edges: FloatArray
    planes: FloatArray
    seen_from: FloatArray  # (P, 3) in the direction from which the planes were seen


class Surroundings:
    """What is around the places of a saved map."""

    def __init__(self, saved: SavedMap) -> None:
        self._saved = saved
        self._cube = lru_cache(_CUBES)(saved.cube)

    def around(self, place: Place, radius: float) -> Sight:
        """The points of the map within metres of a place."""
        pose = place.map_T_middle.matrix()
        local = inverse_pose(pose)
        edges, planes = (self._near(layer, pose[:3, 3], radius) for layer in LAYERS[:2])
        seen = views(planes.tags)[:, :3] / 127.0
        away = pose[:3, 3] - planes.points
        along = np.einsum("ni,ni->n", seen, away)
        sizes = np.sqrt(squared_norm(seen.T) * squared_norm(away.T))
        shown = along >= _SAME_SIDE * sizes
        points = transform(local, planes.points[shown])
        return Sight(transform(local, edges.points), points, points + seen[shown] @ local[:3, :3].T)

    def _near(self, layer: str, position: FloatArray, radius: float) -> CubePoints:
        size = self._saved.config.map.cube_size
        reach = radius + 0.5 * size
        near = [
            self._cube(layer, index)
            for index in self._saved.layers[layer]
            if (np.abs(np.array(index) * size - position) <= reach).all()
        ]
        content = joined(near)
        return content.chosen(squared_norm((content.points - position).T) < radius**2)


class CommonPlaces:
    """Looks for the places of some maps in each other; places are numbered through all maps.

    Parameters
    ----------
    maps : must stay open, and have descriptors of one shape
    config : for the registration

    Attributes
    ----------
    places : of all maps
    map_of : (N,) number of the map of each place
    rejected : candidates, by the reason
    """

    def __init__(self, maps: Sequence[SavedMap], config: Config) -> None:
        self._config, self._verifier = config, Verifier(config)
        least = min(config.loops.min_agreement, _CHANGED)
        self._known = Verifier(config.changed(loops=config.loops.changed(min_agreement=least)))
        self.places = [place for saved in maps for place in saved.places]
        self.map_of: IntArray = np.repeat(np.arange(len(maps)), [len(m.places) for m in maps])
        self.rejected: Counter[Rejection] = Counter()
        self._surroundings = [Surroundings(saved) for saved in maps]
        self._descriptors = [place.descriptor.astype(np.float64) for place in self.places]
        self._keys = np.array([heading_free_key(one) for one in self._descriptors])
        self._submap = lru_cache(_SUBMAPS)(self._make_submap)
        self._keyframes = _keyframes(maps)
        self._errors = [error for saved in maps for error in _place_errors(saved)]

    @property
    def stretch(self) -> float:
        """Metres that two drives must have in common for as many loops as are asked for."""
        return LEAST * self._apart

    @property
    def _apart(self) -> float:
        """Metres between the places that are looked for."""
        return _APART * self._config.pose_graph.keyframe_distance

    def looked_for(self) -> list[int]:
        """Places of all maps but the first, some keyframe distances apart."""
        chosen: list[int] = []
        last: tuple[int, gtsam.Pose3] | None = None
        for number, place in enumerate(self.places):
            drive, pose = int(self.map_of[number]), place.map_T_middle
            if drive and (last is None or last[0] != drive or last[1].range(pose) >= self._apart):
                chosen.append(number)
                last = drive, pose
        return chosen

    def find(self, number: int) -> list[LoopClosure]:
        """Where in the maps before its own a place is, as far as its surroundings tell.

        Nowhere if they fit elsewhere in its own map as well: then they tell nothing.
        """
        tries = self._config.loops.tries
        before = np.flatnonzero(self.map_of < self.map_of[number])
        found = self._alike(number, before, tries)
        if not found:
            return []
        pose = self.places[number].map_T_middle
        same_map = np.flatnonzero(self.map_of == self.map_of[number])
        least = 2.0 * self._config.loops.search
        far = [n for n in same_map.tolist() if pose.range(self.places[n].map_T_middle) > least]
        for twin in self._alike(number, np.array(far, np.int64), _TWINS):
            if not same(twin.earlier_T_later, self.places[twin.earlier].map_T_middle.between(pose)):
                return []
        return found

    def _alike(self, number: int, others: IntArray, tries: int) -> list[LoopClosure]:
        """Where a place fits at those of some others that look most alike."""
        if not len(others):
            return []
        _, near = cKDTree(self._keys[others]).query(self._keys[number], k=min(_ALIKE, len(others)))
        descriptor = self._descriptors[number]
        compared = [
            (*compare_descriptors(self._descriptors[other], descriptor), other)
            for other in others[np.sort(np.atleast_1d(near))].tolist()
        ]
        tried: list[int] = []
        found = []
        for unlike, turn, other in sorted(compared):
            if unlike > self._config.loops.max_unlike or len(tried) == tries:
                break
            if any(self._near_by(other, taken) for taken in tried):
                continue
            tried.append(other)
            start = gtsam.Pose3(gtsam.Rot3.Yaw(turn), np.zeros(3))
            loop = self._register(self._verifier, number, other, start, turn)
            found += [] if loop is None else [loop]
        return found

    def register(self, number: int, other: int, other_T_place: gtsam.Pose3) -> LoopClosure | None:
        """The motion from one place to another, of which it is known about where it is."""
        turn = float(other_T_place.rotation().yaw())
        loop = self._register(self._known, number, other, other_T_place, turn)
        return loop if loop is not None and same(loop.earlier_T_later, other_T_place) else None

    def _register(
        self, verifier: Verifier, number: int, other: int, start: gtsam.Pose3, turn: float
    ) -> LoopClosure | None:
        radius = _SIGHT * self._config.loops.reach
        place, home = self.places[number], self._surroundings[self.map_of[number]]
        sight = home.around(place, radius)
        usual = verifier.share(sight.edges, sight.planes, self._submap(number))
        maps = self._submap(other)
        found = verifier.verify(sight.edges, sight.planes, maps, start, turn=turn, usual=usual)
        if isinstance(found, Rejection):
            self.rejected[found] += 1
            return None
        to_place = found.pose.inverse().AdjointMap()
        covariance = (
            found.covariance + self._errors[number] + to_place @ self._errors[other] @ to_place.T
        )
        return LoopClosure(other, number, found.pose, symmetric(covariance), *astuple(found.fit))

    def agreeing(self, loops: Sequence[LoopClosure]) -> tuple[list[LoopClosure], int]:
        """Of loop closures between two maps most that agree, and how many agree otherwise."""
        config = self._config.pose_graph.changed(walk=0.0, turn_walk_deg=0.0)  # which drifts have
        of: dict[int, set[int]] = {number: set() for number in range(len(loops))}
        for one, two in combinations(of, 2):
            if consistent(loops[one], loops[two], self._keyframes, config):
                of[one].add(two)
                of[two].add(one)

        def largest(numbers: set[int]) -> set[int]:
            sets = (consistent_set(one, lambda n: of[n] & numbers) for one in sorted(numbers))
            return max(sets, key=len, default=set())

        most = largest(set(of))
        others = {number for number in set(of) - most if not most <= of[number]}
        return [loops[number] for number in sorted(most)], len(largest(others))

    def _near_by(self, one: int, two: int) -> bool:
        if self.map_of[one] != self.map_of[two]:
            return False
        poses = self.places[one].map_T_middle, self.places[two].map_T_middle
        return bool(poses[0].range(poses[1]) < self._config.loops.search)

    def _make_submap(self, number: int) -> tuple[CubeMap, CubeMap]:
        """Edge and plane map around a place, in its frame."""
        home, place = self._surroundings[self.map_of[number]], self.places[number]
        sight = home.around(place, self._config.loops.reach)
        maps = empty_submap(self._config)
        maps[0].insert(sight.edges)
        maps[1].insert(sight.planes, sight.seen_from)
        return maps


def are_tied(agreeing: int, otherwise: int) -> bool:
    """Whether loop closures between two maps are believed, from how many agree on what."""
    return agreeing >= LEAST and otherwise <= _RIVAL * agreeing


def walked(saved: SavedMap) -> list[LoopClosure]:
    """The links of a map, which may have drifted by more than the run measured."""
    poses, config = [place.map_T_middle for place in saved.places], saved.config.pose_graph
    ways = [poses[link.earlier].range(poses[link.later]) for link in saved.graph.links]
    return [
        replace(link, covariance=link.covariance + walk(way, config))
        for link, way in zip(saved.graph.links, ways, strict=True)
    ]


def _place_errors(saved: SavedMap) -> list[FloatArray]:
    """(6, 6) by which the sweep of each place lies off the map around it, in its axes.

    A motion has the errors of both ends in its covariance.
    """
    found = [np.zeros((6, 6)) for _ in saved.places]
    for link in reversed(saved.graph.links):
        found[link.later] = 0.5 * link.covariance
        if not found[link.earlier].any():
            found[link.earlier] = found[link.later]
    return found


def _keyframes(maps: Sequence[SavedMap]) -> list[Keyframe]:
    """The places as keyframes between which the links have drifted."""
    found: list[Keyframe] = []
    nothing = np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.bool_)
    for session, saved in enumerate(maps):
        poses = [place.map_T_middle for place in saved.places]
        drifts = [np.zeros((6, 6))]
        link_to = {link.later: link for link in walked(saved)}
        for number in range(1, len(poses)):
            drift, link = drifts[-1], link_to.get(number)
            if link is None:  # of another run, which loops tie
                drift = drift + saved.places[number].covariance
            else:
                to_map = poses[number].AdjointMap()
                back = drift - drifts[link.earlier] if link.earlier < number else 0.0
                drift = drift + back + to_map @ link.covariance @ to_map.T
            drifts.append(drift)
        for pose, drift in zip(poses, drifts, strict=True):
            number = len(found)
            error = Uncertainty(np.zeros((6, 6)), np.zeros((6, 6)), None, drift, 1.0, np.inf)
            update = MapUpdate(number, pose, FrameStatus.OK, uncertainty=error)
            found.append(Keyframe(number, update, 0.0, *nothing, session))
    return found
