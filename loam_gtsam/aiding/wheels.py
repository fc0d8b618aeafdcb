"""The motion from sweep to sweep by the wheels, while it agrees with what the scans see."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.config import AidingConfig, Config
from loam_gtsam.datasets.decode.aiding import WheelSamples
from loam_gtsam.errors import check_kind
from loam_gtsam.registration.odometry import ConstantVelocity, Guess, Odometry, Turns
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.types import ConfigError, Features, FrameStatus, MapUpdate

_GAP = 500_000_000  # nanoseconds between samples that are still interpolated
_REMEMBERED = 20  # sweeps that see all directions, by which the wheels are judged
_SHARE, _CREEP = 0.1, 0.1  # of the speed, and m/s, by which wheels may differ from the scans
_HARDEST = 10.0  # m/s^2 that no vehicle accelerates by: then the wheels spin, or are blocked


class _Step(NamedTuple):
    """The way of the lidar between two moments, by the wheels."""

    motion: gtsam.Pose3
    seconds: float

    @property
    def speed(self) -> float:
        """Metres a second."""
        return float(np.linalg.norm(self.motion.translation())) / self.seconds


class WheelOdometry(Odometry):
    """Predicts the sweeps by the wheels: how far; the gyro says which way, if there is one.

    Along directions that a scan does not fix the prediction stays
    (:class:`~loam_gtsam.registration.solvers.MotionPrior`); everywhere else the scan decides, and
    so wheels that slip bend nothing. The covariance along such directions is that of a constant
    velocity, which is wider than that of wheels.

    Parameters
    ----------
    config : where the vehicle's point is, seen from the lidar
    wheels : their way
    imu : source of the rotation; None takes that of the wheels

    Attributes
    ----------
    used, refused : numbers of sweeps that were predicted by the wheels, and for which they were
        not believed: they had contradicted the scans, or changed their speed as no vehicle can
    """

    def __init__(
        self, config: AidingConfig, wheels: WheelSamples, imu: Turns | None = None
    ) -> None:
        turn = gtsam.Rot3.RzRyRx(*np.deg2rad(config.lidar_R_wheels_deg))
        self._lidar_T_body = gtsam.Pose3(turn, np.array(config.lidar_t_wheels))
        self._wheels, self._steady = wheels, ConstantVelocity(imu)
        self.reset()

    def reset(self) -> None:
        """See :meth:`Odometry.reset`."""
        self._judged: list[bool] = []  # whether wheels and scan agreed, of the last sweeps
        self._last: MapUpdate | None = None  # that was judged
        self._believed: int | None = None  # stamp of the last sweep that they predicted
        self.used = self.refused = 0

    def guess(self, features: Features, last: MapUpdate | None) -> Guess:
        """See :meth:`Odometry.guess`."""
        steady = self._steady.guess(features, last)
        if last is None:
            return steady
        self._judge(last)
        step = self._step(last.stamp, features.stamp)
        if step is None:
            return steady
        if not self._plausible(step, last):
            self.refused += 1
            return steady
        self.used += 1
        self._believed = features.stamp
        twist = gtsam.Pose3.Logmap(step.motion) / step.seconds
        return Guess(last.map_T_lidar.compose(step.motion), np.asarray(twist, np.float64))

    def _judge(self, last: MapUpdate) -> None:
        """Compare the last motion with that of the wheels, if the scans saw all of it."""
        before, self._last = self._last, last
        if before is None or last.stamp <= before.stamp:
            return
        if not (before.status is FrameStatus.OK and last.status is FrameStatus.OK):
            return
        step = self._step(before.stamp, last.stamp)
        if step is None:
            return
        seen = before.map_T_lidar.between(last.map_T_lidar).translation() / step.seconds
        said = step.motion.translation() / step.seconds
        allowed = _SHARE * max(np.linalg.norm(seen), np.linalg.norm(said)) + _CREEP
        noise = 3.0 * np.sqrt(np.trace(relative_covariance(before, last)[3:, 3:])) / step.seconds
        agree = bool(np.linalg.norm(seen - said) < allowed + noise)
        self._judged = [*self._judged, agree][-_REMEMBERED:]

    def _plausible(self, step: _Step, last: MapUpdate) -> bool:
        """Whether the wheels agreed with the scans, and roll on as they did."""
        if self._judged and not 2 * sum(self._judged) > len(self._judged):
            return False
        if self._believed is None or last.status is FrameStatus.FIRST:
            return True
        since = (last.stamp - self._believed) * 1e-9 + step.seconds
        return abs(step.speed - float(np.linalg.norm(last.twist[3:]))) < _HARDEST * since + _CREEP

    def _step(self, first: int, second: int) -> _Step | None:
        """The way between two stamps; None if the wheels do not tell it."""
        ends = [self._at(first), self._at(second)]
        if second <= first or ends[0] is None or ends[1] is None:
            return None
        lidar = self._lidar_T_body
        motion = lidar.compose(ends[0].between(ends[1])).compose(lidar.inverse())
        return _Step(motion, (second - first) * 1e-9)

    def _at(self, stamp: int) -> gtsam.Pose3 | None:
        """``start_T_body`` at a moment."""
        times = self._wheels.stamps
        after = int(np.searchsorted(times, stamp, "left"))
        if after < len(times) and times[after] == stamp:
            return gtsam.Pose3(self._wheels.start_T_body[after])
        if after in (0, len(times)) or times[after] - times[after - 1] > _GAP:
            return None
        share = (stamp - int(times[after - 1])) / int(times[after] - times[after - 1])
        start, end = map(gtsam.Pose3, self._wheels.start_T_body[after - 1 : after + 1])
        return start.slerp(share, end)


def wheels_problem(odometry: object) -> str:
    """A sentence on wheels that were not believed for most sweeps; empty if they were, or none."""
    if not isinstance(odometry, WheelOdometry) or odometry.refused <= odometry.used:
        return ""
    told = odometry.used + odometry.refused
    return (
        f"wheels: not believed for {odometry.refused} of {told} sweeps: they contradicted the "
        "scans, or changed their speed as no vehicle can; check aiding.lidar_R_wheels_deg, their "
        "unit (m/s, rad/s) and stamps"
    )


def aided_odometry(
    config: Config, wheels: WheelSamples | None, imu: Turns | None
) -> WheelOdometry | None:
    """The prediction by the wheels, if they are to be used.

    Raises ConfigError if there are none, or the accelerometer predicts.
    """
    if not config.aiding.wheels:
        return None
    if wheels is None:
        raise ConfigError(
            "aiding.wheels: expected the odometry of the wheels, got none; give it to Pipeline as "
            "wheels=WheelSamples(...), or leave aiding.wheels out"
        )
    check_kind(wheels, WheelSamples, "wheels", "WheelSamples(stamps, start_T_body) makes one")
    if imu is not None and config.imu.coupling == "tight":
        raise ConfigError(
            "aiding.wheels: with imu.coupling tight the accelerometer predicts, not the wheels; "
            "choose one: imu.coupling loose (gyro and wheels), or aiding.wheels false"
        )
    return WheelOdometry(config.aiding, wheels, imu)
