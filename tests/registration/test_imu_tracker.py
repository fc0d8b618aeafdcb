"""What the mapper makes of an IMU, on scans solved by the real solver and IMUs in closed form."""

import dataclasses
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from support.imu import START, as_seen_by, motion, moving, part, rot, rot3, turning
from support.matches import make_matches

from loam_gtsam.config import ImuConfig, SolverConfig
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.imu.level import Level
from loam_gtsam.imu_prior import roll_pitch, roll_pitch_jacobian, tilt_information
from loam_gtsam.io.state import freeze
from loam_gtsam.registration.imu_tracker import ImuTracker
from loam_gtsam.registration.odometry import Moment
from loam_gtsam.registration.solvers import POSE_KEY, GtsamSolver
from loam_gtsam.types import ImuSamples, TiltPrior

NOW = START + 500_000_000
FLAT = gtsam.Rot3()
FRAME = 100_000_000
SOLVER = GtsamSolver(SolverConfig(rotation_tolerance_deg=1e-9, translation_tolerance=1e-9))


def tracker_for(measured, level_R_map=None, **config):
    """A tracker that knows up in the map; ``measured`` is the IMU's rotation or its samples."""
    samples = turning(measured) if isinstance(measured, gtsam.Rot3) else measured
    tracker = new_tracker(samples, **config)
    tracker.level = Level(level_R_map or FLAT, 0.0, 0.0, 1, "still", felt=False)
    return tracker


def along(axis):
    """The projector onto an axis of the tangent, as a solver tells that it is weak."""
    return np.diag(np.eye(6)[axis])


def new_tracker(samples, **config):
    config = ImuConfig(**config)
    return ImuTracker(config, ImuBuffer(config, samples))


def solve(seed, map_T_lidar, factors=()):
    matches = make_matches(map_T_lidar, 40, 250, noise=0.02, seed=seed)
    return SOLVER.solve(lambda pose: matches, map_T_lidar, factors)


def with_information(pose, information):
    """A solution that the solver might have come to."""
    solution = solve(0, gtsam.Pose3())
    return dataclasses.replace(solution, map_T_lidar=pose, information=information)


def tilt_of(pose, level_R_map=FLAT):
    """Roll and pitch of a pose, (2,) degrees."""
    return np.degrees(roll_pitch(level_R_map.compose(pose.rotation())))


def compare(tracker, poses):
    for last, now in pairwise(poses):
        tracker.compare_gyro(last, now)


@pytest.mark.parametrize("weight", [0.002, 0.5])
@pytest.mark.parametrize("tilt", [(50, -60), (-170, 20), (3, 1)])
def test_scan_and_imu_meet_at_the_mean_of_the_blend(weight, tilt):
    """In a map that is not level."""
    level_R_map = gtsam.Rot3.Expmap(np.array([0.3, -0.2, 0.1]))
    truth = gtsam.Pose3(level_R_map.inverse().compose(rot3(*tilt, 140)), np.array([5.0, 30.0, 2.0]))
    measured = rot3(tilt[0] + 0.8, tilt[1] - 0.6, -20)
    solution = solve(1, truth)
    found, by = tracker_for(measured, level_R_map, weight=weight).add_tilt(NOW, solution)
    assert by is TiltPrior.EQUIVALENT
    before, after = (tilt_of(each.map_T_lidar, level_R_map) for each in (solution, found))
    mean = (1 - weight) * before + weight * np.degrees(roll_pitch(measured))
    np.testing.assert_allclose(after, mean, atol=5e-5)
    assert np.abs(after - before).max() > 0.05 * weight


def test_the_information_grows_by_that_of_the_prior():
    solution = solve(2, gtsam.Pose3())
    found, _ = tracker_for(rot3(0.01, -0.02, 0), weight=0.2).add_tilt(NOW, solution)
    jacobian = roll_pitch_jacobian(solution.map_T_lidar.rotation())
    knows = tilt_information(solution.information, solution.map_T_lidar.rotation())
    expected = solution.information + 0.25 * jacobian.T @ knows @ jacobian
    scale = 1e-3 * expected.max()
    np.testing.assert_allclose(found.information, expected, atol=scale)


