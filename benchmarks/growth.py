"""Whether time and memory grow with the length of a run: ``python -m benchmarks.growth``.

Two drives through the built-in world: round and round a block (``street_loop``, 3,000 sweeps), and
10 km over ground that is always new (``avenue``). Each is mapped in a process of its own, with its
IMU, as ``loam-gtsam run`` does it. Besides, the mapping stage is held against what the C++ systems
recorded on the same sweeps. Tables and curves are CSV files.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, fields, is_dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks import recorded
from benchmarks.cases import ROOT, data_folder
from benchmarks.growth_report import GrowthResult, size_table, time_table, write
from benchmarks.process import memory, processor_clock
from benchmarks.report import show, write_tables
from loam_gtsam.config import Config, MapConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.datasets.sim.world import build_avenue
from loam_gtsam.pipeline import Pipeline, effective_config, imu_buffer
from loam_gtsam.studies.evaluation import absolute_error, distance_travelled
from loam_gtsam.types import FloatArray, MapUpdate, Trajectory

STAGES = ("features", "odometry", "prepare", "match", "solve", "insert", "covariance")
COLUMNS = (
    "distance_m", "cpu_ms", "make_ms", "wall_ms", *(f"{stage}_ms" for stage in STAGES),
    "window_cubes", "window_points", "near_points", "archived_points", "process_mb",
)  # fmt: skip
"""Of a frame: metres driven; processor time of the whole pipeline, of making the sweep, and time on
the wall of the pipeline; processor time by stage; cubes and points in the window of both maps,
points that are matched against, points in the archive; resident memory of the process."""
_SPARE = 60.0
"""Metres of road beyond the last pose."""
_LEAST = {"frames": 10, "kilometres": 0.1}
"""Of a drive, which is judged by its tenths."""


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive through the built-in world.

    Attributes
    ----------
    scene : closed, or ``avenue``, which is as long as needed
    frames, kilometres : of which one is given: how far
    columns : firings a sweep; None is the sensor's own
    map : the cube map's configuration
    """

    scene: str
    frames: int = 0
    kilometres: float = 0.0
    columns: int | None = None
    map: MapConfig = field(default_factory=MapConfig)

    def open(self) -> SimulatedWorld:
        """The world, with as many sweeps as needed."""
        if self.scene != "avenue":
            return SimulatedWorld(self.scene, frames=self.frames, columns=self.columns)
        # A sweep at 10 m/s is one metre.
        scene = build_avenue(0, max(1e3 * self.kilometres, 1.2 * self.frames) + _SPARE)
        frames = self.frames
        if not frames:
            driven = distance_travelled(SimulatedWorld(scene).truth.positions)
            frames = int(np.searchsorted(driven, 1e3 * self.kilometres)) + 1
        return SimulatedWorld(scene, frames=frames, columns=self.columns)


DRIVES = (Drive("street_loop", frames=3000), Drive("avenue", kilometres=10.0))
# Small cubes and a narrow window, so that a drive of some metres leaves cubes behind.
_NARROW = MapConfig(cube_size=4.0, window=(9, 9, 9), window_margin=1, neighbourhood=(7, 7, 7))
QUICK = (
    Drive("street_loop", frames=20, columns=450, map=_NARROW),
    Drive("avenue", frames=50, columns=450, map=_NARROW),
)


