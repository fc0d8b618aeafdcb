"""The contenders of a comparison, in groups that say what is held equal among them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, get_args

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.config import Config, SolverConfig, load_config, preset
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.datasets.decode.aiding import GnssFixes
from loam_gtsam.datasets.decode.extrinsics import rigid_transform
from loam_gtsam.errors import nearest
from loam_gtsam.frontend.organise import assign_rings, assign_times, usable_columns
from loam_gtsam.frontend.workers import Extraction, extract
from loam_gtsam.geometry import transform_each
from loam_gtsam.io.version import installed_version
from loam_gtsam.pipeline import Parts, Pipeline, RunResult
from loam_gtsam.refine.map_quality import MapQuality, map_quality
from loam_gtsam.registration.matches import spread_rows
from loam_gtsam.registration.odometry import Guess, Odometry
from loam_gtsam.studies.factories import is_factory, make_parts
from loam_gtsam.studies.peers import Inertial, Peer, TimedPoints, make_peer
from loam_gtsam.types import (
    BadSweep,
    ConfigError,
    Features,
    FeatureSweep,
    FloatArray,
    FrameStatus,
    InputError,
    IntArray,
    MapUpdate,
    Scan,
    Sweep,
    SweepError,
    Trajectory,
)

_SAMPLE, _MAP_SAMPLE = 2000, 200_000
"""Points of a sweep, and of a whole drive, that maps are judged by."""
METHODS: tuple[str, ...] = get_args(SolverConfig.model_fields["method"].annotation)
"""Solvers of this package by the name of their ``solver.method``."""


class Group(StrEnum):
    """What sets the contenders of a group apart, and so what they have in common."""

    SOLVER = "solver"
    FEATURES = "front end"
    PRESET = "preset"
    CONFIG = "configuration"
    PEER = "peer"

    @property
    def held_equal(self) -> str:
        """A sentence on what the contenders of this group share."""
        return _HELD_EQUAL[self]


_HELD_EQUAL = {
    Group.SOLVER: "Only the solver differs: features, map, search, gates of the matches, limits "
    "and the rule to predict are the same.",
    Group.FEATURES: "Only the features differ: map, gates, solver and the rule to predict are the "
    "same.",
    Group.PRESET: "The whole system differs: features, de-skew, map, gates, limits and solver are "
    "those of the preset.",
    Group.CONFIG: "The whole system differs, as the configuration files say.",
    Group.PEER: "Other systems on the points and times of the same sweeps, with their own de-skew, "
    "features, map and settings.",
}


@dataclass(frozen=True, slots=True)
class Contender:
    """What a comparison is to run.

    Attributes
    ----------
    name : of its row and its files; no two may be equal
    config : of a run of this package; None for a peer
    group : with which others it is to be compared
    parts : of a user's own, see :class:`loam_gtsam.pipeline.Parts`; each contender needs its own
    peer : see :func:`loam_gtsam.studies.peers.make_peer`; empty for runs of this package
    """

    name: str
    config: Config | None = None
    group: Group = Group.CONFIG
    parts: Parts = field(default_factory=lambda: Parts())
    peer: str = ""


def with_solver(base: Config, method: str) -> Config:
    """``base`` with another ``solver.method`` and nothing else."""
    return base.changed({"solver.method": method})


def make_contender(group: Group, name: str, base: Config) -> Contender:
    """The contender called ``name`` in a group.

    Raises ConfigError if there is none of that name.

    Parameters
    ----------
    group, name : ``SOLVER``: gtsam, loam, aloam, or ``package.module:factory``; ``FEATURES``:
        ``package.module:factory``; ``PRESET``: its name; ``CONFIG``: a file; ``PEER``: its name,
        with settings
    base : into which solvers and front ends are put
    """
    if group is Group.PEER:
        return Contender(name, None, group, peer=name)
    if group is Group.CONFIG:
        return Contender(Path(name).stem, load_config(name), group)
    if group is Group.PRESET:
        return Contender(f"preset {name}", preset(name), group)
    if group is Group.FEATURES or is_factory(name):
        part = "features" if group is Group.FEATURES else "solver"
        return Contender(name.rpartition(":")[2], base, group, make_parts({part: name}, base))
    if name not in METHODS:
        raise ConfigError(
            f"unknown solver {name!r}{nearest(name, METHODS, listing=False)}; expected "
            f"{', '.join(METHODS)}, or PACKAGE.MODULE:FACTORY. Presets, configuration files and "
            "peers have options of their own: --preset, --config, --peer"
        )
    return Contender(name, with_solver(base, name), group)


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
    loops : whether loop closures moved the poses, to which their covariances then do not belong
    """

    name: str
    version: str
    config: Config | None
    updates: tuple[MapUpdate, ...]
    map_points: int
    problem: str = ""
    group: Group = Group.CONFIG
    loops: bool = False

    @classmethod
    def of_result(cls, name: str, result: RunResult, group: Group = Group.CONFIG) -> SolverRun:
        """The run of a pipeline of this package."""
        updates = list(result.updates)
        if result.loops is not None:
            placed = [n for n, update in enumerate(updates) if update.status.has_pose]
            for number, pose in zip(placed, result.trajectory.map_T_lidar, strict=True):
                updates[number] = replace(updates[number], map_T_lidar=gtsam.Pose3(pose))
        points = len(result.edge_points) + len(result.plane_points)
        version, loops = f"loam_gtsam {installed_version()}", result.loops is not None
        return cls(name, version, result.config, tuple(updates), points, "", group, loops)

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


