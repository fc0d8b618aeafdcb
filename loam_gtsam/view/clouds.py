"""What a run shows of itself, frame by frame: the registered sweep and the map around it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.organise import OrganisedSweep, organise
from loam_gtsam.geometry import transform
from loam_gtsam.mapper import Mapper
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

_NONE = np.zeros((0, 3))
_NO_RINGS = np.zeros(0, np.int64)


class Recording(Protocol):
    """What takes the frames; :class:`loam_gtsam.ros.bag_writer.BagWriter` does."""

    def write(
        self,
        update: MapUpdate,
        cloud: NDArray[np.floating] | None = None,
        surround: Callable[[], NDArray[np.floating]] | None = None,
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


def registered_cloud(sweep: Sweep, update: MapUpdate, mapper: Mapper) -> FloatArray | None:
    """All usable points of a sweep, de-skewed with its final motion, in the map frame.

    Parameters
    ----------
    sweep : as it was processed
    update : the result
    mapper : that made it; the sensor and the de-skew are read as it does

    Returns
    -------
    (N, 4) metres, and LOAM's intensity: the ring plus the seconds since the sweep began. None if
    there are no points. Those of another front end have intensity 0.
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
    """Map points of the cubes around the sensor, those that the next sweep is matched with.

    Returns
    -------
    (N, 4) metres, map frame, and the intensity: 0 of edge, 1 of plane points
    """
    pose = update.map_T_lidar.matrix()
    parts = []
    for intensity, cubes in enumerate((mapper.maps.edges, mapper.maps.planes)):
        points = cubes.points(cubes.neighbourhood(pose))
        parts.append(np.column_stack([points, np.full(len(points), float(intensity))]))
    return np.concatenate(parts)


def _deskewed(
    scan: Scan, organised: OrganisedSweep, update: MapUpdate, mapper: Mapper
) -> FloatArray:
    """(N, 3) points of a sweep in the map frame, moved as the mapper moves features."""
    since_scan = (update.stamp - scan.stamp) * 1e-9
    times = organised.times - since_scan
    first, last = organised.span
    points = Features(
        stamp=update.stamp,
        edges=_NONE,
        planes=organised.xyz.T.astype(np.float64),
        edge_times=np.zeros(0),
        plane_times=times,
        edge_rings=_NO_RINGS,
        plane_rings=_NO_RINGS,
        sharp=_NO_RINGS,
        flat=_NO_RINGS,
        span=(first - since_scan, last - since_scan),
    )
    # As it was for this frame: the gyro may have been given up since.
    turned = update.sweep_motion in (SweepMotion.GYRO, SweepMotion.ORIENTATION)
    imu = mapper.imu.buffer if turned and mapper.imu is not None else None
    posed = MovingSweep(points, mapper.config, imu, thin=False).at(update.twist)
    return transform(posed.map_T_middle(update.map_T_lidar).matrix(), posed.points[1])
