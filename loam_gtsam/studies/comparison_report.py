"""The files of a comparison: tables of scores and frames, trajectories, pictures, the report."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.config import Config, config_to_dict
from loam_gtsam.io.atomic import file_name, write_json, write_text
from loam_gtsam.io.run_files import stage_seconds
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.studies import evaluation
from loam_gtsam.studies.comparison import (
    Comparison,
    FrameDifferences,
    Scores,
    frame_differences,
    score_all,
)
from loam_gtsam.studies.contenders import SolverRun
from loam_gtsam.studies.report_html import TextTable, list_html, page, picture_html, table_html
from loam_gtsam.types import FloatArray, InputError, Trajectory
from loam_gtsam.view import plots

TRUTH_FILE = "truth.tum"
TRAJECTORIES = "trajectory_", "truth_matched_"
"""How the names of the trajectories begin; the name of the contender follows."""
TABLE_FILES = ("comparison.csv", "comparison.json", "frames.csv")
PICTURES = {
    "trajectories.png": "Trajectories",
    "errors.png": "Position error over the distance travelled",
    "differences.png": "Differences from the first-named solver, frame by frame",
    "stages.png": "Time per stage",
}
REPORT_FILE = "report.html"


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the tables; ``key`` is an attribute of :class:`Scores`."""

    key: str
    title: str
    meaning: str
    digits: int
    lower_wins: bool = False


ACCURACY = (
    Column("ate_m", "ATE [m]", "root mean square distance between the positions of the solver "
            "and the reference at the same moments, after the rigid motion (SE(3), no scale) that "
            "brings them nearest", 4, True),
    Column("ate_max_m", "max [m]", "largest of those distances", 3, True),
    Column("start_m", "not fitted [m]", "root mean square distance if only the first common poses "
            "are made equal: a fit hides a run that went the wrong way, this does not", 3, True),
    Column("rotation_deg", "rot. [deg]", "root mean square angle between the orientations, after "
            "the rotation that fits them best", 3, True),
    Column("rpe_percent", "RPE [%]", "error of the relative motion over each path length, in per "
            "cent of it; mean over all starts and lengths", 3, True),
    Column("rpe_deg_per_m", "RPE [deg/m]", "the same for the rotation", 4, True),
)  # fmt: skip
SHARPNESS = (
    Column("thickness_mm", "thickness [mm]", "standard deviation of the points across a plane, "
            "mean over the voxels of 0.5 m that three sweeps see and that hold a plane; of the map "
            "that the poses make of the same points of the sweeps, at most 200,000", 2, True),
    Column("planar_share", "planar share", "share of those voxels among all that have enough "
            "points", 3),
    Column("entropy", "entropy", "mean map entropy in nats, of the points within 0.3 m about "
            "each: lower is sharper", 3, True),
)  # fmt: skip
FRAMES = (
    Column("solved", "solved", "share of the frames after the first whose pose a scan gave; of a "
            "peer, share with a pose", 3),
    Column("beyond", "> 5 sigma", "frames ok whose pose since the start is off by more than five "
            "told standard deviations: wrong, and said to be right", 0),
    Column("nees", "NEES/6", "mean squared error over covariance, in degrees of freedom, of the "
            "poses since the start; 1 if the covariances are right, above if they are too small",
            2),
    Column("nees_step", "NEES/6, step", "the same of the motions from frame to frame", 2),
    Column("broken", "broken", "covariances of these poses and motions that are not positive "
            "definite; NEES/6 is infinite with one", 0),
    Column("statuses", "frames", "number of frames by status", 0),
    Column("faults", "unused", "number of sweeps that could not be used, by cause", 0),
)  # fmt: skip
COST = (
    Column("iterations", "assoc.", "associations a frame, mean of the solved frames", 1),
    Column("solver_iterations", "iter.", "solver steps a frame, over all associations, mean", 1),
    Column("matches", "matches", "edge and plane matches of the last association, median", 0),
    Column("ms_median", "ms/frame", "median time of a frame without reading it, features "
            "included; the first frame is left out", 1, True),
    Column("ms_95", "95 % [ms]", "95th percentile of it", 1, True),
    Column("map_points", "map", "points of the whole map; of a peer, points or voxels it "
            "still keeps", 0),
)  # fmt: skip
TABLES = {"Accuracy": ACCURACY, "Map": SHARPNESS, "Frames": FRAMES, "Cost": COST}
"""The tables of scores; one table of all columns would not fit a page."""
COLUMNS = (*ACCURACY, *SHARPNESS, *FRAMES, *COST)


