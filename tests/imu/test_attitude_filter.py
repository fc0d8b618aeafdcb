"""Orientation from gyro and accelerometer, against the simulated world."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.imu import CONFIG, START, moving, ns, part, resting, rot

from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.imu.buffer import ImuBuffer


def tilt_errors(world, config=CONFIG, samples=None):
    """Degrees between up by the filter and true up, and the buffer."""
    samples = dataclasses.replace(world.imu if samples is None else samples, orientation=None)
    buffer = ImuBuffer(config, samples)
    window = buffer.samples_between(int(samples.stamps[0]), int(samples.stamps[-1]))
    up = Rotation.from_quat(window.orientation).as_matrix()[:, 2]
    true_up = (world.world_T_start @ world.truth_at(samples.stamps).map_T_lidar)[:, 2, :3]
    return np.rad2deg(np.arccos(np.clip((up * true_up).sum(axis=1), -1.0, 1.0))), buffer


@pytest.mark.parametrize(
    ("scene", "begins", "degrees"),
    [("room", 0, 0.6), ("shaken", 0, 0.8), ("slopes", 0, 2.0), ("shaken", 1000, 1.5)],
)
def test_gravity_filter_finds_up(scene, begins, degrees):
    """About one and a half times what was measured: docs/maths/imu_buffer.md."""
    world = SimulatedWorld(scene, **({"frames": 300} if begins else {}))
    errors, buffer = tilt_errors(world, samples=part(world.imu, slice(begins, None)))
    assert np.sqrt(np.mean(errors**2)) < degrees
    assert buffer.report.orientation == "gravity_filter"
    assert ("no rest at the start" in "".join(buffer.report.problems)) is bool(begins)


def test_gravity_filter_beats_both_of_its_halves():
    world = SimulatedWorld("shaken", frames=900)
    errors, _ = tilt_errors(world)
    only_gyro, _ = tilt_errors(world, CONFIG.changed(filter_seconds=1e9))
    only_acceleration, _ = tilt_errors(world, CONFIG.changed(filter_seconds=0.1))
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
            said = "".join(buffer.report.problems)  # nothing of an accelerometer that is not there
            assert ("is not near 9.81 m/s^2" in said) is (factor > 0.0)
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
