"""Planes and lines among the points of many sweeps: an adaptive voxel tree, and robust fits.

A voxel is split until its points on surfaces lie in a plane, and those on edges along a line, or it
is too small. Points in one voxel need not be of one surface: what a door frame or a thin pillar
adds to the plane of a wall would pull all poses that see it. So planes and lines are tested for
structure in their residuals, and points count by the scatter of *their* plane or line and not by
that of all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loam_gtsam.geometry import MAD_TO_SIGMA, voxel_keys
from loam_gtsam.types import BoolArray, FloatArray, InputError, IntArray

_LEAST_POINTS = 12
_FLAT = 16.0
"""Variance along the least extent over that across it: a patch, or a stretch, of four times its
scatter."""
_STRUCTURE = 0.1
"""Share of the scatter across a plane or line that the means of its parts may explain, beyond what
chance makes of it."""
_CHANCE = {1: 6.0, 2: 1.0}
"""Freedoms among the means along a normal that chance fills, by the number of normals: nine parts
of a plane, less the three of the plane; three of a line, less two."""
_THIN = 0.1
"""A scatter counts as at least this share of the point's standard deviation."""
_TO_SIGMA = np.array([MAD_TO_SIGMA, 1.0 / np.sqrt(2.0 * np.log(2.0))])
"""Standard deviation over the median distance, from a plane and from a line (Rayleigh)."""
_KERNEL = 2.0
"""Standard deviations at which the Geman-McClure kernel lets go of a point."""
_FITS = 6
"""Rounds of fit and weights, which settle on the larger of two surfaces in a voxel."""


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """L planes and lines in the map and the points that were found on them.

    Attributes
    ----------
    centres : (L, 3) metres, on the planes and lines
    axes : (L, 3, 3) unit columns: normal, narrow and wide extent of a plane; two normals and the
        direction of a line
    is_line : (L,)
    scatters : (L,) metres, standard deviation of a point along a normal
    rows : (M,) which points are on planes and lines
    labels : (M,) the plane or line of each
    weights : (M,) 0 to 1, of each
    residuals : (M, 2) metres along the first two axes; the second is 0 on planes
    """

    centres: FloatArray
    axes: FloatArray
    is_line: BoolArray
    scatters: FloatArray
    rows: IntArray
    labels: IntArray
    weights: FloatArray
    residuals: FloatArray

    def __len__(self) -> int:
        return len(self.centres)


def voxel_sizes(largest: float, least: float) -> tuple[float, ...]:
    """Edge lengths of the levels of the tree, each half of the one before, metres."""
    if not 0.0 < least <= largest < np.inf:
        raise InputError(f"voxels: expected 0 < least <= largest metres, got {least}, {largest}")
    sizes = [largest]
    while sizes[-1] / 2.0 >= 0.999 * least:
        sizes.append(sizes[-1] / 2.0)
    return tuple(sizes)


def find_landmarks(
    points: FloatArray,
    sweeps: IntArray,
    is_edge: BoolArray,
    sigma: float,
    sizes: tuple[float, ...],
    shift: FloatArray | None = None,
    views: int = 3,
) -> Landmarks:
    """Planes and lines of an adaptive voxel tree.

    Parameters
    ----------
    points : (N, 3) metres in the map
    sweeps : (N,) numbers of the sweeps that saw them
    is_edge : (N,) whether they are on edges: lines are looked for among these, planes among others
    sigma : metres, that a measured point may have across a surface
    sizes : edge lengths of the levels, see :func:`voxel_sizes`
    shift : (3,) metres by which the grid is moved. A surface that a border of the grid cuts along
        its face is pinned to where it is, so each round of an adjustment takes another grid.
    views : sweeps that must see a plane or line at least
    """
    moved = points if shift is None else points + shift
    labels = np.full(len(points), -1, np.int64)
    counts: list[int] = []
    for normals, some in ((1, np.flatnonzero(~is_edge)), (2, np.flatnonzero(is_edge))):
        found, count = _grouped(
            points[some], moved[some], sweeps[some], sigma, sizes, views, normals
        )
        labels[some] = np.where(found >= 0, found + sum(counts), -1)
        counts.append(count)
    rows = np.flatnonzero(labels >= 0)
    return _fitted(points[rows], labels[rows], np.repeat([False, True], counts), sigma, rows)


