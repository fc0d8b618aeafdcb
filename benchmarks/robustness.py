"""Disturbed runs: ``python -m benchmarks.robustness``.

Passing objects, outliers, drop-outs, missing sweeps and a kidnapped lidar, each held against the
undisturbed run, and KISS-ICP on the same sweeps if it is installed. The table goes to
``robustness.csv``. All numbers are the same on every run.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.cases import ROOT, data_folder
from benchmarks.peers import KissIcp, load, timed_points
from benchmarks.tables import write_rows
from loam_gtsam.config import Config
from loam_gtsam.datasets import Dataset, SimulatedWorld, open_dataset
from loam_gtsam.datasets.arrays import ArrayDataset
from loam_gtsam.datasets.sim.disturbances import (
    Disturbed,
    Kidnapped,
    MissingSweeps,
    MovingObjects,
    Outliers,
    SectorDropouts,
    SkippedAhead,
)
from loam_gtsam.pipeline import effective_config, run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import FloatArray, Scan, Trajectory

OURS, KISS = "loam_gtsam", "KISS-ICP"
NONE = "none"
TOWN = "sim_town"
_BACK = 0.1
"""Metres by which the error may exceed that of the undisturbed run to count as recovered."""
_STAYS = 5
"""Sweeps for which it must be."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where it is run.

    Attributes
    ----------
    scene : built-in, or TOWN, which is a folder
    frames, columns : of the simulated world
    lane : metres from the lidar to passing objects
    disturbances : of :data:`DISTURBANCES`
    """

    scene: str
    frames: int | None = 150
    columns: int | None = None
    lane: float = 2.5
    disturbances: tuple[str, ...] = ()


MOVING = "30 % on moving objects"
HUBER = f"{MOVING}, kernel huber"
"""The same sweeps; ours only."""
COMMON = (
    NONE,
    MOVING,
    HUBER,
    "20 % outliers",
    "a quarter of the azimuth lost",
    "one sweep missing",
    "five sweeps missing",
)
MOVES: Mapping[str, tuple[tuple[float, float, float], float]] = {
    "kidnapped 1 m sideways": ((0.0, 1.0, 0.0), 0.0),
    "kidnapped 1 m ahead": ((1.0, 0.0, 0.0), 0.0),
    "kidnapped 3 m sideways": ((0.0, 3.0, 0.0), 0.0),
    "kidnapped 3 m ahead": ((3.0, 0.0, 0.0), 0.0),
    "kidnapped 10 m ahead": ((10.0, 0.0, 0.0), 0.0),
    "kidnapped, turned by 30 degrees": ((0.0, 0.0, 0.0), 30.0),
}
"""Where the lidar is put, metres and degrees. A recorded drive can be moved ahead only."""
AHEAD = {"kidnapped 1 m ahead": 1.0, "kidnapped 3 m ahead": 3.0}
PLACES = (
    Place("street_loop", disturbances=(*COMMON, *MOVES)),
    # Ten metres are not to be had in a room.
    Place(
        "room",
        lane=1.2,
        disturbances=(*COMMON, *(name for name in MOVES if "10 m" not in name)),
    ),
    Place(TOWN, frames=None, disturbances=(*COMMON, *AHEAD)),
    Place("trees", lane=1.5, disturbances=(NONE, MOVING, HUBER)),
)
QUICK = (
    Place(
        "room",
        frames=36,
        columns=600,
        lane=1.2,
        disturbances=(NONE, "20 % outliers", "one sweep missing", "kidnapped 1 m sideways"),
    ),
)


@dataclass(frozen=True, slots=True)
class Case:
    """Disturbed sweeps, and what was done to them.

    Attributes
    ----------
    events : numbers, in the undisturbed drive, of sweeps after which to look for a recovery
    unclear : numbers of sweeps that are not compared: over their end the truth jumps
    cut : sweeps cut out at the event
    """

    dataset: Dataset
    events: tuple[int, ...] = ()
    unclear: tuple[int, ...] = ()
    cut: int = 0


@dataclass(frozen=True, slots=True)
class Row:
    """One run of one system.

    Attributes
    ----------
    ate_m, max_m : root mean square and largest error of the positions, aligned
    recovery : sweeps after an event until the error is that of the undisturbed run again, up to
        0.1 m; the longest of the run's events. "never", or empty if there was no event.
    statuses : how many sweeps ended in which; of ours only
    """

    place: str
    disturbance: str
    system: str
    sweeps: int
    ate_m: float
    max_m: float
    recovery: str
    statuses: str


@cache
def recorded(place: Place, data: Path) -> tuple[ArrayDataset, SimulatedWorld | None]:
    """The undisturbed sweeps, made once in a process, and the world they come from."""
    world: SimulatedWorld | None = None
    source: Dataset
    if place.scene == TOWN:
        source = open_dataset(data / TOWN)
    else:
        source = world = SimulatedWorld(place.scene, frames=place.frames, columns=place.columns)
    sweeps = [sweep for sweep in source if isinstance(sweep, Scan)]
    return ArrayDataset(sweeps, truth=source.truth, sensor=source.sensor), world


def disturbed(place: Place, name: str, data: Path) -> Case:
    """The sweeps of a place with one disturbance."""
    calm, world = recorded(place, data)
    sweeps = list(calm)
    count = len(sweeps)
    half, thirds = count // 2, (count // 3, count // 2, 5 * count // 6)
    if name in MOVES and world is not None:
        moved = Kidnapped(world, half, *MOVES[name])
        later = [moved[number] for number in range(half, count)]
        dataset = ArrayDataset([*sweeps[:half], *later], truth=moved.truth, sensor=calm.sensor)
        return Case(dataset, (half,), (half - 1,))
    if name in AHEAD:
        assert calm.truth is not None
        away = calm.truth.map_T_lidar[half:, :3, 3] - calm.truth.map_T_lidar[half, :3, 3]
        cut = int(np.searchsorted(np.linalg.norm(away, axis=1), AHEAD[name]))
        return Case(SkippedAhead(calm, half, cut), (half,), (half - 1,), cut)
    if name == "one sweep missing":
        return Case(Disturbed(calm, [MissingSweeps(thirds)]), thirds)
    if name == "five sweeps missing":
        return Case(Disturbed(calm, [MissingSweeps(thirds, 5)]), thirds)
    if name in (MOVING, HUBER):
        passing = MovingObjects(lane=place.lane).covering(0.3, sweeps[half])
        return Case(Disturbed(calm, [passing]))
    changes = {
        NONE: (),
        "20 % outliers": (Outliers(0.2),),
        "a quarter of the azimuth lost": (SectorDropouts(0.25),),
    }
    return Case(Disturbed(calm, changes[name]))


@dataclass(frozen=True, slots=True)
class Measured:
    """A row, and what its recovery follows from.

    Attributes
    ----------
    errors : (N,) metres by the number of the sweep in the undisturbed drive, the first poses laid
        on top of each other; NaN where there is none
    events : see :class:`Case`
    """

    row: Row
    errors: FloatArray
    events: tuple[int, ...]


def finished(measured: Sequence[Measured]) -> list[Row]:
    """The rows with their recovery, which needs the undisturbed run of the same system."""
    calm = {(m.row.place, m.row.system): m.errors for m in measured if m.row.disturbance == NONE}
    return [
        replace(m.row, recovery=recovery(m.errors, calm[m.row.place, m.row.system], m.events))
        for m in measured
    ]


def recovery(errors: FloatArray, calm: FloatArray, events: Sequence[int]) -> str:
    """Sweeps from each event until the error is again that of the undisturbed run; the longest.

    Parameters
    ----------
    errors, calm : (N,) metres by the number of the sweep, NaN where there is none
    """
    longest = 0
    for event in events:
        there = np.isfinite(errors[event:]) & np.isfinite(calm[event:])
        good = (errors[event:] < calm[event:] + _BACK)[there]
        # Padded: a run that ends well stays well.
        stays = np.convolve(np.append(good, np.ones(_STAYS - 1)), np.ones(_STAYS), "valid")
        first = np.flatnonzero(stays == _STAYS)
        if not len(first) or not good[first[0] :].size:
            return "never"
        longest = max(longest, int(first[0]))
    return str(longest) if len(events) else ""


def measure(task: tuple[Place, str], data: Path) -> list[Measured]:
    """Our run of a disturbed drive, and KISS-ICP's."""
    place, name = task
    case = disturbed(place, name, data)
    truth = case.dataset.truth
    assert truth is not None
    config = effective_config(Config(), case.dataset)
    if name == HUBER:
        config = config.changed("solver.kernel=huber")
    result = run(case.dataset, config)
    statuses = ", ".join(f"{count} {status}" for status, count in _others(result.status_counts))
    found = {OURS: result.trajectory}
    if load("kiss_icp") is not None and name != HUBER:
        kiss = KissIcp()
        for sweep in case.dataset:
            assert isinstance(sweep, Scan)
            kiss.register(sweep.stamp, timed_points(sweep, config))
        found[KISS] = kiss.trajectory
    starts = np.array([sweep.stamp for sweep in case.dataset if isinstance(sweep, Scan)], np.int64)
    measured = []
    for system, trajectory in found.items():
        numbers = np.searchsorted(truth.stamps, starts)
        inside = trajectory.stamps <= truth.stamps[-1]
        clear = inside & ~np.isin(numbers, case.unclear)
        compared = trajectory[clear]
        error = absolute_error(compared, truth)
        errors = np.full(len(truth) + case.cut, np.nan)
        before = case.events[:1] or (0,)
        originally = numbers[clear] + np.where(numbers[clear] >= before[0], case.cut, 0)
        errors[originally] = _from_the_start(compared, truth)
        row = Row(
            place=place.scene,
            disturbance=name,
            system=system,
            sweeps=len(starts),
            ate_m=error.rmse,
            max_m=error.maximum,
            recovery="",
            statuses=statuses if system == OURS else "",
        )
        measured.append(Measured(row, errors, case.events))
    return measured


