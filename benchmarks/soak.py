"""Thousands of sweeps with every fault there is, again and again: ``python -m benchmarks.soak``.

Drives round and round a room and a block of the built-in world, or with ``--places`` through other
places once, whose sweeps, stamps and IMU samples are spoilt as :mod:`benchmarks.soak_faults` says.
No exception may leave the pipeline, its memory must not grow, the good frames must stay accurate,
no frame may be ``ok`` and off by more than five told standard deviations, and the report of the run
must count every fault that was injected, no more and no less; else the exit code is 1. Tables and
curves are CSV files.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from benchmarks.cases import ROOT, Verdict
from benchmarks.process import memory
from benchmarks.report import machine
from benchmarks.soak_faults import KINDS, Expected, FaultyDrive
from benchmarks.tables import write_csv
from loam_gtsam.config import Config
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.io.run_files import summarise
from loam_gtsam.pipeline import Pipeline, effective_config
from loam_gtsam.studies.evaluation import FIVE_SIGMA, absolute_error, squared_errors
from loam_gtsam.types import (
    BoolArray,
    FloatArray,
    FrameStatus,
    IntArray,
    MapUpdate,
    Trajectory,
    stack_poses,
)
from loam_gtsam.view.plots import available, plot_curves

FRAMES, QUICK = 10_000, 300
SCENES = {"room": 300, "street_loop": 450}
"""Firings a sweep: a sixth and a quarter of the sensor's own."""
PLACES = dict.fromkeys(
    ("park", "forest", "square", "rooms", "garage", "stairwell", "bridge"), 450
) | {"tunnel_pilasters": 1800}
"""Likewise, of places where a fault may cost more than its sweep: only exceptions, counts and what
is told are judged."""
_USABLE = "sixty points"
"""The fault that is left out there, since such a sweep may be good enough, or not."""
_FRAMES_OF_A_PLACE = 1_800
_LONGEST = {"stairwell": 540, "bridge": 250, "tunnel_pilasters": 290}
"""Sweeps until the way ends."""
_BOUNDED = "room"
"""The map of the block gets denser all the time, as noise fills further voxels."""
_ATE = 0.05
"""Metres."""
_GROWTH = 2.0
"""MB per 1,000 sweeps over the last four fifths of a run; the poses kept here are half of it."""
_JUDGED = 2_000
"""Sweeps from which on growth is judged."""
_ROWS = 500
"""Of the CSV at most."""
_POINT = 36e-6
"""MB of a map point, three doubles and a voxel key."""
_NOTHING: dict[str, Any] = {
    **{name: np.zeros((6, 6)) for name in ("information", "covariance", "directions")},
    **dict.fromkeys(
        ("localizability", "direction_information", "axis_localizability", "twist"), np.zeros(6)
    ),
    "uncertainty": None,
    "timings": {},
}
"""Of a frame's report what is not kept, in order to see the memory of the pipeline alone."""


