"""Association: closed forms, every gate from both sides, brute force, frames."""

import dataclasses
from functools import partial

import gtsam
import numpy as np
import pytest

from loam_gtsam.config import MapConfig, MatchingConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.geometry import transform
from loam_gtsam.registration.association import (
    associate,
    match_features,
    match_lines,
    rematched,
)
from loam_gtsam.registration.matches import ScanMatches, chosen_rows, spread_rows, trial_matching
from loam_gtsam.registration.planes import match_planes

CONFIG = MatchingConfig(plane_tolerance=0.2)  # groups may be rough
STEPS = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
X, Y, Z = np.eye(3)
SQUARE = np.array([[1.0, 1], [1, -1], [-1, -1], [-1, 1], [0, 0]])
AHEAD = 5.0 * X


def changed(**changes):
    return CONFIG.changed(**changes)


def one(match, point, group, config=CONFIG, pose=None, squared=0.25):
    """Match one map point with one group of five, seen from ``pose``."""
    pose = np.eye(4) if pose is None else pose
    return match(
        transform(np.linalg.inv(pose), np.array([point], dtype=float)),
        np.array([point], dtype=float),
        np.asarray(group, dtype=float)[None],
        np.full((1, len(group)), squared),
        pose,
        config,
    )


def line_group(along=0.4 * Z, aside=0.0 * Y, centre=AHEAD):
    """Variance 2 |along|^2 and 1.2 |aside|^2, uncorrelated."""
    return centre + np.outer(STEPS, along) + np.outer([1.0, 0, -2, 0, 1], aside)


def plane_group(wide=0.5 * Y, narrow=0.5 * Z, saddle=0.0 * X, centre=AHEAD):
    """Variances 0.8 |wide|^2, 0.8 |narrow|^2 and 0.8 |saddle|^2, uncorrelated."""
    return (
        centre
        + np.outer(SQUARE[:, 0], wide)
        + np.outer(SQUARE[:, 1], narrow)
        + np.outer(SQUARE[:, 0] * SQUARE[:, 1], saddle)
    )


def test_a_line_match_in_closed_form():
    matches = one(match_lines, [5.0, 0.1, 0.3], line_group())
    assert len(matches) == 1
    np.testing.assert_allclose(matches.centres[0], AHEAD, atol=1e-12)
    np.testing.assert_allclose(np.abs(matches.directions[0]), Z, atol=1e-9)
    np.testing.assert_allclose(matches.distances, [0.1], atol=1e-9)
    np.testing.assert_allclose(matches.weights, [1 - 0.9 * 0.1], atol=1e-9)
    np.testing.assert_array_equal(matches.points, [[5.0, 0.1, 0.3]])
    np.testing.assert_array_equal(matches.indices, [0])


def test_a_plane_match_in_closed_form():
    matches = one(match_planes, [4.8, 0.1, 0.3], plane_group())
    assert len(matches) == 1
    sign = np.sign(matches.normals[0, 0])
    np.testing.assert_allclose(sign * matches.normals[0], X, atol=1e-9)
    np.testing.assert_allclose(sign * matches.offsets, [-5.0], atol=1e-9)
    np.testing.assert_allclose(sign * matches.distances, [-0.2], atol=1e-9)
    reach = np.linalg.norm([4.8, 0.1, 0.3])
    np.testing.assert_allclose(matches.weights, [1 - 0.9 * 0.2 / np.sqrt(reach)], atol=1e-9)
    np.testing.assert_array_equal(matches.indices, [0])


