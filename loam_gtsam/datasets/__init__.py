"""Loaders: whatever holds sweeps becomes a :class:`Dataset`; :func:`open_dataset` guesses which.

They are imported when asked for: arrays and KITTI folders do not pay for the bag reader.
"""

from __future__ import annotations

import importlib
import inspect
import os
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

from loam_gtsam.datasets.base import BagOptions, LoadedDataset
from loam_gtsam.datasets.base import Dataset as Dataset
from loam_gtsam.datasets.base import DatasetInfo as DatasetInfo
from loam_gtsam.datasets.known.layouts import known_loader
from loam_gtsam.errors import as_path, nearest
from loam_gtsam.types import DatasetError
from loam_gtsam.types import Sweep as Sweep

if TYPE_CHECKING:
    from loam_gtsam.datasets.arrays import ArrayDataset as ArrayDataset
    from loam_gtsam.datasets.bags.bag import BagDataset as BagDataset
    from loam_gtsam.datasets.bags.loam_topics import LoamTopicsDataset as LoamTopicsDataset
    from loam_gtsam.datasets.decode.pointcloud2 import decode_pointcloud2 as decode_pointcloud2
    from loam_gtsam.datasets.kitti.folder import KittiDataset as KittiDataset
    from loam_gtsam.datasets.known.boreas import BoreasDataset as BoreasDataset
    from loam_gtsam.datasets.known.helipr import HeLiPRDataset as HeLiPRDataset
    from loam_gtsam.datasets.known.mulran import MulRanDataset as MulRanDataset
    from loam_gtsam.datasets.known.newer_college import NewerCollegeBags as NewerCollegeBags
    from loam_gtsam.datasets.known.newer_college import NewerCollegeClouds as NewerCollegeClouds
    from loam_gtsam.datasets.known.oxford_spires import OxfordSpiresBags as OxfordSpiresBags
    from loam_gtsam.datasets.known.oxford_spires import OxfordSpiresClouds as OxfordSpiresClouds
    from loam_gtsam.datasets.known.rigs import RigBag as RigBag
    from loam_gtsam.datasets.sim.streets import build_city as build_city
    from loam_gtsam.datasets.sim.world import SimulatedWorld as SimulatedWorld

_LAZY = {
    "ArrayDataset": "arrays",
    "BagDataset": "bags.bag",
    "BoreasDataset": "known.boreas",
    "HeLiPRDataset": "known.helipr",
    "KittiDataset": "kitti.folder",
    "LoamTopicsDataset": "bags.loam_topics",
    "MulRanDataset": "known.mulran",
    "NewerCollegeBags": "known.newer_college",
    "NewerCollegeClouds": "known.newer_college",
    "OxfordSpiresBags": "known.oxford_spires",
    "OxfordSpiresClouds": "known.oxford_spires",
    "RigBag": "known.rigs",
    "SimulatedWorld": "sim.world",
    "build_city": "sim.streets",
    "decode_pointcloud2": "decode.pointcloud2",
}
__all__ = ["Dataset", "DatasetInfo", "Sweep", "open_dataset", *_LAZY]