@pytest.mark.parametrize(
    ("sigma_deg", "tilt", "share"),
    [
        (0.49, TiltPrior.EQUIVALENT, 0.002),
        (0.51, TiltPrior.GRAVITY, 0.51**2 / (0.51**2 + 0.25)),
        (50.0, TiltPrior.GRAVITY, 50.0**2 / (50.0**2 + 0.25)),
    ],
)
def test_gravity_takes_over_where_the_scan_knows_less_than_the_imu(sigma_deg, tilt, share):
    """The worked example of docs/maths/imu_prior.md: a scan that knows roll only to sigma_deg."""
    tracker = tracker_for(rot3(0.1, 0, 0), sigma_deg=0.5, weight=0.002)
    scan = np.radians(sigma_deg) ** -2.0
    solution = with_information(gtsam.Pose3(), np.diag([scan, 1e6, 1e6, 1e6, 1e6, 1e6]))
    found, by = tracker.add_tilt(NOW, solution)
    assert by is tilt
    np.testing.assert_allclose(tilt_of(found.map_T_lidar), [0.1 * share, 0.0], atol=1e-6)
    # What is known of roll is the sum of the two in every case.
    assert found.information[0, 0] == pytest.approx(scan / (1.0 - share), rel=1e-4)


def test_what_only_the_expected_motion_says_about_the_tilt_does_not_count():
    """Roll is in the information, but it is a direction that the solver found to be weak."""
    solution = with_information(gtsam.Pose3(), 1e6 * np.eye(6))
    tracker = tracker_for(rot3(0.1, 0, 0))
    assert tracker.add_tilt(NOW, solution)[1] is TiltPrior.EQUIVALENT
    blind = dataclasses.replace(solution, weak=along(0))
    assert tracker.add_tilt(NOW, blind)[1] is TiltPrior.GRAVITY
    forward = dataclasses.replace(solution, weak=along(3))
    assert tracker.add_tilt(NOW, forward)[1] is TiltPrior.EQUIVALENT


