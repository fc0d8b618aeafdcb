"""Keyframes, loops between them, and their covariances as noise models."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from loam_gtsam.config import PoseGraphConfig
from loam_gtsam.geometry import as_array, as_vector, symmetric
from loam_gtsam.registration.pose_errors import relative_covariance
from loam_gtsam.types import BoolArray, FloatArray, InputError, MapUpdate

_LEAST_SIGMAS = np.repeat([1e-6, 1e-5], 3)
"""rad and m added to every standard deviation: a factor must not be infinitely sure."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame that is a pose of the graph.

    Attributes
    ----------
    index : its number, which is its key in the graph
    update : of the frame; its ``map_T_lidar`` is in the frame that drifts, see ``odom_T_lidar``
    way : metres gone along the keyframes until here
    edges, planes : (E, 3) and (P, 3) metres, de-skewed to the stamp, lidar frame, voxel-filtered
    distinct : (E,) whether an edge stands out of its ring by more than noise makes it
    session : of how many the run is that the frame is of; no odometry leads from one to another
    """

    index: int
    update: MapUpdate
    way: float
    edges: FloatArray
    planes: FloatArray
    distinct: BoolArray
    session: int = 0

    @property
    def stamp(self) -> int:
        """Nanoseconds the pose belongs to."""
        return self.update.stamp

    @property
    def odom_T_lidar(self) -> gtsam.Pose3:
        """The pose as the mapper found it."""
        return self.update.map_T_lidar


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """The motion between two keyframes, found by looking at the same place.

    Attributes
    ----------
    earlier, later : numbers of the keyframes
    earlier_T_later : the pose of the later one seen from the earlier one
    covariance : (6, 6) of it, tangent order of the package, perturbation on the right
    share, agreement : of the features off level ground that were matched, and of those matches that
        agree; NaN if unknown
    """

    earlier: int
    later: int
    earlier_T_later: gtsam.Pose3
    covariance: FloatArray
    share: float = np.nan
    agreement: float = np.nan

    def factor(self, kernel_width: float = np.inf) -> gtsam.BetweenFactorPose3:
        """The loop as a factor, with a Huber kernel of that width on its whitened norm."""
        noise: gtsam.noiseModel.Base = noise_model(self.covariance)
        if np.isfinite(kernel_width):
            kernel = gtsam.noiseModel.mEstimator.Huber.Create(kernel_width)
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        return gtsam.BetweenFactorPose3(self.earlier, self.later, self.earlier_T_later, noise)


def odometry_between(
    one: Keyframe, two: Keyframe, config: PoseGraphConfig
) -> tuple[gtsam.Pose3, FloatArray]:
    """``one_T_two`` as the mapper has it, in either order of time, and its (6, 6) covariance."""
    motion = one.odom_T_lidar.between(two.odom_T_lidar)
    if one.index == two.index:
        return motion, np.zeros((6, 6))
    if one.index < two.index:
        covariance = relative_covariance(one.update, two.update)
    else:
        back = motion.inverse().AdjointMap()
        covariance = back @ relative_covariance(two.update, one.update) @ back.T
    walk = np.repeat([np.radians(config.turn_walk_deg), config.walk], 3)
    return motion, covariance + np.diag(walk**2 * abs(two.way - one.way))


def noise_model(covariance: FloatArray, size: int = 6) -> gtsam.noiseModel.Gaussian:
    """A noise model that is never infinitely sure.

    Raises
    ------
    InputError
        If the matrix is no covariance: GTSAM would make NaN of it in silence.
    """
    matrix = as_array(covariance, "covariance", (size, size))
    if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-12 * np.abs(matrix).max()):
        raise InputError("covariance: expected a symmetric matrix; give 0.5 * (C + C.T)")
    values, vectors = np.linalg.eigh(symmetric(matrix))
    if values[0] < -1e-6 * np.trace(matrix):
        raise InputError(f"covariance: expected no negative eigenvalue, got {values[0]:.3g}")
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T  # rounding, far from the origin
    return gtsam.noiseModel.Gaussian.Covariance(positive + np.diag(_LEAST_SIGMAS[-size:] ** 2))


def direction(name: str, vector: ArrayLike) -> gtsam.Unit3:
    """The direction of a (3,) vector of any length; InputError if it has none."""
    array = as_vector(vector, name)
    if not np.linalg.norm(array) > 0.0:
        raise InputError(f"{name}: expected a direction, got the zero vector")
    return gtsam.Unit3(array)
