"""One trial of an experiment: one run of one estimator on one sequence becomes a row of numbers.

"Sweep" is a turn of the lidar everywhere else ; a sweep over parameters
is made of *trials* here.
"""

from __future__ import annotations

import hashlib
import json
import math
import socket
import time
import traceback
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from typing import Any

import gtsam

from loam_gtsam import datasets
from loam_gtsam.config import Config, config_to_dict
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.pipeline import OnFrame, effective_config, run
from loam_gtsam.studies.comparison import score
from loam_gtsam.studies.contenders import SolverRun, Theirs, prepare
from loam_gtsam.studies.evaluation import pose_differences
from loam_gtsam.studies.peers import make_peer, version
from loam_gtsam.types import FrameStatus, LoamError, Trajectory

Row = dict[str, Any]
"""Values of :data:`COLUMNS` by name; None where there is none."""

VERSIONS = ("loam_gtsam", "gtsam", "numpy")
"""Distributions that decide the numbers of our estimators."""

METRICS = (
    "ate_m",
    "ate_max_m",
    "rotation_deg",
    "rpe_percent",
    "rpe_deg_per_m",
    "drift_percent",
    "iterations",
    "solver_iterations",
    "matches",
    "ms_median",
    "ms_95",
)
"""Numbers of a run that can be compared; defined in ``docs/compare.md`` and ``docs/sweep.md``."""

COLUMNS: dict[str, type] = {
    "trial": str,
    "sequence": str,
    "config": str,
    "seed": int,
    "path": str,
    "options": str,
    "config_hash": str,
    "peer": str,
    "peer_version": str,
    **{f"{name}_version": str for name in VERSIONS},
    "frames": int,
    **{f"frames_{status}": int for status in FrameStatus},
    **dict.fromkeys(METRICS, float),
    "path_m": float,
    "rpe_shortest_m": float,
    "map_points": int,
    "problem": str,
    "error": str,
    "wall_s": float,
    "host": str,
}
"""Of the table, in its order."""

NOT_REPEATABLE = ("ms_median", "ms_95", "wall_s", "host")
"""Columns that differ when the same trial is run again; the others do not."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of one estimator on one sequence.

    Attributes
    ----------
    sequence, config_name : what the specification calls them
    path, options : of the data set, see :func:`loam_gtsam.datasets.open_dataset`
    frames : stop after so many sweeps; None takes all
    seed : of a built-in world; None for recorded data
    config : as given to the run; of a peer only what it says about the sensor counts
    peer : name in :data:`loam_gtsam.studies.peers.PEERS`; None for ours
    """

    sequence: str
    config_name: str
    path: str
    options: Mapping[str, Any]
    frames: int | None
    seed: int | None
    config: Config
    peer: str | None = None

    @property
    def config_hash(self) -> str:
        """Of every value of the configuration, or of the peer and what it is told."""
        return _hash({"peer": self.peer, "config": config_to_dict(self.config)})

    @property
    def id(self) -> str:
        """Of all that decides the result, so not of the names; the data itself is not read."""
        return _hash(
            {
                "path": self.path,
                "options": dict(self.options),
                "frames": self.frames,
                "seed": self.seed,
                "config": self.config_hash,
            }
        )

    @property
    def dataset_options(self) -> dict[str, Any]:
        """For the loader, the seed included."""
        return dict(self.options) | ({} if self.seed is None else {"seed": self.seed})


@cache
def versions() -> Mapping[str, str]:
    """Of what decides the numbers, by column, here and now."""
    return {f"{name}_version": version(name) for name in VERSIONS}


