"""Ways: rows of points with straight lines between them, and what goes along one for ever."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from loam_gtsam.geometry import interpolated
from loam_gtsam.types import FloatArray

_FINE = 0.05  # metres between the points of a way while it is rounded


@dataclass(frozen=True, slots=True, eq=False)
class Mover:
    """An upright cylinder or box that goes round and round a closed way at constant speed.

    Attributes
    ----------
    way : (K, 2) corners x y, metres; with two of them it goes there and back
    footprint : radius of a cylinder, or half length and half width of a box, metres
    low, high : between these heights, metres
    speed : m/s
    start : metres along the way at time zero
    """

    way: FloatArray
    footprint: tuple[float] | tuple[float, float]
    low: float
    high: float
    speed: float
    start: float = 0.0

    @property
    def reach(self) -> float:
        """Metres from its centre to its farthest edge, seen from above."""
        return math.hypot(*self.footprint)

    def places(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Centres (N, 2) and headings (N,) in rad at ``times`` (N,) in seconds.

        Front and rear of a box are on the way, as the axles of a car are: it turns smoothly.
        """
        half = self.footprint[0]
        loop = np.vstack([self.way, self.way[:1]])
        length = distances_along(loop)[-1]
        gone = self.start + self.speed * times
        if len(self.footprint) == 1:
            return points_along(loop, gone % length), np.zeros(len(times))
        front, rear = (points_along(loop, (gone + end) % length) for end in (half, -half))
        ahead = front - rear
        return 0.5 * (front + rear), np.arctan2(ahead[:, 1], ahead[:, 0])


def distances_along(way: FloatArray) -> FloatArray:
    """(N,) metres from the first of (N, D) points to each, along straight lines between them."""
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def points_along(way: FloatArray, metres: FloatArray) -> FloatArray:
    """(M, D) points so far along a way of (N, D) points, of which no two in a row are the same."""
    return interpolated(metres, distances_along(way), way)


def rounded(corners: FloatArray, blur: float, spacing: float, closed: bool) -> FloatArray:
    """(W, D) points about ``spacing`` apart on the way through (N, D) corners, cut smoothly.

    ``blur`` is the standard deviation of a Gaussian along the way, metres: a right angle is cut by
    0.56 of it, and has a least radius of 0.9 of it.
    """
    way = np.vstack([corners, corners[:1]]) if closed else corners
    length = distances_along(way)[-1]
    fine = np.linspace(0.0, length, int(length / _FINE), endpoint=not closed)
    mode = "wrap" if closed else "nearest"
    smooth = gaussian_filter1d(points_along(way, fine), blur / _FINE, axis=0, mode=mode)
    return np.asarray(smooth[:: max(1, round(spacing / _FINE))])


def distance_to_way(way: FloatArray, points: FloatArray) -> FloatArray:
    """(N,) metres from each of (N, 2) points to the nearest of the points of a way."""
    return np.asarray(np.linalg.norm(points[:, None] - way[None, :, :2], axis=2).min(axis=1))
