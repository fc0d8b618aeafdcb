"""Several solvers on the same sweeps, and their scores."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from support.contenders import Sweeps
from support.quick import PREDICTED, QUICK
from support.trajectories import winding

from loam_gtsam.config import Config, config_from_dict, preset
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.mapper import make_solver
from loam_gtsam.pipeline import run
from loam_gtsam.studies import contenders
from loam_gtsam.studies.comparison import (
    Comparison,
    compare_solvers,
    frame_differences,
    score,
    score_all,
)
from loam_gtsam.studies.contenders import (
    METHODS,
    Contender,
    Group,
    MapSample,
    SolverRun,
    make_contender,
)
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.studies.peers import PEERS
from loam_gtsam.types import (
    BadSweep,
    ConfigError,
    DatasetError,
    FeatureSweep,
    FrameStatus,
    InputError,
    MapUpdate,
    Trajectory,
)

FRAMES = 6


def find_contender(name):
    """A solver that starts quickly, or a peer."""
    return make_contender(Group.PEER if name in PEERS else Group.SOLVER, name, QUICK)


def poses(run_or_result):
    return run_or_result.trajectory.map_T_lidar


def test_our_solver_gives_what_run_gives(dataset):
    alone = run(dataset, QUICK)
    result = compare_solvers(dataset, [find_contender("gtsam")])
    np.testing.assert_array_equal(poses(result.runs[0]), poses(alone))
    assert result.runs[0].map_points == len(alone.edge_points) + len(alone.plane_points)
    scores = score(result.runs[0], result.truth)
    assert scores.ate_m == absolute_error(alone.trajectory, dataset.truth).rmse
    assert scores.solved == 1.0
    assert scores.statuses == alone.status_counts
    assert scores.matches > 50
    assert scores.iterations >= 1


@pytest.mark.parametrize("group", [Group.SOLVER, Group.PRESET])
def test_with_an_imu_too_each_gives_what_run_gives(sweeps, world, group):
    """Each has its own IMU, blend or prior; the map of each is level."""
    dataset = Sweeps(sweeps, world.truth)
    dataset.imu = world.imu
    names = ("loam", "aloam") if group is Group.PRESET else ("gtsam", "loam", "aloam")
    result = compare_solvers(dataset, [make_contender(group, name, QUICK) for name in names])
    for name, entry in zip(names, result.runs, strict=True):
        np.testing.assert_array_equal(poses(entry), poses(run(dataset, entry.config)))
        tilts = {str(update.tilt_prior) for update in entry.updates[1:]}
        expected = {"gtsam": "equivalent", "aloam": "none"} if group is Group.PRESET else {
            "gtsam": "equivalent"}  # fmt: skip
        assert tilts == {expected.get(name, "blend")}
    if group is Group.SOLVER:
        told = [note for note in result.notes if "imu.prior blend" in note]
        assert len(told) == 2


def test_features_are_extracted_once_for_all(dataset, monkeypatch):
    calls = []
    real = contenders.extract
    monkeypatch.setattr(contenders, "extract", lambda *a: (calls.append(a), real(*a))[1])
    result = compare_solvers(dataset, [Contender(n, QUICK) for n in ("one", "two")])
    assert len(calls) == FRAMES
    np.testing.assert_array_equal(poses(result.runs[0]), poses(result.runs[1]))
    differences = frame_differences(result)
    assert list(differences) == ["two"]
    np.testing.assert_array_equal(differences["two"].frames, np.arange(FRAMES))
    assert differences["two"].metres.max() == 0.0


def test_shared_guess_gives_all_the_guesses_of_the_first(dataset):
    other = QUICK.changed("odometry.method=scan_to_scan")
    contenders = [Contender("velocity", QUICK), Contender("scan", other)]
    own, shared = (
        poses(compare_solvers(dataset, contenders, shared_guess=flag).runs[1])
        for flag in (False, True)
    )
    first = poses(compare_solvers(dataset, contenders[:1]).runs[0])
    # The two differ in their guesses only.
    np.testing.assert_allclose(shared, first, atol=1e-9)
    assert np.abs(own - first).max() > 1e-6


def test_solvers_differ_in_the_solver_and_presets_in_everything(dataset):
    base = config_from_dict({"features": {"sectors": 4}, "sensor": {"max_range": 80.0}})
    base = base.changed(PREDICTED)
    chosen = [make_contender(Group.SOLVER, name, base) for name in METHODS]
    chosen.append(make_contender(Group.PRESET, "loam", base))
    result = compare_solvers(dataset, chosen, max_frames=2)
    assert [entry.group for entry in result.runs] == [Group.SOLVER] * 3 + [Group.PRESET]
    for name, entry in zip(METHODS, result.runs, strict=False):
        same = entry.config.changed({"solver.method": "gtsam", "imu.prior": base.imu.prior})
        assert same == base.changed(sensor=entry.config.sensor)
        assert entry.config.solver.method == name
    loam = result.runs[-1].config
    assert loam.features == preset("loam").features
    assert loam.sensor == result.runs[0].config.sensor  # the same points for all
    assert result.notes == (
        "preset loam: section sensor is that of the first, so that all get the same points",
    )
    assert all(group.held_equal for group in Group)


def test_contenders_come_group_by_group(dataset, fake):
    mixed = [find_contender("gtsam"), find_contender("fake"), find_contender("loam")]
    result = compare_solvers(dataset, mixed, max_frames=1)
    assert [entry.name for entry in result.runs] == ["gtsam", "loam", "fake"]


def test_a_configuration_file_is_a_contender(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("map:\n  edge_voxel: 0.3\n")
    mine = make_contender(Group.CONFIG, str(file), Config())
    assert (mine.name, mine.config.map.edge_voxel) == ("mine", 0.3)


def test_solvers_must_be_known_and_have_different_names(dataset):
    for name in ("gtsm", "", "kiss"):
        with pytest.raises(ConfigError, match=r"unknown solver .*gtsam, loam, aloam.*--peer"):
            find_contender(name)
    for names in ([], ["gtsam", "gtsam"]):
        with pytest.raises(InputError, match="different names"):
            compare_solvers(dataset, [find_contender(name) for name in names])


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
    part = truth[:15]
    long, short = solver_run("long", truth), solver_run("short", part)
    assert (score(long, truth).lengths[0], score(short, truth).lengths[0]) == (1.0, 0.5)
    both = score_all(Comparison("x", (long, short), truth))
    assert both[0].lengths == both[1].lengths == score(short, truth).lengths
    assert both[0].rpe_percent == pytest.approx(0.0, abs=1e-9)
    assert score_all(Comparison("x", (long,), truth))[0].lengths[0] == 1.0
    without_truth = score_all(Comparison("x", (long, short), None))
    assert np.isnan(without_truth[0].ate_m)
    assert without_truth[1].ate_m == pytest.approx(0.0, abs=1e-9)


def test_recorded_features_are_for_ours_only(sweeps, fake):
    config = QUICK
    odometry = [gtsam.Pose3(gtsam.Rot3(), [0.1 * number, 0.0, 0.0]) for number in range(3)]
    features = [extract_features(scan, config) for scan in sweeps[:3]]
    data = Sweeps(list(map(FeatureSweep, features, odometry)))
    result = compare_solvers(data, [find_contender("gtsam")])
    np.testing.assert_array_equal(poses(result.runs[0]), poses(run(data, config)))
    assert [u.status for u in result.runs[0].updates][1:] == [FrameStatus.OK] * 2
    with pytest.raises(InputError, match="peers need the points of raw sweeps"):
        compare_solvers(data, [find_contender("gtsam"), find_contender("fake")])


def test_what_came_before_an_error_is_kept(sweeps):
    gtsam_alone = [find_contender("gtsam")]
    result = compare_solvers(Sweeps([*sweeps[:2], DatasetError("torn")]), gtsam_alone)
    assert str(result.error) == "torn"
    assert result.frames == 2
    for items, message in (([DatasetError("torn")], "torn"), ([], "no sweeps in it")):
        with pytest.raises(DatasetError, match=message):
            compare_solvers(Sweeps(items), gtsam_alone)


@pytest.mark.parametrize("name", ["gtsam", "fake"])
def test_no_sweep_is_read_beyond_max_frames(name, sweeps, fake):
    data = Sweeps([*sweeps[:2], DatasetError("this sweep must not be read")])
    result = compare_solvers(data, [find_contender(name)], max_frames=2)
    assert result.error is None
    assert result.frames == 2


class Recorder:
    """A user's own solver: the default one, and a count of its calls."""

    def __init__(self):
        self.inner, self.calls = make_solver(Config().solver), 0

    def solve(self, *arguments, **options):
        self.calls += 1
        return self.inner.solve(*arguments, **options)


