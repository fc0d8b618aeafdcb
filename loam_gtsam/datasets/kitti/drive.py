"""What lies beside KITTI's sweeps: stamps, the GPS/IMU (``oxts``), poses and calibration.

Geiger, Lenz, Stiller and Urtasun, Vision meets robotics: The KITTI dataset, IJRR 32(11), 2013, and
the ``readme.txt`` and ``dataformat.txt`` of the development kits.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.decode import tables
from loam_gtsam.datasets.decode.extrinsics import moved_to_lidar
from loam_gtsam.datasets.decode.point_times import SWEEP_SECONDS
from loam_gtsam.datasets.kitti.file_names import stamps_of_names
from loam_gtsam.datasets.known.layouts import first_existing
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.types import DatasetError, FloatArray, ImuSamples, IntArray, Trajectory

_RAW = "velodyne_points"
_RIGID = "12 numbers of a rigid transform"
_KITTI_360 = re.compile(r"2013_05_28_drive_\d{4}_(sync|extract)")
_EARTH_RADIUS = 6378137.0  # metres, as in the development kit
_LATITUDE, _LONGITUDE, _ALTITUDE = 0, 1, 2
_ANGLES = slice(3, 6)  # roll, pitch, yaw: radians; yaw 0 is east
_ACCELERATION, _GYRO = slice(11, 14), slice(17, 20)
"""Along x, y, z of the unit, m/s^2 with gravity, rad/s."""
_OXTS_VALUES = 30
_NORTHERNMOST = 89.9  # degrees: the Mercator projection has no poles
_FAR = 1e6  # metres and degrees that no packet has
_BRIDGED_NS = 100_000_000  # default of ``imu.max_gap``


def sweep_stamps(
    root: Path, files: Sequence[Path], facts: dict[str, str], problems: list[str]
) -> IntArray:
    """Nanoseconds of each sweep, by ``times.txt``, their names or KITTI's ``timestamps.txt``."""
    names = [re.search(r"__(\d{16})(\.|$)", file.stem) for file in files]
    path, raw = root / "times.txt", root / _RAW / "timestamps.txt"
    if path.is_file():
        stamps = tables.read_stamps(path)
    elif all(names):  # nuScenes: microseconds
        try:
            listed = [tables.whole_number(name[1], 1000) for name in names if name]
        except ValueError as error:
            raise DatasetError(
                f"{root}: expected microseconds in names of files: {error}"
            ) from error
        stamps = np.array(listed, np.int64)
    elif raw.is_file():
        path, dates = raw, read_dates(raw)
        stamps = _of_files(dates, files)
        if missing := len(dates) - len(stamps):
            problems.append(f"{missing} sweeps of {path.name} have no file")
    else:
        return stamps_of_names(files, facts, problems)
    if len(stamps) != len(files):
        counts = f"{len(stamps)} stamps for {len(files)} sweeps"
        raise DatasetError(f"{path}: {counts}; expected one line for each file")
    return stamps


def turn_seconds(
    root: Path, files: Sequence[Path], stamps: IntArray, problems: list[str]
) -> float | None:
    """Median duration of a sweep of a raw drive; None if it does not tell."""
    paths = [root / _RAW / f"timestamps_{end}.txt" for end in ("start", "end")]
    if not all(path.is_file() for path in paths):
        return None
    first, last = (_of_files(read_dates(path), files) for path in paths)
    if not len(first) == len(last) == len(files):
        counts = f"{len(first)} and {len(last)} stamps for {len(files)} sweeps"
        raise DatasetError(f"{paths[0]}, {paths[1].name}: {counts}")
    seconds = float(np.median(last - first)) * 1e-9
    if not SWEEP_SECONDS[0] <= seconds <= SWEEP_SECONDS[1]:
        raise DatasetError(f"{paths[1]}: sweeps of {seconds:g} s (median), expected about 0.1")
    if outside := int(np.count_nonzero((stamps < first) | (stamps > last))):
        problems.append(f"{outside} stamps lie outside their sweep's start and end")
    return round(seconds, 6)


