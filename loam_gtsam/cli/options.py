"""Options of the commands, each declared once, and what they say as objects.

A command takes groups of options: dataclasses whose fields are what typer reads. See
:func:`command`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

if TYPE_CHECKING:  # the help of a command needs neither GTSAM nor SciPy
    from loam_gtsam.config import Config
    from loam_gtsam.datasets.base import Dataset

DEBUG = "loam_gtsam.debug"
"""Key in the context of a command: whether ``--debug`` was given."""

Frames = Annotated[int | None, typer.Option(min=1, help="Stop after so many sweeps.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]


def _set_debug(ctx: typer.Context, wanted: bool) -> bool:
    if wanted:
        ctx.meta[DEBUG] = True
    return wanted


_Debug = Annotated[
    bool, typer.Option("--debug", callback=_set_debug, help="Show the traceback of an error.")
]


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Make a function with groups of options one that typer understands.

    Every parameter whose type is a dataclass is replaced by the fields of that dataclass, and
    ``--debug`` is added.
    """
    groups: dict[str, Any] = {}
    parameters: list[inspect.Parameter] = []
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in inspect.signature(function).parameters.items():
        if is_dataclass(hints[name]):
            groups[name] = hints[name]
            types = get_type_hints(hints[name], include_extras=True)
            options = inspect.signature(groups[name]).parameters.values()
            parameters += [option.replace(annotation=types[option.name]) for option in options]
        else:
            parameters.append(parameter.replace(annotation=hints[name]))
    debug = inspect.Parameter("debug", inspect.Parameter.KEYWORD_ONLY, default=False)
    parameters.append(debug.replace(annotation=_Debug))

    def call(*, debug: bool, **values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{item.name: values.pop(item.name) for item in fields(group)})
        function(**values)

    call.__name__, call.__doc__ = function.__name__, function.__doc__
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    vars(call)["__signature__"] = inspect.Signature(parameters)
    return call


@dataclass(frozen=True, slots=True, kw_only=True)
class InputOptions:
    """The data set that a command reads."""

    path: Annotated[
        str,
        typer.Argument(
            metavar="PATH",
            help="A folder of .bin sweeps (KITTI), a ROS 1 or ROS 2 bag, an .mcap or .db3 file, a "
            "sequence of a known data set (docs/inputs.md), or a built-in world such as "
            "sim:street_loop.",
        ),
    ]
    topic: Annotated[
        str | None,
        typer.Option(help="Topic of the sweeps [default: the one with most messages]."),
    ] = None
    imu_topic: Annotated[
        str | None,
        typer.Option(help="Topic of the IMU [default: the one with most messages]."),
    ] = None
    loader_options: Annotated[
        list[str] | None,
        typer.Option(
            "--option",
            metavar="KEY=VALUE",
            help="Option of the loader, e.g. time_unit=ns; may be given repeatedly. Those of each "
            "loader: docs/inputs.md.",
        ),
    ] = None

    def dataset(self) -> Dataset:
        """Open the data set."""
        from loam_gtsam.datasets import open_dataset

        options: dict[str, Any] = dict(
            _key_value("--option", entry) for entry in self.loader_options or []
        )
        return open_dataset(self.path, topic=self.topic, imu_topic=self.imu_topic, **options)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorOptions:
    """The sensor and single values, which change a configuration."""

    sensor: Annotated[
        str | None,
        typer.Option(
            help="Sensor model (sensor.model): vlp16, hdl32, hdl64, os1-16, os1-32, os1-64 or "
            "os1-128."
        ),
    ] = None
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="SECTION.KEY=VALUE", help="Change one value; may be given repeatedly."
        ),
    ] = None

    def changed(self, config: Config) -> Config:
        """``config`` with ``--sensor``, then with every ``--set`` at once."""
        if self.sensor is not None:
            config = config.changed({"sensor.model": self.sensor}, source="--sensor")
        for entry in self.overrides or []:
            key, _ = _key_value("--set", entry)
            if "." not in key:
                owners = [name for name, section in config if key in type(section).model_fields]
                meant = f", for example {owners[0]}.{entry}" if owners else ""
                raise typer.BadParameter(f"--set {entry}: expected SECTION.KEY=VALUE{meant}")
        return config.changed(*(self.overrides or []), source="--set")


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfigOptions(SensorOptions):
    """The configuration of a command."""

    preset: Annotated[
        str | None,
        typer.Option(help="Named configuration to start from: default, loam or aloam."),
    ] = None
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="YAML configuration.")
    ] = None

    def settings(self) -> Config:
        """The preset or the file, then ``--sensor``, then each ``--set`` in turn."""
        from loam_gtsam.config import load_config, preset

        if self.preset is not None and self.config is not None:
            raise typer.BadParameter(
                "give --preset or --config, not both; a file names its preset with 'preset: NAME'"
            )
        if self.config is not None:
            return self.changed(load_config(self.config))
        return self.changed(preset(self.preset or "default"))


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputOptions:
    """Where results go, and what is shown of them."""

    output: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the results [default: one in loam_gtsam_output, named after the "
            "data]. If it holds earlier results, a new folder beside it is used (DIR-2, DIR-3, "
            "...).",
        ),
    ] = None
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace earlier results in DIR.")
    ] = False
    plot: Annotated[
        bool | None,
        typer.Option(
            "--plot/--no-plot", help="Draw pictures [default: if matplotlib is installed]."
        ),
    ] = None
    quiet: Quiet = False


