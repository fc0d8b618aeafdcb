"""The classical solvers: steps and optima of the factor graph, and what is theirs alone."""

from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares
from support import matches as made
from support.jacobians import numerical
from support.matches import TRUTH, difference

from loam_gtsam.config import Config, SolverConfig, preset
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.factors import scan_match_factor
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.mapper import Mapper, make_solver
from loam_gtsam.pipeline import run
from loam_gtsam.registration.matches import EdgeMatches, PlaneMatches, ScanMatches
from loam_gtsam.registration.report import status_of
from loam_gtsam.registration.solvers import POSE_KEY, GtsamSolver, MotionPrior, match_rows
from loam_gtsam.registration.solvers.classical import (
    ALoamSolver,
    ClassicalSolver,
    aloam_rows,
    degeneracy_projector,
    euler_jacobian,
    loam_rows,
)
from loam_gtsam.registration.solvers.scan_error import SeenGround, scan_error
from loam_gtsam.types import FrameStatus, InputError

OFFSET = np.array([0.02, -0.01, 0.02, 0.07, 0.13, -0.13])
SIX = np.eye(6)
make_matches = partial(made.make_matches, n_planes=200, sigma=1.0)


def measured(weights):
    """The distances, standard deviations, weights and indices of matches."""
    count = len(weights)
    return np.zeros(count), np.ones(count), weights, np.arange(count)


def planes_alone(points, normals, offsets, weights):
    edges = EdgeMatches(*[np.empty((0, 3))] * 3, *measured(np.empty(0)))
    return ScanMatches(edges, PlaneMatches(points, normals, offsets, *measured(weights)))


def floor_and_wall(n_wall, seed=0):
    """300 points of a floor, n_wall of a wall across x, some of a wall across y; pose: identity."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-10, 10, (500 + n_wall, 3))
    normals = np.repeat(np.eye(3), [n_wall, 200, 300], axis=0)
    offsets = -np.einsum("ij,ij->i", normals, points)
    return planes_alone(points, normals, offsets, np.ones(len(points)))


def solver(kind, **changes):
    """Without LOAM's projector, which finds a few hundred matches too few, unless asked for."""
    method = {GtsamSolver: "gtsam", ClassicalSolver: "loam", ALoamSolver: "aloam"}[kind]
    return kind(SolverConfig(**{"method": method, "degeneracy_threshold": 0.0} | changes))


def graph_step(matches, pose):
    """The Gauss-Newton step of the factor graph, in the package's tangent."""
    factor = scan_match_factor(POSE_KEY, match_rows(matches))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(factor)
    values.insert(POSE_KEY, pose)
    return graph.linearize(values).optimize().at(POSE_KEY)


def by_euler(pose, x):
    """Add to (rx, ry, rz, x, y, z) in LOAM's camera-like axes, written out as matrices there."""
    lidar_r_loam = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    r = lidar_r_loam.T @ pose.rotation().matrix() @ lidar_r_loam
    rx = np.arcsin(-r[1, 2]) + x[0]
    ry = np.arctan2(r[0, 2], r[2, 2]) + x[1]
    rz = np.arctan2(r[1, 0], r[1, 1]) + x[2]
    turned = (gtsam.Rot3.Ry(ry) * gtsam.Rot3.Rx(rx) * gtsam.Rot3.Rz(rz)).matrix()
    return gtsam.Pose3(
        gtsam.Rot3(lidar_r_loam @ turned @ lidar_r_loam.T),
        pose.translation() + lidar_r_loam @ x[3:],
    )


def faced(matches, pose):
    """The same matches with each line replaced by the plane through it that faces its point."""
    rows, p = loam_rows(matches, pose), matches.planes
    weights = np.concatenate([matches.edges.weights, p.weights])
    return planes_alone(rows.points, rows.normals, rows.offsets, weights)


@pytest.mark.parametrize("n_edges", [0, 60])
def test_one_step_of_loam_is_that_of_the_factor_graph(n_edges):
    """With edges, of the graph that has LOAM's single row for each of them."""
    pose = TRUTH.retract(OFFSET)
    matches = make_matches(n_edges=n_edges, noise=0.02)
    solution = solver(ClassicalSolver, iterations=1).solve(lambda pose: matches, pose)
    expected = graph_step(faced(matches, pose), pose)
    assert np.abs(expected).max() > 0.1
    moved = by_euler(pose, np.linalg.solve(euler_jacobian(pose), expected))
    assert difference(solution.map_T_lidar, moved) < 1e-9


