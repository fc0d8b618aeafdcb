"""Are the covariances right? ``python -m benchmarks.consistency``.

Monte-Carlo runs of the built-in world: normalised estimation error squared (NEES) of the motion
over windows of frames, and of the pose since the start, by scene. The same numbers come out with
any number of workers.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, dataclass, fields
from itertools import groupby
from pathlib import Path

import gtsam
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import chi2

from benchmarks.tables import write_csv
from loam_gtsam.config import Config
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.pipeline import run
from loam_gtsam.registration.pose_errors import relative_covariance
from loam_gtsam.types import FloatArray, MapUpdate

AXES = ("rx", "ry", "rz", "x", "y", "z")
FREEDOM = 6
MEAN = (0.5, 2.0)
"""Bounds of the mean NEES, in degrees of freedom."""
COVERAGE = (0.85, 0.99)
"""Bounds of the share of samples below the 95 % quantile of chi-squared."""
START = 0
"""The window that stands for the pose since the start of the map."""


@dataclass(frozen=True, slots=True)
class Study:
    """Runs to be made of one scene.

    Attributes
    ----------
    seeds : how many, of the scene and of all noise
    imu : whether the built-in IMU is used
    first : first seed; 100 to 103 were used for fitting
    """

    scene: str
    seeds: int
    imu: bool = False
    first: int = 0
    frames: int = 150
    columns: int | None = None
    windows: tuple[int, ...] = (1, 10, 50, START)

    @property
    def all_seeds(self) -> range:
        """One run for each."""
        return range(self.first, self.first + self.seeds)


def studies(seeds: int, first: int = 0) -> tuple[Study, ...]:
    """The whole programme; what takes part in the verdict comes first."""
    main, others = ("street_loop", "room", "corridor"), ("trees", "slopes")
    return (
        *(Study(scene, seeds, first=first) for scene in main),
        *(Study(scene, max(1, seeds // 5), imu=True, first=first) for scene in main),
        *(Study(scene, max(1, seeds // 10), first=first) for scene in others),
    )


QUICK = (
    Study("room", 2, frames=14, columns=600, windows=(1, 5, START)),
    Study("corridor", 1, imu=True, frames=8, columns=600, windows=(1,)),
)


@dataclass(frozen=True, slots=True)
class Samples:
    """Squared errors of one run over one window, (N,) and by axis (N, 6), each over its variance.

    ``raw`` takes the inverse information of both frames for their covariances.
    """

    study: Study
    window: int
    nees: FloatArray
    raw: FloatArray
    axes: FloatArray


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table; NEES are in degrees of freedom, 1 is right."""

    scene: str
    imu: bool
    window: str
    seeds: int
    samples: int
    mean: float
    low: float
    high: float
    coverage: float
    raw_mean: float
    rx: float
    ry: float
    rz: float
    x: float
    y: float
    z: float

    @property
    def within(self) -> bool:
        """Whether mean and coverage are in their bounds."""
        return MEAN[0] <= self.mean <= MEAN[1] and COVERAGE[0] <= self.coverage <= COVERAGE[1]


def run_seed(job: tuple[Study, int]) -> list[Samples]:
    """Map one world and hold its errors against its covariances."""
    study, seed = job
    world = SimulatedWorld(study.scene, seed=seed, frames=study.frames, columns=study.columns)
    config = Config()
    config = config.changed({"imu.enabled": study.imu})
    updates = run(world, config).updates
    truth = [gtsam.Pose3(pose) for pose in world.truth.map_T_lidar]
    return [samples(study, window, updates, truth) for window in study.windows]


def samples(
    study: Study, window: int, updates: Sequence[MapUpdate], truth: Sequence[gtsam.Pose3]
) -> Samples:
    """All pairs of solved frames a window apart, or all frames against the first one."""
    found = []
    for k in range(1 if window == START else window, len(updates)):
        earlier, later = updates[0 if window == START else k - window], updates[k]
        if not later.status.solved or (window != START and not earlier.status.solved):
            continue
        moved = earlier.map_T_lidar.between(later.map_T_lidar)
        true = truth[0 if window == START else k - window].between(truth[k])
        raw = later.raw_covariance
        if window == START:  # the first pose is where the map is, and has no error
            covariance = later.covariance
        else:
            covariance = relative_covariance(earlier, later)
            back = moved.inverse().AdjointMap()
            raw = raw + back @ earlier.raw_covariance @ back.T
        error = moved.localCoordinates(true)
        found.append(
            (
                error @ np.linalg.solve(covariance, error),
                error @ np.linalg.solve(raw, error),
                *(error**2 / np.diag(covariance)),
            )
        )
    table = np.array(found, np.float64).reshape(-1, 2 + FREEDOM)
    return Samples(study, window, table[:, 0] / FREEDOM, table[:, 1] / FREEDOM, table[:, 2:])


