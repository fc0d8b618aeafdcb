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
    disputed : number of frames in which the scans told another motion than an IMU that had agreed
    problems : sentences on the samples, and on what the scans say about clock, unit and mounting
    """

    report: ImuReport
    level: Level | None
    map_up: FloatArray | None
    gyro_bias: FloatArray
    sweep_motions: Mapping[str, int]
    tilt_priors: Mapping[str, int]
    gyro_trusted: bool
    gyro_left_out: int
    disputed: int
    problems: tuple[str, ...]


def imu_summary(aid: ImuTracker, updates: Sequence[MapUpdate]) -> ImuSummary:
    """Summary of a run, from its IMU and the results of its sweeps."""
    tilt_priors = Counter(str(update.tilt_prior) for update in updates)
    report, left_out = aid.buffer.report, aid.gyro.left_out
    in_the_run = _in_the_run(report, tilt_priors, left_out, aid.dispute.frames)
    return ImuSummary(
        report=report,
        level=aid.level,
        map_up=aid.map_up,
        gyro_bias=aid.buffer.gyro_bias,
        sweep_motions=Counter(str(update.sweep_motion) for update in updates),
        tilt_priors=tilt_priors,
        gyro_trusted=aid.gyro.holds,
        gyro_left_out=left_out,
        disputed=aid.dispute.frames,
        problems=(*report.problems, *in_the_run, *aid.problems),
    )


def _in_the_run(
    report: ImuReport, tilt_priors: Mapping[str, int], left_out: int, disputed: int
) -> list[str]:
    """Sentences on sweeps without an orientation, without the gyro, and in dispute."""
    problems = []
    dropped = tilt_priors.get("dropped", 0)
    if dropped and report.orientation != "none":
        at = f"{dropped} of {sum(tilt_priors.values())} sweeps"
        why = "gaps longer than imu.max_gap, another clock, or samples added after their sweep"
        problems.append(f"IMU: no orientation at {at}: {why}")
    if left_out:
        problems.append(
            f"IMU: its gyro turned unlike the scans and was given up for {left_out} "
            "sweeps; check imu.lidar_R_imu_deg, units and stamps; if the gyro is right, the poses "
            "are wrong"
        )
    if disputed:
        problems.append(
            f"IMU: in {disputed} sweeps gyro and accelerometer told another motion than the scans; "
            "either most of what the lidar sees moved, as in a lift, on a ship or among lorries, "
            "or the accelerometer failed; covariances allow for both"
        )
    return problems