@dataclass(frozen=True, slots=True, kw_only=True)
class MappingOptions(OutputOptions):
    """Options that ``demo`` and ``run`` share."""

    profile: Annotated[bool, typer.Option("--profile", help="Show the time per stage.")] = False

    def of_a_run(self) -> RunOptions:
        """Options of ``run`` with the same values."""
        return RunOptions(**{item.name: getattr(self, item.name) for item in fields(self)})


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions(MappingOptions):
    """Options of ``run``."""

    frames: Frames = None
    bag: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also write a bag with LOAM's topics: ROS 1 (FILE.bag), ROS 2 (FILE.mcap, or a "
            "folder if FILE has no suffix).",
        ),
    ] = None
    view: Annotated[
        bool,
        typer.Option("--view", help="Watch the run live, in the Rerun viewer (viewer extra)."),
    ] = False
    rrd: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.rrd",
            help="Save what --view shows, to be opened later with: rerun FILE.rrd.",
        ),
    ] = None
    loops: Annotated[
        bool,
        typer.Option(
            "--loops",
            help="Close loops: look for places seen before, let the map follow, and write the "
            "pose graph (loops.enabled).",
        ),
    ] = False
    workers: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=16,
            help="Processes that extract features ahead of the solve; by default one for more "
            "than 200 sweeps. The result is the same.",
        ),
    ] = None
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Go on from the last checkpoint in the output folder, if a run of the same data "
            "and configuration was stopped or killed; the result is the same.",
        ),
    ] = False
    checkpoint: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="SECONDS",
            help="Time from one checkpoint to the next; 0 writes none.",
        ),
    ] = 60.0

    def check(self, path: str) -> None:
        """Refuse options that contradict each other, or that would replace the input ``path``."""
        from loam_gtsam.types import OutputError

        if self.resume and (self.bag is not None or self.rrd is not None):
            recording = "--bag" if self.bag is not None else "--rrd"
            raise typer.BadParameter(
                f"--resume: the frames before would not be in {recording}; give one only"
            )
        if self.resume and self.overwrite:
            raise typer.BadParameter(
                "--resume and --overwrite contradict each other; give one only"
            )
        source = Path(path).resolve()
        if self.bag is not None and self.bag.resolve() in (source, *source.parents):
            raise OutputError(
                f"--bag {self.bag}: the input must not be replaced; choose another name"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareOptions(OutputOptions):
    """Options of ``compare``."""

    frames: Frames = None
    solvers: Annotated[
        list[str] | None,
        typer.Option(
            "--solver",
            metavar="NAME",
            help="gtsam, another preset (loam, aloam), a configuration file (.yaml), or a peer "
            "(kiss-icp, small-gicp, genz-icp; see docs/compare.md); may be given repeatedly. "
            "Without truth the first one is the reference [default: gtsam and all presets].",
        ),
    ] = None
    shared_guess: Annotated[
        bool,
        typer.Option(
            "--shared-guess",
            help="All solvers of this package start from the guesses of the first of them.",
        ),
    ] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyOptions:
    """Options of ``study``."""

    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes on this machine [default: none, in this process]."),
    ] = None
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Run on a Dask cluster, e.g. tcp://HOST:8786; paths must exist on its workers.",
        ),
    ] = None
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the results [default: loam_gtsam_output/NAME_study]. Trials that are "
            "finished there are not run again.",
        ),
    ] = None
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Run failed trials again.")
    ] = False
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Run all trials again, finished ones as well.")
    ] = False
    quiet: Quiet = False


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimizeOptions:
    """Options of ``optimize``."""

    graph: Annotated[
        Path,
        typer.Argument(metavar="GRAPH", help="A pose graph: NAME.g2o, or GTSAM's NAME.graph."),
    ]
    output: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Where to write it [default: NAME_optimized.*]."),
    ] = None
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write the poses as TUM, if the graph has stamps."),
    ] = None
    robust: Annotated[
        bool,
        typer.Option("--robust/--plain", help="Switch off loops that contradict the others."),
    ] = True
    max_chi2: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Squared Mahalanobis distance from which a loop contradicts [default: that of "
            "pose_graph.max_chi2].",
        ),
    ] = None
    overwrite: Overwrite = False
    quiet: Quiet = False


def _key_value(option: str, entry: str) -> tuple[str, Any]:
    """``KEY=VALUE`` with the value read as YAML."""
    from ruamel.yaml import YAML

    key, separator, text = entry.partition("=")
    if not separator or not key.strip():
        raise typer.BadParameter(f"{option} {entry}: expected KEY=VALUE")
    try:
        return key.strip(), YAML(typ="safe", pure=True).load(text)
    except Exception as error:  # a day 32 is a ValueError, deep nesting a RecursionError
        raise typer.BadParameter(f"{option} {entry}: {text!r} is not a YAML value") from error
