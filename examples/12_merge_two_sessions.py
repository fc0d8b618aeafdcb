"""Two drives through the same place become one map.

Each drive was mapped on its own: here the second drive began in another corner of the room, with
another heading. Loop closures between the drives are found as within one run, and tie the drives
together.
"""

import gtsam
import numpy as np

from loam_gtsam import (
    Config,
    Mapper,
    PoseGraph,
    ScanLoopCloser,
    SimulatedWorld,
    extract_features,
)
from loam_gtsam.io.run_files import write_ply

config = Config().changed(  # small steps for a small room
    "pose_graph.keyframe_distance=0.5", "loops.neighbours=3", "loops.min_way=4.0"
)
world = SimulatedWorld("room", frames=90, columns=400, speed=2.0)
sweeps = [world[number] for number in range(len(world))]
sessions = sweeps[:50], sweeps[40:]  # the second one begins elsewhere

graph, closer = PoseGraph(config), ScanLoopCloser(config)
for session in sessions:
    graph.new_session()
    mapper = Mapper(config)
    for scan in session:
        features = extract_features(scan, config)
        keyframe = graph.add(mapper.register(features), features)
        loop = None if keyframe is None else closer.detect(keyframe, graph)
        if loop is not None:
            graph.add_loop(loop)

truth = {scan.stamp: world.truth.map_T_lidar[k] for k, scan in enumerate(sweeps)}
start = gtsam.Pose3(truth[graph.keyframes[0].stamp])
first = next(keyframe.index for keyframe in graph.keyframes if keyframe.session == 1)
true = start.between(gtsam.Pose3(truth[graph.keyframes[first].stamp]))
found = graph.pose(0).between(graph.pose(first))
between = [loop for loop in graph.loops if loop.earlier < first <= loop.later]
print(f"{len(graph)} keyframes, {len(graph.loops)} loops, {len(between)} between the sessions")
print(f"the second one began {np.linalg.norm(true.translation()):.2f} m away;")
print(f"that is found to within {1e3 * true.range(found):.0f} mm")
edges, planes = graph.map_points()
write_ply("both.ply", edges, planes)
print(f"both.ply: {len(edges) + len(planes)} points")
