from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from support.bags import (
    KINDS,
    LATENCY,
    ROS1,
    START,
    cloud,
    imu,
    loam_recording,
    odometry,
    store_of,
    sweep_points,
    sweeps,
    write_bag,
)

from loam_gtsam.datasets import (
    ArrayDataset,
    BagDataset,
    Dataset,
    KittiDataset,
    LoamTopicsDataset,
    open_dataset,
)
from loam_gtsam.datasets.bags.bag import POINT_CLOUD
from loam_gtsam.datasets.bags.bag_reader import choose_topic
from loam_gtsam.datasets.decode.loam_messages import StampMatcher
from loam_gtsam.datasets.decode.tables import clean_imu, read_tum, seconds_to_ns
from loam_gtsam.datasets.kitti.folder import raise_elevation
from loam_gtsam.types import (
    BadSweep,
    ConfigError,
    DatasetError,
    FeatureSweep,
    InputError,
    LoamError,
    Scan,
)

# --- bags -----------------------------------------------------------------------------------


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
        assert isinstance(scan, Scan)
        assert scan.stamp == START + index * 100_000_000  # the header's, not the receive time
        np.testing.assert_array_equal(scan.points, sweep_points(index))
        assert scan.times is not None
        np.testing.assert_allclose(scan.times, np.linspace(0, 0.1, 300), atol=1e-8)
        np.testing.assert_array_equal(scan.rings, np.arange(300) % 16)
    for scan, again in zip(scans, dataset, strict=True):
        assert isinstance(again, Scan)
        np.testing.assert_array_equal(scan.points, again.points)
    samples = dataset.imu
    assert samples is not None
    assert samples.orientation is not None
    np.testing.assert_array_equal(samples.stamps, START + np.arange(9) * 5_000_000)
    np.testing.assert_allclose(samples.gyro[0], [0.1, 0.2, 0.3])
    info = dataset.info()
    assert info.facts["rate"] == "10.00 Hz"
    assert info.facts["rings"] == "field, 16 beams (0 .. 15)"
    assert info.facts["point times"].startswith("field 'time' in s, relative to the stamp")
    assert info.facts["IMU"] == "9 samples, 200.00 Hz, with orientation"
    assert info.problems == []


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


