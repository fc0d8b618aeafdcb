"""Measures along a ring against closed forms: curvature, occlusion, grazing, roughness."""

import numpy as np
import pytest

from loam_gtsam.config import FeatureConfig
from loam_gtsam.frontend.curvature import (
    UNIFORM_SIGMA,
    curvature,
    ends_of_surfaces,
    prominence,
    roughness,
    running_sums,
    squared_gaps,
    unreliable_points,
    window_fits,
    window_means,
)

LOAM = FeatureConfig(post_depth=0.0)
GRAZED = np.deg2rad(np.arange(6.0, 174.0, 0.2))


def one_ring(azimuth: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """(3, N) points of one level ring."""
    xyz = np.stack((distance * np.cos(azimuth), distance * np.sin(azimuth), 0 * azimuth))
    return xyz.astype(np.float32)


def unreliable(xyz: np.ndarray, starts: list[int] | None = None, **changes: float) -> np.ndarray:
    """Indices of the points that LOAM would leave out, by the tests that ``changes`` leaves on."""
    bounds = np.array(starts or [0, xyz.shape[1]])
    gaps = squared_gaps(xyz, bounds)
    return np.flatnonzero(unreliable_points(xyz, gaps, bounds, LOAM.changed(**changes)))


@pytest.mark.parametrize("half_window", [1, 5])
def test_curvature_is_the_squared_sum_of_differences(half_window: int) -> None:
    xyz = np.random.default_rng(0).uniform(-50, 50, (3, 60)).astype(np.float32)
    found = curvature(xyz, half_window)
    for i in range(half_window, 60 - half_window):
        around = xyz[:, i - half_window : i + half_window + 1].astype(float)
        expected = np.sum((around - xyz[:, i : i + 1]).sum(axis=1) ** 2)
        assert found[i] == pytest.approx(expected, rel=1e-4)


def test_windows_stay_in_their_ring() -> None:
    fits = window_fits(np.array([0, 12, 15, 40]), 5)
    assert np.array_equal(np.flatnonzero(fits), [5, 6, *range(20, 35)])


def test_occlusion_rejects_the_six_points_behind_on_either_side() -> None:
    azimuth = np.deg2rad(np.arange(-50.1, 50.2, 0.2))
    xyz = one_ring(azimuth, np.where(np.abs(azimuth - 0.2) < 0.023, 5.0, 10.0 / np.cos(azimuth)))
    pole = np.flatnonzero(np.hypot(xyz[0], xyz[1]) < 6.0)
    expected = np.concatenate((pole[0] - 1 - np.arange(6), pole[-1] + 1 + np.arange(6)))
    assert np.array_equal(unreliable(xyz, grazing_ratio=1e9), np.sort(expected))


@pytest.mark.parametrize(
    ("turn", "gap", "count"),
    [(0.0, 0.1, 6), (0.0, 2.2, 6), (0.0, 2.3, 0), (0.09, 0.1, 6), (0.11, 0.1, 0)],
)
def test_occlusion_needs_a_gap_and_two_points_on_one_ray(
    turn: float, gap: float, count: int
) -> None:
    """20 points at 5 m, then 20 at 6.5 m on almost the same ray: squared gap 2.25."""
    behind = np.arange(40) >= 20
    xyz = one_ring(0.001 * np.arange(40) + turn * behind, np.where(behind, 6.5, 5.0))
    rejected = unreliable(xyz, grazing_ratio=1e9, occlusion_gap=gap)
    assert np.array_equal(rejected, 20 + np.arange(count))


def test_occlusion_does_not_reach_into_the_next_ring() -> None:
    # The ring ends three points behind the occlusion; the next ring starts elsewhere.
    distance = np.concatenate((np.full(20, 5.0), np.full(3, 6.5), np.full(20, 30.0)))
    xyz = one_ring(0.001 * np.arange(43), distance)
    assert np.array_equal(unreliable(xyz, [0, 23, 43], grazing_ratio=1e9), [20, 21, 22])


def test_grazing_rejects_where_both_gaps_are_large_for_the_range() -> None:
    # A wall along x at y = 1 seen every 0.2 degrees: gaps of about r^2 * 0.0035 m.
    azimuth = np.deg2rad(np.arange(4.0, 90.0, 0.2))
    xyz = np.stack((1 / np.tan(azimuth), np.ones(len(azimuth)), np.zeros(len(azimuth))))
    xyz = xyz.astype(np.float32)
    rejected = np.isin(np.arange(len(azimuth)), unreliable(xyz, occlusion_gap=1e9))
    distance = np.hypot(xyz[0], xyz[1])
    bound = np.sqrt(LOAM.grazing_ratio) / np.deg2rad(0.2)
    assert rejected[1:-1][distance[1:-1] > 1.05 * bound].all()
    assert not rejected[distance < 0.95 * bound].any()
    # One large gap is an edge, not a grazed surface.
    step = np.zeros((3, 30), np.float32)
    step[0] = np.where(np.arange(30) < 15, 5.0, 9.0)
    step[1] = 0.01 * np.arange(30)
    assert len(unreliable(step, occlusion_gap=1e9)) == 0


def along_wall(distance: float, azimuths: np.ndarray, noise: np.ndarray | float = 0.0):
    """(3, N) one ring on a wall at y = distance, ranges off by noise."""
    return one_ring(azimuths, distance / np.sin(azimuths) + noise)


def test_a_wall_is_smooth_and_straight_however_grazed() -> None:
    wall = along_wall(1.7, GRAZED)
    middle = np.arange(5, len(GRAZED) - 5)
    assert curvature(wall, 5)[:20].max() > 1.0  # what LOAM's curvature takes for an edge
    assert roughness(wall)[middle].max() < 2e-3
    assert prominence(wall, 5, middle).max() < 2e-3


def test_roughness_and_prominence_are_in_units_of_the_range_noise() -> None:
    rng = np.random.default_rng(0)
    wall = along_wall(8.0, GRAZED, 0.02 * rng.normal(size=len(GRAZED)))
    middle = np.arange(5, len(GRAZED) - 5)
    assert np.sqrt(np.mean(prominence(wall, 5, middle) ** 2)) == pytest.approx(0.02, rel=0.2)
    smooth = roughness(wall)[middle]
    assert 0.008 < np.median(smooth) < 0.02  # the smoothest of three windows
    # One window alone: the residual variance of a fitted line, as numpy finds it.
    few = along_wall(8.0, GRAZED[:5], 0.02 * rng.normal(size=5))
    squared = np.sum(few.astype(float) ** 2, axis=0)
    inverse, place = 1 / np.sqrt(squared), np.arange(5)
    off = (inverse - np.polyval(np.polyfit(place, inverse, 1), place)) * squared[2]
    assert roughness(few)[2] == pytest.approx(np.sqrt(np.sum(off**2) / 3), rel=0.1)


def test_next_to_a_step_a_surface_is_smooth_and_the_step_stands_out() -> None:
    step = along_wall(8.0, GRAZED, np.where(np.arange(len(GRAZED)) < 400, 0.0, 3.0))
    rough = roughness(step)
    assert rough[390:410].max() < 0.01
    # Five neighbours are beyond the step: 5 * 3 m * (8 m / 11 m), or its inverse, over sqrt(110).
    expected = np.array([0.0, 15.0 * 8 / 11, 15.0 * 11 / 8]) / np.sqrt(110)
    assert prominence(step, 5, np.array([380, 399, 400])) == pytest.approx(expected, abs=0.02)


STEP = np.deg2rad(0.4)


def wall_before(behind: float, incidence: float, begin: float, lost: tuple[int, ...] = ()):
    """A wall from beam 20 + ``begin`` to beam 50, 20 m away there; what is behind it is farther.

    Returns the points, the beams they belong to and where the wall begins; ``behind`` may be NaN.
    """
    number = np.arange(80)
    towards = np.array([np.cos(35 * STEP + incidence), np.sin(35 * STEP + incidence)])
    here = np.array([np.cos(50 * STEP), np.sin(50 * STEP)])
    reach = 20.0 * (here @ towards)
    directions = np.array([np.cos(number * STEP), np.sin(number * STEP)])
    ranges = reach / (towards @ directions)
    ranges[(number < 20.0 + begin) | (number > 50)] = behind
    ranges[list(lost)] = np.nan
    end = np.array([np.cos((20.0 + begin) * STEP), np.sin((20.0 + begin) * STEP)])
    met = np.isfinite(ranges)
    return one_ring(number[met] * STEP, ranges[met]), number[met], end * reach / (towards @ end)


@pytest.mark.parametrize("incidence", [-1.0, 0.0, 1.0])
@pytest.mark.parametrize("behind", [45.0, np.nan])
def test_edges_before_a_drop_lie_where_walls_end_in_the_mean(behind, incidence) -> None:
    before, after = [], []
    for begin in np.linspace(-0.95, 0.0, 20):  # the first beam on the wall is the twentieth
        xyz, number, end = wall_before(behind, incidence, begin)
        chosen = np.flatnonzero(number == 20)
        if np.isnan(behind):
            assert len(number) == 31  # nothing is behind it: the ring goes on elsewhere
            xyz = np.concatenate((xyz[:, -10:], xyz), axis=1)
            chosen = chosen + 10
        moved, apart = ends_of_surfaces(xyz, 5, chosen, 0.3, 0.0)
        before.append(xyz[:2, chosen[0]] - end)
        after.append(moved[0, :2] - end)
    late, right = (np.linalg.norm(np.mean(errors, axis=0)) for errors in (before, after))
    assert late > 0.4 * 20.0 * STEP
    assert right < 0.1 * late
    across = np.array([-np.sin(20.0 * STEP), np.cos(20.0 * STEP)])
    assert UNIFORM_SIGMA * apart == pytest.approx(np.std(np.array(after) @ across), rel=0.15)


def test_only_ends_of_surfaces_before_a_drop_are_moved() -> None:
    xyz, number, _ = wall_before(45.0, 0.3, 0.0)
    # The last points on either side, one within the wall, and one behind it.
    chosen = np.searchsorted(number, [20, 50, 35, 19])
    moved, apart = ends_of_surfaces(xyz, 5, chosen, 0.3, 0.0)
    assert apart == pytest.approx(np.linalg.norm(xyz[:, chosen], axis=0) * STEP, rel=0.01)
    same = np.all(moved == xyz[:, chosen].T, axis=1)
    assert same.tolist() == [False, False, True, True]
    turned = np.arctan2(moved[:2, 1], moved[:2, 0]) / STEP
    assert turned == pytest.approx([19.5, 50.5], abs=1e-3)
    half = ends_of_surfaces(xyz, 5, chosen, 0.3, 0.5 * STEP)[0]  # beams with as much between them
    turned = np.arctan2(half[:2, 1], half[:2, 0]) / STEP
    assert turned == pytest.approx([19.75, 50.25], abs=1e-3)
    for wide in (STEP, 1.0):  # without anything
        found = ends_of_surfaces(xyz, 5, chosen, 0.3, wide)[0]
        assert found == pytest.approx(xyz[:, chosen].T, abs=1e-4)
    # Nothing is known of a surface with one point, nor of what lies behind lost beams.
    alone = one_ring(number * STEP, np.where(number == 30, 20.0, 45.0))
    there = np.searchsorted(number, [30])
    assert np.array_equal(ends_of_surfaces(alone, 5, there, 0.3, 0.0)[0], alone[:, there].T)
    xyz, number, _ = wall_before(45.0, 0.3, 0.0, lost=(17, 18, 19))
    first = np.searchsorted(number, [20])
    assert np.array_equal(ends_of_surfaces(xyz, 5, first, 0.3, 0.0)[0], xyz[:, first].T)


def test_a_lost_beam_on_the_wall_does_not_move_its_end() -> None:
    xyz, number, _ = wall_before(45.0, 0.3, 0.0, lost=(22,))
    moved = ends_of_surfaces(xyz, 5, np.searchsorted(number, [20]), 0.3, 0.0)[0][0]
    assert np.arctan2(moved[1], moved[0]) / STEP == pytest.approx(19.5, abs=0.15)


def test_too_short_a_sweep_is_rough_everywhere() -> None:
    assert np.isinf(roughness(along_wall(8.0, GRAZED[:4]))).all()


@pytest.mark.parametrize("count", [1, 4, 9, 10, 11, 12, 40])
def test_the_mean_over_a_window_is_cut_at_the_ends_of_the_sweep(count: int) -> None:
    xyz = np.random.default_rng(count).uniform(-9.0, 9.0, (3, count)).astype(np.float32)
    means = window_means(running_sums(xyz), 5)
    for row in range(count):
        window = xyz[:, max(row - 5, 0) : row + 6].astype(np.float64)
        assert means[:, row] == pytest.approx(window.mean(axis=1), abs=1e-12)
