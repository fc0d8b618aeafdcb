"""Errors of single beams of a lidar: what the residuals of the matches tell of them.

A beam whose ranges are too long finds its points behind the walls that other beams have mapped, in
whatever direction the wall lies. See docs/maths/covariance.md, "Beams that disagree".
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from scipy import sparse

from loam_gtsam.config import Config
from loam_gtsam.config.base import BeamRow
from loam_gtsam.frontend.beams import Rays, errors_at, half_way
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.registration.solvers import Solution
from loam_gtsam.registration.solvers.gtsam_solver import match_rows
from loam_gtsam.registration.solvers.scan_error import ScanError
from loam_gtsam.types import BoolArray, FloatArray

_KINDS = "ranges", "elevations", "azimuths"
_EXPECTED = np.array([0.02, np.radians(0.05), np.radians(0.05)])
"""Metres and rad: standard deviations of the errors before any sweep has told. Data sheets promise
2 to 3 cm, and 0.1 degrees or less."""
_MOVED, _TURNED, _LATER = 0.5, np.radians(10.0), 300_000_000
"""From one sweep that counts to the next: metres or rad, for what is nearer meets the same points,
and nanoseconds, for it takes a millisecond or more."""
_SWEEPS = 10
"""Sweeps that are foretold before a word is said."""
_FREEDOMS = 6.0
"""What the errors must explain of a sweep, in squared standard deviations: as much as noise makes
its pose explain. What explains less moves a pose by less than its own standard deviation."""
_ODD = 5.0
"""Standard deviations of the mean of what they explain, beyond which it is no chance."""
_ALIKE = 2.33
"""Standard deviations by which errors of neighbouring beams may be alike: 1 % of independent ones
are more so. What changes evenly with the elevation, surfaces may make as well."""
_MORE = 1.5
"""Times the rings of a sweep: if more elevations were met, these are not those of beams."""
_TOGETHER = 1e3
"""Over the expected error: a beam's errors beside those of all, of which the map has as much."""


