"""A map in one file, ``.lgmap``: what a later run needs to find itself in it.

The file is a zip archive without compression: ``map.json``, which says what is in it, and arrays as
``.npy``; nothing that is read can run code. Every member has the checksum (CRC-32) of the zip
format, which is tested when the member is read. Cubes are members of their own, so that a long map
is opened at once and read where the lidar is. The members are listed in docs/localise.md.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.config import Config, MapConfig, config_from_dict, config_to_dict
from loam_gtsam.cubemap import Contents, grid_of
from loam_gtsam.datasets.decode.geodesy import GeoReference
from loam_gtsam.errors import DAMAGED, as_path
from loam_gtsam.io.atomic import atomic_file
from loam_gtsam.io.version import installed_version
from loam_gtsam.loops.places import Place
from loam_gtsam.maps.map_graph import (
    PARTS,
    MapGraph,
    array_shapes,
    graph_arrays,
    graph_of,
    graph_of_arrays,
)
from loam_gtsam.pipeline import Pipeline, RunResult
from loam_gtsam.registration.frame_matcher import MapPair
from loam_gtsam.types import BoolArray, DatasetError, FloatArray, InputError, OutputError
from loam_gtsam.voxels.cubes import NO_POINTS, CubePoints
from loam_gtsam.voxels.grid import CubeIndex, Grid

SUFFIX = ".lgmap"
MAP_FILE = f"map{SUFFIX}"
VERSION = 3
LAYERS = "edges", "planes", "small_edges", "small_planes"
_FORMAT = "loam_gtsam map"
_HEADER = "map.json"
_CLOUDS = ".ply", ".pcd", ".las", ".laz"
_DATE = (1980, 1, 1, 0, 0, 0)  # the same map makes the same file
_POINT = np.dtype([("xyz", "<f8", 3), ("owner", "<i4"), ("view", "i1", 4)])
"""A map point: metres, the number of its place, from where it was seen (voxels/tags.py)."""
_FARTHEST = 1e12
"""Beyond all numbers of a map; their voxels still have numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class MapFrame:
    """What is known of the frame of a map.

    Attributes
    ----------
    up : (3,) up in the map; None if the run had no IMU that knew
    earth : where the map is on the earth; None if the run had no GNSS receiver
    """

    up: FloatArray | None = None
    earth: GeoReference | None = None


def map_of_run(path: str | Path) -> Path:
    """The file of the map in the folder of a run, or a file as it is."""
    path = as_path(path)
    return path / MAP_FILE if path.is_dir() else path


def save_map(path: str | Path, pipeline: Pipeline | RunResult | None) -> None:
    """Write the map of a run, corrected by its loops if there are any.

    Parameters
    ----------
    path : a file, whose name should end in ``.lgmap``; replaced if it is there
    pipeline : that made the map, or the result of a run, which has one

    Raises
    ------
    InputError
        If ``pipeline`` is none, or the result has none.
    OutputError
        If the file cannot be written, an old one is then as it was; or its name is that of a cloud.
    """
    if isinstance(pipeline, RunResult):
        pipeline = pipeline.pipeline
    if not isinstance(pipeline, Pipeline):
        got = type(pipeline).__name__
        raise InputError(f"pipeline: expected that of a run, got {got}; run makes one")
    aid = pipeline.mapper.imu
    tied = pipeline.fixes
    earth, fixes = (None, None) if tied is None else (tied.reference, tied.placed)
    frame = MapFrame(None if aid is None else aid.map_up, earth)
    if pipeline.loops is not None:
        points = whole(pipeline.loops.corrected_maps())
        graph = graph_of(pipeline.loops, pipeline.config, fixes)
        numbers = [keyframe.index for keyframe in pipeline.loops.graph.keyframes]
        write_map(path, points, graph, pipeline.config, frame, numbers)
    else:
        graph = MapGraph(pipeline.places.all, pipeline.places.links, [])
        write_map(path, whole(pipeline.mapper.maps), graph, pipeline.config, frame)


def grids(config: Config) -> dict[str, Grid]:
    """Cubes and voxels of the maps, by layer."""
    sizes = [grid for place in (config, config.of_small_places()) for grid in _grids(place.map)]
    return dict(zip(LAYERS, sizes, strict=True))


def _grids(config: MapConfig) -> tuple[Grid, Grid]:
    return grid_of(config, config.edge_voxel), grid_of(config, config.plane_voxel)


def whole(maps: MapPair) -> dict[str, Contents]:
    """All points of maps, by layer and cube."""
    return {name: cubes.contents(archived=True) for name, cubes in maps.layers().items()}


