"""How right are maps that were joined? ``python -m benchmarks.merging``.

Each world is driven once as a whole, and in parts that overlap; the parts are mapped apart, saved
and merged from their files. With ``--changed`` every other part is another drive: with other noise,
and in a world of which a share of the objects is gone or moved. With ``--refine`` the parts are
then adjusted together.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.localisation import with_changes
from benchmarks.tables import write_rows
from loam_gtsam.datasets.base import Dataset, PartOf
from loam_gtsam.datasets.sim.scenes import BUILDERS
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.maps import MergedMaps, SavedMap, merge_maps, save_map
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.refine.runs import refine_runs, run_points
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import Trajectory

_RESULTS = Path("benchmarks/results/merging")


@dataclass(frozen=True, slots=True)
class Row:
    """A world, and what became of its parts.

    Attributes
    ----------
    parts, overlap : number of parts, and metres that two of them have in common, on average
    alone_mm : largest ATE of a part
    merged_mm, whole_mm, ratio : ATE of all parts in one frame, of one drive, and their quotient
    nees : over six freedoms of the places of the last part, in the frame of the first
    loops, unused : between the maps
    seconds : that merging took
    refined_mm, refined_nees, refined_s : the same of the parts adjusted together, the NEES over all
        poses of the last part; NaN without ``--refine``
    """

    world: str
    seed: int
    parts: int
    overlap: float
    alone_mm: float
    merged_mm: float
    whole_mm: float
    ratio: float
    nees: float
    loops: int
    unused: int
    seconds: float
    refined_mm: float
    refined_nees: float
    refined_s: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.merging", description=__doc__)
    parser.add_argument("worlds", nargs="*", default=("street_loop", "avenue"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2], help="of the worlds")
    parser.add_argument("--parts", type=int, default=2, help="of a drive")
    parser.add_argument("--overlap", type=int, default=90, help="sweeps of two parts in common")
    parser.add_argument("--changed", type=float, help="share of the objects, for every other part")
    parser.add_argument("--refine", action="store_true", help="adjust the parts together")
    parser.add_argument("--output", type=Path, default=_RESULTS, help="folder for the table")
    options = parser.parse_args(arguments)
    rows = []
    for world in options.worlds:
        for seed in options.seeds:
            parts = options.parts, options.overlap, options.changed
            rows.append(measure(world, seed, *parts, refine=options.refine))
            print(rows[-1], flush=True)
    write_rows(options.output / "merging.csv", rows)
    return 0


def measure(
    name: str, seed: int, parts: int, overlap: int, changed: float | None, *, refine: bool = False
) -> Row:
    """Map a world as a whole and in parts, and merge these."""
    world = SimulatedWorld(name, seed=seed)
    other = world
    if changed is not None:
        other = SimulatedWorld(with_changes(BUILDERS[name](seed), changed, seed), seed=seed + 100)
    length = -(-(len(world) + (parts - 1) * overlap) // parts)
    starts = [number * (length - overlap) for number in range(parts)]
    drives = [(world, other)[number % 2] for number in range(parts)]
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{number}.lgmap" for number in range(parts)]
        pieces, runs = [PartOf(d, n, 1) for d, n in zip(drives, starts, strict=True)], []
        for file, piece in zip(files, pieces, strict=True):
            runs.append(run(piece, max_frames=length))
            pipeline = runs[-1].pipeline
            assert pipeline is not None
            save_map(file, pipeline)
        maps = [SavedMap(file) for file in files]
        started = time.perf_counter()
        merged = merge_maps(maps, Path(folder) / "all.lgmap")
        seconds = time.perf_counter() - started
        for opened in maps:
            opened.close()
    whole = run(world)
    ways = [merged.trajectory(number, done.updates) for number, done in enumerate(runs)]
    way = _joined(ways)
    alone = [absolute_error(done.trajectory, world.truth).rmse for done in runs]
    errors = [absolute_error(found, world.truth).rmse for found in (way, whole.trajectory)]
    refined = _refined(world, pieces, runs, merged, ways) if refine else (np.nan,) * 3
    return Row(
        name, seed, parts, overlap * world.truth.path_length / len(world), 1e3 * max(alone),
        1e3 * errors[0], 1e3 * errors[1], errors[0] / errors[1], _nees(world, runs, merged),
        sum(merged.ties.values()), merged.unused, seconds, *refined,
    )  # fmt: skip


def _refined(
    world: SimulatedWorld, pieces: Sequence[Dataset], runs: Sequence[RunResult],
    merged: MergedMaps, ways: Sequence[Trajectory],
) -> tuple[float, float, float]:  # fmt: skip
    """Parts adjusted together: error in millimetres, NEES over six of the last part, seconds."""
    started = time.perf_counter()
    updates = [done.updates for done in runs]
    points = [run_points(piece, done.updates, done.config)
              for piece, done in zip(pieces, runs, strict=True)]  # fmt: skip
    graph = merged.graph.saved()
    found = refine_runs(points, updates, ways, graph=graph, starts=merged.starts)
    seconds = time.perf_counter() - started
    error = absolute_error(_joined([one.trajectory for one in found]), world.truth).rmse
    last, held = found[-1].trajectory, found[0].refined  # the middle of the first sweep is exact
    true = world.truth_at(np.append(held.sweeps[0].stamp, last.stamps)).map_T_lidar
    there = held.path.map_T_middle[0] @ inverse_pose(true[0]) @ true[1:]
    squared = []
    for pose, right, covariance in zip(last.map_T_lidar, there, found[-1].covariances, strict=True):
        off = gtsam.Pose3.Logmap(gtsam.Pose3(right).between(gtsam.Pose3(pose)))
        squared.append(off @ np.linalg.solve(covariance, off) / 6.0)
    return 1e3 * error, float(np.mean(squared)), seconds


def _joined(ways: Sequence[Trajectory]) -> Trajectory:
    """The poses of all ways, those of equal stamps of an earlier one."""
    stamps, rows = np.unique(np.concatenate([way.stamps for way in ways]), return_index=True)
    return Trajectory(stamps, np.concatenate([way.map_T_lidar for way in ways])[rows])


def _nees(world: SimulatedWorld, runs: Sequence[RunResult], merged: MergedMaps) -> float:
    began = runs[0].updates[0]
    true = world.truth_at(np.array([began.stamp], np.int64)).map_T_lidar[0]
    map_T_world = began.map_T_lidar.matrix() @ inverse_pose(true)
    middles = {update.stamp: update.middle_stamp for update in runs[-1].updates}
    found = []
    for place in merged.places(len(runs) - 1):
        stamp = np.array([middles[place.stamp]], np.int64)
        there = gtsam.Pose3(map_T_world @ world.truth_at(stamp).map_T_lidar[0])
        error = gtsam.Pose3.Logmap(place.map_T_middle.compose(there.inverse()))
        found.append(error @ np.linalg.solve(place.covariance, error) / 6.0)
    return float(np.mean(found))


if __name__ == "__main__":
    sys.exit(main())
