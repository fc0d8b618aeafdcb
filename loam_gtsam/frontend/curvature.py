"""Measures along the rings of a sweep: how bent, how rough and how trustworthy each point is.

Throughout, ``xyz`` is (3, N) float32 in metres, ring after ring in firing order, and ring i begins
at ``ring_starts[i]``; the last of these (R + 1,) entries is N. See docs/maths/features.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.config import FeatureConfig
from loam_gtsam.geometry import squared_norm
from loam_gtsam.types import BoolArray, FloatArray, IntArray

LINKED_BEAMS = 2.5
"""Beam spacings between two points that are neighbours, at most: one lost beam is bridged."""
EMPTY_BEAMS = 5.5
"""Beam spacings without a point at least, for there to be nothing: four beams in a row are lost by
chance where one in four returns nothing, as on dark ground."""
UNIFORM_SIGMA = 12.0**-0.5
"""Standard deviation of what is anywhere within a metre: where an edge is between two beams."""
_NEAREST = 1e-9  # rad, from one beam to the next
_NEARER = 2.0
"""A surface that is continued comes nearer by less than this factor."""
_LINE_RESIDUALS = tuple(np.float32(factor) for factor in (0.4, 0.7, 0.8, 0.4))
"""Residual sum of squares of a straight line through five even samples, from their second
differences a, b, c: ``0.4 (a^2 + c^2) + 0.7 b^2 + 0.8 b (a + c) + 0.4 a c``, the quadratic form of
``(D D^T)^-1`` with D the second differences of five samples."""


def window_fits(ring_starts: IntArray, half_window: int) -> BoolArray:
    """(N,) true where the window around a point stays within its ring."""
    count = int(ring_starts[-1])
    fits = np.ones(count, dtype=bool)
    near = (ring_starts[:, None] + np.arange(-half_window, half_window)).ravel()
    fits[near[(near >= 0) & (near < count)]] = False
    return fits


def running_sums(xyz: NDArray[np.float32]) -> FloatArray:
    """(3, N + 1) metres: column i is the sum of the first i points of the sweep."""
    sums = np.zeros((3, xyz.shape[1] + 1))
    np.cumsum(xyz, axis=1, dtype=np.float64, out=sums[:, 1:])
    return sums


def window_means(sums: FloatArray, half_window: int) -> FloatArray:
    """(3, N) mean of the points in the window around each, cut at the ends of the sweep.

    ``sums`` are those of :func:`running_sums`; ``half_window`` is the number of neighbours on
    either side.
    """
    count, width = sums.shape[1] - 1, 2 * half_window + 1
    means = np.empty((3, count))
    whole = means[:, half_window : max(count - half_window, half_window)]
    np.subtract(sums[:, width:], sums[:, :-width], out=whole)
    whole /= width
    begin = min(half_window, count)
    cut = np.r_[:begin, max(count - half_window, begin) : count]
    first, end = np.maximum(cut - half_window, 0), np.minimum(cut + half_window + 1, count)
    means[:, cut] = (sums[:, end] - sums[:, first]) / (end - first)
    return means


def curvature(xyz: NDArray[np.float32], half_window: int) -> NDArray[np.float32]:
    """LOAM's curvature: squared norm of the sum of differences to the neighbours on the ring.

    Returns (N,) square metres, meaningless where :func:`window_fits` is false; ``half_window`` is
    the number of neighbours on either side.
    """
    width = 2 * half_window + 1
    inner = xyz.shape[1] - width + 1
    total = xyz[:, half_window : half_window + inner] * np.float32(-width)
    for shift in range(width):
        total += xyz[:, shift : shift + inner]
    result = np.zeros(xyz.shape[1], dtype=np.float32)
    result[half_window : half_window + inner] = squared_norm(total)
    return result


def prominence(xyz: NDArray[np.float32], half_window: int, chosen: IntArray) -> FloatArray:
    """How far points stand out, along their beams, of the surface through their neighbours.

    On *every* plane the inverse range is linear in the direction of the beam. So a point of a wall,
    however grazed, lies where the mean of its neighbours on one side and the mean of those on the
    other side predict it, interpolated by angle. :func:`curvature` is large on a grazed wall, whose
    points are spread unevenly. Evenly weighted inverse ranges would be off where a beam was lost.

    Parameters
    ----------
    xyz : (3, N) points of the sweep
    half_window : w, neighbours on either side
    chosen : (M,) indices of points whose windows stay within their rings

    Returns
    -------
    (M,) metres: the distance along the beam, divided by ``sqrt(1 + (a^2 + b^2) / w)``, its standard
    deviation for unit range noise, with a and b = 1 - a the weights of the two sides
    """
    rows = chosen[:, None] + np.arange(-half_window, half_window + 1)
    window = xyz.take(rows, axis=1).astype(np.float64)
    inverse = 1.0 / np.sqrt(squared_norm(window))
    beams = window * inverse
    turned = np.sqrt(squared_norm(beams - beams[:, :, half_window, None]))
    before, after = slice(0, half_window), slice(half_window + 1, None)
    left, right = turned[:, before].mean(axis=1), turned[:, after].mean(axis=1)
    share = np.divide(right, left + right, out=np.full(len(chosen), 0.5), where=left + right > 0.0)
    centre = inverse[:, half_window]
    expected = share * inverse[:, before].mean(axis=1)
    expected += (1.0 - share) * inverse[:, after].mean(axis=1)
    unit = np.sqrt(1.0 + (share**2 + (1.0 - share) ** 2) / half_window)
    off: FloatArray = np.abs(expected - centre) / (centre**2 * unit)
    return off


def ends_of_surfaces(
    xyz: NDArray[np.float32], half_window: int, chosen: IntArray, drop: float, width: float
) -> tuple[FloatArray, FloatArray]:
    """Where the surfaces end on which some points are the last ones before a drop.

    The last beam that meets a surface passes its end by anything up to the spacing of the beams,
    always on the same side: an edge that is taken there moves with the range, and with the side
    from which it is seen. The surface goes on along its last points, on which the inverse range
    is linear in the direction of the beam (see :func:`prominence`).

    Parameters
    ----------
    xyz : (3, N) points of the sweep
    half_window : neighbours at most by which a surface is continued
    chosen : (M,) indices of points whose windows stay within their rings
    drop : metres in range between two neighbours that may always be on one surface; far away it
        is what grazed surfaces have, ``LINKED_BEAMS`` times the way between two beams
    width : rad, of a beam, which meets a surface with any part of it, so that the last one misses
        the end by half the spacing of the beams less half its width, in the mean

    Returns
    -------
    points : (M, 3) metres, those that were measured where there is no drop, or one on both sides. A
        beam that returned nothing is a drop as well, if its neighbours did not either
    apart : (M,) metres from one beam to the next at these points, across the beams
    """
    ended = xyz.take(chosen, axis=1).T.astype(np.float64)
    apart = np.full(len(chosen), np.inf)
    for side in (-1, 1):  # of the surface, seen from its last point
        rows = chosen[:, None] + side * np.arange(-1, half_window + 1)
        window = xyz.take(rows, axis=1).astype(np.float64)
        ranges = np.sqrt(squared_norm(window))
        rays = np.concatenate((window / ranges, [1.0 / ranges]))
        turn = np.sqrt(squared_norm(np.diff(rays[:3], axis=2)))
        spacing = _medians(turn)
        np.minimum(apart, spacing * ranges[:, 1], out=apart)
        most = np.maximum(drop, LINKED_BEAMS * spacing * ranges[:, 1])
        linked = np.abs(np.diff(ranges[:, 1:], axis=1)) < most[:, None]
        count = np.logical_and.accumulate(linked, axis=1).sum(axis=1)
        last, far = rays[:, :, 1], np.take_along_axis(rays, count[None, :, None] + 1, axis=2)
        step = (last - far[:, :, 0]) / np.maximum(count, 1)
        falls = (ranges[:, 0] - ranges[:, 1] > most) & (turn[:, 0] < LINKED_BEAMS * spacing)
        falls |= turn[:, 0] > EMPTY_BEAMS * spacing
        here = np.flatnonzero((count > 0) & falls)
        reach = np.maximum(0.5 - 0.5 * width / np.maximum(spacing[here], _NEAREST), 0.0)
        beyond = last[:, here] + reach * step[:, here]
        inverse = np.maximum(beyond[3], last[3, here] / _NEARER)
        inverse *= np.sqrt(squared_norm(beyond[:3]))
        ended[here] = (beyond[:3] / inverse).T
    return ended, apart


def _medians(rows: FloatArray) -> FloatArray:
    """(M,) medians of the rows of (M, K), for a small K faster than ``np.median``."""
    ordered = np.sort(rows, axis=1)
    middle = rows.shape[1] // 2
    medians: FloatArray = 0.5 * (ordered[:, (rows.shape[1] - 1) // 2] + ordered[:, middle])
    return medians


def roughness(xyz: NDArray[np.float32]) -> NDArray[np.float32]:
    """Scatter along the beam of five consecutive points of a ring about a smooth surface.

    A straight line is fitted to the inverse ranges (see :func:`prominence`); its residuals have
    three degrees of freedom, the second differences. Of the windows that end at, are centred on and
    begin at a point the smoothest counts, so that points next to an edge are not rough. Returns
    (N,) metres, a standard deviation; infinite within two points of the ends.
    """
    squared = squared_norm(xyz)
    inverse = 1.0 / np.sqrt(squared)
    count = len(inverse)
    best = np.full(count, np.inf, dtype=np.float32)
    if count < 5:
        return best
    second = (inverse[:-2] - 2.0 * inverse[1:-1] + inverse[2:]) * squared[1:-1]
    left, centre, right = second[:-2], second[1:-1], second[2:]
    outer, inner, beside, across = _LINE_RESIDUALS
    scatter = outer * (left * left + right * right) + inner * (centre * centre)
    scatter += beside * (centre * (left + right)) + across * (left * right)
    middle = best[2:-2]
    middle[:] = scatter
    middle[2:] = np.minimum(middle[2:], scatter[:-2])
    middle[:-2] = np.minimum(middle[:-2], scatter[2:])
    rough: NDArray[np.float32] = np.sqrt(np.maximum(best, 0.0) / np.float32(3.0))
    return rough


def squared_gaps(xyz: NDArray[np.float32], ring_starts: IntArray) -> NDArray[np.float32]:
    """(N,) squared distance to the next point of the ring, square metres; infinite at its end."""
    gaps = np.empty(xyz.shape[1], dtype=np.float32)
    gaps[:-1] = squared_norm(xyz[:, 1:] - xyz[:, :-1])
    gaps[ring_starts[1:] - 1] = np.inf
    return gaps


def unreliable_points(
    xyz: NDArray[np.float32],
    gaps: NDArray[np.float32],
    ring_starts: IntArray,
    settings: FeatureConfig,
) -> BoolArray:
    """(N,) points LOAM never picks: on the rim of an occluded surface, or on a grazed one.

    Two neighbours lie on almost the same ray if they are far apart, and close once the farther one
    is drawn in to the range of the nearer one. The nearer surface then cuts off the farther one,
    whose end is no edge: that point and the five behind it are left out (figure 4b of the paper).
    Where both gaps of a point are large for its range, the surface is seen at a grazing angle
    (figure 4a). ``gaps`` are those of :func:`squared_gaps`.
    """
    squared = squared_norm(xyz)
    limit = squared * np.float32(settings.grazing_ratio)
    out = np.zeros(len(squared), dtype=bool)
    out[1:] = (gaps[1:] > limit[1:]) & (gaps[:-1] > limit[1:])

    first = np.flatnonzero(gaps > settings.occlusion_gap)
    first = first[gaps[first] < np.inf]
    second = first + 1
    near_is_second = squared[first] > squared[second]
    near = np.where(near_is_second, second, first)
    far = np.where(near_is_second, first, second)
    range_near, range_far = np.sqrt(squared[near]), np.sqrt(squared[far])
    drawn_in = xyz.take(far, axis=1) * (range_near / range_far)
    apart = np.linalg.norm(xyz.take(near, axis=1) - drawn_in, axis=0)
    one_ray = apart < settings.occlusion_ratio * range_near
    far, away = far[one_ray], np.where(near_is_second, -1, 1)[one_ray]
    hidden = far[:, None] + away[:, None] * np.arange(settings.half_window + 1)
    ring = np.searchsorted(ring_starts, far, side="right")[:, None]
    same_ring = (hidden >= ring_starts[ring - 1]) & (hidden < ring_starts[ring])
    out[hidden[same_ring]] = True
    return out
