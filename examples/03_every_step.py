"""The steps of a frame, each by hand: sweep, features, guess, registration.

Use your own front end, your own guess or your own solver by replacing one of them.
"""

import numpy as np

from loam_gtsam import Config, Mapper, SimulatedWorld, extract_features
from loam_gtsam.registration.odometry import ConstantVelocity

world = SimulatedWorld("room", sensor="hdl32", frames=6)
config = Config().changed("matching.max_distance=0.8")  # any parameter

odometry = ConstantVelocity()
mapper = Mapper(config)
for scan in world:
    features = extract_features(scan, config)  # raw positions, each with its time
    guess = odometry.guess(features, mapper.last)  # pose and body velocity
    update = mapper.register(features, guess.map_T_lidar, guess.twist)

print(
    f"features: {len(features.edges)} edge and {len(features.planes)} plane points, before voxels"
)
print(f"guess at:  {guess.map_T_lidar.translation().round(3)} m")
print(f"solved at: {update.map_T_lidar.translation().round(3)} m, status {update.status}")
truth = world.truth.map_T_lidar[-1]
print(f"truth at:  {truth[:3, 3].round(3)} m")
print(f"matches: {update.n_edge_matches} of {update.n_edges} edge points,")
print(f"         {update.n_plane_matches} of {update.n_planes} plane points")
print(f"{update.iterations} associations, {update.solver_iterations} solver iterations")
print(f"cost {update.error_before:.1f} -> {update.error_after:.1f}")
sigmas = np.sqrt(np.diag(update.covariance))  # rotation first, then translation
print(f"standard deviations: {np.degrees(sigmas[:3]).round(4)} deg, {1e3 * sigmas[3:].round(5)} mm")
print("ms:", {stage: round(1e3 * seconds, 1) for stage, seconds in update.timings.items()})
