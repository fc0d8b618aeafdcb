"""Motion from gyro and accelerometer between scan-matched poses; see docs/maths/inertial.md.

Inside, states are those of the *IMU*, at ``lidar_t_imu`` and with the axes of the lidar. (GTSAM's
own lever arm, ``body_P_sensor``, leaves out the angular acceleration.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.geometry import as_array, as_vector, cross, positive_root, symmetric
from loam_gtsam.imu.preintegration_window import (
    BIASES,
    GRAVITY,
    POSE,
    REST,
    STATE,
    VELOCITY,
    InertialState,
    Window,
    WindowFrame,
    information_root,
    scan_residual,
)
from loam_gtsam.types import FloatArray, ImuSamples, InputError, SweepError

_MAGNITUDE_SIGMA = 0.02
"""m/s^2: half the spread of gravity over the Earth's surface (9.780 to 9.832, WGS 84)."""
_JUMP = 30.0
"""Mahalanobis distance between prediction and scan that no noise explains: the pose has jumped (a
wrong match, a map put elsewhere). An information ten times too large in sigma stays below it."""
_LEAST_SIGMA = 1e-6
"""rad and m: keeps a covariance regular after a scan that claims more."""
NO_STEP = np.zeros(6)
"""To the optimum of a scan that is where its pose is."""
_UNSOLVABLE = RuntimeError, np.linalg.LinAlgError
"""What GTSAM and numpy raise where there is no finite solution."""


@dataclass(frozen=True, slots=True)
class StartSigmas:
    """Standard deviations of what is known where a window begins, all above zero.

    Attributes
    ----------
    pose : rad and m, of the lidar in the map: those of one scan match
    velocity : m/s: two poses 0.1 s apart, known to 0.03 m; with what the lever arm adds in a turn
    gyro_bias, acceleration_bias : rad/s and m/s^2, spread among MEMS IMUs without calibration
    gravity : rad, direction in the map. Gravity is estimated too, for a tilt of the map looks like
        a bias that turns with the platform.
    """

    pose: tuple[float, float] = (1e-3, 0.01)
    velocity: float = 0.5
    gyro_bias: float = 0.01
    acceleration_bias: float = 0.1
    gravity: float = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class InertialPrediction:
    """Pose of the next frame by the IMU, and (3,) m/s of the lidar, map frame.

    The (6, 6) covariance of the pose, ``[rotation, translation]``, right perturbation, is regular;
    ``across`` (3, 6) is that of the velocity with the pose, ``spread`` (3, 3) that of the velocity.
    """

    map_T_lidar: gtsam.Pose3
    velocity: FloatArray
    covariance: FloatArray
    across: FloatArray
    spread: FloatArray

    @property
    def covariance_in_map(self) -> FloatArray:
        """(6, 6) of the pose, left perturbation: along the axes of the map, about its origin."""
        to_map = self.map_T_lidar.AdjointMap()
        return symmetric(to_map @ self.covariance @ to_map.T)

    def velocity_at(self, map_T_lidar: gtsam.Pose3, known: float) -> FloatArray:
        """(3,) m/s of the lidar, map frame: what is expected if this is the pose.

        What is ``known`` to within so many m/s stays as it is predicted: a scan that is de-skewed
        for the velocity of whatever pose it is tried at may be bent until it fits there.
        """
        away = self.map_T_lidar.localCoordinates(map_T_lidar)
        variances, axes = np.linalg.eigh(self.spread)
        vague = axes[:, variances > known**2]
        told = vague.T @ self.across @ np.linalg.solve(self.covariance, away)
        expected: FloatArray = self.velocity + vague @ told
        return expected


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """A frame by its scan and the IMU together.

    Attributes
    ----------
    map_T_lidar : the pose
    velocity : (3,) m/s of the lidar, map frame
    covariance : (9, 9) of pose and velocity, in the map as it is around the lidar
    across : (9, 9) of these errors with those of the frame before
    gyro_bias : (3,) rad/s
    """

    map_T_lidar: gtsam.Pose3
    velocity: FloatArray
    covariance: FloatArray
    across: FloatArray
    gyro_bias: FloatArray


