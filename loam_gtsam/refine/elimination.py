"""Planes eliminated from the normal equations of all poses.

With ``q = [p, 1]`` a point as seen from its sweep, ``T`` the pose of the sweep and
``pi = [n, d]`` a plane, a residual is ``pi^T T q``: linear in ``q``. All points that a sweep has on
a plane therefore count by the 4 x 4 sum of ``w q q^T`` alone, however many they are, at every
pose and for every plane. Equations: docs/maths/refine.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from scipy.sparse import bsr_array, csc_array, csr_array

from loam_gtsam.refine.surfaces import Planes, weighted_moments
from loam_gtsam.types import FloatArray, IntArray

_CHUNK = 200
"""Planes that are eliminated together, by one product of matrices."""
_RIDGE = 1e-9
"""Share of its own information by which each freedom of a plane is held where it is."""
_NOISE = 0.5
"""Share of the information along a direction that may be noise of the normals."""
_MEDIAN = 0.4549 * 0.35
"""Median of the squared mean of a pair over its expected variance, if its points share no error:
that of chi-squared, times what the kernel takes from the mean of normal residuals (0.35)."""


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """What each sweep saw of each plane: M pairs, as sums over their points.

    Attributes
    ----------
    sweeps, planes : (M,) numbers of both
    moments : (M, 4, 4) sums of ``w q q^T`` over variance, 1 / m^2, in the frame of the sweep, about
        the plane's scatter and what the points of a pair have in common
    counts : (M,) sums of the weights
    shared : metres, standard deviation of the error that all points of a pair have in common
    """

    sweeps: IntArray
    planes: IntArray
    moments: FloatArray
    counts: FloatArray
    shared: float


def sightings(points: FloatArray, sweeps: IntArray, planes: Planes) -> Sightings:
    """Compress points to pairs, and find what the points of a pair have in common.

    A surface is not the plane it is taken for, and the motion within a sweep not what it is thought
    to be: neighbours share such errors, and a thousand points on a wall do not know it thirty times
    as well as one. With ``s^2`` the variance of a pair's mean that the scatter of its points does
    not explain, found from the median over all pairs, a pair of n points of scatter ``c`` has the
    information ``1 / (s^2 + c^2 / n)`` in place of ``n / c^2``.

    Parameters
    ----------
    points : (N, 3) metres, as seen from the middle of each sweep
    sweeps : (N,) numbers of the sweeps
    """
    mine, seen = points[planes.rows], sweeps[planes.rows]
    size = int(sweeps.max(initial=0)) + 1
    keys, pair = np.unique(planes.labels * size + seen, return_inverse=True)
    of_plane, of_sweep = keys // size, keys % size
    counts = np.bincount(pair, planes.weights, minlength=len(keys)).astype(np.float64)
    sums = np.bincount(pair, planes.weights * planes.residuals, minlength=len(keys))
    variances = planes.scatters[of_plane] ** 2
    means = sums / np.maximum(counts, 1e-9)
    shared = _common_variance(means, variances / np.maximum(counts, 1e-9))
    by = planes.weights / variances[pair] / (1.0 + counts * shared / variances)[pair]
    moments = weighted_moments(mine, by, pair, len(keys))
    return Sightings(of_sweep, of_plane, moments, counts, float(np.sqrt(shared)))


def _common_variance(means: FloatArray, expected: FloatArray) -> float:
    """Variance s^2 for which the median of ``means^2 / (s^2 + expected)`` is that of chance."""
    squared = means**2

    def excess(common: float) -> float:
        return float(np.median(squared / (common + expected))) - _MEDIAN

    if not len(means) or excess(0.0) <= 0.0:
        return 0.0
    low, high = 0.0, float(squared.max()) / _MEDIAN
    for _ in range(60):
        half = 0.5 * (low + high)
        low, high = (half, high) if excess(half) > 0.0 else (low, half)
    return high


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """Normal equations of N poses, planes eliminated: ``hessian x = -gradient``.

    Attributes
    ----------
    hessian : (6 N, 6 N) sparse
    gradient : (6 N,)
    """

    hessian: csc_array
    gradient: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PlaneTies:
    """What planes that were eliminated tell of the poses that saw them.

    It is known about poses at which the planes were found, up to a motion of all together: a
    quadratic form of where the others are, seen from one of them.

    Attributes
    ----------
    numbers : (K,) of the sweeps
    map_T_middle : (K, 4, 4) the poses there
    base : row of the pose from which the others are seen
    hessian : (6 K, 6 K)
    gradient : (6 K,)
    """

    numbers: IntArray
    map_T_middle: FloatArray
    base: int
    hessian: FloatArray
    gradient: FloatArray

    def _moved(self, poses: FloatArray) -> FloatArray:
        """(6 K,) tangents from where the poses were to where they are among all N."""
        base, now = self.map_T_middle[self.base], poses[self.numbers]
        to_base = gtsam.Pose3(base).compose(gtsam.Pose3(now[self.base]).inverse())
        then = (gtsam.Pose3(pose) for pose in self.map_T_middle)
        moved = [
            a.localCoordinates(to_base.compose(gtsam.Pose3(b)))
            for a, b in zip(then, now, strict=True)
        ]
        return np.concatenate(moved)

    def cost(self, poses: FloatArray) -> float:
        """Cost at poses (N, 4, 4) of all sweeps, above that where the planes were found."""
        moved = self._moved(poses)
        return float((self.gradient + 0.5 * self.hessian @ moved) @ moved)

    def equations(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information (6 K, 6 K) and gradient (6 K,) at poses (N, 4, 4) of all sweeps."""
        return self.hessian, self.gradient + self.hessian @ self._moved(poses)


