"""Options on the data and on parts of a user's own: truth, parts of a data set, going on."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.cli import loam
from support.quick import QUICK_START

from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.registration.solvers import make_solver

WORLD = "sim:room?frames=8&columns=300"


@pytest.fixture(autouse=True)
def empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


def mapped(*arguments, code=0, folder="out"):
    result = loam("run", WORLD, "--no-plot", "--output", folder, *QUICK_START, *arguments)
    assert result.exit_code == code, result.output
    return result.output


def test_a_part_of_the_sweeps_is_mapped():
    stamps = [scan.stamp for scan in SimulatedWorld("room", frames=8, columns=300)]
    for options, wanted in (
        (("--start", 2, "--every", 2), stamps[2::2]),
        (("--begin", 0.2, "--end", 0.4), stamps[2:5]),
        (("--start", 1, "--frames", 3), stamps[1:4]),
    ):
        mapped(*options, "--overwrite")
        assert read_tum("out/trajectory.tum").stamps.tolist() == wanted


def test_a_truth_of_ones_own_is_compared_with_and_matched():
    world = SimulatedWorld("room", frames=8, columns=300)
    truth = world.truth
    late = np.asarray(truth.stamps, np.int64)[::2]  # not at the stamps of the sweeps

    write_tum("mine.tum", truth.at(late[:-1] + 7_000_000))
    text = mapped("--truth", "mine.tum", "--truth-extrinsic", "0 0 0")
    assert "if not fitted" in text
    found, matched = (read_tum(f"out/{n}.tum") for n in ("trajectory", "truth_matched"))
    assert len(matched) >= 3
    assert set(matched.stamps) <= set(found.stamps)
    accuracy = json.loads(Path("out/summary.json").read_text())["accuracy"]
    assert accuracy["ok_beyond_five_sigma"] == accuracy["broken_covariances"] == 0
    assert accuracy["not_fitted_rmse_m"] < 0.1
    result = loam("run", WORLD, "--truth-extrinsic", "0 0 0")
    assert result.exit_code == 2
    assert "belong to --truth" in result.output


def test_a_run_of_fewer_frames_is_extended_from_its_checkpoint():
    mapped("--frames", 3, "--resume")
    assert (Path("out") / "checkpoint").is_dir()
    assert "complete, 3 sweeps" in mapped("--frames", 3, "--resume")
    mapped("--frames", 6, "--resume")
    mapped("--resume")
    assert not (Path("out") / "checkpoint").exists()
    mapped(folder="whole")
    ours, theirs = (Path(f"{name}/trajectory.tum").read_text() for name in ("out", "whole"))
    assert ours == theirs
    assert "holds the results of another run" in mapped("--frames", 3, "--resume", code=1)


@pytest.mark.parametrize(
    ("option", "named"), [("seed=3", "seed was 0, now 3"), ("gyro_noise=0.1", "first sweep")]
)
def test_a_complete_run_is_not_taken_for_one_of_other_options(option, named):
    mapped("--resume")
    said = mapped("--resume", "--option", option, code=1)
    assert named in " ".join(said.split())


calls: list[str] = []


def make_front_end(config):
    calls.append("features")
    return lambda scan: extract_features(scan, config)


def make_my_solver(config):
    calls.append("solver")
    return make_solver(config.solver)


def no_factors(config):
    calls.append("extra_factors")
    return lambda context: []


def test_parts_of_ones_own_by_name_take_part_in_a_run():
    mapped()
    names = {"features": make_front_end, "solver": make_my_solver, "extra-factors": no_factors}
    options = [x for k, f in names.items() for x in (f"--{k}", f"{__name__}:{f.__name__}")]
    mapped(*options, folder="own")
    assert sorted(calls) == ["extra_factors", "features", "solver"]
    ours, theirs = (read_tum(f"{name}/trajectory.tum") for name in ("own", "out"))
    np.testing.assert_array_equal(ours.map_T_lidar, theirs.map_T_lidar)
    mapped("--solver", "aloam", folder="aloam")
    assert "method: aloam" in Path("aloam/config.yaml").read_text()
    assert "expected one of gtsam" in mapped("--solver", "lom", code=1)
