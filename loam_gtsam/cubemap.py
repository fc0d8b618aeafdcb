"""The map of one feature class: points in cubes, a window that follows the sensor, an archive.

A cube of 50 m is named by its absolute index ``floor((x + 25) / 50)``, so cube (0, 0, 0) is
centred on the map origin and nothing has to be moved when the sensor travels. The cubes of a
window of 21 x 21 x 11 around the sensor are in use (LOAM, laserMapping); what leaves the window is
archived and comes back with it.

Points of a cube are sorted by voxel. An insert then finds the voxels it hits by bisection, and a
kd-tree builds in half the time that it takes on unordered points. One tree holds all
cubes that are searched together: a sweep touches a dozen, most of them with a handful of points.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from loam_gtsam.config import MapConfig
from loam_gtsam.geometry import (
    as_array,
    as_points,
    as_vector,
    find_in_sorted,
    transform,
    voxel_keys,
)
from loam_gtsam.types import BoolArray, ConfigError, FloatArray, InputError, IntArray
from loam_gtsam.voxels.archive import Archive, CubeIndex, CubePoints, Owners

_COS_VIEW = np.sqrt(3.0) / 2.0  # cos 30 degrees: LOAM's field of view is 30 to 150 off the up axis
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3))).T[:, None]  # of a cube, from its centre
_VOXEL_LIMIT = (1 << 20) - 1  # voxels on either side of the origin that voxel_keys tells apart
_RECENT = 0.1  # a tree is rebuilt when points added since exceed this share of those in it
_WAITING = 0.1  # new points of a cube are merged in when they exceed this share of the others
_SEARCHES = 2  # trees that are kept: a sensor that stands on the border of a cube needs two in turn
# Measured on 100,000 voxel-sorted points: build 5.5 ms, against 8.4 ms with scipy's leaf of 16 and
# 18 ms balanced and compact; queries are as fast.
_TREE = {"leafsize": 32, "balanced_tree": False, "compact_nodes": False}
_NO_POINTS: FloatArray = np.empty((0, 3))
_NO_KEYS: IntArray = np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class CubeMapStats:
    """Where the points of a map are, and how many went missing.

    Attributes
    ----------
    cubes, points : in the window now
    archived, archived_points : cubes and points in the archive now, in memory or on disk
    evicted, restored : cubes that ever went into the archive, and came back
    dropped_cubes, dropped_points : lost for good: beyond the archive's memory, or unreadable
    outside : points offered to :meth:`CubeMap.insert` outside the window and not taken
    """

    cubes: int
    points: int
    archived: int
    archived_points: int
    evicted: int
    restored: int
    dropped_cubes: int
    dropped_points: int
    outside: int


class CubeMap:
    """Map points of one feature class, at most one per voxel, searchable around the sensor.

    Parameters
    ----------
    config : cubes, window, neighbourhood, insertion policy and archive
    voxel_size : metres; the voxel grid is anchored at the map origin

    Attributes
    ----------
    owner : number that points inserted from now on carry, see :meth:`move`

    Raises
    ------
    ConfigError
        If ``voxel_size`` is not positive, or no folder can be made in ``config.archive_dir``.
    """

    def __init__(self, config: MapConfig, voxel_size: float) -> None:
        if not 0.0 < voxel_size < np.inf:
            raise ConfigError(f"voxel_size: expected metres above 0, got {voxel_size!r}")
        self._config = config
        self._voxel_size = float(voxel_size)
        self._cubes: dict[CubeIndex, _Cube] = {}
        self.owner = 0
        self._searches: list[_Search] = []  # the last one used comes last
        self._archive = Archive(config.archive_megabytes, config.archive_dir)
        self._shape = np.array(config.window, dtype=np.int64)
        self._low = -(self._shape // 2)
        self._evicted = self._restored = self._outside = 0

    @property
    def window(self) -> tuple[CubeIndex, CubeIndex]:
        """First and last cube of the window."""
        return _index(self._low), _index(self._low + self._shape - 1)

    @property
    def stats(self) -> CubeMapStats:
        """Counters of this moment."""
        return CubeMapStats(
            cubes=len(self._cubes),
            points=self.count(),
            archived=len(self._archive),
            archived_points=self._archive.count(),
            evicted=self._evicted,
            restored=self._restored,
            dropped_cubes=self._archive.dropped_cubes,
            dropped_points=self._archive.dropped_points,
            outside=self._outside,
        )

    def recenter(self, position: FloatArray) -> int:
        """Shift the window if the sensor is within ``window_margin`` cubes of its edge.

        Cubes that fall out are archived, archived ones that fall in are restored. The window moves
        no farther than needed. A margin that leaves no room is cut to half the window.

        Parameters
        ----------
        position : (3,) sensor position, metres, map frame

        Returns
        -------
        Cubes evicted by this call.

        Raises
        ------
        InputError
            If the position is not three finite numbers in range of the voxel grid.
        """
        cell = self._cell_of(position)
        margin = np.minimum(self._config.window_margin, (self._shape - 1) // 2)
        low = np.clip(self._low, cell - (self._shape - 1 - margin), cell - margin)
        if np.array_equal(low, self._low):
            return 0
        self._low = low
        leaving = [index for index in self._cubes if not self._in_window(index)]
        # Restore first: storing may push the oldest cubes out of the archive.
        for index in self._archive.indices():
            if self._in_window(index):
                content = self._archive.take(index)
                if content is not None:
                    self._cubes[index] = _Cube(self._by_voxel(content))
                    self._restored += 1
        self._searches = [kept for kept in self._searches if kept.cubes.isdisjoint(leaving)]
        for index in leaving:
            self._archive.store(index, self._cubes.pop(index).content)
        self._evicted += len(leaving)
        return len(leaving)

    def neighbourhood(self, map_T_lidar: FloatArray) -> tuple[CubeIndex, ...]:
        """Cubes around the sensor's that hold points and, if configured, are in its view.

        A cube is in view if the direction to any of its 8 corners is 30 to 150 degrees off the
        sensor's up axis (LOAM, laserMapping; A-LOAM has no such test).

        Parameters
        ----------
        map_T_lidar : (4, 4) sensor pose

        Returns
        -------
        Indices in ascending order.

        Raises
        ------
        InputError
            If the pose is not a finite (4, 4) array in range of the voxel grid.
        """
        pose = as_array(map_T_lidar, "map_T_lidar", (4, 4))
        cell = self._cell_of(pose[:3, 3])
        shape = np.array(self._config.neighbourhood)
        low = (cell - shape // 2).tolist()
        high = (cell - shape // 2 + shape).tolist()
        around = tuple(
            sorted(
                (x, y, z)
                for x, y, z in self._cubes
                if low[0] <= x < high[0] and low[1] <= y < high[1] and low[2] <= z < high[2]
            )
        )
        if not around or not self._config.field_of_view:
            return around
        corners = self._config.cube_size * (np.array(around).T[:, :, None] + _CORNERS)
        rays = corners - pose[:3, 3, None, None]
        up = np.tensordot(pose[:3, 2], rays, axes=1)
        visible = (up**2 < _COS_VIEW**2 * (rays**2).sum(axis=0)).any(axis=1)
        return tuple(index for index, seen in zip(around, visible.tolist(), strict=True) if seen)

    def insert(self, points_map: NDArray[np.floating]) -> None:
        """Add points; each voxel keeps one.

        With the policy ``centroid`` a voxel holds the mean of the point it had and the new ones,
        the old one counting once: what LOAM's voxel filter does to a cube after each sweep. With
        ``settled`` the first point of a voxel stays, a cube in which no new voxel got occupied is
        unchanged, and search trees are kept while few of their points are new. Points outside the
        window, or beyond the voxel grid (about 2^20 voxels from the origin), are not taken and
        counted in ``stats.outside``.

        Parameters
        ----------
        points_map : (N, 3) metres, map frame

        Raises
        ------
        InputError
            If the array is not (N, 3) floats, all finite; the map is then unchanged.
        """
        points = as_points(points_map, "points_map")
        self._put(points, np.full(len(points), self.owner, np.int32))

    def move(self, moves: Mapping[int, FloatArray]) -> int:
        """Move points of the window and of the archive, after a loop closure.

        Where one comes to lie in the voxel of another, the one that was not moved stays; of two
        that were moved, that of the lower owner.

        Parameters
        ----------
        moves : (4, 4) rigid transforms in the map frame, by the owner of the points

        Returns
        -------
        Points moved.
        """
        owners = np.array(sorted(moves), np.int32)
        taken = [cube.take_out(owners) for cube in self._cubes.values()]
        for index in self._archive.indices():
            content = self._archive.read(index)
            if content is not None and np.isin(content.owners, owners).any():
                cube = self._unarchived(index)
                taken.append(cube.take_out(owners))
                self._archive.store(index, cube.content)
        self._searches = []
        count = 0
        for owner in owners.tolist():
            parts = [part.points[part.owners == owner] for part in taken]
            points = transform(moves[owner], np.concatenate([_NO_POINTS, *parts]))
            self._put(points, np.full(len(points), owner, np.int32), archive=True)
            count += len(points)
        return count

    def moved_points(self, moves: Mapping[int, FloatArray]) -> FloatArray:
        """Points of the whole map as they would be after :meth:`move`; the map does not change.

        Parameters
        ----------
        moves : (4, 4) rigid transforms in the map frame, by the owner of the points
        """
        copy = CubeMap(self._config.changed(archive_dir=None), self._voxel_size)
        copy._low = self._low
        copy._cubes = {index: cube.copy() for index, cube in self._cubes.items()}
        copy._archive = Archive(np.inf, None)
        for index in self._archive.indices():
            content = self._archive.read(index)
            if content is not None:
                copy._archive.store(index, content)
        copy.move(moves)
        return copy.points(archived=True)

    def _put(self, points: FloatArray, owners: Owners, *, archive: bool = False) -> None:
        """Insert points; with ``archive`` those outside the window go there."""
        # By component: numpy is several times slower along an axis of three.
        axes = np.ascontiguousarray(points.T)
        places = self._cells(axes) - self._low[:, None]
        inside = ((places >= 0) & (places < self._shape[:, None])).all(axis=0)
        inside &= (np.abs(axes) < _VOXEL_LIMIT * self._voxel_size).all(axis=0)
        if not inside.all():
            if archive:
                self._put_away(points[~inside], owners[~inside])
            else:
                self._outside += int(np.count_nonzero(~inside))
            points, owners, places = points[inside], owners[inside], places[:, inside]
        if len(points) == 0:
            return
        slots: IntArray = np.ravel_multi_index(tuple(places.astype(np.int64)), self._shape)
        keys = voxel_keys(points, self._voxel_size)
        order = np.lexsort((keys, slots))  # stable: points of a voxel stay in the order given
        # take is several times faster than an index on rows.
        points = points.take(order, axis=0)
        keys, slots, owners = keys[order], slots[order], owners[order]
        first = _starts((slots[1:] != slots[:-1]) | (keys[1:] != keys[:-1]))
        slots = slots[first]
        starts = _starts(slots[1:] != slots[:-1])
        cells = np.transpose(np.unravel_index(slots[starts], self._shape)) + self._low
        found = [_index(cell) for cell in cells]
        cubes = [self._cubes.setdefault(cell, _Cube()) for cell in found]
        stops = np.append(starts[1:], len(slots)).tolist()
        parts = [slice(*ends) for ends in zip(starts.tolist(), stops, strict=True)]
        owners = owners[first]
        if self._config.insertion == "settled":
            keys, points = keys[first], points.take(first, axis=0)
            added = {
                cell: cube.settle(_Content(keys[part], points[part], owners[part]))
                for cell, cube, part in zip(found, cubes, parts, strict=True)
            }
            for search in self._searches:
                search.add(added)
        else:
            voxels = _group(points, keys, first)
            for cube, part in zip(cubes, parts, strict=True):
                cube.average(voxels.part(part), owners[part])
            self._searches = [kept for kept in self._searches if kept.cubes.isdisjoint(found)]

    def _put_away(self, points: FloatArray, owners: Owners) -> None:
        """Put points into the archive; those beyond the voxel grid are not taken."""
        far = (np.abs(points) >= _VOXEL_LIMIT * self._voxel_size).any(axis=1)
        self._outside += int(np.count_nonzero(far))
        points, owners = points[~far], owners[~far]
        cells = self._cells(points).astype(np.int64)
        found, numbers = np.unique(cells, axis=0, return_inverse=True)
        for number, cell in enumerate(found):
            here = numbers.ravel() == number
            cube = self._unarchived(_index(cell))
            new = self._by_voxel(CubePoints(points[here], owners[here]))
            first = _starts(new.keys[1:] != new.keys[:-1])
            cube.settle(new.at(first))
            self._archive.store(_index(cell), cube.content)

    def _unarchived(self, index: CubeIndex) -> _Cube:
        """A cube out of the archive; an empty one if it is not there or cannot be read."""
        content = self._archive.take(index) if index in self._archive else None
        return _Cube() if content is None else _Cube(self._by_voxel(content))

    def _by_voxel(self, content: CubePoints) -> _Content:
        keys = voxel_keys(content.points, self._voxel_size)
        order = np.argsort(keys, kind="stable")
        return _Content(keys[order], content.points[order], content.owners[order])

    def nearest(
        self,
        queries: NDArray[np.floating],
        k: int,
        max_distance: float,
        cubes: Iterable[CubeIndex],
    ) -> tuple[FloatArray, FloatArray]:
        """The k nearest points of the given cubes to each query, exactly, also across borders.

        Parameters
        ----------
        queries : (M, 3) metres, map frame
        k : neighbours a query
        max_distance : metres; only points nearer than this count. May be infinite.
        cubes : as from :meth:`neighbourhood`; cubes that hold no points are allowed

        Returns
        -------
        points : (M, k, 3) metres, map frame, nearest first; NaN where there is no neighbour
        squared_distances : (M, k) square metres, ascending; infinite where there is none

        Raises
        ------
        InputError
            If ``queries`` is not (M, 3) finite floats, ``k`` < 1 or ``max_distance`` not positive.

        Notes
        -----
        The same calls in the same order give the same answer; the order of points at equal distance
        is otherwise unspecified.
        """
        queries = as_points(queries, "queries")
        if k < 1:
            raise InputError(f"k: expected at least 1, got {k}")
        if not max_distance > 0.0:
            raise InputError(f"max_distance: expected metres above 0, got {max_distance}")
        held = {index for index in cubes if index in self._cubes}
        if not held or len(queries) == 0:
            return np.full((len(queries), k, 3), np.nan), np.full((len(queries), k), np.inf)
        return self._search(held).nearest(queries, k, max_distance)

    def _search(self, held: set[CubeIndex]) -> _Search:
        """Trees of the cubes: those of an earlier search if they fit."""
        for search in reversed(self._searches):
            if search.cubes <= held:  # with others it would find points of cubes not asked for
                self._searches.remove(search)
                new = held - search.cubes
                search.cubes |= new
                search.add({index: self._cubes[index].points for index in sorted(new)})
                break
        else:
            search = _Search(held, self._parts(held))
        if search.is_stale:
            search = _Search(held, self._parts(held))
        self._searches = [*self._searches[1 - _SEARCHES :], search]
        return search

    def points(
        self, cubes: Iterable[CubeIndex] | None = None, *, archived: bool = False
    ) -> FloatArray:
        """Map points, ordered by cube and voxel, (N, 3) metres, map frame, a copy.

        Parameters
        ----------
        cubes : which; all cubes of the window when None
        archived : with ``cubes=None``, include the archive: the whole map
        """
        if cubes is not None:
            parts = self._parts({index for index in cubes if index in self._cubes})
        else:
            everywhere = {index: cube.points for index, cube in self._cubes.items()}
            if archived:
                for index in self._archive.indices():
                    stored = self._archive.read(index)
                    if stored is not None:
                        everywhere[index] = stored.points
            parts = [everywhere[index] for index in sorted(everywhere)]
        return np.concatenate([_NO_POINTS, *parts])

    def _parts(self, held: set[CubeIndex]) -> list[FloatArray]:
        """Points of cubes of the window, in the order of the cubes."""
        return [self._cubes[index].points for index in sorted(held)]

    def thinned(self, factor: float) -> CubeMap:
        """The points of the window in a map of their own, with voxels this times as large."""
        config = self._config.changed(insertion="centroid", archive_dir=None)
        thin = CubeMap(config, factor * self._voxel_size)
        thin._low = self._low
        thin.insert(self.points())
        return thin

    def count(self, cubes: Iterable[CubeIndex] | None = None) -> int:
        """Points in the given cubes, or in the whole window."""
        if cubes is None:
            return sum(map(len, self._cubes.values()))
        return sum(len(self._cubes[index]) for index in set(cubes) & self._cubes.keys())

    def _in_window(self, index: CubeIndex) -> bool:
        return all(
            0 <= i - low < n for i, low, n in zip(index, self._low, self._shape, strict=True)
        )

    def _cell_of(self, position: FloatArray) -> IntArray:
        """Index of the sensor's cube, (3,)."""
        position = as_vector(position, "position")
        limit = _VOXEL_LIMIT * self._voxel_size
        if np.abs(position).max() >= limit:
            raise InputError(
                f"position: expected coordinates within {limit:.0f} m of the map origin (the voxel "
                f"grid ends there), got {position.tolist()}; start the map nearer, or use a larger "
                "voxel"
            )
        cell: IntArray = self._cells(position).astype(np.int64)
        return cell

    def _cells(self, points: FloatArray) -> FloatArray:
        """Cube coordinates of points, as floats: far or infinite points must not overflow."""
        size = self._config.cube_size
        cells: FloatArray = np.floor((points + 0.5 * size) / size)
        return cells


