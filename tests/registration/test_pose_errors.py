"""Covariances of a run: parts, drift, the motion between two frames, and what must not change."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from support.jacobians import numerical
from support.list_dataset import ListDataset
from support.quick import PREDICTED, begin_quickly
from support.solved import solved

from loam_gtsam.config import Config, preset
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.mapper import Mapper
from loam_gtsam.pipeline import run
from loam_gtsam.registration.acceleration import Accelerations
from loam_gtsam.registration.matches import EdgeMatches, PlaneMatches, ScanMatches
from loam_gtsam.registration.odometry import Moment
from loam_gtsam.registration.solvers import POSE_KEY, Solution
from loam_gtsam.registration.solvers.scan_error import ScanError, scan_error
from loam_gtsam.registration.solvers.seen_ground import SeenGround
from loam_gtsam.registration.solvers.sweep_velocity import ToldVelocity
from loam_gtsam.registration.uncertainty import PoseErrors, relative_covariance
from loam_gtsam.registration.uncertainty import pose_errors as covariance_module
from loam_gtsam.registration.uncertainty.frame_errors import FrameErrors
from loam_gtsam.studies.evaluation import nees
from loam_gtsam.types import Features, FrameStatus, InputError, MapUpdate, SweepMotion, Uncertainty

FRAME = 100_000_000
NONE = np.zeros((4, 6, 6))


def some_covariance(rng, scale=1e-4):
    root = scale * rng.normal(size=(6, 6))
    return root @ root.T


def some_pose(rng):
    return gtsam.Pose3.Expmap(np.concatenate([rng.normal(0, 0.5, 3), rng.normal(0, 20.0, 3)]))


def room(number, rng, noise=0.02, ends=6.0):
    """Features of frame ``number`` of a sensor at rest in a room from -ends to ends along x."""
    sides = np.array([ends, 4.0, 2.0])
    points = rng.uniform(-1, 1, (4000, 3)) * sides
    rows, axis = np.arange(4000), rng.integers(0, 3, 4000)
    points[rows, axis] = sides[axis] * rng.choice([-1.0, 1.0], 4000) + rng.normal(0.0, noise, 4000)
    return Features.from_points(number * FRAME, np.zeros((0, 3)), points)


@pytest.fixture(scope="module")
def moving():
    """A run through the built-in street that is under way."""
    world = SimulatedWorld("street_loop", frames=66, columns=900)
    return run(part(world, 40, 66), no_imu()).updates


def part(world, first, last):
    """Some sweeps of a world."""
    dataset = ListDataset([world[i] for i in range(first, last)])
    dataset.sensor = world.sensor
    return dataset


def no_imu(**covariance):
    config = Config()
    return config.changed("imu.coupling=off", covariance=config.covariance.changed(**covariance))


def made_up(stamp, pose, own, drift, shared=None, follows=None):
    shared = np.zeros((6, 6)) if shared is None else shared
    parts = Uncertainty(own, shared, follows, drift, 1.0, 100.0)
    return MapUpdate(stamp, pose, FrameStatus.OK, uncertainty=parts)


@pytest.mark.parametrize("consecutive", [False, True])
def test_relative_covariance_is_that_of_perturbed_poses(consecutive):
    rng = np.random.default_rng(5)
    one, two = some_pose(rng), some_pose(rng)
    joint = rng.normal(size=(12, 12)) * 1e-4
    joint = joint @ joint.T  # own errors of the earlier and of the later frame
    drifts = some_covariance(rng), some_covariance(rng)
    earlier = made_up(1, one, joint[:6, :6], drifts[0])
    later = made_up(2, two, joint[6:, 6:], drifts[0] + drifts[1], joint[6:, :6],
                    follows=1 if consecutive else 0)  # fmt: skip
    between = one.between(two)

    def off(first, second):
        return between.localCoordinates(first.between(second))

    by_first = numerical(lambda d: off(one.retract(d), two))
    by_second = numerical(lambda d: off(one, two.retract(d)))
    by_map = numerical(lambda d: off(one, gtsam.Pose3.Expmap(d).compose(two)))
    if not consecutive:
        joint[:6, 6:] = joint[6:, :6] = 0.0
    own = np.hstack([by_first, by_second])
    expected = own @ joint @ own.T + by_map @ drifts[1] @ by_map.T
    found = relative_covariance(earlier, later)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    assert np.linalg.eigvalsh(found).min() > 0.0


def test_frames_must_be_solved_and_in_order():
    rng = np.random.default_rng(0)
    zero = np.zeros((6, 6))
    one, two = (made_up(stamp, some_pose(rng), some_covariance(rng), zero) for stamp in (1, 2))
    predicted = MapUpdate(3, gtsam.Pose3(), FrameStatus.UNUSABLE_SCAN)
    for first, second, says in (
        (one, predicted, r"later: expected .* solved.*unusable_scan"),
        (predicted, two, "earlier: expected a frame that was solved"),
        (two, one, "later: expected a stamp after"),
        (one, one, "later: expected a stamp after"),
    ):
        with pytest.raises(InputError, match=says):
            relative_covariance(first, second)
    assert relative_covariance(one, two).shape == (6, 6)


def test_every_solved_frame_has_its_covariances(moving):
    first, *others = moving
    assert first.status is FrameStatus.FIRST
    assert first.uncertainty is None
    assert np.isnan(first.covariance).all()
    # The map begins at the first frame: its pose has no error there.
    np.testing.assert_array_equal(relative_covariance(first, others[0]), others[0].covariance)
    with pytest.raises(InputError, match="later: expected a stamp after"):
        relative_covariance(first, first)
    for earlier, update in pairwise(others):
        assert update.uncertainty.follows == earlier.stamp
        for matrix in (update.covariance, update.uncertainty.own,
                       relative_covariance(earlier, update)):  # fmt: skip
            np.testing.assert_array_equal(matrix, matrix.T)
            assert np.linalg.eigvalsh(matrix).min() > 0.0
        grown = update.uncertainty.drift - earlier.uncertainty.drift
        assert np.linalg.eigvalsh(grown).min() > -1e-9 * np.trace(grown)
        np.testing.assert_allclose(update.raw_covariance @ update.information, np.eye(6), atol=1e-6)
        assert 0.02 < update.uncertainty.residual_variance < 3.0
        rows = 2 * update.n_edge_matches + update.n_plane_matches
        assert rows / 30 < update.uncertainty.effective_matches < 2 * rows
    assert others[0].uncertainty.follows is None
    np.testing.assert_array_equal(others[0].uncertainty.shared, 0.0)


def test_drift_is_a_matter_of_the_way(moving):
    """Ten metres of new street drift more than one; the covariance in the map grows."""
    near = relative_covariance(moving[10], moving[11])
    far = relative_covariance(moving[10], moving[20])
    assert np.trace(far[3:, 3:]) > 1.5 * np.trace(near[3:, 3:])
    assert np.trace(moving[-1].covariance[3:, 3:]) > np.trace(moving[10].covariance[3:, 3:])


def test_who_stands_still_does_not_drift():
    rng = np.random.default_rng(1)
    mapper = Mapper()
    updates = [mapper.register(room(i, rng)) for i in range(40)]
    drifts = [np.trace(u.uncertainty.drift[3:, 3:]) for u in updates[1:]]
    late = drifts[-1] - drifts[19]
    assert 0.0 <= late < 0.1 * drifts[0]
    assert drifts[0] > 0.0  # the first sweep's noise stays in the map
    # Walls that were not there before
    changed = mapper.register(room(40, rng, ends=6.6))
    assert np.trace(changed.uncertainty.drift[3:, 3:]) - drifts[-1] > 5.0 * late / 20


def test_ground_that_is_new_drifts_by_the_factor():
    def drift(factor):
        world = SimulatedWorld("room", frames=6, columns=450)
        config = no_imu(drift=factor).changed(PREDICTED)
        return run(world, config).updates[-1].uncertainty.drift

    once = drift(1.0)
    assert np.trace(once) > 0.0
    np.testing.assert_allclose(drift(3.0), 3.0 * once, rtol=1e-9)
    np.testing.assert_array_equal(drift(0.0), 0.0)


def test_no_pose_depends_on_the_calibration():
    world = SimulatedWorld("room", frames=5, columns=600)
    one = run(world, no_imu()).updates
    other = run(world, no_imu(drift=0.0, match_cell=5.0, ground_cell=3.0, window=2)).updates
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.map_T_lidar.matrix(), b.map_T_lidar.matrix())
        np.testing.assert_array_equal(a.raw_covariance, b.raw_covariance)
    assert not np.allclose(one[-1].covariance, other[-1].covariance, rtol=0.01)


def test_a_prior_of_ones_own_holds_the_pose_in_spite_of_drift():
    rng = np.random.default_rng(1)
    mapper = Mapper()
    for i in range(5):
        mapper.register(room(i, rng))
    sigmas = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1e-6])
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    height = gtsam.PriorFactorPose3(POSE_KEY, gtsam.Pose3(), noise)
    free = mapper.register(room(5, rng))
    held = mapper.register(room(6, rng), priors=[height])
    assert held.covariance[5, 5] < 1e-11  # as the axes of lidar and map allow
    assert free.covariance[5, 5] > 1e-8


def test_classical_solvers_have_covariances_of_the_same_size(monkeypatch):
    begin_quickly(monkeypatch)
    world = SimulatedWorld("room", frames=16, columns=450)
    # Where all take the velocity as constant within a sweep.
    ours = run(world, no_imu().changed("deskew.model=constant")).updates[-1]
    for name in ("loam", "aloam"):
        theirs = run(world, preset(name).changed("imu.coupling=off")).updates[-1]
        ratio = np.sqrt(np.diag(theirs.uncertainty.own) / np.diag(ours.uncertainty.own))
        assert ratio.min() > 0.2
        assert ratio.max() < 6.0


def test_a_preset_that_begins_on_the_way_tells_where_its_map_lies():
    """Half a sweep's way beside the first pose, for its first sweep is not de-skewed anew."""
    world = SimulatedWorld("street_loop", frames=8, columns=450, speed=8.0, start="moving")
    result = run(world, preset("loam").changed("imu.coupling=off"))
    found = nees(result.updates, world.truth)
    assert np.abs(found.errors[:, 3]).min() > 0.25
    assert found.mean < 2.0
    assert len(found.beyond) == 0


