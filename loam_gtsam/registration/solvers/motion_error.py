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
_LASTS = 2.0
"""Seconds for which a vehicle goes on to gather speed: the time constant of an exponential
correlation (Singer, Estimating optimal tracking filter performance for manned maneuvering targets,
IEEE Transactions on Aerospace and Electronic Systems 6, 1970)."""
_LEAST = 1e-12  # (rad/s)^2 and (m/s)^2: keeps the covariance of the state regular

_LEAST_SHARE = 1e-15  # of the sum of all: a root is found to some 1e-16 of the largest variance


@dataclass(frozen=True, slots=True, eq=False)
class BlindStep:
    """What a frame adds to the error that the expected motion alone leaves; axes of the lidar.

    The error of velocity and acceleration is ``root @ u``, with u (9,) of unit covariance.

    Attributes
    ----------
    by_velocity : (6, 9) displacement by the u of the last frame, rad and m
    by_chance : (6, 6) covariance of a displacement that has nothing to do with others
    kept : (9, 9) correlation of this frame's u (rows) with the last frame's (columns)
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
    sees it is the one before. An angular acceleration lasts for a frame, a linear one for seconds:
    a vehicle that starts unseen gathers speed. The state is the velocity and that acceleration.
    Covariances are of right perturbations.
    """

    def __init__(self, config: SolverConfig) -> None:
        self._turn, self._acceleration = config.turn_sigma**2, config.acceleration_sigma**2
        start = [config.start_turn**2, config.start_speed**2, self._acceleration]
        self._state = np.diag(np.repeat(start, 3))
        self._scan = np.zeros((6, 6))  # of the last solved pose in the map around it
        self._pose = np.zeros((6, 6))  # of the last pose in the map around it
        self._solved: int | None = None  # stamp of the last solved pose, nanoseconds
        self._last: int | None = None  # stamp of the last pose
        self._turned = False

    @property
    def velocity(self) -> FloatArray:
        """(6, 6) covariance."""
        return self._state[:6, :6]

    def cut(self) -> None:
        """The next frame is on another clock than the frames before."""
        self._solved = self._last = None

    def of_expected(self, stamp: int, *, turned: bool) -> FloatArray:
        """Covariance of the pose expected at a stamp; ``turned`` if a gyro knows the rotation."""
        seconds = self._seconds(stamp, self._solved)
        moved = _moved(seconds)
        by_state = moved @ self._known(turned=turned) @ moved.T
        return self._scan + by_state + self._by_turning(seconds, turned=turned)

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
        state, by_turning = self._known(turned=turned), self._by_turning(since, turned=turned)
        tied = share - np.eye(6)
        noise = np.zeros((9, 9))
        by_pose = tied @ self._pose @ tied.T + scan
        noise[:6, :6] = by_pose / seconds**2 + share @ by_turning @ share.T / since**2
        passed_on = np.zeros((9, 9))
        passed_on[:6] = share @ _moved(since) / since
        if turned:  # the scan has no say in the velocity
            passed_on[:3] = np.eye(9)[:3]
            noise[:3] = noise[:, :3] = 0.0
        stays = np.exp(-since / _LASTS)
        passed_on[6:, 6:] = stays * np.eye(3)
        noise[6:, 6:] = (1.0 - stays**2) * self._acceleration * np.eye(3)
        before = positive_root(state)
        found = symmetric(passed_on @ state @ passed_on.T + noise)
        least = max(_LEAST, _LEAST_SHARE * float(np.trace(found)))
        self._state = found + least * np.eye(9)
        kept = np.linalg.solve(positive_root(self._state), passed_on @ before)
        left, values, right = np.linalg.svd(kept)
        # What is tied to the map by 1 - share is drawn back to the map by that in the next frame.
        lasting = share @ share
        step = BlindStep(
            lasting @ _moved(since) @ before,
            lasting @ (self._scan + by_turning) @ lasting.T,
            (left * np.minimum(values, 1.0)) @ right,
        )
        self._scan = self._pose = scan
        self._solved = self._last = stamp
        self._turned = turned
        return step

    def _known(self, *, turned: bool) -> FloatArray:
        """Covariance of the state with which the next pose is predicted."""
        if not turned or self._turned:
            return self._state
        state = self._state.copy()
        state[:3] = state[:, :3] = 0.0
        state[:3, :3] = _GYRO_RATE**2 * np.eye(3)
        return state

    def _by_turning(self, seconds: float, *, turned: bool) -> FloatArray:
        """What the angular acceleration since the last pose does to the expected one."""
        return np.diag(np.repeat([0.0 if turned else seconds**4 * self._turn, 0.0], 3))

    @staticmethod
    def _seconds(stamp: int, since: int | None) -> float:
        return 0.1 if since is None else max((stamp - since) * 1e-9, 1e-3)


def _moved(seconds: float) -> FloatArray:
    """(6, 9) displacement over some seconds by the state."""
    return np.hstack([seconds * np.eye(6), seconds**2 * np.eye(6, 3, k=-3)])