class SharedFeatures:
    """The features of the last sweep, extracted once for all that want the same."""

    def __init__(self) -> None:
        self._sweep: Sweep | None = None
        self._found: list[tuple[Any, Extraction]] = []

    def of(self, sweep: Sweep, config: Config, parts: Parts) -> Extraction | None:
        """The features of a sweep for one contender; None if the sweep has no points."""
        if not isinstance(sweep, Scan):
            return None
        if sweep is not self._sweep:
            self._sweep, self._found = sweep, []
        front_end, deskew = parts.get("features"), config.deskew
        key = config.sensor, config.features, deskew.enabled, deskew.reference, front_end
        for known, extraction in self._found:
            if known == key:
                return extraction
        extraction = extract_for_all(sweep, config, parts)
        self._found.append((key, extraction))
        return extraction


def extract_for_all(sweep: Scan, config: Config, parts: Parts) -> Extraction:
    """The features of a sweep for several pipelines, which may have maps of different voxels."""
    # No feature is left out: each pipeline thins the features to the voxels of its own map.
    whole = config.changed({"odometry.method": "scan_to_scan"})
    return extract(sweep, whole, parts.get("features"))


def timed_points(scan: Scan, config: Config) -> TimedPoints:
    """The points and times of a sweep that features are extracted from, as a peer takes them.

    Raises SweepError if the sweep has too few points, or their times cannot be known.
    """
    columns = usable_columns(scan, config)
    timing = assign_times(columns, assign_rings(columns, config.sensor), config)
    points = np.ascontiguousarray(columns.xyz.T, dtype=np.float64)
    return TimedPoints(points, np.asarray(timing.times, np.float64), timing.span)


