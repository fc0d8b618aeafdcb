"""Boreas: a Velodyne Alpha Prime (128 beams) on a car, one file of points per sweep."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.decode import tables
from loam_gtsam.datasets.decode.extrinsics import Rig
from loam_gtsam.datasets.decode.packed_points import read_records
from loam_gtsam.datasets.known import layouts
from loam_gtsam.datasets.known.stamped_files import StampedFiles
from loam_gtsam.types import DatasetError, FloatArray, Trajectory

RECORD = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity", "ring", "time")])
"""Fields of a point; the time counts from the stamp, seconds (``DATA_REFERENCE.md``)."""
_RIG = Rig("Boreas sequence", np.eye(4), "", body_T_lidar=np.eye(4))
_POSE = [
    "easting",
    "northing",
    "altitude",
    "vx",
    "vy",
    "vz",
    "roll",
    "pitch",
    "heading",
    "wz",
    "wy",
    "wx",
]
_ANGLES = slice(6, 9)  # roll, pitch, heading


class BoreasDataset(StampedFiles):
    """A sequence of Boreas.

    Parameters
    ----------
    path : holds ``lidar/*.bin``, named by microseconds, and, where present,
        ``applanix/lidar_poses.csv``, the poses of the lidar in metres east, north and up
    time_unit, stamp_is : see :func:`~loam_gtsam.datasets.decode.pointcloud2.decode_pointcloud2`

    Notes
    -----
    The accelerations of its IMU are without gravity: it is left out.

    References
    ----------
    Burnett et al., Boreas: A multi-season autonomous driving dataset, IJRR 42, 2023;
    https://github.com/utiasASRL/pyboreas.
    """

    def __init__(
        self, path: str | Path, *, time_unit: str | None = None, stamp_is: str | None = None
    ) -> None:
        root = Path(path)
        super().__init__(
            root,
            _RIG,
            root / "lidar",
            "*.bin",
            partial(read_records, record=RECORD),
            name="MICROSECONDS",
            truth=layouts.first_existing(root, ["applanix/lidar_poses.csv"]),
            time_unit=time_unit,
            stamp_is=stamp_is,
        )

    def _read_truth(self, path: Path) -> Trajectory:
        rows = [line.split(",") for line in tables.read_lines(path)[1:]]
        stamps, poses = [], []
        for number, row in enumerate(rows, start=2):
            try:
                stamps.append(tables.whole_number(row[0], 1000))
                poses.append(_pose([float(word) for word in row[1:]]))
            except ValueError as error:
                expected = f"microseconds, {', '.join(_POSE)}"
                text = f"{path}:{number}: expected {expected}: {str(error)[:80]}"
                raise DatasetError(text) from error
        found = np.array(stamps, np.int64), np.reshape(poses, (-1, 4, 4))
        return tables.sorted_trajectory(*found, path.name, self._problems)


def _pose(values: list[float]) -> FloatArray:
    """(4, 4); the angles turn the world into the lidar, so their inverse is the pose."""
    if len(values) != len(_POSE) or not np.isfinite(values).all():
        raise ValueError(f"{len(values)} numbers, or NaN")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("XYZ", -np.array(values[_ANGLES])).as_matrix()
    pose[:3, 3] = values[:3]
    return pose
