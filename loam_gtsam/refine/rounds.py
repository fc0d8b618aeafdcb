"""Rounds of an adjustment: landmarks are found anew, and poses solved by Levenberg-Marquardt.

Planes and lines are eliminated (:mod:`loam_gtsam.refine.elimination`); all other factors come as
GTSAM linearises them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gtsam
import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from loam_gtsam.errors import own_code
from loam_gtsam.geometry import transform
from loam_gtsam.refine.elimination import (
    Sightings,
    eliminated,
    refitted,
    seen_directions,
    sightings,
)
from loam_gtsam.refine.landmarks import Landmarks, find_landmarks, voxel_sizes
from loam_gtsam.refine.sweeps import Stack
from loam_gtsam.registration.solvers.own_factors import check_finite
from loam_gtsam.types import FloatArray, InputError, IntArray

_GOLDEN: FloatArray = np.array([0.8191725, 0.6710436, 0.5497005])
"""Steps of the grid from round to round, as shares of the largest voxel: never the same again."""
_ANCHOR = 1e-4
"""Radians and metres: standard deviation of the first pose if no factor holds any."""
_DAMPING = 1e-6, 1e-12, 1e6
"""Levenberg-Marquardt: first, least and largest share of the diagonal."""
_SLACK = 1e-4
"""Share by which the cost may rise in a step, where directions that are not seen were left out."""
_LEAST_PIVOT = 1e-13
"""Pivot over its diagonal entry below which a direction counts as free."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How the adjustment goes.

    Attributes
    ----------
    rounds : times that planes and lines are searched for
    steps : steps of Levenberg-Marquardt at most in each
    sigma : metres, that a point may have across a surface or edge (``matching.point_sigma``)
    largest, least : metres, edge lengths of the voxels of the first and the last level
    enough : metres and radians; a round that moves no pose by more is the last
    whole : sweeps up to which all are adjusted at once; more are first adjusted in windows
    """

    rounds: int = 5
    steps: int = 3
    sigma: float = 0.03
    largest: float = 3.2
    least: float = 0.4
    enough: float = 2e-4
    whole: int = 700

    def __post_init__(self) -> None:
        voxel_sizes(self.largest, self.least)
        if min(self.rounds, self.steps, self.whole) < 1 or not 0.0 < self.sigma < np.inf:
            raise InputError(
                "Settings: expected rounds, steps and whole of 1 or more and a positive sigma, "
                f"got {self}"
            )


@dataclass(frozen=True, slots=True)
class Round:
    """What one round did.

    Attributes
    ----------
    planes, lines : how many
    pairs, points : pairs of a sweep and a plane or line, and points on them
    scatter : metres, weighted root mean square distance of the points from them
    shared : metres, see :class:`~loam_gtsam.refine.elimination.Sightings`
    moved : metres, largest step of a pose
    cost_before, cost_after : with the planes and lines of this round
    """

    planes: int
    lines: int
    pairs: int
    points: int
    scatter: float
    shared: float
    moved: float
    cost_before: float
    cost_after: float


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """Poses after some rounds, and what they were adjusted to.

    Attributes
    ----------
    map_T_middle : (N, 4, 4) poses of the middles of the sweeps
    landmarks, seen : of the last round, and which sweep saw which of them
    clear : (N, 6, 6) projectors onto the directions about which these were asked
    rounds : what each round did
    """

    map_T_middle: FloatArray
    landmarks: Landmarks
    seen: Sightings
    clear: FloatArray
    rounds: tuple[Round, ...]


def adjusted(
    points_at: Callable[[FloatArray], Stack],
    map_T_middle: FloatArray,
    others: OtherFactors,
    asked: FloatArray,
    settings: Settings,
    on_round: Callable[[Round], None] | None = None,
    views: int = 3,
) -> Adjusted:
    """Adjust poses until no round moves them any more.

    Parameters
    ----------
    points_at : the points, when the sweeps have some poses
    map_T_middle : (N, 4, 4) poses at which the search starts
    others : factors beside the planes and lines
    asked : (N, 6, 6) projectors onto the directions about which these are asked
    views : sweeps that must see a plane or line at least

    Raises
    ------
    InputError
        If none is seen by so many sweeps, or some sweep is tied to no other.
    """
    poses, sizes = map_T_middle, voxel_sizes(settings.largest, settings.least)
    rounds: list[Round] = []
    for number in range(settings.rounds):
        stack = points_at(poses)
        shift = settings.largest * np.modf(number * _GOLDEN)[0]
        in_map = _placed(stack.points, stack.sweeps, poses)
        landmarks = find_landmarks(
            in_map, stack.sweeps, stack.is_edge, settings.sigma, sizes, shift, views
        )
        seen = sightings(stack.points, stack.sweeps, landmarks)
        _check_ties(seen, others, len(poses))
        clear = seen_directions(poses, landmarks, seen) @ asked
        before, poses_before = None, poses
        damping = _DAMPING[0]
        for _ in range(settings.steps):
            poses, landmarks, costs, damping = _step(poses, landmarks, seen, clear, others, damping)
            before = costs[0] if before is None else before
            if costs[0] - costs[1] <= 1e-4 * costs[0]:
                break
        weights, squared = landmarks.weights, (landmarks.residuals**2).sum(axis=1)
        scatter = float(np.sqrt(weights @ squared / max(weights.sum(), 1e-12)))
        moved = float(np.linalg.norm(poses[:, :3, 3] - poses_before[:, :3, 3], axis=1).max())
        lines = int(np.count_nonzero(landmarks.is_line))
        counts = len(landmarks) - lines, lines, len(seen.sweeps), len(landmarks.rows)
        assert before is not None
        rounds.append(Round(*counts, scatter, seen.shared, moved, before, costs[1]))
        if on_round is not None:
            on_round(rounds[-1])
        if moved < settings.enough:
            break
    return Adjusted(poses, landmarks, seen, clear, tuple(rounds))


def _placed(points: FloatArray, numbers: IntArray, poses: FloatArray) -> FloatArray:
    """Points of all sweeps in the map."""
    placed = np.empty_like(points)
    bounds = np.searchsorted(numbers, np.arange(len(poses) + 1))
    for pose, begin, end in zip(poses, bounds[:-1], bounds[1:], strict=True):
        placed[begin:end] = transform(pose, points[begin:end])
    return placed


class Ties(Protocol):
    """What is known of some poses (K of N), all else that it is known from being eliminated."""

    @property
    def numbers(self) -> IntArray:
        """(K,) of the sweeps."""

    def cost(self, poses: FloatArray) -> float:
        """Cost at poses (N, 4, 4) of all sweeps."""

    def equations(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information (6 K, 6 K) and gradient (6 K,) there."""


