"""What moved is taken out of a map: free-space votes of the sweeps that made it.

A sweep is seen as an image of ranges, ring by ring. A map point that lies nearer than all returns
around its direction, in the ring above and in the ring below, was not there then; one that is as
far as a return, between the returns of the two rings, or on the same surface as one of them, was.
Points that were seen through more often than seen are removed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.config import Config
from loam_gtsam.datasets.base import Dataset, sweeps_of_run
from loam_gtsam.errors import SweepError, as_path, check_kind
from loam_gtsam.frontend.organise import organise
from loam_gtsam.geometry import as_points, move_points, squared_norm
from loam_gtsam.maps.map_file import SavedMap
from loam_gtsam.types import BoolArray, DatasetError, FloatArray, IntArray, MapUpdate, Scan
from loam_gtsam.voxels.grid import CubeIndex

REACH = 60.0
"""Metres from the lidar within which a sweep votes; the neighbouring rings are too far apart
beyond."""
SHARE = 1.0
"""A point goes if it was seen through more often than this for each time that it was seen."""
_NEAREST = 9  # points by which the surface at a point is known
_FLAT = 3.0  # a surface is flat if it is so many times as wide as thick
_STEP = 0.1  # metres that the lidar moves within a part of a sweep that has one centre
_PARTS = 16  # of a sweep, at most


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A sweep, or a part of one, as it was seen from one place.

    Attributes
    ----------
    number : of the sweep
    map_T_lidar : (4, 4) pose
    points : (N, 3) metres, de-skewed, in the frame of the lidar
    rings : (N,) numbers of the beams
    """

    number: int
    map_T_lidar: FloatArray
    points: FloatArray
    rings: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """How often map points were seen through, and how often they were seen, both (N,)."""

    free: IntArray
    seen: IntArray

    @property
    def moved(self) -> BoolArray:
        """(N,) which points were there for a while only."""
        return np.asarray(self.free > SHARE * self.seen)


def views(
    dataset: Dataset, updates: Sequence[MapUpdate], poses: FloatArray, config: Config
) -> Iterator[View]:
    """The sweeps of a run, as they were registered.

    Parameters
    ----------
    dataset : that was run; its raw sweeps
    updates, poses : of the frames, and (N, 4, 4) where they are in the map
    config : of the run

    Raises
    ------
    DatasetError
        If the sweeps are not those of the frames, or have no rings.
    """
    sweeps = sweeps_of_run(dataset, len(updates))
    for number, (sweep, update, pose) in enumerate(zip(sweeps, updates, poses, strict=True)):
        if not update.status.solved:
            continue
        if not isinstance(sweep, Scan):
            raise DatasetError(
                f"sweep {number}: expected one of raw points, got {type(sweep).__name__}, which "
                "says nothing of what its beams passed"
            )
        try:
            found = organise(sweep, config)
        except SweepError as error:
            raise DatasetError(f"sweep {number}: {error}; give the data set of the run") from error
        if not found.rings.known:
            raise DatasetError(
                f"sweep {number}: {found.rings.note}; expected rings, between which beams are "
                "known to have passed"
            )
        offset = (update.stamp - sweep.stamp) * 1e-9
        if not found.span[0] - 1e-3 <= offset <= found.span[1] + 1e-3:
            raise DatasetError(
                f"sweep {number}: expected the stamp {update.stamp} of its frame, got "
                f"{sweep.stamp}; give the data set of the run"
            )
        sizes = np.diff(found.ring_starts)
        rings, seconds = np.repeat(found.ring_of_start, sizes), found.times - offset
        points = found.xyz.T.astype(np.float64)
        for step, moved, rows in _parts(points, seconds, update.twist):
            yield View(number, pose @ step, moved, rings[rows])


