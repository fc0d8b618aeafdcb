"""Pre-integrated motion: closed forms, blind directions, biases, and behaviour in trouble."""

import gtsam
import numpy as np
import pytest
from support.imu import part
from support.jacobians import numerical

from loam_gtsam.config import ImuConfig
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.imu.preintegration import InertialOdometry, StartSigmas, _surprise_of_turn
from loam_gtsam.imu.preintegration_window import information_root, scan_factor, scan_residual
from loam_gtsam.io.state import freeze, thaw
from loam_gtsam.types import ImuSamples, InputError, SweepError

START = 1_700_000_000_000_000_000
STEP = 5_000_000  # nanoseconds, 200 Hz
FRAME = 100_000_000
DOWN = np.array([0.0, 0.0, -9.81])
UP = -DOWN
KNOWN = np.diag([1e6] * 3 + [1e4] * 3)  # 1 mrad, 1 cm
ZERO = np.zeros(3)


def samples(gyro=(0.0, 0.0, 0.0), acceleration=UP, seconds=1.0, before=0.0):
    """Samples from START; gyro and acceleration are vectors, or functions of (N,) seconds."""
    stamps = START + np.arange(-round(before * 200), round(seconds * 200) + 1) * STEP
    t = (stamps - START) * 1e-9
    rows = [
        np.asarray(value(t) if callable(value) else np.tile(value, (len(t), 1)), dtype=float)
        for value in (gyro, acceleration)
    ]
    return ImuSamples(stamps, None, *rows)


def odometry(
    config=None, gravity=DOWN, pose=None, velocity=ZERO, gyro_bias=ZERO, sigmas=None, start=START
):
    config, pose = config or ImuConfig(), pose or gtsam.Pose3()
    return InertialOdometry(config, gravity, start, pose, velocity, gyro_bias, sigmas)


def pose(rotation, translation):
    return gtsam.Pose3(gtsam.Rot3(rotation), np.asarray(translation, dtype=float))


FORCE = UP + np.array([1.5, -0.5, 0.2])
FORWARD = np.array([2.0, 0.0, 0.0])


def test_constant_acceleration():
    found = odometry(velocity=FORWARD).predict(START + FRAME * 5, samples(acceleration=FORCE))
    way = [2.0 * 0.5 + 1.5 * 0.125, -0.5 * 0.125, 0.2 * 0.125]
    np.testing.assert_allclose(found.map_T_lidar.translation(), way, atol=1e-9)
    np.testing.assert_allclose(found.velocity, [2.75, -0.25, 0.1], atol=1e-9)


def test_constant_turn_with_a_bias_that_is_known():
    rate, speed, t, bias = 0.8, 5.0, 0.5, np.array([0.02, -0.01, 0.03])
    data = samples(bias + np.array([0.0, 0.0, rate]), UP + np.array([0.0, rate * speed, 0.0]))
    odo = odometry(velocity=np.array([speed, 0.0, 0.0]), gyro_bias=bias)
    found = odo.predict(START + round(t * 1e9), data)
    angle, radius = rate * t, speed / rate
    there = [radius * np.sin(angle), radius * (1 - np.cos(angle)), 0.0]
    expected = pose(gtsam.Rot3.Rz(angle).matrix(), there).matrix()
    # 200 steps a second, each with a constant rate
    np.testing.assert_allclose(found.map_T_lidar.matrix(), expected, atol=2e-5)
    along = [speed * np.cos(angle), speed * np.sin(angle), 0.0]
    np.testing.assert_allclose(found.velocity, along, atol=2e-5)


def test_a_map_that_is_not_levelled():
    # Everything as above, seen from a map tilted by T: poses, velocities and gravity turn with it.
    T = gtsam.Rot3.RzRyRx(0.3, -0.4, 0.5).matrix()
    moment, start = (START + FRAME * 5, samples(acceleration=FORCE)), pose(T, [10.0, 20.0, 30.0])
    found = odometry(gravity=T @ DOWN, pose=start, velocity=T @ FORWARD).predict(*moment)
    level = odometry(velocity=FORWARD).predict(*moment)
    expected = start.compose(level.map_T_lidar).matrix()
    np.testing.assert_allclose(found.map_T_lidar.matrix(), expected, atol=1e-9)
    np.testing.assert_allclose(found.velocity, T @ level.velocity, atol=1e-9)
    np.testing.assert_allclose(found.covariance, level.covariance, rtol=1e-6, atol=1e-12)


