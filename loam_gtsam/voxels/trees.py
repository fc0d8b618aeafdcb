"""kd-trees over the points of cubes that are searched together, kept while they can be used."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.types import FloatArray, IntArray
from loam_gtsam.voxels.cubes import Cube, CubePoints
from loam_gtsam.voxels.grid import CubeIndex
from loam_gtsam.voxels.tags import Views, tags_of, views

_RECENT = 0.1
"""A tree is rebuilt when the points added since exceed this share of the points in it."""
_KEPT = 2
"""Sets of cubes whose trees are kept: a sensor on the border of a cube needs two in turn."""
# Measured on 100,000 voxel-sorted points: build 5.5 ms, against 8.4 ms with scipy's leaf of 16 and
# 18 ms balanced and compact; queries are as fast.
_TREE = {"leafsize": 32, "balanced_tree": False, "compact_nodes": False}


class Neighbours(NamedTuple):
    """The k map points nearest to each of M queries, nearest first.

    Attributes
    ----------
    points : (M, k, 3) metres, map frame; NaN where there is no neighbour
    squared : (M, k) distances, square metres, ascending; infinite where there is none
    views : (M, k, 4) from where the points were seen, see :data:`loam_gtsam.voxels.tags.Views`
    """

    points: FloatArray
    squared: FloatArray
    views: Views

    @classmethod
    def none(cls, queries: int, k: int) -> Neighbours:
        """The answer of an empty map."""
        nowhere, far = np.full((queries, k, 3), np.nan), np.full((queries, k), np.inf)
        return cls(nowhere, far, np.zeros((queries, k, 4), np.int8))

    def of(self, queries: IntArray) -> Neighbours:
        """The neighbours of some of the queries."""
        return Neighbours(self.points[queries], self.squared[queries], self.views[queries])


class Tree:
    """A kd-tree of points, given in parts."""

    def __init__(self, parts: Sequence[CubePoints]) -> None:
        # The last row stands for a neighbour that is missing.
        self._points = np.concatenate([*(part.points for part in parts), [[np.nan] * 3]])
        self._tags = np.concatenate([*(part.tags for part in parts), tags_of(1, 0)])
        self._tree: Any = cKDTree(self._points[:-1], **_TREE)

    def __len__(self) -> int:
        return len(self._points) - 1

    @property
    def content(self) -> CubePoints:
        """The points and their tags."""
        return CubePoints(self._points[:-1], self._tags[:-1])

    def nearest(
        self, queries: FloatArray, k: int, max_distance: float
    ) -> tuple[FloatArray, IntArray]:
        """Distances (M, k), infinite if missing, and rows (M, k) of points."""
        distances, found = self._tree.query(queries, k, distance_upper_bound=max_distance)
        return distances.reshape(-1, k), found.reshape(-1, k)

    def at(self, rows: IntArray) -> CubePoints:
        """Points (..., 3) and tags (..., 2) at rows (...); those of negative rows mean nothing."""
        points = self._points.take(rows, axis=0, mode="clip")
        return CubePoints(points, self._tags.take(rows, axis=0, mode="clip"))


class CubeTrees:
    """kd-trees over the points of a set of cubes, while the points in these cubes do not change.

    Points added later are searched in a small tree of their own, until there are too many.
    """

    def __init__(self, cubes: set[CubeIndex], parts: Sequence[CubePoints]) -> None:
        self.cubes = cubes
        self._tree = Tree(parts)
        self._recent: list[CubePoints] = []
        self._recent_tree: Tree | None = None

    def __getstate__(self) -> tuple[set[CubeIndex], CubePoints, list[CubePoints]]:
        return self.cubes, self._tree.content, self._recent

    def __setstate__(self, state: tuple[set[CubeIndex], CubePoints, list[CubePoints]]) -> None:
        # A tree is a function of its points in their order.
        cubes, content, recent = state
        self.__init__(cubes, [content])  # type: ignore[misc]
        self._recent = recent

    def add(self, points: Mapping[CubeIndex, CubePoints]) -> None:
        """Take in points that were added to cubes; cubes that are not searched do not matter."""
        new = [part for index, part in points.items() if index in self.cubes and len(part.points)]
        if new:
            self._recent += new
            self._recent_tree = None

    @property
    def is_stale(self) -> bool:
        """Whether a new tree of all the points is due."""
        return sum(len(part.points) for part in self._recent) > _RECENT * len(self._tree)

    def nearest(self, queries: FloatArray, k: int, max_distance: float) -> Neighbours:
        """As :meth:`loam_gtsam.cubemap.CubeMap.nearest`, in these cubes."""
        distances, found = self._tree.nearest(queries, k, max_distance)
        if not self._recent:
            points, tags = self._tree.at(found)
            return Neighbours(points, distances * distances, views(tags))
        if self._recent_tree is None:
            self._recent_tree = Tree(self._recent)
            self._recent = [self._recent_tree.content]
        more, more_found = self._recent_tree.nearest(queries, k, max_distance)
        rows = np.flatnonzero(more[:, 0] < distances[:, -1])
        both = np.hstack((distances[rows], more[rows]))
        order = both.argsort(axis=1, kind="stable")[:, :k]  # the first tree goes first if equal
        order += 2 * k * np.arange(len(rows))[:, None]  # in flat arrays, the fastest to take from
        # Rows of the recent tree are negative until both are gathered.
        merged = np.hstack((found[rows], ~more_found[rows])).take(order)
        distances[rows], found[rows] = both.take(order), merged
        points, tags = self._tree.at(found)
        query, place = np.nonzero(merged < 0)
        recent = self._recent_tree.at(~merged[query, place])
        points[rows[query], place], tags[rows[query], place] = recent
        return Neighbours(points, distances * distances, views(tags))


class TreeCache:
    """The trees of the sets of cubes that were searched last."""

    def __init__(self) -> None:
        self._kept: list[CubeTrees] = []  # the one used last comes last

    def over(self, chosen: set[CubeIndex], cubes: Mapping[CubeIndex, Cube]) -> CubeTrees:
        """Trees over the points of the chosen ones of all cubes: kept trees if they fit."""
        for trees in reversed(self._kept):
            if trees.cubes <= chosen:  # with others it would find points of cubes not asked for
                self._kept.remove(trees)
                new = chosen - trees.cubes
                trees.cubes |= new
                trees.add({index: cubes[index].content for index in sorted(new)})
                break
        else:
            trees = None
        if trees is None or trees.is_stale:
            for index in chosen:
                cubes[index].merge()
            trees = CubeTrees(chosen, [cubes[index].content for index in sorted(chosen)])
        self._kept = [*self._kept[1 - _KEPT :], trees]
        return trees

    def add(self, points: Mapping[CubeIndex, CubePoints]) -> None:
        """Take in points that were added to cubes."""
        for trees in self._kept:
            trees.add(points)

    def forget(self, cubes: Collection[CubeIndex]) -> None:
        """Drop the trees that hold points of any of these cubes, in which points have changed."""
        self._kept = [trees for trees in self._kept if trees.cubes.isdisjoint(cubes)]
