"""Relative errors, several estimators on the same sweeps, and what ``compare`` writes of them."""

from __future__ import annotations

import csv
import importlib
import json
import os
import re
import signal
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from support.cli import loam
from support.list_dataset import ListDataset

from loam_gtsam.config import PRESETS, Config, config_from_dict
from loam_gtsam.datasets.base import DatasetInfo
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import run
from loam_gtsam.studies import contenders, peers
from loam_gtsam.studies.comparison import (
    Comparison,
    compare_solvers,
    frame_differences,
    score,
    score_all,
)
from loam_gtsam.studies.comparison_report import PICTURES, REPORT_FILE, TABLE_FILES
from loam_gtsam.studies.contenders import (
    Contender,
    SolverRun,
    find_contender,
    solver_names,
    timed_points,
)
from loam_gtsam.studies.evaluation import (
    absolute_error,
    path_lengths,
    pose_differences,
    relative_error,
)
from loam_gtsam.studies.peers import PEERS, Peer, PeerError, TimedPoints
from loam_gtsam.studies.report_html import write_report
from loam_gtsam.types import (
    BadSweep,
    ConfigError,
    DatasetError,
    FeatureSweep,
    FrameStatus,
    InputError,
    MapUpdate,
    OutputError,
    Scan,
    Trajectory,
)
from loam_gtsam.view import plots as visualization

FRAMES = 6
PLOTS = visualization.available()


# -- relative error --------------------------------------------------------------------------------


def winding(count=120, seed=0, step=1.0):
    """A path of even steps that turns about all axes."""
    rng = np.random.default_rng(seed)
    poses, at = [], gtsam.Pose3()
    for _ in range(count):
        poses.append(at.matrix())
        at = at.compose(gtsam.Pose3.Expmap(np.r_[rng.normal(0, 0.05, 3), step, 0.0, 0.0]))
    return Trajectory(np.arange(count) * 100_000_000, np.array(poses))


def disturbed(trajectory, seed=1, size=0.02):
    rng = np.random.default_rng(seed)
    noise = [gtsam.Pose3.Expmap(v).matrix() for v in rng.normal(0, size, (len(trajectory), 6))]
    return Trajectory(trajectory.stamps, trajectory.map_T_lidar @ np.array(noise))


def moved(trajectory, seed=3):
    """The same in another map frame."""
    other_T_map = gtsam.Pose3.Expmap(np.random.default_rng(seed).normal(size=6)).matrix()
    return Trajectory(trajectory.stamps, other_T_map @ trajectory.map_T_lidar)


def straight(count=200, scale=1.0, yaw_per_step=0.0):
    poses = np.tile(np.eye(4), (count, 1, 1))
    for n in range(count):
        poses[n, :3, :3] = gtsam.Rot3.Yaw(n * yaw_per_step).matrix()
        poses[n, 0, 3] = scale * n
    return Trajectory(np.arange(count) * 100_000_000, poses)


def test_relative_error_of_known_drifts():
    scaled = relative_error(straight(scale=1.01), straight(), np.array([9.5, 19.5]))
    # 9.5 m end at the pose 10 m on, where the error is 1 % of 10 m.
    np.testing.assert_allclose(scaled.translations, [100 * 0.1 / 9.5, 100 * 0.2 / 19.5])
    np.testing.assert_allclose(scaled.rotations, 0.0, atol=1e-7)
    np.testing.assert_array_equal(scaled.pairs, [190, 180])
    pooled = np.average(scaled.translations, weights=scaled.pairs)
    assert scaled.translation_percent == pytest.approx(pooled)
    turning = relative_error(straight(yaw_per_step=0.01), straight(), np.array([9.5]))
    assert turning.rotation_deg_per_m == pytest.approx(np.degrees(0.1) / 9.5)


