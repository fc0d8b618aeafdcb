"""Trials of a parameter study: a trial is one run of one solver on one sequence, and gives a row.

The row of a finished trial is written to a small file at once, so that an interrupted study can go
on; the table of all trials is a Parquet file that is made of these files.
"""

from __future__ import annotations

import hashlib
import json
import math
import socket
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

from loam_gtsam import datasets
from loam_gtsam.config import Config, config_to_dict
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.io.atomic import atomic_file
from loam_gtsam.io.version import installed_version
from loam_gtsam.pipeline import OnFrame, effective_config, run
from loam_gtsam.studies.comparison import score
from loam_gtsam.studies.contenders import MapSample, PeerRunner, SolverRun
from loam_gtsam.studies.evaluation import pose_differences
from loam_gtsam.studies.factories import make_parts
from loam_gtsam.types import FrameStatus, LoamError, OutputError, Trajectory

Row = dict[str, Any]
"""The values of a trial by the name of their column, see :data:`COLUMNS`; None if not known."""
VERSIONS = ("loam_gtsam", "gtsam", "numpy")
"""Packages whose version decides the numbers of the solvers of this package."""
METRICS = (
    "ate_m", "ate_max_m", "start_m", "rotation_deg", "rpe_percent", "rpe_deg_per_m",
    "drift_percent", "solved", "beyond", "nees", "nees_step", "broken",
    "thickness_mm", "planar_share", "entropy",
    "iterations", "solver_iterations", "matches", "ms_median", "ms_95",
)  # fmt: skip
"""Columns to compare solvers by; see ``docs/compare.md`` and ``docs/parameter_studies.md``."""
COLUMNS: dict[str, type] = {
    **dict.fromkeys(("trial", "sequence", "config"), str),
    "seed": int,
    **dict.fromkeys(("path", "options", "config_hash", "parts", "peer", "peer_version"), str),
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
"""Name and type of the columns of the table, in their order."""
NOT_REPEATABLE = ("ms_median", "ms_95", "wall_s", "host")
"""Columns that differ when the same trial runs again; all other columns are the same."""
TABLE_FILE = "results.parquet"
TRIALS_FOLDER = "trials"


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of one solver on one sequence.

    Attributes
    ----------
    path, options : of the data set, see :func:`loam_gtsam.datasets.open_dataset`
    frames : at most so many sweeps; None takes all
    seed : of a built-in world; None for recorded data
    config : of the run; a peer uses the section ``sensor`` only
    peer : name of a peer, with settings; None for a run of this package
    parts : of a user's own by name, see :func:`loam_gtsam.studies.factories.make_parts`
    """

    sequence: str
    config_name: str
    path: str
    options: Mapping[str, Any]
    frames: int | None
    seed: int | None
    config: Config
    peer: str | None = None
    parts: Mapping[str, str] = field(default_factory=dict)

    @property
    def config_hash(self) -> str:
        """Hash of every value of the configuration, and of the names of peer and parts."""
        named = {"peer": self.peer, **self.parts}
        return _hash(named | {"config": config_to_dict(self.config)})

    @property
    def id(self) -> str:
        """Hash of all that decides the result: not the names of the trial, nor the data itself."""
        deciding = {name: getattr(self, name) for name in ("path", "frames", "seed")}
        return _hash(deciding | {"options": dict(self.options), "config": self.config_hash})

    @property
    def dataset_options(self) -> dict[str, Any]:
        """Options of the data set, the seed included."""
        return dict(self.options) | ({} if self.seed is None else {"seed": self.seed})


@cache
def versions() -> Mapping[str, str]:
    """Installed versions of the packages that decide the numbers, by column."""
    return {f"{name}_version": installed_version(name) for name in VERSIONS}


def run_trial(trial: Trial, on_frame: OnFrame | None = None) -> Row:
    """Run one trial; an error during the trial becomes the ``error`` of its row.

    Raises KeyboardInterrupt if ``on_frame``, which is called after each frame, raised it: half a
    trial is no result.
    """
    row = empty_row(trial) | {"host": socket.gethostname()}
    started = time.perf_counter()
    try:
        dataset = datasets.open_dataset(trial.path, **trial.dataset_options)
        sample = MapSample(effective_config(trial.config, dataset))
        finished = _run_solver(trial, dataset, sample, on_frame)
        row |= _numbers(finished, sample, dataset.truth)
        row["error"] = _unusable(dataset.name, finished)
    except LoamError as error:
        row["error"] = f"{type(error).__name__}: {error}"
    except Exception:  # a defect of this package or of a peer must not end the other trials
        row["error"] = traceback.format_exc()
    row["wall_s"] = time.perf_counter() - started
    return row


def empty_row(trial: Trial) -> Row:
    """The row of a trial that has not run."""
    known = {
        "trial": trial.id,
        "sequence": trial.sequence,
        "config": trial.config_name,
        "seed": trial.seed,
        "path": trial.path,
        "options": json.dumps(dict(trial.options), sort_keys=True, default=str),
        "config_hash": trial.config_hash,
        "parts": json.dumps(dict(trial.parts), sort_keys=True) if trial.parts else None,
        "peer": trial.peer,
    }
    return dict.fromkeys(COLUMNS) | dict(versions()) | known


def _run_solver(
    trial: Trial, dataset: Dataset, sample: MapSample, on_frame: OnFrame | None
) -> SolverRun:
    if trial.peer is None:
        result = run(
            dataset,
            trial.config,
            max_frames=trial.frames,
            on_frame=on_frame,
            observe=lambda sweep, *_: sample.add(sweep),
            **make_parts(trial.parts, trial.config),
        )
        if result.interrupted:
            raise KeyboardInterrupt
        return SolverRun.of_result(trial.config_name, result)
    runner = PeerRunner.of(trial.peer, dataset, effective_config(trial.config, dataset))
    with closing(runner):
        for number, sweep in enumerate(islice(dataset, trial.frames)):
            runner.register(sweep)
            sample.add(sweep)
            if on_frame is not None:
                on_frame(number, runner.updates[-1])
        return runner.result(len(runner.updates))


def _numbers(finished: SolverRun, sample: MapSample, truth: Trajectory | None) -> Row:
    scores = replace(score(finished, truth), **sample.sharpness(finished))
    counts = Counter(update.status for update in finished.updates)
    row: Row = {
        "frames": len(finished.updates),
        **{f"frames_{status}": counts[status] for status in FrameStatus},
        **{name: getattr(scores, name, math.nan) for name in METRICS},
        "path_m": scores.path_m,
        "rpe_shortest_m": min(scores.lengths, default=math.nan),
        "map_points": scores.map_points,
        "problem": scores.problem or (None if truth is not None else "no truth"),
        "peer_version": None if finished.config is not None else finished.version,
    }
    if truth is not None and scores.path_m > 0.0:
        _, metres, _ = pose_differences(finished.trajectory, truth)
        row["drift_percent"] = 100.0 * float(metres[-1]) / scores.path_m
    # NaN would not equal itself when two tables are compared.
    unknown = [k for k, v in row.items() if isinstance(v, float) and not math.isfinite(v)]
    return row | dict.fromkeys(unknown)


def _unusable(name: str, finished: SolverRun) -> str | None:
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
    """A hash that is equal on every machine; a value that JSON does not know counts as text."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16]


class TrialStore:
    """The files of the finished trials of a study, in a folder beside the table."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / TRIALS_FOLDER

    def save(self, row: Row) -> None:
        """Write the row of a finished trial; OutputError if the file cannot be written."""
        with atomic_file(self._file(row["trial"])) as file:
            file.write((json.dumps(row, indent=1, allow_nan=False) + "\n").encode("utf-8"))

    def load(self, trial: Trial) -> Row | None:
        """The row of a trial that the installed versions have finished, in a readable file."""
        try:
            row = json.loads(self._file(trial.id).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        if not isinstance(row, dict) or set(row) != set(COLUMNS) or row["trial"] != trial.id:
            return None
        if any(row[name] != value for name, value in versions().items()):
            return None
        # The names in the specification may have changed since the trial ran.
        return row | {"sequence": trial.sequence, "config": trial.config_name}

    def _file(self, trial: str) -> Path:
        return self.folder / f"{trial}.json"


def write_table(path: Path, rows: Iterable[Row], text: str, trials: Iterable[Trial]) -> None:
    """Write the table of a study; text and configurations of its specification become metadata.

    Raises OutputError if pyarrow is missing or the file cannot be written.
    """
    arrow, parquet = import_pyarrow()
    kinds = {str: arrow.string(), int: arrow.int64(), float: arrow.float64()}
    configs = {trial.config_hash: config_to_dict(trial.config) for trial in trials}
    metadata = {"loam_gtsam.spec": text, "loam_gtsam.configs": json.dumps(configs)}
    schema = arrow.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()], metadata)
    with atomic_file(path) as file:
        parquet.write_table(arrow.Table.from_pylist(list(rows), schema), file)


def read_table(path: Path) -> tuple[list[Row], Mapping[str, Any]]:
    """The rows of a table, and the full configurations by their ``config_hash``."""
    _, parquet = import_pyarrow()
    table = parquet.read_table(path)
    return table.to_pylist(), json.loads(table.schema.metadata[b"loam_gtsam.configs"])


def import_pyarrow() -> tuple[Any, Any]:
    """``pyarrow`` and ``pyarrow.parquet``; OutputError if they are not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise OutputError(
            f'the table needs pyarrow ({error}): pip install "loam_gtsam[cluster]"'
        ) from error
    return pyarrow, pyarrow.parquet
