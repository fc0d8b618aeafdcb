"""The command line: ``loam-gtsam demo | run | compare | sweep | inspect | optimize | config``.

The only place that catches :class:`~loam_gtsam.types.LoamError`. Exit codes: 0 done, 1 an error
(one message on stderr), 2 wrong usage, 130 stopped by Ctrl-C, 143 by SIGTERM.
"""

from __future__ import annotations

import platform
from dataclasses import fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from ruamel.yaml import YAML
from typer.core import TyperGroup

from loam_gtsam.config import (
    Config,
    dump_config,
    load_config,
    preset,
    with_value,
)
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.io.atomic import atomic_file
from loam_gtsam.types import LoamError, OutputError

_DEBUG = "loam_gtsam.debug"


class _Group(TyperGroup):
    """Turns the package's errors into one message and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except LoamError as error:
            if ctx.meta.get(_DEBUG):
                raise
            typer.secho("error: ", fg=typer.colors.RED, bold=True, err=True, nl=False)
            typer.echo(str(error), err=True)
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            typer.echo("stopped; nothing was computed yet", err=True)
            raise typer.Exit(130) from None


app = typer.Typer(
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="LOAM's scan-to-map LiDAR mapping as a GTSAM factor graph.",
)


def _show_version(wanted: bool) -> None:
    if wanted:
        for name in ("loam_gtsam", "gtsam", "numpy"):
            typer.echo(f"{name} {version(name)}")
        typer.echo(f"python {platform.python_version()}")
        raise typer.Exit


def _set_debug(ctx: typer.Context, wanted: bool) -> bool:
    if wanted:
        ctx.meta[_DEBUG] = True
    return wanted


DataPath = Annotated[
    str,
    typer.Argument(
        metavar="PATH",
        help="A folder of .bin sweeps (KITTI), a ROS 1 or ROS 2 bag, an .mcap or .db3 file, a "
        "sequence of a known data set (docs/inputs.md), or a built-in world such as "
        "sim:street_loop.",
    ),
]
Topic = Annotated[
    str | None, typer.Option(help="Topic of the sweeps [default: the one with most messages].")
]
ImuTopic = Annotated[
    str | None, typer.Option(help="Topic of the IMU [default: the one with most messages].")
]
LoaderOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="KEY=VALUE",
        help="Option of the loader, e.g. time_unit=ns; may be given repeatedly. Those of each "
        "loader: docs/inputs.md.",
    ),
]
Sensor = Annotated[
    str | None,
    typer.Option(
        help="Sensor model (sensor.model): vlp16, hdl32, hdl64, os1-16, os1-32, os1-64 or os1-128."
    ),
]
Preset = Annotated[
    str | None,
    typer.Option(help="Named configuration to start from: default, loam or aloam."),
]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="YAML configuration.")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="SECTION.KEY=VALUE", help="Change one value; may be given repeatedly."
    ),
]
Output = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder for the results [default: loam_gtsam_output/NAME]. If it holds an earlier "
        "run, a new folder beside it is used (DIR-2, DIR-3, ...).",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier run in DIR.")]
Plot = Annotated[
    bool | None,
    typer.Option("--plot/--no-plot", help="Draw pictures [default: if matplotlib is installed]."),
]
Profile = Annotated[bool, typer.Option("--profile", help="Show the time per stage.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Debug = Annotated[
    bool, typer.Option("--debug", callback=_set_debug, help="Show the traceback of an error.")
]


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show versions."),
    ] = False,
) -> None:
    pass


@app.command(short_help="Map a built-in world and compare with its exact truth.")
def demo(
    scene: Annotated[
        str, typer.Option(help="Built-in scene; a wrong name lists them.")
    ] = "street_loop",
    frames: Annotated[int, typer.Option(min=1, help="Number of sweeps.")] = 150,
    output: Output = None,
    overwrite: Overwrite = False,
    plot: Plot = None,
    profile: Profile = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Map a built-in simulated world and compare with its exact truth; downloads nothing."""
    from loam_gtsam.cli.run import RunOptions, execute
    from loam_gtsam.datasets.sim.world import SimulatedWorld

    world = SimulatedWorld(scene, frames=frames)
    code = execute(world, Config(), RunOptions(frames, output, overwrite, plot, profile, quiet))
    if not quiet and code == 0:
        typer.echo(
            "\nNext: loam-gtsam inspect PATH   what is understood of your own data\n"
            "      loam-gtsam run PATH       map it\n"
            "      loam-gtsam config         every parameter, explained"
        )
    raise typer.Exit(code)


