"""A wrong mounting of the IMU is found in the motion of the scans."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.imu import CONFIG, G, angle, as_seen_by, ns, part, rot

from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.imu.extrinsic_check import extrinsic_problem
from loam_gtsam.types import ImuSamples, InputError


@pytest.fixture(scope="module")
def walk():
    """IMU of a walk through the room, and the poses a scan matcher would give, 1 mrad off."""
    world = SimulatedWorld("shaken", frames=80)
    poses = world.truth.map_T_lidar.copy()
    noise = Rotation.from_rotvec(0.001 * np.random.default_rng(6).standard_normal((80, 3)))
    poses[:, :3, :3] = poses[:, :3, :3] @ noise.as_matrix()
    return dataclasses.replace(world.imu, orientation=None), world.truth.stamps, poses


@pytest.mark.parametrize(
    "degrees",
    [
        (90, 0, 0),
        (-90, 0, 0),
        (0, 45, 0),
        (0, 0, 90),
        (0, 0, -90),
        (180, 0, 0),
        (180, 0, 90),
        (3, 8, -170),
    ],
)
def test_a_wrong_mounting_is_found_and_named(walk, degrees):
    samples, stamps, poses = walk
    there = as_seen_by(samples, rot(*degrees))
    said = extrinsic_problem(ImuBuffer(CONFIG, there), stamps, poses)
    named = [float(x) for x in said.split("[")[1].split("]")[0].split(",")]
    assert angle(rot(*named), rot(*degrees)) < np.deg2rad(2.0)
    # Set as it says, it is content.
    config = CONFIG.changed(lidar_R_imu_deg=tuple(named))
    assert extrinsic_problem(ImuBuffer(config, there), stamps, poses) == ""
    # From a configuration that is wrong in another way the same is found.
    config = CONFIG.changed(lidar_R_imu_deg=(20.0, 0.0, 30.0))
    assert str([round(x) for x in named]) in extrinsic_problem(
        ImuBuffer(config, there), stamps, poses
    )


def test_a_pitch_of_ninety_degrees_is_named_by_any_of_its_angles(walk):
    samples, stamps, poses = walk
    there = as_seen_by(samples, rot(0, 90, 0))
    assert "better by 90 degrees" in extrinsic_problem(ImuBuffer(CONFIG, there), stamps, poses)


def test_a_good_or_nearly_good_mounting_is_left_alone(walk):
    samples, stamps, poses = walk
    for degrees, told in (((0, 0, 0), False), ((0, 0, 4), False), ((0, 6, 0), True)):
        buffer = ImuBuffer(CONFIG, as_seen_by(samples, rot(*degrees)))
        assert bool(extrinsic_problem(buffer, stamps, poses)) is told


def test_too_little_motion_says_nothing(walk):
    samples, stamps, poses = walk
    there = as_seen_by(samples, rot(0, 0, 90))
    buffer = ImuBuffer(CONFIG, there)
    assert extrinsic_problem(buffer, stamps[:20], poses[:20]) == ""  # 19 pairs
    assert extrinsic_problem(buffer, stamps[40:], poses[40:]) != ""
    assert extrinsic_problem(ImuBuffer(CONFIG), stamps, poses) == ""
    assert extrinsic_problem(buffer, stamps, np.tile(np.eye(4), (80, 1, 1))) == ""
    rng = np.random.default_rng(7)
    # About one axis only: the noise of the others must not pass for motion, however much of it.
    for count in (100, 3000):
        times = np.arange(20 * count) * 0.005
        gyro = np.column_stack([0 * times, 0 * times, 0.5 * np.sin(times)])
        even = ImuSamples(
            ns(times),
            None,
            gyro + 0.003 * rng.standard_normal(gyro.shape),
            np.tile([0, 0, G], (len(times), 1)),
        )
        yaw = 0.5 * (1.0 - np.cos(0.1 * np.arange(count)))
        scatter = Rotation.from_rotvec(0.001 * rng.standard_normal((count, 3)))
        scans = np.tile(np.eye(4), (count, 1, 1))
        scans[:, :3, :3] = (Rotation.from_euler("z", yaw[:, None]) * scatter).as_matrix()
        planar = ImuBuffer(CONFIG, as_seen_by(even, rot(0, 0, 90)))
        assert extrinsic_problem(planar, ns(0.1 * np.arange(count)), scans) == ""


def test_lost_tracks_and_gaps_do_not_mislead(walk):
    samples, stamps, poses = walk
    poses = poses.copy()
    for k in (10, 30, 50):  # from there on in a map turned by 45 degrees
        poses[k:, :3, :3] = rot(25, 10, 40).as_matrix() @ poses[k:, :3, :3]
    seconds = (samples.stamps - stamps[0]) * 1e-9
    holed = part(samples, (seconds < 4.0) | (seconds > 4.5))
    assert extrinsic_problem(ImuBuffer(CONFIG, holed), stamps, poses) == ""
    there = as_seen_by(holed, rot(0, 0, 90))
    assert "[0, 0, 90]" in extrinsic_problem(ImuBuffer(CONFIG, there), stamps, poses)


@pytest.mark.parametrize("signs", [[1, -1, 1], [-1, -1, -1]])
def test_a_mirrored_gyro_is_no_matter_of_mounting(walk, signs):
    samples, stamps, poses = walk
    mirrored = dataclasses.replace(samples, gyro=samples.gyro * np.array(signs, float))
    assert extrinsic_problem(ImuBuffer(CONFIG, mirrored), stamps, poses) == ""


def test_extrinsic_check_wants_as_many_poses_as_stamps(walk):
    samples, stamps, poses = walk
    for wrong in (poses[:-1], poses[:, :3], poses[0]):
        with pytest.raises(InputError, match=r"map_T_lidar: expected \(80, 4, 4\)"):
            extrinsic_problem(ImuBuffer(CONFIG, samples), stamps, wrong)