@pytest.mark.parametrize(("reference", "share"), [("start", 0.5), ("middle", 0.0), ("end", -0.5)])
def test_the_reference_has_its_share_in_two_sweeps(reference, share):
    config = no_imu().changed({"deskew.reference": reference})
    world = SimulatedWorld("room", frames=12, columns=900)
    both = run(part(world, 6, 12), config).updates[-1].uncertainty
    ratio = np.trace(both.shared[3:, 3:]) / np.trace(both.own[3:, 3:])
    # Equal errors of both frames: h (1 - h) over (1 - h)^2 + h^2, less what acceleration adds
    expected = share * (1.0 - share) / ((1.0 - share) ** 2 + share**2)
    assert abs(ratio) <= abs(expected) * 1.3
    assert np.sign(np.round(ratio, 6)) == np.sign(expected)
    if share:
        assert abs(ratio) > 0.3 * abs(expected)


_NONE = np.zeros((0, 3)), np.zeros(0)
NO_MATCHES = ScanMatches(
    EdgeMatches(*[_NONE[0]] * 3, *[_NONE[1]] * 3, np.zeros(0, np.int64)),
    PlaneMatches(*[_NONE[0]] * 2, *[_NONE[1]] * 4, np.zeros(0, np.int64)),
)


class _Sweep:
    """As much of a sweep as the reference time needs."""

    def __init__(self, stamp, motion):
        self.stamp, self.motion, self.middle, self.duration = stamp, motion, 0.05, 0.1
        self.acceleration = self.ring_elevations = None

    def seconds(self, edges, planes):
        return np.zeros(len(edges)), np.zeros(len(planes))