def run_trial(trial: Trial, on_frame: OnFrame | None = None) -> Row:
    """Run one trial; whatever goes wrong in it becomes the ``error`` of its row.

    Parameters
    ----------
    on_frame : called after each frame; a KeyboardInterrupt raised there ends the trial

    Raises
    ------
    KeyboardInterrupt
        If the trial was stopped, for half a trial is no result.
    """
    row = empty_row(trial) | {"host": socket.gethostname()}
    started = time.perf_counter()
    try:
        dataset = datasets.open_dataset(trial.path, **trial.dataset_options)
        finished = (_ours if trial.peer is None else _theirs)(trial, dataset, on_frame)
        row |= _numbers(finished, dataset.truth)
        row["error"] = _unusable(dataset.name, finished)
    except LoamError as error:
        row["error"] = f"{type(error).__name__}: {error}"
    except Exception:  # a mistake of ours or of a peer must not cost the other trials
        row["error"] = traceback.format_exc()
    row["wall_s"] = time.perf_counter() - started
    return row


def empty_row(trial: Trial) -> Row:
    """What is known of a trial before it runs."""
    row: Row = dict.fromkeys(COLUMNS)
    return (
        row
        | dict(versions())
        | {
            "trial": trial.id,
            "sequence": trial.sequence,
            "config": trial.config_name,
            "seed": trial.seed,
            "path": trial.path,
            "options": json.dumps(dict(trial.options), sort_keys=True, default=str),
            "config_hash": trial.config_hash,
            "peer": trial.peer,
        }
    )


def _ours(trial: Trial, dataset: Dataset, on_frame: OnFrame | None) -> SolverRun:
    result = run(dataset, trial.config, max_frames=trial.frames, on_frame=on_frame)
    if result.interrupted:
        raise KeyboardInterrupt
    # As corrected by loops, if there are any: these are the poses that the run gives.
    poses = iter(result.trajectory.map_T_lidar)
    updates = tuple(
        update
        if not update.status.has_pose
        else replace(update, map_T_lidar=gtsam.Pose3(next(poses)))
        for update in result.updates
    )
    points = len(result.edge_points) + len(result.plane_points)
    return SolverRun(trial.config_name, "", result.config, updates, points)


def _theirs(trial: Trial, dataset: Dataset, on_frame: OnFrame | None) -> SolverRun:
    assert trial.peer is not None
    estimator = Theirs(make_peer(trial.peer))
    config = effective_config(trial.config, dataset)
    sweeps = prepare(dataset, config, ours=False, theirs=True)
    for number, sweep in enumerate(islice(sweeps, trial.frames)):
        estimator.register(sweep, None)
        if on_frame is not None:
            on_frame(number, estimator.updates[-1])
    return estimator.result(len(estimator.updates))


def _numbers(finished: SolverRun, truth: Trajectory | None) -> Row:
    """The columns that a run fills."""
    scores = score(finished, truth)
    counts = Counter(update.status for update in finished.updates)
    row: Row = {
        "frames": len(finished.updates),
        **{f"frames_{status}": counts[status] for status in FrameStatus},
        **{name: getattr(scores, name) for name in METRICS if name != "drift_percent"},
        "drift_percent": math.nan,
        "path_m": scores.path_m,
        "rpe_shortest_m": min(scores.lengths, default=math.nan),
        "map_points": scores.map_points,
        "problem": scores.problem or (None if truth is not None else "no truth"),
        "peer_version": None if finished.config is not None else finished.version,
    }
    if truth is not None and scores.path_m > 0.0:
        _, metres, _ = pose_differences(finished.trajectory, truth)
        row["drift_percent"] = 100.0 * float(metres[-1]) / scores.path_m
    # NaN is no value, and would not equal itself when two tables are compared.
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }


def _unusable(name: str, finished: SolverRun) -> str | None:
    """Why a run that ended has no result, if it has none."""
    if not finished.updates:
        return f"{name}: no sweeps in it; see what is understood with: loam-gtsam inspect"
    if finished.config is None and finished.problem:
        return finished.problem
    if not any(update.status.usable for update in finished.updates):
        return (
            f"{name}: none of the {len(finished.updates)} sweeps could be used; the first: "
            f"{finished.updates[0].message}; see also: loam-gtsam inspect"
        )
    return None


def _hash(value: Mapping[str, Any]) -> str:
    """The same for the same values on every machine; an option that is no JSON counts as text."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16]
