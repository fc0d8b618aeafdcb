"""A wrong velocity stays wrong along what no scan sees: its covariance, and that of the drift."""

from itertools import combinations

import gtsam
import numpy as np
import pytest
from support.list_dataset import ListDataset

from loam_gtsam.config import Config, SolverConfig
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.io.rollback import Before
from loam_gtsam.pipeline import run
from loam_gtsam.registration.solvers import MotionFilter
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.types import FrameStatus

FRAME = 100_000_000
SECONDS = 0.1
CONFIG = SolverConfig()
X = np.eye(6)[3]


def solved(blind, sigma=0.01):
    """A pose that the scan fixes to ``sigma``, but for x if ``blind``."""
    share = blind * np.outer(X, X)
    return share, sigma**2 * (np.eye(6) - share)


def moved(metres):
    return gtsam.Pose3(gtsam.Rot3(), np.array([metres, 0.0, 0.0]))


def after(pattern, **changes):
    """The motion after so many frames, and the steps; ``pattern`` says which are blind."""
    motion, steps = MotionFilter(CONFIG.changed(**changes)), []
    motion.begin(0)
    for number, blind in enumerate(pattern, 1):
        share, raw = solved(blind)
        step = motion.observe(number * FRAME, moved(0), moved(0), share, raw, turned=False)
        steps.append(step)
    return motion, steps


def follow(ways, sigma, blind=0):
    """(N,) expected ways of N noisy ones, metres a frame along x; ``blind`` of them at the end."""
    motion, expected = MotionFilter(CONFIG), []
    motion.begin(0)
    for number, way in enumerate(ways, 1):
        share, raw = solved(number > len(ways) - blind, sigma / 2.0)  # half, as raw ones are
        expected.append(motion.expected(number * FRAME, moved(0)).x())
        found = moved(expected[-1] if share.any() else way)
        motion.observe(number * FRAME, moved(0), found, share, raw, turned=False)
    return np.array(expected)


def test_a_velocity_that_scans_tell_well_is_followed_at_once():
    ways = np.repeat([0.0, 1.0, 2.0], 5)
    np.testing.assert_allclose(follow(ways, 1e-3)[[1, 6, 11]], [0.0, 1.0, 2.0], atol=0.01)


def test_along_what_scans_hardly_fix_the_velocity_is_that_of_many_poses():
    """Poses known to 0.1 m: the difference of two would be wrong by 0.14 m a frame."""
    rng = np.random.default_rng(0)
    noisy = [0.5 + np.diff(rng.normal(0.0, 0.1, 101)) for _ in range(20)]
    errors = np.array([follow(ways, 0.1)[50:] - 0.5 for ways in noisy])
    assert np.sqrt(np.mean(errors**2)) < 0.05


def test_what_no_scan_sees_goes_on_as_it_was():
    ways = np.repeat([0.5, 3.0], [10, 30])
    np.testing.assert_allclose(follow(ways, 1e-3, blind=30)[10:], 0.5, atol=0.01)


def test_a_velocity_that_an_imu_told_can_be_taken_back():
    motion, _ = after([False] * 3)
    before = Before(motion)
    motion.told(np.array([4.0, 0.0, 0.0]))
    before.restore()
    assert motion.expected(4 * FRAME, moved(0)).x() == 0.0


def test_a_velocity_that_an_imu_told_goes_on_and_is_as_badly_known_as_without():
    motion, alone = after([True] * 5)[0], after([True] * 5)[0]
    motion.told(np.array([4.0, 0.0, 0.0]))
    assert motion.expected(6 * FRAME, moved(0)).x() == pytest.approx(4.0 * SECONDS)
    assert alone.expected(6 * FRAME, moved(0)).x() == pytest.approx(0.0)
    np.testing.assert_array_equal(motion.covariance, alone.covariance)


