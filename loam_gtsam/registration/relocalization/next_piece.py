"""Another piece of map: of sweeps that fit the map nowhere, with which the run goes on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import gtsam
import numpy as np

from loam_gtsam.geometry import symmetric
from loam_gtsam.imu.preintegration import StartSigmas
from loam_gtsam.registration.odometry import ANYWHERE, LONGEST, Prediction
from loam_gtsam.types import Features, FloatArray, MapUpdate

if TYPE_CHECKING:
    from loam_gtsam.mapper import Mapper
    from loam_gtsam.registration.relocalization.fits import FitMonitor

CONTINUED = "the run goes on in another piece of map"
"""Is in the message of the first frame that has its pose in another piece of map."""
_KNOWN = 3  # sweeps by which the velocity after a gap is known
_USUAL = 3.0  # times the root mean square of the accelerations before a gap that are likely in it
_LIKELY = 0.5, 2.0
"""rad/s^2 and m/s^2 that are likely in any gap: a car brakes and turns at a crossing, and what
stood still is carried away."""


@dataclass(frozen=True, slots=True, eq=False)
class Gap:
    """The time since the last sweep that was found.

    Attributes
    ----------
    stamp, map_T_lidar : nanoseconds, and the pose then
    twist : (6,) body velocity then, rad/s and m/s
    accelerations : (6,) mean squares of those that are likely, (rad/s^2)^2 and (m/s^2)^2
    """

    stamp: int
    map_T_lidar: gtsam.Pose3
    twist: FloatArray
    accelerations: FloatArray

    @classmethod
    def since(cls, found: MapUpdate, usual: FloatArray) -> Self:
        """Since a sweep, before which accelerations had ``usual`` mean squares (6,)."""
        assert found.map_T_middle is not None
        likely = np.maximum(_USUAL**2 * usual, np.repeat(_LIKELY, 3) ** 2)
        return cls(found.middle_stamp, found.map_T_middle, found.twist, likely)

    def steady(self, stamp: int) -> gtsam.Pose3:
        """The pose at the velocity before the gap."""
        return self.map_T_lidar.expmap((stamp - self.stamp) * 1e-9 * self.twist)

    def bridged(
        self, stamp: int, twist: FloatArray, turned: gtsam.Rot3 | None = None
    ) -> tuple[gtsam.Pose3, FloatArray]:
        """The pose after the gap, and its covariance (6, 6) on the left, in map axes.

        ``twist`` (6,) is the body velocity then, and ``turned`` the rotation in between by a gyro,
        of an unknown bias, if it tells. The mean of both velocities leads to the pose. An
        acceleration ``a`` that brings the velocity away from a straight line between them, and back
        again, moves it by ``a T^2 / 4``, with the rotation that the lidar has half way.
        """
        seconds = (stamp - self.stamp) * 1e-9
        before = self.map_T_lidar.rotation()
        seconds = seconds if seconds > 0.0 else LONGEST  # a clock that was set back
        steady = min(seconds, LONGEST)
        by_mean = gtsam.Rot3.Expmap(0.5 * steady * (self.twist[:3] + twist[:3]))
        after = before.compose(by_mean if turned is None else turned)
        way = 0.5 * steady * (before.rotate(self.twist[3:]) + after.rotate(twist[3:]))
        start = self.map_T_lidar.translation()
        half = gtsam.Pose3(before.slerp(0.5, after), start + 0.5 * way)
        squares = np.maximum(self.accelerations, ((twist - self.twist) / seconds) ** 2)
        sigmas = 0.25 * seconds**2 * np.sqrt(squares)
        if turned is not None:
            sigmas[:3] = StartSigmas().gyro_bias * seconds
        sigmas = np.minimum(sigmas, ANYWHERE)
        return gtsam.Pose3(after, start + way), spread_in_map(half, sigmas)


def spread_in_map(pose: gtsam.Pose3, sigmas: FloatArray) -> FloatArray:
    """Covariance (6, 6) on the left, in map axes, by the deviations (6,) in those of a pose."""
    to_map = pose.AdjointMap() * sigmas
    return symmetric(to_map @ to_map.T)


def goes_on(mapper: Mapper, features: Features) -> bool:
    """Whether sweeps that are not found can make another piece of map, as these features can.

    In the first sweeps of a map there may be too little of it around without a gap.
    """
    config = mapper.config.relocalization
    allowed = config.enabled and config.new_piece > 0 and not mapper.maps.given
    enough = 2 * mapper.config.solver.min_matches
    many = len(features.edges) + len(features.planes) >= enough
    begun = mapper.start is None or mapper.monitor.lost > 0
    return allowed and many and begun and mapper.errors.gap is not None


class NextPiece:
    """What is mapped of sweeps that are not found, beside the map in which they are looked for.

    It begins with the first of them, and anew with each that does not fit those before. Where it
    is, the velocity after the gap tells, which the third sweep knows.

    Attributes
    ----------
    gap : since the last sweep that was found
    mapper : of the piece
    """

    mapper: Mapper

    def __init__(self, gap: Gap | None) -> None:
        assert gap is not None  # or no run goes on
        self.gap = gap
        self._last: MapUpdate | None = None  # None before the first sweep
        self._first: list[Features] = []  # sweeps whose place is not known yet
        self._turned: gtsam.Rot3 | None = None  # in the gap, by a gyro

    def add(self, beside: Mapper, features: Features, predicted: Prediction) -> MapUpdate | None:
        """Map a further sweep; its update if the run is to go on in this piece.

        Its poses are predicted by itself: an odometry may have lost its way as well.

        Parameters
        ----------
        beside : in whose map the sweep is not found
        predicted : where it is expected there
        """
        if self._last is not None:
            self._last = self.mapper.register(features)
            if self._last.status.solved:
                self._place(beside, features)
                return self._found_after(beside.monitor)
        uncertain, self._first = np.zeros((6, 6)), [features]
        if predicted.inertial is not None:
            uncertain, self._first = predicted.inertial.covariance_in_map, []
        if (gyro := beside.imu) is not None:
            self._turned = gyro.rotation_between(self.gap.stamp, features.stamp)
        self.mapper = _another(beside, uncertain)
        self._last = self.mapper.register(features, predicted.map_T_lidar)
        return None

    def _found_after(self, beside: FitMonitor) -> MapUpdate | None:
        """The last update, once sweeps are judged by this map and not looked for in the other."""
        last, mapper = self._last, self.mapper
        begun = not self._first and mapper.start is None and mapper.monitor.ready
        if last is None or not begun or not beside.gives_up:
            return None
        message = f"after {beside.lost} lost sweeps {CONTINUED}"
        return replace(last, message="; ".join(filter(None, (message, last.message))))

    def _place(self, beside: Mapper, features: Features) -> None:
        """Begin anew where the velocity leads, once it is known."""
        if not self._first:
            return
        assert self._last is not None
        self._first.append(features)
        if len(self._first) < _KNOWN:
            return
        sweeps, self._first, twist = self._first, [], self._last.twist
        pose, covariance = self.gap.bridged(sweeps[0].stamp, twist, self._turned)
        carried = self._carried_off(pose, beside.monitor.widest)
        self.mapper = _another(beside, covariance + carried)
        self.mapper.register(sweeps[0], pose, twist)
        for sweep in sweeps[1:]:
            self._last = self.mapper.register(sweep)

    def _carried_off(self, pose: gtsam.Pose3, searched: float) -> FloatArray:
        """Covariance (6, 6) of the piece, on the left, in map axes, if no motion led to it.

        The motion leads to ``pose``. If that is less than the radius that is ``searched``, metres,
        from the last sweep that was found, the map has what is seen there. As likely as not, the
        lidar is farther off: it was carried, or sweeps are missing of which the stamps do not tell.
        """
        if pose.range(self.gap.map_T_lidar) > searched:
            return np.zeros((6, 6))
        sigmas = np.repeat([ANYWHERE[0] if self._turned is None else 0.0, searched], 3)
        return 0.5 * spread_in_map(pose, sigmas)


def _another(beside: Mapper, uncertain: FloatArray) -> Mapper:
    """A mapper like another one, of a map that is so uncertain, (6, 6) on the left, in map axes."""
    imu = None if beside.imu is None else beside.imu.buffer
    factors = beside.extra_factors
    mapper = type(beside)(beside.config, beside.solver, imu=imu, extra_factors=factors)
    mapper.errors.begin_after(beside.errors, uncertain)
    return mapper
