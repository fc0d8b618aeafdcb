"""The solvers: known poses, the rematch loop, the stop rule, priors, information."""

import gtsam
import numpy as np
import pytest
from support.jacobians import numerical
from support.matches import TRUTH, difference, make_matches

from loam_gtsam.config import SolverConfig
from loam_gtsam.registration.matches import EdgeMatches, PlaneMatches, ScanMatches
from loam_gtsam.registration.solvers import (
    POSE_KEY,
    GtsamSolver,
    Matcher,
    Solution,
    fuse,
    make_solver,
    match_rows,
    rematch,
)
from loam_gtsam.registration.solvers.gtsam_solver import within_tolerance

CONFIG = SolverConfig()
# 2 degrees and 0.2 m
OFFSET = np.concatenate(
    [np.radians(2.0) * np.array([2, -1, 2]) / 3, 0.2 * np.array([1, 2, -2]) / 3]
)


def changed(**changes):
    return CONFIG.changed(**changes)


def same(a, b):
    return bool((a.matrix() == b.matrix()).all())


def solver(method, **changes):
    """A solver; LOAM's projector is off, for it finds a few hundred matches too few."""
    return make_solver(SolverConfig(**{"method": method, "degeneracy_threshold": 0.0} | changes))


ALL = pytest.mark.parametrize("method", ["gtsam", "loam", "aloam"])


@ALL
@pytest.mark.parametrize(("n_edges", "n_planes"), [(40, 120), (0, 200)])
def test_a_known_pose_is_recovered_with_the_same_bits_each_time(method, n_edges, n_planes):
    matches = make_matches(n_edges=n_edges, n_planes=n_planes, sigma=1.0)
    guess = TRUTH.retract(OFFSET)
    first, again = (solver(method).solve(lambda pose: matches, guess) for _ in range(2))
    assert difference(first.map_T_lidar, TRUTH) < (1e-9 if method == "gtsam" else 1e-5)
    assert (first.solved, first.converged) == (True, True)
    assert first.error_after < 1e-6 < first.error_before
    assert first.solver_iterations >= first.iterations > 1
    assert first.matches is matches
    assert same(first.map_T_lidar, again.map_T_lidar)
    assert first.information.tobytes() == again.information.tobytes()


@ALL
@pytest.mark.parametrize("lost_at", [1, 2])
def test_too_few_matches_in_any_round_give_the_guess_back(method, lost_at):
    asked, guess = [], TRUTH.retract(OFFSET)

    def associate(pose):
        asked.append(pose)
        few = len(asked) == lost_at
        return make_matches(n_edges=10, n_planes=40 if few else 200, noise=0.02, sigma=1.0)

    refused = solver(method, min_matches=51).solve(associate, guess)
    assert (refused.solved, refused.converged, refused.iterations) == (False, False, lost_at)
    assert same(refused.map_T_lidar, guess)
    assert len(refused.matches) == 50
    assert not refused.information.any()
    few = make_matches(n_edges=10, n_planes=40, sigma=1.0)
    assert solver(method, min_matches=50).solve(lambda pose: few, guess).solved


class Logged(Matcher):
    """A matcher that writes down every call, with the number of its de-skew and the pose."""

    motion_is_free = False

    def __init__(self, log, number=0, motion_is_free=False):
        self.log, self.number, self.motion_is_free = log, number, motion_is_free

    def __call__(self, pose):
        self.log.append(("search", self.number, pose.x()))
        return make_matches()

    def again(self, matches, pose):
        self.log.append(("again", self.number, pose.x()))
        return matches

    def deskewed(self, pose, matches):
        self.log.append(("de-skew", self.number, pose.x()))
        return Logged(self.log, self.number + 1, self.motion_is_free)


def one_metre(converged_at=None):
    """An optimisation that moves the pose by a metre, three steps and a cost of 10 less the x."""

    def optimise(matches, pose):
        moved = gtsam.Pose3(gtsam.Rot3(), pose.translation() + np.array([1.0, 0.0, 0.0]))
        done = converged_at is not None and moved.x() >= converged_at
        costs = 10.0 - pose.x(), 10.0 - moved.x()
        return Solution(moved, True, done, matches, 1, 3, *costs, np.eye(6))

    return optimise


