"""Livox's own message, ``CustomMsg``, from its bytes.

Deserialised like others, its points become as many objects, which takes longer than mapping them.
"""

from __future__ import annotations

import struct

import numpy as np

from loam_gtsam.datasets.decode.packed_points import PackedCloud, packed
from loam_gtsam.types import DatasetError

KINDS = (
    "livox_ros_driver2/msg/CustomMsg",
    "livox_ros_driver/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
)
"""The same message of the drivers for ROS 1 and 2, old and new."""
TIME_UNIT = "ns"
"""Of ``offset_time``, by its definition; messages of 50 or 100 Hz are too short to tell it."""
_BYTES = ("reflectivity", "u1"), ("tag", "u1"), ("laser", "u1")
_POINT = np.dtype([("offset_time", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *_BYTES])
_ALIGNED = np.dtype([*_POINT.descr, ("filled", "V1")])
"""In ROS 2 the next point begins at a multiple of four bytes."""


def read_custom(raw: bytes | memoryview, *, cdr: bool) -> PackedCloud:
    """The points of a message; ``offset_time`` counts nanoseconds from its stamp.

    Parameters
    ----------
    raw : serialised ``CustomMsg`` of livox_ros_driver: header, ``uint64 timebase`` (of the first
        point, which is the stamp as well), ``uint32 point_num``, ``uint8 lidar_id``, ``uint8[3]``,
        and points of ``uint32 offset_time, float32 x y z, uint8 reflectivity tag line``
    cdr : by ROS 2, with an encapsulation of four bytes and aligned numbers; else by ROS 1

    Raises
    ------
    DatasetError
        If the message is cut off, or not little-endian.
    """
    body = memoryview(raw)[4:] if cdr else memoryview(raw)
    if cdr and bytes(raw[:2]) != b"\0\1":
        raise DatasetError(
            f"CustomMsg: expected little-endian CDR, its bytes begin with {bytes(raw[:2])!r}"
        )
    try:
        seconds, nanoseconds, length = struct.unpack_from("<iII" if cdr else "<4xIII", body)
        at = (12 if cdr else 16) + length  # past the name of the frame
        at += -at % 8 if cdr else 0
        at += 8 + 4 + 1 + 3
        (count,) = struct.unpack_from("<I", body, at)
    except struct.error as error:
        raise DatasetError(f"CustomMsg: {len(raw)} bytes are cut off in the header") from error
    record = _ALIGNED if cdr else _POINT
    step = record.itemsize
    data = np.frombuffer(body[at + 4 :], np.uint8)
    if len(data) < count * step - (step - _POINT.itemsize):
        raise DatasetError(
            f"CustomMsg: {count} points of {step} bytes are cut off, {len(data)} bytes are left"
        )
    data = np.append(data, np.uint8(0))[: count * step]  # the last one is not filled up
    return packed(seconds * 10**9 + nanoseconds, record, 1, count, data)
