"""The error of one scan, told by its own residuals.

Equations: docs/maths/covariance.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loam_gtsam.config import CovarianceConfig
from loam_gtsam.geometry import find_in_sorted, symmetric, transform, voxel_keys
from loam_gtsam.registration.solvers import Solution, match_rows
from loam_gtsam.types import BoolArray, FloatArray, IntArray

_PRIOR_CELLS = 6.0
"""Cells that the scatter of all residuals counts for beside that of the cells: with fewer than six
of them the scores alone do not span the six directions."""
_LEAST_VARIANCE = 1e-6
"""Of whitened residuals: a covariance must not vanish on data without noise."""
_REMEMBERED = 500_000
"""Cells of one generation of :class:`SeenGround`: 4 MB."""
_WAITING = 0.1
"""Share of a generation that waits to be put in its place."""
_NO_KEYS: IntArray = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class ScanError:
    """What the matches of one frame say about its error, all about the middle of the sweep.

    Attributes
    ----------
    covariance : (6, 6) of the solution, were the map exact
    renewed : (6, 6) the part of it that stems from ground matched for the first time, and along
        weak directions, in which nothing but the expected motion ties the pose to the map
    user : (6, 6) share of the pose that factors beside the scan decide
    residual_variance, effective_matches : see :class:`loam_gtsam.types.Uncertainty`
    """

    covariance: FloatArray
    renewed: FloatArray
    user: FloatArray
    residual_variance: float
    effective_matches: float


class SeenGround:
    """Which cells of the map have been matched; those not matched for long are forgotten.

    Parameters
    ----------
    size : edge length of a cell, metres
    remembered : cells of a generation. When the younger one is full it becomes the older one, and
        what was in that is forgotten: ground that comes back then counts as new.
    """

    def __init__(self, size: float, remembered: int = _REMEMBERED) -> None:
        self._size = size
        self._remembered = remembered
        # Each sorted. The newest keys wait in an array of their own: to put them in their places
        # takes time in proportion to all the others.
        self._new: IntArray = _NO_KEYS
        self._young: IntArray = _NO_KEYS
        self._old: IntArray = _NO_KEYS

    @property
    def is_empty(self) -> bool:
        """Whether nothing has been matched yet."""
        return len(self._new) + len(self._young) + len(self._old) == 0

    def cells(self, points_map: FloatArray) -> tuple[IntArray, BoolArray]:
        """Number of the cell of each point (N,), and which of the C cells are new; remembers them.

        Parameters
        ----------
        points_map : (N, 3) metres
        """
        keys, numbers = np.unique(voxel_keys(points_map, self._size), return_inverse=True)
        fresh = ~(find_in_sorted(self._new, keys)[1] | find_in_sorted(self._young, keys)[1])
        new = fresh & ~find_in_sorted(self._old, keys)[1]
        self._new = np.sort(np.concatenate((self._new, keys[fresh])), kind="stable")
        if len(self._new) > _WAITING * len(self._young):
            self._young = np.sort(np.concatenate((self._young, self._new)), kind="stable")
            self._new = _NO_KEYS
        if len(self._young) > self._remembered:
            self._young, self._old = _NO_KEYS, self._young
        return numbers, new


def scan_error(
    solution: Solution,
    kernel_width: float,
    seen: SeenGround,
    config: CovarianceConfig,
    *,
    kernel: str = "huber",
    with_priors: bool = True,
) -> ScanError | None:
    """The error of one solve from its residuals; None if its information is singular.

    The sandwich ``B S B`` of robust statistics, with B the inverse information and S the scatter of
    the scores ``J^T r``, summed over cells of the map before they are squared: matches in one cell
    share map points, and their errors (Liang and Zeger, Biometrika 73, 1986; White, Econometrica
    48, 1980).

    Parameters
    ----------
    solution : solved
    kernel_width, kernel : of the solver, for the weights of the matches if it gives no rows
    seen : ground matched so far; this frame's is added
    with_priors : whether the solution's information counts priors beside the matches
    """
    pose = solution.map_T_lidar
    rows = solution.rows or match_rows(solution.matches, kernel_width, kernel)
    residuals, jacobian = rows.residuals(pose)
    if solution.unseen is not None:
        assert solution.beacons is not None
        told = jacobian @ (np.eye(6) - solution.unseen)
        jacobian = np.where(solution.beacons[:, None], jacobian, told)
    points = transform(pose.matrix(), rows.points)
    scores = jacobian * residuals[:, None]
    by_ground, new = seen.cells(points)
    fresh = _sums(scores, by_ground, len(new))[new]
    _, by_cell = np.unique(voxel_keys(points, config.match_cell), return_inverse=True)
    cells = by_cell.max(initial=-1) + 1
    scatter = _sums(scores, by_cell, cells)
    information: FloatArray = jacobian.T @ jacobian
    variance = float(residuals @ residuals) / max(len(residuals) - 6, 1)
    variance = max(variance, _LEAST_VARIANCE)
    meat: FloatArray = cells * scatter.T @ scatter + _PRIOR_CELLS * variance * information
    meat = meat / (cells + _PRIOR_CELLS)
    renewed: FloatArray = fresh.T @ fresh
    inflation = float(np.trace(_solve(information, meat))) / 6.0
    effective = len(residuals) * variance / inflation if inflation > 0.0 else 0.0

    priors = user = np.zeros((6, 6))
    total = information
    if with_priors:
        total = solution.information
        priors = user = _positive(total - information)
    try:
        bread: FloatArray = np.linalg.inv(total).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        return None
    if solution.weak is not None:
        # Along weak directions the prior is the expected motion, which starts at the last pose.
        renewed = renewed + solution.weak.T @ priors @ solution.weak
        keep = np.eye(6) - solution.weak
        user = keep.T @ user @ keep
    return ScanError(
        covariance=symmetric(bread @ (meat + priors) @ bread),
        renewed=symmetric(bread @ renewed @ bread),
        user=bread @ user,
        residual_variance=variance,
        effective_matches=effective,
    )


def _sums(rows: FloatArray, numbers: IntArray, count: int) -> FloatArray:
    """(count, C) sums of the rows (N, C) that have the same number."""
    columns = [np.bincount(numbers, column, minlength=count) for column in rows.T]
    return np.stack(columns, axis=1)


def _solve(information: FloatArray, right: FloatArray) -> FloatArray:
    """Least squares: the matches alone may leave a direction free."""
    return np.linalg.lstsq(information, right, rcond=None)[0].astype(np.float64, copy=False)


def _positive(matrix: FloatArray) -> FloatArray:
    """The nearest positive semi-definite matrix; what is left of rounding becomes zero."""
    eigenvalues, vectors = np.linalg.eigh(symmetric(matrix))
    nearest: FloatArray = ((vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T).astype(np.float64)
    return nearest