def test_an_imu_off_the_lidar_that_starts_to_turn():
    # The lidar turns on the spot with 2 rad/s^2; the IMU feels both of Euler's and the centripetal.
    arm, angular = np.array([0.5, 0.2, 0.3]), 2.0

    def rate(t):
        return np.outer(angular * t, [0.0, 0.0, 1.0])

    def force(t):
        w = rate(t)
        return UP + np.cross([0.0, 0.0, angular], arm) + np.cross(w, np.cross(w, arm))

    odo = odometry(ImuConfig(lidar_t_imu=tuple(arm)))
    found = odo.predict(START + FRAME * 3, samples(rate, force))
    np.testing.assert_allclose(found.map_T_lidar.translation(), 0.0, atol=1e-5)
    np.testing.assert_allclose(found.velocity, 0.0, atol=1e-4)
    assert found.map_T_lidar.rotation().yaw() == pytest.approx(0.5 * angular * 0.09, abs=1e-9)


@pytest.mark.parametrize("offset", [0, 1, 1_234_567, STEP - 1])
def test_the_ends_are_cut_and_interpolated(offset):
    # Acceleration rises linearly: the straight lines between samples are exact, so that the
    # velocity is too, wherever between two samples a frame begins and ends.
    jerk = 3.0
    data = samples(acceleration=lambda t: UP + np.outer(jerk * t, [1.0, 0.0, 0.0]))
    begin, end = offset, FRAME + offset // 2
    found = odometry(start=START + begin).predict(START + end, data)
    expected = 0.5 * jerk * ((end * 1e-9) ** 2 - (begin * 1e-9) ** 2)
    assert found.velocity[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), (0.5, -0.3, 0.2)])
@pytest.mark.parametrize("scale", [1.0, 1e-3], ids=["unsure", "known"])
def test_covariance_is_that_of_the_errors(arm, scale):
    """Start, biases, gravity and samples drawn from their own distributions; NEES of 300 draws."""
    rng = np.random.default_rng(1)
    config = ImuConfig(lidar_t_imu=arm, acceleration_noise=0.02, gyro_noise=0.002)
    turn, force = np.array([0.3, -0.2, 0.5]), UP + np.array([1.0, 0.5, 0.0])
    stop, speed = START + 5 * FRAME, np.array([3.0, 0.0, 0.0])
    clean = samples(turn, force)
    exact = odometry(config, velocity=speed).predict(stop, clean)
    pose_sigma, rest = (0.01 * scale, 0.02 * scale), scale * np.array([0.05, 0.01, 0.05, 0.01])
    sigmas = StartSigmas(pose_sigma, *rest)

    def draw(sigma, size=3):
        return sigma * scale * rng.standard_normal(size)

    errors = []
    for _ in range(300):
        # White noise of a density, sampled at 200 Hz.
        noise = rng.standard_normal((2, len(clean.stamps), 3)) * np.sqrt(200.0)
        gyro, acceleration = turn + draw(0.01), force + draw(0.05)
        rows = gyro + 0.002 * noise[0], acceleration + 0.02 * noise[1]
        data = ImuSamples(clean.stamps, None, *rows)
        start = gtsam.Pose3().retract(np.append(draw(0.01), draw(0.02)))
        tilt = gtsam.Rot3.Expmap(np.append(draw(0.01, 2), 0.0))
        gravity = tilt.matrix() @ DOWN + draw(0.02, 1) / scale * [0.0, 0.0, 1.0]
        odo = odometry(config, gravity, start, speed + draw(0.05), sigmas=sigmas)
        found = odo.predict(stop, data)
        error = exact.map_T_lidar.localCoordinates(found.map_T_lidar)
        errors.append(error @ np.linalg.solve(found.covariance, error))
    # 300 draws of chi^2(6): the mean has a standard deviation of sqrt(12 / 300) = 0.2.
    assert 5.2 < np.mean(errors) < 6.8


