"""Bags hold what the run computed, in every format, and are whole whatever ends the run."""

from __future__ import annotations

import gc
import shutil
import sqlite3
import struct
import subprocess
from functools import partial
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from loam_gtsam.config import BagConfig
from loam_gtsam.datasets import open_dataset
from loam_gtsam.ros.bag_writer import BagWriter
from loam_gtsam.ros.messages import ODOMETRY, PATH, REGISTERED, SURROUND, TF, ros_covariance
from loam_gtsam.types import ConfigError, FrameStatus, InputError, MapUpdate, OutputError

pytestmark = pytest.mark.usefixtures("quick_start")

START = 1_700_000_000_123_456_789
NAMES = ("run.bag", "run.mcap", "run")


def make_update(number: int, status: FrameStatus = FrameStatus.OK) -> MapUpdate:
    rng = np.random.default_rng(number)
    root = rng.normal(size=(6, 6))
    return MapUpdate(
        stamp=START + number * 100_000_007,
        map_T_lidar=gtsam.Pose3.Expmap(rng.normal(0.0, 1.0, 6)),
        status=status,
        covariance=root @ root.T if status.solved else np.full((6, 6), np.nan),
        twist=rng.normal(size=6),
    )


def make_cloud(number: int, count: int = 40) -> np.ndarray:
    return np.random.default_rng(100 + number).uniform(-50.0, 50.0, (count, 4))


def write(path: Path, frames: int, config: BagConfig | None = None, **options: Any) -> Path:
    with BagWriter(path, config, **options) as bag:
        for number in range(frames):
            around = partial(make_cloud, 1000 + number)
            bag.write(make_update(number), make_cloud(number), around)
    return path


