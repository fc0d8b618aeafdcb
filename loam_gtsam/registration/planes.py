"""Planes through the neighbours of plane features: fits, their errors, and the side they show."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loam_gtsam.config import MatchingConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.geometry import (
    cross,
    dot,
    fit_planes,
    moments,
    norm,
    symmetric_eigenvalues,
    symmetric_eigenvector,
    transform,
)
from loam_gtsam.registration.matches import PlaneMatches, deviations, subset
from loam_gtsam.types import BoolArray, FloatArray, IntArray
from loam_gtsam.voxels.tags import LEAST_ANGLE, Faces, sines
from loam_gtsam.voxels.trees import Neighbours

_TINY = 1e-9
_MORE = 2
"""Times as many neighbours are searched for where those of one side are wanted: a wall has two."""
_ROUGH, _WRONG = 2.0, 4.0
"""A plane is rough if a neighbour lies farther off than twice the median of the sweep's planes, as
less than one in ten of flat ones do by noise. It is wrong by four times what is beyond that."""
_WIDE, _THICK = 32.0, 1.0
"""Metres along a floor or a wall, and across it, within which it may be flat. Of 16 beams two that
follow each other meet a floor 14 m away 4 m apart."""
_KEY = (1 << 18) - 1  # cells along an axis that are told apart: 262 km of a metre
_UNLIKE = 0.5  # sine of the angle between the normals of a point's own plane and of another surface
_SURE = 2.0  # standard deviations beyond which a difference is none of noise (95 %)
_RIM = 4.0
"""The leverage at the rim of an ellipse that points fill evenly: beyond it a plane extrapolates."""


def match_planes(
    points: FloatArray,
    points_map: FloatArray,
    neighbours: FloatArray,
    squared_distances: FloatArray,
    map_T_lidar: FloatArray,
    config: MatchingConfig,
    reach: float | None = None,
) -> PlaneMatches:
    """Planes through the neighbours of plane features (LOAM, Section VI; constants in the config).

    Scattered returns of one beam (foliage, grass) lie in the surface that the beam sweeps. A plane
    through such returns contains the viewing ray, moves with the sensor, and would hold the pose at
    the last one; such planes are rejected. Parameters are those of :func:`match_lines`.

    Notes
    -----
    Deviations from the published code: planes are fitted about the centroid, so that one through
    the map's origin is no special case, and the range in the weight is that from the sensor (as in
    LIO-SAM). ``plane_fit: unit_offset`` and ``weight_range: map`` give the published forms.
    """
    reach = config.max_distance if reach is None else reach
    rows = np.flatnonzero(squared_distances[:, -1] < reach**2)
    fits = _fit(neighbours.take(rows, axis=0), config)
    return _matched_planes(points, points_map, rows, fits, map_T_lidar, config)


def match_surfaces(
    points: FloatArray,
    map_T_lidar: FloatArray,
    plane_map: CubeMap,
    config: MatchingConfig,
    reach: float,
    most_leverage: float = np.inf,
) -> tuple[PlaneMatches, Faces]:
    """Match plane features with surfaces that show towards the lidar.

    Neighbours on two sides of a thin wall make one plane between the two. Where their views say so,
    the plane is fitted to those of this side alone, and there is no match if these are too few.
    Parameters are those of :func:`match_planes`; features of more than ``most_leverage``, see
    :func:`~loam_gtsam.registration.matches.deviations`, are not matched.

    Returns
    -------
    matches, faces : of the features, and those of them that have neighbours on another side
    """
    points_map, around = transform(map_T_lidar, points), plane_map.neighbourhood(map_T_lidar)
    k = config.neighbours
    near = plane_map.nearest(points_map, k, reach, around)
    rows = np.flatnonzero(near.squared[:, -1] < reach**2)
    fits = _fit(near.points.take(rows, axis=0), config)
    here = points_map.take(rows, axis=0).T
    sight = map_T_lidar[:3, 3:] - here
    sight /= np.maximum(norm(sight), _TINY)
    side = dot(fits.normals, sight)
    least = _least_sines(config.point_sigma, k, fits.eigenvalues[1])
    views, towards = near.views.take(rows, axis=0), _towards(fits.normals, sight, least)
    normals, surely = _wide_surfaces(here, fits.normals, config)
    facing = np.where(surely < least, _towards(normals, sight, surely), towards)
    least = np.minimum(surely, least)
    hidden = (sines(views, facing) < -least).any(axis=0)
    # A plane that is seen at a steeper angle now has moved more if ranges are too long.
    seen, away = sines(views, towards), map_T_lidar[:3, 3:] - fits.centres
    turned = seen.mean(axis=0) - dot(towards, away) / np.maximum(norm(away), _TINY)
    known = seen.any(axis=0) & ~hidden & (np.abs(turned) > LEAST_ANGLE)
    by_range = np.where(known, np.sign(side) * turned, 0.0)
    doubtful = np.flatnonzero(hidden & fits.planar)
    faces = Faces(rows[doubtful], facing.T[doubtful], least[doubtful])
    if len(doubtful):
        first, far = near.of(faces.rows), points_map.take(faces.rows, axis=0)
        more = plane_map.nearest(far, _MORE * k, reach, around)
        again, known = _on_this_side(first, more, faces, config)
        fits.planar[doubtful[~known]] = False
        better = again.planar
        for column, new in zip(fits, again, strict=True):
            column[..., doubtful[better]] = new[..., better]
    matches = _matched_planes(
        points, points_map, rows, fits, map_T_lidar, config, by_range, most_leverage
    )
    return matches, faces


def match_wide_surfaces(
    points: FloatArray,
    map_T_lidar: FloatArray,
    coarse: CubeMap,
    plane_map: CubeMap,
    config: MatchingConfig,
) -> PlaneMatches:
    """Match plane features with planes through points metres apart, held by the points near by.

    Points of a ``coarse`` map tell how a surface is inclined. Where it lies, the nearest points of
    ``plane_map`` tell: a wide plane cuts off a piece of a tank or a hill, and so lies behind it
    wherever it is seen. A plane is not extrapolated, because that would multiply the error of the
    last poses, by which its points were placed. Other parameters are those of :func:`match_planes`.
    """
    # Five points across a corner may lie in a plane by accident; seven seldom do.
    more = config.model_copy(update={"neighbours": config.neighbours + config.neighbours // 2})
    reach = config.wide_search * config.max_distance
    wide, _ = match_surfaces(points, map_T_lidar, coarse, more, reach, _RIM)
    here, around = transform(map_T_lidar, wide.points), plane_map.neighbourhood(map_T_lidar)
    near = plane_map.nearest(here, config.neighbours, config.max_distance, around)
    found = np.isfinite(near.squared)
    nearest = np.where(found[:, :, None], near.points, 0.0)
    off = np.einsum("mki,mi->mk", nearest, wide.normals) + wide.offsets[:, None]
    of_surface = found & (np.abs(off) <= config.plane_tolerance)
    count = np.maximum(np.count_nonzero(of_surface, axis=1), 1)
    shares = of_surface / count[:, None]
    moved = (shares * off).sum(axis=1)
    sigmas = wide.sigmas
    if config.fit_uncertainty:
        assert wide.tilts is not None  # match_surfaces sets the tilts
        apart = norm((here - np.einsum("mk,mki->mi", shares, nearest)).T)
        variances = config.point_sigma**2 * (1.0 + 1.0 / count) + (wide.tilts * apart) ** 2
        sigmas = np.where(of_surface.any(axis=1), np.sqrt(variances), sigmas)
    held = replace(wide, offsets=wide.offsets - moved, sigmas=sigmas)
    return at_distances(held, wide.distances - moved, here, config)


def at_distances(
    planes: PlaneMatches, distances: FloatArray, points_map: FloatArray, config: MatchingConfig
) -> PlaneMatches:
    """Matches whose points, (M, 3) in the map frame, are at other distances (M,) from their planes.

    They have the weights of these distances; those that weigh too little are left out.
    """
    far = points_map if config.weight_range == "map" else planes.points
    weights = plane_weights(distances, norm(far.T), config)
    keep = weights > config.min_weight
    planes = replace(planes, distances=distances, weights=weights)
    return planes if keep.all() else subset(planes, keep)


def translations_fixed(planes: PlaneMatches) -> FloatArray:
    """(3,) how many planes fix each of three translations, the one that they fix least first.

    They are counted as if they lay across it: the eigenvalues of ``sum n n^T - s^2 I``, s being the
    standard deviation of a normal.
    """
    # Planes that fix three translations face three ways, and then they fix the rotation as well.
    tilts = planes.tilts
    assert tilts is not None  # match_planes sets the tilts
    across = planes.normals.T @ planes.normals - (tilts @ tilts) * np.eye(3)
    fixed: FloatArray = np.linalg.eigvalsh(across).astype(np.float64)
    return fixed


def leaves_open(planes: PlaneMatches, config: MatchingConfig) -> bool:
    """Whether planes leave a translation open, so that edges are searched for more widely."""
    return config.wide_search > 1.0 and bool(translations_fixed(planes)[0] < config.wide_below)


def _on_this_side(
    first: Neighbours, more: Neighbours, faces: Faces, config: MatchingConfig
) -> tuple[_Fits, BoolArray]:
    """Planes through the neighbours of this side, and where (M,) there are enough of these.

    Such a plane is planar only if it explains the others among the ``first`` neighbours: they lie
    behind it, and were seen from behind.

    Parameters
    ----------
    first, more : k neighbours of M features, and more than k
    faces : of the planes through the first neighbours
    """
    facing, least = faces.normals.T, faces.least
    hidden = (sines(more.views, facing) < -least).T | np.isinf(more.squared)
    order = hidden.argsort(axis=1, kind="stable")[:, : config.neighbours]
    known = np.count_nonzero(~hidden, axis=1) >= config.neighbours
    order[~known] = 0  # no plane, but finite
    fits = _fit(np.take_along_axis(more.points, order[:, :, None], axis=1), config)
    normals = fits.normals * np.sign(dot(fits.normals, facing))
    depth = dot(first.points.T - fits.centres[:, None], normals[:, None])
    from_behind = sines(first.views, facing) < -least
    explained = ~from_behind | (depth < -_SURE * config.point_sigma)
    return fits._replace(planar=fits.planar & known & explained.all(axis=0)), known


def _towards(normals: FloatArray, sight: FloatArray, least: FloatArray) -> FloatArray:
    """(3, M) normals turned to where unit vectors (3, M) point; zero where these do not tell."""
    side = dot(normals, sight)
    turned: FloatArray = normals * (np.sign(side) * (np.abs(side) > least))
    return turned


def _least_sines(
    sigma: float | FloatArray, count: int | IntArray, spread: FloatArray
) -> FloatArray:
    """(M,) sines of the angles from which on a view is beyond the error of the normal.

    That is of ``count`` points, off their plane by ``sigma``, with the variance ``spread`` (M,)
    along their narrow extent.
    """
    least: FloatArray = _SURE * sigma / np.sqrt(count * np.maximum(spread, _TINY))
    return least


def _wide_surfaces(
    points: FloatArray, normals: FloatArray, config: MatchingConfig
) -> tuple[FloatArray, FloatArray]:
    """The surface about each of M points (3, M) of a sweep, by all around it that face alike.

    These are all of this side, and wider apart than the neighbours of one point, so that they tell
    a flat surface better than ``normals`` (3, M), which are by the neighbours.

    Returns
    -------
    normals, least : (3, M), and (M,) as of :func:`_least_sines`; infinite without such a surface
    """
    axis = np.abs(normals).argmax(axis=0)
    size = np.where(axis == np.arange(3)[:, None], _THICK, _WIDE)
    corner = np.floor(points / size)
    x, y, z = corner.astype(np.int64) & _KEY
    keys = (x << 38) | (y << 20) | (z << 2) | axis
    counts, cells = np.unique(keys, return_inverse=True, return_counts=True)[:0:-1]
    away = points - corner * size
    away -= np.array([np.bincount(cells, along) / counts for along in away])[:, cells]
    u, v, w = away
    pairs = ((u, u), (v, v), (w, w), (u, v), (v, w), (u, w))
    covariance = np.array([np.bincount(cells, a * b) / counts for a, b in pairs])
    eigenvalues = symmetric_eigenvalues(covariance)
    sigma = np.maximum(np.sqrt(np.maximum(eigenvalues[0], 0.0)), config.point_sigma)
    least = _least_sines(sigma, counts, eigenvalues[1])[cells]
    whole = symmetric_eigenvector(covariance, eigenvalues[0])[:, cells]
    least[norm(cross(whole, normals)) > _UNLIKE] = np.inf
    return whole, least


class _Fits(NamedTuple):
    """Planes through M groups of neighbours."""

    centres: FloatArray  # (3, M)
    normals: FloatArray  # (3, M)
    offsets: FloatArray  # (M,)
    wide: FloatArray  # (3, M) unit directions of the widest extent
    eigenvalues: FloatArray  # (3, M) variances across the plane and along its extents, ascending
    worst: FloatArray  # (M,) distance of the neighbour that is farthest from the plane
    planar: BoolArray  # (M,) whether the neighbours lie in the plane and span it


def _fit(neighbours: FloatArray, config: MatchingConfig) -> _Fits:
    """Planes through groups (M, k, 3)."""
    # Memory order is axis by axis, as in all of the following arrays.
    axes = np.ascontiguousarray(neighbours.transpose(2, 1, 0))
    group = axes.transpose(2, 1, 0)
    centres, normals, wide, eigenvalues = fit_planes(group)
    offsets = -dot(normals, centres)
    if config.plane_fit == "unit_offset":
        normals, offsets = _unit_offset_planes(group)
    across = dot(axes, normals[:, None, :]) + offsets
    worst = np.abs(across).max(axis=0)
    planar = worst <= config.plane_tolerance
    planar &= eigenvalues[1] > config.plane_ratio * eigenvalues[2]
    return _Fits(centres, normals, offsets, wide, eigenvalues, worst, planar)


def _matched_planes(
    points: FloatArray,
    points_map: FloatArray,
    rows: IntArray,
    fits: _Fits,
    map_T_lidar: FloatArray,
    config: MatchingConfig,
    by_range: FloatArray | None = None,
    most_leverage: float = np.inf,
) -> PlaneMatches:
    """The matches of some rows of the points with the planes fitted to their neighbours."""
    normals, offsets, eigenvalues = fits.normals, fits.offsets, fits.eigenvalues
    here = np.ascontiguousarray(points_map.take(rows, axis=0).T)
    away = here - fits.centres
    distances = dot(here, normals) + offsets
    rays = here - map_T_lidar[:3, 3:]
    ranges = norm(rays)
    seen = np.abs(dot(normals, rays)) >= config.min_incidence_sine * ranges
    far = norm(here) if config.weight_range == "map" else ranges
    weights = plane_weights(distances, far, config)
    keep = fits.planar & seen & (weights > config.min_weight)
    along = dot(away, fits.wide)
    aside = np.maximum(dot(away, away) - along**2 - distances**2, 0.0)
    leverage = along**2 / np.maximum(eigenvalues[2], _TINY)
    leverage += aside / np.maximum(eigenvalues[1], _TINY)
    keep &= leverage <= most_leverage
    sigmas, tilts = deviations(
        eigenvalues[0], eigenvalues[1], leverage, 3, config.neighbours, config
    )
    if config.fit_uncertainty:
        sigmas = np.hypot(sigmas, _misfit(fits, config.point_sigma))
    return PlaneMatches(
        points.take(rows[keep], axis=0),
        normals.T[keep],
        offsets[keep],
        distances[keep],
        sigmas[keep],
        weights[keep],
        rows[keep],
        tilts[keep],
        None if by_range is None else by_range[keep],
    )


def plane_weights(distances: FloatArray, ranges: FloatArray, config: MatchingConfig) -> FloatArray:
    """LOAM's weights (M,) of points at some distances (M,) from their planes, and ranges (M,)."""
    roots = np.sqrt(np.maximum(ranges, _TINY))
    weights: FloatArray = 1.0 - config.weight_slope * np.abs(distances) / roots
    return weights


