"""Which fixes of a receiver are right: those that agree with each other and with the way.

Found by graduated non-convexity (Yang et al., RA-L 2020) from all of them, and from the largest set
whose distances are those along the way. Equations: docs/gnss.md.
"""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np

from loam_gtsam.aiding.placed_fixes import LARGEST, MEDIAN, PlacedFixes
from loam_gtsam.loops.keyframes import odometry_between
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.types import BoolArray, FloatArray, IntArray

LEAST = 0.5  # share of the fixes that must agree
FEWEST = 5  # fixes
_STEP = 1.6  # by which graduated non-convexity sharpens from solve to solve
_ROUNDS = 15  # at most, until the fixes that are right stay the same
_APART = 10.83  # of chi squared with one degree of freedom, 0.1 % exceed it
_COMPARED = 1000  # fixes, evenly over the way, of which all pairs are compared


class FixSelection:
    """A graph with fixes, each of which has a weight.

    Parameters
    ----------
    graph : of the run; it stays as it is
    fixes : on its poses
    way : (N, 3) metres, where the antenna was at each of them before they are used
    up : (3,) upward in the map; None if no IMU levelled it

    Attributes
    ----------
    rest : factors of the graph that are none of fixes
    """

    def __init__(
        self, graph: PoseGraph, fixes: PlacedFixes, way: FloatArray, up: FloatArray | None
    ) -> None:
        self._fixes, self._way, self._up = fixes, way, up
        self.rest = graph.active_factors()
        self._values = graph.values
        # How uncertain turn and place have become by the odometry, at the keyframe of each fix.
        steps = [odometry_between(*ends, graph.config)[1] for ends in pairwise(graph.keyframes)]
        added = [np.diag(covariance).reshape(2, 3).sum(axis=1) for covariance in steps]
        grown = np.cumsum([np.zeros(2), *added], axis=0)
        numbers = [keyframe.index for keyframe in graph.keyframes]
        self._drift = grown[np.searchsorted(numbers, fixes.poses)]

    def factors(self, spread: FloatArray | float, used: BoolArray) -> gtsam.NonlinearFactorGraph:
        """Factors of the ``used`` (N,) fixes; covariances times ``spread``, of each (U,) or all."""
        return self._fixes.of(np.flatnonzero(used), spread).factors(self._up)

    def solve(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        """The poses that fit all factors best."""
        graph = gtsam.NonlinearFactorGraph(self.rest)
        graph.push_back(factors)
        params = gtsam.LevenbergMarquardtParams()
        params.setVerbosityLM("SILENT")
        params.setMaxIterations(20)
        return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()

    def robust(self, enu_T_map: FloatArray) -> tuple[gtsam.Values, BoolArray, float]:
        """Estimates, (N,) which fixes are right, and by how much their sigmas are too small.

        A RuntimeError, as GTSAM's own, if none is right.
        """
        start = gtsam.Values(self._values)
        start.insert(self._fixes.start(gtsam.Pose3(enu_T_map)))
        everyone = np.ones(len(self._fixes), np.bool_)
        found = [self._settled(self._graduated(start), everyone)]
        # Where wrong fixes are surer than the way, it bends to them before they can be told.
        rigid = self._rigid()
        if LEAST <= rigid.mean() < 1.0:
            alone = self.solve(self.factors(1.0, rigid), start)
            found.append(self._settled(alone, rigid))
        values, used, scale = min(found, key=self._cost)
        if not used.any():
            raise RuntimeError("no fix agrees with the way")
        return values, used, float(np.sqrt(scale))

    def _graduated(self, values: gtsam.Values) -> gtsam.Values:
        """The poses that most fixes agree with, by graduated non-convexity from all of them."""
        everyone = np.ones(len(self._fixes), np.bool_)
        squared = self._fixes.squared(values)
        sharp = max(1.0, 2.0 * float(squared.max()) / LARGEST)
        while True:
            weights = (sharp * LARGEST / (squared + sharp * LARGEST)) ** 2
            values = self.solve(self.factors(1.0 / np.maximum(weights, 1e-9), everyone), values)
            if sharp == 1.0:
                return values
            squared = self._fixes.squared(values)
            sharp = max(1.0, sharp / _STEP)

    def _rigid(self) -> BoolArray:
        """(N,) the fixes whose distances are those of the way: as many as greedy search finds.

        Where the map lies on the earth is not asked for that, and no wrong fix has bent the way.
        """
        count = len(self._fixes)
        tried = np.linspace(0, count - 1, min(count, _COMPARED)).round().astype(np.int64)
        agree, chosen = self._as_far_apart(tried, tried), list[int]()
        for number in np.argsort(-agree.sum(axis=1), kind="stable").tolist():
            if agree[number, chosen].all():
                chosen.append(number)
        return np.asarray(self._as_far_apart(np.arange(count), tried[chosen]).all(axis=1))

    def _as_far_apart(self, some: IntArray, others: IntArray) -> BoolArray:
        """(S, O) whether fixes are as far apart as the way is there, but for noise and drift."""
        by_way, by_fixes = (
            np.linalg.norm(at[some][:, None] - at[others], axis=2)
            for at in (self._way, self._fixes.enu)
        )
        grown = np.abs(self._drift[some][:, None] - self._drift[others])
        drift = grown[:, :, 1] + grown[:, :, 0] * by_way**2 / 3.0
        variances = self._fixes.sigmas**2
        allowed = variances[some][:, None] + variances[others] + drift
        close: BoolArray = (by_way - by_fixes) ** 2 <= _APART * allowed
        return close

    def _settled(
        self, values: gtsam.Values, trusted: BoolArray
    ) -> tuple[gtsam.Values, BoolArray, float]:
        """Estimates, which fixes are right, and the factor of their variances, from some (N,)."""
        squared = self._fixes.squared(values)
        scale = max(1.0, float(np.median(squared[trusted])) / MEDIAN)
        used = squared <= scale * LARGEST
        for _ in range(_ROUNDS):
            if used.sum() < FEWEST:
                break
            values = self.solve(self.factors(scale, used), values)
            before, used = used, self._fixes.squared(values) <= scale * LARGEST
            if (before == used).all():
                break
        return values, used, scale

    def _cost(self, found: tuple[gtsam.Values, BoolArray, float]) -> float:
        """Squared errors of all factors, those of a fix up to where it counts as wrong."""
        values = found[0]
        squared = np.minimum(self._fixes.squared(values), LARGEST)
        return 2.0 * float(self.rest.error(values)) + float(squared.sum())
