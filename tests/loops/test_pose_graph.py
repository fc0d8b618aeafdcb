"""Pose graphs: keyframes, closed forms, marginals, sessions; reset and resumed ones."""

import pickle
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from support.pose_graphs import (
    FRAME,
    SIGMAS,
    drifted,
    filled,
    frames,
    off,
    right_loops,
    settings,
    square,
    wrong_loops,
)

from loam_gtsam.config import Config
from loam_gtsam.io.state import freeze, thaw
from loam_gtsam.loops.batch import optimize_graph
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.loops.places import Places
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.mapper import Registered
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.types import Features, FrameStatus, InputError, MapUpdate


def test_a_frame_is_a_keyframe_when_it_is_far_or_has_turned():
    yaw = gtsam.Rot3.Yaw
    way = ((0, 0), (1.9, 0), (2.1, 0), (2.1, 0.5), (2.1, 0.53), (4.0, 0.53))
    poses = [gtsam.Pose3(yaw(turn), np.array([x, 0.0, 0.0])) for x, turn in way]
    graph = PoseGraph(settings(keyframe_distance=2.0))
    taken = [graph.add(update) is not None for update in frames(poses)]
    assert taken == [True, False, True, False, True, False]
    assert [keyframe.stamp for keyframe in graph.keyframes] == [0, 2 * FRAME, 4 * FRAME]
    assert [keyframe.travelled for keyframe in graph.keyframes] == pytest.approx([0.0, 2.1, 2.1])


def test_frames_must_be_solved_and_come_in_order():
    graph = PoseGraph(settings())
    lost = MapUpdate(5, gtsam.Pose3(), FrameStatus.LOST)
    assert graph.add(lost) is None
    assert len(graph) == 0
    assert graph.visit() is None
    assert graph.correction.equals(gtsam.Pose3(), 0.0)
    assert graph.poses().shape == (0, 4, 4)
    assert graph.trajectory([lost]).map_T_lidar.shape == (1, 4, 4)
    with pytest.raises(InputError, match="expected a stamp after 200000000"):
        filled(square(4, 1)[:3]).add(frames(square(4, 1))[1])


def test_a_pickled_graph_is_the_graph_with_its_configuration():
    graph = filled(square(4, 1))
    copy = pickle.loads(pickle.dumps(graph))
    np.testing.assert_array_equal(copy.poses(), graph.poses())
    assert copy.config == graph.config
    assert copy.correction.equals(graph.correction, 1e-12)


def test_frames_whose_first_motion_is_in_doubt_are_neither_keyframes_nor_places():
    graph, places = PoseGraph(settings()), Places(Config())
    points = Registered(np.empty((0, 3)), np.zeros((1, 3)), gtsam.Pose3(), None)
    for number, update in enumerate(frames(square(4, 1)[:3])):
        assert update.uncertainty is not None
        told = replace(update.uncertainty, in_doubt=number < 2)
        update = replace(update, uncertainty=told)
        assert (graph.add(update) is None) == (number < 2)
        assert (places.add(update, points) is None) == (number < 2)
    assert graph.keyframes[0].stamp == places.all[0].stamp == 2 * FRAME


def test_features_are_kept_where_they_are_at_the_stamp():
    config = settings()
    twist = np.array([0.0, 0.0, 0.3, 5.0, 0.0, 0.0])
    where = np.array([[10.0, 4.0, 1.0], [3.0, -8.0, 0.5]])
    times = np.array([0.02, 0.09])
    seen = np.array([gtsam.Pose3.Expmap(twist * t).transformTo(p)
                     for p, t in zip(where, times, strict=True)])  # fmt: skip
    features = replace(
        Features.from_points(0, np.zeros((0, 3)), seen), plane_times=times, span=(0.0, 0.1)
    )
    update = replace(frames([gtsam.Pose3()])[0], twist=twist)
    keyframe = PoseGraph(config).add(update, features)
    np.testing.assert_allclose(np.sort(keyframe.planes, axis=0), np.sort(where, axis=0), atol=1e-9)
    assert len(keyframe.edges) == len(keyframe.distinct) == 0
    with pytest.raises(InputError, match="expected those of the stamp 0, got 7"):
        PoseGraph(config).add(update, replace(features, stamp=7))


