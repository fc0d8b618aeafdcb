"""What is found wrong with an IMU: by its samples alone, and by the turns of the scans."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.imu import CONFIG, START, angle, moving, part, resting, rot

from loam_gtsam.config import ImuConfig
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.imu.diagnosis import samples_problems, scans_problems


@pytest.fixture(scope="module")
def walk():
    """Samples of a walk through the room, and its frames: spans and turns by the scans."""
    world = SimulatedWorld("shaken", frames=80)
    rotations = Rotation.from_matrix(world.truth.map_T_lidar[:, :3, :3])
    turns = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
    noise = 1.4e-3 * np.random.default_rng(6).standard_normal(turns.shape)
    stamps = world.truth.stamps
    return world.imu, np.column_stack([stamps[:-1], stamps[1:]]), turns + noise


def said(walk, change=lambda imu: imu, mounted=(0, 0, 0), **settings):
    """Of samples that are changed, and of an IMU that is mounted otherwise than configured."""
    imu, spans, by_scan = walk
    seen = rot(*settings.get("lidar_R_imu_deg", (0, 0, 0))) * rot(*mounted).inv()
    imu = change(replace(imu, gyro=seen.apply(imu.gyro)))
    config = ImuConfig(**settings)
    gyro = ImuBuffer(ImuConfig(), imu)
    turned = [gyro.rotation_between(*span) for span in spans.tolist()]
    known = [turn is not None for turn in turned]
    by_gyro = np.array([gtsam.Rot3.Logmap(turn) for turn in turned if turn]).reshape(-1, 3)
    return " ".join(scans_problems(spans[known], by_scan[known], by_gyro, imu, config))


@pytest.mark.parametrize("configured", [(0, 0, 0), (20, 0, 30)])
@pytest.mark.parametrize(
    "degrees",
    [
        *((90, 0, 0), (-90, 0, 0), (0, 45, 0), (0, 0, 90), (0, 0, -90)),
        *((180, 0, 0), (180, 0, 90), (3, 8, -170)),
    ],
)
def test_a_wrong_mounting_is_found_and_named(walk, degrees, configured):
    told = said(walk, mounted=degrees, lidar_R_imu_deg=configured)
    named = tuple(float(x) for x in told.split("[")[1].split("]")[0].split(","))
    assert angle(rot(*named), rot(*degrees)) < np.deg2rad(2.0)
    assert said(walk, mounted=degrees, lidar_R_imu_deg=named) == ""  # set so, it is content


@pytest.mark.parametrize(
    ("degrees", "told"),
    [((0, 0, 0), ""), ((0, 0, 4), ""), ((0, 6, 0), "by 6 deg"), ((0, 90, 0), "by 90 deg")],
)
def test_a_good_or_nearly_good_mounting_is_left_alone(walk, degrees, told):
    found = said(walk, mounted=degrees)
    assert told in found if told else found == ""


@pytest.mark.parametrize("milliseconds", [-120, -30, 8, 50, 200])
@pytest.mark.parametrize("offset", [0.0, 0.1])
def test_the_clock_of_the_imu_is_found_to_be_off(walk, milliseconds, offset):
    def late(imu):
        return replace(imu, stamps=imu.stamps + milliseconds * 10**6)

    told = said(walk, late, time_offset=offset)
    assert ("late" if milliseconds > 0 else "early") in told
    named = float(told.split("imu.time_offset to ")[1])
    assert named == pytest.approx(offset - 1e-3 * milliseconds, abs=3e-3)


def test_a_clock_that_is_right_or_nearly_so_is_left_alone(walk):
    for milliseconds in (0, 3):
        shift = milliseconds * 10**6
        assert said(walk, lambda imu, s=shift: replace(imu, stamps=imu.stamps + s)) == ""


@pytest.mark.parametrize("milliseconds", [-60, 40])
def test_a_clock_that_jumps_is_no_offset(walk, milliseconds):
    """Whether the IMU's does, or that of the sweeps: what they say of each other is the same."""

    def jumps(imu):
        later = np.arange(len(imu.stamps)) > len(imu.stamps) // 2
        stamps = imu.stamps + np.where(later, milliseconds * 10**6, 0)
        order = np.argsort(stamps, kind="stable")
        return replace(imu, stamps=stamps[order], gyro=imu.gyro[order])

    told = said(walk, jumps)
    assert "its clock jumps or drifts" in told
    assert "in time in one half" in told
    named = float(told.split("run and ")[1].split(" ms ")[0])
    assert named == pytest.approx(abs(milliseconds), abs=3.0)
    assert "set imu.time_offset" not in told


def test_with_the_named_offset_the_samples_are_in_time():
    samples = moving()
    late = replace(samples, stamps=samples.stamps + 50_000_000)
    found = ImuBuffer(ImuConfig(time_offset=-0.05), late).orientation(START + 10**9)
    assert found.equals(ImuBuffer(ImuConfig(), samples).orientation(START + 10**9), 0.0)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda gyro: np.rad2deg(gyro), "degrees per second"),
        (lambda gyro: np.deg2rad(gyro), "too large by 180 / pi"),
        (lambda gyro: gyro * np.array([1.0, -1.0, 1.0]), "left-handed"),
        (lambda gyro: -gyro, "left-handed"),
        (lambda gyro: 1.3 * gyro, ""),  # of no known cause
        (lambda gyro: gyro + np.array([0.1, -0.2, 0.1]), ""),  # a bias
        (lambda gyro: np.random.default_rng(0).standard_normal(gyro.shape), ""),
        (lambda gyro: np.zeros_like(gyro), ""),
    ],
)
def test_units_and_signs_of_the_gyro_are_named(walk, change, told):
    found = said(walk, lambda imu: replace(imu, gyro=change(imu.gyro)))
    assert told in found if told else found == ""


