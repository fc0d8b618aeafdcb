"""Matches of a scan with the map: values that association makes and solvers take.

Matches are immutable arrays, so that the same ones can be given to different solvers.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import gtsam
import numpy as np

from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class EdgeMatches:
    """Points matched with lines of the map.

    Attributes
    ----------
    points : (M, 3) metres, lidar frame
    centres, directions : (M, 3) a point on each line and its unit direction, map frame
    distances : (M,) metres from the line at association
    sigmas : (M,) standard deviation of the distance, metres
    weights : (M,) LOAM's s, in (min_weight, 1]
    indices : (M,) which features these are
    tilts : (M,) standard deviation of the direction, rad; None: exact
    distinct : (M,) whether the feature stands out of its ring by more than noise makes it; None:
        all do
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
    """Points matched with planes ``n . q + d = 0`` of the map.

    Attributes
    ----------
    points : (M, 3) metres, lidar frame
    normals, offsets : (M, 3) unit and (M,) metres, map frame
    distances : (M,) signed metres from the plane at association
    sigmas : (M,) standard deviation of the distance, metres
    weights : (M,) LOAM's s, in (min_weight, 1]
    indices : (M,) which features these are
    tilts : (M,) standard deviation of the normal in its worst direction, rad; None: exact
    """

    points: FloatArray
    normals: FloatArray
    offsets: FloatArray
    distances: FloatArray
    sigmas: FloatArray
    weights: FloatArray
    indices: IntArray
    tilts: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True, eq=False)
class ScanMatches:
    """All matches of one scan at one pose.

    Attributes
    ----------
    edges, planes : the matches
    search : the neighbour search that found them; None for matches made otherwise
    """

    edges: EdgeMatches
    planes: PlaneMatches
    search: Search | None = None

    def __len__(self) -> int:
        return len(self.edges) + len(self.planes)

    @property
    def wide(self) -> bool:
        """Whether the matches come from a wide search; see :class:`Search`."""
        return self.search is not None and self.search.wide


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """A search for neighbours, whose lines and planes may serve at other poses near by.

    Attributes
    ----------
    map_T_lidar : pose of the search
    posed : de-skewed sweep, whose points were searched for
    found : all matches there
    wide : whether the map was thinned and the reach enlarged, for want of matches
    """

    map_T_lidar: gtsam.Pose3
    posed: PosedSweep
    found: ScanMatches
    wide: bool


@dataclass(frozen=True, slots=True, eq=False)
class ChosenRows:
    """The features of a sweep that are matched.

    Attributes
    ----------
    edges, planes : rows of the sweep's edges and planes
    distinct : which of those edges are distinct; None where all are
    """

    edges: IntArray
    planes: IntArray
    distinct: BoolArray | None

    def __len__(self) -> int:
        return len(self.edges) + len(self.planes)


_Matches = TypeVar("_Matches", EdgeMatches, PlaneMatches)


def subset(matches: _Matches, keep: BoolArray) -> _Matches:
    """Those matches for which a mask is true."""
    columns = {item.name: getattr(matches, item.name) for item in fields(matches)}
    chosen: dict[str, Any] = {
        name: None if column is None else column[keep] for name, column in columns.items()
    }
    return type(matches)(**chosen)


def joined_edges(first: EdgeMatches, second: EdgeMatches) -> EdgeMatches:
    """All matches of both, in the order of the features; ``distinct`` is left out."""
    columns: dict[str, Any] = {}
    order = np.argsort(np.concatenate([first.indices, second.indices]), kind="stable")
    for item in fields(first):
        parts = getattr(first, item.name), getattr(second, item.name)
        columns[item.name] = None if parts[0] is None else np.concatenate(parts)[order]
    return EdgeMatches(**columns)
