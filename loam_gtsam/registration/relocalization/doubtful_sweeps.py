"""The search for the pose of a sweep whose solution is doubtful."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import compress

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.geometry import five_sigma, parallel_sum
from loam_gtsam.registration.degeneracy import displacements
from loam_gtsam.registration.frame_matcher import Frame, FrameMatcher
from loam_gtsam.registration.imu_tracker import ImuTracker
from loam_gtsam.registration.odometry import advance, predict, solved_twist, timed_rows
from loam_gtsam.registration.relocalization.evidence import Evidence, speaks_for
from loam_gtsam.registration.relocalization.fits import (
    AS_WELL,
    Fit,
    FitMonitor,
    beyond_any_motion,
    same,
    step_in_map,
)
from loam_gtsam.registration.relocalization.likely_poses import (
    MORE_EDGES,
    Field,
    likely_poses,
    sample_features,
)
from loam_gtsam.registration.report import distance_in_words, make_update
from loam_gtsam.registration.solvers import MotionPrior, ScanSolver, Solution
from loam_gtsam.registration.solvers.base import SCAN_VARIANCE
from loam_gtsam.registration.solvers.own_factors import NamedSolver
from loam_gtsam.types import Features, FloatArray, FrameStatus, MapUpdate, SweepMotion

_CLOSER = 3  # largest number of places that are looked at closer
_BASIN = 0.5
"""Part of the reach of a match, from within which a solve converges: as the spacing of trials."""
_UNLIKELY = five_sigma(6)  # from which on a place contradicts an IMU
_PLACES = 6  # largest number of places that are tried for a sweep that does not fit the map
_TOLD = 3  # times that a sweep which fits with no expected motion tells one by itself
_ANY = 1e3  # rad/s and m/s: standard deviation of a motion of which nothing is known
RELOCALISED = "relocalised"  # begins the message of a frame that was found elsewhere in the map
CLEARLY = 1.02  # by which another motion within a sweep must fit better than the motion before


class Doubt(Enum):
    """Why a solution is doubtful."""

    MISFIT = "the sweep does not fit the map there, or is to be found after others were lost"
    JUMP = "no acceleration leads there"
    OPTIMUM = "another optimum may be the true one"


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The outcome of a search that found the pose of the sweep."""

    solution: Solution  # at the middle of the sweep
    posed: PosedSweep  # the sweep, de-skewed with the motion that belongs to it
    message: str = ""  # sentence for the user if the search moved the sweep
    doubt: FloatArray | None = None  # (6, 6) covariance, map frame, if other places may be right
    parting: FloatArray | None = None  # (6, 6) mean square velocity at which these go elsewhere
    led: FloatArray | None = None  # (6,) velocity that led to the pose, if the sweep keeps another
    beside_imu: bool = False  # whether gyro and accelerometer had a say in the solve


@dataclass(frozen=True, slots=True, eq=False)
class Lost:
    """The outcome of a search that found nothing, with a sentence for the user."""

    solution: Solution  # of no pose, with the matches at the expected one
    message: str


def found_at(frame: Frame, solution: Solution) -> Found:
    """The sweep at a solved pose, with the motion that leads there."""
    return Found(solution, frame.posed_for(solution))


def doubtful(
    frame: Frame, solution: Solution, monitor: FitMonitor, last_twist: FloatArray
) -> Doubt | None:
    """Why the solution of a sweep is doubtful, so that the sweep must be searched for, if it is.

    ``last_twist`` is the (6,) body velocity of the last sweep: the prediction may be a user's.
    """
    moment = frame.matcher.last
    if not monitor.config.enabled or moment is None:
        return None
    if monitor.lost or not solution.solved:
        return Doubt.MISFIT if monitor.lost else None
    fit = Fit.of(solution.matches, frame.matcher.offered)
    if monitor.misfit(fit):
        return Doubt.MISFIT
    seconds = moment.seconds_to(frame.sweep.stamp)
    twists = [last_twist] if monitor.led is None else [last_twist, monitor.led]
    expected = [advance(moment.map_T_lidar, twist, seconds) for twist in twists]
    steps = [pose.localCoordinates(solution.map_T_lidar) for pose in expected]
    if all(monitor.jumped(step, seconds) for step in steps):
        return Doubt.JUMP
    return Doubt.OPTIMUM if _another_optimum(frame, solution, monitor, fit) else None


