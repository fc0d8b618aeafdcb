"""Runs that are stopped, killed, and gone on with."""

import signal
import subprocess
import sys
import time
from dataclasses import fields

import gtsam
import numpy as np
import pytest
from support.cli import loam
from support.list_dataset import ListDataset
from support.quick import QUICK, QUICK_START

from loam_gtsam.config import Config, preset
from loam_gtsam.datasets import SimulatedWorld, open_dataset
from loam_gtsam.io.checkpoint import Checkpoint
from loam_gtsam.loops.closure import ScanLoopCloser
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.pipeline import Pipeline, run
from loam_gtsam.registration.solvers import POSE_KEY, GtsamSolver
from loam_gtsam.types import DatasetError, OutputError


def assert_same(one, two):
    """All but the times it took."""
    assert len(one.updates) == len(two.updates)
    for number, (first, second) in enumerate(zip(one.updates, two.updates, strict=True)):
        for item in fields(first):
            if item.name not in ("timings", "uncertainty"):
                left, right = getattr(first, item.name), getattr(second, item.name)
                if isinstance(left, gtsam.Pose3):
                    left, right = left.matrix(), right.matrix()
                np.testing.assert_array_equal(left, right, f"frame {number}: {item.name}")
    np.testing.assert_array_equal(one.trajectory.map_T_lidar, two.trajectory.map_T_lidar)
    np.testing.assert_array_equal(one.edge_points, two.edge_points)
    np.testing.assert_array_equal(one.plane_points, two.plane_points)
    assert one.map_stats == two.map_stats
    if one.loops is not None:
        assert one.loops.counts() == two.loops.counts()


def stopped(dataset, config, folder, at, **options):
    """A run that is interrupted after a frame, with what was there before."""

    def stop(number, update):
        if number + 1 == at:
            raise KeyboardInterrupt

    checkpoint = Checkpoint(folder, seconds=1e9, resume=True)
    return run(dataset, config, on_frame=stop, checkpoint=checkpoint, **options)


class NearestPlace:
    """The closer of a user, as in docs/own_loop_closer.md, with a memory of its own."""

    def __init__(self, config):
        self.registration = ScanLoopCloser(config)
        self.positions = []

    def detect(self, keyframe, history):
        here = keyframe.odom_T_lidar.translation()
        self.positions.append(here)
        if len(self.positions) < 8:
            return None
        nearest = int(np.argmin(np.linalg.norm(np.array(self.positions[:-7]) - here, axis=1)))
        found = self.registration.verify(keyframe, nearest, history)
        return found if isinstance(found, LoopClosure) else None


def held_near_the_start(context):
    """Own factors of a user, on the pose and between it and the last one."""
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
    slow = gtsam.BetweenFactorPose3(context.last_key, context.key, gtsam.Pose3(), noise)
    return [gtsam.PriorFactorPose3(POSE_KEY, gtsam.Pose3(), noise), slow]


LOOPS = QUICK.changed("loops.enabled=true", "loops.min_way=3", "pose_graph.keyframe_distance=0.7")
IMU = QUICK.changed("imu.lag=5")
DENSE = QUICK.changed("pose_graph.keyframe_distance=0.5", "solver.kernel=huber")
CASES = {
    "plain": ("street_loop?frames=8&columns=300", Config(), [1, 2, 5]),
    "imu in the graph": ("corridor?frames=12&columns=300", IMU, [3, 10]),
    "scan to scan": (
        "trees?frames=6&columns=300",
        QUICK.changed("odometry.method=scan_to_scan"),
        [4],
    ),
    "classical": ("room?frames=8&columns=400", preset("aloam"), [4]),
    "loops": ("room?frames=30&columns=240&speed=4&start=moving", LOOPS, [12, 24]),
    "own closer": ("room?frames=28&columns=240&speed=4&start=moving", DENSE, [9, 25]),
    "own factors": ("room?frames=6&columns=300", Config(), [2, 4]),
    "workers": ("room?frames=6&columns=300", QUICK, [4]),
}
OPTIONS = {
    "own closer": lambda: {"loop_closer": NearestPlace(DENSE)},
    "own factors": lambda: {"extra_factors": held_near_the_start},
    "workers": lambda: {"workers": 1},
}


