"""The command ``compare``: run the solvers, print the tables, write files, pictures and report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from loam_gtsam.cli.console import (
    draws_pictures,
    file_name,
    frame_progress,
    output_folder,
    print_written,
    stop_requests,
    write_results,
)
from loam_gtsam.cli.options import CompareOptions
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.studies.comparison import compare_solvers
from loam_gtsam.studies.comparison_report import (
    ACCURACY_COLUMNS,
    COLUMNS,
    PICTURES,
    REPORT_FILE,
    TABLE_FILES,
    TRUTH_FILE,
    ScoredComparison,
    difference_table,
    score_table,
    write_comparison,
)
from loam_gtsam.studies.contenders import Contender
from loam_gtsam.studies.report_html import TextTable
from loam_gtsam.types import DatasetError


def execute(dataset: Dataset, contenders: Sequence[Contender], options: CompareOptions) -> int:
    """Compare the solvers, write the results and print the tables; returns the exit code.

    Raises
    ------
    LoamError
        If the comparison cannot start or its results cannot be written. An error that ended the
        comparison early is raised after the results up to there were written.
    """
    plot = draws_pictures(options.plot)
    wanted = options.output or Path("loam_gtsam_output") / f"{file_name(dataset.name)}_compare"
    known = (*TABLE_FILES, *PICTURES, REPORT_FILE, TRUTH_FILE)
    total = len(dataset) if options.frames is None else min(len(dataset), options.frames)
    with (
        output_folder(wanted, known, overwrite=options.overwrite) as folder,
        stop_requests() as stop,
    ):
        started = time.perf_counter()
        with frame_progress(dataset.name, total, stop, quiet=options.quiet) as on_frame:
            comparison = compare_solvers(
                dataset,
                contenders,
                max_frames=options.frames,
                shared_guess=options.shared_guess,
                on_frame=on_frame,
            )
        seconds = time.perf_counter() - started
        results = ScoredComparison.of(comparison)
        # Files of an earlier comparison, also those of solvers that did not run this time.
        left = (*known, *(path.name for path in folder.glob("trajectory_*.tum")))
        files = write_results(
            folder, left, REPORT_FILE, lambda new: write_comparison(results, new, plot)
        )
    if not options.quiet:
        console = Console()
        console.print(_summary(results, seconds))
        print_written(console, stop, comparison.frames, total, folder, files)
    if comparison.error is not None:
        raise comparison.error
    if stop.signum is not None:
        return 128 + stop.signum
    if not any(u.status.usable for run in comparison.runs for u in run.updates):
        message = next((u.message for u in comparison.runs[0].updates if u.message), "")
        raise DatasetError(
            f"{dataset.name}: no solver could use any of the {comparison.frames} sweeps; the "
            f"first: {message}; see also: loam-gtsam inspect"
        )
    return 0


def _summary(results: ScoredComparison, seconds: float) -> Group:
    first = results.comparison.runs[0].name
    # Two tables, accuracy and cost: one table would not fit a terminal of 80 columns.
    accuracy = score_table(results, COLUMNS[:ACCURACY_COLUMNS])
    cost = score_table(results, COLUMNS[ACCURACY_COLUMNS:])
    tables = [_table(accuracy, f"{results.comparison.name}  ({seconds:.1f} s)"), _table(cost)]
    if results.differences:
        tables.append(_table(difference_table(results), f"Difference from {first}"))
    return Group(*tables, *(Text(f"  {note}", style="dim") for note in results.notes))


def _table(table: TextTable, title: str | None = None) -> Table:
    heading = None if title is None else Text(title, style="bold")
    shown = Table(table.header[0], title=heading, title_justify="left", box=None)
    for name in table.header[1:]:
        shown.add_column(Text(name), justify="right")
    for number, row in enumerate(table.rows):
        styles = ("bold green" if (number, n) in table.best else "" for n in range(len(row)))
        shown.add_row(*map(Text, row, styles))
    return shown
