"""First motions of a run, and which of them explains the sweeps best: docs/maths/start.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.config import Config, RelocalizationConfig
from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.geometry import five_sigma, transform
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.registration.odometry import Moment, advance
from loam_gtsam.registration.relocalization.evidence import CHANCE, Evidence, Favour, favour
from loam_gtsam.registration.relocalization.fits import beyond_any_motion, same, step_in_map
from loam_gtsam.registration.solvers import MotionPrior, Solution
from loam_gtsam.types import FloatArray

_UNLIKELY = five_sigma(6)  # from which on a pose contradicts factors
_SURELY = 5.0  # standard deviations beyond which the scans alone tell
_HARDLY = 2.0  # standard deviations: one of twenty right ways is worse by chance


@dataclass(frozen=True, slots=True, eq=False)
class EarlySweep:
    """One of the first sweeps of a run, where it is in the map.

    Attributes
    ----------
    posed : the sweep, de-skewed
    map_T_middle : pose at the middle of the sweep
    expected : the expected motion, for directions that the scan does not fix
    keyframe : number of the keyframe to which the points belong
    told : what further factors say of the pose, whichever way leads there; None without any
    moved : what they say of the pose seen from the sweep before; None without any
    turned : what a gyro says of that pose, the rotation; None without one
    velocity : (6,) rad/s and m/s in the middle of the sweep, as its matches tell; None if untold
    """

    posed: PosedSweep
    map_T_middle: gtsam.Pose3
    expected: MotionPrior
    keyframe: int
    told: MotionPrior | None = None
    moved: MotionPrior | None = None
    turned: MotionPrior | None = None
    velocity: FloatArray | None = None

    @property
    def untold(self) -> EarlySweep:
        """The sweep where it is, as if its matches told no velocity."""
        return replace(self, velocity=None)

    def put(self, map_T_middle: gtsam.Pose3) -> EarlySweep:
        """The sweep at another pose, where its matches have told no velocity."""
        return replace(self, map_T_middle=map_T_middle, velocity=None)

    @property
    def moment(self) -> Moment:
        """The middle of the sweep."""
        return Moment(self.posed.sweep.stamp, self.map_T_middle, True)

    def factors(self, before: EarlySweep) -> list[MotionPrior]:
        """What further factors say of the pose, with the sweep before where it is."""
        told = () if self.told is None else (self.told,)
        return [*told, *_seen_from(before, self.moved)]

    def turn(self, before: EarlySweep) -> list[MotionPrior]:
        """What a gyro says of it."""
        return _seen_from(before, self.turned)


def _seen_from(before: EarlySweep, moved: MotionPrior | None) -> list[MotionPrior]:
    """What is known of a pose seen from the sweep before, with that where it is; if anything is."""
    if moved is None:
        return []
    return [replace(moved, map_T_lidar=before.map_T_middle.compose(moved.map_T_lidar))]


class Tried(NamedTuple):
    """A sweep, registered with the map of those before it."""

    evidence: Evidence
    sweeps: list[EarlySweep]  # it and those before it
    solution: Solution

    @property
    def moved(self) -> gtsam.Pose3:
        """The last sweep, seen from the first one."""
        return self.sweeps[0].map_T_middle.between(self.sweeps[-1].map_T_middle)


Way = tuple[Tried, ...]
"""A first motion and where it led: the sweeps after the first, one after the other."""


def continued(sweeps: Sequence[EarlySweep], stamp: int) -> gtsam.Pose3:
    """Where the motion between the last two sweeps leads by a stamp, nanoseconds."""
    before, last = sweeps[-2:]
    return advance(last.map_T_middle, mean_twist(before, last), last.moment.seconds_to(stamp))


def by_second_step(sweeps: Sequence[EarlySweep]) -> list[list[EarlySweep]]:
    """Of three sweeps, the first two by the motion between the last two, if that leads elsewhere.

    The first motion was searched for on a grid, with two sweeps that may see little of each other.
    """
    if len(sweeps) != 3:
        return []
    first, second, third = sweeps
    seconds = first.moment.seconds_to(second.moment.stamp)
    place = advance(first.map_T_middle, mean_twist(second, third), seconds)
    led = [first.untold, second.put(place)]
    return [] if same(place, second.map_T_middle) else [led]


def steady(sweeps: Sequence[EarlySweep], moved: gtsam.Pose3) -> list[EarlySweep]:
    """The sweeps at constant velocity, the last one ``moved`` from the first."""
    first = sweeps[0].moment
    seconds = [first.seconds_to(one.moment.stamp) for one in sweeps]
    twist = gtsam.Pose3.Logmap(moved) / seconds[-1]
    poses = [first.map_T_lidar, *(advance(first.map_T_lidar, twist, s) for s in seconds[1:])]
    return [one.put(pose) for one, pose in zip(sweeps, poses, strict=True)]


def moved_with_first(
    sweeps: Sequence[EarlySweep], solutions: Sequence[Solution]
) -> list[EarlySweep]:
    """Sweeps that were solved, all moved with the first one to where that was.

    What pushes every sweep off a map, as planes through curved ground do, then pushes none away
    from another. Along ways that no planes fix the first one was held.
    """
    first, solved = sweeps[0].map_T_middle, solutions[0]
    pushed = first.localCoordinates(solved.map_T_lidar)
    if solved.unseen is not None:
        pushed = pushed - solved.unseen @ pushed
    back = first.compose(first.retract(pushed).inverse())
    pairs = zip(sweeps[1:], solutions[1:], strict=True)
    moved = [
        replace(s, map_T_middle=back.compose(f.map_T_lidar)) if f.solved else s for s, f in pairs
    ]
    return [sweeps[0], *moved]


def parting(
    sweeps: Sequence[EarlySweep], rivals: Sequence[Sequence[EarlySweep]], near: float
) -> FloatArray:
    """Mean square (6, 6) of the velocity at which any of some rivals parts from a way, map axes.

    One that leads to another place and goes on as the way does, as in rows that repeat, does not
    part from it: it is less than ``near``, metres, farther away at its end than at its beginning.
    Of two that part one follows what moves, which may turn: the velocity has any direction.
    """
    total = np.zeros((6, 6))
    for rival in rivals:
        ends = (sweeps[1], rival[1]), (sweeps[len(rival) - 1], rival[-1])
        first, last = (step_in_map(one.map_T_middle, other.map_T_middle) for one, other in ends)
        apart = last - first
        if np.linalg.norm(apart[3:]) > near:
            apart /= rival[1].moment.seconds_to(rival[-1].moment.stamp)
            squares = np.repeat([apart[:3] @ apart[:3], apart[3:] @ apart[3:]], 3)
            total += np.diag(squares) / (1 + len(rivals))
    return total


def mean_twist(one: EarlySweep, other: EarlySweep) -> FloatArray:
    """Mean body velocity (6,) from one sweep to the next, rad/s and m/s."""
    return one.moment.twist_to(other.moment.stamp, other.map_T_middle)


def turned_anew(sweeps: Sequence[EarlySweep], imu: ImuBuffer) -> list[EarlySweep]:
    """The sweeps, turned by a gyro whose bias is better known by now."""
    return [
        replace(sweep, posed=sweep.posed.sweep.turned_anew(imu).at(sweep.posed.twist))
        for sweep in sweeps
    ]


def without_turns(sweeps: Sequence[EarlySweep]) -> list[EarlySweep]:
    """The sweeps, de-skewed as if no IMU had been there."""
    return [
        replace(sweep, posed=sweep.posed.sweep.without_turns().at(sweep.posed.twist), turned=None)
        for sweep in sweeps
    ]


def kept_ways(ways: Sequence[Way], config: Config, silent: Sequence[Way] = ()) -> list[Way]:
    """The best of some ways, and after it those that are as good, but for chance.

    The first one is the way that was taken. If some acceleration explains it, others that none
    explains are no ways; nor are those that further factors contradict, unless they contradict
    all. Of ``silent`` ones no scan tells whether they are as good.
    """
    least, near = config.solver.min_aligned, config.map.plane_voxel
    ways = [way for way in ways if _as_told(way)] or ways
    silent = [way for way in silent if _as_told(way)]
    if _drivable(ways[0], config.relocalization):
        ways = [way for way in ways if _drivable(way, config.relocalization)]
    best = ways[0]
    for way in ways[1:]:
        if _better(way, best, least):
            best = way
    kept = [best]
    as_good = [way for way in ways if _favour(way, best, moving=True).every > -CHANCE]
    for way in (*as_good, *silent):
        if all(_apart(way, other, near) for other in kept):
            kept.append(way)
    return kept


def is_surely_beaten(ways: Sequence[Way]) -> bool:
    """Whether some way is better than the first one, by more than chance among many.

    Of ten places along a row of posts one may be better by three standard deviations.
    """
    return any(_favour(way, ways[0]).every > _SURELY for way in ways[1:])


def as_good(
    one: Way, other: Way, least: float, less: float = _HARDLY, *, moving: bool = False
) -> bool:
    """Whether a way to a place that was merely looked for is as good as another one.

    It is if hardly more speaks against it, by so many standard deviations ``less``, with all that
    it contradicts unless that may be ``moving``: from a place beside the right one, walls and trees
    lead halfway there. More than ``least`` features, counted as if they lay across, must tell the
    two apart at all.
    """
    told = _favour(one, other, moving=moving)
    return told.every > -less and told.said > least


def tell_nothing(one: Way, other: Way, least: float) -> bool:
    """Whether fewer than ``least`` features, counted as if they lay across, tell two ways apart."""
    return _favour(one, other).said < least


def _as_told(way: Way) -> bool:
    """Whether further factors contradict no pose of a way, by their covariances."""
    pairs = pairwise(way[-1].sweeps)
    return not any(_contradicts(told, now) for last, now in pairs for told in now.factors(last))


def as_turned(way: Way, felt: EarlySweep) -> bool:
    """Whether what a gyro says of the second sweep does not contradict it where a way has it."""
    first, second = way[0].sweeps
    return not any(_contradicts(told, second) for told in felt.turn(first))


def _contradicts(told: MotionPrior, sweep: EarlySweep) -> bool:
    away = told.map_T_lidar.localCoordinates(sweep.map_T_middle)
    return bool(away @ told.information @ away > _UNLIKELY)


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
    seen = transform(one[-1].sweeps[-1].map_T_middle.inverse().matrix(), one[-1].evidence.points)
    ends = [transform(way[-1].moved.matrix(), seen) for way in (one, other)]
    away = np.linalg.norm(ends[0] - ends[1], axis=1)
    return bool(np.count_nonzero(away > near) > 0.5 * len(away))


def _better(tried: Way, best: Way, least: float) -> bool:
    """Whether one way is better than another by more than chance.

    Neither lines nor planes may speak against it: at rest few lines are found, for next to a point
    lie those of its own ring. ``least`` is the number of features at least, counted as if they lay
    across.
    """
    told = _favour(tried, best)
    agreed = min(told.lines, told.planes) > -CHANCE
    return told.every > CHANCE and agreed and told.weight > least


def _favour(tried: Way, best: Way, *, moving: bool = False) -> Favour:
    found = [one.evidence for one in tried]
    return favour(found, [one.evidence for one in best], moving=moving)
