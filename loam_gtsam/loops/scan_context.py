"""Scan Context: a descriptor of a place that can be compared at any heading.

It (Kim and Kim, IROS 2018) holds the height of the highest point, here feature, in each cell of a
polar grid around the lidar, whose columns shift with a turn of the lidar.
"""

from __future__ import annotations

import numpy as np

from loam_gtsam.config import LoopConfig
from loam_gtsam.geometry import as_points
from loam_gtsam.types import FloatArray, InputError

_BELOW = 3.0  # heights count from so many metres below the lidar; lower points are 0
_HIGHEST = 20.0  # metres: what is higher depends on the opening angle of the lidar


def scan_context(points: FloatArray, config: LoopConfig) -> FloatArray:
    """(rings, sectors) metres above a level below the lidar; 0 where there is no point.

    ``points`` are (N, 3) metres, lidar frame, de-skewed. Sectors count from x towards y.
    """
    points = as_points(points, "points")
    rings, sectors = config.rings, config.sectors
    ranges = np.hypot(points[:, 0], points[:, 1])
    near = ranges < config.reach
    turns = np.arctan2(points[near, 1], points[near, 0]) / (2.0 * np.pi)
    row = np.minimum((ranges[near] * (rings / config.reach)).astype(np.int64), rings - 1)
    column = np.floor((turns % 1.0) * sectors).astype(np.int64) % sectors
    heights = np.clip(points[near, 2] + _BELOW, 0.0, _HIGHEST)
    grid = np.zeros(rings * sectors)
    np.maximum.at(grid, row * sectors + column, heights)
    return grid.reshape(rings, sectors)


def heading_free_key(descriptor: FloatArray) -> FloatArray:
    """(rings,) means of the rows, which do not change with the heading, for a search tree."""
    means: FloatArray = descriptor.mean(axis=1)
    return means


def compare_descriptors(one: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Distance of two descriptors at the heading at which they are most alike.

    Returns
    -------
    distance : one less the mean cosine of the columns that both fill: 0 for equal descriptors, 1
        for descriptors without anything in common
    turn : rad about z by which the lidar of ``other`` is turned against that of ``one``
    """
    if one.shape != other.shape:
        raise InputError(f"descriptors: expected equal shapes, got {one.shape} and {other.shape}")
    sectors = one.shape[1]
    # Circular correlations over the columns, for all shifts at once.
    filled = [np.any(grid > 0.0, axis=0, keepdims=True).astype(np.float64) for grid in (one, other)]
    both = _correlated(*filled)
    cosines = _correlated(_columns(one), _columns(other))
    # A few columns that happen to agree must not count as a likeness.
    counts = np.maximum(both, 0.5 * min(float(part.sum()) for part in filled))
    likeness = np.divide(cosines, counts, out=np.zeros(sectors), where=counts > 0.5)
    shift = int(likeness.argmax())
    turn = 2.0 * np.pi * shift / sectors
    return 1.0 - float(likeness[shift]), float((turn + np.pi) % (2.0 * np.pi) - np.pi)


def _columns(grid: FloatArray) -> FloatArray:
    """Columns scaled to length one; empty ones stay empty."""
    lengths = np.linalg.norm(grid, axis=0)
    unit: FloatArray = np.divide(grid, lengths, out=np.zeros_like(grid), where=lengths > 0.0)
    return unit


def _correlated(one: FloatArray, other: FloatArray) -> FloatArray:
    """(sectors,) sums over all cells of ``one[:, c + shift] * other[:, c]``."""
    spectrum = np.fft.rfft(one, axis=1) * np.conj(np.fft.rfft(other, axis=1))
    sums: FloatArray = np.fft.irfft(spectrum.sum(axis=0), n=one.shape[1])
    return sums
