"""Motion from a gyro and an accelerometer between scan-matched poses.

A window of the last frames (pose, velocity and biases each, and one gravity vector) is a factor
graph of GTSAM's pre-integrated IMU factors and of what the scans said. It predicts the next pose
with a covariance that grows only as fast as the IMU drifts, so that the prediction can stand in
for the scan along directions in which the scan says nothing. See docs/maths/inertial.md.

Inside, states are those of the *IMU*, at ``lidar_t_imu`` and with the axes of the lidar. Only the
way in and out is in the lidar frame. (GTSAM's own lever arm, ``body_P_sensor``, leaves out the
angular acceleration.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.geometry import as_array, as_vector
from loam_gtsam.imu.preintegration_factors import (
    BIASES,
    GRAVITY,
    POSE,
    REST,
    STATE,
    VELOCITY,
    information_root,
    samples_between,
    scan_residual,
)
from loam_gtsam.imu.preintegration_window import (
    InertialState,
    Window,
    WindowFrame,
    predict_state,
)
from loam_gtsam.types import FloatArray, ImuSamples, InputError, SweepError

_MAGNITUDE_SIGMA = 0.02
"""m/s^2: half the spread of gravity over the Earth's surface (9.780 to 9.832, WGS 84)."""
_JUMP = 30.0
"""Mahalanobis distance between prediction and scan that no noise explains: the pose has jumped (a
wrong match, a map put elsewhere). An information ten times too large in sigma stays below it."""
_LEAST_SIGMA = 1e-6
"""rad and m: keeps a covariance regular after a scan that claims more."""
_POSE_SIGMA = (1e-3, 0.01)
"""rad and m of a pose from which a window begins: that of one scan match."""
_VELOCITY_SIGMA = 0.5
"""m/s: two poses 0.1 s apart, known to 0.03 m."""
_ZERO = (0.0, 0.0, 0.0)
_UNSOLVABLE = RuntimeError, np.linalg.LinAlgError
"""What GTSAM and numpy raise where there is no finite solution."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Pose and velocity of the next frame by the IMU.

    Attributes
    ----------
    stamp : nanoseconds
    map_T_lidar : predicted pose
    velocity : (3,) m/s of the lidar, map frame
    covariance : (6, 6) of the pose, ``[rotation, translation]``, right perturbation; it has an
        inverse
    """

    stamp: int
    map_T_lidar: gtsam.Pose3
    velocity: FloatArray
    covariance: FloatArray


