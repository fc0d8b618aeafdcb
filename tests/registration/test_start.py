"""The first sweeps of a run: their motion is searched for, and they are registered together."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from loam_gtsam import Mapper
from loam_gtsam.config import Config
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.registration import start
from loam_gtsam.registration.matches import EdgeMatches, PlaneMatches, ScanMatches
from loam_gtsam.registration.relocalization import Fit
from loam_gtsam.registration.solvers import GtsamSolver
from loam_gtsam.types import FrameStatus

CONFIG = Config().changed("imu.coupling=off")


def features_of(scene, frames, **options):
    world = SimulatedWorld(scene, frames=frames, **{"columns": 600} | options)
    return world, [extract_features(scan, CONFIG) for scan in world]


def errors(world, updates):
    """Metres from the truth, of every pose."""
    truth = [gtsam.Pose3(pose) for pose in world.truth.map_T_lidar]
    return np.array([u.map_T_lidar.range(t) for u, t in zip(updates, truth, strict=False)])


@pytest.mark.parametrize("speed", [5.0, 20.0, 36.0])
def test_a_run_may_start_at_any_speed(speed):
    world, features = features_of("avenue", 9, speed=speed, start="moving")
    mapper = Mapper(CONFIG)
    updates = [mapper.register(one) for one in features]
    assert all(update.status.solved for update in updates[1:])
    assert errors(world, updates).max() < 0.2
    moved = np.linalg.norm(updates[1].twist[3:])
    assert moved == pytest.approx(np.linalg.norm(world.truth.map_T_lidar[1][:3, 3]) / 0.1, rel=0.05)


def test_sweeps_may_be_missing_between_the_first_two():
    world, features = features_of("avenue", 30, speed=10.0, start="moving")
    mapper = Mapper(CONFIG)
    updates = [mapper.register(one) for one in features[::5]]
    truth = world.truth.map_T_lidar[::5]
    far = [u.map_T_lidar.range(gtsam.Pose3(t)) for u, t in zip(updates, truth, strict=True)]
    assert max(far) < 0.3


def test_a_first_motion_that_was_not_found_is_that_of_the_second_step(monkeypatch):
    """With the second sweep, or with the third alone, 2.5 m behind where it was taken."""
    found = {}
    look_again = start.Start._as_the_second_step

    def from_behind(self, frame, sweeps, solver):
        behind = gtsam.Pose3(gtsam.Rot3(), np.array([-2.5, 0.0, 0.0]))
        for first in (1, 2):
            late = [
                replace(sweep, map_T_middle=behind.compose(sweep.map_T_middle))
                for sweep in sweeps[first:]
            ]
            given = [*sweeps[:first], *late]
            found[first] = given, look_again(self, frame, given, solver)
        found["true"] = sweeps
        return sweeps

    monkeypatch.setattr(start.Start, "_as_the_second_step", from_behind)
    _, features = features_of("avenue", 11, speed=10.0, start="moving")
    mapper = Mapper(CONFIG)
    for one in features[::5]:
        mapper.register(one)
    for sweep, true in zip(found[1][1], found["true"], strict=True):
        assert sweep.map_T_middle.range(true.map_T_middle) < 0.1
    assert found[2][1] is found[2][0]


@pytest.mark.parametrize(
    ("scene", "options"),
    [
        ("room", {}),
        # Nothing tells the places along a bare corridor or on a field apart: none beats rest.
        ("corridor_bare", {}),
        ("open_field", {}),
        # Between the rings of the first sweep, 4 m on, more of the road finds planes than on them.
        ("avenue", {"sensor": "hdl64", "seed": 2, "columns": 1000}),
        ("avenue", {"sensor": "hdl64", "seed": 4, "columns": 1000}),
    ],
)
def test_a_platform_at_rest_stays_where_it_is(scene, options):
    world, features = features_of(scene, 3, **options)
    mapper = Mapper(CONFIG)
    updates = [mapper.register(one) for one in features]
    assert errors(world, updates).max() < 0.1


@pytest.mark.parametrize(
    ("sigma", "way", "apart"),
    [(0.05, [3.0, 0.0, 0.0], True), (0.55, [3.0, 0.0, 0.0], False), (0.55, [0.0, 3.0, 0.0], True)],
)
def test_lines_that_are_found_at_any_place_do_not_tell_two_places_apart(sigma, way, apart):
    """Walls at both sides and the ground leave the way ahead to twelve poles."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-9.0, 9.0, (120, 3))
    normals = np.eye(3)[1 + np.arange(120) % 2]
    ones, none = np.ones(120), np.zeros(120)
    planes = PlaneMatches(points, normals, none, none, 0.05 * ones, ones, np.arange(120), none)
    poles, up = points[:12], np.tile([0.0, 0.0, 1.0], (12, 1))
    lines = EdgeMatches(
        poles, poles, up, none[:12], np.full(12, sigma), ones[:12], np.arange(12), none[:12]
    )
    here = SimpleNamespace(map_T_lidar=gtsam.Pose3(), matches=ScanMatches(lines, planes), weak=None)
    there = SimpleNamespace(map_T_lidar=gtsam.Pose3(gtsam.Rot3(), np.array(way)))
    tried, best = (SimpleNamespace(solution=solution) for solution in (here, there))
    assert start._told_apart(tried, best, CONFIG) == apart


