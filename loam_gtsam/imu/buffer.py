"""The IMU buffer: samples in any order go in, orientation and rotation at any time come out.

Everything that leaves the buffer is in lidar axes: the configured ``lidar_R_imu_deg`` is applied
when samples enter. Stamps are subtracted as integers before they become seconds.
"""

from __future__ import annotations

from collections import Counter

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.geometry import as_array, as_stamps, as_vector
from loam_gtsam.imu.at_rest import RestWindow, find_rest, rest_at_start
from loam_gtsam.imu.attitude_filter import BLOCK, GravityFilter
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
from loam_gtsam.imu.store import SampleStore
from loam_gtsam.types import MAX_STAMP, FloatArray, ImuSamples, IntArray, check_array

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


class ImuBuffer:
    """IMU samples in lidar axes, in order of time, to be asked about any time.

    Asked twice the same with the same samples in it, the buffer gives the same answer to the last
    bit, however the samples came in.

    Parameters
    ----------
    config : section ``imu``
    samples : the first samples, if there are some already

    Attributes
    ----------
    lidar_R_imu : the configured rotation from IMU into lidar axes
    gyro_bias : (3,) rad/s in lidar axes, subtracted by :meth:`rotations_since` and
        :meth:`rotation_between`. It does not touch :meth:`orientation`, whose filter takes the
        bias of the rest at the start.

    Raises
    ------
    InputError
        If an array has the wrong shape or dtype.
    """

    def __init__(self, config: ImuConfig, samples: ImuSamples | None = None) -> None:
        self._config = config
        self._gap = round(config.max_gap * 1e9)
        roll, pitch, yaw = np.deg2rad(config.lidar_R_imu_deg)
        self.lidar_R_imu = gtsam.Rot3.RzRyRx(roll, pitch, yaw)
        self._bias = np.zeros(3)
        self._counts: Counter[str] = Counter()
        self._store = SampleStore(self._counts)
        self._quality = QualityLog(config, self._counts)
        self._filter = GravityFilter(config)
        self._rest: RestWindow | None = None
        self._start_is_held = True
        if samples is not None:
            self.add(samples)

    @property
    def gyro_bias(self) -> FloatArray:
        """(3,) rad/s, lidar axes."""
        return self._bias

    @gyro_bias.setter
    def gyro_bias(self, bias: FloatArray) -> None:
        self._bias = as_vector(bias, "gyro_bias").copy()

    def add(self, samples: ImuSamples) -> None:
        """Put in one or many samples, in any order, overlapping others or not.

        Raises
        ------
        InputError
            If an array has the wrong shape or dtype.
        """
        counts = self._counts
        stamps, values = _checked(samples)
        finite = (np.abs(values[:, 4:]) < _ABSURD).all(axis=1)  # NaN compares false
        finite &= (stamps >= -MAX_STAMP) & (stamps <= MAX_STAMP)
        counts["not_finite"] += len(stamps) - int(finite.sum())
        stamps, values = stamps[finite], values[finite]
        if len(stamps) == 0:
            return
        quaternions, unnormalised = _normalised(values[:, :4])
        known = ~np.isnan(quaternions[0])
        counts["unnormalised"] += unnormalised
        counts["no_orientation"] += len(stamps) - int(known.sum())
        self._quality.watch_orientation(quaternions[:, known], values[:, 4:7])
        lidar_R_imu = self.lidar_R_imu.matrix()
        turned = np.empty_like(values)
        turned[:, :4] = quaternion_product(quaternions, inverse(from_rot3(self.lidar_R_imu))).T
        turned[:, 4:7] = values[:, 4:7] @ lidar_R_imu.T
        turned[:, 7:] = values[:, 7:] @ lidar_R_imu.T
        self._store.add(stamps, turned)

    def forget_old(self, stamp: int) -> None:
        """Drop the samples that no frame from ``stamp`` on needs; once a frame in a live run.

        Samples of :data:`MEMORY` before the frame stay; answers about that time and the counts of
        the report stay the same. Dropped samples that come again are dropped again, unless
        ``stamp`` goes back as far, as it does after the clock was set back.
        """
        self._merge()
        store, config = self._store, self._config
        needed = MEMORY + config.still_seconds + config.average_seconds + config.max_gap
        first = stamp - round(needed * 1e9)
        if store.accepts_from is not None and first < store.accepts_from:
            store.accepts_from = None
        # The sample before `first` stays, and the blocks of the filter do not shift.
        count = int(np.searchsorted(store.stamps, first, side="right")) - 1
        count -= count % BLOCK
        if count <= 0:
            return
        self._rest, self._start_is_held = self._rest_at_start(), False
        if self._quality.constant:  # then the filter is in use, or may be later
            self._filter.orientations(store.samples)
            self._filter.drop(count)
        self._quality.drop(store.stamps[: count + 1])
        store.drop(count)

    def __len__(self) -> int:
        """Number of samples that are held."""
        self._merge()
        return len(self._store.stamps)

    @property
    def report(self) -> ImuReport:
        """Numbers of all samples so far, and what was wrong with them."""
        filtered = self._orientations() is not None
        return self._quality.report(self._store.stamps, self._rest_at_start(), filtered)

    def orientation(self, stamp: int) -> gtsam.Rot3 | None:
        """``world_R_lidar`` (world z up), interpolated between the neighbours.

        Beyond the newest sample that one is held, for ``max_gap`` at most (LOAM holds it for
        ever). None before the first sample, inside a longer gap, or without any orientation.
        """
        quaternions = self._orientations()
        if quaternions is None:
            return None
        stamps = self._store.stamps
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

        Raises
        ------
        InputError
            If ``seconds`` is no row of finite numbers.
        """
        seconds = as_array(seconds, "seconds", ("K",))
        earliest, latest = seconds.min(initial=0.0), seconds.max(initial=0.0)
        first, last = stamp + round(earliest * 1e9), stamp + round(latest * 1e9)
        found = self._rates(first, last, stamp)
        if found is None:
            return None
        return _rotation_vectors(seconds, earliest, latest, *found)

    def rotation_between(self, first: int, second: int) -> gtsam.Rot3 | None:
        """``first_R_second`` of two stamps from the gyro; None as for :meth:`rotations_since`."""
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
        quaternions, samples = self._orientations(), self._store.samples
        part = slice(*np.searchsorted(samples.stamps, [first, last + 1]))
        return ImuSamples(
            stamps=samples.stamps[part].copy(),
            orientation=None if quaternions is None else quaternions[part].copy(),
            gyro=samples.gyro[part].copy(),
            acceleration=samples.acceleration[part].copy(),
        )

    def rest_at(self, stamp: int) -> RestWindow | None:
        """The rest from ``still_seconds`` before ``stamp`` to 0.1 s after it; None if none.

        :func:`loam_gtsam.imu.at_rest.find_rest` says what rest means.
        """
        first = stamp - round(self._config.still_seconds * 1e9)
        return find_rest(self._config, self.samples_between(first, stamp + round(REST_AHEAD * 1e9)))

    def _merge(self) -> None:
        """Sort in what was added since the last question."""
        changed = self._store.merge()
        if changed is not None:
            self._filter.changed_from(*changed)

    def _rates(self, first: int, last: int, origin: int) -> tuple[FloatArray, FloatArray] | None:
        """Seconds (K,) from ``origin`` and rates (3, K) of the samples around a stretch of time,
        or None where it is not covered.
        """
        self._merge()
        stamps = self._store.stamps
        low = int(np.searchsorted(stamps, first, side="right")) - 1
        high = int(np.searchsorted(stamps, last, side="left"))
        if low < 0 or (high == len(stamps) and last - int(stamps[-1]) > self._gap):
            return None
        inside = stamps[low : high + 1]
        if (np.diff(inside) > self._gap).any():
            return None
        rates = self._store.samples.gyro[low : high + 1] - self._bias
        return (inside - origin).astype(np.float64) * 1e-9, rates.T

    def _rest_at_start(self) -> RestWindow | None:
        """The rest at the start of all samples, dropped ones included."""
        if not self._start_is_held or len(self._store.stamps) == 0:
            return self._rest
        return rest_at_start(self._config, self._store.samples)

    def _orientations(self) -> FloatArray | None:
        """(N, 4) quaternions of ``world_R_lidar``, NaN where unknown; None if all are."""
        self._merge()
        if len(self._store.stamps) == 0:
            return None
        samples = self._store.samples
        return samples.orientation if self._quality.measured else self._filter.orientations(samples)


def _checked(samples: ImuSamples) -> tuple[IntArray, FloatArray]:
    """Stamps (N,) and values (N, 10): quaternion (zero where unknown), gyro, acceleration."""
    stamps = as_stamps(samples.stamps, "ImuSamples.stamps")
    columns = []
    for name, width in (("orientation", 4), ("gyro", 3), ("acceleration", 3)):
        column = getattr(samples, name)
        if column is None and name == "orientation":
            column = np.zeros((len(stamps), 4))
        column = np.asarray(column)
        check_array(column, f"ImuSamples.{name}", (len(stamps), width), "numbers")
        columns.append(column)
    return stamps, np.hstack(columns).astype(np.float64)


def _normalised(quaternions: FloatArray) -> tuple[FloatArray, int]:
    """(4, N) unit quaternions of (N, 4), NaN where absurd, and how many were not of unit length."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        norms = np.linalg.norm(quaternions, axis=1)
        known = (norms > 1.0 / _ABSURD) & (norms < _ABSURD)
        off = known & (np.abs(norms - 1.0) > _UNIT)
        return np.where(known, quaternions.T / norms, np.nan), int(off.sum())


def _rotation_vectors(
    seconds: FloatArray, earliest: float, latest: float, times: FloatArray, rates: FloatArray
) -> FloatArray | None:
    """(K, 3) rotation vectors from time 0 to ``seconds``, None if one is beyond :data:`WRAP`.

    Parameters
    ----------
    seconds : (K,) between ``earliest`` <= 0 and ``latest`` >= 0
    times, rates : (N,) seconds and (3, N) rad/s
    """
    begin = int(np.floor(earliest / _FINE))
    end = int(np.ceil(latest / _FINE)) + 2
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
    return np.stack([np.interp(times, seconds, rate) for rate in rates])
