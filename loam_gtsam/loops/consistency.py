"""Tests of a loop closure: against the rest of the graph, and against other loop closures.

* The squared Mahalanobis distance of a loop closure from what all other factors say, whether the
  loop closure is in the graph or not: equations (1) and (2) of docs/maths/pose_graph.md.
* Pairwise consistency: whether two loop closures and the odometry between their ends make a cycle
  that closes, equation (3) (Mangelson, Dominic, Eustice and Vasudevan, Pairwise Consistent
  Measurement Set Maximization for Robust Multi-Robot Map Merging, ICRA 2018).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from loam_gtsam.config import PoseGraphConfig
from loam_gtsam.geometry import symmetric
from loam_gtsam.loops.keyframes import Keyframe, LoopClosure, odometry_between
from loam_gtsam.types import BoolArray, FloatArray


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
    measured : motion between two poses
    noise : (6, 6) covariance of ``measured``
    between : the same motion, according to the graph
    covariance : (6, 6) covariance of ``between``
    included : whether the measured motion is a factor of the graph
    """
    residual = gtsam.Pose3.Logmap(measured.between(between))
    scatter = noise - covariance if included else noise + covariance
    values, vectors = np.linalg.eigh(symmetric(scatter))
    # An included motion that alone fixes some direction cannot be contradicted in that direction.
    least = 1e-9 * float(np.trace(noise)) / 6.0
    parts = (vectors.T @ residual) ** 2 / np.maximum(values, least)
    return float(parts[values > least].sum())


def relative_pose_covariance(
    between: gtsam.Pose3, joint: gtsam.JointMarginal, earlier: int, later: int
) -> FloatArray:
    """(6, 6) covariance of ``earlier_T_later`` from the joint covariance of both poses."""
    to_later = between.inverse().AdjointMap()
    own, other = joint.at(earlier, earlier), joint.at(later, later)
    crossed = to_later @ joint.at(earlier, later)
    covariance: FloatArray = to_later @ own @ to_later.T + other - crossed - crossed.T
    return covariance


def loop_to_switch(active: BoolArray, distances: FloatArray, max_chi2: float) -> int | None:
    """The loop closure that greedy selection switches next, off or on.

    Parameters
    ----------
    active : (L,) which loop closures are in the graph
    distances : (L,) squared Mahalanobis distance of each from what all the others say
    max_chi2 : largest distance of a loop closure that agrees with the others

    Returns
    -------
    The active loop closure that contradicts the others most, or else the inactive one that fits
    best; None if all active ones agree with the others and all inactive ones contradict them.
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

    Parameters
    ----------
    number : number of the given loop closure
    agreeing : gives the numbers of the other loop closures that agree with one
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