def own_errors(
    acceleration, covariance, motion=SweepMotion.CONSTANT_VELOCITY, frames=250, begins=0,
    known=None, across=0.0, apart=1, turned=None, told=None,
):  # fmt: skip
    """Own error at the start of the last of many sweeps along x, accelerated after some.

    A velocity that is missed draws the pose along y by ``across`` s, as where a lidar that turns
    has its walls on one side; an acceleration draws it by a twenty-fourth of T^2.
    """
    config = Config()
    expected = [config.solver.turn_sigma, config.solver.acceleration_sigma]
    accelerations = Accelerations(config.covariance.window, np.repeat(expected, 3) ** 2)
    errors = FrameErrors(config.imu.gyro_noise)
    drawn = np.zeros((6, 6))
    drawn[4, [0, 3]] = across
    scan = ScanError(
        covariance, np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0,
        by_velocity=drawn, by_acceleration=0.1**2 / 24.0 * np.eye(6),
        told=told,
    )  # fmt: skip
    for k in range(frames):
        x = 0.5 * acceleration * (0.1 * apart * max(k - begins, 0)) ** 2
        middle = gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0]))
        sweep = _Sweep(apart * k * FRAME, motion)
        sweep.acceleration = known
        if errors.last is not None:
            accelerations.add(*errors.last, sweep.stamp, middle, covariance)
        update = MapUpdate(sweep.stamp, middle, FrameStatus.OK)
        own = errors.of(update, sweep, middle, scan, accelerations, None, turned).covariance
    return own


