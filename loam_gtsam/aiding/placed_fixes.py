"""Fixes of a GNSS receiver in a graph: factors, and how far they are from the way.

Equations: docs/gnss.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import gtsam
import numpy as np

from loam_gtsam.factors import checked_factor
from loam_gtsam.geometry import as_vector, cross_matrix
from loam_gtsam.loops.keyframes import noise_model, pose_key
from loam_gtsam.types import FloatArray, IntArray, stack_poses

MAP_KEY: int = gtsam.symbol("g", 0)
"""Key of the pose ``enu_T_map``, which a graph has once fixes tie it."""
ANTENNA_KEY: int = gtsam.symbol("a", 0)
"""Key of the position of the first receiver's antenna in the frame of the lidar, metres."""
LARGEST = 16.27  # of chi squared with three degrees of freedom, 0.1 % of right fixes exceed it
MEDIAN = 2.366  # of chi squared with three degrees of freedom
_LEVEL, _LEANING = 0.02, 0.3  # rad: of the z axis of the map, if the IMU levelled it, and if not
UPWARD = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class PlacedFixes:
    """Fixes that are believed, each seen from a pose of a graph.

    Attributes
    ----------
    poses : (N,) numbers of the poses
    pose_T_lidar : (N, 4, 4) the lidar at the moment of each fix, seen from its pose
    enu : (N, 3) metres east, north and up of an origin on the earth
    covariances : (N, 3, 3) of them, m^2, wide enough for errors that last
    receivers : (N,) number of the receiver of each
    antennas : (R, 3) metres, where the antenna of each receiver was said to be, lidar frame
    antenna_sigmas : (R,) standard deviations of these, metres
    """

    poses: IntArray
    pose_T_lidar: FloatArray
    enu: FloatArray
    covariances: FloatArray
    receivers: IntArray
    antennas: FloatArray
    antenna_sigmas: FloatArray

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def sigmas(self) -> FloatArray:
        """(N,) standard deviations along the worst axis, metres."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.covariances)[:, -1]))

    def factors(self, up: FloatArray | None) -> gtsam.NonlinearFactorGraph:
        """As factors; ``up`` (3,) is upward in the map, or None if no IMU levelled it.

        They are on the poses, :data:`MAP_KEY`, and the antennas, whose keys begin at
        :data:`ANTENNA_KEY`.
        """
        graph = gtsam.NonlinearFactorGraph()
        columns = self.poses.tolist(), self.receivers.tolist(), self.enu, self.covariances
        for pose, receiver, enu, covariance, move in zip(*columns, self.pose_T_lidar, strict=True):
            noise, moved = noise_model(covariance, 3), gtsam.Pose3(move)
            graph.add(fix_factor(pose_key(pose), enu, noise, moved, ANTENNA_KEY + receiver))
        level = gtsam.noiseModel.Isotropic.Sigma(2, _LEANING if up is None else _LEVEL)
        top = gtsam.Unit3(UPWARD if up is None else up)
        graph.add(gtsam.AttitudeFactorPose3(MAP_KEY, gtsam.Unit3(UPWARD), level, top))
        for number, (place, sigma) in enumerate(self._antennas()):
            known = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
            graph.add(gtsam.PriorFactorPoint3(ANTENNA_KEY + number, place, known))
        return graph

    def start(self, enu_T_map: gtsam.Pose3) -> gtsam.Values:
        """Where :data:`MAP_KEY` and the antennas begin."""
        values = gtsam.Values()
        values.insert(MAP_KEY, enu_T_map)
        for number, (place, _) in enumerate(self._antennas()):
            values.insert(ANTENNA_KEY + number, place)
        return values

    def residuals(self, values: gtsam.Values) -> FloatArray:
        """(N, 3) metres from the fixes to where the antennas are."""
        earth = values.atPose3(MAP_KEY)
        antennas = [values.atPoint3(ANTENNA_KEY + n) for n in range(len(self.antennas))]
        columns = self.poses.tolist(), self.receivers.tolist(), self.pose_T_lidar
        places = [
            earth.transformFrom(
                values.atPose3(pose_key(pose)).transformFrom(
                    gtsam.Pose3(move).transformFrom(antennas[receiver])
                )
            )
            for pose, receiver, move in zip(*columns, strict=True)
        ]
        return np.array(places).reshape(-1, 3) - self.enu

    def squared(self, values: gtsam.Values) -> FloatArray:
        """(N,) squared Mahalanobis distances of the fixes from where the antennas are."""
        away = self.residuals(values)
        solved = np.linalg.solve(self.covariances, away[:, :, None])[:, :, 0]
        return np.asarray(np.einsum("ij,ij->i", away, solved))

    def offsets(self, values: gtsam.Values) -> FloatArray:
        """(R, 3) mean error of each receiver, metres, where it is beyond chance; else zeros.

        The antennas count as where they were said to be, for they take over what they can of such
        an error.
        """
        said = gtsam.Values(values)
        for number, (place, _) in enumerate(self._antennas()):
            said.update(ANTENNA_KEY + number, place)
        away, found = self.residuals(said), np.zeros((len(self.antennas), 3))
        for receiver in np.unique(self.receivers).tolist():
            rows = np.flatnonzero(self.receivers == receiver)
            mean, chance = away[rows].mean(axis=0), self.covariances[rows].mean(axis=0) / len(rows)
            chance += self.antenna_sigmas[receiver] ** 2 * np.eye(3)
            if mean @ np.linalg.solve(chance, mean) > LARGEST:
                found[receiver] = mean
        return found

    def allowing_for(self, offsets: FloatArray) -> PlacedFixes:
        """With covariances that allow for offsets (R, 3) of the receivers.

        An error that all N fixes of a receiver share has N times its square in that of each.
        """
        counts = np.bincount(self.receivers, minlength=len(self.antennas))
        shared = (counts * np.sum(offsets**2, axis=1))[self.receivers]
        return replace(self, covariances=self.covariances + shared[:, None, None] * np.eye(3))

    def of(self, rows: IntArray, spread: FloatArray | float = 1.0) -> PlacedFixes:
        """Some of the fixes, their covariances times ``spread``, one for each or all."""
        times = np.broadcast_to(spread, len(rows))[:, None, None]
        return replace(
            self,
            poses=self.poses[rows],
            pose_T_lidar=self.pose_T_lidar[rows],
            enu=self.enu[rows],
            covariances=times * self.covariances[rows],
            receivers=self.receivers[rows],
        )

    def seen_from(self, others: Mapping[int, tuple[int, gtsam.Pose3]]) -> PlacedFixes:
        """The fixes on some poses, as seen from others: the number of each, and its pose there."""
        kept = self.of(np.flatnonzero(np.isin(self.poses, list(others))))
        found = [others[number] for number in kept.poses.tolist()]
        return replace(
            kept,
            poses=np.array([number for number, _ in found], np.int64),
            pose_T_lidar=stack_poses(move.inverse() for _, move in found) @ kept.pose_T_lidar,
        )

    @classmethod
    def joined(cls, parts: Sequence[PlacedFixes]) -> PlacedFixes:
        """The fixes of all parts, whose receivers are numbered as one."""
        columns = {item.name: [getattr(part, item.name) for part in parts] for item in fields(cls)}
        return cls(**{name: np.concatenate(column) for name, column in columns.items()})

    def _antennas(self) -> list[tuple[FloatArray, float]]:
        return list(zip(self.antennas, self.antenna_sigmas.tolist(), strict=True))


def fix_factor(
    pose_key: int,
    enu: FloatArray,
    noise: gtsam.noiseModel.Base,
    keyframe_T_lidar: gtsam.Pose3 | None = None,
    antenna_key: int = ANTENNA_KEY,
) -> gtsam.CustomFactor:
    """A measured position of the antenna: on a pose, :data:`MAP_KEY` and that of the antenna.

    GTSAM's GPSFactorArmCalib has no unknown pose of the map, in whose frame the poses are.

    Parameters
    ----------
    pose_key : of ``map_T_lidar`` of the keyframe
    enu : (3,) metres east, north, up
    noise : of its three rows
    keyframe_T_lidar : the lidar at the moment of the fix, seen from the keyframe
    """
    enu = as_vector(enu, "enu")
    moved = gtsam.Pose3() if keyframe_T_lidar is None else keyframe_T_lidar
    turned, start = moved.rotation().matrix(), moved.translation()

    def residual(values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        pose, earth = values.atPose3(pose_key), values.atPose3(MAP_KEY)
        there, outer = pose.rotation().matrix(), earth.rotation().matrix()
        seen = turned @ values.atPoint3(antenna_key) + start
        place = there @ seen + pose.translation()
        whole = outer @ there
        by_pose = np.hstack([-whole @ cross_matrix(seen), whole])
        by_earth = np.hstack([-outer @ cross_matrix(place), outer])
        error = outer @ place + earth.translation() - enu
        return error, [by_pose, by_earth, whole @ turned]

    return checked_factor(noise, [pose_key, MAP_KEY, antenna_key], residual)