def test_a_step_back_after_a_blind_way_is_no_velocity_but_tells_one():
    """Slower by 0.05 m a frame for ten blind ones: the next scan finds the pose 0.5 m back."""
    motion, sigma = MotionFilter(CONFIG), 1e-3
    motion.begin(0)
    for number in range(1, 22):
        share, raw = solved(10 < number < 21, sigma)
        way = 0.5 if number < 21 else 0.45 - 0.5
        found = moved(motion.expected(number * FRAME, moved(0)).x() if share.any() else way)
        before = motion.covariance[3, 3]
        motion.observe(number * FRAME, moved(0), found, share, raw, turned=False)
    assert 0.3 < motion.expected(22 * FRAME, moved(0)).x() < 0.48
    # The scan may have seen what was mapped on the way: then it tells little of the velocity.
    assert motion.covariance[3, 3] > 0.5 * before


def test_a_share_that_a_users_factor_has_a_say_in_tells_the_velocity():
    """Positions of a receiver, known to 0.02 m, beside an expected pose of 0.01 m."""
    motion, share, raw = MotionFilter(CONFIG), 0.8 * np.outer(X, X), 0.08**2 / 4.0 * np.eye(6)
    motion.begin(0)
    at = found = 0.0
    for number in range(1, 60):
        at += 0.5
        expected = found + motion.expected(number * FRAME, moved(0)).x()
        before, found = found, 0.8 * expected + 0.2 * at
        motion.observe(number * FRAME, moved(0), moved(found - before), share, raw, turned=False)
    assert found == pytest.approx(at, abs=0.02)


def test_a_way_that_is_not_known_says_nothing_of_the_velocity():
    motion, (share, raw) = MotionFilter(CONFIG), solved(False)
    motion.begin(0)
    for number in range(1, 6):
        motion.observe(number * FRAME, moved(0), moved(0.5), share, raw, turned=False)
    before = motion.covariance
    motion.observe(6 * FRAME, None, moved(7.0), share, raw, turned=False)
    assert motion.expected(7 * FRAME, moved(0)).x() == pytest.approx(0.5, abs=0.01)
    assert (np.diag(motion.covariance) > np.diag(before)).all()


def test_with_a_gyro_the_velocity_stays_in_the_map_and_the_scan_has_no_say_in_the_turn():
    motion, (share, raw) = MotionFilter(CONFIG), solved(False, 1e-4)
    motion.begin(0)
    turn, last = gtsam.Rot3.Yaw(0.3), moved(0)
    for number in range(1, 6):  # straight ahead along x of the map, turning on the way
        now = gtsam.Pose3(last.rotation() * turn, last.translation() + 0.5 * X[3:])
        motion.observe(number * FRAME, last, now, share, raw, turned=True)
        last = now
    expected = motion.expected(6 * FRAME, last, turn)
    np.testing.assert_allclose(expected.translation(), [3.0, 0.0, 0.0], atol=0.01)
    assert expected.rotation().equals(last.rotation() * turn, 1e-12)
    straight = motion.expected(6 * FRAME, last)
    assert straight.rotation().equals(last.rotation(), 1e-12)


def test_the_told_velocity_is_as_wrong_as_sampled_ones():
    """Monte Carlo: accelerations of 2 m/s^2 that last, poses known to 0.1 m."""
    rng, errors, stays = np.random.default_rng(1), [], np.exp(-SECONDS / 2.0)
    for _ in range(300):
        speed, acceleration = rng.normal(0.0, 10.0), rng.normal(0.0, 2.0)
        motion, at, noise = MotionFilter(CONFIG), 0.0, 0.0
        motion.begin(0)
        for number in range(1, 31):
            speed += SECONDS * acceleration
            at += SECONDS * speed
            acceleration = stays * acceleration + rng.normal(0.0, 2.0 * np.sqrt(1.0 - stays**2))
            before, noise = noise, rng.normal(0.0, 0.1)
            share, raw = solved(False, 0.05)
            way = moved(SECONDS * speed + noise - before)
            motion.observe(number * FRAME, moved(0), way, share, raw, turned=False)
        errors.append(motion.expected(31 * FRAME, moved(0)).x() / SECONDS - speed)
    assert np.std(errors) == pytest.approx(motion.covariance[3, 3] ** 0.5, rel=0.15)


