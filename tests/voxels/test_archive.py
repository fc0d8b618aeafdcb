"""Cubes that left the window: they come back bit by bit, or their loss is counted."""

import logging
import pickle
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.cubes import SMALL, moved_by

from loam_gtsam.config import MapConfig
from loam_gtsam.cubemap import CubeMap, grid_of
from loam_gtsam.geometry import OBLIQUE_EDGE, voxel_keys
from loam_gtsam.io.rollback import Before
from loam_gtsam.io.state import freeze, thaw
from loam_gtsam.types import ConfigError
from loam_gtsam.voxels.archive import Archive
from loam_gtsam.voxels.cubes import CubePoints
from loam_gtsam.voxels.tags import tags_of


@pytest.fixture
def small(tmp_path: Path) -> MapConfig:
    """All that leaves the window goes to disk."""
    return SMALL.changed(archive_dir=str(tmp_path), archive_megabytes=0.0)


@pytest.mark.parametrize("megabytes", [10.0, 0.0])
@pytest.mark.parametrize("insertion", ["centroid", "settled"])
def test_round_trip_is_bit_identical(
    tmp_path: Path, small: MapConfig, megabytes: float, insertion: str
) -> None:
    """A map that was archived in between goes on exactly as one that was not."""
    rng = np.random.default_rng(1)
    config = small.changed(archive_megabytes=megabytes, insertion=insertion)
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
    got, want = (cube_map.nearest(first, 5, 2.0, cubes) for cube_map in (travelled, stayed))
    np.testing.assert_array_equal(got[0], want[0])
    np.testing.assert_array_equal(got[1], want[1])
    left = len(list(tmp_path.glob("cubes_*/*")))
    assert left == (travelled.stats.archived + stayed.stats.archived if megabytes == 0.0 else 0)


def test_two_maps_share_an_archive_folder(tmp_path: Path) -> None:
    config = SMALL.changed(archive_dir=str(tmp_path / "new" / "folder"), archive_megabytes=0.0)
    maps = [CubeMap(config, 0.5) for _ in range(2)]
    for shift, cube_map in enumerate(maps):
        cube_map.insert(np.array([[0.1 * shift, 0.0, 0.0]]))
        cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    for shift, cube_map in enumerate(maps):
        cube_map.recenter(np.zeros(3))
        np.testing.assert_array_equal(cube_map.points(), [[0.1 * shift, 0.0, 0.0]])


def test_budget_drops_the_oldest_counts_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    """Each stop leaves one cube of 7 points, 224 bytes; two of them fit into 500 bytes."""
    cube_map = CubeMap(SMALL.changed(archive_megabytes=500e-6), 0.5 / OBLIQUE_EDGE)
    heap = np.arange(-1.4, 1.7, 0.5)[:, None] * np.ones(3)
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
    assert (cube_map.stats.restored, cube_map.count()) == (1, 7)


def test_restoring_goes_before_dropping() -> None:
    """A cube that comes back is not pushed out by one that leaves in the same step."""
    cube_map = CubeMap(SMALL.changed(archive_megabytes=40e-6), 0.5)
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
    tmp_path: Path, small: MapConfig, damage: Callable[[Path], None], caplog: Any
) -> None:
    cube_map = CubeMap(small, 0.5)
    cube_map.insert(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 4.0, 0.0]]))
    cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    damage(next(tmp_path.glob("cubes_*/cube_0_0_0.npy")))
    cube_map.recenter(np.zeros(3))
    stats = cube_map.stats
    assert (stats.dropped_cubes, stats.dropped_points, stats.restored) == (1, 2, 1)
    assert "cannot read" in caplog.text
    assert stats.archived == 0


def test_archive_that_cannot_be_written_is_counted(
    tmp_path: Path, small: MapConfig, caplog: pytest.LogCaptureFixture
) -> None:
    cube_map = CubeMap(small, 0.5)
    cube_map.insert(np.zeros((1, 3)))
    tmp_path.rmdir()
    cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    assert (cube_map.stats.dropped_cubes, cube_map.stats.archived) == (1, 0)
    assert "cannot write" in caplog.text


def test_a_cube_that_is_dropped_while_the_archive_is_read_is_skipped() -> None:
    archive = Archive(grid_of(SMALL, 0.5), 70e-6, None)  # room for two points
    one, two = (CubePoints(np.zeros((n, 3)), tags_of(n, 0)) for n in (1, 2))
    archive.store((0, 0, 0), one)
    archive.store((1, 0, 0), one)
    seen = []
    for index, _ in archive.contents():
        seen.append(index)
        archive.store((2, 0, 0), two)
    assert seen == [(0, 0, 0)]
    assert archive.indices() == [(2, 0, 0)]
    assert archive.take((0, 0, 0)) is None


