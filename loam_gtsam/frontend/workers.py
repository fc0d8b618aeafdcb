"""Worker processes, which extract the features of the next sweeps while one is being solved."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import cycle
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.heap import Arena
from multiprocessing.reduction import ForkingPickler

from loam_gtsam.config import Config
from loam_gtsam.errors import check_kind, is_own, own_code
from loam_gtsam.frontend.features import extract_features, thinned
from loam_gtsam.types import Features, Scan, Sweep, SweepError, SweepFault

_AHEAD = 2
"""Sweeps read ahead per process: one that is worked on, and one that waits for the process."""
_IN_FLIGHT = _AHEAD + 1
"""Sweeps at most that a process was sent and has not answered."""
_SLOT = 1 << 23
"""Bytes of memory for each sweep in flight: 350,000 points with times and rings."""
_PATIENCE = 5.0
"""Seconds that a process is given to end, for it may be at work."""
_SILENCE = 60.0
"""Seconds after which a process that does not answer is given up, stopped or hung."""

_log = logging.getLogger(__name__)

FrontEnd = Callable[[Scan], Features]
"""Makes the features of a sweep; raises SweepError for a sweep without any."""


@dataclass(frozen=True, slots=True, eq=False)
class Extraction:
    """Features of a sweep, or why there are none: a sentence and typed; seconds that it took."""

    features: Features | None
    problem: str
    seconds: float
    fault: SweepFault | None = None


def extract(scan: Scan, config: Config, front_end: FrontEnd | None = None) -> Extraction:
    """Extract the features of a sweep in this process; no content of a sweep raises an error.

    ``front_end`` takes the place of :func:`~loam_gtsam.frontend.features.extract_features`; what
    it raises is a PartError.

    With ``odometry.method: constant_velocity`` the features are thinned to the voxels of the map,
    as the mapper would do it, so that less is handed over. ``scan_to_scan`` needs all of them.
    """
    started = time.perf_counter()
    features, problem, fault = None, "", None
    try:
        if front_end is None:
            features = extract_features(scan, config)
        else:
            own = front_end if is_own(front_end) else "one of this package"
            with own_code("features", own):
                features = front_end(scan)
                check_kind(
                    features, Features, "what features returns", "extract_features makes them"
                )
        if config.odometry.method == "constant_velocity":
            features = thinned(features, config.map)
    except SweepError as error:
        problem, fault = str(error), error.fault
    return Extraction(features, problem, time.perf_counter() - started, fault)


def extract_ahead(
    sweeps: Iterable[tuple[Sweep, float]], config: Config, workers: int
) -> Iterator[tuple[Sweep, float, Extraction | None]]:
    """Each sweep with its features, extracted by processes that are a few sweeps ahead.

    The features are the same at any number of processes. An error of ``sweeps`` is raised after
    the sweeps before it.

    Parameters
    ----------
    sweeps : each with a number of the caller's, which is handed on
    config : of the run
    workers : processes; with 0 nothing is extracted, and no sweep is read ahead

    Yields
    ------
    sweep, number, extraction
        The extraction is None if the caller is to extract the features: without processes, if a
        process died or does not answer, or if a sweep is too large to be handed over. It is None,
        too, for sweeps that are no scans.
    """
    source = iter(sweeps)
    crew = _crew(config, workers)
    if not crew:
        for sweep, number in source:
            yield sweep, number, None
        return
    waiting: deque[tuple[Sweep, float, _Worker | None]] = deque()
    error: Exception | None = None
    more = True
    with ExitStack() as stack:
        team = cycle([stack.enter_context(worker) for worker in crew])
        while True:
            while more and len(waiting) <= _AHEAD * len(crew):
                try:
                    sweep, number = next(source)
                except StopIteration:
                    more = False
                except Exception as caught:
                    error, more = caught, False
                else:
                    worker = None
                    if isinstance(sweep, Scan) and not (worker := next(team)).send(sweep):
                        worker = None
                    waiting.append((sweep, number, worker))
            if not waiting:
                break
            sweep, number, worker = waiting.popleft()
            yield sweep, number, None if worker is None else worker.receive()
    if error is not None:
        raise error


def timed(dataset: Iterable[Sweep]) -> Iterator[tuple[Sweep, float]]:
    """The sweeps, each with the seconds it took to read."""
    sweeps = iter(dataset)
    while True:
        started = time.perf_counter()
        try:
            sweep = next(sweeps)
        except StopIteration:
            return
        yield sweep, time.perf_counter() - started


def _crew(config: Config, workers: int) -> list[_Worker]:
    """The processes, as many of them as memory and system allow."""
    crew: list[_Worker] = []
    try:
        for _ in range(workers):
            crew.append(_Worker(config))
    except OSError as error:
        others = f"{len(crew)} of {workers} are used" if crew else "the features are extracted here"
        _log.warning("no process for feature extraction: %s; %s", error.strerror or error, others)
    return crew


class _Worker:
    """A process that extracts the features of sweeps in the order in which they are sent."""

    def __init__(self, config: Config) -> None:
        context = get_context("spawn")  # a forked child of a process with threads may hang
        memory = _memory(_IN_FLIGHT * _SLOT)
        self._pipe, far = context.Pipe()
        # The pipe only tells numbers of bytes: through it sweeps took 2 of the 15 ms of a frame.
        self._outgoing, self._incoming = _slots(memory), _slots(memory)
        self._process = context.Process(target=_serve, args=(far, memory, config), daemon=True)
        try:
            with _deaf():
                self._process.start()
        except OSError:
            self._pipe.close()
            raise
        finally:
            far.close()  # otherwise the death of the process would not close the pipe
        self._alive = True

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self._pipe.close()
        self._process.join(_PATIENCE if self._alive else 0.0)
        self._process.kill()  # it may be stopped
        self._process.join()
        self._process.close()

    def send(self, scan: Scan) -> bool:
        """Have a sweep worked on; False if the sweep is too large, or the process is dead."""
        data = ForkingPickler.dumps(scan)
        if not self._alive or len(data) > _SLOT:
            return False
        with self._watched():
            next(self._outgoing)[: len(data)] = data
            self._pipe.send(len(data))
        return True

    def receive(self) -> Extraction | None:
        """The features of the first sweep not received yet; None if the process cannot say."""
        if self._alive:
            with self._watched():
                if not self._pipe.poll(_SILENCE):
                    raise TimeoutError(f"did not answer for {_SILENCE:g} s")
                slot, size = next(self._incoming), self._pipe.recv()
                extraction: Extraction | None = ForkingPickler.loads(slot[:size])
                return extraction
        return None

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except (EOFError, OSError) as error:
            self._alive = False
            what = error if isinstance(error, TimeoutError) else "died"
            _log.warning(
                "a process for feature extraction %s; the features are extracted here", what
            )


@contextmanager
def _deaf() -> Iterator[None]:
    """A process that starts here hears no interrupt: that is for the caller to handle."""
    resource_tracker.ensure_running()  # which would hear for both, once it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _memory(size: int) -> Arena:
    """Shared memory that is there: a file that is full when it is written kills the process."""
    arena = Arena(size)
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(arena.fd, 0, size)
    return arena


def _slots(memory: Arena) -> Iterator[memoryview]:
    """The parts of the shared memory, one after the other, over and over."""
    view = memoryview(memory.buffer)
    return cycle([view[start : start + _SLOT] for start in range(0, len(view), _SLOT)])


def _serve(pipe: Connection, memory: Arena, config: Config) -> None:
    """In the process: answer each sweep, until the caller closes the pipe."""
    with suppress(EOFError, OSError):
        for slot in _slots(memory):
            scan = ForkingPickler.loads(slot[: pipe.recv()])
            answer = ForkingPickler.dumps(extract(scan, config))
            if len(answer) > _SLOT:
                answer = ForkingPickler.dumps(None)
            slot[: len(answer)] = answer
            pipe.send(len(answer))
