"""The presets against the C++ systems themselves, given the same features and odometry.

``data/fidelity.npz`` holds twenty sweeps of a simulated street and the poses that the unmodified
C++ systems make of them. How it was made, where the limits come from, and the causes of what is
left stand in docs/classical.md. The recordings of longer runs are not part of this repository.
"""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.list_dataset import ListDataset

from loam_gtsam.config import preset
from loam_gtsam.datasets import open_dataset
from loam_gtsam.pipeline import run
from loam_gtsam.types import Features, FeatureSweep, ImuSamples

EXTRACT = Path(__file__).parent / "data" / "fidelity.npz"
GRID = 1.0 / 512.0
"""Metres; unit of the points of the extract."""
FIRST_20 = {"aloam": 0.0001, "loam": 0.001}
"""Metres by which the first 20 poses may differ from the recordings."""


def differences(config, sweeps, map_T_lidar):
    """Position (m) and rotation (degrees) differences to (N, 4, 4) poses, and the run."""
    result = run(sweeps, config)
    between = np.linalg.inv(map_T_lidar) @ result.trajectory.map_T_lidar
    position = np.linalg.norm(between[:, :3, 3], axis=1)
    sine = np.linalg.norm(between[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(8.0)
    return position, np.degrees(2.0 * np.arcsin(sine)), result


def as_matrices(rows):
    """(N, 4, 4) poses of (N, 7) rows x y z qx qy qz qw."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 3:]).as_matrix()
    poses[:, :3, 3] = rows[:, :3]
    return poses


@pytest.fixture(scope="module")
def extract():
    """The sweeps that both were given, and the poses of the C++ systems."""
    kept = dict(np.load(EXTRACT))
    clouds = []
    for kind in ("edges", "planes"):
        # Kept as steps from point to point, which modulo 2^16 add up to the points.
        points = np.cumsum(kept[kind], axis=1, dtype=np.int16).T * np.float32(GRID)
        clouds.append(np.split(points, np.cumsum(kept[f"{kind}_counts"])[:-1]))
    odometry = map(gtsam.Pose3, as_matrices(kept["odometry"]))
    sweeps = [
        FeatureSweep(Features.from_points(int(stamp), edges, planes), odom_T_lidar)
        for stamp, edges, planes, odom_T_lidar in zip(
            kept["stamps"], *clouds, odometry, strict=True
        )
    ]
    names = "aloam", "loam", "loam_imu"
    return ListDataset(sweeps), {name: as_matrices(kept[name]) for name in names}


@pytest.mark.parametrize(
    ("name", "median", "largest", "degrees"),
    [("aloam", 0.0002, 0.001, 0.01), ("loam", 0.0007, 0.002, 0.01)],
)
def test_the_presets_follow_the_cpp_systems(extract, name, median, largest, degrees):
    sweeps, theirs = extract
    position, rotation, result = differences(preset(name), sweeps, theirs[name])
    assert all(update.status.solved for update in result.updates[1:])
    assert np.median(position) < median
    assert position.max() < largest
    assert rotation.max() < degrees
    other = preset(name).changed("matching.line_ratio=5")
    assert np.median(differences(other, sweeps, theirs[name])[0]) > largest


def test_the_tilt_is_blended_as_laser_mapping_does(extract):
    sweeps, theirs = extract
    first, last = sweeps.items[0].stamp, sweeps.items[-1].stamp
    stamps = np.arange(first, last + 1, 5_000_000)
    leaning = np.clip((stamps - first) * 1e-9 - 1.0, 0.0, 1.0)  # from level, within a second
    angles = np.outer(leaning, [0.3, -0.2, 0.0])
    still, up = np.zeros((len(stamps), 3)), np.tile([0.0, 0.0, 9.81], (len(stamps), 1))
    with_imu = ListDataset(sweeps.items)
    with_imu.imu = ImuSamples(stamps, Rotation.from_euler("xyz", angles).as_quat(), still, up)
    position, rotation, _ = differences(preset("loam"), with_imu, theirs["loam_imu"])
    assert np.median(position) < 0.002
    assert rotation.max() < 0.02
    unblended = np.linalg.inv(theirs["loam"]) @ theirs["loam_imu"]
    assert np.degrees(Rotation.from_matrix(unblended[-1, :3, :3]).magnitude()) > 0.1


@pytest.mark.parametrize(
    ("name", "median", "most", "largest", "degrees"),
    [("aloam", 0.0004, 0.005, 0.006, 0.001), ("loam", 0.001, 0.005, 0.006, 0.002)],
)
def test_the_recorded_poses_come_out_again(shared_data, name, median, most, largest, degrees):
    dataset = open_dataset(shared_data / f"{name}_town" / "topics.bag")
    recorded = dataset.recorded
    position, rotation, result = differences(preset(name), dataset, recorded.map_T_lidar)
    np.testing.assert_array_equal(recorded.stamps, result.trajectory.stamps)
    assert len(position) == 60
    assert all(update.status.solved for update in result.updates[1:])
    assert position[:20].max() < FIRST_20[name]
    assert np.median(position) < median
    assert np.quantile(position, 0.95) < most
    assert position.max() < largest
    assert np.median(rotation) < degrees