@pytest.mark.parametrize("shared_guess", [False, True])
def test_a_user_s_own_solver_is_compared_with_the_others(dataset, shared_guess):
    own = Recorder()
    pair = [find_contender("gtsam"), Contender("own", QUICK, parts={"solver": own})]
    result = compare_solvers(dataset, pair, shared_guess=shared_guess)
    assert own.calls >= FRAMES - 1
    np.testing.assert_allclose(poses(result.runs[1]), poses(result.runs[0]), atol=1e-9)


def test_loops_are_closed_in_a_comparison_as_in_a_run(dataset):
    config = QUICK.changed("loops.enabled=true")
    found = compare_solvers(dataset, [Contender("loops", config)]).runs[0]
    np.testing.assert_array_equal(poses(found), poses(run(dataset, config)))
    assert "loops" in found.updates[-1].timings


def make_recorder(config):
    """A factory, as the command line names one."""
    return Recorder()


def make_front_end(config):
    return lambda scan: extract_features(scan, config)


def test_own_parts_by_name_give_what_the_package_gives(dataset):
    chosen = [
        find_contender("gtsam"),
        find_contender(f"{__name__}:make_recorder"),
        make_contender(Group.FEATURES, f"{__name__}:make_front_end", QUICK),
    ]
    result = compare_solvers(dataset, chosen)
    assert [entry.name for entry in result.runs] == ["gtsam", "make_recorder", "make_front_end"]
    for entry in result.runs[1:]:
        np.testing.assert_allclose(poses(entry), poses(result.runs[0]), atol=1e-9)


