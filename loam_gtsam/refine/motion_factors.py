"""What a run knew of the motion between its sweeps and within them, for the adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.geometry import symmetric
from loam_gtsam.loops.batch import SavedGraph, optimize_graph
from loam_gtsam.loops.keyframes import noise_model
from loam_gtsam.refine.sweeps import SweepPoints
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.types import BoolArray, FloatArray, FrameStatus, IntArray, MapUpdate, SweepMotion

_UNKNOWN: FloatArray = np.diag(np.repeat([0.1, 1.0], 3) ** 2)
"""Covariance of a motion to or from a sweep that was not solved."""
_LOOP_KERNEL = 3.0
"""Width of the Huber kernel on a loop closure, of which a right one has a norm of sqrt(6)."""


def told_directions(updates: Sequence[MapUpdate], least: float) -> FloatArray:
    """Projectors (N, 6, 6) of the poses onto the directions that the run saw in each sweep.

    A direction that fewer than ``least`` matches fix (``solver.min_aligned``) is left out. All are
    kept where the run did not look.
    """
    keep = np.tile(np.eye(6), (len(updates), 1, 1))
    for number, update in enumerate(updates):
        known = np.isfinite(update.directions).all() and np.isfinite(update.localizability).all()
        weak = update.localizability < least
        if known and weak.any():
            # The rows of ``directions`` are orthonormal by the motion that they give the points.
            dual = np.linalg.pinv(update.directions).T
            keep[number] -= update.directions[weak].T @ dual[weak]
    return keep


def odometry_factors(
    updates: Sequence[MapUpdate],
    map_T_middle: FloatArray,
    keep: FloatArray | None = None,
    *,
    start: int = 0,
) -> gtsam.NonlinearFactorGraph:
    """Between factors of consecutive sweeps, with the covariances that the run calibrated.

    They come from the same points as the planes, so that where the planes decide, they add little
    that is new; they decide along directions that no plane fixes. After sweeps that were not found,
    the next one that was is tied to the last one before.

    Parameters
    ----------
    updates : N frames of a run, in their order
    map_T_middle : (N, 4, 4) their poses
    keep : (N, 6, 6) of :func:`told_directions`. Along what is left out, an error of the velocity
        persists: over n sweeps it grows with n and not with its root, so that each variance along
        it is taken n times.
    start : number of the first of them among the sweeps of all runs
    """
    keep = np.tile(np.eye(6), (len(updates), 1, 1)) if keep is None else keep
    blind = np.eye(6) - keep
    length = _stretches(np.abs(blind).max(axis=(1, 2)) > 0.0)
    graph = gtsam.NonlinearFactorGraph()
    last: int | None = None  # number of the last one that was found
    for number, (earlier, later) in enumerate(pairwise(updates)):
        last = last if earlier.uncertainty is None else number
        tied = number if later.uncertainty is None or last is None else last
        known = later.uncertainty is not None and last is not None
        covariance = relative_covariance(updates[tied], later) if known else _UNKNOWN
        left_out = blind[number + 1]
        extra = max(length[number + 1] - 1, 0) * left_out @ covariance @ left_out.T
        covariance = symmetric(covariance + extra)
        motion = gtsam.Pose3(map_T_middle[tied]).between(gtsam.Pose3(map_T_middle[number + 1]))
        keys = gtsam.symbol("x", start + tied), gtsam.symbol("x", start + number + 1)
        graph.add(gtsam.BetweenFactorPose3(*keys, motion, noise_model(covariance)))
    return graph


def long_motion_factors(
    updates: Sequence[MapUpdate], map_T_middle: FloatArray, span: int = 50, *, start: int = 0
) -> gtsam.NonlinearFactorGraph:
    """Between factors over ``span`` sweeps, each beginning half of that after the one before.

    The own error of a frame counts in every step of a chain, and cancels in truth: over long ways
    the run knows more than its steps, above all along a corridor, of which planes tell little.
    Sweeps that were not solved begin and end none. For the parameters see
    :func:`odometry_factors`.
    """
    graph = gtsam.NonlinearFactorGraph()
    for first in range(1, len(updates) - span, max(span // 2, 1)):
        last = first + span
        if updates[first].uncertainty is None or updates[last].uncertainty is None:
            continue
        noise = noise_model(relative_covariance(updates[first], updates[last]))
        motion = gtsam.Pose3(map_T_middle[first]).between(gtsam.Pose3(map_T_middle[last]))
        keys = gtsam.symbol("x", start + first), gtsam.symbol("x", start + last)
        graph.add(gtsam.BetweenFactorPose3(*keys, motion, noise))
    return graph


def step_variances(updates: Sequence[MapUpdate]) -> FloatArray:
    """(N, 6), infinite where nothing is known; of the first sweep a gyro tells the rotation.

    The own error of a frame has the error of this step in it, which so is told to be larger.
    """
    found = np.full((len(updates), 6), np.inf)
    for place, update in enumerate(updates):
        if update.uncertainty is not None:
            found[place] = np.diag(update.uncertainty.own)
    if [update.sweep_motion for update in updates[:2]] == [SweepMotion.GYRO] * 2:
        found[0, :3] = found[:2, :3].min(axis=0)
    return found


def to_middles(updates: Sequence[MapUpdate], sweeps: Sequence[SweepPoints]) -> list[gtsam.Pose3]:
    """Poses of the middles of the sweeps, seen from their reference times, as the run had them."""
    steps = []
    for update, sweep in zip(updates, sweeps, strict=True):
        step = gtsam.Pose3.Expmap(update.twist * -sweep.reference)
        if update.map_T_middle is not None and update.middle_stamp == sweep.stamp:
            step = update.map_T_lidar.between(update.map_T_middle)
        steps.append(step)
    if len(updates) > 1 and updates[0].status is FrameStatus.FIRST and updates[1].status.solved:
        steps[0] = _first_to_middle(updates, sweeps, steps)
    return steps


def _first_to_middle(
    updates: Sequence[MapUpdate], sweeps: Sequence[SweepPoints], steps: Sequence[gtsam.Pose3]
) -> gtsam.Pose3:
    """The step of the first sweep, whose motion the run did not know yet when it told the pose.

    It lies on the parabola through the pose at the reference time and the middle of the second
    sweep, with the velocity of that one; a rotation that a gyro told stays.
    """
    first, second = updates[:2]
    seconds = (sweeps[1].stamp - first.stamp) * 1e-9
    moved = gtsam.Pose3.Logmap(first.map_T_lidar.between(second.map_T_lidar.compose(steps[1])))
    part = -sweeps[0].reference / seconds
    more = second.twist * seconds - moved  # than with a constant velocity
    step = gtsam.Pose3.Expmap(part * (moved - more) + part**2 * more)
    if first.sweep_motion is SweepMotion.GYRO is second.sweep_motion:
        step = gtsam.Pose3(steps[0].rotation(), step.translation())
    return step


def _stretches(mask: BoolArray) -> IntArray:
    """(N,) length of the run of true values that each is in; 0 for the others."""
    length = np.zeros(len(mask), np.int64)
    for start in np.flatnonzero(mask & ~np.concatenate([[False], mask[:-1]])):
        rest = np.flatnonzero(~mask[start:])
        end = start + rest[0] if len(rest) else len(mask)
        length[start:end] = end - start
    return length


def loop_factors(
    graph: SavedGraph,
    frames: Mapping[int, int],
    to_middle: Sequence[gtsam.Pose3],
) -> gtsam.NonlinearFactorGraph:
    """The loop closures that agree with the others, between the middles of the sweeps.

    Parameters
    ----------
    graph : pose graph of a run, or of several
    frames : numbers of the sweeps by the keys of the graph; loops on other keys are left out
    to_middle : pose of the middle of each sweep, seen from where the graph has its pose
    """
    found, loops = gtsam.NonlinearFactorGraph(), graph.loops
    if not loops:
        return found
    for place, report in zip(loops, optimize_graph(graph).loops, strict=True):
        factor: Any = graph.factors.at(place)
        first, second = (frames.get(key) for key in factor.keys())  # noqa: SIM118
        if not report.active or first is None or second is None:
            continue
        one, two = to_middle[first], to_middle[second]
        motion = one.inverse().compose(factor.measured()).compose(two)
        turn = two.inverse().AdjointMap()
        noise = noise_model(symmetric(turn @ factor.noiseModel().covariance() @ turn.T))
        kernel = gtsam.noiseModel.mEstimator.Huber.Create(_LOOP_KERNEL)
        keys = gtsam.symbol("x", first), gtsam.symbol("x", second)
        robust = gtsam.noiseModel.Robust.Create(kernel, noise)
        found.add(gtsam.BetweenFactorPose3(*keys, motion, robust))
    return found
