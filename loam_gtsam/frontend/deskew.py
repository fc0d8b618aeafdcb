"""De-skewing: the features of a sweep as seen from its middle, where an error of the motion cancels
to first order; at the start or the end the same error would shift the whole sweep.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.config import Config
from loam_gtsam.frontend.features import thinned
from loam_gtsam.geometry import cross, cross_matrix, interpolated, move_points
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.types import BoolArray, Features, FloatArray, IntArray, SweepMotion

_DISTINCT = 4.5
"""Prominence of a distinct edge in its ring, in standard deviations of range noise."""


class MovingSweep:
    """The voxel-filtered features of a sweep as measured, each from its own position of the lidar.

    The rotation within the sweep comes from the gyro (or the orientation) of an IMU if the IMU
    covers the sweep. The translation, and without an IMU the rotation too, comes from a velocity,
    for which :meth:`at` de-skews the features; it is constant, unless :meth:`accelerated`.

    Parameters
    ----------
    features : features of the sweep
    config : ``deskew``, ``features.range_noise``, ``imu.max_gap`` and the voxel sizes of ``map``
        are used
    imu : source of the rotation; None for constant velocity
    thin : whether to voxel-filter the points, as for matching

    Attributes
    ----------
    reference_stamp : nanoseconds, for which the pose of the frame is reported
    stamp : nanoseconds of the middle of the sweep
    middle : seconds from the reference time to the middle; 0 without de-skewing
    duration : seconds of the sweep; 0 without de-skewing
    n_edges, n_planes : numbers of features
    distinct : (E,) whether an edge stands out of its ring by more than range noise
    alone : (E,) whether it is a pole, which stands before all that is beside it; None if unknown
    edge_sigmas : (E,) metres, standard deviation of its place along its ring; None if unknown
    level_rings : whether beams sweep rings about the lidar's z axis
    ring_elevations : (R,) rad, of these rings; None if unknown
    motion : source of the rotation within the sweep
    acceleration : (6,) rad/s^2 and m/s^2, of the body velocity; None if that is constant
    not_finite : number of points of the sweep that were NaN or infinite
    """

    def __init__(
        self, features: Features, config: Config, imu: ImuBuffer | None = None, *, thin: bool = True
    ) -> None:
        first, end = features.span
        moving = config.deskew.enabled and end > first
        self.middle = 0.5 * (first + end) if moving else 0.0
        self.duration = end - first if moving else 0.0
        self.reference_stamp = features.stamp
        self.not_finite = features.not_finite
        self.stamp = features.stamp + round(self.middle * 1e9)
        if thin:
            features = thinned(features, config.map)
        prominence, least = features.edge_prominence, _DISTINCT * config.features.range_noise
        self.distinct: BoolArray = (
            np.ones(len(features.edges), np.bool_) if prominence is None else prominence > least
        )
        depth = config.features.post_depth or np.inf
        self.alone: BoolArray | None = None if prominence is None else prominence > depth
        self.edge_sigmas, self.level_rings = features.edge_sigmas, features.level_rings
        self.ring_elevations = features.ring_elevations
        self._points = features.edges, features.planes
        times = features.edge_times, features.plane_times
        self._seconds = times[0] - self.middle, times[1] - self.middle
        self.n_edges, self.n_planes = map(len, self._points)
        self.motion = SweepMotion.CONSTANT_VELOCITY if moving else SweepMotion.NONE
        self._turned: tuple[FloatArray, FloatArray] | None = None
        self._bend: tuple[FloatArray, FloatArray] | None = None
        self.acceleration: FloatArray | None = None
        self._span = np.array([first, 0.0, end]) - self.middle
        if moving and imu is not None and config.deskew.rotation != "constant_velocity":
            if config.deskew.rotation == "orientation":
                turns = _turns_by_orientation(imu, self.stamp, self._moments, config.imu.max_gap)
                motion = SweepMotion.ORIENTATION
            else:
                turns = imu.rotations_since(self.stamp, self._moments)
                motion = SweepMotion.GYRO
            if turns is not None:
                self.motion = motion
                self._turn(turns)

    @property
    def _moments(self) -> FloatArray:
        """Seconds from the middle to the start, the reference, the end, and all points."""
        return np.concatenate([self._span, *self._seconds])

    def _turn(self, turns: FloatArray) -> None:
        """Turn the points by the rotation vectors (3 + N, 3) of these moments."""
        before, reference, after = turns[:3]
        self._rate = (after - before) / (self._span[2] - self._span[0])
        self._middle_R_reference: FloatArray = Rotation.from_rotvec(reference).as_matrix()
        split = 3 + self.n_edges
        edges, planes = self._points
        self._turned = _rotated(edges, turns[3:split]), _rotated(planes, turns[split:])

    def turned_anew(self, imu: ImuBuffer) -> MovingSweep:
        """The sweep with its rotation as the gyro knows it by now, with the bias of today."""
        if self.motion is not SweepMotion.GYRO:
            return self
        turns = imu.rotations_since(self.stamp, self._moments)
        if turns is None:
            return self
        sweep = copy(self)
        sweep._turn(turns)
        return sweep if self._bend is None else sweep.bent(*self._bend)

    def bent(self, seconds: FloatArray, path: FloatArray) -> MovingSweep:
        """The sweep of a lidar whose path bends.

        ``path`` (K, 3) is the way from the straight line through the middle of the sweep, metres in
        the axes of the lidar there, at ``seconds`` (K,) from the middle, ascending. Nothing changes
        if no gyro knows the rotation.
        """
        if self._turned is None:
            return self
        sweep = copy(self)
        sweep._bend = seconds, path
        turned = (
            points + sweep._bent(seconds)
            for points, seconds in zip(self._turned, self._seconds, strict=True)
        )
        sweep._turned = next(turned), next(turned)
        return sweep

    def accelerated(self, acceleration: FloatArray | None) -> MovingSweep:
        """The sweep of a lidar with a (6,) body acceleration, rad/s^2 and m/s^2, or with none.

        Nothing changes if a gyro knows the rotation, or without de-skewing.
        """
        if self.motion is not SweepMotion.CONSTANT_VELOCITY:
            return self
        sweep = copy(self)
        sweep.acceleration = acceleration
        return sweep

    def measured_planes(self, rows: IntArray) -> FloatArray:
        """Chosen planes (M, 3) as the lidar measured them, metres, not de-skewed."""
        return self._points[1].take(rows, axis=0)

    def later(self, nanoseconds: int) -> MovingSweep:
        """The sweep on a clock that was set ahead by so much."""
        sweep = copy(self)
        sweep.stamp += nanoseconds
        sweep.reference_stamp += nanoseconds
        return sweep

    def without_turns(self) -> MovingSweep:
        """The sweep as if no IMU had been there."""
        if self._turned is None:
            return self
        sweep = copy(self)
        sweep._turned = sweep._bend = None
        sweep.motion = SweepMotion.CONSTANT_VELOCITY
        return sweep

    def _bent(self, seconds: FloatArray | float) -> FloatArray:
        """(..., 3) the way from the straight line."""
        if self._bend is None:
            return np.zeros(3)
        return interpolated(seconds, *self._bend)

    def velocity_at(self, seconds: float, twist: FloatArray) -> FloatArray | None:
        """(3,) m/s at that time from the middle, in the axes of the middle; None if on a line.

        ``twist`` is the (6,) body velocity at the reference time.
        """
        if self._bend is None:
            return None
        times, path = self._bend
        felt = interpolated(seconds, times, np.gradient(path, times, axis=0, edge_order=2))
        velocity: FloatArray = self._middle_R_reference @ twist[3:] + felt
        return velocity

    def seconds(self, edges: IntArray, planes: IntArray) -> tuple[FloatArray, FloatArray]:
        """Seconds (N,) from the middle of the sweep to chosen edges and planes, by their rows."""
        return self._seconds[0].take(edges), self._seconds[1].take(planes)

    def at(self, twist: FloatArray) -> PosedSweep:
        """The sweep de-skewed for a (6,) body velocity at the reference time, rad/s and m/s."""
        return PosedSweep(self, twist)

    def middle_T_reference(self, twist: FloatArray) -> gtsam.Pose3:
        """The pose of the lidar at the reference time, seen from the middle of the sweep."""
        if self._turned is None:
            step = -twist * self.middle
            if self.acceleration is not None:
                step = step + 0.5 * self.middle**2 * self.acceleration
            return gtsam.Pose3.Expmap(step)
        rotation = self._middle_R_reference
        moved = rotation @ twist[3:] * -self.middle + self._bent(-self.middle)
        return gtsam.Pose3(gtsam.Rot3(rotation), moved)

    def twist_since(self, last: tuple[int, gtsam.Pose3], map_T_middle: gtsam.Pose3) -> FloatArray:
        """(6,) body velocity at the reference time, from the poses of the middles of two sweeps.

        ``last`` is the stamp, nanoseconds, and the pose of an earlier one.
        """
        seconds = (self.stamp - last[0]) * 1e-9
        if self._turned is None:
            twist: FloatArray = gtsam.Pose3.Logmap(last[1].between(map_T_middle)) / seconds
            return twist
        away = np.asarray(map_T_middle.translation()) - last[1].translation()
        # The velocity of the middle, not the mean since then.
        map_R_middle = map_T_middle.rotation().matrix()
        away = away + map_R_middle @ self._bent(-seconds)
        map_R_reference = map_R_middle @ self._middle_R_reference
        return np.concatenate([self._rate, map_R_reference.T @ away / seconds])

    def twist_at_reference(self, rate: FloatArray, velocity: FloatArray) -> FloatArray:
        """(6,) body velocity at the reference time.

        ``velocity`` (3,) m/s is that at the middle of the sweep, in the axes of the lidar there;
        ``rate`` (3,) rad/s counts if no gyro knows that of the sweep.
        """
        if self._turned is not None:
            rate, velocity = self._rate, self._middle_R_reference.T @ velocity
        return np.concatenate([rate, velocity])

    def deskewed(
        self,
        twist: FloatArray,
        edge_rows: IntArray | None = None,
        plane_rows: IntArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Edges and planes seen from the middle of the sweep, (N, 3) metres; rows None are all."""
        return self._part(0, twist, edge_rows), self._part(1, twist, plane_rows)

    def _part(self, which: int, twist: FloatArray, rows: IntArray | None) -> FloatArray:
        """Edges (0) or planes (1)."""
        points, seconds = (self._turned or self._points)[which], self._seconds[which]
        if rows is not None:
            points, seconds = points.take(rows, axis=0), seconds.take(rows)
        if self.motion is SweepMotion.NONE:
            return points
        if self._turned is None:
            moved = move_points(points, twist, seconds)
            return moved if self.acceleration is None else moved + self._swerved(moved, seconds)
        return points + np.outer(seconds, self._middle_R_reference @ twist[3:])

    def _swerved(self, points: FloatArray, seconds: FloatArray) -> FloatArray:
        """(N, 3) how far the acceleration moved points meanwhile."""
        assert self.acceleration is not None
        turn, shift = self.acceleration[:3], self.acceleration[3:]
        return (0.5 * seconds**2)[:, None] * (points @ cross_matrix(turn).T + shift)


