"""Association: matches of features with lines and planes through their neighbours in the map."""

from __future__ import annotations

from dataclasses import replace

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
    joined_edges,
    subset,
)
from loam_gtsam.types import BoolArray, FloatArray, IntArray

_TINY = 1e-9


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
        matched before other edges. A distinct edge without a line near by is searched for more
        widely (``wide_search``) if the planes leave a translation open.
    """
    rows = chosen_rows(len(edges), len(planes), config, distinct)
    chosen = edges.take(rows.edges, axis=0), planes.take(rows.planes, axis=0)
    return match_features(*chosen, map_T_lidar, edge_map, plane_map, config, rows)


def chosen_rows(
    edges: int, planes: int, config: MatchingConfig, distinct: BoolArray | None = None
) -> ChosenRows:
    """Choose the features that are matched, from their numbers; see :func:`associate`."""
    if distinct is not None and distinct.all():
        distinct = None
    edge_rows = spread_rows(edges, config.max_edges, distinct)
    known = None if distinct is None else distinct[edge_rows]
    return ChosenRows(edge_rows, spread_rows(planes, config.max_planes), known)


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
    rows : rows of these features in the sweep
    reach : metres to the farthest neighbour; ``config.max_distance`` if None
    """
    pose = map_T_lidar.matrix()
    edges_map, planes_map = transform(pose, edges), transform(pose, planes)
    k, limit = config.neighbours, config.max_distance if reach is None else reach
    distinct = rows.distinct
    around = edge_map.neighbourhood(pose)
    near_edges = edge_map.nearest(edges_map, k, limit, around)
    near_planes = plane_map.nearest(planes_map, k, limit, plane_map.neighbourhood(pose))
    lines = match_lines(edges, edges_map, *near_edges, pose, config, limit)
    surfaces = match_planes(planes, planes_map, *near_planes, pose, config, limit)
    if distinct is not None:
        alone = distinct.copy()
        alone[lines.indices] = False
        left = np.flatnonzero(alone)
        if config.wide_search > 1.0 and len(left) and _fixed_by(surfaces) < config.wide_below:
            # A pole that few beams met has no five points within max_distance.
            far = config.wide_search * limit
            near_edges = edge_map.nearest(edges_map[left], k, far, around)
            more = match_lines(edges[left], edges_map[left], *near_edges, pose, config, far)
            lines = joined_edges(lines, replace(more, indices=left[more.indices]))
        lines = replace(lines, distinct=distinct[lines.indices])
    return ScanMatches(
        replace(lines, indices=rows.edges[lines.indices]),
        replace(surfaces, indices=rows.planes[surfaces.indices]),
    )


def _fixed_by(planes: PlaneMatches) -> float:
    """The least eigenvalue of ``sum n n^T - s^2 I``, s being the standard deviation of a normal."""
    # Planes that fix three translations face three ways, and then they fix the rotation as well.
    tilts = planes.tilts
    assert tilts is not None  # match_planes sets the tilts
    across = planes.normals.T @ planes.normals - (tilts @ tilts) * np.eye(3)
    return float(np.linalg.eigvalsh(across)[0])


def spread_rows(count: int, limit: int, first: BoolArray | None = None) -> IntArray:
    """At most ``limit`` of ``count`` rows, evenly spread; those of ``first`` before others."""
    if not 0 < limit < count:
        return np.arange(count)
    if first is None:
        return np.arange(limit) * count // limit
    before, after = np.flatnonzero(first), np.flatnonzero(~first)
    before = before[spread_rows(len(before), limit)]
    if len(before) == limit:
        return before
    return np.sort(np.concatenate([before, after[spread_rows(len(after), limit - len(before))]]))


