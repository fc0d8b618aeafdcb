"""Options of the commands, each declared once: a command takes one dataclass of options."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

if TYPE_CHECKING:  # the help of a command needs neither GTSAM nor SciPy
    from loam_gtsam.config import Config
    from loam_gtsam.config.completion import Kind
    from loam_gtsam.datasets.base import Dataset
    from loam_gtsam.pipeline import Parts
    from loam_gtsam.studies.contenders import Contender

_TYPER = "typer"


def option(help: str, *names: str, default: Any = None, **how: Any) -> Any:
    """A field that is an option of a command, with the further arguments of typer.Option."""
    return field(default=default, metadata={_TYPER: typer.Option(*names, help=help, **how)})


def _known(kind: Kind) -> Callable[[str], list[str]]:
    """The ``autocompletion`` of an option; imports nothing before it is asked."""
    module = "loam_gtsam.config.completion"
    return lambda incomplete: list(importlib.import_module(module).completions(kind, incomplete))


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

    A ``LoamError`` becomes one message on stderr and the exit code 1.
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
        except LoamError as error:
            if options.debug:
                raise
            typer.secho("error: ", fg=typer.colors.RED, bold=True, err=True, nl=False)
            typer.echo(str(error), err=True)
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
        "Pose of the lidar in the frame of the reference poses: x y z, or x y z qx qy qz qw.",
        metavar="NUMBERS",
    )
    sensor: str | None = option(
        "Model: vlp16, hdl32, hdl64, os1-16, -32, -64 or -128.", autocompletion=_known("sensor")
    )
    overrides: list[str] | None = option(
        "Change one value; may be given repeatedly.", "--set",
        metavar="SECTION.KEY=VALUE", autocompletion=_known("set"),
    )  # fmt: skip

    def dataset(self) -> Dataset:
        """Open the data set."""
        from loam_gtsam.datasets import open_dataset
        from loam_gtsam.datasets.base import PartOf, WithTruth
        from loam_gtsam.datasets.truth import extrinsic

        options = dict(_key_value("--option", entry) for entry in self.loader_options or [])
        dataset = open_dataset(self.path, topic=self.topic, imu_topic=self.imu_topic, **options)
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
            key, _ = _key_value("--set", entry)
            if "." not in key:
                owners = [name for name, section in config if key in type(section).model_fields]
                meant = f", for example {owners[0]}.{entry}" if owners else ""
                raise typer.BadParameter(f"--set {entry}: expected SECTION.KEY=VALUE{meant}")
        return config.changed(*(self.overrides or []), source="--set")


@dataclass(frozen=True, kw_only=True)
class InspectOptions(SourceOptions):
    """A data set and a configuration."""

    preset: str | None = option(
        "Configuration to start from: default, loam or aloam.", autocompletion=_known("preset")
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


@dataclass(frozen=True, kw_only=True)
class DemoOptions(OutputOptions):
    """Options of ``demo``."""

    scene: str = option("Built-in scene; a wrong name lists them.", default="street_loop")
    frames: int = option("Number of sweeps.", default=150, min=1)
    profile: bool = flag("Show the time per stage.", "--profile")

    def of_a_run(self) -> RunOptions:
        """Options of ``run`` with the same values."""
        shared = {item.name: getattr(self, item.name) for item in fields(OutputOptions)}
        return RunOptions(path=f"sim:{self.scene}", profile=self.profile, **shared)


_FACTORY = "PACKAGE.MODULE:FACTORY"


@dataclass(frozen=True, kw_only=True)
class PartOptions(InspectOptions):
    """Parts of a user's own; each is made by a function of one argument, the configuration."""

    solver: str | None = option(
        "gtsam, loam or aloam (solver.method), or a solver of your own.",
        metavar=f"NAME|{_FACTORY}",
        autocompletion=_known("solver"),
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


@dataclass(frozen=True, kw_only=True)
class RunOptions(OutputOptions, PartOptions):
    """Options of ``run``."""

    profile: bool = flag("Show the time per stage.", "--profile")
    frames: int | None = option("Stop after so many sweeps.", min=1)
    bag: Path | None = option(
        "Also write a bag with LOAM's topics: ROS 1 (FILE.bag), ROS 2 (FILE.mcap, or a folder if "
        "FILE has no suffix).",
        metavar="FILE",
    )
    view: bool = flag("Watch the run live, in the Rerun viewer (viewer extra).", "--view")
    rrd: Path | None = option(
        "Save what --view shows, to be opened later with: rerun FILE.rrd.", metavar="FILE.rrd"
    )
    loops: bool = flag(
        "Close loops: look for places seen before, let the map follow, and write the pose graph "
        "(loops.enabled).",
        "--loops",
    )
    refine: bool = flag(
        "Adjust all planes of the map together with the poses when the run is done; the results "
        "go to DIR/refined, as with loam-gtsam refine.",
        "--refine",
    )
    workers: int | None = option(
        "Processes that extract features ahead of the solve; by default one for more than 200 "
        "sweeps. The result is the same.",
        min=0,
        max=16,
    )
    resume: bool = flag(
        "Go on from the last checkpoint in the output folder, if a run of the same data and "
        "configuration was stopped or killed, or ended by --frames; the result is the same.",
        "--resume",
    )
    checkpoint: float = option(
        "Time from one checkpoint to the next; 0 writes none.",
        default=60.0,
        min=0.0,
        metavar="SECONDS",
    )

    def check(self) -> None:
        """Refuse options that contradict each other, or that would replace the input."""
        from loam_gtsam.types import OutputError

        if self.resume and (self.bag is not None or self.rrd is not None):
            other = "--bag" if self.bag is not None else "--rrd"
            problem = f"--resume: the frames before would not be in {other}; give one only"
            raise typer.BadParameter(problem)
        if self.resume and self.overwrite:
            raise typer.BadParameter(
                "--resume and --overwrite contradict each other; give one only"
            )
        source = Path(self.path).resolve()
        if self.bag is not None and self.bag.resolve() in (source, *source.parents):
            raise OutputError(
                f"--bag {self.bag}: the input must not be replaced; choose another name"
            )


@dataclass(frozen=True, kw_only=True)
class LocaliseOptions(OutputOptions, PartOptions):
    """Options of ``localise``."""

    map: Path = argument("MAP", "A map (.lgmap) that a run wrote, or the folder of its results.")
    extend: bool = flag(
        "Add what the map does not have yet, and write the larger map to DIR/map.lgmap; MAP stays.",
        "--extend",
    )
    frames: int | None = option("Stop after so many sweeps.", min=1)
    workers: int | None = option(
        "Processes that extract features ahead; by default one for more than 200 sweeps.",
        min=0,
        max=16,
    )


@dataclass(frozen=True, kw_only=True)
class CompareOptions(OutputOptions, SourceOptions):
    """Options of ``compare``."""

    frames: int | None = option("Stop after so many sweeps.", min=1)
    solvers: list[str] | None = option(
        "gtsam, loam, aloam, or a solver of your own: only the solver differs; may be given "
        "repeatedly, as all of these [default, if nothing is chosen: gtsam, loam and aloam].",
        "--solver",
        metavar="NAME|PACKAGE.MODULE:FACTORY",
    )
    front_ends: list[str] | None = option(
        "A front end of your own: only the features differ.",
        "--features",
        metavar="PACKAGE.MODULE:FACTORY",
    )
    presets: list[str] | None = option(
        "default, loam or aloam: the whole system differs.", "--preset", metavar="NAME"
    )
    configs: list[Path] | None = option(
        "A configuration file (.yaml): the whole system differs.", "--config", metavar="FILE"
    )
    peers: list[str] | None = option(
        "Another system: kiss-icp, genz-icp, small-gicp, and with an IMU rko-lio, genz-lio; with "
        "settings as in 'kiss-icp?deskew=false&voxel=scene' (docs/compare.md).",
        "--peer",
        metavar="NAME",
    )
    base: str = option(
        "Preset or configuration file (.yaml) into which --solver and --features are put.",
        default="default",
        metavar="NAME|FILE",
    )
    shared_guess: bool = flag(
        "All solvers of this package start from the guesses of the first of them.", "--shared-guess"
    )
    same_matches: bool = flag(
        "Ask every solver for the pose of each sweep with the same map and guess, so that the "
        "solve alone differs: cost, differences, convergence from disturbed guesses, time.",
        "--same-matches",
    )
    driver: str | None = option(
        "With --same-matches: the solver whose poses make the map, or truth [default: the first].",
        metavar="NAME",
    )

    def contenders(self) -> list[Contender]:
        """Those of all groups; the solvers of the package if none is chosen."""
        from loam_gtsam.config import load_config, preset
        from loam_gtsam.studies.contenders import METHODS, Group, make_contender

        is_file = Path(self.base).suffix in (".yaml", ".yml")
        base = self.changed(load_config(self.base) if is_file else preset(self.base, "--base: "))
        chosen = {
            Group.SOLVER: self.solvers,
            Group.FEATURES: self.front_ends,
            Group.PRESET: self.presets,
            Group.CONFIG: self.configs,
            Group.PEER: self.peers,
        }
        if not any(chosen.values()):
            chosen[Group.SOLVER] = [*METHODS]
        found = [
            make_contender(group, str(name), base)
            for group, names in chosen.items()
            for name in names or []
        ]
        return [replace(c, config=c.config and self.changed(c.config)) for c in found]


@dataclass(frozen=True, kw_only=True)
class StudyOptions(Options):
    """Options of ``study``."""

    spec: Path = argument(
        "SPEC", "What to run: sequences, configs, seeds (YAML; see docs/parameter_studies.md)."
    )
    workers: int | None = option(
        "Processes on this machine [default: none, in this process].", min=1
    )
    scheduler: str | None = option(
        "Run on a Dask cluster, e.g. tcp://HOST:8786; paths must exist on its workers.",
        metavar="ADDRESS",
    )
    output: Path | None = option(
        "Folder for the results [default: loam_gtsam_output/NAME_study]. Trials that are finished "
        "there are not run again.",
        metavar="DIR",
    )
    retry_failed: bool = flag("Run failed trials again.", "--retry-failed")
    overwrite: bool = flag("Run all trials again, finished ones as well.", "--overwrite")
    quiet: bool = flag("Print nothing but errors.", "--quiet", "-q")


@dataclass(frozen=True, kw_only=True)
class OptimizeOptions(Options):
    """Options of ``optimize``."""

    graph: Path = argument("GRAPH", "A pose graph: NAME.g2o, or GTSAM's NAME.graph.")
    output: Path | None = option("Where to write it [default: NAME_optimized.*].", metavar="FILE")
    trajectory: Path | None = option(
        "Also write the poses as TUM, if the graph has stamps.", metavar="FILE"
    )
    robust: bool = option(
        "Switch off loops that contradict the others.", "--robust/--plain", default=True
    )
    max_chi2: float | None = option(
        "Squared Mahalanobis distance from which a loop contradicts [default: that of "
        "pose_graph.max_chi2].",
        min=0.0,
    )
    overwrite: bool = flag("Replace an existing file.", "--overwrite")
    quiet: bool = flag("Print nothing but errors.", "--quiet", "-q")


@dataclass(frozen=True, kw_only=True)
class RefineOptions(SourceOptions):
    """Options of ``refine``."""

    run: Path = argument("RUN", "Folder with the results of loam-gtsam run PATH.")
    rounds: int = option("Search for planes, and solve, at most so often.", default=5, min=1)
    points: int = option("Points of a sweep at most.", default=3000, min=100)
    plot: bool | None = option(
        "Draw pictures [default: if matplotlib is installed].", "--plot/--no-plot"
    )
    overwrite: bool = flag("Replace earlier results in RUN/refined.", "--overwrite")
    quiet: bool = flag("Print nothing but errors.", "--quiet", "-q")


@dataclass(frozen=True, kw_only=True)
class ConfigOptions(Options):
    """Options of ``config``."""

    preset: str = option("Named configuration.", default="default")
    output: Path | None = option("Write to a file instead of the screen.", metavar="FILE")
    overwrite: bool = flag("Replace an existing file.", "--overwrite")


def _key_value(option: str, entry: str) -> tuple[str, Any]:
    """``KEY=VALUE`` with the value read as YAML."""
    from loam_gtsam.config.base import assignment
    from loam_gtsam.types import ConfigError

    try:
        return next(iter(assignment(entry, f"{option}: ", "KEY=VALUE").items()))
    except ConfigError as error:
        raise typer.BadParameter(str(error)) from error
