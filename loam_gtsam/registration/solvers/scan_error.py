"""The error of one solved scan, from its residuals: docs/maths/covariance.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.config import CovarianceConfig
from loam_gtsam.factors import MatchRows
from loam_gtsam.geometry import nearest_positive, symmetric, transform, voxel_keys
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.solvers.base import SCAN_VARIANCE, MotionPrior, Solution, linearized
from loam_gtsam.registration.solvers.gtsam_solver import match_rows
from loam_gtsam.registration.solvers.seen_ground import SeenGround, facings
from loam_gtsam.registration.solvers.sweep_velocity import ToldVelocity
from loam_gtsam.types import FloatArray, IntArray

_TOLD = 6.0
"""Residuals as large as their standard deviations say that count beside those of the lines, and of
the planes: the few that decide a pose may agree by chance."""
_STAYS = 4.0
"""Times the drift by which new ground counts beside an IMU: what a scan is off by it stays in the
map. Chosen by the table of worlds: docs/consistency.md."""
_LEAST_POSE = 1e-30  # (1e-15 rad or m)^2: no pose is known as well
_LEAST_SHARE = 1e-4  # of a pose, or of the ground: less is not told from none


class GyroNoise(NamedTuple):
    """By which the attitude walks within a sweep, from its middle on, forth and back.

    Attributes
    ----------
    density : rad/s/sqrt(Hz)
    reference : seconds from the middle of the sweep to its reference time
    """

    density: float
    reference: float

    def scatter(self, jacobian: FloatArray, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What it makes of the scores of rows (R, 6) that are seen ``seconds`` after the middle.

        Returns
        -------
        scatter, at_reference : (6, 6), and (6, 3) with the turn until the reference time
        """
        scatter, ahead = np.zeros((6, 6)), np.abs(seconds)
        for times in (seconds, -seconds):  # each turn has turned all rows farther from the middle
            last_first = np.argsort(-times, kind="stable")[: np.count_nonzero(times > 0.0)]
            rows, times = jacobian[last_first], times[last_first]
            turned = np.cumsum(rows[:, :, None] * rows[:, None, :3], axis=0)
            turned *= np.sqrt(-np.diff(times, append=0.0))[:, None, None]
            by_axis = turned.transpose(1, 0, 2).reshape(6, -1)
            scatter += by_axis @ by_axis.T
        common = np.minimum(ahead, abs(self.reference)) * (seconds * self.reference > 0.0)
        at_reference = jacobian.T * common @ jacobian[:, :3]
        return self.density**2 * scatter, self.density**2 * at_reference


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
    by_velocity, by_acceleration, by_jerk : (6, 6) s, s^2 and s^3, by which a velocity, an
        acceleration and its change in the middle of the sweep that its points were not de-skewed
        for move the pose
    told : what the matches have told of that velocity; None if they had no say in it
    by_offset : (6,) how far each metre that all ranges are too long, of this scan and of those
        before, moves the pose, rad and m per metre
    offset : metres that they are too long, by the residuals of this scan
    offset_information : of that number, 1 / m^2, as far as it is none of scans before
    by_turns : (6, 3) covariance of the pose with the rotation from the middle of the sweep to its
        reference, as far as both stem from the noise of a gyro
    since_last : (6, 6) part of ``covariance`` that stems from factors since the last pose, along
        degenerate directions: the poses to come have it, too
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
    by_velocity: FloatArray = field(default_factory=partial(np.zeros, (6, 6)))
    by_acceleration: FloatArray = field(default_factory=partial(np.zeros, (6, 6)))
    by_jerk: FloatArray = field(default_factory=partial(np.zeros, (6, 6)))
    told: ToldVelocity | None = None
    by_offset: FloatArray = field(default_factory=partial(np.zeros, 6))
    offset: float = 0.0
    offset_information: float = 0.0
    by_turns: FloatArray = field(default_factory=partial(np.zeros, (6, 3)))
    since_last: FloatArray = field(default_factory=partial(np.zeros, (6, 6)))

    def seen(self, weak: FloatArray | None) -> FloatArray:
        """(6, 6) the part of ``covariance`` across the degenerate directions, a projector."""
        keep = np.eye(6) if weak is None else np.eye(6) - weak
        return symmetric(_through(keep, self.covariance))

    def drift(self, factor: float, fused: FloatArray | None) -> FloatArray:
        """(6, 6) what new ground adds to the map's error: docs/maths/covariance.md, (6), (13).

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
        new = np.clip(np.trace(share) / 6.0, 0.0, 1.0)
        lasts = 2.0 * new + gains * (1.0 - new)
        pulls, strays = (1.0 + new) * gains / lasts, 2.0 * new / lasts
        out, back = turn * roots @ axes, axes.T @ (turn / roots).T
        pulled = _through(out * pulls @ back, self.renewed)
        strayed = out * (gains * (1.0 - gains) * strays**2) @ out.T
        return symmetric(factor * pulled + strayed)

    def with_factors(
        self, map_T_lidar: gtsam.Pose3, factors: Sequence[gtsam.NonlinearFactor],
        *, alone: bool = True,
    ) -> tuple[FloatArray, FloatArray]:  # fmt: skip
        """What scan and further factors, each by its true share, say of the pose.

        ``map_T_lidar`` is the pose that was solved with these factors on
        :data:`~loam_gtsam.registration.solvers.POSE_KEY`, and, if not ``alone``, with others.

        Returns
        -------
        information, step : (6, 6) at that pose, and (6,) from there to the optimum; no step where
            nothing tells. It may be far, as along what a tilt and a height tell of the way: all
            this is linear near the pose only, which is therefore not moved there.
        """
        if not factors:
            return self.information, np.zeros(6) if alone else self.step
        theirs, pull = linearized(factors, map_T_lidar)
        information: FloatArray = self.information + theirs
        step = np.linalg.lstsq(information, self.information @ self.step + pull, rcond=None)[0]
        return information, step.astype(np.float64, copy=False)


def scan_error(
    solution: Solution, kernel_width: float, seen: SeenGround, config: CovarianceConfig,
    *, kernel: str = "huber", with_priors: bool = True, seconds: FloatArray | None = None,
    between: MotionPrior | None = None, gyro: GyroNoise | None = None,
) -> ScanError | None:  # fmt: skip
    """The error of one solved frame from its residuals; None if its information is singular.

    The sandwich ``B S B`` of robust statistics, with B the inverse information and S the scatter of
    the scores ``J^T r``, summed over cells of the map before they are squared: matches in one cell
    share map points, and their errors (Liang and Zeger, Biometrika 73, 1986; White, Econometrica
    48, 1980). What the fit has taken from the scores of a cell is added again.

    Parameters
    ----------
    solution : of the solver
    kernel_width, kernel : of the solver, for the weights of the matches if the solution has no rows
    seen : ground matched so far; this frame is added
    config : its cells and ``drift`` are used
    with_priors : whether ``solution.information`` counts priors beside the matches
    seconds : (R,) from the middle of the sweep to the points of the rows, two an edge and one a
        plane; None if all are of one time
    between : what factors between the last pose and this one tell, which the solution counts among
        its priors; None without any
    gyro : of what has turned the points within the sweep; None if no gyro has
    """
    pose, lines = solution.map_T_lidar, 2 * len(solution.matches.edges)
    rows = solution.rows or match_rows(solution.matches, kernel_width, kernel)
    keep = np.eye(6) if solution.weak is None else np.eye(6) - solution.weak
    residuals, jacobian = _as_solved(solution, rows, keep)
    points = transform(pose.matrix(), rows.points)
    information: FloatArray = jacobian.T @ jacobian
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
    by_ground, since = seen.cells(points, facings(rows.normals, lines), config.ground_cell)
    new = since == seen.scans
    bread: FloatArray = np.linalg.inv(total).astype(np.float64, copy=False)

    deviations = np.sqrt(_variances(residuals, jacobian, bread, lines))
    scaled = jacobian * deviations[:, None]
    scores = jacobian * residuals[:, None]
    by_cell = np.unique(voxel_keys(points, config.match_cell), return_inverse=True)[1]
    fresh = np.flatnonzero(new[by_ground])
    meat, renewed, alike = _scores(scores, scaled, priors, by_cell, by_ground, fresh)

    scattered = _variance_and_matches(residuals, information, meat)
    times = np.zeros(len(residuals)) if seconds is None else seconds
    new_share = float(np.trace(bread @ jacobian[fresh].T @ jacobian[fresh])) / 6.0
    by_turns = np.zeros((6, 3))
    if gyro is not None:
        turned, at_reference = gyro.scatter(jacobian, times)
        # None of it is an error of the map's points: (6) with f = 0.
        meat, renewed = meat + turned, renewed + (2.0 * new_share / (1.0 + new_share)) ** 2 * turned
        by_turns = -bread @ at_reference
    for_others = information / SCAN_VARIANCE
    if solution.weak is None:
        whole = meat + _STAYS * config.drift * renewed
        for_others = information @ np.linalg.lstsq(whole, information, rcond=None)[0]
    step = np.linalg.lstsq(information, -jacobian.T @ residuals, rcond=None)[0]
    parts = meat + priors, renewed, total - expected
    covariance, renewed, raw = (symmetric(bread @ part @ bread) for part in parts)
    shares = bread @ keep.T @ (priors - expected) @ keep, bread @ expected
    found = covariance, renewed, *shares, raw, symmetric(for_others), step.astype(np.float64)
    back, last = pose.inverse().AdjointMap(), seen.moved(np.array([seen.scans]))[0]
    follows = np.einsum("ni,ni->n", jacobian @ back, seen.moved(since)[by_ground])
    by_range = _by_range(solution.matches, rows) - follows
    moved, offset, known = _offset(residuals, jacobian, bread, by_range, deviations)
    moved = moved + shares[1] @ back @ last
    seen.add(pose.AdjointMap() @ moved)
    known *= new_share / alike
    return ScanError(
        *found, *scattered, *_by_motion(bread, jacobian, times),
        by_offset=moved, offset=offset, offset_information=known, by_turns=by_turns,
        since_last=_since_last(solution, between),
    )  # fmt: skip


def _by_motion(
    bread: FloatArray, jacobian: FloatArray, seconds: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``by_velocity``, ``by_acceleration`` and ``by_jerk`` of a :class:`ScanError`."""

    def by(moved: FloatArray) -> FloatArray:
        drawn: FloatArray = bread @ (jacobian.T * moved @ jacobian)
        return drawn

    return by(seconds), by(seconds**2 / 2.0), by(seconds**3 / 6.0)


