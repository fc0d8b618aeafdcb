"""The start of a run: the first sweeps are registered together, before the map is relied on.

A map of one sweep is thin, and distorted by a motion that nobody knows yet. An error made in it
would stay for good. Therefore the first motion is searched for, and the first eight sweeps are
registered again and again, each with the map of all the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.geometry import transform
from loam_gtsam.registration.frame_matcher import Frame, FrameMatcher, MapPair
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
from loam_gtsam.registration.relocalization.evidence import Evidence
from loam_gtsam.registration.relocalization.fits import APART
from loam_gtsam.registration.solvers import ScanSolver, Solution, trial_solver
from loam_gtsam.registration.start.ways import (
    EarlySweep,
    Tried,
    Way,
    by_second_step,
    continued,
    kept_ways,
    moved_with_first,
    parting,
    tell_nothing,
    without_turns,
)
from loam_gtsam.types import FloatArray, SweepMotion

_TOGETHER = (2, 3, 5, 8)
"""Numbers of sweeps at which all are registered anew: each time half as many more or so."""
_ONCE = (3, 5)
"""Numbers at which each is then registered with the map of the others once, and not twice, unless
there are rivals: without them a second time makes no world's trajectory better by more than 3 %."""
_PLACES = 12  # most motions between the first two sweeps that are tried beside the expected one
_LIKELY = 0.5
"""Part of the best place's score below which a place is not tried. The place next to the true one
had 0.68 at least in 60 drawn starts; with 0.6, two of 18 with a view of 70 degrees go wrong."""
_NEAR = (0.8, APART[1])
"""Metres and rad within which a place leads where another one did: less than the 1 m between trial
places. In a corridor two sweeps that are registered from 0.7 m away do not find each other."""
_SAMPLE = (500, 140)
"""Number of edges and planes that are looked at for these: ten of 500 edges may lie on posts."""
_HOPEFUL = 0.5
"""Part of the best place's share, by few matches, below which a place is not looked at closer."""
_FASTEST = 50.0  # m/s, 180 km/h: largest speed of a first motion
_FARTHEST = 30.0  # metres: largest distance between the first two sweeps
_TURNING = 3.0  # rad/s: largest turn rate of a first motion about the vertical axis


