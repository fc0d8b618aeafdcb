"""The contenders of a comparison, pipelines of this package and other systems, on equal sweeps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np

from loam_gtsam.config import PRESETS, Config, load_config
from loam_gtsam.frontend.organise import assign_rings, assign_times, usable_columns
from loam_gtsam.frontend.workers import Extraction, extract
from loam_gtsam.io.version import installed_version
from loam_gtsam.pipeline import Pipeline, RunResult
from loam_gtsam.registration.odometry import Guess, Odometry
from loam_gtsam.registration.solvers import ScanSolver
from loam_gtsam.studies.peers import PEERS, Peer, TimedPoints
from loam_gtsam.types import (
    BadSweep,
    ConfigError,
    Features,
    FeatureSweep,
    FrameStatus,
    InputError,
    MapUpdate,
    Scan,
    Sweep,
    SweepError,
    Trajectory,
)

_PRESET_OF = {"gtsam": "default"}
"""Solver names that are not the name of their preset."""


@dataclass(frozen=True, slots=True)
class Contender:
    """One solver that a comparison is to run.

    Attributes
    ----------
    name : of a solver of this package its preset (``gtsam`` is the default preset), of a peer its
        name in :data:`loam_gtsam.studies.peers.PEERS`
    config : of a solver of this package; None for a peer
    solver : a user's own solver in place of the one that ``config`` names
    """

    name: str
    config: Config | None = None
    solver: ScanSolver | None = None


def solver_names() -> tuple[str, ...]:
    """All names that :func:`find_contender` knows, those of this package first."""
    named = {preset: name for name, preset in _PRESET_OF.items()}
    return (*(named.get(preset, preset) for preset in PRESETS), *PEERS)


def find_contender(name: str) -> Contender:
    """The contender called ``name``; a name that ends in .yaml or .yml is a configuration file.

    Raises
    ------
    ConfigError
        If no solver has this name, or the configuration file does not fit.
    """
    if name in PEERS:
        return Contender(name)
    if Path(name).suffix in (".yaml", ".yml"):
        return Contender(Path(name).stem, load_config(name))
    preset = _PRESET_OF.get(name, name)
    if preset not in PRESETS:
        raise ConfigError(
            f"unknown solver {name!r}; expected one of {', '.join(solver_names())}, or a "
            "configuration file (.yaml)"
        )
    return Contender(name, PRESETS[preset])


# -- results ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SolverRun:
    """The result of one contender on all sweeps.

    Attributes
    ----------
    name : of the contender
    version : of the package that the contender comes from
    config : as used; None for a peer
    updates : one per sweep, corrected by loop closures if there are any; of a peer only stamp,
        pose, status and time have a meaning
    map_points : points of the whole map; of a peer the points or voxels that it still keeps
    problem : what ended the contender early, else ""
    """

    name: str
    version: str
    config: Config | None
    updates: tuple[MapUpdate, ...]
    map_points: int
    problem: str = ""

    @classmethod
    def of_result(cls, name: str, result: RunResult) -> SolverRun:
        """The run of a pipeline of this package."""
        updates = result.updates
        if result.loops is not None:
            poses = iter(result.trajectory.map_T_lidar)
            updates = tuple(
                replace(update, map_T_lidar=gtsam.Pose3(next(poses)))
                if update.status.has_pose
                else update
                for update in updates
            )
        return cls(
            name=name,
            version=f"loam_gtsam {installed_version()}",
            config=result.config,
            updates=updates,
            map_points=len(result.edge_points) + len(result.plane_points),
        )

    @property
    def used(self) -> tuple[int, ...]:
        """Numbers of the frames with a pose; of this package's solvers also predicted poses."""
        if self.config is None:
            wanted = [update.status is FrameStatus.OK for update in self.updates]
        else:
            wanted = [update.status.has_pose for update in self.updates]
        return tuple(np.flatnonzero(wanted).tolist())

    @property
    def trajectory(self) -> Trajectory:
        """The poses of the frames ``used``."""
        good = [self.updates[number] for number in self.used]
        return Trajectory.from_poses([u.stamp for u in good], [u.map_T_lidar for u in good])


# -- sweeps that all contenders share --------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class SharedSweep:
    """One sweep as all contenders take it.

    Attributes
    ----------
    sweep : as the data set gives it
    extraction : the features of a :class:`~loam_gtsam.types.Scan`, for pipelines of this package
    points : the points of the sweep, for peers
    problem : why there are no points
    """

    sweep: Sweep
    extraction: Extraction | None = None
    points: TimedPoints | None = None
    problem: str = ""

    @property
    def stamp(self) -> int:
        """Nanoseconds."""
        sweep = self.sweep
        return sweep.features.stamp if isinstance(sweep, FeatureSweep) else sweep.stamp


