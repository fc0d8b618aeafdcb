"""Closed-form geometry on arrays of points: checks, rigid motion, fits, voxels; free of state.

Tangent order is ``[rotation, translation]`` (see :mod:`loam_gtsam.types`).
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri, ndtr

from loam_gtsam.errors import as_one_array
from loam_gtsam.errors import as_stamps as as_stamps
from loam_gtsam.trajectory import checked_pose as checked_pose
from loam_gtsam.trajectory import is_rigid as is_rigid
from loam_gtsam.types import BoolArray, FloatArray, InputError, IntArray, check_array

_Real = TypeVar("_Real", np.float32, np.float64)
MAD_TO_SIGMA = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""
_SMALL_ANGLE = 1e-9
_GRID = 1 << 20
"""Voxels on either side of the origin that the keys of voxels tell apart."""
OBLIQUE_EDGE = float(np.sqrt(1.5))
"""Edges of oblique voxels over the size asked for. In the mean over all attitudes a plane crosses
1.5 times as many voxels as one along their borders does, so oblique ones are as much larger."""


def five_sigma(freedoms: int) -> float:
    """Squared Mahalanobis distance, of so many, that is as unlikely as five standard deviations."""
    return float(chdtri(freedoms, 2.0 * ndtr(-5.0)))


def as_array(value: ArrayLike, name: str, shape: tuple[int | str, ...]) -> FloatArray:
    """Anything that numpy makes a finite array of, as float64; checked by :func:`check_array`."""
    array = as_one_array(value, name)
    check_array(array, name, shape, "numbers")
    finite = np.isfinite(array)
    if not finite.all():
        got = f"{array.size - np.count_nonzero(finite)} NaN or infinite ones of {array.size}"
        raise InputError(f"{name}: expected finite numbers, got {got}")
    return array.astype(np.float64, copy=False)


def as_points(value: ArrayLike, name: str) -> FloatArray:
    """(N, 3) finite float64, checked as by :func:`as_array`."""
    return as_array(value, name, ("N", 3))


def as_vector(value: ArrayLike, name: str, size: int = 3) -> FloatArray:
    """(size,) finite float64, checked as by :func:`as_array`."""
    return as_array(value, name, (size,))


def as_unit(value: ArrayLike, name: str) -> FloatArray:
    """(3,) of unit length, checked as by :func:`as_array`."""
    vector = as_vector(value, name)
    length = float(np.linalg.norm(vector))
    if abs(length - 1.0) > 1e-6:
        raise InputError(f"{name}: expected unit length, got length {length:.6g}")
    return vector


def transform(a_T_b: FloatArray, points: NDArray[np.floating]) -> FloatArray:
    """Apply a (4, 4) rigid transform to (N, 3) points."""
    moved: FloatArray = points @ a_T_b[:3, :3].T
    moved += a_T_b[:3, 3]
    return moved


def transform_each(a_T_b: FloatArray, points: FloatArray) -> FloatArray:
    """Apply a rigid transform of its own, of (N, 4, 4), to each of (N, 3) points."""
    moved: FloatArray = np.einsum("nij,nj->ni", a_T_b[:, :3, :3], points)
    moved += a_T_b[:, :3, 3]
    return moved


def inverse_pose(a_T_b: FloatArray) -> FloatArray:
    """``b_T_a`` of one rigid transform (4, 4), or of each of (N, 4, 4)."""
    inverse = np.zeros_like(a_T_b)
    rotation = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = (-rotation @ a_T_b[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def move_points(
    points: NDArray[np.floating], twist: FloatArray, times: NDArray[np.floating]
) -> FloatArray:
    """Points (N, 3), each moved by the screw motion ``Exp(twist * time)``.

    With ``twist`` (6,) the body velocity, rad/s and m/s, and ``times`` (N,) in seconds from the
    reference time, this maps points measured at their own time into the lidar frame at the
    reference time: the de-skew of a sweep under constant velocity.

    The screw axis is the same for all points: along k, the direction of w, and through
    ``c = k x v / |w|``. With ``a = |w| t`` Rodrigues' formula about it needs one sine and cosine
    per point and no matrices: ``p' = p + sin(a) k x (p - c) + (1 - cos(a)) k x (k x (p - c)) +
    t (k . v) k`` (Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation, eq. 2.14
    and 2.36). Slow rotations put c far away, but what cancels there is scaled by as small a sine.
    """
    # Component arrays, as for the fits below.
    moved = np.array(points.T, dtype=np.float64, order="C")
    times = np.asarray(times, dtype=np.float64)
    omega, velocity = twist[:3], twist[3:]
    rate = float(np.linalg.norm(omega))
    if rate < _SMALL_ANGLE:
        moved += velocity[:, None] * times
        return np.ascontiguousarray(moved.T)
    axis, angle = omega / rate, rate * times
    across = cross_matrix(axis)
    around = across @ moved - (across @ across @ velocity / rate)[:, None]
    inward = across @ around
    around *= np.sin(angle)
    # 1 - cos a, written so that it does not cancel.
    inward *= 2.0 * np.sin(0.5 * angle) ** 2
    moved += around
    moved += inward
    moved += ((axis @ velocity) * axis)[:, None] * times
    return np.ascontiguousarray(moved.T)


def cross_matrix(vector: FloatArray) -> FloatArray:
    """(3, 3) matrix that takes a vector to its cross product with (3,) ``vector``, on the left."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


