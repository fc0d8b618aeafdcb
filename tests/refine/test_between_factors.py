"""Factors between two sweeps with both poses free."""

import gtsam
import numpy as np
import pytest
from support.jacobians import numerical

from loam_gtsam.factors import concatenate_rows, line_rows, plane_rows
from loam_gtsam.refine.between_factors import (
    distribution_rows,
    point_to_line_between_factor,
    point_to_plane_between_factor,
    sweep_match_factor,
)
from loam_gtsam.types import InputError

TARGET, SOURCE = gtsam.symbol("x", 3), gtsam.symbol("x", 9)
POSES = [
    (gtsam.Pose3(), gtsam.Pose3()),
    (gtsam.Pose3.Expmap([0.4, -2.0, 1.1, 30.0, -8.0, 5.0]),
     gtsam.Pose3.Expmap([-1.3, 0.7, 2.4, 28.0, 4.0, -6.0])),
]  # fmt: skip
RNG = np.random.default_rng(5)
POINTS = RNG.normal(size=(20, 3)) * 8.0
UNITS = RNG.normal(size=(20, 3))
UNITS /= np.linalg.norm(UNITS, axis=1, keepdims=True)
COVARIANCES = np.array([np.diag([1.0, 1.0, 0.01])] * 20)


def _rows():
    ones = np.ones(20)
    planes = plane_rows(POINTS, UNITS, RNG.normal(size=20), ones, 0.05)
    lines = line_rows(POINTS, POINTS + 0.1, UNITS, ones, 0.1)
    pairs = distribution_rows(
        POINTS, POINTS + 0.2, COVARIANCES, COVARIANCES, gtsam.Pose3.Expmap(0.3 * np.ones(6))
    )
    return concatenate_rows([planes, lines, pairs])


def _factors():
    one, two = (gtsam.noiseModel.Isotropic.Sigma(n, 0.1) for n in (1, 2))
    yield point_to_plane_between_factor(TARGET, SOURCE, POINTS[0], UNITS[0], 0.3, one)
    yield point_to_line_between_factor(TARGET, SOURCE, POINTS[1], POINTS[2], UNITS[1], two)
    yield sweep_match_factor(TARGET, SOURCE, _rows())


def _values(target, source):
    values = gtsam.Values()
    values.insert(TARGET, target)
    values.insert(SOURCE, source)
    return values


@pytest.mark.parametrize(("target", "source"), POSES)
def test_jacobians_on_both_poses_are_the_numerical_ones(target, source) -> None:
    for factor in _factors():
        linear = factor.linearize(_values(target, source)).jacobian()[0]
        size = len(linear)

        def error(first, second, factor=factor, size=size):
            jacobian = factor.linearize(_values(first, second)).jacobian()
            assert len(jacobian[1]) == size
            return -jacobian[1]  # b = -r

        of_target = numerical(lambda p: error(p, source), target)
        of_source = numerical(lambda p: error(target, p), source)
        scale = np.abs(linear).max()
        np.testing.assert_allclose(linear[:, :6], of_target, atol=2e-6 * scale)
        np.testing.assert_allclose(linear[:, 6:], of_source, atol=2e-6 * scale)


def test_one_factor_costs_what_all_matches_cost_wherever_both_poses_are() -> None:
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.05)
    offsets = RNG.normal(size=20)
    rows = plane_rows(POINTS, UNITS, offsets, np.ones(20), 0.05)
    together = sweep_match_factor(TARGET, SOURCE, rows)
    for poses in POSES:
        values = _values(*poses)
        single = sum(
            point_to_plane_between_factor(TARGET, SOURCE, *match, noise).error(values)
            for match in zip(POINTS, UNITS, offsets, strict=True)
        )
        assert together.error(values) == pytest.approx(single, rel=1e-9)


def test_moving_both_poses_together_costs_nothing() -> None:
    factor, move = sweep_match_factor(TARGET, SOURCE, _rows()), POSES[1][0]
    target, source = POSES[1]
    moved = _values(move.compose(target), move.compose(source))
    assert factor.error(moved) == pytest.approx(factor.error(_values(target, source)), rel=1e-9)


def test_rows_of_distributions_are_mahalanobis_distances() -> None:
    rows = distribution_rows(POINTS, POINTS[::-1], COVARIANCES, 2.0 * COVARIANCES, gtsam.Pose3())
    residuals, _ = rows.residuals(gtsam.Pose3())
    away = POINTS - POINTS[::-1]
    expected = np.einsum("ni,nij,nj->n", away, np.linalg.inv(3.0 * COVARIANCES), away)
    np.testing.assert_allclose((residuals.reshape(20, 3) ** 2).sum(axis=1), expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"source": TARGET}, "the same one twice"),
        ({"normal": [0.0, 0.0, 2.0]}, "unit length"),
        ({"point": [0.0, 1.0]}, r"point: expected \(3,\)"),
        ({"offset": np.nan}, "offset: expected a finite number"),
        ({"noise": gtsam.noiseModel.Unit.Create(2)}, "noise: expected dimension 1, got 2"),
        ({"noise": None}, "noise: expected a noise model of GTSAM, got NoneType"),
    ],
)
def test_what_makes_no_factor_is_refused(change, message) -> None:
    parts = {"target": TARGET, "source": SOURCE, "point": POINTS[0], "normal": UNITS[0],
             "offset": 0.0, "noise": gtsam.noiseModel.Unit.Create(1)}  # fmt: skip
    with pytest.raises(InputError, match=message):
        point_to_plane_between_factor(**(parts | change))


def test_a_flat_covariance_is_refused() -> None:
    flat = np.array([np.diag([1.0, 1.0, 0.0])] * 20)
    with pytest.raises(InputError, match="positive definite"):
        distribution_rows(POINTS, POINTS, flat, flat, gtsam.Pose3())


def test_a_matrix_is_no_pose() -> None:
    with pytest.raises(InputError, match=r"target_T_source: expected a gtsam.Pose3, got ndarray"):
        distribution_rows(POINTS, POINTS, COVARIANCES, COVARIANCES, np.eye(4))
