"""The IMU's roll and pitch as a blend and as factors: means, Jacobians, steep pitch."""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.imu import rot3
from support.jacobians import numerical

from loam_gtsam.imu_prior import (
    RollPitchPrior,
    blend,
    blend_direction,
    blended_angles,
    equivalent_prior,
    gravity_factor,
    roll_pitch,
    roll_pitch_factor,
    roll_pitch_jacobian,
    tilt_information,
    too_steep,
)
from loam_gtsam.registration.solvers import POSE_KEY, fuse

FLAT = gtsam.Rot3()
WEIGHTS = (0.0005, 0.002, 0.05, 0.5)
UP = np.array([0.0, 0.0, 1.0])


def scan_information(rng, count=200):
    """Of random planes seen from 2 to 35 m, known to 2 to 10 cm: all of it correlated."""
    points = rng.uniform(-20, 20, (count, 3))
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.hstack([np.cross(points, normals), normals]) / rng.uniform(0.02, 0.1, (count, 1))
    return rows.T @ rows


def random_case(rng, pull=0.02):
    """level_R_map, the scan's pose, its information, and the IMU's rotation ``pull`` rad away."""
    tilt = rng.uniform(-np.pi / 3, np.pi / 3, 2)
    level_R_map = gtsam.Rot3.Expmap(rng.normal(size=3))
    level_R_lidar = gtsam.Rot3.RzRyRx(*tilt, rng.uniform(-3, 3))
    pose = gtsam.Pose3(level_R_map.inverse().compose(level_R_lidar), rng.normal(0, 50, 3))
    measured = gtsam.Rot3.RzRyRx(*(tilt + rng.uniform(-pull, pull, 2)), rng.uniform(-3, 3))
    return level_R_map, pose, scan_information(rng), measured


def fused(pose, information, measured, weight, level_R_map=FLAT):
    """The pose with the equivalent prior."""
    level_R_lidar = level_R_map.compose(pose.rotation())
    prior = equivalent_prior(level_R_lidar, information, measured, weight)
    return fuse(pose, information, [roll_pitch_factor(POSE_KEY, prior, level_R_map)])[0]


def at(pose):
    values = gtsam.Values()
    values.insert(POSE_KEY, pose)
    return values


def whitened(factor, pose):
    return factor.noiseModel().whiten(factor.unwhitenedError(at(pose)))


def check_jacobian(factor, pose, tolerance):
    """Compare the Jacobian, as GTSAM linearises the factor, with the numerical one; the error."""
    jacobian, right = factor.linearize(at(pose)).jacobian()
    expected = numerical(lambda near: whitened(factor, near), pose)
    np.testing.assert_allclose(jacobian, expected, atol=tolerance * np.abs(expected).max())
    assert np.linalg.matrix_rank(jacobian, tol=1e-6) == 2
    return -right


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("pull", [1e-3, 1.0])
def test_the_jacobian_of_the_roll_pitch_factor_is_the_numerical_one(seed, pull):
    level_R_map, pose, information, measured = random_case(np.random.default_rng(seed), pull)
    level_R_lidar = level_R_map.compose(pose.rotation())
    prior = equivalent_prior(level_R_lidar, information, measured, 0.05)
    factor = roll_pitch_factor(POSE_KEY, prior, level_R_map)
    error = check_jacobian(factor, pose, 1e-6)
    away = roll_pitch(level_R_lidar) - prior.roll_pitch
    assert error @ error == pytest.approx(away @ prior.information @ away)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("away", [1e-4, 0.1, 1.5])
def test_the_jacobian_of_the_gravity_factor_is_the_numerical_one_at_any_tilt(seed, away):
    rng = np.random.default_rng(seed)
    up = gtsam.Rot3.Expmap(rng.normal(size=3)).matrix()[2]
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(0, 50, 3))
    axis = np.cross(rng.normal(size=3), pose.rotation().matrix().T @ up)
    axis *= away / np.linalg.norm(axis)
    # The world's z axis seen by the lidar, turned by so much.
    lidar_up = gtsam.Rot3.Expmap(axis).matrix() @ pose.rotation().matrix().T @ up
    measured = gtsam.Rot3(Rotation.align_vectors([[0, 0, 1.0]], [lidar_up])[0].as_matrix())
    factor = gravity_factor(POSE_KEY, measured, 0.01, up)
    error = check_jacobian(factor, pose, 1e-5)
    assert np.linalg.norm(error) * 0.01 == pytest.approx(np.sin(away), rel=1e-5)


