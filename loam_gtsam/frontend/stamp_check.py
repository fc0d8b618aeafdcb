"""Check that the stamps of sweeps come from one clock that goes forward."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from statistics import median_low

from loam_gtsam.types import SweepFault

LARGEST_STEP = 10.0
"""Seconds between two sweeps above which a stamp is doubted: in 10 s an acceleration of 1 m/s^2
leads 50 m away from the prediction. For a slow sensor the limit is ten of its own intervals, of
which the second sweep, which is doubted, and the third tell one."""
IN_A_ROW = 5
"""Number of consecutive doubted sweeps with consistent stamps that shows that the clock was set."""
_STEPS = 10  # intervals of the sensor between two sweeps above which a stamp is doubted
_SHORTEST = 1_000_000
"""Nanoseconds between two sweeps below which a stamp is none: no lidar makes a thousand sweeps a
second, and stamps that are no nanoseconds are as close."""
_SOON = 0.25
"""Share of the usual interval, or of the time that a sweep takes, below which a stamp is wrong: the
velocity would be four times the true one."""
_USUAL = 5  # number of intervals whose median is the usual one


@dataclass(frozen=True, slots=True)
class Refusal:
    """The reason why a sweep is not used because of its stamp.

    ``clock_step`` is by how many nanoseconds the clock was set ahead, if this sweep shows it, else
    0. The next sweep must be checked against the new clock.
    """

    fault: SweepFault
    message: str
    clock_step: int = 0


class StampCheck:
    """Comparison of each stamp with the stamp of the last sweep that was used.

    A stamp must be later than the last one, by a quarter of the usual interval at least (unless
    that sweep was so short, as where a cover left its end alone) and by at most
    :data:`LARGEST_STEP`; one wrong stamp costs one sweep. :data:`IN_A_ROW` of those that are
    far off and consistent show that the clock was set. If ahead, the run continues as if no time
    had passed; if back, it cannot, since trajectories ascend.
    """

    def __init__(self) -> None:
        self._steps: deque[int] = deque(maxlen=_USUAL)  # between the last sweeps that were used
        self._doubted: tuple[int, int, int] | None = None  # first and newest stamp, and count
        self._took = 0.0  # seconds that the last sweep took, 0 if that is not known

    def refuse(self, stamp: int, last: int, seconds: float = 0.0) -> Refusal | None:
        """The reason why a sweep cannot be used, by its stamp and that of the last one used, ns.

        None for a sweep that counts as used from now on. ``seconds`` is how long it took, 0 if that
        is not known.
        """
        step, before = stamp - last, self._before(stamp)
        largest = max(round(LARGEST_STEP * 1e9), _STEPS * before)
        usual = self._usual(round(seconds * 1e9))
        later = f"stamp {stamp} ns is {step * 1e-9:.6g} s after the last one, {last} ns"
        if 0 < step < _SHORTEST:
            return Refusal(SweepFault.TOO_SOON, f"{later}; expected nanoseconds")
        if 0 < step < _SOON * usual and not 0.0 < self._took <= step * 1e-9:
            told = f"{usual * 1e-9:.3g} s are usual"
            if not self._steps:
                told = f"the times of its points span {seconds:.3g} s: are they seconds?"
            return Refusal(SweepFault.TOO_SOON, f"{later}; {told}")
        if 0 < step <= largest:
            self._steps.append(step)
            self._doubted, self._took = None, seconds
            return None
        earlier = f"stamp {stamp} ns is not later than the last one, {last} ns"
        if step == 0:
            return Refusal(SweepFault.DUPLICATE_STAMP, earlier)
        if -largest <= step < 0:
            return Refusal(SweepFault.LATE, earlier)
        first, agree = self._agreeing(stamp, largest)
        if step < 0:
            if agree < IN_A_ROW:
                return Refusal(SweepFault.STAMP_BACK, earlier)
            return Refusal(
                SweepFault.CLOCK_SET_BACK,
                f"{earlier}, like the {agree - 1} sweeps before it: the clock was set back; reset "
                "the mapper, or map what follows as a run of its own",
            )
        if agree < IN_A_ROW:
            return Refusal(SweepFault.STAMP_AHEAD, later)
        # The first doubted sweep is taken to be one interval later than the last used sweep.
        ahead = first - before - last
        self._doubted = None
        return Refusal(
            SweepFault.CLOCK_SET_AHEAD,
            f"{agree} sweeps in a row are {ahead * 1e-9:.6g} s ahead: the clock was set, or there "
            "was a long pause; the run goes on from the last pose",
            ahead,
        )

    def _before(self, stamp: int) -> int:
        """The last step, ns; as long as there is none, that since the newest doubted sweep."""
        if self._steps:
            return self._steps[-1]
        return 0 if self._doubted is None else stamp - self._doubted[1]

    def _usual(self, seconds: int) -> int:
        """Interval between two sweeps, ns; at first the time that a sweep takes, if that is less.

        One step alone may be a gap, as at the beginning of a recording.
        """
        if not self._steps:
            return seconds
        return median_low(self._steps) if len(self._steps) > 1 else min(*self._steps, seconds)

    def _agreeing(self, stamp: int, largest: int) -> tuple[int, int]:
        """First stamp and number of the consistent doubted sweeps, this sweep included."""
        first, newest, count = self._doubted or (stamp, stamp, 1)
        if 0 < stamp - newest <= largest:
            count += 1
        elif stamp != newest:
            first, count = stamp, 1
        self._doubted = first, stamp, count
        return first, count
