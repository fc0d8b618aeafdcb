"""Factors: derivatives, equivalence of the stacked and per-match forms, bad input."""

import os
import subprocess
import sys

import gtsam
import numpy as np
import pytest
from support.jacobians import numerical
from support.matches import unit

from loam_gtsam import factors
from loam_gtsam.geometry import transform
from loam_gtsam.types import InputError

KEY = gtsam.symbol("x", 0)
POSES = [
    gtsam.Pose3(),
    gtsam.Pose3.Expmap(np.array([1e-7, -2e-7, 1e-7, 1e-6, 0, -1e-6])),
    gtsam.Pose3.Expmap(np.array([0.3, -0.5, 1.2, 4.0, -2.0, 1.0])),
    gtsam.Pose3.Expmap(np.array([0.0, 0.0, np.pi - 1e-3, 2000.0, -3000.0, 40.0])),
    gtsam.Pose3.Expmap(np.array([2.0, -2.0, 0.5, -1.0, 7.0, 0.2])),
]


def at(pose):
    values = gtsam.Values()
    values.insert(KEY, pose)
    return values


def expect_the_error_of_the_rows(rows, pose, rel):
    residual, _ = rows.residuals(pose)
    error = factors.scan_match_factor(KEY, rows).error(at(pose))
    assert error == pytest.approx(0.5 * residual @ residual, rel=rel)


def make_matches(rng, pose, n_lines=40, n_planes=60, noise=0.05):
    """Matches that a pose near ``pose`` satisfies."""
    lines = rng.uniform(-20, 20, (n_lines, 3))
    planes = rng.uniform(-20, 20, (n_planes, 3))
    rotation, translation = pose.rotation().matrix(), pose.translation()
    directions, normals = unit(rng, n_lines), unit(rng, n_planes)
    centres = lines @ rotation.T + translation + rng.normal(0, noise, (n_lines, 3))
    offsets = -np.einsum("ni,ni->n", normals, planes @ rotation.T + translation)
    offsets += rng.normal(0, noise, n_planes)
    weights = rng.uniform(0.1, 1.0, n_lines), rng.uniform(0.1, 1.0, n_planes)
    return lines, centres, directions, weights[0], planes, normals, offsets, weights[1]


@pytest.mark.parametrize("pose", POSES)
def test_jacobians_equal_numerical_derivatives(pose):
    rng = np.random.default_rng(1)
    point, centre, offset = rng.uniform(-20, 20, 3), rng.uniform(-20, 20, 3), 3.0
    for axis in [*np.eye(3), *-np.eye(3), *unit(rng, 4)]:

        def line(p, u=axis):
            return factors.point_to_line_residual(p, point, centre, u)

        def plane(p, n=axis):
            return factors.point_to_plane_residual(p, point, n, offset)

        for residual in (line, plane):
            expected = numerical(lambda p, f=residual: f(p)[0], pose)
            np.testing.assert_allclose(residual(pose)[1], expected, atol=2e-5)


def test_residuals_in_closed_form():
    turn = gtsam.Pose3(gtsam.Rot3.Rz(np.pi / 2), np.array([1.0, 0.0, 2.0]))
    # (1, 0, 0) goes to (1, 1, 2)
    point = np.array([1.0, 0.0, 0.0])
    residual, _ = factors.point_to_plane_residual(turn, point, np.array([0.0, 1.0, 0.0]), -0.25)
    np.testing.assert_allclose(residual, [0.75], atol=1e-12)
    centre, direction = np.array([0.0, 1.0, 50.0]), np.array([0.0, 0.0, 1.0])
    residual, _ = factors.point_to_line_residual(turn, point, centre, direction)
    np.testing.assert_allclose(np.linalg.norm(residual), 1.0)


def test_line_residual_is_loams_distance_and_smooth_on_the_line():
    rng = np.random.default_rng(2)
    for direction in [*unit(rng, 20), np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])]:
        point, centre = rng.normal(size=3), rng.normal(size=3)
        residual, _ = factors.point_to_line_residual(POSES[2], point, centre, direction)
        moved = POSES[2].transformFrom(point)
        distance = np.linalg.norm(np.cross(moved - centre, direction))
        np.testing.assert_allclose(np.linalg.norm(residual), distance, rtol=1e-10)
        on_line = POSES[2].transformTo(centre + 3 * direction)
        residual, jacobian = factors.point_to_line_residual(POSES[2], on_line, centre, direction)
        np.testing.assert_allclose(residual, 0, atol=1e-12)
        assert np.linalg.matrix_rank(jacobian) == 2


