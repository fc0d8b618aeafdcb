"""KITTI's GPS/IMU (``oxts``) and the poses of its odometry benchmark, at the scanner.

References
----------
Geiger, Lenz, Stiller and Urtasun, Vision meets robotics: The KITTI dataset, IJRR 32(11), 2013, and
the ``readme.txt`` and ``dataformat.txt`` of the development kits.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.decode.extrinsics import moved_to_lidar
from loam_gtsam.datasets.decode.tables import (
    clean_imu,
    describe_rate,
    read_lines,
    sorted_trajectory,
)
from loam_gtsam.datasets.kitti.times import read_dates
from loam_gtsam.datasets.known.layouts import first_existing
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.types import DatasetError, FloatArray, ImuSamples, IntArray, Trajectory

_EARTH_RADIUS = 6378137.0
"""Metres, as in the development kit."""
_LATITUDE, _LONGITUDE, _ALTITUDE = 0, 1, 2
_ANGLES = slice(3, 6)
"""Roll, pitch, yaw: radians; yaw 0 is east."""
_ACCELERATION, _GYRO = slice(11, 14), slice(17, 20)
"""Along x, y, z of the unit, m/s^2 with gravity, rad/s."""
_OXTS_VALUES = 30
_BRIDGED_NS = 100_000_000
"""Default of ``imu.max_gap``."""


def read_oxts(root: Path) -> tuple[IntArray, FloatArray] | None:
    """Stamps (ns) and the 30 values of each packet of ``oxts/``, or None without the folder.

    Raises
    ------
    DatasetError
        If a packet or the list of stamps is damaged, or their numbers differ.
    """
    folder = root / "oxts"
    files = sorted((folder / "data").glob("*.txt"))
    if not files:
        return None
    stamps = read_dates(folder / "timestamps.txt")
    if len(stamps) != len(files):
        raise DatasetError(
            f"{folder / 'timestamps.txt'}: {len(stamps)} stamps for {len(files)} packets; expected "
            "one line for each file of oxts/data"
        )
    values = np.empty((len(files), _OXTS_VALUES))
    for row, file in enumerate(files):
        words = " ".join(read_lines(file)).split()
        try:
            if len(words) != _OXTS_VALUES:
                raise ValueError(f"{len(words)} values")
            values[row] = [float(word) for word in words]
        except ValueError as error:
            raise DatasetError(f"{file}: expected {_OXTS_VALUES} numbers: {error}") from error
    return stamps, values


def oxts_imu(stamps: IntArray, values: FloatArray, problems: list[str]) -> ImuSamples | None:
    """The unit as an IMU, its orientation in a world of east, north and up."""
    quaternions = Rotation.from_euler("xyz", values[:, _ANGLES]).as_quat()
    samples = np.hstack([quaternions, values[:, _GYRO], values[:, _ACCELERATION]])
    imu = clean_imu(stamps, samples, problems)
    if imu is not None and len(stamps) > 1 and np.median(np.diff(imu.stamps)) > 0.9 * _BRIDGED_NS:
        problems.append(
            f"oxts: {describe_rate(imu.stamps)}; gaps above imu.max_gap (0.1 s) are not bridged. "
            "imu.max_gap=0.25 uses it all the same; oxts of unsynced drives (_extract) have 100 Hz"
        )
    return imu


def oxts_truth(
    stamps: IntArray, values: FloatArray, lidar_T_imu: FloatArray, problems: list[str]
) -> Trajectory:
    """Poses of the scanner from positions of the GPS/IMU, in metres from the first one.

    The development kit's Mercator projection, scaled at the first latitude.
    """
    scale = np.cos(np.radians(values[0, _LATITUDE])) * _EARTH_RADIUS
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", values[:, _ANGLES]).as_matrix()
    poses[:, 0, 3] = scale * np.radians(values[:, _LONGITUDE])
    poses[:, 1, 3] = scale * np.log(np.tan(np.radians(90.0 + values[:, _LATITUDE]) / 2.0))
    poses[:, 2, 3] = values[:, _ALTITUDE]
    poses[:, :3, 3] -= poses[0, :3, 3].copy()
    return moved_to_lidar(
        sorted_trajectory(stamps, poses, "oxts", problems), inverse_pose(lidar_T_imu)
    )


def lidar_T_imu_of(root: Path) -> FloatArray | None:
    """Extrinsics of ``calib_imu_to_velo.txt``, in the drive or in the folder of its day."""
    path = first_existing(root, ["calib_imu_to_velo.txt", "../calib_imu_to_velo.txt"])
    if path is None:
        return None
    numbers = _calibration(path)
    result = np.eye(4)
    try:
        result[:3, :3] = np.reshape(numbers["R"], (3, 3))
        result[:3, 3] = numbers["T"]
    except (KeyError, ValueError) as error:
        raise DatasetError(f"{path}: expected R: with 9 and T: with 3 numbers") from error
    return result


def camera_T_lidar_of(root: Path) -> FloatArray | None:
    """``Tr`` of an odometry sequence's ``calib.txt``; None without the file or the line."""
    path = root / "calib.txt"
    if not path.is_file():
        return None
    numbers = _calibration(path)
    if "Tr" not in numbers:
        return None
    result = np.eye(4)
    try:
        result[:3] = np.reshape(numbers["Tr"], (3, 4))
    except ValueError as error:
        raise DatasetError(f"{path}: expected Tr: with 12 numbers") from error
    return result


def odometry_truth(root: Path, stamps: IntArray, camera_T_lidar: FloatArray) -> Trajectory | None:
    """Poses of the scanner from ``poses/NN.txt``, of the left camera, beside ``sequences/NN``."""
    path = root.resolve().parent.parent / "poses" / f"{root.resolve().name}.txt"
    if not path.is_file():
        return None
    lines = read_lines(path)
    poses = np.tile(np.eye(4), (len(lines), 1, 1))
    for number, line in enumerate(lines, start=1):
        try:
            poses[number - 1, :3] = np.reshape([float(word) for word in line.split()], (3, 4))
        except ValueError as error:
            raise DatasetError(
                f"{path}:{number}: expected 12 numbers, got {line.strip()[:80]!r}"
            ) from error
    if len(poses) != len(stamps):
        raise DatasetError(f"{path}: {len(poses)} poses for {len(stamps)} sweeps")
    return Trajectory(stamps, inverse_pose(camera_T_lidar) @ poses @ camera_T_lidar)


def _calibration(path: Path) -> dict[str, list[float]]:
    """Lines of ``name: numbers``; those that hold no numbers are left out."""
    found = {}
    for line in read_lines(path):
        name, _, rest = line.partition(":")
        try:
            found[name.strip()] = [float(word) for word in rest.split()]
        except ValueError:  # calib_time: 25-May-2012 16:47:16
            continue
    return found
