"""The paths within the first sweeps: a parabola through their poses, velocities by the matches."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from loam_gtsam import Mapper
from loam_gtsam.config import Config
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.pipeline import run
from loam_gtsam.registration.start.paths import on_paths, with_velocity
from loam_gtsam.registration.start.ways import EarlySweep
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import Features

CONFIG = Config().changed("imu.coupling=off")
VELOCITY = np.array([0.1, -0.1, 0.2, 2.0, 0.5, -0.3])
ACCELERATION = np.array([0.5, -0.6, 0.8, 3.0, -2.0, 3.0])
FIRST = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.5), np.array([1.0, 2.0, 0.5]))


def _path(seconds):
    return FIRST.compose(gtsam.Pose3.Expmap(VELOCITY * seconds + 0.5 * ACCELERATION * seconds**2))


def _sweep(number, at):
    """A sweep of 0.1 s from its reference time on, with a point in each tenth of it."""
    times = np.linspace(0.0, 0.1, 11)
    points = np.column_stack([np.full((11, 2), 5.0), times])
    features = Features(
        number * 10**8, points[:0], points, times[:0], times,
        np.zeros(0, int), np.zeros(11, int), np.zeros(0, int), np.zeros(0, int), (0.0, 0.1),
    )  # fmt: skip
    posed = MovingSweep(features, CONFIG).at(np.zeros(6))
    return EarlySweep(posed, at, None, number)


@pytest.mark.parametrize("count", [3, 5])
def test_the_path_is_the_parabola_through_the_poses(count):
    told = _path(0.0).localCoordinates(_path(1e-6)) / 1e-6
    first = _sweep(0, _path(0.02))  # where it would be at another velocity
    first = replace(first, velocity=VELOCITY + 0.05 * ACCELERATION)
    sweeps = [first, *(_sweep(n, _path(0.05 + 0.1 * n)) for n in range(1, count))]
    moved = on_paths(sweeps, FIRST)
    assert np.allclose(told, VELOCITY, atol=1e-4)
    for number, one in enumerate(moved):
        middle = 0.05 + 0.1 * number
        true = _path(middle).localCoordinates(_path(middle + 1e-6)) / 1e-6
        # The tangent spaces of poses that are turned by 0.1 differ by as much of the velocity.
        np.testing.assert_allclose(one.posed.twist, true, atol=0.12)
        assert one.map_T_middle.equals(_path(middle), 3e-3)
        reference = one.map_T_middle.compose(one.posed.middle_T_reference)
        assert reference.equals(_path(middle - 0.05), 4e-3)


def test_where_the_first_sweep_tells_no_velocity_all_are_constant():
    sweeps = [_sweep(n, _path(0.05 + 0.1 * n)) for n in range(4)]
    sweeps[2] = replace(sweeps[2], velocity=np.ones(6))
    moved = on_paths(sweeps, FIRST)
    for before, now in zip(sweeps, moved[1:], strict=False):
        twist = gtsam.Pose3.Logmap(before.map_T_middle.between(now.map_T_middle)) / 0.1
        np.testing.assert_allclose(now.posed.twist, twist)
        assert now.posed.sweep.acceleration is None
    np.testing.assert_array_equal(moved[0].posed.twist, moved[1].posed.twist)


@pytest.mark.parametrize("count", [2, 4])
def test_a_velocity_that_is_told_no_more_is_that_of_the_path(count):
    """Of two sweeps there is no path yet."""
    sweeps = [_sweep(n, _path(0.05 + 0.1 * n)) for n in range(count)]
    assert with_velocity(sweeps, 0, None, FIRST, CONFIG)[0].velocity is None  # nor was it before
    stale = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 1.0])
    sweeps = [replace(one, velocity=stale) for one in sweeps]
    first, *others = with_velocity(sweeps, 0, None, FIRST, CONFIG)
    assert all(now is before for now, before in zip(others, sweeps[1:], strict=True))
    expected = stale if count == 2 else VELOCITY + 0.05 * ACCELERATION
    np.testing.assert_allclose(first.velocity, expected, atol=0.02)


def _turned(model):
    """Degrees by which poses of a shaken lidar are turned, seen from the very first."""
    world = SimulatedWorld("shaken", sensor="os1-64", columns=512, frames=5, start="moving", seed=1)
    config = CONFIG.changed({"deskew.model": model})
    mapper = Mapper(config)
    updates = [mapper.register(extract_features(scan, config)) for scan in world]
    truth = [gtsam.Pose3(pose) for pose in world.truth.map_T_lidar]
    off = [
        updates[0].map_T_lidar.between(update.map_T_lidar).localCoordinates(truth[0].between(pose))
        for update, pose in zip(updates, truth, strict=True)
    ]
    return np.degrees(np.linalg.norm(np.array(off)[:, :3], axis=1))


def test_a_run_that_begins_while_it_turns_is_not_bent_by_its_first_sweep():
    steady, told = _turned("constant"), _turned("linear")
    assert told[1] < 0.5 * steady[1]
    assert told[4] < 0.5 * steady[4]
    assert steady[1] > 0.8


def test_a_first_sweep_that_is_held_at_its_end_is_not_continued_backwards():
    """The end is nearer to the middle of the second sweep than to that of the first."""
    world = SimulatedWorld("room", frames=12, columns=450, seed=2)
    found = run(world, CONFIG.changed("deskew.reference=end"))
    assert absolute_error(found.trajectory, world.truth).rmse < 0.02  # 0.09 by such a path
