"""Boreas in files of its layout, and bags that are told by their topics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import layout_writers as write
from support.bags import Recording, cloud, imu, odometry, store_of, write_bag

from loam_gtsam import absolute_error
from loam_gtsam.datasets import BagDataset, BoreasDataset, RigBag, open_dataset
from loam_gtsam.datasets.decode.tables import pose_matrix
from loam_gtsam.datasets.known.rigs import HILTI_2021
from loam_gtsam.types import DatasetError

MIDDLE = 50_000_000
IMU_T_XT32 = pose_matrix([-0.001, -0.00855, 0.055, 0.7071068, -0.7071068, 0.0, 0.0])
HESAI = "/hesai/pandar", "/alphasense/imu"
POINTS = {"pole": (-0.00938425, -0.0148401), "prism": (-0.00594496, -0.00721288)}
OS0 = "/os_cloud_node/points", "/alphasense/imu"
VIRAL = "/os1_cloud_node1/points", "/imu/imu"


def write_boreas(root: Path, **world: object) -> Path:
    (root / "lidar").mkdir(parents=True)
    for sweep in write.sweeps(**world):
        columns = np.zeros(len(sweep.points)), sweep.rings, sweep.times - 0.05
        rows = np.column_stack([sweep.points, *columns]).astype("<f4")
        rows.tofile(root / "lidar" / f"{(sweep.stamp + MIDDLE) // 1000}.bin")
    truth = write.lidar_truth(**world)
    # The kit multiplies rolls by pitches by yaws of the angles' opposites.
    x, y, z = np.eye(3)
    angles = -Rotation.from_matrix(truth.map_T_lidar[:, :3, :3]).as_euler("XYZ")
    one = truth.map_T_lidar[0, :3, :3]
    turns = [Rotation.from_rotvec(-a * axis) for a, axis in zip(angles[0], (x, y, z), strict=True)]
    np.testing.assert_allclose((turns[0] * turns[1] * turns[2]).as_matrix(), one, atol=1e-12)
    rest = np.zeros((len(angles), 3))
    rows = np.hstack([truth.positions, rest, angles, rest])
    header = "GPSTime,easting,northing,altitude,ve,vn,vu,roll,pitch,heading,wz,wy,wx"
    write.write_rows(root / "applanix" / "lidar_poses.csv", truth.stamps // 1000, rows, ",", header)
    return root


def test_a_boreas_sequence_is_recognised_and_mapped(tmp_path: Path) -> None:
    dataset = open_dataset(write_boreas(tmp_path))
    assert isinstance(dataset, BoreasDataset)
    assert dataset.stamps.tolist() == (write.stamps() + MIDDLE).tolist()
    assert dataset.imu is None
    write.expect_truth(dataset)
    scan = next(iter(dataset))
    assert scan.times.min() == pytest.approx(-0.05, abs=0.002)
    assert len(np.unique(scan.rings)) == 64
    write.expect_mapped(dataset, imu=False)


def test_what_is_wrong_with_boreas_is_told(tmp_path: Path) -> None:
    root = write_boreas(tmp_path)
    table = root / "applanix" / "lidar_poses.csv"
    table.write_text("head\n1606417097528152,1,2,3\n")
    with pytest.raises(DatasetError, match=r"lidar_poses.csv:2: expected microseconds, easting"):
        _ = open_dataset(root).truth
    (root / "lidar" / "first.bin").touch()
    with pytest.raises(DatasetError, match="first is not MICROSECONDS"):
        open_dataset(root)


def write_rig(
    path: Path, topics: tuple[str, str], lidar_R_imu: np.ndarray, more: Recording | None = None
) -> Path:
    store = store_of("ros1")
    entries: Recording = list(more or [])
    for sweep in write.sweeps():
        rings = np.asarray(sweep.rings).astype("<u2")
        times = sweep.stamp * 1e-9 + sweep.times
        message = cloud(store, sweep.stamp, sweep.points, timestamp=times, ring=rings)
        entries.append((topics[0], sweep.stamp, message))
    stamps, quaternions, gyro, acceleration = write.imu_rows(lidar_R_imu)
    values = np.hstack([quaternions, gyro, acceleration])
    for stamp, row in zip(stamps.tolist(), values, strict=True):
        entries.append((topics[1], stamp, imu(store, stamp, row, unknown=True)))
    write_bag(path, "ros1", sorted(entries, key=lambda entry: entry[1]))
    return path


def test_a_hilti_bag_is_told_by_its_topics_and_has_its_extrinsics(tmp_path: Path) -> None:
    lidar_R_imu = IMU_T_XT32[:3, :3].T
    bag = write_rig(tmp_path / "exp04_upper_level.bag", HESAI, lidar_R_imu)
    truth = write.body_truth(IMU_T_XT32)
    seconds = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in truth.stamps]
    names = "exp04_upper_level_imu.txt", "exp_04_upper_level_imu.txt"
    for name in names:
        write.write_rows(tmp_path / name, seconds, write.quaternion_rows(truth), " ")
        dataset = open_dataset(bag)
        assert isinstance(dataset, RigBag)
        write.expect_truth(dataset)
        (tmp_path / name).unlink()
    dataset = dataset.with_truth(write.lidar_truth())
    result = write.expect_mapped(dataset)
    turned = Rotation.from_euler("xyz", result.config.imu.lidar_R_imu_deg, degrees=True)
    np.testing.assert_allclose(turned.as_matrix(), lidar_R_imu, atol=1e-6)


def test_hilti_2021_is_another_lidar_above_the_same_imu(tmp_path: Path) -> None:
    """The pose of the case in the IMU's frame is the one that FAST-LIO-MULTI has in digits."""
    imu_T_case = np.eye(4)
    imu_T_case[:3] = [
        [0.9999757, 0.0024556, -0.0065197, 0.0102543784],
        [0.0024579, -0.9999969, 0.0003309, -0.0066573859],
        [-0.0065188, -0.0003470, -0.9999787, 0.130729657],
    ]
    np.testing.assert_allclose(HILTI_2021.body_T_lidar, imu_T_case, atol=1e-6)
    bag = write_rig(tmp_path / "Basement_1.bag", OS0, imu_T_case[:3, :3].T)
    truth = write.body_truth(HILTI_2021.body_T_lidar)
    seconds = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in truth.stamps]
    write.write_rows(tmp_path / "Basement_1_imu.txt", seconds, write.quaternion_rows(truth), " ")
    dataset = open_dataset(bag)
    assert isinstance(dataset, RigBag)
    write.expect_truth(dataset)
    position = -imu_T_case[:3, :3].T @ imu_T_case[:3, 3]
    np.testing.assert_allclose(dataset.sensor["imu.lidar_t_imu"], position, atol=1e-5)
    write.expect_mapped(dataset)


