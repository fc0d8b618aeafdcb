"""Loop closers: they find earlier keyframes at the same place, and the motion in between.

That of this package looks for keyframes that are near enough, given the drift, and look alike, and
registers the new one with the mapper's solver against the features around the old one.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import astuple, dataclass, field
from enum import StrEnum
from typing import Any, Protocol

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.config import Config, MatchingConfig, as_config
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.geometry import transform
from loam_gtsam.loops.keyframes import Keyframe, LoopClosure
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.loops.scan_context import compare_descriptors, heading_free_key, scan_context
from loam_gtsam.registration.association import associate
from loam_gtsam.registration.degeneracy import localizability
from loam_gtsam.registration.matches import ScanMatches, trial_matching
from loam_gtsam.registration.relocalization import Field, Fit, likely_poses, sample_features
from loam_gtsam.registration.relocalization.fits import standing_fit
from loam_gtsam.registration.solvers import GtsamSolver, Solution, trial_solver
from loam_gtsam.registration.solvers.scan_error import scan_error
from loam_gtsam.registration.solvers.seen_ground import SeenGround
from loam_gtsam.types import BoolArray, FloatArray, IntArray

_ALIKE = 10  # number of keyframes with the most similar heading-free keys that are compared in full
_STARTS = 3  # number of poses from the search around a candidate at which a trial starts
_LEVEL = gtsam.Pose3()  # a lidar that stands upright in the frame of a place, which is level


class LoopCloser(Protocol):
    """An object that finds loop closures.

    A loop closer that remembers keyframes should have a method ``reset()``, too.
    """

    def detect(self, keyframe: Keyframe, history: PoseGraph) -> LoopClosure | None:
        """Look for an earlier keyframe at the place of a new one; called once for each, in order.

        It is the newest of ``history``, the graph of all so far, which must not be changed. Returns
        a loop closure whose ``later`` is the number of the keyframe; None if there is none.
        """
        ...


class NoLoops(LoopCloser):
    """Finds none: for a pose graph that something else ties."""

    def detect(self, keyframe: Keyframe, history: PoseGraph) -> LoopClosure | None:
        """See :meth:`LoopCloser.detect`."""
        return None


class Rejection(StrEnum):
    """The reason why a keyframe or a candidate gave no loop closure."""

    NO_FEATURES = "no_features"  # the keyframe has none
    TOO_RECENT = "too_recent"  # no keyframe is far enough back, in metres travelled
    OUT_OF_REACH = "out_of_reach"  # even if the poses are as wrong as they may be
    UNLIKE = "unlike"  # the descriptor of the candidate is too different
    FEW_MATCHES = "few_matches"  # too few to solve for the motion
    LITTLE_OVERLAP = "little_overlap"  # too few of the features are matched
    DISAGREES = "disagrees"  # too many of the matches are left far apart
    DEGENERATE = "degenerate"  # a direction is left free, as along a corridor


@dataclass(slots=True)
class LoopStatistics:
    """Counts of what a loop closer did since its beginning or last reset.

    Attributes
    ----------
    keyframes, verified : for which loop closures were looked for, and found
    candidates : earlier keyframes that were registered, or rejected by their descriptor
    rejected : keyframes and candidates, by the reason
    """

    keyframes: int = 0
    candidates: int = 0
    verified: int = 0
    rejected: Counter[Rejection] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True, eq=False)
class Verified:
    """A registration that is believed.

    Attributes
    ----------
    pose : of the features in the frame of the map they were registered with
    covariance : (6, 6) of the scan's own error in it
    fit : of the features off level ground
    """

    pose: gtsam.Pose3
    covariance: FloatArray
    fit: Fit


class Verifier:
    """Registers the features of one place with those of another, and judges what comes of it.

    Parameters
    ----------
    config : ``loops``; ``map``, ``matching``, ``solver`` and ``covariance`` for the registration
    """

    def __init__(self, config: Config) -> None:
        self._whole, self.config = config, config.loops
        self._solver = GtsamSolver(config.solver)
        self._rough_solver = trial_solver(config.solver)

    def verify(
        self,
        edges: FloatArray,
        planes: FloatArray,
        maps: tuple[CubeMap, CubeMap],
        known: gtsam.Pose3,
        *,
        turn: float = 0.0,
        usual: float = 1.0,
        distinct: BoolArray | None = None,
    ) -> Verified | Rejection:
        """Register features (E, 3) and (P, 3) in the edge and the plane map of a place.

        Parameters
        ----------
        known : pose of the features in the frame of the place, as far as known
        turn : rad about z by which they are turned against it, to be tried if that does not fit
        usual : share of such features that has a match where they belong
        distinct : (E,) see :func:`~loam_gtsam.registration.association.associate`
        """
        matching = self._whole.matching

        def matches_at(pose: gtsam.Pose3) -> ScanMatches:
            return associate(edges, planes, pose, *maps, matching, distinct)

        def fit(found: Solution) -> Fit:
            offered = _offered(len(edges), len(planes), matching)
            return standing_fit(found.matches, offered, _LEVEL) if found.solved else Fit(0.0, 0.0)

        solution = self._solver.solve(matches_at, known)
        if self._judged(fit(solution), usual) is not None:
            matching = trial_matching(self._whole.matching)
            # The ground is where it was: height zero, and the tilt that the graph says.
            matrix = known.rotation().matrix()
            missing = turn - float(np.arctan2(matrix[1, 0], matrix[0, 0]))
            turned = gtsam.Rot3.Yaw(missing).compose(known.rotation())
            start = gtsam.Pose3(turned, np.zeros(3))
            held = np.concatenate([cubes.points() for cubes in maps])
            sample = sample_features(edges, planes)
            field = Field.around(held, start, self.config.search)
            around = likely_poses(sample, [field], [start], _STARTS)
            trials = [self._rough_solver.solve(matches_at, pose) for pose in (start, *around)]
            best = max(trials, key=lambda tried: fit(tried).total)
            matching = self._whole.matching
            solution = self._solver.solve(matches_at, best.map_T_lidar)
        if not solution.solved:
            return Rejection.FEW_MATCHES
        final = fit(solution)
        if (rejection := self._judged(final, usual)) is not None:
            return rejection
        covariance = self._covariance(solution)
        if covariance is None:
            return Rejection.DEGENERATE
        return Verified(solution.map_T_lidar, covariance, final)

    def share(self, edges: FloatArray, planes: FloatArray, maps: tuple[CubeMap, CubeMap]) -> float:
        """Share of features off level ground that have a match in the maps as they are."""
        matches = associate(edges, planes, gtsam.Pose3(), *maps, self._whole.matching)
        offered = _offered(len(edges), len(planes), self._whole.matching)
        return standing_fit(matches, offered, _LEVEL).share

    def _judged(self, fit: Fit, usual: float) -> Rejection | None:
        """The reason to reject a registration; None if it is believed."""
        if fit.share < self.config.min_share * usual:
            return Rejection.LITTLE_OVERLAP
        return Rejection.DISAGREES if fit.agreement < self.config.min_agreement else None

    def _covariance(self, solution: Solution) -> FloatArray | None:
        """(6, 6) of the scan's own error; None if the registration leaves a direction free."""
        seen = localizability(solution.matches, solution.map_T_lidar)
        if seen.aligned[0] < self.config.min_aligned:
            return None
        config, solver = self._whole.covariance, self._whole.solver
        width, kernel = solver.kernel_width, solver.kernel
        error = scan_error(solution, width, SeenGround(), config, kernel=kernel)
        return None if error is None else error.covariance


