"""Whether a sweep still fits the map, and if not, where it would.

A solve always gives some pose. That it is the wrong one shows in its matches: planes and lines of
the map that lie near, but not where the sweep has its own. What is usual differs from place to
place (grass, people, a bare hall), so each sweep is held against the ones before it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.ndimage import maximum_filter

from loam_gtsam.config import RelocalizationConfig
from loam_gtsam.registration.association import spread_rows
from loam_gtsam.registration.frame_matcher import Frame
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.odometry import Moment, Prediction, advance
from loam_gtsam.registration.report import distance_in_words
from loam_gtsam.registration.solvers import MotionPrior, ScanSolver, Solution
from loam_gtsam.types import FloatArray, IntArray

_AGREE = 3.0
"""Standard deviations within which a match agrees with the pose: 99.7 % of normal noise."""
_CELL = 0.5
"""Metres; half the distance of a match, so that the neighbouring cells are those in its reach."""
_SPACING = 2
"""Cells from one trial position to the next: 1 m, out of which a solve finds its way."""
_TURN = np.radians(5.0)
"""From one trial heading to the next: half of it moves what is 15 m away by little over a cell."""
_REACH = 40.0
"""Metres; what is farther away is not looked at."""
_HEIGHT = 10.0
"""Metres above and below the lidar likewise."""
_SOME = (60, 140)
"""Edge and plane features that are looked at."""
_START_ROUNDS = 2
"""Times the first two sweeps are registered anew while their motion becomes known."""
_PLACES = 6
"""Places tried at most when a sweep does not fit where it was solved."""
_CLEARLY = 1.02
"""Ratio by which another motion within a sweep must fit better than the one before."""
_APART = (1.5, np.radians(12.0))
"""Metres and rad; nearer trials lead to the same solution."""


@dataclass(frozen=True, slots=True)
class Fit:
    """How well a sweep fits the map at a pose.

    Attributes
    ----------
    share : of the features that were matched
    agreement : share of the matches within three of their standard deviations
    """

    share: float
    agreement: float

    @classmethod
    def of(cls, matches: ScanMatches, offered: int) -> Fit:
        """The fit of the last association of a solve, which had so many features to match."""
        if not len(matches):
            return cls(0.0, 0.0)
        e, p = matches.edges, matches.planes
        agree = np.count_nonzero(e.distances < _AGREE * e.sigmas)
        agree += np.count_nonzero(np.abs(p.distances) < _AGREE * p.sigmas)
        return cls(len(matches) / max(offered, 1), agree / len(matches))

    @property
    def total(self) -> float:
        """Share of the features that were matched and agree."""
        return self.share * self.agreement


class FitMonitor:
    """Fits of the last sweeps, against which the next sweep is judged.

    Attributes
    ----------
    lost : number of sweeps in a row that did not fit
    last : pose of the last sweep that fitted
    """

    def __init__(self, config: RelocalizationConfig) -> None:
        self.config = config
        self.lost = 0
        self.last: gtsam.Pose3 | None = None
        self._past: deque[Fit] = deque(maxlen=config.memory)

    @property
    def ready(self) -> bool:
        """Whether enough is known of what is usual; a run must begin with that many good sweeps."""
        return len(self._past) == self.config.memory

    @property
    def usual(self) -> Fit:
        """Medians over the last sweeps that went into the map."""
        past = np.array([(fit.share, fit.agreement) for fit in self._past])
        share, agreement = np.median(past, axis=0).tolist() if len(past) else (0.0, 0.0)
        return Fit(share, agreement)

    def accept(self, fit: Fit, map_T_lidar: gtsam.Pose3) -> None:
        """A sweep went into the map."""
        self.lost, self.last = 0, map_T_lidar
        self._past.append(fit)

    def misfit(self, fit: Fit) -> bool:
        """Whether a sweep contradicts the map, or hardly anything of it is matched any more.

        A share that sinks by less says nothing: it may be new ground.
        """
        usual, config = self.usual, self.config
        return self.ready and (
            fit.agreement < config.min_agreement * usual.agreement
            or fit.total < config.min_share * usual.total
        )

    def fits_again(self, fit: Fit) -> bool:
        """Whether a pose that was searched for is to be believed: a stricter test."""
        usual, config = self.usual, self.config
        return (
            fit.agreement >= config.found_agreement * usual.agreement
            and fit.total >= config.found_share * usual.total
        )

    def jumped(self, step: FloatArray, seconds: float) -> bool:
        """Whether no acceleration of a vehicle or a hand explains the way from the prediction.

        Parameters
        ----------
        step : (6,) from the predicted pose to the solved one, rad and m
        seconds : since the last sweep
        """
        reach = 0.5 * seconds**2
        config = self.config
        return self.ready and bool(
            np.linalg.norm(step[:3]) > reach * config.max_turn_acceleration
            or np.linalg.norm(step[3:]) > reach * config.max_acceleration
        )

    @property
    def radius(self) -> float:
        """Metres around the prediction in which to search, more with every sweep."""
        config = self.config
        return min(config.radius + config.radius_growth * self.lost, config.max_radius)

    def around(self, predicted: gtsam.Pose3) -> list[gtsam.Pose3]:
        """Where to search: around the prediction, and where the last sweep was that did fit."""
        if self.last is None or predicted.range(self.last) < self.radius:
            return [predicted]
        return [predicted, self.last]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The outcome of a search: where the sweep is.

    Attributes
    ----------
    solution : pose at the middle of the sweep
    twist : (6,) body velocity of the de-skew
    message : a sentence for people if the sweep was moved, else empty
    """

    solution: Solution
    twist: FloatArray
    message: str = ""


