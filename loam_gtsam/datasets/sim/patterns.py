"""Lidars that do not sweep rings: where their beams point, point by point.

Fields of view, rates and numbers of beams are those of the data sheets, and so are the turn rates
of the prisms of the Avia (Livox, Mid-40 and Avia user manuals); how the mirror of a Mid-360 moves
is not published, and made up so that sweeps fill its field unlike each other, as they do.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loam_gtsam.types import FloatArray, IntArray

_PRISMS = 121.57, -77.74
"""Turns a second of the two prisms of an Avia."""
_AVIA_FIELD = 35.2, 38.6
"""Degrees, half the field of view across and up."""
_AVIA_BEAMS = 6
_BETWEEN_BEAMS = 0.9  # degrees, between the beams of an Avia
_MID360_FIELD = 22.5, 29.5
"""Degrees: middle and half of the field of view, up."""
_MID360_BEAMS = 4
_MID360_TURNS = 20.274  # a second, and no multiple of the sweeps: each is another
_MID360_NODS = 733.31  # a second


def _avia(seconds: FloatArray, firing: IntArray) -> tuple[FloatArray, FloatArray]:
    """Azimuths and elevations in degrees."""
    one, other = (2.0 * np.pi * turns * seconds for turns in _PRISMS)
    across, up = _AVIA_FIELD
    apart = firing % _AVIA_BEAMS - 0.5 * (_AVIA_BEAMS - 1)
    azimuth = across * 0.5 * (np.cos(one) + np.cos(other))
    return azimuth, up * 0.5 * (np.sin(one) + np.sin(other)) + _BETWEEN_BEAMS * apart


def _mid360(seconds: FloatArray, firing: IntArray) -> tuple[FloatArray, FloatArray]:
    """Azimuths and elevations in degrees."""
    beam, (middle, half) = firing % _MID360_BEAMS, _MID360_FIELD
    nod = np.sin(2.0 * np.pi * _MID360_NODS * seconds + 0.7 * beam)
    azimuth = 360.0 * (_MID360_TURNS * seconds + beam / _MID360_BEAMS)
    return azimuth, middle + half * (2.0 / np.pi) * np.arcsin(nod)


PATTERNS: dict[str, tuple[Callable[..., tuple[FloatArray, FloatArray]], int]] = {
    "avia": (_avia, 24_000),
    "mid360": (_mid360, 20_000),
}
"""Livox lidars: how their beams move, and points in a sweep of 0.1 s."""


def unit_vectors(azimuth: FloatArray, elevation: FloatArray) -> FloatArray:
    """(3, ...) directions of angles in rad, of shapes that go together."""
    level, up = np.cos(elevation), np.sin(elevation)
    across = np.cos(azimuth) * level, np.sin(azimuth) * level
    return np.stack([*across, np.broadcast_to(up, across[0].shape)])


def fired(pattern: str, count: int, start: float, duration: float) -> tuple[FloatArray, FloatArray]:
    """The beams of one sweep, clockwise from straight behind.

    Parameters
    ----------
    pattern : one of :data:`PATTERNS`
    count : of points
    start : seconds since the first sweep; no two sweeps are alike
    duration : seconds

    Returns
    -------
    directions : (3, count, 1) unit vectors
    times : (count,) seconds from the start of the sweep
    """
    firing = np.arange(count)
    times = duration * firing / count
    azimuth, elevation = map(np.deg2rad, PATTERNS[pattern][0](start + times, firing))
    beams = unit_vectors(azimuth, elevation)
    around = np.argsort(-np.arctan2(beams[1], beams[0]), kind="stable")
    return beams[:, around, None], times[around]
