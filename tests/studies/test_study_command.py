"""The command ``study``: what runs again, the table, the summary, signals."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.cli import loam
from support.list_dataset import ListDataset
from support.trials import SPEC, write_spec
from typer.testing import Result

from loam_gtsam.config import Config
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.io.atomic import used_alone
from loam_gtsam.studies import trial_runner
from loam_gtsam.studies.trial_spec import load_spec
from loam_gtsam.studies.trials import TABLE_FILE, Row, Trial, empty_row, read_table, run_trial


def study(*arguments: object) -> Result:
    return loam("study", *arguments)


def one_line(result: Result) -> str:
    return " ".join(result.output.split())


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


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


def test_a_second_study_in_the_folder_of_one_that_runs_is_refused(tmp_path, quick):
    file = write_spec(tmp_path, SPEC)
    (tmp_path / "out").mkdir()
    with used_alone(tmp_path / "out"):
        result = study(file, "--output", "out")
        assert result.exit_code == 1
        assert "out: another run uses this folder" in one_line(result)
        assert not quick
    assert study(file, "--output", "out").exit_code == 0


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
    written = "Written to loam_gtsam_output/spec_study: results.parquet, report.html"
    assert written in one_line(result)
    page = Path("loam_gtsam_output/spec_study/report.html").read_text("utf-8")
    assert "<tr><td>room</td><td>3</td><td>7</td></tr>" in page
    assert "<h2>rpe_percent</h2>" in page
    assert "room x gtsam, seed 13" in page
    assert "on [red]purpose[/red]" in page
    assert study("spec.yaml", "--quiet").output == ""


def test_wrong_options_and_missing_packages_are_told(tmp_path, monkeypatch):
    file = write_spec(tmp_path, SPEC)
    assert study(file, "--workers", 2, "--scheduler", "tcp://x:1").exit_code == 2
    for arguments, message in (
        (("absent.yaml",), "absent.yaml: cannot read"),
        ((file, "--scheduler", "nonsense"), "--scheduler nonsense: cannot reach a Dask scheduler"),
    ):
        result = study(*arguments)
        assert result.exit_code == 1
        assert message in one_line(result)
    for module, arguments in (("distributed", ("--scheduler", "tcp://x:1")), ("pyarrow", ())):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, module, None)
            result = study(file, *arguments)
        assert result.exit_code == 1
        assert 'pip install "loam_gtsam[cluster]"' in one_line(result)


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
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
    file = write_spec(tmp_path, SPEC)
    result = study(file, "--output", "out")
    assert result.exit_code == 130, result.output
    assert "1 of 4 trials done, 0 of them failed Stopped;" in one_line(result)
    rows, _ = read_table(Path("out") / TABLE_FILE)
    assert [(row["config"], row["seed"]) for row in rows] == [("gtsam", 0)]
    assert study(file, "--output", "out").exit_code == 0
    assert [entry["seed"] for entry in opened] == [0, 1, 1, 0, 1]
    assert len(read_table(Path("out") / TABLE_FILE)[0]) == 4


def test_what_takes_long_to_import_is_imported_only_where_it_is_needed():
    code = """
import sys
import loam_gtsam.cli.study, loam_gtsam.cli.run
slow = "dask", "distributed", "pyarrow", "scipy.stats", "scipy.integrate", "matplotlib.figure"
print([name for name in slow if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_recordings_of_the_documentation_are_a_study(tmp_path, monkeypatch):
    """The 27 of the usual comparison, KITTI, MulRan and HeLiPR; nothing of it is there."""
    monkeypatch.setenv("LOAM_GTSAM_DATA", str(tmp_path))
    spec = load_spec(Path(__file__).resolve().parents[2] / "docs/study/recordings.yaml")
    names = list(dict.fromkeys(trial.sequence for trial in spec.trials))
    usual = [n for n in names if n.startswith(("NC20", "NC21", "Spires", "Hilti", "NTU"))]
    assert len(usual) == 27
    assert len([n for n in names if n.startswith("KITTI")]) == 11
    assert {n.split()[0] for n in names[38:]} == {"MulRan", "HeLiPR"}
    assert {Path(trial.path).is_relative_to(tmp_path) for trial in spec.trials} == {True}
    assert "no such" in run_trial(spec.trials[0])["error"]
