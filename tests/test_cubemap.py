from collections.abc import Callable
from itertools import product

import gtsam
import numpy as np
import pytest
from support.cubes import SMALL, moved_by

from loam_gtsam.config import MapConfig
from loam_gtsam.cubemap import CubeMap, grid_of
from loam_gtsam.geometry import voxel_filter, voxel_keys
from loam_gtsam.types import ConfigError, InputError
from loam_gtsam.voxels.archive import Archive

ALL_AROUND = MapConfig(field_of_view=False)
CENTROID = MapConfig(insertion="centroid")


def test_border_query_finds_the_eight_cubes_that_meet() -> None:
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    corner = np.array([-25.0, 25.0, -25.0])
    cube_map = CubeMap(ALL_AROUND, 0.4)
    cube_map.insert(corner + 0.3 * signs)
    cubes = cube_map.neighbourhood(np.eye(4))
    assert len(cubes) == 8
    points, squared, _ = cube_map.nearest(corner[None], 9, 1.0, cubes)
    np.testing.assert_allclose(squared[0, :8], 3 * 0.3**2)
    assert np.isinf(squared[0, 8])
    assert np.isnan(points[0, 8]).all()
    ascending = points[0, np.lexsort(points[0, :8].T[::-1])]
    np.testing.assert_allclose(ascending, corner + 0.3 * signs, atol=1e-12)
    again = cube_map.nearest(corner[None], 9, 1.0, cubes[::-1] + cubes)
    np.testing.assert_array_equal(again[0], points)
    np.testing.assert_array_equal(again[1], squared)
    only = cube_map.nearest(corner[None], 9, 1.0, [(0, 0, 0)])[1]
    assert np.isfinite(only).sum() == 1


def test_distances_are_squared_metres_and_the_limit_is_exclusive() -> None:
    cube_map = CubeMap(ALL_AROUND, 0.4)
    cube_map.insert(np.array([[3.0, 0.0, 0.0], [0.0, 2.0, 0.0]]))
    points, squared, _ = cube_map.nearest(np.zeros((1, 3)), 3, 3.0, [(0, 0, 0)])
    np.testing.assert_array_equal(squared, [[4.0, np.inf, np.inf]])
    np.testing.assert_array_equal(points[0, 0], [0.0, 2.0, 0.0])
    _, squared, _ = cube_map.nearest(np.zeros((1, 3)), 3, 3.001, [(0, 0, 0), (0, 0, 0)])
    np.testing.assert_array_equal(squared, [[4.0, 9.0, np.inf]])


def test_empty_map_and_empty_arrays() -> None:
    cube_map = CubeMap(MapConfig(), 0.4)
    cube_map.insert(np.empty((0, 3)))
    assert cube_map.stats.cubes == cube_map.count() == 0
    assert cube_map.points().shape == (0, 3)
    assert cube_map.neighbourhood(np.eye(4)) == ()
    points, squared, _ = cube_map.nearest(np.zeros((2, 3)), 5, 1.0, [(0, 0, 0)])
    np.testing.assert_array_equal(points, np.full((2, 5, 3), np.nan))
    assert np.isinf(squared).all()
    cube_map.insert(np.zeros((1, 3)))
    points, squared, _ = cube_map.nearest(np.empty((0, 3)), 5, 1.0, [(0, 0, 0)])
    assert (points.shape, squared.shape) == ((0, 5, 3), (0, 5))


def test_cube_zero_is_centred_on_the_origin() -> None:
    cube_map = CubeMap(ALL_AROUND, 0.4)
    cube_map.insert(np.array([[-25.0, 0.0, 24.99], [25.0, -25.01, 0.0]]))
    assert cube_map.neighbourhood(np.eye(4)) == ((0, 0, 0), (1, -1, 0))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_window_follows_in_every_direction(axis: int, sign: int) -> None:
    """The window holds still up to the margin, then keeps the sensor 3 cubes from its edge."""
    cube_map = CubeMap(MapConfig(), 0.4)
    start = cube_map.window[0][axis]
    slack = MapConfig().window[axis] // 2 - 3
    for step in range(2 * slack + 5):
        position = np.zeros(3)
        position[axis] = 50.0 * sign * step
        cube_map.recenter(position)
        assert cube_map.window[0][axis] == start + sign * max(0, step - slack)


