"""The ROS 2 node between messages and mapper, with a small stand-in for ROS."""

from __future__ import annotations

import dataclasses
import importlib
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from support.bags import loam_recording, write_bag
from support.live_replay import IMU, POINTS, bag_of, recorded

from loam_gtsam.config import LiveConfig
from loam_gtsam.datasets import open_dataset
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.ros.frame_messages import ODOMETRY, PATH, REGISTERED, SURROUND, TF, TYPES
from loam_gtsam.ros.live_report import LiveReport
from loam_gtsam.ros.messages import Messages
from loam_gtsam.ros.topics import PARAMETERS, RosRun, config_of
from loam_gtsam.types import ConfigError, DatasetError, OutputError

FRAMES = 11
Raw = list[tuple[str, bytes]]


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("nodes")
    world = SimulatedWorld("shaken", frames=FRAMES, columns=240)
    return {
        kind: bag_of(folder / kind, recorded(world, kind), kind) for kind in ("ros1", "sqlite3")
    }


@pytest.fixture(scope="module")
def offline(bags: dict[str, Path]) -> RunResult:
    return run(open_dataset(bags["ros1"]))


def raw_messages(bag: Path) -> Raw:
    store = get_typestore(Stores.ROS1_NOETIC if bag.suffix == ".bag" else Stores.ROS2_HUMBLE)
    with AnyReader([bag], default_typestore=store) as reader:
        return [(connection.topic, bytes(raw)) for connection, _, raw in reader.messages()]


def values(**changed: Any) -> dict[str, Any]:
    return PARAMETERS | changed


def wait_for(condition: Callable[[], bool]) -> None:
    patience = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < patience
        time.sleep(0.002)


def assert_published(published: Raw, ros1: bool, offline: RunResult) -> None:
    """The poses of the run on every frame, and the other topics as often as they are due."""
    counts = {topic: sum(name == topic for name, _ in published) for topic in TYPES}
    assert counts == {TF: FRAMES, ODOMETRY: FRAMES, REGISTERED: FRAMES, SURROUND: 3, PATH: 1}
    store = Messages(ros1, "a", "b").store
    read = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    places = [
        read(raw, TYPES[topic]).pose.pose.position for topic, raw in published if topic == ODOMETRY
    ]
    np.testing.assert_array_equal(
        [[p.x, p.y, p.z] for p in places], [u.map_T_lidar.translation() for u in offline.updates]
    )
    # The pose goes out before the clouds, which take longer.
    assert [topic for topic, _ in published[:4]] == [TF, ODOMETRY, REGISTERED, SURROUND]


# --- what both share ------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_serialised_messages_go_in_and_come_out(
    bags: dict[str, Path], offline: RunResult, tmp_path: Path, kind: str
) -> None:
    published: Raw = []
    ros = RosRun(
        values(cloud_topic=POINTS, imu_topic=IMU, output=str(tmp_path / "run")),
        lambda topic, raw: published.append((topic, raw)),
        ros1=kind == "ros1",
    )
    assert ros.subscriptions == {
        POINTS: "sensor_msgs/msg/PointCloud2",
        IMU: "sensor_msgs/msg/Imu",
    }
    assert ros.depths == {POINTS: 20, IMU: 1000}
    ros.start()
    for topic, raw in raw_messages(bags[kind]):
        ros.receive(topic, raw)
    wait_for(lambda: sum(ros.live.report().statuses.values()) == FRAMES)
    ros.stop()
    assert_published(published, kind == "ros1", offline)
    written = read_tum(tmp_path / "run" / "trajectory.tum")
    np.testing.assert_allclose(written.map_T_lidar, offline.trajectory.map_T_lidar, atol=1e-8)


