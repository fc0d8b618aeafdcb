"""What is found wrong with samples and with the mounting of the IMU."""

import dataclasses

import numpy as np
from support.imu import CONFIG, moving, part, resting

from loam_gtsam.imu.buffer import ImuBuffer


def test_a_placeholder_is_not_taken_for_an_orientation():
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (800, 1))
    report = ImuBuffer(CONFIG, dataclasses.replace(moving(), orientation=identity)).report
    assert report.orientation == "gravity_filter"
    assert "never changes while the gyro says" in report.problems[0]
    # At rest the same orientation may well be true, and with few samples nobody knows.
    for still in (
        dataclasses.replace(resting(800), orientation=identity),
        part(dataclasses.replace(moving(), orientation=identity), slice(9)),
    ):
        assert ImuBuffer(CONFIG, still).report.orientation == "ahrs"


def test_of_an_imu_without_an_accelerometer_nothing_is_said_about_gravity():
    with_gyro_alone = dataclasses.replace(moving(), orientation=None, acceleration=None)
    report = ImuBuffer(CONFIG, with_gyro_alone).report
    assert report.orientation == "none"
    assert not report.problems
    weak = dataclasses.replace(with_gyro_alone, acceleration=0.1 * moving().acceleration)
    told = " ".join(ImuBuffer(CONFIG, weak).report.problems)
    assert "none to be had from the acceleration" in told
    assert "gravity has been taken off" in told or "multiples of gravity" in told
