"""A peer in a process of its own, where it disturbs nobody and nobody disturbs it."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

from loam_gtsam.studies.peers.base import Inertial, Peer, TimedPoints
from loam_gtsam.types import FloatArray, FrameStatus, MapUpdate

_child: Peer | None = None  # the peer, in the process that was started for it
_Answer = tuple[FloatArray | None, int, float, int]
"""Pose (4, 4), its stamp, the seconds that it took, and the points of the map."""


def _begin(kind: type[Peer], settings: Mapping[str, Any], imu: Inertial | None) -> None:
    global _child
    # Ctrl-C in a terminal reaches every process, and the caller handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # some peers report to the terminal what they do
        os.dup2(silence, stream)
    _child = kind(settings, imu)


def _work(stamp: int, sweep: TimedPoints) -> _Answer:
    assert _child is not None
    update = _child.register(stamp, sweep)
    pose = update.map_T_lidar.matrix() if update.status is FrameStatus.OK else None
    return pose, update.stamp, update.timings["register"], _child.map_points


class PeerProcess(Peer):
    """A peer of some kind in a process of its own; its times are those within that process."""

    def __init__(
        self, kind: type[Peer], settings: Mapping[str, Any], imu: Inertial | None = None
    ) -> None:
        self.name, self.package, self.module = kind.name, kind.package, kind.module
        self.knobs, self._map_points = kind.knobs, 0
        kind.load()  # the PeerError of one that is not installed
        super().__init__(settings, imu)
        self._pool = ProcessPoolExecutor(
            1, get_context("spawn"), _begin, (kind, dict(settings), imu)
        )

    @classmethod
    def load(cls, name: str = "") -> Any:
        """Nothing: the other process loads the peer."""
        return None

    def register(self, stamp: int, sweep: TimedPoints) -> MapUpdate:
        """See :meth:`Peer.register`."""
        answer = self._pool.submit(_work, stamp, sweep).result()
        pose, moment, seconds, self._map_points = answer
        return self._add(moment, pose, 0.0, seconds)

    @property
    def map_points(self) -> int:
        """See :attr:`Peer.map_points`."""
        return self._map_points

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _register(self, stamp: int, sweep: TimedPoints) -> tuple[FloatArray, float]:
        raise NotImplementedError  # the other process does it