@pytest.mark.parametrize("pose", POSES)
def test_stacked_factor_equals_sum_of_match_factors(pose):
    rng = np.random.default_rng(3)
    sigma = 0.1
    lines, centres, directions, w_line, planes, normals, offsets, w_plane = make_matches(rng, pose)
    single = gtsam.NonlinearFactorGraph()
    for p, c, u, w in zip(lines, centres, directions, w_line, strict=True):
        noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma / w)
        single.add(factors.point_to_line_factor(KEY, p, c, u, noise))
    for p, n, d, w in zip(planes, normals, offsets, w_plane, strict=True):
        noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma / w)
        single.add(factors.point_to_plane_factor(KEY, p, n, d, noise))
    line_rows = factors.line_rows(lines, centres, directions, w_line, sigma)
    plane_rows = factors.plane_rows(planes, normals, offsets, w_plane, sigma)
    rows = factors.concatenate_rows([line_rows, plane_rows])
    stacked = gtsam.NonlinearFactorGraph()
    stacked.add(factors.scan_match_factor(KEY, rows))

    def solve(graph, start):
        params = gtsam.LevenbergMarquardtParams()
        params.setRelativeErrorTol(1e-15)
        params.setAbsoluteErrorTol(1e-15)
        result = gtsam.LevenbergMarquardtOptimizer(graph, at(start), params).optimize()
        return result.atPose3(KEY)

    for delta in (np.zeros(6), np.array([0.1, -0.2, 0.05, 0.4, 0.3, -0.5])):
        values = at(pose.retract(delta))
        assert stacked.error(values) == pytest.approx(single.error(values), rel=1e-9)
        ours, theirs = stacked.linearize(values), single.linearize(values)
        hessian, gradient = ours.hessian()
        expected_hessian, expected_gradient = theirs.hessian()
        scale = np.abs(expected_hessian).max()
        np.testing.assert_allclose(hessian, expected_hessian, atol=1e-10 * scale)
        atol = 1e-9 * np.abs(expected_gradient).max() + 1e-7
        np.testing.assert_allclose(gradient, expected_gradient, atol=atol)
    start = pose.retract(np.array([0.02, -0.02, 0.03, 0.1, 0.2, -0.1]))
    difference = solve(single, start).localCoordinates(solve(stacked, start))
    assert np.abs(difference).max() < 1e-8


def test_uncompressed_rows_agree_with_factor():
    rng = np.random.default_rng(4)
    lines, centres, directions, weights, *_ = make_matches(rng, POSES[2])
    rows = factors.line_rows(lines, centres, directions, weights, 0.1)
    expected = numerical(lambda p: rows.residuals(p)[0], POSES[4])
    np.testing.assert_allclose(rows.residuals(POSES[4])[1], expected, atol=1e-4)
    expect_the_error_of_the_rows(rows, POSES[4], 1e-10)


def test_a_basis_is_orthonormal_also_beside_a_nearly_vertical_line():
    """A pole leans a little: nearly straight up, nearly straight down, and exactly so."""
    for tilt in (0.0, 1e-9, 1e-6, 1e-3, 0.5, np.pi / 2):
        up = np.array([np.sin(tilt) * 0.6, np.sin(tilt) * 0.8, np.cos(tilt)])
        for direction in (up, -up):
            frame = np.vstack([direction, factors.complement_basis(direction[None])[0]])
            np.testing.assert_allclose(frame @ frame.T, np.eye(3), rtol=0, atol=1e-14)


def test_a_scan_far_from_the_map_origin_loses_no_digits():
    rng = np.random.default_rng(6)
    pose = gtsam.Pose3(POSES[2].rotation(), np.array([90_000.0, -40_000.0, 300.0]))
    _, _, _, _, planes, normals, offsets, weights = make_matches(rng, pose)
    rows = factors.plane_rows(planes, normals, offsets, weights, 0.1)
    expect_the_error_of_the_rows(rows, pose, 1e-8)