def test_a_frame_by_its_scan_after_one_beside_an_imu_has_a_motion_of_positive_variance():
    """The IMU knew the place at the start of that sweep better than in the middle."""
    errors, accelerations = FrameErrors(0.0), Accelerations(10, np.zeros(6))
    pose = np.diag([1e-8, 1e-8, 1e-8, 1e-4, 1e-4, 1e-4])
    faster = np.vstack([np.eye(6), np.hstack([np.zeros((3, 3)), np.eye(3) / 0.05])])
    fused = SimpleNamespace(
        covariance=faster @ pose @ faster.T + 1e-10 * np.eye(9), across=np.zeros((9, 9))
    )
    scan = ScanError(pose, np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    found = []
    for k, by_imu in enumerate((fused, None)):
        sweep = _Sweep(k * FRAME, SweepMotion.GYRO)
        update = MapUpdate(sweep.stamp, gtsam.Pose3(), FrameStatus.OK)
        found.append(errors.of(update, sweep, gtsam.Pose3(), scan, accelerations, by_imu))
    first, second = found
    assert first.covariance[3, 3] < 1e-6  # 0.05 s before the middle, which is off by a centimetre
    motion = first.covariance + second.covariance - second.shared - second.shared.T
    assert np.linalg.eigvalsh(motion).min() > 0.0


def test_what_a_constant_velocity_misses():
    """Eighth of a T^2 from the chord, and a twenty-fourth for the sweep itself."""
    still, fast = (own_errors(a, np.zeros((6, 6)))[3, 3] for a in (0.0, 3.0))
    assert still == 0.0
    assert fast == pytest.approx((3.0 * 0.1**2 / 6.0) ** 2, rel=1e-6)
    # Errors whose second differences explain any such acceleration
    noisy = np.diag([0.0, 0.0, 0.0, 1e-2, 1e-2, 1e-2])
    quiet = own_errors(3.0, noisy)
    np.testing.assert_allclose(quiet, 0.5 * noisy, atol=1e-4)


def test_a_velocity_that_is_missed_draws_the_pose_aside():
    """It is off by half of what the acceleration adds between two sweeps."""
    own = own_errors(3.0, np.zeros((6, 6)), across=0.02)
    assert own[4, 4] == pytest.approx((3.0 * 0.1 / 2.0 * 0.02) ** 2, rel=1e-6)
    assert own[3, 4] == pytest.approx(np.sqrt(own[3, 3] * own[4, 4]), rel=1e-6)
    assert own_errors(3.0, np.zeros((6, 6)))[4, 4] == 0.0


def test_sweeps_far_apart_do_not_show_how_fast_the_lidar_sways():
    """The same second differences, as far apart as the sweeps are long, and five times as far."""
    near, far = (
        own_errors(a, np.zeros((6, 6)), across=0.02, apart=apart)
        for a, apart in ((3.0, 1), (3.0 / 25.0, 5))
    )
    np.testing.assert_allclose(far, near, rtol=1e-6)
    assert near[3, 3] > 0.0


def test_an_acceleration_that_has_just_begun_counts_in_full():
    steady, begun = (own_errors(3.0, np.zeros((6, 6)), begins=k)[3, 3] for k in (0, 247))
    assert begun == pytest.approx(steady, rel=1e-6)
    over = own_errors(3.0, np.zeros((6, 6)), begins=248)[3, 3]  # half of it shows so far
    assert over == pytest.approx(0.25 * steady, rel=1e-6)


def test_a_sweep_de_skewed_with_its_acceleration_misses_what_nobody_expected():
    steady, known = (own_errors(3.0, np.zeros((6, 6)), known=a)[3, 3] for a in (None, np.zeros(6)))
    assert known < 0.05 * steady
    # At its onset, it is as unknown as without.
    onset = [own_errors(3.0, np.zeros((6, 6)), begins=248, known=a) for a in (None, np.zeros(6))]
    np.testing.assert_allclose(onset[0], onset[1], rtol=1e-6)


def test_what_the_matches_have_told_of_the_velocity_is_not_missed():
    """Of a sway only what is no parabola within the sweep is left, and what they have not told."""
    known, none = np.zeros(6), np.zeros((6, 6))
    untold = own_errors(3.0, none, known=known, begins=246)[3, 3]
    told, partly = (
        own_errors(
            3.0,
            none,
            known=known,
            begins=246,
            told=ToldVelocity(np.zeros(6), knows * np.eye(6), none),
        )[3, 3]
        for knows in (1e12, 400.0)
    )
    assert told < 0.1 * untold
    assert told < partly < untold


def test_a_gyro_leaves_its_noise():
    own = own_errors(0.0, np.zeros((6, 6)), SweepMotion.GYRO)
    expected = Config().imu.gyro_noise ** 2 * 0.05
    np.testing.assert_allclose(np.diag(own)[:3], expected, rtol=1e-9)
    np.testing.assert_array_equal(own_errors(0.0, np.zeros((6, 6)), SweepMotion.ORIENTATION), 0.0)


def test_a_scan_that_a_gyro_has_turned_errs_with_the_turn_to_the_reference():
    """What has moved the pose forth has turned the reference back."""
    scan = ScanError(
        1e-8 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0,
        by_turns=-2e-10 * np.eye(6, 3),
    )  # fmt: skip
    errors, accelerations = FrameErrors(2e-4), Accelerations(10, np.zeros(6))
    sweep, update = _Sweep(0, SweepMotion.GYRO), MapUpdate(0, gtsam.Pose3(), FrameStatus.OK)
    own = errors.of(update, sweep, gtsam.Pose3(), scan, accelerations, None).covariance
    np.testing.assert_allclose(np.diag(own)[:3], 1e-8 + 2e-4**2 * 0.05 - 4e-10, rtol=1e-9)


@pytest.mark.parametrize(("middle", "since"), [(0.05, -1.0), (0.0, 0.0), (-0.05, 1.0)])
def test_where_the_gyro_alone_leads_its_noise_counts_from_one_reference_to_the_next(middle, since):
    """No scan tells: so what it turned between a reference and a later middle does not matter."""
    noise, known = 2e-4, 1e-8
    scan = ScanError(np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    errors, accelerations = FrameErrors(noise), Accelerations(10, np.zeros(6))
    turned, found = noise**2 * np.diag([0.1] * 3 + [0.0] * 6), []
    for k in range(2):
        sweep = _Sweep(k * FRAME, SweepMotion.GYRO)
        sweep.middle = middle
        update = MapUpdate(sweep.stamp, gtsam.Pose3(), FrameStatus.OK)
        before = known * np.eye(9) + k * turned
        fused = SimpleNamespace(covariance=before + turned, across=before)
        found.append(errors.of(update, sweep, gtsam.Pose3(), scan, accelerations, fused))
    first, second = found
    own = known + noise**2 * (0.1 + since * 0.05)
    np.testing.assert_allclose(np.diag(first.covariance)[:3], own, rtol=1e-9)
    motion = first.covariance + second.covariance - second.shared - second.shared.T
    np.testing.assert_allclose(np.diag(motion)[:3], noise**2 * 0.1 * (1 + max(since, 0)), rtol=1e-6)


def test_a_gyro_that_turns_unlike_the_scans_bends_the_sweep_and_leads_elsewhere():
    more, none = np.array([0.04, 0.0, 0.0]), np.zeros((6, 6))
    args = {"across": 0.02, "turned": more}
    own, right, gyroless = (
        own_errors(0.0, none, motion, **{**args, **changes})
        for motion, changes in (
            (SweepMotion.GYRO, {}),
            (SweepMotion.GYRO, {"turned": np.zeros(3)}),
            (SweepMotion.CONSTANT_VELOCITY, {}),
        )
    )
    added = np.diag(own - right)
    assert added[0] == pytest.approx((0.04 * 0.05) ** 2, rel=1e-6)
    assert added[4] == pytest.approx((0.04 * 0.02) ** 2, rel=0.05)
    np.testing.assert_array_equal(gyroless, own_errors(0.0, none, across=0.02))
    # What the noise of two scans, 0.1 s apart, makes of it is no sign of anything.
    noisy = np.diag([0.04**2 * 0.1**2 / 2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    quiet = own_errors(0.0, noisy, SweepMotion.GYRO, **args)
    np.testing.assert_allclose(quiet, own_errors(0.0, noisy, SweepMotion.GYRO), atol=1e-12)


def calibrated(errors, number, map_T_lidar=None, twist=None, x=0.0, last=None, **more):
    """A frame at rest or at ``x``, whatever its matches are."""
    pose, twist = map_T_lidar or gtsam.Pose3(), np.zeros(6) if twist is None else twist
    stamp, middle = number * FRAME, gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0]))
    moment = {"middle_stamp": stamp, "map_T_middle": middle}
    update = MapUpdate(stamp, pose, FrameStatus.OK, twist=twist, **moment)
    solution = Solution.unsolved(middle, NO_MATCHES, 1, 1)
    sweep = _Sweep(number * FRAME, SweepMotion.CONSTANT_VELOCITY)
    return errors.calibrated(update, sweep, solution, errors.of_scan(solution, sweep), last, **more)


def test_the_error_of_the_origin_is_that_of_the_first_motion(monkeypatch):
    """Whoever brakes hard later does not move it; whoever started so has an origin in doubt."""
    good = ScanError(1e-10 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)

    def told(accelerations):
        errors, speed, x, found = PoseErrors(Config()), 0.0, 0.0, []
        errors.skipped(PosedSweep(_Sweep(0, SweepMotion.CONSTANT_VELOCITY), np.zeros(6)))
        for number, acceleration in enumerate(accelerations, start=1):
            speed += 0.1 * acceleration
            x += 0.1 * speed
            last = Moment(0, gtsam.Pose3(), True) if number == 1 else None
            update = calibrated(errors, number, x=x, last=last)
            found.append(update.covariance[3, 3] - update.uncertainty.own[3, 3])
        return np.sqrt(found)

    late, early = told([0.0] * 10 + [3.0] * 5), told([3.0] * 5 + [0.0] * 10)
    missed = 0.5 * 0.05 * 0.15  # s^2, from the middle between both sweeps back to the start
    unknown = missed * Config().solver.acceleration_sigma
    assert late[0] == pytest.approx(unknown, rel=1e-3)
    assert late[-1] < 0.01 * unknown
    assert early[-1] == pytest.approx(3.0 * missed, rel=1e-3)
    # The first two motions are between three sweeps, the very first one among them.
    assert told([10.0, -6.0] + [0.0] * 10)[-1] == pytest.approx(
        6.0 * missed / np.sqrt(3.0), rel=1e-3
    )


def test_a_lidar_that_turns_tilts_the_map_by_what_it_missed_in_its_first_sweep(monkeypatch):
    """It sees the floor on either side at its own time: a height that is missed looks like a roll.

    The floor as it was mapped, and as it was, by the reference that is held and the velocity from
    the middle of the first sweep to that of the second.
    """
    seconds = np.linspace(-0.05, 0.05, 2000)
    side, up = 5.0 * np.cos(20.0 * np.pi * seconds + 1.0), 3.0
    floor = np.column_stack([5.0 * np.sin(40.0 * np.pi * seconds), side, np.full(2000, -1.0)])
    walls = np.random.default_rng(0).uniform(-9.0, 9.0, (2000, 3))
    points, normals = np.concatenate([floor, walls]), np.repeat(np.eye(3)[[2, 0]], 2000, axis=0)
    normals[3000:] = [0.0, 1.0, 0.0]
    way = up * ((seconds**2 - 0.05**2) / 2.0 - 0.5 * 0.1 * (seconds + 0.05))
    errors = np.append(way, np.zeros(2000))  # how much higher it is than it was mapped
    there = gtsam.Pose3()
    step = solved(points, normals, -errors, there)[1]
    solution = solved(points, normals, np.random.default_rng(1).normal(0, 1e-9, 4000), there)[0]
    times = np.append(seconds, np.zeros(2000))
    found = scan_error(solution, np.inf, SeenGround(), Config().covariance, seconds=times)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: found)
    errors = PoseErrors(
        Config().changed(f"solver.acceleration_sigma={up}", "solver.turn_sigma=0.001")
    )
    errors.skipped(PosedSweep(_Sweep(0, SweepMotion.CONSTANT_VELOCITY), np.zeros(6)))
    update = calibrated(errors, 1, last=None)
    told = np.sqrt(np.diag(update.covariance - update.uncertainty.own))
    assert abs(step[0]) > 1e-4
    assert told[0] == pytest.approx(abs(step[0]), rel=0.05)
    assert 1.0 < told[5] / abs(step[5]) < 1.3  # what cancels along one axis is not counted on


