"""MulRan and HeLiPR, in files of their layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import layout_writers as write

from loam_gtsam.config import Config, ImuConfig
from loam_gtsam.datasets import HeLiPRDataset, MulRanDataset, open_dataset
from loam_gtsam.pipeline import effective_config
from loam_gtsam.types import BadSweep, DatasetError, Scan

HALF_TURN = np.diag([-1.0, -1.0, 1.0])
STAMPS = write.stamps()


BASE_T_LIDAR = np.eye(4)
"""MulRan's calib_base2ouster.txt: 1.7042 -0.021 1.8047 0.0001 0.0003 179.6654."""
BASE_R_LIDAR = Rotation.from_euler("xyz", np.radians([0.0001, 0.0003, 179.6654]))
BASE_T_LIDAR[:3, :3] = BASE_R_LIDAR.as_matrix()
BASE_T_LIDAR[:3, 3] = (1.7042, -0.021, 1.8047)


def write_mulran(root: Path, below: str = "", count: int = write.COUNT) -> Path:
    folder = root / below / "Ouster"
    folder.mkdir(parents=True)
    for sweep in write.sweeps()[:count]:
        write.firings(sweep, 64, 1024).tofile(folder / f"{sweep.stamp}.bin")
    base = write.body_truth(BASE_T_LIDAR)
    rows = base.map_T_lidar[:, :3].reshape(-1, 12)
    write.write_rows(root / "global_pose.csv", base.stamps, rows)
    write.write_xsens(root / below / "xsens_imu.csv", HALF_TURN)
    listing = [f"{stamp},ouster" for stamp in STAMPS[:count]] + [f"{STAMPS[0]},imu"]
    (root / below / "data_stamp.csv").write_text("\n".join(listing) + "\n")
    return root


def test_a_mulran_sequence_is_recognised_and_mapped_in_the_lidar_s_frame(tmp_path: Path) -> None:
    root = write_mulran(tmp_path)
    next(root.rglob(f"{STAMPS[0]}.bin")).with_name(f"._{STAMPS[0]}.bin").write_bytes(b"of macOS")
    dataset = open_dataset(root)
    assert isinstance(dataset, MulRanDataset)
    assert dataset.stamps.tolist() == STAMPS.tolist()
    write.expect_truth(dataset)
    result = write.expect_mapped(dataset)
    assert sum(update.status.solved for update in result.updates) == write.COUNT - 1
    # The IMU is half a turn away from the lidar; its gyro agrees once that is known.
    assert result.config.imu.lidar_R_imu_deg == (0.0, 0.0, 180.0)
    assert result.config.imu.lidar_t_imu == (1.77, 0.0, -0.05)
    assert result.imu.sweep_motions["gyro"] >= write.COUNT - 1


def test_what_the_user_sets_of_the_imu_wins_over_the_data_set(tmp_path: Path) -> None:
    dataset = open_dataset(write_mulran(tmp_path, count=1))
    mine = Config(imu=ImuConfig(lidar_R_imu_deg=(0.0, 0.0, 90.0)))
    used = effective_config(mine, dataset).imu
    assert used.lidar_R_imu_deg == (0.0, 0.0, 90.0)
    assert used.lidar_t_imu == (1.77, 0.0, -0.05)


def test_times_and_beams_of_mulran_follow_from_the_order_of_the_points(tmp_path: Path) -> None:
    expected = write.sweeps()[0]
    for stamp_is, shift in (("start", 0.0), ("middle", 0.05), ("end", 0.1)):
        root = write_mulran(tmp_path / stamp_is, "sensor_data", count=1)
        dataset = MulRanDataset(root, stamp_is=stamp_is)
        (scan,) = dataset
        assert scan.rows == 64
        row = np.arange(len(scan.points)) // 1024
        seen = np.any(scan.points != 0.0, axis=1)
        order = np.lexsort((63 - row[seen], scan.times[seen]))
        np.testing.assert_array_equal(scan.points[seen][order], expected.points)
        np.testing.assert_allclose(scan.times[seen][order], expected.times - shift, atol=1e-9)
        assert "which moment" not in " ".join(dataset.info().problems)
    assert "which moment" in " ".join(open_dataset(root).info().problems)


def test_mulran_says_what_is_missing_or_broken(tmp_path: Path) -> None:
    root = write_mulran(tmp_path, count=3)
    files = sorted((root / "Ouster").iterdir())
    files[0].write_bytes(files[0].read_bytes()[: 30_000 * 16])
    files[1].write_bytes(files[1].read_bytes()[:-3])
    files[2].unlink()
    with (root / "data_stamp.csv").open("a") as listing:
        listing.writelines(f"{stamp},ouster\n" for stamp in ("9" * 5011, 2**63, "abc"))
    dataset = open_dataset(root)
    first, second = dataset
    assert "30000 points, expected 1024 firings of 64 = 65536" in first.message
    assert "1048573 bytes is not a multiple of 16 (x, y, z, intensity)" in second.message
    problems = " ".join(dataset.info().problems)
    assert "data_stamp.csv: 3 rows of ouster without a valid stamp" in problems
    assert f"data_stamp.csv lists 1 sweeps without a file, the first {STAMPS[2]}" in problems
    (root / "Ouster" / "front.bin").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"front.bin: expected a name that is the stamp"):
        open_dataset(root)
    for file in (root / "Ouster").iterdir():
        file.unlink()
    with pytest.raises(DatasetError, match=r"Ouster: no sweeps \(\*.bin\)"):
        open_dataset(root)


