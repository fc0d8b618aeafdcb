"""What became of the messages of a live run, and how long its sweeps took."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from loam_gtsam.types import FrameStatus, MapUpdate

STAGES = ("waiting", "mapping", "publishing", "total")
_LATEST = 1000  # sweeps of which the latencies are kept
_REASONS = 30  # that are counted one by one: they may quote numbers of the message
_LETTERS = 300  # of a reason that are kept
OTHER_REASONS = "other reasons"


@dataclass(frozen=True, slots=True)
class Latency:
    """Seconds that sweeps took: measured ones, none interpolated."""

    median: float
    p95: float
    worst: float


@dataclass(frozen=True, slots=True)
class LiveReport:
    """The state of a live run.

    Attributes
    ----------
    received : messages by kind: ``cloud``, ``imu``, or a topic of LOAM
    dropped : messages dropped because a queue was full: ``sweep``, ``imu``
    unmatched : messages of LOAM's topics given up without partners within 5 ms, by topic
    faults : messages and sweeps that could not be used, by reason
    late : ``sweep``: sweeps whose stamp is not after that of one mapped before; ``imu``: samples of
        a time that has been mapped
    without_imu : sweeps mapped although their IMU samples had not all come
    statuses : sweeps mapped, by status
    waiting, deepest : sweeps not yet mapped, and in the queue at most
    latency : of the last 1000 sweeps, by stage: ``waiting`` from its reception to the start,
        ``mapping``, ``publishing``, and ``total``. Empty before the first one.
    """

    received: Mapping[str, int]
    dropped: Mapping[str, int]
    unmatched: Mapping[str, int]
    faults: Mapping[str, int]
    late: Mapping[str, int]
    without_imu: int
    statuses: Mapping[str, int]
    waiting: int
    deepest: int
    latency: Mapping[str, Latency]

    def __str__(self) -> str:
        """One line for a log."""
        parts = [f"{sum(self.statuses.values())} sweeps mapped ({_listed(self.statuses)})"]
        counted = {"dropped": self.dropped, "late": self.late, "unmatched": self.unmatched}
        for what, counts in (counted | {"not used": self.faults}).items():
            if sum(counts.values()):
                parts.append(f"{what}: {_listed(counts)}")
        if self.without_imu:
            parts.append(f"{self.without_imu} mapped before their IMU samples came")
        parts.append(f"{self.waiting} waiting (most: {self.deepest})")
        for stage, took in self.latency.items():
            median, p95, worst = (f"{1e3 * s:.0f}" for s in (took.median, took.p95, took.worst))
            parts.append(f"{stage} {median} ms (95 %: {p95}, worst: {worst})")
        return "; ".join(parts)


@dataclass(slots=True)
class LiveLog:
    """Counts while the run goes on, bounded however long that is; not locked."""

    received: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    late: Counter[str] = field(default_factory=Counter)
    statuses: Counter[str] = field(default_factory=Counter)
    without_imu: int = 0
    deepest: int = 0
    _seconds: deque[tuple[float, ...]] = field(default_factory=lambda: deque(maxlen=_LATEST))

    def fault(self, reason: str) -> None:
        """Count a message that cannot be used."""
        reason = reason[:_LETTERS]
        new = reason not in self.faults and len(self.faults) >= _REASONS
        self.faults[OTHER_REASONS if new else reason] += 1

    def mapped(self, update: MapUpdate, seconds: tuple[float, ...]) -> None:
        """Count a sweep, and note how long it took, by stage."""
        self.statuses[str(update.status)] += 1
        if update.status is FrameStatus.UNUSABLE_SCAN:
            self.fault(update.message)
        elif not update.status.has_pose:
            self.late["sweep"] += 1
        self._seconds.append(seconds)

    def report(self, waiting: int, unmatched: Mapping[str, int]) -> LiveReport:
        """As it is now, to keep."""
        latency = {}
        if self._seconds:
            seconds = np.array(self._seconds)
            ranks = np.percentile(seconds, [50, 95, 100], axis=0, method="inverted_cdf")
            latency = dict(zip(STAGES, map(Latency, *ranks.tolist()), strict=True))
        counts = ("received", "dropped", "faults", "late", "statuses")
        return LiveReport(
            **{name: dict(getattr(self, name)) for name in counts},
            unmatched=dict(unmatched),
            without_imu=self.without_imu,
            waiting=waiting,
            deepest=self.deepest,
            latency=latency,
        )


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items() if count)
