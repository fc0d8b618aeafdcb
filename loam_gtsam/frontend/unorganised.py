"""Features of a sweep without rings: flat patches, and posts.

LOAM compares consecutive measurements of one beam. A lidar that sweeps no rings (Livox), the
points of several lidars together, or points that others have filtered or de-skewed have no such
order. There a point's neighbours in space tell what it is. On a plane through them that is as thin
as range noise it is a plane point, as in most LiDAR-inertial odometry (Xu et al., FAST-LIO2, T-RO
2022); and what stands apart from everything around it is a post, the middle of which is an edge.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.config import FeatureConfig
from loam_gtsam.geometry import run_starts, symmetric_eigenvalues
from loam_gtsam.types import BoolArray, FloatArray, IntArray

_NEIGHBOURS = 10
"""Means of voxels in a patch, which is half a metre wide where points are dense."""
_ROUGH = 2.0
"""Standard deviations of range noise: the scatter of a flat patch, of seven degrees of freedom, is
larger once in 2,000. Half of what rings allow, whose five points are curved over less."""
_FLAT = 0.2
"""Most variance of a patch across it, over that along its narrow extent."""
_SPEED = 10.0
"""m/s: what is thicker than noise may have moved by this while it was measured."""
_SLICE = 0.4
"""Metres, the height of the part of a post of which an edge is the middle."""
_APART = 1e3
"""Metres between two slices, for the search of neighbours within each."""


def on_flat_patches(points: FloatArray, times: FloatArray, noise: float) -> BoolArray:
    """(M,) which points lie, with their neighbours, on a plane that is as thin as range noise.

    A patch is measured within up to a whole sweep by a lidar that moves. What its points' times
    explain of their positions is no thickness, as far as speeds are usual: that is as if each point
    had been measured once more, off by range noise, ``noise / _SPEED`` earlier or later.

    Parameters
    ----------
    points : (M, 3) metres, means of voxels
    times : (M,) seconds
    noise : standard deviation of a range, metres; with 0 a patch may be as thick as it wants
    """
    count = min(_NEIGHBOURS, len(points))
    if count < 4:
        return np.zeros(len(points), np.bool_)
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    near = np.ascontiguousarray(tree.query(points, k=count)[1].T)
    patches = np.vstack([points.T, times]).take(near, axis=1)
    x, y, z, t = patches - patches.mean(axis=1, keepdims=True)
    pairs = ((x, x), (y, y), (z, z), (x, y), (y, z), (x, z))
    covariance = np.stack([(a * b).mean(axis=0) for a, b in pairs])
    moved = np.stack([(axis * t).mean(axis=0) for axis in (x, y, z)])
    spread = (t * t).mean(axis=0) + max(noise / _SPEED, 1e-6) ** 2 / count
    covariance -= moved[[0, 1, 2, 0, 1, 0]] * moved[[0, 1, 2, 1, 2, 2]] / spread
    across, along, _ = symmetric_eigenvalues(covariance)
    is_flat: BoolArray = across < _FLAT * along
    if noise > 0.0:
        is_flat &= across * count < (_ROUGH * noise) ** 2 * (count - 3)
    return is_flat


def posts(
    points: FloatArray, times: FloatArray, free: BoolArray, config: FeatureConfig
) -> tuple[FloatArray, FloatArray]:
    """Middles (P, 3) of what stands apart from everything at its height, and their times (P,).

    Parameters
    ----------
    points, times : see :func:`on_flat_patches`
    free : (M,) which of them are on no plane
    config : a post is narrower than ``post_width`` and at least ``post_depth`` from all else
    """
    from scipy.sparse import coo_array  # slow to import, and not for every run
    from scipy.sparse.csgraph import connected_components

    if config.post_depth <= 0.0 or not free.any():
        return np.empty((0, 3)), np.empty(0)
    slices = np.column_stack([points[:, :2], _APART * np.floor(points[:, 2] / _SLICE)])
    tree = cKDTree(slices, balanced_tree=False, compact_nodes=False)
    one, other = tree.query_pairs(config.post_depth, output_type="ndarray").T
    linked = coo_array((np.ones(len(one), np.bool_), (one, other)), shape=(len(points),) * 2)
    group = connected_components(linked, directed=False)[1]
    order = np.argsort(group, kind="stable")
    first: IntArray = run_starts(np.diff(group[order]) > 0)
    rows = np.column_stack([points, times])[order]
    lowest, highest = np.minimum.reduceat(rows, first), np.maximum.reduceat(rows, first)
    apart = np.logical_and.reduceat(free[order], first)
    apart &= np.hypot(*(highest - lowest)[:, :2].T) < config.post_width
    middles = np.add.reduceat(rows, first) / np.diff(first, append=len(rows))[:, None]
    return middles[apart, :3], middles[apart, 3]
