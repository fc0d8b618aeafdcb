"""Whole runs on the built-in world: accuracy, interruption, determinism, recorded odometry."""

import pickle
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.list_dataset import ListDataset
from support.quick import QUICK, begin_quickly

from loam_gtsam import pipeline as pipeline_module
from loam_gtsam.config import Config, ImuConfig, preset
from loam_gtsam.datasets.arrays import ArrayDataset
from loam_gtsam.datasets.decode.aiding import GnssFixes
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.factors import checked_factor
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.geometry import move_points
from loam_gtsam.imu_prior import roll_pitch
from loam_gtsam.pipeline import Pipeline, effective_config, imu_buffer, run
from loam_gtsam.registration.odometry import ConstantVelocity
from loam_gtsam.registration.solvers import POSE_KEY, make_solver
from loam_gtsam.studies.evaluation import absolute_error, squared_errors
from loam_gtsam.types import (
    BadSweep,
    ConfigError,
    DatasetError,
    Features,
    FeatureSweep,
    FrameStatus,
    ImuSamples,
    InputError,
    PartError,
    SweepMotion,
)


@pytest.mark.parametrize(
    ("scene", "frames", "limit"),
    [("room", 12, 0.01), ("street_loop", 20, 0.02), ("corridor", 24, 0.03), ("trees", 16, 0.05)],
)
def test_scene_is_mapped_to_centimetres(scene, frames, limit):
    world = SimulatedWorld(scene, frames=frames, columns=600)
    result = run(world)
    assert absolute_error(result.trajectory, world.truth).rmse < limit
    assert result.status_counts["first"] == 1
    assert sum(update.status.solved for update in result.updates) == frames - 1
    assert len(result.edge_points) > 100
    assert len(result.plane_points) > 1000


@pytest.mark.parametrize("sensor", ["hdl32", "os1-128"])
def test_denser_sensors(sensor):
    world = SimulatedWorld("street_loop", sensor=sensor, frames=12, columns=300)
    result = run(world)
    assert absolute_error(result.trajectory, world.truth).rmse < 0.01


def test_scan_to_scan_guess_maps_as_well(monkeypatch):
    begin_quickly(monkeypatch)
    world = SimulatedWorld("street_loop", frames=22, columns=450)
    config = Config().changed("odometry.method=scan_to_scan")
    result = run(world, config)
    assert absolute_error(result.trajectory, world.truth).rmse < 0.03
    assert result.updates[5].timings["odometry"] > 0.0


@pytest.mark.parametrize("copied", [deepcopy, lambda result: pickle.loads(pickle.dumps(result))])
@pytest.mark.parametrize("config", [QUICK.changed("loops.enabled=true"), Config()])
def test_a_copy_of_a_result_goes_on_as_the_result_does(copied, config):
    world = SimulatedWorld("room", frames=6, columns=300, imu="six_axis")
    result = run(world, config, max_frames=5)
    copy = copied(result)
    before = copy.trajectory.map_T_lidar
    np.testing.assert_array_equal(before, result.trajectory.map_T_lidar)
    poses = [each.pipeline.process(world[5]).map_T_lidar.matrix() for each in (copy, result)]
    np.testing.assert_array_equal(*poses)
    assert copy.pipeline.mapper.imu.buffer is not result.pipeline.mapper.imu.buffer


def test_max_frames_and_on_frame():
    seen = []
    result = run(
        SimulatedWorld("room", frames=4, columns=300),
        QUICK,
        max_frames=3,
        on_frame=lambda number, update: seen.append((number, update.status)),
    )
    assert [number for number, _ in seen] == [0, 1, 2]
    assert len(result.updates) == 3
    assert set(result.updates[2].timings) == {
        "read", "features", "odometry", "prepare", "match", "solve", "insert", "covariance",
    }  # fmt: skip


def test_interruption_keeps_what_was_computed():
    scans = list(SimulatedWorld("room", frames=3, columns=300))
    result = run(ListDataset([*scans, KeyboardInterrupt()]), QUICK)
    assert result.interrupted
    assert len(result.trajectory) == 3
    assert len(result.plane_points) > 0


def test_an_error_in_the_data_is_raised_or_kept_with_the_partial_result():
    scans = list(SimulatedWorld("room", frames=2, columns=300))
    broken = ListDataset([*scans, DatasetError("disk gone")])
    with pytest.raises(DatasetError, match="disk gone"):
        run(broken, QUICK)
    result = run(broken, QUICK, keep_partial=True)
    assert len(result.updates) == 2
    assert isinstance(result.error, DatasetError)


