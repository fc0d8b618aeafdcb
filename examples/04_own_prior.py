"""A factor of your own beside the scan matches: here a height, as from a barometer.

Priors are ordinary GTSAM factors on POSE_KEY, the pose at the *middle* of the sweep; the mapper
hands its result out at the *start* (or whatever deskew.reference says).
"""

import gtsam
import numpy as np

from loam_gtsam import POSE_KEY, Config, Mapper, SimulatedWorld, checked_factor, extract_features


def height_prior(metres: float, sigma: float) -> gtsam.CustomFactor:
    """The middle of the sweep is ``metres`` above the map's origin."""

    def residual(values: gtsam.Values) -> tuple[np.ndarray, list[np.ndarray]]:
        pose = values.atPose3(POSE_KEY)
        jacobian = np.zeros((1, 6))  # rotation first, then translation along the lidar's axes
        jacobian[0, 3:] = pose.rotation().matrix()[2]
        return np.array([pose.translation()[2] - metres]), [jacobian]

    return checked_factor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), [POSE_KEY], residual)


config = Config()
sweeps = [extract_features(s, config) for s in SimulatedWorld("room", sensor="hdl32", frames=4)]


def height_with(priors: list[gtsam.CustomFactor]) -> tuple[float, float]:
    """Height of the last sweep at its middle and its sigma, if the priors act on that sweep."""
    mapper = Mapper(config)
    for number, features in enumerate(sweeps):
        update = mapper.register(features, priors=priors if number == len(sweeps) - 1 else [])
    half = 0.5 * sum(sweeps[-1].span)
    middle = update.map_T_lidar.compose(gtsam.Pose3.Expmap(half * update.twist))
    return middle.translation()[2], float(np.sqrt(update.raw_covariance[5, 5]))


free, sigma = height_with([])
print(f"scan alone: {free:.4f} m, sigma {sigma:.4f} m")
target = free + 0.05
for strength in (1.0, sigma, 1e-4):
    held, after = height_with([height_prior(target, strength)])
    print(f"prior at {target:.4f} m, sigma {strength:.4f} m: {held:.4f} m, sigma {after:.4f} m")
