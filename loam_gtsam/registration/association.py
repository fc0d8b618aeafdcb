"""Association: matches of features with lines and planes through their neighbours in the map."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.config import MatchingConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.geometry import cross, fit_lines, fit_planes, moments, transform
from loam_gtsam.registration.matches import (
    ChosenRows,
    EdgeMatches,
    PlaneMatches,
    ScanMatches,
    chosen_rows,
    joined,
    subset,
)
from loam_gtsam.types import BoolArray, FloatArray, IntArray
from loam_gtsam.voxels.tags import Faces, sines
from loam_gtsam.voxels.trees import Neighbours

_TINY = 1e-9
_MORE = 2
"""Times as many neighbours are searched for where those of one side are wanted: a wall has two."""
_ROUGH, _WRONG = 2.0, 4.0
"""A plane is rough if a neighbour lies farther off than twice the median of the sweep's planes, as
less than one in ten of flat ones do by noise. It is wrong by four times what is beyond that."""
_LEAN = 0.1
"""Standard deviation, rad, of the angle between the axis of the rings and what stands upright."""
_SURE = 2.0  # standard deviations beyond which a difference is none of noise (95 %)


def associate(
    edges: FloatArray,
    planes: FloatArray,
    map_T_lidar: gtsam.Pose3,
    edge_map: CubeMap,
    plane_map: CubeMap,
    config: MatchingConfig,
    distinct: BoolArray | None = None,
) -> ScanMatches:
    """Match de-skewed features with the cubes around a pose.

    At most ``max_edges`` and ``max_planes`` features are matched, evenly spread over the rows and,
    as these are sorted by voxel, over the sweep.

    Parameters
    ----------
    edges, planes : (E, 3) and (P, 3) metres, lidar frame
    distinct : (E,) mask of :class:`EdgeMatches`; None if all edges are distinct. Distinct edges are
        matched before other edges. If the planes leave a translation open, a distinct edge without
        a line near by is searched for more widely (``wide_search``).
    """
    rows = chosen_rows(len(edges), len(planes), config, distinct)
    chosen = edges.take(rows.edges, axis=0), planes.take(rows.planes, axis=0)
    return match_features(*chosen, map_T_lidar, edge_map, plane_map, config, rows)


def match_features(
    edges: FloatArray,
    planes: FloatArray,
    map_T_lidar: gtsam.Pose3,
    edge_map: CubeMap,
    plane_map: CubeMap,
    config: MatchingConfig,
    rows: ChosenRows,
    reach: float | None = None,
) -> ScanMatches:
    """Match chosen features; further parameters are those of :func:`associate`.

    Parameters
    ----------
    edges, planes : the chosen features, (E, 3) and (P, 3) metres, lidar frame
    rows : rows of these features in the sweep. Those that stand ``alone``, if the planes leave a
        translation open and they have no line, are matched with the map points near by.
    reach : metres to the farthest neighbour; ``config.max_distance`` if None
    """
    pose = map_T_lidar.matrix()
    edges_map = transform(pose, edges)
    k, limit = config.neighbours, config.max_distance if reach is None else reach
    distinct = rows.distinct
    around = edge_map.neighbourhood(pose)
    near_edges = edge_map.nearest(edges_map, k, limit, around)
    in_map = partial(match_lines, level_rings=rows.level_rings)
    lines = in_map(edges, edges_map, *near_edges[:2], pose, config, limit)
    surfaces, faces = match_surfaces(planes, pose, plane_map, config, limit)
    if distinct is not None:
        left = distinct.copy()
        left[lines.indices] = False
        if left.any() and leaves_open(surfaces, config):
            # A pole that few beams met has no five points within max_distance, or only these.
            poles = rows.alone is not None and rows.alone
            ways = (in_map, True, config.wide_search * limit), (match_uprights, poles, limit)
            for match, among, far in ways:
                chosen = np.flatnonzero(left & among)
                if not len(chosen):
                    continue
                near = edge_map.nearest(edges_map[chosen], k, far, around)
                features = edges[chosen], edges_map[chosen], *near[:2]
                more = match(*features, pose, config, far)
                lines = joined(lines, replace(more, indices=chosen[more.indices]))
                left[lines.indices] = False
        lines = replace(lines, distinct=distinct[lines.indices])
    if rows.sigmas is not None and config.fit_uncertainty:
        # The points of the line missed the edge as the feature did, and all rings alike.
        variances = 2.0 * rows.sigmas[lines.indices] ** 2 - config.point_sigma**2
        sigmas = np.sqrt(lines.sigmas**2 + np.maximum(variances, 0.0))
        lines = replace(lines, sigmas=sigmas)
    return ScanMatches(
        replace(lines, indices=rows.edges[lines.indices]),
        replace(surfaces, indices=rows.planes[surfaces.indices]),
        faces=faces._replace(rows=rows.planes[faces.rows]),
    )


def match_surfaces(
    points: FloatArray,
    map_T_lidar: FloatArray,
    plane_map: CubeMap,
    config: MatchingConfig,
    reach: float,
) -> tuple[PlaneMatches, Faces]:
    """Match plane features with surfaces that show towards the lidar.

    Neighbours on two sides of a thin wall make one plane between the two. Where their views say so,
    the plane is fitted to those of this side alone, and there is no match if these are too few.
    Parameters are those of :func:`match_planes`.

    Returns
    -------
    matches, faces : of the features, and those of them that have neighbours on another side
    """
    points_map, around = transform(map_T_lidar, points), plane_map.neighbourhood(map_T_lidar)
    k = config.neighbours
    near = plane_map.nearest(points_map, k, reach, around)
    rows = np.flatnonzero(near.squared[:, -1] < reach**2)
    fits = _fit(near.points.take(rows, axis=0), config)
    sight = map_T_lidar[:3, 3:] - points_map.take(rows, axis=0).T
    side = _dot(fits.normals, sight) / np.maximum(_norm(sight), _TINY)
    # A view tells the side if its angle to the plane is beyond the error of the normal.
    spread = np.maximum(fits.eigenvalues[1], _TINY)
    least = _SURE * config.point_sigma / np.sqrt(k * spread)
    facing = fits.normals * (np.sign(side) * (np.abs(side) > least))
    hidden = (sines(near.views.take(rows, axis=0), facing) < -least).any(axis=0)
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
    return _matched_planes(points, points_map, rows, fits, map_T_lidar, config), faces


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
    normals = fits.normals * np.sign(_dot(fits.normals, facing))
    depth = _dot(first.points.T - fits.centres[:, None], normals[:, None])
    behind = (depth < -_SURE * config.point_sigma) & (sines(first.views, normals) < -least)
    explained = behind | (sines(first.views, facing) >= -least)
    return fits._replace(planar=fits.planar & known & explained.all(axis=0)), known


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


def rematched(
    matches: ScanMatches, map_T_lidar: gtsam.Pose3, config: MatchingConfig
) -> ScanMatches:
    """The matches with the same lines and planes at another pose."""
    pose = map_T_lidar.matrix()
    e, p = matches.edges, matches.planes
    away = (transform(pose, e.points) - e.centres).T
    along = _dot(away, e.directions.T)
    distances = np.sqrt(np.maximum(_dot(away, away) - along**2, 0.0))
    weights = _line_weights(distances, config)
    keep = weights > config.min_weight
    edges = replace(e, distances=distances, weights=weights)
    edges = edges if keep.all() else subset(edges, keep)
    points_map = transform(pose, p.points)
    distances = _dot(points_map.T, p.normals.T) + p.offsets
    reach = points_map if config.weight_range == "map" else p.points
    weights = _plane_weights(distances, _norm(reach.T), config)
    keep = weights > config.min_weight
    planes = replace(p, distances=distances, weights=weights)
    planes = planes if keep.all() else subset(planes, keep)
    return ScanMatches(edges, planes, faces=matches.faces)


def _line_weights(distances: FloatArray, config: MatchingConfig) -> FloatArray:
    weights: FloatArray = 1.0 - config.weight_slope * distances
    return weights


def _plane_weights(distances: FloatArray, ranges: FloatArray, config: MatchingConfig) -> FloatArray:
    roots = np.sqrt(np.maximum(ranges, _TINY))
    weights: FloatArray = 1.0 - config.weight_slope * np.abs(distances) / roots
    return weights


def match_lines(
    points: FloatArray,
    points_map: FloatArray,
    neighbours: FloatArray,
    squared_distances: FloatArray,
    map_T_lidar: FloatArray,
    config: MatchingConfig,
    reach: float | None = None,
    *,
    level_rings: bool = True,
) -> EdgeMatches:
    """Lines through the neighbours of edge features (LOAM, Section VI; constants in the config).

    An edge is a break along its ring, so that its line, as the lidar sees it, crosses the ring.
    Neighbours along a ring are the trace of one beam on rough ground, foliage or a wall beside the
    way. It moves with the sensor and would hold the pose at the last one: such lines are rejected.

    Parameters
    ----------
    points, points_map : (N, 3) features in the lidar frame and in the map frame
    neighbours : (N, k, 3) their nearest map points
    squared_distances : (N, k) m^2, ascending, inf where missing
    map_T_lidar : (4, 4) pose; its z axis is the axis of the rings, if there are (``level_rings``)
    reach : metres to the farthest neighbour; ``config.max_distance`` if None
    """
    reach = config.max_distance if reach is None else reach
    near = np.flatnonzero(squared_distances[:, -1] < reach**2)
    here = np.ascontiguousarray(points_map.take(near, axis=0).T)
    centres, directions, eigenvalues = fit_lines(neighbours.take(near, axis=0))
    is_line = eigenvalues[2] > config.line_ratio * eigenvalues[1]
    if level_rings:
        rays = here - map_T_lidar[:3, 3:]
        ring = cross(map_T_lidar[:3, 2], rays)
        along_ring, seen = _dot(directions, ring) * _norm(rays), _norm(cross(directions, rays))
        is_line &= np.abs(along_ring) <= (config.max_ring_cosine + _TINY) * seen * _norm(ring)
    away = here - centres
    along = _dot(away, directions)
    distances = np.sqrt(np.maximum(_dot(away, away) - along**2, 0.0))
    weights = _line_weights(distances, config)
    # A line in space has four parameters, two for each of the directions across it.
    leverage = along**2 / np.maximum(eigenvalues[2], _TINY)
    fit = eigenvalues[1], eigenvalues[2], leverage
    sigmas, tilts = _deviations(*fit, 2, neighbours.shape[1], config)
    columns = centres.T, directions.T, distances, sigmas, weights, near, tilts
    matches = EdgeMatches(points.take(near, axis=0), *columns)
    return subset(matches, is_line & (weights > config.min_weight))


def match_uprights(
    points: FloatArray,
    points_map: FloatArray,
    neighbours: FloatArray,
    squared_distances: FloatArray,
    map_T_lidar: FloatArray,
    config: MatchingConfig,
    reach: float,
) -> EdgeMatches:
    """Lines across the rings through the few neighbours of what stands alone.

    A car or a rock far away has one point on each of few rings: no five of them make a line. It is
    known to be within ``reach`` of them, evenly in a disc; that is a standard deviation of half of
    ``reach`` to either side, of the point as of each neighbour. How high it is stays open.
    Parameters are those of :func:`match_lines`.
    """
    found = squared_distances < reach**2
    rows = np.flatnonzero(found.any(axis=1))
    found = found.take(rows, axis=0)
    count = np.count_nonzero(found, axis=1)
    near = np.where(found[:, :, None], neighbours.take(rows, axis=0), 0.0)
    centres = near.sum(axis=1) / count[:, None]
    up = map_T_lidar[:3, 2]
    away = points_map.take(rows, axis=0) - centres
    distances = np.linalg.norm(away - (away @ up)[:, None] * up, axis=1)
    weights = _line_weights(distances, config)
    sigmas = 0.5 * reach * np.sqrt(1.0 + 1.0 / count)
    lines = centres, np.broadcast_to(up, centres.shape), distances, sigmas, weights
    tilts = np.full(len(rows), _LEAN)
    matches = EdgeMatches(points.take(rows, axis=0), *lines, rows, tilts)
    return subset(matches, weights > config.min_weight)


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
    offsets = -_dot(normals, centres)
    if config.plane_fit == "unit_offset":
        normals, offsets = _unit_offset_planes(group)
    across = _dot(axes, normals[:, None, :]) + offsets
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
) -> PlaneMatches:
    """The matches of some rows of the points with the planes fitted to their neighbours."""
    normals, offsets, eigenvalues = fits.normals, fits.offsets, fits.eigenvalues
    here = np.ascontiguousarray(points_map.take(rows, axis=0).T)
    away = here - fits.centres
    distances = _dot(here, normals) + offsets
    rays = here - map_T_lidar[:3, 3:]
    ranges = _norm(rays)
    seen = np.abs(_dot(normals, rays)) >= config.min_incidence_sine * ranges
    far = _norm(here) if config.weight_range == "map" else ranges
    weights = _plane_weights(distances, far, config)
    keep = fits.planar & seen & (weights > config.min_weight)
    along = _dot(away, fits.wide)
    aside = np.maximum(_dot(away, away) - along**2 - distances**2, 0.0)
    leverage = along**2 / np.maximum(eigenvalues[2], _TINY)
    leverage += aside / np.maximum(eigenvalues[1], _TINY)
    fit = eigenvalues[0], eigenvalues[1], leverage
    sigmas, tilts = _deviations(*fit, 3, config.neighbours, config)
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
    )


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
    scale = determinant + _dot(means, across)
    length = _norm(across)
    proper = (length > 0.0) & (scale != 0.0)
    length = np.where(proper, length, 1.0)
    normals = -np.sign(scale) * across / length
    offsets = np.where(proper, np.abs(scale) / length, np.inf)
    return normals, offsets


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    product: FloatArray = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


def _norm(vectors: FloatArray) -> FloatArray:
    length: FloatArray = np.sqrt(_dot(vectors, vectors))
    return length


def _deviations(
    roughness: FloatArray,
    spread: FloatArray,
    leverage: FloatArray,
    parameters: int,
    neighbours: int,
    config: MatchingConfig,
) -> tuple[FloatArray, FloatArray]:
    """Standard deviations (M,) of the distance of a new point, m, and the tilt of the fit, rad."""
    # ``roughness`` and ``spread`` are variances across and along the fit. Variance of prediction of
    # a regression: Draper and Smith, Applied Regression Analysis, 3rd ed., section 3.1.
    least = config.point_sigma**2
    scatter, variance = np.full((2, len(roughness)), least)
    if config.fit_uncertainty:
        freedom = max(neighbours - parameters, 1)
        scatter = np.maximum(roughness * neighbours / freedom, least)
        variance = scatter * (1.0 + (1.0 + leverage) / neighbours)
    return np.sqrt(variance), np.sqrt(scatter / (neighbours * np.maximum(spread, _TINY)))
