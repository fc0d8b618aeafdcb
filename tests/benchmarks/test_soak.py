"""Every fault there is, injected and counted; and that the soak notices what it must."""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import soak, soak_faults
from benchmarks.soak import SoakResult
from benchmarks.soak_faults import FaultyDrive
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.types import BadSweep, FrameStatus, Scan, SweepFault

ROOT = Path(__file__).resolve().parents[2]

FRAMES = 160


@pytest.fixture(scope="module")
def result() -> SoakResult:
    return soak.soak("street_loop", FRAMES)


def tiny(seed: int = 0, frames: int = FRAMES) -> FaultyDrive:
    """A drive whose sweeps are quickly made."""
    return FaultyDrive(SimulatedWorld("room", frames=frames, columns=60), seed)


# -- the run ---------------------------------------------------------------------------------------


def test_every_fault_is_injected_and_counted_exactly(result: SoakResult) -> None:
    assert set(result.expected.injected) == set(soak_faults.KINDS)
    counts = list(result.counts())
    assert all(injected > 0 for _, injected, _ in counts)
    assert [(name, counted) for name, _, counted in counts] == [
        (name, injected) for name, injected, _ in counts
    ]
    assert set(result.summary["faults"]) == {str(fault) for fault in SweepFault}
    assert result.exceptions == {}
    assert result.met


def test_frames_without_a_fault_are_solved_as_without_any(result: SoakResult) -> None:
    sound, solved = result.sound
    assert sound == solved > 100
    assert result.ate < 0.03
    statuses = result.summary["status_counts"]
    assert set(statuses) == {"first", "ok", "unusable_scan", "bad_stamp"}
    bad_stamps = ("duplicate_stamp", "late", "stamp_back", "stamp_ahead",
                  "clock_set_back", "clock_set_ahead")  # fmt: skip
    faults = result.summary["faults"]
    assert statuses["bad_stamp"] == sum(faults[name] for name in bad_stamps)
    assert statuses["unusable_scan"] == sum(faults.values()) - statuses["bad_stamp"]


def test_what_is_not_as_it_must_be_is_said(result: SoakResult) -> None:
    assert replace(result, exceptions=Counter({"ValueError: x": 1})).met is False
    assert replace(result, ate=0.06).met is False
    assert replace(result, sound=(100, 99)).met is False
    miscounted = dict(result.summary) | {"faults": dict(result.summary["faults"]) | {"late": 0}}
    assert replace(result, summary=miscounted).met is False
    assert not replace(result, summary=miscounted).verdicts()["counts that are exact"][1].met


