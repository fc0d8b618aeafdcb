"""Small text files of numbers, IMU samples, and the stamps of both."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from decimal import Decimal
from pathlib import Path
from typing import TypeVar

import gtsam
import numpy as np

from loam_gtsam.geometry import is_rigid
from loam_gtsam.types import (
    MAX_STAMP,
    DatasetError,
    FloatArray,
    ImuSamples,
    IntArray,
    Trajectory,
)

DEFAULT_PERIOD_NS = 100_000_000
"""10 Hz, the usual rate of a spinning lidar."""
STANDARD_GRAVITY = 9.80665  # m/s^2, CGPM 1901
_ABSURD = 1e6  # rad/s and m/s^2 that no IMU measures
UNIT_TOLERANCE = 0.1
"""Limit by which the length of a quaternion may differ from one for it to be an orientation."""

_WHOLE = re.compile(r"[+-]?[0-9]+")
_SLOW = 2.0  # seconds from a sweep to the next, above which the unit of the stamps is doubted
_HUGE = 1e100  # its square is finite
_LONGEST = 40  # characters of a number: of any stamp, with zeros before it

_Row = TypeVar("_Row")


def whole_number(text: str, unit: int = 1, most: int = MAX_STAMP) -> int:
    """Decimal digits as so many ``unit``; a ValueError unless it is within ``most`` of zero."""
    word = text.strip()
    if not _WHOLE.fullmatch(word):
        raise ValueError(f"not a whole number: {_shown(word)}")
    if len(word) > _LONGEST or abs(number := int(word) * unit) > most:
        raise ValueError(f"out of range: {_shown(word)}")
    return number


def seconds_to_ns(text: str) -> int:
    """Decimal seconds as integer nanoseconds; no detour over binary floating point."""
    word = text.strip()
    try:
        nanoseconds = Decimal(word) * 10**9
        # before it becomes an integer, which may have a million digits
        if not abs(nanoseconds) <= MAX_STAMP:
            hint = "; nanoseconds?" if _WHOLE.fullmatch(word) else ""
            raise ValueError(f"out of range: {_shown(word)}{hint}")
        return int(nanoseconds.to_integral_value())
    except ArithmeticError as error:
        raise ValueError(f"not a time in seconds: {_shown(word)}") from error


def _shown(word: str) -> str:
    return repr(word if len(word) <= _LONGEST else f"{word[:_LONGEST]}...")


def read_lines(path: Path) -> list[str]:
    """Lines of a text file without trailing blank ones, and without a byte order mark."""
    try:
        return path.read_text(encoding="utf-8-sig").rstrip().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot read: {error}") from error


def convert_lines(path: Path, convert: Callable[[str], _Row], expected: str) -> list[_Row]:
    """What ``convert`` makes of each line; a DatasetError names the line at its ValueError."""
    rows = []
    for number, line in enumerate(map(str.strip, read_lines(path)), start=1):
        try:
            rows.append(convert(line))
        except ValueError as error:
            raise DatasetError(
                f"{path}:{number}: expected {expected}, got {line[:80]!r}: {str(error)[:80]}"
            ) from error
    return rows


def read_stamps(path: Path) -> IntArray:
    """One time in seconds per line, as nanoseconds."""
    return np.array(convert_lines(path, seconds_to_ns, "a time in seconds"), dtype=np.int64)


def read_table(path: Path, columns: str, separator: str | None) -> tuple[IntArray, FloatArray]:
    """Stamps (N,) in ns and the other values (N, C) of a table; lines of ``#`` are left out.

    ``columns`` are the names, which may be a line of it: first ``t`` (seconds), ``ns`` or ``secs
    nsecs``, then finite numbers. A DatasetError names the line that does not fit.
    """
    width = len(columns.split()) - (2 if columns.startswith("secs") else 1)
    stamps, rows = _read_rows(path, columns, separator, _finite)
    return stamps, np.array(rows, dtype=np.float64).reshape(len(rows), width)


def read_pose_table(path: Path, columns: str, separator: str | None) -> tuple[IntArray, FloatArray]:
    """Stamps (N,) and poses (N, 4, 4) of a table whose last columns are ``x y z qx qy qz qw``."""
    stamps, poses = _read_rows(path, columns, separator, pose_matrix)
    return stamps, np.array(poses, dtype=np.float64).reshape(-1, 4, 4)


def read_tum(path: str | Path) -> Trajectory:
    """Read a trajectory in TUM format: ``t x y z qx qy qz qw`` per line, seconds and metres.

    Stamps are exact to the nanosecond. A DatasetError names the line that does not fit.
    """
    return Trajectory(*read_pose_table(Path(path), "t x y z qx qy qz qw", None))


def read_poses(path: Path, problems: list[str]) -> Trajectory:
    """Reference poses in order of time, of a table ``secs,nsecs,x,y,z,qx,qy,qz,qw`` or as TUM's."""
    first = next((line for line in read_lines(path) if not line.startswith("#")), "")
    clock, separator = ("secs nsecs", ",") if "," in first else ("t", None)
    stamps, poses = read_pose_table(path, f"{clock} x y z qx qy qz qw", separator)
    if len(stamps) == 0:
        raise DatasetError(f"{path}: no poses")
    return sorted_trajectory(stamps, poses, path.name, problems)