@pytest.mark.parametrize("turn", [gtsam.Rot3(), gtsam.Rot3.RzRyRx(0.3, 0.5, 0.7)])
@pytest.mark.parametrize("noise", [1e-3, 1e-4, 1e-5, 0.0])
@pytest.mark.parametrize("metres", [0.0, 1e5, 5e6])
def test_nor_does_one_in_a_corridor_whose_walls_hardly_fix_the_way_along_it(turn, noise, metres):
    rng = np.random.default_rng(8)
    pose = gtsam.Pose3(turn, turn.rotate(np.array([metres, 2.0, 3.0])))
    points = rng.uniform(-20.0, 20.0, (400, 3))
    normals = np.repeat(np.eye(3)[1:], 200, axis=0) + noise * rng.normal(size=(400, 3))
    normals = normals / np.linalg.norm(normals, axis=1)[:, None] @ turn.matrix().T
    offsets = rng.normal(0.0, 0.03, 400) - np.sum(normals * transform(pose.matrix(), points), 1)
    rows = factors.plane_rows(points, normals, offsets, np.ones(400), 0.03)
    expect_the_error_of_the_rows(rows, pose, 1e-7)


def test_rows_that_weigh_nothing_are_a_factor_that_says_nothing():
    rows = factors.plane_rows(np.eye(3), np.eye(3), np.ones(3), np.zeros(3), 1.0)
    factor = factors.scan_match_factor(KEY, rows)
    assert factor.error(at(POSES[2])) == 0.0
    assert np.all(factor.linearize(at(POSES[2])).information() == 0.0)


def test_nearly_parallel_planes_do_not_send_the_anchor_away():
    """Where rough ground alone is seen, its planes meet at a point far off, if at all."""
    rng = np.random.default_rng(7)
    points = np.column_stack([rng.uniform(-10, 10, (200, 2)), np.full(200, -1.7)])
    normals = np.column_stack([rng.normal(0, 1e-7, (200, 2)), np.ones(200)])
    offsets = 1.7 + rng.normal(0, 0.05, 200)
    rows = factors.plane_rows(points, normals, offsets, np.ones(200), 0.1)
    expect_the_error_of_the_rows(rows, gtsam.Pose3(), 1e-9)


def test_a_scan_is_one_factor_of_13_rows_however_many_matches_it_has():
    for count in (1, 5, 50):
        lines, centres, directions, weights, *_ = make_matches(np.random.default_rng(8), POSES[2])
        some = (part[:count] for part in (lines, centres, directions, weights))
        rows = factors.line_rows(*some, 0.1)
        assert factors.scan_match_factor(KEY, rows).dim() == 13


def test_rows_are_chosen_by_a_mask():
    lines, centres, directions, weights, *_ = make_matches(np.random.default_rng(9), POSES[2])
    rows = factors.line_rows(lines, centres, directions, weights, 0.1)
    chosen = np.arange(80) % 3 == 0
    residual, jacobian = rows.where(chosen).residuals(POSES[4])
    expected, expected_jacobian = rows.residuals(POSES[4])
    np.testing.assert_array_equal(residual, expected[chosen])
    np.testing.assert_array_equal(jacobian, expected_jacobian[chosen])


@pytest.mark.parametrize("number", [int, np.float32])
def test_rows_are_double_precision_whatever_is_given(number):
    threes = np.eye(3).astype(number)
    ones = np.ones(3, number)
    for rows in (
        factors.line_rows(threes, threes, threes, ones, ones),
        factors.plane_rows(threes, threes, ones, ones, ones),
        factors.plane_rows(threes.tolist(), threes.tolist(), [1, 1, 1], [1, 1, 1], 1),
    ):
        for name in ("points", "normals", "offsets", "scales"):
            assert getattr(rows, name).dtype == np.float64