def test_relative_error_does_not_depend_on_the_map_frame():
    truth = winding()
    one, other = (relative_error(e, truth) for e in (disturbed(truth), moved(disturbed(truth))))
    assert one.translation_percent > 0.1
    np.testing.assert_allclose(one.translations, other.translations, rtol=1e-9)
    np.testing.assert_allclose(one.rotations, other.rotations, rtol=1e-6)


def test_relative_error_is_that_of_the_kitti_kit_with_every_start():
    truth, estimate = winding(60), disturbed(winding(60))
    lengths = np.array([5.0, 10.0, 20.0])
    travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(truth.map_T_lidar[:, :3, 3], axis=0),
                                                    axis=1))]  # fmt: skip
    translations, rotations = [], []
    for length in lengths:
        for i in range(len(truth)):
            j = next((k for k in range(i, 60) if travelled[k] > travelled[i] + length), None)
            if j is None:
                continue
            wanted = np.linalg.inv(truth.map_T_lidar[i]) @ truth.map_T_lidar[j]
            found = np.linalg.inv(estimate.map_T_lidar[i]) @ estimate.map_T_lidar[j]
            error = np.linalg.inv(found) @ wanted
            translations.append(np.linalg.norm(error[:3, 3]) / length)
            rotations.append(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)) / length)
    result = relative_error(estimate, truth, lengths)
    assert result.pairs.sum() == len(translations)
    assert result.translation_percent == pytest.approx(100 * np.mean(translations), rel=1e-9)
    assert result.rotation_deg_per_m == pytest.approx(np.degrees(np.mean(rotations)), rel=1e-6)


def test_ate_and_rpe_are_those_of_evo():
    metrics = pytest.importorskip("evo.core.metrics")
    evo_path = pytest.importorskip("evo.core.trajectory").PosePath3D
    truth, estimate = winding(), moved(disturbed(winding()))
    reference, other = (evo_path(poses_se3=list(t.map_T_lidar)) for t in (truth, estimate))
    for length in (4.6, 9.6):
        # evo takes the nearest pose, KITTI the first beyond: with steps just below 1 m these are
        # one and the same for the lengths here.
        found = relative_error(estimate, truth, np.array([length]))
        for relation, ours in (
            (metrics.PoseRelation.translation_part, found.translations[0] * length / 100.0),
            (metrics.PoseRelation.rotation_angle_deg, found.rotations[0] * length),
        ):
            rpe = metrics.RPE(relation, length, metrics.Unit.meters, 0.5 / length, True, True)
            rpe.process_data((reference, other))
            assert len(rpe.error) == found.pairs[0]
            assert ours == pytest.approx(float(np.mean(rpe.error)), rel=1e-6)
    other.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, other))
    assert absolute_error(estimate, truth).rmse == pytest.approx(
        ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-9
    )


@pytest.mark.parametrize(
    ("path", "unit"), [(1600.0, 100.0), (5000.0, 100.0), (1599.0, 50.0), (21.4, 1.0), (1.6, 0.1)]
)
def test_lengths_fit_the_path(path, unit):
    np.testing.assert_allclose(path_lengths(path), unit * np.arange(1, 9))


def test_a_short_path_needs_lengths():
    short = winding(15, step=0.1)
    with pytest.raises(InputError, match=r"path of 1\.6 m or more is needed .* has 1\.4 m"):
        relative_error(short, short)
    assert relative_error(short, short, np.array([0.5])).pairs[0] > 0
    with pytest.raises(InputError, match=r"lengths below the path of 1\.4 m, got 3"):
        relative_error(short, short, np.array([3.0]))
    # One length that fits is enough; the other one has no number.
    both = relative_error(disturbed(short), short, np.array([0.5, 3.0]))
    assert np.isnan(both.translations[1])
    assert both.translation_percent == both.translations[0]


def test_relative_error_needs_poses_in_common():
    later = Trajectory(winding().stamps + 10**12, winding().map_T_lidar)
    for metric in (relative_error, pose_differences):
        with pytest.raises(InputError, match="3 or more poses"):
            metric(later, winding())