def _parts(
    points: FloatArray, seconds: FloatArray, twist: FloatArray
) -> Iterator[tuple[FloatArray, FloatArray, BoolArray]]:
    """Parts of a sweep within which the lidar stays: its pose, de-skewed points, their rows."""
    first, last = float(seconds.min()), float(seconds.max())
    count = int(np.ceil(np.linalg.norm(twist[3:]) * (last - first) / _STEP))
    edges = np.linspace(first, last, np.clip(count, 1, _PARTS) + 1)
    part = np.clip(np.searchsorted(edges, seconds, "right") - 1, 0, len(edges) - 2)
    for number, middle in enumerate(0.5 * (edges[1:] + edges[:-1])):
        rows = part == number
        if rows.any():
            moved = move_points(points[rows], twist, seconds[rows] - middle)
            yield gtsam.Pose3.Expmap(twist * middle).matrix(), moved, rows


def count_votes(points: FloatArray, sweeps: Iterable[View], config: Config) -> Votes:
    """Ask every sweep which of the map points it saw, and through which it saw.

    Parameters
    ----------
    points : (N, 3) metres, map
    sweeps : see :func:`views`
    config : of the run; ``matching.point_sigma`` and ``features.plane_voxel`` say how exact a point
        of the map is along a beam
    """
    points = as_points(points, "points")
    sigma = config.matching.point_sigma
    # A point of the map is the mean of a voxel of one ring, and the sweep has noise as well.
    off_plane = 3.0 * np.sqrt(2.0) * sigma
    along = off_plane + config.features.plane_voxel / np.sqrt(12.0)
    normals, flat = surfaces(points, off_plane / 3.0)
    free, seen = np.zeros((2, len(points)), np.int64)
    check_kind(sweeps, Iterable, "sweeps", "views makes them")
    for view in sweeps:
        check_kind(view, View, "sweeps", "views makes them")
        image = _Image.of(view)
        if image is None:
            continue
        away = points - view.map_T_lidar[:3, 3]
        rows = np.flatnonzero(np.sqrt(squared_norm(away.T)) < REACH)
        local = away[rows] @ view.map_T_lidar[:3, :3]
        faces = normals[rows] @ view.map_T_lidar[:3, :3]
        through, met = image.ask(local, faces, flat[rows], along, off_plane)
        free[rows[through]] += 1
        seen[rows[met]] += 1
    return Votes(free, seen)


@dataclass(frozen=True, slots=True, eq=False)
class CleanedMap:
    """What was taken out of a map.

    Attributes
    ----------
    points : (N, 3) metres, of the whole map as it was
    moved : (N,) which of them are gone
    counts : points before and points removed, by layer
    """

    points: FloatArray
    moved: BoolArray
    counts: Mapping[str, tuple[int, int]]


def clean_map(
    saved: SavedMap, sweeps: Iterable[View], config: Config, path: str | Path
) -> CleanedMap:
    """Write a map without what moved while it was made.

    Parameters
    ----------
    saved : of the run
    sweeps : of the run, see :func:`views`
    config : of the run
    path : of the new file

    Raises
    ------
    DatasetError
        If the map or a sweep cannot be read.
    OutputError
        If the file cannot be written.
    """
    check_kind(saved, SavedMap, "saved", "SavedMap(path) opens one")
    path = as_path(path)
    check_kind(config, Config, "config", "saved.config is that of the run")
    order = [(layer, index) for layer, cubes in saved.layers.items() for index in cubes]
    parts = [saved.cube(layer, index).points for layer, index in order]
    points = np.concatenate([np.empty((0, 3)), *parts])
    moved = count_votes(points, sweeps, config).moved
    ends = np.cumsum([len(part) for part in parts], dtype=np.int64)[:-1]
    keep: dict[str, dict[CubeIndex, BoolArray]] = {layer: {} for layer in saved.layers}
    counts = dict.fromkeys(saved.layers, (0, 0))
    for (layer, index), gone in zip(order, np.split(moved, ends), strict=True):
        keep[layer][index] = ~gone
        before, removed = counts[layer]
        counts[layer] = before + len(gone), removed + int(gone.sum())
    saved.write_part(path, keep)
    return CleanedMap(points, moved, counts)


