"""The first fix: where in a saved map a sweep was taken, without any idea before.

Registrations begin at the likeliest positions and headings around the places that look like the
sweep (Scan Context). One sweep is not believed: :mod:`loam_gtsam.maps.hypotheses` follows what is
found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.loops.places import Place
from loam_gtsam.loops.scan_context import compare_descriptors, heading_free_key, scan_context
from loam_gtsam.maps.saved_maps import SavedMaps
from loam_gtsam.registration.frame_matcher import FrameMatcher
from loam_gtsam.registration.matches import ScanMatches, subset
from loam_gtsam.registration.relocalization import Fit, likely_poses, same, sample_features
from loam_gtsam.registration.relocalization.fits import AS_WELL
from loam_gtsam.registration.report import Clock
from loam_gtsam.registration.solvers import GtsamSolver
from loam_gtsam.types import FloatArray

_ALIKE = 40  # number of places with the most similar heading-free keys that are compared in full
_TRIES = 6  # number of places that are tried
_STARTS = 18  # number of poses around all of these at which a registration starts
_NEAR_STARTS = 3  # the same around one pose
_NEAR = (0.03, 0.2)  # metres and degrees: a smaller step ends a trial
_LEVEL = 0.7  # cosine between normal and up above which a plane is level


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pose at which a sweep fits the map.

    Attributes
    ----------
    map_T_middle : pose at the middle of the sweep
    fit : of the features off level ground
    """

    map_T_middle: gtsam.Pose3
    fit: Fit


class PlaceSearch:
    """Looks for a sweep in a whole saved map.

    Parameters
    ----------
    places : of the map
    maps : its cubes
    config : of the mapper
    """

    def __init__(self, places: Sequence[Place], maps: SavedMaps, config: Config) -> None:
        self._places, self._maps, self._config = places, maps, config
        keys = [heading_free_key(place.descriptor.astype(np.float64)) for place in places]
        self._tree = cKDTree(np.array(keys).reshape(-1, config.loops.rings))
        near = {"translation_tolerance": _NEAR[0], "rotation_tolerance_deg": _NEAR[1]}
        self._solver = GtsamSolver(config.solver.changed(**near))

    def find(
        self, posed: PosedSweep, reach: float, near: gtsam.Pose3 | None = None
    ) -> list[Candidate]:
        """The poses that fit the map, no two of them near each other, the best first.

        ``near`` is a further pose, if there is one, around which the sweep is looked for; ``reach``
        is that of its features.
        """
        edges, planes = posed.points
        if not self._places or not len(edges) + len(planes):
            return []
        alike = self._alike(np.concatenate([edges, planes]))
        centres = alike if near is None else [*alike, near]
        return self._registered(posed, centres, self._config.loops.search, reach, _STARTS)

    def around(
        self,
        posed: PosedSweep,
        map_T_middle: gtsam.Pose3,
        radius: float,
        reach: float,
        most_turn: float = np.pi,
    ) -> list[Candidate]:
        """The poses within a radius, metres, at which registrations of the sweep end."""
        return self._registered(posed, [map_T_middle], radius, reach, _NEAR_STARTS, most_turn)

    def _registered(
        self,
        posed: PosedSweep,
        centres: Sequence[gtsam.Pose3],
        radius: float,
        reach: float,
        count: int,
        most_turn: float = np.pi,
    ) -> list[Candidate]:
        """Where registrations end that begin at the likeliest poses around some centres."""
        maps, held = self._maps, []
        for centre in centres:
            maps.recenter(centre, reach)
            layers, near = (maps.edges, maps.planes), centre.matrix()
            parts = [cubes.points(cubes.surroundings(near)) for cubes in layers]
            held.append(np.concatenate(parts))
        sample = sample_features(*posed.points)
        starts = likely_poses(sample, held, centres, radius, count, most_turn, least=AS_WELL)
        whole = FrameMatcher.of(posed, maps, maps.config, None, Clock(), refine=False)
        trial, found = whole.with_few_matches(), []
        # Place by place, so that each cube is read once.
        for start in sorted(starts, key=lambda s: np.argmin([s.range(c) for c in centres])):
            maps.recenter(start, reach)
            solution = self._solver.solve(trial, start)
            if solution.solved:
                fit = standing_fit(solution.matches, trial.offered, solution.map_T_lidar)
                found.append(Candidate(solution.map_T_lidar, fit))
        return distinct(found)

    def _alike(self, points: FloatArray) -> list[gtsam.Pose3]:
        """Poses at the places that look most alike."""
        own, places = scan_context(points, self._config.loops), self._places
        _, near = self._tree.query(heading_free_key(own), k=min(_ALIKE, len(places)))
        compared = []
        for number in np.sort(np.atleast_1d(near)).tolist():
            descriptor = places[number].descriptor.astype(np.float64)
            compared.append((*compare_descriptors(descriptor, own), number))
        chosen: list[gtsam.Pose3] = []
        for _, turn, number in sorted(compared):
            place = places[number].map_T_middle
            if all(place.range(other) > self._config.loops.search for other in chosen):
                chosen.append(place.compose(gtsam.Pose3(gtsam.Rot3.Yaw(turn), np.zeros(3))))
            if len(chosen) == _TRIES:
                break
        return chosen


def distinct(candidates: list[Candidate]) -> list[Candidate]:
    """The best of those that are near each other, the best first."""
    chosen: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda c: -c.fit.total):
        if not any(same(candidate.map_T_middle, other.map_T_middle) for other in chosen):
            chosen.append(candidate)
    return chosen


def standing_fit(matches: ScanMatches, offered: int, map_T_lidar: gtsam.Pose3) -> Fit:
    """Fit of edges and of planes that are not level, of so many features.

    Level ground fits at any heading. Up is that of the lidar: a map need not have one.
    """
    up = map_T_lidar.rotation().matrix()[:, 2]
    standing = np.abs(matches.planes.normals @ up) < _LEVEL
    level = int(np.count_nonzero(~standing))
    return Fit.of(ScanMatches(matches.edges, subset(matches.planes, standing)), offered - level)