def read_dates(path: Path) -> IntArray:
    """KITTI raw: ``2011-09-26 13:02:25.594360375`` per line, as nanoseconds since 1970 UTC."""

    def nanoseconds(line: str) -> int:
        date, _, fraction = line.partition(".")
        moment = datetime.strptime(date, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        if fraction.strip("0123456789"):
            raise ValueError(f"not a fraction of a second: {fraction[:20]!r}")
        seconds = tables.whole_number(str(int(moment.timestamp())), 10**9)
        return tables.whole_number(str(seconds + int(f"{fraction:0<9}"[:9])))

    return np.array(tables.convert_lines(path, nanoseconds, "a date and time"), dtype=np.int64)


def _of_files(listed: IntArray, files: Sequence[Path]) -> IntArray:
    """Stamps of the files of a drive, of all its listed ones: some drives lack a few sweeps."""
    numbers = [int(file.stem) if file.stem.isdecimal() else -1 for file in files]
    if len(listed) > len(numbers) and min(numbers) >= 0 and max(numbers) < len(listed):
        return listed[numbers]
    return listed


def read_oxts(root: Path) -> tuple[IntArray, FloatArray] | None:
    """Stamps (ns) and the 30 values of each packet of ``oxts/``, or None without the folder."""
    folder = root / "oxts"
    files = sorted((folder / "data").glob("[!.]*.txt"))
    if not files:
        return None
    stamps = read_dates(folder / "timestamps.txt")
    if len(stamps) != len(files):
        text = f"{folder / 'timestamps.txt'}: {len(stamps)} stamps for {len(files)} packets"
        raise DatasetError(f"{text}; expected one line for each file of oxts/data")
    values = np.empty((len(files), _OXTS_VALUES))
    for row, file in enumerate(files):
        words = " ".join(tables.read_lines(file)).split()
        try:
            if len(words) != _OXTS_VALUES:
                raise ValueError(f"{len(words)} values")
            values[row] = [float(word) for word in words]
            if not abs(values[row, _LATITUDE]) < _NORTHERNMOST:
                raise ValueError(f"a latitude of {values[row, _LATITUDE]:g} degrees")
            if not (np.abs(values[row, : _ANGLES.stop]) < _FAR).all():
                raise ValueError("no position and angles")
        except ValueError as error:
            text = f"{file}: expected {_OXTS_VALUES} numbers: {str(error)[:80]}"
            raise DatasetError(text) from error
    return stamps, values


def oxts_imu(stamps: IntArray, values: FloatArray, problems: list[str]) -> ImuSamples | None:
    """The unit as an IMU, its orientation in a world of east, north and up."""
    quaternions = Rotation.from_euler("xyz", values[:, _ANGLES]).as_quat()
    samples = np.hstack([quaternions, values[:, _GYRO], values[:, _ACCELERATION]])
    imu = tables.clean_imu(stamps, samples, problems)
    if imu is not None and len(stamps) > 1 and np.median(np.diff(imu.stamps)) > 0.9 * _BRIDGED_NS:
        problems.append(
            f"oxts: {tables.describe_rate(imu.stamps)}; gaps above imu.max_gap (0.1 s) are not "
            "bridged. imu.max_gap=0.25 uses it all the same; oxts of unsynced drives (_extract) "
            "have 100 Hz"
        )
    return imu


def oxts_truth(
    stamps: IntArray, values: FloatArray, lidar_T_imu: FloatArray, problems: list[str]
) -> Trajectory:
    """Poses of the scanner, metres from the first: the kit's Mercator at the first latitude."""
    scale = np.cos(np.radians(values[0, _LATITUDE])) * _EARTH_RADIUS
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", values[:, _ANGLES]).as_matrix()
    poses[:, 0, 3] = scale * np.radians(values[:, _LONGITUDE])
    poses[:, 1, 3] = scale * np.log(np.tan(np.radians(90.0 + values[:, _LATITUDE]) / 2.0))
    poses[:, 2, 3] = values[:, _ALTITUDE]
    poses[:, :3, 3] -= poses[0, :3, 3].copy()
    body = tables.sorted_trajectory(stamps, poses, "oxts", problems)
    return moved_to_lidar(body, inverse_pose(lidar_T_imu))


def lidar_T_imu_of(root: Path) -> FloatArray | None:
    """Extrinsics of ``calib_imu_to_velo.txt``, in the drive or in the folder of its day."""
    path = first_existing(root, ["calib_imu_to_velo.txt", "../calib_imu_to_velo.txt"])
    if path is None:
        return None
    numbers = _calibration(path)
    try:
        rows = np.column_stack([np.reshape(numbers["R"], (3, 3)), np.reshape(numbers["T"], 3)])
        return tables.rigid_matrix(rows.ravel().tolist())
    except (KeyError, ValueError) as error:
        text = f"{path}: expected R: with 9 and T: with 3 numbers of a rigid transform"
        raise DatasetError(text) from error


def camera_T_lidar_of(root: Path) -> FloatArray | None:
    """``Tr`` of an odometry sequence's ``calib.txt``; None without the file or the line."""
    path = root / "calib.txt"
    numbers = _calibration(path) if path.is_file() else {}
    if "Tr" not in numbers:
        return None
    try:
        return tables.rigid_matrix(numbers["Tr"])
    except ValueError as error:
        text = f"{path}: expected Tr: with 12 numbers of a rigid transform"
        raise DatasetError(text) from error


def _rigid(line: str) -> FloatArray:
    return tables.rigid_matrix([float(word) for word in line.split()])


def odometry_truth(root: Path, stamps: IntArray, camera_T_lidar: FloatArray) -> Trajectory | None:
    """Poses of the scanner from ``poses/NN.txt``, of the left camera, beside ``sequences/NN``."""
    path = root.resolve().parent.parent / "poses" / f"{root.resolve().name}.txt"
    if not path.is_file():
        return None

    poses = tables.convert_lines(path, _rigid, _RIGID)
    if len(poses) != len(stamps):
        raise DatasetError(f"{path}: {len(poses)} poses for {len(stamps)} sweeps")
    moved = inverse_pose(camera_T_lidar) @ np.reshape(poses, (-1, 4, 4)) @ camera_T_lidar
    return Trajectory(stamps, moved)


def is_kitti_360(root: Path) -> bool:
    """Whether a folder has the name of a drive of KITTI-360."""
    return _KITTI_360.fullmatch(root.resolve().name) is not None


def kitti_360_truth(root: Path, problems: list[str]) -> Trajectory | None:
    """Poses of the scanner from ``cam0_to_world.txt``: frame numbers and matrices, row by row.

    Liao, Xie and Geiger, KITTI-360, PAMI 45(3), 2023; ``loadCalibration.py`` of its scripts.
    """
    above, name = root.resolve().parent.parent, root.resolve().name
    path = first_existing(above, [f"data_poses/{name}/cam0_to_world.txt"])
    if path is None:
        return None
    calibration = above / "calibration" / "calib_cam_to_velo.txt"
    if not calibration.is_file():
        problems.append(f"{path.name} left out: no {calibration} says where the scanner is")
        return None
    dates = read_dates(root / _RAW / "timestamps.txt")

    def frame(line: str) -> tuple[int, FloatArray]:
        number, *words = line.split()
        if len(words) != 16 or not 0 <= (at := tables.whole_number(number)) < len(dates):
            raise ValueError(f"{len(words)} numbers, of {len(dates)} frames")
        return int(dates[at]), tables.rigid_matrix([float(word) for word in words[:12]])

    found = tables.convert_lines(calibration, _rigid, _RIGID)
    if not found:
        raise DatasetError(f"{calibration}: expected {_RIGID}, got an empty file")
    lidar_T_camera = found[0]
    rows = tables.convert_lines(path, frame, "a frame number and the 16 of a rigid transform")
    stamps = np.array([stamp for stamp, _ in rows], np.int64)
    poses = np.reshape([pose for _, pose in rows], (-1, 4, 4)) @ inverse_pose(lidar_T_camera)
    return tables.sorted_trajectory(stamps, poses, path.name, problems)


def _calibration(path: Path) -> dict[str, list[float]]:
    """Lines of ``name: numbers``; those that hold no numbers are left out."""
    found = {}
    for line in tables.read_lines(path):
        name, _, rest = line.partition(":")
        try:
            found[name.strip()] = [float(word) for word in rest.split()]
        except ValueError:  # calib_time: 25-May-2012 16:47:16
            continue
    return found
