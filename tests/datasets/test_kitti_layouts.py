"""KITTI's raw drives with their GPS/IMU, and sequences of its odometry benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import layout_writers as write
from support.quick import QUICK

from loam_gtsam.config import ImuConfig
from loam_gtsam.datasets import KittiDataset, open_dataset
from loam_gtsam.pipeline import run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import DatasetError, Scan

WORLD = {"sensor": "hdl64", "columns": 720}
LIDAR_T_IMU = np.array(
    [
        [9.999976e-01, 7.553071e-04, -2.035826e-03, -8.086759e-01],
        [-7.854027e-04, 9.998898e-01, -1.482298e-02, 3.195559e-01],
        [2.024406e-03, 1.482454e-02, 9.998881e-01, -7.997231e-01],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""calib_imu_to_velo.txt of 2011_09_26."""
CALIBRATION = (
    "calib_time: 25-May-2012 16:47:16\n"
    f"R: {' '.join(map(str, LIDAR_T_IMU[:3, :3].ravel()))}\n"
    f"T: {' '.join(map(str, LIDAR_T_IMU[:3, 3]))}\n"
)
LATITUDE, LONGITUDE = 49.011212804408, 8.4228850417969
MIDDLE = 50_000_000


def date(stamp: int) -> str:
    return f"{np.datetime64(stamp // 10**9, 's')}.{stamp % 10**9:09d}".replace("T", " ")


