"""Scan matching as GTSAM factors: point to line, point to plane, one by one or a scan at once.

=========================================  ========================================================
You look for                               It is called here
=========================================  ========================================================
``PointToPlaneFactor``, one per match      :func:`point_to_plane_factor`
``PointToLineFactor`` (edge factor)        :func:`point_to_line_factor`
a batched or scan factor                   :func:`scan_match_factor` of :class:`MatchRows`
``CustomFactor`` with an own residual      :func:`checked_factor`, for variables of any type
``evaluateError`` without a factor         :func:`point_to_plane_residual`,
                                           :func:`point_to_line_residual`,
                                           :meth:`MatchRows.residuals`
=========================================  ========================================================

The functions return a :class:`gtsam.CustomFactor`; every one on a pose takes the key of a Pose3
``map_T_lidar`` and the noise model that GTSAM's own factors take, robust ones included.

Residuals (``q = R p + t``, pose ``map_T_lidar = (R, t)``, right perturbation ``[rot, trans]``):

* plane ``n . q + d = 0``: one row ``n . q + d``;
* line through ``c`` along ``u``: two rows ``e_i . (q - c)`` with ``e_1, e_2`` an orthonormal basis
  of the complement of ``u``. Their norm is LOAM's point-to-line distance, without its division by
  zero on the line.

A line match is thus two plane rows with normals ``e_i`` and offsets ``-e_i . c``, and every row
reads ``r = n . (R p) + n . t + d`` with derivative ``[p x R^T n, R^T n]``.

A row is *linear* in the 13 numbers ``z(T) = [vec(R), t, 1]``. A scan of M weighted rows is
therefore ``r = L z(T)`` with a constant (M, 13) matrix L, and any S with ``S^T S = L^T L`` gives
the same cost, gradient and Gauss-Newton Hessian at every pose: :func:`scan_match_factor` hands
GTSAM 13 rows however many matches a scan has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from loam_gtsam.errors import check_all, check_kind, check_number
from loam_gtsam.geometry import as_array, as_points, as_unit, as_vector, cross
from loam_gtsam.types import BoolArray, FloatArray, InputError, check_array

_RIDGE = 1e-9
"""Weight, relative to that of the planes, that pulls the anchor of :func:`scan_match_factor` to the
origin. It decides only where the planes leave the anchor free."""

Residual = Callable[[gtsam.Values], tuple[FloatArray, Sequence[FloatArray]]]
"""Maps values to (residual (m,), one Jacobian (m, dim) per key)."""


def point_to_plane_residual(
    map_T_lidar: gtsam.Pose3, point: FloatArray, normal: FloatArray, offset: float
) -> tuple[FloatArray, FloatArray]:
    """Signed distance (1,) of a point from the plane ``normal . q + offset = 0``; Jacobian (1, 6).

    Parameters
    ----------
    map_T_lidar : pose
    point : (3,) metres, lidar frame
    normal : (3,) unit, map frame
    offset : metres
    """
    offsets = np.array([offset], dtype=np.float64)
    return _row_residuals(map_T_lidar, point[None, :], normal[None, :], offsets)


def point_to_line_residual(
    map_T_lidar: gtsam.Pose3, point: FloatArray, centre: FloatArray, direction: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Offset (2,) of a point from a line, whose norm is the distance; Jacobian (2, 6).

    Parameters
    ----------
    map_T_lidar : pose
    point : (3,) metres, lidar frame
    centre, direction : (3,) a point on the line and its unit direction, map frame
    """
    basis = complement_basis(direction[None, :])[0]
    return _row_residuals(map_T_lidar, np.vstack([point, point]), basis, -basis @ centre)


def complement_basis(directions: FloatArray) -> FloatArray:
    """Two unit vectors (N, 2, 3) orthogonal to each of (N, 3) unit directions and to one another.

    Branch-free construction of Duff et al., Building an Orthonormal Basis, Revisited,
    JCGT 6(1), 2017; well conditioned for every direction.
    """
    x, y, z = directions.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    rows = [[1.0 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]]
    return np.ascontiguousarray(np.array(rows).transpose(2, 0, 1))


