"""ROS 1, ROS 2 and MCAP bags with sweeps, without ROS; those of known rigs.

Sweeps are ``PointCloud2``, or the ``CustomMsg`` of Livox.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from loam_gtsam.datasets.bags import bag_reader
from loam_gtsam.datasets.base import BagOptions, DatasetInfo, Loader
from loam_gtsam.datasets.decode import (
    aiding,
    extrinsics,
    livox,
    pointcloud2,
    sweep_parts,
    tables,
)
from loam_gtsam.datasets.decode.aiding import GnssFixes, WheelSamples
from loam_gtsam.datasets.decode.point_times import (
    IGNORE_TIMES,
    TimeDecision,
    check_time_options,
    shorter_period,
    span_problem,
    usual_step,
)
from loam_gtsam.types import BadSweep, DatasetError, ImuSamples, LoamError, Scan, Trajectory

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
IMU = "sensor_msgs/msg/Imu"
_PEEK = 10  # sweeps looked at before the run, to decide on times and to describe the bag


class BagDataset(Loader):
    """Sweeps and IMU of a bag, read message by message.

    Parameters
    ----------
    path : ROS 1 ``.bag``, ROS 2 bag folder, or a single ``.mcap`` / ``.db3``
    parts : the bags of a recording that was split; ``path`` then only names them
    options : ``topic``, ``imu_topic``, ``gnss_topic``, ``wheels_topic``, ``time_field``,
        ``time_unit``, ``stamp_is``: see
        :class:`~loam_gtsam.datasets.base.BagOptions`

    Raises
    ------
    DatasetError
        If the bag cannot be opened, a topic is not there, or no sweep of its beginning can be
        decoded.
    """

    def __init__(
        self, path: str | Path, *, parts: Sequence[Path] = (), **options: Unpack[BagOptions]
    ) -> None:
        if unknown := options.keys() - BagOptions.__annotations__.keys():
            raise TypeError(f"unexpected keyword arguments: {', '.join(sorted(unknown))}")
        topic, imu_topic = options.pop("topic", None), options.pop("imu_topic", None)
        gnss_topic = options.pop("gnss_topic", None)
        wheels_topic = options.pop("wheels_topic", None)
        check_time_options(options.get("time_unit"), options.get("stamp_is"))
        self._path, self._parts = Path(path), tuple(parts)
        self.name = self._path.stem
        self.sensor: Mapping[str, Any] = {}
        self._options: pointcloud2.TimeOptions = options
        self._problems: list[str] = []
        with closing(bag_reader.open_bag(self._path, self._parts, self._problems)) as reader:
            topics = bag_reader.topic_types(reader)
        choose = partial(bag_reader.choose_topic, self._path, topics, problems=self._problems)
        kind = bag_reader.first_kind(topics, (POINT_CLOUD, *livox.KINDS), topic)
        self.topic = choose(kind or POINT_CLOUD, topic)
        if kind in livox.KINDS and options.get("time_unit") is None:
            options["time_unit"] = livox.TIME_UNIT
        self.imu_topic = None
        if imu_topic is not None or any(kind == IMU for kind, _ in topics.values()):
            self.imu_topic = choose(IMU, imu_topic)
        self.gnss_topic = bag_reader.find_topic(choose, topics, (aiding.FIX,), gnss_topic)
        kinds = aiding.TWIST, aiding.ODOMETRY
        self.wheels_topic = bag_reader.find_topic(choose, topics, kinds, wheels_topic)
        self._count = topics[self.topic][1]
        self._decision: TimeDecision | None = None
        self._peek()

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Scan | BadSweep]:
        offset = self._clock_offset
        for message in self._messages(self.topic, self._problems):
            if isinstance(message, BadSweep):
                yield replace(message, stamp=message.stamp + offset)
                continue
            try:
                scan = self._decode(message).scan
                offset = scan.stamp - message.received
                yield scan
            except LoamError as error:
                stamp = message.received + offset
                yield BadSweep(stamp, f"{self._path}, topic {self.topic}: {error}")

    @cached_property
    def imu(self) -> ImuSamples | None:
        """All samples of the IMU topic, or None; reads them at the first access."""
        if self.imu_topic is None:
            return None
        return bag_reader.read_imu(self._path, self.imu_topic, self._problems, self._parts)

    @cached_property
    def gnss(self) -> GnssFixes | None:
        """All fixes of the GNSS topic, or None; reads them at the first access."""
        if self.gnss_topic is None:
            return None
        messages = self._contents(self.gnss_topic)
        return aiding.fixes_of(messages, self.gnss_topic, self._problems)

    @cached_property
    def wheels(self) -> WheelSamples | None:
        """The way by the wheels' topic, or None; reads it at the first access."""
        if self.wheels_topic is None:
            return None
        messages = self._contents(self.wheels_topic)
        return aiding.wheels_of(messages, self.wheels_topic, self._problems)

    def _contents(self, topic: str) -> list[Any]:
        found = list(self._messages(topic, self._problems))
        good = [message.content for message in found if not isinstance(message, BadSweep)]
        if lost := len(found) - len(good):
            self._problems.append(f"{topic}: {lost} messages cannot be read")
        return good

    @property
    def truth(self) -> Trajectory | None:
        """None: a bag of sweeps carries no reference poses."""
        return None

    def info(self) -> DatasetInfo:
        """Description of the bag; reads the first sweeps and the IMU topic."""
        imu, _ = self.imu, self.gnss  # first: they may find problems
        facts = dict(self._facts)
        if self.imu_topic is not None:
            facts["IMU topic"] = self.imu_topic
        facts["IMU"] = tables.describe_imu(imu)
        if self.gnss_topic is not None:
            facts["GNSS"] = aiding.describe_fixes(self.gnss, self.gnss_topic)
        if self.wheels_topic is not None:
            facts["wheels"] = f"{self.wheels_topic}; --wheels uses it"
        kind = bag_reader.bag_kind(self._parts[0] if self._parts else self._path)
        return DatasetInfo(kind, str(self._path), facts, list(self._problems))

    def _messages(self, topic: str, problems: list[str]) -> Iterator[bag_reader.Message | BadSweep]:
        return bag_reader.read_messages(self._path, [topic], problems, self._parts)

    def _decode(self, message: bag_reader.Message) -> pointcloud2.Decoded:
        cloud, how = message.content, self._decision
        return pointcloud2.decode_with_times(cloud, decision=how, **self._options)

    def _peek(self) -> None:
        """Decide on the times, once for the whole run, and collect what there is to say."""
        decoded: list[pointcloud2.Decoded] = []
        stamps: list[int] = []
        received: list[int] = []
        frames = Counter[str]()
        failure = fields = ""
        for message in islice(self._messages(self.topic, []), _PEEK):
            if isinstance(message, BadSweep):
                failure = failure or message.message
                continue
            received.append(message.received)
            frames[str(getattr(message.content.header, "frame_id", "")).strip("/")] += 1
            try:
                decoded.append(self._decode(message))
            except LoamError as error:
                failure = failure or str(error)
                continue
            if not stamps:
                fields = pointcloud2.describe_fields(message.content)
                # A sweep that cannot be read has only a receive time; this leads to the stamps'.
                self._clock_offset = decoded[0].scan.stamp - message.received
            stamps.append(decoded[-1].scan.stamp)
        if not decoded:
            text = f"no sweep can be decoded: {failure or 'it has no messages'}"
            hint = sweep_parts.packets_hint(received)
            raise DatasetError(f"{self._path}, topic {self.topic}: {text}{hint}")
        if problem := span_problem((d.scan.times for d in decoded), usual_step(stamps)):
            raise DatasetError(f"{self._path}, topic {self.topic}: {problem}; give {IGNORE_TIMES}")
        # The last one: near time zero an absolute time can still look like an offset.
        self._decision = next((d.decision for d in reversed(decoded) if d.decision), None)
        if self._decision is None:
            self.sensor = shorter_period(stamps)
        self._facts = {"topic": self.topic, "sweeps": str(self._count)}
        tables.describe_stamps(np.array(stamps, dtype=np.int64), self._facts, self._problems)
        self._facts |= {
            "stamps": f"from {stamps[0] * 1e-9:.6f} s",
            "fields": fields,
            "points": f"{len(decoded[0].scan.points)} in the first sweep",
            "point times": str(self._decision or "none recorded"),
            "rings": _describe_rings(decoded[0].scan),
        }
        if problem := sweep_parts.sweep_problem(frames, [d.scan for d in decoded]):
            self._problems.append(problem)
        if self._decision is None and self._options.get("time_field") != pointcloud2.NO_TIMES:
            self._problems.append("no per-point time field: times can only come from the azimuth")
        if outliers := sum(d.outliers for d in decoded):
            self._problems.append(
                f"{outliers} points of the first {len(decoded)} sweeps have a time far outside "
                "their sweep and are left out"
            )


