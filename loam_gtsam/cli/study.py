"""The command ``study``: run the trials that are missing, show progress, write the table."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

import typer
from rich.console import Console
from rich.text import Text

from loam_gtsam.cli import console
from loam_gtsam.cli.options import StudyOptions
from loam_gtsam.io.atomic import file_name, make_folder, used_alone, write_text
from loam_gtsam.studies import trial_runner as runner
from loam_gtsam.studies import trials
from loam_gtsam.studies.report_html import TextTable, page, table_html
from loam_gtsam.studies.trial_spec import Spec, load_spec

REPORT_FILE = "report.html"
_SHOWN_ERRORS = 3


def execute(options: StudyOptions) -> int:
    """Run the trials that are not finished, write table and summary; returns the exit code."""
    if options.workers is not None and options.scheduler is not None:
        raise typer.BadParameter("give --workers or --scheduler, not both")
    trials.import_pyarrow()
    spec = load_spec(options.spec)
    folder = options.output or Path("loam_gtsam_output") / f"{file_name(spec.name)}_study"
    make_folder(folder / trials.TRIALS_FOLDER)
    with used_alone(folder):
        return _run_missing(spec, folder, options)


def _run_missing(spec: Spec, folder: Path, options: StudyOptions) -> int:
    """Run the trials whose rows are not in the folder, and write the table of all."""
    store = trials.TrialStore(folder)
    missing = []
    # Each computation once: two names may stand for the same configuration.
    for trial in {trial.id: trial for trial in spec.trials}.values():
        row = store.load(trial)
        if row is None or options.overwrite or (options.retry_failed and row["error"]):
            missing.append(trial)
    with console.stop_requests() as stop:
        try:
            with (
                _workers(options, len(missing)) as workers,
                _progress(spec.name, len(missing), options.quiet) as count,
            ):
                for done in runner.run_trials(missing, lambda: stop.signum is not None, workers):
                    store.save(done)
                    count(done)
        except KeyboardInterrupt:
            pass
        finally:  # also after an error: the finished trials are worth a table
            found = [row for row in map(store.load, spec.trials) if row is not None]
            trials.write_table(folder / trials.TABLE_FILE, found, spec.text, spec.trials)
            _write_page(folder / REPORT_FILE, spec, found)
    failed = [row for row in found if row["error"]]
    if not options.quiet:
        typer.echo("Medians over the seeds")
        for metric in spec.metrics:
            shown = console.number_table("sequence", metric, spec.config_names)
            for name, *cells in _medians(spec, found, metric).rows:
                shown.add_row(Text(name), *map(Text, cells))
            Console().print(shown)
        for row in failed[:_SHOWN_ERRORS]:
            typer.echo(f"  {_label(row)} failed: {row['error'].strip().splitlines()[-1]}")
        if len(failed) > _SHOWN_ERRORS:
            typer.echo(f"  and {len(failed) - _SHOWN_ERRORS} more; see the column 'error'")
        typer.echo(f"{len(found)} of {len(spec.trials)} trials done, {len(failed)} of them failed")
        if len(found) < len(spec.trials):
            typer.echo("Stopped; the same command goes on from here.")
        typer.echo(f"Written to {folder}: {trials.TABLE_FILE}, {REPORT_FILE}")
    if stop.signum is not None:
        return 128 + stop.signum
    return 1 if failed else 0


def _workers(
    options: StudyOptions, count: int
) -> AbstractContextManager[runner.LocalWorkers | runner.ClusterWorkers | None]:
    if options.scheduler is not None and count:
        return runner.cluster_workers(options.scheduler)
    if options.workers is not None and count:
        return runner.local_workers(min(options.workers, count))
    return nullcontext()


@contextmanager
def _progress(name: str, total: int, quiet: bool) -> Iterator[Callable[[trials.Row], None]]:
    """Show a progress bar; gives the function to call after each trial."""
    numbers = itertools.count(1)

    def count(row: trials.Row) -> None:
        end = "failed" if row["error"] else f"{row['wall_s']:.1f} s"
        show(next(numbers), f"{_label(row)}: {end}")

    with console.progress_bar(name, total, quiet=quiet) as show:
        yield count


def _medians(spec: Spec, rows: Sequence[trials.Row], metric: str) -> TextTable:
    """A row for each sequence, a column for each configuration."""
    table = []
    for sequence in dict.fromkeys(trial.sequence for trial in spec.trials):
        cells = []
        for config in spec.config_names:
            wanted = (sequence, config, None)
            found = (r for r in rows if (r["sequence"], r["config"], r["error"]) == wanted)
            values = [row[metric] for row in found if row[metric] is not None]
            cells.append(f"{statistics.median(values):.4g}" if values else "-")
        table.append([sequence, *cells])
    return TextTable(["sequence", *spec.config_names], table)


def _write_page(path: Path, spec: Spec, rows: Sequence[trials.Row]) -> None:
    """All metrics as tables, and what failed."""
    sections = {metric: table_html(_medians(spec, rows, metric)) for metric in spec.metrics}
    failed = [[_label(row), row["error"].strip().splitlines()[-1]] for row in rows if row["error"]]
    if failed:
        sections["Failed"] = table_html(TextTable(["trial", "error"], failed))
    known = ", ".join(
        f"{name.removesuffix('_version')} {version}" for name, version in trials.versions().items()
    )
    intro = [f"{len(rows)} of {len(spec.trials)} trials; medians over the seeds.", known]
    write_text(path, page(f"Study {spec.name}", intro, sections))


def _label(row: trials.Row) -> str:
    seed = "" if row["seed"] is None else f", seed {row['seed']}"
    return f"{row['sequence']} x {row['config']}{seed}"