def share_sweeps(
    sweeps: Iterable[Sweep], config: Config, *, features: bool, points: bool
) -> Iterator[SharedSweep]:
    """Prepare each sweep once for all contenders.

    Parameters
    ----------
    config : decides the features and the points
    features : extract features, for pipelines of this package
    points : take the points with their times, for peers

    Raises
    ------
    InputError
        If points are wanted, and the data set has features instead of points.
    """
    # All features, as for this odometry: each pipeline thins them to the voxels of its own map.
    unthinned = config.changed("odometry.method=scan_to_scan")
    for sweep in sweeps:
        if isinstance(sweep, FeatureSweep) and points:
            raise InputError("peers need the points of raw sweeps; this data set has features only")
        shared = SharedSweep(sweep, problem=sweep.message if isinstance(sweep, BadSweep) else "")
        if isinstance(sweep, Scan):
            if points:
                try:
                    shared = replace(shared, points=timed_points(sweep, config))
                except SweepError as error:
                    shared = replace(shared, problem=str(error))
            if features:
                shared = replace(shared, extraction=extract(sweep, unthinned))
        yield shared


def timed_points(scan: Scan, config: Config) -> TimedPoints:
    """The points and times of a sweep that features are extracted from, as a peer takes them.

    Raises
    ------
    SweepError
        If the sweep has too few points, or their times cannot be known.
    """
    columns = usable_columns(scan, config)
    timing = assign_times(columns, assign_rings(columns, config.sensor), config)
    points = np.ascontiguousarray(columns.xyz.T, dtype=np.float64)
    return TimedPoints(points, np.asarray(timing.times, np.float64), timing.span)


# -- runners ---------------------------------------------------------------------------------------


class SharedGuess:
    """An odometry for several pipelines: the first one predicts, the others take the same step.

    The step is the guess seen from the last pose. The pipeline that asks first for a sweep gets the
    guess of ``odometry``; every other pipeline gets the same step from its own last pose, with the
    same twist.

    Parameters
    ----------
    odometry : of the first pipeline
    """

    def __init__(self, odometry: Odometry) -> None:
        self._odometry = odometry
        self._features: Features | None = None
        self._step: tuple[gtsam.Pose3, Guess] | None = None

    def guess(self, features: Features, last: MapUpdate | None) -> Guess:
        """See :meth:`loam_gtsam.registration.odometry.Odometry.guess`."""
        if features is self._features and self._step is not None and last is not None:
            last_T_guess, first = self._step
            return Guess(last.map_T_lidar.compose(last_T_guess), first.twist)
        own = self._odometry.guess(features, last)
        self._features = features
        self._step = None if last is None else (last.map_T_lidar.between(own.map_T_lidar), own)
        return own

    def remember(self, features: Features) -> None:
        """See :meth:`loam_gtsam.registration.odometry.Odometry.remember`."""
        self._odometry.remember(features)

    def reset(self) -> None:
        """See :meth:`loam_gtsam.registration.odometry.Odometry.reset`."""
        self._odometry.reset()
        self._features = self._step = None


class PipelineRunner:
    """A pipeline of this package as a contender.

    Parameters
    ----------
    name : of the contender
    pipeline : for this contender alone, and so is its IMU buffer, which learns the gyro's bias

    Attributes
    ----------
    updates : one per sweep so far
    """

    def __init__(self, name: str, pipeline: Pipeline) -> None:
        self.name, self.pipeline = name, pipeline
        self.updates: list[MapUpdate] = []

    def register(self, shared: SharedSweep) -> None:
        """Register a sweep."""
        self.updates.append(self.pipeline.process(shared.sweep, shared.extraction))

    def result(self, frames: int) -> SolverRun:
        """The run over the first ``frames`` sweeps."""
        return SolverRun.of_result(self.name, self.pipeline.result(self.updates[:frames]))


class PeerRunner:
    """A peer as a contender; if the peer fails, the other contenders go on without it.

    Attributes
    ----------
    updates : one per sweep so far
    problem : what ended the peer early, else ""
    """

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        self.updates: list[MapUpdate] = []
        self.problem = ""
        self._last_stamp: int | None = None

    def register(self, shared: SharedSweep) -> None:
        """Register a sweep; the peer predicts its guess by itself."""
        self.updates.append(self._update(shared.stamp, shared))

    def _update(self, stamp: int, shared: SharedSweep) -> MapUpdate:
        nowhere = gtsam.Pose3()
        if self.problem or shared.points is None:
            message = self.problem or shared.problem
            return MapUpdate(stamp, nowhere, FrameStatus.UNUSABLE_SCAN, message)
        if self._last_stamp is not None and stamp <= self._last_stamp:
            return MapUpdate(stamp, nowhere, FrameStatus.BAD_STAMP)
        try:
            registered = self.peer.register(stamp, shared.points)
        except Exception as error:  # foreign code: it may raise anything
            number = len(self.updates)
            self.problem = f"ended at frame {number}: {type(error).__name__}: {error}"
            return MapUpdate(stamp, nowhere, FrameStatus.UNUSABLE_SCAN, self.problem)
        self._last_stamp = stamp
        return MapUpdate(
            stamp=registered.stamp,
            map_T_lidar=gtsam.Pose3(registered.map_T_lidar),
            status=FrameStatus.OK,
            timings={"register": registered.seconds},
        )

    def result(self, frames: int) -> SolverRun:
        """The run over the first ``frames`` sweeps."""
        package = self.peer.package
        return SolverRun(
            name=self.peer.name,
            version=f"{package} {installed_version(package)}",
            config=None,
            updates=tuple(self.updates[:frames]),
            map_points=self.peer.map_points,
            problem=self.problem,
        )
