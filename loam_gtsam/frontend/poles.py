"""Pole features: what stands alone and has few points, near and thin or wide and far away.

A pole of ten centimetres has too few points for LOAM's windows, and most of them count as grazed or
occluded; so has a car at fifty metres. On open ground they are nevertheless all that fixes the
pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.frontend.curvature import EMPTY_BEAMS, LINKED_BEAMS
from loam_gtsam.geometry import squared_norm
from loam_gtsam.types import BoolArray, FloatArray, IntArray

_LINKED = 0.2
"""Metres between two neighbours of a run that are always allowed."""
_ROUND = 0.25 * np.pi
"""Distance of a cylinder's axis from the mean of the points seen on it, as a share of the radius:
the mean of ``sqrt(1 - x^2)`` over the width."""
_THINNEST = 0.05
"""Width of the thinnest posts, as of railings and signs, metres."""
_BEFOREHAND = 10.0
"""Runs of a sweep that tell as much about the widths in it as is known beforehand."""


@dataclass(frozen=True, slots=True, eq=False)
class Poles:
    """Poles of a sweep, one for each ring that meets one.

    Attributes
    ----------
    points : (M, 3) metres, on the axis of a round pole through the points of the run
    first, last : (M,) first and last point of each run
    depths : (M,) metres by which a pole stands before what is beside it; infinite if nothing is
    """

    points: FloatArray
    first: IntArray
    last: IntArray
    depths: FloatArray

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
    xyz: NDArray[np.float32], ring_starts: IntArray, depth: float, width: float, most: int
) -> Poles:
    """Find the runs of a ring that are narrow, and nearer than what is on either side of them.

    Parameters
    ----------
    xyz : (3, N) metres, ring after ring in firing order
    ring_starts : (R + 1,) where each ring begins; the last entry is N
    depth : metres by which a run must stand before the next points on both sides, where there are
        any; 0 finds no poles
    width : metres across a run at most
    most : points of a run at most
    """
    if depth <= 0.0:
        nothing = np.zeros(0, np.int64)
        return Poles(np.zeros((0, 3)), nothing, nothing, np.zeros(0))
    own = ring_starts[1:] > ring_starts[:-1]
    heads, tails = ring_starts[:-1][own], ring_starts[1:][own] - 1
    ranges = np.sqrt(squared_norm(xyz))
    beams = xyz / ranges
    turn = np.sqrt(squared_norm(_to_next(beams, heads, tails)))
    spacing = float(np.median(turn))
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
    first, last, depths, length = first[chosen], last[chosen], depths[chosen], length[chosen]
    sums = np.zeros((3, xyz.shape[1] + 1))
    np.cumsum(xyz, axis=1, dtype=np.float64, out=sums[:, 1:])
    means = ((sums[:, last + 1] - sums[:, first]) / length).T
    distance = np.linalg.norm(means, axis=1)
    across = np.linalg.norm(beams[:, last] - beams[:, first], axis=0) + spacing
    radii = 0.5 * _likely_widths(across * distance, spacing * distance, length == 1)
    narrow = 2.0 * radii <= width
    points = means * (1.0 + _ROUND * radii / distance)[:, None]
    return Poles(points[narrow], first[narrow], last[narrow], depths[narrow])


def _likely_widths(widths: FloatArray, apart: FloatArray, single: BoolArray) -> FloatArray:
    """(M,) metres: the ``widths`` of runs, with those of ``single`` points guessed from the others.

    One beam may have met anything narrower than twice the distance to the next beam, ``apart``
    (M,), and if it is wider than that distance, another beam the sooner. So it is as wide as the
    runs of more points of the sweep are in the mean, weighted by the chance that one beam alone
    meets these; see docs/maths/features.md, equation 2. Where they are few: as wide as things are
    if widths x are as frequent as ``1 / x^2``.
    """
    likely, limit = widths.copy(), apart[single]
    known = np.sort(widths[~single])
    sums = np.cumsum([[0.0, *1.0 / known], [0.0, *np.ones(len(known))], [0.0, *known]], axis=1)
    surely, maybe = (sums[:, np.searchsorted(known, most, "right")] for most in (limit, 2 * limit))
    maybe -= surely
    # The chance is 1 up to the distance, and from there on 2 distances / width - 1.
    weight, total = surely[1:] + 2.0 * limit * maybe[:2] - maybe[1:]
    most = np.maximum(limit, _THINNEST)
    guess = 2.0 * np.log(2.0) * most - _THINNEST
    guess /= np.log(most / _THINNEST) + 1.0 - np.log(2.0)
    guess = np.minimum(guess, limit)
    likely[single] = (total + _BEFOREHAND * guess) / (weight + _BEFOREHAND)
    return likely


def _to_next(
    values: NDArray[np.floating], heads: IntArray, tails: IntArray
) -> NDArray[np.floating]:
    """What (..., N) values change by from each point to the next of its ring; rings are closed."""
    change = np.empty_like(values)
    np.subtract(values[..., 1:], values[..., :-1], out=change[..., :-1])
    change[..., tails] = values[..., heads] - values[..., tails]
    return change
