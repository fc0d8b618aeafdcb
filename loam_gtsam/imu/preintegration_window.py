"""The window of frames behind pre-integration: a graph that forgets its oldest frame.

GTSAM's own fixed-lag smoothers were tried and are as accurate. They do not give the joint
covariance of the newest frame, which the next prediction needs, and the incremental one keeps a
slot for every factor it ever had.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, V, X

from loam_gtsam.config import ImuConfig
from loam_gtsam.imu.preintegration_factors import (
    POSE,
    REST,
    VELOCITY,
    integration_steps,
    preintegration_parameters,
    propagated_covariance,
    scan_factor,
)
from loam_gtsam.types import FloatArray, ImuSamples, SweepError

_ITERATIONS = 3
_SMALL_STEP = 1e-2
"""Gauss-Newton stops below this (rad, m, m/s, m/s^2): what is left is about its square, and the
next frame takes that away."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialState:
    """The newest frame of the window.

    Attributes
    ----------
    stamp : nanoseconds
    map_T_imu : pose of the IMU, which has the axes of the lidar
    velocity : (3,) m/s of the IMU, map frame
    acceleration_bias : (3,) m/s^2
    gyro_bias : (3,) rad/s
    map_gravity : (3,) m/s^2, pointing down
    covariance : (18, 18) in the order of these: pose (6), velocity, the two biases, gravity
    """

    stamp: int
    map_T_imu: gtsam.Pose3
    velocity: FloatArray
    acceleration_bias: FloatArray
    gyro_bias: FloatArray
    map_gravity: FloatArray
    covariance: FloatArray

    @property
    def bias(self) -> gtsam.imuBias.ConstantBias:
        """Both biases as GTSAM has them."""
        return gtsam.imuBias.ConstantBias(self.acceleration_bias, self.gyro_bias)

    def values(self, n: int) -> gtsam.Values:
        """Pose, velocity and biases under the keys of frame ``n``."""
        values = gtsam.Values()
        values.insert(X(n), self.map_T_imu)
        values.insert(V(n), self.velocity)
        values.insert(B(n), self.bias)
        return values


@dataclass(frozen=True, slots=True, eq=False)
class WindowFrame:
    """A frame of the window, by what its factors are made of.

    Attributes
    ----------
    before : state of the frame before, from which this one is predicted
    stamp : nanoseconds
    samples : IMU samples between the two frames
    scan : pose, root and offset for :func:`scan_factor`; None if the scan says nothing
    """

    before: InertialState
    stamp: int
    samples: ImuSamples
    scan: tuple[gtsam.Pose3, FloatArray, FloatArray] | None = None


def predict_state(
    config: ImuConfig, last: InertialState, number: int, stamp: int, samples: ImuSamples
) -> tuple[InertialState, gtsam.NonlinearFactor, FloatArray]:
    """State of frame ``number + 1``, at ``stamp``, from the last one and the samples between them.

    Returns
    -------
    state : with its covariance
    factor : pre-integrated, between the two frames
    rate : (3,) rad/s of the gyro at ``stamp``

    Raises
    ------
    InputError, SweepError
        As :func:`integration_steps`; the latter also if the samples are absurd.
    """
    steps, gyro, acceleration, rate = integration_steps(samples, last.stamp, stamp, config.max_gap)
    # GTSAM takes the attitude at the beginning of a piece for all of it. In the middle the
    # acceleration has turned by half the piece: without it, 8 mm/s^2 too much in a bend of
    # 4 m/s^2 and 0.8 rad/s.
    seen = acceleration - last.acceleration_bias
    acceleration += 0.5 * steps[:, None] * np.cross(gyro - last.gyro_bias, seen)
    measured = gtsam.PreintegratedCombinedMeasurements(
        preintegration_parameters(config, last.map_gravity), last.bias
    )
    for step, turning, force in zip(steps, gyro, acceleration, strict=True):
        measured.integrateMeasurement(force, turning, step)
    there = measured.predict(gtsam.NavState(last.map_T_imu, last.velocity), last.bias)
    predicted = replace(last, stamp=stamp, map_T_imu=there.pose(), velocity=there.velocity())
    n = number
    factor = gtsam.CombinedImuFactorWithGravityVector(
        X(n), V(n), X(n + 1), V(n + 1), B(n), B(n + 1), G(0), measured
    )
    values = last.values(n)
    values.insert(G(0), last.map_gravity)
    values.insert(predicted.values(n + 1))
    covariance = propagated_covariance(factor.linearize(values), last.covariance)
    if not np.isfinite(covariance).all():
        raise SweepError("IMU samples: the motion they make has no finite covariance")
    return replace(predicted, covariance=covariance), factor, rate