def test_a_scan_that_says_nothing_about_the_tilt_gets_it_from_gravity():
    """A wall straight ahead fixes pitch and yaw, and a roll about its normal not at all."""
    information = np.diag([0.0, 1e6, 1e6, 1e6, 0.0, 0.0])
    solution = with_information(gtsam.Pose3(), information)
    found, tilt = tracker_for(rot3(3, 0, 0)).add_tilt(NOW, solution)
    assert tilt is TiltPrior.GRAVITY
    assert np.isfinite(found.information).all()
    np.testing.assert_allclose(tilt_of(found.map_T_lidar), [3.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(found.map_T_lidar.translation(), 0.0, atol=1e-6)


@pytest.mark.parametrize("sigma_deg", [0.02, 0.1, 1.0])
def test_a_gravity_direction_moves_the_tilt_by_the_kalman_gain(sigma_deg):
    measured = rot3(0.02, -0.03, 0)
    tracker = tracker_for(measured, prior="sigma", sigma_deg=sigma_deg)
    truth = gtsam.Pose3(rot3(0, 0, 40), np.array([10.0, 0.0, 0.0]))
    alone, both = solve(3, truth), solve(3, truth, tracker.factors(NOW))
    assert tracker.add_tilt(NOW, both) == (both, TiltPrior.GRAVITY)  # it was in the solve
    jacobian = roll_pitch_jacobian(alone.map_T_lidar.rotation())
    covariance = np.linalg.inv(alone.information)
    of_tilt = jacobian @ covariance @ jacobian.T
    gain = covariance @ jacobian.T @ np.linalg.inv(of_tilt + np.radians(sigma_deg) ** 2 * np.eye(2))
    expected = gain @ (roll_pitch(measured) - roll_pitch(alone.map_T_lidar.rotation()))
    moved = alone.map_T_lidar.localCoordinates(both.map_T_lidar)
    np.testing.assert_allclose(moved, expected, atol=1e-3 * np.linalg.norm(expected))


def test_only_sigma_is_a_factor_of_the_solve_and_off_leaves_the_pose():
    for prior in ("off", "blend", "equivalent"):
        assert tracker_for(rot3(1, 0, 0), prior=prior).factors(NOW) == ()
    (factor,) = tracker_for(rot3(1, 0, 0), prior="sigma").factors(NOW)
    assert list(factor.keys()) == [POSE_KEY]
    solution, off = with_information(gtsam.Pose3(), np.eye(6)), tracker_for(FLAT, prior="off")
    assert off.add_tilt(NOW, solution) == (solution, TiltPrior.NONE)
    assert off.blend_tilt(NOW, solution.map_T_lidar) == (solution.map_T_lidar, TiltPrior.NONE)


def test_blend_is_done_after_the_solve():
    level_R_map = rot3(-4, 3, 10)
    tracker = tracker_for(rot3(5, -2, 0), level_R_map, prior="blend", weight=0.1)
    solution = solve(5, gtsam.Pose3(level_R_map.inverse(), np.ones(3)))
    assert tracker.add_tilt(NOW, solution) == (solution, TiltPrior.NONE)
    pose, tilt = tracker.blend_tilt(NOW, solution.map_T_lidar)
    assert tilt is TiltPrior.BLEND
    before, after = tilt_of(solution.map_T_lidar, level_R_map), tilt_of(pose, level_R_map)
    np.testing.assert_allclose(after, 0.9 * before + [0.5, -0.2], atol=1e-7)


@pytest.mark.parametrize(("seconds", "least", "most"), [(0.0, 6.0, 15.0), (0.1, 1.0, 4.0)])
def test_the_tilt_of_a_frame_is_the_mean_over_its_sweep(seconds, least, most):
    """Samples of 10 mrad of noise, on a platform that turns: the gyro brings them together."""
    attitude, rate = rot3(3.0, -2.0, 40.0), (0.3, -0.2, 0.8)
    config = {"prior": "blend", "weight": 0.999, "average_seconds": seconds}
    noisy, exact = (
        tracker_for(turning(attitude, rate, noise=noise), **config) for noise in (0.01, 0.0)
    )
    stamps, pose = NOW + 20_000_000 * np.arange(-8, 9), gtsam.Pose3()
    found, true = (
        np.array([tilt_of(one.blend_tilt(int(stamp), pose)[0]) for stamp in stamps])
        for one in (noisy, exact)
    )
    assert least < 1e3 * np.radians(np.sqrt(np.mean((found - true) ** 2))) < most  # mrad


@pytest.mark.parametrize("pitch", [90.0, -90.0, 85.01, -85.01])
@pytest.mark.parametrize("prior", ["equivalent", "blend"])
def test_near_a_pitch_of_90_degrees_the_gravity_direction_takes_over(pitch, prior):
    tracker = tracker_for(rot3(20, pitch, 0), prior=prior, weight=0.1)
    pose = gtsam.Pose3(rot3(22, np.sign(pitch) * 89.0, 50), np.ones(3))
    solution = solve(6, pose)
    if prior == "equivalent":
        found, tilt = tracker.add_tilt(NOW, solution)
        assert np.isfinite(found.information).all()
        found = found.map_T_lidar
    else:
        found, tilt = tracker.blend_tilt(NOW, solution.map_T_lidar)
    assert tilt is TiltPrior.GRAVITY
    imu_up = tracker.buffer.orientation(NOW).matrix()[2]

    def away(at):
        return np.arccos(np.clip(at.rotation().matrix()[2] @ imu_up, -1, 1))

    # Nearer to the IMU, and no yaw out of nothing: it moved by no more than it had to.
    assert away(found) < away(solution.map_T_lidar)
    turned = np.linalg.norm(solution.map_T_lidar.localCoordinates(found)[:3])
    assert turned < 1.01 * away(solution.map_T_lidar)


@pytest.mark.parametrize("steep", ["pose", "imu"])
def test_a_steep_pitch_counts_however_well_the_scan_knows_it(steep):
    pitches = (85.2, 84.0) if steep == "pose" else (84.0, 85.2)
    pose = gtsam.Pose3(rot3(20, pitches[0], 50), np.ones(3))
    solution = with_information(pose, 1e9 * np.eye(6))
    assert tracker_for(rot3(20, pitches[1], 0)).add_tilt(NOW, solution)[1] is TiltPrior.GRAVITY
    below = dataclasses.replace(solution, map_T_lidar=gtsam.Pose3(rot3(20, 84.0, 50), np.ones(3)))
    assert tracker_for(rot3(20, 84.0, 0)).add_tilt(NOW, below)[1] is TiltPrior.EQUIVALENT


@pytest.mark.parametrize("prior", ["equivalent", "blend", "sigma"])
@pytest.mark.parametrize("gap", [0.09, 0.11])
def test_in_a_gap_the_prior_is_dropped(prior, gap):
    samples = turning(rot3(1, 0, 0))
    away = np.abs(samples.stamps - NOW) * 1e-9
    tracker = tracker_for(part(samples, away >= 0.5 * gap - 0.001), prior=prior, max_gap=0.1)
    solution = solve(7, gtsam.Pose3())
    found, tilt = tracker.add_tilt(NOW, solution)
    pose = found.map_T_lidar
    if prior == "blend":
        pose, tilt = tracker.blend_tilt(NOW, pose)
    dropped = gap > 0.1
    assert (tilt is TiltPrior.DROPPED) is dropped
    assert len(tracker.factors(NOW)) == (prior == "sigma" and not dropped)
    if prior != "sigma":
        assert pose.equals(solution.map_T_lidar, 1e-12) is dropped


@pytest.mark.parametrize(
    ("coupling", "attitude", "tilt"),
    [
        ("tight", False, TiltPrior.NONE),  # the accelerometer counts already
        ("tight", True, TiltPrior.EQUIVALENT),
        ("loose", False, TiltPrior.EQUIVALENT),
    ],
)
def test_an_attitude_made_of_acceleration_does_not_count_beside_it(coupling, attitude, tilt):
    samples = turning(rot3(1, 0, 0))
    samples = samples if attitude else dataclasses.replace(samples, orientation=None)
    tracker, solution = tracker_for(samples, coupling=coupling), solve(7, gtsam.Pose3())
    found, how = tracker.add_tilt(NOW, solution)
    assert how is tilt
    assert found.map_T_lidar.equals(solution.map_T_lidar, 1e-12) is (tilt is TiltPrior.NONE)


def test_without_up_in_the_map_there_is_no_prior_and_the_next_orientation_gives_it():
    samples = turning(rot3(4, 3, 0), seconds=2.0)
    tracker = new_tracker(part(samples, samples.stamps >= NOW + FRAME))
    assert tracker.first_pose(NOW).equals(gtsam.Pose3(), 1e-12)
    solution = solve(8, gtsam.Pose3())
    assert tracker.add_tilt(NOW, solution) == (solution, TiltPrior.DROPPED)
    tracker.find_level(NOW, solution.map_T_lidar)
    assert tracker.level is None
    tracker.find_level(NOW + 2 * FRAME, solution.map_T_lidar)
    level = tracker.level
    found = tilt_of(solution.map_T_lidar, level.level_R_map)
    np.testing.assert_allclose(found, [4, 3], atol=1e-6)
    tracker.find_level(NOW + 3 * FRAME, gtsam.Pose3(rot3(0, 20, 0), np.zeros(3)))
    assert tracker.level is level  # once is for all
    assert tracker.add_tilt(NOW + 3 * FRAME, solution)[1] is TiltPrior.EQUIVALENT


@pytest.mark.parametrize("tilt", [(4, -3), (180, 0), (-100, 60), (20, 90), (0, -90)])
def test_the_first_pose_is_level_at_the_origin(tilt):
    attitude = rot3(*tilt, 77)
    pose = new_tracker(turning(attitude)).first_pose(NOW)
    np.testing.assert_allclose(pose.rotation().matrix()[2], attitude.matrix()[2], atol=1e-9)
    np.testing.assert_array_equal(pose.translation(), np.zeros(3))
    if abs(tilt[1]) < 90:
        np.testing.assert_allclose(pose.rotation().yaw(), 0.0, atol=1e-9)


@pytest.mark.parametrize("level", [True, False])
@pytest.mark.parametrize("given", [None, gtsam.Pose3(rot3(30, 10, 90), np.ones(3))])
def test_a_map_that_is_not_levelled_knows_up_too(level, given):
    """With a start of the user's own, that one counts."""
    tracker = new_tracker(turning(rot3(4, -3, 77)), level=level)
    pose = tracker.first_pose(NOW, given)
    if given is not None:
        assert pose is given
    elif not level:
        assert pose.equals(gtsam.Pose3(), 1e-12)
    found = tilt_of(pose, tracker.level.level_R_map)
    np.testing.assert_allclose(found, [4, -3], atol=1e-6)


@pytest.mark.parametrize(("rate", "bias"), [(0.0, 0.01), (0.3, 0.0)])
def test_a_rest_at_the_start_gives_the_bias_of_the_gyro(rate, bias):
    tracker = new_tracker(turning(FLAT, rate=(0, 0, rate), bias=(0, 0, bias)))
    tracker.first_pose(NOW)
    np.testing.assert_allclose(tracker.buffer.gyro_bias, [0, 0, bias], atol=1e-12)
    assert tracker.level.source == ("moving" if rate else "still")


def frames(rate, count):
    """(stamp, pose) of a lidar that turns evenly."""
    turns = [gtsam.Rot3.Expmap(0.1 * i * np.array(rate)) for i in range(count)]
    return [(NOW + i * FRAME, gtsam.Pose3(turn, np.zeros(3))) for i, turn in enumerate(turns)]


def turning_tracker(rate, bias=(0.0, 0.0, 0.0), seconds=25.0):
    return new_tracker(turning(FLAT, seconds=seconds, rate=rate, bias=bias))


def test_the_bias_of_the_gyro_is_learnt():
    rate, bias = (0.05, -0.1, 0.2), (0.02, -0.01, 0.015)
    tracker = turning_tracker(rate, bias)
    compare(tracker, frames(rate, 200))
    # 2 % of what is left at every frame, about the axes of the lidar
    left = np.linalg.norm(tracker.buffer.gyro_bias - bias) / np.linalg.norm(bias)
    assert left == pytest.approx(0.98**199, rel=0.1)
    assert tracker.trusted_gyro is tracker.buffer


def test_it_is_told_by_how_much_the_gyro_turned_more_than_the_last_scans():
    tracker = turning_tracker((0.05, -0.1, 0.2))
    tracker.first_pose(NOW, None)
    assert tracker._turns.more is None
    compare(tracker, frames((0.05, -0.1, 0.2), 20))
    np.testing.assert_allclose(tracker._turns.more, 0.0, atol=1e-6)
    compare(tracker, frames((0.03, -0.1, 0.21), 40)[20:])
    np.testing.assert_allclose(tracker._turns.more, [0.02, 0.0, -0.01], atol=0.008)


def test_a_gyro_that_turns_otherwise_is_given_up_after_five_frames_and_may_come_back():
    tracker = turning_tracker((0.0, 0.0, 0.8))
    tracker.first_pose(NOW, None)
    wrong, right = frames((0.8, 0.0, 0.0), 30), frames((0.0, 0.0, 0.8), 60)
    compare(tracker, wrong[:5])
    assert tracker.trusted_gyro is tracker.buffer
    assert tracker.rotation_between(NOW, NOW + FRAME) is not None
    assert tracker.map_up is not None
    compare(tracker, wrong[4:6])
    assert tracker.trusted_gyro is None
    assert tracker.map_up is None
    assert tracker.rotation_between(NOW, NOW + FRAME) is None
    np.testing.assert_array_equal(tracker.buffer.gyro_bias, np.zeros(3))  # nothing learnt from it
    compare(tracker, wrong[5:])
    compare(tracker, right[30:46])  # the count of faults is bounded
    assert tracker.trusted_gyro is None
    compare(tracker, right[45:47])
    assert tracker.trusted_gyro is tracker.buffer


def test_a_gyro_that_is_given_up_again_is_given_up_for_twice_as_long():
    away = []
    tracker = turning_tracker((0.0, 0.0, 0.8))
    wrong, right = frames((0.8, 0.0, 0.0), 6), frames((0.0, 0.0, 0.8), 60)
    for _ in range(2):
        compare(tracker, wrong)
        assert tracker.trusted_gyro is None
        away.append(0)
        while tracker.trusted_gyro is None:
            compare(tracker, right[away[-1] : away[-1] + 2])
            away[-1] += 1
    assert away == [6, 20]  # from 10, and from 20 and the four wrong frames that followed, to 4


@pytest.mark.parametrize(
    ("turn", "sigma", "given_up_after"),
    [(0.0, 1e-4, None), (0.01, 1e-4, None), (0.1, 1e-4, 5), (1.0, 1e-4, 1), (0.1, 1e-2, None)],
)
def test_a_gyro_whose_predictions_are_contradicted_is_given_up_soon(turn, sigma, given_up_after):
    """One that feels no turn while the scans see some degrees to and fro, to ``sigma`` rad."""
    tracker = tracker_for(accelerating(2.0))
    information = sigma**-2.0 * np.diag([1.0, 1.0, 1.0, 1e-2, 1e-2, 1e-2])
    trusted = []
    for frame in range(1, 10):
        last, now = (
            (stamp, gtsam.Pose3(gtsam.Rot3.Yaw(np.radians(turn * (k % 2))), pose.translation()))
            for k, (stamp, pose) in ((k, at(k, 2.0)) for k in (frame - 1, frame))
        )
        tracker.predict(now[0])
        tracker.compare_gyro(last, now)
        tracker.observe(last, now, information)
        trusted.append(tracker.trusted_gyro is not None)
    lost = None if all(trusted) else trusted.index(False)
    assert lost == given_up_after


@pytest.mark.parametrize(("degrees", "agrees"), [(0.29, True), (0.31, False)])
def test_how_much_gyro_and_scan_may_differ(degrees, agrees):
    """At rest 0.3 degrees a frame; half of the turn more when turning."""
    for turn in (0.0, 4.0):
        by_scan = np.radians([0.0, 0.0, turn])
        off = by_scan + np.radians([0.0, 0.0, degrees + 0.5 * turn])
        tracker = turning_tracker(tuple(off / 0.1), seconds=3.0)
        poses = frames(by_scan / 0.1, 6)
        for last, now in pairwise(poses):
            tracker.compare_gyro(last, now)
            tracker.buffer.gyro_bias = np.zeros(3)
        assert (tracker.trusted_gyro is not None) is agrees


def test_frames_that_cannot_be_compared_teach_nothing():
    tracker = turning_tracker((0.0, 0.0, 0.8), seconds=2.0)
    pose = gtsam.Pose3()
    beyond = START + 5 * 10**9
    for first, second in ((NOW, NOW), (NOW + FRAME, NOW), (beyond, beyond + FRAME)):
        for _ in range(6):
            tracker.compare_gyro((first, pose), (second, pose))
    np.testing.assert_array_equal(tracker.buffer.gyro_bias, np.zeros(3))
    assert tracker.trusted_gyro is tracker.buffer
    tracker.compare_gyro((NOW, pose), (NOW + FRAME, gtsam.Pose3(gtsam.Rot3.Yaw(0.07), np.zeros(3))))
    assert tracker.buffer.gyro_bias.any()


def test_the_check_of_the_mounting_sees_frames_whose_samples_are_forgotten():
    tracker = new_tracker(as_seen_by(moving(6.0), rot(0, 0, 90)))
    stamps = NOW + FRAME * np.arange(50)
    rotations = motion((stamps - START) * 1e-9)[0].as_matrix()
    poses = [gtsam.Pose3(gtsam.Rot3(rotation), np.zeros(3)) for rotation in rotations]
    compare(tracker, zip(stamps.tolist(), poses, strict=True))
    tracker.buffer.forget_old(NOW + 120 * 10**9)
    assert len(tracker.buffer) < 200
    assert "[0, 0, 90]" in tracker.problems[0]
    tracker.reset()
    assert tracker.problems == ()


def accelerating(acceleration, seconds=2.0):
    """A level lidar that starts at NOW with 1 m/s and gathers speed along x."""
    stamps = NOW - 200_000_000 + 5_000_000 * np.arange(round(200 * seconds))
    count = len(stamps)
    level, still = np.tile([0.0, 0, 0, 1], (count, 1)), np.zeros((count, 3))
    return ImuSamples(stamps, level, still, np.tile([acceleration, 0.0, 9.81], (count, 1)))


def at(frame, acceleration):
    seconds = frame * FRAME * 1e-9
    along = seconds + 0.5 * acceleration * seconds**2
    return NOW + frame * FRAME, gtsam.Pose3(FLAT, np.array([along, 0.0, 0.0]))


def observed(tracker, frames, acceleration, information):
    for last, now in pairwise(frames):
        tracker.predict(at(now, acceleration)[0])
        tracker.observe(at(last, acceleration), at(now, acceleration), information)


@pytest.mark.parametrize("coupling", ["tight", "loose"])
def test_tight_coupling_predicts_what_constant_velocity_cannot(coupling):
    tracker = tracker_for(accelerating(2.0), coupling=coupling)
    observed(tracker, range(8), 2.0, 1e6 * np.eye(6))
    stamp, truth = at(8, 2.0)
    predicted = tracker.predict(stamp)
    if coupling == "loose":
        assert predicted is None
        return
    error = truth.localCoordinates(predicted.map_T_lidar)
    assert np.abs(error).max() < 2e-3  # constant velocity is off by 20 mm
    assert predicted.velocity[0] == pytest.approx(2.6, abs=0.02)


@pytest.mark.parametrize(("step", "unlike"), [(0.0, False), (0.005, False), (0.4, True)])
def test_a_scan_that_is_not_where_a_trusted_imu_expects_it_is_told(step, unlike):
    tracker = tracker_for(accelerating(2.0))
    observed(tracker, range(8), 2.0, 1e6 * np.eye(6))
    assert not tracker._coupling.contradicted
    stamp, pose = at(8, 2.0)
    tracker.predict(stamp)
    away = pose.compose(gtsam.Pose3(FLAT, np.array([0.0, step, 0.0])))
    tracker.observe(at(7, 2.0), (stamp, away), 1e6 * np.eye(6))
    assert tracker._coupling.contradicted is unlike


def test_a_gap_in_the_imu_leaves_the_prediction_out_and_it_begins_anew():
    samples = accelerating(2.0)
    since = (samples.stamps - NOW) * 1e-9
    tracker = tracker_for(part(samples, (since < 0.82) | (since > 1.15)))
    observed(tracker, range(8), 2.0, 1e6 * np.eye(6))
    assert tracker.predict(at(10, 2.0)[0]) is None
    observed(tracker, range(11, 15), 2.0, 1e6 * np.eye(6))
    assert tracker.predict(at(15, 2.0)[0]) is not None


def test_sweeps_whose_middles_are_not_in_order_are_not_observed():
    """A short sweep that begins late in a long one has its middle before that of the long one."""
    tracker = tracker_for(accelerating(2.0))
    observed(tracker, range(4), 2.0, 1e6 * np.eye(6))
    stamp, pose = at(3, 2.0)
    for earlier in (stamp, stamp - 1):
        assert tracker.predict(earlier) is None
        tracker.observe((stamp, pose), (earlier, pose), np.eye(6))
    assert tracker.predict(at(4, 2.0)[0]) is not None


@pytest.mark.parametrize("absurd", ["gyro", "acceleration"])
@pytest.mark.parametrize("size", [1e2, 1e4, 9e5])
def test_an_imu_that_measures_nonsense_makes_no_prediction_and_ends_no_run(absurd, size):
    """Up to what the buffer lets in, on top of every second frame."""
    samples, rng = accelerating(0.0), np.random.default_rng(0)
    values = getattr(samples, absurd) + size * rng.normal(size=(len(samples.stamps), 3)).clip(-1, 1)
    bad = dataclasses.replace(samples, **{absurd: values})
    tracker = tracker_for(bad, gyro_noise=1e3, acceleration_noise=1e3, lag=2)
    for last, now in pairwise(range(14)):
        predicted = tracker.predict(at(now, 0.0)[0])
        assert predicted is None or np.isfinite(np.linalg.inv(predicted.covariance)).all()
        tracker.observe(at(last, 0.0), at(now, 0.0), 10.0 ** rng.uniform(0, 15) * np.eye(6))


def test_after_a_reset_the_tracker_is_a_new_one_to_the_last_bit():
    """Level, bias, distrust and coupling are forgotten."""
    rate = (0.0, 0.0, 0.8)
    samples = turning(rot3(3, -2, 0), rate, seconds=3.0, bias=(0.02, -0.01, 0.015))
    fresh, used = (new_tracker(samples) for _ in range(2))

    def run(tracker):
        tracker.first_pose(NOW)
        said = []
        for last, now in pairwise(frames(rate, 14)):
            predicted = tracker.predict(now[0])
            said += [predicted.covariance] if predicted is not None else []
            tracker.compare_gyro(last, now)
            tracker.observe(last, now, 1e6 * np.eye(6))
        assert said
        return [*said, tracker.buffer.gyro_bias, tracker.level.map_up]

    run(used)
    compare(used, frames((0.8, 0.0, 0.0), 7))
    assert used.trusted_gyro is None
    used.reset()
    assert used.trusted_gyro is used.buffer
    assert (used.level, used.predict(NOW + FRAME)) == (None, None)
    for one, two in zip(run(used), run(fresh), strict=True):
        np.testing.assert_array_equal(one, two)


def test_what_was_learnt_from_another_tracker_is_forgotten_by_a_reset():
    tracker = new_tracker(turning(rot3(3, -2, 0), (0.0, 0.0, 0.8), seconds=3.0))
    given, learnt = tracker.buffer.gyro_bias, np.full(3, 0.01)
    tracker.buffer.gyro_bias = learnt
    other = ImuTracker(tracker.config, tracker.buffer)
    other.first_pose(NOW)
    tracker.learn_from(other)
    assert tracker.level is other.level
    tracker.reset()
    assert tracker.level is None
    np.testing.assert_array_equal(tracker.buffer.gyro_bias, given)


def test_the_state_of_a_tight_coupling_does_not_grow():
    tracker = tracker_for(accelerating(0.1, seconds=8.0), lag=5)
    sizes = []
    for last, now in pairwise(range(60)):
        observed(tracker, (last, now), 0.1, 1e6 * np.eye(6))
        shared = {"samples": tracker.buffer, "config": tracker.config}
        frozen = freeze({"imu": tracker}, shared)
        sizes.append(sum(column.nbytes for column in frozen.values()))
    assert max(sizes[10:]) < 1.03 * min(sizes[10:])


@pytest.mark.parametrize("coupling", ["loose", "tight"])
def test_samples_fed_live_and_forgotten_lead_to_the_same(coupling, monkeypatch):
    monkeypatch.setattr("loam_gtsam.imu.buffer.MEMORY", 1.0)
    rate, config = (0.0, 0.1, 0.5), {"coupling": coupling, "prior": "blend"}
    samples = turning(rot3(3, -2, 0), seconds=12.0, rate=rate, bias=(0.02, -0.01, 0.015))
    at_once, live = new_tracker(samples, **config), new_tracker(None, **config)
    for last, now in pairwise(frames(rate, 100)):
        since = last[0] + 200_000_000 if last[0] > NOW else START
        new = (samples.stamps >= since) & (samples.stamps < now[0] + 200_000_000)
        live.buffer.forget_old(now[0])
        live.buffer.add(part(samples, new))
        said = []
        for tracker in (at_once, live):
            if last[0] == NOW:
                tracker.first_pose(NOW)
            predicted = tracker.predict(now[0])
            tracker.compare_gyro(last, now)
            tracker.observe(last, now, 1e6 * np.eye(6))
            blended = tracker.blend_tilt(*now)[0].matrix()
            said.append([predicted and predicted.covariance, tracker.buffer.gyro_bias, blended])
        np.testing.assert_equal(*said)
    assert len(live.buffer) < 0.6 * len(samples.stamps) < len(at_once.buffer)


@pytest.mark.parametrize(("degrees", "contradicted"), [(0.2, False), (2.0, True)])
def test_a_gyro_that_turns_unlike_the_scans_is_contradicted(degrees, contradicted):
    tracker = new_tracker(turning(rot3(0.0, 0.0, 0.3)))  # which does not turn
    turned = gtsam.Pose3(gtsam.Rot3.Yaw(np.radians(degrees)), np.zeros(3))
    solution = with_information(turned, np.eye(6))
    last = Moment(NOW - FRAME, gtsam.Pose3(), True)
    assert tracker.contradicted(last, solution, NOW) is contradicted
    assert not tracker.contradicted(last._replace(solved=False), solution, NOW)
    assert not tracker.contradicted(None, solution, NOW)


@pytest.mark.parametrize(
    ("degrees", "tilt"), [(1.0, TiltPrior.EQUIVALENT), (9.0, TiltPrior.DROPPED)]
)
def test_an_attitude_that_turns_unlike_the_scans_is_dropped(degrees, tilt):
    tracker = tracker_for(rot3(0.0, 0.0, 0.0))  # which stays as it is
    turned = gtsam.Pose3(gtsam.Rot3.Roll(np.radians(degrees)), np.zeros(3))
    solution = with_information(turned, 1e6 * np.eye(6))
    last = Moment(NOW - FRAME, gtsam.Pose3(), True)
    assert tracker.add_tilt(NOW, solution, last)[1] is tilt
    assert tracker.add_tilt(NOW, solution)[1] is TiltPrior.EQUIVALENT
