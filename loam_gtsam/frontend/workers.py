"""Feature extraction of the next sweeps in processes of their own, while one is being solved."""

from __future__ import annotations

import ctypes
import logging
import signal
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.reduction import ForkingPickler
from queue import SimpleQueue
from threading import Thread
from typing import Any

from loam_gtsam.config import Config
from loam_gtsam.frontend.features import extract_features, thinned
from loam_gtsam.types import Features, Scan, Sweep, SweepError, SweepFault

_AHEAD = 2
"""Sweeps read ahead of the current one, a process: one at work and one that waits for it."""
_IN_FLIGHT = _AHEAD + 1
"""Sweeps that a process was sent and has not answered for, at most."""
_SLOT = 1 << 21
"""Bytes of memory for each: 170,000 points."""
_PATIENCE = 5.0
"""Seconds that a process is given to end: it may be at work."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Extraction:
    """Features of a sweep, or why there are none, and the seconds it took to find out."""

    features: Features | None
    problem: str
    seconds: float
    fault: SweepFault | None = None


def extract(scan: Scan, config: Config) -> Extraction:
    """Extract features here and now; what a sweep contains never raises."""
    started = time.perf_counter()
    features, problem, fault = None, "", None
    try:
        features = extract_features(scan, config)
        if config.odometry.method == "constant_velocity":
            # The mapper would do it, and so less is handed over. Scan to scan needs them all.
            features = thinned(features, config.map)
    except SweepError as error:
        problem, fault = str(error), error.fault
    return Extraction(features, problem, time.perf_counter() - started, fault)


def extract_ahead(
    sweeps: Iterable[tuple[Sweep, float]], config: Config, workers: int
) -> Iterator[tuple[Sweep, float, Extraction | None]]:
    """Each sweep with its features, extracted by processes that are a few sweeps ahead.

    The features are the same at any number of processes. An error of ``sweeps`` is raised after
    the sweeps before it. If a process dies, the work is done here.

    Parameters
    ----------
    sweeps : each with a number of the caller's, which is handed on
    config : for the features
    workers : processes; with 0 nothing is extracted, and no sweep read ahead

    Yields
    ------
    sweep, number, extraction
        The last is None for sweeps that are no scans, and without processes.
    """
    if workers == 0:
        for sweep, number in sweeps:
            yield sweep, number, None
        return
    source = iter(sweeps)
    waiting: deque[tuple[Sweep, float, _Extractor | None]] = deque()
    error: Exception | None = None
    more = True
    with ExitStack() as stack:
        idle = deque(stack.enter_context(_Extractor(config)) for _ in range(workers))
        while True:
            while more and len(waiting) <= _AHEAD * workers:
                try:
                    sweep, number = next(source)
                except StopIteration:
                    more = False
                except Exception as caught:
                    error, more = caught, False
                else:
                    extractor = None
                    if isinstance(sweep, Scan):
                        extractor = idle[0]
                        extractor.send(sweep)
                        idle.rotate(-1)
                    waiting.append((sweep, number, extractor))
            if not waiting:
                break
            sweep, number, extractor = waiting.popleft()
            yield sweep, number, None if extractor is None else extractor.receive()
    if error is not None:
        raise error


class _Extractor:
    """A process that extracts features of sweeps in the order in which they are sent.

    Sweeps and features are handed over when they are sent and received. A pool of
    ``concurrent.futures`` does it in threads of its own, which interrupt the solve, and through
    pipes: with 16 beams that took 2 of the 15 ms of a frame.
    """

    def __init__(self, config: Config) -> None:
        # Spawned, for a forked child of a process with threads may hang.
        context = get_context("spawn")
        self._pipe, far = context.Pipe()
        self._there, self._back = _Shared(context), _Shared(context)
        ways = self._there, self._back
        self._process = context.Process(target=_serve, args=(far, *ways, config), daemon=True)
        self._process.start()
        far.close()  # or its end would not be seen
        self._alive = True

    def __enter__(self) -> _Extractor:
        return self

    def __exit__(self, *_: object) -> None:
        self._pipe.close()
        self._process.join(_PATIENCE)
        self._process.kill()

    def send(self, scan: Scan) -> None:
        """Have a sweep worked on; nothing happens if the process is dead."""
        if self._alive:
            with self._watched():
                self._there.send(self._pipe, scan)

    def receive(self) -> Extraction | None:
        """What was found in the first sweep not received yet; None if the process is dead."""
        if self._alive:
            with self._watched():
                extraction: Extraction = self._back.receive(self._pipe)
                return extraction
        return None

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except (EOFError, OSError):
            self._alive = False
            _log.warning("a process for feature extraction died; the features are extracted here")


class _Shared:
    """One way of a pipe, by way of memory that both processes have.

    Sweeps are too much for a pipe: they go through it in parts, and every part wakes the other
    process. What does not fit the memory goes through all the same.
    """

    def __init__(self, context: SpawnContext) -> None:
        self._memory = context.RawArray(ctypes.c_byte, _IN_FLIGHT * _SLOT)
        self._sent = 0

    def send(self, pipe: Connection, value: Scan | Extraction) -> None:
        data = ForkingPickler.dumps(value)  # as the pipe does it
        if len(data) > _SLOT:
            pipe.send(value)
            return
        start = self._sent % _IN_FLIGHT * _SLOT
        self._sent += 1
        place = slice(start, start + len(data))
        self._bytes[place] = data
        pipe.send(place)

    def receive(self, pipe: Connection) -> Any:
        value = pipe.recv()
        return ForkingPickler.loads(self._bytes[value]) if isinstance(value, slice) else value

    @property
    def _bytes(self) -> memoryview:
        return memoryview(self._memory).cast("B")


# -- in the process --------------------------------------------------------------------------


def _serve(pipe: Connection, there: _Shared, back: _Shared, config: Config) -> None:
    """Extract features of what comes out of a pipe, until its other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is for the caller to handle
    scans: SimpleQueue[Scan | None] = SimpleQueue()
    found: SimpleQueue[Extraction] = SimpleQueue()
    # Neither the caller nor this process waits for the other to put down what it is at.
    Thread(target=_take_in, args=(pipe, there, scans), daemon=True).start()
    Thread(target=_hand_out, args=(pipe, back, found), daemon=True).start()
    while (scan := scans.get()) is not None:
        found.put(extract(scan, config))


def _take_in(pipe: Connection, there: _Shared, scans: SimpleQueue[Scan | None]) -> None:
    while True:
        try:
            scans.put(there.receive(pipe))
        except Exception:  # closed, or in the middle of a sweep
            scans.put(None)
            return


def _hand_out(pipe: Connection, back: _Shared, found: SimpleQueue[Extraction]) -> None:
    with suppress(OSError):  # closed
        while True:
            back.send(pipe, found.get())
