"""Several estimators on the same sweeps, and what came of each.

Sweep by sweep, one estimator after the other: all of them see the same state of the machine.
Features are extracted once per sweep and handed to all of ours; peers get the points and times
those features were taken from.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import gtsam
import numpy as np

from loam_gtsam.config import PRESETS, Config, load_config
from loam_gtsam.datasets.base import Dataset, Sweep
from loam_gtsam.evaluation import absolute_error, distance_travelled, interpolate, relative_error
from loam_gtsam.features import extract_features
from loam_gtsam.mapper import Mapper
from loam_gtsam.odometry import Guess, make_odometry
from loam_gtsam.peers import PEERS, Peer, TimedPoints, make_peer, version
from loam_gtsam.pipeline import OnFrame, effective_config
from loam_gtsam.sweep import assign_rings, assign_times, usable_columns
from loam_gtsam.types import (
    BadSweep,
    ConfigError,
    Features,
    FeatureSweep,
    FloatArray,
    FrameStatus,
    InputError,
    LoamError,
    MapUpdate,
    Scan,
    SweepError,
    Trajectory,
)

_PRESET_OF = {"gtsam": "default"}
"""Solver names that are not the name of their preset."""
_SHARED = ("sensor", "features", "deskew")
"""Sections all of ours take from the first of them: they decide what the features are."""


@dataclass(frozen=True, slots=True)
class Contender:
    """One estimator to run.

    Attributes
    ----------
    name : of ours a preset (``gtsam`` is the default one), of a peer as in :data:`PEERS`
    config : of ours; None for a peer
    """

    name: str
    config: Config | None = None


def solver_names() -> tuple[str, ...]:
    """All names :func:`contender` knows: ours first."""
    named = {preset: name for name, preset in _PRESET_OF.items()}
    return (*(named.get(preset, preset) for preset in PRESETS), *PEERS)


def contender(name: str) -> Contender:
    """The contender called ``name``; a name that ends in .yaml or .yml is a configuration file.

    Raises
    ------
    ConfigError
        If there is none, or the file does not fit.
    """
    if name in PEERS:
        return Contender(name)
    if Path(name).suffix in (".yaml", ".yml"):
        return Contender(Path(name).stem, load_config(name))
    preset = _PRESET_OF.get(name, name)
    if preset not in PRESETS:
        raise ConfigError(
            f"unknown solver {name!r}; expected one of {', '.join(solver_names())}, or a "
            "configuration file (.yaml)"
        )
    return Contender(name, PRESETS[preset])


@dataclass(frozen=True, slots=True)
class SolverRun:
    """What one estimator made of the sweeps.

    Attributes
    ----------
    name, version : of the contender; that of the package it comes from
    config : as used; None for a peer
    updates : one per sweep; of a peer only stamp, pose, status and time are meaningful
    map_points : of the whole map; of a peer those it still keeps, or its voxels
    problem : what ended it early, else ""
    """

    name: str
    version: str
    config: Config | None
    updates: tuple[MapUpdate, ...]
    map_points: int
    problem: str = ""

    @property
    def used(self) -> tuple[int, ...]:
        """Numbers of the frames with a pose of its own; predicted ones count, of ours."""
        if self.config is None:
            wanted = [update.status is FrameStatus.OK for update in self.updates]
        else:
            wanted = [update.status is not FrameStatus.BAD_STAMP for update in self.updates]
        return tuple(np.flatnonzero(wanted).tolist())

    @property
    def trajectory(self) -> Trajectory:
        """The poses of the frames ``used``."""
        good = [self.updates[number] for number in self.used]
        poses = np.array([u.map_T_lidar.matrix() for u in good]).reshape(-1, 4, 4)
        return Trajectory(np.array([u.stamp for u in good], np.int64), poses)


@dataclass(frozen=True, slots=True)
class Comparison:
    """What :func:`compare` gives.

    Attributes
    ----------
    name : of the data set
    runs : in the order they were named
    truth : of the data set, or None
    notes : what a reader of the numbers must know
    interrupted, error : as :class:`loam_gtsam.pipeline.RunResult`
    """

    name: str
    runs: tuple[SolverRun, ...]
    truth: Trajectory | None
    notes: tuple[str, ...] = ()
    interrupted: bool = False
    error: Exception | None = None

    @property
    def frames(self) -> int:
        """Sweeps that all of them have seen."""
        return len(self.runs[0].updates)

    @property
    def reference(self) -> Trajectory:
        """What errors are taken against: the truth, else what the first-named solver found."""
        return self.runs[0].trajectory if self.truth is None else self.truth


@dataclass(frozen=True, slots=True)
class Scores:
    """The numbers of one run; NaN where there is none. Defined in ``docs/compare.md``.

    Attributes
    ----------
    ate_m, ate_max_m, rotation_deg : :class:`loam_gtsam.evaluation.AbsoluteError`, aligned
    rpe_percent, rpe_deg_per_m : :class:`loam_gtsam.evaluation.RelativeError` over ``lengths`` (m)
    path_m : length of the reference that was compared
    iterations, solver_iterations : associations and solver steps, mean of the solved frames
    matches : of the last association, median of the solved frames
    ms_median, ms_95 : milliseconds a frame without reading, after the first frame
    solved : frames with a pose from a solve
    problem : why an error is missing
    """

    ate_m: float = np.nan
    ate_max_m: float = np.nan
    rotation_deg: float = np.nan
    rpe_percent: float = np.nan
    rpe_deg_per_m: float = np.nan
    path_m: float = np.nan
    iterations: float = np.nan
    solver_iterations: float = np.nan
    matches: float = np.nan
    ms_median: float = np.nan
    ms_95: float = np.nan
    map_points: int = 0
    solved: int = 0
    lengths: tuple[float, ...] = ()
    problem: str = ""


def compare(
    dataset: Dataset,
    contenders: Sequence[Contender],
    *,
    max_frames: int | None = None,
    shared_guess: bool = False,
    on_frame: OnFrame | None = None,
) -> Comparison:
    """Run several estimators on one data set.

    Parameters
    ----------
    contenders : the first one is the reference where there is no truth
    max_frames : stop after so many sweeps
    shared_guess : give the step each guess of the first of ours makes from its last pose, and its
        twist, to all of ours; else each predicts from its own motion
    on_frame : called with the number of each sweep and the first contender's result; a
        KeyboardInterrupt raised there ends the comparison, and what is there is returned

    Returns
    -------
    Comparison
        An error that ends it after the first sweeps is in ``error``.

    Raises
    ------
    InputError
        If there is no contender, or two have the same name.
    PeerError
        If a peer is not installed.
    DatasetError
        If the data set cannot be read.
    """
    names = [entry.name for entry in contenders]
    repeated = {name for name in names if names.count(name) > 1}
    if not names or repeated:
        raise InputError(
            f"compare: expected solvers of different names, got {', '.join(names) or 'none'}"
        )
    configs, notes = _common_configs(contenders, dataset)
    estimators = [
        _Theirs(make_peer(entry.name)) if config is None else _Ours(entry.name, config)
        for entry, config in zip(contenders, configs, strict=True)
    ]
    first = next((config for config in configs if config is not None), None)
    config = first or effective_config(Config(), dataset)
    kinds = {type(estimator) for estimator in estimators}
    error: Exception | None = None
    interrupted = False
    done = 0
    try:
        sweeps = _prepare(dataset, config, ours=_Ours in kinds, theirs=_Theirs in kinds)
        for number, sweep in enumerate(sweeps):
            if number == max_frames:
                break
            step = None
            for estimator in estimators:
                given = estimator.register(sweep, step)
                step = step or given if shared_guess else None
            done += 1
            if on_frame is not None:
                on_frame(number, estimators[0].updates[-1])
    except KeyboardInterrupt:
        interrupted = True
    except Exception as caught:
        if not done:
            raise
        error = caught
    return Comparison(
        name=dataset.name,
        runs=tuple(estimator.result(done) for estimator in estimators),
        truth=dataset.truth,
        notes=tuple(notes),
        interrupted=interrupted,
        error=error,
    )


def score(run: SolverRun, reference: Trajectory | None) -> Scores:
    """The numbers of a run, with errors against ``reference`` if there is one."""
    solved = [update for update in run.updates if update.status.solved]
    ours = run.config is not None
    seconds = np.array([sum(update.timings.values()) for update in run.updates if update.timings])
    # The first frame loads, compiles and has no map to match: it is no time of a frame.
    milliseconds = 1e3 * seconds[1:]
    result = Scores(map_points=run.map_points, solved=len(solved), problem=run.problem)
    if len(milliseconds):
        median, high = np.percentile(milliseconds, (50.0, 95.0))
        result = replace(result, ms_median=float(median), ms_95=float(high))
    if ours and solved:
        matches = [update.n_edge_matches + update.n_plane_matches for update in solved]
        result = replace(
            result,
            iterations=float(np.mean([update.iterations for update in solved])),
            solver_iterations=float(np.mean([update.solver_iterations for update in solved])),
            matches=float(np.median(matches)),
        )
    if reference is None:
        return result
    problems = [run.problem] if run.problem else []
    try:
        absolute = absolute_error(run.trajectory, reference)
        there = interpolate(reference, absolute.stamps)
        result = replace(
            result,
            ate_m=absolute.rmse,
            ate_max_m=absolute.maximum,
            rotation_deg=absolute.rotation_rmse_deg,
            path_m=float(distance_travelled(there.map_T_lidar[:, :3, 3])[-1]),
        )
        relative = relative_error(run.trajectory, reference)
        result = replace(
            result,
            rpe_percent=relative.translation_percent,
            rpe_deg_per_m=relative.rotation_deg_per_m,
            lengths=tuple(relative.lengths.tolist()),
        )
    except InputError as problem:  # no overlap in time, or too short a path
        problems.append(str(problem))
    return replace(result, problem="; ".join(problems))


def timed_points(scan: Scan, config: Config) -> TimedPoints:
    """What a peer is given: the points and times our own pipeline works with.

    Raises
    ------
    SweepError
        If the sweep has too few points, or no times can be had.
    """
    columns = usable_columns(scan, config)
    timing = assign_times(columns, assign_rings(columns, config.sensor), config)
    points = np.ascontiguousarray(columns.xyz.T, dtype=np.float64)
    return TimedPoints(points, np.asarray(timing.times, np.float64), timing.span)


@dataclass(frozen=True, slots=True)
class _Step:
    """A guess, seen from the pose before: what can be handed to another solver."""

    last_T_guess: gtsam.Pose3
    twist: FloatArray | None


@dataclass(frozen=True, slots=True)
class _Prepared:
    """One sweep as the estimators take it.

    Attributes
    ----------
    problem : why there are no features, and no points
    features, seconds : features, and the time their extraction took
    recorded : motion since the sweep before, by recorded odometry
    points : for peers
    """

    stamp: int
    problem: str = ""
    features: Features | None = None
    seconds: float = 0.0
    recorded: gtsam.Pose3 | None = None
    points: TimedPoints | None = None


def _prepare(dataset: Dataset, config: Config, ours: bool, theirs: bool) -> Iterator[_Prepared]:
    last_odom: gtsam.Pose3 | None = None
    for sweep in dataset:
        prepared = _prepared(sweep, config, ours, theirs)
        if isinstance(sweep, FeatureSweep):
            if last_odom is not None:
                prepared = replace(prepared, recorded=last_odom.between(sweep.odom_T_lidar))
            last_odom = sweep.odom_T_lidar
        yield prepared


def _prepared(sweep: Sweep, config: Config, ours: bool, theirs: bool) -> _Prepared:
    if isinstance(sweep, BadSweep):
        return _Prepared(sweep.stamp, sweep.message)
    if isinstance(sweep, FeatureSweep):
        if theirs:
            raise InputError("peers need the points of raw sweeps; this data set has features only")
        return _Prepared(sweep.features.stamp, features=sweep.features)
    try:
        points = timed_points(sweep, config) if theirs else None
        started = time.perf_counter()
        features = extract_features(sweep, config) if ours else None
        return _Prepared(
            sweep.stamp,
            features=features,
            seconds=time.perf_counter() - started,
            points=points,
        )
    except SweepError as error:
        return _Prepared(sweep.stamp, str(error))


@dataclass(slots=True)
class _Ours:
    """A mapper with its own odometry."""

    name: str
    config: Config
    updates: list[MapUpdate] = field(default_factory=list)

    def __post_init__(self) -> None:
        ...
