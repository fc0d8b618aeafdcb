"""A town around a way of one's own: nothing stands on it, nothing twice."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from loam_gtsam.datasets import SimulatedWorld, build_city
from loam_gtsam.types import InputError


def eight(laps=1.0, count=200):
    angle = np.linspace(0.0, 2.0 * np.pi * laps, int(count * laps))
    return np.stack([80.0 * np.sin(angle), 50.0 * np.sin(2.0 * angle)], axis=1)


def test_a_way_that_crosses_itself_stays_free():
    scene = build_city(eight())
    assert len(scene.solids.boxes) > 60
    assert len(scene.solids.cylinders) > 10
    way = cKDTree(scene.waypoints)
    x, y, _, half_x, half_y, _, yaw = scene.solids.boxes.T
    for u in (-1.0, 0.0, 1.0):
        for v in (-1.0, 0.0, 1.0):
            a, b = u * half_x, v * half_y
            corner = np.stack([x + np.cos(yaw) * a - np.sin(yaw) * b,
                               y + np.sin(yaw) * a + np.cos(yaw) * b], axis=1)  # fmt: skip
            assert way.query(corner)[0].min() > 2.0
    assert way.query(scene.solids.cylinders[:, :2])[0].min() > 2.5


def test_a_second_time_round_nothing_is_built_anew():
    once, twice = build_city(eight()), build_city(eight(2.0))
    houses = [np.count_nonzero(scene.solids.boxes[:, 4] == 5.0) for scene in (once, twice)]
    assert houses[1] <= 1.1 * houses[0]
    assert len(twice.waypoints) > 1.9 * len(once.waypoints)


def test_it_is_a_world_like_others_and_the_same_every_time():
    scenes = [build_city(eight(), seed=2) for _ in range(2)]
    first, second = (SimulatedWorld(scene, frames=3, columns=100)[2] for scene in scenes)
    np.testing.assert_array_equal(first.points, second.points)
    other = SimulatedWorld(build_city(eight(), seed=3), frames=3, columns=100)[2]
    assert other.points.shape != first.points.shape or (other.points != first.points).any()


@pytest.mark.parametrize(
    ("way", "said"),
    [
        (np.zeros((5, 3)), r"\(N, 2\)"),
        (np.zeros((0, 2)), "100 m"),
        (np.zeros((9, 2)), "100 m"),
        (np.full((4, 2), np.nan), "finite"),
    ],
)
def test_a_way_that_is_none_is_refused(way, said):
    with pytest.raises(InputError, match=said):
        build_city(way)
