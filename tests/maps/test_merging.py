"""Maps that become one: tied by what they have in common, not bent by what only looks like it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from support.cli import loam
from support.quick import QUICK

from loam_gtsam.config import Config
from loam_gtsam.datasets.base import PartOf
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.io.run_files import write_npz
from loam_gtsam.loops.files import read_graph
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.maps.common_places import CommonPlaces, are_tied
from loam_gtsam.maps.localizer import Localizer
from loam_gtsam.maps.map_file import SavedMap, save_map
from loam_gtsam.maps.merging import merge_maps
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import DatasetError, InputError, Trajectory

CUTS = (0, 35), (25, 60)


@dataclass
class Halves:
    world: SimulatedWorld
    runs: list[RunResult]
    folders: list[Path]

    def maps(self) -> list[SavedMap]:
        return [SavedMap(folder / "map.lgmap") for folder in self.folders]


@pytest.fixture(scope="module")
def halves(tmp_path_factory) -> Halves:
    """A drive through rooms in two parts, as folders of runs."""
    world = SimulatedWorld("rooms", frames=CUTS[-1][-1], columns=300, speed=3.0, seed=1)
    config = Config().changed("pose_graph.keyframe_distance=0.5")
    runs, folders = [], []
    for start, end in CUTS:
        runs.append(run(PartOf(world, start, 1, None, None), config, max_frames=end - start))
        folders.append(tmp_path_factory.mktemp("half"))
        save_map(folders[-1] / "map.lgmap", runs[-1].pipeline)
        write_npz(folders[-1] / "run.npz", runs[-1].updates)
    return Halves(world, runs, folders)


@pytest.fixture(scope="module")
def merged(halves, tmp_path_factory):
    path = tmp_path_factory.mktemp("merged") / "both.lgmap"
    return merge_maps(halves.maps(), path), path


def ate(halves, merged):
    """Error of all poses of both parts, in one frame."""
    ways = [merged.trajectory(n, done.updates) for n, done in enumerate(halves.runs)]
    poses = np.concatenate([way.map_T_lidar for way in ways])
    stamps = np.concatenate([way.stamps for way in ways])
    order = np.argsort(stamps, kind="stable")
    return absolute_error(Trajectory(stamps[order], poses[order]), halves.world.truth).rmse


def test_two_parts_of_a_drive_are_as_right_as_one_drive(halves, merged):
    alone = [absolute_error(done.trajectory, halves.world.truth).rmse for done in halves.runs]
    assert merged[0].ties[0, 1] >= 6
    assert merged[0].unused == 0
    assert ate(halves, merged[0]) < 2.0 * max(alone)  # 5.6 mm, 1.8 and 2.9
    np.testing.assert_allclose(merged[0].trajectory(0, halves.runs[0].updates).map_T_lidar[0],
                               halves.runs[0].trajectory.map_T_lidar[0], atol=1e-4)  # fmt: skip


def test_the_whole_is_a_map_as_any_other(halves, merged):
    graph, path = merged[0].graph, merged[1]
    first, second = halves.maps()
    with SavedMap(path) as whole:
        assert len(whole.places) == len(first.places) + len(second.places)
        assert max(len(first), len(second)) < len(whole) < len(first) + len(second)
        assert [loop.later for loop in whole.graph.loops] == [loop.later for loop in graph.loops]
        for layer, cubes in whole.layers.items():
            for index in cubes:
                content = whole.cube(layer, index)
                assert np.isin(content.tags[:, 0], range(len(whole.places))).all()
        # What the second part alone has seen is where the first one's frame has it.
        localizer = Localizer(whole)
        updates = [localizer.process(halves.world.sweep(number)) for number in range(50, 56)]
        found = [update for update in updates if update.status.solved]
        true = halves.world.truth.at([u.stamp for u in found])
        start = halves.world.truth.map_T_lidar[0]
        began = halves.runs[0].trajectory.map_T_lidar[0]
        for update, pose in zip(found, true.map_T_lidar, strict=True):
            there = began @ np.linalg.inv(start) @ pose
            assert np.linalg.norm(update.map_T_lidar.translation() - there[:3, 3]) < 0.06
        assert found


def test_a_merged_map_can_be_merged_and_the_same_maps_make_the_same_file(halves, merged, tmp_path):
    merge_maps(halves.maps(), tmp_path / "again.lgmap")
    assert (tmp_path / "again.lgmap").read_bytes() == merged[1].read_bytes()
    with SavedMap(merged[1]) as whole:
        more = merge_maps([halves.maps()[1], whole], tmp_path / "more.lgmap")
    assert more.ties[0, 1] >= 6


class WithWrongLoops(CommonPlaces):
    """Finds more than there is: loops that agree with each other, half a metre beside."""

    count = 0

    def find(self, number):
        found = super().find(number)
        if not found or WithWrongLoops.count <= 0:
            return found
        WithWrongLoops.count -= 1
        home = self.places[number].map_T_middle
        aside = gtsam.Pose3(gtsam.Rot3(), home.rotation().unrotate(np.array([0.0, 0.5, 0.0])))
        wrong = found[0].earlier_T_later.compose(aside)
        return [*found, replace(found[0], earlier_T_later=wrong)]


def test_wrong_loops_do_not_bend_the_map(halves, merged, tmp_path, monkeypatch):
    monkeypatch.setattr("loam_gtsam.maps.merging.CommonPlaces", WithWrongLoops)
    WithWrongLoops.count = 2
    found = merge_maps(halves.maps(), tmp_path / "same.lgmap")
    assert WithWrongLoops.count == 0
    assert found.ties == merged[0].ties
    assert ate(halves, found) == ate(halves, merged[0])
    # As many as there are right ones: then nobody knows.
    WithWrongLoops.count = 99
    with pytest.raises(DatasetError, match=r"map\.lgmap: .* lead elsewhere"):
        merge_maps(halves.maps(), tmp_path / "none.lgmap")
    assert not (tmp_path / "none.lgmap").exists()


def test_where_loops_are_off_by_more_than_they_may_the_runs_have_walked(
    halves, merged, tmp_path, monkeypatch
):
    monkeypatch.setattr("loam_gtsam.maps.merging._LIKELY", 0.0)
    found = merge_maps(halves.maps(), tmp_path / "walked.lgmap")
    told = [np.trace(of.places(1)[-1].covariance[3:, 3:]) for of in (merged[0], found)]
    assert told[1] > 2.0 * told[0]
    assert ate(halves, found) < 2.0 * ate(halves, merged[0])


def test_a_place_that_has_a_twin_in_its_own_map_tells_nothing(halves, monkeypatch):
    common = CommonPlaces(halves.maps(), halves.runs[0].config)
    number = next(number for number in common.looked_for() if common.find(number))
    whole = CommonPlaces._alike

    def with_twin(self, place, others, tries):
        found = whole(self, place, others, tries)
        if len(others) and (self.map_of[others] < self.map_of[place]).all():
            return found
        loop = LoopClosure(int(number) + 1, place, gtsam.Pose3(), np.eye(6))
        aside = gtsam.Pose3(gtsam.Rot3(), np.array([20.0, 0.0, 0.0]))
        return [replace(loop, earlier_T_later=aside)]

    monkeypatch.setattr(CommonPlaces, "_alike", with_twin)
    assert common.find(number) == []


@pytest.mark.parametrize(
    ("agreeing", "otherwise", "tied"), [(4, 0, True), (3, 0, False), (6, 3, True), (6, 4, False)]
)
def test_maps_are_tied_by_loops_that_agree(agreeing, otherwise, tied):
    assert are_tied(agreeing, otherwise) is tied


def test_maps_without_a_common_place_are_not_merged(halves, tmp_path):
    first, path = halves.maps()[0], tmp_path / "park.lgmap"
    save_map(path, run(SimulatedWorld("park", frames=15, columns=300), QUICK).pipeline)
    saved = SavedMap(path)
    with pytest.raises(DatasetError, match=r"park\.lgmap: no place of it"):
        merge_maps([first, saved], tmp_path / "none.lgmap")
    with pytest.raises(InputError, match="two maps or more"):
        merge_maps([first], tmp_path / "none.lgmap")
    with pytest.raises(DatasetError, match=r"expected another map, got that of .*park\.lgmap"):
        merge_maps([first, saved, SavedMap(path)], tmp_path / "none.lgmap")
    saved.config = saved.config.changed("loops.rings=10")
    with pytest.raises(DatasetError, match=r"expected place descriptors as those"):
        merge_maps([first, saved], tmp_path / "none.lgmap")
    assert list(tmp_path.iterdir()) == [path]


def test_the_command_joins_folders_and_files(halves, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    alone = Path("alone.lgmap")
    alone.write_bytes((halves.folders[1] / "map.lgmap").read_bytes())
    done = loam("merge", halves.folders[0], alone, "--output", "out", "--no-plot")
    assert done.exit_code == 0, done.output
    assert "Written to out: map.lgmap, map.ply, trajectory_1.tum" in " ".join(done.output.split())
    rows = [len(Path(f"out/trajectory_{n}.tum").read_text().splitlines()) - 2 for n in (1, 2)]
    with SavedMap("out/map.lgmap") as whole, SavedMap(alone) as second:
        assert rows == [CUTS[0][1], len(second.places)]  # of a map alone those of its places
        assert len(read_graph("out/pose_graph.g2o").keys) == len(whole.places)
    missing = loam("merge", halves.folders[0], "nothing.lgmap")
    assert missing.exit_code == 1
    assert "there is no such file" in missing.output
