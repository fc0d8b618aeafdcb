"""The map follows the loops, and the mapper's own pose does not jump."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from support.quick import PREDICTED
from support.worlds import OWN, World, there_and_back, updates

from loam_gtsam.config import Config, preset
from loam_gtsam.datasets import SimulatedWorld, open_dataset
from loam_gtsam.io.state import freeze, thaw
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.loops.map_correction import LoopMapping
from loam_gtsam.mapper import Mapper
from loam_gtsam.maps.map_graph import graph_arrays, graph_of, graph_of_arrays
from loam_gtsam.pipeline import Pipeline, imu_buffer, run
from loam_gtsam.registration.frame_matcher import MapPair
from loam_gtsam.registration.solvers import GtsamSolver
from loam_gtsam.registration.uncertainty import PoseErrors
from loam_gtsam.types import InputError

UP = np.array([0.0, 0.0, 3.0])
POSES = there_and_back(np.pi)
DRIFT = (0.0, 0.0, 0.002, 0.0, 0.02, 0.0)  # rad and m a step


def settings(**pose_graph):
    config = Config()
    chosen = {"keyframe_distance": 0.5, "walk": 0.05, "turn_walk_deg": 0.3} | pose_graph
    return config.changed(pose_graph=config.pose_graph.changed(**chosen))


class Known:
    """A loop closer that knows the truth, from some keyframe on."""

    def __init__(self, first):
        self.first = first

    def detect(self, keyframe, history):
        later, earlier = keyframe.index, len(POSES) - 1 - keyframe.index
        if later < self.first or later - earlier < 2:
            return None
        return LoopClosure(earlier, later, POSES[earlier].between(POSES[later]), OWN)


def driven(first, look=False, **pose_graph):
    """A way out and back, with a mark above each keyframe in the mapper's map.

    Loops are found from the keyframe ``first`` on; ``look`` asks for the map after every frame.
    """
    config = settings(**pose_graph)
    mapper = Mapper(config)
    loops = LoopMapping(mapper, config, Known(first))
    world, rng = World(0), np.random.default_rng(0)
    closed = []
    for update in updates(POSES, DRIFT):
        features = world.seen(gtsam.Pose3(), update.stamp, rng)
        closed.append(loops.add(update, features))
        mapper.maps.edges.owner = mapper.maps.keyframe
        mapper.maps.edges.insert((update.map_T_lidar.translation() + UP)[None])
        if look:
            loops.map_points()
            loops.counts()
            loops.loop_ends()
    return mapper, loops, closed


def marks(mapper):
    return np.sort(mapper.map_points()[0], axis=0)


def test_the_map_follows_its_keyframes():
    mapper, loops, closed = driven(first=30)
    assert not any(closed[:30])
    assert all(closed[30:])
    of = f"{len(loops.graph.loops)} of {len(loops.graph.loops)} loops"
    graph = f"PoseGraph({len(loops.graph)} keyframes, {of})"
    assert repr(loops) == f"LoopMapping({graph}, {loops.points_moved} map points moved)"
    wanted = loops.graph.poses()[:, :3, 3] + loops.graph.poses()[:, :3, :3] @ UP
    off = np.abs(marks(mapper) - np.sort(wanted, axis=0)).max()
    assert off > 1e-6  # the mapper's frame is another
    corrected = np.sort(loops.map_points()[0], axis=0)
    np.testing.assert_allclose(corrected, np.sort(wanted, axis=0), atol=2e-3)
    saved = np.sort(loops.corrected_maps().points()[0], axis=0)
    np.testing.assert_allclose(saved, corrected, atol=1e-9)
    truth = np.array([pose.translation() for pose in POSES])
    odometry = np.array([update.map_T_lidar.translation() for update in updates(POSES, DRIFT)])
    before = np.linalg.norm(odometry - truth, axis=1).max()
    after = np.linalg.norm(loops.graph.poses()[:, :3, 3] - truth, axis=1).max()
    assert after < 0.5 * before


def test_places_and_motions_of_a_saved_map_are_those_of_the_graph():
    _, loops, _ = driven(first=30)
    saved = graph_of(loops, Config())
    for place, keyframe in zip(saved.places, loops.graph.keyframes, strict=True):
        pose = loops.graph.pose(keyframe.index)
        np.testing.assert_allclose(place.map_T_middle.matrix(), pose.matrix(), atol=1e-9)
        back = pose.inverse().AdjointMap()
        told = back @ place.covariance @ back.T
        np.testing.assert_allclose(told, loops.graph.covariance(keyframe.index), atol=1e-9)
    assert [(link.earlier, link.later) for link in saved.links] == [
        (number, number + 1) for number in range(len(POSES) - 1)
    ]
    assert [(one.earlier, one.later) for one in saved.loops] == [
        (one.earlier, one.later) for one in loops.graph.loops
    ]
    again = graph_of_arrays(graph_arrays(saved, Config().loops))
    for one, other in zip([*saved.links, *saved.loops], [*again.links, *again.loops], strict=True):
        np.testing.assert_array_equal(one.covariance, other.covariance)
        assert one.earlier_T_later.equals(other.earlier_T_later, 1e-12)


def test_the_newest_keyframe_and_its_points_stay():
    mapper, loops, _ = driven(first=len(POSES) - 1)
    last = loops.graph.keyframes[-1]
    newest = loops.map_T_odom.inverse().compose(loops.graph.pose(last.index))
    np.testing.assert_allclose(newest.matrix(), last.odom_T_lidar.matrix(), atol=1e-9)
    points = mapper.map_points()[0]
    mark = last.odom_T_lidar.translation() + UP
    assert np.linalg.norm(points - mark, axis=1).min() < 1e-9
    assert loops.points_moved > 0


@pytest.mark.parametrize(("metres", "moves"), [(100.0, False), (0.0, True)])
def test_only_keyframes_that_lie_elsewhere_move_their_points(metres, moves):
    mapper, loops, _ = driven(first=30, follow_distance=metres, follow_angle_deg=180.0)
    assert (loops.points_moved > 0) == moves
    before = marks(mapper)
    loops.correct_map(metres, 180.0)  # nothing is left to do
    np.testing.assert_array_equal(marks(mapper), before)


@pytest.mark.parametrize("metres", [100.0, 1e-3])
def test_the_pose_errors_learn_of_the_step_of_the_nearest_points_that_move(metres, monkeypatch):
    steps, moves = [], []
    monkeypatch.setattr(PoseErrors, "moved", lambda _, step: steps.append(step.matrix()))
    move = MapPair.move
    monkeypatch.setattr(MapPair, "move", lambda self, by: moves.append(by) or move(self, by))
    driven(first=len(POSES) - 1, follow_distance=metres, follow_angle_deg=180.0)
    assert len(steps) == len(moves) == (metres < 1.0)
    if steps:
        *earlier, last = (update.map_T_lidar for update in updates(POSES, DRIFT))
        nearest = min(moves[0], key=lambda index: last.range(earlier[index]))
        np.testing.assert_array_equal(steps[0], moves[0][nearest])


def test_counts_and_ends_are_those_of_the_graph():
    _, loops, _ = driven(first=30)
    counts = loops.counts()
    closed = len(POSES) - 30
    assert counts == {"keyframes": len(POSES), "loops": closed, "on": closed, "forgotten": 0}
    ends, on = loops.loop_ends()
    assert ends.shape == (counts["loops"], 2, 3)
    assert on.all()
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max() < 4.2


def assert_same(one, two):
    """To the last bit: the poses, the mapper's map, and the corrected one."""
    assert one[2] == two[2]
    assert one[1].points_moved == two[1].points_moved
    np.testing.assert_array_equal(one[1].graph.poses(), two[1].graph.poses())
    for found, wanted in zip(one[:2], two[:2], strict=True):
        for points, others in zip(found.map_points(), wanted.map_points(), strict=True):
            np.testing.assert_array_equal(points, others)


