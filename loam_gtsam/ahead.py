"""Feature extraction of the next sweeps in processes of their own, while one is being solved."""

from __future__ import annotations

import logging
import signal
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Thread

from loam_gtsam.config import Config
from loam_gtsam.datasets.base import Sweep
from loam_gtsam.features import extract_features, thinned
from loam_gtsam.types import Features, Scan, SweepError, SweepFault

_AHEAD = 2
"""Sweeps read ahead of the current one, a process: one at work and one that waits for it."""
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
            # The mapper would do it, and nobody else needs them all.
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

    Sweeps and features go through a pipe when they are sent and received. A pool of
    ``concurrent.futures`` hands them over in threads of its own, which interrupt a solve: with a
    sweep of 16 beams that took 0.5 to 1 ms of the 17 ms of a frame.
    """

    def __init__(self, config: Config) -> None:
        # Spawned, for a forked child of a process with threads may hang.
        context = get_context("spawn")
        self._pipe, far = context.Pipe()
        self._process = context.Process(target=_serve, args=(far, config), daemon=True)
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
                self._pipe.send(scan)

    def receive(self) -> Extraction | None:
        """What was found in the first sweep not received yet; None if the process is dead."""
        if self._alive:
            with self._watched():
                extraction: Extraction = self._pipe.recv()
                return extraction
        return None

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except (EOFError, OSError):
            self._alive = False
            _log.warning("a process for feature extraction died; the features are extracted here")


# -- in the process --------------------------------------------------------------------------


def _serve(pipe: Connection, config: Config) -> None:
    """Extract features of what comes out of a pipe, until its other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is for the caller to handle
    scans: SimpleQueue[Scan | None] = SimpleQueue()
    found: SimpleQueue[Extraction] = SimpleQueue()
    # Neither the caller nor this process waits for the other to put down what it is at.
    Thread(target=_take_in, args=(pipe, scans), daemon=True).start()
    Thread(target=_hand_out, args=(pipe, found), daemon=True).start()
    while (scan := scans.get()) is not None:
        found.put(extract(scan, config))


def _take_in(pipe: Connection, scans: SimpleQueue[Scan | None]) -> None:
    while True:
        try:
            scans.put(pipe.recv())
        except Exception:  # closed, or in the middle of a sweep
            scans.put(None)
            return


def _hand_out(pipe: Connection, found: SimpleQueue[Extraction]) -> None:
    with suppress(OSError):  # closed
        while True:
            pipe.send(found.get())
