"""Places under the open sky away from streets: a park, a forest, a square full of people, a bridge.

Their streams of random numbers are 10 to 13.
"""

from __future__ import annotations

import numpy as np

from loam_gtsam.datasets.sim import streets
from loam_gtsam.datasets.sim.raycast import Ground, Solids
from loam_gtsam.datasets.sim.ways import Mover, distance_to_way, rounded
from loam_gtsam.types import FloatArray

_WALKING = (0.02, 0.012, 0.015, 0.008)
"""Sway of a lidar that someone carries: heave (m), roll, pitch and yaw (rad)."""
_PEOPLE = 45
_TREE_LINE = 38.0  # metres from the middle of the forest to its edge


def build_park(seed: int) -> streets.Scene:
    """Lawns on waves of the ground, trees with round crowns, a few pavilions; walked through."""
    rng = np.random.default_rng([seed, 0, 10])
    ground = streets.rolling_ground(rng, (0.9, 0.4, 0.1), (75.0, 38.0, 13.0))
    way = _winding(rng, 19.0, (3.5, 2.0))
    trunks = _apart_from(way, rng.uniform(-80.0, 80.0, (190, 2)), 2.5)
    z = ground.height(*trunks.T)
    radius = rng.uniform(0.1, 0.35, len(trunks))
    crown = rng.uniform(1.1, 2.4, len(trunks))
    bole = rng.uniform(1.9, 3.2, len(trunks))
    crowns = np.column_stack([trunks, z + bole + crown, crown, crown, crown])
    boxes = []
    for angle in np.linspace(0.0, 2.0 * np.pi, 7, endpoint=False) + rng.uniform(0.0, 0.7, 7):
        x, y = rng.uniform(38.0, 75.0) * np.array([np.cos(angle), np.sin(angle)])
        half_x, half_y, top = rng.uniform(3.0, 9.0), rng.uniform(3.0, 6.0), rng.uniform(3.0, 7.0)
        foot = float(ground.height(np.array([x]), np.array([y]))[0])
        middle, half = foot + 0.5 * (top - streets.DEEP), 0.5 * (top + streets.DEEP)
        boxes.append([x, y, middle, half_x, half_y, half, rng.uniform(0.0, np.pi)])
    return streets.Scene(
        name="park",
        solids=Solids(
            boxes=np.array(boxes),
            cylinders=np.column_stack([trunks, radius, z - streets.DEEP, z + bole + crown]),
            ellipsoids=crowns,
            foliage=np.ones(len(crowns), np.bool_),
            ground=ground,
        ),
        waypoints=way,
        closed=True,
        speed=1.4,
        height=1.5,
        sway=_WALKING,
        frames=250,
    )


def build_forest(seed: int) -> streets.Scene:
    """Tall trunks close together, bushes between them and low boughs, on uneven ground."""
    rng = np.random.default_rng([seed, 0, 11])
    ground = streets.rolling_ground(rng, (0.8, 0.3, 0.15, 0.05), (60.0, 25.0, 9.0, 4.0))
    way = _winding(rng, 12.0, (2.0, 1.2))
    trunks = _apart_from(way, _in_disc(rng, 360, _TREE_LINE), 1.2)
    z = ground.height(*trunks.T)
    radius = rng.uniform(0.08, 0.28, len(trunks))
    boughs = trunks[rng.random(len(trunks)) < 0.3]
    wide = rng.uniform(1.0, 2.0, len(boughs))
    high = ground.height(*boughs.T) + rng.uniform(4.5, 9.0, len(boughs))
    crowns = np.column_stack([boughs, high, wide, wide, 0.7 * wide])
    at = _apart_from(way, _in_disc(rng, 150, _TREE_LINE), 2.2)
    wide, tall = rng.uniform(0.4, 1.3, (2, len(at))), rng.uniform(0.3, 1.1, len(at))
    bushes = np.column_stack([at, ground.height(*at.T) + 0.6 * tall, *wide, tall])
    round_ones = np.vstack([crowns, bushes])
    return streets.Scene(
        name="forest",
        solids=Solids(
            cylinders=np.column_stack([trunks, radius, z - streets.DEEP, z + 16.0]),
            ellipsoids=round_ones,
            foliage=np.ones(len(round_ones), np.bool_),
            ground=ground,
        ),
        waypoints=way,
        closed=True,
        speed=2.0,
        height=1.3,
        sway=(0.03, 0.025, 0.025, 0.01),
        frames=250,
    )


def build_square(seed: int) -> streets.Scene:
    """A square between houses, crossed by 45 people on foot and driven round by six cars."""
    rng = np.random.default_rng([seed, 0, 12])
    ground = streets.rolling_ground(rng, (0.08, 0.03), (60.0, 25.0))
    street = streets.Street()
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (46.0, 36.0)
    for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        kerb = streets.Kerb(corner, following, False, ground)
        street.add_houses(rng, kerb, False, False)
        for s in np.arange(12.0, kerb.length - 8.0, 16.0) + rng.uniform(0.0, 5.0):
            street.add_post(kerb.place(s, -8.5), 0.09, 5.0)
    street.add_post((0.0, 0.0, 0.0), 0.9, 4.0)  # a monument
    way = _winding(rng, 11.0, (1.2, 0.6))
    things = [(0.0, 0.0, 1.0), (16.0, 16.0, 2.2)]
    for x, y in _apart_from(way, rng.uniform(-24.0, 24.0, (14, 2)), 2.5):
        z = float(ground.height(np.array([x]), np.array([y]))[0])
        street.boxes.append([x, y, z + 0.2, 0.9, 0.25, 0.25, float(rng.uniform(0.0, np.pi))])
        things.append((x, y, 1.0))
    street.stones.append([16.0, 16.0, 0.0, 2.2, 2.2, 1.1])
    movers = _people(rng, way, np.array(things)) + _traffic(rng, corners)
    solids = street.solids(ground)
    return streets.Scene(
        name="square",
        solids=Solids(
            solids.boxes, solids.cylinders, solids.ellipsoids, solids.foliage, ground, movers=movers
        ),
        waypoints=way,
        closed=True,
        speed=1.4,
        height=1.4,
        sway=_WALKING,
        frames=250,
    )


