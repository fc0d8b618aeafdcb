"""A run as a ROS bag with LOAM's topics (:mod:`loam_gtsam.ros.messages`), frame by frame."""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from rosbags import rosbag1, rosbag2

from loam_gtsam.config import BagConfig
from loam_gtsam.errors import as_path
from loam_gtsam.io.atomic import ClosingWriter
from loam_gtsam.ros.messages import TYPES, FrameMessages, Points
from loam_gtsam.types import MapUpdate, OutputError

_ROS2_VERSION: Literal[8] = 8
"""Of ``metadata.yaml``. Humble cannot parse version 9, and later releases read both
(github.com/ros2/rosbag2, issue 1895)."""
_COMMIT_EVERY = 50  # frames between two commits of a database: a killed process loses these at most
_HEADER_RECORD = 4096
"""Bytes of the first record of a ROS 1 bag, as ``rosbag`` has it: without its two lengths. rosbags
counts them in, and ``rosbag reindex`` would then write over the first 8 bytes of the messages."""


class BagWriter(ClosingWriter):
    """Writes a run into a new bag while the run goes on.

    Until it is closed the bag is called ``PATH.active``, as ``rosbag record`` has it. Leaving the
    block closes the bag, after an error or Ctrl-C too: it then holds all frames until there. Raises
    OutputError if the name fits none of these, or there is such a bag already, or it cannot be
    written; ConfigError if the names of the frames are empty or equal.

    Parameters
    ----------
    path : ending in ``.bag``: a ROS 1 bag; in ``.mcap``: an MCAP file (ROS 2); without a suffix: a
        ROS 2 folder with an SQLite database
    config : names of the frames, and which clouds to write
    overwrite : replace an earlier bag, once the new one is complete
    """

    def __init__(
        self, path: str | Path, config: BagConfig | None = None, *, overwrite: bool = False
    ) -> None:
        self.path = as_path(path)
        self.frames = 0  # written so far
        self._kind = self.path.suffix
        if self._kind not in (".bag", ".mcap", "") or not self.path.name:
            raise OutputError(
                f"{self.path}: expected a name that ends in .bag (ROS 1) or .mcap, or has no "
                "suffix (ROS 2 folder)"
            )
        self._frames = FrameMessages(config or BagConfig(), ros1=self._kind == ".bag")
        self._active = self.path.with_name(f"{self.path.name}.active")
        with self._failing():
            self._make_room(overwrite)
            self._writer: Any = self._open()
        self._connections: dict[str, Any] = {}
        self._last_stamp = 0

    def write(
        self,
        update: MapUpdate,
        cloud: Points | None = None,
        surround: Callable[[], Points] | None = None,
    ) -> None:
        """Append one frame; one with a bad stamp is left out, as in trajectories.

        Raises OutputError if the bag is closed or cannot be written (a full disk), or a message
        cannot say the stamp; InputError if a cloud is not (N, 4).

        Parameters
        ----------
        cloud : de-skewed points of the sweep, in the map frame
        surround : gives the map points around the sensor; called when they are due
        """
        if self._writer is None:
            raise OutputError(f"{self.path}: the bag is closed; nothing can be added to it")
        if not update.status.has_pose:
            return
        # All of a frame or, if a message cannot be made, none.
        frame = list(self._frames.frame(update, lambda: cloud, surround))
        self._last_stamp = update.stamp
        self._append(update.stamp, frame)
        self.frames += 1
        if self._kind == "" and self.frames % _COMMIT_EVERY == 0:
            with self._failing():
                self._writer.storage.conn.commit()  # rosbags would only at the end

    def close(self) -> None:
        """Write the whole path and the index, and give the bag its name.

        Without a frame there is no bag. Calling it again does nothing. Raises OutputError if that
        fails; ``PATH.active`` then holds what could be written.
        """
        if self._writer is None:
            return
        with self._failing():
            try:
                self._append(self._last_stamp, self._frames.path())
            finally:
                writer, self._writer = self._writer, None
                writer.close()
            if self.frames:
                self._give_name()
            _remove(self._active)

    def _append(self, stamp: int, messages: Iterable[tuple[str, bytes]]) -> None:
        with self._failing():
            for topic, message in messages:
                if topic not in self._connections:
                    add, store = self._writer.add_connection, self._frames.store
                    self._connections[topic] = add(topic, TYPES[topic], typestore=store)
                self._writer.write(self._connections[topic], stamp, message)

    def _make_room(self, overwrite: bool) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        existing = "the bag exists; add overwrite=True (--overwrite) or choose another name"
        cut_off = (
            "a recording that was cut off, or is still going on; repair it (rosbag reindex, ros2 "
            "bag reindex, mcap recover) or delete it"
        )
        for path, problem, is_bag in (
            (self.path, existing, lambda folder: self._kind == "" and _is_ros2_bag(folder)),
            (self._active, cut_off, _is_cut_off),
        ):
            if path.exists() and not overwrite:
                raise OutputError(f"{path}: {problem}")
            if path.is_dir() and not is_bag(path):
                raise OutputError(f"{path}: not a bag, so it is not replaced; choose another name")
        _remove(self._active)

    def _open(self) -> Any:
        if self._kind == ".bag":
            bag: Any = rosbag1.Writer(self._active)
            bag.open()
            bag.bio.flush()
            bag.bio.write(b" " * _pad_header(self._active))
            return bag
        storage = rosbag2.StoragePlugin.MCAP if self._kind else rosbag2.StoragePlugin.SQLITE3
        self._active.mkdir()
        folder = self._active / self.path.stem  # the file inside gets the name of this folder
        writer: Any = rosbag2.Writer(folder, version=_ROS2_VERSION, storage_plugin=storage)
        writer.open()
        if storage is rosbag2.StoragePlugin.SQLITE3:
            weakref.finalize(self, _close_forgotten, writer.storage.conn).atexit = False
        return writer

    def _give_name(self) -> None:
        source = self._active if self._kind == ".bag" else self._active / self.path.stem
        if self._kind == ".bag":
            _pad_header(source)
        elif self._kind == ".mcap":
            source /= self.path.name
        else:
            _remove(self.path)
        os.replace(source, self.path)

    @contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.Error, rosbag1.WriterError, rosbag2.WriterError) as error:
            raise OutputError(
                f"{self.path}: cannot write the bag: {error}; choose another folder or free some "
                "space"
            ) from error


