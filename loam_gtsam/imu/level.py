"""Which way is up in the map, from the IMU's orientation over a stretch of time."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.config import ImuConfig
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.types import FloatArray


@dataclass(frozen=True, slots=True)
class Level:
    """The direction that points up in the map.

    Attributes
    ----------
    level_R_map : rotation from the map into a frame whose z axis points up
    roll, pitch : angles of the lidar when the direction was found, rad
    samples : number of IMU samples behind it
    source : "still" if the platform was at rest, else "moving"
    felt : whether it was made of acceleration on the way, and has that of the motion in it
    """

    level_R_map: gtsam.Rot3
    roll: float
    pitch: float
    samples: int
    source: str
    felt: bool

    @property
    def map_up(self) -> FloatArray:
        """(3,) unit vector, map frame."""
        return np.array(self.level_R_map.matrix()[2])

    def down(self, gravity: float) -> FloatArray:
        """(3,) gravity of this size, m/s^2, in the map frame."""
        return -gravity * self.map_up


def find_level(
    buffer: ImuBuffer, config: ImuConfig, stamp: int, map_T_lidar: gtsam.Pose3, *, levelled: bool
) -> Level | None:
    """Find up from the samples of ``still_seconds`` before a moment and as long after it.

    None if there is no orientation at that moment, ``stamp`` in nanoseconds. If the map is to be
    ``levelled``, have its z axis up, ``level_R_map`` is the identity, and ``roll`` and ``pitch``
    say how the lidar stands in the map.
    """
    found = mean_orientation(buffer, stamp, config.still_seconds)
    if found is None:
        return None
    world_R_lidar, count = found
    roll, pitch = map(float, world_R_lidar.rpy()[:2])
    level_R_lidar = gtsam.Rot3.RzRyRx(roll, pitch, 0.0)
    level_R_map = level_R_lidar.compose(map_T_lidar.rotation().inverse())
    source = "moving" if buffer.rest_at(stamp) is None else "still"
    rested = source == "still" or buffer.first_rest() is not None
    felt = not (buffer.measures_attitude or rested)
    level_R_map = gtsam.Rot3() if levelled else level_R_map
    return Level(level_R_map, roll, pitch, count, source, felt)


def mean_orientation(buffer: ImuBuffer, stamp: int, reach: float) -> tuple[gtsam.Rot3, int] | None:
    """``world_R_lidar`` of a moment from all samples around it, and the number of samples.

    Samples of ``reach`` seconds before and after ``stamp`` (nanoseconds) are brought to that moment
    by the gyro, so the platform may be turning. If it has turned too far, or the gyro has a gap,
    the answer is the orientation of the moment alone; None if there is none.
    """
    here = buffer.orientation(stamp)
    if here is None:
        return None
    far = round(reach * 1e9)
    samples = buffer.samples_between(stamp - far, stamp + far)
    assert samples.orientation is not None  # there is one at this moment
    known = np.isfinite(samples.orientation[:, 0])
    seconds: FloatArray = (samples.stamps[known] - stamp).astype(np.float64) * 1e-9
    rotations = buffer.rotations_since(stamp, seconds)
    if rotations is None or not len(rotations):
        return here, 1
    brought = Rotation.from_quat(samples.orientation[known]) * Rotation.from_rotvec(rotations).inv()
    return gtsam.Rot3(brought.mean().as_matrix()), len(rotations)
