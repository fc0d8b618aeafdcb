"""What a newcomer hands over by mistake is answered by a sentence that says what was expected."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from loam_gtsam import (
    POSE_KEY,
    Config,
    GtsamSolver,
    ImuBuffer,
    InputError,
    Mapper,
    Pipeline,
    SimulatedWorld,
    absolute_error,
    align,
    checked_factor,
    extract_features,
    make_solver,
    open_dataset,
    optimize_graph,
    point_to_line_factor,
    run,
    write_graph,
)
from loam_gtsam.config import load_config
from loam_gtsam.io.checkpoint import Checkpoint
from loam_gtsam.io.run_files import write_run
from loam_gtsam.io.trajectories import write_kitti, write_tum
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.maps import localise, save_map
from loam_gtsam.registration.uncertainty.pose_errors import relative_covariance
from loam_gtsam.studies.comparison import compare_solvers
from loam_gtsam.studies.evaluation import nees
from loam_gtsam.types import DatasetError, PartError

WORLD = SimulatedWorld("room", frames=2, columns=400)
SWEEP = WORLD[0]
ONE = gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
X = np.array([1.0, 0.0, 0.0])
MIRROR = gtsam.Pose3(np.diag([1.0, 1.0, -1.0, 1.0]))


def row(_: gtsam.Values) -> tuple[np.ndarray, list[np.ndarray]]:
    return np.zeros(1), [np.zeros((1, 6))]


MISTAKES: list[tuple[Callable[[], object], str]] = [
    (lambda: make_solver("loam"), r"a SolverConfig, got str; .* preset\(\"loam\"\).solver"),
    (lambda: GtsamSolver(Config()), "expected a SolverConfig, got Config"),
    (lambda: run(WORLD, solver=GtsamSolver), r"as make_solver\(.*, got the class GtsamSolver"),
    (lambda: run(WORLD, solver="loam"), r"solver: .* make_solver\(config.solver\), got str"),
    (lambda: Mapper(Config(), "loam"), r"solver: .* make_solver\(config.solver\), got str"),
    (lambda: Mapper(extra_factors=[]), "extra_factors: expected a function, got list"),
    (lambda: Pipeline(features=5), "features: expected a function, got int"),
    (lambda: Pipeline(odometry=5), "odometry: .* got int without guess and remember"),
    (lambda: Pipeline(loop_closer=5), "loop_closer: expected an object, got int without detect"),
    (lambda: run(SimulatedWorld), "dataset: expected a Dataset, got the class SimulatedWorld"),
    (lambda: run(WORLD, workers=-1), "workers: expected a whole number, 0 or more"),
    (lambda: run(WORLD, workers=2.5), "workers: expected a whole number, 0 or more"),
    (lambda: WORLD.part(0.5), "part: expected a whole start of 0 or more, .* got start 0.5"),
    (lambda: localise(WORLD, "m.lgmap"), r"saved: .* got str; SavedMap\(path\) opens one"),
    (lambda: LoopClosure(None, None, gtsam.Pose3(), np.eye(6)), r"numbers of .* got NoneType"),
    (lambda: relative_covariance(X, X), "earlier: expected a MapUpdate, got ndarray"),
    (lambda: nees(None, WORLD.truth), r"updates: .* got NoneType; result\.updates of a run"),
    (lambda: compare_solvers(WORLD, ["gtsam"]), r"contenders\[0\]: .* a Contender, got str; make"),
    (lambda: open_dataset(None), "path: expected a path, got NoneType"),
    (lambda: load_config(None), "path: expected a path, got NoneType"),
    (lambda: Checkpoint(None), "folder: expected a path, got NoneType"),
    (lambda: write_run("out", WORLD), "result: expected a RunResult, got str; write_run"),
    (lambda: write_run(SimpleNamespace(updates=()), None), "directory: expected a path, got None"),
    (lambda: run(WORLD, checkpoint="kept"), r"checkpoint: .* Checkpoint\(folder\) makes one"),
    (lambda: extract_features(SWEEP, "loam"), "expected a Config, got str 'loam'"),
    (lambda: extract_features(SWEEP.points, Config()), "scan: expected a Scan, got ndarray"),
    (lambda: Mapper().register(SWEEP.points), "expected a Features, got ndarray; extract_features"),
    (lambda: Pipeline(imu=WORLD.imu), "expected an ImuBuffer, got ImuSamples; ImuBuffer"),
    (lambda: ImuBuffer(Config()), 'the section "imu" of a Config is one'),
    (lambda: ImuBuffer(Config().imu, np.zeros((5, 7))), "samples: expected an ImuSamples, got nd"),
    (lambda: checked_factor(0.1, [POSE_KEY], row), "noise: .* got float; .*Isotropic.Sigma"),
    (lambda: checked_factor(ONE, POSE_KEY, row), "keys: expected a list of keys, got int"),
    (lambda: checked_factor(ONE, [POSE_KEY], 3.0), "residual: expected a function, got float"),
    (lambda: point_to_line_factor(POSE_KEY, X, X, X, 0.1), "noise: .* got float"),
    (lambda: align(SWEEP.points, SWEEP.points, guess=np.eye(4)), r"gtsam.Pose3\(matrix\) makes"),
    (lambda: absolute_error(WORLD, WORLD.truth), "expected a Trajectory, got SimulatedWorld"),
    (lambda: optimize_graph("run.g2o"), r"a SavedGraph, got str; read_graph\(path\)"),
    (lambda: write_graph("run.g2o", WORLD), "saved: expected a SavedGraph, got SimulatedWorld"),
    (lambda: write_tum(WORLD.truth, "a.tum"), "a Trajectory, got str; the path comes first"),
    (lambda: write_kitti(WORLD.truth, "a.txt"), "a Trajectory, got str; the path comes first"),
    (lambda: save_map("a.lgmap", WORLD), "pipeline: expected that of a run, got SimulatedWorld"),
]


@pytest.mark.parametrize(("mistake", "answer"), MISTAKES, ids=[answer for _, answer in MISTAKES])
def test_a_mistake_is_an_input_error(mistake: Callable[[], object], answer: str) -> None:
    with pytest.raises(InputError, match=answer):
        mistake()


@pytest.mark.parametrize(
    ("guess", "twist", "answer"),
    [
        (np.eye(4), None, "guess: expected a gtsam.Pose3"),
        (MIRROR, None, "guess: expected a rotation .* determinant -1;"),
        (gtsam.Pose3(np.diag([2.0, 2.0, 2.0, 1.0])), None, "guess: .* is 3 off"),
        (None, np.zeros(3), r"twist: .*\(6,\)"),
    ],
)
def test_guess_and_twist_of_a_sweep(guess: object, twist: object, answer: str) -> None:
    mapper = Mapper()
    features = extract_features(SWEEP, mapper.config)
    with pytest.raises(InputError, match=answer):
        mapper.register(features, guess, twist)
    assert mapper.register(features, gtsam.Pose3(), np.zeros(6)).status == "first"


@pytest.mark.parametrize(
    ("name", "answer"),
    [("drive.bag", "its first bytes are not those of a bag; if"), ("one.pcd", "one sweep; give")],
)
def test_files_of_junk(tmp_path: Path, name: str, answer: str) -> None:
    (tmp_path / name).write_bytes(bytes(range(128, 256)) * 20)
    with pytest.raises(DatasetError, match=answer):
        open_dataset(tmp_path / name)


def test_a_front_end_that_is_called_otherwise_is_a_part_error():
    with pytest.raises(PartError, match=r"features of your own .* raised TypeError: extract_feat"):
        run(WORLD, features=extract_features)
