"""The map of one feature class: points in cubes, a window that follows the sensor, an archive.

A cube of 50 m is named by its absolute index ``floor((x + 25) / 50)``, so cube (0, 0, 0) is
centred on the map origin and nothing has to be moved when the sensor travels. The cubes of a
window of 21 x 21 x 11 around the sensor are in use (LOAM, laserMapping); what leaves the window is
archived and comes back with it.

Points of a cube are sorted by voxel. An insert then finds the voxels it hits by bisection, and a
kd-tree builds in half the time. One tree holds all cubes that are searched together: a sweep
touches a dozen, most of them with a handful of points. See :mod:`loam_gtsam.voxels`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.config import MapConfig
from loam_gtsam.geometry import OBLIQUE_EDGE, as_array, as_points
from loam_gtsam.types import ConfigError, FloatArray, InputError
from loam_gtsam.voxels.archive import Archive
from loam_gtsam.voxels.cubes import (
    NO_POINTS,
    Cube,
    CubePoints,
    SortedPoints,
    joined,
    mark_second,
)
from loam_gtsam.voxels.grid import CubeIndex, Grid, Window, cubes_in_view
from loam_gtsam.voxels.tags import Faces, look, tags_of
from loam_gtsam.voxels.trees import Neighbours, TreeCache

Chosen = Iterable[CubeIndex] | None
"""Cubes to be looked at; None is all cubes of the window."""
Contents = dict[CubeIndex, CubePoints]
"""Points and tags by cube, ascending."""


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


def grid_of(config: MapConfig, voxel_size: float) -> Grid:
    """Cubes and voxels of a map: LOAM's voxels lie along its axes, ``settled`` ones obliquely."""
    return Grid(config.cube_size, float(voxel_size), oblique=config.insertion == "settled")


def _empty_archive(grid: Grid, config: MapConfig) -> Archive:
    return Archive(grid, config.archive_megabytes, config.archive_dir)


