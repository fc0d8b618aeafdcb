from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import pairwise, product
from pathlib import Path

import gtsam
import numpy as np
import pytest

from loam_gtsam.config import MapConfig
from loam_gtsam.cubemap import CubeIndex, CubeMap
from loam_gtsam.geometry import voxel_filter, voxel_keys
from loam_gtsam.io.state import freeze, thaw
from loam_gtsam.types import ConfigError, FloatArray, InputError

ALL_AROUND = MapConfig(field_of_view=False)
CENTROID = MapConfig(insertion="centroid")
SMALL = MapConfig(
    cube_size=4.0, window=(5, 5, 3), window_margin=1, neighbourhood=(3, 3, 3), field_of_view=False
)


def small(**changes: object) -> MapConfig:
    return MapConfig(**{name: getattr(SMALL, name) for name in SMALL.__slots__} | changes)


def pose(x: float, y: float, z: float, roll: float = 0.0, pitch: float = 0.0) -> FloatArray:
    matrix: FloatArray = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, 0.4), (x, y, z)).matrix()
    return matrix


def brute_force(
    points: FloatArray, queries: FloatArray, k: int, max_distance: float
) -> tuple[FloatArray, FloatArray]:
    squared = ((queries[:, None, :] - points) ** 2).sum(axis=2)
    squared[squared >= max_distance**2] = np.inf
    missing = max(0, k - len(points))
    squared = np.pad(squared, ((0, 0), (0, missing)), constant_values=np.inf)
    points = np.pad(points, ((0, missing), (0, 0)), constant_values=np.nan)
    pick = np.argsort(squared, axis=1, kind="stable")[:, :k]
    squared = np.take_along_axis(squared, pick, axis=1)
    found = points[pick]
    found[np.isinf(squared)] = np.nan
    return found, squared


