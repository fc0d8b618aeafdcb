"""Organised sweeps: ring after ring, each ring in firing order, with the time of each point.

LOAM's features compare consecutive measurements of one beam, so they need this order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.config import Config, SensorConfig, as_config
from loam_gtsam.frontend.rings import (
    MAX_RINGS,
    RingAssignment,
    are_rings,
    azimuth_steps,
    azimuths_about_axis,
    beams_of,
    rings_from_elevation,
    rings_from_file_order,
    rings_from_labels,
    rings_from_rows,
    without_rings,
)
from loam_gtsam.geometry import run_starts
from loam_gtsam.types import (
    BoolArray,
    FloatArray,
    IntArray,
    Scan,
    SweepError,
    SweepFault,
    check_kind,
)

MIN_POINTS = 11
"""Points in one window of LOAM's curvature: a point and five neighbours on either side."""
_MAX_SPAN = 2.0
"""Seconds: longest sweep. No spinning sensor turns slower than 0.5 Hz; more is a wrong unit."""
_MAX_OFFSET = 10.0
"""Seconds: largest distance of a sweep from its stamp, beyond which its pose is extrapolated."""
_MAX_OUTLIERS = 0.01
"""Largest fraction of points with implausible times that are dropped without an error."""
_Angles = NDArray[np.float32]  # rad
_ONE_WAY = 0.8
"""Least fraction of azimuth steps with the same sign that shows the sense of rotation."""
_ALL_AROUND = 0.98 * 2.0 * np.pi  # rad
_SEAM = 0.9
"""Fraction of a turn: between consecutive points of a ring, a larger step crosses the start of the
sweep."""


@dataclass(frozen=True, slots=True, eq=False)
class TimeAssignment:
    """When each point was measured: seconds from the scan's stamp, (N,) and (first, last).

    ``method`` is "field", "azimuth" or "none", ``note`` one sentence for the user.
    """

    times: FloatArray
    span: tuple[float, float]
    method: str
    note: str


@dataclass(frozen=True, eq=False)
class SweepColumns:
    """The usable points of a scan, with their ring labels, image rows and times.

    ``xyz`` is (3, N) float32, metres, lidar frame, ``index`` (N,) the position of each point in the
    scan; ``labels``, ``row_of`` and ``times`` are (N,) or None, ``span`` as in
    :class:`~loam_gtsam.types.Scan`; ``dropped`` and ``not_finite`` are numbers of points.
    """

    xyz: NDArray[np.float32]
    index: IntArray
    labels: NDArray[np.integer] | None
    row_of: IntArray | None
    times: FloatArray | None
    span: tuple[float, float] | None
    dropped: int
    not_finite: int

    def __len__(self) -> int:
        return len(self.index)

    @cached_property
    def azimuth(self) -> _Angles:
        """(N,) radians from x towards y."""
        azimuth: _Angles = np.arctan2(self.xyz[1], self.xyz[0])
        return azimuth


@dataclass(frozen=True, slots=True, eq=False)
class OrganisedSweep:
    """A sweep, ring after ring, each ring in firing order.

    Attributes
    ----------
    xyz : (3, N) float32, metres, lidar frame at each point's own time
    index : (N,) position of each point in the scan
    ring_starts : (R + 1,) where each ring begins; the last entry is N
    ring_of_start : (R,) number of each of those rings
    times : (N,) seconds from the scan's stamp
    span : (first, last) seconds from the stamp
    rings, timing : sources of rings and times; their arrays are in the order of the scan
    dropped : number of points left out (not finite, out of range, implausible time)
    not_finite : number of points that are NaN or infinite
    """

    xyz: NDArray[np.float32]
    index: IntArray
    ring_starts: IntArray
    ring_of_start: IntArray
    times: FloatArray
    span: tuple[float, float]
    rings: RingAssignment
    timing: TimeAssignment
    dropped: int
    not_finite: int


