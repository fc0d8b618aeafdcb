"""The adjustment of planes and poses: closed forms, gains, refusals."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from support.jacobians import numerical
from support.trajectories import off_by

from loam_gtsam import Config, SimulatedWorld, absolute_error, run
from loam_gtsam.factors import checked_factor
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.refine.adjustment import refine
from loam_gtsam.refine.elimination import eliminated, refitted, sightings
from loam_gtsam.refine.landmarks import find_landmarks, voxel_sizes
from loam_gtsam.refine.map_quality import common_thickness, map_quality
from loam_gtsam.refine.motion_factors import told_directions
from loam_gtsam.refine.rounds import Settings, check_factors
from loam_gtsam.refine.runs import refine_run, run_points
from loam_gtsam.refine.sweeps import Path, SweepPoints, extract_points, stacked, sweep_points
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.types import (
    DatasetError,
    FeatureSweep,
    FrameStatus,
    InputError,
    PartError,
    Trajectory,
)

SIZES = voxel_sizes(3.2, 0.4)
SECOND = 1_000_000_000


def _room(rng, count):
    """Points on floor and four walls of a room of 6 x 5 x 3 m, and their walls."""
    points = rng.uniform([-3.0, -2.5, 0.0], [3.0, 2.5, 3.0], (count, 3))
    wall = rng.integers(0, 5, count)
    for number, (axis, value) in enumerate([(0, -3.0), (0, 3.0), (1, -2.5), (1, 2.5), (2, 0.0)]):
        points[wall == number, axis] = value
    return points, wall


POSTS = np.array([[-2.0, -1.5], [2.0, -1.0], [1.5, 1.8], [-1.0, 2.0], [0.3, -2.1]])


def _posts(rng, count=40):
    """Points on the axes of posts, from floor to ceiling."""
    points = np.repeat(np.column_stack([POSTS, np.zeros(len(POSTS))]), count, axis=0)
    points[:, 2] = rng.uniform(0.0, 3.0, len(points))
    return points


def _scene(sweeps=6, count=900, noise=0.01, off=0.01, seed=0, extra=None, edges=None):
    """Sweeps of the room that stand still while they are taken, true poses and wrong ones.

    Of each sweep ``extra`` and ``edges`` make more points, on surfaces and on edges.
    """
    rng = np.random.default_rng(seed)
    poses, found = [], []
    for number in range(sweeps):
        twist = rng.normal(size=6) * [0.1, 0.1, 0.4, 0.4, 0.4, 0.1] + [0, 0, 0, 0, 0, 1.3]
        pose = gtsam.Pose3.Expmap(twist)
        points, _ = _room(rng, count)
        points += rng.normal(size=points.shape) * noise
        if extra is not None:
            points = np.vstack([points, extra(np.random.default_rng(number), number)])
        lines = np.empty((0, 3))
        if edges is not None:
            own = np.random.default_rng([seed, number])
            lines = edges(own)
            lines += own.normal(size=lines.shape) * noise
        local = np.vstack([lines, points]) - pose.translation()
        local = local @ pose.rotation().matrix()
        found.append(SweepPoints(number * SECOND, local, np.zeros(len(local)), edges=len(lines)))
        poses.append(pose)
    steps = rng.normal(size=(sweeps, 6)) * off * np.array([0.3, 0.3, 0.3, 1.0, 1.0, 1.0])
    steps[0] = 0.0
    wrong = [pose.retract(step).matrix() for pose, step in zip(poses, steps, strict=True)]
    return tuple(found), np.array([pose.matrix() for pose in poses]), np.array(wrong)


def _squared(result, truth):
    """Squared Mahalanobis distances over the freedoms of the motions from the first sweep."""
    squared, poses = [], [gtsam.Pose3(pose) for pose in result.path.map_T_middle]
    for number in range(1, len(truth)):
        true = gtsam.Pose3(truth[0]).between(gtsam.Pose3(truth[number]))
        error = poses[0].between(poses[number]).localCoordinates(true)
        covariance = result.relative_covariance(0, number)
        squared.append(error @ np.linalg.solve(covariance, error) / 6.0)
    return squared


def _seen(sweeps, poses):
    """Planes and lines of the sweeps, placed at some poses, and what these saw of them."""
    points, numbers, is_edge = stacked(Path.through(np.arange(len(sweeps)), poses), sweeps)
    placed = np.einsum("nij,nj->ni", poses[numbers, :3, :3], points) + poses[numbers, :3, 3]
    landmarks = find_landmarks(placed, numbers, is_edge, 0.03, SIZES)
    return landmarks, sightings(points, numbers, landmarks)


@pytest.mark.parametrize("off", [1e-6, 0.01])
def test_the_gradient_is_the_derivative_of_the_cost_with_all_at_their_best(off) -> None:
    sweeps, _, poses = _scene(edges=_posts, off=off)
    planes, seen = _seen(sweeps, poses)
    assert planes.is_line.sum() > 4
    planes, _ = refitted(poses, planes, seen)
    gradient = eliminated(poses, planes, seen).gradient
    scale = np.abs(gradient).max()
    for number in (0, 3):

        def cost(pose, number=number):
            moved = poses.copy()
            moved[number] = pose.matrix()
            return np.array([refitted(moved, planes, seen)[1]])

        expected = numerical(cost, gtsam.Pose3(poses[number]))[0]
        np.testing.assert_allclose(gradient[6 * number :][:6], expected, atol=1e-4 * scale)


def test_the_whole_map_can_move_without_cost() -> None:
    sweeps, poses, _ = _scene(edges=_posts)
    planes, seen = _seen(sweeps, poses)
    reduced = eliminated(poses, refitted(poses, planes, seen)[0], seen).hessian
    together = np.vstack([gtsam.Pose3(pose).inverse().AdjointMap() for pose in poses])
    cost = np.diag(together.T @ (reduced @ together))
    assert (np.abs(cost) < 0.02 * reduced.diagonal().max()).all()
    assert np.abs(reduced - reduced.T).max() < 1e-6 * reduced.diagonal().max()


def test_poses_and_walls_are_found_and_as_well_as_they_are_told_to_be() -> None:
    squared = []
    for seed in range(4):
        sweeps, truth, wrong = _scene(seed=seed)
        result = refine(sweeps, wrong)
        assert off_by(result.path.map_T_middle, truth).max() < 0.3 * off_by(wrong, truth).max()
        squared += _squared(result, truth)
    assert 0.5 < np.mean(squared) < 2.0
    offsets = np.abs(result.landmarks.axes[:, :, 0]).max(axis=1)
    assert (offsets > 0.99).mean() > 0.9  # walls, seen from the first pose which is nearly level
    assert (np.sqrt(result.landmark_covariances()[:, 2]) < 0.01).all()


def test_posts_fix_what_the_floor_leaves_open_and_as_well_as_they_are_told_to() -> None:
    def on_floor(sweep, pose):
        height = sweep.points @ pose[2, :3] + pose[2, 3]
        return sweep.chosen(sweep.is_edge | (height < 0.05))

    squared, offsets = [], []
    for seed in range(4):
        sweeps, truth, wrong = _scene(count=4500, seed=seed, edges=_posts)
        floor = [on_floor(*one) for one in zip(sweeps, truth, strict=True)]
        result = refine(floor, wrong)
        assert result.rounds[-1].lines >= len(POSTS)
        assert off_by(result.path.map_T_middle, truth).max() < 0.5 * off_by(wrong, truth).max()
        squared += _squared(result, truth)
        lines, told = result.landmarks.is_line, result.landmark_covariances()
        first = result.path.map_T_middle[0] @ np.linalg.inv(truth[0])
        away = (result.landmarks.centres[lines] - first[:3, 3]) @ first[:3, :3]
        nearest = np.linalg.norm(away[:, None, :2] - POSTS, axis=2).min(axis=1)
        offsets += [nearest, np.sqrt(told[lines, 2])]
        assert (told[lines, 0] == 0.0).all()
        assert (told[~lines] > 0.0).all()
    assert 0.5 < np.mean(squared) < 2.0
    assert max(off.max() for off in offsets) < 0.01


def test_a_line_is_straight_and_alone() -> None:
    rng = np.random.default_rng(4)
    along, sweeps = rng.uniform(0.0, 1.5, 300), np.repeat(np.arange(6), 50)

    def found(aside):
        points = 1.6 + np.column_stack([aside + 0.0 * along, 0.0 * along, along])
        points += 0.008 * rng.normal(size=points.shape)
        return find_landmarks(points, sweeps, np.ones(300, np.bool_), 0.03, (3.2,))

    straight = found(0.0)
    assert straight.is_line.tolist() == [True]
    assert np.abs(straight.axes[0, 2, 2]) > 0.9999
    assert straight.scatters[0] == pytest.approx(0.008, rel=0.2)
    assert len(found(0.05 * (along - 0.75) ** 2 / 0.75**2)) == 0  # bent by 5 cm
    assert len(found(0.1 * rng.integers(0, 2, 300))) == 0  # one of two, 10 cm apart
    few = find_landmarks(np.zeros((40, 3)), np.arange(40) % 2, np.ones(40, np.bool_), 0.03, (3.2,))
    assert len(few) == 0  # two sweeps


def test_what_lasts_as_long_as_an_edge_is_seen_from_one_side_is_found() -> None:
    def half_told(aside):
        """Information of the lines, of twenty sweeps of which the later ones see them aside."""
        number = iter(range(20))

        def edges(rng):
            way = np.linspace(-2.5, 2.5, 30)
            posts = np.column_stack([np.repeat(way, 4), np.full(120, 2.0), np.zeros(120)])
            posts[:, 2] = rng.uniform(0.0, 1.5, 120)
            # Another error of every post: no motion explains it.
            wrong = aside * np.random.default_rng(9).normal(size=30) * (next(number) >= 10)
            return posts + np.column_stack([np.repeat(wrong, 4), np.zeros((120, 2))])

        sweeps, truth, _ = _scene(sweeps=20, count=300, edges=edges)
        landmarks, seen = _seen(sweeps, truth)
        on_lines = landmarks.is_line[seen.landmarks]
        return seen.lasting, seen.moments[on_lines, 3, 3].sum()

    still, told = half_told(0.0)
    lasting, less = half_told(0.01)
    assert still < 0.001
    assert 0.002 < lasting < 0.01
    assert less < 0.5 * told


def test_something_that_moves_is_no_line() -> None:
    def with_pedestrian(rng):
        walks = np.column_stack([np.full((30, 2), 0.5), rng.uniform(0.0, 1.7, 30)])
        walks[:, 0] += 0.1 * next(number)
        return np.vstack([_posts(rng), walks])

    number = iter(range(6))
    sweeps, truth, wrong = _scene(edges=with_pedestrian)
    still = off_by(refine(_scene(edges=_posts)[0], wrong).path.map_T_middle, truth).max()
    moving = off_by(refine(sweeps, wrong).path.map_T_middle, truth).max()
    assert moving < still + 0.001


def test_edges_are_those_near_by_and_none_of_features_that_were_made_elsewhere(room) -> None:
    world, result, _ = room
    scan = next(iter(world))
    points = extract_points(scan, result.config)
    features = extract_features(scan, result.config)
    assert points.edges == len(features.edges) > 50
    assert np.array_equal(points.points[: points.edges], features.edges)
    moved = features.edges.copy()
    moved[:7] *= 20.01 / np.linalg.norm(moved[:7], axis=1, keepdims=True)
    far = sweep_points(replace(features, edges=moved), result.config)
    assert np.array_equal(far.points[: far.edges], features.edges[7:])
    made = extract_points(FeatureSweep(features, gtsam.Pose3()), result.config)
    assert made.edges == 0
    assert len(made.points) == 3000 < len(features.planes)
    late = result.config.changed("features.beam_width=1.0")  # as LOAM has them
    assert np.array_equal(extract_points(scan, late).points, points.points)
    some = points.chosen(np.arange(len(points.points)) % 2 == 0)
    assert some.edges == (points.edges + 1) // 2
    with pytest.raises(InputError, match=r"edges: expected 0 to 3, .* got 4"):
        SweepPoints(0, np.zeros((3, 3)), np.zeros(3), edges=4)


def test_the_same_input_gives_the_same_bits() -> None:
    sweeps, _, wrong = _scene(sweeps=4, count=500, edges=_posts)
    first, second = (refine(sweeps, wrong, settings=Settings(rounds=2)) for _ in range(2))
    assert np.array_equal(first.path.map_T_middle, second.path.map_T_middle)


def test_something_that_moves_does_not_bend_the_map() -> None:
    def car(rng, number):
        """A side of 2 x 1 m, which is 4 cm ahead of where it was in the sweep before."""
        side = rng.uniform([-1.0, 0.0, 0.5], [1.0, 0.0, 1.5], (200, 3))
        return side + np.array([0.0, 0.04 * number, 0.0])

    sweeps, truth, wrong = _scene(extra=car)
    without = _scene()
    assert np.array_equal(without[2], wrong)
    still = off_by(refine(without[0], wrong).path.map_T_middle, truth).max()
    moving = off_by(refine(sweeps, wrong).path.map_T_middle, truth).max()
    assert moving < still + 0.002


def test_a_wrong_loop_does_not_bend_the_map_and_a_position_holds_it() -> None:
    sweeps, truth, wrong = _scene()
    factors = gtsam.NonlinearFactorGraph()
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(3.0)
    noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(6, 0.05))
    far = gtsam.Pose3(gtsam.Rot3(), np.array([5.0, 0.0, 0.0]))
    keys = gtsam.symbol("x", 0), gtsam.symbol("x", 5)
    factors.add(gtsam.BetweenFactorPose3(*keys, far, noise))
    straight = off_by(refine(sweeps, wrong).path.map_T_middle, truth).max()
    bent = off_by(refine(sweeps, wrong, factors).path.map_T_middle, truth).max()
    assert bent < straight + 0.001
    held = gtsam.NonlinearFactorGraph()
    there = gtsam.Pose3(gtsam.Rot3(), np.array([100.0, 0.0, 0.0]))
    held.add(gtsam.PriorFactorPose3(keys[1], there, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    result = refine(sweeps, wrong, held)
    assert np.allclose(result.path.map_T_middle[5, :3, 3], [100.0, 0.0, 0.0], atol=1e-3)


def test_what_cannot_be_adjusted_is_refused() -> None:
    sweeps, _, poses = _scene(sweeps=4, count=500)
    with pytest.raises(InputError, match="3 or more sweeps, got 2"):
        refine(sweeps[:2], poses[:2])
    apart = poses.copy()
    apart[:, 0, 3] += 100.0 * np.arange(4)
    with pytest.raises(InputError, match="no plane or line is seen by three sweeps"):
        refine(sweeps, apart)
    loose = poses.copy()
    loose[3, 0, 3] += 100.0
    with pytest.raises(
        InputError, match="1 sweeps, number 3 the first, share no plane, line or factor"
    ):
        refine(sweeps, loose)
    foreign = gtsam.NonlinearFactorGraph()
    unit = gtsam.noiseModel.Unit.Create(6)
    foreign.add(gtsam.PriorFactorPose3(gtsam.symbol("x", 9), gtsam.Pose3(), unit))
    with pytest.raises(InputError, match="factor 0 has a key that is not x0 to x3"):
        refine(sweeps, poses, foreign)
    sweeps, _, poses = _scene(sweeps=4, count=6000)
    floor = [s.chosen(p[:, 2] < 0.05)
             for s, p in ((s, s.points @ t[:3, :3].T + t[:3, 3])
                          for s, t in zip(sweeps, poses, strict=True))]  # fmt: skip
    with pytest.raises(InputError, match="leave a direction of the poses free"):
        refine(floor, poses)
    with pytest.raises(InputError, match="positive sigma"):
        Settings(sigma=0.0)


def test_the_path_follows_a_motion_that_bends() -> None:
    def pose(t):
        return gtsam.Pose3.Expmap(np.array([0.1 * np.sin(3 * t), 0.0, 0.5 * t, 2 * t, t**2, 0.0]))

    times = 0.1 * np.arange(12)
    stamps = np.round(times * 1e9).astype(np.int64)
    path = Path.through(stamps, np.array([pose(t).matrix() for t in times]))
    for number, tolerance in ((5, 2e-5), (0, 2e-3)):
        off = path.at(number, -0.05).between(pose(times[number] - 0.05))
        assert np.linalg.norm(gtsam.Pose3.Logmap(off)) < tolerance
    sweep = SweepPoints(int(stamps[5]), np.ones((3, 3)) * 5.0, np.array([-0.05, 0.0, 0.05]))
    there = [pose(times[5] + s).transformFrom(np.full(3, 5.0)) for s in sweep.seconds]
    moved = [pose(times[5]).transformFrom(p) for p in path.deskewed(5, sweep)]
    np.testing.assert_allclose(moved, there, atol=2e-4)
    gap = np.where(np.arange(12) < 6, stamps, stamps + 5 * SECOND)
    halves = Path.through(gap, path.map_T_middle)
    assert not halves.powers[5, 2:].any()  # no velocity across the gap


@pytest.fixture(scope="module")
def room():
    world = SimulatedWorld("room", frames=25, columns=900)
    config = Config().changed("imu.coupling=off")
    result = run(world, config)
    points = run_points(world, result.updates, result.config, most=2000)
    return world, result, points


def test_a_run_gets_better_and_its_covariances_are_right(room) -> None:
    world, result, points = room
    refined = refine_run(points, result.updates)
    before = absolute_error(result.trajectory, world.truth).rmse
    after = absolute_error(refined.trajectory, world.truth).rmse
    assert after < 0.95 * before
    assert np.array_equal(refined.trajectory.stamps, result.trajectory.stamps)
    first, last = (map_quality(*refined.held_out(refined=on)) for on in (False, True))
    before, after, planes = common_thickness(first, last)
    assert after < before
    assert planes > 50
    assert last.entropy < first.entropy
    truth = {int(s): gtsam.Pose3(p) for s, p in
             zip(world.truth.stamps, world.truth.map_T_lidar, strict=True)}  # fmt: skip
    poses, squared = refined.trajectory, []
    for k in range(0, 20, 2):
        here, there = (gtsam.Pose3(poses.map_T_lidar[n]) for n in (k, k + 5))
        true = truth[int(poses.stamps[k])].between(truth[int(poses.stamps[k + 5])])
        error = here.between(there).localCoordinates(true)
        covariance = refined.relative_covariance(k, k + 5)
        squared.append(error @ np.linalg.solve(covariance, error) / 6.0)
    assert 0.25 < np.mean(squared) < 4.0
    for absent in (-1, 25):
        with pytest.raises(InputError, match="from 0 to 24"):
            refined.relative_covariance(2, absent)
    assert len(refined.map_points(0.2)) > 1000
    assert refined.seen.all()
    # A sweep that did not see a direction: what the run told of it holds from there on.
    fourth = result.updates[4]
    weak = replace(fourth, localizability=np.array([0.0, 99.0, 99.0, 99.0, 99.0, 99.0]))
    blind = replace(refined, seen=np.arange(25) != 4)
    assert np.array_equal(blind.covariances[4:], [u.covariance for u in result.updates[4:]])
    assert np.array_equal(blind.covariances[:4], refined.covariances[:4])
    told = relative_covariance(result.updates[2], result.updates[8])
    assert np.array_equal(blind.relative_covariance(2, 8), told)
    keep = told_directions([result.updates[3], weak], 10.0)
    assert np.array_equal(keep[0], np.eye(6))
    np.testing.assert_allclose(keep[1] @ weak.directions[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(keep[1] @ weak.directions[1], weak.directions[1], atol=1e-9)


def test_the_data_set_of_another_run_is_refused(room) -> None:
    world, result, _ = room
    updates = [replace(update, stamp=update.stamp + 7) for update in result.updates]
    with pytest.raises(InputError, match=r"expected the stamp .* give the data set of the run"):
        run_points(world, updates, result.config)
    fewer = SimulatedWorld("room", frames=3, columns=400)
    with pytest.raises(DatasetError, match="expected the 4 sweeps of the run, got 3"):
        run_points(fewer, result.updates[:4], result.config, most=300)
    points = run_points(fewer, result.updates[:3], result.config, most=300)
    other = Trajectory.from_poses([1, 2, 3], [gtsam.Pose3()] * 3)
    with pytest.raises(InputError, match="stamps of the run's poses"):
        refine_run(points, result.updates[:3], trajectory=other)


def test_poses_that_mean_nothing_are_refused(room) -> None:
    world, result, _ = room
    updates = [*result.updates]
    lost = [replace(update, status=FrameStatus.LOST) for update in updates[:3]]
    with pytest.raises(InputError, match=r"the first 3 frames .* dataset\.part\(3\)"):
        run_points(world, [*lost, *updates[3:]], result.config)
    sparse = [replace(update, status=FrameStatus.SPARSE_MAP) for update in updates[1:]]
    with pytest.raises(InputError, match=f"solved, got none of {len(updates)}"):
        run_points(world, [updates[0], *sparse], result.config)


@pytest.mark.parametrize(
    ("residual", "error"),
    [
        (lambda values: (np.full(3, np.nan), [np.zeros((3, 6))]), InputError),
        (lambda values: (np.zeros(3), [1e12 * np.eye(3, 6)]), InputError),
        (lambda values: 1 / 0, PartError),
    ],
)
def test_a_faulty_factor_of_ones_own_is_refused(residual, error) -> None:
    sweeps, _, poses = _scene(edges=_posts)
    factors = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    factors.add(checked_factor(noise, [gtsam.symbol("x", 1)], residual))
    with pytest.raises(error, match="factors"):
        refine(sweeps, poses, factors)


@pytest.mark.parametrize("calls", [1, 3])
def test_a_factor_of_ones_own_that_fails_on_the_way_is_named(calls) -> None:
    sweeps, _, poses = _scene(edges=_posts)
    factors, seen = gtsam.NonlinearFactorGraph(), []
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)

    def residual(values):
        seen.append(values)
        if len(seen) > checked + calls:
            raise ZeroDivisionError("late")
        return np.zeros(3), [np.eye(3, 6)]

    factors.add(checked_factor(noise, [gtsam.symbol("x", 1)], residual))
    checked = np.inf
    check_factors(factors, poses)
    checked = len(seen)
    with pytest.raises(PartError, match=r"factors of your own .* raised ZeroDivisionError: late"):
        refine(sweeps, poses, factors)
