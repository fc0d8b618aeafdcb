"""Fixes of a GNSS receiver in the adjustment of one run, and of two."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from support.receiver import ORIGIN, SURVEY, SURVEY_SIGMA, off_in_enu, surveyed_parts
from support.ties import check_gradient

from loam_gtsam.aiding.placed_fixes import PlacedFixes
from loam_gtsam.datasets.decode.geodesy import GeoReference
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.maps.map_file import SavedMap, save_map
from loam_gtsam.maps.merging import MergedMaps, merge_maps
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.refine.rounds import Settings
from loam_gtsam.refine.runs import RefinedRun, RunPoints, refine_run, refine_runs, run_points
from loam_gtsam.refine.ties import FixTies, Survey
from loam_gtsam.types import FloatArray, InputError

CUTS = (0, 35), (25, 60)


@dataclass
class Surveyed:
    """Two parts of a drive through rooms, with fixes of 2 cm."""

    world: SimulatedWorld
    runs: list[RunResult]
    points: list[RunPoints]
    surveys: list[Survey]
    merged: MergedMaps

    def refined(self, survey: Survey | None, **more) -> RefinedRun:
        done = self.runs[0]
        way = done.trajectory
        return refine_run(self.points[0], done.updates, trajectory=way, survey=survey, **more)

    def off(self, found: RefinedRun) -> FloatArray:
        """(N, 3) metres east, north and up from where the lidar was."""
        way = found.trajectory
        return off_in_enu(self.world.truth, way.stamps, way.positions, found.earth)


def survey_of(graph, earth: GeoReference | None, up: FloatArray | None = None) -> Survey:
    assert earth is not None
    return Survey(graph.fixes, np.array([place.stamp for place in graph.places]), earth, up)


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory) -> Surveyed:
    world = SimulatedWorld("rooms", frames=CUTS[-1][-1], columns=300, speed=3.0, seed=2)
    folder, runs, points, maps = tmp_path_factory.mktemp("surveyed"), [], [], []
    for number, drive in enumerate(surveyed_parts(world, list(world), CUTS)):
        runs.append(run(drive, SURVEY))
        points.append(run_points(drive, runs[-1].updates, runs[-1].config, most=1000))
        save_map(folder / f"{number}.lgmap", runs[-1].pipeline)
        maps.append(SavedMap(folder / f"{number}.lgmap"))
    surveys = [survey_of(saved.graph, saved.frame.earth, saved.frame.up) for saved in maps]
    return Surveyed(world, runs, points, surveys, merge_maps(maps, folder / "both.lgmap"))


@pytest.fixture(scope="module")
def refined(surveyed) -> RefinedRun:
    return surveyed.refined(surveyed.surveys[0])


def test_a_refined_run_is_where_its_fixes_have_it(surveyed, refined) -> None:
    off = surveyed.off(refined)
    assert np.linalg.norm(off, axis=1).mean() < 0.025
    earth = refined.earth.covariance
    assert (np.linalg.eigvalsh(earth) > 0.0).all()
    at_start = refined.earth.enu_T_map[:3, :3] @ earth[3:, 3:] @ refined.earth.enu_T_map[:3, :3].T
    assert off[0] @ np.linalg.solve(at_start, off[0]) < 11.3  # of chi squared, 1 % exceed it
    first = surveyed.runs[0].trajectory.map_T_lidar[0]
    np.testing.assert_allclose(refined.trajectory.map_T_lidar[0], first, atol=0.01)


def test_fixes_that_say_otherwise_bend_what_planes_leave_open(surveyed, refined) -> None:
    """As if the way were 1 % longer: planes of one range noise hold it, fixes of 1 mm do not."""
    given = surveyed.surveys[0]
    enu = 1.01 * given.fixes.enu

    def length(sigma: float) -> float:
        fixes = replace(
            given.fixes, enu=enu, covariances=np.tile(sigma**2 * np.eye(3), (len(enu), 1, 1))
        )
        found = surveyed.refined(replace(given, fixes=fixes))
        return found.trajectory.path_length / refined.trajectory.path_length - 1.0

    assert abs(length(10.0)) < 3e-4
    assert length(1e-3) > 5e-3


def test_fixes_worse_than_they_say_make_the_place_on_the_earth_less_sure(surveyed, refined) -> None:
    given = surveyed.surveys[0]
    noise = np.random.default_rng(1).normal(0.0, 10.0 * SURVEY_SIGMA, given.fixes.enu.shape)
    worse = replace(given, fixes=replace(given.fixes, enu=given.fixes.enu + noise))
    found = surveyed.refined(worse)
    ratio = np.trace(found.earth.covariance[3:, 3:]) / np.trace(refined.earth.covariance[3:, 3:])
    assert 10.0 < ratio < 300.0  # 100 but for chance


def test_two_runs_with_fixes_have_one_place_on_the_earth(surveyed) -> None:
    merged = surveyed.merged
    updates = [done.updates for done in surveyed.runs]
    ways = [merged.trajectory(n, of) for n, of in enumerate(updates)]
    survey = survey_of(merged.graph, merged.earth)
    found = refine_runs(
        surveyed.points, updates, ways,
        graph=merged.graph.saved(), survey=survey, starts=merged.starts,
    )  # fmt: skip
    for one in found:
        assert one.earth is found[0].earth
        assert np.linalg.norm(surveyed.off(one), axis=1).mean() < 0.025


def test_in_windows_the_fixes_hold_the_whole(surveyed, refined) -> None:
    found = surveyed.refined(surveyed.surveys[0], settings=Settings(whole=20))
    between = gtsam.Pose3(found.earth.enu_T_map).range(gtsam.Pose3(refined.earth.enu_T_map))
    assert between < 0.01
    assert np.linalg.norm(surveyed.off(found), axis=1).mean() < 0.025


@pytest.mark.parametrize("there", [False, True])
def test_without_a_fix_on_a_frame_nothing_is_on_the_earth(surveyed, there) -> None:
    given = surveyed.surveys[0]
    elsewhere = replace(given, stamps=given.stamps + 1) if there else None
    found = surveyed.refined(elsewhere, settings=Settings(rounds=1))
    assert found.earth is None


def test_fixes_that_tell_nothing_are_refused(surveyed) -> None:
    given = surveyed.surveys[0]
    with pytest.raises(InputError, match="expected fixes on the 3 places"):
        replace(given, stamps=given.stamps[:3])
    wild = replace(given.fixes, enu=1e200 * given.fixes.enu)
    for fixes in (given.fixes.of(np.array([2])), given.fixes.of(np.array([2, 2])), wild):
        with pytest.raises(InputError, match=r"do not tell where the map is|finite numbers"):
            surveyed.refined(replace(given, fixes=fixes))


def ties(up: FloatArray | None, count: int = 6) -> tuple[FixTies, FloatArray]:
    """Fixes of two receivers on some of ten poses, far from where anything is zero."""
    rng = np.random.default_rng(3)
    tangents = rng.normal(0.0, [0.4, 0.4, 2.0, 9.0, 9.0, 1.0], (10, 6))
    poses = np.array([gtsam.Pose3.Expmap(one).matrix() for one in tangents])
    moves = [gtsam.Pose3.Expmap(rng.normal(0.0, 0.1, 6)).matrix() for _ in range(count)]
    numbers = np.sort(rng.integers(0, 10, count))
    enu_T_map = gtsam.Pose3(gtsam.Rot3.Ypr(2.0, 0.02, -0.03), np.array([40.0, -8.0, 3.0]))
    seen = enu_T_map.matrix() @ poses[numbers] @ np.array(moves)
    enu = seen[:, :3, 3] + rng.normal(0.0, 0.5, (count, 3))
    fixes = PlacedFixes(
        numbers, np.array(moves), enu,
        np.repeat(np.diag([0.1, 0.2, 0.5])[None], count, axis=0), np.arange(count) % 2,
        np.array([[0.3, -0.2, 0.9], [0.0, 0.5, 0.0]]), np.array([0.05, 0.2]),
    )  # fmt: skip
    return FixTies.of(fixes, GeoReference(ORIGIN, enu_T_map.matrix(), np.eye(6)), up), poses


@pytest.mark.parametrize("up", [None, np.array([0.0, 0.1, 1.0])])
def test_the_gradient_is_that_of_the_cost(up) -> None:
    check_gradient(*ties(up))


def test_poses_that_move_together_cost_nothing_but_their_lean() -> None:
    known, poses = ties(None)
    turned = gtsam.Pose3(gtsam.Rot3.Yaw(0.7), np.array([5.0, -3.0, 8.0])).matrix() @ poses
    assert known.cost(turned) == pytest.approx(known.cost(poses), rel=1e-6)
    information, _ = known.equations(poses)
    assert np.linalg.eigvalsh(information).min() > -1e-8 * np.abs(information).max()


def test_of_many_fixes_some_are_used_evenly_spread() -> None:
    known, _ = ties(None, 1000)
    assert len(known.fixes) == 200
    assert known.fixes.receivers.tolist() == [n % 2 for n in range(0, 1000, 5)]
