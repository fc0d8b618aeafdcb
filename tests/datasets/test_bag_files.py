"""Bags as recorders leave them: definitions, counts and QoS that are wrong, logs, compression."""

from __future__ import annotations

import re
import sqlite3
import struct
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from support.bags import ROS1, ROS2, START, Recording, imu, sweeps, write_bag

from loam_gtsam.datasets import open_dataset
from loam_gtsam.datasets.bags.rosbag_files import RosbagFiles
from loam_gtsam.types import DatasetError, Scan

POINTS, STATE = "sensor_msgs/msg/PointCloud2", "my_msgs/msg/State"


def with_imu(kind: str, count: int = 4) -> Recording:
    store = ROS1 if kind == "ros1" else ROS2
    stamps = [START + i * 10_000_000 for i in range(10 * count)]
    recording = [*sweeps(kind, count), *(("/imu", stamp, imu(store, stamp)) for stamp in stamps)]
    return sorted(recording, key=lambda entry: entry[1])


def assert_read(path: Path, count: int = 4) -> list[str]:
    """All sweeps are; returns the problems."""
    dataset = open_dataset(path)
    assert len(dataset) == count
    assert [type(scan) for scan in dataset] == [Scan] * count
    return dataset.info().problems


def change(path: Path, *statements: str) -> None:
    database = sqlite3.connect(path)
    for statement in statements:
        database.execute(statement)
    database.commit()
    database.close()


# -- definitions -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("definition", "digest"),
    [
        ("uint32 x\n", "67581dae273cd72369f246148b42401b"),
        ("uint32 x\n", "0" * 32),
        ("uint32 x\n", "*"),
        ("", "0" * 32),
        ("foo_msgs/Bar b\n", "0" * 32),
        ("uint32 x-y 7 ??\n", "0" * 32),
    ],
)
def test_the_definition_of_another_topic_may_be_anything(
    tmp_path: Path, definition: str, digest: str
) -> None:
    path = tmp_path / "run.bag"
    with Writer1(path) as writer:
        points = writer.add_connection("/points", POINTS, typestore=ROS1)
        other = writer.add_connection("/other", STATE, msgdef=definition, md5sum=digest)
        for _, received, message in sweeps("ros1"):
            writer.write(points, received, ROS1.serialize_ros1(message, POINTS))
        writer.write(other, START, b"\0\0\0\0")
    assert assert_read(path) == []


@pytest.mark.parametrize(("definition", "digest"), [("", "0" * 32), ("uint8 x\n", "0" * 32)])
def test_sweeps_without_their_definition_are_read_by_that_of_ros(
    tmp_path: Path, definition: str, digest: str
) -> None:
    path = tmp_path / "run.bag"
    with Writer1(path) as writer:
        points = writer.add_connection("/points", POINTS, msgdef=definition, md5sum=digest)
        for _, received, message in sweeps("ros1"):
            writer.write(points, received, ROS1.serialize_ros1(message, POINTS))
    assert assert_read(path) == []


def test_a_definition_in_the_bag_is_that_of_its_messages(tmp_path: Path) -> None:
    path, text = tmp_path / "run.bag", "uint32 x\n"
    with Writer1(path) as writer:
        for topic, digest in (("/a", "*"), ("/b", "0" * 32)):
            state = writer.add_connection(topic, STATE, msgdef=text, md5sum=digest)
            writer.write(state, START, struct.pack("<I", 7))
        wrong = writer.add_connection("/c", "my_msgs/msg/No", msgdef="??", md5sum="*")
        writer.write(wrong, START + 1, b"")
    files = RosbagFiles([path])
    messages = {connection.topic: (raw, connection.msgtype) for connection, _, raw in
                files.messages(["/a", "/b", "/c"])}  # fmt: skip
    assert files.deserialize(*messages["/a"]).x == 7
    assert files.deserialize(*messages["/b"]).x == 7
    with pytest.raises(Exception, match="my_msgs/msg/No"):
        files.deserialize(*messages["/c"])
    files.close()


@pytest.mark.parametrize("encoding", ["protobf", "jsonsch"])
def test_another_encoding_in_an_mcap_file_is_that_of_its_channel_alone(
    tmp_path: Path, encoding: str
) -> None:
    file = next(write_bag(tmp_path / "run", "mcap", with_imu("mcap")).glob("*.mcap"))
    name = b"sensor_msgs/msg/Imu" + struct.pack("<I", 7)
    data = file.read_bytes()
    assert data.count(name + b"ros2msg")
    file.write_bytes(data.replace(name + b"ros2msg", name + encoding.encode()))
    assert_read(file)
    assert open_dataset(file).imu is not None  # by the definition of ROS


def test_an_mcap_file_of_another_profile_is_named(tmp_path: Path) -> None:
    file = next(write_bag(tmp_path / "run", "mcap", sweeps("mcap")).glob("*.mcap"))
    profile = struct.pack("<I", 4)
    file.write_bytes(file.read_bytes().replace(profile + b"ros2", profile + b"ros1", 1))
    with pytest.raises(DatasetError, match=r"Profile is not ros2; MCAP files of ROS 2 are") as got:
        open_dataset(file)
    assert "reindex" not in str(got.value)


