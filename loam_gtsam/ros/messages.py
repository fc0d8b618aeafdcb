"""The ROS messages of a run, frame by frame, for a bag or a live node. ROS itself is not needed.

Names, types and frames are those of LOAM (J. Zhang and S. Singh) and A-LOAM; the path is A-LOAM's.
Axes are those of the map and of the lidar (x forward, y left, z up), as in A-LOAM.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from loam_gtsam.config import BagConfig
from loam_gtsam.geometry import symmetric
from loam_gtsam.types import ConfigError, FloatArray, MapUpdate, OutputError, check_array

TF = "/tf"
ODOMETRY = "/aft_mapped_to_init"
REGISTERED = "/velodyne_cloud_registered"
SURROUND = "/laser_cloud_surround"
PATH = "/aft_mapped_path"
IN_MAP = "/pose_in_map"
TYPES = {
    TF: "tf2_msgs/msg/TFMessage",
    ODOMETRY: "nav_msgs/msg/Odometry",
    REGISTERED: "sensor_msgs/msg/PointCloud2",
    SURROUND: "sensor_msgs/msg/PointCloud2",
    PATH: "nav_msgs/msg/Path",
}
"""Topic -> type of its messages; docs/bags_out.md says when each is due."""

IN_MAP_TYPES = {IN_MAP: "geometry_msgs/msg/PoseWithCovarianceStamped"}
"""The same of a node that localises in a saved map."""
INITIAL_POSE = "/initialpose"
"""Where a user says that the lidar is in that map, as RViz does; of the same type."""

_PATH_STEP = 10
"""Poses by which the path grows at least before it is written again; later a tenth of its length,
so that all path messages together are eleven times the last one, not its square."""
_LAST_SECOND = 2**31
"""ROS 2 counts seconds in an int32; ROS 1, in a uint32, reaches twice as far."""
_FIELDS = ("x", "y", "z", "intensity")
_FLOAT32 = 7  # of sensor_msgs/PointField
_UNKNOWN = np.zeros(36)
_UNKNOWN[0] = -1.0
_UNKNOWN.flags.writeable = False

Points = NDArray[np.floating]
"""(N, 4) metres in the map frame, and the intensity."""


def ros_covariance(covariance: FloatArray, map_T_lidar: gtsam.Pose3) -> FloatArray:
    """The covariance of a pose as ``geometry_msgs/PoseWithCovariance`` has it.

    A right perturbation (w, v) of ``map_T_lidar = (R, t)`` moves the lidar by R v and turns it by
    R w about the fixed axes of the map, to first order: ``Exp`` of a rotation on the right is that
    of R w on the left. So with ``B = [[0, R], [R, 0]]`` the covariance is ``B C B^T``.

    ``covariance`` is (6, 6), rotation first, body frame, as ``MapUpdate.covariance``. Returns (36,)
    row by row: x, y, z (m), rotation about the map's X, Y, Z (rad). If it is not finite, it is
    unknown: -1, and zeros (as ``sensor_msgs/Imu`` has it; Odometry has no convention).
    """
    if not np.isfinite(covariance).all():
        return _UNKNOWN
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = map_T_lidar.rotation().matrix()
    # Symmetric to the last bit: whoever reads the message may check.
    return symmetric(turn @ covariance @ turn.T).reshape(36)


class FrameMessages:
    """Serialised messages of one frame after the other.

    The poses of all frames are kept, for the path: 14 MB in an hour at 10 Hz. ``ros1`` serialises
    for ROS 1 bags instead of ROS 2. With the name of an ``odom_frame`` the frames are those of
    REP-105: all is in that frame, which is continuous, and ``/tf`` has the transform from the map
    to it as well. Raises ConfigError if the names of the frames are empty or equal.
    """

    def __init__(self, config: BagConfig, *, ros1: bool = False, odom_frame: str = "") -> None:
        if config.map_frame == config.lidar_frame or not (config.map_frame and config.lidar_frame):
            raise ConfigError(
                "bag.map_frame, bag.lidar_frame: expected two different names, got "
                f"{config.map_frame!r} and {config.lidar_frame!r}"
            )
        if odom_frame in (config.map_frame, config.lidar_frame):
            raise ConfigError(
                f"odom_frame: expected another name than those of map and lidar, got {odom_frame!r}"
            )
        self._odom = odom_frame
        # The types, as rosbags has them; all of these are the same from Humble to today.
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:  # not part of that store
            definition = "geometry_msgs/TransformStamped[] transforms\n"
            self.store.register(get_types_from_msg(definition, TYPES[TF]))
        self._config, self._ros1 = config, ros1
        self._poses: list[tuple[int, gtsam.Pose3]] = []
        self._path_length = 0

    def frame(
        self,
        update: MapUpdate,
        cloud: Callable[[], Points | None] | None = None,
        surround: Callable[[], Points] | None = None,
        map_T_odom: gtsam.Pose3 | None = None,
    ) -> Iterator[tuple[str, bytes]]:
        """Topic and message, the pose first; each is made when its turn comes.

        A frame with a bad stamp has none. One whose messages are not all asked for does not count.
        ``cloud`` and ``surround`` give the points that ``BagWriter.write`` takes; each is called
        when its message is due. ``map_T_odom`` is where an odometry frame is in the map; None is
        unknown, and not published. Raises OutputError if a message cannot say the stamp; InputError
        if a cloud is not (N, 4).
        """
        if not update.status.has_pose:
            return
        config = self._config
        yield TF, self._transforms(update, map_T_odom)
        yield ODOMETRY, self._odometry(update)
        points = cloud() if cloud is not None and config.registered else None
        if points is not None:
            yield REGISTERED, self._cloud(update.stamp, points)
        every = config.surround_every
        if surround is not None and every and len(self._poses) % every == 0:
            yield SURROUND, self._cloud(update.stamp, surround())
        self._poses.append((update.stamp, update.map_T_lidar))
        if len(self._poses) - self._path_length >= max(_PATH_STEP, self._path_length // 10):
            yield from self.path()

    def path(self) -> Iterator[tuple[str, bytes]]:
        """The whole path, if it has grown since it was last made."""
        if len(self._poses) > self._path_length:
            self._path_length = len(self._poses)
            yield PATH, self._path()

    def in_map(self, update: MapUpdate) -> Iterator[tuple[str, bytes]]:
        """A pose in a saved map with its covariance there, if it was found."""
        if update.status.solved:
            pose = self._pose(update.map_T_lidar)
            covariance = ros_covariance(update.covariance, update.map_T_lidar)
            yield (
                IN_MAP,
                self._serialised(
                    IN_MAP,
                    header=self._header(update.stamp, self._config.map_frame),
                    pose=self._geometry("PoseWithCovariance", pose=pose, covariance=covariance),
                ),
            )

    def _odometry(self, update: MapUpdate) -> bytes:
        pose, (turn, velocity) = update.map_T_lidar, np.split(update.twist, 2)
        linear, angular = self._xyz("Vector3", velocity), self._xyz("Vector3", turn)
        twist = self._geometry("Twist", linear=linear, angular=angular)
        covariance = ros_covariance(update.covariance, pose)
        return self._serialised(
            ODOMETRY,
            header=self._header(update.stamp),
            child_frame_id=self._config.lidar_frame,
            pose=self._geometry("PoseWithCovariance", pose=self._pose(pose), covariance=covariance),
            twist=self._geometry("TwistWithCovariance", twist=twist, covariance=_UNKNOWN),
        )

    def _transforms(self, update: MapUpdate, map_T_odom: gtsam.Pose3 | None) -> bytes:
        made = [self._transform(update.map_T_lidar, update.stamp, self._config.lidar_frame)]
        if self._odom and map_T_odom is not None:
            made.append(
                self._transform(map_T_odom, update.stamp, self._odom, self._config.map_frame)
            )
        return self._serialised(TF, transforms=made)

    def _transform(self, pose: gtsam.Pose3, stamp: int, child: str, parent: str = "") -> Any:
        position, turn = self._xyz("Vector3", pose.translation()), self._quaternion(pose)
        return self._geometry(
            "TransformStamped",
            header=self._header(stamp, parent),
            child_frame_id=child,
            transform=self._geometry("Transform", translation=position, rotation=turn),
        )

    def _path(self) -> bytes:
        poses = [
            self._geometry("PoseStamped", header=self._header(stamp), pose=self._pose(pose))
            for stamp, pose in self._poses
        ]
        return self._serialised(PATH, header=poses[-1].header, poses=poses)

    def _cloud(self, stamp: int, points_map: Points) -> bytes:
        check_array(points_map, "points_map", ("N", len(_FIELDS)))
        rows = np.ascontiguousarray(points_map, dtype="<f4")
        step = rows.itemsize * len(_FIELDS)
        field = partial(self._make, "sensor_msgs/msg/PointField", datatype=_FLOAT32, count=1)
        return self._serialised(
            REGISTERED,
            header=self._header(stamp),
            height=1,
            width=len(rows),
            fields=[field(name=n, offset=i * rows.itemsize) for i, n in enumerate(_FIELDS)],
            is_bigendian=False,
            point_step=step,
            row_step=step * len(rows),
            data=rows.view(np.uint8).reshape(-1),
            is_dense=bool(np.isfinite(rows).all()),
        )

    def _make(self, name: str, /, **values: Any) -> Any:
        return self.store.types[name](**values)

    def _geometry(self, name: str, /, **values: Any) -> Any:
        return self._make(f"geometry_msgs/msg/{name}", **values)

    def _serialised(self, topic: str, **values: Any) -> bytes:
        name = (TYPES | IN_MAP_TYPES)[topic]
        serialise = self.store.serialize_ros1 if self._ros1 else self.store.serialize_cdr
        return bytes(serialise(self._make(name, **values), name))

    def _header(self, stamp: int, frame: str = "") -> Any:
        seconds, rest = divmod(int(stamp), 10**9)
        if not 0 <= seconds < _LAST_SECOND:
            raise OutputError(
                f"stamp {stamp} ns: a ROS message takes 0 to {_LAST_SECOND} s; run without a bag, "
                "or shift the stamps of the data set"
            )
        time = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        # ROS 1 publishers count in seq; in a bag nothing depends on it.
        counter = {"seq": 0} if self._ros1 else {}
        frame = frame or self._odom or self._config.map_frame
        values = {"stamp": time, "frame_id": frame}
        return self._make("std_msgs/msg/Header", **counter, **values)

    def _pose(self, pose: gtsam.Pose3) -> Any:
        position, turn = self._xyz("Point", pose.translation()), self._quaternion(pose)
        return self._geometry("Pose", position=position, orientation=turn)

    def _xyz(self, name: str, values: NDArray[np.floating]) -> Any:
        x, y, z = values.tolist()
        return self._geometry(name, x=x, y=y, z=z)

    def _quaternion(self, pose: gtsam.Pose3) -> Any:
        q: Any = pose.rotation().toQuaternion()
        return self._geometry("Quaternion", x=q.x(), y=q.y(), z=q.z(), w=q.w())
