"""MulRan: an Ouster OS1-64 on a car, one file of points per sweep."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.decode.extrinsics import (
    extrinsic_settings,
    moved_to_lidar,
    rigid_transform,
)
from loam_gtsam.datasets.decode.packed_points import firing_by_firing, read_records
from loam_gtsam.datasets.decode.point_times import check_time_options
from loam_gtsam.datasets.decode.pointcloud2 import decode_pointcloud2
from loam_gtsam.datasets.decode.tables import read_table, sorted_trajectory
from loam_gtsam.datasets.known.layouts import MULRAN_FOLDERS, first_existing
from loam_gtsam.datasets.known.stamped_files import StampedFiles, missing_files
from loam_gtsam.datasets.known.xsens import read_xsens
from loam_gtsam.types import DatasetError, ImuSamples, Scan, Trajectory

BEAMS, COLUMNS = 64, 1024
"""Points of a sweep come firing by firing, 64 each (the data set's file player numbers the rings
so)."""
PERIOD = 0.1
"""Seconds of a turn at 10 Hz."""
BASE_T_LIDAR = rigid_transform(
    Rotation.from_euler("xyz", [0.0001, 0.0003, 179.6654], degrees=True), [1.7042, -0.021, 1.8047]
)
"""``calib_base2ouster.txt`` of the data set, as KISS-ICP, MOLA and mulran2bag quote it."""
LIDAR_T_IMU = rigid_transform(Rotation.from_euler("z", 180.0, degrees=True), [1.77, 0.0, -0.05])
"""``params_mulran.yaml`` of SC-LIO-SAM, by an author of the data set, which itself states none."""

_RECORD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
_MOMENTS = {"start": 0.0, "middle": 0.5, "end": 1.0}


class MulRanDataset(StampedFiles):
    """A sequence of MulRan.

    Parameters
    ----------
    path : holds ``Ouster/*.bin`` (float32 ``x y z intensity``, named by nanoseconds) and, where
        present, ``global_pose.csv``, ``xsens_imu.csv`` and ``data_stamp.csv``, all in it or, but
        for the poses, in ``sensor_data/``
    stamp_is : the moment of the sweep its stamp is: ``start``, ``middle`` or ``end``

    Notes
    -----
    The files hold neither times nor rings; both follow from the order of the points, which a sweep
    of another size than 64 x 1024 cannot have: it becomes a
    :class:`~loam_gtsam.types.BadSweep`.

    Raises
    ------
    DatasetError
        If there are no sweeps, or a table cannot be understood.

    References
    ----------
    Kim, Park, Cho, Jeong and Kim, MulRan: Multimodal range dataset for urban place recognition,
    ICRA 2020; https://github.com/RPM-Robotics-Lab/file_player_mulran.
    """

    def __init__(self, path: str | Path, *, stamp_is: str | None = None) -> None:
        check_time_options(None, stamp_is)
        root = Path(path)
        folder = first_existing(root, MULRAN_FOLDERS)
        if folder is None:
            raise DatasetError(
                f"{root}: no MulRan sequence: expected a folder Ouster with .bin files"
            )
        super().__init__(root, "MulRan sequence", folder, "*.bin", int)
        self._root, self._beside = root, folder.parent
        self.sensor = extrinsic_settings(LIDAR_T_IMU)
        self._extrinsics_source = "SC-LIO-SAM's configuration"
        self._moment = stamp_is or "start"
        if stamp_is is None:
            self._problems.append(
                "MulRan does not say which moment of the sweep its stamp is: the start is assumed; "
                "stamp_is=middle or end overrides"
            )
        listing = first_existing(self._beside, ["data_stamp.csv"])
        self._problems += missing_files(listing, "ouster", self.stamps)
        column = np.arange(BEAMS * COLUMNS) % COLUMNS  # of a range image, row by row
        self._times = PERIOD * (column / COLUMNS - _MOMENTS[self._moment])

    @cached_property
    def imu(self) -> ImuSamples | None:
        """The IMU of ``xsens_imu.csv``, or None."""
        path = first_existing(self._beside, ["xsens_imu.csv"])
        return None if path is None else read_xsens(path, self._problems)

    @cached_property
    def truth(self) -> Trajectory | None:
        """Poses of ``global_pose.csv``, moved from the car's base to the lidar, or None."""
        path = self._root / "global_pose.csv"
        if not path.is_file():
            return None
        names = "ns r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z"
        stamps, values = read_table(path, names, ",")
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        poses[:, :3] = values.reshape(-1, 3, 4)
        error = poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1) - np.eye(3)
        bad = np.flatnonzero((np.abs(error) > 1e-3).any(axis=(1, 2)))
        if len(bad):
            raise DatasetError(f"{path}: row {bad[0] + 1} does not hold a rotation matrix")
        return moved_to_lidar(
            sorted_trajectory(stamps, poses, path.name, self._problems), BASE_T_LIDAR
        )

    def _read(self, file: Path, stamp: int) -> Scan:
        cloud = firing_by_firing(read_records(file, stamp, _RECORD), BEAMS, COLUMNS, str(file))
        return replace(decode_pointcloud2(cloud), times=self._times)

    def _sweep_facts(self) -> dict[str, str]:
        return {
            "fields": "x, y, z, intensity (float32)",
            "point times": f"from the order of the points, {COLUMNS} firings in {PERIOD:g} s, "
            f"stamp at sweep {self._moment}",
        }