def test_too_little_motion_says_nothing(walk):
    imu, spans, by_scan = walk
    for part_of in (slice(0), slice(40, 59)):  # 19 pairs
        assert said((imu, spans[part_of], by_scan[part_of]), mounted=(0, 0, 90)) == ""
    assert said((imu, spans[40:60], by_scan[40:60]), mounted=(0, 0, 90)) != ""
    assert said((imu, spans, np.zeros_like(by_scan)), mounted=(0, 0, 90)) == ""


@pytest.mark.parametrize("count", [100, 3000])
def test_noise_about_the_other_axes_does_not_pass_for_motion(count):
    """A platform that turns about one axis only, for however long."""
    rng = np.random.default_rng(7)
    turns = np.outer(0.05 * np.sin(0.1 * np.arange(count)), [0.0, 0.0, 1.0])
    by_scan = turns + 1.4e-3 * rng.standard_normal((count, 3))
    by_gyro = rot(0, 0, 90).inv().apply(turns + 1e-4 * rng.standard_normal((count, 3)))
    spans = START + 10**8 * np.column_stack([np.arange(count), np.arange(count) + 1])
    nothing = part(moving(), slice(0))
    assert scans_problems(spans, by_scan, by_gyro, nothing, ImuConfig()) == ()


def test_lost_tracks_do_not_mislead(walk):
    imu, spans, by_scan = walk
    by_scan = by_scan.copy()
    by_scan[[10, 30, 50]] += [0.4, 0.2, 0.7]
    assert said((imu, spans, by_scan)) == ""
    assert "[0, 0, 90]" in said((imu, spans, by_scan), mounted=(0, 0, 90))


# -- by the samples alone --------------------------------------------------------------------------


def told_of(samples, rest=None):
    return " ".join(samples_problems(samples, CONFIG, rest))


def test_good_samples_are_left_alone():
    for seconds in (0.0, 1.0, 8.0):
        assert told_of(moving(seconds)) == ""
    assert told_of(resting()) == ""
    assert told_of(moving(8.0, orientation=False)) == ""


@pytest.mark.parametrize(
    ("factor", "told"),
    [(1 / 9.81, "multiples of gravity"), (0.3, "taken off"), (1.8, "check its unit"), (1.2, "")],
)
def test_units_of_the_acceleration_are_named(factor, told):
    found = told_of(replace(moving(), acceleration=factor * moving().acceleration))
    assert told in found if told else found == ""


@pytest.mark.parametrize(("count", "told"), [(80, False), (120, True)])
def test_a_burst_of_acceleration_is_a_fault(count, told):
    samples = moving()
    samples.acceleration[100 : 100 + count] += [160.0, 0.0, 0.0]
    assert ("above 3 g for 0." in told_of(samples)) is told


@pytest.mark.parametrize(("count", "told"), [(180, False), (220, True)])
def test_sensors_that_repeat_their_values_are_frozen(count, told):
    samples = moving()
    samples.gyro[300 : 300 + count] = samples.gyro[300]
    samples.acceleration[300 : 300 + count] = samples.acceleration[300]
    assert ("frozen" in told_of(samples)) is told


@pytest.mark.parametrize(
    ("orientation", "gyro", "told"),
    [
        (lambda R: R, lambda g: g, ""),
        (lambda R: R, lambda g: g + 0.03, ""),  # a bias
        (lambda R: Rotation.random(len(R), random_state=1), lambda g: g, "nothing in common"),
        (lambda R: R * rot(0, 0, 90), lambda g: g, "90 degrees apart"),
        (lambda R: R, np.rad2deg, "degrees per second"),
    ],
)
def test_orientation_and_gyro_must_turn_alike(orientation, gyro, told):
    samples = moving(8.0)
    wrong = orientation(Rotation.from_quat(samples.orientation)).as_quat()
    found = told_of(replace(samples, orientation=wrong, gyro=gyro(samples.gyro)))
    assert told in found if told else found == ""


@pytest.mark.parametrize(
    ("wrong", "told"),
    [(rot(0, 0, 90), False), (rot(4, 0, 0), False), (rot(6, 0, 0), True), (rot(180, 0, 0), True)],
)
def test_gravity_and_orientation_are_compared_at_rest(wrong, told):
    orientation = np.tile(wrong.as_quat(), (200, 1))
    report = ImuBuffer(CONFIG, replace(resting(), orientation=orientation)).report
    assert report.orientation == "ahrs"
    assert any("degrees apart" in problem for problem in report.problems) is told


@pytest.mark.parametrize(("degrees", "told"), [(0.0, False), (180.0, True)])
def test_without_a_rest_they_are_compared_in_the_mean(degrees, told):
    """Over 20 s, 1 m/s^2 or 6 degrees in the mean may be a change of speed."""
    samples = moving(20.0)
    world_R_lidar = Rotation.from_quat(samples.orientation)
    force = world_R_lidar.inv().apply([1.0, 0.0, 9.81])
    seen = rot(degrees, 0, 0) * world_R_lidar
    found = told_of(replace(samples, orientation=seen.as_quat(), acceleration=force))
    assert ("in the mean, up by" in found) is told


def test_a_lidar_that_hangs_upside_down_is_worth_a_word():
    assert "tilted by 180 degrees" in told_of(resting(world_R_lidar=rot(180, 0, 0)))
    assert told_of(resting(world_R_lidar=rot(40, 0, 0))) == ""
