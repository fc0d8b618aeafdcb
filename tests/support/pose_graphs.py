"""Pose graphs of drives around a square: frames, loop closures, right ones and wrong ones."""

from itertools import pairwise

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.types import FrameStatus, MapUpdate, Uncertainty

SIGMAS = np.repeat([0.002, 0.02], 3)
FRAME = 10**8


def settings(**pose_graph):
    config = Config()
    chosen = {"keyframe_distance": 0.5, "walk": 0.0, "turn_walk_deg": 0.0} | pose_graph
    return config.changed(pose_graph=config.pose_graph.changed(**chosen))


def frames(poses, sigmas=SIGMAS):
    """Solved frames whose relative covariance is that of ``sigmas`` a step."""
    drift = 1e-8 * np.eye(6)
    made = []
    for number, pose in enumerate(poses):
        if number:
            to_map = pose.AdjointMap()
            drift = drift + to_map @ np.diag(sigmas**2) @ to_map.T
        parts = Uncertainty(np.zeros((6, 6)), np.zeros((6, 6)), None, drift, 1.0, 100.0)
        made.append(
            MapUpdate(number * FRAME, pose, FrameStatus.OK, covariance=1e-8 * np.eye(6),
                      uncertainty=parts)
        )  # fmt: skip
    return made


def square(side, laps):
    """Poses 1 m apart around a square, the first ones on its side along x."""
    poses = [gtsam.Pose3()]
    for step in range(laps * 4 * side - 1):
        turn = gtsam.Rot3.Yaw(np.pi / 2.0) if (step + 1) % side == 0 else gtsam.Rot3()
        poses.append(poses[-1].compose(gtsam.Pose3(turn, np.array([1.0, 0.0, 0.0]))))
    return poses


def drifted(poses, rng, sigmas=SIGMAS):
    odometry = [poses[0]]
    for one, two in pairwise(poses):
        step = one.between(two).retract(sigmas * rng.normal(size=6))
        odometry.append(odometry[-1].compose(step))
    return odometry


def right_loops(truth, rng, count):
    lap = len(truth) // 2
    made = []
    for a in np.linspace(3, lap - 3, count).astype(int).tolist():
        seen = truth[a].between(truth[a + lap]).retract(SIGMAS * rng.normal(size=6))
        made.append(LoopClosure(a, a + lap, seen, np.diag(SIGMAS**2)))
    return made


def wrong_loops(count, size, rng):
    made = []
    while len(made) < count:
        one, two = sorted(rng.choice(size, 2, replace=False).tolist())
        if two - one > 1:
            where = gtsam.Pose3(gtsam.Rot3.Yaw(rng.uniform(-3, 3)), rng.normal(0, 2.0, 3))
            made.append(LoopClosure(one, two, where, np.diag(SIGMAS**2)))
    return made


def filled(poses, sigmas=SIGMAS, **pose_graph):
    graph = PoseGraph(settings(**pose_graph))
    for update in frames(poses, sigmas):
        graph.add(update)
    return graph


def off(poses, truth):
    """Metres, root mean square, of (N, 4, 4) or of Pose3 by key."""
    if isinstance(poses, gtsam.Values):
        found = [poses.atPose3(gtsam.symbol("x", n)).translation() for n in range(len(truth))]
    else:
        found = poses[:, :3, 3]
    errors = np.array(found) - [pose.translation() for pose in truth]
    return np.sqrt(np.square(errors).sum(axis=1).mean())
