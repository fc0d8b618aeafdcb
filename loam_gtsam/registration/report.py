"""What the mapper says about a frame: its update, messages, seconds per stage."""

from __future__ import annotations

import time
from dataclasses import replace

import gtsam
import numpy as np

from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.registration.odometry import Guess
from loam_gtsam.registration.solvers import Solution
from loam_gtsam.types import FrameStatus, MapUpdate, TiltPrior


def report(
    sweep: MovingSweep,
    result: Guess,
    status: FrameStatus,
    message: str,
    clock: Clock,
    solution: Solution | None,
    tilt: TiltPrior = TiltPrior.NONE,
) -> MapUpdate:
    """What is known about a frame.

    Parameters
    ----------
    sweep : with the motion it was de-skewed with
    result : pose and velocity at the reference time
    solution : at the middle of the sweep; None if there was no solve
    """
    update = MapUpdate(
        stamp=sweep.reference_stamp,
        map_T_lidar=result.map_T_lidar,
        status=status,
        message=message,
        n_not_finite=sweep.not_finite,
        n_edges=sweep.n_edges,
        n_planes=sweep.n_planes,
        twist=result.twist,
        sweep_motion=sweep.motion,
        tilt_prior=tilt,
        timings=clock.seconds,
    )
    if solution is None:
        return update
    # The solve is about the middle of the sweep; a right perturbation there is, at the reference
    # time, the same one seen through the motion between the two.
    to_middle = sweep.middle_T_reference(result.twist).AdjointMap()
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
    seen = seen.seen_from(sweep.middle_T_reference(result.twist).inverse())
    return replace(
        update,
        localizability=seen.aligned,
        directions=seen.directions,
        direction_information=seen.information,
        axis_localizability=seen.axes(),
    )


def named(solution: Solution) -> str:
    """The weak directions in words: metres and rad in lidar axes."""
    assert solution.localizability is not None
    names = []
    for direction in solution.localizability.directions[: solution.n_weak]:
        unit = direction / direction[np.abs(direction).argmax()]  # its sign means nothing
        parts = zip(unit, ("rx", "ry", "rz", "x", "y", "z"), strict=True)
        names.append(" ".join(f"{value:+.2f} {axis}" for value, axis in parts if abs(value) > 0.05))
    return " or ".join(names)


def way(first: gtsam.Pose3, second: gtsam.Pose3) -> str:
    """How far it is from one pose to another, in words."""
    turn = gtsam.Rot3.Logmap(first.rotation().between(second.rotation()))
    return f"{first.range(second):.2f} m and {np.degrees(np.linalg.norm(turn)):.1f} degrees"


class Clock:
    """Adds up seconds per stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Book the time since the last lap on a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._since
        self._since = now
