"""Our mapping stage beside what the C++ systems recorded of theirs, on the same sweeps."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.cases import EvidenceTable, Verdict
from benchmarks.process import processor_clock
from loam_gtsam.config import Config
from loam_gtsam.datasets import ArrayDataset, open_dataset
from loam_gtsam.frontend.rings import rings_from_elevation
from loam_gtsam.io.run_files import stage_seconds
from loam_gtsam.pipeline import run
from loam_gtsam.registration.odometry import Guess, Odometry
from loam_gtsam.types import DatasetError, Features, FloatArray, MapUpdate, Scan, Trajectory

MAPPING = ("prepare", "match", "solve", "insert")
"""Our stages from features and a guess to a pose and a larger map; theirs gives no covariance."""
SHARE = 0.25
"""Target: of A-LOAM's mapping stage, from its own sweeps on."""
_UNIT, _ORIGIN = 0.002, np.array([0.0, 0.0, 0.03618])
"""Metres: of the integers of an .xyz16 file, and where the beams of an Ouster begin."""
_PARTS = ("reg_total", "odo_total", "map_total")
"""Milliseconds of scan registration, odometry and mapping, in ``timing.csv``."""


@dataclass(frozen=True, slots=True)
class Rival:
    """A recorded system, and the sweeps that ours maps.

    Attributes
    ----------
    timing : its ``timing.csv``, below the data folder
    source : raw sweeps, or the features and odometry it mapped itself
    target : share of its mapping stage that ours may take; None is no target
    """

    system: str
    timing: str
    source: str
    target: float | None = None


RIVALS = (
    Rival("A-LOAM", "aloam_town/timing.csv", "sim_town", SHARE),
    Rival("A-LOAM", "aloam_town/timing.csv", "aloam_town/topics.bag"),
    Rival("loam_velodyne", "loam_town/timing.csv", "sim_town"),
    Rival("loam_velodyne", "loam_town/timing.csv", "loam_town/topics.bag"),
)


@dataclass(frozen=True, slots=True)
class RivalResult:
    """Median milliseconds a frame: its mapping and whole pipeline, ours; NaN without the latter."""

    rival: Rival
    its_mapping: float
    its_total: float
    mapping: float
    total: float

    @property
    def verdict(self) -> Verdict | None:
        """Of the target, if there is one."""
        share = self.rival.target
        if share is None:
            return None
        return Verdict(f"<= {share:g} x", self.mapping <= share * self.its_mapping)


def read_timing(path: Path) -> tuple[float, float]:
    """Median milliseconds of the mapping stage, and of all stages of a frame."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = [[float(row[part]) for part in _PARTS] for row in csv.DictReader(file)]
    milliseconds = np.array(rows)
    return float(np.median(milliseconds[:, -1])), float(np.median(milliseconds.sum(axis=1)))


def measure_all(data: Path) -> list[RivalResult]:
    """Map the sweeps of each rival whose files are in the data folder."""
    ours: dict[str, tuple[float, float]] = {}
    results = []
    for rival in RIVALS:
        if not all((data / name).exists() for name in (rival.timing, rival.source)):
            continue
        if rival.source not in ours:
            ours[rival.source] = _ours(data / rival.source)
        results.append(RivalResult(rival, *read_timing(data / rival.timing), *ours[rival.source]))
    return results


def _ours(source: Path) -> tuple[float, float]:
    """Median milliseconds of our mapping stage and of everything, in processor time."""
    alone = Config().changed("imu.coupling=off")  # as the recorded ones
    with processor_clock():
        names, seconds = stage_seconds(run(open_dataset(source), alone).updates)
    mapping = np.nansum(seconds[:, [names.index(stage) for stage in MAPPING]], axis=1)
    whole = "features" in names  # recorded features are no work of ours
    total = np.median(np.nansum(seconds, axis=1)) if whole else np.nan
    return 1e3 * float(np.median(mapping)), 1e3 * float(total)


def table(results: Sequence[RivalResult]) -> EvidenceTable:
    """One row a rival."""
    header = ("system", "its mapping [ms]", "ours on", "our mapping [ms]", "ratio", "target",
              "its pipeline [ms]", "our pipeline [ms]", "ratio")  # fmt: skip
    rows = []
    for result in results:
        whole = ("-", "-")
        if not np.isnan(result.total):
            whole = f"{result.total:.1f}", f"{result.total / result.its_total:.2f}"
        rows.append(
            (
                result.rival.system,
                f"{result.its_mapping:.1f}",
                result.rival.source,
                f"{result.mapping:.1f}",
                f"{result.mapping / result.its_mapping:.2f}",
                str(result.verdict or ""),
                f"{result.its_total:.1f}",
                *whole,
            )
        )
    return EvidenceTable("growth_recorded", "Beside the recorded C++ systems", header, tuple(rows))


def hand_held(folder: Path) -> ArrayDataset:
    """Sweeps of a 64-beam Ouster, de-skewed and without rings: the beams are those of the first.

    De-skewing moves the points off the elevations of their beams; in the first sweep, of a lidar at
    rest, the beams stand out.
    """

    def elevations(points: FloatArray) -> FloatArray:
        x, y, z = (points - _ORIGIN).T
        return np.asarray(np.arctan2(z, np.hypot(x, y)))

    files = sorted(folder.glob("*.xyz16"))
    sweeps = [_UNIT * np.fromfile(file, "<i2").reshape(-1, 3) for file in files]
    found, note = rings_from_elevation(sweeps[0].T.astype(np.float32), "os1-64")
    if found is None:
        raise DatasetError(f"{files[0]}: {note}")
    beams = np.bincount(found.rings, elevations(sweeps[0])) / np.bincount(found.rings)
    between = 0.5 * (beams[1:] + beams[:-1])
    scans = [
        Scan(points, stamp, rings=np.searchsorted(between, elevations(points)))
        for points, stamp in zip(sweeps, given_poses(folder).stamps.tolist(), strict=True)
    ]
    return ArrayDataset(scans, name=folder.name, sensor={"times": "none"})


def given_poses(folder: Path) -> Trajectory:
    """The poses that FAST-LIO gave the hand-held sweeps; they are no truth."""
    table = np.loadtxt(folder / "fastlio_poses.txt")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3] = table[:, 1:].reshape(-1, 3, 4)
    return Trajectory(np.round(table[:, 0] * 1e9).astype(np.int64), poses)


class GivenSteps(Odometry):
    """The odometry by the steps between given poses.

    From one of the hand-held sweeps to the next the lidar turns by up to 40 degrees, which no
    constant velocity foretells.
    """

    def __init__(self, poses: Trajectory) -> None:
        self._poses = dict(
            zip(poses.stamps.tolist(), map(gtsam.Pose3, poses.map_T_lidar), strict=True)
        )

    def guess(self, features: Features, last: MapUpdate | None) -> Guess:
        """The pose of the last sweep, and the step from there."""
        pose = gtsam.Pose3()
        if last is not None:
            step = self._poses[last.stamp].between(self._poses[features.stamp])
            pose = last.map_T_lidar.compose(step)
        return Guess(pose, np.zeros(6))