def test_a_run_whose_fixes_cannot_be_tied_is_kept(monkeypatch):
    def fails(*_):
        raise PartError("graph", "factors", ValueError("mine"))

    monkeypatch.setattr(pipeline_module, "tie", fails)
    scans = list(SimulatedWorld("room", frames=2, columns=300))
    fixes = GnssFixes(np.array([scan.stamp for scan in scans]), [[47.5, 8.5, 450.0]] * 2)
    dataset, config = ArrayDataset(scans, gnss=fixes), QUICK.changed("aiding.gnss=true")
    with pytest.raises(PartError, match="mine"):
        run(dataset, config)
    result = run(dataset, config, keep_partial=True)
    assert len(result.updates) == 2
    assert isinstance(result.error, PartError)


def test_same_input_same_bits_at_any_speed():
    world = SimulatedWorld("street_loop", frames=6, columns=300)
    whole = run(world)
    pipeline = Pipeline(whole.config, imu=imu_buffer(world, whole.config))
    single = [pipeline.process(scan) for scan in world]
    for a, b in zip(whole.updates, single, strict=True):
        assert np.array_equal(a.map_T_lidar.matrix(), b.map_T_lidar.matrix())
        assert np.array_equal(a.information, b.information)
        assert (a.status, a.n_plane_matches) == (b.status, b.n_plane_matches)
    assert np.array_equal(whole.plane_points, pipeline.mapper.map_points()[1])


def test_recorded_odometry_is_the_guess(monkeypatch):
    """Features of another front end, its odometry drifting in a frame of its own."""
    begin_quickly(monkeypatch)
    world = SimulatedWorld("street_loop", frames=31, columns=600)
    truth = world.truth.map_T_lidar
    start = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 2.0), np.array([5.0, 6.0, 7.0]))
    drift = gtsam.Pose3.Expmap(np.array([0.0, 0.0, 0.002, 0.02, 0.01, 0.0]))
    items, odom = [], start
    for i in range(30):
        scan = world[i]
        features = extract_features(scan, Config())
        step = gtsam.Pose3(np.linalg.inv(truth[i]) @ truth[i + 1])
        twist = gtsam.Pose3.Logmap(step) * 10.0
        edges = move_points(features.edges, twist, features.edge_times)
        planes = move_points(features.planes, twist, features.plane_times)
        items.append(FeatureSweep(Features.from_points(scan.stamp, edges, planes), odom))
        odom = odom.compose(step).compose(drift)
    result = run(ListDataset(items))
    assert absolute_error(result.trajectory, world.truth).rmse < 0.03
    guessed = start.between(items[-1].odom_T_lidar).translation()
    assert np.linalg.norm(guessed - truth[29][:3, 3]) > 0.3  # without the map it drifts


def test_what_the_data_set_implies_yields_to_the_user():
    data = ListDataset([])
    data.sensor = {"stamp": "middle", "spin": "clockwise"}
    assert effective_config(Config(), data).sensor.stamp == "middle"
    mine = Config().changed("sensor.stamp=end")
    sensor = effective_config(mine, data).sensor
    assert (sensor.stamp, sensor.spin) == ("end", "clockwise")


def test_what_is_no_data_set_and_no_sweep_is_told():
    with pytest.raises(
        InputError, match="got str without 'name', 'sensor', 'imu'; open_dataset ma"
    ):
        run("somewhere")
    with pytest.raises(InputError, match="expected a Config, got str 'loam'; preset"):
        run(SimulatedWorld("room", frames=1), "loam")
    with pytest.raises(InputError, match="expected a Scan, got ndarray"):
        Pipeline().process(np.zeros((5, 3)))


@pytest.mark.parametrize(
    ("sensor", "error", "said"),
    [
        ({"minrange": 2}, ConfigError, "sensor of the data set: minrange: .* mean 'min_range'"),
        ({"sensor.min_range": 2}, ConfigError, "did you mean 'min_range'"),
        ({"imu.prior": 2}, ConfigError, "sensor of the data set: prior: expected one of"),
        ({5: 2}, ConfigError, "sensor of the data set: 5: unknown key"),
        (None, InputError, "sensor of the data set: expected a Mapping, got NoneType"),
    ],
)
def test_what_a_data_set_implies_by_mistake_is_told(sensor, error, said):
    data = ListDataset([])
    data.sensor = sensor
    with pytest.raises(error, match=said):
        run(data)


