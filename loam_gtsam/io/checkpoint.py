"""Checkpoints of a run: its state, written to a folder every minute or so, to go on from.

What a run computed after its last checkpoint is computed again. The result has the same bits as
that of a run that was never stopped. See docs/outputs.md.
"""

from __future__ import annotations

import json
import logging
import re
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any
from zlib import crc32

import gtsam
import numpy as np
from numpy.typing import NDArray

from loam_gtsam.errors import DAMAGED, InputError, as_path, is_number
from loam_gtsam.io.atomic import atomic_file, lock_folder, make_folder, unlock_folder
from loam_gtsam.io.state import STRUCTURE, Frozen, freeze, thaw
from loam_gtsam.io.version import installed_version
from loam_gtsam.types import BadSweep, DatasetError, MapUpdate, OutputError, Sweep, check_kind

_HEADER = "header"
_FILE = re.compile(r"(frames_\d+_\d+|state_\d+)\.npz")
_UNFINISHED = re.compile(rf"\.{_FILE.pattern}\.\d+\.tmp")
_SHOWN = 5  # parameters of two configurations that differ, in a message
_log = logging.getLogger(__name__)


def checksum(contents: object, start: int = 0) -> int:
    """CRC-32 of all that is in sweeps, samples of an IMU and the like, or in several of them.

    Of a bad sweep the stamp counts alone: its message names the file, whose folder may move.
    ``start`` is the checksum of what comes before.
    """
    if isinstance(contents, BadSweep):
        contents = contents.stamp
    if isinstance(contents, gtsam.Pose3):
        contents = contents.matrix()
    if is_dataclass(contents):
        contents = tuple(getattr(contents, item.name) for item in fields(contents))
    if isinstance(contents, tuple):
        for part in contents:
            start = checksum(part, start)
        return start
    if isinstance(contents, np.ndarray):
        return crc32(contents.tobytes(), checksum((contents.dtype.str, contents.shape), start))
    return crc32(repr(contents).encode(), start)


class _Frames:
    """Checksums of the sweeps and updates of the frames between two checkpoints."""

    def __init__(self, sweeps: Sequence[int] = (), updates: Sequence[MapUpdate] = ()) -> None:
        self.sweeps, self.updates = list(sweeps), list(updates)