def test_only_the_second_sweep_of_a_refined_start_is_searched_for(monkeypatch):
    asked = []
    monkeypatch.setattr(start, "likely_poses", lambda *_, **__: asked.append(1) or [])
    _, features = features_of("avenue", 4, speed=20.0, start="moving")
    for config, searches in ((CONFIG.changed("deskew.model=predicted"), 0), (CONFIG, 1)):
        mapper = Mapper(config)
        for one in features:
            mapper.register(one)
        assert len(asked) == searches


def test_places_that_few_matches_contradict_are_not_looked_at_closer(monkeypatch):
    _, features = features_of("square", 2, speed=24.0, start="moving")
    found, closer = [], []
    for share in (0.0, start._HOPEFUL, 1.0):
        monkeypatch.setattr(start, "_HOPEFUL", share)
        solver = Counting(CONFIG.solver)
        mapper = Mapper(CONFIG, solver=solver)
        found.append([mapper.register(one).map_T_lidar.matrix() for one in features])
        closer.append(solver.offered.count(max(solver.offered)))
    assert np.array_equal(*found[:2])
    assert closer[0] > closer[1] > closer[2]


class Counting(GtsamSolver):
    """Notes how many features each solve may match."""

    def __init__(self, config):
        super().__init__(config)
        self.offered = []

    def solve(self, associate, guess, priors=(), motion=None):
        self.offered.append(associate.offered)
        return super().solve(associate, guess, priors, motion)


def test_the_search_leaves_the_map_of_the_motion_that_it_chose(monkeypatch):
    """Every place that is tried makes the map anew; what follows must not match the last one."""
    shares = []

    def add(self, frame, found, *_):
        again = frame.matcher.moving_at(found.twist)(found.solution.map_T_lidar)
        shares.append([Fit.of(m, 1000).total for m in (found.solution.matches, again)])
        return frame, found

    monkeypatch.setattr(start.Start, "add", add)
    _, features = features_of("avenue", 2, speed=36.0, start="moving")
    mapper = Mapper(CONFIG)
    for one in features:
        mapper.register(one)
    ((chosen, again),) = shares
    assert again > 0.9 * chosen > 0.0


def test_a_good_guess_of_a_user_stays_and_a_bad_one_does_not():
    world, features = features_of("avenue", 2, speed=36.0, start="moving")
    truth = gtsam.Pose3(world.truth.map_T_lidar[1])
    for guess in (truth, gtsam.Pose3(gtsam.Rot3(), np.array([-3.0, 0.0, 0.0]))):
        mapper = Mapper(CONFIG)
        mapper.register(features[0])
        assert mapper.register(features[1], guess).map_T_lidar.range(truth) < 0.1


def test_the_map_is_made_anew_of_the_first_sweeps_and_then_left_alone():
    _, features = features_of("room", 11)
    mapper = Mapper(CONFIG.changed("map.small_below=0"))  # one pair of maps
    changed = []
    for one in features:
        before = mapper.maps.planes
        mapper.register(one)
        changed.append(mapper.maps.planes is not before)
    assert [number + 1 for number, anew in enumerate(changed) if anew] == [2, 3, 5, 8]


def test_the_first_pose_stays_and_the_start_becomes_better():
    world, features = features_of("park", 9)
    mapper = Mapper(CONFIG)
    updates = [mapper.register(one) for one in features]
    assert updates[0].status is FrameStatus.FIRST
    assert updates[0].map_T_lidar.equals(gtsam.Pose3(), 0.0)
    assert errors(world, updates)[-1] < 0.06


def test_after_a_reset_the_next_sweep_is_a_start_again():
    world, features = features_of("avenue", 4, speed=20.0, start="moving")
    mapper = Mapper(CONFIG)
    once = [mapper.register(one).map_T_lidar.matrix() for one in features]
    mapper.reset()
    again = [mapper.register(one).map_T_lidar.matrix() for one in features]
    assert np.array_equal(once, again)
    assert np.linalg.norm(once[-1][:3, 3]) > 0.9 * world.truth.path_length
