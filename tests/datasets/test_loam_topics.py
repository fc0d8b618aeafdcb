"""Bags with the topics of LOAM and A-LOAM: features, odometry and their axes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import (
    ROS1,
    START,
    Recording,
    cloud,
    imu,
    loam_recording,
    odometry,
    sweep_points,
    write_bag,
)

from loam_gtsam.datasets import BagDataset, LoamTopicsDataset, open_dataset
from loam_gtsam.datasets.decode.loam_messages import StampMatcher
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.types import BadSweep, DatasetError, FeatureSweep


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
    np.testing.assert_allclose(last.features.edges, flat, atol=1e-6)
    np.testing.assert_allclose(last.features.planes, flat, atol=1e-6)
    np.testing.assert_allclose(last.cloud, flat, atol=1e-6)
    np.testing.assert_allclose(last.odom_T_lidar.translation(), [2.0, 1.0, 0.1])
    quaternion = last.odom_T_lidar.rotation().toQuaternion()
    np.testing.assert_allclose(
        [quaternion.x(), quaternion.y(), quaternion.z()], [0.1, 0.2, 0.3], atol=1e-12
    )
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
    no_pose = odometry(ROS1, START, (0, 0, 0), (0,) * 4)
    recording = damaged(recording, {("/laser_odom_to_init", 0): no_pose})
    dataset = open_dataset(write_bag(tmp_path / "topics", "ros1", recording))
    got = list(dataset)
    assert [type(sweep) for sweep in got] == [BadSweep, FeatureSweep, FeatureSweep]
    assert "/laser_odom_to_init" in got[0].message
    assert got[1].cloud is None
    assert any("no /velodyne_cloud_3" in text for text in dataset.info().problems)


def without_x(stamp: int) -> Any:
    message = cloud(ROS1, stamp, sweep_points(0))
    message.fields = message.fields[1:]
    return message


def damaged(recording: Recording, damages: dict[tuple[str, int], Any]) -> Recording:
    """The recording with other messages of some topics and sweeps."""
    return [
        (topic, stamp, damages.get((topic, (stamp - START) // 100_000_000), message))
        for topic, stamp, message in recording
    ]


GARBAGE = b"\x00\x01\x00\x00garbage" * 3


def test_damaged_messages_of_loam_topics_are_bad_sweeps(tmp_path: Path) -> None:
    edges, planes = "/laser_cloud_corner_last", "/laser_cloud_surf_last"
    damages = {(planes, 0): without_x(START), (edges, 2): GARBAGE}
    recording = damaged(loam_recording(count=4), damages)
    dataset = LoamTopicsDataset(write_bag(tmp_path / "topics", "ros1", recording))
    got = list(dataset)
    assert [type(sweep) for sweep in got] == [BadSweep, FeatureSweep, BadSweep, FeatureSweep]
    assert "topic /laser_cloud_surf_last: " in got[0].message
    assert "topic /laser_cloud_corner_last: cannot deserialise" in got[2].message
    others = {"/laser_odom_to_init": 1, "/velodyne_cloud_3": 1}
    assert dataset.unmatched == {edges: 0, planes: 1, **others}


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
    damages = {("/velodyne_cloud_3", sweep): damage for sweep, damage in enumerate(faulty)}
    recording = damaged(loam_recording(loam_axes=True, count=4), damages)
    assert LoamTopicsDataset(write_bag(tmp_path / "all", "ros1", recording)).axes == "loam"
    short = [entry for entry in recording if entry[1] < START + 300_000_000]
    with pytest.raises(DatasetError, match=r"cannot tell the axes .*unknown"):
        LoamTopicsDataset(write_bag(tmp_path / "short", "ros1", short))


def test_recorded_poses_of_loam_are_optional_and_broken_ones_are_left_out(tmp_path: Path) -> None:
    mapped = "/aft_mapped_to_init"
    recording = loam_recording(count=4)
    damages = {(mapped, 0): odometry(ROS1, START, (0, 0, 0), (0,) * 4), (mapped, 2): GARBAGE}
    broken = damaged(recording, damages)
    broken.append(("/imu", START, imu(ROS1, START)))
    dataset = LoamTopicsDataset(write_bag(tmp_path / "broken", "ros1", broken))
    np.testing.assert_array_equal(dataset.recorded.stamps - START, [100_000_000, 300_000_000])
    info = dataset.info()
    assert info.facts["recorded result"] == f"{mapped}, 2 poses"
    assert info.facts["IMU topic"] == "/imu"
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
    mapped = read_tum(shared_data / name / "mapped.tum")
    np.testing.assert_allclose(dataset.recorded.map_T_lidar, mapped.map_T_lidar, atol=2e-9)