def test_a_covariance_is_that_of_the_lidar():
    # 50 mrad and 1 mm of the lidar are 25 mm of an IMU half a metre off.
    config = ImuConfig(lidar_t_imu=(0.0, 0.0, 0.5))
    odo = odometry(config, sigmas=StartSigmas((0.05, 0.001), 1e-6, 1e-7, 1e-7, 1e-8))
    found = odo.predict(START + STEP, samples())
    sigmas = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(sigmas, np.repeat([0.05, 0.001], 3), rtol=0.01)
    assert odo.state.covariance[3, 3] == pytest.approx(0.025**2, rel=0.01)


def test_the_scan_residual_against_numerical_derivatives():
    rng = np.random.default_rng(2)
    for _ in range(20):
        measured, arm = gtsam.Pose3().retract(rng.standard_normal(6)), rng.standard_normal(3)
        lidar_T_imu = pose(np.eye(3), arm)
        at = measured.compose(lidar_T_imu).retract(0.3 * rng.standard_normal(6))
        _, derivative = scan_residual(at, lidar_T_imu, measured)
        expected = numerical(lambda p, a=lidar_T_imu, m=measured: scan_residual(p, a, m)[0], at)
        np.testing.assert_allclose(derivative, expected, atol=1e-8)


def blind(rotation, axis, information=KNOWN):
    """``information`` without the direction ``axis`` of the map."""
    along = np.append(np.zeros(3), rotation.T @ axis)
    across = np.eye(6) - np.outer(along, along)
    return across @ information @ across


def test_a_blind_direction_stays_blind_at_every_estimate():
    # Fixed in the map, not in the body: an estimate that is turned a little, or shifted along the
    # blind direction, must not see it.
    rng = np.random.default_rng(3)
    axis = np.array([0.6, 0.8, 0.0])
    measured = gtsam.Pose3().retract(rng.standard_normal(6))
    root = information_root(blind(measured.rotation().matrix(), axis))
    assert len(root) == 5
    factor = scan_factor(0, gtsam.Pose3(), measured, root, np.zeros(6))
    here = measured.retract(0.01 * rng.standard_normal(6))
    values, shifted = gtsam.Values(), gtsam.Values()
    values.insert(0, here)
    shifted.insert(0, pose(here.rotation().matrix(), here.translation() + 7.0 * axis))
    assert factor.error(shifted) == pytest.approx(factor.error(values), rel=1e-9)
    jacobian = factor.linearize(values).jacobian()[0]
    along = np.append(np.zeros(3), here.rotation().matrix().T @ axis)
    np.testing.assert_allclose(jacobian @ along, 0.0, atol=1e-7)


@pytest.mark.parametrize("rank", [0, 1, 3, 6])
def test_information_root_of_any_rank(rank):
    rows = np.random.default_rng(rank).standard_normal((rank, 6)) * np.repeat([1e4, 10.0], 3)
    root = information_root(rows.T @ rows)
    assert root.shape == (rank, 6)
    np.testing.assert_allclose(root.T @ root, rows.T @ rows, rtol=1e-9, atol=1e-3)


@pytest.mark.parametrize(
    ("diagonal", "rank"),
    [((1e6,) * 3 + (0,) * 3, 3), ((0,) * 3 + (1e6,) * 3, 3), ((1e6,) * 3 + (1e4, 1e4, -1e-8), 5)],
)
def test_rounding_is_no_information(diagonal, rank):
    information = np.diag(np.array(diagonal, float))
    information[0, 3] = information[3, 0] = 1e-11
    assert len(information_root(information)) == rank


@pytest.mark.parametrize(
    ("information", "what"),
    [
        (np.diag([1e6, 1e6, 1e6, 1e4, 1e4, -1.0]), "negative eigenvalue"),
        (1e19 * np.eye(6), "up to 1e.18"),
        (np.full((6, 6), np.nan), "finite numbers"),
        (np.eye(3), r"expected \(6, 6\)"),
    ],
)
def test_information_that_is_none(information, what):
    odo = odometry()
    with pytest.raises(InputError, match="predict"):
        odo.update(gtsam.Pose3(), KNOWN)
    odo.predict(START + FRAME, samples())
    with pytest.raises(InputError, match=what):
        odo.update(gtsam.Pose3(), information)
    odo.update(gtsam.Pose3(), KNOWN)  # the prediction is still there


