"""A run that was killed goes on: its state, written to a folder every now and then.

What a run computed after its last checkpoint is computed again; the result has the same bits as
that of a run that was never stopped. See docs/outputs.md.
"""

from __future__ import annotations

import json
import logging
import re
import shutil
import time
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.io.atomic import atomic_file, make_folder
from loam_gtsam.io.state import Frozen, freeze, thaw
from loam_gtsam.io.version import installed_version
from loam_gtsam.types import MapUpdate, OutputError

_STATE = re.compile(r"state_(\d+)\.npz")
_HEADER = "header"
_log = logging.getLogger(__name__)


class _Frames:
    """Frames from one checkpoint to the next."""

    def __init__(self, stamps: Sequence[int] = (), updates: Sequence[MapUpdate] = ()) -> None:
        self.stamps, self.updates = list(stamps), list(updates)


class Checkpoint:
    """Where a run keeps its state, and goes on from it.

    Parameters
    ----------
    folder : of its own, made when it is needed. Without ``resume`` what an earlier run left there
        is removed.
    seconds : from one checkpoint to the next, on the clock on the wall
    resume : go on from what is in the folder, if there is anything

    Examples
    --------
    >>> checkpoint = Checkpoint("drive.checkpoint", resume=True)  # doctest: +SKIP
    >>> result = run(dataset, config, checkpoint=checkpoint)  # doctest: +SKIP
    >>> write_run(result, "drive")  # doctest: +SKIP
    >>> checkpoint.remove()  # doctest: +SKIP
    """

    def __init__(self, folder: str | Path, *, seconds: float = 60.0, resume: bool = False) -> None:
        self.folder = Path(folder)
        self.seconds = seconds
        self._resume = resume
        self._failed = False
        self._parts: list[int] = []  # how many frames there were at each checkpoint
        self._about: dict[str, Any] = {}
        self._written = time.monotonic()

    @property
    def due(self) -> bool:
        """Whether it is time for the next one."""
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
        Stamps of the sweeps that were processed, nanoseconds, and their updates; empty at the
        start.

        Raises
        ------
        OutputError
            If the checkpoint is of another run or version, or cannot be read.
        """
        self._about = {"loam_gtsam": installed_version(), **about}
        newest = self._newest()
        if newest is None or not self._resume:
            self.remove()
            return [], []
        frames = _Frames()
        try:
            state, header = _read(newest)
            self._check(header["about"])
            self._parts = header["parts"]
            for start, end in zip([0, *self._parts], self._parts, strict=False):
                part = _Frames()
                thaw(_read(self._frames_file(start, end))[0], {"frames": part}, {})
                frames.stamps += part.stamps
                frames.updates += part.updates
            thaw(state, roots, shared)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise OutputError(
                f"{newest}: the checkpoint cannot be read: {error}; start again without resuming"
            ) from error
        self._written = time.monotonic()
        return frames.stamps, frames.updates

    def save(
        self,
        stamps: Sequence[int],
        updates: Sequence[MapUpdate],
        roots: Mapping[str, Any],
        shared: Mapping[str, Any],
    ) -> None:
        """Write the state after a frame. If it cannot be written the run must not suffer.

        Parameters
        ----------
        stamps, updates : of all sweeps so far
        roots, shared : as in :meth:`begin`

        Raises
        ------
        TypeError
            If something of a user's own, a loop closer say, cannot be kept.
        """
        done, total = (self._parts or [0])[-1], len(updates)
        if total == done:
            return
        before = self._newest()
        try:
            make_folder(self.folder)
            new = _Frames(stamps[done:], updates[done:])
            _write(self._frames_file(done, total), freeze({"frames": new}, {}), {})
            header = {"about": self._about, "parts": [*self._parts, total]}
            _write(self.folder / f"state_{total:07d}.npz", freeze(roots, shared), header)
        except OutputError as error:
            if not self._failed:
                _log.warning("no checkpoint: %s; the run goes on without", error)
            self._failed = True
        else:
            self._parts.append(total)
            if before is not None:
                before.unlink(missing_ok=True)
        self._written = time.monotonic()

    def remove(self) -> None:
        """Forget the checkpoint, once the results of the run are written elsewhere."""
        if self._newest() is not None or any(self.folder.glob("frames_*.npz")):
            shutil.rmtree(self.folder, ignore_errors=True)

    def _newest(self) -> Path | None:
        files = self.folder.glob("state_*.npz")
        return max((f for f in files if _STATE.fullmatch(f.name)), default=None)

    def _frames_file(self, start: int, end: int) -> Path:
        return self.folder / f"frames_{start:07d}_{end:07d}.npz"

    def _check(self, about: Mapping[str, str]) -> None:
        for name, now in self._about.items():
            if about.get(name) != now:
                raise OutputError(
                    f"{self.folder}: the checkpoint is of another run: its {name} was "
                    f"{_shown(about.get(name))}, now it is {_shown(now)}; resume with the same, or "
                    "start again"
                )


def _write(path: Path, frozen: Frozen, header: Mapping[str, Any]) -> None:
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    with atomic_file(path) as file:
        np.savez(file, **frozen, **{_HEADER: text})  # type: ignore[arg-type]


def _read(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return arrays, json.loads(arrays.pop(_HEADER).tobytes())


def _shown(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 60 else "a longer text"
