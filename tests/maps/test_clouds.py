"""Point clouds of other systems as maps, and maps as point clouds."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from support.cli import loam

from loam_gtsam.config import Config
from loam_gtsam.geometry import transform
from loam_gtsam.maps.cleaning import views
from loam_gtsam.maps.clouds import features_of, import_cloud, in_sight, read_cloud, write_cloud
from loam_gtsam.maps.localizer import Localizer
from loam_gtsam.maps.map_file import SavedMap
from loam_gtsam.types import DatasetError, FrameStatus, OutputError, stack_poses


@pytest.mark.parametrize("middle", [(0.0, 0.0, 0.0), (5e5, 5.4e6, 300.0), (-5e6, 0.0, 0.0)])
@pytest.mark.parametrize("kind", [".pcd", ".las", ".laz"])
def test_a_cloud_comes_back_from_anywhere_on_earth(tmp_path, kind, middle):
    if kind in (".las", ".laz"):
        pytest.importorskip("laspy")
    rng = np.random.default_rng(3)
    points = middle + rng.uniform(-900.0, 900.0, (100, 3))
    path = tmp_path / f"cloud{kind}"
    write_cloud(path, points[:40], points[40:])
    np.testing.assert_allclose(read_cloud(path), points, rtol=0.0, atol=6e-4)
    write_cloud(path, points[:0], points[:0])


@pytest.mark.parametrize("kind", [".ply", ".pcd", ".las", ".laz"])
def test_a_cloud_comes_back(tmp_path, kind):
    if kind in (".las", ".laz"):
        pytest.importorskip("laspy")
    rng = np.random.default_rng(3)
    edges, planes = rng.uniform(-900.0, 900.0, (40, 3)), rng.uniform(-900.0, 900.0, (60, 3))
    path = tmp_path / f"cloud{kind}"
    write_cloud(path, edges, planes)
    np.testing.assert_allclose(read_cloud(path), np.concatenate([edges, planes]), atol=6e-4)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DatasetError, match=str(path)):
        read_cloud(path)


def test_what_is_no_cloud_is_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"expected a name that ends in \.ply"):
        read_cloud(tmp_path / "cloud.doc")
    with pytest.raises(DatasetError, match="no such file"):
        read_cloud(tmp_path / "cloud.ply")
    with pytest.raises(OutputError, match=r"expected a name that ends in \.ply"):
        write_cloud(tmp_path / "cloud.doc", np.zeros((1, 3)), np.zeros((1, 3)))
    write_cloud(tmp_path / "none.pcd", np.full((3, 3), np.nan), np.empty((0, 3)))
    with pytest.raises(DatasetError, match="expected points"):
        read_cloud(tmp_path / "none.pcd")
    for stray in (np.zeros((0, 3)), np.array([[0.0, 0.0, 0.0], [1e30, 0.0, 0.0]])):
        with pytest.raises(DatasetError, match="points within 1e\\+06 m of each other"):
            import_cloud(stray, tmp_path / "stray.lgmap")
    blob = np.random.default_rng(0).normal(size=(500, 3))
    with pytest.raises(DatasetError, match="expected level ground"):
        import_cloud(blob, tmp_path / "blob.lgmap")
    assert not (tmp_path / "blob.lgmap").exists()


@pytest.mark.parametrize("streamed", [False, True])
def test_a_laz_file_that_claims_too_many_chunks_is_refused(tmp_path, streamed):
    """The decoder would ask for 64 GB, and end the process."""
    pytest.importorskip("laspy")
    path = tmp_path / "cloud.laz"
    points = np.random.default_rng(3).uniform(-9.0, 9.0, (100, 3))
    write_cloud(path, points[:50], points[50:])
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, start)
    assert struct.unpack_from("<I", data, table + 4) == (1,)
    if streamed:  # then the place of the table is at the end
        struct.pack_into("<q", data, start, -1)
        data += struct.pack("<q", table)
    path.write_bytes(data)
    assert len(read_cloud(path)) == 100
    struct.pack_into("<I", data, table + 4, 2**32 - 1)
    path.write_bytes(data)
    with pytest.raises(DatasetError, match="chunks, got 4294967295"):
        read_cloud(path)


@pytest.mark.parametrize("kind", [".las", ".laz"])
def test_a_las_file_that_claims_too_many_records_is_refused(tmp_path, kind):
    """A reader would look for four billion of them."""
    pytest.importorskip("laspy")
    path = tmp_path / f"cloud{kind}"
    points = np.random.default_rng(3).uniform(-9.0, 9.0, (100, 3))
    write_cloud(path, points[:50], points[50:])
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 100, 2**32 - 1)
    path.write_bytes(data)
    with pytest.raises(DatasetError, match="records, got 4294967295"):
        read_cloud(path)


def test_flat_points_are_planes_and_corners_may_be_edges():
    rng = np.random.default_rng(1)
    across, along = rng.uniform(0.0, 6.0, (2, 30_000))
    none = np.zeros_like(across)
    floor, wall = np.stack([across, along, none], 1), np.stack([none, along, across], 1)
    points = np.concatenate([floor, wall]) + rng.normal(0.0, 0.005, (60_000, 3))
    edges, planes, normals = features_of(points, Config())
    near = np.hypot(planes[:, 0], planes[:, 2])
    inside = (planes[:, 1] > 0.5) & (planes[:, 1] < 5.5)
    assert np.percentile(near[inside], 1) > 0.1
    assert np.abs(normals[np.argmax(near)]).max() > 0.99
    assert (np.hypot(edges[:, 0], edges[:, 2]) < 0.3).mean() > 0.1  # of all points 0.05 are there
    assert len(planes) > 5 * len(edges)


def test_what_is_behind_something_is_not_seen():
    angle = np.radians(np.arange(-5.0, 5.0, 0.2))
    wall = 5.0 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
    above = np.array([[0.0, 0.0, 4.0], [10.0, 0.0, 2.0]])
    seen = in_sight(np.concatenate([wall, 2.0 * wall, above]), (-15.0, 15.0))
    assert seen[: len(wall)].all()
    assert not seen[len(wall) : 2 * len(wall)].any()
    assert seen[-2:].tolist() == [False, True]


def test_a_drive_is_found_in_a_foreign_cloud(mapped, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    updates = mapped.result.updates
    poses = stack_poses(update.map_T_lidar for update in updates)
    seen = list(views(mapped.world, updates, poses, Config()))[::2]
    cloud = np.concatenate([transform(view.map_T_lidar, view.points) for view in seen])
    far = np.array([500_000.0, 5_400_000.0, 400.0])
    write_cloud("cloud.pcd", cloud[:0], cloud + far)
    done = loam("convert", "cloud.pcd", "cloud.lgmap", "--height", 1.0)
    assert done.exit_code == 0, done.output
    origin = np.array(done.output.split("origin is at ")[1].split(", "), np.float64)
    with SavedMap("cloud.lgmap") as saved:
        localizer = Localizer(saved)
        numbers = range(16, 24)  # while it stands still, a rival fits as well
        found = [localizer.process(mapped.world.sweep(number)) for number in numbers]
    assert found[-1].status is FrameStatus.OK
    for number, update in zip(numbers, found, strict=True):
        if update.status.solved:
            there = updates[number].map_T_lidar.translation() + far - origin
            assert np.linalg.norm(update.map_T_lidar.translation() - there) < 0.06
            assert np.linalg.eigvalsh(update.covariance)[-1] > 0.02**2  # with the cloud's own
    back = loam("convert", "cloud.lgmap", "again.pcd")
    assert back.exit_code == 0
    assert len(read_cloud(Path("again.pcd"))) == int(back.output.split(": ")[1].split()[0])
    assert loam("convert", "cloud.lgmap", "again.pcd").exit_code == 1
