"""Features without rings: flat patches, posts, and whole runs of lidars that sweep none."""

import gtsam
import numpy as np
import pytest
from support.quick import begin_quickly

from loam_gtsam import Config, FrameStatus, SimulatedWorld, run
from loam_gtsam.config import FeatureConfig
from loam_gtsam.datasets import ArrayDataset
from loam_gtsam.frontend.features import extract_features, thinned
from loam_gtsam.frontend.unorganised import on_flat_patches, posts
from loam_gtsam.geometry import transform
from loam_gtsam.studies.evaluation import FIVE_SIGMA, squared_errors
from loam_gtsam.types import Scan, SweepError, SweepFault, stack_poses

NOISE = 0.02


def wall(noise=NOISE, count=2000, metres=10.0, seed=0):
    """(N, 3) points of a wall across x, 8 m wide and 4 m high."""
    rng = np.random.default_rng(seed)
    y, z = rng.uniform(-4.0, 4.0, count), rng.uniform(-2.0, 2.0, count)
    return np.column_stack([metres + noise * rng.standard_normal(count), y, z])


def share_flat(points, times=None, noise=NOISE):
    count = len(points)
    times = np.zeros(count) if times is None else times
    return on_flat_patches(points, times, noise).mean()


def test_a_wall_is_flat_and_what_scatters_is_not():
    assert share_flat(wall()) > 0.95
    assert share_flat(wall(noise=0.15)) < 0.02  # a hedge
    assert share_flat(wall(noise=0.15, count=200), noise=0.15) > 0.4  # said to be noise
    thick = np.random.default_rng(1).uniform(-1.0, 1.0, (2000, 3))
    assert share_flat(thick) < 0.05
    assert share_flat(thick, noise=0.0) < 0.1  # no bound of the scatter, but no plane either


def test_a_row_of_points_has_no_plane_and_few_points_have_none():
    row = np.column_stack([np.full(200, 10.0), np.linspace(-3.0, 3.0, 200), np.zeros(200)])
    row += 0.005 * np.random.default_rng(0).standard_normal(row.shape)
    assert share_flat(row) < 0.4
    assert share_flat(wall(count=3)) == 0.0


def test_a_wall_that_comes_nearer_within_the_sweep_is_flat_if_times_tell():
    times = np.random.default_rng(2).uniform(0.0, 0.1, 2000)
    points = wall()
    points[:, 0] -= 8.0 * times  # m/s: the wall is 0.8 m thick
    assert share_flat(points, times) > 0.95
    assert share_flat(points) < 0.1
    hedge = wall(noise=0.15)
    assert share_flat(hedge, times) < 0.06  # times do not explain everything


def post(x=6.0, y=1.0, radius=0.1, bottom=-1.0, top=2.0, count=60, seed=3):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(np.pi / 2, 3 * np.pi / 2, count)  # the side that faces the lidar
    height = rng.uniform(bottom, top, count)
    return np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle), height])


def middles(points, free=None, **settings):
    free = np.ones(len(points), bool) if free is None else free
    return posts(points, np.full(len(points), 0.01), free, FeatureConfig(**settings))


def test_a_post_that_stands_apart_is_an_edge_in_every_slice():
    found, times = middles(np.concatenate([post(), wall()]), np.arange(2060) < 60)
    assert 7 <= len(found) <= 9  # three metres
    assert np.ptp(found[:, 2]) > 2.0
    assert np.hypot(found[:, 0] - 6.0, found[:, 1] - 1.0).max() < 0.12
    assert np.allclose(times, 0.01)


@pytest.mark.parametrize(
    ("points", "settings"),
    [
        (np.concatenate([post(), post(x=6.4)]), {"post_width": 0.4}),  # too wide together
        (post(radius=0.6, count=200), {"post_width": 0.9}),
        (post(), {"post_depth": 0.0}),  # turned off
    ],
)
def test_what_is_wide_or_not_asked_for_is_no_post(points, settings):
    assert len(middles(points, **settings)[0]) == 0


def test_what_stands_beside_a_plane_is_no_post():
    points = np.concatenate([post(), wall(metres=6.3)])
    free = np.arange(len(points)) < 60
    assert len(middles(points, free)[0]) == 0
    assert len(middles(points, free, post_depth=0.1)[0]) > 5


