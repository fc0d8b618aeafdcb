"""A run refined, and two of its sweeps registered with both poses free in a graph of your own."""

import gtsam
import numpy as np

from loam_gtsam import Config, SimulatedWorld, absolute_error, run
from loam_gtsam.factors import plane_rows
from loam_gtsam.refine.between_factors import sweep_match_factor
from loam_gtsam.refine.map_quality import common_thickness, map_quality
from loam_gtsam.refine.runs import refine_run, run_points

world = SimulatedWorld("room", frames=25, columns=900)
result = run(world, Config().changed("imu.coupling=off"))

# The whole run: all planes and lines of the map adjusted together with all poses.
points = run_points(world, result.updates, result.config, most=1500)
refined = refine_run(points, result.updates)
before, after = (map_quality(*refined.held_out(refined=on)) for on in (False, True))
thick = common_thickness(before, after)
errors = [absolute_error(t, world.truth).rmse for t in (result.trajectory, refined.trajectory)]
print(f"thickness of the walls {1e3 * thick[0]:.1f} -> {1e3 * thick[1]:.1f} mm")
print(f"error {1e3 * errors[0]:.1f} -> {1e3 * errors[1]:.1f} mm")
sigmas = np.sqrt(np.diag(refined.relative_covariance(5, 15)))
print("motion from frame 5 to 15, standard deviations (rad, m):", np.round(sigmas, 5))

# A graph of your own: planes of one sweep (the target), seen in another, both poses free.
TARGET, SOURCE = gtsam.symbol("x", 0), gtsam.symbol("x", 1)
landmarks, path = refined.refined.landmarks, refined.refined.path
planes, sweep = ~landmarks.is_line, points.used[15]
first, second = (gtsam.Pose3(path.map_T_middle[n]) for n in (5, 15))
seen = path.deskewed(15, sweep)[sweep.edges :]  # those on surfaces
in_map = second.transformFrom(seen.T).T
centres = landmarks.centres[planes]
nearest = np.linalg.norm(in_map[:, None] - centres, axis=2).argmin(axis=1)
normals = landmarks.axes[planes][nearest, :, 0]
on_it = np.abs(np.einsum("ni,ni->n", normals, in_map - centres[nearest])) < 0.05
to_first = first.rotation().matrix()
target_normals = normals[on_it] @ to_first
centres = first.transformTo(centres[nearest][on_it].T).T
offsets = -np.einsum("ni,ni->n", target_normals, centres)
ones = np.ones(len(offsets))
rows = plane_rows(seen[on_it], target_normals, offsets, ones, 0.03)

graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
graph.add(sweep_match_factor(TARGET, SOURCE, rows))
graph.add(gtsam.PriorFactorPose3(TARGET, first, gtsam.noiseModel.Isotropic.Sigma(6, 0.01)))
start.insert(TARGET, first)
start.insert(SOURCE, second.retract(np.full(6, 0.02)))
found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
off = np.linalg.norm(found.atPose3(SOURCE).translation() - second.translation())
print(f"{len(ones)} matches in one factor of 13 rows: {1e3 * off:.1f} mm from the refined pose")
