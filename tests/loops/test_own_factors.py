"""Factors and variables of a user's own in a pose graph."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X
from support.cli import loam
from support.pose_graphs import SIGMAS, drifted, filled, off, right_loops, square, wrong_loops

from loam_gtsam.factors import checked_factor
from loam_gtsam.io.state import freeze
from loam_gtsam.loops.batch import optimize_graph
from loam_gtsam.loops.files import read_graph, write_graph
from loam_gtsam.types import InputError, OutputError

POST = np.array([4.0, 3.0, 1.0])
NOISE = gtsam.noiseModel.Isotropic.Sigma(3, 0.05)
TRUTH = square(8, 2)


def valued(key, value):
    values = gtsam.Values()
    values.insert(key, value)
    return values


def sighting(index, post=POST, key=None, noise=NOISE):
    """Bearing and range of a post, exact."""
    pose = TRUTH[index]
    return gtsam.BearingRangeFactor3D(
        X(index), L(0) if key is None else key, pose.bearing(post), pose.range(post), noise
    )


def bearing(index, key):
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.01)
    return gtsam.BearingFactor3D(X(index), key, TRUTH[index].bearing(POST), noise)


def python_position(index):
    """A position as a factor written in Python."""

    def residual(values):
        pose = values.atPose3(X(index))
        jacobian = np.hstack([np.zeros((3, 3)), pose.rotation().matrix()])
        return pose.translation() - TRUTH[index].translation(), [jacobian]

    return checked_factor(NOISE, [X(index)], residual)


def test_a_landmark_holds_the_poses_from_which_it_is_seen():
    odometry = drifted(TRUTH, np.random.default_rng(0))
    plain, graph = filled(odometry), filled(odometry)
    graph.add_factor(sighting(0), valued(L(0), POST + 0.5))
    np.testing.assert_allclose(graph.estimate(L(0)), POST, atol=1e-3)
    for index in range(4, 64, 4):
        graph.add_factor(sighting(index))
    assert off(graph.poses(), TRUTH) < 0.6 * off(plain.poses(), TRUTH)
    assert graph.estimate_covariance(L(0)).shape == (3, 3)
    assert graph.estimate(X(5)).equals(graph.pose(5), 0.0)
    assert graph.values.size() == len(graph) + 1
    for ask in (graph.estimate, graph.estimate_covariance):
        with pytest.raises(InputError, match="expected one of a variable in the graph, got l3"):
            ask(L(3))
    for loop in right_loops(TRUTH, np.random.default_rng(1), 3):
        assert graph.add_loop(loop)


def test_variables_of_any_type_can_be_added():
    graph = filled(TRUTH[:4])
    bias = gtsam.imuBias.ConstantBias(np.full(3, 0.1), np.full(3, 0.01))
    unit = gtsam.noiseModel.Unit.Create(6)
    graph.add_factor(gtsam.PriorFactorConstantBias(B(0), bias, unit), valued(B(0), bias))
    assert graph.estimate(B(0)).equals(bias, 1e-9)
    mounting = gtsam.symbol("e", 0)
    two = gtsam.NonlinearFactorGraph()
    for index in (1, 2):
        two.add(gtsam.BetweenFactorPose3(X(index), mounting, TRUTH[3].inverse(), unit))
    graph.add_factor(two, valued(mounting, gtsam.Pose3()))
    assert isinstance(graph.estimate(mounting), gtsam.Pose3)
    scale = gtsam.symbol("s", 0)
    one = gtsam.noiseModel.Unit.Create(1)
    graph.add_factor(gtsam.PriorFactorDouble(scale, 1.5, one), valued(scale, 1.0))
    assert graph.estimate(scale) == pytest.approx(1.5)


def test_new_variables_must_be_determined():
    graph = filled(TRUTH)
    with pytest.raises(InputError, match="does not determine the new variables l1"):
        graph.add_factor(bearing(1, L(1)), valued(L(1), POST + 0.2))
    both = gtsam.NonlinearFactorGraph()
    both.add(bearing(1, L(1)))
    both.add(bearing(9, L(1)))
    graph.add_factor(both, valued(L(1), POST + 0.2))
    np.testing.assert_allclose(graph.estimate(L(1)), POST, atol=1e-3)


UNIT = gtsam.noiseModel.Unit.Create(6)
NAN = np.full(3, np.nan)
REFUSED = [
    (None, None, "expected a gtsam.NonlinearFactor or NonlinearFactorGraph, got NoneType"),
    (gtsam.NonlinearFactorGraph(), None, "no factor is on any variable"),
    (sighting(1), {L(0): POST}, "expected gtsam.Values or None, got dict"),
    (gtsam.PriorFactorPose3(X(99), gtsam.Pose3(), UNIT), None, "no variable has the keys x99"),
    (gtsam.PriorFactorPose3(3, gtsam.Pose3(), UNIT), None, "no variable has the keys 3"),
    (sighting(1, key=L(7)), None, "no variable has the keys l7"),
    (sighting(1), valued(L(0), POST), "l0 is in the graph already"),
    (gtsam.GPSFactor(X(99), POST, NOISE), valued(X(99), gtsam.Pose3()), "another letter than x"),
    (gtsam.GPSFactor(X(1), POST, NOISE), valued(L(7), POST), "no factor is on l7"),
    (sighting(1, key=L(7)), valued(L(7), NAN), "values: expected finite numbers"),
    (gtsam.GPSFactor(L(0), POST, NOISE), None, "cannot evaluate it: .* type stored in Values"),
    (gtsam.GPSFactor(X(1), NAN, NOISE), None, "is NaN or infinite"),
    (gtsam.GPSFactor(X(1), POST, gtsam.noiseModel.Isotropic.Sigma(3, 0.0)), None, "is NaN or inf"),
    (gtsam.BetweenFactorPose3(X(1), X(1), gtsam.Pose3(), UNIT), None, "expected different keys"),
    (checked_factor(NOISE, [X(1)], lambda values: (NAN, [])), None, "cannot evaluate it: factor"),
]


@pytest.mark.parametrize(("factor", "values", "message"), REFUSED)
def test_what_gtsam_cannot_bear_is_refused_and_changes_nothing(factor, values, message):
    graph = filled(TRUTH[:10])
    graph.add_factor(sighting(0), valued(L(0), POST))
    before = graph.poses()
    with pytest.raises(InputError, match=message):
        graph.add_factor(factor, values)
    np.testing.assert_array_equal(graph.poses(), before)
    graph.add_factor(sighting(5))
    assert graph.saved().factors.size() == 12


def test_after_a_factor_that_fails_in_isam_the_graph_is_as_before():
    calls = []

    def residual(values):
        calls.append(None)
        if len(calls) > 2:
            raise RuntimeError("not again")
        return np.ones(3), [np.eye(3, 6)]

    graph = filled(TRUTH[:10])
    before = graph.poses()
    with pytest.raises(InputError, match="cannot solve the graph with it: not again"):
        graph.add_factor(checked_factor(NOISE, [X(3)], residual))
    np.testing.assert_allclose(graph.poses(), before, atol=1e-9)
    graph.add_position(9, POST, np.eye(3))


def test_factors_written_in_python_go_with_loops_and_into_the_batch_solution():
    rng = np.random.default_rng(2)
    odometry = drifted(TRUTH, rng)
    graph = filled(odometry)
    for index in (20, 40, 60):
        graph.add_factor(python_position(index))
    for loop in [*right_loops(TRUTH, rng, 5), *wrong_loops(10, len(TRUTH), rng)]:
        graph.add_loop(loop)
    active = graph.active
    assert active == (True,) * 5 + (False,) * 10
    result = graph.optimize()  # with graduated non-convexity, which copies factors
    assert tuple(loop.active for loop in result.loops) == graph.active == active
    assert off(graph.poses(), TRUTH) < 0.5 * off(filled(odometry).poses(), TRUTH)


def test_a_motion_of_ones_own_is_believed_in_the_run_and_tested_in_a_graph_of_its_own():
    graph = filled(TRUTH[:10])
    graph.add_factor(gtsam.BetweenFactorPose3(X(3), X(4), gtsam.Pose3(), UNIT))
    for loop in wrong_loops(2, 10, np.random.default_rng(2)):
        graph.add_loop(loop)
    assert graph.saved().loops == (*graph.own, 11, 12)
    assert len(optimize_graph(graph.saved()).loops) == 3
    assert len(graph.optimize().loops) == 2


def test_factors_written_in_python_cannot_be_kept(tmp_path):
    graph = filled(TRUTH[:10])
    freeze({"graph": graph}, {})
    graph.add_factor(python_position(3))
    with pytest.raises(OutputError, match="cannot be in a checkpoint"):
        freeze({"graph": graph}, {})
    with pytest.raises(OutputError, match="written in Python cannot be saved"):
        write_graph(tmp_path / "g.graph", graph.saved())
    write_graph(tmp_path / "g.g2o", graph.saved())
    assert read_graph(tmp_path / "g.g2o").poses.size() == 10


def test_landmarks_are_kept_in_files_of_gtsam_and_optimised_again(tmp_path):
    graph = filled(drifted(TRUTH, np.random.default_rng(3)))
    graph.add_factor(sighting(0), valued(L(0), POST))
    graph.add_factor(sighting(40))
    path = tmp_path / "run.graph"
    write_graph(path, graph.saved())
    saved = read_graph(path)
    assert saved.factors.equals(graph.saved().factors, 1e-12)
    assert saved.poses.equals(graph.values, 1e-12)
    assert saved.keys == [X(n) for n in range(len(TRUTH))]
    done = loam("optimize", path, "--trajectory", tmp_path / "t.tum")
    assert done.exit_code == 0, done.output
    again = read_graph(tmp_path / "run_optimized.graph")
    np.testing.assert_allclose(again.poses.atPoint3(L(0)), graph.estimate(L(0)), atol=1e-3)
    write_graph(tmp_path / "run.g2o", graph.saved())
    assert "# 3 factors are left out" in (tmp_path / "run.g2o").read_text("ascii")


def test_a_motion_between_keyframes_of_ones_own_is_no_loop():
    """It is believed as it is, and the loop closures keep their numbers in the batch solution."""
    rng = np.random.default_rng(4)
    graph = filled(drifted(TRUTH, rng))
    noise = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
    graph.add_factor(gtsam.BetweenFactorPose3(X(3), X(35), TRUTH[3].between(TRUTH[35]), noise))
    assert graph.loops == []
    for loop in [*wrong_loops(2, len(TRUTH), rng), *right_loops(TRUTH, rng, 2)]:
        graph.add_loop(loop)
    result = graph.optimize()
    assert [loop.active for loop in result.loops] == [False, False, True, True]
