"""What a comparison runs: a mapper of ours or a peer, both fed with the same prepared sweeps."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.frontend.organise import assign_rings, assign_times, usable_columns
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.mapper import Mapper
from loam_gtsam.registration.odometry import make_odometry
from loam_gtsam.studies.peers import Peer, TimedPoints, version
from loam_gtsam.types import (
    BadSweep,
    Features,
    FeatureSweep,
    FloatArray,
    FrameStatus,
    InputError,
    MapUpdate,
    Scan,
    Sweep,
    SweepError,
    Trajectory,
)


@dataclass(frozen=True, slots=True)
class SolverRun:
    """What one estimator made of the sweeps.

    Attributes
    ----------
    name, version : of the contender; that of the package it comes from
    config : as used; None for a peer
    updates : one per sweep; of a peer only stamp, pose, status and time are meaningful
    map_points : of the whole map; of a peer those it still keeps, or its voxels
    problem : what ended it early, else ""
    """

    name: str
    version: str
    config: Config | None
    updates: tuple[MapUpdate, ...]
    map_points: int
    problem: str = ""

    @property
    def used(self) -> tuple[int, ...]:
        """Numbers of the frames with a pose of its own; predicted ones count, of ours."""
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


def timed_points(scan: Scan, config: Config) -> TimedPoints:
    """What a peer is given: the points and times our own pipeline works with.

    Raises
    ------
    SweepError
        If the sweep has too few points, or no times can be had.
    """
    columns = usable_columns(scan, config)
    timing = assign_times(columns, assign_rings(columns, config.sensor), config)
    points = np.ascontiguousarray(columns.xyz.T, dtype=np.float64)
    return TimedPoints(points, np.asarray(timing.times, np.float64), timing.span)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A guess, seen from the pose before: what can be handed to another solver."""

    last_T_guess: gtsam.Pose3
    twist: FloatArray | None


@dataclass(frozen=True, slots=True)
class Prepared:
    """One sweep as the estimators take it.

    Attributes
    ----------
    problem : why there are no features, and no points
    features, seconds : features, and the time their extraction took
    recorded : motion since the sweep before, by recorded odometry
    points : for peers
    """

    stamp: int
    problem: str = ""
    features: Features | None = None
    seconds: float = 0.0
    recorded: gtsam.Pose3 | None = None
    points: TimedPoints | None = None


def prepare(dataset: Dataset, config: Config, ours: bool, theirs: bool) -> Iterator[Prepared]:
    """The sweeps of a data set, with features for ours and points for peers if there are any.

    Raises
    ------
    InputError
        If there are peers, and the data set has features instead of sweeps.
    """
    last_odom: gtsam.Pose3 | None = None
    for sweep in dataset:
        prepared = _prepared(sweep, config, ours, theirs)
        if isinstance(sweep, FeatureSweep):
            if last_odom is not None:
                prepared = replace(prepared, recorded=last_odom.between(sweep.odom_T_lidar))
            last_odom = sweep.odom_T_lidar
        yield prepared


def _prepared(sweep: Sweep, config: Config, ours: bool, theirs: bool) -> Prepared:
    if isinstance(sweep, BadSweep):
        return Prepared(sweep.stamp, sweep.message)
    if isinstance(sweep, FeatureSweep):
        if theirs:
            raise InputError("peers need the points of raw sweeps; this data set has features only")
        return Prepared(sweep.features.stamp, features=sweep.features)
    points, features, problem = None, None, ""
    started = time.perf_counter()
    try:
        points = timed_points(sweep, config) if theirs else None
        started = time.perf_counter()
        features = extract_features(sweep, config) if ours else None
    except SweepError as error:
        problem = str(error)
    seconds = time.perf_counter() - started
    return Prepared(sweep.stamp, problem, features, seconds, points=points)


class Ours:
    """A mapper with its own odometry.

    Parameters
    ----------
    imu : of its own, for it learns the bias of the gyro; None does without
    """

    def __init__(self, name: str, config: Config, imu: ImuBuffer | None = None) -> None:
        self.name, self.config = name, config
        self.mapper = Mapper(config, imu=imu)
        self.odometry = make_odometry(config.odometry, self.mapper.imu)
        self.updates: list[MapUpdate] = []

    def register(self, sweep: Prepared, given: Step | None) -> Step | None:
        """Register a sweep from a given guess or an own one; returns the step of the guess."""
        if sweep.features is None:
            self.updates.append(self.mapper.skip(sweep.stamp, sweep.problem, None))
            return None
        started = time.perf_counter()
        last = self.mapper.last
        guess, twist = None, None
        step = given
        if step is None and sweep.recorded is not None:
            step = Step(sweep.recorded, None)
        if last is not None and step is not None:
            guess, twist = last.map_T_lidar.compose(step.last_T_guess), step.twist
        elif sweep.recorded is None:
            own = self.odometry.guess(sweep.features, last)
            # The first sweep is where the mapper puts it.
            guess, twist = None if last is None else own.map_T_lidar, own.twist
        seconds = time.perf_counter() - started
        update = self.mapper.register(sweep.features, guess, twist)
        timings = {"features": sweep.seconds, "odometry": seconds} | dict(update.timings)
        self.updates.append(replace(update, timings=timings))
        if last is None or guess is None:
            return None
        return step or Step(last.map_T_lidar.between(guess), twist)

    def result(self, frames: int) -> SolverRun:
        """What came of the first so many sweeps."""
        return SolverRun(
            name=self.name,
            version=f"loam_gtsam {version('loam_gtsam')}",
            config=self.config,
            updates=tuple(self.updates[:frames]),
            map_points=sum(len(points) for points in self.mapper.map_points()),
        )


class Theirs:
    """A peer; if it fails, the others go on without it."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        self.updates: list[MapUpdate] = []
        self.problem = ""
        self._last_stamp: int | None = None

    def register(self, sweep: Prepared, given: Step | None) -> Step | None:
        """Register a sweep; a peer predicts by itself, so ``given`` is handed on."""
        self.updates.append(self._update(sweep))
        return given

    def _update(self, sweep: Prepared) -> MapUpdate:
        nowhere = gtsam.Pose3()
        if self.problem or sweep.points is None:
            message = self.problem or sweep.problem
            return MapUpdate(sweep.stamp, nowhere, FrameStatus.UNUSABLE_SCAN, message)
        if self._last_stamp is not None and sweep.stamp <= self._last_stamp:
            return MapUpdate(sweep.stamp, nowhere, FrameStatus.BAD_STAMP)
        try:
            registered = self.peer.register(sweep.stamp, sweep.points)
        except Exception as error:  # foreign code: it may raise anything
            number = len(self.updates)
            self.problem = f"ended at frame {number}: {type(error).__name__}: {error}"
            return MapUpdate(sweep.stamp, nowhere, FrameStatus.UNUSABLE_SCAN, self.problem)
        self._last_stamp = sweep.stamp
        return MapUpdate(
            stamp=registered.stamp,
            map_T_lidar=gtsam.Pose3(registered.map_T_lidar),
            status=FrameStatus.OK,
            timings={"register": registered.seconds},
        )

    def result(self, frames: int) -> SolverRun:
        """What came of the first so many sweeps."""
        package = self.peer.package
        return SolverRun(
            name=self.peer.name,
            version=f"{package} {version(package)}",
            config=None,
            updates=tuple(self.updates[:frames]),
            map_points=self.peer.map_points,
            problem=self.problem,
        )