@pytest.mark.parametrize("sigma", [0.01, 0.03])
def test_sigmas_of_a_perfect_fit_in_closed_form(sigma):
    config = changed(point_sigma=sigma)

    def line(along):
        return one(match_lines, AHEAD + along * Z, line_group(), config).sigmas[0]

    def plane(wide, narrow):
        group = plane_group(0.5 * Y, 0.4 * Z)
        return one(match_planes, AHEAD + wide * Y + narrow * Z, group, config).sigmas[0]

    # 0.32 is the variance of the five along the line; 0.2 and 0.128 those in the plane.
    assert line(0.0) == pytest.approx(sigma * np.sqrt(1 + 1 / 5), rel=1e-6)
    assert line(3.0) == pytest.approx(sigma * np.sqrt(1 + (1 + 9 / 0.32) / 5), rel=1e-6)
    assert plane(0.0, 0.0) == pytest.approx(sigma * np.sqrt(1 + 1 / 5), rel=1e-6)
    assert plane(1.0, 0.0) == pytest.approx(sigma * np.sqrt(1 + (1 + 1 / 0.2) / 5), rel=1e-6)
    assert plane(0.0, 1.0) == pytest.approx(sigma * np.sqrt(1 + (1 + 1 / 0.128) / 5), rel=1e-6)
    both = 1 + (1 + 1 / 0.2 + 4 / 0.128) / 5
    assert plane(1.0, 2.0) == pytest.approx(sigma * np.sqrt(both), rel=1e-6)
    assert line(0.0) < line(0.1) < line(1.0)


@pytest.mark.parametrize("uncertain", [True, False])
def test_an_edge_between_two_beams_is_somewhere_between_them(uncertain):
    """And so is the line of the map; what is less than the noise of a point is in that."""
    config, held = changed(fit_uncertainty=uncertain), map_of(line_group())
    sigmas, features = np.array([0.0, 0.02, 0.2]), np.tile(AHEAD, (3, 1))
    rows = chosen_rows(3, 0, config, sigmas=sigmas)
    none = np.empty((0, 3))
    found = match_features(features, none, gtsam.Pose3(), held, held, config, rows).edges
    expected = 1.2 * 0.03**2 + np.array([0.0, 0.0, 2.0 * 0.2**2 - 0.03**2])
    assert found.sigmas == pytest.approx(np.sqrt(expected) if uncertain else np.full(3, 0.03))


def test_scatter_of_the_neighbours_raises_the_sigma():
    line = one(match_lines, AHEAD, line_group(aside=0.1 * Y)).sigmas[0]
    assert line == pytest.approx(np.sqrt(0.012 * 5 / 3 * 1.2), rel=1e-6)
    plane = one(match_planes, AHEAD, plane_group(saddle=0.1 * X)).sigmas[0]
    assert plane == pytest.approx(np.sqrt(0.008 * 5 / 2 * 1.2), rel=1e-6)
    # Less scatter than that of a point counts as that of a point.
    smooth = one(match_planes, AHEAD, plane_group(saddle=0.001 * X)).sigmas[0]
    assert smooth == pytest.approx(0.03 * np.sqrt(1.2), rel=1e-6)


@pytest.mark.parametrize("uncertain", [True, False])
@pytest.mark.parametrize(
    ("saddle", "beyond"), [(0.029, 0.0), (0.05, 4 * np.sqrt(0.05**2 - 0.03**2))]
)
def test_a_plane_much_rougher_than_those_of_the_sweep_is_wrong_by_what_is_beyond(
    saddle, beyond, uncertain
):
    """Of three planes, two are 15 mm rough: up to 3 cm, as by noise, the third is like them."""
    groups = np.array([plane_group(saddle=by * X) for by in (0.015, 0.015, saddle)])
    points, config = np.tile(AHEAD, (3, 1)), changed(fit_uncertainty=uncertain)
    near = np.full((3, 5), 0.25)
    sigmas = match_planes(points, points, groups, near, np.eye(4), config).sigmas
    alone = [one(match_planes, AHEAD, group, config).sigmas[0] for group in groups]
    rough = np.hypot(alone[2], beyond) if uncertain else alone[2]
    np.testing.assert_allclose(sigmas, [*alone[:2], rough], rtol=1e-6)


def test_few_neighbours_leave_one_degree_of_freedom_at_least():
    """Four points leave a plane one, three leave it none: then the scatter counts in full."""
    square = plane_group(saddle=0.1 * X)[:4]
    config = changed(neighbours=4)
    plane = one(match_planes, AHEAD, square, config).sigmas[0]
    assert plane == pytest.approx(np.sqrt(0.01 * 4 / 1 * (1 + 1 / 4)), rel=1e-6)
    three = AHEAD + np.array([[0.1, 0, -0.5], [-0.2, 0, 0], [0.1, 0, 0.5]])
    line = one(match_lines, AHEAD, three, changed(neighbours=3, line_ratio=2.0)).sigmas[0]
    assert line == pytest.approx(np.sqrt(0.02 * 3 / 1 * (1 + 1 / 3)), rel=1e-6)


