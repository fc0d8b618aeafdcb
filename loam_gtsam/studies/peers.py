"""Peers: other registration systems, run through their own Python packages, all of them optional.

Every peer runs with its own defaults. Its docstring says what is not a default, and which moment of
the sweep its pose belongs to.
"""

from __future__ import annotations

import importlib
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.geometry import move_points
from loam_gtsam.types import FloatArray, FrameStatus, InputError, LoamError, MapUpdate, Trajectory


class PeerError(LoamError):
    """A peer is not installed, not known, or cannot be imported."""


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


class Peer(ABC):
    """Another system, which registers one sweep at a time.

    Attributes
    ----------
    name, package, module : name on the command line, for pip and for ``import``
    alone : whether instances in one process share state, so that only one may run at a time
    """

    name: str
    package: str
    module: str
    alone: bool = False

    def __init__(self) -> None:
        self.updates: list[MapUpdate] = []

    def register(self, stamp: int, sweep: TimedPoints) -> MapUpdate:
        """Register a sweep and measure the time of the registration itself.

        The times of the points count from ``stamp``, nanoseconds; the stamp of the result is the
        moment that the pose belongs to. Raises InputError if the peer cannot take this sweep.
        """
        started = time.perf_counter()
        pose, moment = self._register(stamp, sweep)
        timings = {"register": time.perf_counter() - started}
        stamp += round(moment * 1e9)
        update = MapUpdate(stamp, gtsam.Pose3(pose), FrameStatus.OK, timings=timings)
        self.updates.append(update)
        return update

    @property
    def trajectory(self) -> Trajectory:
        """One pose per sweep, stamped with the moment that it belongs to."""
        stamps = [update.stamp for update in self.updates]
        return Trajectory.from_poses(stamps, [update.map_T_lidar for update in self.updates])

    @property
    @abstractmethod
    def map_points(self) -> int:
        """Number of points in the present map, or of voxels if the peer keeps distributions."""

    @abstractmethod
    def _register(self, stamp: int, sweep: TimedPoints) -> tuple[FloatArray, float]:
        """Pose (4, 4) of a sweep, and the moment of the pose in seconds from the stamp."""


class _IcpPeer(Peer):
    """A peer of the KISS-ICP family, with the names of two classes in its package."""

    deskew: bool = True
    settings_class: str
    system_class: str

    def __init__(self) -> None:
        super().__init__()
        settings = getattr(_module(self, "config"), self.settings_class)()
        settings.data.deskew = self.deskew
        if settings.mapping.voxel_size is None:  # as its own load_config does
            settings.mapping.voxel_size = settings.data.max_range / 100.0
        self._icp = getattr(_module(self, self.module), self.system_class)(settings)

    @property
    def map_points(self) -> int:
        """See :attr:`Peer.map_points`."""
        return len(self._icp.local_map.point_cloud())

    def _register(self, stamp: int, sweep: TimedPoints) -> tuple[FloatArray, float]:
        times, moment = np.zeros(0), sum(sweep.span) / 2.0
        if self.deskew:
            if len(sweep.times) == 0 or sweep.times.min() >= sweep.times.max():
                # Equal times would end the process.
                raise InputError(f"{self.name}: expected points of different times to de-skew with")
            times, moment = self._deskewed(sweep.times)
        self._icp.register_frame(sweep.points, times)
        return np.array(self._icp.last_pose), moment

    @abstractmethod
    def _deskewed(self, times: FloatArray) -> tuple[FloatArray, float]:
        """Times in the peer's own unit, and the moment that the peer de-skews to, in seconds."""


class KissIcp(_IcpPeer):
    """KISS-ICP (Vizzo et al., RA-L 2023).

    Version 1.3 de-skews to the time of the *last* point, so the pose belongs to that time. Without
    de-skew a pose fits the whole sweep best at the middle of the sweep.
    """

    name, package, module = "kiss-icp", "kiss-icp", "kiss_icp"
    settings_class, system_class = "KISSConfig", "KissICP"

    def _deskewed(self, times: FloatArray) -> tuple[FloatArray, float]:
        return times, float(times.max())


