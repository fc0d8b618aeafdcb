"""The adjustment: planes and lines of the map and poses of the sweeps together.

Sweeps are de-skewed along the adjusted path, anew in each round
(:mod:`loam_gtsam.refine.rounds`). A long drive is adjusted in windows, and then as a whole
(:mod:`loam_gtsam.refine.windows`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from scipy.sparse import csc_array

from loam_gtsam.datasets.decode.geodesy import GeoReference
from loam_gtsam.geometry import as_array, symmetric
from loam_gtsam.refine.elimination import Sightings, about_landmarks, transformed_moments
from loam_gtsam.refine.landmarks import Landmarks
from loam_gtsam.refine.rounds import (
    OtherFactors,
    Round,
    Settings,
    Ties,
    adjusted,
    check_factors,
    equations,
    factorised,
)
from loam_gtsam.refine.sweeps import Path, ReferenceSteps, Stack, SweepPoints, stacked
from loam_gtsam.refine.ties import FixTies
from loam_gtsam.refine.windows import in_windows
from loam_gtsam.types import FloatArray, InputError, Trajectory

_TOGETHER = 20
"""Poses of which covariances are found in one solve."""


@dataclass(frozen=True, eq=False)
class Refined:
    """Adjusted poses, planes and lines.

    Attributes
    ----------
    path : poses of the middles of the sweeps, and the motion about them
    landmarks : planes and lines of the last round
    sightings : which sweep saw which of them
    information : (6 N, 6 N) of the poses, landmarks eliminated, other factors included
    steps : the motion from the middles to the reference times
    rounds : what each round did
    fixes : those of a GNSS receiver that took part
    """

    path: Path
    sweeps: Sequence[SweepPoints]
    landmarks: Landmarks
    sightings: Sightings
    information: csc_array
    steps: ReferenceSteps
    rounds: tuple[Round, ...] = field(default=())
    fixes: FixTies | None = None

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses at the reference times of the sweeps."""
        stamps = [sweep.stamp + round(sweep.reference * 1e9) for sweep in self.sweeps]
        poses = [self._reference(number) for number in range(len(self.sweeps))]
        return Trajectory.from_poses(stamps, poses)

    @cached_property
    def _solver(self) -> Callable[[FloatArray], FloatArray]:
        solver: Callable[[FloatArray], FloatArray] = factorised(self.information).solve
        return solver

    @cached_property
    def earth(self) -> GeoReference | None:
        """Where the map is on the earth; None without fixes."""
        if self.fixes is None:
            return None
        return self.fixes.referenced(self.path.map_T_middle, self._solver)

    def _reference(self, number: int) -> gtsam.Pose3:
        """The pose of a sweep at its reference time."""
        led = self.path.at(number, self.sweeps[number].reference)
        return led.compose(gtsam.Pose3.Expmap(self.steps.beyond[number]))

    def joint_covariance(self, numbers: Sequence[int]) -> FloatArray:
        """(6 K, 6 K) joint marginal of the poses of K sweeps at their reference times.

        Tangent order of the package, perturbations on the right. A number that no sweep has is
        an InputError.
        """
        count = len(self.sweeps)
        if not all(0 <= n < count for n in numbers):
            raise InputError(
                f"expected numbers of sweeps from 0 to {count - 1}, got {list(numbers)}"
            )
        rows = np.concatenate([6 * n + np.arange(6) for n in numbers])
        units = np.zeros((self.information.shape[0], len(rows)))
        units[rows, np.arange(len(rows))] = 1.0
        joint = self._solver(units)[rows]
        turn = np.zeros_like(joint)
        for k, n in enumerate(numbers):
            pose = gtsam.Pose3(self.path.map_T_middle[n])
            away = self._reference(n).between(pose).AdjointMap()
            turn[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = away
        joint = turn @ joint @ turn.T + np.diag(self.steps.variances[list(numbers)].ravel())
        return symmetric(joint)

    @cached_property
    def covariances(self) -> FloatArray:
        """(N, 6, 6) marginals of all poses at their reference times."""
        count = len(self.sweeps)
        groups = [range(n, min(n + _TOGETHER, count)) for n in range(0, count, _TOGETHER)]
        found = np.empty((count, 6, 6))
        for group in groups:
            joint = self.joint_covariance(group).reshape(len(group), 6, len(group), 6)
            for place, number in enumerate(group):
                found[number] = joint[place, :, place]
        return found

    def covariance(self, number: int) -> FloatArray:
        """(6, 6) marginal of one pose."""
        return self.joint_covariance([number])

    def relative_covariance(self, earlier: int, later: int) -> FloatArray:
        """(6, 6) of the motion between two poses, perturbation on the right of the later one."""
        joint = self.joint_covariance([earlier, later])
        poses = self.trajectory.map_T_lidar
        motion = gtsam.Pose3(poses[later]).between(gtsam.Pose3(poses[earlier]))
        both = np.hstack([-motion.AdjointMap(), np.eye(6)])
        return symmetric(both @ joint @ both.T)

    def landmark_covariances(self) -> FloatArray:
        """(L, 3) variances of the planes and lines, poses given.

        Turns of a normal towards the second and the third axis, rad^2, and offset along it, m^2.
        Both normals of a line have the same, and a line no turn towards the second axis: 0.
        """
        seen, landmarks = self.sightings, self.landmarks
        relative = about_landmarks(self.path.map_T_middle, landmarks, seen)
        moments = transformed_moments(relative, landmarks, seen)
        across = landmarks.axes[:, :, 1:]
        turns = np.einsum("nik,nij,njk->nk", across, moments[:, :3, :3], across)
        found: FloatArray = 1.0 / np.maximum(np.column_stack([turns, moments[:, 3, 3]]), 1e-300)
        found[landmarks.is_line, 0] = 0.0
        return found


def refine(
    sweeps: Sequence[SweepPoints],
    map_T_middle: FloatArray,
    factors: gtsam.NonlinearFactorGraph | None = None,
    settings: Settings | None = None,
    *,
    keep: FloatArray | None = None,
    for_covariances: gtsam.NonlinearFactorGraph | None = None,
    fixes: FixTies | None = None,
    ties: Sequence[Ties] = (),
    starts: Sequence[int] = (0,),
    steps: ReferenceSteps | None = None,
    on_round: Callable[[Round], None] | None = None,
    on_window: Callable[[int, int], None] | None = None,
) -> Refined:
    """Adjust the poses of sweeps so that the planes and lines that they see become thin.

    Parameters
    ----------
    sweeps : in the order of their stamps, run after run
    map_T_middle : (N, 4, 4) poses of the middles of the sweeps, where the search starts: what
        sweeps see farther apart than about ``settings.sigma`` ties nothing
    factors : further factors on the poses, whose keys are ``gtsam.symbol("x", n)``: odometry,
        loops, positions. The first pose is held if no factor is on one pose alone.
    keep : (N, 6, 6) projectors of the poses onto the directions about which planes and lines are
        asked, all if None; those that drown in noise are left out anyway
        (:func:`~loam_gtsam.refine.elimination.seen_directions`)
    for_covariances : factors that stand for ``factors`` in the covariances, if those are less
        sure than they are given weight
    fixes : of a GNSS receiver, on the poses
    ties : what else is known of them, with other variables
    starts : numbers of the first sweeps of the runs, if there are several, or of other stretches
        between which no motion is known
    steps : from the middles to the reference times, as an IMU or the points told them; if None, the
        path through the adjusted poses tells
    on_round : called after each round of the whole, to show progress
    on_window : called after each window of a long drive with the number of those done, and of all

    Raises
    ------
    InputError
        If no plane or line is seen by three sweeps, some sweep is tied to no other, or a direction
        of the poses is free.
    """
    settings = settings or Settings()
    poses = as_array(map_T_middle, "map_T_middle", (len(sweeps), 4, 4)).copy()
    if len(sweeps) < 3:
        raise InputError(f"refine: expected 3 or more sweeps, got {len(sweeps)}")
    known: tuple[Ties, ...] = (*ties, *(() if fixes is None else (fixes,)))
    for graph in (factors, for_covariances):
        if graph is not None:
            check_factors(graph, poses)
    others = OtherFactors(factors, poses, known=known)
    stamps = np.array([sweep.stamp for sweep in sweeps], np.int64)
    asked = np.tile(np.eye(6), (len(sweeps), 1, 1))
    if keep is not None:
        asked = as_array(keep, "keep", (len(sweeps), 6, 6))

    def points_at(poses: FloatArray) -> Stack:
        return stacked(Path.through(stamps, poses, starts), sweeps)

    views = 3
    if len(sweeps) > settings.whole:
        views = 2  # of stretches, each of which saw it from many places
        windows = in_windows(sweeps, poses, others, asked, settings, starts, on_window)
        poses, points_at = windows.map_T_middle, windows.points_at
        known = (*windows.ties, *known)
        others = OtherFactors(factors, poses, known=known)
    found = adjusted(points_at, poses, others, asked, settings, on_round, views)
    poses = found.map_T_middle
    if for_covariances is not None:
        others = OtherFactors(for_covariances, poses, known=known)
    information, _ = equations(poses, found.landmarks, found.seen, found.clear, others)
    factorised(information)
    path = Path.through(stamps, poses, starts)
    steps = steps or ReferenceSteps.along(path, sweeps)
    parts = found.landmarks, found.seen, information, steps, found.rounds, fixes
    return Refined(path, tuple(sweeps), *parts)
