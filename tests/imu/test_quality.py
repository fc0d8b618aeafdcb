"""What is found wrong with samples and with the mounting of the IMU."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.imu import CONFIG, angle, moving, part, resting, rot, rot3

from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.imu.quality import extrinsic_problem


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


@pytest.fixture(scope="module")
def walk():
    """Rotations from frame to frame of a walk through the room, as a scan matcher and a gyro see
    them, 1.4 mrad and 1 mrad off.
    """
    rotations = Rotation.from_matrix(SimulatedWorld("shaken").truth.map_T_lidar[:80, :3, :3])
    turns = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
    noise = np.random.default_rng(6).standard_normal((2, 79, 3))
    return turns + 1.4e-3 * noise[0], turns + 1e-3 * noise[1]


def problem(by_scan, by_gyro, mounted=(0, 0, 0), configured=(0, 0, 0)):
    """Of a gyro that is mounted otherwise than configured."""
    seen = rot(*configured).apply(rot(*mounted).inv().apply(by_gyro))
    return extrinsic_problem(by_scan, seen, rot3(*configured))


@pytest.mark.parametrize("configured", [(0, 0, 0), (20, 0, 30)])
@pytest.mark.parametrize(
    "degrees",
    [
        *((90, 0, 0), (-90, 0, 0), (0, 45, 0), (0, 0, 90), (0, 0, -90)),
        *((180, 0, 0), (180, 0, 90), (3, 8, -170)),
    ],
)
def test_a_wrong_mounting_is_found_and_named(walk, degrees, configured):
    said = problem(*walk, degrees, configured)
    named = [float(x) for x in said.split("[")[1].split("]")[0].split(",")]
    assert angle(rot(*named), rot(*degrees)) < np.deg2rad(2.0)
    assert problem(*walk, degrees, named) == ""  # set as it says, it is content


@pytest.mark.parametrize(
    ("degrees", "told"),
    [((0, 0, 0), ""), ((0, 0, 4), ""), ((0, 6, 0), "by 6 deg"), ((0, 90, 0), "by 90 deg")],
)
def test_a_good_or_nearly_good_mounting_is_left_alone(walk, degrees, told):
    said = problem(*walk, degrees)
    assert told in said if told else said == ""


def test_too_little_motion_says_nothing(walk):
    by_scan, by_gyro = walk
    assert problem(by_scan[:0], by_gyro[:0]) == ""
    assert problem(by_scan[40:59], by_gyro[40:59], (0, 0, 90)) == ""  # 19 pairs
    assert problem(by_scan[40:60], by_gyro[40:60], (0, 0, 90)) != ""
    assert problem(np.zeros((79, 3)), by_gyro, (0, 0, 90)) == ""


@pytest.mark.parametrize("count", [100, 3000])
def test_noise_about_the_other_axes_does_not_pass_for_motion(count):
    """A platform that turns about one axis only, for however long."""
    rng = np.random.default_rng(7)
    turns = np.outer(0.05 * np.sin(0.1 * np.arange(count)), [0.0, 0.0, 1.0])
    by_scan = turns + 1.4e-3 * rng.standard_normal((count, 3))
    assert problem(by_scan, turns + 1e-4 * rng.standard_normal((count, 3)), (0, 0, 90)) == ""


def test_lost_tracks_do_not_mislead(walk):
    by_scan, by_gyro = walk[0].copy(), walk[1]
    by_scan[[10, 30, 50]] += [0.4, 0.2, 0.7]
    assert problem(by_scan, by_gyro) == ""
    assert "[0, 0, 90]" in problem(by_scan, by_gyro, (0, 0, 90))


@pytest.mark.parametrize("signs", [[1, -1, 1], [-1, -1, -1]])
def test_a_mirrored_gyro_is_no_matter_of_mounting(walk, signs):
    assert problem(walk[0], walk[1] * np.array(signs, float)) == ""
