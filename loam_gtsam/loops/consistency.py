"""Which loops agree with each other, through the odometry between their ends.

Pairwise consistency (Mangelson, Dominic, Eustice and Vasudevan, Pairwise Consistent Measurement Set
Maximization for Robust Multi-Robot Map Merging, ICRA 2018). Equations: docs/maths/pose_graph.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam

from loam_gtsam.config import PoseGraphConfig
from loam_gtsam.loops.batch import chi_squared
from loam_gtsam.loops.keyframes import Keyframe, LoopClosure, odometry_between
from loam_gtsam.types import FloatArray


class LoopConsistency:
    """Keeps for every loop the others that it agrees with.

    Parameters
    ----------
    config : ``max_chi2``, ``walk`` and ``turn_walk_deg``

    loops, keyframes : of the graph, which grow with it
    """

    def __init__(
        self, config: PoseGraphConfig, loops: Sequence[LoopClosure], keyframes: Sequence[Keyframe]
    ) -> None:
        self.config = config
        self._loops = loops
        self._keyframes = keyframes
        self._known: dict[tuple[int, int], bool] = {}

    def agreeing(self, number: int) -> set[int]:
        """The numbers of the other loops that one agrees with; pairs are compared once."""
        return {n for n in range(len(self._loops)) if n != number and self._agree(n, number)}

    def clique(self, number: int) -> set[int]:
        """Loops that agree pairwise, this one among them; as many as are found greedily."""
        agreeing = {other: self.agreeing(other) for other in self.agreeing(number)}
        chosen = {number}
        for other in sorted(agreeing, key=lambda n: (-len(agreeing[n]), n)):
            if chosen <= agreeing[other]:
                chosen.add(other)
        return chosen

    def _agree(self, one: int, two: int) -> bool:
        pair = min(one, two), max(one, two)
        if pair not in self._known:
            first, second = self._loops[pair[0]], self._loops[pair[1]]
            self._known[pair] = consistent(second, first, self._keyframes, self.config)
        return self._known[pair]


def consistent(
    one: LoopClosure, two: LoopClosure, keyframes: Sequence[Keyframe], config: PoseGraphConfig
) -> bool:
    """Whether two loops and the odometry between their ends make a cycle that closes.

    If there is no odometry between two ends, which are then of two sessions, nothing contradicts.
    """
    ends = (one.earlier, two.earlier), (one.later, two.later)
    if any(keyframes[a].session != keyframes[b].session for a, b in ends):
        return True

    def odometry(first: int, second: int) -> tuple[gtsam.Pose3, FloatArray]:
        return odometry_between(keyframes[first], keyframes[second], config)

    start, start_covariance = odometry(one.earlier, two.earlier)
    end, end_covariance = odometry(two.later, one.later)
    rest = two.earlier_T_later.compose(end)
    by_start, by_loop = rest.inverse().AdjointMap(), end.inverse().AdjointMap()
    covariance = end_covariance + by_start @ start_covariance @ by_start.T
    covariance = covariance + by_loop @ two.covariance @ by_loop.T
    distance = chi_squared(
        one.earlier_T_later, one.covariance, start.compose(rest), covariance, included=False
    )
    return distance <= config.max_chi2
