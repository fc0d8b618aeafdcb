"""Whole runs over the built-in scenes, with every solver and IMU: ``python -m benchmarks.scenes``.

Two tables, each as CSV and Markdown: ``solvers`` holds the presets against each other without an
IMU, ``imu`` the default with and without one, in every mode. All numbers but the milliseconds are
the same on every run.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.cases import ROOT, data_folder
from benchmarks.scene_tables import NONE, RECORDED, Row, along, drift, tilt, write
from loam_gtsam.config import Config, preset
from loam_gtsam.datasets import SimulatedWorld, open_dataset
from loam_gtsam.datasets.arrays import ArrayDataset
from loam_gtsam.frontend.workers import Extraction
from loam_gtsam.pipeline import Pipeline, effective_config, imu_buffer
from loam_gtsam.studies.contenders import extract_for_all
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import FloatArray, FrameStatus, ImuSamples, Scan, Trajectory

SOLVERS = ("default", "loam", "aloam")
NOISES = (0.003, 0.010)
"""Of the IMU's orientation, rad per axis: a good and a poor attitude filter."""


def _with_imu(**changes: Any) -> Config:
    return Config().changed(imu=Config().imu.changed(**changes))


AIDS: Mapping[str, Config] = {
    NONE: _with_imu(coupling="off"),
    "gyro only": _with_imu(prior="off"),
    "blend": _with_imu(prior="blend"),
    "equivalent": _with_imu(prior="equivalent"),
    "sigma": _with_imu(prior="sigma"),
    "tight": _with_imu(coupling="tight"),
}
"""Uses of an IMU by the default; ``gyro only`` levels the map and de-skews."""


@dataclass(frozen=True, slots=True)
class Place:
    """What is run where.

    Attributes
    ----------
    scene : built-in, or TOWN, which is a folder
    frames, columns, seed : of the simulated world
    solvers, aids : what is run without and with an IMU, of SOLVERS and AIDS
    noises : of the IMU's orientation, rad
    """

    scene: str
    frames: int | None = None
    columns: int | None = None
    seed: int = 0
    solvers: tuple[str, ...] = SOLVERS
    aids: tuple[str, ...] = ()
    noises: tuple[float, ...] = NOISES

    @property
    def name(self) -> str:
        """As in the tables."""
        return self.scene + (f", seed {self.seed}" if self.seed else "")


TOWN = "sim_town"
REPEATED = (NONE, "gyro only", "equivalent", "sigma")
PLACES = (
    Place("street_loop", aids=tuple(AIDS)),
    Place("corridor", aids=tuple(AIDS)),
    Place("slopes", aids=tuple(AIDS)),
    Place("trees", frames=250),
    Place("trees", frames=250, seed=1),
    Place("trees", frames=250, seed=2),
    Place("corridor_bare", solvers=(), aids=(NONE, "equivalent", "pre-integration")),
    Place("shaken", aids=tuple(AIDS)),
    # How much of a difference is chance: other sweeps, doors and houses.
    *(
        Place(scene, seed=seed, solvers=(), aids=REPEATED, noises=NOISES[:1])
        for scene in ("corridor", "slopes")
        for seed in (1, 2, 3)
    ),
    Place(TOWN, aids=tuple(AIDS)),
    Place("room"),
)
"""Mostly the longest first, for the processes that share them."""
QUICK = (
    Place("room", frames=12, columns=600, aids=(NONE, "equivalent")),
    Place("corridor_bare", frames=12, columns=600, solvers=(), aids=(NONE, "pre-integration")),
)


@dataclass(frozen=True, slots=True)
class Recording:
    """Sweeps of a place, made once for all runs.

    Attributes
    ----------
    truth : one pose a sweep
    imus : by the noise of their orientation, or RECORDED
    world_R_start : (3, 3) attitude of the first pose, z up
    """

    sweeps: Sequence[Scan]
    sensor: Mapping[str, Any]
    truth: Trajectory
    imus: Mapping[float, ImuSamples | None]
    world_R_start: FloatArray


def record(place: Place, data: Path) -> Recording:
    """Make the sweeps of a place, or read them from a folder of ``data``."""
    if place.scene == TOWN:
        town = open_dataset(data / TOWN)
        assert town.truth is not None
        start = np.loadtxt(data / TOWN / "start_world.txt")  # x y z, quaternion x y z w
        attitude = Rotation.from_quat(start[3:]).as_matrix()
        sweeps = [sweep for sweep in town if isinstance(sweep, Scan)]
        return Recording(sweeps, town.sensor, town.truth, {RECORDED: town.imu}, attitude)
    make = partial(
        SimulatedWorld, place.scene, frames=place.frames, columns=place.columns, seed=place.seed
    )
    world = make()
    imus = {noise: make(imu_noise=noise).imu for noise in place.noises}
    return Recording(list(world), world.sensor, world.truth, imus, world.world_T_start[:3, :3])


