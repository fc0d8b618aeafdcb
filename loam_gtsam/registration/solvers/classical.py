"""The classical solvers: LOAM's hand solve and A-LOAM's robust least squares, in numpy.

Rows have a standard deviation of 1 m, as in the originals: divide ``Solution.information`` by the
variance of a residual, m^2, to compare it with that of ``GtsamSolver``. Along degenerate directions
no step is made: the pose stays at the guess, and the expected motion tells how well that is known.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from scipy.linalg import qr, solve_triangular

from loam_gtsam.config import SolverConfig
from loam_gtsam.factors import MatchRows, concatenate_rows, line_rows, plane_rows
from loam_gtsam.geometry import transform
from loam_gtsam.registration.degeneracy import Localizability, localizability
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.solvers.base import (
    Associate,
    MotionPrior,
    Solution,
    check_settings,
    rematch,
)
from loam_gtsam.types import FloatArray, InputError

# LOAM's (rx, ry, rz) are (pitch, yaw, roll), and LOAM's (x, y, z) are (left, up, forward): the
# lidar's components in this order.
_LOAM_ORDER = [1, 2, 0]

# Levenberg-Marquardt as in Ceres with default options, which A-LOAM uses
# (ceres-solver, Solver::Options and levenberg_marquardt_strategy).
_START_RADIUS = 1e4
_MAX_RADIUS = 1e16
_DIAGONAL = (1e-6, 1e32)
_HALVINGS = 4  # of a step of LOAM's at most
_FALL = 0.25
"""Least share of the fall of the cost, as far as the gradient promises it, for which a step of
LOAM's is taken at its length (Armijo's rule); a step to the optimum of a parabola has half."""
_MIN_DECREASE = 1e-3  # share of the predicted fall of the cost from which a step is taken


class _SolverWithoutPriors(ABC):
    """The interface of both classical solvers: an error for priors, then the rematch loop."""

    _stop = True

    def __init__(self, config: SolverConfig) -> None:
        check_settings(config)
        self.config = config

    def solve(
        self,
        associate: Associate,
        guess: gtsam.Pose3,
        priors: Sequence[gtsam.NonlinearFactor] = (),
        motion: MotionPrior | None = None,
    ) -> Solution:
        """See :meth:`ScanSolver.solve`; InputError if priors are given."""
        if len(priors):
            raise InputError(
                f"priors: the {self.config.method} solver has no place for them, got "
                f"{len(priors)}; use solver.method: gtsam"
            )
        seen = weak = kept = None

        def optimise(matches: ScanMatches, pose: gtsam.Pose3) -> Solution:
            nonlocal seen, weak, kept
            if kept is None:  # the first matches decide which directions are degenerate
                seen = None if motion is None else localizability(matches, pose)
                kept, weak = self._kept(matches, pose, self._weak(seen, motion))
            return self._optimise(matches, pose, kept)

        found = rematch(associate, guess, self.config, optimise, stop=self._stop)
        if not found.solved or motion is None or weak is None:
            return replace(found, localizability=seen)
        rows = np.zeros(2 * len(found.matches.edges) + len(found.matches.planes), np.bool_)
        added = weak.T @ motion.information @ weak
        return replace(
            found, localizability=seen, weak=weak, unseen=weak, beacons=rows, expected=added
        )

    def _weak(self, seen: Localizability | None, motion: MotionPrior | None) -> FloatArray | None:
        """(6, 6) projector onto the degenerate directions; None if there are none."""
        if seen is None or motion is None or self.config.degeneracy == "off":
            return None
        weak = seen.projector(self.config.min_aligned)
        return None if weak is None else motion.share(weak)

    @abstractmethod
    def _kept(
        self, matches: ScanMatches, pose: gtsam.Pose3, weak: FloatArray | None
    ) -> tuple[FloatArray, FloatArray | None]:
        """(6, 6) projector of steps, in the solver's unknowns, and onto what it takes away.

        ``weak`` and the second one are in the package's tangent, None for no direction.
        """

    @abstractmethod
    def _optimise(self, matches: ScanMatches, pose: gtsam.Pose3, kept: FloatArray) -> Solution:
        """The next pose, from fixed matches."""


class ClassicalSolver(_SolverWithoutPriors):
    """LOAM's hand solve: one Gauss-Newton step on Euler angles per association.

    The unknowns are LOAM's (rx, ry, rz, x, y, z) with ``R = Ry(ry) Rx(rx) Rz(rz)`` in camera-like
    axes (x left, y up, z forward), which is singular at a pitch of 90 degrees. Every match is one
    row, multiplied by its weight s; ``A^T A x = A^T b`` is solved by QR. Directions with an
    eigenvalue of ``A^T A`` below ``config.degeneracy_threshold`` at the first association are
    projected out of every step (Zhang, Kaess and Singh, On Degeneracy of Optimization-based State
    Estimation Problems, ICRA 2016). With a threshold of 0, those that ``GtsamSolver`` finds
    degenerate are.

    With ``config.shorten_steps``, a step that hardly lowers the cost is halved: along directions
    that edges alone fix, LOAM's rows make steps twice too long, and the pose would move back and
    forth without end.

    Notes
    -----
    With fewer than ``config.min_matches`` matches the published code makes no step and adds the
    sweep to the map; here the guess is returned as not solved, as by the other solvers. For a point
    exactly on its line the published code divides by zero; here such a match adds nothing.
    """

    def _kept(
        self, matches: ScanMatches, pose: gtsam.Pose3, weak: FloatArray | None
    ) -> tuple[FloatArray, FloatArray | None]:
        turn, threshold = euler_jacobian(pose), self.config.degeneracy_threshold
        back = np.linalg.inv(turn)
        if threshold > 0.0:
            a = loam_rows(matches, pose).residuals(pose)[1] @ turn
            normal = a.T @ a
            published = self.config.degeneracy_projector == "published"
            kept = degeneracy_projector(normal, threshold, published=published)
            if np.linalg.eigvalsh(normal)[0] >= threshold:
                return kept, None
            return kept, np.eye(6) - turn @ degeneracy_projector(normal, threshold) @ back
        return (np.eye(6) if weak is None else back @ (np.eye(6) - weak) @ turn), weak

    def _optimise(self, matches: ScanMatches, pose: gtsam.Pose3, kept: FloatArray) -> Solution:
        residual, jacobian = loam_rows(matches, pose).residuals(pose)
        a = jacobian @ euler_jacobian(pose)
        step, steps = kept @ _solve_by_qr(a.T @ a, -a.T @ residual), 1
        small = _is_small(step, self.config)
        before, slope = 0.5 * float(residual @ residual), float(residual @ a @ step)
        moved, cost, jacobian = _after(matches, pose, step)
        while self.config.shorten_steps and steps <= _HALVINGS and cost > before + _FALL * slope:
            step, slope, steps = 0.5 * step, 0.5 * slope, steps + 1
            moved, cost, jacobian = _after(matches, pose, step)
        return Solution(moved, True, small, matches, 1, steps, before, cost, jacobian.T @ jacobian)


class ALoamSolver(_SolverWithoutPriors):
    """A-LOAM's solve: per association, a robust least squares over rotation and translation.

    Levenberg-Marquardt with Ceres' damping, at most ``config.inner_iterations`` steps, on the
    distance vectors of edges and the distances of planes with a Huber loss. All
    ``config.iterations`` associations are made; the stop rule only decides what is reported as
    converged. A-LOAM takes no direction for degenerate; ``config.degeneracy: off`` does so.

    Notes
    -----
    A-LOAM's edge residual is the cross product ``(q - a) x (q - b) / |a - b|`` with a, b on the
    line: the offset from the line turned by 90 degrees about the line. The two rows of
    :func:`loam_gtsam.factors.line_rows` give the same norms and the same normal equations.
    """

    _stop = False

    def _kept(
        self, matches: ScanMatches, pose: gtsam.Pose3, weak: FloatArray | None
    ) -> tuple[FloatArray, FloatArray | None]:
        turn = _turn(pose)
        return (np.eye(6) if weak is None else turn @ (np.eye(6) - weak) @ turn.T), weak

    def _optimise(self, matches: ScanMatches, pose: gtsam.Pose3, kept: FloatArray) -> Solution:
        rows, pairs, delta = aloam_rows(matches), len(matches.edges), self.config.huber_delta
        first, steps = pose, 0
        radius, shrink = _START_RADIUS, 2.0
        cost, normal, gradient = _robust(rows, pairs, delta, pose)
        start, settled = cost, False
        while steps < self.config.inner_iterations and not settled:
            steps += 1
            damping = np.clip(normal.diagonal(), *_DIAGONAL) / radius
            damped = np.linalg.solve(normal + np.diag(damping), gradient)
            step: FloatArray = kept @ np.negative(damped, dtype=np.float64)
            expected = -float(step @ (gradient + 0.5 * normal @ step))
            moved = _add_global(pose, step)
            new_cost, new_normal, new_gradient = _robust(rows, pairs, delta, moved)
            change = cost - new_cost
            if abs(change) <= self.config.cost_tolerance * cost:
                settled = True  # as in Ceres, the last small step is not taken
            elif expected > 0.0 and change > _MIN_DECREASE * expected:
                quality = 2.0 * change / expected - 1.0
                radius = min(radius / max(1.0 / 3.0, 1.0 - quality**3), _MAX_RADIUS)
                shrink = 2.0
                pose, cost, normal, gradient = moved, new_cost, new_normal, new_gradient
            else:
                radius /= shrink
                shrink *= 2.0
        turn = _turn(pose)
        information = turn.T @ normal @ turn
        small = _is_small(first.localCoordinates(pose), self.config)
        return Solution(pose, True, small, matches, 1, steps, start, cost, information)


def _after(
    matches: ScanMatches, pose: gtsam.Pose3, step: FloatArray
) -> tuple[gtsam.Pose3, float, FloatArray]:
    """Pose, cost and Jacobian of LOAM's rows after a step from a pose."""
    moved = _add_euler(pose, step)
    residual, jacobian = loam_rows(matches, moved).residuals(moved)
    return moved, 0.5 * float(residual @ residual), jacobian