class InertialOdometry:
    """Predicts the pose of every frame from the IMU, and learns from what the scan then said.

    For every frame: :meth:`predict`, then :meth:`update`. A prediction that no update follows is
    forgotten, and the next one reaches back to the same frame. InputError if a shape or a value is
    wrong.

    Parameters
    ----------
    config : noise densities, lever arm, largest gap, frames in the window
    map_gravity : (3,) m/s^2 in the map frame, pointing down
    stamp : nanoseconds of the first pose
    map_T_lidar : the first pose
    velocity : (3,) m/s of the lidar, map frame
    gyro_bias : (3,) rad/s, to be taken off the samples
    sigmas : of these
    spread : (3, 3) covariance of the velocity, map frame, on top of that in ``sigmas``

    Attributes
    ----------
    state : the newest frame
    surprise : squared Mahalanobis distance between the last scan and its prediction; chi-squared
    turn_surprise : the same of the rotation alone
    restarts : how often the window was begun anew by itself: at the scan's pose, because the scan
        contradicts the prediction (more than 30 standard deviations); or at the predicted pose,
        because the graph could not be solved. Biases and gravity are kept.
    """

    state: InertialState
    _pending: WindowFrame | None

    def __init__(
        self,
        config: ImuConfig,
        map_gravity: FloatArray,
        stamp: int,
        map_T_lidar: gtsam.Pose3,
        velocity: FloatArray,
        gyro_bias: FloatArray,
        sigmas: StartSigmas | None = None,
        spread: FloatArray | None = None,
    ) -> None:
        self.config, self._sigmas = config, sigmas or StartSigmas()
        sigmas = self._sigmas
        gravity = as_vector(map_gravity, "map_gravity")
        size = float(np.linalg.norm(gravity))
        if size < 1.0:
            raise InputError(f"map_gravity: expected about 9.81 m/s^2, got {size:.3g}")
        self._lidar_T_imu = gtsam.Pose3(gtsam.Rot3(), np.asarray(config.lidar_t_imu, np.float64))
        self._to_lidar: FloatArray = self._lidar_T_imu.AdjointMap()
        self.restarts, self.surprise, self.turn_surprise = 0, 0.0, 0.0
        covariance = np.zeros((STATE, STATE))
        biases = np.repeat(np.square([sigmas.acceleration_bias, sigmas.gyro_bias]), 3)
        covariance[BIASES, BIASES] = np.diag(biases)
        along = np.outer(gravity, gravity) / size**2
        across = (size * sigmas.gravity) ** 2 * (np.eye(3) - along)
        # A vector of known length that points elsewhere is shorter along where it was thought to.
        length = _MAGNITUDE_SIGMA**2 + (size * sigmas.gravity**2) ** 2
        covariance[GRAVITY, GRAVITY] = length * along + across
        bias, still = as_vector(gyro_bias, "gyro_bias"), np.zeros(3)
        state = InertialState(stamp, gtsam.Pose3(), still, still, bias, gravity, covariance)
        self._start_at(state, map_T_lidar, velocity, spread)

    def predict(self, stamp: int, samples: ImuSamples) -> InertialPrediction:
        """Pose at ``stamp``, nanoseconds, from the newest frame and the samples since, lidar axes.

        SweepError if there is no prediction: the samples do not cover the time between, are not in
        order, have a gap above ``config.max_gap``, or add up to a motion without a finite
        covariance. Nothing has changed then; :meth:`restart` at a pose known otherwise.
        """
        frame = WindowFrame(self.config, self._window.newest + 1, self.state, stamp, samples)
        covariance = frame.predicted.covariance
        prediction = InertialPrediction(
            *self._of_lidar(frame.predicted, frame.rate),
            self._to_lidar @ covariance[POSE, POSE] @ self._to_lidar.T,
            covariance[VELOCITY, POSE] @ self._to_lidar.T,
            covariance[VELOCITY, VELOCITY],
        )
        if not _has_inverse(prediction.covariance):
            raise SweepError("IMU samples: the covariance of the motion they make has no inverse")
        self._pending = frame
        return prediction

    @property
    def predicted(self) -> InertialState | None:
        """The state of the last :meth:`predict`; None if an update has followed."""
        return None if self._pending is None else self._pending.predicted

    def carried(self, state: InertialState, stamp: int, samples: ImuSamples) -> InertialState:
        """A state of a frame, carried on to a stamp by the samples; errors of :meth:`predict`."""
        predicted = WindowFrame(self.config, 1, state, stamp, samples).predicted
        if not _has_inverse(predicted.covariance[POSE, POSE]):
            raise SweepError("IMU samples: the covariance of the motion they make has no inverse")
        return predicted

    def pose_of(self, state: InertialState) -> tuple[gtsam.Pose3, FloatArray]:
        """``map_T_lidar`` of a state, and its covariance (6, 6)."""
        covariance = self._to_lidar @ state.covariance[POSE, POSE] @ self._to_lidar.T
        return state.map_T_imu.compose(self._lidar_T_imu.inverse()), covariance

    def _of_lidar(self, state: InertialState, rate: FloatArray) -> tuple[gtsam.Pose3, FloatArray]:
        """Pose and velocity of the lidar, round which the IMU goes as the platform turns."""
        lever = cross(rate - state.gyro_bias, self._lidar_T_imu.translation())
        map_T_imu = state.map_T_imu
        velocity: FloatArray = state.velocity - map_T_imu.rotation().matrix() @ lever
        return map_T_imu.compose(self._lidar_T_imu.inverse()), velocity

    def update(
        self, measured: gtsam.Pose3, information: FloatArray, step: FloatArray = NO_STEP
    ) -> Fused | None:
        """Take in what the scan said about the predicted frame; None if a new window began.

        InputError if a value is wrong, or nothing has been predicted. SweepError if no window can
        begin here; make a new object then.

        Parameters
        ----------
        measured : ``map_T_lidar`` of the scan
        information : (6, 6) of the tangent there, positive semi-definite; singular or zero where
            the scan says nothing. It is believed; errors that last over frames are to be allowed
            for.
        step : (6,) of the tangent there, to the optimum of the scan. That may be far away along
            what it hardly knows, and all this is linear near ``measured`` only.
        """
        root = information_root(as_array(information, "information", (6, 6)))
        if self._pending is None:
            raise InputError("nothing has been predicted: call predict() once for every frame")
        frame, self._pending = self._pending, None
        before, predicted = self.state.covariance, frame.predicted
        self.surprise = self.turn_surprise = 0.0
        left = np.eye(STATE)  # share of the predicted state's error that the scan leaves
        if len(root):
            apart, derivative = scan_residual(predicted.map_T_imu, self._lidar_T_imu, measured)
            error = apart - step
            surprise, rows = root @ error, root @ derivative
            spread = predicted.covariance[:, POSE]
            covariance = spread[POSE]
            with np.errstate(over="ignore", invalid="ignore"):
                expected = rows @ covariance @ rows.T + np.eye(len(rows))
            if not _has_inverse(expected):
                self._start(predicted, 1)
                return None
            self.surprise = float(surprise @ np.linalg.solve(expected, surprise))
            told = derivative[:3] @ covariance @ derivative[:3].T
            self.turn_surprise = _surprise_of_turn(error[:3], told, information)
            if self.surprise > _JUMP**2:
                known = _updated(covariance, rows, expected)
                # A velocity that was wrong looks like this too: it is free along the jump, and
                # kept across it, where the scan may be blind.
                seconds = (predicted.stamp - self.state.stamp) * 1e-9
                jump = measured.rotation().matrix() @ apart[3:] / seconds
                free = predicted.covariance[VELOCITY, VELOCITY] + np.outer(jump, jump)
                moved = replace(predicted, map_T_imu=measured.compose(self._lidar_T_imu))
                self._start(_uncorrelated(moved, known, free), 1)
                return None
            frame.add_scan(self._lidar_T_imu, measured, root, step)
            left[:, POSE] -= spread @ rows.T @ np.linalg.solve(expected, rows)
        try:
            self.state = self._window.append(frame)
        except _UNSOLVABLE:
            self._start(frame.predicted, 1)
            return None
        to_lidar = np.eye(VELOCITY.stop)
        to_lidar[POSE, POSE] = self._to_lidar
        of_lidar, across = (
            to_lidar @ whole[: VELOCITY.stop, : VELOCITY.stop] @ to_lidar.T
            for whole in (self.state.covariance, left @ frame.transition @ before)
        )
        pose, velocity = self._of_lidar(self.state, frame.rate)
        return Fused(pose, velocity, of_lidar, across, self.state.gyro_bias)

    def restart(
        self,
        stamp: int,
        map_T_lidar: gtsam.Pose3,
        velocity: FloatArray,
        spread: FloatArray | None = None,
    ) -> None:
        """Begin a new window at a known pose, e.g. after a gap in the IMU data.

        Biases and gravity stay; what the biases may have walked since is added to their variance.
        Parameters as in the constructor, errors as of :meth:`update`.
        """
        seconds = (stamp - self.state.stamp) * 1e-9
        if seconds < 0.0:
            raise InputError(f"stamp: expected {self.state.stamp} or later, got {stamp}")
        walks = np.repeat([self.config.acceleration_bias_walk, self.config.gyro_bias_walk], 3)
        covariance = self.state.covariance.copy()
        covariance[BIASES, BIASES] += np.diag(np.square(walks)) * seconds
        state = replace(self.state, stamp=stamp, covariance=covariance)
        self._start_at(state, map_T_lidar, velocity, spread)

    def distance_to(self, map_T_lidar: gtsam.Pose3) -> float:
        """Squared Mahalanobis distance of the newest frame from a pose, by the frame's error."""
        away = self.state.map_T_imu.localCoordinates(map_T_lidar.compose(self._lidar_T_imu))
        return float(away @ np.linalg.solve(self.state.covariance[POSE, POSE], away))

    def moved(self, map_T_lidar: gtsam.Pose3) -> None:
        """Take the map, as the newest frame sees it, to be elsewhere: the frame is at this pose.

        Velocity and gravity turn along; how well all is known stays. A prediction is forgotten.
        SweepError if no window can begin here.
        """
        state, map_T_imu = self.state, map_T_lidar.compose(self._lidar_T_imu)
        turn = map_T_imu.rotation().compose(state.map_T_imu.rotation().inverse()).matrix()
        along = np.eye(STATE)
        along[VELOCITY, VELOCITY] = along[GRAVITY, GRAVITY] = turn
        moved = replace(
            state,
            map_T_imu=map_T_imu,
            velocity=turn @ state.velocity,
            map_gravity=turn @ state.map_gravity,
            covariance=along @ state.covariance @ along.T,
        )
        self._start(moved)

    def _start_at(
        self,
        state: InertialState,
        map_T_lidar: gtsam.Pose3,
        velocity: FloatArray,
        spread: FloatArray | None,
    ) -> None:
        """Begin a window at a pose of the lidar, with stamp, biases and gravity of ``state``."""
        from_lidar = np.linalg.inv(self._to_lidar)
        known = from_lidar * np.repeat(np.square(self._sigmas.pose), 3) @ from_lidar.T
        map_T_imu = map_T_lidar.compose(self._lidar_T_imu)
        state = replace(state, map_T_imu=map_T_imu, velocity=as_vector(velocity, "velocity"))
        of_velocity = self._sigmas.velocity**2 * np.eye(3)
        if spread is not None:
            of_velocity += as_array(spread, "spread", (3, 3))
        self._start(_uncorrelated(state, known, of_velocity))

    def _start(self, state: InertialState, restarts: int = 0) -> None:
        self.restarts += restarts
        try:
            self._window = Window(state, self.config.lag)
        except _UNSOLVABLE as error:
            raise SweepError(f"IMU: no window can begin from this state: {error}") from error
        self.state, self._pending = state, None


