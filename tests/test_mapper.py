"""The mapper: poses, reference times, statuses, priors, what it reports."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from support.quick import QUICK, begin_quickly
from support.worlds import room_features

from loam_gtsam.config import Config, preset
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.io.rollback import Before
from loam_gtsam.mapper import Mapper
from loam_gtsam.pipeline import imu_buffer
from loam_gtsam.registration import frame_matcher
from loam_gtsam.registration.solvers import POSE_KEY, GtsamSolver
from loam_gtsam.types import (
    ConfigError,
    Features,
    FrameStatus,
    ImuSamples,
    SweepFault,
    TiltPrior,
)

SECOND = 1_000_000_000


def with_deskew(**changes):
    return Config().changed(deskew=Config().deskew.changed(**changes))


def with_solver(**changes):
    return Config().changed(solver=Config().solver.changed(**changes))


@pytest.fixture
def rng():
    return np.random.default_rng(8)


@pytest.fixture(scope="module")
def mapped_once():
    mapper, rng = Mapper(), np.random.default_rng(7)
    for i in range(10):
        mapper.register(room_features(gtsam.Pose3(), i * SECOND // 10, rng))
    return mapper


@pytest.fixture
def mapped(mapped_once):
    """A mapper that has seen the room ten times from the origin."""
    before = Before(mapped_once)
    yield mapped_once
    before.restore()


@pytest.mark.parametrize("scale", [0.01, 0.3])
def test_closed_form_room_is_solved_exactly(mapped, rng, scale):
    truth = gtsam.Pose3.Expmap(scale * np.array([0.05, -0.1, 0.2, 0.5, -0.4, 0.3]))
    update = mapped.register(room_features(truth, SECOND, rng), guess=gtsam.Pose3())
    assert update.status is FrameStatus.OK
    error = truth.localCoordinates(update.map_T_lidar)
    assert np.abs(error[:3]).max() < 1e-3
    assert np.abs(error[3:]).max() < 2e-3
    assert update.error_after < 1.01 * update.error_before
    assert update.n_edge_matches > 100
    assert update.n_plane_matches > 500
    assert np.linalg.eigvalsh(update.information).min() > 0


def test_first_sweep_is_the_origin_and_has_no_covariance(rng):
    update = Mapper().register(room_features(gtsam.Pose3(), 0, rng))
    assert update.status is FrameStatus.FIRST
    assert update.map_T_lidar.equals(gtsam.Pose3(), 0.0)
    assert np.isnan(update.covariance).all()


def test_a_guess_places_the_first_sweep(rng):
    start = gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([100.0, -20.0, 3.0]))
    mapper = Mapper()
    assert mapper.register(room_features(gtsam.Pose3(), 0, rng), guess=start).map_T_lidar.equals(
        start, 1e-12
    )
    update = mapper.register(room_features(gtsam.Pose3(), SECOND // 10, rng))
    assert np.abs(start.localCoordinates(update.map_T_lidar)).max() < 5e-3


@pytest.fixture(scope="module")
def driving():
    """A world, and six sweeps of it taken at 10 m/s: 1 m a sweep."""
    world = SimulatedWorld("street_loop", frames=66, columns=900)
    return world, [world[i] for i in range(60, 66)]


@pytest.mark.parametrize("reference", ["start", "middle", "end", "stamp"])
def test_poses_belong_to_the_stated_reference_time(driving, reference):
    world, scans = driving
    config = with_deskew(reference=reference)
    mapper = Mapper(config)
    updates = [mapper.register(extract_features(scan, config)) for scan in scans]
    offset = {"middle": SECOND // 20, "end": SECOND // 10}.get(reference, 0)
    expected = np.array([scan.stamp + offset for scan in scans])
    assert np.array_equal([u.stamp for u in updates], expected)
    # The first reference pose is the origin of the map.
    truth = world.truth_at(expected).map_T_lidar
    truth = np.linalg.inv(truth[0]) @ truth
    for pose, update in zip(truth, updates, strict=True):
        error = gtsam.Pose3(pose).localCoordinates(update.map_T_lidar)
        assert np.abs(error[:3]).max() < 0.01
        assert np.abs(error[3:]).max() < 0.12


def test_deskew_matters_and_can_be_turned_off(monkeypatch):
    begin_quickly(monkeypatch)
    world = SimulatedWorld("room", frames=20, columns=450)
    errors = {}
    for enabled in (True, False):
        config = with_deskew(enabled=enabled)
        mapper = Mapper(config)
        updates = [mapper.register(extract_features(scan, config)) for scan in world]
        errors[enabled] = np.mean(
            [
                np.linalg.norm(u.map_T_lidar.translation() - pose[:3, 3])
                for u, pose in zip(updates, world.truth.map_T_lidar, strict=True)
            ]
        )
    assert errors[True] < 0.5 * errors[False]


def test_a_wrong_twist_hardly_moves_the_middle_of_the_sweep():
    """Why poses are kept there: the error of the de-skew cancels to first order."""
    world = SimulatedWorld("room", frames=26, columns=450, range_noise=0.0)
    features = [extract_features(scan, Config()) for scan in world]
    middles = []
    # One association only: the second would already use a better twist.
    mapper = Mapper(with_solver(iterations=1, inner_iterations=5))
    for item in features[:-1]:
        last = mapper.register(item)
    before = Before(mapper)
    for wrong in (np.zeros(6), np.array([0, 0, 0.2, 0.3, 0, 0])):
        solved = {}

        class Spy(GtsamSolver):
            def solve(self, associate, guess, priors=(), motion=None, solved=solved):
                solved["pose"] = (
                    solution := super().solve(associate, guess, priors, motion)
                ).map_T_lidar
                return solution

        mapper.solver = Spy(mapper.config.solver)
        mapper.register(features[-1], twist=last.twist + wrong)
        before.restore()
        middles.append(solved["pose"])
    moved = middles[0].localCoordinates(middles[1])
    # At the start of the sweep it would be 0.05 s of the wrong twist: 10 mrad and 15 mm.
    assert abs(moved[2]) < 3e-3
    assert abs(moved[3]) < 3e-3


def test_a_run_that_starts_in_motion_rebuilds_its_first_sweep(driving):
    world, scans = driving[0], driving[1][:4]
    mapper = Mapper()
    updates = [mapper.register(extract_features(scan, mapper.config)) for scan in scans]
    truth = world.truth.map_T_lidar[60:64]
    truth = np.linalg.inv(truth[0]) @ truth
    step = np.linalg.norm(truth[1][:3, 3])
    assert step > 0.5  # metres between sweeps
    for update, pose in zip(updates, truth, strict=True):
        error = np.linalg.norm(update.map_T_lidar.translation() - pose[:3, 3])
        assert error < 0.1 * step, update.status  # 0.5 without


def test_duplicate_and_earlier_stamps_are_skipped(mapped, rng):
    before, points = mapped.last, mapped.maps.planes.count()
    for stamp in (before.stamp, before.stamp - 1, 0):
        update = mapped.register(room_features(gtsam.Pose3(), stamp, rng))
        assert update.status is FrameStatus.BAD_STAMP
        assert str(before.stamp) in update.message
        assert update.map_T_lidar.equals(before.map_T_lidar, 0.0)
    assert mapped.last is before
    assert mapped.maps.planes.count() == points
    assert mapped.register(
        room_features(gtsam.Pose3(), before.stamp + 100_000_000, rng)
    ).status.solved


def test_no_features_predict_the_pose_and_leave_the_map(rng):
    mapper = Mapper()
    for i in range(4):
        pose = gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * i, 0.0, 0.0]))
        mapper.register(room_features(pose, i * SECOND // 10, rng), guess=pose)
    points = mapper.maps.planes.count()
    empty = Features.from_points(4 * SECOND // 10, np.zeros((0, 3)), np.zeros((0, 3)))
    update = mapper.register(empty)
    assert update.status is FrameStatus.UNUSABLE_SCAN
    assert mapper.maps.planes.count() == points
    expected = mapper.last.map_T_lidar.translation()
    np.testing.assert_allclose(expected, [0.4, 0.0, 0.0], atol=0.02)


@pytest.mark.parametrize(("speed", "copies"), [(1.0, 2), (0.0, 2), (1.0, 0)])
def test_a_copy_of_the_last_sweep_is_none_if_the_lidar_moves(rng, speed, copies):
    """It would be found where the last one was; one that stands may see the same."""
    mapper, features = Mapper(), room_features(gtsam.Pose3(), 0, rng)
    for i in range(6):
        pose = gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * speed * i, 0.0, 0.0]))
        stamp = i * SECOND // 10
        if i in range(4, 4 + copies):
            update = mapper.register(replace(features, stamp=stamp))
            fault = SweepFault.REPEATED if speed else None
            assert update.fault is fault
            assert update.status.solved is (fault is None)
        else:
            features = room_features(pose, stamp, rng)
            update = mapper.register(features, guess=pose if i < 4 else None)
            assert update.status is (FrameStatus.OK if i else FrameStatus.FIRST)
        assert update.map_T_lidar.equals(pose, 0.02)


def test_sparse_map_inserts_at_the_guess(rng):
    mapper = Mapper()
    few = Features.from_points(0, rng.uniform(-5, 5, (20, 3)), rng.uniform(-5, 5, (30, 3)))
    mapper.register(few)
    guess = gtsam.Pose3(gtsam.Rot3(), np.array([0.5, 0.0, 0.0]))
    update = mapper.register(room_features(guess, SECOND // 10, rng), guess=guess)
    assert update.status is FrameStatus.SPARSE_MAP
    assert "50" in update.message
    assert update.map_T_lidar.equals(guess, 1e-12)
    after = mapper.register(room_features(guess, SECOND // 5, rng), guess=guess)
    assert after.status.solved
    # Nothing but an expected motion, to 2 m/s^2, has led to the map that it was found in.
    assert (np.sqrt(np.diag(after.covariance))[3:] > 0.5 * 2.0 * 0.1**2).all()


def test_where_nothing_is_mapped_a_known_sweep_does_not_go_into_the_map(mapped, rng):
    points, far = mapped.maps.planes.count(), gtsam.Pose3(gtsam.Rot3(), [900.0, 0.0, 0.0])
    update = mapped.register(room_features(gtsam.Pose3(), SECOND, rng), guess=far)
    assert update.status is FrameStatus.FEW_MATCHES
    assert mapped.monitor.lost == 1
    assert len(mapped.map_points()[1]) == points


def test_few_matches_keep_the_guess_and_do_not_insert(mapped, rng):
    points = mapped.maps.planes.count()
    far = gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([30.0, 10.0, 0.0]))
    update = mapped.register(room_features(gtsam.Pose3(), SECOND, rng), guess=far)
    assert update.status is FrameStatus.FEW_MATCHES
    assert update.map_T_lidar.equals(far, 1e-9)
    assert mapped.maps.planes.count() == points
    assert not update.information.any()
    # and the run goes on
    back = mapped.register(room_features(gtsam.Pose3(), 2 * SECOND, rng), guess=gtsam.Pose3())
    assert back.status.solved


@pytest.mark.parametrize("name", ["loam", "aloam"])
def test_a_classical_run_goes_on_where_a_sweep_matched_nothing(rng, name):
    """The sweep goes into the map as in LOAM, so that the next one has something to match."""
    mapper = Mapper(preset(name).changed("imu.coupling=off"))
    for i in range(3):
        mapper.register(room_features(gtsam.Pose3(), i * SECOND // 10, rng))
    far = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 30.0]))  # in the same cubes
    last = [
        mapper.register(room_features(gtsam.Pose3(), i * SECOND // 10, rng), guess=far)
        for i in range(3, 6)
    ]
    assert last[0].status is FrameStatus.FEW_MATCHES
    assert np.isnan(last[0].covariance).all()
    assert [update.status.solved for update in last[1:]] == [True, True]


def test_the_iteration_limit_is_reported(rng):
    mapper = Mapper(with_solver(iterations=1))
    for i in range(3):
        mapper.register(room_features(gtsam.Pose3(), i * SECOND // 10, rng))
    truth = gtsam.Pose3(gtsam.Rot3(), np.array([0.2, 0.0, 0.0]))
    update = mapper.register(room_features(truth, SECOND, rng), guess=gtsam.Pose3())
    assert update.status is FrameStatus.NOT_CONVERGED
    assert update.iterations == 1
    assert "1 associations" in update.message


def test_priors_are_factors_beside_the_scan(mapped, rng):
    features = room_features(gtsam.Pose3(), SECOND, rng)
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
    lifted = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.05]))
    update = mapped.register(features, priors=[gtsam.PriorFactorPose3(POSE_KEY, lifted, tight)])
    np.testing.assert_allclose(update.map_T_lidar.translation(), [0, 0, 0.05], atol=2e-3)
    assert update.covariance[5, 5] < 1.1e-10


def test_information_is_that_of_the_reference_time(driving):
    """A rotation of the pose at the start moves the middle, 0.05 s later, sideways."""
    mapper = Mapper()
    seen = []

    class Spy(GtsamSolver):
        def solve(self, associate, guess, priors=(), motion=None):
            seen.append(super().solve(associate, guess, priors, motion))
            return seen[-1]

    mapper.solver = Spy(mapper.config.solver)
    for scan in driving[1][:4]:
        update = mapper.register(extract_features(scan, mapper.config))
    middle = seen[-1]
    motion = update.map_T_lidar.between(middle.map_T_lidar)
    assert np.linalg.norm(motion.translation()) > 0.3
    # J maps a perturbation at the start to one at the middle; numerically, column by column.
    jacobian = (
        np.stack(
            [
                motion.inverse()
                .compose(gtsam.Pose3.Expmap(1e-6 * axis))
                .compose(motion)
                .logmap(gtsam.Pose3())
                for axis in np.eye(6)
            ],
            axis=1,
        )
        / -1e-6
    )
    expected = jacobian.T @ middle.information @ jacobian
    np.testing.assert_allclose(update.information, expected, rtol=1e-3, atol=1e-3 * expected.max())


@pytest.mark.parametrize(("metres", "searches"), [(0.0, 2), (1.0, 1)])
def test_a_search_is_skipped_only_while_the_pose_stays(rng, monkeypatch, metres, searches):
    config = QUICK.changed(
        {
            "matching.keep_translation": metres,
            "matching.keep_rotation_deg": 5.0,
            "solver.iterations": 2,
            "solver.step_sigmas": 0.0,
            "solver.translation_tolerance": 0.0,
        }
    )
    mapper = Mapper(config)
    for i in range(3):
        mapper.register(room_features(gtsam.Pose3(), i * SECOND // 10, rng))
    calls = []
    real = frame_matcher.match_features

    def count(*args, **settings):
        calls.append(1)
        return real(*args, **settings)

    monkeypatch.setattr(frame_matcher, "match_features", count)
    truth = gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.0]))
    update = mapper.register(room_features(truth, SECOND, rng), guess=gtsam.Pose3())
    assert (update.iterations, len(calls)) == (2, searches)


def test_cubes_left_behind_are_evicted_counted_and_kept(rng):
    config = Config().changed(
        {"map.cube_size": 10.0, "map.window": (5, 5, 5), "map.window_margin": 1}
    )
    mapper = Mapper(config)
    total = 0
    for i in range(8):  # a new room, out of sight of the last one, at every sweep
        pose = gtsam.Pose3(gtsam.Rot3(), np.array([80.0 * i, 0.0, 0.0]))
        update = mapper.register(room_features(gtsam.Pose3(), i * SECOND // 10, rng), guess=pose)
        assert update.status in (FrameStatus.FIRST, FrameStatus.SPARSE_MAP)
        total += update.n_planes
    stats = mapper.maps.planes.stats
    assert stats.evicted >= 7
    assert stats.archived == stats.evicted - stats.restored
    assert stats.dropped_points == 0
    # One point a voxel, and voxels of the map cut those of the sweep differently.
    assert 0.5 * total < len(mapper.map_points()[1]) <= total
    home = mapper.register(
        room_features(gtsam.Pose3(), 2 * SECOND, rng), guess=gtsam.Pose3.Expmap(np.full(6, 0.01))
    )
    assert home.status.solved
    assert mapper.maps.planes.stats.restored > 0
    assert np.abs(home.map_T_lidar.logmap(gtsam.Pose3())).max() < 5e-3


# -- with an IMU -----------------------------------------------------------------------------------


def imu_of(world_R_lidar, seconds=2.0):
    """An IMU at rest at that attitude, 200 Hz."""
    stamps = 5_000_000 * np.arange(round(200 * seconds), dtype=np.int64) - SECOND // 2
    q = world_R_lidar.toQuaternion()
    rotation = world_R_lidar.matrix()
    count = len(stamps)
    samples = ImuSamples(
        stamps,
        np.tile([q.x(), q.y(), q.z(), q.w()], (count, 1)),
        np.zeros((count, 3)),
        np.tile(9.81 * rotation[2], (count, 1)),
    )
    return ImuBuffer(Config().imu, samples)


def test_a_start_of_the_users_own_keeps_its_map_and_learns_where_up_is(rng):
    """A map whose axes the user has chosen, with z nowhere near up."""
    attitude = gtsam.Rot3.RzRyRx(0.1, -0.2, 0.0)
    start = gtsam.Pose3(gtsam.Rot3.RzRyRx(1.2, 0.4, 2.0), np.array([3.0, 4.0, 5.0]))
    mapper = Mapper(imu=imu_of(attitude))
    first = mapper.register(room_features(gtsam.Pose3(), 0, rng), guess=start)
    assert first.map_T_lidar.equals(start, 1e-12)
    up = start.rotation().matrix() @ attitude.matrix()[2]
    np.testing.assert_allclose(mapper.imu.level.map_up, up, atol=1e-9)
    update = mapper.register(room_features(gtsam.Pose3(), SECOND // 10, rng), guess=start)
    assert update.tilt_prior is TiltPrior.EQUIVALENT
    # The IMU agrees, so it changes nothing.
    assert np.abs(start.localCoordinates(update.map_T_lidar)).max() < 5e-3


def test_the_imu_moves_roll_and_pitch_of_a_frame_by_its_weight(rng):
    """Frames of one attitude, an IMU that changes its mind by 10 mrad after the start."""
    results = {}
    for weight in (0.0, 0.1):
        config = QUICK.changed({"imu.weight": weight, "imu.still_seconds": 0.1})
        buffer = imu_of(gtsam.Rot3.Roll(0.01))
        start = imu_of(gtsam.Rot3(), seconds=0.75).samples_between(-SECOND // 2, SECOND // 8)
        late = buffer.samples_between(SECOND // 8 + 1, 2 * SECOND)
        mapper = Mapper(config, imu=ImuBuffer(config.imu, start))
        mapper.imu.buffer.add(late)
        same = np.random.default_rng(3)
        mapper.register(room_features(gtsam.Pose3(), 0, same, noise=0.01))
        update = mapper.register(room_features(gtsam.Pose3(), SECOND // 2, same, noise=0.01))
        assert update.tilt_prior is TiltPrior.EQUIVALENT
        results[weight] = update.map_T_lidar.rotation().rpy()
    moved = results[0.1][:2] - results[0.0][:2]
    expected = 0.1 * (np.array([0.01, 0.0]) - results[0.0][:2])
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_a_frame_that_is_not_solved_has_no_prior(rng):
    mapper = Mapper(imu=imu_of(gtsam.Rot3()))
    first = mapper.register(room_features(gtsam.Pose3(), 0, rng))
    mapper.register(room_features(gtsam.Pose3(), SECOND // 10, rng))
    far = gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([30.0, 10.0, 0.0]))
    lost = mapper.register(room_features(gtsam.Pose3(), SECOND // 5, rng), guess=far)
    assert lost.status is not FrameStatus.OK
    assert first.tilt_prior is lost.tilt_prior is TiltPrior.NONE


def test_sweeps_of_unlike_length_may_share_their_middle():
    """Stamps go on, the middles of the sweeps do not: no velocity comes of it, and no error."""
    world = SimulatedWorld("room", frames=4, columns=300)
    mapper = Mapper(imu=imu_buffer(world, Config()))
    sweeps = [extract_features(scan, mapper.config) for scan in world]
    for features in sweeps[:3]:
        mapper.register(features)
    long = replace(sweeps[2], stamp=sweeps[2].stamp + 40_000_000, span=(0.0, 0.3))
    middle = mapper.register(long)
    after = replace(sweeps[3], stamp=long.stamp + 100_000_000, span=(0.0, 0.1))
    assert long.stamp + 150_000_000 == after.stamp + 50_000_000
    update = mapper.register(after)
    for one in (middle, update):
        assert np.isfinite(one.map_T_lidar.matrix()).all()
        assert np.isfinite(one.twist).all()
        assert one.status.solved


def test_a_user_may_hand_priors_and_own_factors_together(mapped, rng):
    """Two heights, equally sure: the frame is half way between them."""
    noise = gtsam.noiseModel.Diagonal.Sigmas([1e3, 1e3, 1e-5])
    high, low = (gtsam.GPSFactor(POSE_KEY, np.array([0, 0, z]), noise) for z in (0.04, 0.02))
    mapped.extra_factors = lambda context: [low]
    update = mapped.register(room_features(gtsam.Pose3(), SECOND, rng), priors=[high])
    np.testing.assert_allclose(update.map_T_lidar.translation()[2], 0.03, atol=1e-3)


# -- values and states -----------------------------------------------------------------------------


def with_coupling(world, count):
    """A tightly coupled mapper after some sweeps, and the features of the next one."""
    mapper = Mapper(QUICK, imu=imu_buffer(world, QUICK))
    for number in range(count):
        mapper.register(extract_features(world[number], QUICK))
    assert mapper.last.status is FrameStatus.OK
    return mapper, extract_features(world[count], QUICK)


def test_a_guess_is_used_under_pre_integration():
    """Solves that start 5 m apart do not start at the same pose."""
    world = SimulatedWorld("room", frames=12, columns=450)
    starts = []

    class Spy(GtsamSolver):
        def solve(self, associate, guess, priors=(), motion=None):
            starts.append(guess)
            return super().solve(associate, guess, priors, motion)

    for away in (0.0, 5.0):
        mapper, features = with_coupling(world, 10)
        expected = mapper.last.map_T_lidar
        mapper.solver = Spy(mapper.config.solver)
        guess = expected.compose(gtsam.Pose3(gtsam.Rot3(), np.array([away, 0.0, 0.0])))
        starts.clear()
        mapper.register(features, guess=guess)
        assert starts[0].range(guess) < 0.1  # from the reference time to the middle


def test_a_predicted_pose_teaches_nothing_about_the_gyro():
    """After a sweep with too few matches, the next solved one leaves the bias alone."""
    world = SimulatedWorld("room", frames=12, columns=450)
    mapper, features = with_coupling(world, 10)
    few = replace(
        features,
        edges=features.edges[:5],
        edge_times=features.edge_times[:5],
        edge_rings=features.edge_rings[:5],
        edge_prominence=None,
        edge_sigmas=None,
        planes=features.planes[:20],
        plane_times=features.plane_times[:20],
        plane_rings=features.plane_rings[:20],
        sharp=features.sharp[:0],
        flat=features.flat[:0],
        voxel_sizes=None,
    )
    assert mapper.register(few).status is FrameStatus.FEW_MATCHES
    before = mapper.imu.buffer.gyro_bias.copy()
    mapper.register(extract_features(world[11], mapper.config))
    assert np.array_equal(mapper.imu.buffer.gyro_bias, before)


def test_what_is_said_about_a_frame_cannot_be_changed(mapped, rng):
    update = mapped.register(room_features(gtsam.Pose3(), 2 * SECOND, rng))
    assert set(update.timings) >= {"prepare", "match", "solve", "insert", "covariance"}
    with pytest.raises(TypeError):
        update.timings["solve"] = 0.0
    with pytest.raises(ValueError, match="read-only"):
        update.twist[:3] *= 57.3  # by which the next frame is predicted
    before = dict(update.timings)
    mapped.register(room_features(gtsam.Pose3(), 2 * SECOND + SECOND // 10, rng))
    assert dict(update.timings) == before


def test_the_pose_of_the_middle_is_handed_out_too():
    world = SimulatedWorld("street_loop", frames=4, columns=450)
    mapper = Mapper()
    for number in range(4):
        update = mapper.register(extract_features(world[number], mapper.config))
        half = update.middle_stamp - update.stamp
        assert half == pytest.approx(0.05e9, abs=1e6)
        moved = gtsam.Pose3.Expmap(update.twist * half * 1e-9)
        assert update.map_T_middle.equals(update.map_T_lidar.compose(moved), 1e-9)


def test_walls_that_lean_a_little_from_the_axes_of_the_map_do_not_turn_it():
    """Voxels along these axes took the lean away, 0.3 degrees within twelve sweeps."""
    lean = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.006, -0.005, 0.0), np.zeros(3))
    for seed in range(2):
        world = SimulatedWorld("room", frames=12, columns=450, seed=seed)
        mapper, truth = Mapper(), [gtsam.Pose3(pose) for pose in world.truth.map_T_lidar]
        features = [extract_features(sweep, Config()) for sweep in world]
        poses = [mapper.register(features[0], lean).map_T_lidar]
        poses += [mapper.register(part).map_T_lidar for part in features[1:]]
        error = poses[0].between(poses[-1]).localCoordinates(truth[0].between(truth[-1]))
        assert np.degrees(np.abs(error[:3])).max() < 0.1


def test_an_imu_that_is_off_is_none_and_one_made_for_other_settings_is_refused():
    world = SimulatedWorld("room", frames=1, columns=300, imu="white")
    config = Config()
    buffer = ImuBuffer(config.imu, world.imu)
    assert Mapper(config, imu=buffer).imu is not None
    assert Mapper(config.changed("imu.coupling=off"), imu=buffer).imu is None
    for setting, made in (
        ("imu.lidar_R_imu_deg=[0,0,90]", "0.0, 0.0"),
        ("imu.time_offset=0.2", "0.0"),
    ):
        expected = rf"{setting.partition('=')[0]}: expected that of the ImuBuffer, .*{made}"
        with pytest.raises(ConfigError, match=expected):
            Mapper(config.changed(setting), imu=buffer)


def test_mappers_on_the_samples_of_one_imu_do_not_change_each_other():
    world = SimulatedWorld("street_loop", frames=6, columns=450, imu="mems")
    buffer = ImuBuffer(QUICK.imu, world.imu)
    features = [extract_features(scan, QUICK) for scan in world]
    other = QUICK.changed("imu.coupling=loose")
    alone, one, two = (Mapper(config, imu=buffer) for config in (QUICK, QUICK, other))
    expected = [alone.register(sweep).map_T_lidar for sweep in features]
    for sweep, pose in zip(features, expected, strict=True):
        assert one.register(sweep).map_T_lidar.equals(pose, 0.0)
        two.register(sweep)
    assert one.imu.buffer.gyro_bias.any()
    assert not buffer.gyro_bias.any()
