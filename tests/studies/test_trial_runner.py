"""Where trials run: in this process, in processes of this machine, on a Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.cli import loam
from support.trials import SPEC, repeatable, trial_of, write_spec

from loam_gtsam.studies import trial_runner
from loam_gtsam.studies.trial_spec import load_spec
from loam_gtsam.studies.trials import (
    TABLE_FILE,
    Row,
    Trial,
    empty_row,
    read_table,
    run_trial,
    versions,
)
from loam_gtsam.types import MapUpdate


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A Dask cluster of two worker processes with one thread each."""
    distributed = pytest.importorskip("distributed")
    settings = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "memory_limit": 0}
    quiet = {"dashboard_address": None, "silence_logs": logging.ERROR}
    with distributed.LocalCluster(**settings, **quiet) as cluster:
        yield cluster


def dies(victim: str, flag: str, trial: Trial) -> Row:
    """Kill this process in the middle of one trial: once, if a flag file tells, or always."""

    def on_frame(number: int, update: MapUpdate) -> None:
        if trial.id == victim and number == 1 and not (flag and Path(flag).exists()):
            if flag:
                Path(flag).touch()
            os.kill(os.getpid(), signal.SIGKILL)

    return run_trial(trial, on_frame)


def never() -> bool:
    return False


def in_order(trials: tuple[Trial, ...], rows: list[Row]) -> list[Row]:
    assert len(rows) == len(trials)
    found = {row["trial"]: row for row in rows}
    return repeatable([found[trial.id] for trial in trials])


def test_a_stop_between_two_trials_starts_no_other(monkeypatch):
    monkeypatch.setattr(trial_runner, "run_trial", lambda *_: pytest.fail("a trial was started"))
    with pytest.raises(KeyboardInterrupt):
        list(trial_runner.run_trials([trial_of()], lambda: True))


def test_the_death_of_a_worker_in_the_middle_changes_no_number(tmp_path):
    trials = load_spec(write_spec(tmp_path, SPEC)).trials
    here = list(trial_runner.run_trials(trials, never))
    flag = tmp_path / "died"
    work = partial(dies, trials[1].id, str(flag))
    with trial_runner.local_workers(1) as workers:
        rows = list(trial_runner.run_trials(trials, never, workers, work))
    assert flag.exists()
    assert in_order(trials, rows) == repeatable(here)
    assert all(row["error"] is None for row in rows)
    assert all(row["ate_m"] > 0.0 for row in here)


@pytest.mark.parametrize("where", ["local", "cluster"])
def test_a_trial_that_always_kills_its_worker_fails_alone(where, request, tmp_path, monkeypatch):
    trials = load_spec(write_spec(tmp_path, SPEC)).trials
    if where == "local":
        monkeypatch.setattr(trial_runner, "_DEATHS", 2)
        workers = trial_runner.local_workers(2)
    else:
        cluster = request.getfixturevalue("cluster")
        monkeypatch.setattr(cluster.scheduler, "allowed_failures", 0)
        workers = trial_runner.cluster_workers(cluster.scheduler_address)
    with workers as pool:
        rows = list(trial_runner.run_trials(trials, never, pool, partial(dies, trials[0].id, "")))
    errors = {row["trial"]: row["error"] for row in rows}
    assert errors.pop(trials[0].id).startswith(("KilledWorker: ", "BrokenProcessPool: "))
    assert set(errors.values()) == {None}
    assert len(errors) == 3


def test_a_stop_ends_the_wait_for_workers_and_the_workers(tmp_path):
    trials = load_spec(write_spec(tmp_path, SPEC)).trials
    before = set(multiprocessing.active_children())
    rows: list[Row] = []

    def run_until_stopped() -> None:
        with trial_runner.local_workers(1) as pool:
            for row in trial_runner.run_trials(trials, lambda: bool(rows), pool):
                rows.append(row)

    with pytest.raises(KeyboardInterrupt):
        run_until_stopped()
    assert 1 <= len(rows) < 4
    assert set(multiprocessing.active_children()) <= before


def test_a_worker_with_other_versions_is_refused():
    other = dict(versions()) | {"gtsam_version": "4.2"}
    row = trial_runner._work_if_same_versions(run_trial, other, trial_of())
    assert f"the worker has gtsam_version {versions()['gtsam_version']}" in row["error"]
    assert row["gtsam_version"] == "4.2"
    assert trial_runner._work_if_same_versions(empty_row, versions(), trial_of())["error"] is None


def test_the_table_is_the_same_here_in_processes_and_on_a_cluster(cluster, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = write_spec(tmp_path, SPEC)
    places = ((), ("--workers", 2), ("--scheduler", cluster.scheduler_address))
    tables = []
    for number, place in enumerate(places):
        result = loam("study", file, "--output", f"out{number}", *place)
        assert result.exit_code == 0, result.output
        tables.append(repeatable(read_table(Path(f"out{number}") / TABLE_FILE)[0]))
    assert tables[0] == tables[1] == tables[2]
    assert [(row["config"], row["seed"]) for row in tables[0]] == [
        ("gtsam", 0), ("gtsam", 1), ("few", 0), ("few", 1),
    ]  # fmt: skip
    assert tables[0][0]["ate_m"] is not None
