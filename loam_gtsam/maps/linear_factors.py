"""A user's own factors in a saved map: what they say of its places, as linear equations.

GTSAM cannot write every factor, and nothing that is read from a map may run code. Near the poses
with which a run has ended a factor is its linearisation, and that is numbers, whatever the factor
was.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import gtsam
import numpy as np

from loam_gtsam.factors import checked_factor
from loam_gtsam.loops.keyframes import is_pose_key, pose_key, pose_number
from loam_gtsam.loops.places import Place
from loam_gtsam.types import FloatArray, IntArray, stack_poses

FRAME, NUMBER = -1, -2
"""What stands for the frame of a map, and for a number, where places have numbers."""
_KEYS: dict[int, int] = {FRAME: gtsam.symbol("f", 0), NUMBER: gtsam.symbol("n", 0)}

_Part = tuple[Sequence[int], FloatArray, FloatArray]
"""A factor: numbers of its V variables, blocks (R, V, 6), right side (R,)."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearFactors:
    """Rows ``sum_v A_v e_v = b``, each with a standard deviation of 1.

    ``e_v`` is ``Logmap(at_v^-1 x_v)`` of a pose ``x_v``, or a number, of which the block ``A_v``
    has one column. The poses are those of places, and the frames of maps that were merged into this
    one: what a factor says in the frame of its run is true there, wherever that frame is found to
    be. Numbers are the tangent directions of a user's own variables.

    Attributes
    ----------
    places : (V,) number of the place of each variable; -1 is the frame of a map, -2 a number
    at : (V, 4, 4) the poses for which the rows were made
    rows, variables : (B,) numbers of the row and of the variable of each block, one row after the
        other; rows on the same variables that follow one another are one factor
    blocks : (B, 6) the blocks ``A_v``, rotation first
    right : (R,) right sides ``b``
    """

    places: IntArray
    at: FloatArray
    rows: IntArray
    variables: IntArray
    blocks: FloatArray
    right: FloatArray

    @classmethod
    def of(
        cls, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values,
        moves: Mapping[int, tuple[int, gtsam.Pose3]],
    ) -> LinearFactors:  # fmt: skip
        """Factors near ``values``, on places.

        Parameters
        ----------
        factors : on poses of keyframes, and on variables of a user's own
        values : estimates of all of these
        moves : by the number of a keyframe: number of its place, and the pose of the place, seen
            from the keyframe
        """
        sizes, variables = values.zeroVectors(), _Variables(values, moves)
        parts: list[_Part] = []
        for position in range(factors.size()):
            factor, alone = factors.at(position), gtsam.NonlinearFactorGraph()
            alone.add(factor)
            keys, ordering = list(factor.keys()), gtsam.Ordering()
            for key in keys:
                ordering.push_back(key)
            matrix, right = alone.linearize(values).jacobian(ordering)
            ends = np.cumsum([len(sizes.at(key)) for key in keys])[:-1]
            columns = zip(keys, np.split(matrix, ends, axis=1), strict=True)
            found = [one for key, block in columns for one in variables.of(key, block)]
            blocks = np.stack([block for _, block in found], axis=1)
            parts.append(([number for number, _ in found], blocks, right))
        return cls._of_parts(variables.places, variables.at, parts)

    @classmethod
    def _of_parts(
        cls, places: Sequence[int], at: Sequence[gtsam.Pose3], parts: Sequence[_Part]
    ) -> LinearFactors:
        widths = [len(variables) for variables, _, right in parts for _ in right]
        numbers = [n for variables, _, right in parts for _ in right for n in variables]
        return cls(
            np.array(places, np.int64),
            stack_poses(at),
            np.repeat(np.arange(len(widths)), widths),
            np.array(numbers, np.int64),
            np.concatenate([np.empty((0, 6)), *(blocks.reshape(-1, 6) for _, blocks, _ in parts)]),
            np.concatenate([np.empty(0), *(right for _, _, right in parts)]),
        )

    def _parts(self) -> Iterator[_Part]:
        starts = np.searchsorted(self.rows, np.arange(len(self.right) + 1)).tolist()
        of_row = [self.variables[start:end].tolist() for start, end in pairwise(starts)]
        for numbers, group in groupby(range(len(of_row)), key=of_row.__getitem__):
            rows = list(group)
            blocks = self.blocks[starts[rows[0]] : starts[rows[-1] + 1]]
            yield numbers, blocks.reshape(len(rows), len(numbers), 6), self.right[rows]

    def _at(self) -> list[gtsam.Pose3]:
        return [gtsam.Pose3(pose) for pose in self.at]

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """As factors of GTSAM, on poses of places, and on the variables of :meth:`start`."""
        graph, at = gtsam.NonlinearFactorGraph(), self._at()
        for numbers, blocks, right in self._parts():
            keys = [self._key(number) for number in numbers]
            poses = [None if self.places[n] == NUMBER else at[n] for n in numbers]
            graph.add(_factor(keys, poses, blocks.swapaxes(0, 1), right))
        return graph

    def start(self) -> gtsam.Values:
        """Where the frames and the numbers begin."""
        values = gtsam.Values()
        for number in np.flatnonzero(self.places == FRAME).tolist():
            values.insert(self._key(number), gtsam.Pose3(self.at[number]))
        for number in np.flatnonzero(self.places == NUMBER).tolist():
            values.insert(self._key(number), np.zeros(1))
        return values

    def _key(self, variable: int) -> int:
        place = int(self.places[variable])
        return pose_key(place) if place >= 0 else _KEYS[place] + variable

    def within(
        self, whole_T_map: gtsam.Pose3, places: Sequence[Place], first: int
    ) -> LinearFactors:
        """As they are in a whole of which this map is a part.

        Parameters
        ----------
        whole_T_map : the frame of this map there
        places : of this map
        first : number of the first of them there
        """
        at, frame = self._at(), len(self.places)
        parts: list[_Part] = []
        for numbers, blocks, right in self._parts():
            if (self.places[numbers] == FRAME).any():  # of a map that this one was merged from
                parts.append((numbers, blocks, right))
                continue
            on_poses = self.places[numbers] >= 0
            to_frame = np.stack([at[number].inverse().AdjointMap() for number in numbers])
            turned = -np.einsum("rvi,vij->rj", blocks[:, on_poses], to_frame[on_poses])
            parts.append(([*numbers, frame], np.concatenate([blocks, turned[:, None]], 1), right))
        # The frame is where its run began.
        begin = places[0].map_T_middle
        here = begin.inverse().AdjointMap()
        whiten = places[0].noise.R()
        tie = np.stack([whiten, -whiten @ here], axis=1)
        parts.append(([frame + 1, frame], tie, np.zeros(6)))
        moved = [whole_T_map.compose(pose) for pose in (*at, gtsam.Pose3(), begin)]
        numbered = np.where(self.places >= 0, self.places + first, self.places).tolist()
        return self._of_parts([*numbered, FRAME, first], moved, parts)

    @classmethod
    def joined(cls, several: Sequence[LinearFactors]) -> LinearFactors:
        """The factors of all."""
        places: list[int] = []
        at: list[gtsam.Pose3] = []
        parts: list[_Part] = []
        for one in several:
            shift = len(places)
            for numbers, blocks, right in one._parts():
                parts.append(([number + shift for number in numbers], blocks, right))
            places += one.places.tolist()
            at += one._at()
        return cls._of_parts(places, at, parts)