@dataclass(frozen=True, slots=True)
class SoakResult:
    """What came of a run.

    Attributes
    ----------
    scene : where it was
    expected, summary : what was injected, and ``summary.json``
    exceptions : that left the pipeline, by what they say
    columns : (N,) per sweep delivered: ``process_mb``, ``map_points``, ``error_m`` (NaN if the
        pose was not solved) and ``faults`` so far
    sound : sweeps in the right order that were used, and how many of them were solved
    ate, largest : metres, of the solved frames
    false_ok : frames that are ``ok`` and off by more than five told standard deviations
    """

    scene: str
    expected: Expected
    summary: Mapping[str, Any]
    exceptions: Counter[str]
    columns: Mapping[str, FloatArray]
    sound: tuple[int, int]
    ate: float
    largest: float
    false_ok: int

    @property
    def growth(self) -> float:
        """MB per 1,000 sweeps: a straight line through the last four fifths."""
        return self.slope(0.2, 1.0)

    def slope(self, first: float, last: float) -> float:
        """The same of any part of the run, in shares of it."""
        used = self.columns["process_mb"]
        part = np.arange(int(first * len(used)), int(last * len(used)))
        return 1e3 * float(np.polyfit(part, used[part], 1)[0])

    def counts(self) -> Iterator[tuple[str, int, int]]:
        """What is counted, how often it was injected, and how often the report has it."""
        expected, summary = self.expected, self.summary
        for name in sorted({*expected.faults, *summary["faults"]}):
            yield name, expected.faults[name], summary["faults"].get(name, 0)
        yield "gaps between sweeps", expected.gaps, summary["sweep_gaps"]
        points = summary["not_finite_points"]
        yield "usable sweeps with NaN", len(expected.not_finite), points["sweeps"]
        yield "NaN points in them", sum(expected.not_finite), points["points"]
        for name in ("gaps", "duplicates", "out_of_order", "not_finite"):
            yield f"IMU: {name.replace('_', ' ')}", expected.imu[name], summary["imu"][name]

    def verdicts(self) -> dict[str, tuple[str, Verdict]]:
        """By label the value and whether it is as it must be."""
        raised = sum(self.exceptions.values())
        equal = sum(injected == counted for _, injected, counted in self.counts())
        total = len(list(self.counts()))
        judged = self.scene == _BOUNDED and len(self.columns["faults"]) >= _JUDGED
        known = self.scene in SCENES
        solved = self.sound[0] == self.sound[1] if known else None
        return {
            "exceptions": (str(raised), Verdict("0", raised == 0)),
            "counts that are exact": (f"{equal} of {total}", Verdict("all", equal == total)),
            "sound sweeps solved": (
                f"{self.sound[1]} of {self.sound[0]}",
                Verdict("all", solved),
            ),
            "ATE [m]": (
                f"{self.ate:.4f}",
                Verdict(f"<= {_ATE:g}", self.ate <= _ATE if known else None),
            ),
            "largest error [m]": (f"{self.largest:.3f}", Verdict("-", None)),
            "ok beyond five sigma": (str(self.false_ok), Verdict("0", self.false_ok == 0)),
            "memory [MB per 1,000 sweeps]": (
                f"{self.growth:+.2f}",
                Verdict(f"<= {_GROWTH:g}", self.growth <= _GROWTH if judged else None),
            ),
        }

    @property
    def met(self) -> bool:
        """Whether nothing is as it must not be."""
        return all(verdict.met is not False for _, verdict in self.verdicts().values())


def soak(scene: str, frames: int, seed: int = 0) -> SoakResult:
    """Drive so many sweeps of a scene, spoilt, through a pipeline."""
    frames = min(frames, _LONGEST.get(scene, frames))
    world = SimulatedWorld(scene, frames=frames, columns=(SCENES | PLACES)[scene])
    kinds = tuple(kind for kind in KINDS if scene in SCENES or kind != _USABLE)
    drive = FaultyDrive(world, seed, kinds)
    config = effective_config(Config(), world)
    pipeline = Pipeline(config, imu=ImuBuffer(config.imu, drive.imu))
    updates: list[MapUpdate] = []
    numbers: list[int] = []
    exceptions: Counter[str] = Counter()
    rows: list[tuple[float, int, int]] = []
    true, false_ok = [gtsam.Pose3(pose) for pose in world.truth.map_T_lidar], 0
    for sweep, number in drive.deliveries():
        try:
            update = pipeline.process(sweep)
        except Exception as problem:  # what must not happen is counted
            exceptions[f"{type(problem).__name__}: {problem}"] += 1
            continue
        updates.append(replace(update, **_NOTHING))
        numbers.append(number)
        if update.status is FrameStatus.OK:
            ends = [true[numbers[0]], true[number]]  # whatever the sweeps said
            squared = squared_errors([updates[0], update], ends).get(1, np.inf)
            false_ok += squared > FIVE_SIGMA
        maps = pipeline.mapper.maps.edges.stats, pipeline.mapper.maps.planes.stats
        points = sum(each.points + each.archived_points for each in maps)
        rows.append((memory()[0], points, drive.expected.injected.total()))
    solved = np.array([update.status.solved for update in updates])
    used = np.array([update.fault is None for update in updates])
    error, ate = _errors(updates, np.array(numbers), solved, world)
    process, points, faults = np.array(rows, np.float64).T
    return SoakResult(
        scene=scene,
        expected=drive.expected,
        summary=summarise(pipeline.result(updates)),
        exceptions=exceptions,
        columns={"process_mb": process, "map_points": points, "error_m": error, "faults": faults},
        sound=(int(used.sum()) - 1, int(solved.sum())),  # the first is not solved
        ate=ate,
        largest=float(np.nanmax(error)),
        false_ok=false_ok,
    )


def _errors(
    updates: Sequence[MapUpdate], numbers: IntArray, solved: BoolArray, world: SimulatedWorld
) -> tuple[FloatArray, float]:
    """Metres each solved frame is off after alignment, NaN for the others; the ATE of all."""
    found = stack_poses(update.map_T_lidar for update in updates)[solved]
    stamps = world.truth.stamps[numbers[solved]]  # whatever the sweeps said
    absolute = absolute_error(Trajectory(stamps, found), world.truth)
    errors = np.full(len(updates), np.nan)
    errors[solved] = absolute.translations
    return errors, absolute.rmse


