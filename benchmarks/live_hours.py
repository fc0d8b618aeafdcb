"""A day of a live run in one place: does anything grow? ``python -m benchmarks.live_hours``.

A lidar of 16 x 90 beams and an IMU go round a room once in half a minute, with a pause between two
laps, as messages that are handed to the live mapper one by one, as fast as it takes them. The laps
are cast once, and every sweep has noise of its own. ``live_hours.csv`` has the memory of the
process, the processor time of a frame and the size of all that is kept, every 2,000 frames.

``python -m benchmarks.live_hours [--minutes 90] [--frames 864000] [--loops]``
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np

from benchmarks.cases import ROOT
from benchmarks.process import memory
from benchmarks.tables import write_csv
from loam_gtsam.config import Config
from loam_gtsam.datasets.sim.inertial import ImuErrors
from loam_gtsam.datasets.sim.motion import Motion
from loam_gtsam.datasets.sim.raycast import cast_rays
from loam_gtsam.datasets.sim.scenes import BUILDERS
from loam_gtsam.datasets.sim.world import SENSORS
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.ros.live import LiveMapper
from loam_gtsam.studies.evaluation import FIVE_SIGMA, squared_errors
from loam_gtsam.types import FloatArray, FrameStatus, ImuSamples, MapUpdate, Scan

EVERY = 2_000
PERIOD, PERIODS = 30.0, 6
"""Seconds from one lap to the next, and laps after which the wander of the IMU repeats itself."""
COLUMNS = ("frame", "process_mb", "cpu_ms", "worst_ms", "map_points", "imu_samples", "keyframes",
           "loops", "forgotten", "not_solved", "worst_error_m", "worst_odom_m",
           "beyond")  # fmt: skip
"""Errors are those of poses in ``map``, which loops correct, and in ``odom``, which drifts on;
``beyond`` are frames ``ok`` that are off by more than five told standard deviations in ``odom``.
"""
_SPEED, _LAP = 0.6840360804642713, 20.0
"""m/s at which the lap takes this many seconds, a whole number of periods of the sway."""
_BRAKING = 3.0  # seconds
_COLUMNS, _RANGE_NOISE, _DROPOUT = 90, 0.02, 0.02
_EPOCH, _SWEEP, _SAMPLE = 1_700_000_000_000_000_000, 100_000_000, 5_000_000  # nanoseconds
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


def sample(stamp: int, samples: ImuSamples, row: int) -> Any:
    """A sample as ``sensor_msgs/Imu``."""
    assert samples.orientation is not None
    gyro, acceleration = samples.gyro[row], samples.acceleration[row]
    return SimpleNamespace(
        header=_header(stamp),
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


class Patrol(Motion):
    """Once round a room from rest to rest, and a pause, again and again."""

    def world_T_lidar(self, times: FloatArray) -> FloatArray:
        """(N, 4, 4) poses at ``times`` (N,) in seconds."""
        within = np.asarray(times, dtype=np.float64) % PERIOD
        left = np.clip((_LAP + 0.5 * _BRAKING - within) / _BRAKING, 0.0, 1.0)
        braked = _LAP - _BRAKING * left**4 * (left * left - 3.0 * left + 2.5)
        return super().world_T_lidar(np.where(left < 1.0, braked, within))


class Round:
    """Sweeps and IMU samples of :data:`PERIODS` laps, which follow each other without a seam."""

    def __init__(self) -> None:
        scene, imu = BUILDERS["room"](0), ImuErrors.of("mems", 0, {})
        motion, elevations = Patrol(scene, _SPEED), np.deg2rad(SENSORS["vlp16"][0])
        azimuths = np.pi - 2.0 * np.pi * np.arange(_COLUMNS) / _COLUMNS
        beams = np.stack(
            [np.outer(np.cos(azimuths), np.cos(elevations)),
             np.outer(np.sin(azimuths), np.cos(elevations)),
             np.tile(np.sin(elevations), (_COLUMNS, 1))]
        )  # fmt: skip
        self.lever = imu.lever
        self.frames = round(PERIODS * PERIOD * 10.0)
        self._rng = np.random.default_rng(0)
        self._sweeps = []
        for number in range(self.frames):
            times = 0.1 * (number + np.arange(_COLUMNS) / _COLUMNS)
            poses = motion.world_T_lidar(times)
            rays = np.einsum("cij,jcb->icb", poses[:, :3, :3], beams)
            ranges, _ = cast_rays(scene.solids, poses[:, :3, 3], rays, 100.0, times)
            column, ring = np.nonzero(np.isfinite(ranges))
            rays = beams[:, column, ring].T
            parts = (rays, "f4"), (ranges[column, ring], "f4"), (column, "i2"), (ring, "i2")
            self._sweeps.append([np.ascontiguousarray(part, kind) for part, kind in parts])
        poses = motion.world_T_lidar(np.arange(self.frames) * np.float64(0.1))
        self._truth = inverse_pose(poses[0]) @ poses
        stamps = np.arange(0, self.frames * _SWEEP, _SAMPLE)
        self._samples = imu.samples(motion, stamps, (stamps * 1e-9).astype(np.float64), 0)

    def sweep(self, number: int) -> Scan:
        """The sweep of that number, counted from the start of the run."""
        beams, ranges, column, ring = self._sweeps[number % self.frames]
        noisy = ranges + _RANGE_NOISE * self._rng.standard_normal(len(ranges))
        kept = self._rng.random(len(ranges)) > _DROPOUT
        points = (beams[kept] * noisy[kept, None]).astype(np.float32)
        times = column[kept] * (1e-9 * _SWEEP / _COLUMNS)
        rings = ring[kept].astype(np.int32)
        return Scan(points, _EPOCH + number * _SWEEP, times=times, rings=rings)

    def true(self, stamp: int) -> gtsam.Pose3:
        """Pose of the lidar, seen from its first sweep."""
        number = (stamp - _EPOCH) // _SWEEP
        return gtsam.Pose3(self._truth[number % self.frames])

    def sample(self, number: int) -> tuple[int, ImuSamples, int]:
        """Stamp of the sample of that number, and its row in a lap's."""
        return _EPOCH + number * _SAMPLE, self._samples, number % len(self._samples.stamps)


