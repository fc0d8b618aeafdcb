"""The expected motion, and its error: along what no scan sees, a wrong velocity stays wrong."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from loam_gtsam.config import SolverConfig
from loam_gtsam.geometry import symmetric
from loam_gtsam.registration.solvers.base import SCAN_VARIANCE
from loam_gtsam.types import FloatArray

_GYRO_RATE = 0.01
"""Error of a gyro's rate, rad/s: 0.6 degrees/s, a bias that was not learnt yet."""
_LASTS = 2.0
"""Seconds for which a vehicle goes on to gather speed: the time constant of an exponential
correlation (Singer, Estimating optimal tracking filter performance for manned maneuvering targets,
IEEE Transactions on Aerospace and Electronic Systems 6, 1970)."""
_LEAST = 1e-12  # squares of rad, m, rad/s and m/s: keeps covariances regular
_SHORTEST, _LONGEST = 1e-3, 10.0  # seconds of extrapolation: after more it would be anywhere
_WHOLLY = 64
"""Power of the share that the expected motion decides, which leaves only what it decides alone: of
a share of 0.8, beside a user's factor, nothing, and of 0.9997, by noise, nearly all."""
_UNKNOWN = 1e2  # rad and metres: error of a solved pose along what its scan does not see
_NO_MORE = 5.0
"""Standard deviations of the start beyond which no velocity is unknown: 50 m/s and 2.5 rad/s. Where
what is blind swings from frame to frame, the gain of the one error may add to the other."""
_LEAST_SHARE = 1e-14  # of the largest variance, to which all are found to some 1e-16


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