class InertialOdometry:
    """Predicts the pose of every frame from the IMU, and learns from what the scan then said.

    For every frame: :meth:`predict`, then either :meth:`update` or :meth:`skip`. A prediction that
    neither follows is forgotten, and the next one reaches back to the same frame.

    Parameters
    ----------
    config : noise densities, lever arm, largest gap, frames in the window
    map_gravity : (3,) m/s^2 in the map frame, pointing down
    stamp : nanoseconds of the first pose
    map_T_lidar : the first pose
    velocity : (3,) m/s of the lidar, map frame
    gyro_bias, acceleration_bias : (3,) rad/s and m/s^2, what is to be taken off the samples
    pose_sigma : of the first pose in the map, (rad, m)
    velocity_sigma : m/s per axis; it includes what the lever arm and a turn at the start add
    gyro_bias_sigma, acceleration_bias_sigma : rad/s and m/s^2 per axis, spread among MEMS IMUs
        that were not calibrated
    gravity_sigma : rad, direction of ``map_gravity``. Gravity is estimated too, for a tilt of the
        map looks like a bias that turns with the platform.

    Attributes
    ----------
    state : the newest frame
    restarts : how often the window was begun anew by itself: at the scan's pose, because the scan
        contradicts the prediction (more than 30 standard deviations); or at the predicted pose,
        because the graph could not be solved. Biases and gravity are kept.

    Raises
    ------
    InputError
        If a shape or a value is wrong.
    """

    _pending: tuple[WindowFrame, InertialState, gtsam.NonlinearFactor] | None

    def __init__(
        self,
        config: ImuConfig,
        map_gravity: FloatArray,
        stamp: int,
        map_T_lidar: gtsam.Pose3,
        velocity: FloatArray | tuple[float, ...] = _ZERO,
        gyro_bias: FloatArray | tuple[float, ...] = _ZERO,
        acceleration_bias: FloatArray | tuple[float, ...] = _ZERO,
        *,
        pose_sigma: tuple[float, float] = _POSE_SIGMA,
        velocity_sigma: float = _VELOCITY_SIGMA,
        gyro_bias_sigma: float = 0.01,
        acceleration_bias_sigma: float = 0.1,
        gravity_sigma: float = 0.01,
    ) -> None:
        self.config = config
        gravity = as_vector(map_gravity, "map_gravity")
        size = float(np.linalg.norm(gravity))
        if size < 1.0:
            raise InputError(f"map_gravity: expected about 9.81 m/s^2, got {size:.3g}")
        sigmas = acceleration_bias_sigma, gyro_bias_sigma, gravity_sigma
        _check_positive(*pose_sigma, velocity_sigma, *sigmas)
        self._lidar_T_imu = gtsam.Pose3(gtsam.Rot3(), np.asarray(config.lidar_t_imu, np.float64))
        self._to_lidar: FloatArray = self._lidar_T_imu.AdjointMap()
        self.restarts = 0
        velocity = as_vector(velocity, "velocity")
        state = InertialState(
            stamp,
            map_T_lidar.compose(self._lidar_T_imu),
            velocity,
            as_vector(acceleration_bias, "acceleration_bias"),
            as_vector(gyro_bias, "gyro_bias"),
            gravity,
            _rest_covariance(gravity, *sigmas),
        )
        known = _pose_covariance(self._to_lidar, pose_sigma)
        free = velocity_sigma**2 * np.eye(3)
        self._start(_start_state(state, state.map_T_imu, velocity, known, free))

    def __getstate__(self) -> dict[str, Any]:
        # GTSAM's factors cannot be kept; the prediction is made again.
        asked = None if self._pending is None else self._pending[0]
        return vars(self) | {"_pending": None, "_asked": asked}

    def __setstate__(self, state: dict[str, Any]) -> None:
        asked: WindowFrame | None = state.pop("_asked")
        vars(self).update(state)
        if asked is not None:
            self.predict(asked.stamp, asked.samples)

    def predict(self, stamp: int, samples: ImuSamples) -> Prediction:
        """Pose at ``stamp``, from the newest frame and the samples since.

        Parameters
        ----------
        stamp : nanoseconds
        samples : in lidar axes, from ``state.stamp`` or before to ``stamp`` or after

        Raises
        ------
        InputError
            If an array has the wrong shape.
        SweepError
            If there is no prediction: the samples do not cover the time between, are not in order,
            have a gap above ``config.max_gap``, or add up to a motion without a finite covariance.
            Nothing has changed then; :meth:`restart` at a pose known otherwise.
        """
        last = self.state
        predicted, factor, rate = predict_state(
            self.config, last, self._window.newest, stamp, samples
        )
        # The IMU goes round the lidar as the platform turns.
        lever = np.cross(rate - last.gyro_bias, self._lidar_T_imu.translation())
        map_T_imu = predicted.map_T_imu
        prediction = Prediction(
            stamp,
            map_T_imu.compose(self._lidar_T_imu.inverse()),
            predicted.velocity - map_T_imu.rotation().matrix() @ lever,
            self._to_lidar @ predicted.covariance[POSE, POSE] @ self._to_lidar.T,
        )
        if not _has_inverse(prediction.covariance):
            raise SweepError("IMU samples: the covariance of the motion they make has no inverse")
        frame = WindowFrame(last, stamp, samples_between(samples, last.stamp, stamp))
        self._pending = frame, predicted, factor
        return prediction

    def update(
        self, measured: gtsam.Pose3, information: FloatArray, gradient: FloatArray | None = None
    ) -> None:
        """Take in what the scan said about the predicted frame.

        The scan is the quadratic ``0.5 e' information e - gradient' e`` in ``e``, the tangent at
        ``measured``. Where its matches alone have their optimum at ``measured`` the gradient is
        zero. Where the prediction was a prior of that solve it is not: hand over the vector of the
        linearised *scan* factor there, without the prior, or the prediction counts twice.

        Parameters
        ----------
        measured : ``map_T_lidar``
        information : (6, 6), positive semi-definite: nothing is inverted, so that it may be
            singular or zero. It is believed; errors that last over frames are to be allowed for.
        gradient : (6,) or None for zero

        Raises
        ------
        InputError
            If a shape or a value is wrong, or nothing has been predicted.
        SweepError
            If no window can begin here; make a new object then.
        """
        root, offset = information_root(
            as_array(information, "information", (6, 6)),
            np.zeros(6) if gradient is None else as_vector(gradient, "gradient", 6),
        )
        frame, predicted, imu_factor = self._take_pending()
        if not len(root):
            self._append(frame, predicted, imu_factor)
            return
        error, derivative = scan_residual(predicted.map_T_imu, self._lidar_T_imu, measured)
        surprise, rows = root @ error - offset, root @ derivative
        covariance = predicted.covariance[POSE, POSE]
        with np.errstate(over="ignore", invalid="ignore"):
            expected = rows @ covariance @ rows.T + np.eye(len(rows))
        if not _has_inverse(expected):
            self.restarts += 1
            self._start(predicted)
        elif surprise @ np.linalg.solve(expected, surprise) > _JUMP**2:
            self.restarts += 1
            known = _updated(covariance, rows, expected)
            # A velocity that was wrong looks like this too: it is free along the jump, and kept
            # across it, where the scan may be blind.
            seconds = (predicted.stamp - self.state.stamp) * 1e-9
            jump = measured.rotation().matrix() @ error[3:] / seconds
            free = predicted.covariance[VELOCITY, VELOCITY] + np.outer(jump, jump)
            map_T_imu = measured.compose(self._lidar_T_imu)
            self._start(_start_state(predicted, map_T_imu, predicted.velocity, known, free))
        else:
            frame = replace(frame, scan=(measured, root, offset))
            self._append(frame, predicted, imu_factor)

    def skip(self) -> None:
        """Take the prediction as it is, for a frame of which the scan says nothing.

        Raises
        ------
        InputError
            If nothing has been predicted.
        SweepError
            As :meth:`update`.
        """
        self._append(*self._take_pending())

    def restart(
        self,
        stamp: int,
        map_T_lidar: gtsam.Pose3,
        velocity: FloatArray,
        *,
        pose_sigma: tuple[float, float] = _POSE_SIGMA,
        velocity_sigma: float = _VELOCITY_SIGMA,
    ) -> None:
        """Begin a new window at a known pose, e.g. after a gap in the IMU data.

        Biases and gravity stay; what the biases may have walked since is added to their variance.
        Parameters as in the constructor.

        Raises
        ------
        InputError
            If ``stamp`` is before ``state.stamp``, or a shape or a value is wrong.
        SweepError
            As :meth:`update`.
        """
        seconds = (stamp - self.state.stamp) * 1e-9
        if seconds < 0.0:
            raise InputError(f"stamp: expected {self.state.stamp} or later, got {stamp}")
        _check_positive(*pose_sigma, velocity_sigma)
        walks = np.repeat([self.config.acceleration_bias_walk, self.config.gyro_bias_walk], 3)
        covariance = self.state.covariance.copy()
        covariance[BIASES, BIASES] += np.diag(np.square(walks)) * seconds
        known = _pose_covariance(self._to_lidar, pose_sigma)
        free = velocity_sigma**2 * np.eye(3)
        state = replace(self.state, stamp=stamp, covariance=covariance)
        map_T_imu = map_T_lidar.compose(self._lidar_T_imu)
        self._start(_start_state(state, map_T_imu, as_vector(velocity, "velocity"), known, free))

    def _start(self, state: InertialState) -> None:
        try:
            self._window = Window(self.config, self._lidar_T_imu, state)
        except _UNSOLVABLE as error:
            raise SweepError(f"IMU: no window can begin from this state: {error}") from error
        self.state: InertialState = state
        self._pending = None

    def _take_pending(self) -> tuple[WindowFrame, InertialState, gtsam.NonlinearFactor]:
        if self._pending is None:
            raise InputError("nothing has been predicted: call predict() once for every frame")
        pending, self._pending = self._pending, None
        return pending

    def _append(
        self, frame: WindowFrame, predicted: InertialState, imu_factor: gtsam.NonlinearFactor
    ) -> None:
        try:
            self.state = self._window.append(frame, predicted, imu_factor)
        except _UNSOLVABLE:
            self.restarts += 1
            self._start(predicted)


