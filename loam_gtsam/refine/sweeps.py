"""The points of the sweeps, and where they were measured: a path that follows the adjusted poses.

Unlike the mapper's features, points on surfaces are no centroids: the mean of the points in a voxel
of the lidar's frame moves with the lidar, and an adjustment of all sweeps would take that for a
motion (in a corridor 0.7 mm a sweep).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.config import Config, FeatureConfig
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.geometry import as_array, as_points, as_vector, cross
from loam_gtsam.types import (
    BoolArray,
    Features,
    FeatureSweep,
    FloatArray,
    FrameStatus,
    InputError,
    IntArray,
    MapUpdate,
    Scan,
    Sweep,
)

_NEAR_EDGES = 20.0
"""Metres from the lidar within which edges are used: a post that is farther away is met by a beam
or two, and the guess of its width puts its axis some millimetres too near, for every post."""
_NEAR = 10
"""Sweeps before and after one over which errors of the path are averaged."""
_WITHIN: FloatArray = np.linspace(-1.0, 1.0, 9)
"""Times of points, over half of a sweep, at which is looked what the path misses."""
_CHANCE = 1.0 + np.sqrt(2.0 / (2.0 * _NEAR + 1.0))
"""Times a variance that the mean square of so many errors reaches, a standard deviation above."""
_GAP = 2.5
"""Sweeps, as the median from one to the next, across which no velocity is taken."""


@dataclass(frozen=True, slots=True, eq=False)
class SweepPoints:
    """Points of one sweep on edges and smooth surfaces, as they were measured.

    Attributes
    ----------
    stamp : nanoseconds of the middle of the sweep, to which its pose belongs
    points : (N, 3) metres, lidar frame, each at its own time
    seconds : (N,) from the middle; all zero if the points are de-skewed already
    reference : seconds from the middle to the reference time, for which poses are reported
    edges : so many of the points, the first ones, are on edges, and the others on surfaces
    """

    stamp: int
    points: FloatArray
    seconds: FloatArray
    reference: float = 0.0
    edges: int = 0

    def __post_init__(self) -> None:
        points = as_points(self.points, "SweepPoints.points")
        if not 0 <= self.edges <= len(points):
            raise InputError(
                f"SweepPoints.edges: expected 0 to {len(points)}, the number of points, got "
                f"{self.edges}"
            )
        object.__setattr__(self, "points", points)
        seconds = as_vector(self.seconds, "SweepPoints.seconds", len(points))
        object.__setattr__(self, "seconds", seconds)

    @property
    def is_edge(self) -> BoolArray:
        """(N,) whether points are on edges."""
        return np.arange(len(self.points)) < self.edges

    def chosen(self, rows: BoolArray) -> SweepPoints:
        """Some of the points (N,)."""
        edges = int(np.count_nonzero(rows[: self.edges]))
        return replace(self, points=self.points[rows], seconds=self.seconds[rows], edges=edges)


def sweep_points(features: Features, config: Config, most: int = 3000) -> SweepPoints:
    """Edges near the lidar, and at most ``most`` plane points, evenly spread over the sweep."""
    first, end = features.span
    moving = config.deskew.enabled and end > first
    middle = 0.5 * (first + end) if moving else 0.0
    count = len(features.planes)
    order = np.argsort(features.plane_times, kind="stable")
    rows = order[np.linspace(0, count - 1, min(most, count)).astype(int)]
    near = np.linalg.norm(features.edges, axis=1) < _NEAR_EDGES
    points = np.concatenate([features.edges[near], features.planes[rows]])
    times = np.concatenate([features.edge_times[near], features.plane_times[rows]])
    seconds = times - middle if moving else np.zeros(len(times))
    stamp = features.stamp + round(middle * 1e9)
    return SweepPoints(stamp, points, seconds, -middle, int(np.count_nonzero(near)))


def extract_points(sweep: Sweep, config: Config, most: int = 3000) -> SweepPoints:
    """The points of a sweep of a data set, not averaged.

    Of sweeps that come as features, only those on surfaces: LOAM's edges show up to a beam too
    late, always to one side. For the same reason ``features.beam_width`` is that of the default.

    Raises
    ------
    SweepError
        If the sweep has no usable points.
    InputError
        If the sweep could not be read.
    """
    if isinstance(sweep, FeatureSweep):
        points = sweep_points(sweep.features, config, most)
        return points.chosen(~points.is_edge)
    if not isinstance(sweep, Scan):
        raise InputError(f"sweep: expected a Scan or a FeatureSweep, got {type(sweep).__name__}")
    every = config.changed(
        {"features.plane_voxel": 0.0, "features.beam_width": FeatureConfig().beam_width}
    )
    return sweep_points(extract_features(sweep, every), config, most)


class Sway(NamedTuple):
    """What is too fast for polynomials through the poses of N sweeps: a sine, by axis.

    Attributes
    ----------
    squares : (N, 6) its mean square
    turns : (N, 6) rad by which it goes on from one sweep to the next, at most pi
    seconds : (N,) from one sweep to the next
    reach : (N, 2) sweeps before and after each, as far as its polynomial goes through their poses
    """

    squares: FloatArray
    turns: FloatArray
    seconds: FloatArray
    reach: IntArray

    @classmethod
    def of(cls, powers: FloatArray, reach: IntArray, seconds: float) -> Sway:
        """The sine that has the fourth and sixth differences of the poses of a run.

        Two more differences make it ``2 - 2 cos(turn)`` times as large. If sweeps are too few to
        tell the turn, it is pi, the worst; with less than five nothing is known, and it is zero.
        """
        fourth = powers[:, 3] * 24.0 * seconds**4
        sixth = np.zeros_like(fourth)
        sixth[1:-1] = fourth[2:] - 2.0 * fourth[1:-1] + fourth[:-2]
        whole = (reach == 2).all(axis=1)
        amid = whole & np.roll(whole, 1) & np.roll(whole, -1)
        amid[[0, -1]] = False
        numbers = np.flatnonzero(whole) if whole.any() else np.zeros(1, np.int64)
        nearest = numbers[np.abs(np.arange(len(whole))[:, None] - numbers).argmin(axis=1)]
        fourths, sixths = (
            _mean_near(squares, np.repeat(counted[:, None], 6, axis=1))[nearest]
            for squares, counted in ((fourth**2, whole), (sixth**2, amid))
        )
        grown = np.full_like(fourths, 4.0)
        told = (sixths > 0.0) & (fourths > 0.0)
        grown[told] = np.minimum(np.sqrt(sixths[told] / fourths[told]), 4.0)
        every = np.full(len(whole), seconds)
        return cls(fourths / grown**4, np.arccos(1.0 - 0.5 * grown), every, reach)

    def missed(self, seconds: FloatArray) -> FloatArray:
        """(N, 6) mean squares of what the polynomials miss of it at times (N,) from the middles."""
        times, missed = seconds / self.seconds, np.empty_like(self.squares)
        for reach in np.unique(self.reach, axis=0):
            rows = (self.reach == reach).all(axis=1)
            nodes = np.arange(-reach[0], reach[1] + 1)
            degrees = np.arange(len(nodes))[:, None]
            shares = np.linalg.solve(nodes.astype(np.float64) ** degrees, times[rows] ** degrees)
            turns = self.turns[rows]
            led = np.einsum("kn,nak->na", shares, np.exp(1j * turns[:, :, None] * nodes))
            true = np.exp(1j * turns * times[rows, None])
            missed[rows] = self.squares[rows] * np.abs(true - led) ** 2
        return missed


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """The motion about the middles of N sweeps, from the poses around each.

    Attributes
    ----------
    map_T_middle : (N, 4, 4)
    powers : (N, 4, 6) coefficients of t, t^2, t^3, t^4, with t the seconds from the middle: the
        lidar is at ``map_T_middle Exp(xi(t))``, tangent order of the package
    sway : what these miss
    starts : numbers of the first sweeps of the runs, which have clocks of their own, and of other
        stretches between which no motion is known
    """

    map_T_middle: FloatArray
    powers: FloatArray
    sway: Sway
    starts: tuple[int, ...] = (0,)

    @classmethod
    def through(
        cls, stamps: IntArray, map_T_middle: FloatArray, starts: Sequence[int] = (0,)
    ) -> Path:
        """Through the pose of each sweep and up to two neighbours of its run on either side.

        A sweep in the middle of others has a polynomial of degree four through five poses; at a gap
        in time, where the neighbours of one side are missing, the degree is at most two. A sweep
        without neighbours is at rest.

        Parameters
        ----------
        stamps : (N,) nanoseconds, increasing in each run
        map_T_middle : (N, 4, 4) run after run
        starts : numbers of the first sweeps of the runs
        """
        poses = as_array(map_T_middle, "map_T_middle", (len(stamps), 4, 4))
        rows = _rows(starts, len(poses))
        found = [_polynomials(stamps[some], poses[some]) for some in rows]
        powers = np.concatenate([part[0] for part in found])
        sways = zip(*(part[1] for part in found), strict=True)
        return cls(poses, powers, Sway(*map(np.concatenate, sways)), tuple(starts))

    def motion(self, number: int, seconds: FloatArray) -> FloatArray:
        """``xi`` (M, 6) at times (M,) from the middle of a sweep."""
        found: FloatArray = (seconds[:, None] ** np.arange(1, 5)) @ self.powers[number]
        return found

    def deskewed(self, number: int, sweep: SweepPoints) -> FloatArray:
        """Points of a sweep as seen from its middle, (N, 3) metres."""
        if not sweep.seconds.any():
            return sweep.points
        return _moved(sweep.points, self.motion(number, sweep.seconds))

    def at(self, number: int, seconds: float) -> gtsam.Pose3:
        """``map_T_lidar`` so many seconds from the middle of a sweep."""
        step = self.motion(number, np.array([seconds]))[0]
        return gtsam.Pose3(self.map_T_middle[number]).compose(gtsam.Pose3.Expmap(step))


def check_placed(updates: Sequence[MapUpdate]) -> None:
    """InputError for frames whose poses mean nothing: none was solved, or the first are lost."""
    statuses = [update.status for update in updates]
    begin = next((number for number, status in enumerate(statuses) if status.solved), 0)
    if len(updates) > 1 and not any(status.solved for status in statuses):
        raise InputError(f"updates: expected frames that were solved, got none of {len(updates)}")
    if FrameStatus.LOST in statuses[:begin] and FrameStatus.FIRST not in statuses:
        raise InputError(
            f"updates: the first {begin} frames were not found in a map (localise), and their "
            f"poses mean nothing; give dataset.part({begin}) and updates[{begin}:]"
        )


def path_starts(found: Sequence[BoolArray]) -> list[int]:
    """Numbers of the first sweeps of paths: of runs, and of stretches that were ``found`` or not.

    No motion is known of a stretch that was not, nor to it or from it.
    """
    begins = [np.diff(one.astype(np.int8), prepend=2) != 0 for one in found]
    return np.flatnonzero(np.concatenate(begins)).tolist()


def _rows(starts: Sequence[int], count: int) -> list[slice]:
    """The sweeps of each run."""
    bounds = [*starts, count]
    if bounds[0] != 0 or (np.diff(bounds[:-1]) <= 0).any() or bounds[-2] > count:
        raise InputError(
            f"starts: expected 0 and then increasing numbers of the {count} sweeps, got {starts}"
        )
    return [slice(*pair) for pair in pairwise(bounds)]


def _polynomials(stamps: IntArray, poses: FloatArray) -> tuple[FloatArray, Sway]:
    """``powers`` and ``sway`` of one run."""
    count = len(poses)
    seconds = (stamps - stamps[:1]) * 1e-9
    steps = np.diff(seconds)
    if not (steps > 0.0).all():
        raise InputError("stamps: expected increasing nanoseconds, got others; sort the sweeps")
    linked = steps <= _GAP * np.median(steps) if count > 1 else np.zeros(0, np.bool_)
    stretch = np.concatenate([[0], np.cumsum(~linked)])
    frames = [gtsam.Pose3(pose) for pose in poses]
    powers, reach = np.zeros((count, 4, 6)), np.zeros((count, 2), np.int64)
    for k in range(count):
        near = [n for n in range(max(k - 2, 0), min(k + 3, count)) if stretch[n] == stretch[k]]
        near.remove(k)
        near = [near[n] for n in np.argsort(np.abs(np.array(near) - k), kind="stable")]
        near = near[: 4 if len(near) == 4 else 2]
        degrees = np.arange(1, len(near) + 1)
        if len(near):
            away = np.array([gtsam.Pose3.Logmap(frames[k].between(frames[n])) for n in near])
            matrix = (seconds[near] - seconds[k])[:, None] ** degrees
            powers[k, : len(near)] = np.linalg.solve(matrix, away)
            reach[k] = k - min(*near, k), max(*near, k) - k
    return powers, Sway.of(powers, reach, float(np.median(steps)) if count > 1 else 1.0)


def _mean_near(values: FloatArray, counted: BoolArray) -> FloatArray:
    """(N, 6) means over those of the sweeps near by that count (N, 6); zero if none does."""
    window = np.ones(2 * _NEAR + 1)
    summed, counts = (
        np.stack([np.convolve(column, window)[_NEAR:-_NEAR] for column in columns.T], axis=1)
        for columns in (np.where(counted, values, 0.0), counted.astype(np.float64))
    )
    means: FloatArray = summed / np.maximum(counts, 1.0)
    return means


class ReferenceSteps(NamedTuple):
    """How the lidar moved from the middles of N sweeps to their reference times.

    Attributes
    ----------
    beyond : (N, 6) of the motion, from where a path leads, tangent order of the package
    variances : (N, 6) of the poses there: what is not known of the motion, and as much for the
        points, which were taken along the path and so misplace the middle
    """

    beyond: FloatArray
    variances: FloatArray

    @classmethod
    def along(cls, path: Path, sweeps: Sequence[SweepPoints]) -> ReferenceSteps:
        """By a path alone."""
        unknown = np.full((len(sweeps), 6), np.inf)
        return cls.told(path, sweeps, [gtsam.Pose3()] * len(sweeps), unknown)

    @classmethod
    def told(
        cls, path: Path, sweeps: Sequence[SweepPoints], steps: Sequence[gtsam.Pose3],
        variances: FloatArray,
    ) -> ReferenceSteps:  # fmt: skip
        """By a path, and by ``steps`` as a run had them, with their ``variances`` (N, 6).

        An IMU feels what is too fast for a path through one pose per sweep. The steps are farther
        from the path than their own errors make them by what this misses; each has its share by
        these variances. Those of what steps do not tell are not finite.
        """
        seconds = np.array([sweep.reference for sweep in sweeps])
        missed, known = path.sway.missed(seconds), np.isfinite(variances)
        halves = np.array([np.abs(sweep.seconds).max(initial=0.0) for sweep in sweeps])
        within = np.mean([path.sway.missed(part * halves) for part in _WITHIN], axis=0)
        beyond = np.zeros_like(missed)
        for n in np.flatnonzero(known.any(axis=1)).tolist():
            led = path.motion(n, seconds[n : n + 1])[0]
            beyond[n] = gtsam.Pose3.Logmap(gtsam.Pose3.Expmap(led).between(steps[n]))
        rows = _rows(path.starts, len(missed))
        by_chance = _CHANCE * variances
        near = [_mean_near(beyond[some] ** 2 - by_chance[some], known[some]) for some in rows]
        missed = np.maximum(missed, np.concatenate(near))
        share = missed / np.maximum(missed + variances, np.finfo(float).tiny)
        return cls(share * beyond, (1.0 - share) * (missed + within))


def _moved(points: FloatArray, motions: FloatArray) -> FloatArray:
    """Points (N, 3), each moved by ``Exp`` of its own tangent vector (N, 6)."""
    axis, way, point = motions[:, :3].T.copy(), motions[:, 3:].T, points.T.copy()
    angle = np.maximum(np.sqrt((axis * axis).sum(axis=0)), 1e-9)
    sine = np.sin(angle) / angle
    versine = 2.0 * (np.sin(0.5 * angle) / angle) ** 2
    rest = np.where(angle < 1e-2, 1.0 / 6.0 - angle**2 / 120.0, (1.0 - sine) / angle**2)
    turned = cross(axis, point)
    across = cross(axis, way)
    moved = point + sine * turned + versine * cross(axis, turned)
    moved += way + versine * across + rest * cross(axis, across)
    result: FloatArray = np.ascontiguousarray(moved.T)
    return result


class Stack(NamedTuple):
    """Points of many sweeps.

    Attributes
    ----------
    points : (N, 3) metres, as seen from the middles of the sweeps
    sweeps : (N,) numbers of these, ascending
    is_edge : (N,) whether they are on edges, and not on smooth surfaces
    """

    points: FloatArray
    sweeps: IntArray
    is_edge: BoolArray

    @classmethod
    def of(cls, parts: Sequence[tuple[int, FloatArray, BoolArray]]) -> Stack:
        """Of the number, the points and ``is_edge`` of each sweep."""
        numbers = np.repeat([part[0] for part in parts], [len(part[1]) for part in parts])
        points = np.concatenate([np.empty((0, 3)), *(part[1] for part in parts)])
        is_edge = np.concatenate([np.zeros(0, np.bool_), *(part[2] for part in parts)])
        return cls(points, numbers.astype(np.int64), is_edge)


def stacked(path: Path, sweeps: Sequence[SweepPoints]) -> Stack:
    """Points of all sweeps, each as seen from the middle of its sweep."""
    return Stack.of([(n, path.deskewed(n, one), one.is_edge) for n, one in enumerate(sweeps)])
