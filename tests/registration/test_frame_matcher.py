"""The matcher of one frame: pure, keeps matches near by, searches widely where there is little."""

from dataclasses import fields, replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from loam_gtsam.config import Config
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.geometry import transform
from loam_gtsam.imu.preintegration import InertialPrediction
from loam_gtsam.registration import frame_matcher
from loam_gtsam.registration.acceleration import Expected
from loam_gtsam.registration.degeneracy import localizability
from loam_gtsam.registration.frame_matcher import FrameMatcher, MapPair
from loam_gtsam.registration.odometry import Moment
from loam_gtsam.registration.planes import match_planes, translations_fixed
from loam_gtsam.registration.report import Clock
from loam_gtsam.types import Features

CONFIG = Config()
HERE = gtsam.Pose3(gtsam.Rot3.Yaw(0.01), np.array([0.1, 0.02, 0.0]))
TWIST = np.array([0.0, 0.0, 0.1, 1.0, 0.2, 0.0])


def matcher_of(second, last, maps, config=CONFIG, **options):
    return FrameMatcher.of(second.at(TWIST), maps, config, last, Clock(), **options)


@pytest.fixture(scope="module")
def parts():
    """The second sweep of the room, the middle of the first one, and the map of the first one."""
    world = SimulatedWorld("room", frames=2, columns=450)
    first, second = (MovingSweep(extract_features(scan, CONFIG), CONFIG) for scan in world)
    maps = MapPair(CONFIG)
    maps.insert(first.at(TWIST), gtsam.Pose3(), 0)
    return second, Moment(first.stamp, gtsam.Pose3(), True), maps


@pytest.fixture
def matcher(parts):
    return matcher_of(*parts)


def moved(metres):
    return HERE.compose(gtsam.Pose3(gtsam.Rot3(), np.array([metres, 0.0, 0.0])))


def same(first, second):
    """Whether two sets of matches are equal to the last bit."""
    return all(
        np.array_equal(getattr(a, item.name), getattr(b, item.name))
        for a, b in ((first.edges, second.edges), (first.planes, second.planes))
        for item in fields(a)
    )


def test_the_matches_of_a_pose_do_not_depend_on_earlier_calls(parts, matcher):
    first = matcher(HERE)
    assert len(first) > 500
    for other in (moved(0.02), moved(0.5)):
        matcher(other)
        matcher.again(first, other)
        matcher.deskewed(other, first)(other)
        matcher.with_few_matches()(other)
    assert same(matcher(HERE), first)
    assert same(matcher_of(*parts)(HERE), first)


def test_near_the_search_lines_and_planes_are_kept(matcher):
    found, near = matcher(HERE), moved(0.04)
    kept = matcher.again(found, near)
    assert kept.search.map_T_lidar is HERE
    rows = np.isin(found.planes.indices, kept.planes.indices)
    np.testing.assert_array_equal(kept.planes.normals, found.planes.normals[rows])
    p = kept.planes
    distances = np.sum(transform(near.matrix(), p.points) * p.normals, axis=1) + p.offsets
    np.testing.assert_allclose(p.distances, distances, atol=1e-12)
    assert not same(matcher(near), kept)


def test_away_from_the_search_matches_are_searched_for_anew(matcher):
    """The distance counts from the pose of the search, not from that of the last call."""
    found = matcher(HERE)
    assert same(matcher.again(found, moved(0.06)), matcher(moved(0.06)))
    twice = matcher.again(matcher.again(found, moved(0.04)), moved(0.08))
    assert same(twice, matcher(moved(0.08)))


def test_deskewing_anew_makes_another_matcher(parts, matcher):
    second, last, _ = parts
    found = matcher(HERE)
    anew = matcher.deskewed(HERE, found)
    np.testing.assert_array_equal(anew.posed.twist, second.twist_since(last[:2], HERE))
    assert not same(anew(HERE), found)
    np.testing.assert_array_equal(matcher.posed.twist, TWIST)
    assert same(matcher(HERE), found)
    # Kept planes take the points of the new de-skew.
    kept = anew.again(found, moved(0.01)).planes
    np.testing.assert_array_equal(kept.points, anew.posed.points[1][kept.indices])
    plain = matcher_of(*parts, refine=False)
    assert plain.deskewed(HERE, found) is plain


