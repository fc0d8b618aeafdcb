"""The window of frames behind pre-integration; equations are those of docs/maths/inertial.md.

GTSAM's own fixed-lag smoothers, as accurate, do not give the joint covariance of the newest frame,
which the next prediction needs; the incremental one keeps a slot for every factor it ever had.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, V, X

from loam_gtsam.config import ImuConfig
from loam_gtsam.geometry import cross, interpolated
from loam_gtsam.types import FloatArray, ImuSamples, InputError, SweepError

STATE = 18
POSE, VELOCITY, BIASES, GRAVITY = slice(0, 6), slice(6, 9), slice(9, 15), slice(15, 18)
REST = slice(BIASES.start, GRAVITY.stop)
"""Parts of a state; REST is what does not move."""

_INTEGRATION_NOISE = 1e-4
"""m/sqrt(s): what two samples 5 ms apart miss of a vehicle's jerk; negligible, but not zero."""
_RANK = 1e-9
"""Eigenvalues below this, of an information scaled to 1, are rounding."""
_MOST = 1e18
"""1 nm: larger ones are no measurement, and leave no digits for the rest of the graph."""
_BLOCK = 1e-6
"""rad/m; largest ratio of scale of rotation and translation: a block may be zero up to rounding."""
_ITERATIONS = 3
_SMALL_STEP = 1e-2
"""Gauss-Newton stops below this (rad, m, m/s, m/s^2): what is left is about its square, and the
next frame takes that away."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialState:
    """The state of a frame.

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
        """Both, as GTSAM has them."""
        return gtsam.imuBias.ConstantBias(self.acceleration_bias, self.gyro_bias)

    def values(self, n: int) -> gtsam.Values:
        """Pose, velocity and biases under the keys of frame ``n``."""
        values = gtsam.Values()
        values.insert(X(n), self.map_T_imu)
        values.insert(V(n), self.velocity)
        values.insert(B(n), self.bias)
        return values


class WindowFrame:
    """The prediction of a frame, and the factors between the frame before and this one.

    Attributes
    ----------
    number, graph : of the frame, and its factors
    predicted : state by the samples, with its covariance
    transition : (18, 18) derivative of that state by the one before
    rate : (3,) rad/s of the gyro at the end
    scan : arguments of :func:`scan_factor` behind the key; empty if the scan says nothing
    """

    def __init__(self, *made_of: *tuple[ImuConfig, int, InertialState, int, ImuSamples]) -> None:
        self.__setstate__((made_of, ()))

    # GTSAM's pre-integrated factors cannot be kept; what they are made of can.
    def __getstate__(self) -> tuple[Any, Any]:
        return self._made_of, self.scan

    def __setstate__(self, state: tuple[Any, Any]) -> None:
        config, self.number, before, stamp, samples = state[0]
        samples = _covering(samples, before.stamp, stamp, config.max_gap)
        self._made_of = config, self.number, before, stamp, samples
        self.predicted, self.transition, factor, self.rate = _predict(*self._made_of)
        self.graph = gtsam.NonlinearFactorGraph()
        self.graph.add(factor)
        self.scan: tuple[Any, ...] = ()
        if state[1]:
            self.add_scan(*state[1])

    def add_scan(self, *scan: *tuple[gtsam.Pose3, gtsam.Pose3, FloatArray, FloatArray]) -> None:
        """Add what the scan says."""
        self.scan = scan
        self.graph.add(scan_factor(X(self.number), *scan))


def _covering(samples: ImuSamples, start: int, stop: int, max_gap: float) -> ImuSamples:
    """Gyro and acceleration from ``start`` to ``stop`` and one sample on either side, as views."""
    stamps = samples.stamps
    if stop <= start:
        raise SweepError(f"stamp: expected later than {start}, got {stop}")
    if not len(stamps) or stamps[0] > start or stamps[-1] < stop:
        have = f"{stamps[0]} to {stamps[-1]}" if len(stamps) else "none"
        raise SweepError(f"IMU samples: expected to cover {start} to {stop}, got {have}")
    rows = slice(stamps.searchsorted(start, "right") - 1, stamps.searchsorted(stop) + 1)
    gaps = np.diff(stamps[rows])
    if gaps.min() <= 0 or gaps.max() > round(max_gap * 1e9):
        raise SweepError(
            f"IMU samples: expected steps above 0 and up to {max_gap:g} s, "
            f"got {gaps.min() * 1e-9:g} to {gaps.max() * 1e-9:g} s"
        )
    return ImuSamples(stamps[rows], None, samples.gyro[rows], samples.acceleration[rows])


