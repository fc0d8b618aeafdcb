"""The velocity within a sweep: told by matches that are exact, few, noisy, or of one moment."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from support.quick import begin_quickly

from loam_gtsam.config import Config
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.factors import MatchRows
from loam_gtsam.geometry import move_points
from loam_gtsam.pipeline import run
from loam_gtsam.registration.solvers.sweep_velocity import ToldVelocity, solved_twist
from loam_gtsam.studies.evaluation import absolute_error

START = gtsam.Pose3.Expmap(np.array([0.1, -0.2, 0.7, 12.0, -5.0, 1.0]))
TWIST = np.array([0.2, -0.3, 1.0, 8.0, -2.0, 0.5])
WIDE, TIGHT = np.full(6, 100.0), np.full(6, 1e-3)


def exact(rows):
    """Normals without noise."""
    return np.zeros(len(rows.points))


def sweep_of_walls(twist, assumed, seconds=None, count=3000, scale=50.0):
    """Matches of a sweep that moved with a twist and was de-skewed with another one."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-10.0, 10.0, (count, 3))
    seconds = rng.uniform(-0.05, 0.05, count) if seconds is None else np.full(count, seconds)
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    offsets = -np.einsum("ij,ij->i", normals, START.transformFrom(points.T).T)
    seen = move_points(move_points(points, -twist, seconds), assumed, seconds)
    return MatchRows(seen, normals, offsets, np.full(count, scale)), seconds


def test_the_motion_within_a_sweep_is_found_from_its_matches():
    assumed = TWIST + np.array([0.1, -0.2, 0.1, 1.0, 0.5, -0.5])
    rows, seconds = sweep_of_walls(TWIST, assumed)
    found = solved_twist(rows, exact(rows), seconds, START, assumed, assumed, WIDE, 0.0)
    # One linear step, against an error of a metre per second.
    np.testing.assert_allclose(found, TWIST, atol=0.02)
    rows, seconds = sweep_of_walls(TWIST, found)
    again = solved_twist(rows, exact(rows), seconds, START, found, assumed, WIDE, 0.0)
    np.testing.assert_allclose(again, TWIST, atol=1e-3)


def test_a_mean_velocity_that_is_known_better_stays():
    rows, seconds = sweep_of_walls(TWIST, TWIST, scale=1.0)
    mean = TWIST + 0.05
    found = solved_twist(rows, exact(rows), seconds, START, TWIST, mean, TIGHT, 0.02)
    np.testing.assert_allclose(found, mean, atol=2e-3)


def test_what_the_pose_explains_as_well_is_no_motion():
    """All points of the sweep at one moment: the scan fits at another pose or another velocity."""
    rows, seconds = sweep_of_walls(TWIST, TWIST + 0.2, seconds=0.03)
    mean = TWIST + 0.1
    found = solved_twist(rows, exact(rows), seconds, START, TWIST + 0.2, mean, np.ones(6), 0.0)
    np.testing.assert_allclose(found, mean, atol=1e-6)


