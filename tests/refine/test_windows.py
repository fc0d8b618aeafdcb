"""Long drives in windows: what a window tells, and the whole beside an adjustment at once."""

import gtsam
import numpy as np
import pytest
from support.jacobians import numerical
from support.trajectories import off_by

from loam_gtsam.refine.adjustment import refine
from loam_gtsam.refine.elimination import LandmarkTies
from loam_gtsam.refine.rounds import Settings
from loam_gtsam.refine.sweeps import SweepPoints
from loam_gtsam.types import InputError

SECOND = 1_000_000_000
SWEEPS = 60


def _street(noise=0.01, off=0.01, seed=0):
    """Sweeps along a street with houses and posts, 1.5 m apart; true poses and wrong ones.

    Each sees 12 m.
    """
    rng = np.random.default_rng(seed)
    places = np.arange(SWEEPS) * 1.5
    found, poses, wrong = [], [], []
    for number, way in enumerate(places):
        points = rng.uniform([way - 12.0, -5.0, 0.0], [way + 12.0, 5.0, 4.0], (700, 3))
        ground, front = rng.random(len(points)) < 0.3, rng.random(len(points)) < 0.3
        points[ground, 2] = 0.0
        rest = ~ground & ~front
        points[rest, 1] = np.where(points[rest, 1] > 0.0, 5.0, -5.0)
        house = ~ground & front  # a wall across every six metres
        points[house, 0] = 6.0 * np.round(points[house, 0] / 6.0)
        posts = np.arange(np.ceil((way - 12.0) / 7.5), (way + 12.0) / 7.5) * 7.5
        edges = np.column_stack([np.repeat(posts, 12), np.full((12 * len(posts), 2), 3.0)])
        edges[:, 2] = rng.uniform(0.0, 4.0, len(edges))
        points = np.vstack([edges, points])
        points += noise * rng.normal(size=points.shape)
        pose = gtsam.Pose3.Expmap(0.1 * rng.normal(size=6) * [1, 1, 1, 0, 0, 0])
        pose = gtsam.Pose3(pose.rotation(), np.array([way, 0.0, 1.5]))
        local = (points - pose.translation()) @ pose.rotation().matrix()
        seconds = np.zeros(len(local))
        found.append(SweepPoints(number * SECOND, local, seconds, edges=len(edges)))
        step = off * rng.normal(size=6) * [0.3, 0.3, 0.3, 1.0, 1.0, 1.0]
        poses.append(pose.matrix())
        wrong.append(pose.retract(step * (number > 0)).matrix())
    return tuple(found), np.array(poses), np.array(wrong)


def _odometry(truth, sigma=0.02):
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, sigma)
    for number in range(len(truth) - 1):
        motion = gtsam.Pose3(truth[number]).between(gtsam.Pose3(truth[number + 1]))
        keys = gtsam.symbol("x", number), gtsam.symbol("x", number + 1)
        graph.add(gtsam.BetweenFactorPose3(*keys, motion, noise))
    return graph


def _steps(poses, truth, span=5):
    """Errors of the motions over some sweeps, metres."""
    motions = [np.linalg.inv(p[:-span]) @ p[span:] for p in (poses, truth)]
    return np.linalg.norm(motions[0][:, :3, 3] - motions[1][:, :3, 3], axis=1)


@pytest.fixture(scope="module")
def street():
    sweeps, truth, wrong = _street()
    return sweeps, truth, wrong, refine(sweeps, wrong, settings=Settings(whole=20))