@dataclass(frozen=True, slots=True, eq=False)
class MatchRows:
    """Matches as whitened plane rows: ``r = scale * (n . (R p + t) + d)``.

    Attributes
    ----------
    points : (M, 3) metres, lidar frame
    normals : (M, 3) unit, map frame
    offsets : (M,) metres
    scales : (M,) match weight over standard deviation, 1 / metres
    """

    points: FloatArray
    normals: FloatArray
    offsets: FloatArray
    scales: FloatArray

    def __post_init__(self) -> None:
        points = as_points(self.points, "MatchRows.points")
        set_field = partial(object.__setattr__, self)
        set_field("points", points)
        set_field("normals", as_array(self.normals, "MatchRows.normals", points.shape))
        for name in ("offsets", "scales"):
            values = as_vector(getattr(self, name), f"MatchRows.{name}", len(points))
            set_field(name, values)

    def residuals(self, map_T_lidar: gtsam.Pose3) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (M,) and Jacobian (M, 6) at a pose."""
        residual, jacobian = _row_residuals(map_T_lidar, self.points, self.normals, self.offsets)
        return self.scales * residual, self.scales[:, None] * jacobian

    def where(self, chosen: BoolArray) -> MatchRows:
        """The rows for which an (M,) mask is true."""
        return MatchRows(
            self.points[chosen], self.normals[chosen], self.offsets[chosen], self.scales[chosen]
        )


def line_rows(
    points: ArrayLike,
    centres: ArrayLike,
    directions: ArrayLike,
    weights: ArrayLike,
    sigmas: ArrayLike,
) -> MatchRows:
    """Rows of M point-to-line matches (2 M rows).

    Parameters
    ----------
    points : (M, 3) metres, lidar frame
    centres, directions : (M, 3) each; metres and unit, map frame
    weights : (M,) multiply row and residual, as LOAM's s does
    sigmas : standard deviations of the distances, metres; (M,) or one for all

    Raises
    ------
    InputError
        If a shape is wrong or a value not finite.
    """
    p, c, u, w = (np.asarray(part, np.float64) for part in (points, centres, directions, weights))
    check_array(p, "points", ("N", 3))
    check_array(c, "centres", p.shape)
    check_array(u, "directions", p.shape)
    check_array(w, "weights", p.shape[:1])
    basis = complement_basis(u)
    offsets = -np.einsum("nij,nj->ni", basis, c)
    return MatchRows(
        np.repeat(p, 2, axis=0),
        basis.reshape(-1, 3),
        offsets.reshape(-1),
        np.repeat(np.divide(w, sigmas, dtype=np.float64), 2),
    )


def plane_rows(
    points: ArrayLike, normals: ArrayLike, offsets: ArrayLike, weights: ArrayLike, sigmas: ArrayLike
) -> MatchRows:
    """Rows of M point-to-plane matches; ``normals`` (M, 3) unit and ``offsets`` (M,) in metres.

    For the other parameters and the errors see :func:`line_rows`.
    """
    p, n = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    check_array(p, "points", ("N", 3))
    check_array(n, "normals", p.shape)
    scales = np.divide(weights, sigmas, dtype=np.float64)
    return MatchRows(p, n, np.asarray(offsets, np.float64), scales)


def concatenate_rows(parts: Sequence[MatchRows]) -> MatchRows:
    """All rows of several sets of matches, at least one."""
    check_all(parts, MatchRows, "parts", "line_rows and plane_rows make them")
    if not parts:
        raise InputError("parts: expected at least one set of rows, got none")
    names = ("points", "normals", "offsets", "scales")
    return MatchRows(*(np.concatenate([getattr(part, n) for part in parts]) for n in names))


def checked_factor(
    noise: gtsam.noiseModel.Base, keys: Sequence[int], residual: Residual
) -> gtsam.CustomFactor:
    """A CustomFactor that turns a faulty residual function into a Python error.

    GTSAM itself crashes the process on a Jacobian of the wrong shape and silently accepts one with
    the wrong number of columns, so shapes, dtypes and finiteness are checked here. The variables
    may be of any type that :class:`gtsam.Values` holds (poses, rotations, points, vectors, numbers,
    IMU biases, navigation states, calibrations): a Jacobian has as many columns as the variable has
    tangent directions.

    Parameters
    ----------
    noise : model of the residual's dimension
    keys : the variables, in the order of the Jacobians
    residual : see :data:`Residual`

    Raises
    ------
    InputError
        For anything but a noise model, a list of keys and a function; and from GTSAM's error and
        linearize calls, when ``residual`` returns something unusable.
    """
    rows = noise_dimension(noise)
    if not isinstance(keys, Sequence):
        raise InputError(f"keys: expected a list of keys, got {type(keys).__name__} {keys!r}")
    keys = [_checked_key(key) for key in keys]
    if not callable(residual):
        raise InputError(f"residual: expected a function, got {type(residual).__name__}")

    def call(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        error, derivatives = _both(residual(values))
        error = as_vector(error, "factor residual", rows)
        if jacobians is not None:
            if len(derivatives) != len(keys):
                raise InputError(
                    f"factor: expected {len(keys)} Jacobians, one per key, got {len(derivatives)}"
                )
            for slot, (key, block) in enumerate(zip(keys, derivatives, strict=True)):
                shape = (rows, _dimension(values, key))
                block = as_array(block, f"factor Jacobian {slot}", shape)
                jacobians[slot] = np.asfortranarray(block)
        return error

    return gtsam.CustomFactor(noise, keys, call)


def _both(returned: object) -> tuple[FloatArray, Sequence[FloatArray]]:
    """What a residual function returned; InputError if that is no residual with Jacobians."""
    pair: Any = returned if isinstance(returned, tuple) and len(returned) == 2 else (None, None)
    if isinstance(pair[1], (list, tuple)):
        return pair[0], pair[1]
    given = type(returned).__name__
    if isinstance(returned, tuple):
        given = f"({', '.join(type(part).__name__ for part in returned)})"
    raise InputError(
        "factor: expected the residual function to return (residual, [Jacobian of each key]); "
        f"got {given}; gtsam.utils.numerical_derivative differentiates functions"
    )


def point_to_plane_factor(
    key: int, point: ArrayLike, normal: ArrayLike, offset: float, noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """One point-to-plane match as a factor on the pose ``key``.

    Parameters
    ----------
    key : of a Pose3 ``map_T_lidar``
    point, normal : (3,) metres in the lidar frame, unit in the map frame
    offset : metres, the plane is ``normal . q + offset = 0``
    noise : 1-dimensional; may be robust

    Raises
    ------
    InputError
        If a shape is wrong, a value not finite, or the normal not of unit length.
    """
    p, n = as_vector(point, "point"), as_unit(normal, "normal")
    check_number(offset, "offset")
    noise_dimension(noise, 1)
    residual = partial(point_to_plane_residual, point=p, normal=n, offset=float(offset))
    return _pose_factor(key, noise, residual)


def point_to_line_factor(
    key: int,
    point: ArrayLike,
    centre: ArrayLike,
    direction: ArrayLike,
    noise: gtsam.noiseModel.Base,
) -> gtsam.CustomFactor:
    """One point-to-line match as a factor on the pose ``key``.

    Parameters
    ----------
    key : of a Pose3 ``map_T_lidar``
    point : (3,) metres, lidar frame
    centre, direction : (3,) a point on the line and its unit direction, map frame
    noise : 2-dimensional; may be robust

    Raises
    ------
    InputError
        As :func:`point_to_plane_factor` does.
    """
    p, c, u = (
        as_vector(point, "point"),
        as_vector(centre, "centre"),
        as_unit(direction, "direction"),
    )
    noise_dimension(noise, 2)
    return _pose_factor(key, noise, partial(point_to_line_residual, point=p, centre=c, direction=u))


def scan_match_factor(key: int, rows: MatchRows) -> gtsam.CustomFactor:
    """All matches of a scan, at least one, as one 13-row factor on the pose ``key``.

    Its error, gradient, Gauss-Newton Hessian and optimum are those of the sum of the per-match
    factors with sigma ``1 / scale`` (module docstring), at a cost per evaluation that does not
    depend on the number of matches. InputError if there are no rows.
    """
    residual = scan_match_residual(rows)
    return _pose_factor(key, gtsam.noiseModel.Unit.Create(13), residual)


def scan_match_residual(
    rows: MatchRows,
) -> Callable[[gtsam.Pose3], tuple[FloatArray, FloatArray]]:
    """The function of a pose behind :func:`scan_match_factor`: residual (13,), Jacobian (13, 6)."""
    check_kind(rows, MatchRows, "rows", "match_rows(matches) makes them")
    if len(rows.points) == 0:
        raise InputError("scan_match_factor: expected at least one match, got none")
    anchor, root = _compressed(rows)
    return partial(_compressed_residual, anchor=anchor, root=root)


def _compressed(rows: MatchRows) -> tuple[FloatArray, FloatArray]:
    """An anchor (3,) in the map and S (13, 13) with ``|S z|^2 = sum r^2``.

    Map coordinates are taken from the anchor, a point on the planes, so that the entries of L stay
    of the size of a scan. Where the planes hardly fix the anchor, the scan may be far from it. So
    these coordinates are along the eigenvectors of what the planes fix, and each column of L is
    scaled to its own size: the squared form loses no digits, however far the map extends.
    """
    normals = np.ascontiguousarray(rows.normals.T) * rows.scales
    offsets = rows.offsets * rows.scales
    matrix = np.empty((13, len(offsets)))
    np.multiply(normals[:, None], rows.points.T, out=matrix[:9].reshape(3, 3, -1))
    fixed, axes = np.linalg.eigh(normals @ normals.T)
    # Where no plane fixes the anchor it stays near the origin.
    held = fixed + _RIDGE * fixed.sum()
    along = matrix[9:12] = axes.T @ normals
    anchor = -(along @ offsets) / np.where(held > 0.0, held, 1.0)  # 0 if no row counts
    matrix[12] = offsets + anchor @ along
    form = matrix @ matrix.T
    sizes = np.sqrt(form.diagonal())
    sizes[sizes == 0.0] = 1.0
    values, vectors = np.linalg.eigh(form / np.outer(sizes, sizes))
    root: FloatArray = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * sizes
    root[:, 9:12] = root[:, 9:12] @ axes.T
    return axes @ anchor, root


_GENERATORS = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _GENERATORS[_i, _k, _j], _GENERATORS[_i, _j, _k] = 1.0, -1.0


def _compressed_residual(
    map_T_lidar: gtsam.Pose3, anchor: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    rotation = map_T_lidar.rotation().matrix()
    z = np.empty(13)
    z[:9] = rotation.ravel()
    z[9:12] = map_T_lidar.translation() - anchor
    z[12] = 1.0
    derivative = np.zeros((13, 6))
    # d(R)/d(omega_i) = R [e_i]x, d(t)/d(v) = R
    derivative[:9, :3] = (rotation @ _GENERATORS).reshape(3, 9).T
    derivative[9:12, 3:] = rotation
    return root @ z, root @ derivative


def _row_residuals(
    map_T_lidar: gtsam.Pose3, points: FloatArray, normals: FloatArray, offsets: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (M,) and Jacobian (M, 6) of plane rows."""
    rotation = map_T_lidar.rotation().matrix()
    local = normals @ rotation
    residual = np.einsum("ij,ij->i", local, points) + normals @ map_T_lidar.translation() + offsets
    return residual, np.hstack([cross(points.T, local.T).T, local])