@pytest.mark.parametrize("number", [-1, 2.0, "2"])
def test_a_number_of_sweeps_that_is_none_is_told(number):
    with pytest.raises(InputError, match=f"max_frames: expected a whole number, .* {number!r}"):
        run(ListDataset([]), max_frames=number)


def test_a_result_is_shown_in_a_line():
    result = run(SimulatedWorld("room", frames=2, columns=450), QUICK)
    assert repr(result).startswith("RunResult(2 updates: 1 first, 1 ok; ")
    assert len(repr(result)) < 100


def test_an_empty_data_set_is_an_empty_result():
    result = run(ListDataset([]))
    assert result.updates == ()
    assert len(result.trajectory) == 0
    assert result.edge_points.shape == (0, 3)


# -- bad sweeps in the middle of a run ---------------------------------------------------------


def part(scan, keep):
    return replace(scan, points=scan.points[keep], times=scan.times[keep], rings=scan.rings[keep])


BROKEN = {
    "0 points": lambda scan: part(scan, slice(0)),
    "0 finite": lambda scan: replace(scan, points=np.full_like(scan.points, np.nan)),
    "1 ring": lambda scan: part(scan, scan.rings == 3),
    "sweep of 10 points": lambda scan: part(scan, slice(10)),
    "range": lambda scan: replace(scan, points=scan.points * np.float32(1e-4)),
    "000003.bin": lambda scan: BadSweep(scan.stamp, "000003.bin: 7 bytes left over"),
    "is not later": lambda scan: replace(scan, stamp=scan.stamp - 100_000_000),
    "0 ns is not later": lambda scan: replace(scan, stamp=0),
}
"""What may be wrong with a sweep, by what the message says."""


@pytest.fixture(scope="module")
def driving():
    """A world, a pipeline that has mapped most of it, and the next six sweeps, at speed."""
    world = SimulatedWorld("street_loop", frames=18, columns=450)
    sweeps = list(world)
    return world, run(ListDataset(sweeps[:12]), QUICK).pipeline, sweeps[12:]


@pytest.mark.parametrize("says", BROKEN)
def test_a_bad_sweep_has_a_status_and_the_run_goes_on(driving, says):
    world, pipeline, sweeps = driving[0], deepcopy(driving[1]), [*driving[2]]
    sweeps[3] = BROKEN[says](sweeps[3])
    result = pipeline.result([pipeline.process(sweep) for sweep in sweeps])
    bad = result.updates[3]
    assert says in bad.message
    assert bad.status == ("bad_stamp" if "later" in says else "unusable_scan")
    assert np.isnan(bad.covariance).all()
    truth = world.truth.map_T_lidar[12:]
    for i in (2, 4, 5):
        assert result.updates[i].status.solved
        error = np.linalg.norm(result.updates[i].map_T_lidar.translation() - truth[i][:3, 3])
        assert error < 0.12
    if bad.status == "unusable_scan":  # predicted where it was
        predicted = bad.map_T_lidar.translation()
        assert np.linalg.norm(predicted - truth[3][:3, 3]) < 0.15
        assert len(result.trajectory) == 6
    else:
        assert len(result.trajectory) == 5
    assert (np.diff(result.trajectory.stamps) > 0).all()


@pytest.mark.parametrize("says", ["0 points", "0 finite", "sweep of 10 points", "000003.bin"])
def test_a_run_may_begin_with_bad_sweeps(says):
    scans = list(SimulatedWorld("room", frames=3, columns=450))
    scans[0] = BROKEN[says](scans[0])
    statuses = [update.status for update in run(ListDataset(scans), QUICK).updates]
    assert statuses[:2] == [FrameStatus.UNUSABLE_SCAN, FrameStatus.FIRST]
    assert statuses[2].solved


def test_nothing_but_bad_sweeps():
    items = [BadSweep(i, "unreadable") for i in range(5)]
    assert run(ListDataset(items)).status_counts == {"unusable_scan": 5}


# -- with an IMU -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shaken():
    """The room at up to 2 rad/s; the first second is at rest."""
    return SimulatedWorld("shaken", frames=32, columns=600)


@pytest.fixture(scope="module")
def sweeps(shaken):
    return list(shaken)


