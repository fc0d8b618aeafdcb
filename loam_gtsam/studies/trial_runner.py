"""Where trials run: in this process, in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from loam_gtsam.studies.trials import Row, Trial, empty_row, run_trial, versions
from loam_gtsam.types import LoamError, OutputError

_POLL = 0.2  # seconds between two checks whether the user has asked to stop
_CONNECT_SECONDS = 10
_DEATHS = 4  # worker processes that may die of one trial before the trial counts as failed
Work = Callable[[Trial], Row]
"""What a worker does with a trial: :func:`loam_gtsam.studies.trials.run_trial`, except in tests."""


class ClusterError(LoamError):
    """The scheduler of a cluster cannot be reached, or the connection was lost."""


def run_trials(
    trials: Sequence[Trial],
    stopped: Callable[[], bool],
    workers: LocalWorkers | ClusterWorkers | None = None,
    work: Work | None = None,
) -> Iterator[Row]:
    """Run trials; a row comes as soon as its trial is finished.

    A trial whose worker process dies runs again. Workers get as many trials as they have slots and
    no more: the scheduler of a cluster suspects every trial that a dying worker held. Raises
    KeyboardInterrupt if the user asked to stop; trials under way are lost.

    Parameters
    ----------
    stopped : whether the user has asked to stop
    workers : None for this process, one trial after the other; a stop acts after each frame
    """

    def stop_if_asked(*_: object) -> None:
        if stopped():
            raise KeyboardInterrupt

    if workers is None:
        for trial in trials:
            stop_if_asked()
            yield run_trial(trial, stop_if_asked)
        return
    task = partial(_work_if_same_versions, work or run_trial, versions())
    waiting = deque(trials)
    running: dict[Future[Row], Trial] = {}
    deaths: Counter[str] = Counter()
    while waiting or running:
        stop_if_asked()
        # Without any worker, one trial waits at the scheduler for the first one.
        while waiting and len(running) < max(1, workers.slots):
            trial = waiting.popleft()
            running[workers.submit(task, trial)] = trial
        done, _ = wait(running, timeout=_POLL, return_when=FIRST_COMPLETED)
        for future in done:
            trial, error = running.pop(future), future.exception()
            if error is None:
                yield future.result()
                continue
            deaths[trial.id] += isinstance(error, BrokenExecutor)
            if isinstance(error, BrokenExecutor) and deaths[trial.id] < _DEATHS:
                waiting.appendleft(trial)
            else:
                yield empty_row(trial) | {"error": f"{type(error).__name__}: {error}"}


def _work_if_same_versions(work: Work, wanted: Mapping[str, str], trial: Trial) -> Row:
    here = versions()
    if here != wanted:
        problem = ", ".join(f"{name} {here[name]}" for name in here if here[name] != wanted[name])
        error = f"the worker has {problem}, unlike the caller; install the same versions"
        return empty_row(trial) | dict(wanted) | {"error": error}
    return work(trial)


class LocalWorkers:
    """Executors of one process each: a process that dies takes no other trial with it."""

    def __init__(self, count: int) -> None:
        self.slots = count
        self.children: set[multiprocessing.process.BaseProcess] = set()
        self.last: dict[ProcessPoolExecutor, Future[Any]] = {}

    def submit(self, work: Work, trial: Trial) -> Future[Row]:
        """Start a trial; at most ``slots`` trials may be under way."""
        done = ((executor, last) for executor, last in self.last.items() if last.done())
        idle = (e for e, last in done if not isinstance(last.exception(), BrokenExecutor))
        executor = next(idle, None) or self._start()
        try:
            future = executor.submit(work, trial)
        except BrokenExecutor:  # the process died between two trials
            self.last.pop(executor, None)
            return self.submit(work, trial)
        self.last[executor] = future
        return future

    def _start(self) -> ProcessPoolExecutor:
        others = set(multiprocessing.active_children())
        # Ctrl-C in a terminal reaches every process, and the caller handles it.
        executor = ProcessPoolExecutor(
            1, multiprocessing.get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
        )
        executor.submit(os.getpid)  # starts the process
        self.children |= set(multiprocessing.active_children()) - others
        return executor


@contextmanager
def local_workers(count: int) -> Iterator[LocalWorkers]:
    """Processes of this machine, one trial at a time in each; trials under way end with them."""
    # The threads of several processes disturb each other's times. BLAS reads this at its start.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    workers = LocalWorkers(count)
    try:
        yield workers
    finally:
        for child in workers.children.intersection(multiprocessing.active_children()):
            child.terminate()
        for executor in workers.last:
            executor.shutdown(cancel_futures=True)


class ClusterWorkers:
    """The workers of a Dask cluster."""

    def __init__(self, client: Any) -> None:
        self.client = client
        # Not pure: a scheduler that still holds an old result would hand it out again.
        self.executor: Executor = client.get_executor(pure=False)
        self.submit: Callable[[Work, Trial], Future[Row]] = self.executor.submit

    @property
    def slots(self) -> int:
        """Number of trials that can run at the same time."""
        return sum(self.client.nthreads().values())


@contextmanager
def cluster_workers(address: str) -> Iterator[ClusterWorkers]:
    """The workers of a running Dask cluster, by the address of its scheduler.

    Raises OutputError if Dask is not installed; ClusterError if the scheduler cannot be reached, or
    the connection is lost.
    """
    try:
        from distributed import Client
        from distributed.comm.addressing import parse_address, parse_host_port
        from distributed.utils import silence_logging_cmgr
    except ImportError as error:
        raise OutputError(
            f'--scheduler needs Dask ({error}): pip install "loam_gtsam[cluster]"'
        ) from error
    # Dask logs a lost connection with a traceback; the errors below say the same.
    with silence_logging_cmgr(logging.CRITICAL):
        try:
            parse_host_port(parse_address(address)[1])
            client = Client(address, timeout=_CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ClusterError(
                f"--scheduler {address}: cannot reach a Dask scheduler there: {error}; start one "
                "with: dask scheduler"
            ) from error
        with client:
            workers = ClusterWorkers(client)
            try:
                yield workers
            except (OSError, CancelledError) as error:
                raise ClusterError(
                    f"the connection to the scheduler was lost ({error}); finished trials are "
                    "kept: start the scheduler and the study again"
                ) from error
            finally:
                with suppress(OSError, CancelledError):
                    workers.executor.shutdown(wait=False)
