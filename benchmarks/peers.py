"""Other systems on the same sweeps. All of them are optional: ``pip install -e ".[bench]"``."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loam_gtsam.datasets.kitti.folder import raise_elevation
from loam_gtsam.studies import peers
from loam_gtsam.studies.contenders import timed_points as timed_points
from loam_gtsam.studies.peers import TimedPoints
from loam_gtsam.types import FloatArray, MapUpdate


def load(module: str) -> Any | None:
    """The module if it is installed, else None."""
    try:
        return importlib.import_module(module)
    except ImportError:
        return None


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


class KissIcp(peers.KissIcp):
    """KISS-ICP, given the sweeps as a variant says."""

    def __init__(self, variant: KissVariant = KissVariant()) -> None:
        self.variant, self.deskew = variant, variant.deskew
        super().__init__()

    def register(self, stamp: int, sweep: TimedPoints) -> MapUpdate:
        """See :meth:`loam_gtsam.studies.peers.Peer.register`."""
        if self.variant.elevation_deg:
            angle = float(np.radians(self.variant.elevation_deg))
            points = raise_elevation(sweep.points, angle).astype(np.float64)
            sweep = replace(sweep, points=points)
        return super().register(stamp, sweep)

    @property
    def seconds(self) -> list[float]:
        """What each registration took."""
        return [sum(update.timings.values()) for update in self.updates]


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
