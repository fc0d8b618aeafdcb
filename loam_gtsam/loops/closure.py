"""Finding loops: where the sensor may have been before, and whether what it sees there fits.

A loop closer is anything with :meth:`LoopCloser.detect`. The one of this package looks for
keyframes that are near enough for what is known of the drift and that look alike, and registers the
new keyframe against the features of those around the old one, with the factor graph of the mapper.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import astuple, dataclass, field
from enum import StrEnum
from typing import Any, Protocol

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.config import Config
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.geometry import transform
from loam_gtsam.loops.keyframes import Keyframe, LoopClosure
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.loops.scan_context import describe, heading_free, unlike
from loam_gtsam.registration.association import associate, trial_matching
from loam_gtsam.registration.degeneracy import localizability
from loam_gtsam.registration.matches import ScanMatches, subset
from loam_gtsam.registration.relocalization import Fit, likely_poses, sample_features
from loam_gtsam.registration.scan_error import SeenGround, scan_error
from loam_gtsam.registration.solvers import GtsamSolver, Solution
from loam_gtsam.types import FloatArray, IntArray

_ALIKE = 10
"""Keyframes with the most similar heading-free descriptors that are compared in full."""
_NEAR = (0.03, 0.2)
"""Metres and degrees: a step of a trial that is smaller ends it."""
_STARTS = 3
"""Poses from the search around a candidate from which a few matches are tried."""

_LEVEL = 0.7
"""Cosine between a normal and up from which a plane is level: slopes are no landmarks."""


class LoopCloser(Protocol):
    """Finds loops."""

    def detect(self, keyframe: Keyframe, history: PoseGraph) -> LoopClosure | None:
        """Look whether a new keyframe was seen before.

        Parameters
        ----------
        keyframe : the newest of ``history``; to be called once for each, in order
        history : all keyframes so far, to look at and not to change

        Returns
        -------
        A loop with ``later`` being the keyframe; None if there is none.
        """
        ...


class Rejection(StrEnum):
    """Why there is no loop."""

    NO_FEATURES = "no_features"
    """The keyframe has no features to be looked for with."""
    TOO_RECENT = "too_recent"
    """No keyframe is far enough back on the way."""
    OUT_OF_REACH = "out_of_reach"
    """All of those are too far away, however uncertain the poses are."""
    UNLIKE = "unlike"
    """The candidate looks different."""
    FEW_MATCHES = "few_matches"
    """Verification: too few matches to solve for the motion."""
    LITTLE_OVERLAP = "little_overlap"
    """Verification: too few of the features find a match."""
    DISAGREES = "disagrees"
    """Verification: the matches do not lie where they should."""
    DEGENERATE = "degenerate"
    """Verification: the features do not fix the motion in some direction, as along a corridor."""


@dataclass(slots=True)
class LoopStatistics:
    """What became of the keyframes and candidates.

    Attributes
    ----------
    keyframes : that were looked at
    candidates : keyframes that were verified, or compared and rejected
    verified : loops that were returned
    rejected : how many keyframes or candidates for which reason
    """

    keyframes: int = 0
    candidates: int = 0
    verified: int = 0
    rejected: Counter[Rejection] = field(default_factory=Counter)


class ScanLoopCloser:
    """Finds loops of one pose graph by position, descriptor and registration.

    Parameters
    ----------
    config : ``loops``; ``map``, ``matching``, ``solver`` and ``covariance`` for the registration

    Attributes
    ----------
    statistics : of this closer so far
    """

    def __init__(self, config: Config | None = None) -> None:
        self._whole = config or Config()
        self.config = self._whole.loops
        self._solver = GtsamSolver(self._whole.solver)
        # Of a trial it is enough to be near; what follows it goes the rest of the way.
        self._rough_solver = GtsamSolver(
            self._whole.solver.changed(
                translation_tolerance=_NEAR[0],
                rotation_tolerance_deg=_NEAR[1],
            )
        )
        self.reset()

    def reset(self) -> None:
        """Forget all keyframes and what was counted."""
        self.statistics = LoopStatistics()
        self._descriptors: list[FloatArray] = []
        self._spreads: list[float] = []

    def __getstate__(self) -> tuple[Any, ...]:
        return self._whole, self.statistics, self._descriptors, self._spreads

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.__init__(state[0])  # type: ignore[misc]
        self.statistics, self._descriptors, self._spreads = state[1:]

    def detect(self, keyframe: Keyframe, history: PoseGraph) -> LoopClosure | None:
        """See :meth:`LoopCloser.detect`."""
        self._describe(history)
        self.statistics.keyframes += 1
        if len(keyframe.edges) + len(keyframe.planes) == 0:
            self._reject(Rejection.NO_FEATURES)
            return None
        near = self._near(keyframe, history)
        if isinstance(near, Rejection):
            self._reject(near)
            return None
        for candidate, turn in self._alike(keyframe.index, near):
            found = self.verify(keyframe, candidate, history, turn)
            if isinstance(found, LoopClosure):
                self.statistics.verified += 1
                return found
            self._reject(found)
        return None

    def verify(
        self, keyframe: Keyframe, candidate: int, history: PoseGraph, turn: float = 0.0
    ) -> LoopClosure | Rejection:
        """Register a keyframe against the features of the keyframes around another one.

        Parameters
        ----------
        candidate : number of the other one
        turn : rad about z that the lidar is thought to be turned against the candidate's
        """
        whole, config = self._whole, self.config
        maps = self._submap(keyframe, candidate, history)
        features = keyframe.edges, keyframe.planes
        matching = whole.matching

        def matches_at(pose: gtsam.Pose3) -> ScanMatches:
            return associate(*features, pose, *maps, matching, keyframe.distinct)

        def fit(found: Solution) -> Fit:
            most = matching.max_edges or np.inf, matching.max_planes or np.inf
            offered = min(len(features[0]), most[0]) + min(len(features[1]), most[1])
            return standing_fit(found.matches, int(offered)) if found.solved else Fit(0.0, 0.0)

        known = history.pose(candidate).between(history.pose(keyframe.index))
        solution = self._solver.solve(matches_at, known)
        if self._judged(fit(solution)) is not None:
            matching = trial_matching(whole.matching)
            # The ground is where it was: height zero, and the tilt that the graph says.
            rotation = known.rotation()
            heading = gtsam.Rot3.Yaw(turn - _heading(rotation)).compose(rotation)
            start = gtsam.Pose3(heading, np.zeros(3))
            held = np.concatenate([cubes.points() for cubes in maps])
            around = likely_poses(sample_features(*features), held, [start], config.search, _STARTS)
            starts = start, *around
            trials = [self._rough_solver.solve(matches_at, pose) for pose in starts]
            best = max(trials, key=lambda tried: fit(tried).total)
            matching = whole.matching
            solution = self._solver.solve(matches_at, best.map_T_lidar)
        if not solution.solved:
            return Rejection.FEW_MATCHES
        final = fit(solution)
        rejection = self._judged(final)
        if rejection is not None:
            return rejection
        covariance = self._covariance(solution, history.keyframes[candidate], keyframe)
        if covariance is None:
            return Rejection.DEGENERATE
        pose = solution.map_T_lidar
        return LoopClosure(candidate, keyframe.index, pose, covariance, *astuple(final))

    # -- inside --------------------------------------------------------------------------------

    def _describe(self, history: PoseGraph) -> None:
        """Descriptor and standard deviation of the position of keyframes that have none yet."""
        for keyframe in history.keyframes[len(self._descriptors) :]:
            points = np.concatenate([keyframe.edges, keyframe.planes])
            self._descriptors.append(describe(points, self.config))
            # Loops make poses surer, so what is kept of an old one is no underestimate.
            spread = np.linalg.eigvalsh(history.covariance(keyframe.index)[3:, 3:])[-1]
            self._spreads.append(float(np.sqrt(max(spread, 0.0))))

    def _reject(self, reason: Rejection) -> None:
        self.statistics.rejected[reason] += 1

    def _near(self, keyframe: Keyframe, history: PoseGraph) -> IntArray | Rejection:
        """Keyframes that may be at the same place."""
        config = self.config
        travelled = keyframe.travelled - np.array([other.travelled for other in history.keyframes])
        old = np.flatnonzero(travelled >= config.min_way)
        if len(old) == 0:
            return Rejection.TOO_RECENT
        spreads = np.array(self._spreads)[old] + self._spreads[keyframe.index]
        gate = config.gate + config.gate_sigmas * spreads
        gate += config.gate_drift * _untied(keyframe, history)[old]
        positions = history.poses()[:, :3, 3]
        away = np.linalg.norm(positions[old] - positions[keyframe.index], axis=1)
        near = old[away <= gate]
        return near if len(near) else Rejection.OUT_OF_REACH

    def _alike(self, index: int, near: IntArray) -> list[tuple[int, float]]:
        """The candidates that look most alike, and how the lidar is turned against each."""
        own = self._descriptors[index]
        tree = cKDTree([heading_free(self._descriptors[other]) for other in near.tolist()])
        _, found = tree.query(heading_free(own), k=min(_ALIKE, len(near)))
        compared = [
            (*unlike(self._descriptors[other], own), other)
            for other in near[np.sort(np.atleast_1d(found))].tolist()
        ]
        chosen: list[tuple[int, float]] = []
        for distance, turn, other in sorted(compared):
            # Neighbours share a submap, and so a verdict.
            apart = all(abs(other - taken) > self.config.neighbours for taken, _ in chosen)
            if not apart or len(chosen) == self.config.tries:
                continue
            self.statistics.candidates += 1
            if distance > self.config.max_unlike:
                self._reject(Rejection.UNLIKE)
                break
            chosen.append((other, turn))
        return chosen

    def _submap(
        self, keyframe: Keyframe, candidate: int, history: PoseGraph
    ) -> tuple[CubeMap, CubeMap]:
        """Edge and plane map of the keyframes around the candidate, in its frame."""
        config = self._whole.map.changed(archive_dir=None, insertion="settled")
        maps = CubeMap(config, config.edge_voxel), CubeMap(config, config.plane_voxel)
        beside = self.config.neighbours
        around = history.keyframes[max(candidate - beside, 0) : candidate + beside + 1]
        # The candidate's own features come first: a voxel keeps the first point it gets.
        chosen = [
            other
            for other in sorted(around, key=lambda other: abs(other.index - candidate))
            if keyframe.travelled - other.travelled >= self.config.min_way
            or other.index == candidate
        ]
        here = history.pose(candidate)
        poses = [here.between(history.pose(other.index)).matrix() for other in chosen]
        kinds = [other.edges for other in chosen], [other.planes for other in chosen]
        for cubes, parts in zip(maps, kinds, strict=True):
            moved = [transform(pose, part) for pose, part in zip(poses, parts, strict=True)]
            cubes.insert(np.concatenate(moved))
        return maps

    def _judged(self, fit: Fit) -> Rejection | None:
        """What is wrong with a registration; None if it is to be believed."""
        if fit.share < self.config.min_share:
            return Rejection.LITTLE_OVERLAP
        return Rejection.DISAGREES if fit.agreement < self.config.min_agreement else None

    def _covariance(
        self, solution: Solution, earlier: Keyframe, later: Keyframe
    ) -> FloatArray | None:
        """(6, 6) of the loop; None if the registration leaves a direction free.

        The submap lies where the candidate and its neighbours are in the map, each off by an error
        of its own; and what the motion within the sweep did to the keyframe's features is in its.
        """
        seen = localizability(solution.matches, solution.map_T_lidar)
        if seen.aligned[0] < self.config.min_aligned:
            return None
        config, solver = self._whole.covariance, self._whole.solver
        ground = SeenGround(config.ground_cell)
        error = scan_error(solution, solver.kernel_width, ground, config, kernel=solver.kernel)
        if error is None:
            return None
        covariance = error.covariance
        to_later = solution.map_T_lidar.inverse().AdjointMap()
        for keyframe, moved in ((earlier, to_later), (later, np.eye(6))):
            if keyframe.update.uncertainty is not None:
                covariance = covariance + moved @ keyframe.update.uncertainty.own @ moved.T
        return covariance


def standing_fit(matches: ScanMatches, offered: int) -> Fit:
    """How well what stands up fits: edges, and planes that are not level.

    Level ground fits everywhere at any heading, and where there is much of it, nearly all matches
    of a wrong registration agree.

    Parameters
    ----------
    matches : in a frame with z up, roughly
    offered : features that were to be matched
    """
    standing = np.abs(matches.planes.normals[:, 2]) < _LEVEL
    level = int(np.count_nonzero(~standing))
    return Fit.of(ScanMatches(matches.edges, subset(matches.planes, standing)), offered - level)


def _untied(keyframe: Keyframe, history: PoseGraph) -> FloatArray:
    """(N,) metres along which the odometry alone leads to each keyframe: straight, or by a loop."""
    travelled = np.array([other.travelled for other in history.keyframes])
    gone = keyframe.travelled - travelled
    for loop, on in zip(history.loops, history.active, strict=True):
        if on:
            since = keyframe.travelled - travelled[loop.later]
            gone = np.minimum(gone, since + np.abs(travelled - travelled[loop.earlier]))
    return gone


def _heading(rotation: gtsam.Rot3) -> float:
    """Rad about z."""
    matrix = rotation.matrix()
    return float(np.arctan2(matrix[1, 0], matrix[0, 0]))
