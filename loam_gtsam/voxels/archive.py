"""Cubes of the map that the sensor has left behind."""

from __future__ import annotations

import logging
import os
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.types import ConfigError, FloatArray

CubeIndex = tuple[int, int, int]
Owners = NDArray[np.int32]

_log = logging.getLogger(__name__)


class CubePoints(NamedTuple):
    """Points of a cube, (N, 3) metres, and who owns them, (N,): see :meth:`CubeMap.move`."""

    points: FloatArray
    owners: Owners

    @property
    def nbytes(self) -> int:
        """Of memory."""
        return self.points.nbytes + self.owners.nbytes


class Archive:
    """Points of cubes outside the window: the newest in memory, older ones on disk or dropped."""

    def __init__(self, megabytes: float, folder: str | None) -> None:
        self._megabytes, self._root = megabytes, folder
        self._budget = megabytes * 1e6
        self._bytes = 0
        self._memory: dict[CubeIndex, CubePoints] = {}  # oldest first
        self._disk: dict[CubeIndex, int] = {}  # number of points
        self._folder: Path | None = None
        self.dropped_cubes = self.dropped_points = 0
        if folder is not None:
            try:
                Path(folder).mkdir(parents=True, exist_ok=True)
                self._folder = Path(tempfile.mkdtemp(prefix="cubes_", dir=folder))
            except OSError as error:
                raise ConfigError(
                    f"map.archive_dir: cannot make a folder in {folder!r} ({error}); name one that "
                    "can be written to, or null to keep the archive in memory"
                ) from error

    def __getstate__(self) -> dict[str, Any]:
        held = [(index, self.read(index)) for index in self.indices()]
        return {
            "given": (self._megabytes, self._root),
            "cubes": [(index, content) for index, content in held if content is not None],
            "in_memory": len(self._memory),
            "dropped": (self.dropped_cubes, self.dropped_points),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["given"])  # type: ignore[misc]
        in_memory = state["in_memory"]
        for index, content in state["cubes"][in_memory:]:
            self._bytes += content.nbytes
            self._spill(index, content)
        for index, content in state["cubes"][:in_memory]:
            self.store(index, content)
        self.dropped_cubes, self.dropped_points = state["dropped"]

    def __len__(self) -> int:
        return len(self._memory) + len(self._disk)

    def __contains__(self, index: CubeIndex) -> bool:
        return index in self._memory or index in self._disk

    def indices(self) -> list[CubeIndex]:
        """Of its cubes, oldest first, those in memory before those on disk."""
        return [*self._memory, *self._disk]

    def count(self) -> int:
        """Points."""
        return sum(len(held.points) for held in self._memory.values()) + sum(self._disk.values())

    def store(self, index: CubeIndex, content: CubePoints) -> None:
        """Keep a cube that is not in the archive; makes room by spilling the oldest."""
        self._memory[index] = content
        self._bytes += content.nbytes
        while self._bytes > self._budget:
            oldest = next(iter(self._memory))
            self._spill(oldest, self._memory.pop(oldest))

    def read(self, index: CubeIndex) -> CubePoints | None:
        """Points of an archived cube; None, and the cube counts as dropped, if unreadable."""
        if index in self._memory:
            return self._memory[index]
        try:
            # Mapped, so that a damaged header cannot claim more memory than the file has bytes.
            rows = np.load(self._path(index), mmap_mode="r", allow_pickle=False)
            if rows.shape != (self._disk[index], 4) or rows.dtype != np.float64:
                raise ValueError(
                    f"expected ({self._disk[index]}, 4) float64, got {rows.shape} {rows.dtype}"
                )
        except (OSError, ValueError) as error:
            self._drop(self._disk.pop(index), f"cannot read {self._path(index)}: {error}")
            return None
        return CubePoints(np.array(rows[:, :3], order="C"), rows[:, 3].astype(np.int32))

    def take(self, index: CubeIndex) -> CubePoints | None:
        """The same, and forget it."""
        content = self.read(index)
        if index in self._memory:
            self._bytes -= self._memory.pop(index).nbytes
        elif index in self._disk:
            del self._disk[index]
            self._path(index).unlink(missing_ok=True)
        return content

    def _spill(self, index: CubeIndex, content: CubePoints) -> None:
        points = content.points
        self._bytes -= content.nbytes
        if self._folder is None:
            self._drop(len(points), "archive_megabytes is used up and archive_dir is not set")
            return
        path = self._path(index)
        temporary = path.with_suffix(".tmp")
        try:
            with temporary.open("wb") as file:
                np.save(file, np.column_stack(content), allow_pickle=False)
            os.replace(temporary, path)  # a file under its final name is always whole
        except OSError as error:
            self._drop(len(points), f"cannot write {path}: {error}")
        else:
            self._disk[index] = len(points)

    def _drop(self, n_points: int, reason: str) -> None:
        """Count a loss; say it once, as a full disk would say it for every cube."""
        self.dropped_cubes += 1
        self.dropped_points += n_points
        if self.dropped_cubes == 1:
            _log.warning(
                "the map archive lost a cube of %d points: %s. Further losses are only counted "
                "(dropped_cubes, dropped_points)",
                n_points,
                reason,
            )

    def _path(self, index: CubeIndex) -> Path:
        assert self._folder is not None
        return self._folder / "cube_{}_{}_{}.npy".format(*index)
