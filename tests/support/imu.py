"""IMU samples of motions that are known in closed form."""

import dataclasses

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.config import ImuConfig
from loam_gtsam.types import ImuSamples

START = 1_700_000_000_000_000_000
PERIOD = 5_000_000
G = 9.81
CONFIG = ImuConfig(max_gap=0.1, filter_seconds=20.0, still_seconds=0.5, gravity=G)


def ns(seconds):
    return START + np.round(np.asarray(seconds) * 1e9).astype(np.int64)


def motion(times):
    """Exact world_R_lidar and body rates; up to 2.2 rad/s and 3 rad/s^2 about moving axes."""
    phases = np.array([0.3, 1.1, 2.0])
    amplitude, number = np.array([[0.5], [0.4], [1.5]]), np.array([[2.0], [2.5], [1.2]])
    angle = number * times + phases[:, None]
    roll, pitch, yaw = amplitude * np.sin(angle)
    d_roll, d_pitch, d_yaw = amplitude * number * np.cos(angle)
    rates = [
        d_roll - np.sin(pitch) * d_yaw,
        np.cos(roll) * d_pitch + np.sin(roll) * np.cos(pitch) * d_yaw,
        -np.sin(roll) * d_pitch + np.cos(roll) * np.cos(pitch) * d_yaw,
    ]
    # 2.5 rad more: the yaw passes +-pi.
    return Rotation.from_euler("ZYX", np.stack([yaw + 2.5, pitch, roll], 1)), np.stack(rates, 1)


def moving(seconds=4.0, *, orientation=True):
    times = np.arange(round(200 * seconds)) / 200.0
    world_R_lidar, gyro = motion(times)
    return ImuSamples(
        stamps=ns(times),
        orientation=world_R_lidar.as_quat() if orientation else None,
        gyro=gyro,
        acceleration=world_R_lidar.inv().apply([0.0, 0.0, G]),
    )


def resting(count=200, *, world_R_lidar=None, seed=0):
    """Noisy samples at rest, without orientation."""
    rng = np.random.default_rng(seed)
    up = [0.0, 0.0, G] if world_R_lidar is None else world_R_lidar.inv().apply([0.0, 0.0, G])
    return ImuSamples(
        stamps=START + PERIOD * np.arange(count),
        orientation=None,
        gyro=np.array([0.002, -0.001, 0.0015]) + 0.003 * rng.standard_normal((count, 3)),
        acceleration=up + 0.03 * rng.standard_normal((count, 3)),
    )


def part(samples, index):
    """The samples of some rows."""
    columns = (getattr(samples, item.name) for item in dataclasses.fields(samples))
    return ImuSamples(*(None if column is None else column[index] for column in columns))


def as_seen_by(samples, lidar_R_imu):
    """What an IMU mounted so would have measured."""
    return ImuSamples(
        samples.stamps,
        None
        if samples.orientation is None
        else (Rotation.from_quat(samples.orientation) * lidar_R_imu).as_quat(),
        lidar_R_imu.inv().apply(samples.gyro),
        lidar_R_imu.inv().apply(samples.acceleration),
    )


def angle(a, b):
    """Rad between two rotations of either library."""
    a, b = (
        Rotation.from_matrix(r.matrix() if isinstance(r, gtsam.Rot3) else r.as_matrix())
        for r in (a, b)
    )
    return (a.inv() * b).magnitude()


def rot(*degrees):
    """Rz Ry Rx from roll, pitch, yaw."""
    return Rotation.from_euler("ZYX", degrees[::-1], degrees=True)


def rot3(*degrees):
    """The rotation of :func:`rot` as GTSAM has it."""
    return gtsam.Rot3(rot(*degrees).as_matrix())


def turning(world_R_lidar, rate=(0.0, 0.0, 0.0), *, at=0.5, seconds=1.0, bias=0.0, noise=0.0):
    """Samples at 200 Hz of a lidar that turns evenly, at ``world_R_lidar`` after ``at`` seconds.

    ``bias`` is added to the gyro, ``noise`` (rad) is that of the orientation.
    """
    times = np.arange(round(200 * seconds)) / 200.0
    attitude = Rotation.from_matrix(world_R_lidar.matrix())
    attitude = attitude * Rotation.from_rotvec(np.outer(times - at, rate))
    scatter = noise * np.random.default_rng(0).normal(size=(len(times), 3))
    return ImuSamples(
        ns(times),
        (attitude * Rotation.from_rotvec(scatter)).as_quat(),
        np.tile(np.add(rate, bias), (len(times), 1)),
        attitude.inv().apply([0.0, 0.0, G]),
    )
