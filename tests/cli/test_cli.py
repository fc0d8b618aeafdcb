"""The command line: what it writes, says and returns, above all when something is wrong."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.cli import loam
from support.list_dataset import ListDataset
from support.quick import QUICK_START, begin_quickly

from loam_gtsam.cli import report
from loam_gtsam.cli import run as run_command
from loam_gtsam.cli.console import stop_requests
from loam_gtsam.cli.refine import FinishedRun
from loam_gtsam.cli.report import where_it_turns
from loam_gtsam.cli.results import BASE_FILES, ERROR_PLOT, PLOT_FILES
from loam_gtsam.config import Config, load_config
from loam_gtsam.datasets import open_dataset
from loam_gtsam.datasets.base import DatasetInfo, PartOf
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.datasets.truth import read_truth
from loam_gtsam.io.read_run import read_updates
from loam_gtsam.io.version import installed_version
from loam_gtsam.loops.files import read_graph
from loam_gtsam.maps.map_file import SavedMap
from loam_gtsam.refine.rounds import Settings
from loam_gtsam.refine.runs import refine_run, run_points
from loam_gtsam.types import BadSweep, DatasetError, ImuSamples, Scan, Trajectory
from loam_gtsam.view import plots as visualization

FRAMES = 4
DAMAGED = [BadSweep(n, f"damaged {n}") for n in range(9)]


@pytest.fixture(autouse=True)
def _wide_screen_in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")


class FakeDataset(ListDataset):
    """Its names look like markup."""

    name = "fake [bold]data[/bold]"

    def info(self):
        return DatasetInfo("fake", "nowhere", {"fields": "x [y] z"}, ["a [red]small[/red] problem"])


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    return list(SimulatedWorld("room", frames=FRAMES, columns=450))


@pytest.fixture
def opens(monkeypatch):
    """Make every path open as a list of sweeps."""

    def patch(items):
        monkeypatch.setattr("loam_gtsam.datasets.open_dataset", lambda *a, **k: FakeDataset(items))

    return patch


def said(*arguments: object, code: int = 0) -> str:
    """What a command says, as one line."""
    result = loam(*arguments)
    assert result.exit_code == code, result.output
    return " ".join(result.output.split())


def mapped(*more: object, code: int = 0) -> str:
    """What ``run`` says of whatever opens; its results are in the folder out."""
    return said("run", "x", "--no-plot", "--output", "out", *QUICK_START, *more, code=code)


def summary_in(folder: Path | str) -> dict[str, Any]:
    return json.loads((Path(folder) / "summary.json").read_text())


def files_in(folder: Path | str) -> set[str]:
    return {path.name for path in Path(folder).iterdir()}


def test_demo_writes_everything_and_says_how_accurate_it_is():
    text = said("demo", "--scene", "room", "--frames", FRAMES, "--profile")
    folder = Path("loam_gtsam_output/room_vlp16")
    plots = {*PLOT_FILES, ERROR_PLOT} if visualization.available() else set()
    assert files_in(folder) == {*BASE_FILES, "truth.tum", "truth_matched.tum"} | plots
    accuracy = summary_in(folder)["accuracy"]
    assert accuracy["compared_poses"] == FRAMES
    assert accuracy["ate_rmse_m"] < 0.05
    for word in (f"ATE {accuracy['ate_rmse_m']:.3f} m", str(folder), "features", "match", "median",
                 "95 %", "share", "loam-gtsam run PATH"):  # fmt: skip
        assert word in text


def test_run_opens_built_in_worlds_and_uses_every_option():
    Path("mine.yaml").write_text("solver: {iterations: 3, min_matches: 20}\n")
    said(
        "run", "sim:room?frames=9&columns=450", "--frames", 3, "--output", "out", "--no-plot",
        "--config", "mine.yaml", "--sensor", "vlp16", "--set", "solver.iterations=7", *QUICK_START,
        "--set", "map.window=[11, 11, 5]", "--set", "deskew.enabled=false", "--option", "seed=3",
    )  # fmt: skip
    assert files_in("out") == {*BASE_FILES, "truth.tum", "truth_matched.tum"}
    config = load_config("out/config.yaml")
    assert config.sensor.model == "vlp16"
    assert (config.solver.iterations, config.solver.min_matches) == (7, 20)
    assert (config.map.window, config.deskew.enabled) == ((11, 11, 5), False)
    assert len(read_tum("out/trajectory.tum")) == 3
    assert summary_in("out")["input"]["facts"]["seed"] == "3"


def test_a_process_extracts_features_where_it_is_worth_its_start(monkeypatch):
    for asked, sweeps, cores, expected in (
        (None, 200, 2, 0), (None, 201, 2, 1), (None, 201, 1, 0), (0, 900, 2, 0), (3, 2, 1, 3)
    ):  # fmt: skip
        monkeypatch.setattr(run_command.os, "cpu_count", lambda count=cores: count)
        assert run_command.worker_count(asked, sweeps) == expected


def test_an_earlier_run_is_kept_unless_overwrite_is_given(opens, scans):
    opens(scans[:2])
    Path("out").mkdir()
    Path("out/notes.md").write_text("mine")
    for folder in ("out", "out-2", "out-3"):
        assert f"Written to {folder}: " in mapped()
    Path("out/trajectory.png").write_text("of the earlier run")
    opens(scans[:3])
    mapped("--overwrite")
    assert (len(read_tum("out/trajectory.tum")), len(read_tum("out-2/trajectory.tum"))) == (3, 2)
    assert files_in("out") == {*BASE_FILES, "notes.md"}
    assert not Path("out-4").exists()


def test_text_of_the_data_is_never_taken_for_markup_and_quiet_prints_nothing(opens, scans):
    opens(scans[:2])
    assert mapped("--quiet") == ""
    assert "summary.json" in files_in("out")
    assert "fake [bold]data[/bold]" in mapped()
    text = said("inspect", "x", *QUICK_START)
    assert "x [y] z" in text
    assert "a [red]small[/red] problem" in text


def test_inspect_tells_sweeps_that_cannot_be_used(opens, scans):
    opens([*scans[:3], BadSweep(scans[2].stamp + 10**8, "damaged")])
    text = said("inspect", "x", *QUICK_START)
    assert "1 of 4 sweeps: 1 unusable_scan, the first: damaged" in text


def test_odd_frames_are_counted_and_only_the_first_few_told(opens, scans):
    opens(
        [*scans[:3], *[BadSweep(scans[2].stamp + n * 10**8, f"damaged {n}") for n in range(1, 7)]]
    )
    text = mapped()
    assert "1 first, 2 ok, 6 unusable_scan" in text
    assert [n for n in range(1, 7) if f"damaged {n}" in text] == [1, 2, 3]
    assert "and 3 more" in text
    with np.load("out/run.npz") as data:
        assert data["messages"][-1] == "damaged 6"


def test_poses_that_no_scan_fixes_are_told_in_one_line():
    text = said(
        "run", "sim:room?frames=3&columns=300", "--output", "room", "--no-plot", *QUICK_START
    )
    assert "not fixed" not in text
    assert "weakly constrained" not in text
    assert "positions told to 0.0" in text
    assert "positions are told to" not in text
    text = said(
        "run", "sim:open_field?frames=4&columns=300", "--output", "field", "--no-plot", *QUICK_START
    )
    told = "DO NOT TRUST THIS RUN: 3 of 4 poses (75 %) are not fixed by their scans (3 degenerate)"
    assert f"{told}, first that of frame 1; a sensor that the run does without" in text
    assert "weakly constrained: x, y, rz (3 directions)" in text
    assert "positions are told to" in text
    assert "rz in 3 frames, x in 3 frames, y in 3 frames (axes of the lidar)" in text


def test_poses_that_still_moved_when_the_iterations_ended_are_no_reason_to_distrust():
    spec = "sim:street_loop?frames=12&columns=450"
    text = said("run", spec, "--output", "out", "--no-plot", "--set", "solver.iterations=1")
    assert "not_converged" in text
    assert "poses still moved when solver.iterations ended" in text
    assert "DO NOT TRUST" not in text


def test_a_few_odd_frames_leave_a_run_in_trust(opens):
    world = SimulatedWorld("room", frames=21, columns=200)
    opens([*world, BadSweep(world[20].stamp + 10**8, "damaged")])
    text = mapped()
    assert "1 of 22 poses (5 %) are not fixed by their scans (1 unusable_scan)" in text
    assert "DO NOT TRUST" not in text


@pytest.mark.parametrize(
    ("items", "message", "written"),
    [
        (DAMAGED[:3], "none of the 3 sweeps could be used; the first: damaged 0", True),
        ([], "no sweeps", False),
        ([DatasetError("the bag is damaged")], "error: the bag is damaged", False),
    ],
)
def test_a_run_without_a_usable_sweep_fails(opens, items, message, written):
    opens(items)
    assert message in mapped(code=1)
    assert Path("out/run.npz").exists() == Path("out").exists() == written


def test_a_truth_that_cannot_be_compared_is_told_and_costs_nothing(opens, scans, monkeypatch):
    opens(scans)
    first, last = scans[0].stamp, scans[-1].stamp
    for stamps, problem in (([1, 2, 3, 4], "3 or more poses"), ([first, first, last, last], "")):
        truth = Trajectory(np.array(stamps, np.int64), np.tile(np.eye(4), (4, 1, 1)))
        monkeypatch.setattr(FakeDataset, "truth", truth)
        assert problem in mapped("--overwrite")
        assert problem in summary_in("out")["accuracy"]["problem"]
        assert len(read_tum("out/trajectory.tum")) == len(scans)


def test_what_is_odd_about_the_input_is_told_after_a_run(opens, scans, monkeypatch):
    opens(scans[:1])
    assert "input: a [red]small[/red] problem" in mapped()

    def damaged(self):
        raise DatasetError("the index is gone")

    monkeypatch.setattr(FakeDataset, "info", damaged)
    assert "input: the index is gone" in mapped("--overwrite")
    assert files_in("out") == set(BASE_FILES)


@pytest.mark.parametrize("error", [DatasetError("the bag breaks off"), RuntimeError("oops")])
def test_an_error_in_the_middle_keeps_what_was_computed(opens, scans, error):
    opens([*scans[:3], error, scans[3]])
    result = loam("run", "x", "--no-plot", "--output", "out", *QUICK_START)
    assert result.exit_code == 1
    assert len(read_tum("out/trajectory.tum")) == 3
    assert str(error) in summary_in("out")["error"]
    if isinstance(error, DatasetError):
        assert "error: the bag breaks off" in result.output
    else:  # a mistake of ours keeps its traceback
        assert result.exception is error


def test_errors_are_one_message_and_debug_shows_the_traceback():
    text = said("run", "missing/folder", code=1)
    assert text.startswith("error: missing/folder: ")
    assert "Traceback" not in text
    assert isinstance(loam("run", "missing/folder", "--debug").exception, DatasetError)


def test_plots_without_matplotlib(opens, scans, monkeypatch):
    monkeypatch.setattr(visualization, "available", lambda: False)
    opens(scans[:1])
    assert "No pictures without matplotlib" in said("run", "x", "--output", "a")
    assert files_in("a") == set(BASE_FILES)
    assert "No pictures" not in mapped()
    assert 'pip install "loam_gtsam[plot]"' in said("run", "x", "--output", "b", "--plot", code=1)
    assert not Path("b").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--set", "solver.iteratons=3"], 1, "did you mean 'iterations'"),
        (["--set", "solver.iterations=many"], 1, "--set: solver.iterations: expected int"),
        (["--set", "solver=1"], 2, "expected SECTION.KEY=VALUE"),
        (["--set", "min_range=2"], 2, "SECTION.KEY=VALUE, for example sensor.min_range=2"),
        (["--set", "solver.iterations"], 2, "expected KEY=VALUE"),
        (["--set", "imu.gravity=2001-12-00"], 2, "is not a YAML value"),
        (["--option", "=1"], 2, "expected KEY=VALUE"),
        (["--option", "nonsense=1"], 1, "nonsense"),
        (["--sensor", "vlp17"], 1, "did you mean 'vlp16'"),
        (["--preset", "nothing"], 1, "unknown preset 'nothing'"),
        (["--config", "absent.yaml"], 1, "absent.yaml: cannot read"),
        (["--preset", "default", "--config", "x.yaml"], 2, "not both"),
        (["--frames", "0"], 2, "--frames"),
        (["--resume", "--bag", "x.mcap"], 2, "give one only"),
        (["--resume", "--rrd", "x.rrd"], 2, "give one only"),
        (["--resume", "--overwrite"], 2, "give one only"),
    ],
)
def test_wrong_options_say_what_was_expected(arguments, code, message):
    assert message in said("run", "sim:room", "--quiet", "--no-plot", *arguments, code=code)


@pytest.mark.parametrize(
    ("items", "code", "words"),
    [
        ([BadSweep(0, "damaged"), 0], 0, ("sweep 0: damaged", "sweep 1", "can be run")),
        (DAMAGED, 1, ("problem: sweeps 0, 1, 2, 3, 4: damaged 0", "cannot be run")),
        ([BadSweep(0, "cut"), BadSweep(1, "torn")], 1, ("sweep 0: cut", "sweep 1: torn")),
        ([Scan(np.full((50, 3), np.nan), 0)], 1, ("sweep of 50 points, 0 finite", "cannot be")),
        ([], 1, ("no sweeps", "cannot be run")),
    ],
)
def test_inspect_looks_past_bad_sweeps_and_fails_on_what_cannot_be_run(
    opens, scans, items, code, words
):
    opens([scans[item] if isinstance(item, int) else item for item in items])
    text = said("inspect", "x", code=code)
    assert all(word in text for word in words)
    assert "damaged 5" not in text


def test_config_prints_and_writes_what_can_be_loaded_and_replaces_no_file_unasked():
    printed = loam("config").output
    assert "# Every cube of the map has this edge length. Unit: m. Source: LOAM." in printed
    said("config", "--output", "c.yaml")
    assert Path("c.yaml").read_text() == printed
    assert load_config("c.yaml") == Config()
    Path("c.yaml").write_text("mine")
    assert "c.yaml: the file exists" in said("config", "--output", "c.yaml", code=1)
    assert Path("c.yaml").read_text() == "mine"
    said("config", "--output", "c.yaml", "--overwrite")
    assert Path("c.yaml").read_text() == printed


def test_version_names_what_matters_in_a_bug_report():
    lines = loam("--version").output.splitlines()
    assert [line.split()[0] for line in lines] == ["loam_gtsam", "gtsam", "numpy", "python"]


_ENDLESS = """
import itertools, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # as in a terminal
import loam_gtsam.datasets
from loam_gtsam.cli import main
from loam_gtsam.datasets.sim.world import SimulatedWorld

