"""Localisation in a saved map: found, tracked, lost, carried away, and never found elsewhere."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from support.cli import loam
from support.list_dataset import ListDataset
from support.quick import begin_quickly
from support.rooms_map import FRAMES, Mapped, world
from support.worlds import OWN
from support.worlds import updates as made_up

from loam_gtsam.config import Config, preset
from loam_gtsam.datasets.base import PartOf
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.frontend.workers import extract
from loam_gtsam.geometry import inverse_pose, transform
from loam_gtsam.maps.first_fix import Candidate, PlaceSearch
from loam_gtsam.maps.hypotheses import SWEEPS, Hypothesis, Motion
from loam_gtsam.maps.localizer import Localizer, localise
from loam_gtsam.maps.map_file import LAYERS, MapFrame, SavedMap, save_map, write_map
from loam_gtsam.maps.map_graph import MapGraph
from loam_gtsam.maps.merging import merge_maps
from loam_gtsam.maps.saved_maps import SavedMaps
from loam_gtsam.pipeline import Pipeline, run
from loam_gtsam.registration.relocalization import Field, Fit
from loam_gtsam.registration.relocalization.evidence import Evidence
from loam_gtsam.types import (
    BadSweep,
    ConfigError,
    DatasetError,
    FrameStatus,
    InputError,
    MapUpdate,
    PartError,
)

NEAR = 0.06  # metres, of a pose in the map


def other_drive(mapped: Mapped):
    """The same way with other noise."""
    drive = world()
    drive._seed = 77
    return drive


def errors(mapped: Mapped, drive, updates):
    """(6,) tangents from solved poses to the true ones, in the frame of the map."""
    start = mapped.result.updates[0].map_T_lidar.matrix()
    map_T_world = start @ inverse_pose(mapped.world.world_T_start)
    true = dict(zip(drive.truth.stamps.tolist(), drive.truth.map_T_lidar, strict=True))
    poses = [gtsam.Pose3(map_T_world @ drive.world_T_start @ true[u.stamp]) for u in updates]
    return [u.map_T_lidar.localCoordinates(p) for u, p in zip(updates, poses, strict=True)]


def test_a_drive_is_found_and_tracked_with_the_maps_error_in_its_covariance(
    mapped, saved, tmp_path
):
    drive = other_drive(mapped)
    found = localise(drive, saved)
    assert found.fixes == 1
    statuses = [update.status for update in found.updates]
    assert set(statuses[:SWEEPS]) == {FrameStatus.LOST}
    assert set(statuses[SWEEPS:]) == {FrameStatus.OK}
    assert found.updates[SWEEPS].message == "found in the map"
    assert len(found.trajectory) == FRAMES - SWEEPS
    off = errors(mapped, drive, found.solved)
    assert max(np.linalg.norm(error[3:]) for error in off) < NEAR
    with_map, without = [], []
    for error, update in zip(off, found.solved, strict=True):
        with_map.append(error @ np.linalg.solve(update.covariance, error) / 6.0)
        without.append(error @ np.linalg.solve(update.uncertainty.own, error) / 6.0)
        assert np.linalg.eigvalsh(update.covariance - update.uncertainty.own)[0] > -1e-12
    assert np.mean(with_map) < 2.0
    assert np.mean(without) > 2.0  # what the map's error is left out of
    found.localizer.save(tmp_path / "same.lgmap")
    assert (tmp_path / "same.lgmap").read_bytes() == mapped.path.read_bytes()


def test_a_lidar_without_rings_is_found_in_the_map_of_one_with_rings(mapped, saved):
    drive = SimulatedWorld("rooms", seed=1, frames=10, sensor="mid360")
    found = localise(drive, saved, inside=True)
    assert found.fixes == 1
    assert len(found.solved) > 3
    assert max(np.linalg.norm(e[3:]) for e in errors(mapped, drive, found.solved)) < NEAR


@pytest.mark.parametrize(("first", "is_found"), [(6, False), (18, True)])
def test_a_narrow_view_is_not_found_in_a_room_that_looks_the_same(mapped, saved, first, is_found):
    """Rooms repeat, and the right pose need not be one of the three likeliest of a place."""
    drive = SimulatedWorld("rooms", seed=1, frames=first + SWEEPS + 1, sensor="avia")
    drive._seed = 2
    found = localise(PartOf(drive, first, 1), saved)
    assert found.fixes == is_found
    assert all(np.linalg.norm(e[3:]) < NEAR for e in errors(mapped, drive, found.solved))


def test_nothing_is_found_in_the_map_of_another_place(saved):
    found = localise(world("park", seed=3, frames=7), saved)
    assert (found.fixes, found.solved) == (0, [])
    assert {update.status for update in found.updates} == {FrameStatus.LOST}
    assert all(update.message.startswith("no fix: ") for update in found.updates)
    assert len(found.trajectory) == 0


def test_a_lidar_that_is_carried_away_is_found_again(mapped, saved):
    """From the end of the way back to its start, from one sweep to the next."""
    drive, localizer = other_drive(mapped), Localizer(saved)
    first = [localizer.process(drive.sweep(n)) for n in range(14, 29)]
    assert localizer.fixed
    assert localizer.fixes == 1
    sweeps = [drive.sweep(n) for n in range(8)]
    shift = first[-1].stamp + 100_000_000 - sweeps[0].stamp
    second = [localizer.process(replace(sweep, stamp=sweep.stamp + shift)) for sweep in sweeps]
    # A place near by that fits might be another that looks the same: the whole map is asked.
    assert [update.status for update in second[:SWEEPS]] == [FrameStatus.LOST] * SWEEPS
    assert localizer.fixes == 2
    pairs = zip(second, sweeps, strict=True)
    solved = [replace(u, stamp=s.stamp) for u, s in pairs if u.status.solved]
    off = [np.linalg.norm(error[3:]) for error in errors(mapped, drive, solved)]
    assert max(off) < 2 * NEAR  # whose motion within the sweep nobody knows at first
    assert off[-1] < NEAR
    assert second[-1].status is FrameStatus.OK


def test_a_lidar_that_is_carried_into_the_map_while_it_is_looked_for_is_found(mapped, saved):
    outside, drive = world("park", seed=3, frames=6), other_drive(mapped)
    localizer = Localizer(saved)
    before = [localizer.process(sweep) for sweep in outside]
    shift = before[-1].stamp + 100_000_000 - drive.sweep(0).stamp
    sweeps = [drive.sweep(number) for number in range(8)]
    after = [localizer.process(replace(sweep, stamp=sweep.stamp + shift)) for sweep in sweeps]
    assert {update.status for update in before} == {FrameStatus.LOST}
    assert after[-1].status is FrameStatus.OK
    off = errors(mapped, drive, [replace(after[-1], stamp=sweeps[-1].stamp)])
    assert np.linalg.norm(off[0][3:]) < NEAR


@pytest.mark.parametrize(
    ("sigma", "carried", "reach"), [(0.01, 0, 1.0), (1.0, 0, 4.0), (0.01, 15, None)]
)
def test_a_place_to_which_no_motion_leads_only_looks_the_same(mapped, saved, sigma, carried, reach):
    """As long as the sweeps fit each other; within three standard deviations more than 1.5 m."""
    drive = other_drive(mapped)
    sweeps = [extract(drive.sweep(n), saved.config).features for n in range(14, 18)]
    known = MapUpdate(
        sweeps[2].stamp, gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([30.0, 5.0, 0.0])),
        FrameStatus.OK, covariance=sigma**2 * np.diag([0, 0, 0, 1.0, 1.0, 1.0]),
    )  # fmt: skip
    motion = Motion(saved.config)
    motion.begin(sweeps, known)
    features = extract(drive.sweep(18 - carried), saved.config).features
    motion.register(replace(features, stamp=sweeps[-1].stamp + 100_000_000))
    true = [gtsam.Pose3(drive.truth.map_T_lidar[n]) for n in (16, 18)]
    here = known.map_T_lidar.compose(true[0].between(true[1]))
    assert motion.leads_to(here)
    for metres in (1.0, 4.0, 5.0):
        aside = here.compose(gtsam.Pose3(gtsam.Rot3(), np.array([metres, 0.0, 0.0])))
        assert motion.leads_to(aside) == (reach is None or metres <= reach)
    assert (motion.map_T_lidar is None) == (reach is None)
    assert reach is None or motion.map_T_lidar.equals(here, NEAR)


def test_that_motion_is_known_for_as_long_as_it_drifts_by_less_than_places_are_apart(mapped, saved):
    """75 metres, if it drifts by 2 %."""
    features = [extract(mapped.world.sweep(n), saved.config).features for n in range(14, 18)]
    known = MapUpdate(features[0].stamp, gtsam.Pose3(), FrameStatus.OK, covariance=np.eye(6) * 1e-4)
    for share in (0.02, 20.0):
        motion = Motion(saved.config.changed({"loops.gate_drift": share}))
        motion.begin(features, known)
        assert (motion.map_T_lidar is None) == (share > 1.0)  # of 0.2 m


@pytest.mark.parametrize(
    ("sigma", "status", "extend", "asked"),
    [
        (0.4, FrameStatus.OK, False, False),
        (0.6, FrameStatus.OK, False, True),
        (0.6, FrameStatus.DEGENERATE, False, False),
        (0.6, FrameStatus.OK, True, False),  # new ground has led there
    ],
)
def test_the_whole_map_is_asked_where_a_pose_was_open_by_more_than_places_are_apart(
    saved, sigma, status, extend, asked
):
    localizer = Localizer(saved, extend=extend)
    spread = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, sigma**2])
    localizer._last = MapUpdate(0, gtsam.Pose3(), FrameStatus.DEGENERATE, covariance=spread)
    now = MapUpdate(100_000_000, gtsam.Pose3(), status, covariance=1e-4 * np.eye(6))
    assert localizer._given_up(now) == asked


def test_sweeps_that_cannot_be_used_cost_no_fix_and_a_reset_forgets(mapped, saved):
    drive, localizer = other_drive(mapped), Localizer(saved)
    none = localizer.process(BadSweep(drive.sweep(0).stamp - 1, "torn"))
    assert (none.status, none.message) == (FrameStatus.UNUSABLE_SCAN, "torn")
    first = [localizer.process(drive.sweep(n)) for n in range(8)]
    assert first[-1].status.solved
    bad = localizer.process(BadSweep(drive.sweep(8).stamp, "torn"))
    assert bad.status is FrameStatus.UNUSABLE_SCAN
    assert localizer.process(drive.sweep(9)).status.solved
    localizer.reset()
    assert not localizer.fixed
    again = [localizer.process(drive.sweep(n)) for n in range(8)]
    for one, other in zip(first, again, strict=True):
        assert one.map_T_lidar.equals(other.map_T_lidar, 0.0)


def test_what_no_sweep_saw_counts_until_some_in_a_row_have_seen_it(saved):
    localizer = Localizer(saved)
    seen, unseen = FrameStatus.OK, FrameStatus.DEGENERATE
    statuses = [seen, unseen, seen, unseen, seen, seen, seen]
    poses = [gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * n, 0, 0])) for n in range(len(statuses))]
    drifted = []
    for update, status in zip(made_up(poses), statuses, strict=True):
        told = localizer._told(replace(update, status=status))
        from_map = update.map_T_lidar.inverse().AdjointMap()
        of_map = from_map @ localizer.map_covariance(update.map_T_lidar) @ from_map.T
        more = np.trace(told.covariance - OWN - of_map)
        assert more > -1e-12
        drifted.append(more > 1e-9)
    assert drifted == [False, True, True, True, True, True, False]


def test_what_a_hypothesis_has_drifted_until_the_fix_does_not_count(mapped, saved):
    """It has a mapper of its own, and may have been followed for long."""
    drive, localizer = other_drive(mapped), Localizer(saved)
    add = localizer._hypotheses.add

    def late(features, near):
        fix, why = add(features, near)
        if fix is not None:
            long_ago = {"blind": np.ones((6, 10)), "forgotten": np.full(10, 1e3)}
            fix = replace(fix, uncertainty=replace(fix.uncertainty, **long_ago))
        return fix, why

    localizer._hypotheses.add = late
    updates = [localizer.process(drive.sweep(n)) for n in range(SWEEPS + 1)]
    assert updates[-1].status is FrameStatus.OK
    update = localizer._tracking.process(drive.sweep(SWEEPS + 1))
    told = localizer._told(replace(update, status=FrameStatus.DEGENERATE))
    from_map = update.map_T_lidar.inverse().AdjointMap()
    of_map = from_map @ localizer.map_covariance(update.map_T_lidar) @ from_map.T
    np.testing.assert_allclose(told.covariance, update.uncertainty.own + of_map, atol=1e-12)


@pytest.mark.parametrize(("x", "number"), [(4.6, 1), (0.0, 0), (9.0, 2), (12.0, 2), (40.0, 3)])
def test_the_maps_error_is_that_of_the_first_visit_near_by(saved, x, number):
    """By its nearest place: 0, 4 and 8 m, then far away, then back beside the first ones."""

    def at(metres: float) -> gtsam.Pose3:
        return gtsam.Pose3(gtsam.Rot3(), np.array([metres, 0.0, 0.0]))

    places = [
        replace(saved.places[0], map_T_middle=at(metres), covariance=n * np.eye(6))
        for n, metres in enumerate([0.0, 4.0, 8.0, 50.0, 9.5, 4.5])
    ]
    saved.graph = replace(saved.graph, places=places)
    found = Localizer(saved).map_covariance(at(x))
    np.testing.assert_array_equal(found, number * np.eye(6))
    with pytest.raises(InputError, match=r"map_T_lidar: expected a gtsam.Pose3, got ndarray"):
        Localizer(saved).map_covariance(np.eye(4))


class Held:
    """A hypothesis with made-up fits."""

    def __init__(
        self, agreement, status=FrameStatus.OK, seen=100.0, count=SWEEPS, share=0.3, metres=0.01
    ):
        config = Pipeline().config
        self.held = Hypothesis.__new__(Hypothesis)
        self.held._config = config
        self.held.fits = [Fit(share, agreement)] * count
        told = {"localizability": np.full(6, seen), "covariance": metres**2 * np.eye(6)}
        self.held.last = MapUpdate(0, gtsam.Pose3(), status, **told)


@pytest.mark.parametrize(
    ("held", "below"),
    [
        (Held(0.95), 0.75),
        (Held(0.8), 0.5),
        (Held(0.7), 0.0),
        (Held(0.95, count=SWEEPS - 1), 0.0),
        (Held(0.95, FrameStatus.DEGENERATE), 0.0),
        (Held(0.95, seen=29.0), 0.0),
        (Held(0.95, seen=np.nan), 0.0),
        (Held(0.95, metres=0.6), 0.0),  # other places are within three of these
        (Held(0.95, metres=np.nan), 0.0),
    ],
)
def test_a_hypothesis_stands_if_it_fits_and_sees_all_directions(held, below):
    assert held.held.rivals_below() == below


def candidate(x: float, fit: float, agreeing: int) -> Candidate:
    """A pose with walls across the way from one such pose to another."""
    points, walls = np.zeros((100, 3)), np.tile([1.0, 0.0, 0.0], (100, 1))
    points[:, 0] = x
    signs = np.where(np.arange(100) < agreeing, 1.0, -5.0)
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0]))
    return Candidate(pose, Fit(fit, 1.0), Evidence(0, points, signs, walls))


@pytest.mark.parametrize(
    ("others", "far", "count", "inside"),
    [
        ([(50.0, 0.2, 60)], 0.75, 0, 0),
        ([(50.0, 0.25, 60)], 0.75, 1, 0),  # another place fits nearly as well
        ([(50.0, 0.2, 60)], 0.5, 1, 0),  # a changed place must stand out more
        ([(3.0, 0.2, 60)], 0.5, 0, 0),  # than another optimum near by
        ([(3.0, 0.25, 60)], 0.5, 1, 0),
        ([(50.0, 0.1, 100), (60.0, 0.1, 60)], 0.75, 1, 1),  # the sweep does not object
    ],
)
def test_a_fix_needs_that_no_other_place_may_be_right(saved, others, far, count, inside):
    found = [candidate(0.0, 0.3, 100), *(candidate(*other) for other in others)]
    here, places, maps = found[0].map_T_middle, saved.places, SavedMaps(saved.config, saved)
    search = PlaceSearch(places, maps, saved.config)
    assert len(search.rivals(here, found, far)) == count
    assert not search.refuted(here, found)
    surely = PlaceSearch(places, maps, saved.config, inside=True)
    assert len(surely.rivals(here, found, far)) == inside


def test_a_pose_is_given_up_if_the_sweep_speaks_against_it_or_is_not_found_there(saved):
    search = PlaceSearch(saved.places, SavedMaps(saved.config, saved), saved.config)
    found = [candidate(0.0, 0.3, 100), candidate(50.0, 0.2, 60)]
    assert search.refuted(found[1].map_T_middle, found)
    assert search.refuted(candidate(7.0, 0.3, 100).map_T_middle, found)
    assert len(search.rivals(candidate(7.0, 0.3, 100).map_T_middle, found, 0.75)) == 2


def test_places_are_looked_at_once_and_a_pose_beyond_the_map_harms_no_search(
    mapped, saved, monkeypatch
):
    made, around = [], Field.around
    monkeypatch.setattr(Field, "around", lambda *args: made.append(args) or around(*args))
    features = extract(mapped.world.sweep(10), saved.config).features
    posed = MovingSweep(features, saved.config).at(np.zeros(6))
    search = PlaceSearch(saved.places, SavedMaps(saved.config, saved), saved.config)
    first = search.find(posed, features.reach)
    looked = len(made)
    assert first
    assert looked
    again = search.find(posed, features.reach)
    assert len(made) == looked
    beyond = gtsam.Pose3(gtsam.Rot3(), np.array([2000.0, 0.0, 0.0]))
    with_it = search.find(posed, features.reach, [beyond])
    assert len(made) == looked + 1
    for other in (again, with_it):
        assert first[0].map_T_middle.equals(other[0].map_T_middle, 0.0)


def test_where_bays_repeat_a_lidar_is_found_if_it_is_surely_in_the_map_or_its_place_is_said(
    tmp_path, monkeypatch
):
    """Another storey would look the same but for what is parked there."""
    begin_quickly(monkeypatch)
    monday = SimulatedWorld("garage", seed=1, frames=50, columns=600)
    mapped = run(monday)
    save_map(tmp_path / "garage.lgmap", mapped.pipeline)
    tuesday = SimulatedWorld("garage", seed=1, frames=50, columns=600, range_noise=0.03)
    drive = PartOf(tuesday, 30, 1, None, None)
    with SavedMap(tmp_path / "garage.lgmap") as saved:
        assert not localise(drive, saved, max_frames=6).fixes
        x, y, z = mapped.updates[30].map_T_lidar.translation()
        found = [
            localise(drive, saved, max_frames=6, inside=True),
            localise(drive, saved, max_frames=6, near=(x - 3.0, y + 3.0)),
        ]
        assert not localise(drive, saved, max_frames=6, near=(x - 12.0, y, z)).fixes
    true = dict(zip(monday.truth.stamps.tolist(), monday.truth.map_T_lidar, strict=True))
    start = mapped.updates[0].map_T_lidar
    for one in found:
        assert one.fixes == 1
        off = [u.map_T_lidar.range(start.compose(gtsam.Pose3(true[u.stamp]))) for u in one.solved]
        assert max(off) < NEAR


@pytest.mark.parametrize(
    ("near", "expected"),
    [
        ((900.0, 0.0), r"near: expected a position in the frame of .* got \[900.0, 0.0\], 8"),
        ((0.0, 0.0, 40.0), "within 16 m of the way of its run"),
        ((1.0,), r"near: expected \(3,\) numbers, got shape \(1,\)"),
        ((np.nan, 0.0), "near: .*finite"),
    ],
)
def test_a_place_that_is_said_must_be_in_the_map(saved, near, expected):
    localizer = Localizer(saved)
    with pytest.raises(InputError, match=expected):
        localizer.reset(near)


def test_a_map_is_extended_by_what_it_does_not_have(mapped, tmp_path, monkeypatch):
    """The first third of a drive is mapped; a second drive adds the rest."""
    begin_quickly(monkeypatch)
    short, long = tmp_path / "short.lgmap", tmp_path / "long.lgmap"
    result = run(PartOf(mapped.world, 0, 1, None, 1.0), mapped.result.config)
    save_map(short, result.pipeline)
    drive = other_drive(mapped)
    with SavedMap(short) as saved:
        found = localise(drive, saved, extend=True)
        found.localizer.save(long)
        with SavedMap(long) as larger:
            assert len(larger) > 1.2 * len(saved)
            for layer, cubes in saved.layers.items():
                for index in cubes:
                    old = {tuple(row) for row in saved.cube(layer, index).points.tolist()}
                    new = {tuple(row) for row in larger.cube(layer, index).points.tolist()}
                    assert old <= new  # no point is moved or lost
            assert len(larger.places) > len(saved.places)
            added = larger.places[len(saved.places) :]
            ends = [link.later for link in larger.graph.links]
            assert ends == list(range(1, len(larger.places)))  # each hangs on an earlier one
            owners = {
                int(owner)
                for layer, cubes in larger.layers.items()
                for index in cubes
                for owner in np.unique(larger.cube(layer, index).tags[:, 0])
            }
            assert max(owners) in range(len(saved.places), len(larger.places))
            for place in added:
                here = place.map_T_middle.inverse().AdjointMap()
                errors_of = [here @ p.covariance @ here.T for p in (saved.places[-1], place)]
                assert np.trace(errors_of[1]) >= np.trace(errors_of[0])
            last = Localizer(larger)
            updates = [last.process(drive.sweep(n)) for n in range(FRAMES - 6, FRAMES)]
    off = errors(mapped, drive, [*found.solved, *(u for u in updates if u.status.solved)])
    assert max(np.linalg.norm(error[3:]) for error in off) < NEAR
    assert updates[-1].status is FrameStatus.OK


def test_the_classical_systems_track_too_from_a_fix_of_the_default_solver(mapped, saved):
    """Which do not tell the directions that are seen."""
    config = preset("aloam").changed(imu=saved.config.imu.changed(coupling="off"))
    found = localise(PartOf(other_drive(mapped), 0, 1, None, 0.55), saved, config)
    assert found.fixes == 1
    assert found.config.solver.method == "aloam"
    off = errors(mapped, other_drive(mapped), found.solved)
    assert max(np.linalg.norm(error[3:]) for error in off) < NEAR


def test_an_error_keeps_what_was_localised_and_a_part_that_raises_costs_its_sweep(mapped, saved):
    drive = other_drive(mapped)
    sweeps = [drive.sweep(n) for n in range(3)]
    broken = ListDataset([*sweeps, DatasetError("disk gone")])
    with pytest.raises(DatasetError, match="disk gone"):
        localise(broken, saved)
    found = localise(broken, saved, keep_partial=True)
    assert len(found.updates) == 3
    assert isinstance(found.error, DatasetError)

    def features(scan):
        if scan is sweeps[1]:
            raise ValueError("mine")
        return extract_features(scan, saved.config)

    config = Localizer(saved).config
    with pytest.raises(PartError, match="mine"):
        localise(ListDataset(sweeps), saved, config, features=features)
    lenient = Localizer(saved, config.changed("parts.on_error=continue"), features=features)
    faulty = [lenient.process(sweep).status for sweep in sweeps]
    assert faulty == [FrameStatus.LOST, FrameStatus.UNUSABLE_SCAN, FrameStatus.LOST]


def test_parts_that_do_not_go_together_are_refused_at_once(mapped, saved):
    config = preset("loam").changed("imu.prior=sigma")
    with pytest.raises(ConfigError, match=r"imu\.prior"):
        localise(mapped.world, saved, config)


def test_a_loop_closer_has_nothing_to_close_in_a_map(saved):
    with pytest.raises(InputError, match="loop_closer: no loops are closed in a map"):
        Localizer(saved, loop_closer=object())


def test_a_map_without_places_is_refused(tmp_path):
    """As that of a run of which no frame was sure; it can be opened, for its points."""
    path = tmp_path / "none.lgmap"
    config, points = Config(), {layer: {} for layer in LAYERS}
    write_map(path, points, MapGraph([], [], []), config, MapFrame())
    with SavedMap(path) as nowhere, pytest.raises(InputError, match="no places"):
        Localizer(nowhere)


def test_the_command_localises_in_the_map_that_a_run_wrote(mapped, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = "sim:rooms?seed=1&frames=10&columns=450"
    done = loam("localise", spec, mapped.path, "--output", "out", "--no-plot", "--extend")
    assert done.exit_code == 0, done.output
    assert "found 1 times" in done.output
    summary = json.loads(Path("out/summary.json").read_text())
    assert (summary["frames"], summary["fixes"], summary["first_fix_frame"]) == (10, 1, SWEEPS)
    assert len(Path("out/trajectory_covariance.csv").read_text().splitlines()) == 11 - SWEEPS
    with SavedMap("out/map.lgmap") as larger, SavedMap(mapped.path) as saved:
        assert len(larger) >= len(saved)
    elsewhere = loam("localise", "sim:park?frames=5&columns=450", mapped.path, "--output", "no",
                     "--no-plot", "--quiet")  # fmt: skip
    assert elsewhere.exit_code == 1
    assert "no fix" in elsewhere.output
    no_place = loam("localise", spec, mapped.path, "--near", "1,2,3,4")
    assert no_place.exit_code == 2
    assert "--near: expected metres X,Y or X,Y,Z, got '1,2,3,4'" in no_place.output
    missing = loam("localise", spec, "nothing.lgmap")
    assert missing.exit_code == 1
    assert "there is no such file" in missing.output


def test_a_path_is_no_map_and_nothing_no_pipeline():
    with pytest.raises(InputError, match="saved: expected a SavedMap, got str"):
        Localizer("map.lgmap")
    with pytest.raises(InputError, match=r"maps\[0\]: expected a SavedMap, got str"):
        merge_maps(["a.lgmap", "b.lgmap"], "whole.lgmap")
    with pytest.raises(InputError, match="pipeline: expected that of a run, got NoneType"):
        save_map("none.lgmap", None)


def test_what_is_gone_since_the_map_was_made_is_cleaned_out_of_the_larger_map(
    tmp_path, monkeypatch
):
    """Of a cupboard of the first day, the drive of the second day sees what was behind it."""
    begin_quickly(monkeypatch)
    monkeypatch.chdir(tmp_path)
    drive = world(frames=10)
    scene = drive.scene
    last = drive.world_T_start @ drive.truth.map_T_lidar[-1]
    cupboard = np.array([[*(last @ [2.0, 0.0, 0.0, 1.0])[:2], 0.75, 0.3, 0.3, 0.75, 0.0]])
    solids = replace(scene.solids, boxes=np.concatenate([scene.solids.boxes, cupboard]))
    before = SimulatedWorld(replace(scene, solids=solids), seed=1, frames=10, columns=600)
    first = run(before)
    save_map("before.lgmap", first.pipeline)
    spec = "sim:rooms?seed=1&frames=10&columns=600"
    for command in (("localise", spec, "before.lgmap", "--extend", "--output", "out"),
                    ("clean", spec, "out")):  # fmt: skip
        done = loam(*command, "--no-plot", "--quiet")
        assert done.exit_code == 0, done.output
    start = first.updates[0].map_T_lidar.matrix() @ inverse_pose(before.world_T_start)

    def points(path):
        with SavedMap(path) as saved:
            held = np.concatenate(saved.points())
        in_world = transform(inverse_pose(start), held)
        near = np.abs(in_world - cupboard[0, :3]) < cupboard[0, 3:6] + 0.1
        stood = near.all(axis=1) & (in_world[:, 2] > 0.1)
        return int(stood.sum()), int((~stood).sum())

    was, now = points("out/map.lgmap"), points("out/cleaned/map.lgmap")
    assert was[0] > 15
    assert now[0] <= 0.1 * was[0]
    assert now[1] > 0.98 * was[1]


def test_a_map_stays_open_to_its_localizer(mapped):
    with SavedMap(mapped.path) as saved:
        assert Localizer(saved).config.map.cube_size == saved.config.map.cube_size