class _Voxels(NamedTuple):
    """New points by voxel, V voxels in ascending order of their keys."""

    keys: IntArray
    sums: FloatArray
    counts: FloatArray
    lows: FloatArray
    highs: FloatArray

    def part(self, which: slice) -> _Voxels:
        return _Voxels(*[column[which] for column in self])  # type: ignore[arg-type]


class _Tree:
    """A kd-tree, and a row of NaN behind its points, which stands for a neighbour that is missing.

    Parameters
    ----------
    parts : (N, 3) each, metres
    """

    def __init__(self, parts: Sequence[FloatArray]) -> None:
        self._points = np.concatenate([*parts, [[np.nan] * 3]])
        self._tree: Any = cKDTree(self.points, **_TREE)

    def __len__(self) -> int:
        return len(self._points) - 1

    @property
    def points(self) -> FloatArray:
        """(N, 3) metres."""
        return self._points[:-1]

    def query(
        self, queries: FloatArray, k: int, max_distance: float
    ) -> tuple[FloatArray, FloatArray]:
        """Points (M, k, 3) and squared distances (M, k); NaN and infinite if missing."""
        distances, found = self._tree.query(queries, k, distance_upper_bound=max_distance)
        squared: FloatArray = (distances * distances).reshape(-1, k)
        return self._points.take(found.reshape(-1, k), axis=0), squared


