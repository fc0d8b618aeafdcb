"""Optimisation of a whole pose graph at once, robust against wrong loop closures.

Graduated non-convexity (Yang et al., RA-L 2020) makes the first choice of loop closures, then each
is tested against all the others. Equations: docs/maths/pose_graph.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from loam_gtsam.config import PoseGraphConfig
from loam_gtsam.loops.incremental import relative_pose
from loam_gtsam.loops.keyframes import is_pose, pose_number
from loam_gtsam.loops.loop_selection import chi_squared, loop_to_switch, may_be_drift
from loam_gtsam.types import BoolArray, FloatArray, InputError, check_kind

_INLIER = 0.5  # weight of graduated non-convexity above which a loop closure is in the first choice
_GNC_TOLERANCE = 1e-3  # relative change of the cost that ends a round of GNC
_ANCHOR = 1e-4  # rad and m: sigma of the first pose of a graph without any unary factor


@dataclass(frozen=True, slots=True, eq=False)
class SavedGraph:
    """Poses and factors of a graph, as files hold them.

    Attributes
    ----------
    factors : of GTSAM, on the poses
    poses : Pose3 by key; a user's own variables may be among them
    stamps : nanoseconds by key, as far as known
    closures : positions of the loop closures in ``factors``; None, as of a file, if it is not known
    """

    factors: gtsam.NonlinearFactorGraph
    poses: gtsam.Values
    stamps: Mapping[int, int] = field(default_factory=dict)
    closures: Sequence[int] | None = None

    @property
    def keys(self) -> list[int]:
        """Keys of the poses in ascending order, without those of a user's other variables."""
        return sorted(key for key in self.poses.keys() if is_pose(self.poses, key))  # noqa: SIM118

    @property
    def loops(self) -> tuple[int, ...]:
        """Positions of the loop closures in ``factors``.

        If it is not known: the between factors whose poses do not follow one another.
        """
        if self.closures is not None:
            return tuple(self.closures)
        rank = {key: place for place, key in enumerate(self.keys)}
        found = []
        for place in range(self.factors.size()):
            factor = self.factors.at(place)
            if isinstance(factor, gtsam.BetweenFactorPose3):
                first, second = factor.keys()
                if abs(rank[first] - rank[second]) != 1:
                    found.append(place)
        return tuple(found)


@dataclass(frozen=True, slots=True)
class LoopReport:
    """What the optimisation found out about a loop closure.

    Attributes
    ----------
    earlier, later : numbers of the poses
    active : whether the loop closure was used
    chi_squared : squared Mahalanobis distance from what all the others say, 6 degrees of freedom
    """

    earlier: int
    later: int
    active: bool
    chi_squared: float


@dataclass(frozen=True, slots=True, eq=False)
class OptimizedGraph:
    """The result of :func:`optimize_graph`.

    Attributes
    ----------
    poses : Pose3 by key, and a user's own variables if there are any
    loops : reports in the order of the factors
    error_before, error_after : cost of ``factors``, those that were used, at the start and the end
    """

    poses: gtsam.Values
    loops: tuple[LoopReport, ...]
    error_before: float
    error_after: float
    factors: gtsam.NonlinearFactorGraph

    def covariance(self, key: int) -> FloatArray:
        """Marginal covariance of a variable, (6, 6) of a pose."""
        found: FloatArray = gtsam.Marginals(self.factors, self.poses).marginalCovariance(key)
        return found


def optimize_graph(
    saved: SavedGraph,
    *,
    robust: bool = True,
    max_chi2: float = PoseGraphConfig().max_chi2,
) -> OptimizedGraph:
    """Find the poses that fit all factors best, without loop closures that contradict the others.

    Parameters
    ----------
    saved : between factors must have Gaussian noise, or a robust kernel around it, which is taken
        off. If there is no unary factor, the first pose is held where it is.
    robust : False uses all loop closures
    max_chi2 : largest squared Mahalanobis distance of a loop closure that agrees with the others

    Raises
    ------
    InputError
        If there is nothing to optimise, or the factors do not determine the poses.
    """
    _check(saved)
    problem = _Problem(saved)
    possible = problem.possible() if robust else np.ones(len(problem.loops), np.bool_)
    active = possible
    try:
        graph, poses, distances = problem.solve(active)
        if robust and (distances[active] > max_chi2).any():
            active = problem.inliers() & possible
            graph, poses, distances = problem.solve(active)
            for _ in range(2 * len(active)):
                number = loop_to_switch(active, np.where(possible, distances, np.inf), max_chi2)
                if number is None:
                    break
                active[number] = not active[number]
                graph, poses, distances = problem.solve(active)
    except RuntimeError as error:  # GTSAM's own, as for an indeterminate system
        raise InputError(
            "the factors do not determine the poses: is some pose connected to no other? "
            f"({' '.join(str(error).split())[:200]})"
        ) from error
    reports = []
    for place, on, distance in zip(problem.loops, active, distances, strict=True):
        first, second = map(pose_number, saved.factors.at(place).keys())
        reports.append(LoopReport(first, second, bool(on), float(distance)))
    before, after = graph.error(saved.poses), graph.error(poses)
    return OptimizedGraph(poses, tuple(reports), before, after, graph)


