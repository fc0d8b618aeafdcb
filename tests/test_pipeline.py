"""Whole runs on the built-in world: accuracy, interruption, determinism, recorded odometry."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from loam_gtsam.config import Config
from loam_gtsam.datasets.arrays import ArrayDataset
from loam_gtsam.datasets.simulation import SimulatedWorld
from loam_gtsam.evaluation import absolute_error
from loam_gtsam.features import extract_features
from loam_gtsam.geometry import move_points
from loam_gtsam.pipeline import Pipeline, effective_config, run
from loam_gtsam.types import BadSweep, DatasetError, Features, FeatureSweep, FrameStatus


class Sweeps:
    """A data set made of whatever the test wants."""

    name = "test"
    sensor: dict = {}  # noqa: RUF012
    imu = None
    truth = None

    def __init__(self, items):
        self.items = items

    def __len__(self):
        return len(self.items)

    def __iter__(self):
        for item in self.items:
            if isinstance(item, BaseException):
                raise item
            yield item

    def info(self):
        raise NotImplementedError


@pytest.mark.parametrize(
    ("scene", "frames", "limit"),
    [("room", 60, 0.03), ("street_loop", 100, 0.03), ("corridor", 100, 0.06), ("trees", 40, 0.15)],
)
def test_scene_is_mapped_to_centimetres(scene, frames, limit):
    world = SimulatedWorld(scene, frames=frames)
    result = run(world)
    assert absolute_error(result.trajectory, world.truth).rmse < limit
    assert result.status_counts["first"] == 1
    assert sum(update.status.solved for update in result.updates) == frames - 1
    assert len(result.edge_points) > 100
    assert len(result.plane_points) > 1000


@pytest.mark.parametrize("sensor", ["hdl32", "os1-64", "os1-128"])
def test_denser_sensors(sensor):
    world = SimulatedWorld("street_loop", sensor=sensor, frames=30, columns=900)
    result = run(world)
    assert absolute_error(result.trajectory, world.truth).rmse < 0.02


def test_scan_to_scan_guess_maps_as_well():
    world = SimulatedWorld("street_loop", frames=40)
    config = replace(Config(), odometry=replace(Config().odometry, method="scan_to_scan"))
    result = run(world, config)
    assert absolute_error(result.trajectory, world.truth).rmse < 0.03
    assert result.updates[5].timings["odometry"] > 0.0


def test_featureless_corridor_does_not_fail():
    """Along the corridor nothing can be known; across it everything can."""
    world = SimulatedWorld("corridor_bare", frames=40)
    result = run(world)
    truth = world.truth.map_T_lidar
    for update, pose in zip(result.updates[1:], truth[1:], strict=True):
        assert update.status.solved
        across = (update.map_T_lidar.matrix() - pose)[1:3, 3]
        assert np.abs(across).max() < 0.1


def test_max_frames_and_on_frame():
    seen = []
    result = run(
        SimulatedWorld("room", frames=5, columns=600),
        max_frames=3,
        on_frame=lambda number, update: seen.append((number, update.status)),
    )
    assert [number for number, _ in seen] == [0, 1, 2]
    assert len(result.updates) == 3
    assert set(result.updates[2].timings) == {
        "read", "features", "odometry", "prepare", "match", "solve", "insert",
    }  # fmt: skip


def test_interruption_keeps_what_was_computed():
    scans = list(SimulatedWorld("room", frames=3, columns=600))
    result = run(Sweeps([*scans, KeyboardInterrupt()]))
    assert result.interrupted
    assert len(result.trajectory) == 3
    assert len(result.plane_points) > 0


def test_an_error_in_the_data_is_raised_or_kept_with_the_partial_result():
    scans = list(SimulatedWorld("room", frames=2, columns=600))
    broken = Sweeps([*scans, DatasetError("disk gone")])
    with pytest.raises(DatasetError, match="disk gone"):
        run(broken)
    result = run(broken, keep_partial=True)
    assert len(result.updates) == 2
    assert isinstance(result.error, DatasetError)


def test_same_input_same_bits_at_any_speed():
    world = SimulatedWorld("street_loop", frames=12, columns=900)
    whole = run(world)
    pipeline = Pipeline(whole.config)
    single = [pipeline.process(scan) for scan in world]
    for a, b in zip(whole.updates, single, strict=True):
        assert np.array_equal(a.map_T_lidar.matrix(), b.map_T_lidar.matrix())
        assert np.array_equal(a.information, b.information)
        assert (a.status, a.n_plane_matches) == (b.status, b.n_plane_matches)
    assert np.array_equal(whole.plane_points, pipeline.mapper.map_points()[1])


def test_recorded_odometry_is_the_guess():
    """Features of another front end, its odometry drifting in a frame of its own."""
    world = SimulatedWorld("street_loop", frames=31)
    truth = world.truth.map_T_lidar
    start = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 2.0), np.array([5.0, 6.0, 7.0]))
    drift = gtsam.Pose3.Expmap(np.array([0.0, 0.0, 0.002, 0.02, 0.01, 0.0]))
    items, odom = [], start
    for i in range(30):
        scan = world[i]
        features = extract_features(scan, Config())
        step = gtsam.Pose3(np.linalg.inv(truth[i]) @ truth[i + 1])
        twist = gtsam.Pose3.Logmap(step) * 10.0
        edges = move_points(features.edges, twist, features.edge_times)
        planes = move_points(features.planes, twist, features.plane_times)
        items.append(FeatureSweep(Features.from_points(scan.stamp, edges, planes), odom))
        odom = odom.compose(step).compose(drift)
    result = run(Sweeps(items))
    assert absolute_error(result.trajectory, world.truth).rmse < 0.03
    guessed = start.between(items[-1].odom_T_lidar).translation()
    assert np.linalg.norm(guessed - truth[29][:3, 3]) > 0.3  # without the map it drifts


def test_what_the_data_set_implies_yields_to_the_user():
    data = Sweeps([])
    data.sensor = {"stamp": "middle", "spin": "clockwise"}
    assert effective_config(Config(), data).sensor.stamp == "middle"
    mine = replace(Config(), sensor=replace(Config().sensor, stamp="end"))
    sensor = effective_config(mine, data).sensor
    assert (sensor.stamp, sensor.spin) == ("end", "clockwise")


def test_an_empty_data_set_is_an_empty_result():
    result = run(Sweeps([]))
    assert result.updates == ()
    assert len(result.trajectory) == 0
    assert result.edge_points.shape == (0, 3)


# -- bad sweeps in the middle of a run ---------------------------------------------------------


def broken_sweep(kind, scan):
    points = scan.points
    if kind == "empty":
        return replace(scan, points=points[:0], times=scan.times[:0], rings=scan.rings[:0])
    if kind == "all NaN":
        return replace(scan, points=np.full_like(points, np.nan))
    if kind == "one ring":
        one = scan.rings == 3
        return replace(scan, points=points[one], times=scan.times[one], rings=scan.rings[one])
    if kind == "10 points":
        return replace(scan, points=points[:10], times=scan.times[:10], rings=scan.rings[:10])
    if kind == "too near":
        return replace(scan, points=points * np.float32(1e-4))
    if kind == "unreadable":
        return BadSweep(scan.stamp, "000003.bin: 7 bytes left over")
    if kind == "duplicate stamp":
        return replace(scan, stamp=scan.stamp - 100_000_000)
    if kind == "stamp in the past":
        return replace(scan, stamp=0)
    raise AssertionError(kind)


@pytest.mark.parametrize(
    ("kind", "status", "says"),
    [
        ("empty", "unusable_scan", "0 points"),
        ("all NaN", "unusable_scan", "0 finite"),
        ("one ring", "unusable_scan", "ring"),
        ("10 points", "unusable_scan", "10"),
        ("too near", "unusable_scan", "range"),
        ("unreadable", "unusable_scan", "000003.bin"),
        ("duplicate stamp", "bad_stamp", "not later"),
        ("stamp in the past", "bad_stamp", "not later"),
    ],
)
def test_a_bad_sweep_has_a_status_and_the_run_goes_on(kind, status, says):
    world = SimulatedWorld("street_loop", frames=26, columns=900)
    scans = [world[i] for i in range(20, 26)]
    scans[3] = broken_sweep(kind, scans[3])
    result = run(Sweeps(scans))
    bad = result.updates[3]
    assert bad.status == status
    assert says.lower() in bad.message.lower()
    assert np.isnan(bad.covariance).all()
    truth = world.truth.map_T_lidar[20:26]
    truth = np.linalg.inv(truth[0]) @ truth
    for i in (2, 4, 5):
        assert result.updates[i].status.solved
        error = np.linalg.norm(result.updates[i].map_T_lidar.translation() - truth[i][:3, 3])
        assert error < 0.12
    if status == "unusable_scan":  # predicted where it was
        predicted = bad.map_T_lidar.translation()
        assert np.linalg.norm(predicted - truth[3][:3, 3]) < 0.15
        assert len(result.trajectory) == 6
    else:
        assert len(result.trajectory) == 5
    assert (np.diff(result.trajectory.stamps) > 0).all()


@pytest.mark.parametrize("kind", ["empty", "all NaN", "10 points", "unreadable"])
def test_a_run_may_begin_with_bad_sweeps(kind):
    scans = list(SimulatedWorld("room", frames=4, columns=900))
    scans[0] = broken_sweep(kind, scans[0])
    statuses = [update.status for update in run(Sweeps(scans)).updates]
    assert statuses[:2] == [FrameStatus.UNUSABLE_SCAN, FrameStatus.FIRST]
    assert statuses[2].solved


def test_nothing_but_bad_sweeps():
    items = [BadSweep(i, "unreadable") for i in range(5)]
    assert run(Sweeps(items)).status_counts == {"unusable_scan": 5}


def test_numpy_arrays_go_through():
    world = SimulatedWorld("room", frames=6, columns=900)
    scans = list(world)
    dataset = ArrayDataset(
        [scan.points for scan in scans],
        np.array([scan.stamp for scan in scans]),
        times=[scan.times for scan in scans],
        rings=[scan.rings for scan in scans],
    )
    expected = run(world).trajectory
    assert np.allclose(run(dataset).trajectory.map_T_lidar, expected.map_T_lidar, atol=1e-3)