def test_without_information_the_prediction_is_the_frame_and_the_one_before_is_forgotten():
    data = samples((0.1, 0.2, 0.3), UP + np.array([0.5, 0.0, 0.0]))
    odo = odometry()
    odo.predict(START + FRAME, data)
    found = odo.predict(START + 2 * FRAME, data)
    odo.update(gtsam.Pose3().retract(np.ones(6)), np.zeros((6, 6)))
    np.testing.assert_array_equal(odo.state.map_T_imu.matrix(), found.map_T_lidar.matrix())
    np.testing.assert_array_equal(odo.state.covariance[:6, :6], found.covariance)
    expected = odometry().predict(START + 2 * FRAME, data)
    np.testing.assert_array_equal(found.covariance, expected.covariance)


def turning_on_the_spot(frames, gyro_bias, acceleration_bias, noise=0.0, config=None, **known):
    """A platform that turns about the vertical at 0.6 rad/s, seen by a scan of 1 mrad and 1 cm."""
    rng, rate, odo = np.random.default_rng(5), 0.6, odometry(config, **known)
    data = samples(gyro_bias + np.array([0.0, 0.0, rate]), UP + acceleration_bias, 0.1 * frames)
    for k in range(1, frames + 1):
        odo.predict(START + k * FRAME, data)
        truth = pose(gtsam.Rot3.Rz(0.1 * k * rate).matrix(), np.zeros(3))
        scan = truth.retract(noise * rng.standard_normal(6) * np.repeat([1e-3, 1e-2], 3))
        odo.update(scan, KNOWN)
    return odo


def test_biases_and_gravity_are_found():
    gyro, acceleration = np.array([0.002, -0.001, 0.0015]), np.array([0.03, -0.02, 0.04])
    tilted = gtsam.Rot3.Expmap(np.array([0.008, -0.006, 0.0])).matrix() @ DOWN
    odo = turning_on_the_spot(120, gyro, acceleration, noise=1.0, gravity=tilted)
    state = odo.state
    sigmas = np.sqrt(np.diag(state.covariance))
    assert np.all(np.abs(state.gyro_bias - gyro) < 3.0 * sigmas[12:15])
    assert np.all(np.abs(state.acceleration_bias - acceleration) < 3.0 * sigmas[9:12])
    assert np.all(np.abs(state.map_gravity - DOWN) < 3.0 * sigmas[15:18])
    # At first 0.1 m/s^2, 0.01 rad/s and 0.01 rad of gravity.
    assert np.all(sigmas[9:11] < 0.005)
    assert np.all(sigmas[12:15] < 3e-4)
    assert np.all(sigmas[15:17] < 0.005)
    assert np.linalg.norm(state.velocity) < 0.02


def test_a_short_window_knows_what_a_long_one_does():
    gyro, acceleration = np.array([0.002, -0.001, 0.0015]), np.array([0.03, -0.02, 0.04])
    short, long = (
        turning_on_the_spot(40, gyro, acceleration, noise=1.0, config=ImuConfig(lag=lag)).state
        for lag in (2, 100)
    )
    sigmas = np.sqrt(np.diag(long.covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(short.covariance)), sigmas, rtol=0.05)
    assert np.all(np.abs(short.gyro_bias - long.gyro_bias) < 0.3 * sigmas[12:15])
    assert np.all(np.abs(short.velocity - long.velocity) < 0.3 * sigmas[6:9])


@pytest.mark.parametrize("frames", [2, 4, 5, 11])
@pytest.mark.parametrize("asked", [False, True])
def test_a_window_read_from_a_checkpoint_goes_on_to_the_last_bit(frames, asked):
    """Before and after the window has forgotten frames; also between a prediction and its scan."""
    odo = turning_on_the_spot(frames, np.zeros(3), np.zeros(3), 1.0, ImuConfig(lag=4))
    rng = np.random.default_rng(0)

    def ahead(frame):
        rows = samples(gyro=[0.1, -0.2, 0.3], seconds=2.0 * FRAME * frame * 1e-9)
        gyro = rows.gyro + 0.01 * rng.normal(size=rows.gyro.shape)
        return START + FRAME * frame, ImuSamples(rows.stamps, None, gyro, rows.acceleration)

    if asked:
        odo.predict(*ahead(frames + 1))
    again, shared = odometry(odo.config), {"config": odo.config}
    thaw(freeze({"odometry": odo}, shared), {"odometry": again}, shared)
    for number in range(frames + 1, frames + 8):
        if number > frames + 1 or not asked:
            moment = ahead(number)
            one, two = odo.predict(*moment), again.predict(*moment)
            np.testing.assert_array_equal(one.covariance, two.covariance)
            np.testing.assert_array_equal(one.map_T_lidar.matrix(), two.map_T_lidar.matrix())
        for same in (odo, again):
            same.update(gtsam.Pose3(), KNOWN if number % 3 else np.zeros((6, 6)))
        np.testing.assert_array_equal(odo.state.covariance, again.state.covariance)
    assert odo.restarts == again.restarts