def trial_matching(config: MatchingConfig) -> MatchingConfig:
    """The configuration for few matches, with which a pose is tried quickly."""

    def at_most(limit: int, most: int) -> int:
        return min(limit, most) if most else limit

    return config.changed(
        max_edges=at_most(config.trial_edges, config.max_edges),
        max_planes=at_most(config.trial_planes, config.max_planes),
    )


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
    return ScanMatches(edges, planes if keep.all() else subset(planes, keep))


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
) -> EdgeMatches:
    """Lines through the neighbours of edge features (LOAM, Section VI; constants in the config).

    An edge is a break along its ring, so that its line crosses the ring. Neighbours along a ring
    are not an edge but the trace of one beam on rough ground or foliage. That trace moves with the
    sensor and would hold the pose at the last one; such lines are rejected.

    Parameters
    ----------
    points, points_map : (N, 3) features in the lidar frame and in the map frame
    neighbours : (N, k, 3) their nearest map points
    squared_distances : (N, k) m^2, ascending, inf where missing
    map_T_lidar : (4, 4) pose; its z axis is the axis of the rings
    reach : metres to the farthest neighbour; ``config.max_distance`` if None
    """
    reach = config.max_distance if reach is None else reach
    near = np.flatnonzero(squared_distances[:, -1] < reach**2)
    here = np.ascontiguousarray(points_map.take(near, axis=0).T)
    centres, directions, eigenvalues = fit_lines(neighbours.take(near, axis=0))
    is_line = eigenvalues[2] > config.line_ratio * eigenvalues[1]
    ring = cross(map_T_lidar[:3, 2], here - map_T_lidar[:3, 3:])
    is_line &= np.abs(_dot(directions, ring)) <= (config.max_ring_cosine + _TINY) * _norm(ring)
    away = here - centres
    along = _dot(away, directions)
    distances = np.sqrt(np.maximum(_dot(away, away) - along**2, 0.0))
    weights = _line_weights(distances, config)
    keep = is_line & (weights > config.min_weight)
    # A line in space has four parameters, two for each of the directions across it.
    leverage = along**2 / np.maximum(eigenvalues[2], _TINY)
    fit = eigenvalues[1], eigenvalues[2], leverage
    sigmas, tilts = _deviations(*fit, 2, neighbours.shape[1], config)
    columns = (part[keep] for part in (distances, sigmas, weights, near, tilts))
    return EdgeMatches(points[near[keep]], centres.T[keep], directions.T[keep], *columns)


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
    near = np.flatnonzero(squared_distances[:, -1] < reach**2)
    # Memory order is axis by axis, as in all of the following arrays.
    axes = np.ascontiguousarray(neighbours.take(near, axis=0).transpose(2, 1, 0))
    here = np.ascontiguousarray(points_map.take(near, axis=0).T)
    group = axes.transpose(2, 1, 0)
    centres, normals, wide, eigenvalues = fit_planes(group)
    offsets = -_dot(normals, centres)
    if config.plane_fit == "unit_offset":
        normals, offsets = _unit_offset_planes(group)
    across = _dot(axes, normals[:, None, :]) + offsets
    is_plane = np.abs(across).max(axis=0) <= config.plane_tolerance
    is_plane &= eigenvalues[1] > config.plane_ratio * eigenvalues[2]
    away = here - centres
    distances = _dot(here, normals) + offsets
    rays = here - map_T_lidar[:3, 3:]
    ranges = _norm(rays)
    is_plane &= np.abs(_dot(normals, rays)) >= config.min_incidence_sine * ranges
    far = _norm(here) if config.weight_range == "map" else ranges
    weights = _plane_weights(distances, far, config)
    keep = is_plane & (weights > config.min_weight)
    along = _dot(away, wide)
    aside = np.maximum(_dot(away, away) - along**2 - distances**2, 0.0)
    leverage = along**2 / np.maximum(eigenvalues[2], _TINY)
    leverage += aside / np.maximum(eigenvalues[1], _TINY)
    fit = eigenvalues[0], eigenvalues[1], leverage
    sigmas, tilts = _deviations(*fit, 3, neighbours.shape[1], config)
    columns = (part[keep] for part in (offsets, distances, sigmas, weights, near, tilts))
    return PlaneMatches(points[near[keep]], normals.T[keep], *columns)


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
