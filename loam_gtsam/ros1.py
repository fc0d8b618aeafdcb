"""The ROS 1 node: ``python -m loam_gtsam.ros1 _cloud_topic:=/points``.

Everything but subscriptions, publishers and parameters is in :mod:`loam_gtsam.ros_topics`.
"""

from __future__ import annotations

from typing import Any

try:
    import rospy
except ImportError as error:
    raise ImportError(
        "loam_gtsam.ros1 needs rospy of ROS 1 in a Python of 3.11 or newer: on Debian 12, install "
        "python3-rospy, and use a virtual environment made with --system-site-packages"
    ) from error

from loam_gtsam.frame_messages import TYPES
from loam_gtsam.ros_topics import PARAMETERS, RosRun

_BUFFER = 2**24
"""Bytes that are taken from a socket at once: several sweeps, or messages wait in the system."""
_DEPTH = 10
"""Messages of a topic that ROS keeps for a slow subscriber."""


def connect() -> RosRun:
    """Read the node's private parameters, subscribe and advertise; the node is initialised.

    Returns
    -------
    RosRun
        To be started, and stopped when the node ends.

    Raises
    ------
    LoamError
        If a parameter is wrong.
    """
    values = {name: rospy.get_param(f"~{name}", default) for name, default in PARAMETERS.items()}
    publishers: dict[str, Any] = {}

    def publish(topic: str, message: bytes) -> None:
        raw = publishers[topic].data_class()
        raw.deserialize(message)
        publishers[topic].publish(raw)

    run = RosRun(
        values, publish, ros1=True, on_error=lambda: rospy.signal_shutdown("mapping failed")
    )
    for topic, kind in TYPES.items():
        definition, checksum = run.messages.store.generate_msgdef(kind, ros_version=1)
        names = {"_type": kind.replace("/msg/", "/"), "_md5sum": checksum, "_full_text": definition}
        raw_class = type("Raw", (rospy.AnyMsg,), names)
        publishers[topic] = rospy.Publisher(topic, raw_class, queue_size=_DEPTH)
    for topic in run.subscriptions:
        rospy.Subscriber(
            topic,
            rospy.AnyMsg,
            lambda message, topic=topic: run.receive(topic, message._buff),
            queue_size=run.depths[topic],
            buff_size=_BUFFER,
            tcp_nodelay=True,
        )
    if values["report_every"] > 0.0:
        period = rospy.Duration.from_sec(values["report_every"])
        rospy.Timer(period, lambda event: rospy.loginfo("%s", run.live.report()))
    return run


def main() -> None:
    """Run the node until it is interrupted."""
    rospy.init_node("loam_gtsam")
    run = connect()
    run.start()
    try:
        rospy.spin()
    finally:
        run.stop()


if __name__ == "__main__":
    main()