def test_to_look_at_the_map_changes_nothing():
    limits = {"follow_distance": 0.1, "follow_angle_deg": 0.3}  # so that something is left to do
    looked = driven(first=30, look=True, **limits)
    assert_same(looked, driven(first=30, **limits))
    corrected = looked[1].map_points()
    looked[1].correct_map()
    assert looked[1].points_moved > 0
    for points, wanted in zip(corrected, looked[1].map_points(), strict=True):
        np.testing.assert_allclose(points, wanted, atol=1e-12)


class Remembering:
    """A loop closer of one's own, which finds a loop with the keyframe it saw four before."""

    def __init__(self):
        self.seen = []

    def detect(self, keyframe, history):
        self.seen.append(keyframe.index)
        if len(self.seen) < 5:
            return None
        earlier = self.seen[-5]
        off = np.array([1e-4, 0.0, 2e-4, 3e-3, -2e-3, 1e-3])
        motion = history.pose(earlier).between(history.pose(keyframe.index)).retract(off)
        return LoopClosure(earlier, keyframe.index, motion, OWN)

    def reset(self):
        self.seen = []


@pytest.mark.parametrize("coupling", ["loose", "tight"])
@pytest.mark.parametrize("begin", ["resumed", "reset"])
def test_a_run_with_loops_goes_on_or_begins_anew_to_the_last_bit(begin, coupling):
    """With a loop closer of one's own, and looked at after every frame."""
    dataset = open_dataset("sim:corridor?frames=16&columns=300&speed=8")
    limits = {"keyframe_distance": 0.1, "follow_distance": 1e-4, "follow_angle_deg": 1e-4}
    config = settings(**limits).changed(f"imu.coupling={coupling}", PREDICTED)
    sweeps = list(dataset)

    def pipeline():
        imu = imu_buffer(dataset, config)
        return Pipeline(config, imu=imu, loop_closer=Remembering())

    whole, other = pipeline(), pipeline()
    for sweep in sweeps[:9]:
        whole.process(sweep)
    if begin == "resumed":
        thaw(freeze(*whole.state()), *other.state())
        rest = sweeps[9:]
    else:
        whole.reset()
        rest = sweeps
    expected = [whole.process(sweep).map_T_lidar for sweep in rest]
    for sweep, pose in zip(rest, expected, strict=True):
        np.testing.assert_array_equal(other.process(sweep).map_T_lidar.matrix(), pose.matrix())
        other.map_points()
    assert sum(whole.loops.graph.active) > 3
    assert whole.loops.points_moved > 0
    assert_same((whole.mapper, whole.loops, 0), (other.mapper, other.loops, 0))


