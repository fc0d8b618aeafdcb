"""Data sets with one file per sweep, named by its stamp; ``xsens_imu.csv`` beside some of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.base import DatasetInfo, SweepFiles
from loam_gtsam.datasets.decode import extrinsics, tables
from loam_gtsam.datasets.decode.packed_points import PackedCloud, firing_by_firing
from loam_gtsam.datasets.decode.point_times import ANCHORS, TimeDecision, check_time_options
from loam_gtsam.datasets.decode.pointcloud2 import decode_with_times, describe_fields
from loam_gtsam.types import (
    MAX_STAMP,
    DatasetError,
    FloatArray,
    ImuSamples,
    IntArray,
    Scan,
    Trajectory,
)

_NAMES = {
    "MICROSECONDS": r"(-?\d+)",
    "NANOSECONDS": r"(-?\d+)",
    "SECONDS.NANOSECONDS": r"(?:cloud_)?(\d+)[._](\d{9})",
    "cloud_SECONDS_NANOSECONDS": r"cloud_(\d+)_(\d{1,9})",
}
BEAMS, COLUMNS, PERIOD = 64, 1024, 0.1
"""Ouster's OS1-64 at 10 Hz: points of a sweep come firing by firing, 64 each, in 0.1 s."""
_TRIED = 10  # sweeps looked at, at most, to decide on times
_XSENS = "ns qx qy qz qw ex ey ez ax ay az bx by bz cx cy cz"
_TRIPLES = {"columns 9 to 11": slice(7, 10), "columns 15 to 17": slice(13, 16)}
_ACCELERATION = slice(10, 13)
_WINDOW = 0.3  # seconds over which the gyro is compared with the orientation
_CLEARLY = 0.5
"""The gyro's distance from the rates of the orientation is below this share of the other's."""


class StampedFiles(SweepFiles):
    """A data set with one file per sweep, whose fields are those of a PointCloud2.

    Parameters
    ----------
    path, rig : as the user gave it; of the data set
    folder, pattern : of the files
    read : makes the cloud of a file with its stamp
    name : of a file, without suffix: ``MICROSECONDS``, ``NANOSECONDS``, ``SECONDS.NANOSECONDS``
        or ``cloud_SECONDS_NANOSECONDS``
    imu, truth : files of the IMU (``xsens_imu.csv``, unless a subclass reads another one) and of
        the reference poses, or None
    in_order : whether sweeps without times of points are complete ones of an OS1-64, firing by
        firing
    time_unit, stamp_is : see :func:`~loam_gtsam.datasets.decode.pointcloud2.decode_pointcloud2`
    """

    def __init__(
        self,
        path: Path,
        rig: extrinsics.Rig,
        folder: Path,
        pattern: str,
        read: Callable[[Path, int], PackedCloud],
        *,
        name: str = "NANOSECONDS",
        imu: Path | None = None,
        truth: Path | None = None,
        in_order: bool = False,
        time_unit: str | None = None,
        stamp_is: str | None = None,
    ) -> None:
        check_time_options(time_unit, stamp_is)
        self._path, self._rig, self._folder, self._unpack = path, rig, folder, read
        self._imu_file, self._truth_file = imu, truth
        self._in_order, self._stamp_is = in_order, stamp_is or "start"
        self._decode = partial(decode_with_times, time_unit=time_unit, stamp_is=stamp_is)
        self.name = path.resolve().name or "sweeps"
        self.sensor: Mapping[str, Any] = extrinsics.extrinsic_settings(rig.lidar_T_imu)
        # macOS's ._*.bin are no sweeps
        files = [file for file in folder.glob(pattern) if not file.name.startswith(".")]
        found = sorted((_stamp(file, name), file) for file in files)
        if not found:
            raise DatasetError(f"{folder}: no sweeps ({pattern})")
        self._files = [file for _, file in found]
        self.stamps = np.array([stamp for stamp, _ in found], dtype=np.int64)
        self._problems: list[str] = []

    @cached_property
    def imu(self) -> ImuSamples | None:
        """Of its file, or None."""
        return None if self._imu_file is None else self._read_imu(self._imu_file)

    @cached_property
    def truth(self) -> Trajectory | None:
        """Reference poses, moved to the lidar; None without their file."""
        if self._truth_file is None:
            return None
        return extrinsics.moved_to_lidar(self._read_truth(self._truth_file), self._rig.body_T_lidar)

    def info(self) -> DatasetInfo:
        """Description of the files; reads the first sweeps, the IMU and the reference poses."""
        imu, truth = self.imu, self.truth  # first: they may find problems
        info = DatasetInfo(self._rig.kind, str(self._path), {"sweeps": str(len(self))})
        tables.describe_stamps(self.stamps, info.facts, info.problems)
        decision, info.facts["fields"] = self._first
        info.facts["point times"] = str(decision or "none")
        if decision is None and self._in_order:
            info.facts["point times"] = (
                f"from the order of the points, {COLUMNS} firings in {PERIOD:g} s, stamp at sweep "
                f"{self._stamp_is}"
            )
        info.facts["IMU"] = tables.describe_imu(imu)
        if imu is not None:
            where = extrinsics.describe_extrinsics(self.sensor, self._rig.source)
            info.facts["IMU to lidar"] = where
        info.facts["reference poses"] = str(len(truth)) if truth is not None else "none"
        info.problems.extend(self._problems)
        return info

    def _read_imu(self, path: Path) -> ImuSamples | None:
        return read_xsens(path, self._problems)

    def _read_truth(self, path: Path) -> Trajectory:
        return tables.read_poses(path, self._problems)

    def _look_for_missing(self, listing: Path | None, sensor: str) -> None:
        """A problem if a list of ``stamp,sensor`` rows names sweeps without a file, or no stamp."""
        if listing is None:
            return
        rows = [line.partition(",") for line in tables.read_lines(listing)]
        listed, wrong = [], 0
        for stamp, _, name in rows:
            if name.strip() == sensor:
                try:
                    listed.append(tables.whole_number(stamp))
                except ValueError:
                    wrong += 1
        if wrong:
            self._problems.append(f"{listing.name}: {wrong} rows of {sensor} without a valid stamp")
        missing = np.setdiff1d(np.array(listed, np.int64), self.stamps)
        if len(missing):
            self._problems.append(
                f"{listing.name} lists {len(missing)} sweeps without a file, the first {missing[0]}"
            )

    def _read(self, file: Path, stamp: int) -> Scan:
        cloud = self._unpack(file, stamp)
        decision, _ = self._first
        if decision is not None or not self._in_order:
            return self._decode(cloud, decision=decision).scan
        scan = self._decode(firing_by_firing(cloud, BEAMS, COLUMNS, str(file))).scan
        column = np.arange(BEAMS * COLUMNS) % COLUMNS  # of a range image, row by row
        return replace(scan, times=PERIOD * (column / COLUMNS - ANCHORS[self._stamp_is]))

    @cached_property
    def _first(self) -> tuple[TimeDecision | None, str]:
        """How the times are read, and the fields: from the first sweep that can be read."""
        message = ""
        for file, stamp in zip(self._files[:_TRIED], self.stamps.tolist(), strict=False):
            try:
                cloud = self._unpack(file, stamp)
                return self._decode(cloud).decision, describe_fields(cloud)
            except DatasetError as error:
                message = message or str(error)
        raise DatasetError(f"{self._folder}: no usable sweep among the first {_TRIED}; {message}")


