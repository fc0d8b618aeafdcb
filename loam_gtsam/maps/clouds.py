"""A point cloud of another system becomes a map, and a map a point cloud.

Of a foreign cloud it is not known from where its points were seen. Any point may lie on a plane,
what is not flat on an edge, and places are put all over the ground, where a lidar may stand; what
it would see there is told by a picture of ranges.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.config import Config, as_config
from loam_gtsam.datasets.decode.packed_points import read_pcd, read_ply
from loam_gtsam.datasets.decode.pointcloud2 import read_positions
from loam_gtsam.errors import as_path
from loam_gtsam.geometry import as_points, squared_norm, voxel_filter
from loam_gtsam.io.atomic import atomic_file
from loam_gtsam.io.run_files import write_ply
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.loops.places import Place
from loam_gtsam.loops.scan_context import scan_context
from loam_gtsam.maps.cleaning import surfaces
from loam_gtsam.maps.map_file import MapFrame, grids, write_map
from loam_gtsam.maps.map_graph import MapGraph
from loam_gtsam.types import BoolArray, DatasetError, FloatArray, OutputError
from loam_gtsam.voxels.archive import Archive
from loam_gtsam.voxels.cubes import CubePoints
from loam_gtsam.voxels.tags import tags_of

_FAR = 10_000.0  # metres from the origin from which on a cloud is brought near it
_WIDEST = 1e6
"""Metres, beyond all maps: what spans more has stray points in it, or other units."""
_THIN = 0.5  # share of the voxels of planes with which a cloud is made even first
_GROUND = 0.95  # cosine between up and the normals of the ground
_CELL = 1.0  # metres, in which the lowest level point is the ground
_LAS_POINTS = 96  # byte of a LAS file at which the offset of its points stands
_LAS_RECORDS = ((100, 54), (243, 60))
"""Bytes at which the numbers of its records before and (LAS 1.4) after the points stand, and the
least bytes of a record."""
_FREE = 0.5  # metres around a lidar in which there is nothing
_BINS = np.radians(1.0)  # of a picture of what is seen
_RIGID = np.repeat([1e-5, 1e-3], 3)  # rad and m: between places of a cloud nothing has drifted


def read_cloud(path: str | Path) -> FloatArray:
    """(N, 3) the finite points of a PLY, PCD, LAS or LAZ file.

    Raises
    ------
    DatasetError
        If it cannot be read, is of another kind, or needs a package that is not installed.
    """
    path = as_path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        kinds = ", ".join(_READERS)
        raise DatasetError(f"{path}: expected a name that ends in {kinds}, got {path.suffix!r}")
    if not path.exists():
        raise DatasetError(f"{path}: there is no such file")
    points = reader(path)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise DatasetError(f"{path}: expected points, found none")
    return points


def write_cloud(path: str | Path, edges: FloatArray, planes: FloatArray) -> None:
    """Write points (E, 3) and (P, 3), metres, as PLY, PCD, LAS or LAZ.

    Raises
    ------
    OutputError
        If the file cannot be written, or the name ends otherwise.
    """
    path, points = as_path(path), np.concatenate([edges, planes])
    kind = path.suffix.lower()
    if kind == ".ply":
        write_ply(path, edges, planes)
    elif kind in (".las", ".laz"):
        _write_las(path, points)
    elif kind == ".pcd":
        with atomic_file(path) as file:
            file.write(_PCD.format(count=len(points)).encode())
            file.write(np.ascontiguousarray(points, "<f8").data)
    else:
        kinds = ", ".join(_READERS)
        raise OutputError(f"{path}: expected a name that ends in {kinds}, got {path.suffix!r}")


_PCD = """VERSION 0.7
FIELDS x y z
SIZE 8 8 8
TYPE F F F
COUNT 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""


def _laspy(path: Path) -> Any:
    try:
        import laspy
    except ImportError as error:
        raise DatasetError(
            f'{path}: LAS and LAZ need laspy: pip install "loam_gtsam[laz]" ({error})'
        ) from error
    return laspy


