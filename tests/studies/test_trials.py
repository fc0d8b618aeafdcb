"""Trials of parameter studies: what decides a trial, what its row says, how it is stored."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from support.list_dataset import ListDataset
from support.quick import QUICK
from support.trials import trial_of

from loam_gtsam.config import Config, preset
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.studies.contenders import SolverRun
from loam_gtsam.studies.evaluation import absolute_error, pose_differences, relative_error
from loam_gtsam.studies.trials import (
    COLUMNS,
    TRIALS_FOLDER,
    TrialStore,
    empty_row,
    run_trial,
    versions,
)
from loam_gtsam.types import BadSweep, FrameStatus, MapUpdate


def test_the_id_depends_on_what_decides_the_result_and_on_no_name():
    trial = trial_of()
    assert trial.id == trial_of(sequence="there", config_name="that").id
    changes = (
        {"path": "sim:trees"},
        {"options": {"dropout": 0.1}},
        {"frames": 3},
        {"seed": 0},
        {"config": preset("loam")},
        {"peer": "kiss-icp"},
        {"parts": {"solver": "a:b"}},
    )
    others = [trial_of(**change) for change in changes]
    assert len({t.id for t in [trial, *others]}) == len(changes) + 1
    assert len({t.config_hash for t in [trial, *others]}) == 4


def test_a_row_has_the_numbers_of_the_run():
    drive = "sim:room?frames=14&columns=300&speed=5&start=moving"
    row = run_trial(trial_of(drive, seed=2, options={"dropout": 0.1}, config=QUICK))
    assert list(row) == list(COLUMNS)
    options = {"speed": 5, "start": "moving", "seed": 2, "dropout": 0.1}
    world = SimulatedWorld("room", frames=14, columns=300, **options)
    result = run(world, QUICK)
    truth, found = world.truth, result.trajectory
    absolute, relative = absolute_error(found, truth), relative_error(found, truth)
    assert row["error"] is row["problem"] is row["peer"] is None
    assert (row["ate_m"], row["rotation_deg"]) == (absolute.rmse, absolute.rotation_rmse_deg)
    assert row["rpe_percent"] == relative.translation_percent
    assert row["rpe_shortest_m"] == relative.lengths[0]
    assert 0.0 < row["thickness_mm"] < 40.0
    assert 0.0 < row["planar_share"] <= 1.0
    assert row["entropy"] < 0.0
    apart = pose_differences(found, truth)[1][-1]
    assert row["drift_percent"] == pytest.approx(100.0 * apart / truth.path_length, rel=1e-9)
    assert row["frames"] == 14
    counts = {str(s): row[f"frames_{s}"] for s in FrameStatus if row[f"frames_{s}"]}
    assert counts == result.status_counts
    assert row["map_points"] == len(result.edge_points) + len(result.plane_points)
    assert {name: row[name] for name in versions()} == versions()
    assert 0.0 < row["ms_median"] < 1e3 * row["wall_s"]


def test_loops_correct_the_poses_that_are_scored():
    """The updates of a run with loops are odometry; its trajectory is corrected."""
    truth = SimulatedWorld("room", frames=5, speed=5).truth
    updates = [MapUpdate(int(stamp), gtsam.Pose3(), FrameStatus.OK) for stamp in truth.stamps]
    bad = MapUpdate(0, gtsam.Pose3(), FrameStatus.BAD_STAMP)
    updates.insert(2, bad)
    loops = SimpleNamespace(graph=SimpleNamespace(trajectory=lambda updates: truth))
    none = np.zeros((0, 3))
    result = RunResult(Config(), tuple(updates), none, none, {}, interrupted=False, loops=loops)
    found = SolverRun.of_result("x", result)
    np.testing.assert_allclose(found.trajectory.map_T_lidar, truth.map_T_lidar, atol=1e-12)
    assert found.updates[2] is bad


@pytest.fixture
def opened(monkeypatch):
    """Sets the data set that every trial opens."""

    def use(dataset):
        monkeypatch.setattr("loam_gtsam.datasets.open_dataset", lambda *a, **k: dataset)

    return use


@pytest.mark.parametrize(
    ("items", "error"),
    [
        ([RuntimeError("oops")], "RuntimeError: oops"),
        ([], "no sweeps in it"),
        ([BadSweep(n, f"damaged {n}") for n in range(3)], "damaged 0"),
    ],
)
def test_what_goes_wrong_in_a_trial_is_in_its_row(opened, items, error):
    opened(ListDataset(items))
    row = run_trial(trial_of())
    assert error in row["error"]
    assert row["wall_s"] >= 0.0


@pytest.mark.parametrize(
    ("trial", "error"),
    [
        (trial_of("nowhere"), "DatasetError: nowhere: no such file"),
        (trial_of(options={"fames": 3}), "takes no option fames"),
        (trial_of(peer="no-such-peer"), "PeerError: unknown peer"),
    ],
)
def test_what_keeps_a_trial_from_starting_is_in_its_row(trial, error):
    assert error in run_trial(trial)["error"]


def test_without_truth_there_are_no_errors_and_the_row_says_why(opened):
    opened(ListDataset(list(SimulatedWorld("room", frames=3, columns=300))))
    row = run_trial(trial_of())
    assert (row["error"], row["problem"]) == (None, "no truth")
    assert row["ate_m"] is row["rpe_percent"] is row["drift_percent"] is None
    assert row["ms_median"] > 0.0


def test_a_peer_gets_the_sweeps_and_the_sensor(fake, monkeypatch):
    seen = []
    monkeypatch.setattr(
        fake, "_register", lambda *a: (seen.append(len(a[2].times)), (np.eye(4), 0.0))[1]
    )
    monkeypatch.setattr(fake, "package", "numpy")
    near = Config().sensor.changed(max_range=3.0)
    rows = [
        run_trial(trial_of(peer="fake", frames=5, config=config))
        for config in (Config(), Config(sensor=near))
    ]
    assert [row["frames_ok"] for row in rows] == [5, 5]
    assert rows[0]["ate_m"] > 0.0
    assert rows[0]["peer_version"] == f"numpy {np.__version__}"
    assert (rows[0]["map_points"], rows[0]["matches"]) == (7, None)
    assert sum(seen[5:]) < sum(seen[:5])


def test_a_peer_that_fails_in_the_middle_is_an_error(fake, monkeypatch):
    monkeypatch.setattr(fake, "fails_at", 2)
    monkeypatch.setattr(fake, "package", "numpy")
    assert "cannot [go] on" in run_trial(trial_of(peer="fake", frames=3))["error"]


def test_a_trial_that_is_stopped_is_no_row(fake):
    def stop(number: int, update: MapUpdate) -> None:
        raise KeyboardInterrupt

    for peer in (None, "fake"):
        with pytest.raises(KeyboardInterrupt):
            run_trial(trial_of(peer=peer), stop)


def test_a_stored_trial_comes_back_as_it_was_with_its_names_of_today(tmp_path):
    (tmp_path / TRIALS_FOLDER).mkdir()
    store, trial = TrialStore(tmp_path), trial_of(seed=1)
    row = empty_row(trial) | {"ate_m": 0.1 + 0.2, "frames": 3}
    assert store.load(trial) is None
    store.save(row)
    assert store.load(trial) == row
    renamed = store.load(replace(trial, sequence="new", config_name="too"))
    assert renamed == row | {"sequence": "new", "config": "too"}
    assert store.load(replace(trial, frames=2)) is None


@pytest.mark.parametrize("change", [{"numpy_version": "1.0"}, {"trial": "x"}, {"new": 1}, None])
def test_a_trial_of_another_version_or_a_damaged_file_counts_as_none(tmp_path, change):
    (tmp_path / TRIALS_FOLDER).mkdir()
    store, trial = TrialStore(tmp_path), trial_of()
    store.save(empty_row(trial))
    file = next((tmp_path / TRIALS_FOLDER).iterdir())
    text = file.read_text()
    file.write_text(text[:-9] if change is None else json.dumps(json.loads(text) | change))
    assert store.load(trial) is None
    store.save(empty_row(trial))
    assert store.load(trial) is not None
