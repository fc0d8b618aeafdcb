"""Messages and bags made of arrays: clouds, IMU samples, odometry, recordings of LOAM's topics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
LIVOX = "livox_ros_driver2/msg/"
_LIVOX = {
    "CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "uint8 reflectivity\nuint8 tag\nuint8 line\n",
    "CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\n"
    "uint8[3] rsvd\nCustomPoint[] points\n",
}
for _store in (ROS1, ROS2):
    for _name, _text in _LIVOX.items():
        _store.register(get_types_from_msg(_text, LIVOX + _name))
KINDS = ["ros1", "sqlite3", "mcap"]
START = 1_700_000_000_000_000_000
LATENCY = 30_000_000
"""Receive time minus header stamp in the bags below."""
STAMP = 1_700_000_000_123_456_789
TO_LOAM = [1, 2, 0]
"""Columns of a point in LOAM's axes: x is left, y is up, z is forward."""
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
"""Numbers of sensor_msgs/PointField by numpy's code of the type."""
N = 400
Recording = list[tuple[str, int, Any]]
"""Topic, receive time, message or raw bytes of a cloud."""


def store_of(kind: str) -> Any:
    return ROS1 if kind == "ros1" else ROS2


def header(store: Any, stamp: int) -> Any:
    types = store.types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    extra = {"seq": 0} if store is ROS1 else {}
    return types["std_msgs/msg/Header"](stamp=time, frame_id="lidar", **extra)


def cloud(store: Any, stamp: int, points: np.ndarray, **columns: np.ndarray) -> Any:
    types = store.types
    coordinates = dict(zip("xyz", points.T.astype("f4"), strict=True))
    parts = vars(make_message(coordinates | columns, stamp=stamp))
    fields = [types["sensor_msgs/msg/PointField"](**vars(field)) for field in parts["fields"]]
    parts |= {"header": header(store, stamp), "fields": fields}
    return types["sensor_msgs/msg/PointCloud2"](**parts)


def livox(store: Any, stamp: int, points: np.ndarray, seconds: np.ndarray) -> Any:
    """Points of a Livox, by six lasers in turn."""
    point = store.types[LIVOX + "CustomPoint"]
    rows = zip(np.rint(seconds * 1e9).astype(int), points.astype(float), strict=True)
    return store.types[LIVOX + "CustomMsg"](
        header=header(store, stamp),
        timebase=stamp,
        point_num=len(points),
        lidar_id=1,
        rsvd=np.zeros(3, np.uint8),
        points=[
            point(offset_time=time, x=xyz[0], y=xyz[1], z=xyz[2],
                  reflectivity=9, tag=16, line=number % 6)
            for number, (time, xyz) in enumerate(rows)
        ],
    )  # fmt: skip


def imu(
    store: Any,
    stamp: int,
    values: Sequence[float] = (0.0, 0.0, 0.0, 1.0, 0.1, 0.2, 0.3, 0.0, 0.0, 9.81),
    *,
    unknown: bool = False,
) -> Any:
    """A sample of quaternion x y z w, rad/s, m/s^2; ``unknown``: it says so of its orientation."""
    types, row = store.types, [float(value) for value in values]
    vector = types["geometry_msgs/msg/Vector3"]
    covariance = np.zeros(9)
    covariance[0] = -1.0 if unknown else 0.0
    return types["sensor_msgs/msg/Imu"](
        header=header(store, stamp),
        orientation=types["geometry_msgs/msg/Quaternion"](*row[:4]),
        orientation_covariance=covariance,
        angular_velocity=vector(*row[4:7]),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(*row[7:]),
        linear_acceleration_covariance=np.zeros(9),
    )


def odometry(
    store: Any,
    stamp: int,
    position: Sequence[float],
    quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
) -> Any:
    types = store.types
    vector = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](*map(float, position)),
        orientation=types["geometry_msgs/msg/Quaternion"](*map(float, quaternion)),
    )
    return types["nav_msgs/msg/Odometry"](
        header=header(store, stamp),
        child_frame_id="/laser_odom",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](linear=vector, angular=vector),
            covariance=np.zeros(36),
        ),
    )


