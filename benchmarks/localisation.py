"""Is a second drive found in the map of the first? ``python -m benchmarks.localisation``.

Each world is mapped once and saved. A second drive has other noise, and a share of the objects is
gone or stands up to 3 m elsewhere. It starts at many places; then one stretch is tracked. A world
of the same kind, made of another seed, is looked for in the map as well: it is not there.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.tables import write_rows
from loam_gtsam.datasets.base import PartOf
from loam_gtsam.datasets.sim.scenes import BUILDERS
from loam_gtsam.datasets.sim.streets import Scene
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.maps import Localizer, SavedMap, localise, own_settings, save_map
from loam_gtsam.pipeline import effective_config, run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import BoolArray, FloatArray, MapUpdate

RIGHT = (0.5, np.radians(3.0))
"""Metres and rad by which a right fix may be off."""
SWEEPS = 20
"""After which a start without a fix is given up."""
_CHANGED = 0.2
_FAR = 3.0  # metres by which things are moved
_WORLDS = ("street_loop", "avenue", "park", "forest", "garage", "rooms")
_ALIKE = ("room", "corridor")  # which are the same place for all seeds
_RESULTS = Path("benchmarks/results/localisation")


@dataclass(frozen=True, slots=True)
class Row:
    """A world, and what became of a second drive in its map.

    Attributes
    ----------
    starts, right, wrong : first sweeps of the second drive, and the fixes
    sweeps_to_fix, most_sweeps : median and most
    tracked : sweeps that were tracked, from a further start
    ate_mm : ATE of these, aligned as a whole, as every ATE here is
    rms_mm, aligned_mm : error of the position in the frame of the map; less its mean, in lidar axes
    nees, nees_without : over six freedoms, with and without the map's own error
    elsewhere, elsewhere_fixes : starts in a world of another seed, and fixes, which are all wrong
    """

    world: str
    seed: int
    starts: int
    right: int
    wrong: int
    sweeps_to_fix: float
    most_sweeps: int
    tracked: int
    ate_mm: float
    rms_mm: float
    aligned_mm: float
    nees: float
    nees_without: float
    elsewhere: int
    elsewhere_fixes: int


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns 1 if there was a wrong fix."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.localisation", description=__doc__)
    parser.add_argument("worlds", nargs="*", default=_WORLDS, help="built-in worlds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1], help="of the worlds")
    parser.add_argument("--starts", type=int, default=40, help="of the second drive")
    parser.add_argument("--frames", type=int, default=300, help="sweeps of a drive; 0 is all")
    parser.add_argument("--columns", type=int, help="firings per sweep")
    parser.add_argument("--changed", type=float, default=_CHANGED, help="share of the objects")
    parser.add_argument("--inside", action="store_true", help="the lidar is surely in the map")
    parser.add_argument("--output", type=Path, default=_RESULTS, help="folder for the table")
    options = parser.parse_args(arguments)
    rows = []
    for world in options.worlds:
        for seed in options.seeds:
            sizes = options.frames or None, options.columns
            how = options.starts, options.changed, options.inside
            rows.append(measure(world, seed, *how, *sizes))
            print(rows[-1], flush=True)
    write_rows(options.output / "localisation.csv", rows)
    return int(any(row.wrong or row.elsewhere_fixes for row in rows))


def measure(
    world: str, seed: int, starts: int, changed: float, inside: bool,
    frames: int | None, columns: int | None,
) -> Row:  # fmt: skip
    """Map a world, and look for a second drive in the map."""
    first = SimulatedWorld(world, seed=seed, frames=frames, columns=columns)
    scene = with_changes(BUILDERS[world](seed), changed, seed)
    second = SimulatedWorld(scene, seed=seed + 100, frames=frames, columns=columns)
    other = SimulatedWorld(world, seed=seed + 1, frames=frames, columns=columns)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "first.lgmap"
        mapped = run(first)
        assert mapped.pipeline is not None
        save_map(path, mapped.pipeline)
        start = mapped.updates[0].map_T_lidar.matrix() @ inverse_pose(first.world_T_start)
        with SavedMap(path) as saved:
            found = first_fixes(saved, second, start, starts, seed, inside=inside)
            ate, errors, nees, without = tracked(saved, second, start, inside=inside)
            there = 0 if inside or world in _ALIKE else max(1, starts // 3)
            elsewhere = first_fixes(saved, other, start, there, seed)
    right = [sweeps for sweeps, is_right in found if is_right]
    positions = errors[:, 3:]
    spread = positions - positions.mean(axis=0) if len(positions) else positions
    return Row(
        world, seed, starts, len(right), len(found) - len(right),
        float(np.median(right)) if right else np.nan, max(right, default=0),
        len(errors), 1e3 * ate, 1e3 * _rms(positions), 1e3 * _rms(spread),
        nees, without, there, len(elsewhere),
    )  # fmt: skip


def first_fixes(
    saved: SavedMap, drive: SimulatedWorld, map_T_world: FloatArray, starts: int, seed: int,
    *, inside: bool = False,
) -> list[tuple[int, bool]]:  # fmt: skip
    """After how many sweeps each start had its fix, and whether that is right."""
    config = effective_config(own_settings(saved), drive)
    localizer, rng = Localizer(saved, config, inside=inside), np.random.default_rng([seed, 3])
    fixes = []
    for start in rng.integers(0, len(drive) - SWEEPS, starts).tolist():
        localizer.reset()
        for number in range(start, start + SWEEPS):
            update = localizer.process(drive.sweep(number))
            if update.status.solved:
                error = error_in_map(update, drive, map_T_world)
                right = np.linalg.norm(error[3:]) < RIGHT[0]
                right &= np.linalg.norm(error[:3]) < RIGHT[1]
                fixes.append((number - start + 1, bool(right)))
                break
    return fixes


def tracked(
    saved: SavedMap, drive: SimulatedWorld, map_T_world: FloatArray, *, inside: bool = False
) -> tuple[float, FloatArray, float, float]:
    """ATE and (N, 6) errors of a stretch, and NEES/6 with and without the map's own error."""
    part = PartOf(drive, len(drive) // 3, 1)
    result = localise(part, saved, max_frames=min(200, len(part)), inside=inside)
    updates = result.solved
    errors = np.array([error_in_map(u, drive, map_T_world) for u in updates]).reshape(-1, 6)
    nees = []
    for update, error in zip(updates, errors, strict=True):
        assert update.uncertainty is not None
        both = update.covariance, update.uncertainty.own
        nees.append([error @ np.linalg.solve(covariance, error) / 6.0 for covariance in both])
    with_map, without = np.mean(nees, axis=0).tolist() if nees else (np.nan, np.nan)
    ate = absolute_error(result.trajectory, drive.truth).rmse if updates else np.nan
    return ate, errors, with_map, without


def with_changes(scene: Scene, share: float, seed: int) -> Scene:
    """The scene with a share of its objects changed: half of them gone, half moved."""
    rng, solids = np.random.default_rng([seed, 77]), scene.solids

    def change(rows: FloatArray) -> tuple[FloatArray, BoolArray]:
        chosen, gone = rng.random(len(rows)) < share, rng.random(len(rows)) < 0.5
        moved, away = rows.copy(), chosen & ~gone
        moved[away, :2] += rng.uniform(-_FAR, _FAR, (int(away.sum()), 2))
        return moved, ~(chosen & gone)

    boxes, cylinders, round_ones = map(change, (solids.boxes, solids.cylinders, solids.ellipsoids))
    changed = replace(
        solids,
        boxes=boxes[0][boxes[1]],
        cylinders=cylinders[0][cylinders[1]],
        ellipsoids=round_ones[0][round_ones[1]],
        foliage=solids.foliage[round_ones[1]],
    )
    return replace(scene, solids=changed)


def error_in_map(update: MapUpdate, drive: SimulatedWorld, map_T_world: FloatArray) -> FloatArray:
    """(6,) tangent from the pose to the true one, in the frame of the map."""
    stamp = np.array([update.stamp], np.int64)
    true = map_T_world @ drive.world_T_start @ drive.truth_at(stamp).map_T_lidar[0]
    error: FloatArray = update.map_T_lidar.localCoordinates(gtsam.Pose3(true))
    return error


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean())) if len(errors) else np.nan


if __name__ == "__main__":
    sys.exit(main())
