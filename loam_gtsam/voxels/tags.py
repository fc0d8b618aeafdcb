"""What the points of a map carry: their owners, and from where they were seen.

A beam sees only the side of a surface that is turned towards it. A wall of 0.2 m has two, and their
points lie nearer to each other than a search for neighbours reaches. What tells them apart is the
direction from a point to the lidar that saw it, its view, together with the normal of the surface.
Views alone do not: who walks past a wall sees one face of it from both ends, and who walks round
its end sees both faces along nearly the same line.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.types import BoolArray, FloatArray, IntArray

Owners = NDArray[np.int32]
"""Numbers that points carry: points of one number can be moved together."""
Views = NDArray[np.int8]
"""(..., 4) in 127ths, which is to half a degree, unit vectors from points to the lidar that saw
them, zero where that is not known; then 1 if a point is the second in its voxel, else 0."""
Tags = NDArray[np.int32]
"""(..., 2) the owner of each point, and the four bytes of its view: one column is fast to sort."""

_UNIT = 127.0
LEAST_ANGLE = 1.0 / _UNIT
"""Between views, rad: a smaller one may be none."""


class Faces(NamedTuple):
    """Points of a sweep by which the map has points of the other side of their surface.

    Attributes
    ----------
    rows : (F,) among the points
    normals : (F, 3) of the surface at these points, towards the lidar, map frame
    least : (F,) sines of the angles to the surface from which on a view tells the side
    """

    rows: IntArray
    normals: FloatArray
    least: FloatArray


def tags_of(count: int, owner: int | IntArray) -> Tags:
    """Tags of so many points of an owner, or (N,) owners, whose views are not known."""
    tags: Tags = np.zeros((count, 2), np.int32)
    tags[:, 0] = owner
    return tags


def views(tags: Tags) -> Views:
    """The views in tags, which change with them."""
    return tags[..., 1:].view(np.int8)


def second(tags: Tags) -> BoolArray:
    """Which points are second in their voxels."""
    is_second: BoolArray = views(tags)[..., 3] > 0
    return is_second


def look(tags: Tags, points: FloatArray, seen_from: NDArray[np.floating]) -> None:
    """Write into tags that points (N, 3) were seen from (3,) or (N, 3) positions of the lidar."""
    x, y, z = np.ascontiguousarray((seen_from - points).T)
    scale = _UNIT / np.sqrt(np.maximum(x * x + y * y + z * z, 1e-12))
    seen = views(tags)
    for column, part in enumerate((x, y, z)):
        seen[:, column] = np.rint(part * scale)


def turn(tags: Tags, rotation: FloatArray) -> None:
    """Turn the views in tags (N, 2) with the rotation (3, 3) of all points, or each (N, 3, 3)."""
    seen = views(tags)
    turned = np.einsum("...ij,...j->...i", rotation, seen[:, :3].astype(np.float64))
    seen[:, :3] = np.rint(turned)


def sines(seen: Views, normals: FloatArray) -> FloatArray:
    """(k, M) sines of the angles between views (M, k, 4) and surfaces with normals (3, M).

    They are positive where the normal points to the side from which the point was seen.
    """
    x, y, z = np.ascontiguousarray(seen.T[:3], np.float64)
    along: FloatArray = (x * normals[0] + y * normals[1] + z * normals[2]) / _UNIT
    return along
