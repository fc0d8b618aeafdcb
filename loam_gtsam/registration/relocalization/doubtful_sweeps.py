"""The search for the pose of a sweep whose solution is doubtful."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.registration.frame_matcher import Frame, FrameMatcher
from loam_gtsam.registration.imu_tracker import ImuTracker
from loam_gtsam.registration.odometry import advance, predict
from loam_gtsam.registration.relocalization.evidence import Evidence, speaks_for
from loam_gtsam.registration.relocalization.fits import (
    AGREE,
    AS_WELL,
    FASTEST,
    Fit,
    FitMonitor,
    beyond_any_motion,
    same,
)
from loam_gtsam.registration.relocalization.places import (
    any_of,
    contradicts,
    fit_of,
    likely_places,
    moved,
    solved_near,
)
from loam_gtsam.registration.report import distance_in_words, make_update
from loam_gtsam.registration.solvers import ScanSolver, Solution
from loam_gtsam.registration.solvers.base import SCAN_VARIANCE
from loam_gtsam.registration.solvers.own_factors import NamedSolver
from loam_gtsam.registration.solvers.sweep_velocity import solved_twist, timed_rows
from loam_gtsam.types import Features, FloatArray, FrameStatus, MapUpdate, SweepMotion

_CLOSER = 3  # largest number of places that are looked at closer
_BASIN = 0.5
"""Share of the reach of a match from within which a solve converges: trials are as far apart."""
_TOLD = 3  # times that a sweep which fits with no expected motion is asked for its motion
_ANY = 1e3  # rad/s and m/s: standard deviation of a motion of which nothing is known
RELOCALISED = "relocalised"  # begins the message of a frame that was found elsewhere in the map
_CONTRARY = "fits better as if no IMU had been there: one of the two is wrong"
CLEARLY = 1.02  # factor by which another motion within a sweep must fit better than the first


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
    parting: FloatArray | None = None  # (6, 6) mean square velocity at which these move apart
    led: FloatArray | None = None  # (6,) velocity that led to the pose, if the sweep keeps another
    in_vain: bool = False  # whether it fits unusually little, and was found nowhere else
    searched: float = 0.0  # radius of that search, metres, if no acceleration leads here
    beside_imu: bool = False  # whether gyro and accelerometer had a say in the solve
    contrary: str = ""  # sentence for the user if the sweep fits better without the IMU

    def saying(self, otherwise: str) -> str:
        """Its sentences for the user, with another one if it was not moved."""
        return "; ".join(filter(None, (self.message or otherwise, self.contrary)))


@dataclass(frozen=True, slots=True, eq=False)
class Lost:
    """The outcome of a search that found nothing, with a sentence for the user."""

    solution: Solution  # unsolved, with the matches at the expected pose
    message: str


def found_at(frame: Frame, solution: Solution) -> Found:
    """The sweep at a solved pose, with the motion that leads there."""
    return Found(solution, frame.posed_for(solution))


def doubtful(
    frame: Frame, solution: Solution, monitor: FitMonitor, last_twist: FloatArray
) -> Doubt | None:
    """Why a solution is doubtful and the sweep has to be searched for; None if it is not.

    ``last_twist`` is the (6,) body velocity of the last sweep; the prediction may be a user's.
    """
    moment = frame.matcher.last
    if not monitor.config.enabled or moment is None:
        return None
    if monitor.lost or not solution.solved:
        return Doubt.MISFIT if monitor.lost else None
    fit = fit_of(frame.matcher, solution)
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
    reach = frame.matcher.config.matching.max_distance
    return _led(solution, frame.predicted.map_T_middle) > _BASIN * reach


def _led(solution: Solution, away: gtsam.Pose3) -> float:
    """Metres, root mean square, between the matched features of a solution and at another pose."""
    points = np.concatenate([solution.matches.edges.points, solution.matches.planes.points])
    return moved(points, away, solution.map_T_lidar)


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
    matcher = FrameMatcher.of(
        alone.posed, m.maps, m.config, m.last, m.clock,
        refine=m.refine, accelerations=m.accelerations,
    )  # fmt: skip
    other = replace(frame, matcher=matcher, predicted=alone)
    solution = other.solve(solver)
    if not solution.solved:
        return frame, found
    fit, before = fit_of(matcher, solution), fit_of(m, found.solution)
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
    before, stamp = frame.matcher.last, frame.sweep.stamp
    if imu is not None and (doubt is not None or imu.contradicted(before, found.solution, stamp)):
        frame, found = second_opinion(frame, found, *apart)
        doubt = doubtful(frame, found.solution, monitor, last.twist)
    if imu is not None and frame is not given:
        imu.reject()
    place = found if doubt is None else search(frame, found.solution, monitor, solver, doubt)
    if isinstance(place, Found) and frame.sweep.motion is not given.sweep.motion:
        place = replace(place, contrary=_CONTRARY)
    return frame, place


def _solved(frame: Frame, solver: ScanSolver) -> Found:
    """The sweep as the scan alone has it; beside the IMU, if the scan leads elsewhere.

    Where much repeats, as on stairs, features of a step that is not mapped yet match the one beside
    it, and lead there. So a scan that contradicts the IMU is solved once more with the prediction
    of the IMU as a factor. That solution counts if it is at another place, fits nearly as well, and
    its matches alone do not contradict the IMU. A classical solver takes no such factor.
    """
    alone, matcher, expected = frame.solve(solver), frame.matcher, frame.predicted.motion
    if matcher.config.solver.method != "gtsam" or not contradicts(expected, alone):
        return found_at(frame, alone)
    prior = SCAN_VARIANCE * expected.information  # as that of the matches beside it
    both = frame.solve(solver, [replace(expected, information=prior).factor()])
    beside = replace(both, information=both.information - prior)  # the IMU is heard later
    pull = prior @ expected.map_T_lidar.localCoordinates(both.map_T_lidar)
    step = np.linalg.lstsq(beside.information, pull, rcond=None)[0]
    optimum = replace(beside, map_T_lidar=both.map_T_lidar.retract(step))
    fits, best = (fit_of(matcher, one).total for one in (both, alone))
    sigmas = np.concatenate([alone.matches.edges.sigmas, alone.matches.planes.sigmas])
    elsewhere = both.solved and _led(alone, both.map_T_lidar) > AGREE * np.median(sigmas)
    if not elsewhere or contradicts(expected, optimum) or fits < AS_WELL * best:
        return found_at(frame, alone)
    return replace(found_at(frame, beside), beside_imu=True)


def _gyro_begins(last: MapUpdate, sweep: MovingSweep) -> bool:
    """Whether a gyro turned the points of a sweep, and not those of the one before.

    If that gyro is wrong it has bent this sweep alone, and the solve confirms the turn.
    """
    return sweep.motion is SweepMotion.GYRO and last.sweep_motion is not SweepMotion.GYRO


def search(
    frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver, doubt: Doubt
) -> Found | Lost:
    """Search for the pose of a sweep whose solution is doubtful.

    A sweep that does not fit is searched for around the expected pose. So is one that may have
    another optimum, or has jumped to where it fits unusually little, but another place is believed
    only if the features speak for it. Else one that has jumped is solved again with the motion from
    before.
    """
    matcher = frame.matcher
    if doubt is Doubt.MISFIT:
        found = _elsewhere(frame, solution, monitor, solver)
        matcher.clock.lap("relocalize")
        return _lost(frame, solution, monitor, solver) if found is None else found
    stays, found = found_at(frame, solution), None
    if doubt is Doubt.OPTIMUM or monitor.unusual(fit_of(matcher, solution)):
        found = _elsewhere(frame, solution, monitor, solver, stays)
        searched = monitor.radius if doubt is Doubt.JUMP else 0.0
        stays = replace(stays, in_vain=True, searched=searched)
    if found is None and doubt is Doubt.JUMP:
        found = _as_before(frame, stays, monitor, solver)
    matcher.clock.lap("relocalize")
    return found or stays


def _as_before(
    frame: Frame, jumped: Found, monitor: FitMonitor, solver: ScanSolver
) -> Found | None:
    """A sweep that jumped, with the motion from before; None if that which led there fits best."""
    matcher, pose = frame.matcher, jumped.solution.map_T_lidar
    twists = [matcher.posed.twist, jumped.posed.twist]
    found = _with_motion(frame, pose, twists, monitor, solver)
    if found is None or matcher.last is None or found.posed.twist is jumped.posed.twist:
        return None
    led = matcher.last.twist_to(frame.sweep.stamp, found.solution.map_T_lidar)
    return replace(found, led=led, in_vain=jumped.in_vain, searched=jumped.searched)


def _lost(frame: Frame, solution: Solution, monitor: FitMonitor, solver: ScanSolver) -> Lost:
    """The sweep, that fits nowhere, with its solution at the expected pose."""
    guess, usual = frame.predicted.map_T_middle, monitor.usual
    before = fit_of(frame.matcher, solution)
    nowhere = Solution.unsolved(guess, solution.matches, solution.iterations, 0)
    further = ""
    if frame.priors:
        alone = replace(frame, lasting=(), since_last=()).solve(solver)
        if alone.solved and monitor.fits_again(fit_of(frame.matcher, alone)):
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

    If it otherwise ``stays`` where it was solved, its features must speak for the new place against
    that one. They may then speak for another of the likely places, which is taken instead.
    """
    places = likely_places(frame, solution, monitor, solver)
    other_twist = np.zeros(6) if stays is None else stays.posed.twist

    def fitting(place: gtsam.Pose3, rival: Found | None) -> Found | None:
        twists = _motions(frame, place, other_twist)
        found = _with_motion(frame, place, twists, monitor, solver, told=True)
        if found is None or rival is None:
            return found
        matcher = frame.matcher.moving_at(found.posed.twist)
        here = Evidence.of(matcher, found.solution, dense=True)
        return found if _speaks_for(here, rival.solution, matcher) else None

    near = (fitting(place, stays) for place in places[: 1 if monitor.lost else _CLOSER])
    first = next(filter(None, near), None)
    if first is None:
        return None
    found, (matcher, others) = first, _others(frame, first, places, solver)
    for other in others:
        if _speaks_for(Evidence.of(matcher, other, dense=True), first.solution, matcher):
            found = fitting(other.map_T_lidar, found) or found
    if found is not first:
        matcher, others = _others(frame, found, places, solver)
    doubt = any_of(found.solution.map_T_lidar, _rivals(matcher, found, others))
    after = f" after {monitor.lost} lost sweeps" if monitor.lost else ""
    return replace(found, message=f"{RELOCALISED}{after}, {found.message}", doubt=doubt)