@pytest.mark.parametrize("place", ["{}/file", "{}/file/below", "/proc"])
def test_bad_archive_dir(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"map\.archive_dir"):
        CubeMap(MapConfig(archive_dir=place.format(tmp_path)), 0.4)


def test_an_archive_has_a_folder_from_its_first_cube_on_disk_as_long_as_it_lives(
    tmp_path: Path, small: MapConfig
) -> None:
    cube_map, unused = CubeMap(small, 0.5), CubeMap(small, 0.5)
    cube_map.insert(np.zeros((1, 3)))
    before = Before(cube_map)
    assert list(tmp_path.iterdir()) == []
    cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    (folder,) = tmp_path.iterdir()
    before.restore()
    cube_map.recenter(np.array([100.0, 0.0, 0.0]))
    copy, pickled = deepcopy(cube_map), pickle.dumps(cube_map)
    assert list(tmp_path.iterdir()) == [folder]
    del cube_map, before, unused
    assert list(tmp_path.iterdir()) == []
    for again in (copy, pickle.loads(pickled)):
        np.testing.assert_array_equal(again.points(archived=True), np.zeros((1, 3)))


@pytest.mark.parametrize("megabytes", [100.0, 0.0])
def test_moved_points_join_those_of_a_cube_in_the_archive(small, megabytes):
    """Of the moved ones too a voxel keeps one, and those that were there stay."""
    cubes = CubeMap(small.changed(archive_megabytes=megabytes), 0.5 / OBLIQUE_EDGE)
    there = np.array([[100.1, 0.1, 0.1], [100.6, 0.1, 0.1], [101.1, 0.1, 0.1]])
    cubes.recenter(there[0])
    cubes.insert(there)
    cubes.recenter(np.zeros(3))
    cubes.owner = 1
    # The last two come to lie in one voxel, the second in that of a point that was there.
    arrived = np.array(
        [[100.1, 0.4, 0.5], [100.6, 0.05, 0.2], [101.4, 0.2, 0.5], [101.4, 0.3, 0.2]]
    )
    turned = moved_by(100.0)
    turned[2, 2], turned[1, 1] = -1.0, -1.0
    turned[1:3, 3] = 0.7, 0.65
    here = (arrived - turned[:3, 3]) @ turned[:3, :3]
    cubes.insert(here)
    assert cubes.move({1: turned}) == 4
    assert cubes.count() == 0
    union = np.concatenate([there, arrived])
    _, first = np.unique(voxel_keys(union, 0.5 / OBLIQUE_EDGE, oblique=True), return_index=True)
    assert sorted(first) == [0, 1, 2, 3, 5]
    np.testing.assert_allclose(cubes.points(archived=True), union[first], atol=1e-12)
    cubes.recenter(np.array([100.0, 0.0, 0.0]))
    assert cubes.count() == 5
    # They can move on, each with its owner.
    assert cubes.move({1: moved_by(-100.0)}) == 2
    left = cubes.points()
    np.testing.assert_allclose(left[left[:, 0].argsort()], there, atol=1e-12)


def test_archived_cubes_without_a_moved_point_are_left_alone(tmp_path, small):
    cubes = CubeMap(small, 0.5)
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


@pytest.mark.parametrize("insertion", ["centroid", "settled"])
@pytest.mark.parametrize("megabytes", [100.0, 1e-3, 0.0])
def test_a_restored_map_goes_on_with_the_archive_it_had(
    small: MapConfig, megabytes: float, insertion: str
) -> None:
    """In memory, part of it on disk, or all of it."""
    rng = np.random.default_rng(2)
    config = small.changed(archive_megabytes=megabytes, insertion=insertion)
    going, resumed = CubeMap(config, 0.5), CubeMap(config, 0.5)
    for stop in range(4):
        going.recenter(np.array([20.0 * stop, 0.0, 0.0]))
        going.owner = stop
        seen_from = np.array([20.0 * stop, 0.0, 9.0])
        going.insert(rng.normal((20.0 * stop, 0.0, 0.0), 3.0, (100, 3)), seen_from)
    thaw(freeze({"map": going}, {"config": config}), {"map": resumed}, {"config": config})
    assert resumed.stats == going.stats
    moved = {1: moved_by(7.0), 3: moved_by(-30.0)}
    extra = rng.normal(0.0, 3.0, (100, 3))
    for cube_map in (going, resumed):
        assert cube_map.move(moved) > 100
        cube_map.recenter(np.zeros(3))
        cube_map.insert(extra)
    assert resumed.stats == going.stats
    assert going.stats.restored > 0
    np.testing.assert_array_equal(resumed.points(archived=True), going.points(archived=True))
    cubes = going.neighbourhood(np.eye(4))
    found, again = (cube_map.nearest(extra, 5, 2.0, cubes).views for cube_map in (going, resumed))
    np.testing.assert_array_equal(again, found)
    assert found.any() == (insertion == "settled")
