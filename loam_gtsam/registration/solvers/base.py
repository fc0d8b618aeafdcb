"""What every solver takes and returns, and the loop that matches and optimises in turn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np

from loam_gtsam.config import SolverConfig
from loam_gtsam.factors import MatchRows
from loam_gtsam.registration.degeneracy import Localizability
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.types import BoolArray, FloatArray

POSE_KEY: int = gtsam.symbol("x", 0)
"""Key of the frame's pose ``map_T_lidar`` in every graph handed to a solver."""

Associate = Callable[[gtsam.Pose3], ScanMatches]
"""Gives the matches of a sweep at a pose ``map_T_lidar``: a pure function."""


class Matcher:
    """The matches of one sweep with one map.

    Every method is pure: the same arguments give the same result, however often it is asked for.
    This base class serves any function of the pose; a mapper's own matcher overrides all methods.

    Parameters
    ----------
    associate : gives the matches at a pose
    """

    def __init__(self, associate: Associate) -> None:
        self._associate = associate

    def __call__(self, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        """Search for the matches at a pose."""
        return self._associate(map_T_lidar)

    def again(self, matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        """The matches at a further pose; lines and planes found near by may be kept."""
        return self(map_T_lidar)

    def deskewed(self, map_T_lidar: gtsam.Pose3) -> Matcher:
        """The matcher of the sweep de-skewed anew, with the motion that leads to a pose."""
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """What a solver returns.

    Attributes
    ----------
    map_T_lidar : the pose; the guess if ``solved`` is false
    solved : false when an association gave too few matches
    converged : whether the last association moved the pose by less than the stop rule
    matches : matches of the last association
    iterations, solver_iterations : associations, and solver steps over all of them
    error_before, error_after : cost at the guess with the first matches, and at the pose with the
        last ones
    information : (6, 6) of matches and priors at the pose
    localizability : motions that the first matches say something about; None if not looked at
    weak : (6, 6) projector onto the motions they say too little about; None if there are none
    unseen : (6, 6) projector onto the motions that the planes say too little about, where nothing
        but ``beacons`` and the expected motion counts; None if there are none
    beacons : (R,) which rows of the matches count there
    rows : the matches as the last association weighted them; None if a solver has no such rows
    """

    map_T_lidar: gtsam.Pose3
    solved: bool
    converged: bool
    matches: ScanMatches
    iterations: int
    solver_iterations: int
    error_before: float
    error_after: float
    information: FloatArray
    localizability: Localizability | None = None
    weak: FloatArray | None = None
    unseen: FloatArray | None = None
    beacons: BoolArray | None = None
    rows: MatchRows | None = None

    @classmethod
    def unsolved(
        cls, guess: gtsam.Pose3, matches: ScanMatches, iterations: int, solver_iterations: int
    ) -> Solution:
        """The guess back, after an association gave too few matches."""
        nothing = np.zeros((6, 6))
        return cls(guess, False, False, matches, iterations, solver_iterations, 0.0, 0.0, nothing)

    @property
    def n_weak(self) -> int:
        """Number of weak directions: the first of ``localizability.directions``."""
        return 0 if self.weak is None else round(float(np.trace(self.weak)))

    @property
    def scan_information(self) -> FloatArray:
        """(6, 6) ``information`` with the weak directions taken out."""
        if self.weak is None:
            return self.information
        keep = np.eye(6) - self.weak
        kept: FloatArray = keep.T @ self.information @ keep
        return kept


@dataclass(frozen=True, slots=True, eq=False)
class MotionPrior:
    """Where the pose is expected, for the directions in which a scan does not say it.

    Attributes
    ----------
    map_T_lidar : expected pose
    information : (6, 6) of the expectation, tangent order of the package
    """

    map_T_lidar: gtsam.Pose3
    information: FloatArray

    def factor(self, directions: FloatArray | None = None) -> gtsam.NonlinearFactor:
        """The expectation on :data:`POSE_KEY`.

        Parameters
        ----------
        directions : (6, 6) projector onto those in which it acts; all if None
        """
        information = self.information
        if directions is not None:
            information = directions.T @ information @ directions
        expected = gtsam.Values()
        expected.insert(POSE_KEY, self.map_T_lidar)
        hessian = gtsam.HessianFactor(POSE_KEY, information, np.zeros(6), 0.0)
        return gtsam.LinearContainerFactor(hessian, expected)


class ScanSolver(Protocol):
    """Solves one frame."""

    def solve(
        self,
        associate: Associate,
        guess: gtsam.Pose3,
        priors: Sequence[gtsam.NonlinearFactor] = (),
        motion: MotionPrior | None = None,
    ) -> Solution:
        """Find the pose.

        Parameters
        ----------
        associate : gives the matches at a pose; the mapper's is a :class:`Matcher`
        guess : ``map_T_lidar`` to start from
        priors : further factors on :data:`POSE_KEY`
        motion : expected motion, which takes over along weak directions; without it weak
            directions are not looked for
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """What one optimisation on fixed matches found; see :class:`Solution` for the rest.

    Attributes
    ----------
    map_T_lidar : the pose
    converged : whether the step to it was small
    steps : solver steps taken
    """

    map_T_lidar: gtsam.Pose3
    converged: bool
    steps: int
    error_before: float
    error_after: float
    information: FloatArray
    localizability: Localizability | None = None
    weak: FloatArray | None = None
    unseen: FloatArray | None = None
    beacons: BoolArray | None = None
    rows: MatchRows | None = None


def rematch(
    associate: Associate,
    guess: gtsam.Pose3,
    config: SolverConfig,
    optimise: Callable[[ScanMatches, gtsam.Pose3], Optimum],
    *,
    stop: bool = True,
) -> Solution:
    """Match and optimise in turn: the outer loop of every solver here.

    Parameters
    ----------
    associate, guess : see :meth:`ScanSolver.solve`
    config : ``iterations`` and ``min_matches`` are used
    optimise : finds the optimum of fixed matches, starting at a pose
    stop : whether the loop ends once the pose stays
    """
    matcher = associate if isinstance(associate, Matcher) else Matcher(associate)
    pose, steps, error_before = guess, 0, 0.0
    for iteration in range(1, config.iterations + 1):
        if iteration == 1:
            matches = matcher(pose)
        elif iteration == 2:
            # The first optimum knows the motion within the sweep better than the guess. Once is
            # enough: further rounds cost associations and change nothing that can be measured.
            matcher = matcher.deskewed(pose)
        if iteration > 1:
            matches = matcher.again(matches, pose)
        if len(matches) < config.min_matches:
            return Solution.unsolved(guess, matches, iteration, steps)
        found = optimise(matches, pose)
        pose, steps = found.map_T_lidar, steps + found.steps
        if iteration == 1:
            error_before = found.error_before
        if found.converged and stop:
            break
    return Solution(
        pose,
        True,
        found.converged,
        matches,
        iteration,
        steps,
        error_before,
        found.error_after,
        found.information,
        found.localizability,
        found.weak,
        found.unseen,
        found.beacons,
        found.rows,
    )
