"""Detection of rest in IMU samples, and what a rest says about gyro and gravity."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.imu.quaternions import as_rot3
from loam_gtsam.types import FloatArray, ImuSamples

REST_LEAST = 0.1
"""Seconds that samples at rest must span at least."""
REST_SAMPLES = 10
"""Number of samples that a rest must have at least."""
REST_GYRO = 0.02
"""rad/s, scatter per axis at rest: several times the noise of consumer MEMS gyros at 200 Hz."""
REST_ACCELERATION = 0.15
"""m/s^2, scatter per axis at rest: above an idling engine, below any driving (VINS-Mono takes
0.25 for "enough excitation" of a hand-held start)."""
REST_DRIFT = 4.0
"""Standard deviations by which the means of the two halves of a rest may differ. It shows what the
scatter does not: a platform that begins to move."""
REST_DRIFT_FLOOR = (5e-4, 0.01)
"""rad/s and m/s^2, allowed on top: noise is not quite white."""
REST_TURN = 0.05
"""rad/s, mean rate at rest: the largest bias of consumer MEMS gyros (3 deg/s). A platform that
turns evenly at less than that cannot be told from a bias."""
REST_GRAVITY = 0.5
"""m/s^2 by which the mean acceleration at rest may differ from gravity: 5 %, a scale and a bias."""


@dataclass(frozen=True, slots=True, eq=False)
class RestWindow:
    """A stretch of samples at rest, lidar axes.

    Attributes
    ----------
    first, last, samples : stamps of the first and the last sample, nanoseconds, and their number
    gyro : (3,) mean rate, rad/s: the bias of the gyro
    acceleration : (3,) mean acceleration, m/s^2: it points up
    world_R_lidar : mean orientation, None if there is none
    """

    first: int
    last: int
    samples: int
    gyro: FloatArray
    acceleration: FloatArray
    world_R_lidar: gtsam.Rot3 | None

    @property
    def disagreement(self) -> float:
        """Angle between up by the orientation and by the accelerometer, rad; NaN if unknown."""
        if self.world_R_lidar is None:
            return float("nan")
        up = self.world_R_lidar.matrix()[2]
        away = np.linalg.norm(np.cross(up, self.acceleration))
        return float(np.arctan2(away, up @ self.acceleration))


def find_rest(
    config: ImuConfig, samples: ImuSamples, count: int | None = None
) -> RestWindow | None:
    """The rest that the first ``count`` samples make, or all; None if they are not at rest.

    At rest means: gyro and acceleration scatter little (:data:`REST_GYRO`,
    :data:`REST_ACCELERATION`) and do not drift (:data:`REST_DRIFT`), the mean rate is a possible
    bias (:data:`REST_TURN`), the mean acceleration is gravity (:data:`REST_GRAVITY`), and there
    are enough samples without a gap (:data:`REST_LEAST`, :data:`REST_SAMPLES`). Samples are in
    order of time and in lidar axes, their orientation is NaN where unknown.
    """
    stamps, gyro = samples.stamps[:count], samples.gyro[:count]
    acceleration, orientation = samples.acceleration[:count], samples.orientation
    if len(stamps) < REST_SAMPLES or stamps[-1] - stamps[0] < REST_LEAST * 1e9:
        return None
    mean_gyro, mean_acceleration = gyro.mean(axis=0), acceleration.mean(axis=0)
    if (
        np.diff(stamps).max() > config.max_gap * 1e9
        or gyro.std(axis=0).max() > REST_GYRO
        or acceleration.std(axis=0).max() > REST_ACCELERATION
        or _drifts(gyro, REST_DRIFT_FLOOR[0])
        or _drifts(acceleration, REST_DRIFT_FLOOR[1])
        or np.linalg.norm(mean_gyro) > REST_TURN
        or abs(float(np.linalg.norm(mean_acceleration)) - config.gravity) > REST_GRAVITY
    ):
        return None
    world_R_lidar = None
    if orientation is not None:
        known = orientation[:count][np.isfinite(orientation[:count, 0])]
        if len(known):
            # q and -q are one rotation: bring all to one side before they are averaged.
            mean = np.where(known @ known[0] < 0.0, -1.0, 1.0) @ known
            world_R_lidar = as_rot3(mean / np.linalg.norm(mean))
    first, last = int(stamps[0]), int(stamps[-1])
    return RestWindow(first, last, len(stamps), mean_gyro, mean_acceleration, world_R_lidar)


def rest_at_start(config: ImuConfig, samples: ImuSamples) -> RestWindow | None:
    """The rest in the first ``still_seconds`` of one or more samples, or in half or a quarter."""
    stamps = samples.stamps
    for share in (1.0, 0.5, 0.25):
        end = int(stamps[0]) + round(share * config.still_seconds * 1e9)
        rest = find_rest(config, samples, int(np.searchsorted(stamps, end, side="right")))
        if rest is not None:
            return rest
    return None


def _drifts(values: FloatArray, floor: float) -> bool:
    """Whether the halves of (N, 3) values differ by more than chance on some axis."""
    half = len(values) // 2
    change = np.abs(values[half:].mean(axis=0) - values[:half].mean(axis=0))
    chance = 2.0 * values.std(axis=0) / np.sqrt(len(values))
    return bool((change > REST_DRIFT * chance + floor).any())
