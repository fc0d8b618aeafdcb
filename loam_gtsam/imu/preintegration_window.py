"""The window of frames behind pre-integration: a graph that forgets its oldest frame.

GTSAM's own fixed-lag smoothers were tried and are as accurate. They do not give the joint
covariance of the newest frame, which the next prediction needs, and the incremental one keeps a
slot for every factor it ever had.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, V, X

from loam_gtsam.imu.preintegration_factors import POSE, REST, VELOCITY
from loam_gtsam.types import FloatArray

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


class Window:
    """Poses, velocities and biases of the last frames, under the keys X, V, B; gravity is G(0).

    Parameters
    ----------
    state : the only frame at first, with its covariance as prior. Pose, velocity and the rest are
        taken as independent of each other.

    Attributes
    ----------
    newest : number of the newest frame
    """

    def __init__(self, state: InertialState) -> None:
        self.newest = self._oldest = 0
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

    def __len__(self) -> int:
        """Frames after the oldest."""
        return len(self._links)

    def append(self, state: InertialState, *factors: gtsam.NonlinearFactor) -> None:
        """Add a frame, and factors on it and on the one before."""
        link = gtsam.NonlinearFactorGraph()
        for factor in factors:
            link.add(factor)
        self._links.append(link)
        self.newest += 1
        self._values.insert(state.values(self.newest))

    def solve(self, stamp: int) -> InertialState:
        """Gauss-Newton over the window, and the marginal of the newest frame.

        Raises
        ------
        RuntimeError
            If there is no finite solution; GTSAM's own exceptions (of an indeterminate system) are
            children of it.
        """
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

    def forget(self) -> None:
        """Marginalise the oldest frame: what it said about the next one stays, linearised."""
        graph = self._prior
        graph.push_back(self._links.popleft())
        oldest = [key(self._oldest) for key in (X, V, B)]
        _, rest = graph.linearize(self._values).eliminatePartialSequential(gtsam.Ordering(oldest))
        self._prior = gtsam.LinearContainerFactor.ConvertLinearGraph(rest, self._values)
        for key in oldest:
            self._values.erase(key)
        self._oldest += 1
