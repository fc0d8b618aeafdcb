"""Where a sweep alone has little to match: wide search, distinct edges first."""

import gtsam
import numpy as np
import pytest

from loam_gtsam.config import Config, ImuConfig, MapConfig, MatchingConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import run
from loam_gtsam.registration.association import associate
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import FrameStatus


def alone(**changes):
    return Config(imu=ImuConfig(enabled=False), matching=MatchingConfig(**changes))


@pytest.mark.parametrize(("wide", "degenerate"), [(1.0, 0), (4.0, 11)])
def test_the_rings_of_one_sweep_on_open_ground_are_enough_with_a_wide_search(wide, degenerate):
    world = SimulatedWorld("open_field", frames=12)
    result = run(world, alone(wide_search=wide))
    found = [update.status is FrameStatus.DEGENERATE for update in result.updates]
    assert sum(found) == degenerate == sum(update.status.solved for update in result.updates)
    error = np.linalg.inv(world.truth.map_T_lidar[-1]) @ result.trajectory.map_T_lidar[-1]
    if wide > 1.0:  # z, roll and pitch, which the ground does show
        assert abs(error[2, 3]) < 0.01
        assert np.abs(error[2, :2]).max() < 0.003


def pole(distances=(3.0,)):
    """An edge map of a pole with points 0.8 m apart, and a feature on it."""
    edges = CubeMap(MapConfig(), 0.2)
    rows = [[d, 0.0, z] for d in distances for z in np.arange(0.1, 6.0, 0.8)]
    edges.insert(np.array(rows))
    planes = CubeMap(MapConfig(), 0.4)
    return edges, planes, np.array([[3.02, 0.01, 1.3], [-20.0, 3.0, 0.0]])


@pytest.mark.parametrize(
    ("distinct", "wide", "count"),
    [([True, False], 4.0, 1), ([False, False], 4.0, 0), ([True, False], 1.0, 0)],
)
def test_a_distinct_edge_without_a_line_is_searched_for_widely(distinct, wide, count):
    edges, planes, features = pole()
    config = MatchingConfig(wide_search=wide)
    empty = np.zeros((0, 3))
    matches = associate(
        features, empty, gtsam.Pose3(), edges, planes, config, np.array(distinct)
    ).edges
    assert len(matches) == count
    if count:
        assert matches.indices.tolist() == [0]
        assert abs(matches.directions[0, 2]) > 0.99
        assert matches.distances[0] == pytest.approx(np.hypot(0.02, 0.01), abs=0.01)


def test_of_too_many_edges_the_distinct_ones_are_matched():
    poles = np.arange(6.0, 60.0, 6.0)
    edges, planes, _ = pole(distances=poles)
    rng = np.random.default_rng(1)
    features = np.column_stack([rng.choice(poles, 200), np.zeros(200), rng.uniform(2, 4, 200)])
    distinct = np.zeros(200, np.bool_)
    distinct[::20] = True
    config = MatchingConfig(max_edges=30, max_distance=3.0)
    empty = np.zeros((0, 3))
    matches = associate(features, empty, gtsam.Pose3(), edges, planes, config, distinct).edges
    assert matches.distinct.sum() == 10
    assert len(matches) == len(set(matches.indices.tolist())) <= 30
    few = MatchingConfig(max_edges=4, max_distance=3.0)
    chosen = associate(features, empty, gtsam.Pose3(), edges, planes, few, distinct).edges
    assert len(chosen) == 4
    assert chosen.distinct.all()


def test_a_way_between_poles_on_rough_ground_holds():
    world = SimulatedWorld("sparse_terrain", frames=80)
    result = run(world, alone())
    error = absolute_error(result.trajectory, world.truth)
    assert error.rmse < 0.03
    assert all(update.status.solved for update in result.updates[1:])