def _values(poses: FloatArray, first: int = 0) -> gtsam.Values:
    """Poses (N, 4, 4) under their keys, ``gtsam.symbol("x", first)`` and the next ones."""
    values = gtsam.Values()
    for number, pose in enumerate(poses, first):
        values.insert(gtsam.symbol("x", number), gtsam.Pose3(pose))
    return values


def check_factors(factors: gtsam.NonlinearFactorGraph, map_T_middle: FloatArray) -> None:
    """InputError unless all are finite, and on ``gtsam.symbol("x", n)`` of poses (N, 4, 4)."""
    values = _values(map_T_middle)
    for place in range(factors.size()):
        factor = factors.at(place)
        if not all(map(values.exists, factor.keys())):
            raise InputError(
                f"factors: factor {place} has a key that is not x0 to x{len(map_T_middle) - 1}, "
                "the poses of the sweeps"
            )
        with own_code("factors", f"factor {place}"):
            check_finite(factor, values, "factors")


class OtherFactors:
    """What ties the poses beside what the sweeps see, and the anchor they may need.

    Parameters
    ----------
    factors : on the poses ``gtsam.symbol("x", n)`` of N sweeps in a row (:func:`check_factors`)
    map_T_middle : (N, 4, 4) their poses
    first : number ``n`` of the first of them
    known : what landmarks that were eliminated before, and fixes, tell of the poses
    """

    def __init__(
        self,
        factors: gtsam.NonlinearFactorGraph | None,
        map_T_middle: FloatArray,
        first: int = 0,
        known: Sequence[Ties] = (),
    ) -> None:
        self.graph = gtsam.NonlinearFactorGraph() if factors is None else factors
        self.known, self._first, self._count = known, first, len(map_T_middle)
        self.ties = [ties.numbers.tolist() for ties in known]
        held: list[int] = []
        for place in range(self.graph.size()):
            keys: list[int] = self.graph.at(place).keys()
            numbers = [gtsam.symbolIndex(key) - first for key in keys]
            self.ties.append(numbers)
            held += numbers if len(numbers) == 1 else []
        self.held = held or [0]
        self._anchor = None if held else gtsam.Pose3(map_T_middle[0])

    def among(self, start: int, map_T_middle: FloatArray) -> OtherFactors:
        """The factors on poses in a row alone: ``map_T_middle`` (K, 4, 4), from a number on."""
        graph, numbers = gtsam.NonlinearFactorGraph(), range(start, start + len(map_T_middle))
        for place, tied in enumerate(self.ties[len(self.known) :]):
            if all(number in numbers for number in tied):
                graph.add(self.graph.at(place))
        return OtherFactors(graph, map_T_middle, self._first + start)

    def error(self, poses: FloatArray) -> float:
        """Cost of the factors."""
        values = _values(poses, self._first)
        with own_code("factors", "one of them"):
            total = 0.0 if not self.graph.size() else float(self.graph.error(values))
        if self._anchor is not None:
            off = gtsam.Pose3.Logmap(self._anchor.between(gtsam.Pose3(poses[0])))
            total += 0.5 * float(off @ off) / _ANCHOR**2
        return total + sum(ties.cost(poses) for ties in self.known)

    def equations(self, poses: FloatArray) -> tuple[csc_array, FloatArray]:
        """Information (6 N, 6 N) and gradient (6 N,)."""
        parts = [(ties.numbers, *ties.equations(poses)) for ties in self.known]
        values = _values(poses, self._first)
        for place in range(self.graph.size()):
            with own_code("factors", f"factor {place}"):
                linear: Any = self.graph.at(place).linearize(values)
            if linear is None:
                continue
            keys = linear.keys()
            numbers = np.array([gtsam.symbolIndex(key) for key in keys]) - self._first
            block = linear.augmentedInformation()
            parts.append((numbers, block[:-1, :-1], -block[:-1, -1]))
        if self._anchor is not None:
            off = gtsam.Pose3.Logmap(self._anchor.between(gtsam.Pose3(poses[0])))
            parts.append((np.zeros(1, np.int64), np.eye(6) / _ANCHOR**2, off / _ANCHOR**2))
        gradient = np.zeros((self._count, 6))
        for numbers, _, pull in parts:
            gradient[numbers] += pull.reshape(-1, 6)
        where = [(6 * numbers[:, None] + np.arange(6)).ravel() for numbers, _, _ in parts]
        rows = np.concatenate([np.repeat(at, len(at)) for at in where])
        columns = np.concatenate([np.tile(at, len(at)) for at in where])
        entries = np.concatenate([block.ravel() for _, block, _ in parts])
        size = 6 * self._count
        return csc_array(coo_array((entries, (rows, columns)), (size, size))), gradient.ravel()


