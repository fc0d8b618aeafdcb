"""The command ``study``: run the trials that are missing, show progress, write the table."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from loam_gtsam.cli.console import file_name, progress_bar, stop_requests
from loam_gtsam.cli.options import StudyOptions
from loam_gtsam.io.atomic import make_folder
from loam_gtsam.studies.trial_runner import (
    ClusterWorkers,
    LocalWorkers,
    cluster_workers,
    local_workers,
    run_here,
    run_on,
)
from loam_gtsam.studies.trial_spec import Spec, load_spec
from loam_gtsam.studies.trial_table import (
    TABLE_FILE,
    TRIALS_FOLDER,
    TrialStore,
    import_pyarrow,
    write_table,
)
from loam_gtsam.studies.trials import Row, Trial

_SHOWN_ERRORS = 3


def execute(path: Path, options: StudyOptions) -> int:
    """Run the trials that are not finished, write the table and a summary; returns the exit code.

    Raises
    ------
    LoamError
        If the study cannot start, a result cannot be written, or the cluster is lost.
    """
    import_pyarrow()
    spec = load_spec(path)
    folder = options.output or Path("loam_gtsam_output") / f"{file_name(spec.name)}_study"
    make_folder(folder / TRIALS_FOLDER)
    store = TrialStore(folder)
    missing = [trial for trial in _different(spec.trials) if _must_run(store.load(trial), options)]
    with stop_requests() as stop:
        try:
            with (
                _rows(missing, options, lambda: stop.signum is not None) as rows,
                _progress(spec.name, len(missing), options.quiet) as count,
            ):
                for done in rows:
                    store.save(done)
                    count(done)
        except KeyboardInterrupt:
            pass
        finally:  # also after an error: the finished trials are worth a table
            found = [row for row in map(store.load, spec.trials) if row is not None]
            write_table(folder / TABLE_FILE, found, spec)
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


def _different(trials: Sequence[Trial]) -> list[Trial]:
    """Each computation once: two names may stand for the same configuration."""
    return list({trial.id: trial for trial in trials}.values())


def _must_run(found: Row | None, options: StudyOptions) -> bool:
    return found is None or options.overwrite or (options.retry_failed and bool(found["error"]))


@contextmanager
def _rows(
    trials: Sequence[Trial], options: StudyOptions, stopped: Callable[[], bool]
) -> Iterator[Iterator[Row]]:
    """The rows of the trials as they are finished, from where the options have them run."""
    place: AbstractContextManager[LocalWorkers | ClusterWorkers]
    if options.scheduler is not None and trials:
        place = cluster_workers(options.scheduler)
    elif options.workers is not None and trials:
        place = local_workers(min(options.workers, len(trials)))
    else:
        yield run_here(trials, stopped)
        return
    with place as workers:
        yield run_on(workers, trials, stopped)


@contextmanager
def _progress(name: str, total: int, quiet: bool) -> Iterator[Callable[[Row], None]]:
    """A progress bar on stderr, as the function to call after each trial."""
    numbers = itertools.count(1)
    with progress_bar(name, total, quiet=quiet) as show:

        def count(row: Row) -> None:
            end = "failed" if row["error"] else f"{row['wall_s']:.1f} s"
            show(next(numbers), f"{_label(row)}: {end}")

        yield count


def _summary(spec: Spec, rows: Sequence[Row], metric: str) -> Table:
    """Medians over the seeds, one row per sequence and one column per configuration."""
    table = Table("sequence", title=Text(metric, style="bold"), title_justify="left", box=None)
    configs = list(dict.fromkeys(trial.config_name for trial in spec.trials))
    for config in configs:
        table.add_column(Text(config), justify="right")
    for sequence in dict.fromkeys(trial.sequence for trial in spec.trials):
        cells = []
        for config in configs:
            values = [
                row[metric]
                for row in rows
                if (row["sequence"], row["config"]) == (sequence, config)
                and row[metric] is not None
                and not row["error"]
            ]
            cells.append(Text(f"{statistics.median(values):.4g}" if values else "-"))
        table.add_row(Text(sequence), *cells)
    return table


def _print_outcome(
    console: Console, total: int, found: Sequence[Row], failed: Sequence[Row], file: Path
) -> None:
    for row in failed[:_SHOWN_ERRORS]:
        last_line = row["error"].strip().splitlines()[-1]
        console.print(f"  {_label(row)} failed: {last_line}", markup=False, soft_wrap=True)
    if len(failed) > _SHOWN_ERRORS:
        console.print(f"  and {len(failed) - _SHOWN_ERRORS} more; see the column 'error'")
    console.print(f"{len(found)} of {total} trials done, {len(failed)} of them failed")
    if len(found) < total:
        console.print("Stopped; the same command goes on from here.")
    console.print(f"Written to {file}", markup=False, soft_wrap=True)


def _label(row: Row) -> str:
    seed = "" if row["seed"] is None else f", seed {row['seed']}"
    return f"{row['sequence']} x {row['config']}{seed}"
