"""Wide planes of a thin map: held by the points near by, and not extrapolated."""

import numpy as np
import pytest

from loam_gtsam.config import MapConfig, MatchingConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.registration.matches import PlaneMatches
from loam_gtsam.registration.planes import match_surfaces, match_wide_surfaces
from loam_gtsam.types import FloatArray

CONFIG = MatchingConfig()
LIDAR = np.eye(4)


def mapped(points: FloatArray) -> CubeMap:
    """A map of these points, seen from the origin."""
    planes = CubeMap(MapConfig(field_of_view=False), 0.4)
    planes.insert(points, np.zeros(3))
    return planes


def held(points: FloatArray, known: FloatArray, config: MatchingConfig = CONFIG) -> PlaneMatches:
    """The matches of points with wide planes through known ones."""
    planes = mapped(known)
    return match_wide_surfaces(points, LIDAR, planes.thinned(config.wide_search), planes, config)


def alone(points: FloatArray, known: FloatArray) -> PlaneMatches:
    """The same, of planes that are not held."""
    coarse = mapped(known).thinned(CONFIG.wide_search)
    more = CONFIG.changed(neighbours=7)
    return match_surfaces(points, LIDAR, coarse, more, CONFIG.wide_search * CONFIG.max_distance)[0]


def tank(along: FloatArray, heights: FloatArray) -> FloatArray:
    """Points of a round tank, 10 m in radius, ahead: metres along its rings, and up."""
    angle, z = (part.ravel() for part in np.meshgrid(np.pi + along / 10.0, heights))
    return np.column_stack([18.0 + 10.0 * np.cos(angle), 10.0 * np.sin(angle), z])


RINGS = np.arange(-1.2, 3.0, 1.2)
TANK = tank(np.arange(-4.0, 4.0, 0.25), RINGS)
BETWEEN = tank(np.arange(-2.06, 2.0, 0.25), RINGS[1:-1])  # points of the same rings

GROUND = np.stack(np.meshgrid([5.0, 6.5, 8.0], np.arange(-3.0, 3.1, 0.25)), axis=-1)
GROUND = np.column_stack([GROUND.reshape(-1, 2), np.full(GROUND.size // 2, -1.5)])


def test_on_a_tank_wide_planes_lie_behind_the_surface_and_held_ones_on_it() -> None:
    towards = [
        np.sign(-np.einsum("ij,ij->i", found.normals, found.points)) * found.distances
        for found in (alone(BETWEEN, TANK), held(BETWEEN, TANK))
    ]
    assert all(len(distances) > 0.8 * len(BETWEEN) for distances in towards)
    assert towards[0].mean() > 0.03
    assert abs(towards[1].mean()) < 0.3 * towards[0].mean()


def test_distances_and_weights_are_those_of_the_planes_that_are_held() -> None:
    found = held(BETWEEN + np.array([0.05, 0.0, 0.0]), TANK)
    expected = np.einsum("ij,ij->i", found.normals, found.points) + found.offsets
    np.testing.assert_allclose(found.distances, expected, atol=1e-12)
    ranges = np.linalg.norm(found.points, axis=1)
    weights = 1.0 - CONFIG.weight_slope * np.abs(found.distances) / np.sqrt(ranges)
    np.testing.assert_allclose(found.weights, weights, atol=1e-12)
    assert found.sigmas.min() > CONFIG.point_sigma
    exact = held(BETWEEN, TANK, CONFIG.changed(fit_uncertainty=False))
    np.testing.assert_array_equal(exact.sigmas, CONFIG.point_sigma)


@pytest.mark.parametrize(("step", "moves"), [(0.05, True), (0.2, False)])
def test_points_of_another_surface_do_not_hold_a_plane(step: float, moves: bool) -> None:
    """What lies a little aside is of the surface, what lies farther off may be its other side."""
    points = np.array([[6.5, 0.125, -1.5]])
    beside = points + [[x, y, step] for x in (-0.3, 0.3) for y in (-0.3, 0.3)]
    far = np.linalg.norm(GROUND - points, axis=1) > 1.0
    planes, coarse = mapped(np.vstack([GROUND[far], beside])), mapped(GROUND).thinned(4.0)
    (distance,) = match_wide_surfaces(points, LIDAR, coarse, planes, CONFIG).distances
    assert abs(distance) == pytest.approx(step if moves else 0.0, abs=1e-6)


def test_a_plane_counts_between_its_points_and_not_beyond_them() -> None:
    """A point half way to the next ring, and one a whole ring beyond the last one of the map."""
    between, beyond = np.array([[7.4, 0.1, -1.5]]), np.array([[9.5, 0.1, -1.5]])
    assert len(alone(between, GROUND)) == len(held(between, GROUND)) == 1
    assert len(alone(beyond, GROUND)) == 1
    assert len(held(beyond, GROUND)) == 0
