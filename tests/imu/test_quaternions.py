"""Arithmetic of many quaternions at once, against scipy and against one by one."""

import functools
import itertools
import operator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.imu import angle

from loam_gtsam.imu import quaternions


def product(steps):
    """Of scipy rotations, one by one."""
    return functools.reduce(operator.mul, steps, Rotation.identity())


@pytest.mark.parametrize("count", [1, 2, 5, 64, 513])
def test_running_product_is_the_product_one_by_one(count):
    steps = Rotation.random(count, rng=count)
    expected = [r.as_matrix() for r in itertools.accumulate(steps, operator.mul)]
    found = quaternions.running_product(steps.as_quat().T)
    assert np.allclose(Rotation.from_quat(found.T).as_matrix(), expected, atol=1e-12)


def test_exponential_and_logarithm_are_scipys_and_each_others_inverse():
    rng = np.random.default_rng(0)
    axes = rng.standard_normal((60, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    vectors = axes * np.repeat([0.0, 1e-14, 1e-7, 0.3, 2.0, np.pi - 1e-6], 10)[:, None]
    q = quaternions.exponential(vectors.T)
    reference = Rotation.from_rotvec(vectors)
    assert (reference.inv() * Rotation.from_quat(q.T)).magnitude().max() < 1e-12
    for sign in (1.0, -1.0):
        assert np.allclose(quaternions.logarithm(sign * q).T, vectors, rtol=1e-9, atol=1e-15)
    points = rng.standard_normal((3, 60))
    assert np.allclose(quaternions.rotate(q, points).T, reference.apply(points.T))
    back = quaternions.quaternion_product(quaternions.inverse(q), q)
    assert np.allclose(back.T, [0.0, 0.0, 0.0, 1.0])


def test_rotation_steps_follow_a_moving_axis():
    """Rates that change evenly but not about one axis: the trapezoid alone is off by coning."""
    start, change = np.array([[2.0], [0.5], [-1.0]]), np.array([[-3.0], [4.0], [2.0]])
    rough, fine = np.linspace(0.0, 0.1, 6), np.linspace(0.0, 0.1, 20_001)
    turns = quaternions.exponential(quaternions.rotation_steps(fine, start + change * fine))
    exact = Rotation.from_quat(quaternions.running_product(turns)[:, -1])
    rates = start + change * rough
    steps = quaternions.rotation_steps(rough, rates)
    plain = 0.5 * np.diff(rough) * (rates[:, 1:] + rates[:, :-1])
    errors = [angle(exact, product(Rotation.from_rotvec(v.T))) for v in (steps, plain)]
    assert errors[0] < 1e-6
    assert errors[1] > 2e-5


def test_running_filter_is_the_recursion_even_where_it_forgets():
    rng = np.random.default_rng(1)
    keep, new = rng.random(300), rng.standard_normal((3, 300))
    keep[[0, 17, 18, 255]] = 0.0
    y, expected = np.array([1.0, 2.0, 3.0]), []
    for k in range(300):
        y = keep[k] * y + new[:, k]
        expected.append(y)
    found = quaternions.running_filter(keep, new, np.array([1.0, 2.0, 3.0]))
    assert np.allclose(found.T, expected, atol=1e-13)


def test_levelling_turns_up_to_z_the_shortest_way():
    ups = np.random.default_rng(2).standard_normal((3, 50)) * 5.0
    ups = np.column_stack([ups, [0.0, 0.0, 3.0], [0.0, 0.0, -3.0], [0.0, 0.0, 0.0]])
    q = quaternions.levelling(ups)
    turned = quaternions.rotate(q, ups)[:, :-1]
    assert np.allclose(turned[:2], 0.0, atol=1e-9)
    assert np.allclose(turned[2], np.linalg.norm(ups[:, :-1], axis=0))
    steepness = np.arccos(ups[2, :50] / np.linalg.norm(ups[:, :50], axis=0))
    assert np.allclose(Rotation.from_quat(q.T[:50]).magnitude(), steepness)
    assert np.array_equal(q[:, -1], [0.0, 0.0, 0.0, 1.0])