def test_a_featureless_corridor():
    """From frame 150 on the scan corrects all but the way along."""
    world, rng = SimulatedWorld("corridor_bare"), np.random.default_rng(6)
    stamps = world.truth.stamps[:320] + FRAME // 2
    truth = world.truth_at(stamps).map_T_lidar
    map_R_world = world.world_T_start[:3, :3].T
    axis = map_R_world[:, 0]
    odo = odometry(gravity=map_R_world @ DOWN, pose=gtsam.Pose3(truth[0]), start=int(stamps[0]))
    errors = []
    for k in range(1, len(stamps)):
        found = odo.predict(int(stamps[k]), world.imu)
        errors.append(found.map_T_lidar.translation() - truth[k, :3, 3])
        scan = gtsam.Pose3(truth[k]).retract(rng.standard_normal(6) * np.repeat([1e-3, 1e-2], 3))
        odo.update(scan, KNOWN if k < 150 else blind(scan.rotation().matrix(), axis))
    assert odo.restarts == 0
    last, driven = errors[-1] @ axis, (truth[-1] - truth[150])[:3, 3] @ axis
    toward = np.append(np.zeros(3), found.map_T_lidar.rotation().matrix().T @ axis)
    sigma = np.sqrt(toward @ found.covariance @ toward)
    assert driven > 80.0
    assert abs(last) < 0.005 * driven
    # Honest, and a prediction that grows: the scans' 1 mrad of rotation do not leak into it.
    assert abs(last) < 3.0 * sigma
    assert 0.15 < sigma < 1.0
    across = np.array(errors[150:]) @ (np.eye(3) - np.outer(axis, axis))
    assert np.sqrt((across**2).mean()) < 0.01


def broken(rows=slice(None), row=0, **put):
    """Some rows of the samples, with one value of one row changed."""
    data = part(samples(), rows)
    for name, value in put.items():
        getattr(data, name)[row] = value
    return data


def without(first, last):
    """All rows but first to last."""
    return np.r_[0:first, last + 1 : 201]


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (broken(slice(1, None)), "cover"),
        (broken(slice(0, 20)), "cover"),
        (broken(slice(0, 0)), "got none"),
        (broken(without(3, 18)), "up to 0.06"),
        (broken(row=5, stamps=START + 4 * STEP), "above 0"),
        (broken(row=5, stamps=START + 3 * STEP), "above 0"),
        (broken(row=4, gyro=np.nan), "no finite covariance"),
        (broken(row=4, acceleration=np.nan), "no finite covariance"),
    ],
)
def test_samples_that_do_not_do(data, what):
    odo = odometry(ImuConfig(max_gap=0.06))
    before = odo.state
    with pytest.raises(SweepError, match=what):
        odo.predict(START + FRAME, data)
    with pytest.raises(SweepError, match="later than"):
        odo.predict(START, data)
    assert odo.state is before
    odo.predict(START + FRAME, samples())
    odo.update(gtsam.Pose3(), KNOWN)


@pytest.mark.parametrize(
    "data",
    [
        broken(slice(0, 21)),  # from the one stamp to the other exactly
        broken(without(3, 13)),  # a gap of 60 ms
        broken(row=30, gyro=np.nan),  # later
    ],
)
def test_samples_that_just_do(data):
    found = odometry(ImuConfig(max_gap=0.06)).predict(START + FRAME, data)
    np.testing.assert_allclose(found.map_T_lidar.matrix(), np.eye(4), atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        ({"gravity": np.zeros(3)}, "map_gravity"),
        ({"gravity": np.ones(2)}, "map_gravity"),
        ({"velocity": np.full(3, np.nan)}, "velocity"),
        ({"gyro_bias": np.zeros(6)}, "gyro_bias"),
    ],
)
def test_a_start_that_is_none(arguments, what):
    with pytest.raises(InputError, match=what):
        odometry(**arguments)


