"""The interface of a data set, and what loaders have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from loam_gtsam.datasets.decode.pointcloud2 import TimeOptions
from loam_gtsam.types import BadSweep, DatasetError, ImuSamples, IntArray, Scan, Sweep, Trajectory


@dataclass(slots=True)
class DatasetInfo:
    """What the loader of a data set understood, for people.

    Attributes
    ----------
    kind : e.g. "KITTI folder", "ROS 1 bag"
    path : where it was read from
    facts : label -> value, in the order to show them (topics, fields, unit of time, beams, ...)
    problems : one sentence each: what is missing or odd, and what was or can be done about it
    """

    kind: str
    path: str
    facts: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


class BagOptions(TimeOptions, total=False):
    """Keyword arguments of every loader of bags with ``PointCloud2`` sweeps; all may be left out.

    Attributes
    ----------
    topic, imu_topic : of sweeps and IMU; None takes the one of the known data set, else the one of
        its type with the most messages
    time_field, time_unit, stamp_is : see
        :func:`loam_gtsam.datasets.decode.pointcloud2.decode_pointcloud2`
    """

    topic: str | None
    imu_topic: str | None


@runtime_checkable
class Dataset(Protocol):
    """A sequence of sweeps. Iterating twice gives the same sweeps twice."""

    name: str
    sensor: Mapping[str, Any]
    """Fields of ``SensorConfig``, and of ``ImuConfig`` as ``imu.NAME``, that the layout of the data
    implies; the user's own win."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Sweep]: ...

    def info(self) -> DatasetInfo:
        """May read the first sweeps, never the whole data."""
        ...

    @property
    def imu(self) -> ImuSamples | None:
        """All IMU data if there is any."""
        ...

    @property
    def truth(self) -> Trajectory | None:
        """Reference poses if the data comes with them."""
        ...


class ChangedDataset:
    """A data set made of another one by a ``change``, which is added to its name."""

    def __init__(self, dataset: Dataset, change: str) -> None:
        self._dataset = dataset
        self.name = f"{dataset.name} {change}"
        self.sensor: Mapping[str, Any] = dataset.sensor

    @property
    def imu(self) -> ImuSamples | None:
        """IMU of the other data set."""
        return self._dataset.imu

    @property
    def truth(self) -> Trajectory | None:
        """Reference poses of the other data set, those of missing sweeps included."""
        return self._dataset.truth

    def _info(self, **facts: str) -> DatasetInfo:
        info = self._dataset.info()
        more = {label.replace("_", " "): text for label, text in facts.items()}
        return replace(info, facts=info.facts | more)


class SweepFiles(ABC):
    """The sweeps of a data set with one file each; one that cannot be read is a bad sweep."""

    stamps: IntArray
    """(N,) nanoseconds."""
    _files: list[Path]

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[Scan | BadSweep]:
        for file, stamp in zip(self._files, self.stamps.tolist(), strict=True):
            try:
                yield self._read(file, stamp)
            except DatasetError as error:
                yield BadSweep(stamp, str(error))

    @abstractmethod
    def _read(self, file: Path, stamp: int) -> Scan: ...