def raises(config):
    raise RuntimeError("no licence")


def number(config):
    return 3


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("nowhere.at.all:make", "solver nowhere.at.all:make: cannot be imported"),
        (f"{__name__}:absent", "cannot be imported"),
        (f"{__name__}:", "expected PACKAGE.MODULE:FACTORY"),
        (f"{__name__}:raises", "it raised RuntimeError: no licence"),
        (f"{__name__}:number", r"an object with the method solve\(\), got int"),
    ],
)
def test_a_wrong_factory_is_told(name, told):
    with pytest.raises(ConfigError, match=told):
        find_contender(name)


def test_what_is_off_by_more_than_is_told_is_counted(dataset):
    """The same run, held against a truth that drifts: the fault is in the numbers, not hidden."""
    (ours,) = compare_solvers(dataset, [find_contender("gtsam")]).runs
    good = score(ours, dataset.truth)
    assert good.beyond == 0
    assert 0.05 < good.nees < 5.0
    assert good.broken == 0
    poses = dataset.truth.map_T_lidar.copy()
    poses[:, 0, 3] += np.linspace(0.0, 2.0, len(poses))
    wrong = Trajectory(dataset.truth.stamps, poses)
    bad = score(ours, wrong)
    assert bad.beyond == FRAMES - 1
    assert bad.nees > 100.0
    assert bad.start_m > 1.5 * bad.ate_m
    assert (bad.statuses, bad.solved) == ({"first": 1, "ok": FRAMES - 1}, 1.0)


def test_maps_are_judged_by_the_same_points_at_the_poses_of_each(world, sweeps):
    """Truth makes the sharpest map, whatever moment of the sweeps its poses belong to."""
    sample = MapSample(Config())
    for sweep in sweeps:
        sample.add(sweep)
    sample.add(BadSweep(sweeps[-1].stamp + 1, "not read"))
    rng = np.random.default_rng(0)

    def quality(shift, noise):
        stamps = np.array([sweep.stamp + shift for sweep in sweeps], np.int64)
        stamps = np.clip(stamps, world.truth.stamps[0], world.truth.stamps[-1])
        exact = world.truth.at(stamps).map_T_lidar
        updates = []
        for stamp, pose in zip(stamps.tolist(), exact, strict=True):
            moved = gtsam.Pose3(pose).compose(gtsam.Pose3(gtsam.Rot3(), noise * rng.normal(size=3)))
            updates.append(MapUpdate(stamp, moved, FrameStatus.OK))
        return sample.quality(SolverRun("any", "1", None, tuple(updates), 0))

    start, end, bad = quality(0, 0.0), quality(50_000_000, 0.0), quality(0, 0.03)
    assert start.planes > 20
    assert end.thickness == pytest.approx(start.thickness, rel=0.15)
    assert bad.thickness > 1.2 * start.thickness
    assert bad.entropy > start.entropy + 0.1


def test_poses_that_make_no_map_have_no_numbers_of_one(dataset, fake):
    comparison = compare_solvers(dataset, [find_contender("gtsam"), find_contender("fake")])
    ours, drifts = score_all(comparison)
    assert 0.0 < ours.thickness_mm < 30.0
    assert 0.0 < ours.planar_share <= 1.0
    assert drifts.entropy > ours.entropy
    first, *_ = comparison.runs[1].updates
    for lost in ((first,), (first,) * FRAMES):  # one pose, and stamps that do not increase
        runs = comparison.runs[0], replace(comparison.runs[1], updates=lost)
        found = score_all(replace(comparison, runs=runs))[1]
        assert np.isnan([found.thickness_mm, found.planar_share, found.entropy]).all()