class _Search:
    """kd-trees over the points of a set of cubes, while the points in them do not change.

    Points added later are searched in a small tree of their own until there are too many.
    """

    def __init__(self, cubes: set[CubeIndex], parts: Sequence[FloatArray]) -> None:
        self.cubes = cubes
        self._tree = _Tree(parts)
        self._recent: list[FloatArray] = []
        self._recent_tree: _Tree | None = None

    def __getstate__(self) -> tuple[set[CubeIndex], FloatArray, list[FloatArray]]:
        return self.cubes, self._tree.points, self._recent

    def __setstate__(self, state: tuple[set[CubeIndex], FloatArray, list[FloatArray]]) -> None:
        # A tree is a function of its points in their order.
        cubes, points, recent = state
        self.__init__(cubes, [points])  # type: ignore[misc]
        self._recent = recent

    def add(self, points: Mapping[CubeIndex, FloatArray]) -> None:
        """Points that were added to cubes; other cubes than those searched do not matter."""
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
        """As :meth:`CubeMap.nearest`, in these cubes."""
        points, squared = self._tree.query(queries, k, max_distance)
        if self._recent:
            if self._recent_tree is None:
                self._recent_tree = _Tree(self._recent)
                self._recent = [self._recent_tree.points]
            more_points, more_squared = self._recent_tree.query(queries, k, max_distance)
            rows = np.flatnonzero(more_squared[:, 0] < squared[:, -1])
            points[rows], squared[rows] = _merge(
                points[rows], squared[rows], more_points[rows], more_squared[rows]
            )
        return points, squared