@app.command()
def run(
    path: DataPath,
    topic: Topic = None,
    imu_topic: ImuTopic = None,
    loader_options: LoaderOptions = None,
    sensor: Sensor = None,
    preset: Preset = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after so many sweeps.")] = None,
    output: Output = None,
    bag: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also write a bag with LOAM's topics: ROS 1 (FILE.bag), ROS 2 (FILE.mcap, or a "
            "folder if FILE has no suffix).",
        ),
    ] = None,
    view: Annotated[
        bool,
        typer.Option("--view", help="Watch the run live, in the Rerun viewer (viewer extra)."),
    ] = False,
    rrd: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.rrd",
            help="Save what --view shows, to be opened later with: rerun FILE.rrd.",
        ),
    ] = None,
    loops: Annotated[
        bool,
        typer.Option(
            "--loops",
            help="Close loops: look for places seen before, let the map follow, and write the "
            "pose graph (loops.enabled).",
        ),
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=16,
            help="Processes that extract features ahead of the solve; by default one for more "
            "than 200 sweeps. The result is the same.",
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Go on from the last checkpoint in the output folder, if a run of the same data "
            "and configuration was stopped or killed; the result is the same.",
        ),
    ] = False,
    checkpoint: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="SECONDS",
            help="Time from one checkpoint to the next; 0 writes none.",
        ),
    ] = 60.0,
    overwrite: Overwrite = False,
    plot: Plot = None,
    profile: Profile = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Map a data set and write trajectory, map, report and pictures.

    Ctrl-C stops after the current sweep and writes what was computed; a second one stops at once.
    Either way, --resume goes on.
    """
    from loam_gtsam.cli.run import RunOptions, execute

    settings = _settings(preset, config, sensor, overrides)
    if loops:
        settings = replace(settings, loops=replace(settings.loops, enabled=True))
    if resume and (bag is not None or rrd is not None):
        recording = "--bag" if bag is not None else "--rrd"
        raise typer.BadParameter(
            f"--resume: the frames before would not be in {recording}; give one only"
        )
    if resume and overwrite:
        raise typer.BadParameter("--resume and --overwrite contradict each other; give one only")
    if bag is not None and bag.resolve() in (Path(path).resolve(), *Path(path).resolve().parents):
        raise OutputError(f"--bag {bag}: the input must not be replaced; choose another name")
    dataset = _open(path, topic, imu_topic, loader_options)
    options = RunOptions(
        frames,
        output,
        overwrite,
        plot,
        profile,
        quiet,
        bag=bag,
        workers=workers,
        resume=resume,
        checkpoint_seconds=checkpoint,
        view=view,
        rrd=rrd,
    )
    raise typer.Exit(execute(dataset, settings, options))


@app.command(short_help="Run several solvers on the same sweeps, and report.")
def compare(
    path: DataPath,
    solvers: Annotated[
        list[str] | None,
        typer.Option(
            "--solver",
            metavar="NAME",
            help="gtsam, another preset (loam, aloam), a configuration file (.yaml), or a peer "
            "(kiss-icp, small-gicp, genz-icp; see docs/compare.md); may be given repeatedly. "
            "Without truth the first one is the reference [default: gtsam and all presets].",
        ),
    ] = None,
    shared_guess: Annotated[
        bool,
        typer.Option(
            "--shared-guess",
            help="All solvers of this package start from the guesses of the first of them.",
        ),
    ] = False,
    topic: Topic = None,
    imu_topic: ImuTopic = None,
    loader_options: LoaderOptions = None,
    sensor: Sensor = None,
    overrides: Overrides = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after so many sweeps.")] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the results [default: loam_gtsam_output/NAME_compare]. If it holds "
            "an earlier comparison, a new folder beside it is used (DIR-2, DIR-3, ...).",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier comparison in DIR.")
    ] = False,
    plot: Plot = None,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run several solvers on the same sweeps: tables, plots and a report in one HTML file.

    Ctrl-C stops after the current sweep and writes what was computed; a second one stops at once.
    """
    from loam_gtsam.cli.compare import execute
    from loam_gtsam.cli.run import RunOptions
    from loam_gtsam.studies.comparison import Contender, contender, solver_names
    from loam_gtsam.studies.peers import PEERS

    names = solvers or [name for name in solver_names() if name not in PEERS]
    contenders = []
    for entry in map(contender, names):
        changed = entry.config and _changed(entry.config, sensor, overrides)
        contenders.append(Contender(entry.name, changed))
    dataset = _open(path, topic, imu_topic, loader_options)
    options = RunOptions(frames, output, overwrite, plot, False, quiet)
    raise typer.Exit(execute(dataset, contenders, shared_guess, options))