def test_margin_wider_than_the_window_is_cut() -> None:
    cube_map = CubeMap(SMALL.changed(window=(3, 3, 1), window_margin=3), 0.5)
    cube_map.recenter(np.array([40.0, 0.0, 8.0]))
    assert cube_map.window == ((9, -1, 2), (11, 1, 2))


def test_neighbourhood_is_as_wide_as_configured() -> None:
    cube_map = CubeMap(MapConfig(neighbourhood=(5, 5, 3), field_of_view=False), 0.4)
    cube_map.insert(50.0 * np.array(list(product(range(-4, 5), repeat=3)), dtype=np.float64))
    cubes = cube_map.neighbourhood(gtsam.Pose3(gtsam.Rot3.Yaw(0.4), (60.0, 0.0, 30.0)).matrix())
    expected = product(range(1 - 2, 1 + 3), range(-2, 3), range(1 - 1, 1 + 2))
    assert cubes == tuple(expected)


def test_voxels_are_anchored_at_the_map_origin() -> None:
    """In 0.4 m voxels, 0.39 and 0.41 are apart and 0.41 and 0.79 together, also left of zero."""
    x = np.array([0.39, 0.41, 0.79, -0.01, -0.39, -0.41])
    points = np.stack([x, 0.0 * x, 0.0 * x], axis=1)
    cube_map = CubeMap(CENTROID, 0.4)
    cube_map.insert(points)
    np.testing.assert_allclose(cube_map.points()[:, 0], [-0.41, -0.2, 0.39, 0.6], atol=1e-15)
    # A border voxel (24.8 to 25.2) that two cubes share has a point in each of them.
    cube_map.insert(np.array([[24.9, 0.0, 0.0], [25.1, 0.0, 0.0]]))
    np.testing.assert_array_equal(cube_map.points()[-2:, 0], [24.9, 25.1])


def test_centroid_equals_the_voxel_filter_of_the_union() -> None:
    old, new = np.random.default_rng(2).uniform(-20.0, 20.0, (2, 3000, 3)) * (1, 1, 0.05)
    cube_map = CubeMap(CENTROID, 0.4)
    cube_map.insert(old)
    union = np.concatenate((voxel_filter(old, 0.4), new))
    cube_map.insert(new)
    np.testing.assert_allclose(cube_map.points(), voxel_filter(union, 0.4), rtol=0, atol=1e-13)


@pytest.mark.parametrize("x", [1.4, 1.6])
def test_rounding_cannot_move_a_centroid_out_of_its_voxel(x: float) -> None:
    """The plain mean of six times x is one bit off, and so in the next voxel of 0.2 m."""
    points = np.full((6, 3), x)
    plain = np.add.reduce(points, axis=0)[None] / 6.0
    assert voxel_keys(plain, 0.2) != voxel_keys(points[:1], 0.2)
    cube_map = CubeMap(CENTROID, 0.2)
    cube_map.insert(points)
    cube_map.insert(points[:5])
    np.testing.assert_array_equal(cube_map.points(), points[:1])


def test_points_outside_are_counted() -> None:
    cube_map = CubeMap(SMALL, 0.5)
    far = np.array([[10.1, 0.0, 0.0], [0.0, 1e300, 0.0], [0.0, 0.0, -6.1], [9.9, 0.0, 0.0]])
    cube_map.insert(far)
    assert (cube_map.stats.outside, cube_map.count()) == (3, 1)
    cube_map.insert(far)
    assert (cube_map.stats.outside, cube_map.count()) == (6, 1)
    # A fine grid ends inside the window: 0.6 * sqrt(1.5) times 2^20 voxels of 1e-5 m are 7.7 m.
    fine = CubeMap(MapConfig(), 1e-5)
    fine.insert(np.array([[7.8, 0.0, 0.0], [7.7, 7.7, -7.7]]))
    assert (fine.stats.outside, fine.count()) == (1, 1)


def test_an_archive_that_is_given_is_used_though_it_is_empty() -> None:
    archive = Archive(grid_of(SMALL, 0.5), np.inf, None)
    cube_map = CubeMap(SMALL, 0.5, archive)
    cube_map.insert(np.zeros((1, 3)))
    cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    assert archive.count() == 1