@dataclass(frozen=True, slots=True)
class ScoredComparison:
    """A comparison with the scores of every run and the differences from the first run."""

    comparison: Comparison
    scores: tuple[Scores, ...]
    differences: dict[str, FrameDifferences]

    @classmethod
    def of(cls, comparison: Comparison) -> ScoredComparison:
        """Score every run."""
        return cls(comparison, score_all(comparison), frame_differences(comparison))

    @property
    def rows(self) -> list[tuple[SolverRun, Scores]]:
        """Every run with its scores."""
        return list(zip(self.comparison.runs, self.scores, strict=True))

    @property
    def against(self) -> str:
        """Name of the reference of the errors: the truth, or the first-named solver."""
        return "truth" if self.comparison.truth is not None else self.comparison.runs[0].name

    @property
    def notes(self) -> list[str]:
        """Sentences that a reader of the tables must know."""
        lengths = next((s.lengths for s in self.scores if s.lengths), ())
        path = next((s.path_m for s in self.scores if s.path_m == s.path_m), math.nan)
        about = f"{self.comparison.frames} sweeps; errors against {self.against}"
        if lengths:
            listed = ", ".join(f"{length:g}" for length in lengths)
            about += f"; path {path:.1f} m, RPE over {listed} m"
        guesses = "every solver predicts its guesses from its own motion"
        if self.comparison.shared_guess:
            guesses = "every solver of this package starts from the guess of the first of them"
        whose: dict[str, list[str]] = {}
        for run, scores in self.rows:
            if scores.problem:
                whose.setdefault(scores.problem, []).append(run.name)
        problems = [f"{', '.join(names)}: {problem}" for problem, names in whose.items()]
        return [about, guesses, *self.comparison.notes, *problems]


def score_table(results: ScoredComparison, columns: Sequence[Column]) -> TextTable:
    """Some columns of the scores as a table by groups, a dash where there is no number."""
    runs = results.comparison.runs
    rows = [[run.name, *(_cell(scores, c) for c in columns)] for run, scores in results.rows]
    best = set()
    for index, column in enumerate(columns, 1):
        if not column.lower_wins:
            continue
        values = np.array([getattr(scores, column.key) for scores in results.scores], np.float64)
        if np.isfinite(values).sum() > 1:
            best.add((int(np.nanargmin(values)), index))
    groups = {run.group: number for number, run in reversed(list(enumerate(runs)))}
    first = sorted((number, group) for group, number in groups.items())
    sections = {number: f"{group}: {group.held_equal}" for number, group in first}
    header = ["", *(column.title for column in columns)]
    return TextTable(header, rows, frozenset(best), sections)


def _cell(scores: Scores, column: Column) -> str:
    value = getattr(scores, column.key)
    if isinstance(value, Mapping):
        return ", ".join(f"{count} {name}" for name, count in value.items()) or "-"
    return f"{value:.{column.digits}f}" if value == value else "-"


def difference_table(results: ScoredComparison) -> TextTable:
    """The differences from the first run as a table."""
    rows = []
    for name, difference in results.differences.items():
        metres, degrees = _median_95_max(difference.metres), _median_95_max(difference.degrees)
        numbers = [f"{1e3 * value:.2f}" for value in metres] + [f"{value:.4f}" for value in degrees]
        rows.append([name, *numbers])
    header = ("solver", "median [mm]", "95 %", "max", "median [deg]", "95 %", "max")
    return TextTable(header, rows)


