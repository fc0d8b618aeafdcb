"""The first fix: where in a saved map a sweep was taken, without any idea before.

Registrations begin at the likeliest positions and headings around the places that look like the
sweep (Scan Context). One sweep is not believed: :mod:`loam_gtsam.maps.hypotheses` follows what is
found.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.config import Config
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.loops.places import Place
from loam_gtsam.loops.scan_context import compare_descriptors, heading_free_key, scan_context
from loam_gtsam.maps.saved_maps import SavedMaps
from loam_gtsam.registration.frame_matcher import FrameMatcher
from loam_gtsam.registration.relocalization import (
    Field,
    Fit,
    distinct,
    likely_poses,
    one_per_cell,
    same_optimum,
    sample_features,
)
from loam_gtsam.registration.relocalization.evidence import Evidence, speaks_for
from loam_gtsam.registration.relocalization.fits import AS_WELL, standing_fit
from loam_gtsam.registration.report import Clock
from loam_gtsam.registration.solvers import trial_solver
from loam_gtsam.types import FloatArray
from loam_gtsam.voxels.cubes import NO_POINTS
from loam_gtsam.voxels.grid import CubeIndex

_ALIKE = 40  # number of places with the most similar heading-free keys that are compared in full
_TRIES = 6  # number of places that are tried
_STARTS = 18  # number of poses around all of these at which a registration starts
_AROUND = 6  # number of places around one where a lidar is said to be
_FIELDS = 18  # that are kept, of the places that were tried last


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pose at which a sweep fits the map.

    Attributes
    ----------
    map_T_middle : pose at the middle of the sweep
    fit : of the features off level ground
    evidence : of all features, for and against the pose
    """

    map_T_middle: gtsam.Pose3
    fit: Fit
    evidence: Evidence


