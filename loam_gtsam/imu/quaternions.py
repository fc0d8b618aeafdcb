"""Many rotations at once, and the rotations that angular rates add up to.

Quaternions are x y z w, component first: (4, N), one pass over contiguous memory an operation.
Long products are taken by doubling (Hillis and Steele, Data parallel algorithms, CACM 29, 1986).
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from loam_gtsam.geometry import cross
from loam_gtsam.types import FloatArray


def quaternion_product(a: FloatArray, b: FloatArray) -> FloatArray:
    """(4, N) of the rotations ``a_k b_k``; either may be (4, 1)."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def inverse(q: FloatArray) -> FloatArray:
    """(4, N) of the opposite rotations."""
    return np.vstack([-q[:3], q[3:]])


def rotate(q: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors (3, N) turned by ``q`` (4, N) or (4, 1)."""
    twice = 2.0 * cross(q[:3], vectors)
    turned: FloatArray = vectors + q[3] * twice + cross(q[:3], twice)
    return turned


def exponential(vectors: FloatArray) -> FloatArray:
    """Quaternions (4, N) of rotation vectors (3, N), rad."""
    half = 0.5 * np.sqrt((vectors * vectors).sum(axis=0))
    # sin(h) / (2 h), through numpy's sinc(x) = sin(pi x) / (pi x), which knows its limit.
    return np.vstack([0.5 * np.sinc(half / np.pi) * vectors, np.cos(half)])


def logarithm(q: FloatArray) -> FloatArray:
    """Rotation vectors (3, N) of at most pi rad of unit quaternions (4, N)."""
    q = np.where(q[3] < 0.0, -q, q)
    sine = np.sqrt((q[:3] * q[:3]).sum(axis=0))
    angle = 2.0 * np.arctan2(sine, q[3])
    ratio = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-12)
    vectors: FloatArray = q[:3] * ratio
    return vectors


def rotation_steps(seconds: FloatArray, rates: FloatArray) -> FloatArray:
    """Rotation vectors (3, N - 1) from each time (N,) to the next.

    ``rates`` (3, N) are rad/s about the axes of the moving body, linear in between. Two terms of
    the Magnus expansion, whose second is the coning correction (Iserles and Norsett, On the
    solution of linear differential equations in Lie groups, 1999).
    """
    step = np.diff(seconds)
    before, after = rates[:, :-1], rates[:, 1:]
    vectors: FloatArray = 0.5 * step * (before + after) + step * step / 12.0 * cross(before, after)
    return vectors


def running_product(steps: FloatArray) -> FloatArray:
    """(4, N) of ``steps_0 steps_1 ... steps_k`` for every k."""
    product, shift = steps, 1
    while shift < steps.shape[1]:
        longer = quaternion_product(product[:, :-shift], product[:, shift:])
        product = np.hstack([product[:, :shift], longer])
        shift *= 2
    return product


def running_filter(keep: FloatArray, new: FloatArray, start: FloatArray) -> FloatArray:
    """(3, N) of ``y_k = keep_k y_(k-1) + new_k`` from ``y_(-1) = start`` (3,).

    ``keep`` (N,) may be zero anywhere, which forgets all that was before.
    """
    keep, y, shift = keep.copy(), new.copy(), 1
    while shift < len(keep):
        y[:, shift:] = y[:, shift:] + keep[shift:] * y[:, :-shift]
        keep[shift:] = keep[shift:] * keep[:-shift]
        shift *= 2
    filtered: FloatArray = y + keep * start[:, None]
    return filtered


def levelling(up: FloatArray) -> FloatArray:
    """Quaternions (4, N) of the shortest rotations that turn ``up`` (3, N, any length) to z.

    Where ``up`` points straight down the half turn is the one about x; where it is zero nothing is
    turned.
    """
    x, y, z = up / np.maximum(np.sqrt((up * up).sum(axis=0)), 1e-300)
    q = np.stack([y, -x, np.zeros_like(x), 1.0 + z])
    norm = np.sqrt((q * q).sum(axis=0))
    down = norm < 1e-9
    q[:, down] = [[1.0], [0.0], [0.0], [0.0]]
    norm[down] = 1.0
    levelled: FloatArray = q / norm
    return levelled


def as_rot3(q: FloatArray) -> gtsam.Rot3:
    """From x y z w (4,)."""
    x, y, z, w = q
    return gtsam.Rot3.Quaternion(w, x, y, z)


def from_rot3(rotation: gtsam.Rot3) -> FloatArray:
    """(4, 1) x y z w."""
    q: Any = rotation.toQuaternion()
    return np.array([[q.x()], [q.y()], [q.z()], [q.w()]])