@pytest.fixture(scope="module")
def six(shaken, sweeps):
    """The first six sweeps, mapped without priors of roll and pitch."""
    return run(data_of(shaken, sweeps[:6]), with_imu(QUICK, prior="off"))


def with_imu(config=None, **changes):
    config = config or Config()
    return config.changed(imu=config.imu.changed(**changes))


def data_of(world, scans, keep=None):
    """The world's sweeps with those samples of its IMU that ``keep`` (seconds) says."""
    imu = world.imu
    if keep is not None:
        kept = keep((imu.stamps - scans[0].stamp) * 1e-9)
        imu = ImuSamples(
            imu.stamps[kept], imu.orientation[kept], imu.gyro[kept], imu.acceleration[kept]
        )
    return ArrayDataset(scans, truth=world.truth, imu=imu)


def tilted(imu, world_R_start):
    """The samples of an IMU whose first attitude is this one, its acceleration left as it was."""
    attitude = Rotation.from_quat(imu.orientation)
    attitude = Rotation.from_matrix(world_R_start.matrix()) * attitude[0].inv() * attitude
    return ImuSamples(imu.stamps, attitude.as_quat(), imu.gyro, imu.acceleration)


def ate(result, world):
    return absolute_error(result.trajectory, world.truth).rmse


def up_error(result, world):
    """Degrees between up in the map and z, worst of all frames."""
    truth = world.world_T_start @ world.truth.map_T_lidar[: len(result.updates)]
    cosines = np.einsum("ij,ij->i", result.trajectory.map_T_lidar[:, 2, :3], truth[:, 2, :3])
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))).max()


def test_an_imu_levels_the_map_deskews_and_holds_the_tilt(shaken, sweeps):
    """Measured: ATE 7 mm; 12 without."""
    result = run(data_of(shaken, sweeps), QUICK)
    assert result.imu.sweep_motions == {"gyro": 32}
    assert result.imu.tilt_priors == {"none": 1, "equivalent": 31}
    assert result.imu.level.source == "still"
    assert result.imu.report.orientation == "ahrs"
    assert result.imu.gyro_trusted
    assert result.imu.problems == ()
    np.testing.assert_allclose(result.imu.gyro_bias, (0.002, -0.001, 0.0015), atol=0.002)
    assert up_error(result, shaken) < 0.5
    without = run(data_of(shaken, sweeps), with_imu(QUICK, coupling="off"))
    assert without.imu is None
    assert {(u.sweep_motion, u.tilt_prior) for u in without.updates} == {
        ("constant_velocity", "none")
    }
    assert ate(result, shaken) < 0.8 * ate(without, shaken)


@pytest.mark.parametrize("prior", ["off", "blend", "equivalent", "sigma"])
def test_every_mode_acts_and_says_so(shaken, sweeps, six, prior):
    result = run(data_of(shaken, sweeps[:6]), with_imu(QUICK, prior=prior))
    said = {"off": "none", "sigma": "gravity"}.get(prior, prior)
    assert {str(u.tilt_prior) for u in result.updates[1:]} == {said}
    moved = np.abs(result.trajectory.map_T_lidar - six.trajectory.map_T_lidar).max()
    assert (moved > 1e-6) == (prior != "off")


def test_a_levelled_map_and_one_of_the_first_pose_see_the_same_path(shaken, sweeps):
    """A platform that stands tilted by 22 degrees: the maps differ by that, the motion does not."""
    tilt = gtsam.Rot3.RzRyRx(0.3, -0.25, 0.0)
    data = ArrayDataset(sweeps[:20], imu=tilted(shaken.imu, tilt))
    levelled, first = (run(data, with_imu(QUICK, level=on)) for on in (True, False))
    a, b = (result.trajectory.map_T_lidar for result in (levelled, first))
    assert np.array_equal(b[0], np.eye(4))
    assert np.degrees(np.arccos(a[0, 2, 2])) == pytest.approx(22.2, abs=0.6)
    # Voxels of the two maps cut the scene differently, and 16 beams know the height to 1 cm.
    away = np.linalg.inv(a[0]) @ a - b
    assert np.abs(away[:, :3, :3]).max() < 0.01
    assert np.abs(away[:, :3, 3]).max() < 0.03
    assert np.linalg.norm(b[-1, :3, 3]) > 0.3
    # Up was found in the other map, too.
    np.testing.assert_allclose(first.imu.level.map_up, a[0, 2, :3], atol=1e-9)
    for result in (levelled, first):
        assert result.imu.tilt_priors["equivalent"] == 19