class _Content(NamedTuple):
    """Points in ascending order of their voxel keys, and who owns them."""

    keys: IntArray
    points: FloatArray
    owners: Owners

    def at(self, rows: IntArray) -> _Content:
        """Some of them, rows in ascending order."""
        return _Content(
            self.keys.take(rows), self.points.take(rows, axis=0), self.owners.take(rows)
        )

    def joined(self, new: _Content) -> _Content:
        """Both; no key is in both."""
        if len(self.keys) == 0:
            return new
        keys = np.concatenate((self.keys, new.keys))
        # merges two sorted runs; half of np.insert's time
        order = np.argsort(keys, kind="stable")
        return _Content(
            keys[order],
            np.concatenate((self.points, new.points)).take(order, axis=0),
            np.concatenate((self.owners, new.owners))[order],
        )


_EMPTY = _Content(_NO_KEYS, _NO_POINTS, np.empty(0, np.int32))


class _Cube:
    """Points, at most one a voxel.

    New ones wait beside the others until they are many, or all are asked for: merging takes time
    in proportion to all points of the cube, which get more with every visit.
    """

    __slots__ = ("_new", "_old")

    def __init__(self, content: _Content = _EMPTY) -> None:
        self._old, self._new = content, _EMPTY

    def __len__(self) -> int:
        return len(self._old.keys) + len(self._new.keys)

    @property
    def points(self) -> FloatArray:
        """(N, 3) metres, in the order of their voxels."""
        self._take_in()
        return self._old.points

    @property
    def content(self) -> CubePoints:
        """All that is kept of the cube in an archive."""
        self._take_in()
        return CubePoints(self._old.points, self._old.owners)

    def copy(self) -> _Cube:
        """A cube of the same points, which changes on its own."""
        keys, points, owners = self._old.joined(self._new)
        return _Cube(_Content(keys.copy(), points.copy(), owners.copy()))

    def average(self, new: _Voxels, owners: Owners) -> None:
        """Mean of the point a voxel has, if any, and the new ones; the owner stays."""
        self._take_in()
        at, taken = find_in_sorted(self._old.keys, new.keys)
        held = self._old.points
        old = held[at[taken]]
        sums, counts, lows, highs = new.sums, new.counts, new.lows, new.highs
        sums[taken] += old
        counts[taken] += 1.0
        lows[taken] = np.minimum(lows[taken], old)
        highs[taken] = np.maximum(highs[taken], old)
        # Rounding may put a mean just outside its points, and so into another voxel or cube.
        means = np.clip(sums / counts[:, None], lows, highs)
        held[at[taken]] = means[taken]
        self._new = _Content(new.keys[~taken], means[~taken], owners[~taken])

    def settle(self, new: _Content) -> FloatArray:
        """Add the points whose voxels are free, and return them."""
        for held in (self._old.keys, self._new.keys):
            taken = find_in_sorted(held, new.keys)[1]
            new = new.at(np.flatnonzero(~taken)) if taken.any() else new
        if len(new.keys):
            self._new = self._new.joined(new)
            if len(self._new.keys) > _WAITING * len(self._old.keys):
                self._take_in()
        return new.points

    def take_out(self, owners: Owners) -> CubePoints:
        """Remove the points of some owners, and return them."""
        self._take_in()
        out = np.isin(self._old.owners, owners)
        if not out.any():
            return CubePoints(_NO_POINTS, _EMPTY.owners)
        gone = self._old.at(np.flatnonzero(out))
        self._old = self._old.at(np.flatnonzero(~out))
        return CubePoints(gone.points, gone.owners)

    def _take_in(self) -> None:
        """Put the new ones in their places."""
        if len(self._new.keys):
            self._old, self._new = self._old.joined(self._new), _EMPTY


