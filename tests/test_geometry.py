"""Geometry on arrays: against GTSAM, numpy.linalg.eigh and closed forms."""

import gtsam
import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from loam_gtsam.geometry import (
    as_points,
    as_stamps,
    as_vector,
    checked_pose,
    find_in_sorted,
    fit_lines,
    fit_planes,
    integrated,
    inverse_pose,
    moments,
    move_points,
    parallel_sum,
    symmetric_eigenvalues,
    symmetric_eigenvector,
    voxel_filter,
    voxel_keys,
)
from loam_gtsam.types import InputError

RATES = (0.0, 1e-12, 1e-10, 0.9e-9, 1.1e-9, 1e-8, 1e-6, 1e-3, 0.5, 8.0, 60.0)
AXES = [*np.eye(3), np.array([1.0, -2.0, 2.0]) / 3.0]


def packed(matrices):
    """(N, 3, 3) as the (6, N) of the geometry module."""
    return matrices[:, [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]].T


def same_axis(a, b):
    """Sine of the angle between unit vectors, whose signs are arbitrary; (3, N) each."""
    return np.linalg.norm(np.cross(a, b, axis=0), axis=0)


@pytest.mark.parametrize("rate", RATES)
def test_move_points_equals_the_exponential_map_point_by_point(rate):
    rng = np.random.default_rng(1)
    points, times = rng.uniform(-100, 100, (12, 3)), rng.uniform(-0.2, 0.2, 12)
    times[0] = 0.0
    for axis in AXES:
        twist = np.concatenate([rate * axis, [20.0, -3.0, 1.0]])
        moves = (gtsam.Pose3.Expmap(twist * t) for t in times)
        expected = [move.transformFrom(p) for move, p in zip(moves, points, strict=True)]
        atol = 2e-11 + 25 * (rate < 1e-9) * rate
        np.testing.assert_allclose(move_points(points, twist, times), expected, rtol=0, atol=atol)


@pytest.mark.parametrize("rate", [1.01e-9, 1e-8, 1e-7, 1e-6])
def test_a_slow_turn_keeps_its_digits(rate):
    """The path bends by |w| |v| t^2 / 2; 1 - cos(|w| t) would round it to nothing."""
    moved = move_points(np.zeros((1, 3)), np.array([0, 0, rate, 20.0, 0, 0]), np.array([1.0]))
    assert moved[0, 1] == pytest.approx(0.5 * rate * 20.0, rel=1e-9)


def test_move_points_leaves_its_input_alone_and_takes_float32_and_none():
    points = np.arange(6, dtype=np.float32).reshape(2, 3)
    twist, times = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]), np.array([0.1, 0.2])
    before = points.copy()
    moved = move_points(points, twist, times)
    assert moved.dtype == np.float64
    assert not np.allclose(moved, points)
    np.testing.assert_array_equal(points, before)
    assert move_points(points[:0], twist, times[:0]).shape == (0, 3)
    still = move_points(points, np.zeros(6), times)
    np.testing.assert_array_equal(still, points)
    assert not np.shares_memory(still, points)


def test_the_inverse_of_a_pose_undoes_it_for_one_and_for_many():
    poses = [gtsam.Pose3.Expmap(v) for v in np.random.default_rng(9).normal(0, 2, (5, 6))]
    matrices = np.array([pose.matrix() for pose in poses])
    for matrix, inverse, pose in zip(matrices, inverse_pose(matrices), poses, strict=True):
        np.testing.assert_array_equal(inverse, inverse_pose(matrix))
        np.testing.assert_allclose(inverse, pose.inverse().matrix(), atol=1e-14)


@pytest.mark.parametrize(
    ("check", "value", "message"),
    [
        (as_points, np.zeros((7, 4)), r"scan: expected \(N, 3\) numbers, got shape \(7, 4\)"),
        (as_points, [[0, 0, 0], [0, np.nan, np.inf]], "scan: .*2 NaN or infinite ones of 6"),
        (as_points, [["a", "b", "c"]], "scan: expected .* numbers, got .*<U1"),
        (as_points, [[1, 2, 3], [4, 5]], "scan: expected an array"),
        (as_vector, np.zeros(2), r"scan: expected \(3,\) numbers, got shape \(2,\)"),
        (as_vector, None, "scan: .*object"),
        (as_stamps, [0.1, 0.2], r"scan: expected \(N,\) integer nanoseconds.*float64; .*\* 1e9"),
        (as_stamps, np.zeros((2, 1), int), r"scan: expected \(N,\).*\(2, 1\)"),
    ],
)
def test_a_wrong_array_is_refused_by_its_name(check, value, message):
    with pytest.raises(InputError, match="^" + message):
        check(value, "scan")