def _another_optimum(frame: Frame, solution: Solution, monitor: FitMonitor, fit: Fit) -> bool:
    """Whether a solve may have ended in another optimum than the true one.

    Unusually few matches agree, and the solve led so far from the expected pose that features were
    farther from where they belong than half the reach of a match.
    """
    if not monitor.unusual(fit):
        return False
    matches, reach = solution.matches, frame.matcher.config.matching.max_distance
    points = np.concatenate([matches.edges.points, matches.planes.points])
    return _moved(points, frame.predicted.map_T_middle, solution.map_T_lidar) > _BASIN * reach


def second_opinion(
    frame: Frame, found: Found, features: Features, config: Config, last: MapUpdate,
    solver: ScanSolver,
) -> tuple[Frame, Found]:  # fmt: skip
    """The sweep as predicted and de-skewed without the IMU, if it clearly fits the map better so.

    ``features`` are of the sweep, ``config`` is that of the run, and ``last`` is the update of the
    sweep before; ``frame`` and ``found`` are returned if it does not.
    """
    m = frame.matcher
    alone = predict(MovingSweep(features, config), last, m.last, None, config.solver)
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


FirstMotion = Callable[[Frame, Found, NamedSolver, ImuTracker | None], Found]
"""As :meth:`loam_gtsam.registration.start.Start.first_motion`."""


def placed(
    frame: Frame, apart: tuple[Features, Config, MapUpdate, NamedSolver], monitor: FitMonitor,
    imu: ImuTracker | None, first_motion: FirstMotion | None,
) -> tuple[Frame, Found | Lost]:  # fmt: skip
    """Find a sweep: from the expected pose, without the IMU, or by a search.

    Parameters
    ----------
    apart : what :func:`second_opinion` needs: features, configuration, update of the sweep before,
        solver
    first_motion : searches for the motion with which a map begins, while it does
    """
    last, solver = apart[2:]
    found, given = _solved(frame, solver), frame
    if _gyro_begins(last, frame.sweep):
        frame, found = second_opinion(frame, found, *apart)
    if first_motion is not None:
        found = first_motion(frame, found, solver, imu)
    doubt = doubtful(frame, found.solution, monitor, last.twist)
    now = frame.matcher.last, found.solution, frame.sweep.stamp
    if imu is not None and (doubt is not None or imu.contradicted(*now)):
        frame, found = second_opinion(frame, found, *apart)
        doubt = doubtful(frame, found.solution, monitor, last.twist)
    if imu is not None and frame is not given:
        imu.reject()
    if doubt is not None:
        return frame, search(frame, found.solution, monitor, solver, doubt)
    return frame, found


def _solved(frame: Frame, solver: ScanSolver) -> Found:
    """The sweep as the scan alone has it; beside the IMU, if the scan leads elsewhere.

    Where much repeats, as on stairs, features that belong to what is not mapped yet match what is
    next to it, and lead there. The IMU knows better; if it does not, the sweep does not fit where
    it has it, or the scan leads away all the same.
    """
    alone, matcher, expected = frame.solve(solver), frame.matcher, frame.predicted.motion
    if not _contradicts(expected, alone):
        return found_at(frame, alone)
    information = SCAN_VARIANCE * expected.information  # as that of the matches beside it
    beside = frame.solve(solver, [replace(expected, information=information).factor()])
    fits, best = (Fit.of(one.matches, matcher.offered).total for one in (beside, alone))
    if not beside.solved or _contradicts(expected, beside) or fits < AS_WELL * best:
        return found_at(frame, alone)
    told = replace(beside, information=beside.information - information)  # the IMU is heard later
    return replace(found_at(frame, told), beside_imu=True)


def _gyro_begins(last: MapUpdate, sweep: MovingSweep) -> bool:
    """Whether a gyro turned the points of a sweep, and not those of the one before.

    A sweep that a wrong gyro has bent is solved with the turn that bent it, if no sweep before was.
    """
    return sweep.motion is SweepMotion.GYRO and last.sweep_motion is not SweepMotion.GYRO