def test_an_imu_that_starts_late_is_used_from_then_on(shaken, sweeps):
    late = run(data_of(shaken, sweeps[:10], lambda seconds: seconds > 0.33), QUICK)
    assert np.array_equal(late.trajectory.map_T_lidar[0], np.eye(4))
    tilts = [str(u.tilt_prior) for u in late.updates]
    motions = [str(u.sweep_motion) for u in late.updates]
    assert tilts == ["none"] + 4 * ["dropped"] + 5 * ["equivalent"]
    assert motions == 4 * ["constant_velocity"] + 6 * ["gyro"]
    assert late.imu.level is not None
    never = run(data_of(shaken, sweeps[:5], lambda seconds: seconds > 99.0), QUICK)
    assert never.imu.level is None
    assert never.imu.tilt_priors == {"none": 1, "dropped": 4}


def test_in_a_gap_of_the_imu_frames_go_without(shaken, sweeps):
    result = run(data_of(shaken, sweeps[:20], lambda s: (s < 1.02) | (s > 1.28)), QUICK)
    tilts = [str(u.tilt_prior) for u in result.updates]
    motions = [str(u.sweep_motion) for u in result.updates]
    assert tilts[10:13] == ["dropped"] * 3
    assert motions[10:13] == ["constant_velocity"] * 3
    assert set(tilts[1:10] + tilts[13:]) == {"equivalent"}
    assert set(motions[:10] + motions[13:]) == {"gyro"}
    assert result.imu.report.gaps == 1
    assert ate(result, shaken) < 0.03


def test_where_the_gyro_ends_within_a_sweep_the_pose_is_as_sure_as_told(
    shaken, sweeps, monkeypatch
):
    begin_quickly(monkeypatch)
    updates = run(data_of(shaken, sweeps[:13], lambda s: (s < 1.02) | (s > 1.6))).updates
    truth = [gtsam.Pose3(pose) for pose in shaken.truth.map_T_lidar[:14]]
    for number in (8, 9, 10, 11):  # two sweeps with a gyro, one with a fifth of one, one without
        turned = truth[number].between(truth[number + 1]).rotation()
        missing = updates[number].twist[:3] - gtsam.Rot3.Logmap(turned) / 0.1
        assert np.linalg.norm(missing) < (0.02 if number < 10 else 0.5)
        pair = [updates[0], updates[number]], [truth[0], truth[number]]
        assert squared_errors(*pair)[1] < 6.0 * 4.0


@pytest.mark.parametrize("angles", [(180.0, 0.0, 0.0), (0.0, 0.0, 90.0)])
def test_with_wrong_extrinsics_the_gyro_is_given_up_and_the_run_tracks(
    shaken, sweeps, angles, monkeypatch
):
    begin_quickly(monkeypatch)
    sweeps = sweeps[:24]
    data = data_of(shaken, sweeps)
    config = effective_config(with_imu(lidar_R_imu_deg=angles), data)
    pipeline = Pipeline(config, imu=imu_buffer(data, config))
    updates = [pipeline.process(scan) for scan in sweeps[:-1]]
    features = extract_features(sweeps[-1], config)
    guess = ConstantVelocity(pipeline.mapper.imu).guess(features, pipeline.mapper.last)
    result = pipeline.result([*updates, pipeline.process(sweeps[-1])])
    assert not result.imu.gyro_trusted
    assert result.imu.sweep_motions["constant_velocity"] > 10
    told = [update for update in result.updates if "one of the two is wrong" in update.message]
    assert len(told) - result.imu.gyro_left_out in (0, 1)  # it was given up after the first one
    assert result.imu.gyro_left_out > 10
    assert str(result.updates[-1].sweep_motion) == "constant_velocity"
    assert "lidar_R_imu_deg" in result.imu.problems[-1]
    assert ate(result, shaken) < 0.03
    # The guess does without it as well.
    twisted = updates[-1].map_T_lidar.compose(gtsam.Pose3.Expmap(0.1 * updates[-1].twist))
    assert guess.map_T_lidar.equals(twisted, 1e-9)


def test_presets_use_the_imu_as_their_systems_do(shaken, sweeps):
    result = run(data_of(shaken, sweeps[:4]), preset("loam"))
    assert result.imu.tilt_priors == {"none": 1, "blend": 3}
    assert result.imu.sweep_motions == {"constant_velocity": 4}
    assert run(data_of(shaken, sweeps[:4]), preset("aloam")).imu is None


