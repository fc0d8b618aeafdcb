"""The first guess of where a way lies on the earth, which most of the fixes agree with."""

from __future__ import annotations

import gtsam
import numpy as np

from loam_gtsam.geometry import cross_matrix
from loam_gtsam.types import BoolArray, FloatArray

_TRIED = 40  # fixes, evenly over the way, of which pairs are tried
_DRIFT = 0.02  # of the distance from either fix of the pair, by which the way may be off
_LEANING = 0.3  # rad by which the z axis of a map that is not levelled may lean


def align_to_fixes(
    way: FloatArray, fixes: FloatArray, sigmas: FloatArray, up: FloatArray, *, levelled: bool
) -> tuple[FloatArray, BoolArray] | None:
    """The pose ``enu_T_map`` (4, 4) that most fixes agree with, and (N,) which do.

    Every pair of some fixes, with ``up``, tells a pose; a fix agrees if it is where the way is,
    to within three standard deviations and the drift of the way since the pair.

    Parameters
    ----------
    way, fixes : (N, 3) positions of the antenna in the map and in ENU, metres
    sigmas : (N,) standard deviations of the fixes along an axis
    up : (3,) unit vector that points up in the map
    levelled : whether ``up`` is known

    Returns
    -------
    tuple or None
        None if there are no two fixes that are far enough apart to tell a heading.
    """
    tried = np.unique(np.linspace(0, len(way) - 1, _TRIED).round().astype(np.int64))
    first, second = (tried[index] for index in np.triu_indices(len(tried), 1))
    level = _turn(up, np.array([0.0, 0.0, 1.0]))
    flat = way @ level.T
    here, there = flat[second] - flat[first], fixes[second] - fixes[first]
    apart = np.hypot(here[:, 0], here[:, 1])
    clear = apart > 3.0 * np.hypot(sigmas[first], sigmas[second])
    clear &= np.hypot(there[:, 0], there[:, 1]) > 0.0
    if not clear.any():
        return None
    share = _DRIFT if levelled else _DRIFT + _LEANING
    best: tuple[int, float, int] | None = None
    inliers = np.zeros(len(way), np.bool_)
    heading = np.arctan2(there[:, 1], there[:, 0]) - np.arctan2(here[:, 1], here[:, 0])
    found = np.eye(3)
    for number in np.flatnonzero(clear).tolist():
        a, b = first[number], second[number]
        turn = gtsam.Rot3.Yaw(heading[number]).matrix() @ level
        shift = 0.5 * ((fixes[a] + fixes[b]) - turn @ (way[a] + way[b]))
        away = np.linalg.norm(way @ turn.T + shift - fixes, axis=1)
        near = np.minimum(*(np.linalg.norm(way - way[index], axis=1) for index in (a, b)))
        allowed = 3.0 * np.hypot(sigmas, max(sigmas[a], sigmas[b])) + share * near
        good = away < allowed
        score = int(good.sum()), -float(away[good].sum()), -number
        if best is None or score > best:
            best, inliers, found = score, good, turn
    if not inliers.any():
        return np.eye(4), inliers
    turn, shift = _fit(way[inliers], fixes[inliers], found)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift
    return pose, inliers


def _fit(way: FloatArray, fixes: FloatArray, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rotation and shift that fit all of them, tilt as that of ``turn`` (least squares)."""
    middle, target = way.mean(axis=0), fixes.mean(axis=0)
    here, there = (way - middle) @ turn.T, fixes - target
    cross = (here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0]).sum()
    along = (here[:, 0] * there[:, 0] + here[:, 1] * there[:, 1]).sum()
    angle = np.arctan2(cross, along)
    turn = gtsam.Rot3.Yaw(angle).matrix() @ turn
    return turn, target - turn @ middle


def _turn(a: FloatArray, b: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes one unit vector to another."""
    cross, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1.0 + 1e-9:  # upside down: about the x axis
        return np.diag([1.0, -1.0, -1.0])
    skew = cross_matrix(cross)
    return np.asarray(np.eye(3) + skew + skew @ skew / (1.0 + cosine))
