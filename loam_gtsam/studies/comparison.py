"""The comparison of several solvers on the same sweeps, and its numbers.

All contenders register a sweep before the next sweep is read: the conditions of the machine are the
same for all. Pipelines share the features of a sweep; peers get the points these were taken from.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.pipeline import OnFrame, Pipeline, effective_config, imu_buffer
from loam_gtsam.registration.odometry import ConstantVelocity
from loam_gtsam.studies import evaluation
from loam_gtsam.studies.contenders import (
    Contender,
    PeerRunner,
    PipelineRunner,
    SharedGuess,
    SolverRun,
    extract_for_all,
)
from loam_gtsam.studies.peers import PEERS, make_peer
from loam_gtsam.types import DatasetError, FloatArray, InputError, IntArray, Trajectory

_SHARED = ("sensor", "features")
"""Sections of the configuration that all solvers of this package take from the first of them, with
``deskew.enabled`` and ``deskew.reference``: they decide the features and the moment of a pose."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of :func:`compare_solvers` on the data set called ``name``.

    Attributes
    ----------
    notes : sentences that a reader of the numbers must know
    interrupted, error : whether the user, or which error, ended the comparison early
    shared_guess : whether all solvers of this package had the guesses of the first of them
    """

    name: str
    runs: tuple[SolverRun, ...]
    truth: Trajectory | None
    notes: tuple[str, ...] = ()
    interrupted: bool = False
    error: Exception | None = None
    shared_guess: bool = False

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
    iterations, solver_iterations : associations and solver steps, mean of the solved frames
    matches : number of matches of the last association, median of the solved frames
    ms_median, ms_95 : milliseconds per frame without reading, the first frame left out
    map_points, solved : points of the whole map, frames whose pose was solved
    lengths : metres, the path lengths of the relative error
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


def compare_solvers(
    dataset: Dataset,
    contenders: Sequence[Contender],
    *,
    max_frames: int | None = None,
    shared_guess: bool = False,
    on_frame: OnFrame | None = None,
) -> Comparison:
    """Run several solvers on one data set.

    Raises InputError if there is no contender, two have the same name, or two peers cannot run side
    by side; PeerError if a peer is not installed; DatasetError if the data set cannot be read.

    Parameters
    ----------
    contenders : the first one is the reference where there is no truth
    max_frames : stop after so many sweeps; no further sweep is read
    shared_guess : see :class:`~loam_gtsam.studies.contenders.SharedGuess`
    on_frame : called with the number of each sweep and the first contender's result; a
        KeyboardInterrupt raised there ends the comparison, which then has the sweeps so far, as
        it has after an error later than the first sweep
    """
    _check_names(contenders)
    runners, first, notes = _make_runners(contenders, dataset, shared_guess)
    ended: BaseException | None = None
    done = 0
    try:
        for sweep in islice(dataset, max_frames):
            extraction = None if first is None else extract_for_all(sweep, first)
            for runner in runners:
                runner.register(sweep, extraction)
            done += 1
            if on_frame is not None:
                on_frame(done - 1, runners[0].updates[-1])
    except (KeyboardInterrupt, Exception) as caught:
        if not done:
            raise
        ended = caught
    if not done:
        raise DatasetError(
            f"{dataset.name}: no sweeps in it; see what is understood with: loam-gtsam inspect"
        )
    return Comparison(
        name=dataset.name,
        runs=tuple(runner.result(done) for runner in runners),
        truth=dataset.truth,
        notes=tuple(notes),
        interrupted=isinstance(ended, KeyboardInterrupt),
        error=ended if isinstance(ended, Exception) else None,
        shared_guess=shared_guess,
    )


def _check_names(contenders: Sequence[Contender]) -> None:
    names = [entry.name for entry in contenders]
    if not names or len(set(names)) < len(names):
        raise InputError(
            f"compare: expected solvers of different names, got {', '.join(names) or 'none'}"
        )
    packages = [PEERS[name].package for name in names if name in PEERS and PEERS[name].alone]
    if len(set(packages)) < len(packages):
        raise InputError(
            f"compare: instances of {packages[0]} in one process disturb each other; compare its "
            "variants in two comparisons"
        )


def _make_runners(
    contenders: Sequence[Contender], dataset: Dataset, shared_guess: bool
) -> tuple[list[PipelineRunner | PeerRunner], Config | None, list[str]]:
    configs = [entry.config and effective_config(entry.config, dataset) for entry in contenders]
    found = ((entry.name, c) for entry, c in zip(contenders, configs, strict=True) if c is not None)
    name, first = next(found, ("", None))
    common = first or effective_config(Config(), dataset)
    runners: list[PipelineRunner | PeerRunner] = []
    notes: list[str] = []
    guess: SharedGuess | None = None
    for entry, config in zip(contenders, configs, strict=True):
        if config is None:
            runners.append(PeerRunner(make_peer(entry.name), common))
            continue
        shared: dict[str, Any] = {section: getattr(common, section) for section in _SHARED}
        # How often and from what rotation a sweep is de-skewed again is part of the method.
        own = config.deskew
        shared["deskew"] = common.deskew.changed(refine=own.refine, rotation=own.rotation)
        notes += (
            f"{entry.name}: section {section} is that of {name}, so that all get the same features "
            "at the same moments"
            for section, value in shared.items()
            if getattr(config, section) != value
        )
        config = config.changed(**shared)
        imu = imu_buffer(dataset, config)
        pipeline = Pipeline(config, imu=imu, solver=entry.solver, odometry=guess)
        if shared_guess and guess is None:
            steady = ConstantVelocity(pipeline.mapper.imu)
            pipeline.odometry = guess = SharedGuess(pipeline.odometry or steady)
        runners.append(PipelineRunner(entry.name, pipeline))
    return runners, first, notes


def score_all(comparison: Comparison) -> tuple[Scores, ...]:
    """The scores of every run, with relative errors over the same path lengths.

    Without truth the first run is the reference and has no errors itself.
    """
    references = [comparison.reference] * len(comparison.runs)
    pairs = list(zip(comparison.runs, [comparison.truth, *references[1:]], strict=True))
    scores = tuple(score(run, reference) for run, reference in pairs)
    found = {entry.lengths for entry in scores if entry.lengths}
    if len(found) < 2:
        return scores
    # Some runs have poses over a part of the path only: the lengths must fit the shortest part.
    return tuple(score(run, reference, min(found)) for run, reference in pairs)


def score(
    run: SolverRun, reference: Trajectory | None, lengths: Sequence[float] | None = None
) -> Scores:
    """The scores of one run, without errors if there is no reference.

    ``lengths`` are those of the relative error, in metres; those that fit the path if None.
    """
    solved = [update for update in run.updates if update.status.solved]
    values: dict[str, Any] = {"map_points": run.map_points, "solved": len(solved)}
    seconds = [sum(update.timings.values()) for update in run.updates if update.timings]
    # The first frame loads code and has no map to match: its time is not that of a usual frame.
    if len(seconds) > 1:
        median, high = np.percentile(1e3 * np.array(seconds[1:]), (50.0, 95.0))
        values |= {"ms_median": float(median), "ms_95": float(high)}
    if run.config is not None and solved:
        matches = [update.n_edge_matches + update.n_plane_matches for update in solved]
        values |= {
            "iterations": float(np.mean([update.iterations for update in solved])),
            "solver_iterations": float(np.mean([update.solver_iterations for update in solved])),
            "matches": float(np.median(matches)),
        }
    problems = [run.problem] if run.problem else []
    try:
        if reference is not None:
            absolute = evaluation.absolute_error(run.trajectory, reference)
            values |= {
                "ate_m": absolute.rmse,
                "ate_max_m": absolute.maximum,
                "rotation_deg": absolute.rotation_rmse_deg,
                "path_m": evaluation.interpolate(reference, absolute.stamps).path_length,
            }
            given = None if lengths is None else np.array(lengths, np.float64)
            relative = evaluation.relative_error(run.trajectory, reference, given)
            values |= {
                "rpe_percent": relative.translation_percent,
                "rpe_deg_per_m": relative.rotation_deg_per_m,
                "lengths": tuple(relative.lengths.tolist()),
            }
    except InputError as problem:  # no overlap in time, or too short a path
        problems.append(str(problem))
    return Scores(**values, problem="; ".join(problems))


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
