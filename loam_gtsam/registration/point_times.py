"""Whether points move within their sweeps as the lidar does: a test of the times of the points.

A sweep whose times are of another unit, or that was de-skewed before, is distorted by a part of
its motion. The map that is made of such sweeps is distorted alike, so that they fit, and no match
is bad: what is left in the residuals shows only in the sum of many sweeps. See
docs/maths/deskew.md.
"""

from __future__ import annotations

import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.registration.degeneracy import tells_motion
from loam_gtsam.registration.solvers import Solution
from loam_gtsam.registration.solvers.sweep_velocity import timed_rows, unseen_velocity

_LEAST = 1.0
"""Information of a sweep about the share of the motion below which it tells nothing."""
_SWEEPS = 20
"""Sweeps that tell something before a word is said."""
_ODD, _SHARE = 5.0, 0.03
"""Standard deviations, and share of the motion, from which on the times are wrong. Of lidars with
rings right times have less than 0.02 in 31 worlds, sweeps that were de-skewed before 0.1 to 0.7."""


class PointTimes:
    """Sums over the sweeps of a run of what their residuals say of the motion within them.

    Of ``config``, ``deskew``, ``solver`` and ``features.range_noise`` are used.
    """

    def __init__(self, config: Config) -> None:
        # With the predicted motion, as LOAM does it, sweeps are distorted anyway.
        self._asks = config.deskew.enabled and config.deskew.model != "predicted"
        self._range_noise = config.features.range_noise
        self._solver = config.solver
        self._count, self._pull, self._information = 0, 0.0, 0.0
        self._velocity, self._unseen = 0.0, 0.0  # (m/s)^2
        self._sum = self._squares = self._lagged = self._last = 0.0  # of one number a sweep

    def add(self, posed: PosedSweep, solution: Solution) -> None:
        """Take in a sweep whose pose all its matches together have fixed.

        ``posed`` has the final motion, ``solution`` the pose of its middle.
        """
        seen = solution.localizability
        if not self._asks or solution.weak is not None or not posed.sweep.duration:
            return
        if seen is None or not tells_motion(seen, self._solver):
            return
        rows, seconds = timed_rows(solution.matches, posed.sweep, self._solver)
        residuals, by_pose = rows.residuals(solution.map_T_lidar)
        velocity = by_pose @ posed.twist  # of the points, along their normals, and whitened
        moved = seconds * velocity
        followed = np.linalg.pinv(by_pose.T @ by_pose, hermitian=True) @ (by_pose.T @ moved)
        moved = moved - by_pose @ followed
        pull, information = float(moved @ residuals), float(moved @ moved)
        if not information > _LEAST:  # at rest, or all at one time
            return
        now = pull / np.sqrt(information)  # of a variance that is about the same for all sweeps
        self._count += 1
        self._pull += pull
        self._information += information
        self._velocity += float(np.mean((velocity / rows.scales) ** 2))
        self._unseen += unseen_velocity(seconds, self._range_noise) ** 2
        self._sum += now
        self._squares += now**2
        self._lagged += now * self._last
        self._last = now

    @property
    def excess(self) -> tuple[float, float]:
        """By what share of the motion the de-skew moves points too far; over its own deviation.

        The map is distorted like the sweeps, so that of a wrong share the residuals keep a part: a
        tenth to two thirds.
        """
        if self._count < _SWEEPS:
            return 0.0, 0.0
        mean = self._sum / self._count
        variance = self._squares - self._count * mean**2
        correlated = max(self._lagged - (self._count - 1) * mean**2, 0.0)
        deviation = np.sqrt(max(variance + 2.0 * correlated, 1e-300))
        return self._pull / self._information, float(self._sum / deviation)

    @property
    def problem(self) -> str:
        """What is wrong with the times, as a sentence; empty if nothing is."""
        share, deviations = self.excess
        if abs(deviations) < _ODD or abs(share) < _SHARE:
            return ""
        if share**2 * self._velocity < self._unseen:  # as the sensor's own errors may look
            return ""
        if share > 0.0:
            said = "less within the sweeps than the lidar does: are these de-skewed already "
            said += "(sensor.times=none), or the times of the points too long"
        else:
            said = "more within the sweeps than the lidar does: are their times too short"
        return f"the points move {said} (time_unit, sensor.period)? The poses are worse than told"
