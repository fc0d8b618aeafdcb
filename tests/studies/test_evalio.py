"""The pipeline for evalio, with the real evalio."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML
from support import layout_writers as write

from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import ConfigError, InputError, SweepMotion, Trajectory

pytest.importorskip("evalio")

from evalio import datasets, pipelines, stats
from evalio import types as ty
from evalio._cpp.types import VisOption
from support import evalio_room

from loam_gtsam import __version__
from loam_gtsam.studies.evalio_pipeline import LoamGtsam

ROOM = evalio_room.SimulatedRoom.shaken


def as_trajectory(poses: ty.Trajectory) -> Trajectory:
    matrices = np.array([pose.to_mat() for pose in poses.poses]).reshape(-1, 4, 4)
    return Trajectory(np.array([stamp.to_nsec() for stamp in poses.stamps], np.int64), matrices)


def imu_truth() -> Trajectory:
    truth = write.lidar_truth(**evalio_room.WORLD)
    return Trajectory(truth.stamps, truth.map_T_lidar @ np.linalg.inv(evalio_room.IMU_T_LIDAR))


def set_up(**params: object) -> LoamGtsam:
    pipeline, _ = ty.Experiment.from_pl_ds(LoamGtsam, ROOM, **params).setup()
    return pipeline


def estimates(pipeline: LoamGtsam, data: object = ROOM) -> Trajectory:
    """As evalio runs it: the last sweep ends the run, whatever comes after."""
    poses, sweeps = ty.Trajectory(), 0
    for measurement in data:  # type: ignore[attr-defined]
        if isinstance(measurement, ty.ImuMeasurement):
            pipeline.add_imu(measurement)
        else:
            pipeline.add_lidar(measurement)
            sweeps += 1
        for stamp, pose in pipeline.saved_estimates():
            poses.append(stamp, pose)
        if sweeps == write.COUNT:
            break
    return as_trajectory(poses)


def test_evalio_s_command_line_runs_it_and_its_poses_are_those_of_the_imu(tmp_path: Path) -> None:
    tests = Path(__file__).resolve().parents[1]
    paths = [str(tests.parent), str(tests), os.environ.get("PYTHONPATH", "")]
    command = [sys.executable, "-c", "from evalio.cli import app; app()"]
    options = ["run", "-p", "loam_gtsam", "-d", "simulated_room/shaken", "-o", str(tmp_path)]
    modules = {"EVALIO_CUSTOM": "loam_gtsam.studies.evalio_pipeline,support.evalio_room"}
    env = os.environ | {"PYTHONPATH": os.pathsep.join(paths)} | modules
    how = {"capture_output": True, "text": True, "timeout": 300, "cwd": tmp_path}
    done = subprocess.run(command + options, env=env, **how)
    assert done.returncode == 0, done.stderr
    poses = ty.Trajectory.from_file(tmp_path / "simulated_room" / "shaken" / "loam_gtsam.csv")
    assert isinstance(poses, ty.Trajectory), done.stdout + done.stderr
    assert poses.metadata.status is ty.ExperimentStatus.Complete
    assert poses.metadata.pipeline_version == __version__
    trajectory = as_trajectory(poses)
    # In order of their stamps a sweep comes before its IMU; the last two wait in vain.
    assert trajectory.stamps.tolist() == write.stamps(**evalio_room.WORLD).tolist()[:-2]
    error = absolute_error(trajectory, imu_truth())
    assert error.rmse < 0.02
    assert error.rotation_rmse_deg < 0.5
    truth = ty.Trajectory.from_file(tmp_path / "simulated_room" / "shaken" / "gt.csv")
    assert isinstance(truth, ty.Trajectory)
    stats.align(poses, truth, in_place=True)
    assert stats.ate(poses, truth).sse().trans < 0.05


def test_poses_are_the_same_whichever_way_sweeps_and_imu_are_interleaved() -> None:
    given = set_up()
    waited = estimates(given)
    # As a bag has it: a sweep after the samples taken during it. Then none is left over.
    later = sorted(
        [*evalio_room.lidar(), *evalio_room.imu()],
        key=lambda m: m.stamp.to_nsec() + 101_000_000 * isinstance(m, ty.LidarMeasurement),
    )
    received = estimates(set_up(), later)
    assert (len(waited), len(received)) == (write.COUNT - 2, write.COUNT)
    np.testing.assert_array_equal(received.map_T_lidar[:-2], waited.map_T_lidar)
    assert given._pipeline.mapper.last.sweep_motion is SweepMotion.GYRO


def test_an_imu_that_stops_holds_no_sweep_for_long() -> None:
    early = [m for m in evalio_room.imu() if m.stamp.to_nsec() < write.stamps()[1]]
    trajectory = estimates(set_up(), [*early, *evalio_room.lidar()])
    assert len(trajectory) == write.COUNT - 2
    assert absolute_error(trajectory, imu_truth()).rmse < 0.05


def test_without_imu_no_sweep_waits() -> None:
    for params, data in (({}, evalio_room.lidar()), ({"imu.coupling": "off"}, ROOM)):
        trajectory = estimates(set_up(**params), data)
        assert len(trajectory) == write.COUNT
        assert absolute_error(trajectory, imu_truth()).rmse < 0.05


def test_parameters_are_those_of_the_configuration() -> None:
    defaults = LoamGtsam.default_params()
    assert defaults["sensor.min_range"] == 0.5
    assert all(type(value) in (bool, int, float, str) for value in defaults.values())
    config = set_up(preset="loam", **{"solver.iterations": 7})._pipeline.config
    assert config.solver.iterations == 7
    assert config.imu.prior != defaults["imu.prior"]  # LOAM blends
    # What the data set says fills in what was left at its default.
    assert (config.sensor.min_range, config.sensor.max_range) == (0.7, 90.0)
    assert config.imu.gravity == pytest.approx(9.7)
    assert config.imu.gyro_noise == pytest.approx(3e-4)
    assert config.imu.lidar_R_imu_deg == pytest.approx((0.0, 0.0, -90.0))
    assert config.imu.lidar_t_imu == pytest.approx((0.2, 0.3, -0.1))
    assert set_up(**{"sensor.min_range": 1.5})._pipeline.config.sensor.min_range == 1.5
    assert LoamGtsam().set_params({"sensor.min_rage": 1.0}) == {"sensor.min_rage": 1.0}
    with pytest.raises(ConfigError, match=r"min_range: expected at least 0.0, got -1.0"):
        set_up(**{"sensor.min_range": -1.0})


def test_evalio_s_own_checks_of_parameters_accept_and_refuse() -> None:
    pipelines.register_pipeline(pipeline=LoamGtsam)
    sweep = {"pipeline": "loam_gtsam", "sweep": {"imu.weight": [0.01, 0.02]}}
    configs = pipelines.parse_config(sweep)
    assert [params["imu.weight"] for _, _, params in configs] == [0.01, 0.02]
    wrong = pipelines.parse_config({"pipeline": "loam_gtsam", "imu.weigth": 0.1})
    assert isinstance(wrong, pipelines.PipelineConfigError)


def test_the_experiments_of_the_documentation_name_what_evalio_has() -> None:
    page = Path(__file__).resolve().parents[2] / "docs/study/evalio.yaml"
    experiments = YAML(typ="safe").load(page)
    sequences = datasets.parse_config(experiments["datasets"])
    assert isinstance(sequences, list)
    assert len(sequences) > 60
    systems = pipelines.parse_config(experiments["pipelines"])
    assert isinstance(systems, list)
    assert [name for name, _, _ in systems][:2] == ["loam_gtsam", "lidar_only"]
    assert [params.get("imu.coupling") for _, _, params in systems][:2] == ["tight", "off"]


def test_features_and_map_are_shown_only_when_asked_for() -> None:
    quiet, shown = set_up(), set_up()
    shown.set_visualizing({VisOption.FEATURES, VisOption.MAP})
    assert set(quiet.map()) == {"edges", "planes"}
    estimates(quiet)
    estimates(shown)
    assert quiet.saved_features_matrix() == []
    features = shown.saved_features_matrix()
    assert len(features) == write.COUNT - 2
    assert features[0][1]["planes"].shape[1] == 3
    assert len(shown.saved_maps_matrix()) == write.COUNT - 2
    assert len(quiet.map()["planes"]) == len(shown.map()["planes"]) > 100


def test_a_sweep_before_initialize_is_an_error() -> None:
    with pytest.raises(InputError, match=r"initialize\(\) must come first"):
        LoamGtsam().add_lidar(next(evalio_room.lidar()))


def test_without_evalio_the_module_says_what_to_install() -> None:
    code = "import sys; sys.modules['evalio'] = None; import loam_gtsam.studies.evalio_pipeline"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert 'pip install "loam_gtsam[evalio]"' in done.stderr