def fix(
    store: Any,
    stamp: int,
    place: Sequence[float],
    *,
    status: int = 0,
    covariance: Sequence[float] = (0.04, 0.04, 0.16),
    known: int = 2,
) -> Any:
    types = store.types
    return types["sensor_msgs/msg/NavSatFix"](
        header=header(store, stamp),
        status=types["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=float(place[0]), longitude=float(place[1]), altitude=float(place[2]),
        position_covariance=np.diag(covariance).ravel(),
        position_covariance_type=known,
    )  # fmt: skip


def twist(store: Any, stamp: int, ahead: float, turn: float) -> Any:
    types = store.types
    vector = types["geometry_msgs/msg/Vector3"]
    speed = types["geometry_msgs/msg/Twist"](
        linear=vector(x=ahead, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=turn)
    )
    return types["geometry_msgs/msg/TwistStamped"](header=header(store, stamp), twist=speed)


def write_bag(path: Path, kind: str, recording: Recording) -> Path:
    """Write the messages as ``ros1``, ``sqlite3`` or ``mcap``; returns what a user would open."""
    store = ROS1 if kind == "ros1" else ROS2
    if kind == "ros1":
        path = path.with_suffix(".bag")
        writer: Any = Writer1(path)
        serialize = store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
        serialize = store.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for topic, received, message in recording:
            raw = isinstance(message, bytes)
            kind_of = "sensor_msgs/msg/PointCloud2" if raw else message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind_of, typestore=store)
            data = message if raw else serialize(message, kind_of)
            writer.write(connections[topic], received, data)
    return path


def sweep_points(seed: int, count: int = 300) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-20, 20, (count, 3)).astype("f4")


def sweeps(kind: str, count: int = 4, topic: str = "/points") -> Recording:
    store = store_of(kind)
    times = np.linspace(0.0, 0.1, 300).astype("f4")
    rings = (np.arange(300) % 16).astype("u2")
    stamps = [START + i * 100_000_000 for i in range(count)]
    return [
        (topic, s + LATENCY, cloud(store, s, sweep_points(i), ring=rings, time=times))
        for i, s in enumerate(stamps)
    ]


def loam_recording(
    *, loam_axes: bool = False, offsets: dict[str, int] | None = None, count: int = 3
) -> Recording:
    """Flat clouds that spread least along z; ``offsets`` shift the stamps of a topic."""
    recording: Recording = []
    for i in range(count):
        for topic in ("/laser_cloud_corner_last", "/laser_cloud_surf_last", "/velodyne_cloud_3"):
            points = sweep_points(i) * np.array([1.0, 1.0, 0.2])
            stamp = START + i * 100_000_000 + (offsets or {}).get(topic, 0)
            points = points[:, TO_LOAM] if loam_axes else points
            recording.append((topic, stamp, cloud(ROS1, stamp, points)))
        stamp = START + i * 100_000_000
        position = np.array([i, 0.5 * i, 0.1])
        axis = np.array([0.1, 0.2, 0.3])  # lidar axes, rotation vector over two
        quaternion = np.append(axis[TO_LOAM] if loam_axes else axis, np.sqrt(1 - axis @ axis))
        position = position[TO_LOAM] if loam_axes else position
        for topic in ("/laser_odom_to_init", "/aft_mapped_to_init"):
            recording.append((topic, stamp, odometry(ROS1, stamp, position, quaternion)))
    return recording


def make_message(
    columns: dict[str, np.ndarray],
    *,
    height: int = 1,
    big: bool = False,
    gap: int = 0,
    row_padding: int = 0,
    stamp: int = STAMP,
) -> Any:
    """A PointCloud2 look-alike; ``gap`` bytes before each field, ``row_padding`` after each row."""
    count = len(next(iter(columns.values())))
    width = count // height
    fields, offset = [], 0
    for name, values in columns.items():
        code = values.dtype.str[1:]
        fields.append(
            SimpleNamespace(name=name, offset=offset + gap, datatype=DATATYPES[code], count=1)
        )
        offset += gap + values.dtype.itemsize
    step = offset + gap
    row_step = width * step + row_padding
    data = np.full(height * row_step, 0xAB, np.uint8)
    for field, values in zip(fields, columns.values(), strict=True):
        if count == 0:
            break
        order = ">" if big else "<"
        target = np.ndarray(
            (height, width), values.dtype.newbyteorder(order), data, field.offset, (row_step, step)
        )
        target[:] = values.reshape(height, width)
    data.setflags(write=False)
    return SimpleNamespace(
        header=SimpleNamespace(
            stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="lidar"
        ),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=big,
        point_step=step,
        row_step=row_step,
        data=data,
        is_dense=True,
    )


def xyz(count: int = N, dtype: str = "f4") -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    points = rng.uniform(-20, 20, (count, 3)).astype(dtype)
    return {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2]}


def write_sweeps(folder: Path, count: int = 3) -> Path:
    """A folder of ``.bin`` files of 50 points each."""
    folder.mkdir(parents=True)
    for i in range(count):
        values = np.column_stack([sweep_points(i, 50), np.ones(50)]).astype("<f4")
        values.tofile(folder / f"{i:06d}.bin")
    return folder
