"""Long drives in windows: stretches are adjusted one by one, and then tied to each other as wholes.

The cost of an adjustment grows with the square of the sweeps that see the same planes, and its
memory with all points. So a long drive is cut into stretches. Each is adjusted together with half
of the stretch before it and half of the one after (as in HBA: Liu et al., Large-scale lidar
consistent mapping using hierarchical lidar bundle adjustment, RA-L 2023). What the planes of such a
window tell of its poses is kept as a quadratic form, and a stretch counts from then on as a single
large sweep, from its middle. All poses remain free.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from loam_gtsam.geometry import transform
from loam_gtsam.refine.elimination import PlaneTies, eliminated
from loam_gtsam.refine.rounds import Adjusted, OtherFactors, Settings, adjusted
from loam_gtsam.refine.sweeps import Path, SweepPoints, stacked
from loam_gtsam.types import FloatArray, InputError, IntArray

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
    ties : what the planes of each window tell of its poses
    points, numbers : (M, 3) metres and (M,) points of the stretches, as seen from the middle of one
        sweep of each, and the number of that sweep
    """

    map_T_middle: FloatArray
    ties: tuple[PlaneTies, ...]
    points: FloatArray
    numbers: IntArray

    def points_at(self, poses: FloatArray) -> tuple[FloatArray, IntArray]:
        """Points and numbers, whatever the poses (N, 4, 4) are: a stretch is rigid."""
        del poses
        return self.points, self.numbers


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
    ties: list[PlaneTies] = []
    points, numbers = [np.empty((0, 3))], [np.empty(0, np.int64)]
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
        points.append(one.points(base_T_middle, seen))
        numbers.append(np.full(len(points[-1]), base))
        if on_window is not None:
            on_window(done, len(stretches))
    return Windows(poses, tuple(ties), np.concatenate(points), np.concatenate(numbers))


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
        """The window, adjusted; None if its sweeps share too few planes."""

        def points_at(poses: FloatArray) -> tuple[FloatArray, IntArray]:
            return stacked(Path.through(self.stamps, poses), self.sweeps)

        try:
            return adjusted(points_at, poses, others, asked, settings)
        except InputError:
            return None  # whether all are tied is known when the whole is adjusted

    def ties(self, found: Adjusted, base: int) -> PlaneTies:
        """What the planes tell, as seen from the sweep of a number."""
        told = eliminated(found.map_T_middle, found.planes, found.seen, found.clear)
        form = _SHARE * told.hessian.toarray(), _SHARE * told.gradient
        numbers = self.first + np.arange(len(self.sweeps))
        return PlaneTies(numbers, found.map_T_middle, base - self.first, *form)

    def points(self, base_T_middle: FloatArray, rows: Sequence[int]) -> FloatArray:
        """Points (M, 3) of some sweeps as seen from the base, evenly thinned."""
        path = Path.through(self.stamps, base_T_middle)
        parts = [transform(base_T_middle[n], path.deskewed(n, self.sweeps[n])) for n in rows]
        every: FloatArray = np.concatenate([np.empty((0, 3)), *parts])
        chosen = np.linspace(0, len(every), min(_MOST, len(every)), endpoint=False)
        return every[chosen.astype(np.int64)]
