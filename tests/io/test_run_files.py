"""Results are exact and complete, and other programs read them."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.quick import QUICK

from loam_gtsam.config import Config, load_config, preset
from loam_gtsam.datasets.arrays import ArrayDataset
from loam_gtsam.datasets.decode.aiding import GnssFixes
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.io import run_files
from loam_gtsam.io.read_run import read_updates
from loam_gtsam.io.trajectories import write_kitti, write_tum
from loam_gtsam.pipeline import Pipeline, RunResult, run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import (
    DatasetError,
    FrameStatus,
    InputError,
    MapUpdate,
    OutputError,
    SweepFault,
    SweepMotion,
    Trajectory,
)

CONTRARY = "fits better as if no IMU had been there: one of the two is wrong"
FRAMES = 8
WORLD = SimulatedWorld("room", frames=FRAMES, columns=450)


@pytest.fixture(scope="module")
def result() -> RunResult:
    return run(WORLD, QUICK)


def read_ply(path: Path) -> tuple[list[str], np.ndarray]:
    """An independent reader of the properties that are written."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    kinds = {"double": "<f8", "uchar": "u1"}
    properties = [line.split() for line in lines if line.startswith("property")]
    fields = [(name, kinds[kind]) for _, kind, name in properties]
    return lines, np.frombuffer(body, np.dtype(fields))


