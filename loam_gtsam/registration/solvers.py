"""Per-frame solvers: from a guess and a way to associate, to a pose.

A solver is anything with :meth:`ScanSolver.solve`; the mapper does not know which one it has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import gtsam
import numpy as np

from loam_gtsam.config import SolverConfig
from loam_gtsam.factors import (
    MatchRows,
    checked_factor,
    concatenate_rows,
    line_rows,
    plane_rows,
    scan_match_factor,
)
from loam_gtsam.registration.association import ScanMatches
from loam_gtsam.registration.degeneracy import (
    Localizability,
    line_sight,
    localizability,
    unseen_by_planes,
)
from loam_gtsam.types import BoolArray, FloatArray

POSE_KEY: int = gtsam.symbol("x", 0)
"""Key of the frame's pose ``map_T_lidar`` in every graph handed to a solver."""

_REDESCENDING = 2.816
"""Width of a Geman-McClure kernel over that of a Huber kernel of the same efficiency on normal
noise: 3.787 and 1.345 at 95 %."""

_TO_SIGMA = 1.4826
"""Median absolute deviation to standard deviation, for a normal distribution."""

_FUSE = gtsam.LevenbergMarquardtParams()
_FUSE.setVerbosityLM("SILENT")
_FUSE.setlambdaInitial(1e-12)  # a single pose near its optimum: plain Gauss-Newton steps
_FUSE.setRelativeErrorTol(1e-14)
_FUSE.setAbsoluteErrorTol(0.0)

_CERTAIN = 1e10
"""Information that no factor stands up to: 0.01 mrad and 0.01 mm."""

Associate = Callable[[gtsam.Pose3], ScanMatches]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """What a solver returns.

    Attributes
    ----------
    map_T_lidar : the pose; the guess if ``solved`` is false
    solved : false when an association gave too few matches
    converged : the last association moved the pose less than the stop rule
    matches : of the last association
    iterations, solver_iterations : associations, and solver steps over all of them
    error_before, error_after : cost at the guess with the first matches, and at the pose with the
        last ones
    information : (6, 6) of matches and priors at the pose
    localizability : which motions the first matches say something about; None if not looked at
    weak : (6, 6) projector onto those they say too little about; None if there are none
    unseen : (6, 6) projector onto those that the planes say too little about, where nothing but
        ``beacons`` and the expected motion counts; None if there are none
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
        associate : gives the matches at a pose
        guess : ``map_T_lidar`` to start from
        priors : further factors on :data:`POSE_KEY`
        motion : takes over along weak directions; None: they are not looked for
        """
        ...


class GtsamSolver:
    """Levenberg-Marquardt on a factor graph, re-associated until the pose stays.

    Each association makes one scan-match factor (weights frozen: iteratively re-weighted least
    squares); priors are ordinary factors beside it.
    """

    def __init__(self, config: SolverConfig) -> None:
        self.config = config
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(config.inner_iterations)
        params.setVerbosityLM("SILENT")
        self._params = params

    def solve(
        self,
        associate: Associate,
        guess: gtsam.Pose3,
        priors: Sequence[gtsam.NonlinearFactor] = (),
        motion: MotionPrior | None = None,
    ) -> Solution:
        """See :meth:`ScanSolver.solve`."""
        config = self.config
        expected = motion
        if motion is not None and config.degeneracy == "project":
            expected = replace(motion, information=_CERTAIN * np.eye(6))
        seen: Localizability | None = None
        weak: FloatArray | None = None
        planes: Localizability | None = None
        pose = guess
        converged = False
        steps = 0
        error_before = error_after = 0.0
        information = np.zeros((6, 6))
        unseen: FloatArray | None = None
        beacons: BoolArray | None = None
        for iteration in range(1, config.iterations + 1):
            matches = associate(pose)
            if len(matches) < config.min_matches:
                return Solution.unsolved(guess, matches, iteration, steps)
            if iteration == 1 and motion is not None:
                seen = localizability(matches, pose)
                if config.degeneracy != "off":
                    weak = seen.projector(config.min_aligned)
                if config.degeneracy == "prior":
                    planes = unseen_by_planes(matches, pose, seen, config.min_aligned)
            values = gtsam.Values()
            values.insert(POSE_KEY, pose)
            graph = gtsam.NonlinearFactorGraph()
            rows = match_rows(matches, config.kernel_width, config.kernel)
            unseen = weak
            beacons = np.zeros(len(rows.points), np.bool_)
            if planes is not None:
                unseen = planes.projector(config.min_aligned)
                sight = line_sight(matches.edges, pose, planes.weak(config.min_aligned))
                beacons[: 2 * len(sight)] = np.repeat(sight.any(axis=1), 2)
            for factor in _scan_factors(rows, values, unseen, beacons):
                graph.add(factor)
            if weak is not None and expected is not None:
                graph.add(expected.factor(weak))
            for factor in priors:
                graph.add(factor)
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, self._params)
            if iteration == 1:
                error_before = optimizer.error()
            result = optimizer.optimize()
            steps += optimizer.iterations()
            error_after = optimizer.error()
            moved = result.atPose3(POSE_KEY)
            step = pose.localCoordinates(moved)
            pose = moved
            information = graph.linearize(result).hessian()[0]
            converged = within_tolerance(step, information, config)
            if converged:
                break
        return Solution(
            pose,
            True,
            converged,
            matches,
            iteration,
            steps,
            error_before,
            error_after,
            information,
            seen,
            weak,
            unseen,
            beacons,
            rows,
        )