@dataclass(frozen=True, slots=True)
class Lost:
    """The outcome of a search that found nothing, and the sentence that says so."""

    message: str


def doubtful(frame: Frame, solution: Solution, monitor: FitMonitor, last_twist: FloatArray) -> bool:
    """Whether a sweep is to be searched for, instead of believing its solve.

    Parameters
    ----------
    last_twist : (6,) body velocity of the last sweep; the prediction may be a user's
    """
    moment = frame.matcher.last
    if not monitor.config.enabled or moment is None:
        return False
    if monitor.lost or not solution.solved:
        return monitor.lost > 0
    seconds = moment.seconds_to(frame.sweep.stamp)
    expected = advance(moment.map_T_lidar, last_twist, seconds)
    if monitor.jumped(expected.localCoordinates(solution.map_T_lidar), seconds):
        return True
    # Matches of a wide search are unlike the usual ones.
    fit = Fit.of(solution.matches, frame.matcher.offered)
    return not solution.matches.wide and monitor.misfit(fit)


def rebuild_start(
    first: Prediction, frame: Frame, found: Found, solver: ScanSolver
) -> tuple[Frame, Found]:
    """Rebuild the map of the first sweep, now that its motion is known from the second.

    Without this a run that starts in motion keeps a distorted first sweep in its map for ever.

    Parameters
    ----------
    first : the first sweep, and where it is
    frame, found : the second sweep, and the outcome of its solve

    Returns
    -------
    Frame and outcome of the second sweep, as seen from the rebuilt map.
    """
    pose, maps = first.map_T_lidar, frame.matcher.maps
    for _ in range(_START_ROUNDS):
        posed = first.posed.sweep.at(found.twist)
        middle = posed.map_T_middle(pose)
        maps.clear()
        maps.recenter(pose)
        maps.insert(posed, middle, 0)
        last = Moment(posed.sweep.stamp, middle, True)
        frame = replace(frame, matcher=replace(frame.matcher.moving_at(found.twist), last=last))
        start = found.solution.map_T_lidar
        again = solver.solve(frame.matcher, start, frame.priors, frame.predicted.motion)
        if not again.solved:
            break
        found = replace(found, solution=again, twist=frame.twist_to(again.map_T_lidar))
    return frame, found


