"""The command ``refine``: adjust maps and poses of finished runs, write what became of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from loam_gtsam.aiding.gnss import write_enu
from loam_gtsam.cli import console
from loam_gtsam.cli.options import RefineOptions
from loam_gtsam.cli.results import LOOP_FILES, check_data, summary_in
from loam_gtsam.config import Config, load_config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.datasets.truth import read_truth
from loam_gtsam.geometry import voxel_filter
from loam_gtsam.io.atomic import write_json
from loam_gtsam.io.read_run import read_updates
from loam_gtsam.io.run_files import write_covariances, write_ply
from loam_gtsam.io.trajectories import write_kitti, write_tum
from loam_gtsam.maps.map_file import SavedMap, map_of_run
from loam_gtsam.maps.merging import MergedMaps
from loam_gtsam.refine.map_quality import MapQuality, common_thickness, map_quality
from loam_gtsam.refine.rounds import Round, Settings
from loam_gtsam.refine.runs import RefinedRun, RunPoints, refine_runs, run_points
from loam_gtsam.refine.ties import Survey
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import (
    DatasetError,
    FloatArray,
    InputError,
    IntArray,
    MapUpdate,
    Trajectory,
)
from loam_gtsam.view.sections import plot_section

FOLDER = "refined"
_OF_RUN = ".tum", "_kitti.txt", "_covariance.csv", "_enu.tum"
_CLOUD, _PICTURE, _REPORT = "map.ply", "section.png", "report.json"


def execute(options: RefineOptions) -> int:
    """Refine a run; returns the exit code."""
    return refine_folder(
        options.run, options.dataset(), rounds=options.rounds, most=options.points,
        plot=options.plot, overwrite=options.overwrite, quiet=options.quiet,
    )  # fmt: skip


def refine_folder(
    folder: Path, dataset: Dataset, *, rounds: int = 5, most: int = 3000,
    plot: bool | None = None, overwrite: bool = False, quiet: bool = False,
) -> int:  # fmt: skip
    """Refine the run in a folder, whose data set is read once more; into ``folder/refined``."""
    draws = console.draws_pictures(plot)
    run = FinishedRun.read(folder, dataset)
    settings = Settings(rounds=rounds, sigma=run.config.matching.point_sigma)
    found = _refined(folder, [run], [run.trajectory], (0,), settings, most, quiet=quiet)
    return _write_all(folder, [run], found, draws=draws, overwrite=overwrite, quiet=quiet)


def refine_merged(
    folder: Path, runs: Sequence[FinishedRun], merged: MergedMaps, *,
    plot: bool | None = None, quiet: bool = False,
) -> int:  # fmt: skip
    """Refine runs whose maps were merged, together; into ``folder/refined``."""
    draws = console.draws_pictures(plot)
    ways = [merged.trajectory(number, run.updates) for number, run in enumerate(runs)]
    settings = Settings(sigma=runs[0].config.matching.point_sigma)
    found = _refined(folder, runs, ways, merged.starts, settings, 3000, quiet=quiet)
    return _write_all(folder, runs, found, draws=draws, overwrite=True, quiet=quiet)


def _refined(
    folder: Path, runs: Sequence[FinishedRun], ways: Sequence[Trajectory], starts: Sequence[int],
    settings: Settings, most: int, *, quiet: bool,
) -> tuple[RefinedRun, ...]:  # fmt: skip
    """Runs refined, with what the map in a folder knows: loops, fixes, a user's own factors."""
    points = [run.points(most, quiet=quiet) for run in runs]
    graph = survey = None
    if map_of_run(folder).exists():
        with SavedMap(folder) as saved:
            graph, survey = saved.graph.held(), _survey(saved)
    with _progress(settings, quiet=quiet) as shown:
        return refine_runs(
            points, [run.updates for run in runs], ways, graph=graph, survey=survey,
            starts=starts, settings=settings, min_aligned=runs[0].config.solver.min_aligned,
            on_round=shown[0], on_window=shown[1],
        )  # fmt: skip


def _survey(saved: SavedMap) -> Survey | None:
    """The fixes of a map; None if it has none."""
    graph, frame = saved.graph, saved.frame
    if graph.fixes is None or frame.earth is None:
        return None
    stamps = np.array([place.stamp for place in graph.places], np.int64)
    return Survey(graph.fixes, stamps, frame.earth, frame.up)