def refitted(map_T_middle: FloatArray, planes: Planes, seen: Sightings) -> tuple[Planes, float]:
    """Each plane where it fits the poses best, the weights kept, and the cost.

    The cost is half the squared, whitened residuals: a function of the poses alone.
    """
    relative = about_planes(map_T_middle, planes, seen)
    total = transformed_moments(relative, planes, seen)
    weight = np.maximum(total[:, 3, 3], 1e-300)
    means = total[:, :3, 3] / weight[:, None]
    spread = total[:, :3, :3] - weight[:, None, None] * means[:, :, None] * means[:, None, :]
    values, axes = np.linalg.eigh(spread)
    now = replace(planes, centres=planes.centres + means, axes=axes)
    return now, 0.5 * float(np.maximum(values[:, 0], 0.0).sum())


def about_planes(map_T_middle: FloatArray, planes: Planes, seen: Sightings) -> FloatArray:
    """Poses (M, 4, 4) of the sweeps about the centres of the planes, the axes of the map kept."""
    relative = map_T_middle[seen.sweeps].copy()
    relative[:, :3, 3] -= planes.centres[seen.planes]
    return relative


def seen_directions(map_T_middle: FloatArray, planes: Planes, seen: Sightings) -> FloatArray:
    """Projectors (N, 6, 6) of the poses onto what their planes tell, noise apart.

    Normals are known to their noise: a thousand patches of flat ground, each tilted by a little of
    that, tell of every horizontal motion, and what they tell is wrong. With ``A`` the information
    of a sweep about its pose and ``B`` the part of it that the noise of the normals makes, a
    direction in which ``B`` is more than half of ``A`` is not seen, and is left to other factors.
    """
    count = len(map_T_middle)
    relative = about_planes(map_T_middle, planes, seen)
    spread = transformed_moments(relative, planes, seen)
    parts = []
    for column in range(3):
        axis = planes.axes[:, :, column]
        by_pose = _by_pose(relative, axis[seen.planes])
        own = by_pose @ seen.moments @ np.swapaxes(by_pose, 1, 2)
        if column > 0:
            known = np.einsum("ni,nij,nj->n", axis, spread[:, :3, :3], axis)
            own *= (1.0 / np.maximum(known, 1e-12))[seen.planes, None, None]
        parts.append(summed(own, seen.sweeps, count))
    whole, noise = parts[0], parts[1] + parts[2]
    values, vectors = np.linalg.eigh(whole)
    least = 1e-12 * np.maximum(values[:, -1:], 1e-12)
    root = vectors / np.sqrt(np.maximum(values, least))[:, None, :]
    shares, turned = np.linalg.eigh(np.swapaxes(root, 1, 2) @ noise @ root)
    directions = root @ turned  # of unit information, independent of one another
    clear = (shares < _NOISE) & (np.diagonal(whole, 0, 1, 2).sum(axis=1) > 0.0)[:, None]
    # sum over the clear ones of d d^T A: the others are mapped to zero
    keep: FloatArray = (directions * clear[:, None, :]) @ np.swapaxes(directions, 1, 2) @ whole
    return np.where(clear.all(axis=1)[:, None, None], np.eye(6), keep)


def _by_pose(relative: FloatArray, normals: FloatArray) -> FloatArray:
    """Matrices (M, 6, 4) of ``d r / d xi = by_pose q``, with the normals (M, 3) in the map."""
    local = np.einsum("nji,nj->ni", relative[:, :3, :3], normals)
    by_pose = np.zeros((len(local), 6, 4))  # [p x m, m]
    x, y, z = local.T
    by_pose[:, 0, 1], by_pose[:, 0, 2] = z, -y
    by_pose[:, 1, 0], by_pose[:, 1, 2] = -z, x
    by_pose[:, 2, 0], by_pose[:, 2, 1] = y, -x
    by_pose[:, 3:, 3] = local
    return by_pose


def transformed_moments(relative: FloatArray, planes: Planes, seen: Sightings) -> FloatArray:
    """(L, 4, 4) sums of the moments of each plane, about its centre, in the axes of the map."""
    moments = relative @ seen.moments @ np.swapaxes(relative, 1, 2)
    return summed(moments, seen.planes, len(planes))


