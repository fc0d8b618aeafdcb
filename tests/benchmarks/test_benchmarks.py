"""Each benchmark runs, writes its tables, and judges as it says; what is measured is in docs."""

from __future__ import annotations

import csv
import json
from collections import Counter
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from support.quick import begin_quickly

from benchmarks import __main__ as tool
from benchmarks import (
    cases,
    drawn,
    growth,
    history,
    loops,
    ouster,
    peers,
    recorded,
    refining,
    refining_growth,
    robustness,
    soak,
    soak_faults,
    worlds,
)
from benchmarks.cases import Case, CaseResult, PeerResult, judge
from benchmarks.growth_report import GrowthResult
from loam_gtsam.config import Config
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.types import FloatArray, FrameStatus, InputError, MapUpdate, SweepFault, Uncertainty

ROOM = Case("room", "sim:room?frames=6&columns=360", ate_limit=1.0, rivals=("KISS-ICP",))
ABSENT = Path("no such folder")
KINDS = "jsonl", "png"


class InProcess:
    """An executor that works at once and in this process: what is patched here stays patched."""

    def __init__(self, *_: object, **__: object) -> None: ...

    def __enter__(self) -> InProcess:
        return self

    def __exit__(self, *_: object) -> None: ...

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(function(*arguments))
        return done

    map = staticmethod(map)


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    for module in (drawn, growth, refining, refining_growth, robustness, soak, worlds, loops):
        if hasattr(module, "ProcessPoolExecutor"):
            monkeypatch.setattr(module, "ProcessPoolExecutor", InProcess)
    begin_quickly(monkeypatch)
    return monkeypatch


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


# -- every command, on as little as possible -------------------------------------------------------


def test_cases_are_measured_beside_their_targets(tmp_path: Path, here: pytest.MonkeyPatch) -> None:
    here.setenv("LOAM_GTSAM_DATA", str(tmp_path / "absent"))
    here.setattr(tool, "QUICK", (ROOM,))
    here.setattr(tool, "CASES", (*(c for c in tool.CASES if c.name == "sim_town"), ROOM))
    here.setattr(cases, "WORKERS", 0)  # a process takes longer to start than the sweeps
    only = ["--only", "room", "sim_town"]
    assert tool.main(["--quick", *only, "--no-peers", "--output", str(tmp_path)]) == 0
    (row,) = table(tmp_path / "benchmarks.csv")
    assert row["sweeps"] == "6"
    assert 0.0 < float(row["ate_m"]) < 0.1
    assert row["targets"] == "ATE <= 1 m: met; ATE <= KISS-ICP: not judged"
    assert tool.main([*only, "--output", str(tmp_path)]) == 0
    assert table(tmp_path / "benchmarks.csv")[0]["problem"] == "skipped: no data"
    # Each whole run is a line of the history.
    (run,) = map(json.loads, (tmp_path / "history.jsonl").read_text("utf-8").splitlines())
    assert list(run["cases"]) == ["room"]
    assert history.draw(tmp_path) == tuple(tmp_path / f"history.{end}" for end in KINDS)
    assert run["cases"]["room"]["ate_m"] < 0.1
    assert "tottime" in tool.profile("room", tmp_path)[1]


def test_worlds_are_judged_the_same_by_any_number_of_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = replace(worlds.QUICK[0], options={"frames": 7, "columns": 300})
    monkeypatch.setattr(worlds, "QUICK", (small,))
    for workers in ("1", "2"):
        options = ["--quick", "--seeds", "2", "--modes", "lidar", "--workers", workers]
        against = ["--against", str(tmp_path / "1" / "worlds.json")] if workers == "2" else []
        assert worlds.main([*options, *against, "--output", str(tmp_path / workers)]) == 0
    one, two = (worlds.read(tmp_path / workers / "worlds.json") for workers in ("1", "2"))
    assert [replace(row, ms=0.0) for row in one] == [replace(row, ms=0.0) for row in two]
    assert [row.seed for row in one] == [0, 1]
    assert all(0.0 < row.ate < 0.05 and row.broken == row.beyond == 0 for row in one)
    assert "geometric mean 1.000, worst 1.00" in (tmp_path / "2" / "worlds.md").read_text("utf-8")
    (row,) = table(tmp_path / "2" / "worlds.csv")
    assert (row["mode"], row["broken"]) == ("lidar", "0")
    assert float(row["ATE mm"]) == pytest.approx(1e3 * np.sqrt(one[0].ate * one[1].ate), abs=0.06)
    assert float(row["NEES/6 1"]) > 0.0


