"""A sweep in motion: its features, de-skewed to the middle of the sweep.

Within a frame, poses belong to the *middle* of the sweep: there an error of the motion used for
the de-skew cancels to first order, while at the start or the end it would shift the whole sweep.
"""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.config import Config
from loam_gtsam.frontend.features import thinned
from loam_gtsam.geometry import cross, move_points
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.types import BoolArray, Features, FloatArray, IntArray, SweepMotion

_DISTINCT = 4.5
"""Standard deviations of range noise by which a distinct edge stands out of its ring."""


class MovingSweep:
    """The voxel-filtered features of a sweep.

    Rotation within the sweep comes from the gyro (or the orientation) of an IMU if there is one
    that covers the sweep; translation, and without an IMU rotation too, from a constant velocity.

    Parameters
    ----------
    features : of the sweep
    config : ``deskew`` and the voxel sizes of ``map`` are used
    imu : None for constant velocity
    thin : whether to voxel-filter the points, as for matching

    Attributes
    ----------
    reference_stamp : nanoseconds of the moment the frame's pose is handed out for
    stamp : nanoseconds of the middle of the sweep
    middle : seconds from the one to the other; 0 if the features do not move
    duration : seconds of the sweep; 0 likewise
    n_edges, n_planes : how many there are
    distinct : (E,) whether an edge stands out of its ring by more than range noise makes it
    motion : what the rotation comes from
    not_finite : points of the sweep that were NaN or infinite
    """

    def __init__(
        self,
        features: Features,
        config: Config,
        imu: ImuBuffer | None = None,
        *,
        thin: bool = True,
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
        self._points = [features.edges, features.planes]
        times = features.edge_times, features.plane_times
        self._seconds = [part - self.middle for part in times]
        self.n_edges, self.n_planes = map(len, self._points)
        self._twist: FloatArray | None = None
        self._all: tuple[FloatArray, FloatArray] | None = None
        self.motion = SweepMotion.CONSTANT_VELOCITY if moving else SweepMotion.NONE
        self._turned: list[FloatArray] | None = None
        span = np.array([first, 0.0, end]) - self.middle
        if moving and imu is not None and config.deskew.rotation != "constant_velocity":
            moments = np.concatenate([span, *self._seconds])
            if config.deskew.rotation == "orientation":
                turns = _turns_by_orientation(imu, self.stamp, moments, config.imu.max_gap)
                motion = SweepMotion.ORIENTATION
            else:
                turns = imu.rotations_since(self.stamp, moments)
                motion = SweepMotion.GYRO
            if turns is not None:
                self.motion = motion
                before, reference, after = turns[:3]
                self._rate = (after - before) / (span[2] - span[0])
                self._middle_R_reference: FloatArray = Rotation.from_rotvec(reference).as_matrix()
                split = 3 + self.n_edges
                parts = turns[3:split], turns[split:]
                self._turned = [_rotated(*part) for part in zip(self._points, parts, strict=True)]

    @property
    def is_empty(self) -> bool:
        """Whether there is no feature at all."""
        return self.n_edges + self.n_planes == 0

    @property
    def edges(self) -> FloatArray:
        """(E, 3) metres, seen from the middle of the sweep."""
        return self._deskewed()[0]

    @property
    def planes(self) -> FloatArray:
        """(P, 3) metres, seen from the middle of the sweep."""
        return self._deskewed()[1]

    def deskew(self, twist: FloatArray) -> None:
        """Set ``edges`` and ``planes`` for a (6,) body velocity at the reference time."""
        if self.motion is not SweepMotion.NONE:
            self._twist, self._all = twist, None

    def some(self, edges: IntArray, planes: IntArray) -> tuple[FloatArray, FloatArray]:
        """Those of ``edges`` and ``planes`` in some rows."""
        return self._part(0, edges), self._part(1, planes)

    def _deskewed(self) -> tuple[FloatArray, FloatArray]:
        if self._all is None:
            self._all = self._part(0), self._part(1)
        return self._all

    def _part(self, which: int, rows: IntArray | None = None) -> FloatArray:
        """Edges (0) or planes (1), de-skewed; all if there are no rows."""
        twist = self._twist
        points, seconds = self._points[which], self._seconds[which]
        if twist is not None and self._turned is not None:
            points = self._turned[which]
        if rows is not None:
            points, seconds = points.take(rows, axis=0), seconds.take(rows)
        if twist is None:
            return points
        if self._turned is None:
            return move_points(points, twist, seconds)
        return points + np.outer(seconds, self._middle_R_reference @ twist[3:])

    def middle_T_reference(self, twist: FloatArray) -> gtsam.Pose3:
        """The lidar at the reference time seen from the middle of the sweep."""
        if self._turned is None:
            return gtsam.Pose3.Expmap(-twist * self.middle)
        rotation = self._middle_R_reference
        return gtsam.Pose3(gtsam.Rot3(rotation), rotation @ twist[3:] * -self.middle)

    def twist_since(self, last: tuple[int, gtsam.Pose3], map_T_middle: gtsam.Pose3) -> FloatArray:
        """(6,) body velocity at the reference time, from the middle of another sweep to this one's.

        Parameters
        ----------
        last : stamp and pose of the middle of an earlier sweep
        """
        seconds = (self.stamp - last[0]) * 1e-9
        if self._turned is None:
            twist: FloatArray = gtsam.Pose3.Logmap(last[1].between(map_T_middle)) / seconds
            return twist
        away = np.asarray(map_T_middle.translation()) - last[1].translation()
        map_R_reference = map_T_middle.rotation().matrix() @ self._middle_R_reference
        return np.concatenate([self._rate, map_R_reference.T @ away / seconds])

    def twist_at_reference(self, rate: FloatArray, velocity: FloatArray) -> FloatArray:
        """(6,) body velocity at the reference time.

        Parameters
        ----------
        rate : (3,) rad/s
        velocity : (3,) m/s at the middle of the sweep, in the lidar's axes there
        """
        if self._turned is not None:
            velocity = self._middle_R_reference.T @ velocity
        return np.concatenate([rate, velocity])


def _turns_by_orientation(
    imu: ImuBuffer, stamp: int, moments: FloatArray, max_gap: float
) -> FloatArray | None:
    """As :meth:`ImuBuffer.rotations_since`, interpolated between the IMU's orientations."""
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
    return np.stack([np.interp(moments, times, angle) for angle in turns.T], axis=-1)


def _rotated(points: FloatArray, turns: FloatArray) -> FloatArray:
    """Each point turned by its own rotation vector (Rodrigues' formula)."""
    axis, point = turns.T.copy(), points.T.copy()  # component arrays are several times faster
    angle = np.maximum(np.sqrt((axis * axis).sum(axis=0)), 1e-12)
    across = cross(axis, point)
    sine, versine = np.sin(angle) / angle, 2.0 * (np.sin(0.5 * angle) / angle) ** 2
    rotated: FloatArray = (point + sine * across + versine * cross(axis, across)).T
    return rotated