@pytest.mark.parametrize(("off", "right"), [(0.0, True), (4e-6, True), (6e-6, False)])
def test_axes_of_a_pose_may_be_rounded(off, right):
    rotation = gtsam.Rot3.RzRyRx(0.3, -1.0, 2.0).matrix() * (1.0 + off)
    pose = gtsam.Pose3(gtsam.Rot3(rotation), np.ones(3))
    if right:
        assert checked_pose(pose, "here") is pose
        return
    with pytest.raises(InputError, match=r"here: .* 1.2e-05 off, with determinant 1; "):
        checked_pose(pose, "here")


def test_a_right_array_becomes_float64_or_int64_and_is_not_copied_if_it_is_so_already():
    points, stamps = np.ones((2, 3)), np.arange(3)
    assert as_points(points, "scan") is points
    assert as_stamps(stamps, "stamps") is stamps
    assert as_points([[1, 2, 3]], "scan").dtype == np.float64
    assert as_stamps([], "stamps").dtype == np.int64
    assert as_vector(np.arange(5), "values", 5).tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


def matrices_of(kind, rng):
    if kind == "random":
        a = rng.normal(size=(200, 3, 3))
        return a + a.swapaxes(1, 2)
    if kind == "covariance":
        a = rng.normal(size=(200, 3, 5)) * rng.uniform(1e-3, 10, (200, 3, 1))
        return a @ a.swapaxes(1, 2)
    if kind in ("rank 1", "rank 2"):
        a = rng.normal(size=(200, 3, int(kind[-1])))
        return a @ a.swapaxes(1, 2)
    if kind == "diagonal":
        return np.stack([np.diag(d) for d in rng.permuted(np.tile([1.0, 2, 5], (20, 1)), axis=1)])
    if kind == "isotropic":
        return np.eye(3)[None] * rng.uniform(0.1, 10, (20, 1, 1))
    return np.zeros((3, 3, 3))


@pytest.mark.parametrize(
    "kind", ["random", "covariance", "rank 1", "rank 2", "diagonal", "isotropic", "zero"]
)
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_eigenvalues_and_vectors_equal_eigh(kind, scale):
    matrices = scale * matrices_of(kind, np.random.default_rng(2))
    expected, vectors = np.linalg.eigh(matrices)
    size = np.abs(expected).max(axis=1)
    found = symmetric_eigenvalues(packed(matrices))
    # Half the digits where two eigenvalues meet: the price of the closed form.
    np.testing.assert_allclose(found.T / np.maximum(size, 1e-300)[:, None],
                               expected / np.maximum(size, 1e-300)[:, None], atol=3e-8)  # fmt: skip
    assert (np.diff(found, axis=0) >= -1e-15 * size).all()
    for which in (0, 2):
        vector = symmetric_eigenvector(packed(matrices), found[which])
        np.testing.assert_allclose(np.linalg.norm(vector, axis=0), 1.0, atol=1e-12)
        gap = np.abs(expected[:, which] - expected[:, 1]) > 0.05 * size
        assert gap.any() or kind in ("isotropic", "zero", "rank 1")
        assert (same_axis(vector[:, gap], vectors[gap, :, which].T) < 1e-6).all()


def test_moments_are_those_of_numpy_and_leave_the_input_alone():
    rng = np.random.default_rng(3)
    groups = rng.normal(size=(4, 6, 3))
    # This memory order is the one the computation works in: it must copy all the same.
    groups = np.ascontiguousarray(groups.transpose(2, 1, 0)).transpose(2, 1, 0)
    before = groups.copy()
    means, covariance = moments(groups)
    np.testing.assert_array_equal(groups, before)
    np.testing.assert_allclose(means.T, groups.mean(axis=1), atol=1e-15)
    expected = np.stack([np.cov(group.T, bias=True) for group in groups])
    np.testing.assert_allclose(covariance, packed(expected), atol=1e-14)


@pytest.mark.parametrize("centre", [(0, 0, 0), (3, -4, 5), (1e4, -1e4, 1e3)])
@pytest.mark.parametrize("axis", AXES)
def test_lines_in_closed_form(axis, centre):
    group = np.array(centre) + np.outer([-0.4, -0.2, 0.0, 0.2, 0.4], axis)
    centres, directions, eigenvalues = fit_lines(group[None])
    np.testing.assert_allclose(centres[:, 0], centre, atol=1e-11)
    assert same_axis(directions, axis[:, None])[0] < 1e-7
    np.testing.assert_allclose(eigenvalues[:, 0], [0, 0, 0.08], atol=1e-8)


