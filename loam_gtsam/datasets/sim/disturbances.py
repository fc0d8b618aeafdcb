"""Sweeps as they should not be: passing objects, outliers, drop-outs, gaps, a kidnapped lidar.

``Disturbed(dataset, [Outliers(0.2), MissingSweeps(at=(40, 80))])``. Everything random comes from a
seed and the number of the sweep: iterating twice gives the same sweeps twice.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import islice

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.base import ChangedDataset, Dataset, DatasetInfo, check_dataset
from loam_gtsam.datasets.decode.extrinsics import rigid_transform
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.errors import (
    are_two_numbers,
    as_one_array,
    check_all,
    check_array,
    check_count,
    check_kind,
    check_number,
    is_number,
)
from loam_gtsam.geometry import as_vector
from loam_gtsam.types import (
    BadSweep,
    BoolArray,
    ConfigError,
    FeatureSweep,
    FloatArray,
    ImuSamples,
    InputError,
    IntArray,
    Scan,
    Sweep,
    Trajectory,
)

_REACH = 60.0  # metres ahead and behind that hold moving objects
_CALIBRATIONS = 16  # moments at which the share of points on moving objects is averaged


class Disturbance:
    """Change of the sweeps of a data set; this base class changes nothing."""

    def keeps(self, number: int) -> bool:
        """Whether the sweep of that number (from 0) arrives at all."""
        return True

    def apply(self, number: int, scan: Scan) -> Scan:
        """The sweep as it arrives; rows stay in place, lost points become NaN."""
        return scan


@dataclass(frozen=True, slots=True)
class Outliers(Disturbance):
    """Points moved along their beams to a random range, uniform within bounds.

    Parameters
    ----------
    share : of the points of each sweep
    ranges : least and largest, metres
    """

    share: float = 0.2
    ranges: tuple[float, float] = (1.0, 50.0)
    seed: int = 0

    def __post_init__(self) -> None:
        _check_share(self.share)
        check_count(self.seed, "seed")
        _check_pair(self.ranges, "ranges")

    def apply(self, number: int, scan: Scan) -> Scan:
        """See :meth:`Disturbance.apply`."""
        _check_sweep(number, scan)
        rng = np.random.default_rng([self.seed, number])
        chosen = rng.permutation(len(scan.points))[: round(self.share * len(scan.points))]
        return _at_ranges(scan, chosen, rng.uniform(*self.ranges, len(chosen)))


@dataclass(frozen=True, slots=True)
class SectorDropouts(Disturbance):
    """Sectors of azimuth without a return, at other places every few sweeps.

    Parameters
    ----------
    share : of the full circle
    sectors : of equal width, evenly spread
    seconds : after which they are somewhere else
    """

    share: float = 0.25
    sectors: int = 2
    seconds: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        _check_share(self.share)
        check_count(self.seed, "seed")
        check_count(self.sectors, "sectors")
        check_number(self.seconds, "seconds")
        if self.sectors < 1 or not self.seconds > 0.0:
            wanted = "at least one sector and a time above 0 s"
            got = f"{self.sectors} and {self.seconds!r}"
            raise ConfigError(f"SectorDropouts: expected {wanted}, got {got}")

    def apply(self, number: int, scan: Scan) -> Scan:
        """See :meth:`Disturbance.apply`."""
        _check_sweep(number, scan)
        period = int(scan.stamp) // max(round(self.seconds * 1e9), 1)
        offset = np.random.default_rng([self.seed, period]).random()
        turn = np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2.0 * np.pi)
        lost = ((turn + offset) * self.sectors) % 1.0 < self.share
        points = scan.points.copy()
        points[lost] = np.nan
        return replace(scan, points=points)


@dataclass(frozen=True, slots=True)
class MissingSweeps(Disturbance):
    """Sweeps that never arrive.

    Parameters
    ----------
    at : number of the first one missing, of each gap
    count : sweeps in a row
    """

    at: tuple[int, ...]
    count: int = 1

    def __post_init__(self) -> None:
        at = as_one_array(self.at, "at")
        if at.size:
            check_array(at, "at", ("N",), "integer numbers of sweeps")
        check_count(self.count, "count")

    def keeps(self, number: int) -> bool:
        """See :meth:`Disturbance.keeps`."""
        return not any(first <= number < first + self.count for first in self.at)


@dataclass(frozen=True, slots=True)
class MovingObjects(Disturbance):
    """Two columns of boxes that pass the lidar on either side and hide what is behind them.

    They keep their speed in its frame, as traffic on the next lanes does: all points on them agree
    with each other on a wrong motion. Beams without a return meet none.

    Parameters
    ----------
    length, width, height : of a box, metres
    spacing : from the start of one to that of the next, metres
    lane : from the lidar to the near side of a box, metres
    bottom : of a box, metres, lidar frame
    speeds : of the left and of the right column along x, m/s, lidar frame
    range_noise : standard deviation along the beam, metres
    """

    length: float = 8.0
    width: float = 2.0
    height: float = 3.0
    spacing: float = 16.0
    lane: float = 2.5
    bottom: float = -1.5
    speeds: tuple[float, float] = (4.0, -9.0)
    range_noise: float = 0.02
    seed: int = 0

    def __post_init__(self) -> None:
        check_count(self.seed, "seed")
        _check_pair(self.speeds, "speeds")
        for item in fields(self):
            if item.name not in ("seed", "speeds"):
                check_number(getattr(self, item.name), item.name)
        if not 0.0 < self.length <= self.spacing or min(self.width, self.height, self.lane) <= 0.0:
            raise ConfigError(
                "MovingObjects: expected sizes and a lane above 0 m, and boxes no longer than "
                f"their spacing; got {self}"
            )

    def covering(self, share: float, scan: Scan) -> MovingObjects:
        """So long that they hide a share of a sweep's points; ConfigError if they never can."""
        _check_share(share)
        _check_sweep(0, scan)
        # Once past the slower column: the other one is then seen at as many places.
        period = self.spacing / min((abs(v) for v in self.speeds if v), default=self.spacing)
        moments = np.arange(_CALIBRATIONS) * (period / _CALIBRATIONS)

        def hidden(length: float) -> float:
            boxes = replace(self, length=length)
            shares = [np.isfinite(boxes._ranges(scan, at)).mean() for at in moments.tolist()]
            return float(np.mean(shares))

        low, high = 0.0, self.spacing
        if hidden(high) < share:
            hint = "bring the lane nearer or make the boxes higher"
            row = f"boxes in a row hide {hidden(high):.2f} of this sweep, not {share:g}"
            raise ConfigError(f"MovingObjects: {row}; {hint}")
        for _ in range(12):  # to a few millimetres
            middle = 0.5 * (low + high)
            low, high = (middle, high) if hidden(middle) < share else (low, middle)
        return replace(self, length=high)

    def hits(self, scan: Scan) -> BoolArray:
        """(N,) which points of a sweep lie on a box instead."""
        _check_sweep(0, scan)
        return np.asarray(np.isfinite(self._ranges(scan)))

    def apply(self, number: int, scan: Scan) -> Scan:
        """See :meth:`Disturbance.apply`."""
        _check_sweep(number, scan)
        ranges = self._ranges(scan)
        hit = np.isfinite(ranges)
        rng = np.random.default_rng([self.seed, number])
        ranges[hit] += self.range_noise * rng.standard_normal(int(hit.sum()))
        return _at_ranges(scan, hit, ranges[hit])

    def _ranges(self, scan: Scan, later: float = 0.0) -> FloatArray:
        """(N,) metres to the nearest box where it is nearer than the point itself, else inf."""
        points = scan.points.astype(np.float64)
        times = np.zeros(len(points)) if scan.times is None else scan.times
        seconds = scan.stamp * 1e-9 + later + times
        x, y, z = points.T
        count = math.ceil(_REACH / self.spacing)
        starts: FloatArray = np.arange(-count, count, dtype=np.float64) * self.spacing
        nearest = np.full(len(points), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Along a beam, in shares of its measured range: where it is between two planes.
            rise = _between(z, self.bottom, self.bottom + self.height)
            for side, speed in zip((1.0, -1.0), self.speeds, strict=True):
                across = _between(side * y, self.lane, self.lane + self.width)
                low = starts[:, None] + np.remainder(speed * seconds, self.spacing)
                along = _between(x, low, low + self.length)
                enter = np.maximum(np.maximum(rise[0], across[0]), along[0])
                leave = np.minimum(np.minimum(rise[1], across[1]), along[1])
                enter = np.where((enter < leave) & (enter > 0.0) & (enter < 1.0), enter, np.inf)
                nearest = np.minimum(nearest, enter.min(axis=0))
        return np.asarray(nearest * np.linalg.norm(points, axis=1))


def _between(
    coordinate: FloatArray, low: float | FloatArray, high: float | FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Shares of the length of rays from the origin at which they enter and leave two planes."""
    first, second = low / coordinate, high / coordinate
    return np.minimum(first, second), np.maximum(first, second)


class Disturbed(ChangedDataset):
    """A data set of raw sweeps with ``disturbances``, one after the other.

    Raises
    ------
    InputError
        While iterating, if the data set holds features instead of sweeps.
    """

    def __init__(self, dataset: Dataset, disturbances: Sequence[Disturbance]) -> None:
        check_dataset(dataset)
        check_all(disturbances, Disturbance, "disturbances", "as [Outliers(0.2)]")
        super().__init__(dataset, "disturbed")
        self._disturbances = tuple(disturbances)

    def __len__(self) -> int:
        return sum(self._keeps(number) for number in range(len(self._dataset)))

    def __iter__(self) -> Iterator[Sweep]:
        for number, sweep in enumerate(self._dataset):
            if not self._keeps(number):
                continue
            found = _raw(sweep, "Disturbed")
            for disturbance in self._disturbances:
                if isinstance(found, Scan):
                    found = disturbance.apply(number, found)
            yield found

    def _keeps(self, number: int) -> bool:
        return all(disturbance.keeps(number) for disturbance in self._disturbances)

    def info(self) -> DatasetInfo:
        """Of the data set, with what disturbs it."""
        return self._info(disturbed_by=", ".join(map(str, self._disturbances)) or "nothing")


class SkippedAhead(ChangedDataset):
    """A drive out of which some sweeps were cut, and the gap in time closed: a kidnapped lidar.

    It jumps to where it really went, at the speed it had there; the truth jumps with it.

    Parameters
    ----------
    dataset : of raw sweeps; they are read up to the cut at once
    first, count : the sweeps to cut out, with others before and after them
    """

    def __init__(self, dataset: Dataset, first: int, count: int) -> None:
        check_dataset(dataset)
        check_count(first, "first")
        check_count(count, "count")
        if not (first > 0 and count > 0 and first + count < len(dataset)):
            within = f"within 1 to {len(dataset) - 2} to cut out"
            raise InputError(f"SkippedAhead: expected sweeps {within}, got {count} from {first}")
        super().__init__(dataset, "skipped ahead")
        self._first, self._count = first, count
        ends = islice(dataset, first, first + count + 1, count)
        self._begin, self._end = (_raw(sweep, "SkippedAhead").stamp for sweep in ends)

    def __len__(self) -> int:
        return len(self._dataset) - self._count

    def __iter__(self) -> Iterator[Sweep]:
        for number, sweep in enumerate(self._dataset):
            if number < self._first:
                yield sweep
            elif number >= self._first + self._count:
                later = _raw(sweep, "SkippedAhead")
                yield replace(later, stamp=later.stamp - (self._end - self._begin))

    @property
    def imu(self) -> ImuSamples | None:
        """The IMU with the same stretch cut out."""
        imu = self._dataset.imu
        if imu is None:
            return None
        keep, stamps = self._cut(imu.stamps)
        turned = None if imu.orientation is None else imu.orientation[keep]
        return ImuSamples(stamps, turned, imu.gyro[keep], imu.acceleration[keep])

    @property
    def truth(self) -> Trajectory | None:
        """Poses with the same stretch cut out: they jump."""
        truth = self._dataset.truth
        if truth is None:
            return None
        keep, stamps = self._cut(truth.stamps)
        return Trajectory(stamps, truth.map_T_lidar[keep])

    def _cut(self, stamps: IntArray) -> tuple[BoolArray, IntArray]:
        after = stamps >= self._end
        keep = (stamps < self._begin) | after
        return keep, (stamps - after * (self._end - self._begin))[keep]

    def info(self) -> DatasetInfo:
        """Of the data set, with the cut."""
        return self._info(cut_out=f"{self._count} sweeps from {self._first}")


class Kidnapped(ChangedDataset):
    """A simulated drive in which the lidar is put somewhere else between two sweeps.

    From then on it rides along in its new place, seen from where it would have been.

    Parameters
    ----------
    number : of the first sweep elsewhere, from 1
    move : metres, lidar frame
    turn_deg : about the lidar's z axis, after the move
    """

    def __init__(
        self,
        world: SimulatedWorld,
        number: int,
        move: tuple[float, float, float] = (1.0, 0.0, 0.0),
        turn_deg: float = 0.0,
    ) -> None:
        check_kind(world, SimulatedWorld, "world", 'as SimulatedWorld("rooms")')
        check_count(number, "number")
        check_number(turn_deg, "turn_deg")
        if not 0 < number < len(world):
            raise InputError(f"Kidnapped: expected a sweep in 1 to {len(world) - 1}, got {number}")
        super().__init__(world, "kidnapped")
        self._world, self._number = world, number
        turn = Rotation.from_euler("z", turn_deg, degrees=True)
        self._moved = world.seen_from(rigid_transform(turn, as_vector(move, "move")))
        self._change = f"at sweep {number} by {move} m and {turn_deg:g} degrees"

    def __len__(self) -> int:
        return len(self._world)

    def __iter__(self) -> Iterator[Scan]:
        return (self[number] for number in range(len(self)))

    def __getitem__(self, number: int) -> Scan:
        number += len(self) if number < 0 else 0
        return (self._world if number < self._number else self._moved).sweep(number)

    @cached_property
    def truth(self) -> Trajectory:
        """Exact poses at the start of every sweep; they jump."""
        stamps = self._world.truth.stamps
        before = self._world.truth.map_T_lidar[: self._number]
        after = self._moved.truth_at(stamps[self._number :]).map_T_lidar
        return Trajectory(stamps, np.concatenate([before, after]))

    @cached_property
    def imu(self) -> ImuSamples:
        """IMU that is moved along with the lidar, but does not feel the jump."""
        before, after = self._world.imu, self._moved.imu
        here = (before.stamps < self._world.truth.stamps[self._number])[:, None]
        names = ("orientation", "gyro", "acceleration")
        columns = [np.where(here, getattr(before, name), getattr(after, name)) for name in names]
        return ImuSamples(before.stamps, *columns)

    def info(self) -> DatasetInfo:
        """Description of the drive, with the change of place."""
        return self._info(kidnapped=self._change)


def _at_ranges(scan: Scan, chosen: IntArray | BoolArray, ranges: FloatArray) -> Scan:
    points = scan.points.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        points[chosen] *= (ranges / np.linalg.norm(points[chosen], axis=1))[:, None]
    return replace(scan, points=points.astype(scan.points.dtype))


def _raw(sweep: Sweep, who: str) -> Scan | BadSweep:
    if isinstance(sweep, FeatureSweep):
        raise InputError(f"{who}: expected raw sweeps, got features")
    return sweep


def _check_share(share: float) -> None:
    if not (is_number(share) and 0.0 <= share <= 1.0):
        raise ConfigError(f"share: expected 0 to 1, got {share!r}")


def _check_pair(value: object, name: str) -> None:
    if not (are_two_numbers(value) and np.isfinite(np.asarray(value)).all()):
        raise InputError(f"{name}: expected two finite numbers, got {value!r}")


def _check_sweep(number: int, scan: Scan) -> None:
    check_count(number, "number")
    check_kind(scan, Scan, "scan", "a data set of raw sweeps has them")