def _stamp(file: Path, name: str) -> int:
    match = re.fullmatch(_NAMES[name], file.stem)
    reason = f"{file.stem} is not {name}"
    if match is not None:
        *seconds, nanoseconds = map(int, match.groups())
        stamp = sum(seconds) * 10**9 + nanoseconds * (1000 if name == "MICROSECONDS" else 1)
        if abs(stamp) <= MAX_STAMP:
            return stamp
        reason = "out of range"
    raise DatasetError(f"{file}: expected a name that is the stamp of the sweep: {reason}")


def read_xsens(path: Path, problems: list[str]) -> ImuSamples | None:
    """Orientation, gyro and accelerometer, or None if the gyro cannot be told.

    The players of both data sets read the gyro from columns 9 to 11 of 17, evalio (0.6) HeLiPR's
    from the players' magnetometer, 15 to 17: the turning of the file's own orientation decides.
    """
    lines = tables.read_lines(path)
    if lines and len(lines[0].split(",")) == 8:
        problems.append(f"{path.name}: without gyro and accelerometer (8 columns), left out")
        return None
    stamps, values = tables.read_table(path, _XSENS, ",")
    where = _gyro_columns(stamps, values)
    if where is None:
        problems.append(
            f"{path.name}: neither columns 9 to 11 nor 15 to 17 follow the rates of the "
            "orientation, so the gyro cannot be told: left out"
        )
        return None
    if where != next(iter(_TRIPLES)):
        problems.append(f"{path.name}: the gyro is in {where}, not where the file player reads it")
    samples = np.hstack([values[:, :4], values[:, _TRIPLES[where]], values[:, _ACCELERATION]])
    return tables.clean_imu(stamps, samples, problems)


def _gyro_columns(stamps: IntArray, values: FloatArray) -> str | None:
    """The columns whose mean is nearest to the turn rate of the orientation over a window."""
    order = np.argsort(stamps, kind="stable")
    seconds = (stamps[order] - stamps[order[0]]) * 1e-9 if len(order) else np.zeros(0)
    last = np.searchsorted(seconds, seconds + _WINDOW)
    first = np.flatnonzero(last < len(seconds))
    last = last[first]
    if len(first) == 0:
        return None
    values = values[order]
    known = np.linalg.norm(values[:, :4], axis=1) > 1e-12
    world_R_imu = Rotation.from_quat(np.where(known[:, None], values[:, :4], [0.0, 0.0, 0.0, 1.0]))
    turned = (world_R_imu[first].inv() * world_R_imu[last]).as_rotvec()
    rates = turned / (seconds[last] - seconds[first])[:, None]
    total = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    means = (total[last] - total[first]) / (last - first)[:, None]
    distance = {
        name: float(np.median(np.linalg.norm(means[:, columns] - rates, axis=1)))
        for name, columns in _TRIPLES.items()
    }
    nearest, other = sorted(distance, key=distance.__getitem__)
    return nearest if distance[nearest] < _CLEARLY * distance[other] else None