def test_what_a_window_tells_is_a_quadratic_form_about_its_poses() -> None:
    rng = np.random.default_rng(3)
    poses = np.array([gtsam.Pose3.Expmap(rng.normal(size=6)).matrix() for _ in range(5)])
    root = rng.normal(size=(24, 24))
    form = root @ root.T
    numbers = np.array([0, 1, 2, 4])
    # As of planes: nothing changes if all move together.
    together = np.vstack([gtsam.Pose3(pose).inverse().AdjointMap() for pose in poses[numbers]])
    free = np.eye(24) - together @ np.linalg.pinv(together)
    ties = LandmarkTies(numbers, poses[numbers], 1, free @ form @ free, free @ rng.normal(size=24))
    moved = gtsam.Pose3.Expmap(rng.normal(size=6)).matrix() @ poses
    assert ties.cost(moved) == pytest.approx(0.0, abs=1e-9)
    for scale in (0.0, 1e-3):  # exact about the poses, and nearly so near them
        now = np.array([gtsam.Pose3(p).retract(scale * rng.normal(size=6)).matrix() for p in moved])
        hessian, gradient = ties.equations(now)
        for row, number in enumerate(numbers):

            def cost(pose, now=now, number=number):
                other = now.copy()
                other[number] = pose.matrix()
                return np.array([ties.cost(other)])

            expected = numerical(cost, gtsam.Pose3(now[number]))[0]
            tolerance = (1e-5 + 3.0 * scale) * np.abs(hessian).max()
            np.testing.assert_allclose(gradient[6 * row :][:6], expected, atol=tolerance)


def test_windows_find_what_an_adjustment_of_all_at_once_finds(street) -> None:
    sweeps, truth, wrong, windows = street
    whole = refine(sweeps, wrong, settings=Settings(whole=SWEEPS))
    off = [off_by(found.path.map_T_middle, truth) for found in (whole, windows)]
    steps = [_steps(poses, truth) for poses in (wrong, windows.path.map_T_middle)]
    assert np.median(steps[1]) < 0.2 * np.median(steps[0])
    assert min(found.rounds[-1].lines for found in (whole, windows)) > 10  # of 16 posts
    assert off[1].mean() < 1.3 * off[0].mean() + 0.001
    squared = []
    poses = [gtsam.Pose3(pose) for pose in windows.path.map_T_middle]
    for one, other in [(n, n + k) for k in (1, 10, 40) for n in range(1, SWEEPS - k, 3)]:
        true = gtsam.Pose3(truth[one]).between(gtsam.Pose3(truth[other]))
        error = poses[one].between(poses[other]).localCoordinates(true)
        covariance = windows.relative_covariance(one, other)
        squared.append(error @ np.linalg.solve(covariance, error) / 6.0)
    assert 0.4 < np.mean(squared) < 2.0


def test_windows_give_the_same_bits_and_tell_how_far_they_are(street) -> None:
    sweeps, _, wrong, first = street
    told = []
    again = refine(sweeps, wrong, settings=Settings(whole=20), on_window=lambda *n: told.append(n))
    assert np.array_equal(first.path.map_T_middle, again.path.map_T_middle)
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_sweeps_without_planes_stay_where_the_odometry_has_them() -> None:
    sweeps, truth, wrong = _street()
    blind = range(14, 50)  # more than a stretch
    thin = [
        sweep.chosen(np.full(len(sweep.points), n not in blind)) for n, sweep in enumerate(sweeps)
    ]
    with pytest.raises(InputError, match="no plane"):
        refine(thin, wrong, settings=Settings(whole=20))
    found = refine(thin, wrong, _odometry(truth), Settings(whole=20))
    assert off_by(found.path.map_T_middle, truth)[:14].max() < 0.01
    assert _steps(found.path.map_T_middle, truth, span=1)[14:49].max() < 0.01


def test_a_wrong_loop_does_not_bend_windows_and_a_position_holds_them() -> None:
    sweeps, truth, wrong = _street()
    factors = gtsam.NonlinearFactorGraph()
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(3.0)
    noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(6, 0.05))
    keys = gtsam.symbol("x", 3), gtsam.symbol("x", 57)
    factors.add(gtsam.BetweenFactorPose3(*keys, gtsam.Pose3(), noise))
    there = gtsam.Pose3(gtsam.Rot3(), np.array([100.0, 0.0, 0.0]))
    unit = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    factors.add(gtsam.PriorFactorPose3(keys[1], there, unit))
    found = refine(sweeps, wrong, factors, Settings(whole=20)).path.map_T_middle
    assert np.allclose(found[57, :3, 3], [100.0, 0.0, 0.0], atol=0.01)
    assert off_by(found, truth).max() < 0.02
