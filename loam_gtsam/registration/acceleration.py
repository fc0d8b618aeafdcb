"""The acceleration of the lidar, from the poses at the middles of its sweeps."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from loam_gtsam.types import FloatArray

_USUAL = 3.0  # times the root mean square of the accelerations within which one is usual
_BEGUN = 2.0  # times the root mean square above which a surprise is the first of others
_LONGER = 1.5  # times the time between two sweeps for which accelerations are known
_LATER = 2.0 / 3.0
"""Of the time between two sweeps, by which the acceleration that sets the velocity in the middle of
the new one is later than the second difference of the poses, which is that in the last middle."""
_SLOWEST = 1e-3  # sine, of a frequency that no window shows
_SHORTEST = 1e-3  # least seconds between the middles of two sweeps
_KNOWN = 3  # accelerations from which their mean is believed


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """The next acceleration: a share of the last one, which the next pose tells.

    Attributes
    ----------
    stamp : nanoseconds, middle of the last sweep
    velocity : (6,) rad/s and m/s, body velocity between the middles of the last two sweeps
    share : (6,) by axis; none where accelerations do not last
    most : (6,) rad/s^2 and m/s^2, to which the last one is limited: the pose may have jumped
    variances : (6,) (rad/s^2)^2 and (m/s^2)^2, of what is not expected, as far as it can be
        believed: a jump of the pose is no acceleration
    """

    stamp: int
    velocity: FloatArray
    share: FloatArray
    most: FloatArray
    variances: FloatArray

    def at(self, since: int, seconds: float, velocity: FloatArray) -> FloatArray:
        """(6,) rad/s^2 and m/s^2, from the (6,) mean velocity over some seconds since a sweep.

        Nothing is expected if that sweep is not the last one.
        """
        acceleration = np.clip((velocity - self.velocity) / seconds, -self.most, self.most)
        expected: FloatArray = (since == self.stamp) * self.share * acceleration
        return expected


class Accelerations:
    """Mean squares of the body acceleration, from the poses at the middles of three sweeps.

    ``expected`` (6,), (rad/s^2)^2 and (m/s^2)^2, stands for them until three are known.
    """

    def __init__(self, window: int, expected: FloatArray) -> None:
        self._window = window
        self._count = 0
        self._expected = expected
        self._mean, self._raw, self._lasting, self._changed = np.zeros((4, 6))
        self._period = 0.0
        self._last: tuple[int, FloatArray] | None = None
        self._before: tuple[int, FloatArray] | None = None  # the last acceleration, noise and all
        self._first = np.zeros(6)
        # The last square, that of what was not expected, and that of the change
        self._latest = np.zeros((3, 6))

    @property
    def variances(self) -> FloatArray:
        """(6,) (rad/s^2)^2 and (m/s^2)^2."""
        variances: FloatArray = np.maximum(self._mean, 0.0)
        return variances if self.known else np.maximum(variances, self._expected)

    def missed(self, *, steady: bool, faster: float = 1.0) -> FloatArray:
        """(6,) (rad/s^2)^2 and (m/s^2)^2 that a sweep was not de-skewed for.

        A ``steady`` velocity was, or else the :class:`Expected` acceleration. If a motion has just
        begun, the last one counts alone. ``faster`` is by how much they may exceed second
        differences of poses, if sweeps are farther apart than they are long.
        """
        usual, latest = self.variances, self._latest[0]
        if not steady:
            usual, latest = self._unexpected, self._latest[1]
        begun, later = latest > _BEGUN**2 * usual, 1.0 if steady else _LATER**2
        larger = np.maximum(self._faster, faster) ** 2
        return np.where(begun, faster**2 * latest, later * larger * usual)

    @property
    def at_first(self) -> FloatArray:
        """(6,) (rad/s^2)^2 and (m/s^2)^2 of the first ones, with the noise that they have."""
        return self._first if self.known else self._expected

    @property
    def known(self) -> bool:
        """Whether enough accelerations were met for their mean to be believed."""
        return self._count >= _KNOWN

    @property
    def next(self) -> Expected | None:
        """What is expected of the next acceleration; None at first."""
        if not self.known or self._last is None:
            return None
        variances = np.minimum(self._faster**2 * self._unexpected, self._expected)
        return Expected(*self._last, self._share, _USUAL * np.sqrt(self._raw), variances)

    @property
    def _share(self) -> FloatArray:
        """(6,) of an acceleration that is left in the next one: their correlation.

        Noise makes it negative, for consecutive second differences share two poses of three.
        """
        if not self.known:
            return np.zeros(6)
        correlation: FloatArray = self._lasting / np.maximum(self._raw, np.finfo(float).tiny)
        return np.clip(correlation, 0.0, 1.0) ** _LATER

    @property
    def _unexpected(self) -> FloatArray:
        """(6,) mean squares of what is not expected."""
        unexpected: FloatArray = np.maximum(self.variances - self._share**2 * self._raw, 0.0)
        return unexpected

    def jerks(self, faster: float = 1.0) -> FloatArray:
        """(6,) (rad/s^3)^2 and (m/s^3)^2, mean squares; the last one if a motion has just begun.

        ``faster`` as for :meth:`missed`.
        """
        usual, latest = np.maximum(self._changed, 0.0), self._latest[2]
        begun, larger = latest > _BEGUN**2 * usual, np.maximum(self._faster, faster) ** 3
        changes = np.where(begun, faster**3 * latest, larger * usual)
        jerks: FloatArray = changes / max(self._period, _SHORTEST) ** 2
        return jerks

    @property
    def _faster(self) -> FloatArray:
        """(6,) by how much accelerations exceed second differences of the poses.

        As for a sine whose third differences are as these: that of the frequency f over the period
        T has 2 sin(pi f T) times the second ones, and these have (sin(pi f T) / pi f T)^2 of the
        acceleration.
        """
        if not self.known:
            return np.ones(6)
        third = np.maximum(self._changed, 0.0)
        second = np.maximum(self._mean, 0.25 * third)
        sine = np.sqrt(0.25 * third / np.maximum(second, np.finfo(float).tiny))
        sine = np.clip(sine, _SLOWEST, 1.0)
        faster: FloatArray = (np.arcsin(sine) / sine) ** 2
        return faster

    def explains(self, step: FloatArray, stamp: int) -> bool:
        """Whether usual accelerations explain a step (6,) from constant velocity, rad and m.

        Those of longer than usual are not known: held for two seconds they explain any room.
        """
        if not self.known or self._last is None:
            return False
        seconds = (stamp - self._last[0]) * 1e-9
        usual = np.sqrt(self.variances.reshape(2, 3).sum(axis=1))
        reach = _USUAL * seconds**2 * usual  # they are second differences of poses
        far = np.linalg.norm(step.reshape(2, 3), axis=1)
        return seconds < _LONGER * self._period and bool((far <= reach).all())

    def add(
        self, last_stamp: int, last: gtsam.Pose3, stamp: int, map_T_lidar: gtsam.Pose3,
        covariance: FloatArray,
    ) -> None:  # fmt: skip
        """Take in the motion from the middle of the last sweep to that of this one."""
        seconds = (stamp - last_stamp) * 1e-9
        velocity = gtsam.Pose3.Logmap(last.between(map_T_lidar)) / seconds
        before, self._last = self._last, (stamp, velocity)
        if before is None or before[0] != last_stamp:
            return
        # A second difference has the errors of three poses, with weights 1, -2, 1.
        noise = 6.0 * np.diag(covariance) / seconds**4
        acceleration = (velocity - before[1]) / seconds
        previous, self._before = self._before, (stamp, acceleration)
        self._count, self._period = self._count + 1, seconds
        gain = max(1.0 / self._count, 1.0 / self._window)
        squared = acceleration**2
        if self._count <= _KNOWN:
            self._first = self._first + gain * (squared - self._first)
        known, changed = np.zeros(6), np.zeros(6)
        if previous is not None and previous[0] == last_stamp:
            known = self._share * previous[1]
            self._lasting = self._lasting + gain * (acceleration * previous[1] - self._lasting)
            # A third difference has those of four, with weights 1, -3, 3, -1.
            changed = (acceleration - previous[1]) ** 2 - 20.0 / 6.0 * noise
            self._changed = self._changed + gain * (changed - self._changed)
        unexpected = (acceleration - known) ** 2 - noise
        self._latest = np.stack([squared - noise, unexpected, changed])
        self._raw = self._raw + gain * (squared - self._raw)
        self._mean = self._mean + gain * (squared - noise - self._mean)
