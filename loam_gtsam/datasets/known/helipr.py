"""HeLiPR: several lidars on a car, one file of points per sweep."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from loam_gtsam.datasets.decode.extrinsics import Rig
from loam_gtsam.datasets.decode.packed_points import PackedCloud, read_records
from loam_gtsam.datasets.decode.tables import read_pose_table, sorted_trajectory
from loam_gtsam.datasets.known import layouts
from loam_gtsam.datasets.known.stamped_files import StampedFiles
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.types import DatasetError, Trajectory

_XYZ = ("x", "<f4"), ("y", "<f4"), ("z", "<f4")
_XYZI = *_XYZ, ("intensity", "<f4")
_AEVA = ("reflectivity", "<f4"), ("velocity", "<f4"), ("offset_time", "<i4"), ("laser", "u1")
_WORDS = ("reflectivity", "<u2"), ("ring", "<u2"), ("ambient", "<u2")
RECORDS = {
    "Ouster": np.dtype([*_XYZI, ("t", "<u4"), *_WORDS]),
    "Velodyne": np.dtype([*_XYZI, ("ring", "<u2"), ("time", "<f4")]),
    "Avia": np.dtype(
        [*_XYZ, ("intensity", "u1"), ("tag", "u1"), ("laser", "u1"), ("offset_time", "<u4")]
    ),
    "Aeva": np.dtype([*_XYZ, *_AEVA]),
}
"""Fields of a point, without padding (the data set's file player)."""
_AEVA_LATER = np.dtype([*_XYZ, *_AEVA, ("intensity", "<f4")])
_AEVA_CHANGE = 1_691_936_557_946_849_179
"""Nanoseconds after which a point of the Aeva has an intensity, too (HeLiPR-Pointcloud-Toolbox)."""
IMU_T_LIDAR = {
    "Ouster": [
        [0.999715495593027, 0.0223448061210468, -0.00834490926264448, -0.417],
        [-0.0224514077723064, 0.999664614804883, -0.0129070599303583, -0.003],
        [0.00805370475188661, 0.0130907427756056, 0.999881878170293, 0.2996],
    ],
    "Velodyne": [
        [0.999995760375673, 0.000773891425480788, -0.00280719125478291, -1.372],
        [-0.000825966811080870, 0.999826715354752, -0.0185972320992637, 0.0668],
        [0.00279231257318289, 0.0185994719007949, 0.999823115673720, 0.0297],
    ],
    "Avia": [
        [0.999260281307309, 0.0383884500761334, 0.00228409771914936, 0.2054],
        [-0.0383981303207532, 0.999253021123844, 0.00435699010113986, -0.3528],
        [-0.00211513344942227, -0.00444147223600340, 0.999987899694225, 0.0706],
    ],
    "Aeva": [
        [0.998593404866819, 0.0471428768856460, -0.0242643960451897, 0.1337],
        [-0.0476188752386917, 0.998676624578879, -0.0194278727795602, 0.3557],
        [0.0233163993252583, 0.0205559888762785, 0.999516781671935, 0.2219],
    ],
}
"""Extrinsics of the data set's Pointcloud-Toolbox (``transformINStoLiDAR.py``)."""


class HeLiPRDataset(StampedFiles):
    """A sequence of HeLiPR.

    Parameters
    ----------
    path : holds ``LiDAR/Ouster/*.bin`` or those of another lidar (or these without ``LiDAR/``),
        named by nanoseconds, and, where present, ``LiDAR_GT/Ouster_gt.txt`` (or
        ``global_Ouster_gt.txt``), ``Inertial_data/xsens_imu.csv`` and ``stamp.csv``
    lidar : ``Ouster`` (OS2-128), ``Velodyne`` (VLP-16C), ``Avia`` (Livox) or ``Aeva`` (Aeries II);
        None takes the first that is there
    time_unit, stamp_is : see :func:`~loam_gtsam.datasets.decode.pointcloud2.decode_pointcloud2`

    Raises
    ------
    DatasetError
        If there are no sweeps, a table cannot be understood, or another lidar is asked for.

    References
    ----------
    Jung, Yang, Lee, Gil, Kim and Kim, HeLiPR: Heterogeneous LiDAR dataset for inter-LiDAR place
    recognition under spatiotemporal variations, IJRR 2024;
    https://github.com/minwoo0611/HeLiPR-File-Player.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        lidar: str | None = None,
        time_unit: str | None = None,
        stamp_is: str | None = None,
    ) -> None:
        root = Path(path)
        folder = _lidar_folder(root, lidar)
        name = folder.name
        lidar_T_imu = inverse_pose(np.array([*IMU_T_LIDAR[name], [0.0, 0.0, 0.0, 1.0]]))
        kind = f"HeLiPR sequence, {name}"
        super().__init__(
            root,
            Rig(kind, lidar_T_imu, "HeLiPR-Pointcloud-Toolbox", body_T_lidar=np.eye(4)),
            folder,
            "*.bin",
            _read_aeva if name == "Aeva" else partial(read_records, record=RECORDS[name]),
            imu=layouts.first_existing(root, ["Inertial_data/xsens_imu.csv", "xsens_imu.csv"]),
            truth=layouts.helipr_truth(root, name),
            time_unit=time_unit,
            stamp_is=stamp_is,
        )
        self._look_for_missing(layouts.first_existing(root, ["stamp.csv"]), name.lower())

    def _read_truth(self, path: Path) -> Trajectory:
        stamps, poses = read_pose_table(path, "ns x y z qx qy qz qw", None)
        return sorted_trajectory(stamps, poses, path.name, self._problems)


def _read_aeva(path: Path, stamp: int) -> PackedCloud:
    record = _AEVA_LATER if stamp > _AEVA_CHANGE else RECORDS["Aeva"]
    return read_records(path, stamp, record)


def _lidar_folder(root: Path, lidar: str | None) -> Path:
    known = layouts.HELIPR_LIDARS
    if lidar is not None and lidar not in known:
        raise DatasetError(f"lidar: expected one of {', '.join(known)}; got {lidar!r}")
    for name in [lidar] if lidar else known:
        folder = layouts.first_existing(root, [f"LiDAR/{name}", name])
        if folder is not None:
            return folder
    wanted = lidar or " or LiDAR/".join(known)
    raise DatasetError(f"{root}: no HeLiPR sequence: expected LiDAR/{wanted}")