def test_bag_without_sweeps(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run", "ros1", [("/imu", START, imu(ROS1, START))])
    with pytest.raises(DatasetError, match=r"no topic of type .*PointCloud2; the bag has: /imu"):
        open_dataset(path)


def test_imu_without_orientation(tmp_path: Path) -> None:
    recording = sweeps("ros1")
    recording += [("/imu", START + i, imu(ROS1, START + i, unknown=True)) for i in range(3)]
    dataset = BagDataset(write_bag(tmp_path / "run", "ros1", recording))
    assert dataset.imu is not None
    assert dataset.imu.orientation is None
    assert any("no orientation" in text for text in dataset.info().problems)


def test_bag_without_times_says_so(tmp_path: Path) -> None:
    recording = [("/p", START, cloud(ROS1, START, sweep_points(0)))]
    dataset = BagDataset(write_bag(tmp_path / "run", "ros1", recording))
    assert any("no per-point time" in text for text in dataset.info().problems)
    assert [scan.times for scan in dataset if isinstance(scan, Scan)] == [None]


def test_bag_whose_times_fit_nothing(tmp_path: Path) -> None:
    recording = [("/p", START, cloud(ROS1, START, sweep_points(0), time=np.zeros(300)))]
    path = write_bag(tmp_path / "run", "ros1", recording)
    with pytest.raises(DatasetError, match=r"run.bag, topic /p: .*fit no unit"):
        open_dataset(path)
    assert len(list(open_dataset(path, time_field="none"))) == 1


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
    assert isinstance(got[2], BadSweep)
    assert isinstance(got[3], BadSweep)
    assert "no field x" in got[2].message
    assert "/points" in got[3].message
    # receive times are led back to the clock of the stamps
    assert [sweep.stamp for sweep in got[2:4]] == [stamp, START + 300_000_000]  # type: ignore[union-attr]


def test_truncated_bags_cannot_be_opened(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run", "ros1", sweeps("ros1"))
    data = path.read_bytes()
    for size in (0, 5, 100, len(data) // 2, len(data) - 30):
        path.write_bytes(data[:size])
        with pytest.raises(DatasetError, match=r"run.bag: cannot open the bag.*reindex"):
            open_dataset(path)


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
    assert isinstance(got[4], BadSweep)
    assert "the rest is lost" in got[4].message
    assert got[4].stamp == START + 400_000_000  # when the next sweep was due
    list(dataset)
    assert sum("the rest is lost" in text for text in dataset.info().problems) == 1


# --- LOAM's topics --------------------------------------------------------------------------


@pytest.mark.parametrize("loam_axes", [False, True])
@pytest.mark.parametrize("told", [False, True])
def test_loam_topics_in_either_axes(tmp_path: Path, loam_axes: bool, told: bool) -> None:
    path = write_bag(tmp_path / "topics", "ros1", loam_recording(loam_axes=loam_axes))
    name = "loam" if loam_axes else "lidar"
    dataset = open_dataset(path, axes=name if told else None)
    assert isinstance(dataset, LoamTopicsDataset)
    assert dataset.axes == name
    got = list(dataset)
    assert len(got) == len(dataset) == 3
    flat = sweep_points(2) * np.array([1.0, 1.0, 0.2])
    last = got[2]
    assert isinstance(last, FeatureSweep)
    np.testing.assert_allclose(last.features.edges, flat, atol=1e-6)
    np.testing.assert_allclose(last.features.planes, flat, atol=1e-6)
    assert last.cloud is not None
    np.testing.assert_allclose(last.cloud, flat, atol=1e-6)
    np.testing.assert_allclose(last.odom_T_lidar.translation(), [2.0, 1.0, 0.1])
    quaternion = last.odom_T_lidar.rotation().toQuaternion()
    np.testing.assert_allclose(
        [quaternion.x(), quaternion.y(), quaternion.z()], [0.1, 0.2, 0.3], atol=1e-12
    )
    assert dataset.recorded is not None
    np.testing.assert_allclose(dataset.recorded.map_T_lidar[2], last.odom_T_lidar.matrix())
    assert set(dataset.unmatched.values()) == {0}


@pytest.mark.parametrize(
    ("offset", "matched"),
    [(4_900_000, 3), (-4_900_000, 3), (5_000_000, 3), (5_100_000, 0), (-5_100_000, 0)],
)
def test_stamps_agree_to_five_milliseconds(tmp_path: Path, offset: int, matched: int) -> None:
    recording = loam_recording(offsets={"/laser_cloud_surf_last": offset})
    dataset = LoamTopicsDataset(write_bag(tmp_path / "topics", "ros1", recording))
    assert len(list(dataset)) == matched
    assert dataset.unmatched == dict.fromkeys(dataset.unmatched, 3 - matched)
    assert len(dataset.unmatched) == 4
    problems = [text for text in dataset.info().problems if "without partners" in text]
    assert len(problems) == (0 if matched else 4)


def test_missing_and_repeated_messages_are_counted(tmp_path: Path) -> None:
    recording = loam_recording(count=5)
    dropped = [e for e in recording if e[:2] != ("/laser_cloud_surf_last", START + 200_000_000)]
    again = next(e for e in recording if e[0] == "/laser_cloud_corner_last")
    dropped.insert(1, again)
    dataset = LoamTopicsDataset(write_bag(tmp_path / "topics", "ros1", dropped))
    got = list(dataset)
    stamps = [sweep.features.stamp for sweep in got if isinstance(sweep, FeatureSweep)]
    assert stamps == [START + i * 100_000_000 for i in (0, 1, 3, 4)]
    assert dataset.unmatched == {
        "/laser_cloud_corner_last": 2,
        "/laser_cloud_surf_last": 0,
        "/laser_odom_to_init": 1,
        "/velodyne_cloud_3": 1,
    }
    assert len(list(dataset)) == 4  # counting starts anew
    assert sum(dataset.unmatched.values()) == 4


def test_topics_without_a_partner_keep_memory_bounded(tmp_path: Path) -> None:
    recording = loam_recording(count=120, offsets={"/laser_cloud_surf_last": 50_000_000})
    dataset = LoamTopicsDataset(write_bag(tmp_path / "topics", "ros1", recording))
    assert list(dataset) == []
    assert dataset.unmatched == dict.fromkeys(dataset.unmatched, 120)
    matcher = StampMatcher(["/a", "/b"])
    for stamp in range(120):
        assert matcher.add("/a", stamp, None) is None
    assert matcher.unmatched == {"/a": 20, "/b": 0}
    assert matcher.finish() == {"/a": 120, "/b": 0}


def test_loam_bag_without_cloud_or_with_a_broken_pose(tmp_path: Path) -> None:
    recording = [e for e in loam_recording() if e[0] != "/velodyne_cloud_3"]
    index = next(i for i, e in enumerate(recording) if e[0] == "/laser_odom_to_init")
    stamp = recording[index][1]
    recording[index] = ("/laser_odom_to_init", stamp, odometry(ROS1, stamp, (0, 0, 0), (0,) * 4))
    dataset = open_dataset(write_bag(tmp_path / "topics", "ros1", recording))
    got = list(dataset)
    assert [type(sweep) for sweep in got] == [BadSweep, FeatureSweep, FeatureSweep]
    assert isinstance(got[0], BadSweep)
    assert "/laser_odom_to_init" in got[0].message
    assert isinstance(got[1], FeatureSweep)
    assert got[1].cloud is None
    assert any("no /velodyne_cloud_3" in text for text in dataset.info().problems)


def without_x(stamp: int) -> Any:
    message = cloud(ROS1, stamp, sweep_points(0))
    message.fields = message.fields[1:]
    return message


GARBAGE = b"\x00\x01\x00\x00garbage" * 3


def test_damaged_messages_of_loam_topics_are_bad_sweeps_and_the_rest_goes_on(
    tmp_path: Path,
) -> None:
    recording = loam_recording(count=4)
    for topic, sweep, damage in (
        ("/laser_cloud_surf_last", 0, without_x(START)),
        ("/laser_cloud_corner_last", 2, GARBAGE),
    ):
        stamp = START + sweep * 100_000_000
        index = next(i for i, entry in enumerate(recording) if entry[:2] == (topic, stamp))
        recording[index] = (topic, stamp, damage)
    dataset = LoamTopicsDataset(write_bag(tmp_path / "topics", "ros1", recording))
    got = list(dataset)
    assert [type(sweep) for sweep in got] == [BadSweep, FeatureSweep, BadSweep, FeatureSweep]
    assert isinstance(got[0], BadSweep)
    assert isinstance(got[2], BadSweep)
    assert "topic /laser_cloud_surf_last: " in got[0].message
    assert "topic /laser_cloud_corner_last: cannot deserialise" in got[2].message
    assert dataset.unmatched == {
        "/laser_cloud_corner_last": 0,
        "/laser_cloud_surf_last": 1,
        "/laser_odom_to_init": 1,
        "/velodyne_cloud_3": 1,
    }


def test_a_loam_topic_of_a_type_without_stamp_is_a_bad_sweep_each_time(tmp_path: Path) -> None:
    vector = ROS1.types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    recording = [
        (topic, stamp, vector if topic == "/laser_odom_to_init" else message)
        for topic, stamp, message in loam_recording()
    ]
    got = list(LoamTopicsDataset(write_bag(tmp_path / "topics", "ros1", recording)))
    assert [type(sweep) for sweep in got] == [BadSweep] * 3
    assert all("header.stamp" in sweep.message for sweep in got if isinstance(sweep, BadSweep))


def test_the_axes_are_those_of_the_first_cloud_that_can_be_read(tmp_path: Path) -> None:
    few = cloud(ROS1, START + 2 * 100_000_000, np.random.default_rng(0).normal(size=(99, 3)))
    faulty = [GARBAGE, without_x(START + 100_000_000), few]
    recording = loam_recording(loam_axes=True, count=4)
    for topic, stamp, _ in list(recording):
        sweep = (stamp - START) // 100_000_000
        if topic == "/velodyne_cloud_3" and sweep < 3:
            index = next(i for i, entry in enumerate(recording) if entry[:2] == (topic, stamp))
            recording[index] = (topic, stamp, faulty[sweep])
    assert LoamTopicsDataset(write_bag(tmp_path / "all", "ros1", recording)).axes == "loam"
    short = [entry for entry in recording if entry[1] < START + 300_000_000]
    with pytest.raises(DatasetError, match=r"cannot tell the axes .*unknown"):
        LoamTopicsDataset(write_bag(tmp_path / "short", "ros1", short))


def test_recorded_poses_of_loam_are_optional_and_broken_ones_are_left_out(tmp_path: Path) -> None:
    mapped = "/aft_mapped_to_init"
    recording = loam_recording(count=4)
    damages = (odometry(ROS1, START, (0, 0, 0), (0,) * 4), None, GARBAGE, None)
    broken = []
    for topic, stamp, message in recording:
        damage = damages[(stamp - START) // 100_000_000] if topic == mapped else None
        broken.append((topic, stamp, message if damage is None else damage))
    broken.append(("/imu", START, imu(ROS1, START)))
    dataset = LoamTopicsDataset(write_bag(tmp_path / "broken", "ros1", broken))
    assert dataset.recorded is not None
    np.testing.assert_array_equal(dataset.recorded.stamps - START, [100_000_000, 300_000_000])
    info = dataset.info()
    assert info.facts["recorded result"] == f"{mapped}, 2 poses"
    assert info.facts["not used"] == "/imu"
    assert sum("left out: " in text for text in info.problems) == 1
    # A bag without them, in which one kind of feature is missing once.
    recording = [entry for entry in recording if entry[0] != mapped]
    lacking = [entry for entry in recording if entry[:2] != ("/laser_cloud_surf_last", START)]
    dataset = LoamTopicsDataset(write_bag(tmp_path / "without", "ros1", lacking))
    assert dataset.recorded is None
    info = dataset.info()
    assert "recorded result" not in info.facts
    assert info.facts["sweeps"] == "up to 3"
    assert any("different numbers of messages" in text for text in info.problems)


# hardly flat along z; flat along x, which no front end's axes are
@pytest.mark.parametrize("shape", [(1.0, 1.0, 0.9), (0.2, 1.0, 1.0)])
def test_axes_that_cannot_be_told(tmp_path: Path, shape: tuple[float, ...]) -> None:
    recording = loam_recording()
    ball = np.random.default_rng(0).normal(size=(300, 3)) * shape
    recording = [
        (topic, stamp, cloud(ROS1, stamp, ball) if topic == "/velodyne_cloud_3" else message)
        for topic, stamp, message in recording
    ]
    path = write_bag(tmp_path / "topics", "ros1", recording)
    with pytest.raises(DatasetError, match="cannot tell the axes"):
        open_dataset(path)
    assert len(list(open_dataset(path, axes="lidar"))) == 3
    with pytest.raises(DatasetError, match="expected one of auto, lidar, loam; got 'camera'"):
        open_dataset(path, axes="camera")


def test_loam_topics_missing_or_overruled(tmp_path: Path) -> None:
    recording = [e for e in loam_recording() if e[0] != "/laser_odom_to_init"]
    path = write_bag(tmp_path / "some", "ros1", recording)
    with pytest.raises(DatasetError, match="no topic /laser_odom_to_init; the bag has"):
        LoamTopicsDataset(path)
    whole = write_bag(tmp_path / "all", "ros1", loam_recording())
    assert isinstance(open_dataset(whole, topic="/velodyne_cloud_3"), BagDataset)


@pytest.mark.parametrize(("name", "axes"), [("aloam_town", "lidar"), ("loam_town", "loam")])
def test_recorded_loam_runs(shared_data: Path, name: str, axes: str) -> None:
    dataset = LoamTopicsDataset(shared_data / name / "topics.bag")
    assert dataset.axes == axes
    got = [sweep for sweep in dataset if isinstance(sweep, FeatureSweep)]
    assert len(got) == 60
    expected = read_tum(shared_data / name / "odom.tum")
    poses = np.array([sweep.odom_T_lidar.matrix() for sweep in got])
    np.testing.assert_allclose(poses, expected.map_T_lidar, atol=2e-9)  # nine decimals there
    stamps = np.array([sweep.features.stamp for sweep in got])
    np.testing.assert_array_equal(stamps - stamps[0], expected.stamps)
    assert dataset.recorded is not None
    mapped = read_tum(shared_data / name / "mapped.tum")
    np.testing.assert_allclose(dataset.recorded.map_T_lidar, mapped.map_T_lidar, atol=2e-9)


# --- folders of .bin ------------------------------------------------------------------------


def write_sweeps(folder: Path, count: int = 3) -> Path:
    folder.mkdir(parents=True)
    for i in range(count):
        values = np.column_stack([sweep_points(i, 50), np.ones(50)]).astype("<f4")
        values.tofile(folder / f"{i:06d}.bin")
    return folder


@pytest.mark.parametrize(
    ("below", "is_kitti"),
    [("", False), ("scans", False), ("velodyne", True), ("velodyne_points/data", True)],
)
def test_kitti_layouts(tmp_path: Path, below: str, is_kitti: bool) -> None:
    root = tmp_path / "drive"
    folder = write_sweeps(root / below)
    (root / "times.txt").write_text("0.0\n1.036224e-01\n0.207243\n")
    for path in {root, folder}:  # the inner folder may be given as well
        dataset = open_dataset(path)
        assert isinstance(dataset, KittiDataset)
        got = list(dataset)
        assert [sweep.stamp for sweep in got] == [0, 103_622_400, 207_243_000]  # type: ignore[union-attr]
        assert isinstance(got[1], Scan)
        np.testing.assert_array_equal(got[1].points, sweep_points(1, 50))
        assert got[1].times is None
        assert got[1].rings is None
        assert dataset.sensor.get("stamp") == ("middle" if is_kitti else None)


def test_kitti_raw_timestamps(tmp_path: Path) -> None:
    write_sweeps(tmp_path / "velodyne_points" / "data", 2)
    path = tmp_path / "velodyne_points" / "timestamps.txt"
    path.write_text("2011-09-26 13:02:25.594360375\n2011-09-26 13:02:25.7\n")
    first = 1_317_042_145_594_360_375
    assert KittiDataset(tmp_path).stamps.tolist() == [first, 1_317_042_145_700_000_000]
    path.write_text("2011-09-26 13:02:25.594360375\n25.7 s\n")
    with pytest.raises(DatasetError, match=r"timestamps.txt:2: expected a date and time, got '25"):
        KittiDataset(tmp_path)


def test_files_are_read_in_order_of_their_number(tmp_path: Path) -> None:
    for i in (10, 9, 100):
        np.full((1, 4), i, "<f4").tofile(tmp_path / f"{i}.bin")
    points = [scan.points[0, 0] for scan in KittiDataset(tmp_path) if isinstance(scan, Scan)]
    assert points == [9.0, 10.0, 100.0]


def test_without_times_file(tmp_path: Path) -> None:
    dataset = KittiDataset(write_sweeps(tmp_path / "a"))
    assert dataset.stamps.tolist() == [0, 100_000_000, 200_000_000]
    assert any("10 Hz assumed" in text for text in dataset.info().problems)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("0.0\n0.1\n", r"times.txt: 2 stamps for 3 sweeps"),
        ("0.0\n0.1\n0.2\n0.3\n", r"times.txt: 4 stamps for 3 sweeps"),
        ("0.0\nabc\n0.2\n", r"times.txt:2: .*'abc'"),
        ("0.0\n\n0.2\n", r"times.txt:2: "),
        ("0.0\n0.1\nnan\n", r"times.txt:3: "),
        ("0.0\n0.1\n1e30\n", r"times.txt:3: "),
    ],
)
def test_bad_times_file(tmp_path: Path, text: str, match: str) -> None:
    folder = write_sweeps(tmp_path / "a")
    (folder / "times.txt").write_text(text)
    with pytest.raises(DatasetError, match=match):
        KittiDataset(folder)


def test_stamps_keep_every_nanosecond() -> None:
    assert seconds_to_ns("1700000000.123456789") == 1_700_000_000_123_456_789
    assert seconds_to_ns("1e-9") == 1


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("0\n0.1\n0.1\n0.2\n", "1 stamps equal the one before, first at sweep 2"),
        ("0\n0.1\n0.05\n0.2\n", "1 stamps are earlier than the one before, first at sweep 2"),
        ("0\n0.1\n0.2\n0.4\n", "1 stamps come after a gap, first at sweep 3"),
        ("0\n0\n0\n0\n", "all stamps are 0 s: nothing says when the sweeps were measured"),
        ("0\n0.1\n0.21\n0.3\n", None),
    ],
)
def test_disorder_is_reported_and_still_read(
    tmp_path: Path, text: str, problem: str | None
) -> None:
    folder = write_sweeps(tmp_path / "a", 4)
    (folder / "times.txt").write_text(text)
    dataset = KittiDataset(folder)
    said = dataset.info().problems
    assert len(said) == (problem is not None)
    assert all(text.startswith(problem or "") for text in said)
    assert [type(sweep) for sweep in dataset] == [Scan] * 4