def test_evo_finds_the_same_ate_in_the_files_of_a_run(result, tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    metrics = pytest.importorskip("evo.core.metrics")
    sync = pytest.importorskip("evo.core.sync")
    run_files.write_run(result, tmp_path)
    truth = result.trajectory.map_T_lidar.copy()
    truth[:, :3, 3] += np.random.default_rng(4).normal(0.0, 2.0, (FRAMES, 3))
    truth[:, :3] = Rotation.random(random_state=3).as_matrix() @ truth[:, :3]
    reference = Trajectory(result.trajectory.stamps, truth)
    write_tum(tmp_path / "truth.tum", reference)
    write_kitti(tmp_path / "truth.txt", reference)
    expected = absolute_error(result.trajectory, reference).rmse
    assert 1.0 < expected < 5.0
    assert "# poses: at the start of each sweep" in (tmp_path / "trajectory.tum").read_text()
    tum = file_interface.read_tum_trajectory_file
    kitti = file_interface.read_kitti_poses_file
    pairs = (
        sync.associate_trajectories(
            tum(str(tmp_path / "truth.tum")), tum(str(tmp_path / "trajectory.tum")), max_diff=1e-6
        ),
        (kitti(str(tmp_path / "truth.txt")), kitti(str(tmp_path / "trajectory_kitti.txt"))),
    )
    for theirs, ours in pairs:
        assert ours.num_poses == FRAMES
        ours.align(theirs)
        metric = metrics.APE(metrics.PoseRelation.translation_part)
        metric.process_data((theirs, ours))
        rmse = metric.get_statistic(metrics.StatisticsType.rmse)
        assert rmse == pytest.approx(expected, rel=1e-6)


def test_npz_holds_every_frame_without_pickle(result, tmp_path):
    first, *_, last = updates = result.updates
    run_files.write_npz(tmp_path / "run.npz", updates)
    with np.load(tmp_path / "run.npz", allow_pickle=False) as data:
        arrays = dict(data)
    assert {len(array) for name, array in arrays.items() if name != "stage_names"} == {FRAMES}
    assert arrays["stamps"].dtype == np.int64
    assert arrays["stamps"].tolist() == [u.stamp for u in updates]
    assert arrays["status"].tolist() == ["first"] + ["ok"] * (FRAMES - 1)
    assert arrays["messages"].tolist() == [u.message for u in updates]
    assert arrays["sweep_motions"].tolist() == ["gyro"] * FRAMES
    assert arrays["tilt_priors"].tolist() == ["none"] + ["equivalent"] * (FRAMES - 1)
    assert arrays["follows"].tolist()[-2:] == [u.stamp for u in updates[-3:-1]]
    assert arrays["follows"][0] == run_files.NO_STAMP
    np.testing.assert_array_equal(arrays["map_T_lidar"][-1], last.map_T_lidar.matrix())
    known = last.uncertainty
    same = ("information", "localizability", "axis_localizability", "directions", "n_edges",
            "direction_information", "n_planes", "n_edge_matches", "n_plane_matches",
            "iterations", "solver_iterations", "error_before", "error_after")  # fmt: skip
    for name, value in {
        "twists": last.twist, "covariances": last.covariance,
        "raw_covariances": last.raw_covariance, "own_covariances": known.own,
        "shared_covariances": known.shared, "drift_covariances": known.drift,
        "residual_variances": known.residual_variance,
        "effective_matches": known.effective_matches,
        **{name: getattr(last, name) for name in same},
    }.items():  # fmt: skip
        np.testing.assert_array_equal(arrays[name][-1], value, name)
    for name in ("", "raw_", "own_", "shared_", "drift_"):
        assert np.isnan(arrays[f"{name}covariances"][0]).all()
    stages = dict(zip(arrays["stage_names"], arrays["stage_seconds"].T, strict=True))
    assert stages["solve"][-1] == last.timings["solve"]
    not_run = last.timings.keys() - first.timings.keys()
    assert not_run
    assert np.isnan([stages[name][0] for name in not_run]).all()


@pytest.mark.parametrize(
    ("column", "value"),
    [("status", np.array(["fine"])), ("twists", np.zeros(0)), ("map_T_lidar", np.zeros((1, 3)))],
)
def test_a_damaged_run_is_refused(result, tmp_path, column, value):
    path = tmp_path / "run.npz"
    run_files.write_npz(path, result.updates)
    whole = path.read_bytes()
    with np.load(path) as file:
        columns = {name: file[name] for name in file.files}
    np.savez(path, **{**columns, column: value})
    with pytest.raises(DatasetError, match=r"run\.npz: expected the run\.npz of a finished run"):
        read_updates(path)
    rng = np.random.default_rng(0)
    for at in rng.integers(0, len(whole), 40).tolist():
        path.write_bytes(whole[:at] + rng.bytes(8) + whole[at + 8 :])
        with suppress(DatasetError):
            read_updates(path)


def test_the_frames_of_a_saved_run_are_those_of_the_run(result, tmp_path):
    updates = list(result.updates)
    assert updates[1].uncertainty is not None
    told = replace(updates[1].uncertainty, in_doubt=not updates[1].uncertainty.in_doubt)
    updates[1] = replace(updates[1], uncertainty=told)
    run_files.write_npz(tmp_path / "run.npz", updates)
    for here, there in zip(updates, read_updates(tmp_path), strict=True):
        poses = ("map_T_lidar", "map_T_middle")
        for name in {item.name for item in fields(MapUpdate)} - {"uncertainty", "timings", *poses}:
            if name not in ("fault", "n_not_finite"):  # the file does not have them
                np.testing.assert_array_equal(getattr(there, name), getattr(here, name), name)
        for name in poses:
            one, other = (getattr(u, name) or u.map_T_lidar for u in (here, there))
            np.testing.assert_array_equal(one.matrix(), other.matrix())
        assert (there.uncertainty is None) == (here.uncertainty is None)
        if there.uncertainty is not None and here.uncertainty is not None:
            assert there.uncertainty.in_doubt is here.uncertainty.in_doubt
        assert there.timings == here.timings
    assert there.n_plane_matches > 100


def test_a_run_of_before_accelerations_and_doubts_were_written_is_read(result, tmp_path):
    path = tmp_path / "run.npz"
    run_files.write_npz(path, result.updates)
    with np.load(path) as file:
        columns = {name: file[name] for name in file.files}
    del columns["accelerations"], columns["in_doubt"]
    np.savez(path, **columns)
    for here, there in zip(result.updates, read_updates(path), strict=True):
        assert np.array_equal(there.twist, here.twist)
        assert not there.acceleration.any()
        assert there.uncertainty is None or there.uncertainty.in_doubt is False


def test_covariances_stand_beside_the_poses(result, tmp_path):
    """The same lines as the trajectory; the upper triangle row by row; empty if not solved."""
    updates = list(result.updates)
    bad = MapUpdate(updates[2].stamp, gtsam.Pose3(), FrameStatus.BAD_STAMP)
    run_files.write_covariances(tmp_path / "c.csv", [*updates[:3], bad, *updates[3:]])
    header, *lines = (tmp_path / "c.csv").read_text("utf-8").splitlines()
    names = header.split(",")
    assert names[:5] == ["stamp_s", "status", "rx_rx", "rx_ry", "rx_rz"]
    assert names[-3:] == ["y_y", "y_z", "z_z"]
    assert len(lines) == FRAMES
    assert lines[0].split(",")[1:] == ["first", *[""] * 21]
    values = lines[2].split(",")
    seconds, nanoseconds = divmod(updates[2].stamp, 10**9)
    assert values[:2] == [f"{seconds}.{nanoseconds:09d}", "ok"]
    row = dict(zip(names[2:], map(float, values[2:]), strict=True))
    for name, entry in {"rx_rx": (0, 0), "rx_z": (0, 5), "y_z": (4, 5)}.items():
        assert row[name] == pytest.approx(updates[2].covariance[entry], rel=1e-8)


def test_ply_is_exact_and_tells_edges_from_planes(tmp_path):
    edges = np.array([[6_500_000.123456, 1.0, 2.0]])
    planes = np.array([[0.0, 0.1, 0.2], [3.0, 4.0, 5.0]])
    run_files.write_ply(tmp_path / "map.ply", edges, planes)
    header, points = read_ply(tmp_path / "map.ply")
    assert (header[0], "element vertex 3" in header) == ("ply", True)
    xyz, colours = (np.stack([points[name] for name in names], axis=1)
                    for names in (("x", "y", "z"), ("red", "green", "blue")))  # fmt: skip
    np.testing.assert_array_equal(xyz, np.concatenate((edges, planes)))
    assert points["label"].tolist() == [0, 1, 1]
    plane = run_files.PLANE_COLOUR
    np.testing.assert_array_equal(colours, [run_files.EDGE_COLOUR, plane, plane])


def test_ply_refuses_other_shapes(tmp_path):
    with pytest.raises(InputError, match=r"planes: expected \(N, 3\) floats, got shape \(4, 2\)"):
        run_files.write_ply(tmp_path / "map.ply", np.zeros((1, 3)), np.zeros((4, 2)))
    assert list(tmp_path.iterdir()) == []


def test_results_that_fail_half_way_have_no_summary_of_earlier_ones(result, tmp_path, monkeypatch):
    def full(*_):
        raise OutputError("no space")

    run_files.write_run(result, tmp_path)
    assert (tmp_path / "summary.json").exists()
    monkeypatch.setattr(run_files, "write_ply", full)
    with pytest.raises(OutputError, match="no space"):
        run_files.write_run(result, tmp_path)
    assert not (tmp_path / "summary.json").exists()


def test_write_run_writes_all_files(result, tmp_path):
    folder = tmp_path / "a" / "b"
    run_files.write_run(result, folder, dataset="test", extra={"ate": np.float64("nan"), "n": 3})
    assert sorted(p.name for p in folder.iterdir()) == sorted(run_files.RUN_FILES)
    assert load_config(folder / "config.yaml") == result.config
    assert len(read_tum(folder / "trajectory.tum")) == FRAMES
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["frames"], summary["status_counts"]) == (FRAMES, {"first": 1, "ok": FRAMES - 1})
    assert (summary["ate"], summary["n"], summary["error"]) == (None, 3, None)
    assert summary["path_length_m"] == pytest.approx(result.trajectory.path_length)
    known = [np.sqrt(np.trace(u.covariance[3:, 3:])) for u in result.updates if u.status.solved]
    sigmas = summary["position_sigma_m"]
    assert sigmas == {"median": np.median(known), "largest": np.max(known)}
    assert "incomplete" not in (folder / "trajectory.tum").read_text()


