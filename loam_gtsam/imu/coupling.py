"""Gyro, accelerometer and scans in one estimate, see docs/maths/inertial.md."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.geometry import five_sigma, symmetric
from loam_gtsam.imu.bend import bend
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.imu.level import Level
from loam_gtsam.imu.preintegration import (
    NO_STEP,
    Fused,
    InertialOdometry,
    InertialPrediction,
    StartSigmas,
)
from loam_gtsam.imu.preintegration_window import GRAVITY, VELOCITY, InertialState
from loam_gtsam.types import FloatArray, ImuSamples, SweepError

_FORCE = 0.2, 3.0
"""Least and largest mean specific force over a sweep, in multiples of gravity. Less is free fall,
an accelerometer without gravity or in other units; more is beyond any vehicle, or a fault."""
_USUAL, _LONG = (0.7, 1.4), 2.0
"""The same of the median over so many seconds: no vehicle falls or soars for long. One whose
accelerometer has no gravity feels enough of it while it brakes."""
_HARDEST = 1.0
"""Largest acceleration over a sweep, in multiples of gravity, with which the estimate may begin. If
it seems larger, down is not where the orientation has it."""
_FASTEST = 20.0  # m/s: standard deviation of a speed that nothing told
_UNLIKELY = five_sigma(6)
"""Squared Mahalanobis distance from which a pose contradicts its prediction: as unlikely as five
standard deviations."""
_UNFELT = 2.0  # m/s^2: standard deviation of an acceleration that nothing told, as of the solver
_OUTWEIGHS = 5  # frames that agree and one that contradicts: the one after it knows no velocity
_DISTRUST = 3 * _OUTWEIGHS  # from which, less agreements, the accelerometer is not used
_GIVEN_UP = 5.0  # frames of disagreement less those of agreement from which a gyro is not used
_TURNED = five_sigma(3)
"""As ``_UNLIKELY``, of a rotation."""
_CLEAR = 3.0  # frames of disagreement for which a rotation far beyond that counts
_LONGEST = 20_000_000_000
"""Nanoseconds after which the accelerometer is the one that is wrong: lifts arrive, and ships and
lorries reach their speed."""
_LONGER = 6  # times that a gyro which is given up again is given up for twice as long


def _spread(map_T_lidar: gtsam.Pose3, information: FloatArray, seconds: float) -> FloatArray:
    """Covariance (3, 3) of the velocity between two poses, map frame; any speed where none is seen.

    ``information`` (6, 6) is of the second pose; the first one is taken to be as good.
    """
    turns = np.linalg.pinv(information[:3, :3], hermitian=True)
    shifts = information[3:, 3:] - information[3:, :3] @ turns @ information[:3, 3:]
    told = 0.5 * seconds**2 * symmetric(shifts)
    rotation = map_T_lidar.rotation().matrix()
    covariance = np.linalg.inv(told + np.eye(3) / _FASTEST**2)
    spread: FloatArray = rotation @ covariance @ rotation.T
    return spread


class GyroTrust:
    """Counts frames in which a gyro and the scans disagree, less those in which they agree.

    Both kinds are needed: a difference that is beyond all noise whatever is believed of the scan,
    and one beyond what prediction and scan say of themselves, which is seen much sooner.

    Attributes
    ----------
    left_out : number of frames in which the gyro was not used
    """

    def __init__(self) -> None:
        self._frames, self._given_up = 0.0, 0
        self.left_out = 0

    @property
    def holds(self) -> bool:
        """Whether the gyro is to be used."""
        return self._frames < _GIVEN_UP

    @property
    def problem(self) -> str:
        """Sentence for the user while the gyro is given up; empty if it is not."""
        return "" if self.holds else "the gyro turns unlike the scans: one of the two is wrong"

    def compared(self, *, agree: bool) -> None:
        """Take in a frame in which scan and gyro agree or not."""
        self._count(-1.0 if agree else 1.0)
        self.left_out += not self.holds

    def surprised(self, distance: float) -> None:
        """Take in the squared Mahalanobis distance of a turn from its prediction."""
        if distance > _TURNED:
            self._count(min(distance / _TURNED, _CLEAR))

    def denied(self) -> None:
        """Take in that the scans are sure of another turn: it is not to be used."""
        self._count(_GIVEN_UP)

    def _count(self, frames: float) -> None:
        held, most = self.holds, _GIVEN_UP * 2.0 ** (self._given_up + 1)
        self._frames = min(max(self._frames + frames, 0.0), most)
        if held and not self.holds:
            self._frames = most
            self._given_up = min(self._given_up + 1, _LONGER)


class OtherPose(NamedTuple):
    """Where gyro and accelerometer alone lead, in a dispute with the scans."""

    map_T_lidar: gtsam.Pose3
    covariance: FloatArray  # (6, 6)
    since: int  # stamp of the first frame of the dispute, nanoseconds


class Dispute:
    """Where gyro and accelerometer lead by themselves, from when scans began to contradict them.

    If they had agreed for some time, one is as likely to be wrong as the other: an accelerometer
    fails as seldom as most of what a lidar sees moves along with it, as in a lift, or away from it,
    as a ship does from a quay. A turn that the scans deny is no dispute: see :class:`GyroTrust`.

    Attributes
    ----------
    holds : whether scans contradicted them so often that they are not used
    alone, began : their state now, None if there is no dispute; and the stamp of its first frame
    frames : number of frames in which it held
    """

    def __init__(self) -> None:
        self.holds, self.frames = False, 0
        self._agreed = 0  # frames before it
        self.began = 0  # stamp of its first one
        self.alone: InertialState | None = None

    @property
    def problem(self) -> str:
        """Sentence for the user while it holds."""
        text = "gyro and accelerometer tell another motion than the scans: one of the two is wrong"
        return text if self.holds else ""

    def settle(self) -> None:
        """It is over, or was none; they must agree anew before another one may begin."""
        self.holds, self._agreed, self.alone = False, 0, None

    def compared(self, predicted: InertialState, contradictions: int, *, agree: bool) -> None:
        """Take in a frame of which the scan agrees, or not, with the predicted state."""
        if self.alone is None:
            self._agreed += agree
            if not agree and self._agreed >= _OUTWEIGHS:
                self.alone, self.began = predicted, predicted.stamp
        elif not (contradictions or self.holds):
            self.alone = None  # by chance
        self.holds = self.holds or (self.alone is not None and contradictions >= _DISTRUST)
        self.frames += self.holds

    def ends(self, distance: float) -> bool:
        """Whether it is over, by the squared Mahalanobis distance of the scan from ``alone``."""
        assert self.alone is not None
        return distance < _UNLIKELY or self.alone.stamp - self.began > _LONGEST


class TightCoupling:
    """What scans and IMU together know of pose, velocity, biases and gravity.

    For every frame :meth:`predict`, then :meth:`observe`. While scans contradict the predictions
    for some frames in a row, there are none.

    Attributes
    ----------
    contradicted : whether the last :meth:`observe` met a pose that is unlike a trusted prediction
    turn_surprise : how the last :meth:`observe` found the predicted rotation, as a squared
        Mahalanobis distance; 0 without a prediction, and in a dispute, which bends it
    dispute : whether scans contradict gyro and accelerometer that had agreed
    other : where these alone led at the last :meth:`observe`, in a dispute; None without one
    """

    def __init__(self, config: ImuConfig) -> None:
        self.config = config
        self._odometry: InertialOdometry | None = None
        self._predicted: int | None = None
        self._rejected = False  # whether the prediction of this frame was taken back
        self._contradictions = 0
        self.contradicted, self.turn_surprise = False, 0.0
        self.dispute = Dispute()
        self.other: OtherPose | None = None

    @property
    def trusted(self) -> bool:
        """Whether gyro and accelerometer tell where the lidar is, and the scans agree."""
        return self._contradictions < _DISTRUST and not self._gravity_is_open

    @property
    def _gravity_is_open(self) -> bool:
        """Whether gravity is no better known than the acceleration that a constant velocity misses.

        So it is after a start on the way with an IMU that has no attitude of its own.
        """
        if self._odometry is None:
            return False
        variances = np.diag(self._odometry.state.covariance)[GRAVITY]
        return bool(variances.sum() > _UNFELT**2)

    def up(self, level: Level | None) -> FloatArray | None:
        """(3,) unit vector, map frame: as estimated, or by the ``level`` until it is.

        None without a level, and while gyro and accelerometer are not trusted.
        """
        if level is None or not self.trusted:
            return None
        if self._odometry is None:
            return level.map_up
        gravity = self._odometry.state.map_gravity
        up: FloatArray = -gravity / np.linalg.norm(gravity)
        return up

    def predict(self, stamp: int, buffer: ImuBuffer) -> InertialPrediction | None:
        """Pose, velocity and covariance of a moment; None if not known.

        It is not before the first :meth:`observe`, nor if the samples have a gap or are absurd.
        """
        self._predicted, self._rejected, self.other = None, False, None
        if self._odometry is None:
            return None
        samples = self._samples(self._odometry.state.stamp, stamp, buffer)
        if samples is None:
            return None
        try:
            prediction = self._odometry.predict(stamp, samples)
        except SweepError:
            return None
        self._predicted = stamp
        return prediction if self.trusted else None

    def reject(self) -> None:
        """Take the last prediction back: a sweep fitted better without the IMU."""
        self._predicted, self._rejected, self.other = None, True, None

    def leave_out(self) -> None:
        """Do without the IMU: its gyro is not trusted, and so there is no dispute either."""
        self.reject()
        self.dispute.settle()

    def moved(self, map_T_lidar: gtsam.Pose3, buffer: ImuBuffer) -> None:
        """Take the map, as the frame of the last :meth:`observe` sees it, to be elsewhere.

        Only if that frame, now at this pose, is farther off than it may be by its own error. What
        moved it is no motion, and tells neither velocity nor biases.
        """
        if self._odometry is None or self._odometry.distance_to(map_T_lidar) < _UNLIKELY:
            return
        self.dispute.settle()
        try:
            self._odometry.moved(map_T_lidar)
        except SweepError:
            self._odometry = None
        if self._predicted is not None:
            self.predict(self._predicted, buffer)

    def bend(
        self, stamp: int, seconds: FloatArray, map_R_lidar: FloatArray,
        level: Level, buffer: ImuBuffer,
    ) -> FloatArray | None:  # fmt: skip
        """See :func:`loam_gtsam.imu.bend.bend`; None if the samples do not tell.

        ``map_R_lidar`` (3, 3) is the rotation at ``stamp``; ``level`` tells gravity until it is
        estimated.
        """
        if not self.trusted:
            return None
        gravity, bias = level.down(self.config.gravity), np.zeros(3)
        first, last = (stamp + round(float(end) * 1e9) for end in (seconds[0], seconds[-1]))
        if not self._believable(first, last, buffer):
            return None
        if self._odometry is not None:
            state = self._odometry.state
            gravity, bias = state.map_gravity, state.acceleration_bias
        elif level.felt or not self._is_down(gravity @ map_R_lidar, first, last, buffer):
            return None
        lever = np.asarray(self.config.lidar_t_imu, np.float64)
        return bend(buffer, stamp, seconds, gravity @ map_R_lidar, bias, lever)

    def observe(
        self, last: tuple[int, gtsam.Pose3], now: tuple[int, gtsam.Pose3],
        information: FloatArray, level: Level, buffer: ImuBuffer,
        step: FloatArray = NO_STEP,
    ) -> Fused | None:  # fmt: skip
        """Take in what the scan alone said about a moment; the pose by both.

        None if there is no prediction, or if the two contradict each other.

        Parameters
        ----------
        last, now : stamp, nanoseconds, and ``map_T_lidar`` of the frame before and of this one
        information : (6, 6) of the second pose, zero where the scan is not believed
        level : tells gravity where the estimate begins, as the buffer does the bias of the gyro
        step : (6,) from the second pose to where the scan has it
        """
        stamp, pose = now
        self.contradicted, self.turn_surprise = False, 0.0
        if stamp <= last[0]:  # sweeps of unlike length
            return None
        self._carry_on(stamp, buffer)
        try:
            if self._odometry is not None and self._predicted == stamp:
                predicted = self._odometry.predicted
                fused = self._odometry.update(pose, information, step)
                self.turn_surprise = self._odometry.turn_surprise
                unlikely = self._odometry.surprise >= _UNLIKELY
                self.contradicted = unlikely and self.trusted
                agree = fused is not None and not unlikely
                count = self._contradictions + (-1 if agree else _OUTWEIGHS)
                self._contradictions = min(max(count, 0), 2 * _DISTRUST)
                self._compare(predicted, agree=agree)
                self.other = self._other_pose(pose)
                return fused if agree and self.trusted else None
            seconds = (stamp - last[0]) * 1e-9
            velocity = (pose.translation() - last[1].translation()) / seconds
            gravity = level.down(self.config.gravity)
            spread = _spread(pose, information, seconds)
            if self._odometry is not None:
                velocity, spread = self._gone_on(stamp, velocity, spread)
                self._odometry.restart(stamp, pose, velocity, spread)
            elif self._is_down(gravity @ pose.rotation().matrix(), last[0], stamp, buffer):
                sigmas = StartSigmas(gravity=_UNFELT / self.config.gravity) if level.felt else None
                self._odometry = InertialOdometry(
                    self.config, gravity, stamp, pose, velocity, buffer.gyro_bias, sigmas, spread
                )
        except SweepError:  # no window can begin here: with the next frame, then
            self._odometry = None
        return None

    def _compare(self, predicted: InertialState | None, *, agree: bool) -> None:
        """Take in whether scans and prediction agree; a turn that they deny begins no dispute."""
        if self.dispute.alone is not None:
            self.turn_surprise = 0.0
        if predicted is not None and self.turn_surprise < _TURNED:
            self.dispute.compared(predicted, self._contradictions, agree=agree)

    def _other_pose(self, map_T_lidar: gtsam.Pose3) -> OtherPose | None:
        """What is ``other`` for a lidar that the scans have at a pose; a dispute may end so."""
        if not self.dispute.holds or self._odometry is None:
            return None
        assert self.dispute.alone is not None
        pose, covariance = self._odometry.pose_of(self.dispute.alone)
        away = pose.localCoordinates(map_T_lidar)
        if self.dispute.ends(float(away @ np.linalg.solve(covariance, away))):
            self.dispute.settle()
            return None
        return OtherPose(pose, covariance, self.dispute.began)

    def _carry_on(self, stamp: int, buffer: ImuBuffer) -> None:
        """Bring what the IMU tells alone to this moment; it ends where that is absurd, or ends."""
        alone = self.dispute.alone
        if alone is None or self._odometry is None:
            return
        samples = self._samples(alone.stamp, stamp, buffer)
        if samples is None:
            self.dispute.settle()
            return
        try:
            self.dispute.alone = self._odometry.carried(alone, stamp, samples)
        except SweepError:
            self.dispute.settle()

    def _gone_on(
        self, stamp: int, velocity: FloatArray, spread: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """A velocity (3,) and its covariance (3, 3), with the one before.

        In between, samples were missing or absurd. If the prediction was taken back instead, the
        pose may have jumped, or the IMU be wrong: the velocity may be either.
        """
        assert self._odometry is not None
        state = self._odometry.state
        away = velocity - state.velocity
        doubt = np.outer(away, away) if self._rejected else np.zeros((3, 3))
        grown = _UNFELT * (stamp - state.stamp) * 1e-9
        before = state.covariance[VELOCITY, VELOCITY] + grown**2 * np.eye(3)
        gain = before @ np.linalg.inv(before + spread + doubt)
        return state.velocity + gain @ away, symmetric(gain @ (spread + doubt)) + doubt

    def _samples(self, first: int, last: int, buffer: ImuBuffer) -> ImuSamples | None:
        """What was felt between two stamps, and a gap's length about; None if it is absurd."""
        if not self._believable(first, last, buffer):
            return None
        margin = round(self.config.max_gap * 1e9)
        return buffer.samples_between(first - margin, last + margin)

    def _believable(self, first: int, last: int, buffer: ImuBuffer) -> bool:
        """Whether a lidar that is carried about may feel what it felt between two stamps."""
        samples = buffer.samples_between(min(first, last - round(_LONG * 1e9)), last)
        force = np.linalg.norm(samples.acceleration, axis=1) / max(self.config.gravity, 1.0)
        now = force[np.searchsorted(samples.stamps, first) :]
        return bool(
            len(now)
            and _FORCE[0] < now.mean() < _FORCE[1]
            and _USUAL[0] < np.median(force) < _USUAL[1]
        )

    def _is_down(self, gravity: FloatArray, first: int, last: int, buffer: ImuBuffer) -> bool:
        """Whether gravity (3,), lidar axes, may be that of what was felt between two stamps."""
        force = buffer.samples_between(first, last).acceleration
        most = _HARDEST * max(self.config.gravity, 1.0)
        return bool(len(force) and np.linalg.norm(force.mean(axis=0) + gravity) < most)
