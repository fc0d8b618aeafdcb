"""A drive that is mapped in parts, which may run side by side, becomes one map.

Each part begins where no other part has been before it, in a frame of its own, and overlaps the
next one. The parts are joined from their map files, by the places that they have in common. The
same joins drives of different days.
"""

import numpy as np

from loam_gtsam import Config, SimulatedWorld, Trajectory, run
from loam_gtsam.datasets.base import PartOf
from loam_gtsam.maps import SavedMap, merge_maps, save_map
from loam_gtsam.studies.evaluation import absolute_error

config = Config().changed("pose_graph.keyframe_distance=0.5")  # small steps for a small room
world = SimulatedWorld("room", frames=50, columns=300, speed=3.0)
parts = {"first": (0, 28), "second": (20, 50)}

runs = []
for name, (start, end) in parts.items():  # a job for each, with as many cores as there are
    runs.append(run(PartOf(world, start, 1, None, None), config, max_frames=end - start))
    save_map(f"{name}.lgmap", runs[-1])

with SavedMap("first.lgmap") as first, SavedMap("second.lgmap") as second:
    merged = merge_maps([first, second], "both.lgmap")
print(f"{merged.ties[0, 1]} loops between the maps, {merged.unused} not used")

ways = [merged.trajectory(number, done.updates) for number, done in enumerate(runs)]
stamps, rows = np.unique(np.concatenate([way.stamps for way in ways]), return_index=True)
way = Trajectory(stamps, np.concatenate([way.map_T_lidar for way in ways])[rows])
error = absolute_error(way, world.truth).rmse
alone = [1e3 * absolute_error(done.trajectory, world.truth).rmse for done in runs]
print(f"parts alone: {alone[0]:.1f} and {alone[1]:.1f} mm off; the whole: {1e3 * error:.1f} mm")
with SavedMap("both.lgmap") as both:
    print(f"both.lgmap: {len(both.places)} places, {len(both)} points")