def read(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Topic -> (receive time, message) as rosbags reads them."""
    store = Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_JAZZY
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path], default_typestore=get_typestore(store)) as reader:
        for connection, received, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((received, message))
    return found


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def xyz(point: Any) -> list[float]:
    return [point.x, point.y, point.z]


def pose_of(position: Any, orientation: Any) -> gtsam.Pose3:
    rotation = gtsam.Rot3.Quaternion(orientation.w, *xyz(orientation))
    return gtsam.Pose3(rotation, np.array(xyz(position)))


def cloud_rows(message: Any) -> np.ndarray:
    """Decoded by the rules of sensor_msgs/PointCloud2, field by field."""
    assert [field.name for field in message.fields] == ["x", "y", "z", "intensity"]
    assert {(field.datatype, field.count) for field in message.fields} == {(7, 1)}
    offsets = [field.offset for field in message.fields]
    assert (message.height, message.row_step) == (1, message.width * message.point_step)
    assert not message.is_bigendian
    data = bytes(message.data)
    assert len(data) == message.row_step
    starts = [row * message.point_step for row in range(message.width)]
    return np.array([[struct.unpack_from("<f", data, s + at)[0] for at in offsets] for s in starts])


@pytest.mark.parametrize("name", NAMES)
def test_every_message_reads_back(tmp_path: Path, name: str) -> None:
    frames = 12
    found = read(write(tmp_path / name, frames))
    counts = {topic: len(messages) for topic, messages in found.items()}
    assert counts == {TF: 12, ODOMETRY: 12, REGISTERED: 12, SURROUND: 3, PATH: 2}
    assert [path.name for path in tmp_path.iterdir()] == [name]
    for number in range(frames):
        update = make_update(number)
        received, odometry = found[ODOMETRY][number]
        assert received == stamp_of(odometry) == update.stamp
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("camera_init", "aft_mapped")
        pose = pose_of(odometry.pose.pose.position, odometry.pose.pose.orientation)
        assert pose.equals(update.map_T_lidar, 1e-14)
        covariance = odometry.pose.covariance.reshape(6, 6)
        rotation = pose.rotation().matrix()
        ours = update.covariance
        np.testing.assert_allclose(covariance[:3, :3], rotation @ ours[3:, 3:] @ rotation.T)
        np.testing.assert_allclose(covariance[3:, 3:], rotation @ ours[:3, :3] @ rotation.T)
        np.testing.assert_allclose(covariance[:3, 3:], rotation @ ours[3:, :3] @ rotation.T)
        assert np.array_equal(covariance, covariance.T)
        twist = odometry.twist.twist
        assert xyz(twist.angular) + xyz(twist.linear) == update.twist.tolist()
        assert odometry.twist.covariance.tolist() == [-1.0] + [0.0] * 35

        received, transforms = found[TF][number]
        (transform,) = transforms.transforms
        assert received == stamp_of(transform) == update.stamp
        assert transform.header.frame_id == "camera_init"
        assert transform.child_frame_id == "aft_mapped"
        moved = pose_of(transform.transform.translation, transform.transform.rotation)
        assert moved.equals(update.map_T_lidar, 1e-14)

        received, cloud = found[REGISTERED][number]
        assert received == stamp_of(cloud) == update.stamp
        assert cloud.header.frame_id == "camera_init"
        assert cloud.is_dense
        assert np.array_equal(cloud_rows(cloud), make_cloud(number).astype("f4"))
    for number, (received, surround) in zip((0, 5, 10), found[SURROUND], strict=True):
        assert received == stamp_of(surround) == make_update(number).stamp
        assert np.array_equal(cloud_rows(surround), make_cloud(number + 1000).astype("f4"))
    for length, (_, path) in zip((10, 12), found[PATH], strict=True):
        assert len(path.poses) == length
        assert stamp_of(path) == make_update(length - 1).stamp
        for number, stamped in enumerate(path.poses):
            update = make_update(number)
            assert (stamp_of(stamped), stamped.header.frame_id) == (update.stamp, "camera_init")
            pose = pose_of(stamped.pose.position, stamped.pose.orientation)
            assert pose.equals(update.map_T_lidar, 1e-14)


@pytest.mark.parametrize("name", NAMES)
def test_our_own_loader_reads_the_registered_sweeps(tmp_path: Path, name: str) -> None:
    scans = list(open_dataset(write(tmp_path / name, 3)))
    assert [scan.stamp for scan in scans] == [make_update(n).stamp for n in range(3)]
    for number, scan in enumerate(scans):
        assert np.array_equal(scan.points, make_cloud(number)[:, :3].astype("f4"))


@pytest.mark.parametrize("name", NAMES)
def test_the_same_frames_give_the_same_bytes(tmp_path: Path, name: str) -> None:
    for folder in ("a", "b"):
        write(tmp_path / folder / name, 12)
    files = [path.relative_to(tmp_path / "a") for path in sorted(tmp_path.glob("a/**/*.*"))]
    assert files
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_frames_and_clouds_are_as_configured(tmp_path: Path) -> None:
    config = BagConfig(map_frame="map", lidar_frame="lidar", registered=False, surround_every=0)
    found = read(write(tmp_path / "run.bag", 6, config))
    assert set(found) == {TF, ODOMETRY, PATH}
    odometry = found[ODOMETRY][0][1]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "lidar")
    assert len(read(write(tmp_path / "two.bag", 6, BagConfig(surround_every=2)))[SURROUND]) == 3


def test_the_surroundings_are_asked_for_only_when_they_are_due(tmp_path: Path) -> None:
    asked = []
    with BagWriter(tmp_path / "run.bag") as bag:
        for number in range(11):
            bag.write(
                make_update(number), surround=lambda: asked.append(bag.frames) or make_cloud(0)
            )
    assert asked == [0, 5, 10]
    assert REGISTERED not in read(tmp_path / "run.bag")


def test_a_frame_with_a_bad_stamp_is_left_out(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run.bag") as bag:
        bag.write(make_update(0))
        bag.write(make_update(0, FrameStatus.BAD_STAMP))
        bag.write(make_update(1, FrameStatus.UNUSABLE_SCAN))
        assert bag.frames == 2
    found = read(tmp_path / "run.bag")
    assert [stamp for stamp, _ in found[ODOMETRY]] == [make_update(n).stamp for n in (0, 1)]
    assert len(found[PATH][0][1].poses) == 2


def test_all_paths_together_grow_as_the_run_does(tmp_path: Path) -> None:
    frames = 600
    with BagWriter(tmp_path / "run.bag") as bag:
        for number in range(frames):
            bag.write(make_update(number))
    lengths = [len(path.poses) for _, path in read(tmp_path / "run.bag")[PATH]]
    assert (lengths[0], lengths[-1]) == (10, frames)
    assert np.all(np.diff(lengths[:-1]) >= np.maximum(10, np.array(lengths[:-2]) // 10))
    assert sum(lengths) <= 12 * frames


def test_covariance_is_that_of_positions_and_turns_about_the_axes_of_the_map() -> None:
    rng = np.random.default_rng(3)
    pose = gtsam.Pose3.Expmap(np.array([0.7, -1.1, 2.0, 5.0, -3.0, 1.0]))
    root = 1e-3 * rng.normal(size=(6, 6))
    covariance = root @ root.T
    samples = []
    for tangent in rng.multivariate_normal(np.zeros(6), covariance, 20_000):
        moved = pose.retract(tangent)
        turned = moved.rotation().compose(pose.rotation().inverse())
        samples.append([*(moved.translation() - pose.translation()), *gtsam.Rot3.Logmap(turned)])
    ours = ros_covariance(covariance, pose).reshape(6, 6)
    sigmas = np.sqrt(np.diag(ours))
    difference = (np.cov(np.array(samples).T) - ours) / np.outer(sigmas, sigmas)
    assert np.abs(difference).max() < 0.04  # the noise of 20,000 samples is 0.01
    unturned = (np.cov(np.array(samples).T) - covariance) / np.outer(sigmas, sigmas)
    assert np.abs(unturned).max() > 0.3


@pytest.mark.parametrize("status", [FrameStatus.FIRST, FrameStatus.FEW_MATCHES])
def test_an_unknown_covariance_is_minus_one(tmp_path: Path, status: FrameStatus) -> None:
    with BagWriter(tmp_path / "run.mcap") as bag:
        bag.write(make_update(0, status))
        bag.write(make_update(1))
    unknown, known = (message for _, message in read(tmp_path / "run.mcap")[ODOMETRY])
    assert unknown.pose.covariance.tolist() == [-1.0] + [0.0] * 35
    assert known.pose.covariance[0] > 0.0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interrupted_run_leaves_a_whole_bag(
    tmp_path: Path, name: str, error: type[BaseException]
) -> None:
    def interrupted() -> None:
        with BagWriter(tmp_path / name) as bag:
            for number in range(3):
                bag.write(make_update(number), make_cloud(number))
            raise error

    with pytest.raises(error):
        interrupted()
    found = read(tmp_path / name)
    assert len(found[ODOMETRY]) == len(found[REGISTERED]) == 3
    assert len(found[PATH][-1][1].poses) == 3
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", NAMES)
def test_while_it_is_written_the_bag_is_called_active(tmp_path: Path, name: str) -> None:
    bag = BagWriter(tmp_path / name)
    bag.write(make_update(0))
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.active"]
    bag.close()
    bag.close()
    assert [path.name for path in tmp_path.iterdir()] == [name]
    with pytest.raises(OutputError, match="closed"):
        bag.write(make_update(1))
    with BagWriter(tmp_path / name, overwrite=True) as bag:
        left = list(tmp_path.iterdir())
    assert len(left) == 2  # without a frame there is no new bag
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_killed_process_loses_few_frames_of_a_database(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as bag:
        for number in range(60):
            bag.write(make_update(number))
        reader = sqlite3.connect(tmp_path / "run.active/run/run.db3")
        (count,) = reader.execute(
            "SELECT count(*) FROM messages JOIN topics ON topic_id = topics.id WHERE name = ?",
            (ODOMETRY,),
        ).fetchone()
        reader.close()
        assert count == 50


@pytest.mark.parametrize("error", [OSError(28, "No space left"), sqlite3.OperationalError("full")])
@pytest.mark.parametrize("fails", ["write", "close"])
def test_a_full_disk_is_a_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, fails: str
) -> None:
    bag = BagWriter(tmp_path / "run")
    bag.write(make_update(0))

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(bag._writer, fails, fail)
    with pytest.raises(OutputError, match=r"run: cannot write the bag: .*(No space|full)"):
        bag.close() if fails == "close" else bag.write(make_update(1))


@pytest.mark.parametrize("name", NAMES)
def test_an_earlier_bag_is_replaced_only_if_asked_and_when_complete(
    tmp_path: Path, name: str
) -> None:
    path = write(tmp_path / name, 2)
    with pytest.raises(OutputError, match=r"the bag exists; add overwrite=True"):
        BagWriter(path)
    with BagWriter(path, overwrite=True) as bag:
        bag.write(make_update(0))
        assert len(read(path)[ODOMETRY]) == 2
    assert len(read(path)[ODOMETRY]) == 1


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.parametrize("name", NAMES)
def test_a_cut_off_recording_is_kept_unless_overwritten(tmp_path: Path, name: str) -> None:
    BagWriter(tmp_path / name).write(make_update(0))
    gc.collect()
    with pytest.raises(OutputError, match=rf"{name}\.active: a recording that was cut off"):
        BagWriter(tmp_path / name)
    assert len(read(write(tmp_path / name, 2, overwrite=True))[ODOMETRY]) == 2


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.parametrize("name", NAMES)
def test_a_forgotten_recording_does_not_spoil_the_one_that_replaces_it(
    tmp_path: Path, name: str
) -> None:
    gc.disable()
    try:
        BagWriter(tmp_path / name).write(make_update(0))
        with BagWriter(tmp_path / name, overwrite=True) as bag:
            bag.write(make_update(0))
            gc.collect()
            bag.write(make_update(1))
    finally:
        gc.enable()
    assert len(read(tmp_path / name)[ODOMETRY]) == 2


@pytest.mark.parametrize(
    ("name", "inside"),
    [
        ("run", "notes.txt"),
        ("run", "metadata.yaml notes.txt"),
        ("run", "run.db3"),
        ("run.bag", "metadata.yaml"),
    ],
)
def test_a_folder_that_is_no_bag_is_never_replaced(tmp_path: Path, name: str, inside: str) -> None:
    (tmp_path / name).mkdir()
    for file in inside.split():
        (tmp_path / name / file).write_text("mine")
    with pytest.raises(OutputError, match="not a bag"):
        BagWriter(tmp_path / name, overwrite=True)
    assert sorted(path.name for path in (tmp_path / name).iterdir()) == sorted(inside.split())


@pytest.mark.parametrize("name", ["run.db3", "run.bagg", "."])
def test_a_name_that_fits_no_format_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match=r"ends in \.bag \(ROS 1\) or \.mcap"):
        BagWriter(name if name == "." else tmp_path / name)


def test_a_place_that_cannot_be_written_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write the bag"):
        BagWriter(tmp_path / "file/run.bag")
    write(tmp_path / "new/folder/run.bag", 1)


@pytest.mark.parametrize(("map_frame", "lidar_frame"), [("", "a"), ("a", ""), ("a", "a")])
def test_frames_need_two_names(tmp_path: Path, map_frame: str, lidar_frame: str) -> None:
    config = BagConfig(map_frame=map_frame, lidar_frame=lidar_frame)
    with pytest.raises(ConfigError, match="two different names"):
        BagWriter(tmp_path / "run.bag", config)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("stamp", "fits"), [(-1, False), (0, True), (2**31 * 10**9 - 1, True), (2**31 * 10**9, False)]
)
def test_stamps_have_a_range(tmp_path: Path, name: str, stamp: int, fits: bool) -> None:
    update = MapUpdate(stamp, gtsam.Pose3(), FrameStatus.FIRST)
    with BagWriter(tmp_path / name) as bag:
        if not fits:
            with pytest.raises(OutputError, match=f"stamp {stamp} ns: a ROS message takes"):
                bag.write(update)
            return
        bag.write(update)
    assert stamp_of(read(tmp_path / name)[ODOMETRY][0][1]) == stamp


def test_a_cloud_has_four_columns_and_may_be_empty_or_have_holes(tmp_path: Path) -> None:
    holes = make_cloud(0)
    holes[3, 1] = np.nan
    with BagWriter(tmp_path / "run.bag") as bag:
        with pytest.raises(InputError, match=r"\(N, 4\) floats, got shape \(40, 3\)"):
            bag.write(make_update(0), make_cloud(0)[:, :3])
        bag.write(make_update(1), np.zeros((0, 4)))
        bag.write(make_update(2), holes)
    found = read(tmp_path / "run.bag")
    assert len(found[TF]) == len(found[ODOMETRY]) == 2  # nothing of the frame that was refused
    empty, broken = (message for _, message in found[REGISTERED])
    assert (empty.width, len(empty.data), empty.is_dense) == (0, 0, True)
    assert (broken.width, broken.is_dense) == (40, False)


def test_the_first_record_is_as_long_as_rosbag_takes_it_to_be(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "run.bag")
    bag.write(make_update(0), make_cloud(0, 70_000))  # more than a chunk: it is on the disk
    for path in (tmp_path / "run.bag.active", tmp_path / "run.bag"):
        content = path.read_bytes()
        (header,) = struct.unpack_from("<I", content, 13)
        (padding,) = struct.unpack_from("<I", content, 17 + header)
        assert header + padding == 4096
        (following,) = struct.unpack_from("<I", content, 13 + 8 + 4096)
        assert b"op=\x05" in content[13 + 12 + 4096 :][:following]  # a chunk
        bag.close()


@pytest.mark.skipif(shutil.which("rosbag") is None, reason="the rosbag tool is not installed")
def test_rosbag_repairs_what_a_killed_process_left(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "run.bag")
    for number in range(4):
        bag.write(make_update(number), make_cloud(number, 70_000))
    bag._writer.bio.flush()
    left = shutil.copy(tmp_path / "run.bag.active", tmp_path / "left.bag")
    subprocess.run(["rosbag", "reindex", left], check=True, timeout=60)
    assert len(read(tmp_path / "left.bag")[REGISTERED]) == 4
