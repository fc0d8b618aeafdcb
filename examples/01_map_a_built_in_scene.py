"""Map a scene of the built-in world, compare with its exact truth, write all results.

Downloads nothing. The folder it writes is described in docs/outputs.md.
"""

from loam_gtsam import SimulatedWorld, absolute_error, run, write_run

world = SimulatedWorld("street_loop", frames=25)  # 709 go once round the block
result = run(world)

error = absolute_error(result.trajectory, world.truth)
print(
    f"{len(result.updates)} sweeps, {result.trajectory.path_length:.1f} m: {result.status_counts}"
)
print(f"map: {len(result.edge_points)} edge and {len(result.plane_points)} plane points")
print(f"absolute trajectory error {error.rmse:.3f} m, at most {error.maximum:.3f} m")

write_run(result, "loam_gtsam_output/example_01", dataset=world.name)