def test_new_ground_adds_to_the_drift(monkeypatch):
    def error(solution, width, seen, config, **_):
        return ScanError(1e-6 * np.eye(6), 1e-8 * np.eye(6), *NONE, np.zeros(6), 1.0, 10.0)

    monkeypatch.setattr(covariance_module, "scan_error", error)
    errors = PoseErrors(Config())
    drifts = [calibrated(errors, k).uncertainty.drift[0, 0] for k in range(3)]
    once = Config().covariance.drift * 1e-8
    np.testing.assert_allclose(drifts, [once, 2.0 * once, 3.0 * once])


def test_ground_is_not_new_because_the_place_has_become_small(monkeypatch):
    """Its cells are others, but what was matched in the frame of the change was mapped before."""
    fresh = []

    def error(solution, width, seen, config, **_):
        points = solution.matches.planes.points
        since = seen.cells(points, np.full(len(points), 3), config.ground_cell)[1]
        fresh.append(np.count_nonzero(since == seen.scans))
        seen.add(np.zeros(6))
        return ScanError(1e-6 * np.eye(6), 1e-8 * np.eye(6), *NONE, np.zeros(6), 1.0, 10.0)

    monkeypatch.setattr(covariance_module, "scan_error", error)
    errors, ground = PoseErrors(Config()), np.array([[0.1, 0.1, 0.1], [0.1, 0.1, 0.5]])
    none, one, up = NO_MATCHES.edges, np.ones(2), [0, 0, 1]
    steps = ((0.0, False), (0.0, True), (0.0, True), (5.0, True), (0.0, False), (5.0, False))
    for number, (height, small) in enumerate(steps):
        planes = PlaneMatches(ground + height, np.array([up, up]), one, one, one, one, np.arange(2))
        matches = ScanMatches(none, planes)
        solution = replace(Solution.unsolved(gtsam.Pose3(), NO_MATCHES, 1, 1), matches=matches)
        update = MapUpdate(number * FRAME, gtsam.Pose3(), FrameStatus.OK)
        sweep = _Sweep(number * FRAME, SweepMotion.CONSTANT_VELOCITY)
        errors.calibrated(
            update, sweep, solution, errors.of_scan(solution, sweep, small=small), None
        )
    assert fresh == [1, 0, 0, 2, 0, 1]  # cells of 0.8 m, and of 0.4 m in small places