class Reference:
    """What the map should be, written the slow and obvious way, without any window shortcut."""

    def __init__(self, config: MapConfig, voxel_size: float) -> None:
        self.config, self.voxel = config, voxel_size
        self.cubes: dict[CubeIndex, FloatArray] = {}
        self.low = [-(n // 2) for n in config.window]

    def cell(self, point: FloatArray) -> CubeIndex:
        half, size = self.config.cube_size / 2, self.config.cube_size
        x, y, z = (int(np.floor((c + half) / size)) for c in point)
        return x, y, z

    def recenter(self, position: FloatArray) -> None:
        for axis, (c, n) in enumerate(zip(self.cell(position), self.config.window, strict=True)):
            while c - self.low[axis] < self.config.window_margin:
                self.low[axis] -= 1
            while c - self.low[axis] >= n - self.config.window_margin:
                self.low[axis] += 1

    def inside(self, index: CubeIndex) -> bool:
        spans = zip(index, self.low, self.config.window, strict=True)
        return all(low <= i < low + n for i, low, n in spans)

    def insert(self, points: FloatArray) -> None:
        new: dict[CubeIndex, list[FloatArray]] = {}
        for point in points:
            if self.inside(self.cell(point)):
                new.setdefault(self.cell(point), []).append(point)
        for index, group in new.items():
            union = np.concatenate((self.cubes.get(index, np.empty((0, 3))), np.array(group)))
            if self.config.insertion == "centroid":
                self.cubes[index] = voxel_filter(union, self.voxel)
            else:
                _, first = np.unique(voxel_keys(union, self.voxel), return_index=True)
                self.cubes[index] = union[first]

    def window_points(self) -> FloatArray:
        parts = [self.cubes[index] for index in sorted(self.cubes) if self.inside(index)]
        return np.concatenate([np.empty((0, 3)), *parts])


@pytest.mark.parametrize("insertion", ["centroid", "settled"])
@pytest.mark.parametrize("megabytes", [100.0, 0.0])
def test_random_operations_against_reference(
    insertion: str, megabytes: float, tmp_path: Path
) -> None:
    config = small(insertion=insertion, archive_megabytes=megabytes, archive_dir=str(tmp_path))
    rng = np.random.default_rng(3)
    cube_map, reference = CubeMap(config, 0.5), Reference(config, 0.5)
    position = np.zeros(3)
    found_any = partial = 0
    for _ in range(150):
        position += rng.normal(0.0, 3.0, 3) - 0.05 * position
        cube_map.recenter(position)
        reference.recenter(position)
        assert cube_map.window[0] == tuple(reference.low)
        points = position + rng.normal(0.0, 3.0, (60, 3))
        cube_map.insert(points)
        reference.insert(points)
        expected = reference.window_points()
        np.testing.assert_allclose(cube_map.points(), expected, rtol=0, atol=1e-12)

        cubes = cube_map.neighbourhood(pose(*position))
        near = cube_map.points(cubes)
        assert cube_map.count(cubes) == len(near)
        # Half of the queries sit on a face, edge or corner of a cube.
        queries = position + rng.normal(0.0, 3.0, (40, 3))
        border = np.round((queries[:20] - 2.0) / 4.0) * 4.0 + 2.0
        snap = rng.random((20, 3)) < 0.5
        queries[:20][snap] = border[snap] + rng.choice([-1e-9, 0.0, 1e-9], snap.sum())
        radius = rng.choice([0.3, 1.0, 3.0, 9.0, np.inf])
        k = int(rng.integers(1, 8))
        got, got_squared = cube_map.nearest(queries, k, radius, cubes)
        want, want_squared = brute_force(near, queries, k, radius)
        np.testing.assert_allclose(got_squared, want_squared, rtol=1e-12)
        np.testing.assert_array_equal(got, want)
        found_any += np.isfinite(got_squared).sum()
        partial += np.isinf(got_squared).sum()
    assert found_any > 1000
    assert partial > 1000
    assert cube_map.stats.evicted > 20
    assert cube_map.stats.restored > 20
    assert cube_map.stats.dropped_cubes == 0


def test_border_query_finds_the_eight_cubes_that_meet() -> None:
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    corner = np.array([-25.0, 25.0, -25.0])
    cube_map = CubeMap(ALL_AROUND, 0.4)
    cube_map.insert(corner + 0.3 * signs)
    cubes = cube_map.neighbourhood(np.eye(4))
    assert len(cubes) == 8
    points, squared = cube_map.nearest(corner[None], 9, 1.0, cubes)
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
    points, squared = cube_map.nearest(np.zeros((1, 3)), 3, 3.0, [(0, 0, 0)])
    np.testing.assert_array_equal(squared, [[4.0, np.inf, np.inf]])
    np.testing.assert_array_equal(points[0, 0], [0.0, 2.0, 0.0])
    _, squared = cube_map.nearest(np.zeros((1, 3)), 3, 3.001, [(0, 0, 0), (0, 0, 0)])
    np.testing.assert_array_equal(squared, [[4.0, 9.0, np.inf]])


def test_empty_map_and_empty_arrays() -> None:
    cube_map = CubeMap(MapConfig(), 0.4)
    cube_map.insert(np.empty((0, 3)))
    assert cube_map.stats.cubes == cube_map.count() == 0
    assert cube_map.points().shape == (0, 3)
    assert cube_map.neighbourhood(np.eye(4)) == ()
    points, squared = cube_map.nearest(np.zeros((2, 3)), 5, 1.0, [(0, 0, 0)])
    assert points.shape == (2, 5, 3)
    assert np.isnan(points).all()
    assert np.isinf(squared).all()
    cube_map.insert(np.zeros((1, 3)))
    points, squared = cube_map.nearest(np.empty((0, 3)), 5, 1.0, [(0, 0, 0)])
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
    reference = Reference(MapConfig(), 0.4)
    slack = MapConfig().window[axis] // 2 - 3
    for step in range(2 * slack + 5):
        position = np.zeros(3)
        position[axis] = 50.0 * sign * step
        before = cube_map.window
        cube_map.recenter(position)
        reference.recenter(position)
        assert cube_map.window[0] == tuple(reference.low)
        assert (cube_map.window == before) == (step <= slack)


def test_jump_of_ten_kilometres_and_back() -> None:
    cube_map = CubeMap(MapConfig(), 0.4)
    points = np.random.default_rng(0).uniform(-80, 80, (500, 3))
    cube_map.insert(points)
    before, n_cubes = cube_map.points(), cube_map.stats.cubes
    assert cube_map.recenter(np.array([10e3, -10e3, 0.0])) == n_cubes
    assert cube_map.window[0] == (200 - 17, -203, -5)
    assert cube_map.count() == 0
    assert cube_map.stats.archived == n_cubes
    cube_map.insert(np.array([[10e3, -10e3, 0.0]]))
    assert cube_map.recenter(np.zeros(3)) == 1
    np.testing.assert_array_equal(cube_map.points(), before)
    assert len(cube_map.points(archived=True)) == len(before) + 1
    assert cube_map.stats.restored == n_cubes


def test_a_window_that_holds_still_evicts_nothing() -> None:
    cube_map = CubeMap(SMALL, 0.5)
    cube_map.insert(np.zeros((1, 3)))
    assert cube_map.recenter(np.array([3.9, 0.0, 0.0])) == 0
    assert cube_map.stats.evicted == 0


def test_margin_wider_than_the_window_is_cut() -> None:
    cube_map = CubeMap(small(window=(3, 3, 1), window_margin=3), 0.5)
    cube_map.recenter(np.array([40.0, 0.0, 8.0]))
    assert cube_map.window == ((9, -1, 2), (11, 1, 2))


@pytest.mark.parametrize("megabytes", [10.0, 0.0])
@pytest.mark.parametrize("insertion", ["centroid", "settled"])
def test_round_trip_is_bit_identical(tmp_path: Path, megabytes: float, insertion: str) -> None:
    """A map that was archived in between goes on exactly as one that was not."""
    rng = np.random.default_rng(1)
    config = small(archive_dir=str(tmp_path), archive_megabytes=megabytes, insertion=insertion)
    travelled, stayed = CubeMap(config, 0.5), CubeMap(config, 0.5)
    first, second = rng.normal(0.0, 3.0, (2, 800, 3))
    for cube_map in (travelled, stayed):
        cube_map.insert(first)
    evicted = travelled.recenter(np.array([1e3, 0.0, 0.0]))
    files = sorted(tmp_path.glob("cubes_*/*"))
    assert len(files) == (evicted if megabytes == 0.0 else 0)
    assert all(file.suffix == ".npy" for file in files)
    assert len(stayed.points()) > 100
    np.testing.assert_array_equal(travelled.points(archived=True), stayed.points())
    assert travelled.stats.archived_points == stayed.count()  # in memory or on disk
    travelled.recenter(np.zeros(3))  # comes from +x: its window starts one cube farther on
    stayed.recenter(np.array([8.0, 0.0, 0.0]))
    assert travelled.window == stayed.window == ((-1, -2, -1), (3, 2, 1))
    for cube_map in (travelled, stayed):
        cube_map.insert(second)
    np.testing.assert_array_equal(travelled.points(), stayed.points())
    cubes = stayed.neighbourhood(np.eye(4))
    for got, want in zip(
        travelled.nearest(first, 5, 2.0, cubes), stayed.nearest(first, 5, 2.0, cubes), strict=True
    ):
        np.testing.assert_array_equal(got, want)
    left = len(list(tmp_path.glob("cubes_*/*")))
    assert left == (travelled.stats.archived + stayed.stats.archived if megabytes == 0.0 else 0)


def test_two_maps_share_an_archive_folder(tmp_path: Path) -> None:
    config = small(archive_dir=str(tmp_path / "new" / "folder"), archive_megabytes=0.0)
    maps = [CubeMap(config, 0.5) for _ in range(2)]
    for shift, cube_map in enumerate(maps):
        cube_map.insert(np.array([[0.1 * shift, 0.0, 0.0]]))
        cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    for shift, cube_map in enumerate(maps):
        cube_map.recenter(np.zeros(3))
        np.testing.assert_array_equal(cube_map.points(), [[0.1 * shift, 0.0, 0.0]])


def test_budget_drops_the_oldest_counts_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    """Each stop leaves one cube of 7 points, 168 bytes; two of them fit into 400 bytes."""
    cube_map = CubeMap(small(archive_megabytes=400e-6), 0.5)
    heap = np.arange(-1.5, 1.6, 0.5)[:, None] * np.ones(3)
    with caplog.at_level(logging.WARNING, logger="loam_gtsam.cubemap"):
        for stop in range(5):
            position = np.array([100.0 * stop, 0.0, 0.0])
            cube_map.recenter(position)
            cube_map.insert(position + heap)
            dropped = max(0, stop - 2)
            stats = cube_map.stats
            assert (stats.evicted, stats.archived) == (stop, min(stop, 2))
            assert (stats.dropped_cubes, stats.dropped_points) == (dropped, 7 * dropped)
    assert len(caplog.records) == 1
    assert "archive_megabytes" in caplog.text
    cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    assert cube_map.stats.restored == 0
    cube_map.recenter(np.array([300.0, 0.0, 0.0]))
    assert cube_map.stats.restored == 1
    assert cube_map.count() == 7


def test_restoring_goes_before_dropping() -> None:
    """A cube that comes back is not pushed out by one that leaves in the same step."""
    cube_map = CubeMap(small(archive_megabytes=30e-6), 0.5)
    cube_map.insert(np.zeros((1, 3)))
    cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    cube_map.insert(np.array([[100.0, 0.0, 0.0]]))
    cube_map.recenter(np.zeros(3))
    assert (cube_map.stats.restored, cube_map.stats.dropped_cubes) == (1, 0)


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.unlink(),
        lambda file: file.write_bytes(file.read_bytes()[:-5]),
        lambda file: np.save(file, np.zeros((1, 2))),
    ],
)
def test_unreadable_archive_is_counted(
    tmp_path: Path, damage: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    cube_map = CubeMap(small(archive_dir=str(tmp_path), archive_megabytes=0.0), 0.5)
    cube_map.insert(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 4.0, 0.0]]))
    cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    damage(next(tmp_path.glob("cubes_*/cube_0_0_0.npy")))
    cube_map.recenter(np.zeros(3))
    stats = cube_map.stats
    assert (stats.dropped_cubes, stats.dropped_points, stats.restored) == (1, 2, 1)
    assert "cannot read" in caplog.text
    assert stats.archived == 0


