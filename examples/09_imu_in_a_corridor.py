"""The IMU where the scan says nothing: a bare corridor, out of sight of its ends.

With ``imu.coupling`` tight, the default, every pose is predicted from gyro and accelerometer, with
velocity and biases known from the frames before. The prediction takes over along the directions
that the scan does not fix; the update's ``status`` and ``message`` say when, and which.
"""

import numpy as np

from loam_gtsam import Config, RunResult, SimulatedWorld, run

# The lidar sees the wall behind it for the first 20 m, then nothing along the corridor.
world = SimulatedWorld("corridor_bare", frames=80, columns=360, max_range=20.0)


def off_along(result: RunResult) -> float:
    """Metres along the corridor by which the last pose is off."""
    first, last = result.trajectory.map_T_lidar[[0, -1]]
    travelled = (np.linalg.inv(first) @ last)[:3, 3]
    return float(np.linalg.norm(travelled) - np.linalg.norm(world.truth.map_T_lidar[-1, :3, 3]))


constant = run(world, Config().changed("imu.coupling=loose"))
inertial = run(world)
blind = [update for update in inertial.updates if update.status == "degenerate"]
errors = off_along(constant), off_along(inertial)
print(f"{len(blind)} of {len(world)} sweeps are degenerate, e.g.: {blind[0].message}")
print(f"constant velocity: {errors[0]:+.2f} m along, of {world.truth.path_length:.1f} m")
print(f"tight coupling:    {errors[1]:+.2f} m along")