def write(folder: Path, results: Sequence[SoakResult]) -> list[Path]:
    """``soak.csv``, ``soak_counts.csv``, and the curves of each run; or ``soak_places.csv``."""
    places = results[0].scene in PLACES
    paths = [folder / ("soak_places.csv" if places else "soak.csv")]
    header = ("place", "sweeps", "faults", *results[0].verdicts(), "statuses", "CPU")
    write_csv(paths[0], header, map(_row, results))
    if places:
        return paths
    counts = [(result.scene, *row) for result in results for row in result.counts()]
    paths.append(folder / "soak_counts.csv")
    write_csv(paths[-1], ("place", "what", "injected", "counted"), counts)
    return paths + [path for result in results for path in _write_curves(folder, result)]


def _row(result: SoakResult) -> tuple[object, ...]:
    delivered, faults = len(result.columns["faults"]), result.expected.injected.total()
    values = [value for value, _ in result.verdicts().values()]
    statuses = ", ".join(f"{n} {name}" for name, n in result.summary["status_counts"].items())
    return result.scene, delivered, faults, *values, statuses, dict(machine())["CPU"]


def _write_curves(folder: Path, result: SoakResult) -> list[Path]:
    columns = result.columns
    sweeps = len(columns["faults"])
    ends = np.linspace(0, sweeps, min(sweeps, _ROWS) + 1).astype(np.int64)
    rows = {"sweep": (ends[1:] - 1).astype(np.float64)}
    for name, column in columns.items():
        parts = [column[a:b] for a, b in pairwise(ends)]
        worst = name == "error_m"
        rows[name] = np.array(
            [np.nanmax(p) if worst and np.isfinite(p).any() else p[-1] for p in parts]
        )
    path = folder / f"soak_{result.scene}.csv"
    write_csv(path, list(rows), zip(*(values.tolist() for values in rows.values()), strict=True))
    paths = [path]
    if available():
        paths.append(path.with_suffix(".png"))
        x = rows["sweep"]
        map_mb = _POINT * rows["map_points"]
        panels = {
            "memory [MB]": {"process": (x, rows["process_mb"]), "map": (x, map_mb)},
            "error [m]": {"largest of twenty": (x, rows["error_m"])},
            "faults": {"injected so far": (x, rows["faults"])},
        }
        plot_curves(paths[-1], panels, "sweep")
    return paths


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; 1 if anything is not as it must be."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=__doc__)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} sweeps of the block")
    parser.add_argument("--frames", type=int, help=f"sweeps of each scene; {FRAMES} by default")
    parser.add_argument("--seed", type=int, default=0, help="of the faults")
    parser.add_argument("--places", action="store_true", help=f"{_FRAMES_OF_A_PLACE} sweeps of "
                        f"each of {', '.join(PLACES)} instead")  # fmt: skip
    parser.add_argument("--output", type=Path, help="folder for the results; docs/benchmarks, or "
                        "benchmarks/results if only a part is run")  # fmt: skip
    options = parser.parse_args(arguments)
    part = options.quick or options.places or options.frames is not None
    usual = QUICK if options.quick else _FRAMES_OF_A_PLACE if options.places else FRAMES
    frames = options.frames or usual
    if frames < 2 * QUICK // 3:
        parser.error(f"--frames: expected at least {2 * QUICK // 3}, got {frames}")
    folder = options.output or ROOT / ("benchmarks/results" if part else "docs/benchmarks")
    scenes = ["street_loop"] if options.quick else list(PLACES if options.places else SCENES)
    # Processes of their own, started afresh: the memory of one run is not that of the other.
    with ProcessPoolExecutor(
        min(len(scenes), len(SCENES)), mp_context=get_context("spawn"), max_tasks_per_child=1
    ) as pool:
        runs = [pool.submit(soak, scene, frames, options.seed) for scene in scenes]
        results = [run.result() for run in runs]
    for result in results:
        _show(result)
    print(f"Written: {', '.join(map(str, write(folder, results)))}")
    return int(not all(result.met for result in results))


def _show(result: SoakResult) -> None:
    print(result.scene)
    for label, (value, verdict) in result.verdicts().items():
        print(f"  {label}: {value} ({verdict})")
    for name, injected, counted in result.counts():
        if injected != counted:
            print(f"  {name}: injected {injected}, counted {counted}")
    for message, times in result.exceptions.items():
        print(f"  {times} x {message}")


if __name__ == "__main__":
    sys.exit(main())
