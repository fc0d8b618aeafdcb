"""Keyframes of a run as a graph of poses, updated by iSAM2 as the run goes.

A loop closure that contradicts the others is switched off. Equations: docs/maths/pose_graph.md.
Frames and keys: :mod:`loam_gtsam.loops.keyframes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.config import Config, as_config
from loam_gtsam.geometry import transform
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.loops.batch import OptimizedGraph, SavedGraph, optimize_graph
from loam_gtsam.loops.incremental import IncrementalGraph
from loam_gtsam.loops.keyframes import (
    Forgotten,
    Keyframe,
    LoopClosure,
    Tie,
    Visits,
    check_covariance,
    keyframe_points,
    leads_to_keyframe,
    noise_model,
    numbered,
    odometry_between,
    surely_placed,
)
from loam_gtsam.loops.loop_selection import LoopSelection
from loam_gtsam.loops.own_factors import FactorGraph
from loam_gtsam.types import (
    Features,
    FloatArray,
    InputError,
    IntArray,
    MapUpdate,
    Trajectory,
    stack_poses,
)

_ANYWHERE = np.repeat([np.pi, 100.0], 3)  # rad and m: sigmas of the first pose of another run


class PoseGraph(FactorGraph):
    """Keyframes, factors on their poses, and the poses that fit the factors best.

    Parameters
    ----------
    config : ``pose_graph``; ``deskew`` and the voxels of ``map`` for the keyframes' features
    imu : source of the rotation within the sweeps; None for constant velocity

    Attributes
    ----------
    loops : all loop closures that were added
    """

    def __init__(self, config: Config | None = None, *, imu: ImuBuffer | None = None) -> None:
        self._whole = as_config(config)
        self.config = self._whole.pose_graph
        self.imu = imu
        self.reset()

    def reset(self) -> None:
        """Forget everything: the graph is then as a new one."""
        self.__setstate__((0, [], [], IncrementalGraph(), 0, Visits()))

    def __reduce__(self) -> tuple[Any, ...]:
        return _empty_graph, (self._whole, self.imu), self.__getstate__()

    # For checkpoints: of a graph that is there again, with its configuration.
    def __getstate__(self) -> tuple[Any, ...]:
        return self._session, self.keyframes, self.loops, self._graph, self._added, self.visits

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._session: int
        self.loops: list[LoopClosure]
        self.visits: Visits
        self._session, self.keyframes, self.loops, self._graph, self._added, self.visits = state
        self._selection = LoopSelection(self.config, self._graph, self.keyframes, self.loops)

    def __repr__(self) -> str:
        return f"PoseGraph({len(self)} keyframes, {sum(self.active)} of {len(self.loops)} loops)"

    def __len__(self) -> int:
        return len(self.keyframes)

    def add(self, update: MapUpdate, features: Features | None = None) -> Keyframe | None:
        """Add a frame of the run, if it was solved, not in doubt, and far from the last keyframe.

        Without the ``features`` of its sweep no loop closure can be found. Returns the keyframe, or
        None if the frame does not become one.

        Raises
        ------
        InputError
            If the frame is not later than the last keyframe.
        """
        if surely_placed(update) is None:
            return None
        last = self.keyframes[-1] if self.keyframes else None
        motion = gtsam.Pose3()
        if last is not None and last.session == self._session:
            if update.stamp <= last.stamp:
                raise InputError(
                    f"PoseGraph.add: expected a stamp after {last.stamp}, that of the last "
                    f"keyframe, got {update.stamp}; add the frames of a run in their order"
                )
            motion = last.odom_T_lidar.between(update.map_T_lidar)
            if not leads_to_keyframe(motion, self.config):
                return None
        travelled = float(np.linalg.norm(motion.translation()))
        travelled += 0.0 if last is None else last.travelled
        points = keyframe_points(update, features, self._whole, self.imu)
        keyframe = Keyframe(self._added, update, travelled, *points, self._session)
        self._append(keyframe, last)
        self._added += 1
        return keyframe

    def visit(self) -> int | None:
        """Say that the newest keyframe has its loop closures; it is forgotten if its place is full.

        If ``pose_graph.visits`` keyframes have come back to a place, the one after it hangs on that
        with which it closed a loop. Returns the number of the first one there if so, else None.
        """
        place, most = _place(self), self.config.visits
        is_full = place is not None and self.visits.add(self.keyframes[-1].index, place, most)
        return place if is_full else None

    @property
    def forgotten(self) -> Sequence[Forgotten]:
        """Where the keyframes were that were forgotten, in their order."""
        return self.visits.journal.all

    def keyframe(self, index: int) -> Keyframe:
        """The keyframe of a number, which is its place in ``keyframes`` until one is forgotten."""
        return numbered(self.keyframes, index)

    def new_session(self) -> None:
        """Begin another run: nothing but loop closures ties its keyframes to those before."""
        if self.keyframes and self.keyframes[-1].session == self._session:
            self._session += 1

    def add_loop(self, loop: LoopClosure) -> bool:
        """Add a loop closure, which :mod:`.loop_selection` may switch off; whether it is active.

        Raises
        ------
        InputError
            If a keyframe is unknown, the two are neighbours or swapped, or the covariance is not
            positive definite.
        """
        for index in (loop.earlier, loop.later):
            self._key(index)
        if loop.later - loop.earlier < 2:
            raise InputError(
                f"loop: expected keyframes in their order that are no neighbours, got "
                f"{loop.earlier} and {loop.later}; if they are swapped, invert the motion"
            )
        check_covariance(loop.covariance)
        return self._selection.add(loop)

    def poses(self) -> FloatArray:
        """(N, 4, 4) ``map_T_lidar`` of all keyframes."""
        return stack_poses(self.pose(keyframe.index) for keyframe in self.keyframes)

    @property
    def correction(self) -> gtsam.Pose3:
        """``map_T_odom``: what leads from the mapper's drifting frame to the map now."""
        if not self.keyframes:
            return gtsam.Pose3()
        last = self.keyframes[-1]
        return self.pose(last.index).compose(last.odom_T_lidar.inverse())

    @property
    def active(self) -> tuple[bool, ...]:
        """Which of ``loops`` are active."""
        return self._graph.active

    def chi_squared(self, number: int) -> float:
        """Squared Mahalanobis distance of a loop closure from what all other factors say."""
        return self._selection.chi_squared(number)

    def trajectory(self, updates: Sequence[MapUpdate], session: int = 0) -> Trajectory:
        """The frames of a run, corrected by the keyframes before and after each.

        A frame keeps its motion from either keyframe. Where the two disagree, they count by the
        drift between them and the frame as the run reported it; by time if it reported none.

        Parameters
        ----------
        updates : frames of the run that the keyframes are of; those with a bad stamp are left out
        session : number of the run, see :meth:`new_session`
        """
        return corrected_trajectory(updates, _corrections(self, session))

    def map_points(self) -> tuple[FloatArray, FloatArray]:
        """Edge and plane features of all keyframes in the map, (E, 3) and (P, 3) metres."""
        edges, planes = [np.empty((0, 3))], [np.empty((0, 3))]
        for keyframe, pose in zip(self.keyframes, self.poses(), strict=True):
            edges.append(transform(pose, keyframe.edges))
            planes.append(transform(pose, keyframe.planes))
        return np.concatenate(edges), np.concatenate(planes)

    def saved(self) -> SavedGraph:
        """The graph as it is written to files: all loop closures, inactive ones too, no kernels.

        Motions of a user's own are loop closures there: they can be wrong, which odometry is not.
        """
        graph = gtsam.NonlinearFactorGraph(self._graph.factors)
        motion = gtsam.BetweenFactorPose3
        loops = [place for place in self.own if isinstance(graph.at(place), motion)]
        for loop in self.loops:
            loops.append(graph.size())
            graph.add(loop.factor())
        stamps = {keyframe.key: keyframe.stamp for keyframe in self.keyframes}
        return SavedGraph(graph, self.values, stamps, loops)

    def active_factors(self) -> gtsam.NonlinearFactorGraph:
        """All factors that are in the graph now, those of inactive loop closures left out."""
        graph = gtsam.NonlinearFactorGraph(self._graph.factors)
        for loop, active in zip(self.loops, self.active, strict=True):
            if active:
                graph.add(loop.factor(self.config.kernel_width))
        return graph

    def tie(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Add factors that are believed, and go on from a solution with them.

        ``values`` are estimates of all variables, those that ``factors`` add included. Unlike
        :meth:`add_factor` it takes a thousand factors at once, and checks none.
        """
        kept = gtsam.NonlinearFactorGraph(self._graph.factors)
        kept.push_back(factors)
        self._graph.restart(values, np.array(self.active, np.bool_), kept)

    def optimize(self) -> OptimizedGraph:
        """Solve the whole graph at once, loop closures tested from scratch, and go on from there.

        Raises
        ------
        InputError
            If there are no keyframes. The graph is then as it was before.
        """
        first = self._graph.factors.size()
        loops = range(first, first + len(self.loops))  # motions of a user's own are believed
        saved = replace(self.saved(), closures=loops)
        result = optimize_graph(saved, max_chi2=self.config.max_chi2)
        active = np.array([report.active for report in result.loops], np.bool_)
        self._graph.restart(result.poses, active)
        return result

    def _append(self, keyframe: Keyframe, last: Keyframe | None) -> None:
        """Add a keyframe's pose, tied to the last one of its session."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        tie: Tie | None = None
        if last is None or last.session != keyframe.session:
            pose = keyframe.odom_T_lidar
            covariance = keyframe.update.covariance if last is None else np.diag(_ANYWHERE**2)
            factors.add(gtsam.PriorFactorPose3(keyframe.key, pose, noise_model(covariance)))
        else:
            tie = self._tie(last, keyframe)
            pose = self.pose(tie.base).compose(tie.base_T_lidar)
            factors.add(tie.factor(keyframe.key))
        values.insert(keyframe.key, pose)
        self._graph.add(factors, values, settle=False)
        self.keyframes.append(keyframe)
        self.visits.surplus = None
        self.visits.last = None if tie is None else (tie, self._graph.factors.size())

    def _tie(self, last: Keyframe, new: Keyframe) -> Tie:
        """What leads to a new keyframe: odometry from the last one, which may be forgotten now."""
        motion, covariance = odometry_between(last, new, self.config)
        way = new.travelled - last.travelled
        ended = [loop for loop in self.loops if loop.later == last.index]
        if (
            last.index != self.visits.surplus
            or self.visits.last is None
            or self._graph.factors.size() != self.visits.last[1]  # it has a factor of a user's own
            or not all(self.active[len(self.loops) - len(ended) :])  # it may be right some day
        ):
            return Tie(last.index, motion, covariance, way)
        tie = self.visits.last[0]
        base, gone = (ended[-1].earlier, 0.0) if ended else (tie.base, tie.way)
        tie = Tie(base, *self.relative(base, last.index), gone)
        self.visits.forget(last, tie)
        self.keyframes.pop()
        self._selection.forget(len(ended))
        self._graph.forget(len(ended))
        to_new = motion.inverse().AdjointMap()
        covariance = covariance + to_new @ tie.covariance @ to_new.T
        tie = Tie(tie.base, tie.base_T_lidar.compose(motion), covariance, tie.way + way)
        self.visits.ties[new.index] = tie.base, tie.way
        return tie


def _empty_graph(config: Config, imu: ImuBuffer | None) -> PoseGraph:
    return PoseGraph(config, imu=imu)


def _corrections(graph: PoseGraph, session: int) -> list[tuple[int, gtsam.Pose3]]:
    """Stamps of the keyframes of a run, forgotten ones too, and ``map_T_odom`` at each."""
    known = [
        (k.stamp, graph.pose(k.index).compose(k.odom_T_lidar.inverse()))
        for k in graph.keyframes
        if k.session == session
    ]
    known += [
        (f.stamp, graph.pose(f.base).compose(f.base_T_lidar).compose(f.odom_T_lidar.inverse()))
        for f in graph.forgotten
        if f.session == session
    ]
    return sorted(known, key=lambda one: one[0])


def corrected_trajectory(
    updates: Sequence[MapUpdate], known: Sequence[tuple[int, gtsam.Pose3]]
) -> Trajectory:
    """The frames of a run where ``known`` has them: stamps in order, and ``map_T_odom`` at each.

    The corrections of two keyframes differ by the error of the motion between them. A frame there
    has its share in that, by the drift that is told: after a gap, nearly all of it.
    """
    good = [update for update in updates if update.status.has_pose]
    stamps = np.array([update.stamp for update in good], np.int64)
    starts = np.array([start for start, _ in known], np.int64)
    nexts = np.searchsorted(starts, stamps, side="right").tolist()
    drifts, at_starts = _drifts(good, stamps, starts)
    poses = []
    for number, (update, after) in enumerate(zip(good, nexts, strict=True)):
        found = [
            map_T_odom.compose(update.map_T_lidar)
            for _, map_T_odom in known[max(after - 1, 0) : after + 1]
        ]
        pose = found[0] if found else update.map_T_lidar
        if len(found) == 2:
            before, until, now = at_starts[after - 1], at_starts[after], drifts[number]
            if until <= before:  # none is told
                before, until, now = starts[after - 1], starts[after], update.stamp
            pose = pose.slerp(float((now - before) / (until - before)), found[1])
        poses.append(pose)
    return Trajectory.from_poses(stamps, poses)


def _drifts(
    updates: Sequence[MapUpdate], stamps: IntArray, others: IntArray
) -> tuple[FloatArray, FloatArray]:
    """The size of the drift at the stamps of frames and at other ones, zero where none is told."""
    known = [one.uncertainty for one in updates]
    told = [(n, float(np.trace(one.drift))) for n, one in enumerate(known) if one is not None]
    if not told:
        return np.zeros(len(stamps)), np.zeros(len(others))
    numbers, sizes = zip(*told, strict=True)
    at = stamps[list(numbers)]
    return np.interp(stamps, at, sizes), np.interp(others, at, sizes)


def _place(graph: PoseGraph) -> int | None:
    """The first keyframe of the place at which the newest one surely is; None if it is new."""
    if not graph.keyframes:
        return None
    newest, config = graph.keyframes[-1], graph.config
    pose = graph.pose(newest.index)
    near = [
        (graph.pose(other.index).range(pose), other.index)
        for other in graph.keyframes[:-1]
        if graph.visits.is_place(other.index)
    ]
    for away, index in sorted(near):
        if away >= config.keyframe_distance:
            break
        if leads_to_keyframe(graph.pose(index).between(pose), config):
            continue
        covariance = graph.relative(index, newest.index)[1]
        turned, moved = (
            3.0 * np.sqrt(np.linalg.eigvalsh(part)[-1])
            for part in (covariance[:3, :3], covariance[3:, 3:])
        )
        sure = moved < config.keyframe_distance
        return index if sure and turned < np.radians(config.keyframe_angle_deg) else None
    return None
