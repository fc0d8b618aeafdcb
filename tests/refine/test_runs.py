"""Several runs adjusted together: one frame, clocks of their own, wrong loops."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest

from loam_gtsam import Config, SimulatedWorld, Trajectory, run
from loam_gtsam.datasets.base import PartOf
from loam_gtsam.datasets.sim.scenes import BUILDERS
from loam_gtsam.loops.batch import SavedGraph
from loam_gtsam.loops.keyframes import noise_model
from loam_gtsam.maps.map_file import SavedMap, save_map
from loam_gtsam.maps.merging import MergedMaps, merge_maps
from loam_gtsam.pipeline import RunResult
from loam_gtsam.refine.rounds import Settings
from loam_gtsam.refine.runs import RefinedRun, RunPoints, refine_run, refine_runs, run_points
from loam_gtsam.refine.sweeps import Path
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import FloatArray, InputError

CUTS = (0, 35), (25, 60)
X = gtsam.symbol_shorthand.X


@dataclass
class Two:
    truth: Trajectory
    runs: list[RunResult]
    merged: MergedMaps
    points: list[RunPoints]

    @property
    def ways(self) -> list[Trajectory]:
        return [self.merged.trajectory(n, done.updates) for n, done in enumerate(self.runs)]

    def refined(self, **more) -> tuple[RefinedRun, ...]:
        given = {"graph": self.merged.graph.saved(), "starts": self.merged.starts, **more}
        updates = [done.updates for done in self.runs]
        return refine_runs(self.points, updates, given.pop("ways", self.ways), **given)

    def errors(self, ways: list[Trajectory]) -> list[FloatArray]:
        """Metres of all poses from where they are, in the frame of the first pose of the first."""
        began = self.ways[0].map_T_lidar[0]
        map_T_world = began @ np.linalg.inv(self.truth.map_T_lidar[0])
        true = [map_T_world @ self.truth.at(way.stamps).map_T_lidar for way in ways]
        return [way.positions - poses[:, :3, 3]
                for way, poses in zip(ways, true, strict=True)]  # fmt: skip


@pytest.fixture(scope="module")
def two(tmp_path_factory) -> Two:
    """Two drives through the same rooms, the second one of which begins on the way."""
    scene, folder = BUILDERS["rooms"](4), tmp_path_factory.mktemp("two")
    config = Config().changed("pose_graph.keyframe_distance=0.5")
    drives = [SimulatedWorld(scene, frames=60, columns=300, speed=3.0, seed=s) for s in (4, 104)]
    runs, points, maps = [], [], []
    for number, (drive, (start, end)) in enumerate(zip(drives, CUTS, strict=True)):
        part = PartOf(drive, start, 1)
        runs.append(run(part, config, max_frames=end - start))
        points.append(run_points(part, runs[-1].updates, runs[-1].config, most=1000))
        save_map(folder / f"{number}.lgmap", runs[-1].pipeline)
        maps.append(SavedMap(folder / f"{number}.lgmap"))
    return Two(drives[0].truth, runs, merge_maps(maps, folder / "both.lgmap"), points)


@pytest.fixture(scope="module")
def refined(two) -> tuple[RefinedRun, ...]:
    return two.refined()


def rms(errors: FloatArray) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def test_the_runs_are_nearer_to_the_truth_than_merged_and_in_one_frame(two, refined) -> None:
    ways = [one.trajectory for one in refined]
    before, after = (rms(np.concatenate(two.errors(of))) for of in (two.ways, ways))
    assert after < 0.85 * before
    for one, done in zip(refined, two.runs, strict=True):
        assert np.array_equal(one.trajectory.stamps, done.trajectory.stamps)
        assert one.seen.all()
    np.testing.assert_allclose(
        ways[0].map_T_lidar[0, :3, 3], two.ways[0].map_T_lidar[0, :3, 3], atol=0.01
    )
    squared = []
    for error, one in zip(two.errors(ways), refined, strict=True):
        turns = one.trajectory.map_T_lidar[:, :3, :3]
        told = turns @ one.covariances[:, 3:, 3:] @ np.swapaxes(turns, 1, 2)
        squared += [e @ np.linalg.solve(c, e) / 3.0 for e, c in zip(error, told, strict=True)][1:]
    assert 0.2 < np.mean(squared) < 4.0
    parts = [len(one.map_points(0.1)) for one in refined]
    every = np.concatenate([part for one in refined for part in one.all_points()])
    assert len(every) > max(parts)
    sweeps = [one.held_out()[1] for one in refined]
    assert (sweeps[0].min(), sweeps[0].max(), sweeps[1].min()) == (0, 34, 35)


def test_long_runs_are_adjusted_in_windows_each_of_one_run(two, refined) -> None:
    windows: list[tuple[int, int]] = []
    found = two.refined(settings=Settings(whole=20), on_window=lambda *at: windows.append(at))
    assert windows == [(1, 4), (2, 4), (3, 4), (4, 4)]  # 24 and 11 sweeps of each
    ways = [[one.trajectory for one in of] for of in (refined, found)]
    whole, parts = (rms(np.concatenate(two.errors(of))) for of in ways)
    assert parts < 1.5 * whole


def with_loop(graph: SavedGraph, earlier: int, later: int, beside: float) -> SavedGraph:
    """A graph with one more loop, that is wrong."""
    poses = [graph.poses.atPose3(X(n)) for n in (earlier, later)]
    aside = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, beside, 0.0]))
    noise = noise_model(np.diag(np.repeat([1e-3, 3e-3], 3) ** 2))
    factors = gtsam.NonlinearFactorGraph(graph.factors)
    motion = poses[0].between(poses[1]).compose(aside)
    factors.add(gtsam.BetweenFactorPose3(X(earlier), X(later), motion, noise))
    return replace(graph, factors=factors, closures=[*graph.loops, factors.size() - 1])


@pytest.mark.parametrize("neighbours", [True, False])
def test_a_wrong_loop_between_the_runs_does_not_bend_them(two, refined, neighbours) -> None:
    last = two.merged.starts[1] - 1
    graph = with_loop(two.merged.graph.saved(), last, last + (1 if neighbours else 5), 1.0)
    found = two.refined(graph=graph)
    for one, other in zip(refined, found, strict=True):
        assert np.array_equal(one.trajectory.map_T_lidar, other.trajectory.map_T_lidar)


def test_loops_bring_runs_together_that_begin_too_far_apart_for_planes(two) -> None:
    ways = two.ways
    aside = ways[1].map_T_lidar.copy()
    aside[:, 1, 3] += 0.3
    ways[1] = Trajectory(ways[1].stamps, aside)
    off = [
        rms(two.errors([one.trajectory for one in two.refined(ways=ways, graph=graph)])[1])
        for graph in (two.merged.graph.saved(), None)
    ]
    assert off[0] < 0.01
    assert off[1] > 0.1  # without loops: planes alone do not see each other


def test_one_run_is_the_case_of_one(two) -> None:
    updates = two.runs[0].updates
    settings = Settings(rounds=2)
    way = two.runs[0].trajectory
    (one,) = refine_runs(two.points[:1], [updates], [way], settings=settings)
    alone = refine_run(two.points[0], updates, settings=settings)
    assert np.array_equal(one.trajectory.map_T_lidar, alone.trajectory.map_T_lidar)
    assert np.array_equal(one.covariances, alone.covariances)


def test_a_run_that_begins_on_the_way_begins_where_it_was(two) -> None:
    """Its first sweep was taken for one at rest, which would be 15 cm off in the middle."""
    alone = refine_run(two.points[1], two.runs[1].updates)
    error = absolute_error(alone.trajectory, two.truth)
    assert error.translations[0] < 0.02  # 12 mm; 29 mm without
    assert error.rmse < 0.004


@pytest.mark.parametrize("start", ["rest", "moving"])
def test_a_run_stays_where_its_first_pose_is(start) -> None:
    """The first sweep's middle is where the next two poses tell, however slowly it began."""
    drive = SimulatedWorld("room", frames=12, columns=300, speed=0.5, start=start)
    done = run(drive, Config())
    refined = refine_run(run_points(drive, done.updates, done.config), done.updates)
    moved = (refined.trajectory.positions - done.trajectory.positions).mean(axis=0)
    assert np.linalg.norm(moved[:2]) < 0.005  # 26 mm if it is taken for one at rest


