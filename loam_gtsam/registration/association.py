"""Association: matches of features with lines and planes through their neighbours in the map.

Planes are made in :mod:`loam_gtsam.registration.planes`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.config import MatchingConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.errors import check_array, check_kind
from loam_gtsam.geometry import checked_pose, cross, dot, fit_lines, norm, transform
from loam_gtsam.registration.matches import (
    ChosenRows,
    EdgeMatches,
    ScanMatches,
    chosen_rows,
    deviations,
    joined,
    subset,
)
from loam_gtsam.registration.planes import at_distances, leaves_open, match_surfaces
from loam_gtsam.types import BoolArray, FloatArray

_TINY = 1e-9
_ON_ONE = 32
"""Features of a sweep at most on one upright thing: voxels on a pole."""
_LEAN = 0.1
"""Standard deviation, rad, of the angle between the axis of the rings and what stands upright."""


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

    Raises
    ------
    InputError
        If an argument is of another type or shape.
    """
    for name, features in {"edges": edges, "planes": planes}.items():
        check_array(features, name, ("N", 3))
    checked_pose(map_T_lidar, "map_T_lidar")
    for name, cubes in {"edge_map": edge_map, "plane_map": plane_map}.items():
        check_kind(cubes, CubeMap, name, "mapper.maps.edges and mapper.maps.planes are such")
    check_kind(config, MatchingConfig, "config", "it is config.matching")
    if distinct is not None:
        check_array(distinct, "distinct", (len(edges),), "flags")
    rows = chosen_rows(len(edges), len(planes), config, distinct)
    edges, planes = edges.take(rows.edges, axis=0), planes.take(rows.planes, axis=0)
    return match_features(edges, planes, map_T_lidar, edge_map, plane_map, config, rows)


def match_features(
    edges: FloatArray,
    planes: FloatArray,
    map_T_lidar: gtsam.Pose3,
    edge_map: CubeMap,
    plane_map: CubeMap,
    config: MatchingConfig,
    rows: ChosenRows,
    reach: float | None = None,
    *,
    expected: bool = False,
) -> ScanMatches:
    """Match chosen features; further parameters are those of :func:`associate`.

    Parameters
    ----------
    edges, planes : the chosen features, (E, 3) and (P, 3) metres, lidar frame
    rows : rows of these features in the sweep. Those that stand ``alone``, if the planes leave a
        translation open and they have no line, are matched with the map points near by.
    reach : metres to the farthest neighbour; ``config.max_distance`` if None
    expected : whether the pose is one where a motion leads, and none on trial: nothing upright is
        then matched with what may as well be the next one
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
            reaches = None
            if expected and rows.alone is not None:
                reaches = _half_ways(edges, rows.alone, config)
            for match, among, far in ways:
                chosen = np.flatnonzero(left & among)
                if not len(chosen):
                    continue
                here = edges_map[chosen]
                near, squared, _ = edge_map.nearest(here, k, far, around)
                if reaches is not None:
                    squared = _within(reaches[chosen], here, near, squared, pose[:3, 2])
                more = match(edges[chosen], here, near, squared, pose, config, far)
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


def _half_ways(points: FloatArray, uprights: BoolArray, config: MatchingConfig) -> FloatArray:
    """Metres (N,) across the axis of the rings, half way from each upright to the nearest other.

    What is farther from where one is expected may as well be that other one: among clouds of dust,
    or trunks, a wide search would find lines everywhere. Infinite for other features.
    """
    reaches = np.full(len(points), np.inf)
    if uprights.any():
        beside = points[uprights, :2]
        count = min(_ON_ONE, len(beside))
        apart = cKDTree(beside).query(beside, k=count)[0].reshape(len(beside), count)
        others = np.where(apart > 3.0 * config.point_sigma, apart, np.inf)
        reaches[uprights] = 0.5 * others.min(axis=1)
    return reaches


def _within(
    reaches: FloatArray, points_map: FloatArray, neighbours: FloatArray,
    squared_distances: FloatArray, axis: FloatArray,
) -> FloatArray:  # fmt: skip
    """The squared distances (N, k), infinite for what is beyond reach (N,) across an axis (3,)."""
    away = neighbours - points_map[:, None]
    across = away - (away @ axis)[:, :, None] * axis
    near = np.einsum("nki,nki->nk", across, across) <= reaches[:, None] ** 2
    return np.where(near, squared_distances, np.inf)


def rematched(
    matches: ScanMatches, map_T_lidar: gtsam.Pose3, config: MatchingConfig
) -> ScanMatches:
    """The matches with the same lines and planes at another pose."""
    pose = map_T_lidar.matrix()
    e, p = matches.edges, matches.planes
    away = (transform(pose, e.points) - e.centres).T
    along = dot(away, e.directions.T)
    distances = np.sqrt(np.maximum(dot(away, away) - along**2, 0.0))
    weights = _line_weights(distances, config)
    keep = weights > config.min_weight
    edges = replace(e, distances=distances, weights=weights)
    edges = edges if keep.all() else subset(edges, keep)
    points_map = transform(pose, p.points)
    distances = dot(points_map.T, p.normals.T) + p.offsets
    planes = at_distances(p, distances, points_map, config)
    return ScanMatches(edges, planes, faces=matches.faces)


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
        along_ring, seen = dot(directions, ring) * norm(rays), norm(cross(directions, rays))
        is_line &= np.abs(along_ring) <= (config.max_ring_cosine + _TINY) * seen * norm(ring)
    away = here - centres
    along = dot(away, directions)
    distances = np.sqrt(np.maximum(dot(away, away) - along**2, 0.0))
    weights = _line_weights(distances, config)
    # A line in space has four parameters, two for each of the directions across it.
    leverage = along**2 / np.maximum(eigenvalues[2], _TINY)
    count = neighbours.shape[1]
    sigmas, tilts = deviations(eigenvalues[1], eigenvalues[2], leverage, 2, count, config)
    points = points.take(near, axis=0)
    matches = EdgeMatches(points, centres.T, directions.T, distances, sigmas, weights, near, tilts)
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
    points, tilts = points.take(rows, axis=0), np.full(len(rows), _LEAN)
    ups = np.broadcast_to(up, centres.shape)
    matches = EdgeMatches(points, centres, ups, distances, sigmas, weights, rows, tilts)
    return subset(matches, weights > config.min_weight)


def _line_weights(distances: FloatArray, config: MatchingConfig) -> FloatArray:
    weights: FloatArray = 1.0 - config.weight_slope * distances
    return weights
