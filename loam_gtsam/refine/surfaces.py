"""Planes among the points of many sweeps: an adaptive voxel tree, and robust fits.

A voxel is split until its points lie in a plane, or it is too small. Points in one voxel need not
be of one surface: what a door frame or a thin pillar adds to the plane of a wall would pull all
poses that see it. So a plane is tested for structure in its residuals, and points count by the
scatter of *their* plane and not by that of all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loam_gtsam.geometry import MAD_TO_SIGMA, voxel_keys
from loam_gtsam.types import FloatArray, InputError, IntArray

_LEAST_POINTS = 12
_FLAT = 16.0
"""Variance along a plane's narrow extent over that across it: a patch of four times its scatter."""
_STRUCTURE = 0.1
"""Share of the scatter across a plane that the means of its nine parts may explain, beyond what
chance makes of it (six freedoms among the points)."""
_THIN = 0.1
"""A plane's scatter counts as at least this share of the point's standard deviation."""
_KERNEL = 2.0
"""Standard deviations at which the Geman-McClure kernel lets go of a point."""
_FITS = 6
"""Rounds of fit and weights, which settle on the larger of two surfaces in a voxel."""


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """L planes in the map and the points that were found on them.

    Attributes
    ----------
    centres : (L, 3) metres, on the planes
    axes : (L, 3, 3) unit columns: normal, narrow and wide extent
    scatters : (L,) metres, standard deviation of a point across its plane
    extents : (L, 2) metres, standard deviations along both other axes
    rows : (M,) which points are on planes
    labels : (M,) the plane of each
    weights : (M,) 0 to 1, of each
    residuals : (M,) metres across the plane
    """

    centres: FloatArray
    axes: FloatArray
    scatters: FloatArray
    extents: FloatArray
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


def find_planes(
    points: FloatArray,
    sweeps: IntArray,
    sigma: float,
    sizes: tuple[float, ...],
    shift: FloatArray | None = None,
    views: int = 3,
) -> Planes:
    """Planes of an adaptive voxel tree.

    Parameters
    ----------
    points : (N, 3) metres in the map
    sweeps : (N,) numbers of the sweeps that saw them
    sigma : metres, that a measured point may have across a surface
    sizes : edge lengths of the levels, see :func:`voxel_sizes`
    shift : (3,) metres by which the grid is moved. A surface that a border of the grid cuts along
        its face is pinned to where it is, so each round of an adjustment takes another grid.
    views : sweeps that must see a plane at least
    """
    labels = np.full(len(points), -1, np.int64)
    active, found = np.arange(len(points)), 0
    moved = points if shift is None else points + shift
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
        flat = fit.values[:, 1] > _FLAT * np.maximum(fit.values[:, 0], (0.5 * sigma) ** 2)
        good = enough & flat & (fit.values[:, 0] < sigma**2)
        good &= _structure(here, voxel, fit, sigma) < _STRUCTURE + 6.0 / np.maximum(fit.counts, 1.0)
        number = np.where(good, found + np.cumsum(good) - 1, -1)
        found += int(good.sum())
        labels[active] = number[voxel]
        active = active[enough[voxel] & ~good[voxel]]
    rows = np.flatnonzero(labels >= 0)
    return fitted(points[rows], labels[rows], found, sigma, rows)


def fitted(
    points: FloatArray, labels: IntArray, count: int, sigma: float, rows: IntArray,
    weights: FloatArray | None = None,
) -> Planes:  # fmt: skip
    """Robust fits to points (M, 3) in the map whose planes are known.

    With the ``weights`` of an earlier fit there is one round only.
    """
    anchors = np.zeros((count, 3))
    anchors[labels[::-1]] = points[::-1]
    rounds = _FITS if weights is None else 1
    now = np.ones(len(points)) if weights is None else weights
    for _ in range(rounds):
        fit = principal_axes(points, now, labels, count, anchors)
        normals = fit.axes[:, :, 0]
        residuals = np.einsum("ni,ni->n", normals[labels], points - fit.means[labels])
        scatters = _scatters(residuals, labels, count, sigma)
        now = 1.0 / (1.0 + (residuals / (_KERNEL * scatters[labels])) ** 2) ** 2
    extents = np.sqrt(np.maximum(fit.values[:, 1:], 0.0))
    return Planes(fit.means, fit.axes, scatters, extents, rows, labels, now, residuals)


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


def _structure(points: FloatArray, groups: IntArray, fit: Axes, sigma: float) -> FloatArray:
    """Share of the scatter across each plane that lies between the means of its 3 x 3 parts."""
    count = len(fit.counts)
    local = np.einsum("ni,nij->nj", points - fit.means[groups], fit.axes[groups])
    reach = np.sqrt(np.maximum(fit.values[:, 1:], 1e-12)) / np.sqrt(3.0)  # a third of a square
    parts = local[:, 1:] / reach[groups]
    cells = (parts > -1.0).astype(np.int64) + (parts > 1.0)
    cells = 9 * groups + 3 * cells[:, 0] + cells[:, 1]
    sizes = np.bincount(cells, minlength=9 * count)
    sums = np.bincount(cells, local[:, 0], minlength=9 * count)
    between = (sums**2 / np.maximum(sizes, 1)).reshape(count, 9).sum(axis=1)
    total = np.maximum(fit.values[:, 0], 0.0) + (_THIN * sigma) ** 2
    share: FloatArray = between / np.maximum(fit.counts, 1.0) / total
    return share


def _scatters(residuals: FloatArray, labels: IntArray, count: int, sigma: float) -> FloatArray:
    """Robust standard deviation of each group's residuals, from their median."""
    size = np.abs(residuals)
    order = np.argsort(labels + size / (2.0 * size.max(initial=1e-9)))  # by group, then by size
    ends = np.cumsum(np.bincount(labels, minlength=count))
    middle = np.minimum(ends - (np.diff(ends, prepend=0) + 1) // 2, max(len(size) - 1, 0))
    medians = size[order][middle] if len(size) else np.zeros(count)
    return np.clip(MAD_TO_SIGMA * medians, _THIN * sigma, sigma)
