"""Planes and lines eliminated from the normal equations of all poses.

With ``q = [p, 1]`` a point as seen from its sweep, ``T`` the pose of the sweep and
``pi = [n, d]`` a plane, a residual is ``pi^T T q``: linear in ``q``. All points that a sweep has on
a plane therefore count by the 4 x 4 sum of ``w q q^T`` alone, however many they are, at every
pose and for every plane. A line is where two planes meet. Equations: docs/maths/refine.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from scipy.sparse import bsr_array, csc_array, csr_array

from loam_gtsam.refine.landmarks import Landmarks, weighted_moments
from loam_gtsam.types import FloatArray, IntArray

_CHUNK = 200
"""Planes that are eliminated together, by one product of matrices."""
_LEAST_VIEWS = 4
"""Sightings of a line, of which the two halves are held against each other."""
_RIDGE = 1e-9
"""Share of its own information by which each freedom of a plane is held where it is."""
_NOISE = 0.5
"""Share of the information along a direction that may be noise of the normals."""
_MEDIAN = 0.4549 * 0.35
"""Median of the squared mean of a pair over its expected variance, if its points share no error:
that of chi-squared, times what the kernel takes from the mean of normal residuals (0.35)."""


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """What each sweep saw of each plane and line: M pairs, as sums over their points.

    Attributes
    ----------
    sweeps, landmarks : (M,) numbers of both
    moments : (M, 4, 4) sums of ``w q q^T`` over variance, 1 / m^2, in the frame of the sweep
    shared : metres, standard deviation of the error that all points have in common which a sweep
        has on a plane
    lasting : metres, of the error that the sightings of a line have in common
    """

    sweeps: IntArray
    landmarks: IntArray
    moments: FloatArray
    shared: float
    lasting: float


def sightings(points: FloatArray, sweeps: IntArray, landmarks: Landmarks) -> Sightings:
    """Compress points to pairs, and find what the points of a pair have in common.

    A surface is not the plane it is taken for, and the motion within a sweep not what it is thought
    to be: neighbours share such errors, and a thousand points on a wall do not know it thirty times
    as well as one. With ``s^2`` the variance of a pair's mean that the scatter of its points does
    not explain, found from the median over all pairs, a pair of n points of scatter ``c`` has the
    information ``1 / (s^2 + c^2 / n)`` in place of ``n / c^2``.

    An edge, as that of a step, may be taken to be too near for as long as it is seen from one side.
    So with ``l^2`` the variance that halves of the sightings of a line have beyond that, each of m
    sightings has another ``m l^2``.

    Parameters
    ----------
    points : (N, 3) metres, as seen from the middle of each sweep
    sweeps : (N,) numbers of the sweeps
    """
    mine, seen = points[landmarks.rows], sweeps[landmarks.rows]
    size = int(sweeps.max(initial=0)) + 1
    keys, pair = np.unique(landmarks.labels * size + seen, return_inverse=True)
    of_landmark, of_sweep = keys // size, keys % size
    weights = landmarks.weights
    counts = np.maximum(np.bincount(pair, weights, minlength=len(keys)), 1e-9)
    sums = [
        np.bincount(pair, weights * away, minlength=len(keys)) for away in landmarks.residuals.T
    ]
    means = np.stack(sums, axis=1) / counts[:, None]
    variances = landmarks.scatters[of_landmark] ** 2 / counts
    on_line = landmarks.is_line[of_landmark]
    shared = _common_variance(means[~on_line, :1], variances[~on_line])
    on_lines = _common_variance(means[on_line], variances[on_line])
    variances += np.where(on_line, on_lines, shared)
    lasting = _lasting_variance(means[on_line], variances[on_line], of_landmark[on_line])
    variances += lasting * np.bincount(of_landmark, minlength=len(landmarks))[of_landmark] * on_line
    moments = weighted_moments(mine, weights / (counts * variances)[pair], pair, len(keys))
    return Sightings(
        of_sweep, of_landmark, moments, float(np.sqrt(shared)), float(np.sqrt(lasting))
    )


def _lasting_variance(means: FloatArray, variances: FloatArray, lines: IntArray) -> float:
    """Variance l^2 of the mean of half the sightings of a line, beyond that by chance.

    Parameters
    ----------
    means, variances : (M, 2) and (M,) of the sightings along each normal
    lines : (M,) of which line, ascending; the sightings of a line are in the order of the sweeps
    """
    _, line, views = np.unique(lines, return_inverse=True, return_counts=True)
    place = np.arange(len(lines)) - (np.cumsum(views) - views)[line]
    half, count = 2 * line + (2 * place >= views[line]), 2 * len(views)
    sums = [np.bincount(half, some / variances, minlength=count) for some in (1.0, *means.T)]
    enough = views >= _LEAST_VIEWS
    information, *both = (column.reshape(-1, 2)[enough] for column in sums)
    halves = np.stack(both) / information
    apart = halves[..., 1] - halves[..., 0]
    return 0.5 * _common_variance(apart.T, (1.0 / information).sum(axis=1))


def _common_variance(means: FloatArray, expected: FloatArray) -> float:
    """Variance s^2 for which the median of ``means^2 / (s^2 + expected)`` is that of chance.

    The means are (M, K), along K normals each, and the expected variances (M,).
    """
    squared = means**2

    def excess(common: float) -> float:
        return float(np.median(squared / (common + expected)[:, None])) - _MEDIAN

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
class LandmarkTies:
    """What planes and lines that were eliminated tell of the poses that saw them.

    It is known about poses at which these were found, up to a motion of all together: a
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
        """Cost at poses (N, 4, 4) of all sweeps, above that where the landmarks were found."""
        moved = self._moved(poses)
        return float((self.gradient + 0.5 * self.hessian @ moved) @ moved)

    def equations(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information (6 K, 6 K) and gradient (6 K,) at poses (N, 4, 4) of all sweeps."""
        return self.hessian, self.gradient + self.hessian @ self._moved(poses)


def refitted(
    map_T_middle: FloatArray, landmarks: Landmarks, seen: Sightings
) -> tuple[Landmarks, float]:
    """Each plane and line where it fits the poses best, the weights kept, and the cost.

    The cost is half the squared, whitened residuals: a function of the poses alone.
    """
    relative = about_landmarks(map_T_middle, landmarks, seen)
    total = transformed_moments(relative, landmarks, seen)
    weight = np.maximum(total[:, 3, 3], 1e-300)
    means = total[:, :3, 3] / weight[:, None]
    spread = total[:, :3, :3] - weight[:, None, None] * means[:, :, None] * means[:, None, :]
    values, axes = np.linalg.eigh(spread)
    now = replace(landmarks, centres=landmarks.centres + means, axes=axes)
    across = np.append(values[:, 0], values[landmarks.is_line, 1])
    return now, 0.5 * float(np.maximum(across, 0.0).sum())


def about_landmarks(map_T_middle: FloatArray, landmarks: Landmarks, seen: Sightings) -> FloatArray:
    """Poses (M, 4, 4) of the sweeps about the centres of what they saw, the map's axes kept."""
    relative = map_T_middle[seen.sweeps].copy()
    relative[:, :3, 3] -= landmarks.centres[seen.landmarks]
    return relative


def transformed_moments(relative: FloatArray, landmarks: Landmarks, seen: Sightings) -> FloatArray:
    """(L, 4, 4) sums of the moments of each plane or line, about its centre, in the map's axes."""
    moments = relative @ seen.moments @ np.swapaxes(relative, 1, 2)
    return summed(moments, seen.landmarks, len(landmarks))


@dataclass(frozen=True, slots=True, eq=False)
class _Faces:
    """Landmarks as F planes: a line is where two meet, each of which turns along it alone.

    Attributes
    ----------
    normals : (F, 3)
    turns : (F, 3, 2) axes of the map towards which a normal may turn; zero where it may not
    landmarks : (F,) of which each is
    pairs, faces : (P,) which sighting it is, and of which face
    """

    normals: FloatArray
    turns: FloatArray
    landmarks: IntArray
    pairs: IntArray
    faces: IntArray

    @classmethod
    def of(cls, landmarks: Landmarks, seen: Sightings) -> _Faces:
        count, lines = len(landmarks), np.flatnonzero(landmarks.is_line)
        axes = np.concatenate([landmarks.axes, landmarks.axes[lines][:, :, [1, 0, 2]]])
        numbers = np.append(np.arange(count), lines)
        turns = axes[:, :, 1:].copy()
        turns[landmarks.is_line[numbers], :, 0] = 0.0
        again = np.flatnonzero(landmarks.is_line[seen.landmarks])
        second = count + np.searchsorted(lines, seen.landmarks[again])
        pairs = np.append(np.arange(len(seen.landmarks)), again)
        return cls(axes[:, :, 0], turns, numbers, pairs, np.append(seen.landmarks, second))


def seen_directions(map_T_middle: FloatArray, landmarks: Landmarks, seen: Sightings) -> FloatArray:
    """Projectors (N, 6, 6) of the poses onto what their planes and lines tell, noise apart.

    Normals are known to their noise: a thousand patches of flat ground, each tilted by a little of
    that, tell of every horizontal motion, and what they tell is wrong. With ``A`` the information
    of a sweep about its pose and ``B`` the part of it that the noise of the normals makes, a
    direction in which ``B`` is more than half of ``A`` is not seen, and is left to other factors.
    """
    count = len(map_T_middle)
    faces = _Faces.of(landmarks, seen)
    relative = about_landmarks(map_T_middle, landmarks, seen)
    spread = transformed_moments(relative, landmarks, seen)[faces.landmarks, :3, :3]
    relative, moments = relative[faces.pairs], seen.moments[faces.pairs]
    parts = []
    for axis in (faces.normals, faces.turns[:, :, 0], faces.turns[:, :, 1]):
        by_pose = _by_pose(relative, axis[faces.faces])
        by_sweep = by_pose @ moments @ np.swapaxes(by_pose, 1, 2)
        if axis is not faces.normals:
            known = np.einsum("ni,nij,nj->n", axis, spread, axis)
            by_sweep *= (1.0 / np.maximum(known, 1e-12))[faces.faces, None, None]
        parts.append(summed(by_sweep, seen.sweeps[faces.pairs], count))
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


def summed(values: FloatArray, groups: IntArray, count: int) -> FloatArray:
    """Sums (count, ...) of the values (M, ...) of each group."""
    rows = np.ones(len(groups)), groups, np.arange(len(groups) + 1)
    shape = values.shape[1:]
    flat = values.reshape(len(groups), int(np.prod(shape)))
    sums: FloatArray = csr_array(rows, shape=(len(groups), count)).T @ flat
    return sums.reshape(count, *shape)


def eliminated(
    map_T_middle: FloatArray,
    landmarks: Landmarks,
    seen: Sightings,
    keep: FloatArray | None = None,
) -> Reduced:
    """Gauss-Newton's equations of the poses, by the Schur complement of every plane and line.

    Parameters
    ----------
    map_T_middle : (N, 4, 4)
    landmarks : fitted at these poses
    keep : (N, 6, 6) of :func:`seen_directions`; None keeps all
    """
    count, faces = len(map_T_middle), _Faces.of(landmarks, seen)
    relative = about_landmarks(map_T_middle, landmarks, seen)[faces.pairs]
    moments, sweeps = seen.moments[faces.pairs], seen.sweeps[faces.pairs]
    normals, planes = faces.normals[faces.faces], len(faces.normals)
    local = np.einsum("nji,nj->ni", relative[:, :3, :3], normals)
    by_pose = _by_pose(relative, normals)
    if keep is not None:
        by_pose = np.swapaxes(keep, 1, 2)[sweeps] @ by_pose
    basis = np.zeros((planes, 4, 3))  # two turns of the normal, and the offset
    basis[:, :3, :2] = faces.turns
    basis[:, 3, 2] = 1.0
    by_plane = np.einsum("nji,njk->nik", relative, basis[faces.faces])
    plane = np.column_stack([local, np.einsum("ni,ni->n", normals, relative[:, :3, 3])])
    weighted = by_pose @ moments
    by_sweep = weighted @ np.swapaxes(by_pose, 1, 2)
    across = weighted @ by_plane
    pull = np.einsum("nij,nj->ni", weighted, plane)
    on_plane = moments @ by_plane
    of_planes = summed(np.swapaxes(by_plane, 1, 2) @ on_plane, faces.faces, planes)
    their_pull = summed(np.einsum("nji,nj->ni", on_plane, plane), faces.faces, planes)
    diagonal = np.arange(3)
    of_planes[:, diagonal, diagonal] *= 1.0 + _RIDGE
    of_planes[:, diagonal, diagonal] += 1e-12
    root = np.linalg.inv(np.linalg.cholesky(of_planes))
    across = across @ np.swapaxes(root, 1, 2)[faces.faces]
    their_pull = np.einsum("nij,nj->ni", root, their_pull)

    pull -= np.einsum("nij,nj->ni", across, their_pull[faces.faces])
    gradient = summed(pull, sweeps, count)
    blocks = summed(by_sweep, sweeps, count)
    hessian = bsr_array((blocks, np.arange(count), np.arange(count + 1)), shape=(6 * count,) * 2)
    hessian = hessian - _outer_products(across, sweeps, faces.faces, count, planes)
    return Reduced(csc_array(hessian), gradient.ravel())


def _outer_products(
    across: FloatArray, sweeps: IntArray, faces: IntArray, count: int, planes: int
) -> bsr_array:
    """Sum over the planes of the outer products of what ties them to the poses.

    Planes that were first seen at about the same time go together into one dense product, whose
    size is that of the stretch of sweeps that see them: cost and memory grow with the length of the
    drive, not with its square.
    """
    first = np.full(planes, count)
    np.minimum.at(first, faces, sweeps)
    rank = np.empty(planes, np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(planes)
    place = rank[faces]
    order = np.argsort(place, kind="stable")
    bounds = np.searchsorted(place[order], np.arange(0, planes + _CHUNK, _CHUNK))
    parts = [bsr_array((6 * count,) * 2, blocksize=(6, 6))]
    for begin, end in pairwise(bounds):
        some = order[begin:end]
        if not len(some):
            continue
        poses, row = np.unique(sweeps[some], return_inverse=True)
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
