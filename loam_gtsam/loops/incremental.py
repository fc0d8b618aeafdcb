"""A factor graph in iSAM2, with loop closures that can be switched, kept as steps to repeat.

iSAM2 (Kaess et al., IJRR 2012) cannot be serialised, and its last bits depend on the order of all
updates. A graph that goes on as if never stopped is therefore built again by the same steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.types import BoolArray, FloatArray, InputError, OutputError

_RELINEARIZE = 1e-3  # rad or m a pose moves before iSAM2 linearises anew: an error of second order
_ROUNDS = 20  # largest number of updates of iSAM2 until the variables stay
_MOST_STEPS = 100  # beside four for each factor: so many are kept before the graph is begun anew
_STILL = 1e-5  # rad and m; a variable that moves less in an update stays

_Step = tuple[Any, ...]  # name of a method that changed the graph, and what it was given


class IncrementalGraph:
    """Factors and the current estimate of their variables.

    Attributes
    ----------
    factors, values : all but loop closures, and the estimates of all variables
    own : positions in ``factors`` of those that are a user's own
    has_own_factors : whether there may be factors beside those of the odometry
    """

    def __init__(self) -> None:
        self.factors = gtsam.NonlinearFactorGraph()  # all but loop closures
        self.values = gtsam.Values()  # current estimate
        self._loops: list[gtsam.NonlinearFactorGraph] = []  # each of one factor
        self._slots: list[int | None] = []  # place of each loop closure in iSAM2; None: inactive
        self._isam = _new_isam()
        self._last = -1  # place in iSAM2 of the last one of `factors`
        self._steps: list[_Step] = []
        self.own: list[int] = []
        self.has_own_factors = False
        self._before: dict[str, Any] | None = None
        self._is_watched = False

    def restorer(self) -> Callable[[], None]:
        """A function that brings the graph back to what it is now.

        A copy takes 20 microseconds a keyframe, so it is made by the first change.
        """
        self._before, self._is_watched = None, True
        return self._bring_back

    def __getstate__(self) -> list[_Step]:
        try:
            return [tuple(map(_as_text, step)) for step in self._steps]
        except RuntimeError as error:
            raise OutputError(
                "pose graph: GTSAM cannot serialise a factor or a variable that was added (a "
                "factor written in Python?), so the graph cannot be in a checkpoint, nor be "
                f"pickled: {error}"
            ) from error

    def __setstate__(self, state: list[_Step]) -> None:
        self.__init__()  # type: ignore[misc]
        calls = self.add, self.add_loop, self.switch, self.restart, self.forget
        repeat: dict[str, Callable[..., None]] = {call.__name__: call for call in calls}
        for name, *given in state:
            repeat[name](*map(_from_text, given))

    @property
    def active(self) -> tuple[bool, ...]:
        """Which of the loop closures are in the graph."""
        return tuple(slot is not None for slot in self._slots)

    def is_active(self, number: int) -> bool:
        """Whether a loop closure is in the graph."""
        return self._slots[number] is not None

    def add(
        self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, settle: bool = True
    ) -> None:
        """Add factors that are no loop closures, and start values of new variables.

        ``settle`` updates until the estimate stays; a new pose at the end of a chain needs it not,
        factors of a user's own do.

        Raises
        ------
        InputError
            If iSAM2 cannot solve the graph with them; the graph is then as it was before.
        """
        self._about_to_change()
        self.has_own_factors |= settle
        before = gtsam.Values(self.values) if settle else self.values
        try:
            result = self._isam.update(factors, values)
            self._last = result.getNewFactorsIndices()[-1]
            self.values.insert(values)
            if settle:
                self._settle()
        except Exception as error:
            self.restart(before, np.array(self.active, np.bool_))
            raise InputError(f"factor: iSAM2 cannot solve the graph with it: {error}") from error
        if settle:
            size = self.factors.size()
            self.own += range(size, size + factors.size())
        self.factors.push_back(factors)
        self._steps.append(("add", factors, values, settle))

    def add_loop(self, factor: gtsam.NonlinearFactorGraph) -> None:
        """Keep the factor of a loop closure, inactive at first; they are numbered from 0."""
        self._about_to_change()
        self._loops.append(factor)
        self._slots.append(None)
        self._steps.append(("add_loop", factor))

    def switch(self, number: int, on: bool) -> None:
        """Put a loop closure into the graph, or take it out."""
        self._about_to_change()
        slot = self._slots[number]
        graph = self._loops[number] if on else gtsam.NonlinearFactorGraph()
        result = self._isam.update(graph, gtsam.Values(), [] if slot is None else [slot])
        self._slots[number] = result.getNewFactorsIndices()[0] if on else None
        self._settle()
        self._steps.append(("switch", number, on))

    def forget(self, loops: int) -> None:
        """Take out the last variable, the last factor, and the last ``loops`` loop closures.

        They must be all that is on that variable. Where more has been done than there is left, the
        graph is begun anew, so that neither the steps nor iSAM2 grow with what is forgotten.
        """
        self._about_to_change()
        kept = len(self._loops) - loops
        gone = [slot for slot in self._slots[kept:] if slot is not None]
        del self._loops[kept:], self._slots[kept:]
        nothing = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._isam.update(*nothing, [*gone, self._last])
        self.factors.resize(self.factors.size() - 1)
        self._last = -1
        self.values = self._isam.calculateBestEstimate()
        self._settle()
        self._steps.append(("forget", loops))
        if len(self._steps) > 4 * (self.factors.size() + len(self._loops)) + _MOST_STEPS:
            self.restart(self.values, np.array(self.active, np.bool_))

    def restart(
        self,
        values: gtsam.Values,
        active: BoolArray,
        factors: gtsam.NonlinearFactorGraph | None = None,
        own: Sequence[int] | None = None,
    ) -> None:
        """Begin anew in iSAM2, from an estimate and with the ``active`` (L,) loop closures.

        ``factors`` are all but loop closures, and ``own`` the positions of a user's own; those that
        the graph has if None.
        """
        self._about_to_change()
        if factors is not None:
            self.factors, self.has_own_factors = factors, True  # which there may be
        self.own = self.own if own is None else [*own]
        graph = gtsam.NonlinearFactorGraph(self.factors)
        self._slots = [None] * len(self._loops)
        for number in np.flatnonzero(active).tolist():
            self._slots[number] = graph.size()
            graph.push_back(self._loops[number])
        self._isam = _new_isam()
        self._isam.update(graph, values)
        self._last = self.factors.size() - 1
        self.values = self._isam.calculateBestEstimate()
        # Whatever was done before need not be repeated.
        kept = gtsam.NonlinearFactorGraph(self.factors)
        self._steps = [("add_loop", factor) for factor in self._loops]
        self._steps.append(("restart", values, active, kept, [*self.own]))

    def covariance(self, key: int) -> FloatArray:
        """Marginal covariance of a variable, (6, 6) of a pose."""
        found: FloatArray = self._isam.marginalCovariance(key)
        return found

    def relative(self, earlier: int, later: int) -> tuple[gtsam.Pose3, FloatArray]:
        """See :func:`relative_pose`."""
        return relative_pose(self.values, self._isam, earlier, later)

    def _about_to_change(self) -> None:
        if self._is_watched and self._before is None:
            copies: dict[str, Any] = {
                "factors": gtsam.NonlinearFactorGraph(self.factors),
                "values": gtsam.Values(self.values),
                "_isam": gtsam.ISAM2(self._isam),
                "_loops": [*self._loops],
                "_slots": [*self._slots],
                "_steps": [*self._steps],
                "own": [*self.own],
            }
            self._before = vars(self) | copies

    def _bring_back(self) -> None:
        if self._before is not None:
            vars(self).update(self._before)
        self._before, self._is_watched = None, False

    def _settle(self) -> None:
        before = self.values
        for _ in range(_ROUNDS):
            self._isam.update()
            self.values = self._isam.calculateBestEstimate()
            if np.abs(before.localCoordinates(self.values).vector()).max() < _STILL:
                break
            before = self.values


def relative_pose(
    poses: gtsam.Values, marginals: gtsam.ISAM2 | gtsam.Marginals, earlier: int, later: int
) -> tuple[gtsam.Pose3, FloatArray]:
    """``earlier_T_later`` of the poses of two keys and its (6, 6) covariance."""
    between = poses.atPose3(earlier).between(poses.atPose3(later))
    joint = marginals.jointMarginalCovariance([earlier, later])
    to_later = between.inverse().AdjointMap()
    of_earlier, of_later = joint.at(earlier, earlier), joint.at(later, later)
    crossed = to_later @ joint.at(earlier, later)
    return between, to_later @ of_earlier @ to_later.T + of_later - crossed - crossed.T


def _new_isam() -> gtsam.ISAM2:
    params = gtsam.ISAM2Params()
    params.relinearizeSkip = 1
    params.setRelinearizeThreshold(_RELINEARIZE)
    # Cholesky calls the chain of a second session, which hangs on a wide prior, indeterminate.
    params.setFactorization("QR")
    return gtsam.ISAM2(params)


_TEXTS: dict[str, type] = {cls.__name__: cls for cls in (gtsam.NonlinearFactorGraph, gtsam.Values)}


def _as_text(value: Any) -> Any:
    """Factors or values as (name of the class, text), which keeps every bit."""
    name = type(value).__name__
    return (name, value.serialize()) if name in _TEXTS else value


def _from_text(value: Any) -> Any:
    if not isinstance(value, tuple):
        return value
    name, text = value
    made: Any = _TEXTS[name]()
    try:
        made.deserialize(text)
    except (RuntimeError, MemoryError) as error:
        raise ValueError(f"not the text of a gtsam {name}: {error}") from error
    return made