STEP = 2.5  # metres from one sweep to the next


class Drifting:
    """A solver that turns a little too far in every frame."""

    def __init__(self, config):
        self.solver, self.last = GtsamSolver(config), None

    def solve(self, associate, guess, priors=(), motion=None):
        found = self.solver.solve(associate, guess, priors, motion)
        if self.last is not None:
            way = min(STEP, self.last.range(found.map_T_lidar))  # a start solves any of its sweeps
            turn = gtsam.Pose3(gtsam.Rot3.Yaw(0.002 * way), np.zeros(3))
            found = replace(found, map_T_lidar=found.map_T_lidar.compose(turn))
        self.last = found.map_T_lidar
        return found


def ring(laps, radius=35.0, step=2.0):
    angles = np.arange(0.0, 2.0 * np.pi * laps, step / radius)
    way = [np.array([20.0 + radius * np.cos(a), 20.0 + radius * np.sin(a), 0.0]) for a in angles]
    headings = [gtsam.Rot3.Yaw(angle + np.pi / 2) for angle in angles]
    return list(map(gtsam.Pose3, headings, way))


def test_a_run_that_drifts_is_corrected_and_goes_on_without_a_jump():
    """Once round a ring, of which 20 m are in view, and on."""
    config = settings(turn_walk_deg=0.2)
    config = config.changed("loops.min_way=60.0", "loops.min_share=0.4", PREDICTED)
    poses, world = ring(1.15, radius=28.0, step=STEP), World(1)

    rng, odometry, jumps, closes = np.random.default_rng(0), [], [], []
    mapper = Mapper(config, Drifting(config.solver))
    loops = LoopMapping(mapper, config)
    for number, pose in enumerate(poses):
        features = world.seen(pose, number * 10**8, rng)
        guess = odometry[-1].compose(poses[number - 1].between(pose)) if number else pose
        update = mapper.register(features, guess)
        odometry.append(update.map_T_lidar)
        jumps.append(np.linalg.norm(guess.localCoordinates(update.map_T_lidar)[3:]))
        closes.append(loops.add(update, features))
    assert loops.map_points()[1].shape[1] == 3
    first = closes.index(True)
    left_open = poses[first].range(odometry[first])  # no loop has moved the map by then
    closed = [loops.map_T_odom.compose(pose) for pose in odometry]
    assert loops.counts()["on"] >= 3
    assert loops.points_moved > 0
    assert left_open > 0.5
    assert max(p.range(q) for p, q in zip(poses[76:], closed[76:], strict=True)) < 0.5 * left_open
    assert max(jumps) < 0.2  # odom is continuous


PLACES = [gtsam.Pose3(gtsam.Rot3.Yaw(t), 8.0 * np.array([np.sin(t), -np.cos(t), 0.0]))
          for t in np.arange(12) * np.pi / 6]  # fmt: skip


class Round:
    """A loop closer that knows the truth of laps over PLACES, and closes with the first lap."""

    def __init__(self, laps=99):
        self.laps = laps

    def detect(self, keyframe, history):
        lap, place = divmod(keyframe.index, len(PLACES))
        if not 0 < lap < self.laps:
            return None
        return LoopClosure(place, keyframe.index, gtsam.Pose3(), OWN)


