"""The adjustment: planes of the map and poses of the sweeps together, by Levenberg-Marquardt.

Each round de-skews the sweeps along the adjusted path, finds the planes anew, and solves for the
poses, the planes eliminated (:mod:`loam_gtsam.refine.elimination`) and all other factors as GTSAM
linearises them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from loam_gtsam.geometry import as_array, symmetric, transform
from loam_gtsam.refine.elimination import (
    Sightings,
    about_planes,
    eliminated,
    refitted,
    seen_directions,
    sightings,
    transformed_moments,
)
from loam_gtsam.refine.surfaces import Planes, find_planes, voxel_sizes
from loam_gtsam.refine.sweeps import Path, SweepPoints, stacked
from loam_gtsam.types import FloatArray, InputError, IntArray, Trajectory

_GOLDEN: FloatArray = np.array([0.8191725, 0.6710436, 0.5497005])
"""Steps of the grid from round to round, as shares of the largest voxel: never the same again."""
_ANCHOR = 1e-4
"""Radians and metres: standard deviation of the first pose if no factor holds any."""
_DAMPING = 1e-6, 1e-12, 1e6
"""Levenberg-Marquardt: first, least and largest share of the diagonal."""
_SLACK = 1e-4
"""Share by which the cost may rise in a step, where directions that are not seen were left out."""
_TOGETHER = 20
"""Poses of which covariances are found in one solve."""
_LEAST_PIVOT = 1e-13
"""Pivot over its diagonal entry below which a direction counts as free."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How the adjustment goes.

    Attributes
    ----------
    rounds : times that planes are searched for
    steps : steps of Levenberg-Marquardt at most in each
    sigma : metres, that a point may have across a surface (``matching.point_sigma``)
    largest, least : metres, edge lengths of the voxels of the first and the last level
    enough : metres and radians; a round that moves no pose by more is the last
    """

    rounds: int = 5
    steps: int = 3
    sigma: float = 0.03
    largest: float = 3.2
    least: float = 0.4
    enough: float = 2e-4

    def __post_init__(self) -> None:
        voxel_sizes(self.largest, self.least)
        if self.rounds < 1 or self.steps < 1 or not 0.0 < self.sigma < np.inf:
            raise InputError(
                f"Settings: expected rounds and steps of 1 or more and a positive sigma, got {self}"
            )


@dataclass(frozen=True, slots=True)
class Round:
    """What one round did.

    Attributes
    ----------
    planes, pairs, points : planes, pairs of a sweep and a plane, and points on planes
    scatter : metres, weighted root mean square of the points across their planes
    shared : metres, see :class:`~loam_gtsam.refine.elimination.Sightings`
    moved : metres, largest step of a pose
    cost_before, cost_after : with the planes of this round
    """

    planes: int
    pairs: int
    points: int
    scatter: float
    shared: float
    moved: float
    cost_before: float
    cost_after: float


@dataclass(frozen=True, eq=False)
class Refined:
    """Adjusted poses and planes.

    Attributes
    ----------
    path : poses of the middles of the sweeps, and the motion about them
    planes : of the last round
    sightings : which sweep saw which of them
    information : (6 N, 6 N) of the poses, planes eliminated, other factors included
    rounds : what each round did
    """

    path: Path
    sweeps: Sequence[SweepPoints]
    planes: Planes
    sightings: Sightings
    information: csc_array
    rounds: tuple[Round, ...] = field(default=())

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses at the reference times of the sweeps."""
        stamps = [sweep.stamp + round(sweep.reference * 1e9) for sweep in self.sweeps]
        poses = [self.path.at(n, sweep.reference) for n, sweep in enumerate(self.sweeps)]
        return Trajectory.from_poses(stamps, poses)

    @cached_property
    def _solver(self) -> Callable[[FloatArray], FloatArray]:
        solver: Callable[[FloatArray], FloatArray] = _factorised(self.information).solve
        return solver

    @cached_property
    def _path_errors(self) -> FloatArray:
        """(N, 6) variances of the motion from the middles to the reference times."""
        errors = self.path.errors(np.array([sweep.reference for sweep in self.sweeps]))
        return errors

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
            away = self.path.at(n, self.sweeps[n].reference).between(pose).AdjointMap()
            turn[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = away
        joint = turn @ joint @ turn.T + np.diag(self._path_errors[list(numbers)].ravel())
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

    def plane_covariances(self) -> FloatArray:
        """(L, 3) variances of the planes, poses given: turns about both axes (rad^2), offset."""
        seen, planes = self.sightings, self.planes
        information = np.zeros((len(planes), 3))
        relative = about_planes(self.path.map_T_middle, planes, seen)
        moments = transformed_moments(relative, planes, seen)
        for column in range(2):
            axis = planes.axes[:, :, 1 + column]
            information[:, column] = np.einsum("ni,nij,nj->n", axis, moments[:, :3, :3], axis)
        information[:, 2] = moments[:, 3, 3]
        return 1.0 / np.maximum(information, 1e-300)


def refine(
    sweeps: Sequence[SweepPoints],
    map_T_middle: FloatArray,
    factors: gtsam.NonlinearFactorGraph | None = None,
    settings: Settings | None = None,
    *,
    keep: FloatArray | None = None,
    for_covariances: gtsam.NonlinearFactorGraph | None = None,
    on_round: Callable[[Round], None] | None = None,
) -> Refined:
    """Adjust the poses of sweeps so that the planes that they see become thin.

    Parameters
    ----------
    sweeps : in the order of their stamps
    map_T_middle : (N, 4, 4) poses of the middles of the sweeps, where the search starts: planes
        that sweeps see farther apart than about ``settings.sigma`` tie nothing
    factors : further factors on the poses, whose keys are ``gtsam.symbol("x", n)``: odometry,
        loops, positions. The first pose is held if no factor is on one pose alone.
    keep : (N, 6, 6) projectors of the poses onto the directions about which the planes are asked,
        all if None; those that drown in noise are left out anyway
        (:func:`~loam_gtsam.refine.elimination.seen_directions`)
    for_covariances : factors that stand for ``factors`` in the covariances, if those are less
        sure than they are given weight
    on_round : called after each round, to show progress

    Raises
    ------
    InputError
        If no plane is seen by three sweeps, some sweep is tied to no other, or a direction of the
        poses is free.
    """
    settings = settings or Settings()
    poses = as_array(map_T_middle, "map_T_middle", (len(sweeps), 4, 4)).copy()
    if len(sweeps) < 3:
        raise InputError(f"refine: expected 3 or more sweeps, got {len(sweeps)}")
    others = _OtherFactors(factors, poses)
    stamps = np.array([sweep.stamp for sweep in sweeps], np.int64)
    sizes = voxel_sizes(settings.largest, settings.least)
    asked = np.eye(6) if keep is None else as_array(keep, "keep", (len(sweeps), 6, 6))
    rounds: list[Round] = []
    for number in range(settings.rounds):
        points, numbers = stacked(Path.through(stamps, poses), sweeps)
        shift = settings.largest * np.modf(number * _GOLDEN)[0]
        in_map = _placed(points, numbers, poses)
        planes = find_planes(in_map, numbers, settings.sigma, sizes, shift)
        seen = sightings(points, numbers, planes)
        _check_ties(seen, others, len(sweeps))
        clear = seen_directions(poses, planes, seen) @ asked
        before, poses_before = None, poses
        damping = _DAMPING[0]
        for _ in range(settings.steps):
            poses, planes, costs, damping = _step(poses, planes, seen, clear, others, damping)
            before = costs[0] if before is None else before
            if costs[0] - costs[1] <= 1e-4 * costs[0]:
                break
        weights = np.maximum(planes.weights, 1e-12)
        scatter = float(np.sqrt(np.average(planes.residuals**2, weights=weights)))
        moved = float(np.linalg.norm(poses[:, :3, 3] - poses_before[:, :3, 3], axis=1).max())
        counts = len(planes), len(seen.sweeps), len(planes.rows)
        assert before is not None
        rounds.append(Round(*counts, scatter, seen.shared, moved, before, costs[1]))
        if on_round is not None:
            on_round(rounds[-1])
        if moved < settings.enough:
            break
    if for_covariances is not None:
        others = _OtherFactors(for_covariances, poses)
    hessian, _ = _equations(poses, planes, seen, clear, others)
    _factorised(hessian)
    path = Path.through(stamps, poses)
    return Refined(path, tuple(sweeps), planes, seen, hessian, tuple(rounds))


def _placed(points: FloatArray, numbers: IntArray, poses: FloatArray) -> FloatArray:
    """Points of all sweeps in the map."""
    placed = np.empty_like(points)
    bounds = np.searchsorted(numbers, np.arange(len(poses) + 1))
    for pose, begin, end in zip(poses, bounds[:-1], bounds[1:], strict=True):
        placed[begin:end] = transform(pose, points[begin:end])
    return placed


class _OtherFactors:
    """Factors of GTSAM on the poses, and the anchor that they may need."""

    def __init__(self, factors: gtsam.NonlinearFactorGraph | None, poses: FloatArray) -> None:
        self.graph = gtsam.NonlinearFactorGraph() if factors is None else factors
        self._count = len(poses)
        self.ties: list[list[int]] = []
        held: list[int] = []
        for place in range(self.graph.size()):
            keys: list[int] = self.graph.at(place).keys()
            numbers = [gtsam.symbolIndex(key) for key in keys]
            known = [gtsam.symbol("x", number) for number in numbers if number < len(poses)]
            if known != keys:
                raise InputError(
                    f"factors: factor {place} has a key that is not x0 to x{len(poses) - 1}, the "
                    "poses of the sweeps"
                )
            self.ties.append(numbers)
            held += numbers if len(numbers) == 1 else []
        self.held = held or [0]
        self._anchor = None if held else gtsam.Pose3(poses[0])

    def _values(self, poses: FloatArray) -> gtsam.Values:
        values = gtsam.Values()
        for number, pose in enumerate(poses):
            values.insert(gtsam.symbol("x", number), gtsam.Pose3(pose))
        return values

    def error(self, poses: FloatArray) -> float:
        """Cost of the factors."""
        total = 0.0 if not self.graph.size() else float(self.graph.error(self._values(poses)))
        if self._anchor is not None:
            off = gtsam.Pose3.Logmap(self._anchor.between(gtsam.Pose3(poses[0])))
            total += 0.5 * float(off @ off) / _ANCHOR**2
        return total

    def equations(self, poses: FloatArray) -> tuple[csc_array, FloatArray]:
        """Information (6 N, 6 N) and gradient (6 N,)."""
        rows, columns, entries = [], [], []
        gradient = np.zeros((self._count, 6))
        values = self._values(poses)
        for place in range(self.graph.size()):
            linear: Any = self.graph.at(place).linearize(values)
            if linear is None:
                continue
            numbers = [gtsam.symbolIndex(key) for key in linear.keys()]  # noqa: SIM118
            block = linear.augmentedInformation()
            at = np.concatenate([6 * n + np.arange(6) for n in numbers])
            rows.append(np.repeat(at, len(at)))
            columns.append(np.tile(at, len(at)))
            entries.append(block[:-1, :-1].ravel())
            gradient[numbers] -= block[:-1, -1].reshape(-1, 6)
        if self._anchor is not None:
            off = gtsam.Pose3.Logmap(self._anchor.between(gtsam.Pose3(poses[0])))
            gradient[0] += off / _ANCHOR**2
            rows.append(np.arange(6))
            columns.append(np.arange(6))
            entries.append(np.full(6, _ANCHOR**-2))
        where = np.concatenate(rows), np.concatenate(columns)
        size = 6 * self._count
        matrix = coo_array((np.concatenate(entries), where), shape=(size, size))
        return csc_array(matrix), gradient.ravel()


def _check_ties(seen: Sightings, others: _OtherFactors, count: int) -> None:
    """InputError unless every pose is tied to one that is held."""
    if not len(seen.sweeps):
        raise InputError(
            "refine: no plane is seen by three sweeps; are the poses those of the sweeps, and does "
            "Settings.sigma allow for their errors?"
        )
    one = [number for tie in others.ties for number in tie[:-1]]
    two = [number for tie in others.ties for number in tie[1:]]
    planes = int(seen.planes.max()) + 1
    ends = np.append(seen.sweeps, one), np.append(count + seen.planes, two)
    links = coo_array((np.ones(len(ends[0])), ends), shape=(count + planes,) * 2)
    group = connected_components(links, directed=False)[1]
    loose = np.flatnonzero(~np.isin(group[:count], group[others.held]))
    if len(loose):
        raise InputError(
            f"refine: {len(loose)} sweeps, number {loose[0]} the first, share no plane and no "
            "factor with those that are held; leave them out, or give factors that tie them"
        )


def _equations(
    poses: FloatArray, planes: Planes, seen: Sightings, keep: FloatArray, others: _OtherFactors
) -> tuple[csc_array, FloatArray]:
    reduced = eliminated(poses, planes, seen, keep)
    information, gradient = others.equations(poses)
    return csc_array(reduced.hessian + information), reduced.gradient + gradient


def _step(
    poses: FloatArray,
    planes: Planes,
    seen: Sightings,
    keep: FloatArray,
    others: _OtherFactors,
    damping: float,
) -> tuple[FloatArray, Planes, tuple[float, float], float]:
    """One step of Levenberg-Marquardt: poses, planes, cost before and after, damping."""
    planes, before = refitted(poses, planes, seen)
    before += others.error(poses)
    hessian, gradient = _equations(poses, planes, seen, keep, others)
    slack = 1.0 + (0.0 if (keep == np.eye(6)).all() else _SLACK)
    diagonal = hessian.diagonal()
    while damping <= _DAMPING[2]:
        solver = splu(csc_array(hessian + diags_array(damping * diagonal)), **_SYMMETRIC)
        step = solver.solve(-gradient).reshape(-1, 6)
        moved = np.array(
            [
                gtsam.Pose3(pose).retract(delta).matrix()
                for pose, delta in zip(poses, step, strict=True)
            ]
        )
        fitted, after = refitted(moved, planes, seen)
        after += others.error(moved)
        if np.isfinite(after) and after <= slack * before:
            return moved, fitted, (before, after), max(0.1 * damping, _DAMPING[1])
        damping = max(10.0 * damping, 1e-9)
    return poses, planes, (before, before), damping


_SYMMETRIC: dict[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True},
}


def _factorised(information: csc_array) -> Any:
    """Sparse factors of the information; InputError if it leaves a direction free."""
    diagonal = information.diagonal()
    try:
        factors = splu(information, **_SYMMETRIC)
        smallest = float((factors.U.diagonal()[factors.perm_c] / diagonal).min())
    except RuntimeError:
        smallest = 0.0
    if not smallest > _LEAST_PIVOT:
        raise InputError(
            "refine: planes and factors leave a direction of the poses free; give factors that fix "
            "it, as the odometry does"
        )
    return factors
