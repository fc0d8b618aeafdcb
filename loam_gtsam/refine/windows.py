"""Long drives in windows: stretches are adjusted one by one, and then tied to each other as wholes.

The cost of an adjustment grows with the square of the sweeps that see the same planes, and its
memory with all points. So a long drive is cut into stretches. Each is adjusted together with half
of the stretch before it and half of the one after (as in HBA: Liu et al., Large-scale lidar
consistent mapping using hierarchical lidar bundle adjustment, RA-L 2023). What the planes
and lines of such a window tell of its poses is kept as a quadratic form, and a stretch counts from
then on as a single large sweep, from its middle. All poses remain free.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from loam_gtsam.geometry import transform
from loam_gtsam.refine.elimination import LandmarkTies, eliminated
from loam_gtsam.refine.rounds import Adjusted, OtherFactors, Settings, adjusted
from loam_gtsam.refine.sweeps import Path, Stack, SweepPoints, stacked
from loam_gtsam.types import BoolArray, FloatArray, InputError, IntArray

_STRETCH = 24
"""Sweeps of a stretch; a window has twice as many."""
_MOST = 30_000
"""Points of a stretch at most when it counts as one sweep."""
_SHARE = 0.5
"""Weight of what a window tells: each sweep is in two of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """A drive whose windows are adjusted.

    Attributes
    ----------
    map_T_middle : (N, 4, 4) poses of the middles of all sweeps
    ties : what the planes and lines of each window tell of its poses
    points : of the stretches, each as seen from the middle of one of its sweeps
    """

    map_T_middle: FloatArray
    ties: tuple[LandmarkTies, ...]
    points: Stack

    def points_at(self, poses: FloatArray) -> Stack:
        """The points, whatever the poses (N, 4, 4) are: a stretch is rigid."""
        del poses
        return self.points


def in_windows(
    sweeps: Sequence[SweepPoints],
    map_T_middle: FloatArray,
    others: OtherFactors,
    asked: FloatArray,
    settings: Settings,
    starts: Sequence[int] = (0,),
    on_window: Callable[[int, int], None] | None = None,
) -> Windows:
    """Adjust the windows of a drive, one after the other.

    Parameters
    ----------
    asked : (N, 6, 6) projectors of the poses onto the directions about which planes are asked
    starts : numbers of the first sweeps of the runs; a window is of one
    on_window : called after each window with the number of those that are done, and of all
    """
    stamps = np.array([sweep.stamp for sweep in sweeps], np.int64)
    poses, stretches = map_T_middle.copy(), _stretches(starts, len(sweeps))
    ties: list[LandmarkTies] = []
    points: list[tuple[int, FloatArray, BoolArray]] = []
    for done, (stretch, window) in enumerate(stretches, 1):
        base = _base(stretch, asked)
        one = _Window(stamps[window], sweeps[window], window.start)
        now = map_T_middle[window]
        found = one.adjusted(now, others.among(window.start, now), asked[window], settings)
        if found is not None:
            ties.append(one.ties(found, base))
            now = found.map_T_middle
        base_T_middle = np.linalg.inv(now[base - window.start]) @ now
        inside = slice(stretch.start - window.start, stretch.stop - window.start)
        poses[stretch.start : stretch.stop] = map_T_middle[base] @ base_T_middle[inside]
        seen = [n - window.start for n in stretch if asked[n].any()]
        points.append((base, *one.points(base_T_middle, seen)))
        if on_window is not None:
            on_window(done, len(stretches))
    return Windows(poses, tuple(ties), Stack.of(points))


def _stretches(starts: Sequence[int], count: int) -> list[tuple[range, slice]]:
    """The stretches of all runs, and the windows around them."""
    half = _STRETCH // 2
    return [
        (
            range(first, min(first + _STRETCH, end)),
            slice(max(first - half, begin), min(first + _STRETCH + half, end)),
        )
        for begin, end in pairwise([*starts, count])
        for first in range(begin, end, _STRETCH)
    ]


def _base(stretch: range, asked: FloatArray) -> int:
    """The sweep in the middle of a stretch, or the nearest one whose planes are asked."""
    middle = (stretch.start + stretch.stop) // 2
    return min(stretch, key=lambda n: (not asked[n].any(), abs(n - middle)))


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    stamps: IntArray
    sweeps: Sequence[SweepPoints]
    first: int  # number of the first sweep

    def adjusted(
        self, poses: FloatArray, others: OtherFactors, asked: FloatArray, settings: Settings
    ) -> Adjusted | None:
        """The window, adjusted; None if its sweeps share too little."""

        def points_at(poses: FloatArray) -> Stack:
            return stacked(Path.through(self.stamps, poses), self.sweeps)

        try:
            return adjusted(points_at, poses, others, asked, settings)
        except InputError:
            return None  # whether all are tied is known when the whole is adjusted

    def ties(self, found: Adjusted, base: int) -> LandmarkTies:
        """What the planes and lines tell, as seen from the sweep of a number."""
        told = eliminated(found.map_T_middle, found.landmarks, found.seen, found.clear)
        form = _SHARE * told.hessian.toarray(), _SHARE * told.gradient
        numbers = self.first + np.arange(len(self.sweeps))
        return LandmarkTies(numbers, found.map_T_middle, base - self.first, *form)

    def points(
        self, base_T_middle: FloatArray, rows: Sequence[int]
    ) -> tuple[FloatArray, BoolArray]:
        """Points (M, 3) of some sweeps as seen from the base, evenly thinned; whether on edges."""
        path = Path.through(self.stamps, base_T_middle)
        every = Stack.of([
            (n, transform(base_T_middle[n], path.deskewed(n, one)), one.is_edge)
            for n, one in ((n, self.sweeps[n]) for n in rows)
        ])  # fmt: skip
        count = len(every.points)
        chosen = np.linspace(0, count, min(_MOST, count), endpoint=False).astype(np.int64)
        return every.points[chosen], every.is_edge[chosen]
