"""Trajectory errors, defined as evo and the KITTI benchmark define them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from loam_gtsam.types import FloatArray, InputError, IntArray, Trajectory


@dataclass(frozen=True, slots=True)
class AbsoluteError:
    """Absolute trajectory error (ATE).

    Attributes
    ----------
    rmse, median, maximum : metres, of the positions after alignment
    rotation_rmse_deg : degrees, of the orientations after alignment
    translations : (N,) metres per pose
    stamps : (N,) nanoseconds of the poses that were compared
    """

    rmse: float
    median: float
    maximum: float
    rotation_rmse_deg: float
    translations: FloatArray
    stamps: IntArray


def align(estimate: FloatArray, reference: FloatArray) -> FloatArray:
    """Rigid transform ``reference_T_estimate`` (4, 4) that best maps (N, 3) positions on others.

    References
    ----------
    Umeyama, Least-squares estimation of transformation parameters, PAMI 13(4), 1991; no scale.
    """
    mean_e, mean_r = estimate.mean(axis=0), reference.mean(axis=0)
    u, _, vt = np.linalg.svd((reference - mean_r).T @ (estimate - mean_e))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    result = np.eye(4)
    result[:3, :3] = u @ sign @ vt
    result[:3, 3] = mean_r - result[:3, :3] @ mean_e
    return result


def interpolate(trajectory: Trajectory, stamps: IntArray) -> Trajectory:
    """Poses at other times: linear in position, spherical linear in orientation.

    Raises
    ------
    InputError
        If a stamp lies outside the trajectory.
    """
    if len(stamps) and (
        stamps.min() < trajectory.stamps[0] or stamps.max() > trajectory.stamps[-1]
    ):
        raise InputError(
            f"interpolate: stamps {stamps.min()} to {stamps.max()} leave the trajectory "
            f"{trajectory.stamps[0]} to {trajectory.stamps[-1]}"
        )
    start = trajectory.stamps[0]
    times, queries = (trajectory.stamps - start) * 1e-9, (stamps - start) * 1e-9
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    rotations = Rotation.from_matrix(trajectory.map_T_lidar[:, :3, :3])
    poses[:, :3, :3] = Slerp(times, rotations)(queries).as_matrix()
    for axis in range(3):
        poses[:, axis, 3] = np.interp(queries, times, trajectory.map_T_lidar[:, axis, 3])
    return Trajectory(np.asarray(stamps, np.int64), poses)


def absolute_error(
    estimate: Trajectory, reference: Trajectory, *, aligned: bool = True
) -> AbsoluteError:
    """ATE over the poses whose stamps lie inside the reference, which is interpolated.

    Parameters
    ----------
    aligned : fit a rigid transform (SE(3), Umeyama) first; else compare as they are

    Raises
    ------
    InputError
        If fewer than three poses overlap in time.
    """
    inside = (estimate.stamps >= reference.stamps[0]) & (estimate.stamps <= reference.stamps[-1])
    if inside.sum() < 3:
        raise InputError(
            f"absolute_error: expected 3 or more poses inside the reference's time span "
            f"{reference.stamps[0]} to {reference.stamps[-1]} ns, got {int(inside.sum())}"
        )
    poses, stamps = estimate.map_T_lidar[inside], estimate.stamps[inside]
    truth = interpolate(reference, stamps).map_T_lidar
    if aligned:
        poses = align(poses[:, :3, 3], truth[:, :3, 3]) @ poses
    errors = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    difference = np.swapaxes(truth[:, :3, :3], 1, 2) @ poses[:, :3, :3]
    angles = np.degrees(Rotation.from_matrix(difference).magnitude())
    return AbsoluteError(
        rmse=_rms(errors),
        median=float(np.median(errors)),
        maximum=float(errors.max()),
        rotation_rmse_deg=_rms(angles),
        translations=errors,
        stamps=stamps,
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