def test_topics_of_loam_need_no_imu(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "topics", "ros1", loam_recording())
    published: Raw = []
    asked = values(loam_topics=True, full_clouds=False, preset="aloam")
    ros = RosRun(asked, lambda topic, raw: published.append((topic, raw)), ros1=True)
    assert len(ros.subscriptions) == 3
    assert ros.subscriptions["/laser_odom_to_init"] == "nav_msgs/msg/Odometry"
    ros.start()
    for topic, raw in raw_messages(bag):
        if topic in ros.subscriptions:
            ros.receive(topic, raw)
    wait_for(lambda: sum(ros.live.report().statuses.values()) == 3)
    ros.stop()
    assert {topic for topic, _ in published} == {TF, ODOMETRY, SURROUND}
    assert len(RosRun(values(loam_topics=True), print, ros1=True).subscriptions) == 4


def test_damaged_bytes_are_counted(bags: dict[str, Path]) -> None:
    ros = RosRun(values(), print, ros1=False)
    ros.receive(POINTS, b"\x00\x01\x00\x00 not a cloud")
    ((reason, count),) = ros.live.report().faults.items()
    assert reason.startswith("/points: cannot deserialise a sensor_msgs/msg/PointCloud2")
    assert count == 1


def test_a_stamp_that_no_message_can_say_is_not_published_and_the_run_goes_on(
    bags: dict[str, Path], caplog: pytest.LogCaptureFixture
) -> None:
    published: list[str] = []

    def publish(topic: str, raw: bytes) -> None:
        published.append(topic)
        if len(published) == 1:
            raise OutputError("stamp -1 ns")

    ros = RosRun(values(cloud_topic=POINTS), publish, ros1=True)
    ros.start()
    clouds = [entry for entry in raw_messages(bags["ros1"]) if entry[0] == POINTS]
    for topic, raw in clouds[:2]:
        ros.receive(topic, raw)
    wait_for(lambda: sum(ros.live.report().statuses.values()) == 2)
    ros.stop()
    assert published == [TF, TF, ODOMETRY, REGISTERED, SURROUND]
    assert caplog.messages == ["not published: stamp -1 ns"]


def test_an_error_ends_the_thread_and_is_raised_when_it_is_stopped(bags: dict[str, Path]) -> None:
    def publish(topic: str, raw: bytes) -> None:
        raise RuntimeError("the network is gone")

    ended: list[bool] = []
    asked = values(cloud_topic=POINTS)
    ros = RosRun(asked, publish, ros1=True, on_error=lambda: ended.append(True))
    ros.start()
    ros.receive(*next(entry for entry in raw_messages(bags["ros1"]) if entry[0] == POINTS))
    wait_for(lambda: bool(ended))
    with pytest.raises(RuntimeError, match="the network is gone"):
        ros.stop()


def test_parameters_make_the_configuration(tmp_path: Path) -> None:
    config = config_of(values(preset="aloam", sensor="vlp16", map_frame="map", lidar_frame="base"))
    assert config.solver.method == "aloam"
    assert config.sensor.model == "vlp16"
    assert (config.bag.map_frame, config.bag.lidar_frame) == ("map", "base")
    file = tmp_path / "my.yaml"
    file.write_text("live: {queue: 3}\nbag: {map_frame: world}\n")
    config = config_of(values(config=str(file)))
    assert (config.live.queue, config.bag.map_frame) == (3, "world")
    for wrong, error in (
        ({"config": str(file), "preset": "loam"}, ConfigError),
        ({"preset": "slow"}, ConfigError),
        ({"sensor": "sonar"}, ConfigError),
        ({"map_frame": "same", "lidar_frame": "same"}, ConfigError),
        ({"axes": "camera"}, ConfigError),
        ({"time_unit": "hours"}, DatasetError),
        ({"output": str(file)}, OutputError),
    ):
        with pytest.raises(error):
            RosRun(values(**wrong), print, ros1=True)


def test_the_page_on_live_runs_lists_every_parameter_and_field() -> None:
    page = Path(__file__).resolve().parents[2] / "docs" / "live.md"
    text = page.read_text("utf-8")
    fields = [item.name for item in dataclasses.fields(LiveReport)]
    keys = [f"live.{key}" for key in LiveConfig.model_fields]
    assert [name for name in (*PARAMETERS, *fields, *keys) if f"`{name}`" not in text] == []


# --- ROS 2, as far as the node calls it -----------------------------------------------------


