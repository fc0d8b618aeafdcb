"""The comparison of several contenders on the same sweeps, and its numbers.

All contenders register a sweep before the next sweep is read: the conditions of the machine are the
same for all. Pipelines that want the same features share them; peers get the points these were
taken from.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from typing import Any, cast

import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.datasets.decode.aiding import aids_of
from loam_gtsam.errors import check_all, check_count
from loam_gtsam.pipeline import OnFrame, Parts, Pipeline, effective_config, imu_buffer
from loam_gtsam.registration.odometry import ConstantVelocity
from loam_gtsam.studies import evaluation
from loam_gtsam.studies.contenders import (
    Contender,
    MapSample,
    PeerRunner,
    PipelineRunner,
    SharedFeatures,
    SharedGuess,
    SolverRun,
)
from loam_gtsam.types import (
    DatasetError,
    FloatArray,
    FrameStatus,
    InputError,
    IntArray,
    Trajectory,
)


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of :func:`compare_solvers` on the data set called ``name``.

    Attributes
    ----------
    runs : group by group, the first one first
    notes : sentences that a reader of the numbers must know
    interrupted, error : whether the user, or which error, ended the comparison early
    shared_guess : whether all solvers of this package had the guesses of the first of them
    sample : points of the sweeps, by which maps are judged; None judges none
    """

    name: str
    runs: tuple[SolverRun, ...]
    truth: Trajectory | None
    notes: tuple[str, ...] = ()
    interrupted: bool = False
    error: Exception | None = None
    shared_guess: bool = False
    sample: MapSample | None = None

    @property
    def frames(self) -> int:
        """Number of sweeps that every contender has registered."""
        return len(self.runs[0].updates)

    @property
    def reference(self) -> Trajectory:
        """The trajectory that errors are taken against: the truth, else that of the first run."""
        return self.runs[0].trajectory if self.truth is None else self.truth


@dataclass(frozen=True, slots=True)
class Scores:
    """The numbers of one run, see ``docs/compare.md``; NaN where there is none.

    Attributes
    ----------
    path_m : length of the reference trajectory that was compared
    start_m : RMS distance of the positions if the first common poses are made equal: no fit
    statuses, faults : number of frames by status, and of unused sweeps by their fault
    solved : share of the frames after the first whose pose was solved; of a peer, that have a pose
    beyond : frames ``ok`` whose pose is off by more than five told standard deviations; NaN
        without truth or without covariances
    nees, nees_step : mean squared error over covariance, in degrees of freedom, of the poses since
        the start and of the motions from frame to frame: 1 if the covariances are right, infinite
        if one is broken
    broken : covariances of these poses and motions that are not positive definite
    iterations, solver_iterations : associations and solver steps, mean of the solved frames
    matches : number of matches of the last association, median of the solved frames
    ms_median, ms_95 : milliseconds per frame without reading, the first frame left out
    map_points : points of the whole map
    thickness_mm, planar_share, entropy : sharpness of the map that the poses make of the same
        points, see :class:`~loam_gtsam.refine.map_quality.MapQuality`; NaN without a plane
    lengths : metres, the path lengths of the relative error
    problem : why an error is missing
    """

    ate_m: float = np.nan
    ate_max_m: float = np.nan
    start_m: float = np.nan
    rotation_deg: float = np.nan
    rpe_percent: float = np.nan
    rpe_deg_per_m: float = np.nan
    path_m: float = np.nan
    statuses: Mapping[str, int] = field(default_factory=dict)
    faults: Mapping[str, int] = field(default_factory=dict)
    solved: float = np.nan
    beyond: float = np.nan
    nees: float = np.nan
    nees_step: float = np.nan
    broken: float = np.nan
    iterations: float = np.nan
    solver_iterations: float = np.nan
    matches: float = np.nan
    ms_median: float = np.nan
    ms_95: float = np.nan
    map_points: int = 0
    thickness_mm: float = np.nan
    planar_share: float = np.nan
    entropy: float = np.nan
    lengths: tuple[float, ...] = ()
    problem: str = ""


