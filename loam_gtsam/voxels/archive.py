"""Cubes of the map that the sensor has left behind."""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from loam_gtsam.errors import DAMAGED
from loam_gtsam.types import ConfigError
from loam_gtsam.voxels.cubes import Cube, CubePoints, SortedPoints
from loam_gtsam.voxels.grid import CubeIndex, Grid
from loam_gtsam.voxels.tags import Owners

_log = logging.getLogger(__name__)
_COLUMNS = 5  # of a file: a point and its tags


class Archive:
    """Points of cubes outside the window: the newest in memory, older ones on disk or dropped.

    ``dropped_cubes`` and ``dropped_points`` are lost for good.

    Parameters
    ----------
    grid : of the map
    megabytes : memory for points; when it is used up, the oldest cubes go to disk
    folder : in which the archive makes a folder of its own for the first cube that goes to disk,
        and removes it when the archive is gone; None to drop cubes instead
    """

    def __init__(self, grid: Grid, megabytes: float, folder: str | None) -> None:
        self._given = grid, megabytes, folder
        self._grid = grid
        self._bytes = 0
        self._memory: dict[CubeIndex, CubePoints] = {}  # oldest first
        self._disk: dict[CubeIndex, tuple[int, Path]] = {}  # number of points, and the file
        self._stale: list[Path] | None = None  # to be removed, once nothing is remembered
        self._parent = None if folder is None else Path(folder).absolute()
        self._subfolder: Path | None = None  # in the parent, once a cube went there
        self.dropped_cubes = self.dropped_points = 0
        if self._parent is not None:
            try:
                self._parent.mkdir(parents=True, exist_ok=True)
                tempfile.TemporaryFile(dir=self._parent).close()
            except OSError as error:
                raise ConfigError(
                    f"map.archive_dir: cannot write to {folder!r} ({error}); name a folder that "
                    "can be written to, or null to keep the archive in memory"
                ) from error

    def __getstate__(self) -> dict[str, Any]:
        return {
            "given": self._given,
            "cubes": list(self.contents()),
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

    def __deepcopy__(self, _: object) -> Archive:
        # All cubes in memory: a copy needs no folder of its own.
        copy = Archive(self._grid, np.inf, None)
        for index, content in self.contents():
            copy.store(index, content)
        return copy

    def restorer(self) -> Callable[[], None]:
        """A function that brings the archive back to what it is now, until this is called again."""
        for path in self._stale or ():
            path.unlink(missing_ok=True)
        self._stale = []
        before = vars(self).copy() | {
            "_memory": self._memory.copy(),
            "_disk": self._disk.copy(),
            "_stale": [],  # the files are in use again
        }
        del before["_subfolder"]  # which stays, once it is made
        return partial(vars(self).update, before)

    def indices(self) -> list[CubeIndex]:
        """Cubes in the archive, oldest first, those in memory before those on disk."""
        return [*self._memory, *self._disk]

    def count(self) -> int:
        """Points in the archive."""
        on_disk = sum(count for count, _ in self._disk.values())
        return sum(len(held.points) for held in self._memory.values()) + on_disk

    def store(self, index: CubeIndex, content: CubePoints) -> None:
        """Keep a cube that is not in the archive; the oldest cubes make room for it."""
        self._memory[index] = content
        self._bytes += content.nbytes
        while self._bytes > self._given[1] * 1e6:
            oldest = next(iter(self._memory))
            self._spill(oldest, self._memory.pop(oldest))

    def read(self, index: CubeIndex) -> CubePoints | None:
        """Points of an archived cube; None, and the cube counts as dropped, if unreadable.

        None as well if the cube is not in the archive, or no longer.
        """
        if index in self._memory:
            return self._memory[index]
        if index not in self._disk:
            return None
        count, path = self._disk[index]
        try:
            # Mapped, so that a damaged header cannot claim more memory than the file has bytes.
            rows = np.load(path, mmap_mode="r", allow_pickle=False)
            expected = (count, _COLUMNS)
            if rows.shape != expected or rows.dtype != np.float64:
                raise ValueError(f"expected {expected} float64, got {rows.shape} {rows.dtype}")
        except DAMAGED as error:
            del self._disk[index]
            self._drop(count, f"cannot read {path}: {error}")
            return None
        return CubePoints(np.array(rows[:, :3], order="C"), rows[:, 3:].astype(np.int32))

    def contents(self) -> Iterator[tuple[CubeIndex, CubePoints]]:
        """The readable cubes and their points, in the order of :meth:`indices`."""
        for index in self.indices():
            content = self.read(index)
            if content is not None:
                yield index, content

    def take(self, index: CubeIndex) -> Cube | None:
        """Take a cube out of the archive; None if it is not there or cannot be read."""
        content = self.read(index)
        if index in self._memory:
            self._bytes -= self._memory.pop(index).nbytes
        elif index in self._disk:
            path = self._disk.pop(index)[1]
            if self._stale is None:
                path.unlink(missing_ok=True)
            else:
                self._stale.append(path)
        return None if content is None else Cube.of(content, self._grid)

    def take_out(self, owners: Owners) -> list[CubePoints]:
        """Remove the points of some owners from the archived cubes, and return them."""
        taken = []
        for index, content in self.contents():
            if np.isin(content.tags[:, 0], owners).any():
                cube = self.take(index) or Cube()
                taken.append(cube.take_out(owners))
                self.store(index, cube.content)
        return taken

    def settle(self, content: CubePoints) -> None:
        """Add points within the grid's limit to archived cubes where voxels are free."""
        if len(content.points) == 0:
            return
        new = SortedPoints.of(content, self._grid.cells(content.points.T), self._grid)
        for index, part in new.firsts().items():
            cube = self.take(index) or Cube()
            cube.settle(part)
            self.store(index, cube.content)

    def _spill(self, index: CubeIndex, content: CubePoints) -> None:
        """Write a cube to disk; without a folder it is lost."""
        points = content.points
        self._bytes -= content.nbytes
        if self._parent is None:
            self._drop(len(points), "archive_megabytes is used up and archive_dir is not set")
            return
        try:
            path = self._folder(self._parent) / "cube_{}_{}_{}.npy".format(*index)
            while path in (self._stale or ()):  # what is remembered may need the old file
                path = path.with_stem(f"{path.stem}_")
            temporary = path.with_suffix(".tmp")
            with temporary.open("wb") as file:
                np.save(file, np.column_stack(content), allow_pickle=False)
            os.replace(temporary, path)  # a file under its final name is always whole
        except OSError as error:
            self._drop(len(points), f"cannot write to {self._subfolder or self._parent}: {error}")
        else:
            self._disk[index] = len(points), path

    def _folder(self, parent: Path) -> Path:
        if self._subfolder is None:
            self._subfolder = Path(tempfile.mkdtemp(prefix="cubes_", dir=parent))
            weakref.finalize(self, shutil.rmtree, self._subfolder, ignore_errors=True)
        return self._subfolder

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
