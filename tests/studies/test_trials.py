"""Parameter studies: specification, rows, resuming, table, workers, command."""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import pickle
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest
from support.cli import loam
from support.list_dataset import ListDataset
from typer.testing import Result

from loam_gtsam.config import Config, preset
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.studies import trial_runner, trials
from loam_gtsam.studies.contenders import SolverRun
from loam_gtsam.studies.evaluation import absolute_error, pose_differences, relative_error
from loam_gtsam.studies.trial_spec import load_spec
from loam_gtsam.studies.trial_table import TABLE_FILE, TRIALS_FOLDER, TrialStore, read_table
from loam_gtsam.studies.trials import (
    COLUMNS,
    NOT_REPEATABLE,
    Row,
    Trial,
    empty_row,
    run_trial,
    versions,
)
from loam_gtsam.types import BadSweep, ConfigError, FrameStatus, MapUpdate

PAGE = Path(__file__).resolve().parents[2] / "docs" / "parameter_studies.md"
WORLD = "sim:room?frames=24&columns=300&speed=5"
SPEC = f"""
sequences:
  room: {WORLD}
configs:
  gtsam: gtsam
  few: {{set: {{solver.iterations: 2}}}}
seeds: [0, 1]
frames: 4
"""


def trial_of(path: str = WORLD, **changes: Any) -> Trial:
    return replace(Trial("here", "this", path, {}, None, None, Config()), **changes)


def write_spec(folder: Path, text: str) -> Path:
    file = folder / "spec.yaml"
    file.write_text(text)
    return file


def study(*arguments: object) -> Result:
    return loam("study", *arguments)


def one_line(result: Result) -> str:
    return " ".join(result.output.split())


def repeatable(rows: list[Row]) -> list[Row]:
    return [{k: v for k, v in row.items() if k not in NOT_REPEATABLE} for row in rows]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


# -- the specification -------------------------------------------------------------------------


def test_trials_are_sequences_times_configs_times_seeds_in_this_order(tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "preset: aloam\nsolver: {iterations: 7}\nmap: {cube_size: 2.5e1}\n"
    )
    spec = load_spec(
        write_spec(
            tmp_path,
            """
            sequences:
              room: sim:room
              drive: {path: data/drive, frames: null, options: {topic: /points}}
            configs:
              mine: {solver: mine.yaml, set: {map.window: [11, 11, 5]}}
              kiss: kiss-icp
            seeds: [3, 1]
            frames: 9
            metrics: [rpe_percent, ms_median]
            """,
        )
    )
    found = [(t.sequence, t.config_name, t.seed, t.frames, t.peer) for t in spec.trials]
    assert found == [
        ("room", "mine", 3, 9, None),
        ("room", "mine", 1, 9, None),
        ("room", "kiss", 3, 9, "kiss-icp"),
        ("room", "kiss", 1, 9, "kiss-icp"),
        ("drive", "mine", None, None, None),
        ("drive", "kiss", None, None, "kiss-icp"),
    ]
    assert spec.metrics == ("rpe_percent", "ms_median")
    config = spec.trials[0].config
    assert (config.solver.method, config.solver.iterations) == ("aloam", 7)
    assert (config.map.window, config.map.cube_size) == ((11, 11, 5), 25.0)
    sent = pickle.loads(pickle.dumps(spec.trials[0]))  # as it is sent to a worker
    assert (sent, sent.id) == (spec.trials[0], spec.trials[0].id)
    drive = spec.trials[-1]
    assert drive.path == str(tmp_path / "data/drive")
    assert drive.dataset_options == {"topic": "/points"}
    assert spec.trials[0].dataset_options == {"seed": 3}


def test_what_a_sequence_sets_holds_for_every_estimator_on_it(tmp_path):
    text = """
    sequences: {a: {path: x, set: {sensor.model: vlp16}}, b: y}
    configs: {aloam: aloam, kiss: kiss-icp}
    """
    trials = load_spec(write_spec(tmp_path, text)).trials
    default = Config().sensor.model
    assert [t.config.sensor.model for t in trials] == ["vlp16", "vlp16", default, default]
    assert trials[0].config.solver == preset("aloam").solver