@app.command(short_help="Run sequences x configurations x seeds into one table.")
def sweep(
    spec: Annotated[
        Path,
        typer.Argument(
            metavar="SPEC", help="What to run: sequences, configs, seeds (YAML; see docs/sweep.md)."
        ),
    ],
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes on this machine [default: none, in this process]."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Run on a Dask cluster, e.g. tcp://HOST:8786; paths must exist on its workers.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the results [default: loam_gtsam_output/NAME_sweep]. Trials that are "
            "finished there are not run again.",
        ),
    ] = None,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Run failed trials again.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Run all trials again, finished ones as well.")
    ] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run sequences x configs x seeds; one table (Parquet) of all results.

    Ctrl-C keeps the trials that are finished; the same command goes on from there. Exits with 1 if
    a trial failed.
    """
    from loam_gtsam.cli.study import SweepOptions, execute

    if workers is not None and scheduler is not None:
        raise typer.BadParameter("give --workers or --scheduler, not both")
    options = SweepOptions(workers, scheduler, output, retry_failed, overwrite, quiet)
    raise typer.Exit(execute(spec, options))


@app.command(short_help="Show what is understood of a data set, and problems.")
def inspect(
    path: DataPath,
    topic: Topic = None,
    imu_topic: ImuTopic = None,
    loader_options: LoaderOptions = None,
    sensor: Sensor = None,
    preset: Preset = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    debug: Debug = False,
) -> None:
    """Show what is understood of a data set: topics, fields, times, beams, problems.

    Exits with 0 if it can be run and with 1 if not.
    """
    from loam_gtsam.cli.report import inspection

    settings = _settings(preset, config, sensor, overrides)
    dataset = _open(path, topic, imu_topic, loader_options)
    report, runnable = inspection(dataset, settings)
    Console().print(report)
    raise typer.Exit(0 if runnable else 1)


@app.command()
def optimize(
    graph: Annotated[
        Path,
        typer.Argument(metavar="GRAPH", help="A pose graph: NAME.g2o, or GTSAM's NAME.graph."),
    ],
    output: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Where to write it [default: NAME_optimized.*]."),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write the poses as TUM, if the graph has stamps."),
    ] = None,
    robust: Annotated[
        bool,
        typer.Option("--robust/--plain", help="Switch off loops that contradict the others."),
    ] = True,
    max_chi2: Annotated[
        float,
        typer.Option(min=0.0, help="Squared Mahalanobis distance from which a loop contradicts."),
    ] = Config().pose_graph.max_chi2,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Optimise a saved pose graph, robust against wrong loops."""
    from loam_gtsam.cli.optimize import execute

    raise typer.Exit(
        execute(
            graph,
            output,
            trajectory,
            robust=robust,
            max_chi2=max_chi2,
            overwrite=overwrite,
            quiet=quiet,
        )
    )


@app.command("config")
def show_config(
    preset_name: Annotated[str, typer.Option("--preset", help="Named configuration.")] = "default",
    output: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write to a file instead of the screen.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE.")] = False,
    debug: Debug = False,
) -> None:
    """Print a configuration; every key is explained by a comment."""
    text = dump_config(preset(preset_name))
    if output is None:
        typer.echo(text, nl=False)
        return
    if output.exists() and not overwrite:
        raise OutputError(f"{output}: the file exists; add --overwrite or choose another name")
    with atomic_file(output) as file:
        file.write(text.encode("utf-8"))


def _open(
    path: str, topic: str | None, imu_topic: str | None, loader_options: list[str] | None
) -> Dataset:
    from loam_gtsam.datasets import open_dataset

    options: dict[str, Any] = dict(_key_value("--option", entry) for entry in loader_options or [])
    return open_dataset(path, topic=topic, imu_topic=imu_topic, **options)


def _key_value(option: str, entry: str) -> tuple[str, Any]:
    """``KEY=VALUE`` with the value read as YAML."""
    key, separator, text = entry.partition("=")
    if not separator or not key.strip():
        raise typer.BadParameter(f"{option} {entry}: expected KEY=VALUE")
    try:
        return key.strip(), YAML(typ="safe", pure=True).load(text)
    except Exception as error:  # a day 32 is a ValueError, deep nesting a RecursionError
        raise typer.BadParameter(f"{option} {entry}: {text!r} is not a YAML value") from error


def _settings(
    preset_name: str | None, file: Path | None, sensor: str | None, overrides: list[str] | None
) -> Config:
    """The configuration of a command: preset or file, then --sensor, then each --set in turn."""
    if preset_name is not None and file is not None:
        raise typer.BadParameter(
            "give --preset or --config, not both; a file names its preset with 'preset: NAME'"
        )
    config = load_config(file) if file is not None else preset(preset_name or "default")
    return _changed(config, sensor, overrides)


def _changed(config: Config, sensor: str | None, overrides: list[str] | None) -> Config:
    """``config`` with --sensor, then each --set in turn."""
    if sensor is not None:
        config = with_value(config, "sensor.model", sensor, f"--sensor {sensor}")
    for entry in overrides or []:
        key, value = _key_value("--set", entry)
        if "." not in key:
            owners = [s.name for s in fields(config) if hasattr(getattr(config, s.name), key)]
            meant = f", for example {owners[0]}.{entry}" if owners else ""
            raise typer.BadParameter(f"--set {entry}: expected SECTION.KEY=VALUE{meant}")
        config = with_value(config, key, value, f"--set {entry}")
    return config


def main() -> None:
    """Entry point of ``loam-gtsam``."""
    app(prog_name="loam-gtsam")


if __name__ == "__main__":
    main()
