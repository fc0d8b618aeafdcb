"""What is done to sweeps to make them harder: shares, determinism, what is handed through."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.list_dataset import ListDataset

from loam_gtsam.datasets.arrays import ArrayDataset
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.datasets.sim import disturbances
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.types import BadSweep, ConfigError, Features, FeatureSweep, InputError, Scan

SECOND = 1_000_000_000
ALL = (
    disturbances.Outliers(),
    disturbances.SectorDropouts(),
    disturbances.MissingSweeps((3,)),
    disturbances.MovingObjects(lane=1.2),
)


@pytest.fixture(scope="module")
def world() -> SimulatedWorld:
    return SimulatedWorld("room", frames=8, columns=360)


def around(radius: float, count: int = 3600, stamp: int = 0) -> Scan:
    """A cylinder of points about the lidar, one turn in 0.1 s."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    points = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    return Scan(points, stamp, times=np.linspace(0.0, 0.1, count))


def same(first: Dataset, second: Dataset) -> bool:
    pairs = list(zip(first, second, strict=True))
    return all(
        np.array_equal(a.points, b.points, equal_nan=True) and a.stamp == b.stamp
        for a, b in pairs
        if isinstance(a, Scan) and isinstance(b, Scan)
    )


def test_outliers_are_the_share_asked_for_and_stay_on_their_beams():
    scan = around(60.0)
    found = disturbances.Outliers(0.2, (1.0, 50.0)).apply(0, scan)
    ranges = np.linalg.norm(found.points, axis=1)
    moved = ranges < 59.0
    assert moved.sum() == 720
    assert ranges[moved].min() >= 1.0
    assert ranges[moved].max() <= 50.0
    assert np.ptp(ranges[moved]) > 40.0
    np.testing.assert_allclose(found.points / ranges[:, None], scan.points / 60.0, atol=1e-12)
    assert np.array_equal(found.points[~moved], scan.points[~moved])


def test_outliers_differ_from_sweep_to_sweep_and_by_seed():
    scan = around(60.0)
    first = disturbances.Outliers().apply(0, scan).points
    assert np.array_equal(first, disturbances.Outliers().apply(0, scan).points)
    assert not np.array_equal(first, disturbances.Outliers().apply(1, scan).points)
    assert not np.array_equal(first, disturbances.Outliers(seed=1).apply(0, scan).points)


def test_lost_points_stay_lost():
    points = np.full((10, 3), np.nan, np.float32)
    scan = Scan(points, 0, times=np.zeros(10))
    for disturbance in ALL:
        found = disturbance.apply(0, scan)
        assert np.isnan(found.points).all()
        assert found.points.dtype == np.float32


