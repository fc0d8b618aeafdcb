"""From the messages of a live run to sweeps that can be mapped."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.datasets.decode.cloud_stream import CloudStream
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
from loam_gtsam.datasets.decode.pointcloud2 import message_stamp
from loam_gtsam.types import (
    BadSweep,
    ConfigError,
    DatasetError,
    FeatureSweep,
    LoamError,
    Scan,
    Sweep,
)

_AFTER_STAMP = {"auto": 1.0, "start": 1.0, "middle": 0.5, "end": 0.0}
"""Share of the period by which a sweep without point times ends after its stamp."""


@dataclass(frozen=True, slots=True)
class ReadySweep:
    """A decoded sweep.

    Attributes
    ----------
    sweep : may be a bad one
    received : nanoseconds of the clock
    needs : up to when the mapper asks the IMU about it, nanoseconds of the stamps; None if never
    """

    sweep: Sweep
    received: int
    needs: int | None


class SweepDecoder:
    """Decodes clouds, or groups of LOAM's messages, as the readers of bags do.

    Parameters
    ----------
    config : what the sensor is like, and what the IMU is asked
    features : LOAM's topics, none for clouds
    axes : of those
    clouds : decodes the clouds

    Raises
    ------
    ConfigError
        If one of LOAM's three topics is missing, or ``axes`` is unknown.
    """

    def __init__(
        self,
        config: Config,
        features: Collection[str],
        axes: Literal["auto", "lidar", "loam"],
        clouds: CloudStream,
    ) -> None:
        missing = [topic for topic in REQUIRED if topic not in features]
        if features and missing:
            raise ConfigError(f"features: expected {', '.join(missing)} among them")
        if axes not in ("auto", "lidar", "loam"):
            raise ConfigError(f"axes: expected one of auto, lidar, loam; got {axes!r}")
        self._config = config
        self._clouds = clouds
        self._features = FeatureDecoder(axes) if axes != "auto" else None
        self._clock_offset: int | None = None

    def ready(self, received: int, content: Any) -> ReadySweep:
        """The sweep of a cloud, or of a group of LOAM's messages by topic.

        One that cannot be decoded becomes a bad sweep.

        Raises
        ------
        DatasetError
            If there is not even a stamp for a bad one: no cloud has been good yet.
        """
        try:
            if isinstance(content, dict):
                return ReadySweep(self._feature_sweep(content), received, None)
            scan = self._scan(content)
        # Whatever a faulty message makes a decoder stumble over: the next one may be good.
        except Exception as error:
            known = isinstance(error, LoamError)
            reason = str(error) if known else f"{type(error).__name__}: {error}"
            bad = self._bad_sweep(received, content, reason)
            return ReadySweep(bad, received, None if isinstance(content, dict) else bad.stamp)
        self._clock_offset = scan.stamp - received
        return ReadySweep(scan, received, self._needs(scan))

    def _scan(self, message: Any) -> Scan:
        checked_stamp(message)
        return self._clouds.decode(message)

    def _feature_sweep(self, group: Mapping[str, Any]) -> FeatureSweep:
        if self._features is None:
            topic = CLOUD if CLOUD in group else PLANES
            spread = directions_spread(finite_points(topic, group[topic]))
            self._features = FeatureDecoder(decide_axes(topic, spread))
        return self._features.sweep(group)

    def _bad_sweep(self, received: int, content: Any, reason: str) -> BadSweep:
        if isinstance(content, dict):
            return BadSweep(message_stamp(content[ODOMETRY]), reason)
        # It has only a receive time: that of the last good one leads to the stamps' clock.
        if self._clock_offset is None:
            raise DatasetError(reason)
        return BadSweep(received + self._clock_offset, reason)

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


def checked_stamp(message: Any) -> int:
    """The header stamp in nanoseconds.

    Raises
    ------
    DatasetError
        If there is none, or no message of ROS 2 could say it.
    """
    stamp = message_stamp(message)
    if not 0 <= stamp < 2**31 * 10**9:
        raise DatasetError(f"stamp of {stamp} ns: expected 0 to 2^31 s")
    return stamp
