"""The start of a run: the first sweeps are registered together, before the map is relied on.

A map of one sweep is thin, and distorted by a motion that nobody knows yet. An error made in it
would stay for good. Therefore the first motion is searched for, and the first eight sweeps are
registered again and again, each with the map of all the others. With the eighth, the motion is
searched for once more. While another motion may be the true one, the start goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.geometry import transform
from loam_gtsam.registration.frame_matcher import Frame, MapPair
from loam_gtsam.registration.imu_tracker import ImuTracker
from loam_gtsam.registration.odometry import Prediction
from loam_gtsam.registration.relocalization import (
    Field,
    Found,
    any_of,
    distinct,
    likely_poses,
    same,
    sample_features,
)
from loam_gtsam.registration.relocalization.fits import APART, FASTEST
from loam_gtsam.registration.relocalization.likely_poses import MORE_EDGES
from loam_gtsam.registration.solvers import MotionPrior
from loam_gtsam.registration.solvers.own_factors import NamedSolver
from loam_gtsam.registration.start.early_map import EarlyMap
from loam_gtsam.registration.start.ways import (
    EarlySweep,
    Tried,
    Way,
    as_good,
    as_turned,
    by_second_step,
    continued,
    is_surely_beaten,
    kept_ways,
    parting,
    steady,
    tell_nothing,
    turned_anew,
    without_turns,
)
from loam_gtsam.types import SweepMotion

_TOGETHER = (2, 3, 5, 8)
"""Numbers of sweeps at which all are registered anew: each time half as many more or so."""
_IN_DOUBT = (12, 18, 27)
"""And at which they are once more, while features tell a rival from the way that was taken: what
explains a few sweeps by chance is refuted by more. Past pylons one at 40 m/s is gone at 12."""
_ONCE = (3, 5)
"""Numbers at which each is then registered with the map of the others once, and not twice, unless
there are rivals: without them a second time makes no world's trajectory better by more than 3 %."""
_FEW = 3
"""Rivals beyond which a place is blind along the way, as a tunnel: further sweeps refute none."""
_PLACES = 12  # most motions between the first two sweeps that are tried beside the expected one
_LIKELY = 0.5
"""Part of the best place's score below which a place is not tried. The place next to the true one
had 0.68 at least in 60 drawn starts; with 0.6, two of 18 with a view of 70 degrees go wrong."""
_NEAR = (0.8, APART[1])
"""Metres and rad within which a place leads where another one did: less than the 1 m between trial
places. In a corridor two sweeps that are registered from 0.7 m away do not find each other."""
_HOPEFUL = 0.5
"""Part of the best place's share, by few matches, below which a place is not looked at closer."""
_ELSEWHERE = 4
"""Most places of the eighth sweep that are tried beside its own. With 12, of 20 drawn starts that
follow something one more is told, and the eighth sweep of a corridor takes half as long again."""
_LESS = 1.0
"""Standard deviations by which few matches may speak less for one of these. Against boxes that were
followed what stood had 0.4 less at most; in the right map places a metre off have one to three."""
_FARTHEST = 30.0  # metres: largest distance between the first two sweeps
_KNOWN_TURN = np.diag(np.repeat([np.radians(0.3) ** -2, 0.0], 3))
"""Information of the rotation between two sweeps by a gyro: above its noise and its bias."""
_TURNING = 3.0  # rad/s: largest turn rate of a first motion about the vertical axis


