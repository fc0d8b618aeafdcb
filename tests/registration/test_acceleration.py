"""The next acceleration, expected from the poses so far: where it lasts, and where it is noise."""

import gtsam
import numpy as np
import pytest

from loam_gtsam.registration.acceleration import Accelerations

PERIOD = 0.1
UNKNOWN = np.full(6, 9.0)
STEPS = 60


def of_path(path, sigma=0.0, seed=0):
    """What is known after a drive; ``path(seconds)`` are (6,) tangent vectors of its poses."""
    rng = np.random.default_rng(seed)
    known, last = Accelerations(10, UNKNOWN), None
    for step in range(STEPS):
        pose = gtsam.Pose3.Expmap(path(step * PERIOD) + sigma * rng.standard_normal(6))
        now = round(step * PERIOD * 1e9), pose
        if last is not None:
            known.add(*last, *now, sigma**2 * np.eye(6))
        last = now
    return known, last


def along(axis, positions):
    return lambda seconds: positions(seconds) * np.eye(6)[axis]


@pytest.mark.parametrize("axis", range(6))
def test_a_constant_acceleration_is_expected_to_go_on(axis):
    known, (stamp, _) = of_path(along(axis, lambda t: 0.05 * t**2))
    mean = known.next.velocity + 0.1 * PERIOD * np.eye(6)[axis]
    expected = known.next.at(stamp, PERIOD, mean)
    np.testing.assert_allclose(expected, 0.1 * np.eye(6)[axis], atol=2e-3)
    assert known.next.variances[axis] < 0.1 * known.variances[axis]
    # None of it if another sweep was the last one, and not all of it if the pose has jumped.
    np.testing.assert_array_equal(known.next.at(stamp - 1, PERIOD, mean), np.zeros(6))
    far = known.next.velocity + 4.0 * PERIOD * np.eye(6)[axis]
    expected = known.next.at(stamp, PERIOD, far)
    np.testing.assert_allclose(expected, 0.3 * np.eye(6)[axis], atol=6e-3)


def test_a_sway_is_expected_to_go_on_in_part():
    known, _ = of_path(along(3, lambda t: 0.02 * np.sin(2.0 * np.pi * t)))
    assert 0.7 < known.next.share[3] < 1.0
    assert known.next.variances[3] < 0.5 * known.variances[3]


@pytest.mark.parametrize("hertz", [1.0, 1.5, 2.5, 3.5])
def test_accelerations_of_a_fast_sway_are_larger_than_second_differences(hertz):
    """Its poses are taken ten times a second."""
    rate, drive = 2.0 * np.pi * hertz, along(3, lambda t: 0.02 * np.sin(2.0 * np.pi * hertz * t))
    known = of_path(drive)[0]
    assert known.missed(steady=True)[3] == pytest.approx((0.02 * rate**2) ** 2 / 2.0, rel=0.35)
    assert known.jerks()[3] == pytest.approx((0.02 * rate**3) ** 2 / 2.0, rel=0.5)
    shown = (np.sin(0.05 * rate) / (0.05 * rate)) ** 4
    assert known.variances[3] / known.missed(steady=True)[3] == pytest.approx(shown, rel=0.2)


def test_what_sweeps_far_apart_may_hide_stands_for_what_a_fast_sway_hides():
    known, _ = of_path(along(3, lambda t: 0.02 * np.sin(2.0 * np.pi * 3.5 * t)))
    hidden = known.missed(steady=True, faster=25.0)
    np.testing.assert_allclose(hidden, 25.0**2 * known.variances)
    larger = known.missed(steady=True)[3] / known.variances[3]
    assert known.jerks(25.0)[3] == pytest.approx(25.0**3 / larger**1.5 * known.jerks()[3])


def test_a_jerk_that_has_just_begun_counts_in_full():
    begins = (STEPS - 2) * PERIOD
    known, _ = of_path(along(3, lambda t: 1.5 * max(t - begins, 0.0) ** 2))
    assert known.jerks()[3] == pytest.approx((1.5 / PERIOD) ** 2)
    assert known.jerks(4.0)[3] == pytest.approx(4.0**3 * (1.5 / PERIOD) ** 2)


@pytest.mark.parametrize("seed", range(5))
def test_of_noise_nothing_is_expected(seed):
    known, _ = of_path(lambda _: np.zeros(6), sigma=0.01, seed=seed)
    np.testing.assert_array_equal(known.next.share, np.zeros(6))


def test_nothing_is_expected_before_three_accelerations_are_known():
    known, last = Accelerations(10, UNKNOWN), (0, gtsam.Pose3())
    for step in range(1, 6):
        assert (known.next is None) == (step < 5)
        now = round(step * 1e8), gtsam.Pose3.Expmap(0.1 * step**2 * np.eye(6)[3])
        known.add(*last, *now, np.zeros((6, 6)))
        last = now
    assert known.next is not None


def test_what_a_sweep_missed_is_less_where_an_acceleration_was_expected():
    known, _ = of_path(along(4, lambda t: 0.02 * np.sin(2.0 * np.pi * t)))
    steady, expected = known.missed(steady=True)[4], known.missed(steady=False)[4]
    assert 0.0 < expected < 0.5 * steady


def test_a_motion_that_has_just_begun_counts_alone():
    stop = STEPS * PERIOD - 1.5 * PERIOD
    known, _ = of_path(along(3, lambda t: 2.0 * max(t - stop, 0.0)))
    for steady in (True, False):
        assert known.missed(steady=steady)[3] > 5.0 * known.variances[3]
