"""Extrinsics: where the sensors of a data set sit relative to each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.geometry import as_array, inverse_pose, is_rigid
from loam_gtsam.types import FloatArray, InputError, Trajectory


@dataclass(frozen=True, eq=False)
class Rig:
    """Sensors of a known data set: extrinsics, and topics in its bags.

    Attributes
    ----------
    kind : name of the data set
    source : where the extrinsics are from, as text
    body_T_lidar : pose of the lidar in the frame of the reference poses
    topic, imu_topic : of the sweeps and of the IMU in its bags
    """

    kind: str
    lidar_T_imu: FloatArray
    source: str
    body_T_lidar: FloatArray
    topic: str = ""
    imu_topic: str = ""


def rigid_transform(rotation: Rotation, translation: Sequence[float] | FloatArray) -> FloatArray:
    """(4, 4) transform of a rotation and a translation in metres."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix()
    matrix[:3, 3] = translation
    return matrix


def moved_to_lidar(truth: Trajectory, body_T_lidar: FloatArray) -> Trajectory:
    """Poses of the lidar, from those of another frame of the same body.

    Positions alone stay where they are, and are told to be of the origin of that frame. InputError
    if the matrix is no rigid transform.
    """
    body_T_lidar = as_array(body_T_lidar, "body_T_lidar", (4, 4))
    if not is_rigid(body_T_lidar):
        shown = " ".join(np.array2string(body_T_lidar, precision=3).split())
        raise InputError(
            "body_T_lidar: expected a rigid transform, a rotation matrix and metres above 0 0 0 1, "
            f"got {shown}"
        )
    if np.isfinite(truth.map_T_lidar).all():
        return Trajectory(truth.stamps, truth.map_T_lidar @ body_T_lidar)
    return Trajectory(truth.stamps, truth.map_T_lidar, inverse_pose(body_T_lidar)[:3, 3])


def extrinsic_settings(lidar_T_imu: FloatArray) -> Mapping[str, Any]:
    """The extrinsics as entries of :attr:`loam_gtsam.Dataset.sensor`."""
    angles = Rotation.from_matrix(lidar_T_imu[:3, :3]).as_euler("xyz", degrees=True)
    return {
        "imu.lidar_R_imu_deg": tuple(round(float(angle), 6) for angle in angles),
        "imu.lidar_t_imu": tuple(round(float(value), 6) for value in lidar_T_imu[:3, 3]),
    }


def describe_extrinsics(sensor: Mapping[str, Any], source: str) -> str:
    """Angles and position of the extrinsics as text, with their source."""
    roll, pitch, yaw = sensor["imu.lidar_R_imu_deg"]
    x, y, z = sensor["imu.lidar_t_imu"]
    angles, position = f"{roll:.2f}, {pitch:.2f}, {yaw:.2f}", f"{x:.3f}, {y:.3f}, {z:.3f}"
    return f"roll, pitch, yaw {angles} degrees, position {position} m ({source})"