def test_with_edges_the_step_is_not_that_of_two_rows():
    """One row knows nothing of the curvature around the line; documented in docs/classical.md."""
    pose, matches = TRUTH.retract(OFFSET), make_matches(n_edges=60, noise=0.02)
    two_rows, one_row = graph_step(matches, pose), graph_step(faced(matches, pose), pose)
    assert np.abs(two_rows - one_row).max() > 1e-4


def test_the_damping_is_that_of_ceres():
    """The first step solves (H + diag(H) / 1e4) x = -g."""
    pose, matches = TRUTH.retract(OFFSET), make_matches(noise=0.02)
    once = solver(ALoamSolver, iterations=1, inner_iterations=1, huber_delta=0.0)
    moved = once.solve(lambda pose: matches, pose).map_T_lidar
    r, j = aloam_rows(matches).residuals(pose)
    to_map = np.kron(np.eye(2), pose.rotation().matrix())
    j = j @ to_map.T
    h = j.T @ j
    x = np.linalg.solve(h + np.diag(h.diagonal()) / 1e4, -j.T @ r)
    expected = gtsam.Pose3(gtsam.Rot3.Expmap(x[:3]) * pose.rotation(), pose.translation() + x[3:])
    assert difference(moved, expected) < 1e-9
    assert difference(moved, pose.retract(graph_step(matches, pose))) > 1e-6


@pytest.mark.parametrize("n_edges", [0, 40])
@pytest.mark.parametrize("guess", [OFFSET, -3 * OFFSET])
def test_solved_to_convergence_the_optima_agree(n_edges, guess):
    matches = make_matches(n_edges=n_edges, noise=0.02)
    exact = {"rotation_tolerance_deg": 1e-9, "translation_tolerance": 1e-10, "step_sigmas": 0.0}
    loam, aloam, graph = (
        solver(kind, iterations=60, **exact, **more).solve(
            lambda pose: matches, TRUTH.retract(guess)
        )
        for kind, more in (
            (ClassicalSolver, {}),
            (ALoamSolver, {"huber_delta": 0.0, "cost_tolerance": 0.0}),
            (GtsamSolver, {}),
        )
    )
    assert difference(TRUTH, graph.map_T_lidar) > 1e-4  # the noise moved it
    assert difference(loam.map_T_lidar, graph.map_T_lidar) < 1e-6
    assert difference(aloam.map_T_lidar, graph.map_T_lidar) < 1e-6
    assert loam.error_after == pytest.approx(graph.error_after, rel=1e-9)
    assert aloam.error_after == pytest.approx(graph.error_after, rel=1e-9)
    assert loam.error_before == pytest.approx(graph.error_before, rel=1e-9)
    np.testing.assert_allclose(aloam.information, graph.information, rtol=1e-5, atol=1e-2)


@pytest.mark.parametrize("shorten", [False, True])
def test_on_edges_alone_loam_goes_to_and_fro_unless_steps_are_shortened(shorten):
    """A row per edge is half of what is known about it: the step is twice too long."""
    matches, exact = make_matches(n_edges=200, n_planes=0, noise=0.02), {"step_sigmas": 0.0}
    still = {"rotation_tolerance_deg": 1e-9, "translation_tolerance": 1e-10}
    loam, graph = (
        solver(kind, iterations=60, shorten_steps=shorten, **exact, **still).solve(
            lambda pose: matches, TRUTH.retract(OFFSET)
        )
        for kind in (ClassicalSolver, GtsamSolver)
    )
    assert (graph.converged, loam.converged) == (True, shorten)
    if shorten:
        assert difference(loam.map_T_lidar, graph.map_T_lidar) < 1e-6
        assert loam.solver_iterations > loam.iterations
    else:
        assert 1e-4 < difference(loam.map_T_lidar, graph.map_T_lidar) < 0.1


# -- what all solvers promise ----------------------------------------------------------------------

BOTH = pytest.mark.parametrize("kind", [ClassicalSolver, ALoamSolver])


@BOTH
def test_a_prior_is_refused_not_ignored(kind):
    prior = gtsam.PriorFactorPose3(POSE_KEY, TRUTH, gtsam.noiseModel.Unit.Create(6))
    matches = make_matches()
    with pytest.raises(InputError, match=r"priors: .* got 1; use solver.method: gtsam"):
        solver(kind).solve(lambda pose: matches, TRUTH, [prior])


