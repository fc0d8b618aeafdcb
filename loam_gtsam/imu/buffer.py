"""The IMU buffer: samples in any order go in, orientation and rotation at any time come out.

Everything that leaves it is in lidar axes and on the clock of the sweeps: ``lidar_R_imu_deg`` and
``time_offset`` are applied when samples enter.
Stamps are subtracted as integers before they become seconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.errors import check_kind, check_nanoseconds
from loam_gtsam.geometry import as_array, as_vector
from loam_gtsam.imu.at_rest import RestWindow, find_rest, rest_at_start
from loam_gtsam.imu.attitude_filter import BLOCK, GravityFilter
from loam_gtsam.imu.diagnosis import samples_problems
from loam_gtsam.imu.quality import ImuReport, QualityLog
from loam_gtsam.imu.quaternions import (
    as_rot3,
    exponential,
    from_rot3,
    inverse,
    logarithm,
    quaternion_product,
    rotation_steps,
    running_product,
)
from loam_gtsam.types import MAX_STAMP, FloatArray, ImuSamples, IntArray

REST_AHEAD = 0.1
"""Seconds after the asked stamp that still count to its rest: one sweep."""
MEMORY = 60.0
"""Seconds before a frame over which a live run keeps samples, beside ``still_seconds``. Only a
comparison with the last frame that was solved reaches back further, if there has been none for so
long; by then an IMU that is no navigation grade has lost the pose."""
WRAP = 3.0
"""rad, below pi: rotation vectors are not interpolated across a half turn."""

_FINE = 1e-3
"""Seconds between the nodes of :meth:`ImuBuffer.rotations_since`: a linear interpolation is then
off by 4e-7 rad at 3 rad/s^2."""
_ABSURD = 1e6
"""rad/s and m/s^2 that no IMU measures, and a length that no quaternion has."""
_UNIT = 1e-3
"""Deviation of a quaternion's length from one that is still rounding (float32 has 1e-7)."""


class SampleStore:
    """Stamps and values of IMU samples, sorted by stamp, one sample for each stamp.

    Samples before ``accepts_from``, nanoseconds, are dropped; None accepts all. In ``counts``
    "duplicates", "out_of_order" and "too_late" are counted.
    """

    def __init__(self, counts: Counter[str]) -> None:
        self._counts = counts
        self.accepts_from: int | None = None
        self._newest_arrival = np.iinfo(np.int64).min
        self._waiting: list[tuple[IntArray, FloatArray]] = []
        self._count = 0
        # Longer than needed: a live stream is then copied a few times in all, not at every merge.
        self._room_stamps = np.zeros(0, np.int64)
        self._room = np.zeros((0, 10))

    @property
    def samples(self) -> ImuSamples:
        """All samples; views that are valid until the next :meth:`merge`."""
        stamps, values = self._room_stamps[: self._count], self._room[: self._count]
        return ImuSamples(stamps, values[:, :4], values[:, 4:7], values[:, 7:])

    def add(self, stamps: IntArray, values: FloatArray) -> None:
        """Keep samples, in any order, for the next :meth:`merge`.

        ``values`` (N, 10) are quaternion x y z w (NaN where unknown), gyro and acceleration.
        """
        if self.accepts_from is not None:
            young = stamps >= self.accepts_from
            self._counts["too_late"] += len(stamps) - int(young.sum())
            stamps, values = stamps[young], values[young]
        if len(stamps) == 0:
            return
        newest = np.maximum.accumulate(np.concatenate([[self._newest_arrival], stamps]))
        self._counts["out_of_order"] += int((stamps < newest[:-1]).sum())
        self._newest_arrival = int(newest[-1])
        self._waiting.append((stamps, values))

    def merge(self) -> tuple[int, int] | None:
        """Sort in what was added.

        The answer is the index from which on samples have changed and the stamp of the earliest new
        sample; None if there was nothing new.
        """
        if not self._waiting:
            return None
        stamps = np.concatenate([part[0] for part in self._waiting])
        values = np.concatenate([part[1] for part in self._waiting])
        self._waiting.clear()
        earliest = int(stamps.min())
        # Nothing before this index changes; as a rule the index is the end.
        old = self.samples.stamps
        at = int(np.searchsorted(old, earliest))
        # The old samples first: of equal stamps a stable sort then keeps the first to come.
        stamps = np.concatenate([old[at:], stamps])
        values = np.concatenate([self._room[at : self._count], values])
        order = np.argsort(stamps, kind="stable")
        stamps = stamps[order]
        kept = np.concatenate([[True], stamps[1:] != stamps[:-1]])
        self._counts["duplicates"] += len(stamps) - int(kept.sum())
        self._count = at + int(kept.sum())
        if self._count > len(self._room):
            more = 2 * self._count - at
            self._room_stamps = np.concatenate([self._room_stamps[:at], np.zeros(more, int)])
            self._room = np.concatenate([self._room[:at], np.zeros((more, 10))])
        self._room_stamps[at : self._count] = stamps[kept]
        self._room[at : self._count] = values[order][kept]
        return at, earliest

    def drop(self, count: int) -> None:
        """Drop the ``count`` oldest samples, fewer than all, and from now on every older one."""
        held = slice(count, self._count)
        self._room_stamps, self._room = self._room_stamps[held].copy(), self._room[held].copy()
        self._count -= count
        self.accepts_from = int(self._room_stamps[0])