def write_dates(path: Path, stamps: list[int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{date(stamp)}\n" for stamp in stamps))


def write_sweeps(folder: Path) -> list[int]:
    """Ring after ring from the top, as KITTI's files are, in ascending azimuth."""
    folder.mkdir(parents=True)
    for number, sweep in enumerate(write.sweeps(**WORLD)):
        azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) % (2.0 * np.pi)
        order = np.lexsort((azimuth, -np.asarray(sweep.rings)))
        values = np.column_stack([sweep.points[order], np.zeros(len(order))]).astype("<f4")
        values.tofile(folder / f"{number:010d}.bin")
    return [stamp + MIDDLE for stamp in write.stamps(**WORLD).tolist()]


def write_oxts(root: Path, period: int = 10_000_000) -> None:
    """Packets as the development kit describes them: position on the earth, angles, rates."""
    first = write.stamps(**WORLD)[0] - 100_000_000
    stamps = np.arange(first, first + 900_000_000, period)
    poses = write.room(**WORLD).truth_at(stamps).map_T_lidar @ LIDAR_T_IMU
    poses = write.room(**WORLD).world_T_start @ poses
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz")
    samples = write.room(**WORLD).imu
    at = np.searchsorted(samples.stamps, stamps)
    gyro = samples.gyro[at] @ LIDAR_T_IMU[:3, :3]
    acceleration = samples.acceleration[at] @ LIDAR_T_IMU[:3, :3]
    radius = 6378137.0 * np.cos(np.radians(LATITUDE))
    data = root / "oxts" / "data"
    data.mkdir(parents=True)
    for number in range(len(stamps)):
        x, y, z = poses[number, :3, 3]
        values = np.zeros(30)
        north = np.log(np.tan(np.radians(90.0 + LATITUDE) / 2)) + y / radius
        values[0] = np.degrees(2.0 * np.arctan(np.exp(north)) - np.pi / 2.0)
        values[1] = LONGITUDE + np.degrees(x / radius)
        values[2] = 112.0 + z
        values[3:6] = angles[number]
        values[11:14] = acceleration[number]
        values[17:20] = gyro[number]
        (data / f"{number:010d}.txt").write_text(" ".join(repr(float(v)) for v in values) + "\n")
    write_dates(root / "oxts" / "timestamps.txt", stamps.tolist())


def write_drive(day: Path, **oxts: int) -> Path:
    root = day / "2011_09_26_drive_0002_sync"
    stamps = write_sweeps(root / "velodyne_points" / "data")
    write_dates(root / "velodyne_points" / "timestamps.txt", stamps)
    for name, shift in (("start", -MIDDLE), ("end", MIDDLE)):
        path = root / "velodyne_points" / f"timestamps_{name}.txt"
        write_dates(path, [stamp + shift for stamp in stamps])
    write_oxts(root, **oxts)
    (day / "calib_imu_to_velo.txt").write_text(CALIBRATION)
    return root


def test_a_raw_drive_has_its_gps_imu_as_truth_of_the_scanner_and_as_imu(tmp_path: Path) -> None:
    root = write_drive(tmp_path)
    for path in (root, root / "velodyne_points" / "data"):
        dataset = open_dataset(path)
        assert isinstance(dataset, KittiDataset)
        truth = dataset.truth
        expected = write.room(**WORLD).truth_at(truth.stamps)
        # The earth is not flat: 1e-6 of a few metres.
        assert absolute_error(truth, expected).maximum < 1e-4
        assert absolute_error(truth, expected).rotation_rmse_deg < 1e-6
        assert truth.map_T_lidar[0, :3, 3] == pytest.approx(
            truth.map_T_lidar[0, :3, :3] @ -LIDAR_T_IMU[:3, :3].T @ LIDAR_T_IMU[:3, 3], abs=0.05
        )
    assert dataset.sensor["period"] == pytest.approx(0.1)
    assert dataset.sensor["stamp"] == "middle"
    facts = dataset.info().facts
    assert facts["IMU"].endswith("100.00 Hz, with orientation")
    assert "position -0.809, 0.320, -0.800 m (calib_imu_to_velo.txt)" in facts["IMU to lidar"]
    result = write.expect_mapped(dataset, 0.03)
    assert result.imu.sweep_motions["gyro"] >= write.COUNT - 1


def test_a_gps_imu_at_the_rate_of_the_sweeps_is_told(tmp_path: Path) -> None:
    root = write_drive(tmp_path, period=103_600_000)
    problems = " ".join(open_dataset(root).info().problems)
    assert "oxts: 9.65 Hz; gaps above imu.max_gap (0.1 s) are not bridged" in problems
    wide = QUICK.changed(imu=ImuConfig(max_gap=0.25))
    for config, used in ((QUICK, False), (wide, True)):
        result = run(open_dataset(root), config)
        assert (result.imu.sweep_motions["gyro"] > 0) is used


def test_without_the_calibration_the_gps_imu_is_left_out(tmp_path: Path) -> None:
    root = write_drive(tmp_path)
    (tmp_path / "calib_imu_to_velo.txt").unlink()
    dataset = open_dataset(root)
    assert dataset.imu is None
    assert dataset.truth is None
    assert "oxts left out: no calib_imu_to_velo.txt" in " ".join(dataset.info().problems)
    (root / "calib_imu_to_velo.txt").write_text(CALIBRATION)
    assert open_dataset(root).truth is not None
    for text in ("T: 1 2 3\n", "R: 1 2 3\nT: 1 2 3\n"):
        (root / "calib_imu_to_velo.txt").write_text(text)
        with pytest.raises(DatasetError, match=r"calib_imu_to_velo.txt: expected R: with 9 and T:"):
            open_dataset(root)


def test_files_of_the_user_win_over_the_gps_imu(tmp_path: Path) -> None:
    root = write_drive(tmp_path)
    (root / "gt.tum").write_text("0 1 2 3 0 0 0 1\n")
    (root / "imu.csv").write_text("0,0,0,0,1,0,0,0,0,0,9.81\n")
    dataset = open_dataset(root)
    assert len(dataset.truth) == 1
    assert len(dataset.imu.stamps) == 1
    assert "imu.lidar_t_imu" not in dataset.sensor


@pytest.mark.parametrize(
    ("file", "text", "match"),
    [
        ("oxts/data/0000000003.txt", "1 2 3\n", r"0000000003.txt: expected 30 numbers: 3 values"),
        ("oxts/timestamps.txt", "2011-09-26 13:02:25.5\n", r"1 stamps for 90 packets; expected"),
        ("velodyne_points/timestamps_end.txt", "2011-09-26 13:02:25.5\n", r"6 and 1 stamps for 6"),
        ("velodyne_points/timestamps.txt", "2011-09-26 13:02:25.5\n", r"1 stamps for 6 sweeps"),
    ],
)
def test_a_damaged_drive_says_which_file(tmp_path: Path, file: str, text: str, match: str) -> None:
    root = write_drive(tmp_path)
    (root / file).write_text(text)
    with pytest.raises(DatasetError, match=match):
        open_dataset(root)


def test_sweeps_that_a_drive_lacks_are_told_by_their_numbers(tmp_path: Path) -> None:
    root = write_drive(tmp_path)
    (root / "velodyne_points" / "data" / "0000000002.bin").unlink()
    dataset = open_dataset(root)
    assert isinstance(dataset, KittiDataset)
    expected = write.stamps(**WORLD) + MIDDLE
    assert dataset.stamps.tolist() == np.delete(expected, 2).tolist()
    assert "1 sweeps of timestamps.txt have no file" in dataset.info().problems


def test_stamps_outside_their_sweep_are_told(tmp_path: Path) -> None:
    root = write_drive(tmp_path)
    late = [stamp + 3 * MIDDLE for stamp in write.stamps(**WORLD).tolist()]
    write_dates(root / "velodyne_points" / "timestamps.txt", late)
    assert "6 stamps lie outside their sweep's start and end" in open_dataset(root).info().problems
    write_dates(root / "velodyne_points" / "timestamps_end.txt", [late[0] + 10**10] * 6)
    with pytest.raises(DatasetError, match=r"timestamps_end.txt: sweeps of 9.9\d* s \(median\)"):
        open_dataset(root)


CAMERA_T_LIDAR = np.array(
    [
        [4.276802385584e-04, -9.999672484946e-01, -8.084491683471e-03, -1.198459927713e-02],
        [-7.210626507497e-03, 8.081198471645e-03, -9.999413164504e-01, -5.403984729748e-02],
        [9.999738645903e-01, 4.859485810390e-04, -7.206933692422e-03, -2.921968648686e-01],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Tr of sequence 00."""


def write_odometry(root: Path) -> Path:
    sequence = root / "sequences" / "00"
    (sequence / "velodyne").mkdir(parents=True)
    stamps = write.stamps(**WORLD)
    truth = write.room(**WORLD).truth_at(stamps).map_T_lidar
    for number, sweep in enumerate(write.sweeps(**WORLD)):
        # Freed of the motion: every point as if it had been measured at the stamp.
        own = np.rint(sweep.times * 1e9).astype(np.int64)
        moments, which = np.unique(own, return_inverse=True)
        then = write.room(**WORLD).truth_at(stamps[number] + moments).map_T_lidar
        poses = np.linalg.inv(truth[number]) @ then
        moved = np.einsum("nij,nj->ni", poses[which, :3, :3], sweep.points) + poses[which, :3, 3]
        order = np.lexsort((np.arctan2(moved[:, 1], moved[:, 0]), -np.asarray(sweep.rings)))
        values = np.column_stack([moved[order], np.zeros(len(order))]).astype("<f4")
        values.tofile(sequence / "velodyne" / f"{number:06d}.bin")
    first = stamps[0]
    seconds = "".join(f"{(stamp - first) * 1e-9:e}\n" for stamp in stamps)
    (sequence / "times.txt").write_text(seconds)
    numbers = " ".join(f"{value:.12e}" for value in CAMERA_T_LIDAR[:3].ravel())
    camera = "7.188560000000e+02 0 6.071928e+02 0 0 7.18856e+02 1.852157e+02 0 0 0 1 0"
    (sequence / "calib.txt").write_text(f"P0: {camera}\nTr: {numbers}\n")
    poses = CAMERA_T_LIDAR @ np.linalg.inv(truth[0]) @ truth @ np.linalg.inv(CAMERA_T_LIDAR)
    (root / "poses").mkdir()
    np.savetxt(root / "poses" / "00.txt", poses[:, :3].reshape(-1, 12))
    return sequence


def test_a_sequence_of_the_odometry_benchmark_is_not_de_skewed_again(tmp_path: Path) -> None:
    sequence = write_odometry(tmp_path)
    for path in (sequence, sequence / "velodyne"):
        dataset = open_dataset(path)
        assert dataset.sensor["times"] == "none"
        expected = write.room(**WORLD).truth_at(write.stamps(**WORLD)).map_T_lidar
        expected = np.linalg.inv(expected[0]) @ expected
        np.testing.assert_allclose(dataset.truth.map_T_lidar, expected, atol=1e-6)
    assert "already freed of the motion" in " ".join(dataset.info().problems)
    write.expect_mapped(dataset, imu=False)


def test_the_odometry_benchmark_s_poses_must_fit_the_sweeps(tmp_path: Path) -> None:
    sequence = write_odometry(tmp_path)
    file = tmp_path / "poses" / "00.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(DatasetError, match=r"00.txt: 5 poses for 6 sweeps"):
        _ = open_dataset(sequence).truth
    file.write_text("\n".join([*lines[:3], "1 2 3", *lines[4:]]) + "\n")
    with pytest.raises(
        DatasetError, match=r"00.txt:4: expected 12 numbers of a rigid transform, got '1 2 3'"
    ):
        _ = open_dataset(sequence).truth
    file.unlink()
    assert open_dataset(sequence).truth is None
    (sequence / "calib.txt").write_text("Tr: 1 2 3\n")
    with pytest.raises(DatasetError, match=r"calib.txt: expected Tr: with 12 numbers"):
        open_dataset(sequence)
    (sequence / "calib.txt").write_text("P0: 1 2 3\n")
    dataset = open_dataset(sequence)
    assert dataset.sensor["stamp"] == "middle"  # nothing says that it is of the benchmark
    assert isinstance(next(iter(dataset)), Scan)


def test_a_drive_of_kitti_360_has_its_poses(tmp_path: Path) -> None:
    """Frame numbers and poses of a camera; rays are left as they are."""
    name = "2013_05_28_drive_0000_sync"
    root = tmp_path / "data_3d_raw" / name
    stamps = write_sweeps(root / "velodyne_points" / "data")
    write_dates(root / "velodyne_points" / "timestamps.txt", stamps)
    assert open_dataset(root).truth is None
    lidar_T_camera = np.linalg.inv(CAMERA_T_LIDAR)
    true = write.room(**WORLD).truth_at(np.array(stamps[1:])).map_T_lidar
    poses = tmp_path / "data_poses" / name / "cam0_to_world.txt"
    rows = (true @ lidar_T_camera).reshape(-1, 16)
    poses.parent.mkdir(parents=True)
    lines = [f"{k} {' '.join(map(repr, row.tolist()))}" for k, row in enumerate(rows, start=1)]
    poses.write_text("\n".join(lines) + "\n")
    dataset = open_dataset(root)
    assert dataset.truth is None
    assert "calib_cam_to_velo.txt says where the scanner is" in " ".join(dataset.info().problems)
    (tmp_path / "calibration").mkdir()
    calibration = tmp_path / "calibration" / "calib_cam_to_velo.txt"
    calibration.write_text(" ".join(map(repr, lidar_T_camera[:3].ravel().tolist())) + "\n")
    dataset = open_dataset(root)
    assert dataset.truth.stamps.tolist() == stamps[1:]
    np.testing.assert_allclose(dataset.truth.map_T_lidar, true, atol=1e-7)
    assert "elevation raised by" not in dataset.info().facts
    assert dataset.sensor["stamp"] == "middle"
    poses.write_text(f"{len(stamps)} {' '.join(['0'] * 16)}\n")
    with pytest.raises(DatasetError, match=r"cam0_to_world.txt:1: expected a frame number"):
        _ = open_dataset(root).truth
    calibration.write_text("")
    with pytest.raises(DatasetError, match=r"calib_cam_to_velo.txt: .*got an empty file"):
        _ = open_dataset(root).truth