def test_archive_that_cannot_be_written_is_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cube_map = CubeMap(small(archive_dir=str(tmp_path), archive_megabytes=0.0), 0.5)
    cube_map.insert(np.zeros((1, 3)))
    next(tmp_path.glob("cubes_*")).rmdir()
    cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    assert (cube_map.stats.dropped_cubes, cube_map.stats.archived) == (1, 0)
    assert "cannot write" in caplog.text


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.5, -0.3), (np.pi / 2, 0.0), (0.0, 1.2)])
def test_field_of_view_against_the_angle(roll: float, pitch: float) -> None:
    """A cube counts if a corner is 30 to 150 degrees off the lidar's z axis."""
    around = [np.array(index) for index in product(range(-2, 3), repeat=3)]
    centres = 50.0 * np.array(around)
    everything, viewed = CubeMap(ALL_AROUND, 0.4), CubeMap(MapConfig(), 0.4)
    for cube_map in (everything, viewed):
        cube_map.insert(centres)
    map_T_lidar = pose(3.0, -7.0, 20.0, roll, pitch)
    up = map_T_lidar[:3, 2]
    expected = []
    for index, centre in zip(product(range(-2, 3), repeat=3), centres, strict=True):
        rays = centre + 25.0 * np.array(list(product((-1, 1), repeat=3))) - map_T_lidar[:3, 3]
        angles = np.degrees(np.arccos(rays @ up / np.linalg.norm(rays, axis=1)))
        if ((angles > 30.0) & (angles < 150.0)).any():
            expected.append(index)
    assert 100 < len(expected) < 125
    assert viewed.neighbourhood(map_T_lidar) == tuple(expected)
    assert len(everything.neighbourhood(map_T_lidar)) == 125


