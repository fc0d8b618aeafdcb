"""A town laid out around a way of one's own, which may cross and repeat itself."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from loam_gtsam.datasets.sim.scenes import (
    DEEP,
    Kerb,
    Scene,
    distances_along,
    points_along,
    rolling_ground,
    solids_with_foliage,
)
from loam_gtsam.geometry import as_array
from loam_gtsam.types import FloatArray, InputError

_STREAM = 9
"""Number of the stream of random numbers; other scenes have lower ones."""
_STEP = 1.0
"""Metres between the points at which the way is looked at."""
_SPACING = 8.0
"""Metres between way points."""
_CLEAR = 5.0
"""Metres that houses keep from the way at least."""
_KERB = 2.8
"""Metres that cars, posts and trees keep from the way at least."""


def build_city(way: FloatArray, seed: int = 0) -> Scene:
    """Houses, parked cars, lamp posts and trees on both sides of a way.

    Nothing stands on the way, nor twice where it passes more than once.

    Parameters
    ----------
    way : (N, 2) x y of the path, metres, in the order in which it is driven
    seed : of the place

    Raises
    ------
    InputError
        If there are no two points 100 m apart along the way.
    """
    way = as_array(way, "way", ("N", 2))
    distances = distances_along(way)
    length = float(distances[-1])
    if not len(way) or length < 100.0:
        raise InputError("way: expected one of 100 m or more; give more points of it")
    way = way[np.concatenate([[True], np.diff(distances) > 0.0])]  # without stops

    def along(spacing: float) -> FloatArray:
        return points_along(way, np.linspace(0.0, length, int(length / spacing) + 1))

    path = along(_STEP)
    rng = np.random.default_rng([seed, 0, _STREAM])
    ground = rolling_ground(rng, (0.5, 0.35, 0.2), (150.0, 90.0, 60.0))
    roadside = _Roadside(path, rng)
    s = 6.0
    while s < length - 6.0:
        a, b = path[int((s - 4.0) / _STEP)], path[min(int((s + 4.0) / _STEP), len(path) - 1)]
        for left in (True, False):
            roadside.build(Kerb(a, b, left, ground))
        s += float(rng.uniform(9.0, 13.0))
    return Scene(
        name="city",
        solids=solids_with_foliage(roadside.boxes, roadside.cylinders, roadside.crowns, ground),
        waypoints=along(_SPACING),
    )


class _Roadside:
    """Things that stand beside a way, and nowhere on it.

    Attributes
    ----------
    boxes, cylinders, crowns : rows as :class:`~loam_gtsam.datasets.sim.raycast.Solids` has them
    """

    def __init__(self, path: FloatArray, rng: np.random.Generator) -> None:
        self._path, self._rng = cKDTree(path), rng
        self._houses: list[FloatArray] = []
        self.boxes: list[list[float]] = []
        self.cylinders: list[list[float]] = []
        self.crowns: list[list[float]] = []

    def build(self, kerb: Kerb) -> None:
        """A house, a post or tree, and a parked car along a kerb, as far as there is room."""
        width, setback, top = (self._between(*r) for r in ((8.0, 13.0), (8.0, 12.5), (5.0, 16.0)))
        chance = float(self._rng.random())
        middle = 0.5 * kerb.length
        self._add_house(kerb, middle, width, setback, top)
        x, y, z = kerb.place(middle, self._between(5.8, 7.0))
        if chance < 0.5 and self._is_free([x, y, 0.0, 0.3, 0.3, 1.0, 0.0], _KERB):
            self.cylinders.append([x, y, self._between(0.1, 0.22), z - DEEP, z + 5.0])
            if chance < 0.25:
                size = self._between(1.2, 1.9)
                self.crowns.append([x, y, z + 3.2 + size, size, size, size])
        car = kerb.box(middle - 2.1, middle + 2.1, 4.2, 6.0, 0.25, 1.3)
        if 0.3 < chance < 0.6 and self._is_free(car, _KERB):
            self.boxes.append(car)

    def _add_house(
        self, kerb: Kerb, middle: float, width: float, setback: float, top: float
    ) -> None:
        half = 0.5 * width
        house = kerb.box(middle - half, middle + half, setback, setback + 10.0, -DEEP, top)
        place = np.array(house[:2])
        near = [np.linalg.norm(other - place) for other in self._houses]
        if not self._is_free(house, _CLEAR) or min(near, default=np.inf) <= 9.0:
            return
        self._houses.append(place)
        self.boxes.append(house)
        for _ in range(int(self._rng.integers(1, 4))):  # porches, bays and pilasters
            at, out = self._between(-0.4, 0.35) * width, self._between(0.25, 0.9)
            end = middle + at + self._between(0.6, 2.2)
            low, high = ((-DEEP, top), (-DEEP, 2.6), (1.0, 4.5))[self._rng.integers(3)]
            self.boxes.append(kerb.box(middle + at, end, setback - out, setback, low, high))

    def _is_free(self, box: list[float], margin: float) -> bool:
        """Whether a box keeps away from the way."""
        x, y, _, half_x, half_y, _, yaw = box
        u, v = np.meshgrid(np.linspace(-half_x, half_x, 7), np.linspace(-half_y, half_y, 7))
        cosine, sine = np.cos(yaw), np.sin(yaw)
        outline = np.stack([x + cosine * u - sine * v, y + sine * u + cosine * v], axis=-1)
        return bool(self._path.query(outline.reshape(-1, 2))[0].min() > margin)

    def _between(self, low: float, high: float) -> float:
        return float(self._rng.uniform(low, high))