def test_a_pose_so_far_off_that_its_adjoint_is_singular(monkeypatch):
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    far = gtsam.Pose3(gtsam.Rot3(), np.array([-3e16, -2e16, -3e16]))
    assert np.linalg.matrix_rank(far.between(gtsam.Pose3()).AdjointMap()) < 6
    errors = PoseErrors(Config())
    for number in range(2):
        assert np.isfinite(calibrated(errors, number, far).covariance).all()


@pytest.mark.parametrize(
    ("step", "usual", "seconds", "unlike", "told"),
    [
        ([0.0, 0.0, 0.0, 1.4, 0.0, 0.0], 0.0, 0.1, False, False),  # the same place
        ([0.0, 0.0, 0.2, 0.0, 0.0, 0.0], 0.0, 0.1, False, False),
        ([0.0, 0.0, 0.0, 5.0, -2.0, 0.0], 0.0, 0.1, False, True),
        ([0.0, 0.0, 0.3, 0.0, 0.0, 0.0], 0.0, 0.1, False, True),
        ([0.0, 0.0, 0.3, 0.0, 0.0, 0.0], 20.0, 0.1, False, False),  # 30 rad/s^2 once more
        ([0.0, 0.0, 0.7, 0.0, 0.0, 0.0], 20.0, 0.1, False, True),
        ([0.0, 0.0, 0.3, 0.0, 0.0, 0.0], 20.0, 0.2, False, True),  # not over two sweeps
        ([0.0, 0.0, 0.0, 0.4, 0.0, 0.0], 20.0, 0.1, True, True),  # the IMU knew better
    ],
)
def test_a_pose_found_where_no_motion_leads_may_be_wrong_by_the_step(
    step, usual, seconds, unlike, told, monkeypatch
):
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    errors = PoseErrors(Config())
    before = [calibrated(errors, k) for k in range(6)][-1]
    found = gtsam.Pose3().retract(np.array(step))
    errors._motion._mean[:] = [0.0, 0.0, usual**2, usual**2, 0.0, 0.0]
    stamp = before.stamp + round(seconds * 1e9)
    posed = PosedSweep(SimpleNamespace(stamp=stamp), np.zeros(6))
    expected = SimpleNamespace(map_T_middle=gtsam.Pose3(), posed=posed, inertial=None)
    _, by_motion = errors.gap.bridged(stamp, np.ones(6))
    errors.jumped(expected, replace(posed, twist=np.ones(6)), found, unlike=unlike)
    after = calibrated(errors, 6, found)
    added = np.diag(after.uncertainty.drift - before.uncertainty.drift)
    expected = told * 0.5 * (np.square(step) + np.diag(by_motion))
    np.testing.assert_allclose(added, expected, atol=1e-6)
    # The motion after it is as well known as ever.
    later = calibrated(errors, 7, found)
    assert np.abs(relative_covariance(after, later)).max() < 0.1


