"""Relocalisation: detection of sweeps that do not fit the map, and the search for their pose.

The matches of a wrong pose disagree with the map. How many usually do differs from place to place
(grass, people, a bare hall), so that each sweep is compared with those before it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from loam_gtsam.config import RelocalizationConfig
from loam_gtsam.registration.frame_matcher import Frame, FrameMatcher
from loam_gtsam.registration.matches import ScanMatches, spread_rows
from loam_gtsam.registration.odometry import Prediction, advance
from loam_gtsam.registration.report import distance_in_words, make_update
from loam_gtsam.registration.solvers import MotionPrior, ScanSolver, Solution
from loam_gtsam.types import BoolArray, FloatArray, FrameStatus, IntArray, MapUpdate

_AGREE = 3.0  # sigmas within which a match agrees with the pose: 99.7 % of normal noise
_CELL = 0.5  # metres: half the reach of a match, which is then the neighbouring cell
_SPACING = 2  # cells between trial positions: 1 m, from which a solve converges
_TURN = np.radians(5.0)  # half of it moves a point at 15 m by little more than a cell
_REACH = 40.0  # largest horizontal distance of a point that is scored, metres
_HEIGHT = 10.0  # largest height above or below the lidar of a point that is scored, metres
_SAMPLE = (60, 140)  # number of edge and plane features that are scored
_CHANCES = 20_000  # trial poses, or so, that tell how rarely a point hits
_RAREST = 200  # number of points, those that hit most rarely, that are scored if rare ones count
_AS_WELL = 0.75
"""Part of the best place's fit from which another place fits as well, but for chance: of 200
matches, half of which agree, three standard deviations."""
_PLACES = 6  # largest number of places that are tried for a sweep that does not fit the map
RELOCALISED = "relocalised"  # begins the message of a frame that was found elsewhere in the map
CLEARLY = 1.02  # by which another motion within a sweep must fit better than the motion before
APART = (1.5, np.radians(12.0))  # metres and rad below which two trials lead to the same pose


@dataclass(frozen=True, slots=True)
class Fit:
    """A measure of how well a sweep fits the map at a pose."""

    share: float  # of the features that are matched
    agreement: float  # share of the matches within three of their standard deviations

    @classmethod
    def of(cls, matches: ScanMatches, offered: int) -> Fit:
        """The fit of matches, from the number of features that were offered for matching."""
        if not len(matches):
            return cls(0.0, 0.0)
        agree = sum(int(np.count_nonzero(mask)) for mask in agreeing(matches))
        return cls(len(matches) / max(offered, 1), agree / len(matches))

    @property
    def total(self) -> float:
        """Share of the features whose matches agree."""
        return self.share * self.agreement


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
    lines: BoolArray = edges.distances < _AGREE * edges.sigmas
    surfaces: BoolArray = np.abs(planes.distances) < _AGREE * planes.sigmas
    return lines, surfaces


def same(one: gtsam.Pose3, other: gtsam.Pose3) -> bool:
    """Whether two poses are no farther apart than the starts of a search."""
    turn = float(np.linalg.norm(gtsam.Rot3.Logmap(one.rotation().between(other.rotation()))))
    return bool(one.range(other) < APART[0] and turn < APART[1])


class FitMonitor:
    """Fits of the last sweeps, against which the next sweep is judged."""

    def __init__(self, config: RelocalizationConfig) -> None:
        self.config = config
        self.lost = 0  # sweeps in a row that did not fit
        self.last: gtsam.Pose3 | None = None  # pose of the last sweep that fitted
        self._past: deque[Fit] = deque(maxlen=config.memory)

    @property
    def ready(self) -> bool:
        """Whether ``memory`` sweeps are accepted; before that, no sweep counts as a misfit."""
        return len(self._past) == self.config.memory

    @property
    def usual(self) -> Fit:
        """Medians over the last accepted sweeps."""
        past = np.array([(fit.share, fit.agreement) for fit in self._past])
        share, agreement = np.median(past, axis=0).tolist() if len(past) else (0.0, 0.0)
        return Fit(share, agreement)

    def accept(self, fit: Fit, map_T_lidar: gtsam.Pose3) -> None:
        """Add the fit of a sweep that went into the map."""
        self.lost, self.last = 0, map_T_lidar
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

    def fits_again(self, fit: Fit) -> bool:
        """Whether a pose found by a search is accepted, by a stricter test than :meth:`misfit`."""
        usual, config = self.usual, self.config
        return (
            fit.agreement >= config.found_agreement * usual.agreement
            and fit.total >= config.found_share * usual.total
        )

    def jumped(self, step: FloatArray, seconds: float) -> bool:
        """Whether a pose is farther from its prediction than any acceleration explains.

        ``step`` is the (6,) tangent from the predicted pose to the solved one, rad and m.
        """
        return self.ready and beyond_any_motion(step, seconds, self.config)

    @property
    def radius(self) -> float:
        """Search radius around the prediction, metres; grows with every lost sweep."""
        config = self.config
        return min(config.radius + config.radius_growth * self.lost, config.max_radius)

    def around(self, predicted: gtsam.Pose3) -> list[gtsam.Pose3]:
        """Centres of the search: the prediction, and the pose of the last sweep that fitted."""
        if self.last is None or predicted.range(self.last) < self.radius:
            return [predicted]
        return [predicted, self.last]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The outcome of a search that found the pose of the sweep."""

    solution: Solution  # at the middle of the sweep
    twist: FloatArray  # (6,) body velocity with which the sweep was de-skewed
    message: str = ""  # sentence for the user if the search moved the sweep
    doubt: FloatArray | None = None  # (6, 6) covariance, map frame, of a start that is not sure


