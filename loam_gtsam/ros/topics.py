"""What a ROS 1 and a ROS 2 node share: parameters, topics, and the thread that maps.

Messages cross the border to ROS as bytes and are read by rosbags, as those of a bag are. So a node
needs no message packages to decode, and what is mapped live and from a bag is the same.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

from rosbags.typesys import Stores, get_typestore

from loam_gtsam.config import Config, load_config, preset
from loam_gtsam.datasets.decode.cloud_stream import CloudStream
from loam_gtsam.datasets.decode.loam_messages import CLOUD, REQUIRED
from loam_gtsam.datasets.decode.loam_messages import ODOMETRY as LOAM_ODOMETRY
from loam_gtsam.io.atomic import make_folder
from loam_gtsam.io.run_files import write_run
from loam_gtsam.pipeline import Pipeline
from loam_gtsam.ros.frame_messages import ODOMETRY, REGISTERED, TYPES, FrameMessages
from loam_gtsam.ros.live import LiveMapper
from loam_gtsam.types import ConfigError, MapUpdate, OutputError, Sweep
from loam_gtsam.view.clouds import registered_cloud, surrounding_cloud

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
    "time_field": "",
    "time_unit": "",
    "stamp_is": "",
    "output": "",
    "report_every": 10.0,
}
"""Parameters of a node with their defaults; an empty text is none. See docs/live.md."""

CLOUD_TYPE = TYPES[REGISTERED]
IMU_TYPE = "sensor_msgs/msg/Imu"
IMU_DEPTH = 1000
"""IMU messages that ROS keeps while Python is busy."""

_log = logging.getLogger(__name__)


class RosRun:
    """A live run between subscriptions and publishers.

    Parameters
    ----------
    values : of all :data:`PARAMETERS`
    publish : takes a topic of :data:`loam_gtsam.ros.frame_messages.TYPES` and a serialised message;
        called from the thread that maps
    ros1 : messages are those of ROS 1
    on_error : called when an error ends that thread

    Attributes
    ----------
    live : what maps
    messages : makes what is published
    subscriptions : topic -> type
    depths : topic -> messages that ROS should keep

    Raises
    ------
    LoamError
        If a parameter is wrong, or the output folder cannot be made.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        publish: Callable[[str, bytes], None],
        *,
        ros1: bool,
        on_error: Callable[[], None] = lambda: None,
    ) -> None:
        config = config_of(values)
        self._publish, self._on_error = publish, on_error
        self.messages = FrameMessages(config.bag, ros1=ros1)
        store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        self._read = store.deserialize_ros1 if ros1 else store.deserialize_cdr
        cloud, imu = values["cloud_topic"], values["imu_topic"]
        features: tuple[str, ...] = ()
        if values["loam_topics"]:
            features = (*REQUIRED, CLOUD) if values["full_clouds"] else REQUIRED
        self.subscriptions = dict.fromkeys(features or (cloud,), CLOUD_TYPE)
        if features:
            self.subscriptions[LOAM_ODOMETRY] = TYPES[ODOMETRY]
        if imu:
            self.subscriptions[imu] = IMU_TYPE
        self.depths = {
            topic: IMU_DEPTH if kind == IMU_TYPE else config.live.queue
            for topic, kind in self.subscriptions.items()
        }
        self.live = LiveMapper(
            config,
            imu=bool(imu),
            features=features,
            axes=values["axes"],
            clouds=CloudStream(
                time_field=values["time_field"] or None,
                time_unit=values["time_unit"] or None,
                stamp_is=values["stamp_is"] or None,
            ),
            observe=self._observe,
        )
        self._features = frozenset(features)
        self._output = make_folder(values["output"]) if values["output"] else None
        self._updates: list[MapUpdate] = []
        self._error: Exception | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="loam_gtsam", daemon=True)

    def receive(self, topic: str, raw: bytes) -> None:
        """Take a serialised message of one of the subscriptions, from any thread."""
        kind = self.subscriptions[topic]
        try:
            message = self._read(raw, kind)
        except Exception as error:  # whatever damage makes it stumble over
            self.live.fault(f"{topic}: cannot deserialise a {kind}: {type(error).__name__}")
            return
        if kind == IMU_TYPE:
            self.live.add_imu(message)
        elif topic in self._features:
            self.live.add_features(topic, message)
        else:
            self.live.add_cloud(message)

    def start(self) -> None:
        """Begin to map, in a thread of its own."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread between two sweeps, and write the run if there is a folder for it.

        Raises
        ------
        Exception
            What ended the thread earlier.
        """
        self._stop.set()
        self._thread.join()
        if self._output is not None and self._updates:
            result = self.live.pipeline.result(self._updates, error=self._error)
            write_run(result, self._output, dataset="live")
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        try:
            self.live.work(self._stop)
        except Exception as error:  # handed to the thread that asks to stop
            self._error = error
            self._on_error()

    def _observe(self, sweep: Sweep, update: MapUpdate, pipeline: Pipeline) -> None:
        if self._output is not None:
            self._updates.append(update)
        frame = self.messages.frame(
            update,
            lambda: registered_cloud(sweep, update, pipeline.mapper),
            lambda: surrounding_cloud(update, pipeline.mapper),
        )
        try:
            for topic, message in frame:
                self._publish(topic, message)
        except OutputError as error:
            _log.warning("not published: %s", error)


def config_of(values: Mapping[str, Any]) -> Config:
    """The configuration that the parameters ask for.

    Raises
    ------
    ConfigError
        If they are wrong.
    """
    if values["config"] and values["preset"] != "default":
        raise ConfigError("give preset or config, not both; a file names its preset itself")
    config = load_config(values["config"]) if values["config"] else preset(values["preset"])
    if values["sensor"] != "auto":
        config = config.changed({"sensor.model": values["sensor"]})
    frames = {name: values[name] for name in ("map_frame", "lidar_frame") if values[name]}
    return config.changed(bag=config.bag.changed(**frames))
