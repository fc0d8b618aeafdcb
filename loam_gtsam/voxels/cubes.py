"""One cube of a map: its points, the owner of each, and from where it was seen.

A voxel holds one point; where a thin wall passes through it, a second one, of the other face.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from loam_gtsam.geometry import find_in_sorted, run_starts, transform
from loam_gtsam.types import BoolArray, FloatArray, IntArray
from loam_gtsam.voxels.grid import CubeIndex, Grid, Window, cube_index
from loam_gtsam.voxels.key_table import Columns, KeyTable
from loam_gtsam.voxels.tags import Faces, Owners, Tags, second, sines, tags_of, turn, views

NO_POINTS: FloatArray = np.empty((0, 3))
_NO_KEYS: IntArray = np.empty(0, np.int64)
_NO_TAGS = tags_of(0, 0)
_SECOND = np.int64(-(1 << 63))
"""The sign bit: it is set in the keys of points that are second in their voxels."""


class CubePoints(NamedTuple):
    """Points of cubes, (N, 3) metres, and their tags, (N, 2)."""

    points: FloatArray
    tags: Tags

    @property
    def nbytes(self) -> int:
        """Bytes."""
        return self.points.nbytes + self.tags.nbytes

    def chosen(self, which: BoolArray | IntArray) -> CubePoints:
        """The points for which a mask is true, or those of some rows."""
        return CubePoints(self.points[which], self.tags[which])

    def of(self, owner: int) -> CubePoints:
        """The points of one owner."""
        return self.chosen(self.tags[:, 0] == owner)

    def moved(self, move: FloatArray) -> CubePoints:
        """The points after a rigid transform (4, 4)."""
        tags = self.tags.copy()
        turn(tags, move[:3, :3])
        return CubePoints(transform(move, self.points), tags)

    def without_seconds(self) -> CubePoints:
        """The points for other voxels, where none of them is known to be second."""
        tags = self.tags.copy()
        views(tags)[..., 3] = 0
        return CubePoints(self.points, tags)

    def keys(self, grid: Grid) -> IntArray:
        """(N,) under which cubes hold the points."""
        keys = grid.keys(self.points)
        keys[second(self.tags)] |= _SECOND
        return keys


class VoxelPoints(NamedTuple):
    """Ascending keys (V,) of voxels, a point (V, 3) of each, and the tags (V, 2) of the points."""

    keys: IntArray
    points: FloatArray
    tags: Tags


class VoxelSums(NamedTuple):
    """Sums (V, 3), bounds (V, 3) and counts (V,) of the points of voxels, by ascending key (V,)."""

    keys: IntArray
    tags: Tags
    sums: FloatArray
    lows: FloatArray
    highs: FloatArray
    counts: FloatArray


class Cube(KeyTable):
    """Points of a cube in the order of their keys: one of each voxel, or a first and a second."""

    __slots__ = ()

    def __init__(
        self, keys: IntArray = _NO_KEYS, points: FloatArray = NO_POINTS, tags: Tags = _NO_TAGS
    ) -> None:
        super().__init__(keys, points, tags)

    @classmethod
    def of(cls, content: CubePoints, grid: Grid) -> Cube:
        """A cube that holds these points, of which no two are both first or second in a voxel."""
        keys = content.keys(grid)
        order = np.argsort(keys, kind="stable")
        return cls(keys[order], *content.chosen(order))

    @property
    def points(self) -> FloatArray:
        """(N, 3) metres, in the order of their keys."""
        points: FloatArray = self.columns[1]
        return points

    @property
    def content(self) -> CubePoints:
        """All that is kept of the cube in an archive, and in trees."""
        return CubePoints(*self.columns[1:])

    def tags_at(self, keys: IntArray) -> Tags:
        """Tags (V, 2) of the points that are first in voxels; those of unknown view if none is."""
        found = tags_of(len(keys), 0)
        self.look_up(keys, 2, found)
        return found

    def settle(self, new: VoxelPoints) -> CubePoints:
        """Add the points whose places in their voxels are free, and return them."""
        added = self.add(*new)
        return CubePoints(new.points.take(added, axis=0), new.tags.take(added, axis=0))

    def average(self, new: VoxelSums) -> None:
        """Put into each voxel the mean of its point, if it has one, and the new ones.

        A voxel that has a point keeps the owner of that point. The arrays of ``new`` are changed.
        """
        keys, held = self.columns[:2]
        at, taken = find_in_sorted(keys, new.keys)
        old = held[at[taken]]
        new.sums[taken] += old
        new.counts[taken] += 1.0
        new.lows[taken] = np.minimum(new.lows[taken], old)
        new.highs[taken] = np.maximum(new.highs[taken], old)
        # Rounding may put a mean just outside its points, and so into another voxel or cube.
        means = np.clip(new.sums / new.counts[:, None], new.lows, new.highs)
        held = held.copy()
        held[at[taken]] = means[taken]
        self._put(keys, held, *self.columns[2:])
        free = np.flatnonzero(~taken)
        self.append(*(column.take(free, axis=0) for column in (new.keys, means, new.tags)))
        self.merge()

    def give_to(self, owner: int) -> None:
        """Let all points belong to an owner."""
        *columns, tags = self.columns
        tags = tags.copy()
        tags[:, 0] = owner
        self._put(*columns, tags)

    def take_out(self, owners: Owners) -> CubePoints:
        """Remove the points of some owners, and return them."""
        columns, content = self.columns, self.content
        out = np.isin(content.tags[:, 0], owners)
        if out.any():
            self._put(*(column[~out] for column in columns))
        return content.chosen(out)


def joined(parts: Sequence[CubePoints]) -> CubePoints:
    """The points of all parts."""
    return CubePoints(*map(np.concatenate, zip(Cube().content, *parts, strict=True)))


def any_order(count: int) -> IntArray:
    """(N,) rows in an order by chance, in which of two rows the same always comes first.

    The features of a sweep are sorted along an axis of the lidar, and of those in a voxel the first
    stays: it would always lie on the same side of their mean, and so would a wall that is made of
    such points. See docs/maths/cubemap.md.
    """
    return np.random.default_rng(0).random(count).argsort()


def _order(keys: IntArray, numbers: IntArray) -> IntArray:
    """Rows (N,) by number, then by key, then as given; in half of ``np.lexsort``'s time."""
    order = keys.argsort()  # numpy's fastest, but equal keys come in any order
    runs = np.cumsum(np.diff(keys[order]) != 0)
    order[1:] += len(keys) * runs
    order.sort()
    order %= len(keys)
    small = numbers[order].astype(np.min_scalar_type(int(numbers.max())))
    return order[small.argsort(kind="stable")]  # by radix for two bytes