def _read_las(path: Path) -> FloatArray:
    laspy = _laspy(path)
    try:
        _check_counts(path)
        return np.asarray(laspy.read(path).xyz, np.float64)
    except Exception as error:  # of laspy, or of whatever a damaged file makes it stumble over
        raise DatasetError(f"{path}: the file cannot be read: {error}") from error


def _check_counts(path: Path) -> None:
    """A ValueError if a file claims more records or chunks of points than it has room for.

    A reader would look for each of the records, and a decoder of LAZ would abort the process. The
    table of the chunks begins with its version and their number; where it is stands before the
    points, or in the last eight bytes (Isenburg, LASzip, PE&RS 79(2), 2013).
    """
    data: Any = np.memmap(path, np.uint8, "r")
    for place, least in _LAS_RECORDS[: 1 + (data[25] >= 4)]:  # byte 25: the minor version
        (records,) = struct.unpack_from("<I", data, place)
        if records * least > len(data):
            raise ValueError(f"expected at most {len(data) // least} records, got {records}")
    if path.suffix.lower() != ".laz":
        return
    (points,) = struct.unpack_from("<I", data, _LAS_POINTS)
    (table,) = struct.unpack_from("<q", data, points)
    if table == -1:
        (table,) = struct.unpack_from("<q", data, len(data) - 8)
    (chunks,) = struct.unpack_from("<I", data, max(table, 0) + 4)
    if chunks > len(data):
        raise ValueError(f"expected at most {len(data)} chunks, got {chunks}")


def _write_las(path: Path, points: FloatArray) -> None:
    laspy = _laspy(path)
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, 1e-3)
    header.offsets = np.floor(points.min(axis=0)) if len(points) else np.zeros(3)
    cloud = laspy.LasData(header)
    cloud.xyz = points
    with atomic_file(path) as file:
        cloud.write(file, do_compress=path.suffix.lower() == ".laz")


_READERS: dict[str, Callable[[Path], FloatArray]] = {
    ".ply": lambda path: read_positions(read_ply(path, 0)).astype(np.float64),
    ".pcd": lambda path: read_positions(read_pcd(path, 0)).astype(np.float64),
    ".las": _read_las,
    ".laz": _read_las,
}


@dataclass(frozen=True, slots=True, eq=False)
class ImportedCloud:
    """What was made of a cloud.

    Attributes
    ----------
    shift : (3,) metres taken off the coordinates of the cloud
    edges, planes, places : how many there are
    """

    shift: FloatArray
    edges: int
    planes: int
    places: int


def import_cloud(
    points: FloatArray,
    path: str | Path,
    config: Config | None = None,
    *,
    height: float = 1.7,
    sigma: float = 0.02,
    opening: tuple[float, float] = (-15.0, 15.0),
) -> ImportedCloud:
    """Write a cloud as a map in which drives are localised.

    Parameters
    ----------
    points : (N, 3) metres, z up
    path : of the new file
    config : voxels, descriptors and noise; the defaults if None
    height : of the lidar above the ground, metres
    sigma : standard deviation of the cloud's own error, metres
    opening : lowest and highest beam of the lidar, degrees

    Raises
    ------
    DatasetError
        If there is nothing in the cloud that could be ground with something around it.
    OutputError
        If the file cannot be written.
    """
    config = as_config(config)
    points = as_points(points, "points")
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    if not len(points) or not (0.5 * high - 0.5 * low < 0.5 * _WIDEST).all():
        raise DatasetError(
            f"cloud: expected points within {_WIDEST:g} m of each other, got {len(points)}, from "
            f"{low} to {high} m; take out those that are far off"
        )
    far = bool(np.abs(points).max() > _FAR)
    shift = np.round(0.5 * low + 0.5 * high) * far
    edges, planes, normals = features_of(points - shift, config)
    seen = np.concatenate([edges, planes])
    seats = stands(planes, normals, seen, height, config)
    if not len(seats) or not len(edges):
        raise DatasetError(
            f"cloud: expected level ground, surfaces and edges, z up, in metres; found "
            f"{len(planes)} points on surfaces, {len(edges)} on edges, and {len(seats)} places "
            "where a lidar could stand"
        )
    places = places_at(seats, seen, sigma, opening, config)
    contents = {}
    tree = cKDTree(seats)
    for (layer, grid), found in zip(
        grids(config).items(), (edges, seen, seen[:0], seen[:0]), strict=True
    ):
        tags = tags_of(len(found), 0)
        tags[:, 0] = tree.query(found)[1] if len(found) else 0
        archive = Archive(grid, np.inf, None)
        archive.settle(CubePoints(found, tags))
        contents[layer] = dict(sorted(archive.contents()))
    poses = [place.map_T_middle for place in places]
    links = [
        LoopClosure(number, number + 1, poses[number].between(pose), np.diag(_RIGID**2))
        for number, pose in enumerate(poses[1:])
    ]
    frame = MapFrame(up=np.array([0.0, 0.0, 1.0]))
    write_map(path, contents, MapGraph(places, links, []), config, frame)
    kept = [sum(len(c.points) for c in contents[layer].values()) for layer in ("edges", "planes")]
    return ImportedCloud(shift, kept[0], kept[1], len(places))


