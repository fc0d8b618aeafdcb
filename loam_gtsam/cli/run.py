"""One run from the command line: output folder, progress, signals, files, summary."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from loam_gtsam.cli.report import NOT_MAPPED, profile_table, summary
from loam_gtsam.config import Config, dump_config
from loam_gtsam.datasets.base import Dataset, DatasetInfo
from loam_gtsam.io.atomic import make_folder, staged_files
from loam_gtsam.io.checkpoint import Checkpoint
from loam_gtsam.io.run_files import RUN_FILES, write_run
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.loops.files import write_graph
from loam_gtsam.pipeline import Observer, OnFrame, Pipeline, RunResult, effective_config, run
from loam_gtsam.studies.evaluation import absolute_error, align, align_rotations, interpolate
from loam_gtsam.types import DatasetError, LoamError, MapUpdate, OutputError, Sweep, Trajectory
from loam_gtsam.view import frame_plot
from loam_gtsam.view import plots as visualization
from loam_gtsam.view.observers import LastFrame, watch

FRAME_PLOT = "frame.png"
PLOT_FILES = ("trajectory.png", "map.png", FRAME_PLOT, "timings.png")
ERROR_PLOT = "errors.png"
TRUTH_FILE = "truth.tum"
LOOP_FILES = ("odometry.tum", "pose_graph.g2o")
RUN_OUTPUTS = (*RUN_FILES, *PLOT_FILES, ERROR_PLOT, *LOOP_FILES, TRUTH_FILE)
CHECKPOINT = "checkpoint"
"""Folder among the results, until they are complete."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_WORTH_A_PROCESS = 200
"""Sweeps by which a process has saved the second that it takes to start."""
_SHOW_CURSOR = b"\x1b[?25h"


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options that ``run`` and ``demo`` share; see their help."""

    frames: int | None
    output: Path | None
    overwrite: bool
    plot: bool | None
    profile: bool
    quiet: bool
    bag: Path | None = None
    workers: int | None = None
    resume: bool = False
    checkpoint_seconds: float = 60.0
    view: bool = False
    rrd: Path | None = None


def execute(dataset: Dataset, config: Config, options: RunOptions) -> int:
    """Run, write, report; returns the exit code.

    Raises
    ------
    LoamError
        If the run cannot start or its results cannot be written, or what ended the run early
        (after what was computed until then has been written).
    """
    plot = visualization.available() if options.plot is None else options.plot
    if plot and not visualization.available():
        raise OutputError('--plot needs matplotlib: pip install "loam_gtsam[plot]"')
    wanted = options.output or Path("loam_gtsam_output") / file_name(dataset.name)
    total = len(dataset) if options.frames is None else min(len(dataset), options.frames)
    if not options.resume:
        wanted = free_folder(wanted, options.overwrite, (*RUN_OUTPUTS, CHECKPOINT))
    is_new = not wanted.exists()
    folder = make_folder(wanted)
    if options.resume and _complete(folder, config, dataset, total):
        Console(quiet=options.quiet).print(
            f"{folder}: complete, {total} sweeps", markup=False, soft_wrap=True
        )
        return 0
    checkpoint = None
    if options.checkpoint_seconds > 0.0:
        place = folder / CHECKPOINT
        checkpoint = Checkpoint(place, seconds=options.checkpoint_seconds, resume=options.resume)
    last = LastFrame()
    with (
        no_empty_folder(folder, is_new),
        stop_requests() as stop,
        _observers(options, config, last) as observe,
    ):
        started = time.perf_counter()
        with frame_progress(dataset.name, total, stop, options.quiet) as on_frame:
            result = run(
                dataset,
                config,
                max_frames=options.frames,
                on_frame=on_frame,
                keep_partial=True,
                observe=observe,
                workers=_workers(options, total),
                checkpoint=checkpoint,
            )
        seconds = time.perf_counter() - started
        if not result.updates:
            raise DatasetError(
                f"{dataset.name}: no sweeps in it; see what is understood with: loam-gtsam inspect"
            )
        accuracy, truth = compare(result.trajectory, dataset.truth)
        info = _input_info(dataset)
        folder, files = _write_somewhere(
            folder,
            lambda there: _write(
                result, dataset, info, there, last if plot else None, accuracy, truth
            ),
        )
        if checkpoint is not None and not result.interrupted and result.error is None:
            checkpoint.remove()
    if not options.quiet:
        console = Console()
        if options.profile:
            console.print(profile_table(result.updates))
        console.print(summary(result, dataset.name, seconds, accuracy, info.problems))
        say_written(console, stop, len(result.updates), total, folder, files)
        if not plot and options.plot is None:
            text = 'No pictures without matplotlib: pip install "loam_gtsam[plot]"'
            console.print(text, markup=False, soft_wrap=True)
        if stop.signum is not None and checkpoint is not None and not (options.bag or options.rrd):
            text = f"To go on: the same command with --output {folder} --resume"
            console.print(text, markup=False, soft_wrap=True)
        if options.bag is not None and options.bag.exists():
            console.print(f"Bag written to {options.bag}", markup=False, soft_wrap=True)
        if options.rrd is not None and options.rrd.exists():
            text = f"Recording written to {options.rrd}; look at it with: rerun {options.rrd}"
            console.print(text, markup=False, soft_wrap=True)
    if result.error is not None:
        raise result.error
    if stop.signum is not None:
        return 128 + stop.signum
    if all(update.status in NOT_MAPPED for update in result.updates):
        raise DatasetError(
            f"{dataset.name}: none of the {len(result.updates)} sweeps could be used; the first: "
            f"{result.updates[0].message}; see also: loam-gtsam inspect"
        )
    return 0


def _complete(folder: Path, config: Config, dataset: Dataset, total: int) -> bool:
    """Whether the run is done, and its results are in the folder.

    Raises
    ------
    OutputError
        If those of another run are.
    """
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        written = (folder / "config.yaml").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return False
    if summary.get("interrupted") or summary.get("error"):
        return False
    now = total, _described(_input_info(dataset)), dump_config(effective_config(config, dataset))
    if (summary.get("frames"), summary.get("dataset"), written) != now:
        raise OutputError(
            f"{folder}: holds the results of another run (data, configuration or number of "
            "sweeps); choose another folder, or --overwrite without --resume"
        )
    return True


def _write_somewhere(folder: Path, write: Callable[[Path], list[str]]) -> tuple[Path, list[str]]:
    """Write the results; if it cannot be done there, elsewhere, for they took long to compute.

    Returns
    -------
    Where they are, and their names.

    Raises
    ------
    OutputError
        If they could not be written where they were wanted, saying where they are instead.
    """
    try:
        return folder, write(folder)
    except OutputError as error:
        problem = error
    while sys.stdin.isatty() and sys.stderr.isatty():
        typer.echo(f"{problem}", err=True)
        answer = typer.prompt("Another folder for the results (empty: none)", "", err=True)
        if not answer:
            break
        try:
            there = make_folder(free_folder(Path(answer), False))
            return there, write(there)
        except OutputError as error:
            problem = error
    try:
        there = Path(tempfile.mkdtemp(prefix=f"loam_gtsam_{folder.name}_"))
        write(there)
    except (OSError, OutputError):
        raise problem from None
    raise OutputError(f"{problem}. The results were written to {there} instead")


def _workers(options: RunOptions, sweeps: int) -> int:
    """Processes for feature extraction: unless asked for, one if it is worth its start."""
    if options.workers is not None:
        return options.workers
    return int(sweeps > _WORTH_A_PROCESS and (os.cpu_count() or 1) > 1)


@contextmanager
def _observers(options: RunOptions, config: Config, last: LastFrame) -> Iterator[Observer]:
    """What takes every frame: the bag and the viewer, if they were asked for, and ``last``."""
    with ExitStack() as stack:
        observers: list[Observer] = [last.observe]
        if options.view or options.rrd is not None:
            from loam_gtsam.view.rerun_viewer import RerunViewer

            viewer = RerunViewer(options.rrd, window=options.view, overwrite=options.overwrite)
            observers.append(watch(stack.enter_context(viewer)))
        if options.bag is not None:
            from loam_gtsam.ros.bag_writer import BagWriter
            from loam_gtsam.view.clouds import record

            bag = BagWriter(options.bag, config.bag, overwrite=options.overwrite)
            observers.append(record(stack.enter_context(bag)))

        def observe(sweep: Sweep, update: MapUpdate, pipeline: Pipeline) -> None:
            for observer in observers:
                observer(sweep, update, pipeline)

        yield observe


@contextmanager
def no_empty_folder(folder: Path, is_new: bool) -> Iterator[None]:
    """Remove a folder made for a run that ends with an error before it wrote anything."""
    try:
        yield
    except BaseException:
        if is_new:
            with suppress(OSError):  # it is not empty
                folder.rmdir()
        raise


def free_folder(wanted: Path, overwrite: bool, known: Sequence[str] = RUN_OUTPUTS) -> Path:
    """``wanted``, or, if that holds a run that must not be replaced, a new folder beside it."""
    if overwrite or not any((wanted / name).exists() for name in known):
        return wanted
    wanted = wanted if wanted.name not in ("", "..") else wanted.resolve()
    candidates = (wanted.with_name(f"{wanted.name}-{n}") for n in itertools.count(2))
    return next(folder for folder in candidates if not folder.exists())


def compare(
    trajectory: Trajectory, truth: Trajectory | None
) -> tuple[dict[str, Any], Trajectory | None]:
    """Accuracy for the summary, and the truth in the map frame for the picture."""
    if truth is None:
        return {}, None
    try:
        error = absolute_error(trajectory, truth)
    except ValueError as problem:  # no overlap in time, or stamps of the truth that repeat
        return {"problem": str(problem)}, None
    there = interpolate(truth, error.stamps)
    inside = (trajectory.stamps >= truth.stamps[0]) & (trajectory.stamps <= truth.stamps[-1])
    here = trajectory.map_T_lidar[inside]
    turn = align_rotations(there.map_T_lidar[:, :3, :3], here[:, :3, :3])
    map_T_truth = align(there.map_T_lidar[:, :3, 3], here[:, :3, 3], turn)
    accuracy = {
        "ate_rmse_m": error.rmse,
        "ate_max_m": error.maximum,
        "compared_poses": len(error.stamps),
        "compared_length_m": there.path_length,
    }
    return accuracy, Trajectory(there.stamps, map_T_truth @ there.map_T_lidar)


def _input_info(dataset: Dataset) -> DatasetInfo:
    """What is known of the input after the run; must not cost the results if it is damaged."""
    try:
        return dataset.info()
    except LoamError as error:
        return DatasetInfo("data set", dataset.name, problems=[str(error)])


def _described(info: DatasetInfo) -> str:
    return f"{info.kind} {info.path}"


def _write(
    result: RunResult,
    dataset: Dataset,
    info: DatasetInfo,
    folder: Path,
    drawn: LastFrame | None,
    accuracy: dict[str, Any],
    truth: Trajectory | None,
) -> list[str]:
    """Write all files, with pictures if ``drawn`` is given; names of what was written."""
    extra = {"accuracy": accuracy or None, "input": asdict(info)}
    files = list(RUN_FILES)
    with staged_files(folder, RUN_OUTPUTS, last="summary.json") as new:
        write_run(result, new, dataset=_described(info), extra=extra)
        if dataset.truth is not None:
            write_tum(new / TRUTH_FILE, dataset.truth)
            files.append(TRUTH_FILE)
        if result.loops is not None:
            write_tum(new / LOOP_FILES[0], result.odometry, comments={"frame": "odom"})
            write_graph(new / LOOP_FILES[1], result.loops.graph.saved())
            files.extend(LOOP_FILES)
        if drawn is not None:
            files.extend(_draw(result, dataset, new, drawn, truth))
    return files


def _draw(
    result: RunResult, dataset: Dataset, folder: Path, last: LastFrame, truth: Trajectory | None
) -> list[str]:
    """Draw all pictures; their names."""
    files = [name for name in PLOT_FILES if name != FRAME_PLOT or last.seen]
    trajectory = result.trajectory
    loops = None if result.loops is None else result.loops.ends()
    visualization.plot_trajectory(folder / "trajectory.png", trajectory, truth, loops)
    visualization.plot_map(folder / "map.png", result.edge_points, result.plane_points, trajectory)
    if last.seen:
        frame_plot.plot_frame(folder / FRAME_PLOT, last.frame(), last.around())
    visualization.plot_timings(folder / "timings.png", result.updates)
    if truth is not None and dataset.truth is not None:
        error = absolute_error(trajectory, dataset.truth)
        visualization.plot_errors(folder / ERROR_PLOT, error.stamps, error.translations)
        files.append(ERROR_PLOT)
    return files


@dataclass(slots=True)
class StopRequest:
    """The signal that asked the run to stop, if one did."""

    signum: int | None = None


def say_written(
    console: Console, stop: StopRequest, frames: int, total: int, folder: Path, files: list[str]
) -> None:
    """The last lines of a run: whether it was stopped, and where its files are."""
    if stop.signum is not None:
        name = signal.Signals(stop.signum).name
        done = f"after frame {frames} of {total}"
        console.print(f"Stopped by {name} {done}; what was computed until then is written.")
    console.print(f"Written to {folder}: {', '.join(files)}", markup=False, soft_wrap=True)


@contextmanager
def stop_requests() -> Iterator[StopRequest]:
    """Note the first Ctrl-C or SIGTERM instead of acting on it; the second ends the process.

    An exception raised by a signal could surface anywhere, a solver's callback included, and
    leave half a frame in the map. A note can be read between two frames.
    """
    stop = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread may set handlers
        return

    def note(signum: int, frame: FrameType | None) -> None:
        stop.signum = signum
        # The system's own action needs no interpreter: it ends a long native call as well.
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        if sys.stderr.isatty():
            # Unbuffered, for a signal may arrive in the middle of a buffered write.
            os.write(sys.stderr.fileno(), _SHOW_CURSOR)

    before = {number: signal.getsignal(number) for number in _SIGNALS}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, note)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def frame_progress(name: str, total: int, stop: StopRequest, quiet: bool) -> Iterator[OnFrame]:
    """A progress bar on stderr; gives the function to call after each frame."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[status]}", style="dim"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task(name, total=total, rate="", status="")
        started, done = time.perf_counter(), 0

        def on_frame(number: int, update: MapUpdate) -> None:
            nonlocal done
            done += 1  # not number + 1: a run that goes on begins in the middle
            rate = done / (time.perf_counter() - started)
            bar.update(
                task, completed=number + 1, rate=f"{rate:.1f} frames/s", status=str(update.status)
            )
            if stop.signum is not None:
                raise KeyboardInterrupt  # run() ends here, between two frames

        yield on_frame


def file_name(name: str) -> str:
    """A name of a data set as that of a file or folder."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._") or "run"