def test_poses_of_mulran_may_be_unsorted_but_not_distorted(tmp_path: Path) -> None:
    root = write_mulran(tmp_path, count=1)
    file = root / "global_pose.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[::-1], lines[0]]) + "\n")
    dataset = open_dataset(root)
    np.testing.assert_array_equal(dataset.truth.stamps, write.lidar_truth().stamps)
    problems = " ".join(dataset.info().problems)
    assert "global_pose.csv: poses out of order, sorted" in problems
    assert "global_pose.csv: 1 poses with a repeated stamp left out" in problems
    stamp, _, *rest = lines[1].split(",")
    file.write_text("\n".join([lines[0], ",".join([stamp, "2.0", *rest])]) + "\n")
    with pytest.raises(DatasetError, match=r"global_pose.csv: row 2 does not hold a rotation"):
        _ = open_dataset(root).truth
    file.write_text(lines[0] + "\n1,2,3\n")
    with pytest.raises(DatasetError, match=r"global_pose.csv:2: expected 13 numbers \(ns r11"):
        _ = open_dataset(root).truth


def test_the_gyro_is_where_the_orientation_says(tmp_path: Path) -> None:
    root = write_mulran(tmp_path, count=1)
    expected = open_dataset(root).imu
    np.testing.assert_allclose(expected.gyro, write.imu_rows(HALF_TURN)[2], atol=1e-12)
    np.testing.assert_allclose(expected.acceleration, write.imu_rows(HALF_TURN)[3], atol=1e-12)
    file = root / "xsens_imu.csv"
    write.write_xsens(file, HALF_TURN, gyro_last=True)
    dataset = open_dataset(root)
    np.testing.assert_array_equal(dataset.imu.gyro, expected.gyro)
    assert "the gyro is in columns 15 to 17" in " ".join(dataset.info().problems)
    rows = [line.split(",") for line in file.read_text().splitlines()]
    for row in rows:
        row[14:17] = row[8:11]  # a gyro nowhere
    file.write_text("\n".join(",".join(row) for row in rows) + "\n")
    dataset = open_dataset(root)
    assert dataset.imu is None
    assert "the gyro cannot be told: left out" in " ".join(dataset.info().problems)
    file.write_text("\n".join(",".join(row[:8]) for row in rows) + "\n")
    dataset = open_dataset(root)
    assert dataset.imu is None
    assert "without gyro and accelerometer (8 columns)" in " ".join(dataset.info().problems)


@pytest.mark.parametrize("lidar", write.HELIPR_SENSORS)
def test_a_helipr_sequence_has_times_rings_and_truth(tmp_path: Path, lidar: str) -> None:
    dataset = open_dataset(write.write_helipr(tmp_path, lidar))
    assert isinstance(dataset, HeLiPRDataset)
    write.expect_sweeps(dataset, write.sweeps(*write.HELIPR_SENSORS[lidar]))
    write.expect_truth(dataset)  # it is of the lidar already
    # The toolbox has the lidar in the IMU's axes; the IMU is then on the other side.
    x, y, z = dataset.sensor["imu.lidar_t_imu"]
    assert z < 0.0
    assert (x > 0.0) == (lidar in ("Ouster", "Velodyne"))  # the others are in front of it
    assert np.sign(y) == {"Avia": 1.0, "Aeva": -1.0}.get(lidar, np.sign(y))
    facts = dataset.info().facts
    own = {"Avia": "intensity uint8", "Aeva": "reflectivity float32"}
    fourth = own.get(lidar, "intensity float32")
    assert facts["fields"].startswith(f"x float32, y float32, z float32, {fourth}")
    assert "relative to the stamp" in facts["point times"]
    assert "HeLiPR-Pointcloud-Toolbox" not in facts  # no IMU, no extrinsics shown
    if lidar == "Ouster":
        write.expect_mapped(dataset, imu=False)


def test_helipr_takes_the_lidar_asked_for(tmp_path: Path) -> None:
    write.write_helipr(tmp_path)
    write.write_helipr(tmp_path, "Velodyne")
    assert "Ouster" in open_dataset(tmp_path).info().kind
    assert "Velodyne" in open_dataset(tmp_path, lidar="Velodyne").info().kind
    with pytest.raises(DatasetError, match=r"one of Ouster, Velodyne, Avia, Aeva; got 'Ariva'"):
        open_dataset(tmp_path, lidar="Ariva")
    with pytest.raises(DatasetError, match=r"no HeLiPR sequence: expected LiDAR/Aeva"):
        open_dataset(tmp_path, lidar="Aeva")


def test_points_of_an_aeva_have_no_intensity_before_some_day(tmp_path: Path) -> None:
    root = write.write_helipr(tmp_path, "Aeva")
    later, *_ = sorted((root / "LiDAR" / "Aeva").iterdir())
    points = np.fromfile(later, np.uint8).reshape(-1, 29)
    for file in (root / "LiDAR" / "Aeva").iterdir():
        file.unlink()
    points[:, :25].tofile(later.with_stem("1690000000000000000"))
    (sweep,) = open_dataset(root)
    assert len(sweep.points) == len(points)
    assert sweep.times.max() > 0.09


def test_helipr_says_what_is_broken(tmp_path: Path) -> None:
    root = write.write_helipr(tmp_path)
    files = sorted((root / "LiDAR" / "Ouster").iterdir())
    files[1].write_bytes(files[1].read_bytes()[:-1])
    sweeps = list(open_dataset(root))
    assert [type(sweep) for sweep in sweeps[:3]] == [Scan, BadSweep, Scan]
    assert "is not a multiple of 26 (x, y, z, intensity, t, reflectivity" in sweeps[1].message
    for file in files:
        file.write_bytes(b"123")
    with pytest.raises(DatasetError, match=r"no usable sweep among the first 10; .*3 bytes"):
        open_dataset(root).info()
