"""Selection of the loop closures that are used: how each is tested, and what a new one changes.

Their squared Mahalanobis distance from what all other factors say decides. Of those that contradict
each other the larger set that agrees pairwise is believed (Mangelson et al., Pairwise Consistent
Measurement Set Maximization, ICRA 2018). Equations (1) to (3): docs/maths/pose_graph.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from loam_gtsam.config import PoseGraphConfig
from loam_gtsam.geometry import symmetric
from loam_gtsam.loops.incremental import IncrementalGraph
from loam_gtsam.loops.keyframes import Keyframe, LoopClosure, numbered, odometry_between, pose_key
from loam_gtsam.types import BoolArray, FloatArray

_LIKELY = 12.6  # squared Mahalanobis distance that 95 % of right loop closures do not exceed
_DRIFT = np.radians(0.02), 0.01
"""rad and metres a metre of way, by which an odometry may be off beyond its covariance. LOAM has
0.55 % and 0.0013 degrees a metre on KITTI (Zhang and Singh, Autonomous Robots 41, 2017)."""
_SWITCHES = 50  # largest number of loop closures that are switched one by one after a new one


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
    measured, noise : motion between two poses and its (6, 6) covariance
    between, covariance : the same according to the graph
    included : whether the measured motion is a factor of the graph
    """
    residual = gtsam.Pose3.Logmap(measured.between(between))
    scatter = noise - covariance if included else noise + covariance
    values, vectors = np.linalg.eigh(symmetric(scatter))
    # An included motion that alone fixes some direction cannot be contradicted in that direction.
    least = 1e-9 * float(np.trace(noise)) / 6.0
    parts = (vectors.T @ residual) ** 2 / np.maximum(values, least)
    return float(parts[values > least].sum())


def may_be_drift(
    measured: gtsam.Pose3,
    noise: FloatArray,
    between: gtsam.Pose3,
    covariance: FloatArray,
    way: float,
) -> bool:
    """Whether an odometry may have drifted by so much that a measured motion is right.

    A place that looks the same is one storey or one aisle off after any way, drift grows with it.

    Parameters
    ----------
    measured, noise, between, covariance : see :func:`chi_squared`, but of the odometry alone
    way : metres between the two poses
    """
    away = gtsam.Pose3.Logmap(measured.between(between))
    drift = np.diag(np.repeat(_DRIFT, 3) ** 2) * way**2
    return float(away @ np.linalg.solve(drift + _LIKELY * (noise + covariance), away)) <= 1.0


def loop_to_switch(active: BoolArray, distances: FloatArray, max_chi2: float) -> int | None:
    """The loop closure that greedy selection switches next, off or on.

    Of L loop closures the active one that contradicts the others most, by their ``chi_squared``, or
    else the inactive one that fits best; None if active ones agree and inactive ones contradict.
    """
    if len(active) == 0:
        return None
    worst = int(np.where(active, distances, -1.0).argmax())
    best = int(np.where(active, np.inf, distances).argmin())
    if active[worst] and distances[worst] > max_chi2:
        return worst
    return best if not active[best] and distances[best] <= max_chi2 else None


def consistent_set(number: int, agreeing: Callable[[int], set[int]]) -> set[int]:
    """Loop closures that agree pairwise, a given one among them: as many as greedy search finds.

    ``agreeing`` gives the numbers of the other loop closures that agree with one.
    """
    others = {other: agreeing(other) for other in agreeing(number)}
    chosen = {number}
    for other in sorted(others, key=lambda n: (-len(others[n]), n)):
        if chosen <= others[other]:
            chosen.add(other)
    return chosen


def consistent(
    one: LoopClosure, two: LoopClosure, keyframes: Sequence[Keyframe], config: PoseGraphConfig
) -> bool:
    """Whether two loop closures and the odometry between their ends make a cycle that closes.

    Ends in different sessions have no odometry between them, so nothing contradicts them.
    """
    ends = (one.earlier, two.earlier), (one.later, two.later)
    first, second, last, before = (numbered(keyframes, index) for pair in ends for index in pair)
    if first.session != second.session or last.session != before.session:
        return True
    start, start_covariance = odometry_between(first, second, config)
    end, end_covariance = odometry_between(before, last, config)
    rest = two.earlier_T_later.compose(end)
    by_start, by_loop = rest.inverse().AdjointMap(), end.inverse().AdjointMap()
    covariance = end_covariance + by_start @ start_covariance @ by_start.T
    covariance = covariance + by_loop @ two.covariance @ by_loop.T
    seen, said = (one.earlier_T_later, one.covariance), (start.compose(rest), covariance)
    return chi_squared(*seen, *said, included=False) <= config.max_chi2


class LoopSelection:
    """Loop closures of a graph, and which of them are active.

    Parameters
    ----------
    graph : in which they are switched
    keyframes, loops : lists of the graph, which grow; :meth:`add` appends to ``loops``
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
        """Add a loop closure; returns whether it is active."""
        # All are tested anew, since right ones make it easier to tell wrong ones.
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
        if on <= self._agreeing(number) and distance <= self.config.max_chi2:
            self._graph.switch(number, True)
        else:
            most = consistent_set(number, self._agreeing)
            if len(most) > len(on):
                self._replace(on, most, number)
        if set(np.flatnonzero(self._graph.active).tolist()) != on:
            self._settle(range(len(self._loops)))
        return self._graph.is_active(number)

    def _replace(self, on: set[int], most: set[int], number: int) -> None:
        """Switch from some loop closures to more, a given one among them, which agree.

        Either the others were wrong, or the odometry is worse than its covariance says. Only many
        are believed against it, and only if they may be its drift.
        """
        wrong = sorted(on - most)
        for other in wrong:
            self._graph.switch(other, False)
        many = len(most) >= self.config.believed_loops
        believed = many and all(map(self._may_be_drift, most))
        if wrong and not believed:  # without wrong ones it is as it was: too far away
            believed = self.chi_squared(number) <= self.config.max_chi2
        for other in sorted(most - on) if believed else wrong:
            self._graph.switch(other, True)

    def forget(self, count: int) -> None:
        """Forget the last ``count`` loop closures, which the graph has none of any more."""
        del self._loops[len(self._loops) - count :]
        del self._compared[len(self._loops) :]

    def chi_squared(self, number: int) -> float:
        """Squared Mahalanobis distance of a loop closure from what all other factors say."""
        loop = self._loops[number]
        between, covariance = self._graph.relative(pose_key(loop.earlier), pose_key(loop.later))
        on = self._graph.is_active(number)
        return chi_squared(loop.earlier_T_later, loop.covariance, between, covariance, included=on)

    def _may_be_drift(self, number: int) -> bool:
        loop = self._loops[number]
        first, last = (numbered(self._keyframes, index) for index in (loop.earlier, loop.later))
        if first.session != last.session:  # no odometry, which may be right or wrong
            return True
        between, way = odometry_between(first, last, self.config), last.travelled - first.travelled
        return may_be_drift(loop.earlier_T_later, loop.covariance, *between, way)

    def _agreeing(self, number: int) -> set[int]:
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