@dataclass(frozen=True, eq=False)
class PosedSweep:
    """A sweep de-skewed for one ``twist``, as of :meth:`MovingSweep.at`: an immutable value."""

    sweep: MovingSweep
    twist: FloatArray

    @cached_property
    def points(self) -> tuple[FloatArray, FloatArray]:
        """All edges (E, 3) and planes (P, 3), metres, seen from the middle of the sweep."""
        return self.sweep.deskewed(self.twist)

    def rows(self, edges: IntArray, planes: IntArray) -> tuple[FloatArray, FloatArray]:
        """Chosen edges and planes, by their rows, seen from the middle of the sweep."""
        return self.sweep.deskewed(self.twist, edges, planes)

    @cached_property
    def middle_T_reference(self) -> gtsam.Pose3:
        """The pose of the lidar at the reference time, seen from the middle of the sweep."""
        return self.sweep.middle_T_reference(self.twist)

    def later(self, nanoseconds: int) -> PosedSweep:
        """The sweep on a clock that was set ahead by so much."""
        return PosedSweep(self.sweep.later(nanoseconds), self.twist)

    def map_T_middle(self, map_T_lidar: gtsam.Pose3) -> gtsam.Pose3:
        """The pose at the middle of the sweep, from the pose at the reference time."""
        return map_T_lidar.compose(self.middle_T_reference.inverse())


