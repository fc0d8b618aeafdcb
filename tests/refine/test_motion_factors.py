"""What a run knew of the motion between its sweeps, where it has lost some of them."""

import gtsam
import numpy as np

from loam_gtsam.refine.motion_factors import odometry_factors
from loam_gtsam.refine.sweeps import Path, path_starts
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.types import FrameStatus, MapUpdate, Uncertainty

LOST = 2, 3


def updates():
    """Six frames, two of which are lost; where the next one is, is known to 3 m."""
    found = []
    for number in range(6):
        pose = gtsam.Pose3(gtsam.Rot3(), [float(number), 0.0, 0.0])
        if number in LOST:
            found.append(MapUpdate(number, pose, FrameStatus.LOST))
            continue
        drift = np.diag(np.repeat([1e-6, 9.0 if number > LOST[1] else 1e-4], 3))
        parts = Uncertainty(1e-6 * np.eye(6), np.zeros((6, 6)), None, drift, 1.0, 100.0)
        found.append(MapUpdate(number, pose, FrameStatus.OK, uncertainty=parts))
    return found


def test_after_lost_sweeps_the_next_is_tied_to_the_last_that_was_found():
    run = updates()
    poses = np.array([update.map_T_lidar.matrix() for update in run])
    graph = odometry_factors(run, poses)
    factors = [graph.at(number) for number in range(graph.size())]
    pairs = [tuple(map(gtsam.symbolIndex, factor.keys())) for factor in factors]
    assert pairs == [(0, 1), (1, 2), (2, 3), (1, 4), (4, 5)]
    across = factors[3]
    expected = relative_covariance(run[1], run[4])
    np.testing.assert_allclose(across.noiseModel().covariance(), expected, rtol=1e-6, atol=1e-9)
    assert expected[3, 3] > 8.0
    assert across.measured().range(gtsam.Pose3(gtsam.Rot3(), [3.0, 0.0, 0.0])) < 1e-9


def test_no_path_leads_through_sweeps_that_were_not_found():
    found = np.array([number not in LOST for number in range(6)])
    assert path_starts([found, found[:1]]) == [0, 2, 4, 6]
    # The lidar went on at 1 m/s; where it is lost, it is said to be far away.
    poses = np.array(
        [gtsam.Pose3(gtsam.Rot3(), [n, 9.0 * (n in LOST), 0.0]).matrix() for n in range(6)]
    )
    path = Path.through(np.arange(6) * 10**9, poses, path_starts([found]))
    for number in np.flatnonzero(found).tolist():
        step = path.motion(number, np.array([0.5]))[0]
        np.testing.assert_allclose(step, [0, 0, 0, 0.5, 0, 0], atol=1e-9)
