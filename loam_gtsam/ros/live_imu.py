"""IMU samples of a live run, from their arrival to the buffer of the mapper."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.datasets.decode.tables import STANDARD_GRAVITY, UNIT_TOLERANCE, is_in_g
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.types import ImuSamples

Row = tuple[int, tuple[float, ...]]
"""Nanoseconds; quaternion x y z w, rad/s, m/s^2."""


class LiveImu:
    """Collects samples and puts them into an :class:`~loam_gtsam.imu.buffer.ImuBuffer`.

    They are read as those of a bag: acceleration in g is converted, and quaternions that are not
    of unit length are no orientation. A bag decides on the former from all of its samples, this
    from those before the first sweep.

    Parameters
    ----------
    config : section ``imu``
    capacity : samples that may wait; None is no limit

    Attributes
    ----------
    buffer : what the mapper asks
    dropped : oldest samples that had to make room
    late : samples of a time that had been mapped when they came
    """

    def __init__(self, config: ImuConfig, capacity: int | None) -> None:
        self.buffer = ImuBuffer(config)
        self.dropped = self.late = 0
        self._waiting: deque[Row] = deque(maxlen=capacity)
        self._last: int | None = None
        self._mapped: int | None = None
        self._scale: float | None = None

    def add(self, row: Row) -> None:
        """A new sample, finite."""
        self.dropped += len(self._waiting) == self._waiting.maxlen
        self._waiting.append(row)
        self._last = row[0]

    def covers(self, stamp: int) -> bool:
        """Whether samples have come up to that moment.

        The one that came last tells, not the newest: one stamp from the future opens no gate.
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
            self.late += sum(stamp <= self._mapped for stamp, _ in rows)
        self._mapped = until
        self.buffer.forget_old(until)
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