def test_neighbourhood_is_as_wide_as_configured() -> None:
    cube_map = CubeMap(MapConfig(neighbourhood=(5, 5, 3), field_of_view=False), 0.4)
    cube_map.insert(50.0 * np.array(list(product(range(-4, 5), repeat=3)), dtype=np.float64))
    cubes = cube_map.neighbourhood(pose(60.0, 0.0, 30.0))
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


def test_centroid_counts_the_old_point_once() -> None:
    cube_map = CubeMap(CENTROID, 0.4)
    cube_map.insert(np.array([[0.0, 0.1, 0.1], [0.2, 0.1, 0.1]]))
    cube_map.insert(np.array([[0.3, 0.1, 0.1]]))
    np.testing.assert_allclose(cube_map.points(), [[0.2, 0.1, 0.1]])


def test_centroid_equals_the_voxel_filter_of_the_union() -> None:
    old, new = np.random.default_rng(2).uniform(-20.0, 20.0, (2, 3000, 3)) * (1, 1, 0.05)
    cube_map = CubeMap(CENTROID, 0.4)
    cube_map.insert(old)
    union = np.concatenate((voxel_filter(old, 0.4), new))
    cube_map.insert(new)
    np.testing.assert_allclose(cube_map.points(), voxel_filter(union, 0.4), rtol=0, atol=1e-13)


