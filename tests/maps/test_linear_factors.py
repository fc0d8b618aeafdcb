"""A user's own factors in a saved map: there again as what they say, whatever they were."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest
from support.jacobians import numerical
from support.pose_graphs import SIGMAS, drifted, frames, right_loops, settings, square
from support.quick import QUICK

from loam_gtsam.config import Config
from loam_gtsam.datasets.base import PartOf
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.factors import checked_factor
from loam_gtsam.loops.batch import optimize_graph
from loam_gtsam.loops.keyframes import is_pose, noise_model, pose_key
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.maps.linear_factors import LinearFactors
from loam_gtsam.maps.localizer import Localizer
from loam_gtsam.maps.map_file import SavedMap, save_map
from loam_gtsam.maps.map_graph import MapGraph, graph_arrays, graph_of, graph_of_arrays
from loam_gtsam.maps.merging import merge_maps
from loam_gtsam.pipeline import run
from loam_gtsam.types import FloatArray

SIDE, LAPS = 6, 2
LIDAR_T_MIDDLE = gtsam.Pose3(gtsam.Rot3.Yaw(0.05), np.array([0.1, 0.02, 0.0]))
MOVED = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 2.0), np.array([40.0, -7.0, 3.0]))
"""A whole, in whose frame a map lies somewhere else."""


@dataclass
class Driven:
    """Twice around a square, with loops, and factors of all kinds."""

    graph: PoseGraph
    saved: MapGraph


@pytest.fixture(scope="module")
def driven() -> Driven:
    rng = np.random.default_rng(0)
    truth = square(SIDE, LAPS)
    graph = PoseGraph(settings())
    for update in frames(drifted(truth, rng)):
        graph.add(replace(update, map_T_middle=update.map_T_lidar.compose(LIDAR_T_MIDDLE)))
    for loop in right_loops(truth, rng, 3):
        graph.add_loop(loop)
    for number in (5, 11, 30):
        graph.add_position(number, truth[number].translation() + 0.01, 0.02**2 * np.eye(3))
    graph.add_gravity(9, truth[9].rotation().unrotate(np.array([0.0, 0.0, 1.0])), 0.01)
    far = noise_model(np.diag(SIGMAS**2))
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.0), far)
    motion = truth[2].between(truth[20])
    graph.add_factor(gtsam.BetweenFactorPose3(pose_key(2), pose_key(20), motion, robust))
    graph.add_factor(*landmark(truth))
    height = checked_factor(gtsam.noiseModel.Isotropic.Sigma(1, 0.01), [pose_key(17)], level)
    graph.add_factor(height)
    return Driven(graph, graph_of(SimpleNamespace(graph=graph), settings()))


def landmark(truth: list[gtsam.Pose3]) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A point that is ranged from five keyframes, which no file needs to know."""
    factors, values, key = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.symbol("l", 0)
    point, noise = np.array([3.0, 3.0, 1.0]), gtsam.noiseModel.Isotropic.Sigma(1, 0.01)
    for number in (3, 8, 14, 20, 40):
        away = float(np.linalg.norm(truth[number].transformTo(point))) + 0.005
        factors.add(gtsam.RangeFactor3D(pose_key(number), key, away, noise))
    values.insert(key, point)
    return factors, values