class Runs:
    """Runs over one recording; features are extracted once for all that take the same."""

    def __init__(self, place: Place, recording: Recording) -> None:
        self.place, self.recording = place, recording
        self._prepared: dict[Any, list[tuple[Extraction | None, float]]] = {}

    def run(self, table: str, variant: str, config: Config, noise: float = np.nan) -> Row:
        """One run, with the IMU of that noise if the configuration uses one."""
        recording = self.recording
        imu = recording.imus[noise] if config.imu.coupling != "off" else None
        dataset = ArrayDataset(
            recording.sweeps, imu=imu, truth=recording.truth, sensor=recording.sensor
        )
        config = effective_config(config, dataset)
        pipeline = Pipeline(config, imu=imu_buffer(dataset, config))
        updates, seconds = [], []
        prepared = self._features(dataset, config)
        for sweep, (extraction, spent) in zip(dataset, prepared, strict=True):
            # Processor time: the clock on the wall also counts what others do on the machine.
            started = time.process_time()
            updates.append(pipeline.process(sweep, extraction))
            seconds.append(spent + time.process_time() - started)
        found = pipeline.result(updates)
        error = absolute_error(found.trajectory, recording.truth)
        poses = found.trajectory.map_T_lidar
        if imu is None or not config.imu.level:
            # The true tilt at the start stands in for the level that such a map does not have.
            poses = _turned(recording.world_R_start, poses)
        truth = _turned(recording.world_R_start, recording.truth.map_T_lidar)
        counts = Counter(update.status for update in found.updates)
        return Row(
            table=table,
            place=self.place.name,
            noise=np.nan if imu is None else noise,
            variant=variant,
            sweeps=len(dataset),
            path_m=recording.truth.path_length,
            ate_m=error.rmse,
            max_m=error.maximum,
            drift_m=drift(poses, truth),
            tilt_deg=tilt(poses, truth),
            along_percent=along(poses, truth),
            degenerate=counts[FrameStatus.DEGENERATE],
            not_converged=counts[FrameStatus.NOT_CONVERGED],
            unsolved=sum(n for status, n in counts.items() if not status.solved)
            - counts[FrameStatus.FIRST],
            ms=1e3 * float(np.median(seconds[1:])),
        )

    def _features(
        self, dataset: ArrayDataset, config: Config
    ) -> list[tuple[Extraction | None, float]]:
        """Features of all sweeps, and the processor time each took."""
        key = config.sensor, config.features, config.deskew.enabled, config.deskew.reference
        if key not in self._prepared:
            own = self._prepared[key] = []
            for sweep in dataset:
                started = time.process_time()
                extraction = extract_for_all(sweep, config, {}) if isinstance(sweep, Scan) else None
                own.append((extraction, time.process_time() - started))
        return self._prepared[key]


def measure(place: Place, data: Path) -> list[Row]:
    """All runs of a place: the solvers, then the IMU, noise by noise."""
    runs = Runs(place, record(place, data))
    rows = []
    for name in place.solvers:
        config = preset(name)
        config = config.changed("imu.coupling=off")
        rows.append(runs.run("solvers", name, config))
    if NONE in place.aids:
        same = [row for row in rows if row.variant == "default"]
        bare = same[0] if same else runs.run("imu", NONE, AIDS[NONE])
        rows.append(replace(bare, table="imu", variant=NONE))
    for noise in runs.recording.imus:
        rows += [runs.run("imu", name, AIDS[name], noise) for name in place.aids if name != NONE]
    return rows


def _turned(rotation: FloatArray, poses: FloatArray) -> FloatArray:
    turn = np.eye(4)
    turn[:3, :3] = rotation
    turned: FloatArray = turn @ poses
    return turned


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scenes", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="twelve coarse sweeps of two places")
    names = sorted({place.scene for place in PLACES})
    parser.add_argument("--only", nargs="+", metavar="SCENE", choices=names, default=names,
                        help=f"scenes to run: {', '.join(names)}")  # fmt: skip
    parser.add_argument("--data", type=Path, default=data_folder(),
                        help=f"folder with {TOWN}, which is skipped if it is absent")  # fmt: skip
    parser.add_argument("--output", type=Path, help="folder for the tables; docs/study, or "
                        "benchmarks/results with --quick or --only")  # fmt: skip
    options = parser.parse_args(arguments)
    part = options.quick or set(options.only) != set(names)
    folder = options.output or ROOT / ("benchmarks/results" if part else "docs/study")
    places = [
        place for place in (QUICK if options.quick else PLACES) if place.scene in options.only
    ]
    if not (options.data / TOWN).is_dir():
        places = [place for place in places if place.scene != TOWN]
    started = time.perf_counter()
    with ProcessPoolExecutor(2) as pool:
        found = list(pool.map(partial(measure, data=options.data), places))
    rows = [row for rows in found for row in rows]
    paths = write(folder, rows)
    seconds = time.perf_counter() - started
    print(f"{len(rows)} rows in {seconds:.0f} s: {', '.join(map(str, paths))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