def test_results_do_not_share_memory_with_the_map() -> None:
    cube_map = CubeMap(SMALL, 0.5)
    given = np.array([[0.1, 0.1, 0.1]])
    cube_map.insert(given)
    given[:] = 7.0
    cube_map.points()[:] = 7.0
    cube_map.nearest(np.zeros((1, 3)), 1, 9.0, [(0, 0, 0)])[0][:] = 7.0
    np.testing.assert_array_equal(cube_map.points(), [[0.1, 0.1, 0.1]])


def test_float32_points_are_averaged_in_float64() -> None:
    points = np.random.default_rng(4).uniform(-1.0, 1.0, (200, 3)).astype(np.float32)
    single, double = CubeMap(SMALL, 0.5), CubeMap(SMALL, 0.5)
    single.insert(points)
    double.insert(points.astype(np.float64))
    np.testing.assert_array_equal(single.points(), double.points())
    assert single.points().dtype == np.float64


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: m.insert(np.zeros((3, 4))), r"points_map: expected \(N, 3\).*\(3, 4\)"),
        (lambda m: m.insert(np.array([[0.0, np.nan, np.inf]])), "points_map: .* 2 NaN"),
        (lambda m: m.nearest(np.zeros(3), 5, 1.0, []), "queries"),
        (lambda m: m.nearest(np.full((1, 3), np.inf), 5, 1.0, []), "queries"),
        (lambda m: m.nearest(np.zeros((1, 3)), 0, 1.0, []), "k: expected at least 1, got 0"),
        (lambda m: m.nearest(np.zeros((1, 3)), 5, 0.0, []), "max_distance"),
        (lambda m: m.nearest(np.zeros((1, 3)), 5, np.nan, []), "max_distance"),
        (lambda m: m.recenter(np.zeros(2)), r"position: expected \(3,\)"),
        (lambda m: m.recenter(np.array([0.0, np.nan, 0.0])), "position"),
        (lambda m: m.recenter(np.array([0.0, 1e300, 0.0])), "position: .*within 385271 m"),
        (lambda m: m.neighbourhood(np.eye(3)), "map_T_lidar"),
        (lambda m: m.neighbourhood(np.full((4, 4), np.nan)), "map_T_lidar"),
    ],
)
def test_bad_input(call: Callable[[CubeMap], object], message: str) -> None:
    cube_map = CubeMap(SMALL, 0.5)
    cube_map.insert(np.zeros((1, 3)))
    before = cube_map.stats
    with pytest.raises(InputError, match="^" + message):
        call(cube_map)
    assert cube_map.stats == before


@pytest.mark.parametrize("voxel_size", [0.0, -1.0, np.nan, np.inf])
def test_bad_voxel_size(voxel_size: float) -> None:
    with pytest.raises(ConfigError, match="voxel_size"):
        CubeMap(MapConfig(), voxel_size)


@pytest.mark.parametrize("archive", ["memory", "disk"])
def test_points_move_with_their_owner_and_nothing_else_does(tmp_path, archive):
    config = MapConfig(
        cube_size=10.0, window=(3, 3, 3), window_margin=0,
        archive_dir=str(tmp_path) if archive == "disk" else None,
        archive_megabytes=1e-6 if archive == "disk" else 100.0,
    )  # fmt: skip
    cubes = CubeMap(config, 0.5)
    rng = np.random.default_rng(0)
    parts = [rng.uniform(-4.0, 4.0, (60, 3)) + np.array([x, 0, 0]) for x in (0.0, 10.0, 20.0, 30.0)]
    for owner, part in enumerate(parts):
        cubes.recenter(part.mean(axis=0))
        cubes.owner = owner
        cubes.insert(part)
    assert cubes.stats.archived
    held = {tuple(point) for point in cubes.points(archived=True).round(6).tolist()}
    count = cubes.move({0: moved_by(30.5), 3: moved_by(-30.5)})  # in, and out
    after = cubes.points(archived=True)
    assert 90 < count <= 120
    assert len(after) == len(held)  # they changed places, and met nothing
    expected = set()
    for point in held:
        shift = 30.5 if point[0] < 5.0 else -30.5 if point[0] > 25.0 else 0.0
        expected.add((round(point[0] + shift, 6), *point[1:]))
    assert {tuple(point) for point in after.round(6).tolist()} == expected
    here = cubes.points()
    assert len(here) > 0
    assert (here[:, 0] > 5.0).all()  # those of the window


