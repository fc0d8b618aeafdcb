"""Output files that are whole or not there, output folders, and writers that close themselves."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import re
import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np

from loam_gtsam.errors import as_path
from loam_gtsam.types import OutputError

_log = logging.getLogger(__name__)
_STAGED = ".loam_gtsam_new"  # folder of new files among the old ones, until all are written


def file_name(name: str) -> str:
    """Any name as that of a file or folder."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._") or "run"


def _refused(problem: str, error: OSError) -> OutputError:
    advice = "choose another folder or free some space"
    return OutputError(f"{problem}: {error.strerror or error}; {advice}")


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Open a binary file that takes the place of ``path`` when the block ends without an error.

    The file is written beside ``path`` and then renamed: whatever interrupts the block leaves the
    old file or the new one, never half of one.

    Raises
    ------
    OutputError
        If the file cannot be written; ``path`` is then as it was.
    """
    path = as_path(path)
    # The same folder, for a rename is atomic only within one file system.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise _refused(f"{path}: cannot write the file", error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8, see :func:`atomic_file`."""
    with atomic_file(path) as file:
        file.write(text.encode("utf-8"))


def write_json(path: str | Path, value: Any) -> None:
    """Write plain values, mappings and sequences as JSON, see :func:`atomic_file`.

    NaN and infinity, for which JSON has no numbers, become ``null``.
    """
    write_text(path, json.dumps(_without_nan(value), indent=2, allow_nan=False) + "\n")


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(entry) for entry in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def make_folder(directory: str | Path) -> Path:
    """Make a folder and check that files can be written there, else raise an OutputError."""
    folder = as_path(directory, "directory")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _refused(f"{folder}: cannot make this output folder", error) from error
    return folder


@contextmanager
def used_alone(folder: Path) -> Iterator[None]:
    """A block in which this process alone uses a folder that is there.

    The lock is on the folder itself: it ends with the process, whatever ends that, and leaves no
    file. File systems without locks have none.

    Raises
    ------
    OutputError
        If another process, or another run in this one, uses the folder.
    """
    held = lock_folder(folder)
    try:
        yield
    finally:
        unlock_folder(held)


def lock_folder(folder: Path) -> int | None:
    """Lock a folder as :func:`used_alone` does; returns what :func:`unlock_folder` wants."""
    held: int | None = None
    try:
        held = os.open(folder, os.O_RDONLY)
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        unlock_folder(held)
        raise OutputError(
            f"{folder}: another run uses this folder; wait for its end or choose another folder"
        ) from error
    except OSError as error:
        unlock_folder(held)
        _log.info("%s: cannot be locked: %s", folder, error)
        return None
    return held


def unlock_folder(held: int | None) -> None:
    """End a lock."""
    if held is not None:
        os.close(held)


@contextmanager
def staged_files(folder: Path, known: Sequence[str], last: str) -> Iterator[Path]:
    """Make a folder for new files, which replace the old files in ``folder`` at the end.

    If the block ends with an error, or the process is killed in it, the old files are as they were.
    After the block the new files are moved, one rename each.

    Parameters
    ----------
    folder : where the files are to be; other files in it stay
    known : names of files that an earlier run may have left, which are removed if not written anew
    last : name of the file that is removed first and moved last: if it is there, all files are of
        one run
    """
    staged = folder / _STAGED
    try:
        shutil.rmtree(staged, ignore_errors=True)  # of a run that was killed
        staged.mkdir()
        yield staged
        names = sorted((path.name for path in staged.iterdir()), key=lambda name: name == last)
        for name in (last, *(set(known) - set(names))):
            (folder / name).unlink(missing_ok=True)
        for name in names:
            os.replace(staged / name, folder / name)
    except OSError as error:
        raise _refused(f"{folder}: cannot write there", error) from error
    finally:
        shutil.rmtree(staged, ignore_errors=True)


class ClosingWriter(ABC):
    """Writer of an output that grows during a run; its ``with`` block closes it in any case."""

    @abstractmethod
    def close(self) -> None:
        """Finish what was written."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # What ended the block matters more than what closing says on a full disk.
        with nullcontext() if kind is None else suppress(OutputError):
            self.close()