def test_the_sweep_is_deskewed_once_more_at_the_second_round():
    log = []
    found = rematch(Logged(log), gtsam.Pose3(), changed(iterations=4), one_metre())
    assert log == [
        ("search", 0, 0.0), ("de-skew", 0, 1.0),
        ("again", 1, 1.0), ("again", 1, 2.0), ("again", 1, 3.0),
    ]  # fmt: skip
    assert (found.iterations, found.solver_iterations, found.converged) == (4, 12, False)
    assert (found.error_before, found.error_after) == (10.0, 6.0)


def test_a_free_motion_is_solved_for_in_every_round():
    log = []
    rematch(Logged(log, motion_is_free=True), gtsam.Pose3(), changed(iterations=3), one_metre())
    assert log == [
        ("search", 0, 0.0), ("de-skew", 0, 1.0), ("again", 1, 1.0), ("de-skew", 1, 2.0),
        ("again", 2, 2.0),
    ]  # fmt: skip


@pytest.mark.parametrize(("stop", "rounds"), [(True, 2), (False, 5)])
def test_the_loop_ends_when_the_pose_stays_unless_told_to_go_on(stop, rounds):
    found = rematch(Logged([]), gtsam.Pose3(), changed(iterations=5), one_metre(2.0), stop=stop)
    assert (found.iterations, found.converged, found.map_T_lidar.x()) == (rounds, True, rounds)


@pytest.mark.parametrize(("far", "solved"), [(9e3, True), (1.1e4, False), (np.nan, False)])
def test_a_pose_out_of_this_world_is_no_solution(far, solved):
    def optimise(matches, pose):
        moved = gtsam.Pose3(gtsam.Rot3(), np.array([far, 0.0, 0.0]))
        return Solution(moved, True, True, matches, 1, 3, 10.0, 1.0, np.eye(6))

    guess = gtsam.Pose3()
    found = rematch(lambda pose: make_matches(), guess, changed(iterations=3), optimise)
    assert found.solved is solved
    assert same(found.map_T_lidar, guess) is not solved


def test_a_plain_function_is_asked_at_every_pose():
    asked = []

    def associate(pose):
        asked.append(pose.x())
        return make_matches()

    rematch(associate, gtsam.Pose3(), changed(iterations=3), one_metre())
    assert asked == [0.0, 1.0, 2.0]


def test_noise_lowers_the_error_to_its_own_level():
    matches = make_matches(noise=0.02)
    solution = GtsamSolver(CONFIG).solve(lambda pose: matches, TRUTH.retract(OFFSET))
    assert 1.0 < solution.error_after < 0.01 * solution.error_before
    residual, jacobian = match_rows(matches).residuals(solution.map_T_lidar)
    assert solution.error_after == pytest.approx(0.5 * residual @ residual, rel=1e-8)
    residual_before, _ = match_rows(matches).residuals(TRUTH.retract(OFFSET))
    assert solution.error_before == pytest.approx(0.5 * residual_before @ residual_before, rel=1e-9)
    scale = np.linalg.norm(jacobian) * np.linalg.norm(residual)
    assert np.abs(jacobian.T @ residual).max() < 1e-6 * scale


@pytest.mark.parametrize(
    ("degrees", "metres", "within"),
    [
        (0.0, 0.0, True),
        (0.0499, 0.000499, True),
        (0.0501, 0.0, False),
        (0.0, 0.000501, False),
        (0.0501, 0.000501, False),
    ],
)
@pytest.mark.parametrize("axis", [np.array([0.0, 0, -1]), np.array([2.0, -1, 2]) / 3])
def test_the_stop_rule_bounds_rotation_and_translation(degrees, metres, within, axis):
    step = np.concatenate([np.radians(degrees) * axis, metres * axis])
    assert within_tolerance(step, 1e12 * np.eye(6), CONFIG) is within