def test_pose_differences_are_seen_from_the_first_common_pose():
    truth = winding()
    _, metres, degrees = pose_differences(moved(truth), truth)
    assert len(metres) == len(truth)
    np.testing.assert_allclose(metres, 0.0, atol=1e-9)
    np.testing.assert_allclose(degrees, 0.0, atol=1e-5)
    poses = truth.map_T_lidar.copy()
    shift = gtsam.Pose3(gtsam.Rot3.Yaw(0.1), [0.3, 0.0, 0.4]).matrix()
    poses[5] = poses[5] @ shift
    _, metres, degrees = pose_differences(Trajectory(truth.stamps, poses), truth)
    np.testing.assert_allclose(metres[4:7], [0.0, 0.5, 0.0], atol=1e-9)
    np.testing.assert_allclose(degrees[4:7], [0.0, np.degrees(0.1), 0.0], atol=1e-5)


# -- several estimators on the same sweeps ---------------------------------------------------------


class Sweeps(ListDataset):
    """With truth, and a name that looks like markup."""

    name = "a <b>list</b> [red]"

    def __init__(self, items, truth=None):
        super().__init__(items)
        self.truth = truth

    def info(self):
        return DatasetInfo("list", "nowhere")


class FakePeer(Peer):
    """Moves a metre a sweep; raises at sweep ``fails_at``."""

    name, package, module = "fake", "fake", "fake"
    fails_at: int | None = None

    @property
    def map_points(self):
        return 7

    def _register(self, stamp, sweep):
        if len(self.poses) == self.fails_at:
            raise RuntimeError("cannot [go] on")
        pose = np.eye(4)
        pose[0, 3] = len(self.poses)
        return pose, 0.0


@pytest.fixture(scope="module")
def world() -> SimulatedWorld:
    return SimulatedWorld("room", frames=FRAMES, columns=450)


@pytest.fixture(scope="module")
def sweeps(world) -> list[Scan]:
    return list(world)


@pytest.fixture
def dataset(world, sweeps) -> ListDataset:
    return Sweeps(sweeps, world.truth)


@pytest.fixture
def fake(monkeypatch) -> type[FakePeer]:
    monkeypatch.setitem(PEERS, "fake", FakePeer)
    monkeypatch.setattr(FakePeer, "fails_at", None)
    return FakePeer


def poses(run_or_result):
    return run_or_result.trajectory.map_T_lidar


def test_our_solver_gives_what_run_gives(dataset):
    alone = run(dataset, Config())
    result = compare_solvers(dataset, [find_contender("gtsam")])
    np.testing.assert_array_equal(poses(result.runs[0]), poses(alone))
    again = compare_solvers(dataset, [find_contender("gtsam")])
    np.testing.assert_array_equal(poses(result.runs[0]), poses(again.runs[0]))
    assert result.runs[0].map_points == len(alone.edge_points) + len(alone.plane_points)
    scores = score(result.runs[0], result.truth)
    assert scores.ate_m == absolute_error(alone.trajectory, dataset.truth).rmse
    assert scores.solved == FRAMES - 1
    assert scores.matches > 50
    assert scores.iterations >= 1


@pytest.mark.parametrize("names", [("gtsam", "loam", "aloam"), ("loam", "gtsam")])
def test_with_an_imu_too_each_gives_what_run_gives(sweeps, world, names):
    """Each has its own IMU, blend or prior, and de-skew; the map of each is level."""
    dataset = Sweeps(sweeps, world.truth)
    dataset.imu = world.imu
    result = compare_solvers(dataset, [find_contender(name) for name in names])
    for name, entry in zip(names, result.runs, strict=True):
        assert entry.config.deskew.rotation == find_contender(name).config.deskew.rotation
        alone = run(dataset, entry.config)
        np.testing.assert_array_equal(poses(entry), poses(alone))
        tilts = {str(update.tilt_prior) for update in entry.updates[1:]}
        assert tilts == {{"gtsam": "equivalent", "loam": "blend", "aloam": "none"}[name]}
        motions = {str(update.sweep_motion) for update in entry.updates}
        assert motions == {"gyro" if name == "gtsam" else "constant_velocity"}


