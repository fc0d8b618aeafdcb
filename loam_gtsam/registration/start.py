"""The start of a run: the first sweeps are registered together, before the map is relied on.

A map of one sweep is thin, and distorted by a motion that nobody knows yet. An error made in it
would stay for good. Therefore the first motion is searched for, and the first eight sweeps are
registered again and again, each with the map of all the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.geometry import transform
from loam_gtsam.registration.frame_matcher import Frame, FrameMatcher, MapPair
from loam_gtsam.registration.matches import ChosenRows
from loam_gtsam.registration.odometry import Moment, Prediction
from loam_gtsam.registration.relocalization import (
    APART,
    Found,
    agreeing,
    likely_poses,
    same,
    sample_features,
)
from loam_gtsam.registration.solvers import MotionPrior, ScanSolver, Solution
from loam_gtsam.types import FloatArray

_TOGETHER = (2, 3, 5, 8)
"""Numbers of sweeps at which all are registered anew: each time half as many more or so."""
_ROUNDS = 2  # times that each of them is then registered with the map of the others
_PLACES = 6  # motions between the first two sweeps that are tried beside the expected one
_AGAINST = 5.0
"""Number of features that agree which one outweighs that contradicts. At the right place 3 of 1000
matches contradict by noise, at a wrong one ten times as many (medians of 315 starts, of which 10
go wrong, and at most 14 with any number from 3 to 10)."""
_TINY = 1e-9
_HOPEFUL = 0.5
"""Part of the best place's share, by few matches, below which a place is not looked at closer."""
_CHANCE = 3.0  # standard deviations beyond which a difference is no chance
_FASTEST = 50.0  # m/s, 180 km/h: largest speed of a first motion
_FARTHEST = 30.0  # metres: largest distance between the first two sweeps
_TURNING = 3.0  # rad/s: largest turn rate of a first motion about the vertical axis


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


class _Tried(NamedTuple):
    """A first motion that was tried."""

    edges: int  # number of edges, which come first among the features that may be matched
    points: FloatArray  # (F, 3) where these are in the map
    evidence: FloatArray  # (F,) what each says of the motion, see :func:`_evidence`
    axes: FloatArray  # (F, 3) of their lines and planes
    sweeps: list[EarlySweep]
    solution: Solution

    @property
    def share(self) -> float:
        """Share of the features whose matches agree."""
        return float(np.count_nonzero(self.evidence > 0.0)) / max(len(self.evidence), 1)