def _check_ties(seen: Sightings, others: OtherFactors, count: int) -> None:
    """InputError unless every pose is tied to one that is held."""
    if not len(seen.sweeps) and not others.known:
        raise InputError(
            "refine: no plane or line is seen by three sweeps; are the poses those of the sweeps, "
            "and does Settings.sigma allow for their errors?"
        )
    one = [number for tie in others.ties for number in tie[:-1]]
    two = [number for tie in others.ties for number in tie[1:]]
    landmarks = int(seen.landmarks.max(initial=-1)) + 1
    ends = np.append(seen.sweeps, one), np.append(count + seen.landmarks, two)
    links = coo_array((np.ones(len(ends[0])), ends), shape=(count + landmarks,) * 2)
    group = connected_components(links, directed=False)[1]
    loose = np.flatnonzero(~np.isin(group[:count], group[others.held]))
    if len(loose):
        raise InputError(
            f"refine: {len(loose)} sweeps, number {loose[0]} the first, share no plane, line "
            "or factor with those that are held; leave them out, or give factors that tie them"
        )


def equations(
    poses: FloatArray, landmarks: Landmarks, seen: Sightings, keep: FloatArray,
    others: OtherFactors,
) -> tuple[csc_array, FloatArray]:  # fmt: skip
    """Information (6 N, 6 N) and gradient (6 N,) of the poses, planes and lines eliminated."""
    reduced = eliminated(poses, landmarks, seen, keep)
    information, gradient = others.equations(poses)
    return csc_array(reduced.hessian + information), reduced.gradient + gradient


def _step(
    poses: FloatArray,
    landmarks: Landmarks,
    seen: Sightings,
    keep: FloatArray,
    others: OtherFactors,
    damping: float,
) -> tuple[FloatArray, Landmarks, tuple[float, float], float]:
    """One step of Levenberg-Marquardt: poses, landmarks, cost before and after, damping."""
    landmarks, before = refitted(poses, landmarks, seen)
    before += others.error(poses)
    hessian, gradient = equations(poses, landmarks, seen, keep, others)
    slack = 1.0 + (0.0 if (keep == np.eye(6)).all() else _SLACK)
    diagonal = hessian.diagonal()
    while damping <= _DAMPING[2]:
        solver = splu(csc_array(hessian + diags_array(damping * diagonal)), **_SYMMETRIC)
        step = solver.solve(-gradient).reshape(-1, 6)
        moved = np.array(
            [
                gtsam.Pose3(pose).retract(delta).matrix()
                for pose, delta in zip(poses, step, strict=True)
            ]
        )
        fitted, after = refitted(moved, landmarks, seen)
        after += others.error(moved)
        if np.isfinite(after) and after <= slack * before:
            return moved, fitted, (before, after), max(0.1 * damping, _DAMPING[1])
        damping = max(10.0 * damping, 1e-9)
    return poses, landmarks, (before, before), damping


_SYMMETRIC: dict[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True},
}


def factorised(information: csc_array) -> Any:
    """Sparse factors of the information; InputError if it leaves a direction free."""
    diagonal = information.diagonal()
    try:
        factors = splu(information, **_SYMMETRIC)
        smallest = float((factors.U.diagonal()[factors.perm_c] / diagonal).min())
    except RuntimeError:
        smallest = 0.0
    if not smallest > _LEAST_PIVOT:
        raise InputError(
            "refine: planes, lines and factors leave a direction of the poses free; give factors "
            "that fix it, as the odometry does"
        )
    return factors