@dataclass(frozen=True, slots=True, eq=False)
class FinishedRun:
    """The results of a run, and its data set.

    Where all ranges looked too long, its ``config`` has the offset that the run has found.
    """

    folder: Path
    dataset: Dataset
    updates: list[MapUpdate]
    config: Config

    @staticmethod
    def read(folder: Path, dataset: Dataset, updates: list[MapUpdate] | None = None) -> FinishedRun:
        """Read a run, but for ``updates`` that are known.

        A DatasetError if the folder has none, or one of other data.
        """
        if not (folder / "run.npz").exists() or not (folder / "config.yaml").exists():
            raise DatasetError(
                f"{folder}: expected the folder of a finished run, with run.npz and config.yaml; "
                "make one with loam-gtsam run PATH --output FOLDER"
            )
        check_data(folder, dataset)
        if updates is None:
            updates = read_updates(folder / "run.npz")
        config, summary = load_config(folder / "config.yaml"), summary_in(folder)
        told = {"range_offset": ("ranges", "advised_offset_m"), "beams": ("beams", "advised")}
        for key, (part, name) in told.items():
            if isinstance(known := summary.get(part), dict) and name in known:
                config = config.changed({f"sensor.{key}": known[name]})
        return FinishedRun(folder, dataset, updates, config)

    @property
    def trajectory(self) -> Trajectory:
        """Its poses, as loops have corrected them; a DatasetError if the files contradict."""
        frames = [update for update in self.updates if update.status.has_pose]
        stamps = [update.stamp for update in frames]
        as_run = Trajectory.from_poses(stamps, (update.map_T_lidar for update in frames))
        if not (self.folder / LOOP_FILES[1]).exists():
            if summary_in(self.folder).get("loops") is not None:
                raise DatasetError(
                    f"{self.folder}: expected {LOOP_FILES[1]}, for the run had loops; write_graph "
                    "writes it beside the files of write_run"
                )
            return as_run
        corrected = read_truth(self.folder / "trajectory.tum")
        if len(corrected) != len(as_run):
            raise DatasetError(f"{self.folder}: trajectory.tum and run.npz are not of the same run")
        return Trajectory(as_run.stamps, corrected.map_T_lidar)

    def points(self, most: int, *, quiet: bool) -> RunPoints:
        """The points of the data set; an InputError that names the folder if it is of another."""
        with console.progress_bar("points", len(self.updates), quiet=quiet) as show:
            try:
                return run_points(
                    self.dataset, self.updates, self.config, most=most,
                    on_sweep=lambda number: show(number + 1, ""),
                )  # fmt: skip
            except InputError as error:
                raise InputError(f"{self.folder} and {self.dataset.name}: {error}") from error


@contextmanager
def _progress(
    settings: Settings, *, quiet: bool
) -> Iterator[tuple[Callable[[Round], None], Callable[[int, int], None]]]:
    done: list[Round] = []
    with console.progress_bar("rounds", settings.rounds, quiet=quiet) as show:

        def on_round(last: Round) -> None:
            done.append(last)
            show(len(done), f"moved by {1e3 * last.moved:.1f} mm")

        yield on_round, lambda number, of: show(0, f"window {number} of {of}")


def _write_all(
    folder: Path, runs: Sequence[FinishedRun], found: Sequence[RefinedRun], *,
    draws: bool, overwrite: bool, quiet: bool,
) -> int:  # fmt: skip
    clouds = _held_out(found, refined=False), _held_out(found, refined=True)
    qualities = map_quality(*clouds[0]), map_quality(*clouds[1])
    report = _report(found, *qualities, runs)
    known = _names(len(runs))

    def write(target: Path) -> list[str]:
        for number, refined in enumerate(found):
            _write_trajectory(target, refined, known[len(_OF_RUN) * number :])
        every = [part for refined in found for part in refined.all_points()]
        points = voxel_filter(np.concatenate(every), runs[0].config.map.edge_voxel)
        write_ply(target / _CLOUD, np.empty((0, 3)), points)
        if draws and qualities[0].planes and qualities[1].planes:
            planes = _most_improved(*qualities)
            plot_section(target / _PICTURE, clouds[0][0], clouds[1][0], *planes)
        write_json(target / _REPORT, report)
        return [name for name in known if (target / name).exists()]

    with console.output_folder(folder / FOLDER, known, overwrite=overwrite) as target:
        files = console.write_results(target, known, _REPORT, write)
    if not quiet:
        Console().print(_table(report))
        typer.echo(f"Written to {target}: {', '.join(files)}")
    return 0


def _names(runs: int) -> tuple[str, ...]:
    """Files of a refinement: those of each run, and those of all."""
    numbers = [""] if runs == 1 else [f"_{number}" for number in range(1, runs + 1)]
    of_runs = [f"trajectory{number}{end}" for number in numbers for end in _OF_RUN]
    return *of_runs, _CLOUD, _PICTURE, _REPORT


