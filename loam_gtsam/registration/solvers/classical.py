"""The classical solvers: LOAM's hand solve and A-LOAM's robust least squares, in numpy.

They take and return what :class:`~loam_gtsam.registration.solvers.GtsamSolver` does, so that the
same matches can be given to all three. Two differences of meaning:

* Rows count as measured to 1 m: the matches' standard deviations are not used, as in the
  originals, and ``Solution.information`` is that of these rows. Divided by the variance of a
  residual in m^2 it compares with that of ``GtsamSolver``.
* There is no place for priors; giving one is an error. A motion prior is not used:
  :class:`ClassicalSolver` has LOAM's own projector.

Both re-associate in the outer loop. ``R p + t = q`` with the pose ``map_T_lidar = (R, t)``.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from scipy.linalg import qr, solve_triangular

from loam_gtsam.config import SolverConfig
from loam_gtsam.factors import MatchRows, concatenate_rows, line_rows, plane_rows
from loam_gtsam.geometry import transform
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.solvers.base import (
    Associate,
    MotionPrior,
    Optimum,
    Solution,
    rematch,
)
from loam_gtsam.types import FloatArray, InputError

# LOAM's (rx, ry, rz) are (pitch, yaw, roll) and its (x, y, z) are (left, up, forward): both are the
# lidar's (x, y, z) components in this order.
_LOAM_ORDER = [1, 2, 0]

# Levenberg-Marquardt as in Ceres with default options, which A-LOAM uses
# (ceres-solver, Solver::Options and levenberg_marquardt_strategy).
_START_RADIUS = 1e4
_MAX_RADIUS = 1e16
_DIAGONAL = (1e-6, 1e32)
_MIN_DECREASE = 1e-3
"""A step is taken if the cost falls by more than this share of what the linear model says."""


class ClassicalSolver:
    """LOAM's hand solve: one Gauss-Newton step on Euler angles per association.

    The unknowns are LOAM's (rx, ry, rz, x, y, z) with ``R = Ry(ry) Rx(rx) Rz(rz)`` in its
    camera-like axes (x left, y up, z forward), singular at a pitch of 90 degrees. Every match is
    one row, multiplied by its weight s; ``A^T A x = A^T b`` is solved by QR. Directions whose
    eigenvalue of ``A^T A`` at the first association is below ``config.degeneracy_threshold`` are
    projected out of every step (Zhang, Kaess and Singh, On Degeneracy of Optimization-based State
    Estimation Problems, ICRA 2016).

    Notes
    -----
    Where the published code gets fewer than ``config.min_matches`` matches it makes no step and
    adds the sweep to the map anyway; here the guess comes back as not solved, as from the other
    solvers. On a line itself, where the published code divides by zero, a match adds nothing.
    """

    def __init__(self, config: SolverConfig) -> None:
        self.config = config

    def solve(
        self,
        associate: Associate,
        guess: gtsam.Pose3,
        priors: Sequence[gtsam.NonlinearFactor] = (),
        motion: MotionPrior | None = None,
    ) -> Solution:
        """See :meth:`loam_gtsam.registration.solvers.ScanSolver.solve`.

        Raises
        ------
        InputError
            If priors are given.
        """
        projector: FloatArray | None = None

        def optimise(matches: ScanMatches, pose: gtsam.Pose3) -> Optimum:
            nonlocal projector
            residual, jacobian = loam_rows(matches, pose).residuals(pose)
            a = jacobian @ euler_jacobian(pose)
            normal = a.T @ a
            if projector is None:
                projector = degeneracy_projector(
                    normal,
                    self.config.degeneracy_threshold,
                    published=self.config.degeneracy_projector == "published",
                )
            step = projector @ _solve_by_qr(normal, -a.T @ residual)
            moved = _add_euler(pose, step)
            after, jacobian = loam_rows(matches, moved).residuals(moved)
            return Optimum(
                moved,
                _is_small(step, self.config),
                1,
                0.5 * float(residual @ residual),
                0.5 * float(after @ after),
                jacobian.T @ jacobian,
            )

        _refuse_priors(priors, self.config)
        return rematch(associate, guess, self.config, optimise)


class ALoamSolver:
    """A-LOAM's solve: per association, a robust least squares over rotation and translation.

    Levenberg-Marquardt with Ceres' damping, at most ``config.inner_iterations`` steps, on the
    distance vectors of edges and the distances of planes with a Huber loss. All
    ``config.iterations`` associations are made; the stop rule only decides what is reported as
    converged.

    Notes
    -----
    A-LOAM's edge residual is the cross product ``(q - a) x (q - b) / |a - b|`` with a, b on the
    line: the offset from the line turned by 90 degrees about it, so the two rows of
    :func:`loam_gtsam.factors.line_rows` give the same norms and the same normal equations.
    """

    def __init__(self, config: SolverConfig) -> None:
        self.config = config

    def solve(
        self,
        associate: Associate,
        guess: gtsam.Pose3,
        priors: Sequence[gtsam.NonlinearFactor] = (),
        motion: MotionPrior | None = None,
    ) -> Solution:
        """See :meth:`loam_gtsam.registration.solvers.ScanSolver.solve`.

        Raises
        ------
        InputError
            If priors are given.
        """
        _refuse_priors(priors, self.config)
        return rematch(associate, guess, self.config, self._optimise, stop=False)

    def _optimise(self, matches: ScanMatches, pose: gtsam.Pose3) -> Optimum:
        rows, pairs, delta = aloam_rows(matches), len(matches.edges), self.config.huber_delta
        first, steps = pose, 0
        radius, shrink = _START_RADIUS, 2.0
        cost, normal, gradient = _robust(rows, pairs, delta, pose)
        start, settled = cost, False
        while steps < self.config.inner_iterations and not settled:
            steps += 1
            damping = np.clip(normal.diagonal(), *_DIAGONAL) / radius
            damped = np.linalg.solve(normal + np.diag(damping), gradient)
            step: FloatArray = np.negative(damped, dtype=np.float64)
            expected = -float(step @ (gradient + 0.5 * normal @ step))
            moved = _add_global(pose, step)
            new_cost, new_normal, new_gradient = _robust(rows, pairs, delta, moved)
            change = cost - new_cost
            if abs(change) <= self.config.cost_tolerance * cost:
                settled = True  # and, as in Ceres, this last small step is not taken
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
        converged = _is_small(first.localCoordinates(pose), self.config)
        return Optimum(pose, converged, steps, start, cost, information)


def loam_rows(matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> MatchRows:
    """LOAM's rows at a pose, one per match: the distance from the line or the plane, times s.

    The row of an edge is that of the plane through the line which faces the point, so its residual
    is the distance and its derivative the gradient of the distance. It knows nothing of the
    curvature of the distance around the line: with edges, LOAM's Gauss-Newton step differs from
    that of the two-row form, though the cost and its gradient are the same.

    Parameters
    ----------
    matches : M in all
    map_T_lidar : pose at which the edges' rows are taken

    Returns
    -------
    MatchRows
        M rows in metres, edges first.
    """
    e, p = matches.edges, matches.planes
    away = transform(map_T_lidar.matrix(), e.points) - e.centres
    away -= np.einsum("ij,ij->i", away, e.directions)[:, None] * e.directions
    distance = np.linalg.norm(away, axis=1)
    normals = away / np.where(distance > 0.0, distance, 1.0)[:, None]
    offsets = -np.einsum("ij,ij->i", normals, e.centres)
    return concatenate_rows(
        [
            plane_rows(e.points, normals, offsets, e.weights, 1.0),
            plane_rows(p.points, p.normals, p.offsets, p.weights, 1.0),
        ]
    )


def aloam_rows(matches: ScanMatches) -> MatchRows:
    """A-LOAM's rows: two per edge, one per plane, in metres, times the match's weight."""
    e, p = matches.edges, matches.planes
    return concatenate_rows(
        [
            line_rows(e.points, e.centres, e.directions, e.weights, 1.0),
            plane_rows(p.points, p.normals, p.offsets, p.weights, 1.0),
        ]
    )


def euler_jacobian(map_T_lidar: gtsam.Pose3) -> FloatArray:
    """(6, 6) derivative of the package's tangent vector by LOAM's (rx, ry, rz, x, y, z).

    From ``R = Rz(yaw) Ry(pitch) Rx(roll)`` in lidar axes, which is LOAM's
    ``Ry(ry) Rx(rx) Rz(rz)`` in its own.
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
    """(6, 6) matrix that takes a step out of the directions with eigenvalues below a threshold.

    Parameters
    ----------
    normal : (6, 6) A^T A
    threshold : in the units of ``normal``
    published : as the published Eigen port does it: it keeps eigenvectors in columns but zeroes
        rows, and so mixes all directions

    Notes
    -----
    Zhang, Kaess and Singh (ICRA 2016), eq. 15: ``V_f^-1 V_u`` with eigenvectors as rows.
    """
    values, columns = np.linalg.eigh(normal)
    vectors = columns if published else columns.T
    projector: FloatArray = vectors.T @ ((values >= threshold)[:, None] * vectors)
    return projector


