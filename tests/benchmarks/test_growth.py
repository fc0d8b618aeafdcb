"""The benchmark of long runs, and the table beside recorded systems."""

from __future__ import annotations

import csv
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import growth, growth_report, process, recorded
from benchmarks.growth import COLUMNS, Drive
from benchmarks.growth_report import GrowthResult
from benchmarks.recorded import Rival, RivalResult
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.types import FloatArray

ROOT = Path(__file__).resolve().parents[2]

LOOP = Drive("street_loop", frames=10, columns=300)


def made_up(cpu: FloatArray, make: FloatArray | None = None) -> GrowthResult:
    """A run of which only the times matter."""
    columns = {name: np.arange(len(cpu), dtype=np.float64) for name in COLUMNS}
    columns |= {"cpu_ms": cpu, "make_ms": np.ones(len(cpu)) if make is None else make}
    return GrowthResult(
        name="x", columns=columns, path=1.0, ate=0.0, statuses={"ok": len(cpu)}, map_points=(1, 2),
        evicted=0, dropped=0, report_kb=1.0, peak_mb=1.0, peak_with_map_mb=2.0,
    )  # fmt: skip


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def avenue() -> GrowthResult:
    return growth.measure(growth.QUICK[1])


# -- the drives ------------------------------------------------------------------------------------


def test_a_drive_leaves_cubes_behind_and_keeps_them(avenue: GrowthResult) -> None:
    columns = avenue.columns
    assert set(columns) == set(COLUMNS)
    assert avenue.sweeps == growth.QUICK[1].frames
    assert avenue.evicted > 20
    assert avenue.dropped == 0
    archived, window = columns["archived_points"], columns["window_points"]
    assert archived[0] == 0.0 < archived[-1]
    assert np.all(np.diff(archived + window) >= 0.0)  # nothing is lost
    assert archived[-1] + window[-1] == sum(avenue.map_points)
    assert np.all(columns["near_points"] <= window)
    assert avenue.statuses == {"first": 1, "ok": avenue.sweeps - 1}
    assert avenue.ate < 0.05


def test_the_stages_add_up_to_the_frame(avenue: GrowthResult) -> None:
    stages = sum(avenue.columns[f"{stage}_ms"] for stage in growth.STAGES)
    assert np.all(stages > 0.0)
    assert np.all(stages <= avenue.columns["cpu_ms"])
    assert np.all(avenue.columns["match_ms"][1:] > 0.0)
    assert avenue.columns["match_ms"][0] == 0.0  # the first sweep has nothing to match with


def test_memory_is_that_of_the_process(avenue: GrowthResult) -> None:
    used = avenue.columns["process_mb"]
    assert 20.0 < used.min() <= used.max() <= 1.05 * avenue.peak_mb  # pages are counted late
    assert avenue.peak_mb <= avenue.peak_with_map_mb
    assert 0.5 < avenue.report_kb < 20.0


def test_a_drive_is_as_long_as_asked() -> None:
    world = replace(growth.DRIVES[1], kilometres=0.4).open()
    driven = world.truth.path_length
    assert 400.0 <= driven < 401.5  # a sweep is a metre
    laps = replace(growth.DRIVES[0], frames=1500).open()
    assert len(laps) == 1500
    assert laps.truth.path_length > 2.0 * 600.0


# -- the numbers -----------------------------------------------------------------------------------


def test_growth_is_the_last_tenth_over_the_second() -> None:
    cpu = np.full(100, 20.0)
    cpu[:10], cpu[10:20], cpu[90:] = 90.0, 10.0, 11.5
    result = made_up(cpu)
    np.testing.assert_array_equal(result.tenths("cpu_ms"), [90.0, 10.0, *[20.0] * 7, 11.5])
    assert result.growth("cpu_ms") == pytest.approx(1.15)
    assert result.verdict.met is False
    cpu[90:] = 10.9
    assert made_up(cpu).verdict.met is True


def test_a_machine_that_slows_down_is_no_growth() -> None:
    slower = np.linspace(1.0, 2.0, 100)
    only_slower = made_up(10.0 * slower, slower)
    assert only_slower.verdict.met is True
    row = growth_report.time_table([only_slower]).rows[0]
    assert row[:2] == ("x", "whole pipeline")
    assert row[-3:] == ("1.70", "1.00", "<= 1.1 x: met")
    assert made_up(10.0 * slower**2, slower).verdict.met is False


def test_curves_are_thinned() -> None:
    result = made_up(np.tile([1.0, 9.0, 2.0], 700))
    rows = growth_report.thinned(result)
    assert {len(column) for column in rows.values()} == {500}
    assert rows["frame"][-1] == 2099.0
    assert rows["distance_m"][-1] == 2099.0  # as it was in the end
    assert set(rows["cpu_ms"]) <= {1.0, 1.5, 2.0, 5.0, 5.5, 9.0}  # medians of four or five
    short = growth_report.thinned(made_up(np.arange(7.0)))
    np.testing.assert_array_equal(short["cpu_ms"], np.arange(7.0))


# -- beside recorded systems -----------------------------------------------------------------------