def pose_matrix(numbers: Sequence[float]) -> FloatArray:
    """(4, 4) transform of ``x y z qx qy qz qw``."""
    x, y, z, w = _finite(numbers)[3:]
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not 0.5 < length < 2.0:
        raise ValueError(f"quaternion of length {length:g}")
    pose = np.eye(4)
    pose[:3, :3] = gtsam.Rot3.Quaternion(w / length, x / length, y / length, z / length).matrix()
    pose[:3, 3] = numbers[:3]
    return pose


def rigid_matrix(numbers: Sequence[float]) -> FloatArray:
    """(4, 4) transform of the 12 numbers of its first three rows; ValueError if it is not rigid."""
    matrix = np.vstack([np.reshape(_finite(numbers), (3, 4)), [0.0, 0.0, 0.0, 1.0]])
    if not is_rigid(matrix):
        raise ValueError("no rigid transform")
    return matrix


def _finite(numbers: Sequence[float]) -> Sequence[float]:
    if not all(abs(number) < _HUGE for number in numbers):  # NaN compares false
        raise ValueError("NaN or infinity, or all but that")
    return numbers


def _read_rows(
    path: Path, columns: str, separator: str | None, convert: Callable[[Sequence[float]], _Row]
) -> tuple[IntArray, list[_Row]]:
    names = columns.split()

    def split(line: str) -> tuple[int, _Row] | None:
        cells = [cell.strip() for cell in line.split(separator)]
        if not line or line.startswith("#") or cells == names:
            return None
        if len(cells) != len(names):
            raise ValueError(f"{len(cells)} columns")
        numbers = [float(cell) for cell in cells[2 if names[0] == "secs" else 1 :]]
        return _stamp(names[0], cells), convert(numbers)

    unit = "; t in seconds" if names[0] == "t" else ""
    found = convert_lines(path, split, f"{len(names)} numbers ({columns}{unit})")
    rows = [row for row in found if row is not None]
    return np.array([stamp for stamp, _ in rows], np.int64), [row for _, row in rows]


def _stamp(clock: str, cells: list[str]) -> int:
    if clock == "t":
        return seconds_to_ns(cells[0])
    if clock == "ns":
        return whole_number(cells[0])
    return whole_number(str(whole_number(cells[0], 10**9) + whole_number(cells[1])))


def sorted_trajectory(
    stamps: IntArray, poses: FloatArray, source: str, problems: list[str]
) -> Trajectory:
    """Reference poses by time, each time once; what had to be put right goes to ``problems``."""
    rows = rows_in_time(stamps)
    if (np.diff(stamps) < 0).any():
        problems.append(f"{source}: poses out of order, sorted")
    if dropped := len(stamps) - len(rows):
        problems.append(f"{source}: {dropped} poses with a repeated stamp left out")
    return Trajectory(stamps[rows], poses[rows])


