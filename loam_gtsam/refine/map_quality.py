"""How sharp a map is, without any truth: thickness of planes, share of planes, entropy.

To be taken on points that no pose was solved with, where possible: points that were matched are
nearer to the map than the surface is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from loam_gtsam.geometry import as_points, voxel_keys
from loam_gtsam.refine.landmarks import principal_axes
from loam_gtsam.types import BoolArray, FloatArray, InputError, IntArray

_LEAST_POINTS, _LEAST_SWEEPS = 10, 3
_FLAT = 0.15
"""Thickness over the narrow extent of what counts as a plane (two thirds of a quarter)."""
_QUERIES = 20_000
_NEIGHBOURS = 5
_FLOOR = 1e-6
"""Metres, standard deviation that every direction has at least, for the entropy."""


@dataclass(frozen=True, slots=True, eq=False)
class MapQuality:
    """Sharpness of a map.

    Attributes
    ----------
    thickness : metres, mean over the planes of the standard deviation of the points across each;
        NaN if there is no plane
    planar_share : share of the voxels with enough points whose points lie in a plane
    planes : number of those voxels
    entropy : mean map entropy in nats, of the points within the radius about each point: lower is
        sharper; NaN if no point has enough neighbours
    thicknesses : (V,) metres of each plane
    centres : (V, 3) metres
    normals : (V, 3) unit
    keys : (V,) of the voxels
    """

    thickness: float
    planar_share: float
    planes: int
    entropy: float
    thicknesses: FloatArray
    centres: FloatArray
    normals: FloatArray
    keys: IntArray


def map_quality(
    points: ArrayLike, sweeps: ArrayLike | None = None, *, voxel: float = 0.5, radius: float = 0.3
) -> MapQuality:
    """Sharpness of the points of a map.

    See Droeschel and Behnke, Efficient continuous-time SLAM for 3D lidar-based online mapping, ICRA
    2018, for the entropy.

    Parameters
    ----------
    points : (N, 3) metres
    sweeps : (N,) numbers of the sweeps that saw them; a voxel counts only if three did. None counts
        all.
    voxel : metres, edge length of the voxels in which planes are looked for
    radius : metres, about a point for the entropy

    Raises
    ------
    InputError
        If a shape is wrong, a value not finite, or a length not positive.
    """
    p = as_points(points, "points")
    for name, length in (("voxel", voxel), ("radius", radius)):
        if not 0.0 < length < np.inf:
            raise InputError(f"{name}: expected a positive length in metres, got {length}")
    keys, first, group = np.unique(voxel_keys(p, voxel), return_index=True, return_inverse=True)
    fit = principal_axes(p, np.ones(len(p)), group, len(keys), p[first])
    enough = fit.counts >= _LEAST_POINTS
    if sweeps is not None:
        enough &= _views(group, np.asarray(sweeps), len(keys), p) >= _LEAST_SWEEPS
    spread = np.sqrt(np.maximum(fit.values, 0.0))
    flat: BoolArray = enough & (spread[:, 0] < _FLAT * spread[:, 1])
    thick = spread[flat, 0]
    return MapQuality(
        thickness=float(thick.mean()) if len(thick) else np.nan,
        planar_share=float(flat.sum() / max(int(enough.sum()), 1)),
        planes=int(flat.sum()),
        entropy=_entropy(p, radius),
        thicknesses=thick,
        centres=fit.means[flat],
        normals=fit.axes[flat, :, 0],
        keys=keys[flat],
    )


def common_thickness(first: MapQuality, second: MapQuality) -> tuple[float, float, int]:
    """Mean thickness, metres, of the voxels that are planes in two maps of one place; their number.

    A map that becomes sharper has more planes, and those that were none before are thicker than
    the rest: the means over all of each do not compare.
    """
    _, here, there = np.intersect1d(first.keys, second.keys, return_indices=True)
    if not len(here):
        return np.nan, np.nan, 0
    means = first.thicknesses[here].mean(), second.thicknesses[there].mean()
    return float(means[0]), float(means[1]), len(here)


def _views(group: IntArray, sweeps: IntArray, count: int, points: FloatArray) -> IntArray:
    if sweeps.shape != (len(points),) or sweeps.dtype.kind not in "iu":
        raise InputError(
            f"sweeps: expected ({len(points)},) integers, got shape {sweeps.shape} of "
            f"{sweeps.dtype}"
        )
    size = int(sweeps.max(initial=0)) + 1
    return np.bincount(np.unique(group * size + sweeps) // size, minlength=count)


def _entropy(points: FloatArray, radius: float) -> float:
    """Mean over at most 20,000 evenly chosen points of the entropy of what is about each."""
    if not len(points):
        return np.nan
    chosen = np.linspace(0, len(points) - 1, min(len(points), _QUERIES)).astype(int)
    near = cKDTree(points).query_ball_point(points[np.unique(chosen)], radius)
    sizes = np.array([len(some) for some in near])
    group = np.repeat(np.arange(len(near)), sizes)
    rows = np.concatenate([np.empty(0, np.int64), *near]).astype(np.int64)
    anchors = points[np.unique(chosen)]
    fit = principal_axes(points[rows], np.ones(len(rows)), group, len(near), anchors)
    known = sizes >= _NEIGHBOURS
    if not known.any():
        return np.nan
    values = np.maximum(fit.values[known], _FLOOR**2)
    return float(np.mean(0.5 * np.log(2.0 * np.pi * np.e * values).sum(axis=1)))
