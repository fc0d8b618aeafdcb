"""The commands of ``loam-gtsam``: demo, run, compare, study, inspect, optimize, refine, ...

Exit codes: 0 done, 1 an error, 2 wrong usage, 130 stopped by Ctrl-C, 143 by SIGTERM. What a command
needs is imported when the command runs: ``--help`` and the completion of a shell answer at once.
"""

from __future__ import annotations

import platform
from typing import Annotated

import typer

from loam_gtsam.cli.options import (
    CleanOptions,
    CompareOptions,
    ConfigOptions,
    ConvertOptions,
    DemoOptions,
    InspectOptions,
    LocaliseOptions,
    MergeOptions,
    OptimizeOptions,
    RefineOptions,
    RunOptions,
    StudyOptions,
    command,
)

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="LOAM's scan-to-map LiDAR mapping as a GTSAM factor graph.",
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from loam_gtsam.io.version import installed_version

        for name in ("loam_gtsam", "gtsam", "numpy"):
            typer.echo(f"{name} {installed_version(name)}")
        typer.echo(f"python {platform.python_version()}")
        raise typer.Exit


_VERSION = typer.Option("--version", callback=_show_version, is_eager=True, help="Show versions.")


@app.callback()
def _root(version: Annotated[bool, _VERSION] = False) -> None:
    pass


@app.command(short_help="Map a built-in world and compare with its exact truth.")
@command
def demo(options: DemoOptions) -> int:
    """Map a built-in simulated world and compare with its exact truth; downloads nothing."""
    from loam_gtsam.cli.run import execute
    from loam_gtsam.config import Config
    from loam_gtsam.datasets.sim.world import SimulatedWorld

    world = SimulatedWorld(options.scene, frames=options.frames)
    code = execute(world, Config(), options.of_a_run())
    if not options.quiet and code == 0:
        typer.echo(
            "\nNext: loam-gtsam inspect PATH   what is understood of your own data\n"
            "      loam-gtsam run PATH       map it\n"
            "      loam-gtsam config         every parameter, explained"
        )
    return code


@app.command()
@command
def run(options: RunOptions) -> int:
    """Map a data set and write trajectory, map, report and pictures.

    Ctrl-C stops after the current sweep and writes what was computed; a second one stops at once.
    Either way, --resume goes on.
    """
    from loam_gtsam.cli.run import execute

    config = options.settings()
    options.check()
    return execute(options.dataset(), config, options)


@app.command(short_help="Run several solvers on the same sweeps, and report.")
@command
def compare(options: CompareOptions) -> int:
    """Run several solvers on the same sweeps: tables, plots and a report in one HTML file.

    Ctrl-C stops after the current sweep and writes what was computed; a second one stops at once.
    """
    from loam_gtsam.cli.compare import execute

    return execute(options)


@app.command(short_help="Run sequences x configurations x seeds into one table.")
@command
def study(options: StudyOptions) -> int:
    """Run sequences x configs x seeds; one table (Parquet) of all results.

    Ctrl-C keeps the trials that are finished; the same command goes on from there. Exits with 1 if
    a trial failed.
    """
    from loam_gtsam.cli.study import execute

    return execute(options)


@app.command(hidden=True)
@command
def sweep(options: StudyOptions) -> int:
    """Old name of the command study."""
    from loam_gtsam.cli.study import execute

    typer.echo("sweep is an old name, which the next release drops: loam-gtsam study", err=True)
    return execute(options)


@app.command(short_help="Show what is understood of a data set, and problems.")
@command
def inspect(options: InspectOptions) -> int:
    """Show what is understood of a data set: topics, fields, times, beams, problems.

    Exits with 0 if it can be run and with 1 if not.
    """
    from rich.console import Console

    from loam_gtsam.cli.report import inspection

    config = options.settings()
    report, runnable = inspection(options.dataset(), config)
    Console().print(report)
    return 0 if runnable else 1


@app.command()
@command
def optimize(options: OptimizeOptions) -> int:
    """Optimise a saved pose graph, robust against wrong loops."""
    from loam_gtsam.cli.saved import optimise_graph

    return optimise_graph(options)


@app.command(short_help="Find a drive in the map of another one, and track it there.")
@command
def localise(options: LocaliseOptions) -> int:
    """Find the sweeps of PATH in a saved map, and track them there; the map stays as it is.

    Exits with 1 if no sweep was found in the map.
    """
    from loam_gtsam.cli.saved import localise_in_map

    return localise_in_map(options)


@app.command(short_help="Join the maps of several runs.")
@command
def merge(options: MergeOptions) -> int:
    """Join the maps of several runs that have places in common: one frame, one pose graph, one map.

    Without --refine no data are read again. The frame is that of the first. Exits with 1, and
    writes nothing, if a map has no place in common with the others.
    """
    from loam_gtsam.cli.merge import execute

    return execute(options)


@app.command(short_help="Make a map of a point cloud, or a point cloud of a map.")
@command
def convert(options: ConvertOptions) -> int:
    """Make a map of a foreign point cloud, in which drives are localised; or export a map."""
    from loam_gtsam.cli.merge import convert_map

    return convert_map(options)


@app.command(short_help="Adjust map and poses of a finished run.")
@command
def refine(options: RefineOptions) -> int:
    """Adjust all planes and lines of the map of a finished run together with its poses.

    PATH is the data set that was run: it is read once more. Trajectory, covariances, map, report
    and a cross-section go to RUN/refined.
    """
    from loam_gtsam.cli.refine import execute

    return execute(options)


@app.command(short_help="Take what moved out of the map of a finished run.")
@command
def clean(options: CleanOptions) -> int:
    """Take out of the map of a finished run what its sweeps saw through: people, cars.

    PATH is the data set that was run: it is read once more. The map without them, a picture of
    before and after, and the counts go to RUN/cleaned.
    """
    from loam_gtsam.cli.saved import clean_run

    return clean_run(options)


@app.command("config")
@command
def show_config(options: ConfigOptions) -> None:
    """Print a configuration; every key is explained by a comment."""
    from loam_gtsam.config import dump_config, preset
    from loam_gtsam.io.atomic import write_text
    from loam_gtsam.types import OutputError

    text, output = dump_config(preset(options.preset)), options.output
    if output is None:
        typer.echo(text, nl=False)
    elif output.exists() and not options.overwrite:
        raise OutputError(f"{output}: the file exists; add --overwrite or choose another name")
    else:
        write_text(output, text)
