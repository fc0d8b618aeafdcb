"""The messages that one frame of a run makes, on LOAM's topics, for a bag or a live node.

| topic | type | when |
|---|---|---|
| ``/tf`` | ``tf2_msgs/TFMessage`` | every frame |
| ``/aft_mapped_to_init`` | ``nav_msgs/Odometry`` | every frame |
| ``/velodyne_cloud_registered`` | ``sensor_msgs/PointCloud2`` | every frame with a sweep |
| ``/laser_cloud_surround`` | ``sensor_msgs/PointCloud2`` | every fifth frame |
| ``/aft_mapped_path`` | ``nav_msgs/Path`` | whenever it has grown by a tenth |

Names, types and frames are those of LOAM (J. Zhang and S. Singh) and A-LOAM; the path is A-LOAM's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.config import BagConfig
from loam_gtsam.ros.messages import (
    CLOUD_TYPE,
    ODOMETRY_TYPE,
    PATH_TYPE,
    TF_TYPE,
    Messages,
    StampedPose,
)
from loam_gtsam.types import ConfigError, MapUpdate

TF = "/tf"
ODOMETRY = "/aft_mapped_to_init"
REGISTERED = "/velodyne_cloud_registered"
SURROUND = "/laser_cloud_surround"
PATH = "/aft_mapped_path"

TYPES = {
    TF: TF_TYPE,
    ODOMETRY: ODOMETRY_TYPE,
    REGISTERED: CLOUD_TYPE,
    SURROUND: CLOUD_TYPE,
    PATH: PATH_TYPE,
}
"""Topic -> type of its messages."""
_PATH_STEP = 10
"""Poses by which the path grows at least before it is written again; later a tenth of its length,
so that all of its messages together are eleven times the last one, not its square."""

Points = NDArray[np.floating]
"""(N, 4) metres in the map frame, and the intensity."""


class FrameMessages:
    """Serialised messages of one frame after the other.

    Parameters
    ----------
    config : names of the frames, and which clouds to make
    ros1 : serialise for ROS 1 instead of ROS 2

    Attributes
    ----------
    store : the types, as rosbags has them

    Raises
    ------
    ConfigError
        If the names of the frames are empty or equal.
    """

    def __init__(self, config: BagConfig, *, ros1: bool) -> None:
        if config.map_frame == config.lidar_frame or not (config.map_frame and config.lidar_frame):
            raise ConfigError(
                "bag.map_frame, bag.lidar_frame: expected two different names, got "
                f"{config.map_frame!r} and {config.lidar_frame!r}"
            )
        self._config = config
        self._messages = Messages(ros1, config.map_frame, config.lidar_frame)
        self.store = self._messages.store
        self._poses: list[StampedPose] = []
        self._path_length = 0

    def frame(
        self,
        update: MapUpdate,
        cloud: Callable[[], Points | None] | None = None,
        surround: Callable[[], Points] | None = None,
    ) -> Iterator[tuple[str, bytes]]:
        """Topic and message, the pose first; each is made when its turn comes.

        A frame with a bad stamp has none. One whose messages are not all asked for does not count.

        Parameters
        ----------
        update : of the frame
        cloud : gives the de-skewed points of the sweep, in the map frame
        surround : gives the map points around the sensor; called when they are due

        Raises
        ------
        OutputError
            If a message cannot say the stamp.
        InputError
            If a cloud is not (N, 4).
        """
        if not update.status.has_pose:
            return
        stamp, messages, config = update.stamp, self._messages, self._config
        yield TF, messages.transform(update)
        yield ODOMETRY, messages.odometry(update)
        points = cloud() if cloud is not None and config.registered else None
        if points is not None:
            yield REGISTERED, messages.cloud(stamp, points)
        every = config.surround_every
        if surround is not None and every and len(self._poses) % every == 0:
            yield SURROUND, messages.cloud(stamp, surround())
        self._poses.append((stamp, update.map_T_lidar))
        if len(self._poses) - self._path_length >= max(_PATH_STEP, self._path_length // 10):
            yield from self.path()

    def path(self) -> Iterator[tuple[str, bytes]]:
        """The whole path, if it has grown since it was made."""
        if len(self._poses) > self._path_length:
            self._path_length = len(self._poses)
            yield PATH, self._messages.path(self._poses)
