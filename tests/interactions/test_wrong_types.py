"""Every argument of every public function, replaced by what it cannot be, in turn.

The call works as it is; with one argument replaced it works too, or raises an error of the package,
which says what was expected. Nothing else leaves it.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from support.quick import QUICK

import loam_gtsam as api
from loam_gtsam.datasets.sim import disturbances
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.io.frame_table import to_dataframe
from loam_gtsam.io.read_run import read_updates
from loam_gtsam.io.run_files import write_covariances, write_npz
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.maps.cleaning import clean_map
from loam_gtsam.maps.localizer import localise
from loam_gtsam.maps.map_file import SavedMap, save_map
from loam_gtsam.refine.runs import refine_run, run_points
from loam_gtsam.ros.live import LiveMapper
from loam_gtsam.studies.evaluation import matched_truth, nees, relative_error

WORLD = api.SimulatedWorld("room", frames=5, columns=400)
CONFIG = QUICK.changed("map.window=[5,5,5]")
RESULT = api.run(WORLD, CONFIG)
SWEEP, UPDATES, TRUTH = WORLD[0], RESULT.updates, WORLD.truth
FEATURES = api.extract_features(SWEEP, CONFIG)
MAPPER = api.Mapper(CONFIG)
MAPPER.register(FEATURES)
MATCHES = api.associate(
    FEATURES.edges,
    FEATURES.planes,
    gtsam.Pose3(),
    MAPPER.maps.edges,
    MAPPER.maps.planes,
    CONFIG.matching,
)
GRAPH = api.PoseGraph()
BUFFER, FIRST = ImuBuffer(CONFIG.imu, WORLD.imu), int(WORLD.imu.stamps[0])
OUTLIERS, BOXES = disturbances.Outliers(), disturbances.MovingObjects()
LIVE = LiveMapper(CONFIG, imu=True)
SIGMA = gtsam.noiseModel.Isotropic.Sigma
WRONG: tuple[Any, ...] = (
    None, "abc", 7, -1.5, float("nan"), object(), [1, 2], {"a": 1}, np.zeros((2, 2)),
    np.array(["a"]), api.Config, CONFIG, RESULT, UPDATES[0], GRAPH, TRUTH, SWEEP,
)  # fmt: skip


def row(_: gtsam.Values) -> tuple[np.ndarray, list[np.ndarray]]:
    return np.zeros(1), [np.zeros((1, 6))]


def register(**given: Any) -> api.MapUpdate:
    return api.Mapper().register(**given)


def skipped(**given: Any) -> list[Any]:
    return list(disturbances.SkippedAhead(**given))


def kidnapped(**given: Any) -> api.Scan:
    return disturbances.Kidnapped(**given)[3]


def disturbed(**given: Any) -> list[Any]:
    return list(disturbances.Disturbed(**given))


def outliers(**given: Any) -> api.Scan:
    return disturbances.Outliers(**given).apply(0, SWEEP)


def dropouts(**given: Any) -> api.Scan:
    return disturbances.SectorDropouts(**given).apply(0, SWEEP)


def missing(**given: Any) -> bool:
    return disturbances.MissingSweeps(**given).keeps(2)


def boxes(**given: Any) -> api.Scan:
    return disturbances.MovingObjects(**given).apply(0, SWEEP)


def live(**given: Any) -> Any:
    mapper = LiveMapper(CONFIG, **given)
    mapper.add_scan(SWEEP)
    return mapper.finish()


def process(sweep: api.Scan) -> api.MapUpdate:
    return api.Pipeline().process(sweep)


CALLS: dict[str, tuple[Callable[..., object], dict[str, Any]]] = {
    call.__name__: (call, given)
    for call, given in (
        (api.Scan, {"points": SWEEP.points, "stamp": 0, "times": None, "rings": None,
                    "span": None, "rows": 0}),
        (api.ImuSamples, {"stamps": [0, 1], "orientation": None, "gyro": np.zeros((2, 3)),
                          "acceleration": np.zeros((2, 3))}),
        (api.Trajectory, {"stamps": [0], "map_T_lidar": np.eye(4)[None], "point": None}),
        (api.ArrayDataset, {"scans": [SWEEP], "imu": None, "truth": TRUTH, "sensor": {}}),
        (api.SimulatedWorld, {"scene": "room", "frames": 2, "sensor": "vlp16", "seed": 0,
                              "range_noise": 0.02, "dropout": 0.0, "rate": 10.0, "speed": 1.0,
                              "max_range": 50.0, "start": "rest", "imu": "white"}),
        (api.extract_features, {"scan": SWEEP, "config": CONFIG}),
        (api.associate, {"edges": FEATURES.edges, "planes": FEATURES.planes,
                         "map_T_lidar": gtsam.Pose3(), "edge_map": MAPPER.maps.edges,
                         "plane_map": MAPPER.maps.planes, "config": CONFIG.matching,
                         "distinct": None}),
        (api.match_rows, {"matches": MATCHES, "kernel_width": 1.3, "kernel": "huber"}),
        (api.scan_match_factor, {"key": 0, "rows": api.match_rows(MATCHES)}),
        (api.point_to_plane_factor, {"key": 0, "point": [0, 0, 0], "normal": [0, 0, 1],
                                     "offset": 0.0, "noise": SIGMA(1, 0.1)}),
        (api.point_to_line_factor, {"key": 0, "point": [0, 0, 0], "centre": [0, 0, 0],
                                    "direction": [0, 0, 1], "noise": SIGMA(2, 0.1)}),
        (api.checked_factor, {"noise": SIGMA(1, 0.1), "keys": [0], "residual": row}),
        (api.align, {"source": SWEEP.points.T[:3].T, "target": SWEEP.points, "guess": None,
                     "config": CONFIG, "max_distance": 2.0}),
        (register, {"features": FEATURES, "guess": None, "twist": None}),
        (process, {"sweep": SWEEP}),
        (api.Mapper, {"config": CONFIG, "solver": None, "imu": None, "extra_factors": None}),
        (api.Pipeline, {"config": CONFIG, "imu": None, "features": None, "odometry": None}),
        (api.make_solver, {"config": CONFIG.solver}),
        (api.absolute_error, {"estimate": RESULT.trajectory, "reference": TRUTH, "aligned": True}),
        (relative_error, {"estimate": RESULT.trajectory, "reference": TRUTH, "lengths": [1e-3]}),
        (matched_truth, {"trajectory": RESULT.trajectory, "reference": TRUTH}),
        (nees, {"updates": UPDATES, "reference": TRUTH, "window": 0}),
        (api.relative_covariance, {"earlier": UPDATES[2], "later": UPDATES[3]}),
        (to_dataframe, {"updates": UPDATES}),
        (run_points, {"dataset": WORLD, "updates": UPDATES, "config": CONFIG}),
        (ImuBuffer, {"config": CONFIG.imu, "samples": WORLD.imu}),
        (BUFFER.orientation, {"stamp": FIRST}),
        (BUFFER.rotations_since, {"stamp": FIRST, "seconds": np.zeros(2)}),
        (BUFFER.rotation_between, {"first": FIRST, "second": FIRST + 10**7}),
        (BUFFER.samples_between, {"first": FIRST, "last": FIRST + 10**7}),
        (BUFFER.rest_at, {"stamp": FIRST}),
        (BUFFER.forget_old, {"stamp": FIRST}),
        (outliers, {"share": 0.2, "ranges": (1.0, 50.0), "seed": 0}),
        (dropouts, {"share": 0.2, "sectors": 2, "seconds": 0.5, "seed": 0}),
        (missing, {"at": (2,), "count": 1}),
        (boxes, {"length": 8.0, "width": 2.0, "height": 3.0, "spacing": 16.0, "lane": 2.5,
                 "bottom": -1.5, "speeds": (4.0, -9.0), "range_noise": 0.02, "seed": 0}),
        (BOXES.hits, {"scan": SWEEP}),
        (BOXES.covering, {"share": 0.01, "scan": SWEEP}),
        (OUTLIERS.apply, {"number": 0, "scan": SWEEP}),
        (disturbed, {"dataset": WORLD, "disturbances": [OUTLIERS]}),
        (skipped, {"dataset": WORLD, "first": 1, "count": 1}),
        (kidnapped, {"world": WORLD, "number": 2, "move": (1.0, 0.0, 0.0), "turn_deg": 5.0}),
        (live, {"imu": False, "features": (), "axes": "auto", "clouds": None, "observe": None,
                "solver": None, "odometry": None, "extra_factors": None, "loop_closer": None,
                "clock": time.monotonic_ns}),
        (LIVE.add_scan, {"scan": SWEEP, "received": None}),
        (LIVE.add_cloud, {"message": SWEEP, "received": None}),
        (LIVE.add_imu, {"message": WORLD.imu}),
        (LIVE.wait, {"seconds": 0.0}),
        (refine_run, {"points": run_points(WORLD, UPDATES, CONFIG), "updates": UPDATES,
                      "trajectory": None, "graph": None, "factors": None}),
    )
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_an_argument_of_another_type(name: str):
    call, given = CALLS[name]
    call(**given)
    answered(call, given)


def test_files(tmp_path: Path):
    where = tmp_path / "run"
    api.write_run(RESULT, where)
    save_map(where / "map.lgmap", RESULT)
    saved = SavedMap(where)
    calls: list[tuple[Callable[..., object], dict[str, Any]]] = [
        (api.write_run, {"result": RESULT, "directory": where, "dataset": "", "extra": None}),
        (read_updates, {"path": where}),
        (write_npz, {"path": tmp_path / "a.npz", "updates": UPDATES}),
        (write_covariances, {"path": tmp_path / "a.csv", "updates": UPDATES}),
        (write_tum, {"path": tmp_path / "a.tum", "trajectory": TRUTH}),
        (api.load_config, {"path": where / "config.yaml"}),
        (SavedMap, {"path": where}),
        (save_map, {"path": where / "b.lgmap", "pipeline": RESULT}),
        (clean_map, {"saved": saved, "sweeps": [], "config": CONFIG, "path": where / "c.lgmap"}),
        (localise, {"dataset": WORLD, "saved": saved, "config": CONFIG, "max_frames": 1}),
    ]
    for call, given in calls:
        call(**given)
        # Texts are paths: no file is to be written where the tests run.
        answered(call, given, [value for value in WRONG if not isinstance(value, str)])


def answered(
    call: Callable[..., object], given: dict[str, Any], wrong: tuple[Any, ...] | list[Any] = WRONG
) -> None:
    """Replace each argument by each of the wrong ones."""
    for name in given:
        for value in wrong:
            try:
                call(**{**given, name: value})
            except api.LoamError:
                pass
            except Exception as error:
                kind = type(error).__name__
                pytest.fail(f"{call.__name__}({name}={value!r:.60}) raised {kind}: {error}")