def test_a_database_with_a_type_without_definition(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "run", "sqlite3", with_imu("sqlite3"))
    file = next(folder.glob("*.db3"))
    set_to = "SET encoding = 'unknown', encoded_message_definition = ''"
    change(file, f"UPDATE message_definitions {set_to} WHERE topic_type LIKE '%Imu'")
    for path in (folder, file):
        assert_read(path)
        assert len(open_dataset(path).imu.stamps) == 40
    change(file, "ALTER TABLE topics RENAME TO others")
    with pytest.raises(DatasetError, match="missing tables; if the recording was cut off"):
        open_dataset(file)


# -- counts ----------------------------------------------------------------------------------------


def promise(folder: Path, sweeps: int, before: int = 4) -> None:
    file = folder / "metadata.yaml"
    text = file.read_text()
    assert len(re.findall(rf"message_count: {before}\b", text)) in (1, 2, 3)
    file.write_text(re.sub(rf"message_count: {before}\b", f"message_count: {sweeps}", text))


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_fewer_messages_than_promised_are_said(tmp_path: Path, kind: str) -> None:
    folder = write_bag(tmp_path / "run", kind, with_imu(kind))
    promise(folder, 7)
    promise(folder, 90, before=40)
    dataset = open_dataset(folder)
    assert sum(1 for _ in islice(dataset, 3)) == 3
    assert sum(1 for _ in islice(dataset.part(0, 2), 2)) == 2
    assert len(dataset.imu.stamps) == 40
    (problem,) = dataset.info().problems
    assert problem.startswith("40 of 90 messages of /imu came; the metadata of run promise more")
    for _ in range(2):
        assert sum(1 for _ in dataset) == 4
    said = [text for text in dataset.info().problems if "4 of 7 messages of /points came" in text]
    assert len(said) == 1
    assert "reindex" in said[0]


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_whole_bag_has_all_of_its_messages(tmp_path: Path, kind: str) -> None:
    assert assert_read(write_bag(tmp_path / "run", kind, with_imu(kind))) == []


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
@pytest.mark.parametrize("count", [0, 2])
def test_metadata_that_count_too_few_cut_nothing(tmp_path: Path, kind: str, count: int) -> None:
    folder = write_bag(tmp_path / "run", kind, sweeps(kind))
    promise(folder, count)
    assert assert_read(folder) == []
    part = open_dataset(folder).part(3)
    assert len(part) == sum(1 for _ in part) == 1


def test_a_topic_is_read_whatever_its_qos_in_the_second_file(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "run", "sqlite3", sweeps("sqlite3"))
    first = next(folder.glob("*.db3"))
    second = folder / "second.db3"
    second.write_bytes(first.read_bytes())
    change(first, f"DELETE FROM messages WHERE timestamp >= {START + 200_000_000}")
    qos = "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n  deadline:\n    sec: 1\n"
    qos += "    nsec: 0\n  lifespan:\n    sec: 1\n    nsec: 0\n  liveliness: 1\n"
    qos += "  liveliness_lease_duration:\n    sec: 1\n    nsec: 0\n"
    qos += "  avoid_ros_namespace_conventions: false\n"
    change(
        second,
        f"DELETE FROM messages WHERE timestamp < {START + 200_000_000}",
        f"UPDATE topics SET offered_qos_profiles = '{qos}'",
    )
    metadata = folder / "metadata.yaml"
    text = metadata.read_text()
    listed = f"- {first.name}"
    assert listed in text
    indent = text[: text.index(listed)].rpartition("\n")[2]
    metadata.write_text(text.replace(listed, f"{listed}\n{indent}- {second.name}", 1))
    assert assert_read(folder) == []


# -- beside the files, and within the messages -----------------------------------------------------


def test_a_log_beside_a_database_is_named(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "run", "sqlite3", sweeps("sqlite3"))
    file = next(folder.glob("*.db3"))
    log = file.with_name(f"{file.name}-wal")
    log.write_bytes(b"")
    assert assert_read(folder) == assert_read(file) == []
    log.write_bytes(b"x" * 40)
    for path in (folder, file):
        (problem,) = open_dataset(path).info().problems
        assert problem.startswith(f"{log.name} (40 bytes) is not read and may hold the newest")
        assert assert_read(path) == [problem]
    change(file, "DROP TABLE topics")
    log.write_bytes(b"x" * 40)
    with pytest.raises(DatasetError, match=r"cannot open the bag: .*; run.db3-wal .*checkpoint"):
        open_dataset(file)


@pytest.mark.parametrize(
    ("plugin", "suffix"), [(StoragePlugin.SQLITE3, "db3"), (StoragePlugin.MCAP, "mcap")]
)
def test_compressed_messages_are_read_without_their_metadata(
    tmp_path: Path, plugin: Any, suffix: str
) -> None:
    writer = Writer2(tmp_path / "run", version=9, storage_plugin=plugin)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        points = writer.add_connection("/points", POINTS, typestore=ROS2)
        for _, received, message in sweeps("sqlite3"):
            writer.write(points, received, ROS2.serialize_cdr(message, POINTS))
    assert assert_read(tmp_path / "run") == []
    assert assert_read(next((tmp_path / "run").glob(f"*.{suffix}"))) == []