@pytest.mark.parametrize(
    ("address", "seed"), [("sim:room", 0), ("sim:room?seed=4", 4), ("folder", None)]
)
def test_without_seeds_a_world_has_its_own(tmp_path, address, seed):
    text = f"sequences: {{a: '{address}'}}\nconfigs: {{c: gtsam}}"
    assert [t.seed for t in load_spec(write_spec(tmp_path, text)).trials] == [seed]


ROOM = "sequences: {a: sim:room}\n"
GTSAM = "configs: {c: gtsam}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a mapping"),
        ("a: {", "not valid YAML"),
        ("a: !!python/name:os.system x", "not valid YAML"),
        (ROOM, "configs: expected at least one"),
        (GTSAM, "sequences: expected at least one"),
        (ROOM + GTSAM + "sede: [1]", "unknown key 'sede' (known: sequences, configs"),
        (ROOM + "configs: {c: gtsm}", "configs.c: unknown solver 'gtsm'"),
        (ROOM + "configs: {c: absent.yaml}", "absent.yaml: cannot read"),
        (ROOM + "configs: {c: {preset: loam}}", "configs.c: unknown key 'preset'"),
        (ROOM + "configs: {c: {set: {solver.iteratons: 3}}}", "did you mean 'iterations'"),
        (ROOM + "configs: {c: {set: {solver: 3}}}", "configs.c.set: expected SECTION.KEY"),
        (ROOM + "configs: {c: {set: 3}}", "configs.c.set: expected a mapping"),
        (ROOM + "configs: {c: {solver: kiss-icp, set: {solver.iterations: 3}}}", "is a peer"),
        (ROOM + "configs: {c: {solver: 3}}", "configs.c.solver: expected a name"),
        (ROOM + "configs: {1: gtsam}", "expected names as keys, got 1"),
        (GTSAM + "sequences: {a: {frames: 3}}", "sequences.a: expected a path"),
        (GTSAM + "sequences: {a: {path: x, frames: 0}}", "sequences.a.frames: expected"),
        (GTSAM + "sequences: {a: {path: x, set: {map.windw: 0}}}", "sequences.a.set: unknown key"),
        (GTSAM + "sequences: {a: 'sim:room?seed=x'}", "sequences.a: seed: expected an integer"),
        (ROOM + GTSAM + "seeds: 3", "seeds: expected a list"),
        (ROOM + GTSAM + "seeds: [1, 1]", "seeds: expected a list of different"),
        (ROOM + GTSAM + "seeds: [-1]", "seeds: expected a list"),
        (GTSAM + "sequences: {a: x}\nseeds: [1]", "only built-in worlds"),
        (GTSAM + "sequences: {a: 'sim:room?seed=2'}\nseeds: [1]", "a seed of its own"),
        (ROOM + GTSAM + "metrics: [ate]", "metrics: expected a list of ate_m"),
        (ROOM + GTSAM + "frames: many", "frames: expected a number"),
    ],
)
def test_a_wrong_specification_is_told_by_key(tmp_path, text, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        load_spec(write_spec(tmp_path, text))


def test_a_specification_that_is_not_there_is_told():
    result = study("absent.yaml")
    assert result.exit_code == 1
    assert "absent.yaml: cannot read" in result.output


def test_the_id_depends_on_what_decides_the_result_and_on_no_name():
    trial = trial_of()
    assert trial.id == trial_of(sequence="there", config_name="that").id
    changes = (
        {"path": "sim:trees"},
        {"options": {"dropout": 0.1}},
        {"frames": 3},
        {"seed": 0},
        {"config": preset("loam")},
        {"peer": "kiss-icp"},
    )
    others = [trial_of(**change) for change in changes]
    assert len({t.id for t in [trial, *others]}) == len(changes) + 1
    assert len({t.config_hash for t in [trial, *others]}) == 3


# -- one trial ---------------------------------------------------------------------------------


def test_a_row_has_the_numbers_of_the_run():
    row = run_trial(trial_of(seed=2, options={"dropout": 0.1}))
    assert list(row) == list(COLUMNS)
    world = SimulatedWorld("room", frames=24, columns=300, speed=5, seed=2, dropout=0.1)
    result = run(world)
    truth, found = world.truth, result.trajectory
    absolute, relative = absolute_error(found, truth), relative_error(found, truth)
    assert row["error"] is row["problem"] is row["peer"] is None
    assert row["ate_m"] == absolute.rmse
    assert row["rotation_deg"] == absolute.rotation_rmse_deg
    assert row["rpe_percent"] == relative.translation_percent
    assert row["rpe_shortest_m"] == relative.lengths[0]
    apart = pose_differences(found, truth)[1][-1]
    assert row["drift_percent"] == pytest.approx(100.0 * apart / truth.path_length, rel=1e-9)
    assert row["frames"] == 24
    counts = {str(s): row[f"frames_{s}"] for s in FrameStatus if row[f"frames_{s}"]}
    assert counts == result.status_counts
    assert row["map_points"] == len(result.edge_points) + len(result.plane_points)
    assert {name: row[name] for name in versions()} == versions()
    assert 0.0 < row["ms_median"] < 1e3 * row["wall_s"]


def test_loops_correct_the_poses_that_are_scored():
    """The updates of a run with loops are odometry; its trajectory is corrected."""
    truth = SimulatedWorld("room", frames=5, speed=5).truth
    wrong = [MapUpdate(int(stamp), gtsam.Pose3(), FrameStatus.OK) for stamp in truth.stamps]
    bad = MapUpdate(0, gtsam.Pose3(), FrameStatus.BAD_STAMP)
    graph = SimpleNamespace(trajectory=lambda updates: truth)
    none = np.zeros((0, 3))
    updates = (*wrong[:2], bad, *wrong[2:])
    loops = SimpleNamespace(graph=graph)
    result = RunResult(Config(), updates, none, none, {}, interrupted=False, loops=loops)
    found = SolverRun.of_result("x", result)
    np.testing.assert_allclose(found.trajectory.map_T_lidar, truth.map_T_lidar, atol=1e-12)
    assert found.updates[2] is bad


class NoTruth(SimulatedWorld):
    truth = None


class Broken(ListDataset):
    def __init__(self):
        super().__init__([RuntimeError("oops")])


@pytest.mark.parametrize(
    ("dataset", "error"),
    [
        (Broken, "RuntimeError: oops"),
        (lambda: ListDataset([]), "no sweeps in it"),
        (lambda: ListDataset([BadSweep(n, f"damaged {n}") for n in range(3)]), "damaged 0"),
    ],
)
def test_what_goes_wrong_in_a_trial_is_in_its_row(monkeypatch, dataset, error):
    monkeypatch.setattr("loam_gtsam.datasets.open_dataset", lambda *a, **k: dataset())
    row = run_trial(trial_of())
    assert error in row["error"]
    assert row["wall_s"] >= 0.0


@pytest.mark.parametrize(
    ("trial", "error"),
    [
        (trial_of("nowhere"), "DatasetError: nowhere: no such file"),
        (trial_of(options={"fames": 3}), "takes no option fames"),
        (trial_of(peer="no-such-peer"), "PeerError: unknown peer"),
    ],
)
def test_what_keeps_a_trial_from_starting_is_in_its_row(trial, error):
    assert error in run_trial(trial)["error"]


def test_without_truth_there_are_no_errors_and_the_row_says_why(monkeypatch):
    world = NoTruth("room", frames=3, columns=300)
    monkeypatch.setattr("loam_gtsam.datasets.open_dataset", lambda *a, **k: world)
    row = run_trial(trial_of())
    assert (row["error"], row["problem"]) == (None, "no truth")
    assert row["ate_m"] is row["rpe_percent"] is row["drift_percent"] is None
    assert row["ms_median"] > 0.0


def test_a_peer_gets_the_sweeps_and_the_sensor(monkeypatch):
    seen = []

    class Still:
        name, package, map_points = "still", "numpy", 7

        def register(self, stamp, sweep):
            seen.append(sweep.points.shape[0])
            return SimpleNamespace(stamp=stamp, map_T_lidar=np.eye(4), seconds=0.001)

    monkeypatch.setattr(trials, "make_peer", lambda name: Still())
    near = Config().sensor.changed(max_range=3.0)
    rows = [
        run_trial(trial_of(peer="still", frames=5, config=config))
        for config in (Config(), Config(sensor=near))
    ]
    assert [row["frames_ok"] for row in rows] == [5, 5]
    assert rows[0]["ate_m"] > 0.0
    assert rows[0]["peer_version"] == f"numpy {np.__version__}"
    assert (rows[0]["map_points"], rows[0]["matches"]) == (7, None)
    assert sum(seen[5:]) < sum(seen[:5])


def test_a_peer_that_fails_in_the_middle_is_an_error(monkeypatch):
    class Failing:
        name, package, map_points = "failing", "numpy", 0

        def register(self, stamp, sweep):
            raise RuntimeError("out of patience")

    monkeypatch.setattr(trials, "make_peer", lambda name: Failing())
    assert "out of patience" in run_trial(trial_of(peer="failing", frames=3))["error"]


def test_a_trial_that_is_stopped_is_no_row():
    def stop(number: int, update: MapUpdate) -> None:
        raise KeyboardInterrupt

    for peer in (None, "small-gicp"):
        if peer is not None:
            pytest.importorskip("small_gicp")
        with pytest.raises(KeyboardInterrupt):
            run_trial(trial_of(peer=peer), stop)


# -- resuming ----------------------------------------------------------------------------------


def test_a_stored_trial_comes_back_as_it_was_with_its_names_of_today(tmp_path):
    (tmp_path / TRIALS_FOLDER).mkdir()
    store, trial = TrialStore(tmp_path), trial_of(seed=1)
    row = empty_row(trial) | {"ate_m": 0.1 + 0.2, "frames": 3}
    assert store.load(trial) is None
    store.save(row)
    assert store.load(trial) == row
    renamed = store.load(replace(trial, sequence="new", config_name="too"))
    assert renamed == row | {"sequence": "new", "config": "too"}
    assert store.load(replace(trial, frames=2)) is None


@pytest.mark.parametrize("change", [{"numpy_version": "1.0"}, {"trial": "x"}, {"new": 1}, None])
def test_a_trial_of_another_version_or_a_damaged_file_counts_as_none(tmp_path, change):
    (tmp_path / TRIALS_FOLDER).mkdir()
    store, trial = TrialStore(tmp_path), trial_of()
    store.save(empty_row(trial))
    file = next((tmp_path / TRIALS_FOLDER).iterdir())
    text = file.read_text()
    file.write_text(text[:-9] if change is None else json.dumps(json.loads(text) | change))
    assert store.load(trial) is None
    store.save(empty_row(trial))
    assert store.load(trial) is not None


@pytest.fixture
def quick(monkeypatch) -> list[Trial]:
    """Trials take no time; gives the list of those that were run."""
    ran: list[Trial] = []

    def pretend(trial: Trial, on_frame: object = None) -> Row:
        ran.append(trial)
        error = "it broke\nDatasetError: on [red]purpose[/red]" if trial.seed == 13 else None
        return empty_row(trial) | {"ate_m": 1.0 + len(ran), "wall_s": 0.0, "error": error}

    monkeypatch.setattr(trial_runner, "run_trial", pretend)
    return ran


def test_only_what_is_missing_or_has_changed_is_run_again(tmp_path, quick):
    file = write_spec(tmp_path, SPEC)
    assert study(file, "--output", "out").exit_code == 0
    assert len(quick) == 4
    assert study(file, "--output", "out").exit_code == 0
    assert len(quick) == 4
    write_spec(tmp_path, SPEC.replace("seeds: [0, 1]", "seeds: [0, 1, 2]"))
    study(file, "--output", "out")
    assert [t.seed for t in quick[4:]] == [2, 2]
    write_spec(tmp_path, SPEC.replace("solver.iterations: 2", "solver.iterations: 3"))
    study(file, "--output", "out")
    assert [(t.config_name, t.seed) for t in quick[6:]] == [("few", 0), ("few", 1)]
    assert study(file, "--output", "out", "--overwrite").exit_code == 0
    assert len(quick) == 12
    rows, configs = read_table(Path("out") / TABLE_FILE)
    assert [row["ate_m"] for row in rows] == [10.0, 11.0, 12.0, 13.0]
    assert configs[rows[2]["config_hash"]]["solver"]["iterations"] == 3


def test_one_configuration_under_two_names_runs_once_and_has_two_rows(tmp_path, quick):
    text = "sequences: {a: sim:room}\nconfigs: {one: gtsam, two: {set: {map.cube_size: 50.0}}}"
    assert Config().map.cube_size == 50.0
    assert study(write_spec(tmp_path, text), "--output", "out").exit_code == 0
    assert len(quick) == 1
    rows, _ = read_table(Path("out") / TABLE_FILE)
    assert [row["config"] for row in rows] == ["one", "two"]
    assert len({row["trial"] for row in rows}) == 1


def test_failed_trials_are_rows_and_run_again_only_when_asked(tmp_path, quick):
    file = write_spec(tmp_path, SPEC.replace("[0, 1]", "[13, 1]"))
    for arguments, runs in (([], 4), ([], 4), (["--retry-failed"], 6)):
        result = study(file, "--output", "out", *arguments)
        assert result.exit_code == 1
        assert len(quick) == runs
        assert "4 of 4 trials done, 2 of them failed" in result.output
        assert "room x few, seed 13 failed: DatasetError: on [red]purpose[/red]" in result.output
    rows, _ = read_table(Path("out") / TABLE_FILE)
    assert [bool(row["error"]) for row in rows] == [True, False, True, False]
    assert "it broke" in rows[0]["error"]


def test_the_table_at_the_end_shows_medians_of_what_did_not_fail(tmp_path, quick):
    text = SPEC.replace("[0, 1]", "[0, 1, 2, 13]") + "metrics: [ate_m, rpe_percent]"
    result = study(write_spec(tmp_path, text))
    assert re.search(r"ate_m\s+sequence\s+gtsam\s+few\s+room\s+3\s+7\s", result.output)
    assert re.search(r"rpe_percent\s+sequence\s+gtsam\s+few\s+room\s+-\s+-\s", result.output)
    assert "Written to loam_gtsam_output/spec_study/results.parquet" in one_line(result)
    assert study("spec.yaml", "--quiet").output == ""


def test_wrong_options_and_missing_packages_are_told(tmp_path, monkeypatch):
    file = write_spec(tmp_path, SPEC)
    assert study(file, "--workers", 2, "--scheduler", "tcp://x:1").exit_code == 2
    result = study(file, "--scheduler", "nonsense")
    assert result.exit_code == 1
    assert "--scheduler nonsense: cannot reach a Dask scheduler" in one_line(result)
    for module, arguments in (("distributed", ("--scheduler", "tcp://x:1")), ("pyarrow", ())):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, module, None)
            result = study(file, *arguments)
        assert result.exit_code == 1
        assert 'pip install "loam_gtsam[cluster]"' in one_line(result)


