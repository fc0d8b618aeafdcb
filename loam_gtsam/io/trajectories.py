"""Trajectories as text files that other tools read.

Poses are ``map_T_lidar`` (x forward, y left, z up) in all formats; no file has camera axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.io.atomic import write_text
from loam_gtsam.types import MAX_STAMP, DatasetError, Trajectory

_NS = 10**9


def write_tum(
    path: str | Path, trajectory: Trajectory, *, comments: Mapping[str, str] | None = None
) -> None:
    """Write ``stamp x y z qx qy qz qw`` per line (TUM format, as evo reads it).

    Parameters
    ----------
    trajectory : stamps become seconds with nine decimals, exactly
    comments : written as ``# key: value`` at the top

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    notes = dict(comments or {}) | {"columns": "stamp_s x y z qx qy qz qw (map_T_lidar)"}
    lines = [f"# {key}: {' '.join(str(value).split())}" for key, value in notes.items()]
    poses = trajectory.map_T_lidar
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat() if len(poses) else []
    for stamp, xyz, quaternion in zip(
        trajectory.stamps.tolist(), poses[:, :3, 3], quaternions, strict=True
    ):
        numbers = [f"{value:.9f}" for value in xyz] + [f"{value:.12f}" for value in quaternion]
        lines.append(" ".join([stamp_text(stamp), *numbers]))
    write_text(path, "\n".join(lines) + "\n")


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM file; stamps are exact to the nanosecond.

    Raises
    ------
    DatasetError
        If the file cannot be read, naming the line that does not fit.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot read the trajectory: {error}") from error
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            nanoseconds = Decimal(words[0]) * _NS
            if not abs(nanoseconds) <= MAX_STAMP:
                raise ValueError("out of range")
            stamp = int(nanoseconds.to_integral_value())
            row = [float(word) for word in words[1:]]
        except (ArithmeticError, ValueError) as error:
            raise DatasetError(f"{path}:{number}: not numbers: {line[:80]!r}") from error
        if len(row) != 7 or not np.isfinite(row).all() or not any(row[3:]):
            raise DatasetError(
                f"{path}:{number}: expected 8 finite numbers, stamp x y z qx qy qz qw with a "
                f"quaternion that is not zero; got {line[:80]!r}"
            )
        stamps.append(stamp)
        rows.append(row)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if rows:
        values = np.array(rows)
        poses[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
        poses[:, :3, 3] = values[:, :3]
    return Trajectory(np.array(stamps, np.int64), poses)


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write the upper three rows of each pose, row by row, 12 numbers a line (KITTI format).

    The axes are those of the lidar, not KITTI's camera.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    rows = trajectory.map_T_lidar[:, :3, :].reshape(-1, 12).tolist()
    write_text(path, "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows))


def stamp_text(stamp: int) -> str:
    """Decimal seconds of integer nanoseconds; a float would round today's stamps to 0.2 us."""
    whole, rest = divmod(abs(stamp), _NS)
    return f"{'-' if stamp < 0 else ''}{whole}.{rest:09d}"
