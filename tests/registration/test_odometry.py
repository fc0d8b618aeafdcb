"""The guess: constant velocity in closed form, scan to scan on exact and on simulated sweeps."""

import dataclasses
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from support.matches import difference

from loam_gtsam.config import Config, OdometryConfig
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.geometry import move_points
from loam_gtsam.imu.preintegration import InertialPrediction
from loam_gtsam.registration.odometry import (
    ConstantVelocity,
    Moment,
    ScanToScan,
    _RingSearch,
    advance,
    make_odometry,
    predict,
)
from loam_gtsam.types import Features, FrameStatus, MapUpdate

STAMP = 1_700_000_000_000_000_000
PERIOD = 100_000_000
START = gtsam.Pose3.Expmap(np.array([0.1, -0.2, 0.7, 12.0, -5.0, 1.0]))
TWIST = np.array([0.2, -0.3, 1.0, 8.0, -2.0, 0.5])


def update(pose=START, twist=TWIST, stamp=STAMP):
    return MapUpdate(stamp, pose, FrameStatus.OK, twist=twist)


def empty(stamp=STAMP + PERIOD, span=(0.0, 0.1)):
    none = np.empty((0, 3))
    return dataclasses.replace(Features.from_points(stamp, none, none), span=span)


def test_the_first_guess_is_the_identity_at_rest():
    guess = ConstantVelocity().guess(empty(), None)
    assert difference(guess.map_T_lidar, gtsam.Pose3()) == 0.0
    np.testing.assert_array_equal(guess.twist, np.zeros(6))


@pytest.mark.parametrize("frames", [1, 3])
def test_uniform_motion_is_predicted_exactly(frames):
    """Turning while moving is a screw; sweeps may be missing in between."""
    stamp = STAMP + frames * PERIOD
    guess = ConstantVelocity().guess(empty(stamp), update())
    step = gtsam.Pose3.Expmap(TWIST * 0.1)
    expected = START
    for _ in range(frames):
        expected = expected.compose(step)
    assert difference(guess.map_T_lidar, expected) < 1e-12
    np.testing.assert_array_equal(guess.twist, TWIST)


def test_advance_turns_and_moves():
    # A quarter circle of radius 2 to the left.
    moved = advance(gtsam.Pose3(), np.array([0, 0, np.pi / 2, np.pi, 0, 0]), 1.0)
    np.testing.assert_allclose(moved.translation(), [2, 2, 0], atol=1e-12)
    np.testing.assert_allclose(moved.rotation().matrix()[:, 0], [0, 1, 0], atol=1e-12)
    assert difference(advance(moved, TWIST, 0.0), moved) < 1e-15


def test_the_configuration_names_the_odometry():
    assert make_odometry(OdometryConfig()) is None  # the mapper predicts by itself
    assert isinstance(make_odometry(OdometryConfig(method="scan_to_scan")), ScanToScan)


class Gyro:
    """Turns evenly about an axis of the body; None beyond its last moment."""

    def __init__(self, rate, until=STAMP + 10 * PERIOD):
        self.rate, self.until = np.array(rate), until

    def rotation_between(self, first, second):
        if second > self.until:
            return None
        return gtsam.Rot3.Expmap(self.rate * (second - first) * 1e-9)


def test_a_gyro_turns_the_guess_and_the_velocity_stays_in_the_map():
    rate = np.array([0.5, -0.2, 2.0])
    guess = ConstantVelocity(Gyro(rate)).guess(empty(), update())
    turned = gtsam.Rot3.Expmap(0.1 * rate)
    assert guess.map_T_lidar.rotation().equals(START.rotation().compose(turned), 1e-12)
    moved = START.rotation().matrix() @ TWIST[3:] * 0.1
    np.testing.assert_allclose(guess.map_T_lidar.translation(), START.translation() + moved)
    np.testing.assert_allclose(turned.matrix() @ guess.twist[3:], TWIST[3:], atol=1e-12)
    np.testing.assert_array_equal(guess.twist[:3], TWIST[:3])


def test_without_the_gyro_of_that_moment_it_is_constant_velocity():
    gone = ConstantVelocity(Gyro([0.5, -0.2, 2.0], until=STAMP)).guess(empty(), update())
    plain = ConstantVelocity().guess(empty(), update())
    assert np.array_equal(gone.map_T_lidar.matrix(), plain.map_T_lidar.matrix())
    np.testing.assert_array_equal(gone.twist, plain.twist)