def test_long_drives_leave_cubes_behind_and_keep_them(
    tmp_path: Path, here: pytest.MonkeyPatch
) -> None:
    kept: list[GrowthResult] = []
    measure = growth.measure
    here.setattr(growth, "measure", lambda drive: kept.append(measure(drive)) or kept[-1])
    here.setattr(growth, "QUICK", (replace(growth.QUICK[1], frames=36),))
    assert growth.main(["--quick", "--output", str(tmp_path)]) == 0
    (avenue,) = kept
    assert (avenue.evicted > 20, avenue.dropped) == (True, 0)
    assert avenue.statuses == {"first": 1, "ok": avenue.sweeps - 1}
    points = avenue.columns["archived_points"] + avenue.columns["window_points"]
    assert np.all(np.diff(points) >= 0.0)
    assert len(table(tmp_path / "growth_avenue.csv")) == avenue.sweeps
    (row,) = table(tmp_path / "growth.csv")
    assert (row["run"], row["sweeps"]) == ("avenue", str(avenue.sweeps))
    assert len(table(tmp_path / "growth_times.csv")) == 7
    with pytest.raises(SystemExit):
        growth.main(["--frames", "9"])  # no tenths


def test_refined_runs_are_judged_as_the_runs_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    to = ["--seeds", "1", "--output", str(tmp_path)]
    assert refining.main(["--quick", *to]) == 0
    (row,) = table(tmp_path / "refining.csv")
    assert (row["seed"], row["frames"], row["broken"], row["problem"]) == ("0", "12", "0", "")
    ratio = float(row["refined_mm"]) / float(row["run_mm"])
    assert ratio < 0.95
    assert float(row["ratio"]) == pytest.approx(ratio, rel=1e-3)
    assert 0.2 < float(row["nees_1"]) < 5.0
    assert float(row["thin_mm"]) < float(row["thick_mm"])
    printed = capsys.readouterr().out.partition("geometric mean ")[2].partition(",")[0]
    assert float(printed) == pytest.approx(ratio, abs=2e-3)
    two = [refining.Row("room", 0, ratio=0.5), refining.Row("room", 1, ratio=2.0)]
    assert "geometric mean 1.000, worst 2.00" in refining.summary(two)
    with pytest.raises(SystemExit):
        refining.main(["--worlds", "nowhere", *to])


def test_what_chance_makes_is_told_from_two_drives() -> None:
    plain, noisy = (world.name for world in refining.MICROMETRE)
    apart = [(plain, 0, 10.0), (plain, 1, 20.0), (noisy, 0, 13.0), (noisy, 1, 16.0)]
    rows = [refining.Row(name, seed, run_mm=5.0, refined_mm=mm) for name, seed, mm in apart]
    rows.append(refining.Row(plain, 2, problem="ended early"))
    assert "refined_mm: standard deviation by chance 2.50 mm" in refining.spread(rows)
    assert "run_mm: standard deviation by chance 0.00 mm" in refining.spread(rows)


