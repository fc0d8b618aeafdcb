"""Values refuse what they cannot be, and say what they expected and what came."""

import gtsam
import numpy as np
import pytest

from loam_gtsam.types import (
    BadSweep,
    Features,
    FeatureSweep,
    FrameStatus,
    ImuSamples,
    InputError,
    MapUpdate,
    Scan,
    Trajectory,
)

POINTS = np.zeros((6, 3), np.float32)


def features_at(stamp):
    return Features.from_points(stamp, POINTS, POINTS)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"points": np.zeros((6, 4))}, r"Scan.points: expected \(N, 3\) floats.*\(6, 4\)"),
        ({"points": np.zeros(3)}, r"Scan.points.*\(3,\)"),
        ({"points": np.ma.array(np.zeros((6, 3)))}, r"Scan.points: .*without a mask.*filled"),
        ({"points": "cloud"}, "Scan.points.*str"),
        ({"points": np.zeros((6, 4))}, r"Scan.points: .*; \[:, :3\] takes the first three columns"),
        ({"points": np.zeros((6, 3), np.int64)}, "Scan.points: expected .* floats, got .*int64"),
        ({"times": np.zeros(5)}, r"Scan.times: expected \(6,\) floats.*\(5,\)"),
        ({"times": np.zeros(6, np.int32)}, "Scan.times: expected .* floats, got .*int32"),
        ({"rings": np.zeros((6, 1), np.uint8)}, r"Scan.rings.*\(6, 1\)"),
        ({"rings": np.zeros(6)}, "Scan.rings: expected .* integers, got .*float64"),
        ({"stamp": 0.1}, "Scan.stamp: expected integer nanoseconds .* got 0.1"),
        ({"rows": 4}, "Scan.rows: 6 points do not divide into 4 rows"),
        ({"rows": -1}, "Scan.rows: expected a number of rows, or 0, got -1"),
        ({"rows": 2.0}, "Scan.rows: expected a number of rows, or 0, got 2.0"),
        ({"stamp": True}, "Scan.stamp: expected integer nanoseconds .* got True"),
        ({"span": (0.1,)}, r"Scan.span: expected \(first, last\) seconds, got \(0.1,\)"),
        ({"span": ("a", "b")}, "Scan.span: expected .* got .'a', 'b'."),
        ({"span": (0.1, (0.2, 0.3))}, "Scan.span: expected"),
    ],
)
def test_a_scan_of_wrong_shape_or_dtype_is_refused(fields, message):
    with pytest.raises(InputError, match=message):
        Scan(**({"points": POINTS, "stamp": 0} | fields))


def test_a_scan_takes_what_fits():
    scan = Scan(POINTS, 5, np.zeros(6), np.zeros(6, np.uint16), rows=3)
    assert scan.stamp == 5
    assert Scan(POINTS, 0, np.zeros(6), span=np.array([0, 0.5])).span == (0.0, 0.5)
    assert len(Scan(POINTS[:0], 0).points) == 0
    listed = Scan([[1.0, 2.0, 3.0]], 0, [0.05], [7])
    assert (listed.points.shape, listed.times.tolist(), listed.rings.tolist()) == (
        (1, 3),
        [0.05],
        [7],
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"stamps": np.arange(5)}, r"ImuSamples.gyro: expected \(5, 3\) numbers, got .*\(6, 3\)"),
        ({"stamps": np.zeros(6)}, r"ImuSamples.stamps: expected .*seconds \* 1e9"),
        ({"orientation": np.zeros((6, 3))}, r"ImuSamples.orientation: expected \(6, 4\)"),
        ({"gyro": None}, r"ImuSamples.gyro: expected \(6, 3\) numbers"),
        ({"gyro": np.ma.array(np.zeros((6, 3)))}, r"ImuSamples.gyro: expected .* without a mask"),
        ({"stamps": np.ma.array(np.arange(6))}, r"ImuSamples.stamps: expected .* without a mask"),
        ({"acceleration": np.zeros(6)}, r"ImuSamples.acceleration: expected \(6, 3\)"),
    ],
)
def test_imu_samples_of_wrong_shape_or_dtype_are_refused(fields, message):
    good = {"stamps": np.arange(6), "orientation": None, "gyro": np.zeros((6, 3))}
    for none in ({}, {"acceleration": None}):
        assert ImuSamples(**(good | none)).acceleration.tolist() == [[0.0, 0.0, 0.0]] * 6
    with pytest.raises(InputError, match=message):
        ImuSamples(**(good | fields))


