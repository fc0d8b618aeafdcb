"""One decoder for every ``sensor_msgs/PointCloud2``, one by one or as a stream; and for ``Imu``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.datasets.decode.point_times import (
    TimeDecision,
    apply_times,
    check_time_options,
    decide_times,
)
from loam_gtsam.types import BoolArray, DatasetError, LoamError, Scan

RING_FIELDS = ("ring", "channel", "line")
TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "stamps", "time_stamp", "offset_time")
NO_TIMES = "none"
"""Value of ``time_field`` that ignores a time field on purpose."""

_WILD_RING = 2.0**31
"""Bound of beam numbers; larger floats, which no integer holds, are clipped to it."""

_MOST_OF_THEM = 0.01, 0.99
"""Quantiles of times between which a sweep spans less than its distance from an absolute zero."""
_SAMPLED = 1000  # times, about, of which these are taken

_OPEN = 10
"""Sweeps that decide for themselves: near time zero an absolute time can still look like an
offset. A bag decides once, on the last of as many."""

_CODES = "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "i8", "u8"
DATATYPES = dict(enumerate(_CODES, start=1))
"""Numbers of ``sensor_msgs/PointField``, by numpy's codes; the last two are those of PCL alone."""


def decode_pointcloud2(
    msg: Any,
    *,
    time_field: str | None = None,
    time_unit: str | None = None,
    stamp_is: str | None = None,
) -> Scan:
    """Decode one PointCloud2 message.

    Parameters
    ----------
    msg : a message as rosbags or rclpy hand it out, or any object with its attributes
    time_field : name of the per-point time field; None looks for the usual names, ``"none"``
        ignores it
    time_unit : ``s``, ``ms``, ``us`` or ``ns``; None decides from the numbers
    stamp_is : moment of the sweep the header stamp is (``start``, ``middle``, ``end``); None
        decides from the numbers

    Returns
    -------
    Scan
        A copy. Points that are not finite are dropped, with their times and rings, unless the
        cloud is a range image without ring field: then they stay, as NaN, and ``rows`` is set.

    Raises
    ------
    DatasetError
        If the layout, a field or the times cannot be understood.
    """
    options: TimeOptions = {"time_field": time_field, "time_unit": time_unit, "stamp_is": stamp_is}
    return decode_with_times(msg, **options).scan


class TimeOptions(TypedDict, total=False):
    """How the times of points are read; see :func:`decode_pointcloud2`. All may be left out."""

    time_field: str | None
    time_unit: str | None
    stamp_is: str | None


@dataclass(frozen=True, slots=True)
class Decoded:
    """A decoded cloud, and what was found out about its times."""

    scan: Scan
    decision: TimeDecision | None
    """None if the cloud has no times."""
    outliers: int
    """Points taken out because their time lies far outside the sweep."""


def decode_with_times(
    msg: Any, *, decision: TimeDecision | None = None, **options: Unpack[TimeOptions]
) -> Decoded:
    """Decode one PointCloud2 message and tell how its times were read.

    With the ``decision`` of an earlier sweep even one with too few points to tell is read alike.
    """
    unit, stamp_is = options.get("time_unit"), options.get("stamp_is")
    check_time_options(unit, stamp_is)
    layout = _Layout(msg)
    stamp = message_stamp(msg)
    points = _points(layout)
    rings = _rings(layout)
    values = _time_values(layout, options.get("time_field"))
    rows = outliers = 0
    if rings is None and layout.height > 1:
        rows = min(layout.height, layout.width)
        if layout.height > layout.width:  # one column of the image per row of the message
            order = np.arange(len(points)).reshape(layout.height, layout.width).T.ravel()
            points = points[order]
            values = (values[0], values[1][order]) if values is not None else None
    finite = np.isfinite(points).all(axis=1)
    times = None
    # Only measured points: drivers leave anything in the time of a missing return.
    there = finite if values is None else _measured(points, finite, values[1], decision)
    if values is not None and there.any():
        name, column = values
        measured = column[there]
        if decision is None:
            decision = decide_times(measured, stamp, field=name, unit=unit, stamp_is=stamp_is)
        measured_times, outlier = apply_times(measured, stamp, decision)
        outliers = int(outlier.sum())
        times = np.full(len(points), measured_times.min())
        times[there] = measured_times
        if outliers:
            points[np.flatnonzero(there)[outlier]] = np.nan
            finite = np.isfinite(points).all(axis=1)
    elif values is not None:
        times = np.zeros(len(points))
    if rows == 0 and not finite.all():
        points = points[finite]
        times = times[finite] if times is not None else None
        rings = rings[finite] if rings is not None else None
    scan = Scan(points=points, stamp=stamp, times=times, rings=rings, rows=rows)
    return Decoded(scan, decision if values is not None else None, outliers)


