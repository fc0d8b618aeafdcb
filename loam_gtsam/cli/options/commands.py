"""The options of each command."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from loam_gtsam.cli.options.common import (
    Options,
    OutputOptions,
    PartOptions,
    SourceOptions,
    argument,
    flag,
    key_value,
    known,
    one_of,
    option,
)

if TYPE_CHECKING:  # the help of a command needs neither GTSAM nor SciPy
    from loam_gtsam.datasets.base import Dataset
    from loam_gtsam.studies.contenders import Contender


@dataclass(frozen=True, kw_only=True)
class DemoOptions(OutputOptions):
    """Options of ``demo``."""

    scene: str = option(
        "Built-in scene; a wrong name lists them.",
        default="street_loop",
        autocompletion=one_of("loam_gtsam.datasets.sim.world", "SCENES"),
    )
    frames: int = option("Number of sweeps.", default=150, min=1)
    profile: bool = flag("Show the time per stage.", "--profile")

    def of_a_run(self) -> RunOptions:
        """Options of ``run`` with the same values."""
        shared = {item.name: getattr(self, item.name) for item in fields(OutputOptions)}
        return RunOptions(path=f"sim:{self.scene}", profile=self.profile, **shared)


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
    gnss: bool = flag(
        "Tie the pose graph to the fixes of a GNSS receiver, and place the map on the earth "
        "(aiding.gnss).",
        "--gnss",
    )
    wheels: bool = flag("Predict the motion by the wheels (aiding.wheels).", "--wheels")
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
    inside: bool = flag(
        "The lidar is surely in the map, not on another storey or beyond it: found where much "
        "looks alike, too.",
        "--inside",
    )
    near: str | None = option(
        "Where in the map the lidar is at first, to within 8 m: found where much looks alike, too.",
        metavar="X,Y[,Z]",
    )
    frames: int | None = option("Stop after so many sweeps.", min=1)
    workers: int | None = option(
        "Processes that extract features ahead; by default one for more than 200 sweeps.",
        min=0,
        max=16,
    )

    def position(self) -> list[float] | None:
        """The position ``near`` which the lidar is."""
        if self.near is None:
            return None
        try:
            numbers = [float(part) for part in self.near.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) not in (2, 3):
            raise typer.BadParameter(f"--near: expected metres X,Y or X,Y,Z, got {self.near!r}")
        return numbers


@dataclass(frozen=True, kw_only=True)
class MergeOptions(OutputOptions):
    """Options of ``merge``."""

    maps: list[Path] = argument(
        "MAP...", "Two or more folders with the results of runs, or maps (.lgmap) alone."
    )
    refine: list[str] | None = option(
        "The data set of a run, as it was given to loam-gtsam run; once for each MAP, in their "
        "order. Then planes and poses of all runs are adjusted together, into DIR/refined.",
        metavar="PATH",
    )
    start: list[int] | None = option(
        "Number of the first sweep that the run used; once for each --refine [default: 0].", min=0
    )
    loader_options: list[str] | None = option(
        "Option of the loader of all data sets, e.g. topic=/points; may be given repeatedly.",
        "--option",
        metavar="KEY=VALUE",
    )

    def datasets(self) -> list[Dataset]:
        """Open the data sets of --refine."""
        from loam_gtsam.datasets import open_dataset
        from loam_gtsam.datasets.base import PartOf

        paths, starts = self.refine or [], self.start or [0] * len(self.refine or [])
        if paths and len(paths) != len(self.maps):
            raise typer.BadParameter(
                f"--refine: expected the data set of each of the {len(self.maps)} maps, in their "
                f"order, got {len(paths)}"
            )
        if len(starts) != len(paths):
            raise typer.BadParameter(
                f"--start: expected one for each of the {len(paths)} --refine, got {len(starts)}"
            )
        options = dict(key_value("--option", entry) for entry in self.loader_options or [])
        opened = [open_dataset(path, **options) for path in paths]
        return [PartOf(one, start, 1) for one, start in zip(opened, starts, strict=True)]


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(Options):
    """Options of ``convert``."""

    source: Path = argument("FROM", "A point cloud (.ply, .pcd, .las, .laz), or a map.")
    target: Path = argument("TO", "A map (.lgmap) of a cloud, or the other way round.")
    height: float = option("Of the lidar above the ground, metres.", default=1.7, min=0.1)
    lowest: float = option("Lowest beam of the lidar, degrees.", default=-15.0, min=-90.0)
    highest: float = option("Highest beam of the lidar, degrees.", default=15.0, max=90.0)
    sigma: float = option("Error of the cloud, metres.", default=0.02, min=0.0)
    overwrite: bool = flag("Replace an existing file.", "--overwrite")
    quiet: bool = flag("Print nothing but errors.", "--quiet", "-q")


@dataclass(frozen=True, kw_only=True)
class CompareOptions(OutputOptions, SourceOptions):
    """Options of ``compare``."""

    frames: int | None = option("Stop after so many sweeps.", min=1)
    solvers: list[str] | None = option(
        "gtsam, loam, aloam, or a solver of your own: only the solver differs; may be given "
        "repeatedly, as all of these [default, if nothing is chosen: gtsam, loam and aloam].",
        "--solver",
        metavar="NAME|PACKAGE.MODULE:FACTORY",
        autocompletion=known("solver"),
    )
    front_ends: list[str] | None = option(
        "A front end of your own: only the features differ.",
        "--features",
        metavar="PACKAGE.MODULE:FACTORY",
    )
    presets: list[str] | None = option(
        "default, loam or aloam: the whole system differs.",
        "--preset",
        metavar="NAME",
        autocompletion=known("preset"),
    )
    configs: list[Path] | None = option(
        "A configuration file (.yaml): the whole system differs.", "--config", metavar="FILE"
    )
    peers: list[str] | None = option(
        "Another system: kiss-icp, genz-icp, small-gicp, and with an IMU rko-lio, genz-lio; with "
        "settings as in 'kiss-icp?deskew=false&voxel=scene' (docs/compare.md).",
        "--peer",
        metavar="NAME",
        autocompletion=one_of("loam_gtsam.studies.peers", "PEERS"),
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
class FinishedRunOptions(SourceOptions):
    """A finished run, whose data set is read once more."""

    run: Path = argument("RUN", "Folder with the results of loam-gtsam run PATH.")
    plot: bool | None = option(
        "Draw pictures [default: if matplotlib is installed].", "--plot/--no-plot"
    )
    quiet: bool = flag("Print nothing but errors.", "--quiet", "-q")


@dataclass(frozen=True, kw_only=True)
class RefineOptions(FinishedRunOptions):
    """Options of ``refine``."""

    rounds: int = option("Search for planes, and solve, at most so often.", default=5, min=1)
    points: int = option("Points of a sweep at most.", default=3000, min=100)
    overwrite: bool = flag("Replace earlier results in RUN/refined.", "--overwrite")


@dataclass(frozen=True, kw_only=True)
class CleanOptions(FinishedRunOptions):
    """Options of ``clean``."""

    overwrite: bool = flag("Replace earlier results in RUN/cleaned.", "--overwrite")


@dataclass(frozen=True, kw_only=True)
class ConfigOptions(Options):
    """Options of ``config``."""

    preset: str = option("Named configuration.", default="default", autocompletion=known("preset"))
    output: Path | None = option("Write to a file instead of the screen.", metavar="FILE")
    overwrite: bool = flag("Replace an existing file.", "--overwrite")