@pytest.mark.parametrize("point", ["pole", "prism"])
def test_positions_of_the_pole_are_compared_at_the_pole(tmp_path: Path, point: str) -> None:
    imu_T_lidar = HILTI_2021.body_T_lidar
    bag = write_rig(tmp_path / "IC_Office_1.bag", OS0, imu_T_lidar[:3, :3].T)
    truth = write.body_truth(imu_T_lidar)
    offset = {"pole": 1.66722, "prism": 0.272943}[point]
    beside = truth.map_T_lidar @ np.array([*POINTS[point], offset, 1.0])
    lines = [
        f"{stamp * 1e-9:.9f} {x:.9f} {y:.9f} {z:.9f} 0 0 0 1"
        for stamp, (x, y, z, _) in zip(truth.stamps, beside, strict=True)
    ]
    (tmp_path / f"IC_Office_1_{point}.txt").write_text("\n".join(lines))
    dataset = open_dataset(bag)
    assert np.isnan(dataset.truth.map_T_lidar[:, :3, :3]).all()
    exact = write.lidar_truth()
    assert absolute_error(exact, dataset.truth).rmse < 1e-5
    assert f"IC_Office_1_{point}.txt" in dataset.info().facts["reference poses"]


def test_ntu_viral_brings_the_positions_of_its_prism(tmp_path: Path) -> None:
    exact = write.lidar_truth()
    # Prism and lidar in the frame of the IMU, by the calibration files of the data set.
    prism = np.array([-0.293656, -0.012288, -0.273095]) - np.array([-0.05, 0.0, 0.055])
    places = exact.map_T_lidar[:, :3, :3] @ prism + exact.positions
    store = store_of("ros1")
    entries = []
    for stamp, place in zip(exact.stamps.tolist(), places, strict=True):
        message = odometry(store, stamp, place)
        make = store.types["geometry_msgs/msg/PoseStamped"]
        entry = make(header=message.header, pose=message.pose.pose)
        entries.append(("/leica/pose/relative", stamp, entry))
    dataset = open_dataset(write_rig(tmp_path / "eee_01.bag", VIRAL, np.eye(3), entries))
    assert absolute_error(exact, dataset.truth).rmse < 1e-6
    assert "positions of a prism" in dataset.info().facts["reference poses"]


def test_ntu_viral_has_its_extrinsics_unless_another_lidar_is_asked_for(tmp_path: Path) -> None:
    bag = write_rig(tmp_path / "eee_01.bag", VIRAL, np.eye(3))
    dataset = open_dataset(bag)
    assert isinstance(dataset, RigBag)
    assert dataset.truth is None
    assert dataset.sensor["imu.lidar_t_imu"] == (0.05, 0.0, -0.055)
    assert open_dataset(bag, topic=VIRAL[0]).sensor == dataset.sensor
    with pytest.raises(DatasetError, match="os1_cloud_node2"):
        open_dataset(bag, topic="/os1_cloud_node2/points")
    with pytest.raises(DatasetError, match="no known rig: expected /hesai/pandar and /alphasense"):
        RigBag(write_rig(tmp_path / "other.bag", ("/points", "/imu/imu"), np.eye(3)))
    assert type(open_dataset(tmp_path / "other.bag")) is BagDataset
