"""The command ``compare``: tables, pictures, report, errors, signals."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
from pathlib import Path

import pytest
from support.cli import loam
from support.contenders import FakePeer
from support.quick import QUICK_START

from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.studies.comparison_report import PICTURES, REPORT_FILE, TABLE_FILES
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.studies.report_html import picture_html
from loam_gtsam.types import BadSweep, DatasetError, OutputError
from loam_gtsam.view import plots

FRAMES = 6
PLOTS = plots.available()


@pytest.fixture
def command(tmp_path, monkeypatch, dataset):
    """``compare`` on a list of sweeps, in an empty folder and a wide screen."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.setattr("loam_gtsam.datasets.open_dataset", lambda *a, **k: dataset)
    return lambda *arguments: loam("compare", "x", *QUICK_START, *arguments)


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_command_writes_tables_pictures_and_report(command, fake, world):
    result = command("--solver", "gtsam", "--peer", "fake", "--output", "out", "--set",
                     "solver.iterations=3")  # fmt: skip
    assert result.exit_code == 0, result.output
    names = {path.name for path in Path("out").iterdir()}
    poses = {f"{kind}_{name}.tum" for kind in ("trajectory", "truth_matched")
             for name in ("gtsam", "fake")}  # fmt: skip
    trajectories = poses | {"truth.tum"}
    assert names == {*TABLE_FILES, REPORT_FILE} | trajectories | set(PICTURES if PLOTS else ())
    table = rows("out/comparison.csv")
    assert [row["solver"] for row in table] == ["gtsam", "fake"]
    expected = absolute_error(read_tum("out/trajectory_gtsam.tum"), world.truth)
    assert float(table[0]["ate_m"]) == pytest.approx(expected.rmse, abs=1e-7)
    assert table[1]["iterations"] == ""
    summary = json.loads(Path("out/comparison.json").read_text())
    assert summary["reference"] == "truth"
    assert summary["solvers"][0]["scores"]["ate_m"] == pytest.approx(expected.rmse, abs=1e-7)
    assert summary["solvers"][0]["config"]["solver"]["iterations"] == 3
    assert summary["solvers"][1]["scores"]["iterations"] is None
    assert summary["solvers"][1]["difference_m"][2] > 1.0
    frames = rows("out/frames.csv")
    assert len(frames) == 2 * FRAMES
    assert {row["difference_m"] for row in frames if row["solver"] == "gtsam"} == {""}
    assert frames[FRAMES + 2]["x"] == "2"
    for text in ("ATE [m]", "fake", "Difference from gtsam", "errors against truth"):
        assert text in result.output


def test_one_frame_is_compared_without_errors(command):
    result = command("--solver", "gtsam", "--frames", "1", "--output", "out")
    assert result.exit_code == 0, result.output
    (row,) = rows("out/comparison.csv")
    assert row["ate_m"] == ""
    assert "expected" in row["problem"]


def test_report_is_one_file_with_everything_escaped(command, fake):
    assert command("--solver", "gtsam", "--peer", "fake", "--output", "out").exit_code == 0
    page = Path("out/report.html").read_text()
    assert "a &lt;b&gt;list&lt;/b&gt; [red]" in page
    assert "<b>list" not in page
    assert 'src="http' not in page
    assert "href" not in page
    assert page.count("data:image/png;base64,") == (4 if PLOTS else 0)
    assert len(re.findall("<tr>", page)) == 4 * 3  # four tables of two contenders
    assert len(re.findall('<tr class="group">', page)) == 4 * 2
    assert "Only the solver differs" in page
    assert 'class="best"' in page


def test_without_truth_the_first_solver_is_the_reference(command, dataset, fake):
    dataset.truth = None
    result = command("--solver", "gtsam", "--peer", "fake", "--no-plot", "--output", "out")
    assert result.exit_code == 0, result.output
    assert "errors against gtsam" in result.output
    ours, theirs = rows("out/comparison.csv")
    assert ours["ate_m"] == ""
    assert float(theirs["ate_m"]) > 0.0
    assert not {path.name for path in Path("out").iterdir()} & {"truth.tum", *PICTURES}


def test_an_earlier_comparison_is_kept_unless_told(command):
    arguments = ("--solver", "gtsam", "--frames", 2, "--no-plot")
    for folder in ("a_b_list_b_red_compare", "a_b_list_b_red_compare-2"):
        assert command(*arguments).exit_code == 0
        assert (Path("loam_gtsam_output") / folder / "report.html").is_file()
    left = Path("loam_gtsam_output/a_b_list_b_red_compare/trajectory_other.tum")
    left.write_text("of another solver")
    assert command(*arguments, "--overwrite").exit_code == 0
    assert not left.exists()
    assert len(list(Path("loam_gtsam_output").iterdir())) == 2


def test_an_error_on_the_way_leaves_what_was_computed(command, dataset):
    dataset.items = [*dataset.items[:3], DatasetError("the disk is gone")]
    result = command("--solver", "gtsam", "--no-plot", "--output", "out")
    assert result.exit_code == 1
    assert "the disk is gone" in result.output
    assert len(rows("out/frames.csv")) == 3
    assert "disk" in json.loads(Path("out/comparison.json").read_text())["error"]


def test_ctrl_c_ends_it_between_two_sweeps(command, dataset, fake, monkeypatch):
    real = FakePeer._register

    def interrupting(self, stamp, sweep):
        if len(self.updates) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return real(self, stamp, sweep)

    monkeypatch.setattr(FakePeer, "_register", interrupting)
    # A test run in the background inherits an ignored SIGINT, which the command respects.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        result = command("--peer", "fake", "--solver", "gtsam", "--no-plot", "--output", "out")
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.exit_code == 130, result.output
    assert "Stopped by SIGINT after frame 3 of 6" in result.output
    assert [row["frame"] for row in rows("out/frames.csv")] == ["0", "1", "2"] * 2
    assert json.loads(Path("out/comparison.json").read_text())["interrupted"] is True


def test_sweeps_nobody_can_use_are_an_error(command, dataset):
    dataset.items = [BadSweep(n, "torn") for n in range(3)]
    result = command("--solver", "gtsam", "--no-plot")
    assert result.exit_code == 1
    assert "no solver could use any of the 3 sweeps; the first: torn" in result.output


def test_a_picture_that_is_gone_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match=r"no\.png: cannot read the picture"):
        picture_html("x", tmp_path / "no.png")