class MapSample:
    """Some points of every sweep, to judge how sharp a map the poses of each contender make.

    The points are the same for all, 2000 of a sweep at most, as they were measured; each is put
    where the trajectory was at its time, linear in position between poses, whatever moment of a
    sweep a contender's poses belong to and however it de-skews.

    Parameters
    ----------
    config : decides which points of a sweep are used, and their times
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._sweeps: list[tuple[FloatArray, IntArray]] = []

    def add(self, sweep: Sweep) -> None:
        """Keep points of the next sweep; none of one that is unusable or has features only."""
        found = np.empty((0, 3)), np.empty(0, np.int64)
        if isinstance(sweep, Scan):
            with suppress(SweepError):
                timed = timed_points(sweep, self._config)
                rows = spread_rows(len(timed.points), _SAMPLE)
                stamps = sweep.stamp + np.round(timed.times[rows] * 1e9).astype(np.int64)
                found = timed.points[rows], stamps
        self._sweeps.append(found)

    def quality(self, run: SolverRun) -> MapQuality:
        """Sharpness of the map by the poses of a run, of at most 200,000 points.

        Points measured before its first pose and after its last are left out.
        """
        trajectory = run.trajectory
        if len(trajectory) < 2:
            return map_quality(np.empty((0, 3)))
        kept = [self._sweeps[number] for number in run.used]
        points, stamps = (np.concatenate(column) for column in zip(*kept, strict=True))
        numbers = np.repeat(np.arange(len(kept)), [len(part) for part, _ in kept])
        inside = (stamps >= trajectory.stamps[0]) & (stamps <= trajectory.stamps[-1])
        rows = np.flatnonzero(inside)
        rows = rows[spread_rows(len(rows), _MAP_SAMPLE)]
        map_T_lidar = trajectory.at(stamps[rows]).map_T_lidar
        return map_quality(transform_each(map_T_lidar, points[rows]), numbers[rows])

    def sharpness(self, run: SolverRun) -> dict[str, Any]:
        """The columns of :meth:`quality` in tables; none if the poses make no map."""
        try:
            quality = self.quality(run)
        except InputError:  # poses of a peer that are not finite, or whose stamps do not increase
            return {}
        share = quality.planar_share if quality.planes else np.nan
        return {
            "thickness_mm": 1e3 * quality.thickness,
            "planar_share": share,
            "entropy": quality.entropy,
        }


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
        guess = self._odometry.guess(features, last)
        self._features = features
        self._step = None if last is None else (last.map_T_lidar.between(guess.map_T_lidar), guess)
        return guess

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

    def __init__(
        self, contender: Contender, pipeline: Pipeline, features: SharedFeatures,
        fixes: GnssFixes | None = None,
    ) -> None:  # fmt: skip
        self.contender, self.pipeline, self._features = contender, pipeline, features
        self._fixes = fixes
        self.updates: list[MapUpdate] = []

    def register(self, sweep: Sweep) -> None:
        """Register a sweep, with features that another one extracted before if there are any."""
        extraction = self._features.of(sweep, self.pipeline.config, self.contender.parts)
        self.updates.append(self.pipeline.process(sweep, extraction))

    def result(self, frames: int) -> SolverRun:
        """The run over the first ``frames`` sweeps."""
        if self._fixes is not None:
            self.pipeline.tie_to_earth(self.updates[:frames], self._fixes)
        whole = self.pipeline.result(self.updates[:frames])
        return SolverRun.of_result(self.contender.name, whole, self.contender.group)

    def close(self) -> None:
        """Nothing is held."""
        return


class PeerRunner:
    """A peer as a contender; if the peer fails, the other contenders go on without it.

    ``config`` decides which points of a sweep are used, and their times.
    """

    def __init__(self, name: str, peer: Peer, config: Config) -> None:
        self.name, self.peer, self.config = name, peer, config
        self.updates: list[MapUpdate] = []
        self.problem = ""  # what ended the peer early
        self._last_stamp: int | None = None

    @classmethod
    def of(cls, text: str, dataset: Dataset, config: Config) -> PeerRunner:
        """The peer called ``text``, for a data set and its effective configuration."""
        return cls(text, make_peer(text, inertial_of(dataset, config)), config)

    def register(self, sweep: Sweep) -> None:
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
        points, problem = peer.map_points, self.problem
        return SolverRun(self.name, version, None, updates, points, problem, Group.PEER)

    def close(self) -> None:
        """End the peer's process, if it has one."""
        self.peer.close()


def inertial_of(dataset: Dataset, config: Config) -> Inertial | None:
    """The IMU of a data set for peers, by its extrinsics; None if there is none."""
    samples = dataset.imu if config.imu.coupling != "off" else None
    if samples is None:
        return None
    rotation = Rotation.from_euler("xyz", config.imu.lidar_R_imu_deg, degrees=True)
    return Inertial(samples, rigid_transform(rotation, config.imu.lidar_t_imu))
