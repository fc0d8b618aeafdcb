"""Other systems on the same sweeps. All of them are optional: ``pip install -e ".[bench]"``."""

from __future__ import annotations

import importlib
import importlib.metadata
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.datasets.kitti import raise_elevation
from loam_gtsam.sweep import assign_rings, assign_times, usable_columns
from loam_gtsam.types import FloatArray, InputError, Scan, Trajectory


def version(package: str) -> str:
    """Installed version of a package, or "not installed"."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def load(module: str) -> Any | None:
    """The module if it is installed, else None."""
    try:
        return importlib.import_module(module)
    except ImportError:
        return None


@dataclass(frozen=True, slots=True)
class TimedPoints:
    """The usable points of a sweep, for systems that want arrays.

    Attributes
    ----------
    points : (N, 3) float64, metres, lidar frame at each point's own time
    times : (N,) seconds from the stamp: those of the data, else from the azimuth as ours
    span : (first, last) seconds from the stamp covered by the sweep
    """

    points: FloatArray
    times: FloatArray
    span: tuple[float, float]


def timed_points(scan: Scan, config: Config) -> TimedPoints:
    """What a peer is given: the points and times our own pipeline works with.

    Raises
    ------
    SweepError
        If the sweep has too few points, or no times can be had.
    """
    columns = usable_columns(scan, config)
    timing = assign_times(columns, assign_rings(columns, config.sensor), config)
    points = np.ascontiguousarray(columns.xyz.T, dtype=np.float64)
    return TimedPoints(points, np.asarray(timing.times, np.float64), timing.span)


@dataclass(frozen=True, slots=True)
class KissVariant:
    """How KISS-ICP is given the sweeps; everything else is its default.

    Attributes
    ----------
    label : column of the report
    deskew : use its own de-skew
    elevation_deg : raise every ray, as its loader of KITTI's raw data does (0.205 degrees)
    """

    label: str = "KISS-ICP"
    deskew: bool = True
    elevation_deg: float = 0.0


class KissIcp:
    """KISS-ICP (Vizzo et al., RA-L 2023), one sweep at a time.

    Notes
    -----
    Version 1.3 de-skews to the time of the *last* point (a point at the end of the sweep is left
    where it was), so its pose belongs there and is compared with the truth of that moment. Without
    de-skew a pose fits the sweep as a whole best at its middle.
    """

    def __init__(self, variant: KissVariant = KissVariant()) -> None:
        settings = importlib.import_module("kiss_icp.config").KISSConfig()
        settings.data.deskew = variant.deskew
        if settings.mapping.voxel_size is None:  # as its own load_config does
            settings.mapping.voxel_size = settings.data.max_range / 100.0
        self.variant = variant
        self.seconds: list[float] = []
        self._icp = importlib.import_module("kiss_icp.kiss_icp").KissICP(settings)
        self._stamps: list[int] = []
        self._poses: list[FloatArray] = []

    def register(self, stamp: int, sweep: TimedPoints) -> None:
        """Register a sweep; only the registration itself is timed.

        Raises
        ------
        InputError
            If all points have the same time and it is to de-skew: it would end the process.
        """
        points, times = sweep.points, sweep.times
        if self.variant.deskew and (len(times) == 0 or times.min() >= times.max()):
            raise InputError("KISS-ICP: expected points of different times to de-skew with")
        if self.variant.elevation_deg:
            angle = float(np.radians(self.variant.elevation_deg))
            points = raise_elevation(points, angle).astype(np.float64)
        started = time.perf_counter()
        self._icp.register_frame(points, times)
        self.seconds.append(time.perf_counter() - started)
        moment = float(times.max()) if self.variant.deskew else sum(sweep.span) / 2.0
        self._stamps.append(stamp + round(moment * 1e9))
        self._poses.append(np.array(self._icp.last_pose))

    @property
    def trajectory(self) -> Trajectory:
        """One pose per sweep, at the moment it belongs to."""
        return Trajectory(np.array(self._stamps, np.int64), np.array(self._poses).reshape(-1, 4, 4))


def gicp_step(
    target: FloatArray, source: FloatArray, kind: str, voxel: float, guess: FloatArray
) -> FloatArray:
    """``target_T_source`` (4, 4) by small_gicp (Koide, JOSS 2024) on (N, 3) points.

    Parameters
    ----------
    kind : "ICP", "PLANE_ICP" or "GICP"
    voxel : metres, of its downsampling
    guess : (4, 4) where it starts
    """
    result = importlib.import_module("small_gicp").align(
        target,
        source,
        init_T_target_source=guess,
        registration_type=kind,
        downsampling_resolution=voxel,
        max_correspondence_distance=1.0,
        max_iterations=100,
    )
    step: FloatArray = np.array(result.T_target_source)
    return step
