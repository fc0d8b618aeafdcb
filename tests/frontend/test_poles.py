"""Poles: found where they stand alone, and not where they do not."""

import numpy as np
import pytest

from loam_gtsam.config import Config, FeatureConfig
from loam_gtsam.datasets.sim.world import Scene, SimulatedWorld, Solids
from loam_gtsam.frontend.curvature import running_sums
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.frontend.poles import find_poles

STEP = np.deg2rad(0.2)


def ring(ranges, first=0.0):
    """(3, N) points of one level ring, one beam every 0.2 degrees; lost beams are NaN."""
    angle = first - STEP * np.arange(len(ranges))
    points = np.array([np.cos(angle), np.sin(angle), 0.0 * angle]) * ranges
    return points[:, np.isfinite(ranges)].astype(np.float32)


def found(points, depth=0.5, width=0.5, most=10, starts=None):
    bounds = np.array([0, points.shape[1]] if starts is None else starts)
    return find_poles(points, running_sums(points), bounds, depth, width, most)


def wall(count=200, metres=12.0):
    return np.full(count, metres)


def test_a_run_before_a_wall_is_one_pole_on_the_axis():
    ranges = wall()
    # A round pole of 0.1 m at 8 m: as a beam meets it.
    angle = STEP * (np.arange(200) - 100.0)
    across = 8.0 * np.sin(angle)
    met = np.abs(across) < 0.1
    ranges[met] = 8.0 * np.cos(angle[met]) - np.sqrt(0.01 - across[met] ** 2)
    poles = found(ring(ranges))
    assert len(poles) == 1
    assert (poles.first[0], poles.last[0]) == (np.flatnonzero(met)[0], np.flatnonzero(met)[-1])
    assert np.linalg.norm(poles.points[0]) == pytest.approx(8.0, abs=0.02)
    assert poles.depths[0] == pytest.approx(4.0, abs=0.15)
    assert np.array_equal(np.flatnonzero(poles.members(200)), np.flatnonzero(met))


@pytest.mark.parametrize(
    ("change", "count"),
    [
        ({}, 1),
        ({"depth": 4.5}, 0),  # it stands only 4 m before the wall
        ({"width": 0.1}, 0),  # five beams at 8 m are 0.14 m
        ({"most": 4}, 0),
    ],
)
def test_depth_width_and_number_decide(change, count):
    ranges = wall()
    ranges[100:105] = 8.0
    assert len(found(ring(ranges), **change)) == count


def test_a_hole_in_a_wall_and_a_step_are_no_poles():
    assert found(ring(wall())).points.shape == (0, 3)
    assert not found(ring(wall())).members(200).any()
    hole = wall()
    hole[100:105] = 15.0
    assert len(found(ring(hole))) == 0
    step = wall()
    step[:100] = 8.0
    assert len(found(ring(step))) == 0
    step[100:105] = 10.0  # nearer than one side only
    assert len(found(ring(step))) == 0


def test_before_the_sky_nothing_has_to_be_farther():
    ranges = np.full(200, np.nan)
    ranges[50:54], ranges[120:123] = 20.0, 30.0
    poles = found(ring(ranges))
    assert len(poles) == 2
    assert np.isinf(poles.depths).all()
    # The only thing on a ring: its end is followed by its start, a turn later.
    ranges[120:123] = np.nan
    assert len(found(ring(ranges))) == 1


def test_one_lost_beam_does_not_cut_a_wall_and_two_only_with_depth():
    lost = wall()
    lost[[60, 66, 67, 72]] = np.nan
    assert len(found(ring(lost))) == 0  # twelve metres on either side of every gap


@pytest.mark.parametrize(("lost", "count"), [(1, 0), (4, 0), (5, 1)])
def test_a_point_between_a_few_lost_beams_is_no_pole(lost, count):
    """By dropout, points of flat ground are alone; they are no thing that tells the motion."""
    ranges = wall()
    ranges[100 - lost : 100] = ranges[101 : 101 + lost] = np.nan
    assert len(found(ring(ranges))) == count
    ranges[100] = 8.0  # before the wall beyond the gap
    assert len(found(ring(ranges))) == 1


def test_rings_do_not_touch():
    ranges = wall()
    ranges[-3:] = 8.0
    both = np.concatenate([ring(ranges), ring(wall(metres=9.0))], axis=1)
    poles = found(both, starts=[0, 200, 400])
    # The three are cut from the next ring; their own ring goes on, a turn later, at its start.
    assert poles.members(400)[200:].sum() == 0