def _predict(
    config: ImuConfig, n: int, last: InertialState, stamp: int, samples: ImuSamples
) -> tuple[InertialState, FloatArray, gtsam.NonlinearFactor, FloatArray]:
    """State of frame ``n`` from the one before, transition, factor between the two, last rate."""
    # Offsets in integers first: floats do not hold nanoseconds since 1970.
    times: FloatArray = (samples.stamps - last.stamp).astype(np.float64) * 1e-9
    knots = np.concatenate([[0.0], times[1:-1], [(stamp - last.stamp) * 1e-9]])
    joined = interpolated(knots, times, np.hstack([samples.gyro, samples.acceleration]))
    steps, means = np.diff(knots), 0.5 * (joined[1:] + joined[:-1])
    gyro, acceleration = means[:, :3], means[:, 3:]
    # GTSAM takes the attitude at the beginning of a step for all of it. In the middle the
    # acceleration has turned by half the step: without it, 8 mm/s^2 too much in a bend of
    # 4 m/s^2 and 0.8 rad/s.
    seen = acceleration - last.acceleration_bias
    acceleration += 0.5 * steps[:, None] * cross((gyro - last.gyro_bias).T, seen.T).T
    parameters, unit = gtsam.PreintegrationCombinedParams(last.map_gravity), np.eye(3)
    parameters.setGyroscopeCovariance(config.gyro_noise**2 * unit)
    parameters.setAccelerometerCovariance(config.acceleration_noise**2 * unit)
    parameters.setBiasOmegaCovariance(config.gyro_bias_walk**2 * unit)
    parameters.setBiasAccCovariance(config.acceleration_bias_walk**2 * unit)
    parameters.setIntegrationCovariance(_INTEGRATION_NOISE**2 * unit)
    measured = gtsam.PreintegratedCombinedMeasurements(parameters, last.bias)
    for step, turning, force in zip(steps, gyro, acceleration, strict=True):
        measured.integrateMeasurement(force, turning, step)
    there = measured.predict(gtsam.NavState(last.map_T_imu, last.velocity), last.bias)
    predicted = replace(last, stamp=stamp, map_T_imu=there.pose(), velocity=there.velocity())
    factor = gtsam.CombinedImuFactorWithGravityVector(
        X(n - 1), V(n - 1), X(n), V(n), B(n - 1), B(n), G(0), measured
    )
    values = last.values(n - 1)
    values.insert(G(0), last.map_gravity)
    values.insert(predicted.values(n))
    moved, transition = _propagated(factor.linearize(values), last.covariance)
    return replace(predicted, covariance=moved), transition, factor, joined[-1, :3]


