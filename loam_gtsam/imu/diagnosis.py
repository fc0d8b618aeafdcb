"""What is wrong with an IMU, in sentences: by its samples alone, and by the turns of the scans.

Turns, rotation vectors over the same stretches of time, are compared as sets of vectors: constant
differences are biases, one rotation between the sets is a mounting, one factor a unit, and a shift
in time a clock (docs/maths/imu_buffer.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.geometry import integrated, interpolated
from loam_gtsam.imu.at_rest import RestWindow
from loam_gtsam.imu.quaternions import inverse, logarithm, quaternion_product, rotate
from loam_gtsam.types import FloatArray, ImuSamples, IntArray

LATEST = 0.5  # seconds: largest shift of the IMU's clock that is looked for
MOUNTING_LIMIT = np.deg2rad(5.0)
"""rad from which on a configured rotation is called wrong, if the better one is known well."""
TILT_LIMIT = np.deg2rad(5.0)
"""rad between up by the orientation and up by the accelerometer, from which on one of them is
called wrong: an accelerometer bias of 0.85 m/s^2, ten times that of a consumer MEMS."""

_MOUNTING_SIGMA = np.deg2rad(1.5)
"""rad, largest standard deviation of the better rotation about any axis for it to be believed."""
_PAIRS = 20  # frames below which nothing is said
_WINDOWS = 8  # windows of orientation and gyro below which nothing is said
_ALIKE = 0.8  # correlation of turns above which they are those of one body
_SURE = 12.5  # gain in log-likelihood of a shift of five standard deviations
_SHIFT_STEP, _SHIFT_LEAST = 0.01, 0.005  # seconds
_SHIFTS: FloatArray = _SHIFT_STEP * np.arange(
    -round(LATEST / _SHIFT_STEP), round(LATEST / _SHIFT_STEP) + 1, dtype=np.float64
)
_UNITS = np.pi / 180.0, 180.0 / np.pi  # factors between two sets of turns that have a reason
_FORCE = 0.7, 1.4  # median specific force in multiples of gravity: no unit and no fault lies in it
_HARDEST = 3.0  # multiples of gravity that no vehicle feels for long
_LYING = np.deg2rad(60.0)  # rad from upright, from which on a mean tilt is worth a word
_FROZEN = 1.0  # seconds over which no sensor with noise repeats its values
_WINDOW = 0.5  # seconds over which orientation and gyro are compared
_ATTITUDE = np.deg2rad(2.0)  # rad: by so much they may differ at any time
_SHARE = 0.25  # and by this share of the turn
_SPEED_CHANGE = 20.0  # m/s: the mean acceleration of a recording is at most this over its length


class TurnFit(NamedTuple):
    """How one set of turns, (N, 3) rad, becomes another one: ``first = factor R second + bias``.

    Attributes
    ----------
    R : rotation between the two
    factor : between the two
    likeness : correlation coefficient of the two, thus turned
    mirrored : the same with all signs of one axis turned as well
    sigma : rad, standard deviation of R about its worst axis; infinite if it is unknown
    residuals : (N,) rad, lengths of what is left
    """

    R: gtsam.Rot3
    factor: float
    likeness: float
    mirrored: float
    sigma: float
    residuals: FloatArray


def compare_turns(first: FloatArray, second: FloatArray) -> TurnFit:
    """Fit turns (N, 3) to others: Wahba's problem in closed form by SVD (Markley 1988).

    Reference: J. Astronautical Sciences 36, 1988.
    """
    first, second = first - first.mean(axis=0), second - second.mean(axis=0)
    left, strength, right = np.linalg.svd(first.T @ second)
    sign = float(np.sign(np.linalg.det(left) * np.linalg.det(right))) or 1.0
    R = left @ np.diag([1.0, 1.0, sign]) @ right
    squares = max(float((first**2).sum()), 1e-30), max(float((second**2).sum()), 1e-30)
    agree = strength[0] + strength[1] + sign * strength[2]
    other = strength[0] + strength[1] - sign * strength[2]
    factor = float(agree / squares[1])
    residuals = np.linalg.norm(first - factor * second @ R.T, axis=1)
    variance = float((residuals**2).sum()) / max(3 * len(first) - 7, 1)
    # Information about the axis known least. Products of the two, not squares of one: noise, which
    # is not the same in both, must not pass for motion.
    weakest = factor * (strength[1] + sign * strength[2])
    sigma = np.sqrt(variance / weakest) if weakest > 0.0 else np.inf
    like = 1.0 / np.sqrt(squares[0] * squares[1])
    return TurnFit(gtsam.Rot3(R), factor, like * agree, like * other, float(sigma), residuals)


def samples_problems(
    samples: ImuSamples, config: ImuConfig, rest: RestWindow | None
) -> tuple[str, ...]:
    """Sentences on what is wrong with samples in lidar axes, of which nothing else is known.

    ``rest`` is that at the start of the run, None if there is none.
    """
    if len(samples.stamps) < 2:
        return ()
    seconds = (samples.stamps - samples.stamps[0]) * 1e-9
    force = ""
    if samples.acceleration.any():  # or there is no accelerometer
        force = _force(samples, seconds, config.gravity) or _up_problem(samples, seconds, rest)
    found = (
        _frozen(samples, seconds),
        _orientation_problem(samples, seconds, config.max_gap),
        force,
    )
    return tuple(f"IMU: {problem}" for problem in found if problem)


def scans_problems(
    spans: IntArray, by_scan: FloatArray, by_gyro: FloatArray, samples: ImuSamples,
    config: ImuConfig,
) -> tuple[str, ...]:  # fmt: skip
    """Sentences on what the turns of the scans say about the gyro: its clock, unit and mounting.

    Parameters
    ----------
    spans : (N, 2) stamps between which the scans turned, nanoseconds
    by_scan, by_gyro : (N, 3) rotation vectors over these spans, rad, lidar axes
    samples : those that are left, lidar axes
    """
    if len(spans) < _PAIRS:
        return ()
    shifts: tuple[float, ...] = (0.0,)
    held = _in_time(spans, by_scan, samples)
    if held is not None:
        shifts, by_scan, by_gyro = held
    # With wrong axes the scans are not what they should be, and the clock is not named.
    problem = _unlike(by_scan, by_gyro, config) or _clock_problem(shifts, config)
    return (f"IMU: {problem}",) if problem else ()


def _unlike(by_scan: FloatArray, by_gyro: FloatArray, config: ImuConfig) -> str:
    """Unit or axes in which turns of a gyro that is in time are unlike those of the scans."""
    # How far, unlike about which axis, does not depend on the mounting: a pair that disagrees in
    # that is a lost track or a fault of the gyro, and would only mislead.
    unit = _unit(compare_turns(by_scan, by_gyro))
    apart = np.linalg.norm(by_scan, axis=1) - unit * np.linalg.norm(by_gyro, axis=1)
    fair = np.abs(apart) <= 3.0 * np.median(np.abs(apart)) + 1e-9
    fit = compare_turns(by_scan[fair], by_gyro[fair])
    if fit.mirrored > _ALIKE and _gain(fit.mirrored, fit.likeness, len(by_scan)) > _SURE:
        return "its axes are left-handed: one of them has the wrong sign"
    if fit.sigma > _MOUNTING_SIGMA:
        return ""
    if unit != 1.0:
        return _in_words(unit)
    away = float(np.linalg.norm(gtsam.Rot3.Logmap(fit.R)))
    if away <= MOUNTING_LIMIT:
        return ""
    configured = gtsam.Rot3.RzRyRx(*np.deg2rad(config.lidar_R_imu_deg))
    angles = np.rad2deg(fit.R.compose(configured).rpy()).round().astype(int)
    return (
        f"its rotations fit those of the scans better by {np.rad2deg(away):.0f} degrees with "
        f"imu.lidar_R_imu_deg = {angles.tolist()}; check how the IMU is mounted"
    )


def _clock_problem(shifts: tuple[float, ...], config: ImuConfig) -> str:
    """By how much a clock is late, in all of the run or in each half of it."""
    if len(shifts) > 1:
        first, second = map(_late, shifts)
        return (
            f"its clock jumps or drifts against that of the sweeps: {first} in one half of the "
            f"run and {second} in the other, which no imu.time_offset puts right; check how both "
            "are stamped"
        )
    (shift,) = shifts
    if not shift:
        return ""
    return (
        f"its clock is {_late(shift)} against that of the sweeps: set imu.time_offset to "
        f"{config.time_offset - shift:.3f}"
    )


def _late(shift: float) -> str:
    """In words by how many seconds a clock is late."""
    if abs(shift) < _SHIFT_LEAST:
        return "in time"
    return f"{1e3 * abs(shift):.0f} ms {'late' if shift > 0.0 else 'early'}"


def _in_time(
    spans: IntArray, by_scan: FloatArray, samples: ImuSamples
) -> tuple[tuple[float, ...], FloatArray, FloatArray] | None:
    """Seconds by which the samples are late; turns by scan and gyro with that put right.

    The turns are compared whatever the mounting and the unit. The shift is 0 if no other one is
    surely better; there are two, one for each half of the time, if these are. None if too few
    samples are left.
    """
    if not len(samples.stamps):
        return None
    origin = samples.stamps[0]
    times = (samples.stamps - origin) * 1e-9
    turned = integrated(samples.gyro, times)

    def gyro(shift: float) -> FloatArray:
        first, last = interpolated(((spans - origin) * 1e-9 + shift).T, times, turned)
        turns: FloatArray = last - first
        return turns

    held = (spans[:, 0] - origin) * 1e-9 - LATEST > 0.0
    held &= (spans[:, 1] - origin) * 1e-9 + LATEST < times[-1]
    spans, by_scan = spans[held], by_scan[held]
    best = gains = None
    for _ in range(2):  # the second time without the pairs that fit nowhere
        if len(spans) < _PAIRS:
            return None
        turns = [gyro(shift) for shift in _SHIFTS]
        fits = [compare_turns(by_scan, one) for one in turns]
        gains = np.array([_gain(fit.likeness, 0.0, len(spans)) for fit in fits])
        best = int(gains.argmax())
        left = fits[best].residuals
        kept = left <= 3.0 * np.median(left)
        spans, by_scan = spans[kept], by_scan[kept]
    assert best is not None
    assert gains is not None
    halves = _halves(by_scan, [one[kept] for one in turns], best)
    if halves is not None:
        middle = len(spans) // 2
        by_gyro = np.concatenate([gyro(halves[0])[:middle], gyro(halves[1])[middle:]])
        return halves, by_scan, by_gyro
    if best in (0, len(_SHIFTS) - 1) or gains[best] - gains[len(_SHIFTS) // 2] < _SURE:
        return (0.0,), by_scan, gyro(0.0)
    shift = _top(gains)
    shift = shift if abs(shift) >= _SHIFT_LEAST else 0.0
    return (shift,), by_scan, gyro(shift)


def _halves(
    by_scan: FloatArray, turns: Sequence[FloatArray], best: int
) -> tuple[float, float] | None:
    """Shifts of the halves of the pairs, if these are surely better than the ``best`` of all.

    ``turns`` are those of the gyro at each shift.
    """
    middle = len(by_scan) // 2
    if middle < _PAIRS:
        return None
    gains = [
        np.array([
            _gain(compare_turns(by_scan[half], one[half]).likeness, 0.0, len(by_scan[half]))
            for one in turns
        ])
        for half in (slice(None, middle), slice(middle, None))
    ]  # fmt: skip
    first, second = map(_top, gains)
    gained = sum(float(half.max() - half[best]) for half in gains)
    return (first, second) if gained > _SURE and abs(first - second) > _SHIFT_STEP else None


def _top(gains: FloatArray) -> float:
    """The shift, seconds, at the top of a parabola through the best one and its neighbours."""
    best = int(gains[1:-1].argmax()) + 1
    before, top, after = gains[best - 1 : best + 2]
    beside = 0.5 * (before - after) / min(before - 2 * top + after, -1e-12)
    return float(_SHIFTS[best] + _SHIFT_STEP * np.clip(beside, -0.5, 0.5))


def _gain(likeness: float, other: float, count: int) -> float:
    """Log-likelihood of turns that are alike by ``likeness`` over that of ``other``."""
    left = [max(1.0 - min(max(like, 0.0), 1.0) ** 2, 1e-12) for like in (likeness, other)]
    return 1.5 * count * float(np.log(left[1] / left[0]))


def _unit(fit: TurnFit) -> float:
    """By what the second turns are to be multiplied if they are in another unit; else 1."""
    return next((unit for unit in _UNITS if 0.5 < fit.factor / unit < 2.0), 1.0)


def _in_words(unit: float) -> str:
    wrong = "degrees per second" if unit < 1.0 else "a unit too large by 180 / pi"
    return f"the gyro is in {wrong}, expected rad/s"


def _frozen(samples: ImuSamples, seconds: FloatArray) -> str:
    same = (np.diff(samples.gyro, axis=0) == 0.0).all(axis=1)
    same &= (np.diff(samples.acceleration, axis=0) == 0.0).all(axis=1)
    changes = np.flatnonzero(np.concatenate([[True], ~same, [True]]))
    longest = float((seconds[changes[1:] - 1] - seconds[changes[:-1]]).max())
    if longest < _FROZEN:
        return ""
    return f"gyro and accelerometer repeat the same values for {longest:.1f} s: frozen"


def _force(samples: ImuSamples, seconds: FloatArray, gravity: float) -> str:
    force = np.linalg.norm(samples.acceleration, axis=1)
    usual = float(np.median(force))
    if not _FORCE[0] < usual / gravity < _FORCE[1]:
        cause = (
            "it is in multiples of gravity" if 0.9 < usual < 1.1
            else "gravity has been taken off" if usual < 0.5 * gravity
            else "check its unit"
        )  # fmt: skip
        return (
            f"the median acceleration is {usual:.2g} m/s^2, expected near {gravity:g} "
            f"(imu.gravity), which an accelerometer feels at rest: {cause}"
        )
    hard = float(np.mean(force > _HARDEST * gravity) * seconds[-1])
    if hard < _WINDOW:
        return ""
    return f"the acceleration is above {_HARDEST:g} g for {hard:.1f} s in all: a fault"


def _orientation_problem(samples: ImuSamples, seconds: FloatArray, max_gap: float) -> str:
    """Whether the orientation turns as the gyro does, over windows of half a second."""
    if samples.orientation is None:
        return ""
    known = np.isfinite(samples.orientation[:, 0])
    if not known.any():
        return ""
    q, at = samples.orientation[known].T, seconds[known]
    by_gyro = integrated(samples.gyro, seconds)[known]
    steps = logarithm(quaternion_product(inverse(q[:, :-1]), q[:, 1:]))
    steps = np.where(np.diff(at) > max_gap, np.nan, steps)
    ends = np.searchsorted(at, np.arange(at[0], at[-1], _WINDOW))
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=1).T])
    attitude, gyro = np.diff(turned[ends], axis=0), np.diff(by_gyro[ends], axis=0)
    whole = np.isfinite(attitude[:, 0])
    attitude, gyro = attitude[whole], gyro[whole]
    if len(gyro) < _WINDOWS:
        return ""
    away = float(np.median(np.linalg.norm(attitude - gyro, axis=1)))
    if away < _ATTITUDE + _SHARE * float(np.median(np.linalg.norm(gyro, axis=1))):
        return ""
    fit = compare_turns(attitude, gyro)
    rotation = float(np.rad2deg(np.linalg.norm(gtsam.Rot3.Logmap(fit.R))))
    if fit.likeness < _ALIKE:
        cause = "they have nothing in common"
    elif _unit(fit) != 1.0:
        cause = _in_words(_unit(fit))
    else:
        cause = f"their axes are {rotation:.0f} degrees apart"
    return (
        f"in half a second, orientation and gyro turn {np.rad2deg(away):.2g} degrees apart in the "
        f"median: {cause}; imu.prior off does without the orientation"
    )


def _up_problem(samples: ImuSamples, seconds: FloatArray, rest: RestWindow | None) -> str:
    """Whether orientation and accelerometer agree on what is up, and whether the lidar stands."""
    mean = samples.acceleration.mean(axis=0)
    tilt = float(np.arctan2(np.hypot(*mean[:2]), mean[2]))
    known = None if samples.orientation is None else np.isfinite(samples.orientation[:, 0])
    apart, limit, when = float("nan"), TILT_LIMIT, "at rest at the start"
    if rest is not None:
        apart = rest.disagreement
    elif known is not None and known.any():
        assert samples.orientation is not None
        force = rotate(samples.orientation[known].T, samples.acceleration[known].T)
        force = force.mean(axis=1)
        apart = float(np.arctan2(np.hypot(*force[:2]), force[2]))
        gravity = max(float(np.linalg.norm(mean)), 1e-9)
        limit += float(np.arctan(_SPEED_CHANGE / max(float(seconds[-1]), 1e-3) / gravity))
        when = "in the mean"
    if apart > limit:
        return (
            f"{when}, up by the orientation and up by the accelerometer are "
            f"{np.rad2deg(apart):.0f} degrees apart: expected the orientation of the IMU in a "
            "world with z up (not the north-east-down one) and an acceleration that reads +9.8 "
            "upwards; correct the driver or set imu.prior to off"
        )
    if tilt > _LYING:
        return (
            f"by the accelerometer the lidar is tilted by {np.rad2deg(tilt):.0f} degrees; if it is "
            "not, set imu.lidar_R_imu_deg to how the IMU is mounted"
        )
    return ""