def test_truncated_and_unreadable_sweeps(tmp_path: Path) -> None:
    folder = write_sweeps(tmp_path / "a", 4)
    file = folder / "000001.bin"
    file.write_bytes(file.read_bytes()[:-3])
    (folder / "000002.bin").unlink()
    (folder / "000002.bin").symlink_to(folder / "gone")
    got = list(KittiDataset(folder))
    assert [type(sweep) for sweep in got] == [Scan, BadSweep, BadSweep, Scan]
    assert isinstance(got[1], BadSweep)
    assert isinstance(got[2], BadSweep)
    assert "000001.bin: 797 bytes is not a multiple of 16" in got[1].message
    assert got[1].stamp == 100_000_000
    assert "000002.bin" in got[2].message


def test_empty_file_is_an_empty_sweep(tmp_path: Path) -> None:
    (tmp_path / "0.bin").write_bytes(b"")
    (scan,) = KittiDataset(tmp_path)
    assert isinstance(scan, Scan)
    assert scan.points.shape == (0, 3)


@pytest.mark.parametrize("base", [0, 991_587_364_520])
def test_point_times_of_a_folder(tmp_path: Path, base: int) -> None:
    write_sweeps(tmp_path / "velodyne")
    (tmp_path / "t_ns").mkdir()
    offsets = np.arange(50, dtype="<u8") * 2_000_000
    for i in (0, 1):
        (offsets + base).astype("<u8").tofile(tmp_path / "t_ns" / f"{i:06d}.u64")
    (offsets[:7] + base).astype("<u8").tofile(tmp_path / "t_ns" / "000002.u64")
    dataset = KittiDataset(tmp_path)
    got = list(dataset)
    assert isinstance(got[1], Scan)
    assert got[1].times is not None
    np.testing.assert_allclose(got[1].times, offsets * 1e-9, atol=1e-12)
    assert isinstance(got[2], BadSweep)
    assert "000002.u64: expected 50 point times, got 7" in got[2].message
    assert dataset.sensor == {}  # nothing of KITTI's is implied
    for file in (tmp_path / "t_ns").iterdir():
        file.unlink()
    with pytest.raises(DatasetError, match=r"t_ns: no usable point times.*000000.u64"):
        KittiDataset(tmp_path)


