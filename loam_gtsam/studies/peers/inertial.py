"""Peers that use lidar and IMU: RKO-LIO and GenZ-LIO."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np

from loam_gtsam.geometry import inverse_pose
from loam_gtsam.studies.peers.base import Inertial, Peer, PeerError, TimedPoints
from loam_gtsam.types import FloatArray, InputError, IntArray


class _InertialPeer(Peer):
    """A peer that gets the samples up to the end of each sweep; PeerError without an IMU."""

    shares = False  # they write to the terminal, too
    _lio: Any = None

    def _start(self, sweep: TimedPoints) -> None:
        if self.imu is None:
            raise PeerError(f"{self.name} needs an IMU, and the data set has none")
        self._imu: Inertial = self.imu
        self._given = 0

    def _samples(self, end: int) -> tuple[IntArray, FloatArray, FloatArray]:
        """Stamps (M,), accelerations (M, 3) and rates (M, 3) since the last sweep."""
        samples = self._imu.samples
        last = int(np.searchsorted(samples.stamps, end, side="right"))
        new, self._given = slice(self._given, max(last, self._given)), max(last, self._given)
        return samples.stamps[new], samples.acceleration[new], samples.gyro[new]


class RkoLio(_InertialPeer):
    """RKO-LIO (Malladi et al., RA-L 2026).

    Its defaults, among them a start without the phase that finds gravity (``initialize`` turns it
    on: the sensor must then be at rest between the first two sweeps). Version 0.4 de-skews to the
    end of the sweep, to which the pose belongs.
    """

    name, package, module = "rko-lio", "rko-lio", "rko_lio"
    knobs = MappingProxyType({"deskew": True, "voxel": None, "initialize": False})

    @property
    def map_points(self) -> int:
        """See :attr:`Peer.map_points`."""
        return 0 if self._lio is None else len(self._lio.map_point_cloud())

    def _start(self, sweep: TimedPoints) -> None:
        super()._start(sweep)
        lio, config = self.load("lio"), self.load("config")
        settings = config.LIOConfig(
            deskew=self.settings["deskew"], initialization_phase=self.settings["initialize"]
        )
        settings.voxel_size = self.voxel(sweep, settings.voxel_size)
        self._lio = lio.LIO(settings)

    def _register(self, stamp: int, sweep: TimedPoints) -> tuple[FloatArray, float]:
        first, last = (stamp + round(moment * 1e9) for moment in sweep.span)
        for time, acceleration, rate in zip(*self._samples(last), strict=True):
            self._lio.add_imu_measurement(acceleration, rate, int(time), self._imu.lidar_T_imu)
        times = stamp + np.round(sweep.times * 1e9).astype(np.int64)
        self._lio.register_scan(sweep.points, times, np.eye(4), first, last)
        return np.array(self._lio.pose(), np.float64), sweep.span[1]


class GenzLio(_InertialPeer):
    """GenZ-LIO (Lee et al., 2026).

    Its defaults; the number of beams and the rate of the sensor, which it asks for, come from the
    first sweep. Version 0.1 gives the pose of the IMU at the end of the sweep, which is moved to
    the lidar here. The sweeps before it has found gravity, for which the sensor should be at rest,
    have no pose.
    """

    name, package, module = "genz-lio", "genz-lio", "genz_lio"
    knobs = MappingProxyType({"voxel": None})

    @property
    def map_points(self) -> int:
        """See :attr:`Peer.map_points`."""
        return 0 if self._lio is None else int(self._lio.map_size)

    def _start(self, sweep: TimedPoints) -> None:
        super()._start(sweep)
        package = self.load()
        config = package.Config()
        config.preprocess.scan_rate = max(1, round(1.0 / max(sweep.span[1] - sweep.span[0], 1e-3)))
        config.mapping.voxel_size = self.voxel(sweep, config.mapping.voxel_size)
        imu_T_lidar = inverse_pose(self._imu.lidar_T_imu)
        config.mapping.extrinsic_r = imu_T_lidar[:3, :3]
        config.mapping.extrinsic_t = imu_T_lidar[:3, 3]
        self._lio = package.GenZLIO(config)
        self._imu_T_lidar = imu_T_lidar

    def _register(self, stamp: int, sweep: TimedPoints) -> tuple[FloatArray | None, float]:
        first, last = sweep.span
        stamps, acceleration, rate = self._samples(stamp + round(last * 1e9))
        if not len(stamps):
            raise InputError(f"{self.name}: no IMU samples between this sweep and the last")
        found = self._lio.register_scan(
            sweep.points,
            stamp * 1e-9 + first,
            stamp * 1e-9 + last,
            np.column_stack([stamps * 1e-9, acceleration, rate]),
            timestamps=sweep.times - first,
        )
        pose = np.array(found.pose, np.float64) @ self._imu_T_lidar if found.valid else None
        return pose, last
