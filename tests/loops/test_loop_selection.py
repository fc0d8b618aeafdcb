"""Which loop closures are used: right ones, wrong ones, ones that contradict the odometry."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from support.pose_graphs import SIGMAS, drifted, filled, off, right_loops, square, wrong_loops

from loam_gtsam.loops.batch import optimize_graph
from loam_gtsam.loops.keyframes import LoopClosure


@pytest.mark.parametrize("seed", [0, 1])
def test_fifty_wrong_loops_do_not_bend_ten_right_ones(seed):
    truth = square(25, 2)
    rng = np.random.default_rng(seed)
    odometry = drifted(truth, rng)
    right = right_loops(truth, rng, 10)
    clean = filled(odometry)
    for loop in right:
        assert clean.add_loop(loop)
    alone = off(clean.poses(), truth)
    assert alone < 0.7 * off(filled(odometry).poses(), truth)
    loops = [*right, *wrong_loops(50, len(truth), rng)]
    order = rng.permutation(len(loops)).tolist()
    graph = filled(odometry)
    for number in order:
        graph.add_loop(loops[number])
    assert graph.active == tuple(number < 10 for number in order)
    assert off(graph.poses(), truth) == pytest.approx(alone, rel=0.05)
    # They are what bends it if they are believed.
    believed = optimize_graph(graph.saved(), robust=False)
    assert off(believed.poses, truth) > 5.0 * alone


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
        assert off(graph.poses(), truth) < 0.5 * off(filled(odometry).poses(), truth)
