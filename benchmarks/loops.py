"""How many loops are found, are they right, what do they bring? ``python -m benchmarks.loops``.

One kilometre round a street block, driven once for each seed; then the odometry is made to drift by
a share of the way, and loops are looked for. With ``--city PATH``, a file of poses as KITTI's
odometry benchmark has them, a town is laid out around that way and mapped with ``loops.enabled``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.tables import write_rows
from loam_gtsam.config import Config
from loam_gtsam.datasets import SimulatedWorld, build_city
from loam_gtsam.frontend.workers import extract
from loam_gtsam.loops.closure import ScanLoopCloser
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.mapper import Mapper
from loam_gtsam.pipeline import effective_config, run
from loam_gtsam.studies.evaluation import absolute_error, distance_travelled
from loam_gtsam.types import Features, FloatArray, MapUpdate, Scan, Trajectory, stack_poses

DRIFTS = (0.0, 0.005, 0.01, 0.02)
"""Shares of the way."""
YAW_DRIFT = np.radians(0.6)
"""rad a metre for a drift of 1."""
NEAR = 5.0
"""Metres within which a place is the same."""
RIGHT = (0.5, np.radians(3.0))
"""Metres and rad by which a right loop may be off."""
FALSE_LOOPS = 50
_WITHOUT_IMU = Config().changed("imu.coupling=off")
_RESULTS = Path("benchmarks/results/loops")


@dataclass(frozen=True, slots=True)
class Row:
    """One drive with one drift.

    Attributes
    ----------
    drift : share of the way
    keyframes, revisits : and those of them that have an old one within 5 m
    closed : revisits with a loop that is used
    loops, wrong : loops used, and those off by more than 0.5 m or 3 degrees
    ate_before, ate_after, ate_attacked : metres, over the keyframes; the last one with 50 false
        loops between the right ones
    overhead : time of graph and loops over that of the mapping
    """

    seed: int
    drift: float
    keyframes: int
    revisits: int
    closed: int
    loops: int
    wrong: int
    ate_before: float
    ate_after: float
    ate_attacked: float
    overhead: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.loops", description=__doc__)
    parser.add_argument(
        "--quick",
        action="store_true",
        help="one drive that is too short for a loop",
    )
    parser.add_argument("--seeds", type=int, default=20, help="drives")
    parser.add_argument("--city", type=Path, help="poses of a way, 12 numbers a line")
    parser.add_argument("--output", type=Path, default=_RESULTS, help="folder for the tables")
    options = parser.parse_args(arguments)
    if options.city is not None:
        for line in city(options.city):
            print(line, flush=True)
        return 0
    metres, columns = (150.0, 400) if options.quick else (1000.0, 600)
    seeds = range(1 if options.quick else options.seeds)
    with ProcessPoolExecutor(None, get_context("spawn")) as pool:
        drifts = DRIFTS[-1:] if options.quick else DRIFTS
        job = partial(drive, metres=metres, columns=columns, drifts=drifts)
        rows = [row for part in pool.map(job, seeds) for row in part]
    write_rows(options.output / "loops.csv", rows, digits=6)
    print("\n".join(table(rows)))
    return 0


def drive(seed: int, metres: float, columns: int, drifts: Sequence[float]) -> list[Row]:
    """Map a way round the block once, and look for loops with every drift."""
    world = SimulatedWorld(
        "street_loop", seed=seed, columns=columns, speed=20.0, frames=int(metres / 1.7) + 100
    )
    config = effective_config(_WITHOUT_IMU, world)
    mapper, frames = Mapper(config), []
    made = 0.0
    for sweep in _until(world, metres):
        begun = time.perf_counter()
        extraction = extract(sweep, config)
        assert extraction.features is not None
        frames.append((mapper.register(extraction.features), extraction.features))
        made += time.perf_counter() - begun
    truth = world.truth.map_T_lidar
    return [_closed(seed, drift, frames, truth, config, made) for drift in drifts]


def _closed(
    seed: int,
    drift: float,
    frames: Sequence[tuple[MapUpdate, Features]],
    truth: FloatArray,
    config: Config,
    mapping: float,
) -> Row:
    updates = drifted([update for update, _ in frames], drift, seed)
    graph, closer = PoseGraph(config), ScanLoopCloser(config)
    numbers: list[int] = []
    started = time.perf_counter()
    for number, (update, (_, features)) in enumerate(zip(updates, frames, strict=True)):
        keyframe = graph.add(update, features)
        if keyframe is None:
            continue
        numbers.append(number)
        loop = closer.detect(keyframe, graph)
        if loop is not None:
            graph.add_loop(loop)
    seconds = time.perf_counter() - started
    poses = [gtsam.Pose3(truth[number]) for number in numbers]
    used = [loop for loop, on in zip(graph.loops, graph.active, strict=True) if on]
    wrong = sum(_is_wrong(loop, poses) for loop in used)
    way = np.array([keyframe.travelled for keyframe in graph.keyframes])
    places = np.array([pose.translation() for pose in poses])
    revisits = [
        bool((np.linalg.norm(places[old] - places[k], axis=1) <= NEAR).any())
        for k, old in ((k, way[k] - way >= config.loops.min_way) for k in range(len(way)))
    ]
    ends = {loop.later for loop in used}
    before = stack_poses(keyframe.odom_T_lidar for keyframe in graph.keyframes)
    after = _ate(graph.poses(), truth[numbers])
    rng = np.random.default_rng([seed, 1])
    for loop in false_loops(len(graph), FALSE_LOOPS, rng):
        graph.add_loop(loop)
    return Row(
        seed=seed,
        drift=drift,
        keyframes=len(graph),
        revisits=sum(revisits),
        closed=sum(revisits[later] for later in ends),
        loops=len(used),
        wrong=wrong,
        ate_before=_ate(before, truth[numbers]),
        ate_after=after,
        ate_attacked=_ate(graph.poses(), truth[numbers]),
        overhead=seconds / mapping,
    )


def drifted(updates: Sequence[MapUpdate], drift: float, seed: int) -> list[MapUpdate]:
    """The same frames with an odometry that goes astray by a share of the way.

    To one side, the same all the time, and in heading.
    """
    rng = np.random.default_rng([seed, 2])
    side = rng.normal(size=3) * (1.0, 1.0, 0.3)
    side *= drift / np.linalg.norm(side)
    out, last, odometry = [], updates[0].map_T_lidar, updates[0].map_T_lidar
    for update in updates:
        step = last.between(update.map_T_lidar)
        way = float(np.linalg.norm(step.translation()))
        astray = gtsam.Pose3(gtsam.Rot3.Yaw(YAW_DRIFT * drift * way), way * side)
        odometry = odometry.compose(step).compose(astray)
        last = update.map_T_lidar
        out.append(replace(update, map_T_lidar=odometry))
    return out


def false_loops(size: int, count: int, rng: np.random.Generator) -> list[LoopClosure]:
    """Loops between any two keyframes, a few metres off and turned anyhow."""
    covariance = np.diag(np.repeat([0.002, 0.02], 3) ** 2)
    made: list[LoopClosure] = []
    while len(made) < count:
        one, two = sorted(rng.choice(size, 2, replace=False).tolist())
        if two - one > 1:
            where = gtsam.Pose3(gtsam.Rot3.Yaw(rng.uniform(-3, 3)), rng.normal(0.0, 2.0, 3))
            made.append(LoopClosure(one, two, where, covariance))
    return made


def table(rows: Sequence[Row]) -> Iterator[str]:
    """The rows by drift, as Markdown."""
    yield "| drift | drives | recall | loops, wrong | ATE before [m] | after | with false loops |"
    yield "|---|---|---|---|---|---|---|"
    for drift in sorted({row.drift for row in rows}):
        part = [row for row in rows if row.drift == drift]
        closed, revisits = sum(row.closed for row in part), sum(row.revisits for row in part)
        change = max(abs(row.ate_attacked / row.ate_after - 1.0) for row in part)
        means = [
            float(np.mean([getattr(row, name) for row in part]))
            for name in ("ate_before", "ate_after", "ate_attacked")
        ]
        yield (
            f"| {100 * drift:g} % | {len(part)} | {closed} of {revisits} "
            f"({100 * closed / max(revisits, 1):.0f} %) | {sum(row.loops for row in part)}, "
            f"{sum(row.wrong for row in part)} | {means[0]:.3f} | {means[1]:.3f} | "
            f"{means[2]:.3f}, at most {100 * change:.2f} % |"
        )
    shares = [row.overhead for row in rows]
    yield f"\nGraph and loops take {100 * float(np.median(shares)):.0f} % of the mapping's time."


def city(path: Path) -> Iterator[str]:
    """Map a town around a recorded way, with loops and without; lines of a report."""
    poses = np.loadtxt(path).reshape(-1, 3, 4)[:, :, 3]
    # KITTI's camera: x right, y down, z forward.
    scene = build_city(np.column_stack([poses[:, 2], -poses[:, 0]]))
    world = SimulatedWorld(scene, columns=600, speed=14.0)
    for enabled in (True, False):
        config = _WITHOUT_IMU.changed({"loops.enabled": enabled})
        result = run(world, config, workers=1)
        error = absolute_error(result.trajectory, world.truth)
        length = world.truth.path_length
        seconds = {
            name: sum(update.timings.get(name, 0.0) for update in result.updates)
            for name in ("prepare", "match", "solve", "insert", "covariance", "features", "loops")
        }
        loops = seconds.pop("loops")
        yield f"loops {'on' if enabled else 'off'}: {len(result.updates)} sweeps, {length:.0f} m"
        share = 100.0 * error.rmse / length
        yield f"  ATE {error.rmse:.3f} m ({share:.4f} %), at most {error.maximum:.3f} m"
        yield f"  {result.status_counts}"
        if result.loops is not None:
            before = absolute_error(result.odometry, world.truth).rmse
            yield f"  odometry {before:.3f} m; {result.loops.counts()}"
            yield f"  graph and loops take {100 * loops / sum(seconds.values()):.0f} % of the rest"


def _until(world: SimulatedWorld, metres: float) -> Iterator[Scan]:
    """The sweeps of the first so many metres."""
    driven = distance_travelled(world.truth.positions)
    count = int(np.searchsorted(driven[1:], metres)) + 1
    for number in range(min(count, len(world))):
        yield world[number]


def _is_wrong(loop: LoopClosure, poses: Sequence[gtsam.Pose3]) -> bool:
    true = poses[loop.earlier].between(poses[loop.later])
    off = true.localCoordinates(loop.earlier_T_later)
    return bool(np.linalg.norm(off[3:]) > RIGHT[0] or np.linalg.norm(off[:3]) > RIGHT[1])


def _ate(poses: FloatArray, truth: FloatArray) -> float:
    stamps = np.arange(len(poses), dtype=np.int64)
    return absolute_error(Trajectory(stamps, poses), Trajectory(stamps, truth)).rmse


if __name__ == "__main__":
    sys.exit(main())
