"""The velocity within a sweep, as its matches tell it: docs/maths/deskew.md."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from loam_gtsam.config import SolverConfig
from loam_gtsam.factors import MatchRows
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.geometry import five_sigma, nearest_positive, parallel_sum, squared_norm
from loam_gtsam.registration.degeneracy import displacements
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.solvers.gtsam_solver import match_rows
from loam_gtsam.types import FloatArray

_STEADIEST = 1e-3  # rad/s, m/s and metres, far below what is measured: the least of some errors
_SHORTEST = 1e-3  # least seconds from the middle of a sweep to its ends
_UNEVEN = 0.5
"""Error that the ranges of one side of a sweep have in common, over the noise of a single one. Data
sheets state an accuracy of 2 to 3 cm as the bound of both."""
_RANK = 1e-9  # of the largest eigenvalue, below which a scan has no information on a pose


def timed_rows(
    matches: ScanMatches, sweep: MovingSweep, config: SolverConfig
) -> tuple[MatchRows, FloatArray]:
    """The rows of the matches of a sweep, and seconds (R,) from its middle to their points."""
    rows = match_rows(matches, config.kernel_width, config.kernel)
    return rows, row_seconds(matches, sweep)


def row_seconds(matches: ScanMatches, sweep: MovingSweep) -> FloatArray:
    """Seconds (R,) from the middle of a sweep to the points of its rows, two an edge."""
    edges, planes = sweep.seconds(matches.edges.indices, matches.planes.indices)
    return np.concatenate([np.repeat(edges, 2), planes])


class ToldVelocity(NamedTuple):
    """What the matches of a sweep tell of the velocity in its middle, while the pose follows.

    Attributes
    ----------
    step : (6,) rad/s and m/s, the change of the velocity that they want
    information : (6, 6) of it, as far as it can be believed
    by_jerk : (6, 6) s^2, by which a jerk changes that step; zero if it was not asked for
    """

    step: FloatArray
    information: FloatArray
    by_jerk: FloatArray

    @classmethod
    def of(
        cls, rows: MatchRows, tilts: FloatArray, seconds: FloatArray, map_T_middle: gtsam.Pose3,
        range_noise: float, span: float = np.inf, *, with_jerk: bool = False,
    ) -> ToldVelocity:  # fmt: skip
        """Of the matches of a sweep at a pose.

        A change of the velocity moves a point that was measured s seconds from the middle s times
        as far as the same change of the pose, or s + s^2 / span times where the path is a parabola
        through the last middle. What a change of the pose explains as well is left out, and so is
        the information that the noise of the normals makes. Ranges that are wrong on one side of
        the sensor look like a motion, which limits the rest.

        Parameters
        ----------
        rows : R rows of the matches
        tilts : (R,) standard deviations of their normals, rad
        seconds : (R,) from the middle of the sweep
        map_T_middle : the solved pose
        range_noise : metres, of a single range
        span : seconds since the last middle; infinite if it is not on the path
        with_jerk : whether ``by_jerk`` is asked for, with a finite span
        """
        residuals, by_pose = rows.residuals(map_T_middle)
        moved = seconds + seconds**2 / span
        both = np.hstack([by_pose, by_pose * moved[:, None]])
        information, pull = both.T @ both, -(both.T @ residuals)
        of_pose, across = information[:6, :6], information[6:, :6]
        followed = across @ np.linalg.pinv(of_pose, rcond=_RANK, hermitian=True)
        information = information[6:, 6:] - followed @ across.T
        alone = np.linalg.pinv(information, rcond=_RANK, hermitian=True)
        step = alone @ (pull[6:] - followed @ pull[:6])
        by_jerk = np.zeros((6, 6))
        if with_jerk:
            bent = both.T @ (by_pose * ((seconds + span) * seconds**2 / 6.0)[:, None])
            by_jerk = alone @ (bent[6:] - followed @ bent[:6])
        noise = displacements(rows.points, (rows.scales * tilts * moved) ** 2)
        information = nearest_positive(information - noise)
        wrong = unseen_velocity(moved, range_noise)
        far = float(np.median(np.sqrt(squared_norm(rows.points.T))))
        limit = np.diag(np.repeat([far / wrong, 1.0 / wrong], 3) ** 2)
        return cls(step, parallel_sum(limit, information), by_jerk)

    def left(self, missed: FloatArray, believed: FloatArray) -> FloatArray:
        """(6, 6) covariance of the velocity by the matches and the expected one.

        That misses it by the covariance ``missed`` (6, 6), and was believed by the information
        ``believed`` (6, 6).
        """
        both = np.linalg.inv(believed + self.information)
        kept = both @ believed
        left: FloatArray = kept @ missed @ kept.T + both @ self.information @ both
        return left

    def bent(self, believed: FloatArray) -> FloatArray:
        """(6, 6) s^2, by which a jerk changes that velocity."""
        both, alone = believed + self.information, self.information @ self.by_jerk
        return np.asarray(np.linalg.solve(both, alone), np.float64)


def solved_twist(
    rows: MatchRows, tilts: FloatArray, seconds: FloatArray, map_T_middle: gtsam.Pose3,
    twist: FloatArray, mean: FloatArray, missed: FloatArray, range_noise: float,
    *, span: float = np.inf, heed_contradiction: bool = False,
) -> FloatArray:  # fmt: skip
    """(6,) body velocity in the middle of a sweep, by its matches and by the mean velocity.

    Parameters
    ----------
    rows, tilts, seconds, map_T_middle, range_noise, span : as for :meth:`ToldVelocity.of`
    twist : (6,) rad/s and m/s, with which the sweep was de-skewed
    mean, missed : (6,) rad/s and m/s, the mean velocity since the last sweep and the standard
        deviation of its difference from that in the middle
    heed_contradiction : whether the matches may contradict the mean velocity by five sigma. Then it
        is less certain than ``missed``; else they are taken to be of a pose that has jumped
    """
    step, seen, _ = ToldVelocity.of(rows, tilts, seconds, map_T_middle, range_noise, span)
    believed = expected_information(missed)
    if heed_contradiction:
        away = twist + step - mean
        unlikely = float(away @ parallel_sum(seen, believed) @ away)
        if unlikely > five_sigma(len(away)):
            believed = believed * (len(away) / unlikely)
    change = np.linalg.solve(believed + seen, believed @ (mean - twist) + seen @ step)
    solved: FloatArray = twist + change
    return solved


def expected_information(missed: FloatArray) -> FloatArray:
    """(6, 6) information of a velocity that is expected but for (6,) rad/s and m/s."""
    information: FloatArray = np.diag(np.maximum(missed, _STEADIEST) ** -2.0)
    return information


def unseen_velocity(seconds: FloatArray, range_noise: float) -> float:
    """Velocity within a sweep, m/s, that a range error of one side of the sensor looks like.

    ``seconds`` (R,) of the points are from the middle of the sweep; ``range_noise`` is in metres.
    """
    return max(_UNEVEN * range_noise, _STEADIEST) / max(float(np.abs(seconds).max()), _SHORTEST)
