"""Runs with settings, sensors and faults drawn at random: ``python -m benchmarks.drawn``.

Each seed is a world of its own, a lidar, an IMU, settings, and disturbances. It is mapped; a second
drive, for which a fifth of the objects may be changed, is mapped too and looked for in the map of
the first, which it may extend; then the maps are merged. No exception may come but a refusal of the
package with its reason, and every covariance must be positive; else the exit code is 1. Frames that
are ``ok`` and off by more than five told standard deviations are counted.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import traceback
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.localisation import error_in_map, with_changes
from benchmarks.tables import write_rows
from loam_gtsam.config import Config
from loam_gtsam.datasets.base import PartOf
from loam_gtsam.datasets.sim.disturbances import (
    Disturbance,
    Disturbed,
    MissingSweeps,
    MovingObjects,
    Outliers,
    SectorDropouts,
)
from loam_gtsam.datasets.sim.scenes import BUILDERS
from loam_gtsam.datasets.sim.streets import Scene
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.maps import SavedMap, localise, merge_maps, save_map
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.studies.evaluation import FIVE_SIGMA
from loam_gtsam.types import (
    ConfigError,
    DatasetError,
    FloatArray,
    FrameStatus,
    InputError,
    MapUpdate,
)

_SENSORS = (("vlp16", 450), ("os1-32", 360), ("os1-64", 256), ("mid360", 5000), ("avia", 6000))
"""Names, and firings of a sweep: few, so that a seed takes half a minute."""
_RESULTS = Path("benchmarks/results/drawn")


@dataclass(frozen=True, slots=True)
class Row:
    """What came of a seed.

    Attributes
    ----------
    drawn : disturbances and settings
    frames, ok, beyond : of both runs; those that are ``ok``, and of these those that are off by
        more than five told standard deviations
    tracked, wrong : solved sweeps of the second drive in the map of the first; those ``ok`` beyond
    merged : whether the maps had a place in common
    problem : the end of the trace of an exception, or what covariance is none; empty if all is well
    """

    seed: int
    scene: str
    sensor: str
    drawn: str
    frames: int = 0
    ok: int = 0
    beyond: int = 0
    tracked: int = 0
    wrong: int = 0
    merged: bool = False
    problem: str = ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drawn", description=__doc__)
    parser.add_argument("--first", type=int, default=0, help="seed")
    parser.add_argument("--seeds", type=int, default=100, help="how many")
    parser.add_argument("--frames", type=int, default=60, help="sweeps of a drive at most")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--output", type=Path, default=_RESULTS, help="folder for the table")
    options = parser.parse_args(arguments)
    seeds, rows = range(options.first, options.first + options.seeds), []
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        for row in pool.map(partial(measure, most=options.frames), seeds):
            print(row, flush=True)
            rows.append(row)
    write_rows(options.output / "drawn.csv", rows)
    return int(any(row.problem for row in rows))


def measure(seed: int, most: int) -> Row:
    """Run what a seed draws."""
    rng = np.random.default_rng([seed, 55])
    scene = str(rng.choice(sorted(BUILDERS)))
    sensors = [_SENSORS[rng.integers(len(_SENSORS))] for _ in range(2)]
    sensors[1] = sensors[rng.integers(2)]
    settings, faults = _settings(rng), _faults(rng, most)
    told = [*(type(fault).__name__ for fault in faults), *(f"{k}={v}" for k, v in settings.items())]
    row = Row(seed, scene, " ".join(name for name, _ in sensors), " ".join(told))
    try:
        first, second = _worlds(scene, sensors, seed, rng, most)
        return _measured(row, first, second, faults, Config().changed(settings), rng)
    except Exception:  # whatever it is, it is what is looked for
        return replace(row, problem=traceback.format_exc()[-600:])


def _settings(rng: np.random.Generator) -> dict[str, Any]:
    """Some settings, each drawn or left as it is."""
    drawn: dict[str, tuple[float, list[Any]]] = {
        "pose_graph.keyframe_distance": (1.0, [0.5, 1.0, 4.0]),
        "loops.enabled": (0.5, [True]),
        "imu.coupling": (0.5, ["tight", "loose", "off"]),
        "imu.prior": (0.2, ["equivalent", "sigma", "off"]),
        "deskew.model": (0.3, ["linear", "constant", "predicted"]),
        "solver.degeneracy": (0.3, ["prior", "project"]),
        "solver.kernel": (0.2, ["huber", "geman_mcclure"]),
        "map.insertion": (0.2, ["centroid"]),
        "map.insert_unmatched": (0.2, [True]),
    }
    chosen = {name: values[rng.integers(len(values))] for name, (_, values) in drawn.items()}
    return {name: value for name, value in chosen.items() if rng.random() < drawn[name][0]}


def _faults(rng: np.random.Generator, frames: int) -> list[Disturbance]:
    speeds, at = rng.uniform(-15.0, 15.0, 2).tolist(), rng.integers(1, frames, 2).tolist()
    seed = int(rng.integers(1000))
    every = [
        (0.3, MovingObjects(speeds=(speeds[0], speeds[1]), seed=seed, bottom=-1.2)),
        (0.3, Outliers(float(rng.uniform(0.05, 0.4)), seed=seed)),
        (0.3, SectorDropouts(float(rng.uniform(0.1, 0.7)), seed=seed)),
        (0.4, MissingSweeps(at=(at[0], at[1]), count=int(rng.integers(1, 9)))),
    ]
    return [fault for chance, fault in every if rng.random() < chance]


def _worlds(
    scene: str, sensors: Sequence[tuple[str, int]], seed: int, rng: np.random.Generator, most: int
) -> list[SimulatedWorld]:
    """Two drives, for the second of which objects may be changed; shorter where the way ends."""
    number, changed = seed % 7, float(rng.choice([0.0, 0.2]))
    common: dict[str, Any] = {
        "speed": float(rng.uniform(0.5, 12.0)),
        "rate": float(rng.choice([5.0, 10.0, 20.0])),
        "start": str(rng.choice(["rest", "moving"])),
        "imu": str(rng.choice(["white", "mems"])),
        "range_noise": float(rng.choice([0.01, 0.03, 0.06])),
        "max_range": float(rng.choice([15.0, 40.0, 100.0])),
    }
    frames = int(rng.integers(most // 2, most + 1))
    places: tuple[str | Scene, ...] = scene, with_changes(BUILDERS[scene](number), changed, seed)
    for count in (frames, frames // 2, frames // 4):
        try:
            return [
                SimulatedWorld(
                    place, seed=own, frames=count, sensor=name, columns=columns, **common
                )
                for place, own, (name, columns) in zip(
                    places, (number, number + 100), sensors, strict=True
                )
            ]
        except ConfigError:  # the way is too short
            continue
    return _worlds("room", sensors, seed, rng, most)


def _measured(
    row: Row, first: SimulatedWorld, second: SimulatedWorld, faults: Sequence[Disturbance],
    config: Config, rng: np.random.Generator,
) -> Row:  # fmt: skip
    """Map both drives, look for the second one in the map of the first, and merge the maps."""
    cut = int(rng.integers(len(first) // 2, len(first) + 1))
    disturbed, start = Disturbed(second, faults), int(rng.integers(0, cut))
    later = PartOf(disturbed, min(start, len(disturbed) - 1), 1)
    runs = run(first, config, max_frames=cut), run(later, config)
    map_T_world = _start(runs[0], first)
    found = [
        _judged(runs[0].updates, first, map_T_world),
        _judged(runs[1].updates, second, _start(runs[1], second)),
    ]
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{name}.lgmap" for name in ("first", "second", "more", "both")]
        for result, file in zip(runs, files, strict=False):
            assert result.pipeline is not None
            _with_own_factors(result, rng)
            save_map(file, result.pipeline)
        maps = [SavedMap(file) for file in files[:2]]
        tracked, merged = _Judged(), False
        try:
            extend = bool(rng.random() < 0.5)
            localised = localise(later, maps[0], extend=extend)
            tracked = _judged(localised.updates, second, map_T_world)
            if extend:
                localised.localizer.save(files[2])
                maps[0] = SavedMap(files[2])
            places = merge_maps(maps, files[3]).graph.places
            merged = True
            found.append(_Judged(bad=sum(not _is_positive(place.covariance) for place in places)))
        except (DatasetError, InputError):  # no place in common, or none at all
            pass
        for opened in maps:
            opened.close()
    bad = tracked.bad + sum(one.bad for one in found)
    return replace(
        row, frames=sum(len(result.updates) for result in runs),
        ok=sum(one.ok for one in found), beyond=sum(one.beyond for one in found),
        tracked=tracked.solved, wrong=tracked.beyond, merged=merged,
        problem=f"{bad} covariances are none" if bad else "",
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Judged:
    """How many frames are solved, ``ok``, of these off beyond five sigma; covariances, none."""

    solved: int = 0
    ok: int = 0
    beyond: int = 0
    bad: int = 0


def _start(result: RunResult, world: SimulatedWorld) -> FloatArray:
    """``map_T_world`` of a run, whose first pose is believed."""
    if not result.updates:  # all sweeps are missing
        return np.eye(4)
    first = result.updates[0]
    true = world.world_T_start @ world.truth_at(np.array([first.stamp], np.int64)).map_T_lidar[0]
    return np.asarray(first.map_T_lidar.matrix() @ inverse_pose(true))


def _judged(
    updates: Sequence[MapUpdate], world: SimulatedWorld, map_T_world: FloatArray
) -> _Judged:
    solved = [u for u in updates if u.status.solved]
    good = [u for u in solved if u.status is FrameStatus.OK and _is_positive(u.covariance)]
    beyond = 0
    for update in good:
        error = error_in_map(update, world, map_T_world)
        beyond += bool(error @ np.linalg.solve(update.covariance, error) > FIVE_SIGMA)
    bad = sum(not _is_positive(update.covariance) for update in solved)
    return _Judged(len(solved), len(good), beyond, bad)


def _is_positive(covariance: FloatArray) -> bool:
    """Whether it is one, but for rounding where it is exact."""
    return bool(np.linalg.eigvalsh(covariance)[0] > -1e-12 * (1.0 + np.trace(covariance)))


def _with_own_factors(result: RunResult, rng: np.random.Generator) -> None:
    """Measured positions of some keyframes, if the run has a graph."""
    assert result.pipeline is not None
    if result.pipeline.loops is None:
        return
    graph = result.pipeline.loops.graph
    for keyframe in graph.keyframes[:: max(1, len(graph) // 3)]:
        aside = graph.pose(keyframe.index).translation() + rng.normal(0.0, 0.05, 3)
        graph.add_position(keyframe.index, aside, 0.05**2 * np.eye(3))


if __name__ == "__main__":
    sys.exit(main())
