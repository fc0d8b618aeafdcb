"""The Oxford Spires data set: a Hesai QT64 on a backpack."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np

from loam_gtsam.datasets.bags.bag import BagSequence
from loam_gtsam.datasets.base import BagOptions
from loam_gtsam.datasets.decode.extrinsics import Rig
from loam_gtsam.datasets.decode.packed_points import read_pcd
from loam_gtsam.datasets.decode.tables import clean_imu, pose_matrix, read_table
from loam_gtsam.datasets.known import layouts
from loam_gtsam.datasets.known.stamped_files import StampedFiles
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.types import DatasetError, ImuSamples

_CAMERA_T_LIDAR = pose_matrix(
    [
        *(0.00035060884033447846, -0.079574053851818, -0.053826061545697405),
        *(0.5034725628949727, 0.5003337192107279, -0.4947539264483171, 0.5013981452864594),
    ]
)
_CAMERA_T_IMU = pose_matrix(
    [
        *(-0.0008544600980918986, 0.005115741648037186, -0.06898747851173177),
        *(0.0042909719518877815, -0.7085293318962699, 0.705668106144218, 0.0005453193252705428),
    ]
)
RIG = Rig(
    kind="Oxford Spires",
    topic="/hesai/pandar",
    imu_topic="/alphasense_driver_ros/imu",
    body_T_lidar=pose_matrix([0.0, 0.0, 0.124, 0.0, 0.0, 1.0, 0.0]),
    lidar_T_imu=inverse_pose(_CAMERA_T_LIDAR) @ _CAMERA_T_IMU,
    source="sensor.yaml of the data set's tools",
)
"""``T_base_lidar``, and ``T_cam_lidar`` and ``T_cam_imu`` of the front camera, in
``configs/sensor.yaml`` of https://github.com/ori-drs/oxford_spires_dataset. Earlier
calibrations there differ by half a degree and 2 cm."""


class OxfordSpiresBags(BagSequence):
    """A sequence as ROS 1 or ROS 2 bags.

    Parameters
    ----------
    path : holds ``gt-tum.txt`` or ``processed/trajectory/gt-tum.txt``, and the bags in itself, in
        ``raw/rosbag/`` or in ``raw/ros2bag/``, which are read one after the other
    options : see :class:`~loam_gtsam.datasets.base.BagOptions`

    References
    ----------
    Tao et al., The Oxford Spires dataset, IJRR 2025,
    https://dynamic.robots.ox.ac.uk/datasets/oxford-spires.
    """

    def __init__(self, path: str | Path, **options: Unpack[BagOptions]) -> None:
        root = Path(path)
        if not (parts := layouts.spires_bags(root)):
            raise DatasetError(f"{root}: no bags of an Oxford Spires sequence")
        super().__init__(root, parts, RIG, layouts.spires_truth(root), **options)


class OxfordSpiresClouds(StampedFiles):
    """A sequence as PCD files.

    Parameters
    ----------
    path : holds ``raw/lidar-clouds/SECONDS.NANOSECONDS.pcd`` and, where present, ``raw/imu.csv``
        and ``processed/trajectory/gt-tum.txt``
    time_unit, stamp_is : as for :class:`~loam_gtsam.datasets.BagDataset`
    """

    def __init__(
        self, path: str | Path, *, time_unit: str | None = None, stamp_is: str | None = None
    ) -> None:
        root = Path(path)
        super().__init__(
            root,
            replace(RIG, kind=f"{RIG.kind}, PCD files"),
            root / layouts.SPIRES_CLOUDS,
            "*.pcd",
            read_pcd,
            name="SECONDS.NANOSECONDS",
            imu=layouts.first_existing(root, ["raw/imu.csv"]),
            truth=layouts.spires_truth(root),
            time_unit=time_unit,
            stamp_is=stamp_is,
        )

    def _read_imu(self, path: Path) -> ImuSamples | None:
        columns = "secs nsecs acc_x acc_y acc_z ang_vel_x ang_vel_y ang_vel_z"
        stamps, values = read_table(path, columns, ",")
        samples = np.hstack([np.zeros((len(values), 4)), values[:, 3:], values[:, :3]])
        return clean_imu(stamps, samples, self._problems)