class BeamErrors:
    """By how much the points of each beam are off, as the sweeps of a run tell it.

    What all beams have in common does not show, for the map has it, too: the errors are those
    beside their mean. Each sweep is foretold by the errors that the sweeps before it have told;
    these are believed if they explain more of it than a pose does.

    Of ``config``, ``sensor.beams`` and ``solver`` are used.
    """

    def __init__(self, config: Config) -> None:
        self._removed, self._solver = config.sensor.beams, config.solver
        self._elevations = np.zeros(0)  # (B,) rad, ascending
        self._information, self._pull = np.zeros((0, 0)), np.zeros(0)  # (3 B, 3 B) and (3 B,)
        self._errors = np.zeros(0)  # (3 B,) of each beam in turn
        self._last: tuple[int, gtsam.Pose3] | None = None  # nanoseconds and pose of its middle
        self._count = 0
        self._wander = False  # whether the elevations of rings are not those of beams
        self._sums, self._squares = np.zeros(3), np.zeros(3)  # of what was explained, by kind
        self._left = 0.0  # of squared residuals, in the sweeps that were foretold

    def add(self, sweep: MovingSweep, solution: Solution, scan: ScanError | None) -> None:
        """Take in a sweep whose pose all its matches together have fixed."""
        pose, elevations = solution.map_T_lidar, sweep.ring_elevations
        if self._wander or scan is None or solution.weak is not None:
            return
        if elevations is None or len(elevations) < 2:
            return
        matches = solution.matches
        if len(matches.planes) == 0 or not self._is_new(sweep.stamp, pose):
            return
        self._last = sweep.stamp, pose
        self._meet(elevations)
        if self._wander:
            return
        rows = match_rows(matches, self._solver.kernel_width, self._solver.kernel)
        planes = slice(2 * len(matches.edges), None)
        residuals, by_pose = (part[planes] for part in rows.residuals(pose))
        by_beam = self._by_beam(
            sweep.measured_planes(matches.planes.indices),
            rows.normals[planes] @ pose.rotation().matrix(),
            rows.scales[planes],
        )
        followed = np.linalg.pinv(by_pose.T @ by_pose, hermitian=True) @ by_pose.T
        across = by_beam.T @ by_pose
        information = (by_beam.T @ by_beam).toarray() - across @ (followed @ by_beam)
        pull = by_beam.T @ residuals - across @ (followed @ residuals)
        counts = min(scan.effective_matches / len(rows.scales), 1.0)
        self._foretell(counts * information, counts * pull)
        self._left += counts * float(residuals @ residuals)
        self._information = self._information + counts * information
        self._pull = self._pull + counts * pull
        self._errors = self._solved()

    def _is_new(self, stamp: int, pose: gtsam.Pose3) -> bool:
        """Whether a sweep meets other points than the last one that counted."""
        if self._last is None:
            return True
        step = self._last[1].localCoordinates(pose)
        away = np.linalg.norm(step[3:]) >= _MOVED or np.linalg.norm(step[:3]) >= _TURNED
        return bool(away) and stamp - self._last[0] >= _LATER

    def _meet(self, elevations: FloatArray) -> None:
        """Take in beams at these elevations (R,), rad, that are none of those known."""
        known, apart = self._elevations, half_way(elevations)
        new = elevations
        if len(known):
            new = elevations[np.abs(elevations[:, None] - known).min(axis=1) > apart]
        if not len(new):
            return
        joined = np.concatenate((known, new))
        if len(joined) > _MORE * len(elevations):
            self._wander, self._count = True, 0
            return
        order = np.argsort(joined, kind="stable")
        place = np.argsort(order, kind="stable")[: len(known)]
        rows = (3 * place[:, None] + np.arange(3)).ravel()
        information, pull = np.zeros((3 * len(joined), 3 * len(joined))), np.zeros(3 * len(joined))
        information[np.ix_(rows, rows)], pull[rows] = self._information, self._pull
        self._elevations, self._information, self._pull = joined[order], information, pull
        self._errors = self._solved()

    def _by_beam(
        self, points: FloatArray, normals: FloatArray, scales: FloatArray
    ) -> sparse.csr_array:
        """(M, 3 B) by which rows change with the errors; points as measured, lidar frame.

        A point between two beams is the mean of points of both.
        """
        known = self._elevations
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        upper = np.clip(known.searchsorted(elevation), 1, len(known) - 1)
        share = (elevation - known[upper - 1]) / (known[upper] - known[upper - 1])
        share = np.clip(share, 0.0, 1.0)
        each = np.stack(
            [scales * np.einsum("mi,mi->m", ray, normals) for ray in Rays.of(points)], 1
        )
        values = np.concatenate((each * (1.0 - share)[:, None], each * share[:, None]), axis=1)
        columns = 3 * np.stack((upper - 1, upper), axis=1)[:, :, None] + np.arange(3)
        starts = np.arange(0, 6 * len(points) + 1, 6)
        shape = len(points), 3 * len(known)
        return sparse.csr_array((values.ravel(), columns.ravel(), starts), shape=shape)

    def _solved(self) -> FloatArray:
        """(3 B,) the errors by what all sweeps have told, of each kind with the mean zero."""
        beams = len(self._elevations)
        expected = np.tile(_EXPECTED, beams)
        weights = np.diagonal(self._information).reshape(beams, 3)
        weights = weights / np.maximum(weights.sum(axis=0), 1e-300)
        common = np.zeros((3, 3 * beams))
        for kind in range(3):
            common[kind, kind::3] = weights[:, kind] * _TOGETHER / _EXPECTED[kind]
        whole = self._information + np.diag(expected**-2.0) + common.T @ common
        return np.linalg.solve(whole, self._pull).astype(np.float64, copy=False)

    def _foretell(self, information: FloatArray, pull: FloatArray) -> None:
        """What the errors known so far, of each kind by itself, explain of a further sweep."""
        if not self._errors.any():
            return
        alone = np.zeros((3, len(pull)))
        for kind in range(3):
            alone[kind, kind::3] = self._errors[kind::3]
        explained = 2.0 * alone @ pull - np.einsum("ki,ij,kj->k", alone, information, alone)
        self._count += 1
        self._sums = self._sums + explained
        self._squares = self._squares + explained**2

    @property
    def explained(self) -> FloatArray:
        """(3,) of ranges, elevations and azimuths: share of the squared residuals of sweeps that
        the errors told before them explain; zero before any was foretold.
        """
        return self._sums / self._left if self._count else np.zeros(3)

    @property
    def believed(self) -> tuple[bool, ...]:
        """Whether the errors of ranges, elevations and azimuths are more than chance."""
        if self._count < _SWEEPS:
            return False, False, False
        mean = self._sums / self._count
        variance = np.maximum(self._squares / self._count - mean**2, 1e-300) / self._count
        real = (mean > _FREEDOMS) & (mean > _ODD * np.sqrt(variance))
        return tuple((real & independent(self._errors.reshape(-1, 3))).tolist())

    @property
    def advised(self) -> tuple[BeamRow, ...]:
        """What ``sensor.beams`` should be; what it was, if nothing is believed."""
        if not any(self.believed):
            return self._removed
        errors = self._errors.reshape(-1, 3) * self.believed
        errors = errors + errors_at(self._elevations, self._removed)
        table = np.column_stack((self._elevations, errors))
        table[:, [0, 2, 3]] = np.degrees(table[:, [0, 2, 3]])
        return tuple((row[0], row[1], row[2], row[3]) for row in np.round(table, 5).tolist())

    def as_dict(self) -> dict[str, list[Any] | str | None]:
        """For the summary of a run."""
        return {
            "explained": self.explained.tolist(),
            "advised": [list(row) for row in self.advised],
            "problem": self.problem or None,
        }

    @property
    def problem(self) -> str:
        """What is wrong with the beams, as a sentence; empty if nothing is."""
        believed = self.believed
        if not any(believed):
            return ""
        typical = np.sqrt(np.mean(self._errors.reshape(-1, 3) ** 2, axis=0))
        sizes = f"{1e3 * typical[0]:.0f} mm", *(f"{np.degrees(a):.2f} degrees" for a in typical[1:])
        kinds = zip(_KINDS, sizes, believed, strict=True)
        said = " and ".join(f"{kind} by {size}" for kind, size, on in kinds if on)
        share = float(self.explained @ np.array(believed))
        return (
            f"the beams of the lidar disagree, {said} (root mean square), which explains "
            f"{100.0 * share:.0f} % of what the matches leave; poses are worse than told: map with "
            "sensor.beams, which a run writes to beams.yaml (--config)"
        )


def independent(errors: FloatArray) -> BoolArray:
    """(3,) whether errors (B, 3) of neighbouring beams differ as those of any two do.

    Their mean squared difference over the variance is 2 then, with a standard deviation of 2 over
    the root of B (von Neumann, Annals of Mathematical Statistics 12, 1941).
    """
    differences = np.sum(np.diff(errors, axis=0) ** 2, axis=0)
    least = 2.0 - 2.0 * _ALIKE / np.sqrt(len(errors))
    apart: BoolArray = differences > least * np.sum((errors - errors.mean(axis=0)) ** 2, axis=0)
    return apart