def compare_solvers(
    dataset: Dataset,
    contenders: Sequence[Contender],
    *,
    max_frames: int | None = None,
    shared_guess: bool = False,
    on_frame: OnFrame | None = None,
) -> Comparison:
    """Run several contenders on one data set.

    Raises InputError if there is no contender or two have the same name; PeerError if a peer is not
    installed; DatasetError if the data set cannot be read.

    Parameters
    ----------
    contenders : the first one is the reference where there is no truth
    max_frames : stop after so many sweeps; no further sweep is read
    shared_guess : see :class:`~loam_gtsam.studies.contenders.SharedGuess`
    on_frame : called with the number of each sweep and the first contender's result; a
        KeyboardInterrupt raised there ends the comparison, which then has the sweeps so far, as
        it has after an error later than the first sweep
    """
    check_count(max_frames, "max_frames", optional=True)
    _check_names(contenders)
    # Group by group, as the report shows them; the order within a group is the caller's.
    groups = list(dict.fromkeys(entry.group for entry in contenders))
    contenders = sorted(contenders, key=lambda entry: groups.index(entry.group))
    ended: BaseException | None = None
    done = 0
    first = next((entry.config for entry in contenders if entry.config is not None), Config())
    sample = MapSample(effective_config(first, dataset))
    with ExitStack() as stack:
        runners, notes = _make_runners(contenders, dataset, shared_guess, stack)
        try:
            for sweep in islice(dataset, max_frames):
                for runner in runners:
                    runner.register(sweep)
                sample.add(sweep)
                done += 1
                if on_frame is not None:
                    on_frame(done - 1, runners[0].updates[-1])
        except (KeyboardInterrupt, Exception) as caught:
            if not done:
                raise
            ended = caught
        runs = tuple(runner.result(done) for runner in runners)
    if not done:
        raise DatasetError(
            f"{dataset.name}: no sweeps in it; see what is understood with: loam-gtsam inspect"
        )
    return Comparison(
        name=dataset.name,
        runs=runs,
        truth=dataset.truth,
        notes=tuple(notes),
        interrupted=isinstance(ended, KeyboardInterrupt),
        error=ended if isinstance(ended, Exception) else None,
        shared_guess=shared_guess,
        sample=sample,
    )


def _check_names(contenders: Sequence[Contender]) -> None:
    how = "make_contender(Group.SOLVER, name, config) makes one"
    check_all(contenders, Contender, "contenders", how)
    names = [entry.name for entry in contenders]
    if not names or len(set(names)) < len(names):
        raise InputError(
            f"compare: expected contenders of different names, got {', '.join(names) or 'none'}"
        )


def _make_runners(
    contenders: Sequence[Contender], dataset: Dataset, shared_guess: bool, stack: ExitStack
) -> tuple[list[PipelineRunner | PeerRunner], list[str]]:
    configs = [entry.config and effective_config(entry.config, dataset) for entry in contenders]
    first = next((config for config in configs if config is not None), None)
    common = first or effective_config(Config(), dataset)
    runners: list[PipelineRunner | PeerRunner] = []
    notes: list[str] = []
    priors: list[str] = []
    features, guess = SharedFeatures(), None
    for entry, config in zip(contenders, configs, strict=True):
        if config is None:
            runners.append(PeerRunner.of(entry.peer, dataset, common))
        else:
            if config.sensor != common.sensor:
                notes.append(
                    f"{entry.name}: section sensor is that of the first, so that all get the same "
                    "points"
                )
                config = config.changed(sensor=common.sensor)
            imu = imu_buffer(dataset, config)
            # A guess that is shared takes the place of the contender's own odometry.
            parts = cast(Parts, dict(entry.parts) | ({} if guess is None else {"odometry": guess}))
            fixes, wheels = aids_of(dataset, config)
            pipeline = Pipeline(config, imu=imu, wheels=wheels, **parts)
            priors.append(pipeline.config.imu.prior)
            if imu is not None and priors[-1] != priors[0]:
                notes.append(
                    f"{entry.name}: the tilt of the IMU comes in by imu.prior {priors[-1]}, "
                    f"in the first by {priors[0]}"
                )
            if shared_guess and guess is None:
                steady = ConstantVelocity(pipeline.mapper.imu)
                pipeline.odometry = guess = SharedGuess(pipeline.odometry or steady)
            runners.append(PipelineRunner(entry, pipeline, features, fixes))
        stack.callback(runners[-1].close)
    return runners, notes


def score_all(comparison: Comparison) -> tuple[Scores, ...]:
    """The scores of every run, with relative errors over the same path lengths.

    Without truth the first run is the reference and has no errors itself.
    """
    references = [comparison.reference] * len(comparison.runs)
    exact = comparison.truth is not None
    pairs = list(zip(comparison.runs, [comparison.truth, *references[1:]], strict=True))
    scores = tuple(score(run, reference, exact=exact) for run, reference in pairs)
    found = {entry.lengths for entry in scores if entry.lengths}
    if len(found) > 1:
        # Some runs have poses over a part of the path only: the lengths must fit the shortest part.
        scores = tuple(score(run, reference, min(found), exact=exact) for run, reference in pairs)
    if comparison.sample is None:
        return scores
    maps = [comparison.sample.sharpness(run) for run in comparison.runs]
    return tuple(replace(entry, **values) for entry, values in zip(scores, maps, strict=True))