def test_a_velocity_that_was_never_seen_is_that_of_the_start():
    velocity, start = after([True] * 3)[0].covariance, CONFIG.start_speed**2
    assert start < velocity[3, 3] < start + (3.0 * CONFIG.acceleration_sigma * SECONDS) ** 2


@pytest.mark.parametrize("blind", [True, False])
def test_along_what_nothing_sees_the_errors_of_steps_add_up(blind):
    """Blind for 50 frames, the standard deviation grows with the time; seen, there is no step."""
    changes = {"acceleration_sigma": 1e-6}
    motion, steps = after([False] * 5 + [blind] * 50, **changes)
    before = after([False] * 5, **changes)[0].covariance[3, 3]
    total, kept = np.zeros((6, 9)), np.eye(9)
    for step in steps[5:]:
        total, kept = (total + step.by_velocity) @ step.kept.T, step.kept @ kept
    assert np.sqrt(total[3] @ total[3]) == pytest.approx(blind * 5.0 * before**0.5, rel=1e-3)
    if blind:
        assert kept[3, 3] == pytest.approx(1.0, abs=1e-3)
        assert motion.covariance[3, 3] == pytest.approx(before, rel=1e-3)
    else:
        assert motion.covariance[3, 3] < 0.5 * before


def test_steps_are_as_large_as_those_of_a_sampled_velocity():
    """Monte Carlo: a velocity known to 0.3 m/s at first, accelerations of 2 m/s^2, 40 blind.

    An acceleration lasts for two seconds, as that of a vehicle that starts does.
    """
    rng = np.random.default_rng(0)
    speed = rng.normal(0.0, after([False] * 5)[0].covariance[3, 3] ** 0.5, 20_000)
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
        motion = MotionFilter(CONFIG.changed(**{n: 10 ** rng.uniform(-6, 4) for n in names}))
        motion.begin(0)
        for number in range(1, 4):
            axes, _ = np.linalg.qr(rng.normal(size=(6, 6)))
            share = axes @ np.diag(rng.choice([0.0, 1.0, 0.5], 6)) @ axes.T
            raw = 10 ** rng.uniform(-14, -4) * np.eye(6)
            turned = bool(rng.integers(2))
            motion.observe(number * FRAME, moved(0), moved(1), share, raw, turned=turned)
            assert np.isfinite(motion.covariance).all()


@pytest.mark.parametrize(("seed", "reached"), [(3, True), (5, False)])
def test_no_velocity_is_ever_less_known_than_anything_that_moves(seed, reached):
    """What is blind swings with the yaw: the covariance grew to kilometres a second."""
    rng, motion = np.random.default_rng(seed), MotionFilter(CONFIG)
    motion.begin(0)
    most = 5.0 * np.repeat([CONFIG.start_turn, CONFIG.start_speed], 3)
    largest = []
    for number in range(1, 40):
        turn = rng.uniform(0.0, 2.0 * np.pi)
        along = np.array([0.0, 0.0, 0.0, np.cos(turn), np.sin(turn), 0.0])
        across = along + rng.normal(size=6) * [0.0, 0.0, 0.3, 1.0, 1.0, 0.0]
        share = np.outer(along, across) / (across @ along)
        raw = np.diag(np.repeat([1e-6, 1e-4], 3))
        motion.observe(number * FRAME, moved(0), moved(0), share, raw, turned=False)
        values = np.linalg.eigvalsh(motion.covariance / np.outer(most, most))
        assert values[0] > 0.0
        largest.append(values[-1])
    assert max(largest) <= 1.0 + 1e-9
    assert (max(largest) > 0.999) == reached
