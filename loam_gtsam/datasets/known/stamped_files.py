"""Data sets with one file per sweep, named by the stamp of the sweep."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from loam_gtsam.datasets.base import DatasetInfo, SweepFiles
from loam_gtsam.datasets.decode.extrinsics import describe_extrinsics
from loam_gtsam.datasets.decode.packed_points import PackedCloud
from loam_gtsam.datasets.decode.point_times import TimeDecision, check_time_options
from loam_gtsam.datasets.decode.pointcloud2 import decode_with_times, describe_fields
from loam_gtsam.datasets.decode.tables import describe_imu, describe_stamps, read_lines
from loam_gtsam.types import (
    MAX_STAMP,
    DatasetError,
    ImuSamples,
    IntArray,
    Scan,
    Trajectory,
)

_TRIED = 10
"""Sweeps looked at, at most, to decide on times."""


class StampedFiles(SweepFiles):
    """A data set with one file per sweep.

    Parameters
    ----------
    path : as the user gave it
    kind : name of the data set
    folder : of the files
    pattern : of their names
    stamp_of : nanoseconds of a file, from its name without suffix; raises ValueError
    """

    def __init__(
        self,
        path: Path,
        kind: str,
        folder: Path,
        pattern: str,
        stamp_of: Callable[[str], int],
    ) -> None:
        self._path, self._kind, self._folder = path, kind, folder
        self.name = path.resolve().name or "sweeps"
        self.sensor: Mapping[str, Any] = {}
        self._extrinsics_source = ""
        self._problems: list[str] = []
        found = []
        for file in folder.glob(pattern):
            try:
                stamp = stamp_of(file.stem)
                if abs(stamp) > MAX_STAMP:
                    raise ValueError("out of range")
                found.append((stamp, file))
            except ValueError as error:
                raise DatasetError(
                    f"{file}: expected a name that is the stamp of the sweep: {error}"
                ) from error
        if not found:
            raise DatasetError(f"{folder}: no sweeps ({pattern})")
        found.sort()
        self._files = [file for _, file in found]
        self.stamps = np.array([stamp for stamp, _ in found], dtype=np.int64)

    @property
    @abstractmethod
    def imu(self) -> ImuSamples | None:
        """All IMU data if there is any."""

    @property
    @abstractmethod
    def truth(self) -> Trajectory | None:
        """Poses of the lidar if the data comes with them."""

    @abstractmethod
    def _sweep_facts(self) -> dict[str, str]:
        """Label and text of the facts about the points."""

    def info(self) -> DatasetInfo:
        """Description of the files; reads the first sweeps, the IMU and the reference poses."""
        imu, truth = self.imu, self.truth  # first: they may find problems
        info = DatasetInfo(self._kind, str(self._path), {"sweeps": str(len(self))})
        describe_stamps(self.stamps, info.facts, info.problems)
        info.facts |= self._sweep_facts()
        info.facts["IMU"] = describe_imu(imu) if imu is not None else "none"
        if imu is not None and self._extrinsics_source:
            info.facts["IMU to lidar"] = describe_extrinsics(self.sensor, self._extrinsics_source)
        info.facts["reference poses"] = str(len(truth)) if truth is not None else "none"
        info.problems.extend(self._problems)
        return info


class PackedFiles(StampedFiles):
    """A data set whose files hold fields as a PointCloud2 does, the times of the points included.

    Parameters
    ----------
    read : makes the cloud of a file with its stamp
    time_unit, stamp_is : see :func:`~loam_gtsam.datasets.decode.pointcloud2.decode_pointcloud2`
    """

    def __init__(
        self,
        path: Path,
        kind: str,
        folder: Path,
        pattern: str,
        stamp_of: Callable[[str], int],
        *,
        read: Callable[[Path, int], PackedCloud],
        time_unit: str | None,
        stamp_is: str | None,
    ) -> None:
        check_time_options(time_unit, stamp_is)
        super().__init__(path, kind, folder, pattern, stamp_of)
        self._unpack = read
        self._decode = partial(decode_with_times, time_unit=time_unit, stamp_is=stamp_is)

    def _read(self, file: Path, stamp: int) -> Scan:
        cloud = self._unpack(file, stamp)
        return self._decode(cloud, decision=self._first[0]).scan

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

    def _sweep_facts(self) -> dict[str, str]:
        decision, fields = self._first
        return {"fields": fields, "point times": str(decision or "none")}


def missing_files(listing: Path | None, sensor: str, stamps: IntArray) -> list[str]:
    """A problem if a list of ``stamp,sensor`` rows names sweeps that have no file."""
    if listing is None:
        return []
    listed = [
        int(stamp)
        for stamp, _, name in (line.partition(",") for line in read_lines(listing))
        if name.strip() == sensor and stamp.strip().isdecimal()
    ]
    missing = np.setdiff1d(np.array(listed, np.int64), stamps)
    if len(missing) == 0:
        return []
    return [f"{listing.name} lists {len(missing)} sweeps without a file, the first {missing[0]}"]
