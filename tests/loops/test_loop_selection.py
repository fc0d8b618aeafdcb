"""Selection of loop closures: the tests of each, and right, wrong and contradicting ones."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from support.pose_graphs import (
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

from loam_gtsam.loops.batch import optimize_graph
from loam_gtsam.loops.keyframes import Keyframe, LoopClosure
from loam_gtsam.loops.loop_selection import chi_squared, consistent, consistent_set, loop_to_switch


def test_chi_squared_is_the_same_before_and_after_the_loop_is_in():
    truth = square(20, 2)
    rng = np.random.default_rng(12)
    graph = filled(drifted(truth, rng), max_chi2=1e9, kernel_width=np.inf)
    for loop in right_loops(truth, rng, 3):
        graph.add_loop(loop)
    extra = right_loops(truth, rng, 7)[3]
    known = graph.relative(extra.earlier, extra.later)
    before = chi_squared(extra.earlier_T_later, extra.covariance, *known, included=False)
    graph.add_loop(extra)
    assert graph.chi_squared(3) == pytest.approx(before, rel=0.05)
    assert before < 40.0


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
    two = (replace(k, earlier_T_later=k.earlier_T_later.compose(aside)) for k in (one, near))
    assert consistent(*two, keyframes, config)


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
    groups = [{1, 2, 4}, {0, 2}, {0, 1}, set(), {0}]
    assert consistent_set(2, groups.__getitem__) == {0, 1, 2}
    assert consistent_set(4, groups.__getitem__) == {0, 4}
    assert consistent_set(3, groups.__getitem__) == {3}


@pytest.mark.parametrize(
    ("active", "distances", "expected"),
    [
        ([True, True, False], [41.0, 50.0, 1.0], 1),  # the worst goes first
        ([True, True, False, False], [40.0, 2.0, 30.0, 20.0], 3),  # then the best comes
        ([True, False], [40.0, 40.1], None),
        ([False, False], [99.0, 41.0], None),
        ([], [], None),
    ],
)
def test_the_loop_that_contradicts_most_is_switched_first(active, distances, expected):
    assert loop_to_switch(np.array(active, bool), np.array(distances), 40.0) == expected


def test_fifty_wrong_loops_do_not_bend_ten_right_ones():
    truth = square(25, 2)
    rng = np.random.default_rng(0)
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
    bend = gtsam.Pose3(gtsam.Rot3.Yaw(0.0001), np.array([0.003, 0.0, 0.006]))  # 0.7 % of the way
    odometry = [truth[0]]
    for one, two in pairwise(truth):
        odometry.append(odometry[-1].compose(one.between(two)).compose(bend))
    graph = filled(odometry, 0.2 * SIGMAS, believed_loops=6)
    for loop in right_loops(truth, rng, count):
        graph.add_loop(loop)
    assert sum(graph.active) == (count if believed else 0)
    wrong = wrong_loops(30, len(truth), rng)
    for loop in wrong:
        graph.add_loop(loop)
    assert sum(graph.active[count:]) == 0
    batch = optimize_graph(graph.saved())
    assert sum(report.active for report in batch.loops[:count]) >= sum(graph.active)
    if believed:
        assert off(graph.poses(), truth) < 0.5 * off(filled(odometry).poses(), truth)


@pytest.mark.parametrize("backed", [True, False])
@pytest.mark.parametrize("turned", [False, True])
def test_no_number_of_look_alike_places_is_believed_against_the_odometry(turned, backed):
    """All along one side, off alike by more than any odometry drifts: another aisle."""
    truth = square(20, 2)
    graph = filled(truth, believed_loops=6)
    spread = np.diag(SIGMAS**2)
    if backed:
        assert graph.add_loop(LoopClosure(3, 83, truth[3].between(truth[83]), spread))
    aside = gtsam.Pose3(gtsam.Rot3.Yaw(np.pi * turned), np.array([0.0, 6.0 * (not turned), 0.0]))
    for place in range(6, 18):
        seen = truth[place].compose(aside).between(truth[place + 80])
        graph.add_loop(LoopClosure(place, place + 80, seen, spread))
    assert graph.active == (*[True] * backed, *[False] * 12)
    batch = optimize_graph(graph.saved())
    assert tuple(report.active for report in batch.loops) == graph.active
    assert off(batch.poses, truth) < 0.1