def test_the_distance_from_a_plane_is_no_distance_within_it():
    above = one(match_planes, AHEAD - 0.4 * X, plane_group())
    assert above.sigmas[0] == pytest.approx(0.03 * np.sqrt(1 + 1 / 5), rel=1e-6)


def test_tilts_in_closed_form():
    """Of a line by its own length, of a plane by the shorter side of the two."""
    line = one(match_lines, AHEAD, line_group())
    np.testing.assert_allclose(line.tilts, 0.03 / np.sqrt(5 * 0.32), rtol=1e-6)
    rough = one(match_lines, AHEAD, line_group(aside=0.1 * Y))
    np.testing.assert_allclose(rough.tilts, np.sqrt(0.012 * 5 / 3 / (5 * 0.32)), rtol=1e-6)
    plane = one(match_planes, AHEAD, plane_group(0.5 * Y, 0.4 * Z))
    np.testing.assert_allclose(plane.tilts, 0.03 / np.sqrt(5 * 0.128), rtol=1e-6)


def test_without_fit_uncertainty_every_sigma_is_that_of_a_point():
    config = changed(fit_uncertainty=False)
    assert one(match_lines, AHEAD + 3 * Z, line_group(aside=0.1 * Y), config).sigmas[0] == 0.03
    assert one(match_planes, AHEAD + 3 * Z, plane_group(saddle=0.1 * X), config).sigmas[0] == 0.03


@pytest.mark.parametrize(("match", "group"), [(match_lines, line_group()),
                                              (match_planes, plane_group())])  # fmt: skip
def test_the_farthest_neighbour_must_be_near(match, group):
    assert len(one(match, AHEAD, group, squared=0.9999)) == 1
    assert len(one(match, AHEAD, group, squared=1.0)) == 0
    assert len(one(match, AHEAD, group, squared=1.0001)) == 0
    assert len(one(match, AHEAD, group, changed(max_distance=1.1), squared=1.0001)) == 1
    assert len(one(match, AHEAD, group, changed(max_distance=1.1), squared=1.2099)) == 1
    assert len(one(match, AHEAD, group, changed(max_distance=1.1), squared=1.2101)) == 0
    farthest = np.array([0.1, 0.2, 0.3, 0.4, 1.01])
    assert len(one(match, AHEAD, group, squared=farthest)) == 0
    missing = group.copy()
    missing[-1] = np.nan
    assert len(one(match, AHEAD, missing, squared=np.inf)) == 0


