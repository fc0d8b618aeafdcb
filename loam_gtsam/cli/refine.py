"""The command ``refine``: adjust planes and poses of a finished run, write what became of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from loam_gtsam.cli import console
from loam_gtsam.cli.options import RefineOptions
from loam_gtsam.config import load_config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.datasets.truth import read_truth
from loam_gtsam.io.atomic import write_json
from loam_gtsam.io.read_run import read_updates
from loam_gtsam.io.run_files import write_covariances, write_ply
from loam_gtsam.io.trajectories import write_kitti, write_tum
from loam_gtsam.loops.files import read_graph
from loam_gtsam.refine.map_quality import MapQuality, common_thickness, map_quality
from loam_gtsam.refine.rounds import Round, Settings
from loam_gtsam.refine.runs import RefinedRun, refine_run, run_points
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import (
    DatasetError,
    FloatArray,
    FrameStatus,
    InputError,
    MapUpdate,
    Trajectory,
)
from loam_gtsam.view.sections import plot_section

FOLDER = "refined"
FILES = (
    "trajectory.tum", "trajectory_kitti.txt", "trajectory_covariance.csv", "map.ply",
    "section.png", "report.json",
)  # fmt: skip


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
    if not (folder / "run.npz").exists():
        raise DatasetError(
            f"{folder}: expected the folder of a finished run, with run.npz and config.yaml; make "
            "one with loam-gtsam run PATH --output FOLDER"
        )
    draws = console.draws_pictures(plot)
    updates = read_updates(folder / "run.npz")
    config = load_config(folder / "config.yaml")
    graph, trajectory = None, None
    if (folder / "pose_graph.g2o").exists():
        graph = read_graph(folder / "pose_graph.g2o")
        trajectory = corrected_trajectory(folder, updates)
    settings = Settings(rounds=rounds, sigma=config.matching.point_sigma)
    with console.progress_bar("points", len(updates), quiet=quiet) as show:
        points = run_points(
            dataset, updates, config, most=most, on_sweep=lambda number: show(number + 1, "")
        )
    done: list[Round] = []
    with console.progress_bar("rounds", settings.rounds, quiet=quiet) as show:

        def on_round(last: Round) -> None:
            done.append(last)
            show(len(done), f"moved by {1e3 * last.moved:.1f} mm")

        found = refine_run(
            points, updates, trajectory=trajectory, graph=graph, settings=settings,
            min_aligned=config.solver.min_aligned, on_round=on_round,
            on_window=lambda done, of: show(0, f"window {done} of {of}"),
        )  # fmt: skip
    before, after = (map_quality(*found.held_out(refined=on)) for on in (False, True))
    report = _report(found, before, after, dataset)
    with console.output_folder(folder / FOLDER, FILES, overwrite=overwrite) as target:
        files = console.write_results(
            target,
            FILES,
            "report.json",
            lambda new: _write(new, found, (before, after), report, draws=draws, config=config),
        )
    if not quiet:
        Console().print(_table(report))
        typer.echo(f"Written to {target}: {', '.join(files)}")
    return 0


def corrected_trajectory(folder: Path, updates: list[MapUpdate]) -> Trajectory:
    """The trajectory of a run with loops, with the stamps of its frames."""
    read = read_truth(folder / "trajectory.tum")
    stamps = np.array([u.stamp for u in updates if u.status.has_pose], np.int64)
    if len(read) != len(stamps):
        raise DatasetError(f"{folder}: trajectory.tum and run.npz are not of the same run")
    return Trajectory(stamps, read.map_T_lidar)


def _write(
    folder: Path, found: RefinedRun, qualities: tuple[MapQuality, MapQuality],
    report: dict[str, Any], *, draws: bool, config: Any,
) -> list[str]:  # fmt: skip
    trajectory = found.trajectory
    write_tum(folder / FILES[0], trajectory, comments={"refined": "planes and poses adjusted"})
    write_kitti(folder / FILES[1], trajectory)
    told = zip(trajectory.stamps, trajectory.map_T_lidar, found.covariances, strict=True)
    poses = [MapUpdate(int(s), gtsam.Pose3(p), FrameStatus.OK, covariance=c) for s, p, c in told]
    write_covariances(folder / FILES[2], poses)
    write_ply(folder / FILES[3], np.empty((0, 3)), found.map_points(config.map.edge_voxel))
    files = list(FILES[:4])
    if draws and qualities[0].planes and qualities[1].planes:
        clouds = found.held_out(refined=False)[0], found.held_out()[0]
        plot_section(folder / FILES[4], *clouds, *_most_improved(*qualities))
        files.append(FILES[4])
    write_json(folder / FILES[5], report)
    return [*files, FILES[5]]


def _most_improved(before: MapQuality, after: MapQuality) -> tuple[FloatArray, FloatArray]:
    """Centre and normal of the plane that has become thinner by most."""
    _, first, last = np.intersect1d(before.keys, after.keys, return_indices=True)
    if not len(first):
        return after.centres[0], after.normals[0]
    best = int((before.thicknesses[first] - after.thicknesses[last]).argmax())
    return after.centres[last[best]], after.normals[last[best]]


def _report(
    found: RefinedRun, before: MapQuality, after: MapQuality, dataset: Dataset
) -> dict[str, Any]:
    common = common_thickness(before, after)
    first = found.before.map_T_middle[:, :3, 3]
    moved = np.linalg.norm(found.refined.path.map_T_middle[:, :3, 3] - first, axis=1)
    edges = [0.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 50.0, 1e9]
    report: dict[str, Any] = {
        "frames": len(moved),
        "moved_mean_m": float(moved.mean()),
        "moved_max_m": float(moved.max()),
        "moved_most_frame": int(found.points.frames[moved.argmax()]),
        "common_planes": common[2],
        "rounds": [{name: getattr(done, name) for name in Round.__slots__}
                   for done in found.refined.rounds],
        "thickness_bins_mm": edges[:-1],
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
    if dataset.truth is not None:
        try:
            error = absolute_error(found.trajectory, dataset.truth)
            report["after"]["ate_rmse_m"] = error.rmse
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
    if "ate_rmse_m" in report["after"]:
        table.add_row("ATE against the truth (m)", "", f"{report['after']['ate_rmse_m']:.4f}")
    moved = f"{report['moved_mean_m']:.4f}, most {report['moved_max_m']:.4f}"
    table.add_row("poses moved by (m)", "", moved)
    return table
