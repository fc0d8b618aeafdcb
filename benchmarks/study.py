"""Where do the factor graph and the classical solvers differ? ``python -m benchmarks.study``.

Single solves against a map built from exact poses, so that nothing but the solve (with its own
association and map policy) makes the difference: convergence basin, outliers, degenerate corridor,
cost at the optimum. The same numbers come out on every run.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.study_figures import averages, draw, summary, write_fields
from benchmarks.study_variants import (
    ALONG,
    CAUCHY,
    CHANGES,
    CORRIDOR,
    DEGREES,
    FULL,
    GUESS,
    INSIDE,
    MAIN,
    METRES,
    NEAR,
    QUICK,
    SCENES,
    SHARE,
    SHARES,
    SHIFT,
    SHORT_RANGE,
    Effort,
    Measured,
    Result,
    Trial,
    Variant,
)
from loam_gtsam.config import Config, FeatureConfig, MapConfig, preset
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.geometry import transform
from loam_gtsam.mapper import make_solver
from loam_gtsam.registration.association import associate
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.solvers import MotionPrior, Solution, match_rows
from loam_gtsam.studies.same_matches import disturbed
from loam_gtsam.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Cloud:
    """Features of a sweep: (E, 3) and (P, 3) metres, lidar frame; (E,) which edges are distinct."""

    edges: FloatArray
    planes: FloatArray
    distinct: BoolArray

    def changed(self, change: Callable[[FloatArray], FloatArray]) -> Cloud:
        """The same rows, elsewhere."""
        return Cloud(change(self.edges), change(self.planes), self.distinct)


class Sweep:
    """A sweep as each variant sees it, de-skewed to its middle with the exact motion.

    Attributes
    ----------
    truth : pose at the middle
    clouds : by the way to extract features
    """

    def __init__(self, world: SimulatedWorld, number: int, kinds: Iterable[FeatureConfig]) -> None:
        self.clouds: dict[FeatureConfig, Cloud] = {}
        scan = world.sweep(number)
        assert scan.span is not None
        half = 0.5 * scan.span[1]
        stamps = scan.stamp + np.round(np.array([0.0, half, 2.0 * half]) * 1e9).astype(np.int64)
        start, self.truth, end = map(gtsam.Pose3, world.truth_at(stamps).map_T_lidar)
        twist = gtsam.Pose3.Logmap(start.between(end)) / (2.0 * half)
        for kind in kinds:
            config = Config().changed(features=kind)
            moving = MovingSweep(extract_features(scan, config), config)
            self.clouds[kind] = Cloud(*moving.at(twist).points, moving.distinct)


class Place:
    """Maps of one scene, one for each way to extract features and to keep a map."""

    def __init__(self, world: SimulatedWorld, variants: Iterable[Variant]) -> None:
        self.along = np.asarray(world.world_T_start)[0, :3]
        self.maps: dict[tuple[FeatureConfig, MapConfig], tuple[CubeMap, CubeMap]] = {}
        for config in (variant.config for variant in variants):
            self.maps[config.features, config.map] = (
                CubeMap(config.map, config.map.edge_voxel),
                CubeMap(config.map, config.map.plane_voxel),
            )

    def insert(self, sweep: Sweep) -> None:
        """Add a sweep at its true pose."""
        pose = sweep.truth.matrix()
        for (kind, _), maps in self.maps.items():
            cloud = sweep.clouds[kind]
            for cubes, points in zip(maps, (cloud.edges, cloud.planes), strict=True):
                cubes.recenter(pose[:3, 3])
                cubes.insert(transform(pose, points))

    def matches(self, variant: Variant, cloud: Cloud, pose: gtsam.Pose3) -> ScanMatches:
        """Matches of a variant at a pose, before its robust kernel."""
        config = variant.config
        maps = self.maps[config.features, config.map]
        return associate(cloud.edges, cloud.planes, pose, *maps, config.matching, cloud.distinct)

    def solve(self, variant: Variant, cloud: Cloud, guess: gtsam.Pose3) -> Solution:
        """One frame, as the mapper would do it but without a second de-skew."""

        def matches_at(pose: gtsam.Pose3) -> ScanMatches:
            return robust(self.matches(variant, cloud, pose), variant.kernel)

        config = variant.config.solver
        # What constant velocity is believed to within after a tenth of a second.
        away = 0.5 * 0.1**2 * np.repeat([config.turn_sigma, config.acceleration_sigma], 3)
        motion = MotionPrior(guess, np.diag(away**-2.0))
        return make_solver(config).solve(matches_at, guess, (), motion)


def robust(matches: ScanMatches, kernel: str) -> ScanMatches:
    """The matches with weights of a robust kernel on distance over sigma, frozen as they are now.

    A match's row is multiplied by its weight, so the kernel's weight enters by its square root.
    """
    if not kernel:
        return matches
    edges, planes = matches.edges, matches.planes
    pulls = [np.abs(part.distances) / part.sigmas for part in (edges, planes)]
    unit = 1.0
    if kernel.startswith("scaled"):
        unit = max(1.0, 1.4826 * float(np.median(np.concatenate(pulls))))

    def shrunk(weights: FloatArray, pull: FloatArray) -> FloatArray:
        shrunken: FloatArray = weights / np.sqrt(1.0 + (pull / unit / CAUCHY) ** 2)
        return shrunken

    return ScanMatches(
        replace(edges, weights=shrunk(edges.weights, pulls[0])),
        replace(planes, weights=shrunk(planes.weights, pulls[1])),
    )


def with_random_points(points: FloatArray, share: float, rng: np.random.Generator) -> FloatArray:
    """Replace a share of (N, 3) points by others, uniform in the box of all."""
    count = round(share * len(points))
    if not count:  # no points, no box
        return points
    which = rng.permutation(len(points))[:count]
    out = points.copy()
    out[which] = rng.uniform(points.min(axis=0), points.max(axis=0), (count, 3))
    return out


def with_moving_object(
    points: FloatArray, share: float, azimuth: float, shift: FloatArray
) -> FloatArray:
    """Shift the share of (N, 3) points nearest in azimuth (rad) to one by ``shift`` (3,)."""
    off = np.angle(np.exp(1j * (np.arctan2(points[:, 1], points[:, 0]) - azimuth)))
    which = np.argsort(np.abs(off), kind="stable")[: round(share * len(points))]
    out = points.copy()
    out[which] += shift
    return out


def study_scene(scene: str, effort: Effort) -> list[Result]:
    """Basin, outliers and costs of one scene; the bare corridor has a study of its own."""
    bare = scene == "corridor_bare"
    variants = CORRIDOR if bare else (*MAIN, *CHANGES)
    first = effort.first + (INSIDE if bare else 0)
    last = first + effort.spacing * (effort.targets - 1)
    world = SimulatedWorld(
        scene,
        frames=last + 1,
        columns=effort.columns,
        max_range=SHORT_RANGE if bare else 100.0,
    )
    place = Place(world, variants)
    kinds = list(dict.fromkeys(variant.config.features for variant in variants))
    results: list[Result] = []
    for number in range(first - effort.mapped, last + 1):
        sweep = Sweep(world, number, kinds)
        if number >= first and (number - first) % effort.spacing == 0:
            seed = (sum(map(ord, scene)), number)
            if bare:
                results += bare_corridor(place, sweep, effort, seed)
            else:
                for variant in variants:
                    results += basin(place, variant, sweep, scene, effort, seed)
                    results += outliers(place, variant, sweep, scene, effort, seed)
                results += costs(place, sweep, scene)
        place.insert(sweep)
    return results


def basin(
    place: Place,
    variant: Variant,
    sweep: Sweep,
    scene: str,
    effort: Effort,
    seed: tuple[int, int],
) -> Iterator[Trial]:
    """Solves from the truth and from errors of the guess."""
    solve = partial(place.solve, variant, sweep.clouds[variant.config.features])
    trial = partial(_trial, scene=scene, variant=variant, truth=sweep.truth, along=place.along)
    goal = solve(sweep.truth)
    yield trial("from truth", level=0.0, solution=goal, goal=goal)
    changed = variant in CHANGES  # of these, only what may differ
    levels = [("metres", level, (level, 0.0)) for level in METRES[4 * changed :]]
    levels += [("degrees", level, (0.0, level)) for level in DEGREES[3 * changed :]]
    starts = effort.starts // 2 if changed else effort.starts
    for study, level, error in levels:
        # The same starts for every solver.
        rng = np.random.default_rng([*seed, round(100 * level), len(study)])
        for _ in range(starts):
            found = solve(disturbed(sweep.truth, *error, rng))
            yield trial(study, level=level, solution=found, goal=goal)


def outliers(
    place: Place,
    variant: Variant,
    sweep: Sweep,
    scene: str,
    effort: Effort,
    seed: tuple[int, int],
) -> Iterator[Trial]:
    """Solves of a sweep with random points, or with a sector that has moved since."""
    trial = partial(_trial, scene=scene, variant=variant, truth=sweep.truth, along=place.along)
    cloud = sweep.clouds[variant.config.features]
    goal = place.solve(variant, cloud, sweep.truth)
    for share in (SHARE,) if variant in CHANGES else SHARES:
        for start in range(effort.starts // 2):
            rng = np.random.default_rng([*seed, round(100 * share), start, 3])
            guess = disturbed(sweep.truth, *GUESS, rng)
            azimuth, heading = rng.uniform(-np.pi, np.pi, 2)
            shift = SHIFT * np.array([np.cos(heading), np.sin(heading), 0.0])
            changes: dict[str, Callable[[FloatArray], FloatArray]] = {
                "random outliers": partial(with_random_points, share=share, rng=rng),
                "moving outliers": partial(
                    with_moving_object, share=share, azimuth=azimuth, shift=shift
                ),
            }
            for study, change in changes.items():
                found = place.solve(variant, cloud.changed(change), guess)
                yield trial(study, level=share, solution=found, goal=goal)


def costs(place: Place, sweep: Sweep, scene: str) -> Iterator[Measured]:
    """Each solution under each cost, all on the matches at the truth, per match."""
    clouds = {variant.name: sweep.clouds[variant.config.features] for variant in MAIN}
    found = {
        variant.name: place.solve(variant, clouds[variant.name], sweep.truth).map_T_lidar
        for variant in MAIN
    }
    for variant in MAIN:
        matches = place.matches(variant, clouds[variant.name], sweep.truth)
        for name, pose in found.items():
            value = cost(matches, pose, variant.name) / len(matches)
            yield Measured("cost", scene, name, f"under {variant.name}", value)


def cost(matches: ScanMatches, pose: gtsam.Pose3, of: str) -> float:
    """What a main variant minimises: whitened squares with the kernel's weights, metres squared,
    or Huber's in metres.
    """
    e, p = matches.edges, matches.planes
    if of != "default":
        matches = ScanMatches(
            replace(e, sigmas=np.ones(len(e))), replace(p, sigmas=np.ones(len(p)))
        )
    width = Config().solver.kernel_width if of == "default" else math.inf
    residual, _ = match_rows(matches, width).residuals(pose)
    squares = residual**2
    squares = np.concatenate([squares[: 2 * len(e)].reshape(-1, 2).sum(1), squares[2 * len(e) :]])
    if of == "aloam":
        delta = preset("aloam").solver.huber_delta
        far = squares > delta**2
        squares[far] = 2.0 * delta * np.sqrt(squares[far]) - delta**2
    return 0.5 * float(squares.sum())


def bare_corridor(
    place: Place, sweep: Sweep, effort: Effort, seed: tuple[int, int]
) -> Iterator[Result]:
    """Solves where the way along cannot be seen, from a guess that is wrong in it."""
    scene = "corridor_bare"
    for variant in CORRIDOR:
        trial = partial(_trial, scene=scene, variant=variant, truth=sweep.truth, along=place.along)
        solve = partial(place.solve, variant, sweep.clouds[variant.config.features])
        goal = solve(sweep.truth)
        yield trial("from truth", level=0.0, solution=goal, goal=goal)
        for number, value in enumerate(np.linalg.eigvalsh(goal.information)):
            yield Measured("eigenvalue", scene, variant.name, str(number + 1), float(value))
        for start in range(effort.starts):
            rng = np.random.default_rng([*seed, start])
            guess = disturbed(sweep.truth, *GUESS, rng)
            side = np.sign(rng.uniform(-1.0, 1.0))
            error = guess.translation() - sweep.truth.translation()
            shift = side * ALONG - error @ place.along
            guess = gtsam.Pose3(guess.rotation(), guess.translation() + shift * place.along)
            yield trial("wrong along", level=ALONG, solution=solve(guess), goal=goal)


def _trial(
    study: str,
    *,
    scene: str,
    variant: Variant,
    level: float,
    truth: gtsam.Pose3,
    along: FloatArray,
    solution: Solution,
    goal: Solution,
) -> Trial:
    pose = solution.map_T_lidar
    metres, degrees = _apart(pose, truth)
    near = _apart(pose, goal.map_T_lidar)
    error = pose.translation() - truth.translation()
    ahead = float(error @ along)
    return Trial(
        study,
        scene,
        variant.name,
        level,
        solution.solved and near[0] < NEAR[0] and near[1] < NEAR[1],
        metres,
        degrees,
        abs(ahead),
        float(np.linalg.norm(error - ahead * along)),
        solution.iterations,
        solution.converged,
    )


def _apart(a: gtsam.Pose3, b: gtsam.Pose3) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    turn = np.linalg.norm(gtsam.Rot3.Logmap(a.rotation().between(b.rotation())))
    return float(np.linalg.norm(a.translation() - b.translation())), float(np.degrees(turn))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.study", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one sweep of one scene, two starts")
    root = Path(__file__).resolve().parents[1]
    parser.add_argument("--output", type=Path, help="for study/*.csv, images/study_*.png; "
                        "docs, or benchmarks/results with --quick")  # fmt: skip
    options = parser.parse_args(arguments)
    folder = options.output or root / ("benchmarks/results" if options.quick else "docs")
    effort, scenes = (QUICK, ("room",)) if options.quick else (FULL, SCENES)
    with ProcessPoolExecutor(2) as pool:
        parts = pool.map(partial(study_scene, effort=effort), (*scenes, "corridor_bare"))
        results = [result for part in parts for result in part]
    rows, numbers = summary(results), averages(results)
    write_fields(folder / "study" / "trials.csv", rows)
    write_fields(folder / "study" / "numbers.csv", numbers)
    draw(folder / "images", rows, numbers)
    print(f"{sum(isinstance(r, Trial) for r in results)} solves; tables in {folder / 'study'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
