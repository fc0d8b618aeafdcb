"""The pose at the reference time: by the path through the middles, and by what an IMU felt."""

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from loam_gtsam import SimulatedWorld, run
from loam_gtsam.refine.runs import refine_run, run_points
from loam_gtsam.refine.sweeps import Path, ReferenceSteps

COUNT, PERIOD, AWAY = 60, 0.1, -0.05  # sweeps, seconds from one to the next, to the reference
AXIS = np.array([0.3, -0.5, 0.8, 0.4, 0.2, -0.6])


def _pose(seconds, hertz):
    """Along a bend, shaken by 4 mrad and 4 mm."""
    bend = gtsam.Pose3.Expmap(seconds * np.array([0.0, 0.0, 0.1, 2.0, 0.0, 0.0]))
    return bend.compose(gtsam.Pose3.Expmap(4e-3 * AXIS * np.sin(2.0 * np.pi * hertz * seconds)))


def _errors(hertz, sigma):
    """Of the path alone and of both together, (60, 6) each, and what the latter should be."""
    rng = np.random.default_rng(3)
    times = np.arange(COUNT) * PERIOD
    middles = [_pose(t, hertz) for t in times]
    stamps = np.round(times * 1e9).astype(np.int64)
    path = Path.through(stamps, np.array([pose.matrix() for pose in middles]))
    true = [m.between(_pose(t + AWAY, hertz)) for t, m in zip(times, middles, strict=True)]
    steps = [step.retract(sigma * rng.normal(size=6)) for step in true]
    seconds, variances = np.full(COUNT, AWAY), np.full((COUNT, 6), sigma**2)
    both = ReferenceSteps.told(path, seconds, steps, variances)
    led = [gtsam.Pose3.Expmap(path.motion(n, seconds[:1])[0]) for n in range(COUNT)]
    moved = [
        one.compose(gtsam.Pose3.Expmap(more)) for one, more in zip(led, both.beyond, strict=True)
    ]
    off = [
        np.array([one.localCoordinates(step) for one, step in zip(found, true, strict=True)])
        for found in (led, moved)
    ]
    return *off, both.variances


@pytest.mark.parametrize("hertz", [4.0, 7.0, 12.0])
def test_what_is_too_fast_for_the_path_is_as_the_imu_felt_it(hertz):
    alone, both, variances = _errors(hertz, 1e-4)
    assert np.sqrt((alone**2).mean()) > 5e-4
    assert np.sqrt((both**2).mean()) < 1.2e-4
    likely = (both**2 / variances).sum(axis=1)
    assert 0.5 < likely.mean() / 6.0 < 2.0
    assert (likely < chi2.isf(1e-5, 6)).all()


def test_a_smooth_motion_is_as_the_path_tells_it():
    alone, both, variances = _errors(0.2, 1e-3)
    inside = slice(2, -2)
    assert np.sqrt((both[inside] ** 2).mean()) < 0.2e-3
    assert np.median(variances[inside]) < 0.1e-6
    assert np.sqrt((alone[inside] ** 2).mean()) < 0.01e-3


def test_of_what_no_step_tells_the_path_does():
    stamps = (np.arange(COUNT) * 1e8).astype(np.int64)
    poses = np.array([_pose(t, 4.0).matrix() for t in stamps * 1e-9])
    path, seconds = Path.through(stamps, poses), np.full(COUNT, AWAY)
    alone = ReferenceSteps.along(path, seconds)
    steps, nothing = [gtsam.Pose3()] * COUNT, np.full((COUNT, 6), np.inf)
    for other in (ReferenceSteps.told(path, seconds, steps, nothing), alone):
        np.testing.assert_array_equal(other.beyond, np.zeros((COUNT, 6)))
        np.testing.assert_allclose(other.variances, path.errors(seconds))


def test_a_shaken_run_with_an_imu_is_refined_as_it_was_felt():
    world = SimulatedWorld("shaken", frames=15, columns=450, imu="white")
    done = run(world)
    refined = refine_run(run_points(world, done.updates, done.config), done.updates)
    true = [gtsam.Pose3(pose) for pose in world.truth.map_T_lidar]

    def turned(poses):
        off = [
            one.between(two).localCoordinates(before.between(now))[:3]
            for one, two, before, now in zip(poses, poses[1:], true, true[1:], strict=False)
        ]
        return np.sqrt((np.array(off) ** 2).sum(axis=1).mean())

    told = turned([gtsam.Pose3(pose) for pose in refined.trajectory.map_T_lidar])
    path, sweeps = refined.refined.path, refined.refined.sweeps
    along_path = turned([path.at(n, sweep.reference) for n, sweep in enumerate(sweeps)])
    assert told < turned([update.map_T_lidar for update in done.updates])
    assert told < 0.5 * along_path
