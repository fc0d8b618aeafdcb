"""The command ``compare``: run the solvers, print the tables, write files, pictures and report."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from loam_gtsam.cli import console
from loam_gtsam.cli.options import CompareOptions
from loam_gtsam.studies import comparison_report as report
from loam_gtsam.studies.comparison import compare_solvers
from loam_gtsam.studies.contenders import Contender, find_contender, solver_names
from loam_gtsam.studies.peers import PEERS
from loam_gtsam.studies.report_html import TextTable


def execute(options: CompareOptions) -> int:
    """Compare the solvers, write the results and print the tables; returns the exit code.

    An error that ends the comparison early is raised after the results up to there were written.
    """
    names = options.solvers or [name for name in solver_names() if name not in PEERS]
    found = map(find_contender, names)
    contenders = [Contender(c.name, c.config and options.changed(c.config)) for c in found]
    dataset = options.dataset()
    name, plot = dataset.name, console.draws_pictures(options.plot)
    wanted = options.output or Path("loam_gtsam_output") / f"{console.file_name(name)}_compare"
    known = (*report.TABLE_FILES, *report.PICTURES, report.REPORT_FILE, report.TRUTH_FILE)
    total = len(dataset) if options.frames is None else min(len(dataset), options.frames)
    with (
        console.output_folder(wanted, known, overwrite=options.overwrite) as folder,
        console.stop_requests() as stop,
    ):
        started = time.perf_counter()
        with console.frame_progress(name, total, stop, quiet=options.quiet) as on_frame:
            comparison = compare_solvers(
                dataset,
                contenders,
                max_frames=options.frames,
                shared_guess=options.shared_guess,
                on_frame=on_frame,
            )
        seconds = time.perf_counter() - started
        results = report.ScoredComparison.of(comparison)
        # Files of an earlier comparison, also those of solvers that did not run this time.
        left = (*known, *(path.name for path in folder.glob("trajectory_*.tum")))
        write = partial(report.write_comparison, results, plot=plot)
        files = console.write_results(folder, left, report.REPORT_FILE, write)
    if not options.quiet:
        Console().print(_summary(results, seconds))
        console.print_written(stop, comparison.frames, total, folder, files)
    updates = [update for run in comparison.runs for update in run.updates]
    nothing = f"{name}: no solver could use any of the {comparison.frames} sweeps"
    return console.exit_code(comparison.error, stop, updates, nothing)


def _summary(results: report.ScoredComparison, seconds: float) -> Group:
    first = results.comparison.runs[0].name
    # Two tables, accuracy and cost: one table would not fit a terminal of 80 columns.
    accuracy = report.score_table(results, report.COLUMNS[: report.ACCURACY_COLUMNS])
    cost = report.score_table(results, report.COLUMNS[report.ACCURACY_COLUMNS :])
    tables = [_table(accuracy, f"{results.comparison.name}  ({seconds:.1f} s)"), _table(cost)]
    if results.differences:
        tables.append(_table(report.difference_table(results), f"Difference from {first}"))
    return Group(*tables, *(Text(f"  {note}", style="dim") for note in results.notes))


def _table(table: TextTable, title: str = "") -> Table:
    shown = console.number_table(table.header[0], title, table.header[1:])
    for number, row in enumerate(table.rows):
        styles = ("bold green" if (number, n) in table.best else "" for n in range(len(row)))
        shown.add_row(*map(Text, row, styles))
    return shown
