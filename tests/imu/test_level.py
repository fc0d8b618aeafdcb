"""Up in the map, found in the samples around a moment."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from support.imu import START, part, rot3, turning

from loam_gtsam.config import ImuConfig
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.imu.level import find_level


def samples_of(level_R_lidar, rate=(0.0, 0.0, 0.0), noise=0.0):
    return turning(level_R_lidar, rate, at=1.0, seconds=2.0, noise=noise)


def level_of(samples, config=None, pose=None, levelled=False, stamp=START + 10**9):
    config, pose = config or ImuConfig(), pose or gtsam.Pose3()
    return find_level(ImuBuffer(config, samples), config, stamp, pose, levelled=levelled)


def test_up_is_found_in_any_map_and_yaw_is_left_alone():
    attitude = rot3(12, -7, 130)
    pose = gtsam.Pose3(rot3(50, 20, -80), np.ones(3))
    level = level_of(samples_of(attitude), pose=pose)
    np.testing.assert_allclose(np.degrees([level.roll, level.pitch]), [12, -7], atol=1e-9)
    found = level.level_R_map.compose(pose.rotation())
    np.testing.assert_allclose(np.degrees(found.rpy()), [12, -7, 0], atol=1e-9)
    up = pose.rotation().matrix() @ attitude.matrix()[2]
    np.testing.assert_allclose(level.map_up, up, atol=1e-9)
    assert level.source == "still"
    in_level = level_of(samples_of(attitude), levelled=True)
    assert in_level.level_R_map.equals(gtsam.Rot3(), 0.0)
    assert (in_level.roll, in_level.pitch) == (level.roll, level.pitch)


@pytest.mark.parametrize("rate", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.8)])
def test_a_second_of_samples_is_averaged_though_the_lidar_turns(rate):
    noisy = samples_of(rot3(12, -7, 130), rate, noise=0.01)
    level = level_of(noisy)
    assert level.samples == 201
    away = np.array([level.roll, level.pitch]) - np.radians([12, -7])
    assert np.abs(away).max() < 3.0 * 0.01 / np.sqrt(201.0)
    assert level.source == ("moving" if any(rate) else "still")
    # Also where there is little before that moment, so that the turning does not cancel.
    samples = samples_of(rot3(12, -7, 130), rate)
    level = level_of(part(samples, slice(180, None)))
    np.testing.assert_allclose(np.degrees([level.roll, level.pitch]), [12, -7], atol=1e-6)
    alone = level_of(noisy, ImuConfig(still_seconds=0.0))
    assert alone.samples == 1


@pytest.mark.parametrize(
    ("attitude", "rest", "felt"),
    [(True, False, False), (False, False, True), (False, True, False)],
)
def test_an_attitude_made_on_the_way_has_felt_the_motion(attitude, rest, felt):
    """But for a sensor's own, or where a rest before has told down."""
    samples = samples_of(rot3(12, -7, 130), (0.3, -0.2, 0.8))
    if rest:
        still = samples_of(rot3(12, -7, 130))
        samples = replace(
            samples,
            stamps=np.concatenate([still.stamps - 2 * 10**9, samples.stamps]),
            gyro=np.concatenate([still.gyro, samples.gyro]),
            acceleration=np.concatenate([still.acceleration, samples.acceleration]),
            orientation=np.concatenate([still.orientation, samples.orientation]),
        )
    level = level_of(samples if attitude else replace(samples, orientation=None))
    assert (level.felt, level.source) == (felt, "moving")


def test_samples_without_orientation_do_not_spoil_the_level():
    samples = samples_of(rot3(12, -7, 130))
    samples.orientation[180:190] = np.nan
    level = level_of(samples)
    assert level.samples == 191
    np.testing.assert_allclose(np.degrees([level.roll, level.pitch]), [12, -7], atol=1e-6)


def test_no_orientation_at_that_moment_is_no_level():
    samples = samples_of(rot3(12, -7, 130))
    assert level_of(replace(samples, stamps=samples.stamps + 2 * 10**9)) is None
    assert level_of(samples) is not None


def test_where_the_gyro_cannot_bring_samples_together_one_orientation_counts():
    noisy = samples_of(rot3(12, -7, 130), noise=0.01)
    at = ImuBuffer(ImuConfig(), noisy).orientation(START + 10**9)
    # A gap of 0.4 s ends 0.1 s before that moment.
    gap = part(noisy, (noisy.stamps < START + 5e8) | (noisy.stamps > START + 9e8))
    # 3 rad/s turn the lidar by more than 3 rad within a second of it.
    wild = samples_of(rot3(12, -7, 130), (0.0, 0.0, 7.0), noise=0.01)
    spun = ImuBuffer(ImuConfig(), wild).orientation(START + 10**9)
    for samples, alone in ((gap, at), (wild, spun)):
        level = level_of(samples, ImuConfig(still_seconds=1.0))
        assert level.samples == 1
        assert [level.roll, level.pitch] == pytest.approx(alone.rpy()[:2], abs=1e-12)
    # Between two samples none may be within reach.
    near = ImuConfig(still_seconds=0.001)
    level = level_of(samples_of(rot3(0, 0, 0)), near, stamp=START + 1_002_500_000)
    assert level.samples == 1
