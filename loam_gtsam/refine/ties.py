"""What is known of the poses beside motions: fixes of a GNSS receiver, and a user's own factors.

Their other variables, as where the map is on the earth, the antennas, or landmarks, are eliminated
(variable projection: Golub and Pereyra, SIAM Journal on Numerical Analysis, 1973): at any poses
they are where they fit best. So the poses are those of a map whose first one is held, with fixes
or without.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from loam_gtsam.aiding.placed_fixes import MAP_KEY, MEDIAN, PlacedFixes
from loam_gtsam.datasets.decode.geodesy import GeoReference
from loam_gtsam.loops.batch import SavedGraph
from loam_gtsam.loops.keyframes import is_pose_key, pose_key
from loam_gtsam.types import FloatArray, InputError, IntArray

_MOST = 200
"""Fixes that are used at most, evenly spread: their equations are dense."""
_STEPS, _ENOUGH = 10, 1e-10
"""Gauss-Newton steps to where the other variables fit best, and the change that ends them."""
_LEAST = 1e-12
"""Eigenvalue of the information of these, its diagonal 1, below which one is unknown."""


@dataclass(frozen=True, eq=False)
class FactorTies:
    """Factors on places of some sweeps, which are tied to each other by them.

    Attributes
    ----------
    factors : on the poses of the places, and on other variables
    others : where these begin
    places : by the numbers of the sweeps, ascending: key of the place, and the pose of the middle
        of the sweep, seen from there
    unknown : what an InputError says if the factors leave one of the others open
    """

    factors: gtsam.NonlinearFactorGraph
    others: gtsam.Values
    places: Mapping[int, tuple[int, gtsam.Pose3]]
    unknown: str

    @cached_property
    def numbers(self) -> IntArray:
        """(K,) of the sweeps, ascending."""
        return np.array(list(self.places), np.int64)

    @cached_property
    def _order(self) -> gtsam.Ordering:
        """The poses, then the others by their keys."""
        order = gtsam.Ordering()
        for key in (*(key for key, _ in self.places.values()), *self.others.keys()):
            order.push_back(key)
        return order

    @cached_property
    def _to_places(self) -> FloatArray:
        """(K, 6, 6) from what moves the middles of the sweeps to what moves the places."""
        return np.array([place_T_middle.AdjointMap() for _, place_T_middle in self.places.values()])

    @cached_property
    def rows(self) -> dict[int, slice]:
        """Rows of each of the others among those of all of them, by key."""
        sizes, end, found = self.others.zeroVectors(), 0, {}
        for key in self.others.keys():  # noqa: SIM118
            end += len(sizes.at(key))
            found[key] = slice(end - len(sizes.at(key)), end)
        return found

    def fitted(self, poses: FloatArray) -> tuple[gtsam.Values, FloatArray, FloatArray]:
        """The others where they fit best; information and pull of places and others.

        An InputError if the factors leave open where that is.
        """
        values, size = gtsam.Values(self.others), 6 * len(self.places)
        for number, (key, place_T_middle) in self.places.items():
            values.insert(key, gtsam.Pose3(poses[number]).compose(place_T_middle.inverse()))
        for _ in range(_STEPS):
            information, pull = self.factors.linearize(values).hessian(self._order)
            if not self.others.size():
                break
            if not _all_told(information[size:, size:]):
                raise InputError(f"refine: {self.unknown}")
            step = np.asarray(np.linalg.solve(information[size:, size:], pull[size:]), float)
            if np.abs(step).max() < _ENOUGH:
                break
            moved = gtsam.VectorValues()
            for key, rows in self.rows.items():
                moved.insert(key, step[rows])
            values = values.retract(moved)
        return values, information, pull

    def cost(self, poses: FloatArray) -> float:
        """Half the squared, whitened residuals at poses (N, 4, 4) of all sweeps."""
        return float(self.factors.error(self.fitted(poses)[0]))

    def equations(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information (6 K, 6 K) and gradient (6 K,) at poses (N, 4, 4) of all sweeps."""
        _, information, pull = self.fitted(poses)
        count, turn = len(self.places), self._to_places
        size = 6 * count
        across = information[:size, size:]
        by_pose = np.linalg.solve(information[size:, size:], across.T)
        of_places = (information[:size, :size] - across @ by_pose).reshape(count, 6, count, 6)
        of_middles = np.einsum("nji,njmk,mkl->niml", turn, of_places, turn, optimize=True)
        pull = np.einsum("nji,nj->ni", turn, (pull[:size] - by_pose.T @ pull[size:]).reshape(-1, 6))
        return of_middles.reshape(size, size), -pull.ravel()


