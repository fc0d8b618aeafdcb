"""A bag with the topics of LOAM's own front end: features and odometry, ready to map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from loam_gtsam.datasets.bags import bag_reader
from loam_gtsam.datasets.base import DatasetInfo, Loader
from loam_gtsam.datasets.decode import loam_messages
from loam_gtsam.datasets.decode.pointcloud2 import message_stamp
from loam_gtsam.datasets.decode.tables import describe_imu, describe_stamps
from loam_gtsam.types import BadSweep, DatasetError, FeatureSweep, ImuSamples, LoamError, Trajectory

MAPPED = "/aft_mapped_to_init"
_IMU = "sensor_msgs/msg/Imu"
_Asked = Literal["auto", "lidar", "loam"]


class LoamTopicsDataset(Loader):
    """De-skewed features and odometry poses of LOAM or A-LOAM, recorded in a bag.

    Parameters
    ----------
    path : ROS 1 or ROS 2 bag with ``/laser_cloud_corner_last``, ``/laser_cloud_surf_last``,
        ``/laser_odom_to_init`` and, optionally, ``/velodyne_cloud_3`` and ``/aft_mapped_to_init``
    axes : ``lidar`` (A-LOAM), ``loam`` (the original's camera-like axes), or ``auto``: the
        directions of a spinning lidar's points spread least along its vertical axis
    imu_topic : whose roll and pitch the mapping uses, as laserMapping does; the one with the most
        messages if None, if there is any

    Attributes
    ----------
    axes : what was decided
    unmatched : topic -> messages without partners within 5 ms, of the last full iteration

    Notes
    -----
    Whatever comes out is in lidar axes (x forward, y left, z up).

    Raises
    ------
    DatasetError
        If the bag cannot be opened, a topic is missing or the axes cannot be told.
    """

    truth: Trajectory | None = None
    """The result of LOAM itself is ``recorded``."""

    def __init__(
        self, path: str | Path, *, axes: _Asked = "auto", imu_topic: str | None = None
    ) -> None:
        if axes not in ("auto", "lidar", "loam"):
            raise DatasetError(f"axes: expected one of auto, lidar, loam; got {axes!r}")
        self._path = Path(path)
        self.name = self._path.stem
        self.sensor: Mapping[str, Any] = {}
        self.unmatched: dict[str, int] = {}
        self._problems: list[str] = []
        with closing(bag_reader.open_bag(self._path, problems=self._problems)) as reader:
            self._types = bag_reader.topic_types(reader)
        if missing := [topic for topic in loam_messages.REQUIRED if topic not in self._types]:
            listing = ", ".join(f"{name} ({kind})" for name, (kind, _) in self._types.items())
            text = f"no topic {', '.join(missing)}; the bag has: {listing or 'none'}"
            raise DatasetError(f"{self._path}: {text}")
        self.imu_topic: str | None = None
        if imu_topic is not None or any(kind == _IMU for kind, _ in self._types.values()):
            choice = self._path, self._types, _IMU, imu_topic, self._problems
            self.imu_topic = bag_reader.choose_topic(*choice)
        self._topics = list(loam_messages.REQUIRED)
        self._topics += [loam_messages.CLOUD] if loam_messages.CLOUD in self._types else []
        self.axes: Literal["lidar", "loam"] = axes if axes != "auto" else self._decide_axes()
        self._decoder = loam_messages.FeatureDecoder(self.axes)

    def __len__(self) -> int:
        """Most sweeps there can be: the count of the rarest topic."""
        return min(self._types[topic][1] for topic in self._topics)

    def __iter__(self) -> Iterator[FeatureSweep | BadSweep]:
        matcher = loam_messages.StampMatcher(self._topics)
        for message in bag_reader.read_messages(self._path, self._topics, self._problems):
            if isinstance(message, BadSweep):
                yield message
                continue
            try:
                group = matcher.add(message.topic, message_stamp(message.content), message.content)
            except DatasetError as error:
                yield BadSweep(message.received, f"{self._path}: {error}")
                continue
            if group is not None:
                yield self._sweep(group)
        self.unmatched = matcher.finish()

    @cached_property
    def imu(self) -> ImuSamples | None:
        """All samples of the IMU topic, in the axes of the IMU, not in LOAM's; None without it."""
        if self.imu_topic is None:
            return None
        return bag_reader.read_imu(self._path, self.imu_topic, self._problems)

    @cached_property
    def recorded(self) -> Trajectory | None:
        """LOAM's own mapped poses (``/aft_mapped_to_init``), for comparison, or None."""
        if MAPPED not in self._types:
            return None
        found = []
        for message in bag_reader.read_messages(self._path, [MAPPED], self._problems):
            if isinstance(message, bag_reader.Message):
                try:
                    pose = self._decoder.pose(MAPPED, message.content)
                    found.append((message_stamp(message.content), pose))
                except DatasetError as error:
                    self._problems.append(f"left out: {error}")
        stamps = np.array([stamp for stamp, _ in found], dtype=np.int64)
        return Trajectory(stamps, np.reshape([pose for _, pose in found], (-1, 4, 4)))

    def info(self) -> DatasetInfo:
        """Description of the bag; reads the recorded poses of LOAM if there are any."""
        facts = {"sweeps": f"up to {len(self)}", "axes": self.axes}
        facts["topics"] = ", ".join(f"{topic} ({self._types[topic][1]})" for topic in self._topics)
        problems: list[str] = []
        tolerance = f"{loam_messages.STAMP_TOLERANCE_NS * 1e-6:g} ms"
        if self.recorded is not None:
            facts["recorded result"] = f"{MAPPED}, {len(self.recorded)} poses"
            describe_stamps(self.recorded.stamps, facts, problems)
        imu = self.imu  # first: it may find problems
        facts["IMU"] = describe_imu(imu)
        if self.imu_topic is not None:
            facts["IMU topic"] = self.imu_topic
        known = *self._topics, MAPPED, self.imu_topic
        if others := [name for name in self._types if name not in known]:
            facts["not used"] = ", ".join(others)
        if len({self._types[topic][1] for topic in self._topics}) > 1:
            problems.append(
                "the topics have different numbers of messages; those without partners within "
                f"{tolerance} are left out"
            )
        if loam_messages.CLOUD not in self._topics:
            problems.append(f"no {loam_messages.CLOUD}: no full-resolution cloud")
        problems += [
            f"{count} messages of {topic} without partners within {tolerance}, left out"
            for topic, count in self.unmatched.items()
            if count
        ]
        kind = f"{bag_reader.bag_kind(self._path)} with LOAM topics"
        return DatasetInfo(kind, str(self._path), facts, problems + self._problems)

    def _sweep(self, group: Mapping[str, Any]) -> FeatureSweep | BadSweep:
        try:
            return self._decoder.sweep(group)
        except LoamError as error:
            return BadSweep(message_stamp(group[loam_messages.ODOMETRY]), f"{self._path}: {error}")

    def _decide_axes(self) -> Literal["lidar", "loam"]:
        topic = loam_messages.CLOUD if loam_messages.CLOUD in self._types else loam_messages.PLANES
        spread = None
        for message in bag_reader.read_messages(self._path, [topic], []):
            if isinstance(message, bag_reader.Message):
                with suppress(DatasetError):  # it becomes a bad sweep of the run
                    points = loam_messages.finite_points(topic, message.content)
                    spread = loam_messages.directions_spread(points)
            if spread is not None:
                break
        try:
            return loam_messages.decide_axes(topic, spread)
        except DatasetError as error:
            raise DatasetError(f"{self._path}: {error}") from error