def drive(odo, frames, speed, jump=None, start=1):
    """A straight way at constant speed, with the scan ``jump`` away from some frame on."""
    data = samples(seconds=0.1 * (start + frames))
    for k in range(start, start + frames):
        found = odo.predict(START + k * FRAME, data)
        truth = pose(np.eye(3), [speed * 0.1 * k, 0.0, 0.0])
        odo.update(truth if jump is None else jump.compose(truth), KNOWN)
    return found


def test_a_jump_of_the_scan_begins_anew_and_leaves_the_biases():
    odo = odometry(velocity=np.array([5.0, 0.0, 0.0]))
    drive(odo, 30, 5.0)
    before = odo.state
    jump = pose(np.eye(3), [0.0, 3.0, 1.0])
    drive(odo, 1, 5.0, jump, start=31)
    assert odo.restarts == 1
    # Along the way, where the scan did not jump, the velocity is known as well as before.
    assert odo.state.covariance[6, 6] < 2.0 * before.covariance[6, 6]
    assert odo.state.covariance[7, 7] > 1.0
    found = drive(odo, 9, 5.0, jump, start=32)
    assert odo.restarts == 1
    np.testing.assert_allclose(found.map_T_lidar.translation(), [20.0, 3.0, 1.0], atol=0.01)
    sigmas = np.sqrt(np.diag(before.covariance))
    assert np.all(np.abs(odo.state.acceleration_bias - before.acceleration_bias) < sigmas[9:12])


@pytest.mark.parametrize("claimed", [1e17, 1e-3])
def test_a_jump_with_information_of_any_size(claimed):
    odo = odometry()
    odo.predict(START + FRAME, samples())
    odo.update(pose(np.eye(3), [1e6, 0.0, 0.0]), claimed * np.eye(6))
    assert odo.restarts == 1
    found = odo.predict(START + 2 * FRAME, samples())
    assert np.isfinite(found.covariance).all()
    odo.update(found.map_T_lidar, KNOWN)
    assert odo.restarts == 1


def test_what_hardly_knows_a_way_may_have_it_far_away():
    """As height and tilt along a corridor: 50 m off, which is one standard deviation."""
    rng = np.random.default_rng(4)
    across, along = rng.normal(size=(5, 6)), np.array([1e-3, 0.0, 0.0, 1.0, 4e-3, 0.0])
    across -= np.outer(across @ along, along) / (along @ along)
    known = 1e6 * across.T @ across + 50.0**-2 * np.outer(along, along) / (along @ along) ** 2
    found = []
    for step in (50.0 * along, np.zeros(6)):
        odo = odometry()
        for k in range(1, 20):
            odo.predict(START + k * FRAME, samples(seconds=3.0))
            odo.update(gtsam.Pose3(), known, step)
        assert odo.restarts == 0
        assert odo.surprise < 1.0
        found.append(odo.state)
    off = found[0].map_T_imu.localCoordinates(found[1].map_T_imu)
    assert np.abs(off).max() < 0.1 < np.sqrt(found[0].covariance[3, 3])


def test_a_disagreement_within_reason_does_not():
    odo = odometry(velocity=np.array([5.0, 0.0, 0.0]))
    drive(odo, 30, 5.0)
    drive(odo, 10, 5.0, pose(np.eye(3), [0.0, 0.1, 0.0]), start=31)
    assert odo.restarts == 0


def test_a_graph_that_cannot_be_solved_begins_anew():
    # Noise so small that no digits are left for the scan.
    tiny = dict.fromkeys(
        ("acceleration_noise", "gyro_noise", "acceleration_bias_walk", "gyro_bias_walk"), 1e-9
    )
    odo = odometry(ImuConfig(**tiny))
    odo.predict(START + FRAME, samples())
    odo.update(gtsam.Pose3().retract(np.full(6, 1e-3)), KNOWN)
    assert odo.restarts == 1
    assert odo.state.stamp == START + FRAME
    np.testing.assert_allclose(odo.state.map_T_imu.matrix(), np.eye(4), atol=1e-9)
    odo.predict(START + 2 * FRAME, samples())


