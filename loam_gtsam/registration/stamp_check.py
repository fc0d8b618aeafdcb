"""Which stamps of sweeps can be used: one clock that goes forward, and what is wrong otherwise."""

from __future__ import annotations

from dataclasses import dataclass

from loam_gtsam.types import SweepFault

LARGEST_STEP = 10.0
"""Seconds from one sweep to the next beyond which the stamp is doubted: 1 m/s^2 leads 50 m away
from where a constant velocity does. A sensor that is slower may take ten of its own steps."""
IN_A_ROW = 5
"""Sweeps that must agree among themselves for the clock to count as set, not a stamp as wrong."""
_STEPS = 10


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why the stamp of a sweep is not used.

    Attributes
    ----------
    fault, message : the same, typed and as a sentence
    clock_step : nanoseconds by which the clock was found to be set ahead with this sweep, else 0:
        from the next one on it is the clock
    """

    fault: SweepFault
    message: str
    clock_step: int = 0


class StampCheck:
    """Holds each stamp against the last one that was used.

    A stamp must be later, and by no more than :data:`LARGEST_STEP`. A sweep beyond that is not
    used; a wrong stamp costs one sweep. If :data:`IN_A_ROW` of them follow each other, the clock
    was set, as it is when a computer that booted without one gets the time: ahead, the run goes on
    as if no time had passed; back, it cannot, as stamps in trajectories and graphs ascend, and this
    is said.
    """

    def __init__(self) -> None:
        self._step = 0
        self._doubted: tuple[int, int, int] | None = None  # first and newest stamp, and how many

    def refuse(self, stamp: int, last: int) -> Refusal | None:
        """Why a sweep cannot be used; None if it can, which is then taken as done.

        Parameters
        ----------
        stamp, last : nanoseconds, of this sweep and of the last one used
        """
        step = stamp - last
        largest = max(round(LARGEST_STEP * 1e9), _STEPS * self._step)
        if step > 0 and (step <= largest or not self._step):
            self._step = step
            self._doubted = None
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
            message = f"stamp {stamp} ns is {step * 1e-9:.6g} s after the last one, {last} ns"
            return Refusal(SweepFault.STAMP_AHEAD, message)
        # As if the first of them had come when it was due.
        ahead = first - self._step - last
        self._doubted = None
        return Refusal(
            SweepFault.CLOCK_SET_AHEAD,
            f"{agree} sweeps in a row are {ahead * 1e-9:.6g} s ahead: the clock was set, or there "
            "was a long pause; the run goes on from the last pose",
            ahead,
        )

    def _agreeing(self, stamp: int, largest: int) -> tuple[int, int]:
        """First stamp and number of the doubted sweeps in a row on one clock, with this one."""
        first, newest, count = self._doubted or (stamp, stamp, 1)
        if 0 < stamp - newest <= largest:
            count += 1
        elif stamp != newest:
            first, count = stamp, 1
        self._doubted = first, stamp, count
        return first, count