def test_raised_elevation() -> None:
    points = sweep_points(3).astype(np.float64)
    points[0] = (0.0, 0.0, 2.0)  # straight up: no direction to turn in
    angle = np.radians(0.205)
    raised = raise_elevation(points, float(angle))

    def elevation(p: np.ndarray) -> np.ndarray:
        result: np.ndarray = np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))
        return result

    np.testing.assert_allclose(np.linalg.norm(raised, axis=1), np.linalg.norm(points, axis=1))
    np.testing.assert_allclose((elevation(raised) - elevation(points))[1:], angle, atol=1e-12)
    azimuths = [np.arctan2(p[1:, 1], p[1:, 0]) for p in (raised, points)]
    np.testing.assert_allclose(azimuths[0], azimuths[1])
    np.testing.assert_array_equal(raised[0], points[0])


def test_elevation_option(tmp_path: Path) -> None:
    folder = write_sweeps(tmp_path / "a", 1)
    (plain,) = open_dataset(folder)
    (raised,) = open_dataset(folder, vertical_angle_offset_deg=0.205)
    assert isinstance(plain, Scan)
    assert isinstance(raised, Scan)
    expected = raise_elevation(plain.points, np.radians(0.205))
    np.testing.assert_array_equal(raised.points, expected)


def test_reference_poses_and_imu_of_a_folder(tmp_path: Path) -> None:
    folder = write_sweeps(tmp_path / "a")
    assert KittiDataset(folder).truth is None
    assert KittiDataset(folder).imu is None
    (folder / "gt.tum").write_text("# t x y z q\n0.1 1 2 3 0 0 0.70710678 0.70710678\n")
    (folder / "imu.csv").write_text("0.005,0,0,0,1,0.1,0.2,0.3,0,0,9.81\n")
    dataset = KittiDataset(folder)
    assert dataset.truth is not None
    assert dataset.truth.stamps.tolist() == [100_000_000]
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(dataset.truth.map_T_lidar[0], expected, atol=1e-12)
    assert dataset.imu is not None
    assert dataset.imu.stamps.tolist() == [5_000_000]
    np.testing.assert_allclose(dataset.imu.acceleration, [[0, 0, 9.81]])


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("gt.tum", "0 1 2 3 0 0 0 1\n0 1 2 3 0 0 1\n", "gt.tum:2: expected 8 numbers"),
        ("gt.tum", "0 1 2 3 0 0 0 0\n", "gt.tum:1: .*quaternion of length 0"),
        ("gt.tum", "0 1 nan 3 0 0 0 1\n", "gt.tum:1: .*NaN"),
        ("imu.csv", "0,0,0,0,1,0,0,0,0,0,x\n", "imu.csv:1: expected 11 numbers"),
    ],
)
def test_bad_files_next_to_the_sweeps(tmp_path: Path, name: str, text: str, match: str) -> None:
    folder = write_sweeps(tmp_path / "a")
    (folder / name).write_text(text)
    with pytest.raises(DatasetError, match=match):
        KittiDataset(folder).info()


