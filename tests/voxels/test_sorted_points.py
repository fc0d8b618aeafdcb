"""New points in the order of their cubes and voxels, against a plain sort."""

import numpy as np
import pytest

from loam_gtsam.geometry import voxel_keys
from loam_gtsam.voxels.cubes import CubePoints, SortedPoints
from loam_gtsam.voxels.grid import Grid
from loam_gtsam.voxels.tags import tags_of


@pytest.mark.parametrize(("spread", "count"), [(0.3, 1), (0.3, 500), (30.0, 2000), (3000.0, 500)])
def test_points_come_by_cube_then_by_voxel_then_as_given(spread: float, count: int) -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(0.0, spread, (count, 3))
    grid, tags = Grid(4.0, 0.5), tags_of(count, 0)
    tags[:, 0] = np.arange(count)
    cells = grid.cells(points.T)
    found = SortedPoints.of(CubePoints(points, tags), cells, grid)
    keys = voxel_keys(points, grid.voxel_size)
    order = np.lexsort((keys, *cells[::-1]))
    np.testing.assert_array_equal(found.content.points, points[order])
    np.testing.assert_array_equal(found.content.tags[:, 0], order)
    firsts = found.firsts()
    for index, part in firsts.items():
        assert (np.diff(part.keys) > 0).all()
        assert (grid.cells(part.points.T) == np.array(index)[:, None]).all()
    voxels = np.column_stack([*cells.astype(np.int64), keys])
    first = np.unique(voxels, axis=0, return_index=True)[1]
    assert sorted(first.tolist()) == sorted(np.concatenate([p.tags[:, 0] for p in firsts.values()]))


def test_points_without_an_owner_are_those_of_the_others_sorted() -> None:
    rng = np.random.default_rng(5)
    points, tags = rng.normal(0.0, 4.0, (2000, 3)), tags_of(2000, 0)
    tags[:, 0] = rng.integers(0, 3, len(tags))
    grid, others = Grid(4.0, 0.5), tags[:, 0] != 1
    cells = grid.cells(points.T)
    found = SortedPoints.of(CubePoints(points, tags), cells, grid).without(1)
    assert found is not None
    content = CubePoints(points[others], tags[others])
    expected = SortedPoints.of(content, cells[:, others], grid)
    for got, wanted in ((found.firsts(), expected.firsts()), (found.sums(), expected.sums())):
        assert got.keys() == wanted.keys()
        for index in got:
            for one, other in zip(got[index], wanted[index], strict=True):
                np.testing.assert_array_equal(one, other)