def _median_95_max(values: FloatArray) -> tuple[float, float, float]:
    median, high = np.percentile(values, (50.0, 95.0))
    return float(median), float(high), float(values.max())


def write_comparison(results: ScoredComparison, folder: Path, plot: bool) -> list[str]:
    """Write all files; returns their names."""
    comparison = results.comparison
    keys = [*(column.key for column in COLUMNS), "path_m", "problem"]
    rows = (
        [run.name, str(run.group), run.version, *(getattr(s, key) for key in keys)]
        for run, s in results.rows
    )
    write_csv(folder / "comparison.csv", ["solver", "group", "version", *keys], rows)
    write_json(folder / "comparison.json", _summary(results))
    write_csv(folder / "frames.csv", _FRAME_COLUMNS, _frame_rows(results))
    trajectories = {}
    for run in comparison.runs:
        name, found = file_name(run.name), run.trajectory
        trajectories[f"trajectory_{name}.tum"] = found
        if comparison.truth is not None:
            with suppress(InputError):  # of one pose, or in disorder: why, the scores say
                matched = evaluation.matched_truth(found, comparison.truth)
                trajectories[f"truth_matched_{name}.tum"] = matched
    if comparison.truth is not None:
        trajectories[TRUTH_FILE] = comparison.truth
    for name, trajectory in trajectories.items():
        write_tum(folder / name, trajectory)
    drawn = _draw(results, folder) if plot else []
    pictures = {PICTURES[name]: folder / name for name in drawn}
    sections = {
        **{name: table_html(score_table(results, part)) for name, part in TABLES.items()},
        **{caption: picture_html(caption, file) for caption, file in pictures.items()},
        "Definitions": list_html({column.title: column.meaning for column in COLUMNS}),
        "What was run": list_html({run.name: _settings(run) for run in comparison.runs}),
    }
    title = f"Comparison on {comparison.name}"
    write_text(folder / REPORT_FILE, page(title, results.notes, sections))
    return [*TABLE_FILES, *trajectories, *drawn, REPORT_FILE]


def _summary(results: ScoredComparison) -> dict[str, Any]:
    solvers = []
    for run, scores in results.rows:
        difference = results.differences.get(run.name)
        solver = {
            "name": run.name,
            "group": str(run.group),
            "held_equal": run.group.held_equal,
            "version": run.version,
            "config": run.config and config_to_dict(run.config),
            "scores": asdict(scores),
            "stages_ms": _stages(run),
            "difference_m": difference and _median_95_max(difference.metres),
            "difference_deg": difference and _median_95_max(difference.degrees),
        }
        solvers.append(solver)
    comparison = results.comparison
    return {
        "dataset": comparison.name,
        "frames": comparison.frames,
        "reference": results.against,
        "shared_guess": comparison.shared_guess,
        "interrupted": comparison.interrupted,
        "error": comparison.error and f"{type(comparison.error).__name__}: {comparison.error}",
        "notes": results.notes,
        "solvers": solvers,
    }


_FRAME_COLUMNS = (
    "solver", "frame", "stamp_ns", "status", "x", "y", "z", "ms", "associations", "iterations",
    "edge_matches", "plane_matches", "difference_m", "difference_deg",
)  # fmt: skip


def _frame_rows(results: ScoredComparison) -> Iterable[list[Any]]:
    for run in results.comparison.runs:
        found = {}
        if (apart := results.differences.get(run.name)) is not None:
            pairs = zip(apart.metres.tolist(), apart.degrees.tolist(), strict=True)
            found = dict(zip(apart.frames.tolist(), pairs, strict=True))
        for number, update in enumerate(run.updates):
            position = update.map_T_lidar.translation().tolist()
            milliseconds = 1e3 * sum(update.timings.values())
            yield [
                run.name, number, update.stamp, str(update.status), *position, milliseconds,
                update.iterations, update.solver_iterations, update.n_edge_matches,
                update.n_plane_matches, *found.get(number, (math.nan, math.nan)),
            ]  # fmt: skip


