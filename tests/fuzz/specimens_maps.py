"""Small maps, point clouds that become maps, and the files of a run, to be damaged."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np

from loam_gtsam import Config, run
from loam_gtsam.aiding.placed_fixes import PlacedFixes
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.datasets.decode.geodesy import GeoReference
from loam_gtsam.io.read_run import read_updates
from loam_gtsam.io.run_files import write_npz
from loam_gtsam.maps.clouds import import_cloud, read_cloud, write_cloud
from loam_gtsam.maps.localizer import Localizer
from loam_gtsam.maps.map_file import MAP_FILE, MapFrame, SavedMap, save_map, write_map
from loam_gtsam.maps.merging import merge_maps
from loam_gtsam.pipeline import Pipeline
from loam_gtsam.types import DatasetError

Specimens = Mapping[str, tuple[Mapping[str, bytes], Callable[[Path], object]]]
WORLD = SimulatedWorld("room", frames=4, columns=120, speed=3.0, start="moving")
_CONFIG = Config().changed("pose_graph.keyframe_distance=0.2", "loops.sectors=8", "loops.rings=3")


def use(path: Path) -> None:
    """All that is done with a map: read whole, found again, merged with itself."""
    with SavedMap(path) as saved, SavedMap(path) as other:
        saved.points()
        for layer, cubes in saved.layers.items():
            for index in cubes:
                saved.cube(layer, index)
        saved.graph.saved()
        localizer = Localizer(saved, extend=True)
        for sweep in WORLD.part(0, 2):
            localizer.process(sweep)
        with suppress(DatasetError):
            merge_maps([saved, other], path.with_name("both.lgmap"))


def zipped(folder: Path) -> None:
    """The members of a map, in the archive again, with checksums that fit."""
    path = folder.with_name(f"{folder.name}.lgmap")
    try:
        with zipfile.ZipFile(path, "w") as archive:
            for member in sorted(folder.rglob("*")):
                if member.is_file():
                    archive.write(member, member.relative_to(folder))
        use(path)
    finally:
        path.unlink(missing_ok=True)


def to_map(folder: Path) -> None:
    """Makes a map of a cloud."""
    (path,) = folder.iterdir()
    import_cloud(read_cloud(path), folder / MAP_FILE, _CONFIG)


def room_cloud() -> np.ndarray:
    """(N, 3) points on a floor, two walls and a post."""
    rng = np.random.default_rng(5)
    x, y, z = rng.uniform([-6.0, -6.0, 0.0], [6.0, 6.0, 3.0], (1000, 3)).T
    none = np.zeros_like(x)
    parts = [(x, y, none), (none + 6.0, y, z), (x, none - 6.0, z)]
    parts.append((2.0 + 0.05 * np.cos(x), 2.0 + 0.05 * np.sin(x), z))
    return np.concatenate([np.stack(part, 1) for part in parts])


def write_with_fixes(path: Path, pipeline: Pipeline) -> None:
    """The map of a run, with a fix at every place, as if it were on the earth."""
    save_map(path, pipeline)
    with SavedMap(path) as saved:
        count = len(saved.places)
        fixes = PlacedFixes(
            np.arange(count), np.tile(np.eye(4), (count, 1, 1)),
            np.array([place.map_T_middle.translation() for place in saved.places]),
            np.tile(0.01 * np.eye(3), (count, 1, 1)), np.zeros(count, np.int64), np.zeros((1, 3)),
            np.full(1, 0.05),
        )  # fmt: skip
        earth = GeoReference(np.array([47.5, 8.5, 450.0]), np.eye(4), 0.01 * np.eye(6))
        cubes = {
            layer: {index: saved.cube(layer, index) for index in indices}
            for layer, indices in saved.layers.items()
        }
        graph = replace(saved.graph, fixes=fixes)
        write_map(path, cubes, graph, saved.config, MapFrame(earth=earth))


def maps(made: Callable[[Callable[[Path], object]], Mapping[str, bytes]]) -> Specimens:
    """By the name of the format, files and what reads them; ``made`` keeps what is written."""
    result = run(WORLD, _CONFIG)
    pipeline = result.pipeline
    assert pipeline is not None
    whole = made(lambda folder: write_with_fixes(folder / MAP_FILE, pipeline))
    with zipfile.ZipFile(io.BytesIO(whole[MAP_FILE])) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    header = json.loads(members["map.json"])
    # Else most words are of the configuration.
    header["config"] = {"loops": {"sectors": 8, "rings": 3}}
    short = {"map.json": json.dumps(header).encode(), **{n: c for n, c in members.items() if
                                                        n != "map.json"}}  # fmt: skip
    rows = made(lambda folder: write_npz(folder / "run.npz", result.updates))
    found = {
        "map": (whole, lambda folder: use(folder / MAP_FILE)),
        "map, its members": (short, zipped),
        "run": (rows, lambda folder: read_updates(folder / "run.npz")),
    }
    points = room_cloud()
    for kind in ("ply", "pcd", "las"):

        def write(folder: Path, kind: str = kind) -> None:
            write_cloud(folder / f"cloud.{kind}", points[:10], points[10:])

        found[f"cloud {kind}"] = made(write), to_map
    found["cloud laz"] = made(lambda folder: write_laz(folder, found["cloud las"][0])), to_map
    return found


def write_laz(folder: Path, las: Mapping[str, bytes]) -> None:
    """Compress a cloud without threads, of which the processes that are forked would know nothing.

    (Reading a compressed one starts threads.)
    """
    cloud = laspy.read(io.BytesIO(las["cloud.las"]))
    cloud.write(folder / "cloud.laz", laz_backend=laspy.LazBackend.Lazrs)
