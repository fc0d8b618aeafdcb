"""Closed-form geometry on arrays of points: rigid motion, fits, voxels.

Everything here is vectorised over points and free of state. Tangent order is
``[rotation, translation]`` (see :mod:`loam_gtsam.types`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.types import FloatArray, IntArray

_SMALL_ANGLE = 1e-9


def transform(a_T_b: FloatArray, points: NDArray[np.floating]) -> FloatArray:
    """Apply a (4, 4) rigid transform to (N, 3) points."""
    moved: FloatArray = points @ a_T_b[:3, :3].T
    moved += a_T_b[:3, 3]
    return moved


def move_points(
    points: NDArray[np.floating], twist: FloatArray, times: NDArray[np.floating]
) -> FloatArray:
    """Move each point by the screw motion ``Exp(twist * time)``.

    With ``twist`` the body velocity and ``times`` counted from the reference time, this maps
    points measured at their own time into the lidar frame at the reference time: the de-skew of a
    sweep under constant velocity.

    Parameters
    ----------
    points : (N, 3) metres
    twist : (6,) rad/s and m/s
    times : (N,) seconds

    Returns
    -------
    (N, 3) float64

    Notes
    -----
    The rotation axis k is the same for all points, so Rodrigues' formula and the SE(3)
    left Jacobian need one sine and cosine per point and no matrices:
    ``p' = p + sin(a) k x p + (1 - cos(a)) k x (k x p) + V v t`` with ``a = |w| t``
    (Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation, eq. 2.14 and 2.36).
    """
    points = np.asarray(points, dtype=np.float64)
    omega, velocity = twist[:3], twist[3:]
    shift = np.outer(times, velocity)
    rate = float(np.linalg.norm(omega))
    if rate < _SMALL_ANGLE:
        return points + shift
    axis = omega / rate
    angle = rate * np.asarray(times, dtype=np.float64)
    sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
    cross = np.cross(axis, points)
    moved = points + sine * cross + (1.0 - cosine) * np.cross(axis, cross)
    # V(a k) v t = t v + (1 - cos a)/|w| k x v + (t - sin(a)/|w|) k x (k x v)
    axis_v = np.cross(axis, velocity)
    moved += shift + (1.0 - cosine) / rate * axis_v
    moved += (angle[:, None] - sine) / rate * np.cross(axis, axis_v)
    return moved


def symmetric_eigenvalues(matrices: FloatArray) -> FloatArray:
    """Eigenvalues of (N, 3, 3) symmetric matrices, ascending, (N, 3).

    Closed form by the trigonometric solution of the characteristic cubic
    (Smith, Eigenvalues of a symmetric 3 x 3 matrix, CACM 4, 1961).
    """
    a, b, c = matrices[:, 0, 0], matrices[:, 1, 1], matrices[:, 2, 2]
    d, e, f = matrices[:, 0, 1], matrices[:, 1, 2], matrices[:, 0, 2]
    mean = (a + b + c) / 3.0
    a0, b0, c0 = a - mean, b - mean, c - mean
    p = np.sqrt((a0 * a0 + b0 * b0 + c0 * c0 + 2.0 * (d * d + e * e + f * f)) / 6.0)
    determinant = a0 * (b0 * c0 - e * e) - d * (d * c0 - e * f) + f * (d * e - b0 * f)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(p > 0.0, determinant / (2.0 * p * p * p), 0.0)
    phi = np.arccos(np.clip(ratio, -1.0, 1.0)) / 3.0
    largest = mean + 2.0 * p * np.cos(phi)
    smallest = mean + 2.0 * p * np.cos(phi + 2.0 * np.pi / 3.0)
    return np.stack([smallest, 3.0 * mean - largest - smallest, largest], axis=1)


def symmetric_eigenvector(matrices: FloatArray, eigenvalues: FloatArray) -> FloatArray:
    """Unit eigenvector of each (3, 3) symmetric matrix for a simple eigenvalue, (N, 3).

    The longest cross product of two rows of ``A - l I`` spans its null space. Where the
    eigenvalue is not simple all of them vanish; the returned vector is then arbitrary but unit.
    """
    shifted = matrices - eigenvalues[:, None, None] * np.eye(3)
    rows = shifted[:, [0, 1, 2]], shifted[:, [1, 2, 0]]
    candidates = np.cross(rows[0], rows[1])
    norms = np.einsum("nij,nij->ni", candidates, candidates)
    best = norms.argmax(axis=1)
    index = np.arange(len(matrices))
    vector = candidates[index, best]
    norm = np.sqrt(norms[index, best])
    degenerate = norm <= 0.0
    vector[degenerate] = (0.0, 0.0, 1.0)
    norm[degenerate] = 1.0
    unit: FloatArray = vector / norm[:, None]
    return unit


def fit_lines(neighbours: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least-squares line through each group of points.

    Parameters
    ----------
    neighbours : (N, k, 3) metres

    Returns
    -------
    centres : (N, 3) a point on each line (the mean)
    directions : (N, 3) unit
    eigenvalues : (N, 3) of the covariance, ascending; a line has the last far above the second
    """
    centres, covariance = _moments(neighbours)
    eigenvalues = symmetric_eigenvalues(covariance)
    return centres, symmetric_eigenvector(covariance, eigenvalues[:, 2]), eigenvalues


def fit_planes(
    neighbours: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Least-squares plane through each group of points, about its centroid.

    Parameters
    ----------
    neighbours : (N, k, 3) metres

    Returns
    -------
    centres : (N, 3) a point on each plane (the mean)
    normals : (N, 3) unit
    directions : (N, 3) unit, in the plane, along its widest extent
    eigenvalues : (N, 3) of the covariance, ascending: across the plane, along its narrow and its
        wide extent
    """
    centres, covariance = _moments(neighbours)
    eigenvalues = symmetric_eigenvalues(covariance)
    normals = symmetric_eigenvector(covariance, eigenvalues[:, 0])
    return centres, normals, symmetric_eigenvector(covariance, eigenvalues[:, 2]), eigenvalues


def _moments(neighbours: FloatArray) -> tuple[FloatArray, FloatArray]:
    centres = neighbours.mean(axis=1)
    centred = neighbours - centres[:, None, :]
    covariance = np.einsum("nki,nkj->nij", centred, centred) / neighbours.shape[1]
    return centres, covariance


def voxel_keys(points: NDArray[np.floating], size: float) -> IntArray:
    """One integer per voxel of edge length ``size`` (21 bits an axis: +-1,048,576 voxels)."""
    cells = np.floor(points[:, :3] / size).astype(np.int64) + (1 << 20)
    keys: IntArray = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    return keys


def voxel_filter(points: NDArray[np.floating], size: float) -> FloatArray:
    """Centroid of the points in each voxel, ordered by voxel.

    Parameters
    ----------
    points : (N, C) with C >= 3: metres in the first three columns, anything that can be averaged
        (e.g. times) in the others
    size : edge length of a voxel, metres; 0 returns the points as they are

    Returns
    -------
    (M, C) float64, M <= N
    """
    if size <= 0.0 or len(points) == 0:
        return np.asarray(points, dtype=np.float64)
    keys = voxel_keys(points, size)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.flatnonzero(np.concatenate(([True], keys[1:] != keys[:-1])))
    sums = np.add.reduceat(points[order].astype(np.float64, copy=False), first, axis=0)
    counts = np.diff(np.append(first, len(keys)))
    centroids: FloatArray = sums / counts[:, None]
    return centroids
