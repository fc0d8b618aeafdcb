"""Messages of LOAM's own front end: which belong together, and what they hold."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from loam_gtsam.datasets.decode.pointcloud2 import NO_TIMES, decode_pointcloud2, message_stamp
from loam_gtsam.datasets.decode.tables import pose_matrix
from loam_gtsam.types import DatasetError, Features, FeatureSweep, FloatArray, LoamError

EDGES = "/laser_cloud_corner_last"
PLANES = "/laser_cloud_surf_last"
ODOMETRY = "/laser_odom_to_init"
CLOUD = "/velodyne_cloud_3"
REQUIRED = (EDGES, PLANES, ODOMETRY)

STAMP_TOLERANCE_NS = 5_000_000
"""Messages of one sweep agree to this (LOAM, laserMapping: 0.005 s)."""
_WAITING = 100  # messages of a topic kept while their partners are missing
_FLATNESS = 0.85
"""The vertical axis must spread this much less than the next: beams fan out by at most +-45
degrees, so their directions vary by at most 0.7 of what the azimuth makes of the other two."""

# x_loam = left, y_loam = up, z_loam = forward
_LIDAR_T_LOAM: FloatArray = np.eye(4)[[2, 0, 1, 3]]


class StampMatcher:
    """Groups messages of several topics whose stamps agree."""

    def __init__(self, topics: Collection[str]) -> None:
        self.unmatched = dict.fromkeys(topics, 0)  # messages given up so far
        self._waiting: dict[str, dict[int, Any]] = {topic: {} for topic in topics}

    def add(self, topic: str, stamp: int, message: Any) -> dict[str, Any] | None:
        """The group this message completes, if it does; older messages are then given up."""
        messages = self._waiting[topic]
        if stamp in messages or len(messages) >= _WAITING:
            del messages[stamp if stamp in messages else min(messages)]
            self.unmatched[topic] += 1
        messages[stamp] = message
        if not all(self._waiting.values()):
            return None
        waiting = self._waiting.items()
        nearest = {other: min(stamps, key=lambda s: abs(s - stamp)) for other, stamps in waiting}
        if max(nearest.values()) - min(nearest.values()) > STAMP_TOLERANCE_NS:
            return None
        group = {other: self._waiting[other].pop(best) for other, best in nearest.items()}
        for other, best in nearest.items():
            for old in [s for s in self._waiting[other] if s < best]:
                del self._waiting[other][old]
                self.unmatched[other] += 1
        return group

    def finish(self) -> dict[str, int]:
        """Counts, with what is still waiting."""
        return {topic: self.unmatched[topic] + len(kept) for topic, kept in self._waiting.items()}


class FeatureDecoder:
    """Decodes groups of messages from ``lidar`` (A-LOAM) or ``loam`` axes into lidar axes."""

    def __init__(self, axes: Literal["lidar", "loam"]) -> None:
        self._loam = axes == "loam"
        self._lidar_T_message: FloatArray = _LIDAR_T_LOAM if self._loam else np.eye(4)

    def sweep(self, group: Mapping[str, Any]) -> FeatureSweep:
        """Topic -> message as a sweep, with the stamp of the odometry."""
        return FeatureSweep(
            features=Features.from_points(
                message_stamp(group[ODOMETRY]),
                self._points(EDGES, group[EDGES]),
                self._points(PLANES, group[PLANES]),
            ),
            odom_T_lidar=gtsam.Pose3(self.pose(ODOMETRY, group[ODOMETRY])),
            cloud=self._points(CLOUD, group[CLOUD]) if CLOUD in group else None,
        )

    def pose(self, topic: str, message: Any) -> FloatArray:
        """(4, 4) pose of an odometry message."""
        p, q = message.pose.pose.position, message.pose.pose.orientation
        try:
            message_T = pose_matrix([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
        except ValueError as error:
            raise DatasetError(f"topic {topic}: not a pose: {error}") from error
        return np.asarray(self._lidar_T_message @ message_T @ self._lidar_T_message.T)

    def _points(self, topic: str, message: Any) -> NDArray[np.floating]:
        points = finite_points(topic, message)
        # x_loam, y_loam, z_loam = left, up, forward; a permutation is exact
        return np.ascontiguousarray(points[:, [2, 0, 1]]) if self._loam else points


def finite_points(topic: str, message: Any) -> NDArray[np.floating]:
    """(N, 3) points of a de-skewed cloud, in its own axes."""
    try:
        # Whatever looks like a time in it is none.
        points: NDArray[np.floating] = decode_pointcloud2(message, time_field=NO_TIMES).points
    except LoamError as error:
        raise DatasetError(f"topic {topic}: {error}") from error
    return points[np.flatnonzero(np.isfinite(points).all(axis=1))]


def directions_spread(points: NDArray[np.floating]) -> FloatArray | None:
    """(3,) standard deviations of the directions to (N, 3) points; None of too few."""
    points = points.astype(np.float64)
    ranges = np.linalg.norm(points, axis=1)
    if (ranges > 0.0).sum() < 100:  # too few to speak of a spread
        return None
    return np.asarray((points[ranges > 0.0] / ranges[ranges > 0.0, None]).std(axis=0))


def decide_axes(topic: str, spread: FloatArray | None) -> Literal["lidar", "loam"]:
    """The axes in which directions spread so: they do least along the vertical one."""
    if spread is not None:
        order = np.argsort(spread)
        if spread[order[0]] < _FLATNESS * spread[order[1]] and order[0] in (1, 2):
            return "lidar" if order[0] == 2 else "loam"
    raise DatasetError(
        f"cannot tell the axes of {topic} (spread of the directions along x, y, "
        f"z: {'unknown' if spread is None else np.round(spread, 3).tolist()}); give "
        "axes='lidar' (A-LOAM) or axes='loam' (the original LOAM)"
    )