def driven_round(laps, closer=None, gps=(), **pose_graph):
    mapper = Mapper(config := settings(**{"walk": 0.02, "turn_walk_deg": 0.1} | pose_graph))
    loops = LoopMapping(mapper, config, closer or Round())
    drives = updates(laps * PLACES, (0.0, 0.0, 1e-4, 0.0, 2e-3, 0.0))
    for number, update in enumerate(drives):
        loops.add(update, None)
        if number in gps:
            where = PLACES[number % len(PLACES)].translation()
            loops.graph.add_position(number, where, 0.01 * np.eye(3))
    found = loops.graph.trajectory(drives).positions
    truth = np.array([pose.translation() for pose in laps * PLACES])
    return mapper, loops, np.linalg.norm(found - truth, axis=1)


def test_a_place_that_is_visited_again_and_again_takes_no_more_room():
    """Keyframes beyond ``visits`` are forgotten, and the run is as right as with all of them."""
    (_, some, error), (_, every, least) = (driven_round(12, visits=visits) for visits in (2, 99))
    counts = some.counts()
    assert counts["keyframes"] == 3 * len(PLACES) + 1  # the newest one is there until the next
    assert counts["loops"] == counts["on"] == 2 * len(PLACES) + 1
    assert counts["keyframes"] + counts["forgotten"] == every.counts()["keyframes"] == 144
    assert error.max() < 1.5 * least.max() < 0.1
    first, last = 3, some.graph.keyframes[-1].index
    sigmas = [np.diag(loops.graph.relative(first, last)[1]) for loops in (some, every)]
    assert (sigmas[0] > 0.9 * sigmas[1]).all()  # what is forgotten is not counted
    assert (sigmas[0] < 5.0 * sigmas[1]).all()  # 3 passes, not 12
    with pytest.raises(InputError, match="got 100, which was forgotten"):
        some.graph.pose(100)
    steps = len(some.graph._graph.__getstate__())
    assert steps <= 4 * (counts["keyframes"] + counts["loops"]) + 101


@pytest.mark.parametrize("name", ["loam", "aloam"])
def test_a_loop_closer_of_ones_own_goes_with_the_odometry_of_a_preset(name):
    """Which has a public method ``remember``, as what rolls a failed sweep back once had."""

    class Closer:
        def detect(self, keyframe, history):
            return None

    result = run(SimulatedWorld("room", frames=3, columns=300), preset(name), loop_closer=Closer())
    assert len(result.updates) == 3
    assert result.loops is not None


def test_odometry_back_to_a_known_place_is_no_loop():
    """Its keyframes do not follow one another, as the one before was forgotten."""
    _, loops, _ = driven_round(4, visits=1)
    saved = loops.graph.saved()
    assert len(saved.loops) == len(loops.graph.loops) < len(replace(saved, closures=None).loops)


def test_points_seen_from_a_forgotten_keyframe_belong_to_its_place():
    mapper, loops, _ = driven_round(4, visits=1)
    assert loops.counts()["forgotten"] == 2 * len(PLACES) - 1
    assert mapper.maps.keyframe == len(PLACES) - 1
    assert set(loops._placed) == set(range(2 * len(PLACES)))


def test_a_keyframe_is_forgotten_only_where_it_surely_is_at_a_known_place():
    _, lost, _ = driven_round(4, Round(laps=0), visits=1, walk=0.2)  # off by decimetres
    assert lost.counts()["forgotten"] == 0
    known = {"walk": 1e-3, "turn_walk_deg": 1e-3}
    _, sure, _ = driven_round(4, Round(laps=0), visits=1, **known)  # needs no loop
    assert sure.counts()["forgotten"] > len(PLACES)
    _, marked, _ = driven_round(4, visits=1, gps=[30, 31])  # factors of a user's own
    assert {30, 31} <= {keyframe.index for keyframe in marked.graph.keyframes}


def test_a_graph_that_has_forgotten_keyframes_goes_on_to_the_last_bit():
    drives = updates(9 * PLACES, (0.0, 0.0, 1e-4, 0.0, 2e-3, 0.0))
    config = settings(walk=0.02, visits=1)
    whole, other = (Pipeline(config.changed("loops.enabled=true"), loop_closer=Round())
                    for _ in range(2))  # fmt: skip
    for update in drives[:77]:
        whole.loops.add(update, None)
    thaw(freeze(*whole.state()), *other.state())
    for update in drives[77:]:
        for pipeline in (whole, other):
            pipeline.loops.add(update, None)
    np.testing.assert_array_equal(whole.loops.graph.poses(), other.loops.graph.poses())
    one, two = (p.loops.graph.trajectory(drives).map_T_lidar for p in (whole, other))
    np.testing.assert_array_equal(one, two)
    assert whole.loops.counts()["forgotten"] > 50