def loam_rows(matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> MatchRows:
    """LOAM's rows at a pose, one per match, edges first: the distance in metres, times s.

    The row of an edge is the row of the plane that holds the line and faces the point: the residual
    is the distance, the derivative its gradient. Such a row leaves out the curvature of the
    distance around the line. With edges, LOAM's Gauss-Newton step therefore differs from the step
    of the two-row form, though cost and gradient are the same.
    """
    e, p = matches.edges, matches.planes
    away = transform(map_T_lidar.matrix(), e.points) - e.centres
    away -= np.einsum("ij,ij->i", away, e.directions)[:, None] * e.directions
    distance = np.linalg.norm(away, axis=1)
    normals = away / np.where(distance > 0.0, distance, 1.0)[:, None]
    offsets = -np.einsum("ij,ij->i", normals, e.centres)
    edges = plane_rows(e.points, normals, offsets, e.weights, 1.0)
    return concatenate_rows([edges, plane_rows(p.points, p.normals, p.offsets, p.weights, 1.0)])


def aloam_rows(matches: ScanMatches) -> MatchRows:
    """A-LOAM's rows, metres: two per edge, then one per plane, times the weight of the match."""
    e, p = matches.edges, matches.planes
    edges = line_rows(e.points, e.centres, e.directions, e.weights, 1.0)
    return concatenate_rows([edges, plane_rows(p.points, p.normals, p.offsets, p.weights, 1.0)])


def euler_jacobian(map_T_lidar: gtsam.Pose3) -> FloatArray:
    """(6, 6) derivative of the package's tangent vector by LOAM's (rx, ry, rz, x, y, z).

    ``R = Rz(yaw) Ry(pitch) Rx(roll)`` in lidar axes is ``Ry(ry) Rx(rx) Rz(rz)`` in LOAM's axes.
    """
    roll, pitch, _ = map_T_lidar.rotation().rpy()
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    rates = np.array([[1.0, 0.0, -sp], [0.0, cr, sr * cp], [0.0, -sr, cr * cp]])
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = rates[:, _LOAM_ORDER]
    jacobian[3:, 3:] = map_T_lidar.rotation().matrix().T[:, _LOAM_ORDER]
    return jacobian


def degeneracy_projector(
    normal: FloatArray, threshold: float, *, published: bool = False
) -> FloatArray:
    """(6, 6) matrix that removes from a step the directions of small eigenvalues.

    Zhang, Kaess and Singh (ICRA 2016), eq. 15: ``V_f^-1 V_u`` with eigenvectors as rows.

    Parameters
    ----------
    normal : (6, 6) A^T A
    threshold : least eigenvalue of a direction that is kept, in the units of ``normal``
    published : whether to repeat the error of the published Eigen port, which holds eigenvectors
        in columns but sets rows to zero, and so mixes all directions
    """
    values, columns = np.linalg.eigh(normal)
    vectors = columns if published else columns.T
    projector: FloatArray = vectors.T @ ((values >= threshold)[:, None] * vectors)
    return projector


def _is_small(step: FloatArray, config: SolverConfig) -> bool:
    """LOAM's stop rule on a (6,) step, rad and m."""
    rotation, translation = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
    limit = np.radians(config.rotation_tolerance_deg)
    return bool(rotation < limit and translation < config.translation_tolerance)


def _solve_by_qr(normal: FloatArray, right: FloatArray) -> FloatArray:
    """The step by QR with column pivoting, as in Eigen; 0 for a dependent column."""
    q, r, order = qr(normal, pivoting=True)
    diagonal = np.abs(r.diagonal())
    rank = int(np.count_nonzero(diagonal > len(r) * np.finfo(np.float64).eps * diagonal[0]))
    step = np.zeros(len(r))
    step[order[:rank]] = solve_triangular(r[:rank, :rank], (q.T @ right)[:rank])
    return step


def _add_euler(map_T_lidar: gtsam.Pose3, step: FloatArray) -> gtsam.Pose3:
    """The pose after a step in LOAM's (rx, ry, rz, x, y, z)."""
    angles, position = map_T_lidar.rotation().rpy(), np.array(map_T_lidar.translation())
    angles[_LOAM_ORDER] += step[:3]
    position[_LOAM_ORDER] += step[3:]
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(*angles), position)