def test_scan_to_scan_starts_from_the_gyro():
    """While it has nothing to compare with, its guess is that of the gyro."""
    odometry = make_odometry(OdometryConfig(method="scan_to_scan"), Gyro([0.0, 0.0, 2.0]))
    expected = ConstantVelocity(Gyro([0.0, 0.0, 2.0])).guess(empty(), update())
    found = odometry.guess(empty(), update())
    assert np.array_equal(found.map_T_lidar.matrix(), expected.map_T_lidar.matrix())


# -- the prediction of the mapper ------------------------------------------------------------------

SECOND = STAMP + PERIOD
MIDDLE = Moment(STAMP + PERIOD // 2, advance(START, TWIST, 0.05), True)
OTHER = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([1.0, 2.0, 3.0]))


class Inertial(Gyro):
    """A gyro with an accelerometer that knows one pose."""

    known = InertialPrediction(
        OTHER, np.array([1.0, 0.0, 0.5]), np.diag(np.arange(1.0, 7.0)), np.zeros((3, 6)), np.eye(3)
    )

    def predict(self, stamp):
        return self.known if stamp <= self.until else None

    def bend(self, stamp, seconds, map_R_lidar):
        return None


def predicted(imu=None, guess=None, twist=None, last=MIDDLE):
    points = np.random.default_rng(0).uniform(-9.0, 9.0, (50, 3))
    features = Features.from_points(SECOND, points, points)
    sweep = MovingSweep(dataclasses.replace(features, span=(0.0, 0.1)), Config())
    found = predict(sweep, last and update(), last, imu, Config().solver, guess, twist)
    assert difference(found.map_T_middle, found.posed.map_T_middle(found.map_T_lidar)) < 1e-12
    return found


def test_without_an_imu_the_motion_goes_on_with_the_spread_of_an_acceleration():
    found, config = predicted(), Config().solver
    assert difference(found.map_T_lidar, advance(START, TWIST, 0.1)) < 1e-12
    np.testing.assert_array_equal(found.posed.twist, TWIST)
    assert difference(found.motion.map_T_lidar, advance(START, TWIST, 0.15)) < 1e-12
    sigmas = 0.5 * 0.1**2 * np.repeat([config.turn_sigma, config.acceleration_sigma], 3)
    np.testing.assert_allclose(found.motion.information, np.diag(sigmas**-2.0))
    first = predicted(last=None)
    assert difference(first.map_T_lidar, gtsam.Pose3()) == 0.0
    assert not first.motion.information.any()


@pytest.mark.parametrize("imu", [None, Inertial([0.0, 0.0, 2.0])])
def test_a_given_guess_and_twist_take_the_place_of_the_predicted_ones(imu):
    guess, twist = START.retract(np.full(6, 0.1)), 0.5 * TWIST
    found = predicted(imu, guess, twist)
    assert difference(found.map_T_lidar, guess) < 1e-12
    np.testing.assert_array_equal(found.posed.twist, twist)
    # What the IMU expects does not depend on the guess.
    expected = found.map_T_middle if imu is None else OTHER
    assert difference(found.motion.map_T_lidar, expected) < 1e-12


def test_with_an_accelerometer_the_pose_of_the_middle_is_the_predicted_one():
    found = predicted(Inertial([0.0, 0.0, 2.0]))
    assert difference(found.map_T_middle, OTHER) < 1e-12
    np.testing.assert_allclose(found.motion.information, np.diag(1.0 / np.arange(1.0, 7.0)))
    velocity = OTHER.rotation().matrix() @ found.posed.twist[3:]
    np.testing.assert_allclose(velocity, [1.0, 0.0, 0.5], atol=1e-12)
    # Where the accelerometer fails, the gyro alone predicts.
    failed = predicted(Inertial([0.0, 0.0, 2.0], until=STAMP))
    assert difference(failed.map_T_lidar, advance(START, TWIST, 0.1)) < 1e-12


