"""Laws of the geometry that hold for every input: rigid motions, fits, voxels."""

from typing import Any

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import generators

from loam_gtsam.geometry import fit_planes, symmetric_eigenvalues, transform, voxel_filter

SIZES = [0.0, 1e-12, 1e-9, 1e-7, 1e-4, 0.1, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-9]
"""Angles: none, where series take over from sines, and near a half turn."""


@st.composite
def rotation_vectors(draw: st.DrawFn) -> Any:
    axis = draw(generators()).normal(size=3)
    return draw(st.sampled_from(SIZES)) * axis / np.linalg.norm(axis)


@st.composite
def twists(draw: st.DrawFn) -> Any:
    metres = draw(st.sampled_from([0.0, 1e-9, 1.0, 30.0]))
    return np.concatenate([draw(rotation_vectors()), draw(generators()).normal(0.0, metres, 3)])


@st.composite
def clouds(draw: st.DrawFn, most: int = 60) -> Any:
    rng = draw(generators())
    count = draw(st.integers(1, most))
    return draw(st.sampled_from([0.01, 1.0, 100.0])) * rng.normal(size=(count, 3))


def pose(twist: Any) -> gtsam.Pose3:
    return gtsam.Pose3.Expmap(twist)


@given(a=twists(), b=twists(), points=clouds())
def test_transforms_compose_and_invert(a: Any, b: Any, points: Any) -> None:
    A, B = pose(a).matrix(), pose(b).matrix()
    tolerance = {"rtol": 0, "atol": 1e-12 * (100.0 + np.abs(points).max())}
    twice, moved = transform(A, transform(B, points)), transform(A, points)
    np.testing.assert_allclose(transform(A @ B, points), twice, **tolerance)
    np.testing.assert_allclose(transform(np.linalg.inv(A), moved), points, **tolerance)
    np.testing.assert_array_equal(transform(np.eye(4), points), points)
    before, after = (np.linalg.norm(p[1:] - p[:-1], axis=1) for p in (points, moved))
    np.testing.assert_allclose(after, before, **tolerance)


@st.composite
def groups(draw: st.DrawFn) -> Any:
    """Five or more points each: scattered, on lines, in planes, at one place; near and far away."""
    rng = draw(generators())
    shapes = [(1, 1, 1), (1, 0.3, 0), (1, 0, 0), (1, 1, 0), (0, 0, 0)]
    extent = np.array(draw(st.sampled_from(shapes)))
    noise = draw(st.sampled_from([0.0, 1e-6, 0.02]))
    points = rng.normal(size=(draw(st.integers(1, 20)), draw(st.integers(5, 8)), 3)) * extent
    points += noise * rng.normal(size=points.shape)
    turn = gtsam.Rot3.Expmap(rng.normal(size=3)).matrix()
    away = draw(st.sampled_from([0.0, 10.0, 1e3])) * rng.normal(size=3)
    return points @ turn.T + away


@given(neighbours=groups(), twist=twists(), rng=generators())
def test_fits_move_with_the_frame_and_forget_the_order(
    neighbours: Any, twist: Any, rng: np.random.Generator
) -> None:
    T = pose(twist).matrix()
    moved = transform(T, neighbours.reshape(-1, 3)).reshape(neighbours.shape)
    shuffled = rng.permuted(np.arange(neighbours.shape[1]))
    values = fit_planes(neighbours)[3]
    size = np.abs(neighbours).max() + np.abs(moved).max()
    tolerance = 1e-7 * values[2].max() + 1e-14 * size**2
    for other in (moved, neighbours[:, shuffled]):
        np.testing.assert_allclose(fit_planes(other)[3], values, rtol=0, atol=tolerance)
    clear = (values[1] - values[0] > 0.1 * values[2]) & (values[2] > 1e-9 * size**2)
    before, after = fit_planes(neighbours)[1], fit_planes(moved)[1]
    cosine = np.abs((after * (T[:3, :3] @ before)).sum(axis=0))
    assert (cosine[clear] > 1.0 - 1e-8).all()


@given(rng=generators(), scale=st.sampled_from([1e-100, 1e-6, 1.0, 1e6, 1e50]))
def test_eigenvalues_scale_and_shift_with_the_matrix(
    rng: np.random.Generator, scale: float
) -> None:
    matrices = rng.normal(size=(6, 20))
    values = symmetric_eigenvalues(matrices)
    np.testing.assert_allclose(values.sum(axis=0), matrices[:3].sum(axis=0), atol=1e-12)
    np.testing.assert_allclose(symmetric_eigenvalues(scale * matrices), scale * values,
                               rtol=1e-9, atol=1e-9 * scale)  # fmt: skip
    shifted = matrices + np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])[:, None]
    np.testing.assert_allclose(symmetric_eigenvalues(shifted), values + 1.0, atol=1e-9)


@given(points=clouds(most=200), size=st.sampled_from([0.05, 0.4, 7.0]), rng=generators())
def test_voxel_filter_forgets_the_order_and_is_done_after_one_pass(
    points: Any, size: float, rng: np.random.Generator
) -> None:
    once = voxel_filter(points, size)
    np.testing.assert_allclose(voxel_filter(rng.permutation(points), size), once,
                               rtol=0, atol=1e-12 * np.abs(points).max())  # fmt: skip
    assert len(once) <= len(points)
    cells = np.floor(points / size)
    assert len(once) == len(np.unique(cells, axis=0))
    # A mean may be rounded out of its voxel; else nothing is left to do.
    inside = (np.floor(once / size) == np.unique(cells, axis=0)).all()
    if inside:
        np.testing.assert_array_equal(voxel_filter(once, size), once)
    whole = np.round(rng.uniform(-50, 50, 3)) * size  # a shift by whole voxels shifts the result
    shifted = voxel_filter(points + whole, size)
    if len(shifted) == len(once):
        np.testing.assert_allclose(shifted, once + whole, rtol=0, atol=1e-9 * (100 * size + 100))