def scene():
    """Three poles of 6 cm on flat ground, at 6, 12 and 25 m."""
    poles = [[6.0, 0.0, 0.06, -1.0, 5.0], [0.0, 12.0, 0.06, -1.0, 5.0], [-25.0, 1.0, 0.06, -1, 5.0]]
    way = np.stack([0.0 * np.arange(6.0), 0.5 * np.arange(6.0)], axis=1)
    return Scene("poles", Solids(cylinders=np.array(poles)), way, False, 0.2, 1.5, (0, 0, 0, 0))


def near_poles(features, world, points):
    truth = world.world_T_start
    there = points @ truth[:3, :3].T + truth[:3, 3]
    gaps = np.linalg.norm(there[:, None, :2] - world.scene.solids.cylinders[None, :, :2], axis=2)
    return (gaps.min(axis=1) < 0.4) & (there[:, 2] > 0.2)


def test_poles_become_edges_near_their_axes_and_stay_out_of_the_planes():
    world = SimulatedWorld(scene(), frames=2)
    with_poles = extract_features(world[0], Config())
    without = extract_features(world[0], Config(features=FeatureConfig(post_depth=0.0)))
    on = near_poles(with_poles, world, with_poles.edges)
    assert on.sum() > 20
    assert on.sum() > 2 * near_poles(without, world, without.edges).sum()
    points = with_poles.edges[on] @ world.world_T_start[:3, :3].T + world.world_T_start[:3, 3]
    axes = world.scene.solids.cylinders[:, :2]
    off = np.linalg.norm(points[:, None, :2] - axes[None], axis=2).min(axis=1)
    assert np.median(off) < 0.03
    assert with_poles.edge_prominence[on].min() > 0.5
    assert near_poles(with_poles, world, with_poles.planes).sum() == 0
    assert with_poles.sharp.max(initial=-1) < len(with_poles.edges)


def begins(count, step):
    """Where so many posts begin, rad: 3 degrees apart, anywhere between two beams."""
    return np.deg2rad(3.0) * (np.arange(count) + 0.3) + step * np.random.default_rng(0).random(
        count
    )


def posts(widths, distances, step):
    """A ring, one beam every ``step``, that meets flat posts (``begins``); a wall is 300 m away."""
    beams = np.arange(int(np.deg2rad(3.0) * len(widths) / step) + 20) * step
    ranges = np.full(len(beams), 300.0)
    for begin, width, metres in zip(begins(len(widths), step), widths, distances, strict=True):
        ranges[(beams >= begin) & (beams < begin + width / metres)] = metres
    return ring_of(beams, ranges)


def ring_of(angle, ranges):
    return (np.array([np.cos(angle), np.sin(angle), 0.0 * angle]) * ranges).astype(np.float32)


def radii_of(poles, points):
    """How far poles lie behind the points of their runs, as radii of round ones."""
    means = [
        points[:, a : b + 1].mean(axis=1) for a, b in zip(poles.first, poles.last, strict=True)
    ]
    behind = np.linalg.norm(poles.points, axis=1) - np.linalg.norm(means, axis=1)
    return behind / (np.pi / 4.0)


@pytest.mark.parametrize("width", [0.12, 0.5])
def test_what_one_beam_met_is_as_wide_as_what_more_beams_met(width):
    step = np.deg2rad(0.4)
    near, far = width / (3.0 * step), 2.0 * width / step
    points = posts(np.full(160, width), np.repeat([near, far], [60, 100]), step)
    poles, points = found_in_two_rings(points)
    radii, single = radii_of(poles, points), poles.first == poles.last
    # Half of those far away are met, by one beam each.
    assert (np.count_nonzero(~single), np.count_nonzero(single)) == (
        120,
        pytest.approx(100, abs=30),
    )
    assert radii[~single].mean() == pytest.approx(0.5 * width, rel=0.15)
    assert radii[single].mean() == pytest.approx(0.5 * width, rel=0.15)  # not 1.0, the beams' gap


@pytest.mark.parametrize("beams", [0.4, 0.7, 1.3, 2.5, 4.0])
def test_the_place_of_a_pole_is_known_as_well_as_it_says(beams):
    """Of a wide one to the gap between two beams, of a thin one to its width."""
    count, step, width = 110, np.deg2rad(0.2), 0.2
    distances = np.where(np.arange(count) % 4, width / (beams * step), width / (3.3 * step))
    poles, _ = found_in_two_rings(posts(np.full(count, width), distances, step))
    middles = begins(count, step) + 0.5 * width / distances
    turned = np.arctan2(poles.points[:, 1], poles.points[:, 0]) % (2.0 * np.pi)
    post = np.abs(turned[:, None] - middles).argmin(axis=1)
    off = np.sin(turned - middles[post]) * np.linalg.norm(poles.points, axis=1)
    meant = post % 4 > 0
    assert meant.sum() > 30
    assert np.sqrt(np.mean((off / poles.sigmas)[meant] ** 2)) == pytest.approx(1.0, rel=0.5)


