"""Hypotheses about the first fix: each is followed through a few sweeps until one stands."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.loops.keyframes import surely_placed
from loam_gtsam.mapper import Mapper
from loam_gtsam.maps.first_fix import Candidate, PlaceSearch
from loam_gtsam.maps.saved_maps import SavedMaps
from loam_gtsam.registration.matches import trial_matching
from loam_gtsam.registration.odometry import advance
from loam_gtsam.registration.relocalization import Fit, distinct, same, same_optimum
from loam_gtsam.registration.relocalization.fits import APART, AS_WELL, standing_fit
from loam_gtsam.types import Features, FloatArray, FrameStatus, MapUpdate

_TURNED, _MOVED = slice(3), slice(3, 6)
SWEEPS = 3
"""Sweeps in a row that must fit before a fix is believed."""
_HYPOTHESES = 3  # that a search adds at most; twice as many are followed at a time
_HOPEFUL = 0.5  # share of the best candidate's fit from which another one is followed, too
_CLEARLY = ((0.9, AS_WELL), (0.75, 0.5))
"""The less a place is as it was, the clearer must it stand out: least share of the matches that
agree, and share of the fix's own fit that no other place may then reach. Of a place that is as it
was nearly all agree (``loops.min_agreement``), of one that looks the same up to 0.98."""


class Hypothesis:
    """A pose in the map, and what became of it in the sweeps after.

    Attributes
    ----------
    fits : of the sweeps
    last : result for the last sweep
    """

    def __init__(self, posed: PosedSweep, features: Features, start: Candidate, mapper: Mapper):
        self._mapper, self._config = mapper, mapper.config
        self.fits = [start.fit]
        pose = start.map_T_middle.compose(posed.middle_T_reference)
        self.last = mapper.register(features, pose, posed.twist)

    def follow(self, features: Features, twist: FloatArray) -> bool:
        """Whether the next sweep is solved, too, and the last ones may yet fit.

        ``twist`` (6,) is the body velocity with which the lidar came to that sweep.
        """
        seconds = (features.stamp - self.last.stamp) * 1e-9
        guess = advance(self.last.map_T_lidar, twist, seconds)
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
        if len(last) < SWEEPS or self.last.status is not FrameStatus.OK or not is_alone(self.last):
            return 0.0
        if not self.last.localizability[0] >= self._config.loops.min_aligned:
            return 0.0  # a direction is hardly seen, or it is not known
        agreement = min(fit.agreement for fit in last)
        return next((share for least, share in _CLEARLY if agreement >= least), 0.0)


class Motion:
    """How a lidar moves while it is looked for, by a map of its own of the sweeps since then.

    Where it was tracked before, that map begins with the last of those sweeps. As long as each one
    fits it, the lidar has moved there from where it was, and a place elsewhere that fits the saved
    map only looks the same.

    Attributes
    ----------
    way : metres since the first of the sweeps; infinite after one that did not fit
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        few = trial_matching(config.matching)
        self._mapper = Mapper(config.changed({"map.archive_megabytes": 0.0}, matching=few))
        self._map_T_local: gtsam.Pose3 | None = None  # frame of this map in the saved one, if known
        self._apart = APART  # metres and rad by which that may be wrong
        self._last = gtsam.Pose3()
        self.way = 0.0

    def begin(self, sweeps: Sequence[Features], known: MapUpdate) -> None:
        """Begin with tracked sweeps, and others after these; ``known`` is the last tracked one."""
        metres, rad = three_sigma(known)
        self._apart = APART[0] + metres, APART[1] + rad
        self._map_T_local = gtsam.Pose3()
        for features in sweeps:
            moved = self.register(features)
            if features.stamp == known.stamp and self._map_T_local is not None:
                self._map_T_local = known.map_T_lidar.compose(moved.map_T_lidar.inverse())
        if self._map_T_local is None:
            self._mapper.reset()

    def register(self, features: Features) -> MapUpdate:
        """Where the next sweep was taken in this map, which begins anew where it is not found."""
        moved = self._mapper.register(features)
        if moved.status is FrameStatus.FIRST:
            return moved
        if not moved.status.solved or not self._fits(moved):
            self._mapper.reset()  # it may be anywhere now
            moved, self._map_T_local = self._mapper.register(features), None
            self.way = np.inf
        self.way += self._last.range(moved.map_T_lidar)
        self._last = moved.map_T_lidar
        if self.way * self._config.loops.gate_drift > APART[0]:
            self._map_T_local = None
        return moved

    def _fits(self, moved: MapUpdate) -> bool:
        """Whether a sweep is for sure where it was found; asked only while that matters."""
        seen = self._mapper.registered
        if self._map_T_local is None:
            return True
        if surely_placed(moved) is None or seen is None or seen.matches is None:
            return False
        offered = _offered(moved, self._config)
        fit = standing_fit(seen.matches, offered, seen.map_T_middle)
        return fit.agreement >= self._config.loops.min_agreement

    @property
    def map_T_lidar(self) -> gtsam.Pose3 | None:
        """Where the motion has led in the saved map; None if that is not known."""
        return None if self._map_T_local is None else self._map_T_local.compose(self._last)

    def leads_to(self, pose: gtsam.Pose3) -> bool:
        """Whether the lidar may be at a pose in the saved map."""
        expected = self.map_T_lidar
        return expected is None or same(expected, pose, self._apart)


