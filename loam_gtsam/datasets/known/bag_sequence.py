"""Bags of a known data set: their parts, topics, extrinsics and reference poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

from loam_gtsam.datasets.bags.bag import BagDataset
from loam_gtsam.datasets.bags.bag_reader import open_bag
from loam_gtsam.datasets.base import BagOptions, DatasetInfo
from loam_gtsam.datasets.decode.extrinsics import (
    Rig,
    describe_extrinsics,
    extrinsic_settings,
    moved_to_lidar,
)
from loam_gtsam.datasets.decode.tables import read_poses
from loam_gtsam.types import Trajectory


class BagSequence(BagDataset):
    """Bags (``parts``) recorded by a known rig, with a file of reference poses (``truth``) or None.

    For the options see :class:`~loam_gtsam.datasets.base.BagOptions`; topics default to the rig's.
    """

    def __init__(
        self,
        path: Path,
        parts: Sequence[Path],
        rig: Rig,
        truth: Path | None,
        **options: Unpack[BagOptions],
    ) -> None:
        with closing(open_bag(path, parts)) as reader:
            known = set(reader.topics)
        options["topic"] = options.get("topic") or (rig.topic if rig.topic in known else None)
        if not options.get("imu_topic") and rig.imu_topic in known:
            options["imu_topic"] = rig.imu_topic
        super().__init__(path, parts=parts, **options)
        self._rig, self._truth_file = rig, truth
        self.name = path.resolve().name if path.is_dir() else path.stem
        if self.imu_topic == rig.imu_topic:
            self.sensor: Mapping[str, Any] = extrinsic_settings(rig.lidar_T_imu)
        elif self.imu_topic is not None:
            self._problems.append(
                f"IMU: not the {rig.imu_topic} of {rig.kind}, so its rotation to the lidar is "
                "unknown: set imu.lidar_R_imu_deg"
            )

    @cached_property
    def truth(self) -> Trajectory | None:
        """The reference poses, moved to the lidar; None without their file."""
        if self._truth_file is None:
            return None
        return moved_to_lidar(read_poses(self._truth_file, self._problems), self._rig.body_T_lidar)

    def info(self) -> DatasetInfo:
        """Description of the bags, with their extrinsics and reference poses."""
        truth = self.truth  # first: it may find problems
        info = super().info()
        info.kind = f"{self._rig.kind}, {info.kind}"
        if len(self._parts) > 1:
            info.facts["bags"] = f"{self._parts[0].name} and {len(self._parts) - 1} more"
        if self.sensor:
            info.facts["IMU to lidar"] = describe_extrinsics(self.sensor, self._rig.source)
        info.facts["reference poses"] = "none"
        if truth is not None and self._truth_file is not None:
            info.facts["reference poses"] = f"{len(truth)} ({self._truth_file.name})"
        return info
