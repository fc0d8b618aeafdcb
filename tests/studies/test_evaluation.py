"""Trajectory errors: closed forms, degenerate paths, and evo where it is installed."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from support.quick import QUICK
from support.trajectories import disturbed, moved, straight, winding

from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import run
from loam_gtsam.studies.evaluation import (
    absolute_error,
    align_positions,
    align_rotations,
    nees,
    path_lengths,
    pose_differences,
    relative_error,
)
from loam_gtsam.types import FrameStatus, InputError, Trajectory

LATERAL = np.array([0.0, 1.0, 1.0])


def pose(rng, size=1.0):
    return gtsam.Pose3.Expmap(rng.normal(size=6) * size).matrix()


def rotation(*vector):
    return gtsam.Rot3.Expmap(np.array(vector, dtype=float)).matrix()


def changed(trajectory, poses):
    return Trajectory(trajectory.stamps, poses)


@pytest.mark.parametrize("seed", range(5))
def test_align_recovers_a_rigid_transform(seed):
    rng = np.random.default_rng(seed)
    truth, points = pose(rng, 3.0), rng.normal(size=(30, 3)) * [50, 10, 1]
    found = align_positions(points, points @ truth[:3, :3].T + truth[:3, 3])
    np.testing.assert_allclose(found, truth, atol=1e-11)
    # The positions decide alone, whatever is offered for what they leave open.
    np.testing.assert_array_equal(
        align_positions(points, points @ truth[:3, :3].T + truth[:3, 3], rotation(1, 2, 3)), found
    )
    assert np.linalg.det(align_positions(points, points * [1, 1, -1])[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(5))
def test_on_a_line_the_roll_comes_from_the_offered_rotation(seed):
    truth = pose(np.random.default_rng(seed), 2.0)
    line = np.linspace(0, 300, 40)[:, None] * [0.6, 0.8, 0.0]
    line += [100.0, 0, 3]
    moved = line @ truth[:3, :3].T + truth[:3, 3]
    np.testing.assert_allclose(align_positions(line, moved, truth[:3, :3]), truth, atol=1e-5)
    anyhow = align_positions(line, moved)
    np.testing.assert_allclose(anyhow[:3, :3] @ anyhow[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(anyhow[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(line @ anyhow[:3, :3].T + anyhow[:3, 3], moved, atol=1e-5)


def test_without_motion_the_rotation_is_the_offered_one():
    still, there = np.zeros((5, 3)), np.tile([1.0, 2, 3], (5, 1))
    np.testing.assert_allclose(align_positions(still, there)[:3, :3], np.eye(3), atol=1e-15)
    found = align_positions(still, there, rotation(0.1, 0.2, 0.3))
    np.testing.assert_allclose(found[:3, :3], rotation(0.1, 0.2, 0.3), atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], [1, 2, 3], atol=1e-15)


def test_align_rotations_recovers_a_turn_and_averages():
    rng = np.random.default_rng(3)
    some = np.array([pose(rng)[:3, :3] for _ in range(20)])
    turn = rotation(0.3, -1.0, 2.0)
    np.testing.assert_allclose(align_rotations(some, turn @ some), turn, atol=1e-12)
    # Offsets of +a and -a about one axis average to none.
    offsets = np.array([rotation(0, 0, 0.2), rotation(0, 0, -0.2)])
    np.testing.assert_allclose(align_rotations(some[:2], offsets @ some[:2]), np.eye(3), atol=1e-12)


def test_interpolation_of_constant_velocity_and_rotation_is_exact():
    rate, velocity = np.array([0.3, -0.2, 0.5]), np.array([10.0, -2.0, 0.5])
    stamps = 1_700_000_000_000_000_000 + np.array([0, 1, 3, 4]) * 100_000_000

    def at(stamps_):
        seconds = (stamps_ - stamps[0]) * 1e-9
        poses = np.tile(np.eye(4), (len(seconds), 1, 1))
        poses[:, :3, :3] = [rotation(*(rate * s)) for s in seconds]
        poses[:, :3, 3] = np.outer(seconds, velocity)
        return Trajectory(stamps_, poses)

    between = stamps[0] + np.array([0, 33_333_333, 250_000_001, 400_000_000])
    found = at(stamps).at(between)
    np.testing.assert_array_equal(found.stamps, between)
    np.testing.assert_allclose(found.map_T_lidar, at(between).map_T_lidar, atol=1e-12)


@pytest.mark.parametrize("outside", [-1, 1_000_000_001])
def test_interpolation_ends_where_the_trajectory_ends(outside):
    some = winding(11)
    start = some.stamps[0]
    assert len(some.at(start + np.array([0, 1_000_000_000]))) == 2
    with pytest.raises(InputError, match=f"expected stamps from {start} to {some.stamps[-1]} ns"):
        some.at(start + np.array([5, outside]))


@pytest.mark.parametrize(
    ("stamps", "message"),
    [
        ([0, 1, 1, 2], "increasing stamps, got 1 at index 2"),
        ([0, 2, 1, 3], "increasing stamps, got 1 at index 2"),
        ([], "2 or more poses .* got 0"),
        ([7], "2 or more poses .* got 1"),
    ],
)
def test_a_reference_that_cannot_be_interpolated_is_refused(stamps, message):
    bad = Trajectory(np.array(stamps, np.int64), np.tile(np.eye(4), (len(stamps), 1, 1)))
    with pytest.raises(InputError, match=f"Trajectory.at: expected {message}"):
        bad.at(1)
    with pytest.raises(InputError, match=f"absolute_error: expected {message}"):
        absolute_error(winding(), bad)


def test_a_rigid_change_is_no_error_unless_unaligned():
    truth = winding()
    error = absolute_error(moved(truth), truth)
    assert error.maximum < 1e-11
    assert error.rotation_rmse_deg < 1e-5
    np.testing.assert_allclose(error.aligned.map_T_lidar, truth.map_T_lidar, atol=1e-9)
    raw = absolute_error(moved(truth), truth, aligned=False)
    assert raw.rmse > 1.0
    np.testing.assert_array_equal(raw.aligned.map_T_lidar, moved(truth).map_T_lidar)
    assert raw.rotation_rmse_deg > 10.0


def test_known_offsets_give_known_numbers():
    truth = winding(4)
    poses = truth.map_T_lidar.copy()
    poses[:, 2, 3] += [0.0, 0.1, 0.2, -0.4]
    poses[2, :3, :3] = poses[2, :3, :3] @ rotation(0, 0, np.radians(2.0))
    error = absolute_error(changed(truth, poses), truth, aligned=False)
    np.testing.assert_allclose(error.translations, [0, 0.1, 0.2, 0.4], atol=1e-12)
    np.testing.assert_array_equal(error.stamps, truth.stamps)
    assert error.rmse == pytest.approx(np.sqrt(0.21 / 4))
    assert error.median == pytest.approx(0.15)
    assert error.maximum == pytest.approx(0.4)
    assert error.rotation_rmse_deg == pytest.approx(1.0)


def test_the_reference_is_interpolated_and_what_lies_outside_is_left_out():
    truth = straight(21)
    stamps = truth.stamps[:-1] + 50_000_000
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 0, 3] = np.arange(20) + 0.5
    inner = truth[5:9]
    error = absolute_error(Trajectory(stamps, poses), inner, aligned=False)
    np.testing.assert_array_equal(error.stamps, stamps[5:8])
    assert error.maximum < 1e-12
    with pytest.raises(InputError, match=r"3 or more poses .* got 2"):
        absolute_error(Trajectory(stamps[:7], poses[:7]), inner)


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-2])
def test_on_a_straight_path_the_orientation_error_is_that_of_the_orientations(noise):
    """Positions on a line do not say how far one path is rolled against the other."""
    truth = straight(50)
    rng = np.random.default_rng(7)
    poses = truth.map_T_lidar.copy()
    poses[:, :3, 3] += LATERAL * rng.normal(0, noise, (50, 3))
    wobble = np.where(np.arange(50) % 2, 1.0, -1.0) * np.radians(0.5)
    poses[:, :3, :3] = [rotation(angle, 0, 0) for angle in wobble]
    turned = pose(rng, 2.0) @ poses  # a gauge that must not matter
    error = absolute_error(changed(truth, turned), truth)
    assert error.rotation_rmse_deg == pytest.approx(0.5, rel=1e-6)
    assert error.rmse <= np.sqrt(2) * noise * 1.3 + 1e-6


def test_a_standstill_has_no_error():
    still = Trajectory(np.arange(5), np.tile(np.eye(4), (5, 1, 1)))
    error = absolute_error(moved(still), still)
    assert error.maximum < 1e-12
    assert error.rotation_rmse_deg < 1e-5


def test_absolute_errors_are_those_of_evo():
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    truth = winding()
    ours = moved(disturbed(truth))

    def theirs(some):
        stamps = some.stamps * 1e-9
        return trajectory.PoseTrajectory3D(poses_se3=list(some.map_T_lidar), timestamps=stamps)

    def evo_rmse(relation, aligned):
        reference, estimate = theirs(truth), theirs(ours)
        if aligned:
            estimate.align(reference)
        metric = metrics.APE(relation)
        metric.process_data((reference, estimate))
        return metric.get_statistic(metrics.StatisticsType.rmse)

    part, angle = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg
    error, raw = absolute_error(ours, truth), absolute_error(ours, truth, aligned=False)
    assert error.rmse == pytest.approx(evo_rmse(part, True), rel=1e-9)
    assert raw.rmse == pytest.approx(evo_rmse(part, False), rel=1e-9)
    assert raw.rotation_rmse_deg == pytest.approx(evo_rmse(angle, False), rel=1e-6)
    # Fitted to the orientations themselves, these are at least as near as evo leaves them.
    assert error.rotation_rmse_deg <= evo_rmse(angle, True)
    assert error.rotation_rmse_deg == pytest.approx(evo_rmse(angle, True), rel=0.1)


def test_relative_error_of_known_drifts():
    scaled = relative_error(straight(scale=1.01), straight(), np.array([9.5, 19.5]))
    # 9.5 m end at the pose 10 m on, where the error is 1 % of 10 m.
    np.testing.assert_allclose(scaled.translations, [100 * 0.1 / 9.5, 100 * 0.2 / 19.5])
    np.testing.assert_allclose(scaled.rotations, 0.0, atol=1e-7)
    np.testing.assert_array_equal(scaled.pairs, [190, 180])
    pooled = np.average(scaled.translations, weights=scaled.pairs)
    assert scaled.translation_percent == pytest.approx(pooled)
    turning = relative_error(straight(yaw_per_step=0.01), straight(), np.array([9.5]))
    assert turning.rotation_deg_per_m == pytest.approx(np.degrees(0.1) / 9.5)


def test_relative_error_is_that_of_the_kitti_kit_with_every_start():
    truth, estimate = winding(60), disturbed(winding(60))
    lengths = np.array([5.0, 10.0, 20.0])
    steps = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
    travelled = np.r_[0.0, np.cumsum(steps)]
    translations, rotations = [], []
    for length in lengths:
        for i in range(len(truth)):
            j = next((k for k in range(i, 60) if travelled[k] > travelled[i] + length), None)
            if j is None:
                continue
            wanted = np.linalg.inv(truth.map_T_lidar[i]) @ truth.map_T_lidar[j]
            found = np.linalg.inv(estimate.map_T_lidar[i]) @ estimate.map_T_lidar[j]
            error = np.linalg.inv(found) @ wanted
            translations.append(np.linalg.norm(error[:3, 3]) / length)
            rotations.append(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)) / length)
    result = relative_error(estimate, truth, lengths)
    assert result.pairs.sum() == len(translations)
    assert result.translation_percent == pytest.approx(100 * np.mean(translations), rel=1e-9)
    assert result.rotation_deg_per_m == pytest.approx(np.degrees(np.mean(rotations)), rel=1e-6)


@pytest.mark.parametrize(
    ("path", "unit"), [(1600.0, 100.0), (5000.0, 100.0), (1599.0, 50.0), (21.4, 1.0), (1.6, 0.1)]
)
def test_lengths_fit_the_path(path, unit):
    np.testing.assert_allclose(path_lengths(path), unit * np.arange(1, 9))


def test_a_short_path_needs_lengths():
    short = winding(15, step=0.1)
    with pytest.raises(InputError, match=r"path of 1\.6 m or more is needed .* has 1\.4 m"):
        relative_error(short, short)
    assert relative_error(short, short, np.array([0.5])).pairs[0] > 0
    with pytest.raises(InputError, match=r"lengths below the path of 1\.4 m, got 3"):
        relative_error(short, short, np.array([3.0]))
    # One length that fits is enough; the other one has no number.
    both = relative_error(disturbed(short), short, np.array([0.5, 3.0]))
    assert np.isnan(both.translations[1])
    assert both.translation_percent == both.translations[0]


def test_relative_error_needs_poses_in_common():
    later = Trajectory(winding().stamps + 10**12, winding().map_T_lidar)
    for metric in (relative_error, pose_differences):
        with pytest.raises(InputError, match="3 or more poses"):
            metric(later, winding())


def test_pose_differences_are_seen_from_the_first_common_pose():
    truth = winding()
    _, metres, degrees = pose_differences(moved(truth), truth)
    assert len(metres) == len(truth)
    np.testing.assert_allclose(metres, 0.0, atol=1e-9)
    np.testing.assert_allclose(degrees, 0.0, atol=1e-5)
    poses = truth.map_T_lidar.copy()
    poses[5] = poses[5] @ gtsam.Pose3(gtsam.Rot3.Yaw(0.1), [0.3, 0.0, 0.4]).matrix()
    _, metres, degrees = pose_differences(Trajectory(truth.stamps, poses), truth)
    np.testing.assert_allclose(metres[4:7], [0.0, 0.5, 0.0], atol=1e-9)
    np.testing.assert_allclose(degrees[4:7], [0.0, np.degrees(0.1), 0.0], atol=1e-5)


def test_relative_errors_are_those_of_evo():
    metrics = pytest.importorskip("evo.core.metrics")
    evo_path = pytest.importorskip("evo.core.trajectory").PosePath3D
    truth, estimate = winding(), moved(disturbed(winding()))
    reference, other = (evo_path(poses_se3=list(t.map_T_lidar)) for t in (truth, estimate))
    for length in (4.6, 9.6):
        # evo takes the nearest pose, KITTI the first beyond: with steps just below 1 m these are
        # one and the same for the lengths here.
        found = relative_error(estimate, truth, np.array([length]))
        for relation, ours in (
            (metrics.PoseRelation.translation_part, found.translations[0] * length / 100.0),
            (metrics.PoseRelation.rotation_angle_deg, found.rotations[0] * length),
        ):
            rpe = metrics.RPE(relation, length, metrics.Unit.meters, 0.5 / length, True, True)
            rpe.process_data((reference, other))
            assert len(rpe.error) == found.pairs[0]
            assert ours == pytest.approx(float(np.mean(rpe.error)), rel=1e-6)


def test_a_covariance_that_is_not_positive_definite_does_not_improve_the_nees():
    world = SimulatedWorld("room", frames=5, columns=180, sensor="vlp16")
    updates, truth = [*run(world, QUICK).updates], world.truth
    good = nees(updates, truth)
    last = updates[-1]
    updates[-1] = replace(last, covariance=-last.covariance)
    bad = nees(updates, truth)
    assert (good.broken, bad.broken) == (0, 1)
    assert np.isfinite(good.mean)
    assert bad.mean == np.inf
    assert len(updates) - 1 in bad.beyond


def test_what_is_lost_before_the_first_fix_of_a_localisation_has_no_error():
    world = SimulatedWorld("room", frames=6, columns=180, sensor="vlp16")
    updates = run(world, QUICK).updates
    nowhere = {"status": FrameStatus.LOST, "map_T_lidar": gtsam.Pose3()}
    lost = [replace(update, **nowhere) for update in updates[:2]]
    found = nees([*lost, *updates[2:]], world.truth)
    assert found.mean == nees(updates[2:], world.truth).mean
    assert found.frames.tolist() == [3, 4, 5]


def test_poses_that_are_no_numbers_have_no_error():
    truth = winding()
    poses = truth.map_T_lidar.copy()
    poses[1] = np.nan
    for error in (absolute_error, relative_error):
        with pytest.raises(InputError, match="expected poses of finite numbers, got 1 of"):
            error(changed(truth, poses), truth)
        with pytest.raises(InputError, match=r"a reference with .* got 1 of .* leave them out"):
            error(truth, changed(truth, poses))
