"""Matches of a sweep with the map: immutable arrays, made by association and used by solvers."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import gtsam
import numpy as np

from loam_gtsam.config import MatchingConfig
from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.types import BoolArray, FloatArray, IntArray
from loam_gtsam.voxels.tags import Faces

_TINY = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class EdgeMatches:
    """Edge features, each matched with a line of the map.

    Attributes
    ----------
    points : (M, 3) metres, lidar frame
    centres, directions : (M, 3) a point of each line, metres, and its unit direction, map frame
    distances : (M,) metres from the line at the pose of the association
    sigmas : (M,) standard deviation of the distance, metres
    weights : (M,) LOAM's s, in (min_weight, 1]
    indices : (M,) rows of the features among the edges of the sweep
    tilts : (M,) standard deviation of the direction, rad; None for exact directions
    distinct : (M,) whether the feature stands out of its ring by more than range noise; None if all
        features do
    """

    points: FloatArray
    centres: FloatArray
    directions: FloatArray
    distances: FloatArray
    sigmas: FloatArray
    weights: FloatArray
    indices: IntArray
    tilts: FloatArray | None = None
    distinct: BoolArray | None = None

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True, eq=False)
class PlaneMatches:
    """Plane features, each matched with a plane ``n . q + d = 0`` of the map.

    Attributes that are not listed are those of :class:`EdgeMatches`.

    Attributes
    ----------
    normals, offsets : (M, 3) unit and (M,) metres, map frame
    distances : (M,) signed metres from the plane at the pose of the association
    tilts : (M,) standard deviation of the normal in its worst direction, rad
    by_range : (M,) by which the distance changes with each metre that all ranges are too long, of
        the sweep and of those in the map; zero where it is not known, None if it is nowhere
    """

    points: FloatArray
    normals: FloatArray
    offsets: FloatArray
    distances: FloatArray
    sigmas: FloatArray
    weights: FloatArray
    indices: IntArray
    tilts: FloatArray | None = None
    by_range: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True, eq=False)
class ScanMatches:
    """All matches of one sweep at one pose, and the neighbour search, if any, that found them.

    ``faces`` are the planes of the sweep by which the map has points of another side.
    """

    edges: EdgeMatches
    planes: PlaneMatches
    search: Search | None = None
    faces: Faces | None = None

    def __len__(self) -> int:
        return len(self.edges) + len(self.planes)

    @property
    def tilts(self) -> FloatArray:
        """(R,) standard deviations of the normals, rad, of the rows: two a line, one a plane."""
        e, p = self.edges, self.planes
        tilts = (np.zeros(len(m)) if m.tilts is None else m.tilts for m in (e, p))
        return np.concatenate([np.repeat(next(tilts), 2), next(tilts)])


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """A search for neighbours, whose lines and planes may be kept at other poses near by."""

    map_T_lidar: gtsam.Pose3
    posed: PosedSweep  # whose points were searched for
    found: ScanMatches


@dataclass(frozen=True, slots=True, eq=False)
class ChosenRows:
    """The features of a sweep that are matched."""

    edges: IntArray  # rows among the edges of the sweep
    planes: IntArray  # rows among its planes
    distinct: BoolArray | None  # mask of ``edges``; None if all are distinct
    alone: BoolArray | None = None  # mask of those that are poles; None if none is known to be
    sigmas: FloatArray | None = None  # metres, of the places of ``edges``; None if these are exact
    level_rings: bool = True  # whether a beam may have traced a line, which is no edge then

    def __len__(self) -> int:
        return len(self.edges) + len(self.planes)


def chosen_rows(
    edges: int, planes: int, config: MatchingConfig,
    distinct: BoolArray | None = None, alone: BoolArray | None = None,
    sigmas: FloatArray | None = None, level_rings: bool = True,
) -> ChosenRows:  # fmt: skip
    """Choose the features that are matched, evenly spread: those that stand out first."""
    if distinct is not None and alone is None and distinct.all():
        distinct = None
    edge_rows = spread_rows(edges, config.max_edges, distinct)
    return ChosenRows(
        edge_rows,
        spread_rows(planes, config.max_planes),
        None if distinct is None else distinct[edge_rows],
        None if alone is None else alone[edge_rows],
        None if sigmas is None else sigmas[edge_rows],
        level_rings,
    )


def trial_matching(config: MatchingConfig) -> MatchingConfig:
    """The configuration for few matches, with which a pose is tried quickly."""

    def at_most(limit: int, most: int) -> int:
        return min(limit, most) if most else limit

    return config.changed(
        max_edges=at_most(config.trial_edges, config.max_edges),
        max_planes=at_most(config.trial_planes, config.max_planes),
    )


def spread_rows(count: int, limit: int, first: BoolArray | None = None) -> IntArray:
    """At most ``limit`` of ``count`` rows, evenly spread; those of ``first`` before others."""
    if not 0 < limit < count:
        return np.arange(count)
    if first is None:
        return np.arange(limit) * count // limit
    before, after = np.flatnonzero(first), np.flatnonzero(~first)
    before = before[spread_rows(len(before), limit)]
    if len(before) == limit:
        return before
    return np.sort(np.concatenate([before, after[spread_rows(len(after), limit - len(before))]]))


_Matches = TypeVar("_Matches", EdgeMatches, PlaneMatches)


def subset(matches: _Matches, keep: BoolArray) -> _Matches:
    """The matches for which a mask is true."""
    columns = {item.name: getattr(matches, item.name) for item in fields(matches)}
    kept: dict[str, Any] = {n: column[keep] for n, column in columns.items() if column is not None}
    return replace(matches, **kept)


def joined(first: _Matches, second: _Matches) -> _Matches:
    """All matches of both, in the order of the features; a column that one lacks is left out."""
    columns: dict[str, Any] = {}
    order = np.argsort(np.concatenate([first.indices, second.indices]), kind="stable")
    for item in fields(first):
        parts = getattr(first, item.name), getattr(second, item.name)
        missing = parts[0] is None or parts[1] is None
        columns[item.name] = None if missing else np.concatenate(parts)[order]
    return replace(first, **columns)


def deviations(
    roughness: FloatArray,
    spread: FloatArray,
    leverage: FloatArray,
    parameters: int,
    neighbours: int,
    config: MatchingConfig,
) -> tuple[FloatArray, FloatArray]:
    """Standard deviations (M,) of the distance of a new point, m, and of the tilt of a fit, rad.

    The variance of prediction of a regression: Draper and Smith, Applied Regression Analysis, 3rd
    ed., section 3.1.

    Parameters
    ----------
    roughness, spread : (M,) m^2, variances of the neighbours across and along the line or plane
    leverage : (M,) squared distance of the point from their centre, along the fit, over the spread
    parameters : that a line or a plane has
    neighbours : through which each is fitted
    """
    least = config.point_sigma**2
    scatter, variance = np.full((2, len(roughness)), least)
    if config.fit_uncertainty:
        freedom = max(neighbours - parameters, 1)
        scatter = np.maximum(roughness * neighbours / freedom, least)
        variance = scatter * (1.0 + (1.0 + leverage) / neighbours)
    return np.sqrt(variance), np.sqrt(scatter / (neighbours * np.maximum(spread, _TINY)))