def test_what_the_noise_of_the_normals_makes_is_no_information():
    """Ground alone: a turn moves its points along it, and only false normals see that."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-30.0, 30.0, (2000, 2)), np.full(2000, -1.5)])
    seconds, tilts = rng.uniform(-0.05, 0.05, 2000), np.full(2000, 0.07)
    normals = np.column_stack([0.05 * rng.standard_normal((2000, 2)), np.ones(2000)])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    offsets = -np.einsum("ij,ij->i", normals, points) + 0.03 * rng.standard_normal(2000)
    rows = MatchRows(points, normals, offsets, np.full(2000, 30.0))
    mean, missed = np.array([0.0, 0.0, 0.3, 5.0, 0.0, 0.0]), np.full(6, 0.3)
    still = rows, seconds, gtsam.Pose3(), np.zeros(6), mean, missed, 0.0
    noisy = solved_twist(still[0], tilts, *still[1:])
    np.testing.assert_allclose(noisy[[2, 3]], [0.3, 5.0], rtol=0.05)
    believed = solved_twist(still[0], exact(rows), *still[1:])
    assert believed[2] < 0.1


@pytest.mark.parametrize("count", [2, 5])
def test_a_few_matches_leave_the_mean_velocity(count):
    rows, seconds = sweep_of_walls(TWIST, TWIST + 0.2, count=count)
    found = solved_twist(
        rows, exact(rows), seconds, START, TWIST + 0.2, TWIST, np.full(6, 0.1), 0.02
    )
    np.testing.assert_allclose(found, TWIST, atol=1e-6)


def test_matches_are_believed_up_to_the_error_of_one_side_of_the_sensor():
    """Half of 2 cm over half a sweep: 0.2 m/s, beside a mean velocity that is as uncertain."""
    rows, seconds = sweep_of_walls(TWIST, TWIST, scale=1e4)
    mean, missed = TWIST + 0.1 * np.eye(6)[3], np.array([1.0, 1.0, 1.0, 0.2, 0.2, 0.2])
    found = solved_twist(rows, exact(rows), seconds, START, TWIST, mean, missed, 0.02)
    assert found[3] - TWIST[3] == pytest.approx(0.05, rel=0.02)
    even = solved_twist(rows, exact(rows), seconds, START, TWIST, mean, missed, 0.0)
    assert even[3] - TWIST[3] == pytest.approx(0.0, abs=1e-3)


def test_where_it_shakes_a_solved_motion_halves_the_error(monkeypatch):
    begin_quickly(monkeypatch)
    world = SimulatedWorld("shaken", frames=35, columns=300)

    def error(model):
        result = run(world, Config().changed({"deskew.model": model, "imu.coupling": "off"}))
        return absolute_error(result.trajectory, world.truth).rmse

    assert error("linear") < 0.6 * error("constant")


def test_a_velocity_that_was_expected_and_told_has_the_error_of_both():
    rng, trials = np.random.default_rng(0), 20000
    variances = np.array([0.01, 0.04, 0.01, 0.02, 0.01, 0.09])
    root = rng.normal(size=(6, 6))
    information, believed = root @ root.T + np.eye(6), np.diag(rng.uniform(5.0, 200.0, 6))
    expected = np.sqrt(variances) * rng.normal(size=(trials, 6))
    seen = rng.multivariate_normal(np.zeros(6), np.linalg.inv(information), trials)
    solved = np.linalg.solve(believed + information, believed @ expected.T + information @ seen.T)
    told = ToldVelocity(np.zeros(6), information, np.zeros((6, 6)))
    left = told.left(np.diag(variances), believed)
    np.testing.assert_allclose(solved @ solved.T / trials, left, atol=0.05 * np.abs(left).max())


@pytest.mark.parametrize("axis", range(6))
def test_a_jerk_changes_the_velocity_that_matches_tell(axis):
    jerk, span = 2.0 * np.eye(6)[axis], 0.1
    rows, seconds = sweep_of_walls(np.zeros(6), np.zeros(6))
    still = ToldVelocity.of(rows, exact(rows), seconds, START, 0.0, span, with_jerk=True)
    curve = (seconds**3 + span * seconds**2) / 6.0
    bent = replace(rows, points=move_points(rows.points, -jerk, curve))
    told = ToldVelocity.of(bent, exact(rows), seconds, START, 0.0, span)
    np.testing.assert_allclose(told.step - still.step, still.by_jerk @ jerk, atol=1e-5)
    # Over all points, the part of the curve that goes along with the velocity's
    alike = (1.0 / 80.0 + 1.0 / 180.0) / 6.0 / (1.0 / 12.0 + 1.0 / 180.0)
    assert told.step[axis] == pytest.approx(alike * span**2 * jerk[axis], rel=0.1)
    assert not told.by_jerk.any()  # it was not asked for
