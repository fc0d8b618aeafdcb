"""The command ``optimize``: read a saved pose graph, optimise it, write it, print a table."""

from __future__ import annotations

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from loam_gtsam.cli.options import OptimizeOptions
from loam_gtsam.config import Config
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.loops.batch import OptimizedGraph, SavedGraph, optimize_graph
from loam_gtsam.loops.files import GTSAM_SUFFIXES, read_graph, write_graph
from loam_gtsam.types import DatasetError, OutputError, Trajectory

_LISTED = 10  # at most, of the loops that are switched off


def execute(options: OptimizeOptions) -> int:
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