def test_what_one_learns_of_the_gyro_is_not_told_to_the_next(sweeps, world):
    dataset = Sweeps(sweeps, world.truth)
    dataset.imu = world.imu
    runs = compare_solvers(dataset, [Contender(name, Config()) for name in "ab"]).runs
    np.testing.assert_array_equal(poses(runs[0]), poses(runs[1]))
    for one, other in zip(runs[0].updates, runs[1].updates, strict=True):
        np.testing.assert_array_equal(one.twist, other.twist)


def test_features_are_extracted_once_for_all(dataset, monkeypatch):
    calls = []
    real = contenders.extract_features
    monkeypatch.setattr(contenders, "extract_features", lambda *a: (calls.append(a), real(*a))[1])
    result = compare_solvers(dataset, [Contender(n, Config()) for n in ("one", "two")])
    assert len(calls) == FRAMES
    np.testing.assert_array_equal(poses(result.runs[0]), poses(result.runs[1]))
    differences = frame_differences(result)
    assert list(differences) == ["two"]
    np.testing.assert_array_equal(differences["two"].frames, np.arange(FRAMES))
    assert differences["two"].metres.max() == 0.0


def test_shared_guess_gives_all_the_guesses_of_the_first(dataset):
    other = config_from_dict({"odometry": {"method": "scan_to_scan"}})
    contenders = [Contender("velocity", Config()), Contender("scan", other)]
    own, shared = (
        poses(compare_solvers(dataset, contenders, shared_guess=flag).runs[1])
        for flag in (False, True)
    )
    first = poses(compare_solvers(dataset, contenders[:1]).runs[0])
    # The two differ in their guesses only.
    np.testing.assert_allclose(shared, first, atol=1e-9)
    assert np.abs(own - first).max() > 1e-6


def test_what_decides_the_features_is_that_of_the_first(dataset):
    other = config_from_dict(
        {"features": {"sectors": 4}, "deskew": {"reference": "end", "refine": False}}
    )
    result = compare_solvers(
        dataset, [Contender("a", Config()), Contender("b", other)], max_frames=2
    )
    used = result.runs[1].config
    assert used.features == Config().features
    assert used.deskew == other.deskew.changed(reference="start")
    assert result.notes == (
        "b: section features is that of a, so that all get the same features at the same moments",
        "b: section deskew is that of a, so that all get the same features at the same moments",
    )
    assert compare_solvers(dataset, [Contender("a", Config())], max_frames=2).notes == ()


def test_all_presets_are_solvers(dataset):
    names = [name for name in solver_names() if name not in PEERS]
    assert names[0] == "gtsam"
    assert [find_contender(name).config for name in names] == list(PRESETS.values())
    result = compare_solvers(dataset, [find_contender(name) for name in names], max_frames=3)
    for entry in result.runs:
        assert score(entry, result.truth).ate_m < 0.1, entry.name


