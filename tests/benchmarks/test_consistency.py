"""The consistency benchmark: what NEES counts, bounds that accept and refuse, the command."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from benchmarks import consistency
from benchmarks.consistency import QUICK, START, Row, Study, measure, samples, summarise
from loam_gtsam.types import FrameStatus, MapUpdate, Uncertainty

STUDY = Study("room", 1)
GOOD = Row("room", False, "1", 30, 1000, 1.0, 0.9, 1.1, 0.95, 0.3, *[1.0] * 6)


def random_walk(rng, frames=400):
    """Poses with errors of their own and a drift, and updates that say just so."""
    white = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
    step = 0.1 * white
    true, updates, drift = [], [], np.zeros(6)
    for k in range(frames):
        pose = gtsam.Pose3.Expmap(np.array([0.001, -0.002, 0.01, 0.3, 0.02, 0.0]) * k)
        drift = drift + rng.multivariate_normal(np.zeros(6), step)
        own = rng.multivariate_normal(np.zeros(6), white)
        found = gtsam.Pose3.Expmap(drift).compose(pose).retract(own)
        to_body = found.inverse().AdjointMap()
        total = step * (k + 1)
        parts = Uncertainty(white, np.zeros((6, 6)), None, total, 1.0, 100.0)
        updates.append(
            MapUpdate(k + 1, found, FrameStatus.OK, information=np.linalg.inv(white),
                      covariance=white + to_body @ total @ to_body.T, uncertainty=parts)
        )  # fmt: skip
        true.append(pose)
    return updates, true


@pytest.mark.parametrize("window", [1, 10, 50])
def test_right_covariances_have_a_nees_of_one(window):
    rng = np.random.default_rng(2)
    row = summarise([samples(STUDY, window, *random_walk(rng)) for _ in range(10)])
    assert 0.85 < row.mean < 1.15
    assert 0.92 < row.coverage < 0.975
    assert row.within
    assert row.raw_mean > row.mean  # it knows no drift
    assert row.samples == 10 * (400 - window)
    axes = (row.rx, row.ry, row.rz, row.x, row.y, row.z)
    assert min(axes) > 0.7
    assert max(axes) < 1.4


def test_since_the_start():
    rng = np.random.default_rng(2)
    parts = []
    for _ in range(30):
        updates, true = random_walk(rng, 100)
        start = MapUpdate(0, gtsam.Pose3(), FrameStatus.FIRST)
        parts.append(samples(STUDY, START, [start, *updates], [gtsam.Pose3(), *true]))
    row = summarise(parts)
    assert row.window == "start"
    assert 0.7 < row.mean < 1.4


def test_frames_that_were_not_solved_do_not_count():
    updates, true = random_walk(np.random.default_rng(2), 20)
    updates[7] = MapUpdate(8, gtsam.Pose3(), FrameStatus.UNUSABLE_SCAN)
    found = samples(STUDY, 5, updates, true)
    assert len(found.nees) == 15 - 2
    assert len(found.axes) == len(found.raw) == 13


@pytest.mark.parametrize(
    ("changes", "within"),
    [
        ({}, True),
        ({"mean": 0.51}, True),
        ({"mean": 0.49}, False),
        ({"mean": 2.01}, False),
        ({"coverage": 0.851}, True),
        ({"coverage": 0.84}, False),
        ({"coverage": 0.995}, False),
    ],
)
def test_the_bounds_accept_and_refuse(changes, within):
    assert replace(GOOD, **changes).within is within


@pytest.mark.parametrize(
    ("bad", "code"),
    [
        (None, 0),
        ({"scene": "room", "mean": 3.0}, 1),
        ({"scene": "room", "mean": 3.0, "imu": True}, 0),
        ({"scene": "room", "mean": 3.0, "window": "start"}, 0),
        ({"scene": "trees", "mean": 3.0}, 0),
    ],
)
def test_the_command_fails_if_a_main_scene_is_out_of_bounds(bad, code, tmp_path, monkeypatch):
    rows = [GOOD] if bad is None else [GOOD, replace(GOOD, **bad)]
    monkeypatch.setattr(consistency, "measure", lambda programme, workers: rows)
    assert consistency.main(["--output", str(tmp_path)]) == code


def test_quick_variant_writes_its_files_with_any_number_of_workers(tmp_path):
    results = [measure(QUICK, workers) for workers in (1, 2)]
    assert results[0] == results[1]
    assert [row.window for row in results[0]] == ["1", "5", "start", "1"]
    assert all(0.0 < row.mean < 50.0 for row in results[0])
    paths = consistency.write(results[0], tmp_path)
    assert [path.name for path in paths] == ["nees.csv", "nees.md", "nees.png"]
    lines = paths[0].read_text("utf-8").splitlines()
    assert len(lines) == 1 + len(results[0])
    assert lines[0].startswith("scene,imu,window,seeds,samples,mean")
    assert paths[1].read_text("utf-8").count("\n| room |") == 3
    assert 5_000 < paths[2].stat().st_size < 200_000


def test_the_whole_programme_is_as_large_as_asked_for():
    programme = consistency.studies(30)
    main = [study for study in programme if not study.imu][:3]
    assert [study.scene for study in main] == ["street_loop", "room", "corridor"]
    assert all(study.seeds == 30 and study.windows[:3] == (1, 10, 50) for study in main)
    assert {study.scene for study in programme if study.imu} == {study.scene for study in main}
    assert consistency.studies(2, first=100)[0].all_seeds == range(100, 102)
