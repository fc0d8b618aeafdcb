"""The error of one scan: Monte-Carlo solves with errors that are independent, shared, or priors."""

import dataclasses

import numpy as np
import pytest
from support.solved import POSE, SIGMA, solved, surroundings

from loam_gtsam.config import CovarianceConfig
from loam_gtsam.factors import plane_rows
from loam_gtsam.geometry import voxel_keys
from loam_gtsam.registration.matches import EdgeMatches
from loam_gtsam.registration.solvers import Solution, match_rows
from loam_gtsam.registration.solvers.scan_error import _STAYS, GyroNoise, ScanError, scan_error
from loam_gtsam.registration.solvers.seen_ground import SeenGround, facings

CONFIG = CovarianceConfig()
CELL = CONFIG.match_cell * np.array([5.0, 0.0, 1.0])
"""Least corner of a cell."""


def noisy_walls(**changes):
    """The optimum of matches that are off by 2 cm, independently."""
    rng = np.random.default_rng(0)
    points, normals, there = surroundings(rng)
    return solved(points, normals, rng.normal(0.0, 0.02, len(there)), **changes)[0]


def error_of(solution, **changes):
    config = CONFIG.changed(**changes)
    found = scan_error(solution, np.inf, SeenGround(), config)
    assert found is not None
    return found


def trials(draw, count=400, seed=0):
    """Mean covariance that is told, that of the steps, and mean inverse information."""
    rng = np.random.default_rng(seed)
    points, normals, there = surroundings(rng)
    told, steps = [], []
    for _ in range(count):
        solution, step = solved(points, normals, draw(rng, there))
        told.append(error_of(solution).covariance)
        steps.append(step)
    return np.mean(told, axis=0), np.cov(np.array(steps).T), np.linalg.inv(solution.information)


def spread(told, actual):
    """Eigenvalues of what happens over what is told: all 1 if it is right."""
    root = np.linalg.cholesky(np.linalg.inv(told))
    return np.linalg.eigvalsh(root.T @ actual @ root)


def by_cell(rng, there):
    """One error for all points of a cell of 1.6 m."""
    _, numbers = np.unique(voxel_keys(there, CONFIG.match_cell), return_inverse=True)
    return rng.normal(0.0, 0.02, numbers.max() + 1)[numbers]


def test_residuals_tell_the_scatter():
    told, actual, raw = trials(lambda rng, there: rng.normal(0.0, 0.02, len(there)))
    ratios = spread(told, actual)
    assert ratios.min() > 0.75
    assert ratios.max() < 1.35
    assert spread(raw, actual).max() < 0.25  # (0.02 / 0.05)^2 = 0.16


def test_errors_that_neighbours_share_do_not_average_out():
    rng = np.random.default_rng(3)
    corners = rng.uniform(-14.0, 14.0, (150, 3)) // CONFIG.match_cell * CONFIG.match_cell
    there = np.repeat(corners, 10, axis=0) + rng.uniform(0.1, 1.5, (1500, 3))
    normals = np.repeat(np.eye(3)[rng.integers(0, 3, 150)], 10, axis=0)
    points = POSE.transformTo(there.T).T
    told, alone, steps = [], [], []
    for _ in range(300):
        solution, step = solved(points, normals, by_cell(rng, there))
        told.append(error_of(solution).covariance)
        alone.append(error_of(solution, match_cell=0.01).covariance)
        steps.append(step)
    actual = np.cov(np.array(steps).T)
    ratios = spread(np.mean(told, axis=0), actual)
    assert ratios.min() > 0.7
    assert ratios.max() < 1.5
    assert spread(np.mean(alone, axis=0), actual).min() > 4.0
    last = error_of(solution)
    assert 80 < last.effective_matches < 300  # 150 cells of ten
    assert last.residual_variance == pytest.approx((0.02 / SIGMA) ** 2, rel=0.4)


def test_the_only_thing_that_tells_the_way_is_not_told_to_agree_with_itself():
    """The scores of a cell that alone decides a direction sum to nothing at the optimum."""
    rng = np.random.default_rng(5)
    points, normals, there = surroundings(rng, axes=2)  # along a hall
    there[:20] = CELL + rng.uniform(0.1, 1.5, (20, 3))
    points[:20], normals[:20] = POSE.transformTo(there[:20].T).T, [1.0, 0.0, 0.0]
    told, steps = [], []
    for _ in range(300):
        solution, step = solved(points, normals, rng.normal(0.0, 0.02, 1500))
        told.append(error_of(solution))
        steps.append(step)
    actual = np.cov(np.array(steps).T)
    ratios = spread(np.mean([error.covariance for error in told], axis=0), actual)
    assert ratios.min() > 0.6
    assert ratios.max() < 1.4
    # Nor does the map then know better where it is.
    ratios = spread(np.mean([error.renewed for error in told], axis=0), actual)
    assert ratios.max() < 1.4


