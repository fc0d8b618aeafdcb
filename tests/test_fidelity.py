"""The presets against the recorded results of the C++ systems, on those systems' own topics.

What the limits come from, and the causes of what is left, stand in docs/classical.md. The
recordings are not part of this repository. What is: 20 poses of each preset in a place made of
points, as they were when the presets followed the recordings. After a change that is meant, and
with the recordings at hand, ``PYTHONPATH=tests python tests/test_fidelity.py`` makes them anew.
"""

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from support.worlds import World

from loam_gtsam.config import preset
from loam_gtsam.datasets import open_dataset
from loam_gtsam.mapper import Mapper
from loam_gtsam.pipeline import run

KEPT = Path(__file__).parent / "data" / "fidelity.json"
FIRST_20 = {"aloam": 0.0001, "loam": 0.001}
"""Metres by which the first 20 poses may differ."""


def replay(path, name):
    """Position (m) and rotation (degrees) differences per frame, and the statuses."""
    dataset = open_dataset(path)
    result = run(dataset, preset(name))
    recorded, ours = dataset.recorded, result.trajectory
    np.testing.assert_array_equal(recorded.stamps, ours.stamps)
    between = np.linalg.inv(recorded.map_T_lidar) @ ours.map_T_lidar
    position = np.linalg.norm(between[:, :3, 3], axis=1)
    sine = np.linalg.norm(between[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(8.0)
    return position, np.degrees(2.0 * np.arcsin(sine)), result.updates


@pytest.mark.parametrize(
    ("name", "median", "most", "largest", "degrees"),
    [("aloam", 0.0004, 0.005, 0.006, 0.001), ("loam", 0.001, 0.005, 0.006, 0.002)],
)
def test_the_recorded_poses_come_out_again(shared_data, name, median, most, largest, degrees):
    position, rotation, updates = replay(shared_data / f"{name}_town" / "topics.bag", name)
    assert len(position) == 60
    assert all(update.status.solved for update in updates[1:])
    assert position[:20].max() < FIRST_20[name]
    assert np.median(position) < median
    assert np.quantile(position, 0.95) < most
    assert position.max() < largest
    assert np.median(rotation) < degrees


def mapped(config):
    """(20, 6) poses, rad and metres, from features and the guesses of a drifting odometry."""
    rng, world, mapper = (
        np.random.default_rng(5),
        World(4, 25, 50, low=-14.0, high=26.0),
        Mapper(config),
    )
    pose, odometry, poses = gtsam.Pose3(), gtsam.Pose3(), []
    for number in range(20):
        update = mapper.register(world.seen(pose, number * 10**8, rng), odometry)
        assert number == 0 or update.status.solved
        poses.append(gtsam.Pose3.Logmap(update.map_T_lidar))
        motion = gtsam.Pose3.Expmap(np.array([0.002, -0.003, 0.02, 0.4, 0.01, 0.005]))
        pose = pose.compose(motion)
        drift = motion.retract(rng.normal(0.0, [2e-3] * 3 + [0.02] * 3))
        odometry = update.map_T_lidar.compose(drift)
    return np.array(poses)


@pytest.mark.parametrize("name", list(FIRST_20))
def test_the_presets_are_those_that_followed_the_recordings(name):
    kept = np.array(json.loads(KEPT.read_text("utf-8"))[name])
    config = preset(name).changed("imu.coupling=off")
    assert np.abs(mapped(config) - kept).max() < FIRST_20[name]
    other = config.changed("matching.plane_fit=centroid")
    assert np.abs(mapped(other) - kept).max() > FIRST_20[name]


if __name__ == "__main__":
    found = {name: mapped(preset(name).changed("imu.coupling=off")) for name in FIRST_20}
    rows = {name: np.round(poses, 7).tolist() for name, poses in found.items()}
    KEPT.write_text(json.dumps(rows) + "\n", "utf-8")
