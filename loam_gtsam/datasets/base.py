"""The interface of a data set, and what loaders have in common."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice, pairwise
from operator import attrgetter
from pathlib import Path
from statistics import median_low
from typing import Any, Protocol, TypeVar, cast, runtime_checkable

import numpy as np

from loam_gtsam.datasets.decode.aiding import GnssFixes, WheelSamples
from loam_gtsam.datasets.decode.extrinsics import moved_to_lidar
from loam_gtsam.datasets.decode.pointcloud2 import TimeOptions
from loam_gtsam.errors import check_part
from loam_gtsam.types import (
    BadSweep,
    DatasetError,
    FloatArray,
    ImuSamples,
    InputError,
    IntArray,
    Scan,
    Sweep,
    Trajectory,
)

_T = TypeVar("_T")
_IN_A_ROW = 5
"""Number of sweeps at the beginning whose stamps are compared, and of consecutive ones beyond the
end of a part after which no more are read; one wrong stamp is no end."""
_FAR, _STEPS = 10 * 10**9, 10  # nanoseconds, and usual steps, beyond which a first stamp is wrong


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
    gnss_topic, wheels_topic : of a GNSS receiver and of wheels; likewise
    time_field, time_unit, stamp_is : see
        :func:`loam_gtsam.datasets.decode.pointcloud2.decode_pointcloud2`
    """

    topic: str | None
    imu_topic: str | None
    gnss_topic: str | None
    wheels_topic: str | None


@runtime_checkable
class Dataset(Protocol):
    """A sequence of sweeps. Iterating twice gives the same sweeps twice."""

    @property
    def name(self) -> str:
        """For people."""
        ...

    @property
    def sensor(self) -> Mapping[str, Any]:
        """Fields of ``SensorConfig``, and of ``ImuConfig`` as ``imu.NAME``, that the data implies.

        The user's own win.
        """
        ...

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


def check_dataset(dataset: object) -> None:
    """InputError for anything without the members of a :class:`Dataset` that a run asks for."""
    check_part(dataset, "dataset", "a Dataset")
    # Of the class first: a property of a bag reads all of its IMU.
    missing = [
        repr(name)
        for name in ("name", "sensor", "imu", "__iter__")
        if not (hasattr(type(dataset), name) or hasattr(dataset, name))
    ]
    if missing:
        raise InputError(
            f"dataset: expected a Dataset, got {type(dataset).__name__} without "
            f"{', '.join(missing)}; open_dataset makes one of a path, ArrayDataset of arrays or "
            "Scan objects, and docs/own_sensor.md shows one of your own"
        )


def sweeps_of_run(dataset: Dataset, count: int) -> Iterator[Sweep]:
    """The sweeps of so many frames of a run, from the data set that was run.

    A DatasetError follows the last one if there are fewer.
    """
    found = 0
    for sweep in islice(dataset, count):
        found += 1
        yield sweep
    if found < count:
        raise DatasetError(
            f"{dataset.name}: expected the {count} sweeps of the run, got {found}; give the data "
            "set of the run"
        )


class Loader(Protocol):
    """What every loader can do besides: be cut, be given reference poses, and show itself."""

    def __repr__(self) -> str:
        shown = cast(Dataset, self)
        return f"{type(self).__name__}({shown.name!r}: {len(shown)} sweeps)"

    def part(
        self,
        start: int = 0,
        every: int = 1,
        *,
        begin_s: float | None = None,
        end_s: float | None = None,
    ) -> PartOf:
        """Some of the sweeps of this data set; IMU and reference poses stay whole.

        Parameters
        ----------
        start, every : number of the first sweep that is used, and the step to the next
        begin_s, end_s : seconds after the first sweep of the data set between which sweeps are
            used; a first sweep whose stamp is far from those of the next ones does not count
        """
        return PartOf(cast(Dataset, self), start, every, begin_s, end_s)

    def with_truth(
        self,
        truth: Trajectory | str | Path,
        *,
        topic: str | None = None,
        body_T_lidar: FloatArray | None = None,
    ) -> WithTruth:
        """The same data set with other reference poses, see :meth:`WithTruth.of`."""
        return WithTruth.of(cast(Dataset, self), truth, topic=topic, body_T_lidar=body_T_lidar)


class LoadedDataset(Dataset, Loader, Protocol):
    """A data set of a loader of this package, which has the methods of both."""


class ChangedDataset(Loader):
    """A data set made of another one by a ``change``, which is added to its name."""

    def __init__(self, dataset: Dataset, change: str) -> None:
        self._dataset = dataset
        self.name = f"{dataset.name} {change}".rstrip()
        self.sensor: Mapping[str, Any] = dataset.sensor

    @property
    def imu(self) -> ImuSamples | None:
        """IMU of the other data set."""
        return self._dataset.imu

    @property
    def gnss(self) -> GnssFixes | None:
        """Fixes of the other data set, if it has any."""
        return getattr(self._dataset, "gnss", None)

    @property
    def wheels(self) -> WheelSamples | None:
        """Wheels of the other data set, if it has any."""
        return getattr(self._dataset, "wheels", None)

    @property
    def truth(self) -> Trajectory | None:
        """Reference poses of the other data set, those of missing sweeps included."""
        return self._dataset.truth

    def _info(self, **facts: str) -> DatasetInfo:
        info = self._dataset.info()
        more = {label.replace("_", " "): text for label, text in facts.items()}
        return replace(info, facts=info.facts | more)


