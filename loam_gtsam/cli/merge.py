"""The commands that make maps of maps: ``merge``, and ``convert`` for those of other systems."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

from loam_gtsam.aiding.gnss import write_enu
from loam_gtsam.cli import console
from loam_gtsam.cli.options import ConvertOptions, MergeOptions
from loam_gtsam.cli.refine import FinishedRun, refine_merged
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.io.atomic import write_json
from loam_gtsam.io.read_run import read_updates
from loam_gtsam.io.run_files import write_ply
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.loops.files import write_graph
from loam_gtsam.maps.clouds import import_cloud, read_cloud, write_cloud
from loam_gtsam.maps.map_file import MAP_FILE, SUFFIX, SavedMap, map_of_run
from loam_gtsam.maps.merging import MergedMaps, merge_maps
from loam_gtsam.types import DatasetError, MapUpdate, OutputError, Trajectory
from loam_gtsam.view import plots

GRAPH_FILE, PLOT_FILE = "pose_graph.g2o", "merged.png"


def execute(options: MergeOptions) -> int:
    """Merge maps; returns the exit code."""
    paths = [map_of_run(path) for path in options.maps]
    numbers = range(1, len(paths) + 1)
    names = [(f"trajectory_{number}.tum", f"trajectory_{number}_enu.tum") for number in numbers]
    files_of_runs = [name for pair in names for name in pair]
    known = (MAP_FILE, "map.ply", *files_of_runs, GRAPH_FILE, PLOT_FILE, "summary.json")
    datasets = options.datasets()
    draws, started = console.draws_pictures(options.plot), time.perf_counter()
    wanted = options.output or Path("loam_gtsam_output") / "merged"
    with ExitStack() as stack:
        maps = [stack.enter_context(SavedMap(path)) for path in paths]
        updates = [_frames(path, saved) for path, saved in zip(paths, maps, strict=True)]
        runs = _runs(paths, updates, datasets)
        report: dict[str, Any] = {}
        done: list[MergedMaps] = []

        def write(target: Path) -> list[str]:
            merged = _merge(maps, target / MAP_FILE, quiet=options.quiet)
            done.append(merged)
            ways = [merged.trajectory(*numbered) for numbered in enumerate(updates)]
            for (name, enu_name), way in zip(names, ways, strict=True):
                write_tum(target / name, way, comments={"frame": f"of {paths[0]}"})
                if merged.earth is not None:
                    write_enu(target / enu_name, way, merged.earth)
            write_graph(target / GRAPH_FILE, merged.graph.saved())
            with SavedMap(target / MAP_FILE) as whole:
                write_ply(target / "map.ply", *whole.points())
            if draws:
                labels = [f"{number}: {path}" for number, path in enumerate(options.maps, 1)]
                plots.plot_trajectories(target / PLOT_FILE, dict(zip(labels, ways, strict=True)))
            report.update(_summary(paths, merged, ways, time.perf_counter() - started))
            write_json(target / "summary.json", report)
            return [name for name in known if (target / name).exists()]

        with console.output_folder(wanted, known, overwrite=options.overwrite) as folder:
            files = console.write_results(folder, known, "summary.json", write)
    if not options.quiet:
        Console().print(_table(report))
        typer.echo(f"Written to {folder}: {', '.join(files)}")
    if runs:
        return refine_merged(folder, runs, done[-1], plot=options.plot, quiet=options.quiet)
    return 0


def _runs(
    paths: Sequence[Path],
    updates: Sequence[list[MapUpdate] | None],
    datasets: Sequence[Dataset],
) -> list[FinishedRun]:
    """The runs that are to be refined together; none without data sets."""
    found = []
    for path, frames, dataset in zip(paths, updates, datasets, strict=False):
        if frames is None:
            raise DatasetError(
                f"{path}: --refine expects the map of one run, with its run.npz and config.yaml "
                "beside it; give the folder of the run, or leave out --refine"
            )
        found.append(FinishedRun.read(path.parent, dataset, frames))
    return found


def _frames(path: Path, saved: SavedMap) -> list[MapUpdate] | None:
    """Frames of the run that made a map, if they are beside it and the map is of one run."""
    beside = path.with_name("run.npz")
    one_run = len(saved.graph.links) == len(saved.places) - 1
    updates = read_updates(beside) if one_run and beside.exists() else []
    stamps = {update.stamp for update in updates}
    return updates if any(place.stamp in stamps for place in saved.places) else None


def _merge(maps: Sequence[SavedMap], path: Path, *, quiet: bool) -> MergedMaps:
    total = sum(len(saved.places) for saved in maps)
    with console.progress_bar("places", total, quiet=quiet) as show:
        return merge_maps(maps, path, on_place=lambda done, of: show(done * total // of, ""))


def _summary(
    paths: Sequence[Path], merged: MergedMaps, ways: Sequence[Trajectory], seconds: float
) -> dict[str, Any]:
    maps = []
    for number, (path, way) in enumerate(zip(paths, ways, strict=True)):
        loops = {str(paths[sum(pair) - number]): count
                 for pair, count in merged.ties.items() if number in pair}  # fmt: skip
        places = len(merged.places(number))
        maps.append({"map": str(path), "places": places, "path_length_m": way.path_length,
                     "loops": loops})  # fmt: skip
    return {
        "maps": maps,
        "loops_between_maps": sum(merged.ties.values()),
        "loops_not_used": merged.unused,
        "fixes": merged.graph.sizes["fixes"],
        "enu": None if merged.earth is None else merged.earth.as_dict(),
        "seconds": seconds,
    }


def _table(report: dict[str, Any]) -> Table:
    table = Table("map", "places", "way", "loops with the others", box=None)
    for row in report["maps"]:
        loops = ", ".join(f"{count} with {path}" for path, count in row["loops"].items())
        table.add_row(row["map"], str(row["places"]), f"{row['path_length_m']:.0f} m", loops)
    return table


def convert_map(options: ConvertOptions) -> int:
    """Make a map of a cloud, or a cloud of a map; returns the exit code."""
    source, target = options.source, options.target
    if target.exists() and not options.overwrite:
        raise OutputError(f"{target}: the file exists; add --overwrite or choose another name")
    if target.suffix == SUFFIX:
        opening = options.lowest, options.highest
        made = import_cloud(
            read_cloud(source), target, height=options.height, sigma=options.sigma, opening=opening
        )
        said = f"{made.edges} edges, {made.planes} points on planes, {made.places} places"
        if made.shift.any():
            said += f"; its origin is at {', '.join(f'{value:.0f}' for value in made.shift)}"
    else:
        with SavedMap(source) as saved:
            edges, planes = saved.points()
        write_cloud(target, edges, planes)
        said = f"{len(edges) + len(planes)} points"
    if not options.quiet:
        typer.echo(f"Written to {target}: {said}")
    return 0
