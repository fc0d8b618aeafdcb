"""First motions of a run, and which of them explains the sweeps best: docs/maths/start.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.config import Config, RelocalizationConfig
from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.geometry import transform
from loam_gtsam.registration.matches import ChosenRows
from loam_gtsam.registration.odometry import Moment, advance
from loam_gtsam.registration.relocalization import agreeing, beyond_any_motion
from loam_gtsam.registration.solvers import MotionPrior, Solution
from loam_gtsam.types import BoolArray, FloatArray

_AGAINST = 5.0
"""Number of features that agree which one outweighs that contradicts. At the right place 3 of 1000
matches contradict by noise, at a wrong one ten times as many (medians of 315 starts, of which 10
go wrong, and at most 14 with any number from 3 to 10)."""
_CHANCE = 3.0  # standard deviations beyond which a difference is no chance
_TINY = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class EarlySweep:
    """One of the first sweeps of a run, where it is in the map.

    Attributes
    ----------
    posed : the sweep, de-skewed
    map_T_middle : pose at the middle of the sweep
    held : whether further factors decided on the pose, which is then left as it is
    expected : the expected motion, for directions that the scan does not fix
    keyframe : number of the keyframe to which the points belong
    """

    posed: PosedSweep
    map_T_middle: gtsam.Pose3
    held: bool
    expected: MotionPrior
    keyframe: int

    @property
    def moment(self) -> Moment:
        """The middle of the sweep."""
        return Moment(self.posed.sweep.stamp, self.map_T_middle, True)


class Tried(NamedTuple):
    """A sweep, registered with the map of those before it."""

    edges: int  # number of edges, which come first among the features that may be matched
    points: FloatArray  # (F, 3) where these are in the map
    evidence: FloatArray  # (F,) what each says of the motion, see :func:`evidence_of`
    axes: FloatArray  # (F, 3) of their lines and planes
    sweeps: list[EarlySweep]  # it and those before it
    solution: Solution

    @property
    def share(self) -> float:
        """Share of the features whose matches agree."""
        return float(np.count_nonzero(self.evidence > 0.0)) / max(len(self.evidence), 1)


Way = tuple[Tried, ...]
"""A first motion and where it led: the sweeps after the first, one after the other."""


def continued(sweeps: Sequence[EarlySweep], stamp: int) -> gtsam.Pose3:
    """Where the motion between the last two sweeps leads by a stamp, nanoseconds."""
    before, last = sweeps[-2:]
    return advance(last.map_T_middle, mean_twist(before, last), last.moment.seconds_to(stamp))


def mean_twist(one: EarlySweep, other: EarlySweep) -> FloatArray:
    """Mean body velocity (6,) from one sweep to the next, rad/s and m/s."""
    moved = gtsam.Pose3.Logmap(one.map_T_middle.between(other.map_T_middle))
    twist: FloatArray = moved / one.moment.seconds_to(other.moment.stamp)
    return twist


def without_turns(sweeps: Sequence[EarlySweep]) -> list[EarlySweep]:
    """The sweeps, de-skewed as if no IMU had been there."""
    return [
        replace(sweep, posed=sweep.posed.sweep.without_turns().at(sweep.posed.twist))
        for sweep in sweeps
    ]


def evidence_of(rows: ChosenRows, solution: Solution) -> tuple[FloatArray, FloatArray]:
    """What each feature (F,) says of a place, and the axis (F, 3) of its line or plane.

    It is 1 if its match agrees, -5 if it contradicts, and 0 without a match.
    """
    evidence, axes = np.zeros(len(rows)), np.zeros((len(rows), 3))
    if solution.solved:
        edges, planes = solution.matches.edges, solution.matches.planes
        lines = np.searchsorted(rows.edges, edges.indices)
        others = len(rows.edges) + np.searchsorted(rows.planes, planes.indices)
        for places, agree in zip((lines, others), agreeing(solution.matches), strict=True):
            evidence[places] = np.where(agree, 1.0, -_AGAINST)
        axes[lines], axes[others] = edges.directions, planes.normals
    return evidence, axes


def kept_ways(ways: Sequence[Way], config: Config) -> list[Way]:
    """The best of some ways, and after it those that are as good, but for chance.

    The first one is the way that was taken. If some acceleration explains it, others that none
    explains are no ways.
    """
    least, near = config.solver.min_aligned, config.map.plane_voxel
    if _drivable(ways[0], config.relocalization):
        ways = [way for way in ways if _drivable(way, config.relocalization)]
    best = ways[0]
    for way in ways[1:]:
        if _better(way, best, least):
            best = way
    kept = [best]
    for way in ways:
        apart = all(_apart(way, other, near) for other in kept)
        if apart and min(_signs(way, best)[:3]) > -_CHANCE:
            kept.append(way)
    return kept


def _drivable(way: Way, config: RelocalizationConfig) -> bool:
    """Whether some acceleration explains each change of the velocity on a way."""
    sweeps = way[-1].sweeps
    for number in range(2, len(sweeps)):
        last, now = sweeps[number - 1].moment, sweeps[number].moment
        expected = continued(sweeps[:number], now.stamp)
        step = expected.localCoordinates(now.map_T_lidar)
        if beyond_any_motion(step, last.seconds_to(now.stamp), config):
            return False
    return True


def _apart(one: Way, other: Way, near: float) -> bool:
    """Whether most features of the last sweep are farther than ``near``, metres, from each other.

    Compared are the motions since the first sweep, not the points, which are de-skewed for them.
    """
    moved = [
        way[-1].sweeps[0].map_T_middle.between(way[-1].sweeps[-1].map_T_middle)
        for way in (one, other)
    ]
    seen = transform(one[-1].sweeps[-1].map_T_middle.inverse().matrix(), one[-1].points)
    ends = [transform(pose.matrix(), seen) for pose in moved]
    away = np.linalg.norm(ends[0] - ends[1], axis=1)
    return bool(np.count_nonzero(away > near) > 0.5 * len(away))


def _better(tried: Way, best: Way, least: float) -> bool:
    """Whether one way is better than another by more than chance.

    Neither lines nor planes may speak against it: at rest few lines are found, for next to a point
    lie those of its own ring. ``least`` is the number of features at least, counted as if they lay
    across.
    """
    every, lines, planes, weight = _signs(tried, best)
    return every > _CHANCE and min(lines, planes) > -_CHANCE and weight > least


def _signs(tried: Way, best: Way) -> tuple[float, float, float, float]:
    """How much speaks for one way against another.

    In standard deviations, of all features, of lines and of planes; and the number of features that
    speak for it more than against it. The sweeps see the same things, and count as one.
    """
    found = [_gain(*pair) for pair in zip(tried, best, strict=True)]
    gain, edge = (np.concatenate(parts) for parts in list(zip(*found, strict=True))[:2])
    every, lines, planes = (
        float(part.sum() / max(np.sqrt(len(found)) * np.linalg.norm(part), _TINY))
        for part in (gain, gain[edge], gain[~edge])
    )
    return every, lines, planes, sum(weight for _, _, weight in found) / len(found)


def _gain(tried: Tried, best: Tried) -> tuple[FloatArray, BoolArray, float]:
    """What each feature (F,) says for one place against another, which are edges, and their number.

    A feature counts as far as its line or plane lies across the way from one place to the other:
    ground and walls along the way agree at both, but for chance.
    """
    edge = np.arange(len(best.points)) < best.edges
    way = tried.points - best.points
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), _TINY)
    matched = [one.axes.any(axis=1) for one in (tried, best)]
    along = [np.einsum("ij,ij->i", one.axes, way) ** 2 for one in (tried, best)]
    each = [
        has * np.where(edge, 1.0 - cosine, cosine)
        for has, cosine in zip(matched, along, strict=True)
    ]
    across = np.sqrt(np.clip(sum(each) / np.maximum(sum(matched), 1), 0.0, 1.0))
    gain = across * (tried.evidence - best.evidence)
    return gain, edge, float(across @ gain)
