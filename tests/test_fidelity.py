"""The presets against the recorded results of the C++ systems, on those systems' own topics.

What the limits come from, and the causes of what is left, stand in docs/classical.md.
"""

import numpy as np
import pytest

from loam_gtsam.config import preset
from loam_gtsam.datasets import open_dataset
from loam_gtsam.pipeline import run


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
    ("name", "first_20", "median", "most", "largest", "degrees"),
    [
        ("aloam", 0.0001, 0.0004, 0.005, 0.006, 0.001),
        ("loam", 0.001, 0.001, 0.005, 0.006, 0.002),
    ],
)
def test_the_recorded_poses_come_out_again(
    shared_data, name, first_20, median, most, largest, degrees
):
    position, rotation, updates = replay(shared_data / f"{name}_town" / "topics.bag", name)
    assert len(position) == 60
    assert all(update.status.solved for update in updates[1:])
    assert position[:20].max() < first_20
    assert np.median(position) < median
    assert np.quantile(position, 0.95) < most
    assert position.max() < largest
    assert np.median(rotation) < degrees