def test_edges_are_not_as_good_as_planes_only_because_these_are():
    rng = np.random.default_rng(6)
    points, normals, _ = surroundings(rng, axes=2)  # along a hall
    count, up = 40, [0.0, 0.0, 1.0]
    centres = CELL + rng.uniform(0.1, 1.5, (count, 3))
    told, steps = [], []
    for _ in range(300):
        off = rng.normal(0.0, SIGMA, (count, 3)) * [1.0, 1.0, 0.0]
        edges = EdgeMatches(
            POSE.transformTo((centres + off).T).T, centres, np.tile(up, (count, 1)),
            np.linalg.norm(off, axis=1), np.full(count, SIGMA), np.ones(count), np.arange(count),
        )  # fmt: skip
        solution, step = solved(points, normals, rng.normal(0.0, 0.01, 1500), edges=edges)
        told.append(error_of(solution).covariance)
        steps.append(step)
    ratios = spread(np.mean(told, axis=0), np.cov(np.array(steps).T))
    assert ratios.min() > 0.6
    assert ratios.max() < 1.4


def test_a_motion_within_the_sweep_moves_the_pose_by_what_is_told():
    """Each side is seen at its own time, so a roll that was not taken out looks like a height."""
    points, normals, _ = surroundings(np.random.default_rng(7))
    seconds = np.arctan2(points[:, 1], points[:, 0]) / (20.0 * np.pi)
    _, jacobian = plane_rows(points, normals, np.zeros(1500), np.ones(1500), 1.0).residuals(POSE)
    velocity, acceleration = [0.02, 0.0, 0.01, 0.1, 0.0, 0.0], [0.3, -0.1, 0.0, 0.0, 2.0, 1.0]
    for motion, name, times in (
        (velocity, "by_velocity", seconds),
        (acceleration, "by_acceleration", 0.5 * seconds**2),
    ):
        solution, step = solved(points, normals, -times * (jacobian @ motion))
        seen = SeenGround()
        found = scan_error(solution, np.inf, seen, CONFIG, seconds=seconds)
        np.testing.assert_allclose(getattr(found, name) @ motion, step, rtol=0.02, atol=1e-6)
        assert abs(step[5]) > 1e-6
    assert not scan_error(solution, np.inf, SeenGround(), CONFIG).by_velocity.any()


@pytest.mark.parametrize("reference", [-0.05, -0.02, 0.03])
def test_a_gyro_that_turns_the_points_tells_what_its_noise_makes_of_the_pose(reference):
    rng, walk = np.random.default_rng(5), 0.01
    points, normals, _ = surroundings(rng)
    seconds = np.arctan2(points[:, 1], points[:, 0]) / (20.0 * np.pi)
    _, jacobian = plane_rows(points, normals, np.zeros(1500), np.ones(1500), 1.0).residuals(POSE)
    times, steps, turns = np.linspace(-0.05, 0.05, 201), [], []
    for _ in range(600):
        turned = np.cumsum(walk * np.sqrt(5e-4) * rng.normal(size=(201, 3)), axis=0)
        turned -= turned[100]  # the pose is that of the middle
        at = np.column_stack([np.interp(seconds, times, axis) for axis in turned.T])
        errors = np.einsum("ni,ni->n", jacobian[:, :3], at)
        steps.append(solved(points, normals, errors)[1])
        turns.append([np.interp(reference, times, axis) for axis in turned.T])
    solution = solved(points, normals, rng.normal(0.0, 1e-9, 1500))[0]
    still, found = (
        scan_error(solution, np.inf, SeenGround(), CONFIG, seconds=seconds, gyro=gyro)
        for gyro in (None, GyroNoise(walk, reference))
    )
    both = np.column_stack([steps, turns])
    actual = both.T @ both / len(both)
    ratios = spread(found.covariance - still.covariance, actual[:6, :6])
    assert ratios.min() > 0.8
    assert ratios.max() < 1.25
    sizes = np.sqrt(np.diag(actual))
    off = (found.by_turns - actual[:6, 6:]) / np.outer(sizes[:6], sizes[6:])
    assert np.abs(off).max() < 0.12
    assert (found.by_turns / np.outer(sizes[:6], sizes[6:])).min() < -0.5
    assert not still.by_turns.any()


def test_matches_without_any_error_leave_a_covariance():
    rng = np.random.default_rng(0)
    points, normals, _ = surroundings(rng)
    found = error_of(solved(points, normals, np.zeros(1500))[0])
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0