@dataclass(slots=True)
class _Start:
    """The rest before the first motion, once the samples of that time are not held any more."""

    rest: RestWindow | None = None
    is_held: bool = True


class ImuBuffer:
    """IMU samples in lidar axes, in order of time, to be asked about any time.

    The answers for the same samples are the same to the last bit, however the samples came in.
    ``lidar_R_imu`` is the configured rotation from IMU into lidar axes.

    Parameters
    ----------
    config : section ``imu``, of the mapper as well
    samples : the first samples, if there are some already; errors as of :meth:`add`
    """

    def __init__(self, config: ImuConfig, samples: ImuSamples | None = None) -> None:
        how = 'the section "imu" of a Config is one'
        check_kind(config, ImuConfig, "config of an ImuBuffer", how)
        self.config, self._gap = config, round(config.max_gap * 1e9)
        self.lidar_R_imu = gtsam.Rot3.RzRyRx(*np.deg2rad(config.lidar_R_imu_deg))
        self._bias = np.zeros(3)
        self._counts: Counter[str] = Counter()
        self._store = SampleStore(self._counts)
        self._quality = QualityLog(config, self._counts)
        self._filter = GravityFilter(config)
        self._start = _Start()
        if samples is not None:
            self.add(samples)

    @property
    def gyro_bias(self) -> FloatArray:
        """(3,) rad/s in lidar axes, subtracted by the rotations, but not by :meth:`orientation`,
        whose filter takes the bias of the rest at the start.
        """
        return self._bias

    @gyro_bias.setter
    def gyro_bias(self, bias: FloatArray) -> None:
        self._bias = as_vector(bias, "gyro_bias").copy()

    def with_own_bias(self) -> ImuBuffer:
        """The same samples, those to come as well, with a bias that others do not change."""
        return copy(self)

    def restorer(self) -> Callable[[], None]:
        """A function that brings the bias back; samples do not depend on the frames."""
        return partial(setattr, self, "_bias", self._bias)

    def add(self, samples: ImuSamples) -> None:
        """Put in one or many samples, in any order, overlapping others or not.

        InputError if it is anything but :class:`ImuSamples`.
        """
        check_kind(samples, ImuSamples, "samples", "ImuSamples(stamps, None, gyro) makes one")
        counts = self._counts
        stamps, values = _columns(samples)
        finite = (np.abs(values[:, 4:]) < _ABSURD).all(axis=1)  # NaN compares false
        finite &= (stamps >= -MAX_STAMP) & (stamps <= MAX_STAMP)
        stamps = stamps + round(self.config.time_offset * 1e9)
        counts["not_finite"] += len(stamps) - int(finite.sum())
        stamps, values = stamps[finite], values[finite]
        if len(stamps) == 0:
            return
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            norms = np.linalg.norm(values[:, :4], axis=1)
            known = (norms > 1.0 / _ABSURD) & (norms < _ABSURD)
            quaternions = np.where(known, values[:, :4].T / norms, np.nan)
            counts["unnormalised"] += int((known & (np.abs(norms - 1.0) > _UNIT)).sum())
        counts["no_orientation"] += len(stamps) - int(known.sum())
        self._quality.watch_orientation(quaternions[:, known], values[:, 4:7])
        lidar_R_imu = self.lidar_R_imu.matrix()
        values[:, :4] = quaternion_product(quaternions, inverse(from_rot3(self.lidar_R_imu))).T
        values[:, 4:7] = values[:, 4:7] @ lidar_R_imu.T
        values[:, 7:] = values[:, 7:] @ lidar_R_imu.T
        self._store.add(stamps, values)

    def forget_old(self, stamp: int) -> None:
        """Drop the samples that no frame from ``stamp`` on needs; once a frame in a live run.

        Samples of :data:`MEMORY` before the frame stay; answers about that time and the counts of
        the report stay the same. Dropped samples that come again are dropped again, unless
        ``stamp`` goes back as far, as it does after the clock was set back.
        """
        check_nanoseconds(stamp)
        self._merge()
        store, config = self._store, self.config
        needed = MEMORY + config.still_seconds + config.average_seconds + config.max_gap
        first = stamp - round(needed * 1e9)
        if store.accepts_from is not None and first < store.accepts_from:
            store.accepts_from = None
        # The sample before `first` stays, and the blocks of the filter do not shift.
        count = int(np.searchsorted(store.samples.stamps, first, side="right")) - 1
        count -= count % BLOCK
        if count <= 0:
            return
        self._start.rest, self._start.is_held = self.first_rest(), False
        if self._quality.constant:  # then the filter is in use, or may be later
            self._filter.orientations(store.samples)
            self._filter.drop(count)
        self._quality.drop(store.samples.stamps[: count + 1])
        store.drop(count)

    def __len__(self) -> int:
        """Number of samples that are held."""
        self._merge()
        return len(self._store.samples.stamps)

    @property
    def report(self) -> ImuReport:
        """Numbers of all samples so far, and what was wrong with them."""
        filtered = self._orientations() is not None
        samples, rest = self._store.samples, self.first_rest()
        if not self._quality.measured:
            samples = replace(samples, orientation=None)
        wrong = samples_problems(samples, self.config, rest)
        return self._quality.report(samples, rest, filtered, wrong)

    @property
    def measures_attitude(self) -> bool:
        """Whether :meth:`orientation` is the sensor's own, not made of gyro and acceleration."""
        return self._quality.measured

    def orientation(self, stamp: int) -> gtsam.Rot3 | None:
        """``world_R_lidar`` (world z up), interpolated between the neighbours.

        Beyond the newest sample that one is held, for ``max_gap`` at most (LOAM holds it for
        ever). None before the first sample, inside a longer gap, or without any orientation.
        """
        check_nanoseconds(stamp)
        quaternions, stamps = self._orientations(), self._store.samples.stamps
        if quaternions is None:
            return None
        low = int(np.searchsorted(stamps, stamp - self._gap, side="left"))
        high = int(np.searchsorted(stamps, stamp + self._gap, side="right"))
        known = low + np.flatnonzero(np.isfinite(quaternions[low:high, 0]))
        split = int(np.searchsorted(stamps[known], stamp, side="right"))
        if split == 0:
            return None
        i = known[split - 1]
        before = as_rot3(quaternions[i])
        if stamps[i] == stamp:
            return before
        if split == len(known):
            ends = not np.isfinite(quaternions[high:, 0]).any()
            return before if ends else None
        j = known[split]
        step = int(stamps[j] - stamps[i])
        if step > self._gap:
            return None
        return before.slerp((stamp - int(stamps[i])) / step, as_rot3(quaternions[j]))

    def rotations_since(self, stamp: int, seconds: FloatArray) -> FloatArray | None:
        """Rotation vectors of the lidar since ``stamp``, from the gyro.

        Parameters
        ----------
        stamp : nanoseconds
        seconds : (K,) from ``stamp``, in any order, negative ones too

        Returns
        -------
        (K, 3) rotation vectors of ``at_stamp_R_at(stamp + seconds)``, rad; None if a gap longer
        than ``max_gap`` or the start of the data is in the way, if the end is more than ``max_gap``
        back (until then the last rate is held), or if the lidar turns by more than 3 rad.
        """
        check_nanoseconds(stamp)
        seconds = as_array(seconds, "seconds", ("K",))
        earliest, latest = seconds.min(initial=0.0), seconds.max(initial=0.0)
        first, last = stamp + round(earliest * 1e9), stamp + round(latest * 1e9)
        found = self._rates(first, last, stamp)
        return None if found is None else _rotation_vectors(seconds, earliest, latest, *found)

    def rotation_between(self, first: int, second: int) -> gtsam.Rot3 | None:
        """``first_R_second`` of two stamps from the gyro; None as for :meth:`rotations_since`."""
        check_nanoseconds(first, "first")
        check_nanoseconds(second, "second")
        if second < first:
            backwards = self.rotation_between(second, first)
            return None if backwards is None else backwards.inverse()
        found = self._rates(first, second, first)
        if found is None:
            return None
        end = (second - first) * 1e-9
        inside = found[0][(found[0] > 0.0) & (found[0] < end)]
        times = np.concatenate([[0.0], inside, [end]])
        steps = rotation_steps(times, _interpolate(times, *found))
        return as_rot3(running_product(exponential(steps))[:, -1])

    def samples_between(self, first: int, last: int) -> ImuSamples:
        """Copy of the samples from ``first`` to ``last``, both included, in lidar axes.

        The orientation is that of :meth:`orientation`, NaN where unknown.
        """
        check_nanoseconds(first, "first")
        check_nanoseconds(last, "last")
        quaternions, samples = self._orientations(), self._store.samples
        part = slice(*np.searchsorted(samples.stamps, [first, last + 1]))
        orientation = None if quaternions is None else quaternions[part].copy()
        gyro, acceleration = samples.gyro[part].copy(), samples.acceleration[part].copy()
        return ImuSamples(samples.stamps[part].copy(), orientation, gyro, acceleration)

    def rest_at(self, stamp: int) -> RestWindow | None:
        """The rest from ``still_seconds`` before ``stamp`` to 0.1 s after it; None if none.

        :func:`loam_gtsam.imu.at_rest.find_rest` says what rest means.
        """
        check_nanoseconds(stamp)
        first = stamp - round(self.config.still_seconds * 1e9)
        return find_rest(self.config, self.samples_between(first, stamp + round(REST_AHEAD * 1e9)))

    def first_rest(self) -> RestWindow | None:
        """The rest at the start of all samples, dropped ones included; None if none."""
        self._merge()
        samples = self._store.samples
        held = self._start.is_held and len(samples.stamps)
        return rest_at_start(self.config, samples) if held else self._start.rest

    def _merge(self) -> None:
        changed = self._store.merge()
        if changed is not None:
            self._filter.changed_from(*changed)

    def _rates(self, first: int, last: int, origin: int) -> tuple[FloatArray, FloatArray] | None:
        """Seconds (K,) from ``origin`` and rates (3, K) around a stretch; None if not covered."""
        self._merge()
        stamps = self._store.samples.stamps
        low = int(np.searchsorted(stamps, first, side="right")) - 1
        high = int(np.searchsorted(stamps, last, side="left"))
        if low < 0 or (high == len(stamps) and last - int(stamps[-1]) > self._gap):
            return None
        inside = stamps[low : high + 1]
        if (np.diff(inside) > self._gap).any():
            return None
        rates = self._store.samples.gyro[low : high + 1] - self._bias
        return (inside - origin).astype(np.float64) * 1e-9, rates.T

    def _orientations(self) -> FloatArray | None:
        """(N, 4) quaternions of ``world_R_lidar``, NaN where unknown; None if all are."""
        self._merge()
        samples = self._store.samples
        if len(samples.stamps) == 0:
            return None
        return samples.orientation if self._quality.measured else self._filter.orientations(samples)


