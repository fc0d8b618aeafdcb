"""The per-frame solve: known poses, the stop rule, limits, priors, information."""

import gtsam
import numpy as np
import pytest
from support.matches import TRUTH, difference, make_matches

from loam_gtsam.config import SolverConfig
from loam_gtsam.registration.matches import EdgeMatches, PlaneMatches, ScanMatches
from loam_gtsam.registration.solvers import (
    POSE_KEY,
    GtsamSolver,
    fuse,
    match_rows,
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


# -- the pose --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n_edges", "n_planes"), [(40, 120), (60, 0), (0, 200)])
def test_recovers_a_known_pose(n_edges, n_planes):
    matches = make_matches(n_edges=n_edges, n_planes=n_planes)
    solution = GtsamSolver(CONFIG).solve(lambda pose: matches, TRUTH.retract(OFFSET))
    assert difference(solution.map_T_lidar, TRUTH) < 1e-9
    assert solution.solved
    assert solution.converged
    assert solution.error_after < 1e-6 < solution.error_before
    assert 2 <= solution.iterations <= CONFIG.iterations
    assert solution.solver_iterations >= solution.iterations
    assert solution.matches is matches


def test_far_from_the_map_origin_too():
    truth = gtsam.Pose3(TRUTH.rotation(), np.array([8000.0, -6000.0, 100.0]))
    matches = make_matches(truth)
    solution = GtsamSolver(CONFIG).solve(lambda pose: matches, truth.retract(OFFSET))
    assert difference(solution.map_T_lidar, truth) < 1e-7


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


def test_matches_are_asked_for_at_the_current_pose():
    asked = []

    def associate(pose):
        asked.append(pose)
        return make_matches(noise=0.02, seed=len(asked))  # they change: it cannot settle at once

    guess = TRUTH.retract(OFFSET)
    solution = GtsamSolver(changed(iterations=3)).solve(associate, guess)
    assert len(asked) == solution.iterations
    assert same(asked[0], guess)
    assert all(difference(a, b) > 1e-6 for a, b in zip(asked[1:], asked[:-1], strict=True))


def test_the_same_input_gives_the_same_bits():
    matches = make_matches(noise=0.02)
    a, b = (
        GtsamSolver(CONFIG).solve(lambda pose: matches, TRUTH.retract(OFFSET)) for _ in range(2)
    )
    assert a.map_T_lidar.matrix().tobytes() == b.map_T_lidar.matrix().tobytes()
    assert a.information.tobytes() == b.information.tobytes()
    assert (a.error_before, a.error_after) == (b.error_before, b.error_after)


# -- when it stops ---------------------------------------------------------------------------------


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


def test_too_few_matches_give_the_guess_back():
    guess = TRUTH.retract(OFFSET)

    def solve(least):
        return GtsamSolver(changed(min_matches=least)).solve(
            lambda pose: make_matches(n_edges=10, n_planes=40), guess
        )

    assert solve(50).solved
    refused = solve(51)
    assert (refused.solved, refused.converged) == (False, False)
    assert same(refused.map_T_lidar, guess)
    assert len(refused.matches) == 50
    assert (refused.iterations, refused.solver_iterations) == (1, 0)
    np.testing.assert_array_equal(refused.information, np.zeros((6, 6)))


def test_matches_lost_on_the_way_give_the_guess_back_too():
    asked = []

    def associate(pose):
        asked.append(pose)
        return make_matches(n_planes=0 if len(asked) == 2 else 120, noise=0.02)

    guess = TRUTH.retract(OFFSET)
    refused = GtsamSolver(CONFIG).solve(associate, guess)
    assert (refused.solved, refused.iterations) == (False, 2)
    assert same(refused.map_T_lidar, guess)


# -- priors and information ------------------------------------------------------------------------


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
    rows, pose, step = match_rows(matches), solution.map_T_lidar, 1e-6
    numerical = np.stack(
        [
            (rows.residuals(pose.retract(step * axis))[0]
             - rows.residuals(pose.retract(-step * axis))[0]) / (2 * step)
            for axis in np.eye(6)
        ],
        axis=1,
    )  # fmt: skip
    expected = numerical.T @ numerical
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


# -- factors that come after the solve -------------------------------------------------------------


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


def test_fusing_twice_gives_the_same_bits():
    arguments = TRUTH, random_information(3), [pose_prior(OFFSET, np.full(6, 0.1))]
    (a, one), (b, other) = (fuse(*arguments) for _ in range(2))
    assert same(a, b)
    assert one.tobytes() == other.tobytes()
