"""Two clouds aligned in one call: closed forms, what they do not fix, what is refused."""

import gtsam
import numpy as np
import pytest

from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.registration.alignment import align
from loam_gtsam.types import InputError

TRUTH = gtsam.Pose3(gtsam.Rot3.Ypr(0.05, -0.02, 0.03), np.array([0.4, -0.3, 0.1]))


def walls(rng, *, ends=True, noise=0.01, count=6000):
    """Points on floor, ceiling and sides of a hall of 24 x 12 x 5 m, with or without its ends."""
    size = np.array([12.0, 6.0, 2.5])
    axes = rng.integers(0 if ends else 1, 3, count)
    points = rng.uniform(-1.0, 1.0, (count, 3)) * size
    rows = np.arange(count)
    points[rows, axes] = np.where(points[rows, axes] < 0.0, -1.0, 1.0) * size[axes]
    return points + rng.normal(0.0, noise, (count, 3))


def seen_from(pose, points):
    return points @ pose.rotation().matrix() + pose.inverse().translation()


def test_a_known_pose_is_found_within_what_is_told():
    rng = np.random.default_rng(0)
    found = align(seen_from(TRUTH, walls(rng)), walls(rng))
    error = found.target_T_source.localCoordinates(TRUTH)
    assert found.solved
    assert found.converged
    assert found.weak is None
    assert found.overlap > 0.65
    assert found.agreement > 0.98
    assert np.abs(error).max() < 2e-3
    assert error @ np.linalg.solve(found.covariance, error) / 6.0 < 4.0
    assert repr(found).startswith("Alignment(converged, at [0.4")


def test_a_guess_brings_clouds_together_that_are_far_apart():
    rng = np.random.default_rng(1)
    away = gtsam.Pose3(gtsam.Rot3.Yaw(2.0), np.array([5.0, 1.0, 0.0]))
    source, target = seen_from(away, walls(rng)), walls(rng)
    assert not align(source, target).target_T_source.equals(away, 0.1)
    found = align(source, target, away.compose(TRUTH))
    assert found.target_T_source.equals(away, 5e-3)


def test_what_the_clouds_do_not_fix_is_said():
    """Along a hall without ends the pose stays at the guess, and its covariance says so."""
    rng = np.random.default_rng(2)
    found = align(seen_from(TRUTH, walls(rng, ends=False)), walls(rng, ends=False))
    assert found.weak is not None
    along = found.target_T_source.rotation().matrix().T[:, 0]
    assert np.linalg.norm(found.weak[3:, 3:] @ along) > 0.9
    assert along @ found.covariance[3:, 3:] @ along > 1.0
    aside = np.linalg.eigvalsh(found.covariance[3:, 3:])[:2]
    assert np.sqrt(aside).max() < 0.01


@pytest.mark.parametrize(("aside", "right"), [(0.0, True), (3.0, False)])
def test_agreement_tells_a_right_pose_from_one_that_is_merely_solved(aside, right):
    world = SimulatedWorld("garage", seed=1, frames=7, columns=450)
    truth = gtsam.Pose3(world.truth.map_T_lidar[6])
    guess = truth.compose(gtsam.Pose3(gtsam.Rot3(), np.array([0.0, aside, 0.0])))
    found = align(world.sweep(6).points, world.sweep(0).points, guess)
    assert found.solved
    assert (found.target_T_source.range(truth) < 0.1) is right
    assert (found.agreement > 0.9) is right


@pytest.mark.parametrize("halves", [False, True])
def test_a_cloud_lies_on_itself_within_what_is_told(halves):
    cloud = SimulatedWorld("room", frames=1).sweep(0).points
    half = np.random.default_rng(4).random(len(cloud)) < 0.5
    source, target = (cloud[half], cloud[~half]) if halves else (cloud, cloud)
    found = align(source, target)
    error = gtsam.Pose3.Logmap(found.target_T_source)
    assert error @ np.linalg.solve(found.covariance, error) < 6.0
    assert np.linalg.norm(error[3:]) < 4e-3


def test_clouds_that_do_not_meet_are_not_solved():
    rng = np.random.default_rng(3)
    guess = gtsam.Pose3(gtsam.Rot3(), np.array([70.0, 0.0, 0.0]))
    found = align(walls(rng), walls(rng), guess)
    assert not found.solved
    assert found.target_T_source.equals(guess, 0.0)
    assert np.isnan(found.covariance).all()


@pytest.mark.parametrize("sides", [(0,), (1,), (0, 1)])
def test_clouds_of_one_place_alone_are_not_solved(sides):
    clouds = [walls(np.random.default_rng(3)) for _ in range(2)]
    for side in sides:
        clouds[side] = np.ones((99, 3))
    with np.errstate(all="raise"):
        assert not align(*clouds).solved


@pytest.mark.parametrize(
    ("source", "says"),
    [
        (np.zeros((5, 2)), r"source: expected \(N, 3\)"),
        ([[0.0, 0.0, 0.0], [0.0]], "source: expected an array"),
        (np.zeros((99, 6)), r"source: expected \(N, 3\) .*; \[:, :3\] takes the first three"),
        (np.full((99, 3), np.nan), "source: expected at least 50 finite points, got 0"),
        (np.zeros((49, 3)), "source: expected at least 50 finite points, got 49"),
    ],
)
def test_what_is_no_cloud_is_refused(source, says):
    with pytest.raises(InputError, match=says):
        align(source, np.zeros((99, 3)))


def test_points_that_are_not_finite_and_a_fourth_column_are_left_out():
    rng = np.random.default_rng(0)
    source, target = seen_from(TRUTH, walls(rng)), walls(rng)
    found = align(np.insert(np.column_stack([source, source[:, 0]]), 5, np.nan, axis=0), target)
    assert found.target_T_source.equals(align(source, target).target_T_source, 0.0)


@pytest.mark.parametrize("distance", [-1.0, 0.0, np.nan])
def test_a_distance_that_is_none_is_refused(distance):
    with pytest.raises(InputError, match="max_distance: expected metres above 0, got"):
        align(np.zeros((99, 3)), np.zeros((99, 3)), max_distance=distance)
