"""Feature extraction of the next sweeps in processes of their own, while one is being solved."""

from __future__ import annotations

import logging
import signal
import time
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context

from loam_gtsam.config import Config
from loam_gtsam.datasets.base import Sweep
from loam_gtsam.features import extract_features, thinned
from loam_gtsam.types import Features, Scan, SweepError, SweepFault

_AHEAD = 2
"""Sweeps read ahead of the current one, a process: one at work and one that waits for it."""

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
    waiting: deque[tuple[Sweep, float, Future[Extraction] | None]] = deque()
    error: Exception | None = None
    more = True
    with _processes(config, workers) as pool:
        while True:
            while more and len(waiting) <= _AHEAD * workers:
                try:
                    sweep, number = next(source)
                except StopIteration:
                    more = False
                except Exception as caught:
                    error, more = caught, False
                else:
                    waiting.append((sweep, number, _submit(pool, sweep)))
            if not waiting:
                break
            sweep, number, future = waiting.popleft()
            yield sweep, number, None if future is None else _result(future)
    if error is not None:
        raise error


@contextmanager
def _processes(config: Config, workers: int) -> Iterator[ProcessPoolExecutor]:
    # Spawned, for a forked child of a process with threads may hang.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (config,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _submit(pool: ProcessPoolExecutor, sweep: Sweep) -> Future[Extraction] | None:
    if not isinstance(sweep, Scan):
        return None
    try:
        return pool.submit(_extract, sweep)
    except BrokenProcessPool:
        return None


def _result(future: Future[Extraction]) -> Extraction | None:
    """What the process found; None if it died."""
    try:
        return future.result()
    except BrokenProcessPool:
        _log.warning("a process for feature extraction died; the features are extracted here")
        return None


# -- in the processes ------------------------------------------------------------------------

_config = Config()


def _begin(config: Config) -> None:
    global _config
    _config = config
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is for the caller to handle


def _extract(scan: Scan) -> Extraction:
    return extract(scan, _config)