def imu_values(count: int) -> np.ndarray:
    return np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (count, 1))


def test_imu_samples_are_put_in_order() -> None:
    problems: list[str] = []
    values = imu_values(5)
    values[:, 4] = np.arange(5)
    values[4, 5] = np.nan
    samples = clean_imu(np.array([20, 10, 10, 30, 40]), values, problems)
    assert samples is not None
    assert samples.stamps.tolist() == [10, 20, 30]
    assert samples.gyro[:, 0].tolist() == [1.0, 0.0, 3.0]
    assert len(problems) == 2
    clean: list[str] = []
    assert clean_imu(np.arange(5), imu_values(5), clean) is not None
    assert clean == []


def test_imu_in_g_is_converted_and_an_empty_one_is_none() -> None:
    problems: list[str] = []
    values = imu_values(4)
    values[:, 9] = 1.0
    samples = clean_imu(np.arange(4), values, problems)
    assert samples is not None
    np.testing.assert_allclose(samples.acceleration[:, 2], 9.80665)
    assert "in g" in problems[0]
    assert clean_imu(np.zeros(0, np.int64), np.zeros((0, 10)), problems) is None


def test_shared_folders(shared_data: Path) -> None:
    town = open_dataset(shared_data / "sim_town")
    assert len(town) == 60
    assert town.truth is not None
    assert len(town.truth) == 60
    assert town.imu is not None
    assert len(town.imu.stamps) == 1220
    ouster = open_dataset(shared_data / "ouster_os1_128")
    for sweep in ouster:
        assert isinstance(sweep, Scan)
        assert sweep.times is not None
        assert sweep.times.min() == 0.0
        assert 0.09 < sweep.times.max() < 0.1
    kitti = open_dataset(shared_data / "kitti_2011_09_26_0002")
    assert kitti.sensor["spin"] == "clockwise"
    assert kitti.info().facts["stamps"] == "0.000000 .. 4.020000 s"