def found_in_two_rings(points):
    """Poles of a sweep whose second ring meets the same, a little higher; and its points."""
    both = np.hstack([points, points + np.float32([[0.0], [0.0], [0.05]])])
    return found_in_halves(both), both


def found_in_halves(both):
    """Poles of two rings with as many points."""
    count = both.shape[1] // 2
    return found(both, width=2.0, starts=[0, count, 2 * count])


def test_drops_of_rain_do_not_tell_how_wide_posts_are():
    step, width = np.deg2rad(0.4), 0.25
    distances = np.repeat([width / (1.3 * step), width / (0.7 * step)], [40, 120])
    points = posts(np.full(160, width), distances, step)
    dry, both = found_in_two_rings(points)
    rng, ranges = np.random.default_rng(0), np.linalg.norm(both, axis=0)
    drops = (rng.random(len(ranges)) < 0.1) & (ranges > 250.0)
    wet = np.float32(both * np.where(drops, rng.uniform(2.0, 100.0, len(ranges)) / ranges, 1.0))
    poles = found_in_halves(wet)
    of_posts = np.isin(poles.first, dry.first)
    assert np.count_nonzero(~of_posts) > 150
    still = np.isin(dry.first, poles.first)
    radii = radii_of(poles, wet)[of_posts].mean()
    assert radii == pytest.approx(radii_of(dry, both)[still].mean(), rel=0.05)  # else 0.8


def test_beams_in_one_direction_have_no_width():
    ranges = np.where(np.arange(40) % 4, 10.0, 20.0)
    points = (np.array([[1.0], [0.0], [0.0]]) * ranges).astype(np.float32)
    assert np.isfinite(found(points, width=2.0).points).all()


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_things_near_by_that_one_beam_met_tell_of_the_widths_too(share):
    # Two beams have met what is 1.3 beams wide in three of ten cases: those alone are two wide.
    step, width = np.deg2rad(0.8), 0.1
    near, far = width / (1.3 * step), 6.0 * width / step
    distances = np.repeat([near, far], [round(400 * share), round(400 * (1 - share))])
    points = posts(np.full(400, width), distances, step)
    poles, points = found_in_two_rings(points)
    radii, away = radii_of(poles, points), np.linalg.norm(poles.points, axis=1) > 2.0 * near
    assert np.count_nonzero(away) > 10
    assert radii[~away].mean() == pytest.approx(0.5 * width, rel=0.2)
    assert radii[away].mean() == pytest.approx(0.5 * width, rel=0.3)


@pytest.mark.parametrize(("degrees", "is_pole"), [(90.0, True), (50.0, True), (20.0, False)])
def test_a_run_that_is_deeper_than_wide_is_no_pole(degrees, is_pole):
    step, metres, turned = np.deg2rad(0.4), 10.0, np.deg2rad(degrees)
    angle = np.arange(-30, 31) * step
    # A board of 0.5 m across, turned out of the ring's way.
    ranges = metres * np.sin(turned) / np.sin(turned - angle)
    ranges[np.abs(ranges * np.sin(angle)) > 0.25] = 60.0
    assert len(found(ring_of(angle, ranges), width=2.0)) == is_pole


def test_without_others_what_one_beam_met_is_rather_thin():
    step = np.deg2rad(0.4)
    for begin in np.linspace(0.0, 1.0, 20):  # until a beam meets it
        angle = np.arange(60) * step
        ranges = np.full(60, 60.0)
        start = (30.0 + begin) * step
        ranges[(angle >= start) & (angle < start + 0.12 / 40.0)] = 40.0
        points = ring_of(angle, ranges)
        if len(poles := found(points, width=2.0)):
            break
    apart = 2.0 * 40.0 * np.sin(0.5 * step)
    # The mean of widths as frequent as 1 / x^2 from 5 cm on, by a sum over a finer grid; the first
    # of the coarse one's cells begins before 5 cm.
    x = np.geomspace(0.05 / np.sqrt(1.08), 0.05 * 1.08**57.5, 4000)
    chance = np.maximum(0.0, 1.0 - np.abs(x / apart - 1.0))
    mean = np.sum(chance) / np.sum(chance / x)
    assert 2.0 * radii_of(poles, points)[0] == pytest.approx(mean, rel=1e-3)
    assert mean < 0.7 * apart