def test_a_run_that_ended_before_its_first_frame_can_be_written_and_says_so(result, tmp_path):
    run_files.write_run(replace(result, updates=(), error=ValueError("broken")), tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text())["error"] == "ValueError: broken"
    assert "# incomplete" in (tmp_path / "trajectory.tum").read_text()
    assert len(read_tum(tmp_path / "trajectory.tum")) == 0
    with np.load(tmp_path / "run.npz") as data:
        assert data["covariances"].shape == (0, 6, 6)


def test_writing_twice_gives_the_same_bytes(result, tmp_path):
    for name in ("a", "b"):
        run_files.write_run(result, tmp_path / name, dataset="x")
    for name in run_files.RUN_FILES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_what_an_imu_did_is_summed_up(result):
    imu = run_files.summarise(result)["imu"]
    expected = {
        "samples": len(WORLD.imu.stamps), "rate_hz": pytest.approx(200.0), "orientation": "ahrs",
        "gaps": 0, "problems": [], "gyro_bias_rad_s": result.imu.gyro_bias.tolist(),
        "gyro_trusted": True, "gyro_left_out": 0, "disputed": 0, "sweep_motions": {"gyro": FRAMES},
        "tilt_priors": {"none": 1, "equivalent": FRAMES - 1},
    }  # fmt: skip
    assert {name: imu[name] for name in expected} == expected
    assert imu["level"]["source"] == "still"
    np.testing.assert_allclose(imu["level"]["map_up"], [0.0, 0.0, 1.0], atol=0.02)
    assert imu["level"]["roll_deg"] == pytest.approx(np.degrees(result.imu.level.roll))
    assert run_files.summarise(replace(result, imu=None))["imu"] is None


