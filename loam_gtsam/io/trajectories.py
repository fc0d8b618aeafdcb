"""Trajectories as text files that other tools read.

Poses are ``map_T_lidar`` (x forward, y left, z up) in all formats; no file has camera axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.io.atomic import write_text
from loam_gtsam.types import Trajectory, check_kind

_NS = 10**9
_ORDER = "the path comes first, and RunResult.trajectory is one"


def write_tum(
    path: str | Path,
    trajectory: Trajectory,
    *,
    comments: Mapping[str, str] | None = None,
    pose: str = "map_T_lidar",
) -> None:
    """Write ``stamp x y z qx qy qz qw`` per line (TUM format, as evo reads it).

    An attitude that is not known, as that of a prism or an antenna, is written as none at all: the
    quaternion 0 0 0 1, and a comment.

    Parameters
    ----------
    trajectory : stamps become seconds with nine decimals, exactly
    comments : written as ``# key: value`` at the top
    pose : what the poses are called there
    """
    check_kind(trajectory, Trajectory, "trajectory", _ORDER)
    notes = dict(comments or {}) | {"columns": f"stamp_s x y z qx qy qz qw ({pose})"}
    poses = trajectory.map_T_lidar
    rotations = poses[:, :3, :3].copy()
    unknown = ~np.isfinite(rotations).all(axis=(1, 2))
    rotations[unknown] = np.eye(3)
    if unknown.any():
        notes["attitude"] = f"not known in {np.count_nonzero(unknown)} lines (0 0 0 1)"
    lines = [f"# {key}: {' '.join(str(value).split())}" for key, value in notes.items()]
    quaternions = Rotation.from_matrix(rotations).as_quat() if len(poses) else []
    for stamp, xyz, quaternion in zip(
        trajectory.stamps.tolist(), poses[:, :3, 3], quaternions, strict=True
    ):
        numbers = [f"{value:.9f}" for value in xyz] + [f"{value:.12f}" for value in quaternion]
        lines.append(" ".join([stamp_text(stamp), *numbers]))
    write_text(path, "\n".join(lines) + "\n")


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write the upper three rows of each pose, row by row, 12 numbers a line (KITTI format).

    The axes are those of the lidar, not KITTI's camera.
    """
    check_kind(trajectory, Trajectory, "trajectory", _ORDER)
    rows = trajectory.map_T_lidar[:, :3, :].reshape(-1, 12).tolist()
    write_text(path, "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows))


def stamp_text(stamp: int) -> str:
    """Decimal seconds of integer nanoseconds; a float would round today's stamps to 0.2 us."""
    whole, rest = divmod(abs(stamp), _NS)
    return f"{'-' if stamp < 0 else ''}{whole}.{rest:09d}"
