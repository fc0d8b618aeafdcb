"""How wrong the expected motion is: a wrong velocity stays wrong along what no scan sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loam_gtsam.config import SolverConfig
from loam_gtsam.geometry import positive_root, symmetric
from loam_gtsam.registration.solvers.base import SCAN_VARIANCE
from loam_gtsam.types import FloatArray

_GYRO_RATE = 0.01
"""Error of a gyro's rate, rad/s: 0.6 degrees/s, a bias that was not learnt yet."""
_LEAST = 1e-12  # (rad/s)^2 and (m/s)^2: keeps the velocity's covariance regular

_LEAST_SHARE = 1e-15  # of the sum of all: a root is found to some 1e-16 of the largest variance


@dataclass(frozen=True, slots=True, eq=False)
class BlindStep:
    """What a frame adds to the error that the expected motion alone leaves; axes of the lidar.

    The error of the velocity is ``root @ u``, with u of unit covariance.

    Attributes
    ----------
    by_velocity : (6, 6) displacement by the u of the last frame, rad and m
    by_chance : (6, 6) covariance of a displacement that has nothing to do with others
    kept : (6, 6) correlation of this frame's u (rows) with the last frame's (columns)
    """

    by_velocity: FloatArray
    by_chance: FloatArray
    kept: FloatArray


class MotionError:
    """Covariance of the velocity by which the next pose is predicted, and of that pose.

    The velocity is that between the last two poses. With W the share of a pose that the expected
    motion decides, s the error of the scan and n that of the acceleration, the errors are

        pose: W (velocity * seconds + n) + s,  velocity: the change of that error over the seconds.

    So along what a scan sees the velocity's error is new with every frame, and along what no scan
    sees it is the one before. Covariances are (6, 6), right perturbations.
    """

    def __init__(self, config: SolverConfig) -> None:
        turn, speed = config.turn_sigma, config.acceleration_sigma
        self._missed = np.repeat([turn, speed], 3) ** 2
        self.velocity = np.diag(np.repeat([config.start_turn, config.start_speed], 3) ** 2.0)
        self._scan = np.zeros((6, 6))  # of the last solved pose in the map around it
        self._pose = np.zeros((6, 6))  # of the last pose in the map around it
        self._solved: int | None = None  # stamp of the last solved pose, nanoseconds
        self._last: int | None = None  # stamp of the last pose
        self._turned = False

    def cut(self) -> None:
        """The next frame is on another clock than the frames before."""
        self._solved = self._last = None

    def of_expected(self, stamp: int, *, turned: bool) -> FloatArray:
        """Covariance of the pose expected at a stamp; ``turned`` if a gyro knows the rotation."""
        seconds = self._seconds(stamp, self._solved)
        velocity = seconds**2 * self._known(turned=turned)
        return self._scan + velocity + self._by_acceleration(seconds, turned=turned)

    def coast(self, stamp: int, *, turned: bool) -> None:
        """The pose at a stamp is the expected one; the first pose is exact."""
        if self._solved is None:
            self._solved = stamp
        else:
            self._pose = self.of_expected(stamp, turned=turned)
        self._last = stamp

    def observe(self, stamp: int, share: FloatArray, raw: FloatArray, *, turned: bool) -> BlindStep:
        """Take in a solved pose, and say what the expected motion made of it.

        ``share`` is the (6, 6) part of the pose that the expected motion decides, and ``raw`` the
        (6, 6) raw covariance of what else decides.
        """
        since, seconds = self._seconds(stamp, self._solved), self._seconds(stamp, self._last)
        scan = SCAN_VARIANCE * raw
        velocity, missed = self._known(turned=turned), self._by_acceleration(since, turned=turned)
        tied = share - np.eye(6)
        noise = tied @ self._pose @ tied.T + scan
        noise = noise / seconds**2 + share @ missed @ share.T / since**2
        passed_on = share.copy()
        if turned:  # the scan has no say in the velocity
            passed_on[:3] = np.eye(6)[:3]
            noise[:3] = noise[:, :3] = 0.0
        before = positive_root(velocity)
        found = symmetric(passed_on @ velocity @ passed_on.T + noise)
        least = max(_LEAST, _LEAST_SHARE * float(np.trace(found)))
        self.velocity = found + least * np.eye(6)
        kept = np.linalg.solve(positive_root(self.velocity), passed_on @ before)
        left, values, right = np.linalg.svd(kept)
        # What is tied to the map by 1 - share is drawn back to the map by that in the next frame.
        lasting = share @ share
        step = BlindStep(
            since * lasting @ before,
            lasting @ (self._scan + missed) @ lasting.T,
            (left * np.minimum(values, 1.0)) @ right,
        )
        self._scan = self._pose = scan
        self._solved = self._last = stamp
        self._turned = turned
        return step

    def _known(self, *, turned: bool) -> FloatArray:
        """Covariance of the velocity with which the next pose is predicted."""
        if not turned or self._turned:
            return self.velocity
        velocity = self.velocity.copy()
        velocity[:3] = velocity[:, :3] = 0.0
        velocity[:3, :3] = _GYRO_RATE**2 * np.eye(3)
        return velocity

    def _by_acceleration(self, seconds: float, *, turned: bool) -> FloatArray:
        """What the acceleration since the last pose does to the expected one."""
        missed = seconds**4 * self._missed
        if turned:
            missed[:3] = 0.0
        return np.diag(missed)

    @staticmethod
    def _seconds(stamp: int, since: int | None) -> float:
        return 0.1 if since is None else max((stamp - since) * 1e-9, 1e-3)