def search(
    frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver, doubt: Doubt
) -> Found | Lost:
    """Search for the pose of a sweep whose solution is doubtful.

    A sweep that jumped is solved again with the motion from before. One that does not fit is looked
    for around the expected pose; so is one that may have another optimum, which is believed only if
    the features speak for it.
    """
    matcher = frame.matcher
    if doubt is Doubt.MISFIT:
        found = _elsewhere(frame, solution, monitor, solver)
        matcher.clock.lap("relocalize")
        return _lost(frame, solution, monitor, solver) if found is None else found
    stays = found_at(frame, solution)
    if doubt is Doubt.JUMP:
        twists = [matcher.posed.twist, stays.posed.twist]
        found = _with_motion(frame, solution.map_T_lidar, twists, monitor, solver)
        if found is not None and found.posed.twist is stays.posed.twist:
            found = None
        if found is not None and matcher.last is not None:
            led = matcher.last.twist_to(frame.sweep.stamp, found.solution.map_T_lidar)
            found = replace(found, led=led)
    else:
        found = _elsewhere(frame, solution, monitor, solver, stays)
    matcher.clock.lap("relocalize")
    return stays if found is None else found


def _lost(frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver) -> Lost:
    """The sweep, that fits nowhere, with its solution at the expected pose."""
    guess, usual = frame.predicted.map_T_middle, monitor.usual
    before = Fit.of(solution.matches, frame.matcher.offered)
    nowhere = Solution.unsolved(guess, solution.matches, solution.iterations, 0)
    further = ""
    if frame.priors:
        alone = replace(frame, lasting=(), since_last=()).solve(solver)
        if alone.solved and monitor.fits_again(Fit.of(alone.matches, frame.matcher.offered)):
            further = "; without the factors beside the scan, which contradict the map, it fits"
    return Lost(
        nowhere,
        f"{before.share:.0%} of the features match, and {before.agreement:.0%} of these agree "
        f"({usual.share:.0%} and {usual.agreement:.0%} are usual); nothing fits within "
        f"{monitor.radius:g} m{further}; "
        f"lost for {monitor.lost + 1} sweeps",
    )


def _elsewhere(
    frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver,
    stays: Found | None = None,
) -> Found | None:  # fmt: skip
    """The sweep in the first of the likely places in which it fits again; None if in none.

    If it ``stays`` where it was solved otherwise, its features must speak against that.
    """
    places = _places(frame, solution, monitor, solver)
    other = np.zeros(6) if stays is None else stays.posed.twist
    for place in places[: 1 if monitor.lost else _CLOSER]:
        twists = _motions(frame, place, other)
        found = _with_motion(frame, place, twists, monitor, solver, told=True)
        if found is None:
            continue
        matcher = frame.matcher.moving_at(found.posed.twist)
        here = Evidence.of(matcher, found.solution, dense=True)
        if stays is None or _speaks_for(here, stays.solution, matcher):
            rivals = any_of(found.solution.map_T_lidar, _rivals(frame, found, places, solver))
            after = f" after {monitor.lost} lost sweeps" if monitor.lost else ""
            return replace(found, message=f"{RELOCALISED}{after}, {found.message}", doubt=rivals)
    return None


def _speaks_for(here: Evidence, other: Solution, matcher: FrameMatcher) -> bool:
    """Whether the features of a matcher speak for a place against another one, beyond chance."""
    there = Evidence.of(matcher, other, dense=True)
    return speaks_for(here, there, matcher.config.solver.min_aligned)


def _rivals(
    frame: Frame, found: Found, places: Sequence[gtsam.Pose3], solver: ScanSolver
) -> list[gtsam.Pose3]:
    """Other places than the one where the sweep was found, to which its features do not object."""
    rivals, matcher = [], frame.matcher.moving_at(found.posed.twist)
    here = Evidence.of(matcher, found.solution, dense=True)
    for place in places:
        if not same(place, found.solution.map_T_lidar):
            other = _solved_near(frame, matcher, place, solver)
            if other.solved and not _speaks_for(here, other, matcher):
                rivals.append(other.map_T_lidar)
    return rivals


