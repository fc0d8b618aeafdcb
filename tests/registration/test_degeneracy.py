"""Which directions a scan fixes: closed-form scenes, false information, and what takes over."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from support.matches import NO_EDGES

from loam_gtsam.config import Config, SolverConfig
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.geometry import transform
from loam_gtsam.mapper import Mapper
from loam_gtsam.pipeline import effective_config
from loam_gtsam.registration.degeneracy import by_lines, localizability, unseen_by_planes
from loam_gtsam.registration.matches import EdgeMatches, PlaneMatches, ScanMatches, joined, subset
from loam_gtsam.registration.report import status_of
from loam_gtsam.registration.solvers import (
    POSE_KEY,
    GtsamSolver,
    Matcher,
    MotionPrior,
    make_solver,
)
from loam_gtsam.types import FrameStatus

LEAST = SolverConfig().min_aligned
POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.2, -0.3, 1.1), np.array([40.0, -7.0, 3.0]))


def surfaces(points, normals, tilt=0.05, noise=0.0, seed=0):
    """Matches seen from POSE with planes through the points; normals wrong by ``noise`` rad."""
    rng = np.random.default_rng(seed)
    count = len(points)
    wrong = normals + noise * rng.normal(size=(count, 3))
    wrong /= np.linalg.norm(wrong, axis=1)[:, None]
    rotation = POSE.rotation().matrix()
    there = points @ rotation.T + POSE.translation()
    turned = wrong @ rotation.T
    offsets, ones = -np.einsum("ij,ij->i", turned, there), np.ones(count)
    rest = 0 * ones, 0.03 * ones, ones, np.arange(count), tilt * ones
    return PlaneMatches(points, turned, offsets, *rest)


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


def whole_room():
    """Points on all six sides."""
    return room(((0, 15.0), (1, 6.0), (2, 2.0)))


def ground(count=400):
    points, normals = room(((2, 2.0),), count, extent=(15.0, 15.0, 2.0))
    points[:, 2] = -2.0
    return points, normals


def lines(points, distinct=None):
    """Matches seen from POSE with upright lines through the points."""
    rotation = POSE.rotation().matrix()
    there = points @ rotation.T + POSE.translation()
    ones = np.ones(len(points))
    up = np.tile(rotation[:, 2], (len(points), 1))
    rest = 0 * ones, 0.05 * ones, ones, np.arange(len(points)), 0.02 * ones
    return EdgeMatches(points, there, up, *rest, None if distinct is None else distinct * ones > 0)


def found(planes, edges=NO_EDGES):
    return localizability(ScanMatches(edges, planes), POSE)


def test_a_room_has_no_weak_direction():
    seen = found(surfaces(*whole_room(), noise=0.05))
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


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_turns_about_the_only_points_are_motions_of_finite_size(count):
    points, normals = whole_room()
    matches = ScanMatches(NO_EDGES, surfaces(points[:count], normals[:count]))
    found = localizability(matches, POSE)
    assert np.isfinite(found.directions).all()
    assert np.linalg.norm(found.directions, axis=1).max() < 1e3
    assert (found.aligned[0], found.information[0]) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert np.isfinite(found.projector(LEAST)).all()


def test_enough_of_an_end_wall_lifts_it():
    points, normals = room()
    end = np.column_stack([np.full(40, 20.0), *np.random.default_rng(3).uniform(-2, 2, (2, 40))])
    for count, weak in ((3, 1), (40, 0)):
        both = np.concatenate([points, end[:count]])
        across = np.concatenate([normals, np.tile([1.0, 0, 0], (count, 1))])
        assert len(found(surfaces(both, across, noise=0.05)).weak(LEAST)) == weak


def test_on_one_plane_three_directions_are_weak():
    weak = found(surfaces(*ground())).weak(LEAST)
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
    return lines(points, distinct)


@pytest.mark.parametrize(("distinct", "weak"), [(True, 0), (False, 3)])
def test_poles_lift_an_open_field_if_they_are_distinct(distinct, weak):
    assert len(found(surfaces(*ground()), poles(120, distinct)).weak(LEAST)) == weak


def ground_and_poles(distinct=True):
    """Planes that hold the guess along x and y by noise, and poles where they truly stand."""
    points, normals = ground(1500)
    planes = surfaces(points, normals, noise=0.05)
    held = GUESS.matrix()[:3, :3] @ points.T + GUESS.translation()[:, None]
    offsets = -np.einsum("ij,ij->i", planes.normals, held.T)
    return ScanMatches(poles(60, distinct), replace(planes, offsets=offsets))


@pytest.mark.parametrize(
    ("policy", "distinct", "off"),
    [("prior", True, 0.02), ("off", True, 0.09), ("prior", False, 0.5)],
)
def test_poles_say_where_they_see_and_planes_do_not(policy, distinct, off):
    """The noise of a thousand planes holds the guess; the poles know better, if they are any."""
    matches = ground_and_poles(distinct)
    solver = GtsamSolver(SolverConfig(degeneracy=policy, kernel_width=np.inf, inner_iterations=5))
    solution = solver.solve(lambda _: matches, GUESS, (), MotionPrior(GUESS, 1e4 * np.eye(6)))
    error = np.linalg.norm(POSE.localCoordinates(solution.map_T_lidar)[3:5])
    assert error == pytest.approx(off, rel=0.3, abs=0.02)
    assert (solution.n_weak > 0) == (not distinct)


class Vanishing(Matcher):
    """Poles on open ground, of which only so many are found again after the first association."""

    def __init__(self, left):
        self.matches = ground_and_poles()
        keep = np.arange(len(self.matches.edges)) < left
        self.fewer = replace(self.matches, edges=subset(self.matches.edges, keep))

    def __call__(self, pose):
        found, self.matches = self.matches, self.fewer
        return self.held_at(pose, found)

    def again(self, _, pose):
        return self.held_at(pose, self.fewer)

    def held_at(self, pose, matches):
        """The planes are made anew, and hold the pose wherever it is."""
        here = transform(pose.matrix(), matches.planes.points)
        offsets = -np.einsum("ij,ij->i", matches.planes.normals, here)
        return replace(matches, planes=replace(matches.planes, offsets=offsets))


@pytest.mark.parametrize(("left", "weak"), [(60, 0), (10, 1), (0, 3)])
def test_no_direction_is_left_to_lines_that_vanish(left, weak):
    """Planes are left out of x, y and yaw for 60 lines; then 10 of one pole remain, then none."""
    prior = MotionPrior(GUESS, 25.0 * np.eye(6))
    solver = GtsamSolver(SolverConfig(step_sigmas=0.0))
    solution = solver.solve(Vanishing(left), GUESS, (), prior)
    assert solution.iterations > 1
    assert solution.n_weak == weak
    assert (status_of(solution, "")[0] is FrameStatus.DEGENERATE) == (weak > 0)
    covariance = np.linalg.inv(solution.information)
    assert np.linalg.eigvalsh(covariance).max() < 1.0  # of the expected motion: 0.2 m, 0.2 rad
    assert np.linalg.norm(POSE.localCoordinates(solution.map_T_lidar)) < 1.0


@pytest.mark.parametrize(
    ("slope", "hilly", "weak"), [(0.08, True, 0), (0.08, False, 3), (0.05, True, 3)]
)
def test_planes_are_tried_with_lines_that_do_not_hold_the_pose(slope, hilly, weak):
    """Lines in foliage are wherever the pose is; slopes, each lost in noise, are not.

    Only those are believed that stand out of noise together.
    """
    points, normals = ground(1500)
    normals = normals + slope * np.random.default_rng(5).normal(size=normals.shape)
    planes, foliage = surfaces(points, normals), poles(30, True)

    def associate(pose):
        edges = replace(foliage, centres=transform(pose.matrix(), foliage.points))
        here = transform(pose.matrix(), points)
        held = -np.einsum("ij,ij->i", planes.normals, here)
        return ScanMatches(edges, planes if hilly else replace(planes, offsets=held))

    seen = found(planes, foliage)
    assert len(seen.weak(LEAST)) == 0
    assert len(unseen_by_planes(ScanMatches(foliage, planes), POSE, seen, LEAST)) == 3
    prior = MotionPrior(GUESS, 25.0 * np.eye(6))
    solution = GtsamSolver(SolverConfig(iterations=30)).solve(associate, GUESS, (), prior)
    assert solution.n_weak == weak
    error = np.abs(POSE.localCoordinates(solution.map_T_lidar))
    assert (error.max() < 0.02) == (weak == 0)


@pytest.mark.parametrize(
    ("slope", "follow", "weak"), [(0.08, False, 0), (0.08, True, 3), (0.04, False, 3)]
)
def test_slopes_that_together_stand_out_of_noise_are_tried(slope, follow, weak):
    """Each slope is lost in noise of 0.05 rad; planes of noise follow the pose."""
    points, normals = ground(1500)
    tilted = normals + slope * np.random.default_rng(5).normal(size=normals.shape)
    planes = surfaces(points, tilted)

    def associate(pose):
        held = -np.einsum("ij,ij->i", planes.normals, transform(pose.matrix(), points))
        return ScanMatches(NO_EDGES, replace(planes, offsets=held) if follow else planes)

    seen = found(planes)
    assert len(seen.weak(LEAST)) == 3
    assert (seen.over_noise[:3].min() > 4.0 / 3.0) == (slope > 0.05)
    prior = MotionPrior(GUESS, 25.0 * np.eye(6))
    solution = GtsamSolver(SolverConfig(iterations=30)).solve(associate, GUESS, (), prior)
    assert solution.n_weak == weak
    error = np.abs(POSE.localCoordinates(solution.map_T_lidar))
    assert (error.max() < 0.02) == (weak == 0)


def test_what_lines_leave_open_is_a_turn_about_the_one_pole():
    matches = ScanMatches(lines(np.tile([4.0, 3, 0], (20, 1))), surfaces(*ground()))
    unseen = localizability(replace(matches, edges=NO_EDGES), POSE).between(-1.0, LEAST)
    left = by_lines(matches, POSE, unseen, LEAST)[0]
    assert (len(unseen), len(left)) == (3, 1)
    turn = left.vectors[0] / left.vectors[0, 2]
    np.testing.assert_allclose(turn[[3, 4]], [3.0, -4.0], atol=0.1)  # (4, 3) does not move
    np.testing.assert_allclose(left.projector @ left.vectors[0], left.vectors[0], atol=1e-9)
    np.testing.assert_allclose(left.projector @ left.projector, left.projector, atol=1e-9)


def corridor_with_end(count, follows):
    """A corridor with so many points on an end wall; one that ``follows`` is wherever one is."""
    points, normals = room()
    end = np.column_stack(
        [np.full(count, 20.0), *np.random.default_rng(3).uniform(-2, 2, (2, count))]
    )
    walls, wall = (
        surfaces(points, normals, noise=0.02),
        surfaces(end, np.tile(np.eye(3)[0], (count, 1))),
    )

    def associate(pose):
        here = pose.matrix()[:3, :3] @ end.T + pose.translation()[:, None]
        offsets = -np.einsum("ij,ij->i", wall.normals, here.T) if follows else wall.offsets
        parts = replace(walls, distances=walls.distances), replace(wall, offsets=offsets)
        return ScanMatches(NO_EDGES, joined(*parts))

    return associate


@pytest.mark.parametrize(
    ("count", "follows", "weak"), [(14, False, 0), (14, True, 1), (3, False, 1), (60, False, 0)]
)
def test_few_matches_are_believed_if_they_bring_a_displaced_pose_back(count, follows, weak):
    """Accidental planes of noise move with the pose; an end wall stays where it is."""
    associate = corridor_with_end(count, follows)
    assert (localizability(associate(POSE), POSE).aligned[0] < LEAST) == (count < LEAST)
    solution = GtsamSolver(SolverConfig()).solve(
        associate, GUESS, (), MotionPrior(GUESS, 1e4 * np.eye(6))
    )
    assert solution.n_weak == weak
    error = POSE.localCoordinates(solution.map_T_lidar)
    if count > 3:
        assert (abs(error[3]) > 0.05) == follows
    claimed = np.linalg.inv(solution.information)[3, 3]
    assert (claimed > 0.9e-4) == (weak > 0)  # of the expected motion: 0.01 m
    assert np.abs(np.delete(error, 3)).max() < 0.02


@pytest.mark.parametrize(
    ("count", "sigma", "measured", "believed"),
    [
        (14, 0.05, True, False),
        (14, 0.3, True, True),
        (14, 0.05, False, True),
        (60, 0.05, True, True),
    ],
)
def test_few_matches_are_not_believed_against_the_imu(count, sigma, measured, believed):
    """The IMU is 0.5 m off along the corridor; an end wall of few points contradicts it."""
    expected = MotionPrior(GUESS, np.diag(np.repeat([1e4, sigma**-2], 3)), measured=measured)
    associate = corridor_with_end(count, follows=False)
    solution = GtsamSolver(SolverConfig()).solve(associate, GUESS, (), expected)
    assert solution.n_weak == (not believed)
    along = GUESS if not believed else POSE
    assert along.localCoordinates(solution.map_T_lidar)[3] == pytest.approx(0.0, abs=0.05)


def test_planes_are_believed_where_lines_see_too_little():
    planes = surfaces(*whole_room())
    seen = found(planes, poles(6, True))
    # They see everything.
    assert unseen_by_planes(ScanMatches(poles(6, True), planes), POSE, seen, LEAST) is None
    thin = surfaces(*room(((1, 6.0), (2, 2.0), (0, 15.0)), count=7))
    few = ScanMatches(poles(6, True), thin)
    both = localizability(few, POSE)
    just = 0.99 * both.aligned[0]
    assert both.by_planes.min() < just  # but with the lines it is enough
    assert unseen_by_planes(few, POSE, both, just) is None
    assert unseen_by_planes(few, POSE, both, 1.1 * both.aligned[0]) is not None


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


def wall_ahead():
    """Points of a narrow view: a wall 8 m ahead, floor and ceiling before it; nothing tells y."""
    rng = np.random.default_rng(4)
    wall, level = (rng.uniform(-1, 1, (600, 3)) * np.array([1.0, 3.0, 2.0]) for _ in range(2))
    wall[:, 0], level[:, 0] = 8.0, rng.uniform(5.0, 8.0, 600)
    level[:, 2] = 2.0 * np.sign(level[:, 2])
    normals = np.repeat(np.eye(3)[[0, 2]], 600, axis=0)
    return ScanMatches(NO_EDGES, surfaces(np.concatenate([wall, level]), normals, noise=0.05))


@pytest.mark.parametrize("method", ["gtsam", "loam", "aloam"])
def test_a_lidar_that_turned_less_than_expected_has_not_moved_aside(method):
    """About the wall that it sees, the turn would be one of the lidar around a far point."""
    turn = gtsam.Pose3(gtsam.Rot3.Yaw(0.02), np.zeros(3))
    guess, matches = POSE.compose(turn), wall_ahead()
    solver = make_solver(SolverConfig(method=method, inner_iterations=5))
    solution = solver.solve(lambda _: matches, guess, (), MotionPrior(guess, 1e4 * np.eye(6)))
    error = POSE.localCoordinates(solution.map_T_lidar)
    assert solution.n_weak == 1
    assert abs(error[2]) < 0.004  # the scan sees that it has not turned
    assert abs(error[4]) < 0.005  # 0.02 rad times 7 m are 140 mm
    if method == "gtsam":
        share = np.linalg.solve(solution.information, solution.expected)
        assert np.abs(share - MotionPrior(guess, 1e4 * np.eye(6)).share(share)).max() < 1e-6
        assert np.linalg.norm(share @ np.eye(6)[2]) < 0.1  # of a turn, nothing along y


def test_the_share_of_the_expected_motion_follows_what_is_known_of_it():
    """A free turn about a pole, and a lidar that may slide more easily than turn."""
    pole = np.array([0.0, 0.0, 1.0, 0.0, -4.0, 0.0])[:, None]
    across = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    directions = pole @ across
    for sigma, moved in ((1e-3, 0.0), (1e3, 1.0)):
        motion = MotionPrior(POSE, np.diag(np.array([1, 1, 1, 1, sigma, 1.0]) ** -2.0))
        share = motion.share(directions)
        np.testing.assert_allclose(share @ share, share, atol=1e-9)
        np.testing.assert_allclose(share @ pole, pole, atol=1e-6)
        # Of an expected turn about the lidar itself, the pose takes what is likely.
        assert (share @ np.eye(6)[2])[2] == pytest.approx(moved, abs=1e-3)
        along = motion.along(directions).information
        assert np.linalg.matrix_rank(along) == 1
        assert (pole.T @ along @ pole).item() == pytest.approx(
            (pole.T @ motion.information @ pole).item()
        )
    nothing = MotionPrior(POSE, np.zeros((6, 6)))
    assert nothing.share(directions) is directions
    assert not nothing.along(directions).information.any()


def test_switched_off_the_noise_is_believed():
    solution = corridor_solution("off", GUESS, 1e4 * np.eye(6))
    assert solution.weak is None
    assert len(solution.localizability.weak(LEAST)) == 1  # reported all the same
    assert abs(POSE.localCoordinates(solution.map_T_lidar)[3]) < 0.1


def test_a_users_factor_decides_along_the_weak_direction():
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.001)
    factor = gtsam.GPSFactor(POSE_KEY, POSE.translation(), noise)
    solution = corridor_solution("prior", GUESS, 1e2 * np.eye(6), [factor])
    assert abs(POSE.localCoordinates(solution.map_T_lidar)[3]) < 0.01


def test_in_a_room_the_motion_prior_does_nothing():
    matches = ScanMatches(NO_EDGES, surfaces(*whole_room()))
    solver = GtsamSolver(SolverConfig())
    alone = solver.solve(lambda _: matches, GUESS)
    beside = solver.solve(lambda _: matches, GUESS, (), MotionPrior(GUESS, 1e9 * np.eye(6)))
    assert beside.weak is None
    assert alone.map_T_lidar.equals(beside.map_T_lidar, 0.0)


def test_per_axis_a_corridor_leaves_x_open_and_nothing_else():
    points, normals = room()
    axes = found(surfaces(points, normals, noise=0.05)).axes()
    assert axes[3] < LEAST
    assert np.delete(axes, 3).min() > 5 * LEAST
    whole = found(surfaces(*whole_room(), noise=0.05)).axes()
    assert whole.min() > 5 * LEAST


def test_per_axis_a_corridor_across_the_lidar_leaves_two_axes_open():
    points, normals = room()
    turn = gtsam.Rot3.Yaw(np.pi / 4).matrix()
    axes = found(surfaces(points @ turn.T, normals @ turn.T, noise=0.05)).axes()
    assert axes[[3, 4]].max() < LEAST
    assert np.delete(axes, [3, 4]).min() > 5 * LEAST


def test_per_axis_the_count_of_a_pure_translation_is_that_of_its_normals():
    # Walls across x, y and z around the origin: nothing couples the axes.
    rng = np.random.default_rng(0)
    half = np.concatenate([rng.uniform(-5, 5, (50, 3)) for _ in range(3)])
    normals = np.repeat(np.eye(3), 50, axis=0)
    points = np.concatenate([half, half * (-1, 1, 1), half * (1, -1, 1), half * (-1, -1, 1)])
    points = np.concatenate([points, -points])
    matches = surfaces(points, np.tile(normals, (8, 1)), tilt=0.01)
    np.testing.assert_allclose(found(matches).axes()[3:], 400.0, rtol=1e-3)


def test_per_axis_a_turn_about_the_line_that_all_points_lie_on_is_not_fixed():
    post = np.linspace(-1.0, 1.0, 20)[:, None] * np.eye(3)[2]
    with np.errstate(all="raise"):
        axes = found(surfaces(post[:0], post[:0]), lines(post)).axes()
    assert axes[2] <= 1.0
    assert axes[[0, 1, 3, 4]].min() > 10.0


def test_information_along_a_direction_is_that_of_the_factor():
    points, normals = room()
    planes = surfaces(points, normals, noise=0.05)
    seen = found(planes)
    rows = planes.normals @ POSE.rotation().matrix()
    jacobian = np.hstack([np.cross(points, rows), rows]) / planes.sigmas[:, None]
    expected = ((jacobian @ seen.directions.T) ** 2).sum(axis=0)
    np.testing.assert_allclose(seen.information, expected, rtol=1e-6)


def test_seen_from_another_place_on_the_vehicle_the_same_points_move_by_as_much():
    points, normals = room()
    here = found(surfaces(points, normals, noise=0.05))
    there_T_here = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, -0.4), np.array([2.0, -1.0, 0.5]))
    there = here.seen_from(there_T_here)
    seen = np.array([there_T_here.transformFrom(point) for point in points])
    for first, second in zip(here.directions, there.directions, strict=True):
        before = np.cross(first[:3], points) + first[3:]
        after = np.cross(second[:3], seen) + second[3:]
        np.testing.assert_allclose(after, before @ there_T_here.rotation().matrix().T, atol=1e-9)
        assert second @ there.displacement @ second == pytest.approx(1.0)


@pytest.mark.parametrize(("off", "weak"), [(0.02, 1), (4.0, 0)])
def test_round_one_pole_a_turn_is_weak_and_round_two_it_is_not(off, weak):
    rng = np.random.default_rng(5)
    at = np.tile([6.0, 1.0, 0.0], (60, 1)) + off * rng.normal(size=(60, 3)) * (1, 1, 0)
    at[:, 2] = rng.uniform(-1, 3, 60)
    seen = found(surfaces(*ground()), lines(at)).weak(LEAST)
    assert len(seen) == weak
    if weak:
        turn = seen[0] / seen[0][2]
        np.testing.assert_allclose(turn, [0, 0, 1, 1, -6, 0], atol=0.15)  # (6, 1) stays


# -- whole sweeps of the built-in places ----------------------------------------------------------

UNSEEN = {
    "corridor_bare": [[0, 0, 0, 1, 0, 0]],
    "open_field": [[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 1, 0]],
    "single_plane": [[0, 1, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, 1]],
    "single_pole": [[0, 0, 1, 0, 0, 0]],
    "tunnel": [[0, 0, 0, 1, 0, 0], [1, 0, 0, 0, 3.0, 0]],
}
"""Motions about the world's origin that no beam shows, [rotation, translation]; the tunnel's axis
is 3 m above it."""
FIRST = {"corridor_bare": 250}
"""Sweep to begin with, when the platform moves; in the corridor out of sight of its ends."""


def drive(scene, sweeps=8, first=50, **solver):
    """Updates and true world poses, with odometry that is one per cent too long as the guess."""
    world = SimulatedWorld(scene, columns=900)
    config = effective_config(Config(solver=SolverConfig(**solver)), world)
    truth = (world.world_T_start @ world.truth.map_T_lidar)[first : first + sweeps + 1]
    poses = [gtsam.Pose3(pose) for pose in truth]
    mapper, guess, updates = Mapper(config), gtsam.Pose3(), []
    for i in range(sweeps):
        step = 1.01 * gtsam.Pose3.Logmap(poses[i].between(poses[i + 1]))
        features = extract_features(world[first + i], config)
        updates.append(mapper.register(features, guess, 10.0 * step))
        guess = updates[-1].map_T_lidar.compose(gtsam.Pose3.Expmap(step))
    return world, updates, poses[:-1]


def largest_angle(found, true, points):
    """Largest principal angle in degrees, by the displacement of the points of the sweep."""
    form = np.zeros((6, 6))
    for x, y, z in points:
        moves = np.hstack([[[0, z, -y], [-z, 0, x], [y, -x, 0]], np.eye(3)])
        form += moves.T @ moves / len(points)
    root = np.linalg.cholesky(form)
    a, b = (np.linalg.qr((rows @ root).T)[0] for rows in (found, true))
    return np.degrees(np.arccos(min(np.linalg.svd(a.T @ b, compute_uv=False).min(), 1.0)))


@pytest.mark.parametrize("scene", UNSEEN)
def test_weak_directions_of_a_place_are_the_true_ones_and_the_others_stay_accurate(scene):
    first = FIRST.get(scene, 50)
    world, updates, poses = drive(scene, sweeps=4, first=first)
    motions = np.array(UNSEEN[scene], float)
    for number, (update, pose) in enumerate(zip(updates[1:], poses[1:], strict=True), 1):
        assert update.status is FrameStatus.DEGENERATE, update.message
        true = motions @ pose.inverse().AdjointMap().T
        points = world[first + number].points[::100].astype(float)
        weak = update.directions[update.localizability < LEAST]
        assert len(weak) == len(motions), update.localizability
        assert largest_angle(weak, true, points) < 5.0
    # What is left of the error once the unseen motions are taken out of it.
    error = poses[0].between(poses[-1]).localCoordinates(updates[-1].map_T_lidar)
    rest = error - true.T @ np.linalg.lstsq(true.T, error, rcond=None)[0]
    assert np.abs(rest[3:]).max() < 0.05
    assert np.abs(rest[:3]).max() < 0.005


@pytest.mark.parametrize("scene", ["room", "street_loop", "trees"])
def test_no_false_alarm(scene):
    _, updates, _ = drive(scene, sweeps=6, first=40)
    assert {update.status for update in updates[1:]} == {FrameStatus.OK}
    assert min(update.localizability[0] for update in updates[1:]) > LEAST
    assert min(update.axis_localizability.min() for update in updates[1:]) > LEAST


@pytest.mark.parametrize(("mixed", "pure"), [(0.001, True), (0.2, False)])
def test_a_translation_is_freed_of_the_rotation_that_noise_adds(mixed, pure):
    """Along a corridor; a motion with a turn that the walls would show is left as it is."""
    seen = found(surfaces(*room(), noise=0.02))
    along = np.array([0.0, 0.0, mixed, 1.0, 0.0, 0.0])
    blind = np.outer(along, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    cleaned = seen.without_noise(blind, 1.0)
    expected = blind * [[0], [0], [0], [1], [1], [1]] if pure else blind
    np.testing.assert_allclose(cleaned, expected, atol=1e-4)


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_without_noise_the_expected_motion_decides_as_much_as_before(share):
    """A share above 1 would let the velocity grow: it is taken to a high power."""
    seen = found(surfaces(*room(), noise=0.02))
    along = np.array([0.0, 0.0, 1e-3, 1.0, 0.0, 0.0])
    row = np.array([0.0, 0.0, 20.0, 1.0, 0.1, 0.0])
    blind = share * np.outer(along, row / (row @ along))
    cleaned = seen.without_noise(blind, 1.0)
    np.testing.assert_allclose(cleaned[:3], 0.0, atol=1e-9)
    assert np.trace(cleaned) == pytest.approx(share)
    np.testing.assert_allclose(cleaned @ cleaned, share * cleaned, atol=1e-12)


@pytest.mark.parametrize("moving", [0.0, 1e-3])
def test_a_blind_turn_is_no_translation_however_large_the_noise(moving):
    """Nothing would be left of it."""
    seen = found(surfaces(*room(), noise=0.02))
    turn = np.array([0.0, 0.0, 1.0, moving, 0.0, 0.0])
    blind = np.outer(turn, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(seen.without_noise(blind, 1e9), blind, atol=1e-12)


def test_a_blind_way_turns_towards_translations_by_the_noise_of_the_normals():
    seen = found(surfaces(*room(), tilt=0.05, noise=0.02))
    wander = seen.wander(np.diag([0.0, 0.0, 0.0, 4.0, 0.0, 0.0]))
    np.testing.assert_array_equal(wander[:3], 0.0)
    across = 2.0 * 0.05 / np.sqrt(400)  # 2 m along, 400 normals across y or z
    np.testing.assert_allclose(np.sqrt(np.diag(wander)[4:]), across, rtol=0.3)
