"""A loop closer of your own: it takes the nearest old keyframe, which the package registers.

A loop closer is any object with a method ``detect``. This loop closer looks at positions only; put
your own place recognition there. The odometry is made to drift, so that there is a loop to close.
"""

from dataclasses import replace

import gtsam
import numpy as np

from loam_gtsam import (
    Config,
    Keyframe,
    LoopClosure,
    Mapper,
    PoseGraph,
    ScanLoopCloser,
    SimulatedWorld,
    extract_features,
)

# Small steps for a small room, and an odometry that is known to be bad.
config = Config().changed(
    "pose_graph.keyframe_distance=0.5",
    "pose_graph.walk=0.05",
    "pose_graph.turn_walk_deg=0.5",
    "loops.neighbours=3",
)


class NearestKeyframe:
    """Closes the loop with the nearest of the keyframes 8 m or more back on the way."""

    def __init__(self) -> None:
        self.registration = ScanLoopCloser(config)

    def detect(self, keyframe: Keyframe, history: PoseGraph) -> LoopClosure | None:
        """Register the keyframe against the nearest old one."""
        old = [
            other.index for other in history.keyframes if keyframe.travelled - other.travelled > 8.0
        ]
        if not old:
            return None
        nearest = min(old, key=lambda n: history.pose(n).range(history.pose(keyframe.index)))
        found = self.registration.verify(keyframe, nearest, history)
        return found if isinstance(found, LoopClosure) else None


world = SimulatedWorld("room", frames=80, columns=300, speed=2.0)
drift = gtsam.Pose3(gtsam.Rot3.Yaw(0.002), np.array([0.003, 0.002, 0.0]))  # a frame
mapper, graph, closer = Mapper(config), PoseGraph(config), NearestKeyframe()
odometry, last = gtsam.Pose3(), gtsam.Pose3()
drifting = []
for scan in world:
    features = extract_features(scan, config)
    update = mapper.register(features)
    odometry = odometry.compose(last.between(update.map_T_lidar)).compose(drift)
    last = update.map_T_lidar
    drifting.append(replace(update, map_T_lidar=odometry))
    keyframe = graph.add(drifting[-1], features)
    loop = None if keyframe is None else closer.detect(keyframe, graph)
    if loop is not None:
        graph.add_loop(loop)

closed = graph.trajectory(drifting).positions
truth = world.truth.positions
before = np.linalg.norm(odometry.translation() - truth[-1])
after = np.linalg.norm(closed[-1] - truth[-1])
print(f"{len(graph)} keyframes, {len(graph.loops)} loops, {sum(graph.active)} of them used")
print(f"last pose off by {before:.2f} m before, {after:.2f} m after")
