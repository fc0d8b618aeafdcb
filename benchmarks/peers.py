"""Other systems on the same sweeps. All of them are optional: ``pip install -e ".[bench]"``."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from loam_gtsam.studies.contenders import timed_points as timed_points
from loam_gtsam.studies.peers import TimedPoints as TimedPoints
from loam_gtsam.studies.peers import icp
from loam_gtsam.types import FloatArray


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
    """

    label: str = "KISS-ICP"
    deskew: bool = True


class KissIcp(icp.KissIcp):
    """KISS-ICP, given the sweeps as a variant says."""

    def __init__(self, variant: KissVariant = KissVariant()) -> None:
        self.variant = variant
        super().__init__({"deskew": variant.deskew})

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
