"""The update of a frame: its values, its messages, and the seconds per stage."""

from __future__ import annotations

import time
from dataclasses import replace
from zlib import crc32

import gtsam
import numpy as np

from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.registration.degeneracy import spanned
from loam_gtsam.registration.solvers import Solution
from loam_gtsam.types import TANGENT, Features, FrameStatus, MapUpdate, SweepFault, TiltPrior

_STILL = 0.01  # metres or rad below which a lidar stands: a noise of zero leaves the points alike


def make_update(
    posed: PosedSweep,
    map_T_lidar: gtsam.Pose3,
    status: FrameStatus,
    message: str,
    solution: Solution | None = None,
    tilt: TiltPrior = TiltPrior.NONE,
) -> MapUpdate:
    """The update of a frame, without covariance and timings.

    ``posed`` has the final motion, ``map_T_lidar`` is of the reference time, ``solution`` of the
    middle of the sweep.
    """
    sweep = posed.sweep
    update = MapUpdate(
        stamp=sweep.reference_stamp,
        map_T_lidar=map_T_lidar,
        status=status,
        message=message,
        n_not_finite=sweep.not_finite,
        n_edges=sweep.n_edges,
        n_planes=sweep.n_planes,
        middle_stamp=sweep.stamp,
        map_T_middle=posed.map_T_middle(map_T_lidar),
        twist=posed.twist,
        acceleration=np.zeros(6) if sweep.acceleration is None else sweep.acceleration,
        sweep_motion=sweep.motion,
        tilt_prior=tilt,
    )
    if solution is None:
        return update
    # The solution belongs to the middle of the sweep, the update to the reference time.
    to_middle = posed.middle_T_reference.AdjointMap()
    update = replace(
        update,
        n_edge_matches=len(solution.matches.edges),
        n_plane_matches=len(solution.matches.planes),
        iterations=solution.iterations,
        solver_iterations=solution.solver_iterations,
        error_before=solution.error_before,
        error_after=solution.error_after,
        information=to_middle.T @ solution.information @ to_middle,
    )
    seen = solution.localizability
    if seen is None:
        return update
    seen = seen.seen_from(posed.middle_T_reference.inverse())
    return replace(
        update,
        localizability=seen.aligned,
        directions=seen.directions,
        direction_information=seen.information,
        axis_localizability=seen.axes(),
    )


def problem_of(features: Features, alike: MapUpdate | None = None) -> tuple[str, SweepFault] | None:
    """The reason why features cannot be used, as a sentence and as a fault; None if usable.

    ``alike`` is the update of the sweep before, if that had the same points: a lidar that stands
    may see the same once more.
    """
    points = features.edges, features.planes, features.edge_times, features.plane_times
    told = features.edge_prominence, features.edge_sigmas  # infinite ones say something
    unknown = any(part is not None and np.isnan(part).any() for part in told)
    if unknown or not all(np.isfinite(part).all() for part in points):
        return "features of the sweep are NaN or infinite", SweepFault.NOT_FINITE
    if not len(features.edges) + len(features.planes):
        return "the sweep has no features", SweepFault.NO_FEATURES
    if alike is not None and _moves(alike, features.stamp):
        message = "the points are those of the sweep before, though the lidar moves: a copy of it"
        return message, SweepFault.REPEATED
    return None


def checksum(features: Features) -> int:
    """A number that features of other points, but for one of 4 billion, do not have."""
    return crc32(features.planes.tobytes(), crc32(features.edges.tobytes()))


def _moves(last: MapUpdate, stamp: int) -> bool:
    """Whether a lidar that goes on as in a sweep sees other points at the time of a stamp."""
    return float(np.linalg.norm(last.twist)) * abs(stamp - last.stamp) * 1e-9 > _STILL


def status_of(solution: Solution, message: str) -> tuple[FrameStatus, str]:
    """Status and message of a solved frame; the message begins with ``message``."""
    status, problem = FrameStatus.OK, ""
    if not solution.converged:
        status = FrameStatus.NOT_CONVERGED
        problem = f"the pose still moved after {solution.iterations} associations"
    if solution.weak is not None:
        status = FrameStatus.DEGENERATE
        weak = weak_directions_in_words(solution)
        problem = f"weakly constrained: {weak}; no better known than the expected motion"
    return status, "; ".join(filter(None, (message, problem)))


def weak_directions_in_words(solution: Solution) -> str:
    """The degenerate directions of a solution: ``x, z (2 directions)``, in lidar axes.

    One that is along no single axis is told by its parts, in metres and rad: ``x -0.31 y``.
    """
    assert solution.weak is not None
    ways = spanned(solution.weak).T
    for row in range(len(ways)):  # each is to have an axis that the others have not
        ways[row:] = ways[row:][np.argsort(-np.abs(ways[row:]).max(axis=1), kind="stable")]
        axis = int(np.abs(ways[row]).argmax())
        unit = ways[row] / ways[row, axis]
        ways = ways - np.outer(ways[:, axis], unit)
        ways[row] = unit
    names = []
    # Positions first: these are asked for more often.
    mains = np.abs(ways).argmax(axis=1).tolist()
    for main, unit in sorted(zip(mains, ways, strict=True), key=lambda pair: (pair[0] + 3) % 6):
        parts = enumerate(zip(unit, TANGENT, strict=True))
        rest = [f" {v:+.2f} {axis}" for i, (v, axis) in parts if i != main and abs(v) > 0.05]
        names.append(TANGENT[main] + "".join(rest))
    count = f"{len(names)} direction" + "s" * (len(names) > 1)
    return f"{', '.join(names)} ({count})"


def distance_in_words(first: gtsam.Pose3, second: gtsam.Pose3) -> str:
    """The distance between two poses in words: metres and degrees."""
    turn = gtsam.Rot3.Logmap(first.rotation().between(second.rotation()))
    return f"{first.range(second):.2f} m and {np.degrees(np.linalg.norm(turn)):.1f} degrees"


class Clock:
    """A stopwatch that adds up the seconds of each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._since
        self._since = now