def test_a_moved_point_gives_way_to_one_that_was_there():
    cubes = CubeMap(MapConfig(), 0.4)
    for owner, x in enumerate((0.1, 1.1, 2.1)):
        cubes.owner = owner
        cubes.insert(np.array([[x, 0.1, 0.1]]))
    before = cubes.nearest(np.zeros((1, 3)), 1, np.inf, [(0, 0, 0)])[0]
    assert cubes.move({2: moved_by(-1.9), 1: moved_by(-0.85)}) == 2
    np.testing.assert_array_equal(cubes.points()[:, 0], [0.1])
    after = cubes.nearest(np.full((1, 3), 2.0), 1, np.inf, [(0, 0, 0)])[0]
    np.testing.assert_array_equal(after, before)  # its trees know that
    assert cubes.move({7: moved_by(1.0)}) == 0


@pytest.mark.parametrize("on_disk", [False, True])
def test_a_point_may_move_to_where_no_cube_was_ever_kept(tmp_path, on_disk):
    config = MapConfig(
        cube_size=10.0, window=(3, 3, 3), archive_dir=str(tmp_path) if on_disk else None
    )
    cubes = CubeMap(config, 0.5)
    cubes.insert(np.array([[0.1, 0.1, 0.1]]))
    assert cubes.move({0: moved_by(200.0)}) == 1
    assert cubes.count() == 0
    assert cubes.stats.archived_points == 1
    np.testing.assert_allclose(cubes.points(archived=True), [[200.1, 0.1, 0.1]])


def test_points_moved_beyond_the_voxel_grid_are_counted():
    """Voxels of 1e-5 m end at 7.7 m, and the window of one cube at 1 m."""
    cubes = CubeMap(SMALL.changed(cube_size=2.0, window=(1, 1, 1), window_margin=0), 1e-5)
    for owner in range(3):
        cubes.owner = owner
        cubes.insert(np.array([[0.1 * owner, 0.0, 0.0], [0.1 * owner, 0.5, 0.0]]))
    assert cubes.move({0: moved_by(7.5), 1: moved_by(8.0)}) == 4
    assert (cubes.stats.outside, cubes.stats.archived_points, cubes.count()) == (2, 2, 2)
    assert cubes.move({2: moved_by(1e6)}) == 2
    assert (cubes.stats.outside, cubes.stats.archived_points, cubes.count()) == (4, 2, 0)


@pytest.mark.parametrize(("insertion", "lowest", "highest"), [
    ("settled", 0.85, 1.15), ("centroid", 0.0, 0.8)
])  # fmt: skip
def test_a_wall_along_the_axes_is_not_pulled_to_a_border_of_voxels(insertion, lowest, highest):
    """It leans by half a degree, at a border of voxels along the axes, and is seen ten times."""
    lean, rng, slopes = np.deg2rad(0.5), np.random.default_rng(3), []
    for _ in range(12):
        cubes = CubeMap(MapConfig(insertion=insertion), 0.4)
        for _ in range(10):
            y, z = rng.uniform(-4.0, 4.0, 600), rng.uniform(-1.5, 1.5, 600)
            noise = 0.02 * rng.standard_normal(600)
            cubes.insert(np.column_stack((4.0 + lean * z + noise, y, z)))
        found = cubes.points()
        slopes.append(np.polyfit(found[:, 2], found[:, 0], 1)[0] / lean)
    assert lowest < np.mean(slopes) < highest


def test_a_thinned_map_is_that_of_the_window_in_larger_voxels(tmp_path):
    config = SMALL.changed(insertion="settled", archive_dir=str(tmp_path))
    cubes = CubeMap(config, 0.5)
    cubes.insert(np.zeros((1, 3)))
    cubes.recenter(np.array([100.0, 0.0, 0.0]))
    points = np.array([[98.1, 0.1, 0.1], [100.1, 0.1, 0.1], [101.7, 0.1, 0.1]])
    cubes.insert(points)
    folders = list(tmp_path.iterdir())
    thin = cubes.thinned(4.0)  # edges of 2 m: from 98 to 100 and from 100 to 102
    np.testing.assert_allclose(thin.points(archived=True), [points[0], [100.9, 0.1, 0.1]])
    assert thin.window == cubes.window
    assert list(tmp_path.iterdir()) == folders
    np.testing.assert_array_equal(cubes.points(), points)
