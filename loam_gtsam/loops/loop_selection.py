"""Selection of the loop closures that are used, each time a new one comes.

Of loop closures that contradict each other the larger number is believed that agree pairwise
(Mangelson et al., Pairwise Consistent Measurement Set Maximization, ICRA 2018). Then the squared
Mahalanobis distance of each from what all the others say decides, one by one. Equations:
docs/maths/pose_graph.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from loam_gtsam.config import PoseGraphConfig
from loam_gtsam.loops.consistency import (
    chi_squared,
    consistent,
    consistent_set,
    loop_to_switch,
)
from loam_gtsam.loops.incremental import IncrementalGraph
from loam_gtsam.loops.keyframes import Keyframe, LoopClosure, pose_key

_LIKELY = 12.6
"""Squared Mahalanobis distance that 95 % of right loop closures do not exceed."""
_SWITCHES = 50
"""Largest number of loop closures that are switched one by one after a new one."""


class LoopSelection:
    """Loop closures of a graph, and which of them are active.

    Parameters
    ----------
    config : ``max_chi2``, ``believed_loops``, ``kernel_width``, ``walk`` and ``turn_walk_deg`` are
        used
    graph : the graph, in which the loop closures are switched
    keyframes : the list of the graph, which grows
    loops : those that are in the graph; :meth:`add` appends the new one
    """

    def __init__(
        self,
        config: PoseGraphConfig,
        graph: IncrementalGraph,
        keyframes: Sequence[Keyframe],
        loops: list[LoopClosure],
    ) -> None:
        self.config = config
        self._graph, self._keyframes, self._loops = graph, keyframes, loops
        # One byte for each pair, a row for each loop closure: 0 unknown, 1 inconsistent, 2 not.
        self._compared: list[bytearray] = []

    def add(self, loop: LoopClosure) -> bool:
        """Add a loop closure, and switch off those that contradict the rest of the graph.

        All are tested anew, since right ones make it easier to tell wrong ones.

        Returns
        -------
        Whether the new one is active.
        """
        number = len(self._loops)
        factor = gtsam.NonlinearFactorGraph()
        factor.add(loop.factor(self.config.kernel_width))
        self._loops.append(loop)
        self._graph.add_loop(factor)
        on = set(np.flatnonzero(self._graph.active).tolist())
        distance = self.chi_squared(number)
        if distance <= min(_LIKELY, self.config.max_chi2):
            # It changes little, so of the others only the inactive ones are tested anew.
            self._graph.switch(number, True)
            self._settle(sorted(set(range(number)) - on))
            return self._graph.is_active(number)
        agrees = on <= self._agreeing(number)
        if agrees and distance <= self.config.max_chi2:
            self._graph.switch(number, True)
        else:
            most = consistent_set(number, self._agreeing)
            # The others were the wrong ones, or the odometry is worse than its covariance says.
            if len(most) > max(len(on), self.config.believed_loops - 1 if agrees else 0):
                for other in sorted(on - most):
                    self._graph.switch(other, False)
                for other in sorted(most - on):
                    self._graph.switch(other, True)
        if set(np.flatnonzero(self._graph.active).tolist()) != on:
            self._settle(range(len(self._loops)))
        return self._graph.is_active(number)

    def chi_squared(self, number: int) -> float:
        """Squared Mahalanobis distance of a loop closure from what all other factors say."""
        loop = self._loops[number]
        between, covariance = self._graph.relative(pose_key(loop.earlier), pose_key(loop.later))
        on = self._graph.is_active(number)
        return chi_squared(loop.earlier_T_later, loop.covariance, between, covariance, included=on)

    def _agreeing(self, number: int) -> set[int]:
        """Numbers of the other loop closures that are consistent with one."""
        return {n for n in range(len(self._loops)) if n != number and self._agree(n, number)}

    def _agree(self, one: int, two: int) -> bool:
        """Whether two loop closures are consistent; each pair is compared once."""
        first, second = min(one, two), max(one, two)
        while len(self._compared) <= second:
            self._compared.append(bytearray(len(self._compared)))
        row = self._compared[second]
        if not row[first]:
            loops = self._loops[second], self._loops[first]
            row[first] = 1 + consistent(*loops, self._keyframes, self.config)
        return row[first] == 2

    def _settle(self, numbers: Sequence[int]) -> None:
        """Switch some of the loop closures one by one until all agree with their tests."""
        for _ in range(_SWITCHES):
            distances = np.array([self.chi_squared(number) for number in numbers])
            on = np.array([self._graph.is_active(number) for number in numbers])
            place = loop_to_switch(on, distances, self.config.max_chi2)
            if place is None:
                break
            self._graph.switch(numbers[place], not on[place])
