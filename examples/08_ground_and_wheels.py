"""Own factors on every sweep: a flat floor, and the distance that wheels have measured.

The floor is a residual of one's own in ``checked_factor``, the wheels a between-factor that joins
the pose with that of the last sweep.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from loam_gtsam import Config, PoseContext, SimulatedWorld, checked_factor, run

FLOOR_SIGMAS = (0.005, 0.002, 0.002)  # height in m, tilt in rad: how flat the floor is
# rad, then metres, per sweep: wheels measure no roll, no pitch and no height.
WHEELS = (10.0, 10.0, 0.01, 0.003, 0.003, 10.0)

# A short-sighted lidar between bare walls: no sweep says how far one went.
world = SimulatedWorld("corridor_bare", frames=45, columns=450, max_range=6.0)
floor_up = world.world_T_start[2, :3]  # z of the world in the map, which is the first pose's frame
off = Config().changed("imu.coupling=off")  # the factors have to do it


def floor(context: PoseContext) -> gtsam.NonlinearFactor:
    """The lidar keeps its height above the floor and stands upright on it."""

    def residual(values: gtsam.Values) -> tuple[np.ndarray, list[np.ndarray]]:
        pose = values.atPose3(context.key)
        up = pose.rotation().matrix().T @ floor_up  # lidar frame
        error = np.array([floor_up @ pose.translation(), up[0] - floor_up[0], up[1] - floor_up[1]])
        jacobian = np.zeros((3, 6))  # rotation first; a turn w moves up by up x w
        jacobian[0, 3:] = up
        jacobian[1:, :3] = np.array([[0.0, -up[2], up[1]], [up[2], 0.0, -up[0]]])
        return error, [jacobian]

    noise = gtsam.noiseModel.Diagonal.Sigmas(FLOOR_SIGMAS)
    return checked_factor(noise, [context.key], residual)


def wheels(context: PoseContext) -> gtsam.NonlinearFactor:
    """What the wheels have turned since the last sweep; they slip by 1 %."""
    stamp, _ = context.last
    a, b = world.truth_at(np.array([stamp, context.middle_stamp])).map_T_lidar
    step = gtsam.Pose3(np.linalg.inv(a) @ b)
    step = gtsam.Pose3(step.rotation(), 1.01 * step.translation())
    noise = gtsam.noiseModel.Diagonal.Sigmas(WHEELS)
    return gtsam.BetweenFactorPose3(context.last_key, context.key, step, noise)


def both(context: PoseContext) -> Sequence[gtsam.NonlinearFactor]:
    """As many factors as there are sensors."""
    return [floor(context), wheels(context)]


errors = {}
travelled = world.truth.path_length
for name, factors in (("scans alone", None), ("with floor and wheels", both)):
    result = run(world, off, extra_factors=factors)
    away = result.trajectory.positions - world.truth.positions
    errors[name] = np.abs(away[-1, 0]), np.abs(away @ floor_up).max()
    print(f"{name}: {errors[name][0]:.3f} m along after {travelled:.1f} m, "
          f"{1e3 * errors[name][1]:.1f} mm in height")  # fmt: skip