class PlaceSearch:
    """Looks for a sweep in a whole saved map.

    Parameters
    ----------
    places : of the map
    maps : its cubes
    config : of the mapper
    inside : whether the lidar is surely in the map
    """

    def __init__(
        self, places: Sequence[Place], maps: SavedMaps, config: Config, *, inside: bool = False
    ) -> None:
        self._places, self._maps, self._config = places, maps, config
        self._inside = inside
        keys = [heading_free_key(place.descriptor.astype(np.float64)) for place in places]
        self._tree = cKDTree(np.array(keys).reshape(-1, config.loops.rings))
        self._held: dict[tuple[CubeMap, CubeIndex], FloatArray] = {}
        self._field = lru_cache(_FIELDS)(self._make_field)
        self._solver = trial_solver(config.solver)

    def find(
        self, posed: PosedSweep, reach: float, known: Sequence[gtsam.Pose3] = ()
    ) -> list[Candidate]:
        """The poses that fit the map, each an optimum of its own, the best first.

        They are where registrations end that begin at the likeliest poses around the places that
        look like the sweep, and at ``known`` poses; ``reach`` is that of its features.
        """
        edges, planes = posed.points
        if not self._places or not len(edges) + len(planes):
            return []
        maps, fields = self._maps, []
        centres = [*self._lookalikes(np.concatenate([edges, planes])), *known]
        for centre in centres:
            maps.recenter(centre, reach)
            fields.append(self._field(tuple(centre.translation().tolist()), maps.small))
        sample = sample_features(edges, planes)
        starts = likely_poses(sample, fields, centres, _STARTS, least=AS_WELL)
        whole = FrameMatcher.of(posed, maps, maps.config, None, Clock(), refine=False)
        trial, found = whole.with_few_matches(), []
        # Place by place, so that each cube is read once.
        for start in sorted(
            [*starts, *known], key=lambda s: np.argmin([s.range(c) for c in centres])
        ):
            maps.recenter(start, reach)
            solution = self._solver.solve(trial, start)
            if solution.solved:
                pose = solution.map_T_lidar
                fit = standing_fit(solution.matches, trial.offered, pose)
                found.append(Candidate(pose, fit, Evidence.of(trial, solution, dense=True)))
        found.sort(key=lambda c: -c.fit.margin)
        found = distinct(found, lambda c: c.map_T_middle)
        against = [sum(self._favoured(other, one) for other in found) for one in found]
        return [found[number] for number in np.argsort(against, kind="stable")]

    def _make_field(self, position: Sequence[float], small: bool) -> Field:
        """Which cells around a position hold points of the maps in use, the ``small`` ones or not.

        The map does not change while a lidar is looked for.
        """
        centre, held = gtsam.Pose3(gtsam.Rot3(), np.array(position)), [NO_POINTS]
        for cubes in (self._maps.edges, self._maps.planes):
            for cube in cubes.surroundings(centre.matrix()):
                if (cubes, cube) not in self._held:
                    self._held[cubes, cube] = one_per_cell(cubes.points([cube]))
                held.append(self._held[cubes, cube])
        return Field.around(np.concatenate(held), centre, self._config.loops.search)

    def _favoured(self, one: Candidate, other: Candidate) -> bool:
        """Whether a sweep speaks for a pose, against another one."""
        return speaks_for(one.evidence, other.evidence, self._config.solver.min_aligned)

    def rivals(self, pose: gtsam.Pose3, found: list[Candidate], far: float) -> list[Candidate]:
        """What may be right as well if a sweep is at a pose: all if it was not found there.

        Rivals are poses to which the sweep does not object. A place that is not in the map may look
        like one of those that are, if these look alike. So rivals are all poses, too, that fit
        nearly as well: to that share ``far`` away, or to :data:`AS_WELL` where the same is seen.
        """
        here = _at(pose, found)
        if here is None:
            return found
        return [c for c in found if c is not here and self._may_be(c, here, far)]

    def _may_be(self, other: Candidate, here: Candidate, far: float) -> bool:
        """Whether another pose may be the right one as well; see :meth:`rivals`."""
        if not self._favoured(here, other):
            return True
        near = other.map_T_middle.range(here.map_T_middle) < self._config.loops.search
        nearly = (AS_WELL if near else far) * here.fit.total
        return not self._inside and other.fit.total >= nearly

    def fits_better(self, pose: gtsam.Pose3, found: list[Candidate]) -> bool:
        """Whether the map fits better at another pose, to which the sweep does not object."""
        here = _at(pose, found)
        return here is None or any(
            c.fit.total > here.fit.total and not self._favoured(here, c) for c in found
        )

    def refuted(self, pose: gtsam.Pose3, found: list[Candidate]) -> bool:
        """Whether a sweep speaks against a pose and for another one, or was not found there."""
        here = _at(pose, found)
        return here is None or any(self._favoured(c, here) for c in found)

    def _lookalikes(self, points: FloatArray) -> list[gtsam.Pose3]:
        """Poses at the places that look most alike."""
        seen, places = scan_context(points, self._config.loops), self._places
        _, near = self._tree.query(heading_free_key(seen), k=min(_ALIKE, len(places)))
        compared = []
        for number in np.sort(np.atleast_1d(near)).tolist():
            descriptor = places[number].descriptor.astype(np.float64)
            compared.append((*compare_descriptors(descriptor, seen), number))
        turned = (
            places[number].map_T_middle.compose(gtsam.Pose3(gtsam.Rot3.Yaw(turn), np.zeros(3)))
            for _, turn, number in sorted(compared)
        )
        return self._apart(turned, _TRIES)

    def around(self, pose: gtsam.Pose3) -> list[gtsam.Pose3]:
        """Poses of places next to a pose, in which a lidar may be that is said to be there."""
        most, places = 2.0 * self._config.loops.search, [one.map_T_middle for one in self._places]
        near = sorted(places, key=pose.range)
        return self._apart((one for one in near if pose.range(one) < most), _AROUND)

    def _apart(self, poses: Iterable[gtsam.Pose3], most: int) -> list[gtsam.Pose3]:
        """The first of some poses that are a radius of the search apart, so many at most."""
        chosen: list[gtsam.Pose3] = []
        for pose in poses:
            if all(pose.range(other) > self._config.loops.search for other in chosen):
                chosen.append(pose)
            if len(chosen) == most:
                break
        return chosen


def _at(pose: gtsam.Pose3, found: list[Candidate]) -> Candidate | None:
    """What was found at a pose."""
    return next((c for c in found if same_optimum(c.map_T_middle, pose)), None)
