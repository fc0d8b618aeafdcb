"""Hours of a live run in one place: does anything grow? ``python -m benchmarks.live_hours``.

A lidar of 16 x 120 beams and an IMU go round and round a room, as messages that are handed to the
live mapper one by one, as fast as it takes them. ``live_hours.csv`` has the memory of the process,
the processor time of a frame and the size of all that is kept, every 500 frames.

``python -m benchmarks.live_hours [--minutes 30] [--frames 100000] [--loops]``
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.cases import ROOT
from benchmarks.process import memory
from benchmarks.tables import write_csv
from loam_gtsam.config import Config
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.ros.live import LiveMapper
from loam_gtsam.types import ImuSamples, Scan

EVERY = 500
COLUMNS = ("frame", "process_mb", "cpu_ms", "worst_ms", "map_points", "imu_samples", "keyframes",
           "loops", "forgotten", "not_solved")  # fmt: skip
_POINT = np.dtype([("xyz", "<f4", 3), ("time", "<f4"), ("ring", "<u2")])
_FIELDS = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("time", 12, 7), ("ring", 16, 4)]


def cloud(scan: Scan) -> Any:
    """A sweep as ``sensor_msgs/PointCloud2``."""
    points = np.zeros(len(scan.points), _POINT)
    points["xyz"], points["time"], points["ring"] = scan.points, scan.times, scan.rings
    names = ("name", "offset", "datatype")
    return SimpleNamespace(
        header=_header(scan.stamp),
        height=1,
        width=len(points),
        fields=[SimpleNamespace(count=1, **dict(zip(names, f, strict=True))) for f in _FIELDS],
        is_bigendian=False,
        point_step=_POINT.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=True,
    )


def sample(samples: ImuSamples, row: int) -> Any:
    """A sample as ``sensor_msgs/Imu``."""
    assert samples.orientation is not None
    gyro, acceleration = samples.gyro[row], samples.acceleration[row]
    return SimpleNamespace(
        header=_header(int(samples.stamps[row])),
        orientation=_named("xyzw", samples.orientation[row]),
        angular_velocity=_named("xyz", gyro),
        linear_acceleration=_named("xyz", acceleration),
        orientation_covariance=np.zeros(9),
    )


def _header(stamp: int) -> Any:
    seconds, rest = divmod(stamp, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=rest), frame_id="lidar")


def _named(names: str, values: Any) -> Any:
    return SimpleNamespace(**dict(zip(names, values.tolist(), strict=True)))


def measure(frames: int, minutes: float, *, loops: bool) -> list[tuple[float, ...]]:
    """A row of :data:`COLUMNS` for every :data:`EVERY` frames, until one of the limits."""
    world = SimulatedWorld("room", frames=frames, columns=120, imu="mems")
    lever = world.sensor["imu.lidar_t_imu"]
    config = Config().changed({"imu.lidar_t_imu": lever, "loops.enabled": loops})
    live = LiveMapper(config, imu=True)
    samples, row, end = world.imu, 0, time.monotonic() + 60.0 * minutes
    rows: list[tuple[float, ...]] = []
    milliseconds: list[float] = []
    not_solved = 0
    for number in range(frames):
        scan = world.sweep(number)
        message, ready = cloud(scan), scan.stamp + 150_000_000
        begun = time.process_time()
        while row < len(samples.stamps) and samples.stamps[row] <= ready:
            live.add_imu(sample(samples, row))
            row += 1
        live.add_cloud(message)
        while (result := live.step()) is not None:
            not_solved += not result.update.status.solved
        milliseconds.append(1e3 * (time.process_time() - begun))
        if number % EVERY == EVERY - 1:
            rows.append((number, *_state(live, milliseconds), not_solved))
            milliseconds.clear()
            if time.monotonic() > end:
                break
    print(live.report())
    return rows


def _state(live: LiveMapper, milliseconds: list[float]) -> tuple[float, ...]:
    pipeline = live.pipeline
    maps, imu, loops = pipeline.mapper.maps, pipeline.mapper.imu, pipeline.loops
    assert imu is not None
    points = sum(m.stats.points + m.stats.archived_points for m in (maps.edges, maps.planes))
    graph = 0, 0, 0
    if loops is not None:
        graph = len(loops.graph), len(loops.graph.loops), len(loops.graph.forgotten)
    times = float(np.median(milliseconds)), max(milliseconds)
    return memory()[0], *times, points, len(imu.buffer), *graph


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0, help="on the wall, at most")
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--loops", action="store_true")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks/results")
    options = parser.parse_args()
    rows = measure(options.frames, options.minutes, loops=options.loops)
    name = "live_hours_loops.csv" if options.loops else "live_hours.csv"
    options.output.mkdir(parents=True, exist_ok=True)
    write_csv(options.output / name, COLUMNS, rows)
    table = np.array(rows)
    late = table[len(table) // 5 :]
    for column in ("process_mb", "cpu_ms", "map_points", "keyframes"):
        values = late[:, COLUMNS.index(column)]
        slope = 36_000 * float(np.polyfit(late[:, 0], values, 1)[0]) if len(late) > 1 else 0.0
        print(f"{column}: {values[0]:.1f} to {values[-1]:.1f}, {slope:+.2f} per hour at 10 Hz")


if __name__ == "__main__":
    main()