class Start:
    """The first sweeps of a run; the pose of the very first at its reference time never changes."""

    def __init__(self, first: Prediction, keyframe: int) -> None:
        self._map_T_first = first.map_T_lidar
        self._sweeps = [EarlySweep(first.posed, first.map_T_middle, True, first.motion, keyframe)]

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
        around = [middle]
        if middle.range(first.map_T_middle) > APART[0]:  # a guess, and it may be wrong
            around.append(first.map_T_middle)
        places = likely_poses(
            sample_features(*frame.matcher.posed.points),
            np.concatenate(_in_map(first)),
            around,
            min(_FASTEST * seconds, _FARTHEST),
            _PLACES,
            most_turn=_TURNING * seconds,
        )
        quick = [
            self._tried(frame, place, solver) for place in (expected.solution.map_T_lidar, *places)
        ]
        enough = _HOPEFUL * max(tried.share for tried in quick)
        best, *others = (
            self._registered(frame, self._with_motion(tried.sweeps), solver)
            for number, tried in enumerate(quick)
            if number == 0 or tried.share >= enough
        )
        for tried in others:
            if _better(tried, best, frame.matcher.config.solver.min_aligned):
                best = tried
        self._sweeps = best.sweeps[:1]
        self._fill(frame, self._sweeps)
        return replace(expected, solution=best.solution, twist=best.sweeps[1].posed.twist)

    def add(
        self, frame: Frame, found: Found, keyframe: int, solver: ScanSolver
    ) -> tuple[Frame, Found]:
        """Add a solved sweep; after some, all are registered anew and the map is made of them.

        Returns the sweep and its solve in the new map, which does not hold this sweep yet.
        """
        new = EarlySweep(
            frame.sweep.at(found.twist),
            found.solution.map_T_lidar,
            bool(frame.priors),
            frame.predicted.motion,
            keyframe,
        )
        sweeps = [*self._sweeps, new]
        if len(sweeps) not in _TOGETHER:
            self._sweeps = sweeps
            return frame, found
        if len(sweeps) == 3:
            sweeps = self._as_the_second_step(frame, sweeps, solver)
        for _ in range(_ROUNDS):
            sweeps = self._with_motion(sweeps)
            for number, sweep in enumerate(sweeps):
                if sweep.held and sweep.posed.sweep is not frame.sweep:
                    continue
                solution = self._solved(frame, sweep, self._matcher(frame, sweeps, number), solver)
                if solution.solved:
                    sweeps[number] = replace(sweeps[number], map_T_middle=solution.map_T_lidar)
        sweeps = self._with_motion(sweeps)
        matcher = self._matcher(frame, sweeps, len(sweeps) - 1, to_keep=True)
        solution = self._solved(frame, sweeps[-1], matcher, solver)
        if not solution.solved:
            self._fill(frame, self._sweeps)
            return frame, found
        last, posed = sweeps[-2].moment, sweeps[-1].posed
        sweeps[-1] = replace(sweeps[-1], map_T_middle=solution.map_T_lidar)
        self._sweeps = sweeps
        frame = replace(
            frame, matcher=replace(frame.matcher, posed=posed, last=last, inertial=None)
        )
        return frame, replace(found, solution=solution, twist=frame.twist_of(solution))

    def _as_the_second_step(
        self, frame: Frame, sweeps: list[EarlySweep], solver: ScanSolver
    ) -> list[EarlySweep]:
        """The sweeps with another first motion, if that of the second step leads to a better place.

        The first one was searched for on a grid, with two sweeps that may see little of each other.
        """
        first, second, third = (sweep.map_T_middle for sweep in sweeps)
        early, late = (sweeps[k].moment.seconds_to(sweeps[k + 1].posed.sweep.stamp) for k in (0, 1))
        step = gtsam.Pose3.Logmap(second.between(third)) * (early / late)
        place = first.compose(gtsam.Pose3.Expmap(step))
        if sweeps[1].held or sweeps[2].held or same(place, second):
            return sweeps
        best, tried = (
            self._registered(
                frame,
                self._with_motion([sweeps[0], replace(sweeps[1], map_T_middle=pose)]),
                solver,
            )
            for pose in (second, place)
        )
        if not _better(tried, best, frame.matcher.config.solver.min_aligned):
            return sweeps
        moved = tried.solution.map_T_lidar
        last = replace(sweeps[2], map_T_middle=moved.compose(second.between(third)))
        return [*tried.sweeps, last]

    def _with_motion(self, sweeps: Sequence[EarlySweep]) -> list[EarlySweep]:
        """The sweeps, de-skewed for the motion between their poses."""
        moved = list(sweeps)
        for number in range(1, len(moved)):
            last, now = moved[number - 1].moment, moved[number]
            sweep = now.posed.sweep
            if sweep.stamp > last.stamp:  # not for sweeps of unlike length
                twist = sweep.twist_since(last[:2], now.map_T_middle)
                moved[number] = replace(now, posed=sweep.at(twist))
        posed = moved[0].posed.sweep.at(moved[1].posed.twist)
        middle = posed.map_T_middle(self._map_T_first)
        moved[0] = replace(moved[0], posed=posed, map_T_middle=middle)
        return moved

    def _tried(self, frame: Frame, map_T_middle: gtsam.Pose3, solver: ScanSolver) -> _Tried:
        """The first two sweeps, the second near a pose, registered by few matches."""
        first = self._sweeps[0]
        moved = first.map_T_middle.between(map_T_middle)
        second = EarlySweep(frame.matcher.posed, map_T_middle, False, frame.predicted.motion, 0)
        first, second = self._with_motion([first, second])
        second = replace(second, map_T_middle=first.map_T_middle.compose(moved))
        return self._registered(frame, [first, second], solver, quickly=True)

    def _registered(
        self,
        frame: Frame,
        sweeps: list[EarlySweep],
        solver: ScanSolver,
        *,
        quickly: bool = False,
    ) -> _Tried:
        """The second of two sweeps registered with the first, and what its features say of it."""
        matcher = self._matcher(frame, sweeps, 1)
        matcher = matcher.with_few_matches() if quickly else matcher
        solution = self._solved(frame, sweeps[1], matcher, solver)
        second = replace(sweeps[1], map_T_middle=solution.map_T_lidar)
        rows, told = matcher.rows, _evidence(matcher.rows, solution)
        points = np.concatenate(matcher.posed.rows(rows.edges, rows.planes))
        points = transform(solution.map_T_lidar.matrix(), points)
        return _Tried(len(rows.edges), points, *told, [sweeps[0], second], solution)

    def _matcher(
        self, frame: Frame, sweeps: Sequence[EarlySweep], number: int, *, to_keep: bool = False
    ) -> FrameMatcher:
        """The matches of one of the sweeps with a map of all the others, which may be to keep."""
        self._fill(frame, [*sweeps[:number], *sweeps[number + 1 :]], on_trial=not to_keep)
        old, posed = frame.matcher, sweeps[number].posed
        return FrameMatcher.of(posed, old.maps, old.config, old.last, old.clock, refine=False)

    def _solved(
        self, frame: Frame, one: EarlySweep, matcher: FrameMatcher, solver: ScanSolver
    ) -> Solution:
        """A sweep, registered with the map of a matcher."""
        expected = replace(one.expected, map_T_lidar=one.map_T_middle)
        priors = frame.priors if one.posed.sweep is frame.sweep else ()
        return solver.solve(matcher, one.map_T_middle, priors, expected)

    def _fill(self, frame: Frame, sweeps: Sequence[EarlySweep], *, on_trial: bool = False) -> None:
        """Make the map of these sweeps; one on trial is made as far as a solve reads it."""
        maps = frame.matcher.maps
        maps.clear()
        maps.recenter(self._map_T_first)
        for sweep in sweeps:
            maps.insert(sweep.posed, sweep.map_T_middle, sweep.keyframe, on_trial=on_trial)


