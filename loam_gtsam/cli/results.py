"""The results of ``run`` and ``demo``: accuracy, files, pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from loam_gtsam.aiding.gnss import write_enu
from loam_gtsam.config import Config, dump_config
from loam_gtsam.datasets.base import Dataset, DatasetInfo
from loam_gtsam.io.atomic import write_text
from loam_gtsam.io.checkpoint import checksum
from loam_gtsam.io.run_files import RUN_FILES, write_run
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.io.version import installed_version
from loam_gtsam.loops.files import write_graph
from loam_gtsam.maps.map_file import MAP_FILE, save_map
from loam_gtsam.pipeline import RunResult, effective_config
from loam_gtsam.registration.uncertainty.beam_errors import BeamErrors
from loam_gtsam.studies import evaluation
from loam_gtsam.types import (
    DatasetError,
    FloatArray,
    FrameStatus,
    InputError,
    IntArray,
    LoamError,
    OutputError,
    Trajectory,
)
from loam_gtsam.view import frame_plot, plots
from loam_gtsam.view.observers import LastFrame

PLOT_FILES = ("trajectory.png", "map.png", "frame.png", "timings.png")
ERROR_PLOT = "errors.png"
TRUTH_FILE, MATCHED_FILE = "truth.tum", "truth_matched.tum"
LOOP_FILES = ("odometry.tum", "pose_graph.g2o")
ENU_FILE = "trajectory_enu.tum"
BEAMS_FILE = "beams.yaml"
"""A configuration of what the beams of the lidar are off by, if they are."""
BASE_FILES = (*RUN_FILES, MAP_FILE)
"""What every run writes."""
RUN_OUTPUTS = (
    *BASE_FILES,
    *PLOT_FILES,
    ERROR_PLOT,
    *LOOP_FILES,
    TRUTH_FILE,
    MATCHED_FILE,
    ENU_FILE,
    BEAMS_FILE,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Results:
    """A run with what is known of its input, ready to be written."""

    run: RunResult
    info: DatasetInfo
    truth: Trajectory | None
    last: LastFrame | None  # for the pictures; None draws none
    checksum: str  # of the input, see :func:`_input_checksum`
    whole: bool = True  # the data set ended, and not the number of frames that was asked for
    accuracy: Mapping[str, Any] = field(default_factory=dict)  # or ``problem``; empty without truth
    error: evaluation.AbsoluteError | None = None
    map_truth: Trajectory | None = None  # in the map frame; None if it cannot be compared

    @staticmethod
    def of(
        run: RunResult, dataset: Dataset, last: LastFrame | None, *, whole: bool = True
    ) -> Results:
        """Compare a run with the truth of its data set, if there is any."""
        trajectory, truth = run.trajectory, dataset.truth
        info = _input_info(dataset)
        check = _input_checksum(dataset)
        results = Results(run=run, info=info, truth=truth, last=last, checksum=check, whole=whole)
        if truth is None:
            return results
        try:
            error = evaluation.absolute_error(trajectory, truth)
        except ValueError as problem:  # no overlap in time, or stamps of the truth that repeat
            return replace(results, accuracy={"problem": str(problem)})
        there = truth.at(error.stamps)
        inside = (trajectory.stamps >= truth.stamps[0]) & (trajectory.stamps <= truth.stamps[-1])
        here = trajectory.map_T_lidar[inside]
        if len(here) != len(error.stamps):  # a sparse reference
            here = trajectory.at(error.stamps).map_T_lidar
        turn = None
        if np.isfinite(there.map_T_lidar).all():
            turn = evaluation.align_rotations(there.map_T_lidar[:, :3, :3], here[:, :3, :3])
        map_T_truth = evaluation.align_positions(there.positions, here[:, :3, 3], turn)
        accuracy = {
            "ate_rmse_m": error.rmse,
            "ate_max_m": error.maximum,
            "compared_poses": len(error.stamps),
            "compared_length_m": there.path_length,
            **_without_fit(run, truth),
        }
        moved = Trajectory(there.stamps, map_T_truth @ there.map_T_lidar)
        return replace(results, accuracy=accuracy, error=error, map_truth=moved)

    def write(self, folder: Path) -> list[str]:
        """Write all files into a folder; returns their names."""
        extra = {"whole": self.whole, "accuracy": self.accuracy or None}
        extra["input"] = asdict(self.info) | {"checksum": self.checksum}
        files = list(BASE_FILES)
        write_run(self.run, folder, dataset=_described(self.info), extra=extra)
        if self.run.pipeline is not None:
            save_map(folder / MAP_FILE, self.run.pipeline)
            files += _write_beams(folder / BEAMS_FILE, self.run.pipeline.mapper.errors.beam_errors)
        if self.run.fixes is not None and self.run.fixes.reference is not None:
            write_enu(folder / ENU_FILE, self.run.trajectory, self.run.fixes.reference)
            files.append(ENU_FILE)
        if self.truth is not None:
            write_tum(folder / TRUTH_FILE, self.truth)
            files.append(TRUTH_FILE)
            if self.error is not None:
                matched = evaluation.matched_truth(self.run.trajectory, self.truth)
                write_tum(folder / MATCHED_FILE, matched)
                files.append(MATCHED_FILE)
        if self.run.loops is not None:
            write_tum(folder / LOOP_FILES[0], self.run.odometry, comments={"frame": "odom"})
            write_graph(folder / LOOP_FILES[1], self.run.loops.graph.saved())
            files += LOOP_FILES
        return files if self.last is None else files + self._draw(folder, self.last)

    def _draw(self, folder: Path, last: LastFrame) -> list[str]:
        path, cloud, frame, timings = PLOT_FILES
        run, trajectory = self.run, self.run.trajectory
        loops = None if run.loops is None else run.loops.loop_ends()
        plots.plot_trajectory(folder / path, trajectory, self.map_truth, loops)
        plots.plot_map(folder / cloud, run.edge_points, run.plane_points, trajectory)
        if last.seen:
            frame_plot.plot_frame(folder / frame, last.frame(), last.around())
        plots.plot_timings(folder / timings, run.updates)
        if self.error is not None:
            error = self.error.stamps, self.error.translations
            plots.plot_errors(folder / ERROR_PLOT, *error, self._told())
        return [name for name in (*PLOT_FILES, ERROR_PLOT) if (folder / name).exists()]

    def _told(self) -> tuple[IntArray, FloatArray, FloatArray] | None:
        """Stamps, errors and told standard deviations; None with loops, which change the poses."""
        if self.truth is None or self.run.loops is not None:
            return None
        with suppress(InputError):  # positions alone
            nees = evaluation.nees(self.run.updates, self.truth)
            stamps = np.array([self.run.updates[n].stamp for n in nees.frames], np.int64)
            return stamps, nees.errors, nees.sigmas
        return None


def _without_fit(run: RunResult, truth: Trajectory) -> dict[str, float]:
    """The error that no fit hides, and the covariances against the errors."""
    found: dict[str, float] = {}
    with suppress(InputError):  # positions alone
        start = evaluation.absolute_error(run.trajectory, truth, aligned="start")
        found["not_fitted_rmse_m"] = start.rmse
        if run.loops is None:
            nees = evaluation.nees(run.updates, truth)
            ok = [n for n in nees.beyond if run.updates[n].status is FrameStatus.OK]
            found |= {
                "nees": nees.mean,
                "ok_beyond_five_sigma": len(ok),
                "broken_covariances": nees.broken,
            }
    return found


def is_complete(folder: Path, config: Config, dataset: Dataset, total: int) -> bool:
    """Whether a folder holds the complete results of the run; an OutputError if of another.

    Results that end earlier because fewer frames were asked for are not complete.
    """
    summary = summary_in(folder)
    try:
        written = (folder / "config.yaml").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return False
    if not summary or summary.get("interrupted") or summary.get("error"):
        return False
    differs = _differences(summary, dataset)
    if written != dump_config(effective_config(config, dataset)):
        differs.append("the configuration")
    made_by, now = summary.get("loam_gtsam"), installed_version()
    if made_by != now:
        differs.append(f"by version {made_by}, now {now}")
    frames, whole = summary.get("frames", 0), summary.get("whole", True)
    if not differs and frames < total and not whole:
        return False
    if frames > total:
        differs.append("the number of sweeps")
    if differs:
        raise OutputError(
            f"{folder}: holds the results of another run ({', '.join(differs)}); choose another "
            "folder, or --overwrite without --resume"
        )
    return True


def _differences(summary: Mapping[str, Any], dataset: Dataset) -> list[str]:
    """What of a data set differs from that of which the run with this summary was made."""
    info, before = _input_info(dataset), summary.get("input") or {}
    made_of = before.get("kind"), Path(before.get("path", "")).name
    if made_of != (info.kind, Path(info.path).name):
        return [f"the data set was {summary.get('dataset')}"]
    facts = before.get("facts") or {}
    differs = [
        f"{label} was {facts.get(label)}, now {info.facts.get(label)}"
        for label in facts | info.facts
        if facts.get(label) != info.facts.get(label)
    ]
    if not differs and before.get("checksum") != _input_checksum(dataset):
        return ["the first sweep, IMU, fixes or wheels"]
    return differs


def check_data(folder: Path, dataset: Dataset) -> None:
    """DatasetError if the run in a folder was made of another data set, by kind and name."""
    made_of, info = str(summary_in(folder).get("dataset", "")), _input_info(dataset)
    names = {Path(path).name for path in (made_of.removeprefix(f"{info.kind} "), info.path)}
    if len(names) > 1 and "" not in names:
        raise DatasetError(
            f"{folder}: its run was made of {made_of!r}, got {_described(info)!r}; give the data "
            "set that was run"
        )


def summary_in(folder: Path) -> dict[str, Any]:
    """The summary of the run in a folder; empty if there is none that can be read."""
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return summary if isinstance(summary, dict) else {}


def described(dataset: Dataset) -> str:
    """Kind and path of a data set, as the summary of a run has them."""
    return _described(_input_info(dataset))


def _input_info(dataset: Dataset) -> DatasetInfo:
    """What is known of the input after the run; must not cost the results if it is damaged."""
    try:
        return dataset.info()
    except LoamError as error:
        return DatasetInfo("data set", dataset.name, problems=[str(error)])


def _input_checksum(dataset: Dataset) -> str:
    """Of the first sweep, IMU, fixes and wheels, by which other data of the same name are told."""
    try:
        first = next(iter(dataset), None)
        aids = dataset.imu, getattr(dataset, "gnss", None), getattr(dataset, "wheels", None)
    except LoamError:  # then the run was not complete
        return ""
    return f"{checksum((first, aids)):08x}"


def _described(info: DatasetInfo) -> str:
    return f"{info.kind} {info.path}"


def _write_beams(path: Path, errors: BeamErrors) -> list[str]:
    """Write what ``sensor.beams`` should be, if it is not that; the names of files written."""
    if not errors.problem:
        return []
    rows = "".join(f"  - {list(row)}\n" for row in errors.advised)
    said = "# degrees; metres by which ranges are too long; elevations, azimuths too large, degrees"
    write_text(path, f"sensor:\n  {said}\n  beams:\n{rows}")
    return [path.name]
