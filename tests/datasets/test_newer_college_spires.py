"""Newer College and Oxford Spires, in bags and PCD files of their layout."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import layout_writers as write
from support.bags import Recording, cloud, imu, store_of, write_bag

from loam_gtsam import datasets
from loam_gtsam.datasets.decode.packed_points import read_pcd
from loam_gtsam.datasets.decode.tables import pose_matrix
from loam_gtsam.datasets.known import layouts
from loam_gtsam.types import DatasetError, Scan

WORLD = {"sensor": "os1-64", "columns": 512}
CAMERA_T_OS1 = pose_matrix([-0.084, -0.025, 0.050, 0.0, 0.0, 0.924, 0.383])
BASE_T_OS0 = pose_matrix([0.001, 0.0, 0.091, 0.0, 0.0, 0.0, 1.0])
BASE_T_QT64 = pose_matrix([0.0, 0.0, 0.124, 0.0, 0.0, 1.0, 0.0])
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
ABOUT = pytest.approx


def recording(
    topic: str, imu_topic: str, lidar_R_imu: np.ndarray, kind: str = "ros1", absolute: bool = False
) -> Recording:
    """The sweeps and the IMU of the room, and another IMU that has more messages."""
    store = store_of(kind)
    entries: Recording = []
    for sweep in write.sweeps(**WORLD):
        if absolute:
            columns = {"timestamp": sweep.stamp * 1e-9 + sweep.times, "ring": sweep.rings}
        else:
            columns = {"t": np.rint(sweep.times * 1e9).astype("<u4"), "ring": sweep.rings}
        columns["ring"] = np.asarray(columns["ring"]).astype("<u2")
        message = cloud(store, sweep.stamp, sweep.points, **columns)
        entries.append((topic, sweep.stamp + 110_000_000, message))
    stamps, quaternions, gyro, acceleration = write.imu_rows(lidar_R_imu)
    values = np.hstack([quaternions, gyro, acceleration])
    for stamp, row in zip(stamps.tolist(), values, strict=True):
        entries.append((imu_topic, stamp, imu(store, stamp, row, unknown=True)))
        for later in (0, 2_000_000):
            entries.append(("/camera/imu", stamp + later, imu(store, stamp + later)))
    return sorted(entries, key=lambda entry: entry[1])


def of_2021() -> Recording:
    return recording("/os_cloud_node/points", "/os_cloud_node/imu", np.eye(3))


def write_truth(path: Path, body_T_lidar: np.ndarray, tum: bool = False) -> None:
    truth = write.body_truth(body_T_lidar, **WORLD)
    rows = write.quaternion_rows(truth)
    point, separator, header = (".", " ", "") if tum else (",", ",", "#sec,nsec,x,y,z,qx,qy,qz,qw")
    stamps = [f"{stamp // 10**9}{point}{stamp % 10**9:09d}" for stamp in truth.stamps]
    write.write_rows(path, stamps, rows, separator, header)


def write_parts(folder: Path, names: list[str], entries: Recording) -> None:
    """A recording cut into as many bags."""
    folder.mkdir(parents=True, exist_ok=True)
    size = -(-len(entries) // len(names))
    for number, name in enumerate(names):
        write_bag(folder / name, "ros1", entries[number * size : (number + 1) * size])


def test_newer_college_2020_is_read_over_all_its_bags_and_mapped(tmp_path: Path) -> None:
    names = [f"rooster_2020-03-10-10-3{i}-30_{i}" for i in range(3)]
    entries = recording("/os1_cloud_node/points", "/os1_cloud_node/imu", HALF_TURN)
    write_parts(tmp_path / "rosbag", names, entries)
    write_truth(tmp_path / "ground_truth" / "registered_poses.csv", CAMERA_T_OS1)
    dataset = datasets.open_dataset(tmp_path)
    assert isinstance(dataset, datasets.NewerCollegeBags)
    assert [sweep.stamp for sweep in dataset] == write.stamps(**WORLD).tolist()
    assert dataset.imu_topic == "/os1_cloud_node/imu"  # not the one with more messages
    write.expect_truth(dataset, **WORLD)
    # Ouster's manual: lidar frame half a turn about z from the case, 36.18 mm up; the IMU at
    # 6.253, -11.775, 7.645 mm.
    assert abs(dataset.sensor["imu.lidar_R_imu_deg"][2]) == ABOUT(180.0)
    assert dataset.sensor["imu.lidar_t_imu"] == ABOUT((-0.006253, 0.011775, -0.028535))
    info = dataset.info()
    assert info.kind == "Newer College 2020, ROS 1 bag"
    assert info.facts["bags"] == f"{names[0]}.bag and 2 more"
    assert "registered_poses.csv" in info.facts["reference poses"]
    assert "Ouster's manual" in info.facts["IMU to lidar"]
    write.expect_mapped(dataset)


def test_one_bag_of_newer_college_is_only_itself_and_finds_its_truth(tmp_path: Path) -> None:
    names = [f"2021-11-30-17-0{i}-49_{i}-park" for i in range(2)]
    write_parts(tmp_path, names, of_2021())
    write_truth(tmp_path / "ground_truth" / "tum_format" / "gt-nc-park.csv", BASE_T_OS0, tum=True)
    first = datasets.open_dataset(tmp_path / f"{names[0]}.bag")
    assert isinstance(first, datasets.NewerCollegeBags)
    assert 0 < len(first) < len(datasets.open_dataset(tmp_path)) == write.COUNT
    write.expect_truth(first, **WORLD)
    assert first.sensor["imu.lidar_R_imu_deg"] == ABOUT((0.0, 0.0, 0.0), abs=1.0)
    # evalio has the lidar in the IMU's axes at 13.801, -12.207, -15.14 mm.
    assert first.sensor["imu.lidar_t_imu"] == ABOUT((-0.0138, 0.0122, 0.0151), abs=2e-4)


def test_a_folder_of_several_sequences_asks_which_one(tmp_path: Path) -> None:
    entries = of_2021()
    write_parts(tmp_path, ["2021-07-01-10-37-38-quad-easy"], entries)
    write_parts(tmp_path, ["2021-07-01-10-40-50_0-stairs"], entries)
    write_truth(tmp_path / "gt-nc-quad-easy.csv", BASE_T_OS0)
    with pytest.raises(DatasetError, match=r"several sequences \(quad-easy, stairs\); give seq"):
        datasets.open_dataset(tmp_path)
    with pytest.raises(DatasetError, match=r"no sequence 'park'; there is quad-easy, stairs"):
        datasets.open_dataset(tmp_path, sequence="park")
    write.expect_truth(datasets.open_dataset(tmp_path, sequence="quad-easy"), **WORLD)
    assert datasets.open_dataset(tmp_path, sequence="stairs").truth is None
    write_parts(tmp_path, ["2022-07-01-10-40-50_0-stairs"], entries)
    with pytest.raises(DatasetError, match=r"are both part 0: several recordings"):
        datasets.open_dataset(tmp_path)


def test_a_maths_sequence_has_its_truth_under_another_name(tmp_path: Path) -> None:
    write_parts(tmp_path, ["2021-04-07-13-55-18-math-medium"], of_2021())
    write_truth(tmp_path / "ground_truth" / "gt_state_medium.csv", BASE_T_OS0)
    write.expect_truth(datasets.open_dataset(tmp_path), **WORLD)


def test_another_imu_than_the_rig_s_has_no_known_extrinsics(tmp_path: Path) -> None:
    write_parts(tmp_path, ["2021-07-01-10-40-50_0-stairs"], of_2021())
    dataset = datasets.open_dataset(tmp_path, imu_topic="/camera/imu")
    assert dataset.sensor == {}
    assert "rotation to the lidar is unknown" in " ".join(dataset.info().problems)


def test_any_other_bag_stays_any_other_bag(tmp_path: Path) -> None:
    write_parts(tmp_path, ["2021-07-01-10-40-50-katzensee"], of_2021())
    dataset = datasets.open_dataset(tmp_path / "2021-07-01-10-40-50-katzensee.bag")
    assert type(dataset) is datasets.BagDataset
    with pytest.raises(DatasetError, match=r"open one of its bags instead"):
        datasets.open_dataset(tmp_path)


@pytest.mark.parametrize("timed", [False, True])
def test_newer_college_as_pcd_files(tmp_path: Path, timed: bool) -> None:
    folder = tmp_path / "raw_format" / "ouster_scan"
    for sweep in write.sweeps():
        name = f"cloud_{sweep.stamp // 10**9}_{sweep.stamp % 10**9:09d}.pcd"
        if timed:
            times = np.rint(sweep.times * 1e9).astype("<u4")
            columns = dict(zip("xyz", sweep.points.T, strict=True)) | {"t": times}
        else:
            columns = dict(zip("xyz", write.firings(sweep, 64, 1024)[:, :3].T, strict=True))
        write.write_pcd(folder / name, columns)
    write_truth(tmp_path / "ground_truth" / "registered_poses.csv", CAMERA_T_OS1)
    dataset = datasets.open_dataset(tmp_path)
    assert isinstance(dataset, datasets.NewerCollegeClouds)
    write.expect_truth(dataset, **WORLD)
    scan = next(iter(dataset))
    seen = np.any(scan.points != 0.0, axis=1)
    assert sorted(scan.times[seen]) == ABOUT(sorted(write.sweeps()[0].times), abs=1e-8)
    assert dataset.imu is None
    assert "the bags have one" in " ".join(dataset.info().problems)
    if not timed:
        late = datasets.NewerCollegeClouds(tmp_path, stamp_is="end")
        np.testing.assert_allclose(next(iter(late)).times, scan.times - 0.1, atol=1e-9)
        assert late.info().facts["point times"].endswith("firings in 0.1 s, stamp at sweep end")
        write.write_pcd(folder / name, {key: values[:-64] for key, values in columns.items()})
        last = list(dataset)[-1]
        assert "65472 points, expected 1024 firings of 64" in last.message


def write_spires_clouds(root: Path, data: str = "binary") -> Path:
    for sweep in write.sweeps(**WORLD):
        assert sweep.times is not None
        columns = dict(zip("xyz", sweep.points.T, strict=True))
        columns["timestamp"] = sweep.stamp * 1e-9 + sweep.times
        columns["ring"] = sweep.rings.astype("<u2")
        name = f"{sweep.stamp // 10**9}.{sweep.stamp % 10**9:09d}.pcd"
        write.write_pcd(root / "raw" / "lidar-clouds" / name, columns, data)
    stamps, _, gyro, acceleration = write.imu_rows(spires_R_imu())
    write.write_rows(
        root / "raw" / "imu.csv",
        [f"{stamp // 10**9},{stamp % 10**9}" for stamp in stamps],
        np.hstack([acceleration, gyro]),
        ",",
        "secs,nsecs,acc_x,acc_y,acc_z,ang_vel_x,ang_vel_y,ang_vel_z",
    )
    write_truth(root / "processed" / "trajectory" / "gt-tum.txt", BASE_T_QT64, tum=True)
    return root


def spires_R_imu() -> np.ndarray:
    """Of cam_front in sensor.yaml: the IMU's x axis points to the lidar's right, to a degree."""
    lidar_R_camera = Rotation.from_quat(
        [0.5034725628949727, 0.5003337192107279, -0.4947539264483171, 0.5013981452864594]
    ).inv()
    camera_R_imu = Rotation.from_quat(
        [0.0042909719518877815, -0.7085293318962699, 0.705668106144218, 0.0005453193252705428]
    )
    return (lidar_R_camera * camera_R_imu).as_matrix()


def test_oxford_spires_as_pcd_files_is_mapped_with_its_imu(tmp_path: Path) -> None:
    dataset = datasets.open_dataset(write_spires_clouds(tmp_path))
    assert isinstance(dataset, datasets.OxfordSpiresClouds)
    write.expect_truth(dataset, **WORLD)
    write.expect_sweeps(dataset, write.sweeps(**WORLD))
    assert dataset.sensor["imu.lidar_R_imu_deg"] == ABOUT((0.0, 0.0, -90.0), abs=1.0)
    write.expect_mapped(dataset)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_oxford_spires_as_bags_in_either_layout(tmp_path: Path, kind: str) -> None:
    topics = ("/hesai/pandar", "/alphasense_driver_ros/imu")
    entries = recording(*topics, spires_R_imu(), kind, absolute=True)
    half = len(entries) // 2
    inner = "raw/rosbag" if kind == "ros1" else "raw/ros2bag"
    for root, below in ((tmp_path / "whole", inner), (tmp_path / "flat", "")):
        (root / below).mkdir(parents=True)
        for part, cut in enumerate((entries[:half], entries[half:])):
            write_bag(root / below / f"1710754066_{part}", kind, cut)
        truth = root / ("processed/trajectory/gt-tum.txt" if below else "gt-tum.txt")
        write_truth(truth, BASE_T_QT64, tum=True)
        dataset = datasets.open_dataset(root)
        assert isinstance(dataset, datasets.OxfordSpiresBags)
        assert [sweep.stamp for sweep in dataset] == write.stamps(**WORLD).tolist()
        assert (dataset.topic, dataset.imu_topic) == topics
        write.expect_truth(dataset, **WORLD)
        assert "absolute" in dataset.info().facts["point times"]
    if kind != "ros1":  # one bag whose own folder holds the reference poses
        alone = write_bag(tmp_path / "alone", kind, entries)
        assert type(datasets.open_dataset(alone)) is datasets.BagDataset
        write_truth(alone / "gt-tum.txt", BASE_T_QT64, tum=True)
        write.expect_truth(datasets.open_dataset(alone), **WORLD)


@pytest.mark.parametrize(
    ("broken", "match"),
    [
        (lambda data: data[:2000], r"need \d+ bytes, got \d+; the file is cut off"),
        (lambda data: data.replace(b"binary", b"binary_compressed"), r"cut off or damaged"),
        (lambda data: data.replace(b"DATA binary", b"DATA zip"), r"PCD with DATA zip; expected"),
        (lambda data: data.replace(b"FIELDS x", b"FIELDS"), r"header cannot be understood"),
        (lambda data: b"ply\n" + data[4000:], r"no PCD file: expected a line DATA"),
        (lambda data: data.replace(b"WIDTH", b"WIDER"), r"header cannot be understood.*WIDTH"),
        (lambda data: data.replace(b"DATA binary", b"DATA ascii"), r"the points cannot be read"),
    ],
)
def test_a_broken_pcd_file_says_what_is_wrong(tmp_path: Path, broken: Any, match: str) -> None:
    root = write_spires_clouds(tmp_path)
    files = sorted((root / "raw" / "lidar-clouds").iterdir())
    files[1].write_bytes(broken(files[1].read_bytes()))
    first, second, *_ = datasets.open_dataset(root)
    assert isinstance(first, Scan)
    with pytest.raises(DatasetError, match=match):
        read_pcd(files[1], 0)
    assert str(files[1]) in second.message


def test_a_compressed_pcd_file_is_read_as_the_binary_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    columns = {name: rng.normal(size=500).astype(np.float32) for name in "xyz"}
    columns |= {"ring": np.arange(500, dtype=np.uint16) // 32, "t": np.linspace(0.0, 0.1, 500)}
    for data in ("binary", "binary_compressed"):
        write.write_pcd(tmp_path / f"{data}.pcd", columns, data)
    plain, packed = (read_pcd(tmp_path / f"{d}.pcd", 5) for d in ("binary", "binary_compressed"))
    assert packed.fields == plain.fields
    np.testing.assert_array_equal(packed.data, plain.data)


def test_a_compressed_pcd_file_names_the_extra_that_reads_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write.write_pcd(tmp_path / "a.pcd", {name: np.zeros(4) for name in "xyz"}, "binary_compressed")
    monkeypatch.setitem(sys.modules, "lzf", None)
    with pytest.raises(DatasetError, match=r"a.pcd: .*pip install .loam_gtsam\[pcd\]"):
        read_pcd(tmp_path / "a.pcd", 0)


def test_an_ascii_pcd_file_is_read_as_the_binary_one(tmp_path: Path) -> None:
    fields = "FIELDS x y z timestamp\nSIZE 4 4 4 8\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    header = f"{fields}WIDTH 2\nHEIGHT 1\n"
    file = tmp_path / "a.pcd"
    file.write_text(header + "POINTS 2\nDATA ascii\n1 2 3 10.25\n-1 0.5 nan 10.5\n")
    cloud_of = read_pcd(file, 5)
    assert [field.name for field in cloud_of.fields] == ["x", "y", "z", "timestamp"]
    values = cloud_of.data.view([("xyz", "<f4", 3), ("t", "<f8")])
    np.testing.assert_array_equal(values["xyz"], [[1.0, 2.0, 3.0], [-1.0, 0.5, np.nan]])
    assert values["t"].tolist() == [10.25, 10.5]


def test_tables_beside_the_sweeps_name_the_line_that_does_not_fit(tmp_path: Path) -> None:
    root = write_spires_clouds(tmp_path)
    file = root / "raw" / "imu.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(["secs,nsecs,ang_vel_x", *lines[1:]]) + "\n")
    with pytest.raises(DatasetError, match=r"imu.csv:1: expected 8 numbers \(secs nsecs acc_x"):
        _ = datasets.open_dataset(root).imu
    truth = root / "processed" / "trajectory" / "gt-tum.txt"
    truth.write_text("# nothing\n")
    with pytest.raises(DatasetError, match=r"gt-tum.txt: no poses"):
        _ = datasets.open_dataset(root).truth
    (root / "raw" / "lidar-clouds" / "first.pcd").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"first is not SECONDS.NANOSECONDS"):
        datasets.open_dataset(root)


@pytest.mark.parametrize("place", ["quad", "math", "underground", "mine"])
def test_sequences_are_told_by_their_names(place: str) -> None:
    bag = Path(f"2021-07-01-10-37-38_1-{place}-hard.bag")
    assert layouts.newer_college_sequence(bag) == (f"{place}-hard", 1)
    assert layouts.newer_college_sequence(Path(f"2021-07-01-10-37-38-{place}.bag")) is None
