"""IMU samples in order of time, in arrays that grow at their end and are dropped at their start."""

from __future__ import annotations

from collections import Counter

import numpy as np

from loam_gtsam.types import FloatArray, ImuSamples, IntArray


def rows_of(samples: ImuSamples, rows: slice) -> ImuSamples:
    """The samples in some rows, as views."""
    orientation = None if samples.orientation is None else samples.orientation[rows]
    return ImuSamples(
        samples.stamps[rows], orientation, samples.gyro[rows], samples.acceleration[rows]
    )


class SampleStore:
    """Stamps and values of IMU samples, sorted by stamp, one sample for each stamp.

    Parameters
    ----------
    counts : "duplicates", "out_of_order" and "too_late" are counted here

    Attributes
    ----------
    accepts_from : older samples are dropped, nanoseconds; None accepts all
    """

    def __init__(self, counts: Counter[str]) -> None:
        self._counts = counts
        self.accepts_from: int | None = None
        self._newest_arrival = np.iinfo(np.int64).min
        self._waiting: list[tuple[IntArray, FloatArray]] = []
        self._count = 0
        # Longer than needed: a live stream is then copied a few times in all, not at every merge.
        self._room_stamps = np.zeros(0, np.int64)
        self._room = np.zeros((0, 10))

    @property
    def stamps(self) -> IntArray:
        """(N,) nanoseconds, ascending; a view that is valid until the next :meth:`merge`."""
        return self._room_stamps[: self._count]

    @property
    def samples(self) -> ImuSamples:
        """All samples; views like ``stamps``."""
        values = self._room[: self._count]
        return ImuSamples(self.stamps, values[:, :4], values[:, 4:7], values[:, 7:])

    def add(self, stamps: IntArray, values: FloatArray) -> None:
        """Keep samples for the next :meth:`merge`.

        Parameters
        ----------
        stamps : (N,) nanoseconds, in any order
        values : (N, 10) quaternion x y z w (NaN where unknown), gyro, acceleration
        """
        if self.accepts_from is not None:
            young = stamps >= self.accepts_from
            self._counts["too_late"] += len(stamps) - int(young.sum())
            stamps, values = stamps[young], values[young]
        if len(stamps) == 0:
            return
        newest = np.maximum.accumulate(np.concatenate([[self._newest_arrival], stamps]))
        self._counts["out_of_order"] += int((stamps < newest[:-1]).sum())
        self._newest_arrival = int(newest[-1])
        self._waiting.append((stamps, values))

    def merge(self) -> tuple[int, int] | None:
        """Sort in what was added.

        Returns
        -------
        Index from which on samples have changed, and the stamp of the earliest new sample; None if
        there was nothing new.
        """
        if not self._waiting:
            return None
        stamps = np.concatenate([part[0] for part in self._waiting])
        values = np.concatenate([part[1] for part in self._waiting])
        self._waiting.clear()
        earliest = int(stamps.min())
        # Nothing before this index changes; as a rule the index is the end.
        at = int(np.searchsorted(self.stamps, earliest))
        # The old samples first: of equal stamps a stable sort then keeps the first to come.
        stamps = np.concatenate([self.stamps[at:], stamps])
        values = np.concatenate([self._room[at : self._count], values])
        order = np.argsort(stamps, kind="stable")
        stamps = stamps[order]
        kept = np.concatenate([[True], stamps[1:] != stamps[:-1]])
        self._counts["duplicates"] += len(stamps) - int(kept.sum())
        self._count = at + int(kept.sum())
        if self._count > len(self._room):
            room = 2 * self._count
            self._room_stamps = np.concatenate([self._room_stamps[:at], np.zeros(room - at, int)])
            self._room = np.concatenate([self._room[:at], np.zeros((room - at, 10))])
        self._room_stamps[at : self._count] = stamps[kept]
        self._room[at : self._count] = values[order][kept]
        return at, earliest

    def drop(self, count: int) -> None:
        """Drop the ``count`` oldest samples, fewer than all, and from now on every older one."""
        held = slice(count, self._count)
        self._room_stamps, self._room = self._room_stamps[held].copy(), self._room[held].copy()
        self._count -= count
        self.accepts_from = int(self._room_stamps[0])
