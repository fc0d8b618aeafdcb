"""The avenue and the city: as long as asked, clear to drive, built once."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from loam_gtsam.datasets import build_city
from loam_gtsam.datasets.sim.world import Scene, SimulatedWorld, build_avenue
from loam_gtsam.types import ConfigError, FloatArray, InputError


def way_of(scene: Scene) -> FloatArray:
    """(N, 2) positions of the sensor in the world, one a sweep."""
    world = SimulatedWorld(scene)
    return (world.world_T_start @ world.truth.map_T_lidar)[:, :2, 3]


def distance_to_boxes(scene: Scene, points: FloatArray) -> FloatArray:
    """(N,) metres from each point of the plane to the nearest box, negative inside."""
    nearest = np.full(len(points), np.inf)
    for x, y, _, half_x, half_y, _, yaw in scene.solids.boxes:
        cosine, sine = np.cos(yaw), np.sin(yaw)
        local = (points - (x, y)) @ np.array([[cosine, -sine], [sine, cosine]])
        beyond = np.abs(local) - (half_x, half_y)
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        nearest = np.minimum(nearest, outside + np.minimum(beyond.max(axis=1), 0.0))
    return nearest


@pytest.mark.parametrize("metres", [100.0, 450.0, 3000.0])
def test_way_is_as_long_as_asked(metres: float) -> None:
    # It is left half a second, five metres, before its end, and corners are cut a little.
    world = SimulatedWorld(build_avenue(2, metres))
    assert world.truth.path_length == pytest.approx(metres, abs=15.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_way_is_clear_and_between_houses(seed: int) -> None:
    scene = build_avenue(seed, 1500.0)
    gaps = distance_to_boxes(scene, way_of(scene)[::3])
    assert gaps.min() > 2.0
    assert gaps.max() < 20.0  # to the very end


def test_it_turns_both_ways_and_never_comes_back() -> None:
    way = way_of(build_avenue(0, 4000.0))[::10]
    assert np.ptp(way[:, 0]) > 2000.0
    moved = np.diff(way, axis=0)
    turn = moved[:-1, 0] * moved[1:, 1] - moved[:-1, 1] * moved[1:, 0]
    assert turn.min() < -10.0
    assert turn.max() > 10.0
    apart = np.linalg.norm(way[:, None] - way[None], axis=2)
    along = np.abs(np.subtract.outer(np.arange(len(way)), np.arange(len(way))))
    assert apart[along > 40].min() > 100.0  # 40 steps are more than 200 m of way


def test_a_longer_way_begins_with_the_same_streets() -> None:
    short, long = build_avenue(0, 1000.0).solids, build_avenue(0, 3000.0).solids
    assert len(long.boxes) > 2 * len(short.boxes)
    same = int(0.7 * len(short.boxes))  # the last street leads beyond the end
    np.testing.assert_array_equal(short.boxes[:same], long.boxes[:same])
    np.testing.assert_array_equal(short.ground.waves, long.ground.waves)
    assert not np.array_equal(build_avenue(1, 1000.0).solids.boxes[:same], short.boxes[:same])


@pytest.mark.parametrize("metres", [99.0, -1.0, float("inf"), float("nan")])
def test_a_way_without_room_for_start_and_end_is_refused(metres: float) -> None:
    with pytest.raises(ConfigError, match="metres: expected at least 100"):
        build_avenue(0, metres)


def eight(laps=1.0, count=200):
    angle = np.linspace(0.0, 2.0 * np.pi * laps, int(count * laps))
    return np.stack([80.0 * np.sin(angle), 50.0 * np.sin(2.0 * angle)], axis=1)


def test_a_way_that_crosses_itself_stays_free():
    scene = build_city(eight())
    assert len(scene.solids.boxes) > 60
    assert len(scene.solids.cylinders) > 10
    assert distance_to_boxes(scene, scene.waypoints).min() > 2.0
    way = cKDTree(scene.waypoints)
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