class _Variables:
    """Variables of linear factors, numbered as they come."""

    def __init__(self, values: gtsam.Values, moves: Mapping[int, tuple[int, gtsam.Pose3]]) -> None:
        self._values, self._moves = values, moves
        self._first: dict[int, int] = {}  # number of the first variable of each key
        self.places: list[int] = []
        self.at: list[gtsam.Pose3] = []

    def of(self, key: int, block: FloatArray) -> list[tuple[int, FloatArray]]:
        """Numbers and blocks (R, 6) of a variable of the graph with the block (R, d)."""
        move = self._moves[pose_number(key)] if is_pose_key(key) else None
        is_new = self._first.setdefault(key, len(self.places)) == len(self.places)
        if is_new and move is None:
            self.places += [NUMBER] * block.shape[1]
            self.at += [gtsam.Pose3()] * block.shape[1]
        elif is_new and move is not None:
            self.places.append(move[0])
            self.at.append(self._values.atPose3(key).compose(move[1]))
        first = self._first[key]
        if move is not None:
            return [(first, block @ move[1].AdjointMap())]
        padding = [(0, 0), (0, 5)]
        columns = np.split(block, block.shape[1], axis=1)
        return [(first + n, np.pad(column, padding)) for n, column in enumerate(columns)]


def _factor(
    keys: Sequence[int], at: Sequence[gtsam.Pose3 | None], blocks: FloatArray, right: FloatArray
) -> gtsam.CustomFactor:
    """A factor from its blocks (V, R, 6): on poses near ``at``, on a number where that is None."""

    def residual(values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        error, jacobians = -right, []
        for key, pose, block in zip(keys, at, blocks, strict=True):
            if pose is None:
                jacobians.append(block[:, :1])
                error = error + block[:, :1] @ values.atVector(key)
            else:
                step = pose.between(values.atPose3(key))
                jacobians.append(block @ gtsam.Pose3.LogmapDerivative(step))
                error = error + block @ gtsam.Pose3.Logmap(step)
        return error, jacobians

    return checked_factor(gtsam.noiseModel.Unit.Create(len(right)), keys, residual)
