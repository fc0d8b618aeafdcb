"""Results as tables: on the terminal, and as CSV files."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from benchmarks.cases import CaseResult, EvidenceTable
from benchmarks.peers import load
from benchmarks.tables import write_csv
from loam_gtsam.io.version import installed_version

STAGES = ("features", "odometry", "prepare", "match", "solve", "insert", "covariance", "wall")
_PACKAGES = ("loam_gtsam", "gtsam", "numpy", "scipy", "kiss-icp", "small_gicp")
_KISS = "KISS-ICP"


def machine() -> list[tuple[str, str]]:
    """What the numbers were measured on."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    facts = [
        ("CPU", f"{os.cpu_count()} x {models[0] if models else platform.processor() or 'unknown'}"),
        ("system", f"{platform.system()} {platform.machine()}"),
        ("Python", platform.python_version()),
    ]
    if hasattr(os, "getloadavg"):
        facts.append(("load average at the end", f"{os.getloadavg()[0]:.1f}"))
    return facts + [(package, installed_version(package)) for package in _PACKAGES]


def summary_table(results: Sequence[CaseResult]) -> EvidenceTable:
    """One row a case: accuracy, targets, peers, speed, size, statuses."""
    header = ("case", "sweeps", "path [m]", "ATE [m]", "targets", "other systems' ATE [m]",
              "ms a frame", "x KISS-ICP", "map points", "status")  # fmt: skip
    rows = tuple(_summary_row(result) for result in results)
    return EvidenceTable("summary", "Summary", header, rows)


def _summary_row(result: CaseResult) -> tuple[str, ...]:
    if result.problem:
        return (result.name, "", "", "", result.problem, "", "", "", "", "")
    peers = [f"{peer.label} {peer.ate:.3f}" for peer in result.peers]
    if load("kiss_icp") is None:
        peers.append(f"{_KISS} not installed")
    return (
        result.name,
        str(result.sweeps),
        f"{result.path:.1f}",
        _number(result.ate, 4),
        "; ".join(map(str, result.verdicts)),
        "; ".join(peers),
        _times(result, "wall"),
        _number(result.ratio, 2),
        f"{result.map_points[0]} edge, {result.map_points[1]} plane",
        ", ".join(f"{count} {status}" for status, count in result.statuses.items()),
    )


def stage_table(results: Sequence[CaseResult]) -> EvidenceTable:
    """Where the time goes."""
    rows = tuple(
        (result.name, *(_times(result, stage) for stage in STAGES))
        for result in results
        if not result.problem
    )
    title = "Median (95 %) milliseconds a frame, by stage"
    return EvidenceTable("stages", title, ("case", *STAGES), rows)


def tables(results: Sequence[CaseResult]) -> list[EvidenceTable]:
    """Everything there is to show, in order."""
    own = [table for result in results for table in result.tables]
    return [summary_table(results), stage_table(results), *own]


def show(console: Console, tables: Iterable[EvidenceTable]) -> None:
    """Print tables."""
    for content in tables:
        # Text: brackets are units, not markup.
        table = Table(title=Text(content.title), title_justify="left")
        for column in content.header:
            table.add_column(Text(column))
        for row in content.rows:
            table.add_row(*map(Text, row))
        console.print(table)


def write_tables(folder: Path, tables: Iterable[EvidenceTable]) -> tuple[Path, ...]:
    """Write a CSV file of each table; their paths."""
    paths = []
    for content in tables:
        paths.append(folder / f"{content.name}.csv")
        write_csv(paths[-1], content.header, content.rows)
    return tuple(paths)


def write(folder: Path, results: Sequence[CaseResult]) -> tuple[Path, ...]:
    """Write ``benchmarks.csv``, a row a case, and the further evidence; the paths."""
    rows = [_csv_row(result) for result in results]
    names = list(dict.fromkeys(name for row in rows for name in row))
    path = folder / "benchmarks.csv"
    write_csv(path, names, ([row.get(name, "") for name in names] for row in rows))
    return path, *write_tables(folder, (table for result in results for table in result.tables))


def _csv_row(result: CaseResult) -> dict[str, object]:
    row: dict[str, object] = {"case": result.name, "problem": result.problem, "note": result.note}
    if result.problem:
        return row
    row |= {
        "sweeps": result.sweeps,
        "path_m": result.path,
        "ate_m": result.ate,
        "targets": "; ".join(map(str, result.verdicts)),
        "ratio_to_kiss_icp": result.ratio,
        "edge_points": result.map_points[0],
        "plane_points": result.map_points[1],
    }
    row |= {f"frames_{status}": count for status, count in result.statuses.items()}
    for stage, (median, tail) in result.stages.items():
        row |= {f"{stage}_ms_median": median, f"{stage}_ms_95": tail}
    for peer in result.peers:
        row |= {f"ate_m {peer.label}": peer.ate, f"ms_median {peer.label}": peer.ms}
    return row


def _times(result: CaseResult, stage: str) -> str:
    if stage not in result.stages:
        return "-"
    return "{:.1f} ({:.1f})".format(*result.stages[stage])


def _number(value: float, digits: int) -> str:
    return "-" if value != value else f"{value:.{digits}f}"