@pytest.mark.parametrize("tilt", [(0, 0), (30, -40), (10, 90), (200, -90)])
def test_the_gravity_factor_is_free_of_yaw_and_position(tilt):
    own = gtsam.Rot3.RzRyRx(*np.radians(tilt), 0.0)
    factor = gravity_factor(POSE_KEY, own, 0.01, UP)
    for yaw in (0.0, 1.0, 3.0):
        pose = gtsam.Pose3(gtsam.Rot3.Yaw(yaw).compose(own), np.array([yaw, 7.0, -2.0]))
        assert np.abs(whitened(factor, pose)).max() < 1e-10


def test_too_steep_is_85_degrees_of_any_of_them():
    assert not too_steep(rot3(170, 84.9, 10), rot3(0, -84.9, 0))
    assert too_steep(rot3(0, 85.1, 0))
    assert too_steep(rot3(0, 0, 0), rot3(10, -85.1, 0))


def test_the_blend_is_loams_formula_to_the_last_bit():
    rng = np.random.default_rng(0)
    for _ in range(100):
        own, imu = (gtsam.Rot3.RzRyRx(*rng.uniform(-1.4, 1.4, 3)) for _ in range(2))
        roll, pitch = 0.998 * roll_pitch(own) + 0.002 * roll_pitch(imu)
        assert np.array_equal(blended_angles(own, imu, 0.002), [roll, pitch])
        expected = gtsam.Rot3.RzRyRx(roll, pitch, own.yaw())
        position = rng.normal(size=3)
        found = blend(gtsam.Pose3(own, position), imu, 0.002, FLAT)
        assert np.array_equal(found.rotation().matrix(), expected.matrix())
        assert np.array_equal(found.translation(), position)


def test_the_blend_happens_about_up_and_not_about_the_axis_of_the_map():
    rng = np.random.default_rng(1)
    for _ in range(20):
        level_R_map, pose, _, measured = random_case(rng, 0.3)
        before = level_R_map.compose(pose.rotation())
        blended = blend(pose, measured, 0.25, level_R_map)
        after = level_R_map.compose(blended.rotation())
        mean = 0.75 * roll_pitch(before) + 0.25 * roll_pitch(measured)
        np.testing.assert_allclose(roll_pitch(after), mean, atol=1e-12)
        assert after.yaw() == pytest.approx(before.yaw(), abs=1e-12)
        np.testing.assert_array_equal(blended.translation(), pose.translation())


@pytest.mark.parametrize(("own", "imu"), [(179.9, -179.9), (-179.9, 179.9), (179.0, -170.0)])
@pytest.mark.parametrize("weight", [0.002, 0.5])
def test_roll_is_taken_the_short_way_round(own, imu, weight):
    """Upside down: 179.9 and -179.9 degrees are 0.2 degrees apart, and their mean is not 0."""
    pose = gtsam.Pose3(rot3(own, 20, 50), np.zeros(3))
    measured = rot3(imu, 20, 0)
    expected = own + weight * ((imu - own + 180.0) % 360.0 - 180.0)
    blended = blend(pose, measured, weight, FLAT)
    by_factor = fused(pose, scan_information(np.random.default_rng(0)), measured, weight)
    for found in (blended, by_factor):
        away = np.degrees(found.rotation().roll()) - expected
        assert abs((away + 180.0) % 360.0 - 180.0) < 1e-6


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("half", [91.0, 120.0, 134.0])
def test_roll_is_taken_the_short_way_round_from_far_off(half, side):
    """Two rolls on either side of upside down, ``360 - 2 half`` degrees apart."""
    own, imu = rot3(side * half, 0, 0), rot3(-side * half, 0, 0)
    apart = side * (360.0 - 2.0 * half)
    roll, _ = blended_angles(own, imu, 0.25)
    assert np.degrees(roll) == pytest.approx(side * half + 0.25 * apart, abs=1e-9)
    prior = RollPitchPrior(roll_pitch(imu), np.eye(2))
    error = whitened(roll_pitch_factor(POSE_KEY, prior, FLAT), gtsam.Pose3(own, np.zeros(3)))
    np.testing.assert_allclose(np.degrees(error), [-apart, 0.0], atol=1e-9)