def _others(
    frame: Frame, found: Found, places: Sequence[gtsam.Pose3], solver: ScanSolver
) -> tuple[FrameMatcher, list[Solution]]:
    """The sweep as solved near other places than the one where it was found, and its matcher."""
    matcher, here = frame.matcher.moving_at(found.posed.twist), found.solution.map_T_lidar
    away = (place for place in places if not same(place, here))
    solved = (solved_near(frame, matcher, place, solver) for place in away)
    return matcher, [one for one in solved if one.solved]


def _rivals(matcher: FrameMatcher, found: Found, others: Sequence[Solution]) -> list[gtsam.Pose3]:
    """Other places to which the features of a sweep that was found do not object."""
    here = Evidence.of(matcher, found.solution, dense=True)
    return [one.map_T_lidar for one in others if not _speaks_for(here, one, matcher)]


def _speaks_for(here: Evidence, other: Solution, matcher: FrameMatcher) -> bool:
    """Whether the features of a matcher speak for a place against another one, beyond chance."""
    there = Evidence.of(matcher, other, dense=True)
    return speaks_for(here, there, matcher.config.solver.min_aligned)


def _motions(frame: Frame, place: gtsam.Pose3, other: FloatArray) -> list[FloatArray]:
    """The (6,) velocities with which a sweep may have been taken at a place, the likeliest first.

    They are that of a drive to the place, if any car is as fast, the predicted one, an ``other``
    one, and the predicted one in axes that were turned on the vehicle. If no acceleration leads to
    the place, the lidar was carried there between two sweeps, and a drive is the least likely.
    """
    matcher, expected = frame.matcher, frame.predicted.map_T_middle
    steady, last = matcher.posed.twist, matcher.last
    turned = _turned(steady, place.rotation().between(expected.rotation()))
    twists = [steady, other, turned]
    if last is not None and last.solved:
        step, seconds = expected.localCoordinates(place), last.seconds_to(frame.sweep.stamp)
        carried = beyond_any_motion(step, seconds, matcher.config.relocalization)
        drive = matcher.twist_to(place)
        if _may_drive(drive):
            twists.insert(len(twists) if carried else 0, drive)
    return twists if frame.sweep.duration > 0.0 else twists[:1]