class FakeRos2:
    """What the node uses of rclpy, and a network that plays messages while it spins."""

    def __init__(self, parameters: dict[str, Any], messages: Raw) -> None:
        self.parameters, self.messages = parameters, messages
        self.declared: dict[str, Any] = {}
        self.subscribed: dict[str, Any] = {}
        self.callbacks: dict[str, Callable[[bytes], None]] = {}
        self.published: Raw = []
        self.said: list[str] = []
        self.report: Callable[[], None] = lambda: None
        self.calls: list[str] = []

    # the node

    def declare_parameter(self, name: str, default: Any) -> Any:
        self.declared[name] = default
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        assert kind.__name__ == TYPES[topic].rpartition("/")[2]

        def publish(message: object) -> None:
            assert type(message) is bytes
            assert len(message) % 4 == 0
            self.published.append((topic, message))

        return SimpleNamespace(publish=publish)

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

    # the module

    def spin(self, node: FakeRos2) -> None:
        assert node is self
        for topic, raw in self.messages:
            self.callbacks[topic](raw)
        wait_for(lambda: sum(topic == PATH for topic, _ in self.published) == 1)
        self.report()
        raise self.shutdown_error

    def modules(self) -> Iterator[ModuleType]:
        class ExternalShutdownException(Exception):  # noqa: N818
            pass

        self.shutdown_error = ExternalShutdownException()
        yield module(
            "rclpy",
            init=lambda args: self.calls.append(f"init {args}"),
            create_node=lambda name: self,
            spin=self.spin,
            try_shutdown=lambda: self.calls.append("shutdown"),
        )
        yield module("rclpy.executors", ExternalShutdownException=ExternalShutdownException)
        yield module(
            "rclpy.qos",
            QoSProfile=SimpleNamespace,
            ReliabilityPolicy=SimpleNamespace(BEST_EFFORT="best effort"),
        )
        for package, *names in (
            ("sensor_msgs", "PointCloud2", "Imu"),
            ("nav_msgs", "Odometry", "Path"),
            ("tf2_msgs", "TFMessage"),
        ):
            yield module(package)
            yield module(f"{package}.msg", **{name: type(name, (), {}) for name in names})


def module(name: str, **content: Any) -> ModuleType:
    made = ModuleType(name)
    vars(made).update(content)
    return made


def imported(monkeypatch: pytest.MonkeyPatch, name: str, *modules: ModuleType) -> Any:
    """A module of the package, imported while these are there in place of ROS."""
    for fake in modules:
        monkeypatch.setitem(sys.modules, fake.__name__, fake)
    monkeypatch.delitem(sys.modules, name, raising=False)
    node = importlib.import_module(name)
    monkeypatch.delitem(sys.modules, name)
    return node


def test_the_ros_2_node_maps_what_it_hears(
    monkeypatch: pytest.MonkeyPatch, bags: dict[str, Path], offline: RunResult
) -> None:
    world = FakeRos2({"imu_topic": IMU}, raw_messages(bags["sqlite3"]))
    node = imported(monkeypatch, "loam_gtsam.ros.node", *world.modules())
    node.main(["--ros-args"])
    assert world.declared == PARAMETERS
    assert world.subscribed == {
        POINTS: ("PointCloud2", 20, "best effort", True),
        IMU: ("Imu", 1000, "best effort", True),
    }
    assert_published(world.published, False, offline)
    assert "sweeps mapped" in world.said[0]
    assert world.calls == ["init ['--ros-args']", "destroy", "shutdown"]


def test_a_wrong_parameter_ends_the_ros_2_node(monkeypatch: pytest.MonkeyPatch) -> None:
    world = FakeRos2({"preset": "slow"}, [])
    node = imported(monkeypatch, "loam_gtsam.ros.node", *world.modules())
    with pytest.raises(ConfigError, match="unknown preset 'slow'"):
        node.main()
    assert world.calls[1:] == ["destroy", "shutdown"]


def test_without_ros_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "loam_gtsam.ros.node"
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(ImportError, match=r"source /opt/ros/DISTRO/setup.bash"):
        importlib.import_module(name)
