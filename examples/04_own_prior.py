"""A factor of your own beside the scan matches: here a height, as from a barometer.

Priors are ordinary GTSAM factors on POSE_KEY, the pose at the middle of the sweep. The corridor
without furniture shows when they matter: the scan says nothing about the way along it.
"""

import gtsam
import numpy as np

from loam_gtsam import POSE_KEY, Config, Mapper, SimulatedWorld, checked_factor, extract_features


def coordinate_prior(axis: int, metres: float, sigma: float) -> gtsam.CustomFactor:
    """The map coordinate ``axis`` (0 x, 1 y, 2 z) of the pose is ``metres``."""

    def residual(values: gtsam.Values) -> tuple[np.ndarray, list[np.ndarray]]:
        pose = values.atPose3(POSE_KEY)
        jacobian = np.zeros((1, 6))  # rotation first, then translation in body axes
        jacobian[0, 3:] = pose.rotation().matrix()[axis]
        return np.array([pose.translation()[axis] - metres]), [jacobian]

    return checked_factor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), [POSE_KEY], residual)


def map_with(prior: list[gtsam.CustomFactor], scene: str) -> tuple[np.ndarray, np.ndarray]:
    """Position of the fourth sweep, and its standard deviations, if the prior acts on that one."""
    config, mapper = Config(), Mapper()
    for number, scan in enumerate(SimulatedWorld(scene, frames=4)):
        features = extract_features(scan, config)
        update = mapper.register(features, priors=prior if number == 3 else [])
    return update.map_T_lidar.translation(), np.sqrt(np.diag(update.covariance))[3:]


free, sigmas = map_with([], "room")
print(f"room, scan alone:       z = {free[2]:.4f} m, sigma {sigmas[2]:.4f} m")
for strength in (1.0, 0.01, 0.0001):
    held, _ = map_with([coordinate_prior(2, free[2] + 0.05, strength)], "room")
    print(f"  5 cm up, sigma {strength:6g} m: z = {held[2]:.4f} m, moved {held[2] - free[2]:.4f} m")

free, sigmas = map_with([], "corridor_bare")
print(f"corridor, scan alone:   x = {free[0]:.4f} m, sigma {sigmas[0]:.4f} m")
moved, sigmas = map_with([coordinate_prior(0, free[0] + 0.05, 0.001)], "corridor_bare")
print(f"  5 cm on, sigma  0.001 m: x = {moved[0]:.4f} m, moved {moved[0] - free[0]:.4f} m")