def rows_in_time(stamps: IntArray) -> IntArray:
    """Rows of stamps (N,) in order of time, the first one of each stamp."""
    order = np.argsort(stamps, kind="stable")
    later = np.diff(stamps[order], prepend=np.iinfo(np.int64).min // 2) > 0
    return np.asarray(order[later])


def read_imu(path: Path, problems: list[str]) -> ImuSamples | None:
    """Samples of ``t qx qy qz qw wx wy wz ax ay az``, or of EuRoC's ``ns wx wy wz ax ay az``."""
    first = next((line for line in read_lines(path) if not line.startswith("#")), "")
    if first.count(",") != 6:
        return clean_imu(*read_table(path, "t qx qy qz qw wx wy wz ax ay az", ","), problems)
    stamps, values = read_table(path, "ns wx wy wz ax ay az", ",")
    return clean_imu(stamps, np.hstack([np.zeros((len(values), 4)), values]), problems)


def clean_imu(stamps: IntArray, values: FloatArray, problems: list[str]) -> ImuSamples | None:
    """IMU samples in order of time, in SI units; what had to be put right goes to ``problems``.

    ``values`` (N, 10) are quaternion x y z w (zero where unknown), rad/s, m/s^2.
    """
    keep = np.flatnonzero((np.abs(values) < _ABSURD).all(axis=1))  # NaN compares false
    order = keep[rows_in_time(stamps[keep])]
    if dropped := len(stamps) - len(order):
        what = "with NaN, absurd values or a repeated stamp"
        problems.append(f"IMU: {dropped} samples {what} left out")
    if (np.diff(stamps) < 0).any():
        problems.append("IMU: stamps out of order, sorted")
    if len(order) == 0:
        problems.append("IMU: no usable samples")
        return None
    stamps, values = stamps[order], values[order]
    orientation, gyro, acceleration = values[:, :4].copy(), values[:, 4:7], values[:, 7:]
    norms = np.linalg.norm(orientation, axis=1, keepdims=True)
    bad = np.abs(norms[:, 0] - 1.0) > UNIT_TOLERANCE
    orientation[bad] = np.nan
    unknown = bool(2 * bad.sum() > len(bad))
    if unknown and norms.any():
        problems.append("IMU: no orientation in it (not of unit length)")
    elif not unknown and bad.any():
        problems.append(
            f"IMU: {bad.sum()} of {len(bad)} orientations are not of unit length, left out"
        )
    if is_in_g(acceleration):
        median = float(np.median(np.linalg.norm(acceleration, axis=1)))
        problems.append(f"IMU: acceleration of {median:.2f} at rest is in g, converted to m/s^2")
        acceleration = acceleration * STANDARD_GRAVITY
    return ImuSamples(stamps, None if unknown else orientation / norms, gyro, acceleration)


def is_in_g(acceleration: FloatArray) -> bool:
    """Whether (N, 3) accelerations, most of them near rest, are in g instead of m/s^2."""
    return bool(0.8 < np.median(np.linalg.norm(acceleration, axis=1)) < 1.2)


def describe_imu(samples: ImuSamples | None) -> str:
    """Count and rate of IMU samples as text."""
    if samples is None:
        return "none"
    orientation = f"{'without' if samples.orientation is None else 'with'} orientation"
    return f"{len(samples.stamps)} samples, {describe_rate(samples.stamps)}, {orientation}"


def describe_rate(stamps: IntArray) -> str:
    """Median rate as text."""
    steps = np.diff(stamps)
    median = float(np.median(steps)) if len(steps) else 0.0
    return f"{1e9 / median:.2f} Hz" if median > 0.0 else "unknown rate"


def describe_stamps(stamps: IntArray, facts: dict[str, str], problems: list[str]) -> None:
    """Range and rate of sweep stamps; disorder, gaps and a doubtful unit go to ``problems``."""
    if len(stamps) == 0:
        return
    facts["stamps"] = f"{stamps[0] * 1e-9:.6f} .. {stamps[-1] * 1e-9:.6f} s"
    facts["rate"] = describe_rate(stamps)
    steps = np.diff(stamps)
    if len(steps) and not steps.any():
        problems.append(
            f"all stamps are {stamps[0] * 1e-9:g} s: nothing says when the sweeps were measured, "
            "and only the first can be mapped; each needs a stamp of its own"
        )
        return
    median = float(np.median(steps)) if len(steps) else 0.0
    if median > _SLOW * 1e9:
        problems.append(
            f"a sweep comes each {median * 1e-9:g} s: if the lidar is not that slow, the stamps "
            "are in another unit"
        )
    # half a period late is jitter, a whole one is a missing sweep
    gap = 1.8 * max(median, 1.0) if len(steps) > 2 else np.inf
    for what, which in (
        ("equal the one before", steps == 0),
        ("are earlier than the one before", steps < 0),
        ("come after a gap", steps > gap),
    ):
        if which.any():
            problems.append(f"{which.sum()} stamps {what}, first at sweep {which.argmax() + 1}")
