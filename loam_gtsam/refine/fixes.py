"""Fixes of a GNSS receiver in the adjustment: what they tell of the poses, and where the map is.

Where the map is on the earth, and the antennas, are eliminated (variable projection: Golub and
Pereyra, SIAM Journal on Numerical Analysis, 1973): at any poses they are where they fit the fixes
best. So the poses are those of a map whose first one is held, with fixes or without.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from loam_gtsam.aiding.gnss import ANTENNA_KEY, MAP_KEY, MEDIAN, PlacedFixes
from loam_gtsam.datasets.decode.geodesy import GeoReference
from loam_gtsam.loops.keyframes import pose_key
from loam_gtsam.types import FloatArray, InputError, IntArray

_MOST = 200
"""Fixes that are used at most, evenly spread: their equations are dense."""
_STEPS, _ENOUGH = 10, 1e-10
"""Gauss-Newton steps to where the fixes fit best, and rad and m that end them."""
_LEAST = 1e-12
"""Eigenvalue of the information of map and antennas, its diagonal 1, below which one is unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Fixes of a map, or of merged ones, and where these had it on the earth.

    Attributes
    ----------
    fixes : by numbers of places, seen from the middles of their sweeps, as in a saved map
    stamps : of the places
    reference : where the map was
    up : (3,) upward in the map; None if no IMU levelled it

    Raises
    ------
    InputError
        If a fix is on a place that has no stamp.
    """

    fixes: PlacedFixes
    stamps: IntArray
    reference: GeoReference
    up: FloatArray | None = None

    def __post_init__(self) -> None:
        numbers, count = self.fixes.poses, len(self.stamps)
        if ((numbers < 0) | (numbers >= count)).any():
            raise InputError(f"Survey: expected fixes on the {count} places, got others")


@dataclass(frozen=True, eq=False)
class FixTies:
    """What fixes tell of the poses of the sweeps, which are then tied to each other.

    Attributes
    ----------
    fixes : by numbers of sweeps, seen from their middles
    reference : where the map is, about
    up : (3,) upward in the map; None if unknown
    """

    fixes: PlacedFixes
    reference: GeoReference
    up: FloatArray | None = None

    @staticmethod
    def of(fixes: PlacedFixes, reference: GeoReference, up: FloatArray | None) -> FixTies:
        """Of fixes, or of some of many."""
        rows = np.linspace(0, len(fixes), min(_MOST, len(fixes)), endpoint=False)
        return FixTies(fixes.of(rows.astype(np.int64)), reference, up)

    @cached_property
    def numbers(self) -> IntArray:
        """(K,) of the sweeps, ascending."""
        return np.unique(self.fixes.poses)

    @cached_property
    def _graph(self) -> gtsam.NonlinearFactorGraph:
        return self.fixes.factors(self.up)

    @cached_property
    def _order(self) -> gtsam.Ordering:
        """The poses, the map, the antennas."""
        order = gtsam.Ordering()
        antennas = [ANTENNA_KEY + number for number in range(len(self.fixes.antennas))]
        for key in (*map(pose_key, self.numbers.tolist()), MAP_KEY, *antennas):
            order.push_back(key)
        return order

    def _fitted(self, poses: FloatArray) -> tuple[gtsam.Values, FloatArray, FloatArray]:
        """Map and antennas where they fit best; information and pull of all, in their order.

        An InputError if the fixes leave open where that is.
        """
        values = self.fixes.start(gtsam.Pose3(self.reference.enu_T_map))
        for number in self.numbers.tolist():
            values.insert(pose_key(number), gtsam.Pose3(poses[number]))
        own = 6 * len(self.numbers)
        for _ in range(_STEPS):
            information, pull = self._graph.linearize(values).hessian(self._order)
            if not _all_told(information[own:, own:]):
                raise InputError(
                    f"refine: {len(self.fixes)} fixes do not tell where the map is; leave them out"
                )
            step = np.linalg.solve(information[own:, own:], pull[own:])
            if np.abs(step).max() < _ENOUGH:
                break
            values.update(MAP_KEY, values.atPose3(MAP_KEY).retract(step[:6]))
            for number, moved in enumerate(step[6:].reshape(-1, 3)):
                key = ANTENNA_KEY + number
                values.update(key, values.atPoint3(key) + moved)
        return values, information, pull

    def cost(self, poses: FloatArray) -> float:
        """Half the squared, whitened residuals at poses (N, 4, 4) of all sweeps."""
        return float(self._graph.error(self._fitted(poses)[0]))

    def equations(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information (6 K, 6 K) and gradient (6 K,) at poses (N, 4, 4) of all sweeps."""
        _, information, pull = self._fitted(poses)
        own = 6 * len(self.numbers)
        across = information[:own, own:]
        by_pose = np.linalg.solve(information[own:, own:], across.T)
        return information[:own, :own] - across @ by_pose, -(pull[:own] - by_pose.T @ pull[own:])

    def referenced(
        self, poses: FloatArray, solve: Callable[[FloatArray], FloatArray]
    ) -> GeoReference:
        """Where the map is; ``solve`` (6 N, M) by the information of all poses (N, 4, 4).

        If the fixes are farther off than their covariances say, its covariance is larger for it.
        """
        values, information, _ = self._fitted(poses)
        own = 6 * len(self.numbers)
        known = np.linalg.inv(information[own:, own:])
        by_pose = (known @ information[own:, :own])[:6]
        rows = (6 * self.numbers[:, None] + np.arange(6)).ravel()
        units = np.zeros((6 * len(poses), 6))
        units[rows] = by_pose.T
        covariance = known[:6, :6] + by_pose @ solve(units)[rows]
        spread = max(1.0, float(np.median(self.fixes.squared(values))) / MEDIAN)
        earth = values.atPose3(MAP_KEY).matrix()
        return GeoReference(self.reference.origin, earth, spread * covariance)


def _all_told(information: FloatArray) -> bool:
    """Whether an information leaves no direction free."""
    scale = np.sqrt(np.diagonal(information))
    if not (np.isfinite(information).all() and (scale > 0.0).all()):
        return False
    return bool(np.linalg.eigvalsh(information / np.outer(scale, scale))[0] > _LEAST)
