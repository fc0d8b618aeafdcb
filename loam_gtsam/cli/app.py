"""The commands of ``loam-gtsam``: demo, run, compare, study, inspect, optimize, config.

The only module that catches :class:`~loam_gtsam.types.LoamError`. Exit codes: 0 done, 1 an error
(one message on stderr), 2 wrong usage, 130 stopped by Ctrl-C, 143 by SIGTERM.

Everything that a command needs is imported when the command runs: ``--help`` and the completion of
a shell answer at once.
"""

from __future__ import annotations

import platform
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from loam_gtsam.cli.options import (
    DEBUG,
    CompareOptions,
    ConfigOptions,
    InputOptions,
    MappingOptions,
    OptimizeOptions,
    Overwrite,
    RunOptions,
    SensorOptions,
    StudyOptions,
    command,
)


class _Group(TyperGroup):
    """Commands whose errors become one message and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.echo("stopped; nothing was computed yet", err=True)
            raise typer.Exit(130) from None
        except Exception as error:
            # Without that module none of its errors can have been raised, --help for one is not.
            types = sys.modules.get("loam_gtsam.types")
            if ctx.meta.get(DEBUG) or types is None or not isinstance(error, types.LoamError):
                raise
            typer.secho("error: ", fg=typer.colors.RED, bold=True, err=True, nl=False)
            typer.echo(str(error), err=True)
            raise typer.Exit(1) from None


app = typer.Typer(
    cls=_Group,
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


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show versions."),
    ] = False,
) -> None:
    pass


@app.command(short_help="Map a built-in world and compare with its exact truth.")
@command
def demo(
    *,
    scene: Annotated[
        str, typer.Option(help="Built-in scene; a wrong name lists them.")
    ] = "street_loop",
    frames: Annotated[int, typer.Option(min=1, help="Number of sweeps.")] = 150,
    options: MappingOptions,
) -> None:
    """Map a built-in simulated world and compare with its exact truth; downloads nothing."""
    from loam_gtsam.cli.run import execute
    from loam_gtsam.config import Config
    from loam_gtsam.datasets.sim.world import SimulatedWorld

    code = execute(SimulatedWorld(scene, frames=frames), Config(), options.of_a_run())
    if not options.quiet and code == 0:
        typer.echo(
            "\nNext: loam-gtsam inspect PATH   what is understood of your own data\n"
            "      loam-gtsam run PATH       map it\n"
            "      loam-gtsam config         every parameter, explained"
        )
    raise typer.Exit(code)


@app.command()
@command
def run(*, source: InputOptions, config: ConfigOptions, options: RunOptions) -> None:
    """Map a data set and write trajectory, map, report and pictures.

    Ctrl-C stops after the current sweep and writes what was computed; a second one stops at once.
    Either way, --resume goes on.
    """
    from loam_gtsam.cli.run import execute

    settings = config.settings()
    options.check(source.path)
    raise typer.Exit(execute(source.dataset(), settings, options))


@app.command(short_help="Run several solvers on the same sweeps, and report.")
@command
def compare(*, source: InputOptions, sensor: SensorOptions, options: CompareOptions) -> None:
    """Run several solvers on the same sweeps: tables, plots and a report in one HTML file.

    Ctrl-C stops after the current sweep and writes what was computed; a second one stops at once.
    """
    from loam_gtsam.cli.compare import execute
    from loam_gtsam.studies.contenders import Contender, find_contender, solver_names
    from loam_gtsam.studies.peers import PEERS

    names = options.solvers or [name for name in solver_names() if name not in PEERS]
    contenders = []
    for entry in map(find_contender, names):
        contenders.append(Contender(entry.name, entry.config and sensor.changed(entry.config)))
    raise typer.Exit(execute(source.dataset(), contenders, options))


_Spec = Annotated[
    Path,
    typer.Argument(
        metavar="SPEC",
        help="What to run: sequences, configs, seeds (YAML; see docs/parameter_studies.md).",
    ),
]


def _study(spec: Path, options: StudyOptions) -> None:
    from loam_gtsam.cli.study import execute

    if options.workers is not None and options.scheduler is not None:
        raise typer.BadParameter("give --workers or --scheduler, not both")
    raise typer.Exit(execute(spec, options))


@app.command(short_help="Run sequences x configurations x seeds into one table.")
@command
def study(*, spec: _Spec, options: StudyOptions) -> None:
    """Run sequences x configs x seeds; one table (Parquet) of all results.

    Ctrl-C keeps the trials that are finished; the same command goes on from there. Exits with 1 if
    a trial failed.
    """
    _study(spec, options)


@app.command(hidden=True)
@command
def sweep(*, spec: _Spec, options: StudyOptions) -> None:
    """Old name of the command study."""
    typer.echo("sweep is an old name, which the next release drops: loam-gtsam study", err=True)
    _study(spec, options)


@app.command(short_help="Show what is understood of a data set, and problems.")
@command
def inspect(*, source: InputOptions, config: ConfigOptions) -> None:
    """Show what is understood of a data set: topics, fields, times, beams, problems.

    Exits with 0 if it can be run and with 1 if not.
    """
    from rich.console import Console

    from loam_gtsam.cli.report import inspection

    settings = config.settings()
    report, runnable = inspection(source.dataset(), settings)
    Console().print(report)
    raise typer.Exit(0 if runnable else 1)


@app.command()
@command
def optimize(*, options: OptimizeOptions) -> None:
    """Optimise a saved pose graph, robust against wrong loops."""
    from loam_gtsam.cli.optimize import execute

    raise typer.Exit(execute(options))


@app.command("config")
@command
def show_config(
    *,
    preset_name: Annotated[str, typer.Option("--preset", help="Named configuration.")] = "default",
    output: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write to a file instead of the screen.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Print a configuration; every key is explained by a comment."""
    from loam_gtsam.config import dump_config, preset
    from loam_gtsam.io.atomic import write_text
    from loam_gtsam.types import OutputError

    text = dump_config(preset(preset_name))
    if output is None:
        typer.echo(text, nl=False)
        return
    if output.exists() and not overwrite:
        raise OutputError(f"{output}: the file exists; add --overwrite or choose another name")
    write_text(output, text)


def main() -> None:
    """Entry point of ``loam-gtsam``."""
    app(prog_name="loam-gtsam")
