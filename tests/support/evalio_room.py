"""A data set of evalio: a simulated room, seen from an IMU that is turned and off to the side."""

from collections.abc import Iterator, Sequence
from enum import auto
from pathlib import Path

import numpy as np
from evalio.datasets import Dataset, DatasetIterator
from evalio.datasets.loaders import RawDataIter
from evalio.types import (
    SE3,
    SO3,
    Duration,
    ImuMeasurement,
    ImuParams,
    LidarMeasurement,
    LidarParams,
    Point,
    Stamp,
    Trajectory,
)
from support import layout_writers as write

WORLD = {"sensor": "vlp16", "columns": 720}
IMU_T_LIDAR = np.array(
    [[0.0, -1.0, 0.0, 0.3], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 1.0, 0.1], [0.0, 0.0, 0.0, 1.0]]
)


def as_se3(matrix: np.ndarray) -> SE3:
    return SE3(SO3.from_mat(matrix[:3, :3]), matrix[:3, 3])


def lidar() -> Iterator[LidarMeasurement]:
    for sweep in write.sweeps(**WORLD):
        assert sweep.times is not None
        assert sweep.rings is not None
        points = [
            Point(x=x, y=y, z=z, t=Duration.from_nsec(t), row=row)
            for (x, y, z), t, row in zip(
                sweep.points.tolist(),
                np.rint(sweep.times * 1e9).astype(int).tolist(),
                sweep.rings.tolist(),
                strict=True,
            )
        ]
        yield LidarMeasurement(Stamp.from_nsec(sweep.stamp), points)


def imu() -> Iterator[ImuMeasurement]:
    stamps, _, gyro, acceleration = write.imu_rows(IMU_T_LIDAR[:3, :3].T)
    for stamp, w, a in zip(stamps.tolist(), gyro, acceleration, strict=True):
        yield ImuMeasurement(Stamp.from_nsec(stamp), w, a)


class SimulatedRoom(Dataset):
    shaken = auto()

    def data_iter(self) -> DatasetIterator:
        return RawDataIter(lidar(), imu(), write.COUNT)

    def ground_truth_raw(self) -> Trajectory:
        truth = write.lidar_truth(**WORLD)
        return Trajectory(
            stamps=[Stamp.from_nsec(stamp) for stamp in truth.stamps.tolist()],
            poses=[as_se3(pose) for pose in truth.map_T_lidar],
        )

    def imu_T_lidar(self) -> SE3:
        return as_se3(IMU_T_LIDAR)

    def imu_T_gt(self) -> SE3:
        return as_se3(IMU_T_LIDAR)

    def imu_params(self) -> ImuParams:
        return ImuParams(gravity=np.array([0.0, 0.0, -9.7]), gyro=3e-4)

    def lidar_params(self) -> LidarParams:
        return LidarParams(num_rows=16, num_columns=720, min_range=0.7, max_range=90.0)

    def files(self) -> Sequence[str | Path]:
        return []

    def quick_len(self) -> int:
        return write.COUNT
