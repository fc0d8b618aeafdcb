"""Ranges that are all too long, or too short, by the same: what the residuals tell of it.

A wall that was seen at a grazing angle, and is now seen from the front, seems to have moved. See
docs/maths/covariance.md.
"""

from __future__ import annotations

from loam_gtsam.registration.solvers.scan_error import ScanError

_ODD, _LARGE = 5.0, 0.02
"""Standard deviations, and metres, beyond which an offset is worth a word: data sheets promise 2 to
3 cm, and on foliage or rolling ground sweeps without any offset look up to 1.8 cm too long."""


class RangeOffset:
    """By how much all ranges of a run are too long, as its sweeps tell it.

    Parameters
    ----------
    expected : standard deviation of what it may be before any sweep has told, metres
    removed : what was taken from all ranges before, ``sensor.range_offset``, metres
    """

    def __init__(self, expected: float, removed: float = 0.0) -> None:
        self._prior, self._removed = expected**-2, removed
        self._information = self._pull = 0.0

    def add(self, scan: ScanError) -> None:
        """Take in what a sweep tells whose pose all its matches together have fixed."""
        self._information += scan.offset_information
        self._pull += scan.offset_information * scan.offset

    @property
    def mean(self) -> float:
        """Metres."""
        return self._pull / (self._prior + self._information)

    @property
    def sigma(self) -> float:
        """Standard deviation of that, metres."""
        return float((self._prior + self._information) ** -0.5)

    @property
    def mean_square(self) -> float:
        """Expected square of the offset, m^2."""
        return self.mean**2 + self.sigma**2

    @property
    def advised(self) -> float:
        """Metres that ``sensor.range_offset`` should be; what it was, if there is no problem."""
        mean = self.mean
        return self._removed + (mean if abs(mean) > max(_LARGE, _ODD * self.sigma) else 0.0)

    @property
    def problem(self) -> str:
        """What is wrong with the ranges, as a sentence; empty if nothing is."""
        if self.advised == self._removed:
            return ""
        long = "long" if self.mean > 0.0 else "short"
        return (
            f"the ranges look {100.0 * abs(self.mean):.1f} cm too {long} (standard deviation "
            f"{100.0 * self.sigma:.1f} cm), which the covariances count; if this lidar always does "
            f"so, map with sensor.range_offset={self.advised:.3f}"
        )

    def as_dict(self) -> dict[str, float | str | None]:
        """For the summary of a run."""
        return {
            "offset_m": self.mean,
            "sigma_m": self.sigma,
            "advised_offset_m": self.advised,
            "problem": self.problem or None,
        }