def search(
    frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver
) -> Found | Lost:
    """Search for a sweep that does not fit where it was solved.

    A lidar that was moved between two sweeps did not move like that within them: its velocity is
    that from before, or none, or, if it was turned on its vehicle, that of the vehicle.

    Parameters
    ----------
    solution : of the solve that is in doubt
    monitor : what is usual, and how many sweeps are lost already
    """
    matcher, guess = frame.matcher, frame.matcher.posed.twist
    usual, before = monitor.usual, Fit.of(solution.matches, matcher.offered)
    lost = monitor.lost > 0 or monitor.misfit(before)
    start: gtsam.Pose3 | None = solution.map_T_lidar
    moving = frame.twist_to(solution.map_T_lidar)
    twists = [guess, np.zeros(6) if lost else moving]
    if lost:
        start = _place(frame, solution, monitor, solver)
        if start is not None:
            twists.append(
                _turned(guess, start.rotation().between(frame.predicted.map_T_middle.rotation()))
            )
    best: tuple[Fit, Solution, FloatArray] | None = None
    for twist in twists:
        if start is None:
            break
        here = MotionPrior(start, frame.predicted.motion.information)
        found = solver.solve(matcher.moving_at(twist), start, frame.priors, here)
        fit = Fit.of(found.matches, matcher.offered)
        if not (found.solved and monitor.fits_again(fit)):
            continue
        if best is None or fit.total > _CLEARLY * best[0].total:
            best = fit, found, twist
    matcher.clock.lap("relocalize")
    if best is not None and best[2] is not moving:
        moved = f"moved by {distance_in_words(frame.predicted.map_T_middle, best[1].map_T_lidar)}"
        after = f" after {monitor.lost} lost sweeps" if monitor.lost else ""
        return Found(best[1], best[2], f"relocalised{after}, {moved}" if lost else moved)
    if not lost:
        return Found(solution, moving)
    return Lost(
        f"{before.agreement:.0%} of the matches agree with the map, {usual.agreement:.0%} is "
        f"usual; nothing fits within {monitor.radius:g} m; lost for {monitor.lost + 1} sweeps"
    )


def _place(
    frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver
) -> gtsam.Pose3 | None:
    """Where around the prediction a few matches fit best; None if nowhere."""
    matcher = frame.matcher
    around = monitor.around(frame.predicted.map_T_middle)
    known = [
        cubes.points(cubes.neighbourhood(pose.matrix()))
        for pose in around
        for cubes in (matcher.maps.edges, matcher.maps.planes)
    ]
    starts = [solution.map_T_lidar] if solution.solved else []
    points = sample_features(*matcher.posed.points)
    starts += likely_poses(points, np.concatenate(known), around, monitor.radius, _PLACES)
    matcher.clock.lap("relocalize")
    trial = replace(matcher, refine=False).with_few_matches()
    best: tuple[float, gtsam.Pose3] | None = None
    for start in starts:
        tried = solver.solve(trial, start, frame.priors)
        total = Fit.of(tried.matches, trial.offered).total
        if tried.solved and (best is None or total > best[0]):
            best = total, tried.map_T_lidar
    return None if best is None else best[1]


def _turned(twist: FloatArray, a_R_b: gtsam.Rot3) -> FloatArray:
    """A (6,) body velocity in the axes of ``a``, if it is given in those of ``b``."""
    return (a_R_b.matrix() @ twist.reshape(2, 3).T).T.reshape(6)


def sample_features(edges: FloatArray, planes: FloatArray) -> FloatArray:
    """(N, 3) a few of the features of a sweep, evenly spread; metres."""
    parts = [
        points[spread_rows(len(points), most)]
        for points, most in ((edges, _SOME[0]), (planes, _SOME[1]))
    ]
    return np.concatenate(parts)


