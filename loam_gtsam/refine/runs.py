"""Finished runs, refined: their data sets are read once more, for the points of every sweep."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from loam_gtsam.config import Config, SolverConfig, as_config
from loam_gtsam.datasets.base import Dataset, check_dataset, sweeps_of_run
from loam_gtsam.datasets.decode.geodesy import GeoReference
from loam_gtsam.geometry import transform, voxel_filter
from loam_gtsam.loops.batch import SavedGraph
from loam_gtsam.loops.keyframes import pose_number
from loam_gtsam.refine.adjustment import Refined, refine
from loam_gtsam.refine.motion_factors import (
    long_motion_factors,
    loop_factors,
    odometry_factors,
    step_variances,
    to_middles,
    told_directions,
)
from loam_gtsam.refine.rounds import Round, Settings
from loam_gtsam.refine.sweeps import (
    Path,
    ReferenceSteps,
    SweepPoints,
    check_placed,
    extract_points,
    path_starts,
)
from loam_gtsam.refine.ties import FactorTies, FixTies, Survey, own_ties
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.types import (
    BoolArray,
    FloatArray,
    FrameStatus,
    InputError,
    IntArray,
    MapUpdate,
    SweepError,
    Trajectory,
    check_kind,
    check_updates,
    stack_poses,
)

_SEEN = (FrameStatus.FIRST, FrameStatus.SPARSE_MAP)
"""Statuses of frames that were not solved and are in the map all the same."""
_HELD = 5
"""Of so many points of a sweep on surfaces one is held out, to judge the map by."""


@dataclass(frozen=True, slots=True, eq=False)
class RunPoints:
    """The points of the frames of a run.

    Attributes
    ----------
    frames : (N,) numbers of the frames, all that have a pose
    used, held : N sweeps each: points for the adjustment, and others, on surfaces, to judge the map
        by; none of frames that are not in the map
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
    DatasetError
        If there are fewer of them.
    """
    frames: list[int] = []
    used: list[SweepPoints] = []
    held: list[SweepPoints] = []
    check_dataset(dataset)
    check_updates(updates)
    check_placed(updates)
    config = as_config(config)
    sweeps = sweeps_of_run(dataset, len(updates))
    for number, (sweep, update) in enumerate(zip(sweeps, updates, strict=True)):
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
        place = np.arange(len(points.points)) - points.edges
        out = (place >= 0) & (place % _HELD == _HELD - 1)
        used.append(points.chosen(~out))
        held.append(points.chosen(out))
    if not frames:
        raise InputError(f"{dataset.name}: expected frames with a pose, got none")
    return RunPoints(np.array(frames, np.int64), tuple(used), tuple(held))


@dataclass(frozen=True, slots=True, eq=False)
class RefinedRun:
    """A run and what the adjustment made of it.

    Attributes
    ----------
    points : of the frames
    before : path with which the adjustment began, of all runs that were adjusted together
    refined : the adjustment, of all of them
    updates : N frames of the run that have a pose
    seen : (N,) whether the run saw all directions of each
    first : number of its first sweep in ``before`` and ``refined``
    """

    points: RunPoints
    before: Path
    refined: Refined
    updates: tuple[MapUpdate, ...]
    seen: BoolArray
    first: int = 0

    @property
    def trajectory(self) -> Trajectory:
        """One pose per frame that has one, at the stamps of the run, in the frame of the first."""
        return self.refined.trajectory[self._rows]

    @property
    def earth(self) -> GeoReference | None:
        """Where the map is on the earth; None if no fixes took part."""
        return self.refined.earth

    @property
    def covariances(self) -> FloatArray:
        """(N, 6, 6) of the poses, that of the middle of the very first sweep being exact.

        From the first sweep on of which the run did not see all directions they are those of the
        run, on top of that of its first pose, or NaN if it has none: where nothing tells, planes
        know no better, and a chain of motions forgets that an error of the velocity persists.
        """
        clear = np.logical_and.accumulate(self.seen)[:, None, None]
        found = self.refined.covariances[self._rows]
        told = np.array([update.covariance for update in self.updates])
        if self.first:
            start = self.updates[0].map_T_lidar
            back = np.array([u.map_T_lidar.between(start).AdjointMap() for u in self.updates])
            told += back @ found[0] @ np.swapaxes(back, 1, 2)
        return np.where(clear, found, told)

    def relative_covariance(self, earlier: int, later: int) -> FloatArray:
        """(6, 6) of the motion between two poses, perturbation on the right of the later one.

        It is that of the run if there is a sweep between of which the run did not see all
        directions.
        """
        count = len(self.updates)
        if not 0 <= earlier < later < count:
            raise InputError(
                f"expected earlier < later, numbers of sweeps from 0 to {count - 1}, got {earlier} "
                f"and {later}" + ("; swap the two" if later < earlier else "")
            )
        if self.seen[earlier : later + 1].all():
            return self.refined.relative_covariance(self.first + earlier, self.first + later)
        return relative_covariance(self.updates[earlier], self.updates[later])

    def held_out(self, *, refined: bool = True) -> tuple[FloatArray, IntArray]:
        """Points that took no part, (M, 3) metres in the refined or the first map; their sweeps."""
        return self._in_map(self.refined.path if refined else self.before, self.points.held)

    def map_points(self, size: float) -> FloatArray:
        """The map, rebuilt from the points of all sweeps: one centroid per voxel of that size."""
        return voxel_filter(np.concatenate(self.all_points()), size)

    def all_points(self) -> tuple[FloatArray, FloatArray]:
        """Points of all sweeps on surfaces, metres in the refined map: used and held out."""
        path, points = self.refined.path, self.points
        return self._in_map(path, points.used)[0], self._in_map(path, points.held)[0]

    @property
    def _rows(self) -> slice:
        return slice(self.first, self.first + len(self.updates))

    def _in_map(self, path: Path, sweeps: Sequence[SweepPoints]) -> tuple[FloatArray, IntArray]:
        numbers = np.arange(self.first, self.first + len(sweeps))
        parts = [
            transform(path.map_T_middle[number], path.deskewed(number, sweep)[sweep.edges :])
            for number, sweep in zip(numbers.tolist(), sweeps, strict=True)
        ]
        return np.concatenate(parts), np.repeat(numbers, [len(part) for part in parts])


def refine_run(
    points: RunPoints,
    updates: Sequence[MapUpdate],
    *,
    trajectory: Trajectory | None = None,
    graph: SavedGraph | None = None,
    survey: Survey | None = None,
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
    graph : pose graph of the run. Its loop closures are used unless they contradict the others;
        what is neither that nor a motion, a user's own factors, stays in the graph.
    survey : fixes of the run, as its map has them
    factors : further ones, on the poses of the middles of the sweeps: ``gtsam.symbol("x", n)`` is
        that of frame ``points.frames[n]``
    min_aligned : matches that must fix a direction (``solver.min_aligned``); sweeps of which one
        is not fixed stay as the run had them
    on_round, on_window : see :func:`~loam_gtsam.refine.adjustment.refine`

    Raises
    ------
    InputError
        As :func:`~loam_gtsam.refine.adjustment.refine` does, or if updates are missing, or the
        trajectory has other stamps.
    """
    run = _Run.of(points, updates, trajectory, "trajectory")
    further, own = gtsam.NonlinearFactorGraph(), list[FactorTies]()
    if graph is not None:
        check_kind(graph, SavedGraph, "graph", "read_graph(path) and PoseGraph.saved() make one")
        frames = {key: run.frame[s] for key, s in graph.stamps.items() if s in run.frame}
        further.push_back(loop_factors(graph, frames, run.to_middle))
        own = own_ties(graph, frames, run.to_middle)
    ties = None if survey is None else _fix_ties(survey, [run])
    return _adjusted(
        [run], further, factors, ties, own, settings, min_aligned, on_round, on_window
    )[0]