_BAG_FILES = (".bag", ".mcap", ".db3")
_ACCEPTED = (
    "a folder with .bin, .pcd, .ply or .npy sweeps (also in velodyne/, scans/ or "
    "velodyne_points/data/), a ROS 1 .bag, a ROS 2 bag folder (with metadata.yaml), an .mcap or "
    ".db3 file, a sequence of Newer College, MulRan, HeLiPR, Boreas or Oxford Spires, or a "
    "built-in world such as sim:street_loop or 'sim:room?frames=50&seed=3'"
)
_OTHERS = "sweeps of any other format: docs/own_sensor.md"
_LOOKED_AT = 500  # folders searched for a better path to suggest


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(f"{__name__}.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def open_dataset(path: str | Path, **options: Any) -> LoadedDataset:
    """Open whatever is at ``path``.

    Parameters
    ----------
    path : sweeps in a folder, a bag or a known data set, or ``sim:room?frames=50&seed=3``
    options : for the loader, e.g. ``topic`` (bags), ``axes`` (LOAM's topics), ``sequence`` (Newer
        College). Those that are None count as not given.

    Notes
    -----
    A bag with LOAM's own topics is read as such unless ``topic`` or another option of plain bags
    is given. Known data sets are told by the names of their files and folders; a file named as one
    of theirs that is to be read as any other bag: :class:`BagDataset`.

    Raises
    ------
    DatasetError
        If nothing is there, it is of no known kind, or an option does not belong to it.
    """
    options = {key: value for key, value in options.items() if value is not None}
    text, path = str(path), as_path(path)
    if text.startswith("sim:"):
        return _open_world(text, options)
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder; expected {_ACCEPTED}")
    if path.is_file() and path.suffix not in _BAG_FILES:
        if path.suffix in (".bin", ".pcd", ".ply", ".npy"):
            raise DatasetError(f"{path}: one sweep; give the folder that holds them: {path.parent}")
        kind = f"unknown kind of file {path.suffix!r}"
        raise DatasetError(f"{path}: {kind}; expected {_ACCEPTED}; {_OTHERS}")
    known = known_loader(path)
    if known is not None:
        return _construct(__getattr__(known), path, options)
    if path.is_file() or (path / "metadata.yaml").is_file():
        return _open_bag(path, options)
    from loam_gtsam.datasets.kitti.folder import KittiDataset, find_sweeps

    try:
        return _construct(KittiDataset, path, options)
    except DatasetError as error:
        if find_sweeps(path) is not None:
            raise
        shown = sorted(path.glob("[!.]*"))
        bags = [file.name for file in shown if file.suffix in _BAG_FILES]
        if bags:
            names = ", ".join(bags[:5])
            raise DatasetError(f"{path}: open one of its bags instead: {names}") from error
        raise DatasetError(f"{error}. {_suggestion(path)}") from error


def _suggestion(path: Path) -> str:
    inside: list[str] = []
    for folder, names, files in islice(os.walk(path), _LOOKED_AT):
        names.sort()
        if "metadata.yaml" in files or any(name.endswith(".bin") for name in files):
            inside.append(folder)
            names.clear()
        inside += [f"{folder}/{name}" for name in sorted(files) if name.endswith(_BAG_FILES)]
    if inside:
        more = ", ..." if len(inside) > 3 else ""
        return f"There may be sweeps in {', '.join(inside[:3])}{more}"
    kinds = sorted({file.suffix for file in path.iterdir() if file.is_file()})
    there = f"it has files {', '.join(kinds[:5])}" if kinds else "it has no files"
    return f"Expected {_ACCEPTED}; {there}; {_OTHERS}"


def _open_bag(path: Path, options: dict[str, Any]) -> LoadedDataset:
    from contextlib import closing

    from loam_gtsam.datasets.bags.bag import BagDataset
    from loam_gtsam.datasets.bags.bag_reader import open_bag
    from loam_gtsam.datasets.bags.loam_topics import LoamTopicsDataset
    from loam_gtsam.datasets.decode.loam_messages import REQUIRED
    from loam_gtsam.datasets.known.rigs import RigBag, rig_of

    with closing(open_bag(path)) as reader:
        loam, rig = reader.topics.keys() >= set(REQUIRED), rig_of(reader.topics.keys())
    plain = (BagOptions.__annotations__.keys() - {"imu_topic"}) & options.keys()
    of_loam = "axes" in options or (loam and not plain)
    known = rig is not None and options.get("topic") in (None, rig.topic)
    plain_bag = RigBag if known else BagDataset
    return _construct(LoamTopicsDataset if of_loam else plain_bag, path, options)


def _open_world(text: str, options: dict[str, Any]) -> LoadedDataset:
    scene, _, query = text.removeprefix("sim:").partition("?")
    try:
        pairs = parse_qsl(query, strict_parsing=bool(query))
    except ValueError as error:
        form = "sim:SCENE?frames=NUMBER&seed=NUMBER&sensor=NAME"
        raise DatasetError(f"{text}: expected {form}: {error}") from error
    from loam_gtsam.datasets.sim.world import SimulatedWorld

    settings = {key: _number_or_text(value) for key, value in pairs} | options
    numbers = set(inspect.signature(SimulatedWorld).parameters) - {"sensor", "start", "imu"}
    for key, value in settings.items():
        if key in numbers and isinstance(value, str):
            raise DatasetError(f"{text}: {key}: expected a number, got {value!r}")
    return _construct(SimulatedWorld, scene, settings)


def _number_or_text(value: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(value)
        except ValueError:
            continue
    return value


def _construct(loader: Any, source: str | Path, options: dict[str, Any]) -> LoadedDataset:
    known = list(inspect.signature(loader).parameters)[1:]
    if "options" in known:
        known[known.index("options") :] = BagOptions.__annotations__
    if unknown := [key for key in options if key not in known]:
        name, takes = loader.__name__, ", ".join(known)
        raise DatasetError(
            f"{source}: {name} takes no option {', '.join(unknown)}; it takes {takes}"
            f"{nearest(unknown[0], known, listing=False)}"
        )
    dataset: LoadedDataset = loader(source, **options)
    return dataset