class Window:
    """Poses, velocities and biases of the last frames, under the keys X, V, B; gravity is G(0).

    Parameters
    ----------
    config : section ``imu``
    lidar_T_imu : pose of the IMU in the lidar frame
    state : the only frame at first, with its covariance as prior. Pose, velocity and the rest are
        taken as independent of each other.

    Attributes
    ----------
    newest : number of the newest frame
    """

    def __init__(self, config: ImuConfig, lidar_T_imu: gtsam.Pose3, state: InertialState) -> None:
        self._config, self._lidar_T_imu = config, lidar_T_imu
        self.newest = 0
        self._frames: deque[WindowFrame] = deque()
        self._links: deque[gtsam.NonlinearFactorGraph] = deque()
        self._values = state.values(0)
        self._values.insert(G(0), state.map_gravity)
        normal = gtsam.noiseModel.Gaussian.Covariance
        pose, velocity = state.covariance[POSE, POSE], state.covariance[VELOCITY, VELOCITY]
        # Biases and gravity stay correlated: the scans tell their sum much better than either.
        rest = np.linalg.inv(state.covariance[REST, REST])
        joint = gtsam.HessianFactor(
            B(0), G(0), rest[:6, :6], rest[:6, 6:], np.zeros(6), rest[6:, 6:], np.zeros(3), 0.0
        )
        self._prior = gtsam.NonlinearFactorGraph()
        self._prior.add(gtsam.PriorFactorPose3(X(0), state.map_T_imu, normal(pose)))
        self._prior.add(gtsam.PriorFactorVector(V(0), state.velocity, normal(velocity)))
        self._prior.add(gtsam.LinearContainerFactor(joint, self._values))

    def __getstate__(self) -> dict[str, Any]:
        # Custom factors cannot be written: the links are made again from their frames.
        prior, values = self._prior.serialize(), self._values.serialize()
        return vars(self) | {"_links": deque(), "_prior": prior, "_values": values}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._prior, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._prior.deserialize(state["_prior"])
        self._values.deserialize(state["_values"])
        for n, frame in enumerate(self._frames, self.newest - len(self._frames)):
            _, imu_factor, _ = predict_state(
                self._config, frame.before, n, frame.stamp, frame.samples
            )
            self._link(n + 1, frame, imu_factor)

    def append(
        self, frame: WindowFrame, predicted: InertialState, imu_factor: gtsam.NonlinearFactor
    ) -> InertialState:
        """Add a frame with what :func:`predict_state` said of it, solve, and return its state.

        Raises
        ------
        RuntimeError, numpy.linalg.LinAlgError
            If there is no finite solution; the window is of no use then.
        """
        self.newest += 1
        self._frames.append(frame)
        self._link(self.newest, frame, imu_factor)
        self._values.insert(predicted.values(self.newest))
        state = predicted if frame.scan is None else self._solved(frame.stamp)
        if len(self._frames) > self._config.lag:
            self._forget()
        return state

    def _link(self, number: int, frame: WindowFrame, imu_factor: gtsam.NonlinearFactor) -> None:
        graph = gtsam.NonlinearFactorGraph()
        graph.add(imu_factor)
        if frame.scan is not None:
            measured, root, offset = frame.scan
            graph.add(scan_factor(X(number), self._lidar_T_imu, measured, root, offset))
        self._links.append(graph)

    def _solved(self, stamp: int) -> InertialState:
        """Gauss-Newton over the window, and the marginal of the newest frame."""
        graph = gtsam.NonlinearFactorGraph(self._prior)
        for link in self._links:
            graph.push_back(link)
        older = [key(n) for n in range(self._oldest, self.newest) for key in (X, V, B)]
        newest = gtsam.Ordering([key(self.newest) for key in (X, V, B)] + [G(0)])
        values = self._values
        for _ in range(_ITERATIONS):
            past, rest = graph.linearize(values).eliminatePartialSequential(gtsam.Ordering(older))
            last = rest.eliminateSequential(newest)
            step = past.optimize(last.optimize())
            values = values.retract(step)
            if np.abs(step.vector()).max() < _SMALL_STEP:
                break
        # Elimination leaves R with R' R the information of the newest frame.
        root = np.linalg.inv(last.matrix()[0])
        covariance: FloatArray = root @ root.T
        if not np.isfinite(step.vector()).all() or not np.isfinite(covariance).all():
            raise RuntimeError("the window has no finite solution")
        self._values = values
        n = self.newest
        bias = values.atConstantBias(B(n))
        return InertialState(
            stamp,
            values.atPose3(X(n)),
            values.atVector(V(n)),
            bias.accelerometer(),
            bias.gyroscope(),
            values.atVector(G(0)),
            covariance,
        )

    @property
    def _oldest(self) -> int:
        return self.newest - len(self._frames)

    def _forget(self) -> None:
        """Marginalise the oldest frame: what it said about the next one stays, linearised."""
        graph = self._prior
        graph.push_back(self._links.popleft())
        oldest = [key(self._oldest) for key in (X, V, B)]
        _, rest = graph.linearize(self._values).eliminatePartialSequential(gtsam.Ordering(oldest))
        self._prior = gtsam.LinearContainerFactor.ConvertLinearGraph(rest, self._values)
        for key in oldest:
            self._values.erase(key)
        self._frames.popleft()