@pytest.mark.parametrize(("metres", "within"), [(0.0049, True), (0.0051, False)])
def test_a_step_far_below_what_is_known_is_small_enough(metres, within):
    """A direction known to 1 cm: half a standard deviation is 5 mm."""
    information = np.diag([1e12, 1e12, 1e12, 1e12, 1e12, 1e4])
    step = np.array([0.0, 0.0, 0.0, 0.0, 0.0, metres])
    assert within_tolerance(step, information, CONFIG) is within
    assert not within_tolerance(step, information, changed(step_sigmas=0.0))
    assert not within_tolerance(np.roll(step, 2), information, CONFIG)


def test_the_iteration_limit_is_reported_as_not_converged():
    def solve(config):
        matches = make_matches()
        return GtsamSolver(config).solve(lambda pose: matches, TRUTH.retract(OFFSET))

    once = solve(changed(iterations=1))
    assert (once.solved, once.converged, once.iterations) == (True, False, 1)
    assert np.linalg.matrix_rank(once.information) == 6
    assert solve(
        changed(iterations=1, rotation_tolerance_deg=5.0, translation_tolerance=1.0)
    ).converged
    never = solve(changed(iterations=4, translation_tolerance=0.0, step_sigmas=0.0))
    assert (never.converged, never.iterations) == (False, 4)


def test_a_prior_moves_the_pose_to_the_weighted_mean():
    """Near the optimum all is Gaussian: L (x - scan) + P (x - prior) = 0."""
    matches = make_matches()
    offset = np.array([1e-4, -2e-4, 1e-4, 2e-3, 1e-3, -1e-3])
    sigmas = np.array([1e-3, 2e-3, 1e-3, 5e-3, 3e-3, 1e-2])
    prior = gtsam.PriorFactorPose3(
        POSE_KEY, TRUTH.retract(offset), gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    )
    config = changed(rotation_tolerance_deg=1e-9, translation_tolerance=1e-9)
    solver = GtsamSolver(config)
    alone = solver.solve(lambda pose: matches, TRUTH)
    both = solver.solve(lambda pose: matches, TRUTH, [prior])
    weight = np.diag(sigmas**-2.0)
    expected = np.linalg.solve(alone.information + weight, weight @ offset)
    moved = TRUTH.localCoordinates(both.map_T_lidar)
    assert 0.02 < np.linalg.norm(moved) / np.linalg.norm(offset) < 0.98
    np.testing.assert_allclose(moved, expected, atol=1e-6)
    scale = alone.information.max()
    np.testing.assert_allclose(both.information, alone.information + weight, atol=1e-4 * scale)
    assert both.error_after > alone.error_after


