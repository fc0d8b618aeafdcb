"""Association against brute force: all distances, numpy's eigh, and the gates one by one."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import generators

from loam_gtsam.config import MapConfig, MatchingConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.registration.association import associate, rematched
from loam_gtsam.registration.matches import spread_rows

MAP = MapConfig(field_of_view=False)
EXACT = MatchingConfig(
    max_edges=0, max_planes=0, wide_search=1.0, fit_uncertainty=True, plane_fit="centroid"
)


def scene(rng: np.random.Generator) -> tuple[Any, Any]:
    """Points on poles and on walls, some rough, near and far from the origin of the map."""
    poles, walls = [], []
    for _ in range(6):
        foot = rng.uniform(-15, 15, 3)
        way = rng.normal(size=3) * [0.2, 0.2, 1.0]
        way /= np.linalg.norm(way)
        noise = rng.normal(0.0, rng.choice([0.0, 0.01, 0.2]), (12, 3))
        poles.append(foot + np.outer(rng.uniform(0, 2, 12), way) + noise)
        across = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        flat = rng.uniform(-2, 2, (60, 2)) @ across[:2]
        rough = rng.normal(0.0, rng.choice([0.0, 0.01, 0.2]), 60)
        walls.append(foot + flat + np.outer(rough, across[2]))
    return np.concatenate(poles), np.concatenate(walls)


def cubes_of(points: Any) -> CubeMap:
    cubes = CubeMap(MAP, 1e-3)
    cubes.insert(points)
    return cubes


def fit(query: Any, points: Any, config: MatchingConfig) -> Any:
    """The neighbours of a query, their mean, and the eigenvalues and -vectors of their scatter."""
    order = np.argsort(((points - query) ** 2).sum(axis=1), kind="stable")[: config.neighbours]
    near = points[order]
    if ((near[-1] - query) ** 2).sum() >= config.max_distance**2:
        return None
    centre = near.mean(axis=0)
    return near, centre, *np.linalg.eigh((near - centre).T @ (near - centre) / len(near))


def expected_line(query: Any, pose: Any, points: Any, config: MatchingConfig) -> Any:
    """Direction, centre, distance, weight and margins of the gates for one point, or None."""
    found = fit(query, points, config)
    if found is None:
        return None
    _, centre, values, vectors = found
    direction = vectors[:, 2]
    ray = query - pose[:3, 3]
    ring = np.cross(pose[:3, 2], ray)
    seen = direction - (direction @ ray) * ray / (ray @ ray)
    distance = np.linalg.norm(np.cross(query - centre, direction))
    weight = 1.0 - config.weight_slope * distance
    margins = [
        values[2] / max(config.line_ratio * values[1], 1e-12) - 1.0,
        config.max_ring_cosine * np.linalg.norm(seen) - abs(seen @ ring) / np.linalg.norm(ring),
        weight - config.min_weight,
    ]
    return direction, centre, distance, weight, margins


def expected_plane(query: Any, pose: Any, points: Any, config: MatchingConfig) -> Any:
    """Normal, offset, distance, weight and margins of the gates for one point, or None."""
    found = fit(query, points, config)
    if found is None:
        return None
    near, centre, values, vectors = found
    normal = vectors[:, 0]
    offset = -normal @ centre
    ray = query - pose[:3, 3]
    reach = np.linalg.norm(query if config.weight_range == "map" else ray)
    distance = normal @ query + offset
    weight = 1.0 - config.weight_slope * abs(distance) / np.sqrt(reach)
    margins = [
        config.plane_tolerance - np.abs(near @ normal + offset).max(),
        values[1] - config.plane_ratio * values[2],
        abs(normal @ ray) / np.linalg.norm(ray) - config.min_incidence_sine,
        weight - config.min_weight,
    ]
    return normal, offset, distance, weight, margins


CONFIGS = [
    EXACT,
    EXACT.changed(neighbours=7, max_distance=2.0),
    EXACT.changed(line_ratio=30.0, plane_ratio=0.3, plane_tolerance=0.05),
    EXACT.changed(max_ring_cosine=0.5, min_incidence_sine=0.4),
    EXACT.changed(weight_slope=5.0, min_weight=0.3, weight_range="map"),
]


@pytest.mark.parametrize("config", CONFIGS, ids=range(len(CONFIGS)))
@given(rng=generators())
def test_association_is_brute_force_with_gates(
    config: MatchingConfig, rng: np.random.Generator
) -> None:
    poles, walls = scene(rng)
    pose = gtsam.Pose3.Expmap(np.append(rng.normal(0, 0.5, 3), rng.normal(0, 3, 3)))
    back = np.linalg.inv(pose.matrix())
    edges_map = rng.permutation(poles)[:40] + rng.normal(0, 0.1, (40, 3))
    planes_map = rng.permutation(walls)[:60] + rng.normal(0, 0.1, (60, 3))
    edges, planes = (p @ back[:3, :3].T + back[:3, 3] for p in (edges_map, planes_map))
    maps = cubes_of(poles), cubes_of(walls)
    poles, walls = (cubes.points() for cubes in maps)  # of two in one voxel the map keeps one
    found = associate(edges, planes, pose, *maps, config)
    sets = (
        (edges_map, poles, expected_line, found.edges),
        (planes_map, walls, expected_plane, found.planes),
    )
    for queries, points, reference, matches in sets:
        rows = dict(zip(matches.indices.tolist(), range(len(matches)), strict=True))
        assert list(rows) == sorted(rows)
        for number, query in enumerate(queries):
            want = reference(query, pose.matrix(), points, config)
            if want is None or min(want[4]) < -1e-6:
                assert number not in rows
                continue
            if min(want[4]) < 1e-6:
                continue  # too close to call
            row = rows[number]
            axis, place, distance, weight, _ = want
            line = reference is expected_line
            axes = matches.directions if line else matches.normals
            sign = 1.0 if line else np.sign(axes[row] @ axis)
            assert abs(axes[row] @ axis) > 1.0 - 1e-6
            places, limit = (matches.centres, 1e-9) if line else (matches.offsets, 1e-4)
            np.testing.assert_allclose(sign * places[row], place, rtol=1e-6, atol=limit)
            assert sign * matches.distances[row] == pytest.approx(distance, abs=1e-5)
            assert matches.weights[row] == pytest.approx(weight, abs=1e-4)
            assert matches.sigmas[row] >= config.point_sigma


@given(rng=generators())
def test_renewed_matches_are_the_old_ones_seen_from_the_new_pose(rng: np.random.Generator) -> None:
    poles, walls = scene(rng)
    pose = gtsam.Pose3.Expmap(rng.normal(0, 0.02, 6))
    edges, planes = poles[::2], walls[::5]
    found = associate(edges, planes, pose, cubes_of(poles), cubes_of(walls), EXACT)
    again = rematched(found, pose, EXACT)
    assert len(again) == len(found)
    np.testing.assert_allclose(again.edges.distances, found.edges.distances, atol=1e-7)
    np.testing.assert_allclose(again.planes.distances, found.planes.distances, atol=1e-12)
    step = gtsam.Pose3.Expmap(rng.normal(0, 0.02, 6))
    after = rematched(found, pose.compose(step), EXACT)
    T = pose.compose(step).matrix()
    for match in range(len(after.planes)):
        there = T[:3, :3] @ after.planes.points[match] + T[:3, 3]
        distance = after.planes.normals[match] @ there + after.planes.offsets[match]
        assert after.planes.distances[match] == pytest.approx(distance, abs=1e-12)


@given(count=st.integers(0, 300), limit=st.integers(0, 320), rng=generators())
def test_what_is_spread_is_sorted_unique_and_prefers_the_first(
    count: int, limit: int, rng: np.random.Generator
) -> None:
    first = rng.random(count) < rng.random()
    for chosen in (spread_rows(count, limit), spread_rows(count, limit, first)):
        assert len(chosen) == (min(limit, count) if limit else count)
        assert (np.diff(chosen) > 0).all()
        assert len(chosen) == 0 or (chosen[0] >= 0 and chosen[-1] < count)
    preferred = first[spread_rows(count, limit, first)].sum()
    assert preferred == (min(first.sum(), limit) if limit else first.sum())
