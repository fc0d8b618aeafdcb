"""The simulated world judges everything else, so it is checked against code of its own kind:
the distances to its solids are computed here, independently of the ray caster.
"""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.sim.motion import GRAVITY
from loam_gtsam.datasets.sim.world import SCENES, SENSORS, Ground, Scene, SimulatedWorld, Solids
from loam_gtsam.types import ConfigError, InputError

EXACT = {"range_noise": 0.0, "dropout": 0.0, "foliage_noise": 0.0}
NOISES = ("range_noise", "foliage_noise", "imu_noise", "gyro_noise", "acceleration_noise")
NOT_NEGATIVE = (*NOISES, "seed", "rate", "speed")
BARE = ("open_field", "single_plane", "single_pole", "sparse_terrain")
PERFECT_IMU = dict.fromkeys(("imu_noise", "gyro_noise", "acceleration_noise"), 0.0)
PERFECT_IMU |= dict.fromkeys(("gyro_bias", "acceleration_bias"), (0.0, 0.0, 0.0))


def signed_distances(solids: Solids, points: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """(N, S + 1) distance to every solid and the ground, negative inside; exact near surfaces."""
    columns = []
    for cx, cy, cz, hx, hy, hz, yaw in solids.boxes:
        local = (points - (cx, cy, cz)) @ Rotation.from_euler("z", yaw).as_matrix()
        q = np.abs(local) - (hx, hy, hz)
        outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
        columns.append(outside + np.minimum(q.max(axis=1), 0.0))
    for cx, cy, radius, low, high in solids.cylinders:
        radial = np.hypot(points[:, 0] - cx, points[:, 1] - cy) - radius
        within = (points[:, 2] > low - 1e-6) & (points[:, 2] < high + 1e-6)
        columns.append(np.where(within, radial, np.inf))
    for row in solids.ellipsoids:
        scaled = np.linalg.norm((points - row[:3]) / row[3:], axis=1)
        columns.append((scaled - 1.0) * row[3:].min())
    for mover in solids.movers:
        places, yaw = mover.places(seconds)
        x, y = (points[:, :2] - places).T
        if len(mover.footprint) == 1:
            within = (points[:, 2] > mover.low - 1e-6) & (points[:, 2] < mover.high + 1e-6)
            columns.append(np.where(within, np.hypot(x, y) - mover.footprint[0], np.inf))
        else:
            local = np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x
            half = np.array([*mover.footprint, 0.5 * (mover.high - mover.low)])
            up = points[:, 2] - 0.5 * (mover.low + mover.high)
            q = np.abs(np.stack([*local, up], axis=1)) - half
            outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
            columns.append(outside + np.minimum(q.max(axis=1), 0.0))
    for x, y, z, yaw, radius in solids.tubes:
        aside = np.cos(yaw) * (points[:, 1] - y) - np.sin(yaw) * (points[:, 0] - x)
        columns.append(radius - np.hypot(aside, points[:, 2] - z))
    columns.append(points[:, 2] - solids.ground.height(points[:, 0], points[:, 1]))
    return np.stack(columns, axis=1)


def to_world(world: SimulatedWorld, points: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """Each point by the exact pose at its own time."""
    poses = world.world_T_start @ world.truth_at(stamps).map_T_lidar
    return np.einsum("nij,nj->ni", poses[:, :3, :3], points.astype(float)) + poses[:, :3, 3]


def seconds_of(world: SimulatedWorld, stamps: np.ndarray) -> np.ndarray:
    return (stamps - world.truth.stamps[0]) * 1e-9


def stamps_of(scan) -> np.ndarray:
    return scan.stamp + np.round(scan.times * 1e9).astype(np.int64)


def roll_pitch(world: SimulatedWorld) -> tuple[np.ndarray, np.ndarray]:
    """(N,) radians each, of all sweeps."""
    rotations = (world.world_T_start @ world.truth.map_T_lidar)[:, :3, :3]
    _, pitch, roll = Rotation.from_matrix(rotations).as_euler("ZYX").T
    return roll, pitch


def middle_sweep(scene: str, **options) -> tuple[SimulatedWorld, int]:
    world = SimulatedWorld(scene, **EXACT, **options)
    return world, min(len(world) - 1, 150)


@pytest.mark.parametrize(
    ("scene", "sensor"),
    [*((scene, "vlp16") for scene in SCENES), ("street_loop", "mid360"), ("square", "avia")],
)
def test_every_exact_point_lies_on_a_surface_and_nothing_stands_before_it(scene, sensor):
    world, index = middle_sweep(scene, columns=600 if sensor == "vlp16" else 6000, sensor=sensor)
    scan = world[index]
    rng = np.random.default_rng(0)
    pick = rng.choice(len(scan.points), 400, replace=False)
    points = to_world(world, scan.points[pick], stamps_of(scan)[pick])
    seconds = seconds_of(world, stamps_of(scan)[pick])
    distance = signed_distances(world.scene.solids, points, seconds)
    # Stamps are whole nanoseconds and points float32: 1e-5 m at 100 m.
    assert np.abs(distance).min(axis=1).max() < 1e-4
    assert distance.min() > -1e-4
    # No solid between the sensor and the point: the culling of the ray caster loses nothing.
    origins = to_world(world, np.zeros((400, 3)), stamps_of(scan)[pick])
    ways, at = [], []
    for origin, point, second in zip(origins[:60], points[:60], seconds[:60], strict=True):
        length = np.linalg.norm(point - origin)
        metres = np.arange(0.05, length - 0.1, 0.1)
        ways.append(origin + metres[:, None] * (point - origin) / length)
        at.append(np.full(len(ways[-1]), second))
    on_way = np.concatenate(ways), np.concatenate(at)
    assert signed_distances(world.scene.solids, *on_way).min() > -1e-4


@pytest.mark.parametrize("scene", ["street_loop", "trees", "square"])
def test_beams_without_a_return_meet_nothing_in_range(scene):
    world, index = middle_sweep(scene, columns=200, max_range=60.0)
    scan = world[index]
    elevations = np.deg2rad(SENSORS["vlp16"][0])
    column = np.round(scan.times * 10.0 * 200).astype(int)
    seen = np.zeros((200, 16), bool)
    seen[column, scan.rings] = True
    missing = np.argwhere(~seen)
    assert len(missing) > 20
    missing = missing[:: max(1, len(missing) // 40)]
    azimuth = np.pi - 2.0 * np.pi * missing[:, 0] / 200
    elevation = elevations[missing[:, 1]]
    turned = Rotation.from_euler("ZY", np.stack([azimuth, -elevation], axis=1))
    beams = turned.apply([1.0, 0.0, 0.0])
    steps = np.arange(0.5, 59.9, 0.2)
    stamps = scan.stamp + np.round(missing[:, 0] / 200 * 1e8).astype(np.int64)
    along = (beams[:, None] * steps[:, None]).reshape(-1, 3)
    stamps = np.repeat(stamps, len(steps))
    on_way = to_world(world, along, stamps)
    seconds = seconds_of(world, stamps)
    assert signed_distances(world.scene.solids, on_way, seconds).min() > 0.0


def test_without_point_times_a_moving_sweep_leaves_the_surfaces():
    world, index = middle_sweep("street_loop", columns=600)
    scan = world[index]
    frozen = to_world(world, scan.points[::20], np.full(len(scan.points[::20]), scan.stamp))
    off = np.abs(signed_distances(world.scene.solids, frozen, np.zeros(len(frozen)))).min(axis=1)
    assert np.percentile(off, 80) > 0.03
    assert off.max() > 0.3


def test_distances_at_rest_in_the_room_are_those_of_its_plan():
    # It starts at rest at (2.4, 0, 1.3) heading +y; a beam one degree up clears the furniture.
    scan = SimulatedWorld("room", **EXACT)[0]
    level = scan.rings == 8
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    for direction, metres in ((0.0, 4.0), (np.pi / 2, 7.0), (-np.pi / 2, 2.6)):
        nearest = np.flatnonzero(level)[np.argmin(np.abs(azimuth[level] - direction))]
        expected = metres / np.cos(np.deg2rad(1.0))
        assert np.linalg.norm(scan.points[nearest]) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("name", SENSORS)
def test_sensors_have_their_beams_and_fire_in_order(name):
    world = SimulatedWorld("room", sensor=name, columns=90, **EXACT)
    scan = world[3]
    elevations = SENSORS[name][0]
    assert np.array_equal(np.unique(scan.rings), np.arange(len(elevations)))
    measured = np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1))
    assert np.allclose(np.rad2deg(measured), elevations[scan.rings], atol=1e-3)
    turned = (np.pi - np.arctan2(scan.points[:, 1], scan.points[:, 0])) / (2.0 * np.pi) % 1.0
    off = np.abs(turned - scan.times / 0.1)
    assert np.minimum(off, 1.0 - off).max() < 1e-6
    assert np.all(np.diff(scan.times) >= 0.0)
    assert scan.points.dtype == np.float32
    assert scan.span == (0.0, 0.1)
    assert len(SENSORS[name][0]) * 90 >= len(scan.points) > 0.98 * len(elevations) * 90


@pytest.mark.parametrize(("name", "field"), [("avia", (-41, 41)), ("mid360", (-7, 52))])
def test_lidars_without_rings_fill_their_field_otherwise_in_every_sweep(name, field):
    world = SimulatedWorld("room", sensor=name, columns=3000, **EXACT)
    scans = [world[3], world[4]]
    for scan in scans:
        assert scan.rings is None
        assert np.all(np.diff(scan.times) > 0.0)
        assert 0.0 <= scan.times[0] < scan.times[-1] < scan.span[1] == 0.1
        elevation = np.rad2deg(np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1)))
        azimuth = np.rad2deg(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
        assert field[0] < elevation.min() < field[0] + 8
        assert field[1] - 8 < elevation.max() < field[1]
        assert np.ptp(azimuth) > (350 if name == "mid360" else 60)
    beams = [scan.points / np.linalg.norm(scan.points, axis=1, keepdims=True) for scan in scans]
    assert np.median(cKDTree(beams[0]).query(beams[1])[0]) > 1e-3


@pytest.mark.parametrize("scene", SCENES)
def test_every_scene_gives_full_sweeps_from_a_clear_path(scene):
    for seed in (0, 5):
        world = SimulatedWorld(scene, seed=seed)
        least = 11_000 if scene in BARE else 15_000  # half the beams look into the sky
        least = 6_000 if scene == "bridge" else least  # and many down into the valley
        assert all(len(world[i].points) > least for i in (0, len(world) // 2, len(world) - 1))
        positions = (world.world_T_start @ world.truth.map_T_lidar)[::4, :3, 3]
        seconds = seconds_of(world, world.truth.stamps[::4])
        assert signed_distances(world.scene.solids, positions, seconds).min() > 0.5


def test_sweeps_are_the_same_in_any_order_process_and_run():
    world = SimulatedWorld("street_loop", frames=4, columns=300)
    alone = pickle.loads(pickle.dumps(world)).sweep(3)
    first, second = list(world), list(world)
    assert len(first) == len(world) == 4
    for a, b in [*zip(first, second, strict=True), (alone, first[3]), (world[-1], first[3])]:
        assert a.stamp == b.stamp
        assert np.array_equal(a.points, b.points)
        assert np.array_equal(a.times, b.times)
        assert np.array_equal(a.rings, b.rings)
    other = SimulatedWorld("street_loop", frames=4, columns=300, seed=1)[3]
    assert not np.array_equal(other.points[:100], alone.points[:100])
    for index in (4, -5):
        with pytest.raises(IndexError, match="4 sweeps"):
            world[index]


def test_noise_has_the_asked_size():
    exact = SimulatedWorld("room", **EXACT)[2]
    noisy = SimulatedWorld("room", range_noise=0.05, dropout=0.0)[2]
    error = np.linalg.norm(noisy.points, axis=1) - np.linalg.norm(exact.points, axis=1)
    assert np.std(error) == pytest.approx(0.05, rel=0.02)
    assert abs(np.mean(error)) < 0.002
    thinned = SimulatedWorld("room", dropout=0.3)[2]
    assert len(thinned.points) / len(exact.points) == pytest.approx(0.7, abs=0.02)


def test_beams_enter_foliage_but_not_rocks_or_ground():
    hard = SimulatedWorld("trees", **EXACT)
    soft = SimulatedWorld("trees", range_noise=0.0, dropout=0.0, foliage_noise=0.2)
    a, b = hard[5], soft[5]
    assert len(a.points) == len(b.points)
    deeper = np.linalg.norm(b.points, axis=1) - np.linalg.norm(a.points, axis=1)
    entered = deeper > 1e-4
    assert 0.01 < entered.mean() < 0.6
    assert deeper.min() > -1e-4
    assert deeper[entered].mean() == pytest.approx(0.2, rel=0.15)
    points = to_world(hard, a.points[entered][::10], stamps_of(a)[entered][::10])
    crowns = Solids(ellipsoids=hard.scene.solids.ellipsoids[hard.scene.solids.foliage])
    gaps = signed_distances(crowns, points, np.zeros(len(points)))[:, :-1]
    assert np.abs(gaps).min(axis=1).max() < 1e-4


def test_truth_starts_at_the_identity_and_agrees_with_truth_at():
    world = SimulatedWorld("street_loop", frames=50)
    truth = world.truth
    assert np.array_equal(truth.map_T_lidar[0], np.eye(4))
    assert truth.stamps[7] == world[7].stamp
    again = world.truth_at(truth.stamps[10:20])
    assert np.allclose(again.map_T_lidar, truth.map_T_lidar[10:20], atol=1e-12)
    rotation = truth.map_T_lidar[:, :3, :3]
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    for wrong in (truth.stamps.astype(float), truth.stamps[:, None]):
        with pytest.raises(InputError, match="integer nanoseconds"):
            world.truth_at(wrong)


def test_an_open_path_has_as_many_frames_as_it_has_metres():
    world = SimulatedWorld("corridor_bare")
    assert world.truth.path_length >= 300.0
    with pytest.raises(ConfigError, match=f"ends after {len(world)} sweeps"):
        SimulatedWorld("corridor_bare", frames=len(world) + 1)
    assert len(SimulatedWorld("corridor_bare", frames=len(world) + 1, speed=4.0)) > len(world)
    last = world.truth.stamps[-1:]
    assert len(world.truth_at(last + 100_000_000)) == 1
    with pytest.raises(InputError, match="ends at"):
        world.truth_at(last + 2_000_000_000)


def test_motion_starts_at_rest_and_is_gentle():
    for scene in SCENES:
        world = SimulatedWorld(scene, **PERFECT_IMU)
        imu = world.imu
        at_rest = imu.acceleration[imu.stamps <= world.truth.stamps[0]]
        up = Rotation.from_matrix(world.world_T_start[:3, :3]).inv().apply([0.0, 0.0, GRAVITY])
        assert np.allclose(at_rest, up, atol=1e-3)
        assert at_rest[0, 2] > 9.0
        assert np.linalg.norm(imu.acceleration, axis=1).max() < GRAVITY + 6.0
        assert np.abs(imu.gyro).max() < (1.5 if scene != "shaken" else 2.5)
        if scene == "shaken":  # fast, about every axis
            assert np.abs(imu.gyro).max(axis=0) == pytest.approx([1.4, 1.4, 2.0], abs=0.5)
            largest = [np.abs(angle).max() for angle in roll_pitch(world)]
            assert largest == pytest.approx([0.15, 0.15], abs=0.02)


@pytest.mark.parametrize("seed", [0, 5])
def test_slopes_climb_and_fall_by_fifteen_metres(seed):
    world = SimulatedWorld("slopes", seed=seed)
    x, y, z = (world.world_T_start @ world.truth.map_T_lidar)[:, :3, 3].T
    crest, dip = z.argmax(), z.argmin()
    assert 10 < crest < dip < len(world) - 30
    assert z[crest] - z[dip] > 15.0
    assert z[crest] - z[0] > 8.0
    moving = np.hypot(np.diff(x), np.diff(y)) > 0.3
    grade = np.diff(z)[moving] / np.hypot(np.diff(x), np.diff(y))[moving]
    assert 0.1 < grade.max() < 0.13
    assert -0.13 < grade.min() < -0.1
    assert np.median(np.hypot(np.diff(x), np.diff(y))) == pytest.approx(0.8, abs=0.05)
    # It starts nose up: a map in the frame of the first pose is not level.
    assert np.rad2deg(roll_pitch(world)[1][0]) == pytest.approx(-5.5, abs=1.2)


@pytest.mark.parametrize("scene", ["room", "street_loop", "trees", "slopes", "shaken"])
def test_integrated_imu_gives_the_true_motion(scene):
    world = SimulatedWorld(scene, frames=60, **PERFECT_IMU)
    imu = world.imu
    assert np.all(np.diff(imu.stamps) == 5_000_000)
    truth = world.truth_at(imu.stamps)
    world_T_lidar = world.world_T_start @ truth.map_T_lidar
    from_truth = Rotation.from_matrix(world_T_lidar[:, :3, :3])
    assert (Rotation.from_quat(imu.orientation).inv() * from_truth).magnitude().max() < 1e-9
    rate = 0.5 * (imu.gyro[1:] + imu.gyro[:-1]) * 0.005
    turned = from_truth[0]
    for step in Rotation.from_rotvec(rate):
        turned = turned * step
    assert (turned.inv() * from_truth[-1]).magnitude() < 1e-3
    acceleration = from_truth.apply(imu.acceleration) - (0.0, 0.0, GRAVITY)
    speed = np.cumsum(0.5 * (acceleration[1:] + acceleration[:-1]) * 0.005, axis=0)
    moved = np.sum(0.005 * speed, axis=0)
    travelled = world_T_lidar[-1, :3, 3] - world_T_lidar[0, :3, 3]
    assert np.linalg.norm(travelled) > 2.0
    assert np.allclose(moved, travelled, atol=0.05)


def test_imu_noise_and_bias_have_the_asked_size():
    perfect = SimulatedWorld("street_loop", **PERFECT_IMU).imu
    bias = np.array([0.01, -0.02, 0.03])
    gyro = {"gyro_noise": 0.01, "gyro_bias": tuple(bias)}
    acceleration = {"acceleration_noise": 0.1, "acceleration_bias": tuple(10.0 * bias)}
    noisy = SimulatedWorld("street_loop", imu_noise=0.004, **gyro, **acceleration).imu
    gyro, acceleration = noisy.gyro - perfect.gyro, noisy.acceleration - perfect.acceleration
    assert np.allclose(gyro.mean(axis=0), bias, atol=5e-4)
    assert np.allclose(gyro.std(axis=0), 0.01, rtol=0.05)
    assert np.allclose(acceleration.mean(axis=0), 10.0 * bias, atol=5e-3)
    assert np.allclose(acceleration.std(axis=0), 0.1, rtol=0.05)
    wrong = Rotation.from_quat(perfect.orientation).inv() * Rotation.from_quat(noisy.orientation)
    assert np.allclose(wrong.as_rotvec().std(axis=0), 0.004, rtol=0.05)


def test_street_loop_closes_after_500_metres_and_goes_on():
    world = SimulatedWorld("street_loop")
    truth = world.truth
    assert truth.path_length > 500.0
    back = np.linalg.norm(truth.map_T_lidar[-30:, :3, 3], axis=1)
    closest = truth.map_T_lidar[-30:][back.argmin()]
    assert back.min() < 0.6  # frames are up to a metre apart
    assert Rotation.from_matrix(closest[:3, :3]).magnitude() < 0.05
    longer = SimulatedWorld("street_loop", frames=1500)
    assert longer.truth.path_length > 2.0 * truth.path_length
    assert len(longer[1499].points) > 15_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scene": "moon"}, "scene: expected one of room, .*'moon'"),
        ({"sensor": "vlp17"}, "sensor: expected one of vlp16, .*'vlp17'"),
        ({"frames": 0}, "frames: expected at least 1, got 0"),
        ({"dropout": 1.0}, "dropout"),
        ({"columns": 4}, "columns"),
        ({"max_range": 0.1}, "max_range"),
        ({"range_noise": float("nan")}, "range_noise"),
        *(({name: -1}, f"{name}: expected at least") for name in NOT_NEGATIVE),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ConfigError, match=message):
        SimulatedWorld(**{"scene": "room", **arguments})


def test_the_rate_sets_the_period_and_the_stamps():
    world = SimulatedWorld("trees", sensor="os1-64", frames=20, columns=256, rate=20.0)
    assert world.info().facts["frames"] == "20 at 20 Hz"
    assert world.sensor["period"] == 0.05
    assert world[1].stamp - world[0].stamp == 50_000_000


def test_a_scene_of_ones_own():
    """A lone ball over a plane: one ring of rays sees it at the distance of its plan."""
    row, floor = np.array([[5.0, 0.0, 1.0, 1.0, 1.0, 1.0]]), Ground(level=-1.0)
    ball = Solids(ellipsoids=row, foliage=np.zeros(1, bool), ground=floor)
    way = np.array([[x, 0.0] for x in np.arange(0.0, -40.0, -4.0)])
    scene = Scene("ball", ball, way, speed=1.0, height=2.0, sway=(0.0, 0.0, 0.0, 0.0))
    world = SimulatedWorld(scene, frames=5, **EXACT)
    points = world[0].points
    behind = np.linalg.norm(points[points[:, 2] > -1.0], axis=1)  # it drives away from the ball
    assert behind.min() == pytest.approx(4.0, abs=0.01)
    floor = points[np.linalg.norm(points, axis=1) > 12.0]
    assert np.allclose(floor[:, 2], -2.0, atol=1e-4)
    assert len(floor) > 1000


def test_whole_numbers_are_numbers() -> None:
    whole, exact = (
        SimulatedWorld("room", frames=1, columns=60, max_range=far, speed=speed, rate=rate)
        for far, speed, rate in ((20, 1, 10), (20.0, 1.0, 10.0))
    )
    assert np.array_equal(whole[0].points, exact[0].points)


def test_a_turned_tube_is_hit_where_its_equation_says():
    tube = Solids(tubes=np.array([[3.0, -1.0, 2.0, 0.7, 2.5]]), ground=Ground(level=-9.0))
    way = np.array([[3.0, -1.0]]) + np.arange(0.0, 40.0, 8.0)[:, None] * (np.cos(0.7), np.sin(0.7))
    scene = Scene("tube", tube, way, False, 1.0, 10.5, (0.0, 0.0, 0.0, 0.0))
    world = SimulatedWorld(scene, frames=12, columns=90, max_range=60.0, **EXACT)
    scan = world[11]
    points = to_world(world, scan.points, stamps_of(scan))
    assert len(points) > 90 * 14
    assert np.abs(signed_distances(tube, points, np.zeros(len(points)))[:, 0]).max() < 1e-4
    assert np.ptp(points @ (np.cos(0.7), np.sin(0.7), 0.0)) > 15.0
