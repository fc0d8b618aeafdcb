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
from gtsam.symbol_shorthand import B, G, V, X

from loam_gtsam.config import ImuConfig
from loam_gtsam.imu.preintegration_factors import (
    BIASES,
    GRAVITY,
    POSE,
    REST,
    STATE,
    VELOCITY,
    pieces_between,
    preintegration_parameters,
    propagate,
    scan_factor,
    scan_residual,
    square_root,
)
from loam_gtsam.imu.preintegration_window import InertialState, Window
from loam_gtsam.types import FloatArray, ImuSamples, InputError

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
_Scan = tuple[gtsam.Pose3, FloatArray, FloatArray | None]
"""Pose, information and gradient of a scan, as :meth:`InertialOdometry.update` takes them."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where the IMU says the next frame is.

    Attributes
    ----------
    stamp : nanoseconds
    map_T_lidar : the pose
    velocity : (3,) m/s of the lidar, map frame
    covariance : (6, 6) of the pose, ``[rotation, translation]``, right perturbation
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
    restarts : how often the window was begun anew by itself: at the scan's pose, because it
        contradicts the prediction (more than 30 standard deviations); or at the predicted one,
        because the graph could not be solved. Biases and gravity are kept.

    Raises
    ------
    InputError
        If a shape or a value is wrong.
    """

    state: InertialState
    restarts: int
    _pending: tuple[InertialState, gtsam.NonlinearFactor] | None
    _asked: tuple[int, ImuSamples] | None
    """Stamp and samples of the last prediction."""

    def __init__(
        self,
        config: ImuConfig,
        map_gravity: FloatArray,
        stamp: int,
        map_T_lidar: gtsam.Pose3,
        velocity: FloatArray | None = None,
        gyro_bias: FloatArray | None = None,
        acceleration_bias: FloatArray | None = None,
        *,
        pose_sigma: tuple[float, float] = _POSE_SIGMA,
        velocity_sigma: float = _VELOCITY_SIGMA,
        gyro_bias_sigma: float = 0.01,
        acceleration_bias_sigma: float = 0.1,
        gravity_sigma: float = 0.01,
    ) -> None:
        self.config = config
        gravity = _array("map_gravity", map_gravity)
        size = float(np.linalg.norm(gravity))
        if size < 1.0:
            raise InputError(f"map_gravity: expected about 9.81 m/s^2, got {size:.3g}")
        sigmas = [acceleration_bias_sigma, gyro_bias_sigma]
        _positive(*pose_sigma, velocity_sigma, *sigmas, gravity_sigma)
        self._lidar_T_imu = gtsam.Pose3(gtsam.Rot3(), np.asarray(config.lidar_t_imu, np.float64))
        self._to_lidar: FloatArray = self._lidar_T_imu.AdjointMap()
        covariance = np.zeros((STATE, STATE))
        covariance[BIASES, BIASES] = np.diag(np.repeat(np.square(sigmas), 3))
        along = np.outer(gravity, gravity) / size**2
        across = np.eye(3) - along
        covariance[GRAVITY, GRAVITY] = (
            _MAGNITUDE_SIGMA**2 * along + (size * gravity_sigma) ** 2 * across
        )
        self.restarts = 0
        velocity = _array("velocity", velocity)
        state = InertialState(
            stamp,
            map_T_lidar,
            velocity,
            _array("acceleration_bias", acceleration_bias),
            _array("gyro_bias", gyro_bias),
            gravity,
            covariance,
        )
        self._begin(
            state,
            map_T_lidar,
            velocity,
            self._pose_covariance(pose_sigma),
            velocity_sigma**2 * np.eye(3),
        )

    def __getstate__(self) -> dict[str, Any]:
        # GTSAM's factors are made again by going the same way.
        gone = "_window", "_pending", "state"
        return {name: value for name, value in vars(self).items() if name not in gone}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        asked, journal, restarts = self._asked, self._journal, self.restarts
        self._start(self._base)
        for stamp, samples, scan in journal:
            self.predict(stamp, samples)
            if scan is None:
                self.skip()
            else:
                self.update(*scan)
        if asked is not None:
            self.predict(*asked)
        self.restarts = restarts

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
            If the samples do not cover the time between, are not in order or have a gap above
            ``config.max_gap``. Nothing has changed then; :meth:`restart` at a pose known otherwise.
        """
        last, n = self.state, self._window.newest
        steps, gyro, acceleration, rate = pieces_between(
            samples, last.stamp, stamp, self.config.max_gap
        )
        # GTSAM takes the attitude at the beginning of a piece for all of it. In the middle the
        # acceleration has turned by half the piece: without it, 8 mm/s^2 too much in a bend of
        # 4 m/s^2 and 0.8 rad/s.
        seen = acceleration - last.acceleration_bias
        acceleration += 0.5 * steps[:, None] * np.cross(gyro - last.gyro_bias, seen)
        measured = gtsam.PreintegratedCombinedMeasurements(
            preintegration_parameters(self.config, last.map_gravity), last.bias
        )
        for step, turning, force in zip(steps, gyro, acceleration, strict=True):
            measured.integrateMeasurement(force, turning, step)
        there = measured.predict(gtsam.NavState(last.map_T_imu, last.velocity), last.bias)
        predicted = replace(last, stamp=stamp, map_T_imu=there.pose(), velocity=there.velocity())
        factor = gtsam.CombinedImuFactorWithGravityVector(
            X(n), V(n), X(n + 1), V(n + 1), B(n), B(n + 1), G(0), measured
        )
        values = last.values(n)
        values.insert(G(0), last.map_gravity)
        values.insert(predicted.values(n + 1))
        covariance = propagate(factor.linearize(values), last.covariance)
        self._pending = replace(predicted, covariance=covariance), factor
        self._asked = stamp, samples
        # The IMU goes round the lidar as the platform turns.
        lever = np.cross(rate - last.gyro_bias, self._lidar_T_imu.translation())
        return Prediction(
            stamp,
            there.pose().compose(self._lidar_T_imu.inverse()),
            there.velocity() - there.pose().rotation().matrix() @ lever,
            self._to_lidar @ covariance[POSE, POSE] @ self._to_lidar.T,
        )

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
        """
        root, offset = square_root(
            _array("information", information, (6, 6)), _array("gradient", gradient, (6,))
        )
        predicted, imu_factor = self._take_pending((measured, information, gradient))
        if not len(root):
            self._take_in(predicted, imu_factor)
            return
        error, derivative = scan_residual(predicted.map_T_imu, self._lidar_T_imu, measured)
        surprise, rows = root @ error - offset, root @ derivative
        covariance = predicted.covariance[POSE, POSE]
        expected = rows @ covariance @ rows.T + np.eye(len(rows))
        if surprise @ np.linalg.solve(expected, surprise) > _JUMP**2:
            self.restarts += 1
            gain = np.linalg.solve(expected, rows @ covariance).T
            left = np.eye(6) - gain @ rows
            known = left @ covariance @ left.T + gain @ gain.T + _LEAST_SIGMA**2 * np.eye(6)
            # A velocity that was wrong looks like this too: it is free along the jump, and kept
            # across it, where the scan may be blind.
            seconds = (predicted.stamp - self.state.stamp) * 1e-9
            jump = measured.rotation().matrix() @ error[3:] / seconds
            free = predicted.covariance[VELOCITY, VELOCITY] + np.outer(jump, jump)
            self._begin(predicted, measured, predicted.velocity, known, free)
            return
        scan = scan_factor(X(self._window.newest + 1), self._lidar_T_imu, measured, root, offset)
        self._take_in(predicted, imu_factor, scan)

    def skip(self) -> None:
        """Take the prediction as it is, for a frame of which the scan says nothing.

        Raises
        ------
        InputError
            If nothing has been predicted.
        """
        predicted, imu_factor = self._take_pending(None)
        self._take_in(predicted, imu_factor)

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
        """
        seconds = (stamp - self.state.stamp) * 1e-9
        if seconds < 0.0:
            raise InputError(f"stamp: expected {self.state.stamp} or later, got {stamp}")
        _positive(*pose_sigma, velocity_sigma)
        walks = np.repeat([self.config.acceleration_bias_walk, self.config.gyro_bias_walk], 3)
        covariance = self.state.covariance.copy()
        covariance[BIASES, BIASES] += np.diag(np.square(walks)) * seconds
        self._begin(
            replace(self.state, stamp=stamp, covariance=covariance),
            map_T_lidar,
            _array("velocity", velocity),
            self._pose_covariance(pose_sigma),
            velocity_sigma**2 * np.eye(3),
        )

    def _pose_covariance(self, sigmas: tuple[float, float]) -> FloatArray:
        """Of the IMU, (6, 6), from standard deviations (rad, m) of the lidar."""
        from_lidar = np.linalg.inv(self._to_lidar)
        covariance: FloatArray = from_lidar * np.repeat(np.square(sigmas), 3) @ from_lidar.T
        return covariance

    def _begin(
        self,
        state: InertialState,
        map_T_lidar: gtsam.Pose3,
        velocity: FloatArray,
        pose_covariance: FloatArray,
        velocity_covariance: FloatArray,
    ) -> None:
        """A new window at another pose and velocity, with the biases and gravity of ``state``."""
        covariance = np.zeros((STATE, STATE))
        covariance[REST, REST] = state.covariance[REST, REST]
        covariance[POSE, POSE] = pose_covariance
        covariance[VELOCITY, VELOCITY] = velocity_covariance
        map_T_imu = map_T_lidar.compose(self._lidar_T_imu)
        self._start(replace(state, map_T_imu=map_T_imu, velocity=velocity, covariance=covariance))

    def _start(self, state: InertialState) -> None:
        self.state = self._base = state
        self._window = Window(state)
        self._pending = self._asked = None
        self._journal: list[tuple[int, ImuSamples, _Scan | None]] = []

    def _take_pending(self, scan: _Scan | None) -> tuple[InertialState, gtsam.NonlinearFactor]:
        if self._pending is None or self._asked is None:
            raise InputError("nothing has been predicted: call predict() once for every frame")
        self._journal.append((*self._asked, scan))
        pending, self._pending, self._asked = self._pending, None, None
        return pending

    def _take_in(self, predicted: InertialState, *factors: gtsam.NonlinearFactor) -> None:
        """Add the predicted frame; solve if there is more than the prediction itself."""
        window = self._window
        window.append(predicted, *factors)
        try:
            self.state = window.solve(predicted.stamp) if len(factors) > 1 else predicted
            if len(window) > self.config.lag:
                window.forget()
        except (RuntimeError, np.linalg.LinAlgError):
            self.restarts += 1
            self._start(predicted)


def _array(name: str, value: FloatArray | None, shape: tuple[int, ...] = (3,)) -> FloatArray:
    """Finite numbers; None is zero."""
    array = np.zeros(shape) if value is None else np.asarray(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite numbers of shape {shape}, got {value!r}")
    return array


def _positive(*sigmas: float) -> None:
    if not all(sigma > 0.0 for sigma in sigmas):
        raise InputError(
            f"sigmas: expected all above 0, got {sigmas}; a small one says that it is known"
        )
