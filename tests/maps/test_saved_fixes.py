"""Fixes of a GNSS receiver in a saved map: they are there again, and hold what is merged."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from support.cli import loam
from support.receiver import SURVEY, SURVEY_SIGMA, off_in_enu, surveyed_parts

from loam_gtsam.aiding.placed_fixes import PlacedFixes
from loam_gtsam.datasets.decode.geodesy import GeoReference
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.datasets.truth import read_truth
from loam_gtsam.loops.places import Place
from loam_gtsam.maps.localizer import Localizer
from loam_gtsam.maps.map_file import MapFrame, SavedMap, save_map
from loam_gtsam.maps.map_graph import graph_arrays, graph_of_arrays
from loam_gtsam.maps.merging import merge_maps
from loam_gtsam.pipeline import run
from loam_gtsam.types import DatasetError, FloatArray, Scan

TOO_LONG = 1.005
CUTS = (0, 35), (25, 60)
ASIDE = np.array([2.0, 1.0, 0.0])


@dataclass
class Surveyed:
    """Two parts of a drive with ranges that are too long, which their fixes know."""

    world: SimulatedWorld
    sweeps: list[Scan]
    folder: Path

    def map(self, name: str) -> SavedMap:
        return SavedMap(self.folder / f"{name}.lgmap")

    def without_fixes(self, name: str = "second") -> SavedMap:
        saved = self.map(name)
        saved.graph, saved.frame = replace(saved.graph, fixes=None), MapFrame()
        return saved

    def of_another_receiver(self, times: float = 1.0) -> SavedMap:
        """One that is metres off all the time."""
        saved = self.map("second")
        fixes, earth = saved.graph.fixes, saved.frame.earth
        assert fixes is not None
        assert earth is not None
        aside = np.eye(4)
        aside[:3, 3] = times * ASIDE
        saved.graph = replace(saved.graph, fixes=replace(fixes, enu=fixes.enu + aside[:3, 3]))
        saved.frame = MapFrame(earth=replace(earth, enu_T_map=aside @ earth.enu_T_map))
        return saved

    def off(self, places: list[Place], earth: GeoReference | None) -> FloatArray:
        """(K, 3) metres east, north and up that places are from where they were."""
        middles = np.array([place.stamp for place in places]) + 50_000_000
        positions = np.array([place.map_T_middle.translation() for place in places])
        return off_in_enu(self.world.truth, middles, positions, earth)


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> Surveyed:
    world = SimulatedWorld("rooms", frames=CUTS[-1][-1], columns=300, speed=3.0, seed=1)
    sweeps = [replace(s, points=(TOO_LONG * s.points).astype(np.float32)) for s in world]
    made = Surveyed(world, sweeps, tmp_path_factory.mktemp("surveyed"))
    parts = surveyed_parts(world, sweeps, CUTS)
    for name, drive in zip(("first", "second"), parts, strict=True):
        save_map(made.folder / f"{name}.lgmap", run(drive, SURVEY).pipeline)
    return made


@pytest.fixture(scope="module")
def merged(surveyed: Surveyed) -> SavedMap:
    maps = [surveyed.map("first"), surveyed.map("second")]
    assert merge_maps(maps, surveyed.folder / "both.lgmap").ties[0, 1] >= 6
    return surveyed.map("both")


def test_fixes_are_in_the_file_and_seen_from_their_places(surveyed: Surveyed) -> None:
    saved = surveyed.map("first")
    fixes, earth = saved.graph.fixes, saved.frame.earth
    assert fixes is not None
    assert earth is not None
    values = fixes.start(gtsam.Pose3(earth.enu_T_map))
    for number, place in enumerate(saved.places):
        values.insert(gtsam.symbol("x", number), place.map_T_middle)
    away = fixes.residuals(values)
    assert len(fixes) > 5
    assert np.linalg.norm(away, axis=1).max() < 5.0 * SURVEY_SIGMA
    # The lidar at the fix is 50 ms before the middle of the sweep, at 3 m/s.
    moved = np.linalg.norm(fixes.pose_T_lidar[:, :3, 3], axis=1)
    assert 0.05 < np.median(moved) < 0.3


def test_what_is_merged_is_where_the_fixes_of_both_have_it(
    surveyed: Surveyed, merged: SavedMap
) -> None:
    off = np.linalg.norm(surveyed.off(merged.places, merged.frame.earth), axis=1)
    assert off.mean() < 0.03  # 0.051 without the fixes
    assert off.max() < 0.05
    assert merged.graph.fixes is not None
    assert len(merged.graph.fixes.antennas) == 2


def test_of_two_maps_one_may_have_fixes(surveyed: Surveyed, tmp_path: Path) -> None:
    without = surveyed.without_fixes("first")
    done = merge_maps([without, surveyed.map("second")], tmp_path / "both.lgmap")
    assert np.linalg.norm(surveyed.off(done.places(1), done.earth), axis=1).mean() < 0.05
    neither = [without, surveyed.without_fixes()]
    assert merge_maps(neither, tmp_path / "neither.lgmap").earth is None


def test_receivers_that_contradict_each_other_are_not_believed_to_millimetres(
    surveyed: Surveyed, tmp_path: Path
) -> None:
    maps = [surveyed.map("first"), surveyed.of_another_receiver()]
    done = merge_maps(maps, tmp_path / "both.lgmap")
    assert done.ties[0, 1] >= 6
    assert done.unused == 0
    off = surveyed.off(done.places(0), done.earth).mean(axis=0)
    assert np.linalg.norm(off) > 0.5
    assert done.earth is not None
    covariance = done.earth.covariance[3:, 3:]
    assert off @ np.linalg.solve(covariance, off) < 7.8  # of chi squared, 5 % exceed it
    maps[1] = surveyed.of_another_receiver(200.0)
    with pytest.raises(
        DatasetError, match=r"\.lgmap: its fixes lie \d+ m beside those of the other maps"
    ):
        merge_maps(maps, tmp_path / "none.lgmap")


def test_a_merged_map_keeps_its_fixes_when_it_is_merged_or_extended(
    surveyed: Surveyed, merged: SavedMap, tmp_path: Path
) -> None:
    again = merge_maps([merged, surveyed.map("second")], tmp_path / "again.lgmap")
    assert np.linalg.norm(surveyed.off(again.places(0), again.earth), axis=1).max() < 0.05
    assert again.graph.fixes is not None
    assert len(again.graph.fixes.antennas) == 3
    localizer = Localizer(surveyed.map("first"), extend=True)
    for sweep in surveyed.sweeps[24:44]:
        localizer.process(sweep)
    localizer.save(tmp_path / "more.lgmap")
    with SavedMap(tmp_path / "more.lgmap") as more, surveyed.map("first") as first:
        assert len(more.places) > len(first.places)
        assert more.graph.fixes is not None
        assert first.graph.fixes is not None
        np.testing.assert_array_equal(more.graph.fixes.enu, first.graph.fixes.enu)


@pytest.mark.parametrize("name", ["places", "receivers"])
def test_fixes_of_what_is_not_there_are_refused(surveyed: Surveyed, name: str) -> None:
    saved = surveyed.map("first")
    arrays = graph_arrays(saved.graph, saved.config.loops)
    again = graph_of_arrays(arrays)
    assert again.fixes is not None
    arrays[f"fixes/{name}"] = arrays[f"fixes/{name}"] + 1000
    with pytest.raises(ValueError, match=rf"fixes/{name}\.npy: expected numbers of the"):
        graph_of_arrays(arrays)


@pytest.mark.parametrize("name", ["covariances", "antenna_sigmas"])
def test_fixes_without_a_spread_are_refused(surveyed: Surveyed, name: str) -> None:
    saved = surveyed.map("first")
    arrays = graph_arrays(saved.graph, saved.config.loops)
    arrays[f"fixes/{name}"] = -arrays[f"fixes/{name}"]
    with pytest.raises(ValueError, match=r"expected variances above 0"):
        graph_of_arrays(arrays)


def test_an_offset_of_a_receiver_is_allowed_for_if_it_is_beyond_chance() -> None:
    rng = np.random.default_rng(0)
    count = 40
    true = np.cumsum(rng.normal(0.0, 1.0, (count, 3)), axis=0)
    fixes = PlacedFixes(
        np.arange(count), np.broadcast_to(np.eye(4), (count, 4, 4)),
        true + rng.normal(0.0, 0.1, (count, 3)), np.broadcast_to(0.01 * np.eye(3), (count, 3, 3)),
        np.repeat([0, 1], count // 2), np.zeros((2, 3)), np.full(2, 0.05),
    )  # fmt: skip
    values = fixes.start(gtsam.Pose3())
    for number, place in enumerate(true):
        values.insert(gtsam.symbol("x", number), gtsam.Pose3(gtsam.Rot3(), place))
    assert not fixes.offsets(values).any()
    aside = replace(fixes, enu=fixes.enu + np.where(fixes.receivers == 1, 0.5, 0.0)[:, None])
    wide = aside.allowing_for(aside.offsets(values)).covariances
    assert (wide[:20] == fixes.covariances[:20]).all()
    assert 0.5 < np.sqrt(wide[-1, 0, 0] / 20) < 1.0  # 0.87 m, shared by twenty


def test_the_command_says_where_the_whole_is(surveyed: Surveyed, tmp_path: Path) -> None:
    files = [surveyed.folder / f"{name}.lgmap" for name in ("first", "second")]
    done = loam("merge", *files, "--output", tmp_path / "out", "--no-plot")
    assert done.exit_code == 0, done.output
    with SavedMap(tmp_path / "out" / "map.lgmap") as whole:
        assert whole.frame.earth is not None
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert summary["enu"] == whole.frame.earth.as_dict()
        assert whole.graph.fixes is not None
        assert summary["fixes"] == len(whole.graph.fixes)
    for number in (1, 2):
        enu, own = (tmp_path / "out" / f"trajectory_{number}{kind}.tum" for kind in ("_enu", ""))
        assert enu.read_text().startswith("# origin: latitude ")
        assert enu.name in " ".join(done.output.split())
        assert len(read_truth(enu)) == len(read_truth(own))