def test_loam_stops_when_the_step_is_small_and_aloam_never():
    def solve(kind, **changes):
        matches = make_matches(noise=0.02)
        return solver(kind, iterations=7, **changes).solve(lambda pose: matches, TRUTH)

    wide = {"rotation_tolerance_deg": 50.0, "translation_tolerance": 5.0}
    for changes, converged, loam_iterations in (
        (wide, True, 1),
        (wide | {"rotation_tolerance_deg": 0.0}, False, 7),
        (wide | {"translation_tolerance": 0.0}, False, 7),
    ):
        loam, aloam = solve(ClassicalSolver, **changes), solve(ALoamSolver, **changes)
        assert (loam.converged, loam.iterations) == (converged, loam_iterations)
        assert (aloam.converged, aloam.iterations) == (converged, 7)


def test_euler_jacobian_is_the_derivative_in_loams_own_axes():
    pose = TRUTH
    expected = numerical(lambda x: pose.localCoordinates(by_euler(pose, x)))
    np.testing.assert_allclose(euler_jacobian(pose), expected, atol=1e-8)


def test_loam_rows_are_distances_with_their_gradients_times_s():
    matches, pose = make_matches(noise=0.1), TRUTH.retract(OFFSET)
    e, p = matches.edges, matches.planes

    def distances(step):
        moved = pose.retract(step)
        away = moved.transformFrom(e.points.T).T - e.centres
        planes = np.einsum("ij,ij->i", p.normals, moved.transformFrom(p.points.T).T) + p.offsets
        lines = np.linalg.norm(np.cross(away, e.directions), axis=1)
        return np.concatenate([e.weights * lines, p.weights * planes])

    residual, jacobian = loam_rows(matches, pose).residuals(pose)
    np.testing.assert_allclose(residual, distances(np.zeros(6)), atol=1e-12)
    np.testing.assert_allclose(jacobian, numerical(distances), atol=1e-5)


def test_a_point_on_its_line_adds_nothing_and_divides_by_nothing():
    line = np.array([[0.0, 0.0, 1.0]])
    base = make_matches(n_edges=0).planes
    on_line = EdgeMatches(line * 2.0, line, line, *measured(np.ones(1)))
    residual, jacobian = loam_rows(ScanMatches(on_line, base), gtsam.Pose3()).residuals(
        gtsam.Pose3()
    )
    assert residual[0] == 0.0
    assert not jacobian[0].any()


def test_information_is_that_of_the_rows_at_the_pose():
    matches = make_matches(noise=0.05)
    for kind in (ClassicalSolver, ALoamSolver):
        solution = solver(kind, iterations=1, huber_delta=0.0).solve(
            lambda pose: matches, TRUTH.retract(OFFSET)
        )
        pose = solution.map_T_lidar
        rows = loam_rows(matches, pose) if kind is ClassicalSolver else aloam_rows(matches)
        _, j = rows.residuals(pose)
        np.testing.assert_allclose(solution.information, j.T @ j, rtol=1e-9, atol=1e-6)


def test_weak_directions_below_the_threshold_stay_and_others_move():
    """40 rows across x make an eigenvalue of 40."""
    matches, guess = floor_and_wall(40), gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.2, 0.1]))

    def solve(threshold):
        frozen = solver(ClassicalSolver, degeneracy_threshold=threshold)
        return frozen.solve(lambda pose: matches, guess).map_T_lidar

    free = solve(0.0)
    assert difference(free, gtsam.Pose3()) < 1e-6
    assert difference(solve(10.0), free) < 1e-12
    held = solve(100.0)
    np.testing.assert_allclose(held.translation(), [0.3, 0.0, 0.0], atol=0.02)
    np.testing.assert_allclose(held.translation()[1:], 0.0, atol=0.01)
    assert held.x() > 0.28


