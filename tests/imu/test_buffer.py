"""The IMU buffer against motion that is known in closed form, and against the simulated world."""

import dataclasses
import functools
import itertools
import operator

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loam_gtsam.config import ImuConfig
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.imu import quaternions
from loam_gtsam.imu.at_rest import find_rest, rest_at_start
from loam_gtsam.imu.buffer import ImuBuffer, extrinsic_problem
from loam_gtsam.types import ImuSamples, InputError

START = 1_700_000_000_000_000_000
PERIOD = 5_000_000
G = 9.81
CONFIG = ImuConfig(max_gap=0.1, filter_seconds=20.0, still_seconds=0.5, gravity=G)


def ns(seconds):
    return START + np.round(np.asarray(seconds) * 1e9).astype(np.int64)


def motion(times):
    """Exact world_R_lidar and body rates; up to 2.2 rad/s and 3 rad/s^2 about moving axes."""
    phases = np.array([0.3, 1.1, 2.0])
    amplitude, number = np.array([[0.5], [0.4], [1.5]]), np.array([[2.0], [2.5], [1.2]])
    angle = number * times + phases[:, None]
    roll, pitch, yaw = amplitude * np.sin(angle)
    d_roll, d_pitch, d_yaw = amplitude * number * np.cos(angle)
    rates = [
        d_roll - np.sin(pitch) * d_yaw,
        np.cos(roll) * d_pitch + np.sin(roll) * np.cos(pitch) * d_yaw,
        -np.sin(roll) * d_pitch + np.cos(roll) * np.cos(pitch) * d_yaw,
    ]
    # 2.5 rad more: the yaw passes +-pi.
    return Rotation.from_euler("ZYX", np.stack([yaw + 2.5, pitch, roll], 1)), np.stack(rates, 1)


def moving(seconds=4.0, *, rate=200.0, orientation=True):
    times = np.arange(round(seconds * rate)) / rate
    world_R_lidar, gyro = motion(times)
    return ImuSamples(
        stamps=ns(times),
        orientation=world_R_lidar.as_quat() if orientation else None,
        gyro=gyro,
        acceleration=world_R_lidar.inv().apply([0.0, 0.0, G]),
    )


def resting(count=200, *, world_R_lidar=None, seed=0):
    """Noisy samples at rest, without orientation."""
    rng = np.random.default_rng(seed)
    up = [0.0, 0.0, G] if world_R_lidar is None else world_R_lidar.inv().apply([0.0, 0.0, G])
    return ImuSamples(
        stamps=START + PERIOD * np.arange(count),
        orientation=None,
        gyro=np.array([0.002, -0.001, 0.0015]) + 0.003 * rng.standard_normal((count, 3)),
        acceleration=up + 0.03 * rng.standard_normal((count, 3)),
    )


def part(samples, index):
    return ImuSamples(
        samples.stamps[index],
        None if samples.orientation is None else samples.orientation[index],
        samples.gyro[index],
        samples.acceleration[index],
    )


def as_seen_by(samples, lidar_R_imu):
    """What an IMU mounted so would have measured."""
    return ImuSamples(
        samples.stamps,
        None
        if samples.orientation is None
        else (Rotation.from_quat(samples.orientation) * lidar_R_imu).as_quat(),
        lidar_R_imu.inv().apply(samples.gyro),
        lidar_R_imu.inv().apply(samples.acceleration),
    )


def angle(a, b):
    """Rad between two rotations of either library."""
    a, b = (
        Rotation.from_matrix(r.matrix() if isinstance(r, gtsam.Rot3) else r.as_matrix())
        for r in (a, b)
    )
    return (a.inv() * b).magnitude()


def product(steps):
    """Of scipy rotations, one by one."""
    return functools.reduce(operator.mul, steps, Rotation.identity())


def rot(*degrees):
    """Rz Ry Rx from roll, pitch, yaw."""
    return Rotation.from_euler("ZYX", degrees[::-1], degrees=True)


# -- many rotations at once ------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 5, 64, 513])
def test_running_product_is_the_product_one_by_one(count):
    steps = Rotation.random(count, rng=count)
    expected = [r.as_matrix() for r in itertools.accumulate(steps, operator.mul)]
    found = quaternions.running_product(steps.as_quat().T)
    assert np.allclose(Rotation.from_quat(found.T).as_matrix(), expected, atol=1e-12)