@dataclass(frozen=True, slots=True, eq=False)
class Lost:
    """The outcome of a search that found nothing, with a sentence for the user."""

    solution: Solution  # of no pose, with the matches at the expected one
    message: str


def found_at(frame: Frame, solution: Solution) -> Found:
    """The sweep at a solved pose, with the motion that leads there."""
    return Found(solution, frame.twist_of(solution))


def doubtful(frame: Frame, solution: Solution, monitor: FitMonitor, last_twist: FloatArray) -> bool:
    """Whether the solution of a sweep is doubtful, so that the sweep must be searched for.

    ``last_twist`` is the (6,) body velocity of the last sweep: the prediction may be a user's.
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
    return monitor.misfit(Fit.of(solution.matches, frame.matcher.offered))


def second_opinion(
    frame: Frame, found: Found, alone: Prediction, solver: ScanSolver
) -> tuple[Frame, Found]:
    """The sweep as predicted and de-skewed without the IMU, if it clearly fits the map better so.

    ``alone`` is that prediction; ``frame`` and ``found`` are returned if it does not.
    """
    m = frame.matcher
    parts = alone.posed, m.maps, m.config, m.last, m.clock
    matcher = FrameMatcher.of(*parts, refine=m.refine, accelerations=m.accelerations)
    other = replace(frame, matcher=matcher, predicted=alone)
    solution = other.solve(solver)
    if not solution.solved:
        return frame, found
    fit, before = (
        Fit.of(solution.matches, matcher.offered),
        Fit.of(found.solution.matches, m.offered),
    )
    better = not found.solution.solved or fit.total > CLEARLY * before.total
    return (other, found_at(other, solution)) if better else (frame, found)


def search(
    frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver
) -> Found | Lost:
    """Search for the pose of a sweep whose solution is doubtful.

    The motion of a lidar that was carried away between two sweeps says nothing about the motion
    within the sweeps. These velocities are tried: the predicted one, rest, the predicted one in
    axes that were turned on the vehicle, and that of a drive from the last pose to the one found.
    """
    matcher, steady = frame.matcher, frame.matcher.posed.twist
    usual, before = monitor.usual, Fit.of(solution.matches, matcher.offered)
    lost = monitor.lost > 0 or monitor.misfit(before)
    start: gtsam.Pose3 | None = solution.map_T_lidar
    rivals: list[gtsam.Pose3] = []
    moving = frame.twist_of(solution)
    twists = [steady, np.zeros(6) if lost else moving]
    if lost:
        place = _place(frame, solution, monitor, solver)
        start, rivals = (None, []) if place is None else place
        if start is not None:
            twists.append(
                _turned(steady, start.rotation().between(frame.predicted.map_T_middle.rotation()))
            )
            if matcher.last is not None and matcher.last.solved:
                twists.append(matcher.twist_to(start))  # it was not carried away, but drove there
    best: tuple[Fit, Solution, FloatArray] | None = None
    for twist in twists:
        if start is None:
            break
        here = MotionPrior(start, frame.predicted.motion.information)
        found = solver.solve(matcher.moving_at(twist), start, frame.priors, here)
        fit = Fit.of(found.matches, matcher.offered)
        if not (found.solved and monitor.fits_again(fit)):
            continue
        if best is None or fit.total > CLEARLY * best[0].total:
            best = fit, found, twist
    matcher.clock.lap("relocalize")
    if best is not None and best[2] is not moving:
        moved = f"moved by {distance_in_words(frame.predicted.map_T_middle, best[1].map_T_lidar)}"
        after = f" after {monitor.lost} lost sweeps" if monitor.lost else ""
        text = f"{RELOCALISED}{after}, {moved}" if lost else moved
        return Found(best[1], best[2], text, any_of(best[1].map_T_lidar, rivals))
    if not lost:
        return Found(solution, moving)
    guess = frame.predicted.map_T_middle
    nowhere = Solution.unsolved(guess, solution.matches, solution.iterations, 0)
    return Lost(
        nowhere,
        f"{before.agreement:.0%} of the matches agree with the map, {usual.agreement:.0%} is "
        f"usual; nothing fits within {monitor.radius:g} m; lost for {monitor.lost + 1} sweeps",
    )


def any_of(pose: gtsam.Pose3, rivals: Sequence[gtsam.Pose3]) -> FloatArray | None:
    """Covariance (6, 6) of a pose, map frame, if one of the rivals may be right; None without any.

    The mean squared error of any of the places, about each.
    """
    if not rivals:
        return None
    steps = np.array([pose.AdjointMap() @ pose.localCoordinates(rival) for rival in rivals])
    total: FloatArray = steps.T @ steps / (1 + len(rivals))
    return total


def unplaced(frame: Frame, outcome: Found | Lost, monitor: FitMonitor) -> MapUpdate:
    """The update of a sweep that is lost, or that matches too little; the monitor counts it."""
    least, solution = frame.matcher.config.solver.min_matches, outcome.solution
    if isinstance(outcome, Lost):
        monitor.lost += 1
        status, message = FrameStatus.LOST, outcome.message
    else:
        # Once may be chance; a sweep that has plenty to match is searched for the next time.
        monitor.lost += monitor.config.enabled and frame.matcher.offered >= 2 * least
        status = FrameStatus.FEW_MATCHES
        message = f"{len(solution.matches)} matches; {least} are needed"
    predicted = frame.predicted
    return make_update(predicted.posed, predicted.map_T_lidar, status, message, solution)


def _place(
    frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver
) -> tuple[gtsam.Pose3, list[gtsam.Pose3]] | None:
    """The pose around the prediction at which a few matches fit best, and others that fit as well.

    None if there is none.
    """
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
    places: list[tuple[float, gtsam.Pose3]] = []
    for start in starts:
        # Few matches leave directions open: along these a place stays where it is.
        here = MotionPrior(start, frame.predicted.motion.information)
        tried = solver.solve(trial, start, frame.priors, here)
        if tried.solved:
            places.append((Fit.of(tried.matches, trial.offered).total, tried.map_T_lidar))
    best = max((total for total, _ in places), default=0.0)
    expected = frame.predicted.map_T_middle
    near = [place for place in places if place[0] >= _AS_WELL * best]
    # Where much repeats, a place one bay farther on fits as well. The nearest is the likeliest, but
    # not if it was tried in vain.
    near.sort(key=lambda place: place[0] if monitor.lost else -expected.range(place[1]))
    near.reverse()
    if not near:
        return None
    chosen, *others = (pose for _, pose in near)
    return chosen, [pose for pose in others if not same(chosen, pose)]


def _turned(twist: FloatArray, a_R_b: gtsam.Rot3) -> FloatArray:
    """A (6,) body velocity in the axes of ``a``, from the axes of ``b``."""
    return (a_R_b.matrix() @ twist.reshape(2, 3).T).T.reshape(6)


def sample_features(
    edges: FloatArray, planes: FloatArray, most: tuple[int, int] = _SAMPLE
) -> FloatArray:
    """(N, 3) some evenly spread features of a sweep, at ``most`` so many of each kind, metres."""
    pairs = zip((edges, planes), most, strict=True)
    return np.concatenate([points[spread_rows(len(points), count)] for points, count in pairs])


def likely_poses(
    points: FloatArray,
    map_points: FloatArray,
    around: Sequence[gtsam.Pose3],
    radius: float,
    count: int,
    most_turn: float = np.pi,
    *,
    rare: bool = False,
) -> list[gtsam.Pose3]:
    """Poses from which a sweep may have been taken, the likeliest first.

    Trial poses lie on a grid of 1 m and 5 degrees around each centre, with the height and the tilt
    of the centre. The score of a trial pose is the number of points in cells that hold map points;
    a point in a cell beside such a cell counts half (the likelihood field of Thrun, Burgard and
    Fox, Probabilistic Robotics, section 6.4, in its simplest form).

    Parameters
    ----------
    points, map_points : (N, 3), a few hundred of the sweep in the lidar frame, and (M, 3), metres
    around, radius : centres of the search, ``map_T_lidar``, and metres around each
    count : largest number of poses, which are more than 1.5 m or 12 degrees apart
    most_turn : largest rotation against the centre about the vertical axis, rad
    rare : whether a point counts minus the logarithm of the share of the trial poses at which it
        hits: ground, which fits everywhere, tells nothing, and a post, which fits at few places,
        tells much. For two sweeps that follow each other: what is new or gone is rare as well.
    """
    tried = [_trials(points, map_points, pose, radius, most_turn) for pose in around]
    scored, weights = np.arange(len(points)), np.ones(len(points), np.float32)
    if rare:
        chance = np.mean([trials.chance() for trials in tried], axis=0)
        hit = np.flatnonzero(chance)
        scored = hit[np.argsort(chance[hit], kind="stable")[:_RAREST]]
        weights = -np.log(chance[scored]).astype(np.float32)
    scores = np.concatenate([trials.scores(scored, weights) for trials in tried])
    moves = np.concatenate([trials.moves for trials in tried])
    owner = np.repeat(np.arange(len(tried)), [len(trials.moves) for trials in tried])
    best: list[gtsam.Pose3] = []
    at = moves[:, :2] + np.array([pose.translation() for pose in around])[owner, :2]
    while len(best) < count and len(scores) and scores.max() > 0.0:
        top = int(scores.argmax())
        x, y, turn = moves[top]
        pose = around[owner[top]]
        rotation = gtsam.Rot3.Yaw(turn).compose(pose.rotation())
        best.append(gtsam.Pose3(rotation, pose.translation() + np.array([x, y, 0.0])))
        away = np.abs((moves[:, 2] - turn + np.pi) % (2.0 * np.pi) - np.pi)
        taken = (np.linalg.norm(at - at[top], axis=1) < APART[0]) & (away < APART[1])
        scores[taken] = 0.0
    return best


class _Trials(NamedTuple):
    """Trial poses around a centre, and the field of cells that hold map points."""

    field: NDArray[np.uint8]  # 2 in a cell that holds some, 1 beside it, 0 elsewhere
    near: BoolArray  # (N,) whether a point is near enough to be scored
    bases: IntArray  # (R, N) cells of the points, for each yaw
    shifts: IntArray  # (S,) by which these move with the trial positions
    moves: FloatArray  # (R S, 3) offsets of the trial poses: x and y in metres, yaw in rad

    def chance(self) -> FloatArray:
        """Share of what each point (N,) would score if it hit at every trial pose."""
        some = self.shifts[:: max(1, len(self.moves) // _CHANCES), None]
        hits = [self.field[base + some].mean(axis=0) for base in self.bases]
        share: FloatArray = 0.5 * np.mean(hits, axis=0) * self.near
        return share

    def scores(self, points: IntArray, weights: NDArray[np.float32]) -> FloatArray:
        """Score of each trial pose by some of the points."""
        near = self.near[points]
        points, weights = points[near], weights[near]
        scores = np.empty((len(self.bases), len(self.shifts)))
        for row, base in zip(scores, self.bases[:, points], strict=True):
            row[:] = self.field[base + self.shifts[:, None]] @ weights
        return scores.ravel()


def _trials(
    points: FloatArray,
    map_points: FloatArray,
    map_T_lidar: gtsam.Pose3,
    radius: float,
    most_turn: float,
) -> _Trials:
    """The trial poses around a centre."""
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
    ahead, aside = np.divmod(np.arange((2 * steps + 1) ** 2), 2 * steps + 1) - np.array([[steps]])
    close = ahead**2 + aside**2 <= (steps + 0.5) ** 2
    ahead, aside = ahead[close], aside[close]
    shifts = _SPACING * (ahead * shape[1] + aside) * shape[2]
    metres = _SPACING * _CELL * np.column_stack([ahead, aside])
    most = int(np.ceil(min(most_turn, np.pi) / _TURN))
    turns = _TURN * np.arange(-most, most + (most_turn < np.pi))
    yaws = [gtsam.Rot3.Yaw(turn).matrix() for turn in turns.tolist()]
    turned = np.where(near[:, None], level, 0.0) @ np.transpose(yaws, (0, 2, 1))
    bases = np.ravel_multi_index(tuple(np.moveaxis(_cells(turned, shape), -1, 0)), shape)
    moves = np.column_stack([np.tile(metres, (len(turns), 1)), np.repeat(turns, len(shifts))])
    return _Trials(field, near, bases, shifts, moves)


def _cells(points: FloatArray, shape: tuple[int, int, int]) -> IntArray:
    """Cells of points, counted from the middle of the field."""
    cells: IntArray = np.floor(points / _CELL).astype(np.int64) + np.array(shape) // 2
    return cells
