"""Pole features: what stands alone and has few points, near and thin or wide and far away.

A pole of ten centimetres has too few points for LOAM's windows, and most of them count as grazed or
occluded; so has a car at fifty metres. On open ground they are nevertheless all that fixes the
pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from loam_gtsam.frontend.curvature import EMPTY_BEAMS, LINKED_BEAMS, UNIFORM_SIGMA
from loam_gtsam.geometry import squared_norm
from loam_gtsam.types import BoolArray, FloatArray, IntArray

_LINKED = 0.2
"""Metres between two neighbours of a run that are always allowed."""
_ROUND = 0.25 * np.pi
"""Distance of a cylinder's axis from the mean of the points seen on it, as a share of the radius:
the mean of ``sqrt(1 - x^2)`` over the width."""
_NOISE = 0.1
"""Metres by which the ranges of two points of a pole differ by chance."""
_WIDTHS = 0.05 * 1.08 ** np.arange(58)
"""Metres, from the thinnest posts of railings and signs to twice the widest poles."""
_EXPECTED = (1.0 / _WIDTHS) / (1.0 / _WIDTHS).sum()
"""How frequent they are known to be beforehand: in proportion to ``1 / x^2``, which is what makes
half as many twice as wide."""
_BEFOREHAND = 10.0
"""Things by which that counts."""
_STEPS = 10
"""Of the iteration; fifty change no width by more than a twentieth."""
_UPRIGHT = 1.0, 1.5, 0.5
"""Rings, beams and metres by which two runs on one post are apart at most."""
_TINY = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Poles:
    """Poles of a sweep, one for each ring that meets one.

    Attributes
    ----------
    points : (M, 3) metres, on the axis of a round pole through the points of the run
    first, last : (M,) first and last point of each run
    depths : (M,) metres by which a pole stands before what is beside it; infinite if nothing is
    sigmas : (M,) metres, standard deviation of its place along the ring
    """

    points: FloatArray
    first: IntArray
    last: IntArray
    depths: FloatArray
    sigmas: FloatArray

    def __len__(self) -> int:
        return len(self.points)

    @property
    def middles(self) -> IntArray:
        """(M,) the point in the middle of each run."""
        return (self.first + self.last) // 2

    def members(self, count: int) -> BoolArray:
        """(count,) which of the ``count`` points of the sweep belong to a pole."""
        step = np.zeros(count + 1, np.int64)
        np.add.at(step, self.first, 1)
        np.add.at(step, self.last + 1, -1)
        inside: BoolArray = np.cumsum(step[:-1]) > 0
        return inside


def find_poles(
    xyz: NDArray[np.float32],
    sums: FloatArray,
    ring_starts: IntArray,
    depth: float,
    width: float,
    most: int,
) -> Poles:
    """Find the runs of a ring that are narrow, and nearer than what is on either side of them.

    A run that is deeper than wide is of a surface that is seen at a grazing angle, as of a rail.

    Parameters
    ----------
    xyz : (3, N) metres, ring after ring in firing order
    sums : (3, N + 1) metres, of the points before each, see
        :func:`~loam_gtsam.frontend.curvature.running_sums`
    ring_starts : (R + 1,) where each ring begins; the last entry is N
    depth : metres by which a run must stand before the next points on both sides, where there are
        any; 0 finds no poles
    width : metres across a run at most
    most : points of a run at most
    """
    if depth <= 0.0:
        nothing = np.zeros(0, np.int64)
        return Poles(np.zeros((0, 3)), nothing, nothing, np.zeros(0), np.zeros(0))
    filled = ring_starts[1:] > ring_starts[:-1]
    heads, tails = ring_starts[:-1][filled], ring_starts[1:][filled] - 1
    ranges = np.sqrt(squared_norm(xyz))
    beams = xyz / ranges
    turn = np.sqrt(squared_norm(_to_next(beams, heads, tails)))
    spacing = max(float(np.median(turn)), _TINY)
    # On a ring of a few points the last may lie beside the first, and still be a turn away.
    turn[tails[tails - heads < most]] = np.inf
    farther = _to_next(ranges, heads, tails)
    apart, empty = turn > LINKED_BEAMS * spacing, turn > EMPTY_BEAMS * spacing
    reach = np.maximum(_LINKED, LINKED_BEAMS * spacing * ranges)
    cut = apart | (np.hypot(farther, turn * ranges) > reach)
    # A run does not go on from the end of a ring to its start: it is cut there.
    ends = cut.copy()
    ends[tails] = True
    last = np.flatnonzero(ends)
    first = np.concatenate(([0], last[:-1] + 1))
    before = first - 1
    before[np.searchsorted(first, heads)] = tails
    gap_before = np.where(empty[before], np.inf, -farther[before])
    gap_after = np.where(empty[last], np.inf, farther[last])
    length = last - first + 1
    depths = np.minimum(gap_before, gap_after).astype(np.float64)
    chosen = (length <= most) & cut[last] & cut[before] & (depths > depth)
    first, last, depths, length = (column[chosen] for column in (first, last, depths, length))
    turned = np.linalg.norm(beams[:, last] - beams[:, first], axis=0)
    chosen = np.abs(ranges[last] - ranges[first]) <= turned * ranges[last] + _NOISE
    runs = first, last, depths, length, turned
    first, last, depths, length, turned = (column[chosen] for column in runs)
    means = ((sums[:, last + 1] - sums[:, first]) / length).T
    distance = np.linalg.norm(means, axis=1)
    rings = np.searchsorted(ring_starts, first, side="right")
    upright = _upright(rings, np.arctan2(means[:, 1], means[:, 0]) / spacing, distance)
    widths, apart = (turned + spacing) * distance, spacing * distance
    radii = 0.5 * _likely_widths(widths, apart, length == 1, upright)
    narrow = 2.0 * radii <= width
    points = means * (1.0 + _ROUND * radii / distance)[:, None]
    # What one beam met is not farther from it than its own width, nor than the next beam.
    sigmas = UNIFORM_SIGMA * np.minimum(2.0 * radii, apart)
    return Poles(*(column[narrow] for column in (points, first, last, depths, sigmas)))


def _upright(rings: IntArray, beams: FloatArray, distances: FloatArray) -> BoolArray:
    """(M,) which runs go on in a ring beside theirs: posts do, drops of rain do not."""
    places = np.column_stack([rings, beams, distances]) / _UPRIGHT
    just_beyond = np.nextafter(1.0, 2.0)
    nearest, _ = KDTree(places).query(places, [2], p=np.inf, distance_upper_bound=just_beyond)
    upright: BoolArray = np.isfinite(nearest[:, 0])
    return upright


def _likely_widths(
    widths: FloatArray, apart: FloatArray, single: BoolArray, upright: BoolArray
) -> FloatArray:
    """(M,) metres: the ``widths`` of runs, with those of ``single`` beams guessed from ``upright``.

    Beams that are ``apart`` (M,) may have met anything that is wider or narrower than the run by
    less than that. Over many sweeps the runs of more beams are as wide as what they met; one beam
    alone has mostly met what is narrower. How frequent which width is, is what makes the whole
    sweep likeliest: the self-consistent estimate of B. W. Turnbull, The empirical distribution
    function with arbitrarily grouped, censored and truncated data, J. R. Stat. Soc. B 38, 1976.
    Truncated, for what is narrow and far away is mostly missed. See docs/maths/features.md.
    """
    ratio = _WIDTHS / apart[:, None]
    chance = np.maximum(1.0 - np.abs(ratio - (widths / apart)[:, None]), _TINY)
    met = np.minimum(ratio, 1.0)
    frequency, every = _EXPECTED, chance
    chance, met = chance[upright], met[upright]
    for _ in range(_STEPS):
        # Loops of its own, not BLAS: the same sums with any number of threads.
        seen = np.einsum("ij,i->j", chance, 1.0 / np.einsum("ij,j->i", chance, frequency))
        there = np.einsum("ij,i->j", met, 1.0 / np.einsum("ij,j->i", met, frequency))
        frequency = frequency * seen + _BEFOREHAND * _EXPECTED
        frequency /= there + _BEFOREHAND
        frequency /= frequency.sum()
    alone, likely = every[single], widths.copy()
    likely[single] = np.einsum("ij,j->i", alone, frequency * _WIDTHS)
    likely[single] /= np.einsum("ij,j->i", alone, frequency)
    return likely


def _to_next(
    values: NDArray[np.floating], heads: IntArray, tails: IntArray
) -> NDArray[np.floating]:
    """What (..., N) values change by from each point to the next of its ring; rings are closed."""
    change = np.empty_like(values)
    np.subtract(values[..., 1:], values[..., :-1], out=change[..., :-1])
    change[..., tails] = values[..., heads] - values[..., tails]
    return change