def _may_drive(twist: FloatArray) -> bool:
    """Whether any car is as fast as a (6,) velocity."""
    return bool(np.linalg.norm(twist[3:]) < FASTEST)


def _with_motion(
    frame: Frame, place: gtsam.Pose3, twists: Sequence[FloatArray],
    monitor: FitMonitor, solver: ScanSolver, *, told: bool = False,
) -> Found | None:  # fmt: skip
    """The sweep near a place, with the first velocity of those by which it clearly fits best.

    One more is tried if the matches are asked as well (``told``), because the velocity after a gap
    may be none of those: that which they tell. If the sweep fits with none of them, its velocity is
    found from itself, as that of a lidar that was shaken while it saw nothing. None if it does not
    fit then either.
    """
    matcher, best = frame.matcher, None
    tried = [_tried(frame, matcher.moving_at(twist), place, solver) for twist in twists]
    if told and matcher.motion_is_free:
        fit, near, _ = _tried(frame, matcher, place, solver)
        if _may_drive(matcher.twist_to(near.map_T_lidar)):
            tried.append((fit, near, frame.posed_for(near)))
    for fit, found, posed in tried:
        if not (found.solved and monitor.fits_again(fit)):
            continue
        if best is None or fit.total > CLEARLY * best[0].total:
            best = fit, found, posed
    if best is None:
        best = _by_told_motion(frame, max(tried, key=lambda one: one[0].total), monitor, solver)
    if best is None:
        return None
    distance = distance_in_words(frame.predicted.map_T_middle, best[1].map_T_lidar)
    return Found(best[1], best[2], f"moved by {distance}")