def test_hand_held_sweeps_are_held_against_the_poses_that_come_with_them(
    tmp_path: Path, here: pytest.MonkeyPatch
) -> None:
    here.setenv("LOAM_GTSAM_DATA", str(tmp_path))
    world = SimulatedWorld("room", frames=8, sensor="os1-64", columns=300, speed=0.1)
    folder = tmp_path / "hilti_os0_64"
    folder.mkdir()
    poses = world.truth.map_T_lidar[:, :3].reshape(-1, 12).copy()
    poses[4, 3] += 0.05  # the given poses are no truth
    rows = np.column_stack([1e-9 * world.truth.stamps, poses])
    np.savetxt(folder / "fastlio_poses.txt", rows, "%.9f")
    for number, scan in enumerate(world):
        counts = np.rint((scan.points + recorded._ORIGIN) / recorded._UNIT)
        counts.astype("<i2").tofile(folder / f"{number:06d}.xyz16")
    assert refining.main(["--recorded", "--output", str(tmp_path)]) == 0
    (row,) = table(tmp_path / "refining_recorded.csv")
    assert (row["frames"], row["run_mm"], row["problem"]) == ("8", "nan", "")
    assert float(row["beside_mm"]) < float(row["given_mm"])


def test_first_sweeps_of_a_drive_are_refined_for_what_they_cost(
    tmp_path: Path, here: pytest.MonkeyPatch
) -> None:
    here.setitem(refining_growth.DRIVES, "room", growth.Drive("room", columns=450))
    sizes = ["--growth", "--drives", "room", "--sizes", "6", "14"]
    assert refining.main([*sizes, "--output", str(tmp_path)]) == 0
    short, long = table(tmp_path / "refining_growth.csv")
    assert (short["sweeps"], long["sweeps"]) == ("6", "14")
    assert 0 < int(short["points"]) < int(long["points"])
    assert 0 < int(short["planes"]) < int(long["planes"])
    assert 0.0 < float(long["data_mb"]) <= float(long["peak_mb"])
    assert float(long["refined_mm"]) < float(long["run_mm"])
    assert (tmp_path / "refining_growth.png").stat().st_size > 0


def test_disturbed_runs_fill_the_page(tmp_path: Path, here: pytest.MonkeyPatch) -> None:
    room = robustness.Place("room", frames=24, columns=300, lane=1.2)
    town = robustness.Place(robustness.TOWN, disturbances=("none",))
    kidnapped = replace(room, disturbances=("none", "kidnapped 1 m sideways"))
    here.setattr(robustness, "load", lambda name: None)
    here.setattr(robustness, "QUICK", (kidnapped, town))
    to = ["--quick", "--data", str(ABSENT), "--output", str(tmp_path)]
    assert robustness.main(to) == 0
    calm, moved = table(tmp_path / "robustness.csv")
    assert (calm["recovery"], moved["recovery"]) == ("", "0")
    assert float(moved["max_m"]) < 0.1
    for name in robustness.COMMON:
        case = robustness.disturbed(room, name, ABSENT)
        assert len(list(case.dataset)) == len(case.dataset) <= 24