def _uncorrelated(state: InertialState, pose: FloatArray, velocity: FloatArray) -> InertialState:
    """``state`` with these covariances (6, 6) and (3, 3) of pose and velocity, alone."""
    covariance = np.zeros((STATE, STATE))
    covariance[REST, REST] = state.covariance[REST, REST]
    covariance[POSE, POSE] = pose
    covariance[VELOCITY, VELOCITY] = velocity
    return replace(state, covariance=covariance)


def _updated(covariance: FloatArray, rows: FloatArray, expected: FloatArray) -> FloatArray:
    """Covariance (6, 6) after measurements of unit noise with Jacobian (M, 6) ``rows``."""
    gain = np.linalg.solve(expected, rows @ covariance).T
    left = np.eye(6) - gain @ rows
    updated: FloatArray = left @ covariance @ left.T + gain @ gain.T
    return updated + _LEAST_SIGMA**2 * np.eye(6)


def _surprise_of_turn(error: FloatArray, told: FloatArray, information: FloatArray) -> float:
    """Squared Mahalanobis distance of a rotation (3,) that was predicted to (3, 3) ``told``.

    ``information`` (6, 6) is that of the scan: of its rotation, whatever the translation.
    """
    across, shifts = information[:3, 3:], information[3:, 3:]
    turns = information[:3, :3] - across @ np.linalg.pinv(shifts, hermitian=True) @ across.T
    # By the inverse of both covariances' sum, of which either may be beyond all bounds.
    root = positive_root(turns)
    variances, axes = np.linalg.eigh(symmetric(root @ told @ root))
    seen = axes.T @ root @ error
    return float(np.sum(seen**2 / (1.0 + np.maximum(variances, 0.0))))


def _has_inverse(matrix: FloatArray) -> bool:
    try:
        return bool(np.isfinite(np.linalg.inv(matrix)).all())
    except np.linalg.LinAlgError:
        return False
