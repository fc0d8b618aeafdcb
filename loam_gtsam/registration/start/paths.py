"""The paths of the lidar within the first sweeps of a run: docs/maths/start.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.registration.degeneracy import tells_motion
from loam_gtsam.registration.solvers import Solution
from loam_gtsam.registration.solvers.sweep_velocity import solved_twist, timed_rows
from loam_gtsam.registration.start.ways import EarlySweep, mean_twist
from loam_gtsam.types import FloatArray, SweepMotion

_APART = 0.5  # durations of a sweep that the middles at least are apart from which a path is told
_AHEAD = 0.75
"""Durations after the reference time of the first sweep from which middles count for its path: from
poses that are nearer to each other than to its middle, a path would be continued backwards."""


def on_paths(sweeps: Sequence[EarlySweep], map_T_first: gtsam.Pose3) -> list[EarlySweep]:
    """The sweeps, de-skewed for the paths that lead through their poses.

    These are straight, at constant velocity, unless the matches tell the velocity of the first one.
    ``map_T_first`` is its pose at the reference time, at which it is held.
    """
    moved = list(sweeps)
    for number in range(1, len(moved)):
        last, now = moved[number - 1].moment, moved[number]
        sweep = now.posed.sweep
        if sweep.stamp > last.stamp:  # not for sweeps of unlike length
            twist = sweep.twist_since(last[:2], now.map_T_middle)
            moved[number] = replace(now, posed=sweep.accelerated(None).at(twist))
    sweep = moved[0].posed.sweep.accelerated(None)
    moved[0] = replace(moved[0], posed=sweep.at(_first_twist(*moved[:2])))
    bent = moved[0].velocity is not None
    if bent:
        moved[0] = _on_path(moved, 0, map_T_first)
    moved[0] = replace(moved[0], map_T_middle=moved[0].posed.map_T_middle(map_T_first))
    if bent:
        moved[1:] = [_on_path(moved, number, map_T_first) for number in range(1, len(moved))]
    return moved


def with_velocity(
    sweeps: Sequence[EarlySweep], number: int, solution: Solution | None,
    map_T_first: gtsam.Pose3, config: Config,
) -> list[EarlySweep]:  # fmt: skip
    """The sweeps, one of them with the velocity that its matches tell, if they do.

    Those of the second one tell how its velocity differs from that of the first, which passed by
    the same things at the same part of its sweep: of two sweeps both get theirs. What was told of
    few sweeps is outdated if with more of them (None: it is not solved) nothing is told: then the
    velocity is that of the path through the poses.
    """
    told, one, solver = list(sweeps), sweeps[number], config.solver
    if solution is None or not _tells(sweeps if len(sweeps) == 2 else [one], solution, config):
        if len(sweeps) > 2 and one.velocity is not None:
            told[number] = replace(one, velocity=_parabola(sweeps, number, map_T_first)[0])
        return told
    rows, seconds = timed_rows(solution.matches, one.posed.sweep, solver)
    matches = rows, solution.matches.tilts, seconds, solution.map_T_lidar
    noise = config.features.range_noise
    if len(sweeps) > 2:
        expected, _ = _parabola(sweeps, number, map_T_first)
        missed = 0.5 * _usual_change(sweeps)
        velocity = solved_twist(
            *matches, one.posed.twist, expected, missed, noise, heed_contradiction=True
        )
        told[number] = replace(one, velocity=velocity)
        return told
    first, second = sweeps
    mean, now = mean_twist(first, second), second.posed.twist - first.posed.twist
    usual = np.repeat([solver.turn_sigma, solver.acceleration_sigma], 3)
    missed = first.moment.seconds_to(second.moment.stamp) * usual
    change = solved_twist(*matches, now, np.zeros(6), missed, noise, heed_contradiction=True)
    return [
        replace(first, velocity=mean - 0.5 * change),
        replace(second, velocity=mean + 0.5 * change),
    ]


def _tells(sweeps: Sequence[EarlySweep], solution: Solution, config: Config) -> bool:
    """Whether matches tell velocities of sweeps, which nothing else does."""
    seen = solution.localizability
    if config.deskew.model != "linear" or not solution.solved or seen is None:
        return False
    free = all(one.posed.sweep.motion is SweepMotion.CONSTANT_VELOCITY for one in sweeps)
    return free and tells_motion(seen, config.solver)


def _on_path(sweeps: Sequence[EarlySweep], number: int, map_T_first: gtsam.Pose3) -> EarlySweep:
    """One of the sweeps, de-skewed for a velocity that changes."""
    one = sweeps[number]
    if len(sweeps) > 2:
        velocity, acceleration = _parabola(sweeps, number, map_T_first)
    else:
        velocity, acceleration = one.posed.twist, _parted(*sweeps)
    velocity = velocity if one.velocity is None else one.velocity
    return replace(one, posed=one.posed.sweep.accelerated(acceleration).at(velocity))


def _parabola(
    sweeps: Sequence[EarlySweep], number: int, map_T_first: gtsam.Pose3
) -> tuple[FloatArray, FloatArray]:
    """(6,) body velocity and (6,) acceleration in the middle of one of three sweeps or more.

    They are those of the parabola through its pose and the poses before and after it; at the ends,
    through the next three. For the very first its reference time stands, where the pose is held.
    """
    one, stamp = sweeps[number], sweeps[number].moment.stamp
    middles = [sweep.moment[:2] for sweep in sweeps]
    if number == 0:
        held, ahead = one.posed.sweep.reference_stamp, _AHEAD * one.posed.sweep.duration
        later = [middle for middle in middles if middle[0] - held >= 1e9 * ahead]
        through = [(held, map_T_first), *later[:2]]
    else:
        begins = min(number - 1, len(sweeps) - 3)
        through = middles[begins : begins + 3]
    times = np.array([(near - stamp) * 1e-9 for near, _ in through])
    if len(times) < 3 or np.diff(times).min() < _APART * one.posed.sweep.duration:
        return one.posed.twist, np.zeros(6)
    steps = [gtsam.Pose3.Logmap(one.map_T_middle.between(pose)) for _, pose in through]
    powers = np.stack([np.ones(3), times, 0.5 * times**2], axis=1)
    _, velocity, acceleration = np.linalg.solve(powers, np.array(steps))
    return velocity, acceleration


def _parted(first: EarlySweep, second: EarlySweep) -> FloatArray:
    """(6,) acceleration between two sweeps whose velocities are told; zero if they are not."""
    if first.velocity is None or second.velocity is None:
        return np.zeros(6)
    change: FloatArray = second.velocity - first.velocity
    return change / first.moment.seconds_to(second.moment.stamp)


def _usual_change(sweeps: Sequence[EarlySweep]) -> FloatArray:
    """(6,) rms of the changes of the mean velocity, rad/s and m/s, the same along all axes."""
    changes = np.diff([mean_twist(*pair) for pair in pairwise(sweeps)], axis=0)
    usual: FloatArray = np.sqrt((changes.reshape(-1, 2, 3) ** 2).mean(axis=(0, 2)))
    return usual.repeat(3)


def _first_twist(first: EarlySweep, second: EarlySweep) -> FloatArray:
    """(6,) body velocity of the first sweep: that of the second, less what was felt in between."""
    sweep, twist = second.posed.sweep, second.posed.twist
    velocity = sweep.velocity_at((first.moment.stamp - sweep.stamp) * 1e-9, twist)
    if velocity is None:
        return twist
    moved = first.map_T_middle.rotation().between(second.map_T_middle.rotation())
    return first.posed.sweep.twist_at_reference(twist[:3], moved.matrix() @ velocity)