def measure(drive: Drive) -> GrowthResult:
    """Map the sweeps of a drive one by one, as ``run`` does, and look at the process in between."""
    world = drive.open()
    config = effective_config(Config().changed(map=drive.map), world)
    pipeline = Pipeline(config, imu=imu_buffer(world, config))
    driven = distance_travelled(world.truth.positions)
    updates: list[MapUpdate] = []
    rows = np.full((len(world), len(COLUMNS)), np.nan)
    with processor_clock():
        for number in range(len(world)):
            begun = time.process_time()
            sweep = world.sweep(number)
            made, wall = time.process_time(), time.monotonic()
            update = pipeline.process(sweep)
            done, wall = time.process_time(), time.monotonic() - wall
            updates.append(update)
            rows[number] = (
                driven[number],
                *(1e3 * seconds for seconds in (done - made, made - begun, wall)),
                *(1e3 * update.timings.get(stage, 0.0) for stage in STAGES),
                *_map_size(pipeline, update),
                memory()[0],
            )
    while_mapping = memory()[1]
    maps = pipeline.mapper.maps.edges, pipeline.mapper.maps.planes
    whole = pipeline.mapper.map_points()
    stamps, poses = zip(*((update.stamp, update.map_T_lidar) for update in updates), strict=True)
    found = Trajectory.from_poses(stamps, poses)
    return GrowthResult(
        name=drive.scene,
        columns=dict(zip(COLUMNS, rows.T, strict=True)),
        path=float(driven[-1]),
        ate=absolute_error(found, world.truth).rmse,
        statuses=dict(Counter(str(update.status) for update in updates)),
        map_points=(len(whole[0]), len(whole[1])),
        evicted=sum(cubes.stats.evicted for cubes in maps),
        dropped=sum(cubes.stats.dropped_cubes for cubes in maps),
        report_kb=1e-3 * _bytes(updates[-1]),
        peak_mb=while_mapping,
        peak_with_map_mb=memory()[1],
    )


def _map_size(pipeline: Pipeline, update: MapUpdate) -> tuple[int, int, int, int]:
    """Cubes and points in the window, points around the sensor, points in the archive."""
    maps = pipeline.mapper.maps.edges, pipeline.mapper.maps.planes
    stats = [cubes.stats for cubes in maps]
    pose = update.map_T_lidar.matrix()
    return (
        sum(each.cubes for each in stats),
        sum(each.points for each in stats),
        sum(_near(cubes, pose) for cubes in maps),
        sum(each.archived_points for each in stats),
    )


def _near(cubes: CubeMap, map_T_lidar: FloatArray) -> int:
    return cubes.count(cubes.neighbourhood(map_T_lidar))


def _bytes(value: object) -> int:
    """Of a report and what it holds, but for what is native (a pose)."""
    parts: list[object] = []
    if is_dataclass(value):
        parts = [getattr(value, item.name) for item in fields(value)]
    elif isinstance(value, Mapping):
        parts = list(value.values())
    return sys.getsizeof(value) + sum(map(_bytes, parts))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.growth", description=__doc__)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--quick", action="store_true", help="a few coarse sweeps of both drives")
    what.add_argument("--frames", type=int, help="only the laps, so many sweeps of them")
    what.add_argument("--kilometres", type=float, help="only the avenue, so much of it")
    parser.add_argument("--output", type=Path, help="folder for the results; docs/benchmarks, or "
                        "benchmarks/results if only a part is run")  # fmt: skip
    options = parser.parse_args(arguments)
    for name, least in _LEAST.items():
        asked = getattr(options, name)
        if asked is not None and not asked >= least:
            parser.error(f"--{name}: expected at least {least:g}, got {asked:g}")
    drives: tuple[Drive, ...] = DRIVES
    part = True
    if options.quick:
        drives = QUICK
    elif options.frames is not None:
        drives = (replace(DRIVES[0], frames=options.frames),)
    elif options.kilometres is not None:
        drives = (replace(DRIVES[1], kilometres=options.kilometres),)
    else:
        part = False
    folder = options.output or ROOT / ("benchmarks/results" if part else "docs/benchmarks")
    results, paths = [], []
    for drive in drives:
        print(f"{drive.scene} ...", flush=True)
        # Its own process, started afresh: the memory of one drive is not that of the other.
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            results.append(pool.submit(measure, drive).result())
        paths += write(folder, results[-1])  # kept, should the next one be stopped
    tables = [time_table(results), size_table(results)]
    if not options.quick:
        tables.append(recorded.table(recorded.measure_all(data_folder())))
    show(Console(width=200), tables)
    paths += write_tables(folder, tables)
    print(f"Written: {', '.join(map(str, paths))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