def test_what_is_in_doubt_is_said_in_python_and_in_the_summary(result, tmp_path):
    assert result.notes == ()
    late = replace(WORLD.imu, stamps=WORLD.imu.stamps + 10**15)
    apart = run(ArrayDataset(list(WORLD), imu=late, sensor=WORLD.sensor))
    assert "IMU: no orientation at 7 of 8 sweeps: gaps" in apart.notes[0]
    assert apart.imu.problems == apart.notes
    lost = [replace(update, status=FrameStatus.LOST) for update in apart.updates[2:]]
    doubted = replace(apart, updates=(*apart.updates[:2], *lost))
    assert doubted.notes[1].startswith("DO NOT TRUST THIS RUN: 6 of 8 poses (75 %)")
    run_files.write_run(doubted, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["notes"] == list(doubted.notes)
    assert summary["imu"]["problems"] == list(apart.imu.problems)


def test_what_a_part_of_ones_own_failed_in_is_not_put_down_to_the_scans(result):
    wrong = {"status": FrameStatus.UNUSABLE_SCAN, "fault": SweepFault.EMPTY}
    of_the_scan = [replace(update, **wrong) for update in result.updates[2:]]
    of_the_part = [replace(update, fault=SweepFault.PART_FAILED) for update in of_the_scan]
    for updates, advice in ((of_the_scan, "inspect"), (of_the_part, "a part of your own raised")):
        (note,) = replace(result, updates=(*result.updates[:2], *updates)).notes
        assert advice in note.rpartition(";")[2]


def test_poses_that_still_move_are_a_note_but_with_a_loam_whose_iterations_are_two(result):
    moving = tuple(replace(one, status=FrameStatus.NOT_CONVERGED) for one in result.updates)
    (note,) = replace(result, updates=moving).notes
    assert "8 of 8 poses still moved" in note
    assert replace(result, updates=moving, config=preset("aloam")).notes == ()


def test_samples_that_come_after_their_sweep_are_a_note(result):
    def noted(result):
        return [note for note in result.notes if "did not cover" in note]

    alone = [
        replace(update, sweep_motion=SweepMotion.CONSTANT_VELOCITY) for update in result.updates
    ]
    late = replace(result, updates=tuple(alone))
    (note,) = noted(late)
    assert note.startswith("IMU: its samples did not cover 7 of 7 sweeps when these were mapped")
    assert not noted(replace(late, config=Config().changed("deskew.rotation=constant_velocity")))
    assert not noted(replace(late, imu=replace(result.imu, gyro_left_out=2)))
    assert not noted(replace(late, imu=None))
    contrary = [replace(update, message=f"moved; {CONTRARY}") for update in alone]
    assert not noted(replace(late, updates=tuple(contrary)))
    pipeline = Pipeline(QUICK, imu=ImuBuffer(QUICK.imu))
    (note,) = noted(pipeline.result([pipeline.process(WORLD[i]) for i in range(2)]))
    assert "1 of 1" in note


def test_sweeps_that_fit_better_without_the_imu_are_another_note(result):
    """Samples that cover them all were said to be missing."""

    def noted(result):
        return [note for note in result.notes if note.startswith("IMU: ")]

    alone = replace(result.updates[-1], sweep_motion=SweepMotion.CONSTANT_VELOCITY)
    contrary = replace(result, updates=(*result.updates[:-1], replace(alone, message=CONTRARY)))
    (note,) = noted(contrary)
    assert note.startswith("IMU: 1 of 7 sweeps fitted the map better without it: one of the two")
    assert not noted(replace(contrary, imu=replace(result.imu, gyro_left_out=2)))
    # Where a sweep that fits better without the IMU was lost, or turned by it again, none is.
    for one in (replace(alone, status=FrameStatus.LOST), result.updates[-1]):
        updates = *result.updates[:-1], replace(one, message=CONTRARY)
        assert not noted(replace(result, updates=updates))


@pytest.mark.parametrize(
    ("message", "why"),
    [
        ("relocalised, moved by 9.00 m and 0.1 degrees", "found where no motion had led"),
        ("", "other first motions fit as well"),
    ],
)
def test_since_when_and_why_positions_are_vague_is_said(result, message, why):
    vague = np.diag([0.0, 0.0, 0.0, 4.0, 0.0, 0.0])
    updates = [
        replace(one, covariance=one.covariance + (number >= 5) * vague, message="")
        for number, one in enumerate(result.updates)
    ]
    updates[5] = replace(updates[5], message=message)
    (note,) = replace(result, updates=tuple(updates)).notes
    assert note.startswith("positions are told to 2 m at worst (sigma), to most of it from frame 5")
    assert why in note


def test_fixes_that_were_asked_for_and_not_used_are_a_note(result):
    fixes = GnssFixes(WORLD.truth.stamps, [[47.5, 8.5, 450.0]] * len(WORLD.truth))
    config = Config().changed("aiding.gnss=true")
    world = ArrayDataset(list(WORLD), gnss=fixes, sensor=WORLD.sensor)
    (note,) = run(world, config).notes
    assert note.startswith("fixes of the GNSS receiver not used: 0 keyframes have a fix")


def test_degenerate_poses_put_a_run_in_doubt_only_if_they_are_vague(result):
    def distrusted(axis, variance):
        told = np.full(6, 1e-6)
        told[axis] = variance
        others = [
            replace(update, status=FrameStatus.DEGENERATE, covariance=np.diag(told))
            for update in result.updates[1:]
        ]
        (note,) = replace(result, updates=(result.updates[0], *others)).notes
        assert "7 of 8 poses (88 %) are not fixed by their scans (7 degenerate)" in note
        return note.startswith("DO NOT TRUST")

    assert not distrusted(4, 0.09**2)
    assert distrusted(4, 0.11**2)  # a hundredth of ten metres
    assert distrusted(2, 0.011**2)  # rad
    assert distrusted(4, np.nan)