@pytest.mark.parametrize(("searched", "inertial"), [(10.0, False), (0.0, False), (10.0, True)])
def test_what_was_looked_for_in_vain_may_be_farther_off(searched, inertial, monkeypatch):
    """Even if it has moved little; but not if gyro and accelerometer know where it is."""
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    errors = PoseErrors(Config())
    before = [calibrated(errors, k) for k in range(6)][-1]
    posed = PosedSweep(SimpleNamespace(stamp=before.stamp + FRAME), np.zeros(6))
    told = SimpleNamespace(covariance_in_map=1e-4 * np.eye(6)) if inertial else None
    expected = SimpleNamespace(map_T_middle=gtsam.Pose3(), posed=posed, inertial=told)
    found = gtsam.Pose3(gtsam.Rot3(), [0.4, 0.0, 0.0])
    errors.jumped(
        expected, replace(posed, twist=np.ones(6)), found, unlike=False, searched=searched
    )
    added = np.diag(calibrated(errors, 6, found).uncertainty.drift - before.uncertainty.drift)
    assert np.sqrt(added[3:]).max() < 0.3 if inertial or not searched else added[4] > 49.0


def test_a_guess_that_led_elsewhere_is_no_error_of_the_map(monkeypatch):
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    errors = PoseErrors(Config())
    before = [calibrated(errors, k) for k in range(6)][-1]
    posed = PosedSweep(SimpleNamespace(stamp=before.stamp + 2 * FRAME), np.zeros(6))
    away = gtsam.Pose3(gtsam.Rot3(), [60.0, 0.0, 0.0])
    expected = SimpleNamespace(map_T_middle=away, posed=posed, inertial=None)
    found = gtsam.Pose3(gtsam.Rot3(), [0.02, 0.0, 0.0])  # where the last motion leads
    errors.jumped(expected, replace(posed, twist=np.ones(6)), found, unlike=False)
    added = calibrated(errors, 7, found).uncertainty.drift - before.uncertainty.drift
    assert 0.01 < np.sqrt(added[3, 3]) < 0.1


@pytest.mark.parametrize("unlike", [False, True])
def test_an_imu_tells_what_may_have_happened_unless_the_pose_contradicts_it(unlike, monkeypatch):
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    errors = PoseErrors(Config())
    before = [calibrated(errors, k) for k in range(6)][-1]
    stamp, step = before.stamp + 10 * FRAME, np.array([0.0, 0.0, 0.0, 5.0, 0.0, 0.0])
    posed = PosedSweep(SimpleNamespace(stamp=stamp), np.zeros(6))
    by_imu = SimpleNamespace(covariance_in_map=0.04 * np.eye(6))
    expected = SimpleNamespace(map_T_middle=gtsam.Pose3(), posed=posed, inertial=by_imu)
    missed = errors.gap.bridged(stamp, posed.twist)[1] if unlike else by_imu.covariance_in_map
    found = gtsam.Pose3().retract(step)
    errors.jumped(expected, posed, found, unlike=unlike)
    added = calibrated(errors, 15, found).uncertainty.drift - before.uncertainty.drift
    np.testing.assert_allclose(np.diag(added), 0.5 * (step**2 + np.diag(missed)), rtol=0.01)


@pytest.mark.parametrize("kept", [True, False])
def test_a_sweep_that_was_moved_but_keeps_its_motion_was_hardly_taken_in_that(kept, monkeypatch):
    """At its start, half of the time since the last one away, it may be off by half of the step."""
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    step, own = np.array([0.0, 0.1, 0.0, 0.2, 0.0, 0.0]), []
    found = gtsam.Pose3().retract(step)
    for moved in (False, True):
        errors = PoseErrors(Config())
        for k in range(6):
            calibrated(errors, k)
        before = PosedSweep(SimpleNamespace(stamp=6 * FRAME), np.zeros(6))
        after = before if kept else replace(before, twist=np.ones(6))
        expected = SimpleNamespace(map_T_middle=gtsam.Pose3(), posed=before, inertial=None)
        if moved:
            errors.jumped(expected, after, found, unlike=False)
        own.append(calibrated(errors, 6).uncertainty.own)
        later = calibrated(errors, 7).uncertainty.own
    np.testing.assert_allclose(own[1] - own[0], kept * np.outer(step, step) / 4.0, atol=1e-9)
    assert later[4, 4] == pytest.approx(own[0][4, 4], rel=0.1)


def test_a_singular_frame_has_no_covariance_and_the_next_follows_none(monkeypatch):
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    answers = iter([good, good, None, good])
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: next(answers))
    errors = PoseErrors(Config())
    updates = [calibrated(errors, k) for k in range(4)]
    assert updates[1].uncertainty.follows == updates[0].stamp
    assert updates[2].uncertainty is None
    assert np.isnan(updates[2].covariance).all()
    assert updates[3].uncertainty.follows is None
    np.testing.assert_array_equal(updates[3].uncertainty.shared, 0.0)