def _close_forgotten(database: sqlite3.Connection) -> None:
    """Close the database of a bag that nobody closed.

    Python would close it some time later, in a garbage collection, and SQLite then deletes the
    journal of that *name*: by then perhaps that of the bag that replaces this one.
    """
    with suppress(sqlite3.Error):  # of another thread: not ours to close
        database.close()


def _pad_header(bag: Path) -> int:
    """Tell the first record of a ROS 1 bag its full length; returns the bytes it was short of."""
    with open(bag, "r+b") as file:
        file.seek(len(b"#ROSBAG V2.0\n"))
        (header,) = struct.unpack("<I", file.read(4))
        place = file.seek(header, os.SEEK_CUR)
        (padding,) = struct.unpack("<I", file.read(4))
        file.seek(place)
        file.write(struct.pack("<I", _HEADER_RECORD - header))
    return int(_HEADER_RECORD - header - padding)


def _is_ros2_bag(folder: Path) -> bool:
    files = list(folder.iterdir())
    known = all(path.suffix in (".yaml", ".db3", ".mcap") for path in files)
    return known and folder / "metadata.yaml" in files


def _is_cut_off(folder: Path) -> bool:
    files = (path for path in folder.rglob("*") if not path.is_dir())
    return all(path.suffix.startswith((".yaml", ".db3", ".mcap")) for path in files)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
