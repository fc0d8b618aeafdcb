"""What is recorded and shown of a run is what the mapper used, and changes nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from support.cli import loam
from support.list_dataset import ListDataset
from support.quick import QUICK, QUICK_START
from typer.testing import Result

from loam_gtsam.config import Config, DeskewConfig
from loam_gtsam.datasets.base import DatasetInfo
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.geometry import transform, voxel_filter
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.io.run_files import write_npz
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.mapper import Mapper
from loam_gtsam.pipeline import Pipeline, run
from loam_gtsam.ros.bag_writer import BagWriter
from loam_gtsam.ros.messages import ODOMETRY, REGISTERED, SURROUND
from loam_gtsam.types import (
    BadSweep,
    Features,
    FeatureSweep,
    FrameStatus,
    ImuSamples,
    MapUpdate,
    Scan,
    SweepMotion,
)
from loam_gtsam.view.frame_view import LARGE_RESIDUAL, residual_colours
from loam_gtsam.view.observers import LastFrame, record, registered_cloud, surrounding_cloud, watch

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
    graph = QUICK.pose_graph.changed(keyframe_distance=1e-4, max_chi2=1e9)
    return QUICK.changed(pose_graph=graph)


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
    return run(ListDataset(sweeps), QUICK, observe=watch(kept)), kept


def test_the_matches_are_those_that_the_pose_was_solved_with(watched):
    outcome, kept = watched
    for frame, update in zip(kept.frames, outcome.updates, strict=True):
        matches = update.n_edge_matches + update.n_plane_matches
        assert len(frame.points) == len(frame.feet) == len(frame.residuals) == matches
        used = update.status is not FrameStatus.UNUSABLE_SCAN
        counts = (update.n_edges, update.n_planes) if used else (0, 0)
        assert (len(frame.edges), len(frame.planes)) == counts
        assert np.isfinite(frame.position_covariance).all() is np.bool_(update.status.solved)
    shown = [len(frame.points) > 100 for frame in kept.frames]
    assert shown == [False, True, True, False, True, True]
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
    np.testing.assert_allclose(np.cross(on_edges - edges.centres, edges.directions), 0.0, atol=1e-9)
    np.testing.assert_allclose((on_planes * planes.normals).sum(axis=1), -planes.offsets, atol=1e-9)
    # The residual belongs to the shortest way there, and the points to the sweep.
    lengths = np.linalg.norm(frame.points - frame.feet, axis=1)
    sigmas = np.concatenate([edges.sigmas, planes.sigmas])
    np.testing.assert_allclose(lengths, frame.residuals * sigmas, atol=1e-12)
    away = frame.points[: len(edges)] - on_edges
    np.testing.assert_allclose((away * edges.directions).sum(axis=1), 0.0, atol=1e-9)
    seen = np.concatenate([frame.edges, frame.planes])
    assert np.linalg.norm(frame.points[::20, None] - seen[None], axis=2).min(axis=1).max() < 0.02


def test_covariances_of_positions_are_along_the_axes_of_the_map(watched):
    outcome, kept = watched
    update, frame = outcome.updates[-1], kept.frames[-1]
    step = np.array([0.01, -0.02, 0.03])
    moved = update.map_T_lidar.retract(np.concatenate([np.zeros(3), step]))
    in_map = moved.translation() - update.map_T_lidar.translation()
    inverse = np.linalg.inv(update.covariance[3:, 3:])
    found = in_map @ np.linalg.inv(frame.position_covariance) @ in_map
    np.testing.assert_allclose(found, step @ inverse @ step)


def test_the_map_and_the_way_are_those_of_the_run(watched):
    outcome, kept = watched
    last = kept.maps[-1]
    np.testing.assert_array_equal(last.edges, outcome.edge_points)
    np.testing.assert_array_equal(last.planes, outcome.plane_points)
    np.testing.assert_array_equal(last.path, outcome.trajectory.positions)
    assert last.loops.shape == (0, 2, 3)
    assert [len(view.path) for view in kept.maps] == list(range(1, FRAMES + 1))


def test_with_loops_all_is_where_they_put_it(sweeps, watched):
    kept = Kept()
    outcome = run(ListDataset(sweeps), with_loops(), loop_closer=OneLoop(), observe=watch(kept))
    frame, view = kept.frames[-1], kept.maps[-1]
    corrected = outcome.trajectory.map_T_lidar[-1]
    assert np.linalg.norm(corrected[:3, 3] - outcome.updates[-1].map_T_lidar.translation()) > 1e-4
    np.testing.assert_allclose(frame.map_T_lidar, corrected, atol=1e-9)
    np.testing.assert_allclose(view.path[-1], corrected[:3, 3], atol=1e-9)
    assert view.loops.shape == (1, 2, 3)
    assert view.loops_on.tolist() == [True]
    # The sweep has moved with its pose, and its features with it.
    back = np.linalg.inv(frame.map_T_lidar)
    _, plain = watched
    before = np.linalg.inv(plain.frames[-1].map_T_lidar)
    for name in ("sweep", "planes"):
        here, there = getattr(frame, name), getattr(plain.frames[-1], name)
        np.testing.assert_allclose(transform(back, here), transform(before, there), atol=0.02)


def test_of_a_run_only_the_last_frame_is_remembered(sweeps, watched):
    last, (_, kept) = LastFrame(), watched
    assert not last.seen
    run(ListDataset(sweeps), QUICK, observe=last.observe)
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


STAMP = 1_700_000_000_000_000_000
PLACE = gtsam.Pose3.Expmap(np.array([0.2, -0.1, 1.5, 3.0, 4.0, -1.0]))


def moving_sweep(twist: np.ndarray, moment: float) -> tuple[Scan, np.ndarray, np.ndarray]:
    """A sweep from PLACE at ``moment`` after the stamp on, its points in the map and intensities.

    Points come ring after ring from below, in firing order: the order of the registered cloud.
    """
    times = np.tile(np.linspace(-0.03, 0.07, 20), 16)
    rings = np.repeat(np.arange(16), 20)
    elevation, azimuth = np.radians(2.0 * rings - 15.0), -20.0 * np.pi * times
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=1)
    seen = np.random.default_rng(0).uniform(5.0, 20.0, (320, 1)) * directions
    there = [
        PLACE.compose(gtsam.Pose3.Expmap(twist * (time - moment))).transformFrom(point)
        for point, time in zip(seen, times, strict=True)
    ]
    return Scan(seen, STAMP, times, rings), np.array(there), rings + (times + 0.03)


def result(moment: float, **values: Any) -> MapUpdate:
    stamp = STAMP + round(moment * 1e9)
    return MapUpdate(stamp, PLACE, FrameStatus.OK, **values)


@pytest.mark.parametrize(
    ("reference", "moment"), [("start", -0.03), ("middle", 0.02), ("end", 0.07), ("stamp", 0.0)]
)
def test_a_moving_sweep_is_put_where_its_points_were(reference: Any, moment: float) -> None:
    twist = np.array([0.3, -0.2, 1.0, 8.0, 1.0, -0.5])
    scan, there, intensities = moving_sweep(twist, moment)
    config = Config(deskew=DeskewConfig(reference=reference))
    update = result(moment, twist=twist, sweep_motion=SweepMotion.CONSTANT_VELOCITY)
    cloud = registered_cloud(scan, update, Mapper(config))
    np.testing.assert_allclose(cloud[:, :3], there, atol=1e-4)
    np.testing.assert_allclose(cloud[:, 3], intensities, atol=1e-9)
    assert np.abs(registered_cloud(scan, result(moment), Mapper(config))[:, :3] - there).max() > 0.3


def turning_imu(rate: np.ndarray, config: Config) -> ImuBuffer:
    stamps = STAMP + np.arange(-200_000_000, 200_000_000, 5_000_000)
    gyro = np.tile(rate, (len(stamps), 1))
    return ImuBuffer(config.imu, ImuSamples(stamps, None, gyro, np.tile([0.0, 0, 9.81], (80, 1))))


def test_the_rotation_within_a_sweep_is_that_the_mapper_used() -> None:
    rate = np.array([0.3, -0.2, 1.0])
    scan, there, _ = moving_sweep(np.concatenate([rate, np.zeros(3)]), -0.03)
    config = Config()
    mapper = Mapper(config, imu=turning_imu(rate, config))
    for motion, fits in ((SweepMotion.GYRO, True), (SweepMotion.CONSTANT_VELOCITY, False)):
        # The twist of no motion: the rotation can only come from the gyro.
        cloud = registered_cloud(scan, result(-0.03, sweep_motion=motion), mapper)
        assert bool(np.abs(cloud[:, :3] - there).max() < 1e-3) is fits


def test_a_sweep_without_deskew_is_only_moved() -> None:
    scan, _, _ = moving_sweep(np.zeros(6), 0.0)
    config = Config(deskew=DeskewConfig(enabled=False, reference="stamp"))
    cloud = registered_cloud(scan, result(0.0, twist=np.ones(6)), Mapper(config))
    expected = np.array([PLACE.transformFrom(point) for point in scan.points])
    np.testing.assert_allclose(cloud[:, :3], expected, atol=1e-5)


def test_clouds_of_other_front_ends_and_sweeps_without_any() -> None:
    points = np.random.default_rng(0).normal(size=(30, 3))
    features = Features.from_points(STAMP, points, points)
    with_cloud = FeatureSweep(features, gtsam.Pose3(), points.astype(np.float32))
    cloud = registered_cloud(with_cloud, result(0.0), Mapper())
    expected = np.array([PLACE.transformFrom(point) for point in points])
    np.testing.assert_allclose(cloud, np.column_stack([expected, np.zeros(30)]), atol=1e-5)
    bare = FeatureSweep(features, gtsam.Pose3())
    for sweep in (bare, BadSweep(STAMP, "broken"), Scan(np.zeros((3, 3)), STAMP)):
        assert registered_cloud(sweep, result(0.0), Mapper()) is None


def test_the_whole_of_a_run_is_recorded(tmp_path: Path) -> None:
    world = SimulatedWorld("room", frames=6, columns=450)
    sweeps = [*(world[n] for n in range(5)), BadSweep(world[5].stamp, "broken")]
    mappers = []

    def observe(sweep: Any, update: MapUpdate, pipeline: Pipeline) -> None:
        mappers.append(pipeline.mapper)
        recorded(sweep, update, pipeline)

    with BagWriter(tmp_path / "run.bag") as bag:
        recorded = record(bag)
        outcome = run(ListDataset(sweeps), QUICK, observe=observe)
    counts = topics(tmp_path / "run.bag")
    assert (counts[ODOMETRY], counts[REGISTERED], counts[SURROUND]) == (6, 5, 2)
    surround = surrounding_cloud(outcome.updates[-1], mappers[-1])
    kinds = outcome.edge_points, outcome.plane_points
    rows = [np.column_stack([p, np.full(len(p), float(n))]) for n, p in enumerate(kinds)]
    whole = np.concatenate(rows)
    size = mappers[-1].maps.config.map.edge_voxel
    assert np.array_equal(surround, voxel_filter(whole, size))
    assert 0.7 * len(whole) < len(surround) < len(whole)
    # All round, though the sensor sees no more than two thirds of the cubes at once.
    turned = outcome.updates[-1].map_T_lidar.compose(
        gtsam.Pose3(gtsam.Rot3.Pitch(np.pi / 2), np.zeros(3))
    )
    upright = replace(outcome.updates[-1], map_T_lidar=turned)
    assert np.array_equal(surrounding_cloud(upright, mappers[-1]), surround)
    cloud = registered_cloud(sweeps[4], outcome.updates[4], mappers[-1])
    # On the walls of the map: the voxels of plane points are 0.4 m wide.
    distances = np.linalg.norm(cloud[::50, None, :3] - surround[None, :, :3], axis=2).min(axis=1)
    assert np.median(distances) < 0.4
    far = MapUpdate(STAMP, gtsam.Pose3(gtsam.Rot3(), np.array([1e3, 0, 0])), FrameStatus.OK)
    assert surrounding_cloud(far, mappers[-1]).shape == (0, 4)


def topics(path: Path) -> dict[str, int]:
    with AnyReader([path]) as reader:
        return {topic: info.msgcount for topic, info in reader.topics.items()}


@pytest.fixture(autouse=True)
def _empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")


def run_command(*arguments: object) -> Result:
    return loam("run", *arguments, "--no-plot", "--output", "out", *QUICK_START)


ROOM = "sim:room?frames=3&columns=450"


def test_a_bag_is_written_and_replaced_if_asked() -> None:
    done = run_command(ROOM, "--bag", "bags/a.bag", "--set", "bag.surround_every=0")
    assert done.exit_code == 0, done.output
    assert "Bag written to bags/a.bag" in done.output
    counts = topics(Path("bags/a.bag"))
    assert counts[ODOMETRY] == counts[REGISTERED] == 3
    assert SURROUND not in counts
    again = run_command(ROOM, "--bag", "bags/a.bag")
    assert again.exit_code == 1
    assert "bags/a.bag: the bag exists; add overwrite=True (--overwrite)" in again.output
    assert SURROUND not in topics(Path("bags/a.bag"))
    assert run_command(ROOM, "--bag", "bags/a.bag", "--overwrite").exit_code == 0
    assert topics(Path("bags/a.bag"))[SURROUND] == 1


@pytest.mark.parametrize(
    ("name", "opened"), [("a.bag", "a.bag"), ("a", "a"), ("a", "a/a.db3"), ("a", "../here/a")]
)
def test_the_input_is_never_replaced(
    tmp_path: Path, monkeypatch: Any, name: str, opened: str
) -> None:
    Path("here").mkdir()
    monkeypatch.chdir("here")
    assert run_command(ROOM, "--bag", name).exit_code == 0
    refused = run_command(opened, "--bag", name, "--overwrite")
    assert refused.exit_code == 1
    assert f"--bag {name}: the input must not be replaced" in refused.output
    beside = run_command(opened, "--bag", f"b{name}", "--overwrite")
    assert "must not be replaced" not in beside.output
    assert topics(Path(name))[ODOMETRY] == 3


def test_a_run_that_breaks_off_leaves_a_whole_bag(monkeypatch: pytest.MonkeyPatch) -> None:
    scans = [*SimulatedWorld("room", frames=2, columns=450)]
    dataset = ListDataset([*scans, RuntimeError("the disk is gone")])
    dataset.info = lambda: DatasetInfo("list", "nowhere")
    monkeypatch.setattr("loam_gtsam.datasets.open_dataset", lambda *a, **k: dataset)
    assert isinstance(run_command("x", "--bag", "a.mcap").exception, RuntimeError)
    assert topics(Path("a.mcap"))[ODOMETRY] == 2


def test_a_bag_that_cannot_be_written_costs_no_results(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(bag: BagWriter, topic: str, *_: object) -> None:
        if bag.frames == 2:
            raise OSError(28, "No space left on device")
        BagWriter.__dict__["_kept"](bag, topic, *_)

    monkeypatch.setattr(BagWriter, "_kept", BagWriter._append, raising=False)
    monkeypatch.setattr(BagWriter, "_append", fail)
    assert run_command(ROOM, "--bag", "a.bag").exit_code != 0
    assert len(read_tum("out/trajectory.tum")) == 3
    assert "No space left" in json.loads(Path("out/summary.json").read_text())["error"]
