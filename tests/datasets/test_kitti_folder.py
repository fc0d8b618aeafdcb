"""Folders of ``.bin`` sweeps, with their times, poses and IMU."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.bags import sweep_points, write_sweeps

from loam_gtsam.datasets import KittiDataset, open_dataset
from loam_gtsam.datasets.kitti.folder import ELEVATION_DEG, raise_elevation
from loam_gtsam.types import BadSweep, DatasetError, Scan


@pytest.mark.parametrize(
    ("below", "is_kitti"),
    [("", False), ("scans", False), ("velodyne", True), ("velodyne_points/data", True)],
)
def test_kitti_layouts(tmp_path: Path, below: str, is_kitti: bool) -> None:
    root = tmp_path / "drive"
    folder = write_sweeps(root / below)
    (root / "times.txt").write_text("0.0\n1.036224e-01\n0.207243\n")
    for path in {root, folder}:  # the inner folder may be given as well
        dataset = open_dataset(path)
        assert isinstance(dataset, KittiDataset)
        got = list(dataset)
        assert [sweep.stamp for sweep in got] == [0, 103_622_400, 207_243_000]
        expected = sweep_points(1, 50)
        if is_kitti:
            expected = raise_elevation(expected, np.radians(ELEVATION_DEG))
        np.testing.assert_array_equal(got[1].points, expected)
        assert got[1].times is None
        assert got[1].rings is None
        assert dataset.sensor.get("stamp") == ("middle" if is_kitti else None)


def test_kitti_raw_timestamps(tmp_path: Path) -> None:
    write_sweeps(tmp_path / "velodyne_points" / "data", 2)
    path = tmp_path / "velodyne_points" / "timestamps.txt"
    path.write_text("2011-09-26 13:02:25.594360375\n2011-09-26 13:02:25.7\n")
    first = 1_317_042_145_594_360_375
    assert KittiDataset(tmp_path).stamps.tolist() == [first, 1_317_042_145_700_000_000]
    path.write_text("2011-09-26 13:02:25.594360375\n25.7 s\n")
    with pytest.raises(DatasetError, match=r"timestamps.txt:2: expected a date and time, got '25"):
        KittiDataset(tmp_path)


def test_files_are_read_in_order_of_their_number(tmp_path: Path) -> None:
    for i in (10, 9, 100):
        np.full((1, 4), i, "<f4").tofile(tmp_path / f"{i}.bin")
    (tmp_path / "101.bin").write_bytes(b"")  # an empty sweep
    points = [scan.points[:, 0].tolist() for scan in KittiDataset(tmp_path)]
    assert points == [[9.0], [10.0], [100.0], []]


@pytest.mark.parametrize(
    "names",
    [
        ["scan_2", "scan_10", "scan_100"],
        ["day1_scan9", "day1_scan10", "day2_scan1"],
        ["000009", "000010", "000100"],
        ["17_5000", "17_123456789", "18_0"],  # seconds and nanoseconds
        ["17.123", "17.2", "17.45", "18.0"],  # seconds
        ["1_000000000000000000001", "1_000000000000000000002"],
        ["0a10", "0a9f", "0b1", "1c"],  # no numbers: by name
    ],
)
def test_numbers_in_names_tell_the_order(tmp_path: Path, names: list[str]) -> None:
    for i in reversed(range(len(names))):
        np.full((1, 4), i, "<f4").tofile(tmp_path / f"{names[i]}.bin")
    assert [scan.points[0, 0] for scan in KittiDataset(tmp_path)] == list(range(len(names)))


def test_hidden_files_are_no_sweeps_and_a_byte_order_mark_is_no_time(tmp_path: Path) -> None:
    folder = write_sweeps(tmp_path / "a")
    (folder / "._000000.bin").write_bytes(b"of macOS")
    (folder / "times.txt").write_text("5\n5.1\n5.2\n", encoding="utf-8-sig")
    dataset = open_dataset(folder)
    assert dataset.stamps.tolist() == [5_000_000_000, 5_100_000_000, 5_200_000_000]
    assert [len(scan.points) for scan in dataset] == [len(sweep_points(i, 50)) for i in range(3)]


def test_without_times_file(tmp_path: Path) -> None:
    dataset = KittiDataset(write_sweeps(tmp_path / "a"))
    assert dataset.stamps.tolist() == [0, 100_000_000, 200_000_000]
    assert any("10 Hz assumed" in text for text in dataset.info().problems)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("0\n0.1\n0.1\n0.2\n", "1 stamps equal the one before, first at sweep 2"),
        ("0\n0.1\n0.05\n0.2\n", "1 stamps are earlier than the one before, first at sweep 2"),
        ("0\n0.1\n0.2\n0.4\n", "1 stamps come after a gap, first at sweep 3"),
        ("0\n0\n0\n0\n", "all stamps are 0 s: nothing says when the sweeps were measured"),
        ("0\n0.1\n0.21\n0.3\n", None),
    ],
)
def test_disorder_is_reported_and_still_read(
    tmp_path: Path, text: str, problem: str | None
) -> None:
    folder = write_sweeps(tmp_path / "a", 4)
    (folder / "times.txt").write_text(text)
    dataset = KittiDataset(folder)
    said = dataset.info().problems
    assert len(said) == (problem is not None)
    assert all(text.startswith(problem or "") for text in said)
    assert [type(sweep) for sweep in dataset] == [Scan] * 4


def test_truncated_and_unreadable_sweeps(tmp_path: Path) -> None:
    folder = write_sweeps(tmp_path / "a", 4)
    file = folder / "000001.bin"
    file.write_bytes(file.read_bytes()[:-3])
    (folder / "000002.bin").unlink()
    (folder / "000002.bin").symlink_to(folder / "gone")
    got = list(KittiDataset(folder))
    assert [type(sweep) for sweep in got] == [Scan, BadSweep, BadSweep, Scan]
    assert "000001.bin: 797 bytes is not a multiple of 16" in got[1].message
    assert got[1].stamp == 100_000_000
    assert "000002.bin" in got[2].message


@pytest.mark.parametrize("base", [0, 991_587_364_520])
def test_point_times_of_a_folder(tmp_path: Path, base: int) -> None:
    write_sweeps(tmp_path / "velodyne")
    (tmp_path / "t_ns").mkdir()
    offsets = np.arange(50, dtype="<u8") * 2_000_000
    for i in (0, 1):
        (offsets + base).astype("<u8").tofile(tmp_path / "t_ns" / f"{i:06d}.u64")
    (offsets[:7] + base).astype("<u8").tofile(tmp_path / "t_ns" / "000002.u64")
    dataset = KittiDataset(tmp_path)
    got = list(dataset)
    np.testing.assert_allclose(got[1].times, offsets * 1e-9, atol=1e-12)
    assert "000002.u64: expected 50 point times, got 7" in got[2].message
    assert dataset.sensor == {}  # nothing of KITTI's is implied
    for file in (tmp_path / "t_ns").iterdir():
        file.unlink()
    with pytest.raises(DatasetError, match=r"t_ns: no usable point times.*000000.u64"):
        KittiDataset(tmp_path)


def test_raised_elevation() -> None:
    points = sweep_points(3).astype(np.float64)
    points[0] = (0.0, 0.0, 2.0)  # straight up: no direction to turn in
    angle = np.radians(0.205)
    raised = raise_elevation(points, float(angle))

    def elevation(p: np.ndarray) -> np.ndarray:
        return np.asarray(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))

    np.testing.assert_allclose(np.linalg.norm(raised, axis=1), np.linalg.norm(points, axis=1))
    np.testing.assert_allclose((elevation(raised) - elevation(points))[1:], angle, atol=1e-12)
    azimuths = [np.arctan2(p[1:, 1], p[1:, 0]) for p in (raised, points)]
    np.testing.assert_allclose(azimuths[0], azimuths[1])
    np.testing.assert_array_equal(raised[0], points[0])


def test_elevation_option(tmp_path: Path) -> None:
    folder = write_sweeps(tmp_path / "a", 1)
    (plain,) = open_dataset(folder)
    (raised,) = open_dataset(folder, vertical_angle_offset_deg=0.205)
    expected = raise_elevation(plain.points, np.radians(0.205))
    np.testing.assert_array_equal(raised.points, expected)


def test_reference_poses_and_imu_of_a_folder(tmp_path: Path) -> None:
    folder = write_sweeps(tmp_path / "a")
    assert KittiDataset(folder).truth is None
    assert KittiDataset(folder).imu is None
    (folder / "gt.tum").write_text("# t x y z q\n0.1 1 2 3 0 0 0.70710678 0.70710678\n")
    (folder / "imu.csv").write_text("0.005,0,0,0,1,0.1,0.2,0.3,0,0,9.81\n")
    dataset = KittiDataset(folder)
    assert dataset.truth.stamps.tolist() == [100_000_000]
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(dataset.truth.map_T_lidar[0], expected, atol=1e-12)
    assert dataset.imu.stamps.tolist() == [5_000_000]
    np.testing.assert_allclose(dataset.imu.acceleration, [[0, 0, 9.81]])
    (folder / "imu.csv").unlink()  # EuRoC's table has no orientation
    (folder / "imu0").mkdir()
    text = "#timestamp [ns],w_RS_S_x [rad s^-1],...\n5000000,0.1,0.2,0.3,0,0,9.81\n"
    (folder / "imu0" / "data.csv").write_text(text)
    euroc = KittiDataset(folder).imu
    assert euroc.stamps.tolist() == [5_000_000]
    assert euroc.orientation is None
    np.testing.assert_allclose(euroc.gyro, [[0.1, 0.2, 0.3]])


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("times.txt", "0.0\n0.1\n", r"times.txt: 2 stamps for 3 sweeps"),
        ("times.txt", "0.0\n0.1\n0.2\n0.3\n", r"times.txt: 4 stamps for 3 sweeps"),
        ("times.txt", "0.0\nabc\n0.2\n", r"times.txt:2: .*'abc'"),
        ("times.txt", "0.0\n\n0.2\n", r"times.txt:2: "),
        ("times.txt", "0.0\n0.1\nnan\n", r"times.txt:3: "),
        ("times.txt", "0.0\n0.1\n1e30\n", r"times.txt:3: .*out of range: '1e30'$"),
        ("times.txt", "1700000000000000000\n", "out of range: '17.*'; nanoseconds\\?$"),
        ("gt.tum", "0 1 2 3 0 0 0 1\n0 1 2 3 0 0 1\n", "gt.tum:2: expected 8 numbers"),
        ("gt.tum", "0 1 2 3 0 0 0 0\n", "gt.tum:1: .*quaternion of length 0"),
        ("gt.tum", "0 1 nan 3 0 0 0 1\n", "gt.tum:1: .*NaN"),
        ("imu.csv", "0,0,0,0,1,0,0,0,0,0,x\n", "imu.csv:1: expected 11 numbers"),
    ],
)
def test_bad_files_next_to_the_sweeps(tmp_path: Path, name: str, text: str, match: str) -> None:
    folder = write_sweeps(tmp_path / "a")
    (folder / name).write_text(text)
    with pytest.raises(DatasetError, match=match):
        KittiDataset(folder).info()