def _grouped(
    points: FloatArray, moved: FloatArray, sweeps: IntArray, sigma: float,
    sizes: tuple[float, ...], views: int, normals: int,
) -> tuple[IntArray, int]:  # fmt: skip
    """The plane (1 normal) or line (2 normals) of each point or -1, and how many there are."""
    labels = np.full(len(points), -1, np.int64)
    active, found = np.arange(len(points)), 0
    for size in sizes:
        if not len(active):
            break
        _, first, voxel = np.unique(
            voxel_keys(moved[active], size), return_index=True, return_inverse=True
        )
        here, count = points[active], len(first)
        seen = np.unique(voxel * (int(sweeps.max()) + 1) + sweeps[active])
        seen_by = np.bincount(seen // (int(sweeps.max()) + 1), minlength=count)
        fit = principal_axes(here, np.ones(len(here)), voxel, count, here[first])
        enough = (fit.counts >= _LEAST_POINTS) & (seen_by >= views)
        across, along = fit.values[:, normals - 1], fit.values[:, normals]
        good = enough & (along > _FLAT * np.maximum(across, (0.5 * sigma) ** 2))
        good &= across < sigma**2
        by_chance = _CHANCE[normals] / np.maximum(fit.counts, 1.0)
        good &= _structure(here, voxel, fit, sigma, normals) < _STRUCTURE + by_chance
        number = np.where(good, found + np.cumsum(good) - 1, -1)
        found += int(good.sum())
        labels[active] = number[voxel]
        active = active[enough[voxel] & ~good[voxel]]
    return labels, found


def _fitted(
    points: FloatArray, labels: IntArray, is_line: BoolArray, sigma: float, rows: IntArray
) -> Landmarks:
    """Robust fits to points (M, 3) in the map whose planes and lines are known."""
    anchors = np.zeros((len(is_line), 3))
    anchors[labels[::-1]] = points[::-1]
    weights, residuals = np.ones(len(points)), np.zeros((len(points), 2))
    on_line = is_line[labels]
    for _ in range(_FITS):
        fit = principal_axes(points, weights, labels, len(is_line), anchors)
        away = points - fit.means[labels]
        residuals[:, 0] = np.einsum("ni,ni->n", fit.axes[labels, :, 0], away)
        second = fit.axes[labels[on_line], :, 1]
        residuals[on_line, 1] = np.einsum("ni,ni->n", second, away[on_line])
        distances = np.sqrt((residuals**2).sum(axis=1))
        medians = _medians(distances, labels, len(is_line))
        scatters = np.clip(_TO_SIGMA[is_line.astype(np.int64)] * medians, _THIN * sigma, sigma)
        weights = 1.0 / (1.0 + (distances / (_KERNEL * scatters[labels])) ** 2) ** 2
    return Landmarks(fit.means, fit.axes, is_line, scatters, rows, labels, weights, residuals)


def weighted_moments(
    points: FloatArray, weights: FloatArray, groups: IntArray, count: int
) -> FloatArray:
    """Sums of ``w [p, 1] [p, 1]^T`` over the points of each group, (count, 4, 4)."""
    columns = [points[:, 0], points[:, 1], points[:, 2], None]
    sums = np.empty((count, 4, 4))
    for i, one in enumerate(columns):
        weighted = weights if one is None else weights * one
        for j in range(i, 4):
            other = columns[j]
            product = weighted if other is None else weighted * other
            total = np.bincount(groups, product, minlength=count)
            sums[:, i, j] = sums[:, j, i] = total
    return sums


@dataclass(frozen=True, slots=True, eq=False)
class Axes:
    """Principal axes of G groups of points.

    Attributes
    ----------
    counts : (G,) sums of the weights
    means : (G, 3) metres
    values : (G, 3) m^2, variances along the axes, ascending
    axes : (G, 3, 3) unit columns
    """

    counts: FloatArray
    means: FloatArray
    values: FloatArray
    axes: FloatArray


def principal_axes(
    points: FloatArray, weights: FloatArray, groups: IntArray, count: int, anchors: FloatArray
) -> Axes:
    """Means and principal axes of groups; sums are taken about ``anchors`` (count, 3)."""
    moments = weighted_moments(points - anchors[groups], weights, groups, count)
    totals = np.maximum(moments[:, 3, 3], 1e-12)
    means = moments[:, :3, 3] / totals[:, None]
    spread = moments[:, :3, :3] / totals[:, None, None] - means[:, :, None] * means[:, None, :]
    values, axes = np.linalg.eigh(spread)
    return Axes(moments[:, 3, 3], anchors + means, values, axes)


def _structure(
    points: FloatArray, groups: IntArray, fit: Axes, sigma: float, normals: int
) -> FloatArray:
    """Share of each group's scatter along its normals that lies between the means of its parts.

    These are 3 x 3 parts of a plane, and 3 of a line.
    """
    count = len(fit.counts)
    local = np.einsum("ni,nij->nj", points - fit.means[groups], fit.axes[groups])
    reach = np.sqrt(np.maximum(fit.values[:, normals:], 1e-12)) / np.sqrt(3.0)  # a third of it
    thirds = local[:, normals:] / reach[groups]
    place = (thirds > -1.0).astype(np.int64) + (thirds > 1.0)
    parts = 3 ** place.shape[1]
    cells = parts * groups + place @ 3 ** np.arange(place.shape[1])
    sizes = np.maximum(np.bincount(cells, minlength=parts * count), 1)
    between, total = np.zeros(count), np.zeros(count)
    for column in range(normals):
        sums = np.bincount(cells, local[:, column], minlength=parts * count)
        between += (sums**2 / sizes).reshape(count, parts).sum(axis=1)
        total += np.maximum(fit.values[:, column], 0.0) + (_THIN * sigma) ** 2
    share: FloatArray = between / np.maximum(fit.counts, 1.0) / total
    return share


def _medians(values: FloatArray, labels: IntArray, count: int) -> FloatArray:
    """Median (count,) of the values of each group, which are not negative."""
    if not len(values):
        return np.zeros(count)
    order = np.argsort(labels + values / (2.0 * max(values.max(), 1e-9)))  # by group, then by size
    ends = np.cumsum(np.bincount(labels, minlength=count))
    middle = np.minimum(ends - (np.diff(ends, prepend=0) + 1) // 2, len(values) - 1)
    medians: FloatArray = values[order][middle]
    return medians