def features_of(points: FloatArray, config: Config) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Edges (E, 3), points on planes (P, 3), and their normals (P, 3), of a cloud (N, 3).

    All that is not flat may be an edge, and lie on a plane too: the matching takes those that do.
    """
    even = voxel_filter(points, _THIN * config.map.plane_voxel)
    normals, flat = surfaces(even, np.sqrt(2.0) * config.matching.point_sigma)
    return even[~flat], even[flat], normals[flat]


def stands(
    planes: FloatArray, normals: FloatArray, everything: FloatArray, height: float, config: Config
) -> FloatArray:
    """(S, 3) where a lidar may stand: over ground, with nothing close around it."""
    ground = planes[np.abs(normals[:, 2]) > _GROUND]
    ground = ground[np.argsort(ground[:, 2], kind="stable")]
    _, first = np.unique(np.floor(ground[:, :2] / _CELL), axis=0, return_index=True)
    ground = ground[np.sort(first)]
    step = config.pose_graph.keyframe_distance
    _, first = np.unique(np.floor(ground[:, :2] / step), axis=0, return_index=True)
    seats: FloatArray = ground[first] + np.array([0.0, 0.0, height])
    if not len(seats):
        return seats
    away = cKDTree(everything).query(seats)[0]
    return np.asarray(seats[away > min(_FREE, 0.5 * height)])


def places_at(
    seats: FloatArray,
    points: FloatArray,
    sigma: float,
    opening: tuple[float, float],
    config: Config,
) -> list[Place]:
    """Places at seats (S, 3), with descriptors of the points that a lidar sees there."""
    tree = cKDTree(points)
    covariance = np.diag(np.repeat([1e-12, sigma**2], 3))
    places = []
    for number, seat in enumerate(seats):
        local = points[tree.query_ball_point(seat, config.loops.reach)] - seat
        seen = local[in_sight(local, opening)]
        descriptor = scan_context(seen, config.loops).astype(np.float16)
        pose = gtsam.Pose3(gtsam.Rot3(), seat)
        places.append(Place(number, pose, covariance, descriptor))
    return places


def in_sight(points: FloatArray, opening: tuple[float, float]) -> BoolArray:
    """(N,) which points (N, 3) around a lidar its beams meet, and no other point hides."""
    ranges = np.sqrt(squared_norm(points.T))
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arcsin(np.clip(points[:, 2] / np.maximum(ranges, 1e-9), -1.0, 1.0))
    columns, rows = (np.floor(angle / _BINS).astype(np.int64) for angle in (azimuth, elevation))
    _, pixel = np.unique(columns * 1000 + rows, return_inverse=True)
    nearest = np.full(pixel.max(initial=-1) + 1, np.inf)
    np.minimum.at(nearest, pixel, ranges)
    low, high = np.radians(opening)
    met = (elevation >= low) & (elevation <= high)
    return np.asarray(met & (ranges <= 1.05 * nearest[pixel] + 0.5))
