"""What an IMU makes of the exact motion: its kinds, and their errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.decode.extrinsics import rigid_transform
from loam_gtsam.datasets.sim.motion import Motion
from loam_gtsam.types import FloatArray, ImuSamples, IntArray

IMUS = "white", "mems", "six_axis"
Axes = tuple[float, float, float]

_DRIFT_PERIODS = 20.0, 30.0, 45.0  # seconds
_DRIFT = np.deg2rad(0.4)  # rad per axis
_GYRO_BIAS = float(np.deg2rad(0.3))  # rad/s
_ACCELERATION_BIAS = 0.05  # m/s^2
_LEVER = 0.1, -0.05, -0.15  # metres


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """Place and errors of an IMU; its axes are the lidar's.

    Attributes
    ----------
    lever : where it sits in the lidar frame, metres
    attitude_noise : rad per axis, white
    gyro_noise, gyro_bias : rad/s per axis, white and constant
    acceleration_noise, acceleration_bias : m/s^2 per axis, white and constant
    attitude_drift : rad per axis, the root mean square of what changes over half a minute
    six_axis : whether it measures no attitude, but rate and acceleration only
    """

    lever: Axes = (0.0, 0.0, 0.0)
    attitude_noise: float = 0.003
    gyro_noise: float = 0.003
    gyro_bias: Axes = (0.002, -0.001, 0.0015)
    acceleration_noise: float = 0.03
    acceleration_bias: Axes = (0.03, -0.02, 0.04)
    attitude_drift: float = 0.0
    six_axis: bool = False

    @classmethod
    def of(cls, kind: str, seed: int, own: Mapping[str, Any]) -> ImuErrors:
        """Those of a kind of IMU, but for those of one's ``own`` that are not None.

        The biases have a size, 0.3 deg/s and 0.05 m/s^2, and a random direction, but for ``white``.
        """
        errors = cls()
        if kind != "white":
            rng = np.random.default_rng([seed, 0, 201])
            turns = rng.standard_normal((2, 3))
            gyro, pull = turns / np.linalg.norm(turns, axis=1, keepdims=True)
            errors = cls(
                lever=_LEVER,
                attitude_noise=0.0005,
                gyro_bias=tuple((_GYRO_BIAS * gyro).tolist()),
                acceleration_bias=tuple((_ACCELERATION_BIAS * pull).tolist()),
                attitude_drift=_DRIFT,
                six_axis=kind == "six_axis",
            )
        return replace(errors, **{name: own[name] for name in own if own[name] is not None})

    def samples(self, motion: Motion, stamps: IntArray, times: FloatArray, seed: int) -> ImuSamples:
        """What it measures at ``stamps`` (N,), at ``times`` (N,) of the motion in seconds."""
        if any(self.lever):
            motion = motion.seen_from(rigid_transform(Rotation.identity(), self.lever))
        poses, gyro, acceleration = motion.inertial(times)
        # One number more than a sweep's seed, so that no sweep shares this stream.
        rng = np.random.default_rng([seed, 0, 200])
        shape = gyro.shape
        wrong = self.attitude_noise * rng.standard_normal(shape) + self._drift(times, seed)
        exact = Rotation.from_matrix(poses[:, :3, :3])
        measured = (exact * Rotation.from_rotvec(wrong)).as_quat()
        orientation = None if self.six_axis else measured
        gyro = gyro + self.gyro_bias + self.gyro_noise * rng.standard_normal(shape)
        noise = self.acceleration_noise * rng.standard_normal(shape)
        acceleration = acceleration + self.acceleration_bias + noise
        return ImuSamples(stamps, orientation, gyro, acceleration)

    def _drift(self, times: FloatArray, seed: int) -> FloatArray:
        """(N, 3) rotation vectors in rad: slow sines, of other phases about every axis."""
        phases = np.random.default_rng([seed, 0, 202]).uniform(0.0, 2.0 * np.pi, (3, 3))
        turns = 2.0 * np.pi * times[:, None, None] / np.array(_DRIFT_PERIODS)[:, None]
        size = self.attitude_drift * np.sqrt(2.0 / len(_DRIFT_PERIODS))
        return np.asarray(size * np.sin(turns + phases).sum(axis=1))