class BagSequence(BagDataset):
    """Bags recorded by a known rig, whose topics are the default, with a file of its ``truth``."""

    def __init__(
        self,
        path: Path,
        parts: Sequence[Path],
        rig: extrinsics.Rig,
        truth: Path | None,
        **options: Unpack[BagOptions],
    ) -> None:
        with closing(bag_reader.open_bag(path, parts)) as reader:
            known = set(reader.topics)
        options["topic"] = options.get("topic") or (rig.topic if rig.topic in known else None)
        if not options.get("imu_topic") and rig.imu_topic in known:
            options["imu_topic"] = rig.imu_topic
        super().__init__(path, parts=parts, **options)
        self._rig, self._truth_file = rig, truth
        self._truth_source = "" if truth is None else truth.name
        self.name = path.resolve().name if path.is_dir() else path.stem
        if self.imu_topic == rig.imu_topic:
            self.sensor = {**self.sensor, **extrinsics.extrinsic_settings(rig.lidar_T_imu)}
        elif self.imu_topic is not None:
            self._problems.append(
                f"IMU: not the {rig.imu_topic} of {rig.kind}, so its rotation to the lidar is "
                "unknown: set imu.lidar_R_imu_deg"
            )

    @cached_property
    def truth(self) -> Trajectory | None:
        """The reference poses, moved to the lidar; None without their file."""
        if self._truth_file is None:
            return None
        poses = tables.read_poses(self._truth_file, self._problems)
        return extrinsics.moved_to_lidar(poses, self._rig.body_T_lidar)

    def info(self) -> DatasetInfo:
        """Description of the bags, with their extrinsics and reference poses."""
        truth = self.truth  # first: it may find problems
        info = super().info()
        info.kind = f"{self._rig.kind}, {info.kind}"
        if len(self._parts) > 1:
            info.facts["bags"] = f"{self._parts[0].name} and {len(self._parts) - 1} more"
        if "imu.lidar_t_imu" in self.sensor:
            where = extrinsics.describe_extrinsics(self.sensor, self._rig.source)
            info.facts["IMU to lidar"] = where
        info.facts["reference poses"] = "none"
        if truth is not None:
            info.facts["reference poses"] = f"{len(truth)} ({self._truth_source})"
        return info


def _describe_rings(scan: Scan) -> str:
    if scan.rows:
        return f"{scan.rows} rows of a range image"
    if scan.rings is None or len(scan.rings) == 0:
        return "none"
    return f"field, {len(np.unique(scan.rings))} beams ({scan.rings.min()} .. {scan.rings.max()})"
