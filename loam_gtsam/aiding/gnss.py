"""Fixes of a GNSS receiver on the keyframes of a run, robust against wrong ones.

A fix ties the pose ``map_T_lidar`` of a keyframe, the pose ``enu_T_map`` of the map on the earth,
and the antenna in the frame of the lidar. Which fixes are right is found by graduated non-convexity
(Yang et al., RA-L 2020). Equations: docs/gnss.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.aiding.alignment import align
from loam_gtsam.config import AidingConfig
from loam_gtsam.datasets.decode.aiding import GnssFixes
from loam_gtsam.datasets.decode.geodesy import GeoReference, east_north_up
from loam_gtsam.factors import checked_factor
from loam_gtsam.geometry import cross_matrix
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.loops.keyframes import noise_model, pose_key
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

MAP_KEY: int = gtsam.symbol("g", 0)
"""Key of the pose ``enu_T_map``, which a graph has once fixes tie it."""
ANTENNA_KEY: int = gtsam.symbol("a", 0)
"""Key of the position of the first receiver's antenna in the frame of the lidar, metres."""
_LARGEST = 16.27  # of chi squared with three degrees of freedom, 0.1 % of right fixes exceed it
MEDIAN = 2.366  # of chi squared with three degrees of freedom
_STEP = 1.6  # by which graduated non-convexity sharpens from solve to solve
_LEAST = 0.5  # share of the fixes that must agree
_HEADING = 0.2  # rad: with a larger standard deviation the heading counts as unknown
_LEVEL, _LEANING = 0.02, 0.3  # rad: of the z axis of the map, if the IMU levelled it, and if not
_UPWARD = np.array([0.0, 0.0, 1.0])
_FEWEST = 5  # fixes