def test_between_factors_have_the_covariance_of_the_motion():
    updates = frames(square(3, 1))
    graph = filled(square(3, 1))
    factor = graph.saved().factors.at(2)
    floor = np.diag(np.repeat([1e-6, 1e-5], 3) ** 2)
    expected = relative_covariance(updates[1], updates[2]) + floor
    np.testing.assert_allclose(factor.noiseModel().covariance(), expected, rtol=1e-6, atol=1e-15)
    walking = filled(square(3, 1), walk=0.1, turn_walk_deg=1.0).saved().factors.at(2)
    more = np.diag(np.repeat([np.radians(1.0), 0.1], 3) ** 2)
    np.testing.assert_allclose(walking.noiseModel().covariance(), expected + more, rtol=1e-6,
                               atol=1e-15)  # fmt: skip


def test_a_square_with_known_drift_closes_by_equal_shares():
    """Translation only, equal variances: the error at the end is taken out linearly."""
    n, shift = 12, np.array([0.3, -0.12, 0.06])
    straight = [gtsam.Pose3(gtsam.Rot3(), np.array([float(k), 0, 0]) + k / n * shift)
                for k in range(n + 1)]  # fmt: skip
    sigmas = np.repeat([1e-5, 0.1], 3)
    graph = PoseGraph(settings(max_chi2=1e9, kernel_width=np.inf))
    for update in frames(straight, sigmas):
        graph.add(update)
    tight = np.diag(np.repeat([1e-4, 1e-4], 3) ** 2)
    true = gtsam.Pose3(gtsam.Rot3(), np.array([float(n), 0, 0]))
    assert graph.add_loop(LoopClosure(0, n, true, tight))
    expected = np.array([[float(k), 0.0, 0.0] for k in range(n + 1)])
    np.testing.assert_allclose(graph.poses()[:, :3, 3], expected, atol=1e-4)
    # Two springs in a row: the half-way pose is known half as well as either side gives alone.
    middle = np.diag(graph.covariance(n // 2))[3:]
    np.testing.assert_allclose(middle, sigmas[3] ** 2 * (n / 2) / 2.0, rtol=0.02)


def test_correction_leads_from_odometry_to_the_map():
    rng = np.random.default_rng(0)
    truth = square(40, 2)
    odometry = drifted(truth, rng)
    graph = filled(odometry)
    assert graph.correction.equals(gtsam.Pose3(), 1e-9)
    for loop in right_loops(truth, rng, 6):
        graph.add_loop(loop)
    last = len(truth) - 1
    corrected = graph.correction.compose(odometry[last])
    assert corrected.equals(graph.pose(last), 1e-9)
    assert np.linalg.norm(corrected.translation() - truth[last].translation()) < 0.3
    assert np.linalg.norm(odometry[last].translation() - truth[last].translation()) > 0.5


def test_frames_between_keyframes_follow_them():
    truth = square(20, 2)
    rng = np.random.default_rng(4)
    updates = frames(drifted(truth, rng))
    graph = PoseGraph(settings(keyframe_distance=3.5))
    for update in updates:
        graph.add(update)
    skipped = replace(updates[5], status=FrameStatus.BAD_STAMP)
    plain = graph.trajectory([*updates[:5], skipped, *updates[6:]])
    odometry = np.array([update.map_T_lidar.matrix() for update in updates])
    np.testing.assert_allclose(plain.map_T_lidar, np.delete(odometry, 5, axis=0), atol=1e-9)
    at = [keyframe.stamp // FRAME for keyframe in graph.keyframes]
    lap = len(at) // 2
    motion = truth[at[2]].between(truth[at[2 + lap]])
    graph.add_loop(LoopClosure(2, 2 + lap, motion, np.diag(SIGMAS**2)))
    moved = graph.trajectory(updates).map_T_lidar
    np.testing.assert_allclose(moved[at], graph.poses(), atol=1e-9)
    assert np.linalg.norm(moved[at[2 + lap], :3, 3] - odometry[at[2 + lap], :3, 3]) > 0.05
    # Steps stay what they were, up to what the loop takes out of each of them.
    steps = np.linalg.norm(np.diff(moved[:, :3, 3], axis=0), axis=1)
    measured = np.linalg.norm(np.diff(odometry[:, :3, 3], axis=0), axis=1)
    assert np.abs(steps - measured).max() < 0.02


def test_positions_and_gravity_hold_the_graph():
    truth = square(20, 1)
    rng = np.random.default_rng(8)
    odometry = drifted(truth, rng)
    graph = filled(odometry)
    tilt = graph.covariance(70)[0, 0]
    for index in range(0, 80, 10):
        graph.add_position(index, np.array(truth[index].translation()), 1e-4 * np.eye(3))
    assert off(graph.poses(), truth) < 0.1 < off(filled(odometry).poses(), truth)
    for index in range(80):
        up = truth[index].rotation().unrotate(np.array([0.0, 0.0, 2.0]))
        graph.add_gravity(index, up, 1e-4)
    roll_pitch = [gtsam.Rot3(pose[:3, :3]).rpy()[:2] for pose in graph.poses()]
    assert np.abs(roll_pitch).max() < 5e-4
    assert graph.covariance(70)[0, 0] < 0.01 * tilt
    before = graph.covariance(70)[2, 2]
    graph.add_gravity(70, np.array([0.0, 0.0, 1.0]), 1e-4)
    assert graph.covariance(70)[2, 2] == pytest.approx(before, rel=0.01)  # it says no yaw
    for index, position, covariance in ((80, np.zeros(3), np.eye(3)), (0, np.zeros(2), np.eye(3)),
                                        (0, np.zeros(3), -np.eye(3))):  # fmt: skip
        with pytest.raises(InputError):
            graph.add_position(index, position, covariance)
    for up, sigma in ((np.zeros(3), 0.1), (np.ones(3), 0.0), (np.ones(2), 0.1)):
        with pytest.raises(InputError):
            graph.add_gravity(0, up, sigma)


def test_marginals_of_a_chain_are_those_of_monte_carlo():
    """The squared error of the last pose, in its covariance, is 6 in the mean."""
    truth, runs = square(6, 1), 300
    sigmas = np.repeat([0.004, 0.03], 3)
    rng = np.random.default_rng(11)
    odometry = [drifted(truth, rng, sigmas) for _ in range(runs)]
    graph = PoseGraph(settings())
    for update in frames(odometry[0], sigmas):
        graph.add(update)
    last = len(truth) - 1
    between, relative = graph.relative(4, last)
    assert between.equals(odometry[0][4].between(odometry[0][last]), 1e-9)
    for start, covariance in ((0, graph.covariance(last)), (4, relative)):
        nees = []
        for poses in odometry:
            expected = truth[start].between(truth[last])
            error = expected.localCoordinates(poses[start].between(poses[last]))
            nees.append(error @ np.linalg.solve(covariance, error))
        assert np.mean(nees) == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / runs))


def test_isam_is_the_batch_solution():
    truth = square(20, 2)
    rng = np.random.default_rng(6)
    graph = filled(drifted(truth, rng), kernel_width=np.inf)
    for loop in right_loops(truth, rng, 8):
        assert graph.add_loop(loop)
    result = optimize_graph(graph.saved(), robust=False)
    batch = np.array([result.poses.atPose3(X(n)).matrix() for n in range(len(graph))])
    np.testing.assert_allclose(graph.poses(), batch, atol=2e-4)
    np.testing.assert_allclose(graph.covariance(70), result.covariance(X(70)), rtol=0.02, atol=1e-9)


def test_bad_loops_are_refused():
    graph = filled(square(4, 1))
    good = LoopClosure(0, 9, gtsam.Pose3(), np.eye(6))
    nan = np.full((6, 6), np.nan)
    lopsided = np.eye(6) + np.eye(6, k=2)
    for earlier, later in ((0, 16), (-1, 9), (0, 0), (9, 0), (0, 1)):
        with pytest.raises(InputError, match="keyframe"):
            graph.add_loop(replace(good, earlier=earlier, later=later))
    for covariance in (np.eye(5), nan, -np.eye(6), lopsided, np.zeros((6, 6))):
        with pytest.raises(InputError, match="covariance: expected"):
            graph.add_loop(replace(good, covariance=covariance))
    assert graph.loops == []
    assert not graph.add_loop(replace(good, covariance=1e-6 * np.eye(6)))
    assert graph.active == (False,)


def test_a_second_session_is_tied_by_loops_alone():
    """Two drives along the same way, the second one with another start of its own."""
    rng = np.random.default_rng(3)
    truth = square(10, 1)
    offset = gtsam.Pose3(gtsam.Rot3.Yaw(2.0), np.array([30.0, -12.0, 1.0]))
    first = drifted(truth, rng)
    second = [offset.compose(pose) for pose in drifted(truth, rng)]
    graph = PoseGraph(settings())
    for update in frames(first):
        graph.add(update)
    graph.new_session()
    graph.new_session()  # nothing came in between
    for update in frames(second):  # their stamps begin again
        graph.add(update)
    count = len(truth)
    assert [keyframe.session for keyframe in graph.keyframes] == [0] * count + [1] * count
    assert graph.pose(count).range(second[0]) < 1e-6
    for k in range(2, count, 5):
        seen = truth[k].between(truth[k].retract(SIGMAS * rng.normal(size=6)))
        assert graph.add_loop(LoopClosure(k, k + count, seen, np.diag(SIGMAS**2)))
    wrong = gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([5.0, 5.0, 0.0]))
    assert not graph.add_loop(LoopClosure(4, count + 20, wrong, np.diag(SIGMAS**2)))
    assert off(graph.poses(), truth + truth) < 0.2
    frames_of_second = graph.trajectory(frames(second), session=1)
    np.testing.assert_allclose(frames_of_second.map_T_lidar, graph.poses()[count:], atol=1e-9)


