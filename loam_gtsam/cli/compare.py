"""The command ``compare``: run the solvers, print the tables, write files, pictures and report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from loam_gtsam.cli import console
from loam_gtsam.cli.options import CompareOptions
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.io.atomic import file_name
from loam_gtsam.pipeline import OnFrame
from loam_gtsam.studies import comparison_report as report
from loam_gtsam.studies import same_matches
from loam_gtsam.studies.comparison import compare_solvers
from loam_gtsam.studies.contenders import Contender
from loam_gtsam.studies.report_html import TextTable
from loam_gtsam.types import ConfigError, MapUpdate


def execute(options: CompareOptions) -> int:
    """Compare the contenders, write the results and print the tables; returns the exit code.

    An error that ends the comparison early is raised after the results up to there were written.
    """
    contenders, dataset = options.contenders(), options.dataset()
    name, plot = dataset.name, console.draws_pictures(options.plot)
    kind = "same_matches" if options.same_matches else "compare"
    wanted = options.output or Path("loam_gtsam_output") / f"{file_name(name)}_{kind}"
    known = (*report.TABLE_FILES, *report.PICTURES, report.TRUTH_FILE, *same_matches.FILES)
    total = len(dataset) if options.frames is None else min(len(dataset), options.frames)
    with (
        console.output_folder(wanted, known, overwrite=options.overwrite) as folder,
        console.stop_requests() as stop,
    ):
        started = time.perf_counter()
        with console.frame_progress(name, total, stop, quiet=options.quiet) as on_frame:
            done = _compare(options, dataset, contenders, on_frame, plot)
        seconds = time.perf_counter() - started
        # Files of an earlier comparison, also those of solvers that did not run this time.
        old = (path.name for kind in report.TRAJECTORIES for path in folder.glob(f"{kind}*.tum"))
        files = console.write_results(folder, (*known, *old), report.REPORT_FILE, done.write)
    if not options.quiet:
        Console().print(done.shown(f"{name}  ({seconds:.1f} s)"))
        console.print_written(stop, done.frames, total, folder, files)
    nothing = f"{name}: no solver could use any of the {done.frames} sweeps"
    return console.exit_code(done.error, stop, done.updates, nothing)


@dataclass(frozen=True, slots=True)
class _Done:
    """A comparison of either kind: how it is written and shown."""

    write: Callable[[Path], list[str]]
    shown: Callable[[str], Group]  # with a title
    frames: int
    error: Exception | None
    updates: Sequence[MapUpdate]


def _compare(
    options: CompareOptions,
    dataset: Dataset,
    contenders: Sequence[Contender],
    on_frame: OnFrame,
    plot: bool,
) -> _Done:
    if options.driver and not options.same_matches:
        raise ConfigError("--driver: it leads --same-matches, which is not given")
    if options.same_matches:
        updates: list[MapUpdate] = []

        def keep(number: int, update: MapUpdate) -> None:
            updates.append(update)
            on_frame(number, update)

        same = same_matches.compare_on_same_matches(
            dataset,
            contenders,
            driver=options.driver or "",
            max_frames=options.frames,
            on_frame=keep,
        )
        write = partial(same_matches.write_same_matches, same)
        return _Done(write, partial(_solves, same), len(updates), same.error, updates)
    comparison = compare_solvers(
        dataset,
        contenders,
        max_frames=options.frames,
        shared_guess=options.shared_guess,
        on_frame=on_frame,
    )
    results = report.ScoredComparison.of(comparison)
    updates = [update for run in comparison.runs for update in run.updates]
    write = partial(report.write_comparison, results, plot=plot)
    shown = partial(_summary, results)
    return _Done(write, shown, comparison.frames, comparison.error, updates)


def _solves(results: same_matches.SameMatches, title: str) -> Group:
    table = same_matches.table_of(results)
    # Solvers side by side: there are more numbers than a terminal has room for in a line.
    columns = [row[0] for row in table.rows]
    turned = [list(cells) for cells in zip(table.header, *table.rows, strict=True)]
    shown = _table(TextTable(["", *columns], turned[1:]), title)
    return Group(shown, Text(f"  {same_matches.sentence_of(results)}", style="dim"))


def _summary(results: report.ScoredComparison, title: str) -> Group:
    first = results.comparison.runs[0].name
    tables: list[Table | Text] = []
    for columns in report.TABLES.values():  # one table would not fit a terminal of 80 columns
        table = report.score_table(results, columns)
        tables.append(_table(table, title))
        title = ""
    tables += [Text(f"  {text}", style="dim") for text in table.sections.values()]
    if results.differences:
        tables.append(_table(report.difference_table(results), f"Difference from {first}"))
    return Group(*tables, *(Text(f"  {note}", style="dim") for note in results.notes))


def _table(table: TextTable, title: str = "") -> Table:
    shown = console.number_table(table.header[0], title, table.header[1:])
    for number, row in enumerate(table.rows):
        styles = ("bold green" if (number, n) in table.best else "" for n in range(len(row)))
        shown.add_row(*map(Text, row, styles))
    return shown