def test_the_blend_of_the_direction_turns_up_by_its_share_of_the_way():
    rng = np.random.default_rng(2)
    for _ in range(20):
        pose = gtsam.Pose3(gtsam.Rot3.Expmap(2 * rng.normal(size=3)), rng.normal(size=3))
        measured = gtsam.Rot3.Expmap(2 * rng.normal(size=3))
        own, imu = pose.rotation().matrix()[2], measured.matrix()[2]
        blended = blend_direction(pose, measured, 0.25, UP)
        there = blended.rotation().matrix()[2]
        whole = np.arccos(own @ imu)
        assert np.arccos(own @ there) == pytest.approx(0.25 * whole, abs=1e-7)
        assert np.arccos(there @ imu) == pytest.approx(0.75 * whole, abs=1e-7)
        turned = gtsam.Rot3.Logmap(pose.rotation().between(blended.rotation()))
        assert turned @ own == pytest.approx(0.0, abs=1e-12)  # none about up
        np.testing.assert_array_equal(blended.translation(), pose.translation())


def test_the_blend_of_equal_directions_is_the_pose_itself():
    pose = gtsam.Pose3(rot3(0, 90, 20), np.ones(3))
    measured = gtsam.Rot3.Yaw(1.0).compose(pose.rotation())
    found = blend_direction(pose, measured, 0.5, UP)
    assert found.equals(pose, 1e-12)


@pytest.mark.parametrize("weight", WEIGHTS)
@pytest.mark.parametrize("pull", [1e-3, 0.02, 0.2])
def test_the_equivalent_prior_has_the_mean_of_the_blend(weight, pull):
    """Tilts of up to 60 degrees, random scans, maps that are not level. Measured: 3e-9 rad."""
    rng = np.random.default_rng(3)
    for _ in range(40):
        level_R_map, pose, information, measured = random_case(rng, pull)
        before = level_R_map.compose(pose.rotation())
        found = fused(pose, information, measured, weight, level_R_map)
        mean = (1 - weight) * roll_pitch(before) + weight * roll_pitch(measured)
        after = roll_pitch(level_R_map.compose(found.rotation()))
        np.testing.assert_allclose(after, mean, atol=1e-6)
        assert np.abs(after - roll_pitch(before)).max() > 1e-3 * weight * pull  # it did act


@pytest.mark.parametrize("weight", [0.002, 0.5])
def test_yaw_and_position_go_where_the_correlations_of_the_scan_take_them(weight):
    """To first order by L^-1 J^T (J L^-1 J^T)^-1 times what roll and pitch moved."""
    rng = np.random.default_rng(4)
    pull = 1e-4
    for _ in range(20):
        level_R_map, pose, information, measured = random_case(rng, pull)
        level_R_lidar = level_R_map.compose(pose.rotation())
        found = pose.localCoordinates(fused(pose, information, measured, weight, level_R_map))
        jacobian = roll_pitch_jacobian(level_R_lidar)
        gain = np.linalg.solve(information, jacobian.T)
        gain = gain @ np.linalg.inv(jacobian @ gain)
        expected = gain @ (weight * (roll_pitch(measured) - roll_pitch(level_R_lidar)))
        assert np.linalg.norm(expected[3:]) > 1e-4 * weight * pull  # there are correlations
        # What is left is of second order in the pull.
        np.testing.assert_allclose(found, expected, atol=30.0 * weight * pull**2)


def test_no_weight_is_no_move():
    _, pose, information, measured = random_case(np.random.default_rng(6))
    assert fused(pose, information, measured, 0.0).equals(pose, 1e-12)


