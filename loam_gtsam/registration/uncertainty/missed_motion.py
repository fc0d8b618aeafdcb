"""What the motion within a sweep misses: docs/maths/covariance.md, "At the reference time"."""

from __future__ import annotations

import numpy as np

from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.registration.acceleration import Accelerations
from loam_gtsam.registration.solvers.scan_error import ScanError
from loam_gtsam.registration.solvers.sweep_velocity import expected_information
from loam_gtsam.types import FloatArray, SweepMotion


def missed_motion(
    sweep: MovingSweep, motion: Accelerations, interval: float, scan: ScanError | None
) -> FloatArray:
    """(6, 6) covariance of what the motion of a sweep misses until the reference time.

    Parameters
    ----------
    motion : accelerations so far
    interval : seconds since the middle of the last sweep; 0 if the frame follows none
    scan : None if an IMU has led to the middle
    """
    seconds, faster = unresolved(interval, sweep.duration)
    steady = sweep.acceleration is None
    accelerations = np.diag(motion.missed(steady=steady, faster=faster))
    drawn, curved = by_acceleration(sweep, seconds, scan), np.zeros((6, 6))
    if interval and scan is not None and scan.told is not None and motion.next is not None:
        half = 0.5 * seconds  # times the acceleration, by which it changes the velocity
        believed = expected_information(0.5 * interval * np.sqrt(motion.next.variances))
        accelerations = scan.told.left(half**2 * accelerations, believed) / half**2
        bent = by_jerk(sweep, seconds, scan, drawn @ scan.told.bent(believed) / half)
        curved = bent * motion.jerks(faster) @ bent.T
    if rotation_is_known(sweep):
        accelerations[:3] = accelerations[:, :3] = 0.0
    covariance: FloatArray = drawn @ accelerations @ drawn.T + curved
    return covariance


def by_acceleration(sweep: MovingSweep, seconds: float, scan: ScanError | None) -> FloatArray:
    """(6, 6) s^2, by which an acceleration moves the pose at the reference time.

    By what the points of the sweep draw its pose aside, and by how far an arc is from its chord,
    which begins ``seconds`` before the middle.
    """
    drawn, chord = np.zeros((6, 6)), 0.0
    if seconds:
        chord = 0.5 * sweep.middle * (seconds - sweep.middle)
        if scan is not None:
            drawn = scan.by_acceleration + 0.5 * seconds * scan.by_velocity
    # Along one axis the two might cancel each other, which a stamp that is late does not.
    least = sweep.duration**2 / 24.0
    np.fill_diagonal(drawn, chord + np.maximum(np.diag(drawn), least))
    return drawn


def by_jerk(
    sweep: MovingSweep, seconds: float, scan: ScanError, by_velocity: FloatArray
) -> FloatArray:
    """(6, 6) s^3, by which a jerk moves the pose at the reference time.

    The path is taken for a parabola that begins ``seconds`` before the middle, and the jerk moves
    the pose ``by_velocity`` (6, 6) the other way, because the matches tell another velocity.
    """
    chord = sweep.middle**2 * (seconds - sweep.middle) / 6.0
    bent = scan.by_jerk + seconds / 3.0 * scan.by_acceleration - by_velocity
    np.fill_diagonal(bent, np.minimum(np.diag(bent), 0.0) - chord)
    return bent


def unresolved(seconds: float, duration: float) -> tuple[float, float]:
    """The time in which a motion may change, and how much larger accelerations are in that.

    Sweeps that follow each other after more ``seconds`` than one has (``duration``) do not show how
    fast what sways between them does: it may do so within each of them.
    """
    if not 0.0 < duration < seconds:
        return seconds, 1.0
    return duration, (seconds / duration) ** 2


def rotation_is_known(sweep: MovingSweep) -> bool:
    """Whether an IMU has measured how a sweep turned."""
    return sweep.motion in (SweepMotion.GYRO, SweepMotion.ORIENTATION)
