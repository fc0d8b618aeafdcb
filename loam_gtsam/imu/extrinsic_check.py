"""Check of the configured mounting of the IMU against the motion that the scans measured."""

from __future__ import annotations

import gtsam
import numpy as np

from loam_gtsam.geometry import as_array, as_points
from loam_gtsam.types import FloatArray

EXTRINSIC_LIMIT = np.deg2rad(5.0)
"""rad from which on a configured rotation is called wrong."""
EXTRINSIC_SIGMA = np.deg2rad(1.5)
"""rad, largest standard deviation of the better rotation about any axis for it to be believed."""
EXTRINSIC_FRAMES = 20
"""Pairs of frames below which nothing is said."""


def extrinsic_problem(by_scan: FloatArray, by_gyro: FloatArray, lidar_R_imu: gtsam.Rot3) -> str:
    """Say so if another ``lidar_R_imu_deg`` would fit the motion of the scans better.

    The rotations from frame to frame by the gyro and by the scans are the same vectors in two sets
    of axes; the rotation between the sets is found in closed form (Wahba's problem by SVD:
    Markley, J. Astronautical Sciences 36, 1988).

    Parameters
    ----------
    by_scan, by_gyro : (N, 3) rotation vectors from frame to frame, rad, lidar axes
    lidar_R_imu : the configured rotation

    Returns
    -------
    A sentence if the best rotation is more than :data:`EXTRINSIC_LIMIT` away and known to
    :data:`EXTRINSIC_SIGMA`, else "": then all is well or the motion was too poor to tell.

    Raises
    ------
    InputError
        If the shapes do not fit.
    """
    by_scan = as_points(by_scan, "by_scan")
    by_gyro = as_array(by_gyro, "by_gyro", by_scan.shape)
    if len(by_scan) < EXTRINSIC_FRAMES:
        return ""
    # How far, unlike about which axis, does not depend on the extrinsics: a pair that disagrees
    # in that is a lost track or a gyro fault, and would only mislead.
    unlike = np.abs(np.linalg.norm(by_scan, axis=1) - np.linalg.norm(by_gyro, axis=1))
    fair = unlike <= 3.0 * np.median(unlike) + 1e-9
    by_scan, by_gyro = by_scan[fair], by_gyro[fair]
    left, strength, right = np.linalg.svd(by_scan.T @ by_gyro)
    sign = float(np.sign(np.linalg.det(left) * np.linalg.det(right)))
    better = gtsam.Rot3(left @ np.diag([1.0, 1.0, sign]) @ right)
    away = float(np.linalg.norm(gtsam.Rot3.Logmap(better)))
    residuals = by_scan - by_gyro @ better.matrix().T
    variance = float((residuals**2).sum()) / (3 * len(residuals) - 3)
    # Information about the axis known least, unit weights. Products of the two, not squares of one:
    # noise, which is not the same in both, must not pass for motion.
    weakest = strength[1] + sign * strength[2]
    if away <= EXTRINSIC_LIMIT or variance > EXTRINSIC_SIGMA**2 * weakest:
        return ""
    angles = np.rad2deg(better.compose(lidar_R_imu).rpy()).round().astype(int)
    return (
        f"IMU: its rotations fit those of the scans better by {np.rad2deg(away):.0f} degrees with "
        f"imu.lidar_R_imu_deg = {angles.tolist()}; check how the IMU is mounted"
    )