def test_a_prior_of_its_own_is_believed():
    prior = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 1e12])
    found, free = error_of(noisy_walls(prior=prior)), error_of(noisy_walls())
    assert found.covariance[5, 5] == pytest.approx(1e-12, rel=1e-3)
    assert free.covariance[5, 5] > 1e-8
    assert found.user[5, 5] == pytest.approx(1.0, abs=1e-4)
    np.testing.assert_allclose(free.user, 0.0, atol=1e-4)


def test_information_of_another_scale_is_no_prior():
    """The classical solvers count rows as measured to 1 m."""
    solution = noisy_walls()
    scaled = dataclasses.replace(solution, information=solution.information * SIGMA**2)
    results = [
        scan_error(one, np.inf, SeenGround(), CONFIG, with_priors=False)
        for one in (solution, scaled)
    ]
    np.testing.assert_array_equal(results[0].covariance, results[1].covariance)


def test_a_pose_that_others_held_is_told_with_the_step_to_the_optimum():
    rng = np.random.default_rng(0)
    points, normals, there = surroundings(rng)
    solution, _ = solved(points, normals, rng.normal(0.0, 0.02, len(there)))
    pose, held = solution.map_T_lidar, np.array([0.001, 0.0, 0.0, 0.0, 0.02, 0.0])
    error = error_of(dataclasses.replace(solution, map_T_lidar=pose.retract(held)))
    assert np.array_equal(error.with_factors(pose, ())[1], np.zeros(6))
    assert np.allclose(error.with_factors(pose, (), alone=False)[1], -held, atol=1e-4)


def test_along_a_weak_direction_there_is_the_expected_motion_only():
    rng = np.random.default_rng(0)
    points, normals, _ = surroundings(rng, axes=2)  # nothing across x of the map
    along = np.concatenate([np.zeros(3), POSE.rotation().matrix().T @ [1.0, 0.0, 0.0]])
    weak = np.outer(along, along)
    prior = 400.0 * weak  # 0.05 m
    found = error_of(solved(points, normals, rng.normal(0, 0.02, 1500), prior=prior, weak=weak)[0])
    assert along @ found.covariance @ along == pytest.approx(0.05**2, rel=1e-6)
    assert along @ found.renewed @ along == pytest.approx(0.0, abs=1e-12)  # of the scan: nothing
    np.testing.assert_allclose(found.user @ along, 0.0, atol=1e-9)


def test_along_unseen_directions_only_the_beacons_count():
    """1500 walls across x, of which ten count; then the covariance is that of the ten."""
    rng = np.random.default_rng(0)
    points, normals, there = surroundings(rng)
    along = np.concatenate([np.zeros(3), POSE.rotation().matrix().T @ [1.0, 0.0, 0.0]])
    unseen = np.outer(along, along)
    across = np.flatnonzero(np.abs(normals[:, 0]) > 0.5)
    beacons = np.zeros(len(points), np.bool_)
    beacons[across[:10]] = True
    solution, _ = solved(points, normals, rng.normal(0.0, 0.02, len(there)))
    rows = match_rows(solution.matches)
    told = rows.residuals(solution.map_T_lidar)[1] @ (np.eye(6) - unseen)
    told[beacons] = rows.where(beacons).residuals(solution.map_T_lidar)[1]
    few = dataclasses.replace(solution, unseen=unseen, beacons=beacons, information=told.T @ told)
    before, after = (along @ error_of(one).covariance @ along for one in (solution, few))
    assert 10 < after / before < 200  # 500 walls against 10


@pytest.mark.parametrize(("left", "known"), [(0.0, False), (1e-11, False), (1e-2, True)])
def test_singular_information_gives_no_covariance(left, known):
    """What rounding leaves along a direction, beside 1e9 along the others, is no information."""
    rng = np.random.default_rng(0)
    points, normals, _ = surroundings(rng, axes=1)
    matches = solved(points, normals, np.zeros(1500), prior=np.eye(6))[0].matches
    information = np.diag([left, *[1e9] * 5])
    solution = Solution(POSE, True, True, matches, 1, 1, 0.0, 0.0, information)
    assert (scan_error(solution, np.inf, SeenGround(), CONFIG) is not None) == known


def test_only_new_ground_is_renewed():
    solution = noisy_walls()
    seen = SeenGround()
    first = scan_error(solution, np.inf, seen, CONFIG)
    again = scan_error(solution, np.inf, seen, CONFIG)
    assert np.linalg.eigvalsh(first.renewed).min() > 0.0
    np.testing.assert_allclose(again.renewed, 0.0, atol=1e-20)
    np.testing.assert_array_equal(first.covariance, again.covariance)