def _motions(frame: Frame, place: gtsam.Pose3, other: FloatArray) -> list[FloatArray]:
    """The (6,) velocities with which a sweep may have been taken at a place, the likeliest first.

    They are that of a drive to the place, the predicted one, an ``other`` one, and the predicted
    one in axes that were turned on the vehicle. If no acceleration leads to the place,
    the lidar was carried there between two sweeps, and a drive is the least likely.
    """
    matcher, expected = frame.matcher, frame.predicted.map_T_middle
    steady, last = matcher.posed.twist, matcher.last
    turned = _turned(steady, place.rotation().between(expected.rotation()))
    twists = [steady, other, turned]
    if last is not None and last.solved:
        step, seconds = expected.localCoordinates(place), last.seconds_to(frame.sweep.stamp)
        carried = beyond_any_motion(step, seconds, matcher.config.relocalization)
        twists.insert(len(twists) if carried else 0, matcher.twist_to(place))
    return twists if frame.sweep.duration > 0.0 else twists[:1]


def _with_motion(
    frame: Frame, place: gtsam.Pose3, twists: Sequence[FloatArray],
    monitor: FitMonitor, solver: ScanSolver, *, told: bool = False,
) -> Found | None:  # fmt: skip
    """The sweep near a place, with the first velocity of those by which it clearly fits best.

    The last one is what its matches tell, if these are to be asked (``told``): after a gap the
    velocity is none of those. If it fits again with none, it tells its velocity by itself, as what
    was blind may have shaken. None if it does not fit then either.
    """
    matcher, best = frame.matcher, None
    tried = [_tried(frame, matcher.moving_at(twist), place, solver) for twist in twists]
    if told and matcher.motion_is_free:
        fit, near, _ = _tried(frame, matcher, place, solver)
        tried.append((fit, near, frame.posed_for(near)))
    for fit, found, posed in tried:
        if not (found.solved and monitor.fits_again(fit)):
            continue
        if best is None or fit.total > CLEARLY * best[0].total:
            best = fit, found, posed
    if best is None:
        best = _by_own_motion(frame, max(tried, key=lambda one: one[0].total), monitor, solver)
    if best is None:
        return None
    moved = distance_in_words(frame.predicted.map_T_middle, best[1].map_T_lidar)
    return Found(best[1], best[2], f"moved by {moved}")


def _tried(
    frame: Frame, matcher: FrameMatcher, place: gtsam.Pose3, solver: ScanSolver
) -> tuple[Fit, Solution, PosedSweep]:
    """The sweep near a place, as it is de-skewed, and how it fits there."""
    found = _solved_near(frame, matcher, place, solver)
    return Fit.of(found.matches, matcher.offered), found, matcher.posed


def _by_own_motion(
    frame: Frame, closest: tuple[Fit, Solution, PosedSweep], monitor: FitMonitor, solver: ScanSolver
) -> tuple[Fit, Solution, PosedSweep] | None:
    """A sweep that hardly fits, de-skewed for the motion that its matches tell; None if in vain.

    As it may tell any, it has to fit as sweeps usually do.
    """
    matcher, config = frame.matcher, frame.matcher.config
    sweep, noise = matcher.posed.sweep, config.features.range_noise
    if sweep.motion is not SweepMotion.CONSTANT_VELOCITY:
        return None
    fit, near, posed = closest
    for _ in range(_TOLD):
        if not (near.solved and monitor.might_agree(fit)):
            return None
        rows, seconds = timed_rows(near.matches, sweep, config.solver)
        motions = posed.twist, posed.twist, np.full(6, _ANY)
        pose = near.map_T_lidar
        twist = solved_twist(rows, near.matches.tilts, seconds, pose, *motions, noise)
        fit, near, posed = _tried(frame, matcher.moving_at(twist), pose, solver)
        if near.solved and monitor.fits_again(fit) and not monitor.unusual(fit):
            return fit, near, posed
    return None