@dataclass(frozen=True, slots=True, eq=False)
class PlacedFixes:
    """Fixes that are believed, each seen from a pose of a graph.

    Attributes
    ----------
    poses : (N,) numbers of the poses
    pose_T_lidar : (N, 4, 4) the lidar at the moment of each fix, seen from its pose
    enu : (N, 3) metres east, north and up of an origin on the earth
    covariances : (N, 3, 3) of them, m^2, wide enough for errors that last
    receivers : (N,) number of the receiver of each
    antennas : (R, 3) metres, where the antenna of each receiver was said to be, lidar frame
    antenna_sigmas : (R,) standard deviations of these, metres
    """

    poses: IntArray
    pose_T_lidar: FloatArray
    enu: FloatArray
    covariances: FloatArray
    receivers: IntArray
    antennas: FloatArray
    antenna_sigmas: FloatArray

    def __len__(self) -> int:
        return len(self.poses)

    def factors(self, up: FloatArray | None) -> gtsam.NonlinearFactorGraph:
        """As factors; ``up`` (3,) is upward in the map, or None if no IMU levelled it.

        They are on the poses, :data:`MAP_KEY`, and the antennas, whose keys begin at
        :data:`ANTENNA_KEY`.
        """
        graph = gtsam.NonlinearFactorGraph()
        columns = self.poses.tolist(), self.receivers.tolist(), self.enu, self.covariances
        for pose, receiver, enu, covariance, move in zip(*columns, self.pose_T_lidar, strict=True):
            noise, moved = noise_model(covariance, 3), gtsam.Pose3(move)
            graph.add(fix_factor(pose_key(pose), enu, noise, moved, ANTENNA_KEY + receiver))
        level = gtsam.noiseModel.Isotropic.Sigma(2, _LEANING if up is None else _LEVEL)
        top = gtsam.Unit3(_UPWARD if up is None else up)
        graph.add(gtsam.AttitudeFactorPose3(MAP_KEY, gtsam.Unit3(_UPWARD), level, top))
        for number, (place, sigma) in enumerate(self._antennas()):
            known = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
            graph.add(gtsam.PriorFactorPoint3(ANTENNA_KEY + number, place, known))
        return graph

    def start(self, enu_T_map: gtsam.Pose3) -> gtsam.Values:
        """Where :data:`MAP_KEY` and the antennas begin."""
        values = gtsam.Values()
        values.insert(MAP_KEY, enu_T_map)
        for number, (place, _) in enumerate(self._antennas()):
            values.insert(ANTENNA_KEY + number, place)
        return values

    def residuals(self, values: gtsam.Values) -> FloatArray:
        """(N, 3) metres from the fixes to where the antennas are."""
        earth = values.atPose3(MAP_KEY)
        antennas = [values.atPoint3(ANTENNA_KEY + n) for n in range(len(self.antennas))]
        columns = self.poses.tolist(), self.receivers.tolist(), self.pose_T_lidar
        places = [
            earth.transformFrom(
                values.atPose3(pose_key(pose)).transformFrom(
                    gtsam.Pose3(move).transformFrom(antennas[receiver])
                )
            )
            for pose, receiver, move in zip(*columns, strict=True)
        ]
        return np.array(places).reshape(-1, 3) - self.enu

    def squared(self, values: gtsam.Values) -> FloatArray:
        """(N,) squared Mahalanobis distances of the fixes from where the antennas are."""
        away = self.residuals(values)
        solved = np.linalg.solve(self.covariances, away[:, :, None])[:, :, 0]
        return np.asarray(np.einsum("ij,ij->i", away, solved))

    def offsets(self, values: gtsam.Values) -> FloatArray:
        """(R, 3) mean error of each receiver, metres, where it is beyond chance; else zeros.

        The antennas count as where they were said to be, for they take over what they can of such
        an error.
        """
        said = gtsam.Values(values)
        for number, (place, _) in enumerate(self._antennas()):
            said.update(ANTENNA_KEY + number, place)
        away, found = self.residuals(said), np.zeros((len(self.antennas), 3))
        for receiver in np.unique(self.receivers).tolist():
            rows = np.flatnonzero(self.receivers == receiver)
            mean, chance = away[rows].mean(axis=0), self.covariances[rows].mean(axis=0) / len(rows)
            chance += self.antenna_sigmas[receiver] ** 2 * np.eye(3)
            if mean @ np.linalg.solve(chance, mean) > _LARGEST:
                found[receiver] = mean
        return found

    def allowing_for(self, offsets: FloatArray) -> PlacedFixes:
        """With covariances that allow for offsets (R, 3) of the receivers.

        An error that all N fixes of a receiver share has N times its square in that of each.
        """
        counts = np.bincount(self.receivers, minlength=len(self.antennas))
        shared = (counts * np.sum(offsets**2, axis=1))[self.receivers]
        return replace(self, covariances=self.covariances + shared[:, None, None] * np.eye(3))

    def of(self, rows: IntArray, spread: FloatArray | float = 1.0) -> PlacedFixes:
        """Some of the fixes, their covariances times ``spread``, one for each or all."""
        times = np.broadcast_to(spread, len(rows))[:, None, None]
        return replace(
            self,
            poses=self.poses[rows],
            pose_T_lidar=self.pose_T_lidar[rows],
            enu=self.enu[rows],
            covariances=times * self.covariances[rows],
            receivers=self.receivers[rows],
        )

    def seen_from(self, others: Mapping[int, tuple[int, gtsam.Pose3]]) -> PlacedFixes:
        """The fixes on some poses, as seen from others: the number of each, and its pose there."""
        kept = self.of(np.flatnonzero(np.isin(self.poses, list(others))))
        found = [others[number] for number in kept.poses.tolist()]
        return replace(
            kept,
            poses=np.array([number for number, _ in found], np.int64),
            pose_T_lidar=stack_poses(move.inverse() for _, move in found) @ kept.pose_T_lidar,
        )

    @classmethod
    def joined(cls, parts: Sequence[PlacedFixes]) -> PlacedFixes:
        """The fixes of all parts, whose receivers are numbered as one."""
        columns = {item.name: [getattr(part, item.name) for part in parts] for item in fields(cls)}
        return cls(**{name: np.concatenate(column) for name, column in columns.items()})

    def _antennas(self) -> list[tuple[FloatArray, float]]:
        return list(zip(self.antennas, self.antenna_sigmas.tolist(), strict=True))


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
    """

    reference: GeoReference | None
    problem: str
    stamps: IntArray
    used: BoolArray
    distances: FloatArray
    scale: float = 1.0
    antenna: FloatArray | None = None
    placed: PlacedFixes | None = None

    def __str__(self) -> str:
        """A line."""
        if self.reference is None:
            return f"not used: {self.problem}"
        spread = np.median(self.distances[self.used])
        return (
            f"{self.used.sum()} of {len(self.used)} fixes used, {spread:.2f} m from the way "
            f"(median); x axis of the map {self.reference.heading_deg:.1f} degrees from east"
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
            "enu": None if reference is None else reference.as_dict(),
        }


def fix_factor(
    pose_key: int,
    enu: FloatArray,
    noise: gtsam.noiseModel.Base,
    keyframe_T_lidar: gtsam.Pose3 | None = None,
    antenna_key: int = ANTENNA_KEY,
) -> gtsam.CustomFactor:
    """A measured position of the antenna: on a pose, :data:`MAP_KEY` and that of the antenna.

    GTSAM's GPSFactorArmCalib has no unknown pose of the map, in whose frame the poses are.

    Parameters
    ----------
    pose_key : of ``map_T_lidar`` of the keyframe
    enu : (3,) metres east, north, up
    noise : of its three rows
    keyframe_T_lidar : the lidar at the moment of the fix, seen from the keyframe
    """
    moved = gtsam.Pose3() if keyframe_T_lidar is None else keyframe_T_lidar
    turned, start = moved.rotation().matrix(), moved.translation()

    def residual(values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        pose, earth = values.atPose3(pose_key), values.atPose3(MAP_KEY)
        there, outer = pose.rotation().matrix(), earth.rotation().matrix()
        seen = turned @ values.atPoint3(antenna_key) + start
        place = there @ seen + pose.translation()
        whole = outer @ there
        by_pose = np.hstack([-whole @ cross_matrix(seen), whole])
        by_earth = np.hstack([-outer @ cross_matrix(place), outer])
        error = outer @ place + earth.translation() - enu
        return error, [by_pose, by_earth, whole @ turned]

    return checked_factor(noise, [pose_key, MAP_KEY, antenna_key], residual)


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
    top = _UPWARD if up is None else up
    placed = problem.placed
    start = align(problem.way, placed.enu, problem.sigmas, top, levelled=up is not None)
    if start is None:
        return _refused(
            "the way is too short for the accuracy of the fixes to tell a heading", problem
        )
    if start[1].sum() < _FEWEST:
        return _refused(_disagree(start[1]), problem)
    solver = _Solver(graph, problem, up)
    try:
        values, used, scale = solver.robust(start[0])
        placed = placed.of(np.flatnonzero(used), problem.memory[used] * scale**2)
        final = placed.factors(up)
        values = solver.solve(final, values)
        distances = np.linalg.norm(problem.placed.residuals(values), axis=1)
        if used.mean() < _LEAST:
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
    return TiedFixes(reference, "", problem.stamps, used, distances, scale, antenna, placed)


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
        if len(rows) < _FEWEST:
            return (
                f"{len(rows)} keyframes have a fix with a covariance, {_FEWEST} are needed; the "
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

    @property
    def sigmas(self) -> FloatArray:
        """(N,) metres, along the worst axis."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.placed.covariances)[:, -1]))