def _add_global(map_T_lidar: gtsam.Pose3, step: FloatArray) -> gtsam.Pose3:
    """The pose after a turn about the map's axes and a shift along them, as in Ceres."""
    turned = gtsam.Rot3.Expmap(step[:3]).compose(map_T_lidar.rotation())
    return gtsam.Pose3(turned, map_T_lidar.translation() + step[3:])


def _turn(map_T_lidar: gtsam.Pose3) -> FloatArray:
    """(6, 6) derivative of a step along the map's axes by the package's tangent vector."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = map_T_lidar.rotation().matrix()
    return turn


def _robust(
    rows: MatchRows, pairs: int, delta: float, map_T_lidar: gtsam.Pose3
) -> tuple[float, FloatArray, FloatArray]:
    """Huber cost, J^T W J (6, 6) and J^T W r (6,) for steps along the map's axes."""
    # The two rows of an edge have one weight. W is the derivative of the loss (Triggs et al.,
    # Bundle Adjustment, 2000, without the second-order term, as in Ceres).
    residual, jacobian = rows.residuals(map_T_lidar)
    squared = residual * residual
    edges = squared[: 2 * pairs].reshape(-1, 2).sum(axis=1)
    squared = np.concatenate([edges, squared[2 * pairs :]])
    distance = np.sqrt(squared)
    weight = np.ones(len(squared))
    if delta > 0.0:
        far = distance > delta
        weight[far] = delta / distance[far]
        squared[far] = 2.0 * delta * distance[far] - delta * delta
    weight = np.concatenate([np.repeat(weight[:pairs], 2), weight[pairs:]])
    weighted = jacobian * weight[:, None]
    turn = _turn(map_T_lidar)
    normal = turn @ (weighted.T @ jacobian) @ turn.T
    return 0.5 * float(squared.sum()), normal, turn @ (weighted.T @ residual)
