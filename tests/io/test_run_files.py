"""Files are exact, complete, and never half written."""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.trajectories import random_trajectory

from loam_gtsam.config import Config, load_config
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.io import run_files as export
from loam_gtsam.io.trajectories import write_kitti, write_tum
from loam_gtsam.pipeline import RunResult
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import (
    FloatArray,
    FrameStatus,
    InputError,
    MapUpdate,
    Trajectory,
    Uncertainty,
)


def symmetric() -> FloatArray:
    """Every entry of its upper triangle is another one."""
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = np.arange(1.0, 22.0)
    return upper + np.triu(upper, 1).T


def uncertainty_of(number: int, trajectory: Trajectory) -> Uncertainty:
    own = number * np.eye(6)
    follows = None if number == 1 else int(trajectory.stamps[number - 1])
    return Uncertainty(own, 0.1 * own, follows, 10.0 * own, 0.3, 100.0 * number)


def make_result(count: int = 5, error: Exception | None = None) -> RunResult:
    trajectory = random_trajectory(count)
    updates = [
        MapUpdate(
            stamp=int(stamp),
            map_T_lidar=gtsam.Pose3(pose),
            status=FrameStatus.OK if number else FrameStatus.FIRST,
            message="" if number else "the map starts here",
            n_edges=number,
            n_plane_matches=7 * number,
            error_after=0.5 * number,
            information=np.diag(np.arange(1.0, 7.0)),
            covariance=np.full((6, 6), np.nan) if number == 0 else number * symmetric(),
            uncertainty=None if number == 0 else uncertainty_of(number, trajectory),
            twist=np.full(6, float(number)),
            timings={"read": 0.001} | ({"solve": 0.002} if number else {}),
        )
        for number, (stamp, pose) in enumerate(
            zip(trajectory.stamps, trajectory.map_T_lidar, strict=True)
        )
    ]
    rng = np.random.default_rng(1)
    return RunResult(
        config=Config(),
        updates=tuple(updates),
        edge_points=rng.normal(size=(11, 3)),
        plane_points=rng.normal(size=(23, 3)),
        map_stats={"edges": {"points": 11}},
        interrupted=False,
        error=error,
    )