def level(values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
    """The height of a keyframe, in Python, so that GTSAM could not write it."""
    pose = values.atPose3(pose_key(17))
    down = np.concatenate([np.zeros(3), pose.rotation().matrix()[2]])[None]
    return pose.translation()[2:], [down]


def solved(graph: MapGraph) -> tuple[gtsam.Values, gtsam.Marginals]:
    """The places where all that is in the file has them."""
    saved = graph.saved()
    first = graph.places[0].map_T_middle
    to_middle = LIDAR_T_MIDDLE.inverse().AdjointMap()
    noise = noise_model(1e-8 * to_middle @ to_middle.T)
    saved.factors.add(gtsam.PriorFactorPose3(pose_key(0), first, noise))
    if graph.own is not None:
        saved.factors.push_back(graph.own.factors())
        saved.poses.insert(graph.own.start())
    found = optimize_graph(replace(saved, closures=()))
    return found.poses, gtsam.Marginals(found.factors, found.poses)


def test_the_file_says_of_the_places_what_the_graph_of_the_run_says(driven: Driven) -> None:
    """Poses and covariances are those with the factors, and not those without."""
    config = Config().loops
    arrays = graph_arrays(driven.saved, config)
    back = graph_of_arrays(arrays)
    poses, marginals = solved(back)
    without, wider = solved(replace(back, own=None))
    for number, place in enumerate(back.places):
        there = poses.atPose3(pose_key(number))
        assert there.equals(place.map_T_middle, 1e-5)
        to_map = there.AdjointMap()
        told = to_map @ marginals.marginalCovariance(pose_key(number)) @ to_map.T
        sigmas = np.sqrt(np.diagonal(place.covariance))
        assert (np.abs(told - place.covariance) < 1e-3 * np.outer(sigmas, sigmas)).all()
    far = pose_key(30)
    assert without.atPose3(far).range(poses.atPose3(far)) > 0.01
    spreads = [np.trace(m.marginalCovariance(far)[3:, 3:]) for m in (marginals, wider)]
    assert spreads[0] < 0.5 * spreads[1]
    assert all(abs(link.later - link.earlier) == 1 for link in back.links)  # 2 to 20 is none


def test_the_jacobians_are_those_of_the_factors(driven: Driven) -> None:
    """Far from the poses for which they were made, and near."""
    own = driven.saved.own
    assert own is not None
    held = own.within(MOVED, driven.saved.places, 0)
    factors, rng = held.factors(), np.random.default_rng(1)
    values = held.start()
    for number, place in enumerate(driven.saved.places):
        values.insert(pose_key(number), MOVED.compose(place.map_T_middle))
    for size in (1e-3, 0.5):
        away = moved(values, {key: size * rng.normal(size=6) for key in values.keys()})  # noqa: SIM118
        for number in range(factors.size()):
            _check_jacobian(factors.at(number), away)


def moved(values: gtsam.Values, steps: dict[int, FloatArray]) -> gtsam.Values:
    """Poses, and numbers, changed by steps, of which a number takes the first entry."""
    there = gtsam.Values(values)
    for key, step in steps.items():
        if is_pose(values, key):
            there.update(key, values.atPose3(key).retract(step))
        else:
            there.update(key, values.atVector(key) + step[:1])
    return there


def _check_jacobian(factor: Any, values: gtsam.Values) -> None:
    matrix = factor.linearize(values).jacobian()[0]
    for key in factor.keys():  # noqa: SIM118
        width = 6 if is_pose(values, key) else 1
        block, matrix = matrix[:, :width], matrix[:, width:]

        def error(step: FloatArray, key: int = key) -> FloatArray:
            return np.asarray(factor.unwhitenedError(moved(values, {key: step})))

        expected = numerical(error)[:, :width]
        np.testing.assert_allclose(block, expected, atol=1e-4 * (1.0 + np.abs(block).max()))


def test_what_is_said_in_the_frame_of_a_map_is_true_wherever_that_frame_is(driven: Driven) -> None:
    own, places = driven.saved.own, driven.saved.places
    assert own is not None
    first = 7
    held = own.within(MOVED, places, first)
    values = own.start()
    for number, place in enumerate(places):
        values.insert(pose_key(number), place.map_T_middle.retract(np.full(6, 0.01 * number)))
    said = own.factors().error(values)
    assert said > 100.0
    beside = MOVED.retract(np.array([0.01, 0.02, -0.01, 0.2, 0.1, -0.1]))
    for frame, almost in ((MOVED, 1e-6), (beside, 0.05)):  # to first order of the difference
        there = held.start()
        for key in there.keys():  # noqa: SIM118
            if is_pose(there, key):
                there.update(key, frame)
        for number in range(len(places)):
            pose = values.atPose3(pose_key(number))
            there.insert(pose_key(number + first), frame.compose(pose))
        assert held.factors().error(there) == pytest.approx(said, rel=almost)


def test_factors_of_several_maps_are_joined(driven: Driven) -> None:
    own = driven.saved.own
    assert own is not None
    both = LinearFactors.joined([own, own.within(MOVED, driven.saved.places, 100)])
    assert both.factors().size() == 2 * own.factors().size() + 1  # the frame is tied
    assert both.start().size() == 1 + 2 * 3  # and the point of each map
    again = both.within(MOVED, driven.saved.places, 0)
    assert again.start().size() == 2 + 2 * 3  # what has a frame keeps it


@pytest.mark.parametrize(
    ("name", "wrong"), [("places", 99), ("places", -3), ("variables", -1), ("rows", 0)]
)
def test_factors_on_what_is_not_there_are_refused(driven: Driven, name: str, wrong: int) -> None:
    arrays = graph_arrays(driven.saved, Config().loops)
    arrays[f"own/{name}"] = np.full_like(arrays[f"own/{name}"], wrong)
    with pytest.raises(ValueError, match=f"own/{name}"):
        graph_of_arrays(arrays)


CUTS = (0, 36), (24, 60)
_CONFIG = QUICK.changed("pose_graph.keyframe_distance=0.5", "loops.enabled=true")


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimulatedWorld, list[Path]]:
    """Two parts of a drive; the end of each is said to lie 30 cm aside."""
    world = SimulatedWorld("rooms", frames=CUTS[-1][-1], columns=300, speed=3.0, seed=3)
    files = []
    for start, end in CUTS:
        done = run(PartOf(world, start, 1, None, None), _CONFIG, max_frames=end - start)
        assert done.pipeline is not None
        assert done.pipeline.loops is not None
        graph = done.pipeline.loops.graph
        last = graph.keyframes[-1].index
        aside = graph.pose(last).translation() + np.array([0.0, 0.0, 0.3])
        graph.add_position(last, aside, 0.01**2 * np.eye(3))
        files.append(tmp_path_factory.mktemp("part") / "map.lgmap")
        save_map(files[-1], done.pipeline)
    return world, files