@pytest.mark.parametrize("case", CASES)
def test_a_run_that_was_stopped_goes_on_to_the_last_bit(case, tmp_path):
    world, config, stops = CASES[case]
    options = OPTIONS.get(case, dict)
    dataset = open_dataset(f"sim:{world}")
    whole = run(dataset, config, **(options() | {"workers": 0}))
    if case in ("loops", "own closer"):
        assert whole.loops.counts()["on"] > 0
    folder = tmp_path / "checkpoint"
    for at in stops:
        assert len(stopped(dataset, config, folder, at, **options()).updates) == at
    assert_same(stopped(dataset, config, folder, None, **options()), whole)


class OwnSolver(GtsamSolver):
    """The solver of a user; it holds objects of GTSAM that no checkpoint can keep."""


def test_an_own_solver_is_given_again(tmp_path):
    def pipeline():
        return Pipeline(QUICK, solver=OwnSolver(QUICK.solver))

    scans = list(open_dataset("sim:room?frames=4&columns=400"))
    first, again, checkpoint = pipeline(), pipeline(), Checkpoint(tmp_path)
    updates = [first.process(scan) for scan in scans[:2]]
    checkpoint.begin({}, *first.state())
    checkpoint.save([scan.stamp for scan in scans[:2]], updates, *first.state())
    assert len(Checkpoint(tmp_path, resume=True).begin({}, *again.state())[1]) == 2
    for scan in scans[2:]:
        poses = [pipeline.process(scan).map_T_lidar.matrix() for pipeline in (first, again)]
        np.testing.assert_array_equal(*poses)


def test_checkpoints_change_nothing_and_only_the_newest_state_stays(tmp_path):
    dataset = open_dataset("sim:room?frames=5&columns=300")
    checkpoint = Checkpoint(tmp_path / "checkpoint", seconds=0.0)
    assert_same(run(dataset, QUICK, checkpoint=checkpoint), run(dataset, QUICK))
    names = sorted(path.name for path in checkpoint.folder.iterdir())
    frames = [f"frames_{n:07d}_{n + 1:07d}.npz" for n in range(5)]
    assert names == [*frames, "state_0000005.npz"]
    checkpoint.remove()
    assert not checkpoint.folder.exists()
    assert checkpoint.due
    assert not Checkpoint(tmp_path, seconds=60.0).due


def test_without_resume_an_old_checkpoint_goes_but_only_files_of_checkpoints(tmp_path):
    dataset = open_dataset("sim:room?frames=3&columns=300")
    stopped(dataset, QUICK, tmp_path / "old", 2)
    (tmp_path / "old" / ".state_0000003.npz.77.tmp").write_text("of a killed process")
    assert len(run(dataset, QUICK, checkpoint=Checkpoint(tmp_path / "old")).updates) == 3
    assert not (tmp_path / "old").exists()
    (tmp_path / "chapters").mkdir()
    for name in ("thesis.txt", "state.npz", "frames_of_mine.npz", "chapters/1.txt"):
        (tmp_path / name).write_text("mine")
    mine = {path.name for path in tmp_path.iterdir()}
    stopped(dataset, QUICK, tmp_path, 2)
    run(dataset, QUICK, checkpoint=Checkpoint(tmp_path))  # from the start: the checkpoint goes
    assert {path.name for path in tmp_path.iterdir()} == mine
    stopped(dataset, QUICK, tmp_path, 2)
    Checkpoint(tmp_path).remove()
    assert {path.name for path in tmp_path.iterdir()} == mine


@pytest.mark.parametrize("name", ["state_0000002.npz", "frames_0000000_0000002.npz"])
def test_a_file_of_another_with_the_name_of_a_checkpoint_is_left_and_told(name, tmp_path):
    np.savez(tmp_path / name, positions=np.zeros(3))
    with pytest.raises(OutputError, match=f"{name}: the file has the name of a checkpoint's"):
        run(open_dataset("sim:room?frames=1&columns=300"), checkpoint=Checkpoint(tmp_path))
    Checkpoint(tmp_path).remove()
    assert (tmp_path / name).exists()


class Foreign:
    """Something that a checkpoint does not know."""


class Remembering:
    """A closer whose memory cannot be kept, at once or from the first keyframe on."""

    def __init__(self, *memory):
        self.memory = list(memory)

    def detect(self, keyframe, history):
        self.memory.append(Foreign())


