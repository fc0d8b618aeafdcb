"""Meaning of the per-point times of a driver: unit, clock, and moment of the stamp.

Velodyne writes seconds from the stamp, Ouster nanoseconds, Hesai and Robosense absolute seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.config import SensorConfig
from loam_gtsam.errors import nearest
from loam_gtsam.types import BoolArray, DatasetError, FloatArray, IntArray

SWEEP_SECONDS = (0.02, 1.0)
"""Shortest and longest plausible sweep: spinning sensors run at 5 to 20 Hz, with room to spare.
The ratio is below 1000, so at most one unit fits."""
ANCHORS: dict[str, float] = {"start": 0.0, "middle": 0.5, "end": 1.0}
"""Share of the sweep before the moment that its stamp is."""
_NANOSECONDS: dict[str, int] = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_FOREIGN = "absolute, in another clock than the stamp"
_CLOCKS = {"offset": "relative to the stamp", "stamp": "absolute", "own": _FOREIGN}
IGNORE_TIMES = "time_field=none to ignore the field (on the command line --option time_field=none)"
"""What can be done about times that cannot be understood."""
_TRIM = 100  # one value in this many is set aside at either end before the span is measured
_OVERLAP = 4.0
"""Times of the points that span more than so many steps between sweeps are no seconds: the sweeps
of two lidars overlap by half, and fractions of a sweep of 5 Hz span five steps."""
_SHORTER = 0.75  # share of the usual time between two sweeps below which it is another


def shorter_period(stamps: Sequence[int] | IntArray) -> Mapping[str, float]:
    """``sensor.period`` of sweeps that follow each other sooner than its default says.

    None takes longer than until the next one begins. Empty for slower sweeps: some may be left out.
    """
    steps = np.diff(np.asarray(stamps, np.int64))
    seconds = float(np.median(steps)) * 1e-9 if len(steps) else 0.0
    most = _SHORTER * SensorConfig().period
    return {"period": seconds} if SWEEP_SECONDS[0] <= seconds < most else {}


def usual_step(stamps: Sequence[int] | IntArray) -> float:
    """Seconds from a sweep to the next, on average where those of two lidars alternate.

    0 if fewer than three stamps (nanoseconds) tell.
    """
    ordered = np.asarray(stamps, np.int64)
    return 0.5e-9 * float(np.median(ordered[2:] - ordered[:-2])) if len(ordered) > 2 else 0.0


def span_problem(times: Iterable[NDArray[np.floating] | None], step: float) -> str:
    """What is wrong with the times of the points of sweeps, by the seconds from sweep to sweep.

    Their median span counts. Empty if nothing is wrong, or if such a step is that of no lidar.
    """
    spans = [float(np.ptp(some)) for some in times if some is not None and len(some)]
    seconds = float(np.median(spans)) if spans else 0.0
    if not SWEEP_SECONDS[0] <= step < seconds / _OVERLAP:
        return ""
    return (
        f"the times of the points span {seconds:.3g} s, but a sweep follows each {step:.3g} s; "
        "expected seconds (fractions of a sweep are to be multiplied by its duration), and stamps "
        "of the sweeps that are right"
    )


@dataclass(frozen=True, slots=True)
class TimeDecision:
    """How the point times of a data set are read.

    Attributes
    ----------
    field : name of the column
    unit : of its numbers
    clock : ``offset`` if they count from the sweep's stamp, ``stamp`` if they are absolute in the
        clock of the stamp, ``own`` if they are absolute in another clock
    anchor : moment of the sweep that is put at the stamp; None if the numbers themselves say
        where the stamp is
    span : first and last time of the sweep this was decided on, seconds from its stamp
    """

    field: str
    unit: str
    clock: Literal["offset", "stamp", "own"]
    anchor: str | None
    span: tuple[float, float]

    def __str__(self) -> str:
        clock = _CLOCKS[self.clock]
        anchor = f", sweep {self.anchor} put at the stamp" if self.anchor else ""
        span = f"{self.span[0]:+.4f} .. {self.span[1]:+.4f} s from the stamp"
        return f"field {self.field!r} in {self.unit}, {clock}{anchor}: {span}"


def decide_times(
    values: NDArray[Any],
    stamp: int,
    *,
    field: str,
    unit: str | None = None,
    stamp_is: str | None = None,
) -> TimeDecision:
    """Decide from the numbers (N,) of one sweep what they mean, but for what is given.

    ``field`` is their name. DatasetError if they fit no unit, or an option is unknown.
    """
    check_time_options(unit, stamp_is)
    relative, base = _split(values)
    low, high = _robust_bounds(relative, field)
    if unit is None:
        unit = _fitting_unit(float(base) + low, float(base) + high, high - low, field)
    scale = 1e-9 * _NANOSECONDS[unit]
    anchor = stamp_is
    clock: Literal["offset", "stamp", "own"]
    # Both ends: an absolute time near zero (a simulated clock) is told from an offset by the stamp.
    first = float(base) * scale + low * scale
    to_stamp = (_to_ns(base, unit) - stamp) * 1e-9 + low * scale
    near_zero = max(abs(first), abs(first + (high - low) * scale)) <= SWEEP_SECONDS[1]
    if near_zero and abs(first) <= abs(to_stamp):
        clock = "offset"
    elif abs(to_stamp) <= SWEEP_SECONDS[1]:
        clock = "stamp"
    else:
        clock, anchor = "own", anchor or "start"
    decision = TimeDecision(field, unit, clock, anchor, (0.0, 0.0))
    times, outlier = apply_times(values, stamp, decision)
    inliers = times[~outlier]
    return replace(decision, span=(float(inliers.min()), float(inliers.max())))


def apply_times(
    values: NDArray[Any], stamp: int, decision: TimeDecision
) -> tuple[FloatArray, BoolArray]:
    """Seconds (N,) from the stamp, and (N,) which are outliers, whose times are clipped.

    DatasetError if the sweep does not lie where ``decision`` says it should.
    """
    if len(values) == 0:
        return np.zeros(0), np.zeros(0, np.bool_)
    scale = 1e-9 * _NANOSECONDS[decision.unit]
    relative, base = _split(values)
    low, high = _robust_bounds(relative, decision.field)
    margin = 0.5 * (high - low) + SWEEP_SECONDS[0] / scale
    with np.errstate(invalid="ignore"):
        outlier: BoolArray = ~((relative >= low - margin) & (relative <= high + margin))
    inliers = relative[~outlier]
    first, last = float(inliers.min()) * scale, float(inliers.max()) * scale
    if decision.anchor is not None:
        shift = -(first + ANCHORS[decision.anchor] * (last - first))
    elif decision.clock == "stamp":
        shift = (_to_ns(base, decision.unit) - stamp) * 1e-9
    else:
        shift = float(base) * scale
    # Twice the longest sweep: a stamp may trail its sweep by the latency of the driver.
    if max(abs(first + shift), abs(last + shift)) > 2.0 * SWEEP_SECONDS[1]:
        raise DatasetError(
            f"point times ({decision}): this sweep lies {first + shift:.3f} .. "
            f"{last + shift:.3f} s from its stamp; expected within {2.0 * SWEEP_SECONDS[1]:g} s"
        )
    times = relative * scale + shift
    times[outlier] = np.clip(np.nan_to_num(times[outlier]), first + shift, last + shift)
    return times, outlier


def check_time_options(unit: str | None, stamp_is: str | None) -> None:
    """Raise DatasetError unless both options are known."""
    for name, value, known in (("time_unit", unit, _NANOSECONDS), ("stamp_is", stamp_is, ANCHORS)):
        if value is not None and value not in known:
            near = nearest(value, known, listing=False)
            raise DatasetError(f"{name}: expected one of {', '.join(known)}; got {value!r}{near}")


def _fitting_unit(low: float, high: float, span: float, field: str) -> str:
    for unit, nanoseconds in _NANOSECONDS.items():
        if SWEEP_SECONDS[0] <= span * nanoseconds * 1e-9 <= SWEEP_SECONDS[1]:
            return unit
    raise DatasetError(
        f"point-time field {field!r}: values {low:.9g} .. {high:.9g} (span {span:.6g}) fit no "
        f"unit; tried {', '.join(_NANOSECONDS)} for a sweep of {SWEEP_SECONDS[0]:g} to "
        f"{SWEEP_SECONDS[1]:g} s. Give time_unit if you know it, another time_field, or "
        f"{IGNORE_TIMES}"
    )


def _split(values: NDArray[Any]) -> tuple[FloatArray, int | float]:
    """Differences to a base value, exact also for absolute integer nanoseconds."""
    if values.dtype.kind in "iu":
        base = values[len(values) // 2] if len(values) else values.dtype.type(0)
        # Modulo 2**64, so a wild unsigned outlier cannot overflow; then read as signed.
        wide = values.astype(np.int64).view(np.uint64) - np.int64(base).view(np.uint64)
        return wide.view(np.int64).astype(np.float64), int(np.int64(base))
    with np.errstate(invalid="ignore"):  # some bit patterns of NaN do not survive it
        wide_values = values.astype(np.float64)
    finite = wide_values[np.isfinite(wide_values)]
    start = float(finite[0]) if len(finite) else 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        return wide_values - start, start


def _to_ns(base: int | float, unit: str) -> int:
    return round(base * _NANOSECONDS[unit])


def _robust_bounds(relative: FloatArray, field: str) -> tuple[float, float]:
    """Smallest and largest finite value once the outermost ones are set aside."""
    finite = relative[np.isfinite(relative)]
    if (count := len(finite)) == 0:
        wrong = f"all {len(relative)} values are NaN or infinite"
        raise DatasetError(f"point-time field {field!r}: {wrong}")
    trim = max(1, count // _TRIM) if count > 4 else 0
    ordered = np.partition(finite, [trim, count - 1 - trim])
    return float(ordered[trim]), float(ordered[count - 1 - trim])