def _held_out(found: Sequence[RefinedRun], *, refined: bool) -> tuple[FloatArray, IntArray]:
    parts = [run.held_out(refined=refined) for run in found]
    points, sweeps = zip(*parts, strict=True)
    return np.concatenate(points), np.concatenate(sweeps)


def _write_trajectory(folder: Path, found: RefinedRun, names: Sequence[str]) -> None:
    trajectory = found.trajectory
    write_tum(
        folder / names[0], trajectory, comments={"refined": "planes, lines and poses adjusted"}
    )
    write_kitti(folder / names[1], trajectory)
    told = zip(found.updates, trajectory.map_T_lidar, found.covariances, strict=True)
    poses = [
        replace(update, map_T_lidar=gtsam.Pose3(pose), covariance=covariance)
        for update, pose, covariance in told
    ]
    write_covariances(folder / names[2], poses)
    if found.earth is not None:
        write_enu(folder / names[3], trajectory, found.earth)


def _most_improved(before: MapQuality, after: MapQuality) -> tuple[FloatArray, FloatArray]:
    """Centre and normal of the plane that has become thinner by most."""
    _, first, last = np.intersect1d(before.keys, after.keys, return_indices=True)
    if not len(first):
        return after.centres[0], after.normals[0]
    best = int((before.thicknesses[first] - after.thicknesses[last]).argmax())
    return after.centres[last[best]], after.normals[last[best]]


def _report(
    found: Sequence[RefinedRun], before: MapQuality, after: MapQuality,
    runs: Sequence[FinishedRun],
) -> dict[str, Any]:  # fmt: skip
    common = common_thickness(before, after)
    all_of = found[0]
    first = all_of.before.map_T_middle[:, :3, 3]
    moved = np.linalg.norm(all_of.refined.path.map_T_middle[:, :3, 3] - first, axis=1)
    frames = np.concatenate([run.points.frames for run in found])
    edges = [0.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 50.0, 1e9]
    report: dict[str, Any] = {
        "frames": len(moved),
        "moved_mean_m": float(moved.mean()),
        "moved_max_m": float(moved.max()),
        "moved_most_frame": int(frames[moved.argmax()]),
        "common_planes": common[2],
        "rounds": [{name: getattr(done, name) for name in Round.__slots__}
                   for done in all_of.refined.rounds],
        "thickness_bins_mm": edges[:-1],
        "enu": None if all_of.earth is None else all_of.earth.as_dict(),
        "range_offsets_m": [run.config.sensor.range_offset for run in runs],
    }  # fmt: skip
    for name, quality, thickness in (
        ("before", before, common[0]), ("after", after, common[1])
    ):  # fmt: skip
        counts = np.histogram(1e3 * quality.thicknesses, edges)[0]
        report[name] = {
            "held_out_thickness_mm": 1e3 * thickness,
            "thickness_of_all_planes_mm": 1e3 * quality.thickness,
            "planes": quality.planes,
            "planar_share": quality.planar_share,
            "entropy": quality.entropy,
            "planes_by_thickness": counts.tolist(),
        }
    if len(runs) > 1:
        most = [run.first <= moved.argmax() for run in found].count(True) - 1
        report["moved_most_run"] = str(runs[most].folder)
        report["runs"] = [{"run": str(run.folder), "frames": len(one.updates)}
                          for run, one in zip(runs, found, strict=True)]  # fmt: skip
    errors = report["runs"] if len(runs) > 1 else [report["after"]]
    for error, run, one in zip(errors, runs, found, strict=True):
        if run.dataset.truth is not None:
            try:
                error["ate_rmse_m"] = absolute_error(one.trajectory, run.dataset.truth).rmse
            except InputError as problem:
                report["accuracy_problem"] = str(problem)
    return report


def _table(report: dict[str, Any]) -> Table:
    table = Table("", "before", "after", box=None)
    rows = {
        "thickness of common planes, held-out points (mm)": "held_out_thickness_mm",
        "planes": "planes",
        "share of planar voxels": "planar_share",
        "mean map entropy": "entropy",
    }
    for label, name in rows.items():
        values = (report[part][name] for part in ("before", "after"))
        table.add_row(label, *(f"{value:.4g}" for value in values))
    told = [run["ate_rmse_m"] for run in (report["after"], *report.get("runs", []))
            if "ate_rmse_m" in run]  # fmt: skip
    if told:
        errors = ", ".join(f"{error:.4f}" for error in told)
        table.add_row("ATE against the truth (m)", "", errors)
    moved = f"{report['moved_mean_m']:.4f}, most {report['moved_max_m']:.4f}"
    table.add_row("poses moved by (m)", "", moved)
    return table
