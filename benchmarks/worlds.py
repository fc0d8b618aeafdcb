"""The table by which every change of the estimator is judged: ``python -m benchmarks.worlds``.

Worlds x seeds x modes: how accurate the poses are, how well the start goes, whether the covariances
are right, and whether a wrong pose is ever handed out as a good one. With seed 0 a lidar looks
ahead, and the map stands along the walls, as it hardly does elsewhere; with the others it is
mounted at any yaw, tilted by some degrees. ``--against`` holds a table against an earlier one. All
numbers but the milliseconds are the same on every run.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby, starmap
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from benchmarks import recorded
from benchmarks.cases import ROOT, data_folder
from benchmarks.process import processor_clock
from benchmarks.tables import markdown_table
from loam_gtsam.config import Config
from loam_gtsam.datasets import ArrayDataset, Dataset, SimulatedWorld, open_dataset
from loam_gtsam.datasets.base import PartOf
from loam_gtsam.datasets.sim.patterns import PATTERNS
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.studies.evaluation import FIVE_SIGMA, FREEDOM, absolute_error, squared_errors
from loam_gtsam.types import FloatArray, FrameStatus, LoamError, Trajectory, stack_poses

WINDOWS = (1, 10, 50)
"""Frames over which the error of a motion is held against its covariance."""
START = 0
"""The window that stands for the pose since the start of the map."""
_TILT = 2.0  # degrees, standard deviation per axis
_START = 30  # sweeps that are the start of a run
_FEW = 3  # samples below which a mean says nothing


@dataclass(frozen=True, slots=True)
class World:
    """A place and the way through it.

    Attributes
    ----------
    name : in the table
    scene : built-in, or a folder of the recorded data if ``recorded``
    options : further arguments of :class:`SimulatedWorld`
    every : only every so many sweeps are used
    first : number of the first sweep that is used
    """

    name: str
    scene: str
    options: Mapping[str, Any] = field(default_factory=dict)
    every: int = 1
    first: int = 0
    recorded: bool = False

    def open(self, seed: int, imu: str | None) -> Dataset:
        """The data set of a seed; ``imu`` is the kind of IMU, None if it does not matter."""
        dataset: Dataset
        if self.recorded:
            dataset = open_dataset(data_folder() / self.scene)
        else:
            ahead = SimulatedWorld(self.scene, seed=seed, imu=imu or "white", **self.options)
            dataset = ahead.seen_from(mount(seed)) if seed else ahead
        return PartOf(dataset, self.first, self.every)


class Carried(World):
    """Sweeps of a lidar that was carried about, two a second; the truth are poses of FAST-LIO."""

    def open(self, seed: int, imu: str | None) -> Dataset:
        """The same for every seed."""
        folder = data_folder() / self.scene
        sweeps, poses = recorded.hand_held(folder), recorded.given_poses(folder)
        return ArrayDataset(list(sweeps), truth=poses, sensor=sweeps.sensor)


def mount(seed: int) -> FloatArray:
    """(4, 4) attitude of a lidar on its vehicle: any yaw, and a tilt."""
    rng = np.random.default_rng(seed)
    roll, pitch = np.deg2rad(_TILT * rng.standard_normal(2))
    turn = gtsam.Rot3.RzRyRx(roll, pitch, rng.uniform(-np.pi, np.pi))
    return np.asarray(gtsam.Pose3(turn, np.zeros(3)).matrix())


@dataclass(frozen=True, slots=True)
class Mode:
    """A way to use the estimator; ``imu`` is the kind of simulated IMU, None for none."""

    name: str
    imu: str | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)
    more: tuple[str, ...] = ()

    @property
    def config(self) -> Config:
        """The default with the changes, and more of them as ``KEY=VALUE``."""
        coupling = "off" if self.imu is None else "tight"
        return Config().changed({"imu.coupling": coupling}, self.changes, *self.more)


MODES = (
    Mode("lidar"),
    Mode("imu", "white"),
    Mode("mems", "mems"),
    Mode("six", "six_axis"),
    Mode("loose", "mems", {"imu.coupling": "loose"}),
    Mode("project", None, {"solver.degeneracy": "project"}),
)


def _sim(scene: str, name: str = "", **options: Any) -> World:
    return World(name or scene, scene, {"frames": 150} | options)


BUILT_IN = (
    _sim("street_loop"),
    _sim("avenue"),
    _sim("trees", frames=120),
    _sim("slopes"),
    _sim("sparse_terrain"),
    _sim("room", frames=120),
    _sim("shaken", frames=120),
    _sim("corridor"),
    _sim("park", frames=120),
    _sim("forest", frames=120),
    _sim("rooms", frames=200),
    _sim("garage"),
    _sim("square"),
    _sim("stairwell"),
    _sim("bridge"),
    _sim("street_loop", "street, 64 beams", sensor="hdl64", columns=1000, frames=80),
    _sim("park", "park, 32 beams", sensor="os1-32", frames=80),
    _sim("rooms", "rooms, 64 beams", sensor="os1-64", frames=80, columns=512),
)
DEGENERATE = (
    _sim("corridor_bare"),
    _sim("corridor_bare", "corridor_bare, 6 m", columns=900, max_range=6.0, frames=60),
    _sim("tunnel"),
    _sim("tunnel_pilasters"),
    _sim("open_field"),
    _sim("single_plane", frames=100),
    _sim("single_pole"),
)
RECORDED = (
    tuple(
        World(name, name, recorded=True)
        for name in ("sim_town", "sim_park", "kitti_2011_09_26_0002")
    )
    + tuple(
        World(f"KITTI, every {n}.", "kitti_2011_09_26_0002", every=n, first=5, recorded=True)
        for n in (2, 3)
    )
    + (Carried("OS0-64, carried", "hilti_os0_64", recorded=True),)
)
SLOW = tuple(
    replace(_sim(scene, f"{scene}, every 5.", frames=400, columns=900), every=5)
    for scene in ("rooms", "room", "shaken", "garage", "square", "forest", "park", "stairwell")
)
"""Two sweeps a second: the lidar turns by up to 44 degrees from one to the next."""
WITHOUT_RINGS = tuple(
    replace(w, name=f"{w.name}, {lidar}", options={**w.options, "sensor": lidar, "max_range": 70.0})
    for w in BUILT_IN
    if "sensor" not in w.options
    for lidar in PATTERNS
)


def _starts() -> Iterator[World]:
    """Starts at any speed, and sweeps that are missing from the start."""
    sensors = {"16": {}, "64": {"sensor": "hdl64", "columns": 1000}}
    for scene in ("street_loop", "avenue"):
        for beams, sensor in sensors.items():
            for speed in (5.0, 10.0, 20.0, 30.0, 40.0):
                options = {"start": "moving", "speed": speed, "frames": 40} | sensor
                yield _sim(scene, f"{scene} {beams} from {speed:g} m/s", **options)
            yield _sim(scene, f"{scene} {beams} from rest", **{"frames": 40} | sensor)
            for n in (2, 3, 5):
                options = {"start": "moving", "frames": 25 * n} | sensor
                world = _sim(scene, f"{scene} {beams} every {n}.", **options)
                yield replace(world, every=n)


STARTS = tuple(_starts())
GROUPS = {
    "worlds": BUILT_IN,
    "degenerate": DEGENERATE,
    "recorded": RECORDED,
    "slow": SLOW,
    "without rings": WITHOUT_RINGS,
    "starts": STARTS,
}
QUICK = (_sim("room", frames=12, columns=600),)


@dataclass(frozen=True, slots=True)
class Row:
    """One run.

    Attributes
    ----------
    path : metres driven
    ate : metres, aligned
    start_deg, start_m : largest error of roll and pitch, and of the position, over the first 30
        sweeps, not aligned
    nees : mean squared error over covariance, in degrees of freedom, by window; "start" is since
        the start of the run; of solved frames
    samples : number behind each mean
    beyond : frames ``ok`` whose pose is off by more than five told standard deviations
    beyond_degenerate : the same of other solved frames
    broken : covariances, of poses and of motions, that are not positive definite
    statuses : number of frames by status
    ms : median processor time a frame, features and mapping
    problem : why the run ended early
    """

    world: str
    mode: str
    seed: int
    path: float = 0.0
    ate: float = float("nan")
    start_deg: float = float("nan")
    start_m: float = float("nan")
    nees: Mapping[str, float] = field(default_factory=dict)
    samples: Mapping[str, int] = field(default_factory=dict)
    beyond: int = 0
    beyond_degenerate: int = 0
    broken: int = 0
    statuses: Mapping[str, int] = field(default_factory=dict)
    ms: float = float("nan")
    problem: str = ""


def measure(world: World, mode: Mode, seed: int) -> Row:
    """Map one world and hold the result against the truth."""
    try:
        dataset = world.open(seed, mode.imu)
        with processor_clock():
            result = run(dataset, mode.config)
    except LoamError as error:
        return Row(world.name, mode.name, seed, problem=f"{type(error).__name__}: {error}")
    assert dataset.truth is not None
    return judge(Row(world.name, mode.name, seed), result, dataset.truth)


def judge(row: Row, result: RunResult, truth: Trajectory) -> Row:
    """The row with what a run gave."""
    first, last = truth.stamps[0], truth.stamps[-1]
    updates = [update for update in result.updates if first <= update.stamp <= last]
    exact_at = truth.at([update.stamp for update in updates])
    true = [gtsam.Pose3(pose) for pose in exact_at.map_T_lidar]
    moved = [updates[0].map_T_lidar.between(update.map_T_lidar) for update in updates]
    exact = [true[0].between(pose) for pose in true]
    errors = np.array([a.localCoordinates(b) for a, b in zip(moved, exact, strict=True)])
    starts = (stack_poses(poses[:_START]) for poses in (moved, exact))
    seconds = [sum(t for name, t in update.timings.items() if name != "read") for update in updates]
    nees: dict[str, FloatArray] = {}
    broken = 0
    for window in (*WINDOWS, START):  # that since the start is the last, and judged once more
        found = squared_errors(updates, true, window)
        squared = np.array(list(found.values()))
        nees[name_of(window)] = squared[np.isfinite(squared)]
        broken += int(np.isinf(squared).sum())
    far = [k for k, value in found.items() if value > FIVE_SIGMA]
    good = sum(updates[k].status is FrameStatus.OK for k in far)
    return replace(
        row,
        path=truth.path_length,
        ate=absolute_error(result.trajectory, truth).rmse,
        start_deg=float(np.degrees(tilts(*starts).max())),
        start_m=float(np.linalg.norm(errors[:_START, 3:], axis=1).max()),
        nees={k: float(v.mean()) / FREEDOM if len(v) >= _FEW else np.nan for k, v in nees.items()},
        samples={k: len(v) for k, v in nees.items()},
        beyond=good,
        beyond_degenerate=len(far) - good,
        broken=broken,
        statuses=dict(Counter(str(update.status) for update in updates)),
        ms=1e3 * float(np.median(seconds)),
    )


def tilts(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """(N,) angles between the up axes, seen from the lidar: roll and pitch together, rad.

    ``estimate`` and ``truth`` are (N, 4, 4) in frames with z up.
    """
    up, wanted = estimate[:, 2, :3], truth[:, 2, :3]
    angles: FloatArray = np.arctan2(
        np.linalg.norm(np.cross(up, wanted), axis=1), (up * wanted).sum(axis=1)
    )
    return angles


def name_of(window: int) -> str:
    """Of a window in tables."""
    return str(window) if window else "start"


# -- tables ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Line:
    """All seeds of one world in one mode: geometric means, or sums of counts."""

    world: str
    mode: str
    rows: Sequence[Row]

    @property
    def ate(self) -> float:
        """Geometric mean, metres."""
        return _geometric([row.ate for row in self.rows])

    def nees(self, window: str) -> float:
        """Mean over all samples of all seeds."""
        weights = np.array([row.samples.get(window, 0) for row in self.rows], np.float64)
        means = np.array([row.nees.get(window, np.nan) for row in self.rows])
        known = np.isfinite(means) & (weights > 0)
        return float(np.average(means[known], weights=weights[known])) if known.any() else np.nan

    def cells(self, before: Line | None) -> list[str]:
        """The columns of :data:`TITLES`."""
        rows = self.rows
        counts: Counter[str] = Counter()
        for row in rows:
            counts.update(row.statuses)
        total = counts.total()
        fine = counts.pop("ok", 0) + counts.pop("first", 0)
        others = [f"{n} {name}" for name, n in sorted(counts.items())]
        problems = [f"{sum(bool(row.problem) for row in rows)} ended early"]
        others += problems if any(row.problem for row in rows) else []
        cells = [
            self.world,
            self.mode,
            f"{1e3 * self.ate:.1f}",
            f"{1e3 * max(row.ate for row in rows):.0f}",
            f"{max(row.start_deg for row in rows):.2f}",
            f"{1e3 * max(row.start_m for row in rows):.0f}",
            *(_marked(self.nees(name_of(window))) for window in (*WINDOWS, START)),
            *(str(sum(column)) for column in zip(*((row.beyond, row.beyond_degenerate, row.broken)
                                                   for row in rows), strict=True)),
            f"{fine}/{total}" + "".join(f", {text}" for text in others),
            f"{np.median([row.ms for row in rows]):.0f}",
        ]  # fmt: skip
        if before is not None:
            cells.append(f"{self.ate / before.ate:.2f}")
        return cells


TITLES = (
    *("world", "mode", "ATE mm", "worst", "tilt deg", "start mm"),
    *(f"NEES/6 {window}" for window in WINDOWS),
    *("since start", "beyond ok", "beyond other", "broken", "ok frames", "ms"),
)


def _geometric(values: Sequence[float]) -> float:
    known = np.array([value for value in values if np.isfinite(value)])
    return float(np.exp(np.log(np.maximum(known, 1e-9)).mean())) if len(known) else np.nan


def _marked(nees: float) -> str:
    """In bold if out of bounds: twice too large or too small."""
    return f"{nees:.2f}" if 0.5 <= nees <= 2.0 else f"**{nees:.2g}**"


def lines_of(rows: Sequence[Row]) -> list[Line]:
    """One line for each world and mode, in order."""

    def key(row: Row) -> tuple[str, str]:
        return row.world, row.mode

    return [Line(*names, list(group)) for names, group in groupby(rows, key)]


def table(rows: Sequence[Row], before: Sequence[Row] = ()) -> str:
    """In Markdown; the last column is the ATE over that of an earlier table."""
    known = {(row.world, row.mode, row.seed): row for row in before}
    titles = TITLES + (("ATE, x before",) if before else ())
    cells, ratios = [], []
    for line in lines_of(rows):
        pairs = [known.get((row.world, row.mode, row.seed)) for row in line.rows]
        same = [row for row in pairs if row is not None]
        older = Line(line.world, line.mode, same) if len(same) == len(line.rows) else None
        if older is not None:
            ratios.append(line.ate / older.ate)
        cells.append(line.cells(older))
    lines = list(markdown_table(titles, cells))
    if ratios:
        mean, worst = _geometric(ratios), max(ratios)
        lines += ["", f"ATE over that before: geometric mean {mean:.3f}, worst {worst:.2f}."]
    return "\n".join(lines) + "\n"


def read(path: Path) -> list[Row]:
    """Rows that :func:`main` wrote."""
    return [Row(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; 1 if a run ended early."""
    every = [world for group in GROUPS.values() for world in group]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.worlds", description=__doc__)
    parser.add_argument("--only", nargs="+", metavar="WORLD", default=list(GROUPS),
                        help="worlds or groups of them: "
                        f"{', '.join([*GROUPS, *(world.name for world in every)])}")  # fmt: skip
    parser.add_argument("--modes", nargs="+", default=["lidar", "imu", "mems"],
                        choices=[mode.name for mode in MODES])  # fmt: skip
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE",
                        help="change the configuration of every mode")  # fmt: skip
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="a few coarse sweeps")
    parser.add_argument("--against", type=Path, help="worlds.json of an earlier run")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "results")
    options = parser.parse_args(arguments)
    chosen = [
        world
        for name, group in GROUPS.items()
        for world in group
        if {name, world.name} & set(options.only)
    ]
    if options.quick:
        chosen = list(QUICK)
    modes = [mode for mode in MODES if mode.name in options.modes]
    jobs = [
        (world, replace(mode, more=tuple(options.set)), seed)
        for world in chosen
        if not world.recorded or (data_folder() / world.scene).is_dir()
        for mode in modes
        for seed in range(options.first_seed, options.first_seed + options.seeds)
        if not (world.recorded and (seed > options.first_seed or mode.imu not in (None, "white")))
    ]
    if options.workers > 1:
        with ProcessPoolExecutor(options.workers) as pool:
            rows = list(pool.map(measure, *zip(*jobs, strict=True)))
    else:
        rows = list(starmap(measure, jobs))
    text = table(rows, read(options.against) if options.against else ())
    print(text)
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "worlds.md").write_text(text, encoding="utf-8")
    with open(options.output / "worlds.csv", "w", encoding="utf-8", newline="") as file:
        cells = [[cell.strip("*") for cell in line.cells(None)] for line in lines_of(rows)]
        csv.writer(file, lineterminator="\n").writerows([TITLES, *cells])
    found = json.dumps([asdict(row) for row in rows], indent=1)
    (options.output / "worlds.json").write_text(found, encoding="utf-8")
    for row in rows:
        if row.problem:
            print(f"{row.world}, {row.mode}, seed {row.seed}: {row.problem}")
    return int(any(row.problem for row in rows))


if __name__ == "__main__":
    sys.exit(main())
