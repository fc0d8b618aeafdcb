"""What the commands share: output folders, Ctrl-C, progress bars, the last lines."""

from __future__ import annotations

import itertools
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from loam_gtsam.io.atomic import make_folder, staged_files, used_alone
from loam_gtsam.pipeline import OnFrame
from loam_gtsam.types import DatasetError, MapUpdate, OutputError
from loam_gtsam.view import plots

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def output_folder(wanted: Path, known: Sequence[str], *, overwrite: bool) -> Iterator[Path]:
    """Make the folder for results, and remove it if an error leaves it empty.

    If ``wanted`` holds any of the ``known`` results, a new folder beside it is made (``wanted-2``,
    ...), unless ``overwrite`` is given. OutputError if another run uses the folder.
    """
    if not overwrite and any((wanted / name).exists() for name in known):
        wanted = wanted if wanted.name not in ("", "..") else wanted.resolve()
        candidates = (wanted.with_name(f"{wanted.name}-{n}") for n in itertools.count(2))
        wanted = next(folder for folder in candidates if not folder.exists())
    is_new = not wanted.exists()
    try:
        folder = make_folder(wanted)
        with used_alone(folder):
            yield folder
    except BaseException:
        if is_new:
            with suppress(OSError):  # it is not empty, or was not made
                wanted.rmdir()
        raise


def write_results(
    folder: Path, known: Sequence[str], last: str, write: Callable[[Path], list[str]]
) -> list[str]:
    """Replace earlier results by new ones, which took long to compute; returns their names.

    ``write`` writes all files into the folder that it is given, and returns their names; for the
    others see :func:`~loam_gtsam.io.atomic.staged_files`. If that fails, for whatever reason, the
    results, or what can be written of them, go into a temporary folder, which the OutputError
    names.
    """
    try:
        with staged_files(folder, known, last) as new:
            return write(new)
    except Exception as problem:
        told = str(problem) if isinstance(problem, OutputError) else repr(problem)
        try:
            there = Path(tempfile.mkdtemp(prefix=f"loam_gtsam_{folder.name}_"))
        except OSError:
            raise problem from None
        try:
            write(there)
        except Exception:
            if not any(there.iterdir()):
                there.rmdir()
                raise problem from None
            told = f"{told}. What could be written of the results is in {there}"
        else:
            told = f"{told}. The results were written to {there} instead"
        raise OutputError(told) from problem


def draws_pictures(asked: bool | None) -> bool:
    """Whether pictures are drawn; if ``asked`` is None, they are if matplotlib is installed."""
    if asked and not plots.available():
        raise OutputError('--plot needs matplotlib: pip install "loam_gtsam[plot]"')
    return plots.available() if asked is None else asked


@dataclass(slots=True)
class StopRequest:
    """The signal that asked the run to stop, if one did."""

    signum: int | None = None


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
            # The cursor is shown again; unbuffered, for a signal may come in a buffered write.
            os.write(sys.stderr.fileno(), b"\x1b[?25h")

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
def progress_bar(name: str, total: int, *, quiet: bool) -> Iterator[Callable[[int, str], None]]:
    """Show a progress bar on stderr; gives the function that sets it to a number, with a note."""
    console = Console(stderr=True)
    name_column = TextColumn("{task.description}", markup=False)
    note_column = TextColumn("{task.fields[note]}", style="dim", markup=False)
    columns = (name_column, BarColumn(), MofNCompleteColumn(), note_column, TimeRemainingColumn())
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task(name, total=total, note="")

        def show(done: int, note: str) -> None:
            bar.update(task, completed=done, note=note)

        yield show


@contextmanager
def frame_progress(name: str, total: int, stop: StopRequest, *, quiet: bool) -> Iterator[OnFrame]:
    """Show a progress bar of frames; gives the function to call after each frame."""
    started, done = time.perf_counter(), 0
    with progress_bar(name, total, quiet=quiet) as show:

        def on_frame(number: int, update: MapUpdate) -> None:
            nonlocal done
            done += 1  # not number + 1: a run that goes on begins in the middle
            rate = done / (time.perf_counter() - started)
            show(number + 1, f"{rate:.1f} frames/s {update.status}")
            if stop.signum is not None:
                raise KeyboardInterrupt  # run() ends here, between two frames

        yield on_frame


def exit_code(
    error: Exception | None, stop: StopRequest, updates: Sequence[MapUpdate], nothing: str
) -> int:
    """The exit code after the results were written; raises what ended the command early.

    If no frame was usable, that is a DatasetError: ``nothing``, and the first problem.
    """
    if error is not None:
        raise error
    if stop.signum is not None:
        return 128 + stop.signum
    if not any(update.status.usable for update in updates):
        first = next((update.message for update in updates if update.message), "")
        raise DatasetError(f"{nothing}; the first: {first}; see also: loam-gtsam inspect")
    return 0


def number_table(first: str, title: str, columns: Sequence[str]) -> Table:
    """An empty table of numbers, with a column of names called ``first``."""
    heading = Text(title, style="bold") if title else None
    table = Table(first, title=heading, title_justify="left", box=None)
    for column in columns:
        table.add_column(Text(column), justify="right")
    return table


def print_written(
    stop: StopRequest, frames: int, total: int, folder: Path, files: Sequence[str]
) -> None:
    """Print the last lines of a command: whether it was stopped, and where its files are."""
    if stop.signum is not None:
        done = f"{signal.Signals(stop.signum).name} after frame {frames} of {total}"
        typer.echo(f"Stopped by {done}; what was computed until then is written.")
    typer.echo(f"Written to {folder}: {', '.join(files)}")
