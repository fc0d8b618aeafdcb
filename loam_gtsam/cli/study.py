"""The command ``study``: run the trials that are missing, show progress, write the table."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from loam_gtsam.cli.console import (
    file_name,
    number_table,
    print_plain,
    progress_bar,
    stop_requests,
)
from loam_gtsam.cli.options import StudyOptions
from loam_gtsam.io.atomic import make_folder
from loam_gtsam.studies.trial_runner import (
    ClusterWorkers,
    LocalWorkers,
    cluster_workers,
    local_workers,
    run_trials,
)
from loam_gtsam.studies.trial_spec import Spec, load_spec
from loam_gtsam.studies.trials import (
    TABLE_FILE,
    TRIALS_FOLDER,
    Row,
    TrialStore,
    import_pyarrow,
    write_table,
)

_SHOWN_ERRORS = 3


def execute(options: StudyOptions) -> int:
    """Run the trials that are not finished, write table and summary; returns the exit code."""
    if options.workers is not None and options.scheduler is not None:
        raise typer.BadParameter("give --workers or --scheduler, not both")
    import_pyarrow()
    spec = load_spec(options.spec)
    folder = options.output or Path("loam_gtsam_output") / f"{file_name(spec.name)}_study"
    make_folder(folder / TRIALS_FOLDER)
    store = TrialStore(folder)
    # Each computation once: two names may stand for the same configuration.
    different = {trial.id: trial for trial in spec.trials}.values()
    missing = [trial for trial in different if _must_run(store.load(trial), options)]
    with stop_requests() as stop:
        try:
            with (
                _workers(options, len(missing)) as workers,
                _progress(spec.name, len(missing), options.quiet) as count,
            ):
                for done in run_trials(missing, lambda: stop.signum is not None, workers):
                    store.save(done)
                    count(done)
        except KeyboardInterrupt:
            pass
        finally:  # also after an error: the finished trials are worth a table
            found = [row for row in map(store.load, spec.trials) if row is not None]
            write_table(folder / TABLE_FILE, found, spec.text, spec.trials)
    failed = [row for row in found if row["error"]]
    if not options.quiet:
        console = Console()
        console.print("Medians over the seeds")
        for metric in spec.metrics:
            console.print(_summary(spec, found, metric))
        _print_outcome(console, len(spec.trials), found, failed, folder / TABLE_FILE)
    if stop.signum is not None:
        return 128 + stop.signum
    return 1 if failed else 0


def _must_run(found: Row | None, options: StudyOptions) -> bool:
    return found is None or options.overwrite or (options.retry_failed and bool(found["error"]))


def _workers(
    options: StudyOptions, count: int
) -> AbstractContextManager[LocalWorkers | ClusterWorkers | None]:
    """Where so many trials run; None stands for this process."""
    if options.scheduler is not None and count:
        return cluster_workers(options.scheduler)
    if options.workers is not None and count:
        return local_workers(min(options.workers, count))
    return nullcontext()


@contextmanager
def _progress(name: str, total: int, quiet: bool) -> Iterator[Callable[[Row], None]]:
    """Show a progress bar; gives the function to call after each trial."""
    numbers = itertools.count(1)

    def count(row: Row) -> None:
        end = "failed" if row["error"] else f"{row['wall_s']:.1f} s"
        show(next(numbers), f"{_label(row)}: {end}")

    with progress_bar(name, total, quiet=quiet) as show:
        yield count


def _summary(spec: Spec, rows: Sequence[Row], metric: str) -> Table:
    """Medians over the seeds, one row per sequence and one column per configuration."""
    configs = list(dict.fromkeys(trial.config_name for trial in spec.trials))
    table = number_table("sequence", metric, configs)
    for sequence in dict.fromkeys(trial.sequence for trial in spec.trials):
        cells = []
        for config in configs:
            values = [
                row[metric]
                for row in rows
                if (row["sequence"], row["config"], row["error"]) == (sequence, config, None)
                and row[metric] is not None
            ]
            cells.append(Text(f"{statistics.median(values):.4g}" if values else "-"))
        table.add_row(Text(sequence), *cells)
    return table


def _print_outcome(
    console: Console, total: int, found: Sequence[Row], failed: Sequence[Row], file: Path
) -> None:
    for row in failed[:_SHOWN_ERRORS]:
        last_line = row["error"].strip().splitlines()[-1]
        print_plain(console, f"  {_label(row)} failed: {last_line}")
    if len(failed) > _SHOWN_ERRORS:
        console.print(f"  and {len(failed) - _SHOWN_ERRORS} more; see the column 'error'")
    console.print(f"{len(found)} of {total} trials done, {len(failed)} of them failed")
    if len(found) < total:
        console.print("Stopped; the same command goes on from here.")
    print_plain(console, f"Written to {file}")


def _label(row: Row) -> str:
    seed = "" if row["seed"] is None else f", seed {row['seed']}"
    return f"{row['sequence']} x {row['config']}{seed}"