def _turns_by_orientation(
    imu: ImuBuffer, stamp: int, moments: FloatArray, max_gap: float
) -> FloatArray | None:
    """Rotation vectors as of :meth:`ImuBuffer.rotations_since`, from the IMU's orientations."""
    first, end = moments.min(), moments.max()
    begins, ends = (stamp + round(float(seconds) * 1e9) for seconds in (first, end))
    samples = imu.samples_between(begins, ends)
    middle = imu.orientation(stamp)
    before, after = imu.orientation(begins), imu.orientation(ends)
    if middle is None or before is None or after is None or samples.orientation is None:
        return None
    known = np.isfinite(samples.orientation[:, 0])
    times = np.concatenate([[first], (samples.stamps[known] - stamp) * 1e-9, [end]])
    if np.diff(times).max() > max_gap:
        return None
    inside = Rotation.from_quat(samples.orientation[known]).as_matrix()
    world = np.concatenate([[before.matrix()], inside, [after.matrix()]])
    turns = Rotation.from_matrix(middle.matrix().T @ world).as_rotvec()
    return interpolated(moments, times, turns)


def _rotated(points: FloatArray, turns: FloatArray) -> FloatArray:
    """Points, each turned by its own rotation vector (Rodrigues' formula)."""
    axis, point = turns.T.copy(), points.T.copy()  # component arrays are several times faster
    angle = np.maximum(np.sqrt((axis * axis).sum(axis=0)), 1e-12)
    across = cross(axis, point)
    sine, versine = np.sin(angle) / angle, 2.0 * (np.sin(0.5 * angle) / angle) ** 2
    rotated: FloatArray = (point + sine * across + versine * cross(axis, across)).T
    return rotated
