"""Places under a roof: an office floor, a tunnel with pilasters, a parking garage, a stairwell.

Their streams of random numbers are 14 to 17.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from loam_gtsam.datasets.sim import streets
from loam_gtsam.datasets.sim.raycast import Solids
from loam_gtsam.datasets.sim.ways import rounded
from loam_gtsam.types import FloatArray

_WALKING = (0.02, 0.012, 0.012, 0.01)
"""Sway of a lidar that someone carries: heave (m), roll, pitch and yaw (rad)."""
_ROOMS = 10  # on either side of the corridor
_DOOR = 0.6  # metres, half the width of a door opening
_LINTEL = 2.1  # metres, height of a door opening
_CEILING = 2.8  # metres, of the office
_STEPS, _RUN, _RISE = 10, 0.28, 0.17
"""Steps of a flight of stairs, depth and height of a step in metres."""
_FLIGHTS = 8


def build_rooms(seed: int) -> streets.Scene:
    """An office floor, 145 m once round: in by one door, through a wall, out by another.

    Twenty rooms on both sides of a corridor, with walls of 0.1 to 0.2 m. The way leads through
    every room and passes the ends of their walls.
    """
    rng = np.random.default_rng([seed, 0, 14])
    thick = rng.uniform(0.1, 0.2, 2)  # of the walls along the corridor and between rooms
    edges = np.concatenate([[0.0], np.cumsum(rng.uniform(4.9, 5.7, _ROOMS))])
    end, depth, half = float(edges[-1]), 4.8, 1.2
    rows: streets.Rows = [
        streets.box(-1.0, end + 1.0, -9.0, 9.0, _CEILING, 4.0),
        *_walls((0.0, end), (-half - thick[0] - depth, half + thick[0] + depth), 4.0),
    ]
    middles = 0.5 * (edges[1:] + edges[:-1]) + rng.uniform(-0.5, 0.5, _ROOMS)
    corners: list[tuple[float, float]] = []
    for side in (-1.0, 1.0):
        near, far = half + thick[0], half + thick[0] + depth
        rows += _wall_along_x(side * (half + 0.5 * thick[0]), thick[0], 0.0, end, middles)
        inner = side * (near + rng.uniform(1.8, 2.6, _ROOMS))  # doors from room to room
        for number, x in enumerate(edges[1:-1]):
            span = sorted((side * near, side * far))
            doors = inner[number : number + 1] if number % 2 == 0 else inner[:0]
            rows += [_turned(row) for row in _wall_along_x(x, thick[1], span[0], span[1], doors)]
        through = [
            point
            for first in range(0, _ROOMS, 2)
            for point in (
                (middles[first], 0.0),
                (middles[first], inner[first]),
                (middles[first + 1], inner[first]),
                (middles[first + 1], 0.0),
            )
        ]
        corners += through if side < 0.0 else through[::-1]
        rows += _furniture(rng, edges, side, near, far)
    way = rounded(np.array(corners), 1.0, 0.4, closed=True)
    return streets.Scene(
        name="rooms",
        solids=Solids(boxes=np.array(rows)),
        waypoints=way,
        closed=True,
        speed=1.1,
        height=1.3,
        sway=_WALKING,
        frames=300,
        bends=0.5,
    )


def build_tunnel_pilasters(seed: int) -> streets.Scene:
    """A road tunnel of 7 x 5 m, bare but for a pair of pilasters every 37 m."""
    rng = np.random.default_rng([seed, 0, 15])
    boxes = [
        streets.box(-300.0, 600.0, 3.5, 4.5, -1.0, 6.0),
        streets.box(-300.0, 600.0, -4.5, -3.5, -1.0, 6.0),
        streets.box(-300.0, 600.0, -4.5, 4.5, 5.0, 6.0),
    ]
    out, wide = rng.uniform(0.2, 0.4), rng.uniform(0.4, 0.8)
    for x in np.arange(-300.0, 600.0, 37.0) + rng.uniform(0.0, 37.0):
        boxes.append(streets.box(x, x + wide, 3.5 - out, 3.5, -1.0, 5.0))
        boxes.append(streets.box(x, x + wide, -3.5, out - 3.5, -1.0, 5.0))
    along = np.arange(0.0, 313.0, 8.0)
    return streets.Scene(
        name="tunnel_pilasters",
        solids=Solids(boxes=np.array(boxes)),
        waypoints=np.stack([along, -1.2 + 0.2 * np.sin(along / 19.0)], axis=1),
        speed=11.0,
    )


def build_garage(seed: int) -> streets.Scene:
    """A storey of a parking garage: low ceiling with beams, columns on a grid, parked cars."""
    rng = np.random.default_rng([seed, 0, 16])
    half_x, half_y, ceiling = 30.0, 17.0, 2.6
    boxes: streets.Rows = [
        streets.box(-half_x - 1.0, half_x + 1.0, -half_y - 1.0, half_y + 1.0, ceiling, 4.0),
        *_walls((-half_x, half_x), (-half_y, half_y), 4.0),
    ]
    cylinders = []
    grid = np.arange(-24.0, 25.0, 8.0)
    boxes += [streets.box(x - 0.2, x + 0.2, -half_y, half_y, 2.25, ceiling) for x in grid]
    for x in grid:
        for y in (-11.5, -5.0, 5.0, 11.5):
            if abs(y) > 6.0 or rng.random() < 0.5:
                cylinders.append([x, y, 0.3, 0.0, ceiling])
            else:
                boxes.append(streets.box(x - 0.25, x + 0.25, y - 0.25, y + 0.25, 0.0, ceiling))
    boxes.append(streets.box(-2.5, 2.5, -1.5, 1.5, 0.0, ceiling))  # the lift
    # Rows of bays: along both walls, and back to back between the two aisles.
    for row, ahead in ((-14.4, 1.0), (-2.7, -1.0), (2.7, 1.0), (14.4, -1.0)):
        for x in np.arange(-21.2, 21.5, 2.65) + 0.1:
            beside = np.abs(grid - x).min() < 1.3 and abs(row) < 6.0
            if rng.random() < 0.6 and not beside and (abs(x) > 4.5 or abs(row) > 6.0):
                boxes += _parked(rng, x, row, ahead)
    corners = np.array([[0, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * (26.5, 9.0)
    return streets.Scene(
        name="garage",
        solids=Solids(boxes=np.array(boxes), cylinders=np.array(cylinders)),
        waypoints=rounded(corners, 3.0, 2.0, closed=True),
        closed=True,
        speed=4.0,
        height=1.6,
        frames=300,
    )


def build_stairwell(seed: int) -> streets.Scene:
    """A shaft with eight flights of stairs and a landing after each, walked up."""
    rng = np.random.default_rng([seed, 0, 17])
    flight, end, wide = 0.5 * _STEPS * _RUN, 2.9, 1.5
    climb, top = _STEPS * _RISE, (_FLIGHTS + 2) * _STEPS * _RISE
    boxes: streets.Rows = [
        *_walls((-end, end), (-wide, wide), top),
        streets.box(-end, end, -wide, wide, top - 1.0, top),
    ]
    cylinders = [[float(rng.uniform(-2.7, -2.3)), 1.35, 0.07, 0.0, top]]  # a pipe
    corners: list[list[float]] = []  # of the sensor's way
    for number in range(_FLIGHTS + 1):
        foot, eye = number * climb, number * climb + 1.4
        ahead = -1.0 if number % 2 else 1.0  # this flight leads to +x or -x
        side = -ahead
        # The landing behind the foot of this flight, with a door or a radiator on its wall.
        boxes.append(streets.box(-ahead * flight, -ahead * end, -wide, wide, foot - 0.25, foot))
        y, half, high = rng.uniform(-0.8, 0.8), rng.uniform(0.3, 0.5), rng.choice([0.7, 2.05])
        out = rng.uniform(0.05, 0.15)
        wall = -ahead * (end - out), -ahead * end
        boxes.append(streets.box(*wall, y - half, y + half, foot, foot + high))
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 9) if number else np.zeros(0)
        for turn in angle:  # round from the flight before
            x = -ahead * (flight + 0.15 + 0.75 * np.cos(turn))
            corners.append([x, side * 0.75 * np.sin(turn), eye])
        if number == 0:
            corners.append([-flight - 0.8, -0.75, eye])
        if number == _FLIGHTS:
            continue
        corners += [
            [-ahead * flight, side * 0.75, eye],
            [ahead * flight, side * 0.75, eye + climb],
        ]
        for step in range(_STEPS):
            x, z = ahead * (step * _RUN - flight), foot + (step + 1) * _RISE
            inner, outer = side * 0.1, side * wide
            boxes.append(streets.box(x, x + ahead * _RUN, inner, outer, z - 2.0 * _RISE, z))
    return streets.Scene(
        name="stairwell",
        solids=Solids(boxes=np.array(boxes), cylinders=np.array(cylinders)),
        waypoints=rounded(np.array(corners), 0.25, 0.3, closed=False),
        speed=0.9,
        sway=_WALKING,
        frames=300,
        bends=0.3,
    )


def _walls(x: tuple[float, float], y: tuple[float, float], top: float) -> streets.Rows:
    """Four of them, 1 m thick, round a rectangle between these."""
    return [
        streets.box(x[0] - 1.0, x[0], y[0] - 1.0, y[1] + 1.0, -1.0, top),
        streets.box(x[1], x[1] + 1.0, y[0] - 1.0, y[1] + 1.0, -1.0, top),
        streets.box(x[0], x[1], y[0] - 1.0, y[0], -1.0, top),
        streets.box(x[0], x[1], y[1], y[1] + 1.0, -1.0, top),
    ]


def _wall_along_x(
    y: float, thick: float, begin: float, end: float, doors: FloatArray
) -> streets.Rows:
    """A wall with door openings in the middle of which are such x."""
    rows, low, high = [], y - 0.5 * thick, y + 0.5 * thick
    for door in sorted(doors):
        rows.append(streets.box(begin, door - _DOOR, low, high, -1.0, 4.0))
        rows.append(streets.box(door - _DOOR, door + _DOOR, low, high, _LINTEL, 4.0))
        begin = door + _DOOR
    return [*rows, streets.box(begin, end, low, high, -1.0, 4.0)]


def _turned(row: list[float]) -> list[float]:
    """The box with x and y exchanged."""
    x, y, z, half_x, half_y, half_z, _ = row
    return [y, x, z, half_y, half_x, half_z, 0.0]


def _furniture(
    rng: np.random.Generator, edges: FloatArray, side: float, near: float, far: float
) -> streets.Rows:
    """A desk or shelves at the back of every room, and something beside its door."""
    rows = []
    for left, right in pairwise(edges):
        out, top = rng.uniform(0.35, 0.8), float(rng.choice([0.75, 1.2, 2.0]))
        begin = left + rng.uniform(0.4, 1.2)
        stop = begin + rng.uniform(0.8, 1.8)
        rows.append(streets.box(begin, stop, side * (far - out), side * far, 0.0, top))
        if rng.random() < 0.6:
            x = rng.choice([left + 0.45, right - 0.45])
            row = streets.box(x - 0.3, x + 0.3, side * near, side * (near + 0.45), 0.0, 1.8)
            rows.append(row)
        corner = right - 0.5, side * (far - 0.45)
        rows.append([*corner, 0.45, 0.25, 0.25, 0.45, rng.uniform(0.0, np.pi)])  # a chair
    return rows


def _parked(rng: np.random.Generator, x: float, y: float, ahead: float) -> streets.Rows:
    """A car in its bay, nose to +y or -y: body and cabin."""
    y += float(rng.uniform(-0.2, 0.2))
    half, top = rng.uniform(0.82, 0.92), rng.uniform(1.4, 1.75)
    body = [x, y, 0.55, half, rng.uniform(1.95, 2.25), 0.33, 0.0]
    cabin = [x, y - 0.25 * ahead, 0.5 * (top + 0.88), half - 0.12, 1.2, 0.5 * (top - 0.88), 0.0]
    turn = float(rng.normal(0.0, 0.03))
    return [[*body[:6], turn], [*cabin[:6], turn]]