def summed(values: FloatArray, groups: IntArray, count: int) -> FloatArray:
    """Sums (count, ...) of the values (M, ...) of each group."""
    rows = np.ones(len(groups)), groups, np.arange(len(groups) + 1)
    shape = values.shape[1:]
    flat = values.reshape(len(groups), int(np.prod(shape)))
    sums: FloatArray = csr_array(rows, shape=(len(groups), count)).T @ flat
    return sums.reshape(count, *shape)


def eliminated(
    map_T_middle: FloatArray, planes: Planes, seen: Sightings, keep: FloatArray | None = None
) -> Reduced:
    """Gauss-Newton's equations of the poses, by the Schur complement of every plane.

    Parameters
    ----------
    map_T_middle : (N, 4, 4)
    planes : fitted at these poses
    keep : (N, 6, 6) of :func:`seen_directions`; None keeps all
    """
    count = len(map_T_middle)
    normals = planes.axes[:, :, 0]
    relative = about_planes(map_T_middle, planes, seen)
    local = np.einsum("nji,nj->ni", relative[:, :3, :3], normals[seen.planes])
    by_pose = _by_pose(relative, normals[seen.planes])
    if keep is not None:
        by_pose = np.swapaxes(keep, 1, 2)[seen.sweeps] @ by_pose
    basis = np.zeros((len(planes), 4, 3))  # two turns of the normal, and the offset
    basis[:, :3, :2] = planes.axes[:, :, 1:]
    basis[:, 3, 2] = 1.0
    by_plane = np.einsum("nji,njk->nik", relative, basis[seen.planes])
    plane = np.concatenate(
        [local, np.einsum("ni,ni->n", normals[seen.planes], relative[:, :3, 3])[:, None]], axis=1
    )
    weighted = by_pose @ seen.moments
    own = weighted @ np.swapaxes(by_pose, 1, 2)
    across = weighted @ by_plane
    pull = np.einsum("nij,nj->ni", weighted, plane)
    on_plane = seen.moments @ by_plane
    of_planes = summed(np.swapaxes(by_plane, 1, 2) @ on_plane, seen.planes, len(planes))
    their_pull = summed(np.einsum("nji,nj->ni", on_plane, plane), seen.planes, len(planes))
    diagonal = np.arange(3)
    of_planes[:, diagonal, diagonal] *= 1.0 + _RIDGE
    of_planes[:, diagonal, diagonal] += 1e-12
    root = np.linalg.inv(np.linalg.cholesky(of_planes))
    across = across @ np.swapaxes(root, 1, 2)[seen.planes]
    their_pull = np.einsum("nij,nj->ni", root, their_pull)

    pull -= np.einsum("nij,nj->ni", across, their_pull[seen.planes])
    gradient = summed(pull, seen.sweeps, count)
    blocks = summed(own, seen.sweeps, count)
    hessian = bsr_array((blocks, np.arange(count), np.arange(count + 1)), shape=(6 * count,) * 2)
    hessian = hessian - _outer_products(across, seen, count, len(planes))
    return Reduced(csc_array(hessian), gradient.ravel())


def _outer_products(across: FloatArray, seen: Sightings, count: int, planes: int) -> bsr_array:
    """Sum over the planes of the outer products of what ties them to the poses.

    Planes that were first seen at about the same time go together into one dense product, whose
    size is that of the stretch of sweeps that see them: cost and memory grow with the length of the
    drive, not with its square.
    """
    first = np.full(planes, count)
    np.minimum.at(first, seen.planes, seen.sweeps)
    rank = np.empty(planes, np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(planes)
    place = rank[seen.planes]
    order = np.argsort(place, kind="stable")
    bounds = np.searchsorted(place[order], np.arange(0, planes + _CHUNK, _CHUNK))
    parts = [bsr_array((6 * count,) * 2, blocksize=(6, 6))]
    for begin, end in pairwise(bounds):
        some = order[begin:end]
        if not len(some):
            continue
        poses, row = np.unique(seen.sweeps[some], return_inverse=True)
        dense = np.zeros((len(poses), 6, _CHUNK, 3))
        dense[row, :, place[some] % _CHUNK] = across[some]
        flat = dense.reshape(6 * len(poses), 3 * _CHUNK)
        product = (flat @ flat.T).reshape(len(poses), 6, len(poses), 6).transpose(0, 2, 1, 3)
        tied = np.abs(product).max(axis=(2, 3)) > 0.0
        which = np.flatnonzero(tied.any(axis=1))
        where, other = np.nonzero(tied)
        starts = np.zeros(count + 1, np.int64)
        starts[poses[which] + 1] = tied.sum(axis=1)[which]
        parts.append(
            bsr_array(
                (product[where, other], poses[other], np.cumsum(starts)), shape=(6 * count,) * 2
            )
        )
    while len(parts) > 1:  # in pairs: neighbours overlap most
        rest = parts[len(parts) // 2 * 2 :]
        parts = [a + b for a, b in zip(parts[::2], parts[1::2], strict=False)] + rest
    return parts[0]
