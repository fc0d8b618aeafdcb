"""Loops: places that are found again, places that only look alike, and why candidates fall."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from support.worlds import OWN, STEP, World, there_and_back, updates

from loam_gtsam.config import Config
from loam_gtsam.datasets.sim.scenes import BUILDERS
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.workers import extract
from loam_gtsam.loops.closure import Rejection, ScanLoopCloser, _odometry_distance
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.loops.pose_graph import PoseGraph


class Corridor(World):
    """Two long walls, a floor and a ceiling; every place looks the same."""

    def __init__(self):
        rng = np.random.default_rng(0)
        x = np.repeat(np.arange(-60.0, 100.0, 0.4), 8)
        side = np.tile(np.linspace(-1.5, 1.5, 8), len(x) // 8)
        jitter = rng.uniform(-0.2, 0.2, len(x))
        walls = [np.column_stack([x + jitter, side, np.full(len(x), z)]) for z in (-1.5, 1.5)]
        walls += [np.column_stack([x + jitter, np.full(len(x), y), side]) for y in (-1.5, 1.5)]
        self.planes, self.edges = np.concatenate(walls), np.zeros((0, 3))


def settings(**loops):
    config = Config()
    chosen = {"min_way": 15.0, "min_share": 0.4} | loops  # these worlds are thinly sampled
    pose_graph = config.pose_graph.changed(keyframe_distance=1.0)
    return config.changed(pose_graph=pose_graph, loops=config.loops.changed(**chosen))


def driven(world, poses, made, config, seed=0):
    """The graph of a run in which every frame is a keyframe, and the loops that were found."""
    rng = np.random.default_rng(seed)
    graph, closer = PoseGraph(config), ScanLoopCloser(config)
    loops = []
    for pose, update in zip(poses, made, strict=True):
        keyframe = graph.add(update, world.seen(pose, update.stamp, rng))
        loop = closer.detect(keyframe, graph)
        if loop is not None:
            loops.append(loop)
            graph.add_loop(loop)
    return graph, closer, loops


def off(loop, poses):
    """Metres and rad."""
    true = poses[loop.earlier].between(poses[loop.later])
    error = true.localCoordinates(loop.earlier_T_later)
    return np.linalg.norm(error[3:]), np.linalg.norm(error[:3])


@pytest.mark.parametrize("heading", [0.0, 1.9, np.pi])
def test_a_place_is_found_again_with_any_heading(heading):
    poses = there_and_back(heading)
    made = updates(poses, drift=(0.0, 0.0, 5e-4, 0.015, 0.005, 0.01))
    graph, closer, loops = driven(World(1), poses, made, settings())
    assert len(loops) > 8
    assert max(off(loop, poses)[0] for loop in loops) < 0.1
    assert max(off(loop, poses)[1] for loop in loops) < 0.01
    assert all(graph.active)
    assert closer.statistics.verified == len(loops)
    assert closer.statistics.keyframes == len(graph) == len(poses)
    last = len(poses) - 1
    true, before = poses[last].translation(), made[last].map_T_lidar.translation()
    assert np.linalg.norm(before - true) > 0.2
    assert np.linalg.norm(graph.pose(last).translation() - true) < 0.1


def test_a_street_is_recognised_on_the_way_back():
    """The built-in street, along it and back on the other lane."""
    lane = np.arange(-60.0, 61.0, 30.0)
    bend = np.array([[80.0, -54], [88, -45], [84, -36], [76, -40], [70, -50]])
    out, back = (np.column_stack([lane, np.full(5, y)]) for y in (-55.0, -53.0))
    way = np.concatenate([out, bend, back[::-1]])
    scene = replace(BUILDERS["street_loop"](0), waypoints=way, closed=False)
    world = SimulatedWorld(scene, columns=450, speed=10.0)
    config = settings(min_way=20.0, min_share=0.5)
    numbers = [*range(40, 82, 3), *range(312, 336, 6)]  # what lies between is left out
    truth = world.truth_at(np.array([world[n].stamp for n in numbers])).map_T_lidar
    poses = [gtsam.Pose3(pose) for pose in truth]
    graph, closer = PoseGraph(config), ScanLoopCloser(config)
    found = []
    for number, update in zip(numbers, updates(poses), strict=True):
        scan = world[number]
        features = extract(scan, config).features
        ends = world.truth_at(np.array([scan.stamp, scan.stamp + 10**8])).map_T_lidar
        twist = gtsam.Pose3.Logmap(gtsam.Pose3(ends[0]).between(gtsam.Pose3(ends[1]))) / 0.1
        stamped = replace(update, stamp=features.stamp, twist=twist)
        keyframe = graph.add(stamped, features)
        loop = closer.detect(keyframe, graph)
        if loop is not None:
            found.append(loop)
    assert len(found) >= 2
    for loop in found:
        assert off(loop, poses)[0] < 0.1
        assert off(loop, poses)[1] < 0.005
        assert abs(loop.earlier_T_later.rotation().yaw()) > 3.0


def test_the_covariance_is_about_right():
    poses = there_and_back(2.0)
    _, _, loops = driven(World(3), poses, updates(poses), settings())
    nees = []
    for loop in loops:
        true = poses[loop.earlier].between(poses[loop.later])
        error = true.localCoordinates(loop.earlier_T_later)
        nees.append(error @ np.linalg.solve(loop.covariance, error))
    assert len(loops) > 8
    assert 0.05 < np.mean(nees) < 12.0  # of 6; the poses here have none of the error they claim


def test_a_corridor_is_no_place():
    poses = there_and_back(0.0, aside=0.3)
    _, closer, loops = driven(Corridor(), poses, updates(poses), settings())
    assert loops == []
    assert closer.statistics.rejected[Rejection.DEGENERATE] > 8


def test_another_place_that_the_drift_would_allow_is_rejected():
    """On the way back the world is another one, as behind a building that the gate reaches over."""
    poses = there_and_back(np.pi, turn_at=20)
    config = settings(max_unlike=1.0)  # leave it to the registration
    graph, closer = PoseGraph(config), ScanLoopCloser(config)
    rng = np.random.default_rng(0)
    worlds = [World(1)] * 10 + [World(2)] * (len(poses) - 10)
    for world, pose, update in zip(worlds, poses, updates(poses), strict=True):
        keyframe = graph.add(update, world.seen(pose, update.stamp, rng))
        assert closer.detect(keyframe, graph) is None
    rejected = closer.statistics.rejected
    assert rejected[Rejection.LITTLE_OVERLAP] + rejected[Rejection.DISAGREES] > 3
    strict = ScanLoopCloser(settings(max_unlike=0.05))
    assert strict.detect(graph.keyframes[-1], graph) is None
    assert strict.statistics.rejected == {Rejection.UNLIKE: 1}


@pytest.fixture(scope="module")
def back_again():
    poses = there_and_back(0.5, turn_at=20)
    graph, closer, _ = driven(World(1), poses, updates(poses), settings(min_way=12.0))
    return poses, graph, closer


def test_a_right_candidate_is_verified(back_again):
    poses, graph, closer = back_again
    good = closer.verify(graph.keyframes[-1], 1, graph)
    assert (good.earlier, good.later) == (1, len(poses) - 1)
    assert 0.5 < good.share <= 1.0
    assert off(good, poses)[0] < 0.1
    assert 0.9 < good.agreement <= 1.0


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (["loops.min_share=1.0"], Rejection.LITTLE_OVERLAP),
        (["loops.min_aligned=1e6"], Rejection.DEGENERATE),
        # The noise is 0.01.
        (["matching.point_sigma=0.001", "matching.fit_uncertainty=false"], Rejection.DISAGREES),
    ],
)
def test_every_test_of_a_registration_can_reject(back_again, changes, reason):
    _, graph, _ = back_again
    strict = ScanLoopCloser(settings(min_way=12.0).changed(*changes))
    assert strict.verify(graph.keyframes[-1], 1, graph) is reason


def test_too_few_features_to_solve(back_again):
    _, graph, closer = back_again
    last = graph.keyframes[-1]
    few = replace(last, edges=last.edges[:5], planes=last.planes[:20], distinct=last.distinct[:5])
    # What cannot be solved overlaps with nothing.
    assert closer.verify(few, 1, graph) is Rejection.FEW_MATCHES


def test_where_not_to_look():
    poses = there_and_back(0.5, turn_at=20)
    made = updates(poses)
    world, rng = World(1), np.random.default_rng(0)

    def reasons(config, features=True, made=made):
        graph, closer = PoseGraph(config), ScanLoopCloser(config)
        for pose, update in zip(poses, made, strict=True):
            seen = world.seen(pose, update.stamp, rng) if features else None
            keyframe = graph.add(update, seen)
        closer.detect(keyframe, graph)
        return closer.statistics.rejected

    assert reasons(settings(), features=False) == {Rejection.NO_FEATURES: 1}
    assert reasons(settings(min_way=1e3)) == {Rejection.TOO_RECENT: 1}
    tight = {"gate": 0.0, "gate_drift": 0.0, "gate_sigmas": 3.0}
    assert reasons(settings(**tight)) == {Rejection.OUT_OF_REACH: 1}
    # The same with poses that are less sure of themselves.
    unsure = updates(poses, step=1e4 * STEP)
    assert reasons(settings(**tight), made=unsure)[Rejection.OUT_OF_REACH] == 0
    assert reasons(settings(**tight | {"gate": 30.0}))[Rejection.OUT_OF_REACH] == 0
    assert reasons(settings(**tight | {"gate_drift": 1.0}))[Rejection.OUT_OF_REACH] == 0


def test_a_keyframe_is_no_loop_with_itself_or_the_one_before():
    config, rng = settings(min_way=0.0, gate=50.0), np.random.default_rng(0)
    graph, closer = PoseGraph(config), ScanLoopCloser(config)
    poses = [gtsam.Pose3(gtsam.Rot3(), np.array([5.0 * k, 0, 0])) for k in range(3)]
    for number, (pose, update) in enumerate(zip(poses, updates(poses), strict=True)):
        keyframe = graph.add(update, World(1).seen(pose, update.stamp, rng))
        loop = closer.detect(keyframe, graph)
        assert loop is None or (loop.earlier, loop.later) == (0, 2)
        assert closer.statistics.rejected[Rejection.TOO_RECENT] == min(number + 1, 2)
    assert closer.statistics.candidates == 1


def test_what_loops_have_tied_is_looked_for_less_far():
    """The drift that nobody knows grows with the way from the last loop, not from the start."""
    graph = PoseGraph(settings())
    straight = [gtsam.Pose3(gtsam.Rot3(), np.array([2.0 * k, 0, 0])) for k in range(40)]
    for update in updates(straight):
        graph.add(update)
    last = graph.keyframes[-1]
    distances = _odometry_distance(last, graph.keyframes, graph)
    np.testing.assert_allclose(distances, 78.0 - 2.0 * np.arange(40), atol=1e-6)
    loop = LoopClosure(3, 35, graph.pose(3).between(graph.pose(35)), OWN)
    assert graph.add_loop(loop)
    tied = _odometry_distance(last, graph.keyframes, graph)
    assert tied[3] == pytest.approx(8.0)  # from the end of the loop to the last
    assert tied[0] == pytest.approx(8.0 + 6.0)
    assert tied[37] == pytest.approx(4.0)