def test_the_map_of_a_graph_is_that_of_its_keyframes():
    graph = PoseGraph(settings())
    assert graph.map_points()[0].shape == (0, 3)
    points = np.array([[5.0, 0.0, 0.0], [0.0, 4.0, 1.0]])
    for update in frames([gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3.Yaw(np.pi / 2), np.ones(3))]):
        graph.add(update, Features.from_points(update.stamp, points[:1], points))
    edges, planes = graph.map_points()
    np.testing.assert_allclose(edges, [[5, 0, 0], [1, 6, 1]], atol=1e-6)
    assert planes.shape == (4, 3)


def eventful(graph):
    """Events of a drive: keyframes, loop closures, a landmark, positions, a batch solution."""
    truth, rng = square(6, 2), np.random.default_rng(1)
    updates = frames(drifted(truth, rng))
    loops = [*right_loops(truth, rng, 5), *wrong_loops(8, len(truth) - 2, rng)]
    loops = [loop for loop in loops if loop.later < len(truth) - 2]
    start = gtsam.Values()
    start.insert(L(0), np.array([3.0, 3.2, 0.9]))
    post = np.array([3.0, 3.0, 1.0])
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.05)
    seen = [
        gtsam.BearingRangeFactor3D(X(k), L(0), truth[k].bearing(post), truth[k].range(post), noise)
        for k in (2, 20)
    ]
    events = [(graph.add, update) for update in updates[:-2]]
    events += [(graph.add_loop, loop) for loop in loops]
    events.insert(6, (graph.add_factor, seen[0], start))
    events.insert(30, (graph.add_factor, seen[1]))
    events.insert(40, (graph.add_position, 20, truth[20].translation(), 0.01 * np.eye(3)))
    events.insert(50, (graph.add_gravity, 21, np.array([0.0, 0.0, 1.0]), 0.01))
    events += [(graph.optimize,), *((graph.add, update) for update in updates[-2:])]
    events += [(graph.add_loop, wrong_loops(1, len(truth), rng)[0])]
    return events


