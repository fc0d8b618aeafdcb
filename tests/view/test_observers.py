"""What is shown of a run is what the mapper used, and showing it changes nothing."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from support.list_dataset import ListDataset

from loam_gtsam.config import Config
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.geometry import transform
from loam_gtsam.io.run_files import write_npz
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.pipeline import Pipeline, run
from loam_gtsam.types import BadSweep, FrameStatus
from loam_gtsam.view.frame_view import LARGE_RESIDUAL, residual_colours
from loam_gtsam.view.observers import LastFrame, watch

FRAMES = 6


class Kept:
    """A watcher that keeps everything."""

    def __init__(self):
        self.frames, self.maps = [], []

    def show(self, frame, around):
        self.frames.append(frame)
        self.maps.append(around())


class OneLoop:
    """Says that the third keyframe is a little off, seen from the first."""

    def detect(self, keyframe, history):
        if keyframe.index != 2:
            return None
        off = gtsam.Pose3(gtsam.Rot3(), np.array([0.02, 0.0, 0.0]))
        motion = history.relative(0, 2)[0].compose(off)
        return LoopClosure(0, 2, motion, np.diag(np.repeat([1e-3, 1e-3], 3) ** 2))


@pytest.fixture(scope="module")
def sweeps():
    world = SimulatedWorld("room", frames=FRAMES, columns=450)
    scans = [world[n] for n in range(FRAMES)]
    return [*scans[:3], BadSweep(scans[3].stamp, "broken"), *scans[4:]]


def with_loops():
    config = Config()
    graph = config.pose_graph.changed(keyframe_distance=1e-4, max_chi2=1e9)
    return config.changed(pose_graph=graph)


def saved(outcome, path):
    """The arrays of a run but for its times."""
    write_npz(path, outcome.updates)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files if not name.startswith("stage")}
    return arrays | {"edges": outcome.edge_points, "planes": outcome.plane_points}


@pytest.mark.parametrize("loops", [False, True])
def test_a_run_that_is_watched_is_the_same_run(tmp_path, sweeps, loops):
    runs = []
    for observe in (None, watch(Kept(), Kept())):
        closer = OneLoop() if loops else None
        outcome = run(ListDataset(sweeps), with_loops(), loop_closer=closer, observe=observe)
        assert loops is (outcome.loops is not None and len(outcome.loops.graph.loops) == 1)
        runs.append(saved(outcome, tmp_path / "run.npz"))
    assert runs[0].keys() == runs[1].keys()
    for name, array in runs[0].items():
        np.testing.assert_array_equal(array, runs[1][name], err_msg=name)


@pytest.fixture(scope="module")
def watched(sweeps):
    kept = Kept()
    return run(ListDataset(sweeps), observe=watch(kept)), kept


def test_the_matches_are_those_that_the_pose_was_solved_with(watched):
    outcome, kept = watched
    for frame, update in zip(kept.frames, outcome.updates, strict=True):
        matches = update.n_edge_matches + update.n_plane_matches
        assert len(frame.points) == len(frame.feet) == len(frame.residuals) == matches
        assert (len(frame.edges), len(frame.planes)) == (
            (update.n_edges, update.n_planes) if update.status is not FrameStatus.UNUSABLE_SCAN
            else (0, 0)
        )  # fmt: skip
        assert np.isfinite(frame.position_covariance).all() is np.bool_(update.status.solved)
    assert [len(frame.points) > 100 for frame in kept.frames] == [
        False,
        True,
        True,
        False,
        True,
        True,
    ]
    # The sweep itself is in the map by now: matched anew, it would fit much better than it did.
    assert 0.1 < np.median(kept.frames[-1].residuals) < 1.0


def test_feet_lie_on_the_lines_and_planes_of_the_matches(sweeps):
    pipeline, kept = Pipeline(), Kept()
    observe = watch(kept)
    for sweep in sweeps[:3]:
        observe(sweep, pipeline.process(sweep), pipeline)
    matches, frame = pipeline.mapper.registered.matches, kept.frames[-1]
    edges, planes = matches.edges, matches.planes
    on_edges, on_planes = np.split(frame.feet, [len(edges)])
    across = np.cross(on_edges - edges.centres, edges.directions)
    np.testing.assert_allclose(across, 0.0, atol=1e-9)
    np.testing.assert_allclose((on_planes * planes.normals).sum(axis=1), -planes.offsets, atol=1e-9)
    # The residual belongs to the shortest way there, and the points to the sweep.
    lengths = np.linalg.norm(frame.points - frame.feet, axis=1)
    sigmas = np.concatenate([edges.sigmas, planes.sigmas])
    np.testing.assert_allclose(lengths, frame.residuals * sigmas, atol=1e-12)
    away = frame.points[: len(edges)] - on_edges
    np.testing.assert_allclose((away * edges.directions).sum(axis=1), 0.0, atol=1e-9)
    seen = np.concatenate([frame.edges, frame.planes])
    nearest = np.linalg.norm(frame.points[::20, None] - seen[None], axis=2).min(axis=1)
    assert nearest.max() < 0.02


def test_covariances_of_positions_are_along_the_axes_of_the_map(watched):
    outcome, kept = watched
    update, frame = outcome.updates[-1], kept.frames[-1]
    step = np.array([0.01, -0.02, 0.03])
    moved = update.map_T_lidar.retract(np.concatenate([np.zeros(3), step]))
    in_map = moved.translation() - update.map_T_lidar.translation()
    inverse = np.linalg.inv(update.covariance[3:, 3:])
    np.testing.assert_allclose(
        in_map @ np.linalg.inv(frame.position_covariance) @ in_map, step @ inverse @ step
    )


def test_the_map_and_the_way_are_those_of_the_run(watched):
    outcome, kept = watched
    last = kept.maps[-1]
    np.testing.assert_array_equal(last.edges, outcome.edge_points)
    np.testing.assert_array_equal(last.planes, outcome.plane_points)
    np.testing.assert_array_equal(last.path, outcome.trajectory.map_T_lidar[:, :3, 3])
    assert last.loops.shape == (0, 2, 3)
    assert [len(view.path) for view in kept.maps] == list(range(1, FRAMES + 1))


def test_with_loops_all_is_where_they_put_it(sweeps):
    kept = Kept()
    outcome = run(ListDataset(sweeps), with_loops(), loop_closer=OneLoop(), observe=watch(kept))
    frame, view = kept.frames[-1], kept.maps[-1]
    corrected = outcome.trajectory.map_T_lidar[-1]
    moved = np.linalg.norm(corrected[:3, 3] - outcome.updates[-1].map_T_lidar.translation())
    assert moved > 1e-4
    np.testing.assert_allclose(frame.map_T_lidar, corrected, atol=1e-9)
    np.testing.assert_allclose(view.path[-1], corrected[:3, 3], atol=1e-9)
    assert view.loops.shape == (1, 2, 3)
    assert view.loops_on.tolist() == [True]
    # The sweep has moved with its pose, and its features with it.
    back = np.linalg.inv(frame.map_T_lidar)
    plain = Kept()
    run(ListDataset(sweeps), observe=watch(plain))
    before = np.linalg.inv(plain.frames[-1].map_T_lidar)
    for name in ("sweep", "planes"):
        here, there = getattr(frame, name), getattr(plain.frames[-1], name)
        np.testing.assert_allclose(transform(back, here), transform(before, there), atol=0.02)


def test_of_a_run_only_the_last_frame_is_remembered(sweeps):
    last, kept = LastFrame(), Kept()
    assert not last.seen
    run(ListDataset(sweeps), observe=last.observe)
    run(ListDataset(sweeps), observe=watch(kept))
    assert last.seen
    assert last.frame().number == FRAMES - 1
    np.testing.assert_array_equal(last.frame().feet, kept.frames[-1].feet)
    np.testing.assert_array_equal(last.around().path, kept.maps[-1].path)


def test_residuals_go_from_blue_to_red_and_large_ones_are_alike():
    colours = residual_colours(np.array([0.0, 1.5, LARGE_RESIDUAL, 100.0, -1.5])).astype(int)
    assert colours.shape == (5, 3)
    assert colours[0, 2] > colours[0, 0] + 100
    assert colours[2, 0] > colours[2, 2] + 100
    assert (colours[2] == colours[3]).all()
    assert (colours[1] == colours[4]).all()
    assert residual_colours(np.zeros(0)).shape == (0, 3)