def summarise(parts: Sequence[Samples]) -> Row:
    """The runs of one study over one window."""
    study, window = parts[0].study, parts[0].window
    nees = np.concatenate([part.nees for part in parts])
    means = [float(part.nees.mean()) for part in parts if len(part.nees)]
    low, high = np.percentile(means, (5.0, 95.0))
    limit = chi2.ppf(0.95, FREEDOM) / FREEDOM
    return Row(
        study.scene,
        study.imu,
        "start" if window == START else str(window),
        len(parts),
        len(nees),
        float(nees.mean()),
        float(low),
        float(high),
        float((nees < limit).mean()),
        float(np.concatenate([part.raw for part in parts]).mean()),
        *np.concatenate([part.axes for part in parts]).mean(axis=0).tolist(),
    )


def measure(programme: Iterable[Study], workers: int) -> list[Row]:
    """All runs, over ``workers`` processes; kept in order, so that their number does not matter."""
    jobs = [(study, seed) for study in programme for seed in study.all_seeds]
    if workers > 1:
        with ProcessPoolExecutor(workers) as pool:
            results = list(pool.map(run_seed, jobs))
    else:
        results = [run_seed(job) for job in jobs]
    rows = []
    for _, group in groupby(results, key=lambda result: result[0].study):
        rows += [summarise(parts) for parts in zip(*group, strict=True)]
    return rows


def write(rows: Sequence[Row], folder: Path) -> list[Path]:
    """``nees.csv``, ``nees.md`` and ``nees.png``."""
    paths = [folder / name for name in ("nees.csv", "nees.md", "nees.png")]
    names = [*(item.name for item in fields(Row)), "within"]
    write_csv(paths[0], names, ((*astuple(row), row.within) for row in rows), digits=4)
    paths[1].write_text(table(rows), encoding="utf-8")
    draw(rows, paths[2])
    return paths


def table(rows: Sequence[Row]) -> str:
    """The rows in Markdown."""
    titles = ("scene", "IMU", "window", "seeds", "samples", "NEES / 6", "runs, 5-95 %", "coverage",
              "within", "raw", *AXES)  # fmt: skip
    lines = [
        "# NEES of the built-in world",
        "",
        "Written by `python -m benchmarks.consistency`. [What it means](../consistency.md).",
        "",
        "| " + " | ".join(titles) + " |",
        "|" + "---|" * len(titles),
    ]
    for row in rows:
        axes = [f"{getattr(row, axis):.2f}" for axis in AXES]
        cells = (row.scene, "yes" if row.imu else "no", row.window, str(row.seeds),
                 str(row.samples), f"{row.mean:.2f}", f"{row.low:.2f}-{row.high:.2f}",
                 f"{100.0 * row.coverage:.1f} %", "yes" if row.within else "**no**",
                 f"{row.raw_mean:.2f}", *axes)  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def draw(rows: Sequence[Row], path: Path) -> None:
    """Mean and coverage by scene and window, with the bounds."""
    mpl.use("Agg")
    places = list(dict.fromkeys((row.scene, row.imu) for row in rows))
    windows = list(dict.fromkeys(row.window for row in rows))
    figure, (above, below) = plt.subplots(2, 1, figsize=(8.0, 5.6), sharex=True, dpi=90)
    above.axhspan(*MEAN, color="#3a9d5d", alpha=0.15, label="bounds")
    below.axhspan(*(100.0 * np.array(COVERAGE)), color="#3a9d5d", alpha=0.15)
    for number, window in enumerate(windows):
        chosen = [row for row in rows if row.window == window]
        offset = 0.8 * ((number + 0.5) / len(windows) - 0.5)
        at = [places.index((row.scene, row.imu)) + offset for row in chosen]
        mean = np.array([row.mean for row in chosen])
        spread = np.abs(np.array([[row.low, row.high] for row in chosen]).T - mean)
        label = "since the start" if window == "start" else f"frames apart: {window}"
        colour = f"C{number}"
        above.errorbar(at, mean, spread, fmt="o", color=colour, capsize=2, label=label)
        above.plot(at, [row.raw_mean for row in chosen], "x", color=colour, alpha=0.6)
        below.plot(at, [100.0 * row.coverage for row in chosen], "o", color=colour)
    above.plot([], [], "kx", alpha=0.6, label="raw")
    above.set(yscale="log", ylabel="mean NEES / 6")
    above.legend(ncol=3, fontsize="small")
    below.set(ylabel="below the 95 % quantile, %")
    names = [f"{scene}\nwith IMU" if imu else scene for scene, imu in places]
    below.set_xticks(range(len(places)), names, fontsize="small")
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; 1 if a scene without IMU out of the first three is out of bounds."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.consistency", description=__doc__)
    parser.add_argument("--seeds", type=int, default=30, help="of the first three scenes")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="a few short runs")
    parser.add_argument("--output", type=Path, default=Path("docs/consistency"),
                        help="folder for nees.csv, nees.md and nees.png")  # fmt: skip
    options = parser.parse_args(arguments)
    programme = QUICK if options.quick else studies(options.seeds, options.first)
    rows = measure(programme, options.workers)
    print(table(rows))
    paths = write(rows, options.output)
    print(f"Written: {', '.join(map(str, paths))}")
    if options.quick:
        return 0
    judged = {study.scene for study in programme[:3]}
    windows = ("start",)
    missed = [row for row in rows
              if row.scene in judged and not row.imu and row.window not in windows
              and not row.within]  # fmt: skip
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
