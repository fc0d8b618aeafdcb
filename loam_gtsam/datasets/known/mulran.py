"""MulRan: an Ouster OS1-64 on a car, one file of points per sweep."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.decode.extrinsics import Rig, rigid_transform
from loam_gtsam.datasets.decode.packed_points import XYZI, read_records
from loam_gtsam.datasets.decode.tables import read_table, sorted_trajectory
from loam_gtsam.datasets.known.layouts import MULRAN_FOLDERS, first_existing
from loam_gtsam.datasets.known.stamped_files import StampedFiles
from loam_gtsam.geometry import is_rigid
from loam_gtsam.types import DatasetError, Trajectory

RIG = Rig(
    kind="MulRan sequence",
    lidar_T_imu=rigid_transform(Rotation.from_euler("z", 180.0, degrees=True), [1.77, 0.0, -0.05]),
    source="SC-LIO-SAM's configuration",
    body_T_lidar=rigid_transform(
        Rotation.from_euler("xyz", [0.0001, 0.0003, 179.6654], degrees=True),
        [1.7042, -0.021, 1.8047],
    ),
)
"""``params_mulran.yaml`` of SC-LIO-SAM, by an author of the data set, which itself states no place
of the IMU; ``calib_base2ouster.txt`` of the data set, as KISS-ICP, MOLA and mulran2bag quote it."""


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
    The files hold neither times nor rings; both follow from the order of the points, 64 x 1024. A
    sweep of another size becomes a :class:`~loam_gtsam.types.BadSweep`.

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
        root = Path(path)
        folder = first_existing(root, MULRAN_FOLDERS)
        if folder is None:
            expected = "expected a folder Ouster with .bin files"
            raise DatasetError(f"{root}: no MulRan sequence: {expected}")
        super().__init__(
            root,
            RIG,
            folder,
            "*.bin",
            partial(read_records, record=XYZI),
            imu=first_existing(folder.parent, ["xsens_imu.csv"]),
            truth=first_existing(root, ["global_pose.csv"]),
            in_order=True,
            stamp_is=stamp_is,
        )
        self._first = None, "x, y, z, intensity (float32)"
        if stamp_is is None:
            self._problems.append(
                "MulRan does not say which moment of the sweep its stamp is: the start is assumed; "
                "stamp_is=middle or end overrides"
            )
        self._look_for_missing(first_existing(folder.parent, ["data_stamp.csv"]), "ouster")

    def _read_truth(self, path: Path) -> Trajectory:
        names = "ns r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z"
        stamps, values = read_table(path, names, ",")
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        poses[:, :3] = values.reshape(-1, 3, 4)
        bad = np.flatnonzero(~is_rigid(poses))
        if len(bad):
            raise DatasetError(f"{path}: row {bad[0] + 1} does not hold a rotation matrix")
        return sorted_trajectory(stamps, poses, path.name, self._problems)
