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
        streets.box(-1.0, 0.0, -9.0, 9.0, -1.0, 4.0),
        streets.box(end, end + 1.0, -9.0, 9.0, -1.0, 4.0),
    ]
    middles = 0.5 * (edges[1:] + edges[:-1]) + rng.uniform(-0.5, 0.5, _ROOMS)
    corners: list[tuple[float, float]] = []
    for side in (-1.0, 1.0):
        near, far = half + thick[0], half + thick[0] + depth
        back = sorted((side * far, side * (far + 1.0)))
        rows.append(streets.box(-1.0, end + 1.0, back[0], back[1], -1.0, 4.0))
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
        out, top = rng.uniform(0.35, 0.8), rng.choice([0.75, 1.2, 2.0])
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
