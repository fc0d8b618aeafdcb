"""The map of the first sweeps of a run, made anew of any of them to register the others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.geometry import transform
from loam_gtsam.registration.frame_matcher import Frame, FrameMatcher, TrialPoints
from loam_gtsam.registration.relocalization.evidence import Evidence
from loam_gtsam.registration.solvers import ScanSolver, Solution, trial_solver
from loam_gtsam.registration.start.paths import on_paths, with_velocity
from loam_gtsam.registration.start.ways import (
    EarlySweep,
    Tried,
    Way,
    continued,
    moved_with_first,
)

_SETTLED = 0.5
"""Noises of a range below which sweeps that were moved need not be registered once more: the next
time moves them by a third of that, and makes no trajectory better, but for chance."""


@dataclass(frozen=True, slots=True, eq=False)
class EarlyMap:
    """Registers early sweeps with maps of each other.

    Attributes
    ----------
    frame : the newest sweep; its map is the one that is made anew
    solver : by which the sweeps are registered
    map_T_first : pose of the very first sweep at its reference time, which never changes
    """

    frame: Frame
    solver: ScanSolver
    map_T_first: gtsam.Pose3

    @property
    def config(self) -> Config:
        """The configuration of the map."""
        return self.frame.matcher.config

    @property
    def on_trial(self) -> EarlyMap:
        """The same with a solver for trials, which ends early."""
        return replace(self, solver=trial_solver(self.config.solver))

    def together(self, sweeps: Sequence[EarlySweep], rounds: int) -> list[EarlySweep]:
        """The sweeps, each registered with the map of all the others, so many times at most."""
        before, moved = sweeps, self._registered_once(sweeps)
        for _ in range(rounds - 1):
            if self._settled(before, moved):
                break
            before, moved = moved, self._registered_once(moved)
        return moved

    def _registered_once(self, sweeps: Sequence[EarlySweep]) -> list[EarlySweep]:
        """The sweeps, each registered with the map of all the others."""
        moved = self.with_motion(sweeps)
        if (solutions := self.at_once(moved)) is not None:
            moved = moved_with_first(moved, solutions)
            for number, solution in enumerate(solutions):
                moved = self._with_velocity(moved, number, solution)
            return moved
        for number in range(1, len(moved)):
            solution = self.solved(moved, number, self.matcher(moved, number))
            if solution.solved:
                moved[number] = replace(moved[number], map_T_middle=solution.map_T_lidar)
                moved = self._with_velocity(moved, number, solution)
        return self._with_velocity(moved, 0, None)

    def _settled(self, before: Sequence[EarlySweep], after: Sequence[EarlySweep]) -> bool:
        """Whether features came to lie where they were, to well below their noise."""
        most = _SETTLED * self.config.features.range_noise
        return all(_shift(*pair) < most for pair in zip(before, after, strict=True))

    def _with_velocity(
        self, sweeps: Sequence[EarlySweep], number: int, solution: Solution | None
    ) -> list[EarlySweep]:
        return with_velocity(sweeps, number, solution, self.map_T_first, self.config)

    def at_once(self, sweeps: Sequence[EarlySweep]) -> list[Solution] | None:
        """Each sweep, the first as well, registered with the map of the others as they are.

        None if there are less than three, or if the first one does not see all directions.
        """
        if len(sweeps) < 3:
            return None
        solutions: list[Solution] = []
        for number, matcher in enumerate(self.matchers(sweeps)):
            solutions.append(self.solved(sweeps, number, matcher))
            if not solutions[0].solved or solutions[0].weak is not None:
                return None
        return solutions

    def way(self, sweeps: Sequence[EarlySweep]) -> Way:
        """Each sweep after the first, registered with the map of those before it.

        All at constant velocity: ways are compared that were adjusted more and less.
        """
        steady = [one.untold for one in sweeps]
        return tuple(
            self.registered(self.with_motion(steady[:count])) for count in range(2, len(steady) + 1)
        )

    def followed(self, way: list[EarlySweep], sweeps: Sequence[EarlySweep]) -> Way:
        """Further sweeps of a way, each expected at constant velocity."""
        found: list[Tried] = []
        for sweep in sweeps:
            expected = sweep.put(continued(way, sweep.moment.stamp))
            found.append(self.registered(self.with_motion([*way, expected])))
            way = found[-1].sweeps
        return tuple(found)

    def tried(self, first: EarlySweep, later: EarlySweep) -> Tried:
        """A later sweep, registered with the first by few matches."""
        moved = first.map_T_middle.between(later.map_T_middle)
        first, later = self.with_motion([first.untold, later.untold])
        later = replace(later, map_T_middle=first.map_T_middle.compose(moved))
        return self.registered([first, later], quickly=True)

    def registered(self, sweeps: Sequence[EarlySweep], *, quickly: bool = False) -> Tried:
        """The last of some sweeps, registered with the others, and what its features say of it."""
        matcher = self.matcher(sweeps, len(sweeps) - 1)
        matcher = matcher.with_few_matches() if quickly else matcher
        solution = self.solved(sweeps, len(sweeps) - 1, matcher)
        last = replace(sweeps[-1], map_T_middle=solution.map_T_lidar)
        return Tried(Evidence.of(matcher, solution), [*sweeps[:-1], last], solution)

    def solved(self, sweeps: Sequence[EarlySweep], number: int, matcher: FrameMatcher) -> Solution:
        """One of the sweeps, registered with the map of a matcher."""
        one = sweeps[number]
        expected = replace(one.expected, map_T_lidar=one.map_T_middle)
        priors: list[gtsam.NonlinearFactor] = []
        if number:
            last = sweeps[number - 1]
            priors = [told.factor() for told in (*one.factors(last), *one.turn(last))]
        return self.solver.solve(matcher, one.map_T_middle, priors, expected)

    def matcher(
        self, sweeps: Sequence[EarlySweep], number: int, *, to_keep: bool = False
    ) -> FrameMatcher:
        """The matches of one of the sweeps with a map of all the others, which may be to keep."""
        others = [*sweeps[:number], *sweeps[number + 1 :]]
        if to_keep:
            self.fill(others)
        else:
            self.frame.matcher.maps.insert_on_trial(self._placed(others))
        return self._matcher(sweeps[number])

    def matchers(self, sweeps: Sequence[EarlySweep]) -> Iterator[FrameMatcher]:
        """As :meth:`matcher`, of one sweep after the other; each is of use until the next."""
        placed = self._placed(sweeps)
        for number, one in enumerate(sweeps):
            self._clear()
            self.frame.matcher.maps.insert_on_trial(placed, without=number)
            yield self._matcher(one)

    def _matcher(self, sweep: EarlySweep) -> FrameMatcher:
        old = self.frame.matcher
        return FrameMatcher.of(sweep.posed, old.maps, old.config, old.last, old.clock, refine=False)

    def fill(self, sweeps: Sequence[EarlySweep]) -> None:
        """Make the map of these sweeps."""
        self._clear()
        for sweep in sweeps:
            self.frame.matcher.maps.insert(sweep.posed, sweep.map_T_middle, sweep.keyframe)

    def _placed(self, sweeps: Sequence[EarlySweep]) -> TrialPoints:
        """The points of sweeps at their poses; clears the map."""
        self._clear()
        placed = [(one.posed, one.map_T_middle) for one in sweeps]
        return self.frame.matcher.maps.sorted_on_trial(placed)

    def _clear(self) -> None:
        self.frame.matcher.maps.clear()
        self.frame.matcher.maps.recenter(self.map_T_first)

    def with_motion(self, sweeps: Sequence[EarlySweep]) -> list[EarlySweep]:
        """The sweeps, de-skewed for the motion through their poses."""
        return on_paths(sweeps, self.map_T_first)


def _shift(before: EarlySweep, after: EarlySweep) -> float:
    """Metres (RMS) by which a new pose moves the features of a sweep."""
    points = np.concatenate(after.posed.points)
    moved = transform(after.map_T_middle.matrix() - before.map_T_middle.matrix(), points)
    return float(np.sqrt((moved**2).sum(axis=1).mean()))
