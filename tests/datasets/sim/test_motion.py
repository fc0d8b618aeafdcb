"""The moving start is the same drive, later; what moves is where closed form says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets import open_dataset
from loam_gtsam.datasets.sim.motion import GRAVITY
from loam_gtsam.datasets.sim.raycast import Ground, Solids, cast_rays
from loam_gtsam.datasets.sim.ways import Mover, points_along, rounded
from loam_gtsam.datasets.sim.world import SCENES, SimulatedWorld
from loam_gtsam.types import ConfigError, DatasetError

PERFECT_IMU = dict.fromkeys(("imu_noise", "gyro_noise", "acceleration_noise"), 0.0)
PERFECT_IMU |= dict.fromkeys(("gyro_bias", "acceleration_bias"), (0.0, 0.0, 0.0))
LATER = 35  # sweeps from rest to the moving start


@pytest.mark.parametrize("scene", ["street_loop", "avenue", "rooms", "bridge"])
def test_a_moving_start_is_the_same_drive_three_and_a_half_seconds_later(scene):
    rest = SimulatedWorld(scene, frames=60, columns=90, **PERFECT_IMU)
    moving = SimulatedWorld(scene, frames=20, columns=90, start="moving", **PERFECT_IMU)
    from_there = np.linalg.inv(rest.truth.map_T_lidar[LATER])
    expected = from_there @ rest.truth.map_T_lidar[LATER : LATER + 20]
    assert np.array_equal(moving.truth.map_T_lidar[0], np.eye(4))
    assert np.allclose(moving.truth.map_T_lidar, expected, atol=1e-9)
    assert moving.truth.stamps[0] == rest.truth.stamps[0]
    later = rest.imu.stamps >= rest.truth.stamps[LATER] - 200_000_000
    count = len(moving.imu.stamps)
    for ours, theirs in (
        (moving.imu.gyro, rest.imu.gyro),
        (moving.imu.acceleration, rest.imu.acceleration),
        (moving.imu.orientation, rest.imu.orientation),
    ):
        assert np.allclose(ours, theirs[later][:count], atol=1e-3)


@pytest.mark.parametrize("scene", SCENES)
def test_every_scene_can_start_at_full_speed(scene):
    world = SimulatedWorld(scene, start="moving", **PERFECT_IMU)
    positions = world.truth.positions
    first = np.linalg.norm(positions[1] - positions[0]) * 10.0
    assert 0.65 * world.scene.speed < first < 1.5 * world.scene.speed
    # What the IMU says from before the first sweep on: truth itself, turned and moved.
    imu = world.imu
    poses = world.world_T_start @ world.truth_at(imu.stamps[:400]).map_T_lidar
    attitude = Rotation.from_matrix(poses[:, :3, :3])
    turned = attitude[0]
    for step in Rotation.from_rotvec(0.5 * (imu.gyro[1:400] + imu.gyro[:399]) * 0.005):
        turned = turned * step
    assert (turned.inv() * attitude[-1]).magnitude() < 1e-3
    pull = attitude.apply(imu.acceleration[:400]) - (0.0, 0.0, GRAVITY)
    gained = np.sum(0.5 * (pull[1:] + pull[:-1]) * 0.005, axis=0)
    ends = [(poses[i + 1] - poses[i])[:3, 3] / 0.005 for i in (0, -2)]
    assert np.allclose(gained, ends[1] - ends[0], atol=0.05)


def test_the_start_is_chosen_by_name():
    world = open_dataset("sim:room?frames=3&columns=90&start=moving")
    assert np.linalg.norm(world.truth.map_T_lidar[1, :3, 3]) > 0.05
    with pytest.raises(ConfigError, match="start: expected one of rest, moving; got 'flying'"):
        SimulatedWorld("room", start="flying")
    with pytest.raises(DatasetError, match="frames: expected a number"):
        open_dataset("sim:room?frames=many")


PLACES = ("park", "forest", "square", "bridge")
PLACES += ("rooms", "tunnel_pilasters", "garage", "stairwell")


@pytest.mark.parametrize("scene", PLACES)
def test_places_are_random_by_seed_and_by_nothing_else(scene):
    first, again, other = (
        SimulatedWorld(scene, columns=120, sensor=sensor, seed=seed)
        for sensor, seed in (("os1-32", 1), ("os1-32", 1), ("os1-32", 2))
    )
    assert np.array_equal(first[9].points, again[9].points)
    assert not np.array_equal(first[9].points[:50], other[9].points[:50])
    assert 100 <= len(first) <= 300
    for sensor, rings in (("vlp16", 16), ("hdl64", 64)):
        scan = SimulatedWorld(scene, sensor=sensor, columns=120, frames=5)[4]
        assert len(np.unique(scan.rings)) >= rings // 2
        assert np.linalg.norm(scan.points, axis=1).max() < 100.5


def test_who_walks_there_and_back_is_where_a_triangle_wave_says():
    walker = Mover(np.array([[2.0, 1.0], [5.0, 5.0]]), (0.25,), 0.0, 1.7, 1.25, start=3.0)
    times = np.linspace(-4.0, 30.0, 200)
    gone = (3.0 + 1.25 * times) % 10.0  # 5 m there, 5 m back
    share = (5.0 - np.abs(gone - 5.0)) / 5.0
    places, _ = walker.places(times)
    assert np.allclose(places, [2.0, 1.0] + share[:, None] * [3.0, 4.0], atol=1e-9)


def test_a_car_heads_where_it_goes():
    angle = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)
    ring = 20.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    car = Mover(ring, (2.0, 0.9), 0.2, 1.4, 6.0)
    times = np.linspace(0.0, 40.0, 50)
    places, heading = car.places(times)
    turned = 6.0 / 20.0 * times
    # Both axles are on the ring: the middle is a little inside it.
    inside = np.sqrt(20.0**2 - 2.0**2)
    expected = inside * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    assert np.allclose(places, expected, atol=0.01)
    off = heading - turned - 0.5 * np.pi
    assert np.abs((off + np.pi) % (2.0 * np.pi) - np.pi).max() < 2e-3


def test_each_column_sees_what_moves_where_it_is_by_then():
    """A box as wide as a wall comes nearer by 2 m while one sweep is taken."""
    box = Mover(np.array([[40.0, 0.0], [-160.0, 0.0]]), (1.0, 50.0), -5.0, 5.0, 20.0, start=10.0)
    solids = Solids(ground=Ground(level=-90.0), movers=(box,))
    times = 0.1 * np.arange(400) / 400
    azimuth = np.pi - 2.0 * np.pi * np.arange(400) / 400
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(400)])[:, :, None]
    ranges, _ = cast_rays(solids, np.zeros((400, 3)), rays, 60.0, times)
    ahead = np.cos(azimuth) > 0.5
    expected = (30.0 - 20.0 * times - 1.0) / np.cos(azimuth)
    assert np.allclose(ranges[ahead, 0], expected[ahead], atol=1e-6)
    assert np.all(np.isinf(ranges[np.cos(azimuth) < -0.1]))


def test_people_and_cars_of_the_square_keep_off_the_way():
    world = SimulatedWorld("square", seed=4)
    way = (world.world_T_start @ world.truth.map_T_lidar)[:, :2, 3]
    movers = world.scene.solids.movers
    assert 30 <= sum(len(mover.footprint) == 1 for mover in movers) <= 60
    times = np.arange(0.0, 60.0, 0.5)
    for mover in movers:
        places, _ = mover.places(times)
        gaps = np.linalg.norm(places[:, None] - way[None, ::5], axis=2)
        assert gaps.min() - mover.reach > 0.6
        assert np.ptp(places, axis=0).max() > 1.0


def test_rounded_corners_are_cut_as_much_as_they_say():
    corners = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0]])
    way = rounded(corners, 1.0, 0.1, closed=False)
    cut = np.linalg.norm(way - (20.0, 0.0), axis=1).min()
    assert cut == pytest.approx(0.56, abs=0.01)
    step = np.diff(way, axis=0)
    turn = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    rate = np.diff(turn) / np.linalg.norm(step[1:], axis=1)
    assert 1.0 / rate.max() == pytest.approx(0.9, abs=0.03)
    assert np.allclose(points_along(corners, np.array([25.0])), [[20.0, 5.0]])


@pytest.mark.parametrize("seed", [0, 5])
def test_stairs_are_walked_at_the_height_of_a_head(seed):
    world = SimulatedWorld("stairwell", seed=seed)
    way = (world.world_T_start @ world.truth.map_T_lidar)[:, :3, 3]
    boxes = world.scene.solids.boxes
    above = []
    for x, y, z in way[::5]:
        under = np.abs(boxes[:, :2] - (x, y)) < boxes[:, 3:5]
        tops = (boxes[:, 2] + boxes[:, 5])[under.all(axis=1)]
        above.append(z - max(tops[tops < z], default=0.0))
    assert min(above) > 1.1
    assert max(above) < 1.65
    assert way[-1, 2] - way[0, 2] > 6.0  # more than one floor and a half
    climbing = np.diff(way[:, 2]) / np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1).clip(1e-3)
    assert np.percentile(climbing, 90) == pytest.approx(0.17 / 0.28, rel=0.3)


def test_the_rooms_are_145_metres_round_and_both_faces_of_a_wall_are_seen():
    for seed in (0, 3):
        world = SimulatedWorld("rooms", seed=seed, frames=1400, columns=90)
        way = world.truth.positions
        home = 1000 + np.linalg.norm(way[1000:], axis=1).argmin()
        metres = np.linalg.norm(np.diff(way[:home], axis=0), axis=1).sum()
        assert metres == pytest.approx(145.0, abs=8.0)
        walls = world.scene.solids.boxes[:, 3:5].min(axis=1) * 2.0
        assert np.sum((walls >= 0.1) & (walls <= 0.2)) > 40


@pytest.mark.parametrize("speed", [5.0, 20.0, 40.0])
@pytest.mark.parametrize("scene", ["street_loop", "avenue", "single_pole"])
def test_a_start_can_be_as_fast_as_asked(scene, speed):
    world = SimulatedWorld(scene, speed=speed, start="moving", frames=10, columns=60)
    steps = np.diff(world.truth.positions, axis=0)
    first = np.linalg.norm(steps[0]) * 10.0
    # Bends slow it down: the pole's way is one of 6 m radius.
    most = np.sqrt(2.5 * 6.0) * 1.6 if scene == "single_pole" else 1.15 * speed
    assert min(0.5 * speed, 3.0) < first < most
