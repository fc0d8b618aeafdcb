"""How the path of the lidar within a sweep bends, from gyro and accelerometer."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.geometry import cross, integrated, interpolated
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.types import FloatArray

_BESIDE = 20_000_000  # nanoseconds: samples on either side, down to 50 Hz


def bend(
    buffer: ImuBuffer,
    stamp: int,
    seconds: FloatArray,
    gravity: FloatArray,
    acceleration_bias: FloatArray,
    lidar_t_imu: FloatArray,
) -> FloatArray | None:
    """Way of the lidar away from a straight line at constant velocity.

    The line is the tangent of the path at ``stamp``, so the velocity need not be known. While a
    car brakes with 4 m/s^2, the two ends of a sweep of 0.1 s lie 5 mm from it.

    Parameters
    ----------
    buffer : the samples
    stamp : nanoseconds
    seconds : (K,) from ``stamp``, ascending, negative ones too
    gravity : (3,) m/s^2 pointing down, in the axes of the lidar at ``stamp``
    acceleration_bias : (3,) m/s^2
    lidar_t_imu : (3,) metres

    Returns
    -------
    (K, 3) metres in the axes of the lidar at ``stamp``; None where the samples have a gap
    """
    first, last = (stamp + round(float(end) * 1e9) for end in (seconds[0], seconds[-1]))
    samples = buffer.samples_between(first - _BESIDE, last + _BESIDE)
    # One beyond the end and no more: a live run has just that one.
    needed = slice(int(np.searchsorted(samples.stamps, last)) + 1)
    times: FloatArray = (samples.stamps[needed] - stamp).astype(np.float64) * 1e-9
    if not len(times):
        return None
    inside = times[(times > seconds[0]) & (times < seconds[-1])]
    knots: FloatArray = np.unique(np.concatenate([seconds[[0, -1]], inside, [0.0]]))
    turns = buffer.rotations_since(stamp, knots)
    if turns is None:
        return None
    rotations = Rotation.from_rotvec(turns)
    felt: FloatArray = interpolated(knots, times, samples.acceleration[needed]) - acceleration_bias
    acceleration = rotations.apply(felt) + gravity
    here = int(np.searchsorted(knots, 0.0))
    velocity = integrated(acceleration, knots)
    path = integrated(velocity - velocity[here], knots)
    path -= path[here]
    # The IMU goes round the lidar.
    rate = interpolated(np.zeros(1), times, samples.gyro[needed] - buffer.gyro_bias)
    path -= rotations.apply(lidar_t_imu) - lidar_t_imu
    path += knots[:, None] * cross(rate[0], lidar_t_imu)
    return interpolated(seconds, knots, path)
