"""What an IMU does for the mapper: which way is up, the tilt of every pose, the gyro's bias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.geometry import checked_pose
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.imu.coupling import Dispute, GyroTrust, OtherPose, TightCoupling
from loam_gtsam.imu.diagnosis import LATEST, scans_problems
from loam_gtsam.imu.level import Level, find_level, mean_orientation
from loam_gtsam.imu.preintegration import NO_STEP, Fused, InertialPrediction
from loam_gtsam.imu_prior import (
    blend,
    blend_direction,
    equivalent_prior,
    gravity_factor,
    roll_pitch_factor,
    tilt_information,
    too_steep,
)
from loam_gtsam.registration.odometry import Moment
from loam_gtsam.registration.solvers import POSE_KEY, Solution, fuse
from loam_gtsam.registration.solvers.scan_error import ScanError
from loam_gtsam.types import ConfigError, FloatArray, TiltPrior, check_kind

_BIAS_GAIN = 0.02  # share of a frame's difference of gyro and scan for the bias: 50 frames
_DISAGREEMENT = (np.radians(0.3), 0.5)
"""Angle and share of the turn by which gyro and scan must differ to disagree: above all noise."""
_LATELY = 5  # pairs of frames over which a gyro and the scans are held against each other
_PAIRS = 2000  # number of pairs of frames, the newest, behind the check of the mounting
_SURE = 4.2  # sigmas of one attitude: three of the difference of two


class Registration(NamedTuple):
    """A solved sweep after the IMU had its say."""

    posed: PosedSweep  # with the final motion
    solution: Solution  # at the middle of the sweep
    map_T_lidar: gtsam.Pose3  # at the reference time
    tilt: TiltPrior = TiltPrior.NONE  # how roll and pitch acted
    fused: Fused | None = None  # scan, gyro and accelerometer together; None if not
    contradicted: bool = False  # whether they predicted another pose
    problem: str = ""  # sentence for the user
    turned: FloatArray | None = None  # (3,) rad/s that the gyro turned more than the last scans
    other: OtherPose | None = None  # where gyro and accelerometer lead if scans contradict them


def with_imu(
    imu: ImuTracker | None,
    posed: PosedSweep,
    last: Moment | None,
    solution: Solution,
    scan: ScanError | None,
    factors: Sequence[gtsam.NonlinearFactor],
    beside_imu: bool = False,
) -> Registration:
    """What :meth:`ImuTracker.add_scan` makes of a solved sweep; the sweep as solved without one.

    ``scan`` is the error of the scan, and ``factors`` are those it was solved with, beside the IMU
    or not.
    """
    if imu is None:
        return Registration(posed, solution, solution.map_T_lidar.compose(posed.middle_T_reference))
    pose = solution.map_T_lidar
    alone = None if scan is None else scan.with_factors(pose, factors, alone=not beside_imu)
    return imu.add_scan(posed, last, solution, alone)


class _TurnPairs:
    """How scans and gyro have turned between pairs of frames, the newest."""

    def __init__(self) -> None:
        self._spans = np.zeros((0, 2), np.int64)  # stamps
        self._by_scan, self._by_gyro = np.zeros((2, 0, 3))

    def add(self, span: tuple[int, int], by_scan: FloatArray, by_gyro: FloatArray) -> None:
        """Add the turns (3,) between two stamps."""
        self._spans = np.vstack([self._spans, span])[-_PAIRS:]
        self._by_scan = np.vstack([self._by_scan, by_scan])[-_PAIRS:]
        self._by_gyro = np.vstack([self._by_gyro, by_gyro])[-_PAIRS:]

    @property
    def more(self) -> FloatArray | None:
        """(3,) rad/s, by which the gyro turned more than the last scans; None without any."""
        if not len(self._spans):
            return None
        turned = (self._by_gyro - self._by_scan)[-_LATELY:].sum(axis=0)
        more: FloatArray = turned / (1e-9 * float(np.diff(self._spans[-_LATELY:]).sum()))
        return more

    def problems(self, buffer: ImuBuffer, config: ImuConfig) -> tuple[str, ...]:
        """See :func:`loam_gtsam.imu.diagnosis.scans_problems`."""
        if not len(self._spans):
            return ()
        more = round((LATEST + 1.0) * 1e9)
        samples = buffer.samples_between(self._spans.min() - more, self._spans.max() + more)
        return scans_problems(self._spans, self._by_scan, self._by_gyro, samples, config)


class ImuTracker:
    """The IMU's part in mapping, and what it has learnt from the frames so far.

    Two sweeps that are compared, ``last`` and ``now``, are the stamps and solved poses of their
    middles. More samples may be added to ``buffer`` at any time.

    Attributes
    ----------
    level, gyro : up in the map, None until there is an orientation; whether the gyro is trusted
    """

    def __init__(self, config: ImuConfig, buffer: ImuBuffer) -> None:
        self.config, self.buffer = config, _checked(buffer, config).with_own_bias()
        self._given_bias = buffer.gyro_bias
        self.reset()

    def reset(self) -> None:
        """Forget all frames: as a new tracker on the same buffer, with the bias it was given."""
        self.buffer.gyro_bias = self._given_bias
        self.level: Level | None = None
        self.gyro = GyroTrust()
        self._turns = _TurnPairs()
        self._coupling = TightCoupling(self.config)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.config, self.buffer), self.__getstate__()

    # For checkpoints, in which the buffer may be one that is there again, with another bias.
    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"gyro_bias": self.buffer.gyro_bias}

    def __setstate__(self, state: dict[str, Any]) -> None:
        bias = state.pop("gyro_bias")
        vars(self).update(state)
        self.buffer.gyro_bias = bias

    def learn_from(self, other: ImuTracker) -> None:
        """Know what another tracker knows of the same IMU."""
        self.__setstate__(other.__getstate__() | {"_given_bias": self._given_bias})

    @property
    def trusted_gyro(self) -> ImuBuffer | None:
        """The buffer, while its gyro agrees with the scans."""
        return self.buffer if self.gyro.holds else None

    @property
    def was_still(self) -> bool:
        """Whether gyro and accelerometer were at rest when the run began."""
        return self.level is not None and self.level.source == "still"

    @property
    def map_up(self) -> FloatArray | None:
        """(3,) unit vector, map frame; None if it was not found, or the IMU is not trusted."""
        return self._coupling.up(self.level if self.gyro.holds else None)

    @property
    def dispute(self) -> Dispute:
        """Whether scans contradict gyro and accelerometer."""
        return self._coupling.dispute

    @property
    def problems(self) -> tuple[str, ...]:
        """What :func:`loam_gtsam.imu.diagnosis.scans_problems` says of the frames so far."""
        return self._turns.problems(self.buffer, self.config)

    def rotation_between(self, first: int, second: int) -> gtsam.Rot3 | None:
        """``first_R_second`` of two stamps by the gyro; None while it is not to be trusted."""
        gyro = self.trusted_gyro
        return None if gyro is None else gyro.rotation_between(first, second)

    def first_pose(self, stamp: int, given: gtsam.Pose3 | None = None) -> gtsam.Pose3:
        """Pose of the first sweep: the origin of a map whose z axis points up, if configured.

        ``given`` is the pose that a user wants, in a map of the user's own; up is found in that.
        """
        rest = self.buffer.rest_at(stamp)
        if rest is not None:
            self.buffer.gyro_bias = rest.gyro
        levelled = self.config.level and given is None
        pose = gtsam.Pose3() if given is None else checked_pose(given, "guess")
        self.level = find_level(self.buffer, self.config, stamp, pose, levelled=levelled)
        if self.level is None or not levelled:
            return pose
        tilted = gtsam.Rot3.RzRyRx(self.level.roll, self.level.pitch, 0.0)
        return gtsam.Pose3(tilted, np.zeros(3))

    def find_level(self, stamp: int, map_T_lidar: gtsam.Pose3) -> None:
        """If there was no orientation at the start, find up in the map as soon as there is one."""
        if self.level is None:
            self.level = find_level(self.buffer, self.config, stamp, map_T_lidar, levelled=False)

    def factors(self, stamp: int) -> Sequence[gtsam.NonlinearFactor]:
        """Factors on the pose of a moment for the solve itself: only with ``imu.prior: sigma``."""
        measured = self._attitude(stamp) if self.config.prior == "sigma" else None
        return () if measured is None else (self._gravity(measured),)

    def add_tilt(
        self, stamp: int, solution: Solution, last: Moment | None = None
    ) -> tuple[Solution, TiltPrior]:
        """Add the IMU's roll and pitch to the solution of a moment, in the modes with a factor.

        ``last`` is the moment before; an attitude that turned unlike the scans since is dropped.
        """
        config = self.config
        if config.prior in ("off", "blend"):
            return solution, TiltPrior.NONE
        measured = self._attitude(stamp)
        if measured is None or self.level is None:
            return solution, TiltPrior.DROPPED
        if config.prior == "sigma":
            return solution, TiltPrior.GRAVITY  # it was in the solve
        if config.coupling == "tight" and not self.buffer.measures_attitude:
            return solution, TiltPrior.NONE  # made of acceleration, which counts already
        if not _turned_alike(self.buffer, config.sigma_deg, last, stamp, solution.map_T_lidar):
            return solution, TiltPrior.DROPPED
        pose, information = solution.map_T_lidar, solution.information
        level_R_lidar = self.level.level_R_map.compose(pose.rotation())
        steep = too_steep(level_R_lidar, measured)
        if steep or _tilt_is_unknown(solution, level_R_lidar, config.sigma_deg):
            factor, tilt = self._gravity(measured), TiltPrior.GRAVITY
        else:
            prior = equivalent_prior(level_R_lidar, information, measured, config.weight)
            factor = roll_pitch_factor(POSE_KEY, prior, self.level.level_R_map)
            tilt = TiltPrior.EQUIVALENT
        pose, information = fuse(pose, information, [factor])
        return replace(solution, map_T_lidar=pose, information=information), tilt

    def blend_tilt(self, stamp: int, map_T_lidar: gtsam.Pose3) -> tuple[gtsam.Pose3, TiltPrior]:
        """Blend roll and pitch into the pose of a moment: only with ``imu.prior: blend``."""
        if self.config.prior != "blend":
            return map_T_lidar, TiltPrior.NONE
        measured, level, weight = self._attitude(stamp), self.level, self.config.weight
        if measured is None or level is None:
            return map_T_lidar, TiltPrior.DROPPED
        if too_steep(level.level_R_map.compose(map_T_lidar.rotation()), measured):
            blended = blend_direction(map_T_lidar, measured, weight, level.map_up)
            return blended, TiltPrior.GRAVITY
        return blend(map_T_lidar, measured, weight, level.level_R_map), TiltPrior.BLEND

    def contradicted(self, last: Moment | None, solution: Solution, stamp: int) -> bool:
        """Whether the gyro, while trusted, turned otherwise than a solved sweep says.

        ``last`` and ``stamp`` are of the middles of the last sweep and of this one.
        """
        if last is None or not last.solved or not solution.solved or self.trusted_gyro is None:
            return False
        turned = self.buffer.rotation_between(last.stamp, stamp)
        scan = last.map_T_lidar.rotation().between(solution.map_T_lidar.rotation())
        return turned is not None and _disagree(scan, turned, *_DISAGREEMENT)

    def compare_gyro(self, last: tuple[int, gtsam.Pose3], now: tuple[int, gtsam.Pose3]) -> None:
        """Learn the gyro's bias from two solved sweeps; distrust a gyro that contradicts them."""
        turned = self.buffer.rotation_between(last[0], now[0])
        if turned is None or now[0] <= last[0]:  # sweeps of unlike length
            return
        scan = last[1].rotation().between(now[1].rotation())
        by_scan, by_gyro = gtsam.Rot3.Logmap(scan), gtsam.Rot3.Logmap(turned)
        self._turns.add((last[0], now[0]), by_scan, by_gyro)
        agree = not _disagree(scan, turned, *_DISAGREEMENT)
        self.gyro.compared(agree=agree)
        if agree:
            rate = gtsam.Rot3.Logmap(scan.between(turned)) / ((now[0] - last[0]) * 1e-9)
            self.buffer.gyro_bias = self.buffer.gyro_bias + _BIAS_GAIN * rate

    def reject(self) -> None:
        """Take the last prediction back: a sweep fitted better without the IMU."""
        self._coupling.reject()

    def registered_anew(self, map_T_lidar: gtsam.Pose3) -> None:
        """Take the last sweep to be at another pose, by the sweeps that followed."""
        self._coupling.moved(map_T_lidar, self.buffer)

    def add_scan(
        self, posed: PosedSweep, last: Moment | None, solution: Solution,
        alone: tuple[FloatArray, FloatArray] | None = None,
    ) -> Registration:  # fmt: skip
        """Learn from a solved sweep, and bring the IMU into its pose.

        ``posed`` has the final motion; ``solution`` and ``last`` are of the middles of this and the
        last sweep, of which a predicted pose says nothing about the IMU. ``alone`` is what is known
        without the IMU: (6, 6) information, and the step (6,) to its optimum; None if nothing is.
        """
        stamp, reference_stamp = posed.sweep.stamp, posed.sweep.reference_stamp
        fused, contradicted = None, False
        if last is not None and last.solved:
            self.compare_gyro(last[:2], (stamp, solution.map_T_lidar))
            if alone is not None:
                fused = self.observe(last[:2], (stamp, solution.map_T_lidar), *alone)
                contradicted = self._coupling.contradicted
        if fused is not None:
            self.buffer.gyro_bias = fused.gyro_bias
            solution = replace(solution, map_T_lidar=fused.map_T_lidar)
            velocity = fused.map_T_lidar.rotation().matrix().T @ fused.velocity
            posed = posed.sweep.at(posed.sweep.twist_at_reference(posed.twist[:3], velocity))
        solution, tilt = self.add_tilt(stamp, solution, last)
        pose = solution.map_T_lidar.compose(posed.middle_T_reference)
        if tilt is TiltPrior.NONE:
            pose, tilt = self.blend_tilt(reference_stamp, pose)
        self.find_level(reference_stamp, pose)  # for the frames to come
        told = fused, contradicted, self.gyro.problem or self.dispute.problem, self._turns.more
        return Registration(posed, solution, pose, tilt, *told, self._coupling.other)

    def predict(self, stamp: int) -> InertialPrediction | None:
        """Pose, velocity and covariance of a moment by gyro and accelerometer; None if not known.

        To be called once a frame, before :meth:`observe` of the same stamp.
        """
        if self.config.coupling != "tight" or self.trusted_gyro is None:
            self._coupling.leave_out()
            return None
        return self._coupling.predict(stamp, self.buffer)

    def bend(self, stamp: int, seconds: FloatArray, map_R_lidar: FloatArray) -> FloatArray | None:
        """(K, 3) metres: the lidar's way from a straight line, by :func:`loam_gtsam.imu.bend.bend`.

        ``map_R_lidar`` (3, 3) is the rotation at ``stamp``, near enough to know what is down. None
        if the IMU does not tell.
        """
        if self.config.coupling != "tight" or self.level is None or self.trusted_gyro is None:
            return None
        return self._coupling.bend(stamp, seconds, map_R_lidar, self.level, self.buffer)

    def observe(
        self, last: tuple[int, gtsam.Pose3], now: tuple[int, gtsam.Pose3],
        information: FloatArray, step: FloatArray = NO_STEP,
    ) -> Fused | None:  # fmt: skip
        """Take in what the scan alone said about a moment; the pose by both, None if by none.

        ``information`` is (6, 6), of the second sweep, and zero where the scan is not believed;
        ``step`` (6,) leads from the second pose to where the scan has it.
        """
        if self.config.coupling != "tight" or self.level is None:
            return None
        fused = self._coupling.observe(last, now, information, self.level, self.buffer, step)
        self.gyro.surprised(self._coupling.turn_surprise)
        return fused

    def _attitude(self, stamp: int) -> gtsam.Rot3 | None:
        """``world_R_lidar``; None if unknown, or up is unknown in the map."""
        if self.level is None:
            return None
        if self.trusted_gyro is None or not self.config.average_seconds:
            return self.buffer.orientation(stamp)
        found = mean_orientation(self.buffer, stamp, 0.5 * self.config.average_seconds)
        return None if found is None else found[0]

    def _gravity(self, measured: gtsam.Rot3) -> gtsam.NonlinearFactor:
        assert self.level is not None
        sigma = float(np.radians(self.config.sigma_deg))
        return gravity_factor(POSE_KEY, measured, sigma, self.level.map_up)


