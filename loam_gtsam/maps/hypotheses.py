"""Hypotheses about the first fix: each is followed through a few sweeps until one stands."""

from __future__ import annotations

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.mapper import Mapper
from loam_gtsam.maps.first_fix import Candidate, PlaceSearch, standing_fit
from loam_gtsam.maps.saved_maps import SavedMaps
from loam_gtsam.registration.relocalization import Fit, same
from loam_gtsam.types import Features, FloatArray, FrameStatus, MapUpdate

SWEEPS = 3
"""Sweeps in a row, each solved with a known motion, that must fit before a fix is believed."""
_HYPOTHESES = 3  # that are followed at a time
_HOPEFUL = 0.5  # share of the best candidate's fit from which another one is followed, too
_CLEARLY = ((0.9, 0.75), (0.75, 0.5))
"""The less a place is as it was, the clearer must it stand out: least share of the matches that
agree, and share of the fix's own fit that no other place may then reach. Wrong registrations have
0.75 at most, right ones in an unchanged place 0.97 or more (``loops.min_agreement``). Of poses near
by, where the same walls fit by half, the first share is asked."""
_FASTEST, _TURNING = 50.0, 3.0  # m/s and rad/s, of the first motion


class Hypothesis:
    """A pose in the map, and what became of it in the sweeps after.

    Attributes
    ----------
    fits : of the sweeps with a known motion
    last : result for the last sweep
    """

    def __init__(self, posed: PosedSweep, features: Features, start: gtsam.Pose3, mapper: Mapper):
        self._mapper, self._config = mapper, mapper.config
        self._start: tuple[int, gtsam.Pose3] | None = (posed.sweep.stamp, start)
        self.fits: list[Fit] = []
        self.last = mapper.register(features, start.compose(posed.middle_T_reference), posed.twist)

    def follow(self, features: Features, search: PlaceSearch) -> bool:
        """Whether the next sweep is solved, too, and the last ones may yet fit."""
        guess: gtsam.Pose3 | None = None
        twist: FloatArray | None = None
        if self._start is not None:  # the second sweep may be metres away from the first
            sweep = MovingSweep(features, self._config)
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
        last = [fit.agreement for fit in self.fits[-SWEEPS:]]
        return len(last) < SWEEPS or max(last) >= _CLEARLY[-1][0]

    @property
    def pose(self) -> gtsam.Pose3:
        """At the middle of the last sweep."""
        return self.last.map_T_middle or self.last.map_T_lidar

    def rivals_below(self) -> float:
        """Share of its own fit that no other place may reach; 0 if it does not stand anyway."""
        last = self.fits[-SWEEPS:]
        if len(last) < SWEEPS or self.last.status is not FrameStatus.OK:
            return 0.0
        if not self.last.localizability[0] >= self._config.loops.min_aligned:
            return 0.0  # a direction is hardly seen, or it is not known
        agreement = min(fit.agreement for fit in last)
        return next((share for least, share in _CLEARLY if agreement >= least), 0.0)


class Hypotheses:
    """All hypotheses about where a lidar is in a saved map.

    Parameters
    ----------
    search : of the map
    maps : of the map
    config : of the mapper
    """

    def __init__(self, search: PlaceSearch, maps: SavedMaps, config: Config) -> None:
        self._search, self._maps, self._config = search, maps, config
        self._held: list[Hypothesis] = []

    def add(
        self, features: Features, near: gtsam.Pose3 | None = None
    ) -> tuple[MapUpdate | None, str]:
        """Follow all hypotheses to the next sweep; the fix if one stands, or why none does.

        ``near`` is a pose, if there is one, around which the sweep is looked for as well.
        """
        sweep = MovingSweep(features, self._config)
        self._held = [h for h in self._held if h.follow(features, self._search)]
        self._held = _different(sorted(self._held, key=lambda held: -held.fits[-1].total))
        message = ""
        for held in [held for held in self._held if held.rivals_below() > 0.0]:
            rivals = self._rivals(sweep.at(held.last.twist), features, held)
            if not rivals:
                return held.last, ""
            message = f"{len(rivals)} other poses fit the map nearly as well as the best"
            self._begin(sweep.at(held.last.twist), features, rivals)
            break
        if self._held:
            followed = f"{len(self._held)} poses are followed"
            return None, message or f"{followed}; the best: {_told(self._held[0].fits[-1])}"
        posed = sweep.at(np.zeros(6))
        found = self._search.find(posed, features.reach, near)
        self._begin(posed, features, found)
        return None, f"the best pose: {_told(found[0].fit)}" if found else "no place fits"

    def _begin(self, posed: PosedSweep, features: Features, found: list[Candidate]) -> None:
        """Follow the best of what was found, if they are not followed already."""
        for candidate in found[:_HYPOTHESES]:
            start, hopeful = candidate.map_T_middle, _HOPEFUL * found[0].fit.total
            known = any(same(start, held.pose) for held in self._held)
            if candidate.fit.total >= hopeful and not known and len(self._held) < 2 * _HYPOTHESES:
                mapper = Mapper(self._config)
                mapper.maps = self._maps
                self._held.append(Hypothesis(posed, features, start, mapper))

    def _rivals(self, posed: PosedSweep, features: Features, held: Hypothesis) -> list[Candidate]:
        """Other poses at which the sweep fits nearly as well, or better."""
        found = self._search.find(posed, features.reach, held.pose)
        own = [c.fit.total for c in found if same(c.map_T_middle, held.pose)]
        if not own:
            return found or [Candidate(held.pose, held.fits[-1])]  # not found again: no fix
        near, far = _CLEARLY[0][1] * own[0], held.rivals_below() * own[0]
        radius = self._config.loops.search
        return [
            c
            for c in found
            if not same(c.map_T_middle, held.pose)
            and c.fit.total >= (far if c.map_T_middle.range(held.pose) > radius else near)
        ]


def _different(hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    """The first of those that have come to the same pose."""
    chosen: list[Hypothesis] = []
    for one in hypotheses:
        if not any(same(one.pose, other.pose) for other in chosen):
            chosen.append(one)
    return chosen


def _told(fit: Fit) -> str:
    return f"{fit.share:.0%} of the features off the ground matched, {fit.agreement:.0%} agree"


def _offered(update: MapUpdate, config: Config) -> int:
    """Number of features that would be matched if all found a match."""
    most = config.matching.max_edges or np.inf, config.matching.max_planes or np.inf
    return int(min(update.n_edges, most[0]) + min(update.n_planes, most[1]))