def test_a_prior_holds_what_the_matches_leave_free():
    """Planes facing up say nothing about x, y and yaw: the prior does."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-10, 10, (100, 2)), np.full(100, -1.5)])
    ones, up = np.ones(100), np.tile([0.0, 0, 1], (100, 1))
    none = make_matches(n_edges=0).edges
    floor = ScanMatches(
        none, PlaneMatches(points, up, 1.5 * ones, 0 * ones, 0.05 * ones, ones, np.arange(100))
    )
    there = gtsam.Pose3.Expmap(np.array([0, 0, 0.3, 4.0, 5.0, 0.0]))
    prior = gtsam.PriorFactorPose3(POSE_KEY, there, gtsam.noiseModel.Isotropic.Sigma(6, 0.1))
    guess = there.retract(OFFSET)
    solution = GtsamSolver(CONFIG).solve(lambda pose: floor, guess, [prior])
    assert solution.converged
    assert difference(solution.map_T_lidar, there) < 1e-6
    eigenvalues = np.linalg.eigvalsh(solution.information)
    np.testing.assert_allclose(eigenvalues[:3], 100.0, rtol=1e-3)
    assert (eigenvalues[3:] > 1e4).all()


@pytest.mark.parametrize("iterations", [1, 10])
def test_information_is_that_of_the_rows_at_the_pose(iterations):
    """At the one returned, also when a single far step led there."""
    matches = make_matches(noise=0.02)
    solution = GtsamSolver(changed(iterations=iterations)).solve(
        lambda pose: matches, TRUTH.retract(OFFSET)
    )
    rows, pose = match_rows(matches), solution.map_T_lidar
    jacobian = numerical(lambda step: rows.residuals(pose.retract(step))[0])
    expected = jacobian.T @ jacobian
    np.testing.assert_allclose(solution.information, expected, atol=1e-7 * np.abs(expected).max())
    np.testing.assert_allclose(solution.information, solution.information.T)


def test_rows_are_scaled_by_weight_over_sigma():
    matches = make_matches(n_edges=3, n_planes=2)
    rows = match_rows(matches)
    e, p = matches.edges, matches.planes
    expected = np.concatenate([np.repeat(e.weights / e.sigmas, 2), p.weights / p.sigmas])
    np.testing.assert_allclose(rows.scales, expected)
    assert rows.points.shape == (8, 3)


def plane_matches(distances, sigma=0.1):
    count = len(distances)
    return ScanMatches(
        EdgeMatches(*(np.zeros((0, 3)) for _ in range(3)), *(np.zeros(0) for _ in range(3)),
                    np.zeros(0, np.int64)),
        PlaneMatches(
            np.zeros((count, 3)),
            np.tile([0.0, 0.0, 1.0], (count, 1)),
            distances,
            distances,
            np.full(count, sigma),
            np.ones(count),
            np.arange(count),
        ),
    )  # fmt: skip


def test_the_kernel_scales_down_what_is_far_for_its_sigma_and_nothing_else():
    distances = np.array([0.01, -0.02, 0.05, -0.1, 0.13, 1.345, -13.45])
    rows = match_rows(plane_matches(distances), kernel_width=1.345)  # median 1 sigma
    scatter = 1.4826  # of a median of one sigma
    width = 0.1 * 1.345 * scatter
    expected = np.sqrt(width / np.maximum(np.abs(distances), width)) / 0.1
    np.testing.assert_allclose(rows.scales, expected)
    assert (rows.scales[:5] == 10.0).all()
    np.testing.assert_allclose(match_rows(plane_matches(distances)).scales, 10.0)
    rows = match_rows(plane_matches(distances), 1.345, "geman_mcclure")
    expected = 10.0 / (1.0 + (distances / (2.816 * width)) ** 2)
    np.testing.assert_allclose(rows.scales, expected)


def test_the_kernel_has_a_unit_of_its_own_far_from_the_optimum():
    """All distances large alike: nothing is an outlier, nothing is silenced."""
    rows = match_rows(plane_matches(np.full(9, 5.0)), kernel_width=1.345)
    np.testing.assert_allclose(rows.scales, 10.0)


def test_both_kernels_are_as_efficient_on_normal_noise():
    """Asymptotic efficiency of an M-estimator: E[psi']^2 / E[psi^2] (Huber, 1981)."""
    u = np.linspace(-12.0, 12.0, 24001)
    density = np.exp(-0.5 * u**2) / np.sqrt(2.0 * np.pi) * (u[1] - u[0])
    # The zeros keep the unit at one sigma.
    distances = 0.1 * np.concatenate([u, np.zeros(len(u))])
    for kernel in ("huber", "geman_mcclure"):
        rows = match_rows(plane_matches(distances), 1.345, kernel)
        psi = (0.1 * rows.scales[: len(u)]) ** 2 * u
        slope = np.gradient(psi, u)
        efficiency = (slope @ density) ** 2 / (psi**2 @ density)
        assert efficiency == pytest.approx(0.95, abs=1e-3)


def random_information(seed, rank=6):
    """Of rows in rad and m; directions beyond ``rank`` are free."""
    rng = np.random.default_rng(seed)
    vectors = np.linalg.qr(rng.normal(size=(6, 6)))[0][:, :rank]
    return vectors @ np.diag(10.0 ** rng.uniform(3, 6, rank)) @ vectors.T


def pose_prior(offset, sigmas):
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.asarray(sigmas, np.float64))
    return gtsam.PriorFactorPose3(POSE_KEY, TRUTH.retract(np.asarray(offset)), noise)


