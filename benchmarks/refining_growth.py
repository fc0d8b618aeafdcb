"""What refining long drives costs: ``python -m benchmarks.refining --growth``.

A drive is run once; its first sweeps are refined in processes of their own, one size after the
other.
"""

from __future__ import annotations

import pickle
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.growth import Drive
from benchmarks.process import memory
from benchmarks.tables import write_rows
from loam_gtsam.pipeline import run
from loam_gtsam.refine.runs import RunPoints, refine_run, run_points
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import MapUpdate, Trajectory
from loam_gtsam.view.plots import available, plot_curves

SIZES = (250, 500, 1000, 2000, 4000)
"""Sweeps that are refined."""
DRIVES = {name: Drive(name) for name in ("street_loop", "avenue")}
"""Round and round a block, and over ground that is always new."""


@dataclass(frozen=True, slots=True)
class Size:
    """What refining so many sweeps of a drive costs.

    Attributes
    ----------
    points, planes : that take part in the last round
    run_mm, refined_mm : ATE, aligned
    seconds : processor time of refining alone
    data_mb, peak_mb : resident memory of the process with its data, and at most
    """

    drive: str
    sweeps: int
    points: int
    planes: int
    run_mm: float
    refined_mm: float
    seconds: float
    data_mb: float
    peak_mb: float


def prepare(drive: Drive, sizes: Sequence[int], folder: Path) -> None:
    """Run a drive, and write what refining its first sweeps takes."""
    world = drive.open()
    result = run(world)
    every = run_points(world, result.updates, result.config)
    for size in sizes:
        count = int(np.searchsorted(every.frames, size))
        points = RunPoints(every.frames[:count], every.used[:count], every.held[:count])
        with (folder / f"{size}.pickle").open("wb") as file:
            pickle.dump((points, result.updates[:size], world.truth), file)


def refine_size(name: str, size: int, folder: Path) -> Size:
    """Refine what was prepared; in a process of its own, whose memory is measured."""
    with (folder / f"{size}.pickle").open("rb") as file:
        loaded: tuple[RunPoints, list[MapUpdate], Trajectory] = pickle.load(file)
    points, updates, truth = loaded
    data, began = memory()[0], time.process_time()
    found = refine_run(points, updates)
    seconds, peak = time.process_time() - began, memory()[1]
    last = found.refined.rounds[-1]
    poses = np.array([updates[number].map_T_lidar.matrix() for number in points.frames])
    first = Trajectory(found.trajectory.stamps, poses)
    before, after = (1e3 * absolute_error(way, truth).rmse for way in (first, found.trajectory))
    return Size(name, size, last.points, last.planes, before, after, seconds, data, peak)


def measure_growth(drives: Sequence[Drive], sizes: Sequence[int], path: Path) -> list[Size]:
    """Every size of every drive, one process after the other; as CSV, row by row, and a picture."""
    rows: list[Size] = []
    for drive in drives:
        with tempfile.TemporaryDirectory() as folder:
            _apart(prepare, replace(drive, frames=max(sizes)), sizes, Path(folder))
            for size in sizes:
                rows.append(_apart(refine_size, drive.scene, size, Path(folder)))
                write_rows(path, rows)
    if available():
        panels: dict[str, dict[str, Any]] = {}
        for label, name in (("refining [s]", "seconds"), ("memory at most [MB]", "peak_mb")):
            panels[label] = {
                scene: tuple(np.array([(r.sweeps, getattr(r, name)) for r in some], float).T)
                for scene, group in groupby(rows, lambda row: row.drive)
                for some in [list(group)]
            }
        plot_curves(path.with_suffix(".png"), panels, "sweeps")
    return rows


def _apart(function: Any, *arguments: Any) -> Any:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()
