"""Roll and pitch of an IMU as information on the pose: LOAM's blend, and factors in its place.

Angles are those of ``level_R_lidar = Rz(yaw) Ry(pitch) Rx(roll)``, where ``level`` is any frame
whose z axis points up. The map is such a frame once it is levelled; otherwise
:class:`~loam_gtsam.imu.level.Level` holds the rotation between the two. The mathematics is in
docs/maths/imu_prior.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from loam_gtsam.factors import checked_factor
from loam_gtsam.types import FloatArray

STEEPEST_PITCH = np.radians(85.0)
"""Beyond this pitch roll and yaw are one angle, and the modes that use roll and pitch step aside
for the gravity direction."""

_FLOOR = 1e-12
"""Share of the largest eigenvalue that stands for no information at all."""
_ROUNDS = 20
"""Largest number of rounds that correct the target: 3 do for a pull of 1 mrad, 6 for 0.5 rad."""
_EXACT = 1e-12
"""rad by which the corrected mean may miss that of the blend."""


def roll_pitch(rotation: gtsam.Rot3) -> FloatArray:
    """(2,) rad."""
    return np.array(rotation.rpy()[:2], dtype=np.float64)


def roll_pitch_jacobian(rotation: gtsam.Rot3) -> FloatArray:
    """(2, 6) derivative of roll and pitch by the pose's tangent vector; singular at 90 degrees."""
    roll, pitch = roll_pitch(rotation)
    sine, cosine = np.sin(roll), np.cos(roll)
    jacobian = np.zeros((2, 6))
    jacobian[0, :3] = 1.0, sine * np.tan(pitch), cosine * np.tan(pitch)
    jacobian[1, :3] = 0.0, cosine, -sine
    return jacobian


def too_steep(*rotations: gtsam.Rot3) -> bool:
    """Whether any of the rotations is too near to a pitch of 90 degrees for roll and pitch."""
    return any(abs(rotation.pitch()) > STEEPEST_PITCH for rotation in rotations)


def blend(
    map_T_lidar: gtsam.Pose3, measured: gtsam.Rot3, weight: float, level_R_map: gtsam.Rot3
) -> gtsam.Pose3:
    """LOAM's blend: roll and pitch move by ``weight`` towards the IMU's; yaw and position stay.

    Parameters
    ----------
    map_T_lidar : solved pose
    measured : ``world_R_lidar`` of the IMU, z up; its yaw is not used
    weight : share of the IMU, 0.002 in LOAM
    level_R_map : see :class:`~loam_gtsam.imu.level.Level`

    Notes
    -----
    laserMapping, ``transformUpdate``: ``roll = 0.998 roll + 0.002 imuRoll``. Here the IMU's angles
    are first taken to the turn nearest to the pose's, so that nothing jumps at 180 degrees.
    """
    level_R_lidar = level_R_map.compose(map_T_lidar.rotation())
    target = blended_angles(level_R_lidar, measured, weight)
    blended = gtsam.Rot3.RzRyRx(target[0], target[1], level_R_lidar.yaw())
    return gtsam.Pose3(level_R_map.inverse().compose(blended), map_T_lidar.translation())


def blend_direction(
    map_T_lidar: gtsam.Pose3, measured: gtsam.Rot3, weight: float, map_up: FloatArray
) -> gtsam.Pose3:
    """The blend without angles: up turns by ``weight`` of the way to the IMU's; fit for any tilt.

    Parameters are those of :func:`blend`; ``map_up`` is :attr:`~loam_gtsam.imu.level.Level.map_up`.
    """
    lidar = map_T_lidar.rotation().matrix().T @ map_up
    imu = np.array(measured.matrix()[2])
    axis = np.cross(lidar, imu)
    sine, cosine = float(np.linalg.norm(axis)), float(lidar @ imu)
    if sine < np.finfo(np.float64).eps:
        return map_T_lidar
    turn = gtsam.Rot3.Expmap(-weight * np.arctan2(sine, cosine) * axis / sine)
    return gtsam.Pose3(map_T_lidar.rotation().compose(turn), map_T_lidar.translation())


def blended_angles(level_R_lidar: gtsam.Rot3, measured: gtsam.Rot3, weight: float) -> FloatArray:
    """(2,) roll and pitch, ``(1 - weight)`` of the first and ``weight`` of the second."""
    lidar, imu = roll_pitch(level_R_lidar), roll_pitch(measured)
    imu += 2.0 * np.pi * np.round((lidar - imu) / (2.0 * np.pi))
    angles: FloatArray = (1.0 - weight) * lidar + weight * imu
    return angles