@pytest.mark.parametrize("sectors", [1, 3])
def test_sectors_are_lost_in_one_piece_and_move_with_time(sectors):
    dropouts = disturbances.SectorDropouts(0.25, sectors, seconds=0.5)

    def lost(stamp):
        return np.isnan(dropouts.apply(0, around(10.0, stamp=stamp)).points[:, 0])

    assert lost(0).mean() == pytest.approx(0.25, abs=2e-3)
    borders = np.count_nonzero(lost(0) != np.roll(lost(0), 1))
    assert borders == 2 * sectors
    assert np.array_equal(lost(0), lost(SECOND // 2 - 1))
    assert not np.array_equal(lost(0), lost(SECOND // 2))


def test_boxes_hide_what_is_behind_them_and_nothing_else():
    boxes = disturbances.MovingObjects(
        length=8.0, spacing=16.0, lane=2.5, speeds=(4.0, -9.0), range_noise=0.0
    )
    far, near = around(30.0), around(2.4)
    hit = boxes.hits(far)
    assert 0.05 < hit.mean() < 0.95
    assert not boxes.hits(near).any()
    found = boxes.apply(0, far).points
    assert np.array_equal(found[~hit], far.points[~hit])
    x, y, _ = found[hit].T
    # On a side of a box: the near one, or the front or back of it.
    assert np.abs(y).min() > 2.5 - 1e-9
    assert np.abs(y).max() < 4.5 + 1e-9
    left = y > 0
    start = np.where(left, 4.0, -9.0) * far.times[hit]
    along = (x - start) % 16.0
    at_end = np.minimum(np.minimum(along, 16.0 - along), np.abs(along - 8.0)) < 1e-6
    assert (at_end | (np.abs(np.abs(y) - 2.5) < 1e-9)).all()
    assert (along[~at_end] < 8.0).all()


def test_boxes_move_on_with_time():
    boxes = disturbances.MovingObjects(speeds=(4.0, 4.0))
    start = boxes.hits(around(30.0))
    assert not np.array_equal(start, boxes.hits(around(30.0, stamp=SECOND)))
    assert np.array_equal(start, boxes.hits(around(30.0, stamp=4 * SECOND)))  # one spacing on


def test_boxes_are_made_to_hide_a_share(world):
    boxes = disturbances.MovingObjects(lane=1.2).covering(0.3, world[4])
    shares = [
        boxes.hits(Scan(scan.points, scan.stamp + step * SECOND // 10, scan.times)).mean()
        for scan in world
        for step in range(0, 40, 4)
    ]
    assert np.mean(shares) == pytest.approx(0.3, abs=0.03)
    with pytest.raises(ConfigError, match="bring the lane nearer"):
        disturbances.MovingObjects(lane=50.0).covering(0.3, world[4])


@pytest.mark.parametrize(
    "make",
    [
        lambda: disturbances.Outliers(1.1),
        lambda: disturbances.SectorDropouts(-0.1),
        lambda: disturbances.SectorDropouts(sectors=0),
        lambda: disturbances.SectorDropouts(seconds=0.0),
        lambda: disturbances.MovingObjects(length=20.0),
        lambda: disturbances.MovingObjects(lane=0.0),
        lambda: disturbances.MovingObjects().covering(2.0, around(30.0)),
    ],
)
def test_what_makes_no_sense_is_refused(make):
    with pytest.raises(ConfigError, match="expected"):
        make()


def test_a_disturbed_data_set_is_a_data_set(world):
    disturbed = disturbances.Disturbed(world, ALL)
    assert isinstance(disturbed, Dataset)
    assert len(disturbed) == len(list(disturbed)) == 7
    assert same(disturbed, disturbed)
    assert disturbed.truth is world.truth
    assert disturbed.imu is world.imu
    assert disturbed.sensor == world.sensor
    assert "Outliers" in disturbed.info().facts["disturbed by"]
    assert same(disturbances.Disturbed(world, [disturbances.Disturbance()]), world)
    stamps = [
        sweep.stamp
        for sweep in disturbances.Disturbed(world, [disturbances.MissingSweeps((1, 5), 2)])
    ]
    assert stamps == [world[i].stamp for i in (0, 3, 4, 7)]


def test_unreadable_sweeps_pass_and_features_are_refused(world):
    bad = BadSweep(1, "torn")
    assert list(disturbances.Disturbed(ListDataset([bad]), [disturbances.Outliers()])) == [bad]
    nothing = np.zeros((0, 3))
    features = FeatureSweep(Features.from_points(0, nothing, nothing), gtsam.Pose3())
    with pytest.raises(InputError, match="raw sweeps"):
        list(disturbances.Disturbed(ListDataset([features]), [disturbances.Outliers()]))
    with pytest.raises(InputError, match="raw sweeps"):
        disturbances.SkippedAhead(ListDataset([features] * 4), 1, 1)


def test_skipping_ahead_closes_the_gap_in_time(world):
    cut = disturbances.SkippedAhead(world, 3, 2)
    assert isinstance(cut, Dataset)
    sweeps = list(cut)
    assert len(cut) == len(sweeps) == 6
    assert np.unique(np.diff([sweep.stamp for sweep in sweeps])).tolist() == [SECOND // 10]
    assert np.array_equal(sweeps[3].points, world[5].points)
    kept = [0, 1, 2, 5, 6, 7]
    assert np.array_equal(cut.truth.map_T_lidar, world.truth.map_T_lidar[kept])
    assert cut.truth.stamps.tolist() == [sweep.stamp for sweep in sweeps]
    steps = np.diff(cut.imu.stamps)
    assert steps.min() == steps.max()  # the IMU has no gap either
    assert len(cut.imu.stamps) == len(world.imu.stamps) - 40
    assert "2 sweeps from 3" in cut.info().facts["cut out"]


def test_skipping_ahead_goes_without_truth_and_imu():
    plain = ArrayDataset([around(5.0, stamp=i) for i in range(5)])
    cut = disturbances.SkippedAhead(plain, 1, 1)
    assert cut.truth is None
    assert cut.imu is None


@pytest.mark.parametrize("place", [(0, 1), (3, 0), (3, 5), (8, 1), (0,), (8,)])
def test_a_cut_and_a_kidnapping_need_sweeps_on_both_sides(world, place):
    with pytest.raises(InputError, match=r"SkippedAhead|Kidnapped"):
        disturbances.SkippedAhead(world, *place) if len(place) == 2 else disturbances.Kidnapped(
            world, *place
        )


def test_a_kidnapped_lidar_is_where_the_truth_says(world):
    moved = disturbances.Kidnapped(world, 4, (0.0, 1.0, 0.0), 30.0)
    assert isinstance(moved, Dataset)
    assert len(list(moved)) == len(moved) == 8
    assert np.array_equal(moved[3].points, world[3].points)
    truth, calm = moved.truth.map_T_lidar, world.truth.map_T_lidar
    assert np.array_equal(truth[:4], calm[:4])
    step = np.linalg.inv(calm[4:]) @ truth[4:]
    np.testing.assert_allclose(step[:, :3, 3], [[0.0, 1.0, 0.0]] * 4, atol=1e-9)
    turn = Rotation.from_matrix(step[:, :3, :3]).as_euler("xyz", degrees=True)
    np.testing.assert_allclose(turn, [[0.0, 0.0, 30.0]] * 4, atol=1e-6)
    assert same(moved, moved)
    assert "30 degrees" in moved.info().facts["kidnapped"]


def test_a_kidnapped_lidar_sees_the_same_walls():
    """Points of both runs, put where the truths say, lie on the same walls."""
    world = SimulatedWorld("room", frames=8, columns=360, range_noise=0.0)
    moved = disturbances.Kidnapped(world, 4, (0.5, 0.5, 0.0), 30.0)
    for dataset in (world, moved):
        scan = dataset[6]
        early = scan.times < 2e-3  # the truth is that of the start
        pose = world.world_T_start @ dataset.truth.map_T_lidar[6]
        x, y, z = (scan.points[early] @ pose[:3, :3].T + pose[:3, 3]).T
        inside = np.max([np.abs(x) / 5.0, np.abs(y) / 4.0, np.abs(z - 1.5) / 1.5], axis=0)
        assert len(inside) > 50
        assert inside.max() < 1.002


def test_the_imu_of_a_kidnapped_lidar_turns_along(world):
    imu, calm = disturbances.Kidnapped(world, 4, (0.0, 0.0, 0.0), 90.0).imu, world.imu
    before = imu.stamps < world[4].stamp
    assert np.array_equal(imu.gyro[before], calm.gyro[before])
    # Its noise is the same, so that the turned x is the y of before, up to twice the noise.
    difference = imu.acceleration[~before][:, 0] - calm.acceleration[~before][:, 1]
    assert np.abs(difference).mean() < 0.2
    turned = Rotation.from_quat(calm.orientation).inv() * Rotation.from_quat(imu.orientation)
    angles = np.degrees(turned.magnitude())
    assert angles[before].max() == 0.0
    assert angles[~before] == pytest.approx(90.0, abs=3.0)