@pytest.mark.parametrize("x", [1.4, 1.6])
def test_rounding_cannot_move_a_centroid_out_of_its_voxel(x: float) -> None:
    """The plain mean of six times 1.4 is one bit above it, that of six times 1.6 one bit below.

    Either is then in the next voxel of 0.2 m.
    """
    points = np.full((6, 3), x)
    plain = np.add.reduce(points, axis=0)[None] / 6.0
    assert voxel_keys(plain, 0.2) != voxel_keys(points[:1], 0.2)
    cube_map = CubeMap(CENTROID, 0.2)
    cube_map.insert(points)
    cube_map.insert(points[:5])
    np.testing.assert_array_equal(cube_map.points(), points[:1])


def test_settled_keeps_the_first_point_of_a_voxel() -> None:
    cube_map = CubeMap(small(insertion="settled"), 0.5)
    cube_map.insert(np.array([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [4.1, 0.1, 0.1]]))
    np.testing.assert_array_equal(cube_map.points(), [[0.1, 0.1, 0.1], [4.1, 0.1, 0.1]])
    cube_map.insert(np.array([[0.3, 0.3, 0.3], [4.4, 0.1, 0.1], [4.6, 0.1, 0.1]]))
    np.testing.assert_array_equal(
        cube_map.points(), [[0.1, 0.1, 0.1], [4.1, 0.1, 0.1], [4.6, 0.1, 0.1]]
    )


def test_settled_trees_are_kept_until_many_points_are_new_and_stay_exact() -> None:
    cube_map = CubeMap(MapConfig(insertion="settled"), 0.4)
    rng = np.random.default_rng(5)
    cube_map.insert(rng.uniform(-8.0, 8.0, (3000, 3)))
    queries = rng.uniform(-8.0, 8.0, (300, 3))
    trees = []
    for _ in range(25):
        got = cube_map.nearest(queries, 5, 1.5, [(0, 0, 0)])
        want = brute_force(cube_map.points(), queries, 5, 1.5)
        np.testing.assert_array_equal(got[0], want[0])
        np.testing.assert_allclose(got[1], want[1], rtol=1e-12)
        trees.append(cube_map._searches[0]._tree)
        cube_map.insert(rng.uniform(-8.0, 8.0, (30, 3)))  # 1 % of the tree
    assert [a is b for a, b in pairwise(trees)].count(False) == 2


def test_settled_keeps_everything_of_an_unchanged_cube() -> None:
    cube_map = CubeMap(small(insertion="settled"), 0.5)
    points = np.array([[0.1, 0.1, 0.1], [4.1, 0.1, 0.1]])
    cube_map.insert(points)
    cubes = [(0, 0, 0), (1, 0, 0)]
    cube_map.nearest(points, 1, 9.0, cubes)
    before = {index: cube.points for index, cube in cube_map._cubes.items()}
    (search,) = cube_map._searches
    cube_map.insert(points + 0.1)
    cube_map.nearest(points, 1, 9.0, cubes)
    assert all(cube.points is before[index] for index, cube in cube_map._cubes.items())
    assert cube_map._searches == [search]
    assert search._recent == []


