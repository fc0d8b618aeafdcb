"""Small text files of numbers, and IMU samples made of them."""

from __future__ import annotations

import numpy as np

from loam_gtsam.datasets.decode.tables import clean_imu, seconds_to_ns


def test_stamps_keep_every_nanosecond() -> None:
    assert seconds_to_ns("1700000000.123456789") == 1_700_000_000_123_456_789
    assert seconds_to_ns("1e-9") == 1


def imu_values(count: int) -> np.ndarray:
    return np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (count, 1))


def test_imu_samples_are_put_in_order() -> None:
    problems: list[str] = []
    values = imu_values(5)
    values[:, 4] = np.arange(5)
    values[4, 5] = np.nan
    samples = clean_imu(np.array([20, 10, 10, 30, 40]), values, problems)
    assert samples.stamps.tolist() == [10, 20, 30]
    assert samples.gyro[:, 0].tolist() == [1.0, 0.0, 3.0]
    assert len(problems) == 2
    clean: list[str] = []
    assert clean_imu(np.arange(5), imu_values(5), clean) is not None
    assert clean == []


def test_imu_in_g_is_converted_and_an_empty_one_is_none() -> None:
    problems: list[str] = []
    values = imu_values(4)
    values[:, 9] = 1.0
    samples = clean_imu(np.arange(4), values, problems)
    np.testing.assert_allclose(samples.acceleration[:, 2], 9.80665)
    assert "in g" in problems[0]
    assert clean_imu(np.zeros(0, np.int64), np.zeros((0, 10)), problems) is None
