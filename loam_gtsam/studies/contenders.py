"""The contenders of a comparison, pipelines of this package and other systems, on equal sweeps."""

from __future__ import annotations

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

_PRESET_OF = {"gtsam": "default"}  # solver names that are not the name of their preset


@dataclass(frozen=True, slots=True)
class Contender:
    """One solver that a comparison is to run; ``config`` is None for a peer.

    ``solver`` is a user's own solver in place of the one that ``config`` names.
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

    Raises ConfigError if no solver has this name, or the configuration file does not fit.
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


@dataclass(frozen=True, slots=True)
class SolverRun:
    """The result of one contender on all sweeps.

    Attributes
    ----------
    version : of the package that the contender comes from
    config : as used; None for a peer
    updates : one per sweep, corrected by loop closures if there are any
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
        updates = list(result.updates)
        if result.loops is not None:
            placed = [n for n, update in enumerate(updates) if update.status.has_pose]
            for number, pose in zip(placed, result.trajectory.map_T_lidar, strict=True):
                updates[number] = replace(updates[number], map_T_lidar=gtsam.Pose3(pose))
        points = len(result.edge_points) + len(result.plane_points)
        version = f"loam_gtsam {installed_version()}"
        return cls(name, version, result.config, tuple(updates), points)

    @property
    def used(self) -> tuple[int, ...]:
        """Numbers of the frames with a pose; of this package's solvers also predicted poses."""
        statuses = enumerate(update.status for update in self.updates)
        ours = self.config is not None
        return tuple(n for n, s in statuses if s is FrameStatus.OK or (ours and s.has_pose))

    @property
    def trajectory(self) -> Trajectory:
        """The poses of the frames ``used``."""
        good = [self.updates[number] for number in self.used]
        return Trajectory.from_poses([u.stamp for u in good], [u.map_T_lidar for u in good])


def extract_for_all(sweep: Sweep, config: Config) -> Extraction | None:
    """The features of a sweep for several pipelines; None if the sweep has no points."""
    if not isinstance(sweep, Scan):
        return None
    # No feature is left out: each pipeline thins the features to the voxels of its own map.
    return extract(sweep, config.changed({"odometry.method": "scan_to_scan"}))


def timed_points(scan: Scan, config: Config) -> TimedPoints:
    """The points and times of a sweep that features are extracted from, as a peer takes them.

    Raises SweepError if the sweep has too few points, or their times cannot be known.
    """
    columns = usable_columns(scan, config)
    timing = assign_times(columns, assign_rings(columns, config.sensor), config)
    points = np.ascontiguousarray(columns.xyz.T, dtype=np.float64)
    return TimedPoints(points, np.asarray(timing.times, np.float64), timing.span)


class SharedGuess:
    """An odometry for several pipelines: the first one predicts, the others take the same step.

    The others take that step from their own last pose, with the same twist.
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
    """A pipeline of this package as a contender; its ``updates`` are one per sweep so far.

    Pipeline and IMU buffer are for this contender alone: the buffer learns the gyro's bias.
    """

    def __init__(self, name: str, pipeline: Pipeline) -> None:
        self.name, self.pipeline = name, pipeline
        self.updates: list[MapUpdate] = []

    def register(self, sweep: Sweep, extraction: Extraction | None = None) -> None:
        """Register a sweep, with features that were extracted before if there are any."""
        self.updates.append(self.pipeline.process(sweep, extraction))

    def result(self, frames: int) -> SolverRun:
        """The run over the first ``frames`` sweeps."""
        return SolverRun.of_result(self.name, self.pipeline.result(self.updates[:frames]))


class PeerRunner:
    """A peer as a contender; if the peer fails, the other contenders go on without it.

    ``config`` decides which points of a sweep are used, and their times.
    """

    def __init__(self, peer: Peer, config: Config) -> None:
        self.peer, self.config = peer, config
        self.updates: list[MapUpdate] = []
        self.problem = ""  # what ended the peer early
        self._last_stamp: int | None = None

    def register(self, sweep: Sweep, extraction: Extraction | None = None) -> None:
        """Register a sweep; InputError if it has features instead of points."""
        if isinstance(sweep, FeatureSweep):
            raise InputError("peers need the points of raw sweeps; this data set has features only")
        self.updates.append(self._update(sweep))

    def _update(self, sweep: Scan | BadSweep) -> MapUpdate:
        unused = MapUpdate(sweep.stamp, gtsam.Pose3(), FrameStatus.UNUSABLE_SCAN, self.problem)
        if self.problem:
            return unused
        if isinstance(sweep, BadSweep):
            return replace(unused, message=sweep.message)
        try:
            points = timed_points(sweep, self.config)
        except SweepError as error:
            return replace(unused, message=str(error))
        if self._last_stamp is not None and sweep.stamp <= self._last_stamp:
            return replace(unused, status=FrameStatus.BAD_STAMP)
        try:
            update = self.peer.register(sweep.stamp, points)
        except Exception as error:  # foreign code: it may raise anything
            self.problem = f"ended at frame {len(self.updates)}: {type(error).__name__}: {error}"
            return replace(unused, message=self.problem)
        self._last_stamp = sweep.stamp
        return update

    def result(self, frames: int) -> SolverRun:
        """The run over the first ``frames`` sweeps."""
        peer, updates = self.peer, tuple(self.updates[:frames])
        version = f"{peer.package} {installed_version(peer.package)}"
        return SolverRun(peer.name, version, None, updates, peer.map_points, self.problem)