class Start:
    """The first sweeps of a run; the pose of the very first at its reference time never changes."""

    def __init__(self, first: Prediction, keyframe: int) -> None:
        self._map_T_first = first.map_T_lidar
        self._sweeps = [EarlySweep(first.posed, first.map_T_middle, True, first.motion, keyframe)]
        self._rivals: list[list[EarlySweep]] = []
        """The sweeps on other ways, which explain them as well, but for chance."""
        self._anew = False  # whether the sweeps are to be registered anew with the next one

    @classmethod
    def of_map(cls, first: Prediction, keyframe: int, maps: MapPair) -> Start | None:
        """The start of a map; None if no sweep is de-skewed anew, or the map is there already."""
        begins = maps.config.deskew.model != "predicted" and not maps.given
        return cls(first, keyframe) if begins else None

    @property
    def complete(self) -> bool:
        """Whether all sweeps of the start are there."""
        return len(self._sweeps) >= _TOGETHER[-1]

    def first_motion(self, frame: Frame, expected: Found, solver: ScanSolver) -> Found:
        """Search for the motion between the first two sweeps; returns ``expected`` for later ones.

        The places where the second sweep may have been taken are tried, each with both sweeps
        de-skewed for the motion that leads there. Another place than the expected one is chosen if
        more of the features that tell the two apart are for it than by chance.
        """
        if len(self._sweeps) > 1:
            return expected
        first, middle = self._sweeps[0], frame.predicted.map_T_middle
        seconds = first.moment.seconds_to(frame.sweep.stamp)
        centres = _centres(middle, first.map_T_middle)
        fields = _fields(first, centres, min(_FASTEST * seconds, _FARTHEST))
        places = likely_poses(
            sample_features(*frame.matcher.posed.points, _SAMPLE), fields, centres, _PLACES,
            most_turn=_TURNING * seconds, rare=True, least=_LIKELY, apart=_NEAR,
        )  # fmt: skip
        trial = trial_solver(frame.matcher.config.solver)
        quick = [self._tried(frame, expected.solution.map_T_lidar, trial)]
        for place in places:
            moved = first.map_T_middle.between(place)
            if not any(same(moved, tried.moved, _NEAR) for tried in quick):
                quick.append(self._tried(frame, place, trial))
        enough = _HOPEFUL * max(tried.evidence.share for tried in quick)
        hopeful = [quick[0], *(tried for tried in quick[1:] if tried.evidence.share >= enough)]
        ways = [
            (self._registered(frame, self._with_motion(tried.sweeps), solver),)
            for tried in distinct(hopeful, lambda tried: tried.moved)
        ]
        (best,) = self._best(ways, frame.matcher.config)
        self._sweeps = best.sweeps[:1]
        self._fill(frame, self._sweeps)
        return replace(expected, solution=best.solution, posed=best.sweeps[1].posed)

    def add(
        self, frame: Frame, found: Found, keyframe: int, solver: ScanSolver,
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
        self, frame: Frame, found: Found, keyframe: int, solver: ScanSolver,
        imu: ImuTracker | None,
    ) -> tuple[Frame, Found]:  # fmt: skip
        """As :meth:`add`, without what is in doubt."""
        new = frame.sweep.at(found.posed.twist), found.solution.map_T_lidar, bool(frame.priors)
        sweeps = [*self._sweeps, EarlySweep(*new, frame.predicted.motion, keyframe)]
        if len(sweeps) not in _TOGETHER and not self._anew:
            self._sweeps = sweeps
            return frame, found
        before, once = self._rivals, len(sweeps) in _ONCE and not self._rivals
        sweeps = self._together(frame, sweeps, solver, 1 if once else 2)
        sweeps = self._with_motion(self._told_apart(frame, sweeps, solver))
        matcher = self._matcher(frame, sweeps, len(sweeps) - 1, to_keep=True)
        solution = self._solved(frame, sweeps[-1], matcher, solver)
        if not solution.solved:
            self._rivals = before
            self._fill(frame, self._sweeps)
            return frame, found
        last, posed = sweeps[-2].moment, sweeps[-1].posed
        sweeps[-1] = replace(sweeps[-1], map_T_middle=solution.map_T_lidar)
        self._sweeps, self._anew = sweeps, False
        if imu is not None:
            imu.registered_anew(last.map_T_lidar)
        frame = replace(
            frame, matcher=replace(frame.matcher, posed=posed, last=last, inertial=None)
        )
        return frame, replace(found, solution=solution, posed=frame.posed_for(solution))

    def _together(
        self, frame: Frame, sweeps: list[EarlySweep], solver: ScanSolver, rounds: int
    ) -> list[EarlySweep]:
        """The sweeps, each registered with the map of all the others, so many times."""
        for _ in range(rounds):
            sweeps = self._with_motion(sweeps)
            if (solutions := self._at_once(frame, sweeps, solver)) is not None:
                sweeps = moved_with_first(sweeps, solutions)
                continue
            for number, sweep in enumerate(sweeps):
                if sweep.held and sweep.posed.sweep is not frame.sweep:
                    continue
                solution = self._solved(frame, sweep, self._matcher(frame, sweeps, number), solver)
                if solution.solved:
                    sweeps[number] = replace(sweeps[number], map_T_middle=solution.map_T_lidar)
        return sweeps

    def _at_once(
        self, frame: Frame, sweeps: list[EarlySweep], solver: ScanSolver
    ) -> list[Solution] | None:
        """Each sweep, the first as well, registered with the map of the others as they are.

        None if other factors hold some of them, or if the first one does not see all directions.
        """
        if len(sweeps) < 3 or any(sweep.held for sweep in sweeps[1:]):
            return None
        solutions: list[Solution] = []
        for number, sweep in enumerate(sweeps):
            matcher = self._matcher(frame, sweeps, number)
            solutions.append(self._solved(frame, sweep, matcher, solver))
            if not solutions[0].solved or solutions[0].weak is not None:
                return None
        return solutions

    def _told_apart(
        self, frame: Frame, sweeps: list[EarlySweep], solver: ScanSolver
    ) -> list[EarlySweep]:
        """The sweeps on the way that explains them best, of all that began as well."""
        if len(sweeps) == 2:
            return sweeps
        others, self._rivals = [_moved(sweeps, rival) for rival in self._rivals], []
        others += by_second_step(sweeps)
        if not others or any(sweep.held for sweep in sweeps[1:]):
            return sweeps
        config = frame.matcher.config
        taken, telling, silent = self._way(frame, sweeps, solver), [], []
        for way in others:
            followed = self._followed(frame, way, sweeps[len(way) :], solver)
            if tell_nothing(taken[-len(followed) :], followed, config.solver.min_aligned):
                silent.append(followed)
            else:
                joined = self._together(frame, followed[-1].sweeps, solver, 1)
                telling.append(self._way(frame, joined, solver))
        best = self._best([taken, *telling], config, silent)
        return sweeps if best is taken else best[-1].sweeps

    def _best(self, ways: Sequence[Way], config: Config, silent: Sequence[Way] = ()) -> Way:
        """The best of some ways; those that are as good, or of which no scan tells, are rivals."""
        best, *rivals = kept_ways(ways, config, silent)
        self._rivals = [way[-1].sweeps for way in rivals]
        return best

    def _followed(
        self, frame: Frame, way: list[EarlySweep], sweeps: Sequence[EarlySweep], solver: ScanSolver
    ) -> Way:
        """Further sweeps of a way, each expected at constant velocity."""
        found: list[Tried] = []
        for sweep in sweeps:
            expected = replace(sweep, map_T_middle=continued(way, sweep.moment.stamp))
            found.append(self._registered(frame, self._with_motion([*way, expected]), solver))
            way = found[-1].sweeps
        return tuple(found)

    def _way(self, frame: Frame, sweeps: Sequence[EarlySweep], solver: ScanSolver) -> Way:
        """Each sweep after the first, registered with the map of those before it."""
        return tuple(
            self._registered(frame, self._with_motion(sweeps[:count]), solver)
            for count in range(2, len(sweeps) + 1)
        )

    def _with_motion(self, sweeps: Sequence[EarlySweep]) -> list[EarlySweep]:
        """The sweeps, de-skewed for the motion between their poses."""
        moved = list(sweeps)
        for number in range(1, len(moved)):
            last, now = moved[number - 1].moment, moved[number]
            sweep = now.posed.sweep
            if sweep.stamp > last.stamp:  # not for sweeps of unlike length
                twist = sweep.twist_since(last[:2], now.map_T_middle)
                moved[number] = replace(now, posed=sweep.at(twist))
        posed = moved[0].posed.sweep.at(_first_twist(*moved[:2]))
        middle = posed.map_T_middle(self._map_T_first)
        moved[0] = replace(moved[0], posed=posed, map_T_middle=middle)
        return moved

    def _tried(self, frame: Frame, map_T_middle: gtsam.Pose3, solver: ScanSolver) -> Tried:
        """The first two sweeps, the second near a pose, registered by few matches."""
        first = self._sweeps[0]
        moved = first.map_T_middle.between(map_T_middle)
        second = EarlySweep(frame.matcher.posed, map_T_middle, False, frame.predicted.motion, 0)
        first, second = self._with_motion([first, second])
        second = replace(second, map_T_middle=first.map_T_middle.compose(moved))
        return self._registered(frame, [first, second], solver, quickly=True)

    def _registered(
        self, frame: Frame, sweeps: list[EarlySweep], solver: ScanSolver, *, quickly: bool = False
    ) -> Tried:
        """The last of some sweeps, registered with the others, and what its features say of it."""
        matcher = self._matcher(frame, sweeps, len(sweeps) - 1)
        matcher = matcher.with_few_matches() if quickly else matcher
        solution = self._solved(frame, sweeps[-1], matcher, solver)
        last = replace(sweeps[-1], map_T_middle=solution.map_T_lidar)
        return Tried(Evidence.of(matcher, solution), [*sweeps[:-1], last], solution)

    def _matcher(
        self, frame: Frame, sweeps: Sequence[EarlySweep], number: int, *, to_keep: bool = False
    ) -> FrameMatcher:
        """The matches of one of the sweeps with a map of all the others, which may be to keep."""
        others = [*sweeps[:number], *sweeps[number + 1 :]]
        if to_keep:
            self._fill(frame, others)
        else:
            self._clear(frame)
            frame.matcher.maps.insert_on_trial([(one.posed, one.map_T_middle) for one in others])
        old, posed = frame.matcher, sweeps[number].posed
        return FrameMatcher.of(posed, old.maps, old.config, old.last, old.clock, refine=False)

    def _solved(
        self, frame: Frame, one: EarlySweep, matcher: FrameMatcher, solver: ScanSolver
    ) -> Solution:
        """A sweep, registered with the map of a matcher."""
        expected = replace(one.expected, map_T_lidar=one.map_T_middle)
        priors = frame.priors if one.posed.sweep is frame.sweep else ()
        return solver.solve(matcher, one.map_T_middle, priors, expected)

    def _fill(self, frame: Frame, sweeps: Sequence[EarlySweep]) -> None:
        """Make the map of these sweeps."""
        self._clear(frame)
        for sweep in sweeps:
            frame.matcher.maps.insert(sweep.posed, sweep.map_T_middle, sweep.keyframe)

    def _clear(self, frame: Frame) -> None:
        frame.matcher.maps.clear()
        frame.matcher.maps.recenter(self._map_T_first)


