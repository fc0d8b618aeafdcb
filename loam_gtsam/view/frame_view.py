"""What there is to see of a frame, for the live viewer and the pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.types import BoolArray, FloatArray, MapUpdate

LARGE_RESIDUAL = 3.0
"""Standard deviations that have the last colour: 99.7 % of normal noise is below."""
RESIDUAL_COLOURS = ("#2166ac", "#4fb3a9", "#f2cf4a", "#ee8a34", "#c2222f")
"""From a residual of zero to a large one, evenly spaced."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameView:
    """One frame of a run. All points are in ``map``, corrected by the loops if there are any.

    Attributes
    ----------
    number : of the frame, from 0
    map_T_lidar : (4, 4) pose of the frame
    position_covariance : (3, 3) m^2 of the position, along the axes of the map; NaN where the
        frame was not solved
    sweep : (N, 3) metres, de-skewed
    edges, planes : (E, 3) and (P, 3) metres, the features as they went into the map; empty if
        they did not
    points : (M, 3) metres, the matched features, those of edges first
    feet : (M, 3) metres, the nearest point on the line or plane that each was matched with
    residuals : (M,) distances from ``points`` to ``feet`` over their standard deviations
    """

    number: int
    update: MapUpdate
    map_T_lidar: FloatArray
    position_covariance: FloatArray
    sweep: FloatArray
    edges: FloatArray
    planes: FloatArray
    points: FloatArray
    feet: FloatArray
    residuals: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MapView:
    """Map, path and loops of a run so far, in ``map``.

    Attributes
    ----------
    edges, planes : (E, 3) and (P, 3) metres, map points of the cubes around the sensor
    path : (N, 3) metres, positions of the sensor; with loops, those of the keyframes and the last
    loops : (L, 2, 3) metres, both ends of each loop
    loops_on : (L,) which loops are used; the others are switched off
    """

    edges: FloatArray
    planes: FloatArray
    path: FloatArray
    loops: FloatArray
    loops_on: BoolArray


class FrameWatcher(Protocol):
    """A viewer of frames, such as :class:`loam_gtsam.view.rerun_viewer.RerunViewer`."""

    def show(self, frame: FrameView, around: Callable[[], MapView]) -> None:
        """Show a frame; ``around`` makes the view of the map, which takes longer."""


def residual_colours(residuals: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(M, 3) red, green and blue of residuals, in standard deviations, from blue to red."""
    stops = [[int(name[i : i + 2], 16) for i in (1, 3, 5)] for name in RESIDUAL_COLOURS]
    places = np.linspace(0.0, LARGE_RESIDUAL, len(stops))
    columns = [np.interp(np.abs(residuals), places, column) for column in zip(*stops, strict=True)]
    return np.stack(columns, axis=-1).round().astype(np.uint8)
