"""Pose graphs: keyframes, closed forms, marginals, loops that are right and wrong, batch."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from loam_gtsam.config import Config
from loam_gtsam.loops.batch import SavedGraph, optimize_graph
from loam_gtsam.loops.consistency import LoopConsistency, chi_squared, consistent
from loam_gtsam.loops.keyframes import Keyframe, LoopClosure
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.registration.pose_errors import relative_covariance
from loam_gtsam.types import Features, FrameStatus, InputError, MapUpdate, Uncertainty

SIGMAS = np.repeat([0.002, 0.02], 3)
FRAME = 10**8


def settings(**pose_graph):
    config = Config()
    chosen = {"keyframe_distance": 0.5, "walk": 0.0, "turn_walk_deg": 0.0} | pose_graph
    return config.changed(pose_graph=config.pose_graph.changed(**chosen))


def frames(poses, sigmas=SIGMAS):
    """Solved frames whose relative covariance is that of ``sigmas`` a step."""
    drift = 1e-8 * np.eye(6)
    made = []
    for number, pose in enumerate(poses):
        if number:
            to_map = pose.AdjointMap()
            drift = drift + to_map @ np.diag(sigmas**2) @ to_map.T
        parts = Uncertainty(np.zeros((6, 6)), np.zeros((6, 6)), None, drift, 1.0, 100.0)
        made.append(
            MapUpdate(number * FRAME, pose, FrameStatus.OK, covariance=1e-8 * np.eye(6),
                      uncertainty=parts)
        )  # fmt: skip
    return made


def square(side, laps):
    """Poses 1 m apart around a square, the first ones on its side along x."""
    poses = [gtsam.Pose3()]
    for step in range(laps * 4 * side - 1):
        turn = gtsam.Rot3.Yaw(np.pi / 2.0) if (step + 1) % side == 0 else gtsam.Rot3()
        poses.append(poses[-1].compose(gtsam.Pose3(turn, np.array([1.0, 0.0, 0.0]))))
    return poses


def drifted(poses, rng, sigmas=SIGMAS):
    odometry = [poses[0]]
    for one, two in pairwise(poses):
        step = one.between(two).retract(sigmas * rng.normal(size=6))
        odometry.append(odometry[-1].compose(step))
    return odometry


def right_loops(truth, rng, count):
    lap = len(truth) // 2
    made = []
    for a in np.linspace(3, lap - 3, count).astype(int).tolist():
        seen = truth[a].between(truth[a + lap]).retract(SIGMAS * rng.normal(size=6))
        made.append(LoopClosure(a, a + lap, seen, np.diag(SIGMAS**2)))
    return made


def wrong_loops(count, size, rng):
    made = []
    while len(made) < count:
        one, two = sorted(rng.choice(size, 2, replace=False).tolist())
        if two - one > 1:
            where = gtsam.Pose3(gtsam.Rot3.Yaw(rng.uniform(-3, 3)), rng.normal(0, 2.0, 3))
            made.append(LoopClosure(one, two, where, np.diag(SIGMAS**2)))
    return made


def filled(poses, **pose_graph):
    graph = PoseGraph(settings(**pose_graph))
    for update in frames(poses):
        graph.add(update)
    return graph


def off(graph, truth):
    """Metres, root mean square."""
    positions = graph.poses()[:, :3, 3] - [pose.translation() for pose in truth]
    return np.sqrt((positions**2).sum(axis=1).mean())


# -- keyframes -------------------------------------------------------------------------------------


def test_a_frame_is_a_keyframe_when_it_is_far_or_has_turned():
    yaw = gtsam.Rot3.Yaw
    way = ((0, 0), (1.9, 0), (2.1, 0), (2.1, 0.5), (2.1, 0.53), (4.0, 0.53))
    poses = [gtsam.Pose3(yaw(turn), np.array([x, 0.0, 0.0])) for x, turn in way]
    graph = PoseGraph(settings(keyframe_distance=2.0))
    taken = [graph.add(update) is not None for update in frames(poses)]
    assert taken == [True, False, True, False, True, False]
    assert [keyframe.stamp for keyframe in graph.keyframes] == [0, 2 * FRAME, 4 * FRAME]
    assert [keyframe.travelled for keyframe in graph.keyframes] == pytest.approx([0.0, 2.1, 2.1])


def test_frames_that_were_not_solved_are_none():
    graph = PoseGraph(settings())
    lost = MapUpdate(5, gtsam.Pose3(), FrameStatus.LOST)
    assert graph.add(lost) is None
    assert len(graph) == 0
    assert graph.correction.equals(gtsam.Pose3(), 0.0)
    assert graph.poses().shape == (0, 4, 4)
    assert graph.trajectory([lost]).map_T_lidar.shape == (1, 4, 4)


def test_frames_must_come_in_order():
    graph = filled(square(4, 1)[:3])
    with pytest.raises(InputError, match="expected a stamp after 200000000"):
        graph.add(frames(square(4, 1))[1])


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


# -- the graph -------------------------------------------------------------------------------------


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
    assert off(graph, truth) < 0.1 < off(filled(odometry), truth)
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
    nees = []
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


# -- loops -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1])
def test_fifty_wrong_loops_do_not_bend_ten_right_ones(seed):
    truth = square(25, 2)
    rng = np.random.default_rng(seed)
    odometry = drifted(truth, rng)
    right = right_loops(truth, rng, 10)
    clean = filled(odometry)
    for loop in right:
        assert clean.add_loop(loop)
    alone = off(clean, truth)
    assert alone < 0.7 * off(filled(odometry), truth)
    loops = [*right, *wrong_loops(50, len(truth), rng)]
    order = rng.permutation(len(loops)).tolist()
    graph = filled(odometry)
    for number in order:
        graph.add_loop(loops[number])
    assert graph.active == tuple(number < 10 for number in order)
    assert off(graph, truth) == pytest.approx(alone, rel=0.05)
    # They are what bends it if they are believed.
    believed = optimize_graph(graph.saved(), robust=False)
    assert off_by(believed.poses, truth) > 5.0 * alone


def off_by(values, truth):
    """Metres, root mean square."""
    errors = [values.atPose3(X(n)).translation() - p.translation() for n, p in enumerate(truth)]
    return np.sqrt(np.square(errors).sum(axis=1).mean())


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


def test_a_wrong_loop_that_came_first_is_switched_off_later():
    truth = square(20, 2)
    rng = np.random.default_rng(9)
    graph = filled(drifted(truth, rng))
    n = len(truth)
    spread = np.diag(np.repeat([0.02, 0.3], 3))
    shifted = truth[5].between(truth[5 + n // 2]).retract(spread @ rng.choice([-1.0, 1.0], 6))
    wrong = LoopClosure(5, 5 + n // 2, shifted, np.diag(SIGMAS**2))
    assert graph.add_loop(wrong)  # nothing contradicts it yet
    for loop in right_loops(truth, rng, 8):
        graph.add_loop(loop)
    assert graph.active == (False, *[True] * 8)


def test_chi_squared_is_the_same_before_and_after_the_loop_is_in():
    truth = square(20, 2)
    rng = np.random.default_rng(12)
    graph = filled(drifted(truth, rng), max_chi2=1e9, kernel_width=np.inf)
    for loop in right_loops(truth, rng, 3):
        graph.add_loop(loop)
    extra = right_loops(truth, rng, 7)[3]
    between, covariance = graph.relative(extra.earlier, extra.later)
    before = chi_squared(
        extra.earlier_T_later, extra.covariance, between, covariance, included=False
    )
    graph.add_loop(extra)
    assert graph.chi_squared(3) == pytest.approx(before, rel=0.05)
    assert before < 40.0


def test_bad_loops_are_refused():
    graph = filled(square(4, 1))
    good = LoopClosure(0, 9, gtsam.Pose3(), np.eye(6))
    nan = np.full((6, 6), np.nan)
    lopsided = np.eye(6) + np.eye(6, k=2)
    for change in (
        {"later": 16},
        {"earlier": -1},
        {"later": 0},
        {"earlier": 9, "later": 0},
        {"later": 1},
    ):
        with pytest.raises(InputError, match="keyframe"):
            graph.add_loop(replace(good, **change))
    for covariance in (np.eye(5), nan, -np.eye(6), lopsided):
        with pytest.raises(InputError, match="covariance: expected"):
            graph.add_loop(replace(good, covariance=covariance))
    assert graph.loops == []
    assert not graph.add_loop(replace(good, covariance=1e-6 * np.eye(6)))
    assert graph.active == (False,)


# -- a whole graph at once -------------------------------------------------------------------------


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


def test_same_input_same_output():
    def run():
        truth = square(20, 2)
        rng = np.random.default_rng(7)
        graph = filled(drifted(truth, rng))
        for loop in [*right_loops(truth, rng, 4), *wrong_loops(4, len(truth), rng)]:
            graph.add_loop(loop)
        return graph.poses(), graph.covariance(50)

    for one, two in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(one, two)


# -- pairwise consistency --------------------------------------------------------------------------


def test_loops_agree_if_their_cycle_closes():
    truth = square(10, 2)
    keyframes = filled(truth).keyframes
    config = settings().pose_graph
    one, other = (
        LoopClosure(a, b, truth[a].between(truth[b]), np.diag(SIGMAS**2))
        for a, b in ((3, 43), (7, 49))
    )
    assert consistent(one, other, keyframes, config)
    assert consistent(other, one, keyframes, config)
    aside = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.6, 0.0]))
    off_by = replace(other, earlier_T_later=other.earlier_T_later.compose(aside))
    assert not consistent(one, off_by, keyframes, config)
    assert not consistent(off_by, one, keyframes, config)
    # Both off alike agree with each other.
    near = replace(one, earlier=4, later=44, earlier_T_later=truth[4].between(truth[44]))
    shifted = [replace(loop, earlier_T_later=loop.earlier_T_later.compose(aside))
               for loop in (one, near)]  # fmt: skip
    assert consistent(*shifted, keyframes, config)


def test_the_covariance_of_a_cycle_is_that_of_monte_carlo():
    """Pairs of right loops over a drifting odometry pass as often as 6 freedoms let them."""
    truth = square(10, 2)
    rng = np.random.default_rng(5)
    limit = 10.64  # exceeded by a tenth
    config = settings(max_chi2=limit).pose_graph
    passed = 0
    for _ in range(200):
        nothing, none = np.empty((0, 3)), np.empty(0, np.bool_)
        keyframes = [
            Keyframe(number, update, float(number), nothing, nothing, none)
            for number, update in enumerate(frames(drifted(truth, rng)))
        ]
        pair = []
        for a, b in ((3, 43), (9, 51)):
            seen = truth[a].between(truth[b]).retract(SIGMAS * rng.normal(size=6))
            pair.append(LoopClosure(a, b, seen, np.diag(SIGMAS**2)))
        passed += consistent(*pair, keyframes, config)
    assert 0.83 < passed / 200 < 0.96


def test_the_largest_group_that_agrees_is_found():
    consistency = LoopConsistency(settings().pose_graph, [], [])
    groups = [{1, 2, 4}, {0, 2}, {0, 1}, set(), {0}]
    consistency.agreeing = lambda number: groups[number]
    assert consistency.clique(2) == {0, 1, 2}
    assert consistency.clique(4) == {0, 4}
    assert consistency.clique(3) == {3}


@pytest.mark.parametrize(("count", "believed"), [(4, False), (10, True)])
def test_loops_that_agree_are_believed_against_an_odometry_worse_than_it_knows(count, believed):
    rng = np.random.default_rng(0)
    truth = square(20, 2)
    bend = gtsam.Pose3(gtsam.Rot3.Yaw(0.003), np.array([0.01, 0.03, 0.0]))  # 3 % of the way
    odometry = [truth[0]]
    for one, two in pairwise(truth):
        odometry.append(odometry[-1].compose(one.between(two)).compose(bend))
    graph = filled(odometry, walk=0.02, turn_walk_deg=0.02, believed_loops=6)
    for loop in right_loops(truth, rng, count):
        graph.add_loop(loop)
    assert sum(graph.active) == (count if believed else 0)
    wrong = wrong_loops(30, len(truth), rng)
    for loop in wrong:
        graph.add_loop(loop)
    assert sum(graph.active[count:]) == 0
    if believed:
        assert off(graph, truth) < 0.5 * off(filled(odometry), truth)


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
        there = truth[k].retract(SIGMAS * rng.normal(size=6))
        assert graph.add_loop(
            LoopClosure(k, k + count, truth[k].between(there), np.diag(SIGMAS**2))
        )
    wrong = gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([5.0, 5.0, 0.0]))
    assert not graph.add_loop(LoopClosure(4, count + 20, wrong, np.diag(SIGMAS**2)))
    assert off(graph, truth + truth) < 0.2
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