# -- real runs ---------------------------------------------------------------------------------


def test_a_signal_keeps_what_is_finished_and_the_next_call_goes_on(tmp_path, monkeypatch):
    scans = list(SimulatedWorld("room", frames=4, columns=300))
    opened = []

    class Interrupting(ListDataset):
        def __iter__(self) -> Iterator[Any]:
            for number, scan in enumerate(super().__iter__()):
                if len(opened) == 2 and number == 1:
                    os.kill(os.getpid(), signal.SIGINT)
                yield scan

    def open_dataset(*arguments: Any, **options: Any) -> ListDataset:
        opened.append(options)
        return Interrupting(scans)

    monkeypatch.setattr("loam_gtsam.datasets.open_dataset", open_dataset)
    file = write_spec(tmp_path, SPEC)
    result = study(file, "--output", "out")
    assert result.exit_code == 130, result.output
    assert "1 of 4 trials done, 0 of them failed Stopped;" in one_line(result)
    rows, _ = read_table(Path("out") / TABLE_FILE)
    assert [(row["config"], row["seed"]) for row in rows] == [("gtsam", 0)]
    assert study(file, "--output", "out").exit_code == 0
    assert [entry["seed"] for entry in opened] == [0, 1, 1, 0, 1]
    assert len(read_table(Path("out") / TABLE_FILE)[0]) == 4