def expected(last, variances, share=0.0, velocity=TWIST):
    return Expected(
        last.stamp, velocity, np.full(6, share), np.full(6, np.inf), np.full(6, variances)
    )


def test_a_free_motion_is_solved_for_with_the_matches(parts):
    second, last, _ = parts
    free = replace(matcher_of(*parts, accelerations=expected(last, 1.0)), told=True)
    found, mean = free(HERE), second.twist_since(last[:2], HERE)
    assert free.motion_is_free
    solved = free.deskewed(HERE, found).posed.twist
    assert 1e-4 < np.abs(solved - mean).max() < 0.5
    np.testing.assert_array_equal(free.twist_to(HERE), mean)
    # Steadily driven, it is the mean velocity.
    steady = replace(free, accelerations=expected(last, 0.0)).posed_at(HERE, found).twist
    assert np.abs(steady - mean).max() < 0.1 * np.abs(solved - mean).max()


@pytest.mark.parametrize("told", [True, False])
def test_the_path_leads_from_the_last_middle_to_this_one(parts, told):
    """Whether the matches tell of it or not: a parabola through both, in rotation as well."""
    second, last, _ = parts
    known = expected(last, 1.0, share=0.8, velocity=TWIST - 0.3)
    matcher = replace(matcher_of(*parts, accelerations=known), told=told)
    posed = matcher.posed_at(HERE, matcher(HERE))
    seconds, mean = last.seconds_to(second.stamp), second.twist_since(last[:2], HERE)
    acceleration = posed.sweep.acceleration
    back = -posed.twist * seconds + 0.5 * acceleration * seconds**2
    apart = last.map_T_lidar.localCoordinates(HERE.compose(gtsam.Pose3.Expmap(back)))
    np.testing.assert_allclose(apart, np.zeros(6), atol=1e-9)
    usual = 0.8 * (mean - known.velocity) / seconds
    if told:
        assert np.abs(acceleration - usual).max() > 0.01
    else:
        np.testing.assert_allclose(acceleration, usual)


@pytest.mark.parametrize("told", [True, False])
def test_sweeps_that_overlap_tell_no_path_beyond_them(parts, told):
    """Their middles are 5 ms apart: a parabola through both would be metres off at the ends."""
    second, last, _ = parts
    last = last._replace(stamp=second.stamp - 5_000_000, map_T_lidar=HERE)
    known = expected(last, 1.0, share=0.8, velocity=np.full(6, 0.1))
    matcher = replace(matcher_of(second, last, parts[2], accelerations=known), told=told)
    posed = matcher.posed_at(HERE, matcher(HERE))
    assert np.abs(posed.sweep.acceleration).max() < 2.0


def test_of_another_last_sweep_no_acceleration_is_expected(parts):
    _, last, _ = parts
    known = expected(last._replace(stamp=last.stamp - 1), 1.0, share=0.8)
    matcher = replace(matcher_of(*parts, accelerations=known), told=False)
    np.testing.assert_array_equal(matcher.posed_at(HERE, None).sweep.acceleration, np.zeros(6))


def test_a_motion_is_not_free_that_is_known_or_assumed(parts):
    second, last, maps = parts
    known = {"accelerations": expected(last, 1.0)}
    constant = CONFIG.changed("deskew.model=constant")
    inertial = InertialPrediction(HERE, np.zeros(3), np.eye(6), np.zeros((3, 6)), np.eye(3))
    others = [
        matcher_of(*parts),
        matcher_of(*parts, refine=False, **known),
        matcher_of(*parts, inertial=inertial, **known),
        matcher_of(second, None, maps, **known),
        matcher_of(second, last._replace(stamp=second.stamp), maps, **known),
        matcher_of(*parts, **known).moving_at(TWIST),
        matcher_of(*parts, config=constant, **known),
    ]
    assert not any(matcher.motion_is_free for matcher in others)