def mark_second(
    content: CubePoints, faces: Faces, cubes: Mapping[CubeIndex, Cube], grid: Grid
) -> None:
    """Mark points as second if the first ones of their voxels are on the other side of a face."""
    near = grid.reaches(content.points[faces.rows].T)
    rows, normals, least = faces.rows[near], faces.normals[near], faces.least[near]
    points = content.points[rows]
    cells, keys = grid.cells(points), grid.keys(points)
    held = tags_of(len(rows), 0)
    for cell in set(map(tuple, cells.tolist())):
        cube = cubes.get(cube_index(np.array(cell)))
        if cube is not None:
            inside = (cells == cell).all(axis=1)
            held[inside] = cube.tags_at(keys[inside])
    views(content.tags)[rows, 3] = sines(views(held), normals.T) < -least


class SortedPoints(NamedTuple):
    """New points in the order of their cubes, and within a cube in the order of their voxels.

    Attributes
    ----------
    content : the N points
    keys : (N,) key of the voxel of each
    numbers : (N,) of the cubes, in a box of them
    box, low : number of cubes (3,) along the sides of the box, and its lowest cube (3, 1)
    """

    content: CubePoints
    keys: IntArray
    numbers: IntArray
    box: tuple[int, ...]
    low: FloatArray

    @classmethod
    def of(cls, content: CubePoints, cells: FloatArray, grid: Grid) -> SortedPoints:
        """Sort points, of any cubes and at least one; those of one voxel stay in the order given.

        ``cells`` (3, N) are the indices of the cubes of the points.
        """
        low = cells.min(axis=1, keepdims=True)
        steps = (cells - low).astype(np.int64)
        box = tuple((steps.max(axis=1) + 1).tolist())
        numbers = np.ravel_multi_index(tuple(steps), box)
        keys = content.keys(grid)
        return cls(content, keys, numbers, box, low).chosen(_order(keys, numbers))

    @classmethod
    def inside(
        cls, content: CubePoints, window: Window, grid: Grid
    ) -> tuple[SortedPoints | None, CubePoints, int]:
        """The points inside a window, those outside, and the number of those beyond the grid."""
        # By component: numpy is several times slower along an axis of three.
        axes = np.ascontiguousarray(content.points.T)
        cells, within = grid.cells(axes), grid.reaches(axes)
        inside = within & window.holds(cells)
        away = Cube().content
        if not inside.all():
            away = content.chosen(within & ~inside)
            content, cells = content.chosen(inside), cells[:, inside]
        new = cls.of(content, cells, grid) if len(content.points) else None
        return new, away, int(np.count_nonzero(~within))

    def chosen(self, rows: IntArray) -> SortedPoints:
        """Some of the points, in the order of ``rows``."""
        points, tags = self.content  # ``take`` is several times faster than an index on rows
        content = CubePoints(points.take(rows, axis=0), tags.take(rows, axis=0))
        return self._replace(content=content, keys=self.keys[rows], numbers=self.numbers[rows])

    def without(self, owner: int) -> SortedPoints | None:
        """The points of all other owners; None if there are none."""
        others = np.flatnonzero(self.content.tags[:, 0] != owner)
        return self.chosen(others) if len(others) else None

    def voxels(self) -> tuple[IntArray, dict[CubeIndex, slice]]:
        """(V,) the point with which each voxel begins, and the voxels of each cube."""
        keys, numbers = self.keys, self.numbers
        starts = run_starts((numbers[1:] != numbers[:-1]) | (keys[1:] != keys[:-1]))
        numbers = numbers[starts]
        heads = run_starts(numbers[1:] != numbers[:-1])
        cubes = (np.array(np.unravel_index(numbers[heads], self.box)) + self.low).T
        ends = np.append(heads[1:], len(numbers))
        parts = map(slice, heads.tolist(), ends.tolist())
        return starts, dict(zip(map(cube_index, cubes), parts, strict=True))

    def firsts(self) -> dict[CubeIndex, VoxelPoints]:
        """The first point of each voxel, by cube."""
        starts, parts = self.voxels()
        keys, points = self.keys[starts], self.content.points.take(starts, axis=0)
        tags = self.content.tags.take(starts, axis=0)
        return {
            index: VoxelPoints(keys[part], points[part], tags[part])
            for index, part in parts.items()
        }

    def sums(self) -> dict[CubeIndex, VoxelSums]:
        """Sums over the points of each voxel, by cube."""
        starts, parts = self.voxels()
        points, tags = self.content
        hows = np.add, np.minimum, np.maximum
        sums = (how.reduceat(points, starts, axis=0) for how in hows)
        counts = np.diff(np.append(starts, len(points))).astype(np.float64)
        columns: Columns = self.keys[starts], tags.take(starts, axis=0), *sums, counts
        return {
            index: VoxelSums(*(column[part] for column in columns)) for index, part in parts.items()
        }
