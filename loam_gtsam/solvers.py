"""Per-frame solvers: from a guess and a way to associate, to a pose.

A solver is anything with :meth:`ScanSolver.solve`; the mapper does not know which one it has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np

from loam_gtsam.config import SolverConfig
from loam_gtsam.factors import (
    MatchRows,
    concatenate_rows,
    line_rows,
    plane_rows,
    scan_match_factor,
)
from loam_gtsam.matching import ScanMatches
from loam_gtsam.types import FloatArray

POSE_KEY: int = gtsam.symbol("x", 0)
"""Key of the frame's pose ``map_T_lidar`` in every graph handed to a solver."""

_TO_SIGMA = 1.4826
"""Median absolute deviation to standard deviation, for a normal distribution."""

Associate = Callable[[gtsam.Pose3], ScanMatches]


@dataclass(frozen=True, slots=True)
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


class ScanSolver(Protocol):
    """Solves one frame."""

    def solve(
        self,
        associate: Associate,
        guess: gtsam.Pose3,
        priors: Sequence[gtsam.NonlinearFactor] = (),
    ) -> Solution:
        """Find the pose.

        Parameters
        ----------
        associate : gives the matches at a pose
        guess : ``map_T_lidar`` to start from
        priors : further factors on :data:`POSE_KEY`
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
    ) -> Solution:
        """See :meth:`ScanSolver.solve`."""
        config = self.config
        pose = guess
        converged = False
        steps = 0
        error_before = error_after = 0.0
        information = np.zeros((6, 6))
        for iteration in range(1, config.iterations + 1):
            matches = associate(pose)
            if len(matches) < config.min_matches:
                return Solution(
                    guess, False, False, matches, iteration, steps, 0.0, 0.0, np.zeros((6, 6))
                )
            graph = gtsam.NonlinearFactorGraph()
            graph.add(scan_match_factor(POSE_KEY, match_rows(matches, config.kernel_width)))
            for factor in priors:
                graph.add(factor)
            values = gtsam.Values()
            values.insert(POSE_KEY, pose)
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
            pose, True, converged, matches, iteration, steps, error_before, error_after, information
        )


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


def match_rows(matches: ScanMatches, kernel_width: float = np.inf) -> MatchRows:
    """The matches as whitened rows: each scaled by its weight over its standard deviation.

    Parameters
    ----------
    kernel_width : of a Huber kernel, in units of the scatter of the whitened distances; infinite
        for none

    Notes
    -----
    The kernel is applied as iteratively re-weighted least squares: a row whose whitened distance u
    exceeds ``k s`` is scaled by ``sqrt(k s / u)`` (Huber, Robust Statistics, 1981). The unit s is
    ``max(1, 1.4826 median(u))``: far from the optimum all distances are large, and a fixed unit
    would silence them all. Kernels that fall off faster (Cauchy) lose the pose in foliage, where
    many matches agree on a wrong one.
    """
    e, p = matches.edges, matches.planes
    edge_units, plane_units = e.distances / e.sigmas, np.abs(p.distances) / p.sigmas
    edge_weights, plane_weights = e.weights, p.weights
    if len(matches) and np.isfinite(kernel_width):
        scatter = _TO_SIGMA * float(np.median(np.concatenate([edge_units, plane_units])))
        width = kernel_width * max(1.0, scatter)
        edge_weights = edge_weights * np.sqrt(width / np.maximum(edge_units, width))
        plane_weights = plane_weights * np.sqrt(width / np.maximum(plane_units, width))
    return concatenate_rows(
        [
            line_rows(e.points, e.centres, e.directions, edge_weights, e.sigmas),
            plane_rows(p.points, p.normals, p.offsets, plane_weights, p.sigmas),
        ]
    )
