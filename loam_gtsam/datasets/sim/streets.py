"""Streets with houses, cars, lamp posts and trees, along a way of any kind."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from loam_gtsam.datasets.sim.raycast import Ground, Solids
from loam_gtsam.datasets.sim.ways import distances_along, points_along
from loam_gtsam.geometry import as_array
from loam_gtsam.types import ConfigError, FloatArray, InputError

DEEP = 3.0
"""Metres by which things reach below the ground they stand on, so that no slope shows a gap."""
CAR = (0.01, 0.006, 0.006, 0.002)
"""Sway of a car on an even surface: heave (m), roll, pitch and yaw (rad)."""
_RADIUS = 16.0  # metres, of the way round a corner
_SPACING = 8.0  # metres between way points, about
_SHORTEST = 100.0  # metres, of a way with a start and an end
_HILL = 390.0  # metres from crest to crest of the road over the slopes
_AVENUE_STREAM, _CITY_STREAM = 8, 9
"""Numbers of the streams of random numbers; other scenes have lower ones."""
_EAST, _ACROSS, _START = (150.0, 380.0), (90.0, 200.0), 20.0
"""Metres of the avenue's streets to the east, and of those to the north or south; metres into the
first street at which its way begins."""
_STEP, _CLEAR, _KERB = 1.0, 5.0, 2.8
"""Metres between the points at which a city's way is looked at; metres that its houses, and that
its cars, posts and trees, keep from the way at least."""

_Row = list[float]
Rows = list[_Row]
"""Rows as :class:`~loam_gtsam.datasets.sim.raycast.Solids` has them."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A place and the way through it; metres, gravity-aligned world frame.

    Attributes
    ----------
    name : shown in descriptions
    solids : what the beams hit
    waypoints : (W, 2) x y on the smooth path of the sensor; or (W, 3) x y z of the sensor itself,
        which then does not follow the ground: on stairs, on a bridge
    closed : whether the path returns to its first way point, to be driven round and round
    speed : m/s on a straight
    height : of the sensor above the ground, where the way points have no z
    sway : amplitudes of heave (m), roll, pitch and yaw (rad)
    frames : sweeps by default; None is once round, or to the end
    bends : metres between the knots of the path, short where bends are narrow
    """

    name: str
    solids: Solids
    waypoints: FloatArray
    closed: bool = False
    speed: float = 10.0
    height: float = 1.8
    sway: tuple[float, float, float, float] = CAR
    frames: int | None = None
    bends: float = 2.0


class Kerb:
    """One side of a street, from one corner to the next: s along it, d away from its middle."""

    def __init__(self, corner: FloatArray, following: FloatArray, left: bool, ground: Ground):
        self.length = float(np.linalg.norm(following - corner))
        self._corner, self._ground = corner, ground
        self._along = (following - corner) / self.length
        self._away = np.array([-self._along[1], self._along[0]]) * (1.0 if left else -1.0)
        self._yaw = float(np.arctan2(self._along[1], self._along[0]))

    def place(self, s: float, d: float) -> tuple[float, float, float]:
        """A point on the ground."""
        at = self._corner + s * self._along + d * self._away
        return float(at[0]), float(at[1]), float(self._ground.height(at[:1], at[1:])[0])

    def box(self, s0: float, s1: float, d0: float, d1: float, low: float, top: float) -> _Row:
        """A box between these, its heights counted from the ground under its middle."""
        x, y, z = self.place(0.5 * (s0 + s1), 0.5 * (d0 + d1))
        half = [0.5 * (s1 - s0), 0.5 * (d1 - d0), 0.5 * (top - low)]
        return [x, y, z + 0.5 * (low + top), *half, self._yaw]

    def bay(self, s: float, end: float, setback: float, out: float, top: float, kind: int) -> _Row:
        """A pilaster, a porch or a bay window before a house."""
        low, high = ((-DEEP, top), (-DEEP, 2.6), (1.0, 4.5))[kind]
        return self.box(s, end, setback - out, setback, low, high)


@dataclass
class Street:
    """Things that stand along streets, as rows of :class:`Solids`."""

    boxes: Rows = field(default_factory=list)
    cylinders: Rows = field(default_factory=list)
    crowns: Rows = field(default_factory=list)
    stones: Rows = field(default_factory=list)

    def solids(self, ground: Ground) -> Solids:
        """All of them on the ground; only the crowns are foliage."""
        round_ones = np.array(self.crowns + self.stones)
        foliage = np.arange(len(round_ones)) < len(self.crowns)
        return Solids(np.array(self.boxes), np.array(self.cylinders), round_ones, foliage, ground)

    def add_post(self, at: tuple[float, float, float], radius: float, height: float) -> None:
        """A lamp post or a trunk."""
        x, y, z = at
        self.cylinders.append([x, y, radius, z - DEEP, z + height])

    def add_houses(
        self, rng: np.random.Generator, kerb: Kerb, begins_inside: bool, ends_inside: bool
    ) -> None:
        """Houses of all sizes between two corners, inside or outside of which the kerb runs."""
        s = 15.0 if begins_inside else -14.0
        end = kerb.length - (15.0 if ends_inside else -14.0)
        while s < end - 6.0:
            width = min(float(rng.uniform(9.0, 22.0)), end - s)
            setback, top = float(rng.uniform(8.5, 12.5)), float(rng.uniform(5.0, 18.0))
            self.boxes.append(kerb.box(s, s + width, setback, setback + 12.0, -DEEP, top))
            for bay in np.arange(s + 1.5, s + width - 3.0, rng.uniform(3.5, 6.0)):
                out, wide = float(rng.uniform(0.25, 0.9)), float(rng.uniform(0.6, 2.2))
                kind = int(rng.integers(3))
                self.boxes.append(kerb.bay(bay, bay + wide, setback, out, top, kind))
            alley = rng.random() < 0.3
            s += width + (float(rng.uniform(3.0, 8.0)) if alley else 0.0)

    def add_furniture(self, rng: np.random.Generator, kerb: Kerb) -> None:
        """Parked cars, lamp posts and trees."""
        for s in np.arange(22.0, kerb.length - 24.0, 6.5):
            if rng.random() < 0.45:  # body and cabin
                near = 4.4 + float(rng.uniform(0.0, 0.3))
                self.boxes.append(kerb.box(s, s + 4.3, near, near + 1.8, 0.25, 0.85))
                self.boxes.append(kerb.box(s + 1.0, s + 3.4, near + 0.15, near + 1.65, 0.85, 1.45))
        for s in np.arange(18.0, kerb.length - 16.0, 11.0) + rng.uniform(0.0, 4.0):
            x, y, z = at = kerb.place(s, 7.2)
            if rng.random() < 0.5:  # a lamp post
                self.add_post(at, 0.1, 7.0)
            else:
                self.add_post(at, rng.uniform(0.12, 0.25), 4.0)
                size = rng.uniform(1.2, 1.9)
                self.crowns.append([x, y, z + 3.0 + size, size, size, rng.uniform(1.2, 2.2)])


def build_street_loop(seed: int) -> Scene:
    """Four streets round a city block (about 600 m), driven at 10 m/s, slower in the bends."""
    rng = np.random.default_rng([seed, 0, 2])
    half_x, half_y = 105.0, 55.0
    ground, street = street_ground(rng), Street()
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (half_x, half_y)
    for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        for inside in (True, False):  # the block inside the loop lies to the left
            kerb = Kerb(corner, following, inside, ground)
            street.add_houses(rng, kerb, inside, inside)
            street.add_furniture(rng, kerb)
    return Scene(
        name="street_loop",
        solids=street.solids(ground),
        waypoints=_rounded_rectangle(half_x, half_y, radius=_RADIUS, wander=0.6),
        closed=True,
    )


def build_slopes(seed: int) -> Scene:
    """A winding road over a hill and through a dip 16 m below it, at grades up to 12 %.

    It starts on the slope: a map in the frame of the first pose is tilted by 5 degrees.
    """
    rng = np.random.default_rng([seed, 0, 5])
    # The third harmonic makes the grade more even, and so the climb longer at the same grade.
    number, amplitude, phase = 2.0 * np.pi / _HILL, 7.2, -0.25 * np.pi
    waves = [[amplitude, number, 0.0, phase], [-amplitude / 9.0, 3.0 * number, 0.0, 3.0 * phase]]
    ground = Ground(np.vstack([waves, rolling_ground(rng, (0.25, 0.08), (130.0, 60.0)).waves]))
    bends = np.array([[0.0, 0], [80, 14], [175, -6], [265, 16], [350, 0], [400, -4]])
    legs = [(Kerb(a, b, left, ground), left) for a, b in pairwise(bends) for left in (True, False)]
    street = Street()
    for kerb, inside in legs[:4]:
        street.add_houses(rng, kerb, inside, inside)
        for s in np.arange(9.0, kerb.length - 8.0, 12.0) + rng.uniform(0.0, 4.0):
            street.add_post(kerb.place(s, 6.8), 0.1, 6.0)
    for kerb, _ in legs[4:]:
        for s in np.arange(2.0, kerb.length, 2.2):
            x, y, z = at = kerb.place(s, float(rng.uniform(6.0, 40.0)))
            if rng.random() < 0.25:
                street.stones.append([x, y, z, *rng.uniform(0.4, 1.6, 3)])
            else:
                tall, wide = rng.uniform(4.0, 7.0), rng.uniform(1.0, 2.0)
                street.add_post(at, rng.uniform(0.1, 0.35), tall)
                street.crowns.append([x, y, z + tall, wide, wide, rng.uniform(1.2, 2.4)])
    along = np.arange(8.0, 392.0, 8.0)
    across = np.interp(along, bends[:, 0], bends[:, 1])
    return Scene(
        name="slopes",
        solids=street.solids(ground),
        waypoints=np.stack([along, gaussian_filter1d(across, 2.0, mode="nearest")], axis=1),
        speed=8.0,
    )


def build_avenue(seed: int, metres: float = 1000.0) -> Scene:
    """Streets of a town, each at right angles to the one before, two of three metres to the east.

    No street is met twice; a way of more ``metres`` begins with the same streets. ConfigError if it
    is shorter than 100 m.
    """
    if not _SHORTEST <= metres < np.inf:
        raise ConfigError(f"metres: expected at least {_SHORTEST:g}, got {metres!r}")
    rng = np.random.default_rng([seed, 0, _AVENUE_STREAM])
    ground, street = street_ground(rng), Street()
    corners = _corners(rng, metres)
    steps = np.diff(corners, axis=0)
    turns = np.sign(steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0])
    turns = np.concatenate([turns[:1], turns, turns[-1:]])
    for number, (corner, following) in enumerate(pairwise(corners)):
        rng = np.random.default_rng([seed, 1 + number, _AVENUE_STREAM])  # whatever the length
        for side in (1.0, -1.0):
            kerb = Kerb(corner, following, side > 0.0, ground)
            street.add_houses(rng, kerb, side == turns[number], side == turns[number + 1])
            street.add_furniture(rng, kerb)
    return Scene(name="avenue", solids=street.solids(ground), waypoints=_way(corners, metres))


def build_city(way: FloatArray, seed: int = 0) -> Scene:
    """Houses, parked cars, lamp posts and trees on both sides of a way, and nothing on it.

    ``way`` is (N, 2) x y of the path, metres, as it is driven; InputError if below 100 m.
    """
    way = as_array(way, "way", ("N", 2))
    distances = distances_along(way)
    length = float(distances[-1])
    if not len(way) or length < _SHORTEST:
        raise InputError("way: expected one of 100 m or more; give more points of it")
    way = way[np.concatenate([[True], np.diff(distances) > 0.0])]  # without stops

    def along(spacing: float) -> FloatArray:
        return points_along(way, np.linspace(0.0, length, int(length / spacing) + 1))

    path = along(_STEP)
    rng = np.random.default_rng([seed, 0, _CITY_STREAM])
    ground = street_ground(rng)
    roadside = _Roadside(path, rng)
    s = 6.0
    while s < length - 6.0:
        a, b = path[int((s - 4.0) / _STEP)], path[min(int((s + 4.0) / _STEP), len(path) - 1)]
        for left in (True, False):
            roadside.build(Kerb(a, b, left, ground))
        s += float(rng.uniform(9.0, 13.0))
    return Scene(name="city", solids=roadside.solids(ground), waypoints=along(_SPACING))


class _Roadside(Street):
    """Things that stand beside a way, and nowhere on it."""

    def __init__(self, path: FloatArray, rng: np.random.Generator) -> None:
        super().__init__()
        self._path, self._rng = cKDTree(path), rng
        self._houses: list[FloatArray] = []

    def build(self, kerb: Kerb) -> None:
        """A house, a post or tree, and a parked car along a kerb, as far as there is room."""
        size = [self._between(*r) for r in ((8.0, 13.0), (8.0, 12.5), (5.0, 16.0))]
        chance = float(self._rng.random())
        middle = 0.5 * kerb.length
        self._add_house(kerb, *size)
        x, y, z = at = kerb.place(middle, self._between(5.8, 7.0))
        if chance < 0.5 and self._is_free([x, y, 0.0, 0.3, 0.3, 1.0, 0.0], _KERB):
            self.add_post(at, self._between(0.1, 0.22), 5.0)
            if chance < 0.25:
                wide = self._between(1.2, 1.9)
                self.crowns.append([x, y, z + 3.2 + wide, wide, wide, wide])
        car = kerb.box(middle - 2.1, middle + 2.1, 4.2, 6.0, 0.25, 1.3)
        if 0.3 < chance < 0.6 and self._is_free(car, _KERB):
            self.boxes.append(car)

    def _add_house(self, kerb: Kerb, width: float, setback: float, top: float) -> None:
        middle, half = 0.5 * kerb.length, 0.5 * width
        house = kerb.box(middle - half, middle + half, setback, setback + 10.0, -DEEP, top)
        place = np.array(house[:2])
        near = [np.linalg.norm(other - place) for other in self._houses]
        if not self._is_free(house, _CLEAR) or min(near, default=np.inf) <= 9.0:
            return
        self._houses.append(place)
        self.boxes.append(house)
        for _ in range(int(self._rng.integers(1, 4))):
            at, out = self._between(-0.4, 0.35) * width, self._between(0.25, 0.9)
            end, kind = middle + at + self._between(0.6, 2.2), int(self._rng.integers(3))
            self.boxes.append(kerb.bay(middle + at, end, setback, out, top, kind))

    def _is_free(self, box: list[float], margin: float) -> bool:
        x, y, _, half_x, half_y, _, yaw = box
        u, v = np.meshgrid(np.linspace(-half_x, half_x, 7), np.linspace(-half_y, half_y, 7))
        cosine, sine = np.cos(yaw), np.sin(yaw)
        outline = np.stack([x + cosine * u - sine * v, y + sine * u + cosine * v], axis=-1)
        return bool(self._path.query(outline.reshape(-1, 2))[0].min() > margin)

    def _between(self, low: float, high: float) -> float:
        return float(self._rng.uniform(low, high))


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


def box(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float) -> list[float]:
    """Row of ``Solids.boxes`` between two corners."""
    centre = [0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (z0 + z1)]
    return [*centre, 0.5 * abs(x1 - x0), 0.5 * abs(y1 - y0), 0.5 * abs(z1 - z0), 0.0]


def street_ground(rng: np.random.Generator) -> Ground:
    """The gently rolling ground of a town."""
    return rolling_ground(rng, (0.5, 0.35, 0.2), (150.0, 90.0, 60.0))


def rolling_ground(
    rng: np.random.Generator, amplitudes: tuple[float, ...], wavelengths: tuple[float, ...]
) -> Ground:
    """One wave each, in random directions."""
    direction = rng.uniform(0.0, 2.0 * np.pi, len(amplitudes))
    number = 2.0 * np.pi / np.array(wavelengths)
    phase = rng.uniform(0.0, 2.0 * np.pi, len(amplitudes))
    u, v = number * np.cos(direction), number * np.sin(direction)
    return Ground(np.column_stack([amplitudes, u, v, phase]))


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
    return np.asarray(way + swing[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1))
