"""Small data sets in the layouts of known ones, from a simulated room."""

from __future__ import annotations

import struct
from functools import cache
from pathlib import Path
from typing import Any

import lzf
import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import Scan, Trajectory

FIRST, COUNT = 22, 6
"""Sweeps of the room that are used: by then the sensor moves and turns."""
WORLD_T_MAP = np.eye(4)
WORLD_T_MAP[:3, :3] = Rotation.from_euler("z", 40.0, degrees=True).as_matrix()
WORLD_T_MAP[:3, 3] = (1000.0, -500.0, 30.0)
"""Reference poses of real data sets do not start at the identity."""


@cache
def room(sensor: str = "os1-64", columns: int | None = None) -> SimulatedWorld:
    return SimulatedWorld("shaken", sensor=sensor, columns=columns, frames=FIRST + COUNT, seed=4)


@cache
def sweeps(sensor: str = "os1-64", columns: int | None = None) -> list[Scan]:
    return [room(sensor, columns).sweep(FIRST + i) for i in range(COUNT)]


def stamps(sensor: str = "os1-64", columns: int | None = None) -> np.ndarray:
    return np.array([sweep.stamp for sweep in sweeps(sensor, columns)], np.int64)


def lidar_truth(sensor: str = "os1-64", columns: int | None = None) -> Trajectory:
    """Poses at 50 Hz, from before the first sweep to after the last."""
    at = stamps(sensor, columns)
    times = np.arange(at[0] - 60_000_000, at[-1] + 160_000_000, 20_000_000)
    return Trajectory(times, WORLD_T_MAP @ room(sensor, columns).truth_at(times).map_T_lidar)


def body_truth(body_T_lidar: np.ndarray, **world: object) -> Trajectory:
    truth = lidar_truth(**world)
    return Trajectory(truth.stamps, truth.map_T_lidar @ np.linalg.inv(body_T_lidar))


def imu_rows(lidar_R_imu: np.ndarray) -> tuple[np.ndarray, ...]:
    """Stamps, quaternions, gyro and acceleration of an IMU turned like this, while sweeps last."""
    samples = room().imu
    at = stamps()
    use = (samples.stamps >= at[0] - 100_000_000) & (samples.stamps <= at[-1] + 150_000_000)
    world_R_imu = Rotation.from_quat(samples.orientation[use]) * Rotation.from_matrix(lidar_R_imu)
    turn = np.asarray(lidar_R_imu)  # rows times R is R^T times columns
    return (
        samples.stamps[use],
        world_R_imu.as_quat(),
        samples.gyro[use] @ turn,
        samples.acceleration[use] @ turn,
    )


def expect_truth(dataset: Any, **world: object) -> None:
    """Its reference poses are those of the lidar."""
    expected = lidar_truth(**world)
    np.testing.assert_array_equal(dataset.truth.stamps, expected.stamps)
    np.testing.assert_allclose(dataset.truth.map_T_lidar, expected.map_T_lidar, atol=1e-8)


def expect_sweeps(dataset: Any, expected: list[Scan]) -> None:
    for scan, wanted in zip(dataset, expected, strict=True):
        assert scan.stamp == wanted.stamp
        np.testing.assert_array_equal(scan.points, wanted.points)
        np.testing.assert_array_equal(scan.rings, wanted.rings)
        np.testing.assert_allclose(scan.times, wanted.times, atol=1e-6)


def expect_mapped(dataset: Any, limit: float = 0.02, imu: bool = True) -> RunResult:
    """A run follows the reference poses and, if there is an IMU, trusts its gyro."""
    result = run(dataset)
    assert absolute_error(result.trajectory, dataset.truth).rmse < limit
    if imu:
        assert result.imu.gyro_trusted
        assert result.imu.problems == result.imu.report.problems
    return result


def firings(sweep: Scan, beams: int, columns: int) -> np.ndarray:
    """(beams * columns, 4) float32, firing by firing, zero where nothing came back."""
    column = np.rint(sweep.times * 10.0 * columns).astype(np.int64)
    values = np.zeros((beams * columns, 4), "<f4")
    # Ouster's beams are numbered from the top.
    values[column * beams + (beams - 1 - sweep.rings), :3] = sweep.points
    return values


