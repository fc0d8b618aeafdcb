"""The default solver: a factor graph of one frame, solved by GTSAM's Levenberg-Marquardt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import get_args

import gtsam
import numpy as np

from loam_gtsam.config import SolverConfig
from loam_gtsam.errors import InputError, check_kind, is_number
from loam_gtsam.factors import (
    MatchRows,
    checked_factor,
    concatenate_rows,
    line_rows,
    plane_rows,
    scan_match_factor,
)
from loam_gtsam.geometry import MAD_TO_SIGMA
from loam_gtsam.registration.degeneracy import (
    Directions,
    Localizability,
    by_lines,
    line_sight,
    localizability,
    unseen_by_planes,
)
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.solvers.base import (
    POSE_KEY,
    SCAN_VARIANCE,
    Associate,
    Matcher,
    MotionPrior,
    Solution,
    check_settings,
    rematch,
)
from loam_gtsam.types import BoolArray, FloatArray

_KERNELS: tuple[str, ...] = get_args(SolverConfig.model_fields["kernel"].annotation)
_REDESCENDING = 2.816
"""Width of a Geman-McClure kernel over the width of a Huber kernel with the same efficiency on
normal noise: 3.787 and 1.345 at 95 %."""

_FUSE = gtsam.LevenbergMarquardtParams()
_FUSE.setVerbosityLM("SILENT")
_FUSE.setlambdaInitial(1e-12)  # a single pose near its optimum: plain Gauss-Newton steps
_FUSE.setRelativeErrorTol(1e-14)
_FUSE.setAbsoluteErrorTol(0.0)

_FEW = 3.0  # times ``min_aligned`` below which a direction is tried before it is believed
_PUSH = 0.2  # metres (root mean square of the points) by which the pose is displaced for that
_COMES_BACK = 0.25
"""Least share of the displacement that one more association must undo. It is the share of true
information: below, that of noise is three times as much."""
_SURE = 3.0  # standard deviations beyond which a doubted direction contradicts the IMU
_CERTAIN = 1e10  # information that outweighs every other factor: 0.01 mrad and 0.01 mm


class GtsamSolver:
    """Levenberg-Marquardt on a factor graph, which is made anew with every association.

    Each association makes one scan-match factor whose weights are fixed (iteratively re-weighted
    least squares). Priors are ordinary factors beside that factor.
    """

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
        """See :meth:`ScanSolver.solve`."""
        expected = motion
        if motion is not None and self.config.degeneracy == "project":
            expected = replace(motion, information=_CERTAIN * np.eye(6))
        sight: _Sight | None = None

        def optimise(matches: ScanMatches, pose: gtsam.Pose3) -> Solution:
            nonlocal sight
            if sight is None:  # the first matches decide which directions are degenerate
                sight = _Sight() if motion is None else _sight_of(matches, pose, self.config)
            return self._optimise(matches, pose, sight, expected, priors)

        found = rematch(associate, guess, self.config, optimise)
        if sight is None or not found.solved or self.config.degeneracy == "off":
            return found
        least, lost = self.config.min_aligned, np.zeros(0, np.bool_)
        doubted = sight.doubted(found, least)
        if doubted is not None:
            lost = _contradicted(found, doubted, motion)
            if lost.any():
                sight = sight.without(lost, least)
                return rematch(associate, guess, self.config, optimise)
            lost = self._returns(associate, found, doubted, sight, expected) < _COMES_BACK
        if not lost.any() and found.weak is None:
            return found
        hidden, first = sight.hidden(self.config), sight
        if hidden is not None:
            sight = replace(sight, weak=None, unseen=None)
            whole = rematch(associate, guess, self.config, optimise)
            if whole.solved and not _contradicted(whole, hidden, motion).any():
                returned = self._returns(associate, whole, hidden, sight, expected)
                if (returned >= _COMES_BACK).all():
                    return whole
        return first.without(lost, least).told_of(found, expected) if lost.any() else found

    def _returns(
        self,
        associate: Associate,
        found: Solution,
        doubted: Directions,
        sight: _Sight,
        expected: MotionPrior | None,
    ) -> FloatArray:
        """(W,) share of a displacement along each direction that one more association undoes."""
        away = found.map_T_lidar.retract(_PUSH * doubted.vectors.sum(axis=0))
        if isinstance(associate, Matcher):
            associate = associate.deskewed(found.map_T_lidar, found.matches)
        matches = associate(away)
        if len(matches) < self.config.min_matches:
            return np.zeros(len(doubted))
        back = self._optimise(matches, away, sight, expected, ()).map_T_lidar
        returned: FloatArray = doubted.shares @ away.localCoordinates(back) / -_PUSH
        return returned

    def _optimise(
        self,
        matches: ScanMatches,
        pose: gtsam.Pose3,
        sight: _Sight,
        expected: MotionPrior | None,
        priors: Sequence[gtsam.NonlinearFactor],
    ) -> Solution:
        """The optimum of fixed matches, of priors, and of the expected motion where needed."""
        config = self.config
        values = gtsam.Values()
        values.insert(POSE_KEY, pose)
        graph = gtsam.NonlinearFactorGraph()
        rows = match_rows(matches, config.kernel_width, config.kernel)
        weak, unseen = sight.weak, sight.weak
        beacons = np.zeros(len(rows.points), np.bool_)
        if sight.unseen is not None:
            unseen = sight.unseen
            weak = by_lines(matches, pose, unseen, config.min_aligned)[0]
            seen = line_sight(matches.edges, pose, unseen.vectors)
            beacons[: 2 * len(seen)] = np.repeat(seen.any(axis=1), 2)
        blind, without = (None if part is None else part.projector for part in (weak, unseen))
        for mask, left_out in ((beacons, blind), (~beacons, without)):
            if mask.any():
                graph.add(_scan_factor(rows, values, mask, left_out))
        added = None
        if blind is not None and expected is not None:
            along = expected.along(blind)
            graph.add(along.factor())
            added = along.information
        for factor in priors:
            graph.add(factor)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(self.config.inner_iterations)
        params.setVerbosityLM("SILENT")
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
        before = optimizer.error()
        moved = optimizer.optimize().atPose3(POSE_KEY)
        after, steps = optimizer.error(), optimizer.iterations()
        information = graph.linearize(optimizer.values()).hessian()[0]
        small = within_tolerance(pose.localCoordinates(moved), information, config)
        return Solution(
            moved, True, small, matches, 1, steps, before, after, information,
            sight.scan, blind, without, beacons, rows, added,
        )  # fmt: skip


def _contradicted(found: Solution, doubted: Directions, expected: MotionPrior | None) -> BoolArray:
    """(W,) directions along which the pose is not where the IMU, by its covariance, allows it."""
    if expected is None or not expected.measured:
        return np.zeros(len(doubted), np.bool_)
    away = doubted.shares @ expected.map_T_lidar.localCoordinates(found.map_T_lidar)
    of_both = np.linalg.inv(expected.information) + SCAN_VARIANCE * np.linalg.inv(found.information)
    variances = np.einsum("ki,ij,kj->k", doubted.shares, of_both, doubted.shares)
    contradicted: BoolArray = away**2 > _SURE**2 * variances
    return contradicted


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """What the first matches of a frame see: all of them, and the planes alone."""

    scan: Localizability | None = None
    weak: Directions | None = None  # the degenerate directions
    unseen: Directions | None = None  # left to lines; None where planes fix all that is fixed

    def doubted(self, found: Solution, least: float) -> Directions | None:
        """The directions that few matches fix, without the weak ones; None if there are none."""
        if self.scan is None:
            return None
        if self.unseen is None:
            return self.scan.between(least, _FEW * least)
        return by_lines(found.matches, found.map_T_lidar, self.unseen, least)[1]

    def hidden(self, config: SolverConfig) -> Directions | None:
        """Directions that are weak, or left to lines, which all matches together may fix.

        No match sees them better than noise would, and all together know more than noise makes.
        """
        blind = self.weak or self.unseen
        if config.degeneracy != "prior" or blind is None or blind.over_noise is None:
            return None
        together = (blind.over_noise * (1.0 - _COMES_BACK) >= 1.0).all()
        return self.unseen or self.weak if together else None

    def without(self, lost: BoolArray, least: float) -> _Sight:
        """Such that the lost ones of the doubted directions are weak."""
        if self.unseen is not None:
            return replace(self, weak=self.unseen, unseen=None)
        assert self.scan is not None
        few = np.flatnonzero((self.scan.aligned >= least) & (self.scan.aligned < _FEW * least))
        aligned = self.scan.aligned.copy()
        aligned[few[lost]] = 0.0
        scan = replace(self.scan, aligned=aligned)
        return replace(self, scan=scan, weak=scan.between(-1.0, least))

    def told_of(self, found: Solution, expected: MotionPrior | None) -> Solution:
        """The solution with its pose, and the information of these weak directions."""
        if self.weak is None or expected is None:
            return found
        weak = self.weak.projector
        seen, added = replace(found, weak=weak).scan_information, expected.along(weak).information
        beacons = None if found.beacons is None else np.zeros_like(found.beacons)
        return replace(
            found, localizability=self.scan, weak=weak, unseen=weak, beacons=beacons,
            information=seen + added, expected=added,
        )  # fmt: skip


def _sight_of(matches: ScanMatches, pose: gtsam.Pose3, config: SolverConfig) -> _Sight:
    scan = localizability(matches, pose)
    weak = unseen = None
    if config.degeneracy != "off":
        weak = scan.between(-1.0, config.min_aligned)
    if config.degeneracy == "prior":
        unseen = unseen_by_planes(matches, pose, scan, config.min_aligned)
    return _Sight(scan, weak, unseen)


def _scan_factor(
    rows: MatchRows, values: gtsam.Values, mask: BoolArray, blind: FloatArray | None
) -> gtsam.NonlinearFactor:
    """The factor of some rows of a scan, linearised without its information on some directions."""
    scan = scan_match_factor(POSE_KEY, rows if mask.all() else rows.where(mask))
    if blind is None:
        return scan
    linear = scan.linearize(values)
    information, column = linear.information(), linear.augmentedInformation()[:, -1]
    right, squared = column[:-1], float(column[-1])
    keep = np.eye(6) - blind
    hessian = gtsam.HessianFactor(POSE_KEY, keep.T @ information @ keep, keep.T @ right, squared)
    return gtsam.LinearContainerFactor(hessian, values)


def fuse(
    map_T_lidar: gtsam.Pose3, information: FloatArray, factors: Sequence[gtsam.NonlinearFactor]
) -> tuple[gtsam.Pose3, FloatArray]:
    """Fuse a solved pose and its (6, 6) information with further factors on :data:`POSE_KEY`.

    Returns the optimum of all, and its (6, 6) information.
    """
    # No Cholesky root: the information may be singular.
    eigenvalues, vectors = np.linalg.eigh(information)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * vectors.T

    def solved(at: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        # PriorFactorPose3 would leave out the derivative of the logarithm.
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
    """Whether a step is small enough to stop: by LOAM's rule, or against the standard deviation.

    In a direction that the scan hardly fixes, every association moves the pose back and forth by
    more than LOAM's half millimetre, and the iteration would never stop. Such steps are far below
    the standard deviation in that direction.

    ``step`` is a (6,) tangent, rad and m, and ``information`` the pose's (6, 6).
    """
    rotation = np.degrees(np.linalg.norm(step[:3]))
    translation = np.linalg.norm(step[3:])
    small = rotation < config.rotation_tolerance_deg and translation < config.translation_tolerance
    return bool(small or step @ information @ step < config.step_sigmas**2)


def _kept(units: FloatArray, width: float, kernel: str) -> FloatArray:
    """Factors by which a kernel scales rows, from the whitened distances of the rows."""
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
    kernel_width : width of the Huber kernel, in units of the scatter of the whitened distances;
        infinite for no kernel
    kernel : "huber", or "geman_mcclure" with the same efficiency on normal noise

    Notes
    -----
    The kernel is applied as iteratively re-weighted least squares: a row whose whitened distance u
    exceeds ``k s`` is scaled by ``sqrt(k s / u)`` (Huber, Robust Statistics, 1981). The unit s is
    ``max(1, 1.4826 median(u))``: far from the optimum all distances are large, and a fixed unit
    would scale all rows down. The Cauchy kernel loses the pose in foliage, where many matches
    agree on a wrong pose. The kernel of Geman and McClure (1985), ``1 / (1 + (u / c s)^2)``, does
    not, and rejects passing objects better than the Huber kernel.

    Raises
    ------
    InputError
        If the matches are none, the width no number, or the kernel unknown.
    """
    check_kind(matches, ScanMatches, "matches", "associate makes them")
    if not (is_number(kernel_width) and kernel_width > 0.0):
        raise InputError(f"kernel_width: expected a number above 0, got {kernel_width!r}")
    if not isinstance(kernel, str) or kernel not in _KERNELS:
        raise InputError(f"kernel: expected {' or '.join(_KERNELS)}, got {kernel!r}")
    return _rows(matches, kernel_width, kernel)


@lru_cache(maxsize=1)  # asked for by the solver, then for the motion within the sweep
def _rows(matches: ScanMatches, kernel_width: float, kernel: str) -> MatchRows:
    e, p = matches.edges, matches.planes
    edge_units, plane_units = e.distances / e.sigmas, np.abs(p.distances) / p.sigmas
    edge_weights, plane_weights = e.weights, p.weights
    if len(matches) and np.isfinite(kernel_width):
        units, half = np.concatenate([edge_units, plane_units]), len(matches) // 2
        scatter = MAD_TO_SIGMA * float(np.partition(units, half)[half])
        width = kernel_width * max(1.0, scatter)
        edge_weights = edge_weights * _kept(edge_units, width, kernel)
        plane_weights = plane_weights * _kept(plane_units, width, kernel)
    edges = line_rows(e.points, e.centres, e.directions, edge_weights, e.sigmas)
    planes = plane_rows(p.points, p.normals, p.offsets, plane_weights, p.sigmas)
    return concatenate_rows([edges, planes])
