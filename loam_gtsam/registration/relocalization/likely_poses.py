"""Poses from which a sweep may have been taken, by a likelihood field of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from loam_gtsam.geometry import voxel_keys
from loam_gtsam.registration.matches import spread_rows
from loam_gtsam.registration.relocalization.fits import APART
from loam_gtsam.types import BoolArray, FloatArray, IntArray

_CELL = 0.5  # metres: half the reach of a match, which is then the neighbouring cell
_SPACING = 2  # cells between trial positions: 1 m, from which a solve converges
_BLOCK = 4  # trial positions along either side of a square of these that is bounded as one
_TURN = np.radians(5.0)  # half of it moves a point at 15 m by little more than a cell
_REACH = 40.0  # largest horizontal distance of a point that is scored, metres
_HEIGHT = 10.0  # largest height above or below the lidar of a point that is scored, metres
_SAMPLE = (60, 140)  # number of edge and plane features that are scored
MORE_EDGES = (500, 140)
"""The same if rare ones count more: ten of 500 edges may lie on posts."""
_CHANCES = 20_000  # trial poses, or so, that tell how rarely a point hits
_RAREST = 200  # number of points, those that hit most rarely, that are scored if rare ones count


def sample_features(
    edges: FloatArray, planes: FloatArray, most: tuple[int, int] = _SAMPLE
) -> FloatArray:
    """(N, 3) some evenly spread features of a sweep, at ``most`` so many of each kind, metres."""
    pairs = zip((edges, planes), most, strict=True)
    return np.concatenate([points[spread_rows(len(points), count)] for points, count in pairs])


def one_per_cell(map_points: FloatArray) -> FloatArray:
    """(K, 3) one of the points of each cell of the field: :class:`Field` needs no others."""
    _, first = np.unique(voxel_keys(map_points, _CELL), return_index=True)
    return map_points[first]


@dataclass(frozen=True, eq=False)
class Field:
    """Cells around a place, and which of them hold points of a map.

    Attributes
    ----------
    radius : metres around the place at which trial poses are scored
    shape : number of cells along each axis
    corner : (3,) metres, map frame, of the cell in the middle
    hits : what a point scores twice over in each cell: 2 if it holds map points, 1 beside, or 0
    """

    radius: float
    shape: tuple[int, int, int]
    corner: FloatArray
    hits: NDArray[np.uint8]

    @classmethod
    def around(cls, map_points: FloatArray, place: gtsam.Pose3, radius: float) -> Field:
        """The field of map points (M, 3), metres, for trial poses within ``radius`` metres."""
        # On each side there is a cell that is not scored: what grows beyond it does not matter.
        reached = int(np.ceil((_REACH + radius) / _CELL)) + 2 + _SPACING * (_BLOCK - 1)
        shape = (2 * reached, 2 * reached, 2 * int(_HEIGHT / _CELL) + 3)
        corner = _CELL * np.floor(np.asarray(place.translation()) / _CELL)
        cells = _cells(map_points, corner, shape)
        sides = zip(cells, shape, strict=True)
        inside = np.logical_and.reduce([(row >= 0) & (row < side) for row, side in sides])
        held = np.zeros(np.prod(shape), np.uint8)
        held[np.ravel_multi_index(tuple(row[inside] for row in cells), shape)] = 1
        grown = held.copy()
        for step in (shape[1] * shape[2], shape[2], 1):
            before, after = grown[:-step].copy(), grown[step:].copy()
            grown[step:] |= before
            grown[:-step] |= after
        return cls(radius, shape, corner, held + grown)

    @cached_property
    def most(self) -> NDArray[np.uint8]:
        """The most that a point scores at the trial positions of a block, from its first one on."""
        most = self.hits.copy()
        for step in (self.shape[1] * self.shape[2], self.shape[2]):
            for many in (_SPACING, 2 * _SPACING):  # to the end of a block
                most[: -many * step] = np.maximum(most[: -many * step], most[many * step :])
        return most

    def shifts(self, cells: IntArray) -> IntArray:
        """By which the cell of a point moves with so many cells (2, S) along x and y."""
        moved: IntArray = (cells[0] * self.shape[1] + cells[1]) * self.shape[2]
        return moved


def likely_poses(
    points: FloatArray,
    fields: Sequence[Field],
    around: Sequence[gtsam.Pose3],
    count: int,
    most_turn: float = np.pi,
    *,
    rare: bool = False,
    as_well: float | None = None,
    least: float = 0.0,
    apart: tuple[float, float] = APART,
) -> list[gtsam.Pose3]:
    """Poses from which a sweep may have been taken, the likeliest first.

    Trial poses lie on a grid of 1 m and 5 degrees around each centre, with the height and the tilt
    of the centre. The score of a trial pose is the number of points in cells that hold map points;
    a point in a cell beside such a cell counts half (the likelihood field of Thrun, Burgard and
    Fox, Probabilistic Robotics, section 6.4, in its simplest form).

    Parameters
    ----------
    points : (N, 3) metres, lidar frame, a few hundred of the sweep
    fields : of the map, one around each centre
    around : centres of the search, ``map_T_lidar``
    count : largest number of poses
    most_turn : largest rotation against the centre about the vertical axis, rad
    rare : whether a point counts minus the logarithm of the share of the trial poses at which it
        hits: ground, which fits everywhere, tells nothing, and a post, which fits at few places,
        tells much. For two sweeps that follow each other: what is new or gone is rare as well.
    as_well : part of the best score from which another trial pose is as good: of those the nearest
        to its centre is the likeliest. Along a corridor all fit alike. None takes the best
    least : part of the best score that every pose must have
    apart : metres and rad, one of which at least is between any two of the poses
    """
    places = zip(fields, around, strict=True)
    tried = [_trials(points, field, pose, most_turn) for field, pose in places]
    scored, weights = np.arange(len(points)), np.ones(len(points), np.float32)
    if rare:
        chance = np.mean([trials.chance() for trials in tried], axis=0)
        hit = np.flatnonzero(chance)
        scored = hit[np.argsort(chance[hit], kind="stable")[:_RAREST]]
        weights = -np.log(chance[scored]).astype(np.float32)
    scores = _scores(tried, scored, weights, least)
    moves = np.concatenate([trials.moves for trials in tried])
    owner = np.repeat(np.arange(len(tried)), [len(trials.moves) for trials in tried])
    enough = scores > least * scores.max(initial=0.0)
    scores, moves, owner = scores[enough], moves[enough], owner[enough]
    best: list[gtsam.Pose3] = []
    away = np.linalg.norm(moves[:, :2], axis=1)
    at = np.array([pose.translation() for pose in around]).reshape(-1, 3)[owner]
    at[:, :2] += moves[:, :2]
    while len(best) < count and scores.max(initial=0.0) > 0.0:
        top = int(scores.argmax())
        if as_well is not None:
            good = np.flatnonzero(scores >= as_well * scores[top])
            good = good[away[good] == away[good].min()]
            top = int(good[scores[good].argmax()])
        x, y, turn = moves[top]
        pose = around[owner[top]]
        rotation = gtsam.Rot3.Yaw(turn).compose(pose.rotation())
        best.append(gtsam.Pose3(rotation, pose.translation() + np.array([x, y, 0.0])))
        turned = np.abs((moves[:, 2] - turn + np.pi) % (2.0 * np.pi) - np.pi)
        taken = (np.linalg.norm(at - at[top], axis=1) < apart[0]) & (turned < apart[1])
        scores[taken] = 0.0
    return best


class _Trials(NamedTuple):
    """Trial poses around a centre: at each of R yaws the same S positions, in B blocks."""

    field: Field
    near: BoolArray  # (N,) whether a point is near enough to be scored
    bases: IntArray  # (R, N) cells of the points, for each yaw
    shifts: IntArray  # (S,) by which these move with the trial positions
    corners: IntArray  # (B,) the same for the first position of each block
    blocks: IntArray  # (S,) block of each position
    moves: FloatArray  # (R S, 3) offsets of the trial poses: x and y in metres, yaw in rad

    def chance(self) -> FloatArray:
        """Share of what each point (N,) would score if it hit at every trial pose."""
        some = self.shifts[:: max(1, len(self.moves) // _CHANCES), None]
        hits = [self.field.hits[base + some].mean(axis=0) for base in self.bases]
        share: FloatArray = 0.5 * np.mean(hits, axis=0) * self.near
        return share

    def bounds(self, points: IntArray, weights: NDArray[np.float32]) -> FloatArray:
        """(R, B) what no trial pose of a block scores more than, by some of the points."""
        bases, weights = self._near(points, weights)
        return np.array([self.field.most[base + self.corners[:, None]] @ weights for base in bases])

    def scores(
        self, points: IntArray, weights: NDArray[np.float32], wanted: BoolArray
    ) -> FloatArray:
        """(R S,) score of the trial poses of the ``wanted`` blocks (R, B), and 0 of the others."""
        bases, weights = self._near(points, weights)
        scores = np.zeros((len(bases), len(self.shifts)))
        for row, base, blocks in zip(scores, bases, wanted, strict=True):
            at = np.flatnonzero(blocks[self.blocks])
            row[at] = self.field.hits[base + self.shifts[at, None]] @ weights
        return scores.ravel()

    def _near(
        self, points: IntArray, weights: NDArray[np.float32]
    ) -> tuple[IntArray, NDArray[np.float32]]:
        """Cells (R, M) and weights (M,) of those of the points that are scored."""
        near = self.near[points]
        return self.bases[:, points[near]], weights[near]


def _scores(
    tried: Sequence[_Trials], points: IntArray, weights: NDArray[np.float32], least: float
) -> FloatArray:
    """Scores of all trial poses, one centre after the other; 0 below ``least`` of the best one.

    Branch and bound: most blocks of trial poses are ruled out at once, if any may be.
    """
    wanted = [np.ones((len(trials.bases), len(trials.corners)), np.bool_) for trials in tried]
    if least > 0.0:
        bounds = [trials.bounds(points, weights) for trials in tried]
        best = [bound == bound.max() for bound in bounds]
        pairs = zip(tried, best, strict=True)
        known = max(trials.scores(points, weights, most).max() for trials, most in pairs)
        wanted = [bound >= least * known for bound in bounds]
    pairs = zip(tried, wanted, strict=True)
    return np.concatenate([trials.scores(points, weights, some) for trials, some in pairs])


def _trials(
    points: FloatArray, field: Field, map_T_lidar: gtsam.Pose3, most_turn: float
) -> _Trials:
    """The trial poses around a centre."""
    steps = int(field.radius / (_SPACING * _CELL))
    level = points @ map_T_lidar.rotation().matrix().T
    near = (np.linalg.norm(level[:, :2], axis=1) < _REACH) & (np.abs(level[:, 2]) < _HEIGHT)
    places = np.divmod(np.arange((2 * steps + 1) ** 2), 2 * steps + 1) - np.array([[steps]])
    places = places[:, (places**2).sum(axis=0) <= (steps + 0.5) ** 2]
    corners = places // _BLOCK * _BLOCK
    corners, blocks = np.unique(field.shifts(_SPACING * corners), return_inverse=True)
    metres = _SPACING * _CELL * places.T
    most = int(np.ceil(min(most_turn, np.pi) / _TURN))
    turns = _TURN * np.arange(-most, most + (most_turn < np.pi))
    yaws = [gtsam.Rot3.Yaw(turn).matrix() for turn in turns.tolist()]
    turned = np.where(near[:, None], level, 0.0) @ np.transpose(yaws, (0, 2, 1))
    from_lidar = field.corner - np.asarray(map_T_lidar.translation())
    bases = np.ravel_multi_index(_cells(turned, from_lidar, field.shape), field.shape)
    moves = np.column_stack([np.tile(metres, (len(turns), 1)), np.repeat(turns, len(metres))])
    shifts = field.shifts(_SPACING * places)
    return _Trials(field, near, bases, shifts, corners, blocks, moves)


def _cells(
    points: FloatArray, corner: FloatArray, shape: tuple[int, int, int]
) -> tuple[IntArray, ...]:
    """Cells of points (..., 3) along each axis of a field, in the middle of which a corner is."""
    # By component: numpy is several times slower along an axis of three.
    axes = zip(np.ascontiguousarray(np.moveaxis(points, -1, 0)), corner, shape, strict=True)
    return tuple(
        np.floor((row - start) / _CELL).astype(np.int64) + side // 2 for row, start, side in axes
    )
