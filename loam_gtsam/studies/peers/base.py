"""What all peers have in common: how they are made, what they get, and what they say."""

from __future__ import annotations

import importlib
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.errors import nearest
from loam_gtsam.types import FloatArray, FrameStatus, ImuSamples, LoamError, MapUpdate, Trajectory

_FAR = 99.0  # per cent of the ranges of a sweep that are within the range of a scene
_VOXELS = 100.0
"""Voxels along the range of a scene: KISS-ICP's and GenZ-ICP's rule for the range of a sensor."""
_YES_NO = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


class PeerError(LoamError):
    """A peer is not installed, not known, cannot be imported, or has no such setting."""


@dataclass(frozen=True, slots=True, eq=False)
class TimedPoints:
    """The usable points of a sweep as arrays.

    Attributes
    ----------
    points : (N, 3) float64, metres, lidar frame at each point's own time
    times : (N,) seconds from the stamp
    span : (first, last) seconds from the stamp covered by the sweep
    """

    points: FloatArray
    times: FloatArray
    span: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """The IMU of a data set: all samples, and (4, 4) ``lidar_T_imu``."""

    samples: ImuSamples
    lidar_T_imu: FloatArray


class Peer(ABC):
    """Another system, which registers one sweep at a time.

    Parameters
    ----------
    settings : values of :attr:`knobs`, as text or as they are; what is not in it keeps its default
    imu : of the data set, for peers that use one

    Attributes
    ----------
    name, package, module : name on the command line, for pip and for ``import``
    knobs : the settings that this peer has, with their defaults
    shares : whether several instances in one process do not disturb each other
    """

    name: str
    package: str
    module: str
    knobs: Mapping[str, Any] = MappingProxyType({})
    shares: bool = True

    def __init__(self, settings: Mapping[str, Any] | None = None, imu: Inertial | None = None):
        self.updates: list[MapUpdate] = []
        self.settings = _checked(self.name, self.knobs, settings or {})
        self.imu = imu
        self.load()
        self._started = False

    def register(self, stamp: int, sweep: TimedPoints) -> MapUpdate:
        """Register a sweep and measure the time of the registration itself.

        The times of the points count from ``stamp``, nanoseconds; the stamp of the result is the
        moment that the pose belongs to. Raises InputError if the peer cannot take this sweep.
        """
        if not self._started:
            self._start(sweep)
            self._started = True
        started = time.perf_counter()
        pose, moment = self._register(stamp, sweep)
        seconds = time.perf_counter() - started
        return self._add(stamp, pose, moment, seconds)

    def _add(self, stamp: int, pose: FloatArray | None, moment: float, seconds: float) -> MapUpdate:
        update = MapUpdate(stamp, gtsam.Pose3(), FrameStatus.UNUSABLE_SCAN, f"{self.name}: no pose")
        if pose is not None:
            at = stamp + round(moment * 1e9)
            update = MapUpdate(at, gtsam.Pose3(pose), FrameStatus.OK)
        self.updates.append(replace(update, timings={"register": seconds}))
        return self.updates[-1]

    @property
    def trajectory(self) -> Trajectory:
        """One pose per sweep that has one, stamped with the moment that it belongs to."""
        good = [update for update in self.updates if update.status is FrameStatus.OK]
        return Trajectory.from_poses([u.stamp for u in good], [u.map_T_lidar for u in good])

    @property
    @abstractmethod
    def map_points(self) -> int:
        """Number of points in the present map, or of voxels if the peer keeps distributions."""

    def close(self) -> None:
        """Free what the peer holds; nothing can be registered any more."""
        return

    def _start(self, sweep: TimedPoints) -> None:
        """Make the system, for the scene of the first sweep."""
        return

    @abstractmethod
    def _register(self, stamp: int, sweep: TimedPoints) -> tuple[FloatArray | None, float]:
        """Pose (4, 4) of a sweep or None, and its moment in seconds from the stamp."""

    @classmethod
    def load(cls, name: str = "") -> Any:
        """The Python module of the peer, or one within it; PeerError if it is not installed."""
        try:
            return importlib.import_module(f"{cls.module}.{name}" if name else cls.module)
        except ImportError as error:
            raise PeerError(
                f"{cls.name} cannot be imported ({error}); install it with: pip install "
                f"{cls.package}"
            ) from error

    def voxel(self, sweep: TimedPoints, default: float) -> float:
        """Metres: the setting ``voxel``, which may be "scene"; ``default`` if it is not set."""
        wanted = self.settings["voxel"]
        if wanted == "scene":
            ranges = np.linalg.norm(sweep.points, axis=1)
            return float(np.percentile(ranges, _FAR)) / _VOXELS
        return default if wanted is None else float(wanted)


def _checked(peer: str, knobs: Mapping[str, Any], settings: Mapping[str, Any]) -> Mapping[str, Any]:
    values = dict(knobs)
    for key, value in settings.items():
        if key not in knobs:
            raise PeerError(f"{peer}: unknown setting {key!r}{nearest(key, knobs)}")
        values[key] = _value(f"{peer}: {key}", knobs[key], value)
    return values


def _value(where: str, default: Any, value: Any) -> Any:
    """A setting of the kind of its default: on or off, or else metres or "scene"."""
    text = str(value).lower()
    if isinstance(default, bool):
        if text not in _YES_NO:
            raise PeerError(f"{where}: expected true or false, got {value!r}")
        return _YES_NO[text]
    if text == "scene":
        return text
    try:
        metres = float(text)
    except ValueError:
        metres = -1.0
    if not 0.0 < metres < np.inf:
        raise PeerError(f"{where}: expected metres above 0, or scene; got {value!r}")
    return metres