def test_memory_is_judged_over_a_long_run_with_a_full_map_only(result: SoakResult) -> None:
    def with_memory(per_sweep: float, sweeps: int) -> SoakResult:
        used = 200.0 + np.where(np.arange(sweeps) < sweeps // 5, 0.1, per_sweep) * np.arange(sweeps)
        columns = {"process_mb": used, "faults": np.zeros(sweeps)}
        return replace(result, scene="room", columns=columns)

    assert with_memory(0.003, soak._JUDGED).growth == pytest.approx(3.0)
    assert with_memory(0.003, soak._JUDGED).met is False
    assert with_memory(0.001, soak._JUDGED).met is True
    assert with_memory(0.003, soak._JUDGED - 1).met is True
    assert replace(with_memory(0.003, soak._JUDGED), scene="street_loop").met is True


# -- the faults ------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_faults() -> None:
    first, second, other = (list(tiny(seed, 60).deliveries()) for seed in (4, 4, 5))
    assert [number for _, number in first] == [number for _, number in second]
    assert [sweep.stamp for sweep, _ in first] == [sweep.stamp for sweep, _ in second]
    for (a, _), (b, _) in zip(first, second, strict=True):
        if isinstance(a, Scan) and isinstance(b, Scan):
            np.testing.assert_array_equal(a.points, b.points)
    assert [number for _, number in first] != [number for _, number in other]


def test_the_start_is_sound_and_so_are_sweeps_between_faults() -> None:
    drive = tiny()
    sweeps = [(sweep, number) for sweep, number in drive.deliveries() if number < soak_faults.SOUND]
    assert [number for _, number in sweeps] == list(range(soak_faults.SOUND))
    assert [sweep.stamp for sweep, _ in sweeps] == drive.world.truth.stamps[:15].tolist()
    ends = [first + soak_faults._sweeps(kind) for first, kind in drive._plan]
    starts = [first for first, _ in drive._plan[1:]]
    assert all(start - end >= 3 for start, end in zip(starts, ends[:-1], strict=True))


def test_faults_are_what_they_are_called() -> None:
    drive = tiny(2)
    kinds = {kind: first for first, kind in drive._plan}
    seen: dict[int, list[Scan | BadSweep]] = {}
    order = []
    for sweep, number in drive.deliveries():
        assert isinstance(sweep, (Scan, BadSweep))
        seen.setdefault(number, []).append(sweep)
        order.append(number)
    (unreadable,) = seen[kinds["unreadable"]]
    assert isinstance(unreadable, BadSweep)
    (empty,) = seen[kinds["no points"]]
    assert isinstance(empty, Scan)
    assert len(empty.points) == 0
    twice = seen[kinds["delivered twice"]]
    assert twice[0].stamp == twice[1].stamp
    swapped = kinds["two in the wrong order"]
    at = order.index(swapped)
    assert order[at - 2 : at + 2] == [swapped - 1, swapped + 1, swapped, swapped + 2]
    late = kinds["three sweeps late"]
    at = order.index(late)
    assert order[at - 3 : at + 2] == [late + k for k in (1, 2, 3, 0, 4)]
    assert kinds["two missing"] not in seen
    assert kinds["two missing"] + 1 not in seen
    (ahead,) = seen[kinds["stamp hours to years ahead"]]
    sound = drive.world.truth.stamps[kinds["stamp hours to years ahead"]]
    assert ahead.stamp - sound >= soak_faults.HOUR
    (holes,) = seen[kinds["a third of the points NaN or infinite"]]
    assert isinstance(holes, Scan)
    bad = ~np.isfinite(holes.points).all(axis=1)
    assert bad.mean() == pytest.approx(1.0 / 3.0, abs=0.01)
    assert drive.expected.not_finite[-1] == bad.sum()


def test_the_imu_is_on_the_clock_of_the_sweeps() -> None:
    drive = tiny()
    (first,) = [first for first, kind in drive._plan if kind == "clock set ahead for good"]
    step = drive._clock_steps[first]
    stamps = drive.imu.stamps
    assert stamps.max() == drive.world.imu.stamps.max() + step
    assert not ((stamps > drive.world.sweep(first).stamp) & (stamps < stamps.max() // 2)).any()
    assert drive.expected.imu["gaps"] >= 1
    assert len(stamps) < len(drive.world.imu.stamps) + drive.expected.imu["duplicates"]


def test_a_pipeline_that_raises_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    process = soak.Pipeline.process

    def sometimes(self: soak.Pipeline, sweep: Scan) -> object:
        update = process(self, sweep)
        if update.status is FrameStatus.UNUSABLE_SCAN:
            raise ValueError("oh")
        return update

    monkeypatch.setattr(soak.Pipeline, "process", sometimes)
    raised = soak.soak("room", 60)
    assert raised.exceptions["ValueError: oh"] >= 1
    assert raised.met is False


# -- the command -----------------------------------------------------------------------------------


def test_command_writes_tables_and_curves(
    result: SoakResult,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked: list[tuple[str, int, int]] = []

    class Pool:
        outcome = result

        def __init__(self, *arguments: object, **options: object) -> None: ...

        def __enter__(self) -> Pool:
            return self

        def __exit__(self, *what: object) -> None: ...

        def submit(self, function: object, *arguments: Any) -> SimpleNamespace:
            asked.append(arguments)
            return SimpleNamespace(result=lambda: replace(self.outcome, scene=arguments[0]))

    monkeypatch.setattr(soak, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(soak, "_ROWS", 50)
    assert soak.main(["--quick", "--output", str(tmp_path)]) == 0
    with (tmp_path / "soak_street_loop.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 50
    assert float(rows[-1]["faults"]) == result.expected.injected.total()
    assert (tmp_path / "soak_street_loop.png").read_bytes().startswith(b"\x89PNG")
    text = (tmp_path / "soak.md").read_text(encoding="utf-8")
    assert "| late | 2 | 2 |" in text
    assert "| exceptions | 0 | 0: met |" in text
    Pool.outcome = replace(result, ate=9.0)
    monkeypatch.setattr(soak, "available", lambda: False)  # no pictures this time
    assert soak.main(["--frames", "200", "--seed", "3", "--output", str(tmp_path)]) == 1
    assert "NOT met" in capsys.readouterr().out
    assert asked == [("street_loop", soak.QUICK, 0), ("room", 200, 3), ("street_loop", 200, 3)]
    with pytest.raises(SystemExit):
        soak.main(["--frames", "50"])