@pytest.mark.parametrize("kind", [ClassicalSolver, ALoamSolver])
@pytest.mark.parametrize("n_wall", [4, 40])
def test_what_is_not_solved_is_said_and_known_no_better_than_the_expected_motion(kind, n_wall):
    """Four rows across x are fewer than ``min_aligned``, 8; forty are enough."""
    guess = gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.2, 0.1]))
    motion = MotionPrior(guess, np.diag([1e4, 1e4, 1e4, 25.0, 25.0, 25.0]))

    def solve(**changes):
        classical = solver(kind, iterations=20, **changes)
        return classical.solve(lambda pose: floor_and_wall(n_wall), guess, motion=motion)

    found, believed = solve(), solve(degeneracy="off")
    assert believed.weak is None
    assert abs(believed.map_T_lidar.x()) < 1e-4
    assert found.localizability is not None
    if n_wall == 40:
        assert found.weak is None
        assert difference(found.map_T_lidar, believed.map_T_lidar) < 1e-9
        assert status_of(found, "")[0] is FrameStatus.OK
        return
    np.testing.assert_allclose(found.map_T_lidar.translation(), [0.3, 0.0, 0.0], atol=0.02)
    np.testing.assert_allclose(found.weak @ found.weak, found.weak, atol=1e-9)
    assert found.n_weak == 1
    assert abs(found.weak[3, 3]) > 0.99
    assert status_of(found, "")[0] is FrameStatus.DEGENERATE
    config = Config().covariance
    error = scan_error(found, np.inf, SeenGround(config.ground_cell), config, with_priors=False)
    told = np.sqrt(np.diag(error.covariance))
    assert 0.15 < told[3] < 0.25  # 1 / sqrt(25)
    assert max(told[4:]) < 0.1
    np.testing.assert_allclose(error.expected[3, 3], 1.0, atol=0.05)


def test_what_loams_threshold_projects_out_is_said_too():
    guess = gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.2, 0.1]))
    motion = MotionPrior(guess, 25.0 * SIX)
    for n_wall, said in ((40, True), (200, False)):
        loam = solver(ClassicalSolver, degeneracy_threshold=100.0)
        found = loam.solve(lambda pose, n=n_wall: floor_and_wall(n), guess, motion=motion)
        assert (found.weak is not None) == said
        silent = loam.solve(lambda pose, n=n_wall: floor_and_wall(n), guess)
        assert silent.weak is None
        assert found.map_T_lidar.equals(silent.map_T_lidar, 1e-15)


def test_the_projector_is_that_of_the_first_association():
    guess, asked = gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.2, 0.1])), []

    def solve(first, later):
        asked.clear()

        def associate(pose):
            asked.append(pose)
            return floor_and_wall(first if len(asked) == 1 else later)

        weak = solver(ClassicalSolver, degeneracy_threshold=100.0)
        return weak.solve(associate, guess).map_T_lidar.x()

    assert abs(solve(300, 300)) < 1e-6
    assert solve(40, 300) > 0.28
    assert abs(solve(300, 40)) < 1e-6


def test_projector_keeps_what_is_known_and_the_published_one_does_not():
    rng = np.random.default_rng(3)
    basis, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    normal = basis @ np.diag([1.0, 99.0, 101.0, 1e3, 1e4, 1e5]) @ basis.T
    correct = degeneracy_projector(normal, 100.0)
    np.testing.assert_allclose(correct @ basis[:, :2], 0.0, atol=1e-9)
    np.testing.assert_allclose(correct @ basis[:, 2:], basis[:, 2:], atol=1e-9)
    wrong = degeneracy_projector(normal, 100.0, published=True)
    assert np.abs(wrong @ basis[:, :2]).max() > 0.1
    for published in (False, True):
        whole = degeneracy_projector(normal, 0.5, published=published)
        np.testing.assert_allclose(whole, SIX, atol=1e-9)


def test_the_published_projector_is_selectable():
    matches, guess = floor_and_wall(40), gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.2, 0.1]))
    correct, published = (
        solver(ClassicalSolver, degeneracy_threshold=100.0, degeneracy_projector=name)
        .solve(lambda pose: matches, guess)
        .map_T_lidar
        for name in ("correct", "published")
    )
    assert difference(correct, published) > 0.01


def test_a_direction_without_any_row_is_no_error():
    matches, guess = floor_and_wall(0), gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.2, 0.1]))
    solution = solver(ClassicalSolver).solve(lambda pose: matches, guess)
    np.testing.assert_allclose(solution.map_T_lidar.translation()[1:], 0.0, atol=1e-6)
    assert np.isfinite(solution.map_T_lidar.matrix()).all()


def with_outliers(n_edges):
    matches = make_matches(n_edges=n_edges, noise=0.02)
    ones = np.ones(len(matches.planes))
    shifted = matches.planes.offsets + np.where(np.arange(len(ones)) % 8 == 0, 0.7, 0.0)
    return ScanMatches(
        replace(matches.edges, weights=np.ones(n_edges)),
        replace(matches.planes, weights=ones, offsets=shifted),
    )


