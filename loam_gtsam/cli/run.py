"""The commands ``run`` and ``demo``: map a data set, write the results, print the summary."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import typer
from rich.console import Console

from loam_gtsam.cli import console
from loam_gtsam.cli.options import RunOptions
from loam_gtsam.cli.refine import refine_folder
from loam_gtsam.cli.report import profile_table, summary
from loam_gtsam.cli.results import RUN_OUTPUTS, Results, is_complete
from loam_gtsam.config import Config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.io.atomic import file_name
from loam_gtsam.io.checkpoint import Checkpoint
from loam_gtsam.pipeline import Observer, Pipeline, run
from loam_gtsam.types import DatasetError, MapUpdate, Sweep
from loam_gtsam.view import plots
from loam_gtsam.view.observers import LastFrame, record, watch

CHECKPOINT = "checkpoint"  # folder among the results, until they are complete
_WORTH_A_PROCESS = 200  # sweeps, by which a process has saved the second that it takes to start


def execute(dataset: Dataset, config: Config, options: RunOptions) -> int:
    """Run, write the results, print the summary; returns the exit code.

    An error that ends the run early is raised after the results up to there were written.
    """
    asked = {
        "loops.enabled": options.loops,
        "aiding.gnss": options.gnss,
        "aiding.wheels": options.wheels,
    }
    config = config.changed({key: True for key, on in asked.items() if on})
    plot = console.draws_pictures(options.plot)
    wanted = options.output or Path("loam_gtsam_output") / file_name(dataset.name)
    total = len(dataset) if options.frames is None else min(len(dataset), options.frames)
    last = LastFrame()
    known, overwrite = (*RUN_OUTPUTS, CHECKPOINT), options.overwrite or options.resume
    with console.output_folder(wanted, known, overwrite=overwrite) as folder:
        if options.resume and is_complete(folder, config, dataset, total):
            if not options.quiet:
                typer.echo(f"{folder}: complete, {total} sweeps")
            return 0
        checkpoint: Checkpoint | None = None
        if options.checkpoint > 0.0:
            place = folder / CHECKPOINT
            checkpoint = Checkpoint(place, seconds=options.checkpoint, resume=options.resume)
        started = time.perf_counter()
        # The bag is closed when the results are written: an error there must not cost them.
        with console.stop_requests() as stop, _observers(options, config, last) as observe:
            with console.frame_progress(dataset.name, total, stop, quiet=options.quiet) as on_frame:
                result = run(
                    dataset,
                    config,
                    max_frames=options.frames,
                    on_frame=on_frame,
                    keep_partial=True,
                    observe=observe,
                    workers=worker_count(options.workers, total),
                    checkpoint=checkpoint,
                    **options.parts(config),
                )
            seconds = time.perf_counter() - started
            if not result.updates:
                raise DatasetError(f"{dataset.name}: no sweeps in it; see loam-gtsam inspect")
            done = len(result.updates)
            whole = options.frames is None or not done == options.frames < len(dataset)
            results = Results.of(result, dataset, last if plot else None, whole=whole)
            files = console.write_results(folder, RUN_OUTPUTS, "summary.json", results.write)
            ended = not result.interrupted and result.error is None
            if checkpoint is not None and ended and (whole or not options.resume):
                checkpoint.remove()
    if not options.quiet:
        if options.profile:
            Console().print(profile_table(result.updates))
        problems = results.info.problems
        Console().print(summary(result, dataset.name, seconds, results.accuracy, problems))
        console.print_written(stop, len(result.updates), total, folder, files)
        _print_hints(options, folder, stop)
    if options.refine and ended and any(update.status.solved for update in result.updates):
        refine_folder(folder, dataset, plot=plot, overwrite=True, quiet=options.quiet)
    nothing = f"{dataset.name}: none of the {len(result.updates)} sweeps could be used"
    return console.exit_code(result.error, stop, result.updates, nothing)


def worker_count(asked: int | None, sweeps: int) -> int:
    """Processes for feature extraction; if ``asked`` is None, one if it is worth its start."""
    worth_it = sweeps > _WORTH_A_PROCESS and (os.cpu_count() or 1) > 1
    return int(worth_it) if asked is None else asked


@contextmanager
def _observers(options: RunOptions, config: Config, last: LastFrame) -> Iterator[Observer]:
    with ExitStack() as stack:
        observers: list[Observer] = [last.observe]
        if options.view or options.rrd is not None:
            from loam_gtsam.view.rerun_viewer import RerunViewer

            viewer = RerunViewer(options.rrd, window=options.view, overwrite=options.overwrite)
            observers.append(watch(stack.enter_context(viewer)))
        if options.bag is not None:
            from loam_gtsam.ros.bag_writer import BagWriter

            bag = BagWriter(options.bag, config.bag, overwrite=options.overwrite)
            observers.append(record(stack.enter_context(bag)))

        def observe(sweep: Sweep, update: MapUpdate, pipeline: Pipeline) -> None:
            for observer in observers:
                observer(sweep, update, pipeline)

        yield observe


def _print_hints(options: RunOptions, folder: Path, stop: console.StopRequest) -> None:
    bag, rrd = options.bag, options.rrd
    if options.plot is None and not plots.available():
        typer.echo('No pictures without matplotlib: pip install "loam_gtsam[plot]"')
    if stop.signum is not None and options.checkpoint > 0.0 and not (bag or rrd):
        typer.echo(f"To go on: the same command with --output {folder} --resume")
    if bag is not None and bag.exists():
        typer.echo(f"Bag written to {bag}")
    if rrd is not None and rrd.exists():
        typer.echo(f"Recording written to {rrd}; look at it with: rerun {rrd}")