pause = float(sys.argv.pop())

class Endless(SimulatedWorld):
    def __iter__(self):
        first = next(iter(super().__iter__()))
        for number in itertools.count():
            if number == 3:
                print("ready", flush=True)
                time.sleep(pause)
            yield first.__class__(
                first.points, first.stamp + number * 10**8, first.times, first.rings, first.span
            )

loam_gtsam.datasets.open_dataset = lambda *a, **k: Endless("room", frames=1000, columns=450)
main()
"""


def start_endless_run(pause: float, workers: int = 0) -> subprocess.Popen[str]:
    """A run that goes on for ever; returns when it reads its fourth sweep, ``pause`` s long."""
    command = ["run", "x", "--output", "out", "--no-plot", *QUICK_START]
    command += ["--workers", str(workers), str(pause)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    start = [sys.executable, "-c", _ENDLESS, *command]
    process = subprocess.Popen(start, env=os.environ | {"COLUMNS": "300"}, **pipes)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize(("number", "workers"), [(signal.SIGTERM, 0), (signal.SIGINT, 1)])
def test_a_signal_stops_after_the_frame_and_everything_is_written(number, workers):
    process = start_endless_run(0.05, workers)
    process.send_signal(number)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + number, errors
    assert errors == ""
    frames = len(read_tum("out/trajectory.tum"))
    assert frames >= (1 if workers else 4)  # the fourth sweep may have been read ahead
    assert f"Stopped by {number.name} after frame {frames} of 1000" in output
    assert "To go on: the same command with --output out --resume" in output
    assert files_in("out") >= set(BASE_FILES)
    assert not [name for name in files_in("out") if name.endswith(".tmp")]
    summary = summary_in("out")
    assert (summary["interrupted"], summary["frames"]) == (True, frames)


def test_a_second_signal_ends_the_process_at_once():
    process = start_endless_run(pause=600.0)
    for _ in range(300):
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=0.1)
            break
    assert process.returncode == -signal.SIGINT
    assert not [path for path in Path("out").rglob("*") if path.is_file()]


@pytest.mark.parametrize("ignored", [False, True])
def test_a_signal_is_noted_unless_it_is_ignored_and_handlers_are_put_back(ignored):
    handler = signal.SIG_IGN if ignored else signal.default_int_handler
    before = signal.signal(signal.SIGINT, handler)
    try:
        with stop_requests() as stop:
            os.kill(os.getpid(), signal.SIGINT)
            assert stop.signum == (None if ignored else signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) == handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_run_says_what_was_made_of_the_imu():
    text = said("run", "sim:room?columns=450", "--frames", 3, "--no-plot", *QUICK_START)
    for part in (
        "IMU, level roll", "samples, at rest", "IMU, orientation its own", "mrad/s",
        "IMU, roll and pitch priors: 1 none, 2 equivalent", "IMU, de-skew 3 gyro",
    ):  # fmt: skip
        assert part in text
    assert "given up" not in text
    off = ["--set", "imu.coupling=off", "--output", "off"]
    assert "IMU" not in said(
        "run", "sim:room?columns=450", "--frames", 2, "--no-plot", *off, *QUICK_START
    )
    assert summary_in("off")["imu"] is None


def test_run_says_that_the_imu_is_mounted_otherwise():
    turned = ["--set", "imu.lidar_R_imu_deg=[180.0, 0.0, 0.0]"]
    text = said("run", "sim:shaken?columns=300", "--frames", 30, "--no-plot", *QUICK_START, *turned)
    assert "its gyro turned unlike the scans and was given up" in text
    assert re.search(r"fit those of the scans better by (179|180) degrees", text)


def test_inspect_names_an_imu_that_is_late(monkeypatch):
    """With the offset that is named there is nothing to say."""
    begin_quickly(monkeypatch)
    imu = SimulatedWorld("shaken", frames=60).imu
    late = replace(imu, stamps=imu.stamps + 100_000_000)
    monkeypatch.setattr(SimulatedWorld, "imu", late)
    text = said("inspect", "sim:shaken?columns=300&frames=30")
    assert re.search(r"its clock is (9[5-9]|10[0-5]) ms late", text)
    assert "30 sweeps mapped, from 0 s on" in text
    offset = ["--set", "imu.time_offset=-0.1"]
    told = said("inspect", "sim:shaken?columns=300&frames=30", *QUICK_START, *offset)
    assert "problem" not in told


def test_inspect_maps_where_the_lidar_turns():
    seconds = np.arange(-2.0, 60.0, 0.01)
    gyro = np.zeros((len(seconds), 3))
    assert where_it_turns(seconds, gyro, 5.0, 60.0) == 0.0
    gyro[(seconds > 14.0) & (seconds < 17.0)] = np.sin(np.arange(300.0))[:, None]
    assert 10.0 <= where_it_turns(seconds, gyro, 5.0, 60.0) <= 14.0
    assert 12.0 <= where_it_turns(seconds, gyro, 2.5, 60.0) <= 14.0  # a lidar of 20 Hz
    assert where_it_turns(seconds + 100.0, gyro, 5.0, 60.0) == 0.0  # it has no samples there
    assert where_it_turns(seconds, gyro, 5.0, 12.0) <= 7.0  # nor sweeps


def test_inspect_takes_the_rate_of_the_recording(monkeypatch):
    """At 5 Hz 50 sweeps are ten seconds: what turns in the ninth is reached from the start."""
    asked = []
    monkeypatch.setattr(
        report, "where_it_turns", lambda *a: asked.append(a[2:]) or where_it_turns(*a)
    )
    text = said("inspect", "sim:shaken?columns=300&frames=30", "--every", 2, *QUICK_START)
    assert asked == [(pytest.approx(10.0), pytest.approx(3.0))]
    assert "15 sweeps mapped, from 0 s on" in text


def test_inspect_shows_what_was_understood_of_sweeps_and_imu(opens, scans, monkeypatch):
    room = "sim:room?frames=3&columns=450"
    text = said("inspect", room, *QUICK_START)
    for part in ("simulated world", "16 rings from the ring field", "per-point times",
                 "samples at 200 Hz, orientation its own", "can be run"):  # fmt: skip
        assert part in text
    assert "IMU, used" not in said("inspect", room, *QUICK_START, "--set", "imu.coupling=off")
    opens(scans[:1])
    assert "IMU, used" not in said("inspect", "x", *QUICK_START)
    imu = SimulatedWorld("room", frames=2).imu
    broken = ImuSamples(imu.stamps, 3.0 * imu.orientation, imu.gyro, imu.acceleration)
    monkeypatch.setattr(FakeDataset, "imu", broken)
    assert "not of unit length" in said("inspect", "x", *QUICK_START)


def test_an_imu_on_another_clock_is_told(opens, scans, monkeypatch):
    opens(scans)
    imu = SimulatedWorld("room", frames=FRAMES).imu
    late = ImuSamples(imu.stamps + 3600 * 10**9, imu.orientation, imu.gyro, imu.acceleration)
    for samples, told in ((imu, False), (late, True)):
        monkeypatch.setattr(FakeDataset, "imu", samples)
        assert ("the clocks differ" in said("inspect", "x", *QUICK_START)) == told
        text = mapped("--overwrite")
        assert ("no orientation at 3 of 4 sweeps" in text) == told
        assert ("IMU, level unknown: no samples about the first sweep" in text) == told


def test_run_closes_loops_and_writes_the_graph():
    small = ["--set", "pose_graph.keyframe_distance=0.7", "--set", "loops.min_way=3"]
    drive = "sim:room?frames=30&columns=240&speed=4&start=moving"
    text = said("run", drive, "--loops", "--no-plot", *small, *QUICK_START)
    found = int(re.search(r"(\d+) of (\d+) found are used", text)[1])
    assert found >= 1
    folder = Path("loam_gtsam_output/room_vlp16")
    counts = summary_in(folder)["loops"]
    assert counts["on"] == found
    assert len(read_graph(folder / "pose_graph.g2o").loops) == counts["loops"]
    odometry, corrected = (read_tum(folder / f"{n}.tum") for n in ("odometry", "trajectory"))
    assert (odometry.map_T_lidar != corrected.map_T_lidar).any()
    said("optimize", folder / "pose_graph.g2o")


def test_resume_starts_goes_on_and_says_when_all_is_done(opens, scans):
    opens([*scans[:2], DatasetError("the disk was pulled out")])
    mapped("--resume", code=1)
    assert (Path("out") / run_command.CHECKPOINT).is_dir()
    opens(scans[:3])
    mapped("--resume")
    assert files_in("out") == set(BASE_FILES)
    assert len(read_tum("out/trajectory.tum")) == 3
    assert "out: complete, 3 sweeps" in mapped("--resume")
    assert not Path("out-2").exists()


@pytest.mark.parametrize("change", [["--frames", 2], ["--set", "solver.iterations=7"]])
def test_resume_does_not_take_another_run_for_its_own(opens, scans, change):
    opens(scans[:3])
    mapped()
    assert "out: holds the results of another run" in mapped("--resume", *change, code=1)


def test_resume_does_not_take_results_of_another_version_for_its_own(opens, scans):
    opens(scans[:3])
    mapped()
    summary = summary_in(Path("out")) | {"loam_gtsam": "0.0.1"}
    Path("out/summary.json").write_text(json.dumps(summary), encoding="utf-8")
    told = f"another run (by version 0.0.1, now {installed_version()})"
    assert told in mapped("--resume", code=1)


def test_resume_does_over_what_has_a_damaged_summary(opens, scans):
    opens(scans[:3])
    mapped()
    for damaged in ("[]", "{", "null"):
        Path("out/summary.json").write_text(damaged, encoding="utf-8")
        mapped("--resume")
        assert summary_in(Path("out"))["frames"] == 3


def test_a_checkpoint_is_not_run_over(opens, scans):
    opens([*scans[:2], DatasetError("the disk was pulled out")])
    mapped(code=1)
    for name in BASE_FILES:
        (Path("out") / name).unlink()
    opens(scans[:3])
    mapped()
    assert files_in("out-2") == set(BASE_FILES)
    mapped("--overwrite")
    assert files_in("out") == set(BASE_FILES)


def test_a_run_that_cannot_start_says_so_at_once_and_leaves_no_folder(opens):
    opens([RuntimeError("the run has begun")])
    Path("there.bag").write_text("x")
    problem = "there.bag/out: cannot make this output folder"
    assert problem in said("run", "x", "--output", "there.bag/out", code=1)
    said("run", "x", "--bag", "there.bag", code=1)
    assert not list(Path().glob("loam_gtsam_output/*"))
    Path("out").mkdir()
    mapped("--bag", "there.bag", code=1)
    assert Path("out").is_dir()


_HELP = """
import sys
from loam_gtsam.cli import main
try:
    main()
