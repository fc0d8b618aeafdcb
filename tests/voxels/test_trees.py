"""Trees over cubes: exact whatever was added since, and kept as long as they can be used."""

from itertools import pairwise, product

import numpy as np
import pytest

from loam_gtsam.config import MapConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.io.state import freeze, thaw
from loam_gtsam.types import FloatArray
from loam_gtsam.voxels.cubes import Cube, CubePoints, SortedPoints
from loam_gtsam.voxels.grid import Grid
from loam_gtsam.voxels.tags import tags_of
from loam_gtsam.voxels.trees import CubeTrees, TreeCache

GRID = Grid(4.0, 0.01)
LEFT, MIDDLE, RIGHT = (-1, 0, 0), (0, 0, 0), (1, 0, 0)


def brute_force(
    points: FloatArray, queries: FloatArray, k: int, max_distance: float
) -> tuple[FloatArray, FloatArray]:
    squared = ((queries[:, None, :] - points) ** 2).sum(axis=2)
    squared[squared >= max_distance**2] = np.inf
    squared = np.pad(squared, ((0, 0), (0, k)), constant_values=np.inf)
    points = np.pad(points, ((0, k), (0, 0)), constant_values=np.nan)
    order = np.argsort(squared, axis=1, kind="stable")[:, :k]
    squared = np.take_along_axis(squared, order, axis=1)
    return np.where(np.isinf(squared)[:, :, None], np.nan, points[order]), squared


def tagged(points: FloatArray) -> CubePoints:
    return CubePoints(points, tags_of(len(points), 0))


class Cubes(dict):
    """Cubes and the trees over them, as a map keeps them."""

    def __init__(self) -> None:
        super().__init__()
        self.trees = TreeCache()

    def insert(self, points: FloatArray) -> None:
        new = SortedPoints.of(tagged(points), GRID.cells(points.T), GRID)
        parts = new.firsts().items()
        self.trees.add({index: self.setdefault(index, Cube()).settle(p) for index, p in parts})

    def over(self, *indices) -> CubeTrees:
        return self.trees.over(set(indices), self)


def test_trees_are_kept_until_a_tenth_of_the_points_is_new_and_stay_exact() -> None:
    cubes, rng = Cubes(), np.random.default_rng(5)
    cubes.insert(rng.uniform(-2.0, 2.0, (3000, 3)))
    queries = rng.uniform(-2.0, 2.0, (300, 3))
    used = []
    for _ in range(25):
        used.append(cubes.over(MIDDLE))
        got = used[-1].nearest(queries, 5, 0.4)
        want = brute_force(cubes[MIDDLE].points, queries, 5, 0.4)
        np.testing.assert_array_equal(got[0], want[0])
        np.testing.assert_allclose(got[1], want[1], rtol=1e-12)
        cubes.insert(rng.uniform(-2.0, 2.0, (30, 3)))  # 1 % of the tree
    assert [a is b for a, b in pairwise(used)].count(False) == 2


def test_trees_of_cubes_that_are_not_asked_for_are_not_used() -> None:
    cubes = Cubes()
    cubes.insert(np.array([[0.1, 0.1, 0.1], [4.1, 0.1, 0.1]]))
    both = cubes.over(MIDDLE, RIGHT)
    assert both.nearest(np.zeros((1, 3)), 2, 9.0)[1].max() < np.inf
    one = cubes.over(MIDDLE)
    assert np.isinf(one.nearest(np.zeros((1, 3)), 2, 9.0)[1][0, 1])
    both = cubes.over(MIDDLE, RIGHT)
    assert both.nearest(np.zeros((1, 3)), 2, 9.0)[1].max() < np.inf


def test_a_sensor_on_a_border_needs_no_new_trees() -> None:
    cubes = Cubes()
    cubes.insert(np.array([[0.1, 0.1, 0.1], [4.1, 0.1, 0.1], [-3.9, 0.1, 0.1]]))
    sides = [(MIDDLE, RIGHT), (MIDDLE, LEFT)]
    for side in sides:
        cubes.over(*side)
    kept = [cubes.over(*side) for side in sides]
    for _ in range(2):
        assert [cubes.over(*side) for side in sides] == kept


def test_only_trees_of_changed_cubes_are_forgotten() -> None:
    cubes = Cubes()
    cubes.insert(np.array([[0.1, 0.1, 0.1], [4.1, 0.1, 0.1]]))
    changed, kept = cubes.over(MIDDLE), cubes.over(RIGHT)
    cubes.trees.forget([MIDDLE, LEFT])
    assert cubes.over(RIGHT) is kept
    assert cubes.over(MIDDLE) is not changed


@pytest.mark.parametrize("insertion", ["centroid", "settled"])
def test_searches_of_changing_cubes_see_all_of_theirs_and_nothing_else(insertion: str) -> None:
    """Cubes that come and go between searches, as the sensor walks along their border."""
    rng = np.random.default_rng(8)
    config = MapConfig(cube_size=4.0, window=(5, 5, 3), window_margin=1, insertion=insertion)
    cube_map = CubeMap(config, 0.3)
    cubes = list(product((-1, 0, 1), repeat=2))
    for step in range(60):
        centre = 2.0 * np.sin([0.3 * step, 0.11 * step, 0.0])
        cube_map.insert(centre + rng.normal(0.0, 1.5, (40, 3)))
        here = [(x, y, 0) for x, y in cubes if (x + y + step // 3) % 3]
        queries = rng.uniform(-5.0, 5.0, (30, 3))
        got = cube_map.nearest(queries, 3, 2.0, here)
        want = brute_force(cube_map.points(here), queries, 3, 2.0)
        np.testing.assert_array_equal(got[0], want[0])


def test_restored_trees_are_due_when_those_before_would_have_been() -> None:
    """With the points that were added since the large tree was built."""
    cubes, rng = Cubes(), np.random.default_rng(6)
    queries = rng.uniform(-2.0, 6.0, (200, 3))
    cubes.insert(rng.uniform((-2, -2, -2), (6, 2, 2), (2000, 3)))
    trees = cubes.over(MIDDLE, RIGHT)
    cubes.insert(rng.uniform((-2, -2, -2), (6, 2, 2), (150, 3)))
    restored = TreeCache()
    thaw(freeze({"trees": cubes.trees}, {}), {"trees": restored}, {})
    again = restored.over({MIDDLE, RIGHT}, cubes)
    assert again is not trees
    one, other = (either.nearest(queries, 5, 1.0) for either in (trees, again))
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], other[1])
    assert not trees.is_stale
    more = {MIDDLE: tagged(rng.uniform(-2.0, 2.0, (51, 3)))}
    for either in (trees, again):
        either.add(more)
        assert either.is_stale