def test_one_plane_leaves_three_directions_free():
    """A rank-deficient scan compresses without error and without inventing information."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-10, 10, (100, 2)), np.full(100, -1.7)])
    rows = factors.plane_rows(
        points, np.tile([0.0, 0.0, 1.0], (100, 1)), np.full(100, 1.7), np.ones(100), 0.1
    )
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factors.scan_match_factor(KEY, rows))
    values = at(gtsam.Pose3())
    hessian, _ = graph.linearize(values).hessian()
    eigenvalues = np.linalg.eigvalsh(hessian)
    assert (eigenvalues[:3] < 1e-6 * eigenvalues[-1]).all()
    assert (eigenvalues[3:] > 1e3).all()


VECTOR, UP, ROWS = [1, 2, 3], [0, 0, 1], np.ones((4, 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda n: factors.point_to_plane_factor(KEY, [1, 2], UP, 0.0, n(1)), "point: .*shape"),
        (lambda n: factors.point_to_plane_factor(KEY, VECTOR, [0, 0, 2], 0.0, n(1)),
         "normal: .*unit"),
        (lambda n: factors.point_to_plane_factor(KEY, VECTOR, UP, np.nan, n(1)), "offset: "),
        (lambda n: factors.point_to_plane_factor(KEY, VECTOR, UP, 0.0, n(2)), "noise: "),
        (lambda n: factors.point_to_line_factor(KEY, VECTOR, [0, np.inf, 1], UP, n(2)),
         "centre: .*infinite"),
        (lambda n: factors.point_to_line_factor(KEY, VECTOR, UP, [0, 0, 0], n(2)),
         "direction: .*unit"),
        (lambda n: factors.plane_rows([1, 2, 3], ROWS, np.ones(4), np.ones(4), 1), "points: "),
        (lambda n: factors.plane_rows(ROWS, ROWS[:3], np.ones(4), np.ones(4), 1),
         "normals: "),
        (lambda n: factors.line_rows(ROWS[:, :2], ROWS, ROWS, np.ones(4), 1), "points: "),
        (lambda n: factors.line_rows(ROWS, ROWS[:1], ROWS, np.ones(4), 1), r"centres: .*\(4, 3\)"),
        (lambda n: factors.line_rows(ROWS, ROWS, ROWS[:1], np.ones(4), 1), "directions: "),
        (lambda n: factors.line_rows(ROWS, ROWS, ROWS, [1], 1), r"weights: .*\(4,\)"),
        (lambda n: factors.plane_rows([[np.nan] * 3], [[0, 0, 1.0]], [0.0], [1.0], 1),
         "MatchRows.points: .*NaN"),
        (lambda n: factors.scan_match_factor(KEY, factors.plane_rows(
            np.empty((0, 3)), np.empty((0, 3)), [], [], 1)), "scan_match_factor: .*at least one"),
    ],
)  # fmt: skip
def test_faulty_shapes_are_errors(call, message):
    with pytest.raises(InputError, match="^" + message):
        call(lambda dim: gtsam.noiseModel.Isotropic.Sigma(dim, 1.0))


def test_a_direction_may_be_off_unit_length_by_rounding_alone():
    noise = gtsam.noiseModel.Unit.Create(1)
    for length in (1.0 - 5e-7, 1.0 + 5e-7):
        factors.point_to_plane_factor(KEY, VECTOR, [0, 0, length], 0.0, noise)
    for length in (1.0 - 2e-6, 1.0 + 2e-6):
        with pytest.raises(InputError, match=r"^normal: "):
            factors.point_to_plane_factor(KEY, VECTOR, [0, 0, length], 0.0, noise)


@pytest.mark.parametrize(
    ("residual", "message"),
    [
        (lambda v: (np.zeros(3), [np.zeros((2, 6))]), "residual: .*shape"),
        (lambda v: (np.ones(2), [np.zeros((6, 2))]), "Jacobian 0"),
        (lambda v: (np.ones(2), [np.zeros((2, 5))]), "Jacobian 0"),
        (lambda v: (np.ones(2), []), "expected 1 Jacobians, one per key"),
        (lambda v: (np.ones(2), [None]), "Jacobian 0"),
        (lambda v: np.ones(2), "expected .*Jacobian of each key.*got ndarray"),
        (lambda v: None, "expected .*Jacobian of each key.*got NoneType"),
        (lambda v: (np.ones(2), np.zeros((2, 6))), r"expected .*got \(ndarray, ndarray\)"),
        (lambda v: (np.array([0.0, np.nan]), [np.zeros((2, 6))]), "residual: .*NaN"),
        (lambda v: (["one", "two"], [np.zeros((2, 6))]), "residual: .*<U3"),
    ],
)
def test_a_users_faulty_factor_is_a_python_error(residual, message):
    factor = factors.checked_factor(gtsam.noiseModel.Unit.Create(2), [KEY], residual)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    values = at(gtsam.Pose3())
    with pytest.raises(InputError, match="^factor:? " + message):
        gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()


def test_a_users_sound_factor_solves():
    def height(values):
        pose = values.atPose3(KEY)
        row = np.zeros((1, 6))
        row[0, 3:] = pose.rotation().matrix()[2]
        return pose.translation()[2:] - 1.5, [row]

    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(KEY, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
    graph.add(factors.checked_factor(gtsam.noiseModel.Isotropic.Sigma(1, 1e-3), [KEY], height))
    values = at(gtsam.Pose3())
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize().atPose3(KEY)
    assert result.translation()[2] == pytest.approx(1.5, abs=1e-5)


@pytest.mark.parametrize("number", [int, np.float32])
def test_a_users_factor_may_return_other_numbers_than_doubles(number):
    row = np.array([[0, 0, 0, 0, 0, 1]], number)
    factor = factors.checked_factor(
        gtsam.noiseModel.Unit.Create(1), [KEY], lambda values: (np.array([2], number), [row])
    )
    values = at(gtsam.Pose3())
    assert factor.error(values) == 2.0
    np.testing.assert_array_equal(factor.linearize(values).jacobian()[0], row)


def test_checked_factor_takes_several_variables():
    other = gtsam.symbol("v", 0)

    def rest(values):
        return values.atVector(other), [np.zeros((3, 6)), np.eye(3)]

    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(KEY, gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6)))
    graph.add(factors.checked_factor(gtsam.noiseModel.Unit.Create(3), [KEY, other], rest))
    values = at(gtsam.Pose3())
    values.insert(other, np.array([1.0, 2.0, 3.0]))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    np.testing.assert_allclose(result.atVector(other), 0, atol=1e-9)


VARIABLES = {
    "Pose3": (gtsam.Pose3(), 6),
    "Rot3": (gtsam.Rot3(), 3),
    "Point3": (gtsam.Point3(1.0, 2.0, 3.0), 3),
    "Pose2": (gtsam.Pose2(1.0, 2.0, 0.5), 3),
    "Rot2": (gtsam.Rot2(0.5), 1),
    "Point2": (gtsam.Point2(1.0, 2.0), 2),
    "vector": (np.arange(7.0), 7),
    "double": (1.5, 1),
    "bias": (gtsam.imuBias.ConstantBias(), 6),
    "NavState": (gtsam.NavState(), 9),
    "Unit3": (gtsam.Unit3(), 2),
    "Cal3_S2": (gtsam.Cal3_S2(), 5),
    "Cal3Bundler": (gtsam.Cal3Bundler(), 3),
}


def of_variable(name, residual):
    """A graph of one checked factor on one variable, and its values."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(factors.checked_factor(gtsam.noiseModel.Unit.Create(1), [KEY], residual))
    values.insert(KEY, VARIABLES[name][0])
    return graph, values