# --- arrays ---------------------------------------------------------------------------------


def test_arrays() -> None:
    scans = [sweep_points(0), np.column_stack([sweep_points(1), np.ones(300)])]
    times = [np.linspace(0, 0.1, 300)] * 2
    rings = [np.arange(300) % 16] * 2
    dataset = ArrayDataset(scans, [0, 100_000_000], times=times, rings=rings, name="mine")
    assert isinstance(dataset, Dataset)
    got = list(dataset)
    assert [scan.stamp for scan in got] == [0, 100_000_000]
    np.testing.assert_array_equal(got[1].points, sweep_points(1))
    assert got[1].times is times[1]
    assert dataset.info().facts["point times"] == "given for 2 of 2 sweeps"
    again = ArrayDataset(iter(got))
    assert len(again) == 2
    assert list(again) == list(again) == got


def test_array_stamps_in_seconds() -> None:
    seconds = [1_700_000_000.25, 1_700_000_000.375]
    dataset = ArrayDataset([sweep_points(0)] * 2, stamps_s=seconds)
    assert [scan.stamp for scan in dataset] == [START + 250_000_000, START + 375_000_000]


def test_array_disorder_is_reported() -> None:
    assert "earlier" in ArrayDataset([sweep_points(0)] * 2, [5, 3]).info().problems[0]
    assert ArrayDataset([], []).info().problems == ["no sweeps"]