def write_map(
    path: str | Path,
    contents: Mapping[str, Contents],
    graph: MapGraph,
    config: Config,
    frame: MapFrame,
    numbers: Sequence[int] | None = None,
) -> None:
    """Write points and places.

    Parameters
    ----------
    contents : points by layer (:data:`LAYERS`) and cube, whose owners are numbers of places
    graph : the places
    config : of the maps
    frame : of both
    numbers : the owners, in the order of the places, if they are others

    Raises
    ------
    OutputError
        As :func:`save_map`.
    """
    path = as_path(path)
    if path.suffix.lower() in _CLOUDS:
        cloud = "loam_gtsam.maps.write_cloud writes clouds"
        raise OutputError(f"{path}: expected a name that ends in {SUFFIX}; {cloud}")
    up, earth = frame.up, frame.earth
    header = {
        "format": _FORMAT,
        "version": VERSION,
        "made_by": f"loam_gtsam {installed_version()}",
        "frame": {
            "origin": "first sweep of the run, at its reference time",
            "up": None if up is None else up.tolist(),
            "enu": None if earth is None else earth.as_dict(),
        },
        "config": config_to_dict(config),
        **graph.sizes,
        "layers": {
            name: [[*index, len(cube.points)] for index, cube in cubes.items()]
            for name, cubes in contents.items()
        },
    }
    with atomic_file(path) as file, zipfile.ZipFile(file, "w") as archive:
        _add(archive, _HEADER, json.dumps(header, indent=1).encode())
        for name, array in graph_arrays(graph, config.loops).items():
            _add(archive, f"{name}.npy", _bytes_of(array))
        for name, cubes in contents.items():
            for index, cube in cubes.items():
                rows = _rows(cube)
                if numbers is not None and len(numbers):
                    at = np.searchsorted(numbers, rows["owner"], "right") - 1
                    rows["owner"] = np.maximum(at, 0)
                _add(archive, _cube_name(name, index), _bytes_of(rows))


