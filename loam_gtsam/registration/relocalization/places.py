"""The places at which a sweep that is searched for may be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import compress

import gtsam
import numpy as np

from loam_gtsam.geometry import five_sigma, parallel_sum
from loam_gtsam.registration.degeneracy import displacements
from loam_gtsam.registration.frame_matcher import Frame, FrameMatcher
from loam_gtsam.registration.relocalization.fits import AS_WELL, Fit, FitMonitor, step_in_map
from loam_gtsam.registration.relocalization.likely_poses import (
    MORE_EDGES,
    Field,
    likely_poses,
    sample_features,
)
from loam_gtsam.registration.solvers import MotionPrior, ScanSolver, Solution
from loam_gtsam.registration.solvers.base import SCAN_VARIANCE
from loam_gtsam.types import FloatArray

_UNLIKELY = five_sigma(6)  # from which on a place contradicts an IMU
_PLACES = 6  # largest number of places that are tried for a sweep that does not fit the map


def likely_places(
    frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver
) -> list[gtsam.Pose3]:
    """The poses around the prediction at which a few matches fit best, or as well but for chance.

    Where much repeats, a place one bay farther on fits as well. The nearest, which comes first, is
    the likeliest. Once it was tried in vain, the best comes first.
    """
    matcher, expected = frame.matcher, frame.predicted.map_T_middle
    around = monitor.around(expected)
    known = [
        cubes.points(cubes.neighbourhood(pose.matrix()))
        for pose in around
        for cubes in (matcher.maps.edges, matcher.maps.planes)
    ]
    starts = [solution.map_T_lidar] if solution.solved else []
    points = sample_features(*matcher.posed.points, MORE_EDGES)
    as_well = None if monitor.lost else AS_WELL
    held = np.concatenate(known)
    fields = [Field.around(held, pose, monitor.radius) for pose in around]
    starts += likely_poses(points, fields, around, _PLACES, rare=True, as_well=as_well)
    matcher.clock.lap("relocalize")
    trial = replace(matcher, refine=False).with_few_matches()
    tried = [solved_near(frame, trial, start, solver) for start in starts]
    solved = _as_measured([one for one in tried if one.solved], frame.predicted.motion)
    places = [(fit_of(trial, one).total, one.map_T_lidar) for one in solved]
    best = max((total for total, _ in places), default=0.0)
    as_good = [place for place in places if place[0] >= AS_WELL * best]
    ranks = [-total if monitor.lost else moved(points, expected, pose) for total, pose in as_good]
    return [as_good[number][1] for number in np.argsort(ranks, kind="stable")]


def fit_of(matcher: FrameMatcher, solution: Solution) -> Fit:
    """How well the features of a matcher fit the map where they were solved."""
    return Fit.of(solution.matches, matcher.offered, matcher.matching.max_distance)


def solved_near(
    frame: Frame, matcher: FrameMatcher, place: gtsam.Pose3, solver: ScanSolver
) -> Solution:
    """The sweep, solved from a place: along directions that its matches leave open it stays."""
    here = MotionPrior(place, frame.predicted.motion.information)
    return solver.solve(matcher, place, frame.priors, here)


def _as_measured(places: list[Solution], expected: MotionPrior) -> list[Solution]:
    """The places that gyro and accelerometer do not contradict; all, if they contradict each."""
    agree = [not contradicts(expected, place) for place in places]
    return list(compress(places, agree)) or places


def contradicts(expected: MotionPrior, solution: Solution) -> bool:
    """Whether gyro and accelerometer, if they tell the expected pose, contradict a solved one."""
    if not (expected.measured and solution.solved):
        return False
    step = expected.map_T_lidar.localCoordinates(solution.map_T_lidar)
    by_both = parallel_sum(expected.information, solution.information / SCAN_VARIANCE)
    return bool(step @ by_both @ step >= _UNLIKELY)


def moved(points: FloatArray, one: gtsam.Pose3, other: gtsam.Pose3) -> float:
    """Root mean square of the distances, metres, between points (N, 3) at one pose and another."""
    form = displacements(points, np.full(len(points), 1.0 / max(len(points), 1)))
    step = one.localCoordinates(other)
    squared = float(step @ form @ step)
    return math.sqrt(max(squared, 0.0))


def any_of(pose: gtsam.Pose3, rivals: Sequence[gtsam.Pose3]) -> FloatArray | None:
    """Covariance (6, 6) of a pose, map frame, if one of the rivals may be right; None without any.

    The mean squared error of any of the places, about each.
    """
    if not rivals:
        return None
    steps = np.array([step_in_map(pose, rival) for rival in rivals])
    total: FloatArray = steps.T @ steps / (1 + len(rivals))
    return total