def refine_runs(
    points: Sequence[RunPoints],
    updates: Sequence[Sequence[MapUpdate]],
    trajectories: Sequence[Trajectory],
    *,
    graph: SavedGraph | None = None,
    survey: Survey | None = None,
    starts: Sequence[int] = (0,),
    factors: gtsam.NonlinearFactorGraph | None = None,
    settings: Settings | None = None,
    min_aligned: float = SolverConfig().min_aligned,
    on_round: Callable[[Round], None] | None = None,
    on_window: Callable[[int, int], None] | None = None,
) -> tuple[RefinedRun, ...]:
    """Adjust the poses of several runs together, in one frame.

    Runs may overlap in time, or have clocks of their own. Nothing leads from one to another but
    the planes that both see, and loop closures. The first pose of the first run is held.

    Parameters
    ----------
    points, updates : of each run, as of :func:`refine_run`
    trajectories : of each, in one frame: ``MergedMaps.trajectory(number, updates)``
    graph : places of the runs, at the middles of sweeps, one run after the other, with the motions
        between them: ``MergedMaps.graph.held()``, of which is used what :func:`refine_run` uses
    survey : fixes on these places
    starts : number of the first place of each run: ``MergedMaps.starts``
    factors, settings, min_aligned, on_round, on_window : as of :func:`refine_run`; factors count
        the frames of one run after those of another

    Raises
    ------
    InputError
        As :func:`refine_run` does; if there are not as many of each; or if a run has nothing in
        common with the others.
    """
    counts = [len(points), len(updates), len(trajectories)]
    counts += [] if graph is None and survey is None else [len(starts)]
    if not points or len(set(counts)) > 1:
        raise InputError(
            "refine_runs: expected points, updates, a trajectory and a start for each run, got "
            f"{', '.join(map(str, counts))} of them"
        )
    given = zip(points, updates, trajectories, strict=True)
    runs = [_Run.of(*one, f"trajectories[{n}]") for n, one in enumerate(given)]
    further, own = gtsam.NonlinearFactorGraph(), list[FactorTies]()
    if graph is not None:
        places = {pose_number(key): stamp for key, stamp in graph.stamps.items()}
        found = _sweeps_of(places, runs, starts)
        frames = {key: found[pose_number(key)] for key in graph.stamps if pose_number(key) in found}
        to_middle = [step for run in runs for step in run.from_places()]
        further.push_back(loop_factors(graph, frames, to_middle))
        own = own_ties(graph, frames, to_middle)
    ties = None if survey is None else _fix_ties(survey, runs, starts)
    return _adjusted(runs, further, factors, ties, own, settings, min_aligned, on_round, on_window)


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """A run as it goes into the adjustment."""

    points: RunPoints
    updates: tuple[MapUpdate, ...]  # N frames that have a pose
    frame: Mapping[int, int]  # number of the frame by its stamp
    to_middle: Sequence[gtsam.Pose3]  # of its sweep, seen from the frame
    map_T_middle: FloatArray  # (N, 4, 4) where the adjustment begins
    odometry: FloatArray  # (N, 4, 4) the same as the run had it

    @staticmethod
    def of(
        points: RunPoints, updates: Sequence[MapUpdate], trajectory: Trajectory | None, name: str
    ) -> _Run:
        check_kind(points, RunPoints, "points", "run_points(dataset, updates, config) makes them")
        check_updates(updates)
        if (needed := 1 + max(points.frames, default=-1)) > len(updates):
            got = f"expected all of the run, {needed} or more, got {len(updates)}"
            raise InputError(f"updates: {got}")
        frames = tuple(updates[number] for number in points.frames)
        stamps = np.array([update.stamp for update in frames], np.int64)
        poses = stack_poses(update.map_T_lidar for update in frames)
        if trajectory is not None:
            check_kind(trajectory, Trajectory, name, "corrected poses are one")
            if not np.array_equal(trajectory.stamps, stamps):
                raise InputError(f"{name}: expected the stamps of the run's poses, got others")
            poses = trajectory.map_T_lidar
        steps = to_middles(frames, points.used)
        first = [pose @ step.matrix() for pose, step in zip(poses, steps, strict=True)]
        odometry = [
            u.map_T_lidar.compose(step).matrix() for u, step in zip(frames, steps, strict=True)
        ]
        number = {int(stamp): place for place, stamp in enumerate(stamps)}
        return _Run(points, frames, number, steps, np.array(first), np.array(odometry))

    @property
    def found(self) -> BoolArray:
        """(N,) which frames are in the map: their sweeps were found, or the map began with them."""
        return np.array([one.status.solved or one.status in _SEEN for one in self.updates])

    def from_places(self) -> list[gtsam.Pose3]:
        """Poses of the middles of the sweeps, seen from where the map of the run has its places."""
        return [
            (u.map_T_middle or u.map_T_lidar).between(u.map_T_lidar.compose(step))
            for u, step in zip(self.updates, self.to_middle, strict=True)
        ]