class ScanLoopCloser:
    """Finds loop closures of one pose graph by position, descriptor and registration.

    Parameters
    ----------
    config : ``loops``; ``map``, ``matching``, ``solver`` and ``covariance`` for the registration
    """

    def __init__(self, config: Config | None = None) -> None:
        self._whole = as_config(config)
        self.config = self._whole.loops
        self._verifier = Verifier(self._whole)
        self.reset()

    def reset(self) -> None:
        """Forget all keyframes and what was counted."""
        self.statistics = LoopStatistics()
        self._descriptors: dict[int, FloatArray] = {}  # by the numbers of the keyframes
        self._spreads: dict[int, float] = {}

    def __getstate__(self) -> tuple[Any, ...]:
        return self._whole, self.statistics, self._descriptors, self._spreads

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.__init__(state[0])  # type: ignore[misc]
        self.statistics, self._descriptors, self._spreads = state[1:]

    def detect(self, keyframe: Keyframe, history: PoseGraph) -> LoopClosure | None:
        """See :meth:`LoopCloser.detect`."""
        self._describe(history)
        self.statistics.keyframes += 1
        near = self._near(keyframe, history)
        if isinstance(near, Rejection):
            self.statistics.rejected[near] += 1
            return None
        for candidate, turn in self._alike(keyframe.index, near):
            found = self.verify(keyframe, candidate, history, turn)
            if isinstance(found, LoopClosure):
                self.statistics.verified += 1
                return found
            self.statistics.rejected[found] += 1
        return None

    def verify(
        self, keyframe: Keyframe, candidate: int, history: PoseGraph, turn: float = 0.0
    ) -> LoopClosure | Rejection:
        """Register a keyframe against the features of the keyframes around a candidate.

        ``turn`` is the rad about z by which the lidar is turned against the candidate, as far as
        known. Returns the loop closure, or the reason why the registration is not believed.
        """
        found = self._verifier.verify(
            keyframe.edges,
            keyframe.planes,
            self._submap(keyframe, candidate, history),
            history.pose(candidate).between(history.pose(keyframe.index)),
            turn=turn,
            usual=_usual_share(keyframe, self._whole.matching),
            distinct=keyframe.distinct,
        )
        if isinstance(found, Rejection):
            return found
        covariance = found.covariance
        # The own error of the candidate displaces the submap, that of the new keyframe comes from
        # de-skewing its features.
        earlier, to_later = history.keyframe(candidate), found.pose.inverse().AdjointMap()
        for one, moved in ((earlier, to_later), (keyframe, np.eye(6))):
            if one.update.uncertainty is not None:
                covariance = covariance + moved @ one.update.uncertainty.own @ moved.T
        return LoopClosure(candidate, keyframe.index, found.pose, covariance, *astuple(found.fit))

    def _describe(self, history: PoseGraph) -> None:
        """Compute descriptor and standard deviation of the position of new keyframes."""
        for keyframe in history.keyframes:
            if keyframe.index in self._spreads:
                continue
            points = np.concatenate([keyframe.edges, keyframe.planes])
            self._descriptors[keyframe.index] = scan_context(points, self.config)
            # Later loop closures make a pose surer: the standard deviation now is an upper bound.
            spread = np.linalg.eigvalsh(history.covariance(keyframe.index)[3:, 3:])[-1]
            self._spreads[keyframe.index] = float(np.sqrt(max(spread, 0.0)))
        known = {keyframe.index for keyframe in history.keyframes}
        for index in [index for index in self._spreads if index not in known]:
            del self._spreads[index], self._descriptors[index]

    def _near(self, keyframe: Keyframe, history: PoseGraph) -> IntArray | Rejection:
        """Numbers of the keyframes that may be at the same place."""
        config = self.config
        if len(keyframe.edges) + len(keyframe.planes) == 0:
            return Rejection.NO_FEATURES
        old = [  # neighbours are no loop, and one keyframe of a place is enough
            other
            for other in history.keyframes
            if other.index < keyframe.index - 1 and history.visits.is_place(other.index)
            if keyframe.travelled - other.travelled >= config.min_way
        ]
        if not old:
            return Rejection.TOO_RECENT
        spreads = np.array([self._spreads[other.index] for other in old])
        gate = config.gate + config.gate_sigmas * (spreads + self._spreads[keyframe.index])
        gate += config.gate_drift * _odometry_distance(keyframe, old, history)
        positions = np.array([history.pose(other.index).translation() for other in old])
        here = history.pose(keyframe.index).translation()
        away = np.linalg.norm(positions - here, axis=1)
        near: IntArray = np.array([other.index for other in old], np.int64)[away <= gate]
        return near if len(near) else Rejection.OUT_OF_REACH

    def _alike(self, index: int, near: IntArray) -> list[tuple[int, float]]:
        """The candidates that look most alike, and how the lidar is turned against each."""
        descriptor = self._descriptors[index]
        tree = cKDTree([heading_free_key(self._descriptors[other]) for other in near.tolist()])
        _, found = tree.query(heading_free_key(descriptor), k=min(_ALIKE, len(near)))
        compared = [
            (*compare_descriptors(self._descriptors[other], descriptor), other)
            for other in near[np.sort(np.atleast_1d(found))].tolist()
        ]
        chosen: list[tuple[int, float]] = []
        for distance, turn, other in sorted(compared):
            # Neighbours share a submap, so one of them is enough.
            apart = all(abs(other - taken) > self.config.neighbours for taken, _ in chosen)
            if not apart or len(chosen) == self.config.tries:
                continue
            self.statistics.candidates += 1
            if distance > self.config.max_unlike:
                self.statistics.rejected[Rejection.UNLIKE] += 1
                break
            chosen.append((other, turn))
        return chosen

    def _submap(
        self, keyframe: Keyframe, candidate: int, history: PoseGraph
    ) -> tuple[CubeMap, CubeMap]:
        """Edge and plane map of the keyframes around the candidate, in its frame."""
        maps = empty_submap(self._whole)
        beside = self.config.neighbours
        middle = history.keyframes.index(history.keyframe(candidate))
        around = history.keyframes[max(middle - beside, 0) : middle + beside + 1]
        # The candidate's own features come first: a voxel keeps the first point it gets.
        chosen = [
            other
            for other in sorted(around, key=lambda other: abs(other.index - candidate))
            if keyframe.travelled - other.travelled >= self.config.min_way
            or other.index == candidate
        ]
        here = history.pose(candidate)
        poses = [here.between(history.pose(other.index)).matrix() for other in chosen]
        for cubes, kind in zip(maps, ("edges", "planes"), strict=True):
            parts = list(map(transform, poses, (getattr(other, kind) for other in chosen)))
            origins = [np.tile(p[:3, 3], (len(q), 1)) for p, q in zip(poses, parts, strict=True)]
            cubes.insert(np.concatenate(parts), np.concatenate(origins))
        return maps