def test_a_configuration_file_is_a_solver(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("map:\n  edge_voxel: 0.3\n")
    mine = find_contender(str(file))
    assert mine.name == "mine"
    assert mine.config.map.edge_voxel == 0.3


@pytest.mark.parametrize("name", ["gtsm", "", "kiss"])
def test_unknown_solvers_are_refused(name):
    with pytest.raises(ConfigError, match=r"unknown solver .*gtsam, .*kiss-icp.*\.yaml"):
        find_contender(name)


@pytest.mark.parametrize("names", [[], ["gtsam", "gtsam"]])
def test_solvers_must_have_different_names(dataset, names):
    with pytest.raises(InputError, match="different names"):
        compare_solvers(dataset, [find_contender(name) for name in names])


def test_peers_that_disturb_each_other_are_not_run_together(dataset, fake, monkeypatch):
    monkeypatch.setitem(PEERS, "other", type("Other", (FakePeer,), {"name": "other"}))
    both = [find_contender("fake"), find_contender("other")]
    assert len(compare_solvers(dataset, both, max_frames=1).runs) == 2
    monkeypatch.setattr(fake, "alone", True)
    with pytest.raises(InputError, match="instances of fake in one process disturb each other"):
        compare_solvers(dataset, both)
    assert len(compare_solvers(dataset, [find_contender("gtsam"), both[0]], max_frames=1).runs) == 2
    assert PEERS["genz-icp"].alone
    assert not PEERS["kiss-icp"].alone


def test_bad_sweeps_reach_every_solver(sweeps, fake):
    late = replace(sweeps[1], stamp=sweeps[0].stamp)
    empty = replace(sweeps[3], points=np.full_like(sweeps[3].points, np.nan))
    items = [sweeps[0], BadSweep(sweeps[1].stamp, "torn"), sweeps[2], late, empty, sweeps[4]]
    result = compare_solvers(Sweeps(items), [find_contender("gtsam"), find_contender("fake")])
    ours, theirs = ([str(u.status) for u in entry.updates] for entry in result.runs)
    assert theirs == ["ok", "unusable_scan", "ok", "bad_stamp", "unusable_scan", "ok"]
    assert ours[1] == ours[4] == "unusable_scan"
    assert ours[3] == "bad_stamp"
    assert ours[2] == ours[5] == "ok"
    assert result.runs[1].used == (0, 2, 5)
    np.testing.assert_array_equal(poses(result.runs[1])[:, 0, 3], [0.0, 1.0, 2.0])
    assert result.runs[1].updates[1].message == "torn"


def test_a_peer_that_fails_does_not_cost_the_others(dataset, fake, monkeypatch):
    monkeypatch.setattr(fake, "fails_at", 2)
    result = compare_solvers(dataset, [find_contender("fake"), find_contender("gtsam")])
    theirs, ours = result.runs
    assert theirs.problem == "ended at frame 2: RuntimeError: cannot [go] on"
    assert len(theirs.trajectory) == 2
    assert score(theirs, result.truth).problem.startswith("ended at frame 2")
    assert len(theirs.updates) == len(ours.updates) == FRAMES
    assert ours.problem == ""
    assert score(ours, None).problem == ""


def test_relative_errors_of_all_are_over_the_same_lengths():
    def solver_run(name, trajectory):
        updates = tuple(
            MapUpdate(int(stamp), gtsam.Pose3(pose), FrameStatus.OK)
            for stamp, pose in zip(trajectory.stamps, trajectory.map_T_lidar, strict=True)
        )
        return SolverRun(name, "1", None, updates, 0)

    truth = winding(20)
    part = Trajectory(truth.stamps[:15], truth.map_T_lidar[:15])
    long, short = solver_run("long", truth), solver_run("short", part)
    assert score(long, truth).lengths[0] == 1.0
    assert score(short, truth).lengths[0] == 0.5
    both = score_all(Comparison("x", (long, short), truth))
    assert both[0].lengths == both[1].lengths == score(short, truth).lengths
    assert both[0].rpe_percent == pytest.approx(0.0, abs=1e-9)
    alone = score_all(Comparison("x", (long,), truth))
    assert alone[0].lengths[0] == 1.0
    without_truth = score_all(Comparison("x", (long, short), None))
    assert np.isnan(without_truth[0].ate_m)
    assert without_truth[1].ate_m == pytest.approx(0.0, abs=1e-9)


def test_recorded_features_are_for_ours_only(sweeps, fake):
    config = Config()
    recorded = []
    for number, scan in enumerate(sweeps[:3]):
        features = contenders.extract_features(scan, config)
        odom = gtsam.Pose3(gtsam.Rot3(), [0.1 * number, 0.0, 0.0])
        recorded.append(FeatureSweep(features, odom))
    data = Sweeps(recorded)
    result = compare_solvers(data, [find_contender("gtsam")])
    np.testing.assert_array_equal(poses(result.runs[0]), poses(run(data, config)))
    assert [u.status for u in result.runs[0].updates][1:] == [FrameStatus.OK] * 2
    with pytest.raises(InputError, match="peers need the points of raw sweeps"):
        compare_solvers(data, [find_contender("gtsam"), find_contender("fake")])


def test_without_sweeps_there_is_nothing_to_compare():
    with pytest.raises(DatasetError, match="no sweeps in it"):
        compare_solvers(Sweeps([]), [find_contender("gtsam")])


def test_what_came_before_an_error_is_kept(sweeps):
    result = compare_solvers(Sweeps([*sweeps[:2], DatasetError("torn")]), [find_contender("gtsam")])
    assert str(result.error) == "torn"
    assert result.frames == 2
    with pytest.raises(DatasetError, match="torn"):
        compare_solvers(Sweeps([DatasetError("torn")]), [find_contender("gtsam")])


# -- peers -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*PEERS])
def test_a_peer_that_is_not_installed_is_told_how(name, monkeypatch):
    def missing(module):
        raise ModuleNotFoundError(f"No module named {module!r}")

    monkeypatch.setattr(peers.importlib, "import_module", missing)
    with pytest.raises(
        PeerError, match=rf"{name} cannot be imported .*pip install {PEERS[name].package}"
    ):
        peers.make_peer(name)


def test_an_unknown_peer_is_refused():
    with pytest.raises(PeerError, match=r"unknown peer 'x' \(known: genz-icp, "):
        peers.make_peer("x")


@pytest.mark.parametrize("name", [*PEERS])
def test_peers_find_the_path(name, world, sweeps):
    pytest.importorskip(PEERS[name].module)
    result = compare_solvers(Sweeps(sweeps, world.truth), [find_contender(name)])
    scores = score(result.runs[0], result.truth)
    assert result.runs[0].problem == ""
    assert scores.ate_m < 0.1 * result.truth.path_length + 0.02
    assert scores.map_points > 100
    assert scores.ms_median > 0.0
    assert np.isnan(scores.iterations)


@pytest.mark.parametrize(("name", "moment"), [("kiss-icp", 1.0), ("genz-icp", 0.5)])
def test_peers_de_skew_to_the_moment_their_pose_is_said_to_belong_to(name, moment, sweeps):
    pytest.importorskip(PEERS[name].module)
    peer = peers.make_peer(name)
    package = PEERS[name].module
    settings = peer._icp.config
    preprocess = importlib.import_module(f"{package}.preprocess").get_preprocessor(settings)
    forward = np.eye(4)
    forward[0, 3] = 1.0
    # The point at that share of the sweep is left where it was.
    points, times = np.full((5, 3), 5.0), np.linspace(0.0, 1.0, 5)
    kept = preprocess.preprocess(points, times, forward)[:, 0]
    np.testing.assert_allclose(kept, 5.0 + times - moment)
    sweep = timed_points(sweeps[0], Config())
    pose = peer.register(1000, sweep)
    first, last = sweep.times.min(), sweep.times.max()
    assert pose.stamp == 1000 + round((first + moment * (last - first)) * 1e9)
    same = replace(sweep, times=np.zeros(len(sweep.times)))
    with pytest.raises(InputError, match="different times"):
        peer.register(2000, same)


@pytest.mark.parametrize("name", ["small-gicp", "kiss-icp-no-deskew", "genz-icp-no-deskew"])
def test_poses_of_the_others_belong_to_the_middle(name, sweeps):
    pytest.importorskip(PEERS[name].module)
    sweep = timed_points(sweeps[0], Config())
    pose = peers.make_peer(name).register(1000, TimedPoints(
        sweep.points, sweep.times, (0.0, 0.1)))  # fmt: skip
    assert pose.stamp == 1000 + 50_000_000


# -- the command -----------------------------------------------------------------------------------


@pytest.fixture
def command(tmp_path, monkeypatch, dataset):
    """``compare`` on a list of sweeps, in an empty folder and a wide screen."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.setattr("loam_gtsam.datasets.open_dataset", lambda *a, **k: dataset)
    return lambda *arguments: loam("compare", "x", *arguments)


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_command_writes_tables_pictures_and_report(command, fake, world):
    result = command("--solver", "gtsam", "--solver", "fake", "--output", "out", "--set",
                     "solver.iterations=3")  # fmt: skip
    assert result.exit_code == 0, result.output
    names = {path.name for path in Path("out").iterdir()}
    pictures = set(PICTURES) if PLOTS else set()
    assert names == {
        *TABLE_FILES,
        *pictures,
        REPORT_FILE,
        "trajectory_gtsam.tum",
        "trajectory_fake.tum",
        "truth.tum",
    }
    table = rows("out/comparison.csv")
    assert [row["solver"] for row in table] == ["gtsam", "fake"]
    expected = absolute_error(read_tum("out/trajectory_gtsam.tum"), world.truth)
    assert float(table[0]["ate_m"]) == pytest.approx(expected.rmse, abs=1e-7)
    assert table[1]["iterations"] == ""
    summary = json.loads(Path("out/comparison.json").read_text())
    assert summary["reference"] == "truth"
    assert summary["solvers"][0]["scores"]["ate_m"] == pytest.approx(expected.rmse, abs=1e-7)
    assert summary["solvers"][0]["config"]["solver"]["iterations"] == 3
    assert summary["solvers"][1]["scores"]["iterations"] is None
    assert summary["solvers"][1]["difference_m"][2] > 1.0
    frames = rows("out/frames.csv")
    assert len(frames) == 2 * FRAMES
    assert {row["difference_m"] for row in frames if row["solver"] == "gtsam"} == {""}
    assert frames[FRAMES + 2]["x"] == "2"
    for text in ("ATE [m]", "fake", "Difference from gtsam", "errors against truth"):
        assert text in result.output


def test_report_is_one_file_with_everything_escaped(command, fake):
    assert command("--solver", "gtsam", "--solver", "fake", "--output", "out").exit_code == 0
    page = Path("out/report.html").read_text()
    assert "a &lt;b&gt;list&lt;/b&gt; [red]" in page
    assert "<b>list" not in page
    assert 'src="http' not in page
    assert "href" not in page
    assert page.count("data:image/png;base64,") == (4 if PLOTS else 0)
    assert len(re.findall("<tr>", page)) == 3
    assert 'class="best"' in page


def test_without_truth_the_first_solver_is_the_reference(command, dataset, fake):
    dataset.truth = None
    result = command("--solver", "gtsam", "--solver", "fake", "--no-plot", "--output", "out")
    assert result.exit_code == 0, result.output
    assert "errors against gtsam" in result.output
    ours, theirs = rows("out/comparison.csv")
    assert ours["ate_m"] == ""
    assert float(theirs["ate_m"]) > 0.0
    names = {path.name for path in Path("out").iterdir()}
    assert not names & {"truth.tum", *PICTURES}


def test_an_earlier_comparison_is_kept_unless_told(command):
    arguments = ("--solver", "gtsam", "--frames", 2, "--no-plot")
    for folder in ("a_b_list_b_red_compare", "a_b_list_b_red_compare-2"):
        assert command(*arguments).exit_code == 0
        assert (Path("loam_gtsam_output") / folder / "report.html").is_file()
    left = Path("loam_gtsam_output/a_b_list_b_red_compare/trajectory_other.tum")
    left.write_text("of another solver")
    assert command(*arguments, "--overwrite").exit_code == 0
    assert not left.exists()
    assert len(list(Path("loam_gtsam_output").iterdir())) == 2


def test_a_missing_peer_is_one_line(command, monkeypatch):
    monkeypatch.setattr(PEERS["kiss-icp"], "module", "no_such_module_of_a_peer")
    result = command("--solver", "gtsam", "--solver", "kiss-icp")
    assert result.exit_code == 1
    assert "pip install kiss-icp" in result.output
    assert "Traceback" not in result.output


def test_an_error_on_the_way_leaves_what_was_computed(command, dataset):
    dataset.items = [*dataset.items[:3], DatasetError("the disk is gone")]
    result = command("--solver", "gtsam", "--no-plot", "--output", "out")
    assert result.exit_code == 1
    assert "the disk is gone" in result.output
    assert len(rows("out/frames.csv")) == 3
    assert "disk" in json.loads(Path("out/comparison.json").read_text())["error"]


def test_ctrl_c_ends_it_between_two_sweeps(command, dataset, fake, monkeypatch):
    real = FakePeer._register

    def interrupting(self, stamp, sweep):
        if len(self.poses) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return real(self, stamp, sweep)

    monkeypatch.setattr(FakePeer, "_register", interrupting)
    # A test run in the background inherits an ignored SIGINT, which the command respects.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        result = command("--solver", "fake", "--solver", "gtsam", "--no-plot", "--output", "out")
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.exit_code == 130, result.output
    assert "Stopped by SIGINT after frame 3 of 6" in result.output
    assert [row["frame"] for row in rows("out/frames.csv")] == ["0", "1", "2"] * 2
    assert json.loads(Path("out/comparison.json").read_text())["interrupted"] is True


def test_sweeps_nobody_can_use_are_an_error(command, dataset):
    dataset.items = [BadSweep(n, "torn") for n in range(3)]
    result = command("--solver", "gtsam", "--no-plot")
    assert result.exit_code == 1
    assert "no solver could use any of the 3 sweeps; the first: torn" in result.output


# -- pictures and page -----------------------------------------------------------------------------


@pytest.mark.skipif(not PLOTS, reason="no matplotlib")
def test_pictures_show_every_solver(tmp_path):
    image = pytest.importorskip("matplotlib.image")
    first, second = visualization._RUN_COLOURS[:2]

    def shows(name: str, colour: str) -> bool:
        rgb = [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
        pixels = image.imread(tmp_path / name)[..., :3]
        return bool((np.abs(pixels - rgb).max(axis=2) < 0.02).sum() > 50)

    paths = {"a": winding(), "b": disturbed(winding(), size=0.3)}
    visualization.plot_trajectories(tmp_path / "two.png", paths, winding())
    visualization.plot_trajectories(tmp_path / "one.png", {"a": winding()})
    assert shows("two.png", first)
    assert shows("two.png", second)
    assert shows("two.png", visualization.TRUTH)
    assert shows("one.png", first)
    assert not shows("one.png", second)
    x = np.arange(50)
    curves = {"a": (x, 1.0 + x), "b": (x, 60.0 - x)}
    visualization.plot_curves(tmp_path / "c.png", {"y": curves, "z": curves}, "x", log=True)
    assert shows("c.png", first)
    assert shows("c.png", second)
    visualization.plot_stages(tmp_path / "s.png", {"a": {"match": 3.0}, "b": {"other": 2.0}})
    assert shows("s.png", visualization._STAGE_COLOURS[0])
    assert shows("s.png", visualization._STAGE_COLOURS[1])


def test_a_picture_that_is_gone_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match=r"no\.png: cannot read the picture"):
        write_report(
            tmp_path / "r.html", "t", [], ["a"], [["1"]], [], {}, {"x": tmp_path / "no.png"}, {}
        )
    assert not (tmp_path / "r.html").exists()