def room(rng, count=9000):
    """Points on the walls, floor and ceiling of a box and on its vertical corners."""
    size = np.array([9.0, 7.0, 3.0])
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = rng.uniform(-1, 1, (count // 6, 3)) * (size - 1.2)
            face[:, axis] = side * size[axis]
            faces.append(face)
    corners = [
        np.column_stack([np.full(400, x), np.full(400, y), rng.uniform(-2.5, 2.5, 400)])
        for x in (-9.0, 9.0)
        for y in (-7.0, 7.0)
    ]
    return np.concatenate(corners), np.concatenate(faces)


def rings_of(points):
    elevation = np.arctan2(points[:, 2], np.linalg.norm(points[:, :2], axis=1))
    return np.round(np.degrees(elevation)).astype(np.int64)


def sweep_of(rng, stamp, twist, span, count, travelled=0.0):
    """Features of a sensor that moves on from the room's middle, where it was at ``span[0]``.

    Or has ``travelled`` for so many seconds by then.
    """
    edges, planes = room(rng, count)
    times = [rng.uniform(*span, len(points)) for points in (edges, planes)]
    # Into the lidar frame at each point's own time.
    own = [
        move_points(points, -twist, t - span[0] + travelled)
        for points, t in zip((edges, planes), times, strict=True)
    ]
    chosen = [rng.permutation(len(points))[:n] for points, n in zip(own, (150, 300), strict=True)]
    return Features(stamp, *own, *times, *map(rings_of, own), *chosen, span)


MOTIONS = [
    np.array([0.0, 0.0, 0.0, 1.5, 0.0, 0.0]),
    np.array([0.0, 0.0, 0.3, 0.0, -1.0, 0.0]),
    np.array([0.1, -0.15, 0.2, 1.0, -0.5, 0.4]),
]


@pytest.mark.parametrize("span", [(0.0, 0.1), (-0.05, 0.05), (-0.1, 0.0)])
@pytest.mark.parametrize("twist", MOTIONS)
def test_a_sudden_motion_is_found_from_exact_points(twist, span):
    """At rest during the sweep before, in motion in the new one: the velocity was not constant."""
    rng = np.random.default_rng(0)
    odometry = ScanToScan(OdometryConfig())
    odometry.remember(sweep_of(rng, STAMP, np.zeros(6), span, 24_000))
    new = sweep_of(rng, STAMP + PERIOD, twist, span, 3000)
    guess = odometry.guess(new, update(twist=np.zeros(6)))
    np.testing.assert_allclose(guess.twist, twist, atol=1e-3)
    # The sensor left START when the new sweep began; the guess is for the time of its stamp.
    assert difference(guess.map_T_lidar, advance(START, twist, -span[0])) < 1e-4


@pytest.mark.parametrize("span", [(0.0, 0.1), (-0.05, 0.05), (-0.1, 0.0)])
def test_uniform_motion_stays_what_it_is(span):
    """The sweep before is de-skewed and brought to where the new one begins."""
    rng = np.random.default_rng(2)
    twist, odometry = MOTIONS[2], ScanToScan(OdometryConfig())
    odometry.remember(sweep_of(rng, STAMP, twist, span, 24_000))
    new = sweep_of(rng, STAMP + PERIOD, twist, span, 3000, travelled=0.1)
    guess = odometry.guess(new, update(twist=twist))
    np.testing.assert_allclose(guess.twist, twist, atol=1e-6)
    assert difference(guess.map_T_lidar, advance(START, twist, 0.1)) < 1e-6


@pytest.mark.parametrize("first", [30, 40])
def test_a_simulated_sweep_is_nearer_than_constant_velocity(first):
    """Real features with 2 cm noise; here the turn rate changes by 0.1 rad/s within a sweep.

    Measured errors over the sweep: 1.4 and 1.6 mrad (constant velocity 11.1 and 10.5), 7.4 and
    3.0 mm.
    """
    world = SimulatedWorld("room", sensor="hdl64", frames=first + 2, columns=900)
    sweeps = [extract_features(world.sweep(i), Config()) for i in (first, first + 1)]
    stamps = np.array([sweeps[0].stamp, sweeps[1].stamp, sweeps[1].stamp + PERIOD])
    poses = [gtsam.Pose3(pose) for pose in world.truth_at(stamps).map_T_lidar]
    before, truth = (gtsam.Pose3.Logmap(a.between(b)) / 0.1 for a, b in pairwise(poses))
    odometry, last = ScanToScan(OdometryConfig()), update(poses[0], before, sweeps[0].stamp)
    odometry.remember(sweeps[0])
    guess = odometry.guess(sweeps[1], last)

    def over_the_sweep(twist):
        error = 0.1 * (twist - truth)
        return np.linalg.norm(error[:3]), np.linalg.norm(error[3:])

    assert over_the_sweep(before)[0] > 0.010
    rotation, translation = over_the_sweep(guess.twist)
    assert rotation < 0.004
    assert translation < 0.015


def test_falls_back_to_constant_velocity():
    rng = np.random.default_rng(1)
    full = sweep_of(rng, STAMP, TWIST * 0, (0.0, 0.1), 6000)
    new = dataclasses.replace(full, stamp=STAMP + PERIOD)
    expected = ConstantVelocity().guess(new, update())

    def guess(previous, features, last):
        odometry = ScanToScan(OdometryConfig())
        if previous is not None:
            odometry.remember(previous)
        return odometry.guess(features, last)

    def is_expected(found):
        same = difference(found.map_T_lidar, expected.map_T_lidar) < 1e-12
        return same and np.array_equal(found.twist, TWIST)

    assert not is_expected(guess(full, new, update()))
    for previous, features in (
        (None, new),
        (empty(STAMP), new),
        (full, empty()),
        (full, dataclasses.replace(new, span=(0.0, 0.0))),
        (full, dataclasses.replace(new, sharp=new.sharp[:4], flat=new.flat[:5])),
    ):
        assert is_expected(guess(previous, features, update()))
    start = guess(full, new, None)
    assert difference(start.map_T_lidar, gtsam.Pose3()) == 0.0
    np.testing.assert_array_equal(start.twist, np.zeros(6))


def ring_points(seed=3):
    rng = np.random.default_rng(seed)
    return rng.uniform(-3, 3, (300, 3)), rng.integers(0, 12, 300), rng.uniform(-3, 3, (80, 3))


def nearest_of(points, allowed, query, limit):
    """Index of the nearest allowed point within ``limit``, -1 if none."""
    distance = np.where(allowed, np.linalg.norm(points - query, axis=1), np.inf)
    return int(distance.argmin()) if distance.min() < limit else -1


@pytest.mark.parametrize("limit", [0.4, 1.0, 20.0])
@pytest.mark.parametrize("gap", [1, 2])
def test_lines_and_planes_equal_brute_force(limit, gap):
    points, rings, queries = ring_points()
    search = _RingSearch(points, rings)
    lines, planes = {}, {}
    for i, query in enumerate(queries):
        first = nearest_of(points, rings >= 0, query, limit)
        if first < 0:
            continue
        step = np.abs(rings - rings[first])
        other = nearest_of(points, (step > 0) & (step <= gap), query, limit)
        mine = (step == 0) & (np.arange(300) != first)
        same = nearest_of(points, mine, query, limit)
        if other >= 0:
            lines[i] = points[first], points[other]
        if other >= 0 and same >= 0:
            planes[i] = points[first], points[same], points[other]
    assert lines
    assert planes

    index, centres, directions = search.lines(queries, limit, gap)
    np.testing.assert_array_equal(index, list(lines))
    np.testing.assert_array_equal(centres, [a for a, _ in lines.values()])
    expected = np.array([(b - a) / np.linalg.norm(b - a) for a, b in lines.values()])
    np.testing.assert_allclose(directions, expected, atol=1e-12)

    index, normals, offsets = search.planes(queries, limit, gap)
    np.testing.assert_array_equal(index, list(planes))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    for corner in range(3):
        corners = np.array([triangle[corner] for triangle in planes.values()])
        off = np.einsum("ij,ij->i", normals, corners) + offsets
        np.testing.assert_allclose(off, 0.0, atol=1e-12)


def test_points_that_span_no_line_or_plane_are_left_out():
    query = np.zeros((1, 3))
    twice = np.array([[0.1, 0, 0], [0.1, 0, 0], [0.2, 0.1, 0]])
    assert len(_RingSearch(twice, np.array([3, 4, 3])).lines(query, 1.0, 2)[0]) == 0
    assert len(_RingSearch(twice, np.array([3, 3, 4])).lines(query, 1.0, 2)[0]) == 1
    straight = np.array([[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]])
    rings = np.array([3, 3, 4])
    assert len(_RingSearch(straight, rings).planes(query, 1.0, 2)[0]) == 0
    straight[2, 1] = 0.1
    assert len(_RingSearch(straight, rings).planes(query, 1.0, 2)[0]) == 1


def test_no_points_or_queries_give_no_matches():
    points, rings, queries = ring_points()
    for search, asked in ((_RingSearch(points[:0], rings[:0]), queries),
                          (_RingSearch(points, rings), queries[:0])):  # fmt: skip
        index, centres, directions = search.lines(asked, 1.0, 2)
        assert (len(index), centres.shape, directions.shape) == (0, (0, 3), (0, 3))
        index, normals, offsets = search.planes(asked, 1.0, 2)
        assert (len(index), normals.shape, offsets.shape) == (0, (0, 3), (0,))
