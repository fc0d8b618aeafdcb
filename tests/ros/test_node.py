"""The ROS 2 node between messages and mapper, with a small stand-in for ROS."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from support.bags import ROS2, loam_recording, write_bag
from support.live_replay import IMU, POINTS, bag_of, recorded
from support.quick import QUICK

from loam_gtsam.config import LiveConfig, dump_config
from loam_gtsam.datasets import open_dataset
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.loops.map_correction import LoopMapping
from loam_gtsam.maps import save_map
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.ros.live_report import LiveReport
from loam_gtsam.ros.messages import (
    IN_MAP,
    IN_MAP_TYPES,
    INITIAL_POSE,
    ODOMETRY,
    PATH,
    REGISTERED,
    SURROUND,
    TF,
    TYPES,
)
from loam_gtsam.ros.node import PARAMETERS, LiveNode, config_of, main
from loam_gtsam.types import ConfigError, DatasetError, OutputError

FRAMES = 11
Raw = list[tuple[str, bytes]]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    world = SimulatedWorld("shaken", frames=FRAMES, columns=240)
    return bag_of(tmp_path_factory.mktemp("node") / "bag", recorded(world, "sqlite3"), "sqlite3")


@pytest.fixture(scope="module")
def offline(bag: Path) -> RunResult:
    return run(open_dataset(bag), QUICK)


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The file of the configuration of this run, for a node."""
    file = tmp_path_factory.mktemp("node") / "quick.yaml"
    file.write_text(dump_config(QUICK))
    return str(file)


def raw_messages(bag: Path) -> Raw:
    with AnyReader([bag], default_typestore=ROS2) as reader:
        return [(connection.topic, bytes(raw)) for connection, _, raw in reader.messages()]


def wait_for(condition: Callable[[], bool]) -> None:
    patience = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < patience
        time.sleep(0.002)


class FakeNode:
    """What the package uses of an ``rclpy.node.Node``."""

    def __init__(self, **parameters: Any) -> None:
        self.parameters = parameters
        self.declared: dict[str, Any] = {}
        self.subscribed: dict[str, Any] = {}
        self.callbacks: dict[str, Callable[[bytes], None]] = {}
        self.published: Raw = []
        self.said: list[str] = []
        self.report: Callable[[], None] = lambda: None
        self.calls: list[str] = []

    def declare_parameter(self, name: str, default: Any) -> Any:
        self.declared[name] = default
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        assert kind.__name__ == (TYPES | IN_MAP_TYPES)[topic].rpartition("/")[2]
        return SimpleNamespace(publish=lambda message: self.publish(topic, message))

    def publish(self, topic: str, message: bytes) -> None:
        assert type(message) is bytes
        assert len(message) % 4 == 0
        self.published.append((topic, message))

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[[bytes], None], qos: Any, *, raw: bool
    ) -> None:
        self.subscribed[topic] = (kind.__name__, qos.depth, qos.reliability, raw)
        self.callbacks[topic] = callback

    def create_timer(self, seconds: float, callback: Callable[[], None]) -> None:
        self.report = callback

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.said.append)

    def destroy_node(self) -> None:
        self.calls.append("destroy")


def module(name: str, **content: Any) -> ModuleType:
    made = ModuleType(name)
    vars(made).update(content)
    return made


