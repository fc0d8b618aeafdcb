"""Curves, tables and pictures of long runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.cases import EvidenceTable, Verdict
from benchmarks.report import machine
from benchmarks.tables import write_csv
from loam_gtsam.types import FloatArray, IntArray
from loam_gtsam.view.plots import available, plot_curves

GROWTH = 1.1
"""Target: time of the last tenth of a run over that of its second tenth (the first has a start-up
and an empty map)."""
_ROWS = 500
"""Of a CSV at most, and points of a curve."""
_POINT, _KEYED = 32e-6, 40e-6
"""MB of a point in the archive (three doubles, an owner, a view), and in the window, where it has a
voxel key."""


@dataclass(frozen=True, slots=True)
class GrowthResult:
    """What a drive cost.

    Attributes
    ----------
    name : of the scene
    columns : (N,) a frame each, see ``benchmarks.growth.COLUMNS``
    path, ate : metres driven, and root mean square of the position errors
    statuses : how many frames ended in which
    map_points : edge and plane points of the whole map in the end
    evicted, dropped : cubes that ever left the window, and that were lost
    report_kb : of one frame's :class:`loam_gtsam.MapUpdate`, which a run keeps
    peak_mb, peak_with_map_mb : largest resident memory while mapping, and with a copy of the whole
        map, archive included, as a run returns it
    """

    name: str
    columns: Mapping[str, FloatArray]
    path: float
    ate: float
    statuses: Mapping[str, int]
    map_points: tuple[int, int]
    evicted: int
    dropped: int
    report_kb: float
    peak_mb: float
    peak_with_map_mb: float

    @property
    def sweeps(self) -> int:
        """Frames of the run."""
        return len(self.columns["cpu_ms"])

    def tenths(self, column: str) -> FloatArray:
        """(10,) medians of a column over each tenth of the run."""
        parts = np.array_split(self.columns[column], 10)
        medians: FloatArray = np.array([np.median(part) for part in parts])
        return medians

    def growth(self, column: str) -> float:
        """Last tenth over second tenth."""
        tenths = self.tenths(column)
        return float(tenths[9] / tenths[1])

    def own_growth(self, column: str) -> float:
        """The same, the machine's own ups and downs taken out.

        Making a sweep knows nothing of the map: what it takes longer in the end, the machine does.
        """
        return self.growth(column) / self.growth("make_ms")

    @property
    def verdict(self) -> Verdict:
        """Of the time a frame takes."""
        return Verdict(f"<= {GROWTH:g} x", self.own_growth("cpu_ms") <= GROWTH)


def thinned(result: GrowthResult) -> dict[str, FloatArray]:
    """At most 500 rows: medians of the times, and everything else as it was in the last frame."""
    ends: IntArray = np.linspace(0, result.sweeps, min(result.sweeps, _ROWS) + 1).astype(np.int64)
    rows = {"frame": (ends[1:] - 1).astype(np.float64)}
    for name, column in result.columns.items():
        if name.endswith("_ms"):
            parts = [column[a:b] for a, b in pairwise(ends)]
            rows[name] = np.array([np.median(part) for part in parts])
        else:
            rows[name] = column[ends[1:] - 1]
    return rows


def write(folder: Path, result: GrowthResult) -> list[Path]:
    """``growth_SCENE.csv`` and, with matplotlib, ``.png`` of a drive; the paths."""
    rows = thinned(result)
    path = folder / f"growth_{result.name}.csv"
    columns = [np.asarray(values, np.float64).tolist() for values in rows.values()]
    write_csv(path, list(rows), zip(*columns, strict=True))
    if not available():
        return [path]
    _draw(path.with_suffix(".png"), rows)
    return [path, path.with_suffix(".png")]


def _draw(path: Path, rows: Mapping[str, FloatArray]) -> None:
    frame = rows["frame"]
    times = {"whole pipeline": "cpu_ms", "match": "match_ms", "insert": "insert_ms",
             "(making the sweep)": "make_ms"}  # fmt: skip
    points = {"in the window": "window_points", "matched against": "near_points",
              "in the archive": "archived_points"}  # fmt: skip
    megabytes = {
        "process": rows["process_mb"],
        "map in the window": _KEYED * rows["window_points"],
        "archive": _POINT * rows["archived_points"],
    }
    plot_curves(
        path,
        {
            "processor time [ms]": {name: (frame, rows[key]) for name, key in times.items()},
            "map points [millions]": {
                name: (frame, 1e-6 * rows[key]) for name, key in points.items()
            },
            "memory [MB]": {name: (frame, column) for name, column in megabytes.items()},
        },
        "frame",
    )


def time_table(results: Sequence[GrowthResult]) -> EvidenceTable:
    """What a frame takes, tenth by tenth of the run."""
    header = ("run", "stage", *(f"{k}." for k in range(1, 11)), "10. over 2.",
              "without the machine's", "target")  # fmt: skip
    stages = {
        "whole pipeline": "cpu_ms",
        "features": "features_ms",
        "match": "match_ms",
        "solve": "solve_ms",
        "insert": "insert_ms",
        "covariance": "covariance_ms",
        "(making the sweep)": "make_ms",
    }
    rows = []
    for result in results:
        for label, column in stages.items():
            numbers = [f"{value:.1f}" for value in result.tenths(column)]
            numbers += [f"{result.growth(column):.2f}", f"{result.own_growth(column):.2f}"]
            verdict = str(result.verdict) if column == "cpu_ms" else ""
            rows.append((result.name, label, *numbers, verdict))
    title = "Median processor time a frame in each tenth of the run [ms]"
    return EvidenceTable("growth_times", title, header, tuple(rows))


def size_table(results: Sequence[GrowthResult]) -> EvidenceTable:
    """What was driven, and what it left in memory."""
    header = ("run", "sweeps", "path [m]", "ATE [m]", "status", "whole map [points]",
              "most in the window", "cubes evicted / lost", "archive [MB]", "reports [MB]",
              "process [MB]", "peak [MB]", "peak with the whole map [MB]", "CPU")  # fmt: skip
    rows = []
    for result in results:
        columns = result.columns
        rows.append(
            (
                result.name,
                str(result.sweeps),
                f"{result.path:.0f}",
                f"{result.ate:.3f}",
                ", ".join(f"{count} {status}" for status, count in result.statuses.items()),
                "{} edge, {} plane".format(*result.map_points),
                f"{columns['window_points'].max():.0f}",
                f"{result.evicted} / {result.dropped}",
                f"{_POINT * columns['archived_points'][-1]:.0f}",
                f"{1e-3 * result.report_kb * result.sweeps:.0f}",
                f"{columns['process_mb'][-1]:.0f}",
                f"{result.peak_mb:.0f}",
                f"{result.peak_with_map_mb:.0f}",
                dict(machine())["CPU"],
            )
        )
    return EvidenceTable("growth", "Runs", header, tuple(rows))
