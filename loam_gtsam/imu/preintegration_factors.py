"""Parts of the pre-integrated motion of :mod:`loam_gtsam.imu.preintegration`.

The state of a frame has 18 numbers: pose (6, GTSAM's order), velocity, bias of the accelerometer,
bias of the gyro, gravity. Pose and velocity are those of the IMU, in the map; see
docs/maths/inertial.md, to which the equation numbers refer.
"""

from __future__ import annotations

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.types import FloatArray, ImuSamples, InputError, SweepError, check_array

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
"""Rotation and translation of a scan are not told apart in scale further than this (rad/m): a
whole block may be zero up to rounding."""


def samples_between(samples: ImuSamples, start: int, stop: int) -> ImuSamples:
    """Gyro and acceleration from ``start`` to ``stop`` and one sample on either side, copied."""
    stamps = samples.stamps
    first, last = np.searchsorted(stamps, start, "right"), np.searchsorted(stamps, stop)
    rows = slice(int(first) - 1, int(last) + 1)
    gyro, acceleration = samples.gyro[rows].copy(), samples.acceleration[rows].copy()
    return ImuSamples(stamps[rows].copy(), None, gyro, acceleration)


def integration_steps(
    samples: ImuSamples, start: int, stop: int, max_gap: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Integration steps of constant rate between the samples, from ``start`` to ``stop`` exactly.

    Samples are joined by straight lines; a step has the mean of its two ends.

    Returns
    -------
    seconds : (M,) lengths of the steps
    gyro, acceleration : (M, 3) of the steps
    rate : (3,) gyro at ``stop``

    Raises
    ------
    InputError
        If an array has the wrong shape.
    SweepError
        If the samples do not cover the time, are not in order or finite, or have a gap above
        ``max_gap`` seconds.
    """
    stamps = samples.stamps
    for name in ("gyro", "acceleration"):
        check_array(getattr(samples, name), name, (len(stamps), 3), "numbers")
    if stop <= start:
        raise SweepError(f"stamp: expected later than {start}, got {stop}")
    if not len(stamps) or stamps[0] > start or stamps[-1] < stop:
        have = f"{stamps[0]} to {stamps[-1]}" if len(stamps) else "none"
        raise SweepError(f"IMU samples: expected to cover {start} to {stop}, got {have}")
    used = samples_between(samples, start, stop)
    gaps = np.diff(used.stamps)
    if gaps.min() <= 0 or gaps.max() > round(max_gap * 1e9):
        raise SweepError(
            f"IMU samples: expected steps above 0 and up to {max_gap:g} s, "
            f"got {gaps.min() * 1e-9:g} to {gaps.max() * 1e-9:g} s"
        )
    values = np.hstack([used.gyro, used.acceleration])
    if not np.isfinite(values).all():
        raise SweepError("IMU samples: expected finite values")
    # Offsets in integers first: floats do not hold nanoseconds since 1970.
    times = (used.stamps - start) * 1e-9
    knots = np.concatenate([[0.0], times[1:-1], [(stop - start) * 1e-9]])
    joined = np.stack([np.interp(knots, times, column) for column in values.T], axis=1)
    means = 0.5 * (joined[1:] + joined[:-1])
    return np.diff(knots), means[:, :3], means[:, 3:], joined[-1, :3]


def preintegration_parameters(
    config: ImuConfig, gravity: FloatArray
) -> gtsam.PreintegrationCombinedParams:
    """GTSAM's parameters; ``gravity`` (3,) points down."""
    parameters = gtsam.PreintegrationCombinedParams(gravity)
    for set_covariance, sigma in (
        (parameters.setGyroscopeCovariance, config.gyro_noise),
        (parameters.setAccelerometerCovariance, config.acceleration_noise),
        (parameters.setBiasOmegaCovariance, config.gyro_bias_walk),
        (parameters.setBiasAccCovariance, config.acceleration_bias_walk),
        (parameters.setIntegrationCovariance, _INTEGRATION_NOISE),
    ):
        set_covariance(sigma**2 * np.eye(3))
    return parameters


def propagated_covariance(factor: gtsam.GaussianFactor, covariance: FloatArray) -> FloatArray:
    """Covariance (18, 18) of the next state from that of the last one, equation (2).

    The whitened factor says ``A e + C e_next = w`` with unit normal w, where ``e`` holds the last
    state and gravity. C is square and regular, so that ``e_next = C^-1 (w - A e)``.
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
    return moved


def scan_residual(
    map_T_imu: gtsam.Pose3, lidar_T_imu: gtsam.Pose3, measured: gtsam.Pose3
) -> tuple[FloatArray, FloatArray]:
    """Pose error of the lidar against the scan's, equation (3), and its Jacobian by the IMU's pose.

    Rotation is ``Log(R_m' R)`` and translation ``R_m' (t - t_m)``, along the *measured* axes. The
    blind direction of a corridor is then fixed in the map. In the logarithm of the whole pose
    it would turn with every estimate of the rotation, and a milliradian of noise in that would let
    the walls tell a little of the way along them.

    Returns
    -------
    error : (6,) rad and m
    derivative : (6, 6)
    """
    # Relative pose: its translation is already along the measured axes.
    apart = measured.between(map_T_imu.compose(lidar_T_imu.inverse()))
    turned = apart.rotation()
    error = np.empty(6)
    error[:3] = gtsam.Rot3.Logmap(turned)
    error[3:] = apart.translation()
    derivative = np.zeros((6, 6))
    derivative[:3, :3] = gtsam.Rot3.LogmapDerivative(error[:3])
    derivative[3:, 3:] = turned.matrix()
    return error, derivative @ lidar_T_imu.AdjointMap()


def scan_factor(
    key: int,
    lidar_T_imu: gtsam.Pose3,
    measured: gtsam.Pose3,
    root: FloatArray,
    offset: FloatArray,
) -> gtsam.CustomFactor:
    """``root e - offset`` on the IMU's pose ``key``, with ``e`` of :func:`scan_residual`.

    Parameters
    ----------
    root, offset : (M, 6) and (M,), see :func:`information_root`
    """

    def call(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        error, derivative = scan_residual(values.atPose3(key), lidar_T_imu, measured)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(root @ derivative)
        whitened: FloatArray = root @ error - offset
        return whitened

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(root)), [key], call)


def information_root(
    information: FloatArray, gradient: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """S (M, 6) and c (M,) with ``|S e - c|^2 = e' information e - 2 gradient' e + constant``.

    M is the rank; a gradient along directions without information is left out.

    Raises
    ------
    InputError
        If the information is larger than any scan's, or has a negative eigenvalue beyond rounding.
    """
    if np.abs(information).max() > _MOST:
        raise InputError(
            f"information: expected entries up to {_MOST:g} (1 / rad^2, 1 / m^2), got "
            f"{np.abs(information).max():g}"
        )
    # Rotation and translation differ in unit: each is scaled to 1 before ranks are told.
    sizes = np.sqrt(np.maximum([np.diag(information)[:3].max(), np.diag(information)[3:].max()], 0))
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
    roots, axes = np.sqrt(eigenvalues[seen]), vectors[:, seen].T
    return roots[:, None] * axes * scale, axes @ (gradient / scale) / roots
