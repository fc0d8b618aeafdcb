"""A drive in which everything that can be wrong with sweeps, stamps and IMU samples happens.

The faults are drawn from a seed, keep a few sound sweeps between them, and what the report of a run
has to count is known exactly.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.types import BadSweep, BoolArray, ImuSamples, IntArray, Scan, Sweep

SECOND = 10**9
HOUR, DAY = 3600 * SECOND, 86_400 * SECOND
SOUND = 15
"""Sweeps at the start without a fault: a run needs ten to know what is usual."""
_BETWEEN = (3, 9)
"""Sound sweeps from one fault to the next: at least, and fewer than."""
_IMU_BETWEEN = (200, 400)
"""Likewise samples."""

Rng = np.random.Generator


def _some(scan: Scan, chosen: BoolArray | IntArray) -> Scan:
    """The sweep with some of its points only."""
    assert scan.times is not None
    assert scan.rings is not None
    times, rings = scan.times[chosen], scan.rings[chosen]
    return replace(scan, points=scan.points[chosen], times=times, rings=rings)


def _thin(scan: Scan, rng: Rng, points: int) -> Scan:
    return _some(scan, np.sort(rng.choice(len(scan.points), points, replace=False)))


def _holes(scan: Scan, rng: Rng, share: float) -> Scan:
    """NaN and infinity in a share of the points."""
    points = scan.points.copy()
    wrong = rng.permutation(len(points))[: round(share * len(points))]
    points[wrong, rng.integers(0, 3, len(wrong))] = rng.choice(
        [np.nan, np.inf, -np.inf], len(wrong)
    )
    return replace(scan, points=points)


SPOILT: Mapping[str, tuple[str, Callable[[Scan, Rng], Sweep]]] = {
    "no points": ("empty", lambda scan, rng: _thin(scan, rng, 0)),
    "all points NaN": ("not_finite", lambda scan, rng: _holes(scan, rng, 1.0)),
    "a third of the points NaN or infinite": ("", lambda scan, rng: _holes(scan, rng, 1.0 / 3.0)),
    "seven points": ("too_few_points", lambda scan, rng: _thin(scan, rng, 7)),
    "sixty points": ("no_features", lambda scan, rng: _thin(scan, rng, 60)),
    "point times in nanoseconds": (
        "bad_times",
        lambda scan, rng: replace(scan, times=scan.times * 1e9),  # type: ignore[arg-type, operator]
    ),
    "all points on one ring": (
        "bad_rings",
        lambda scan, rng: replace(scan, rings=np.zeros(len(scan.points), np.int32)),
    ),
    "unreadable": ("unreadable", lambda scan, rng: BadSweep(scan.stamp, "7 bytes left over")),
}
"""What is in a sweep: the fault to be counted (none: the sweep can be used), and how it is made."""

DELIVERY: Mapping[str, tuple[int, Mapping[str, int], int]] = {
    "delivered twice": (1, {"duplicate_stamp": 1}, 0),
    "the last one in its stead": (1, {"repeated": 1}, 0),
    "too soon after the last": (1, {"too_soon": 1}, 1),
    "two in the wrong order": (2, {"late": 1}, 1),
    "three sweeps late": (4, {"late": 1}, 1),
    "two missing": (2, {}, 1),
    "stamp hours to years back": (1, {"stamp_back": 1}, 1),
    "stamp hours to years ahead": (1, {"stamp_ahead": 1}, 1),
    "clock back for eight sweeps": (8, {"stamp_back": 4, "clock_set_back": 4}, 1),
    "clock set ahead for good": (5, {"stamp_ahead": 4, "clock_set_ahead": 1}, 1),
}
"""How sweeps arrive: how many it takes, faults to be counted, and gaps between those used."""

KINDS = (*SPOILT, *DELIVERY)
IMU_KINDS = ("gap", "NaN", "repeated", "swapped", "hour back")
_IMU_LENGTH = {"gap": 100, "NaN": 6, "repeated": 3, "swapped": 2, "hour back": 10}
"""Samples."""


@dataclass(slots=True)
class Expected:
    """What the report has to say.

    Attributes
    ----------
    injected : faults of each kind
    faults, gaps : of sweeps
    not_finite : points of sweeps that can be used all the same
    imu : counts of the IMU's report
    """

    injected: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    gaps: int = 0
    not_finite: list[int] = field(default_factory=list)
    imu: Counter[str] = field(default_factory=Counter)


class FaultyDrive:
    """A built-in world and its faults.

    Parameters
    ----------
    world : as long as wanted
    seed : of the faults
    kinds : of faults

    Attributes
    ----------
    expected : of the sweeps, complete when all were delivered; of the IMU, when it was asked for
    """

    def __init__(
        self, world: SimulatedWorld, seed: int = 0, kinds: tuple[str, ...] = KINDS
    ) -> None:
        self.world, self._seed = world, seed
        self.expected = Expected()
        self._plan = list(_planned(len(world), np.random.default_rng([seed, 0]), kinds))

    def deliveries(self) -> Iterator[tuple[Sweep, int]]:
        """The sweeps as they arrive, each with its number in the world."""
        number, shift = 0, 0
        for first, kind in [*self._plan, (len(self.world), "")]:
            while number < first:
                yield self._sweep(number, shift), number
                number += 1
            if not kind:
                return
            rng = np.random.default_rng([self._seed, 1, first])
            self.expected.injected[kind] += 1
            if kind in SPOILT:
                yield self._spoilt(kind, first, shift, rng), first
            else:
                faults, gaps = DELIVERY[kind][1:]
                self.expected.faults.update(faults)
                self.expected.gaps += gaps
                if kind == "clock set ahead for good":
                    shift += self._clock_steps[first]
                yield from self._delivered(kind, first, shift, rng)
            number += _sweeps(kind)

    def _sweep(self, number: int, shift: int) -> Scan:
        scan = self.world.sweep(number)
        return replace(scan, stamp=scan.stamp + shift)

    def _spoilt(self, kind: str, number: int, shift: int, rng: Rng) -> Sweep:
        fault, spoil = SPOILT[kind]
        sweep = spoil(self._sweep(number, shift), rng)
        if fault:
            self.expected.faults[fault] += 1
        else:
            assert isinstance(sweep, Scan)
            bad = int(np.count_nonzero(~np.isfinite(sweep.points).all(axis=1)))
            self.expected.not_finite.append(bad)
        return sweep

    def _delivered(
        self, kind: str, first: int, shift: int, rng: Rng
    ) -> Iterator[tuple[Sweep, int]]:
        order = {
            "delivered twice": (0, 0),
            "two in the wrong order": (1, 0),
            "three sweeps late": (1, 2, 3, 0),
            "two missing": (),
        }.get(kind, range(_sweeps(kind)))
        off = 0
        if kind.startswith("stamp"):
            off = int(rng.integers(HOUR, 3650 * DAY)) * (1 if "ahead" in kind else -1)
        elif kind == "too soon after the last":
            off = -int(rng.integers(80_000_000, 99_000_000))  # of 100 ms
        elif kind == "clock back for eight sweeps":
            off = -int(rng.integers(HOUR, DAY))
        if kind == "the last one in its stead":
            copied = self._sweep(first - 1, shift)
            yield replace(copied, stamp=self._sweep(first, shift).stamp), first
            return
        for number in (first + step for step in order):
            yield self._sweep(number, shift + off), number

    @cached_property
    def _clock_steps(self) -> dict[int, int]:
        """Nanoseconds by which the clock is set ahead, by the first sweep after it."""
        rng = np.random.default_rng([self._seed, 2])
        firsts = [first for first, kind in self._plan if kind == "clock set ahead for good"]
        return {first: int(rng.integers(DAY, 30 * DAY)) for first in firsts}

    @cached_property
    def imu(self) -> ImuSamples:
        """The samples as they arrive, on the clock of the sweeps, with faults of their own."""
        sound, rng = self.world.imu, np.random.default_rng([self._seed, 3])
        shift = np.zeros(len(sound.stamps), np.int64)
        begins = [self.world.sweep(first).stamp for first in self._clock_steps]
        for begin, step in zip(begins, self._clock_steps.values(), strict=True):
            shift[sound.stamps >= begin] += step
        count: Counter[str] = Counter(gaps=len(begins))
        stamps, gyro = sound.stamps + shift, sound.gyro.copy()
        pieces: list[IntArray] = []
        done, turn = 0, 0
        margin = _IMU_BETWEEN[0]
        changes = np.flatnonzero(np.diff(shift))
        while True:
            at = done + int(rng.integers(*_IMU_BETWEEN))
            kind = IMU_KINDS[turn % len(IMU_KINDS)]
            end = at + _IMU_LENGTH[kind]
            if end + margin > len(stamps):
                break
            if ((changes > at - margin) & (changes < end + margin)).any():
                pieces.append(np.arange(done, end))
            else:
                here = np.arange(at, end)
                pieces += [np.arange(done, at), *_imu_fault(kind, here, stamps, gyro, count)]
                turn += 1
            done = end
        order = np.concatenate([*pieces, np.arange(done, len(stamps))])
        self.expected.imu = count
        assert sound.orientation is not None
        return ImuSamples(
            stamps[order], sound.orientation[order], gyro[order], sound.acceleration[order]
        )


def _imu_fault(
    kind: str, here: IntArray, stamps: IntArray, gyro: np.ndarray, count: Counter[str]
) -> list[IntArray]:
    """The samples of a stretch in the order in which they arrive; changes them and counts."""
    size = len(here)
    if kind == "gap":
        count["gaps"] += 1
        return []
    if kind == "NaN":
        gyro[here, here % 3] = np.nan
        count["not_finite"] += size
    elif kind == "repeated":
        count["duplicates"] += size
        return [np.repeat(here, 2)]
    elif kind == "swapped":
        count["out_of_order"] += 1
        return [here[::-1]]
    else:
        stamps[here] -= HOUR
        # They lie alone, far from all others.
        count.update(out_of_order=size, gaps=1)
    return [here]


def _planned(sweeps: int, rng: Rng, kinds: tuple[str, ...]) -> Iterator[tuple[int, str]]:
    """First sweep and kind of each fault; every kind once before any comes again."""
    at = SOUND
    while True:
        for kind in rng.permutation(kinds).tolist():
            if at + _sweeps(kind) + _BETWEEN[0] > sweeps:
                return
            yield at, kind
            at += _sweeps(kind) + int(rng.integers(*_BETWEEN))


def _sweeps(kind: str) -> int:
    """How many sweeps of the world a fault takes."""
    return DELIVERY[kind][0] if kind in DELIVERY else 1
