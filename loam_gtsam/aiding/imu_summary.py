"""What was made of the IMU in a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from loam_gtsam.imu.level import Level
from loam_gtsam.imu.quality import ImuReport
from loam_gtsam.registration.imu_tracker import ImuTracker
from loam_gtsam.types import FloatArray, MapUpdate


@dataclass(frozen=True, slots=True, eq=False)
class ImuSummary:
    """What was made of the IMU in a run.

    Attributes
    ----------
    report : on the samples
    level : which way was up in the map, and how it was found; None if unknown
    map_up : (3,) unit vector, map frame, up as estimated in the end; None if unknown
    gyro_bias : (3,) rad/s, lidar frame, as learnt in the end
    sweep_motions, tilt_priors : how many frames had which
    gyro_trusted : whether the gyro still agreed with the scans in the end
    gyro_left_out : number of frames in which it did not
    problems : sentences on what the turns of the scans say about clock, unit and mounting
    """

    report: ImuReport
    level: Level | None
    map_up: FloatArray | None
    gyro_bias: FloatArray
    sweep_motions: Mapping[str, int]
    tilt_priors: Mapping[str, int]
    gyro_trusted: bool
    gyro_left_out: int
    problems: tuple[str, ...]


def imu_summary(aid: ImuTracker, updates: Sequence[MapUpdate]) -> ImuSummary:
    """Summary of a run, from its IMU and the results of its sweeps."""
    return ImuSummary(
        report=aid.buffer.report,
        level=aid.level,
        map_up=aid.map_up,
        gyro_bias=aid.buffer.gyro_bias,
        sweep_motions=Counter(str(update.sweep_motion) for update in updates),
        tilt_priors=Counter(str(update.tilt_prior) for update in updates),
        gyro_trusted=aid.gyro.holds,
        gyro_left_out=aid.gyro.left_out,
        problems=aid.problems,
    )