def test_exponential_and_logarithm_are_scipys_and_each_others_inverse():
    rng = np.random.default_rng(0)
    axes = rng.standard_normal((60, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    vectors = axes * np.repeat([0.0, 1e-14, 1e-7, 0.3, 2.0, np.pi - 1e-6], 10)[:, None]
    q = quaternions.exponential(vectors.T)
    reference = Rotation.from_rotvec(vectors)
    assert (reference.inv() * Rotation.from_quat(q.T)).magnitude().max() < 1e-12
    for sign in (1.0, -1.0):
        assert np.allclose(quaternions.logarithm(sign * q).T, vectors, rtol=1e-9, atol=1e-15)
    points = rng.standard_normal((3, 60))
    assert np.allclose(quaternions.rotate(q, points).T, reference.apply(points.T))
    back = quaternions.quaternion_product(quaternions.inverse(q), q)
    assert np.allclose(back.T, [0.0, 0.0, 0.0, 1.0])


def test_rotation_steps_follow_a_moving_axis():
    """Rates that change evenly but not about one axis: the trapezoid alone is off by coning."""
    start, change = np.array([[2.0], [0.5], [-1.0]]), np.array([[-3.0], [4.0], [2.0]])
    rough, fine = np.linspace(0.0, 0.1, 6), np.linspace(0.0, 0.1, 20_001)
    exact = Rotation.from_quat(
        quaternions.running_product(
            quaternions.exponential(quaternions.rotation_steps(fine, start + change * fine))
        )[:, -1]
    )
    rates = start + change * rough
    steps = quaternions.rotation_steps(rough, rates)
    plain = 0.5 * np.diff(rough) * (rates[:, 1:] + rates[:, :-1])
    errors = [angle(exact, product(Rotation.from_rotvec(v.T))) for v in (steps, plain)]
    assert errors[0] < 1e-6
    assert errors[1] > 2e-5


def test_running_filter_is_the_recursion_even_where_it_forgets():
    rng = np.random.default_rng(1)
    keep, new = rng.random(300), rng.standard_normal((3, 300))
    keep[[0, 17, 18, 255]] = 0.0
    y, expected = np.array([1.0, 2.0, 3.0]), []
    for k in range(300):
        y = keep[k] * y + new[:, k]
        expected.append(y)
    found = quaternions.running_filter(keep, new, np.array([1.0, 2.0, 3.0]))
    assert np.allclose(found.T, expected, atol=1e-13)


def test_levelling_turns_up_to_z_the_shortest_way():
    ups = np.random.default_rng(2).standard_normal((3, 50)) * 5.0
    ups = np.column_stack([ups, [0.0, 0.0, 3.0], [0.0, 0.0, -3.0], [0.0, 0.0, 0.0]])
    q = quaternions.levelling(ups)
    turned = quaternions.rotate(q, ups)[:, :-1]
    assert np.allclose(turned[:2], 0.0, atol=1e-9)
    assert np.allclose(turned[2], np.linalg.norm(ups[:, :-1], axis=0))
    steepness = np.arccos(ups[2, :50] / np.linalg.norm(ups[:, :50], axis=0))
    assert np.allclose(Rotation.from_quat(q.T[:50]).magnitude(), steepness)
    assert np.array_equal(q[:, -1], [0.0, 0.0, 0.0, 1.0])


# -- rotation from the gyro ------------------------------------------------------------------------


@pytest.mark.parametrize("start", [0.4, 1.2345678, 2.7])
def test_turn_is_exact_over_a_sweep(start):
    stamp = int(ns(start))
    seconds = np.random.default_rng(3).uniform(-0.03, 0.1, 500)
    found = ImuBuffer(CONFIG, moving()).rotations_since(stamp, seconds)
    exact = motion(np.array([start]))[0].inv() * motion(start + seconds)[0]
    assert found.shape == (500, 3)
    assert (Rotation.from_rotvec(found).inv() * exact).magnitude().max() < 1e-5
    assert np.linalg.norm(found, axis=1).max() > 0.07


def test_turn_subtracts_the_bias_and_zero_seconds_turn_nothing():
    samples = moving()
    bias = np.array([0.03, -0.02, 0.01])
    buffer = ImuBuffer(CONFIG, dataclasses.replace(samples, gyro=samples.gyro + bias))
    seconds = np.array([0.0, 0.05, 0.1])
    plain = ImuBuffer(CONFIG, samples).rotations_since(int(ns(1.0)), seconds)
    assert not np.allclose(buffer.rotations_since(int(ns(1.0)), seconds), plain, atol=1e-3)
    buffer.gyro_bias = bias
    assert np.allclose(buffer.rotations_since(int(ns(1.0)), seconds), plain, atol=1e-12)
    assert np.array_equal(plain[0], np.zeros(3))
    assert buffer.rotations_since(int(ns(1.0)), np.zeros(0)).shape == (0, 3)
    for wrong in (np.zeros(2), [0.0, np.nan, 0.0]):
        with pytest.raises(InputError, match="gyro_bias: expected 3"):
            buffer.gyro_bias = wrong


def test_stamps_are_not_rounded_to_what_a_float_can_hold():
    samples = moving(0.5)
    even = dataclasses.replace(samples, gyro=np.tile([0.0, 0.0, 1.0], (100, 1)))
    turned = ImuBuffer(CONFIG, even).rotation_between(START + 20_000_001, START + 20_000_101)
    assert turned.yaw() == pytest.approx(1e-7, rel=1e-6)


def test_turn_ends_where_the_data_does():
    buffer = ImuBuffer(CONFIG, moving(1.0))
    last = int(ns(0.995))
    assert buffer.rotations_since(int(ns(0.0)), np.array([-1e-6])) is None
    assert buffer.rotations_since(int(ns(0.0)), np.array([0.0])) is not None
    held = buffer.rotations_since(last, np.array([0.0999]))
    assert np.allclose(held[0], motion(np.array([0.995]))[1] * 0.0999, atol=1e-6)
    assert buffer.rotations_since(last, np.array([0.1001])) is None
    assert buffer.rotations_since(last + 50_000_000, np.array([0.04])) is not None
    assert buffer.rotations_since(last + 200_000_000, np.array([0.0])) is None
    assert ImuBuffer(CONFIG).rotations_since(START, np.array([0.0])) is None
    for wrong in (np.zeros((2, 2)), np.array([np.nan])):
        with pytest.raises(InputError, match=r"seconds: expected a \(K,\) array"):
            buffer.rotations_since(last, wrong)


def test_turn_and_between_do_not_bridge_a_long_gap():
    samples = moving(2.0)
    seconds = (samples.stamps - START) * 1e-9
    for gap, bridged in ((0.09, True), (0.11, False)):
        buffer = ImuBuffer(CONFIG, part(samples, (seconds < 1.0) | (seconds > 1.0 + gap)))
        for found in (
            buffer.rotations_since(int(ns(0.98)), np.array([0.15])),
            buffer.rotations_since(int(ns(1.05)), np.array([0.0])),
            buffer.rotation_between(int(ns(0.5)), int(ns(1.5))),
        ):
            assert (found is not None) is bridged
        assert buffer.rotation_between(int(ns(0.2)), int(ns(0.99))) is not None


def test_turn_does_not_interpolate_across_a_half_turn():
    samples = moving(1.0)
    buffer = ImuBuffer(CONFIG, dataclasses.replace(samples, gyro=np.tile([0, 0, 5.0], (200, 1))))
    assert buffer.rotations_since(START, np.array([0.59]))[0, 2] == pytest.approx(2.95)
    assert buffer.rotations_since(START, np.array([0.61])) is None
    # Each side counts for itself.
    both = buffer.rotations_since(int(ns(0.45)), np.array([-0.4, 0.4]))
    assert np.allclose(both[:, 2], [-2.0, 2.0])


def test_between_is_exact_and_its_own_inverse():
    buffer = ImuBuffer(CONFIG, moving())
    first, second = 0.3012345, 3.7
    exact = motion(np.array([first]))[0].inv() * motion(np.array([second]))[0]
    found = buffer.rotation_between(int(ns(first)), int(ns(second)))
    assert angle(found, exact[0]) < 3e-5
    assert angle(buffer.rotation_between(int(ns(second)), int(ns(first))), found.inverse()) < 1e-12
    assert angle(buffer.rotation_between(int(ns(1.0)), int(ns(1.0))), Rotation.identity()) == 0.0
    assert buffer.rotation_between(int(ns(-0.01)), int(ns(1.0))) is None


# -- orientation -----------------------------------------------------------------------------------


def test_orientation_is_interpolated_through_every_wrap():
    samples = moving()
    signs = np.where(np.arange(len(samples.stamps)) % 3 == 0, -1.0, 1.0)
    flipped = dataclasses.replace(samples, orientation=samples.orientation * signs[:, None])
    buffer = ImuBuffer(CONFIG, flipped)
    times = np.linspace(0.0, 3.9, 173)
    exact = motion(times)[0]
    yaw = exact.as_euler("ZYX")[:, 0]
    assert np.abs(np.diff(yaw)).max() > 6.0  # it does pass +-pi
    errors = [angle(buffer.orientation(int(s)), r) for s, r in zip(ns(times), exact, strict=True)]
    assert max(errors) < 2e-5  # 3 rad/s^2 h^2 / 8, and more of it
    assert (
        angle(
            buffer.orientation(int(samples.stamps[77])), Rotation.from_quat(samples.orientation[77])
        )
        < 1e-12
    )
    assert buffer.report.orientation == "ahrs"
    assert buffer.report.problems == ()


def test_orientation_is_held_at_the_end_only_and_not_for_ever():
    samples = moving(2.0)
    seconds = (samples.stamps - START) * 1e-9
    buffer = ImuBuffer(CONFIG, part(samples, (seconds < 1.0) | (seconds > 1.2)))
    last = int(samples.stamps[-1])
    assert buffer.orientation(START - 1) is None
    assert buffer.orientation(START) is not None
    for inside in (1.0, 1.1, 1.19):
        assert buffer.orientation(int(ns(inside))) is None
    assert angle(buffer.orientation(last + 99_000_000), motion(np.array([1.995]))[0][0]) < 1e-12
    assert buffer.orientation(last + 101_000_000) is None
    assert buffer.orientation(last + 10**12) is None
    assert ImuBuffer(CONFIG).orientation(START) is None
    report = buffer.report
    assert (report.gaps, report.rate) == (1, pytest.approx(200.0))
    assert "1 gaps of more than 0.1 s, the longest 0.205 s" in report.problems[0]


def test_samples_without_quaternion_are_interpolated_among_those_with():
    samples = moving(2.0)
    orientation = samples.orientation.copy()
    orientation[100:110] = 0.0
    orientation[200] = np.nan
    orientation[300:330] = 0.0
    orientation[50] *= 1.7
    buffer = ImuBuffer(CONFIG, dataclasses.replace(samples, orientation=orientation))
    for index, known in ((50, True), (104, True), (200, True), (315, False), (330, True)):
        found = buffer.orientation(int(samples.stamps[index]) + 1)
        assert (found is not None) is known, index
        if known:
            assert angle(found, Rotation.from_quat(samples.orientation[index])) < 2e-3
    assert buffer.rotations_since(int(samples.stamps[300]), np.array([0.1])) is not None
    report = buffer.report
    assert (report.no_orientation, report.unnormalised, report.not_finite) == (41, 1, 0)
    assert len(report.problems) == 2
    # At the end the last one known is held.
    orientation[380:] = 0.0
    buffer = ImuBuffer(CONFIG, dataclasses.replace(samples, orientation=orientation))
    assert buffer.orientation(int(samples.stamps[379]) + 99_000_000) is not None
    assert buffer.orientation(int(samples.stamps[399])) is not None
    assert buffer.orientation(int(samples.stamps[379]) + 101_000_000) is None


@pytest.mark.parametrize("orientation", [True, False])
def test_everything_comes_out_in_lidar_axes(orientation):
    degrees = (180.0, 5.0, -30.0)
    samples = moving(orientation=orientation)
    there = as_seen_by(samples, rot(*degrees))
    config = dataclasses.replace(CONFIG, lidar_R_imu_deg=degrees)
    expected, found = ImuBuffer(CONFIG, samples), ImuBuffer(config, there)
    stamp = int(ns(1.01))
    assert angle(found.orientation(stamp), expected.orientation(stamp)) < 1e-9
    assert (
        angle(found.rotation_between(START, stamp), expected.rotation_between(START, stamp)) < 1e-9
    )
    a, b = found.samples_between(START, stamp), expected.samples_between(START, stamp)
    assert len(a.stamps) == 203
    for name in ("gyro", "acceleration"):
        assert np.allclose(getattr(a, name), getattr(b, name), atol=1e-12)
    assert np.allclose(np.abs((a.orientation * b.orientation).sum(axis=1)), 1.0)
    assert angle(found.lidar_R_imu, rot(*degrees)) < 1e-12


# -- in any order ----------------------------------------------------------------------------------


def answers(buffer, samples):
    """Bytes of everything a buffer says."""
    stamps = samples.stamps[::97].tolist()
    rotations_ = [buffer.orientation(s + 3) for s in stamps]
    rotations_ += [buffer.rotation_between(stamps[0], s) for s in stamps]
    turned = buffer.rotations_since(stamps[3], np.linspace(-0.05, 0.1, 40))
    window = buffer.samples_between(stamps[0], stamps[-1])
    return b"".join(
        [r.matrix().tobytes() for r in rotations_]
        + [turned.tobytes(), window.stamps.tobytes(), window.gyro.tobytes()]
        + [window.orientation.tobytes(), window.acceleration.tobytes()]
    )


@pytest.mark.parametrize("source", ["ahrs", "gravity_filter"])
def test_the_way_samples_come_in_does_not_matter(source):
    world = SimulatedWorld("shaken", frames=60)
    samples = world.imu
    if source == "gravity_filter":
        samples = dataclasses.replace(samples, orientation=None)
    count = len(samples.stamps)
    at_once = ImuBuffer(CONFIG, samples)
    expected = answers(at_once, samples)
    assert at_once.report.orientation == source
    rng = np.random.default_rng(4)

    live = ImuBuffer(CONFIG)
    for k in range(count):
        live.add(part(samples, slice(k, k + 1)))
        if k % 37 == 0:
            live.orientation(int(samples.stamps[k]))
    assert answers(live, samples) == expected
    assert live.report == at_once.report

    late = ImuBuffer(CONFIG)
    order = rng.permutation(count)
    for k in range(0, count, 100):
        late.add(part(samples, order[k : k + 120]))  # overlapping
        late.orientation(int(samples.stamps[0]))
    assert answers(late, samples) == expected
    report = late.report
    assert report.duplicates == 20 * ((count - 1) // 100)
    assert report.out_of_order > count // 2
    assert len(late) == report.samples == count

    # One sample comes last of all: within the rest at the start, or far behind it.
    for index in (30, 700):
        missing = ImuBuffer(CONFIG, part(samples, np.arange(count) != index))
        assert answers(missing, samples) != expected
        missing.add(part(samples, slice(index, index + 1)))
        assert answers(missing, samples) == expected
        assert missing.report.out_of_order == 1


def test_of_equal_stamps_the_first_to_come_is_kept():
    samples = moving(1.0)
    other = dataclasses.replace(samples, gyro=samples.gyro + 1.0)
    buffer = ImuBuffer(CONFIG, samples)
    buffer.add(other)
    assert np.array_equal(buffer.samples_between(START, START + 10**9).gyro, samples.gyro)
    assert (len(buffer), buffer.report.duplicates) == (200, 200)
    assert "200 samples repeat a stamp" in " ".join(buffer.report.problems)


def test_samples_that_are_no_numbers_are_left_out():
    samples = moving(1.0)
    samples.gyro[3, 1], samples.acceleration[10, 0] = np.nan, np.inf
    buffer = ImuBuffer(CONFIG, samples)
    assert (len(buffer), buffer.report.not_finite) == (198, 2)
    assert "2 samples hold NaN, infinity or absurd values: left out" in buffer.report.problems[0]
    buffer = ImuBuffer(CONFIG, dataclasses.replace(samples, gyro=np.full((200, 3), np.nan)))
    assert (len(buffer), buffer.report.orientation, buffer.report.rate) == (0, "none", 0.0)
    assert buffer.report.problems


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stamps": np.zeros(5)}, r"stamps: expected \(N,\) integer nanoseconds"),
        ({"stamps": np.zeros((5, 1), int)}, r"stamps: expected \(N,\) integer nanoseconds"),
        ({"gyro": np.zeros((4, 3))}, r"gyro: expected \(5, 3\) numbers.*got shape \(4, 3\)"),
        ({"acceleration": np.zeros((5, 2))}, r"acceleration: expected \(5, 3\)"),
        ({"orientation": np.zeros((5, 3))}, r"orientation: expected \(5, 4\)"),
        ({"gyro": np.full((5, 3), "x")}, r"gyro: expected \(5, 3\) numbers"),
    ],
)
def test_wrong_arrays_are_named(change, message):
    with pytest.raises(InputError, match=message):
        ImuBuffer(CONFIG, dataclasses.replace(part(moving(), slice(5)), **change))


# -- rest ------------------------------------------------------------------------------------------


def ramp(samples, name, slope):
    values = getattr(samples, name) + slope * np.linspace(0.0, 1.0, len(samples.stamps))[:, None]
    return dataclasses.replace(samples, **{name: values})


def scaled_scatter(samples, name, factor):
    values = getattr(samples, name)
    mean = values.mean(axis=0)
    return dataclasses.replace(samples, **{name: mean + factor * (values - mean)})


REST = resting(100)
ABOUT_X = np.array([1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("samples", "rest"),
    [
        (REST, True),
        (resting(100, world_R_lidar=rot(180, 0, 0)), True),
        (scaled_scatter(REST, "gyro", 4.0), True),  # 0.012 rad/s
        (scaled_scatter(REST, "gyro", 8.0), False),
        (scaled_scatter(REST, "acceleration", 4.0), True),  # 0.12 m/s^2
        (scaled_scatter(REST, "acceleration", 6.0), False),
        (ramp(REST, "gyro", 0.003), True),
        (ramp(REST, "gyro", 0.015), False),
        (ramp(REST, "acceleration", 0.03), True),
        (ramp(REST, "acceleration", 0.2), False),
        (dataclasses.replace(REST, gyro=REST.gyro + 0.04 * ABOUT_X), True),
        (dataclasses.replace(REST, gyro=REST.gyro + 0.06 * ABOUT_X), False),
        (dataclasses.replace(REST, acceleration=REST.acceleration * 1.04), True),
        (dataclasses.replace(REST, acceleration=REST.acceleration * 1.06), False),
        (dataclasses.replace(REST, acceleration=REST.acceleration * 0.94), False),
        (part(REST, slice(0, 100, 10)), True),
        (part(REST, slice(0, 90, 10)), False),  # 9 samples
        (part(REST, slice(21)), True),
        (part(REST, slice(20)), False),  # 0.095 s
        (part(REST, np.r_[:50, 68:100]), True),
        (part(REST, np.r_[:50, 71:100]), False),  # a gap of 0.11 s
        (part(REST, slice(0)), False),
    ],
)
def test_rest_is_told_from_motion(samples, rest):
    found = find_rest(CONFIG, samples.stamps, samples.gyro, samples.acceleration)
    assert (found is not None) is rest


def test_rest_at_start_takes_what_there_is_before_the_motion():
    late = resting(100)
    for begins, expected in ((100, 100), (60, 51), (30, 26), (10, None)):
        gyro = late.gyro.copy()
        gyro[begins:] += 0.3
        found = rest_at_start(CONFIG, late.stamps, gyro, late.acceleration)
        assert (found.samples if found else None) == expected


def test_still_window_gives_bias_gravity_and_orientation():
    truth = rot(10, -20, 170)
    samples = resting(world_R_lidar=truth)
    noise = Rotation.from_rotvec(0.003 * np.random.default_rng(5).standard_normal((200, 3)))
    quaternions = (truth * noise).as_quat() * np.where(np.arange(200) % 2, 1, -1)[:, None]
    buffer = ImuBuffer(CONFIG, dataclasses.replace(samples, orientation=quaternions))
    window = buffer.rest_at(int(ns(0.6)))
    assert (window.first, window.last, window.samples) == (ns(0.1), ns(0.7), 121)
    assert np.allclose(window.gyro, [0.002, -0.001, 0.0015], atol=1e-3)
    assert np.allclose(window.acceleration, truth.inv().apply([0, 0, G]), atol=0.02)
    assert angle(window.world_R_lidar, truth) < 1e-3
    assert window.disagreement < 2e-3
    without = ImuBuffer(dataclasses.replace(CONFIG, gravity=0.0), samples)
    assert without.rest_at(int(ns(0.6))) is None
    assert ImuBuffer(CONFIG, moving()).rest_at(int(ns(1.0))) is None
    # 0.1 s of rest before and the first sweep are enough.
    assert buffer.rest_at(START).samples == 21
    assert buffer.rest_at(START - 50_000_000) is None


@pytest.mark.parametrize(
    ("wrong", "told"),
    [(rot(0, 0, 90), False), (rot(4, 0, 0), False), (rot(6, 0, 0), True), (rot(180, 0, 0), True)],
)
def test_gravity_and_orientation_are_compared_at_rest(wrong, told):
    samples = resting()
    orientation = np.tile(wrong.as_quat(), (200, 1))
    report = ImuBuffer(CONFIG, dataclasses.replace(samples, orientation=orientation)).report
    assert report.orientation == "ahrs"
    assert any("degrees apart" in problem for problem in report.problems) is told


def test_a_placeholder_is_not_taken_for_an_orientation():
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (800, 1))
    report = ImuBuffer(CONFIG, dataclasses.replace(moving(), orientation=identity)).report
    assert report.orientation == "gravity_filter"
    assert "never changes while the gyro says" in report.problems[0]
    # At rest the same orientation may well be true, and with few samples nobody knows.
    for still in (
        dataclasses.replace(resting(800), orientation=identity),
        part(dataclasses.replace(moving(), orientation=identity), slice(9)),
    ):
        assert ImuBuffer(CONFIG, still).report.orientation == "ahrs"


# -- without orientation ---------------------------------------------------------------------------


def tilt_errors(world, config=CONFIG, samples=None):
    """Degrees between up by the filter and true up, and the buffer."""
    samples = dataclasses.replace(world.imu if samples is None else samples, orientation=None)
    buffer = ImuBuffer(config, samples)
    window = buffer.samples_between(int(samples.stamps[0]), int(samples.stamps[-1]))
    up = Rotation.from_quat(window.orientation).as_matrix()[:, 2]
    true_up = (world.world_T_start @ world.truth_at(samples.stamps).map_T_lidar)[:, 2, :3]
    return np.rad2deg(np.arccos(np.clip((up * true_up).sum(axis=1), -1.0, 1.0))), buffer


@pytest.mark.parametrize(
    ("scene", "options", "degrees"),
    [("room", {}, 0.6), ("shaken", {}, 0.8), ("slopes", {}, 2.0), ("street_loop", {}, 3.5)],
)
def test_gravity_filter_finds_up(scene, options, degrees):
    """About one and a half times what was measured: docs/maths/imu_buffer.md."""
    errors, buffer = tilt_errors(SimulatedWorld(scene, **options))
    assert np.sqrt(np.mean(errors**2)) < degrees
    assert buffer.report.orientation == "gravity_filter"
    assert buffer.report.problems == ()


def test_gravity_filter_beats_both_of_its_halves():
    world = SimulatedWorld("shaken", frames=900)
    errors, _ = tilt_errors(world)
    only_gyro, _ = tilt_errors(world, dataclasses.replace(CONFIG, filter_seconds=1e9))
    only_acceleration, _ = tilt_errors(world, dataclasses.replace(CONFIG, filter_seconds=0.1))
    assert errors[-1000:].mean() < 0.5 * only_gyro[-1000:].mean()
    assert errors[-1000:].mean() < 0.2 * only_acceleration[-1000:].mean()


@pytest.mark.parametrize("tilt", [(0, 0), (40, -20), (180, 0), (90, 0), (0, 90), (170, 80)])
def test_gravity_filter_starts_at_any_tilt_heading_along_x(tilt):
    truth = rot(*tilt, 0)
    found = ImuBuffer(CONFIG, resting(world_R_lidar=truth)).orientation(int(ns(0.9)))
    up = found.matrix()[2]
    assert np.allclose(up, truth.as_matrix()[2], atol=2e-3)
    if abs(tilt[1]) < 85:
        assert abs(found.yaw()) < 0.02


def test_gravity_filter_without_rest_says_so_and_comes_near():
    world = SimulatedWorld("shaken", frames=300)
    errors, buffer = tilt_errors(world, samples=part(world.imu, slice(1000, None)))
    assert "no rest at the start" in buffer.report.problems[0]
    assert np.sqrt(np.mean(errors**2)) < 1.5


def test_gravity_filter_without_rest_starts_from_many_samples():
    """With 3 m/s^2 of noise a single sample is off by 15 degrees, the mean of 101 by 2."""
    rng = np.random.default_rng(8)
    for seed in range(5):
        samples = resting(world_R_lidar=rot(20, 10, 0), seed=seed)
        rough = samples.acceleration + 3.0 * rng.standard_normal((200, 3))
        buffer = ImuBuffer(CONFIG, dataclasses.replace(samples, acceleration=rough))
        assert "no rest at the start" in buffer.report.problems[0]
        for stamp in samples.stamps[[0, 1, 5, 50, 100, 110]].tolist():
            up = buffer.orientation(stamp).matrix()[2]
            assert up @ rot(20, 10, 0).as_matrix()[2] > np.cos(np.deg2rad(6.0))


def test_an_acceleration_that_is_not_gravity_gives_no_orientation():
    for factor, source in ((0.6, "gravity_filter"), (0.4, "none"), (1.6, "none"), (0.0, "none")):
        samples = moving(orientation=False)
        samples = dataclasses.replace(samples, acceleration=factor * samples.acceleration)
        buffer = ImuBuffer(CONFIG, samples)
        assert buffer.report.orientation == source
        assert (buffer.orientation(int(ns(1.0))) is None) is (source == "none")
        assert buffer.rotations_since(int(ns(1.0)), np.array([0.1])) is not None
        if source == "none":
            assert "is not near 9.81 m/s^2" in buffer.report.problems[0]
            assert buffer.samples_between(START, START + 10**9).orientation is None


@pytest.mark.parametrize(("gap", "forgets"), [(2.0, False), (30.0, True)])
def test_after_a_gap_longer_than_its_memory_the_filter_starts_anew(gap, forgets):
    """The platform is laid on its side while nobody looks."""
    first, second = resting(400), resting(400, world_R_lidar=rot(60, 0, 0), seed=1)
    second = dataclasses.replace(
        second, stamps=first.stamps[-1] + round(gap * 1e9) + second.stamps - START
    )
    buffer = ImuBuffer(CONFIG, first)
    buffer.add(second)
    assert buffer.orientation(int(first.stamps[-1]) + 10**9) is None
    roll = buffer.orientation(int(second.stamps[-1])).roll()
    assert np.rad2deg(roll) == pytest.approx(60.0 if forgets else 5.0, abs=1.0)
    assert buffer.orientation(int(first.stamps[-1])).roll() == pytest.approx(0.0, abs=0.01)


# -- the extrinsic check ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walk():
    """IMU of a walk through the room, and the poses a scan matcher would give, 1 mrad off."""
    world = SimulatedWorld("shaken", frames=80)
    poses = world.truth.map_T_lidar.copy()
    noise = Rotation.from_rotvec(0.001 * np.random.default_rng(6).standard_normal((80, 3)))
    poses[:, :3, :3] = poses[:, :3, :3] @ noise.as_matrix()
    return dataclasses.replace(world.imu, orientation=None), world.truth.stamps, poses


@pytest.mark.parametrize(
    "degrees",
    [
        (90, 0, 0),
        (-90, 0, 0),
        (0, 45, 0),
        (0, 0, 90),
        (0, 0, -90),
        (180, 0, 0),
        (180, 0, 90),
        (3, 8, -170),
    ],
)
def test_a_wrong_mounting_is_found_and_named(walk, degrees):
    samples, stamps, poses = walk
    there = as_seen_by(samples, rot(*degrees))
    said = extrinsic_problem(ImuBuffer(CONFIG, there), stamps, poses)
    named = [float(x) for x in said.split("[")[1].split("]")[0].split(",")]
    assert angle(rot(*named), rot(*degrees)) < np.deg2rad(2.0)
    # Set as it says, it is content.
    config = dataclasses.replace(CONFIG, lidar_R_imu_deg=tuple(named))
    assert extrinsic_problem(ImuBuffer(config, there), stamps, poses) == ""
    # From a configuration that is wrong in another way the same is found.
    config = dataclasses.replace(CONFIG, lidar_R_imu_deg=(20.0, 0.0, 30.0))
    assert str([round(x) for x in named]) in extrinsic_problem(
        ImuBuffer(config, there), stamps, poses
    )


def test_a_pitch_of_ninety_degrees_is_named_by_any_of_its_angles(walk):
    samples, stamps, poses = walk
    there = as_seen_by(samples, rot(0, 90, 0))
    assert "better by 90 degrees" in extrinsic_problem(ImuBuffer(CONFIG, there), stamps, poses)


def test_a_good_or_nearly_good_mounting_is_left_alone(walk):
    samples, stamps, poses = walk
    for degrees, told in (((0, 0, 0), False), ((0, 0, 4), False), ((0, 6, 0), True)):
        buffer = ImuBuffer(CONFIG, as_seen_by(samples, rot(*degrees)))
        assert bool(extrinsic_problem(buffer, stamps, poses)) is told
        assert bool(extrinsic_problem(buffer, stamps, poses[:, :3, :3])) is told


def test_too_little_motion_says_nothing(walk):
    samples, stamps, poses = walk
    there = as_seen_by(samples, rot(0, 0, 90))
    buffer = ImuBuffer(CONFIG, there)
    assert extrinsic_problem(buffer, stamps[:20], poses[:20]) == ""  # 19 pairs
    assert extrinsic_problem(buffer, stamps[40:], poses[40:]) != ""
    assert extrinsic_problem(ImuBuffer(CONFIG), stamps, poses) == ""
    assert extrinsic_problem(buffer, stamps, np.tile(np.eye(4), (80, 1, 1))) == ""
    rng = np.random.default_rng(7)
    # About one axis only: the noise of the others must not pass for motion, however much of it.
    for count in (100, 3000):
        times = np.arange(20 * count) * 0.005
        gyro = np.column_stack([0 * times, 0 * times, 0.5 * np.sin(times)])
        even = ImuSamples(
            ns(times),
            None,
            gyro + 0.003 * rng.standard_normal(gyro.shape),
            np.tile([0, 0, G], (len(times), 1)),
        )
        yaw = 0.5 * (1.0 - np.cos(0.1 * np.arange(count)))
        scans = Rotation.from_euler("z", yaw[:, None]) * Rotation.from_rotvec(
            0.001 * rng.standard_normal((count, 3))
        )
        planar = ImuBuffer(CONFIG, as_seen_by(even, rot(0, 0, 90)))
        assert extrinsic_problem(planar, ns(0.1 * np.arange(count)), scans.as_matrix()) == ""


def test_lost_tracks_and_gaps_do_not_mislead(walk):
    samples, stamps, poses = walk
    poses = poses.copy()
    for k in (10, 30, 50):  # from there on in a map turned by 45 degrees
        poses[k:, :3, :3] = rot(25, 10, 40).as_matrix() @ poses[k:, :3, :3]
    seconds = (samples.stamps - stamps[0]) * 1e-9
    holed = part(samples, (seconds < 4.0) | (seconds > 4.5))
    assert extrinsic_problem(ImuBuffer(CONFIG, holed), stamps, poses) == ""
    there = as_seen_by(holed, rot(0, 0, 90))
    assert "[0, 0, 90]" in extrinsic_problem(ImuBuffer(CONFIG, there), stamps, poses)


@pytest.mark.parametrize("signs", [[1, -1, 1], [-1, -1, -1]])
def test_a_mirrored_gyro_is_no_matter_of_mounting(walk, signs):
    samples, stamps, poses = walk
    mirrored = dataclasses.replace(samples, gyro=samples.gyro * np.array(signs, float))
    assert extrinsic_problem(ImuBuffer(CONFIG, mirrored), stamps, poses) == ""


def test_extrinsic_check_wants_as_many_poses_as_stamps(walk):
    samples, stamps, poses = walk
    for wrong in (poses[:-1], poses[:, :3], poses[0]):
        with pytest.raises(InputError, match=r"expected \(N,\) stamps and"):
            extrinsic_problem(ImuBuffer(CONFIG, samples), stamps, wrong)