def test_merged_and_extended_maps_keep_them(
    parts: tuple[SimulatedWorld, list[Path]], tmp_path: Path
) -> None:
    world, files = parts
    maps = [SavedMap(file) for file in files]
    done = merge_maps(maps, tmp_path / "both.lgmap")
    with SavedMap(tmp_path / "both.lgmap") as both:
        own = both.graph.own
        assert own is not None
        assert own.start().size() == 1  # the frame of the second part
        values = own.start()
        for number, place in enumerate(both.places):
            values.insert(pose_key(number), place.map_T_middle)
        assert own.factors().error(values) < 20.0  # three rows of each, at 1 cm
        bare = [SavedMap(file) for file in files]
        for one in bare:
            one.graph = replace(one.graph, own=None)
        without = merge_maps(bare, tmp_path / "without.lgmap")
        ends = [one.places(1)[-1].map_T_middle.z() for one in (done, without)]
        assert ends[0] > ends[1] + 0.05
        again = merge_maps([both, maps[1]], tmp_path / "again.lgmap").graph.own
        assert again is not None
        assert again.start().size() == 2
    localizer = Localizer(maps[0], extend=True)
    for sweep in (world.sweep(number) for number in range(24, 40)):
        localizer.process(sweep)
    localizer.save(tmp_path / "more.lgmap")
    with SavedMap(tmp_path / "more.lgmap") as more:
        assert len(more.places) > len(maps[0].places)
        assert more.graph.own is not None
        assert maps[0].graph.own is not None
        np.testing.assert_array_equal(more.graph.own.blocks, maps[0].graph.own.blocks)