def play(events):
    for call, *given in events:
        call(*given)


def assert_same(one, two):
    """To the last bit."""
    assert one.active == two.active
    assert one.own == two.own != []
    np.testing.assert_array_equal(one.poses(), two.poses())
    np.testing.assert_array_equal(one.covariance(len(one) - 1), two.covariance(len(two) - 1))
    np.testing.assert_array_equal(one.estimate(L(0)), two.estimate(L(0)))


def test_a_graph_that_was_reset_is_as_a_new_one():
    fresh, graph = PoseGraph(settings()), PoseGraph(settings())
    play(eventful(graph))
    graph.new_session()
    graph.add(frames([gtsam.Pose3()])[0])
    graph.reset()
    assert (len(graph), graph.loops, graph.active, graph.values.size()) == (0, [], (), 0)
    play(eventful(graph))
    play(eventful(fresh))
    assert_same(graph, fresh)
    assert graph.saved().factors.at(0).keys() == [X(0)]  # a prior: nothing ties it to what was


@pytest.mark.parametrize("at", [8, 45, 55, 63])
def test_a_resumed_graph_goes_on_to_the_last_bit(at):
    """With loop closures, factors and variables of one's own, positions, a batch solution."""
    whole, again = PoseGraph(settings()), PoseGraph(settings())
    events = eventful(whole)
    play(events[:at])
    thaw(freeze({"graph": whole}, {}), {"graph": again}, {})
    play(events[at:])
    play(eventful(again)[at:])
    assert sum(whole.active) == 5
    assert_same(again, whole)


def test_an_optimisation_that_failed_is_not_repeated_when_the_run_goes_on():
    graph, again = PoseGraph(settings()), PoseGraph(settings())
    with pytest.raises(InputError, match="expected poses, got none"):
        graph.optimize()
    for update in frames(square(3, 1)):
        graph.add(update)
    thaw(freeze({"graph": graph}, {}), {"graph": again}, {})
    np.testing.assert_array_equal(again.poses(), graph.poses())