class KissIcpNoDeskew(KissIcp):
    """KISS-ICP without de-skew: better where the motion is far from a constant velocity."""

    name, deskew = "kiss-icp-no-deskew", False


class GenzIcp(_IcpPeer):
    """GenZ-ICP (Lee et al., RA-L 2025).

    The de-skew of GenZ-ICP is off by default, for data that are de-skewed already; here it is on.
    Version 0.3 takes times from 0 to 1 and de-skews to 0.5, so that the pose belongs to the middle
    of the sweep, as it does without de-skew. Two instances in one process disturb each other.
    """

    name, package, module = "genz-icp", "genz-icp", "genz_icp"
    alone = True
    settings_class, system_class = "GenZConfig", "GenZICP"

    def _deskewed(self, times: FloatArray) -> tuple[FloatArray, float]:
        first, last = float(times.min()), float(times.max())
        return (times - first) / (last - first), (first + last) / 2.0


class GenzIcpNoDeskew(GenzIcp):
    """GenZ-ICP without de-skew, which is its default."""

    name, deskew = "genz-icp-no-deskew", False


class SmallGicp(Peer):
    """Odometry with small_gicp (Koide, JOSS 2024): each sweep against a map of Gaussian voxels.

    small_gicp is a registration library; this class adds a simple odometry. The motion between the
    last two poses de-skews the points to the middle of the sweep and predicts the pose; each
    registered sweep is added to the map. The sizes are the defaults of small_gicp.
    """

    name, package, module = "small-gicp", "small_gicp", "small_gicp"
    downsampling = 0.25
    voxel = 1.0

    def __init__(self) -> None:
        super().__init__()
        self._gicp = _module(self)
        self._map = self._gicp.GaussianVoxelMap(self.voxel)
        self._twist = np.zeros(6)
        self._last: tuple[int, gtsam.Pose3] | None = None

    @property
    def map_points(self) -> int:
        """See :attr:`Peer.map_points`."""
        return int(self._map.size())

    def _register(self, stamp: int, sweep: TimedPoints) -> tuple[FloatArray, float]:
        middle = sum(sweep.span) / 2.0
        now = stamp + round(middle * 1e9)
        points = move_points(sweep.points, self._twist, sweep.times - middle)
        cloud, _ = self._gicp.preprocess_points(points, self.downsampling)
        pose = gtsam.Pose3()
        if self._last is not None:
            before, last = self._last
            seconds = (now - before) * 1e-9
            guess = last.compose(gtsam.Pose3.Expmap(self._twist * seconds))
            pose = gtsam.Pose3(self._gicp.align(self._map, cloud, guess.matrix()).T_target_source)
            self._twist = gtsam.Pose3.Logmap(last.between(pose)) / seconds
        self._last = now, pose
        self._map.insert(cloud, pose.matrix())
        return pose.matrix(), middle


PEERS: dict[str, type[Peer]] = {
    peer.name: peer for peer in (KissIcp, KissIcpNoDeskew, SmallGicp, GenzIcp, GenzIcpNoDeskew)
}
"""Every peer by its name on the command line."""


def make_peer(name: str) -> Peer:
    """The peer called ``name``, with its defaults.

    Raises PeerError if no peer has this name, or the peer is not installed.
    """
    if name not in PEERS:
        raise PeerError(f"unknown peer {name!r} (known: {', '.join(sorted(PEERS))})")
    return PEERS[name]()


def _module(peer: Peer, name: str = "") -> Any:
    try:
        return importlib.import_module(f"{peer.module}.{name}" if name else peer.module)
    except ImportError as error:
        raise PeerError(
            f"{peer.name} cannot be imported ({error}); install it with: pip install "
            f'{peer.package}, or all peers with: pip install "loam_gtsam[bench]"'
        ) from error
