"""From the messages of a live run to sweeps and IMU samples that can be mapped."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from loam_gtsam.config import Config, ImuConfig
from loam_gtsam.datasets.decode.loam_messages import (
    CLOUD,
    ODOMETRY,
    PLANES,
    REQUIRED,
    FeatureDecoder,
    decide_axes,
    directions_spread,
    finite_points,
)
from loam_gtsam.datasets.decode.pointcloud2 import CloudStream, message_stamp
from loam_gtsam.datasets.decode.tables import STANDARD_GRAVITY, UNIT_TOLERANCE, is_in_g
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.types import (
    BadSweep,
    ConfigError,
    DatasetError,
    FeatureSweep,
    ImuSamples,
    LoamError,
    Scan,
    Sweep,
    check_kind,
)

_AFTER_STAMP = {"auto": 1.0, "start": 1.0, "middle": 0.5, "end": 0.0}
"""Share of the period by which a sweep without point times ends after its stamp."""

Row = tuple[int, tuple[float, ...]]
"""An IMU sample: nanoseconds; quaternion x y z w, rad/s, m/s^2."""


@dataclass(frozen=True, slots=True)
class ReadySweep:
    """A decoded sweep, good or bad, and when it was received, in nanoseconds of the clock."""

    sweep: Sweep
    received: int
    needs: int | None
    """Until when the mapper asks the IMU about the sweep, nanoseconds of the stamps; None: never"""


class SweepDecoder:
    """Decodes clouds, or groups of LOAM's messages (``features``), as the readers of bags do."""

    def __init__(
        self,
        config: Config,
        features: Collection[str],
        axes: Literal["auto", "lidar", "loam"],
        clouds: CloudStream,
    ) -> None:
        check_kind(features, Collection, "features", "they are the topics of LOAM's front end")
        for topic in features:
            check_kind(topic, str, "features", "as /laser_cloud_sharp")
        missing = [topic for topic in REQUIRED if topic not in features]
        if features and missing:
            raise ConfigError(f"features: expected {', '.join(missing)} among them")
        if not isinstance(axes, str) or axes not in ("auto", "lidar", "loam"):
            raise ConfigError(f"axes: expected one of auto, lidar, loam; got {axes!r}")
        self._config, self._clouds = config, clouds
        self._features = FeatureDecoder(axes) if axes != "auto" else None
        self._clock_offset: int | None = None

    def decode(self, received: int, content: Any) -> ReadySweep:
        """The sweep of a cloud, or of a group of LOAM's messages by topic.

        A message that cannot be decoded becomes a bad sweep. Raises DatasetError if there is not
        even a stamp for a bad one: no cloud has been good yet.
        """
        is_group = isinstance(content, dict)
        try:
            if is_group:
                sweep = self._feature_sweep(content)
                # Its points are de-skewed: only the tilt of that moment is asked for.
                after = 0.5 * self._config.imu.average_seconds
                needs = sweep.features.stamp + int(np.ceil(after * 1e9)) + 1
                return ReadySweep(sweep, received, needs)
            if isinstance(content, Scan):
                scan = content
            else:
                checked_stamp(content)
                scan = self._clouds.decode(content)
        # Whatever a faulty message makes a decoder stumble over: the next one may be good.
        except Exception as error:
            kind = "" if isinstance(error, LoamError) else f"{type(error).__name__}: "
            reason = f"{kind}{error}"
            if is_group:
                bad = BadSweep(message_stamp(content[ODOMETRY]), reason)
                return ReadySweep(bad, received, None)
            # A bad cloud has only a receive time: that of the last good one leads to the stamps.
            if self._clock_offset is None:
                raise DatasetError(reason) from error
            stamp = received + self._clock_offset
            return ReadySweep(BadSweep(stamp, reason), received, stamp)
        self._clock_offset = scan.stamp - received
        return ReadySweep(scan, received, self._needs(scan))

    def _feature_sweep(self, group: Mapping[str, Any]) -> FeatureSweep:
        if self._features is None:
            topic = CLOUD if CLOUD in group else PLANES
            spread = directions_spread(finite_points(topic, group[topic]))
            self._features = FeatureDecoder(decide_axes(topic, spread))
        return self._features.sweep(group)

    def _needs(self, scan: Scan) -> int:
        sensor, times = self._config.sensor, scan.times
        if times is None or len(times) == 0 or sensor.times in ("azimuth", "none"):
            end = _AFTER_STAMP[sensor.stamp] * sensor.period
            middle = end - 0.5 * sensor.period
        else:
            end = float(times.max())
            middle = 0.5 * (end + float(times.min()))
        last = max(0.0, end, middle + 0.5 * self._config.imu.average_seconds)
        return scan.stamp + int(np.ceil(last * 1e9)) + 1