@pytest.mark.parametrize("bad", [np.zeros((4, 2)), np.zeros((4, 3), np.int32), [[0.0, 0.0, 0.0]]])
def test_features_of_wrong_shape_or_dtype_are_refused(bad):
    good = np.zeros((4, 3))
    with pytest.raises(InputError, match="edges: expected"):
        Features.from_points(0, bad, good)
    with pytest.raises(InputError, match="planes: expected"):
        Features.from_points(0, good, bad)


def test_a_feature_sweep_has_features_and_a_pose():
    features = Features.from_points(0, POINTS, POINTS)
    with pytest.raises(InputError, match=r"odom_T_lidar: expected a gtsam.Pose3, got ndarray"):
        FeatureSweep(features, np.eye(4))
    with pytest.raises(InputError, match="features: expected a Features, got ndarray"):
        FeatureSweep(POINTS, gtsam.Pose3())
    with pytest.raises(InputError, match=r"odom_T_lidar: expected a rotation .* determinant -1"):
        FeatureSweep(features, gtsam.Pose3(np.diag([1.0, 1.0, -1.0, 1.0])))


def test_a_trajectory_needs_one_pose_per_stamp():
    with pytest.raises(InputError, match=r"expected \(3, 4, 4\) numbers, got shape \(2, 4, 4\)"):
        Trajectory(np.arange(3), np.zeros((2, 4, 4)))


def test_a_trajectory_is_made_of_poses_and_knows_the_length_of_its_path():
    positions = [[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 12.0]]
    poses = [gtsam.Pose3(gtsam.Rot3.Rz(0.1), np.array(position)) for position in positions]
    trajectory = Trajectory.from_poses([3, 5, 8], poses)
    assert trajectory.stamps.tolist() == [3, 5, 8]
    np.testing.assert_array_equal(trajectory.map_T_lidar[1], poses[1].matrix())
    assert trajectory.path_length == pytest.approx(17.0)
    assert Trajectory.from_poses([], []).map_T_lidar.shape == (0, 4, 4)


@pytest.mark.parametrize(
    "stamps", [[0.1, 0.2], ["a", "b"], [2**63, 0], [2**70, 0], [[1], [2, 3]], iter([1, 2]), [1]]
)
def test_a_trajectory_is_not_made_of_stamps_that_are_no_integers(stamps):
    with pytest.raises(InputError, match=r"expected .*, got"):
        Trajectory.from_poses(stamps, [gtsam.Pose3()] * 2)


@pytest.mark.parametrize("make", [lambda stamp: BadSweep(stamp, ""), features_at])
def test_the_stamp_of_any_sweep_is_an_integer(make):
    assert type(make(np.uint64(5)).stamp) is int
    for bad in (0.1, None, "0", True):
        with pytest.raises(InputError, match=r"stamp: expected integer nanoseconds .* got"):
            make(bad)


def test_only_the_stamp_of_a_bad_sweep_may_be_out_of_range():
    assert BadSweep(2**63, "damaged").stamp == 2**63
    with pytest.raises(InputError, match=r"Features.stamp: .* up to 2\^62"):
        features_at(2**63)


def test_a_trajectory_is_indexed_iterated_and_asked_for_other_times():
    poses = [gtsam.Pose3(gtsam.Rot3.Rz(0.2 * n), np.array([n, 0.0, 1.0])) for n in range(4)]
    way = Trajectory.from_poses([10, 20, 30, 40], poses)
    np.testing.assert_array_equal(way.positions[:, 0], [0, 1, 2, 3])
    assert all(one.equals(other, 1e-12) for one, other in zip(way, poses, strict=True))
    assert way[-1].equals(poses[3], 1e-12)
    assert way[np.int64(1)].equals(poses[1], 1e-12)
    for which in (slice(1, 3), way.positions[:, 0] % 3 > 0, [1, 2], np.array([1, 2])):
        assert way[which].stamps.tolist() == [20, 30]
    assert way.at(25).equals(gtsam.Pose3(gtsam.Rot3.Rz(0.3), np.array([1.5, 0.0, 1.0])), 1e-9)
    assert way.at([40, 10]).stamps.tolist() == [40, 10]
    assert len(way.at([])) == 0
    with pytest.raises(IndexError):
        way[4]