class Hypotheses:
    """All hypotheses about where a lidar is in a saved map.

    A sweep that is not de-skewed fits badly anywhere, so how the lidar moves must be known.

    Parameters
    ----------
    search : of the map
    maps : of the map
    config : of the mapper
    start : pose about which the first sweep was taken, within ``loops.search`` and at any heading
    """

    def __init__(
        self,
        search: PlaceSearch,
        maps: SavedMaps,
        config: Config,
        start: gtsam.Pose3 | None = None,
    ) -> None:
        self._search, self._maps, self._config = search, maps, config
        self._start = start
        # Where the lidar is said to be, and where it may be if what is said is wrong.
        self._said = [] if start is None else [start, *search.around(start)]
        self._motion = Motion(config)
        self._held: list[Hypothesis] = []

    def begin(self, sweeps: Sequence[Features], known: MapUpdate) -> None:
        """Know the last sweeps before the search; the last one that was tracked is ``known``."""
        self._motion.begin(sweeps, known)

    def add(
        self, features: Features, near: gtsam.Pose3 | None = None
    ) -> tuple[MapUpdate | None, str]:
        """Follow all hypotheses to the next sweep; the fix if one stands, or why none does.

        ``near`` is a pose, if there is one, around which the sweep is looked for as well.
        """
        moved = self._motion.register(features)
        if not moved.status.solved:
            self._held.clear()
            return None, "how the lidar moves is not known before the next sweep"
        twist = moved.twist
        followed = [held for held in self._held if held.follow(features, twist)]
        self._held = distinct(followed, lambda held: held.pose)
        standing = [held for held in self._held if held.rivals_below() > 0.0]
        if self._held and not standing:
            best = max((held.fits[-1] for held in self._held), key=lambda fit: fit.margin)
            return None, f"{len(self._held)} poses are followed; the best: {_told(best)}"
        posed = MovingSweep(features, self._config).at(twist)
        near = self._motion.map_T_lidar or near
        known = [held.pose for held in standing] + ([] if near is None else [near]) + self._said
        found = self._search.find(posed, features.reach, known)
        if not found:
            return None, "no place fits"
        here = [one for one in found if self._may_be_at(one.map_T_middle)]
        message = "what fits is not where the lidar is said to be"
        if here:
            message = f"the best pose: {_told(here[0].fit)}"
        for held in standing:
            rivals = self._search.rivals(held.pose, here, held.rivals_below())
            if rivals:
                fit = "pose fits" if len(rivals) == 1 else "poses fit"
                message = f"{len(rivals)} other {fit} the map nearly as well as the best"
            elif self._said and self._search.fits_better(held.pose, found):
                message = "the map fits better where the lidar is not said to be"
            elif self._motion.leads_to(held.last.map_T_lidar):
                return held.last, ""
            else:
                message = "a pose fits to which the motion does not lead, so it only looks the same"
        self._held = [h for h in self._held if not self._search.refuted(h.pose, found)]
        self._begin(posed, features, here)
        return None, message

    def _may_be_at(self, pose: gtsam.Pose3) -> bool:
        """Whether the lidar may have come to a pose from where it is said to have begun."""
        if self._start is None:
            return True
        return self._start.range(pose) < self._config.loops.search + self._motion.way

    def _begin(self, posed: PosedSweep, features: Features, found: list[Candidate]) -> None:
        """Follow the best of what was found, if they are not followed already."""
        for candidate in found[:_HYPOTHESES]:
            start, hopeful = candidate.map_T_middle, _HOPEFUL * found[0].fit.margin
            known = any(same_optimum(start, held.pose) for held in self._held)
            if candidate.fit.margin >= hopeful and not known and len(self._held) < 2 * _HYPOTHESES:
                mapper = Mapper(self._config)
                mapper.maps = self._maps
                self._held.append(Hypothesis(posed, features, candidate, mapper))


def three_sigma(update: MapUpdate) -> tuple[float, float]:
    """Three standard deviations of a pose, in the worst direction: metres and rad."""
    worst = [np.linalg.eigvalsh(update.covariance[part, part])[-1] for part in (_MOVED, _TURNED)]
    metres, rad = (3.0 * np.sqrt(worst)).tolist()
    return metres, rad


def is_alone(update: MapUpdate) -> bool:
    """Whether no other place is within three standard deviations of a pose, if they are known."""
    if not np.isfinite(update.covariance).all():
        return False
    return all(told < apart for told, apart in zip(three_sigma(update), APART, strict=True))


def _told(fit: Fit) -> str:
    return f"{fit.share:.0%} of the features off the ground matched, {fit.agreement:.0%} agree"


def _offered(update: MapUpdate, config: Config) -> int:
    """Number of features that would be matched if all found a match."""
    most = config.matching.max_edges or np.inf, config.matching.max_planes or np.inf
    return int(min(update.n_edges, most[0]) + min(update.n_planes, most[1]))
