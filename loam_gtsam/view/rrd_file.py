"""An ``.rrd`` file that Rerun fills through a pipe, until its own file sink survives a full disk.

In rerun-sdk 0.41.0 the thread of the file sink ends at the first write that fails. If a flush is
waiting just then, the flush times out, and ``disconnect`` and the end of the process never return.
To see it: limit the file size (``RLIMIT_FSIZE``, SIGXFSZ ignored) to 1 MB, log 30 clouds of 5,000
points into ``RecordingStream.save``, ``flush(timeout_sec=5)``, ``disconnect()``. There was no
report of it at github.com/rerun-io/rerun in November 2026; the timeout of a flush came with its
pull request 11008. When ``viewer`` in pyproject.toml allows a later rerun-sdk, try that again: if
``disconnect`` returns, this file is no longer needed.

Behind a pipe the sink never fails, and what goes wrong with the file is an error like any other.
"""

from __future__ import annotations

import os
import threading
from pathlib import Path

from loam_gtsam.types import OutputError

_CHUNK = 1 << 20
_PATIENCE = 60.0
"""Seconds to wait for the last bytes."""


class RrdFile:
    """Copies what is written to the path :attr:`sink` into a file, in a thread.

    Raises
    ------
    OutputError
        If the name does not end in ``.rrd``, the file exists or cannot be written.
    """

    def __init__(self, path: Path, overwrite: bool) -> None:
        self._path = path
        if path.suffix != ".rrd":
            raise OutputError(f"{path}: expected a name that ends in .rrd")
        if path.exists() and not overwrite:
            raise OutputError(
                f"{path}: the file exists; add overwrite=True (--overwrite) or choose another name"
            )
        self._problem: OSError | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = open(path, "wb", buffering=0)  # noqa: SIM115 - the thread closes it
        except OSError as error:
            raise self._unwritable(error) from error
        source, self._write_end = os.pipe()
        self.sink = f"/dev/fd/{self._write_end}"

        def copy() -> None:
            with open(source, "rb", buffering=0) as pipe, file:
                while data := pipe.read(_CHUNK):
                    # After an error the rest is read all the same: the pipe must not fill up.
                    try:
                        while data and self._problem is None:
                            data = data[file.write(data) :]
                    except OSError as error:
                        self._problem = error

        self._thread = threading.Thread(target=copy, name="rrd file", daemon=True)
        self._thread.start()

    def opened(self) -> None:
        """Rerun has opened :attr:`sink`: when it closes that, the file ends."""
        os.close(self._write_end)

    def check(self) -> None:
        """Raise an OutputError if something could not be written."""
        if self._problem is not None:
            raise self._unwritable(self._problem) from self._problem

    def finish(self) -> None:
        """Wait until all is in the file, and :meth:`check`; :attr:`sink` must have been closed."""
        self._thread.join(_PATIENCE)
        if self._thread.is_alive():
            self._problem = TimeoutError("the disk does not keep up")
        self.check()

    def _unwritable(self, error: OSError) -> OutputError:
        return OutputError(
            f"{self._path}: cannot write the file: {error.strerror or error}; choose another "
            "folder or free some space"
        )
