"""Folders of .pcd, .ply and .npy sweeps, .bin files of five columns, KITTI's elevation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from loam_gtsam.datasets import KittiDataset, open_dataset
from loam_gtsam.datasets.kitti.folder import ELEVATION_DEG, raise_elevation
from loam_gtsam.types import BadSweep, DatasetError

COUNT = 40
POINTS = np.random.default_rng(3).uniform(2.0, 9.0, (COUNT, 3)).astype("<f4")
RINGS = (np.arange(COUNT) % 4).astype("<u2")
TIMES = np.linspace(0.0, 0.1, COUNT).astype("<f4")


def structured() -> np.ndarray:
    kind = [*((name, "<f4") for name in "xyz"), ("ring", "<u2"), ("t", "<f4")]
    cloud = np.zeros(COUNT, kind)
    for name, column in zip(("x", "y", "z", "ring", "t"), (*POINTS.T, RINGS, TIMES), strict=True):
        cloud[name] = column
    return cloud


def write(folder: Path, suffix: str, number: int = 0) -> None:
    file = folder / f"{number}{suffix}"
    cloud = structured()
    if suffix == ".npy":
        np.save(file, cloud)
    elif suffix == ".ply":
        plyfile = pytest.importorskip("plyfile")
        element = plyfile.PlyElement.describe(cloud, "vertex")
        plyfile.PlyData([element], byte_order="<").write(str(file))
    else:
        head = (
            "VERSION 0.7\nFIELDS x y z ring t\nSIZE 4 4 4 2 4\nTYPE F F F U F\nCOUNT 1 1 1 1 1\n"
            f"WIDTH {COUNT}\nHEIGHT 1\nPOINTS {COUNT}\nDATA binary\n"
        )
        file.write_bytes(head.encode() + cloud.tobytes())


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npy"])
def test_files_that_tell_their_fields(tmp_path, suffix):
    for number in (0, 1, 10):
        write(tmp_path, suffix, number)
    (tmp_path / "times.txt").write_text("5\n5.1\n5.2\n")
    (tmp_path / f"2{suffix}").write_bytes(b"nothing")
    (tmp_path / "times.txt").write_text("5\n5.1\n5.15\n5.2\n")
    dataset = open_dataset(tmp_path)
    info = dataset.info()
    assert info.kind == f"folder of {suffix} files"
    assert info.facts["fields"].endswith("z float32, ring uint16, t float32")
    assert info.facts["point times"].startswith("field 't' in s, relative to the stamp: +0.0000 ..")
    first, second, bad, last = list(dataset)
    assert isinstance(bad, BadSweep)
    assert f"2{suffix}" in bad.message
    for scan, stamp in ((first, 5.0), (second, 5.1), (last, 5.2)):
        assert scan.stamp == round(stamp * 1e9)
        np.testing.assert_array_equal(scan.points, POINTS)
        np.testing.assert_array_equal(scan.rings, RINGS)
        np.testing.assert_allclose(scan.times, TIMES, atol=1e-7)


def timed(folder: Path, times: np.ndarray, count: int = 4) -> Path:
    """PCD files with a field ``time``, ten a second."""
    cloud = np.zeros(COUNT, [*((name, "<f4") for name in "xyz"), ("time", times.dtype)])
    for name, column in zip("xyz", POINTS.T, strict=True):
        cloud[name] = column
    cloud["time"] = times
    kind, size = times.dtype.kind.upper(), times.dtype.itemsize
    head = (
        f"VERSION 0.7\nFIELDS x y z time\nSIZE 4 4 4 {size}\nTYPE F F F {kind}\nWIDTH {COUNT}\n"
        f"HEIGHT 1\nPOINTS {COUNT}\nDATA binary\n"
    )
    for number in range(count):
        (folder / f"{number}.pcd").write_bytes(head.encode() + cloud.tobytes())
    return folder


@pytest.mark.parametrize("kind", ["<u8", "<i8"])
def test_times_of_eight_bytes_are_exact(tmp_path, kind):
    began = 1_700_000_000_123_456_789
    (tmp_path / "times.txt").write_text("1700000000.123456789\n")
    nanoseconds = began + np.arange(COUNT) * 2_500_000
    (scan,) = KittiDataset(timed(tmp_path, nanoseconds.astype(kind), 1))
    np.testing.assert_allclose(scan.times, np.arange(COUNT) * 0.0025, atol=1e-12)


def test_times_that_are_fractions_of_the_sweep_are_refused(tmp_path):
    fractions = timed(tmp_path, np.linspace(0.0, 1.0, COUNT).astype("<f4"))
    for sweep in KittiDataset(fractions):
        assert isinstance(sweep, BadSweep)
        assert "span 1 s, but a sweep follows each 0.1 s; expected seconds (frac" in sweep.message
    assert all(sweep.times is None for sweep in KittiDataset(fractions, time_field="none"))
    (fractions / "times.txt").write_text("0\n0.5\n1\n1.5\n")  # two lidars, or two sweeps a second
    assert {np.ptp(sweep.times) for sweep in KittiDataset(fractions)} == {1.0}


def test_times_of_files_are_read_as_asked(tmp_path):
    zeros = timed(tmp_path, np.zeros(COUNT, "<f4"))
    assert "time_field=none" in next(iter(KittiDataset(zeros))).message
    assert next(iter(open_dataset(zeros, time_field="none"))).times is None
    timed(tmp_path, np.linspace(0.0, 90.0, COUNT).astype("<f4"))
    scan = next(iter(open_dataset(tmp_path, time_unit="ms", stamp_is="end")))
    np.testing.assert_allclose((scan.times[0], scan.times[-1]), (-0.09, 0.0), atol=1e-9)
    with pytest.raises(DatasetError, match="time_unit: expected one of"):
        open_dataset(tmp_path, time_unit="h")
    for number in range(4):
        five(tmp_path, f"{number}.bin")
    with pytest.raises(DatasetError, match=r"\.bin files have no fields for time_field, time_unit"):
        open_dataset(tmp_path, time_unit="ms")


def test_plain_arrays_and_arrays_of_another_shape(tmp_path):
    np.save(tmp_path / "0.npy", POINTS.astype(np.float64))
    np.save(tmp_path / "1.npy", np.zeros((4, 7)))
    good, bad = list(KittiDataset(tmp_path))
    np.testing.assert_array_equal(good.points, POINTS)
    assert "expected an array of shape (N, 3) or (N, 4)" in bad.message


def five(folder: Path, name: str = "0.bin") -> None:
    columns = np.column_stack([POINTS, np.full(COUNT, 7.5), RINGS]).astype("<f4")
    columns.tofile(folder / name)


def test_the_fifth_column_is_the_beam(tmp_path):
    """40 points of five columns are 50 of four as well: the numbers tell."""
    five(tmp_path)
    (scan,) = KittiDataset(tmp_path)
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.rings, RINGS)
    assert len(next(iter(KittiDataset(tmp_path, columns=4))).points) == 50
    with pytest.raises(DatasetError, match="columns: expected 4 or 5"):
        KittiDataset(tmp_path, columns=6)


def test_four_columns_stay_four(tmp_path):
    for number, intensity in enumerate((np.arange(COUNT), np.zeros(COUNT), np.full(COUNT, 0.3))):
        folder = tmp_path / str(number)
        folder.mkdir()
        np.column_stack([POINTS, intensity]).astype("<f4").tofile(folder / "0.bin")
        (scan,) = KittiDataset(folder)
        np.testing.assert_array_equal(scan.points, POINTS)
        assert scan.rings is None


def test_names_of_nuscenes_are_stamps(tmp_path):
    five(tmp_path, "n015-2018-07-24__LIDAR_TOP__1532402927647951.pcd.bin")
    assert KittiDataset(tmp_path).stamps.tolist() == [1532402927647951000]
    five(tmp_path, f"n015-2018-07-24__LIDAR_TOP__{'9' * 16}.pcd.bin")  # times 1000 beyond 64 bits
    with pytest.raises(DatasetError, match="expected microseconds in names of files: out of range"):
        KittiDataset(tmp_path)


@pytest.mark.parametrize(("below", "offset"), [("velodyne", ELEVATION_DEG), ("", 0.0)])
def test_kitti_s_rays_are_raised_by_what_its_calibration_lacks(tmp_path, below, offset):
    folder = tmp_path / below
    folder.mkdir(exist_ok=True)
    np.column_stack([POINTS, np.full(COUNT, 0.3)]).astype("<f4").tofile(folder / "0.bin")
    dataset = KittiDataset(tmp_path)
    (scan,) = dataset
    expected = raise_elevation(POINTS, np.radians(offset)) if offset else POINTS
    np.testing.assert_array_equal(scan.points, expected)
    assert ("elevation raised by" in dataset.info().facts) == bool(offset)
    (plain,) = KittiDataset(tmp_path, vertical_angle_offset_deg=0.0)
    np.testing.assert_array_equal(plain.points, POINTS)