def _group(points: FloatArray, keys: IntArray, first: IntArray) -> _Voxels:
    """Reduce points sorted by voxel; ``first`` are the indices at which a voxel begins."""
    return _Voxels(
        keys=keys[first],
        sums=np.add.reduceat(points, first, axis=0),
        counts=np.diff(np.append(first, len(points))).astype(np.float64),
        lows=np.minimum.reduceat(points, first, axis=0),
        highs=np.maximum.reduceat(points, first, axis=0),
    )


def _starts(changes: BoolArray) -> IntArray:
    """Where the runs of a non-empty sequence begin, from ``sequence[1:] != sequence[:-1]``."""
    return np.flatnonzero(np.concatenate(([True], changes)))


def _merge(
    points: FloatArray, squared: FloatArray, more_points: FloatArray, more_squared: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The k nearest of two answers; at equal distance the first answer goes first."""
    k = squared.shape[1]
    squared = np.concatenate((squared, more_squared), axis=1)
    points = np.concatenate((points, more_points), axis=1)
    pick = np.argsort(squared, axis=1, kind="stable")[:, :k]
    return (
        np.take_along_axis(points, pick[:, :, None], axis=1),
        np.take_along_axis(squared, pick, axis=1),
    )


def _index(cell: IntArray) -> CubeIndex:
    x, y, z = cell.tolist()
    return x, y, z
