"""What is recorded of a frame: the sweep where it was, and the map around the sensor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from support.cli import loam
from support.list_dataset import ListDataset
from typer.testing import Result

from loam_gtsam.config import Config, DeskewConfig
from loam_gtsam.datasets.base import DatasetInfo
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.imu.buffer import ImuBuffer
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
from loam_gtsam.view.observers import record, registered_cloud, surrounding_cloud

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
    still = registered_cloud(scan, result(moment), Mapper(config))
    assert np.abs(still[:, :3] - there).max() > 0.3


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
    update = result(0.0, twist=np.ones(6))
    cloud = registered_cloud(scan, update, Mapper(config))
    expected = np.array([PLACE.transformFrom(point) for point in scan.points])
    np.testing.assert_allclose(cloud[:, :3], expected, atol=1e-5)


def test_clouds_of_other_front_ends_and_sweeps_without_any() -> None:
    points = np.random.default_rng(0).normal(size=(30, 3))
    features = Features.from_points(STAMP, points, points)
    with_cloud = FeatureSweep(features, gtsam.Pose3(), points.astype(np.float32))
    cloud = registered_cloud(with_cloud, result(0.0), Mapper())
    expected = np.array([PLACE.transformFrom(point) for point in points])
    np.testing.assert_allclose(cloud, np.column_stack([expected, np.zeros(30)]), atol=1e-5)
    for sweep in (
        FeatureSweep(features, gtsam.Pose3()),
        BadSweep(STAMP, "broken"),
        Scan(np.zeros((3, 3)), STAMP),
    ):
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
        outcome = run(ListDataset(sweeps), observe=observe)
    counts = topics(tmp_path / "run.bag")
    assert (counts[ODOMETRY], counts[REGISTERED], counts[SURROUND]) == (6, 5, 2)
    surround = surrounding_cloud(outcome.updates[-1], mappers[-1])
    assert np.array_equal(surround[surround[:, 3] == 0, :3], outcome.edge_points)
    assert np.array_equal(surround[surround[:, 3] == 1, :3], outcome.plane_points)
    cloud = registered_cloud(sweeps[4], outcome.updates[4], mappers[-1])
    # On the walls of the map: the voxels of plane points are 0.4 m wide.
    distances = np.linalg.norm(cloud[::50, None, :3] - surround[None, :, :3], axis=2).min(axis=1)
    assert np.median(distances) < 0.4
    far = MapUpdate(STAMP, gtsam.Pose3(gtsam.Rot3(), np.array([1e3, 0, 0])), FrameStatus.OK)
    assert surrounding_cloud(far, mappers[-1]).shape == (0, 4)


def topics(path: Path) -> dict[str, int]:
    with AnyReader([path]) as reader:
        return {topic: info.msgcount for topic, info in reader.topics.items()}


# -- from the command line -------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")


def run_command(*arguments: object) -> Result:
    return loam("run", *arguments, "--no-plot", "--output", "out")


class Sweeps(ListDataset):
    def info(self) -> DatasetInfo:
        return DatasetInfo("list", "nowhere")


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


def test_without_the_option_there_is_no_bag() -> None:
    done = run_command(ROOM)
    assert done.exit_code == 0
    assert "Bag" not in done.output
    assert [path.name for path in Path().iterdir()] == ["out"]


def test_a_run_that_breaks_off_leaves_a_whole_bag(monkeypatch: pytest.MonkeyPatch) -> None:
    scans = [*SimulatedWorld("room", frames=2, columns=450)]
    dataset = Sweeps([*scans, RuntimeError("the disk is gone")])
    monkeypatch.setattr("loam_gtsam.datasets.open_dataset", lambda *a, **k: dataset)
    done = run_command("x", "--bag", "a.mcap")
    assert isinstance(done.exception, RuntimeError)
    assert topics(Path("a.mcap"))[ODOMETRY] == 2


def test_a_run_without_sweeps_leaves_no_bag(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loam_gtsam.datasets.open_dataset", lambda *a, **k: Sweeps([]))
    assert run_command("x", "--bag", "a.bag").exit_code == 1
    assert [path.name for path in Path().iterdir()] == []


def test_a_bag_that_cannot_be_written_costs_no_results(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(bag: BagWriter, topic: str, *_: object) -> None:
        if bag.frames == 2:
            raise OSError(28, "No space left on device")
        BagWriter.__dict__["_kept"](bag, topic, *_)

    monkeypatch.setattr(BagWriter, "_kept", BagWriter._append, raising=False)
    monkeypatch.setattr(BagWriter, "_append", fail)
    done = run_command(ROOM, "--bag", "a.bag")
    assert done.exit_code != 0
    assert len(read_tum("out/trajectory.tum")) == 3
    assert "No space left" in json.loads(Path("out/summary.json").read_text())["error"]
