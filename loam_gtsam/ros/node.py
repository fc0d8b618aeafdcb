"""The ROS 2 node: ``python -m loam_gtsam.ros --ros-args -p cloud_topic:=/points``.

Messages cross the border to ROS as bytes and are read by rosbags, as those of a bag are: the node
needs no message package to decode, and what is mapped live and from a bag is the same.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from functools import partial
from importlib import import_module
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.config import Config, load_config, preset
from loam_gtsam.datasets.decode.loam_messages import CLOUD, REQUIRED
from loam_gtsam.datasets.decode.loam_messages import ODOMETRY as LOAM_ODOMETRY
from loam_gtsam.datasets.decode.pointcloud2 import CloudStream
from loam_gtsam.io.atomic import make_folder, used_alone
from loam_gtsam.io.run_files import write_run
from loam_gtsam.pipeline import Pipeline
from loam_gtsam.ros.in_map import InMap
from loam_gtsam.ros.live import LiveMapper
from loam_gtsam.ros.messages import (
    IN_MAP,
    IN_MAP_TYPES,
    INITIAL_POSE,
    ODOMETRY,
    REGISTERED,
    TYPES,
    FrameMessages,
)
from loam_gtsam.types import ConfigError, MapUpdate, OutputError, Sweep
from loam_gtsam.view.observers import registered_cloud, surrounding_cloud

PARAMETERS: dict[str, Any] = {
    "cloud_topic": "/points",
    "imu_topic": "",
    "loam_topics": False,
    "full_clouds": True,
    "axes": "auto",
    "preset": "default",
    "config": "",
    "sensor": "auto",
    "map_frame": "",
    "lidar_frame": "",
    "odom_frame": "",
    "time_field": "",
    "time_unit": "",
    "stamp_is": "",
    "map": "",
    "inside": False,
    "output": "",
    "report_every": 10.0,
}
"""Parameters of the node with their defaults; an empty text is none. See docs/live.md."""

_CLOUD_OPTIONS = ("time_field", "time_unit", "stamp_is")
_CLOUD_TYPE, _IMU_TYPE = TYPES[REGISTERED], "sensor_msgs/msg/Imu"
_IMU_DEPTH = 1000  # IMU messages that ROS keeps while Python is busy
_DEPTH = 10  # published messages of a topic that ROS keeps for a slow subscriber
_log = logging.getLogger(__name__)


class LiveNode:
    """A live run between the subscriptions and publishers of a ROS 2 node.

    Raises LoamError if a parameter is wrong, or the output folder cannot be made or is in use.

    The constructor declares the parameters of ``node``, an ``rclpy.node.Node``, subscribes and
    advertises; ``on_error`` is called when an error ends the thread that maps.
    """

    def __init__(self, node: Any, on_error: Callable[[], object] = lambda: None) -> None:
        values = {key: node.declare_parameter(key, v).value for key, v in PARAMETERS.items()}
        config = config_of(values)
        odom = values["odom_frame"] or ("odom" if values["map"] else "")
        self._messages = FrameMessages(config.bag, odom_frame=odom)
        self._read = self._messages.store.deserialize_cdr
        self._features: tuple[str, ...] = ()
        if values["loam_topics"]:
            self._features = (*REQUIRED, CLOUD) if values["full_clouds"] else REQUIRED
        self.live = LiveMapper(
            config,
            imu=bool(values["imu_topic"]),
            features=self._features,
            axes=values["axes"],
            clouds=CloudStream(**{key: values[key] or None for key in _CLOUD_OPTIONS}),
            observe=self._observe,
        )
        self._output = make_folder(values["output"]) if values["output"] else None
        self._held = ExitStack()
        if self._output is not None:
            self._held.enter_context(used_alone(self._output))
        self._in_map, self._map_frame = None, config.bag.map_frame
        if values["map"]:
            self._in_map = InMap(values["map"], config, inside=values["inside"])
            self._held.callback(self._in_map.close)
        self._updates: list[MapUpdate] = []
        self._on_error = on_error
        self._error: Exception | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="loam_gtsam", daemon=True)
        self._publishers = {
            topic: node.create_publisher(_message_class(kind), topic, _DEPTH)
            for topic, kind in (TYPES | (IN_MAP_TYPES if values["map"] else {})).items()
        }
        self._subscribe(node, values["cloud_topic"], values["imu_topic"], config.live.queue)
        if values["report_every"] > 0.0:
            logger = node.get_logger()
            node.create_timer(values["report_every"], lambda: logger.info(str(self.live.report())))

    def start(self) -> None:
        """Begin to map, in a thread of its own."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread between two sweeps, and write the run if there is a folder for it.

        What still waits is mapped for the run that is written, and not published.
        The error that ended the thread earlier, if any, is raised again.
        """
        self._stop.set()
        self._thread.join()
        with self._held:
            if self._output is not None and self._error is None:
                self.live.finish()
            if self._output is not None and self._updates:
                result = self.live.pipeline.result(self._updates, error=self._error)
                write_run(result, self._output, dataset="live")
        if self._error is not None:
            raise self._error

    def _subscribe(self, node: Any, cloud: str, imu: str, queue: int) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        kinds = dict.fromkeys(self._features or (cloud,), _CLOUD_TYPE)
        if self._features:
            kinds[LOAM_ODOMETRY] = TYPES[ODOMETRY]
        if imu:
            kinds[imu] = _IMU_TYPE
        if self._in_map is not None:
            kinds[INITIAL_POSE] = IN_MAP_TYPES[IN_MAP]
        for topic, kind in kinds.items():
            # Best effort, for it takes from reliable publishers too.
            depth = _IMU_DEPTH if kind == _IMU_TYPE else queue
            qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
            receive = partial(self._receive, topic, kind)
            node.create_subscription(_message_class(kind), topic, receive, qos, raw=True)

    def _receive(self, topic: str, kind: str, raw: bytes) -> None:
        try:
            message = self._read(raw, kind)
        except Exception as error:  # whatever damage makes it stumble over
            self.live.fault(f"{topic}: cannot deserialise a {kind}: {type(error).__name__}")
            return
        if kind == _IMU_TYPE:
            self.live.add_imu(message)
        elif topic == INITIAL_POSE:
            self._look_near(message)
        elif topic in self._features:
            self.live.add_features(topic, message)
        else:
            self.live.add_cloud(message)

    def _look_near(self, message: Any) -> None:
        """Look for the lidar where a user says that it is; RViz tells no height."""
        frame, at = message.header.frame_id, message.pose.pose.position
        if frame != self._map_frame:
            self.live.fault(f"{INITIAL_POSE}: expected the frame {self._map_frame}, got {frame!r}")
        elif self._in_map is not None:
            self._in_map.look_near(np.array([at.x, at.y]))

    def _work(self) -> None:
        try:
            self.live.work(self._stop)
        except Exception as error:  # handed to the thread that asks to stop
            self._error = error
            self._on_error()

    def _observe(self, sweep: Sweep, update: MapUpdate, pipeline: Pipeline) -> None:
        if self._output is not None:
            self._updates.append(update)
        map_T_odom: gtsam.Pose3 | None = gtsam.Pose3()
        if self._in_map is not None:
            map_T_odom = self._in_map.map_T_odom
        elif pipeline.loops is not None:
            map_T_odom = pipeline.loops.map_T_odom
        frame = self._messages.frame(
            update,
            lambda: registered_cloud(sweep, update, pipeline.mapper),
            lambda: surrounding_cloud(update, pipeline.mapper),
            map_T_odom,
        )
        self._publish(frame)
        if self._in_map is not None:  # after the pose has gone out, for the next one
            self._publish(self._messages.in_map(self._in_map.add(sweep, update)))

    def _publish(self, messages: Iterable[tuple[str, bytes]]) -> None:
        if self._stop.is_set():  # ROS may have been shut down
            return
        try:
            for topic, message in messages:
                # RTPS pads to words of four bytes, which not every middleware does for bytes.
                self._publishers[topic].publish(message + bytes(-len(message) % 4))
        except OutputError as error:
            _log.warning("not published: %s", error)


def config_of(values: Mapping[str, Any]) -> Config:
    """The configuration that the parameters of a node ask for; ConfigError if they are wrong."""
    if values["config"] and values["preset"] != "default":
        raise ConfigError("give preset or config, not both; a file names its preset itself")
    config = load_config(values["config"]) if values["config"] else preset(values["preset"])
    if values["sensor"] != "auto":
        config = config.changed({"sensor.model": values["sensor"]})
    frames = {name: values[name] for name in ("map_frame", "lidar_frame") if values[name]}
    return config.changed(bag=config.bag.changed(**frames))


def main(arguments: list[str] | None = None) -> None:
    """Run the node until it is interrupted; LoamError if a parameter is wrong."""
    try:
        import rclpy
        from rclpy.executors import ExternalShutdownException
    except ImportError as error:
        raise ImportError(
            "loam_gtsam.ros needs rclpy of ROS 2: source /opt/ros/DISTRO/setup.bash first, and use "
            "the Python of that distribution (3.11 or newer: Jazzy or later)"
        ) from error
    rclpy.init(args=arguments)
    node = rclpy.create_node("loam_gtsam")
    try:
        run = LiveNode(node, on_error=rclpy.try_shutdown)
        run.start()
        try:
            rclpy.spin(node)
        except (KeyboardInterrupt, ExternalShutdownException):
            pass
        finally:
            run.stop()
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _message_class(kind: str) -> Any:
    package, _, name = kind.partition("/msg/")
    return getattr(import_module(f"{package}.msg"), name)
