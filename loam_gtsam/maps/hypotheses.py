"""Hypotheses about the first fix: each is followed through a few sweeps until one stands."""

from __future__ import annotations

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.mapper import Mapper
from loam_gtsam.maps.first_fix import Candidate, PlaceSearch, same, standing_fit
from loam_gtsam.maps.frozen import FrozenMaps
from loam_gtsam.registration.relocalization import Fit
from loam_gtsam.types import Features, FloatArray, FrameStatus, MapUpdate

SWEEPS = 3
"""Sweeps in a row, each solved with a known motion, that must fit before a fix is believed."""
_HYPOTHESES = 3  # that are followed at a time
_HOPEFUL = 0.5  # share of the best candidate's fit from which another one is followed, too
_CLEARLY = 0.75  # share of the fix's own fit that no other place may reach
_LEAST_SHARE = 0.25
"""Share of the features off level ground that must have a match: fewer may be chance, and much of a
place may have changed since it was mapped."""
_FASTEST, _TURNING = 50.0, 3.0  # m/s and rad/s, of the first motion


class Hypothesis:
    """A pose in the map, and what became of it in the sweeps after.

    Attributes
    ----------
    fits : of the sweeps with a known motion
    last : result for the last sweep
    """

    def __init__(self, posed: PosedSweep, features: Features, start: gtsam.Pose3, mapper: Mapper):
        self._mapper = mapper
        self._start: tuple[int, gtsam.Pose3] | None = (posed.sweep.stamp, start)
        self.fits: list[Fit] = []
        self.last = mapper.register(features, start.compose(posed.middle_T_reference), posed.twist)

    def follow(self, features: Features, search: PlaceSearch, config: Config) -> bool:
        """Whether the next sweep is solved, too."""
        guess: gtsam.Pose3 | None = None
        twist: FloatArray | None = None
        if self._start is not None:  # the second sweep may be metres away from the first
            sweep = MovingSweep(features, config)
            posed = sweep.at(self.last.twist)
            seconds = max((sweep.stamp - self._start[0]) * 1e-9, 0.0)
            reach = max(1.0, _FASTEST * seconds), _TURNING * seconds + np.radians(5.0)
            near = search.around(posed, self._start[1], reach[0], features.reach, reach[1])
            if not near or sweep.stamp <= self._start[0]:
                return False
            twist = sweep.twist_since(self._start, near[0].map_T_middle)
            guess = near[0].map_T_middle.compose(sweep.at(twist).middle_T_reference)
            self._start = None
        self.last = self._mapper.register(features, guess, twist)
        seen = self._mapper.registered
        if not self.last.status.solved or seen is None or seen.matches is None:
            return False
        offered = _offered(self.last, self._mapper.maps.config)
        self.fits.append(standing_fit(seen.matches, offered, seen.map_T_middle))
        return True

    def stands(self, config: Config) -> bool:
        """Whether the last sweeps fit the map, and no direction was left free."""
        last = self.fits[-SWEEPS:]
        return (
            len(last) == SWEEPS
            and self.last.status is FrameStatus.OK
            and min(fit.agreement for fit in last) >= config.loops.min_agreement
            and min(fit.share for fit in last) >= _LEAST_SHARE
        )


class Hypotheses:
    """All hypotheses about where a lidar is in a saved map.

    Parameters
    ----------
    search : of the map
    maps : of the map
    config : of the mapper
    """

    def __init__(self, search: PlaceSearch, maps: FrozenMaps, config: Config) -> None:
        self._search, self._maps, self._config = search, maps, config
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._held: list[Hypothesis] = []

    def add(
        self, features: Features, near: gtsam.Pose3 | None = None
    ) -> tuple[MapUpdate | None, str]:
        """Follow all hypotheses to the next sweep; the fix if one stands, or why none does.

        ``near`` is a pose, if there is one, around which the sweep is looked for as well.
        """
        sweep = MovingSweep(features, self._config)
        self._held = [h for h in self._held if h.follow(features, self._search, self._config)]
        self._held.sort(key=lambda held: -held.fits[-1].total)
        for held in [held for held in self._held if held.stands(self._config)]:
            rivals = self._rivals(sweep.at(held.last.twist), features, held)
            if not rivals:
                return held.last, ""
            message = f"{len(rivals) + 1} places fit the map alike"
            self._begin(sweep.at(held.last.twist), features, rivals)
            return None, message
        if self._held:
            fit = self._held[0].fits[-1]
            return None, f"{len(self._held)} places are followed; best: {_told(fit)}"
        posed = sweep.at(np.zeros(6))
        found = self._search.find(posed, features.reach, near)
        self._begin(posed, features, found)
        return None, f"best place: {_told(found[0].fit)}" if found else "no place fits"

    def _begin(self, posed: PosedSweep, features: Features, found: list[Candidate]) -> None:
        for candidate in found[:_HYPOTHESES]:
            if candidate.fit.total >= _HOPEFUL * found[0].fit.total:
                mapper = Mapper(self._config)
                mapper.maps = self._maps
                start = candidate.map_T_middle
                self._held.append(Hypothesis(posed, features, start, mapper))

    def _rivals(self, posed: PosedSweep, features: Features, held: Hypothesis) -> list[Candidate]:
        """Other poses at which the sweep fits nearly as well."""
        found = self._search.find(posed, features.reach, held.last.map_T_middle)
        here = held.last.map_T_middle or held.last.map_T_lidar
        own = [c for c in found if same(c.map_T_middle, here)]
        least = _CLEARLY * max((c.fit.total for c in own), default=0.0)
        return [c for c in found if c not in own and c.fit.total >= least]


def _told(fit: Fit) -> str:
    return f"{fit.share:.0%} of the features off the ground matched, {fit.agreement:.0%} agree"


def _offered(update: MapUpdate, config: Config) -> int:
    """Number of features that would be matched if all found a match."""
    most = config.matching.max_edges or np.inf, config.matching.max_planes or np.inf
    return int(min(update.n_edges, most[0]) + min(update.n_planes, most[1]))
