"""Whole runs over scenes: the numbers, the tables, and that the command runs."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import scene_tables, scenes
from benchmarks.scene_tables import Row, along, drift, tilt
from loam_gtsam.config import preset
from loam_gtsam.types import FloatArray, Trajectory

ROOT = Path(__file__).resolve().parents[2]

TINY = scenes.Place("slopes", frames=5, columns=1200, aids=("none", "equivalent"))
ABSENT = Path("no such folder")


def straight(count: int = 11) -> FloatArray:
    """A way of ten metres along x."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, 10.0, count)
    return poses


def pitched(degrees: float) -> FloatArray:
    turn = np.eye(4)
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn[[0, 0, 2, 2], [0, 2, 0, 2]] = cosine, sine, -sine, cosine
    return turn


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return scenes.measure(TINY, ABSENT)


# -- the numbers -----------------------------------------------------------------------------------


def test_drift_is_the_largest_error_of_the_height_above_the_start() -> None:
    truth = straight()
    found = truth.copy()
    found[:, 2, 3] += 5.0  # another origin
    found[3, 2, 3] -= 0.2
    found[7, 2, 3] += 0.1
    found[:, 1, 3] += 1.0  # sideways does not count
    assert drift(found, truth) == pytest.approx(0.2)
    # A map that is tilted by one degree climbs.
    assert drift(pitched(-1.0) @ truth, truth) == pytest.approx(10.0 * np.sin(np.radians(1.0)))


def test_tilt_counts_roll_and_pitch_and_no_yaw() -> None:
    truth = straight()
    about_x = np.eye(4)
    about_x[1:3, 1:3] = pitched(4.0)[np.ix_([0, 2], [0, 2])]
    yaw = np.eye(4)
    yaw[:2, :2] = pitched(30.0)[np.ix_([0, 2], [0, 2])]
    assert tilt(yaw @ truth, truth) == pytest.approx(0.0, abs=1e-9)
    assert tilt(truth @ pitched(3.0), truth) == pytest.approx(3.0)
    assert tilt(truth @ about_x, truth) == pytest.approx(4.0)
    half = truth.copy()
    half[:5] = half[:5] @ pitched(2.0)
    assert tilt(half, truth) == pytest.approx(2.0 * np.sqrt(5 / 11))


def test_along_is_signed_and_a_share_of_the_path() -> None:
    truth = straight()
    found = truth.copy()
    found[-1, :3, 3] += [-0.2, 3.0, 0.0]
    assert along(found, truth) == pytest.approx(-2.0)
    assert along(pitched(20.0) @ found, truth) == pytest.approx(-2.0)  # in any frame


# -- the runs --------------------------------------------------------------------------------------


def test_every_solver_and_use_of_the_imu_has_its_row(rows: list[Row]) -> None:
    solvers = [row.variant for row in rows if row.table == "solvers"]
    assert solvers == ["default", "loam", "aloam"]
    with_imu = [(row.variant, row.noise) for row in rows if row.table == "imu"]
    assert with_imu == [("none", pytest.approx(np.nan, nan_ok=True)), ("equivalent", 0.003),
                        ("equivalent", 0.010)]  # fmt: skip
    assert {row.sweeps for row in rows} == {5}
    assert all(0.0 < row.ate_m <= row.max_m < 0.5 and row.ms > 0.0 for row in rows)
    assert {row.unsolved for row in rows} == {0}


def test_the_run_without_an_imu_is_the_solvers_own(rows: list[Row]) -> None:
    by_table = {row.table: row for row in reversed(rows) if row.variant in ("default", "none")}
    assert by_table["imu"] == replace(
        by_table["solvers"], table="imu", variant="none", noise=by_table["imu"].noise
    )


def test_a_map_without_level_is_judged_in_its_true_one(rows: list[Row]) -> None:
    # The scene starts on a slope of 5 degrees; none of it is an error of the estimate.
    assert max(row.tilt_deg for row in rows if row.variant in ("none", "equivalent")) < 0.5
    world = scenes.record(TINY, ABSENT)
    assert tilt(world.truth.map_T_lidar, scenes._turned(world.world_R_start,
                world.truth.map_T_lidar)) > 4.0  # fmt: skip


def test_numbers_are_the_same_on_every_run(rows: list[Row]) -> None:
    world = scenes.record(TINY, ABSENT)
    config = preset("aloam")
    config = replace(config, imu=replace(config.imu, enabled=False))
    again = scenes.Runs(TINY, world).run("solvers", "aloam", config)
    before = next(row for row in rows if row.variant == "aloam")
    assert replace(again, ms=0.0, noise=0.0) == replace(before, ms=0.0, noise=0.0)


def test_the_mapper_uses_the_imu_of_the_asked_noise() -> None:
    runs = scenes.Runs(TINY, scenes.record(TINY, ABSENT))
    good, poor = (
        runs.run("imu", "sigma", scenes.AIDS["sigma"], noise).tilt_deg for noise in scenes.NOISES
    )
    assert good < poor


# -- the command -----------------------------------------------------------------------------------


def test_command_writes_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bare = scenes.Place("corridor_bare", frames=4, columns=360, solvers=(), aids=("none", "sigma"))
    monkeypatch.setattr(scenes, "QUICK", (TINY, bare, scenes.Place(scenes.TOWN)))
    assert scenes.main(["--quick", "--data", str(tmp_path), "--output", str(tmp_path)]) == 0
    solvers, imu = table(tmp_path / "solvers.csv"), table(tmp_path / "imu.csv")
    assert [row["variant"] for row in solvers] == ["default", "loam", "aloam"]
    assert [row["place"] for row in imu] == ["slopes"] * 3 + ["corridor_bare"] * 3  # no sim_town
    assert float(solvers[0]["ate_m"]) > 0.0
    text = (tmp_path / "imu.md").read_text(encoding="utf-8")
    # The run without an IMU stands in the line of every noise.
    lines = [line for line in text.splitlines() if line.startswith("| slopes")]
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert [row[3] for row in cells[:2]] == ["3", "10"]
    assert cells[0][4] == cells[1][4] == f"{float(imu[0]['ate_m']):.4f}"


def test_only_runs_what_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = scenes.Place("room", frames=4, columns=360, solvers=("default",))
    monkeypatch.setattr(scenes, "QUICK", (replace(TINY, scene="trees"), other))
    assert scenes.main(["--quick", "--only", "room", "--output", str(tmp_path)]) == 0
    assert [row["place"] for row in table(tmp_path / "solvers.csv")] == ["room"]
    assert not (tmp_path / "imu.csv").exists()


def test_a_recorded_town_has_its_own_imu(tmp_path: Path) -> None:
    if not (scenes.data_folder() / scenes.TOWN).is_dir():
        pytest.skip("needs the sim_town data, see benchmarks")
    town = scenes.record(scenes.Place(scenes.TOWN), scenes.data_folder())
    assert len(town.sweeps) == len(town.truth) == 60
    assert list(town.imus) == [scene_tables.RECORDED]
    start = Trajectory(town.truth.stamps[:4], town.truth.map_T_lidar[:4])
    runs = scenes.Runs(
        scenes.Place(scenes.TOWN), replace(town, sweeps=town.sweeps[:4], truth=start)
    )
    row = runs.run("imu", "sigma", scenes.AIDS["sigma"], scene_tables.RECORDED)
    assert any("| recorded |" in line for line in scene_tables.markdown("imu", [row]))
