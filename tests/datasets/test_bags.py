"""Bags of sweeps: what is read, what is chosen, what damage does."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from support.bags import (
    KINDS,
    LATENCY,
    ROS1,
    START,
    Recording,
    cloud,
    imu,
    livox,
    store_of,
    sweep_points,
    sweeps,
    write_bag,
)

from loam_gtsam.datasets import BagDataset, Dataset, open_dataset
from loam_gtsam.datasets.bags.bag import POINT_CLOUD
from loam_gtsam.datasets.bags.bag_reader import check_metadata, choose_topic
from loam_gtsam.datasets.decode.livox import read_custom
from loam_gtsam.types import BadSweep, DatasetError, LoamError, Scan


@pytest.mark.parametrize("kind", KINDS)
def test_bag_round_trip(tmp_path: Path, kind: str) -> None:
    store = store_of(kind)
    recording = sweeps(kind)
    recording += [
        ("/imu", START + i * 5_000_000, imu(store, START + i * 5_000_000)) for i in range(9)
    ]
    recording.sort(key=lambda entry: entry[1])
    dataset = open_dataset(write_bag(tmp_path / "run", kind, recording))
    assert isinstance(dataset, BagDataset)
    assert isinstance(dataset, Dataset)
    assert len(dataset) == 4
    scans = list(dataset)
    for index, scan in enumerate(scans):
        assert scan.stamp == START + index * 100_000_000  # the header's, not the receive time
        np.testing.assert_array_equal(scan.points, sweep_points(index))
        np.testing.assert_allclose(scan.times, np.linspace(0, 0.1, 300), atol=1e-8)
        np.testing.assert_array_equal(scan.rings, np.arange(300) % 16)
    for scan, again in zip(scans, dataset, strict=True):
        np.testing.assert_array_equal(scan.points, again.points)
    samples = dataset.imu
    assert samples.orientation is not None
    np.testing.assert_array_equal(samples.stamps, START + np.arange(9) * 5_000_000)
    np.testing.assert_allclose(samples.gyro[0], [0.1, 0.2, 0.3])
    info = dataset.info()
    assert info.facts["rate"] == "10.00 Hz"
    assert info.facts["rings"] == "field, 16 beams (0 .. 15)"
    assert info.facts["point times"].startswith("field 'time' in s, relative to the stamp")
    assert info.facts["IMU"] == "9 samples, 200.00 Hz, with orientation"
    assert info.problems == []


@pytest.mark.parametrize(
    ("step", "times", "period"), [(50, False, 0.05), (50, True, None), (100, False, None)]
)
def test_sweeps_without_times_take_no_longer_than_until_the_next_one(
    tmp_path: Path, step: int, times: bool, period: float | None
) -> None:
    recording: Recording = []
    for i in range(4):
        stamp = START + i * step * 1_000_000
        columns = {"time": np.linspace(0, 0.05, 300, dtype="f4")} if times else {}
        recording.append(("/points", stamp, cloud(ROS1, stamp, sweep_points(i), **columns)))
    dataset = open_dataset(write_bag(tmp_path / "run", "ros1", recording))
    assert dataset.sensor.get("period") == (None if period is None else pytest.approx(period))


@pytest.mark.parametrize("kind", KINDS)
def test_the_message_of_a_livox_is_read_with_its_times_and_without_rings(
    tmp_path: Path, kind: str
) -> None:
    times, stamps = np.linspace(0.0, 0.0999, 301), [START + i * 100_000_000 for i in range(3)]
    recording: Recording = [
        ("/livox/lidar", s + LATENCY, livox(store_of(kind), s, sweep_points(i, 301), times))
        for i, s in enumerate(stamps)
    ]
    path = write_bag(tmp_path / "run", kind, recording)
    dataset = open_dataset(path)
    assert dataset.info().facts["point times"].startswith("field 'offset_time' in ns, relative")
    for index, scan in enumerate(dataset):
        assert isinstance(scan, Scan)
        assert scan.stamp == stamps[index]
        assert scan.rings is None
        np.testing.assert_array_equal(scan.points, sweep_points(index, 301))
        np.testing.assert_allclose(scan.times, times, atol=1e-9)
    recording[1:1] = sweeps(kind, 1)  # what is common comes first, and another may be asked for
    both = write_bag(tmp_path / "both", kind, recording)
    assert BagDataset(both).topic == "/points"
    with pytest.raises(DatasetError, match=r"no topic '/x'; the bag has: .*/livox/lidar"):
        BagDataset(both, topic="/x")
    assert len(BagDataset(both, topic="/livox/lidar")) == 3


@pytest.mark.parametrize("hertz", [50, 100])
def test_short_messages_of_a_livox_count_nanoseconds(tmp_path: Path, hertz: int) -> None:
    times = np.linspace(0.0, 0.99 / hertz, 301)
    stamps = [START + i * 10**9 // hertz for i in range(3)]
    recording: Recording = [
        ("/livox/lidar", s, livox(ROS1, s, sweep_points(i, 301), times))
        for i, s in enumerate(stamps)
    ]
    path = write_bag(tmp_path / "run", "ros1", recording)
    for scan in open_dataset(path):
        np.testing.assert_allclose(scan.times, times, atol=1e-9)
    scan = next(iter(open_dataset(path, time_unit="us", time_field="none")))
    assert scan.times is None


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_a_livox_message_that_is_cut_off_is_a_bad_sweep(kind: str) -> None:
    store = store_of(kind)
    message = livox(store, START, sweep_points(0, 50), np.linspace(0.0, 0.1, 50))
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    raw, cdr = bytes(serialize(message, message.__msgtype__)), kind != "ros1"
    assert read_custom(raw, cdr=cdr).width == 50
    for length, says in ((len(raw) - 1, "50 points of .* are cut off"), (30, "in the header")):
        with pytest.raises(DatasetError, match=says):
            read_custom(raw[:length], cdr=cdr)
    if cdr:
        with pytest.raises(DatasetError, match="expected little-endian CDR"):
            read_custom(b"\0\0" + raw[2:], cdr=True)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_single_ros2_file(tmp_path: Path, kind: str) -> None:
    folder = write_bag(tmp_path / "run", kind, sweeps(kind))
    file = next(folder.glob("*.db3" if kind == "sqlite3" else "*.mcap"))
    alone = file.rename(tmp_path / file.name)
    scans = list(open_dataset(alone))
    assert [type(scan) for scan in scans] == [Scan] * 4


def test_topics_are_chosen_and_named(tmp_path: Path) -> None:
    recording = [*sweeps("ros1", 2, "/a"), *sweeps("ros1", 3, "/b")]
    recording.append(("/imu", START, imu(ROS1, START)))
    path = write_bag(tmp_path / "run", "ros1", recording)
    with pytest.raises(DatasetError, match=f"topic '/imu' is .*, expected {POINT_CLOUD}; the bag"):
        BagDataset(path, topic="/imu")
    dataset = BagDataset(path)
    assert dataset.topic == "/b"
    assert len(dataset) == 3
    assert any("/a: 2, /b: 3); took /b" in text for text in dataset.info().problems)
    assert len(BagDataset(path, topic="/a")) == 2
    listing = r"/a \(sensor_msgs/msg/PointCloud2, 2\)"
    with pytest.raises(DatasetError, match=rf"no topic '/c'; the bag has: {listing}"):
        BagDataset(path, topic="/c")
    with pytest.raises(DatasetError, match="'/imu' is sensor_msgs/msg/Imu, expected"):
        BagDataset(path, topic="/imu")
    with pytest.raises(DatasetError, match="no topic '/no'"):
        BagDataset(path, imu_topic="/no")
    with pytest.raises(TypeError, match="unexpected keyword arguments: colour"):
        BagDataset(path, colour="red")


@pytest.mark.parametrize(
    ("recording", "problem"),
    [
        ([*sweeps("ros1"), ("/imu", START, imu(ROS1, START, unknown=True))], "without orientation"),
        ([("/p", START, cloud(ROS1, START, sweep_points(0)))], "no per-point time"),
        (sweeps("ros1", 3, "/velodyne_cloud_registered"), "do not map them again"),
    ],
)
def test_what_a_bag_lacks_is_said(tmp_path: Path, recording: Recording, problem: str) -> None:
    dataset = BagDataset(write_bag(tmp_path / "run", "ros1", recording))
    assert dataset.imu is None or dataset.imu.orientation is None
    info = dataset.info()
    assert any(problem in text for text in [*info.problems, *info.facts.values()])
    assert problem != "no per-point time" or [scan.times for scan in dataset] == [None]


def test_clouds_in_the_map_are_no_sweeps_while_there_are_others(tmp_path: Path) -> None:
    mapped = sweeps("ros1", 3, "/velodyne_cloud_registered")
    both = write_bag(tmp_path / "both", "ros1", [*mapped, *sweeps("ros1", 2, "/velodyne_points")])
    assert BagDataset(both).topic == "/velodyne_points"


def test_bag_whose_times_fit_nothing(tmp_path: Path) -> None:
    recording = [("/p", START, cloud(ROS1, START, sweep_points(0), time=np.zeros(300)))]
    path = write_bag(tmp_path / "run", "ros1", recording)
    with pytest.raises(DatasetError, match=r"run.bag, topic /p: .*fit no unit"):
        open_dataset(path)
    assert len(list(open_dataset(path, time_field="none"))) == 1


def test_a_bag_whose_times_are_fractions_of_the_sweep_is_refused(tmp_path: Path) -> None:
    fractions = np.linspace(0.0, 1.0, 300).astype("f4")

    def bag(name: str, step: int) -> Path:
        stamps = [START + number * step for number in range(4)]
        clouds = [(s, cloud(ROS1, s, sweep_points(0), time=fractions)) for s in stamps]
        return write_bag(tmp_path / name, "ros1", [("/p", *entry) for entry in clouds])

    path = bag("fast", 10**8)
    with pytest.raises(DatasetError, match=r"/p: the times .* span 1 s.*; give time_field=none"):
        open_dataset(path)
    assert len(list(open_dataset(path, time_field="none"))) == 4
    assert len(list(open_dataset(bag("slow", 10**9)))) == 4


@pytest.mark.parametrize("kind", KINDS)
def test_undecodable_messages_are_bad_sweeps(tmp_path: Path, kind: str) -> None:
    recording = sweeps(kind, 5)
    store = store_of(kind)
    stamp = START + 200_000_000
    without_x = cloud(store, stamp, sweep_points(2))
    without_x.fields = without_x.fields[1:]
    recording[2] = ("/points", stamp + LATENCY, without_x)
    recording[3] = ("/points", START + 300_000_000 + LATENCY, b"\x00\x01\x00\x00garbage" * 3)
    dataset = open_dataset(write_bag(tmp_path / "run", kind, recording))
    got = list(dataset)
    assert [type(sweep) for sweep in got] == [Scan, Scan, BadSweep, BadSweep, Scan]
    assert "no field x" in got[2].message
    assert "/points" in got[3].message
    # receive times are led back to the clock of the stamps
    assert [sweep.stamp for sweep in got[2:4]] == [stamp, START + 300_000_000]


def test_truncated_bags_cannot_be_opened(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run", "ros1", sweeps("ros1"))
    data = path.read_bytes()
    for size in (0, 5, 100, len(data) // 2, len(data) - 30):
        path.write_bytes(data[:size])
        with pytest.raises(DatasetError, match=r"run.bag: cannot open the bag.*reindex"):
            open_dataset(path)


def test_what_a_reader_says_of_a_damaged_bag_is_cut(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run", "sqlite3", sweeps("sqlite3"))
    metadata = bag / "metadata.yaml"
    found = re.sub(
        r"storage_identifier: \w+", f"storage_identifier: {'x' * 20_000}", metadata.read_text()
    )
    metadata.write_text(found)
    with pytest.raises(DatasetError, match="cannot open the bag") as caught:
        open_dataset(bag)
    assert len(str(caught.value)) < 1_000


def test_damage_inside_keeps_what_came_before(tmp_path: Path) -> None:
    path = tmp_path / "run.bag"
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat.BZ2)
    writer.chunk_threshold = 1  # a chunk per message
    with writer:
        connection = writer.add_connection("/p", "sensor_msgs/msg/PointCloud2", typestore=ROS1)
        for _, received, message in sweeps("ros1", 6):
            raw = ROS1.serialize_ros1(message, message.__msgtype__)
            writer.write(connection, received, raw)
    data = bytearray(path.read_bytes())
    starts = [i for i in range(len(data)) if data[i : i + 4] == b"BZh9"]
    assert len(starts) == 6
    data[starts[4] + 4 : starts[4] + 200] = bytes(196)
    path.write_bytes(data)
    dataset = BagDataset(path)
    got = list(dataset)
    assert [type(sweep) for sweep in got] == [Scan] * 4 + [BadSweep]
    assert "the rest is lost" in got[4].message
    assert got[4].stamp == START + 400_000_000  # when the next sweep was due
    list(dataset)
    assert sum("the rest is lost" in text for text in dataset.info().problems) == 1


def test_a_bag_of_packets_says_what_they_need(tmp_path: Path) -> None:
    recording = [("/imu", START, imu(ROS1, START))]
    path = write_bag(tmp_path / "run", "ros1", recording)
    with pytest.raises(
        DatasetError, match=r"no topic of type .*PointCloud2; the bag has: /imu.*Imu, 1\)$"
    ):
        BagDataset(path)
    topics = {"/scan": ("sensor_msgs/msg/LaserScan", 3)}
    with pytest.raises(DatasetError, match=r"LaserScan, 3\)$"):
        choose_topic(path, topics, POINT_CLOUD, None, [])
    topics = {"/packets": ("velodyne_msgs/msg/VelodyneScan", 3)}
    with pytest.raises(DatasetError, match="raw packets become PointCloud2 with the driver"):
        choose_topic(path, topics, POINT_CLOUD, None, [])


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_truncated_ros2_never_escapes_loam_error(tmp_path: Path, kind: str) -> None:
    folder = write_bag(tmp_path / "run", kind, sweeps(kind, 20))
    file = next(folder.glob("*.db3" if kind == "sqlite3" else "*.mcap"))
    data = file.read_bytes()
    refused = 0
    for size in (0, 10, len(data) // 3, len(data) - 100):
        file.write_bytes(data[:size])
        try:
            got = list(open_dataset(folder))
        except LoamError:
            refused += 1
        else:
            assert isinstance(got[-1], BadSweep)
    assert refused >= 2


@pytest.mark.parametrize(("topic", "kind", "says"), [(7, "a/msg/B", "name"), ("/a", 7, "type")])
def test_metadata_that_are_no_text_are_refused(topic: object, kind: object, says: str) -> None:
    connection = SimpleNamespace(topic=topic, msgtype=kind, msgcount=1)
    with pytest.raises(ValueError, match=f"expected the {says} of a topic, its metadata have 7"):
        check_metadata(SimpleNamespace(connections=[connection], start_time=0))  # type: ignore[arg-type]