def read_ply(path: Path) -> tuple[list[str], np.ndarray]:
    """An independent reader of the properties that are written."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    kinds = {"double": "<f8", "uchar": "u1"}
    fields = [
        (words[2], kinds[words[1]])
        for words in (line.split() for line in lines)
        if words[0] == "property"
    ]
    return lines, np.frombuffer(body, np.dtype(fields))


def test_evo_finds_the_same_ate_in_the_files_of_a_run(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    metrics = pytest.importorskip("evo.core.metrics")
    sync = pytest.importorskip("evo.core.sync")
    result = make_result(20)
    export.write_run(result, tmp_path)
    moved = Rotation.random(random_state=3).as_matrix()
    truth = result.trajectory.map_T_lidar.copy()
    truth[:, :3, 3] += np.random.default_rng(4).normal(0.0, 2.0, (20, 3))
    truth[:, :3] = moved @ truth[:, :3]
    reference = Trajectory(result.trajectory.stamps, truth)
    write_tum(tmp_path / "truth.tum", reference)
    write_kitti(tmp_path / "truth.txt", reference)
    expected = absolute_error(result.trajectory, reference).rmse
    assert 1.0 < expected < 5.0
    tum = file_interface.read_tum_trajectory_file
    kitti = file_interface.read_kitti_poses_file
    pairs = (
        sync.associate_trajectories(
            tum(str(tmp_path / "truth.tum")), tum(str(tmp_path / "trajectory.tum")), max_diff=1e-6
        ),
        (kitti(str(tmp_path / "truth.txt")), kitti(str(tmp_path / "trajectory_kitti.txt"))),
    )
    for theirs, ours in pairs:
        assert ours.num_poses == 20
        ours.align(theirs)
        metric = metrics.APE(metrics.PoseRelation.translation_part)
        metric.process_data((theirs, ours))
        rmse = metric.get_statistic(metrics.StatisticsType.rmse)
        assert rmse == pytest.approx(expected, rel=1e-6)


def test_npz_holds_every_frame_without_pickle(tmp_path):
    updates = make_result(4).updates
    export.write_npz(tmp_path / "run.npz", updates)
    with np.load(tmp_path / "run.npz", allow_pickle=False) as data:
        arrays = dict(data)
    assert arrays["stamps"].dtype == np.int64
    assert arrays["stamps"].tolist() == [u.stamp for u in updates]
    assert arrays["status"].tolist() == ["first", "ok", "ok", "ok"]
    assert arrays["messages"][0] == "the map starts here"
    assert arrays["n_plane_matches"].tolist() == [0, 7, 14, 21]
    assert arrays["error_after"].tolist() == [0.0, 0.5, 1.0, 1.5]
    assert arrays["stage_names"].tolist() == ["read", "solve"]
    np.testing.assert_array_equal(np.isnan(arrays["stage_seconds"]), [[0, 1], *[[0, 0]] * 3])
    np.testing.assert_array_equal(arrays["map_T_lidar"][2], updates[2].map_T_lidar.matrix())
    np.testing.assert_array_equal(arrays["twists"][2], updates[2].twist)
    np.testing.assert_array_equal(arrays["covariances"][2], 2.0 * symmetric())
    np.testing.assert_allclose(
        arrays["raw_covariances"][1] @ arrays["information"][1], np.eye(6), atol=1e-12
    )
    np.testing.assert_array_equal(arrays["own_covariances"][3], 3.0 * np.eye(6))
    np.testing.assert_array_equal(arrays["shared_covariances"][2], 0.2 * np.eye(6))
    np.testing.assert_array_equal(arrays["drift_covariances"][1], 10.0 * np.eye(6))
    assert arrays["follows"].tolist() == [-1, -1, updates[1].stamp, updates[2].stamp]
    np.testing.assert_array_equal(arrays["effective_matches"], [np.nan, 100.0, 200.0, 300.0])
    np.testing.assert_array_equal(arrays["residual_variances"], [np.nan, 0.3, 0.3, 0.3])
    for name in ("", "raw_", "own_", "shared_", "drift_"):
        assert np.isnan(arrays[f"{name}covariances"][0]).all()


def test_covariances_stand_beside_the_poses(tmp_path):
    """The same lines as the trajectory; the upper triangle row by row; empty if not solved."""
    updates = list(make_result(4).updates)
    bad = MapUpdate(updates[2].stamp, gtsam.Pose3(), FrameStatus.BAD_STAMP)
    export.write_covariances(tmp_path / "c.csv", [*updates[:3], bad, updates[3]])
    header, *lines = (tmp_path / "c.csv").read_text("utf-8").splitlines()
    names = header.split(",")
    assert names[:5] == ["stamp_s", "status", "rx_rx", "rx_ry", "rx_rz"]
    assert names[-3:] == ["y_y", "y_z", "z_z"]
    assert len(lines) == 4
    assert lines[0].split(",")[1:] == ["first", *[""] * 21]
    values = lines[2].split(",")
    seconds, nanoseconds = divmod(updates[2].stamp, 10**9)
    assert values[:2] == [f"{seconds}.{nanoseconds:09d}", "ok"]
    row = dict(zip(names[2:], map(float, values[2:]), strict=True))
    assert row["rx_rx"] == 2.0 * symmetric()[0, 0]
    assert row["rx_z"] == 2.0 * symmetric()[0, 5]
    assert row["y_z"] == 2.0 * symmetric()[4, 5]


def test_ply_is_exact_and_tells_edges_from_planes(tmp_path):
    edges = np.array([[6_500_000.123456, 1.0, 2.0]])
    planes = np.array([[0.0, 0.1, 0.2], [3.0, 4.0, 5.0]])
    export.write_ply(tmp_path / "map.ply", edges, planes)
    header, points = read_ply(tmp_path / "map.ply")
    assert header[0] == "ply"
    assert "element vertex 3" in header
    xyz = np.stack([points["x"], points["y"], points["z"]], axis=1)
    np.testing.assert_array_equal(xyz, np.concatenate((edges, planes)))
    assert points["label"].tolist() == [0, 1, 1]
    colours = np.stack([points["red"], points["green"], points["blue"]], axis=1)
    np.testing.assert_array_equal(colours[0], export.EDGE_COLOUR)
    np.testing.assert_array_equal(colours[1:], [export.PLANE_COLOUR] * 2)


def test_ply_refuses_other_shapes(tmp_path):
    with pytest.raises(InputError, match=r"planes: expected \(N, 3\) floats, got shape \(4, 2\)"):
        export.write_ply(tmp_path / "map.ply", np.zeros((1, 3)), np.zeros((4, 2)))
    assert list(tmp_path.iterdir()) == []


def test_write_run_writes_all_files(tmp_path):
    result = make_result()
    export.write_run(
        result, tmp_path / "a" / "b", dataset="test", extra={"ate": np.float64("nan"), "n": 3}
    )
    folder = tmp_path / "a" / "b"
    assert sorted(p.name for p in folder.iterdir()) == sorted(export.RUN_FILES)
    assert load_config(folder / "config.yaml") == result.config
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["frames"] == 5
    assert summary["status_counts"] == {"first": 1, "ok": 4}
    assert (summary["ate"], summary["n"]) == (None, 3)
    assert summary["error"] is None
    assert summary["path_length_m"] == pytest.approx(result.trajectory.path_length)
    assert "incomplete" not in (folder / "trajectory.tum").read_text()


def test_a_run_that_ended_early_says_so(tmp_path):
    export.write_run(make_result(error=ValueError("broken")), tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text())["error"] == "ValueError: broken"
    assert "# incomplete" in (tmp_path / "trajectory.tum").read_text()


def test_a_run_without_frames_can_be_written(tmp_path):
    export.write_run(make_result(0), tmp_path)
    assert len(read_tum(tmp_path / "trajectory.tum")) == 0
    with np.load(tmp_path / "run.npz") as data:
        assert data["covariances"].shape == (0, 6, 6)


def test_writing_twice_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        export.write_run(make_result(), tmp_path / name, dataset="x")
    for name in export.RUN_FILES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_what_an_imu_did_is_written_frame_by_frame_and_summed_up(tmp_path):
    from loam_gtsam.datasets.sim.world import SimulatedWorld
    from loam_gtsam.pipeline import run

    world = SimulatedWorld("room", frames=3, columns=450)
    result = run(world)
    export.write_run(result, tmp_path / "with")
    with np.load(tmp_path / "with/run.npz") as arrays:
        assert arrays["sweep_motions"].tolist() == ["gyro"] * 3
        assert arrays["tilt_priors"].tolist() == ["none", "equivalent", "equivalent"]
    imu = json.loads((tmp_path / "with/summary.json").read_text())["imu"]
    assert imu["samples"] == len(world.imu.stamps)
    assert imu["rate_hz"] == pytest.approx(200.0)
    assert (imu["orientation"], imu["gaps"], imu["problems"]) == ("ahrs", 0, [])
    assert imu["level"]["source"] == "still"
    assert imu["level"]["roll_deg"] == pytest.approx(np.degrees(result.imu.level.roll))
    assert imu["level"]["map_up"] == [0.0, 0.0, 1.0]
    assert imu["gyro_bias_rad_s"] == result.imu.gyro_bias.tolist()
    assert imu["gyro_trusted"] is True
    assert imu["tilt_priors"] == {"none": 1, "equivalent": 2}
    assert imu["sweep_motions"] == {"gyro": 3}
    export.write_run(make_result(), tmp_path / "without")
    assert json.loads((tmp_path / "without/summary.json").read_text())["imu"] is None
    with np.load(tmp_path / "without/run.npz") as arrays:
        assert set(arrays["sweep_motions"].tolist()) == {"none"}
