"""One decoder for every ``sensor_msgs/Imu``."""

from __future__ import annotations

from typing import Any

from loam_gtsam.datasets.decode.pointcloud2 import message_stamp
from loam_gtsam.types import DatasetError


def decode_imu(msg: Any) -> tuple[int, tuple[float, ...]]:
    """Stamp and numbers of one Imu message, as rosbags, rclpy or rospy hand it out.

    The numbers are (10,) quaternion x y z w (zero if the message says that there is none), rad/s,
    m/s^2.
    """
    stamp = message_stamp(msg)
    try:
        q, w, a = msg.orientation, msg.angular_velocity, msg.linear_acceleration
        # sensor_msgs/Imu: a first covariance element of -1 says there is no orientation
        unknown = msg.orientation_covariance[0] == -1.0
        orientation = (0.0, 0.0, 0.0, 0.0) if unknown else (q.x, q.y, q.z, q.w)
        values = tuple(map(float, (*orientation, w.x, w.y, w.z, a.x, a.y, a.z)))
    except (AttributeError, IndexError, TypeError, ValueError) as error:
        raise DatasetError(f"expected an Imu message, got {type(msg).__name__}: {error}") from error
    return stamp, values
