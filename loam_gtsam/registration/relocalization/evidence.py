"""A paired test: which of two places explains the features of a sweep better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loam_gtsam.geometry import transform
from loam_gtsam.registration.frame_matcher import FrameMatcher
from loam_gtsam.registration.planes import leaves_open
from loam_gtsam.registration.relocalization.fits import AGREE, agreeing, vague
from loam_gtsam.registration.solvers import Solution
from loam_gtsam.types import BoolArray, FloatArray

_AGAINST = 5.0
"""Number of features that agree which one outweighs that contradicts. At the right place 3 of 1000
matches contradict by noise, at a wrong one ten times as many (medians of 315 starts, of which 10
go wrong, and at most 14 with any number from 3 to 10)."""
CHANCE = 3.0  # standard deviations beyond which a difference is no chance
_TINY = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the features of a sweep, those that may be matched, say of a place.

    Attributes
    ----------
    edges : number of edges, which come first
    points : (F, 3) where the features are in the map, metres
    signs : (F,) 1 if the match of a feature agrees, -5 if it contradicts, and 0 without a match
    axes : (F, 3) of the lines and planes of the matches
    hints : (F,) 1 where a match is so vague that it agrees anywhere within its reach: all it says
        is that there was one to find. None if such matches were not looked for; they have no sign.
    """

    edges: int
    points: FloatArray
    signs: FloatArray
    axes: FloatArray
    hints: FloatArray | None = None

    @classmethod
    def of(cls, matcher: FrameMatcher, solution: Solution, *, dense: bool = False) -> Evidence:
        """What the features of a matcher say of the place where they were solved.

        In a ``dense`` map there is something to match with at any place, and a feature counts by
        the chance that a match within reach of it does not agree.
        """
        rows = matcher.rows
        signs, axes = np.zeros(len(rows)), np.zeros((len(rows), 3))
        hints: FloatArray | None = None
        if solution.solved:
            anywhere = np.zeros(len(rows), np.bool_)
            edges, planes = solution.matches.edges, solution.matches.planes
            lines = np.searchsorted(rows.edges, edges.indices)
            others = len(rows.edges) + np.searchsorted(rows.planes, planes.indices)
            reach = matcher.matching.max_distance
            masks = agreeing(solution.matches), vague(solution.matches, reach)
            for places, sigmas, sure, none in zip(
                (lines, others), (edges.sigmas, planes.sigmas), *masks, strict=True
            ):
                signs[places] = np.where(sure, 1.0, -_AGAINST)
                if dense:
                    signs[places] *= 1.0 - np.minimum(AGREE * sigmas / reach, 1.0)
                anywhere[places] = none
            signs[anywhere] = 0.0
            axes[lines], axes[others] = edges.directions, planes.normals
            if not dense and leaves_open(planes, matcher.matching):
                hints = anywhere.astype(np.float64)
        points = np.concatenate(matcher.posed.rows(rows.edges, rows.planes))
        points = transform(solution.map_T_lidar.matrix(), points)
        return cls(len(rows.edges), points, signs, axes, hints)

    @property
    def share(self) -> float:
        """Share of the features whose matches agree."""
        return float(np.count_nonzero(self.signs > 0.0)) / max(len(self.signs), 1)


class Favour(NamedTuple):
    """How much speaks for some places against others.

    In standard deviations, of all features, of lines and of planes; and numbers of features,
    counted as if they lay across: ``weight`` speak for them more than against, ``said`` at all.
    """

    every: float
    lines: float
    planes: float
    weight: float
    said: float


def favour(
    tried: Sequence[Evidence], others: Sequence[Evidence], *, moving: bool = False
) -> Favour:
    """How much speaks for the places of some sweeps, against other places of the same sweeps.

    The sweeps see the same things, and count as one. What agrees at one place and contradicts at
    the other may be ``moving``: then it counts for the one as much as against the other.
    """
    found = [_gain(*pair, moving) for pair in zip(tried, others, strict=True)]
    gain, edge, across = (np.concatenate(parts) for parts in zip(*found, strict=True))
    every, lines, planes = (
        float(part.sum() / max(np.sqrt(len(found)) * np.linalg.norm(part), _TINY))
        for part in (gain, gain[edge], gain[~edge])
    )
    weight, said = (float(across @ some) / len(found) for some in (gain, np.abs(gain)))
    return Favour(every, lines, planes, weight, said)


def speaks_for(here: Evidence, other: Evidence, least: float) -> bool:
    """Whether a sweep speaks for a place against another one, beyond chance and by ``least``.

    That is a number of features, counted as in :class:`Favour`.
    """
    told = favour([here], [other])
    return told.every > CHANCE and told.weight > least


def _gain(
    tried: Evidence, other: Evidence, moving: bool
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """What each feature (F,) says for one place against another, which are edges, how far across.

    A feature counts as far as its line or plane lies across the way from one place to the other:
    ground and walls along the way agree at both, but for chance. Hints count only if they were
    looked for at both.
    """
    edge = np.arange(len(other.points)) < other.edges
    way = tried.points - other.points
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), _TINY)
    matched = [one.axes.any(axis=1) for one in (tried, other)]
    along = [np.einsum("ij,ij->i", one.axes, way) ** 2 for one in (tried, other)]
    each = [
        has * np.where(edge, 1.0 - cosine, cosine)
        for has, cosine in zip(matched, along, strict=True)
    ]
    across = np.sqrt(np.clip(sum(each) / np.maximum(sum(matched), 1), 0.0, 1.0))
    gain = tried.signs - other.signs
    if moving:
        disputed = tried.signs * other.signs < 0.0
        gain[disputed] = np.sign(gain[disputed])
    if tried.hints is not None and other.hints is not None:
        gain = gain + tried.hints - other.hints
    gain = across * gain
    return gain, edge, across
