"""A wrong velocity stays wrong along what no scan sees: its covariance, and that of the drift."""

from itertools import combinations

import gtsam
import numpy as np
import pytest
from support.list_dataset import ListDataset

from loam_gtsam.config import Config, SolverConfig
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import run
from loam_gtsam.registration.pose_errors import relative_covariance
from loam_gtsam.registration.solvers import MotionError
from loam_gtsam.types import FrameStatus

FRAME = 100_000_000
SECONDS = 0.1
CONFIG = SolverConfig()
X = np.eye(6)[3]


def solved(blind, sigma=0.01):
    """A pose that the scan fixes to ``sigma``, but for x if ``blind``."""
    share = blind * np.outer(X, X)
    return share, sigma**2 * (np.eye(6) - share)


def after(pattern, **changes):
    """The motion's error after so many frames, and the steps; ``pattern`` says which are blind."""
    error, steps = MotionError(CONFIG.changed(**changes)), []
    error.coast(0, turned=False)
    for number, blind in enumerate(pattern, 1):
        steps.append(error.observe(number * FRAME, *solved(blind), turned=False))
    return error, steps


def test_a_seen_velocity_is_the_difference_of_two_poses():
    velocity = after([False] * 5)[0].velocity
    expected = 2.0 * 4.0 * (0.01 / SECONDS) ** 2  # of two poses, each with four times its raw one
    np.testing.assert_allclose(velocity, expected * np.eye(6), rtol=1e-6)


def test_a_velocity_that_was_never_seen_is_that_of_the_start():
    velocity, start = after([True] * 3)[0].velocity, CONFIG.start_speed**2
    assert start < velocity[3, 3] < start + (3.0 * CONFIG.acceleration_sigma * SECONDS) ** 2


@pytest.mark.parametrize("blind", [True, False])
def test_along_what_nothing_sees_the_errors_of_steps_add_up(blind):
    """Blind for 50 frames, the standard deviation grows with the time; seen, there is no step."""
    changes = {"acceleration_sigma": 1e-6}
    error, steps = after([False] * 5 + [blind] * 50, **changes)
    before = after([False] * 5, **changes)[0].velocity[3, 3]
    total, kept = np.zeros((6, 9)), np.eye(9)
    for step in steps[5:]:
        total, kept = (total + step.by_velocity) @ step.kept.T, step.kept @ kept
    assert np.sqrt(total[3] @ total[3]) == pytest.approx(blind * 5.0 * before**0.5, rel=1e-3)
    assert kept[3, 3] == pytest.approx(float(blind), abs=1e-3)
    assert error.velocity[3, 3] == pytest.approx(before, rel=1e-3)


def test_steps_are_as_large_as_those_of_a_sampled_velocity():
    """Monte Carlo: a velocity known to 0.3 m/s at first, accelerations of 2 m/s^2, 40 blind.

    An acceleration lasts for two seconds, as that of a vehicle that starts does.
    """
    rng = np.random.default_rng(0)
    speed = rng.normal(0.0, after([False] * 5)[0].velocity[3, 3] ** 0.5, 20_000)
    way, sigma, stays = np.zeros(20_000), CONFIG.acceleration_sigma, np.exp(-SECONDS / 2.0)
    acceleration = rng.normal(0.0, sigma, len(way))
    for _ in range(40):
        speed = speed + SECONDS * acceleration
        way = way + SECONDS * speed
        new = rng.normal(0.0, sigma * np.sqrt(1.0 - stays**2), len(way))
        acceleration = stays * acceleration + new
    _, steps = after([False] * 5 + [True] * 40)
    total, rest = np.zeros((6, 9)), np.zeros((6, 6))
    for step in steps[5:]:
        moved = total + step.by_velocity
        rest += step.by_chance + moved @ (np.eye(9) - step.kept.T @ step.kept) @ moved.T
        total = moved @ step.kept.T
    told = (total @ total.T + rest)[3, 3] ** 0.5
    assert told == pytest.approx(way.std(), rel=0.1)


def test_a_gyro_knows_the_turn_and_a_pose_that_was_not_solved_adds_to_the_spread():
    error, _ = after([False] * 5)
    by_scan, by_gyro = (error.of_expected(6 * FRAME, turned=turned) for turned in (False, True))
    assert by_gyro[0, 0] < by_scan[0, 0]
    assert by_gyro[3, 3] == by_scan[3, 3]
    error.coast(6 * FRAME, turned=False)
    assert error.of_expected(7 * FRAME, turned=False)[3, 3] > 3.0 * by_scan[3, 3]
    error.observe(7 * FRAME, *solved(False), turned=False)
    once = error.velocity[3, 3]  # the last pose was an expected one
    error.observe(8 * FRAME, *solved(False), turned=False)
    assert error.velocity[3, 3] < 0.5 * once


@pytest.fixture(scope="module")
def blind_field():
    """Open ground from a start in motion: x, y and yaw show in no beam."""
    world = SimulatedWorld("open_field", frames=25, columns=450)
    dataset = ListDataset([world[i] for i in range(25)])
    dataset.sensor = world.sensor
    updates = run(dataset, Config().changed("imu.coupling=off")).updates
    return updates, [gtsam.Pose3(pose) for pose in world.truth.map_T_lidar]


def test_a_lost_speed_is_told(blind_field):
    updates, truth = blind_field
    for k in range(2, len(updates)):
        assert updates[k].status is FrameStatus.DEGENERATE
        moved = updates[0].map_T_lidar.between(updates[k].map_T_lidar)
        error = moved.localCoordinates(truth[0].between(truth[k]))
        told = np.sqrt(np.diag(updates[k].covariance))
        assert np.abs(error[3:5]).max() < 2.0 * told[3:5].max()
    assert np.linalg.norm(error[3:5]) > 3.0  # it stood at first, and drove off unseen
    assert told[5] < 0.1 * told[3]


def test_covariances_between_all_pairs_are_positive_definite(blind_field):
    updates, _ = blind_field
    for one, two in combinations(updates[1:], 2):
        covariance = relative_covariance(one, two)
        np.testing.assert_array_equal(covariance, covariance.T)
        values = np.linalg.eigvalsh(covariance)
        assert values[0] > 1e-12 * values[-1]
    for update in updates[1:]:
        assert np.linalg.eigvalsh(update.covariance)[0] > 0.0


def test_between_frames_only_the_way_between_counts(blind_field):
    """The velocity is the same all the time: five frames drift by a fifth of what 25 do."""
    updates, _ = blind_field
    spread = [
        relative_covariance(updates[i], updates[k])[3, 3] ** 0.5 for i, k in ((1, 24), (19, 24))
    ]
    assert spread[1] == pytest.approx(spread[0] * 5 / 23, rel=0.3)


def test_velocities_known_to_micrometres_beside_kilometres_stay_one_covariance():
    """Starts at the bounds of the configuration, and a share of a pose along odd axes."""
    for seed in range(300):
        rng = np.random.default_rng(seed)
        names = ("start_speed", "start_turn", "acceleration_sigma", "turn_sigma")
        error = MotionError(CONFIG.changed(**{n: 10 ** rng.uniform(-6, 4) for n in names}))
        error.coast(0, turned=False)
        for number in range(1, 4):
            axes, _ = np.linalg.qr(rng.normal(size=(6, 6)))
            share = axes @ np.diag(rng.choice([0.0, 1.0, 0.5], 6)) @ axes.T
            raw = 10 ** rng.uniform(-14, -4) * np.eye(6)
            error.observe(number * FRAME, share, raw, turned=bool(rng.integers(2)))
            assert np.isfinite(error.velocity).all()
