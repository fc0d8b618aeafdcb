"""A folder of ``.bin`` sweeps: KITTI, and the many data sets that copy its format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.datasets.base import DatasetInfo
from loam_gtsam.datasets.point_times import TimeDecision, apply_times, decide_times
from loam_gtsam.datasets.tables import (
    DEFAULT_PERIOD_NS,
    clean_imu,
    describe_imu,
    describe_stamps,
    read_lines,
    read_stamps,
    read_table,
    read_tum,
)
from loam_gtsam.types import (
    MAX_STAMP,
    BadSweep,
    DatasetError,
    ImuSamples,
    IntArray,
    Scan,
    Trajectory,
)

KITTI_SENSOR: Mapping[str, Any] = {
    "spin": "clockwise",
    "start_azimuth_deg": 180.0,
    "stamp": "middle",
}
"""KITTI's HDL-64E: the synced stamp is the moment the sensor faces forward (data set paper,
Geiger et al. 2013), the cut between sweeps is behind. The sense of rotation was measured: on drive
2011_09_26_0002, sweeps 8 to 12 frames apart match best (10 of 10 pairs) when de-skewed clockwise
from behind by exactly the true motion; the order in the files, ring by ring, runs the other way."""

_FOLDERS = ("", "velodyne", "scans", "velodyne_points/data")
_POINT_BYTES = 16


class KittiDataset:
    """Folder of ``.bin`` files, float32 ``x y z intensity`` little endian.

    Parameters
    ----------
    path : the folder with the ``.bin`` files, or one that holds them in ``velodyne/``, ``scans/``
        or ``velodyne_points/data/``
    vertical_angle_offset_deg : raise every ray by this elevation. Some systems (CT-ICP, KISS-ICP)
        correct the intrinsic calibration of KITTI's HDL-64E by 0.205 degrees.

    Notes
    -----
    Next to the sweeps it reads, where present: ``times.txt`` (seconds, one per sweep) or KITTI's
    ``velodyne_points/timestamps.txt``; ``t_ns/*.u64`` (uint64 nanoseconds per point);
    ``gt.tum`` (reference poses); ``imu.csv`` (s, quaternion x y z w, rad/s, m/s^2).

    Raises
    ------
    DatasetError
        If there are no sweeps, or a file next to them cannot be understood.
    """

    def __init__(self, path: str | Path, *, vertical_angle_offset_deg: float = 0.0) -> None:
        given = Path(path)
        folder = _find_sweeps(given)
        self._root = _root_of(folder, given)
        self.name = given.resolve().name or "sweeps"
        self._path = given
        self._files = sorted(folder.glob("*.bin"), key=_natural_order)
        self._offset = float(np.radians(vertical_angle_offset_deg))
        if not np.isfinite(self._offset):
            raise DatasetError(
                f"vertical_angle_offset_deg: expected degrees, got {vertical_angle_offset_deg!r}"
            )
        self._times_folder = self._root / "t_ns"
        self._has_times = self._times_folder.is_dir()
        is_kitti = folder.name == "velodyne" or folder.parent.name == "velodyne_points"
        self.sensor: Mapping[str, Any] = (
            dict(KITTI_SENSOR) if is_kitti and not self._has_times else {}
        )
        self._problems: list[str] = []
        self.stamps = self._read_stamps()
        self._decision = self._decide_times() if self._has_times else None

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[Scan | BadSweep]:
        for file, stamp in zip(self._files, self.stamps.tolist(), strict=True):
            try:
                yield self._read(file, stamp)
            except DatasetError as error:
                yield BadSweep(stamp, str(error))

    @cached_property
    def imu(self) -> ImuSamples | None:
        """From ``imu.csv``, or None."""
        path = self._root / "imu.csv"
        if not path.is_file():
            return None
        return clean_imu(*read_table(path, "t qx qy qz qw wx wy wz ax ay az", ","), self._problems)

    @cached_property
    def truth(self) -> Trajectory | None:
        """From ``gt.tum``, or None."""
        path = self._root / "gt.tum"
        return read_tum(path) if path.is_file() else None

    def info(self) -> DatasetInfo:
        """What was understood; reads no sweep."""
        imu = self.imu  # first: it may find problems
        info = DatasetInfo("KITTI folder", str(self._path), {"sweeps": str(len(self))})
        describe_stamps(self.stamps, info.facts, info.problems)
        info.facts["fields"] = "x, y, z, intensity (float32)"
        info.facts["point times"] = str(self._decision) if self._decision else "none"
        if self.sensor:
            info.facts["sensor"] = ", ".join(f"{key} {value}" for key, value in self.sensor.items())
        if self._offset:
            info.facts["elevation raised by"] = f"{np.degrees(self._offset):g} degrees"
        info.facts["IMU"] = describe_imu(imu) if imu is not None else "none"
        info.facts["reference poses"] = str(len(self.truth)) if self.truth is not None else "none"
        info.problems.extend(self._problems)
        return info

    def _read(self, file: Path, stamp: int) -> Scan:
        points = _read_points(file)
        if self._offset:
            points = raise_elevation(points, self._offset)
        if self._decision is None:
            return Scan(points=points, stamp=stamp)
        values = self._read_point_times(file, len(points))
        times, outlier = apply_times(values, stamp, self._decision)
        if outlier.any():
            points[outlier] = np.nan
        return Scan(points=points, stamp=stamp, times=times)

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
        """From the first sweep that has times; a missing file is a bad sweep, not the end."""
        message = ""
        for file, stamp in zip(self._files, self.stamps.tolist(), strict=True):
            try:
                values = self._read_point_times(file)
                return decide_times(values, stamp, field="t_ns", unit="ns")
            except DatasetError as error:
                message = message or str(error)
        raise DatasetError(f"{self._times_folder}: no usable point times; {message}")

    def _read_stamps(self) -> IntArray:
        path = self._root / "times.txt"
        kitti_path = self._root / "velodyne_points" / "timestamps.txt"
        if path.is_file():
            stamps = read_stamps(path)
        elif kitti_path.is_file():
            path = kitti_path
            stamps = _read_dates(path)
        else:
            self._problems.append("no times.txt: 10 Hz assumed")
            return np.arange(len(self._files), dtype=np.int64) * DEFAULT_PERIOD_NS
        if len(stamps) != len(self._files):
            raise DatasetError(
                f"{path}: {len(stamps)} stamps for {len(self._files)} sweeps; expected one line "
                "for each .bin file"
            )
        return stamps


def raise_elevation(points: NDArray[np.floating], angle: float) -> NDArray[np.floating]:
    """Turn every ray up by ``angle`` (rad), about the horizontal axis perpendicular to it."""
    horizontal = np.hypot(points[:, 0], points[:, 1])
    cosine, sine = np.cos(angle), np.sin(angle)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(horizontal > 0.0, cosine - sine * points[:, 2] / horizontal, 1.0)
    raised = np.empty_like(points)
    raised[:, :2] = points[:, :2] * scale[:, None]
    raised[:, 2] = np.where(
        horizontal > 0.0, cosine * points[:, 2] + sine * horizontal, points[:, 2]
    )
    return raised


def _read_points(file: Path) -> NDArray[np.float32]:
    try:
        size = file.stat().st_size
        if size % _POINT_BYTES:
            raise DatasetError(
                f"{file}: {size} bytes is not a multiple of {_POINT_BYTES} (float32 x y z "
                "intensity); the file is truncated or in another format"
            )
        values = np.fromfile(file, dtype="<f4").reshape(-1, 4)
    except OSError as error:
        raise DatasetError(f"{file}: cannot read the sweep: {error}") from error
    return np.ascontiguousarray(values[:, :3], dtype=np.float32)


def _find_sweeps(path: Path) -> Path:
    if not path.is_dir():
        what = "not a folder" if path.exists() else "no such folder"
        raise DatasetError(f"{path}: {what}; expected a folder with .bin sweeps")
    for name in _FOLDERS:
        folder = path / name
        if folder.is_dir() and next(folder.glob("*.bin"), None) is not None:
            return folder
    raise DatasetError(
        f"{path}: no .bin sweeps; looked in the folder itself, "
        f"{', '.join(name + '/' for name in _FOLDERS if name)}"
    )


def _root_of(folder: Path, given: Path) -> Path:
    """Folder of ``times.txt`` and the like, also when the sweep folder itself was given."""
    if folder != given:
        return given
    folder = folder.resolve()
    if folder.name in ("velodyne", "scans"):
        return folder.parent
    if folder.name == "data" and folder.parent.name == "velodyne_points":
        return folder.parent.parent
    return given


def _natural_order(file: Path) -> tuple[int, str]:
    """2.bin before 10.bin."""
    return (int(file.stem) if file.stem.isdecimal() else -1, file.name)


def _read_dates(path: Path) -> IntArray:
    """KITTI raw: ``2011-09-26 13:02:25.594360375`` per line, as nanoseconds since 1970 UTC."""
    stamps = []
    for number, line in enumerate(read_lines(path), start=1):
        date, _, fraction = line.strip().partition(".")
        try:
            moment = datetime.strptime(date, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            stamp = int(moment.timestamp()) * 10**9 + int(f"{fraction:0<9}"[:9])
            if abs(stamp) > MAX_STAMP:
                raise ValueError("out of range")
            stamps.append(stamp)
        except ValueError as error:
            raise DatasetError(
                f"{path}:{number}: expected a date and time, got {line.strip()[:80]!r}"
            ) from error
    return np.array(stamps, dtype=np.int64)
