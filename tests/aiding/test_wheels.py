"""Wheels as the prediction: where they help, and where they are not believed."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loam_gtsam.config import AidingConfig, Config
from loam_gtsam.datasets.arrays import ArrayDataset
from loam_gtsam.datasets.decode.aiding import WheelSamples
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import Pipeline, run
from loam_gtsam.studies.comparison import compare_solvers
from loam_gtsam.studies.contenders import Contender
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import ConfigError, DatasetError, InputError

MOUNTED = AidingConfig(wheels=True, lidar_t_wheels=(-1.0, 0.0, -0.5))
OFF = Config().changed("imu.coupling=off")


def planar(world, factor=1.01, frozen=False):
    """Wheels at 50 Hz that know distance (times a factor) and heading of the vehicle's point."""
    stamps = np.arange(world.truth.stamps[0], world.truth.stamps[-1], 20_000_000)
    lidar_T_body = np.eye(4)
    lidar_T_body[:3, 3] = MOUNTED.lidar_t_wheels
    poses = world.truth_at(stamps).map_T_lidar @ lidar_T_body
    steps, made = np.linalg.inv(poses[:-1]) @ poses[1:], [np.eye(4)]
    for step in steps:
        flat = np.eye(4)
        yaw = np.arctan2(step[1, 0], step[0, 0])
        flat[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
        flat[:2, 3] = factor * step[:2, 3]
        made.append(made[-1] if frozen else made[-1] @ flat)
    return WheelSamples(stamps, np.array(made))


@pytest.fixture(scope="module")
def tunnel():
    return SimulatedWorld("corridor_bare", frames=36, columns=450, max_range=6.0)


def with_wheels(world, wheels, config=OFF):
    dataset = ArrayDataset(list(world), wheels=wheels, truth=world.truth, sensor=world.sensor)
    return run(dataset, config.changed(aiding=MOUNTED))


def test_in_a_bare_tunnel_the_wheels_say_how_far(tunnel):
    alone = absolute_error(run(tunnel, OFF).trajectory, tunnel.truth, aligned="start")
    result = with_wheels(tunnel, planar(tunnel))
    error = absolute_error(result.trajectory, tunnel.truth, aligned="start")
    assert alone.maximum > 5.0
    assert error.maximum < 0.02 * tunnel.truth.path_length
    # The scans do not see it still, and the covariance says so.
    assert result.status_counts["degenerate"] > 30


def test_a_comparison_has_the_wheels_that_a_run_has(tunnel):
    config = OFF.changed(aiding=MOUNTED)
    dataset = ArrayDataset(list(tunnel)[:12], wheels=planar(tunnel), sensor=tunnel.sensor)
    compared = compare_solvers(dataset, [Contender("wheels", config)]).runs[0].trajectory
    expected = run(dataset, config).trajectory
    np.testing.assert_array_equal(compared.map_T_lidar, expected.map_T_lidar)


def test_wheels_that_contradict_the_scans_are_not_believed():
    world = SimulatedWorld("room", frames=24, columns=450, start="moving")
    for wheels, refused in ((planar(world, frozen=True), True), (planar(world), False)):
        result = with_wheels(world, wheels)
        error = absolute_error(result.trajectory, world.truth, aligned="start")
        odometry = result.pipeline.odometry
        assert error.maximum < 0.03
        assert (odometry.refused > 5) == refused
        assert (odometry.used > 20) != refused
        said = [note for note in result.notes if note.startswith("wheels: not believed for")]
        assert said == ([result.wheels_problem] if refused else [])


def test_twists_are_integrated():
    stamps = np.arange(0, 1_000_000_001, 10_000_000)
    twists = np.tile([0.0, 0.0, np.pi / 2, 1.0, 0.0, 0.0], (len(stamps), 1))
    end = WheelSamples.of_twists(stamps, twists).start_T_body[-1]
    np.testing.assert_allclose(end[:3, 3], [2 / np.pi, 2 / np.pi, 0.0], atol=1e-9)


def test_wheels_that_are_asked_for_must_be_there():
    with pytest.raises(ConfigError, match=r"aiding\.wheels: expected .* got none"):
        Pipeline(OFF.changed(aiding=MOUNTED))


def test_what_cannot_be_is_refused(tunnel):
    with pytest.raises(InputError, match="ascending"):
        WheelSamples(np.array([2, 1]), np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(DatasetError, match="nothing of wheels"):
        run(tunnel, OFF.changed("aiding.wheels=true"))
    dataset = ArrayDataset(
        list(tunnel), imu=tunnel.imu, wheels=planar(tunnel), sensor=tunnel.sensor
    )
    with pytest.raises(ConfigError, match=r"imu\.coupling"):
        run(dataset, Config(aiding=MOUNTED))
