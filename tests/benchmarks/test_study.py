"""The study: what it does to sweeps, what counts as success, and that it runs."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

pytest.importorskip("matplotlib")
from benchmarks import study
from loam_gtsam.config import Config
from loam_gtsam.registration.association import EdgeMatches, PlaneMatches, ScanMatches

ROOT = Path(__file__).resolve().parents[2]

TINY = study.Effort(first=4, targets=1, starts=2, columns=600, mapped=3)


@pytest.fixture(scope="module", autouse=True)
def few_levels() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "CHANGES", (study.FIRST,))
        patch.setattr(study, "METRES", (0.05, 2.0))
        patch.setattr(study, "DEGREES", (1.0,))
        patch.setattr(study, "SHARES", (0.0, study.SHARE))
        yield


@pytest.fixture(scope="module")
def results() -> list[study.Result]:
    return study.study_scene("room", TINY)


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def matches(distances: list[float]) -> ScanMatches:
    count = len(distances)
    rows, ones = np.tile([1.0, 0.0, 0.0], (count, 1)), np.ones(count)
    across, indices = np.array(distances), np.arange(count)
    lines = EdgeMatches(np.zeros((0, 3)), *[np.zeros((0, 3))] * 2, *[np.zeros(0)] * 3, indices[:0])
    # The points stand at the distances, the plane is x = 0.
    planes = PlaneMatches(rows * across[:, None], rows, 0 * ones, across, 0.1 * ones, ones, indices)
    return ScanMatches(lines, planes)


def test_small_errors_converge_to_the_truth_and_huge_ones_do_not(
    results: list[study.Result],
) -> None:
    rows = {(r.study, r.solver, r.level): r for r in study.summary(results)}
    small = rows["metres", "default", 0.05]
    assert small.success == 100.0
    assert small.mean_m < 0.05
    assert rows["metres", "aloam", 2.0].success == 0.0
    assert rows["metres", "aloam", 2.0].mean_m > 0.1


@pytest.mark.parametrize("name", ["default", "loam", "aloam"])
def test_no_change_of_the_frame_lowers_a_cost_below_that_of_its_minimum(name: str) -> None:
    at_zero = study.cost(matches([0.3, -0.3]), gtsam.Pose3(), name)
    aside = gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.0]))
    # Whitened: 2 x (0.3 / 0.1)^2 / 2; plain: 0.3^2; Huber: 2 (2 x 0.1 x 0.3 - 0.1^2) / 2.
    assert at_zero == pytest.approx({"default": 9.0, "loam": 0.09, "aloam": 0.05}[name])
    assert study.cost(matches([0.3, -0.3]), aside, name) >= at_zero - 1e-12


def test_kernels_shrink_only_what_is_far() -> None:
    near_and_far = matches([0.0, 0.1, 1.0])
    assert study.robust(near_and_far, "") is near_and_far
    cauchy = study.robust(near_and_far, "cauchy").planes.weights
    assert cauchy[0] == 1.0
    assert cauchy[2] ** 2 == pytest.approx(1.0 / (1.0 + (10.0 / study.CAUCHY) ** 2))
    # Where all residuals are large, the unit grows with them.
    far = matches([1.0, 1.0, -1.0])
    scaled = study.robust(far, "scaled cauchy").planes.weights
    assert np.all(scaled > 2.0 * study.robust(far, "cauchy").planes.weights)


def test_a_change_is_the_default_but_for_what_it_names() -> None:
    changed = study._changed("x", solver={"iterations": 30}).config
    assert changed == replace(Config(), solver=replace(Config().solver, iterations=30))
    names = [variant.name for variant in (*study.MAIN, *study.CHANGES, *study.CORRIDOR)]
    assert study.MAIN[0].config == Config()
    assert len(set(names)) == len(names) - 3  # the main ones are in the corridor too


def test_outliers_are_as_many_as_asked() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(40, 3))
    shift = np.array([0.5, 0.0, 0.0])
    moved = study.with_moving_object(points, 0.25, np.pi, shift)
    changed = np.any(moved != points, axis=1)
    assert changed.sum() == 10
    assert np.allclose(moved[changed] - points[changed], shift)
    off = np.abs(np.abs(np.arctan2(points[:, 1], points[:, 0])) - np.pi)  # from straight behind
    assert off[changed].max() < off[~changed].min()
    replaced = study.with_random_points(points, 0.25, rng)
    assert np.any(replaced != points, axis=1).sum() == 10
    assert np.all((replaced >= points.min(axis=0)) & (replaced <= points.max(axis=0)))


def test_disturbed_by_what_is_asked() -> None:
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([1.0, 2.0, 3.0]))
    off = pose.between(study.disturbed(pose, 0.5, 2.0, np.random.default_rng(0)))
    assert np.linalg.norm(off.translation()) == pytest.approx(0.5)
    assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(off.rotation()))) == pytest.approx(2.0)


def test_what_keeps_the_wrong_way_along() -> None:
    effort = replace(TINY, mapped=4)
    trials = study.summary(study.study_scene("corridor_bare", effort))
    along = {row.solver: row.along_m for row in trials if row.study == "wrong along"}
    for name in ("default", "default, projected", "loam"):
        assert along[name] == pytest.approx(study.ALONG, abs=0.02), name
    for name in ("loam, no projector", "default, scan believed"):
        assert abs(along[name] - study.ALONG) > 0.02, name


def test_command_writes_the_same_numbers_on_every_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, results: list[study.Result]
) -> None:
    monkeypatch.setattr(study, "QUICK", TINY)
    assert study.main(["--quick", "--output", str(tmp_path)]) == 0
    study.write_fields(tmp_path / "again.csv", study.summary(results))
    again, rows = table(tmp_path / "again.csv"), table(tmp_path / "study/trials.csv")
    assert rows[: len(again)] == again
    assert {row["scene"] for row in rows} == {"room", "corridor_bare"}
    assert {row["name"] for row in table(tmp_path / "study/numbers.csv")} >= {"under loam", "6"}
    for name in ("basin", "outliers", "changes", "corridor"):
        assert (tmp_path / f"images/study_{name}.png").stat().st_size > 10_000