def test_restart_after_a_gap():
    odo = turning_on_the_spot(60, np.array([0.002, -0.001, 0.0015]), np.array([0.03, 0.0, 0.04]))
    before = odo.state
    there = pose(np.eye(3), [1.0, 2.0, 3.0])
    odo.restart(before.stamp + 100 * FRAME, there, np.array([1.0, 0.0, 0.0]))
    state = odo.state
    assert odo.restarts == 0  # asked for, not needed
    np.testing.assert_array_equal(state.map_T_imu.matrix(), there.matrix())
    np.testing.assert_array_equal(state.gyro_bias, before.gyro_bias)
    grown = np.diag(state.covariance) - np.diag(before.covariance)
    np.testing.assert_allclose(grown[9:12], 10.0 * odo.config.acceleration_bias_walk**2)
    np.testing.assert_allclose(grown[12:15], 10.0 * odo.config.gyro_bias_walk**2)
    np.testing.assert_array_equal(grown[15:], 0.0)
    with pytest.raises(InputError, match="or later"):
        odo.restart(before.stamp, there, np.zeros(3))


def test_a_frame_that_is_put_elsewhere_in_the_map_tells_no_bias():
    """The map turns by a degree under a drive: the same scans are then seen from there."""
    found = {}
    for knows in (True, False):
        odo = odometry(velocity=np.array([5.0, 0.0, 0.0]))
        drive(odo, 10, 5.0)
        before = odo.state
        turn = gtsam.Pose3(gtsam.Rot3.Yaw(np.radians(1.0)), ZERO)
        if knows:
            odo.moved(turn.compose(pose(np.eye(3), [5.0, 0.0, 0.0])))
            known = [np.linalg.eigvalsh(one.covariance) for one in (odo.state, before)]
            np.testing.assert_allclose(*known, rtol=1e-6)
            turned = turn.rotation().rotate(before.velocity)
            np.testing.assert_allclose(odo.state.velocity, turned, atol=1e-9)
        drive(odo, 1, 5.0, turn, start=11)
        found[knows] = np.abs(odo.state.gyro_bias - before.gyro_bias).max(), odo.turn_surprise
    assert found[True][0] < 1e-6 < 1e-3 < found[False][0]
    assert found[True][1] < 1e-3 < 9.0 < found[False][1]


@pytest.mark.parametrize("far", [1.0, 1e12])
def test_a_turn_is_as_surprising_as_both_covariances_say(far):
    """However little is known of the prediction, as with a gyro in degrees."""
    told, error = np.diag([1e-4, 4e-4, far]), np.array([0.02, 0.0, 0.1])
    information = np.zeros((6, 6))
    information[0, 0], information[2, 2] = 1e4, 1e12  # nothing of the second axis
    found = _surprise_of_turn(error, told, information)
    assert found == pytest.approx(0.02**2 / 2e-4 + 0.1**2 / (far + 1e-12))
    one = np.outer(np.ones(3), np.ones(3))
    assert _surprise_of_turn(error, 1e25 * one, 1e12 * np.eye(6)) >= 0.0


def test_a_frame_that_was_put_elsewhere_has_to_be_predicted_from_there():
    odo = odometry()
    odo.predict(START + FRAME, samples())
    odo.moved(gtsam.Pose3())
    with pytest.raises(InputError, match="nothing has been predicted"):
        odo.update(gtsam.Pose3(), KNOWN)


def test_a_frame_that_is_put_where_it_was_changes_nothing():
    """What velocity, biases and gravity have in common goes into the new window, too."""
    biases = np.array([0.002, -0.001, 0.0015]), np.array([0.03, 0.0, 0.04])
    found = []
    for anew in (False, True):
        odo = turning_on_the_spot(30, *biases)
        if anew:
            odo.moved(gtsam.Pose3(gtsam.Rot3.Rz(30 * 0.1 * 0.6), ZERO))
        data = samples(biases[0] + np.array([0.0, 0.0, 0.6]), UP + biases[1], 4.0)
        expected = odo.predict(START + 31 * FRAME, data).map_T_lidar
        odo.update(expected.retract(np.full(6, 1e-4)), KNOWN)
        found.append(np.sqrt(np.diag(odo.state.covariance)))
    np.testing.assert_allclose(*found, rtol=1e-3)
