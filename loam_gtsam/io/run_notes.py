"""Sentences on what is wrong or in doubt about a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from loam_gtsam.io.run_files import position_sigmas
from loam_gtsam.types import FrameStatus, MapUpdate, SweepFault, SweepMotion

if TYPE_CHECKING:
    from loam_gtsam.aiding.imu_summary import ImuSummary
    from loam_gtsam.loops.pose_graph import PoseGraph
    from loam_gtsam.pipeline import RunResult

DO_NOT_TRUST = "DO NOT TRUST THIS RUN: "
"""What a sentence begins with that puts the whole run in doubt."""
_EXPECTED = (FrameStatus.OK, FrameStatus.FIRST, FrameStatus.NOT_CONVERGED)
_TOO_MANY = 0.05  # share of frames that are not trustworthy from which on a run is in doubt
_PARTS = slice(0, 3), slice(3, 6)  # of a covariance: rotation and position
_ADVICE = {
    FrameStatus.DEGENERATE: "a sensor that the run does without (of IMU, wheels, GPS) can tell "
    "what the scans do not: docs/imu.md, docs/gnss.md",
    FrameStatus.LOST: "too fast or too few matches: use every sweep, check sensor.* and the times "
    "of the points",
    FrameStatus.UNUSABLE_SCAN: "see loam-gtsam inspect",
    FrameStatus.BAD_STAMP: "the stamps of the sweeps, or the times of their points, are wrong: "
    "see loam-gtsam inspect",
}
_ADVICE[FrameStatus.SPARSE_MAP] = _ADVICE[FrameStatus.LOST]
_ADVICE[FrameStatus.FEW_MATCHES] = (
    f"{_ADVICE[FrameStatus.LOST]}; if sweeps are parts of a turn, each of which sees another side, "
    "join them"
)
_PART_FAILED = "a part of your own raised exceptions, which the messages of the frames tell"
_PIECE = " in another piece of map"  # in the message of the first frame there
_MOVED = "moved by "  # in the message of a frame that was searched for
_CONTRARY = "as if no IMU had been there"  # in that of a frame that fits better so
_VAGUE = 0.01  # standard deviation from which on a pose is vague: rad, and part of the path
_SAID = 1.0  # metres of standard deviation from which on a vague one is said
_SHORT = 10.0  # metres: a hundredth of a shorter path is what rough ground makes


def run_notes(result: RunResult) -> tuple[str, ...]:
    """Sentences on positions, IMU, fixes, wheels, points and statuses; none if all is well."""
    notes = []
    sigmas = position_sigmas(result.updates)
    path = result.trajectory.path_length
    if sigmas is not None:
        largest = sigmas["largest"]
        if largest > max(_SAID, _VAGUE * path):
            notes.append(_why_vague(result.updates, largest))
    pieces = [number for number, one in enumerate(result.updates) if _PIECE in one.message]
    if pieces:
        frames = ", ".join(map(str, pieces))
        tell = "where it is, loops.enabled or a GNSS receiver may tell"
        notes.append(f"the run goes on{_PIECE} from frame {frames} on: {tell}")
    if result.imu is not None:
        notes += [*result.imu.problems, *_without_imu(result, result.imu)]
    if result.fixes is not None and result.fixes.reference is None:
        notes.append(f"fixes of the GNSS receiver {result.fixes}")
    if result.fixes is not None and result.fixes.antenna_problem:
        notes.append(result.fixes.antenna_problem)
    if result.loops is not None:
        notes += _on_loops(result.loops.graph)
    if result.wheels_problem:
        notes.append(result.wheels_problem)
    if result.times_problem:
        notes.append(f"{DO_NOT_TRUST}{result.times_problem}")
    if result.range_offset is not None and result.range_offset.problem:
        notes.append(result.range_offset.problem)
    if result.pipeline is not None and (said := result.pipeline.mapper.errors.beam_errors.problem):
        notes.append(said)
    few = result.config.solver.method == "aloam"  # associations, by its design
    return (*notes, *_on_statuses(result.updates, max(path, _SHORT), few))


def _on_loops(graph: PoseGraph) -> list[str]:
    """A sentence on loops that are not used, if there are many, and most are not."""
    on = sum(graph.active)
    off = len(graph.active) - on
    if off < max(graph.config.believed_loops, on):
        return []
    return [
        f"{off} of {len(graph.active)} loops contradict the rest and are not used: places look "
        "alike, or the odometry drifts more than it knows (pose_graph.walk)"
    ]


def _without_imu(result: RunResult, imu: ImuSummary) -> list[str]:
    """Sentences on sweeps that were mapped without the IMU; none if few were.

    Their samples came after them, or they fitted better as if there were none.
    """
    if result.config.deskew.rotation == "constant_velocity" or imu.gyro_left_out:
        return []
    solved = [update for update in result.updates if update.status.solved]
    alone = [one for one in solved if one.sweep_motion is SweepMotion.CONSTANT_VELOCITY]
    contrary = sum(_CONTRARY in update.message for update in alone)
    late, few = len(alone) - contrary, _TOO_MANY * len(solved)
    notes = []
    # Without an orientation either, that is said already.
    told = imu.report.orientation != "none" and imu.tilt_priors.get("dropped", 0) >= late
    if late > few and not told:
        notes.append(
            f"IMU: its samples did not cover {late} of {len(solved)} sweeps when these were "
            "mapped; add them before the sweep"
        )
    if contrary > few:
        notes.append(
            f"IMU: {contrary} of {len(solved)} sweeps fitted the map better without it: one of the "
            "two is wrong; check imu.lidar_R_imu_deg, units and stamps; if the IMU is right, the "
            "poses are wrong"
        )
    return notes


def _why_vague(updates: Sequence[MapUpdate], largest: float) -> str:
    """A sentence on the largest standard deviation of a position, metres, and whence it comes."""
    squares = [np.trace(one.covariance[3:, 3:]) if one.status.solved else 0.0 for one in updates]
    since = int(np.argmax(np.nan_to_num(squares) >= 0.5 * largest**2))
    why = "other first motions fit as well, or the way was blind or is missing"
    if _MOVED in updates[since].message:
        why = "it was found where no motion had led, and another place may look like that"
    return (
        f"positions are told to {largest:.2g} m at worst (sigma), to most of it from frame "
        f"{since} on: {why}"
    )


def _on_statuses(updates: Sequence[MapUpdate], path: float, few: bool) -> list[str]:
    """A sentence on the frames that no scan fixed, or on those that still moved unless ``few``.

    Degenerate ones put the run in doubt if they are told to be vague, after so many metres.
    """
    odd = [number for number, update in enumerate(updates) if update.status not in _EXPECTED]
    if not odd:
        moving = sum(update.status is FrameStatus.NOT_CONVERGED for update in updates)
        if few or moving <= _TOO_MANY * len(updates):
            return []
        share = f"{moving} of {len(updates)} poses still moved"
        return [f"{share} when solver.iterations ended: try more (not_converged)"]
    doubted = [updates[number] for number in odd if _doubtful(updates[number], path)]
    counts = Counter(updates[number].status for number in odd).most_common()
    statuses = ", ".join(f"{count} {status}" for status, count in counts)
    failed = sum(updates[number].fault is SweepFault.PART_FAILED for number in odd)
    advice = _ADVICE[counts[0][0]] if 2 * failed <= len(odd) else _PART_FAILED
    return [
        f"{DO_NOT_TRUST if len(doubted) > _TOO_MANY * len(updates) else ''}"
        f"{len(odd)} of {len(updates)} poses ({100.0 * len(odd) / len(updates):.0f} %) are not "
        f"fixed by their scans ({statuses}), first that of frame {odd[0]}; {advice}"
    ]


def _doubtful(update: MapUpdate, path: float) -> bool:
    """Whether a pose was not found, or is vague by its covariance."""
    if not update.status.solved:
        return True
    turn, shift = (np.sqrt(np.trace(update.covariance[part, part])) for part in _PARTS)
    return not (turn <= _VAGUE and shift <= _VAGUE * path)