class CubeMap:
    """Map points of one feature class, at most one per voxel, searchable around the sensor.

    Parameters
    ----------
    config : cubes, window, neighbourhood, insertion policy and archive
    voxel_size : metres; the voxel grid is anchored at the map origin, and oblique if ``settled``
    archive : cubes outside the window, those of a saved map for example; an empty one if None

    Attributes
    ----------
    owner : number that points inserted from now on carry, see :meth:`move`

    Raises
    ------
    ConfigError
        If ``voxel_size`` is not positive, or nothing can be written in ``config.archive_dir``.
    """

    def __init__(self, config: MapConfig, voxel_size: float, archive: Archive | None = None):
        if not 0.0 < voxel_size < np.inf:
            raise ConfigError(f"voxel_size: expected metres above 0, got {voxel_size!r}")
        self._config = config
        self._grid = grid_of(config, voxel_size)
        self._window = Window.around((0, 0, 0), config.window)
        self._trees = TreeCache()
        self._archive = _empty_archive(self._grid, config) if archive is None else archive
        inside = self._window.choose(self._archive.indices())
        self._cubes = {index: self._archive.take(index) or Cube() for index in inside}
        self.owner = 0
        self._evicted = self._restored = self._outside = 0

    @property
    def window(self) -> tuple[CubeIndex, CubeIndex]:
        """First and last cube of the window."""
        return self._window.first, self._window.last

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
        """Shift the window, no farther than needed, if its edge is within ``window_margin`` cubes.

        Cubes that fall out are archived, archived ones that fall in are restored. Returns the
        number of cubes evicted.

        Parameters
        ----------
        position : (3,) sensor position, metres, map frame

        Raises
        ------
        InputError
            If the position is not three finite numbers in range of the voxel grid.
        """
        window = self._window.following(self._grid.cube_of(position), self._config.window_margin)
        if window == self._window:
            return 0
        self._window = window
        staying = set(window.choose(self._cubes))
        leaving = [index for index in self._cubes if index not in staying]
        # Restore first: storing may push the oldest cubes out of the archive.
        for index in window.choose(self._archive.indices()):
            cube = self._archive.take(index)
            if cube is not None:
                self._cubes[index] = cube
                self._restored += 1
        self._trees.forget(leaving)
        for index in leaving:
            self._archive.store(index, self._cubes.pop(index).content)
        self._evicted += len(leaving)
        return len(leaving)

    def neighbourhood(self, map_T_lidar: FloatArray) -> tuple[CubeIndex, ...]:
        """Cubes around the sensor's that hold points and, if configured, are in view; ascending.

        ``map_T_lidar`` is the (4, 4) sensor pose. Raises InputError if it is not finite, or out of
        range of the voxel grid.
        """
        cubes = self.surroundings(map_T_lidar)
        if not cubes or not self._config.field_of_view:
            return cubes
        return cubes_in_view(cubes, map_T_lidar, self._grid.cube_size)

    def surroundings(self, map_T_lidar: FloatArray) -> tuple[CubeIndex, ...]:
        """As :meth:`neighbourhood`, in view or not."""
        pose = as_array(map_T_lidar, "map_T_lidar", (4, 4))
        around = Window.around(self._grid.cube_of(pose[:3, 3]), self._config.neighbourhood)
        return tuple(sorted(around.choose(self._cubes)))

    def insert(
        self,
        points_map: NDArray[np.floating],
        seen_from: NDArray[np.floating] | None = None,
        faces: Faces | None = None,
    ) -> None:
        """Add points; each voxel keeps one, and one more of a surface that faces the other way.

        With the policy ``centroid`` a voxel holds the mean of the point it had and the new ones,
        the old one counting once: what LOAM's voxel filter does to a cube after each sweep. With
        ``settled`` the first point of a voxel stays, and search trees are kept while few of their
        points are new. Points outside the window, or beyond the voxel grid (about 2^20 voxels from
        the origin), are not taken and counted in ``stats.outside``.

        Parameters
        ----------
        points_map : (N, 3) metres, map frame
        seen_from : (3,) or (N, 3) positions of the lidar, metres, map frame; None if not known. The
            policy ``centroid`` has no use for them: a mean may be of several surfaces.
        faces : those points that may be second in voxels whose first points are on another side

        Raises
        ------
        InputError
            If the array is not (N, 3) floats, all finite; the map is then unchanged.
        """
        points = as_points(points_map, "points_map")
        tags = tags_of(len(points), self.owner)
        if seen_from is not None and self._config.insertion == "settled":
            look(tags, points, seen_from)
            if faces is not None:
                mark_second(CubePoints(points, tags), faces, self._cubes, self._grid)
        self.insert_sorted(self.sorted(CubePoints(points, tags)))

    def sorted(self, content: CubePoints, *, archive: bool = False) -> SortedPoints | None:
        """Points for :meth:`insert_sorted`; None if no point is inside the window.

        Those outside are counted, or put into the archive if asked.
        """
        new, away, beyond = SortedPoints.inside(content, self._window, self._grid)
        if archive:
            self._archive.settle(away)
        self._outside += beyond + (0 if archive else len(away.points))
        return new

    def insert_sorted(self, new: SortedPoints | None, *, settle: bool = False) -> None:
        """Add points that :meth:`sorted` returned for this window, by the policy or to settle."""
        if new is None:
            return
        if settle or self._config.insertion == "settled":
            firsts, held = new.firsts().items(), self._cubes
            self._trees.add({at: held.setdefault(at, Cube()).settle(part) for at, part in firsts})
        else:
            for index, part in (sums := new.sums()).items():
                self._cubes.setdefault(index, Cube()).average(part)
            self._trees.forget(sums)

    def fill(self, other: CubeMap, *, archived: bool = False) -> None:
        """Add the points of another map, archived ones if asked, to free voxels: none is moved."""
        held = joined([*other.contents(archived=archived).values()])
        self.insert_sorted(self.sorted(held.without_seconds(), archive=archived), settle=True)

    def move(self, moves: Mapping[int, FloatArray]) -> int:
        """Move points of the window and of the archive, after a loop closure; return how many.

        Where a point comes to lie in the voxel of another, the one that was not moved stays; of two
        that were moved, the one of the lower owner stays.

        Parameters
        ----------
        moves : (4, 4) rigid transforms in the map frame, by the owner of the points
        """
        owners = np.array(sorted(moves), np.int32)
        taken = [cube.take_out(owners) for cube in self._cubes.values()]
        taken += self._archive.take_out(owners)
        content = joined(taken)
        self._trees = TreeCache()
        for owner in owners.tolist():
            moved = content.of(owner).moved(moves[owner])
            self.insert_sorted(self.sorted(moved, archive=True))
        return len(content.points)

    def give_to(self, owner: int) -> None:
        """Let all points of the window belong to an owner."""
        for cube in self._cubes.values():
            cube.give_to(owner)

    def nearest(
        self, queries: NDArray[np.floating], k: int, max_distance: float, cubes: Iterable[CubeIndex]
    ) -> Neighbours:
        """The k nearest points of the given cubes to each query, exactly, also across borders.

        Points at equal distance come in any order, but in the same one for the same calls.

        Parameters
        ----------
        queries : (M, 3) metres, map frame
        k : neighbours a query
        max_distance : metres; only points nearer than this count. May be infinite.
        cubes : as from :meth:`neighbourhood`; cubes that hold no points are allowed

        Raises
        ------
        InputError
            If ``queries`` is not (M, 3) finite floats, ``k`` < 1 or ``max_distance`` not positive.
        """
        queries = as_points(queries, "queries")
        if k < 1:
            raise InputError(f"k: expected at least 1, got {k}")
        if not max_distance > 0.0:
            raise InputError(f"max_distance: expected metres above 0, got {max_distance}")
        held = {index for index in cubes if index in self._cubes}
        if not held or len(queries) == 0:
            return Neighbours.none(len(queries), k)
        return self._trees.over(held, self._cubes).nearest(queries, k, max_distance)

    def points(self, cubes: Chosen = None, *, archived: bool = False) -> FloatArray:
        """Map points, ordered by cube and voxel, (N, 3) metres, map frame, a copy.

        Parameters
        ----------
        cubes : which; all cubes of the window when None
        archived : with ``cubes=None``, include the archive: the whole map
        """
        found = self.contents(cubes, archived=archived)
        return np.concatenate([NO_POINTS, *(content.points for content in found.values())])

    def contents(self, cubes: Chosen = None, *, archived: bool = False) -> Contents:
        """Points and tags by cube, in the order of :meth:`points`."""
        chosen = self._cubes.keys() if cubes is None else self._cubes.keys() & set(cubes)
        held = {index: self._cubes[index].content for index in chosen}
        held |= dict(self._archive.contents()) if archived and cubes is None else {}
        return dict(sorted(held.items()))

    def thinned(self, factor: float) -> CubeMap:
        """A map of the points of the window, with voxels of ``factor`` times the size."""
        config = self._config.changed(insertion="centroid", archive_dir=None)
        edge = OBLIQUE_EDGE if self._grid.oblique else 1.0  # few points are left to a plane anyway
        thin = CubeMap(config, factor * self._grid.voxel_size / edge)
        thin._window, thin._grid = self._window, thin._grid._replace(oblique=self._grid.oblique)
        thin.insert(self.points())
        return thin

    def count(self, cubes: Chosen = None) -> int:
        """Points in the given cubes, or in the whole window."""
        if cubes is None:
            return sum(map(len, self._cubes.values()))
        return sum(len(self._cubes[index]) for index in set(cubes) & self._cubes.keys())
