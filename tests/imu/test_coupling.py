"""The bend of a path, and gyro, accelerometer and scans in one estimate."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.imu import START, ns

from loam_gtsam.config import Config, ImuConfig
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.imu.bend import bend
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.imu.coupling import GyroTrust, TightCoupling
from loam_gtsam.imu.level import Level
from loam_gtsam.imu.preintegration import InertialOdometry
from loam_gtsam.registration.solvers import POSE_KEY
from loam_gtsam.registration.solvers.scan_error import ScanError
from loam_gtsam.types import Features, ImuSamples

DOWN = np.array([0.0, 0.0, -9.81])
FRAME = 100_000_000
KNOWN = 0.1  # m/s: 5 mm in half a sweep
NOW = START + 500_000_000
SECONDS = np.linspace(-0.15, 0.06, 41)
RATE = np.array([0.3, -0.2, 0.9])


def level_of(down, felt=False):
    turned = gtsam.Rot3(Rotation.align_vectors([[0.0, 0.0, -1.0]], [down])[0].as_matrix())
    return Level(turned, 0.0, 0.0, 1, "moving", felt)


LEVEL = level_of(DOWN)


def buffer(config=None, acceleration=(1.5, -0.5, 0.2), arm=(0.0, 0.0, 0.0), scale=1.0):
    """Of a lidar that turns evenly about RATE, and gathers speed in a map that is level at NOW."""
    times = np.arange(-100, 400) / 200.0
    rotations = Rotation.from_rotvec(np.outer(times, RATE))
    arm = np.asarray(arm)
    felt = rotations.inv().apply(np.asarray(acceleration) - DOWN)
    felt += np.cross(RATE, np.cross(RATE, arm))
    gyro = np.tile(RATE, (len(times), 1))
    samples = ImuSamples(NOW + np.round(times * 1e9).astype(np.int64), None, gyro, scale * felt)
    return ImuBuffer(config or ImuConfig(), samples)


@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), (0.5, -0.2, 0.3)])
def test_a_path_bends_as_the_lidar_accelerates_wherever_the_imu_sits(arm):
    acceleration, bias = np.array([1.5, -0.5, 0.2]), np.array([0.1, 0.2, -0.1])
    data = buffer(arm=arm)
    path = bend(data, NOW, SECONDS, DOWN, np.zeros(3), np.asarray(arm))
    np.testing.assert_allclose(path, 0.5 * np.outer(SECONDS**2, acceleration), atol=2e-5)
    # A bias turns with the lidar, which at NOW has the axes of the map.
    wrong = bend(data, NOW, SECONDS, DOWN, bias, np.asarray(arm)) - path
    np.testing.assert_allclose(wrong[-1], -0.5 * SECONDS[-1] ** 2 * bias, atol=2e-5)


def test_a_gap_in_the_samples_leaves_the_bend_unknown():
    data = buffer()
    assert bend(data, NOW + 5_000_000_000, SECONDS, DOWN, np.zeros(3), np.zeros(3)) is None
    assert bend(data, NOW - 450_000_000, SECONDS, DOWN, np.zeros(3), np.zeros(3)) is None


def test_a_sweep_on_a_bent_path_is_undone_and_its_velocity_is_that_of_the_middle():
    acceleration, velocity = np.array([1.5, -0.5, 0.2]), np.array([8.0, 1.0, -0.5])
    rng = np.random.default_rng(0)
    points, times = rng.uniform(-9.0, 9.0, (300, 3)), rng.uniform(0.0, 0.1, 300)
    middle = NOW + FRAME // 2

    def pose(seconds):
        """At seconds from the middle of the sweep."""
        way = np.outer(seconds, velocity) + 0.5 * np.outer(seconds**2, acceleration)
        return Rotation.from_rotvec(np.outer(seconds, RATE)), way

    turned, way = pose(times - 0.05)
    measured = turned.inv().apply(points - way)
    features = replace(
        Features.from_points(NOW, measured, measured),
        edge_times=times, plane_times=times, span=(0.0, 0.1),
    )  # fmt: skip
    level = ImuSamples(*_level_at(middle, acceleration))
    sweep = MovingSweep(features, Config(), ImuBuffer(ImuConfig(), level), thin=False)
    path = bend(ImuBuffer(ImuConfig(), level), middle, SECONDS, DOWN, np.zeros(3), np.zeros(3))
    bent = sweep.bent(SECONDS, path)
    before, way = pose(np.array([-0.1]))
    last = middle - FRAME, gtsam.Pose3(gtsam.Rot3(before[0].as_matrix()), way[0])
    twist = bent.twist_since(last, gtsam.Pose3())
    reference, there = pose(np.array([-0.05]))
    np.testing.assert_allclose(reference[0].apply(twist[3:]), velocity, atol=1e-3)
    np.testing.assert_allclose(bent.at(twist).points[1], points, atol=1e-4)
    at = bent.middle_T_reference(twist)
    np.testing.assert_allclose(at.translation(), there[0], atol=1e-4)
    before = bent.velocity_at(-0.1, twist)
    np.testing.assert_allclose(before, velocity - 0.1 * acceleration, atol=2e-3)
    assert sweep.velocity_at(-0.1, twist) is None
    # The mean velocity since the last middle, on a straight path: 2 mm off at the ends.
    straight = sweep.at(sweep.twist_since(last, gtsam.Pose3()))
    assert np.abs(straight.points[1] - points).max() > 2e-3


def _level_at(stamp, acceleration):
    times = np.arange(-100, 100) / 200.0
    felt = Rotation.from_rotvec(np.outer(times, RATE)).inv().apply(acceleration - DOWN)
    stamps = stamp + np.round(times * 1e9).astype(np.int64)
    return stamps, None, np.tile(RATE, (len(times), 1)), felt


# -- the estimate ----------------------------------------------------------------------------------


def drive(coupling, data, frames, errors=None, information=None):
    """Observe frames of a lidar at rest; what comes of each."""
    information = np.diag([1e6] * 3 + [1e4] * 3) if information is None else information
    found = []
    for number in frames:
        last, now = ((NOW + k * FRAME, gtsam.Pose3()) for k in (number - 1, number))
        if errors is not None:
            now = now[0], gtsam.Pose3().retract(errors[number])
        predicted = coupling.predict(now[0], data)
        found.append((predicted, coupling.observe(last, now, information, LEVEL, data)))
    return found


def resting(acceleration=(0.0, 0.0, 9.81), rng=None, seconds=12.0):
    stamps = ns(np.arange(round(200 * seconds)) / 200.0)
    felt = np.tile(np.asarray(acceleration, float), (len(stamps), 1))
    gyro = np.zeros_like(felt)
    if rng is not None:
        config = ImuConfig()
        felt += config.acceleration_noise * np.sqrt(200.0) * rng.standard_normal(felt.shape)
        gyro += config.gyro_noise * np.sqrt(200.0) * rng.standard_normal(felt.shape)
    return ImuBuffer(ImuConfig(), ImuSamples(stamps, None, gyro, felt))


def test_errors_of_poses_of_velocities_and_between_frames_are_as_told():
    """NEES of 20 runs of 25 frames: of the last state, and of the motion between two frames."""
    rng = np.random.default_rng(0)
    sigmas = np.repeat([1e-3, 5e-3], 3)
    state, motion = [], []
    for _ in range(20):
        data, errors = resting(rng=rng, seconds=4.0), sigmas * rng.standard_normal((30, 6))
        errors[0] = 0.0
        found = [fused for _, fused in drive(TightCoupling(ImuConfig()), data, range(1, 26), errors,
                                             np.diag(sigmas**-2))]  # fmt: skip
        last, now = (gtsam.Pose3.Logmap(fused.map_T_lidar) for fused in found[-2:])
        off = np.append(now, found[-1].velocity)
        state.append(off @ np.linalg.solve(found[-1].covariance, off))
        across = found[-1].across[:6, :6]
        between = found[-1].covariance[:6, :6] + found[-2].covariance[:6, :6] - across - across.T
        motion.append((now - last) @ np.linalg.solve(between, now - last))
    assert 0.7 < np.mean(state) / 9 < 1.4
    assert 0.7 < np.mean(motion) / 6 < 1.4


def test_a_pose_by_both_is_better_than_by_either():
    rng = np.random.default_rng(1)
    errors = np.repeat([1e-3, 5e-3], 3) * rng.standard_normal((60, 6))
    information = np.diag(np.repeat([1e-3, 5e-3], 3) ** -2.0)
    data = resting(rng=rng, seconds=8.0)
    found = drive(TightCoupling(ImuConfig()), data, range(1, 60), errors, information)
    fused = [gtsam.Pose3.Logmap(both.map_T_lidar) for _, both in found[10:]]
    assert np.std(fused, axis=0).max() < 0.6 * 5e-3
    assert np.std(fused, axis=0)[:3].max() < 0.5e-3


@pytest.mark.parametrize(
    "felt", [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 981.0), (160.0, 0.0, 9.81)]
)
def test_no_gravity_other_units_and_nonsense_are_not_used(felt):
    coupling, data = TightCoupling(ImuConfig()), resting(felt)
    assert all(predicted is None for predicted, _ in drive(coupling, data, range(1, 8)))
    assert coupling.bend(NOW, SECONDS, np.eye(3), LEVEL, data) is None
    good = resting()
    assert coupling.bend(NOW, SECONDS, np.eye(3), LEVEL, good) is not None


@pytest.mark.parametrize(("gravity", "believed"), [(0.0, False), (9.81, True)])
def test_without_gravity_a_lidar_that_jerks_is_not_believed_either(gravity, believed):
    """Over the sweep it feels 4 m/s^2 more than in the median of two seconds."""
    felt = np.tile([0.0, 0.0, gravity], (1000, 1))
    felt[800:840] += [0.0, 0.0, 4.0]
    stamps = ns(np.arange(1000) / 200.0)
    data = ImuBuffer(ImuConfig(), ImuSamples(stamps, None, np.zeros_like(felt), felt))
    at, seconds = START + 4_100_000_000, np.linspace(-0.05, 0.05, 5)
    path = TightCoupling(ImuConfig()).bend(at, seconds, np.eye(3), LEVEL, data)
    assert (path is not None) is believed


@pytest.mark.parametrize(("tilt", "begins"), [(0.0, True), (55.0, True), (65.0, False)])
def test_the_estimate_begins_only_where_down_may_be_down(tilt, begins):
    """At rest, down 60 degrees off is an acceleration of g."""
    wrong = level_of(Rotation.from_euler("x", tilt, degrees=True).apply(DOWN))
    coupling, data = TightCoupling(ImuConfig()), resting()
    assert (coupling.bend(NOW, SECONDS, np.eye(3), wrong, data) is not None) is begins
    last, now = ((NOW + k * FRAME, gtsam.Pose3()) for k in (0, 1))
    coupling.observe(last, now, np.eye(6), wrong, data)
    assert (coupling.predict(NOW + 2 * FRAME, data) is not None) is begins


@pytest.mark.parametrize("felt", [True, False])
def test_a_start_in_a_bend_learns_what_down_is_if_it_knows_that_it_does_not(felt):
    """Round a bend of 0.6 rad/s at 6 m/s an IMU without an attitude takes 20 degrees for level."""
    speed, rate, number = 6.0, 0.6, 41

    def pose(seconds):
        heading = rate * seconds
        way = speed / rate * np.array([np.sin(heading), 1.0 - np.cos(heading), 0.0])
        return gtsam.Pose3(gtsam.Rot3.Rz(heading), way)

    times = np.arange(-100, 1000) / 200.0
    force = np.array([0.0, speed * rate, 9.81])
    stamps = NOW + np.round(times * 1e9).astype(np.int64)
    gyro, force_there = (np.tile(row, (len(times), 1)) for row in ([0.0, 0.0, rate], force))
    data = ImuBuffer(ImuConfig(), ImuSamples(stamps, None, gyro, force_there))
    level, coupling = level_of(-force, felt), TightCoupling(ImuConfig())
    assert (coupling.bend(NOW, SECONDS, np.eye(3), level, data) is None) is felt
    said = []
    for k in range(1, number):
        last, now = ((NOW + i * FRAME, pose(0.1 * i)) for i in (k - 1, k))
        said.append(coupling.predict(now[0], data))
        coupling.observe(last, now, np.diag([1e6] * 3 + [1e4] * 3), level, data)
    assert (said[1] is None) is felt  # there is no telling before gravity is known
    assert said[-1] is not None or not felt
    up = coupling.up(level)
    assert (up is not None) is felt  # it is not trusted: what it takes for level is not
    assert up is None or np.degrees(np.arccos(up[2])) < 0.2
    assert np.degrees(np.arccos(level.map_up[2])) == pytest.approx(20.2, abs=0.1)


def test_an_accelerometer_that_contradicts_the_scans_is_left_out_until_it_agrees_again():
    coupling, good, bad = TightCoupling(ImuConfig()), resting(), resting((8.0, 0.0, 9.81))
    sharp = 1e6 * np.eye(6)
    assert drive(coupling, good, range(1, 6), information=sharp)[-1][1] is not None
    assert coupling.trusted
    said = drive(coupling, bad, range(6, 30), information=sharp)
    assert said[0][1] is None
    assert not coupling.trusted
    assert all(predicted is None and fused is None for predicted, fused in said[12:])
    assert drive(coupling, good, range(30, 80), information=sharp)[-1][1] is not None
    assert coupling.trusted


def test_a_rejected_prediction_is_not_fused():
    coupling, data = TightCoupling(ImuConfig()), resting()
    drive(coupling, data, range(1, 6))
    assert coupling.predict(NOW + 6 * FRAME, data) is not None
    coupling.reject()
    last, now = ((NOW + k * FRAME, gtsam.Pose3()) for k in (5, 6))
    assert coupling.observe(last, now, np.eye(6), LEVEL, data) is None


@pytest.mark.parametrize("metres", [0.001, 0.5])
def test_a_frame_that_was_registered_elsewhere_is_no_motion(metres):
    """Beyond its own error; below it nothing changes."""
    data, there = resting(), gtsam.Pose3(gtsam.Rot3(), [metres, 0.0, 0.0])
    coupling = TightCoupling(ImuConfig())
    drive(coupling, data, range(1, 20))
    before = coupling._odometry.state
    coupling.predict(NOW + 20 * FRAME, data)
    coupling.moved(there, data)
    known = np.diag([1e6] * 3 + [1e4] * 3)
    last, now = ((NOW + k * FRAME, there) for k in (19, 20))
    fused = coupling.observe(last, now, known, LEVEL, data)
    assert fused is not None
    assert not coupling.contradicted
    assert np.abs(fused.velocity).max() < 0.01
    at = coupling._odometry.state.map_T_imu.x()
    assert abs(at - metres) < 0.01
    assert (coupling._odometry.distance_to(gtsam.Pose3()) > 40.0) == (metres > 0.1)
    np.testing.assert_allclose(
        coupling._odometry.state.acceleration_bias, before.acceleration_bias, atol=0.005
    )


def slowed(coupling: TightCoupling, data: ImuBuffer, sees_x: bool, reject: bool):
    """The prediction after 10 frames at 5 m/s along x, and 3 whose poses stand still."""
    seen, after = (np.diag([1e6] * 3 + [x, 1e4, 1e4]) for x in (1e4, 1e4 * sees_x))
    for number in range(1, 14):
        last, now = (
            (NOW + k * FRAME, gtsam.Pose3(gtsam.Rot3(), np.array([0.5 * min(k, 10), 0.0, 0.0])))
            for k in (number - 1, number)
        )
        coupling.predict(now[0], data)
        if reject and number > 10:
            coupling.reject()
        coupling.observe(last, now, seen if number <= 10 else after, LEVEL, data)
    return coupling.predict(NOW + 14 * FRAME, data)


def test_a_speed_goes_on_through_a_gap_in_the_samples_where_no_scan_sees_it():
    """It is known to an acceleration of 2 m/s^2 for 0.3 s, and to 0.5 m/s where a window begins."""
    stamps = resting().samples_between(NOW - 10**9, NOW + 10**10).stamps
    stamps = stamps[(stamps <= NOW + 10 * FRAME) | (stamps >= NOW + 13 * FRAME)]
    felt, still = np.tile([0.0, 0.0, 9.81], (len(stamps), 1)), np.zeros((len(stamps), 3))
    data = ImuBuffer(ImuConfig(), ImuSamples(stamps, None, still, felt))
    predicted = slowed(TightCoupling(ImuConfig()), data, sees_x=False, reject=False)
    assert predicted.velocity[0] == pytest.approx(5.0, abs=0.3)
    speed = np.sqrt(predicted.covariance[3, 3]) / 0.1
    assert speed == pytest.approx(np.hypot(0.6, 0.5), rel=0.3)


@pytest.mark.parametrize("sees_x", [True, False])
def test_a_pose_that_takes_a_prediction_back_does_not_tell_the_speed_at_once(sees_x):
    """It may have jumped. After three such poses the scans are believed, if they see the way."""
    predicted = slowed(TightCoupling(ImuConfig()), resting(), sees_x, reject=True)
    speed, sigma = predicted.velocity[0], np.sqrt(predicted.covariance[3, 3]) / 0.1
    assert (speed < 0.5) == sees_x
    assert abs(speed) < 2.0 * sigma
    assert abs(speed - 5.0) < 2.0 * sigma


def test_a_speed_along_which_no_scan_sees_may_be_any():
    """The window begins with the second frame: blind along x of a lidar that faces along y."""
    turned = gtsam.Pose3(gtsam.Rot3.Yaw(np.pi / 2.0), np.zeros(3))
    information = np.diag([1e6] * 3 + [0.0, 1e4, 1e4])
    coupling, data = TightCoupling(ImuConfig()), resting()
    last, now = ((NOW + k * FRAME, turned) for k in (0, 1))
    coupling.observe(last, now, information, LEVEL, data)
    predicted = coupling.predict(NOW + 2 * FRAME, data)
    body = turned.rotation().matrix().T @ predicted.across[:, 3:] / 0.1  # along the lidar's axes
    np.testing.assert_allclose(np.diag(body), [20.0**2, 0.27, 0.27], rtol=0.1)


def test_the_velocity_of_a_pose_follows_from_how_far_it_is_from_the_expected_one():
    """Right after the start, when it is hardly known; later a pose does not change it.

    A scan in which time goes with elevation would be de-skewed until it fits any pose.
    """
    odometry = InertialOdometry(ImuConfig(), DOWN, NOW, gtsam.Pose3(), np.zeros(3), np.zeros(3))
    data = resting().samples_between(START, START + 10**10)
    away = gtsam.Pose3(gtsam.Rot3(), np.array([0.05, 0.0, 0.0]))
    first = odometry.predict(NOW + FRAME, data)
    assert first.velocity_at(away, KNOWN)[0] == pytest.approx(0.05 / 0.1, rel=0.1)
    for number in range(1, 20):
        odometry.predict(NOW + number * FRAME, data)
        odometry.update(gtsam.Pose3(), np.diag([1e6] * 3 + [1e5] * 3))
    later = odometry.predict(NOW + 20 * FRAME, data)
    assert np.array_equal(later.velocity_at(away, KNOWN), later.velocity)
    blind = replace(later, spread=np.diag([1e-4, 1e-4, 4.0]))
    told = blind.velocity_at(away, KNOWN) - later.velocity
    assert np.array_equal(told[:2], [0.0, 0.0])  # along x and y it is known, along z alone not
    assert np.array_equal(first.velocity_at(away, np.inf), first.velocity)


def test_while_a_gyro_is_given_up_that_is_said_and_counted():
    gyro = GyroTrust()
    for _ in range(4):
        gyro.compared(agree=False)
    assert (gyro.problem, gyro.left_out) == ("", 0)
    for _ in range(3):
        gyro.compared(agree=False)
    assert "one of the two is wrong" in gyro.problem
    assert gyro.left_out == 3
    while not gyro.holds:
        gyro.compared(agree=True)
    assert gyro.problem == ""
    assert gyro.left_out < 20


def test_a_gyro_that_is_given_up_again_has_to_agree_for_longer_each_time():
    gyro, waited = GyroTrust(), []
    for disagreements in (5, 1, 1, 3, 1, 1, 1, 1):
        for _ in range(disagreements - 1):
            gyro.compared(agree=True)  # which allows one more
        for number in range(disagreements):
            assert gyro.holds, number
            gyro.compared(agree=False)
        waited.append(0)
        while not gyro.holds:
            gyro.compared(agree=True)
            waited[-1] += 1
    assert waited == [6, 16, 36, 76, 156, 316, 636, 636]


# -- the scan beside further factors ---------------------------------------------------------------


def test_a_scan_and_a_factor_have_their_true_shares():
    pose = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([1.0, 2.0, 3.0]))
    zero, alone = np.zeros((6, 6)), np.diag([1e6] * 3 + [1e4] * 3)
    scan = ScanError(zero, zero, zero, zero, zero, alone, np.full(6, 1e-3), 1.0, 1.0)
    information, step = scan.with_factors(pose, [])
    assert information is alone
    assert not step.any()
    # 1 cm by the scan, 2 cm by the prior: a fifth of the way from the scan's optimum.
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.02)
    prior = gtsam.GPSFactor(POSE_KEY, pose.translation() + np.array([0.0, 0.0, 0.05]), noise)
    information, step = scan.with_factors(pose, [prior])
    np.testing.assert_allclose(step[5], 1e-3 + 0.2 * 0.049, atol=1e-5)
    np.testing.assert_allclose(np.diag(information)[3:], 1e4 + 2500.0)
    # Where nothing tells, the pose stays.
    blind = ScanError(zero, zero, zero, zero, zero, zero, np.zeros(6), 1.0, 1.0)
    _, step = blind.with_factors(pose, [prior])
    np.testing.assert_allclose(step[:3], 0.0, atol=1e-12)