def test_fusing_nothing_changes_nothing():
    information = random_information(0)
    pose, after = fuse(TRUTH, information, [])
    assert difference(pose, TRUTH) < 1e-12
    np.testing.assert_allclose(after, information, atol=1e-9 * information.max())


@pytest.mark.parametrize("seed", range(4))
def test_what_is_fused_is_the_weighted_mean(seed):
    """L x + P (x - prior) = 0, to first order in what separates the two."""
    offset = 1e-4 * np.random.default_rng(seed).normal(size=6)
    information, sigmas = random_information(seed), np.full(6, 3e-3)
    pose, after = fuse(TRUTH, information, [pose_prior(offset, sigmas)])
    weight = np.diag(sigmas**-2.0)
    expected = np.linalg.solve(information + weight, weight @ offset)
    np.testing.assert_allclose(TRUTH.localCoordinates(pose), expected, atol=1e-7)
    scale = information.max() + weight.max()
    np.testing.assert_allclose(after, information + weight, atol=1e-3 * scale)


def test_what_is_fused_is_the_exact_minimum_far_away_too():
    """A prior half a radian and a metre off: the gradient of the sum is zero, numerically."""
    offset = np.array([0.3, -0.2, 0.4, 1.0, -0.5, 0.7])
    information = 1e3 * np.diag([3.0, 1, 2, 1, 4, 2]) + random_information(1)
    weight = 1e4
    at_prior = TRUTH.retract(offset)

    # A plain displacement of the position, in the map: its derivative is known exactly.
    noise = gtsam.noiseModel.Isotropic.Sigma(3, weight**-0.5)
    pose, _ = fuse(TRUTH, information, [gtsam.GPSFactor(POSE_KEY, at_prior.translation(), noise)])
    assert 0.01 < np.linalg.norm(pose.translation() - TRUTH.translation()) < 1.3

    def cost(step):
        moved = pose.retract(step)
        away = gtsam.Pose3.Logmap(TRUTH.between(moved))
        gps = moved.translation() - at_prior.translation()
        return 0.5 * (away @ information @ away + weight * gps @ gps)

    gradient = [(cost(1e-5 * axis) - cost(-1e-5 * axis)) / 2e-5 for axis in np.eye(6)]
    assert np.abs(gradient).max() < 1e-5 * cost(np.zeros(6))


def test_directions_without_information_are_taken_from_the_factors():
    information = random_information(2, rank=4)
    offset = np.array([1e-4, -2e-4, 1e-4, 2e-3, 1e-3, -1e-3])
    pose, after = fuse(TRUTH, information, [pose_prior(offset, np.full(6, 0.1))])
    values, vectors = np.linalg.eigh(information)
    free = vectors[:, :2]
    assert values[1] < 1e-9 * values[-1]
    moved = TRUTH.localCoordinates(pose)
    np.testing.assert_allclose(free.T @ moved, free.T @ offset, atol=2e-6)
    assert np.linalg.norm(vectors[:, 2:].T @ moved) < 0.2 * np.linalg.norm(offset)
    np.testing.assert_allclose(np.linalg.eigvalsh(after)[:2], 100.0, rtol=0.01)


def test_a_direction_that_nobody_knows_stays():
    """A height alone: the rest of a pose without any information is left where it is."""
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.01)
    there = TRUTH.translation() + np.array([0.1, 0.2, 0.3])
    pose, after = fuse(TRUTH, np.zeros((6, 6)), [gtsam.GPSFactor(POSE_KEY, there, noise)])
    np.testing.assert_allclose(pose.translation(), there, atol=1e-6)
    assert np.abs(TRUTH.localCoordinates(pose)[:3]).max() < 1e-9
    assert np.linalg.matrix_rank(after, tol=1.0) == 3