def test_features_of_a_sweep_are_means_within_the_sweep():
    scan = SimulatedWorld("street_loop", sensor="mid360", frames=2).sweep(1)
    features = extract_features(scan, Config())
    assert len(features.planes) > 1500
    assert len(features.edges) > 50
    assert len(features.sharp) == len(features.flat) == 0
    for times in (features.edge_times, features.plane_times):
        assert 0.0 <= times.min() < times.max() <= 0.1
    assert features.edge_prominence is None
    assert thinned(features, Config().map).voxel_sizes is not None
    again = extract_features(scan, Config().changed("deskew.reference=end"))
    assert again.stamp == scan.stamp + 100_000_000
    assert np.allclose(again.plane_times, features.plane_times - 0.1)


def test_a_sweep_in_which_nothing_is_flat_has_no_features():
    points = np.random.default_rng(0).uniform(-5.0, 5.0, (500, 3)) + np.array([20.0, 0.0, 0.0])
    with pytest.raises(SweepError, match=r"no features: of 4.. patches") as caught:
        extract_features(
            Scan(points, 0, times=np.linspace(0.0, 0.1, 500)),
            Config().changed("sensor.rings=none", "features.post_depth=0"),
        )
    assert caught.value.fault is SweepFault.NO_FEATURES


def errors(result, world):
    """Metres off, frame by frame; and how many frames are ``ok`` beyond five told sigma."""
    poses = stack_poses(update.map_T_lidar for update in result.updates)
    off = np.linalg.norm(poses[:, :3, 3] - world.truth.positions, axis=1)
    squared = squared_errors(
        result.updates, [gtsam.Pose3(pose) for pose in world.truth.map_T_lidar], 0
    )
    statuses = [update.status for update in result.updates]
    wrong = [i for i, s in squared.items() if s > FIVE_SIGMA and statuses[i] is FrameStatus.OK]
    return off, len(wrong)


@pytest.mark.parametrize(
    ("scene", "sensor", "frames", "metres"),
    [("street_loop", "mid360", 20, 0.04), ("rooms", "avia", 16, 0.03)],
)
def test_a_lidar_without_rings_is_mapped(scene, sensor, frames, metres):
    world = SimulatedWorld(scene, sensor=sensor, frames=frames)
    result = run(world, Config().changed("imu.coupling=off"))
    off, wrong = errors(result, world)
    assert result.status_counts == {"first": 1, "ok": frames - 1}
    assert off.max() < metres
    assert wrong == 0


def test_points_in_any_order_and_without_times_are_mapped(monkeypatch):
    begin_quickly(monkeypatch)
    world = SimulatedWorld("room", frames=14, columns=450, speed=0.1)
    rng = np.random.default_rng(0)
    scans = [Scan(rng.permutation(scan.points), scan.stamp) for scan in world]
    settings = ["sensor.times=none", "sensor.rings=none", "imu.coupling=off"]
    result = run(ArrayDataset(scans, name="shuffled"), Config().changed(*settings))
    off, _ = errors(result, world)
    assert result.status_counts == {"first": 1, "ok": 13}
    assert off.max() < 0.03


def test_two_lidars_in_one_scan_are_mapped(monkeypatch):
    begin_quickly(monkeypatch)
    lidar = SimulatedWorld("corridor", frames=16, columns=450, seed=3)
    lidar_T_second = gtsam.Pose3(gtsam.Rot3.Roll(1.2), np.array([0.3, -0.4, 0.2])).matrix()
    second = lidar.seen_from(lidar_T_second)
    scans = [
        Scan(
            np.concatenate([one.points, transform(lidar_T_second, other.points)]),
            one.stamp,
            times=np.concatenate([one.times, other.times]),
        )
        for one, other in zip(lidar, second, strict=True)
    ]
    config = Config().changed("imu.coupling=off")
    result = run(ArrayDataset(scans, name="both"), config)
    off, wrong = errors(result, lidar)
    assert result.status_counts == {"first": 1, "ok": 15}
    assert (wrong, off.max() < 0.02) == (0, True)


def test_scan_to_scan_needs_rings_and_leaves_the_prediction_without(monkeypatch):
    begin_quickly(monkeypatch)
    world = SimulatedWorld("rooms", sensor="mid360", frames=8)
    result = run(world, Config().changed("odometry.method=scan_to_scan", "imu.coupling=off"))
    assert errors(result, world)[0].max() < 0.05
    assert result.updates[-1].status is FrameStatus.OK
