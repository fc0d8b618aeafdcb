"""What the buffer finds wrong with its samples."""

import dataclasses

import numpy as np
import pytest
from support.imu import CONFIG, moving, part, resting, rot

from loam_gtsam.imu.buffer import ImuBuffer


@pytest.mark.parametrize(
    ("wrong", "told"),
    [(rot(0, 0, 90), False), (rot(4, 0, 0), False), (rot(6, 0, 0), True), (rot(180, 0, 0), True)],
)
def test_gravity_and_orientation_are_compared_at_rest(wrong, told):
    samples = resting()
    orientation = np.tile(wrong.as_quat(), (200, 1))
    report = ImuBuffer(CONFIG, dataclasses.replace(samples, orientation=orientation)).report
    assert report.orientation == "ahrs"
    assert any("degrees apart" in problem for problem in report.problems) is told


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
