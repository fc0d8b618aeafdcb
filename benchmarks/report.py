"""Results as tables: on the terminal, and as CSV and Markdown files."""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from benchmarks.cases import CaseResult, EvidenceTable
from benchmarks.peers import load
from benchmarks.tables import markdown_table
from loam_gtsam.io.version import installed_version

STAGES = ("features", "odometry", "prepare", "match", "solve", "insert", "covariance", "wall")
_PACKAGES = ("loam_gtsam", "gtsam", "numpy", "scipy", "kiss-icp", "small_gicp")
_KISS = "KISS-ICP"

_EXPLANATION = (
    "ATE: root mean square of the positions after a rigid (SE(3), Umeyama) alignment, against the "
    "truth at the moment each system's pose belongs to: ours at the start of the sweep, KISS-ICP's "
    "at its last point (version 1.3 de-skews to there), without de-skew at its middle.",
    "Times: median (95 %) milliseconds a frame, without reading or making the sweeps. The wall "
    "time is that of the whole pipeline, with one process that extracts features ahead "
    "(`run(..., workers=1)`), so it is less than the sum of the stages. No IMU is used. KISS-ICP "
    "gets the same sweeps with the same point times, in blocks of 50 after ours, with its default "
    "settings (voxel 1 m, all cores); the ratio is our median over its median.",
)


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
    return EvidenceTable("Summary", header, tuple(_summary_row(result) for result in results))


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
    return EvidenceTable("Median (95 %) milliseconds a frame, by stage", ("case", *STAGES), rows)


def tables(results: Sequence[CaseResult]) -> list[EvidenceTable]:
    """Everything there is to show, in order."""
    own = [table for result in results for table in result.tables]
    return [summary_table(results), stage_table(results), *own]


def show(console: Console, results: Sequence[CaseResult]) -> None:
    """Print the tables."""
    for content in tables(results):
        # Text: brackets are units, not markup.
        table = Table(title=Text(content.title), title_justify="left")
        for column in content.header:
            table.add_column(Text(column))
        for row in content.rows:
            table.add_row(*map(Text, row))
        console.print(table)


def write(folder: Path, results: Sequence[CaseResult]) -> tuple[Path, ...]:
    """Write ``benchmarks.csv`` (one row a case) and ``benchmarks.md``; their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [_csv_row(result) for result in results]
    names = list(dict.fromkeys(name for row in rows for name in row))
    csv_path, markdown_path = folder / "benchmarks.csv", folder / "benchmarks.md"
    with csv_path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    markdown_path.write_text("\n".join(_markdown(results)) + "\n", encoding="utf-8")
    return csv_path, markdown_path


def _csv_row(result: CaseResult) -> dict[str, str]:
    row = {"case": result.name, "problem": result.problem, "note": result.note}
    if result.problem:
        return row
    row |= {
        "sweeps": str(result.sweeps),
        "path_m": repr(result.path),
        "ate_m": repr(result.ate),
        "targets": "; ".join(map(str, result.verdicts)),
        "ratio_to_kiss_icp": repr(result.ratio),
        "edge_points": str(result.map_points[0]),
        "plane_points": str(result.map_points[1]),
    }
    row |= {f"frames_{status}": str(count) for status, count in result.statuses.items()}
    for stage, (median, tail) in result.stages.items():
        row |= {f"{stage}_ms_median": repr(median), f"{stage}_ms_95": repr(tail)}
    for peer in result.peers:
        row |= {f"ate_m {peer.label}": repr(peer.ate), f"ms_median {peer.label}": repr(peer.ms)}
    return row


def _markdown(results: Sequence[CaseResult]) -> Iterator[str]:
    yield "# Benchmarks\n\nAfter this page you know how accurate and how fast every case is."
    yield "Made by `python -m benchmarks`; also as [CSV](benchmarks.csv).\n"
    yield "; ".join(f"{name} {value}" for name, value in machine()) + "."
    for paragraph in _EXPLANATION:
        yield f"\n{paragraph}"
    for table in tables(results):
        yield f"\n**{table.title}**\n"
        rows = ([cell.replace("|", "/") for cell in row] for row in table.rows)
        yield from markdown_table(table.header, rows)
    yield "\n**Notes**\n"
    for result in results:
        if result.note:
            yield f"- {result.name}: {result.note}."


def _times(result: CaseResult, stage: str) -> str:
    if stage not in result.stages:
        return "-"
    return "{:.1f} ({:.1f})".format(*result.stages[stage])


def _number(value: float, digits: int) -> str:
    return "-" if value != value else f"{value:.{digits}f}"
