"""How options are declared, and the groups of them that several commands have."""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

if TYPE_CHECKING:  # the help of a command needs neither GTSAM nor SciPy
    from loam_gtsam.config import Config
    from loam_gtsam.config.completion import Kind
    from loam_gtsam.datasets.base import Dataset
    from loam_gtsam.pipeline import Parts

_TYPER = "typer"


def option(help: str, *names: str, default: Any = None, **how: Any) -> Any:
    """A field that is an option of a command, with the further arguments of typer.Option."""
    return field(default=default, metadata={_TYPER: typer.Option(*names, help=help, **how)})


def known(kind: Kind) -> Callable[[str], list[str]]:
    """The ``autocompletion`` of an option; imports nothing before it is asked."""
    module = "loam_gtsam.config.completion"
    return lambda incomplete: list(importlib.import_module(module).completions(kind, incomplete))


def one_of(module: str, table: str) -> Callable[[str], list[str]]:
    """The same for the names in a table of a module."""

    def names(incomplete: str) -> list[str]:
        every: Iterable[str] = getattr(importlib.import_module(module), table)
        return [name for name in every if name.startswith(incomplete)]

    return names


def flag(help: str, *names: str) -> Any:
    """A field that is an option without a value, off unless given."""
    return option(help, *names, default=False)