def test_a_stop_between_two_trials_starts_no_other(quick):
    with pytest.raises(KeyboardInterrupt):
        list(trial_runner.run_here([trial_of()], lambda: True))
    assert quick == []


def test_the_page_explains_every_column_and_its_example_can_be_read(tmp_path):
    text = PAGE.read_text("utf-8")
    assert [name for name in COLUMNS if f"`{name}`" not in text] == []
    spec = re.search(r"^```yaml\n(.*?)^```", text, re.M | re.S)
    (tmp_path / "robot.yaml").write_text("preset: loam\n")
    trials = load_spec(write_spec(tmp_path, spec[1])).trials
    assert len(trials) > 10


def test_the_pandas_of_the_page_works(tmp_path, quick, capsys):
    pytest.importorskip("pandas")
    study(write_spec(tmp_path, SPEC), "--output", "results")
    code = re.search(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
    exec(compile(code[1], "block", "exec"), {})
    assert "gtsam" in capsys.readouterr().out


# -- on several workers ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A Dask cluster of two worker processes with one thread each."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        memory_limit=0,
        dashboard_address=None,
        silence_logs=logging.ERROR,
    ) as cluster:
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


@pytest.mark.parametrize("where", ["local", "cluster"])
def test_the_death_of_a_worker_in_the_middle_changes_no_number(where, request, tmp_path):
    trials = load_spec(write_spec(tmp_path, SPEC)).trials
    here = list(trial_runner.run_here(trials, never))
    flag = tmp_path / "died"
    work = partial(dies, trials[1].id, str(flag))
    if where == "local":
        workers = trial_runner.local_workers(2)
    else:
        address = request.getfixturevalue("cluster").scheduler_address
        workers = trial_runner.cluster_workers(address)
    with workers as pool:
        rows = list(trial_runner.run_on(pool, trials, never, work))
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
        rows = list(trial_runner.run_on(pool, trials, never, partial(dies, trials[0].id, "")))
    errors = {row["trial"]: row["error"] for row in rows}
    assert errors.pop(trials[0].id).startswith(("KilledWorker: ", "BrokenProcessPool: "))
    assert set(errors.values()) == {None}
    assert len(errors) == 3