class Start:
    """The first sweeps of a run; the pose of the very first at its reference time never changes."""

    def __init__(self, first: Prediction, keyframe: int) -> None:
        self._map_T_first = first.map_T_lidar
        self._sweeps = [EarlySweep(first.posed, first.map_T_middle, first.motion, keyframe)]
        self._rivals: list[list[EarlySweep]] = []
        """The sweeps on other ways, which explain them as well, but for chance."""
        self._refutable = False  # whether features tell one of these from the way that was taken
        self._still = False  # whether an IMU was at rest when the run began, as far as scans tell
        self._heeds_gyro = False  # whether its rotation is a factor: the scans alone did not agree
        self._anew = False  # whether the sweeps are to be registered anew with the next one

    @classmethod
    def of_map(cls, first: Prediction, maps: MapPair) -> Start | None:
        """The start of a map; None if no sweep is de-skewed anew, or the map is there already."""
        begins = maps.config.deskew.model != "predicted" and not maps.given
        return cls(first, maps.keyframe) if begins else None

    @property
    def complete(self) -> bool:
        """Whether all sweeps of the start are there; more of them while they may refute a rival."""
        return len(self._sweeps) >= (_IN_DOUBT if self._refutable else _TOGETHER)[-1]

    def later(self, nanoseconds: int) -> Start | None:
        """The start on a clock that was set ahead by so much; None if it has begun to move.

        The motion between its sweeps does not go on over a clock that is set, or a long pause.
        """
        if len(self._sweeps) > 1:
            return None
        (first,) = self._sweeps
        self._sweeps = [replace(first, posed=first.posed.later(nanoseconds))]
        return self

    def first_motion(
        self, frame: Frame, expected: Found, solver: NamedSolver, imu: ImuTracker | None = None
    ) -> Found:
        """Search for the motion between the first two sweeps; returns ``expected`` for later ones.

        The places where the second sweep may have been taken are tried, each with both sweeps
        de-skewed for the motion that leads there. Another place than the expected one is chosen if
        more of the features that tell the two apart are for it than by chance.
        """
        if len(self._sweeps) > 1:
            return expected
        self._still = imu is not None and imu.was_still
        early, first = EarlyMap(frame, solver, self._map_T_first), self._sweeps[0]
        predicted, found = frame.predicted, expected.solution.map_T_lidar
        told, moved = _told(frame, found, first, solver)
        second = EarlySweep(frame.matcher.posed, found, predicted.motion, 0, told, moved)
        seconds = first.moment.seconds_to(frame.sweep.stamp)
        centres = _centres(predicted.map_T_middle, first.map_T_middle)
        within = min(FASTEST * seconds, _FARTHEST), _TURNING * seconds
        places = _likely(first, second, centres, _PLACES, within)
        ways = _ways(early, first, second, places)
        turned = _turned(frame, first, imu)
        if imu is not None and turned is not None:
            ways = self._by_gyro(early, replace(second, turned=turned), within, places, ways, imu)
        (best,) = self._best(ways, early.config)
        self._sweeps = best.sweeps[:1]
        early.fill(self._sweeps)
        return replace(expected, solution=best.solution, posed=best.sweeps[1].posed)

    def _by_gyro(
        self, early: EarlyMap, second: EarlySweep, within: tuple[float, float],
        places: Sequence[gtsam.Pose3], ways: list[Way], imu: ImuTracker,
    ) -> list[Way]:  # fmt: skip
        """The ways themselves, if all that may be true turn as a gyro did; else those with it.

        If one that knows nothing of the gyro is surely better than these, the gyro is wrong.
        """
        first, config = self._sweeps[0], early.config
        if all(as_turned(way, second) for way in kept_ways(ways, config)):
            return ways
        felt = _ways(early, first, second, places)
        start = first.map_T_middle
        first, second = without_turns([first, replace(second, map_T_middle=start)])
        places = _likely(first, second, [start], _PLACES, within)
        without = _ways(early, first, second, places)
        self._heeds_gyro = not is_surely_beaten([kept_ways(felt, config)[0], *without])
        if self._heeds_gyro:
            return felt
        imu.gyro.denied()
        return without

    def add(
        self, frame: Frame, found: Found, keyframe: int, solver: NamedSolver,
        imu: ImuTracker | None = None,
    ) -> tuple[Frame, Found]:  # fmt: skip
        """Add a solved sweep; after some, all are registered anew and the map is made of them.

        Returns the sweep and its solve in the new map, which does not hold this sweep yet.
        A gyro that is not trusted any more leaves the sweeps before as well.
        """
        if imu is not None and imu.trusted_gyro is None:
            self._forget_gyro()
        frame, found = self._added(frame, found, keyframe, solver, imu)
        others = [continued(sweeps, frame.sweep.stamp) for sweeps in self._rivals]
        doubt = any_of(found.solution.map_T_lidar, others)
        parts = parting(self._sweeps, self._rivals, frame.matcher.config.map.plane_voxel)
        doubt = np.zeros((6, 6)) if doubt is None else doubt
        return frame, replace(found, doubt=doubt, parting=parts)

    def _forget_gyro(self) -> None:
        """Take the gyro out of all sweeps, which are to be registered anew."""
        if any(sweep.posed.sweep.motion is SweepMotion.GYRO for sweep in self._sweeps):
            self._sweeps, *self._rivals = map(without_turns, (self._sweeps, *self._rivals))
            self._anew = True

    def _added(
        self, frame: Frame, found: Found, keyframe: int, solver: NamedSolver,
        imu: ImuTracker | None,
    ) -> tuple[Frame, Found]:  # fmt: skip
        """As :meth:`add`, without what is in doubt."""
        posed, pose = frame.sweep.at(found.posed.twist), found.solution.map_T_lidar
        told, moved = _told(frame, pose, self._sweeps[-1], solver)
        turned = _turned(frame, self._sweeps[-1], imu) if self._heeds_gyro else None
        motion = frame.predicted.motion
        new = EarlySweep(posed, pose, motion, keyframe, told, moved, turned)
        gyro = None if imu is None else imu.trusted_gyro
        if imu is not None and gyro is None:
            (new,) = without_turns([new])
        added = [*self._sweeps, new]
        number = len(added)
        if number not in _TOGETHER + _IN_DOUBT and not self._anew:
            self._sweeps = added
            return frame, found
        if gyro is not None:
            added, *self._rivals = (turned_anew(way, gyro) for way in (added, *self._rivals))
        early, rivals = EarlyMap(frame, solver, self._map_T_first), self._rivals
        refutable = self._refutable
        once = number in (_IN_DOUBT if rivals else _ONCE)
        sweeps = early.together(added, 1 if once else 2)
        sweeps = early.with_motion(self._told_apart(early, sweeps))
        matcher = early.matcher(sweeps, number - 1, to_keep=True)
        solution = early.solved(sweeps, number - 1, matcher)
        if not solution.solved:
            early.fill(self._sweeps)
            self._sweeps, self._rivals, self._anew = added, rivals, True
            self._refutable = refutable
            return frame, found
        last, posed = sweeps[-2].moment, sweeps[-1].posed
        sweeps[-1] = replace(sweeps[-1], map_T_middle=solution.map_T_lidar)
        sweeps[-1] = early.with_motion(sweeps)[-1]
        self._sweeps, self._anew = sweeps, False
        if imu is not None:
            imu.registered_anew(last.map_T_lidar)
        frame = replace(
            frame, matcher=replace(frame.matcher, posed=posed, last=last, inertial=None)
        )
        posed = frame.posed_for(solution) if sweeps[0].velocity is None else sweeps[-1].posed
        return frame, replace(found, solution=solution, posed=posed)

    def _told_apart(self, early: EarlyMap, sweeps: list[EarlySweep]) -> list[EarlySweep]:
        """The sweeps on the way that explains them best, of all that may be the true one."""
        if len(sweeps) == 2:
            return sweeps
        others = [_moved(sweeps, rival) for rival in self._rivals] + by_second_step(sweeps)
        self._rivals, self._refutable = [], False
        elsewhere = _elsewhere(early, sweeps) if len(sweeps) == _TOGETHER[-1] else []
        if not others and not elsewhere:
            return sweeps
        least = early.config.solver.min_aligned
        taken, telling, silent = early.way(sweeps), [], []
        for way in others:
            followed = early.followed(way, sweeps[len(way) :])
            if tell_nothing(taken[-len(followed) :], followed, least):
                silent.append(followed)
            else:
                telling.append(early.way(early.together(followed[-1].sweeps, 1)))
        ways = [early.way(early.together(way, 2)) for way in elsewhere]
        telling += [way for way in ways if as_good(way, taken, least)]
        best = self._best([taken, *telling], early.config, silent)
        return sweeps if best is taken else best[-1].sweeps

    def _best(self, ways: Sequence[Way], config: Config, silent: Sequence[Way] = ()) -> Way:
        """The best of some ways; those that are as good, or of which no scan tells, are rivals."""
        self._still = self._still and not is_surely_beaten(ways)
        if self._still:  # which the IMU tells, and the scans do not deny
            ways, silent = ways[:1], ()
        best, *rivals = kept_ways(ways, config, silent)
        self._rivals = [way[-1].sweeps for way in rivals]
        told = any(rival is way for rival in rivals for way in ways)
        self._refutable = told and len(rivals) <= _FEW
        return best