finally:
    print([name for name in ("gtsam", "numpy", "scipy") if name in sys.modules])
"""


@pytest.mark.parametrize("command", ["run", "compare", "study", "optimize"])
def test_the_help_of_a_command_imports_neither_gtsam_nor_scipy(command):
    call = [sys.executable, "-c", _HELP, command, "--help"]
    done = subprocess.run(call, capture_output=True, text=True)
    assert "--quiet" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]", done.stderr


def test_sweep_is_the_old_name_of_study_and_says_so_and_no_help_is_cut_off(monkeypatch):
    old, new = (loam(name, "missing.yaml") for name in ("sweep", "study"))
    assert old.exit_code == new.exit_code == 1
    assert "study" in old.stderr.splitlines()[0]
    assert old.stderr.splitlines()[1:] == new.stderr.splitlines()
    monkeypatch.setenv("COLUMNS", "80")
    commands = loam("--help").output.partition("Commands:")[2]
    assert "\n  sweep" not in commands
    assert "..." not in commands


def test_a_run_whose_ranges_look_too_long_is_refined_with_right_ones(monkeypatch) -> None:
    begin_quickly(monkeypatch)
    spec = "sim:street_loop?frames=45&columns=450"
    longer = "--set", "imu.coupling=off", "--set", "sensor.range_offset=-0.03"
    done = loam("run", spec, "--output", "out", "--no-plot", *longer)
    assert "the ranges look" in done.output
    loam("refine", spec, "out", "--rounds", "2", "--points", "1000", "--no-plot")
    summary = json.loads(Path("out/summary.json").read_text())
    report = json.loads(Path("out/refined/report.json").read_text())
    assert report["range_offsets_m"] == [summary["ranges"]["advised_offset_m"]]
    assert report["range_offsets_m"][0] == pytest.approx(0.0, abs=0.007)
    assert report["after"]["ate_rmse_m"] < 0.5 * summary["accuracy"]["ate_rmse_m"]


def test_a_run_whose_beams_disagree_writes_what_they_are_off_by(monkeypatch) -> None:
    begin_quickly(monkeypatch)
    spec = "sim:garage?frames=55&columns=450&seed=1&start=moving"
    wrong = [
        [float(2 * beam - 15), (0.015 if beam % 2 else -0.015), 0.0, 0.0] for beam in range(16)
    ]
    Path("wrong.yaml").write_text(json.dumps({"sensor": {"beams": wrong}}))
    alone = "--config", "wrong.yaml", "--set", "imu.coupling=off"
    done = loam("run", spec, "--output", "out", "--no-plot", *alone)
    assert "the beams of the lidar disagree, ranges by 1" in done.output
    found = load_config("out/beams.yaml").sensor.beams
    ranges = np.array(found)[:, 1]
    assert np.std(ranges) < 0.01  # of 15 mm
    refined = FinishedRun.read(Path("out"), open_dataset(spec))
    assert refined.config.sensor.beams == found


def test_a_run_is_refined_into_a_folder_of_its_own() -> None:
    spec = "sim:room?frames=12&columns=450"
    done = loam("run", spec, "--output", "out", "--refine", "--no-plot", "--quiet", *QUICK_START)
    assert done.exit_code == 0
    report = json.loads(Path("out/refined/report.json").read_text())
    assert report["frames"] == 12
    assert report["after"]["ate_rmse_m"] < 0.01
    lines = Path("out/refined/trajectory_covariance.csv").read_text().splitlines()
    assert len(lines) == 13
    assert [line.split(",")[1] for line in lines[1:3]] == ["first", "ok"]
    told = loam("refine", spec, "out", "--rounds", "1", "--points", "500")
    assert told.exit_code == 0
    assert report["range_offsets_m"] == [0.0]
    assert "thickness of common planes" in told.output
    assert Path("out/refined-2/section.png").stat().st_size > 1000
    for command in ("refine", "clean"):
        other = said(command, spec.replace("room", "trees"), "out", "--overwrite", code=1)
        assert "made of 'simulated world room', got 'simulated world trees'" in other
    missing = loam("refine", spec, "nothing")
    assert missing.exit_code == 1
    assert "expected the folder of a finished run" in missing.output


def test_odometry_back_to_places_visited_before_is_no_loop_for_refine() -> None:
    often = "pose_graph.keyframe_distance=1", "pose_graph.visits=1"
    spec = "sim:room?frames=160&columns=200&speed=3", "--every", "5"
    settings = [*QUICK_START, *(word for setting in often for word in ("--set", setting))]
    assert loam("run", *spec, "--output", "out", "--no-plot", "-q", *settings).exit_code == 0
    with SavedMap("out/map.lgmap") as saved:
        assert any(abs(link.later - link.earlier) > 1 for link in saved.graph.links)
    few = "--rounds", "1", "--points", "500"
    assert loam("refine", *spec, "out", *few, "--no-plot", "-q").exit_code == 0
    updates, config = read_updates("out"), load_config("out/config.yaml")
    points = run_points(PartOf(open_dataset(spec[0]), 0, 5), updates, config, most=500)
    alone = refine_run(points, updates, settings=Settings(rounds=1)).trajectory
    refined = read_truth("out/refined/trajectory.tum")
    np.testing.assert_allclose(refined.map_T_lidar, alone.map_T_lidar, atol=1e-8)