def test_the_table_is_the_same_here_in_two_processes_and_on_a_cluster(cluster, tmp_path):
    file = write_spec(tmp_path, SPEC)
    places = ((), ("--workers", 2), ("--scheduler", cluster.scheduler_address))
    tables = []
    for number, place in enumerate(places):
        result = study(file, "--output", f"out{number}", *place)
        assert result.exit_code == 0, result.output
        tables.append(repeatable(read_table(Path(f"out{number}") / TABLE_FILE)[0]))
    assert tables[0] == tables[1] == tables[2]
    assert [(row["config"], row["seed"]) for row in tables[0]] == [
        ("gtsam", 0), ("gtsam", 1), ("few", 0), ("few", 1),
    ]  # fmt: skip
    assert tables[0][0]["ate_m"] is not None


def test_a_stop_ends_the_wait_for_workers_and_the_workers(tmp_path):
    trials = load_spec(write_spec(tmp_path, SPEC)).trials
    before = set(multiprocessing.active_children())
    rows: list[Row] = []

    def run_until_stopped() -> None:
        with trial_runner.local_workers(2) as pool:
            for row in trial_runner.run_on(pool, trials, lambda: bool(rows)):
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


def test_dask_is_imported_only_where_it_is_needed():
    code = """
import sys
import loam_gtsam.cli.study, loam_gtsam.cli.app
print([name for name in ("dask", "distributed", "pyarrow") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
