"""The numbers of whole runs (:mod:`benchmarks.scenes`), and their tables as CSV and Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from benchmarks.tables import write_csv
from loam_gtsam.types import FloatArray

NONE = "none"
"""The variant without an IMU, which stands beside every noise of one."""

RECORDED = 0.0
"""In the place of a noise: the IMU comes with the data."""

METRICS = {
    "ate_m": "ATE [m]",
    "max_m": "Largest error, aligned [m]",
    "drift_m": "Vertical drift: largest error of the height, not aligned [m]",
    "tilt_deg": "Roll and pitch together, root mean square error [degrees]",
    "along_percent": "Error along the way at its end [% of the path]",
    "degenerate": "Frames degenerate",
    "not_converged": "Frames not converged",
    "unsolved": "Frames without a solve",
    "ms": "Median ms of processor time a frame",
}
COLUMNS = {
    "solvers": ("ate_m", "max_m", "degenerate", "not_converged", "unsolved", "ms"),
    "imu": (
        "ate_m",
        "drift_m",
        "tilt_deg",
        "along_percent",
        "degenerate",
        "not_converged",
        "unsolved",
        "ms",
    ),
}
"""Metrics of each table."""
_DIGITS = {"along_percent": 2, "tilt_deg": 3, "ms": 0}


@dataclass(frozen=True, slots=True)
class Row:
    """One run.

    Attributes
    ----------
    table : key of COLUMNS
    noise : of the IMU's orientation, rad per axis, or RECORDED; NaN without IMU
    path_m : of the truth
    ate_m, max_m : of the positions, aligned
    drift_m, tilt_deg, along_percent : see :func:`drift`, :func:`tilt`, :func:`along`
    degenerate : frames in which the scan left some direction open
    not_converged : frames that still moved at the limit of associations
    unsolved : frames, the first apart, whose pose is no result of a solve
    ms : median processor time of a frame, without making the sweep
    """

    table: str
    place: str
    noise: float
    variant: str
    sweeps: int
    path_m: float
    ate_m: float
    max_m: float
    drift_m: float
    tilt_deg: float
    along_percent: float
    degenerate: int
    not_converged: int
    unsolved: int
    ms: float


def drift(estimate: FloatArray, truth: FloatArray) -> float:
    """Largest error of the height above the first pose, metres.

    Parameters
    ----------
    estimate, truth : (N, 4, 4) in frames with z up; nothing is aligned
    """
    height, wanted = (poses[:, 2, 3] - poses[0, 2, 3] for poses in (estimate, truth))
    return float(np.abs(height - wanted).max())


def tilts(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """(N,) angles between the up axes, seen from the lidar: roll and pitch together, rad.

    Parameters
    ----------
    estimate, truth : (N, 4, 4) in frames with z up
    """
    up, wanted = estimate[:, 2, :3], truth[:, 2, :3]
    angles: FloatArray = np.arctan2(
        np.linalg.norm(np.cross(up, wanted), axis=1), (up * wanted).sum(axis=1)
    )
    return angles


def tilt(estimate: FloatArray, truth: FloatArray) -> float:
    """Root mean square of :func:`tilts`, degrees."""
    return float(np.degrees(np.sqrt(np.mean(tilts(estimate, truth) ** 2))))


def along(estimate: FloatArray, truth: FloatArray) -> float:
    """Error of the last pose along the line from the first to the last, per cent of the path.

    Both are seen from their first pose; positive is too far.

    Parameters
    ----------
    estimate, truth : (N, 4, 4)
    """
    here, there = ((np.linalg.inv(poses[0]) @ poses)[:, :3, 3] for poses in (estimate, truth))
    path = np.linalg.norm(np.diff(there, axis=0), axis=1).sum()
    direction = there[-1] / np.linalg.norm(there[-1])
    return float(100.0 * (here[-1] - there[-1]) @ direction / path)


def markdown(table: str, rows: Sequence[Row]) -> Iterator[str]:
    """One table a metric: a line for each place and noise, a column for each variant."""
    rows = [row for row in rows if row.table == table]
    variants = list(dict.fromkeys(row.variant for row in rows))
    yield f"# Whole runs: {table}\n"
    yield f"Made by `python -m benchmarks.scenes`; also as [CSV]({table}.csv)."
    for metric in COLUMNS[table]:
        yield f"\n**{METRICS[metric]}**\n"
        head = ("place", "sweeps", "path [m]", *(("noise [mrad]",) if table == "imu" else ()))
        yield f"| {' | '.join((*head, *variants))} |"
        yield "|---" * (len(head) + len(variants)) + "|"
        for place in dict.fromkeys(row.place for row in rows):
            here = [row for row in rows if row.place == place]
            with_imu = [row for row in here if row.variant != NONE]
            # The runs without an IMU, whose noise is NaN, are one line of the solvers' table.
            noises = [None] if table == "solvers" else [row.noise for row in with_imu]
            for noise in dict.fromkeys(noises):
                own = {r.variant: r for r in here if noise in (None, r.noise) or r.variant == NONE}
                cells = [place, str(here[0].sweeps), f"{here[0].path_m:.1f}"]
                if table == "imu":
                    cells.append(f"{1e3 * noise:g}" if noise else "recorded")
                cells += [_cell(own.get(name), metric) for name in variants]
                yield f"| {' | '.join(cells)} |"


def _cell(row: Row | None, metric: str) -> str:
    if row is None:
        return ""
    value = getattr(row, metric)
    return f"{value:.{_DIGITS.get(metric, 4)}f}" if isinstance(value, float) else str(value)


def write(folder: Path, rows: Sequence[Row]) -> list[Path]:
    """The tables that have rows, as ``*.csv`` (one row a run) and ``*.md``; their paths."""
    paths = []
    names = [item.name for item in fields(Row)][1:]
    for table in dict.fromkeys(row.table for row in rows):
        path = folder / f"{table}.csv"
        here = (row for row in rows if row.table == table)
        write_csv(path, names, ([getattr(row, name) for name in names] for row in here))
        text = "\n".join(markdown(table, rows)) + "\n"
        path.with_suffix(".md").write_text(text, encoding="utf-8")
        paths += [path, path.with_suffix(".md")]
    return paths