class Checkpoint:
    """Folder in which a run keeps its state, and from which a run goes on.

    Parameters
    ----------
    folder : which one run at a time may use; only files of checkpoints are ever removed
    seconds : of wall-clock time from one checkpoint to the next
    resume : go on from the checkpoint in the folder, if there is one; else it is removed

    Examples
    --------
    >>> checkpoint = Checkpoint("drive.checkpoint", resume=True)  # doctest: +SKIP
    >>> result = run(dataset, config, checkpoint=checkpoint)  # doctest: +SKIP
    >>> write_run(result, "drive")  # doctest: +SKIP
    >>> checkpoint.remove()  # doctest: +SKIP
    """

    def __init__(self, folder: str | Path, *, seconds: float = 60.0, resume: bool = False) -> None:
        if not (is_number(seconds) and seconds >= 0.0):
            raise InputError(f"seconds: expected a number, 0 or more, got {seconds!r}")
        self.folder, self.seconds = as_path(folder, "folder"), seconds
        self._resume = resume
        self._warned = False
        self._parts: list[int] = []  # how many frames there were at each checkpoint
        self._about: dict[str, Any] = {}
        self._written = time.monotonic()

    @property
    def due(self) -> bool:
        """Whether it is time for the next checkpoint."""
        return time.monotonic() - self._written >= self.seconds

    def begin(
        self, about: Mapping[str, str], roots: Mapping[str, Any], shared: Mapping[str, Any]
    ) -> tuple[list[int], list[MapUpdate]]:
        """Bring ``roots`` into the state of the checkpoint, if there is one to go on from.

        Parameters
        ----------
        about : what must be the same as in the run before: the input, the configuration
        roots, shared : see :func:`loam_gtsam.io.state.freeze`

        Returns
        -------
        Checksums of the sweeps that were processed, and their updates.

        Raises
        ------
        OutputError
            If the state cannot be kept, the checkpoint is of another run or version or cannot be
            read, or other files in the folder have the names of its files.
        """
        parts = json.dumps({name: "given" for name in {**roots, **shared} if "." not in name})
        self._about = {"loam_gtsam": installed_version(), **about, "list of parts": parts}
        self._parts = []
        try:
            freeze(roots, shared)
        except TypeError as error:
            raise OutputError(f"a checkpoint of this run is not possible: {error}") from error
        newest = self._newest()
        if newest is None or not self._resume:
            self._clear()
            for path in self._files():
                raise OutputError(
                    f"{path}: the file has the name of a checkpoint's file, but is none; delete "
                    "it or choose another folder"
                )
            return [], []
        frames, part = _Frames(), _Frames()
        try:
            state, header = _read(newest)
            self._check(header["about"])
            self._parts = header["parts"]
            for start, end in zip([0, *self._parts], self._parts, strict=False):
                thaw(_read(self._frames_file(start, end))[0], {"frames": part}, {})
                frames.sweeps += part.sweeps
                frames.updates += part.updates
            thaw(state, roots, shared)
        except DAMAGED as error:
            problem = f"{newest}: the checkpoint cannot be read: {str(error)[:200]}"
            raise OutputError(f"{problem}; start again without resuming") from error
        self._written = time.monotonic()
        return frames.sweeps, frames.updates

    def save(
        self,
        sweeps: Sequence[int],
        updates: Sequence[MapUpdate],
        roots: Mapping[str, Any],
        shared: Mapping[str, Any],
    ) -> None:
        """Write the state after a frame: that of the roots, and what all sweeps so far gave.

        ``sweeps`` are their checksums, see :func:`checksum`.

        If the state cannot be written, or something in it cannot be kept, the log says so once and
        the run goes on.
        """
        done, total = (self._parts or [0])[-1], len(updates)
        if total == done:
            return
        before = self._newest()
        try:
            state = freeze(roots, shared)
            frames = freeze({"frames": _Frames(sweeps[done:], updates[done:])}, {})
            make_folder(self.folder)
            _write(self._frames_file(done, total), frames, {})
            header = {"about": self._about, "parts": [*self._parts, total]}
            _write(self.folder / f"state_{total:07d}.npz", state, header)
        except Exception as error:  # a user's own __getstate__ may raise anything
            if not self._warned:
                _log.warning("no checkpoint: %s; the run goes on without", error)
            self._warned = True
        else:
            self._parts.append(total)
            if before is not None:
                before.unlink(missing_ok=True)
        self._written = time.monotonic()

    def remove(self) -> None:
        """Remove the checkpoint; other files in the folder stay, and then the folder as well."""
        self._clear()
        with suppress(OSError):
            self.folder.rmdir()  # fails if it is not empty

    def _clear(self) -> None:
        with suppress(OSError):
            for path in self._files():
                if _is_ours(path):
                    path.unlink(missing_ok=True)
            for path in self.folder.glob(".*.tmp"):  # by a process that was killed
                if _UNFINISHED.fullmatch(path.name):
                    path.unlink(missing_ok=True)

    def _files(self) -> Iterator[Path]:
        return (path for path in self.folder.glob("*.npz") if _FILE.fullmatch(path.name))

    def _newest(self) -> Path | None:
        return max((f for f in self._files() if f.name.startswith("state")), default=None)

    def _frames_file(self, start: int, end: int) -> Path:
        return self.folder / f"frames_{start:07d}_{end:07d}.npz"

    def _check(self, about: Mapping[str, str]) -> None:
        for name, now in self._about.items():
            if about.get(name) != now:
                was, is_now = _unlike(about.get(name), now)
                raise OutputError(
                    f"{self.folder}: the checkpoint is of another run: its {name} was {was}, now "
                    f"it is {is_now}; resume with the same, or start again"
                )


