"""Several estimators on the same sweeps, and what came of each.

Sweep by sweep, one estimator after the other: all of them see the same state of the machine.
Features are extracted once per sweep and handed to all of ours; peers get the points and times
those features were taken from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from loam_gtsam.config import PRESETS, Config, load_config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.pipeline import OnFrame, effective_config, imu_buffer
from loam_gtsam.studies.contenders import Ours, SolverRun, Step, Theirs, prepare
from loam_gtsam.studies.evaluation import (
    absolute_error,
    distance_travelled,
    interpolate,
    pose_differences,
    relative_error,
)
from loam_gtsam.studies.peers import PEERS, make_peer
from loam_gtsam.types import (
    ConfigError,
    DatasetError,
    FloatArray,
    InputError,
    IntArray,
    Trajectory,
)

_PRESET_OF = {"gtsam": "default"}
"""Solver names that are not the name of their preset."""
_SHARED = ("sensor", "features")
"""Sections all of ours take from the first of them, with ``deskew.enabled`` and
``deskew.reference``: they decide what the features are and which moment a pose belongs to."""


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
    ate_m, ate_max_m, rotation_deg : ``AbsoluteError``, aligned
    rpe_percent, rpe_deg_per_m : ``RelativeError`` over ``lengths`` (m)
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
        If there is no contender, two have the same name, or two peers cannot run side by side.
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
    packages = [PEERS[name].package for name in names if name in PEERS and PEERS[name].alone]
    if len(set(packages)) < len(packages):
        raise InputError(
            f"compare: instances of {packages[0]} in one process disturb each other; compare its "
            "variants in two comparisons"
        )
    configs, notes = _common_configs(contenders, dataset)
    estimators: list[Ours | Theirs] = [
        Theirs(make_peer(entry.name))
        if config is None
        else Ours(entry.name, config, imu_buffer(dataset, config))
        for entry, config in zip(contenders, configs, strict=True)
    ]
    first = next((config for config in configs if config is not None), None)
    config = first or effective_config(Config(), dataset)
    kinds = {type(estimator) for estimator in estimators}
    error: Exception | None = None
    interrupted = False
    done = 0
    try:
        sweeps = prepare(dataset, config, ours=Ours in kinds, theirs=Theirs in kinds)
        for number, sweep in enumerate(sweeps):
            if number == max_frames:
                break
            step: Step | None = None
            for estimator in estimators:
                made = estimator.register(sweep, step)
                step = made if shared_guess else None
            done += 1
            if on_frame is not None:
                on_frame(number, estimators[0].updates[-1])
    except KeyboardInterrupt:
        if not done:
            raise
        interrupted = True
    except Exception as caught:
        if not done:
            raise
        error = caught
    if not done:
        raise DatasetError(
            f"{dataset.name}: no sweeps in it; see what is understood with: loam-gtsam inspect"
        )
    return Comparison(
        name=dataset.name,
        runs=tuple(estimator.result(done) for estimator in estimators),
        truth=dataset.truth,
        notes=tuple(notes),
        interrupted=interrupted,
        error=error,
    )


def score_all(comparison: Comparison) -> tuple[Scores, ...]:
    """The scores of every run, relative errors over the same path lengths.

    Without truth the first run is the reference, and has no errors itself.
    """
    reference = comparison.reference
    has_none = comparison.truth is None
    pairs = [
        (run, None if has_none and number == 0 else reference)
        for number, run in enumerate(comparison.runs)
    ]
    scores = [score(run, against) for run, against in pairs]
    found = [entry.lengths for entry in scores if entry.lengths]
    if len(set(found)) < 2:
        return tuple(scores)
    # The poses of some begin or end elsewhere: take what fits the shortest of their paths.
    return tuple(score(run, against, min(found)) for run, against in pairs)


def score(
    run: SolverRun, reference: Trajectory | None, lengths: Sequence[float] | None = None
) -> Scores:
    """The numbers of a run.

    Parameters
    ----------
    reference : errors are taken against it; no errors if None
    lengths : metres, of the relative error; what fits the path if None
    """
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
        given = None if lengths is None else np.array(lengths, np.float64)
        relative = relative_error(run.trajectory, reference, given)
        result = replace(
            result,
            rpe_percent=relative.translation_percent,
            rpe_deg_per_m=relative.rotation_deg_per_m,
            lengths=tuple(relative.lengths.tolist()),
        )
    except InputError as problem:  # no overlap in time, or too short a path
        problems.append(str(problem))
    return replace(result, problem="; ".join(problems))


@dataclass(frozen=True, slots=True, eq=False)
class FrameDifferences:
    """Distance of one solver's poses from those of the first-named one, frame by frame.

    Attributes
    ----------
    frames : (N,) numbers of the frames both have
    metres, degrees : (N,) see :func:`loam_gtsam.studies.evaluation.pose_differences`
    """

    frames: IntArray
    metres: FloatArray
    degrees: FloatArray


def frame_differences(comparison: Comparison) -> dict[str, FrameDifferences]:
    """Differences of the other solvers, by name; those too short to compare are left out."""
    first, *others = comparison.runs
    found = {}
    for run in others:
        trajectory = run.trajectory
        try:
            stamps, metres, degrees = pose_differences(trajectory, first.trajectory)
        except InputError:
            continue
        frames = np.array(run.used, np.int64)[np.isin(trajectory.stamps, stamps)]
        found[run.name] = FrameDifferences(frames, metres, degrees)
    return found


def _common_configs(
    contenders: Sequence[Contender], dataset: Dataset
) -> tuple[list[Config | None], list[str]]:
    """The configurations to use, and a note for each section that had to be made the same."""
    configs: list[Config | None] = []
    notes: list[str] = []
    first: tuple[str, Config] | None = None
    for entry in contenders:
        if entry.config is None:
            configs.append(None)
            continue
        config = effective_config(entry.config, dataset)
        if first is None:
            first = entry.name, config
        name, common = first
        shared = {section: getattr(common, section) for section in _SHARED}
        # How often a sweep is de-skewed anew, and by what, is part of the method, and stays.
        own = config.deskew
        shared["deskew"] = replace(common.deskew, refine=own.refine, rotation=own.rotation)
        for section, value in shared.items():
            if getattr(config, section) != value:
                notes.append(
                    f"{entry.name}: section {section} is that of {name}, so that all get the same "
                    "features at the same moments"
                )
        configs.append(replace(config, **shared))
    return configs, notes