def _told(
    frame: Frame, pose: gtsam.Pose3, before: EarlySweep, solver: NamedSolver
) -> tuple[MotionPrior | None, MotionPrior | None]:
    """What further factors say of the pose of a sweep, and of it seen from the sweep before."""
    told, last = solver.told(frame.lasting, pose), frame.matcher.last
    if last is None or last.stamp != before.moment.stamp:  # a sweep in between was not solved
        return told, None
    moved = solver.told(frame.since_last, pose)
    if moved is not None:
        moved = replace(moved, map_T_lidar=last.map_T_lidar.between(moved.map_T_lidar))
    return told, moved


def _turned(frame: Frame, before: EarlySweep, imu: ImuTracker | None) -> MotionPrior | None:
    """What a gyro says of a sweep seen from the one before; None for a solver without factors."""
    if imu is None or frame.matcher.config.solver.method != "gtsam":
        return None
    rotation = imu.rotation_between(before.moment.stamp, frame.sweep.stamp)
    if rotation is None:
        return None
    return MotionPrior(gtsam.Pose3(rotation, np.zeros(3)), _KNOWN_TURN)


def _ways(
    early: EarlyMap, first: EarlySweep, second: EarlySweep, places: Sequence[gtsam.Pose3]
) -> list[Way]:
    """The first two sweeps, from where they are and from places of the second one."""
    hopeful = _hopeful(early, first, second, places)
    return [(early.registered(early.with_motion(tried.sweeps)),) for tried in hopeful]