def _refuse_priors(priors: Sequence[gtsam.NonlinearFactor], config: SolverConfig) -> None:
    if len(priors):
        raise InputError(
            f"priors: the {config.method} solver has no place for them, got {len(priors)}; use "
            "solver.method: gtsam"
        )


def _is_small(step: FloatArray, config: SolverConfig) -> bool:
    """LOAM's stop rule on (6,) rotation and translation, and nothing else."""
    rotation, translation = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
    limit = np.radians(config.rotation_tolerance_deg)
    return bool(rotation < limit and translation < config.translation_tolerance)


def _solve_by_qr(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solve by QR with column pivoting, as Eigen does; a dependent column gets no step."""
    q, r, order = qr(normal, pivoting=True)
    diagonal = np.abs(r.diagonal())
    rank = int(np.count_nonzero(diagonal > len(r) * np.finfo(np.float64).eps * diagonal[0]))
    step = np.zeros(len(r))
    step[order[:rank]] = solve_triangular(r[:rank, :rank], (q.T @ right)[:rank])
    return step


def _add_euler(map_T_lidar: gtsam.Pose3, step: FloatArray) -> gtsam.Pose3:
    """Add a step in LOAM's (rx, ry, rz, x, y, z) to the angles and the position."""
    angles, position = map_T_lidar.rotation().rpy(), np.array(map_T_lidar.translation())
    angles[_LOAM_ORDER] += step[:3]
    position[_LOAM_ORDER] += step[3:]
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(*angles), position)


def _add_global(map_T_lidar: gtsam.Pose3, step: FloatArray) -> gtsam.Pose3:
    """Turn about the map's axes and shift along them, as Ceres' quaternion does."""
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
    """Huber cost, J^T W J (6, 6) and J^T W r (6,) for steps along the map's axes.

    The first ``2 * pairs`` rows belong together in twos. W is the derivative of the loss (Triggs et
    al., Bundle Adjustment, 2000, without the second-order term, as in Ceres for Huber).
    """
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