def quaternion_rows(trajectory: Trajectory) -> np.ndarray:
    """(N, 7): x y z qx qy qz qw."""
    poses = trajectory.map_T_lidar
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])


def write_rows(
    path: Path, stamps: object, rows: np.ndarray, separator: str = ",", header: str = ""
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [header] if header else []
    for stamp, row in zip(stamps, rows, strict=True):
        lines.append(separator.join([str(stamp), *(repr(float(value)) for value in row)]))
    path.write_text("\n".join(lines) + "\n")


def write_xsens(path: Path, lidar_R_imu: np.ndarray, gyro_last: bool = False) -> None:
    at, quaternions, gyro, acceleration = imu_rows(lidar_R_imu)
    angles = Rotation.from_quat(quaternions).as_euler("xyz", degrees=True)
    magnetic = np.tile([0.3, 0.1, -0.4], (len(at), 1))
    first, last = (magnetic, gyro) if gyro_last else (gyro, magnetic)
    write_rows(path, at, np.hstack([quaternions, angles, first, acceleration, last]))


def write_pcd(path: Path, columns: dict[str, np.ndarray], data: str = "binary") -> None:
    """Fields in the given order, with four bytes of padding after the first three."""
    names = list(columns)
    record = np.dtype(
        [
            *((name, columns[name].dtype) for name in names[:3]),
            ("_", "u1", (4,)),
            *((name, columns[name].dtype) for name in names[3:]),
        ]
    )
    points = np.zeros(len(columns[names[0]]), record)
    for name in names:
        points[name] = columns[name]
    kinds = [record[name].base for name in record.names or ()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(record.names or ()),
        "SIZE " + " ".join(str(kind.itemsize) for kind in kinds),
        "TYPE " + " ".join(kind.kind.upper() for kind in kinds),
        "COUNT " + " ".join("4" if name == "_" else "1" for name in record.names or ()),
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        f"DATA {data}",
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    body = points.tobytes()
    if data == "binary_compressed":
        by_field = b"".join(points[name].tobytes() for name in record.names or ())
        packed = lzf.compress(by_field, 2 * len(by_field))
        body = struct.pack("<II", len(packed), len(by_field)) + packed
    path.write_bytes("\n".join(header).encode() + b"\n" + body)


HELIPR_SENSORS = {
    "Ouster": ("os1-128", 512),
    "Velodyne": ("vlp16", 512),
    "Avia": ("avia", 6000),
    "Aeva": ("avia", 6000),
}
"""Simulated sensors in place of those of the data set, and their columns."""


def write_helipr(root: Path, lidar: str = "Ouster") -> Path:
    """As the record of the file player: no padding between the fields."""
    folder = root / "LiDAR" / lidar
    folder.mkdir(parents=True)
    kinds = {
        "Ouster": (
            "<f4 <f4 <f4 <f4 <u4 <u2 <u2 <u2",
            "x y z intensity t reflectivity ring ambient",
        ),
        "Velodyne": ("<f4 <f4 <f4 <f4 <u2 <f4", "x y z intensity ring time"),
        "Avia": ("<f4 <f4 <f4 u1 u1 u1 <u4", "x y z intensity tag line t"),
        "Aeva": ("<f4 <f4 <f4 <f4 <f4 <i4 u1 <f4", "x y z reflectivity velocity t line intensity"),
    }[lidar]
    record = np.dtype(list(zip(kinds[1].split(), kinds[0].split(), strict=True)))
    assert record.itemsize == {"Ouster": 26, "Velodyne": 22, "Avia": 19, "Aeva": 29}[lidar]
    for sweep in sweeps(*HELIPR_SENSORS[lidar]):
        points = np.zeros(len(sweep.points), record)
        for axis, name in enumerate("xyz"):
            points[name] = sweep.points[:, axis]
        if sweep.rings is not None:
            points["ring"] = sweep.rings
        if lidar == "Velodyne":
            points["time"] = sweep.times
        else:
            points["t"] = np.rint(sweep.times * 1e9)
        points.tofile(folder / f"{sweep.stamp}.bin")
    truth = lidar_truth()
    write_rows(root / "LiDAR_GT" / f"{lidar}_gt.txt", truth.stamps, quaternion_rows(truth), " ")
    return root
