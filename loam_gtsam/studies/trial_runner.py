"""Where trials run, on Dask: in this process, in processes of this machine, or on a cluster.

Imports dask, which is optional: import this module only where it is needed.
"""

from __future__ import annotations

import logging
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any
from uuid import uuid4

import dask
from distributed import Client, Future, LocalCluster, WorkerPlugin, wait
from distributed.comm.addressing import parse_address, parse_host_port
from distributed.utils import silence_logging_cmgr

from loam_gtsam.studies.trials import Row, Trial, empty_row, run_trial, versions
from loam_gtsam.types import LoamError, MapUpdate

_POLL = 0.2
"""Seconds between two looks at whether the sweep is to stop."""
_CONNECT_SECONDS = 10

Stopped = Callable[[], bool]
"""Whether the user has asked to stop."""
Work = Callable[[Trial], Row]


class ClusterError(LoamError):
    """The scheduler cannot be reached, or was lost."""


def run_here(trials: Sequence[Trial], stopped: Stopped) -> Iterator[Row]:
    """Run trials in this process, one after the other, by Dask's synchronous scheduler.

    Raises
    ------
    KeyboardInterrupt
        After the frame during which it was stopped.
    """

    def on_frame(number: int, update: MapUpdate) -> None:
        if stopped():
            raise KeyboardInterrupt

    for trial in trials:
        if stopped():
            raise KeyboardInterrupt
        row: Row = dask.delayed(partial(run_trial, trial, on_frame))().compute(scheduler="sync")
        yield row


def run_on(
    client: Client, trials: Sequence[Trial], stopped: Stopped, work: Work | None = None
) -> Generator[Row, None, None]:
    """Run trials on the workers of a cluster; rows come as they are finished.

    A worker gets as many trials as it has threads and no more: the scheduler suspects all that a
    dying worker held, and gives up those that were there too often.

    Parameters
    ----------
    work : what a worker does with a trial; ``run_trial`` if None

    Raises
    ------
    KeyboardInterrupt
        If it was stopped; trials that run are given up.
    ClusterError
        If the connection to the scheduler is lost.
    """
    task = partial(_work, work or run_trial, versions())
    waiting = deque(trials)
    running: dict[Future, Trial] = {}
    try:
        while waiting or running:
            if stopped():
                raise KeyboardInterrupt
            slots = max(1, sum(client.nthreads().values()))  # one waits for the first worker
            while waiting and len(running) < slots:
                trial = waiting.popleft()
                # Not the id alone: a scheduler that still holds an old result would hand it out.
                key = f"trial-{trial.id}-{uuid4()}"
                running[client.submit(task, trial, key=key, pure=False)] = trial
            with suppress(TimeoutError), client.as_current():
                wait(list(running), timeout=_POLL, return_when="FIRST_COMPLETED")
            for future in [future for future in running if future.done()]:
                yield _row(future, running.pop(future))
    except (OSError, CancelledError) as error:
        raise ClusterError(
            f"the connection to the scheduler was lost ({error}); finished trials are kept: start "
            "it and the sweep again"
        ) from error
    finally:
        with suppress(OSError, CancelledError):
            client.cancel(list(running))


def _work(work: Work, wanted: Mapping[str, str], trial: Trial) -> Row:
    """On a worker: the trial, if the same versions are installed there."""
    here = versions()
    if here != wanted:
        problem = ", ".join(f"{name} {here[name]}" for name in here if here[name] != wanted[name])
        error = f"the worker has {problem}, unlike the caller; install the same versions"
        return empty_row(trial) | dict(wanted) | {"error": error}
    return work(trial)


def _row(future: Future, trial: Trial) -> Row:
    error = future.exception()
    if isinstance(error, CancelledError):
        raise error
    if error is None:
        row: Row = future.result()
        return row
    return empty_row(trial) | {"error": f"{type(error).__name__}: {error}"}


@contextmanager
def local_workers(count: int) -> Iterator[Client]:
    """A cluster of processes on this machine, one trial at a time in each."""
    with (
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,  # else a long run is killed where it would have swapped
            dashboard_address=None,
            silence_logs=logging.ERROR,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        client.register_plugin(_IgnoreInterrupts())
        yield client


@contextmanager
def cluster_at(address: str) -> Iterator[Client]:
    """A running cluster, by the address of its scheduler.

    Raises
    ------
    ClusterError
        If it cannot be reached.
    """
    # Its own logs tell of a lost connection by traceback; the errors below say the same.
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
            yield client


class _IgnoreInterrupts(WorkerPlugin):  # type: ignore[misc]  # dask is not checked
    """Ctrl-C in a terminal reaches every process of this machine; the caller alone handles it."""

    def setup(self, worker: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
