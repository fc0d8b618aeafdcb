"""Observers of a run, which record or show its frames as the mapper has just left them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.organise import OrganisedSweep, organise
from loam_gtsam.geometry import transform, voxel_filter
from loam_gtsam.mapper import Mapper, Registered
from loam_gtsam.pipeline import Observer, Pipeline
from loam_gtsam.types import (
    BadSweep,
    Features,
    FeatureSweep,
    FloatArray,
    MapUpdate,
    Scan,
    Sweep,
    SweepError,
    SweepMotion,
)
from loam_gtsam.view.frame_view import FrameView, FrameWatcher, MapView

_NONE = np.zeros((0, 3))
_NO_ROWS = np.zeros(0, np.int64)


class Recording(Protocol):
    """A file of frames, such as :class:`loam_gtsam.ros.bag_writer.BagWriter`."""

    def write(
        self,
        update: MapUpdate,
        cloud: FloatArray | None = None,
        surround: Callable[[], FloatArray] | None = None,
    ) -> None:
        """Append one frame."""


def record(recording: Recording) -> Observer:
    """The ``observe`` of :func:`loam_gtsam.pipeline.run` that writes every frame.

    Examples
    --------
    >>> with BagWriter("mapped.mcap") as bag:  # doctest: +SKIP
    ...     run(dataset, config, observe=record(bag))
    """

    def observe(sweep: Sweep, update: MapUpdate, pipeline: Pipeline) -> None:
        cloud = registered_cloud(sweep, update, pipeline.mapper)
        recording.write(update, cloud, lambda: surrounding_cloud(update, pipeline.mapper))

    return observe


def watch(*watchers: FrameWatcher) -> Observer:
    """The ``observe`` of :func:`loam_gtsam.pipeline.run` that shows every frame.

    Examples
    --------
    >>> with RerunViewer("run.rrd") as viewer:  # doctest: +SKIP
    ...     run(dataset, config, observe=watch(viewer))
    """
    last = LastFrame()

    def observe(sweep: Sweep, update: MapUpdate, pipeline: Pipeline) -> None:
        last.observe(sweep, update, pipeline)
        frame = last.frame()
        for watcher in watchers:
            watcher.show(frame, last.around)

    return observe


class LastFrame:
    """Remembers the last frame of a run, and makes its view when that is asked for."""

    def __init__(self) -> None:
        self._number = -1
        self._path: list[FloatArray] = []
        self._last: tuple[Sweep, MapUpdate, Pipeline] | None = None

    def observe(self, sweep: Sweep, update: MapUpdate, pipeline: Pipeline) -> None:
        """An ``observe`` of :func:`loam_gtsam.pipeline.run` that takes no time."""
        self._number += 1
        self._last = sweep, update, pipeline
        if update.status.has_pose:
            self._path.append(np.asarray(update.map_T_lidar.translation()))

    @property
    def seen(self) -> bool:
        """Whether there was a frame; a run that was resumed may have none left to compute."""
        return self._last is not None

    def frame(self) -> FrameView:
        """See :func:`frame_view`; there must have been a frame."""
        assert self._last is not None
        return frame_view(self._number, *self._last)

    def around(self) -> MapView:
        """See :func:`map_view`; there must have been a frame."""
        assert self._last is not None
        return map_view(*self._last[1:], self._path)


def frame_view(number: int, sweep: Sweep, update: MapUpdate, pipeline: Pipeline) -> FrameView:
    """The frame that a pipeline has just processed, its number, sweep and result."""
    map_T_odom = _correction(pipeline)
    map_T_lidar = map_T_odom @ update.map_T_lidar.matrix()
    cloud = registered_cloud(sweep, update, pipeline.mapper)
    seen = pipeline.mapper.registered
    edges = planes = points = feet = _NONE
    residuals = np.zeros(0)
    if seen is not None:
        pose = seen.map_T_middle.matrix()
        edges, planes = (transform(map_T_odom @ pose, part) for part in (seen.edges, seen.planes))
        points, feet, residuals = matched_points(seen)
        points, feet = transform(map_T_odom, points), transform(map_T_odom, feet)
    # The perturbation of a pose is in the axes of the lidar.
    rotation = map_T_lidar[:3, :3]
    covariance = rotation @ update.covariance[3:, 3:] @ rotation.T
    swept = _NONE if cloud is None else transform(map_T_odom, cloud[:, :3])
    matches = points, feet, residuals
    return FrameView(number, update, map_T_lidar, covariance, swept, edges, planes, *matches)


def map_view(update: MapUpdate, pipeline: Pipeline, path: Sequence[FloatArray]) -> MapView:
    """The map around the sensor, the path of the sensor, and the loops.

    ``update`` is that of the frame that the pipeline has just processed, and ``path`` has the (3,)
    positions of all frames so far, in the frame of the mapper.
    """
    map_T_odom = _correction(pipeline)
    pose, maps = update.map_T_lidar.matrix(), pipeline.mapper.maps
    edges, planes = (
        transform(map_T_odom, cubes.points(cubes.neighbourhood(pose)))
        for cubes in (maps.edges, maps.planes)
    )
    positions = np.array(path).reshape(-1, 3)
    ends, on = np.zeros((0, 2, 3)), np.zeros(0, np.bool_)
    if pipeline.loops is not None and len(pipeline.loops.graph):
        keyframes = pipeline.loops.graph.poses()[:, :3, 3]
        positions = np.concatenate([keyframes, transform(map_T_odom, positions[-1:])])
        ends, on = pipeline.loops.loop_ends()
    return MapView(edges, planes, positions, ends, on)


def matched_points(seen: Registered) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Matched features, the nearest points of their matches, and the residuals; edges first.

    They are (M, 3) and (M, 3) metres in the frame of the mapper, and (M,) distances over their
    standard deviations. Empty if the sweep was not solved.
    """
    if seen.matches is None:
        return _NONE, _NONE, np.zeros(0)
    edges, planes = seen.matches.edges, seen.matches.planes
    pose = seen.map_T_middle.matrix()
    on_edges, on_planes = transform(pose, edges.points), transform(pose, planes.points)
    along = ((on_edges - edges.centres) * edges.directions).sum(axis=1, keepdims=True)
    above = (on_planes * planes.normals).sum(axis=1) + planes.offsets
    points = np.concatenate([on_edges, on_planes])
    feet = np.concatenate(
        [edges.centres + along * edges.directions, on_planes - above[:, None] * planes.normals]
    )
    sigmas = np.concatenate([edges.sigmas, planes.sigmas])
    return points, feet, np.linalg.norm(points - feet, axis=1) / sigmas


