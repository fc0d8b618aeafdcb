"""An IMU beside LOAM's own topics: its tilt is used as laserMapping does, from a bag and live."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bags import ROS1, cloud, imu, odometry, write_bag

from loam_gtsam.config import Config, preset
from loam_gtsam.datasets import open_dataset
from loam_gtsam.datasets.bags.bag_reader import read_messages
from loam_gtsam.datasets.bags.loam_topics import LoamTopicsDataset
from loam_gtsam.datasets.decode.loam_messages import CLOUD, EDGES, ODOMETRY, PLANES, REQUIRED
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.pipeline import run
from loam_gtsam.ros.live import LiveMapper

FRAMES = 5


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """What LOAM's front end would publish in the room, and the IMU."""
    world = SimulatedWorld("room", frames=FRAMES, columns=450)
    recording = []
    for scan, pose in zip(world, world.truth.map_T_lidar, strict=False):
        features = extract_features(scan, Config())
        still = MovingSweep(features, Config()).at(np.zeros(6))
        for topic, points in zip((EDGES, PLANES), still.points, strict=True):
            recording.append((topic, scan.stamp, cloud(ROS1, scan.stamp, points)))
        recording.append((CLOUD, scan.stamp, cloud(ROS1, scan.stamp, scan.points)))
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        recording.append(
            (ODOMETRY, scan.stamp, odometry(ROS1, scan.stamp, pose[:3, 3], quaternion))
        )
    samples = world.imu
    for n, stamp in enumerate(samples.stamps.tolist()):
        row = [*samples.orientation[n], *samples.gyro[n], *samples.acceleration[n]]
        recording.append(("/imu", stamp, imu(ROS1, stamp, row)))
    recording.sort(key=lambda entry: entry[1])
    return write_bag(tmp_path_factory.mktemp("bags") / "loam", "ros1", recording)


@pytest.mark.parametrize("options", [{}, {"imu_topic": "/imu"}])
def test_the_tilt_is_blended_whether_the_topic_is_named_or_not(bag, options):
    dataset = open_dataset(bag, **options)
    assert isinstance(dataset, LoamTopicsDataset)
    assert dataset.info().facts["IMU topic"] == "/imu"
    tilts = [str(update.tilt_prior) for update in run(dataset, preset("loam")).updates]
    assert tilts[1:] == ["blend"] * (FRAMES - 1)
    without = run(dataset, preset("loam").changed("imu.coupling=off"))
    assert {str(update.tilt_prior) for update in without.updates} == {"none"}


def test_live_is_as_from_the_bag(bag):
    config = preset("loam").changed("live.when_full=never", "live.imu_wait=60")
    live = LiveMapper(config, imu=True, features=(*REQUIRED, CLOUD), clock=lambda: 0)
    updates = []
    topics = [*REQUIRED, CLOUD, "/imu"]
    for message in read_messages(bag, topics, []):
        if message.topic == "/imu":
            live.add_imu(message.content)
        else:
            live.add_features(message.topic, message.content)
        while (result := live.step()) is not None:
            updates.append(result.update)
    offline = run(open_dataset(bag), config).updates[: len(updates)]
    assert len(updates) >= FRAMES - 1  # the last one waits for samples that never come
    for ours, theirs in zip(updates, offline, strict=True):
        np.testing.assert_array_equal(ours.map_T_lidar.matrix(), theirs.map_T_lidar.matrix())
        assert ours.tilt_prior == theirs.tilt_prior
    assert live.report().without_imu == 0