def own_ties(
    graph: SavedGraph, frames: Mapping[int, int], to_middle: Sequence[gtsam.Pose3]
) -> list[FactorTies]:
    """The factors of a graph that are no motions, in groups that share no variable but poses.

    Parameters
    ----------
    graph : pose graph of a run, or of several
    frames : numbers of the sweeps by the keys of the graph; factors on other keys are left out
    to_middle : pose of the middle of each sweep, seen from where the graph has its pose
    """
    first = min(filter(is_pose_key, graph.keys), default=0)
    chosen: list[gtsam.NonlinearFactor] = []
    ends: list[tuple[int, int]] = []
    for number in range(graph.factors.size()):
        factor = graph.factors.at(number)
        keys: list[int] = factor.keys()
        known = all(key in frames for key in keys if is_pose_key(key))
        holds = isinstance(factor, gtsam.PriorFactorPose3) and keys == [first]
        if known and not holds and not isinstance(factor, gtsam.BetweenFactorPose3):
            ends += [(len(chosen), key) for key in keys if not is_pose_key(key)]
            chosen.append(factor)
    others = sorted({key for _, key in ends})
    place = {key: len(chosen) + number for number, key in enumerate(others)}
    rows, columns = [row for row, _ in ends], [place[key] for _, key in ends]
    shape = (len(chosen) + len(others),) * 2
    links = coo_array((np.ones(len(ends)), (rows, columns)), shape=shape)
    groups = connected_components(links, directed=False)[1]
    found = []
    for group in range(groups.max(initial=-1) + 1):
        factors = gtsam.NonlinearFactorGraph()
        for row in np.flatnonzero(groups[: len(chosen)] == group).tolist():
            factors.add(chosen[row])
        mine = [key for key, of in zip(others, groups[len(chosen) :], strict=True) if of == group]
        tied = sorted((frames[key], key) for key in factors.keyVector() if is_pose_key(key))
        if not tied:  # all that tells of the poses was left out
            continue
        places = {sweep: (key, to_middle[sweep]) for sweep, key in tied}
        names = ", ".join(map(gtsam.DefaultKeyFormatter, mine))
        unknown = f"the factors of the graph do not tell its {names}; leave these factors out"
        found.append(FactorTies(factors, graph.poses.extract(mine), places, unknown))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Fixes of a map, or of merged ones, and where these had it on the earth.

    Attributes
    ----------
    fixes : by numbers of places, seen from the middles of their sweeps, as in a saved map
    stamps : of the places
    reference : where the map was
    up : (3,) upward in the map; None if no IMU levelled it

    Raises
    ------
    InputError
        If a fix is on a place that has no stamp.
    """

    fixes: PlacedFixes
    stamps: IntArray
    reference: GeoReference
    up: FloatArray | None = None

    def __post_init__(self) -> None:
        numbers, count = self.fixes.poses, len(self.stamps)
        if ((numbers < 0) | (numbers >= count)).any():
            raise InputError(f"Survey: expected fixes on the {count} places, got others")


@dataclass(frozen=True, eq=False)
class FixTies:
    """What fixes tell of the poses of the sweeps, which are then tied to each other.

    Attributes
    ----------
    fixes : by numbers of sweeps, seen from their middles
    reference : where the map is, about
    up : (3,) upward in the map; None if unknown
    """

    fixes: PlacedFixes
    reference: GeoReference
    up: FloatArray | None = None

    @staticmethod
    def of(fixes: PlacedFixes, reference: GeoReference, up: FloatArray | None) -> FixTies:
        """Of fixes, or of some of many."""
        rows = np.linspace(0, len(fixes), min(_MOST, len(fixes)), endpoint=False)
        return FixTies(fixes.of(rows.astype(np.int64)), reference, up)

    @cached_property
    def _ties(self) -> FactorTies:
        enu_T_map = gtsam.Pose3(self.reference.enu_T_map)
        places = {n: (pose_key(n), gtsam.Pose3()) for n in np.unique(self.fixes.poses).tolist()}
        unknown = f"{len(self.fixes)} fixes do not tell where the map is; leave them out"
        return FactorTies(self.fixes.factors(self.up), self.fixes.start(enu_T_map), places, unknown)

    @property
    def numbers(self) -> IntArray:
        """(K,) of the sweeps, ascending."""
        return self._ties.numbers

    def cost(self, poses: FloatArray) -> float:
        """Half the squared, whitened residuals at poses (N, 4, 4) of all sweeps."""
        return self._ties.cost(poses)

    def equations(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information (6 K, 6 K) and gradient (6 K,) at poses (N, 4, 4) of all sweeps."""
        return self._ties.equations(poses)

    def referenced(
        self, poses: FloatArray, solve: Callable[[FloatArray], FloatArray]
    ) -> GeoReference:
        """Where the map is; ``solve`` (6 N, M) by the information of all poses (N, 4, 4).

        If the fixes are farther off than their covariances say, its covariance is larger for it.
        """
        values, information, _ = self._ties.fitted(poses)
        size = 6 * len(self.numbers)
        known, of_map = np.linalg.inv(information[size:, size:]), self._ties.rows[MAP_KEY]
        by_pose = known[of_map] @ information[size:, :size]
        rows = (6 * self.numbers[:, None] + np.arange(6)).ravel()
        units = np.zeros((6 * len(poses), 6))
        units[rows] = by_pose.T
        covariance = known[of_map, of_map] + by_pose @ solve(units)[rows]
        spread = max(1.0, float(np.median(self.fixes.squared(values))) / MEDIAN)
        earth = values.atPose3(MAP_KEY).matrix()
        return GeoReference(self.reference.origin, earth, spread * covariance)


def _all_told(information: FloatArray) -> bool:
    """Whether an information leaves no direction free."""
    scale = np.sqrt(np.diagonal(information))
    if not (np.isfinite(information).all() and (scale > 0.0).all()):
        return False
    return bool(np.linalg.eigvalsh(information / np.outer(scale, scale))[0] > _LEAST)
