"""Are refined runs better, and are their covariances right? ``python -m benchmarks.refining``.

Each world of :mod:`benchmarks.worlds` is run without an IMU, by any mount of the lidar, and
refined. ``--micrometre`` tells chance from gain: the whole corridor, twice, the second time with a
micrometre of noise more in its ranges. ``--recorded`` takes real sweeps, ``--growth`` long drives.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from itertools import groupby
from pathlib import Path

import gtsam
import numpy as np

from benchmarks import recorded, worlds
from benchmarks.cases import ROOT, data_folder
from benchmarks.process import processor_clock
from benchmarks.refining_growth import DRIVES, SIZES, measure_growth
from benchmarks.tables import markdown_table, write_rows
from benchmarks.worlds import GROUPS, MODES, WINDOWS, World
from loam_gtsam.datasets import Dataset
from loam_gtsam.geometry import transform
from loam_gtsam.pipeline import run
from loam_gtsam.refine.map_quality import common_thickness, map_quality
from loam_gtsam.refine.runs import RefinedRun, refine_run, run_points
from loam_gtsam.refine.sweeps import Path as Way
from loam_gtsam.studies.evaluation import FREEDOM, absolute_error, align_rotations
from loam_gtsam.types import FloatArray, InputError, LoamError, Trajectory

_GROUPS = ("worlds", "degenerate")


@dataclass(frozen=True, slots=True)
class HandHeld(World):
    """De-skewed sweeps of a lidar that was carried through a building, without truth."""

    def open(self, seed: int, imu: str | None) -> Dataset:
        """All sweeps; no seed changes them."""
        return recorded.hand_held(data_folder() / self.scene)

    def steps(self) -> recorded.GivenSteps:
        """By which the sweeps are predicted."""
        return recorded.GivenSteps(recorded.given_poses(data_folder() / self.scene))


RECORDED = (
    World("KITTI", "kitti_2011_09_26_0002", recorded=True),
    HandHeld("OS0-64, hand-held", "hilti_os0_64", recorded=True),
)
MICROMETRE = (
    World("corridor, whole", "corridor"),
    World("and 1 um of noise", "corridor", {"range_noise": 0.020001}),
)
"""The same noise but for a factor: of 2 cm, and of a micrometre more."""


@dataclass(frozen=True, slots=True)
class Row:
    """One run, and what became of it.

    Attributes
    ----------
    run_mm, refined_mm, ratio : ATE, aligned, and the second over the first
    nees_1, nees_10, nees_50 : over six freedoms, of refined motions over so many frames
    broken : covariances of these motions that are not positive definite
    not_whole : frames of which the run did not see all directions
    planes, thick_mm, thin_mm : on points that took no part: voxels that are planes before and
        after, their thickness before and after
    given_mm, beside_mm : the same with poses that come with the data, and with the refined ones
    run_s, refine_s : processor time
    problem : why there is no result
    """

    world: str
    seed: int
    frames: int = 0
    run_mm: float = np.nan
    refined_mm: float = np.nan
    ratio: float = np.nan
    nees_1: float = np.nan
    nees_10: float = np.nan
    nees_50: float = np.nan
    broken: int = 0
    not_whole: int = 0
    planes: int = 0
    thick_mm: float = np.nan
    thin_mm: float = np.nan
    given_mm: float = np.nan
    beside_mm: float = np.nan
    run_s: float = np.nan
    refine_s: float = np.nan
    problem: str = ""


def measure(world: World, seed: int) -> Row:
    """Run a world, refine it, and hold both against the truth and the points held out."""
    row = Row(world.name, seed)
    try:
        dataset = world.open(seed, None)
        with processor_clock():
            steps = world.steps() if isinstance(world, HandHeld) else None
            result = run(dataset, MODES[0].config, odometry=steps)
        points = run_points(dataset, result.updates, result.config)
        began = time.process_time()
        found = refine_run(points, result.updates)
        seconds = time.process_time() - began
    except LoamError as error:
        return replace(row, problem=f"{type(error).__name__}: {error}")
    own = [t for update in result.updates for name, t in update.timings.items() if name != "read"]
    before, after = (map_quality(*found.held_out(refined=on)) for on in (False, True))
    thick, thin, planes = common_thickness(before, after)
    row = replace(
        row, frames=len(result.updates), not_whole=int((~found.seen).sum()), planes=planes,
        thick_mm=1e3 * thick, thin_mm=1e3 * thin, run_s=sum(own), refine_s=seconds,
    )  # fmt: skip
    if world.recorded:
        beside = map_quality(*_moved(found, _given(world, dataset)).held_out(refined=False))
        given, ours, _ = common_thickness(beside, after)
        row = replace(row, given_mm=1e3 * given, beside_mm=1e3 * ours)
    if dataset.truth is None:
        return row
    errors = [absolute_error(way, dataset.truth).rmse
              for way in (result.trajectory, found.trajectory)]  # fmt: skip
    squared = [squared_errors(found, dataset.truth, window) for window in WINDOWS]
    nees = [float(s[np.isfinite(s)].mean()) / FREEDOM if len(s) else np.nan for s in squared]
    return replace(
        row, run_mm=1e3 * errors[0], refined_mm=1e3 * errors[1], ratio=errors[1] / errors[0],
        nees_1=nees[0], nees_10=nees[1], nees_50=nees[2],
        broken=sum(int(np.isinf(s).sum()) for s in squared),
    )  # fmt: skip


def squared_errors(found: RefinedRun, truth: Trajectory, window: int) -> FloatArray:
    """Squared Mahalanobis distances of refined motions over so many frames.

    Infinite where the covariance is not positive definite; motions of which there is none, as of
    frames that were not solved, are left out.
    """
    ours = found.trajectory
    inside = np.flatnonzero((ours.stamps >= truth.stamps[0]) & (ours.stamps <= truth.stamps[-1]))
    exact = truth.at(ours.stamps[inside])
    poses = [gtsam.Pose3(pose) for pose in ours.map_T_lidar[inside]]
    true = [gtsam.Pose3(pose) for pose in exact.map_T_lidar]
    squared = []
    for k, (first, last) in enumerate(zip(inside, inside[window:], strict=False)):
        moved = poses[k].between(poses[k + window])
        error = moved.localCoordinates(true[k].between(true[k + window]))
        try:
            root = np.linalg.cholesky(found.relative_covariance(int(first), int(last)))
        except InputError:
            continue
        except np.linalg.LinAlgError:
            squared.append(np.inf)
            continue
        squared.append(float((np.linalg.solve(root, error) ** 2).sum()))
    return np.array(squared)


def _given(world: World, dataset: Dataset) -> Trajectory:
    if dataset.truth is not None:
        return dataset.truth
    return recorded.given_poses(data_folder() / world.scene)


def _moved(found: RefinedRun, given: Trajectory) -> RefinedRun:
    """With other poses for those before, moved to lie as nearly as they can on the refined ones."""
    ours = found.refined.path.map_T_middle
    stamps = np.array([sweep.stamp for sweep in found.points.held], np.int64)
    inside = np.clip(stamps, given.stamps[0], given.stamps[-1])
    poses = given.at(inside).map_T_lidar
    move = np.eye(4)
    move[:3, :3] = align_rotations(poses[:, :3, :3], ours[:, :3, :3])
    move[:3, 3] = (ours[:, :3, 3] - transform(move, poses[:, :3, 3])).mean(axis=0)
    return replace(found, before=Way.through(stamps, move @ poses))


def summary(rows: Iterable[Row]) -> str:
    """All seeds of a world in a line: ATE and ratios as geometric means; a last line of all."""
    titles = ("world", "seeds", "run mm", "refined mm", "ratio", "worst",
              *(f"NEES/6 {window}" for window in WINDOWS), "broken", "not whole",
              "planes mm, run", "refined", "refining s")  # fmt: skip
    cells, ratios, worst = [], [], []
    for name, group in groupby(rows, lambda row: row.world):
        some = [row for row in group if not row.problem]
        if not some:
            continue
        table = {item.name: np.array([getattr(row, item.name) for row in some])
                 for item in fields(Row) if item.name not in ("world", "problem")}  # fmt: skip
        run_mm, refined_mm, ratio = (
            float(np.exp(np.log(table[key]).mean())) for key in ("run_mm", "refined_mm", "ratio")
        )
        ratios.append(ratio)
        worst.append(float(table["ratio"].max()))
        means = {key: float(values.mean()) for key, values in table.items()}
        cells.append([
            name, len(some), f"{run_mm:.1f}", f"{refined_mm:.1f}", f"{ratio:.2f}",
            f"{worst[-1]:.2f}", *(f"{means[f'nees_{window}']:.2g}" for window in WINDOWS),
            table["broken"].sum(), f"{means['not_whole']:.0f}/{means['frames']:.0f}",
            f"{means['thick_mm']:.2f}", f"{means['thin_mm']:.2f}", f"{means['refine_s']:.0f}",
        ])  # fmt: skip
    known = np.array([ratio for ratio in ratios if np.isfinite(ratio)])
    lines = [*markdown_table(titles, cells)]
    if len(known):
        mean = float(np.exp(np.log(known).mean()))
        lines += ["", f"Refined over run: geometric mean {mean:.3f}, worst {np.nanmax(worst):.2f}."]
    return "\n".join(lines)


def spread(rows: Sequence[Row]) -> str:
    """What chance makes of one drive: the refined ATE with a micrometre more, and without."""
    every = {(row.world, row.seed): row for row in rows if not row.problem}
    plain, noisy = (world.name for world in MICROMETRE)
    pairs = [
        (every[plain, seed], every[noisy, seed])
        for name, seed in every
        if name == plain and (noisy, seed) in every
    ]
    lines = [
        f"seed {a.seed}: run {a.run_mm:.1f} and {b.run_mm:.1f} mm, "
        f"refined {a.refined_mm:.1f} and {b.refined_mm:.1f} mm"
        for a, b in pairs
    ]
    for name in ("run_mm", "refined_mm"):
        apart = [getattr(a, name) - getattr(b, name) for a, b in pairs]
        sigma = float(np.sqrt(np.mean(np.square(apart)) / 2.0)) if pairs else np.nan
        lines.append(f"{name}: standard deviation by chance {sigma:.2f} mm")
    return "\n".join(lines)


def _rows(jobs: Sequence[tuple[World, int]], workers: int) -> Iterator[Row]:
    if workers < 2:
        yield from (measure(*job) for job in jobs)
        return
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(measure, *zip(*jobs, strict=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; 1 if a run or its refining ended early."""
    built_in = [(group, world) for group in _GROUPS for world in GROUPS[group]]
    named = [*_GROUPS, *(world.name for _, world in built_in)]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.refining", description=__doc__)
    parser.add_argument("--worlds", nargs="+", metavar="WORLD", choices=named, default=_GROUPS,
                        help=f"worlds or groups of them: {', '.join(named)}")  # fmt: skip
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--quick", action="store_true", help="a few coarse sweeps")
    what.add_argument("--micrometre", action="store_true", help="how much of a figure is chance")
    what.add_argument("--recorded", action="store_true", help="real sweeps")
    what.add_argument("--growth", action="store_true", help="time and memory of long drives")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="sweeps, for --growth")
    parser.add_argument("--drives", nargs="+", choices=DRIVES, default=list(DRIVES),
                        help="for --growth")  # fmt: skip
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "results")
    options = parser.parse_args(arguments)
    if options.growth:
        drives = [DRIVES[name] for name in options.drives]
        for size in measure_growth(drives, options.sizes, options.output / "refining_growth.csv"):
            print(size)
        return 0
    file, seeds = "refining.csv", range(options.first_seed, options.first_seed + options.seeds)
    chosen = tuple(world for group, world in built_in if {group, world.name} & set(options.worlds))
    if options.quick:
        chosen = worlds.QUICK
    elif options.micrometre:
        file, chosen = "refining_micrometre.csv", MICROMETRE
    elif options.recorded:
        file, seeds = "refining_recorded.csv", range(1)
        chosen = tuple(world for world in RECORDED if (data_folder() / world.scene).is_dir())
    rows: list[Row] = []
    for row in _rows([(world, seed) for world in chosen for seed in seeds], options.workers):
        rows.append(row)
        write_rows(options.output / file, rows)  # kept, should the next one be stopped
        print(row, flush=True)
    print(summary(rows))
    if options.micrometre:
        print(spread(rows))
    return int(any(row.problem for row in rows))


if __name__ == "__main__":
    sys.exit(main())