@pytest.mark.parametrize("centre", [(0, 0, 0), (3, -4, 5), (1e4, -1e4, 1e3)])
@pytest.mark.parametrize("normal", AXES)
def test_planes_in_closed_form(normal, centre):
    """Through the origin too, where LOAM's form n.q = -1 has no answer."""
    wide = np.cross(normal, [0.6, 0.0, 0.8])
    wide /= np.linalg.norm(wide)
    narrow = np.cross(normal, wide)
    cross = np.array([[1, 0], [-1, 0], [0, 0.5], [0, -0.5], [0, 0]])
    group = np.array(centre) + cross @ np.stack([wide, narrow])
    centres, normals, directions, eigenvalues = fit_planes(group[None])
    np.testing.assert_allclose(centres[:, 0], centre, atol=1e-11)
    assert same_axis(normals, normal[:, None])[0] < 1e-7
    assert same_axis(directions, wide[:, None])[0] < 1e-7
    np.testing.assert_allclose(eigenvalues[:, 0], [0, 0.1, 0.4], atol=1e-8)


def test_identical_points_and_no_groups_give_finite_unit_vectors():
    centres, directions, eigenvalues = fit_lines(np.full((2, 5, 3), 7.0))
    np.testing.assert_array_equal(centres, 7.0)
    np.testing.assert_array_equal(eigenvalues, 0.0)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=0), 1.0)
    assert [part.shape for part in fit_planes(np.empty((0, 5, 3)))] == [(3, 0)] * 4


def reference_filter(points, size):
    """Centroids by a dictionary, in order of the voxels."""
    voxels = {}
    for point in points:
        voxels.setdefault(tuple(np.floor(point[:3] / size).astype(int)), []).append(point)
    return np.array([np.mean(voxels[key], axis=0) for key in sorted(voxels)])


@pytest.mark.parametrize("columns", [3, 4, 5])
@pytest.mark.parametrize("size", [0.2, 0.4, 3.0])
def test_voxel_filter_equals_a_dictionary(columns, size):
    rng = np.random.default_rng(5)
    points = rng.uniform(-2, 2, (400, columns))  # negative coordinates too; the rest is averaged
    expected = reference_filter(points, size)
    found = voxel_filter(points, size)
    assert 1 < len(expected) < 400
    np.testing.assert_allclose(found, expected, atol=1e-12)
    shuffled = voxel_filter(points[rng.permutation(400)], size)
    np.testing.assert_allclose(shuffled, found, atol=1e-12)


def test_voxel_filter_off_and_empty():
    points = np.array([[1.0, 2, 3], [1.0, 2, 3]], dtype=np.float32)
    np.testing.assert_array_equal(voxel_filter(points, 0.0), points)
    assert voxel_filter(points, 0.0).dtype == np.float64
    assert len(voxel_filter(points, 0.1)) == 1
    assert voxel_filter(np.empty((0, 4)), 0.2).shape == (0, 4)


def test_voxel_keys_tell_every_voxel_apart_and_sort_by_x_y_z():
    far = (1 << 20) - 1
    steps = np.array([-far - 1, -far, -1, 0, 1, far])
    cells = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    keys = voxel_keys((cells + 0.5) * 0.25, 0.25)
    assert (np.diff(keys) > 0).all()


def test_cells_20_km_apart_never_share_a_key():
    near, far = np.zeros((1, 3)), np.array([[0.0, (1 << 21) * 0.01, 0.0]])
    with pytest.raises(InputError, match=r"within 10485.8 \(2\^20 voxels of 0.01 m\).*got 20971.5"):
        voxel_keys(np.vstack([near, far]), 0.01)
    with pytest.raises(InputError, match=r"got 10485\.8"):
        voxel_keys(np.array([[0.0, 0.0, -(1 << 20) * 0.01 - 0.005]]), 0.01)
    # Without a grid the filter tells them apart all the same, in the same order.
    rng = np.random.default_rng(11)
    points = np.vstack([rng.uniform(-0.02, 0.02, (50, 3)) + offset for offset in (near, far, -far)])
    expected = reference_filter(points, 0.01)
    np.testing.assert_allclose(voxel_filter(points, 0.01), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("held", [[], [3, 5, 9]])
def test_keys_are_found_among_sorted_ones(held):
    positions, present = find_in_sorted(np.array(held, np.int64), np.array([9, 4, 3, 12, 0]))
    assert positions.tolist() == np.searchsorted(held, [9, 4, 3, 12, 0]).tolist()
    assert present.tolist() == [key in held for key in (9, 4, 3, 12, 0)]


@pytest.mark.parametrize("count", [1, 2, 40])
def test_integrals_are_those_of_scipy(count):
    rng = np.random.default_rng(count)
    times, values = np.sort(rng.random(count)), rng.normal(size=(count, 3))
    expected = cumulative_trapezoid(values, times, axis=0, initial=0.0)
    np.testing.assert_array_equal(integrated(values, times), expected)


def test_the_parallel_sum_is_the_information_of_a_sum_of_errors():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(2, 4, 4))
    one, other = roots @ np.swapaxes(roots, 1, 2)
    both = np.linalg.inv(np.linalg.inv(one) + np.linalg.inv(other))
    np.testing.assert_allclose(parallel_sum(one, other), both, rtol=1e-9)
    np.testing.assert_allclose(parallel_sum(one, 0.0 * other), 0.0, atol=1e-12)