def _solved_near(
    frame: Frame, matcher: FrameMatcher, place: gtsam.Pose3, solver: ScanSolver
) -> Solution:
    """The sweep, solved from a place: along directions that its matches leave open it stays."""
    here = MotionPrior(place, frame.predicted.motion.information)
    return solver.solve(matcher, place, frame.priors, here)


def any_of(pose: gtsam.Pose3, rivals: Sequence[gtsam.Pose3]) -> FloatArray | None:
    """Covariance (6, 6) of a pose, map frame, if one of the rivals may be right; None without any.

    The mean squared error of any of the places, about each.
    """
    if not rivals:
        return None
    steps = np.array([step_in_map(pose, rival) for rival in rivals])
    total: FloatArray = steps.T @ steps / (1 + len(rivals))
    return total


def accept(frame: Frame, found: Found, monitor: FitMonitor) -> None:
    """Tell the monitor of a sweep that goes into the map where it was found."""
    solution = found.solution
    fit = Fit.of(solution.matches, frame.matcher.offered)
    monitor.accept(fit, solution.map_T_lidar, found.led)


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


def _places(
    frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver
) -> list[gtsam.Pose3]:
    """The poses around the prediction at which a few matches fit best, or as well but for chance.

    Where much repeats, a place one bay farther on fits as well. The nearest, which comes first, is
    the likeliest. Once it was tried in vain, the best comes first.
    """
    matcher, expected = frame.matcher, frame.predicted.map_T_middle
    around = monitor.around(expected)
    known = [
        cubes.points(cubes.neighbourhood(pose.matrix()))
        for pose in around
        for cubes in (matcher.maps.edges, matcher.maps.planes)
    ]
    starts = [solution.map_T_lidar] if solution.solved else []
    points = sample_features(*matcher.posed.points, MORE_EDGES)
    as_well = None if monitor.lost else AS_WELL
    held = np.concatenate(known)
    fields = [Field.around(held, pose, monitor.radius) for pose in around]
    starts += likely_poses(points, fields, around, _PLACES, rare=True, as_well=as_well)
    matcher.clock.lap("relocalize")
    trial = replace(matcher, refine=False).with_few_matches()
    tried = [_solved_near(frame, trial, start, solver) for start in starts]
    solved = _as_measured([one for one in tried if one.solved], frame.predicted.motion)
    places = [(Fit.of(one.matches, trial.offered).total, one.map_T_lidar) for one in solved]
    best = max((total for total, _ in places), default=0.0)
    as_good = [place for place in places if place[0] >= AS_WELL * best]
    ranks = [-total if monitor.lost else _moved(points, expected, pose) for total, pose in as_good]
    return [as_good[number][1] for number in np.argsort(ranks, kind="stable")]


def _as_measured(places: list[Solution], expected: MotionPrior) -> list[Solution]:
    """The places that gyro and accelerometer do not contradict; all, if they contradict each."""
    agree = [not _contradicts(expected, place) for place in places]
    return list(compress(places, agree)) or places


def _contradicts(expected: MotionPrior, solution: Solution) -> bool:
    """Whether gyro and accelerometer, if they tell the expected pose, contradict a solved one."""
    if not (expected.measured and solution.solved):
        return False
    step = expected.map_T_lidar.localCoordinates(solution.map_T_lidar)
    by_both = parallel_sum(expected.information, solution.information / SCAN_VARIANCE)
    return bool(step @ by_both @ step >= _UNLIKELY)


def _moved(points: FloatArray, one: gtsam.Pose3, other: gtsam.Pose3) -> float:
    """Root mean square of the distances, metres, between points (N, 3) at one pose and another."""
    form = displacements(points, np.full(len(points), 1.0 / max(len(points), 1)))
    step = one.localCoordinates(other)
    squared = float(step @ form @ step)
    return math.sqrt(max(squared, 0.0))


def _turned(twist: FloatArray, a_R_b: gtsam.Rot3) -> FloatArray:
    """A (6,) body velocity in the axes of ``a``, from the axes of ``b``."""
    return (a_R_b.matrix() @ twist.reshape(2, 3).T).T.reshape(6)