def test_what_cannot_be_kept_is_told_before_the_first_sweep(tmp_path):
    dataset = ListDataset([RuntimeError("a sweep was read")])
    checkpoint = Checkpoint(tmp_path / "checkpoint")
    message = r"Remembering: .*Foreign cannot be in a checkpoint; .* mark the class"
    with pytest.raises(OutputError, match=message):
        run(dataset, loop_closer=Remembering(Foreign()), checkpoint=checkpoint)
    assert not checkpoint.folder.exists()


@pytest.mark.parametrize("end", [KeyboardInterrupt(), DatasetError("the bag breaks off")])
def test_what_cannot_be_kept_later_costs_checkpoints_but_no_results(end, tmp_path, caplog):
    scans = list(open_dataset("sim:room?frames=4&columns=400"))
    dataset, checkpoint = ListDataset([*scans, end]), Checkpoint(tmp_path / "c", seconds=0.0)
    options = {"checkpoint": checkpoint, "keep_partial": True}
    result = run(dataset, QUICK, loop_closer=Remembering(), **options)
    assert len(result.updates) == 4
    assert caplog.text.count("no checkpoint: ") == 1
    assert "Foreign cannot be in a checkpoint" in caplog.text


def test_other_parts_are_told(tmp_path):
    dataset = open_dataset("sim:room?frames=3&columns=300")
    stopped(dataset, QUICK, tmp_path, 2)
    resumed = Checkpoint(tmp_path, resume=True)
    with pytest.raises(
        OutputError, match="list of parts was extra_factors None, now it is extra_factors given"
    ):
        run(dataset, QUICK, checkpoint=resumed, extra_factors=lambda context: [])


def test_another_configuration_is_told(tmp_path):
    dataset, other = (
        open_dataset(f"sim:{world}?frames=3&columns=300") for world in ("room", "trees")
    )
    stopped(dataset, QUICK, tmp_path, 2)
    before, told = QUICK.solver.iterations, "another run: its configuration was solver.iterations"
    with pytest.raises(OutputError, match=f"{told} {before}, now it is solver.iterations 7; "):
        stopped(dataset, QUICK.changed("solver.iterations=7"), tmp_path, None)
    many = ["solver.iterations=7", "solver.min_matches=21", "imu.coupling=off"]
    many += ["loops.enabled=true", "map.edge_voxel=0.3", "map.plane_voxel=0.7"]
    with pytest.raises(OutputError, match=r"solver.iterations 7.* and 1 more; resume with"):
        stopped(dataset, QUICK.changed(*many), tmp_path, None)
    with pytest.raises(OutputError, match="another run: its data set was room"):
        stopped(other, QUICK, tmp_path, None)


@pytest.mark.parametrize("change", ["seed=3", "dropout=0.1", "gyro_noise=0.1"])
def test_other_options_of_the_loader_are_told(change, tmp_path):
    world = "sim:room?frames=4&columns=300"
    folder = tmp_path / "checkpoint"
    stopped(open_dataset(world), QUICK, folder, 2)
    with pytest.raises(
        (DatasetError, OutputError), match=r"of the run to go on with|checksum of IMU"
    ):
        stopped(open_dataset(f"{world}&{change}"), QUICK, folder, None)
    assert len(stopped(open_dataset(world), QUICK, folder, None).updates) == 4


def test_a_folder_that_moved_is_gone_on_with_and_another_of_its_name_is_not(tmp_path):
    for place, seed in (("monday", 0), ("tuesday", 1)):
        (tmp_path / place / "drive").mkdir(parents=True)
        for number, scan in enumerate(SimulatedWorld("room", frames=3, columns=300, seed=seed)):
            np.save(tmp_path / place / "drive" / f"{number}.npy", scan.points)
        (tmp_path / place / "drive" / "1.npy").write_text("damaged")

    def gone_on(place, at):
        folder = open_dataset(tmp_path / place / "drive")
        return stopped(folder, QUICK, tmp_path / "checkpoint", at)

    gone_on("monday", 2)
    with pytest.raises(DatasetError, match="sweep 0: expected that of the run to go on with"):
        gone_on("tuesday", None)
    (tmp_path / "monday").rename(tmp_path / "moved")
    assert len(gone_on("moved", None).updates) == 3