def _to_references(
    runs: Sequence[_Run], sweeps: Sequence[SweepPoints], before: Path
) -> ReferenceSteps:
    """The motion from the middles to the reference times, by the path and as the runs had it."""
    steps = [step.inverse() for run in runs for step in run.to_middle]
    variances = np.concatenate([step_variances(run.updates) for run in runs])
    return ReferenceSteps.told(before, sweeps, steps, variances)


def _starts(runs: Sequence[_Run]) -> list[int]:
    """Numbers of the first frames of the runs."""
    counted: list[int] = np.cumsum([0, *(len(run.updates) for run in runs[:-1])]).tolist()
    return counted


def _sweeps_of(
    places: Mapping[int, int], runs: Sequence[_Run], starts: Sequence[int]
) -> dict[int, int]:
    """Numbers of the sweeps by those of ``places``, which are stamps; without places of no run."""
    first, found = _starts(runs), {}
    for place, stamp in places.items():
        number = bisect_right(starts, place) - 1
        if stamp in runs[number].frame:
            found[place] = first[number] + runs[number].frame[stamp]
    return found


def _fix_ties(survey: Survey, runs: Sequence[_Run], starts: Sequence[int] = (0,)) -> FixTies | None:
    """The fixes, seen from the middles of the sweeps; None if none is on a frame of the runs."""
    to_middle = [step for run in runs for step in run.from_places()]
    sweeps = _sweeps_of(dict(enumerate(survey.stamps.tolist())), runs, starts)
    seen = survey.fixes.seen_from({p: (sweep, to_middle[sweep]) for p, sweep in sweeps.items()})
    return FixTies.of(seen, survey.reference, survey.up) if len(seen) else None


