"""Registration of a sweep against another sweep as factors, with *both* poses free.

The keys are those of two Pose3, the *target* first: ``map_T_target`` and ``map_T_source``. Points
are in the frame of the source, and lines, planes and other points in the frame of the target, so
that the factors stay valid when both move. Every residual is one of
:mod:`loam_gtsam.factors` at ``target_T_source``.

=================================  ===============================================================
one match                          :func:`point_to_plane_between_factor`,
                                   :func:`point_to_line_between_factor`
all matches of a pair of sweeps    :func:`sweep_match_factor`, in 13 rows however many
=================================  ===============================================================

The rows of a pair come from :func:`loam_gtsam.factors.plane_rows`,
:func:`loam_gtsam.factors.line_rows`, both together (:func:`loam_gtsam.factors.concatenate_rows`),
or :func:`distribution_rows`, which matches surfaces with surfaces as GICP does.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from loam_gtsam.factors import (
    MatchRows,
    checked_factor,
    noise_dimension,
    point_to_line_residual,
    point_to_plane_residual,
    scan_match_residual,
)
from loam_gtsam.geometry import as_array, as_points, as_unit, as_vector, checked_pose
from loam_gtsam.types import FloatArray, InputError

OfPose = Callable[[gtsam.Pose3], tuple[FloatArray, FloatArray]]
"""Residual (m,) and Jacobian (m, 6) at a pose."""


def point_to_plane_between_factor(
    target: int, source: int, point: ArrayLike, normal: ArrayLike, offset: float,
    noise: gtsam.noiseModel.Base,
) -> gtsam.CustomFactor:  # fmt: skip
    """One point of a sweep on a plane of another.

    Parameters
    ----------
    target, source : keys of the two poses
    point : (3,) metres, frame of the source
    normal, offset : (3,) unit and metres, frame of the target; ``normal . q + offset = 0``
    noise : 1-dimensional; may be robust

    Raises
    ------
    InputError
        If a shape is wrong, a value not finite, the normal not of unit length, or both keys the
        same.
    """
    p, n = as_vector(point, "point"), as_unit(normal, "normal")
    if not np.isfinite(offset):
        raise InputError(f"offset: expected a finite number, got {offset}")
    residual = partial(point_to_plane_residual, point=p, normal=n, offset=float(offset))
    return _between(target, source, noise, 1, residual)


def point_to_line_between_factor(
    target: int, source: int, point: ArrayLike, centre: ArrayLike, direction: ArrayLike,
    noise: gtsam.noiseModel.Base,
) -> gtsam.CustomFactor:  # fmt: skip
    """One point of a sweep on a line of another.

    Parameters
    ----------
    target, source, point : as of :func:`point_to_plane_between_factor`
    centre, direction : (3,) a point on the line and its unit direction, frame of the target
    noise : 2-dimensional; may be robust

    Raises
    ------
    InputError
        As :func:`point_to_plane_between_factor` does.
    """
    p, c, u = (
        as_vector(point, "point"),
        as_vector(centre, "centre"),
        as_unit(direction, "direction"),
    )
    residual = partial(point_to_line_residual, point=p, centre=c, direction=u)
    return _between(target, source, noise, 2, residual)


def sweep_match_factor(target: int, source: int, rows: MatchRows) -> gtsam.CustomFactor:
    """All matches of a sweep with another one, at least one, in 13 rows.

    Cost, gradient and Gauss-Newton Hessian are those of the sum of the matches' own factors, at
    every pair of poses.

    Parameters
    ----------
    target, source : keys of the two poses
    rows : points in the frame of the source; normals and offsets in that of the target

    Raises
    ------
    InputError
        If there are no rows, or both keys are the same.
    """
    unit = gtsam.noiseModel.Unit.Create(13)
    return _between(target, source, unit, 13, scan_match_residual(rows))


def distribution_rows(
    points: ArrayLike, targets: ArrayLike, point_covariances: ArrayLike,
    target_covariances: ArrayLike, target_T_source: gtsam.Pose3,
) -> MatchRows:  # fmt: skip
    """Rows of N point pairs, whitened by the shape of both surfaces, as in generalized ICP.

    The residual of a pair is ``C^-1/2 (target_T_source p - q)`` with ``C`` the covariance of the
    target point plus that of the source point, turned by ``target_T_source``. The turn is kept as
    it is given: make the rows anew, as after any new association, when it has changed. See Segal,
    Haehnel and Thrun, Generalized-ICP, RSS 2009.

    Parameters
    ----------
    points, targets : (N, 3) metres, frames of the source and of the target
    point_covariances, target_covariances : (N, 3, 3) m^2, in the same frames
    target_T_source : where the two sweeps are thought to be

    Raises
    ------
    InputError
        If a shape is wrong, a value not finite, or a covariance not positive definite.
    """
    p = as_points(points, "points")
    q = as_array(targets, "targets", p.shape)
    shape = (len(p), 3, 3)
    of_points = as_array(point_covariances, "point_covariances", shape)
    of_targets = as_array(target_covariances, "target_covariances", shape)
    turn = checked_pose(target_T_source, "target_T_source").rotation().matrix()
    try:
        roots = np.linalg.cholesky(np.linalg.inv(of_targets + turn @ of_points @ turn.T))
    except np.linalg.LinAlgError as error:
        raise InputError(
            "covariances: expected positive definite matrices, got one that is not; give each a "
            "small variance across its surface"
        ) from error
    whitening = np.swapaxes(roots, 1, 2).reshape(-1, 3)
    scales = np.linalg.norm(whitening, axis=1)
    normals = whitening / scales[:, None]
    offsets = -np.einsum("ni,ni->n", normals, np.repeat(q, 3, axis=0))
    return MatchRows(np.repeat(p, 3, axis=0), normals, offsets, scales)


def _between(
    target: int, source: int, noise: gtsam.noiseModel.Base, rows: int, residual: OfPose
) -> gtsam.CustomFactor:
    """The factor on two poses of a residual at ``target_T_source``."""
    if target == source:
        raise InputError("target, source: expected the keys of two poses, got the same one twice")
    noise_dimension(noise, rows)

    def at(values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        motion = values.atPose3(target).between(values.atPose3(source))
        error, by_source = residual(motion)
        # Exp(-x) E = E Exp(-Ad_(E^-1) x)
        return error, [-by_source @ motion.inverse().AdjointMap(), by_source]

    return checked_factor(noise, [target, source], at)
