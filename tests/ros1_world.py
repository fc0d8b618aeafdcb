"""A process of a ROS 1 network: plays a bag and keeps the odometry that comes back.

Arguments: the bag, how much faster than recorded, frames to wait for, file for what came.
"""

import sys
import time
from pathlib import Path

import rospy
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

from loam_gtsam.frame_messages import ODOMETRY


def main() -> None:
    bag, speed, frames, found = Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
    rospy.init_node("world")
    came: list[bytes] = []
    rospy.Subscriber(ODOMETRY, rospy.AnyMsg, lambda message: came.append(message._buff))
    store = get_typestore(Stores.ROS1_NOETIC)
    publishers = {}
    with Reader(bag) as reader:
        recorded = [(at, c.topic, bytes(raw)) for c, at, raw in reader.messages()]
        for topic, kind in {(c.topic, c.msgtype) for c in reader.connections}:
            definition, checksum = store.generate_msgdef(kind, ros_version=1)
            names = {"_type": kind.replace("/msg/", "/"), "_md5sum": checksum}
            raw_class = type("Raw", (rospy.AnyMsg,), names | {"_full_text": definition})
            publishers[topic] = rospy.Publisher(topic, raw_class, queue_size=10_000)
    patience = time.monotonic() + 60.0
    while any(publisher.get_num_connections() == 0 for publisher in publishers.values()):
        assert time.monotonic() < patience, "nobody listens"
        time.sleep(0.02)
    begun = time.monotonic()
    for at, topic, raw in recorded:
        rest = (at - recorded[0][0]) * 1e-9 / speed - (time.monotonic() - begun)
        time.sleep(max(rest, 0.0))
        message = publishers[topic].data_class()
        message.deserialize(raw)
        publishers[topic].publish(message)
    while len(came) < frames and time.monotonic() < patience:
        time.sleep(0.02)
    Path(found).write_bytes(b"".join(came))


if __name__ == "__main__":
    main()