def test_a_pull_too_far_for_the_correction_leaves_the_target_at_the_imu():
    information = scan_information(np.random.default_rng(7))
    near = equivalent_prior(FLAT, information, rot3(0, 60, 0), 0.5)
    assert abs(near.roll_pitch[1] - np.radians(60.0)) > 1e-5
    # Past 85 degrees, and no end in 20 rounds.
    for own, measured in (
        (rot3(0, 0, 0), rot3(12, 86, 0)),
        (rot3(10, 84, 0), rot3(12, 86, 0)),
        (rot3(0, 30, 0), rot3(160, 30, 0)),
    ):
        far = equivalent_prior(own, np.eye(6), measured, 0.99)
        np.testing.assert_allclose(far.roll_pitch, roll_pitch(measured), rtol=0, atol=1e-12)
        knows = tilt_information(np.eye(6), own)
        np.testing.assert_allclose(far.information, 0.99 / 0.01 * knows, rtol=1e-12)


def test_the_information_of_the_tilt_is_the_schur_complement():
    information = scan_information(np.random.default_rng(8))
    a, b, c = information[:2, :2], information[:2, 2:], information[2:, 2:]
    schur = a - b @ np.linalg.solve(c, b.T)
    # Level: roll and pitch are the first two tangent directions.
    np.testing.assert_allclose(tilt_information(information, FLAT), schur, rtol=1e-9)


def test_a_direction_without_information_is_free():
    """A corridor along x: x is free, and the tilt is known as well as without it."""
    information = scan_information(np.random.default_rng(9))
    information[3] = information[:, 3] = 0.0
    rest = [0, 1, 2, 4, 5]
    expected = np.linalg.inv(np.linalg.inv(information[np.ix_(rest, rest)])[:2, :2])
    np.testing.assert_allclose(tilt_information(information, FLAT), expected, rtol=1e-6)
    # A wall says nothing about the turn about its normal.
    information[1] = information[:, 1] = 0.0
    knows = tilt_information(information, FLAT)
    assert np.linalg.eigvalsh(knows)[0] < 1e-6 * np.linalg.eigvalsh(knows)[1]


@pytest.mark.parametrize("largest", [0.0, 1e-4, 1.0, 1e8])
def test_no_information_is_a_share_of_the_largest_whatever_its_unit(largest):
    information = largest * np.diag([0.0, 1e-3, 1e-4, 1e-5, 1e-6, 1.0])
    expected = largest * np.diag([1e-12, 1e-3])
    found = tilt_information(information, FLAT)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-300)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_modes_meet_where_they_take_turns(side):
    """Just below 85 degrees angles are blended, just above directions. Up moves alike."""
    pose = gtsam.Pose3(rot3(30, side * 84.99, 100), np.zeros(3))
    measured = rot3(32, side * 84.9, 0)
    between = np.arccos(pose.rotation().matrix()[2] @ measured.matrix()[2])
    by_angles = blend(pose, measured, 0.05, FLAT).rotation()
    by_direction = blend_direction(pose, measured, 0.05, UP).rotation()
    apart = np.arccos(np.clip(by_angles.matrix()[2] @ by_direction.matrix()[2], -1, 1))
    assert apart < 0.05 * 0.05 * between
    # What is left is yaw: that of the angles' blend is the share of the roll by definition.
    turn = np.linalg.norm(gtsam.Rot3.Logmap(by_angles.between(by_direction)))
    assert turn < 1.01 * 0.05 * np.radians(2.0)


@pytest.mark.parametrize("pitch", [90.0, -90.0, 89.999])
def test_directions_are_finite_where_angles_are_not(pitch):
    pose = gtsam.Pose3(rot3(0, pitch, 30), np.ones(3))
    measured = rot3(40, np.sign(pitch) * 88.0, 0)
    blended = blend_direction(pose, measured, 0.002, UP)
    turned = gtsam.Rot3.Logmap(pose.rotation().between(blended.rotation()))
    between = np.arccos(pose.rotation().matrix()[2] @ measured.matrix()[2])
    assert np.linalg.norm(turned) == pytest.approx(0.002 * between, rel=1e-4)