class SavedMap:
    """A map in a file, of which cubes are read when they are asked for.

    Parameters
    ----------
    path : a file that :func:`save_map` wrote, or the folder of a run, which has one; the file must
        not change while it is open

    Attributes
    ----------
    config : of the run that made the map
    graph : places where the map can be recognised, the motions between them, and loops
    layers : numbers of points by cube, by kind of map (:data:`LAYERS`)
    frame : what is known of its frame

    Raises
    ------
    DatasetError
        If the file cannot be read, is none of this kind, of another version, or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = map_of_run(path)
        try:
            self._archive = zipfile.ZipFile(self.path)
        except FileNotFoundError:
            raise DatasetError(
                f"{self.path}: there is no such file; loam-gtsam run PATH writes map{SUFFIX}"
            ) from None
        except DAMAGED as error:
            raise DatasetError(
                f"{self.path}: expected a map ({SUFFIX}) that loam-gtsam run wrote, got another "
                f"file, or a part of one: {error}"
            ) from error
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        try:
            header = json.loads(self._read(_HEADER))
            found = (header["format"], header["version"])
        except DAMAGED as error:
            raise self._damaged(_HEADER, error) from error
        if found != (_FORMAT, VERSION):
            raise DatasetError(
                f"{self.path}: expected a {_FORMAT} of version {VERSION}, got {found[0]!s:.40} of "
                f"version {found[1]!s:.40}; run the data again with this release"
            )
        try:
            self.config: Config = config_from_dict(header["config"], f"{self.path}: {_HEADER}")
            self.layers = {
                name: {
                    (int(x), int(y), int(z)): int(count)
                    for x, y, z, count in header["layers"][name]
                }
                for name in LAYERS
            }
            up, enu = header["frame"]["up"], header["frame"].get("enu")
            self.frame = MapFrame(
                None if up is None else np.array(up, np.float64).reshape(3),
                None if enu is None else GeoReference.of_dict(enu),
            )
            sizes = {name: int(header.get(name, 0)) for name in PARTS}
            shapes = array_shapes(sizes, self.config.loops)
            arrays = {name: self._array(f"{name}.npy", *how) for name, how in shapes.items()}
            self.graph = graph_of_arrays(arrays)
        except DAMAGED as error:
            raise self._damaged(_HEADER, error) from error
        names = set(self._archive.namelist())
        for layer, cubes in self.layers.items():
            for index in cubes:
                if _cube_name(layer, index) not in names:
                    raise self._damaged(_cube_name(layer, index), "it is missing")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._archive.close()

    def __repr__(self) -> str:
        return f"SavedMap({str(self.path)!r}: {len(self)} points, {len(self.places)} places)"

    def __len__(self) -> int:
        """Number of points, those of small places counted once more."""
        return sum(sum(cubes.values()) for cubes in self.layers.values())

    @property
    def places(self) -> Sequence[Place]:
        """Where the map can be recognised."""
        return self.graph.places

    def cube(self, layer: str, index: CubeIndex) -> CubePoints:
        """Read a cube.

        Raises
        ------
        DatasetError
            If it cannot be read, or its checksum does not fit.
        InputError
            If the map was closed.
        """
        self._check_open()
        name = _cube_name(layer, index)
        try:
            rows = self._array(name, _POINT, (self.layers[layer][index],))
        except DAMAGED as error:
            raise self._damaged(name, error) from error
        tags = np.column_stack([rows["owner"], rows["view"].view("<i4")[:, 0]]).astype(np.int32)
        return CubePoints(np.ascontiguousarray(rows["xyz"]), tags)

    def points(self) -> tuple[FloatArray, FloatArray]:
        """Edge and plane points of the whole map but those of small places, (E, 3) and (P, 3)."""
        edges, planes = (
            [self.cube(layer, index).points for index in self.layers[layer]] for layer in LAYERS[:2]
        )
        return np.concatenate([NO_POINTS, *edges]), np.concatenate([NO_POINTS, *planes])

    def write_part(
        self, path: str | Path, keep: Mapping[str, Mapping[CubeIndex, BoolArray]]
    ) -> None:
        """Write the map with some of its points only; all else stays to the last bit.

        Parameters
        ----------
        path : another file than the map's own
        keep : which points of each cube of each layer, in the order of :meth:`cube`

        Raises
        ------
        DatasetError
            If a cube cannot be read.
        InputError
            If the map was closed.
        OutputError
            If the file cannot be written.
        """
        self._check_open()
        header = json.loads(self._read(_HEADER))
        header["layers"] = {
            layer: [
                [*index, int(keep[layer][index].sum())]
                for index in cubes
                if keep[layer][index].any()
            ]
            for layer, cubes in self.layers.items()
        }
        with atomic_file(path) as file, zipfile.ZipFile(file, "w") as archive:
            _add(archive, _HEADER, json.dumps(header, indent=1).encode())
            for name in graph_arrays(self.graph, self.config.loops):
                _add(archive, f"{name}.npy", self._read(f"{name}.npy"))
            for layer, cubes in header["layers"].items():
                for *cube, _ in cubes:
                    index = (cube[0], cube[1], cube[2])
                    rows = _rows(self.cube(layer, index).chosen(keep[layer][index]))
                    _add(archive, _cube_name(layer, index), _bytes_of(rows))

    def _check_open(self) -> None:
        if self._archive.fp is None:
            raise InputError(
                f"{self.path}: this map was closed; use it inside its with block, or open it again"
            )

    def _array(self, name: str, kind: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        array = np.load(io.BytesIO(self._read(name)), allow_pickle=False)
        if array.dtype != kind or array.shape != shape:
            raise ValueError(f"{name}: expected {shape} {kind}, got {array.shape} {array.dtype}")
        fields = [array[part] for part in kind.names or ()] or [array]
        for part in fields:
            if part.dtype.kind == "f" and not (np.abs(part, dtype=np.float64) < _FARTHEST).all():
                raise ValueError(f"{name}: expected finite numbers below {_FARTHEST:g}")
        return np.asarray(array)

    def _read(self, name: str) -> bytes:
        return self._archive.read(name)  # tests the checksum

    def _damaged(self, name: str, problem: object) -> DatasetError:
        told = f"there is no {problem}" if isinstance(problem, KeyError) else str(problem)
        return DatasetError(
            f"{self.path}: the map is damaged: {name}: {told[:200]}; copy the file again, or run "
            "the data again"
        )


def _rows(cube: CubePoints) -> NDArray[Any]:
    """The points of a cube as they are in the file."""
    rows = np.zeros(len(cube.points), _POINT)
    rows["xyz"] = cube.points
    rows["owner"] = cube.tags[:, 0]
    rows["view"] = np.ascontiguousarray(cube.tags[:, 1:], "<i4").view(np.int8)
    return rows


def _bytes_of(array: NDArray[Any]) -> bytes:
    target = io.BytesIO()
    np.save(target, array, allow_pickle=False)
    return target.getvalue()


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    archive.writestr(zipfile.ZipInfo(name, _DATE), content)


def _cube_name(layer: str, index: CubeIndex) -> str:
    return "cubes/{}/{}_{}_{}.npy".format(layer, *index)