def _misfit(fits: _Fits, noise: float) -> FloatArray:
    """Standard deviations (M,), metres, of planes through points that are not of one plane.

    Neighbours on both sides of a corner, or on two steps, make a plane that cuts the corner. It is
    known by a neighbour that lies much farther off than those of the sweep's other planes do, and
    farther than noise, the standard deviation of a point in metres: docs/maths/matching.md.
    """
    if not fits.planar.any():
        return np.zeros(len(fits.worst))
    usual = max(_ROUGH * float(np.median(fits.worst[fits.planar])), noise)
    beyond: FloatArray = _WRONG * np.sqrt(np.maximum(fits.worst**2 - usual**2, 0.0))
    return beyond


def _unit_offset_planes(neighbours: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Planes by the least squares A n = -1 of LOAM; unit normals (3, N), offsets (N,)."""
    # n = -a / (det C + m . a) with a = adj(C) m, mean m and covariance C (Sherman and Morrison on
    # A^T A = k (C + m m^T)). Where a vanishes, an infinite offset fails the plane test.
    means, (xx, yy, zz, xy, yz, xz) = moments(neighbours)
    rows = (
        (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy),
        (xz * yz - xy * zz, xx * zz - xz * xz, xy * xz - xx * yz),
        (xy * yz - xz * yy, xy * xz - xx * yz, xx * yy - xy * xy),
    )
    across = np.stack([x * means[0] + y * means[1] + z * means[2] for x, y, z in rows])
    determinant = xx * rows[0][0] + xy * rows[0][1] + xz * rows[0][2]
    scale = determinant + dot(means, across)
    length = norm(across)
    proper = (length > 0.0) & (scale != 0.0)
    length = np.where(proper, length, 1.0)
    normals = -np.sign(scale) * across / length
    offsets = np.where(proper, np.abs(scale) / length, np.inf)
    return normals, offsets