def test_what_is_no_trajectory_or_no_time_of_it_is_refused():
    way = Trajectory.from_poses([10, 20], [gtsam.Pose3()] * 2)
    with pytest.raises(InputError, match=r"expected stamps from 10 to 20 ns, .* got 21 to 21"):
        way.at(21)
    with pytest.raises(InputError, match=r"Trajectory.at: expected .* integer nanoseconds"):
        way.at(15.0)
    with pytest.raises(InputError, match=r"poses\[0\]: expected a gtsam.Pose3, got ndarray"):
        Trajectory.from_poses([10], [np.eye(4)])
    with pytest.raises(InputError, match=r"Trajectory.stamps: expected .* integer nanoseconds"):
        Trajectory(np.array([0.1]), np.eye(4)[None])


def test_a_trajectory_is_shown_in_a_line():
    way = Trajectory.from_poses([0, 10**9], [gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3(), [3, 4, 0])])
    assert repr(way) == "Trajectory(2 poses: 1.00 s from 0 ns, 5.00 m)"
    assert repr(way[:0]) == "Trajectory(0 poses)"


def test_values_that_hold_arrays_can_be_compared_and_are_equal_only_to_themselves():
    def values():
        poses = Trajectory.from_poses([1, 2], [gtsam.Pose3()] * 2)
        features = Features.from_points(0, np.zeros((2, 3)), np.zeros((2, 3)))
        update = MapUpdate(0, gtsam.Pose3(), FrameStatus.OK)
        return Scan(POINTS.copy(), 0), poses, features, update

    for one, other in zip(values(), values(), strict=True):
        assert one == one
        assert one != other
        assert len({one, other}) == 2


def test_a_frame_is_shown_in_a_line():
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 2.0, 0.1234]))
    update = MapUpdate(7, pose, FrameStatus.LOST, "no fit", n_edges=9, n_plane_matches=3)
    shown = "lost at 7 ns, [1.0, 2.0, 0.123] m, 0 edge and 3 plane matches: no fit"
    assert repr(update) == f"MapUpdate({shown})"


def test_a_frame_has_a_pose_unless_its_stamp_is_bad():
    assert [status for status in FrameStatus if not status.has_pose] == [FrameStatus.BAD_STAMP]


def test_raw_covariance_is_the_inverse_of_the_information_of_a_solved_frame():
    information = np.diag([1.0, 2.0, 4.0, 5.0, 8.0, 10.0])
    solved = MapUpdate(0, gtsam.Pose3(), FrameStatus.OK, information=information)
    np.testing.assert_allclose(np.diag(solved.raw_covariance), [1, 0.5, 0.25, 0.2, 0.125, 0.1])
    unsolved = MapUpdate(0, gtsam.Pose3(), FrameStatus.FIRST, information=information)
    singular = MapUpdate(0, gtsam.Pose3(), FrameStatus.OK)
    assert np.isnan(unsolved.raw_covariance).all()
    assert np.isnan(singular.raw_covariance).all()


def test_a_trajectory_of_matrices_that_are_no_poses_is_refused():
    poses = np.tile(gtsam.Pose3(gtsam.Rot3.Yaw(1.0), [1.0, 2.0, 3.0]).matrix(), (3, 1, 1))
    unknown = poses.copy()
    unknown[:, :3, :3] = np.nan  # positions alone
    unknown[2] = np.nan
    assert len(Trajectory(np.arange(3), unknown)) == 3
    mirrored = poses @ np.diag([1.0, 1.0, -1.0, 1.0])
    for wrong in (poses.transpose(0, 2, 1), 0.0 * poses, 2.0 * poses, mirrored):
        one = np.stack([poses[0], wrong[0], poses[0]])
        with pytest.raises(InputError, match="got 1 others of 3, first at 1; are they transposed"):
            Trajectory(np.arange(3), one)
