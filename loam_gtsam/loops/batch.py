"""A whole pose graph at once: robust against loops that are wrong, for saved graphs too.

Loops are first weighed by graduated non-convexity (Yang, Antonante, Tzoumas and Carlone, Graduated
Non-Convexity for Robust Spatial Perception, RA-L 2020), then each is tested against all the others.
Equations: docs/maths/pose_graph.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.geometry import symmetric
from loam_gtsam.types import BoolArray, FloatArray, InputError

MAX_CHI2 = 40.0
"""Default of ``pose_graph.max_chi2``."""
_INLIER = 0.5
"""Weight of GNC above which a loop is an inlier at first."""
_GNC_TOLERANCE = 1e-3
"""Relative change of the cost that ends a round of GNC; its weights need no more."""
_ANCHOR = 1e-4
"""rad and m: standard deviation of the first pose of a graph that is held by nothing else."""


@dataclass(frozen=True, slots=True)
class SavedGraph:
    """Poses and factors, as they are read from and written to files.

    Attributes
    ----------
    factors : between factors, which are loops unless their keys follow one another, and any others
    poses : :class:`gtsam.Pose3` by key
    stamps : nanoseconds by key, as far as known
    """

    factors: gtsam.NonlinearFactorGraph
    poses: gtsam.Values
    stamps: Mapping[int, int] = field(default_factory=dict)

    @property
    def loops(self) -> tuple[int, ...]:
        """Places in ``factors`` of the loops: between poses that are not neighbours."""
        rank = {key: place for place, key in enumerate(sorted(self.poses.keys()))}
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
    """What became of a loop.

    Attributes
    ----------
    earlier, later : keys
    on : whether it was used
    chi_squared : squared Mahalanobis distance from what all the others say, of 6 freedoms
    """

    earlier: int
    later: int
    on: bool
    chi_squared: float


@dataclass(frozen=True, slots=True)
class OptimizedGraph:
    """The result of :func:`optimize_graph`.

    Attributes
    ----------
    poses : :class:`gtsam.Pose3` by key
    loops : in the order of the factors
    error_before, error_after : cost of the factors that were used, at the start and at the end
    factors : those that were used
    """

    poses: gtsam.Values
    loops: tuple[LoopReport, ...]
    error_before: float
    error_after: float
    factors: gtsam.NonlinearFactorGraph

    def covariance(self, key: int) -> FloatArray:
        """(6, 6) marginal covariance of a pose."""
        found: FloatArray = gtsam.Marginals(self.factors, self.poses).marginalCovariance(key)
        return found


def optimize_graph(
    saved: SavedGraph, *, robust: bool = True, max_chi2: float = MAX_CHI2
) -> OptimizedGraph:
    """Find the poses that fit all factors best, without the loops that contradict the others.

    Parameters
    ----------
    saved : its factors must have Gaussian noise, or robust noise around one, which is taken off. If
        none of them holds a pose to the map, the first pose is held where it is.
    robust : False: all loops are believed
    max_chi2 : a loop is on if its squared Mahalanobis distance from the others is not above

    Raises
    ------
    InputError
        If there is nothing to optimise, or the factors do not determine the poses.
    """
    _check(saved)
    places = saved.loops
    chosen = np.ones(len(places), np.bool_)
    try:
        if not robust or not places:
            return _result(saved, chosen, *_solved(saved, chosen))
        graph, poses = _solved(saved, chosen)
        tested = _tested(saved, graph, poses, chosen)
        if (tested > max_chi2).any():
            chosen = _by_gnc(saved)
            chosen, graph, poses, tested = _by_tests(saved, chosen, max_chi2)
        return _result(saved, chosen, graph, poses, tested)
    except RuntimeError as error:  # GTSAM's own, as for an indeterminate system
        raise InputError(
            "the factors do not determine the poses: is some pose connected to no other? "
            f"({' '.join(str(error).split())[:200]})"
        ) from error


def chi_squared(
    measured: gtsam.Pose3,
    noise: FloatArray,
    between: gtsam.Pose3,
    covariance: FloatArray,
    *,
    included: bool,
) -> float:
    """Squared Mahalanobis distance of a measured motion from what all other factors say.

    Parameters
    ----------
    measured, noise : the motion and its (6, 6) covariance
    between, covariance : what the graph says
    included : whether the graph already contains the measurement. What it says without is then told
        from the residual (Baarda, A Testing Procedure for Use in Geodetic Networks, 1968), see
        docs/maths/pose_graph.md.
    """
    residual = gtsam.Pose3.Logmap(measured.between(between))
    scatter = noise - covariance if included else noise + covariance
    values, vectors = np.linalg.eigh(symmetric(scatter))
    # Included, where nothing else holds the poses there is nothing to contradict.
    least = 1e-9 * float(np.trace(noise)) / 6.0
    parts = (vectors.T @ residual) ** 2 / np.maximum(values, least)
    return float(parts[values > least].sum())


def relative_pose_covariance(
    between: gtsam.Pose3, joint: gtsam.JointMarginal, earlier: int, later: int
) -> FloatArray:
    """(6, 6) covariance of ``earlier_T_later`` from the joint one of both poses."""
    to_later = between.inverse().AdjointMap()
    own, other = joint.at(earlier, earlier), joint.at(later, later)
    crossed = to_later @ joint.at(earlier, later)
    covariance: FloatArray = to_later @ own @ to_later.T + other - crossed - crossed.T
    return covariance


def _check(saved: SavedGraph) -> None:
    if saved.poses.size() == 0:
        raise InputError("graph: expected poses, got none")
    first = min(saved.poses.keys())
    groups = {key: key for key in saved.poses.keys()}  # noqa: SIM118 (no mapping)
    held: list[int] = []

    def group(key: int) -> int:
        while groups[key] != key:
            groups[key] = groups[groups[key]]
            key = groups[key]
        return key

    for place in range(saved.factors.size()):
        keys: list[int] = saved.factors.at(place).keys()
        missing = [key for key in keys if key not in groups]
        if missing:
            raise InputError(f"graph: factor {place} is on the key {missing[0]}, which has no pose")
        if len(keys) == 1:
            held += keys
        for key in keys[1:]:
            groups[group(key)] = group(keys[0])
    reached = {group(key) for key in held or [first]}
    loose = [key for key in groups if group(key) not in reached]
    if loose:
        raise InputError(
            f"graph: {len(loose)} poses, {min(loose)} the first, are connected to none that is "
            "held; leave them out, or add the factors that connect them"
        )


def _measurements(saved: SavedGraph, chosen: BoolArray) -> gtsam.NonlinearFactorGraph:
    """The factors with plain noise, those loops only that are chosen, and an anchor if needed."""
    off = {place for place, on in zip(saved.loops, chosen, strict=True) if not on}
    graph = gtsam.NonlinearFactorGraph()
    held = False
    for place in range(saved.factors.size()):
        factor = saved.factors.at(place)
        held |= factor.size() == 1
        if place not in off:
            graph.add(_plain(factor))
    if not held:
        first = min(saved.poses.keys())
        noise = gtsam.noiseModel.Isotropic.Sigma(6, _ANCHOR)
        graph.add(gtsam.PriorFactorPose3(first, saved.poses.atPose3(first), noise))
    return graph


def _plain(factor: gtsam.NonlinearFactor) -> gtsam.NonlinearFactor:
    """The factor without a robust kernel."""
    noise = factor.noiseModel() if isinstance(factor, gtsam.NoiseModelFactor) else None
    if isinstance(noise, gtsam.noiseModel.Robust):
        plain: Any = factor
        factor = plain.cloneWithNewNoiseModel(noise.noise())
    return factor


def _solved(
    saved: SavedGraph, chosen: BoolArray
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph = _measurements(saved, chosen)
    params = gtsam.LevenbergMarquardtParams()
    params.setVerbosityLM("SILENT")
    params.setRelativeErrorTol(1e-9)
    return graph, gtsam.LevenbergMarquardtOptimizer(graph, saved.poses, params).optimize()


def _by_gnc(saved: SavedGraph) -> BoolArray:
    """Which loops are inliers of graduated non-convexity, all other factors being right.

    With the Geman-McClure loss: truncated least squares loses all loops where most are wrong (ten
    right ones of sixty, measured).
    """
    graph = _measurements(saved, np.ones(len(saved.loops), np.bool_))
    loops = set(saved.loops)
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.GM)
    params.setRelativeCostTol(_GNC_TOLERANCE)
    params.setKnownInliers([place for place in range(graph.size()) if place not in loops])
    optimizer = gtsam.GncLMOptimizer(graph, saved.poses, params)
    optimizer.optimize()
    weights = np.asarray(optimizer.getWeights())[list(saved.loops)]
    inliers: BoolArray = weights > _INLIER
    return inliers


def _tested(
    saved: SavedGraph, graph: gtsam.NonlinearFactorGraph, poses: gtsam.Values, chosen: BoolArray
) -> FloatArray:
    """(L,) squared distance of each loop from what all the others say."""
    marginals = gtsam.Marginals(graph, poses)
    tested = []
    for place, on in zip(saved.loops, chosen.tolist(), strict=True):
        factor: Any = _plain(saved.factors.at(place))
        first, second = factor.keys()
        between = poses.atPose3(first).between(poses.atPose3(second))
        joint = marginals.jointMarginalCovariance([first, second])
        covariance = relative_pose_covariance(between, joint, first, second)
        noise = factor.noiseModel().covariance()
        tested.append(chi_squared(factor.measured(), noise, between, covariance, included=on))
    return np.array(tested)


def _by_tests(
    saved: SavedGraph, chosen: BoolArray, max_chi2: float
) -> tuple[BoolArray, gtsam.NonlinearFactorGraph, gtsam.Values, FloatArray]:
    """From a first choice, loops off or on one by one until all agree with their tests."""
    rounds = 2 * len(chosen)
    for left in range(rounds, -1, -1):
        graph, poses = _solved(saved, chosen)
        tested = _tested(saved, graph, poses, chosen)
        worst = int(np.where(chosen, tested, -1.0).argmax())
        best = int(np.where(chosen, np.inf, tested).argmin())
        if left == 0:
            break
        chosen = chosen.copy()
        if chosen[worst] and tested[worst] > max_chi2:
            chosen[worst] = False
        elif not chosen[best] and tested[best] <= max_chi2:
            chosen[best] = True
        else:
            break
    return chosen, graph, poses, tested


def _result(
    saved: SavedGraph,
    chosen: BoolArray,
    graph: gtsam.NonlinearFactorGraph,
    poses: gtsam.Values,
    tested: FloatArray | None = None,
) -> OptimizedGraph:
    if tested is None:
        tested = _tested(saved, graph, poses, chosen)
    reports = []
    for number, place in enumerate(saved.loops):
        first, second = saved.factors.at(place).keys()
        reports.append(LoopReport(first, second, bool(chosen[number]), float(tested[number])))
    before, after = graph.error(saved.poses), graph.error(poses)
    return OptimizedGraph(poses, tuple(reports), before, after, graph)