def test_ground_is_known_since_its_first_scan_and_forgotten_in_time():
    seen, same = SeenGround(remembered=3), np.ones(3, np.int64)
    row = np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [0.6, 0.5, 0.5]])

    def since(points, **changes):
        numbers, found = seen.cells(points, same, 1.0, **changes)
        assert numbers[0] == numbers[2] != numbers[1]
        seen.add(np.full(6, seen.scans))
        return found.tolist()

    far = [row + np.array([n, 0.0, 0.0]) for n in (10.0, 20.0, 30.0, 40.0, 50.0)]
    assert since(row) == [0, 0]
    assert since(row) == [0, 0]
    assert since(far[0]) == [2, 2]  # fills the generation
    assert since(row) == [0, 0]
    assert [since(points)[0] for points in far[1:]] == [4, 5, 6, 7]
    assert since(row) == [8, 8]
    assert since(far[0], new=3) == [3, 3]
    assert seen.cells(row, same, 2.0)[1].tolist() == [10]  # other cells


def test_what_is_known_since_a_scan_was_moved_as_the_one_before():
    seen = SeenGround()
    assert not seen.moved(np.array([0])).any()  # where the map begins
    for scan in range(3):
        seen.add(np.full(6, 10.0 + scan))
    assert seen.moved(np.array([1, 0, 2, 3]))[:, 0].tolist() == [10.0, 0.0, 11.0, 12.0]


def test_a_wall_makes_neither_the_edge_at_its_end_nor_the_floor_known():
    normals = np.array([[1.0, 0.0, 0.0], [0.1, 0.9, 0.0], [0.0, 0.2, -0.9], [-0.9, 0.3, 0.0]])
    np.testing.assert_array_equal(facings(normals, 1), [0, 2, 3, 1])
    seen, place = SeenGround(), np.full((2, 3), 0.5)

    def since(*facing):
        numbers, found = seen.cells(place, np.array(facing), 1.0)
        seen.add(np.zeros(6))
        return found[numbers].tolist()

    assert since(1, 1) == [0, 0]
    assert since(0, 1) == [1, 0]
    assert since(3, 0) == [2, 1]


@pytest.mark.parametrize("of_map", [0.5, 0.25])
@pytest.mark.parametrize("frames", [5, 20, 50])
@pytest.mark.parametrize("wander", [1e9, 0.1, 1e-3, 1e-5])
def test_drift_beside_an_imu_is_that_of_a_filter_that_makes_its_own_map(frames, wander, of_map):
    """In one dimension: each frame has one new point and forgets the oldest one of its map.

    The prediction ``wander``s; of the scan's covariance the map has a share.
    """
    new = 1.0 / frames
    factor = 4.0 * (of_map + new * (1.0 - of_map)) / (1.0 + new) ** 2
    scan = ScanError(
        covariance=np.eye(6), renewed=new * np.eye(6),
        information=np.eye(6) / (1.0 + _STAYS * factor * new),
        user=np.zeros((6, 6)), expected=np.zeros((6, 6)), raw=np.zeros((6, 6)), step=np.zeros(6),
        residual_variance=1.0, effective_matches=1.0,
    )  # fmt: skip
    known = 0.0
    for _ in range(5000):
        known = 1.0 / (1.0 / (known + wander) + scan.information[0, 0])
    told = scan.drift(factor, known * np.eye(6))
    gain = known * scan.information[0, 0]

    # How far a unit of each error of one frame has moved the pose and its map for good.
    pose, points, once = np.zeros(3), np.zeros((frames, 3)), np.eye(3)
    for frame in range(200 * frames):
        moved, seen, point = once
        pose = gain * (points.mean(axis=0) + seen) + (1.0 - gain) * (pose + moved)
        points[frame % frames] = pose + point
        once = np.zeros((3, 3))
    expected = pose**2 @ [wander, 1.0 - of_map, frames * of_map]
    assert np.trace(told) / 6.0 == pytest.approx(expected, rel=1e-3)
    np.testing.assert_allclose(told, told[0, 0] * np.eye(6), atol=1e-12)


def test_drift_is_less_beside_an_imu_by_each_direction():
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    stretch = axes * np.array([1e-3, 2e-3, 5e-3, 1e-2, 3e-2, 0.1])
    unit, nothing = stretch @ stretch.T, np.zeros((6, 6))
    scan = ScanError(
        unit, 0.1 * unit, nothing, nothing, nothing, np.linalg.inv(unit), np.zeros(6), 1.0, 1.0
    )
    gains = np.array([1.0, 0.5, 0.1, 0.9, 0.3, 0.02])
    told = scan.drift(3.0, stretch * gains @ stretch.T)
    back = np.linalg.inv(stretch)
    stays = gains / (1.0 + 4.5 * gains)
    expected = stays**2 * (3.0 * 0.1 * 5.5**2 + 1.0 - gains)
    np.testing.assert_allclose(back @ told @ back.T, np.diag(expected), atol=1e-9)
    np.testing.assert_array_equal(scan.drift(6.0, None), 6.0 * scan.renewed)
    np.testing.assert_array_equal(scan.drift(0.0, stretch * gains @ stretch.T), nothing)