def _adjusted(
    runs: Sequence[_Run], further: gtsam.NonlinearFactorGraph,
    factors: gtsam.NonlinearFactorGraph | None, fixes: FixTies | None,
    ties: Sequence[FactorTies], settings: Settings | None, min_aligned: float,
    on_round: Callable[[Round], None] | None, on_window: Callable[[int, int], None] | None,
) -> tuple[RefinedRun, ...]:  # fmt: skip
    """Runs adjusted with their odometry, further factors, and a user's own."""
    if factors is not None:
        check_kind(factors, gtsam.NonlinearFactorGraph, "factors", "its push_back takes a factor")
        further.push_back(factors)
    starts = _starts(runs)
    every, told = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    keeps = [told_directions(run.updates, min_aligned) for run in runs]
    for start, run, keep in zip(starts, runs, keeps, strict=True):
        far = long_motion_factors(run.updates, run.odometry, start=start)
        for graph, chosen in ((every, None), (told, keep)):
            graph.push_back(odometry_factors(run.updates, run.odometry, chosen, start=start))
            graph.push_back(far)
    every.push_back(further)
    told.push_back(further)
    sweeps = [sweep for run in runs for sweep in run.points.used]
    middles = np.array([sweep.stamp for sweep in sweeps], np.int64)
    first = np.concatenate([run.map_T_middle for run in runs])
    paths = path_starts([run.found for run in runs])
    before = Path.through(middles, first, paths)
    # A sweep that the run did not see whole stays as the run had it, relative to its neighbours.
    wholes = [(keep == np.eye(6)).all(axis=(1, 2)) for keep in keeps]
    asked = np.concatenate([
        keep * whole[:, None, None] for keep, whole in zip(keeps, wholes, strict=True)
    ])  # fmt: skip
    found = refine(
        sweeps, before.map_T_middle, every, settings,
        keep=asked, for_covariances=told, fixes=fixes, ties=ties, starts=paths,
        steps=_to_references(runs, sweeps, before), on_round=on_round, on_window=on_window,
    )  # fmt: skip
    refined = []
    for start, run, whole in zip(starts, runs, wholes, strict=True):
        seen: BoolArray = whole & run.found
        refined.append(RefinedRun(run.points, before, found, run.updates, seen, start))
    return tuple(refined)