def _propagated(
    factor: gtsam.GaussianFactor, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariance (18, 18) of the next state from that of the last one, equation (2), and the
    derivative of the next state by the last one.
    """
    jacobian = factor.jacobian()[0]
    # Columns as the factor has its keys: X, V, next X, next V, B, next B, G.
    x, v, next_x, next_v, b, next_b, g = np.split(jacobian, [6, 9, 15, 18, 24, 30], axis=1)
    try:
        root = np.linalg.inv(np.hstack([next_x, next_v, next_b]))
    except np.linalg.LinAlgError as error:
        raise SweepError(f"IMU samples: their motion has no covariance: {error}") from error
    transition = np.zeros((STATE, STATE))
    with np.errstate(over="ignore", invalid="ignore"):  # of absurd samples
        transition[:15] = -root @ np.hstack([x, v, b, g])
        transition[GRAVITY, GRAVITY] = np.eye(3)
        moved: FloatArray = transition @ covariance @ transition.T
        moved[:15, :15] += root @ root.T
    if not np.isfinite(moved).all():
        raise SweepError("IMU samples: the motion they make has no finite covariance")
    return moved, transition


def scan_residual(
    map_T_imu: gtsam.Pose3, lidar_T_imu: gtsam.Pose3, measured: gtsam.Pose3
) -> tuple[FloatArray, FloatArray]:
    """Pose error of the lidar against the scan's, equation (3), and its Jacobian by the IMU's pose.

    The error (6,) is ``Log(R_m' R)`` in rad and ``R_m' (t - t_m)`` in m, along the *measured* axes:
    the blind direction of a corridor is then fixed in the map, and does not turn with the estimate.
    """
    # Relative pose: its translation is already along the measured axes.
    apart = measured.between(map_T_imu.compose(lidar_T_imu.inverse()))
    turned = apart.rotation()
    error = np.concatenate([gtsam.Rot3.Logmap(turned), apart.translation()])
    derivative = np.zeros((6, 6))
    derivative[:3, :3] = gtsam.Rot3.LogmapDerivative(error[:3])
    derivative[3:, 3:] = turned.matrix()
    return error, derivative @ lidar_T_imu.AdjointMap()


def scan_factor(
    key: int, lidar_T_imu: gtsam.Pose3, measured: gtsam.Pose3, root: FloatArray, step: FloatArray
) -> gtsam.CustomFactor:
    """``root (e - step)`` on the IMU's pose ``key``, with ``e`` of :func:`scan_residual`.

    ``root`` is (M, 6), and ``step`` (6,) leads from ``measured`` to the optimum of the scan.
    """

    def call(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        error, derivative = scan_residual(values.atPose3(key), lidar_T_imu, measured)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(root @ derivative)
        whitened: FloatArray = root @ (error - step)
        return whitened

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(root)), [key], call)


def information_root(information: FloatArray) -> FloatArray:
    """S (M, 6) with ``S' S = information`` (6, 6), of rank M; InputError if there is none."""
    largest = np.abs(information).max()
    if largest > _MOST:
        raise InputError(
            f"information: expected entries up to {_MOST:g} (1 / rad^2, 1 / m^2), got {largest:g}"
        )
    # Rotation and translation differ in unit: each is scaled to 1 before ranks are told.
    sizes = np.sqrt(np.maximum(np.diag(information).reshape(2, 3).max(axis=1), 0))
    if not sizes.any():
        sizes[:] = 1.0
    scale = np.repeat(np.maximum(sizes, _BLOCK * sizes[::-1]), 3)
    eigenvalues, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if eigenvalues[0] < -_RANK:
        raise InputError(
            f"information: expected no negative eigenvalue, got {eigenvalues[0]:.3g} "
            "(with the largest rotation and translation entries scaled to 1)"
        )
    seen = eigenvalues > _RANK
    root: FloatArray = np.sqrt(eigenvalues[seen])[:, None] * vectors[:, seen].T * scale
    return root


def _known(state: InertialState) -> gtsam.HessianFactor:
    """What the covariance of a state says of it, under the keys of frame 0."""
    information = np.linalg.inv(state.covariance)
    parts = (X(0), POSE), (V(0), VELOCITY), (B(0), BIASES), (G(0), GRAVITY)
    graph = gtsam.GaussianFactorGraph()
    for key, rows in parts:
        block = information[rows, rows]
        graph.add(gtsam.HessianFactor(key, block, np.zeros(len(block)), 0.0))
    for (key, rows), (other, columns) in combinations(parts, 2):
        across = information[rows, columns]
        first, second = (np.zeros((size, size)) for size in across.shape)
        sides = first, across, first[0], second, second[0]
        graph.add(gtsam.HessianFactor(key, other, *sides, 0.0))
    return gtsam.HessianFactor(graph)


class Window:
    """Poses, velocities and biases of the last frames, under the keys X, V, B; gravity is G(0).

    Parameters
    ----------
    state : the only frame at first, with its covariance as prior
    lag : largest number of frames
    """

    def __init__(self, state: InertialState, lag: int) -> None:
        self.newest, self._lag = 0, lag
        self._frames: deque[WindowFrame] = deque()
        self._values = state.values(0)
        self._values.insert(G(0), state.map_gravity)
        self._prior = gtsam.NonlinearFactorGraph()
        self._prior.add(gtsam.LinearContainerFactor(_known(state), self._values))

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {k: vars(self)[k].serialize() for k in ("_prior", "_values")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _prior=gtsam.NonlinearFactorGraph(), _values=gtsam.Values())
        self._prior.deserialize(state["_prior"])
        self._values.deserialize(state["_values"])

    def append(self, frame: WindowFrame) -> InertialState:
        """Add a frame behind the newest one, solve, and return its state.

        A RuntimeError or numpy's LinAlgError says that there is no finite solution; the window is
        of no use then.
        """
        self.newest = frame.number
        self._frames.append(frame)
        self._values.insert(frame.predicted.values(frame.number))
        state = self._solved(frame.predicted.stamp) if frame.scan else frame.predicted
        if len(self._frames) > self._lag:
            self._forget()
        return state

    def _solved(self, stamp: int) -> InertialState:
        """Gauss-Newton over the window, and the marginal of the newest frame."""
        graph = gtsam.NonlinearFactorGraph(self._prior)
        for frame in self._frames:
            graph.push_back(frame.graph)
        n, values = self.newest, self._values
        older = [key(k) for k in range(n - len(self._frames), n) for key in (X, V, B)]
        newest = gtsam.Ordering([X(n), V(n), B(n), G(0)])
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
        bias = values.atConstantBias(B(n))
        biases = bias.accelerometer(), bias.gyroscope()
        motion = values.atPose3(X(n)), values.atVector(V(n))
        return InertialState(stamp, *motion, *biases, values.atVector(G(0)), covariance)

    def _forget(self) -> None:
        """Marginalise the oldest frame: what it said about the next one stays, linearised."""
        n = self.newest - len(self._frames)
        oldest = [X(n), V(n), B(n)]
        self._prior.push_back(self._frames.popleft().graph)
        linear = self._prior.linearize(self._values)
        _, rest = linear.eliminatePartialSequential(gtsam.Ordering(oldest))
        self._prior = gtsam.LinearContainerFactor.ConvertLinearGraph(rest, self._values)
        for key in oldest:
            self._values.erase(key)
