"""Peers that use the lidar alone: KISS-ICP, GenZ-ICP, and an odometry with small_gicp."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.geometry import move_points
from loam_gtsam.studies.peers.base import Peer, TimedPoints
from loam_gtsam.types import FloatArray, InputError


class _IcpPeer(Peer):
    """A peer of the KISS-ICP family, with the names of two classes in its package."""

    knobs = MappingProxyType({"deskew": True, "voxel": None})
    settings_class: str
    system_class: str
    _icp: Any = None

    @property
    def map_points(self) -> int:
        """See :attr:`Peer.map_points`."""
        return 0 if self._icp is None else len(self._icp.local_map.point_cloud())

    def _start(self, sweep: TimedPoints) -> None:
        settings = getattr(self.load("config"), self.settings_class)()
        settings.data.deskew = self.settings["deskew"]
        # Their own load_config takes a hundredth of the range of the sensor.
        default = settings.mapping.voxel_size or settings.data.max_range / 100.0
        settings.mapping.voxel_size = self.voxel(sweep, default)
        self._icp = getattr(self.load(self.module), self.system_class)(settings)

    def _register(self, stamp: int, sweep: TimedPoints) -> tuple[FloatArray, float]:
        times, moment = np.zeros(0), sum(sweep.span) / 2.0
        if self.settings["deskew"]:
            if not sweep.times.max() > sweep.times.min():
                raise InputError(
                    f"{self.name}: expected points of different times, which its de-skew needs, "
                    f"got {len(sweep.times)} of one time; take {self.name}?deskew=false"
                )
            times, moment = self._deskewed(sweep.times)
        self._icp.register_frame(sweep.points, times)
        return np.array(self._icp.last_pose, np.float64), moment

    def _deskewed(self, times: FloatArray) -> tuple[FloatArray, float]:
        """Times in the peer's own unit, and the moment that the peer de-skews to, in seconds."""
        raise NotImplementedError


class KissIcp(_IcpPeer):
    """KISS-ICP (Vizzo et al., RA-L 2023).

    Version 1.3 de-skews to the time of the *last* point, so the pose belongs to that time. Without
    de-skew a pose fits the whole sweep best at the middle of the sweep.
    """

    name, package, module = "kiss-icp", "kiss-icp", "kiss_icp"
    settings_class, system_class = "KISSConfig", "KissICP"

    def _deskewed(self, times: FloatArray) -> tuple[FloatArray, float]:
        return times, float(times.max())


class GenzIcp(_IcpPeer):
    """GenZ-ICP (Lee et al., RA-L 2025).

    The de-skew of GenZ-ICP is off by default, for data that are de-skewed already; here it is on.
    Version 0.3 takes times from 0 to 1 and de-skews to 0.5, so that the pose belongs to the middle
    of the sweep, as it does without de-skew. Two instances in one process disturb each other.
    """

    name, package, module = "genz-icp", "genz-icp", "genz_icp"
    shares = False
    settings_class, system_class = "GenZConfig", "GenZICP"

    def _deskewed(self, times: FloatArray) -> tuple[FloatArray, float]:
        first, last = float(times.min()), float(times.max())
        return (times - first) / (last - first), (first + last) / 2.0


class SmallGicp(Peer):
    """Odometry with small_gicp (Koide, JOSS 2024): each sweep against a map of Gaussian voxels.

    small_gicp is a registration library; this class adds a simple odometry. The motion between the
    last two poses de-skews the points to the middle of the sweep and predicts the pose; each
    registered sweep is added to the map. The sizes are the defaults of small_gicp: voxels of the
    map of 1 m, points thinned to a quarter of it.
    """

    name, package, module = "small-gicp", "small_gicp", "small_gicp"
    knobs = MappingProxyType({"deskew": True, "voxel": None})

    def _start(self, sweep: TimedPoints) -> None:
        self._gicp = self.load()
        self._size = self.voxel(sweep, 1.0)
        self._map = self._gicp.GaussianVoxelMap(self._size)
        self._twist = np.zeros(6)
        self._last: tuple[int, gtsam.Pose3] | None = None

    @property
    def map_points(self) -> int:
        """See :attr:`Peer.map_points`."""
        return int(self._map.size()) if self._started else 0

    def _register(self, stamp: int, sweep: TimedPoints) -> tuple[FloatArray, float]:
        middle = sum(sweep.span) / 2.0
        now = stamp + round(middle * 1e9)
        points = sweep.points
        if self.settings["deskew"]:
            points = move_points(points, self._twist, sweep.times - middle)
        cloud, _ = self._gicp.preprocess_points(points, 0.25 * self._size)
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
