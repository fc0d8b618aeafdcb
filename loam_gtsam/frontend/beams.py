"""Errors of single beams, as ``sensor.beams`` tells them, are taken from the points of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.config.base import BeamRow
from loam_gtsam.frontend.organise import OrganisedSweep
from loam_gtsam.types import FloatArray, IntArray, SweepError, SweepFault


class Rays(NamedTuple):
    """How points move with errors of their beams, each (N, 3) and in the frame of the lidar.

    Attributes
    ----------
    by_range : unit vectors, by each metre of range
    by_elevation, by_azimuth : metres, by each rad
    """

    by_range: FloatArray
    by_elevation: FloatArray
    by_azimuth: FloatArray

    @classmethod
    def of(cls, points: NDArray[np.floating]) -> Rays:
        """Of points (N, 3), metres; those on the axis of the lidar have no azimuth."""
        x, y, z = np.asarray(points, np.float64).T
        flat = np.maximum(np.hypot(x, y), 1e-9)
        ranges = np.hypot(flat, z)
        by_range = np.stack((x, y, z)) / ranges
        by_elevation = np.stack((-z * x / flat, -z * y / flat, flat))
        return cls(by_range.T, by_elevation.T, np.stack((-y, x, np.zeros_like(x))).T)


def elevations_of(xyz: NDArray[np.float32], ring_starts: IntArray) -> FloatArray:
    """(R,) mean elevations of rings, rad, of points (3, N) that lie ring after ring."""
    slopes = xyz[2] / np.maximum(np.hypot(xyz[0], xyz[1]), np.float32(1e-6))
    sums = np.add.reduceat(slopes, ring_starts[:-1], dtype=np.float64)
    means: FloatArray = np.arctan(sums / np.diff(ring_starts))
    return means


def half_way(elevations: FloatArray) -> float:
    """Half of the usual step between beams at (R,) elevations; no limit for a single one."""
    return 0.5 * float(np.median(np.diff(np.sort(elevations)))) if len(elevations) > 1 else np.inf


def errors_at(elevations: FloatArray, beams: Sequence[BeamRow]) -> FloatArray:
    """(R, 3) errors of range, elevation and azimuth of rings at (R,) elevations: metres, rad, rad.

    A row of ``beams`` has the elevation of a beam, degrees, by how much its ranges are too long,
    metres, and its elevations and azimuths too large, degrees. It is for rings no farther from it
    than half way to the next; others have no errors.
    """
    table = np.array(sorted(beams), np.float64).reshape(-1, 4)
    if not len(table):
        return np.zeros((len(elevations), 3))
    away = np.abs(np.degrees(elevations)[:, None] - table[:, 0])
    errors = table[away.argmin(axis=1), 1:]
    errors[:, 1:] = np.radians(errors[:, 1:])
    return np.where((away.min(axis=1) <= half_way(table[:, 0]))[:, None], errors, 0.0)


def without_beam_errors(sweep: OrganisedSweep, beams: Sequence[BeamRow]) -> OrganisedSweep:
    """The sweep without the :func:`errors <errors_at>` of its beams.

    Raises
    ------
    SweepError
        If there are no rings.
    """
    if not beams:
        return sweep
    if not sweep.rings.known:
        raise SweepError(
            f"sensor.beams tells errors of {len(beams)} beams, but there are {sweep.rings.note}; "
            "set sensor.rings, or leave sensor.beams out",
            SweepFault.BAD_RINGS,
        )
    errors = errors_at(elevations_of(sweep.xyz, sweep.ring_starts), beams)
    each = np.repeat(errors, np.diff(sweep.ring_starts), axis=0)
    return replace(sweep, xyz=moved(sweep.xyz.T, -each).T.astype(np.float32))


def moved(points: NDArray[np.floating], errors: FloatArray) -> FloatArray:
    """Points (N, 3) with errors (N, 3) of range, elevation and azimuth: metres, rad and rad."""
    x, y, z = np.asarray(points, np.float64).T
    ranges = np.sqrt(x * x + y * y + z * z) + errors[:, 0]
    elevation = np.arctan2(z, np.hypot(x, y)) + errors[:, 1]
    azimuth = np.arctan2(y, x) + errors[:, 2]
    flat = ranges * np.cos(elevation)
    parts = flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(elevation)
    return np.ascontiguousarray(np.stack(parts, axis=1))
