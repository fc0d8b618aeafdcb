"""Runs where a sweep alone has little to match."""

import numpy as np
import pytest
from support.quick import begin_quickly

from loam_gtsam.config import Config, ImuConfig, MatchingConfig
from loam_gtsam.datasets.sim.world import Scene, SimulatedWorld, Solids
from loam_gtsam.pipeline import run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import FrameStatus


def alone(**changes):
    return Config(imu=ImuConfig(coupling="off"), matching=MatchingConfig(**changes))


@pytest.mark.parametrize(("wide", "degenerate"), [(1.0, 0), (4.0, 7)])
def test_the_rings_of_one_sweep_on_open_ground_are_enough_with_a_wide_search(wide, degenerate):
    world = SimulatedWorld("open_field", frames=8, columns=450)
    result = run(world, alone(wide_search=wide))
    found = [update.status is FrameStatus.DEGENERATE for update in result.updates]
    assert sum(found) == degenerate == sum(update.status.solved for update in result.updates)
    error = np.linalg.inv(world.truth.map_T_lidar[-1]) @ result.trajectory.map_T_lidar[-1]
    if wide > 1.0:  # z, roll and pitch, which the ground does show
        assert abs(error[2, 3]) < 0.01
        assert np.abs(error[2, :2]).max() < 0.003


def test_a_way_between_poles_on_rough_ground_holds(monkeypatch):
    begin_quickly(monkeypatch)
    world = SimulatedWorld("sparse_terrain", frames=28, columns=900)
    result = run(world, alone())
    error = absolute_error(result.trajectory, world.truth)
    assert error.rmse < 0.03
    assert all(update.status.solved for update in result.updates[1:])


def things_far_apart():
    """Posts, rocks and boxes of one to two metres, on flat ground, 8 m from the way at least."""
    rng = np.random.default_rng(4)
    at = np.column_stack([rng.uniform(-60.0, 220.0, 90), rng.uniform(-60.0, 60.0, 90)])
    at = at[np.abs(at[:, 1]) > 8.0]
    boxes, posts = at[::2], at[1::2]
    half, tall = rng.uniform(0.4, 1.0, (len(boxes), 2)), rng.uniform(0.6, 1.5, len(boxes))
    yaw = rng.uniform(0.0, np.pi, len(boxes))
    radius, top = rng.uniform(0.1, 0.5, len(posts)), rng.uniform(1.0, 4.0, len(posts))
    solids = Solids(
        boxes=np.column_stack([boxes, tall - 1.0, half, tall + 1.0, yaw]),
        cylinders=np.column_stack([posts, radius, np.full(len(posts), -3.0), top]),
    )
    way = np.column_stack([np.arange(0.0, 200.0, 8.0), np.zeros(25)])
    sway = (0.01, 0.008, 0.008, 0.004)
    return Scene("things", solids, way, False, 8.0, 1.5, sway, frames=60)


@pytest.mark.parametrize(
    ("speed", "width", "held"), [(8, 2.0, True), (20, 2.0, True), (8, 0, False)]
)
def test_things_that_stand_alone_far_away_hold_a_drive_that_starts_at_speed(speed, width, held):
    given = {"columns": 360, "max_range": 60.0, "start": "moving", "frames": 20}
    world = SimulatedWorld(things_far_apart(), speed=speed, **given)
    result = run(world, alone().changed({"features.post_width": float(width)}))
    found, true = result.trajectory.map_T_lidar, world.truth.map_T_lidar
    off = np.linalg.norm((found - true)[:, :3, 3], axis=1)
    assert (off.max() < 0.02 * world.truth.path_length) == held
    told = [update.status is FrameStatus.OK for update in result.updates]
    assert (sum(told) > 0.5 * len(told)) == held