def tilt_information(information: FloatArray, rotation: gtsam.Rot3) -> FloatArray:
    """(2, 2) marginal information of roll and pitch: ``(J L^-1 J^T)^-1``.

    Directions that L (6, 6) does not know at all count as free, so that what depends on them
    comes out as (almost) unknown instead of as an error.
    """
    covariance = _tilt_covariance(information, roll_pitch_jacobian(rotation))[1]
    return np.asarray(np.linalg.inv(covariance), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class RollPitchPrior:
    """A Gaussian on roll and pitch: (2,) rad, and its (2, 2) information."""

    roll_pitch: FloatArray
    information: FloatArray


def equivalent_prior(
    level_R_lidar: gtsam.Rot3, information: FloatArray, measured: gtsam.Rot3, weight: float
) -> RollPitchPrior:
    """The prior that moves a scan's solution to the mean that LOAM's blend has.

    Its information is ``w / (1 - w)`` times what the scan knows about roll and pitch, its target
    the IMU's angles. Roll and pitch are not linear in the pose, which would leave an error of the
    order of the pull squared; the target is moved by as much, so that the mean is that of the
    blend exactly, and yaw and position go where the scan's own correlations take them. Where the
    way there leads past a pitch of 85 degrees or finds no end (a pull of 2 rad), the target stays
    at the IMU's angles.

    Parameters
    ----------
    level_R_lidar : the scan's solution
    information : (6, 6) of the scan there, tangent order of the package
    measured, weight : as in :func:`blend`; the weight is below 1
    """
    goal = blended_angles(level_R_lidar, measured, weight)
    moved = np.zeros(3)
    for _ in range(_ROUNDS):
        rotation = level_R_lidar.compose(gtsam.Rot3.Expmap(moved))
        if too_steep(rotation):
            break
        jacobian = roll_pitch_jacobian(rotation)
        # By the tangent vector at the solution, where the scan's information belongs.
        jacobian[:, :3] = jacobian[:, :3] @ gtsam.Rot3.ExpmapDerivative(moved)
        gain, covariance = _tilt_covariance(information, jacobian)
        missing = _wrapped(goal - roll_pitch(rotation))
        knows = np.asarray(np.linalg.inv(covariance), np.float64)
        # The force on roll and pitch that takes the scan's solution there.
        force = knows @ (missing + jacobian[:, :3] @ moved)
        if np.abs(missing).max() < _EXACT:
            if weight > 0.0:
                goal = goal + (1.0 - weight) / weight * covariance @ force
            return RollPitchPrior(goal, weight / (1.0 - weight) * knows)
        moved = (gain @ force)[:3]
    knows = tilt_information(information, level_R_lidar)
    return RollPitchPrior(roll_pitch(measured), weight / (1.0 - weight) * knows)


def roll_pitch_factor(
    key: int, prior: RollPitchPrior, level_R_map: gtsam.Rot3
) -> gtsam.CustomFactor:
    """A prior on roll and pitch as a factor on the pose ``key``, a Pose3 ``map_T_lidar``.

    The information of the prior is positive definite; ``level_R_map`` is as in :func:`blend`.
    """

    def residual(values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        level_R_lidar = level_R_map.compose(values.atPose3(key).rotation())
        away = _wrapped(roll_pitch(level_R_lidar) - prior.roll_pitch)
        return away, [roll_pitch_jacobian(level_R_lidar)]

    return checked_factor(gtsam.noiseModel.Gaussian.Information(prior.information), [key], residual)


def gravity_factor(
    key: int, measured: gtsam.Rot3, sigma: float, map_up: FloatArray
) -> gtsam.AttitudeFactorPose3:
    """The IMU's gravity direction as a factor on the pose ``key``; free of yaw, fit for any tilt.

    ``sigma`` is the standard deviation of the direction, rad; the rest as in
    :func:`blend_direction`.
    """
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
    lidar_up = gtsam.Unit3(np.array(measured.matrix()[2]))
    return gtsam.AttitudeFactorPose3(key, gtsam.Unit3(map_up), noise, lidar_up)


def _wrapped(angles: FloatArray) -> FloatArray:
    """The same angles between -pi and pi."""
    wrapped: FloatArray = angles - 2.0 * np.pi * np.round(angles / (2.0 * np.pi))
    return wrapped


def _tilt_covariance(
    information: FloatArray, jacobian: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``L^-1 J^T`` (6, 2) and ``J L^-1 J^T`` (2, 2), finite also if L is singular."""
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, max(_FLOOR * values[-1], np.finfo(np.float64).tiny))
    gain: FloatArray = vectors @ ((vectors.T @ jacobian.T) / values[:, None])
    return gain, jacobian @ gain