@pytest.mark.parametrize("method", ["loam", "aloam"])
@pytest.mark.parametrize(
    ("prior", "tilt"),
    [("equivalent", "blend"), ("sigma", None), ("blend", "blend"), ("off", "none")],
)
def test_a_solver_without_a_graph_blends_and_cannot_have_a_prior(
    shaken, sweeps, method, prior, tilt
):
    config = with_imu(QUICK, prior=prior)
    config = config.changed(solver=preset(method).solver.changed(method=method))
    if tilt is not None:
        result = run(data_of(shaken, sweeps[:2]), config)
        assert result.updates[1].status.solved
        assert result.updates[1].tilt_prior == tilt
        assert result.config.imu.prior == ("off" if prior == "off" else "blend")
    else:
        with pytest.raises(ConfigError, match=f"{prior} is a factor.* {method} .*blend or off"):
            run(data_of(shaken, sweeps[:2]), config)
    without = ArrayDataset(sweeps[:2])  # nobody asks
    assert run(without, config).updates[1].status.solved


@pytest.mark.parametrize("name", ["loam", "aloam", "default"])
def test_a_solver_that_was_made_brings_its_settings(sweeps, name):
    settings = preset(name).solver
    result = run(ArrayDataset(sweeps[:4]), QUICK, solver=make_solver(settings))
    assert result.config.solver == settings
    for update in result.updates[1:]:
        assert update.status.solved
        assert np.isfinite(update.covariance).all()


@pytest.fixture(scope="module")
def room():
    world = SimulatedWorld("room", frames=9, columns=450)
    return world, list(world)


@pytest.mark.parametrize(
    ("swapped", "begins"), [(True, -1.0), (True, 0.06), (True, 0.25), (False, 0.06), (False, 0.25)]
)
def test_a_gyro_that_begins_is_held_against_the_sweep_without_it(room, swapped, begins):
    """Gyro and accelerometer were swapped: the gyro says that it turns at 10 rad/s."""
    (world, sweeps), imu = room, room[0].imu
    keep = (imu.stamps - sweeps[0].stamp) * 1e-9 >= begins
    felt = imu.gyro[keep], imu.acceleration[keep]
    samples = ImuSamples(imu.stamps[keep], None, *(felt[::-1] if swapped else felt))
    result = run(ArrayDataset(sweeps, imu=samples))
    assert ate(result, world) < 4e-3  # 2 mm without an IMU
    assert (result.imu.gyro_left_out > 0) is swapped
    turned = result.updates[-1].sweep_motion
    assert turned is (SweepMotion.CONSTANT_VELOCITY if swapped else SweepMotion.GYRO)
    told = [update for update in result.updates if "as if no IMU had been there" in update.message]
    assert bool(told) is (swapped and begins > 0.0)
    assert all(one.sweep_motion is SweepMotion.CONSTANT_VELOCITY for one in told)


def test_recorded_features_are_levelled_too(shaken, sweeps):
    """Features of another front end: no de-skew, the prior all the same."""
    features = [replace(extract_features(scan, Config()), span=(0.0, 0.0)) for scan in sweeps[:3]]
    data = ListDataset([FeatureSweep(one, gtsam.Pose3()) for one in features])
    data.imu = tilted(shaken.imu, gtsam.Rot3.RzRyRx(0.2, -0.1, 0.0))
    result = run(data)
    found = roll_pitch(result.updates[0].map_T_lidar.rotation())
    np.testing.assert_allclose(found, (0.2, -0.1), atol=0.01)
    assert result.imu.sweep_motions == {"none": 3}
    assert result.imu.tilt_priors == {"none": 1, "equivalent": 2}


# -- own factors -----------------------------------------------------------------------------------


def tight(translation, key=POSE_KEY):
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1e-5)
    return gtsam.GPSFactor(key, np.asarray(translation), noise)


