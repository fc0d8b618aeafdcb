"""The ground that was matched so far, and what wrong ranges have made of the map there."""

from __future__ import annotations

import numpy as np

from loam_gtsam.geometry import voxel_keys
from loam_gtsam.types import FloatArray, IntArray
from loam_gtsam.voxels.key_table import KeyTable

_REMEMBERED = 500_000  # cells of one generation: 8 MB
_FACINGS = 4  # of :func:`facings`
_NO_KEYS: IntArray = np.empty(0, np.int64)
_NOT_YET = -1


class SeenGround:
    """Since which scan each place of the map is matched; what is not matched for long is forgotten.

    A wall says nothing of the edge at its end, or of the floor at its foot. So what is kept are
    cells of the map with what they were matched for: edges, or planes that face along one axis.

    Kept is also how far every scan was moved by each metre that the ranges are too long, and with
    it the points that it has put into the map.

    Parameters
    ----------
    remembered : cells of a generation. When the younger generation is full, it becomes the older
        one, and the older one is forgotten.
    """

    def __init__(self, remembered: int = _REMEMBERED) -> None:
        self._remembered = remembered
        self._tables: dict[tuple[float, int], tuple[KeyTable, KeyTable]] = {}
        self._moved = KeyTable(_NO_KEYS, np.empty((0, 6)))

    @property
    def scans(self) -> int:
        """Scans so far, which is the number of the next one."""
        return len(self._moved)

    def cells(
        self, points_map: FloatArray, facings: IntArray, size: float, *, new: int | None = None
    ) -> tuple[IntArray, IntArray]:
        """The cells of points of the next scan, and since when these are matched.

        Parameters
        ----------
        points_map : (N, 3) metres
        facings : (N,) those of :func:`facings`
        size : edge length of a cell, metres
        new : number of the scan by which new cells are matched; of the next one if None

        Returns
        -------
        numbers, since : (N,) numbers of the cells, and (C,) of the scans by which these were
            matched first
        """
        keys = voxel_keys(points_map, size)
        numbers, all_since, count = np.empty(len(keys), np.int64), [], 0
        for facing in range(_FACINGS):
            younger, older = self._tables.get((size, facing)) or (_no_cells(), _no_cells())
            rows = np.flatnonzero(facings == facing)
            cells, inverse = np.unique(keys[rows], return_inverse=True)
            numbers[rows] = count + inverse
            count += len(cells)
            since = np.full(len(cells), _NOT_YET)
            younger.look_up(cells, 1, since)
            missing = np.flatnonzero(since == _NOT_YET)
            found = np.full(len(missing), self.scans if new is None else new)
            older.look_up(cells[missing], 1, found)
            since[missing] = found
            all_since.append(since)
            younger.append(cells[missing], found)
            if len(younger) > self._remembered:
                younger, older = _no_cells(), younger
            self._tables[size, facing] = younger, older
        return numbers, np.concatenate(all_since)

    def moved(self, since: IntArray) -> FloatArray:
        """(N, 6) how far the map was moved where it is matched since these scans (N,).

        That is as far as the scan before, which had mapped it: in map axes, rad and m per metre.
        """
        moved = np.zeros((len(since), 6))
        self._moved.look_up(since - 1, 1, moved)
        return moved

    def add(self, moved: FloatArray) -> None:
        """The next scan was moved so far (6,), and is over."""
        self._moved.append(np.array([self.scans]), moved[None])


def facings(normals: FloatArray, lines: int) -> IntArray:
    """What rows (N,) are of: 0 an edge, else a plane that faces most along axis 1, 2 or 3.

    ``normals`` (N, 3) are those of the rows, map frame, of which the first ``lines`` are of edges.
    """
    axes: IntArray = 1 + np.abs(normals).argmax(axis=1)
    axes[:lines] = 0
    return axes


def _no_cells() -> KeyTable:
    return KeyTable(_NO_KEYS, _NO_KEYS)
