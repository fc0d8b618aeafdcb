"""De-skew against motion known in closed form: by gyro, by orientation, by constant velocity."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loam_gtsam.config import Config, DeskewConfig, MapConfig
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.geometry import move_points
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.types import Features, ImuSamples, SweepMotion

START = 1_700_000_000_000_000_000
SWEEP = START + 500_000_000
PERIOD = 0.1
VELOCITY = np.array([5.0, -3.0, 1.0])
"""m/s in the map: constant, as MovingSweep takes it to be within a sweep."""
MOTIONS = {"auto": SweepMotion.GYRO, "orientation": SweepMotion.ORIENTATION}
# Between samples 5 ms apart attitudes are interpolated; 9 rad/s^2 make that 3e-5 rad.
LIMITS = {"auto": 2e-4, "orientation": 2e-3}


def attitude(seconds):
    """map_R_lidar: up to 3 rad/s about moving axes."""
    seconds = np.asarray(seconds, dtype=np.float64)
    yaw = 1.0 * np.sin(2.5 * seconds + 0.3)
    pitch = 0.3 * np.sin(3.5 * seconds + 1.1)
    roll = 0.4 * np.sin(3.0 * seconds + 2.0)
    return Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1))


def imu_samples(first=0.0, end=1.2):
    """At 200 Hz; seconds are from START."""
    times = np.arange(round(200 * first), round(200 * end)) / 200.0
    step = 1e-5
    gyro = (attitude(times - step).inv() * attitude(times + step)).as_rotvec() / (2 * step)
    stamps = START + np.round(times * 1e9).astype(np.int64)
    return ImuSamples(stamps, attitude(times).as_quat(), gyro, np.zeros((len(times), 3)))


def config(rotation="auto", **deskew):
    none = MapConfig(edge_voxel=0.01, plane_voxel=0.01)
    return Config(deskew=DeskewConfig(rotation=rotation, **deskew), map=none)


def buffer(samples=None, wanted=None):
    return ImuBuffer((wanted or config()).imu, samples or imu_samples())


def pose_at(seconds):
    """map_T_lidar so many seconds after START."""
    return gtsam.Pose3(gtsam.Rot3(attitude(seconds).as_matrix()), VELOCITY * seconds)


def sweep(reference=0.0, *, count=300, stamp=SWEEP, times=None):
    """Features of a sweep, its reference time so far on its way, and the planes in the map."""
    rng = np.random.default_rng(0)
    span = (-reference * PERIOD, (1.0 - reference) * PERIOD)
    map_points = 30.0 * rng.uniform(-1, 1, (count, 3))
    own = rng.uniform(*span, count) if times is None else times
    then = (stamp - START) * 1e-9 + own
    points = attitude(then).inv().apply(map_points - np.outer(then, VELOCITY))
    features = Features.from_points(stamp, points[: count // 2], points)
    return replace(features, edge_times=own[: count // 2], plane_times=own, span=span), map_points


def twist_at(seconds):
    """Body velocity; its rotation does not count where there is an IMU."""
    return np.concatenate([np.full(3, 9.9), attitude(seconds).inv().apply(VELOCITY)])


def in_order(points):
    return points[np.lexsort(points.T.round(2))]


def largest_error(moving, map_points, twist):
    """Metres between the de-skewed plane points and the truth, seen from the middle."""
    middle = pose_at((moving.stamp - START) * 1e-9).inverse().matrix()
    expected = map_points @ middle[:3, :3].T + middle[:3, 3]
    planes = moving.at(twist).points[1]
    distances = np.linalg.norm(planes[:, None] - expected[None], axis=2)
    return distances.min(axis=1).max()


@pytest.mark.parametrize("rotation", MOTIONS)
@pytest.mark.parametrize("reference", [0.0, 0.5, 1.0])
def test_a_known_motion_is_undone(rotation, reference):
    """Points up to 50 m away; without the rotation they are metres off."""
    wanted = config(rotation)
    features, truth = sweep(reference)
    moving = MovingSweep(features, wanted, buffer())
    assert moving.motion is MOTIONS[rotation]
    as_measured = MovingSweep(features, config(enabled=False))
    assert largest_error(as_measured, truth, np.zeros(6)) > 1.0
    twist = twist_at((moving.reference_stamp - START) * 1e-9)
    assert largest_error(moving, truth, twist) < LIMITS[rotation]
    again = MovingSweep(features, wanted, buffer())
    assert again.at(twist).points[1].tobytes() == moving.at(twist).points[1].tobytes()


def test_a_posed_sweep_stays_what_it_is():
    moving = MovingSweep(sweep()[0], config(), buffer())
    first = moving.at(twist_at(0.5))
    before = first.points[1].copy()
    assert not np.array_equal(moving.at(np.zeros(6)).points[1], before)
    np.testing.assert_array_equal(first.points[1], before)
    with pytest.raises(AttributeError):
        first.twist = np.zeros(6)


@pytest.mark.parametrize("rotation", MOTIONS)
def test_some_points_are_de_skewed_as_all_are(rotation):
    moving = MovingSweep(sweep()[0], config(rotation), buffer())
    posed = moving.at(twist_at((moving.reference_stamp - START) * 1e-9))
    rows = np.arange(moving.n_planes)[::7]
    edges, planes = posed.rows(np.empty(0, np.int64), rows)
    assert edges.shape == (0, 3)
    np.testing.assert_allclose(planes, posed.points[1][rows], atol=1e-12)


@pytest.mark.parametrize("rotation", MOTIONS)
@pytest.mark.parametrize("reference", [0.0, 0.5, 1.0])
def test_poses_between_middle_and_reference_are_those_of_the_motion(rotation, reference):
    moving = MovingSweep(sweep(reference)[0], config(rotation), buffer())
    middle = pose_at((moving.stamp - START) * 1e-9)
    there = pose_at((moving.reference_stamp - START) * 1e-9)
    twist = twist_at((moving.reference_stamp - START) * 1e-9)
    found = middle.compose(moving.middle_T_reference(twist))
    assert np.abs(there.localCoordinates(found)).max() < 1e-4
    # and the way back: the velocity between two middles
    last = (moving.stamp - 100_000_000, pose_at((moving.stamp - START) * 1e-9 - 0.1))
    np.testing.assert_allclose(moving.twist_since(last, middle)[3:], twist[3:], atol=1e-3)
    before, after = (attitude((moving.stamp - START) * 1e-9 + s) for s in (-0.05, 0.05))
    mean = (before.inv() * after).as_rotvec() / PERIOD
    np.testing.assert_allclose(moving.twist_since(last, middle)[:3], mean, atol=0.02)


def test_a_bias_of_the_gyro_is_taken_off():
    samples = imu_samples()
    samples.gyro[:] += [0.05, -0.1, 0.2]
    imu = buffer(samples)
    features, truth = sweep()
    errors = []
    for bias in (np.zeros(3), np.array([0.05, -0.1, 0.2])):
        imu.gyro_bias = bias
        moving = MovingSweep(features, config(), imu)
        errors.append(largest_error(moving, truth, twist_at(0.5)))
    assert errors[0] > 0.1
    assert errors[1] < LIMITS["auto"]


def test_a_sweep_may_be_turned_anew_once_the_bias_is_known():
    imu = buffer()
    features, _ = sweep()
    path = np.array([-0.1, 0.0, 0.1]), np.array([[0.0, 0.1, 0.0], [0.0] * 3, [0.1, 0.0, 0.2]])
    before, alone = MovingSweep(features, config(), imu), MovingSweep(features, config())
    imu.gyro_bias = np.array([0.05, -0.1, 0.2])
    known, twist = MovingSweep(features, config(), imu), twist_at(0.5)
    assert not same(before, known, twist)
    assert same(before.turned_anew(imu), known, twist)
    assert same(before.bent(*path).turned_anew(imu), known.bent(*path), twist)
    here, there = (one.middle_T_reference(twist) for one in (before.turned_anew(imu), known))
    assert here.equals(there, 0.0)
    assert alone.turned_anew(imu) is alone


def without_imu(features, wanted=None):
    return MovingSweep(features, wanted or config())


def same(a, b, twist):
    return all(map(np.array_equal, a.at(twist).points, b.at(twist).points))


@pytest.mark.parametrize("rotation", MOTIONS)
@pytest.mark.parametrize(
    ("first", "end", "covers"),
    [
        (0.45, 0.65, True),
        (0.5, 0.61, True),
        (0.51, 1.0, False),  # it begins within the sweep
        (0.2, 0.45, False),  # it ends long before the end of the sweep
        (0.2, 0.59, True),  # it ends just before it
        (0.7, 1.0, False),
    ],
)
def test_an_imu_that_does_not_cover_the_sweep_leaves_constant_velocity(
    rotation, first, end, covers
):
    wanted = config(rotation)
    features, _ = sweep()
    moving = MovingSweep(features, wanted, buffer(imu_samples(first, end)))
    assert moving.motion is (MOTIONS[rotation] if covers else SweepMotion.CONSTANT_VELOCITY)
    twist = np.array([0.2, -0.3, 1.0, 8.0, -2.0, 0.5])
    assert same(moving, without_imu(features), twist) is not covers


@pytest.mark.parametrize("rotation", MOTIONS)
@pytest.mark.parametrize(("missing", "covers"), [(0.03, True), (0.12, False)])
def test_a_gap_within_a_long_sweep_counts(rotation, missing, covers):
    samples = imu_samples()
    kept = np.abs((samples.stamps - SWEEP) * 1e-9 - 0.1) > 0.5 * missing
    samples = ImuSamples(*(getattr(samples, name)[kept] for name in
                           ("stamps", "orientation", "gyro", "acceleration")))  # fmt: skip
    features = replace(sweep()[0], span=(0.0, 0.5))
    moving = MovingSweep(features, config(rotation), buffer(samples))
    assert moving.motion is (MOTIONS[rotation] if covers else SweepMotion.CONSTANT_VELOCITY)


def test_points_beyond_the_stated_span_must_be_covered_too():
    features, _ = sweep(times=np.linspace(0.0, 0.3, 300))
    features = replace(features, span=(0.0, 0.1))
    for rotation, motion in MOTIONS.items():
        short = MovingSweep(features, config(rotation), buffer(imu_samples(end=0.65)))
        assert short.motion is SweepMotion.CONSTANT_VELOCITY
        assert MovingSweep(features, config(rotation), buffer()).motion is motion


def test_samples_without_an_orientation_are_interpolated_over():
    samples = imu_samples()
    samples.orientation[108:111] = np.nan
    features, truth = sweep()
    moving = MovingSweep(features, config("orientation"), buffer(samples))
    assert moving.motion is SweepMotion.ORIENTATION
    assert largest_error(moving, truth, twist_at(0.5)) < 0.05


def test_the_configuration_may_leave_the_imu_out():
    features, _ = sweep()
    moving = MovingSweep(features, config("constant_velocity"), buffer())
    assert moving.motion is SweepMotion.CONSTANT_VELOCITY
    twist = np.array([0.2, -0.3, 1.0, 8.0, -2.0, 0.5])
    assert same(moving, without_imu(features), twist)
    expected = move_points(features.planes, twist, features.plane_times - 0.05)
    assert np.abs(in_order(moving.at(twist).points[1]) - in_order(expected)).max() < 1e-9


def test_without_an_imu_a_screw_motion_is_undone():
    """The pose at the reference time, too, is that of the constant body velocity."""
    twist = np.array([0.2, -0.3, 1.0, 8.0, -2.0, 0.5])
    moving = without_imu(sweep(1.0)[0])
    expected = gtsam.Pose3.Expmap(0.05 * twist)
    assert moving.middle_T_reference(twist).equals(expected, 1e-12)
    last = moving.stamp - 100_000_000, gtsam.Pose3()
    found = moving.twist_since(last, gtsam.Pose3.Expmap(0.1 * twist))
    np.testing.assert_allclose(found, twist, atol=1e-9)


@pytest.mark.parametrize("imu", [None, "gyro"])
def test_what_does_not_move_is_left_alone(imu):
    imu = None if imu is None else buffer()
    features, _ = sweep()
    off = MovingSweep(features, config(enabled=False), imu)
    still = MovingSweep(replace(features, span=(0.0, 0.0)), config(), imu)
    for moving in (off, still):
        assert moving.motion is SweepMotion.NONE
        assert moving.stamp == moving.reference_stamp == features.stamp
        as_measured = moving.at(np.zeros(6)).points[1]
        np.testing.assert_array_equal(moving.at(np.ones(6)).points[1], as_measured)
        assert moving.middle_T_reference(np.ones(6)).equals(gtsam.Pose3(), 0.0)


@pytest.mark.parametrize("reference", [0.0, 0.3, 1.0])
def test_without_an_imu_a_velocity_that_changes_steadily_is_undone(reference):
    """Points and pose; of a constant velocity the points at the ends are centimetres off."""
    twist = np.array([0.2, -0.3, 0.5, 8.0, -2.0, 0.5])
    acceleration = np.array([2.0, -3.0, 1.0, 6.0, 4.0, -5.0])
    features, _ = sweep(reference)
    seconds = features.plane_times - (0.5 - reference) * PERIOD
    planes = np.array([
        gtsam.Pose3.Expmap(twist * t + 0.5 * acceleration * t**2).transformTo(point)
        for t, point in zip(seconds, features.planes, strict=True)
    ])  # fmt: skip
    steady = without_imu(replace(features, planes=planes))
    moving = steady.accelerated(acceleration)
    expected = in_order(features.planes)
    found = in_order(moving.at(twist).points[1])
    assert np.abs(found - expected).max() < 2e-3
    assert np.abs(in_order(steady.at(twist).points[1]) - expected).max() > 0.03
    back = (reference - 0.5) * PERIOD
    pose = gtsam.Pose3.Expmap(twist * back + 0.5 * acceleration * back**2)
    assert moving.at(twist).middle_T_reference.equals(pose, 1e-12)


def test_what_an_imu_knows_or_does_not_move_is_not_accelerated():
    features, _ = sweep()
    for known in (
        MovingSweep(features, config(), buffer()),
        without_imu(replace(features, span=(0.0, 0.0))),
    ):
        assert known.accelerated(np.ones(6)) is known
