"""Place descriptors: what a turn does to them, what is alike and what is not."""

import numpy as np
import pytest

from loam_gtsam.config import LoopConfig
from loam_gtsam.loops.scan_context import compare_descriptors, heading_free_key, scan_context
from loam_gtsam.types import InputError


def posts(seed, count=80):
    """Upright posts around the lidar, whose tops differ."""
    rng = np.random.default_rng(seed)
    turn, away = rng.uniform(-np.pi, np.pi, count), rng.uniform(3.0, 50.0, count)
    feet = np.stack([away * np.cos(turn), away * np.sin(turn)], axis=1)
    heights = rng.uniform(-1.5, 6.0, (count, 1)) * np.linspace(0.1, 1.0, 12)
    return np.column_stack([np.repeat(feet, 12, axis=0), heights.ravel()])


def turned(points, angle):
    """The same points for a lidar that is turned by an angle, rad."""
    c, s = np.cos(-angle), np.sin(-angle)
    return points @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T


def test_a_cell_has_the_height_of_its_highest_point():
    config = LoopConfig(rings=3, sectors=4, reach=30.0)
    points = np.array([
        [5.0, 0.1, -1.0], [5.0, 0.2, 2.0], [-1.0, -25.0, 1.0], [0.1, 15.0, -9.0],
        [40.0, 1.0, 5.0], [-15.0, 1.0, 90.0],
    ])  # fmt: skip
    expected = np.zeros((3, 4))
    expected[0, 0] = 5.0  # 2 m above the lidar, which stands for 3
    expected[2, 2] = 4.0
    expected[1, 1] = 20.0  # the highest that counts
    np.testing.assert_array_equal(scan_context(points, config), expected)


def test_a_point_that_is_just_within_reach_is_in_the_last_ring():
    config = LoopConfig(rings=24)
    point = np.array([[np.nextafter(config.reach, 0.0), 0.0, 1.0]])
    assert scan_context(point, config)[-1, 0] == 4.0


@pytest.mark.parametrize("sectors", [7, -13, 30])
def test_a_turn_is_found_and_changes_nothing_else(sectors):
    config = LoopConfig()
    angle = 2.0 * np.pi * sectors / config.sectors
    one = scan_context(posts(1), config)
    # Not on the border of a sector, where rounding decides.
    other = scan_context(turned(posts(1), angle), config)
    distance, turn = compare_descriptors(one, other)
    assert abs((turn - angle + np.pi) % (2.0 * np.pi) - np.pi) < 1e-9
    assert distance < 0.05
    np.testing.assert_allclose(heading_free_key(one), heading_free_key(other), atol=0.2)


def test_other_places_are_less_alike_than_the_same_one():
    config = LoopConfig()
    one = scan_context(posts(1), config)
    assert compare_descriptors(one, one) == (pytest.approx(0.0, abs=1e-12), 0.0)
    near = scan_context(posts(1) - [1.0, 0.5, 0.0], config)
    places = (scan_context(posts(seed), config) for seed in range(2, 8))
    others = [compare_descriptors(one, place)[0] for place in places]
    assert compare_descriptors(one, near)[0] < min(others)
    assert min(others) > 0.4


def test_empty_places_and_a_few_columns_that_agree_are_no_likeness():
    config = LoopConfig()
    one = scan_context(posts(1), config)
    empty = scan_context(np.zeros((0, 3)), config)
    assert compare_descriptors(empty, empty)[0] == compare_descriptors(empty, one)[0] == 1.0
    some = np.zeros_like(one)
    some[:, :6] = one[:, :6]
    other = scan_context(posts(2), config)
    other[:, :6] = one[:, :6]
    other[:, 6:40] = 0.0
    assert compare_descriptors(some, one)[0] < 0.05  # all that it has agrees
    assert compare_descriptors(other, one)[0] > 0.3


def test_wrong_shapes_are_refused():
    with pytest.raises(InputError, match=r"points: expected \(N, 3\)"):
        scan_context(np.zeros((4, 2)), LoopConfig())
    with pytest.raises(InputError, match="expected equal shapes"):
        compare_descriptors(np.zeros((20, 60)), np.zeros((20, 30)))