def _measured(
    points: NDArray[Any], finite: BoolArray, column: NDArray[Any], decision: TimeDecision | None
) -> BoolArray:
    """The finite points, without (0, 0, 0) at time 0 where the times of the others are absolute.

    Several drivers write missing returns so.
    """
    missing = np.flatnonzero(finite & (column == 0))
    missing = missing[~points[missing].any(axis=1)]
    if not len(missing):
        return finite
    measured = finite.copy()
    measured[missing] = False
    others = column[measured]
    with np.errstate(invalid="ignore"):  # some bit patterns of NaN do not survive it
        others = others[:: len(others) // _SAMPLED + 1].astype(np.float64)
    others = others[np.isfinite(others)]
    absolute = decision is not None and decision.clock != "offset"
    if len(others):
        low, high = np.quantile(others, _MOST_OF_THEM)
        absolute = low > high - low
    return measured if absolute else finite


class CloudStream:
    """Decodes messages in the order in which they come; options: :func:`decode_pointcloud2`.

    ``decision`` is how the times are read, None before the first that could be.
    """

    def __init__(self, **options: Unpack[TimeOptions]) -> None:
        check_time_options(options.get("time_unit"), options.get("stamp_is"))
        self._options = options
        self.decision: TimeDecision | None = None
        self._decided = 0

    def decode(self, message: Any) -> Scan:
        """The next sweep; DatasetError if it cannot be understood."""
        if self._decided < _OPEN:
            try:
                decoded = decode_with_times(message, **self._options)
            except LoamError:
                if self.decision is None:
                    raise
            else:
                self._decided += decoded.decision is not None
                self.decision = decoded.decision or self.decision
                return decoded.scan
        return decode_with_times(message, decision=self.decision, **self._options).scan


def message_stamp(msg: Any) -> int:
    """Header stamp in nanoseconds."""
    try:
        stamp = msg.header.stamp
        return int(stamp.sec) * 10**9 + int(stamp.nanosec)
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        text = f"expected a message with header.stamp, got {type(msg).__name__}"
        raise DatasetError(f"{text}: {error}") from error


def decode_imu(msg: Any) -> tuple[int, tuple[float, ...]]:
    """Stamp (ns) and (10,) quaternion x y z w (zero if there is none), rad/s, m/s^2 of an Imu."""
    stamp = message_stamp(msg)
    try:
        q, w, a = msg.orientation, msg.angular_velocity, msg.linear_acceleration
        # sensor_msgs/Imu: a first covariance element of -1 says there is no orientation
        unknown = msg.orientation_covariance[0] == -1.0
        orientation = (0.0, 0.0, 0.0, 0.0) if unknown else (q.x, q.y, q.z, q.w)
        values = tuple(map(float, (*orientation, w.x, w.y, w.z, a.x, a.y, a.z)))
    except (AttributeError, IndexError, TypeError, ValueError) as error:
        raise DatasetError(f"expected an Imu message, got {type(msg).__name__}: {error}") from error
    return stamp, values


def describe_fields(msg: Any) -> str:
    """Fields of a PointCloud2 for people: ``x float32, ..., t uint32``."""
    return ", ".join(
        f"{field.name} {np.dtype(DATATYPES[field.datatype]).name}"
        if field.datatype in DATATYPES
        else f"{field.name} datatype {field.datatype}"
        for field in msg.fields
    )


class _Layout:
    """Checked geometry of the byte buffer."""

    def __init__(self, msg: Any) -> None:
        try:
            self.height, self.width = int(msg.height), int(msg.width)
            self.size = self.height * self.width
            self.point_step, row_step = int(msg.point_step), int(msg.row_step)
            self.order = ">" if msg.is_bigendian else "<"
            self.fields = {field.name: field for field in msg.fields}
            data = msg.data
            if isinstance(data, (list, tuple)):
                data = np.asarray(data, dtype=np.uint8)
            self.data = np.frombuffer(data, dtype=np.uint8) if len(data) else np.zeros(0, np.uint8)
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            text = f"expected a PointCloud2 message, got {type(msg).__name__}"
            raise DatasetError(f"{text}: {error}") from error
        if min(self.height, self.width, self.point_step, row_step) < 0:
            raise DatasetError(
                f"PointCloud2: expected sizes from 0 on, got {self.height} x {self.width} points "
                f"of {self.point_step} bytes in rows of {row_step}"
            )
        tight = self.width * self.point_step
        # One row needs no row step, and some drivers leave it zero.
        self.row_step = tight if self.height <= 1 or row_step == 0 else row_step
        if self.size and self.point_step <= 0:
            raise DatasetError(f"PointCloud2: point_step is {self.point_step}, expected above 0")
        if self.row_step < tight:
            below = f"row_step {self.row_step} is below width x point_step = {tight}"
            raise DatasetError(f"PointCloud2: {below}")
        needed = (self.height - 1) * self.row_step + tight if self.size else 0
        if len(self.data) < needed:
            raise DatasetError(
                f"PointCloud2: {self.height} x {self.width} points of {self.point_step} bytes "
                f"need {needed} bytes of data, got {len(self.data)}; the message is damaged"
            )

    def column(self, name: str) -> NDArray[Any]:
        """(height * width,) values of a field, in native byte order."""
        field = self.fields[name]
        if field.datatype not in DATATYPES:
            problem = f"unknown datatype {field.datatype}, expected 1 to {len(DATATYPES)}"
            raise DatasetError(f"PointCloud2 field {name!r}: {problem}")
        dtype = np.dtype(self.order + DATATYPES[field.datatype])
        if field.count > 1:  # 0 is what old PCL versions write for 1
            raise DatasetError(f"PointCloud2 field {name!r}: expected count 1, got {field.count}")
        if self.size == 0:
            return np.zeros(0, dtype.newbyteorder("="))
        if field.offset < 0 or field.offset + dtype.itemsize > self.point_step:
            raise DatasetError(
                f"PointCloud2 field {name!r}: {dtype.itemsize} bytes at offset {field.offset} "
                f"do not fit into point_step {self.point_step}"
            )
        shape, strides = (self.height, self.width), (self.row_step, self.point_step)
        view: NDArray[Any] = np.ndarray(shape, dtype, self.data, field.offset, strides)
        return view.astype(dtype.newbyteorder("=")).reshape(-1)


def read_positions(msg: Any) -> NDArray[Any]:
    """(N, 3) x, y and z of a PointCloud2 as they are in it, those that are not finite too.

    Raises DatasetError if the layout or a field cannot be understood.
    """
    return _points(_Layout(msg))


def _points(layout: _Layout) -> NDArray[Any]:
    if missing := [name for name in "xyz" if name not in layout.fields]:
        there = f"the message has: {', '.join(layout.fields) or 'no fields'}"
        raise DatasetError(f"PointCloud2: no field {', '.join(missing)}; {there}")
    columns = {name: layout.column(name) for name in "xyz"}
    for name, column in columns.items():
        if column.dtype.kind != "f":
            problem = f"expected float32 or float64, got {column.dtype}"
            raise DatasetError(f"PointCloud2 field {name!r}: {problem}")
    with np.errstate(invalid="ignore"):  # some bit patterns of NaN do not survive a change of width
        return np.stack(list(columns.values()), axis=1)


def _rings(layout: _Layout) -> NDArray[Any] | None:
    name = next((name for name in RING_FIELDS if name in layout.fields), None)
    if name is None:
        return None
    column = layout.column(name)
    if column.dtype.kind == "f":  # a missing return may carry NaN; its point is NaN as well
        beams = np.clip(np.nan_to_num(column), -_WILD_RING, _WILD_RING)
        return np.asarray(np.rint(beams).astype(np.int64))
    return column


def _time_values(layout: _Layout, asked: str | None) -> tuple[str, NDArray[Any]] | None:
    if asked == NO_TIMES:
        return None
    if asked is not None and asked not in layout.fields:
        there = f"the message has: {', '.join(layout.fields)}"
        raise DatasetError(f"PointCloud2: no time field {asked!r}; {there}")
    name = asked or next((name for name in TIME_FIELDS if name in layout.fields), None)
    return None if name is None else (name, layout.column(name))