def test_with_few_planes_the_search_is_wide_and_equals_brute_force():
    """Map points 1.5 m apart have no five neighbours within 1 m."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*[np.arange(-15.0, 15.0, 1.5)] * 2), axis=-1).reshape(-1, 2)
    ground = np.column_stack([grid + rng.uniform(-0.3, 0.3, grid.shape), np.full(len(grid), -1.5)])
    ground[:, 2] += 0.01 * rng.normal(size=len(ground))
    some, none = ground[::5] + np.array([0.4, 0.3, 0.0]), np.zeros((0, 3))
    first, second = (
        MovingSweep(Features.from_points(stamp, none, points), CONFIG)
        for stamp, points in ((0, ground), (10**8, some))
    )
    maps = MapPair(CONFIG)
    maps.insert(first.at(np.zeros(6)), gtsam.Pose3(), 0)
    found = matcher_of(second, Moment(0, gtsam.Pose3(), True), maps)(HERE)
    assert len(found) > 30

    config = CONFIG.matching
    reach = config.wide_search * config.max_distance
    known = maps.thinned(config.wide_search).points()
    points = second.at(TWIST).points[1]
    there = transform(HERE.matrix(), points)
    distances = cdist(there, known)
    nearest = np.argsort(distances, axis=1)[:, : config.neighbours + config.neighbours // 2]
    squared = np.take_along_axis(distances, nearest, axis=1) ** 2
    arguments = points, there, known[nearest], squared, HERE.matrix(), config, reach
    expected = match_planes(*arguments)
    np.testing.assert_array_equal(found.planes.indices, expected.indices)
    np.testing.assert_allclose(found.planes.normals, expected.normals, atol=1e-9)
    near = cdist(there, ground) < config.max_distance
    assert near.any(axis=1).all()
    means = near @ ground / near.sum(axis=1)[:, None]  # which hold the planes
    away = (there - means)[expected.indices]
    distances = np.einsum("ij,ij->i", away, expected.normals)
    np.testing.assert_allclose(found.planes.distances, distances, atol=1e-9)


def test_the_thinned_map_follows_the_window_without_an_insertion():
    """After a lost sweep nothing is inserted, but the window moves on."""
    maps = MapPair(Config())
    points = np.random.default_rng(0).uniform(-5.0, 5.0, (500, 3))
    maps.planes.insert(points)
    here = maps.thinned(4.0)
    assert here.count() > 0
    assert maps.thinned(4.0) is here
    maps.recenter(gtsam.Pose3(gtsam.Rot3(), np.array([5000.0, 0.0, 0.0])))
    assert maps.thinned(4.0).count() == 0


def test_in_a_map_that_has_enough_planes_none_is_searched_for_widely(matcher, monkeypatch):
    """The room is small: its planes are dense from the first sweep on."""
    found = matcher(HERE)
    assert len(found.planes) > 0.5 * len(matcher.rows.planes)
    monkeypatch.setattr(frame_matcher, "_FEW", 1.0)
    wider = matcher(HERE)
    assert len(wider.planes) > len(found.planes)
    near = np.isin(wider.planes.indices, found.planes.indices)
    np.testing.assert_array_equal(wider.planes.normals[near], found.planes.normals)
    monkeypatch.setattr(frame_matcher, "_THIN", 10)
    assert same(matcher(HERE), found)


def on_true_poses(scene):
    """The matcher of the fifth sweep in the map of those before it, and its pose."""
    world = SimulatedWorld(scene, frames=6, seed=2, columns=450)
    poses = [gtsam.Pose3(pose) for pose in world.truth.map_T_lidar]
    maps, parts = MapPair(CONFIG), []
    for scan, pose, after in zip(world, poses, poses[1:], strict=False):
        if parts:
            maps.insert(*parts[-1], 0)
        sweep = MovingSweep(extract_features(scan, CONFIG), CONFIG)
        posed = sweep.at(10.0 * gtsam.Pose3.Logmap(pose.between(after)))
        parts.append((posed, pose.slerp(0.5, after)))
    (before, there), (now, here) = parts[-2:]
    last = Moment(before.sweep.stamp, there, True)
    return FrameMatcher.of(now, maps, CONFIG, last, Clock()), here


@pytest.mark.parametrize(
    ("scene", "closes"), [("tunnel_pilasters", True), ("sparse_terrain", False)]
)
def test_wide_planes_count_where_they_close_an_open_translation(scene, closes, monkeypatch):
    """Rings on floor and ceiling of a tunnel tell the height; between poles nothing tells x, y."""
    monkeypatch.setattr(frame_matcher, "_FEW", 0.0)
    matcher, pose = on_true_poses(scene)
    narrow = replace(matcher, matching=CONFIG.matching.changed(wide_search=1.0))
    assert translations_fixed(narrow(pose).planes)[0] < CONFIG.matching.wide_below
    assert (len(matcher(pose).planes) > len(narrow(pose).planes)) == closes
    if closes:
        height = [localizability(one(pose), pose).axes()[5] for one in (narrow, matcher)]
        assert 4.0 * height[0] < height[1] > 5.0 * CONFIG.solver.min_aligned


LIMIT = CONFIG.map.small_below


def sweep_of(points, reach=np.inf):
    features = replace(Features.from_points(0, points[::7], points), reach=reach)
    return MovingSweep(features, CONFIG).at(np.zeros(6))


def wall(seed, x):
    """4,000 points of a wall of 10 m x 5 m."""
    rng = np.random.default_rng(seed)
    return np.column_stack([np.full(4000, x), rng.uniform([-5.0, 0.0], [5.0, 5.0], (4000, 2))])


def test_the_maps_of_small_places_are_in_use_until_the_reach_is_clearly_larger():
    maps, here = MapPair(CONFIG), gtsam.Pose3()
    used = []
    for reach in (np.inf, LIMIT, 0.99 * LIMIT, 1.49 * LIMIT, 1.51 * LIMIT, LIMIT, 0.99 * LIMIT):
        maps.recenter(here, reach)
        used.append(maps.small)
    assert used == [False, False, True, True, False, False, True]
    maps.recenter(here)
    maps.clear()
    assert maps.small
    matching = maps.config.matching
    assert matching.neighbours == 2 * CONFIG.matching.neighbours
    always = MapPair(CONFIG.changed("map.small_below=0"))
    always.recenter(here, 0.1)
    assert not always.small
    assert always.config.matching == CONFIG.matching


@pytest.mark.parametrize("insertion", ["settled", "centroid"])
def test_out_of_the_street_into_a_small_place_and_back(insertion):
    """The small map takes over what was there; the map of the open stays as coarse as ever."""
    maps, here = MapPair(CONFIG.changed({"map.insertion": insertion})), gtsam.Pose3()
    street, later = sweep_of(wall(0, 3.0)), sweep_of(wall(2, 8.0))
    stairs = sweep_of(wall(1, 3.0), reach=1.0)
    maps.recenter(here)
    maps.insert(street, here, 1)
    before = maps.planes.points()
    maps.recenter(here, 1.0)
    np.testing.assert_array_equal(in_order(maps.planes.points()), in_order(before))
    maps.insert(stairs, here, 2)
    fine = maps.planes.points()
    assert len(fine) > 2.5 * len(before)  # of four voxels of 0.2 m in one of 0.4 m
    assert set(map(tuple, before)) <= set(map(tuple, fine)) or insertion == "centroid"
    maps.recenter(here, 100.0)
    assert len(maps.planes.points()) < 1.3 * len(before)
    maps.insert(later, here, 3)
    edges, planes = maps.points()
    assert set(map(tuple, fine)) <= set(map(tuple, planes))
    assert np.count_nonzero(planes[:, 0] > 7.0) == np.count_nonzero(maps.planes.points()[:, 0] > 7)
    maps.recenter(here, 1.0)
    np.testing.assert_array_equal(in_order(maps.planes.points()), in_order(planes))
    assert len(edges) >= len(maps.edges.points())


def in_order(points):
    return points[np.lexsort(points.T)]


def test_points_of_both_resolutions_follow_their_keyframe_and_come_back_from_the_archive():
    maps, here = MapPair(CONFIG), gtsam.Pose3()
    maps.recenter(here)
    maps.insert(sweep_of(wall(0, 3.0)), here, 1)
    maps.recenter(here, 1.0)
    maps.insert(sweep_of(wall(1, 3.0), 1.0), here, 2)
    _, whole = maps.points()
    maps.recenter(gtsam.Pose3(gtsam.Rot3(), np.array([5000.0, 0.0, 0.0])), 100.0)
    assert maps.planes.count() == 0
    np.testing.assert_array_equal(in_order(maps.points()[1]), in_order(whole))
    up = np.eye(4)
    up[2, 3] = 10.0
    moved = maps.points({1: up, 2: up})[1]
    maps.move({1: up, 2: up})
    np.testing.assert_array_equal(in_order(maps.points()[1]), in_order(moved))
    np.testing.assert_allclose(moved[:, 2].mean(), whole[:, 2].mean() + 10.0, atol=0.1)
    maps.recenter(here, 1.0)
    assert len(maps.planes.points()) == len(moved)
