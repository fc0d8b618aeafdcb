"""Every example runs, and does what it says."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from support import walk
from support.quick import begin_quickly

from loam_gtsam import POSE_KEY, PoseContext

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "examples"
Names = dict[str, Any]


def built_in_scene(names: Names, output: str) -> None:
    assert names["error"].rmse < 0.02
    written = {file.name for file in Path("loam_gtsam_output/example_01").iterdir()}
    assert {"trajectory.tum", "run.npz", "map.ply", "summary.json"} <= written


def numpy_arrays(names: Names, output: str) -> None:
    lines = output.splitlines()
    assert [number for number, line in enumerate(lines) if "unusable_scan" in line] == [5]
    assert names["update"].status == "ok"
    assert len(names["planes"]) > 1000


def every_step(names: Names, output: str) -> None:
    update, truth = names["update"], names["truth"]
    assert names["mapper"].config.matching.max_distance == 0.8
    assert update.status == "ok"
    assert np.linalg.norm(update.map_T_lidar.translation() - truth[:3, 3]) < 0.02


def own_prior(names: Names, output: str) -> None:
    free, target = names["free"], names["target"]
    assert abs(names["held"] - target) < 1e-3  # the last prior is far stronger than the scan
    assert names["after"] < names["sigma"]
    # A prior as strong as the scan meets it half way, up to new matches at the new place.
    held, _ = names["height_with"]([names["height_prior"](target, names["sigma"])])
    assert held == pytest.approx(0.5 * (free + target), abs=0.005)


def factors_by_hand(names: Names, output: str) -> None:
    assert names["graph"].size() == 1
    assert names["difference"] < 1e-9
    moved = gtsam.Pose3().localCoordinates(names["optima"][0])
    assert np.linalg.norm(moved) > 1e-3  # it was not there from the start


def ouster_sweeps(names: Names, output: str) -> None:
    assert [update.status for update in names["result"].updates] == ["first", "ok", "ok"]
    steps = np.linalg.norm(np.diff(names["positions"], axis=0), axis=1)
    np.testing.assert_allclose(steps, (0.225, 0.245), atol=0.015)
    assert "point times: field 't_ns' in ns" in output


def gps_factor(names: Names, output: str) -> None:
    assert names["alone"].max() > 5.0
    assert np.median(names["with_gps"][names["had_one"]]) < 0.15
    # Frames 27 to 32 lie in the hole, 57 to 59 after the last fix.
    assert names["had_one"] == [*range(1, 27), *range(33, 57)]


def ground_and_wheels(names: Names, output: str) -> None:
    alone, held = names["errors"].values()
    assert alone[0] > 5.0
    assert held[0] < 0.02 * names["travelled"]
    assert held[1] < 0.02
    pose = gtsam.Pose3.Expmap(np.array([0.02, -0.03, 0.5, 3.0, 1.0, 0.1]))
    factor = names["floor"](PoseContext(POSE_KEY, 0, pose, None))

    def whitened(at: gtsam.Pose3) -> Any:
        values = gtsam.Values()
        values.insert(POSE_KEY, at)
        return values, factor.noiseModel().whiten(factor.unwhitenedError(values))

    jacobian = factor.linearize(whitened(pose)[0]).jacobian()[0]
    numerical = [
        (whitened(pose.retract(1e-6 * axis))[1] - whitened(pose.retract(-1e-6 * axis))[1]) / 2e-6
        for axis in np.eye(6)
    ]
    np.testing.assert_allclose(jacobian, np.transpose(numerical), atol=1e-4)


def imu_in_a_corridor(names: Names, output: str) -> None:
    constant, inertial = names["errors"]
    assert len(names["blind"]) > 40
    assert all("constrained: x (1" in update.message for update in names["blind"])
    assert abs(inertial) < 0.02 * names["world"].truth.path_length
    assert abs(inertial) < 0.5 * abs(constant)


def own_loop_closer(names: Names, output: str) -> None:
    graph = names["graph"]
    assert len(graph.loops) >= 3
    assert all(graph.active)
    assert names["after"] < 0.5 * names["before"]


def saved_graph(names: Names, output: str) -> None:
    assert [loop.active for loop in names["robust"].loops] == [True, False] * 10
    off, robust = names["off"], names["robust"]
    assert off(robust.poses) < 0.6 * off(names["saved"].poses)
    assert off(names["believed"].poses) > 10.0 * off(robust.poses)
    assert "city.g2o city_optimized.graph" in output


def merged_maps(names: Names, output: str) -> None:
    assert names["merged"].ties[0, 1] >= 6
    assert names["error"] < 2e-3 * max(names["alone"])
    assert Path("both.lgmap").stat().st_size > 100_000


def refined_run(names: Names, output: str) -> None:
    before, after = names["errors"]
    assert after < 0.8 * before
    assert names["thick"][1] < names["thick"][0]
    assert names["off"] < 0.01
    assert names["graph"].size() == 2


def own_solver(names: Names, output: str) -> None:
    assert names["update"].status == "ok"
    assert 0.0 < names["apart"] < 0.003


CHECKS: dict[str, Callable[[Names, str], None]] = {
    "01_map_a_built_in_scene.py": built_in_scene,
    "02_numpy_arrays.py": numpy_arrays,
    "03_every_step.py": every_step,
    "04_own_prior.py": own_prior,
    "05_factors_by_hand.py": factors_by_hand,
    "06_ouster_sweeps.py": ouster_sweeps,
    "07_gps_factor.py": gps_factor,
    "08_ground_and_wheels.py": ground_and_wheels,
    "09_imu_in_a_corridor.py": imu_in_a_corridor,
    "10_own_loop_closer.py": own_loop_closer,
    "11_optimise_a_saved_graph.py": saved_graph,
    "12_merge_maps.py": merged_maps,
    "13_refine_a_run.py": refined_run,
    "14_own_solver.py": own_solver,
}
BEGIN_QUICKLY = (
    "02_numpy_arrays.py",
    "04_own_prior.py",
    "10_own_loop_closer.py",
    "14_own_solver.py",
)
"""What these show is the same however a run begins."""


def test_every_example_is_checked() -> None:
    assert sorted(file.name for file in FOLDER.glob("*.py")) == sorted(CHECKS)


@pytest.mark.parametrize("name", CHECKS)
def test_example(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [name])
    if name in BEGIN_QUICKLY:
        begin_quickly(monkeypatch)
    names = runpy.run_path(str(FOLDER / name), run_name="__main__")
    CHECKS[name](names, capsys.readouterr().out)


OPENED = """
from loam_gtsam import open_dataset, run

dataset = open_dataset("folder")
run(dataset.part(100, 2, end_s=60.0).with_truth("poses.tum"))
"""


def test_mypy_accepts_the_examples_and_the_data_sets_of_the_docs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    api = pytest.importorskip("mypy.api")
    texts = {f"example_{file.name}": file.read_text("utf-8") for file in FOLDER.glob("*.py")}
    for page in ("own_sensor", "inputs"):
        for number, block in enumerate(walk.blocks(ROOT / f"docs/{page}.md", "python")):
            texts[f"{page}_{number}.py"] = block.text
    for name, text in (texts | {"opened.py": OPENED}).items():
        (tmp_path / name).write_text(text, "utf-8")
    monkeypatch.setenv("MYPYPATH", str(ROOT))
    monkeypatch.chdir(tmp_path)
    cache = f"--cache-dir={ROOT / '.mypy_cache/examples'}"
    options = "--config-file=", "--check-untyped-defs", "--ignore-missing-imports"
    found, errors, _ = api.run([*options, cache, *sorted(texts), "opened.py"])
    assert (found.splitlines()[:-1], errors) == ([], "")
