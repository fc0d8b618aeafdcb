"""Fixes of a GNSS receiver on the keyframes of a run, robust against wrong ones.

A fix ties the pose ``map_T_lidar`` of a keyframe, the pose ``enu_T_map`` of the map on the earth,
and the antenna in the frame of the lidar. Equations: docs/gnss.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.aiding.alignment import align_to_fixes
from loam_gtsam.aiding.fix_selection import FEWEST, LEAST, FixSelection
from loam_gtsam.aiding.placed_fixes import (
    ANTENNA_KEY,
    LARGEST,
    MAP_KEY,
    MEDIAN,
    UPWARD,
    PlacedFixes,
)
from loam_gtsam.aiding.placed_fixes import fix_factor as fix_factor
from loam_gtsam.config import AidingConfig
from loam_gtsam.datasets.decode.aiding import GnssFixes
from loam_gtsam.datasets.decode.geodesy import GeoReference, east_north_up
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.types import (
    BoolArray,
    FloatArray,
    InputError,
    IntArray,
    MapUpdate,
    Trajectory,
    stack_poses,
)

_HEADING = 0.2  # rad: with a larger standard deviation the heading counts as unknown


@dataclass(frozen=True, slots=True, eq=False)
class TiedFixes:
    """What became of the fixes of a run.

    Attributes
    ----------
    reference : where the map is on the earth; None if the fixes were not used
    problem : why they were not; empty if they were
    stamps : (N,) nanoseconds of the fixes that were looked at, one for a keyframe
    used : (N,) whether each was used; a rejected one contradicts the others and the way
    distances : (N,) metres from the way to the fix in the end
    scale : by which the receiver's standard deviations are too small, at least 1
    antenna : (3,) metres, as estimated, in the frame of the lidar
    placed : the fixes that were used, by numbers of keyframes
    antenna_off : by how many of its standard deviations the antenna is not where it was said to be;
        0 if that is chance. It then counts as less certain
    """

    reference: GeoReference | None
    problem: str
    stamps: IntArray
    used: BoolArray
    distances: FloatArray
    scale: float = 1.0
    antenna: FloatArray | None = None
    placed: PlacedFixes | None = None
    antenna_off: float = 0.0

    def __str__(self) -> str:
        """A line."""
        if self.reference is None:
            return f"not used: {self.problem}"
        spread = np.median(self.distances[self.used])
        return (
            f"{self.used.sum()} of {len(self.used)} fixes used, {spread:.2f} m from the way "
            f"(median); x axis of the map {self.reference.heading_deg:.1f} degrees from east"
        )

    @property
    def antenna_problem(self) -> str:
        """A sentence on an antenna that is not where it was said to be; empty if it is."""
        if self.antenna_off == 0.0:
            return ""
        return (
            f"by the fixes the antenna of the GNSS receiver is {self.antenna_off:.0f} standard "
            "deviations from aiding.lidar_t_antenna: measure it (its height as well, which no "
            "motion may tell)"
        )

    def as_dict(self) -> dict[str, Any]:
        """Numbers for a JSON file."""
        reference, antenna = self.reference, self.antenna
        return {
            "problem": self.problem,
            "fixes": len(self.used),
            "used": int(self.used.sum()),
            "rejected_stamps_ns": self.stamps[~self.used].tolist(),
            "sigma_scale": self.scale,
            "lidar_t_antenna": None if antenna is None else antenna.tolist(),
            "antenna_off_sigmas": self.antenna_off,
            "enu": None if reference is None else reference.as_dict(),
        }


def tie(
    graph: PoseGraph,
    updates: Sequence[MapUpdate],
    fixes: GnssFixes,
    config: AidingConfig | None = None,
    up: FloatArray | None = None,
) -> TiedFixes:
    """Tie the keyframes of a complete run to the fixes; the graph then has the better poses.

    Parameters
    ----------
    graph : of the run; as it was if the fixes are not used
    updates : all frames of the run
    config : antenna and noise
    up : (3,) unit vector that points up in the map; None if unknown
    """
    config = config or AidingConfig()
    problem = _Fixes.of(graph, updates, fixes, config)
    if isinstance(problem, str):
        return _refused(problem)
    top = UPWARD if up is None else up
    placed = problem.placed
    start = align_to_fixes(problem.way, placed.enu, placed.sigmas, top, levelled=up is not None)
    if start is None:
        return _refused(
            "the way is too short for the accuracy of the fixes to tell a heading", problem
        )
    if start[1].sum() < FEWEST:
        return _refused(_disagree(start[1]), problem)
    solver = FixSelection(graph, placed, problem.way, up)
    try:
        values, used, scale = solver.robust(start[0])
        placed = placed.of(np.flatnonzero(used), problem.memory[used] * scale**2)
        final = placed.factors(up)
        values = solver.solve(final, values)
        away = values.atPoint3(ANTENNA_KEY) - placed.antennas[0]
        off = float(np.linalg.norm(away) / placed.antenna_sigmas[0])
        off = off if off**2 > LARGEST else 0.0
        if off > 0.0:  # it is not where it was said to be
            wider = placed.antenna_sigmas * off / np.sqrt(MEDIAN)
            placed = replace(placed, antenna_sigmas=wider)
            final = placed.factors(up)
            values = solver.solve(final, values)
        distances = np.linalg.norm(problem.placed.residuals(values), axis=1)
        if used.mean() < LEAST:
            return _refused(_disagree(used), problem, distances)
        whole = gtsam.NonlinearFactorGraph(solver.rest)
        whole.push_back(final)
        covariance = gtsam.Marginals(whole, values).marginalCovariance(MAP_KEY)
    except RuntimeError as error:  # GTSAM's own, as for an indeterminate system
        text = " ".join(str(error).split())[:200]
        return _refused(f"the fixes do not determine where the map is: {text}", problem)
    earth = values.atPose3(MAP_KEY)
    heading = top @ covariance[:3, :3] @ top
    if not heading < _HEADING**2:
        text = f"the heading is known to {np.degrees(np.sqrt(heading)):.0f} degrees only"
        return _refused(text, problem, distances)
    graph.tie(final, values)
    reference = GeoReference(problem.origin, earth.matrix(), np.asarray(covariance))
    antenna = values.atPoint3(ANTENNA_KEY)
    seen = problem.stamps, used, distances, scale, antenna
    return TiedFixes(reference, "", *seen, placed, off)


@dataclass(frozen=True, slots=True, eq=False)
class _Fixes:
    """Fixes with the keyframes that they belong to, one for a keyframe at most."""

    stamps: IntArray
    origin: FloatArray  # (3,)
    placed: PlacedFixes  # with what the odometry adds since the keyframe
    memory: FloatArray  # (N,) how many fixes have the same error
    poses: list[gtsam.Pose3]  # map_T_lidar at the moment of the fix, as the graph has it

    @classmethod
    def of(
        cls, graph: PoseGraph, updates: Sequence[MapUpdate], fixes: GnssFixes, config: AidingConfig
    ) -> _Fixes | str:
        """The fixes that can be used, or what is wrong with them."""
        covariances = np.array(fixes.covariances, np.float64)
        unknown = np.isnan(covariances).any(axis=(1, 2))
        covariances[unknown] = config.gnss_sigma**2 * np.eye(3)
        known = ~unknown | (config.gnss_sigma > 0.0)
        keyframes = graph.keyframes
        placed = [update for update in updates if update.status.has_pose]
        if not keyframes or len(placed) < 2:
            return "the run has no keyframes"
        times = np.array([update.stamp for update in placed], np.int64)
        starts = np.array([keyframe.stamp for keyframe in keyframes], np.int64)
        known &= (fixes.stamps >= times[0]) & (fixes.stamps <= times[-1])
        rows = np.flatnonzero(known)
        after = np.clip(np.searchsorted(starts, fixes.stamps[rows]), 1, max(len(starts) - 1, 1))
        near = np.column_stack([after - 1, np.minimum(after, len(starts) - 1)])
        gaps = np.abs(starts[near] - fixes.stamps[rows][:, None])
        owner, gap = near[np.arange(len(rows)), gaps.argmin(axis=1)], gaps.min(axis=1)
        order = np.lexsort((gap, owner))
        first = np.diff(owner[order], prepend=-1) > 0
        rows, owner = rows[order[first]], owner[order[first]]
        if len(rows) < FEWEST:
            return (
                f"{len(rows)} keyframes have a fix with a covariance, {FEWEST} are needed; the "
                f"receiver has {len(fixes)} fixes, {int(known.sum())} of them within the run and "
                "with a covariance"
            )
        moves, poses = [], []
        for row, number in zip(rows.tolist(), owner.tolist(), strict=True):
            at = _interpolated(placed, times, int(fixes.stamps[row]))
            move = keyframes[number].odom_T_lidar.between(at)
            moves.append(move)
            poses.append(graph.pose(keyframes[number].index).compose(move))
        walk = graph.config.walk**2 * np.array([np.linalg.norm(m.translation()) for m in moves])
        stamps = fixes.stamps[rows]
        origin = np.asarray(fixes.geodetic[rows[0]], np.float64)
        half = 0.5e9 * config.gnss_memory
        alike = np.searchsorted(stamps, stamps + half, "right")
        alike = alike - np.searchsorted(stamps, stamps - half, "left")
        seen = PlacedFixes(
            np.array([keyframes[number].index for number in owner.tolist()], np.int64),
            stack_poses(moves),
            east_north_up(fixes.geodetic[rows], origin),
            covariances[rows] + walk[:, None, None] * np.eye(3),
            np.zeros(len(rows), np.int64),
            np.array([config.lidar_t_antenna], np.float64),
            np.array([config.antenna_sigma], np.float64),
        )
        return cls(stamps, origin, seen, np.maximum(alike, 1).astype(np.float64), poses)

    @property
    def way(self) -> FloatArray:
        """(N, 3) positions of the antenna in the map before the fixes are used."""
        return np.array([pose.transformFrom(self.placed.antennas[0]) for pose in self.poses])


def _disagree(used: BoolArray) -> str:
    return f"only {used.sum()} of {len(used)} fixes agree with each other and with the way"


def _refused(
    problem: str, fixes: _Fixes | None = None, distances: FloatArray | None = None
) -> TiedFixes:
    stamps = np.empty(0, np.int64) if fixes is None else fixes.stamps
    none = np.zeros(len(stamps), np.bool_)
    away = np.full(len(stamps), np.nan) if distances is None else distances
    return TiedFixes(None, problem, stamps, none, away)


def _interpolated(placed: Sequence[MapUpdate], times: IntArray, stamp: int) -> gtsam.Pose3:
    """The mapper's pose at a moment within the run."""
    after = int(np.clip(np.searchsorted(times, stamp), 1, len(times) - 1))
    before, later = placed[after - 1], placed[after]
    if later.stamp <= before.stamp:
        raise InputError("updates: expected the frames of a run in order of time")
    share = (stamp - before.stamp) / (later.stamp - before.stamp)
    return before.map_T_lidar.slerp(share, later.map_T_lidar)


def write_enu(path: str | Path, trajectory: Trajectory, earth: GeoReference) -> None:
    """Write poses in metres east, north and up of the origin, which a comment names (TUM)."""
    latitude, longitude, height = earth.origin.tolist()
    place = f"latitude {latitude:.9f} longitude {longitude:.9f} height {height:.4f} (WGS 84)"
    moved = Trajectory(trajectory.stamps, earth.enu_T_map @ trajectory.map_T_lidar)
    write_tum(path, moved, comments={"origin": place}, pose="enu_T_lidar")
