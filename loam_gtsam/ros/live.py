"""A live run without ROS: messages come in as they are measured, poses come out.

Here are the queues, what waits for what, and what is dropped when the mapper is too slow.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from loam_gtsam.config import Config, as_config
from loam_gtsam.datasets.decode.loam_messages import StampMatcher
from loam_gtsam.datasets.decode.pointcloud2 import CloudStream, decode_imu
from loam_gtsam.errors import check_kind, check_nanoseconds, check_number, check_part, own_code
from loam_gtsam.imu.buffer import REST_AHEAD
from loam_gtsam.loops.closure import LoopCloser
from loam_gtsam.pipeline import Observer, Pipeline
from loam_gtsam.registration.odometry import Odometry
from loam_gtsam.registration.solvers import ScanSolver
from loam_gtsam.registration.solvers.own_factors import ExtraFactors
from loam_gtsam.ros.live_inputs import (
    LiveImu,
    ReadySweep,
    Row,
    SweepDecoder,
    check_stamp,
    checked_stamp,
    sample_rows,
)
from loam_gtsam.ros.live_report import LiveLog, LiveReport
from loam_gtsam.types import DatasetError, ImuSamples, InputError, MapUpdate, Scan, Sweep

_POLL = 0.02  # seconds after which a worker looks whether a sweep has waited for long enough


@dataclass(frozen=True, slots=True, repr=False)
class LiveResult:
    """One sweep, mapped; ``received`` to ``published`` are in nanoseconds of the clock."""

    sweep: Sweep
    update: MapUpdate
    received: int
    started: int
    mapped: int
    published: int

    def __repr__(self) -> str:
        return f"LiveResult({self.update}, {self.seconds[-1]:.3f} s after it came)"

    @property
    def seconds(self) -> tuple[float, ...]:
        """Waiting, mapping, publishing, and all of it."""
        moments = (self.received, self.started, self.mapped, self.published)
        steps = [end - start for start, end in pairwise(moments)]
        return tuple(step * 1e-9 for step in (*steps, self.published - self.received))


class LiveMapper:
    """Maps sweeps as they come, each as soon as its IMU samples are there.

    Any thread may call the ``add`` methods, :meth:`report` and :meth:`wait`, which return at once
    or when told; one thread at a time calls :meth:`step`, :meth:`work` or :meth:`finish`, which
    own the pipeline.
    If nothing is dropped and no sweep waits in vain, poses and map are those of
    :func:`loam_gtsam.pipeline.run` on a bag of the same messages, to the last bit.

    Memory grows with the map and the keyframes of the loops, of which each that was forgotten keeps
    0.6 kB; not with the time of the run.
    Raises ConfigError if features come without one of LOAM's three topics, or ``axes`` is unknown,
    InputError if ``imu`` or ``features`` are something else.

    Parameters
    ----------
    config : section ``live`` says how long the queues are
    imu, features : whether IMU samples, which topics of LOAM's front end (not clouds) will come
    axes : of those topics, see :class:`loam_gtsam.datasets.bags.loam_topics.LoamTopicsDataset`
    clouds : decodes the clouds; None takes a new one without options
    observe : called after each sweep, e.g. to publish it; its time counts as publishing
    solver, odometry, extra_factors, loop_closer : see :class:`loam_gtsam.pipeline.Pipeline`
    clock : nanoseconds, never going back

    Attributes
    ----------
    pipeline : maps the sweeps; not to be touched while ``step`` runs, and another one after
        :meth:`reset`
    """

    def __init__(
        self, config: Config | None = None, *, imu: bool = False,
        features: Collection[str] = (), axes: Literal["auto", "lidar", "loam"] = "auto",
        clouds: CloudStream | None = None, observe: Observer | None = None,
        solver: ScanSolver | None = None, odometry: Odometry | None = None,
        extra_factors: ExtraFactors | None = None, loop_closer: LoopCloser | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        _check_parts(imu, clouds, observe, clock)
        self._config = config = as_config(config)
        self._decoder = SweepDecoder(config, features, axes, clouds or CloudStream())
        bounded = config.live.when_full != "never"
        self._imu: LiveImu | None = None
        if imu and config.imu.coupling != "off":
            self._imu = LiveImu(config.imu, config.live.imu_queue if bounded else None)
        self._parts: dict[str, Any] = {"solver": solver, "odometry": odometry}
        self._parts |= {"extra_factors": extra_factors, "loop_closer": loop_closer}
        self._begin()
        self._matcher = StampMatcher(features)
        self._features = frozenset(features)
        self._observe, self._clock = observe, clock
        # Below: shared between threads, under the lock.
        self._lock = threading.Lock()
        self._news = threading.Event()
        self._log = LiveLog()
        self._queue: deque[tuple[int, Any]] = deque()
        # Below: of the thread that maps.
        self._current: ReadySweep | None = None

    # -- from any thread ---------------------------------------------------------------------------

    def add_cloud(self, message: Any, received: int | None = None) -> None:
        """Queue a ``sensor_msgs/PointCloud2``; whatever is wrong with it is found when it is due.

        ``received`` is in nanoseconds of the clock; None is now. Raises InputError if this run is
        one of LOAM's topics.
        """
        if self._features:
            raise InputError("add_cloud: this run expects LOAM's topics, see add_features")
        received = _moment(received, self._clock)
        with self._lock:
            self._log.received["cloud"] += 1
            self._enqueue(received, message)

    def add_scan(self, scan: Scan, received: int | None = None) -> None:
        """Queue a sweep that is no message: whatever there is a driver for, without ROS.

        The sweep is copied: the arrays may be filled anew as soon as this returns.
        ``received`` is in nanoseconds of the clock; None is now. Raises InputError if it is no
        Scan, or this run is one of LOAM's topics.
        """
        check_kind(scan, Scan, "add_scan", "Scan(points, stamp) makes one")
        self.add_cloud(deepcopy(scan), received)

    def add_features(self, topic: str, message: Any, received: int | None = None) -> None:
        """Take a message of LOAM's front end; those whose stamps agree to 5 ms make a sweep.

        Raises InputError if it is none of this run's topics.
        """
        if not isinstance(topic, str) or topic not in self._features:
            raise InputError(
                f"add_features: expected one of {', '.join(sorted(self._features)) or 'none'}; "
                f"got {topic!r}"
            )
        received = _moment(received, self._clock)
        with self._lock:
            self._log.received[topic] += 1
            try:
                stamp = checked_stamp(message)
            except DatasetError as error:
                self._log.fault(f"{topic}: {error}")
                return
            group = self._matcher.add(topic, stamp, message)
            if group is not None:
                self._enqueue(received, group)

    def add_imu(self, message: Any) -> None:
        """Take a ``sensor_msgs/Imu`` or :class:`~loam_gtsam.ImuSamples`; ignored without an IMU."""
        if self._imu is None:
            return
        with self._lock:
            if isinstance(message, ImuSamples):
                for row in sample_rows(message):
                    self._log.received["imu"] += 1
                    self._take_sample(row)
                self._news.set()
                return
            self._log.received["imu"] += 1
            try:
                checked_stamp(message)
                row = decode_imu(message)
            except DatasetError as error:
                self._log.fault(f"imu: {error}")
                return
            self._take_sample(row)
        self._news.set()

    def _take_sample(self, row: Row) -> None:
        assert self._imu is not None
        try:
            check_stamp(row[0])
            if not np.isfinite(row[1]).all():
                raise DatasetError("NaN or infinity")
            self._imu.add(row)
        except DatasetError as error:
            self._log.fault(f"imu: {error}")

    def fault(self, reason: str) -> None:
        """Count a message that could not even be handed over."""
        with self._lock:
            self._log.fault(reason)

    def report(self) -> LiveReport:
        """What has become of all messages so far."""
        with self._lock:
            if self._imu is not None:
                self._log.dropped["imu"] = self._imu.dropped
                self._log.late["imu"] = self._imu.late
            waiting = len(self._queue) + (self._current is not None)
            return self._log.report(waiting, self._matcher.unmatched)

    # -- from the one thread that maps -------------------------------------------------------------

    def step(self) -> LiveResult | None:
        """Map the next sweep; None if there is none or the next one waits for the IMU."""
        return self._step(ended=False)

    def finish(self) -> list[LiveResult]:
        """Map all sweeps that wait, without waiting for the IMU: to be called at the end."""
        return list(iter(partial(self._step, ended=True), None))

    def _step(self, *, ended: bool) -> LiveResult | None:
        self._news.clear()
        while self._current is None:
            with self._lock:
                if not self._queue:
                    return None
                received, content = self._queue.popleft()
            try:
                self._current = self._decoder.decode(received, content)
            except DatasetError as error:
                self.fault(str(error))
        if self._must_wait(self._current, ended):
            return None
        return self._map(self._current)

    def reset(self) -> None:
        """Begin a new run, e.g. after :attr:`loam_gtsam.types.SweepFault.CLOCK_SET_BACK`.

        Map, motion, loops and IMU samples are forgotten; how messages are read, and the counts of
        the report, are kept. Messages that wait are the first of the new run. To be called from
        ``observe``, or between two steps, by the thread that maps.
        """
        self.pipeline.reset()  # parts of the user's own forget too
        if self._imu is not None:
            self._imu.forget()
        self._begin()

    def wait(self, seconds: float) -> None:
        """Wait until a message comes, but not longer than this."""
        check_number(seconds, "seconds")
        self._news.wait(seconds)

    def work(self, stop: threading.Event) -> None:
        """Map all sweeps that come, until told to stop."""
        while not stop.is_set():
            if self.step() is None:
                self.wait(_POLL)

    def _begin(self) -> None:
        buffer = None if self._imu is None else self._imu.buffer
        self.pipeline = Pipeline(self._config, imu=buffer, **self._parts)
        self._no_level = False

    def _enqueue(self, received: int, content: Any) -> None:
        live, queue = self._config.live, self._queue
        if live.when_full != "never" and len(queue) >= live.queue:
            gone = 1 if live.when_full == "drop_oldest" else len(queue)
            self._log.dropped["sweep"] += gone
            for _ in range(gone):
                queue.popleft()
        queue.append((received, content))
        self._log.deepest = max(self._log.deepest, len(queue))
        self._news.set()

    def _must_wait(self, current: ReadySweep, ended: bool) -> bool:
        imu, config, aid = self._imu, self._config, self.pipeline.mapper.imu
        if imu is None or aid is None or current.needs is None:
            return False
        # Up is found from the samples before the first sweep and as long after it.
        levelling = aid.level is None and not self._no_level
        more = round(max(config.imu.still_seconds, REST_AHEAD) * 1e9) if levelling else 0
        if imu.covers(current.needs + more):
            return False
        patience = round(config.live.imu_wait * 1e9) + more
        if not ended and self._clock() < current.received + patience:
            return True
        self._no_level = levelling or self._no_level
        if not imu.covers(current.needs):
            with self._lock:
                self._log.without_imu += 1
        return False

    def _map(self, current: ReadySweep) -> LiveResult:
        started = self._clock()
        if self._imu is not None and current.needs is not None:
            with self._lock:
                rows = self._imu.take()
            self._imu.hand_over(rows, current.needs)
        update = self.pipeline.process(current.sweep)
        self._current = None  # if a part of the user's own raises, the next step tries it again
        mapped = self._clock()
        if self._observe is not None:
            with self.pipeline.faults.forgiven(), own_code("observe", self._observe):
                self._observe(current.sweep, update, self.pipeline)
        result = LiveResult(current.sweep, update, current.received, started, mapped, self._clock())
        with self._lock:
            self._log.mapped(update, result.seconds)
        return result


def _check_parts(imu: object, clouds: object, observe: object, clock: object) -> None:
    """InputError for a part that is none; the pipeline checks the others."""
    check_kind(imu, bool, "imu", "whether add_imu will be called")
    if clouds is not None:
        check_kind(clouds, CloudStream, "clouds", "CloudStream(time_field=...) makes one")
    check_part(observe, "observe", "a function", "__call__")
    check_part(clock, "clock", "a function", "__call__")
    if clock is None:
        raise InputError("clock: expected a function, got None; leave it out")


def _moment(received: int | None, clock: Callable[[], int]) -> int:
    """When a message was received, nanoseconds of the clock."""
    if received is None:
        return clock()
    check_nanoseconds(received, "received")
    return received
