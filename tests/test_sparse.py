"""Runs where a sweep alone has little to match."""

import numpy as np
import pytest

from loam_gtsam.config import Config, ImuConfig, MatchingConfig
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import FrameStatus


def alone(**changes):
    return Config(imu=ImuConfig(coupling="off"), matching=MatchingConfig(**changes))


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


def test_a_way_between_poles_on_rough_ground_holds():
    world = SimulatedWorld("sparse_terrain", frames=80)
    result = run(world, alone())
    error = absolute_error(result.trajectory, world.truth)
    assert error.rmse < 0.03
    assert all(update.status.solved for update in result.updates[1:])
