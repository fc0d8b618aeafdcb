"""Reference poses of any data set: from a file of numbers, or from a topic of a bag."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from loam_gtsam.datasets.decode import tables
from loam_gtsam.datasets.decode.extrinsics import moved_to_lidar
from loam_gtsam.datasets.decode.geodesy import east_north_up
from loam_gtsam.datasets.decode.pointcloud2 import message_stamp
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.types import BadSweep, DatasetError, FloatArray, IntArray, Trajectory

_BAGS = (".bag", ".mcap", ".db3")
_POSES: dict[str, Callable[[Any], Any]] = {
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
    "geometry_msgs/msg/TransformStamped": lambda message: message.transform,
}
_FIX = "sensor_msgs/msg/NavSatFix"
_EXPECTED = (
    "TUM (t x y z qx qy qz qw), positions (t x y z), EuRoC (csv: ns, x y z, qw qx qy qz), KITTI "
    "(12 numbers for each sweep), or a bag with a topic of PoseStamped, Odometry or NavSatFix"
)
_SECONDS_DIGITS = 14
"""A first column of more digits, without a point, is nanoseconds."""


def read_truth(
    path: str | Path,
    *,
    topic: str | None = None,
    body_T_lidar: FloatArray | None = None,
    stamps: IntArray | None = None,
    problems: list[str] | None = None,
) -> Trajectory:
    """Read reference poses of the lidar.

    Positions alone (a file of ``t x y z``, GPS) have NaN as their orientation, and with
    ``body_T_lidar`` they are those of a :attr:`~loam_gtsam.Trajectory.point` beside the lidar.

    Parameters
    ----------
    path : file, or bag
    topic : of a bag; the only one of a fitting type if None
    body_T_lidar : (4, 4) pose of the lidar in the frame whose poses the file has; the same frame if
        None
    stamps : (N,) nanoseconds of the sweeps, for files without stamps (KITTI)
    problems : gets a sentence for whatever had to be put right

    Raises
    ------
    DatasetError
        If the file cannot be read, is of no known format, or has no poses.
    """
    path, problems = Path(path), [] if problems is None else problems
    if path.suffix in _BAGS or (path / "metadata.yaml").is_file():
        found, poses = _of_bag(path, topic, problems)
    elif topic is not None:
        raise DatasetError(f"{path}: a topic belongs to a bag, and this is none")
    else:
        found, poses = _of_text(path, stamps, problems)
    if not len(found):
        raise DatasetError(f"{path}: no poses")
    truth = tables.sorted_trajectory(found, poses, path.name, problems)
    return truth if body_T_lidar is None else moved_to_lidar(truth, body_T_lidar)


def extrinsic(text: str) -> FloatArray:
    """(4, 4) of ``x y z``, ``x y z qx qy qz qw``, or 12 or 16 numbers row by row.

    Commas may stand between the numbers. Raises DatasetError if they are no rigid transform.
    """
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
        if len(numbers) == 3:
            numbers += [0.0, 0.0, 0.0, 1.0]
        if len(numbers) == 7:
            return tables.pose_matrix(numbers)
        if len(numbers) in (12, 16):
            return tables.rigid_matrix(numbers[:12])
        raise ValueError(f"{len(numbers)} numbers")
    except ValueError as error:
        raise DatasetError(
            "extrinsic: expected x y z, x y z qx qy qz qw, or the 12 numbers of a 3 x 4 matrix, "
            f"got {text!r}: {error}"
        ) from error


def _of_text(
    path: Path, stamps: IntArray | None, problems: list[str]
) -> tuple[IntArray, FloatArray]:
    lines = [line.strip() for line in tables.read_lines(path)]
    rows = [line for line in lines if line and line[0] in "+-.0123456789"]
    if not rows:
        raise DatasetError(f"{path}: no numbers; expected {_EXPECTED}")
    separator = "," if "," in rows[0] else None
    width = len(rows[0].split(separator))
    first = rows[0].split(separator)[0].strip()
    nanoseconds = first.isdigit() and len(first) > _SECONDS_DIGITS
    if width == 12 and separator is None:
        return _without_stamps(path, rows, stamps, problems)
    if separator == "," and nanoseconds and width >= 8:  # EuRoC: the real part comes first
        return _table(path, rows, separator, nanoseconds, (0, 1, 2, 4, 5, 6, 3))
    if width == 9 and separator == ",":
        return tables.read_pose_table(path, "secs nsecs x y z qx qy qz qw", ",")
    if width in (4, 8):
        return _table(path, rows, separator, nanoseconds, range(width - 1))
    raise DatasetError(f"{path}: lines of {width} columns; expected {_EXPECTED}")


def _table(
    path: Path, rows: list[str], separator: str | None, nanoseconds: bool, order: Sequence[int]
) -> tuple[IntArray, FloatArray]:
    stamps, poses = [], []
    for row in rows:
        cells = row.split(separator)
        try:
            numbers = [float(cells[1 + column]) for column in order]
            stamps.append(
                tables.whole_number(cells[0]) if nanoseconds else tables.seconds_to_ns(cells[0])
            )
            poses.append(_pose(numbers))
        except (ValueError, IndexError) as error:
            raise DatasetError(
                f"{path}: {row[:80]!r}: {str(error)[:80]}; expected lines like the first one"
            ) from error
    return np.array(stamps, np.int64), np.array(poses, np.float64)


def _pose(numbers: Sequence[float]) -> FloatArray:
    """Of position and quaternion x y z w, or of the position alone."""
    if len(numbers) == 7:
        return tables.pose_matrix(numbers)
    if not np.isfinite(numbers).all():
        raise ValueError("NaN or infinity")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.nan, numbers
    return pose


def _without_stamps(
    path: Path, rows: list[str], stamps: IntArray | None, problems: list[str]
) -> tuple[IntArray, FloatArray]:
    if stamps is None or len(rows) != len(stamps):
        known = "unknown" if stamps is None else str(len(stamps))
        raise DatasetError(
            f"{path}: {len(rows)} poses without stamps, one is needed for each sweep; the number "
            f"of sweeps with known stamps is {known}"
        )
    try:
        whole = [tables.rigid_matrix([float(word) for word in row.split()]) for row in rows]
    except ValueError as error:
        raise DatasetError(
            f"{path}: expected 12 numbers of a rigid transform in every line: {str(error)[:80]}"
        ) from error
    problems.append(
        f"{path.name}: without stamps, so its poses are taken to be those at the stamps of the "
        "sweeps; if they are of another moment of the sweep (ours: deskew.reference), the motion "
        "in between passes for error"
    )
    return stamps, inverse_pose(whole[0]) @ np.array(whole)


def _of_bag(path: Path, topic: str | None, problems: list[str]) -> tuple[IntArray, FloatArray]:
    from loam_gtsam.datasets.bags import bag_reader

    with closing(bag_reader.open_bag(path)) as reader:
        topics = bag_reader.topic_types(reader)
    fitting = [name for name, (kind, _) in topics.items() if kind in (*_POSES, _FIX)]
    listing = ", ".join(f"{name} ({kind})" for name, (kind, _) in topics.items()) or "none"
    if topic is None and len(fitting) != 1:
        which = "no topic" if not fitting else "several topics"
        raise DatasetError(f"{path}: {which} of reference poses; name one; the bag has: {listing}")
    chosen = topic or fitting[0]
    if chosen not in fitting:
        raise DatasetError(
            f"{path}: topic {chosen!r} is none of {', '.join([*_POSES, _FIX])}; the bag has: "
            f"{listing}"
        )
    kind, stamps, rows = topics[chosen][0], [], []
    for message in bag_reader.read_messages(path, [chosen], problems):
        if isinstance(message, BadSweep) or (kind == _FIX and message.content.status.status < 0):
            continue
        content = message.content
        stamps.append(message_stamp(content))
        if kind == _FIX:
            rows.append([content.latitude, content.longitude, content.altitude])
            continue
        pose = _POSES[kind](content)
        place = getattr(pose, "position", None) or pose.translation
        turn = getattr(pose, "orientation", None) or pose.rotation
        rows.append([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])
    if kind == _FIX and rows:
        rows = east_north_up(np.array(rows, np.float64)).tolist()
    try:
        poses = np.array([_pose(row) for row in rows], np.float64).reshape(-1, 4, 4)
    except ValueError as error:
        raise DatasetError(f"{path}, topic {chosen}: {error}") from error
    return np.array(stamps, np.int64), poses
