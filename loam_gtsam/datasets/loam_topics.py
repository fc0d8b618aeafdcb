"""A bag with the topics of LOAM's own front end: features and odometry, ready to map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from loam_gtsam.datasets.bag_reader import (
    Message,
    bag_kind,
    open_bag,
    read_messages,
    topic_types,
)
from loam_gtsam.datasets.base import DatasetInfo
from loam_gtsam.datasets.pointcloud2 import NO_TIMES, decode_pointcloud2, message_stamp
from loam_gtsam.datasets.tables import describe_stamps, poses_from_quaternions
from loam_gtsam.types import (
    BadSweep,
    DatasetError,
    Features,
    FeatureSweep,
    FloatArray,
    ImuSamples,
    LoamError,
    Trajectory,
)

EDGES = "/laser_cloud_corner_last"
PLANES = "/laser_cloud_surf_last"
ODOMETRY = "/laser_odom_to_init"
CLOUD = "/velodyne_cloud_3"
MAPPED = "/aft_mapped_to_init"
REQUIRED = (EDGES, PLANES, ODOMETRY)

STAMP_TOLERANCE_NS = 5_000_000
"""Messages of one sweep agree to this (LOAM, laserMapping: 0.005 s)."""
_WAITING = 100
"""Messages of a topic kept while their partners are missing."""
_FLATNESS = 0.85
"""The vertical axis must spread this much less than the next: beams fan out by at most +-45
degrees, so their directions vary by at most 0.7 of what the azimuth makes of the other two."""

# x_loam = left, y_loam = up, z_loam = forward
_LIDAR_R_LOAM: FloatArray = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


class LoamTopicsDataset:
    """De-skewed features and odometry poses of LOAM or A-LOAM, recorded in a bag.

    Parameters
    ----------
    path : ROS 1 or ROS 2 bag with ``/laser_cloud_corner_last``, ``/laser_cloud_surf_last``,
        ``/laser_odom_to_init`` and, optionally, ``/velodyne_cloud_3`` and ``/aft_mapped_to_init``
    axes : ``lidar`` (A-LOAM), ``loam`` (the original's camera-like axes), or ``auto``: the
        directions of a spinning lidar's points spread least along its vertical axis

    Attributes
    ----------
    axes : what was decided
    unmatched : topic -> messages without partners within 5 ms, of the last full iteration

    Notes
    -----
    Everything that comes out is in lidar axes (x forward, y left, z up).

    Raises
    ------
    DatasetError
        If the bag cannot be opened, a topic is missing or the axes cannot be told.
    """

    def __init__(
        self, path: str | Path, *, axes: Literal["auto", "lidar", "loam"] = "auto"
    ) -> None:
        if axes not in ("auto", "lidar", "loam"):
            raise DatasetError(f"axes: expected one of auto, lidar, loam; got {axes!r}")
        self._path = Path(path)
        self.name = self._path.stem
        self.sensor: Mapping[str, Any] = {}
        self.unmatched: dict[str, int] = {}
        self._problems: list[str] = []
        with closing(open_bag(self._path)) as reader:
            self._types = topic_types(reader)
        missing = [topic for topic in REQUIRED if topic not in self._types]
        if missing:
            listing = ", ".join(f"{name} ({kind})" for name, (kind, _) in self._types.items())
            raise DatasetError(
                f"{self._path}: no topic {', '.join(missing)}; the bag has: {listing or 'none'}"
            )
        self._topics = [*REQUIRED, CLOUD] if CLOUD in self._types else list(REQUIRED)
        self.axes: str = axes if axes != "auto" else self._decide_axes()
        self._lidar_R_bag: FloatArray = _LIDAR_R_LOAM if self.axes == "loam" else np.eye(3)

    def __len__(self) -> int:
        """Most sweeps there can be: the count of the rarest topic."""
        return min(self._types[topic][1] for topic in self._topics)

    def __iter__(self) -> Iterator[FeatureSweep | BadSweep]:
        matcher = _StampMatcher(self._topics)
        for message in read_messages(self._path, self._topics, self._problems):
            if isinstance(message, BadSweep):
                yield message
                continue
            try:
                group = matcher.add(message.topic, message_stamp(message.content), message)
            except DatasetError as error:
                yield BadSweep(message.received, f"{self._path}: {error}")
                continue
            if group is not None:
                yield self._sweep(group)
        self.unmatched = matcher.finish()

    @property
    def imu(self) -> ImuSamples | None:
        """None: LOAM's front end has used the IMU already."""
        return None

    @property
    def truth(self) -> Trajectory | None:
        """None: see ``recorded`` for LOAM's own result."""
        return None

    @cached_property
    def recorded(self) -> Trajectory | None:
        """LOAM's own mapped poses (``/aft_mapped_to_init``), for comparison, or None."""
        if MAPPED not in self._types:
            return None
        stamps, poses = [], []
        for message in read_messages(self._path, [MAPPED], self._problems):
            if isinstance(message, BadSweep):
                continue
            try:
                pose = self._pose(message)
            except DatasetError as error:
                self._problems.append(f"left out: {error}")
                continue
            stamps.append(message_stamp(message.content))
            poses.append(pose)
        return Trajectory(
            np.array(stamps, dtype=np.int64), np.array(poses, dtype=float).reshape(-1, 4, 4)
        )

    def info(self) -> DatasetInfo:
        """What was understood; reads LOAM's own poses if they are there."""
        facts = {"sweeps": f"up to {len(self)}", "axes": self.axes}
        facts["topics"] = ", ".join(f"{topic} ({self._types[topic][1]})" for topic in self._topics)
        problems: list[str] = []
        if self.recorded is not None:
            facts["recorded result"] = f"{MAPPED}, {len(self.recorded)} poses"
            describe_stamps(self.recorded.stamps, facts, problems)
        others = [name for name in self._types if name not in (*self._topics, MAPPED)]
        if others:
            facts["not used"] = ", ".join(others)
        counts = {self._types[topic][1] for topic in self._topics}
        if len(counts) > 1:
            problems.append(
                "the topics have different numbers of messages; those without partners within "
                f"{STAMP_TOLERANCE_NS * 1e-6:g} ms are left out"
            )
        if CLOUD not in self._topics:
            problems.append(f"no {CLOUD}: no full-resolution cloud")
        problems += [
            f"{count} messages of {topic} without partners within "
            f"{STAMP_TOLERANCE_NS * 1e-6:g} ms, left out"
            for topic, count in self.unmatched.items()
            if count
        ]
        return DatasetInfo(
            f"{bag_kind(self._path)} with LOAM topics",
            str(self._path),
            facts,
            problems + self._problems,
        )

    def _sweep(self, group: Mapping[str, Message]) -> FeatureSweep | BadSweep:
        stamp = message_stamp(group[ODOMETRY].content)
        try:
            return FeatureSweep(
                features=Features.from_points(
                    stamp, self._points(group[EDGES]), self._points(group[PLANES])
                ),
                odom_T_lidar=gtsam.Pose3(self._pose(group[ODOMETRY])),
                cloud=self._points(group[CLOUD]) if CLOUD in group else None,
            )
        except LoamError as error:
            return BadSweep(stamp, f"{self._path}: {error}")

    def _points(self, message: Message) -> NDArray[np.floating]:
        points = self._raw_points(message)
        # x_loam, y_loam, z_loam = left, up, forward; a permutation is exact
        return np.ascontiguousarray(points[:, [2, 0, 1]]) if self.axes == "loam" else points

    def _raw_points(self, message: Message) -> NDArray[np.floating]:
        try:
            # These clouds are de-skewed; whatever looks like a time in them is none.
            points: NDArray[np.floating] = decode_pointcloud2(
                message.content, time_field=NO_TIMES
            ).points
        except LoamError as error:
            raise DatasetError(f"topic {message.topic}: {error}") from error
        return points[np.flatnonzero(np.isfinite(points).all(axis=1))]

    def _pose(self, message: Message) -> FloatArray:
        pose = message.content.pose.pose
        p, q = pose.position, pose.orientation
        bag_T = poses_from_quaternions(
            np.array([[p.x, p.y, p.z]]), np.array([[q.x, q.y, q.z, q.w]]), f"topic {message.topic}"
        )[0]
        change = np.eye(4)
        change[:3, :3] = self._lidar_R_bag
        converted: FloatArray = change @ bag_T @ change.T
        return converted

    def _decide_axes(self) -> str:
        topic = CLOUD if CLOUD in self._types else PLANES
        spread = None
        for message in read_messages(self._path, [topic], []):
            if isinstance(message, BadSweep):
                continue
            try:
                points = self._raw_points(message).astype(np.float64)
            except DatasetError:
                continue  # it becomes a bad sweep of the run
            ranges = np.linalg.norm(points, axis=1)
            if (ranges > 0.0).sum() < 100:  # too few to speak of a spread
                continue
            directions = points[ranges > 0.0] / ranges[ranges > 0.0, None]
            spread = directions.std(axis=0)
            break
        if spread is not None:
            order = np.argsort(spread)
            if spread[order[0]] < _FLATNESS * spread[order[1]] and order[0] in (1, 2):
                return "lidar" if order[0] == 2 else "loam"
        raise DatasetError(
            f"{self._path}: cannot tell the axes of {topic} (spread of the directions along x, y, "
            f"z: {'unknown' if spread is None else np.round(spread, 3).tolist()}); give "
            "axes='lidar' (A-LOAM) or axes='loam' (the original LOAM)"
        )


@dataclass(slots=True)
class _StampMatcher:
    """Groups messages of several topics whose stamps agree."""

    topics: list[str]
    waiting: dict[str, dict[int, Message]] = field(init=False)
    unmatched: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        self.waiting = {topic: {} for topic in self.topics}
        self.unmatched = dict.fromkeys(self.topics, 0)

    def add(self, topic: str, stamp: int, message: Message) -> dict[str, Message] | None:
        """The group this message completes, if it does; older messages are then given up."""
        own = self.waiting[topic]
        if stamp in own or len(own) >= _WAITING:
            del own[stamp if stamp in own else min(own)]
            self.unmatched[topic] += 1
        own[stamp] = message
        nearest = {}
        for other, stamps in self.waiting.items():
            best = min(stamps, key=lambda s: abs(s - stamp), default=None)
            if best is None:
                return None
            nearest[other] = best
        if max(nearest.values()) - min(nearest.values()) > STAMP_TOLERANCE_NS:
            return None
        group = {other: self.waiting[other].pop(best) for other, best in nearest.items()}
        for other, best in nearest.items():
            for old in [s for s in self.waiting[other] if s < best]:
                del self.waiting[other][old]
                self.unmatched[other] += 1
        return group

    def finish(self) -> dict[str, int]:
        """Counts, with what is still waiting."""
        return {topic: self.unmatched[topic] + len(self.waiting[topic]) for topic in self.topics}