@pytest.mark.parametrize("ratio", [3.0, 10.0])
def test_a_line_must_be_long_against_its_width(ratio):
    width = np.sqrt(0.32 / ratio / 1.2)
    config = changed(line_ratio=ratio)
    assert len(one(match_lines, AHEAD, line_group(aside=0.999 * width * Y), config)) == 1
    assert len(one(match_lines, AHEAD, line_group(aside=1.001 * width * Y), config)) == 0


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_a_line_may_not_run_along_the_ring(seed):
    """At a point straight ahead the ring runs along y, wherever the sensor is and looks."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4) if seed is None else gtsam.Pose3.Expmap(3 * rng.normal(size=6)).matrix()

    def count(degrees, config=CONFIG):
        along = np.cos(np.radians(degrees)) * Y + np.sin(np.radians(degrees)) * Z
        group = transform(pose, line_group(0.4 * along))
        return len(one(match_lines, transform(pose, AHEAD[None])[0], group, config, pose))

    assert [count(a) for a in (0, 30, 59.9, 60.1, 90, 119.9, 120.1)] == [0, 0, 0, 1, 1, 1, 0]
    assert count(0, changed(max_ring_cosine=2.0)) == 1


@pytest.mark.parametrize(("height", "kept"), [(0.0, 0), (2.0, 0), (-2.0, 0), (3.0, 1), (-3.0, 1)])
def test_what_a_beam_traces_on_a_wall_along_the_way_is_no_line(height, kept):
    """Seen from 1.5 m beside a wall, a line along it converges with the rings: 60 degrees at 2.6 m.

    Its direction in space is nearly that of the ray, far from that of the ring.
    """
    here = 12.0 * X + 1.5 * Y + height * Z
    group = line_group(0.4 * X, centre=here)
    assert len(one(match_lines, here, group)) == kept
    assert len(one(partial(match_lines, level_rings=False), here, group)) == 1


def test_a_limit_of_one_keeps_lines_along_the_ring_and_no_limit_is_needed_above_the_sensor():
    assert len(one(match_lines, AHEAD, line_group(0.4 * Y), changed(max_ring_cosine=1.0))) == 1
    # Straight above there is no ring.
    assert len(one(match_lines, 5 * Z, line_group(0.4 * Y, centre=5 * Z))) == 1


def test_a_plane_must_be_flat():
    for tolerance in (0.1, 0.2):
        config = changed(plane_tolerance=tolerance)
        for share, kept in ((0.999, 1), (1.001, 0)):
            group = plane_group(saddle=share * tolerance * X)
            assert len(one(match_planes, AHEAD, group, config)) == kept


def test_a_plane_must_be_wide_both_ways():
    edge = np.sqrt(CONFIG.plane_ratio)
    assert len(one(match_planes, AHEAD, plane_group(0.5 * Y, 1.001 * edge * 0.5 * Z))) == 1
    assert len(one(match_planes, AHEAD, plane_group(0.5 * Y, 0.999 * edge * 0.5 * Z))) == 0
    collinear = line_group(0.2 * Y)
    assert len(one(match_planes, AHEAD, collinear)) == 0
    narrow = plane_group(0.5 * Y, 0.01 * Z)
    assert len(one(match_planes, AHEAD, narrow, changed(plane_ratio=0.0))) == 1


@pytest.mark.parametrize("seed", [None, 0])
def test_a_plane_may_not_contain_the_viewing_ray(seed):
    rng = np.random.default_rng(seed)
    pose = np.eye(4) if seed is None else gtsam.Pose3.Expmap(3 * rng.normal(size=6)).matrix()

    def count(sine, config=CONFIG):
        point = 20.0 * np.array([np.sqrt(1 - sine**2), 0.0, -sine])
        group = transform(pose, plane_group(0.5 * X, 0.5 * Y, centre=point))
        return len(one(match_planes, transform(pose, point[None])[0], group, config, pose))

    assert [count(s) for s in (0.0, 0.0499, 0.0501, 0.5, -0.0499, -0.0501)] == [0, 0, 1, 1, 0, 1]
    assert count(0.0, changed(min_incidence_sine=0.0)) == 1


def test_a_far_line_is_dropped_by_its_weight():
    for slope, edge in ((0.9, 1.0), (1.8, 0.5)):
        config = changed(weight_slope=slope)
        near, far = ([5.0, share * edge, 0.0] for share in (0.999, 1.001))
        assert one(match_lines, near, line_group(), config).weights == pytest.approx(0.1, abs=1e-3)
        assert len(one(match_lines, far, line_group(), config)) == 0
    assert one(match_lines, far, line_group(), changed(weight_slope=0.0)).weights == 1.0
    assert len(one(match_lines, far, line_group(), changed(min_weight=0.05))) == 1


def test_a_far_plane_is_dropped_by_its_weight_sooner_when_near():
    def count(distance, reach, config=CONFIG):
        group = plane_group(centre=(reach - distance) * X)
        return len(one(match_planes, reach * X, group, config))

    for reach in (1.0, 4.0, 25.0):
        edge = np.sqrt(reach)  # 1 - 0.9 d / sqrt(range) = 0.1
        assert count(0.999 * edge, reach) == count(-0.999 * edge, reach) == 1
        assert count(1.001 * edge, reach) == count(-1.001 * edge, reach) == 0
        assert count(1.001 * edge, reach, changed(weight_slope=0.0)) == 1


def test_a_weight_at_the_limit_is_too_small():
    """LOAM keeps s > 0.1; with halves the weight is exact."""
    config = changed(weight_slope=0.5, min_weight=0.5)
    edge, above = [5.0, 1.0, 0.0], [4.0, 0.0, 0.0]
    assert len(one(match_lines, edge, line_group(), config)) == 0
    steep = changed(weight_slope=1.0, min_weight=0.5)
    assert len(one(match_planes, above, plane_group(), steep)) == 0
    kept = ScanMatches(
        one(match_lines, edge, line_group(), changed(weight_slope=0.5)),
        one(match_planes, above, plane_group(), changed(weight_slope=1.0)),
    )
    assert (len(kept.edges), len(kept.planes)) == (1, 1)
    renewed = rematched(kept, gtsam.Pose3(), config)
    assert (len(renewed.edges), len(renewed.planes)) == (0, 1)
    renewed = rematched(kept, gtsam.Pose3(), steep)
    assert (len(renewed.edges), len(renewed.planes)) == (0, 0)


UNIT_OFFSET = changed(plane_fit="unit_offset", min_incidence_sine=0.0)


@pytest.mark.parametrize("seed", range(4))
def test_unit_offset_planes_are_the_least_squares_of_loam(seed):
    """A n = -1 over the five neighbours; rough ones, so that the two fits differ."""
    rng = np.random.default_rng(seed)
    turn = gtsam.Pose3.Expmap(3 * rng.normal(size=6)).matrix()
    flat = plane_group(0.5 * Y, 0.4 * Z, centre=rng.uniform(2, 9) * X)
    group = transform(turn, flat + rng.normal(0, 0.03, (5, 3)))
    point = group.mean(axis=0) + 0.1 * rng.normal(size=3)
    found = one(match_planes, point, group, UNIT_OFFSET)
    n = np.linalg.lstsq(group, -np.ones(5), rcond=None)[0]
    length = np.linalg.norm(n)
    np.testing.assert_allclose(found.normals, [n / length], atol=1e-9)
    np.testing.assert_allclose(found.offsets, [1.0 / length], rtol=1e-9)
    np.testing.assert_allclose(found.distances, [(n @ point + 1.0) / length], atol=1e-9)
    ours = one(match_planes, point, group, changed(min_incidence_sine=0.0))
    assert np.abs(np.abs(ours.offsets) - found.offsets) > 1e-5


def test_unit_offset_planes_lose_nothing_where_the_points_lie_in_the_plane_exactly():
    found = one(match_planes, [4.8, 0.1, 0.3], plane_group(), UNIT_OFFSET)
    np.testing.assert_array_equal(found.normals, [-X])
    np.testing.assert_array_equal(found.offsets, [5.0])


@pytest.mark.parametrize("group", [
    plane_group(0.5 * Y, 0.5 * Z, centre=0.0 * X),  # through the map origin
    plane_group(0.5 * Y, 0.5 * Z, saddle=0.1 * X, centre=0.0 * X),  # all around it
    line_group(0.4 * X, centre=0.0 * X),
])  # fmt: skip
def test_unit_offset_cannot_represent_every_plane(group):
    config = UNIT_OFFSET.changed(plane_ratio=0.0)
    beside = np.eye(4)
    beside[:3, 3] = 3.0, 2.0, 1.0
    with np.errstate(all="raise"):
        assert len(one(match_planes, [0.1, 0.2, 0.1], group, config, beside)) == 0
    if np.linalg.matrix_rank(group) > 1:
        centroid = changed(min_incidence_sine=0.0)
        assert len(one(match_planes, [0.1, 0.2, 0.1], group, centroid, beside)) == 1


def test_the_range_in_the_weight_is_from_the_sensor_or_from_the_map_origin():
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([-3.0, 0.0, 0.0]))
    point = [4.8, 0.1, 0.3]
    edges = one(match_lines, [5.0, 0.1, 0.3], line_group(), pose=pose.matrix())
    for kind, origin in (("lidar", [-3.0, 0.0, 0.0]), ("map", [0.0, 0.0, 0.0])):
        config = changed(weight_range=kind)
        planes = one(match_planes, point, plane_group(), config, pose.matrix())
        reach = np.linalg.norm(np.array(point) - origin)
        expected = 1.0 - 0.9 * 0.2 / np.sqrt(reach)
        np.testing.assert_allclose(planes.weights, [expected], atol=1e-9)
        stripped = dataclasses.replace(planes, weights=np.zeros(1))
        renewed = rematched(ScanMatches(edges, stripped), pose, config)
        np.testing.assert_allclose(renewed.planes.weights, [expected], atol=1e-9)


def map_of(points, voxel=0.01, **changes):
    cubes = CubeMap(MapConfig(field_of_view=False).changed(**changes), voxel)
    if len(points):
        cubes.insert(points)
    return cubes


@pytest.mark.parametrize(("limit", "rows"), [
    (0, range(12)),
    (12, range(12)),
    (13, range(12)),
    (4, [0, 3, 6, 9]),
    (5, [0, 2, 4, 7, 9]),
])  # fmt: skip
def test_at_most_so_many_features_are_matched_at_even_distances(limit, rows):
    away = np.linspace(0.0, 0.22, 12)
    points = AHEAD + np.outer(away, X)  # each with the same line and plane, at its own distance
    limits = {"max_edges": limit, "max_planes": limit}
    lines, planes = map_of(line_group()), map_of(plane_group())
    matches = associate(points, points, gtsam.Pose3(), lines, planes, changed(**limits))
    for kind in (matches.edges, matches.planes):
        np.testing.assert_array_equal(kind.indices, list(rows))
        np.testing.assert_array_equal(kind.points, points[list(rows)])
        np.testing.assert_allclose(np.abs(kind.distances), away[list(rows)], atol=1e-9)


@pytest.mark.parametrize(("limit", "rows"), [
    (0, range(8)),
    (1, [1]),
    (2, [1, 4]),
    (3, [1, 4, 6]),
    (4, [0, 1, 4, 6]),
    (6, [0, 1, 2, 4, 5, 6]),
    (8, range(8)),
])  # fmt: skip
def test_those_that_stand_out_are_matched_before_others(limit, rows):
    first = np.isin(np.arange(8), [1, 4, 6])
    np.testing.assert_array_equal(spread_rows(8, limit, first), list(rows))


def poles(*places, spacing=0.2):
    """Five points each, upright and around eye level."""
    return np.concatenate([line_group(spacing * Z, centre=np.array([*at, 0.0])) for at in places])


FAR_APART = 0.8  # m between the points of a pole: the fifth is 1.6 m off


def test_a_distinct_edge_without_a_line_near_is_searched_for_more_widely():
    held = map_of(np.concatenate([
        poles((5.0, 0.0), (9.0, 0.0)),
        poles((5.0, 8.0), (9.0, 8.0), spacing=FAR_APART),
    ]))  # fmt: skip
    features = np.array([[5, 8, 0.01], [5, 0, 0.02], [9, 8, 0.03], [9, 0, 0.04], [0, -20, 0]])
    distinct = np.array([True, True, False, False, True])
    none = np.empty((0, 3))

    def match(config, distinct):
        found = associate(features, none, gtsam.Pose3(), held, held, config, distinct)
        return found.edges

    for wide, rows in ((4.0, [0, 1, 3]), (2.0, [0, 1, 3]), (1.5, [1, 3]), (1.0, [1, 3])):
        edges = match(changed(wide_search=wide), distinct)
        np.testing.assert_array_equal(edges.indices, rows)  # in the order of the features
        np.testing.assert_array_equal(edges.points, features[rows])
        np.testing.assert_array_equal(edges.distinct, distinct[rows])
        np.testing.assert_allclose(edges.centres[:, :2], features[rows, :2], atol=1e-9)
        np.testing.assert_allclose(np.abs(edges.directions), [Z] * len(rows), atol=1e-9)
        spacing = np.where(np.array(rows) == 0, FAR_APART, 0.2)
        np.testing.assert_allclose(edges.tilts, 0.03 / np.sqrt(10.0 * spacing**2), rtol=1e-6)
    # It multiplies the usual reach, whatever that is: 1.65 m, 1.52 m.
    assert len(match(changed(wide_search=1.1, max_distance=1.5), distinct)) == 3
    assert len(match(changed(wide_search=1.9, max_distance=0.8), distinct)) == 2
    np.testing.assert_array_equal(match(CONFIG, None).indices, [1, 3])
    assert match(CONFIG, None).distinct is None
    np.testing.assert_array_equal(match(CONFIG, np.full(5, True)).indices, [1, 3])


@pytest.mark.parametrize("count", [1, 2, 4])
def test_what_stands_alone_is_matched_with_the_few_points_near_by(count):
    stands = np.array([5.0, 8.0, 0.0]) + np.outer(np.arange(count), [0.0, 0.1, 0.3])
    held = map_of(np.concatenate([stands, [[20.0, 8.0, 0.0]]]))
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.2, -0.1, 0.7), np.array([1.0, 2.0, 0.5]))
    things = np.array([[5.2, 8.1, 0.1], [20.9, 8.5, 0.0], [-9.0, 0.0, 0.0], [5.0, 8.2, 0.2]])
    features = pose.transformTo(things.T).T
    alone = np.array([True, True, True, False])
    none = np.empty((0, 3))

    def near_by(config, alone):
        rows = chosen_rows(4, 0, config, np.full(4, True), alone)
        return match_features(features, none, pose, held, held, config, rows).edges

    edges = near_by(CONFIG, alone)
    # The second is 1.03 m from the nearest point, the fourth is no pole.
    np.testing.assert_array_equal(edges.indices, [0])
    np.testing.assert_allclose(edges.centres, [stands.mean(axis=0)], atol=1e-9)
    up = pose.rotation().matrix()[:, 2]
    np.testing.assert_allclose(edges.directions, [up], atol=1e-12)
    away = np.linalg.norm(np.cross(things[0] - stands.mean(axis=0), up))
    np.testing.assert_allclose(edges.distances, [away], atol=1e-9)
    # Even in a disc of 1 m, both the point and the mean of its neighbours.
    np.testing.assert_allclose(edges.sigmas, [0.5 * np.sqrt(1.0 + 1.0 / count)])
    assert len(near_by(changed(wide_search=1.0), alone)) == 0
    assert len(near_by(CONFIG, None)) == 0
    walls, on_walls = zip(*(wall(across, 10) for across in (X, Y, Z)), strict=True)
    held_planes, config = map_of(np.concatenate(walls)), changed(max_planes=0)
    for planes, count in ((on_walls, 0), (on_walls[:2], 1)):  # these leave the height open
        rows = chosen_rows(4, 10 * len(planes), config, np.full(4, True), alone)
        there = pose.transformTo(np.concatenate(planes).T).T
        found = match_features(features, there, pose, held, held_planes, config, rows)
        assert len(found.planes) == 10 * len(planes)
        assert len(found.edges) == count


@pytest.mark.parametrize(("other", "found"), [(1.9, 0), (2.1, 1), (0.05, 1)])
def test_what_may_as_well_be_another_pole_is_not_searched_for_more_widely(other, found):
    """A pole is 1 m away from where it is expected, and stands ``other`` metres from the next."""
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.2, -0.1, 0.7), np.array([1.0, 2.0, 0.5]))
    _, side, up = pose.rotation().matrix().T
    held = map_of(np.array([9.0, 0.0, 0.0]) + FAR_APART * np.outer(np.arange(-2, 3), up))
    things = np.array([9.0, 0.0, 0.0]) - np.array([[1.0], [1.0 + other]]) * side
    features = pose.transformTo(things.T).T
    known = np.array([True, True])
    rows = chosen_rows(2, 0, CONFIG, known, known)
    config = changed(wide_search=2.0, weight_slope=0.5)
    none = np.empty((0, 3))
    chosen = features, none, pose, held, held, config, rows
    edges = match_features(*chosen, expected=True).edges
    assert np.count_nonzero(edges.indices == 0) == found  # 5 cm beside is the same pole
    assert (match_features(*chosen).edges.indices == 0).any()  # on trial it may be far away


def wall(across, count):
    """Points every 0.5 m on a wall 10 m ahead of the sensor, and features on it, off its edges."""
    along, up = np.delete(np.eye(3), np.argmax(across), axis=0)
    steps = np.arange(-3.0, 3.5, 0.5)
    a, b = np.meshgrid(steps, steps)
    points = 10.0 * across + np.outer(a.ravel(), along) + np.outer(b.ravel(), up)
    inside = points[(np.maximum(np.abs(a), np.abs(b)) < 3.0).ravel()]
    return points, inside[np.linspace(0, len(inside) - 1, count).astype(int)]


@pytest.mark.parametrize(
    ("walls", "count", "wide_below", "searched"),
    [
        ((X, Y, Z), 10, 8.0, False),
        ((X, Y, Z), 7, 8.0, True),
        ((X, Y, Z), 7, 5.0, False),
        ((X, Z), 20, 8.0, True),
        ((X, Z), 20, 0.0, True),
    ],
)
def test_edges_are_searched_for_widely_where_planes_leave_a_translation_open(
    walls, count, wide_below, searched
):
    held = map_of(poles((5.0, 8.0), spacing=FAR_APART))
    points, features = zip(*(wall(across, count) for across in walls), strict=True)
    edges, distinct = np.array([[5, 8, 0.01], [0, -20, 0]]), np.array([True, False])
    maps, config = (held, map_of(np.concatenate(points))), changed(wide_below=wide_below)
    found = associate(edges, np.concatenate(features), gtsam.Pose3(), *maps, config, distinct)
    assert len(found.planes) == count * len(walls)
    assert len(found.edges) == searched


@pytest.mark.parametrize(("most", "expected"), [(0, (20, 70)), (50, (20, 50)), (10, (10, 10))])
def test_the_configuration_for_trials_never_matches_more(most, expected):
    config = changed(max_edges=most, max_planes=most, trial_edges=20, trial_planes=70)
    assert trial_matching(config) == config.changed(max_edges=expected[0], max_planes=expected[1])


@pytest.mark.parametrize(("n_map", "found"), [(0, 0), (4, 0), (5, 1)])
def test_fewer_map_points_than_neighbours_give_no_match(n_map, found):
    lines = map_of(line_group()[:n_map])
    planes = map_of(plane_group()[:n_map])
    matches = associate(AHEAD[None], AHEAD[None], gtsam.Pose3(), lines, planes, CONFIG)
    assert (len(matches.edges), len(matches.planes)) == (found, found)
    assert matches.edges.points.shape == matches.planes.normals.shape == (found, 3)


def test_no_features_give_no_matches():
    none, held = np.empty((0, 3)), map_of(plane_group())
    matches = associate(none, none, gtsam.Pose3(), held, held, CONFIG)
    assert len(matches) == 0
    assert matches.edges.directions.shape == (0, 3)
    assert matches.planes.offsets.shape == (0,)


def both():
    return ScanMatches(
        one(match_lines, [5.0, 0.1, 0.3], line_group()),
        one(match_planes, [4.8, 0.1, 0.3], plane_group()),
    )


def test_renewed_matches_keep_their_shapes_and_measure_anew():
    shift = gtsam.Pose3(gtsam.Rot3(), np.array([0.05, -0.02, 0.0]))
    before, after = both(), rematched(both(), shift, CONFIG)
    np.testing.assert_array_equal(after.edges.directions, before.edges.directions)
    np.testing.assert_array_equal(after.planes.normals, before.planes.normals)
    np.testing.assert_allclose(after.edges.distances, [np.hypot(0.05, 0.08)], atol=1e-9)
    np.testing.assert_allclose(np.abs(after.planes.distances), [0.15], atol=1e-9)
    np.testing.assert_allclose(after.edges.weights, 1 - 0.9 * after.edges.distances)
    reach = np.linalg.norm([4.8, 0.1, 0.3])
    np.testing.assert_allclose(after.planes.weights, [1 - 0.9 * 0.15 / np.sqrt(reach)], atol=1e-9)


def test_a_renewed_match_that_is_too_far_is_dropped():
    far = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 1.0, 0.0]))
    after = rematched(both(), far, CONFIG)
    assert (len(after.edges), len(after.planes)) == (0, 1)
    away = gtsam.Pose3(gtsam.Rot3(), np.array([5.0, 0.0, 0.0]))
    assert len(rematched(both(), away, CONFIG)) == 0