def argument(metavar: str, help: str) -> Any:
    """A field that is the argument of a command."""
    return field(metadata={_TYPER: typer.Argument(metavar=metavar, help=help)})


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of every command."""

    debug: bool = flag("Show the traceback of an error.", "--debug")


def command(function: Callable[[Any], int | None]) -> Callable[..., None]:
    """Make a function of one dataclass of options, which returns an exit code, one for typer.

    A ``LoamError``, and an ``OSError`` of the standard output, become one message on stderr and the
    exit code 1.
    """
    (group,) = (kind for name, kind in get_type_hints(function).items() if name != "return")

    def call(**values: Any) -> None:
        from loam_gtsam.types import LoamError

        options = group(**values)
        try:
            code = function(options)
        except KeyboardInterrupt:
            typer.echo("stopped; nothing was computed yet", err=True)
            code = 130
        except (LoamError, OSError) as error:
            closed = isinstance(error, BrokenPipeError)  # typer ends quietly: `| head` has enough
            if closed or options.debug:
                raise
            what = "standard output: " if isinstance(error, OSError) and _output_is_lost() else ""
            hint = "; results in files are written before they are shown" if what else ""
            typer.secho("error: ", fg=typer.colors.RED, bold=True, err=True, nl=False)
            typer.echo(f"{what}{error}{hint}", err=True)
            code = 1
        raise typer.Exit(code or 0)

    hints = get_type_hints(group)
    parameters = [
        inspect.Parameter(
            item.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if item.default is MISSING else item.default,
            annotation=Annotated[hints[item.name], item.metadata[_TYPER]],
        )
        for item in sorted(fields(group), key=lambda item: item.name == "debug")
    ]
    call.__name__, call.__doc__ = function.__name__, function.__doc__
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    vars(call)["__signature__"] = inspect.Signature(parameters)
    return call


def _output_is_lost() -> bool:
    """Whether not even a line end can be printed; it is dropped then, so that Python can exit."""
    try:
        sys.stdout.write("\n")
        sys.stdout.flush()
    except OSError:
        with suppress(OSError):  # no file behind it
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


@dataclass(frozen=True, kw_only=True)
class SourceOptions(Options):
    """The data set that a command reads, and changes of a configuration."""

    path: str = argument(
        "PATH",
        "A folder of .bin sweeps (KITTI), a ROS 1 or ROS 2 bag, an .mcap or .db3 file, a "
        "sequence of a known data set (docs/inputs.md), or a built-in world such as "
        "sim:street_loop.",
    )
    topic: str | None = option("Topic of the sweeps [default: the one with most messages].")
    imu_topic: str | None = option("Topic of the IMU [default: the one with most messages].")
    gnss_topic: str | None = option("Topic of a GNSS receiver (NavSatFix) [default: likewise].")
    wheels_topic: str | None = option("Topic of wheels (Odometry, TwistStamped).")
    loader_options: list[str] | None = option(
        "Option of the loader, e.g. time_unit=ns; may be given repeatedly. Those of each loader: "
        "docs/inputs.md.",
        "--option",
        metavar="KEY=VALUE",
    )
    start: int = option("Number of the first sweep that is used.", default=0, min=0)
    every: int = option("Use only every so many sweeps.", default=1, min=1)
    begin: float | None = option("From so long after the first sweep.", min=0.0, metavar="SECONDS")
    end: float | None = option("Until so long after the first sweep.", min=0.0, metavar="SECONDS")
    truth: Path | None = option(
        "Reference poses: TUM, EuRoC (csv), KITTI, positions, or a bag (docs/inputs.md).",
        metavar="FILE",
    )
    truth_topic: str | None = option(
        "Topic of the reference poses in a bag (PoseStamped, Odometry, NavSatFix, ...)."
    )
    truth_extrinsic: str | None = option(
        "Pose of the lidar in the frame of the reference poses: x y z, x y z qx qy qz qw, or the "
        "12 numbers of a 3 x 4 matrix.",
        metavar="NUMBERS",
    )
    sensor: str | None = option(
        "Model: vlp16, hdl32, hdl64, os1-16, -32, -64 or -128.", autocompletion=known("sensor")
    )
    overrides: list[str] | None = option(
        "Change one value; may be given repeatedly.", "--set",
        metavar="SECTION.KEY=VALUE", autocompletion=known("set"),
    )  # fmt: skip

    def dataset(self) -> Dataset:
        """Open the data set."""
        from loam_gtsam.datasets import open_dataset
        from loam_gtsam.datasets.base import PartOf, WithTruth
        from loam_gtsam.datasets.truth import extrinsic

        options = dict(key_value("--option", entry) for entry in self.loader_options or [])
        for name in ("topic", "imu_topic", "gnss_topic", "wheels_topic"):
            options[name] = getattr(self, name) or options.get(name)
        dataset = open_dataset(self.path, **options)
        if self.truth is not None:
            given = self.truth_extrinsic
            at = None if given is None else extrinsic(given)
            dataset = WithTruth.of(dataset, self.truth, topic=self.truth_topic, body_T_lidar=at)
        elif self.truth_topic is not None or self.truth_extrinsic is not None:
            raise typer.BadParameter("--truth-topic and --truth-extrinsic belong to --truth FILE")
        if (self.start, self.every, self.begin, self.end) == (0, 1, None, None):
            return dataset
        return PartOf(dataset, self.start, self.every, self.begin, self.end)

    def changed(self, config: Config) -> Config:
        """``config`` with ``--sensor``, then with every ``--set`` at once."""
        if self.sensor is not None:
            config = config.changed({"sensor.model": self.sensor}, source="--sensor")
        for entry in self.overrides or []:
            key, _ = key_value("--set", entry)
            if "." not in key:
                owners = [name for name, section in config if key in type(section).model_fields]
                meant = f", for example {owners[0]}.{entry}" if owners else ""
                raise typer.BadParameter(f"--set {entry}: expected SECTION.KEY=VALUE{meant}")
        return config.changed(*(self.overrides or []), source="--set")


@dataclass(frozen=True, kw_only=True)
class InspectOptions(SourceOptions):
    """A data set and a configuration."""

    preset: str | None = option(
        "Configuration to start from: default, loam or aloam.", autocompletion=known("preset")
    )
    config: Path | None = option("YAML configuration.", metavar="FILE")

    def settings(self, otherwise: Config | None = None) -> Config:
        """The preset or the file, else another one, then ``--sensor``, then every ``--set``."""
        from loam_gtsam.config import load_config, preset

        if self.preset is not None and self.config is not None:
            raise typer.BadParameter(
                "give --preset or --config, not both; a file names its preset with 'preset: NAME'"
            )
        if self.config is not None:
            return self.changed(load_config(self.config))
        if self.preset is None and otherwise is not None:
            return self.changed(otherwise)
        return self.changed(preset(self.preset or "default"))


@dataclass(frozen=True, kw_only=True)
class OutputOptions(Options):
    """Where results go, and what is shown of them."""

    output: Path | None = option(
        "Folder for the results [default: one in loam_gtsam_output, named after the data]. If it "
        "holds earlier results, a new folder beside it is used (DIR-2, DIR-3, ...).",
        metavar="DIR",
    )
    overwrite: bool = flag("Replace earlier results in DIR.", "--overwrite")
    plot: bool | None = option(
        "Draw pictures [default: if matplotlib is installed].", "--plot/--no-plot"
    )
    quiet: bool = flag("Print nothing but errors.", "--quiet", "-q")


_FACTORY = "PACKAGE.MODULE:FACTORY"


@dataclass(frozen=True, kw_only=True)
class PartOptions(InspectOptions):
    """Parts of a user's own; each is made by a function of one argument, the configuration."""

    solver: str | None = option(
        "gtsam, loam or aloam (solver.method), or a solver of your own.",
        metavar=f"NAME|{_FACTORY}",
        autocompletion=known("solver"),
    )
    features: str | None = option("A front end of your own.", metavar=_FACTORY)
    odometry: str | None = option("A prediction of your own.", metavar=_FACTORY)
    extra_factors: str | None = option("Factors of your own on every sweep.", metavar=_FACTORY)
    loop_closer: str | None = option("A loop closer of your own.", metavar=_FACTORY)

    def settings(self, otherwise: Config | None = None) -> Config:
        """With ``--solver``, if it names one of the package."""
        from loam_gtsam.studies.contenders import with_solver
        from loam_gtsam.studies.factories import is_factory

        config = super().settings(otherwise)
        if self.solver is None or is_factory(self.solver):
            return config
        return with_solver(config, self.solver)

    def parts(self, config: Config) -> Parts:
        """Those that were asked for."""
        from loam_gtsam.studies.factories import PARTS, is_factory, make_parts

        names = {name: getattr(self, name) for name in PARTS}
        if self.solver is not None and not is_factory(self.solver):
            del names["solver"]
        return make_parts(names, config)


def key_value(option: str, entry: str) -> tuple[str, Any]:
    """``KEY=VALUE`` with the value read as YAML."""
    from loam_gtsam.config.base import assignment
    from loam_gtsam.types import ConfigError

    try:
        return next(iter(assignment(entry, f"{option}: ", "KEY=VALUE").items()))
    except ConfigError as error:
        raise typer.BadParameter(str(error)) from error
