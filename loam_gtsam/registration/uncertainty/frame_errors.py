"""The errors that a pose has for itself: docs/maths/covariance.md, "At the reference time"."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.geometry import symmetric
from loam_gtsam.imu.preintegration import Fused
from loam_gtsam.registration.acceleration import Accelerations
from loam_gtsam.registration.solvers.scan_error import ScanError
from loam_gtsam.registration.uncertainty.missed_motion import missed_motion, rotation_is_known
from loam_gtsam.types import FloatArray, MapUpdate, SweepMotion

_PAUSE = 1.0
"""Seconds for which a velocity may have changed where a clock was set: nothing tells how long the
sweeps took that were on neither clock."""


class FrameError(NamedTuple):
    """Of a frame, at its reference time.

    Attributes
    ----------
    covariance : (6, 6)
    to_reference : (6, 6) adjoint from the middle of its sweep to there
    shared : (6, 6) its covariance with that of the frame before; zero if it follows none
    follows : reference time of the frame before; None if it follows none
    """

    covariance: FloatArray
    to_reference: FloatArray
    shared: FloatArray
    follows: int | None


@dataclass(frozen=True, slots=True, eq=False)
class _Middle:
    """A solved frame at the middle of its sweep."""

    stamp: int  # nanoseconds of the middle
    map_T_lidar: gtsam.Pose3
    covariance: FloatArray  # (6, 6) of the scan's own error
    with_own: FloatArray  # (6 or 9, 6) of that error, and of the velocity's, with the frame's own
    to_reference: FloatArray  # (6, 6) adjoint from the middle to there
    reference_stamp: int
    state: FloatArray | None = None  # (9, 9) covariance of pose and velocity, beside an IMU


class FrameErrors:
    """Brings the errors of scans, which are at the middles of sweeps, to the reference times.

    ``gyro_noise`` is a density, rad/s/sqrt(Hz).
    """

    def __init__(self, gyro_noise: float) -> None:
        self._gyro_noise = gyro_noise
        self._last: _Middle | None = None
        self._paused = False
        self._strayed = np.zeros(6)  # how far the next frame is from where the motion leads

    @property
    def last(self) -> tuple[int, gtsam.Pose3] | None:
        """The last frame: nanoseconds of its middle, and the pose there; None if there is none."""
        return None if self._last is None else (self._last.stamp, self._last.map_T_lidar)

    def cut(self, *, paused: bool = False) -> None:
        """The next frame follows none; if ``paused``, it is on another clock."""
        self._last, self._paused = None, self._paused or paused

    def stray(self, step: FloatArray) -> None:
        """The next frame is a step (6,) from where the motion leads, which it has kept."""
        self._strayed = step

    def of(
        self,
        update: MapUpdate,
        sweep: MovingSweep,
        middle: gtsam.Pose3,
        scan: ScanError,
        motion: Accelerations,
        fused: Fused | None,
        turned: FloatArray | None = None,
    ) -> FrameError:
        """The own error of a frame, each in turn.

        That of its ``scan`` is at the pose of the ``middle``; ``fused`` is the pose by scan and IMU
        together, None if there is none. The gyro has ``turned`` by (3,) rad/s more than the last
        scans, None if there is none.
        """
        last = self._last
        to_reference = update.map_T_lidar.between(middle).AdjointMap()
        none = np.zeros((6, 6))
        now = _Middle(sweep.stamp, middle, scan.covariance, none, to_reference, update.stamp)
        if fused is None:
            now, covariance, shared = self._by_scan(now, sweep, motion, scan)
            if self._paused:
                covariance = covariance + _changed(update.twist, sweep, motion.variances)
        else:
            now, covariance, shared = self._by_imu(now, sweep, motion, scan, fused, update)
        if turned is not None and last is not None and sweep.motion is SweepMotion.GYRO:
            covariance = covariance + _turned_unlike(turned, sweep, scan, now, last)
        self._last, self._paused, self._strayed = now, False, np.zeros(6)
        follows = None if last is None else last.reference_stamp
        return FrameError(symmetric(covariance), to_reference, shared, follows)

    def _by_scan(
        self, now: _Middle, sweep: MovingSweep, motion: Accelerations, scan: ScanError
    ) -> tuple[_Middle, FloatArray, FloatArray]:
        """The frame, and its own and shared error, of a pose by its scan alone."""
        # The pose at the reference time follows from that at the middle by the velocity since the
        # last middle, and so has a share in the errors of both.
        last = self._last
        if last is not None and sweep.stamp <= last.stamp:  # sweeps of different length
            last = None
        seconds = np.inf if last is None else (sweep.stamp - last.stamp) * 1e-9
        share = np.full(6, sweep.middle / seconds)
        if rotation_is_known(sweep):
            share[:3] = 0.0
        kept, to_reference = 1.0 - share, now.to_reference
        covariance = kept[:, None] * now.covariance * kept
        shared = np.zeros((6, 6))
        if last is not None:
            across = share[:, None] * now.map_T_lidar.between(last.map_T_lidar).AdjointMap()
            covariance = covariance + across @ last.covariance @ across.T
            shared = to_reference @ across @ last.with_own[:6]
        strayed = share * self._strayed
        covariance = covariance + self._missed(sweep, motion, scan) + np.outer(strayed, strayed)
        with_turn = np.column_stack([scan.by_turns, np.zeros((6, 3))])
        crossed = kept[:, None] * with_turn
        covariance = to_reference @ (covariance + crossed + crossed.T) @ to_reference.T
        with_own = (now.covariance * kept + with_turn) @ to_reference.T
        return replace(now, with_own=with_own), covariance, shared

    def _by_imu(
        self,
        now: _Middle,
        sweep: MovingSweep,
        motion: Accelerations,
        scan: ScanError,
        fused: Fused,
        update: MapUpdate,
    ) -> tuple[_Middle, FloatArray, FloatArray]:
        """As :meth:`_by_scan`, of a frame whose velocity is known too."""
        last, to_reference = self._last, now.to_reference
        back = -sweep.middle * update.map_T_lidar.rotation().matrix().T
        of_state = np.hstack([to_reference, np.vstack([np.zeros((3, 3)), back])])
        turned, state = self._missed(sweep, motion), fused.covariance
        turned[3:] = turned[:, 3:] = 0.0
        with_turn = np.zeros((9, 6))
        with_turn[:, :3] = self._with_turn(sweep, scan, state) @ to_reference[:3, :3].T
        crossed = of_state @ with_turn
        covariance = of_state @ state @ of_state.T + turned + crossed + crossed.T
        with_own = state @ of_state.T + with_turn
        shared = np.zeros((6, 6))
        if last is not None and last.state is not None:
            before = np.linalg.lstsq(last.state, last.with_own, rcond=None)[0]
            shared = of_state @ fused.across @ before
        now = replace(now, covariance=state[:6, :6], with_own=with_own, state=state)
        return now, covariance, shared

    def _with_turn(self, sweep: MovingSweep, scan: ScanError, state: FloatArray) -> FloatArray:
        """(9, 3) covariance of pose and velocity with the turn from there to the reference.

        The gyro has also led to the middle: so far, what it turned since the reference cancels.
        """
        if sweep.motion is not SweepMotion.GYRO:
            return np.zeros((9, 3))
        gain = state[:, :6] @ scan.information
        left = np.eye(9, 3) - gain[:, :3]
        with_turn = gain @ scan.by_turns - self._gyro_noise**2 * max(sweep.middle, 0.0) * left
        return np.asarray(with_turn)

    def _missed(
        self, sweep: MovingSweep, motion: Accelerations, scan: ScanError | None = None
    ) -> FloatArray:
        """(6, 6) covariance of what the motion of the sweep misses until the reference time."""
        interval, noise = 0.0, np.zeros(6)
        if self._last is not None and sweep.stamp > self._last.stamp:
            interval = (sweep.stamp - self._last.stamp) * 1e-9
        if sweep.motion is SweepMotion.GYRO:
            noise[:3] = self._gyro_noise**2 * abs(sweep.middle)
        return missed_motion(sweep, motion, interval, scan) + np.diag(noise)


def _turned_unlike(
    turned: FloatArray, sweep: MovingSweep, scan: ScanError, now: _Middle, last: _Middle
) -> FloatArray:
    """(6, 6) covariance of what a gyro that turns by (3,) rad/s more than the scans does to a pose.

    It has bent the sweep, and led from the middle to the reference time. What the errors of both
    scans make of such a difference does not count.
    """
    seconds = (now.stamp - last.stamp) * 1e-9
    if seconds <= 0.0:  # sweeps of different length
        return np.zeros((6, 6))
    noise = sum(float(np.trace(one.covariance[:3, :3])) for one in (now, last)) / seconds**2
    squared = float(turned @ turned)
    off = turned * np.sqrt(max(1.0 - noise / squared, 0.0)) if squared > 0.0 else turned
    bent, led = scan.by_velocity[:, :3] @ off, np.append(sweep.middle * off, np.zeros(3))
    to_reference = now.to_reference
    moved: FloatArray = to_reference @ (np.outer(bent, bent) + np.outer(led, led)) @ to_reference.T
    return moved


def _changed(twist: FloatArray, sweep: MovingSweep, accelerations: FloatArray) -> FloatArray:
    """(6, 6) covariance of what a velocity from before a pause misses at the reference time.

    ``twist`` (6,) is that velocity, rad/s and m/s, which may have turned as well;
    ``accelerations`` are (6,) mean squares.
    """
    squares = accelerations.copy()
    squares[:3] *= not rotation_is_known(sweep)
    squares[3:] += np.sum(np.cross(twist[:3], twist[3:]) ** 2)
    return np.diag((sweep.middle * _PAUSE) ** 2 * squares)