def _others(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    """Statuses and their counts, without those of an ordinary run."""
    return [(status, n) for status, n in Counter(counts).items() if status not in ("ok", "first")]


def _from_the_start(trajectory: Trajectory, truth: Trajectory) -> FloatArray:
    """(N,) metres of position error, the first poses laid on top of each other."""
    reference = truth.at(trajectory.stamps).map_T_lidar
    poses = reference[0] @ np.linalg.inv(trajectory.map_T_lidar[0]) @ trajectory.map_T_lidar
    errors: FloatArray = np.linalg.norm(poses[:, :3, 3] - reference[:, :3, 3], axis=1)
    return errors


def write(folder: Path, rows: Sequence[Row]) -> Path:
    """``robustness.csv``; its path."""
    path = folder / "robustness.csv"
    write_rows(path, rows, digits=6)
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robustness", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a few coarse sweeps of the room")
    parser.add_argument("--data", type=Path, default=data_folder(),
                        help=f"folder with {TOWN}, which is skipped if it is absent")  # fmt: skip
    parser.add_argument("--output", type=Path, help="folder for the tables; docs/benchmarks, "
                        "or benchmarks/results with --quick")  # fmt: skip
    options = parser.parse_args(arguments)
    places = [
        place for place in (QUICK if options.quick else PLACES)
        if place.scene != TOWN or (options.data / TOWN).is_dir()
    ]  # fmt: skip
    folder = options.output or ROOT / ("benchmarks/results" if options.quick else "docs/benchmarks")
    started = time.perf_counter()
    tasks = [(place, name) for place in places for name in place.disturbances]
    # Started afresh: KISS-ICP brings threads of its own, which a fork would not carry over.
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(partial(measure, data=options.data), tasks))
    rows = finished([measured for own in found for measured in own])
    path = write(folder, rows)
    print(f"{len(rows)} rows in {time.perf_counter() - started:.0f} s: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