class MotionFilter:
    """The velocity by which the next pose is predicted, and its covariance.

    A Kalman filter whose measurements are the solved poses. With W the share of a pose that the
    expected motion decides, e the error of the last pose in the map around it, v that of the
    expected velocity and s that of the scan, the difference of expected and solved pose is

        (1 - W) (e + v seconds) - s.

    After a blind way e is all that was strayed on it, if the next scan to see anything sees what
    was mapped before; the velocity is corrected as if it did. It may also see what was mapped on
    the way: so the velocity's covariance is that for an e of the scan alone, which is larger.

    So a scan that hardly fixes a direction hardly changes the velocity along it, and one that does
    not see it leaves the velocity as it was. An angular acceleration lasts for a frame, a linear
    one for seconds: a vehicle that starts unseen gathers speed. The state is the body velocity and
    that acceleration, which has covariances but no estimate. Covariances are of right
    perturbations.
    """

    def __init__(self, config: SolverConfig) -> None:
        self._turn, self._acceleration = config.turn_sigma**2, config.acceleration_sigma**2
        start = [config.start_turn**2, config.start_speed**2, self._acceleration]
        self._most = _NO_MORE * np.repeat([config.start_turn, config.start_speed], 3)
        self._twist = np.zeros(6)
        self._state = np.diag(np.repeat(start, 3))
        # The last solved pose: in the map around it, and in the map before the way was blind.
        self._here = self._there = _Tie(np.zeros((6, 6)), np.zeros((9, 6)))
        self._stamp: int | None = None  # stamp of that pose, nanoseconds
        self._turned = False

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) of the velocity."""
        return self._state[:6, :6]

    def cut(self) -> None:
        """The next frame is on another clock than the frames before."""
        self._stamp = None

    def begin(self, stamp: int) -> None:
        """The first pose of all, which is exact."""
        self._stamp = stamp

    @property
    def stamp(self) -> int | None:
        """Of the last solved pose, nanoseconds; None if there is none on this clock."""
        return self._stamp

    def expected(
        self, stamp: int, last: gtsam.Pose3, turned: gtsam.Rot3 | None = None
    ) -> gtsam.Pose3:
        """The pose at a stamp, from the last solved one; ``turned`` since then, by a gyro."""
        way = self._twist * self._seconds(stamp)
        if turned is None:
            return last.compose(gtsam.Pose3.Expmap(way))
        # With a known rotation, the velocity in the map is constant, not the body velocity.
        return last.compose(gtsam.Pose3(turned, way[3:]))

    def told(self, velocity: FloatArray) -> None:
        """Go on with a velocity (3,) of the last solved pose that an IMU told, m/s, its axes.

        The covariance stays that of the scans alone, the larger one.
        """
        self._twist = np.concatenate([self._twist[:3], velocity])

    def observe(
        self,
        stamp: int,
        last: gtsam.Pose3 | None,
        now: gtsam.Pose3,
        share: FloatArray,
        raw: FloatArray,
        *,
        turned: bool,
    ) -> BlindStep:
        """Take in a solved pose, and say what the expected motion made of it.

        Parameters
        ----------
        last, now : the last solved pose, None if the way from there is not known, and this one
        share : (6, 6) part of the pose that the expected motion decides, without noise of normals
        raw : (6, 6) raw covariance of what else decides
        turned : whether a gyro tells the rotation between them
        """
        seconds, state = self._seconds(stamp), self._known(turned=turned)
        before, to_unit = _roots(state)
        scan, seen = SCAN_VARIANCE * raw, np.eye(6) - share
        grown, sudden = self._growth(seconds, turned=turned)
        ahead = symmetric(grown @ state @ grown.T + np.diag(sudden))
        here = self._here.moved(grown, ahead, seconds)
        there = self._there.moved(grown, ahead, seconds)
        blind = np.linalg.matrix_power(share, _WHOLLY)
        spread = there.difference(seen, scan) + _UNKNOWN**2 * blind @ blind.T
        spread += max(_LEAST, _LEAST_SHARE * float(np.trace(spread))) * np.eye(6)
        gain = there.across @ seen.T @ np.linalg.inv(spread)
        # What is not seen stays as it is: by noise of normals, each sweep sees a little of it.
        gain[:6], gain[6:] = gain[:6] - blind @ gain[:6], 0.0
        if turned:
            gain[:3] = 0.0
        if last is None:
            gain[:] = 0.0
        else:
            self._correct(gain, stamp, last, now, turned=turned)
        common = gain @ seen @ here.across.T
        both = gain @ here.difference(seen, scan) @ gain.T
        state = symmetric(ahead - common - common.T + both)
        less = _lessening(state, self._most)
        self._state = symmetric(less @ state @ less.T)
        kept = (grown - seconds * gain @ seen @ grown[:6]) @ before
        kept -= gain @ seen @ (to_unit @ self._here.across).T
        left, values, right = np.linalg.svd(_roots(self._state)[1] @ kept)
        # What is tied to the map by 1 - share is drawn back to the map by that in the next frame.
        lasting = share @ share
        step = BlindStep(
            lasting @ (seconds * grown[:6]) @ before,
            lasting @ (self._here.error + np.diag(seconds**2 * sudden[:6])) @ lasting.T,
            (left * np.minimum(values, 1.0)) @ right,
        )
        self._here = _Tie(scan, gain @ scan).lessened(less)
        self._there = there.solved(share, scan, gain).lessened(less)
        self._stamp, self._turned = stamp, turned
        return step

    def _correct(
        self, gain: FloatArray, stamp: int, last: gtsam.Pose3, now: gtsam.Pose3, *, turned: bool
    ) -> None:
        rotation = last.rotation().between(now.rotation())
        expected = self.expected(stamp, last, rotation if turned else None)
        self._twist = self._twist + gain[:6] @ expected.localCoordinates(now)
        if turned:
            self._twist[3:] = rotation.matrix().T @ self._twist[3:]

    def _growth(self, seconds: float, *, turned: bool) -> tuple[FloatArray, FloatArray]:
        """(9, 9) by which errors of the state grow over a time, and (9,) new variances."""
        grown, stays = np.eye(9), np.exp(-seconds / _LASTS)
        grown[3:6, 6:] = seconds * np.eye(3)
        grown[6:, 6:] *= stays
        turning = 0.0 if turned else seconds**2 * self._turn
        return grown, np.repeat([turning, 0.0, (1.0 - stays**2) * self._acceleration], 3)

    def _known(self, *, turned: bool) -> FloatArray:
        """Covariance of the state with which the next pose is predicted."""
        if not turned or self._turned:
            return self._state
        state = self._state.copy()
        state[:3] = state[:, :3] = 0.0
        state[:3, :3] = _GYRO_RATE**2 * np.eye(3)
        return state

    def _seconds(self, stamp: int) -> float:
        """Seconds since the last solved pose."""
        if self._stamp is None:
            return 0.1
        return min(max((stamp - self._stamp) * 1e-9, _SHORTEST), _LONGEST)


@dataclass(frozen=True, slots=True, eq=False)
class _Tie:
    """The error of a pose, and what it has in common with that of the state.

    Attributes
    ----------
    error : (6, 6) covariance
    across : (9, 6) covariance of the state and the pose
    """

    error: FloatArray
    across: FloatArray

    def moved(self, grown: FloatArray, ahead: FloatArray, seconds: float) -> _Tie:
        """That of the expected pose: ``ahead`` (9, 9) is the state's that has ``grown``."""
        tied = grown @ self.across
        both = seconds * (tied[:6] + tied[:6].T)
        error = symmetric(self.error + both + seconds**2 * ahead[:6, :6])
        return _Tie(error, tied + seconds * ahead[:, :6])

    def lessened(self, less: FloatArray) -> _Tie:
        """The same with a state whose error is made less, by (9, 9)."""
        return _Tie(self.error, less @ self.across)

    def difference(self, seen: FloatArray, scan: FloatArray) -> FloatArray:
        """(6, 6) of the expected pose's to the solved one, of a (6, 6) error ``scan``."""
        spread: FloatArray = seen @ (self.error + scan) @ seen.T
        return spread

    def solved(self, share: FloatArray, scan: FloatArray, gain: FloatArray) -> _Tie:
        """That of the solved pose, if this is the expected one, and the state corrected."""
        seen = np.eye(6) - share
        across = self.across - gain @ seen @ self.error
        return _Tie(symmetric(share @ self.error @ share.T + scan), across @ share.T + gain @ scan)


def _lessening(state: FloatArray, most: FloatArray) -> FloatArray:
    """(9, 9) that brings the velocities of a covariance to within (6,) standard deviations."""
    less = np.eye(9)
    values, vectors = np.linalg.eigh(state[:6, :6] / np.outer(most, most))
    if values[-1] > 1.0:
        within = (vectors / np.sqrt(np.maximum(values, 1.0))) @ vectors.T
        less[:6, :6] = within * np.outer(most, 1.0 / most)
    return less


def _roots(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The symmetric root of a covariance and its inverse."""
    values, vectors = np.linalg.eigh(covariance)
    scales = np.sqrt(np.maximum(values, max(_LEAST, _LEAST_SHARE * values[-1])))
    root: FloatArray = ((vectors * scales) @ vectors.T).astype(np.float64)
    inverse: FloatArray = ((vectors / scales) @ vectors.T).astype(np.float64)
    return root, inverse
