"""The cubes and voxels of a map: which one a point lies in, and boxes of cubes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from loam_gtsam.geometry import OBLIQUE_EDGE, as_vector, voxel_keys
from loam_gtsam.types import BoolArray, FloatArray, InputError, IntArray

CubeIndex = tuple[int, int, int]

_COS_VIEW = np.sqrt(3.0) / 2.0
"""Cosine of 30 degrees: LOAM's field of view is 30 to 150 degrees off the sensor's up axis."""
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3))).T[:, None]
"""(3, 1, 8) corners of a cube of unit size, from its centre."""
_MOST_VOXELS = (1 << 20) - 1
"""Voxels on either side of the origin that ``voxel_keys`` tells apart."""


class Grid(NamedTuple):
    """Cubes, of which (0, 0, 0) is centred on the map origin, and voxels, anchored there.

    ``cube_size`` and ``voxel_size`` are edge lengths, metres. The voxels, not the cubes, may be
    ``oblique``: see :func:`loam_gtsam.geometry.voxel_keys`.
    """

    cube_size: float
    voxel_size: float
    oblique: bool = False

    @property
    def limit(self) -> float:
        """Metres from the origin along an axis up to which there are voxels whatever the others."""
        most = _MOST_VOXELS * self.voxel_size
        # (2, 2, -1) / 3 times (1, 1, -1) is 5 / 3.
        return 0.6 * OBLIQUE_EDGE * most if self.oblique else most

    def keys(self, points: FloatArray) -> IntArray:
        """(N,) keys of the voxels of points (N, 3)."""
        return voxel_keys(points, self.voxel_size, oblique=self.oblique)

    def cells(self, points: FloatArray) -> FloatArray:
        """Indices of the cubes of points, as floats: far or infinite points must not overflow."""
        cells: FloatArray = np.floor((points + 0.5 * self.cube_size) / self.cube_size)
        return cells

    def cube_of(self, position: FloatArray) -> CubeIndex:
        """The cube in which a position (3,) lies; InputError if the voxel grid ends before it."""
        position = as_vector(position, "position")
        if np.abs(position).max() >= self.limit:
            raise InputError(
                f"position: expected coordinates within {self.limit:.0f} m of the map origin (the "
                f"voxel grid ends there), got {position.tolist()}; start the map nearer, or use a "
                "larger voxel"
            )
        return cube_index(self.cells(position))

    def reaches(self, axes: FloatArray) -> BoolArray:
        """(N,) which points, (3, N), lie within :attr:`limit`."""
        x, y, z = np.abs(axes) < self.limit
        within: BoolArray = x & y & z
        return within


class Window(NamedTuple):
    """``shape`` cubes along each axis, of which ``first`` is the one with the lowest index."""

    first: CubeIndex
    shape: CubeIndex

    @classmethod
    def around(cls, cell: CubeIndex, shape: CubeIndex) -> Window:
        """The window with a cube at its centre."""
        x, y, z = (i - n // 2 for i, n in zip(cell, shape, strict=True))
        return cls((x, y, z), shape)

    @property
    def last(self) -> CubeIndex:
        """The cube with the highest index."""
        x, y, z = (i + n - 1 for i, n in zip(self.first, self.shape, strict=True))
        return x, y, z

    def holds(self, cells: FloatArray) -> BoolArray:
        """(N,) which cubes, (3, N), lie in the window."""
        first, last = np.array([self.first, self.last], np.float64)[:, :, None]
        x, y, z = (cells >= first) & (cells <= last)
        inside: BoolArray = x & y & z
        return inside

    def choose(self, cubes: Iterable[CubeIndex]) -> list[CubeIndex]:
        """Those of some cubes that lie in the window, in the order given."""
        (x0, y0, z0), (x1, y1, z1) = self.first, self.last
        return [(x, y, z) for x, y, z in cubes if x0 <= x <= x1 and y0 <= y <= y1 and z0 <= z <= z1]

    def following(self, cell: CubeIndex, margin: int) -> Window:
        """The window moved no farther than needed to have ``margin`` cubes on all sides of one.

        A margin that leaves no room is cut to half the window.
        """
        low = []
        for i, first, n in zip(cell, self.first, self.shape, strict=True):
            most = min(margin, (n - 1) // 2)
            low.append(min(max(first, i - (n - 1 - most)), i - most))
        x, y, z = low
        return self._replace(first=(x, y, z))


def cube_index(cell: FloatArray) -> CubeIndex:
    """Index of a cube, from (3,) as :meth:`Grid.cells` gives it."""
    x, y, z = map(int, cell.tolist())
    return x, y, z


def cubes_in_view(
    cubes: Sequence[CubeIndex], map_T_lidar: FloatArray, cube_size: float
) -> tuple[CubeIndex, ...]:
    """Those cubes, of at least one, with a corner 30 to 150 degrees off the sensor's up axis.

    LOAM (laserMapping) writes this with the law of cosines; A-LOAM has no such test.
    """
    corners = cube_size * (np.array(cubes).T[:, :, None] + _CORNERS)
    rays = corners - map_T_lidar[:3, 3, None, None]
    up = np.tensordot(map_T_lidar[:3, 2], rays, axes=1)
    visible = (up**2 < _COS_VIEW**2 * (rays**2).sum(axis=0)).any(axis=1)
    return tuple(index for index, seen in zip(cubes, visible.tolist(), strict=True) if seen)
