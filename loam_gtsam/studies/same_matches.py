"""Solvers on the same matches: every solver gets each frame of one run, with its map and its guess.

One of the solvers, or the truth, decides where the sweeps go into the map. All others are asked for
the pose of the same sweep, from the same guess, with the same search in the same map and the same
expected motion, so that nothing but the solve differs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.errors import check_count
from loam_gtsam.factors import scan_match_factor
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.workers import Extraction, extract
from loam_gtsam.io.atomic import write_text
from loam_gtsam.pipeline import OnFrame, Pipeline, effective_config, imu_buffer
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.solvers import (
    POSE_KEY,
    Associate,
    Matcher,
    MotionPrior,
    ScanSolver,
    Solution,
    make_solver,
    match_rows,
)
from loam_gtsam.studies.comparison_report import write_csv
from loam_gtsam.studies.contenders import Contender
from loam_gtsam.studies.report_html import TextTable, list_html, page, table_html
from loam_gtsam.types import (
    FeatureSweep,
    FloatArray,
    InputError,
    MapUpdate,
    Scan,
    Sweep,
    Trajectory,
)

TRUTH = "truth"
"""Name of the truth as what places the sweeps in the map."""
DISTURBANCES = ((0.25, 2.5), (0.5, 5.0), (1.0, 10.0))
"""Metres and degrees by which guesses are disturbed."""
SAME_M, SAME_DEG = 0.05, 0.5
"""A solve from a disturbed guess came back if it ends so near to that from the guess itself."""


@dataclass(frozen=True, slots=True)
class Solve:
    """What one solver made of one frame.

    Attributes
    ----------
    solved, converged : see :class:`~loam_gtsam.registration.solvers.Solution`
    iterations, solver_iterations, matches : associations, steps over all of them, last matches
    metres, degrees : from the solution of the first solver
    error_m, error_deg : from the truth, if the truth places the sweeps in the map; else NaN
    cost : of this pose under the robust cost of the factor graph, on the matches that the first
        solver ended with, over the cost of the first solver's pose
    solve_ms, match_ms : in the solver itself, and in the search for its matches
    returned : by disturbance, whether the solve came back from a guess disturbed by so much
    """

    solved: bool
    converged: bool
    iterations: int
    solver_iterations: int
    matches: int
    metres: float
    degrees: float
    error_m: float
    error_deg: float
    cost: float
    solve_ms: float
    match_ms: float
    returned: tuple[bool, ...] = ()


@dataclass(frozen=True, slots=True)
class SameMatches:
    """The result of :func:`compare_on_same_matches`.

    Attributes
    ----------
    driver : what placed the sweeps in the map
    solves : by solver, one for each frame that was solved
    frames : their numbers
    disturbances : metres and degrees, in the order of ``Solve.returned``
    error : what ended the run early
    """

    name: str
    driver: str
    solves: Mapping[str, Sequence[Solve]]
    frames: Sequence[int]
    disturbances: Sequence[tuple[float, float]]
    error: Exception | None = None


def compare_on_same_matches(
    dataset: Dataset,
    contenders: Sequence[Contender],
    *,
    driver: str = "",
    disturbances: Sequence[tuple[float, float]] = DISTURBANCES,
    max_frames: int | None = None,
    on_frame: OnFrame | None = None,
    seed: int = 0,
) -> SameMatches:
    """Ask several solvers for the pose of every sweep, each with the same matches.

    A KeyboardInterrupt that ``on_frame`` raises ends the run.

    Parameters
    ----------
    contenders : solvers of the package or of a user's own; the configuration of the first one is
        that of the run
    driver : name of the contender whose poses place the sweeps in the map, or ``"truth"``; the
        first contender if empty
    disturbances : metres and degrees by which the guess is disturbed, in random directions
    seed : of these directions

    Raises
    ------
    InputError
        If a contender is no solver, two have the same name, or there is no such driver.
    """
    check_count(max_frames, "max_frames", optional=True)
    first = contenders[0].config if contenders else None
    names = [contender.name for contender in contenders]
    if first is None or any(c.config is None or "features" in c.parts for c in contenders):
        raise InputError("same matches: expected solvers; peers and front ends have no matches")
    driver = driver or names[0]
    if len(set(names)) < len(names) or driver not in (*names, TRUTH):
        raise InputError(
            f"same matches: expected solvers of different names, and one of them or {TRUTH!r} as "
            f"the driver; got {', '.join(names)}, and {driver!r}"
        )
    truth = dataset.truth
    if driver == TRUTH and truth is None:
        raise InputError("same matches: the data set has no truth to place the sweeps by")
    config = effective_config(first, dataset)
    solvers = {c.name: _solver_of(c) for c in contenders}
    judge = _Judge(solvers, config, driver, tuple(disturbances), np.random.default_rng(seed))
    pipeline = Pipeline(config, imu=imu_buffer(dataset, config), solver=judge)
    results: dict[str, list[Solve]] = {name: [] for name in names}
    frames: list[int] = []
    error: Exception | None = None
    try:
        for number, sweep in enumerate(islice(dataset, max_frames)):
            extraction = extract(sweep, config) if isinstance(sweep, Scan) else None
            judge.next_frame(_middle(sweep, extraction, config))
            update = pipeline.process(sweep, extraction)
            if truth is not None and judge.truth is None and update.status.has_pose:
                judge.truth = _Placed.of(truth, update)
            if judge.round is not None:
                frames.append(number)
                for name, solve in judge.solves().items():
                    results[name].append(solve)
            if on_frame is not None:
                on_frame(number, update)
    except KeyboardInterrupt:
        pass
    except Exception as caught:
        if not frames:
            raise
        error = caught
    return SameMatches(dataset.name, driver, results, frames, tuple(disturbances), error)


def _solver_of(contender: Contender) -> ScanSolver:
    assert contender.config is not None
    return contender.parts.get("solver") or make_solver(contender.config.solver)


def _middle(sweep: Sweep, extraction: Extraction | None, config: Config) -> int | None:
    """Nanoseconds of the middle of a sweep, to which its solution belongs; None if unusable."""
    features = sweep.features if isinstance(sweep, FeatureSweep) else None
    if extraction is not None:
        features = extraction.features
    return None if features is None else MovingSweep(features, config).stamp


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """The truth in the frame of the map."""

    truth: Trajectory
    map_T_truth: FloatArray

    @classmethod
    def of(cls, truth: Trajectory, first: MapUpdate) -> _Placed | None:
        """By the first pose of the map; None if the truth begins later."""
        here = cls(truth, np.eye(4)).at(first.stamp)
        if here is None:
            return None
        return cls(truth, first.map_T_lidar.compose(here.inverse()).matrix())

    def at(self, stamp: int) -> gtsam.Pose3 | None:
        """The true ``map_T_lidar``; None outside the truth."""
        if not self.truth.stamps[0] <= stamp <= self.truth.stamps[-1]:
            return None
        return gtsam.Pose3(self.map_T_truth).compose(self.truth.at(stamp))


class _Timed(Matcher):
    """A matcher that measures the time that it takes."""

    def __init__(self, inner: Matcher, spent: list[float]) -> None:
        super().__init__(inner)
        self._inner, self._spent = inner, spent

    def __call__(self, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        return self._measured(lambda: self._inner(map_T_lidar))

    def again(self, matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        return self._measured(lambda: self._inner.again(matches, map_T_lidar))

    @property
    def motion_is_free(self) -> bool:
        return self._inner.motion_is_free

    def deskewed(self, map_T_lidar: gtsam.Pose3, matches: ScanMatches) -> Matcher:
        started = time.perf_counter()
        inner = self._inner.deskewed(map_T_lidar, matches)
        self._spent.append(time.perf_counter() - started)
        return _Timed(inner, self._spent)

    def _measured(self, search: Callable[[], ScanMatches]) -> ScanMatches:
        started = time.perf_counter()
        matches = search()
        self._spent.append(time.perf_counter() - started)
        return matches


@dataclass(frozen=True, slots=True)
class _Round:
    """The first solve of a frame, by all solvers: solution, and seconds of solve and search."""

    found: Mapping[str, tuple[Solution, float, float]]
    returned: Mapping[str, tuple[bool, ...]]


class _Judge:
    """A solver for the mapper, which asks all solvers and answers with what the driver said."""

    def __init__(
        self,
        solvers: Mapping[str, ScanSolver],
        config: Config,
        driver: str,
        disturbances: tuple[tuple[float, float], ...],
        random: np.random.Generator,
    ) -> None:
        self.solvers, self.driver = solvers, driver
        self.truth: _Placed | None = None
        self.round: _Round | None = None
        self._config, self._disturbances, self._random = config.solver, disturbances, random
        self._exact: gtsam.Pose3 | None = None

    def next_frame(self, middle: int | None) -> None:
        """Forget the last frame; the solutions of the next belong to ``middle``, nanoseconds."""
        self.round = None
        known = middle is not None and self.truth is not None
        self._exact = self.truth.at(middle) if known else None  # type: ignore[union-attr,arg-type]

    def solve(
        self,
        associate: Associate,
        guess: gtsam.Pose3,
        priors: Sequence[gtsam.NonlinearFactor] = (),
        motion: MotionPrior | None = None,
    ) -> Solution:
        """See :meth:`loam_gtsam.registration.solvers.base.ScanSolver.solve`."""
        matcher = associate if isinstance(associate, Matcher) else Matcher(associate)
        driver = next(iter(self.solvers)) if self.driver == TRUTH else self.driver
        if self.round is not None:  # the mapper looks again, or elsewhere
            return self.solvers[driver].solve(matcher, guess, priors, motion)
        away = [disturbed(guess, *level, self._random) for level in self._disturbances]
        found, returned = {}, {}
        for name, solver in self.solvers.items():
            spent: list[float] = []
            started = time.perf_counter()
            solution = solver.solve(_Timed(matcher, spent), guess, priors, motion)
            seconds = time.perf_counter() - started
            found[name] = solution, seconds - sum(spent), sum(spent)
            ends = [solver.solve(matcher, start, priors, motion) for start in away]
            goal = solution.map_T_lidar
            returned[name] = tuple(e.solved and _near(goal, e.map_T_lidar) for e in ends)
        self.round = _Round(found, returned)
        answer = found[driver][0]
        if self.driver == TRUTH and self._exact is not None:
            return replace(answer, map_T_lidar=self._exact)
        return answer

    def solves(self) -> dict[str, Solve]:
        """What every solver made of the frame."""
        assert self.round is not None
        first = next(iter(self.round.found.values()))[0]
        rows = match_rows(first.matches, self._config.kernel_width, self._config.kernel)
        factor = scan_match_factor(POSE_KEY, rows) if len(first.matches) else None

        def cost(pose: gtsam.Pose3) -> float:
            values = gtsam.Values()
            values.insert(POSE_KEY, pose)
            return np.nan if factor is None else float(factor.error(values))

        least = cost(first.map_T_lidar)
        found = {}
        for name, (solution, solve_s, match_s) in self.round.found.items():
            pose = solution.map_T_lidar
            exact = self._exact if self.driver == TRUTH else None
            found[name] = Solve(
                solution.solved,
                solution.converged,
                solution.iterations,
                solution.solver_iterations,
                len(solution.matches),
                *_apart(first.map_T_lidar, pose),
                *((np.nan, np.nan) if exact is None else _apart(exact, pose)),
                cost(pose) / least if least > 0.0 else np.nan,
                1e3 * solve_s,
                1e3 * match_s,
                self.round.returned[name],
            )
        return found


def _apart(first: gtsam.Pose3, second: gtsam.Pose3) -> tuple[float, float]:
    """Metres and degrees from one pose to another."""
    step = first.between(second)
    angle = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
    return float(np.linalg.norm(step.translation())), float(np.degrees(angle))


def _near(goal: gtsam.Pose3, end: gtsam.Pose3) -> bool:
    metres, degrees = _apart(goal, end)
    return metres < SAME_M and degrees < SAME_DEG


def disturbed(
    pose: gtsam.Pose3, metres: float, degrees: float, random: np.random.Generator
) -> gtsam.Pose3:
    """The pose, moved and turned by so much in random directions."""
    turn, shift = random.standard_normal((2, 3))
    turn *= np.radians(degrees) / np.linalg.norm(turn)
    shift *= metres / np.linalg.norm(shift)
    return pose.compose(gtsam.Pose3(gtsam.Rot3.Expmap(turn), shift))


# -- the report ------------------------------------------------------------------------------------

FILES = ("same_matches.csv", "report.html")
_SHOWN = {
    "metres": ("apart [mm]", 1e3, 2, "median distance from the pose of the first solver"),
    "degrees": ("[deg]", 1.0, 4, "median angle from it"),
    "error_m": ("error [mm]", 1e3, 2, "median distance from the truth, if that makes the map"),
    "error_deg": ("error [deg]", 1.0, 4, "median angle from the truth, likewise"),
    "cost": ("cost", 1.0, 4, "robust cost of the pose on the last matches of the first solver, "
             "over that of the first solver's pose; median"),
    "iterations": ("assoc.", 1.0, 1, "associations, mean"),
    "solver_iterations": ("iter.", 1.0, 1, "steps of the solver over all associations, mean"),
    "solve_ms": ("solve [ms]", 1.0, 2, "time in the solver itself, median"),
    "match_ms": ("search [ms]", 1.0, 2, "time in the search for its matches, median"),
    "solved": ("solved", 1.0, 3, "share of the frames"),
    "converged": ("converged", 1.0, 3, "share of the frames that came below the stop rule"),
}  # fmt: skip
_MEANS = "iterations", "solver_iterations", "solved", "converged"


def table_of(results: SameMatches) -> TextTable:
    """A row for every solver: medians and shares over the frames."""
    rows = []
    for name, solves in results.solves.items():
        row = [name]
        for key, (_, unit, digits, _) in _SHOWN.items():
            values = np.array([getattr(solve, key) for solve in solves], np.float64)
            values = values[np.isfinite(values)]
            value = (np.mean if key in _MEANS else np.median)(values) if len(values) else np.nan
            row.append(f"{unit * float(value):.{digits}f}" if len(values) else "-")
        shares: Iterable[float] = ()
        if solves:
            shares = np.mean([solve.returned for solve in solves], axis=0)
        rows.append([*row, *(f"{100.0 * share:.0f}" for share in shares)])
    away = [f"back from {m:g} m, {deg:g} deg [%]" for m, deg in results.disturbances]
    return TextTable(["solver", *(title for title, *_ in _SHOWN.values()), *away], rows)


def write_same_matches(results: SameMatches, folder: Path) -> list[str]:
    """Write a table of all frames, and the report; returns the names of the files."""
    keys = [item.name for item in fields(Solve) if item.name != "returned"]
    away = [f"back_{m:g}m_{deg:g}deg" for m, deg in results.disturbances]
    rows: list[list[Any]] = []
    for name, solves in results.solves.items():
        for number, solve in zip(results.frames, solves, strict=True):
            values = [getattr(solve, key) for key in keys] + list(solve.returned)
            rows.append([name, number, *map(float, values)])
    write_csv(folder / FILES[0], ["solver", "frame", *keys, *away], rows)
    meaning = {title: text for title, _, _, text in _SHOWN.values()}
    meaning["back from"] = (
        f"share of the solves from a guess disturbed by so much, in a random direction, that end "
        f"within {SAME_M:g} m and {SAME_DEG:g} degrees of the same solver's own solution"
    )
    sections = {"Solves": table_html(table_of(results)), "Definitions": list_html(meaning)}
    title = f"Same matches on {results.name}"
    write_text(folder / FILES[1], page(title, [sentence_of(results)], sections))
    return [*FILES]


def sentence_of(results: SameMatches) -> str:
    """What was held equal."""
    return (
        f"{len(results.frames)} frames; the map is made by {results.driver}. In each frame all "
        "solvers have the same map, search of matches, guess and expected motion; each searches "
        "anew at its own poses."
    )
