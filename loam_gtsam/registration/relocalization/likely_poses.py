"""Poses from which a sweep may have been taken, by a likelihood field of the map."""

from __future__ import annotations

from collections.abc import Sequence
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
_TURN = np.radians(5.0)  # half of it moves a point at 15 m by little more than a cell
_REACH = 40.0  # largest horizontal distance of a point that is scored, metres
_HEIGHT = 10.0  # largest height above or below the lidar of a point that is scored, metres
_SAMPLE = (60, 140)  # number of edge and plane features that are scored
_CHANCES = 20_000  # trial poses, or so, that tell how rarely a point hits
_RAREST = 200  # number of points, those that hit most rarely, that are scored if rare ones count


def sample_features(
    edges: FloatArray, planes: FloatArray, most: tuple[int, int] = _SAMPLE
) -> FloatArray:
    """(N, 3) some evenly spread features of a sweep, at ``most`` so many of each kind, metres."""
    pairs = zip((edges, planes), most, strict=True)
    return np.concatenate([points[spread_rows(len(points), count)] for points, count in pairs])


def one_per_cell(map_points: FloatArray) -> FloatArray:
    """(K, 3) one of the points of each cell of the field: :func:`likely_poses` needs no others."""
    _, first = np.unique(voxel_keys(map_points, _CELL), return_index=True)
    return map_points[first]


def likely_poses(
    points: FloatArray,
    map_points: FloatArray | Sequence[FloatArray],
    around: Sequence[gtsam.Pose3],
    radius: float,
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
    map_points : (M, 3) metres, of the map; or those around each centre
    around, radius : centres of the search, ``map_T_lidar``, and metres around each
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
    held = [map_points] * len(around) if isinstance(map_points, np.ndarray) else map_points
    places = zip(held, around, strict=True)
    tried = [_trials(points, near, pose, radius, most_turn) for near, pose in places]
    scored, weights = np.arange(len(points)), np.ones(len(points), np.float32)
    if rare:
        chance = np.mean([trials.chance() for trials in tried], axis=0)
        hit = np.flatnonzero(chance)
        scored = hit[np.argsort(chance[hit], kind="stable")[:_RAREST]]
        weights = -np.log(chance[scored]).astype(np.float32)
    scores = np.concatenate([trials.scores(scored, weights) for trials in tried])
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
    """Trial poses around a centre, and the field of cells that hold map points."""

    field: NDArray[np.uint8]  # 2 in a cell that holds some, 1 beside it, 0 elsewhere
    near: BoolArray  # (N,) whether a point is near enough to be scored
    bases: IntArray  # (R, N) cells of the points, for each yaw
    shifts: IntArray  # (S,) by which these move with the trial positions
    moves: FloatArray  # (R S, 3) offsets of the trial poses: x and y in metres, yaw in rad

    def chance(self) -> FloatArray:
        """Share of what each point (N,) would score if it hit at every trial pose."""
        some = self.shifts[:: max(1, len(self.moves) // _CHANCES), None]
        hits = [self.field[base + some].mean(axis=0) for base in self.bases]
        share: FloatArray = 0.5 * np.mean(hits, axis=0) * self.near
        return share

    def scores(self, points: IntArray, weights: NDArray[np.float32]) -> FloatArray:
        """Score of each trial pose by some of the points."""
        near = self.near[points]
        points, weights = points[near], weights[near]
        scores = np.empty((len(self.bases), len(self.shifts)))
        for row, base in zip(scores, self.bases[:, points], strict=True):
            row[:] = self.field[base + self.shifts[:, None]] @ weights
        return scores.ravel()


def _trials(
    points: FloatArray,
    map_points: FloatArray,
    map_T_lidar: gtsam.Pose3,
    radius: float,
    most_turn: float,
) -> _Trials:
    """The trial poses around a centre."""
    steps = int(radius / (_SPACING * _CELL))
    size = 2 * (int(np.ceil((_REACH + radius) / _CELL)) + 2)
    shape = (size, size, 2 * (int(_HEIGHT / _CELL) + 1))
    centre = np.asarray(map_T_lidar.translation())
    corner = _CELL * np.floor(centre / _CELL)
    cells = _cells(map_points - corner, shape).T
    sides = zip(cells, shape, strict=True)
    inside = np.logical_and.reduce([(row >= 0) & (row < end) for row, end in sides])
    held = np.zeros(shape, np.uint8)
    held[tuple(cells[:, inside])] = 1
    field = (held + _grown(held)).ravel()

    level = points @ map_T_lidar.rotation().matrix().T
    near = (np.linalg.norm(level[:, :2], axis=1) < _REACH) & (np.abs(level[:, 2]) < _HEIGHT)
    ahead, aside = np.divmod(np.arange((2 * steps + 1) ** 2), 2 * steps + 1) - np.array([[steps]])
    close = ahead**2 + aside**2 <= (steps + 0.5) ** 2
    ahead, aside = ahead[close], aside[close]
    shifts = _SPACING * (ahead * shape[1] + aside) * shape[2]
    metres = _SPACING * _CELL * np.column_stack([ahead, aside])
    most = int(np.ceil(min(most_turn, np.pi) / _TURN))
    turns = _TURN * np.arange(-most, most + (most_turn < np.pi))
    yaws = [gtsam.Rot3.Yaw(turn).matrix() for turn in turns.tolist()]
    turned = np.where(near[:, None], level, 0.0) @ np.transpose(yaws, (0, 2, 1))
    turned += centre - corner
    bases = np.ravel_multi_index(tuple(np.moveaxis(_cells(turned, shape), -1, 0)), shape)
    moves = np.column_stack([np.tile(metres, (len(turns), 1)), np.repeat(turns, len(shifts))])
    return _Trials(field, near, bases, shifts, moves)


def _grown(held: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """1 in every cell that is held, or touches one that is, by a corner at least."""
    grown = held.copy()
    for axis in range(held.ndim):
        before, after = grown.copy().swapaxes(0, axis), grown.swapaxes(0, axis)
        after[1:] |= before[:-1]
        after[:-1] |= before[1:]
    return grown


def _cells(points: FloatArray, shape: tuple[int, int, int]) -> IntArray:
    """Cells of points, counted from the middle of the field."""
    cells: IntArray = np.floor(points / _CELL).astype(np.int64) + np.array(shape) // 2
    return cells
