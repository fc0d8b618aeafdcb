"""The kinds of IMU: errors of the size they state, at the place they state."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loam_gtsam.config import Config
from loam_gtsam.datasets import open_dataset
from loam_gtsam.datasets.sim.motion import GRAVITY
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import effective_config
from loam_gtsam.types import ConfigError

PERFECT = dict.fromkeys(("imu_noise", "gyro_noise", "acceleration_noise"), 0.0)
NO_BIAS = dict.fromkeys(("gyro_bias", "acceleration_bias"), (0.0, 0.0, 0.0))
LEVER = np.array([0.1, -0.05, -0.15])


def attitude_errors(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Seconds (N,) and rotation vectors (N, 3) in degrees."""
    world = SimulatedWorld("street_loop", columns=30, imu="mems", seed=seed, imu_noise=0.0)
    imu = world.imu
    poses = world.world_T_start @ world.truth_at(imu.stamps).map_T_lidar
    wrong = Rotation.from_matrix(poses[:, :3, :3]).inv() * Rotation.from_quat(imu.orientation)
    return (imu.stamps - imu.stamps[0]) * 1e-9, np.rad2deg(wrong.as_rotvec())


def test_attitude_of_mems_is_wrong_by_its_drift_which_changes_over_half_a_minute():
    squares, products = [], []
    for seed in range(12):
        times, wrong = attitude_errors(seed)
        squares.append((wrong**2).mean(axis=0))
        products.append((wrong[:-1500] * wrong[1500:]).mean(axis=0))  # 7.5 s later
        rate = np.abs(np.diff(wrong, axis=0)).max() / 0.005
        assert rate < 0.3  # deg/s: nothing jumps
        assert np.ptp(wrong[times < 40.0], axis=0).min() > 0.3
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.4, rel=0.1)
    # Three sines of 20, 30 and 45 s: their mean cosine after 7.5 s.
    expected = np.cos(2.0 * np.pi * 7.5 / np.array([20.0, 30.0, 45.0])).mean()
    assert np.mean(products) / np.mean(squares) == pytest.approx(expected, abs=0.15)


def test_biases_of_mems_have_their_size_and_a_direction_by_seed():
    directions = []
    for seed in (0, 1):
        noisy = SimulatedWorld("room", columns=30, imu="mems", seed=seed, **PERFECT)
        exact = SimulatedWorld("room", columns=30, imu="mems", seed=seed, **PERFECT, **NO_BIAS)
        gyro = noisy.imu.gyro - exact.imu.gyro
        pull = noisy.imu.acceleration - exact.imu.acceleration
        assert np.allclose(np.rad2deg(np.linalg.norm(gyro, axis=1)), 0.3)
        assert np.allclose(np.linalg.norm(pull, axis=1), 0.05)
        assert np.ptp(gyro, axis=0).max() < 1e-9
        directions.append(gyro[0])
    assert not np.allclose(*directions)


def test_six_axes_are_those_of_mems():
    options = {"columns": 30, "frames": 3, "seed": 4}
    mems, six = (SimulatedWorld("room", imu=kind, **options).imu for kind in ("mems", "six_axis"))
    assert six.orientation is None
    np.testing.assert_array_equal(six.gyro, mems.gyro)
    np.testing.assert_array_equal(six.acceleration, mems.acceleration)


@pytest.mark.parametrize("start", ["rest", "moving"])
def test_samples_are_those_at_the_place_of_the_imu(start):
    world = SimulatedWorld("shaken", imu="mems", start=start, frames=40, **PERFECT, **NO_BIAS)
    imu = world.imu
    poses = world.world_T_start @ world.truth_at(imu.stamps).map_T_lidar
    attitude = Rotation.from_matrix(poses[:, :3, :3])
    at = poses[:, :3, 3] + attitude.apply(LEVER)
    second = (at[2:] - 2.0 * at[1:-1] + at[:-2]) / 0.005**2 + (0.0, 0.0, GRAVITY)
    expected = attitude[1:-1].inv().apply(second)
    assert np.allclose(imu.acceleration[1:-1], expected, atol=0.05)
    # At the lidar's origin it would be another one.
    plain = SimulatedWorld("shaken", start=start, frames=40, **PERFECT, **NO_BIAS).imu
    assert np.abs(plain.acceleration - imu.acceleration).max() > 0.3
    assert np.array_equal(plain.gyro, imu.gyro)


def test_a_run_is_told_where_the_imu_is():
    world = open_dataset("sim:room?frames=3&columns=90&imu=mems")
    assert effective_config(Config(), world).imu.lidar_t_imu == tuple(LEVER)
    plain = open_dataset("sim:room?frames=3&columns=90")
    assert effective_config(Config(), plain).imu.lidar_t_imu == (0.0, 0.0, 0.0)
    assert "mems" in world.info().facts["imu"]
    with pytest.raises(ConfigError, match="imu: expected one of white, mems, six_axis; got 'fog'"):
        SimulatedWorld("room", imu="fog")
