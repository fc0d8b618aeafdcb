"""A folder of sweeps, one file each: KITTI, and the many data sets that copy its layout."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.datasets.base import DatasetInfo, SweepFiles
from loam_gtsam.datasets.decode import tables
from loam_gtsam.datasets.decode.extrinsics import describe_extrinsics, extrinsic_settings
from loam_gtsam.datasets.decode.packed_points import (
    XYZI,
    XYZI_RING,
    read_npy,
    read_pcd,
    read_ply,
    read_records,
)
from loam_gtsam.datasets.decode.point_times import (
    IGNORE_TIMES,
    TimeDecision,
    apply_times,
    decide_times,
    shorter_period,
    span_problem,
    usual_step,
)
from loam_gtsam.datasets.decode.pointcloud2 import (
    CloudStream,
    TimeOptions,
    decode_with_times,
    describe_fields,
)
from loam_gtsam.datasets.kitti import drive
from loam_gtsam.datasets.kitti.file_names import in_order, without_strays
from loam_gtsam.datasets.known.layouts import first_existing
from loam_gtsam.types import DatasetError, ImuSamples, Scan, Trajectory

KITTI_SENSOR: Mapping[str, Any] = {
    "spin": "clockwise",
    "start_azimuth_deg": 180.0,
    "stamp": "middle",
}
"""KITTI's HDL-64E: the synced stamp is the moment the sensor faces forward (data set paper,
Geiger et al. 2013), the cut between sweeps is behind. The sense of rotation was measured: on drive
2011_09_26_0002, sweeps 8 to 12 frames apart match best (10 of 10 pairs) when de-skewed clockwise
from behind by exactly the true motion; the order in the files, ring by ring, runs the other way."""

ELEVATION_DEG = 0.205
"""By how much KITTI's calibration of its HDL-64E has the rays too low, as CT-ICP and KISS-ICP
correct it. Measured on drive 2011_09_26_0002 as a function of the correction: the error of the
rotation is least there (0.073 degrees against 0.108 without and 0.115 with 0.4), and so is the
drift of the rotation (1.30 degrees per 100 m against 1.57 and 1.56); KISS-ICP's drift is least
between 0.2 and 0.3."""
READERS = {".pcd": read_pcd, ".ply": read_ply, ".npy": read_npy}
"""Readers of the files that tell their own fields."""
SUFFIXES = (".bin", *READERS)
_TRIED = 10  # sweeps looked at, at most, to describe their fields
_NAMED = 5  # files that are left out, at most, whose names are said
_MOST_RINGS = 256  # a fifth column with more different values is no beam

_SHOWN = "[!.]*"  # not those that begin with a dot: macOS's ._000000.bin is no sweep
_FOLDERS = ("", "velodyne", "scans", "velodyne_points/data")


class KittiDataset(SweepFiles):
    """Folder of ``.bin``, ``.pcd``, ``.ply`` or ``.npy`` files, one for each sweep.

    A ``.bin`` file is float32 ``x y z intensity``, little endian, or ``x y z intensity ring``
    (nuScenes), which the numbers in the first file tell. The fields of the others are those of a
    PointCloud2: times and rings are read as from a bag.

    Parameters
    ----------
    path : the folder with the files, or one that holds them in ``velodyne/``, ``scans/`` or
        ``velodyne_points/data/``
    vertical_angle_offset_deg : raise every ray by this elevation; None takes
        :data:`ELEVATION_DEG` for KITTI's own layouts, and 0 for others
    columns : of a ``.bin`` file, 4 or 5; None tells it from the first file
    time_field, time_unit, stamp_is : of the files that tell their own fields, see
        :func:`~loam_gtsam.datasets.decode.pointcloud2.decode_pointcloud2`

    Notes
    -----
    Next to the sweeps it reads, where present: ``times.txt`` (seconds, one per sweep) or KITTI's
    ``velodyne_points/timestamps.txt``; ``t_ns/*.u64`` (uint64 nanoseconds per point);
    ``gt.tum`` (reference poses); ``imu.csv`` (s, quaternion x y z w, rad/s, m/s^2) or EuRoC's
    ``imu0/data.csv`` (ns, rad/s, m/s^2; ``imu.csv`` may have these columns, too).

    Of KITTI's raw drives also ``timestamps_start.txt`` and ``timestamps_end.txt`` (the duration of
    a turn), and ``oxts/`` with ``calib_imu_to_velo.txt`` as IMU and as reference poses. A sequence
    of its odometry benchmark, known by ``Tr`` in ``calib.txt``, has sweeps that are already freed
    of the motion; its reference poses are ``../../poses/NN.txt``. Those of a drive of KITTI-360,
    known by its name, are ``../../data_poses/DRIVE/cam0_to_world.txt``, with
    ``../../calibration/calib_cam_to_velo.txt``.

    Raises
    ------
    DatasetError
        If there are no sweeps, a file next to them cannot be understood, or an option is not one
        of such files.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        vertical_angle_offset_deg: float | None = None,
        columns: int | None = None,
        time_field: str | None = None,
        time_unit: str | None = None,
        stamp_is: str | None = None,
    ) -> None:
        self._path = given = Path(path)
        folder = _sweep_folder(given)
        self._root = _root_of(folder, given)
        self.name = given.resolve().name or "sweeps"
        self._problems: list[str] = []
        self._files = _sweep_files(folder, self._root, self._problems)
        suffix = self._files[0].suffix
        if columns not in (None, 4, 5):
            raise DatasetError(f"columns: expected 4 or 5, got {columns!r}")
        options: TimeOptions = {
            "time_field": time_field,
            "time_unit": time_unit,
            "stamp_is": stamp_is,
        }
        if suffix == ".bin" and any(options.values()):
            raise DatasetError(f"{given}: .bin files have no fields for {', '.join(options)}")
        self._options, self._clouds = options, CloudStream(**options)
        self._record = XYZI
        if suffix == ".bin" and (columns or _columns_of(self._files)) == 5:
            self._record = XYZI_RING
        self._times_folder = self._root / "t_ns"
        self._imu_file = first_existing(self._root, ["imu.csv", "imu0/data.csv"])
        self._facts: dict[str, str] = {}
        self.stamps = drive.sweep_stamps(self._root, self._files, self._facts, self._problems)
        self._camera_T_lidar = drive.camera_T_lidar_of(self._root)
        self._oxts = drive.read_oxts(self._root)
        self._lidar_T_imu = None if self._oxts is None else drive.lidar_T_imu_of(self._root)
        if self._oxts is not None and self._lidar_T_imu is None:
            self._problems.append(
                "oxts left out: no calib_imu_to_velo.txt in the drive or above it says where the "
                "scanner is (it comes with the calibration of the day)"
            )
        self.sensor: Mapping[str, Any] = self._implied(folder)
        self._default_offset = vertical_angle_offset_deg is None
        if vertical_angle_offset_deg is None:
            kitti = not drive.is_kitti_360(self._root) and suffix == ".bin"
            kitti = kitti and self.sensor.get("stamp") == KITTI_SENSOR["stamp"]
            vertical_angle_offset_deg = ELEVATION_DEG if kitti else 0.0
        self._offset = float(np.radians(vertical_angle_offset_deg))
        if not np.isfinite(self._offset):
            got = f"got {vertical_angle_offset_deg!r}"
            raise DatasetError(f"vertical_angle_offset_deg: expected degrees, {got}")
        self._decision = self._decide_times() if self._times_folder.is_dir() else None

    @cached_property
    def imu(self) -> ImuSamples | None:
        """The IMU of ``imu.csv`` or ``oxts/``, or None."""
        if self._imu_file is not None:
            return tables.read_imu(self._imu_file, self._problems)
        if self._oxts is None or self._lidar_T_imu is None:
            return None
        return drive.oxts_imu(*self._oxts, self._problems)

    @cached_property
    def truth(self) -> Trajectory | None:
        """Poses of ``gt.tum``, of the odometry benchmark or of ``oxts/``, or None."""
        path = self._root / "gt.tum"
        if path.is_file():
            return tables.read_tum(path)
        if drive.is_kitti_360(self._root):
            return drive.kitti_360_truth(self._root, self._problems)
        if self._camera_T_lidar is not None:
            return drive.odometry_truth(self._root, self.stamps, self._camera_T_lidar)
        if self._oxts is None or self._lidar_T_imu is None:
            return None
        return drive.oxts_truth(*self._oxts, self._lidar_T_imu, self._problems)

    def info(self) -> DatasetInfo:
        """Description of the folder; reads the first sweep of files that tell their fields."""
        imu = self.imu  # first: it may find problems
        suffix = self._files[0].suffix
        kind = "KITTI folder" if suffix == ".bin" else f"folder of {suffix} files"
        info = DatasetInfo(kind, str(self._path), {"sweeps": str(len(self))})
        tables.describe_stamps(self.stamps, info.facts, info.problems)
        info.facts |= self._facts
        decision, info.facts["fields"] = self._first
        info.facts["point times"] = str(decision or "none recorded")
        sensor = {key: value for key, value in self.sensor.items() if not key.startswith("imu.")}
        if sensor:
            info.facts["sensor"] = ", ".join(f"{key} {value}" for key, value in sensor.items())
        if self._offset:
            why = ", KITTI's calibration; vertical_angle_offset_deg=0 leaves it"
            raised = f"{np.degrees(self._offset):g} degrees{why if self._default_offset else ''}"
            info.facts["elevation raised by"] = raised
        info.facts["IMU"] = tables.describe_imu(imu)
        if "imu.lidar_t_imu" in self.sensor:
            info.facts["IMU to lidar"] = describe_extrinsics(self.sensor, "calib_imu_to_velo.txt")
        info.facts["reference poses"] = str(len(self.truth)) if self.truth is not None else "none"
        info.problems.extend(self._problems)
        return info

    @cached_property
    def _step(self) -> float:
        return usual_step(self.stamps)

    @cached_property
    def _first(self) -> tuple[TimeDecision | None, str]:
        """How the times are read, and the fields: from the first sweep that can be read."""
        if self._files[0].suffix == ".bin":
            return self._decision, f"{', '.join(self._record.names or ())} (float32)"
        for file, stamp in zip(self._files[:_TRIED], self.stamps.tolist(), strict=False):
            with suppress(DatasetError):
                cloud = READERS[file.suffix](file, stamp)
                decision = self._decision
                with suppress(DatasetError):
                    decision = decision or decode_with_times(cloud, **self._options).decision
                return decision, describe_fields(cloud)
        return self._decision, "not readable"

    def _implied(self, folder: Path) -> Mapping[str, Any]:
        sensor: dict[str, Any] = {}
        if self._times_folder.is_dir():
            pass  # they say it all
        elif self._camera_T_lidar is not None:
            sensor = dict(KITTI_SENSOR) | {"times": "none"}
            self._problems.append(
                "a sequence of KITTI's odometry benchmark: its sweeps are already freed of the "
                "motion, so they are not de-skewed (sensor.times=azimuth would)"
            )
        elif folder.name == "velodyne" or folder.parent.name == "velodyne_points":
            period = drive.turn_seconds(self._root, self._files, self.stamps, self._problems)
            sensor = dict(KITTI_SENSOR) | ({} if period is None else {"period": period})
        else:
            sensor = dict(shorter_period(self.stamps))
        if self._lidar_T_imu is not None and self._imu_file is None:
            sensor.update(extrinsic_settings(self._lidar_T_imu))
        return sensor

    def _read(self, file: Path, stamp: int) -> Scan:
        if file.suffix in READERS:
            scan = self._clouds.decode(READERS[file.suffix](file, stamp))
            points, rings = scan.points, scan.rings
            if self._offset:
                points = raise_elevation(points, self._offset)
            if self._decision is None:
                if problem := span_problem([scan.times], self._step):
                    raise DatasetError(f"{problem}; give {IGNORE_TIMES}")
                return replace(scan, points=points)
        else:
            width = len(self._record.names or ())
            rows = read_records(file, stamp, self._record).data.view("<f4").reshape(-1, width)
            points = np.ascontiguousarray(rows[:, :3], dtype=np.float32)
            rings = rows[:, 4].astype(np.int64) if width == 5 else None
            if self._offset:
                points = raise_elevation(points, self._offset)
            if self._decision is None:
                return Scan(points=points, stamp=stamp, rings=rings)
        values = self._read_point_times(file, len(points))
        times, outlier = apply_times(values, stamp, self._decision)
        points[outlier] = np.nan
        return Scan(points=points, stamp=stamp, times=times, rings=rings)

    def _read_point_times(self, file: Path, count: int | None = None) -> NDArray[np.uint64]:
        path = self._times_folder / f"{file.stem}.u64"
        try:
            values = np.fromfile(path, dtype="<u8")
        except OSError as error:
            raise DatasetError(f"{path}: cannot read the point times: {error}") from error
        if count is not None and len(values) != count:
            raise DatasetError(f"{path}: expected {count} point times, got {len(values)}")
        return values

    def _decide_times(self) -> TimeDecision:
        """How times are read, by the first sweep that has times; a missing file is a bad sweep."""
        message = ""
        for file, stamp in zip(self._files, self.stamps.tolist(), strict=True):
            try:
                return decide_times(self._read_point_times(file), stamp, field="t_ns", unit="ns")
            except DatasetError as error:
                message = message or str(error)
        raise DatasetError(f"{self._times_folder}: no usable point times; {message}")


def raise_elevation(points: NDArray[np.floating], angle: float) -> NDArray[np.floating]:
    """Turn every ray up by ``angle`` (rad), about the horizontal axis perpendicular to it."""
    cosine, sine = np.cos(angle), np.sin(angle)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        horizontal = np.hypot(points[:, 0], points[:, 1])
        scale = np.where(horizontal > 0.0, cosine - sine * points[:, 2] / horizontal, 1.0)
        raised = points * scale[:, None]
        up = cosine * points[:, 2] + sine * horizontal
        raised[:, 2] = np.where(horizontal > 0.0, up, points[:, 2])
        return raised.astype(points.dtype)


def find_sweeps(path: Path) -> Path | None:
    """The folder in or below ``path`` that holds sweeps, None if there is none.

    The first with any; a lone file, such as a map, is none where another folder has several.
    """
    folders = (path / name for name in _FOLDERS if (path / name).is_dir())
    counts = {folder: max(_counts(folder).values()) for folder in folders}
    several = next((folder for folder, count in counts.items() if count > 1), None)
    return several or next((folder for folder, count in counts.items() if count), None)


def _counts(folder: Path) -> dict[str, int]:
    """How many files of each kind a folder has, all in one look at it."""
    counts = dict.fromkeys(SUFFIXES, 0)
    with suppress(OSError):
        for name in os.listdir(folder):
            suffix = os.path.splitext(name)[1]
            if suffix in counts and not name.startswith("."):
                counts[suffix] += 1
    return counts


def _sweep_files(folder: Path, root: Path, problems: list[str]) -> list[Path]:
    """The files of the kind of which a folder has most, in order, but for those named otherwise.

    What is left out is named in ``problems``.
    """
    counts = _counts(folder)
    suffix = max(counts, key=counts.__getitem__)  # the first of equals: .bin
    files = list(folder.glob(f"{_SHOWN}{suffix}"))
    for kind, count in counts.items():
        if count and kind != suffix:
            which = f"{count} {kind} files" if count > 1 else f"1 {kind} file"
            problems.append(f"{which} left out: the sweeps are the {len(files)} {suffix} files")
    sweeps, others = without_strays(files)
    times = root / "times.txt"
    if others and not (times.is_file() and len(tables.read_lines(times)) == len(files)):
        names = ", ".join(sorted(file.name for file in others)[:_NAMED])
        more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
        problems.append(
            f"{names}{more} left out: named otherwise than the {len(sweeps)} sweeps "
            f"({min(sweeps).name}, ...); a sweep among them needs a name like theirs"
        )
        return in_order(sweeps)
    return in_order(files)


def _columns_of(files: Sequence[Path]) -> int:
    """4, or 5 if the first file that has points is one of records with a beam at the end."""
    for file in files:
        try:
            values = np.fromfile(file, "<f4")
        except OSError:
            continue
        if len(values):
            break
    else:
        return 4
    if len(values) % 5:
        return 4
    beams = values[4::5]
    whole = np.isfinite(beams).all() and not (beams % 1.0).any() and beams.min() >= 0.0
    few = len(np.unique(beams)) if whole else 0
    # Intensities of four columns may be whole as well, but are no run of numbers from 0 on.
    return 5 if 2 <= few <= _MOST_RINGS and beams.max() < 2 * few else 4


def _sweep_folder(path: Path) -> Path:
    if not path.is_dir():
        what = "not a folder" if path.exists() else "no such folder"
        raise DatasetError(f"{path}: {what}; expected a folder with sweeps")
    if (folder := find_sweeps(path)) is not None:
        return folder
    inner = ", ".join(f"{name}/" for name in _FOLDERS if name)
    kinds = ", ".join(SUFFIXES)
    raise DatasetError(f"{path}: no sweeps ({kinds}); looked in the folder itself, {inner}")


def _root_of(folder: Path, given: Path) -> Path:
    """Where ``times.txt`` and the like are, also when the sweep folder itself was given."""
    if folder != given:
        return given
    folder = folder.resolve()
    inner = next((name for name in _FOLDERS[1:] if folder.match(name)), None)
    return given if inner is None else folder.parents[inner.count("/")]
