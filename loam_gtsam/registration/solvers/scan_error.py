"""The error of one solved scan, from its residuals: docs/maths/covariance.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from loam_gtsam.config import CovarianceConfig
from loam_gtsam.geometry import nearest_positive, symmetric, transform, voxel_keys
from loam_gtsam.registration.solvers.base import SCAN_VARIANCE, Solution, linearized
from loam_gtsam.registration.solvers.gtsam_solver import match_rows
from loam_gtsam.types import BoolArray, FloatArray, IntArray
from loam_gtsam.voxels.key_table import KeyTable

_PRIOR_CELLS = 6.0
"""Weight, in cells, of the scatter of all residuals beside that of the cells: with fewer than six
cells the scores alone do not span the six directions."""
_LEAST_VARIANCE = 1e-6  # of whitened residuals: no covariance vanishes on data without noise
_LEAST_POSE = 1e-30  # (1e-15 rad or m)^2: no pose is known as well
_LEAST_SHARE = 1e-4  # of a pose, or of the ground: less is not told from none
_BESIDE_IMU = 0.5
"""Share of ``covariance.drift`` that is left beside an accelerometer, which measures the motion
within the sweep: nothing of it goes into the map."""
_REMEMBERED = 500_000  # cells of one generation of :class:`SeenGround`: 4 MB
_NO_KEYS: IntArray = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class ScanError:
    """The error of one solved frame, from its matches; all about the middle of the sweep.

    Attributes
    ----------
    covariance : (6, 6) of the pose if the map were exact
    renewed : (6, 6) part of ``covariance`` that stems from ground matched for the first time
    user : (6, 6) share of the pose that factors beside the scan decide
    expected : (6, 6) share of the pose that the expected motion decides
    raw : (6, 6) raw covariance of what scan and other factors decide
    information : (6, 6) of the scan alone, for other factors; none along degenerate directions
    step : (6,) from the solved pose to the optimum of the scan alone
    residual_variance, effective_matches : see :class:`loam_gtsam.types.Uncertainty`
    """

    covariance: FloatArray
    renewed: FloatArray
    user: FloatArray
    expected: FloatArray
    raw: FloatArray
    information: FloatArray
    step: FloatArray
    residual_variance: float
    effective_matches: float

    def seen(self, weak: FloatArray | None) -> FloatArray:
        """(6, 6) the part of ``covariance`` across the degenerate directions, a projector."""
        keep = np.eye(6) if weak is None else np.eye(6) - weak
        return symmetric(_through(keep, self.covariance))

    def drift(self, factor: float, fused: FloatArray | None) -> FloatArray:
        """(6, 6) what new ground adds to the map's error: docs/maths/covariance.md, (6), (10).

        ``factor`` is ``covariance.drift`` for a scan alone; ``fused`` (6, 6) is the covariance of
        the pose by scan and IMU together, None without one. Beside an IMU the ground pulls the pose
        by the gain of the scan, again in every frame while it is in sight, and takes over what the
        IMU is off.
        """
        if fused is None or factor == 0.0:  # no ground is new in a map that stays as it is
            return factor * self.renewed
        variances, turn = np.linalg.eigh(fused)
        roots = np.sqrt(np.maximum(variances, _LEAST_POSE))
        gains, axes = np.linalg.eigh(_through((turn * roots).T, self.information))
        gains = np.clip(gains, _LEAST_SHARE, 1.0)
        share = np.linalg.lstsq(self.covariance, self.renewed, rcond=None)[0]
        frames = 1.0 / np.clip(np.trace(share) / 6.0, _LEAST_SHARE, 1.0)
        left = 1.0 - gains
        pulls = 1.0 - left * (1.0 - left**frames) / (frames * gains)
        out, back = turn * roots @ axes, axes.T @ (turn / roots).T
        pulled = _through(out * pulls @ back, self.renewed)
        taken_over = _through(out * left @ back, self.renewed @ share)
        return symmetric(_BESIDE_IMU * factor * pulled + taken_over)

    def with_factors(
        self, map_T_lidar: gtsam.Pose3, factors: Sequence[gtsam.NonlinearFactor]
    ) -> tuple[FloatArray, FloatArray]:
        """What scan and further factors, each by its true share, say of the pose.

        ``map_T_lidar`` is the pose that was solved with these factors on
        :data:`~loam_gtsam.registration.solvers.POSE_KEY`.

        Returns
        -------
        information, step : (6, 6) at that pose, and (6,) from there to the optimum; no step where
            nothing tells. It may be far, as along what a tilt and a height tell of the way: all
            this is linear near the pose only, which is therefore not moved there.
        """
        if not factors:
            return self.information, np.zeros(6)
        theirs, pull = linearized(factors, map_T_lidar)
        information: FloatArray = self.information + theirs
        step = np.linalg.lstsq(information, self.information @ self.step + pull, rcond=None)[0]
        return information, step.astype(np.float64, copy=False)


class SeenGround:
    """Cells of the map that have been matched; cells not matched for long are forgotten.

    Parameters
    ----------
    size : edge length of a cell, metres
    remembered : cells of a generation. When the younger generation is full, it becomes the older
        one, and the older one is forgotten.
    """

    def __init__(self, size: float, remembered: int = _REMEMBERED) -> None:
        self._size = size
        self._remembered = remembered
        self._younger, self._older = KeyTable(_NO_KEYS), KeyTable(_NO_KEYS)

    def cells(self, points_map: FloatArray) -> tuple[IntArray, BoolArray]:
        """Cell numbers (N,) of points (N, 3), metres, and which of C cells are new; adds them."""
        keys, numbers = np.unique(voxel_keys(points_map, self._size), return_inverse=True)
        added = self._younger.add(keys)
        new = np.zeros(len(keys), np.bool_)
        new[added] = ~self._older.holds(keys[added])
        if len(self._younger) > self._remembered:
            self._younger, self._older = KeyTable(_NO_KEYS), self._younger
        return numbers, new


def scan_error(
    solution: Solution, kernel_width: float, seen: SeenGround, config: CovarianceConfig,
    *, kernel: str = "huber", with_priors: bool = True,
) -> ScanError | None:  # fmt: skip
    """The error of one solved frame from its residuals; None if its information is singular.

    The sandwich ``B S B`` of robust statistics, with B the inverse information and S the scatter of
    the scores ``J^T r``, summed over cells of the map before they are squared: matches in one cell
    share map points, and their errors (Liang and Zeger, Biometrika 73, 1986; White, Econometrica
    48, 1980).

    Parameters
    ----------
    solution : of the solver
    kernel_width, kernel : of the solver, for the weights of the matches if the solution has no rows
    seen : ground matched so far; the cells of this frame are added
    config : ``match_cell`` is used
    with_priors : whether ``solution.information`` counts priors beside the matches
    """
    pose = solution.map_T_lidar
    rows = solution.rows or match_rows(solution.matches, kernel_width, kernel)
    residuals, jacobian = rows.residuals(pose)
    keep = np.eye(6) if solution.weak is None else np.eye(6) - solution.weak
    if solution.unseen is not None:
        assert solution.beacons is not None
        without = jacobian @ (np.eye(6) - solution.unseen)
        jacobian = np.where(solution.beacons[:, None], jacobian @ keep, without)
    points = transform(pose.matrix(), rows.points)
    scores = jacobian * residuals[:, None]
    by_ground, new = seen.cells(points)
    fresh = _sums(scores, by_ground, len(new))[new]
    _, by_cell = np.unique(voxel_keys(points, config.match_cell), return_inverse=True)
    cells = int(by_cell.max(initial=-1)) + 1
    scatter = _sums(scores, by_cell, cells)
    information: FloatArray = jacobian.T @ jacobian
    variance = max(float(residuals @ residuals) / max(len(residuals) - 6, 1), _LEAST_VARIANCE)
    meat: FloatArray = cells * scatter.T @ scatter + _PRIOR_CELLS * variance * information
    meat = meat / (cells + _PRIOR_CELLS)
    renewed: FloatArray = fresh.T @ fresh
    # Least squares, because the matches alone may leave a direction free.
    inflation = float(np.trace(np.linalg.lstsq(information, meat, rcond=None)[0])) / 6.0
    effective = len(residuals) * variance / inflation if inflation > 0.0 else 0.0

    expected = solution.expected
    total = solution.information if with_priors else information
    if expected is not None and not with_priors:
        total = total + expected
    priors = nearest_positive(total - information)
    if expected is None:  # of a solver that does not say: all priors along weak directions
        weak = np.eye(6) - keep
        expected = weak.T @ priors @ weak
    if np.linalg.matrix_rank(total, hermitian=True) < len(total):
        return None
    bread: FloatArray = np.linalg.inv(total).astype(np.float64, copy=False)
    user = keep.T @ priors @ keep
    parts = meat + priors, renewed, total - expected
    covariance, renewed, raw = (symmetric(bread @ part @ bread) for part in parts)
    shares = bread @ user, bread @ expected
    alone = information / SCAN_VARIANCE
    if solution.weak is None:
        scatter = meat + config.drift * fresh.T @ fresh  # new ground has errors of its own
        alone = information @ np.linalg.lstsq(scatter, information, rcond=None)[0]
    step = np.linalg.lstsq(information, -jacobian.T @ residuals, rcond=None)[0]
    found = covariance, renewed, *shares, raw, symmetric(alone), step.astype(np.float64)
    return ScanError(*found, variance, effective)


def _through(matrix: FloatArray, covariance: FloatArray) -> FloatArray:
    return matrix @ covariance @ matrix.T


def _sums(rows: FloatArray, numbers: IntArray, count: int) -> FloatArray:
    """(count, C) sums of the rows (N, C) that have the same number."""
    columns = [np.bincount(numbers, column, minlength=count) for column in rows.T]
    return np.stack(columns, axis=1)
