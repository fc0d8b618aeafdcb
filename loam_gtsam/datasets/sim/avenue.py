"""A way of any length through a town, for runs that must not grow with it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from loam_gtsam.datasets.sim.scenes import Kerb, Scene, build_streets, points_along, rolling_ground
from loam_gtsam.types import ConfigError, FloatArray

_STREAM = 8
"""Number of the stream of random numbers; other scenes have lower ones."""
_EAST, _ACROSS = (150.0, 380.0), (90.0, 200.0)
"""Metres of the streets that lead east and of those that lead north or south."""
_RADIUS = 16.0
"""Metres, of the way round a corner."""
_START = 20.0
"""Metres into the first street at which the way begins."""
_SPACING = 8.0
"""Metres between way points, about."""
_SHORTEST = 100.0
"""Metres."""


def build_avenue(seed: int, metres: float = 1000.0) -> Scene:
    """Streets of a town, each at right angles to the one before, two of three metres to the east.

    No street is met twice. A longer way begins with the same streets.

    Parameters
    ----------
    seed : of streets and houses
    metres : length of the way, 100 or more

    Raises
    ------
    ConfigError
        If the way is too short for a start and an end.
    """
    if not _SHORTEST <= metres < np.inf:
        raise ConfigError(f"metres: expected at least {_SHORTEST:g}, got {metres!r}")
    rng = np.random.default_rng([seed, 0, _STREAM])
    ground = rolling_ground(rng, (0.5, 0.35, 0.2), (150.0, 90.0, 60.0))
    corners = _corners(rng, metres)
    steps = np.diff(corners, axis=0)
    turns = np.sign(steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0])
    turns = np.concatenate([turns[:1], turns, turns[-1:]])
    sides: list[tuple[np.random.Generator, Kerb, bool, bool]] = []
    for number, (corner, following) in enumerate(pairwise(corners)):
        rng = np.random.default_rng([seed, 1 + number, _STREAM])  # whatever the length
        for side in (1.0, -1.0):
            kerb = Kerb(corner, following, side > 0.0, ground)
            sides.append((rng, kerb, side == turns[number], side == turns[number + 1]))
    return Scene(
        name="avenue", solids=build_streets(sides, ground), waypoints=_way(corners, metres)
    )


BUILDERS: dict[str, Callable[[int], Scene]] = {"avenue": build_avenue}


def _corners(rng: np.random.Generator, metres: float) -> FloatArray:
    """(C, 2) where streets meet; the last street is beyond the end of the way."""
    corners, length = [np.zeros(2)], -_START
    while length < metres or len(corners) < 4:
        east = np.array([rng.uniform(*_EAST), 0.0])
        across = np.array([0.0, rng.uniform(*_ACROSS) * rng.choice([-1.0, 1.0])])
        for step in (east, across):
            corners.append(corners[-1] + step)
            length += float(np.linalg.norm(step)) - 2.0 * _RADIUS * (1.0 - 0.25 * np.pi)
    corners.append(corners[-1] + (_EAST[1], 0.0))
    return np.array(corners)


def _way(corners: FloatArray, metres: float) -> FloatArray:
    """(W, 2) way points, rounding the corners."""
    steps = np.diff(corners, axis=0)
    along = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    pieces = [corners[:1] + _START * along[0]]
    angle = np.linspace(0.0, 0.5 * np.pi, 5)[:, None]
    for corner, before, after in zip(corners[1:-1], along, along[1:], strict=False):
        centre = corner + _RADIUS * (after - before)
        pieces.append(centre + _RADIUS * (np.sin(angle) * before - np.cos(angle) * after))
    return points_along(np.vstack(pieces), np.linspace(0.0, metres, int(metres / _SPACING) + 1))
