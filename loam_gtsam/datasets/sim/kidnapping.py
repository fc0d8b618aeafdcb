"""A lidar that is put somewhere else between two sweeps; the truth jumps with it.

:class:`SkippedAhead` cuts a piece out of any drive, :class:`Kidnapped` moves the lidar of a
simulated one to any place.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.base import ChangedDataset, Dataset, DatasetInfo
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.types import (
    BadSweep,
    BoolArray,
    FeatureSweep,
    ImuSamples,
    InputError,
    IntArray,
    Scan,
    Sweep,
    Trajectory,
)


class SkippedAhead(ChangedDataset):
    """A drive out of which some sweeps were cut, and the gap in time closed: a kidnapped lidar.

    Works on any data; the lidar jumps to where it really went, at the speed it had there.

    Parameters
    ----------
    dataset : of raw sweeps; they are read up to the cut at once
    first, count : the sweeps to cut out

    Raises
    ------
    InputError
        If there is nothing before or after the cut.
    """

    def __init__(self, dataset: Dataset, first: int, count: int) -> None:
        if not (first > 0 and count > 0 and first + count < len(dataset)):
            raise InputError(
                f"SkippedAhead: expected sweeps within 1 to {len(dataset) - 2} to cut out, got "
                f"{count} from {first}"
            )
        super().__init__(dataset, "skipped ahead")
        self._first, self._count = first, count
        until = list(itertools.islice(dataset, first + count + 1))
        self._begin, self._end = (_earlier(sweep, 0).stamp for sweep in (until[first], until[-1]))

    def __len__(self) -> int:
        return len(self._dataset) - self._count

    def __iter__(self) -> Iterator[Sweep]:
        for number, sweep in enumerate(self._dataset):
            if number < self._first:
                yield sweep
            elif number >= self._first + self._count:
                yield _earlier(sweep, self._end - self._begin)

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
        keep = (stamps < self._begin) | (stamps >= self._end)
        later = np.where(stamps[keep] >= self._end, self._end - self._begin, 0)
        return keep, stamps[keep] - later

    def info(self) -> DatasetInfo:
        """Description of the data set, with the cut."""
        return self._info(cut_out=f"{self._count} sweeps from {self._first}")


class Kidnapped(ChangedDataset):
    """A simulated drive in which the lidar is put somewhere else between two sweeps.

    From then on it rides along in its new place, seen from where it would have been.

    Parameters
    ----------
    world : the drive
    number : of the first sweep elsewhere
    move : metres, lidar frame
    turn_deg : about the lidar's z axis, after the move

    Raises
    ------
    InputError
        If the drive has no sweep before and at ``number``.
    """

    def __init__(
        self,
        world: SimulatedWorld,
        number: int,
        move: tuple[float, float, float] = (1.0, 0.0, 0.0),
        turn_deg: float = 0.0,
    ) -> None:
        if not 0 < number < len(world):
            raise InputError(f"Kidnapped: expected a sweep in 1 to {len(world) - 1}, got {number}")
        super().__init__(world, "kidnapped")
        self._world, self._number = world, number
        lidar_T_moved = np.eye(4)
        lidar_T_moved[:3, :3] = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
        lidar_T_moved[:3, 3] = move
        self._moved = world.seen_from(lidar_T_moved)
        self._change = f"at sweep {number} by {move} m and {turn_deg:g} degrees"

    def __len__(self) -> int:
        return len(self._world)

    def __iter__(self) -> Iterator[Scan]:
        return (self[number] for number in range(len(self)))

    def __getitem__(self, number: int) -> Scan:
        number += len(self) if number < 0 else 0
        world = self._world if number < self._number else self._moved
        return world.sweep(number)

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
        assert before.orientation is not None
        assert after.orientation is not None
        here = before.stamps < self._world.truth.stamps[self._number]
        pairs = (
            (before.orientation, after.orientation),
            (before.gyro, after.gyro),
            (before.acceleration, after.acceleration),
        )
        columns = [np.where(here[:, None], first, second) for first, second in pairs]
        return ImuSamples(before.stamps, *columns)

    def info(self) -> DatasetInfo:
        """Description of the drive, with the change of place."""
        return self._info(kidnapped=self._change)


def _earlier(sweep: Sweep, nanoseconds: int) -> Scan | BadSweep:
    if isinstance(sweep, FeatureSweep):
        raise InputError("SkippedAhead: expected raw sweeps, got features")
    return replace(sweep, stamp=sweep.stamp - nanoseconds)
