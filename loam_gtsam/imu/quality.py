"""What was wrong with the samples of an IMU, in numbers and in sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.imu.at_rest import REST_SAMPLES, RestWindow
from loam_gtsam.types import FloatArray, ImuSamples, IntArray

FROZEN_TURN = 0.2
"""rad/s; an orientation that never changes while the gyro measures more is a placeholder."""


@dataclass(frozen=True, slots=True)
class ImuReport:
    """Numbers of a run's IMU samples, and what was put right.

    Attributes
    ----------
    samples : samples that were used
    duplicates : samples dropped because of their stamp; the first to come is kept
    out_of_order : samples older than one that came before them; sorted in
    not_finite : samples dropped because of NaN, infinity or an absurd value in stamp, gyro or
        acceleration
    unnormalised : quaternions brought to unit length
    no_orientation : samples without a quaternion, or with a zero, NaN or absurd one
    gaps : steps between neighbours longer than ``max_gap``
    rate : median sample rate, Hz; 0 if unknown; of the samples that are still held
    orientation : source of the orientation: the quaternions ("ahrs"), gyro and acceleration
        ("gravity_filter"), or "none"
    problems : the same and more in sentences, empty if all is well
    """

    samples: int
    duplicates: int
    out_of_order: int
    not_finite: int
    unnormalised: int
    no_orientation: int
    gaps: int
    rate: float
    orientation: str
    problems: tuple[str, ...]


_FAULTS = {
    "duplicates": "repeat a stamp: the first of each is kept",
    "out_of_order": "came late: sorted in",
    "too_late": "came too late: left out",
    "not_finite": "hold NaN, infinity or absurd values: left out",
    "unnormalised": "have a quaternion that is not of unit length: normalised",
    "no_orientation": "have no orientation: interpolated",
}


class QualityLog:
    """Counts what is wrong with samples, and finds out whether their orientation is one.

    ``counts`` are the samples by what is wrong with them, in the words of :class:`ImuReport`;
    "too_late" are those dropped because they are older than what the buffer still holds.
    ``constant`` is true until an orientation differs from the first one.
    """

    def __init__(self, config: ImuConfig, counts: Counter[str]) -> None:
        self._config, self._counts = config, counts
        self.constant = True
        self._first: FloatArray | None = None
        self._quaternions, self._fastest = 0, 0.0
        self._dropped = self._dropped_gaps = self._longest_gap = 0

    def watch_orientation(self, quaternions: FloatArray, gyro: FloatArray) -> None:
        """Note whether the orientation (4, N) ever changes and how fast the gyro (N, 3) turns."""
        self._fastest = max(self._fastest, float(np.linalg.norm(gyro, axis=1).max()))
        self._quaternions += quaternions.shape[1]
        if quaternions.shape[1]:
            if self._first is None:
                self._first = quaternions[:, :1].copy()
            self.constant &= bool((quaternions == self._first).all())

    @property
    def measured(self) -> bool:
        """Whether the samples hold an orientation that is no placeholder."""
        enough = self._quaternions >= REST_SAMPLES
        placeholder = enough and self.constant and self._fastest > FROZEN_TURN
        return self._quaternions > 0 and not placeholder

    def drop(self, stamps: IntArray) -> None:
        """Keep the numbers of samples that are dropped: all of ``stamps`` but the last one."""
        gaps = self._gaps(stamps)
        self._dropped += len(stamps) - 1
        self._dropped_gaps += len(gaps)
        self._longest_gap = max(self._longest_gap, int(gaps.max(initial=0)))

    def report(
        self, held: ImuSamples, rest: RestWindow | None, filtered: bool, wrong: Sequence[str] = ()
    ) -> ImuReport:
        """The report on all samples so far, of which some are ``held``.

        ``rest`` is that at the start of the run, ``filtered`` says whether there is an orientation
        at all, and ``wrong`` are the problems of the values.
        """
        stamps, counts = held.stamps, self._counts
        samples = self._dropped + len(stamps)
        felt = bool(held.acceleration.any())  # else there is no accelerometer
        source, problem = self._source(felt, rest, filtered)
        frozen = (
            f"IMU: the orientation never changes while the gyro says {self._fastest:.2g} rad/s: "
            "it is a placeholder and not used"
        )
        problems = [frozen] if self._quaternions and not self.measured else []
        problems += [problem] if problem else []
        problems += wrong
        for fault, what in _FAULTS.items():
            if counts[fault] and (fault != "no_orientation" or source == "ahrs"):
                problems.append(f"IMU: {counts[fault]} samples {what}")
        steps, gaps = np.diff(stamps), self._gaps(stamps)
        number = self._dropped_gaps + len(gaps)
        if number:
            longest = max(self._longest_gap, int(gaps.max(initial=0))) * 1e-9
            problems.append(
                f"IMU: {number} gaps of more than {self._config.max_gap:g} s, the longest "
                f"{longest:.3g} s: nothing is known inside them"
            )
        return ImuReport(
            samples=samples,
            duplicates=counts["duplicates"],
            out_of_order=counts["out_of_order"],
            not_finite=counts["not_finite"],
            unnormalised=counts["unnormalised"],
            no_orientation=counts["no_orientation"],
            gaps=number,
            rate=1e9 / float(np.median(steps)) if len(steps) else 0.0,
            orientation=source,
            problems=tuple(problems),
        )

    def _gaps(self, stamps: IntArray) -> IntArray:
        steps = np.diff(stamps)
        return steps[steps > round(self._config.max_gap * 1e9)]

    def _source(self, felt: bool, rest: RestWindow | None, filtered: bool) -> tuple[str, str]:
        """Where the orientation comes from, and what is wrong with that, "" if nothing."""
        if self.measured:
            return "ahrs", ""
        if not felt:
            return "none", ""
        if not filtered:
            return "none", (
                "IMU: no orientation, and none to be had from the acceleration, whose mean at the "
                f"start is not near {self._config.gravity:g} m/s^2 (imu.gravity): expected m/s^2"
            )
        if rest is None:
            return "gravity_filter", (
                "IMU: no orientation, and no rest at the start to take the bias of the gyro from: "
                "roll and pitch may be off by several degrees"
            )
        return "gravity_filter", ""
