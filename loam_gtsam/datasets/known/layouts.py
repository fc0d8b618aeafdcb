"""File and folder names by which known data sets are told."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from loam_gtsam.types import DatasetError

MULRAN_FOLDERS = ("Ouster", "sensor_data/Ouster")
HELIPR_LIDARS = ("Ouster", "Velodyne", "Avia", "Aeva")
NEWER_COLLEGE_SCANS = "raw_format/ouster_scan"
SPIRES_CLOUDS = "raw/lidar-clouds"

_ROOSTER = re.compile(r"rooster_[\d-]+_(?P<part>\d+)")
_COLLECTION = re.compile(
    r"\d{4}(-\d\d){5}(_(?P<part>\d+))?-"
    r"(?P<name>(quad|math|underground|mine)-(easy|medium|hard)|stairs|cloister|park)"
)


def known_loader(path: Path) -> str | None:
    """Class of the loader of the known data set whose marks ``path`` bears, or None."""
    if path.is_file():
        return None if newer_college_sequence(path) is None else "NewerCollegeBags"
    if newer_college_sequences(path):
        return "NewerCollegeBags"
    if (path / NEWER_COLLEGE_SCANS).is_dir():
        return "NewerCollegeClouds"
    if (path / SPIRES_CLOUDS).is_dir():
        return "OxfordSpiresClouds"
    if spires_truth(path) is not None and spires_bags(path):
        return "OxfordSpiresBags"
    if (path / "lidar").is_dir() and (path / "applanix").is_dir():
        return "BoreasDataset"
    if any((path / "LiDAR" / name).is_dir() or helipr_truth(path, name) for name in HELIPR_LIDARS):
        return "HeLiPRDataset"
    return "MulRanDataset" if first_existing(path, MULRAN_FOLDERS) is not None else None


def first_existing(root: Path, names: Sequence[str]) -> Path | None:
    """The first of these files or folders that is there."""
    return next((root / name for name in names if (root / name).exists()), None)


def newer_college_sequence(bag: Path) -> tuple[str, int] | None:
    """Name of the sequence (``rooster`` in 2020) and number of the part."""
    if bag.suffix != ".bag":
        return None
    if match := _ROOSTER.fullmatch(bag.stem):
        return "rooster", int(match["part"])
    if match := _COLLECTION.fullmatch(bag.stem):
        return match["name"], int(match["part"] or 0)
    return None


def newer_college_sequences(root: Path) -> Mapping[str, list[Path]]:
    """The bags of each sequence in a folder, or in its ``rosbag/``, in order."""
    for folder in (root, root / "rosbag"):
        found: dict[str, dict[int, Path]] = {}
        for bag in sorted(folder.glob("[!.]*.bag")):
            if (known := newer_college_sequence(bag)) is None:
                continue
            parts = found.setdefault(known[0], {})
            if known[1] in parts:
                both = f"{parts[known[1]].name} and {bag.name} are both part {known[1]}"
                hint = "several recordings; open one bag, or keep each recording in its own folder"
                raise DatasetError(f"{folder}: {both}: {hint}")
            parts[known[1]] = bag
        if found:
            return {name: [parts[n] for n in sorted(parts)] for name, parts in found.items()}
    return {}


def spires_truth(root: Path) -> Path | None:
    """Reference poses of an Oxford Spires sequence."""
    return first_existing(root, ["gt-tum.txt", "processed/trajectory/gt-tum.txt"])


def spires_bags(root: Path) -> list[Path]:
    """ROS 1 files, ROS 2 folders, or the folder itself if it is one."""
    for folder in (root, root / "raw/rosbag", root / "raw/ros2bag"):
        if (folder / "metadata.yaml").is_file():
            return [folder]
        inner = sorted(file.parent for file in folder.glob("[!.]*/metadata.yaml"))
        if found := sorted(folder.glob("[!.]*.bag")) or inner:
            return found
    return []


def helipr_truth(root: Path, lidar: str) -> Path | None:
    """Reference poses of a lidar of HeLiPR."""
    names = [f"{lidar}_gt.txt", f"global_{lidar}_gt.txt"]
    return first_existing(root, [*(f"LiDAR_GT/{name}" for name in names), *names])