def likely_poses(
    points: FloatArray,
    map_points: FloatArray,
    around: Sequence[gtsam.Pose3],
    radius: float,
    count: int,
) -> list[gtsam.Pose3]:
    """Poses from which a sweep may have been taken, the likeliest first.

    Trial poses lie on a grid of 1 m and 5 degrees, all round, at the height and the tilt of the
    poses they are around. Their score is the number of points that fall into cells with map points
    in them, those in a cell beside such a cell counting half (the likelihood field of Thrun,
    Burgard and Fox, Probabilistic Robotics, section 6.4, in its simplest form).

    Parameters
    ----------
    points : (N, 3) of the sweep, metres, lidar frame; a few hundred
    map_points : (M, 3) metres, map frame
    around : ``map_T_lidar`` to search around
    radius : metres around each
    count : of poses to return at most

    Returns
    -------
    Poses more than 1.5 m or 12 degrees apart from each other.
    """
    tried: list[tuple[FloatArray, FloatArray, gtsam.Pose3]] = []
    for pose in around:
        tried.append((*_scores(points, map_points, pose, radius), pose))
    scores = np.concatenate([scored for scored, _, _ in tried])
    moves = np.concatenate([moved for _, moved, _ in tried])
    owner = np.repeat(np.arange(len(tried)), [len(scored) for scored, _, _ in tried])
    best: list[gtsam.Pose3] = []
    origins = np.array([pose.translation() for pose in around])
    at = moves[:, :2] + origins[owner, :2]
    while len(best) < count and len(scores) and scores.max() > 0.0:
        top = int(scores.argmax())
        x, y, turn = moves[top]
        pose = around[owner[top]]
        rotation = gtsam.Rot3.Yaw(turn).compose(pose.rotation())
        best.append(gtsam.Pose3(rotation, pose.translation() + np.array([x, y, 0.0])))
        away = np.abs((moves[:, 2] - turn + np.pi) % (2.0 * np.pi) - np.pi)
        same = (np.linalg.norm(at - at[top], axis=1) < _APART[0]) & (away < _APART[1])
        scores[same] = 0.0
    return best


def _scores(
    points: FloatArray, map_points: FloatArray, map_T_lidar: gtsam.Pose3, radius: float
) -> tuple[FloatArray, FloatArray]:
    """Scores (T,) of trials and (T, 3) how far they are away along x and y, m, and turned, rad."""
    steps = int(radius / (_SPACING * _CELL))
    size = 2 * (int(np.ceil((_REACH + radius) / _CELL)) + 2)
    shape = (size, size, 2 * (int(_HEIGHT / _CELL) + 1))
    centre = np.asarray(map_T_lidar.translation())
    cells = _cells(map_points - centre, shape)
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    held = np.zeros(shape, np.uint8)
    held[tuple(cells[inside].T)] = 1
    field = (held + maximum_filter(held, size=3)).ravel()

    level = points @ map_T_lidar.rotation().matrix().T
    near = (np.linalg.norm(level[:, :2], axis=1) < _REACH) & (np.abs(level[:, 2]) < _HEIGHT)
    level = level[near]
    ahead, aside = np.divmod(np.arange((2 * steps + 1) ** 2), 2 * steps + 1) - np.array([[steps]])
    close = ahead**2 + aside**2 <= (steps + 0.5) ** 2
    ahead, aside = ahead[close], aside[close]
    shifts = _SPACING * (ahead * shape[1] + aside) * shape[2]
    metres = _SPACING * _CELL * np.column_stack([ahead, aside])
    turns = np.arange(0.0, 2.0 * np.pi - 0.5 * _TURN, _TURN)
    scores = np.empty((len(turns), len(shifts)))
    for row, turn in zip(scores, turns.tolist(), strict=True):
        turned = level @ gtsam.Rot3.Yaw(turn).matrix().T
        base = np.ravel_multi_index(tuple(_cells(turned, shape).T), shape)
        row[:] = field[base + shifts[:, None]].sum(axis=1, dtype=np.int64)
    moves = np.column_stack([np.tile(metres, (len(turns), 1)), np.repeat(turns, len(shifts))])
    return scores.ravel(), moves


def _cells(points: FloatArray, shape: tuple[int, int, int]) -> IntArray:
    """Cells of points counted from the middle of the field."""
    cells: IntArray = np.floor(points / _CELL).astype(np.int64) + np.array(shape) // 2
    return cells