def _since_last(solution: Solution, between: MotionPrior | None) -> FloatArray:
    """``since_last`` of a :class:`ScanError`; elsewhere the scan draws the pose back to the map."""
    if between is None or solution.weak is None:
        return np.zeros((6, 6))
    along = solution.weak @ np.linalg.inv(solution.information)
    return symmetric(_through(along, between.information))


def _as_solved(
    solution: Solution, rows: MatchRows, keep: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (R,) and Jacobian (R, 6) of the rows as far as they counted in the solve."""
    residuals, jacobian = rows.residuals(solution.map_T_lidar)
    if solution.unseen is not None:
        assert solution.beacons is not None
        without = jacobian @ (np.eye(6) - solution.unseen)
        jacobian = np.where(solution.beacons[:, None], jacobian @ keep, without)
    return residuals, jacobian


def _variance_and_matches(
    residuals: FloatArray, information: FloatArray, meat: FloatArray
) -> tuple[float, float]:
    """``residual_variance`` and ``effective_matches``."""
    variance = float(residuals @ residuals) / max(len(residuals) - 6, 1)
    # Least squares, because the matches alone may leave a direction free.
    inflation = float(np.trace(np.linalg.lstsq(information, meat, rcond=None)[0])) / 6.0
    return variance, len(residuals) * variance / inflation if inflation > 0.0 else 0.0


def _by_range(matches: ScanMatches, rows: MatchRows) -> FloatArray:
    """(R,) whitened, by which residuals change with each metre that all ranges are too long."""
    by_range, planes = np.zeros(len(rows.scales)), matches.planes
    if planes.by_range is not None:
        first = 2 * len(matches.edges)  # corners show from all sides
        by_range[first:] = rows.scales[first:] * planes.by_range
    return by_range


def _offset(
    residuals: FloatArray, jacobian: FloatArray, bread: FloatArray,
    by_range: FloatArray, deviations: FloatArray,
) -> tuple[FloatArray, float, float]:  # fmt: skip
    """The offset of all ranges that explains most of the residuals.

    Returns
    -------
    moved : (6,) how far each metre of it moves the pose
    offset, information : metres, and 1 / m^2 if residuals (R,) are independent and have these
        ``deviations`` (R,)
    """
    moved: FloatArray = -bread @ (jacobian.T @ by_range)
    left = by_range + jacobian @ moved
    squares, scatter = float(left @ left), float(np.sum((left * deviations) ** 2))
    if not scatter > 0.0:
        return moved, 0.0, 0.0
    return moved, float(left @ residuals) / squares, squares**2 / scatter


def _variances(
    residuals: FloatArray, jacobian: FloatArray, bread: FloatArray, lines: int
) -> FloatArray:
    """(R,) variances of whitened residuals: one for the rows of edges, the first, one for planes.

    Told standard deviations of edges are too large by another factor than those of planes are.
    """
    free = 1.0 - np.einsum("ni,ni->n", jacobian @ bread, jacobian)  # what the fit has left of each
    variances = np.empty(len(residuals))
    for kind in (slice(lines), slice(lines, None)):
        squares, left = float(residuals[kind] @ residuals[kind]), max(float(free[kind].sum()), 0.0)
        variances[kind] = (squares + _TOLD) / (left + _TOLD)
    return variances


def _scores(
    scores: FloatArray, scaled: FloatArray, priors: FloatArray,
    by_cell: IntArray, by_ground: IntArray, fresh: IntArray,
) -> tuple[FloatArray, FloatArray, float]:  # fmt: skip
    """The scatter of all scores, (6, 6), and that of new ground.

    Parameters
    ----------
    scores, scaled : (N, 6) scores, and rows of the Jacobian times the deviations of the residuals
    priors : (6, 6) information beside the matches
    by_cell, by_ground : (N,) numbers of the cells in which scores are summed, of all and of new
    fresh : (F,) which of the N are of new ground

    Returns
    -------
    meat, renewed : (6, 6)
    alike : how much more the cells scatter than they would with independent residuals
    """
    noise: FloatArray = scaled.T @ scaled
    scale: FloatArray = np.linalg.inv(noise + priors).astype(np.float64, copy=False)
    scatter, fitted = _scatter(scores, scaled, scale, by_cell)
    alone = max(float(np.trace(scale @ (noise - fitted))), 1.0)
    alike = max(float(np.trace(scale @ scatter)) / alone, 1.0)
    meat = scatter + alike * fitted
    scatter, fitted = _scatter(scores[fresh], scaled[fresh], scale, by_ground[fresh])
    return meat, scatter + alike * fitted, alike


def _scatter(
    scores: FloatArray, scaled: FloatArray, scale: FloatArray, cells: IntArray
) -> tuple[FloatArray, FloatArray]:
    """The scatter (6, 6) of the scores of cells, and what the fit has taken from it.

    Parameters
    ----------
    scores, scaled : (N, 6) as in :func:`_scores`
    scale : (6, 6) inverse of the scatter of all scores if residuals are independent
    cells : (N,) numbers
    """
    count = int(cells.max(initial=-1)) + 1
    row, column = np.triu_indices(6)
    axes = np.ascontiguousarray(scaled.T)
    halves = _sums((axes[row] * axes[column]).T, cells, count)
    each = np.empty((count, 6, 6))
    each[:, row, column] = each[:, column, row] = halves
    sums = _sums(scores, cells, count)
    return sums.T @ sums, (each @ scale @ each).sum(axis=0)


def _through(matrix: FloatArray, covariance: FloatArray) -> FloatArray:
    return matrix @ covariance @ matrix.T


def _sums(rows: FloatArray, numbers: IntArray, count: int) -> FloatArray:
    """(count, C) sums of the rows (N, C) that have the same number."""
    columns = [np.bincount(numbers, column, minlength=count) for column in rows.T]
    return np.stack(columns, axis=1)
