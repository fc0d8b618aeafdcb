"""The matcher of one frame: pure, keeps matches near by, searches widely where there is little."""

from dataclasses import fields

import gtsam
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from loam_gtsam.config import Config
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.geometry import transform
from loam_gtsam.registration import frame_matcher
from loam_gtsam.registration.association import match_planes
from loam_gtsam.registration.frame_matcher import FrameMatcher, MapPair
from loam_gtsam.registration.odometry import Moment
from loam_gtsam.registration.report import Clock
from loam_gtsam.types import Features

CONFIG = Config()
HERE = gtsam.Pose3(gtsam.Rot3.Yaw(0.01), np.array([0.1, 0.02, 0.0]))
TWIST = np.array([0.0, 0.0, 0.1, 1.0, 0.2, 0.0])


def matcher_of(second, last, maps, *, refine=True):
    return FrameMatcher.of(second.at(TWIST), maps, CONFIG, last, Clock(), refine=refine)


@pytest.fixture(scope="module")
def parts():
    """The second sweep of the room, the middle of the first one, and the map of the first one."""
    world = SimulatedWorld("room", frames=2, columns=450)
    first, second = (MovingSweep(extract_features(scan, CONFIG), CONFIG) for scan in world)
    maps = MapPair(CONFIG.map)
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
        matcher.deskewed(other)(other)
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
    anew = matcher.deskewed(HERE)
    np.testing.assert_array_equal(anew.posed.twist, second.twist_since(last[:2], HERE))
    assert not same(anew(HERE), found)
    np.testing.assert_array_equal(matcher.posed.twist, TWIST)
    assert same(matcher(HERE), found)
    # Kept planes take the points of the new de-skew.
    kept = anew.again(found, moved(0.01)).planes
    np.testing.assert_array_equal(kept.points, anew.posed.points[1][kept.indices])
    plain = matcher_of(*parts, refine=False)
    assert plain.deskewed(HERE) is plain


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
    maps = MapPair(CONFIG.map)
    maps.insert(first.at(np.zeros(6)), gtsam.Pose3(), 0)
    found = matcher_of(second, Moment(0, gtsam.Pose3(), True), maps)(HERE)
    assert len(found) > 30

    config = CONFIG.matching
    reach = config.wide_search * config.max_distance
    known = maps.thinned(config.wide_search).points()
    points = second.at(TWIST).points[1]
    there = transform(HERE.matrix(), points)
    distances = cdist(there, known)
    nearest = np.argsort(distances, axis=1)[:, : config.neighbours]
    squared = np.take_along_axis(distances, nearest, axis=1) ** 2
    arguments = points, there, known[nearest], squared, HERE.matrix(), config, reach
    expected = match_planes(*arguments)
    np.testing.assert_array_equal(found.planes.indices, expected.indices)
    np.testing.assert_allclose(found.planes.normals, expected.normals, atol=1e-9)
    np.testing.assert_allclose(found.planes.distances, expected.distances, atol=1e-9)


def test_the_thinned_map_follows_the_window_without_an_insertion():
    """After a lost sweep nothing is inserted, but the window moves on."""
    maps = MapPair(Config().map)
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