class _Solver:
    """The graph with fixes, each of which has a weight."""

    def __init__(self, graph: PoseGraph, fixes: _Fixes, up: FloatArray | None) -> None:
        self._fixes, self._up = fixes.placed, up
        self.rest = graph.active_factors()
        self._values = graph.values

    def factors(self, spread: FloatArray, used: BoolArray) -> gtsam.NonlinearFactorGraph:
        """Factors of the ``used`` (N,) fixes, whose covariances are times ``spread`` (U,)."""
        return self._fixes.of(np.flatnonzero(used), spread).factors(self._up)

    def solve(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        """The poses that fit all factors best."""
        graph = gtsam.NonlinearFactorGraph(self.rest)
        graph.push_back(factors)
        params = gtsam.LevenbergMarquardtParams()
        params.setVerbosityLM("SILENT")
        params.setMaxIterations(20)
        return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()

    def robust(self, enu_T_map: FloatArray) -> tuple[gtsam.Values, BoolArray, float]:
        """Estimates, (N,) which fixes are right, and by how much their sigmas are too small."""
        fixes = self._fixes
        values = gtsam.Values(self._values)
        values.insert(fixes.start(gtsam.Pose3(enu_T_map)))
        everyone = np.ones(len(fixes), np.bool_)
        squared = fixes.squared(values)
        sharp = max(1.0, 2.0 * float(squared.max()) / _LARGEST)
        while True:
            weights = (sharp * _LARGEST / (squared + sharp * _LARGEST)) ** 2
            values = self.solve(self.factors(1.0 / np.maximum(weights, 1e-9), everyone), values)
            squared = fixes.squared(values)
            if sharp == 1.0:
                break
            sharp = max(1.0, sharp / _STEP)
        scale = max(1.0, float(np.median(squared)) / MEDIAN)
        used = squared <= scale * _LARGEST
        for _ in range(5):
            if used.sum() < _FEWEST:
                break
            spread = np.full(int(used.sum()), scale)
            values = self.solve(self.factors(spread, used), values)
            before, used = used, fixes.squared(values) <= scale * _LARGEST
            if (before == used).all():
                break
        if not used.any():
            raise RuntimeError("no fix agrees with the way")
        return values, used, float(np.sqrt(scale))


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