class LiveImu:
    """Collects samples and puts them into an :class:`~loam_gtsam.imu.buffer.ImuBuffer`.

    The samples are read as those of a bag: acceleration in g is converted, and quaternions that are
    not of unit length are no orientation. A bag decides on the unit from all of its samples, this
    class from those before the first sweep. At most ``capacity`` samples wait; None is no limit.

    Attributes
    ----------
    buffer : what the mapper asks
    dropped : oldest samples that had to make room
    late : samples of a time that had been mapped when they came
    """

    def __init__(self, config: ImuConfig, capacity: int | None) -> None:
        self._config = config
        self._offset = round(config.time_offset * 1e9)
        self.dropped = self.late = 0
        self._waiting: deque[Row] = deque(maxlen=capacity)
        self._last: int | None = None
        self._scale: float | None = None
        self.forget()

    def forget(self) -> None:
        """Begin with an empty buffer; the samples that wait are the first to go into it."""
        self.buffer = ImuBuffer(self._config)
        self._mapped: int | None = None

    def add(self, row: Row) -> None:
        """A new sample, finite."""
        self.dropped += len(self._waiting) == self._waiting.maxlen
        self._waiting.append(row)
        self._last = row[0] + self._offset

    def covers(self, stamp: int) -> bool:
        """Whether samples have come up to that moment.

        The sample that came last tells, not the newest: one stamp from the future opens no gate.
        """
        return self._last is not None and self._last >= stamp

    def take(self) -> Sequence[Row]:
        """The samples that wait; they wait no longer."""
        rows = tuple(self._waiting)
        self._waiting.clear()
        return rows

    def hand_over(self, rows: Sequence[Row], until: int) -> None:
        """Put samples into the buffer before a sweep is mapped that ends at ``until``."""
        if self._mapped is not None:
            self.late += sum(stamp + self._offset <= self._mapped for stamp, _ in rows)
        self._mapped = until
        # A sweep with a stamp from the future must not cost the samples of the next ones.
        self.buffer.forget_old(until if self._last is None else min(until, self._last))
        if not rows:
            return
        stamps = np.array([stamp for stamp, _ in rows], dtype=np.int64)
        values = np.array([row for _, row in rows])
        orientation, gyro, acceleration = values[:, :4], values[:, 4:7], values[:, 7:]
        norms = np.linalg.norm(orientation, axis=1, keepdims=True)
        known = np.abs(norms - 1.0) <= UNIT_TOLERANCE
        orientation = np.where(known, orientation / np.where(known, norms, 1.0), 0.0)
        if self._scale is None:
            self._scale = STANDARD_GRAVITY if is_in_g(acceleration) else 1.0
        self.buffer.add(ImuSamples(stamps, orientation, gyro, acceleration * self._scale))


def sample_rows(samples: ImuSamples) -> list[Row]:
    """Samples one by one; without an orientation, their quaternion is none."""
    none = np.zeros((len(samples.stamps), 4))
    turns = none if samples.orientation is None else samples.orientation
    values = np.column_stack([turns, samples.gyro, samples.acceleration])
    pairs = zip(samples.stamps.tolist(), values, strict=True)
    return [(stamp, tuple(row.tolist())) for stamp, row in pairs]


def checked_stamp(message: Any) -> int:
    """Header stamp, ns; DatasetError if there is none or it is none, see :func:`check_stamp`."""
    return check_stamp(message_stamp(message))


def check_stamp(stamp: int) -> int:
    """The stamp, ns; DatasetError if no message of ROS 2 could say it."""
    if not 0 <= stamp < 2**31 * 10**9:
        raise DatasetError(f"stamp of {stamp} ns: expected 0 to 2^31 s")
    return stamp
