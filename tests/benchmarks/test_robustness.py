"""The benchmark of disturbed runs: its numbers, its tables, and that it runs."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import robustness
from benchmarks.robustness import (
    KISS,
    OURS,
    Measured,
    Place,
    Row,
    finished,
    recovery,
)

ROOT = Path(__file__).resolve().parents[2]

ABSENT = Path("no such folder")
TINY = Place("room", frames=24, columns=300, lane=1.2)


CALM = np.full(30, 0.02)


def test_recovery_counts_sweeps_until_the_error_is_back_to_stay() -> None:
    errors = CALM.copy()
    assert recovery(errors, CALM, ()) == ""
    assert recovery(errors, CALM, (10,)) == "0"
    errors[10:13] = 1.0
    assert recovery(errors, CALM, (10,)) == "3"
    errors[15] = 1.0  # back for two sweeps only
    assert recovery(errors, CALM, (10,)) == "6"
    assert recovery(errors, CALM, (20, 10)) == "6"
    assert recovery(np.where(np.arange(30) < 10, 0.02, 1.0), CALM, (10,)) == "never"


def test_recovery_compares_with_the_undisturbed_run_and_skips_missing_sweeps() -> None:
    drifting = np.linspace(0.0, 1.0, 30)
    errors = drifting + 0.09
    assert recovery(errors, drifting, (10,)) == "0"
    errors[10:15] = np.nan
    errors[15:17] += 0.1
    assert recovery(errors, drifting, (10,)) == "2"


def test_a_run_that_ends_well_has_recovered() -> None:
    errors = CALM[:12].copy()
    errors[9] = 1.0
    assert recovery(errors, CALM[:12], (9,)) == "1"


def test_every_system_is_held_against_its_own_undisturbed_run() -> None:
    calm, worse = CALM, CALM + 1.0
    shifted = CALM + np.where(np.arange(30) < 10, 0.0, 1.0)
    measured = [
        Measured(made_up(), calm, ()),
        Measured(made_up(system=KISS), worse, ()),
        Measured(made_up(disturbance="kidnapped"), shifted, (10,)),
        Measured(made_up(disturbance="kidnapped", system=KISS), shifted, (10,)),
    ]
    assert [row.recovery for row in finished(measured)] == ["", "", "never", "0"]


@pytest.mark.parametrize("name", robustness.COMMON)
def test_common_disturbances_leave_the_truth_alone(name: str) -> None:
    calm, _ = robustness.recorded(TINY, ABSENT)
    case = robustness.disturbed(TINY, name, ABSENT)
    assert case.dataset.truth is calm.truth
    assert len(case.events) == (3 if "missing" in name else 0)
    assert len(list(case.dataset)) == len(case.dataset) <= 24
    assert (len(case.dataset) < 24) == ("missing" in name)


def test_kidnapped_runs_jump_and_leave_out_the_sweep_before() -> None:
    case = robustness.disturbed(TINY, "kidnapped 3 m sideways", ABSENT)
    assert case.dataset.truth is not None
    steps = np.diff(case.dataset.truth.map_T_lidar[:, :3, 3], axis=0)
    assert np.linalg.norm(steps, axis=1).argmax() == 11
    assert np.linalg.norm(steps[11]) == pytest.approx(3.0, abs=0.1)
    assert (case.events, case.unclear) == ((12,), (11,))


def test_a_recorded_drive_is_moved_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    calm, _ = robustness.recorded(TINY, ABSENT)
    monkeypatch.setattr(robustness, "recorded", lambda place, data: (calm, None))
    monkeypatch.setattr(robustness, "AHEAD", {"kidnapped 1 m ahead": 0.1})
    case = robustness.disturbed(TINY, "kidnapped 1 m ahead", ABSENT)
    assert len(case.dataset) < 24
    assert case.dataset.truth is not None
    steps = np.linalg.norm(np.diff(case.dataset.truth.map_T_lidar[:, :3, 3], axis=0), axis=1)
    assert steps.argmax() == 11
    assert 0.1 <= steps[11] < 0.2
    assert case.cut == 24 - len(case.dataset)
    monkeypatch.setattr(robustness, "load", lambda name: None)
    (measured,) = robustness.measure((TINY, "kidnapped 1 m ahead"), ABSENT)
    missing = np.flatnonzero(np.isnan(measured.errors))
    assert missing.tolist() == [11, *range(12, 12 + case.cut)]


def test_a_run_is_measured_with_and_without_the_peer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robustness, "load", lambda name: None)
    (calm,) = robustness.measure((TINY, "none"), ABSENT)
    assert np.isfinite(calm.errors).all()
    (ours,) = robustness.measure((TINY, "kidnapped 1 m sideways"), ABSENT)
    assert np.flatnonzero(np.isnan(ours.errors)).tolist() == [11]
    _, row = finished([calm, ours])
    assert (row.system, row.place, row.sweeps, row.recovery) == (OURS, "room", 24, "0")
    assert row.ate_m <= row.max_m < 0.1
    monkeypatch.undo()
    pytest.importorskip("kiss_icp")
    first, second = robustness.measure((TINY, "kidnapped 1 m sideways"), ABSENT)
    assert first.row == ours.row
    assert (second.row.system, second.row.statuses) == (KISS, "")


def made_up(**changes: object) -> Row:
    row = Row("room", "none", OURS, 18, 0.01, 0.02, "", "1 lost")
    return replace(row, **changes)  # type: ignore[arg-type]


def test_the_table_goes_into_the_page_between_its_marks(tmp_path: Path) -> None:
    rows = [made_up(), made_up(system=KISS, ate_m=0.3, recovery="never", statuses="")]
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- begin table -->\nold\n<!-- end table -->\nafter\n", "utf-8")
    for _ in range(2):
        paths = robustness.write(tmp_path, rows, page)
    assert paths == [tmp_path / "robustness.csv", page]
    text = page.read_text("utf-8")
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    line = "| room | none | 0.0100 | 0.020 |  | 1 lost | 0.3000 | 0.020 | never |"
    assert text.count(line) == 1
    with paths[0].open(newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert [row["system"] for row in table] == [OURS, KISS]
    assert table[1]["ate_m"] == "0.3"


def test_the_table_does_without_the_peer(tmp_path: Path) -> None:
    _, page = robustness.write(tmp_path, [made_up()])
    assert "| room | none | 0.0100 | 0.020 |  | 1 lost |  |  |  |" in page.read_text("utf-8")


def test_the_page_has_a_place_for_the_table() -> None:
    text = (ROOT / "docs/robustness.md").read_text("utf-8")
    assert text.count("<!-- begin table -->") == text.count("<!-- end table -->") == 1


def test_the_command_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Here:
        """In this process: what is patched here stays patched."""

        def __init__(self, *_: object, **__: object) -> None: ...
        def __enter__(self) -> Here:
            return self

        def __exit__(self, *_: object) -> None: ...

        map = staticmethod(map)

    quick = replace(TINY, frames=12, disturbances=("none",))
    town = Place(robustness.TOWN, disturbances=("none",))
    monkeypatch.setattr(robustness, "ProcessPoolExecutor", Here)
    monkeypatch.setattr(robustness, "QUICK", (quick, town))
    arguments = ["--quick", "--data", str(ABSENT), "--output", str(tmp_path)]
    assert robustness.main(arguments) == 0
    assert (tmp_path / "robustness.csv").read_text("utf-8").count("\nroom,none,loam_gtsam") == 1
    assert robustness.TOWN not in (tmp_path / "robustness.md").read_text("utf-8")
