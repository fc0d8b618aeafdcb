"""The commands on what a run has saved: ``optimize`` a pose graph, ``localise`` in a map."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from loam_gtsam.aiding.gnss import write_enu
from loam_gtsam.cli import console
from loam_gtsam.cli.options import CleanOptions, LocaliseOptions, OptimizeOptions
from loam_gtsam.cli.refine import FinishedRun
from loam_gtsam.cli.results import ENU_FILE, described
from loam_gtsam.cli.run import worker_count
from loam_gtsam.config import Config, dump_config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.io.atomic import file_name, write_json, write_text
from loam_gtsam.io.run_files import position_sigmas, write_covariances, write_npz, write_ply
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.loops.batch import OptimizedGraph, SavedGraph, optimize_graph
from loam_gtsam.loops.files import GTSAM_SUFFIXES, read_graph, write_graph
from loam_gtsam.maps.cleaning import View, clean_map, views
from loam_gtsam.maps.localizer import Localisation, localise, own_settings
from loam_gtsam.maps.map_file import MAP_FILE, SavedMap, map_of_run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import (
    DatasetError,
    InputError,
    MapUpdate,
    OutputError,
    Trajectory,
    stack_poses,
)
from loam_gtsam.view import plots
from loam_gtsam.view.sections import plot_cleaned

_LISTED = 10  # at most, of the loops that are switched off
CLEANED_FILES = MAP_FILE, "removed.ply", "cleaned.png", "report.json"
LOCALISED_FILES = (
    "trajectory.tum", "trajectory_covariance.csv", "run.npz", "config.yaml", MAP_FILE,
    "localised.png", ENU_FILE, "summary.json",
)  # fmt: skip


def optimise_graph(options: OptimizeOptions) -> int:
    """Optimise a pose graph; returns the exit code."""
    path, trajectory = options.graph, options.trajectory
    target = options.output or path.with_name(f"{path.stem}_optimized{path.suffix}")
    written = [target]
    if target.suffix == GTSAM_SUFFIXES[0]:
        written = [target.with_suffix(suffix) for suffix in GTSAM_SUFFIXES]
    if trajectory is not None:
        written.append(trajectory)
    for file in written:
        if file.resolve() == path.resolve():
            raise OutputError(f"{file}: the input must not be replaced; choose another name")
        if file.exists() and not options.overwrite:
            raise OutputError(f"{file}: the file exists; add --overwrite or choose another name")
    saved = read_graph(path)
    keys = saved.keys
    if trajectory is not None and set(keys) - set(saved.stamps):
        lack = "has no stamps for some poses, which --trajectory needs; leave it out"
        raise DatasetError(f"{path}: {lack}")
    max_chi2 = Config().pose_graph.max_chi2 if options.max_chi2 is None else options.max_chi2
    result = optimize_graph(saved, robust=options.robust, max_chi2=max_chi2)
    stamps = {key: saved.stamps[key] for key in keys if key in saved.stamps}
    write_graph(target, SavedGraph(result.factors, result.poses, stamps))
    if trajectory is not None:
        poses = [result.poses.atPose3(key) for key in keys]
        corrected = Trajectory.from_poses([stamps[key] for key in keys], poses)
        write_tum(trajectory, corrected, comments={"graph": path.name})
    if not options.quiet:
        Console().print(_table(saved, result, keys))
        typer.echo(f"Written to {', '.join(map(str, written))}")
    return 0


def _table(saved: SavedGraph, result: OptimizedGraph, keys: list[int]) -> Table:
    pairs = ((saved.poses.atPose3(key), result.poses.atPose3(key)) for key in keys)
    moves = np.array([after.translation() - before.translation() for before, after in pairs])
    moved = np.linalg.norm(moves, axis=1)
    off = [loop for loop in result.loops if not loop.active]
    table = Table(show_header=False, box=None)
    table.add_row("poses, factors", f"{len(keys)}, {saved.factors.size()}")
    table.add_row("loops", f"{len(result.loops)}, of which {len(off)} contradict the others")
    table.add_row("cost", f"{result.error_before:.6g} -> {result.error_after:.6g}")
    table.add_row("poses moved", f"{moved.mean():.3f} m on average, {moved.max():.3f} m at most")
    for loop in off[:_LISTED]:
        chi_squared = f"chi squared {loop.chi_squared:.4g}"
        table.add_row("switched off", f"{loop.earlier} - {loop.later}, {chi_squared}")
    if len(off) > _LISTED:
        table.add_row("", f"and {len(off) - _LISTED} more")
    return table


def localise_in_map(options: LocaliseOptions) -> int:
    """Localise a data set in a saved map, write what was found; returns the exit code."""
    path = map_of_run(options.map)
    plot = console.draws_pictures(options.plot)
    dataset = options.dataset()
    total = len(dataset) if options.frames is None else min(len(dataset), options.frames)
    wanted = options.output or Path("loam_gtsam_output") / f"{file_name(dataset.name)}_localised"
    with SavedMap(path) as saved:
        config = options.settings(own_settings(saved))
        with (
            console.output_folder(wanted, LOCALISED_FILES, overwrite=options.overwrite) as folder,
            console.stop_requests() as stop,
        ):
            started = time.perf_counter()
            with console.frame_progress(dataset.name, total, stop, quiet=options.quiet) as on_frame:
                found = localise(
                    dataset, saved, config, max_frames=options.frames, on_frame=on_frame,
                    keep_partial=True, workers=worker_count(options.workers, total),
                    extend=options.extend, inside=options.inside, near=options.position(),
                    **options.parts(config),
                )  # fmt: skip
            if not found.updates:
                raise DatasetError(f"{dataset.name}: no sweeps in it; see loam-gtsam inspect")
            summary = _summary(found, dataset, path) | {"seconds": time.perf_counter() - started}

            def write(target: Path) -> list[str]:
                if options.extend:
                    found.localizer.save(target / MAP_FILE)
                return _write(target, found, saved, summary, draws=plot)

            files = console.write_results(folder, LOCALISED_FILES, "summary.json", write)
    if not options.quiet:
        Console().print(_localised(summary))
        console.print_written(stop, len(found.updates), total, folder, files)
    nothing = f"{dataset.name}: none of the {len(found.updates)} sweeps could be used"
    if not found.fixes:
        typer.echo(f"no fix: the data do not fit {path}, or are too short", err=True)
    return console.exit_code(found.error, stop, found.updates, nothing) or int(not found.fixes)


def _summary(found: Localisation, dataset: Dataset, path: Path) -> dict[str, Any]:
    numbers = [n for n, update in enumerate(found.updates) if update.status.solved]
    accuracy = None
    if dataset.truth is not None and numbers:
        with suppress(InputError, ValueError):
            error = absolute_error(found.trajectory, dataset.truth)
            accuracy = {"ate_rmse_m": error.rmse, "ate_max_m": error.maximum}
    return {
        "map": str(path),
        "dataset": described(dataset),
        "frames": len(found.updates),
        "localised": len(numbers),
        "fixes": found.fixes,
        "first_fix_frame": numbers[0] if numbers else None,
        "interrupted": found.interrupted,
        "status_counts": found.status_counts,
        "last_message": found.updates[-1].message,
        "position_sigma_m": position_sigmas(found.updates),
        "accuracy": accuracy,
    }


def _write(
    folder: Path, found: Localisation, saved: SavedMap, summary: dict[str, Any], *, draws: bool
) -> list[str]:
    write_tum(folder / LOCALISED_FILES[0], found.trajectory, comments={"frame": "of the map"})
    write_covariances(folder / LOCALISED_FILES[1], found.solved)
    write_npz(folder / LOCALISED_FILES[2], found.updates)
    write_text(folder / LOCALISED_FILES[3], dump_config(found.config))
    if saved.frame.earth is not None:
        write_enu(folder / ENU_FILE, found.trajectory, saved.frame.earth)
    if draws:
        plots.plot_map(folder / "localised.png", *saved.points(), found.trajectory)
    write_json(folder / "summary.json", summary)
    return [name for name in LOCALISED_FILES if (folder / name).exists()]


def clean_run(options: CleanOptions) -> int:
    """Clean the map of a finished run; returns the exit code."""
    run = FinishedRun.read(options.run, options.dataset())
    folder, updates, config = run.folder, run.updates, run.config
    poses, way = stack_poses(u.map_T_lidar for u in updates), run.trajectory.map_T_lidar
    poses[[update.status.has_pose for update in updates]] = way
    draws, report = console.draws_pictures(options.plot), dict[str, dict[str, int]]()
    with SavedMap(folder / MAP_FILE) as saved:

        def write(target: Path) -> list[str]:
            with console.progress_bar("votes", len(updates), quiet=options.quiet) as show:
                shown = _shown_views(views(run.dataset, updates, poses, config), updates, show)
                cleaned = clean_map(saved, shown, config, target / MAP_FILE)
            gone, kept = cleaned.points[cleaned.moved], cleaned.points[~cleaned.moved]
            write_ply(target / "removed.ply", np.empty((0, 3)), gone)
            if draws:
                plot_cleaned(target / CLEANED_FILES[2], kept, gone, way[:, :3, 3])
            for layer, (points, removed) in cleaned.counts.items():
                report[layer] = {"points": points, "removed": removed}
            write_json(target / CLEANED_FILES[-1], report)
            return [name for name in CLEANED_FILES if (target / name).exists()]

        with console.output_folder(
            folder / "cleaned", CLEANED_FILES, overwrite=options.overwrite
        ) as target:
            files = console.write_results(target, CLEANED_FILES, CLEANED_FILES[-1], write)
    if not options.quiet:
        for layer, counts in report.items():
            if counts["points"]:
                typer.echo(f"{layer}: {counts['removed']} of {counts['points']} points removed")
        typer.echo(f"Written to {target}: {', '.join(files)}")
    return 0


def _shown_views(
    sweeps: Iterable[View], updates: Sequence[MapUpdate], show: Callable[[int, str], None]
) -> Iterator[View]:
    """The same views, with progress by their stamps."""
    for view in sweeps:
        show(min(view.number + 1, len(updates)), "")
        yield view


def _localised(summary: dict[str, Any]) -> Table:
    first, sigmas, accuracy = (
        summary[k] for k in ("first_fix_frame", "position_sigma_m", "accuracy")
    )
    table = Table(show_header=False, box=None)
    table.add_row("frames", f"{summary['frames']} in {summary['seconds']:.1f} s")
    table.add_row("localised", f"{summary['localised']}, found {summary['fixes']} times")
    table.add_row("first fix", "none" if first is None else f"frame {first}")
    if sigmas is not None:
        told = f"{sigmas['median']:.3f} m (standard deviation, median, with the map's)"
        table.add_row("position", told)
    if accuracy is not None:
        table.add_row("accuracy", f"ATE {accuracy['ate_rmse_m']:.3f} m")
    if summary["localised"] < summary["frames"] and summary["last_message"]:
        table.add_row("last message", summary["last_message"])
    return table
