"""A sweep over parameters from the command line: what is left to run, progress, table, summary."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from loam_gtsam.cli.console import file_name, progress_bar, stop_requests
from loam_gtsam.cli.options import StudyOptions
from loam_gtsam.io.atomic import make_folder
from loam_gtsam.studies.trial_spec import Spec, load_spec
from loam_gtsam.studies.trial_table import (
    TABLE_FILE,
    TRIALS_FOLDER,
    TrialStore,
    import_pyarrow,
    write_table,
)
from loam_gtsam.studies.trials import Row, Trial
from loam_gtsam.types import OutputError

_SHOWN_ERRORS = 3


def execute(path: Path, options: StudyOptions) -> int:
    """Run what is not finished, write the table, report; returns the exit code.

    Raises
    ------
    LoamError
        If the sweep cannot start, a result cannot be written, or the cluster is lost.
    """
    import_pyarrow()
    spec = load_spec(path)
    folder = options.output or Path("loam_gtsam_output") / f"{file_name(spec.name)}_sweep"
    make_folder(folder / TRIALS_FOLDER)
    store = TrialStore(folder)
    left = [trial for trial in _different(spec.trials) if _is_left(store.load(trial), options)]
    with stop_requests() as stop:
        try:
            with (
                _rows(left, options, lambda: stop.signum is not None) as rows,
                _progress(spec.name, len(left), options.quiet) as count,
            ):
                for done in rows:
                    store.save(done)
                    count(done)
        except KeyboardInterrupt:
            pass
        finally:  # also after an error: what is finished is worth a table
            found = [row for row in map(store.load, spec.trials) if row is not None]
            write_table(folder / TABLE_FILE, found, spec)
    failed = [row for row in found if row["error"]]
    if not options.quiet:
        console = Console()
        console.print("Medians over the seeds")
        for metric in spec.metrics:
            console.print(_summary(spec, found, metric))
        _say(console, len(spec.trials), found, failed, folder / TABLE_FILE)
    if stop.signum is not None:
        return 128 + stop.signum
    return 1 if failed else 0


def _different(trials: Sequence[Trial]) -> list[Trial]:
    """Each computation once, for one configuration may have two names."""
    return list({trial.id: trial for trial in trials}.values())


def _is_left(found: Row | None, options: StudyOptions) -> bool:
    return found is None or options.overwrite or (options.retry_failed and bool(found["error"]))


@contextmanager
def _rows(
    trials: Sequence[Trial], options: StudyOptions, stopped: Callable[[], bool]
) -> Iterator[Iterator[Row]]:
    """The rows of the trials, as they are finished, from wherever they are to run."""
    if not trials:
        yield iter(())
        return
    try:
        from loam_gtsam.studies import trial_runner as experiment_workers
    except ImportError as error:
        raise OutputError(
            f'sweep needs Dask ({error}): pip install "loam_gtsam[cluster]"'
        ) from error
    if options.scheduler is not None:
        place = experiment_workers.cluster_at(options.scheduler)
    elif options.workers is not None:
        place = experiment_workers.local_workers(min(options.workers, len(trials)))
    else:
        yield experiment_workers.run_here(trials, stopped)
        return
    with place as client, closing(experiment_workers.run_on(client, trials, stopped)) as rows:
        yield rows


@contextmanager
def _progress(name: str, total: int, quiet: bool) -> Iterator[Callable[[Row], None]]:
    """A progress bar on stderr; gives the function to call after each trial."""
    numbers = itertools.count(1)
    with progress_bar(name, total, quiet=quiet) as show:

        def count(row: Row) -> None:
            end = "failed" if row["error"] else f"{row['wall_s']:.1f} s"
            show(next(numbers), f"{_label(row)}: {end}")

        yield count


def _summary(spec: Spec, rows: Sequence[Row], metric: str) -> Table:
    """Median over the seeds, a line a sequence, a column a configuration."""
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


def _say(
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