def test_points_that_wait_to_be_merged_in_are_there_all_the_same() -> None:
    rng = np.random.default_rng(4)
    waiting, merged = CubeMap(SMALL, 0.2), CubeMap(SMALL, 0.2)
    waited = 0
    for points in (rng.uniform(-2.0, 2.0, (4000, 3)), *rng.uniform(-2.0, 2.0, (30, 20, 3))):
        again = points[:5]  # in voxels that have just been taken
        for cube_map in (waiting, merged):
            cube_map.insert(points)
            cube_map.insert(again)
        assert len(merged.points()) == waiting.count() == waiting.stats.points
        (cube,) = waiting._cubes.values()
        waited += len(cube._new.keys) > 0
        np.testing.assert_array_equal(
            waiting.nearest(points, 1, 9.0, [(0, 0, 0)])[0],
            merged.nearest(points, 1, 9.0, [(0, 0, 0)])[0],
        )
    assert 10 < waited < 31  # merged in by themselves now and then
    keys = voxel_keys(waiting.points(), 0.2)
    assert np.all(np.diff(keys) > 0)
    np.testing.assert_array_equal(waiting.points(), merged.points())


def test_a_restored_map_goes_on_with_the_trees_it_had() -> None:
    """Also with the points that were added since: at which insert a tree is due stays the same."""
    rng = np.random.default_rng(6)
    cube_map, again = CubeMap(SMALL, 0.2), CubeMap(SMALL, 0.2)
    cubes = [(0, 0, 0), (1, 0, 0)]
    queries = rng.uniform(-2.0, 6.0, (200, 3))
    cube_map.insert(rng.uniform((-2, -2, -2), (6, 2, 2), (2000, 3)))
    cube_map.nearest(queries, 5, 1.0, cubes)
    cube_map.insert(rng.uniform((-2, -2, -2), (6, 2, 2), (100, 3)))
    thaw(freeze({"map": cube_map}, {"config": SMALL}), {"map": again}, {"config": SMALL})
    (search,), (restored,) = cube_map._searches, again._searches
    assert restored.cubes == search.cubes == set(cubes)
    assert len(search._recent) > 0
    for one, other in zip(search._recent, restored._recent, strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(
        cube_map.nearest(queries, 5, 1.0, cubes), again.nearest(queries, 5, 1.0, cubes), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    assert again._searches == [restored]


def test_centroid_drops_only_the_trees_it_changed() -> None:
    cube_map = CubeMap(small(insertion="centroid"), 0.5)
    cube_map.insert(np.array([[0.1, 0.1, 0.1], [4.1, 0.1, 0.1]]))
    for index in ((0, 0, 0), (1, 0, 0)):
        cube_map.nearest(np.zeros((1, 3)), 1, 9.0, [index])
    kept = cube_map._searches[1]
    cube_map.insert(np.array([[0.3, 0.1, 0.1]]))
    assert cube_map._searches == [kept]
    cubes = cube_map.neighbourhood(np.eye(4))
    assert cube_map.nearest(np.array([[0.2, 0.1, 0.1]]), 1, 0.5, cubes)[1] < 1e-30


@pytest.mark.parametrize("insertion", ["centroid", "settled"])
def test_searches_of_changing_cubes_see_all_of_theirs_and_nothing_else(insertion: str) -> None:
    """Cubes that come and go between searches, as the sensor walks along their border."""
    rng = np.random.default_rng(8)
    cube_map = CubeMap(small(insertion=insertion), 0.3)
    cubes = list(product((-1, 0, 1), repeat=2))
    built = 0
    for step in range(60):
        centre = 2.0 * np.sin([0.3 * step, 0.11 * step, 0.0])
        cube_map.insert(centre + rng.normal(0.0, 1.5, (40, 3)))
        here = [(x, y, 0) for x, y in cubes if (x + y + step // 3) % 3]
        queries = rng.uniform(-5.0, 5.0, (30, 3))
        earlier = cube_map._searches.copy()
        got = cube_map.nearest(queries, 3, 2.0, here)
        built += cube_map._searches[-1] not in earlier
        want = brute_force(cube_map.points(here), queries, 3, 2.0)
        np.testing.assert_array_equal(got[0], want[0])
        assert len(cube_map._searches) <= 2
    assert built < 60 if insertion == "settled" else built == 60


def test_a_sensor_on_a_border_needs_no_new_trees() -> None:
    cube_map = CubeMap(SMALL, 0.5)
    cube_map.insert(np.array([[0.1, 0.1, 0.1], [4.1, 0.1, 0.1], [-3.9, 0.1, 0.1]]))
    sides = [[(0, 0, 0), (1, 0, 0)], [(0, 0, 0), (-1, 0, 0)]]
    for side in sides:
        cube_map.nearest(np.zeros((1, 3)), 1, 9.0, side)
    kept = set(cube_map._searches)
    for side in [*sides, *sides]:
        cube_map.nearest(np.zeros((1, 3)), 1, 9.0, side)
        assert set(cube_map._searches) == kept


def test_a_cube_that_was_archived_is_not_searched_from_memory() -> None:
    cube_map = CubeMap(SMALL, 0.5)
    cube_map.insert(np.array([[0.1, 0.1, 0.1]]))
    cube_map.nearest(np.zeros((1, 3)), 1, 9.0, [(0, 0, 0)])
    cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    assert cube_map._searches == []
    assert np.isinf(cube_map.nearest(np.zeros((1, 3)), 1, 9.0, [(0, 0, 0)])[1])


def test_points_outside_are_counted() -> None:
    cube_map = CubeMap(SMALL, 0.5)
    far = np.array([[10.1, 0.0, 0.0], [0.0, 1e300, 0.0], [0.0, 0.0, -6.1], [9.9, 0.0, 0.0]])
    cube_map.insert(far)
    assert (cube_map.stats.outside, cube_map.count()) == (3, 1)
    cube_map.insert(far)
    assert (cube_map.stats.outside, cube_map.count()) == (6, 1)
    # A fine grid ends inside the window: 2^20 voxels of 1e-5 m are 10.5 m.
    fine = CubeMap(MapConfig(), 1e-5)
    fine.insert(np.array([[11.0, 0.0, 0.0], [10.0, 0.0, 0.0]]))
    assert (fine.stats.outside, fine.count()) == (1, 1)


def test_results_do_not_share_memory_with_the_map() -> None:
    cube_map = CubeMap(SMALL, 0.5)
    given = np.array([[0.1, 0.1, 0.1]])
    cube_map.insert(given)
    given[:] = 7.0
    cube_map.points()[:] = 7.0
    cube_map.nearest(np.zeros((1, 3)), 1, 9.0, [(0, 0, 0)])[0][:] = 7.0
    np.testing.assert_array_equal(cube_map.points(), [[0.1, 0.1, 0.1]])


def test_neighbour_just_behind_a_border() -> None:
    cube_map = CubeMap(ALL_AROUND, 0.4)
    cube_map.insert(np.array([[25.0, 0.0, 0.0]]))
    query = np.array([[24.0, 0.0, 0.0]])
    assert cube_map.nearest(query, 1, np.nextafter(1.0, 2.0), [(0, 0, 0), (1, 0, 0)])[1] == 1.0
    assert np.isinf(cube_map.nearest(query, 1, 1.0, [(0, 0, 0), (1, 0, 0)])[1])


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
        (lambda m: m.recenter(np.array([0.0, 1e300, 0.0])), "position: .*within 524288 m"),
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


def test_bad_archive_dir(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"map\.archive_dir"):
        CubeMap(MapConfig(archive_dir=str(tmp_path / "file")), 0.4)


def moved_by(x):
    move = np.eye(4)
    move[0, 3] = x
    return move


@pytest.mark.parametrize("archive", ["memory", "disk"])
def test_points_move_with_their_owner_and_nothing_else_does(tmp_path, archive):
    """Also those in the archive, out of it and into it."""
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


@pytest.mark.parametrize("megabytes", [100.0, 0.0])
def test_moved_points_join_those_of_a_cube_in_the_archive(tmp_path, megabytes):
    """Of the moved ones too a voxel keeps one, and those that were there stay."""
    config = small(archive_dir=str(tmp_path), archive_megabytes=megabytes)
    cubes = CubeMap(config, 0.5)
    there = np.array([[100.1, 0.1, 0.1], [100.6, 0.1, 0.1], [101.1, 0.1, 0.1]])
    cubes.recenter(there[0])
    cubes.insert(there)
    cubes.recenter(np.zeros(3))
    cubes.owner = 1
    here = np.array([[0.1, 0.1, 0.1], [0.6, 0.6, 0.6], [1.6, 0.6, 0.4], [1.6, 0.6, 0.6]])
    cubes.insert(here)
    # The last two come to lie in one voxel, the second in that of a point that was there.
    turned = moved_by(100.0)
    turned[2, 2], turned[1, 1] = -1.0, -1.0
    turned[1:3, 3] = 0.7, 0.65
    arrived = here @ turned[:3, :3].T + turned[:3, 3]
    assert cubes.move({1: turned}) == 4
    assert cubes.count() == 0
    union = np.concatenate([there, arrived])
    _, first = np.unique(voxel_keys(union, 0.5), return_index=True)
    assert sorted(first) == [0, 1, 2, 3, 5]
    np.testing.assert_allclose(cubes.points(archived=True), union[first], atol=1e-12)
    cubes.recenter(np.array([100.0, 0.0, 0.0]))
    assert cubes.count() == 5
    # They can move on, each with its owner.
    assert cubes.move({1: moved_by(-100.0)}) == 2
    np.testing.assert_allclose(cubes.points(), there, atol=1e-12)


def test_points_moved_beyond_the_voxel_grid_are_counted():
    """2^20 voxels of 1e-5 m end at 10.5 m, and the window of one cube at 1 m."""
    cubes = CubeMap(small(cube_size=2.0, window=(1, 1, 1), window_margin=0), 1e-5)
    for owner in range(3):
        cubes.owner = owner
        cubes.insert(np.array([[0.1 * owner, 0.0, 0.0], [0.1 * owner, 0.5, 0.0]]))
    assert cubes.move({0: moved_by(10.0), 1: moved_by(11.0)}) == 4
    assert (cubes.stats.outside, cubes.stats.archived_points, cubes.count()) == (2, 2, 2)
    assert cubes.move({2: moved_by(1e6)}) == 2
    assert (cubes.stats.outside, cubes.stats.archived_points, cubes.count()) == (4, 2, 0)


def test_archived_cubes_without_a_moved_point_are_left_alone(tmp_path):
    cubes = CubeMap(small(archive_dir=str(tmp_path), archive_megabytes=0.0), 0.5)
    for owner, x in enumerate((0.0, 100.0, 200.0, 300.0)):
        cubes.recenter(np.array([x, 0.0, 0.0]))
        cubes.owner = owner
        cubes.insert(np.array([[x, 0.0, 0.0]]))
    files = [next(tmp_path.glob(f"cubes_*/cube_{number}_0_0.npy")) for number in (0, 25, 50)]
    before = [file.stat().st_ino for file in files]
    damaged = files[2].read_bytes()[:-5]
    files[2].write_bytes(damaged)
    assert cubes.move({1: moved_by(0.7), 2: moved_by(0.7)}) == 1
    assert files[0].stat().st_ino == before[0]
    np.testing.assert_allclose(np.load(files[1])[:, 0], [100.7])
    assert (cubes.stats.dropped_cubes, cubes.stats.dropped_points) == (1, 1)
    np.testing.assert_allclose(cubes.points(archived=True)[:, 0], [0.0, 100.7, 300.0])


def test_a_thinned_map_is_that_of_the_window_in_larger_voxels(tmp_path):
    config = small(insertion="settled", archive_dir=str(tmp_path))
    cubes = CubeMap(config, 0.5)
    cubes.insert(np.zeros((1, 3)))
    cubes.recenter(np.array([100.0, 0.0, 0.0]))
    points = np.array([[98.1, 0.1, 0.1], [100.1, 0.1, 0.1], [101.7, 0.1, 0.1]])
    cubes.insert(points)
    folders = list(tmp_path.iterdir())
    thin = cubes.thinned(4.0)  # voxels of 2 m: from 98 to 100 and from 100 to 102
    np.testing.assert_allclose(thin.points(archived=True), [points[0], [100.9, 0.1, 0.1]])
    assert thin.window == cubes.window
    assert list(tmp_path.iterdir()) == folders
    np.testing.assert_array_equal(cubes.points(), points)