def surfaces(points: FloatArray, thick: float) -> tuple[FloatArray, BoolArray]:
    """Normals (N, 3) at the points of a map, and (N,) whether they lie on something flat.

    ``thick`` is a standard deviation of the points across a surface, metres.
    """
    if len(points) < _NEAREST:
        return np.zeros_like(points), np.zeros(len(points), np.bool_)
    _, near = cKDTree(points).query(points, k=_NEAREST)
    away = points[near]
    away = away - away.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away) / _NEAREST)
    sizes = np.sqrt(np.maximum(values, 0.0))
    flat = (sizes[:, 0] < 1.5 * thick) & (
        sizes[:, 1] > _FLAT * np.maximum(sizes[:, 0], 0.8 * thick)
    )
    return vectors[:, :, 0], flat


@dataclass(frozen=True, slots=True, eq=False)
class _Image:
    """Ranges by ring and azimuth; where there are several, the nearest.

    Attributes
    ----------
    elevations : (R,) rad, ascending
    ranges : (R, C) metres, NaN without a return
    points : (R, C, 3) of the returns
    """

    elevations: FloatArray
    ranges: FloatArray
    points: FloatArray

    @classmethod
    def of(cls, view: View) -> _Image | None:
        """The image of a sweep; None if it has less than two rings."""
        x, y, z = view.points.T
        ranges = np.sqrt(squared_norm(view.points.T))
        elevation = np.arctan2(z, np.hypot(x, y))
        numbers, ring = np.unique(view.rings, return_inverse=True)
        if len(numbers) < 2:
            return None
        middles = np.array([np.median(elevation[ring == n]) for n in range(len(numbers))])
        rank = np.empty(len(numbers), np.int64)
        rank[np.argsort(middles, kind="stable")] = np.arange(len(numbers))
        azimuth = np.arctan2(y, x)
        order = np.lexsort((azimuth, ring))
        steps = np.diff(azimuth[order])[np.diff(ring[order]) == 0]
        if not len(steps) or not np.median(steps) > 0.0:
            return None
        columns = int(np.clip(round(2.0 * np.pi / np.median(steps)), 90, 4096))
        column = _column(azimuth, columns)
        image = np.full((len(numbers), columns), np.nan)
        points = np.zeros((len(numbers), columns, 3))
        far_first = np.argsort(-ranges, kind="stable")
        at = rank[ring[far_first]], column[far_first]
        image[at] = ranges[far_first]
        points[at] = view.points[far_first]
        return cls(np.sort(middles), image, points)

    def ask(
        self, points: FloatArray, normals: FloatArray, flat: BoolArray, along: float, aside: float
    ) -> tuple[BoolArray, BoolArray]:
        """Which points (N, 3) the sweep saw through, and which it saw."""
        rings, columns = self.ranges.shape
        x, y, z = points.T
        above = np.searchsorted(self.elevations, np.arctan2(z, np.hypot(x, y)))
        column = _column(np.arctan2(y, x), columns)
        hit = np.isfinite(self.ranges).any(axis=0)
        looked = hit | np.roll(hit, 1) | np.roll(hit, -1)
        asked = np.flatnonzero((above > 0) & (above < rings) & looked[column])
        points, normals, flat = points[asked], normals[asked], flat[asked]
        ranges = np.sqrt(squared_norm(points.T))[:, None]
        beside = (column[asked][:, None] + np.array([-1, 0, 1])) % columns
        cells = [(row[:, None], beside) for row in (above[asked] - 1, above[asked])]
        low, high = (self.ranges[cell] for cell in cells)
        around = np.concatenate([low, high], axis=1)
        met = np.concatenate([self.points[cell] for cell in cells], axis=1)
        there = np.isfinite(around)
        away = np.abs(np.einsum("nki,ni->nk", met - points[:, None], normals))
        same = there & flat[:, None] & (away < aside)
        beyond = ~there | ((around > ranges + along) & ~same)
        both = np.isfinite(low).any(axis=1) & np.isfinite(high).any(axis=1)
        close = there & (np.abs(around - ranges) <= along)
        through, seen = np.zeros((2, len(x)), np.bool_)
        through[asked] = both & beyond.all(axis=1)
        seen[asked] = (close | same).any(axis=1)
        return through, seen & ~through


def _column(azimuth: FloatArray, columns: int) -> IntArray:
    turned = np.floor((azimuth + np.pi) * (columns / (2.0 * np.pi)))
    return np.asarray(turned.astype(np.int64) % columns)
