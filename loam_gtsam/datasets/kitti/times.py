"""Stamps of KITTI's sweeps, and how long a turn of its scanner lasts."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from loam_gtsam.datasets.decode.point_times import SWEEP_SECONDS
from loam_gtsam.datasets.decode.tables import DEFAULT_PERIOD_NS, read_lines, read_stamps
from loam_gtsam.types import MAX_STAMP, DatasetError, IntArray

_RAW = "velodyne_points"


def sweep_stamps(root: Path, files: Sequence[Path], problems: list[str]) -> IntArray:
    """Nanoseconds of each sweep.

    Parameters
    ----------
    root : holds ``times.txt`` or, of a raw drive, ``velodyne_points/timestamps.txt``
    files : the sweeps
    problems : is appended to

    Raises
    ------
    DatasetError
        If the numbers of stamps and sweeps differ, or a line does not fit.
    """
    path, raw = root / "times.txt", root / _RAW / "timestamps.txt"
    if path.is_file():
        stamps = read_stamps(path)
    elif raw.is_file():
        path, listed = raw, read_dates(raw)
        stamps = _of_files(listed, files)
        if missing := len(listed) - len(stamps):
            problems.append(f"{missing} sweeps of {path.name} have no file")
    else:
        problems.append("no times.txt: 10 Hz assumed")
        return np.arange(len(files), dtype=np.int64) * DEFAULT_PERIOD_NS
    if len(stamps) != len(files):
        raise DatasetError(
            f"{path}: {len(stamps)} stamps for {len(files)} sweeps; expected one line for each "
            ".bin file"
        )
    return stamps


def turn_seconds(
    root: Path, files: Sequence[Path], stamps: IntArray, problems: list[str]
) -> float | None:
    """Median duration of a sweep of a raw drive; None if it does not tell.

    Raises
    ------
    DatasetError
        If the lists of starts and ends do not fit the sweeps.
    """
    paths = [root / _RAW / f"timestamps_{end}.txt" for end in ("start", "end")]
    if not all(path.is_file() for path in paths):
        return None
    first, last = (_of_files(read_dates(path), files) for path in paths)
    if not len(first) == len(last) == len(files):
        raise DatasetError(
            f"{paths[0]}, {paths[1].name}: {len(first)} and {len(last)} stamps for "
            f"{len(files)} sweeps"
        )
    seconds = float(np.median(last - first)) * 1e-9
    if not SWEEP_SECONDS[0] <= seconds <= SWEEP_SECONDS[1]:
        raise DatasetError(f"{paths[1]}: sweeps of {seconds:g} s (median), expected about 0.1")
    outside = int(np.count_nonzero((stamps < first) | (stamps > last)))
    if outside:
        problems.append(f"{outside} stamps lie outside their sweep's start and end")
    return round(seconds, 6)


def read_dates(path: Path) -> IntArray:
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


def _of_files(listed: IntArray, files: Sequence[Path]) -> IntArray:
    """Stamps of the files of a drive, of all its listed ones: some drives lack a few sweeps."""
    numbers = [int(file.stem) if file.stem.isdecimal() else -1 for file in files]
    if len(listed) > len(numbers) and min(numbers) >= 0 and max(numbers) < len(listed):
        return listed[numbers]
    return listed
