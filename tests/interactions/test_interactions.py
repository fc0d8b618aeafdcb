"""Features together: every way to run, reset, looked at or split over workers, to the last bit."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from support.quick import PREDICTED

from loam_gtsam.config import Config
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.io.state import freeze
from loam_gtsam.loops.closure import ScanLoopCloser
from loam_gtsam.pipeline import Pipeline, imu_buffer, run
from loam_gtsam.registration.odometry import Guess
from loam_gtsam.registration.solvers import GtsamSolver
from loam_gtsam.types import FrameStatus

FRAMES = 9
CLOSE = ("loops.enabled=true", "pose_graph.keyframe_distance=0.2", "loops.min_way=1.0")


def gps(context):
    """A position at the prediction, as a receiver would measure it."""
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.5)
    return [gtsam.GPSFactor(context.key, context.map_T_middle.translation(), noise)]


def wheels(context):
    """A motion since the last sweep, as an odometer would measure it."""
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.2)
    moved = context.last[1].between(context.map_T_middle)
    return [gtsam.BetweenFactorPose3(context.last_key, context.key, moved, noise)]


class Curious(GtsamSolver):
    """A solver of a user's own that asks for matches once more than it needs."""

    def solve(self, associate, guess, priors=(), motion=None):
        associate(guess)
        return super().solve(associate, guess, priors, motion)


class Steady:
    """An odometry of a user's own: the last pose, a little farther with every sweep of a run."""

    def __init__(self):
        self.sweeps = 0

    def guess(self, features, last):
        pose = gtsam.Pose3() if last is None else last.map_T_lidar
        ahead = np.array([1e-3 * self.sweeps, 0.0, 0.0])
        return Guess(pose.compose(gtsam.Pose3(gtsam.Rot3(), ahead)), np.zeros(6))

    def remember(self, features):
        self.sweeps += 1

    def reset(self):
        self.sweeps = 0


MODES = {
    "plain": ((), {}),
    "loose": (("imu.coupling=loose", PREDICTED), {}),
    "scan to scan": (("odometry.method=scan_to_scan", PREDICTED), {}),
    "loops": ((*CLOSE, PREDICTED), {}),
    "loops, loose": ((*CLOSE, "imu.coupling=loose", PREDICTED), {}),
    "own factors": ((PREDICTED,), {"extra_factors": gps}),
    "own factors between sweeps": ((), {"extra_factors": wheels}),
    "own closer": ((*CLOSE, PREDICTED), {"loop_closer": ScanLoopCloser}),
    "own solver": ((), {"solver": Curious}),
    "a place that becomes small": (("map.small_below=5.5",), {}),
    "own odometry": ((PREDICTED,), {"odometry": Steady}),
    "without rings": (("sensor.rings=none", PREDICTED), {}),
    "classical": (("solver.method=loam", "imu.prior=off", PREDICTED), {}),
}
"""What runs beside the mapper does not meet the joint start of its map, half of a short run."""


@pytest.fixture(scope="module")
def world():
    """At full speed: within a few sweeps the place becomes small, and loops are closed."""
    return SimulatedWorld("room", frames=FRAMES, columns=300, seed=3, speed=3.0, start="moving")


@pytest.fixture(scope="module")
def sweeps(world):
    return list(world)


def pipeline_of(mode, world):
    """A new pipeline of the mode."""
    changes, parts = MODES[mode]
    config = Config().changed(*changes, {"sensor.model": "vlp16"})
    own = dict(parts)
    if "loop_closer" in own:
        own["loop_closer"] = own["loop_closer"](config)
    if "solver" in own:
        own["solver"] = own["solver"](config.solver)
    if "odometry" in own:
        own["odometry"] = own["odometry"]()
    return Pipeline(config, imu=imu_buffer(world, config), **own)


@pytest.fixture(scope="module")
def expected(world, sweeps):
    """What a new pipeline of a mode hands out of all sweeps, made once."""
    return cache(lambda mode: outcome(pipeline_of(mode, world), sweeps))


def outcome(pipeline, sweeps, after=lambda updates: None):
    """All numbers that a run hands out, as bytes."""
    updates = []
    for sweep in sweeps:
        updates.append(pipeline.process(sweep))
        after(updates)
    result = pipeline.result(updates)
    arrays = [result.trajectory.map_T_lidar, result.edge_points, result.plane_points]
    arrays += [np.stack([update.covariance for update in updates])]
    return [array.tobytes() for array in arrays], [str(update.status) for update in updates]


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "own solver"])
def test_a_reset_pipeline_is_a_new_one_and_looking_changes_nothing(mode, expected, world, sweeps):
    """Looking: state by state, in the middle of a run, and in what comes after."""
    used = pipeline_of(mode, world)
    for sweep in sweeps[4:8]:
        used.process(sweep)
    used.reset()

    def look(updates):
        if len(updates) % 5:
            return
        before = state_of(used)
        used.map_points()
        used.result(updates)
        if used.loops is not None:
            used.loops.counts()
            used.loops.loop_ends()
            used.loops.map_points()
        assert state_of(used) == before

    assert outcome(used, sweeps, look) == expected(mode)
    assert used.loops is None or used.loops.counts()["on"] > 0


def state_of(pipeline):
    return {name: array.tobytes() for name, array in freeze(*pipeline.state()).items()}


@pytest.mark.parametrize("mode", ["loops, loose", "scan to scan"])
def test_workers_change_nothing(mode, world):
    config = Config().changed(*MODES[mode][0])
    here, there = (run(world, config, max_frames=5, workers=count) for count in (0, 1))
    assert np.array_equal(here.trajectory.map_T_lidar, there.trajectory.map_T_lidar)
    assert np.array_equal(here.plane_points, there.plane_points)


def test_asking_for_matches_again_changes_nothing(expected):
    """The matches of a pose are a pure function of that pose."""
    assert expected("own solver") == expected("plain")


def test_a_refused_sweep_is_not_remembered(expected, world, sweeps):
    """Of a sweep whose stamp is an hour ahead, the next guess knows nothing."""
    pipeline, statuses = pipeline_of("scan to scan", world), []
    updates = []
    for count, sweep in enumerate(sweeps[:8]):
        updates.append(pipeline.process(sweep))
        if count == 4:
            ahead = replace(sweeps[-1], stamp=sweep.stamp + 3600 * 10**9)
            statuses.append(pipeline.process(ahead).status)
    assert statuses == [FrameStatus.BAD_STAMP]
    poses = np.stack([update.map_T_lidar.matrix() for update in updates])
    assert expected("scan to scan")[0][0].startswith(poses.tobytes())