def test_covariances_of_a_later_run_stand_on_its_first_pose(two, refined) -> None:
    one = refined[1]
    between = one.refined.relative_covariance(35 + 2, 35 + 9)
    assert np.array_equal(one.relative_covariance(2, 9), between)
    with pytest.raises(InputError, match="from 0 to 34"):
        one.relative_covariance(-1, 9)
    with pytest.raises(InputError, match=r"earlier < later, .* got 9 and 2; swap the two"):
        one.relative_covariance(9, 2)
    blind = replace(one, seen=np.arange(35) != 4)
    assert np.array_equal(blind.covariances[:4], one.covariances[:4])
    told = np.array([update.covariance for update in two.runs[1].updates])
    more = blind.covariances[4:] - told[4:]
    assert (np.linalg.eigvalsh(more) > 0.0).all()
    motion = one.updates[9].map_T_lidar.between(one.updates[0].map_T_lidar).AdjointMap()
    np.testing.assert_allclose(more[5], motion @ one.covariances[0] @ motion.T, atol=1e-12)


def test_runs_that_do_not_belong_together_are_refused(two) -> None:
    updates = [done.updates for done in two.runs]
    with pytest.raises(InputError, match="for each run, got 2, 2, 1 of them"):
        refine_runs(two.points, updates, two.ways[:1])
    with pytest.raises(InputError, match="got 2, 2, 2, 1 of them"):
        refine_runs(two.points, updates, two.ways, graph=two.merged.graph.saved())
    with pytest.raises(InputError, match=r"trajectories\[1\]: expected the stamps"):
        refine_runs(two.points, updates, [two.ways[0], two.ways[0]])
    with pytest.raises(InputError, match=r"updates: expected all of the run, 3. or more, got 5"):
        refine_run(two.points[0], updates[0][:5])
    with pytest.raises(InputError, match=r"factors: expected a gtsam.NonlinearFactorGraph, got l"):
        refine_run(two.points[0], updates[0], factors=[])
    far = two.ways[1].map_T_lidar.copy()
    far[:, 0, 3] += 500.0
    ways = [two.ways[0], Trajectory(two.ways[1].stamps, far)]
    with pytest.raises(
        InputError, match="35 sweeps, number 35 the first, share no plane, line or factor"
    ):
        refine_runs(two.points, updates, ways)


def test_runs_on_one_clock_have_paths_of_their_own() -> None:
    stamps = np.arange(12) * 100_000_000
    times = stamps * 1e-9
    ways = [
        np.array([gtsam.Pose3.Expmap([0, 0, w * t, 2 * t, w * t**2, 0]).matrix() for t in times])
        for w in (0.3, -0.8)
    ]
    both = Path.through(np.tile(stamps, 2), np.concatenate(ways), (0, 12))
    alone = [Path.through(stamps, way) for way in ways]
    assert np.array_equal(both.powers, np.concatenate([one.powers for one in alone]))
    beside = np.full(24, -0.05)
    missed = np.concatenate([one.sway.missed(beside[:12]) for one in alone])
    np.testing.assert_allclose(both.sway.missed(beside), missed, rtol=1e-9, atol=1e-24)
    with pytest.raises(InputError, match="increasing nanoseconds"):
        Path.through(np.tile(stamps, 2), np.concatenate(ways))
    for starts in ((), (1, 12), (0, 12, 12), (0, 25)):
        with pytest.raises(InputError, match="starts: expected 0 and then increasing"):
            Path.through(np.tile(stamps, 2), np.concatenate(ways), starts)