HEAD = "frame,reg_total,odo_total,map_total\n"


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording of three frames, and sweeps that stand in for those of its source."""
    (tmp_path / "timing.csv").write_text(
        HEAD + "0,10.0,1.0,80.0\n1,12.0,1.0,100.0\n2,14.0,1.0,130.0\n", encoding="utf-8"
    )
    (tmp_path / "sweeps").mkdir()
    world = SimulatedWorld("room", frames=4, columns=360)
    monkeypatch.setattr(recorded, "open_dataset", lambda path: world)
    return tmp_path


def test_recorded_times_are_medians(data: Path) -> None:
    assert recorded.read_timing(data / "timing.csv") == (100.0, 113.0)


def test_ours_is_held_against_a_recording(data: Path) -> None:
    (result,) = recorded.measure_all(data, [Rival("S", "timing.csv", "sweeps", target=0.25)])
    assert result.its_mapping == 100.0
    assert 0.0 < result.mapping < result.total
    row = recorded.table([result]).rows[0]
    assert row[0] == "S"
    assert row[4] == f"{result.mapping / 100.0:.2f}"
    assert row[8] == f"{result.total / 113.0:.2f}"


def test_rivals_without_files_are_left_out(data: Path) -> None:
    absent = [Rival("A", "no.csv", "sweeps"), Rival("B", "timing.csv", "no sweeps")]
    assert recorded.measure_all(data, absent) == []


def test_the_share_is_judged_both_ways() -> None:
    rival = Rival("S", "", "", target=0.25)
    good = RivalResult(rival, its_mapping=100.0, its_total=120.0, mapping=24.9, total=np.nan)
    assert good.verdict is not None
    assert good.verdict.met is True
    bad = replace(good, mapping=25.1).verdict
    assert bad is not None
    assert bad.met is False
    assert replace(good, rival=replace(rival, target=None)).verdict is None
    assert recorded.table([good]).rows[0][-2:] == ("-", "-")  # recorded features


def test_recordings_on_the_same_sweeps(shared_data: Path) -> None:
    present = [rival for rival in recorded.RIVALS if (shared_data / rival.timing).exists()]
    if not present:
        pytest.skip("no recorded timing.csv")
    for rival in present:
        mapping, total = recorded.read_timing(shared_data / rival.timing)
        assert 10.0 < mapping < total < 300.0


# -- the process -----------------------------------------------------------------------------------


def test_processor_clock_is_put_back() -> None:
    wall = time.perf_counter
    clock = process.processor_clock()
    with clock:
        assert time.perf_counter is time.process_time
    assert time.perf_counter is wall
    with pytest.raises(ZeroDivisionError), process.processor_clock():
        1 / 0  # noqa: B018
    assert time.perf_counter is wall


def test_memory_without_proc_is_the_largest_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    now, peak = process.memory()
    assert 20.0 < now <= 1.05 * peak
    monkeypatch.setattr(process, "Path", lambda name: SimpleNamespace(read_text=_unreadable))
    now, peak = process.memory()
    assert now == peak > 20.0


def _unreadable(encoding: str) -> str:
    raise FileNotFoundError


# -- the command -----------------------------------------------------------------------------------


def test_command_writes_curves_and_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(growth, "QUICK", (LOOP,))
    assert growth.main(["--quick", "--output", str(tmp_path)]) == 0
    rows = table(tmp_path / "growth_street_loop.csv")
    assert [row["frame"] for row in rows] == [str(number) for number in range(10)]
    assert list(rows[0])[1:] == list(COLUMNS)
    assert (tmp_path / "growth_street_loop.png").read_bytes().startswith(b"\x89PNG")
    text = (tmp_path / "growth.md").read_text(encoding="utf-8")
    assert "| street_loop | 10 |" in text
    assert "gtsam 4." in text
    assert "growth.md" in capsys.readouterr().out


def test_parts_of_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    class Pool:
        def __init__(self, *arguments: object, **options: object) -> None: ...

        def __enter__(self) -> Pool:
            return self

        def __exit__(self, *what: object) -> None: ...

        def submit(self, function: object, drive: Drive) -> SimpleNamespace:
            seen.append(drive)
            return SimpleNamespace(result=lambda: made_up(np.ones(20)))

    result = RivalResult(recorded.RIVALS[0], 60.0, 75.0, 10.0, 20.0)
    monkeypatch.setattr(growth, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(recorded, "measure_all", lambda data: [result])
    to = ["--output", str(tmp_path)]
    assert growth.main(["--frames", "77", *to]) == 0
    assert growth.main(["--kilometres", "0.5", *to]) == 0
    assert [(drive.scene, drive.frames, drive.kilometres) for drive in seen] == [
        ("street_loop", 77, 0.0),
        ("avenue", 0, 0.5),
    ]
    assert growth.main(to) == 0
    assert tuple(seen[2:]) == growth.DRIVES
    text = (tmp_path / "growth.md").read_text(encoding="utf-8")
    assert "| A-LOAM | 60.0 | sim_town | 10.0 | 0.17 | <= 0.25 x: met |" in text


@pytest.mark.parametrize(
    "words",
    [["--frames", "50", "--quick"], ["--frames", "9"], ["--frames", "0"], ["--kilometres", "0.09"]],
)
def test_drives_without_tenths_are_refused(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        growth.main(words)
    assert words[0] in capsys.readouterr().err