def build_bridge(seed: int) -> streets.Scene:
    """A suspension bridge 45 m above a valley: railings, hangers, lamps and two pylons, no more."""
    rng = np.random.default_rng([seed, 0, 13])
    boxes = [streets.box(-200.0, 500.0, -6.0, 6.0, -1.5, 0.0)]  # the deck
    cylinders = []
    pylons = 30.0 + rng.uniform(0.0, 20.0) + np.array([0.0, 180.0])
    for side in (-5.6, 5.6):
        boxes += [
            streets.box(-200.0, 500.0, side - 0.04, side + 0.04, z, z + 0.08) for z in (0.5, 1.0)
        ]
        cylinders += [[x, side, 0.03, 0.0, 1.0] for x in np.arange(-100.0, 400.0, 4.0)]
        for x in pylons:
            boxes.append(streets.box(x - 1.2, x + 1.2, side - 0.9, side + 0.9, -45.0, 38.0))
        for x in np.arange(-96.0, 400.0, 12.0):
            sag = np.clip(np.abs(x - pylons.mean()) / 90.0, 0.0, 2.0) - 1.0
            cable = 36.0 - 32.0 * (1.0 - abs(sag)) if abs(sag) < 1.0 else 4.0
            cylinders.append([x, side, 0.05, 0.0, max(cable, 4.0)])
    for x in pylons:  # their cross beams
        boxes.append(streets.box(x - 0.9, x + 0.9, -5.6, 5.6, 9.0, 11.5))
    for number, x in enumerate(np.arange(-90.0, 400.0, 35.0)):
        cylinders.append([x, 5.0 if number % 2 else -5.0, 0.09, 0.0, 8.0])
    valley = streets.rolling_ground(rng, (6.0, 3.0), (240.0, 110.0)).waves
    along = np.arange(0.0, 300.0, 8.0)
    lane = -1.8 + 0.15 * np.sin(along / 17.0)
    return streets.Scene(
        name="bridge",
        solids=Solids(np.array(boxes), np.array(cylinders), ground=Ground(valley, -45.0)),
        waypoints=np.stack([along, lane, np.full(len(along), 1.8)], axis=1),
        speed=12.0,
    )


def _winding(rng: np.random.Generator, radius: float, waves: tuple[float, float]) -> FloatArray:
    """(W, 2) a closed way round the origin, in and out by such amplitudes, metres."""
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    turns = rng.uniform(0.0, 2.0 * np.pi, 2)
    away = radius + sum(
        a * np.sin(k * angle + t) for k, a, t in zip((2, 3), waves, turns, strict=True)
    )
    corners = np.stack([away * np.cos(angle), away * np.sin(angle)], axis=1)
    return rounded(corners, 1.0, 3.0, closed=True)


def _in_disc(rng: np.random.Generator, count: int, radius: float) -> FloatArray:
    """(count, 2) points spread evenly over a disc round the origin."""
    angle, away = rng.uniform(0.0, 2.0 * np.pi, count), radius * np.sqrt(rng.random(count))
    return np.stack([away * np.cos(angle), away * np.sin(angle)], axis=1)


def _apart_from(way: FloatArray, candidates: FloatArray, margin: float) -> FloatArray:
    """Those of (N, 2) points that are farther than this from a closed way."""
    fine = rounded(way, 0.05, 0.25, closed=True)
    return np.asarray(candidates[distance_to_way(fine, candidates) > margin])


def _people(rng: np.random.Generator, way: FloatArray, things: FloatArray) -> tuple[Mover, ...]:
    """Pedestrians who go there and back on lines 1 m off the way, and past things (T, 3) x y r."""
    people: list[Mover] = []
    while len(people) < _PEOPLE:
        start = rng.uniform(-26.0, 26.0, 2)
        angle, length = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(5.0, 30.0)
        end = start + length * np.array([np.cos(angle), np.sin(angle)])
        line = start + np.linspace(0.0, 1.0, 120)[:, None] * (end - start)
        size, tall = float(rng.uniform(0.2, 0.3)), float(rng.uniform(1.55, 1.95))
        speed, phase = float(rng.uniform(0.7, 1.7)), float(rng.uniform(0.0, 60.0))
        gaps = np.linalg.norm(line[:, None] - things[:, :2], axis=2) - things[:, 2]
        free = gaps.min() > 0.3 and len(_apart_from(way, line, 1.0)) == len(line)
        if free and np.all(np.abs(end) < (34.0, 25.0)):
            people.append(Mover(np.stack([start, end]), (size,), -0.3, tall, speed, phase))
    return tuple(people)


def _traffic(rng: np.random.Generator, corners: FloatArray) -> tuple[Mover, ...]:
    """Cars, each a body and a cabin, round the square one behind the other."""
    lane = rounded(corners * 0.9, 4.0, 0.5, closed=True)
    speed = float(rng.uniform(5.0, 8.0))
    cars: list[Mover] = []
    for start in np.arange(6.0) * 45.0 + rng.uniform(0.0, 25.0, 6):
        cars.append(Mover(lane, (2.15, 0.9), 0.2, 0.85, speed, float(start)))
        cars.append(Mover(lane, (1.2, 0.75), 0.85, 1.45, speed, float(start)))
    return tuple(cars)
