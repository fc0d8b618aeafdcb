"""A user's own factors in a saved map: what they say of its places, as linear equations.

GTSAM cannot write every factor, and nothing that is read from a map may run code. Near the poses
with which a run has ended a factor is its linearisation, and that is numbers, whatever the factor
was. Variables of a user's own are eliminated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from loam_gtsam.factors import checked_factor
from loam_gtsam.geometry import symmetric
from loam_gtsam.loops.keyframes import is_pose_key, noise_model, pose_key, pose_number
from loam_gtsam.loops.places import Place
from loam_gtsam.types import FloatArray, IntArray, stack_poses

FRAME = -1
"""What stands for the frame of a map where places have numbers."""
_FRAME_KEY: int = gtsam.symbol("f", 0)

_Part = tuple[Sequence[int], FloatArray, FloatArray]
"""A factor: numbers of its V poses, blocks (R, V, 6), right side (R,)."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearFactors:
    """Factors ``sum_v A_v Logmap(at_v^-1 x_v) - b`` on poses ``x_v``, with a sigma of 1 each row.

    The poses are those of places, and the frames of maps that were merged into this one: what a
    factor says in the frame of its run is true there, wherever that frame is found to be.

    Attributes
    ----------
    places : (V,) number of the place of each pose; -1 is the frame of a map
    at : (V, 4, 4) the poses for which the factors were made
    rows, poses : (B,) numbers of the row and of the pose of each block, one row after the other;
        rows on the same poses that follow one another are one factor
    blocks : (B, 6) the blocks ``A_v``, rotation first
    right : (R,) right sides ``b``
    """

    places: IntArray
    at: FloatArray
    rows: IntArray
    poses: IntArray
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
        found = [_linear(group, values, moves) for group in _groups(factors)]
        keyframes = sorted({keyframe for used, _, _ in found for keyframe in used})
        pose = {keyframe: number for number, keyframe in enumerate(keyframes)}
        parts: list[_Part] = [
            ([pose[keyframe] for keyframe in used], blocks, right) for used, blocks, right in found
        ]
        return cls._of_parts(
            [moves[keyframe][0] for keyframe in keyframes],
            [values.atPose3(pose_key(k)).compose(moves[k][1]) for k in keyframes],
            parts,
        )

    @classmethod
    def _of_parts(
        cls, places: Sequence[int], at: Sequence[gtsam.Pose3], parts: Sequence[_Part]
    ) -> LinearFactors:
        widths = [len(poses) for poses, _, right in parts for _ in right]
        numbers = [number for poses, _, right in parts for _ in right for number in poses]
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
        of_row = [self.poses[start:end].tolist() for start, end in pairwise(starts)]
        for numbers, group in groupby(range(len(of_row)), key=of_row.__getitem__):
            rows = list(group)
            blocks = self.blocks[starts[rows[0]] : starts[rows[-1] + 1]]
            yield numbers, blocks.reshape(len(rows), len(numbers), 6), self.right[rows]

    def _at(self) -> list[gtsam.Pose3]:
        return [gtsam.Pose3(pose) for pose in self.at]

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """As factors of GTSAM, on poses of places, and on those of :meth:`start`."""
        graph, at = gtsam.NonlinearFactorGraph(), self._at()
        for numbers, blocks, right in self._parts():
            graph.add(_factor([self._key(n) for n in numbers], [at[n] for n in numbers],
                              blocks.swapaxes(0, 1), right))  # fmt: skip
        return graph

    def start(self) -> gtsam.Values:
        """Where the frames begin."""
        values = gtsam.Values()
        for number in np.flatnonzero(self.places == FRAME).tolist():
            values.insert(self._key(number), gtsam.Pose3(self.at[number]))
        return values

    def _key(self, pose: int) -> int:
        place = int(self.places[pose])
        return _FRAME_KEY + pose if place == FRAME else pose_key(place)

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
            to_frame = np.stack([at[number].inverse().AdjointMap() for number in numbers])
            turned = -np.einsum("rvi,vij->rj", blocks, to_frame)
            parts.append(([*numbers, frame], np.concatenate([blocks, turned[:, None]], 1), right))
        # The frame is where its run began.
        begin = places[0].map_T_middle
        here = begin.inverse().AdjointMap()
        noise = noise_model(symmetric(here @ places[0].covariance @ here.T))
        whiten = noise.R()
        tie = np.stack([whiten, -whiten @ here], axis=1)
        parts.append(([frame + 1, frame], tie, np.zeros(6)))
        moved = [whole_T_map.compose(pose) for pose in (*at, gtsam.Pose3(), begin)]
        numbers = np.where(self.places == FRAME, FRAME, self.places + first).tolist()
        return self._of_parts([*numbers, FRAME, first], moved, parts)

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


def _groups(factors: gtsam.NonlinearFactorGraph) -> Iterator[gtsam.NonlinearFactorGraph]:
    """The factors, together if they share a variable of a user's own."""
    count, links = factors.size(), []
    others: dict[int, int] = {}
    for number in range(count):
        keys: list[int] = factors.at(number).keys()
        links += [(number, others.setdefault(key, count + len(others)))
                  for key in keys if not is_pose_key(key)]  # fmt: skip
    ends, size = np.array(links, np.int64).reshape(-1, 2).T, count + len(others)
    graph = coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(size, size))
    label = connected_components(graph, directed=False)[1][:count]
    for group in dict.fromkeys(label.tolist()):
        together = gtsam.NonlinearFactorGraph()
        for number in np.flatnonzero(label == group).tolist():
            together.add(factors.at(number))
        yield together


def _linear(
    group: gtsam.NonlinearFactorGraph, values: gtsam.Values,
    moves: Mapping[int, tuple[int, gtsam.Pose3]],
) -> _Part:  # fmt: skip
    """Factors as one on places; its poses are given by the numbers of their keyframes."""
    linear = group.linearize(values)
    keys = list(linear.keys())
    used = sorted(pose_number(key) for key in keys if is_pose_key(key))
    ordering = gtsam.Ordering()
    for key in [*(key for key in keys if not is_pose_key(key)), *map(pose_key, used)]:
        ordering.push_back(key)
    matrix, right = linear.jacobian(ordering)
    own = matrix.shape[1] - 6 * len(used)
    if own:  # rows in which the variables of a user's own do not appear
        rest = np.linalg.qr(matrix[:, :own], mode="complete")[0][:, own:].T
        matrix, right = rest @ matrix[:, own:], rest @ right
    if len(right) > 6 * len(used):  # as many as there are freedoms say the same
        turned, matrix = np.linalg.qr(matrix)
        right = turned.T @ right
    blocks = matrix.reshape(len(right), len(used), 6)
    to_keyframe = np.stack([moves[keyframe][1].AdjointMap() for keyframe in used])
    return used, np.einsum("rvi,vij->rvj", blocks, to_keyframe), right


def _factor(
    keys: Sequence[int], at: Sequence[gtsam.Pose3], blocks: FloatArray, right: FloatArray
) -> gtsam.CustomFactor:
    """A factor on poses, from its blocks (V, R, 6)."""

    def residual(values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        steps = [pose.between(values.atPose3(key)) for key, pose in zip(keys, at, strict=True)]
        error = -right
        for block, step in zip(blocks, steps, strict=True):
            error = error + block @ gtsam.Pose3.Logmap(step)
        columns = [gtsam.Pose3.LogmapDerivative(step) for step in steps]
        return error, [block @ column for block, column in zip(blocks, columns, strict=True)]

    return checked_factor(gtsam.noiseModel.Unit.Create(len(right)), keys, residual)
