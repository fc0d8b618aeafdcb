"""The ROS 2 node: ``python -m loam_gtsam.ros --ros-args -p cloud_topic:=/points``.

Everything but subscriptions, publishers and parameters is in :mod:`loam_gtsam.ros.topics`.
"""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any

try:
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import QoSProfile, ReliabilityPolicy
except ImportError as error:
    raise ImportError(
        "loam_gtsam.ros needs rclpy of ROS 2: source /opt/ros/DISTRO/setup.bash first, and use the "
        "Python of that distribution (3.11 or newer: Jazzy or later)"
    ) from error

from loam_gtsam.ros.frame_messages import TYPES
from loam_gtsam.ros.topics import PARAMETERS, RosRun

_DEPTH = 10
"""Messages of a topic that ROS keeps for a slow subscriber."""


def connect(node: Any) -> RosRun:
    """Declare the parameters of a node, subscribe and advertise.

    Parameters
    ----------
    node : an ``rclpy.node.Node``

    Returns
    -------
    RosRun
        To be started, and stopped when the node ends.

    Raises
    ------
    LoamError
        If a parameter is wrong.
    """
    values = {
        name: node.declare_parameter(name, default).value for name, default in PARAMETERS.items()
    }
    publishers = {
        topic: node.create_publisher(_message_class(kind), topic, _DEPTH)
        for topic, kind in TYPES.items()
    }

    def publish(topic: str, message: bytes) -> None:
        # RTPS pads to words of four bytes, which not every middleware does for serialised messages.
        publishers[topic].publish(message + bytes(-len(message) % 4))

    run = RosRun(values, publish, ros1=False, on_error=rclpy.try_shutdown)
    for topic, kind in run.subscriptions.items():
        # Best effort, for it takes from reliable publishers too.
        qos = QoSProfile(depth=run.depths[topic], reliability=ReliabilityPolicy.BEST_EFFORT)
        node.create_subscription(
            _message_class(kind), topic, partial(run.receive, topic), qos, raw=True
        )
    if values["report_every"] > 0.0:
        logger = node.get_logger()
        node.create_timer(values["report_every"], lambda: logger.info(str(run.live.report())))
    return run


def main(arguments: list[str] | None = None) -> None:
    """Run the node until it is interrupted."""
    rclpy.init(args=arguments)
    node = rclpy.create_node("loam_gtsam")
    try:
        run = connect(node)
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
    """``sensor_msgs/msg/Imu`` as a class."""
    package, _, name = kind.partition("/msg/")
    return getattr(import_module(f"{package}.msg"), name)


if __name__ == "__main__":
    main()
