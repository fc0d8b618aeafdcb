"""The places of the simulated world, deterministic from a seed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from loam_gtsam.datasets.sim.raycast import Ground, Solids
from loam_gtsam.types import FloatArray

DEEP = 3.0
"""Metres by which things reach below the ground they stand on, so that no slope shows a gap."""
CAR = (0.01, 0.006, 0.006, 0.002)
"""Sway of a car on an even surface: heave (m), roll, pitch and yaw (rad)."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A place and the way through it; metres, gravity-aligned world frame.

    Attributes
    ----------
    name : shown in descriptions
    solids : what the beams hit
    waypoints : (W, 2) x y on the smooth path of the sensor
    closed : whether the path returns to its first way point, to be driven round and round
    speed : m/s on a straight
    height : of the sensor above the ground
    sway : amplitudes of heave (m), roll, pitch and yaw (rad)
    frames : sweeps by default; None is once round, or to the end
    """

    name: str
    solids: Solids
    waypoints: FloatArray
    closed: bool = False
    speed: float = 10.0
    height: float = 1.8
    sway: tuple[float, float, float, float] = CAR
    frames: int | None = None


def build_room(seed: int) -> Scene:
    """A furnished room, 10 x 8 x 3 m, walked round slowly. The walls stand at |x| = 5, |y| = 4."""
    rng = np.random.default_rng([seed, 0, 1])
    boxes = [
        box(-6, -5, -5, 5, -1, 4),
        box(5, 6, -5, 5, -1, 4),
        box(-6, 6, -5, -4, -1, 4),
        box(-6, 6, 4, 5, -1, 4),
        box(-6, 6, -5, 5, 3.0, 4),
        box(-5, -4.6, -2.5, 0.5, 0, 2.0),  # shelf
        box(-1.5, 1.0, 3.5, 4, 0, 0.9),  # sideboard
        box(2.5, 3.6, -4, -3.6, 0, 2.1),  # cupboard
        box(4.55, 5, -1.0, 1.5, 0, 1.2),  # desk
        box(-5, -4.2, 3.2, 4, 0, 3.0),  # duct in a corner
        box(-0.8, 0.8, -0.4, 0.4, 0.68, 0.74),  # table in the middle
    ]
    boxes += [
        [x, y, rng.uniform(0.3, 0.6), 0.3, 0.25, 0.6, rng.uniform(0.0, np.pi)]
        for x, y in ((4.2, 3.2), (-3.6, -3.4), (0.3, -3.5), (2.9, 3.4))
    ]
    legs = [[x, y, 0.04, 0.0, 0.68] for x in (-0.7, 0.7) for y in (-0.3, 0.3)]
    pillars = [[-3.9, 2.0, 0.2, 0.0, 3.0], [3.7, -2.6, 0.15, 0.0, 3.0]]
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    return Scene(
        name="room",
        solids=Solids(boxes=np.array(boxes), cylinders=np.array(legs + pillars)),
        waypoints=np.stack([2.4 * np.cos(angle), 1.9 * np.sin(angle)], axis=1),
        closed=True,
        speed=0.8,
        height=1.3,
        sway=(0.02, 0.015, 0.015, 0.02),
        frames=60,
    )


def build_street_loop(seed: int) -> Scene:
    """Four streets round a city block (about 600 m): facades with bays, doors and gaps, parked
    cars, lamp posts and trees on gently rolling ground. Driven at 10 m/s, slower in the bends.
    """
    rng = np.random.default_rng([seed, 0, 2])
    half_x, half_y = 105.0, 55.0
    ground = rolling_ground(rng, (0.5, 0.35, 0.2), (150.0, 90.0, 60.0))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (half_x, half_y)
    sides = (
        (rng, Kerb(corner, following, inside, ground), inside, inside)
        for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        for inside in (True, False)  # the block inside the loop lies to the left
    )
    return Scene(
        name="street_loop",
        solids=build_streets(sides, ground),
        waypoints=_rounded_rectangle(half_x, half_y, radius=16.0, wander=0.6),
        closed=True,
    )


def build_trees(seed: int) -> Scene:
    """Open woodland on slopes: trunks, crowns, rocks, no wall anywhere."""
    rng = np.random.default_rng([seed, 0, 3])
    ground = rolling_ground(rng, (1.8, 0.9, 0.2, 0.05), (80.0, 47.0, 16.0, 5.0))
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    radius = 42.0 + 7.0 * np.sin(2.0 * angle + 0.5) + 4.0 * np.sin(3.0 * angle)
    path = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    fine = np.concatenate([path + f * (np.roll(path, -1, axis=0) - path) for f in (0.0, 0.5)])

    def clear(candidates: FloatArray, margin: float) -> FloatArray:
        gaps = np.linalg.norm(candidates[:, None, :] - fine[None], axis=2).min(axis=1)
        kept: FloatArray = candidates[gaps > margin]
        return kept

    trunks = clear(rng.uniform(-110.0, 110.0, (700, 2)), 4.0)
    thick = rng.uniform(0.08, 0.32, len(trunks))
    z = ground.height(*trunks.T)
    bole = rng.uniform(2.5, 5.0, len(trunks))
    wide, tall = rng.uniform(0.9, 1.8, len(trunks)), rng.uniform(1.2, 2.6, len(trunks))
    crowns = np.column_stack([trunks, z + bole + 0.7 * tall, wide, wide, tall])
    rocks_at = clear(rng.uniform(-100.0, 100.0, (150, 2)), 3.5)
    rock_size = rng.uniform(0.3, 1.2, (len(rocks_at), 3))
    rocks = np.column_stack([rocks_at, ground.height(*rocks_at.T), rock_size])
    foliage = np.zeros(len(crowns) + len(rocks), np.bool_)
    foliage[: len(crowns)] = True
    return Scene(
        name="trees",
        solids=Solids(
            cylinders=np.column_stack([trunks, thick, z - DEEP, z + bole + tall]),
            ellipsoids=np.vstack([crowns, rocks]),
            foliage=foliage,
            ground=ground,
        ),
        waypoints=path,
        closed=True,
        speed=3.0,
        height=1.2,
        sway=(0.02, 0.02, 0.02, 0.005),
        frames=400,
    )


def build_corridor(seed: int) -> Scene:
    """A corridor of 320 m with doors in recesses, pillars and cupboards at irregular distances."""
    rng = np.random.default_rng([seed, 0, 4])
    boxes = _shell()
    cylinders = []
    for side in (1.0, -1.0):
        s = 3.0
        while s < _CORRIDOR - 4.0:
            # The wall of the shell is 0.2 m behind the panels; what they leave free is a door.
            panel = float(rng.uniform(3.0, 14.0))
            boxes.append(box(s, min(s + panel, _CORRIDOR), side * 1.5, side * 1.7, -1, 4))
            s += panel + float(rng.uniform(0.9, 1.8))
        for s in np.arange(8.0, _CORRIDOR - 8.0, 17.0) + rng.uniform(-4.0, 4.0, 18):
            if rng.random() < 0.5:
                cylinders.append([s, side * 1.35, 0.15, 0.0, 2.8])
            else:
                boxes.append(box(s, s + 0.8, side * 1.15, side * 1.5, 0.0, 1.9))
    return _in_corridor("corridor", Solids(boxes=np.array(boxes), cylinders=np.array(cylinders)))


def build_corridor_bare(seed: int) -> Scene:
    """The corridor with nothing in it: between its ends no beam tells how far along one is."""
    del seed  # nothing here is random
    return _in_corridor("corridor_bare", Solids(boxes=np.array(_shell())))


def build_shaken(seed: int) -> Scene:
    """The room, its sensor shaken as in a careless hand: 2 rad/s in yaw, 0.15 rad of roll and pitch
    at 1 to 2 Hz.
    """
    return replace(build_room(seed), name="shaken", sway=(0.03, 0.15, 0.15, 0.31), frames=120)


def build_slopes(seed: int) -> Scene:
    """A winding road over a hill and through a dip 16 m below it, at grades up to 12 %.

    Houses line its first half, trees and rocks the second. It starts on the slope, so that a map
    in the frame of the first pose is tilted by 5 degrees.
    """
    rng = np.random.default_rng([seed, 0, 5])
    # The third harmonic makes the grade more even, and so the climb longer at the same grade.
    number, amplitude, phase = 2.0 * np.pi / _HILL, 7.2, -0.25 * np.pi
    waves = [[amplitude, number, 0.0, phase], [-amplitude / 9.0, 3.0 * number, 0.0, 3.0 * phase]]
    ground = Ground(np.vstack([waves, rolling_ground(rng, (0.25, 0.08), (130.0, 60.0)).waves]))
    bends = np.array(
        [[0, 0], [80, 14], [175, -6], [265, 16], [350, 0], [400, -4]], dtype=np.float64
    )
    legs = [(Kerb(a, b, left, ground), left) for a, b in pairwise(bends) for left in (True, False)]
    boxes: list[list[float]] = []
    posts: list[list[float]] = []
    trunks: list[list[float]] = []
    crowns: list[list[float]] = []
    stones: list[list[float]] = []
    for kerb, inside in legs[:4]:
        boxes += facades(rng, kerb, inside, inside)
        for s in np.arange(9.0, kerb.length - 8.0, 12.0) + rng.uniform(0.0, 4.0):
            x, y, z = kerb.place(s, 6.8)
            posts.append([x, y, 0.1, z - DEEP, z + 6.0])
    for kerb, _ in legs[4:]:
        for s in np.arange(2.0, kerb.length, 2.2):
            x, y, z = kerb.place(s, float(rng.uniform(6.0, 40.0)))
            if rng.random() < 0.25:
                stones.append([x, y, z, *rng.uniform(0.4, 1.6, 3)])
            else:
                top, wide = z + rng.uniform(4.0, 7.0), rng.uniform(1.0, 2.0)
                trunks.append([x, y, rng.uniform(0.1, 0.35), z - DEEP, top])
                crowns.append([x, y, top, wide, wide, rng.uniform(1.2, 2.4)])
    along = np.arange(8.0, 392.0, 8.0)
    across = np.interp(along, bends[:, 0], bends[:, 1])
    return Scene(
        name="slopes",
        solids=Solids(
            np.array(boxes),
            np.array(posts + trunks),
            np.array(crowns + stones),
            np.arange(len(crowns) + len(stones)) < len(crowns),
            ground,
        ),
        waypoints=np.stack([along, gaussian_filter1d(across, 2.0, mode="nearest")], axis=1),
        speed=8.0,
    )


BUILDERS: dict[str, Callable[[int], Scene]] = {
    "room": build_room,
    "street_loop": build_street_loop,
    "trees": build_trees,
    "corridor": build_corridor,
    "corridor_bare": build_corridor_bare,
    "slopes": build_slopes,
    "shaken": build_shaken,
}

_CORRIDOR = 320.0
"""Metres."""
_HILL = 390.0
"""Metres from crest to crest of the road over the slopes."""


class Kerb:
    """One side of a street, from one corner to the next: s along it, d away from its middle."""

    def __init__(
        self, corner: FloatArray, following: FloatArray, left: bool, ground: Ground
    ) -> None:
        self.length = float(np.linalg.norm(following - corner))
        self._corner, self._ground = corner, ground
        self._along = (following - corner) / self.length
        self._away = np.array([-self._along[1], self._along[0]]) * (1.0 if left else -1.0)
        self._yaw = float(np.arctan2(self._along[1], self._along[0]))

    def place(self, s: float, d: float) -> tuple[float, float, float]:
        """A point on the ground."""
        at = self._corner + s * self._along + d * self._away
        return float(at[0]), float(at[1]), float(self._ground.height(at[:1], at[1:])[0])

    def box(
        self, s0: float, s1: float, d0: float, d1: float, low: float, top: float
    ) -> list[float]:
        """A box between these, its heights counted from the ground under its middle."""
        x, y, z = self.place(0.5 * (s0 + s1), 0.5 * (d0 + d1))
        half = [0.5 * (s1 - s0), 0.5 * (d1 - d0), 0.5 * (top - low)]
        return [x, y, z + 0.5 * (low + top), *half, self._yaw]


def build_streets(
    sides: Iterable[tuple[np.random.Generator, Kerb, bool, bool]], ground: Ground
) -> Solids:
    """Houses, cars, lamp posts and trees along sides of streets.

    Parameters
    ----------
    sides : of each its random numbers, its kerb, and whether it is the inner side of the bends at
        its two ends
    """
    boxes: list[list[float]] = []
    cylinders: list[list[float]] = []
    crowns: list[list[float]] = []
    for rng, kerb, begins_inside, ends_inside in sides:
        boxes += facades(rng, kerb, begins_inside, ends_inside)
        cars, posts, trees = furniture(rng, kerb)
        boxes += cars
        cylinders += posts
        crowns += trees
    return solids_with_foliage(boxes, cylinders, crowns, ground)


def solids_with_foliage(
    boxes: list[list[float]],
    cylinders: list[list[float]],
    crowns: list[list[float]],
    ground: Ground,
) -> Solids:
    """Solids of which all the crowns are foliage."""
    foliage = np.ones(len(crowns), np.bool_)
    return Solids(np.array(boxes), np.array(cylinders), np.array(crowns), foliage, ground)


def facades(
    rng: np.random.Generator, kerb: Kerb, begins_inside: bool, ends_inside: bool
) -> list[list[float]]:
    """Houses of different width, setback and height, with pilasters, porches and bay windows;
    from corner to corner, of which the kerb is on the inside or the outside.
    """
    boxes = []
    s = 15.0 if begins_inside else -14.0
    end = kerb.length - (15.0 if ends_inside else -14.0)
    while s < end - 6.0:
        width = min(float(rng.uniform(9.0, 22.0)), end - s)
        setback, top = float(rng.uniform(8.5, 12.5)), float(rng.uniform(5.0, 18.0))
        boxes.append(kerb.box(s, s + width, setback, setback + 12.0, -DEEP, top))
        for bay in np.arange(s + 1.5, s + width - 3.0, rng.uniform(3.5, 6.0)):
            out, wide = float(rng.uniform(0.25, 0.9)), float(rng.uniform(0.6, 2.2))
            low, high = ((-DEEP, top), (-DEEP, 2.6), (1.0, 4.5))[rng.integers(3)]
            boxes.append(kerb.box(bay, bay + wide, setback - out, setback, low, high))
        alley = rng.random() < 0.3
        s += width + (float(rng.uniform(3.0, 8.0)) if alley else 0.0)
    return boxes


def furniture(
    rng: np.random.Generator, kerb: Kerb
) -> tuple[list[list[float]], list[list[float]], list[list[float]]]:
    """Rows of parked cars (boxes), of lamp posts and trunks (cylinders) and of crowns."""
    cars, posts, crowns = [], [], []
    for s in np.arange(22.0, kerb.length - 24.0, 6.5):
        if rng.random() < 0.45:  # body and cabin
            near = 4.4 + float(rng.uniform(0.0, 0.3))
            cars.append(kerb.box(s, s + 4.3, near, near + 1.8, 0.25, 0.85))
            cars.append(kerb.box(s + 1.0, s + 3.4, near + 0.15, near + 1.65, 0.85, 1.45))
    for s in np.arange(18.0, kerb.length - 16.0, 11.0) + rng.uniform(0.0, 4.0):
        x, y, z = kerb.place(s, 7.2)
        if rng.random() < 0.5:  # a lamp post
            posts.append([x, y, 0.1, z - DEEP, z + 7.0])
        else:
            posts.append([x, y, rng.uniform(0.12, 0.25), z - DEEP, z + 4.0])
            size = rng.uniform(1.2, 1.9)
            crowns.append([x, y, z + 3.0 + size, size, size, rng.uniform(1.2, 2.2)])
    return cars, posts, crowns


def _shell() -> list[list[float]]:
    """Walls at |y| = 1.7, ceiling at 2.8 and ends of a corridor."""
    return [
        box(-2, _CORRIDOR + 2, 1.7, 2.7, -1, 4),
        box(-2, _CORRIDOR + 2, -2.7, -1.7, -1, 4),
        box(-2, _CORRIDOR + 2, -2, 2, 2.8, 4),
        box(-2, 0, -2, 2, -1, 4),
        box(_CORRIDOR, _CORRIDOR + 2, -2, 2, -1, 4),
    ]


def _in_corridor(name: str, solids: Solids) -> Scene:
    along = np.arange(6.0, _CORRIDOR - 4.0, 8.0)
    return Scene(
        name=name,
        solids=solids,
        waypoints=np.stack([along, 0.25 * np.sin(along / 13.0)], axis=1),
        speed=5.0,
        height=1.1,
        sway=(0.005, 0.006, 0.006, 0.004),
    )


def box(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float) -> list[float]:
    """Row of ``Solids.boxes`` between two corners."""
    centre = [0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (z0 + z1)]
    return [*centre, 0.5 * abs(x1 - x0), 0.5 * abs(y1 - y0), 0.5 * abs(z1 - z0), 0.0]


def rolling_ground(
    rng: np.random.Generator, amplitudes: tuple[float, ...], wavelengths: tuple[float, ...]
) -> Ground:
    """One wave each, in random directions."""
    direction = rng.uniform(0.0, 2.0 * np.pi, len(amplitudes))
    number = 2.0 * np.pi / np.array(wavelengths)
    phase = rng.uniform(0.0, 2.0 * np.pi, len(amplitudes))
    return Ground(
        np.column_stack([amplitudes, number * np.cos(direction), number * np.sin(direction), phase])
    )


def distances_along(way: FloatArray) -> FloatArray:
    """(N,) metres from the first of (N, 2) points to each, along straight lines between them."""
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
    distances: FloatArray = np.concatenate([[0.0], np.cumsum(steps)])
    return distances


def points_along(way: FloatArray, metres: FloatArray) -> FloatArray:
    """(M, 2) points so far along a way of (N, 2) points, of which no two in a row are the same."""
    distances = distances_along(way)
    return np.stack([np.interp(metres, distances, way[:, k]) for k in (0, 1)], axis=1)


def _rounded_rectangle(half_x: float, half_y: float, radius: float, wander: float) -> FloatArray:
    """Counter-clockwise way points about 8 m apart, from the middle of the lower side."""
    corners = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * (half_x - radius, half_y - radius)
    arc = np.linspace(-0.5 * np.pi, 0.0, 5)
    pieces = [np.array([[0.0, -half_y]])]
    for k, centre in enumerate(corners):
        angle = arc + 0.5 * np.pi * k
        pieces.append(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    rough = np.vstack([*pieces, pieces[0]])
    # Fill the straights, then let the driver wander a little within the lane.
    length = distances_along(rough)[-1]
    step = np.linspace(0.0, length, int(length / 8.0), endpoint=False)
    way = points_along(rough, step)
    swing = wander * np.sin(2.0 * np.pi * 7.0 * step / length)
    tangent = np.roll(way, -1, axis=0) - np.roll(way, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    shifted: FloatArray = way + swing[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    return shifted
