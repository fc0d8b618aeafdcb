"""A finished run, refined: its data set is read once more, for the points of every sweep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from loam_gtsam.config import Config, SolverConfig
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.geometry import transform, voxel_filter
from loam_gtsam.loops.batch import SavedGraph, optimize_graph
from loam_gtsam.refine.adjustment import Refined, refine
from loam_gtsam.refine.motion_factors import (
    long_motion_factors,
    loop_factors,
    odometry_factors,
    told_directions,
)
from loam_gtsam.refine.rounds import Round, Settings
from loam_gtsam.refine.sweeps import Path, SweepPoints, extract_points
from loam_gtsam.registration.pose_errors import relative_covariance
from loam_gtsam.types import (
    BoolArray,
    FloatArray,
    FrameStatus,
    InputError,
    IntArray,
    MapUpdate,
    SweepError,
    Trajectory,
)

_SEEN = (FrameStatus.FIRST, FrameStatus.SPARSE_MAP)
"""Statuses of frames that were not solved and are in the map all the same."""
_HELD = 5
"""Of so many points of a sweep one is held out, to judge the map by."""


@dataclass(frozen=True, slots=True, eq=False)
class RunPoints:
    """The points of the frames of a run.

    Attributes
    ----------
    frames : (N,) numbers of the frames, all that have a pose
    used, held : N sweeps each: points for the adjustment, and others to judge the map by; none of
        frames that are not in the map
    """

    frames: IntArray
    used: tuple[SweepPoints, ...]
    held: tuple[SweepPoints, ...]


def run_points(
    dataset: Dataset,
    updates: Sequence[MapUpdate],
    config: Config,
    *,
    most: int = 3000,
    on_sweep: Callable[[int], None] | None = None,
) -> RunPoints:
    """Extract the points of all frames of a run, from the data set that was run.

    Parameters
    ----------
    updates : one per sweep of the data set, from its first on
    config : of the run
    most : points of a sweep at most
    on_sweep : called after each sweep with its number, to show progress

    Raises
    ------
    InputError
        If the sweeps are not those of the frames, by their stamps.
    """
    frames: list[int] = []
    used: list[SweepPoints] = []
    held: list[SweepPoints] = []
    for number, (sweep, update) in enumerate(zip(dataset, updates, strict=False)):
        if on_sweep is not None:
            on_sweep(number)
        if not update.status.has_pose:
            continue
        points = SweepPoints(update.stamp, np.empty((0, 3)), np.empty(0))
        if update.status.solved or update.status in _SEEN:
            try:
                points = extract_points(sweep, config, most)
            except SweepError as error:
                raise InputError(
                    f"sweep {number}: has no points, but its frame is {update.status}: {error}; "
                    "give the data set and the configuration of the run"
                ) from error
            if points.stamp + round(points.reference * 1e9) != update.stamp:
                raise InputError(
                    f"sweep {number}: expected the stamp {update.stamp} of its frame, got "
                    f"{points.stamp + round(points.reference * 1e9)}; give the data set of the run"
                )
        frames.append(number)
        out = np.arange(len(points.points)) % _HELD == _HELD - 1
        for part, chosen in ((used, ~out), (held, out)):
            rows = points.points[chosen], points.seconds[chosen]
            part.append(SweepPoints(points.stamp, *rows, points.reference))
    if not frames:
        raise InputError(f"{dataset.name}: expected frames with a pose, got none")
    return RunPoints(np.array(frames, np.int64), tuple(used), tuple(held))


@dataclass(frozen=True, slots=True, eq=False)
class RefinedRun:
    """A run and what the adjustment made of it.

    Attributes
    ----------
    points : of the frames
    before : path of the run, with which the adjustment began
    refined : the adjustment
    updates : N frames of the run that have a pose
    seen : (N,) whether the run saw all directions of each
    """

    points: RunPoints
    before: Path
    refined: Refined
    updates: tuple[MapUpdate, ...]
    seen: BoolArray

    @property
    def trajectory(self) -> Trajectory:
        """One pose per frame that has one, at the stamps of the run."""
        return self.refined.trajectory

    @property
    def covariances(self) -> FloatArray:
        """(N, 6, 6) of the poses, the first one being exact.

        From the first sweep on of which the run did not see all directions they are those of the
        run, or NaN if it has none: where nothing tells, planes know no better, and a chain of
        motions forgets that an error of the velocity persists.
        """
        clear = np.logical_and.accumulate(self.seen)[:, None, None]
        told = np.array([update.covariance for update in self.updates])
        return np.where(clear, self.refined.covariances, told)

    def relative_covariance(self, earlier: int, later: int) -> FloatArray:
        """(6, 6) of the motion between two poses, perturbation on the right of the later one.

        It is that of the run if there is a sweep between of which the run did not see all
        directions.
        """
        if self.seen[earlier : later + 1].all():
            return self.refined.relative_covariance(earlier, later)
        return relative_covariance(self.updates[earlier], self.updates[later])

    def held_out(self, *, refined: bool = True) -> tuple[FloatArray, IntArray]:
        """Points that took no part, (M, 3) metres in the refined or the first map; their sweeps."""
        return _in_map(self.refined.path if refined else self.before, self.points.held)

    def map_points(self, size: float) -> FloatArray:
        """The map, rebuilt from the points of all sweeps: one centroid per voxel of that size."""
        every = [
            _in_map(self.refined.path, part)[0] for part in (self.points.used, self.points.held)
        ]
        return voxel_filter(np.concatenate(every), size)


def _in_map(path: Path, sweeps: Sequence[SweepPoints]) -> tuple[FloatArray, IntArray]:
    parts = [
        transform(path.map_T_middle[number], path.deskewed(number, sweep))
        for number, sweep in enumerate(sweeps)
    ]
    return np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])


def _to_middle(update: MapUpdate, sweep: SweepPoints) -> gtsam.Pose3:
    """Pose of the middle of a sweep, seen from its reference time, as the run had it."""
    if update.map_T_middle is not None and update.middle_stamp == sweep.stamp:
        return update.map_T_lidar.between(update.map_T_middle)
    return gtsam.Pose3.Expmap(update.twist * -sweep.reference)


def refine_run(
    points: RunPoints,
    updates: Sequence[MapUpdate],
    *,
    trajectory: Trajectory | None = None,
    graph: SavedGraph | None = None,
    factors: gtsam.NonlinearFactorGraph | None = None,
    settings: Settings | None = None,
    min_aligned: float = SolverConfig().min_aligned,
    on_round: Callable[[Round], None] | None = None,
    on_window: Callable[[int, int], None] | None = None,
) -> RefinedRun:
    """Adjust the poses of a run, its odometry and its loops staying in the graph.

    Parameters
    ----------
    points : of the run, by :func:`run_points`
    updates : of the run
    trajectory : where the adjustment begins, if loops corrected the run; else the poses of
        ``updates``
    graph : pose graph of the run, whose loop closures are used unless they contradict the others
    factors : further ones, on the poses of the middles of the sweeps: ``gtsam.symbol("x", n)`` is
        that of frame ``points.frames[n]``
    min_aligned : matches that must fix a direction (``solver.min_aligned``); sweeps of which one
        is not fixed stay as the run had them
    on_round, on_window : see :func:`~loam_gtsam.refine.adjustment.refine`

    Raises
    ------
    InputError
        As :func:`~loam_gtsam.refine.adjustment.refine` does, or if the trajectory has other stamps.
    """
    frames = [updates[number] for number in points.frames]
    stamps = np.array([update.stamp for update in frames], np.int64)
    poses = np.array([update.map_T_lidar.matrix() for update in frames])
    if trajectory is not None:
        if not np.array_equal(trajectory.stamps, stamps):
            raise InputError("trajectory: expected the stamps of the run's poses, got others")
        poses = trajectory.map_T_lidar
    middles = np.array([sweep.stamp for sweep in points.used], np.int64)
    to_middle = [_to_middle(*pair) for pair in zip(frames, points.used, strict=True)]
    first = [pose @ step.matrix() for pose, step in zip(poses, to_middle, strict=True)]
    odometry = [
        u.map_T_lidar.compose(step).matrix() for u, step in zip(frames, to_middle, strict=True)
    ]
    keep = told_directions(frames, min_aligned)
    every = odometry_factors(frames, np.array(odometry))
    told = odometry_factors(frames, np.array(odometry), keep)
    far = long_motion_factors(frames, np.array(odometry))
    every.push_back(far)
    told.push_back(far)
    if graph is not None:
        solved = optimize_graph(graph)
        loops = loop_factors(graph, solved, stamps, to_middle)
        every.push_back(loops)
        told.push_back(loops)
    if factors is not None:
        every.push_back(factors)
        told.push_back(factors)
    before = Path.through(middles, np.array(first))
    # A sweep that the run did not see whole stays as the run had it, relative to its neighbours.
    whole = (keep == np.eye(6)).all(axis=(1, 2))
    asked = keep * whole[:, None, None]
    found = refine(
        points.used, before.map_T_middle, every, settings,
        keep=asked, for_covariances=told, on_round=on_round, on_window=on_window,
    )  # fmt: skip
    seen: BoolArray = whole.copy()
    seen &= np.array([update.status.solved or update.status in _SEEN for update in frames])
    return RefinedRun(points, before, found, tuple(frames), seen)
