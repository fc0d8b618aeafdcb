"""The interface of the solvers, and the loop in which each of them matches and optimises."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import gtsam
import numpy as np

from loam_gtsam.config import SolverConfig
from loam_gtsam.factors import MatchRows
from loam_gtsam.registration.degeneracy import Localizability, spanned
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.types import BoolArray, FloatArray, check_kind

POSE_KEY: int = gtsam.symbol("x", 0)
"""Key of the pose of a frame, ``map_T_lidar`` at the middle of the sweep, in the solver's graph."""

SCAN_VARIANCE = 4.0
"""Variance of a scan's error over that of its raw covariance, where the scatter of the residuals
does not tell it: where some direction is not seen, the map was made by the same guesses as the
scan, and agrees with them."""

_FAR = 1e4
"""Metres from its guess at which a pose is no solution: a sweep has no map there to match."""

Associate = Callable[[gtsam.Pose3], ScanMatches]
"""Gives the matches of a sweep at a pose ``map_T_lidar``: a pure function."""


class Matcher:
    """The matches of one sweep with one map, as a function of the pose.

    Every method is pure: the same arguments always give the same result. This base class wraps a
    plain function; the mapper's ``FrameMatcher`` overrides all methods.
    """

    def __init__(self, associate: Associate) -> None:
        self._associate = associate

    @property
    def motion_is_free(self) -> bool:
        """Whether the matches have a say in the motion within the sweep."""
        return False

    def __call__(self, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        """Search for the matches at a pose."""
        return self._associate(map_T_lidar)

    def again(self, matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        """The matches at another pose; lines and planes that were found near by may be kept."""
        return self(map_T_lidar)

    def deskewed(self, map_T_lidar: gtsam.Pose3, matches: ScanMatches) -> Matcher:
        """The matcher of the same sweep, de-skewed with the motion that leads to a pose.

        ``matches`` are the last ones, with which that pose was found.
        """
        return self


def check_settings(config: object) -> None:
    """InputError for anything but the settings of a solver."""
    how = 'the section "solver" of a Config is one: preset("loam").solver'
    check_kind(config, SolverConfig, "config of a solver", how)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The solved pose of a frame, and what the solver knows about that pose.

    Attributes
    ----------
    map_T_lidar : the pose; the guess if ``solved`` is false
    solved : false if an association gave too few matches
    converged : whether the last association moved the pose by less than the stop rule
    matches : matches of the last association
    iterations, solver_iterations : number of associations, and of solver steps over all of them
    error_before, error_after : cost at the guess with the first matches, and at the pose with the
        last matches
    information : (6, 6) of matches and priors at the pose, tangent order of the package
    localizability : how well the first matches fix each motion; None if not computed
    weak : (6, 6) projector onto the directions that the last matches left open, the degenerate
        ones; None if there are none
    unseen : (6, 6) projector onto the directions that the planes do not fix, along which only
        ``beacons`` and the expected motion count; None if there are none
    beacons : (R,) mask of the rows that count along ``unseen``, though not along ``weak``
    rows : the matches with the weights of the last association; None if the solver has no rows
    expected : (6, 6) what the expected motion added, to ``information`` as well if there are
        ``rows``; None if none
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
    expected: FloatArray | None = None

    @classmethod
    def unsolved(
        cls, guess: gtsam.Pose3, matches: ScanMatches, iterations: int, solver_iterations: int
    ) -> Solution:
        """The solution that returns the guess, after an association gave too few matches."""
        nothing = np.zeros((6, 6))
        return cls(guess, False, False, matches, iterations, solver_iterations, 0.0, 0.0, nothing)

    @property
    def n_weak(self) -> int:
        """Number of degenerate directions."""
        return 0 if self.weak is None else round(float(np.trace(self.weak)))

    @property
    def scan_information(self) -> FloatArray:
        """(6, 6) ``information`` without the degenerate directions and the expected motion."""
        if self.weak is None:
            return self.information
        information, keep = self.information, np.eye(6) - self.weak
        if self.expected is not None and self.rows is not None:
            information = information - self.expected
        kept: FloatArray = keep.T @ information @ keep
        return kept


@dataclass(frozen=True, slots=True, eq=False)
class MotionPrior:
    """A pose that is known beside the scan: that which further factors tell, or the expected one.

    The expected one is used along the directions that a scan does not fix.

    Attributes
    ----------
    map_T_lidar : the pose
    information : (6, 6), in the tangent order of the package
    measured : whether gyro and accelerometer tell it, so that the information holds all that is
        not known of it. That of a constant velocity leaves out the error of the velocity.
    """

    map_T_lidar: gtsam.Pose3
    information: FloatArray
    measured: bool = False

    @classmethod
    def of_factors(
        cls, factors: Sequence[gtsam.NonlinearFactor], near: gtsam.Pose3
    ) -> MotionPrior | None:
        """What factors on :data:`POSE_KEY` say of a pose near this one; None without any."""
        if not factors:
            return None
        information, pull = linearized(factors, near)
        step = np.linalg.lstsq(information, pull, rcond=None)[0]
        return cls(near.retract(step), information)

    def beside(self, others: MotionPrior, seconds: float, config: SolverConfig) -> MotionPrior:
        """The expected pose beside what factors of a user's own tell of it.

        Where these tell more than that no velocity is beyond those of the start of a run, it counts
        for that only: a velocity that poses before have told outvotes them, and so tells itself in
        the next frame. What is measured stays as it is.
        """
        if self.measured or not self.information.any():
            return self
        possible = seconds * np.repeat([config.start_turn, config.start_speed], 3)
        known, axes = np.linalg.eigh(others.information * np.outer(possible, possible))
        told = possible[:, None] * axes[:, known > 1.0]
        variances = np.linalg.inv(self.information) + told @ told.T
        return replace(self, information=np.linalg.inv(variances).astype(np.float64))

    def along(self, directions: FloatArray) -> MotionPrior:
        """The expected pose along directions alone, given by their (6, 6) projector."""
        share = self.share(directions)
        return replace(self, information=share.T @ self.information @ share)

    def share(self, directions: FloatArray) -> FloatArray:
        """(6, 6) the part of a motion that the expected pose decides beside a scan.

        The scan fixes all motions but those of some directions, given by their (6, 6) projector.
        Along these the pose is where it is most likely, given the others: a lidar that has turned
        less than expected has not moved aside for that. Where gyro and accelerometer tell the
        motion, the others are off by the noise of the scan, which tells nothing of these
        directions: the projector stays. See docs/maths/degeneracy.md.
        """
        if self.measured or not self.information.any():
            return directions
        basis = spanned(directions)
        pulled = basis.T @ self.information
        share: FloatArray = basis @ np.linalg.pinv(pulled @ basis, hermitian=True) @ pulled
        return share

    def factor(self, directions: FloatArray | None = None) -> gtsam.NonlinearFactor:
        """The expected pose as a factor on :data:`POSE_KEY`.

        ``directions`` is a (6, 6) projector onto those in which the factor acts; all if None.
        """
        information = self.information if directions is None else self.along(directions).information
        expected = gtsam.Values()
        expected.insert(POSE_KEY, self.map_T_lidar)
        hessian = gtsam.HessianFactor(POSE_KEY, information, np.zeros(6), 0.0)
        return gtsam.LinearContainerFactor(hessian, expected)


def linearized(
    factors: Sequence[gtsam.NonlinearFactor], map_T_lidar: gtsam.Pose3
) -> tuple[FloatArray, FloatArray]:
    """Information (6, 6) of factors on :data:`POSE_KEY` at a pose, and pull (6,) to their optimum.

    The optimum is at ``solve(information, pull)``, in the tangent order of the package.
    """
    values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    values.insert(POSE_KEY, map_T_lidar)
    for factor in factors:
        graph.add(factor)
    return graph.linearize(values).hessian()


class ScanSolver(Protocol):
    """Any object with the method :meth:`solve`."""

    def solve(
        self,
        associate: Associate,
        guess: gtsam.Pose3,
        priors: Sequence[gtsam.NonlinearFactor] = (),
        motion: MotionPrior | None = None,
    ) -> Solution:
        """Find the pose of one frame.

        Parameters
        ----------
        associate : gives the matches at a pose; the mapper passes a :class:`Matcher`
        guess : ``map_T_lidar`` to start from
        priors : further factors on :data:`POSE_KEY`
        motion : expected pose, which decides along degenerate directions; if None, degenerate
            directions are not looked for
        """
        ...


def rematch(
    associate: Associate,
    guess: gtsam.Pose3,
    config: SolverConfig,
    optimise: Callable[[ScanMatches, gtsam.Pose3], Solution],
    *,
    stop: bool = True,
) -> Solution:
    """Match and optimise alternately: the outer loop of every solver of the package.

    From the second round on the sweep is de-skewed with the motion that the round before found.

    Parameters
    ----------
    associate, guess : see :meth:`ScanSolver.solve`
    config : ``iterations`` and ``min_matches`` are used
    optimise : finds the optimum of fixed matches from a start pose. Of the solution that it
        returns, ``converged`` decides whether the loop may end and ``solver_iterations`` are
        added up; ``iterations`` is replaced
    stop : whether the loop ends at the first round that converged
    """
    matcher = associate if isinstance(associate, Matcher) else Matcher(associate)
    pose, steps, error_before = guess, 0, 0.0
    for iteration in range(1, config.iterations + 1):
        if iteration == 1:
            matches = matcher(pose)
        elif iteration == 2 or matcher.motion_is_free:
            # The first optimum knows a constant velocity well enough for all further rounds.
            matcher = matcher.deskewed(pose, matches)
        if iteration > 1:
            matches = matcher.again(matches, pose)
        if len(matches) < config.min_matches:
            return Solution.unsolved(guess, matches, iteration, steps)
        found = optimise(matches, pose)
        pose, steps = found.map_T_lidar, steps + found.solver_iterations
        if not guess.range(pose) < _FAR:  # nor if it is not a number
            return Solution.unsolved(guess, matches, iteration, steps)
        if iteration == 1:
            error_before = found.error_before
        if found.converged and stop:
            break
    return replace(found, iterations=iteration, solver_iterations=steps, error_before=error_before)
