"""Which directions a scan fixes: closed-form scenes, false information, and what takes over."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from loam_gtsam.config import SolverConfig
from loam_gtsam.degeneracy import localizability
from loam_gtsam.matching import EdgeMatches, PlaneMatches, ScanMatches
from loam_gtsam.solvers import POSE_KEY, GtsamSolver, MotionPrior

LEAST = SolverConfig().min_aligned
POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.2, -0.3, 1.1), np.array([40.0, -7.0, 3.0]))
NO_EDGES = EdgeMatches(*[np.zeros((0, 3))] * 3, *[np.zeros(0)] * 3, np.zeros(0, np.int64))


def surfaces(points, normals, tilt=0.05, noise=0.0, seed=0):
    """Matches seen from POSE with planes through the points; normals wrong by ``noise`` rad."""
    rng = np.random.default_rng(seed)
    count = len(points)
    wrong = normals + noise * rng.normal(size=(count, 3))
    wrong /= np.linalg.norm(wrong, axis=1)[:, None]
    rotation = POSE.rotation().matrix()
    there = points @ rotation.T + POSE.translation()
    turned = wrong @ rotation.T
    return PlaneMatches(
        points,
        turned,
        -np.einsum("ij,ij->i", turned, there),
        np.zeros(count),
        np.full(count, 0.03),
        np.ones(count),
        np.arange(count),
        np.full(count, tilt),
    )


def room(sides=((1, 6.0), (2, 2.0)), count=400, extent=(15.0, 6.0, 2.0), seed=0):
    """Points on pairs of walls: (axis, distance)."""
    rng = np.random.default_rng(seed)
    points, normals = [], []
    for axis, distance in sides:
        wall = rng.uniform(-1, 1, (count, 3)) * extent
        wall[:, axis] = distance * np.sign(rng.normal(size=count))
        points.append(wall)
        normals.append(np.tile(np.eye(3)[axis], (count, 1)))
    return np.concatenate(points), np.concatenate(normals)


def angle(direction, axis):
    """Degrees between a tangent vector and one of the six axes, in metres at the points."""
    unit = direction * np.array([10.0, 10, 10, 1, 1, 1])
    return np.degrees(np.arccos(abs(unit[axis]) / np.linalg.norm(unit)))


def found(planes, edges=NO_EDGES):
    return localizability(ScanMatches(edges, planes), POSE)


def test_a_room_has_no_weak_direction():
    points, normals = room(((0, 15.0), (1, 6.0), (2, 2.0)))
    seen = found(surfaces(points, normals, noise=0.05))
    assert len(seen.weak(LEAST)) == 0
    assert seen.projector(LEAST) is None
    assert np.all(np.diff(seen.aligned) >= 0)


def test_a_corridor_is_weak_along_its_axis_although_its_noise_is_information():
    points, normals = room()
    planes = surfaces(points, normals, noise=0.05)
    rows = planes.normals @ POSE.rotation().matrix()
    claimed = np.sum((rows[:, 0] / planes.sigmas) ** 2)
    assert claimed**-0.5 < 0.03  # a standard deviation of centimetres, from noise alone
    weak = found(planes).weak(LEAST)
    assert len(weak) == 1
    assert angle(weak[0], 3) < 5.0


def test_enough_of_an_end_wall_lifts_it():
    points, normals = room()
    end = np.column_stack([np.full(40, 20.0), *np.random.default_rng(3).uniform(-2, 2, (2, 40))])
    for count, weak in ((3, 1), (40, 0)):
        both = np.concatenate([points, end[:count]])
        across = np.concatenate([normals, np.tile([1.0, 0, 0], (count, 1))])
        assert len(found(surfaces(both, across, noise=0.05)).weak(LEAST)) == weak


def test_on_one_plane_three_directions_are_weak():
    points, normals = room(((2, 2.0),), extent=(15.0, 15.0, 2.0))
    points[:, 2] = -2.0
    weak = found(surfaces(points, normals)).weak(LEAST)
    assert len(weak) == 3
    # x, y and yaw: none of them lifts or tilts.
    assert np.abs(weak[:, [0, 1, 5]]).max() < 0.02 * np.abs(weak).max()


def test_a_tunnel_is_weak_along_and_around():
    rng = np.random.default_rng(0)
    around, along = rng.uniform(-np.pi, np.pi, 1500), rng.uniform(-20, 20, 1500)
    normals = np.column_stack([0 * along, np.cos(around), np.sin(around)])
    points = 3.0 * normals
    points[:, 0] = along
    weak = found(surfaces(points, normals, tilt=0.03, noise=0.02)).weak(LEAST)
    assert len(weak) == 2
    assert np.abs(weak[:, [1, 2, 4, 5]]).max() < 0.05 * np.abs(weak[:, [0, 3]]).max()


def poles(count, distinct):
    rng = np.random.default_rng(1)
    feet = rng.uniform(-12, 12, (6, 3))
    points = np.repeat(feet, count // 6, axis=0)
    points[:, 2] = rng.uniform(-1, 3, len(points))
    rotation = POSE.rotation().matrix()
    up = np.tile(rotation[:, 2], (len(points), 1))
    there = points @ rotation.T + POSE.translation()
    n = len(points)
    ones = np.ones(n)
    return EdgeMatches(
        points,
        there,
        up,
        0 * ones,
        0.05 * ones,
        ones,
        np.arange(n),
        0.02 * ones,
        distinct * ones > 0,
    )


@pytest.mark.parametrize(("distinct", "weak"), [(True, 0), (False, 3)])
def test_poles_lift_an_open_field_if_they_are_distinct(distinct, weak):
    points, normals = room(((2, 2.0),), extent=(15.0, 15.0, 2.0))
    points[:, 2] = -2.0
    seen = found(surfaces(points, normals), poles(120, distinct))
    assert len(seen.weak(LEAST)) == weak


def test_directions_do_not_depend_on_the_map_frame():
    points, normals = room()
    planes = surfaces(points, normals, noise=0.05)
    here = found(planes)
    moved = gtsam.Pose3(gtsam.Rot3.Yaw(2.0), np.array([500.0, 20, 0]))
    turn = moved.rotation().matrix()
    offsets = planes.offsets - planes.normals @ turn.T @ moved.translation()
    elsewhere = replace(planes, normals=planes.normals @ turn.T, offsets=offsets)
    there = localizability(ScanMatches(NO_EDGES, elsewhere), moved.compose(POSE))
    np.testing.assert_allclose(there.aligned, here.aligned, rtol=1e-6)


def corridor_solution(policy, guess, information, priors=()):
    points, normals = room()
    matches = ScanMatches(NO_EDGES, surfaces(points, normals, noise=0.05))
    solver = GtsamSolver(SolverConfig(degeneracy=policy, inner_iterations=5))
    return solver.solve(lambda _: matches, guess, priors, MotionPrior(guess, information))


GUESS = POSE.compose(
    gtsam.Pose3(gtsam.Rot3.Expmap([0.01, -0.01, 0.02]), np.array([0.5, 0.1, -0.1]))
)


@pytest.mark.parametrize("policy", ["prior", "project"])
def test_along_the_weak_direction_the_expected_motion_stays(policy):
    solution = corridor_solution(policy, GUESS, 1e4 * np.eye(6))
    error = POSE.localCoordinates(solution.map_T_lidar)
    assert solution.n_weak == 1
    assert error[3] == pytest.approx(POSE.localCoordinates(GUESS)[3], abs=0.02)
    assert np.abs(np.delete(error, 3)).max() < 0.01
    along = solution.localizability.weak(LEAST)[0]
    claimed = along @ solution.information @ along
    assert claimed == pytest.approx(1e4 if policy == "prior" else 1e10, rel=0.1)
    assert along @ solution.scan_information @ along < 1e-6 * claimed


def test_switched_off_the_noise_is_believed():
    solution = corridor_solution("off", GUESS, 1e4 * np.eye(6))
    assert solution.weak is None
    assert solution.localizability is None
    assert abs(POSE.localCoordinates(solution.map_T_lidar)[3]) < 0.1


def test_a_users_factor_decides_along_the_weak_direction():
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.001)
    factor = gtsam.GPSFactor(POSE_KEY, POSE.translation(), noise)
    solution = corridor_solution("prior", GUESS, 1e2 * np.eye(6), [factor])
    assert abs(POSE.localCoordinates(solution.map_T_lidar)[3]) < 0.01


def test_in_a_room_the_motion_prior_does_nothing():
    points, normals = room(((0, 15.0), (1, 6.0), (2, 2.0)))
    matches = ScanMatches(NO_EDGES, surfaces(points, normals))
    solver = GtsamSolver(SolverConfig())
    alone = solver.solve(lambda _: matches, GUESS)
    beside = solver.solve(lambda _: matches, GUESS, (), MotionPrior(GUESS, 1e9 * np.eye(6)))
    assert beside.weak is None
    assert alone.map_T_lidar.equals(beside.map_T_lidar, 0.0)
