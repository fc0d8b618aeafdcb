"""Trajectories for tests."""

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.types import Trajectory


def random_trajectory(count: int, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    if count:
        poses[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
        poses[:, :3, 3] = rng.normal(0.0, 1000.0, (count, 3))
    stamps = 1_700_000_000_123_456_789 + np.arange(count, dtype=np.int64) * 100_000_007
    return Trajectory(stamps, poses)