@pytest.mark.parametrize("name", VARIABLES)
def test_a_factor_may_be_on_a_variable_of_any_type(name):
    dimension = VARIABLES[name][1]
    graph, values = of_variable(name, lambda v: (np.ones(1), [np.full((1, dimension), 2.0)]))
    jacobian = graph.linearize(values).jacobian()[0]
    np.testing.assert_array_equal(jacobian, np.full((1, dimension), 2.0))


def check_that_faulty_jacobians_are_refused():
    for name, (_, dimension) in VARIABLES.items():
        faulty = [(1, dimension + 1), (dimension + 1, 1), (0, 0), (dimension,), (1, 1, dimension)]
        for shape in faulty:
            graph, values = of_variable(name, lambda v, s=shape: (np.ones(1), [np.ones(s)]))
            message = rf"^factor Jacobian 0: expected \(1, {dimension}\)"
            with pytest.raises(InputError, match=message):
                graph.linearize(values)
            with pytest.raises(InputError, match=message):
                gtsam.GaussNewtonOptimizer(graph, values).optimize()


def test_a_jacobian_of_a_wrong_shape_is_a_python_error_and_no_crash_for_any_type_of_variable():
    """In a process of its own, for GTSAM ends the process when a shape slips through."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, __file__], env=env, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


if __name__ == "__main__":
    check_that_faulty_jacobians_are_refused()