def write_csv(path: Path, header: Iterable[str], rows: Iterable[list[Any]]) -> None:
    """Write a table of texts and numbers, see :func:`~loam_gtsam.io.atomic.atomic_file`."""

    def field(value: Any) -> Any:  # a number that is not known is an empty field
        if isinstance(value, Mapping):
            return " ".join(f"{name}={count}" for name, count in value.items())
        if not isinstance(value, float):
            return value
        return f"{value:.9g}" if math.isfinite(value) else ""

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(map(field, row) for row in rows)
    write_text(path, text.getvalue())


def _stages(run: SolverRun) -> dict[str, float]:
    """Median milliseconds of each stage, over the frames after the first in which it ran."""
    names, seconds = stage_seconds(run.updates[1:])
    medians = (1e3 * float(np.nanmedian(column)) for column in seconds.T)
    return dict(zip(names, medians, strict=True))


def _settings(run: SolverRun) -> str:
    if run.config is None:
        where = "see docs/compare.md for its de-skew and the moment of its poses"
        return f"{run.version}; its own defaults; {where}"
    default = config_to_dict(Config())
    changed = []
    for section, values in config_to_dict(run.config).items():
        differing = (key for key in values if values[key] != default[section][key])
        changed += [f"{section}.{key} = {values[key]}" for key in differing]
    return f"{run.version}; differs from the default in: {', '.join(changed) or 'nothing'}"


def _draw(results: ScoredComparison, folder: Path) -> list[str]:
    comparison = results.comparison
    first = comparison.runs[0].name
    drawn: list[str] = []

    def path(name: str) -> Path:
        drawn.append(name)
        return folder / name

    truth, reference = comparison.truth, comparison.reference
    aligned: dict[str, Trajectory] = {}
    errors: dict[str, tuple[NDArray[Any], FloatArray]] = {}
    for run in comparison.runs:
        trajectory = run.trajectory
        try:
            found = evaluation.absolute_error(trajectory, reference)
        except InputError:  # too few poses
            continue
        here = trajectory.map_T_lidar[np.isin(trajectory.stamps, found.stamps)]
        there = reference.at(found.stamps).positions
        reference_T_map = evaluation.align_positions(here[:, :3, 3], there)
        aligned[run.name] = Trajectory(trajectory.stamps, reference_T_map @ trajectory.map_T_lidar)
        errors[run.name] = evaluation.distance_travelled(there), found.translations
    if aligned and truth is not None:
        stamps = np.concatenate([trajectory.stamps for trajectory in aligned.values()])
        inside = (truth.stamps >= stamps.min()) & (truth.stamps <= stamps.max())
        truth = truth[inside]
    if aligned:
        plots.plot_trajectories(path("trajectories.png"), aligned, truth)
    if errors and truth is not None:
        panels = {"position error [m]": errors}
        plots.plot_curves(path("errors.png"), panels, "distance travelled [m]")
    if results.differences:
        # The first solver has no curve; its entry keeps the colours those of the other pictures.
        none: dict[str, tuple[NDArray[Any], FloatArray]] = {first: (np.zeros(0), np.zeros(0))}
        differences = results.differences.items()
        panels = {
            f"distance from {first} [m]": none | {k: (d.frames, d.metres) for k, d in differences},
            f"angle from {first} [deg]": none | {k: (d.frames, d.degrees) for k, d in differences},
        }
        plots.plot_curves(path("differences.png"), panels, "frame", log=True)
    stages = {run.name: _stages(run) for run in comparison.runs}
    if any(stages.values()):
        plots.plot_stages(path("stages.png"), stages)
    return drawn