def measure(frames: int, minutes: float, *, loops: bool) -> Iterator[tuple[float, ...]]:
    """A row of :data:`COLUMNS` for every :data:`EVERY` frames, until one of the limits."""
    laps = Round()
    config = Config().changed({"imu.lidar_t_imu": laps.lever, "loops.enabled": loops})
    live = LiveMapper(config, imu=True)
    samples, end = 0, time.monotonic() + 60.0 * minutes
    milliseconds: list[float] = []
    updates: list[MapUpdate] = []
    not_solved, beyond, errors = 0, 0, np.zeros(2)
    for number in range(frames):
        scan = laps.sweep(number)
        message, ready = cloud(scan), scan.stamp + 150_000_000
        begun = time.process_time()
        while (sampled := laps.sample(samples))[0] <= ready:
            live.add_imu(sample(*sampled))
            samples += 1
        live.add_cloud(message)
        while (result := live.step()) is not None:
            updates.append(result.update)
        milliseconds.append(1e3 * (time.process_time() - begun))
        for update in updates[1:]:
            metres, squared = _errors(live, updates[0], update, laps.true(update.stamp))
            errors = np.maximum(errors, metres)
            not_solved += not update.status.solved
            beyond += update.status is FrameStatus.OK and squared > FIVE_SIGMA
        del updates[1:]
        if number % EVERY == EVERY - 1:
            yield (number, *_state(live, milliseconds), not_solved, *errors.tolist(), beyond)
            milliseconds.clear()
            errors = np.zeros(2)
            if time.monotonic() > end:
                break
    print(live.report())


def _errors(
    live: LiveMapper, first: MapUpdate, update: MapUpdate, true: gtsam.Pose3
) -> tuple[list[float], float]:
    """Metres off in ``map`` and in ``odom``; the latter squared, in told standard deviations."""
    loops, odom = live.pipeline.loops, update.map_T_lidar
    corrected = odom if loops is None else loops.map_T_odom.compose(odom)
    moved = [first.map_T_lidar.between(pose) for pose in (corrected, odom)]
    squared = squared_errors([first, update], [gtsam.Pose3(), true]).get(1, np.inf)
    return [true.range(pose) for pose in moved], squared


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
    parser.add_argument("--minutes", type=float, default=90.0, help="on the wall, at most")
    parser.add_argument("--frames", type=int, default=864_000)
    parser.add_argument("--loops", action="store_true")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks/results")
    options = parser.parse_args()
    rows = []
    name = "live_hours_loops.csv" if options.loops else "live_hours.csv"
    options.output.mkdir(parents=True, exist_ok=True)
    for row in measure(options.frames, options.minutes, loops=options.loops):
        rows.append(row)
        write_csv(options.output / name, COLUMNS, rows)
    table = np.array(rows)
    late = table[len(table) // 5 :]
    for column in ("process_mb", "cpu_ms", "map_points", "keyframes"):
        values = late[:, COLUMNS.index(column)]
        slope = 36_000 * float(np.polyfit(late[:, 0], values, 1)[0]) if len(late) > 1 else 0.0
        print(f"{column}: {values[0]:.1f} to {values[-1]:.1f}, {slope:+.2f} per hour at 10 Hz")


if __name__ == "__main__":
    main()