@pytest.mark.parametrize(
    ("arguments", "options", "match"),
    [
        (([np.zeros((3, 2))], [0]), {}, r"scans\[0\]: expected an \(N, 3\).*got \(3, 2\)"),
        (([[1.0, 2.0, 3.0]], [0]), {}, r"scans\[0\]: .*got list"),
        (([np.zeros((3, 3), int)], [0]), {}, r"scans\[0\]: Scan.points: .* floats"),
        (([np.zeros((3, 3))], [0.0]), {}, "makes them of seconds"),
        (([np.zeros((3, 3))],), {}, "give the stamps"),
        (([np.zeros((3, 3))], [0]), {"stamps_s": [0.0]}, "give the stamps of the sweeps once"),
        (([np.zeros((3, 3))],), {"stamps_s": [np.nan]}, "stamps_s: expected"),
        (([np.zeros((3, 3))], [0, 1]), {}, "stamps: expected 1 entries, got 2"),
        (([np.zeros((3, 3))], [0]), {"times": []}, "times: expected 1 entries, got 0"),
        (([np.zeros((3, 3))], [0]), {"times": [np.zeros(2)]}, r"scans\[0\]: Scan.times"),
        (([np.zeros((3, 3))], [0]), {"rings": [np.zeros(3)]}, r"scans\[0\]: Scan.rings"),
        (([Scan(np.zeros((3, 3)), 0)], [0]), {}, "carry their own"),
        (([Scan(np.zeros((3, 3)), 0), np.zeros((3, 3))],), {}, "only Scan objects"),
        (([np.zeros((3, 3))] * 3, [0, 10**5, 2 * 10**5]), {}, "100000 ns apart; expected nano"),
    ],
)
def test_bad_arrays(arguments: tuple[Any, ...], options: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        ArrayDataset(*arguments, **options)


# --- open_dataset ---------------------------------------------------------------------------


def test_a_folder_above_the_sweeps_says_where_they_are(tmp_path: Path) -> None:
    write_sweeps(tmp_path / "sequences" / "07" / "velodyne", 1)
    with pytest.raises(DatasetError, match=r"There may be sweeps in .*sequences/07/velodyne$"):
        open_dataset(tmp_path)
    file = next((tmp_path / "sequences" / "07" / "velodyne").rglob("*.bin"))
    with pytest.raises(DatasetError, match="one sweep; give the folder that holds them"):
        open_dataset(file)


def test_a_world_is_not_made_of_words() -> None:
    with pytest.raises(DatasetError, match="frames: expected a number, got 'few'"):
        open_dataset("sim:room?frames=few")
    for frames in ("2.5", "2.0", "inf", "nan"):
        with pytest.raises(ConfigError, match="frames: expected a whole number, got"):
            open_dataset(f"sim:room?frames={frames}")


def test_clouds_in_the_map_are_no_sweeps_while_there_are_others(tmp_path: Path) -> None:
    mapped = sweeps("ros1", 3, "/velodyne_cloud_registered")
    both = write_bag(tmp_path / "both", "ros1", [*mapped, *sweeps("ros1", 2, "/velodyne_points")])
    assert BagDataset(both).topic == "/velodyne_points"
    alone = BagDataset(write_bag(tmp_path / "alone", "ros1", mapped))
    assert any("do not map them again" in text for text in alone.info().problems)


def test_a_bag_of_packets_says_what_they_need(tmp_path: Path) -> None:
    recording = [("/imu", START, imu(ROS1, START))]
    path = write_bag(tmp_path / "run", "ros1", recording)
    with pytest.raises(DatasetError, match=r"no topic of type .*PointCloud2; .*Imu, 1\)$"):
        BagDataset(path)
    topics = {"/scan": ("sensor_msgs/msg/LaserScan", 3)}
    with pytest.raises(DatasetError, match=r"LaserScan, 3\)$"):
        choose_topic(path, topics, POINT_CLOUD, None, [])
    topics = {"/packets": ("velodyne_msgs/msg/VelodyneScan", 3)}
    with pytest.raises(DatasetError, match="raw packets become PointCloud2 with the driver"):
        choose_topic(path, topics, POINT_CLOUD, None, [])


def test_nothing_to_open(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no such file or folder; expected a folder with"):
        open_dataset(tmp_path / "none")
    with pytest.raises(DatasetError, match=r"no .bin sweeps; looked in the folder itself"):
        open_dataset(tmp_path)
    (tmp_path / "cloud.pcd").write_text("x")
    with pytest.raises(DatasetError, match=r"it has files .pcd; .*docs/own_sensor.md"):
        open_dataset(tmp_path)
    (tmp_path / "cloud.las").write_text("x")
    with pytest.raises(DatasetError, match=r"unknown kind of file '.las'; expected"):
        open_dataset(tmp_path / "cloud.las")
    (tmp_path / "a.bag").write_text("x")
    with pytest.raises(DatasetError, match=r"open one of its bags instead: a.bag"):
        open_dataset(tmp_path)
    with pytest.raises(DatasetError, match="not a folder"):
        KittiDataset(tmp_path / "a.bag")


def test_options_reach_the_loader_they_belong_to(tmp_path: Path) -> None:
    folder = write_sweeps(tmp_path / "a")
    assert len(open_dataset(folder, topic=None)) == 3  # None is not given
    with pytest.raises(DatasetError, match="KittiDataset takes no option topic; it takes vert"):
        open_dataset(folder, topic="/points")


def test_built_in_world() -> None:
    world = open_dataset("sim:room?frames=2&seed=3")
    assert len(world) == 2
    with pytest.raises(DatasetError, match="expected sim:SCENE"):
        open_dataset("sim:room?frames")
    with pytest.raises(DatasetError, match="takes no option colour"):
        open_dataset("sim:room?colour=red")
    with pytest.raises(LoamError, match="palace"):
        open_dataset("sim:palace")