def _tried(
    frame: Frame, matcher: FrameMatcher, place: gtsam.Pose3, solver: ScanSolver
) -> tuple[Fit, Solution, PosedSweep]:
    """The sweep near a place, as it is de-skewed, and how it fits there."""
    found = solved_near(frame, matcher, place, solver)
    return fit_of(matcher, found), found, matcher.posed


def _by_told_motion(
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
        pose, twist = near.map_T_lidar, posed.twist
        twist = solved_twist(
            rows, near.matches.tilts, seconds, pose, twist, twist, np.full(6, _ANY), noise
        )
        fit, near, posed = _tried(frame, matcher.moving_at(twist), pose, solver)
        if near.solved and monitor.fits_again(fit) and not monitor.unusual(fit):
            return fit, near, posed
    return None


def accept(frame: Frame, found: Found, monitor: FitMonitor) -> None:
    """Tell the monitor of a sweep that goes into the map where it was found."""
    solution = found.solution
    fit = fit_of(frame.matcher, solution)
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


def _turned(twist: FloatArray, a_R_b: gtsam.Rot3) -> FloatArray:
    """A (6,) body velocity in the axes of ``a``, from the axes of ``b``."""
    return (a_R_b.matrix() @ twist.reshape(2, 3).T).T.reshape(6)
