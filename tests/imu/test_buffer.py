"""The IMU buffer against motion that is known in closed form."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.imu import CONFIG, START, angle, as_seen_by, motion, moving, ns, part, rot

from loam_gtsam.config import ImuConfig
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.io.state import freeze
from loam_gtsam.types import ImuSamples, InputError


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
        with pytest.raises(InputError, match="gyro_bias: expected"):
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
        with pytest.raises(InputError, match="seconds: expected"):
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
    at = buffer.orientation(int(samples.stamps[77]))
    assert angle(at, Rotation.from_quat(samples.orientation[77])) < 1e-12
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
    config = CONFIG.changed(lidar_R_imu_deg=degrees)
    expected, found = ImuBuffer(CONFIG, samples), ImuBuffer(config, there)
    stamp = int(ns(1.01))
    assert angle(found.orientation(stamp), expected.orientation(stamp)) < 1e-9
    turned = [buffer.rotation_between(START, stamp) for buffer in (found, expected)]
    assert angle(*turned) < 1e-9
    a, b = found.samples_between(START, stamp), expected.samples_between(START, stamp)
    assert len(a.stamps) == 203
    for name in ("gyro", "acceleration"):
        assert np.allclose(getattr(a, name), getattr(b, name), atol=1e-12)
    assert np.allclose(np.abs((a.orientation * b.orientation).sum(axis=1)), 1.0)
    assert angle(found.lidar_R_imu, rot(*degrees)) < 1e-12


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
    buffer = ImuBuffer(CONFIG, samples)
    buffer.add(dataclasses.replace(samples, gyro=samples.gyro + 1.0))
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
        ({"stamps": np.zeros(5)}, r"stamps: expected \(N,\) integer"),
        ({"stamps": np.zeros((5, 1), int)}, r"stamps: expected \(N,\) integer"),
        ({"gyro": np.zeros((4, 3))}, r"gyro: expected \(5, 3\) numbers.*got shape \(4, 3\)"),
        ({"acceleration": np.zeros((5, 2))}, r"acceleration: expected \(5, 3\)"),
        ({"orientation": np.zeros((5, 3))}, r"orientation: expected \(5, 4\)"),
        ({"gyro": np.full((5, 3), "x")}, r"gyro: expected \(5, 3\) numbers"),
    ],
)
def test_wrong_arrays_are_named(change, message):
    with pytest.raises(InputError, match=message):
        ImuBuffer(CONFIG, dataclasses.replace(part(moving(), slice(5)), **change))


# -- forgetting ------------------------------------------------------------------------------------

SHORT = 2.0  # seconds of memory in these tests, so that runs can be short too


@pytest.fixture
def short_memory(monkeypatch):
    monkeypatch.setattr("loam_gtsam.imu.buffer.MEMORY", SHORT)


def fed_live(samples):
    """Buffers as in a live run of frames of 0.1 s: with all samples so far, and with few."""
    whole, live = ImuBuffer(CONFIG), ImuBuffer(CONFIG)
    for begin in range(0, len(samples.stamps), 20):
        some = part(samples, slice(begin, begin + 20))
        frame = int(some.stamps[-1])
        whole.add(some)
        live.add(some)
        live.forget_old(frame)
        yield frame, whole, live


def stream(kind):
    """Thirty seconds of rest and motion, with a gap of 0.3 s."""
    samples = SimulatedWorld("shaken", frames=300).imu
    rows = np.arange(len(samples.stamps))
    samples = part(samples, (rows < 4000) | (rows > 4060))
    rows = np.arange(len(samples.stamps))[:, None]
    if kind == "placeholder found late":
        slow = np.where(rows < 3000, 0.1 / np.abs(samples.gyro).max(), 1.0)
        constant = np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 1))
        return dataclasses.replace(samples, orientation=constant, gyro=slow * samples.gyro)
    if kind == "no gravity":
        wrong = np.where(rows < 200, 2.0, 1.0) * samples.acceleration
        return dataclasses.replace(samples, orientation=None, acceleration=wrong)
    return samples if kind == "orientation" else dataclasses.replace(samples, orientation=None)


SOURCES = {
    "orientation": "ahrs",
    "no orientation": "gravity_filter",
    "placeholder found late": "gravity_filter",
    "no gravity": "none",
}


@pytest.mark.parametrize("kind", SOURCES)
def test_a_live_run_forgets_and_says_the_same_as_if_it_did_not(kind, short_memory):
    samples = stream(kind)
    held = []
    for frame, whole, live in fed_live(samples):
        first = max(frame - round(SHORT * 1e9), START)
        for stamp in (first, frame - 123_456_789, frame):
            pair = live.orientation(stamp), whole.orientation(stamp)
            assert pair[0] is pair[1] is None or pair[0].equals(pair[1], 0.0)
        between = live.rotation_between(first, frame), whole.rotation_between(first, frame)
        assert between[0] is between[1] is None or between[0].equals(between[1], 0.0)
        turned = (one.rotations_since(frame, np.linspace(-0.1, 0.0, 5)) for one in (live, whole))
        np.testing.assert_array_equal(*turned)
        assert (live.rest_at(frame) is None) is (whole.rest_at(frame) is None)
        held.append(len(live))
    assert max(held) < 200 * (SHORT + 2.0) + 512 + 20
    assert len(whole) == len(samples.stamps)
    reports = [dataclasses.replace(buffer.report, rate=0.0) for buffer in (live, whole)]
    assert reports[0] == reports[1]
    assert reports[0].orientation == SOURCES[kind]


def test_forgotten_samples_are_left_out_and_taken_again_after_the_clock_was_set_back(short_memory):
    samples = stream("no orientation")
    *_, (frame, _, live) = fed_live(samples)
    before, count = live.orientation(frame).matrix(), len(live)
    live.add(part(samples, slice(0, 50)))
    assert len(live) == count
    np.testing.assert_array_equal(live.orientation(frame).matrix(), before)
    assert "50 samples came too late: left out" in " ".join(live.report.problems)
    back = part(samples, slice(0, 600))
    back = dataclasses.replace(back, stamps=back.stamps - 3600 * 10**9)
    last = int(back.stamps[-1])
    live.forget_old(last)
    live.add(back)
    assert live.rotation_between(last - 10**8, last) is not None
    expected = ImuBuffer(CONFIG, back).orientation(last)
    assert live.orientation(last).equals(expected, 0.0)


def test_hours_of_samples_take_no_more_memory_than_one():
    """At 10 Hz, a minute at a time, with a gap, repeats and late ones; through the filter."""
    config = ImuConfig()
    buffer, rng, sizes = ImuBuffer(config), np.random.default_rng(0), []
    count, minute = 600, 60 * 10**9
    for number in range(4 * 60):
        stamps = number * minute + np.arange(count, dtype=np.int64) * 100_000_000
        stamps = np.concatenate([stamps[:300], stamps[310:], stamps[5:9], stamps[:3] - 2 * minute])
        gyro, noise = rng.normal(0.0, 0.1, (2, len(stamps), 3))
        buffer.add(ImuSamples(stamps, None, gyro, 5.66 + noise))
        newest = (number + 1) * minute
        assert (buffer.orientation(newest - 2 * 10**9) is None) is False
        buffer.forget_old(newest)
        if number % 60 == 59:
            frozen = freeze({"buffer": buffer}, {"config": config})
            sizes.append(sum(part.nbytes for part in frozen.values()))
    assert max(sizes[1:]) < 1.2 * sizes[0]
    assert buffer.report.samples > 4 * 60 * 500
