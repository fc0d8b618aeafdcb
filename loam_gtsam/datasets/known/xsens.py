"""``xsens_imu.csv`` of MulRan and HeLiPR."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.decode.tables import clean_imu, read_lines, read_table
from loam_gtsam.types import FloatArray, ImuSamples, IntArray

_COLUMNS = "ns qx qy qz qw ex ey ez ax ay az bx by bz cx cy cz"
_TRIPLES = {"columns 9 to 11": slice(7, 10), "columns 15 to 17": slice(13, 16)}
_ACCELERATION = slice(10, 13)
_WINDOW = 0.3
"""Seconds over which the gyro is compared with the orientation."""
_CLEARLY = 0.5
"""The gyro's distance from the rates of the orientation is below this share of the other's."""


def read_xsens(path: Path, problems: list[str]) -> ImuSamples | None:
    """Orientation, gyro and accelerometer, or None if the gyro cannot be told.

    The 17 columns are nanoseconds, quaternion x y z w, Euler angles, then gyro, accelerometer and
    magnetometer. The file players of both data sets read the gyro from columns 9 to 11. evalio
    (0.6) reads HeLiPR's from columns 15 to 17, which are the players' magnetometer; all agree that
    12 to 14 are the accelerometer. The rates at which the orientation of the same file turns
    decide.
    """
    lines = read_lines(path)
    if lines and len(lines[0].split(",")) == 8:
        problems.append(f"{path.name}: without gyro and accelerometer (8 columns), left out")
        return None
    stamps, values = read_table(path, _COLUMNS, ",")
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
    return clean_imu(stamps, samples, problems)


def _gyro_columns(stamps: IntArray, values: FloatArray) -> str | None:
    """Name of the three columns that are the gyro: their mean is nearest to the turn rate.

    The turn rate is that of the orientation over a window: the noise of the orientation counts less
    the longer the window is.
    """
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