def _checked(buffer: ImuBuffer, config: ImuConfig) -> ImuBuffer:
    """The buffer itself; ConfigError if it has brought its samples elsewhere than configured."""
    check_kind(buffer, ImuBuffer, "imu", "ImuBuffer(config.imu, samples) makes one")
    for name in ("lidar_R_imu_deg", "time_offset", "max_gap"):
        made, wanted = getattr(buffer.config, name), getattr(config, name)
        if made != wanted:
            raise ConfigError(
                f"imu.{name}: expected that of the ImuBuffer, {made}, got {wanted}; make the "
                "buffer with the same configuration, ImuBuffer(config.imu, samples)"
            )
    return buffer


def _turned_alike(
    buffer: ImuBuffer, sigma_deg: float, last: Moment | None, stamp: int, map_T_lidar: gtsam.Pose3
) -> bool:
    """Whether the IMU's attitude turned as the scans did since ``last``, as far as is known."""
    if last is None or not last.solved:
        return True
    before, now = buffer.orientation(last.stamp), buffer.orientation(stamp)
    if before is None or now is None:
        return True
    scan = last.map_T_lidar.rotation().between(map_T_lidar.rotation())
    noise = _SURE * float(np.radians(sigma_deg))
    return not _disagree(scan, before.between(now), noise, _DISAGREEMENT[1])


def _tilt_is_unknown(solution: Solution, level_R_lidar: gtsam.Rot3, degrees: float) -> bool:
    """Whether the scan knows some direction of the tilt less well than to so many degrees."""
    knows = tilt_information(solution.scan_information, level_R_lidar)
    return bool(np.linalg.eigvalsh(knows)[0] < np.radians(degrees) ** -2)


def _disagree(scan: gtsam.Rot3, turned: gtsam.Rot3, angle: float, share: float) -> bool:
    """Whether two rotations differ by more than an angle, rad, and a share of the first."""
    missing = np.linalg.norm(gtsam.Rot3.Logmap(scan.between(turned)))
    return bool(missing > angle + share * np.linalg.norm(gtsam.Rot3.Logmap(scan)))