def _columns(samples: ImuSamples) -> tuple[IntArray, FloatArray]:
    """Stamps (N,) and values (N, 10): quaternion (zero where unknown), gyro, acceleration."""
    quaternions = samples.orientation
    if quaternions is None:
        quaternions = np.zeros((len(samples.stamps), 4))
    values = np.hstack([quaternions, samples.gyro, samples.acceleration])
    return samples.stamps, values.astype(np.float64)


def _rotation_vectors(
    seconds: FloatArray, earliest: float, latest: float, times: FloatArray, rates: FloatArray
) -> FloatArray | None:
    """(K, 3) rotation vectors from time 0 to ``seconds``, None if one is beyond :data:`WRAP`."""
    begin, end = int(np.floor(earliest / _FINE)), int(np.ceil(latest / _FINE)) + 2
    nodes: FloatArray = _FINE * np.arange(begin, end, dtype=np.float64)
    steps = rotation_steps(nodes, _interpolate(nodes, times, rates))
    angles = np.concatenate([[0.0], np.cumsum(np.sqrt((steps * steps).sum(axis=0)))])
    if max(angles[-1] - angles[-begin], angles[-begin]) > WRAP:
        return None
    passed = np.column_stack([[0.0, 0.0, 0.0, 1.0], running_product(exponential(steps))])
    vectors = logarithm(quaternion_product(inverse(passed[:, -begin, None]), passed))
    place = seconds / _FINE - begin
    node = place.astype(np.int64)
    place -= node
    turned: FloatArray = np.diff(vectors, axis=1).take(node, axis=1)
    turned *= place
    turned += vectors.take(node, axis=1)
    return turned.T


def _interpolate(times: FloatArray, seconds: FloatArray, rates: FloatArray) -> FloatArray:
    """(3, N) rates at ``times``; before the first and after the last they are held."""
    return np.array([np.interp(times, seconds, rate) for rate in rates])