class PartOf(ChangedDataset):
    """Some of the sweeps of a data set, see :meth:`Loader.part`; InputError if there are none."""

    def __init__(
        self,
        dataset: Dataset,
        start: int,
        every: int,
        begin_s: float | None = None,
        end_s: float | None = None,
    ) -> None:
        low = 0.0 if begin_s is None else begin_s
        high = np.inf if end_s is None else end_s
        whole = all(isinstance(number, (int, np.integer)) for number in (start, every))
        if not whole or start < 0 or every < 1 or not 0.0 <= low < high:
            raise InputError(
                "part: expected a whole start of 0 or more, every of 1 or more, and 0 <= begin < "
                f"end; got start {start}, every {every}, begin {begin_s} s, end {end_s} s"
            )
        said = [f"from sweep {start}"] if start else []
        said += [f"every {every}"] if every > 1 else []
        said += [f"{low:g} to {high:g} s"] if np.isfinite(high) else []
        said += [f"from {low:g} s"] if low and not np.isfinite(high) else []
        super().__init__(dataset, " ".join(said))
        self._said, self._slice, self._window = (
            ", ".join(said),
            slice(start, None, every),
            (low, high),
        )
        if not len(self):
            raise InputError(
                f"part: expected some of the {len(dataset)} sweeps of {dataset.name}, got none "
                f"({self._said or 'all'}); ask for others"
            )

    def __len__(self) -> int:
        """Number of sweeps; the most there can be if only reading them tells their stamps."""
        stamps = getattr(self._dataset, "stamps", None)
        if stamps is None or not self._timed:
            return len(range(len(self._dataset))[self._slice])
        return sum(1 for _ in self._inside(stamps.tolist(), int))

    def __iter__(self) -> Iterator[Sweep]:
        every = islice(self._dataset, self._slice.start, None, self._slice.step)
        return self._inside(self._dataset, attrgetter("stamp")) if self._timed else every

    @property
    def _timed(self) -> bool:
        return self._window != (0.0, np.inf)

    def _inside(self, sweeps: Iterable[_T], stamp_of: Callable[[_T], int]) -> Iterator[_T]:
        """Those of the sweeps that are in the part."""
        rest = iter(sweeps)
        begin = list(islice(rest, _IN_A_ROW))
        first, beyond = _first_stamp([stamp_of(sweep) for sweep in begin]), 0
        for number, sweep in enumerate(chain(begin, rest), -self._slice.start):
            seconds = (stamp_of(sweep) - first) * 1e-9
            beyond = beyond + 1 if seconds > self._window[1] else 0
            if beyond == _IN_A_ROW:
                return
            taken = number >= 0 and number % self._slice.step == 0
            if taken and self._window[0] <= seconds <= self._window[1]:
                yield sweep

    def info(self) -> DatasetInfo:
        """Of the whole data set, and which part of it is used."""
        known = not self._timed or getattr(self._dataset, "stamps", None) is not None
        most = "" if known else "at most "
        return self._info(used=f"{self._said}: {most}{len(self)} sweeps")


def _first_stamp(stamps: Sequence[int]) -> int:
    """The first of the stamps of the first sweeps, ns, that is not far from the others."""
    middle = median_low(stamps or [0])
    steps = [abs(after - before) for before, after in pairwise(stamps)]
    near = max(_FAR, _STEPS * median_low(steps or [0]))
    return next((stamp for stamp in stamps if abs(stamp - middle) <= near), middle)


class WithTruth(ChangedDataset):
    """A data set with other reference poses, see :meth:`Loader.with_truth`."""

    def __init__(
        self, dataset: Dataset, truth: Trajectory, source: str, problems: Sequence[str] = ()
    ) -> None:
        super().__init__(dataset, "")
        self._truth, self._source, self._problems = truth, source, list(problems)

    @classmethod
    def of(
        cls,
        dataset: Dataset,
        truth: Trajectory | str | Path,
        *,
        topic: str | None = None,
        body_T_lidar: FloatArray | None = None,
    ) -> WithTruth:
        """A data set with the reference poses of a file.

        Parameters
        ----------
        truth : poses, or a file of them, see :func:`loam_gtsam.datasets.truth.read_truth`
        topic : of a bag
        body_T_lidar : (4, 4) pose of the lidar in the frame whose poses are given
        """
        if isinstance(truth, Trajectory):
            if body_T_lidar is not None:
                truth = moved_to_lidar(truth, body_T_lidar)
            return cls(dataset, truth, "given")
        # By name, as the loaders: what reads bags is itself made of what is here.
        reader = importlib.import_module("loam_gtsam.datasets.truth")
        problems: list[str] = []
        stamps = getattr(dataset, "stamps", None)
        poses = reader.read_truth(
            truth, topic=topic, body_T_lidar=body_T_lidar, stamps=stamps, problems=problems
        )
        return cls(dataset, poses, str(truth), problems)

    def __len__(self) -> int:
        return len(self._dataset)

    def __iter__(self) -> Iterator[Sweep]:
        return iter(self._dataset)

    @property
    def truth(self) -> Trajectory | None:
        """The poses that were given."""
        return self._truth

    @property
    def stamps(self) -> IntArray | None:
        """Of the sweeps, if the data set knows them without reading."""
        return getattr(self._dataset, "stamps", None)

    def info(self) -> DatasetInfo:
        """Of the data set, and where the poses come from."""
        info = self._info(reference_poses=f"{len(self._truth)} ({self._source})")
        span, problems = self.stamps, [*info.problems, *self._problems]
        if not len(self._truth):
            problems.append(f"{self._source}: no poses in it")
        elif span is not None and len(span):
            first, last = self._truth.stamps[[0, -1]]
            if not ((span >= first) & (span <= last)).any():
                problems.append(
                    f"{self._source}: its stamps, {first * 1e-9:.3f} to {last * 1e-9:.3f} s, are "
                    "none of the sweeps'"
                )
        return replace(info, problems=problems)


class SweepFiles(Loader, ABC):
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