def test_the_optimum_is_that_of_scipys_huber_loss():
    matches = with_outliers(0)
    rows = aloam_rows(matches)
    reference = least_squares(
        lambda x: rows.residuals(TRUTH.retract(x))[0],
        np.zeros(6),
        loss="huber",
        f_scale=0.1,
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-12,
    )
    exact = solver(ALoamSolver, iterations=10, inner_iterations=10, cost_tolerance=0.0)
    solution = exact.solve(lambda pose: matches, TRUTH.retract(OFFSET))
    assert difference(solution.map_T_lidar, TRUTH.retract(reference.x)) < 1e-6
    assert solution.error_after == pytest.approx(reference.cost, rel=1e-9)
    plain = solver(ALoamSolver, huber_delta=0.0).solve(lambda pose: matches, TRUTH)
    assert difference(solution.map_T_lidar, TRUTH) < 0.5 * difference(plain.map_T_lidar, TRUTH)


def test_the_loss_is_on_the_distance_of_an_edge_not_on_its_two_rows():
    """(0.09, 0.09) is 0.127 from the line: above a delta of 0.1, though neither row is."""
    line = np.array([[0.0, 0.0, 1.0]])
    point = np.array([[0.09, 0.09, 3.0]])
    far = EdgeMatches(point, np.zeros((1, 3)), line, *measured(np.ones(1)))
    planes = floor_and_wall(100).planes
    solution = solver(ALoamSolver, iterations=1).solve(
        lambda pose: ScanMatches(far, planes), gtsam.Pose3()
    )
    distance = np.hypot(0.09, 0.09)
    assert solution.error_before == pytest.approx(0.1 * distance - 0.5 * 0.1**2, rel=1e-9)


def test_a_step_that_raises_the_cost_is_not_taken_but_damped():
    """Seven planes that contradict one another by metres."""
    matches = make_matches(n_edges=0, n_planes=7, noise=3.0)

    def cost(pose):
        return 0.5 * np.sum(aloam_rows(matches).residuals(pose)[0] ** 2)

    def solve(inner):
        once = solver(
            ALoamSolver, min_matches=6, iterations=1, inner_iterations=inner, huber_delta=0.0
        )
        return once.solve(lambda pose: matches, TRUTH)

    assert cost(TRUTH.retract(graph_step(matches, TRUTH))) > cost(TRUTH)
    rejected = solve(1)
    assert rejected.map_T_lidar.equals(TRUTH, 0.0)
    assert rejected.error_after == rejected.error_before == pytest.approx(cost(TRUTH))
    assert solve(30).error_after < 0.1 * cost(TRUTH)


def test_the_last_small_step_is_not_taken():
    matches = make_matches(noise=0.02)

    def solve(tolerance):
        once = solver(ALoamSolver, iterations=1, inner_iterations=20, cost_tolerance=tolerance)
        return once.solve(lambda pose: matches, TRUTH)

    assert solve(1.0).map_T_lidar.equals(TRUTH, 0.0)
    assert solve(1.0).solver_iterations == 1
    assert not solve(1e-6).map_T_lidar.equals(TRUTH, 1e-5)
    assert 1 < solve(1e-6).solver_iterations < 20


@pytest.mark.parametrize(
    ("name", "kind"), [("default", GtsamSolver), ("loam", ClassicalSolver), ("aloam", ALoamSolver)]
)
def test_a_preset_names_its_solver(name, kind):
    config = preset(name)
    assert type(make_solver(config.solver)) is kind
    assert type(Mapper(config).solver) is kind


@pytest.mark.parametrize("name", ["loam", "aloam"])
def test_a_preset_maps_raw_sweeps(name):
    world = SimulatedWorld("street_loop", frames=10, columns=900)
    result = run(world, preset(name))
    assert all(u.status.solved for u in result.updates[1:])
    there = world.truth.map_T_lidar[:10]
    expected = np.linalg.inv(there[0]) @ there
    assert np.linalg.norm(expected[-1, :3, 3]) > 0.3
    assert np.linalg.norm((result.trajectory.map_T_lidar - expected)[:, :3, 3], axis=1).max() < 0.12
    assert np.linalg.eigvalsh(result.updates[-1].information).min() > 1.0


class Counting(GtsamSolver):
    """The default solver, which counts its solves."""

    solves = 0

    def solve(self, *arguments):
        self.solves += 1
        return super().solve(*arguments)


@pytest.mark.parametrize("model", ["constant", "predicted"])
def test_with_a_predicted_motion_the_first_sweeps_are_not_registered_anew(model):
    config = Config().changed({"deskew.model": model})
    counting = Counting(config.solver)
    mapper = Mapper(config, counting)
    for scan in SimulatedWorld("room", frames=3, columns=300):
        mapper.register(extract_features(scan, config))
    assert (counting.solves > 2) is (model == "constant")
