"""A user's own factors in the adjustment: those of a pose graph, and of a saved map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from support.quick import QUICK
from support.ties import check_gradient

from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.loops.batch import SavedGraph
from loam_gtsam.loops.keyframes import noise_model, pose_key
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.maps.map_file import SavedMap, save_map
from loam_gtsam.maps.map_graph import MapGraph
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.refine.rounds import Settings
from loam_gtsam.refine.runs import RefinedRun, RunPoints, refine_run, refine_runs, run_points
from loam_gtsam.refine.ties import own_ties
from loam_gtsam.types import FloatArray, InputError

N = gtsam.symbol("n", 0)
RAISED = 0.04
"""Metres by which a user's own factor says that the last keyframe is higher."""


@dataclass
class Driven:
    result: RunResult
    points: RunPoints
    graph: PoseGraph
    saved: MapGraph

    def height(self, found: RefinedRun) -> float:
        """Metres of the last keyframe."""
        stamp = self.graph.keyframes[-1].stamp
        at = found.trajectory.stamps.tolist().index(stamp)
        return float(found.trajectory.map_T_lidar[at, 2, 3])

    def by_map(self, graph: MapGraph, **more) -> float:
        of_run = [self.points], [self.result.updates], [self.result.trajectory]
        return self.height(refine_runs(*of_run, graph=graph.held(), **more)[0])


@pytest.fixture(scope="module")
def driven(tmp_path_factory) -> Driven:
    """A drive through rooms, of which a user says that its end is higher."""
    world = SimulatedWorld("rooms", frames=30, columns=300, speed=3.0, seed=1)
    changes = "pose_graph.keyframe_distance=0.5", "loops.enabled=true"
    result = run(world, config := QUICK.changed(*changes))
    assert result.pipeline is not None
    assert result.pipeline.loops is not None
    graph = result.pipeline.loops.graph
    last = graph.keyframes[-1].index
    aside = graph.pose(last).translation() + np.array([0.0, 0.0, RAISED])
    graph.add_position(last, aside, 1e-4**2 * np.eye(3))
    file = tmp_path_factory.mktemp("own") / "map.lgmap"
    save_map(file, result.pipeline)
    with SavedMap(file) as saved:
        kept = saved.graph
    points = run_points(world, result.updates, config, most=1000)
    return Driven(result, points, graph, kept)


@pytest.fixture(scope="module")
def without(driven) -> float:
    """The height without that factor."""
    return driven.by_map(replace(driven.saved, own=None))


def test_a_position_of_a_users_own_stays_in_the_graph(driven, without) -> None:
    assert driven.by_map(driven.saved) - without > 0.5 * RAISED
    graph, more = driven.graph.saved(), {"trajectory": driven.result.trajectory}
    alone = refine_run(driven.points, driven.result.updates, graph=graph, **more)
    assert driven.height(alone) - without > 0.5 * RAISED


def test_in_the_frame_of_a_run_that_was_merged_it_says_less(driven, without) -> None:
    """That frame is known as well as the first place is, to a centimetre."""
    own, places = driven.saved.own, driven.saved.places
    merged = replace(driven.saved, own=own.within(gtsam.Pose3(), places, 0))
    assert merged.held().poses.size() == len(places) + 1  # the frame
    raised = driven.by_map(merged) - without
    assert 0.1 * RAISED < raised < 0.5 * RAISED


def test_it_stays_in_windows_too(driven) -> None:
    settings = Settings(whole=20)
    without = driven.by_map(replace(driven.saved, own=None), settings=settings)
    assert driven.by_map(driven.saved, settings=settings) - without > 0.5 * RAISED


FRAMES = {pose_key(number): 2 * number for number in range(5)}
"""Sweeps of the first five places; the sixth is on none."""
STEPS = [gtsam.Pose3.Expmap(0.05 * np.arange(6) * (n - 4)) for n in range(12)]
"""Middles of the sweeps, seen from the places."""
POINT = np.array([2.0, 3.0, 1.0])


def middles() -> FloatArray:
    """Poses of the middles of twelve sweeps, far from where anything is zero."""
    rng = np.random.default_rng(3)
    tangents = rng.normal(0.0, [0.4, 0.4, 2.0, 9.0, 9.0, 1.0], (12, 6))
    return np.array([gtsam.Pose3.Expmap(one).matrix() for one in tangents])


PLACES = [
    gtsam.Pose3(pose).compose(step.inverse())
    for pose, step in zip(middles()[::2], STEPS[::2], strict=True)
]


def graph_of(*factors: gtsam.NonlinearFactor) -> SavedGraph:
    """Six places with a landmark."""
    values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for number, pose in enumerate(PLACES):
        values.insert(pose_key(number), pose)
    values.insert(N, POINT + 0.3)
    for factor in factors:
        graph.add(factor)
    return SavedGraph(graph, values)


def ranges(*numbers: int) -> list[gtsam.NonlinearFactor]:
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
    away = [float(np.linalg.norm(pose.transformTo(POINT))) for pose in PLACES]
    return [gtsam.RangeFactor3D(pose_key(n), N, away[n] + 0.1 * (n - 2), noise) for n in numbers]


def position(number: int) -> gtsam.NonlinearFactor:
    noise = noise_model(0.1**2 * np.eye(3), 3)
    return gtsam.GPSFactor(pose_key(number), np.array([1.0, number, 2.0]), noise)


def motion(earlier: int, later: int) -> gtsam.NonlinearFactor:
    noise = noise_model(0.1**2 * np.eye(6))
    return gtsam.BetweenFactorPose3(pose_key(earlier), pose_key(later), gtsam.Pose3(), noise)


def held(number: int) -> gtsam.NonlinearFactor:
    return gtsam.PriorFactorPose3(pose_key(number), gtsam.Pose3(), noise_model(np.eye(6)))


def test_what_is_no_motion_stays_in_groups_that_share_no_variable() -> None:
    graph = graph_of(
        held(0), motion(0, 1), position(1), *ranges(0, 1, 2), held(2), position(5), *ranges(5)
    )
    found = own_ties(graph, FRAMES, STEPS)
    assert [ties.factors.size() for ties in found] == [1, 3, 1]
    assert [ties.numbers.tolist() for ties in found] == [[2], [0, 2, 4], [4]]
    assert [list(ties.others.keys()) for ties in found] == [[], [N], []]
    known = gtsam.PriorFactorVector(N, POINT, gtsam.noiseModel.Unit.Create(3))
    assert own_ties(graph_of(motion(0, 1), known, *ranges(5)), FRAMES, STEPS) == []


@pytest.mark.parametrize("factors", [(position(1), held(2)), tuple(ranges(0, 1, 2, 3, 4))])
def test_the_gradient_is_that_of_the_cost(factors) -> None:
    for ties in own_ties(graph_of(*factors), FRAMES, STEPS):
        check_gradient(ties, middles())
        information, _ = ties.equations(middles())
        assert np.linalg.eigvalsh(information).min() > -1e-9 * np.abs(information).max()


def test_a_variable_that_is_left_open_is_named() -> None:
    (ties,) = own_ties(graph_of(*ranges(0, 1)), FRAMES, STEPS)
    with pytest.raises(InputError, match="do not tell its n0; leave these factors out"):
        ties.cost(middles())
