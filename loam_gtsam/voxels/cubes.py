"""One cube of a map: its points, at most one a voxel, and the owner of each point."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.geometry import find_in_sorted, run_starts, voxel_keys
from loam_gtsam.types import FloatArray, IntArray
from loam_gtsam.voxels.grid import CubeIndex, Grid, cube_index
from loam_gtsam.voxels.key_table import Columns, KeyTable

Owners = NDArray[np.int32]
"""Numbers that points carry: points of one number can be moved together."""

NO_POINTS: FloatArray = np.empty((0, 3))
_NO_KEYS: IntArray = np.empty(0, np.int64)
_NO_OWNERS: Owners = np.empty(0, np.int32)


class CubePoints(NamedTuple):
    """Points of a cube, (N, 3) metres, and the owners of the points, (N,)."""

    points: FloatArray
    owners: Owners

    @property
    def nbytes(self) -> int:
        """Bytes."""
        return self.points.nbytes + self.owners.nbytes


VoxelPoints = tuple[IntArray, FloatArray, Owners]
"""Ascending keys (V,) of voxels, a point (V, 3) of each, and the owners (V,) of the points."""


class VoxelSums(NamedTuple):
    """Sums (V, 3), bounds (V, 3) and counts (V,) of the points of voxels, by ascending key (V,)."""

    keys: IntArray
    owners: Owners
    sums: FloatArray
    lows: FloatArray
    highs: FloatArray
    counts: FloatArray


class Cube(KeyTable):
    """Points of a cube in the order of their voxels, at most one a voxel."""

    __slots__ = ()

    def __init__(
        self, keys: IntArray = _NO_KEYS, points: FloatArray = NO_POINTS, owners: Owners = _NO_OWNERS
    ) -> None:
        super().__init__(keys, points, owners)

    @classmethod
    def of(cls, content: CubePoints, grid: Grid) -> Cube:
        """A cube that holds these points, of which no two are in one voxel."""
        keys = voxel_keys(content.points, grid.voxel_size)
        order = np.argsort(keys, kind="stable")
        return cls(keys[order], content.points[order], content.owners[order])

    @property
    def points(self) -> FloatArray:
        """(N, 3) metres, in the order of their voxels."""
        points: FloatArray = self.columns[1]
        return points

    @property
    def content(self) -> CubePoints:
        """All that is kept of the cube in an archive."""
        return CubePoints(*self.columns[1:])

    def settle(self, new: VoxelPoints) -> FloatArray:
        """Add the points whose voxels are free, and return them."""
        return new[1].take(self.add(*new), axis=0)

    def average(self, new: VoxelSums) -> None:
        """Put into each voxel the mean of its point, if it has one, and the new ones.

        A voxel that has a point keeps the owner of that point. The arrays of ``new`` are changed.
        """
        keys, held, _ = self.columns
        at, taken = find_in_sorted(keys, new.keys)
        old = held[at[taken]]
        new.sums[taken] += old
        new.counts[taken] += 1.0
        new.lows[taken] = np.minimum(new.lows[taken], old)
        new.highs[taken] = np.maximum(new.highs[taken], old)
        # Rounding may put a mean just outside its points, and so into another voxel or cube.
        means = np.clip(new.sums / new.counts[:, None], new.lows, new.highs)
        held[at[taken]] = means[taken]
        free = np.flatnonzero(~taken)
        self.append(*(column.take(free, axis=0) for column in (new.keys, means, new.owners)))
        self.merge()  # the next call changes points in place

    def take_out(self, owners: Owners) -> CubePoints:
        """Remove the points of some owners, and return them."""
        columns = self.columns
        out = np.isin(columns[2], owners)
        if not out.any():
            return CubePoints(NO_POINTS, _NO_OWNERS)
        self._put(*(column[~out] for column in columns))
        return CubePoints(columns[1][out], columns[2][out])


class SortedPoints(NamedTuple):
    """New points in the order of their cubes, and within a cube in the order of their voxels.

    Attributes
    ----------
    points : (N, 3) metres
    keys, owners : (V,) key of each voxel, and owner of its first point
    starts : (V,) the point with which each voxel begins
    cubes, parts : the C cubes, and the voxels of each
    """

    points: FloatArray
    keys: IntArray
    owners: Owners
    starts: IntArray
    cubes: list[CubeIndex]
    parts: list[slice]

    @classmethod
    def of(cls, points: FloatArray, owners: Owners, cells: FloatArray, grid: Grid) -> SortedPoints:
        """Sort points, (N, 3) with N > 0; those of one voxel stay in the order given.

        ``cells`` (3, N) are the indices of the cubes of the points.
        """
        low = cells.min(axis=1, keepdims=True)
        steps = (cells - low).astype(np.int64)
        box = tuple((steps.max(axis=1) + 1).tolist())
        numbers = np.ravel_multi_index(tuple(steps), box)
        keys = voxel_keys(points, grid.voxel_size)
        order = np.lexsort((keys, numbers))  # stable
        keys, numbers = keys[order], numbers[order]
        starts = run_starts((numbers[1:] != numbers[:-1]) | (keys[1:] != keys[:-1]))
        numbers = numbers[starts]
        heads = run_starts(numbers[1:] != numbers[:-1])
        ends = zip(heads.tolist(), np.append(heads[1:], len(numbers)).tolist(), strict=True)
        return cls(
            points.take(order, axis=0),  # several times faster than an index on rows
            keys[starts],
            owners[order[starts]],
            starts,
            [cube_index(cell) for cell in (np.unravel_index(numbers[heads], box) + low).T],
            [slice(*part) for part in ends],
        )

    def firsts(self) -> Iterator[VoxelPoints]:
        """The first point of each voxel, cube by cube."""
        firsts = self.points.take(self.starts, axis=0)
        return ((self.keys[part], firsts[part], self.owners[part]) for part in self.parts)

    def sums(self) -> Iterator[VoxelSums]:
        """Sums over the points of each voxel, cube by cube."""
        hows = np.add, np.minimum, np.maximum
        sums = (how.reduceat(self.points, self.starts, axis=0) for how in hows)
        counts = np.diff(np.append(self.starts, len(self.points))).astype(np.float64)
        columns: Columns = self.keys, self.owners, *sums, counts
        return (VoxelSums(*(column[part] for column in columns)) for part in self.parts)