def _in_map(sweep: EarlySweep) -> tuple[FloatArray, FloatArray]:
    pose = sweep.map_T_middle.matrix()
    edges, planes = sweep.posed.points
    return transform(pose, edges), transform(pose, planes)


def _evidence(rows: ChosenRows, solution: Solution) -> tuple[FloatArray, FloatArray]:
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


def _better(tried: _Tried, best: _Tried, least: float) -> bool:
    """Whether one place is better than another by more than chance.

    A feature counts as far as its line or plane lies across the way from one place to the other:
    ground and walls along the way agree at both, but for chance. Neither lines nor planes may speak
    against the place: at rest few lines are found, for next to a point lie those of its own ring.
    ``least`` is the number of features at least, counted as if they lay across.
    """
    way = tried.points - best.points
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), _TINY)
    axes = np.where(tried.axes.any(axis=1, keepdims=True), tried.axes, best.axes)
    across = np.abs(np.einsum("ij,ij->i", axes, way))
    across[: tried.edges] = np.sqrt(np.maximum(1.0 - across[: tried.edges] ** 2, 0.0))
    gain = across * (tried.evidence - best.evidence)
    every, lines, planes = (
        float(part.sum() / max(np.linalg.norm(part), _TINY))
        for part in (gain, gain[: tried.edges], gain[tried.edges :])
    )
    return every > _CHANCE and min(lines, planes) > -_CHANCE and bool(across @ gain > least)