def _first_twist(first: EarlySweep, second: EarlySweep) -> FloatArray:
    """(6,) body velocity of the first sweep: that of the second, less what was felt in between."""
    sweep, twist = second.posed.sweep, second.posed.twist
    velocity = sweep.velocity_at((first.moment.stamp - sweep.stamp) * 1e-9, twist)
    if velocity is None:
        return twist
    moved = first.map_T_middle.rotation().between(second.map_T_middle.rotation())
    return first.posed.sweep.twist_at_reference(twist[:3], moved.matrix() @ velocity)


def _centres(expected: gtsam.Pose3, first: gtsam.Pose3) -> list[gtsam.Pose3]:
    """Where the second sweep is looked for: a guess far away from the first may be wrong."""
    return [expected, first] if expected.range(first) > APART[0] else [expected]


def _fields(sweep: EarlySweep, around: Sequence[gtsam.Pose3], radius: float) -> list[Field]:
    """The fields of a map of one sweep."""
    pose = sweep.map_T_middle.matrix()
    held = np.concatenate([transform(pose, points) for points in sweep.posed.points])
    return [Field.around(held, centre, radius) for centre in around]


def _moved(sweeps: list[EarlySweep], to: list[EarlySweep]) -> list[EarlySweep]:
    """The first of some sweeps, with the motions and poses of others of the same time."""
    return [
        replace(one, posed=other.posed, map_T_middle=other.map_T_middle)
        for one, other in zip(sweeps, to, strict=False)
    ]