def test_drives_are_looked_through_for_loops(
    tmp_path: Path, here: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    until = loops._until
    here.setattr(loops, "_until", lambda world, metres: until(world, 0.5 * metres))
    assert loops.main(["--quick", "--output", str(tmp_path)]) == 0
    assert "| drift | drives | recall |" in capsys.readouterr().out
    assert table(tmp_path / "loops.csv")[0]["wrong"] == "0"


def test_every_fault_of_the_soak_is_injected_and_counted(
    tmp_path: Path, here: pytest.MonkeyPatch
) -> None:
    here.setattr(soak, "QUICK", 160)
    here.setitem(soak.SCENES, "street_loop", 300)
    kept: list[soak.SoakResult] = []
    run = soak.soak
    here.setattr(soak, "soak", lambda *a: kept.append(run(*a)) or kept[-1])
    assert soak.main(["--quick", "--output", str(tmp_path)]) == 0
    (result,) = kept
    assert set(result.expected.injected) == set(soak_faults.KINDS)
    assert all(injected == counted for _, injected, counted in result.counts())
    assert set(result.summary["faults"]) == {str(f) for f in SweepFault} - {"part_failed"}
    assert result.sound[0] == result.sound[1] > 100
    (row,) = table(tmp_path / "soak.csv")
    assert (row["exceptions"], row["faults"]) == ("0", str(result.expected.injected.total()))
    assert len(table(tmp_path / "soak_counts.csv")) == len(list(result.counts()))
    # And it notices what it must.
    assert result.met
    assert not replace(result, exceptions=Counter({"ValueError: x": 1})).met
    assert not replace(result, ate=0.06).met
    assert not replace(result, false_ok=1).met
    miscounted = dict(result.summary) | {"faults": dict(result.summary["faults"]) | {"late": 0}}
    assert not replace(result, summary=miscounted).met
    used = 200.0 + 0.003 * np.arange(soak._JUDGED)
    grown = {"process_mb": used, "faults": np.zeros(len(used))}
    assert not replace(result, scene="room", columns=grown).met


def test_the_ouster_sweeps_are_mapped_better_than_their_reference_poses() -> None:
    sample = ouster.run_case(peers=False)
    assert sample.statuses == {"first": 1, "ok": 2}
    residuals = {row[0]: [float(v) for v in row[1:]] for row in sample.tables[1].rows}
    ours, reference = residuals["ours, middle of sweep"], residuals["reference poses"]
    assert all(a < 0.95 * b for a, b in zip(ours, reference, strict=True))
    licence = (ouster.FOLDER / "LICENSE").read_text("utf-8")
    assert "Copyright (c) 2018, Ouster, Inc." in licence


def test_kiss_icp_sees_every_sweep_and_its_pose_belongs_to_the_last_point() -> None:
    pytest.importorskip("kiss_icp")
    result = cases.run_case(ROOM)
    assert [peer.label for peer in result.peers] == ["KISS-ICP"]
    assert 0.0 < result.peers[0].ate < 0.5
    scan = SimulatedWorld("room", frames=1, columns=360).sweep(0)
    sweep, icp = peers.timed_points(scan, Config()), peers.KissIcp()
    icp.register(scan.stamp, sweep)
    assert icp.trajectory.stamps[0] == scan.stamp + round(sweep.times.max() * 1e9)
    with pytest.raises(InputError, match="different times"):
        icp.register(scan.stamp, replace(sweep, times=np.zeros(len(sweep.times))))


# -- what they judge by ----------------------------------------------------------------------------


def test_targets_are_judged_both_ways() -> None:
    case = Case("x", "sim:room", ate_limit=0.05, ate_share=0.001, ms_limit=50.0, ratio_limit=1.0,
                rivals=("A", "B"))  # fmt: skip
    good = CaseResult("x", path=100.0, ate=0.04, stages={"wall": (40.0, 90.0)}, ratio=0.9,
                      peers=(PeerResult("A", 0.041),))  # fmt: skip
    assert [verdict.met for verdict in judge(case, good)] == [True] * 5 + [None]
    bad = replace(good, ate=0.2, stages={"wall": (51.0, 52.0)}, ratio=1.1)
    assert [verdict.met for verdict in judge(case, bad)] == [False] * 5 + [None]
    share = recorded.RivalResult(recorded.Rival("S", "", "", target=0.25), 100.0, 120.0, 24.9, 40.0)
    assert share.verdict is not None
    assert share.verdict.met
    assert not replace(share, mapping=25.1).verdict.met  # type: ignore[union-attr]


def random_walk(rng: np.random.Generator, frames: int) -> tuple[list[MapUpdate], list[Any]]:
    """Poses with errors of their own and a drift, and updates that say just so."""
    white = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
    true, updates, off = [], [], np.zeros(6)
    for k in range(frames):
        pose = gtsam.Pose3.Expmap(np.array([0.001, -0.002, 0.01, 0.3, 0.02, 0.0]) * k)
        off = off + rng.multivariate_normal(np.zeros(6), 0.1 * white)
        found = gtsam.Pose3.Expmap(off).compose(pose)
        found = found.retract(rng.multivariate_normal(np.zeros(6), white))
        to_body, total = found.inverse().AdjointMap(), 0.1 * white * (k + 1)
        parts = Uncertainty(white, np.zeros((6, 6)), None, total, 1.0, 100.0)
        updates.append(
            MapUpdate(k + 1, found, FrameStatus.OK, information=np.linalg.inv(white),
                      covariance=white + to_body @ total @ to_body.T, uncertainty=parts)
        )  # fmt: skip
        true.append(pose)
    return updates, true


@pytest.fixture(scope="module")
def walks() -> list[Any]:
    rng = np.random.default_rng(2)
    return [random_walk(rng, 400) for _ in range(10)]


@pytest.mark.parametrize("window", [1, 10, 50])
def test_right_covariances_have_a_nees_of_one(window: int, walks: list[Any]) -> None:
    runs = [worlds.squared_errors(*walk, window) for walk in walks]
    values = np.array([value for run in runs for value in run.values()])
    assert len(values) == 10 * (400 - window)
    assert 0.85 < values.mean() / worlds.FREEDOM < 1.15
    assert np.count_nonzero(values > worlds.FIVE_SIGMA) == 0


def test_growth_is_the_last_tenth_over_the_second_on_a_machine_of_any_pace() -> None:
    def judged(cpu: FloatArray, make: FloatArray) -> bool | None:
        columns = {name: np.arange(len(cpu), dtype=np.float64) for name in growth.COLUMNS}
        columns |= {"cpu_ms": cpu, "make_ms": make}
        made_up = GrowthResult("x", columns, 1.0, 0.0, {"ok": 100}, (1, 2), 0, 0, 1.0, 1.0, 2.0)
        return made_up.verdict.met

    steady, slower = np.ones(100), np.linspace(1.0, 2.0, 100)
    assert judged(10.0 * steady, steady) is True
    assert judged(10.0 * slower, steady) is False
    assert judged(10.0 * slower, slower) is True


def test_recovery_counts_sweeps_until_the_error_is_back_to_stay() -> None:
    calm = np.full(30, 0.02)
    errors = calm.copy()
    assert robustness.recovery(errors, calm, (10,)) == "0"
    errors[10:13] = 1.0
    assert robustness.recovery(errors, calm, (10,)) == "3"
    errors[15] = 1.0  # back for two sweeps only
    assert robustness.recovery(errors, calm, (10,)) == "6"
    assert robustness.recovery(np.where(np.arange(30) < 10, 0.02, 1.0), calm, (10,)) == "never"


def test_tilts_are_those_of_made_up_poses() -> None:
    truth = np.tile(np.eye(4), (11, 1, 1))
    pitched = gtsam.Pose3(gtsam.Rot3.Pitch(np.radians(3.0)), np.zeros(3)).matrix()
    yawed = gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.zeros(3)).matrix()
    assert np.degrees(worlds.tilts(yawed @ truth, truth)) == pytest.approx(0.0, abs=1e-9)
    assert np.degrees(worlds.tilts(truth @ pitched, truth)) == pytest.approx(3.0)


def test_a_drawn_run_tells_what_is_wrong_with_it(tmp_path: Path, here: pytest.MonkeyPatch) -> None:
    """An exception is in the row of its seed, and in the exit code."""
    command = ["--first", "1", "--seeds", "1", "--frames", "12", "--output", str(tmp_path)]
    assert drawn.main(command) == 0
    here.setattr(drawn, "run", lambda *_, **__: 1 / 0)
    assert drawn.main(command) == 1
    (row,) = table(tmp_path / "drawn.csv")
    assert "division by zero" in row["problem"]
    covariance = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-3])
    told = MapUpdate(0, gtsam.Pose3(), FrameStatus.OK, covariance=covariance)
    judged = drawn._judged([told], SimulatedWorld("room", frames=1, columns=60), np.eye(4))
    assert (judged.solved, judged.ok, judged.bad) == (1, 0, 1)
