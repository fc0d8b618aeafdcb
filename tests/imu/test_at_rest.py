"""Rest told from motion, and what is learnt from it."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.imu import CONFIG, START, G, angle, moving, ns, part, resting, rot

from loam_gtsam.imu.at_rest import find_rest, rest_at_start
from loam_gtsam.imu.buffer import ImuBuffer

REST = resting(100)
ABOUT_X = np.array([1.0, 0.0, 0.0])


def ramp(name, slope):
    values = getattr(REST, name) + slope * np.linspace(0.0, 1.0, 100)[:, None]
    return dataclasses.replace(REST, **{name: values})


def scaled_scatter(name, factor):
    values = getattr(REST, name)
    mean = values.mean(axis=0)
    return dataclasses.replace(REST, **{name: mean + factor * (values - mean)})


@pytest.mark.parametrize(
    ("samples", "rest"),
    [
        (REST, True),
        (resting(100, world_R_lidar=rot(180, 0, 0)), True),
        (scaled_scatter("gyro", 4.0), True),  # 0.012 rad/s
        (scaled_scatter("gyro", 8.0), False),
        (scaled_scatter("acceleration", 4.0), True),  # 0.12 m/s^2
        (scaled_scatter("acceleration", 6.0), False),
        (ramp("gyro", 0.003), True),
        (ramp("gyro", 0.015), False),
        (ramp("acceleration", 0.03), True),
        (ramp("acceleration", 0.2), False),
        (dataclasses.replace(REST, gyro=REST.gyro + 0.04 * ABOUT_X), True),
        (dataclasses.replace(REST, gyro=REST.gyro + 0.06 * ABOUT_X), False),
        (dataclasses.replace(REST, acceleration=REST.acceleration * 1.04), True),
        (dataclasses.replace(REST, acceleration=REST.acceleration * 1.06), False),
        (dataclasses.replace(REST, acceleration=REST.acceleration * 0.94), False),
        (part(REST, slice(0, 100, 10)), True),
        (part(REST, slice(0, 90, 10)), False),  # 9 samples
        (part(REST, slice(21)), True),
        (part(REST, slice(20)), False),  # 0.095 s
        (part(REST, np.r_[:50, 68:100]), True),
        (part(REST, np.r_[:50, 71:100]), False),  # a gap of 0.11 s
        (part(REST, slice(0)), False),
    ],
)
def test_rest_is_told_from_motion(samples, rest):
    found = find_rest(CONFIG, samples)
    assert (found is not None) is rest


def test_rest_at_start_takes_what_there_is_before_the_motion():
    late = resting(100)
    for begins, expected in ((100, 100), (60, 51), (30, 26), (10, None)):
        gyro = late.gyro.copy()
        gyro[begins:] += 0.3
        found = rest_at_start(CONFIG, dataclasses.replace(late, gyro=gyro))
        assert (found.samples if found else None) == expected


def test_still_window_gives_bias_gravity_and_orientation():
    truth = rot(10, -20, 170)
    samples = resting(world_R_lidar=truth)
    noise = Rotation.from_rotvec(0.003 * np.random.default_rng(5).standard_normal((200, 3)))
    quaternions = (truth * noise).as_quat() * np.where(np.arange(200) % 2, 1, -1)[:, None]
    buffer = ImuBuffer(CONFIG, dataclasses.replace(samples, orientation=quaternions))
    window = buffer.rest_at(int(ns(0.6)))
    assert (window.first, window.last, window.samples) == (ns(0.1), ns(0.7), 121)
    assert np.allclose(window.gyro, [0.002, -0.001, 0.0015], atol=1e-3)
    assert np.allclose(window.acceleration, truth.inv().apply([0, 0, G]), atol=0.02)
    assert angle(window.world_R_lidar, truth) < 1e-3
    assert window.disagreement < 2e-3
    without = ImuBuffer(CONFIG.changed(gravity=1.5), samples)
    assert without.rest_at(int(ns(0.6))) is None
    assert ImuBuffer(CONFIG, moving()).rest_at(int(ns(1.0))) is None
    # 0.1 s of rest before and the first sweep are enough.
    assert buffer.rest_at(START).samples == 21
    assert buffer.rest_at(START - 50_000_000) is None