def _scan_factors(
    rows: MatchRows, values: gtsam.Values, unseen: FloatArray | None, beacons: BoolArray
) -> Iterator[gtsam.NonlinearFactor]:
    """The scan; of unseen directions, only what the beacons say about them."""
    if unseen is None:
        yield scan_match_factor(POSE_KEY, rows)
        return
    if beacons.any():
        yield scan_match_factor(POSE_KEY, rows.where(beacons))
    if not beacons.all():
        yield _without(scan_match_factor(POSE_KEY, rows.where(~beacons)), values, unseen)


def _without(
    scan: gtsam.NonlinearFactor, values: gtsam.Values, weak: FloatArray
) -> gtsam.NonlinearFactor:
    """The scan's factor, linearised, with what it claims about weak directions taken out."""
    linear = scan.linearize(values)
    information, column = linear.information(), linear.augmentedInformation()[:, -1]
    right, squared = column[:-1], float(column[-1])
    keep = np.eye(6) - weak
    hessian = gtsam.HessianFactor(POSE_KEY, keep.T @ information @ keep, keep.T @ right, squared)
    return gtsam.LinearContainerFactor(hessian, values)


def fuse(
    map_T_lidar: gtsam.Pose3,
    information: FloatArray,
    factors: Sequence[gtsam.NonlinearFactor],
) -> tuple[gtsam.Pose3, FloatArray]:
    """Bring factors that come after the solve together with its solution.

    Parameters
    ----------
    map_T_lidar, information : the solution and its (6, 6) information, which may be singular: a
        quadratic cost about the solution
    factors : on :data:`POSE_KEY`

    Returns
    -------
    pose, information : the optimum of all, and its (6, 6) information
    """
    # A root by eigenvalues, for the information may be singular.
    eigenvalues, vectors = np.linalg.eigh(information)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * vectors.T

    def solved(at: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        # Not a PriorFactorPose3, whose Jacobian is that of no displacement.
        moved = map_T_lidar.between(at.atPose3(POSE_KEY))
        return root @ gtsam.Pose3.Logmap(moved), [root @ gtsam.Pose3.LogmapDerivative(moved)]

    values = gtsam.Values()
    values.insert(POSE_KEY, map_T_lidar)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(checked_factor(gtsam.noiseModel.Unit.Create(6), [POSE_KEY], solved))
    for factor in factors:
        graph.add(factor)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, _FUSE).optimize()
    return result.atPose3(POSE_KEY), graph.linearize(result).hessian()[0]


def within_tolerance(step: FloatArray, information: FloatArray, config: SolverConfig) -> bool:
    """Whether a (6,) step is small enough to stop: LOAM's rule, or small for what is known.

    In a direction that the scan hardly fixes, re-association goes to and fro by more than LOAM's
    half millimetre for ever. Such steps are far below the standard deviation in that direction.

    Parameters
    ----------
    step : (6,) tangent, rad and m
    information : (6, 6) of the pose
    """
    rotation = np.degrees(np.linalg.norm(step[:3]))
    translation = np.linalg.norm(step[3:])
    small = rotation < config.rotation_tolerance_deg and translation < config.translation_tolerance
    return bool(small or step @ information @ step < config.step_sigmas**2)


def _kept(units: FloatArray, width: float, kernel: str) -> FloatArray:
    """By what a kernel of a Huber width scales rows, for their whitened distances."""
    if kernel == "geman_mcclure":
        scales: FloatArray = 1.0 / (1.0 + (units / (_REDESCENDING * width)) ** 2)
        return scales
    scales = np.sqrt(width / np.maximum(units, width))
    return scales


def match_rows(
    matches: ScanMatches, kernel_width: float = np.inf, kernel: str = "huber"
) -> MatchRows:
    """The matches as whitened rows: each scaled by its weight over its standard deviation.

    Parameters
    ----------
    kernel_width : of a Huber kernel, in units of the scatter of the whitened distances; infinite
        for none
    kernel : "huber", or "geman_mcclure" with the same efficiency on normal noise

    Notes
    -----
    The kernel is applied as iteratively re-weighted least squares: a row whose whitened distance u
    exceeds ``k s`` is scaled by ``sqrt(k s / u)`` (Huber, Robust Statistics, 1981). The unit s is
    ``max(1, 1.4826 median(u))``: far from the optimum all distances are large, and a fixed unit
    would silence them all. Kernels that fall off faster (Cauchy) lose the pose in foliage, where
    many matches agree on a wrong one; that of Geman and McClure (1985), which scales by
    ``1 / (1 + (u / c s)^2)``, did not so far, and stands up to passing objects better. As the unit
    shrinks with the distances from one association to the next, it tightens by itself.
    """
    e, p = matches.edges, matches.planes
    edge_units, plane_units = e.distances / e.sigmas, np.abs(p.distances) / p.sigmas
    edge_weights, plane_weights = e.weights, p.weights
    if len(matches) and np.isfinite(kernel_width):
        units, half = np.concatenate([edge_units, plane_units]), len(matches) // 2
        scatter = _TO_SIGMA * float(np.partition(units, half)[half])
        width = kernel_width * max(1.0, scatter)
        edge_weights = edge_weights * _kept(edge_units, width, kernel)
        plane_weights = plane_weights * _kept(plane_units, width, kernel)
    return concatenate_rows(
        [
            line_rows(e.points, e.centres, e.directions, edge_weights, e.sigmas),
            plane_rows(p.points, p.normals, p.offsets, plane_weights, p.sigmas),
        ]
    )
