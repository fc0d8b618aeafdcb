"""The pose at the reference time: by the path through the middles, and by what an IMU felt."""

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from loam_gtsam import SimulatedWorld, run
from loam_gtsam.refine.runs import refine_run, run_points
from loam_gtsam.refine.sweeps import Path, ReferenceSteps, SweepPoints

pytestmark = pytest.mark.usefixtures("quick_start")

COUNT, PERIOD, AWAY = 60, 0.1, -0.05  # sweeps, seconds from one to the next, to the reference
AXIS = np.array([0.3, -0.5, 0.8, 0.4, 0.2, -0.6])


def _pose(seconds, hertz):
    """Along a bend, shaken by 4 mrad and 4 mm."""
    bend = gtsam.Pose3.Expmap(seconds * np.array([0.0, 0.0, 0.1, 2.0, 0.0, 0.0]))
    return bend.compose(gtsam.Pose3.Expmap(4e-3 * AXIS * np.sin(2.0 * np.pi * hertz * seconds)))


def _path(hertz, count=COUNT, begin=0.0):
    """The path through the middles, the steps from these to the references, and the sweeps."""
    times = begin + np.arange(count) * PERIOD
    middles = [_pose(t, hertz) for t in times]
    stamps = np.round(times * 1e9).astype(np.int64)
    path = Path.through(stamps, np.array([pose.matrix() for pose in middles]))
    true = [m.between(_pose(t + AWAY, hertz)) for t, m in zip(times, middles, strict=True)]
    ends = np.array([AWAY, -AWAY])
    sweeps = [SweepPoints(stamp, np.ones((2, 3)), ends, AWAY) for stamp in stamps.tolist()]
    return path, true, sweeps


def _off(path, true, beyond):
    """(N, 6) errors of the steps along a path and beyond it."""
    led = [path.motion(n, np.array([AWAY]))[0] for n in range(len(true))]
    moved = [
        gtsam.Pose3.Expmap(one).compose(gtsam.Pose3.Expmap(more))
        for one, more in zip(led, beyond, strict=True)
    ]
    return np.array([one.localCoordinates(step) for one, step in zip(moved, true, strict=True)])


def _errors(hertz, sigma):
    """Of the path alone and of both together, (60, 6) each, and what the latter should be."""
    rng = np.random.default_rng(3)
    path, true, sweeps = _path(hertz)
    steps = [step.retract(sigma * rng.normal(size=6)) for step in true]
    both = ReferenceSteps.told(path, sweeps, steps, np.full((COUNT, 6), sigma**2))
    return (
        _off(path, true, np.zeros((COUNT, 6))), _off(path, true, both.beyond), both.variances,
    )  # fmt: skip


@pytest.mark.parametrize("hertz", [1.0, 2.0, 3.0, 4.0, 4.7])
def test_what_a_path_misses_is_told_by_the_poses_alone(hertz):
    off, told = [], []
    for part in range(8):
        path, true, _ = _path(hertz, begin=part / 8.0 / hertz)
        off.append(_off(path, true, np.zeros((COUNT, 6))))
        told.append(path.sway.missed(np.full(COUNT, AWAY)))
    shares = (np.square(off).mean(axis=0) / np.mean(told, axis=0)).mean(axis=1)
    # At both ends as well, where a polynomial of degree two is looked at beyond the poses.
    assert (shares > 0.5).all()
    assert (shares < 2.0).all()


def test_a_path_through_few_poses_expects_the_worst_and_through_four_knows_nothing():
    worst, _, _ = _path(4.0, 6)
    assert (worst.sway.turns == np.pi).all()
    assert (worst.sway.missed(np.full(6, AWAY)) > 0.0).all()
    nothing, _, _ = _path(4.0, 4)
    np.testing.assert_array_equal(nothing.sway.missed(np.full(4, AWAY)), np.zeros((4, 6)))


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
    path, _, sweeps = _path(4.0)
    alone = ReferenceSteps.along(path, sweeps)
    np.testing.assert_array_equal(alone.beyond, np.zeros((COUNT, 6)))
    misses = path.sway.missed(np.full(COUNT, AWAY))
    assert (alone.variances > misses).all()  # the middle is off as well
    whole = [sweep.chosen(np.zeros(2, np.bool_)) for sweep in sweeps]  # no points, no motion
    np.testing.assert_allclose(ReferenceSteps.along(path, whole).variances, misses)


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