@pytest.mark.parametrize("keep", [slice(1, None), slice(1)], ids=["other sweeps", "too few"])
def test_other_sweeps_are_told(keep, tmp_path):
    scans = list(open_dataset("sim:room?frames=4&columns=300"))
    folder = tmp_path / "checkpoint"
    stopped(ListDataset(scans), QUICK, folder, 2)
    with pytest.raises(DatasetError, match="of the run to go on with"):
        stopped(ListDataset(scans[keep]), QUICK, folder, None, keep_partial=True)


@pytest.mark.parametrize(
    ("pattern", "damage"),
    [("state_*", "cut"), ("state_*", "other"), ("frames_*", "cut"), ("frames_*", "gone")],
)
def test_a_damaged_checkpoint_is_told(pattern, damage, tmp_path):
    dataset = open_dataset("sim:room?frames=3&columns=300")
    stopped(dataset, QUICK, tmp_path, 2)
    file = next(tmp_path.glob(pattern))
    file.write_bytes(file.read_bytes()[:1000] if damage == "cut" else b"not an archive")
    if damage == "gone":
        file.unlink()
    with pytest.raises(OutputError, match="cannot be read"):
        stopped(dataset, QUICK, tmp_path, None)


def test_a_run_goes_on_without_checkpoints_if_they_cannot_be_written(tmp_path, caplog):
    (tmp_path / "file").write_text("")
    checkpoint = Checkpoint(tmp_path / "file" / "checkpoint", seconds=0.0)
    assert (
        len(
            run(open_dataset("sim:room?frames=4&columns=300"), QUICK, checkpoint=checkpoint).updates
        )
        == 4
    )
    assert caplog.text.count("no checkpoint") == 1


def test_an_interrupt_in_the_middle_of_a_frame_keeps_the_last_whole_one(tmp_path):
    dataset = open_dataset("sim:room?frames=6&columns=300")
    frames = []

    def interrupting(context):
        frames.append(context.middle_stamp)
        if len(frames) == 3:
            raise KeyboardInterrupt
        return []

    checkpoint = Checkpoint(tmp_path, seconds=0.0)
    assert run(dataset, QUICK, extra_factors=interrupting, checkpoint=checkpoint).interrupted
    again = Checkpoint(tmp_path, resume=True)
    result = run(dataset, QUICK, extra_factors=interrupting, checkpoint=again)
    assert_same(result, run(dataset, QUICK, extra_factors=lambda context: []))


# -- from the command line ----------------------------------------------------------------------

RUN = ("run", "sim:room?frames=16&columns=240", "--no-plot", *QUICK_START, "--output")


def arrays(folder):
    with np.load(folder / "run.npz") as file:
        return {name: file[name] for name in file.files if not name.startswith("stage_")}


def test_killed_again_and_again_a_run_comes_to_the_same_end(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert loam(*RUN, whole).exit_code == 0
    again = [*RUN, killed, "--resume", "--checkpoint", "0.05"]
    for wanted in (4, 9):
        command = [sys.executable, "-m", "loam_gtsam.cli", *again]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while process.poll() is None and not reached(killed, wanted):
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert not (killed / "summary.json").exists()
    assert loam(*again).exit_code == 0
    assert not (killed / "checkpoint").exists()
    for name, array in arrays(whole).items():
        np.testing.assert_array_equal(arrays(killed)[name], array, name)
    for name in ("map.ply", "trajectory.tum", "trajectory_covariance.csv"):
        assert (killed / name).read_bytes() == (whole / name).read_bytes()


def reached(folder, frames):
    states = [path.stem for path in (folder / "checkpoint").glob("state_*.npz")]
    return any(int(name.removeprefix("state_")) >= frames for name in states)


def test_two_runs_at_a_time_do_not_share_a_checkpoint(tmp_path):
    world = SimulatedWorld("room", frames=2, columns=60)

    def second(number, update):
        if number == 0:
            with pytest.raises(OutputError, match="another run uses this folder"):
                run(world, checkpoint=Checkpoint(tmp_path / "here"))

    first = run(world, QUICK, checkpoint=Checkpoint(tmp_path / "here"), on_frame=second)
    assert len(first.updates) == 2
    assert not (tmp_path / "here").exists()  # for nothing was saved in it
    assert (
        len(run(world, QUICK, checkpoint=Checkpoint(tmp_path / "here", seconds=0.0)).updates) == 2
    )
    assert (
        len(run(world, QUICK, checkpoint=Checkpoint(tmp_path / "here", resume=True)).updates) == 2
    )