class Progress:
    """The frames of a run so far, and its checkpoints, whose folder no other run may use.

    Parameters
    ----------
    checkpoint : None keeps nothing
    about : see :meth:`Checkpoint.begin`
    state : gives roots and shared objects, see :func:`loam_gtsam.io.state.freeze`
    """

    def __init__(
        self,
        checkpoint: Checkpoint | None,
        about: Mapping[str, str],
        state: Callable[[], tuple[Mapping[str, Any], Mapping[str, Any]]],
    ) -> None:
        self._checkpoint, self._state = checkpoint, state
        self.whole = True  # not in the middle of a frame
        self.sweeps: list[int] = []  # their checksums
        self.updates: list[MapUpdate] = []
        self._lock: int | None = None
        if checkpoint is not None:
            check_kind(checkpoint, Checkpoint, "checkpoint", "Checkpoint(folder) makes one")
            with suppress(OSError):  # the log will say so
                checkpoint.folder.mkdir(parents=True, exist_ok=True)
            self._lock = lock_folder(checkpoint.folder)
            try:
                self.sweeps, self.updates = checkpoint.begin(about, *state())
            except BaseException:
                self.end()
                raise

    def rest(self, sweeps: Iterator[tuple[Sweep, float]]) -> Iterator[tuple[Sweep, float]]:
        """The sweeps after those that are done, which must be the same; DatasetError if not."""
        for number, done in enumerate(self.sweeps):
            sweep, _ = next(sweeps, (None, 0.0))
            if checksum(sweep) != done:
                self.end()
                got = "no more sweeps" if sweep is None else f"another one at {sweep.stamp} ns"
                raise DatasetError(
                    f"sweep {number}: expected that of the run to go on with, got {got}; resume "
                    "with the same data and options of the loader, or start again"
                )
        return sweeps

    def add(self, sweep: Sweep, update: MapUpdate) -> None:
        """A frame is done."""
        if self._checkpoint is not None:
            self.sweeps.append(checksum(sweep))
        self.updates.append(update)
        self.whole = True

    def end(self) -> None:
        """Leave the folder to other runs; to be called once, however the run ends."""
        unlock_folder(self._lock)
        self._lock = None
        if self._checkpoint is not None:
            with suppress(OSError):
                self._checkpoint.folder.rmdir()  # fails if it is not empty

    def save_if_due(self) -> None:
        """Write a checkpoint, if it is time."""
        if self._checkpoint is not None and self._checkpoint.due:
            self.save()

    def save(self) -> None:
        """Write a checkpoint, unless a frame was cut off in the middle."""
        if self._checkpoint is not None and self.whole:
            self._checkpoint.save(self.sweeps, self.updates, *self._state())


def _is_ours(path: Path) -> bool:
    """Whether a file is one that a checkpoint wrote."""
    with suppress(*DAMAGED), zipfile.ZipFile(path) as archive:
        return {f"{_HEADER}.npy", f"{STRUCTURE}.npy"} <= set(archive.namelist())
    return False


def _write(path: Path, frozen: Frozen, header: Mapping[str, Any]) -> None:
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    with atomic_file(path) as file:
        np.savez(file, **frozen, **{_HEADER: text})  # type: ignore[arg-type]


def _read(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return arrays, json.loads(arrays.pop(_HEADER).tobytes())


def _unlike(before: object, now: object) -> tuple[str, str]:
    """Two values to be shown; of mappings as JSON, the first few entries that differ."""
    one, other = {}, {}
    with suppress(ValueError):
        one, other = (_entries(json.loads(str(value))) for value in (before, now))
    names = [name for name in one | other if one.get(name) != other.get(name)]
    if not (one and other and names):
        return _shorten(before), _shorten(now)
    shown, more = names[:_SHOWN], len(names) - _SHOWN
    rest = f" and {more} more" if more > 0 else ""
    texts = [
        ", ".join(f"{name} {_shorten(part.get(name))}" for name in shown) + rest
        for part in (one, other)
    ]
    return texts[0], texts[1]


def _entries(value: object, name: str = "") -> dict[str, object]:
    """The values of nested mappings by dotted name; nothing of a value that is none."""
    if not isinstance(value, Mapping):
        return {name: value} if name else {}
    inner = {f"{name}.{key}".lstrip("."): part for key, part in value.items()}
    return {key: end for n, part in inner.items() for key, end in _entries(part, n).items()}


def _shorten(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 60 else "a longer text"