def empty_submap(config: Config) -> tuple[CubeMap, CubeMap]:
    """Edge and plane map for what is around a place; the first point of a voxel stays."""
    settled = config.map.changed(archive_dir=None, insertion="settled")
    return CubeMap(settled, settled.edge_voxel), CubeMap(settled, settled.plane_voxel)


def _offered(n_edges: int, n_planes: int, config: MatchingConfig) -> int:
    """How many of so many features are matched at most."""
    return min(n_edges, config.max_edges or n_edges) + min(n_planes, config.max_planes or n_planes)


def _usual_share(keyframe: Keyframe, config: MatchingConfig) -> float:
    """Share of the features that had a match when the mapper registered the keyframe; 1 if unknown.

    How many features find a match is up to the sensor, the place and the tests of the matching; how
    many fewer do in another map of the same place is not.
    """
    update = keyframe.update
    offered = _offered(update.n_edges, update.n_planes, config)
    matched = update.n_edge_matches + update.n_plane_matches
    return min(matched / offered, 1.0) if offered and matched else 1.0


def _odometry_distance(
    keyframe: Keyframe, others: list[Keyframe], history: PoseGraph
) -> FloatArray:
    """(N,) metres of odometry to each of the others: straight back, or by way of one active loop.

    What ties a keyframe to another one in place of a forgotten one is such a loop, too.
    """
    at = {known.index: known.travelled for known in history.keyframes}
    active = zip(history.loops, history.active, strict=True)
    links = [(loop.earlier, loop.later, 0.0) for loop, on in active if on]
    links += [(base, index, way) for index, (base, way) in history.visits.ties.items()]
    to = np.array([other.travelled for other in others])
    gone = keyframe.travelled - to
    for earlier, later, way in links:
        since = keyframe.travelled - at[later] + way
        gone = np.minimum(gone, since + np.abs(to - at[earlier]))
    return gone
