"""Loaders: whatever holds sweeps becomes a :class:`Dataset`.

:func:`open_dataset` guesses the loader from a path. The loaders themselves are imported when they
are asked for, so that arrays and KITTI folders do not pay for the bag reader.
"""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

from loam_gtsam.datasets.base import Dataset as Dataset
from loam_gtsam.datasets.base import DatasetInfo as DatasetInfo
from loam_gtsam.datasets.base import Sweep as Sweep
from loam_gtsam.datasets.layouts import known_loader
from loam_gtsam.types import DatasetError

if TYPE_CHECKING:
    from loam_gtsam.datasets.arrays import ArrayDataset as ArrayDataset
    from loam_gtsam.datasets.bag import BagDataset as BagDataset
    from loam_gtsam.datasets.city import build_city as build_city
    from loam_gtsam.datasets.helipr import HeLiPRDataset as HeLiPRDataset
    from loam_gtsam.datasets.kitti import KittiDataset as KittiDataset
    from loam_gtsam.datasets.loam_topics import LoamTopicsDataset as LoamTopicsDataset
    from loam_gtsam.datasets.mulran import MulRanDataset as MulRanDataset
    from loam_gtsam.datasets.newer_college import NewerCollegeBags as NewerCollegeBags
    from loam_gtsam.datasets.newer_college import NewerCollegeClouds as NewerCollegeClouds
    from loam_gtsam.datasets.oxford_spires import OxfordSpiresBags as OxfordSpiresBags
    from loam_gtsam.datasets.oxford_spires import OxfordSpiresClouds as OxfordSpiresClouds
    from loam_gtsam.datasets.pointcloud2 import decode_pointcloud2 as decode_pointcloud2
    from loam_gtsam.datasets.simulation import SimulatedWorld as SimulatedWorld

_LAZY = {
    "ArrayDataset": "arrays",
    "BagDataset": "bag",
    "HeLiPRDataset": "helipr",
    "KittiDataset": "kitti",
    "LoamTopicsDataset": "loam_topics",
    "MulRanDataset": "mulran",
    "NewerCollegeBags": "newer_college",
    "NewerCollegeClouds": "newer_college",
    "OxfordSpiresBags": "oxford_spires",
    "OxfordSpiresClouds": "oxford_spires",
    "SimulatedWorld": "simulation",
    "build_city": "city",
    "decode_pointcloud2": "pointcloud2",
}
__all__ = ["Dataset", "DatasetInfo", "Sweep", "open_dataset", *_LAZY]

_BAG_FILES = (".bag", ".mcap", ".db3")
_ACCEPTED = (
    "a folder with .bin sweeps (also in velodyne/, scans/ or velodyne_points/data/), a ROS 1 .bag, "
    "a ROS 2 bag folder (with metadata.yaml), an .mcap or .db3 file, a sequence of Newer College, "
    "MulRan, HeLiPR or Oxford Spires, or a built-in world such as sim:street_loop or "
    "sim:room?frames=50&seed=3"
)


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(f"{__name__}.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def open_dataset(path: str | Path, **options: Any) -> Dataset:
    """Open whatever is at ``path``.

    Parameters
    ----------
    path : a folder with ``.bin`` sweeps, a ROS 1 or ROS 2 bag, an MCAP file, a sequence of Newer
        College, MulRan, HeLiPR or Oxford Spires, or the name of a built-in world
        (``sim:room?frames=50&seed=3``)
    options : for the loader, e.g. ``topic``, ``imu_topic``, ``time_field``, ``time_unit``,
        ``stamp_is`` (bags), ``axes`` (LOAM's topics), ``vertical_angle_offset_deg`` (KITTI),
        ``sequence`` (Newer College), ``lidar`` (HeLiPR). Those that are None count as not given.

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
    text = str(path)
    if text.startswith("sim:"):
        return _open_world(text, options)
    path = Path(path)
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder; expected {_ACCEPTED}")
    if path.is_file() and path.suffix not in _BAG_FILES:
        raise DatasetError(f"{path}: unknown kind of file {path.suffix!r}; expected {_ACCEPTED}")
    known = known_loader(path)
    if known is not None:
        return _construct(__getattr__(known), path, options)
    if path.is_file() or (path / "metadata.yaml").is_file():
        return _open_bag(path, options)
    bags = [file for file in sorted(path.iterdir()) if file.suffix in _BAG_FILES]
    from loam_gtsam.datasets.kitti import KittiDataset

    try:
        return _construct(KittiDataset, path, options)
    except DatasetError as error:
        if bags:
            names = ", ".join(file.name for file in bags[:5])
            raise DatasetError(f"{path}: open one of its bags instead: {names}") from error
        raise


def _open_bag(path: Path, options: dict[str, Any]) -> Dataset:
    from contextlib import closing

    from loam_gtsam.datasets.bag import BagDataset
    from loam_gtsam.datasets.bag_reader import open_bag
    from loam_gtsam.datasets.loam_messages import REQUIRED
    from loam_gtsam.datasets.loam_topics import LoamTopicsDataset

    with closing(open_bag(path)) as reader:
        topics = set(reader.topics)
    plain = set(inspect.signature(BagDataset).parameters) & set(options)
    if "axes" in options or (topics.issuperset(REQUIRED) and not plain):
        return _construct(LoamTopicsDataset, path, options)
    return _construct(BagDataset, path, options)


def _open_world(text: str, options: dict[str, Any]) -> Dataset:
    scene, _, query = text.removeprefix("sim:").partition("?")
    try:
        settings = {
            key: _number_or_text(value)
            for key, value in parse_qsl(query, strict_parsing=bool(query))
        }
    except ValueError as error:
        raise DatasetError(
            f"{text}: expected sim:SCENE?frames=NUMBER&seed=NUMBER&sensor=NAME: {error}"
        ) from error
    from loam_gtsam.datasets.simulation import SimulatedWorld

    return _construct(SimulatedWorld, scene, {**settings, **options})


def _number_or_text(value: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(value)
        except ValueError:
            continue
    return value


def _construct(loader: Any, source: str | Path, options: dict[str, Any]) -> Dataset:
    known = list(inspect.signature(loader).parameters)[1:]
    unknown = [key for key in options if key not in known]
    if unknown:
        raise DatasetError(
            f"{source}: {loader.__name__} takes no option {', '.join(unknown)}; "
            f"it takes {', '.join(known)}"
        )
    dataset: Dataset = loader(source, **options)
    return dataset