def _pose_factor(
    key: int,
    noise: gtsam.noiseModel.Base,
    residual: Callable[[gtsam.Pose3], tuple[FloatArray, FloatArray]],
) -> gtsam.CustomFactor:
    """A factor on one pose whose residual is ours and needs no checking per call."""

    def call(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        error, derivative = residual(values.atPose3(key))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(derivative)
        return error

    return gtsam.CustomFactor(noise, [_checked_key(key)], call)


def _checked_key(key: object) -> int:
    if not isinstance(key, (int, np.integer)) or key < 0:
        raise InputError(f"key: expected a whole number, as gtsam.symbol('x', 7) is, got {key!r}")
    return int(key)


def _dimension(values: gtsam.Values, key: int) -> int:
    """Tangent dimension of a variable of any type."""
    try:
        values.atPose3(key)
    except RuntimeError:  # another type: looked up among all variables, which takes longer
        return int(values.zeroVectors().at(key).size)
    return 6


def noise_dimension(noise: gtsam.noiseModel.Base, dimension: int | None = None) -> int:
    """Rows of a noise model; InputError for anything else, or if they are not as many as said."""
    if not isinstance(noise, gtsam.noiseModel.Base):
        raise InputError(
            f"noise: expected a noise model of GTSAM, got {type(noise).__name__}; "
            "gtsam.noiseModel.Isotropic.Sigma(rows, sigma) makes one of a standard deviation"
        )
    rows: int = noise.dim()
    if dimension not in (None, rows):
        raise InputError(f"noise: expected dimension {dimension}, got {rows}")
    return rows
