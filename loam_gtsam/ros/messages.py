"""ROS messages of LOAM's outputs, for ROS 1 and ROS 2, without ROS.

Axes are those of the map and of the lidar (x forward, y left, z up), as in A-LOAM.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from loam_gtsam.geometry import symmetric
from loam_gtsam.types import FloatArray, MapUpdate, OutputError, check_array

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
PATH_TYPE = "nav_msgs/msg/Path"
CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
TF_TYPE = "tf2_msgs/msg/TFMessage"

_NS = 10**9
_LAST_SECOND = 2**31
"""ROS 2 counts seconds in an int32; ROS 1, in a uint32, reaches twice as far."""
_FIELDS = ("x", "y", "z", "intensity")
_FLOAT32 = 7
"""sensor_msgs/PointField"""
_UNKNOWN = np.zeros(36)
_UNKNOWN[0] = -1.0
_UNKNOWN.flags.writeable = False

StampedPose = tuple[int, gtsam.Pose3]
"""Nanoseconds and ``map_T_lidar``."""


def ros_covariance(covariance: FloatArray, map_T_lidar: gtsam.Pose3) -> FloatArray:
    """The covariance of a pose as ``geometry_msgs/PoseWithCovariance`` has it.

    A right perturbation (w, v) of ``map_T_lidar = (R, t)`` moves the lidar by R v and turns it by
    R w about the fixed axes of the map, to first order: ``Exp`` of a rotation on the right is that
    of R w on the left. So with ``B = [[0, R], [R, 0]]`` the covariance is ``B C B^T``.

    Parameters
    ----------
    covariance : (6, 6), rotation first, body frame, as ``MapUpdate.covariance``

    Returns
    -------
    (36,) row by row: x, y, z (m), rotation about the map's X, Y, Z (rad). If it is not finite, it
    is unknown: -1, and zeros (as ``sensor_msgs/Imu`` has it; Odometry has no convention).
    """
    if not np.isfinite(covariance).all():
        return _UNKNOWN
    rotation = map_T_lidar.rotation().matrix()
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = rotation
    # to the last bit: consumers may check
    return symmetric(turn @ covariance @ turn.T).reshape(36)


class Messages:
    """Builds messages of one ROS version and serialises them.

    Parameters
    ----------
    ros1 : ROS 1 instead of ROS 2
    map_frame, lidar_frame : names of the frames
    """

    def __init__(self, ros1: bool, map_frame: str, lidar_frame: str) -> None:
        # All of these are the same from Humble to today.
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:  # not part of that store
            definition = "geometry_msgs/TransformStamped[] transforms\n"
            self.store.register(get_types_from_msg(definition, TF_TYPE))
        self._ros1, self._map, self._lidar = ros1, map_frame, lidar_frame

    def odometry(self, update: MapUpdate) -> bytes:
        """``nav_msgs/Odometry``: the pose, and the twist in the lidar's own axes."""
        pose, (turn, velocity) = update.map_T_lidar, np.split(update.twist, 2)
        message = self._make(
            ODOMETRY_TYPE,
            header=self._header(update.stamp),
            child_frame_id=self._lidar,
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self._pose(pose),
                covariance=ros_covariance(update.covariance, pose),
            ),
            twist=self._make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._make(
                    "geometry_msgs/msg/Twist",
                    linear=self._xyz("Vector3", velocity),
                    angular=self._xyz("Vector3", turn),
                ),
                covariance=_UNKNOWN,
            ),
        )
        return self._serialise(message, ODOMETRY_TYPE)

    def transform(self, update: MapUpdate) -> bytes:
        """``tf2_msgs/TFMessage`` with the one transform from the lidar's frame to the map's."""
        pose = update.map_T_lidar
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(update.stamp),
            child_frame_id=self._lidar,
            transform=self._make(
                "geometry_msgs/msg/Transform",
                translation=self._xyz("Vector3", pose.translation()),
                rotation=self._quaternion(pose),
            ),
        )
        return self._serialise(self._make(TF_TYPE, transforms=[stamped]), TF_TYPE)

    def path(self, poses: Sequence[StampedPose]) -> bytes:
        """``nav_msgs/Path`` of one pose at least; its own stamp is that of the last."""
        stamped = [
            self._make(
                "geometry_msgs/msg/PoseStamped", header=self._header(stamp), pose=self._pose(pose)
            )
            for stamp, pose in poses
        ]
        header = self._header(poses[-1][0])
        return self._serialise(self._make(PATH_TYPE, header=header, poses=stamped), PATH_TYPE)

    def cloud(self, stamp: int, points_map: NDArray[np.floating]) -> bytes:
        """``sensor_msgs/PointCloud2`` with float32 fields x, y, z, intensity.

        Parameters
        ----------
        stamp : nanoseconds
        points_map : (N, 4): metres in the map frame, and the intensity

        Raises
        ------
        InputError
            If the shape is wrong.
        """
        check_array(points_map, "points_map", ("N", len(_FIELDS)))
        rows = np.ascontiguousarray(points_map, dtype="<f4")
        step = rows.itemsize * len(_FIELDS)
        fields = [
            self._make(
                "sensor_msgs/msg/PointField",
                name=name, offset=number * rows.itemsize, datatype=_FLOAT32, count=1,
            )
            for number, name in enumerate(_FIELDS)
        ]  # fmt: skip
        message = self._make(
            CLOUD_TYPE,
            header=self._header(stamp),
            height=1,
            width=len(rows),
            fields=fields,
            is_bigendian=False,
            point_step=step,
            row_step=step * len(rows),
            data=rows.view(np.uint8).reshape(-1),
            is_dense=bool(np.isfinite(rows).all()),
        )
        return self._serialise(message, CLOUD_TYPE)

    def _make(self, name: str, /, **values: Any) -> Any:
        return self.store.types[name](**values)

    def _serialise(self, message: Any, name: str) -> bytes:
        serialise = self.store.serialize_ros1 if self._ros1 else self.store.serialize_cdr
        return bytes(serialise(message, name))

    def _header(self, stamp: int) -> Any:
        seconds, rest = divmod(int(stamp), _NS)
        if not 0 <= seconds < _LAST_SECOND:
            raise OutputError(
                f"stamp {stamp} ns: a ROS message takes 0 to {_LAST_SECOND} s; run without a bag, "
                "or shift the stamps of the data set"
            )
        time = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        # ROS 1 publishers count in seq; in a bag nothing depends on it.
        counter = {"seq": 0} if self._ros1 else {}
        return self._make("std_msgs/msg/Header", **counter, stamp=time, frame_id=self._map)

    def _pose(self, pose: gtsam.Pose3) -> Any:
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._xyz("Point", pose.translation()),
            orientation=self._quaternion(pose),
        )

    def _xyz(self, name: str, values: NDArray[np.floating]) -> Any:
        x, y, z = values.tolist()
        return self._make(f"geometry_msgs/msg/{name}", x=x, y=y, z=z)

    def _quaternion(self, pose: gtsam.Pose3) -> Any:
        q: Any = pose.rotation().toQuaternion()
        return self._make("geometry_msgs/msg/Quaternion", x=q.x(), y=q.y(), z=q.z(), w=q.w())
