"""Values refuse what they cannot be, and say what they expected and what came."""

import gtsam
import numpy as np
import pytest

from loam_gtsam.types import Features, FrameStatus, InputError, MapUpdate, Scan, Trajectory

POINTS = np.zeros((6, 3), np.float32)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"points": np.zeros((6, 4), np.float32)}, r"Scan.points: expected an \(N, 3\).*\(6, 4\)"),
        ({"points": np.zeros(3)}, r"Scan.points.*\(3,\)"),
        ({"points": [[0.0, 0.0, 0.0]]}, "Scan.points.*list"),
        ({"points": np.zeros((6, 3), np.int64)}, "Scan.points: expected a float dtype.*int64"),
        ({"times": np.zeros(5)}, r"Scan.times: expected shape \(6,\).*\(5,\)"),
        ({"times": np.zeros(6, np.int32)}, "Scan.times: expected a float dtype.*int32"),
        ({"rings": np.zeros((6, 1), np.uint8)}, r"Scan.rings.*\(6, 1\)"),
        ({"rings": np.zeros(6)}, "Scan.rings: expected an integer dtype.*float64"),
        ({"stamp": 0.1}, "Scan.stamp: expected integer nanoseconds, got 0.1"),
        ({"rows": 4}, "Scan.rows: 6 points do not divide into 4 rows"),
    ],
)
def test_a_scan_of_wrong_shape_or_dtype_is_refused(fields, message):
    with pytest.raises(InputError, match=message):
        Scan(**({"points": POINTS, "stamp": 0} | fields))


def test_a_scan_takes_what_fits():
    scan = Scan(POINTS, 5, np.zeros(6), np.zeros(6, np.uint16), rows=3)
    assert scan.stamp == 5
    assert len(Scan(POINTS[:0], 0).points) == 0


@pytest.mark.parametrize("bad", [np.zeros((4, 2)), np.zeros((4, 3), np.int32), [[0.0, 0.0, 0.0]]])
def test_features_of_wrong_shape_or_dtype_are_refused(bad):
    good = np.zeros((4, 3))
    with pytest.raises(InputError, match="edges: expected"):
        Features.from_points(0, bad, good)
    with pytest.raises(InputError, match="planes: expected"):
        Features.from_points(0, good, bad)


def test_a_trajectory_needs_one_pose_per_stamp():
    with pytest.raises(InputError, match=r"\(3, 4, 4\), got \(2, 4, 4\)"):
        Trajectory(np.arange(3), np.zeros((2, 4, 4)))


def test_length_of_a_trajectory():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = [[0, 0, 0], [3, 4, 0], [3, 4, 12]]
    assert Trajectory(np.arange(3), poses).path_length == pytest.approx(17.0)


def test_raw_covariance_is_the_inverse_of_the_information_of_a_solved_frame():
    information = np.diag([1.0, 2.0, 4.0, 5.0, 8.0, 10.0])
    solved = MapUpdate(0, gtsam.Pose3(), FrameStatus.OK, information=information)
    np.testing.assert_allclose(np.diag(solved.raw_covariance), [1, 0.5, 0.25, 0.2, 0.125, 0.1])
    unsolved = MapUpdate(0, gtsam.Pose3(), FrameStatus.FIRST, information=information)
    singular = MapUpdate(0, gtsam.Pose3(), FrameStatus.OK)
    assert np.isnan(unsolved.raw_covariance).all()
    assert np.isnan(singular.raw_covariance).all()
