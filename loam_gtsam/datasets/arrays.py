"""Sweeps that are already in memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.datasets.base import DatasetInfo, Loader
from loam_gtsam.datasets.decode.aiding import GnssFixes, WheelSamples
from loam_gtsam.datasets.decode.point_times import shorter_period, span_problem, usual_step
from loam_gtsam.datasets.decode.tables import describe_imu, describe_stamps
from loam_gtsam.errors import check_all, check_kind
from loam_gtsam.geometry import as_array, as_stamps
from loam_gtsam.types import (
    MAX_STAMP,
    ImuSamples,
    InputError,
    IntArray,
    Scan,
    Trajectory,
)

_LATEST = MAX_STAMP * 1e-9  # seconds
_SHORTEST = 1_000_000
"""Nanoseconds between sweeps; no spinning lidar turns a thousand times a second."""

_PARTS: dict[str, tuple[type, str]] = {
    "imu": (ImuSamples, "stamps, orientation, gyro, acceleration"),
    "truth": (Trajectory, "stamps, map_T_lidar"),
    "gnss": (GnssFixes, "stamps, geodetic, covariances"),
    "wheels": (WheelSamples, "stamps, start_T_body"),
}
"""What a data set has beside its sweeps: the classes, and of what they are made."""


class ArrayDataset(Loader):
    """Sweeps from numpy arrays, or ready :class:`Scan` objects.

    Parameters
    ----------
    scans : arrays of shape (N, 3) or (N, 4) in metres, lidar frame (a fourth column, intensity,
        is ignored); or Scan objects, which carry everything below themselves
    stamps : integer nanoseconds, one per array
    stamps_s : instead of ``stamps``: float seconds
    times : per array (N,) seconds from its stamp at which each point was measured
    rings : per array (N,) integer beam numbers
    imu, truth, gnss, wheels : handed through
    name : for output files
    sensor : fields of ``SensorConfig`` these sweeps imply

    Raises
    ------
    InputError
        If a shape, a dtype, a number of entries or the class of a part is wrong, or ``times`` span
        several sweeps.
    """

    def __init__(
        self,
        scans: Iterable[Scan | NDArray[Any]],
        stamps: Sequence[int] | NDArray[np.integer] | None = None,
        *,
        stamps_s: Sequence[float] | NDArray[np.floating] | None = None,
        times: Sequence[NDArray[np.floating]] | None = None,
        rings: Sequence[NDArray[np.integer]] | None = None,
        imu: ImuSamples | None = None,
        truth: Trajectory | None = None,
        gnss: GnssFixes | None = None,
        wheels: WheelSamples | None = None,
        name: str = "arrays",
        sensor: Mapping[str, Any] | None = None,
    ) -> None:
        check_kind(scans, Iterable, "scans", "a list of arrays, or of Scan objects, is one")
        if sensor is not None:
            check_kind(sensor, Mapping, "sensor", '{"min_range": 2.0} is one')
        entries = list(scans)
        for part, given in {"imu": imu, "truth": truth, "gnss": gnss, "wheels": wheels}.items():
            if given is not None:
                kind, fields = _PARTS[part]
                check_kind(given, kind, part, f"{kind.__name__}({fields}) makes one")
        self.name, self.imu, self.truth = name, imu, truth
        self.gnss, self.wheels = gnss, wheels
        self.sensor: Mapping[str, Any] = dict(sensor or {})
        if any(isinstance(entry, Scan) for entry in entries):
            self._scans = _ready(entries, (stamps, stamps_s, times, rings))
        else:
            self._scans = _made(entries, _stamps(stamps, stamps_s), times, rings)
        _check_spans(self._scans)
        if any(scan.times is None for scan in self._scans):
            period = shorter_period([scan.stamp for scan in self._scans])
            self.sensor = {**period, **self.sensor}

    def __len__(self) -> int:
        return len(self._scans)

    def __iter__(self) -> Iterator[Scan]:
        return iter(self._scans)

    @property
    def stamps(self) -> IntArray:
        """(N,) nanoseconds of the sweeps."""
        return np.array([scan.stamp for scan in self._scans], np.int64)

    def info(self) -> DatasetInfo:
        """Description of the arrays."""
        info = DatasetInfo("arrays", self.name, {"sweeps": str(len(self))})
        describe_stamps(self.stamps, info.facts, info.problems)
        for label in ("times", "rings"):
            missing = sum(getattr(scan, label) is None for scan in self._scans)
            info.facts[f"point {label}"] = (
                f"given for {len(self) - missing} of {len(self)} sweeps" if self._scans else "none"
            )
        info.facts["IMU"] = describe_imu(self.imu)
        if not self._scans:
            info.problems.append("no sweeps")
        return info


def _ready(entries: Sequence[Any], columns: Sequence[Any]) -> list[Scan]:
    """Scans as they are given."""
    check_all(entries, Scan, "scans", "give either Scan objects alone or arrays alone")
    if any(column is not None for column in columns):
        raise InputError(
            "scans: Scan objects carry their own stamps, times and rings; give none of stamps, "
            "stamps_s, times, rings"
        )
    return list(entries)


def _made(
    entries: Sequence[Any],
    stamps: IntArray,
    times: Sequence[NDArray[np.floating]] | None,
    rings: Sequence[NDArray[np.integer]] | None,
) -> list[Scan]:
    """Scans of arrays."""
    for label, column in (("stamps", stamps), ("times", times), ("rings", rings)):
        if column is not None and len(column) != len(entries):
            raise InputError(f"{label}: expected {len(entries)} entries, got {len(column)}")
    scans: list[Scan] = []
    for index, entry in enumerate(entries):
        if not isinstance(entry, np.ndarray) or entry.ndim != 2 or entry.shape[1] not in (3, 4):
            got = entry.shape if isinstance(entry, np.ndarray) else type(entry).__name__
            raise InputError(f"scans[{index}]: expected an (N, 3) or (N, 4) array, got {got}")
        columns = None if times is None else times[index], None if rings is None else rings[index]
        try:
            scans.append(Scan(entry[:, :3], int(stamps[index]), *columns))
        except InputError as error:
            raise InputError(f"scans[{index}]: {error}") from error
    return scans


def _check_spans(scans: Sequence[Scan]) -> None:
    step = usual_step([scan.stamp for scan in scans])
    if problem := span_problem((scan.times for scan in scans), step):
        raise InputError(f"times: {problem}")


def _stamps(stamps: Any, stamps_s: Any) -> IntArray:
    if (stamps is None) == (stamps_s is None):
        kinds = "stamps (integer nanoseconds) or stamps_s (float seconds)"
        raise InputError(f"give the stamps of the sweeps once: {kinds}")
    if stamps is not None:
        values = as_stamps(stamps, "stamps")
        step = float(np.median(np.diff(values))) if len(values) > 2 else 0.0
        if 0.0 < step < _SHORTEST:
            apart = f"the sweeps are {step:g} ns apart"
            raise InputError(f"stamps: {apart}; expected nanoseconds, stamps_s takes seconds")
        return values
    seconds = as_array(stamps_s, "stamps_s", ("N",))
    largest = float(np.abs(seconds).max(initial=0.0))
    if largest > _LATEST:
        units = ("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)
        unit = next((unit for unit, times in units if largest <= times * _LATEST), "another unit")
        raise InputError(
            f"stamps_s: expected seconds, {_LATEST:.2g} at most, got {largest:.10g}, probably "
            f"{unit}; stamps takes integer nanoseconds"
        )
    # Whole and fractional seconds apart: their product with 1e9 would lose the last digits.
    whole = np.floor(seconds)
    fraction = np.rint((seconds - whole) * 1e9)
    return np.asarray(whole.astype(np.int64) * 10**9 + fraction.astype(np.int64))
