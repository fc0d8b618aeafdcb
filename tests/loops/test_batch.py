"""A whole graph optimised at once."""

import gtsam
import numpy as np
import pytest
from support.pose_graphs import drifted, filled, frames, right_loops, square, wrong_loops

from loam_gtsam.loops.batch import SavedGraph, optimize_graph
from loam_gtsam.types import InputError


def test_batch_finds_the_same_loops():
    truth = square(20, 2)
    rng = np.random.default_rng(2)
    odometry = drifted(truth, rng)
    graph = filled(odometry)
    loops = [*right_loops(truth, rng, 5), *wrong_loops(15, len(truth), rng)]
    for number in rng.permutation(len(loops)).tolist():
        graph.add_loop(loops[number])
    before, active = graph.poses(), graph.active
    result = graph.optimize()
    assert [loop.active for loop in result.loops] == list(active) == list(graph.active)
    assert sum(active) == 5
    np.testing.assert_allclose(graph.poses(), before, atol=1e-3)
    assert result.error_after <= result.error_before
    # And the run goes on from there.
    step = gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 0, 0]))
    goes_on = frames([*odometry, odometry[-1].compose(step)])[-1]
    assert graph.add(goes_on).index == len(truth)
    assert graph.pose(len(truth)).equals(graph.pose(len(truth) - 1).compose(step), 1e-6)


def test_a_graph_that_nothing_holds_is_held_at_its_first_pose():
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    graph, poses = gtsam.NonlinearFactorGraph(), gtsam.Values()
    start = gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([5.0, 0, 0]))
    step = gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 0, 0]))
    poses.insert(3, start)
    poses.insert(7, gtsam.Pose3())
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(1.0)
    graph.add(gtsam.BetweenFactorPose3(3, 7, step, gtsam.noiseModel.Robust.Create(kernel, noise)))
    result = optimize_graph(SavedGraph(graph, poses))
    assert result.poses.atPose3(7).equals(start.compose(step), 1e-6)
    assert result.loops == ()
    np.testing.assert_allclose(result.covariance(7)[3:, 3:], 0.01 * np.eye(3), atol=1e-4)


def test_graphs_that_cannot_be_solved_are_refused():
    with pytest.raises(InputError, match="expected poses, got none"):
        optimize_graph(SavedGraph(gtsam.NonlinearFactorGraph(), gtsam.Values()))
    points = gtsam.Values()
    points.insert(1, np.zeros(3))
    with pytest.raises(InputError, match="expected poses, got none among 1 variables"):
        optimize_graph(SavedGraph(gtsam.NonlinearFactorGraph(), points))
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    poses = gtsam.Values()
    for key in range(3):
        poses.insert(key, gtsam.Pose3())
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.BetweenFactorPose3(0, 1, gtsam.Pose3(), noise))
    with pytest.raises(InputError, match="1 poses, 2 the first, are connected to none"):
        optimize_graph(SavedGraph(graph, poses))
    graph.add(gtsam.BetweenFactorPose3(1, 9, gtsam.Pose3(), noise))
    with pytest.raises(InputError, match="on the key 9, which has no pose"):
        optimize_graph(SavedGraph(graph, poses))