def _centres(expected: gtsam.Pose3, first: gtsam.Pose3) -> list[gtsam.Pose3]:
    """Where the second sweep is looked for: a guess far away from the first may be wrong."""
    return [expected, first] if expected.range(first) > APART[0] else [expected]


def _likely(
    first: EarlySweep, later: EarlySweep, centres: list[gtsam.Pose3], count: int,
    within: tuple[float, float],
) -> list[gtsam.Pose3]:  # fmt: skip
    """Where a sweep may have been taken, by what the first one shows, within metres and rad."""
    pose, (radius, turn) = first.map_T_middle.matrix(), within
    held = np.concatenate([transform(pose, points) for points in first.posed.points])
    fields = [Field.around(held, centre, radius) for centre in centres]
    return likely_poses(
        sample_features(*later.posed.points, MORE_EDGES), fields, centres, count,
        most_turn=turn, rare=True, least=_LIKELY, apart=_NEAR,
    )  # fmt: skip


def _hopeful(
    early: EarlyMap, first: EarlySweep, later: EarlySweep, places: Sequence[gtsam.Pose3]
) -> list[Tried]:
    """A later sweep, tried where it is, and at each place to which no try before has led."""
    trial = early.on_trial
    quick = [trial.tried(first, later)]
    for place in places:
        moved = first.map_T_middle.between(place)
        if not any(same(moved, tried.moved, _NEAR) for tried in quick):
            quick.append(trial.tried(first, replace(later, map_T_middle=place)))
    enough = _HOPEFUL * max(tried.evidence.share for tried in quick)
    hopeful = [quick[0], *(tried for tried in quick[1:] if tried.evidence.share >= enough)]
    return distinct(hopeful, lambda tried: tried.moved)


def _elsewhere(early: EarlyMap, sweeps: list[EarlySweep]) -> list[list[EarlySweep]]:
    """The sweeps on steady ways to other places of the last one, if the first shows these as well.

    What passes slowly has hardly moved between the first two sweeps, and may have been taken for
    what stands. Two motions that led to the same place then are apart by now.
    """
    first, last = sweeps[0], sweeps[-1]
    within = APART[0] * (len(sweeps) - 1), APART[1]
    places = _likely(first, last, [last.map_T_middle], _ELSEWHERE, within)
    here, *others = _hopeful(early, first, last, places)
    least = early.config.solver.min_aligned
    good = (one for one in others if as_good((one,), (here,), least, _LESS, moving=True))
    return [steady(sweeps, one.moved) for one in good]


def _moved(sweeps: list[EarlySweep], to: list[EarlySweep]) -> list[EarlySweep]:
    """The first of some sweeps, with the motions and poses of others of the same time."""
    return [
        replace(one, posed=other.posed, map_T_middle=other.map_T_middle, velocity=other.velocity)
        for one, other in zip(sweeps, to, strict=False)
    ]