def usable_columns(scan: Scan, config: Config) -> SweepColumns:
    """Correct the ranges; drop points that are not finite, out of range, or of implausible times.

    SweepError if fewer than 11 points remain, or the times cannot be seconds.
    """
    sensor = config.sensor
    # NaN compares false; the square of an infinity is above any finite bound.
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = np.ascontiguousarray(scan.points.T, dtype=np.float32)
        squared = xyz[0] * xyz[0] + xyz[1] * xyz[1] + xyz[2] * xyz[2]
        if sensor.range_offset:
            ranges = np.sqrt(squared)
            left = np.maximum(ranges - np.float32(sensor.range_offset), 0.0)
            xyz, squared = xyz * (left / np.maximum(ranges, 1e-9)), left * left
    keep: BoolArray = (squared >= np.float32(sensor.min_range) ** 2) & (
        squared <= np.float32(min(sensor.max_range, 1e18)) ** 2
    )
    keep &= squared > 0.0  # where a driver puts beams that did not return
    times = None if sensor.times in ("azimuth", "none") else scan.times
    if times is not None:
        keep &= _plausible_times(times, keep)
    count = int(np.count_nonzero(keep))
    everything = count == len(keep)
    not_finite = 0 if everything else int(np.count_nonzero(~np.isfinite(xyz).all(axis=0)))
    finite = len(keep) - not_finite
    if count < MIN_POINTS:
        fault = SweepFault.TOO_FEW_POINTS if len(keep) else SweepFault.EMPTY
        if finite < MIN_POINTS <= len(keep):
            fault = SweepFault.NOT_FINITE
        elif times is not None and (timed := np.isfinite(times).sum()) < MIN_POINTS <= finite:
            what = f"{timed} of {len(keep)} points have a time that is finite, {MIN_POINTS} have to"
            raise SweepError(f"{what}; see sensor.times", SweepFault.BAD_TIMES)
        ranges = np.sqrt(squared[np.isfinite(squared)].astype(np.float64))
        median = float(np.median(ranges)) if len(ranges) else 0.0
        far = median > sensor.max_range
        unit = f"; half are farther than {median:.0f} m: are they in metres?" if far else ""
        raise SweepError(
            f"sweep of {len(scan.points)} points, {finite} finite, {count} of them within "
            f"{sensor.min_range:g} to {sensor.max_range:g} m: at least {MIN_POINTS} are needed; "
            f"check the source, or sensor.min_range and sensor.max_range{unit}",
            fault,
        )
    row_of = None
    if scan.rows and sensor.rings != "field":
        row_of = np.repeat(np.arange(scan.rows), len(scan.points) // scan.rows)
    index = np.flatnonzero(keep)
    return SweepColumns(
        xyz=xyz if everything else xyz.take(index, axis=1),
        index=index,
        labels=None if scan.rings is None else scan.rings[index],
        row_of=None if row_of is None else row_of[index],
        times=None if times is None else times[index].astype(np.float64),
        span=scan.span,
        dropped=len(keep) - count,
        not_finite=not_finite,
    )


def _plausible_times(times: NDArray[np.floating], keep: BoolArray) -> BoolArray:
    """(N,) whether a time can belong to this sweep; SweepError if times are not in seconds."""
    good: BoolArray = np.isfinite(times)
    used = times[good & keep]
    span = float(used.max()) - float(used.min()) if len(used) else 0.0
    if span <= _MAX_SPAN:
        return good
    middle = float(np.median(used))
    with np.errstate(invalid="ignore"):
        near = np.abs(times - middle) <= _MAX_SPAN / 2
    outside = int(np.count_nonzero(good & keep & ~near))
    if outside > _MAX_OUTLIERS * len(used):
        raise SweepError(
            f"point times span {span:.6g} s in one sweep, more than {_MAX_SPAN:g} s: they are "
            "probably not in seconds from the stamp; fix their unit, or set sensor.times to "
            "azimuth or none",
            SweepFault.BAD_TIMES,
        )
    good &= near
    return good


def assign_rings(columns: SweepColumns, sensor: SensorConfig) -> RingAssignment:
    """Find the beam of each point.

    ``sensor.rings`` selects the source; ``auto`` tries the ring field, the order of the points (in
    a range image, or in a file written ring after ring), and the elevations, and believes only
    rings around which the elevation runs smoothly. If none of them has rings, the sweep has none,
    or, if a source or a model is set, SweepError lists what was tried.
    """
    if sensor.rings == "none":
        return without_rings(len(columns), "sensor.rings: none")
    tried: list[str] = []
    for source, (found, reason) in _sources(columns, sensor):
        if found is None:
            tried.append(f"{source}: {reason}")
        elif sensor.rings == "auto" and not are_rings(found, columns.xyz):
            tried.append(f"{found.method}: elevations do not run smoothly around a ring")
        else:
            return _checked(found, columns, sensor)
    if sensor.rings == sensor.model == "auto":
        return without_rings(len(columns), "; ".join(tried))
    raise SweepError(
        f"no rings for a sweep of {len(columns)} points ({'; '.join(tried)}); give Scan.rings or "
        "Scan.rows, set sensor.rings to another source and sensor.model to the sensor, or "
        "sensor.rings to none for one that sweeps no rings",
        SweepFault.BAD_RINGS,
    )


def _sources(
    columns: SweepColumns, sensor: SensorConfig
) -> Iterator[tuple[str, tuple[RingAssignment | None, str]]]:
    """Name of each source that may be asked, its rings or None, and why."""
    asked = sensor.rings
    if asked in ("auto", "field"):
        labels = columns.labels
        rings = None if labels is None else rings_from_labels(labels, columns.xyz)
        yield "ring field", (rings, "the scan has none")
    if asked in ("auto", "rows"):
        if columns.row_of is not None:
            yield "row order", (rings_from_rows(columns.row_of), "")
        else:
            yield "row order", rings_from_file_order(columns.azimuth)
    if asked in ("auto", "elevation"):
        yield "elevation", rings_from_elevation(columns.xyz, sensor.model)


def _checked(found: RingAssignment, columns: SweepColumns, sensor: SensorConfig) -> RingAssignment:
    """The rings; SweepError if they are too few, too many, or not those of the sensor."""
    if found.count < 2 or found.count > MAX_RINGS:
        raise SweepError(
            f"{found.count} ring(s) from {found.method} in a sweep of {len(columns)} points: "
            f"expected 2 to {MAX_RINGS}; check the ring field, or set sensor.rings to another "
            "source",
            SweepFault.BAD_RINGS,
        )
    beams = beams_of(sensor.model)
    if beams is not None and found.count > beams:
        raise SweepError(
            f"sensor.model {sensor.model} has {beams} beams, and the points have {found.count} "
            f"rings ({found.method}): set sensor.model to the sensor of the data, or to auto",
            SweepFault.BAD_RINGS,
        )
    return found


def assign_times(columns: SweepColumns, rings: RingAssignment, config: Config) -> TimeAssignment:
    """Find the time at which each point was measured.

    ``config.sensor.times`` selects the source; ``auto`` takes the times of the points or, where
    de-skewing needs times, the azimuth. SweepError if the source has no times; the message says
    what to set. ``columns`` are in the order of the scan, which shows the sense of rotation.
    """
    sensor = config.sensor
    source: str = sensor.times
    if source == "auto":
        needed = "azimuth" if config.deskew.enabled else "none"
        source = needed if columns.times is None else "field"
        if source == "azimuth" and not rings.known:
            raise SweepError(
                f"neither rings nor times for a sweep of {len(columns)} points, {rings.note}; give "
                "Scan.times, or set sensor.times to none if the points are de-skewed, or to "
                "azimuth if the sensor spins",
                SweepFault.BAD_TIMES,
            )
    if source == "none":
        zeros = np.zeros(len(columns))
        return TimeAssignment(zeros, (0.0, 0.0), "none", "no times: the sweep is not de-skewed")
    if source == "azimuth":
        return _times_from_azimuth(columns, rings, sensor)
    if columns.times is None:
        raise SweepError(
            "sensor.times is field, but the points have no times; set sensor.times to azimuth "
            "(and spin, start_azimuth_deg, period, stamp), or to none to run without de-skew",
            SweepFault.BAD_TIMES,
        )
    span = columns.span or (float(columns.times.min()), float(columns.times.max()))
    # NaN compares false
    if not (0.0 <= span[1] - span[0] <= _MAX_SPAN and max(map(abs, span)) <= _MAX_OFFSET):
        raise SweepError(
            f"the sweep lies {span[0]:.6g} to {span[1]:.6g} s from its stamp; expected at most "
            f"{_MAX_SPAN:g} s, within {_MAX_OFFSET:g} s: times count from the stamp, in seconds",
            SweepFault.BAD_TIMES,
        )
    _check_sensor(columns, rings, sensor, span)
    note = f"per-point times from {span[0]:.4f} to {span[1]:.4f} s after the stamp"
    return TimeAssignment(columns.times, span, "field", note)


def _check_sensor(
    columns: SweepColumns,
    rings: RingAssignment,
    sensor: SensorConfig,
    span: tuple[float, float],
) -> None:
    """SweepError if the times of the points contradict what was set of the sensor's rotation."""
    problem = ""
    seconds, default = span[1] - span[0], type(sensor)()
    if sensor.period != default.period and not 0.5 < seconds / sensor.period < 2.0:
        problem = f"sensor.period is {sensor.period:g} s, and the points span {seconds:.3g} s"
    if sensor.spin != "auto" and columns.times is not None and rings.known:
        order = np.lexsort((columns.times, rings.rings))
        number = rings.rings[order]
        step = azimuth_steps(columns.azimuth[order])[number[1:] == number[:-1]]
        share = float(np.mean(step < 0.0)) if len(step) else 0.5
        turned = "clockwise" if share > _ONE_WAY else "counterclockwise"
        if max(share, 1.0 - share) > _ONE_WAY and turned != sensor.spin:
            problem = f"sensor.spin is {sensor.spin}, and by their times the points turn {turned}"
    if problem:
        raise SweepError(
            f"{problem}: it is for times from azimuths, and contradicts the times of the points; "
            "leave it out, or set sensor.times to azimuth",
            SweepFault.BAD_TIMES,
        )


def _times_from_azimuth(
    columns: SweepColumns, rings: RingAssignment, sensor: SensorConfig
) -> TimeAssignment:
    """Times in proportion to the angle turned since the start of the sweep, about its axis."""
    azimuths = azimuths_about_axis(columns.xyz, rings.rings, columns.azimuth)
    order = slice(None) if rings.ring_major else np.argsort(rings.rings, kind="stable")
    same_ring = np.diff(rings.rings[order]) == 0
    azimuth = azimuths[order]
    steps = azimuth_steps(azimuth) * same_ring  # none from one ring to the next
    clockwise, in_order, why = _sense(steps, rings, sensor)
    sign = -1.0 if clockwise else 1.0
    if sensor.start_azimuth_deg is not None:
        start = float(np.deg2rad(sensor.start_azimuth_deg))
    else:
        start = _beginning(azimuth, steps, same_ring) if in_order else np.pi
    turned = azimuths * np.float32(sign / (2.0 * np.pi))
    turned = turned - np.float64(sign * start / (2.0 * np.pi))
    fraction = turned - np.floor(turned)
    if in_order:
        fraction[order] += _seam_turns(fraction[order], same_ring)
    moment = "start" if sensor.stamp == "auto" else sensor.stamp
    offset = {"start": 0.0, "middle": -0.5, "end": -1.0}[moment]
    span = (offset * sensor.period, (offset + 1.0) * sensor.period)
    note = (
        f"times from azimuth: {'clockwise' if clockwise else 'counterclockwise'} ({why}) from "
        f"{np.rad2deg(start):.4g} degrees, {sensor.period:g} s, stamp at sweep {moment}"
    )
    return TimeAssignment((fraction + offset) * sensor.period, span, "azimuth", note)


def _sense(steps: _Angles, rings: RingAssignment, sensor: SensorConfig) -> tuple[bool, bool, str]:
    """Whether the sensor turns clockwise, whether points are in firing order, and the reason."""
    back, forth = int(np.count_nonzero(steps < 0.0)), int(np.count_nonzero(steps > 0.0))
    one_way = max(back, forth) >= _ONE_WAY * max(back + forth, 1) and back + forth > 0
    # A file stored ring after ring shows the order of the writer, not of the sensor: KITTI's raw
    # sweeps ascend in azimuth although the scanner turned clockwise.
    in_order = one_way and not rings.ring_major
    if sensor.spin != "auto":
        clockwise = sensor.spin == "clockwise"
        return clockwise, in_order and clockwise == (back > forth), "as configured"
    if in_order:
        return back > forth, True, "from the order of the points"
    if rings.ring_major:
        return True, False, "assumed, as Velodyne and Ouster turn; sensor.spin overrides"
    raise SweepError(
        f"cannot tell the sense of rotation: within rings {forth} azimuth steps go up and {back} "
        "go down; set sensor.spin, give per-point times, or set sensor.times to none",
        SweepFault.BAD_TIMES,
    )


def _beginning(azimuth: _Angles, steps: _Angles, same_ring: BoolArray) -> float:
    """Azimuth, rad, at which rings begin that go all around; that of Velodyne if none does."""
    turned = np.concatenate(([0.0], np.cumsum(steps, dtype=float)))
    first = run_starts(~same_ring)
    after = np.append(first[1:], len(azimuth))
    whole = first[np.abs(turned[after - 1] - turned[first]) >= _ALL_AROUND]
    return float(np.angle(np.exp(1j * azimuth[whole]).sum())) if len(whole) else np.pi


def _seam_turns(fraction: FloatArray, same_ring: BoolArray) -> FloatArray:
    """Whole turns to add where drivers, which cut at packets, let a sweep overlap its own start."""
    step = np.diff(fraction) * same_ring
    wraps = (step < -_SEAM).astype(np.float64) - (step > _SEAM)
    if not wraps.any():
        return np.zeros(len(fraction))
    turns = np.concatenate(([0.0], np.cumsum(wraps)))
    first = run_starts(~same_ring)
    after = np.append(first[1:], len(fraction))
    base = turns[first]
    # A ring that begins just before the start azimuth and passes it began a turn early.
    base = base + ((fraction[first] > _SEAM) & (turns[after - 1] > base))
    turns -= np.repeat(base, after - first)
    return turns


def organise(scan: Scan, config: Config) -> OrganisedSweep:
    """Put the points of a sweep ring after ring in firing order, and find their times.

    SweepError if too few points are usable, or rings or times cannot be found.
    """
    check_kind(scan, Scan, "scan", "Scan(points=..., stamp=...) makes one of an array")
    columns = usable_columns(scan, as_config(config))
    rings = assign_rings(columns, config.sensor)
    timing = assign_times(columns, rings, config)
    order = _firing_order(columns, rings, timing)
    number = rings.rings if order is None else rings.rings[order]
    starts = run_starts(number[1:] != number[:-1])
    return OrganisedSweep(
        xyz=columns.xyz if order is None else columns.xyz.take(order, axis=1),
        index=columns.index if order is None else columns.index[order],
        ring_starts=np.append(starts, len(number)),
        ring_of_start=number[starts].astype(np.int64),
        times=timing.times if order is None else timing.times[order],
        span=timing.span,
        rings=rings,
        timing=timing,
        dropped=columns.dropped,
        not_finite=columns.not_finite,
    )


def _firing_order(
    columns: SweepColumns, rings: RingAssignment, timing: TimeAssignment
) -> IntArray | None:
    """Order of the points by ring and time; None if they are in that order, or have no rings."""
    if not rings.known:
        return None
    number = rings.rings
    clock = timing.times
    if timing.method == "none":
        # Without times, the points of a ring are ordered by azimuth.
        clock = -columns.azimuth.astype(np.float64)
    if _in_order(number, clock):
        return None
    first, last = float(clock.min()), float(clock.max())
    bins = 65536 // rings.count
    coarse = (clock - first).astype(np.float32)
    coarse *= np.float32((bins - 1) / max(last - first, 1e-12))
    # A stable sort by 16-bit keys is a radix sort, far cheaper than a sort by time.
    key = number * np.uint16(bins) + coarse.astype(np.uint16)
    against = np.count_nonzero(clock[1:] < clock[:-1]) > len(clock) // 2
    if against:
        order = len(key) - 1 - np.argsort(key[::-1], kind="stable")
    else:
        order = np.argsort(key, kind="stable")
    key, sorted_clock = key[order], clock[order]
    late = np.flatnonzero((key[1:] == key[:-1]) & (sorted_clock[1:] < sorted_clock[:-1]))
    if len(late):  # some keys stand for several times: their points are sorted by time
        several = np.zeros(65536, np.bool_)
        several[key[late]] = True
        rows = np.flatnonzero(several[key])
        order[rows] = order[rows][np.lexsort((order[rows], sorted_clock[rows], key[rows]))]
    return order


def _in_order(number: NDArray[np.uint16], clock: FloatArray) -> bool:
    up, same = number[1:] > number[:-1], number[1:] == number[:-1]
    return bool(np.all(up | (same & (clock[1:] >= clock[:-1]))))
