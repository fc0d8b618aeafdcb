"""kd-trees over the points of cubes that are searched together, kept while they can be used."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.types import FloatArray
from loam_gtsam.voxels.cubes import Cube
from loam_gtsam.voxels.grid import CubeIndex

_RECENT = 0.1
"""A tree is rebuilt when the points added since exceed this share of the points in it."""
_KEPT = 2
"""Sets of cubes whose trees are kept: a sensor on the border of a cube needs two in turn."""
# Measured on 100,000 voxel-sorted points: build 5.5 ms, against 8.4 ms with scipy's leaf of 16 and
# 18 ms balanced and compact; queries are as fast.
_TREE = {"leafsize": 32, "balanced_tree": False, "compact_nodes": False}


class Tree:
    """A kd-tree of points, given in parts (N, 3), which answers with the points themselves."""

    def __init__(self, parts: Sequence[FloatArray]) -> None:
        # The last row stands for a neighbour that is missing.
        self._points = np.concatenate([*parts, [[np.nan] * 3]])
        self._tree: Any = cKDTree(self.points, **_TREE)

    def __len__(self) -> int:
        return len(self._points) - 1

    @property
    def points(self) -> FloatArray:
        """(N, 3) metres."""
        return self._points[:-1]

    def nearest(
        self, queries: FloatArray, k: int, max_distance: float
    ) -> tuple[FloatArray, FloatArray]:
        """Points (M, k, 3) and squared distances (M, k); NaN and infinite if missing."""
        distances, found = self._tree.query(queries, k, distance_upper_bound=max_distance)
        squared: FloatArray = (distances * distances).reshape(-1, k)
        return self._points.take(found.reshape(-1, k), axis=0), squared


class CubeTrees:
    """kd-trees over the points of a set of cubes, while the points in these cubes do not change.

    Points added later are searched in a small tree of their own, until there are too many.
    """

    def __init__(self, cubes: set[CubeIndex], parts: Sequence[FloatArray]) -> None:
        self.cubes = cubes
        self._tree = Tree(parts)
        self._recent: list[FloatArray] = []
        self._recent_tree: Tree | None = None

    def __getstate__(self) -> tuple[set[CubeIndex], FloatArray, list[FloatArray]]:
        return self.cubes, self._tree.points, self._recent

    def __setstate__(self, state: tuple[set[CubeIndex], FloatArray, list[FloatArray]]) -> None:
        # A tree is a function of its points in their order.
        cubes, points, recent = state
        self.__init__(cubes, [points])  # type: ignore[misc]
        self._recent = recent

    def add(self, points: Mapping[CubeIndex, FloatArray]) -> None:
        """Take in points that were added to cubes; cubes that are not searched do not matter."""
        new = [part for index, part in points.items() if index in self.cubes and len(part)]
        if new:
            self._recent += new
            self._recent_tree = None

    @property
    def is_stale(self) -> bool:
        """Whether a new tree of all the points is due."""
        return sum(map(len, self._recent)) > _RECENT * len(self._tree)

    def nearest(
        self, queries: FloatArray, k: int, max_distance: float
    ) -> tuple[FloatArray, FloatArray]:
        """As :meth:`loam_gtsam.cubemap.CubeMap.nearest`, in these cubes."""
        points, squared = self._tree.nearest(queries, k, max_distance)
        if self._recent:
            if self._recent_tree is None:
                self._recent_tree = Tree(self._recent)
                self._recent = [self._recent_tree.points]
            more_points, more_squared = self._recent_tree.nearest(queries, k, max_distance)
            rows = np.flatnonzero(more_squared[:, 0] < squared[:, -1])
            points[rows], squared[rows] = _nearest_of_both(
                points[rows], squared[rows], more_points[rows], more_squared[rows]
            )
        return points, squared


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
                trees.add({index: cubes[index].points for index in sorted(new)})
                break
        else:
            trees = None
        if trees is None or trees.is_stale:
            for index in chosen:
                cubes[index].merge()
            trees = CubeTrees(chosen, [cubes[index].points for index in sorted(chosen)])
        self._kept = [*self._kept[1 - _KEPT :], trees]
        return trees

    def add(self, points: Mapping[CubeIndex, FloatArray]) -> None:
        """Take in points that were added to cubes."""
        for trees in self._kept:
            trees.add(points)

    def forget(self, cubes: Collection[CubeIndex]) -> None:
        """Drop the trees that hold points of any of these cubes, in which points have changed."""
        self._kept = [trees for trees in self._kept if trees.cubes.isdisjoint(cubes)]


def _nearest_of_both(
    points: FloatArray, squared: FloatArray, more_points: FloatArray, more_squared: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The k nearest of two answers; at equal distance the first answer goes first."""
    k = squared.shape[1]
    squared = np.concatenate((squared, more_squared), axis=1)
    points = np.concatenate((points, more_points), axis=1)
    order = np.argsort(squared, axis=1, kind="stable")[:, :k]
    return (
        np.take_along_axis(points, order[:, :, None], axis=1),
        np.take_along_axis(squared, order, axis=1),
    )