def registered_cloud(sweep: Sweep, update: MapUpdate, mapper: Mapper) -> FloatArray | None:
    """All usable points of a sweep, de-skewed with its final motion, in the map frame.

    They are (N, 4) metres, and LOAM's intensity: the ring plus the seconds since the sweep began;
    0 for those of another front end. None if there are no points.
    """
    if isinstance(sweep, FeatureSweep):
        if sweep.cloud is None:
            return None
        points = transform(update.map_T_lidar.matrix(), sweep.cloud)
        return np.column_stack([points, np.zeros(len(points))])
    if isinstance(sweep, BadSweep):
        return None
    try:
        organised = organise(sweep, mapper.config)
    except SweepError:
        return None
    points = _deskewed(sweep, organised, update, mapper)
    rings = np.repeat(organised.ring_of_start, np.diff(organised.ring_starts))
    return np.column_stack([points, rings + (organised.times - organised.span[0])])


def surrounding_cloud(update: MapUpdate, mapper: Mapper) -> FloatArray:
    """Map points of all cubes around the sensor, one for each voxel of the map of edges, as LOAM's.

    They are (N, 4) metres, map frame, and the intensity: 0 of edge, 1 of plane points, and between
    where a voxel has both.
    """
    pose = update.map_T_lidar.matrix()
    parts = []
    for intensity, cubes in enumerate((mapper.maps.edges, mapper.maps.planes)):
        points = cubes.points(cubes.surroundings(pose))
        parts.append(np.column_stack([points, np.full(len(points), float(intensity))]))
    return voxel_filter(np.concatenate(parts), mapper.maps.config.map.edge_voxel)


def _deskewed(
    scan: Scan, organised: OrganisedSweep, update: MapUpdate, mapper: Mapper
) -> FloatArray:
    since_scan = (update.stamp - scan.stamp) * 1e-9
    first, last = organised.span
    points = Features(
        stamp=update.stamp,
        edges=_NONE,
        planes=organised.xyz.T.astype(np.float64),
        edge_times=np.zeros(0),
        plane_times=organised.times - since_scan,
        edge_rings=_NO_ROWS,
        plane_rings=np.zeros(len(organised.times), np.int64),
        sharp=_NO_ROWS,
        flat=_NO_ROWS,
        span=(first - since_scan, last - since_scan),
    )
    # As it was for this frame: the gyro may have been given up since.
    turned = update.sweep_motion in (SweepMotion.GYRO, SweepMotion.ORIENTATION)
    imu = mapper.imu.buffer if turned and mapper.imu is not None else None
    sweep = MovingSweep(points, mapper.config, imu, thin=False)
    posed = sweep.accelerated(update.acceleration).at(update.twist)
    return transform(posed.map_T_middle(update.map_T_lidar).matrix(), posed.points[1])


def _correction(pipeline: Pipeline) -> FloatArray:
    if pipeline.loops is None:
        return np.eye(4)
    correction: FloatArray = pipeline.loops.map_T_odom.matrix()
    return correction
