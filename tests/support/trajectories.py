"""Trajectories for tests."""

import gtsam
import numpy as np

from loam_gtsam.types import Trajectory

STAMP = 1_700_000_000_000_000_000


def winding(count=120, step=1.0):
    """A path of even steps that turns about all axes."""
    rng = np.random.default_rng(0)
    poses, at = [], gtsam.Pose3()
    for _ in range(count):
        poses.append(at.matrix())
        at = at.compose(gtsam.Pose3.Expmap(np.r_[rng.normal(0, 0.05, 3), step, 0.0, 0.0]))
    return Trajectory(STAMP + np.arange(count) * 100_000_000, np.array(poses))


def off_by(poses, truth):
    """Metres by which (N, 4, 4) poses are off, both seen from their first."""
    found, right = (np.linalg.inv(p[0]) @ p for p in (poses, truth))
    return np.linalg.norm(found[:, :3, 3] - right[:, :3, 3], axis=1)


def disturbed(trajectory, seed=1, size=0.02):
    rng = np.random.default_rng(seed)
    noise = [gtsam.Pose3.Expmap(v).matrix() for v in rng.normal(0, size, (len(trajectory), 6))]
    return Trajectory(trajectory.stamps, trajectory.map_T_lidar @ np.array(noise))


def moved(trajectory, seed=3):
    """The same in another map frame."""
    other_T_map = gtsam.Pose3.Expmap(np.random.default_rng(seed).normal(size=6)).matrix()
    return Trajectory(trajectory.stamps, other_T_map @ trajectory.map_T_lidar)


def straight(count=200, scale=1.0, yaw_per_step=0.0):
    poses = np.tile(np.eye(4), (count, 1, 1))
    for n in range(count):
        poses[n, :3, :3] = gtsam.Rot3.Yaw(n * yaw_per_step).matrix()
        poses[n, 0, 3] = scale * n
    return Trajectory(np.arange(count) * 100_000_000, poses)