@pytest.fixture(autouse=True)
def rclpy(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The modules of ROS 2, as far as the package imports them."""

    class ExternalShutdownException(Exception):  # noqa: N818
        pass

    made = module("rclpy", ended=ExternalShutdownException())
    reliability = SimpleNamespace(BEST_EFFORT="best effort")
    modules = [
        made,
        module("rclpy.executors", ExternalShutdownException=ExternalShutdownException),
        module("rclpy.qos", QoSProfile=SimpleNamespace, ReliabilityPolicy=reliability),
    ]
    kinds = {"sensor_msgs": "PointCloud2 Imu", "nav_msgs": "Odometry Path", "tf2_msgs": "TFMessage"}
    kinds["geometry_msgs"] = "PoseWithCovarianceStamped"
    for package, names in kinds.items():
        content = {name: type(name, (), {}) for name in names.split()}
        modules += [module(package), module(f"{package}.msg", **content)]
    for fake in modules:
        monkeypatch.setitem(sys.modules, fake.__name__, fake)
    return made


def play(node: FakeNode, live: LiveNode, messages: Raw, frames: int) -> None:
    """Start, hear the messages, and stop after so many frames."""
    live.start()
    for topic, raw in messages:
        if topic in node.callbacks:
            node.callbacks[topic](raw)
    wait_for(lambda: sum(live.live.report().statuses.values()) == frames)
    live.stop()


def assert_published(published: Raw, offline: RunResult) -> None:
    """The poses of the run on every frame, and the other topics as often as they are due."""
    counts = {topic: sum(name == topic for name, _ in published) for topic in TYPES}
    assert counts == {TF: FRAMES, ODOMETRY: FRAMES, REGISTERED: FRAMES, SURROUND: 3, PATH: 1}
    places = [
        ROS2.deserialize_cdr(raw, TYPES[topic]).pose.pose.position
        for topic, raw in published
        if topic == ODOMETRY
    ]
    np.testing.assert_array_equal(
        [[p.x, p.y, p.z] for p in places], [u.map_T_lidar.translation() for u in offline.updates]
    )
    # The pose goes out before the clouds, which take longer.
    assert [topic for topic, _ in published[:4]] == [TF, ODOMETRY, REGISTERED, SURROUND]


def test_the_node_maps_what_it_hears(
    monkeypatch: pytest.MonkeyPatch, rclpy: Any, bag: Path, offline: RunResult, quick: str
) -> None:
    node = FakeNode(imu_topic=IMU, config=quick)

    def spin(spun: object) -> None:
        assert spun is node
        for topic, raw in raw_messages(bag):
            node.callbacks[topic](raw)
        wait_for(lambda: [topic for topic, _ in node.published].count(ODOMETRY) == FRAMES)
        node.report()
        raise rclpy.ended

    rclpy.init = lambda args: node.calls.append(f"init {args}")
    rclpy.create_node = lambda name: node
    rclpy.spin = spin
    rclpy.try_shutdown = lambda: node.calls.append("shutdown")
    main(["--ros-args"])
    assert node.declared == PARAMETERS
    assert node.subscribed == {
        POINTS: ("PointCloud2", 20, "best effort", True),
        IMU: ("Imu", 1000, "best effort", True),
    }
    assert_published(node.published, offline)
    assert "sweeps mapped" in node.said[0]
    assert node.calls == ["init ['--ros-args']", "destroy", "shutdown"]
    node.parameters, node.calls = {"preset": "slow"}, []
    with pytest.raises(ConfigError, match="unknown preset 'slow'"):
        main()
    assert node.calls[1:] == ["destroy", "shutdown"]


def test_the_files_of_the_run_are_written_when_the_node_ends(
    bag: Path, offline: RunResult, quick: str, tmp_path: Path
) -> None:
    node = FakeNode(imu_topic=IMU, output=str(tmp_path / "run"), config=quick)
    live = LiveNode(node)
    for _ in range(2):  # a node that was refused holds nothing
        with pytest.raises(OutputError, match="another run uses this folder"):
            LiveNode(FakeNode(output=str(tmp_path / "run")))
    play(node, live, raw_messages(bag), FRAMES)
    LiveNode(FakeNode(output=str(tmp_path / "run")))  # the first one has ended
    written = read_tum(tmp_path / "run" / "trajectory.tum")
    np.testing.assert_allclose(written.map_T_lidar, offline.trajectory.map_T_lidar, atol=1e-8)


def test_what_waits_when_the_node_ends_is_in_the_files_and_not_published(
    bag: Path, quick: str, tmp_path: Path
) -> None:
    node = FakeNode(imu_topic=IMU, output=str(tmp_path / "run"), config=quick)
    live = LiveNode(node)
    node.callbacks[POINTS](dict(raw_messages(bag))[POINTS])
    live.start()
    live.stop()
    assert len(read_tum(tmp_path / "run" / "trajectory.tum")) == 1
    assert node.published == []


def test_frames_by_rep_105(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([1.0, 2.0, 0.5]))
    monkeypatch.setattr(LoopMapping, "map_T_odom", moved)
    settings = bag.parent / "loops.yaml"
    settings.write_text("loops: {enabled: true}\ndeskew: {model: predicted}\n")
    node = FakeNode(odom_frame="odom", map_frame="map", lidar_frame="lidar", config=str(settings))
    play(node, LiveNode(node), raw_messages(bag), FRAMES)
    read = [(topic, ROS2.deserialize_cdr(raw, TYPES[topic])) for topic, raw in node.published]
    chains = [message.transforms for topic, message in read if topic == TF]
    assert len(chains) == FRAMES
    for here, there in chains:
        assert (here.header.frame_id, here.child_frame_id) == ("odom", "lidar")
        assert (there.header.frame_id, there.child_frame_id) == ("map", "odom")
        assert here.header.stamp == there.header.stamp
        at, turn = there.transform.translation, there.transform.rotation
        rotation = gtsam.Rot3.Quaternion(turn.w, turn.x, turn.y, turn.z)
        assert gtsam.Pose3(rotation, np.array([at.x, at.y, at.z])).equals(moved, 1e-12)
    # Poses and clouds are where the mapper has them, in the frame that never jumps.
    assert {m.header.frame_id for topic, m in read if topic != TF} == {"odom"}
    with pytest.raises(ConfigError, match="odom_frame"):
        LiveNode(FakeNode(odom_frame="map", map_frame="map"))


def test_a_node_with_a_map_says_where_the_odometry_is_in_it(
    bag: Path, offline: RunResult, tmp_path: Path
) -> None:
    """Played from the fourth sweep on: there the frame of the odometry begins."""
    assert offline.pipeline is not None
    save_map(tmp_path / "map.lgmap", offline.pipeline)
    node = FakeNode(map=str(tmp_path), map_frame="map", lidar_frame="lidar")
    first = offline.updates[3].stamp
    messages = [
        (topic, raw)
        for topic, raw in raw_messages(bag)
        if topic == POINTS and stamp_of(ROS2.deserialize_cdr(raw, TYPES[REGISTERED])) >= first
    ]
    play(node, LiveNode(node), messages, FRAMES - 3)
    read = [ROS2.deserialize_cdr(raw, TYPES[TF]) for topic, raw in node.published if topic == TF]
    assert [len(message.transforms) for message in read] == [1] * 4 + [2] * (FRAMES - 7)
    for message in read[4:]:
        there = message.transforms[1]
        assert (there.header.frame_id, there.child_frame_id) == ("map", "odom")
        at = there.transform.translation
        began = offline.updates[3].map_T_lidar.translation()
        assert np.linalg.norm(np.array([at.x, at.y, at.z]) - began) < 0.05
    poses = [
        ROS2.deserialize_cdr(raw, IN_MAP_TYPES[IN_MAP])
        for topic, raw in node.published
        if topic == IN_MAP
    ]
    assert len(poses) == FRAMES - 6  # from the fix on, which the transform follows a sweep later
    for message, update in zip(poses, offline.updates[6:], strict=True):
        assert (message.header.frame_id, stamp_of(message)) == ("map", update.stamp)
        at, sigmas = message.pose.pose.position, np.sqrt(message.pose.covariance[[0, 7, 14]])
        away = np.array([at.x, at.y, at.z]) - update.map_T_lidar.translation()
        assert np.linalg.norm(away) < 0.05
        assert (sigmas > 0.0).all()
        assert (sigmas < 0.1).all()
    with pytest.raises(DatasetError, match="there is no such file"):
        LiveNode(FakeNode(map=str(tmp_path / "none.lgmap")))


def initial_pose(x: float, frame: str) -> bytes:
    kinds = ROS2.types
    stamp = kinds["builtin_interfaces/msg/Time"](0, 0)
    pose = kinds["geometry_msgs/msg/Pose"](
        kinds["geometry_msgs/msg/Point"](x, 0.0, 0.0),
        kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
    )
    kind = IN_MAP_TYPES[IN_MAP]
    covered = kinds["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
    message = kinds[kind](kinds["std_msgs/msg/Header"](stamp, frame), covered)
    return bytes(ROS2.serialize_cdr(message, kind))


def test_a_user_says_where_the_lidar_is_in_the_map(
    bag: Path, offline: RunResult, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert offline.pipeline is not None
    save_map(tmp_path / "map.lgmap", offline.pipeline)
    node = FakeNode(map=str(tmp_path), map_frame="map", lidar_frame="lidar")
    live = LiveNode(node)
    for x, frame in ((1.0, "odom"), (800.0, "map")):
        node.callbacks[INITIAL_POSE](initial_pose(x, frame))
    messages = [(topic, raw) for topic, raw in raw_messages(bag) if topic == POINTS]
    play(node, live, messages, FRAMES)
    ((reason, count),) = live.live.report().faults.items()
    assert (reason, count) == ("/initialpose: expected the frame map, got 'odom'", 1)
    assert "/initialpose: near: expected a position" in caplog.text
    assert any(topic == IN_MAP for topic, _ in node.published)  # found all the same

    node = FakeNode(map=str(tmp_path), map_frame="map", lidar_frame="lidar")
    live = LiveNode(node)
    asked: list[Any] = []
    assert live._in_map is not None
    live._in_map._localizer.reset = asked.append  # type: ignore[method-assign]
    node.callbacks[INITIAL_POSE](initial_pose(2.0, "map"))
    play(node, live, messages[:2], 2)
    ((x, y),) = asked
    assert (x, y) == (2.0, 0.0)


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def test_topics_of_loam_need_no_imu(tmp_path: Path) -> None:
    with AnyReader([write_bag(tmp_path / "topics", "ros1", loam_recording())]) as reader:
        messages = [
            (connection.topic, bytes(ROS2.ros1_to_cdr(raw, connection.msgtype)))
            for connection, _, raw in reader.messages()
        ]
    node = FakeNode(loam_topics=True, full_clouds=False, preset="aloam")
    play(node, LiveNode(node), messages, 3)
    assert len(node.subscribed) == 3
    assert node.subscribed["/laser_odom_to_init"][0] == "Odometry"
    assert {topic for topic, _ in node.published} == {TF, ODOMETRY, SURROUND}
    LiveNode(node := FakeNode(loam_topics=True))
    assert len(node.subscribed) == 4


def test_damaged_bytes_are_counted() -> None:
    live = LiveNode(node := FakeNode())
    node.callbacks[POINTS](b"\x00\x01\x00\x00 not a cloud")
    ((reason, count),) = live.live.report().faults.items()
    assert reason.startswith("/points: cannot deserialise a sensor_msgs/msg/PointCloud2")
    assert count == 1


def test_a_stamp_that_no_message_can_say_is_not_published_and_the_run_goes_on(
    bag: Path, quick: str, caplog: pytest.LogCaptureFixture
) -> None:
    node = FakeNode(config=quick)
    published: list[str] = []

    def publish(topic: str, raw: bytes) -> None:
        published.append(topic)
        if len(published) == 1:
            raise OutputError("stamp -1 ns")

    node.publish = publish  # type: ignore[method-assign]
    play(node, LiveNode(node), [entry for entry in raw_messages(bag) if entry[0] == POINTS][:2], 2)
    assert published == [TF, TF, ODOMETRY, REGISTERED, SURROUND]
    assert caplog.messages == ["not published: stamp -1 ns"]


def test_an_error_ends_the_thread_and_is_raised_when_it_is_stopped(bag: Path) -> None:
    node = FakeNode()

    def publish(topic: str, raw: bytes) -> None:
        raise RuntimeError("the network is gone")

    node.publish = publish  # type: ignore[method-assign]
    ended: list[bool] = []
    live = LiveNode(node, on_error=lambda: ended.append(True))
    live.start()
    node.callbacks[POINTS](dict(raw_messages(bag))[POINTS])
    wait_for(lambda: bool(ended))
    with pytest.raises(RuntimeError, match="the network is gone"):
        live.stop()


def test_parameters_make_the_configuration(tmp_path: Path) -> None:
    asked = {"preset": "aloam", "sensor": "vlp16", "map_frame": "map", "lidar_frame": "base"}
    config = config_of(PARAMETERS | asked)
    assert (config.solver.method, config.sensor.model) == ("aloam", "vlp16")
    assert (config.bag.map_frame, config.bag.lidar_frame) == ("map", "base")
    file = tmp_path / "my.yaml"
    file.write_text("live: {queue: 3}\nbag: {map_frame: world}\n")
    config = config_of(PARAMETERS | {"config": str(file)})
    assert (config.live.queue, config.bag.map_frame) == (3, "world")
    wrong: list[tuple[dict[str, str], type[Exception]]] = [
        ({"config": str(file), "preset": "loam"}, ConfigError),
        ({"sensor": "sonar"}, ConfigError),
        ({"map_frame": "same", "lidar_frame": "same"}, ConfigError),
        ({"axes": "camera"}, ConfigError),
        ({"time_unit": "hours"}, DatasetError),
        ({"output": str(file)}, OutputError),
    ]
    for parameters, error in wrong:
        with pytest.raises(error):
            LiveNode(FakeNode(**parameters))


def test_the_page_on_live_runs_lists_every_parameter_and_field() -> None:
    page = Path(__file__).resolve().parents[2] / "docs" / "live.md"
    text = page.read_text("utf-8")
    fields = [item.name for item in dataclasses.fields(LiveReport)]
    keys = [f"live.{key}" for key in LiveConfig.model_fields]
    assert [name for name in (*PARAMETERS, *fields, *keys) if f"`{name}`" not in text] == []


def test_without_ros_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(ImportError, match=r"source /opt/ros/DISTRO/setup.bash"):
        main()