def _check(saved: SavedGraph) -> None:
    check_kind(saved, SavedGraph, "graph", "read_graph(path) and PoseGraph.saved() make one")
    keys = sorted(saved.poses.keys())
    if not saved.keys:
        raise InputError(f"graph: expected poses, got none among {len(keys)} variables")
    name = gtsam.DefaultKeyFormatter
    rank = {key: place for place, key in enumerate(keys)}
    pairs: list[tuple[int, int]] = []
    held: list[int] = []
    for place in range(saved.factors.size()):
        connected: list[int] = saved.factors.at(place).keys()
        missing = [key for key in connected if key not in rank]
        if missing:
            raise InputError(
                f"graph: factor {place} is on the key {name(missing[0])}, which has no pose"
            )
        held += [rank[key] for key in connected if len(connected) == 1]
        pairs += [(rank[connected[0]], rank[key]) for key in connected[1:]]
    ends = np.array(pairs, np.int64).reshape(-1, 2).T
    links = coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(len(keys), len(keys)))
    group = connected_components(links, directed=False)[1]
    loose = np.flatnonzero(~np.isin(group, group[held or [rank[saved.keys[0]]]]))
    if len(loose):
        raise InputError(
            f"graph: {len(loose)} poses, {name(keys[loose[0]])} the first, are connected to none "
            "that is held; leave them out, or add the factors that connect them"
        )


class _Problem:
    """Factors of a graph, of which the loop closures can be left out."""

    def __init__(self, saved: SavedGraph) -> None:
        self.saved, self.loops = saved, saved.loops

    def factors(self, active: BoolArray) -> gtsam.NonlinearFactorGraph:
        """Factors with plain noise, the active loop closures among them, and a needed anchor."""
        saved = self.saved
        left_out = {place for place, on in zip(self.loops, active, strict=True) if not on}
        graph = gtsam.NonlinearFactorGraph()
        held = False
        for place in range(saved.factors.size()):
            factor = saved.factors.at(place)
            held |= factor.size() == 1
            if place not in left_out:
                graph.add(_without_kernel(factor))
        if not held:
            first = saved.keys[0]
            noise = gtsam.noiseModel.Isotropic.Sigma(6, _ANCHOR)
            graph.add(gtsam.PriorFactorPose3(first, saved.poses.atPose3(first), noise))
        return graph

    def solve(
        self, active: BoolArray
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, FloatArray]:
        """Factors that were used, poses, and distance (L,) of each loop closure from the others."""
        graph = self.factors(active)
        poses = self._optimised(graph)
        pairs = zip(self._compared(graph, poses), active.tolist(), strict=True)
        distances = [chi_squared(*motions, included=on) for (_, motions), on in pairs]
        return graph, poses, np.array(distances)

    def _compared(
        self, graph: gtsam.NonlinearFactorGraph, poses: gtsam.Values
    ) -> Iterator[tuple[list[int], tuple[gtsam.Pose3, FloatArray, gtsam.Pose3, FloatArray]]]:
        """Of each loop closure its keys, and its motion beside that of a solved graph.

        Both with their covariances, as :func:`chi_squared` takes them.
        """
        if not self.loops:
            return
        marginals = gtsam.Marginals(graph, poses)
        for place in self.loops:
            factor: Any = _without_kernel(self.saved.factors.at(place))
            keys, noise = factor.keys(), factor.noiseModel().covariance()
            yield keys, (factor.measured(), noise, *relative_pose(poses, marginals, *keys))

    def possible(self) -> BoolArray:
        """Which loop closures a drift of the odometry allows; all if only loops tie the poses."""
        everyone = np.ones(len(self.loops), np.bool_)
        if not self.loops:
            return everyone
        graph, keys = self.factors(~everyone), self.saved.keys
        try:
            poses = self._optimised(graph)
            compared = list(self._compared(graph, poses))
        except RuntimeError:
            return everyone
        places = np.array([poses.atPose3(key).translation() for key in keys])
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        way = dict(zip(keys, np.concatenate([[0.0], np.cumsum(steps)]).tolist(), strict=True))
        possible = [
            may_be_drift(*motions, abs(way[second] - way[first]))
            for (first, second), motions in compared
        ]
        return np.array(possible, np.bool_)

    def _optimised(self, graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
        params = gtsam.LevenbergMarquardtParams()
        params.setVerbosityLM("SILENT")
        params.setRelativeErrorTol(1e-9)
        return gtsam.LevenbergMarquardtOptimizer(graph, self.saved.poses, params).optimize()

    def inliers(self) -> BoolArray:
        """Which loop closures graduated non-convexity finds right, given all other factors."""
        poses = self.saved.poses
        graph = self.factors(np.ones(len(self.loops), np.bool_))
        params = gtsam.GncLMParams()
        for place in range(graph.size()):
            factor = graph.at(place)
            if isinstance(factor, gtsam.CustomFactor):  # which GNC cannot copy
                params.setAllowNonNoiseModelFactors(True)
                linear = gtsam.LinearContainerFactor(factor.linearize(poses), poses)
                graph.replace(place, linear)
        loops = set(self.loops)
        # Truncated least squares loses all where most are wrong (ten right ones of 60, measured).
        params.setLossType(gtsam.GncLossType.GM)
        params.setRelativeCostTol(_GNC_TOLERANCE)
        params.setKnownInliers([place for place in range(graph.size()) if place not in loops])
        optimizer = gtsam.GncLMOptimizer(graph, poses, params)
        optimizer.optimize()
        weights = np.asarray(optimizer.getWeights())[list(self.loops)]
        inliers: BoolArray = weights > _INLIER
        return inliers


def _without_kernel(factor: gtsam.NonlinearFactor) -> gtsam.NonlinearFactor:
    """The factor without a robust kernel; GTSAM cannot copy a CustomFactor, which keeps its own."""
    noise = factor.noiseModel() if isinstance(factor, gtsam.NoiseModelFactor) else None
    if isinstance(noise, gtsam.noiseModel.Robust) and not isinstance(factor, gtsam.CustomFactor):
        plain: Any = factor
        factor = plain.cloneWithNewNoiseModel(noise.noise())
    return factor