# Component arrays, points last: one pass over contiguous memory per operation, several times faster
# than (N, 3, 3) stacks. A symmetric 3 x 3 matrix is (6, N): xx, yy, zz, xy, yz, xz.


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (3, N) of vectors (3, N), of which one may be (3,); faster than numpy's."""
    product: FloatArray = np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )
    return product


def squared_norm(xyz: NDArray[_Real]) -> NDArray[_Real]:
    """(...,) of (3, ...), with the bits of numpy's sum along the axis of three; much faster."""
    x, y, z = xyz
    squared: NDArray[_Real] = x * x + y * y + z * z
    return squared


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """(...,) scalar products of vectors (3, ...)."""
    product: FloatArray = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


def norm(vectors: FloatArray) -> FloatArray:
    """(...,) lengths of vectors (3, ...)."""
    length: FloatArray = np.sqrt(squared_norm(vectors))
    return length


def moments(neighbours: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (3, N) and covariance (6, N: xx, yy, zz, xy, yz, xz) of (N, k, 3) groups of points."""
    axes = np.ascontiguousarray(neighbours.transpose(2, 1, 0), dtype=np.float64)
    count = neighbours.shape[1]
    means: FloatArray = axes.sum(axis=1) / count
    x, y, z = axes - means[:, None]
    pairs = ((x, x), (y, y), (z, z), (x, y), (y, z), (x, z))
    covariance: FloatArray = np.array([(a * b).sum(axis=0) for a, b in pairs]) / count
    return means, covariance


def symmetric_eigenvalues(matrices: FloatArray) -> FloatArray:
    """Eigenvalues, ascending, (3, N), of symmetric matrices (6, N: xx, yy, zz, xy, yz, xz).

    Closed form by the trigonometric solution of the characteristic cubic
    (Smith, Eigenvalues of a symmetric 3 x 3 matrix, CACM 4, 1961).
    """
    a, b, c, d, e, f = matrices
    mean = (a + b + c) / 3.0
    a, b, c = a - mean, b - mean, c - mean
    p = np.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    determinant = a * (b * c - e * e) - d * (d * c - e * f) + f * (d * e - b * f)
    cubed = 2.0 * p * p * p
    ratio = np.divide(determinant, cubed, out=np.zeros_like(p), where=cubed > 0.0)
    phi = np.arccos(np.clip(ratio, -1.0, 1.0)) / 3.0
    largest = mean + 2.0 * p * np.cos(phi)
    smallest = mean + 2.0 * p * np.cos(phi + 2.0 * np.pi / 3.0)
    return np.array([smallest, 3.0 * mean - largest - smallest, largest])


def nearest_positive(matrix: FloatArray) -> FloatArray:
    """The nearest positive semi-definite matrix; what is left of rounding becomes zero."""
    root = positive_root(matrix)
    return root @ root


def parallel_sum(one: FloatArray, other: FloatArray) -> FloatArray:
    """``(one^-1 + other^-1)^-1`` of two forms, of which only the first must have an inverse.

    The information that is left of ``one`` when an error of the information ``other`` comes to it.
    """
    both: FloatArray = one - one @ np.linalg.inv(other + one) @ one
    return both


def positive_root(matrix: FloatArray) -> FloatArray:
    """The symmetric root of the nearest positive semi-definite matrix."""
    eigenvalues, vectors = np.linalg.eigh(symmetric(matrix))
    root: FloatArray = ((vectors * np.sqrt(np.maximum(eigenvalues, 0.0))) @ vectors.T).astype(
        np.float64
    )
    return root


def symmetric_eigenvector(matrices: FloatArray, eigenvalues: FloatArray) -> FloatArray:
    """Unit eigenvectors (3, N) of symmetric matrices (6, N) for simple eigenvalues (N,).

    The longest cross product of two rows of ``A - l I`` spans its null space. Where the
    eigenvalue is not simple all of them vanish; the returned vector is then arbitrary but unit.
    """
    a, b, c, d, e, f = matrices
    a, b, c = a - eigenvalues, b - eigenvalues, c - eigenvalues
    p, q, r = d * e - f * b, e * f - c * d, f * d - a * e
    vector: FloatArray = np.array([p, r, a * b - d * d])
    norm = (vector * vector).sum(axis=0)
    for other in (np.array([b * c - e * e, q, p]), np.array([q, c * a - f * f, r])):
        squared = (other * other).sum(axis=0)
        longer = squared > norm
        np.copyto(vector, other, where=longer)
        np.copyto(norm, squared, where=longer)
    norm = np.sqrt(norm)
    degenerate = norm <= 0.0
    if degenerate.any():
        vector[:, degenerate] = [[0.0], [0.0], [1.0]]
        norm[degenerate] = 1.0
    vector /= norm
    return vector


def fit_lines(neighbours: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least-squares line through each of (N, k, 3) groups of points.

    Returns (3, N) each: the means, which are on the lines; unit directions; and the eigenvalues of
    the covariance, ascending, of which a line has the last far above the second.
    """
    centres, covariance = moments(neighbours)
    eigenvalues = symmetric_eigenvalues(covariance)
    return centres, symmetric_eigenvector(covariance, eigenvalues[2]), eigenvalues


def fit_planes(neighbours: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Least-squares plane through each of (N, k, 3) groups of points, about its centroid.

    Returns (3, N) each: the means, which are on the planes; unit normals; unit directions in the
    plane along its widest extent; and the eigenvalues of the covariance, ascending: across the
    plane, along its narrow and its wide extent.
    """
    centres, covariance = moments(neighbours)
    eigenvalues = symmetric_eigenvalues(covariance)
    normals = symmetric_eigenvector(covariance, eigenvalues[0])
    return centres, normals, symmetric_eigenvector(covariance, eigenvalues[2]), eigenvalues


def interpolated(moments: FloatArray | float, times: FloatArray, values: FloatArray) -> FloatArray:
    """(..., C) values at (...) moments, from (N, C) at ascending times; held beyond the ends."""
    return np.stack([np.interp(moments, times, column) for column in values.T], axis=-1)


def integrated(values: FloatArray, times: FloatArray) -> FloatArray:
    """(N, C) integrals of (N, C) values from the first of (N,) times, by trapezoids.

    As ``scipy.integrate.cumulative_trapezoid``, whose import takes longer than a sweep.
    """
    whole = np.zeros(values.shape)
    steps = np.diff(times)[:, None] * (values[1:] + values[:-1]) / 2.0
    np.cumsum(steps, axis=0, out=whole[1:])
    return whole


def voxel_keys(points: NDArray[np.floating], size: float, *, oblique: bool = False) -> IntArray:
    """One integer per voxel of edge length ``size``, metres; keys sort by x, then y, then z.

    The voxels of an ``oblique`` grid have their edges along (2, -1, 2), (2, 2, -1) and (-1, 2, 2),
    sqrt(1.5) times as long: walls have about as many voxels as in the other grid.
    What is built is upright and mostly along the axes of the map. Where a wall runs along a border
    of voxels, noise brings some of its points over that border, and as each voxel counts once,
    they pull the whole wall towards it. A border of an oblique grid runs along nothing.

    InputError if a point of (N, 3) or more columns is outside the grid of 2^20 voxels on either
    side of the origin, whose keys are distinct.
    """
    cells = _voxel_cells(points, size, oblique)
    if not _within_grid(cells):
        farthest = np.abs(points[:, :3]).max()
        raise InputError(
            f"points: expected metres within {_GRID * size:g} (2^20 voxels of {size:g} m) on each "
            f"axis, got {farthest:g}; use larger voxels"
        )
    return _packed_cells(cells)


def _voxel_cells(points: NDArray[np.floating], size: float, oblique: bool) -> IntArray:
    """(3, N) from (N, 3) or more columns."""
    axes = np.ascontiguousarray(points[:, :3].T)
    if oblique:  # by component: a matrix product may round a point otherwise among others
        x, y, z = axes * np.array(1.0 / (3.0 * OBLIQUE_EDGE), axes.dtype)
        axes = np.stack((2.0 * (x + z) - y, 2.0 * (x + y) - z, 2.0 * (y + z) - x))
    cells: IntArray = np.floor(axes / size).astype(np.int64) + _GRID
    return cells


def _within_grid(cells: IntArray) -> bool:
    return int(np.bitwise_or.reduce(cells, axis=None)) >> 21 == 0  # a negative number shifts to -1


def _packed_cells(cells: IntArray) -> IntArray:
    x, y, z = cells
    keys: IntArray = (x << 42) | (y << 21) | z
    return keys


def voxel_filter(points: NDArray[np.floating], size: float, *, oblique: bool = False) -> FloatArray:
    """Centroids (M, C) of the points in each voxel, ordered by voxel.

    Parameters
    ----------
    points : (N, C) with C >= 3: metres in the first three columns, anything that can be averaged
        (e.g. times) in the others
    size : edge length of a voxel, metres; 0 returns the points as they are
    oblique : see :func:`voxel_keys`
    """
    if size <= 0.0 or len(points) == 0:
        return np.asarray(points, dtype=np.float64)
    cells = _voxel_cells(points, size, oblique)
    if _within_grid(cells):
        keys = _packed_cells(cells)
    else:  # slower, but for any extent, and in the same order
        keys = np.unique(cells.T, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = run_starts(keys[1:] != keys[:-1])
    rows = points.take(order, axis=0)
    sums = np.add.reduceat(rows.astype(np.float64, copy=False), first, axis=0)
    counts = np.diff(np.append(first, len(keys)))
    centroids: FloatArray = sums / counts[:, None]
    return centroids


def find_in_sorted(sorted_keys: IntArray, keys: IntArray) -> tuple[IntArray, BoolArray]:
    """Positions at which (N,) keys are, or belong, among (M,) sorted keys; and which are there."""
    positions: IntArray = sorted_keys.searchsorted(keys)
    if len(sorted_keys) == 0:
        return positions, np.zeros(len(keys), np.bool_)
    present: BoolArray = sorted_keys.take(positions, mode="clip") == keys
    return positions, present


def run_starts(changes: BoolArray) -> IntArray:
    """Where the runs of a non-empty sequence begin, from ``sequence[1:] != sequence[:-1]``."""
    return np.flatnonzero(np.concatenate(([True], changes)))


def symmetric(matrix: FloatArray) -> FloatArray:
    """The symmetric part of a square matrix: what rounding made of a symmetric one is removed."""
    part: FloatArray = 0.5 * (matrix + matrix.T)
    return part