def score(
    run: SolverRun,
    reference: Trajectory | None,
    lengths: Sequence[float] | None = None,
    *,
    exact: bool = True,
) -> Scores:
    """The scores of one run, without errors if there is no reference.

    Parameters
    ----------
    lengths : of the relative error, in metres; those that fit the path if None
    exact : whether the reference is the truth, so that covariances can be held against it
    """
    values = _cost(run) | _frames(run)
    problems = [run.problem] if run.problem else []
    relative = partial(_relative, lengths=lengths)
    parts: list[Callable[[SolverRun, Trajectory], dict[str, Any]]] = [_absolute, relative]
    if exact and run.config is not None and not run.loops:
        parts.append(_consistency)
    for part in parts:
        if reference is None:
            break
        try:
            values |= part(run, reference)
        except InputError as problem:  # no overlap in time, positions alone, or too short a path
            problems.append(str(problem))
    return Scores(**values, problem="; ".join(dict.fromkeys(problems)))


def _frames(run: SolverRun) -> dict[str, Any]:
    good = [update.status.solved or run.config is None for update in run.updates]
    has = [update.status is FrameStatus.OK for update in run.updates]
    share = has if run.config is None else good[1:]
    return {
        "statuses": dict(Counter(str(update.status) for update in run.updates)),
        "faults": dict(Counter(str(u.fault) for u in run.updates if u.fault is not None)),
        "solved": float(np.mean(share)) if share else np.nan,
        "map_points": run.map_points,
    }


def _cost(run: SolverRun) -> dict[str, Any]:
    values: dict[str, Any] = {}
    seconds = [sum(update.timings.values()) for update in run.updates if update.timings]
    # The first frame loads code and has no map to match: its time is not that of a usual frame.
    if len(seconds) > 1:
        median, high = np.percentile(1e3 * np.array(seconds[1:]), (50.0, 95.0))
        values |= {"ms_median": float(median), "ms_95": float(high)}
    solved = [update for update in run.updates if update.status.solved]
    if run.config is not None and solved:
        matches = [update.n_edge_matches + update.n_plane_matches for update in solved]
        values |= {
            "iterations": float(np.mean([update.iterations for update in solved])),
            "solver_iterations": float(np.mean([update.solver_iterations for update in solved])),
            "matches": float(np.median(matches)),
        }
    return values


def _absolute(run: SolverRun, reference: Trajectory) -> dict[str, Any]:
    trajectory = run.trajectory
    absolute = evaluation.absolute_error(trajectory, reference)
    values: dict[str, Any] = {
        "ate_m": absolute.rmse,
        "ate_max_m": absolute.maximum,
        "rotation_deg": absolute.rotation_rmse_deg,
        "path_m": reference.at(absolute.stamps).path_length,
    }
    with suppress(InputError):  # positions alone, which the relative error says
        values["start_m"] = evaluation.absolute_error(trajectory, reference, aligned="start").rmse
    return values


def _relative(
    run: SolverRun, reference: Trajectory, lengths: Sequence[float] | None
) -> dict[str, Any]:
    given = None if lengths is None else np.array(lengths, np.float64)
    relative = evaluation.relative_error(run.trajectory, reference, given)
    return {
        "rpe_percent": relative.translation_percent,
        "rpe_deg_per_m": relative.rotation_deg_per_m,
        "lengths": tuple(relative.lengths.tolist()),
    }


def _consistency(run: SolverRun, truth: Trajectory) -> dict[str, Any]:
    since_start = evaluation.nees(run.updates, truth)
    ok = [n for n in since_start.beyond if run.updates[n].status is FrameStatus.OK]
    step = evaluation.nees(run.updates, truth, window=1)
    return {
        "nees": since_start.mean,
        "nees_step": step.mean,
        "broken": float(since_start.broken + step.broken),
        "beyond": float(len(ok)),
    }


@dataclass(frozen=True, slots=True, eq=False)
class FrameDifferences:
    """Distance (N,) of one solver's poses from those of the first-named one, in common frames."""

    frames: IntArray
    metres: FloatArray
    degrees: FloatArray


def frame_differences(comparison: Comparison) -> dict[str, FrameDifferences]:
    """Differences of the other solvers by name; a run too short to compare is left out."""
    first = comparison.runs[0].trajectory
    found = {}
    for run in comparison.runs[1:]:
        with suppress(InputError):
            stamps, *apart = evaluation.pose_differences(run.trajectory, first)
            frames = np.array(run.used, np.int64)[np.isin(run.trajectory.stamps, stamps)]
            found[run.name] = FrameDifferences(frames, *apart)
    return found