def test_a_first_sweep_that_is_not_de_skewed_anew_leaves_the_origin_aside(monkeypatch):
    """By the way to the middle of the sweep, if the run begins on the way."""
    good = ScanError(1e-10 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    speed = np.array([0.0, 0.0, 0.0, 8.0, 0.0, 0.0])

    def told(model, first):
        errors = PoseErrors(Config().changed({"deskew.model": model}))
        errors.skipped(PosedSweep(_Sweep(0, SweepMotion.CONSTANT_VELOCITY), first))
        update = calibrated(errors, 1, x=0.8, last=None, twist=speed)
        return update.covariance[3, 3]

    aside = 8.0 * 0.05
    known = told("linear", np.zeros(6))
    assert told("predicted", np.zeros(6)) == pytest.approx(known + aside**2, rel=1e-6)
    assert told("predicted", speed) == pytest.approx(known, rel=1e-6)


def test_a_rival_that_parts_from_the_motion_goes_on_being_an_error_of_the_map(monkeypatch):
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    velocity = np.diag([0.0, 0.0, 0.0, 9.0, 0.0, 0.0])
    told = []
    for parting in (velocity, 0.0 * velocity):
        errors, seconds = PoseErrors(Config()), 1e-9 * FRAME * np.arange(1, 7)
        errors.skipped(PosedSweep(_Sweep(0, SweepMotion.CONSTANT_VELOCITY), np.zeros(6)))
        doubt = seconds[1] ** 2 * velocity  # as far as it has come with the second frame
        rivals = [
            (doubt, None),
            (doubt, parting),
            (None, None),
            (0.0 * doubt, None),
            *2 * [(None, None)],
        ]
        updates = [
            calibrated(errors, k, doubt=one, parting=other)
            for k, (one, other) in enumerate(rivals, start=1)
        ]
        told.append([update.covariance[3, 3] for update in updates])
        assert np.linalg.eigvalsh(relative_covariance(*updates[-2:]))[0] > 0.0
        motion = relative_covariance(updates[-2], updates[-1])[3, 3]
        apart = parting[3, 3] * (seconds[-1] - seconds[-2]) ** 2
        assert apart <= motion <= parting[3, 3] * (seconds[-1] ** 2 - seconds[-2] ** 2) + 1e-3
    np.testing.assert_allclose(told[0][2:], 9.0 * seconds[2:] ** 2, rtol=0.02)
    np.testing.assert_allclose(told[1][2:], 9.0 * seconds[1] ** 2, rtol=0.02)


@pytest.mark.parametrize("stays", [True, False])
def test_what_is_in_doubt_at_the_end_of_the_start_is_an_error_of_the_map(stays, monkeypatch):
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    errors, doubt = PoseErrors(Config()), np.diag([0.0, 0.0, 0.0, 4.0, 1.0, 0.0])
    doubts = [doubt, doubt, doubt if stays else 0.0 * doubt, None, None]
    updates = [calibrated(errors, k, doubt=one) for k, one in enumerate(doubts)]
    told = np.array([np.diag(update.covariance)[3:5] for update in updates])
    assert (told[:2] > [4.0, 1.0]).all()
    assert (told[2:] > [4.0, 1.0]).all() == stays
    assert (told[2:] < 0.1).all() != stays
    in_doubt = [update.uncertainty.in_doubt for update in updates if update.uncertainty is not None]
    assert in_doubt == [True, True, stays, False, False]
    # Nothing is in doubt that lies behind both frames.
    assert np.diag(relative_covariance(*updates[-2:]))[3] < 0.1
    motion = relative_covariance(*updates[:2])
    assert np.linalg.eigvalsh(motion)[0] > 0.0
    assert motion[3, 3] > 4.0


def test_a_map_that_loops_have_moved_is_an_error_of_the_pose_and_not_of_its_motion(monkeypatch):
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    errors = PoseErrors(Config())
    before = [calibrated(errors, k) for k in range(4)][-1]
    errors.moved(gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.0, 0.0])))
    errors.moved(gtsam.Pose3(gtsam.Rot3(), np.array([0.0, -0.4, 0.0])))
    after = calibrated(errors, 4)
    added = np.diag(after.covariance - before.covariance)
    np.testing.assert_allclose(added, [0.0, 0.0, 0.0, 0.09, 0.16, 0.0], atol=1e-4)
    assert np.abs(relative_covariance(before, after)).max() < 1e-4


@pytest.mark.parametrize("paused", [True, False])
def test_after_a_pause_the_velocity_may_have_turned(paused, monkeypatch):
    good = ScanError(1e-6 * np.eye(6), np.zeros((6, 6)), *NONE, np.zeros(6), 1.0, 10.0)
    monkeypatch.setattr(covariance_module, "scan_error", lambda *_, **__: good)
    errors = PoseErrors(Config())
    for k in range(6):
        calibrated(errors, k)
    if paused:
        errors.cut(10**8)
    # 2 m/s round a bend of 0.5 rad/s for a second: 1 m/s, over the half of a sweep.
    twist = np.array([0.0, 0.0, 0.5, 2.0, 0.0, 0.0])
    told = [calibrated(errors, k, twist=twist).uncertainty.own for k in (6, 7)]
    expected = [0.05 if paused else 0.0, 0.0]
    np.testing.assert_allclose([np.sqrt(own[4, 4]) for own in told], expected, atol=2e-3)
