"""Bags of every kind as a stream of messages; damage becomes a message of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import ReaderError as ReaderError1
from rosbags.rosbag2 import ReaderError as ReaderError2
from rosbags.serde import SerdeError
from rosbags.typesys import TypesysError

from loam_gtsam.datasets.bags.rosbag_files import RosbagFiles
from loam_gtsam.datasets.decode import aiding, livox
from loam_gtsam.datasets.decode.pointcloud2 import decode_imu
from loam_gtsam.datasets.decode.tables import DEFAULT_PERIOD_NS, clean_imu
from loam_gtsam.errors import nearest
from loam_gtsam.types import BadSweep, DatasetError, ImuSamples

MAPPED = ("/laser_cloud_map", "/laser_cloud_surround", "/velodyne_cloud_registered")
"""Topics on which LOAM and A-LOAM publish clouds in the map."""
_MOST = 2**63 - 1
"""Neither a length nor nanoseconds are larger; a bag without messages starts there."""
_SENTENCES = ReaderError1, ReaderError2, SerdeError, TypesysError
_LONGEST = 500  # letters of what a reader says of a damaged bag, parts of which it may quote


_OPTIONS = {
    "sensor_msgs/msg/Imu": "--imu-topic",
    aiding.FIX: "--gnss-topic",
    aiding.TWIST: "--wheels-topic",
    aiding.ODOMETRY: "--wheels-topic",
}


@dataclass(frozen=True, slots=True)
class Message:
    """A deserialised message with its topic and receive time (ns)."""

    topic: str
    received: int
    content: Any


def open_bag(
    path: Path, parts: Sequence[Path] = (), problems: list[str] | None = None
) -> RosbagFiles:
    """An opened reader of a bag, or of ``parts`` that ``path`` names; DatasetError if damaged.

    ``problems`` gets what it cannot read.
    """
    bags = list(parts or [path])
    if missing := [bag for bag in bags if not bag.exists()]:
        raise DatasetError(f"{missing[0]}: no such bag")
    unread = _write_ahead_logs(bags)
    if problems is not None:
        problems += [text for text in unread if text not in problems]
    try:
        reader = RosbagFiles(bags)
        try:
            check_metadata(reader)
        except BaseException:
            reader.close()
            raise
    # Damage surfaces as whatever its parser stumbles over (struct, sqlite3, yaml, assertions ...).
    except Exception as error:
        what = "; ".join([_reason(error), *(unread or _remedy(error))])
        raise DatasetError(f"{path}: cannot open the bag: {what}") from error
    return reader


def _write_ahead_logs(bags: Sequence[Path]) -> list[str]:
    """What is said of logs beside databases, whose messages rosbags does not read."""
    files = (
        file for bag in bags for file in (sorted(bag.glob("*.db3")) if bag.is_dir() else [bag])
    )
    logs = [(file, file.with_name(f"{file.name}-wal")) for file in files]
    return [
        f"{log.name} ({log.stat().st_size} bytes) is not read and may hold the newest messages: "
        "the recording still goes on, or was killed. When it has ended, `sqlite3 "
        f"{file.name} 'pragma wal_checkpoint(truncate)'` moves them into the bag"
        for file, log in logs
        if log.is_file() and log.stat().st_size
    ]


def _remedy(error: Exception) -> list[str]:
    """What can be done about a bag that cannot be opened, if anything."""
    text = str(error)
    if "Profile is not" in text:
        return ["MCAP files of ROS 2 are read; of one of ROS 1, give the .bag that it was made of"]
    if isinstance(error, PermissionError) or "not supported" in text:
        return []
    return [
        "if the recording was cut off, `rosbag reindex` (ROS 1), `ros2 bag reindex` or `mcap "
        "recover` may repair it"
    ]


def check_metadata(reader: RosbagFiles) -> None:
    """ValueError unless the names and numbers of messages that a bag states make sense."""
    for connection in reader.connections:
        name, count = connection.topic, connection.msgcount
        for what, text in (("name", name), ("type", connection.msgtype)):
            if not isinstance(text, str):
                raise ValueError(f"expected the {what} of a topic, its metadata have {text!r}")
        if not isinstance(count, int) or not 0 <= count < _MOST:
            raise ValueError(f"topic {name}: expected a number of messages, got {count!r}")
    if not isinstance(reader.start_time, int) or abs(reader.start_time) > _MOST:
        raise ValueError(f"expected a start in nanoseconds, got {reader.start_time!r}")


def topic_types(reader: RosbagFiles) -> dict[str, tuple[str, int]]:
    """Topic -> (message type, number of messages)."""
    return dict(reader.topics)


def choose_topic(
    path: Path,
    topics: Mapping[str, tuple[str, int]],
    kind: str,
    asked: str | None,
    problems: list[str],
) -> str:
    """The topic asked for, or the one of type ``kind`` with the most messages."""
    listing = ", ".join(f"{name} ({what}, {count})" for name, (what, count) in topics.items())
    if asked is not None:
        if asked not in topics:
            near = nearest(asked, topics, listing=False)
            raise DatasetError(
                f"{path}: no topic {asked!r}; the bag has: {listing or 'none'}{near}"
            )
        if (what := topics[asked][0]) != kind:
            problem = f"topic {asked!r} is {what}, expected {kind}; the bag has: {listing}"
            raise DatasetError(f"{path}: {problem}")
        return asked
    candidates = [name for name, (what, _) in topics.items() if what == kind]
    if not candidates:
        kinds = [what.lower() for what, _ in topics.values()]
        packets = any("packet" in k or (k.endswith("scan") and "laser" not in k) for k in kinds)
        hint = "; raw packets become PointCloud2 with the driver of the sensor" if packets else ""
        there = f"the bag has: {listing or 'no messages'}{hint}"
        raise DatasetError(f"{path}: no topic of type {kind}; {there}")
    option = _OPTIONS.get(kind, "--topic")
    measured = [name for name in candidates if name not in MAPPED] or candidates
    chosen = max(measured, key=lambda name: topics[name][1])  # the first of equals
    if chosen in MAPPED:
        text = "its sweeps are de-skewed and lie in a map; do not map them again"
        problems.append(f"{chosen}: {text}")
    if len(candidates) > 1:
        counts = ", ".join(f"{name}: {topics[name][1]}" for name in candidates)
        problems.append(
            f"{len(candidates)} {kind.rsplit('/', 1)[-1]} topics ({counts}); took {chosen}, "
            f"{option} chooses another"
        )
    return chosen


def first_kind(
    topics: Mapping[str, tuple[str, int]], kinds: Sequence[str], asked: str | None
) -> str | None:
    """The first of some types of which a bag has a topic, or the topic that is asked for is."""
    there = {kind for name, (kind, _) in topics.items() if asked in (None, name)}
    return next((kind for kind in kinds if kind in there), None)


def find_topic(
    choose: Callable[[str, str | None], str],
    topics: Mapping[str, tuple[str, int]],
    kinds: Sequence[str],
    asked: str | None,
) -> str | None:
    """A topic of the first of some types that a bag has, None if it has none of them.

    ``choose`` is :func:`choose_topic` of the bag; a topic that is ``asked`` for must be of one.
    """
    kind = first_kind(topics, kinds, asked)
    return None if kind is None and asked is None else choose(kind or kinds[-1], asked)


def read_messages(
    path: Path, topics: list[str], problems: list[str], parts: Sequence[Path] = ()
) -> Iterator[Message | BadSweep]:
    """Messages in the order they were received; ``parts`` as for :func:`open_bag`.

    One that cannot be deserialised is a :class:`BadSweep`; one ends the stream of a damaged file.
    """
    with closing(open_bag(path, parts, problems)) as reader:
        stream, came = reader.messages(topics), Counter[str]()
        last, interval = reader.start_time, DEFAULT_PERIOD_NS
        while True:
            try:
                connection, received, raw = next(stream)
            except StopIteration:
                promised = {name: count for name, (_, count) in reader.topics.items()}
                missing = _missing(path, {t: promised.get(t, 0) for t in topics}, came)
                problems += [text for text in missing if text not in problems]
                return
            except Exception as error:  # as in open_bag
                when = f"damaged after {last * 1e-9:.3f} s"
                text = f"{path}: {when}, the rest is lost: {_reason(error)}"
                if text not in problems:
                    problems.append(text)
                yield BadSweep(last + interval, text)  # when the next one was due
                return
            interval = received - last if received > last else interval
            last = received
            came[connection.topic] += 1
            try:
                if connection.msgtype in livox.KINDS:
                    content: Any = livox.read_custom(raw, cdr=reader.is2)
                else:
                    content = reader.deserialize(raw, connection.msgtype)
            except Exception as error:
                text = f"{path}, topic {connection.topic}: cannot deserialise: {_reason(error)}"
                yield BadSweep(received, text)
                continue
            yield Message(connection.topic, received, content)


def _missing(path: Path, promised: Mapping[str, int], came: Mapping[str, int]) -> list[str]:
    """What is said of topics that were read to the end and have fewer messages than promised."""
    return [
        f"{came.get(topic, 0)} of {count} messages of {topic} came; the metadata of {path.name} "
        "promise more than its files hold, or files are cut off: copy the recording once more, or "
        "`ros2 bag reindex` (ROS 2), `rosbag reindex` (ROS 1)"
        for topic, count in promised.items()
        if came.get(topic, 0) < count
    ]


def read_imu(
    path: Path, topic: str, problems: list[str], parts: Sequence[Path] = ()
) -> ImuSamples | None:
    """All samples of an IMU topic, put in order; what had to be put right goes to ``problems``."""
    rows, lost = [], 0
    for message in read_messages(path, [topic], problems, parts):
        if isinstance(message, BadSweep):
            lost += 1
        else:
            rows.append(decode_imu(message.content))
    if lost:
        problems.append(f"IMU: {lost} messages cannot be read")
    stamps = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    values = np.array([row for _, row in rows], dtype=np.float64).reshape(-1, 10)
    return clean_imu(stamps, values, problems)


def bag_kind(path: Path) -> str:
    """Name of the kind of file, e.g. ``ROS 1 bag``."""
    return {".bag": "ROS 1 bag", ".mcap": "MCAP file"}.get(path.suffix, "ROS 2 bag")


def _reason(error: Exception) -> str:
    """What a reader stumbled over; its own sentences stand without the name of their class."""
    text = str(error).rstrip(".")
    if isinstance(error, UnicodeDecodeError):
        text = "its first bytes are not those of a bag"
    elif not isinstance(error, _SENTENCES):
        text = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return text[:_LONGEST]
