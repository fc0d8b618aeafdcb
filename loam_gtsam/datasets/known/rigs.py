"""Known rigs whose bags are told by their topics: NTU VIRAL, Hilti 2021, 2022 and 2023."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Unpack

import numpy as np

from loam_gtsam.datasets.bags import bag_reader
from loam_gtsam.datasets.bags.bag import BagSequence
from loam_gtsam.datasets.base import BagOptions
from loam_gtsam.datasets.decode import tables
from loam_gtsam.datasets.decode.extrinsics import Rig
from loam_gtsam.datasets.decode.tables import pose_matrix
from loam_gtsam.datasets.known.layouts import first_existing
from loam_gtsam.datasets.truth import read_truth
from loam_gtsam.geometry import inverse_pose, transform
from loam_gtsam.types import DatasetError, Trajectory

_HILTI_IMU_T_LIDAR = pose_matrix([-0.001, -0.00855, 0.055, 0.7071068, -0.7071068, 0.0, 0.0])
HILTI = Rig(
    kind="Hilti 2022 or 2023, hand-held",
    topic="/hesai/pandar",
    imu_topic="/alphasense/imu",
    body_T_lidar=_HILTI_IMU_T_LIDAR,
    lidar_T_imu=inverse_pose(_HILTI_IMU_T_LIDAR),
    source="the challenge's calibration, as evalio quotes it",
)
"""A Hesai XT32 and an Alphasense. Reference poses, ``BAG_imu.txt``, are those of the IMU."""
_IMU_T_OS_LIDAR = pose_matrix(
    [0.01001967, -0.00664547, 0.09473042, 0.99999392, 0.00122838, -0.00325965, -0.00016948]
)
_OS_LIDAR_T_OS_SENSOR = pose_matrix([0.0, 0.0, -0.036, 0.0, 0.0, 0.0, 1.0])
HILTI_2021 = Rig(
    kind="Hilti 2021, on a pole",
    topic="/os_cloud_node/points",
    imu_topic="/alphasense/imu",
    body_T_lidar=_IMU_T_OS_LIDAR @ _OS_LIDAR_T_OS_SENSOR,
    lidar_T_imu=inverse_pose(_IMU_T_OS_LIDAR @ _OS_LIDAR_T_OS_SENSOR),
    source="the challenge's calibration, as CT-ICP and FAST-LIO-MULTI quote it",
)
"""An OS0-64, whose points are in the frame of its case (``os_sensor``), and the IMU of an
Alphasense, z down. Reference poses, ``BAG_imu.txt``, are those of the IMU."""
NTU_VIRAL = Rig(
    kind="NTU VIRAL",
    topic="/os1_cloud_node1/points",
    imu_topic="/imu/imu",
    body_T_lidar=np.eye(4),
    lidar_T_imu=inverse_pose(pose_matrix([-0.05, 0.0, 0.055, 0.0, 0.0, 0.0, 1.0])),
    source="the data set's calibration, as FAST-LIVO quotes it",
)
"""The horizontal OS1-16 of a drone, and its VN100. Reference positions are those of a prism."""
_POINTS = {
    "pole": [-0.00938425, -0.0148401, 1.66722],
    "prism": [-0.00594496, -0.00721288, 0.272943],
}
"""Metres in the IMU's frame of Hilti 2021, as its ``evaluation.py`` has them: the tip of the pole
that carries the lidar, and a prism. ``BAG_pole.txt`` are a few places at which it stood still."""
_LEICA, _VIRAL_PRISM = "/leica/pose/relative", [-0.293656, -0.012288, -0.273095]
"""Topic of NTU VIRAL's reference positions, and metres of their prism in the IMU's frame
(``leica_prism.yaml``)."""

_RIGS = (HILTI, HILTI_2021, NTU_VIRAL)


def rig_of(topics: Collection[str]) -> Rig | None:
    """The rig whose topics, of sweeps and of the IMU, are both among these."""
    return next((rig for rig in _RIGS if {rig.topic, rig.imu_topic} <= {*topics}), None)


class RigBag(BagSequence):
    """A bag of a known rig, with the extrinsics of its IMU.

    Parameters
    ----------
    path : one bag. Reference poses are those of ``BAG_imu.txt`` beside it, as Hilti has them; or
        positions of a point: ``BAG_pole.txt`` or ``BAG_prism.txt``, and NTU VIRAL's prism
    options : see :class:`~loam_gtsam.datasets.base.BagOptions`

    Raises
    ------
    DatasetError
        If its topics are those of no known rig.
    """

    def __init__(self, path: str | Path, **options: Unpack[BagOptions]) -> None:
        bag = Path(path)
        with closing(bag_reader.open_bag(bag)) as reader:
            topics = sorted(reader.topics)
        rig = rig_of(topics)
        if rig is None:
            known = ", ".join(f"{r.topic} and {r.imu_topic}" for r in _RIGS)
            raise DatasetError(f"{bag}: no known rig: expected {known}; got {', '.join(topics)}")
        names = [f"{bag.stem}_imu.txt", f"exp_{bag.stem.removeprefix('exp')}_imu.txt"]
        names += [f"{bag.stem}_{point}.txt" for point in _POINTS] if rig is HILTI_2021 else []
        super().__init__(bag, [bag], rig, first_existing(bag.parent, names), **options)
        if rig is NTU_VIRAL and _LEICA in topics:
            self._truth_source = f"{_LEICA}, positions of a prism"

    @cached_property
    def truth(self) -> Trajectory | None:
        """The reference poses at the lidar, or the positions of a point beside it."""
        if self._rig is NTU_VIRAL:
            found = self._truth_source and read_truth(self._parts[0], topic=_LEICA)
            return self._positions(found, _VIRAL_PRISM) if found else None
        point = "" if self._truth_file is None else self._truth_file.stem.rpartition("_")[2]
        if self._truth_file is None or point not in _POINTS:
            return super().truth
        return self._positions(tables.read_poses(self._truth_file, self._problems), _POINTS[point])

    def _positions(self, found: Trajectory, point: list[float]) -> Trajectory:
        """Of a point in the IMU's frame; what stands for orientations is none."""
        poses = found.map_T_lidar.copy()
        poses[:, :3, :3] = np.nan
        beside = transform(self._rig.lidar_T_imu, np.array([point]))[0]
        return Trajectory(found.stamps, poses, beside)
