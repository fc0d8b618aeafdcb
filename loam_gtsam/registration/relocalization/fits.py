"""How well sweeps fit the map, and what is usual.

The matches of a wrong pose disagree with the map. How many usually do differs from place to place
(grass, people, a bare hall), so that each sweep is compared with those before it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

import gtsam
import numpy as np

from loam_gtsam.config import RelocalizationConfig
from loam_gtsam.geometry import MAD_TO_SIGMA
from loam_gtsam.registration.matches import ScanMatches, subset
from loam_gtsam.types import BoolArray, FloatArray

AGREE = 3.0  # sigmas within which a match agrees with the pose: 99.7 % of normal noise
_BEYOND = 3.0  # standard deviations of the usual agreement below which one is unusual
_KNOWN = 4  # sweeps from which the usual is known
_EVEN = 1e-3  # standard deviation at least: one of 1000 matches
AS_WELL = 0.75
"""Part of the best place's fit from which another place fits as well, but for chance: of 200
matches, half of which agree, three standard deviations."""
FASTEST = 50.0  # m/s, 180 km/h: largest speed that a place on trial may lead to
_OPTIMA = (0.3, np.radians(3.0))  # metres and rad between two optima of registrations
APART = (1.5, np.radians(12.0))  # metres and rad below which two trials lead to the same pose
_LEVEL = 0.7  # cosine between normal and up above which a plane is level; slopes are
_Item = TypeVar("_Item")


@dataclass(frozen=True, slots=True)
class Fit:
    """A measure of how well a sweep fits the map at a pose, by the matches that may disagree."""

    share: float  # of the features that are matched
    agreement: float  # share of the matches within three of their standard deviations

    @classmethod
    def of(cls, matches: ScanMatches, offered: int, reach: float) -> Fit:
        """The fit of matches, from the number of features that were offered for matching.

        Matches that agree anywhere within ``reach``, metres, do not count: they are no evidence,
        and whether they are looked for at all may change from one sweep to the next.
        """
        told = [~mask for mask in vague(matches, reach)]
        count = sum(int(np.count_nonzero(mask)) for mask in told)
        if not count:
            return cls(0.0, 0.0)
        pairs = zip(agreeing(matches), told, strict=True)
        agree = sum(int(np.count_nonzero(mask & may)) for mask, may in pairs)
        return cls(count / max(offered, 1), agree / count)

    @property
    def total(self) -> float:
        """Share of the features whose matches agree."""
        return self.share * self.agreement

    @property
    def margin(self) -> float:
        """Share of the features whose matches agree, less that of those whose matches do not."""
        return self.share * (2.0 * self.agreement - 1.0)


def beyond_any_motion(step: FloatArray, seconds: float, config: RelocalizationConfig) -> bool:
    """Whether no acceleration explains a step (6,) away from constant velocity, rad and m."""
    reach = 0.5 * seconds**2
    return bool(
        np.linalg.norm(step[:3]) > reach * config.max_turn_acceleration
        or np.linalg.norm(step[3:]) > reach * config.max_acceleration
    )


def agreeing(matches: ScanMatches) -> tuple[BoolArray, BoolArray]:
    """Masks of the line and of the plane matches within three of their standard deviations."""
    edges, planes = matches.edges, matches.planes
    lines: BoolArray = edges.distances < AGREE * edges.sigmas
    surfaces: BoolArray = np.abs(planes.distances) < AGREE * planes.sigmas
    return lines, surfaces


def vague(matches: ScanMatches, reach: float) -> tuple[BoolArray, BoolArray]:
    """Masks of the line and of the plane matches that agree anywhere within so many metres."""
    lines: BoolArray = AGREE * matches.edges.sigmas >= reach
    surfaces: BoolArray = AGREE * matches.planes.sigmas >= reach
    return lines, surfaces


def standing_fit(matches: ScanMatches, offered: int, map_T_lidar: gtsam.Pose3) -> Fit:
    """Fit of edges and of planes that are not level, of so many features.

    All matches count, as in the usual share of a keyframe and in the numbers of a frame.

    Level ground fits at any heading: with much of it, most matches of a wrong pose agree. Up is
    that of the lidar, for a map need not have one.
    """
    up = map_T_lidar.rotation().matrix()[:, 2]
    standing = np.abs(matches.planes.normals @ up) < _LEVEL
    level = int(np.count_nonzero(~standing))
    upright = ScanMatches(matches.edges, subset(matches.planes, standing))
    return Fit.of(upright, offered - level, np.inf)


def same(one: gtsam.Pose3, other: gtsam.Pose3, apart: tuple[float, float] = APART) -> bool:
    """Whether two poses are less than so many metres and rad apart: by default as starts are."""
    turn = float(np.linalg.norm(gtsam.Rot3.Logmap(one.rotation().between(other.rotation()))))
    return bool(one.range(other) < apart[0] and turn < apart[1])


def same_optimum(one: gtsam.Pose3, other: gtsam.Pose3) -> bool:
    """Whether two registrations have ended in the same optimum."""
    return same(one, other, _OPTIMA)


def step_in_map(pose: gtsam.Pose3, other: gtsam.Pose3) -> FloatArray:
    """The (6,) tangent from one pose to another, rad and m, along the axes of the map."""
    step: FloatArray = pose.AdjointMap() @ pose.localCoordinates(other)
    return step


def distinct(items: Iterable[_Item], pose: Callable[[_Item], gtsam.Pose3]) -> list[_Item]:
    """The first of those whose poses are in the same optimum."""
    chosen: list[_Item] = []
    for item in items:
        if not any(same_optimum(pose(item), pose(other)) for other in chosen):
            chosen.append(item)
    return chosen


class FitMonitor:
    """Fits of the last sweeps, against which the next sweep is judged."""

    def __init__(self, config: RelocalizationConfig) -> None:
        self.config = config
        self.lost = 0  # sweeps in a row that did not fit
        self.last: gtsam.Pose3 | None = None  # pose of the last sweep that fitted
        self.led: FloatArray | None = None  # velocity (6,) that led there, if it kept another one
        self._past: deque[Fit] = deque(maxlen=config.memory)

    @property
    def ready(self) -> bool:
        """Whether enough sweeps are accepted; before that, no sweep counts as a misfit."""
        return len(self._past) >= min(self.config.memory, _KNOWN)

    @property
    def usual(self) -> Fit:
        """Medians over the last accepted sweeps."""
        past = np.array([(fit.share, fit.agreement) for fit in self._past])
        share, agreement = np.median(past, axis=0).tolist() if len(past) else (0.0, 0.0)
        return Fit(share, agreement)

    def accept(self, fit: Fit, map_T_lidar: gtsam.Pose3, led: FloatArray | None = None) -> None:
        """Add the fit of a sweep that went into the map."""
        self.lost, self.last, self.led = 0, map_T_lidar, led
        self._past.append(fit)

    def misfit(self, fit: Fit) -> bool:
        """Whether a sweep contradicts the map, or hardly any of its features has a match.

        A moderately low share is no misfit, because the ground may be new.
        """
        usual, config = self.usual, self.config
        return self.ready and (
            fit.agreement < config.min_agreement * usual.agreement
            or fit.total < config.min_share * usual.total
        )

    def unusual(self, fit: Fit) -> bool:
        """Whether fewer matches agree than in the sweeps before, beyond their scatter."""
        if not self.ready:
            return False
        usual, past = self.usual.agreement, np.array([one.agreement for one in self._past])
        scatter = MAD_TO_SIGMA * float(np.median(np.abs(past - usual)))
        return fit.agreement < usual - _BEYOND * max(scatter, _EVEN)

    def fits_again(self, fit: Fit) -> bool:
        """Whether a pose found by a search is accepted, by a stricter test than :meth:`misfit`."""
        usual, config = self.usual, self.config
        return (
            fit.agreement >= config.found_agreement * usual.agreement
            and fit.total >= config.found_share * usual.total
        )

    def might_agree(self, fit: Fit) -> bool:
        """Whether enough features are matched for that, though they may not agree."""
        return fit.share >= self.config.found_share * self.usual.share

    def jumped(self, step: FloatArray, seconds: float) -> bool:
        """Whether a pose is farther from its prediction than any acceleration explains.

        ``step`` is the (6,) tangent from the predicted pose to the solved one, rad and m.
        """
        return self.ready and beyond_any_motion(step, seconds, self.config)

    @property
    def gives_up(self) -> bool:
        """Whether so many sweeps did not fit that the run is to go on in another piece of map."""
        return 0 < self.config.new_piece <= self.lost

    @property
    def radius(self) -> float:
        """Search radius around the prediction, metres; grows with every lost sweep."""
        return self._radius_after(self.lost)

    @property
    def widest(self) -> float:
        """The radius that is searched before the run goes on in another piece of map, metres."""
        return self._radius_after(self.config.new_piece)

    def _radius_after(self, lost: int) -> float:
        config = self.config
        return min(config.radius + config.radius_growth * lost, config.max_radius)

    def around(self, predicted: gtsam.Pose3) -> list[gtsam.Pose3]:
        """Centres of the search: the prediction, and the pose of the last sweep that fitted.

        No trial pose has another height or tilt than its centre has, and turns do not last.
        """
        if self.last is None or same(predicted, self.last):
            return [predicted]
        return [predicted, self.last]