def test_own_factors_are_asked_for_once_a_frame_and_act(shaken, sweeps):
    asked = []

    def extra(context):
        asked.append(context)
        return [tight(context.map_T_middle.translation() + np.array([0.0, 0.0, 0.02]))]

    result = run(data_of(shaken, sweeps[:5]), extra_factors=extra)
    assert [context.key for context in asked] == [POSE_KEY] * 4
    half = 50_000_000  # the middle of a sweep
    assert [context.middle_stamp for context in asked] == [
        scan.stamp + half for scan in sweeps[1:5]
    ]
    assert [context.last[0] for context in asked] == [scan.stamp + half for scan in sweeps[:4]]
    with pytest.deprecated_call(match="middle_stamp"):
        assert asked[0].stamp == asked[0].middle_stamp
    with pytest.deprecated_call(match="map_T_middle"):
        assert asked[0].guess is asked[0].map_T_middle
    for context, before in zip(asked[1:], result.updates[1:], strict=False):
        # The middle of the last sweep is half a sweep on from its reported pose.
        there = before.map_T_lidar.between(context.last[1])
        assert np.linalg.norm(there.translation()) < 0.05
        assert np.linalg.norm(context.last[1].localCoordinates(context.map_T_middle)) < 0.3
        # The pose of the last frame is where the factor on it wanted it.
    for context, after in pairwise(asked):
        moved = after.last[1].translation() - context.map_T_middle.translation()
        np.testing.assert_allclose(moved, [0.0, 0.0, 0.02], atol=1e-3)


def test_a_run_without_own_factors_may_say_so_with_an_empty_list(shaken, sweeps):
    plain = run(data_of(shaken, sweeps[:3]), QUICK)
    asked = run(data_of(shaken, sweeps[:3]), QUICK, extra_factors=lambda context: [])
    assert np.array_equal(plain.trajectory.map_T_lidar, asked.trajectory.map_T_lidar)


@pytest.mark.parametrize(
    ("extra", "says"),
    [
        (lambda context: None, "expected a list of factors, empty if there are none; got NoneType"),
        (lambda context: tight(np.zeros(3)), "expected a list of factors.* got GPSFactor"),
        (lambda context: ["barometer"], r"got str on the keys \[\]"),
        (
            lambda context: [tight(np.zeros(3), key=7)],
            r"context.key, .*\(\[x0, x1\]\); got GPSFactor on the keys \[7\]",
        ),
    ],
)
def test_what_is_no_factor_of_the_frame_is_an_error(shaken, sweeps, extra, says):
    with pytest.raises(InputError, match=f"extra_factors: .*{says}"):
        run(data_of(shaken, sweeps[:2]), QUICK, extra_factors=extra)


@pytest.mark.parametrize(
    ("residual", "error"),
    [
        (lambda values: (np.zeros(1), [np.zeros((1, 5))]), InputError),
        (lambda values: (np.full(1, np.nan), [np.zeros((1, 6))]), InputError),
        (lambda values: (np.zeros(1), [np.full((1, 6), 1e12)]), InputError),
        (lambda values: 1 / 0, PartError),
    ],
)
def test_a_faulty_own_factor_is_an_error_and_no_crash(shaken, sweeps, residual, error):
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 1.0)
    factor = checked_factor(noise, [POSE_KEY], residual)
    with pytest.raises(error):
        run(data_of(shaken, sweeps[:2]), QUICK, extra_factors=lambda context: [factor])


@pytest.mark.parametrize("name", ["loam", "aloam"])
def test_a_classical_solver_has_no_place_for_own_factors(shaken, sweeps, name):
    config = preset(name).changed(imu=ImuConfig(coupling="off"))
    with pytest.raises(ConfigError, match=r"extra_factors: .* use solver\.method gtsam"):
        run(data_of(shaken, sweeps[:1]), config, extra_factors=lambda _: [tight(np.zeros(3))])


def test_foliage_does_not_hold_the_pose(monkeypatch):
    begin_quickly(monkeypatch)
    world = SimulatedWorld("trees", frames=35, columns=600, seed=2)
    # Without poles: the trunks alone would do.
    config = Config().changed({"features.post_depth": 0.0, "imu.coupling": "off"})
    positions = run(world, config).trajectory.positions
    error = np.linalg.norm(positions - world.truth.positions, axis=1).max()
    assert error < 0.12


def test_a_lidar_at_rest_stays_where_it_is():
    """Without noise: 4 mm off by the third sweep if planes that cut corners count as others do."""
    world = SimulatedWorld("rooms", seed=1, frames=60, columns=600, range_noise=0.0)
    result = run(world, Config().changed("imu.coupling=off"), max_frames=3)
    moved = result.updates[0].map_T_lidar.between(result.updates[2].map_T_lidar)
    assert np.abs(moved.translation()).max() < 1e-3