def _pose_covariance(to_lidar: FloatArray, sigmas: tuple[float, float]) -> FloatArray:
    """(6, 6) of the IMU from standard deviations (rad, m) of the lidar."""
    from_lidar = np.linalg.inv(to_lidar)
    covariance: FloatArray = from_lidar * np.repeat(np.square(sigmas), 3) @ from_lidar.T
    return covariance


def _start_state(
    state: InertialState,
    map_T_imu: gtsam.Pose3,
    velocity: FloatArray,
    pose_covariance: FloatArray,
    velocity_covariance: FloatArray,
) -> InertialState:
    """The first state of a window: another pose and velocity, with the rest of ``state``."""
    covariance = np.zeros((STATE, STATE))
    covariance[REST, REST] = state.covariance[REST, REST]
    covariance[POSE, POSE] = pose_covariance
    covariance[VELOCITY, VELOCITY] = velocity_covariance
    return replace(state, map_T_imu=map_T_imu, velocity=velocity, covariance=covariance)


def _updated(covariance: FloatArray, rows: FloatArray, expected: FloatArray) -> FloatArray:
    """Covariance (6, 6) after measurements of unit noise with the Jacobian ``rows`` (M, 6).

    Parameters
    ----------
    expected : (M, M) covariance of the innovation
    """
    gain = np.linalg.solve(expected, rows @ covariance).T
    left = np.eye(6) - gain @ rows
    updated: FloatArray = left @ covariance @ left.T + gain @ gain.T
    return updated + _LEAST_SIGMA**2 * np.eye(6)


def _rest_covariance(
    gravity: FloatArray, acceleration_bias_sigma: float, gyro_bias_sigma: float, sigma: float
) -> FloatArray:
    """(18, 18) of a state of which only biases and gravity are filled in; ``sigma`` in rad."""
    size = float(np.linalg.norm(gravity))
    covariance = np.zeros((STATE, STATE))
    sigmas = [acceleration_bias_sigma, gyro_bias_sigma]
    covariance[BIASES, BIASES] = np.diag(np.repeat(np.square(sigmas), 3))
    along = np.outer(gravity, gravity) / size**2
    across = np.eye(3) - along
    covariance[GRAVITY, GRAVITY] = _MAGNITUDE_SIGMA**2 * along + (size * sigma) ** 2 * across
    return covariance


def _has_inverse(matrix: FloatArray) -> bool:
    try:
        return bool(np.isfinite(np.linalg.inv(matrix)).all())
    except np.linalg.LinAlgError:
        return False


def _check_positive(*sigmas: float) -> None:
    if not all(sigma > 0.0 for sigma in sigmas):
        raise InputError(
            f"sigmas: expected all above 0, got {sigmas}; a small one says that it is known"
        )
