"""The places of the simulated world, deterministic from a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from loam_gtsam.datasets.sim import indoors, outdoors, streets
from loam_gtsam.datasets.sim.raycast import Solids
from loam_gtsam.datasets.sim.ways import distance_to_way
from loam_gtsam.types import FloatArray

_CORRIDOR = 320.0  # metres
_WAY: FloatArray = np.arange(0.0, 208.0, 8.0)  # way points along x, metres
_POLES = 25
_TERRAIN = 300.0  # metres of way between the first and the last pole of the sparse terrain


def build_room(seed: int) -> streets.Scene:
    """A furnished room, 10 x 8 x 3 m, walked round slowly. The walls stand at |x| = 5, |y| = 4."""
    rng = np.random.default_rng([seed, 0, 1])
    boxes = [
        streets.box(-6, -5, -5, 5, -1, 4),
        streets.box(5, 6, -5, 5, -1, 4),
        streets.box(-6, 6, -5, -4, -1, 4),
        streets.box(-6, 6, 4, 5, -1, 4),
        streets.box(-6, 6, -5, 5, 3.0, 4),
        streets.box(-5, -4.6, -2.5, 0.5, 0, 2.0),  # shelf
        streets.box(-1.5, 1.0, 3.5, 4, 0, 0.9),  # sideboard
        streets.box(2.5, 3.6, -4, -3.6, 0, 2.1),  # cupboard
        streets.box(4.55, 5, -1.0, 1.5, 0, 1.2),  # desk
        streets.box(-5, -4.2, 3.2, 4, 0, 3.0),  # duct in a corner
        streets.box(-0.8, 0.8, -0.4, 0.4, 0.68, 0.74),  # table in the middle
    ]
    boxes += [
        [x, y, rng.uniform(0.3, 0.6), 0.3, 0.25, 0.6, rng.uniform(0.0, np.pi)]
        for x, y in ((4.2, 3.2), (-3.6, -3.4), (0.3, -3.5), (2.9, 3.4))
    ]
    legs = [[x, y, 0.04, 0.0, 0.68] for x in (-0.7, 0.7) for y in (-0.3, 0.3)]
    pillars = [[-3.9, 2.0, 0.2, 0.0, 3.0], [3.7, -2.6, 0.15, 0.0, 3.0]]
    return streets.Scene(
        name="room",
        solids=Solids(boxes=np.array(boxes), cylinders=np.array(legs + pillars)),
        waypoints=_round(2.4, 1.9),
        closed=True,
        speed=0.8,
        height=1.3,
        sway=(0.02, 0.015, 0.015, 0.02),
        frames=60,
    )


def build_trees(seed: int) -> streets.Scene:
    """Open woodland on slopes: trunks, crowns, rocks, no wall anywhere."""
    rng = np.random.default_rng([seed, 0, 3])
    ground = streets.rolling_ground(rng, (1.8, 0.9, 0.2, 0.05), (80.0, 47.0, 16.0, 5.0))
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    radius = 42.0 + 7.0 * np.sin(2.0 * angle + 0.5) + 4.0 * np.sin(3.0 * angle)
    path = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    fine = np.concatenate([path + f * (np.roll(path, -1, axis=0) - path) for f in (0.0, 0.5)])

    def clear(candidates: FloatArray, margin: float) -> FloatArray:
        return np.asarray(candidates[distance_to_way(fine, candidates) > margin])

    trunks = clear(rng.uniform(-110.0, 110.0, (700, 2)), 4.0)
    thick = rng.uniform(0.08, 0.32, len(trunks))
    z = ground.height(*trunks.T)
    bole = rng.uniform(2.5, 5.0, len(trunks))
    wide, tall = rng.uniform(0.9, 1.8, len(trunks)), rng.uniform(1.2, 2.6, len(trunks))
    crowns = np.column_stack([trunks, z + bole + 0.7 * tall, wide, wide, tall])
    rocks_at = clear(rng.uniform(-100.0, 100.0, (150, 2)), 3.5)
    rock_size = rng.uniform(0.3, 1.2, (len(rocks_at), 3))
    rocks = np.column_stack([rocks_at, ground.height(*rocks_at.T), rock_size])
    return streets.Scene(
        name="trees",
        solids=Solids(
            cylinders=np.column_stack([trunks, thick, z - streets.DEEP, z + bole + tall]),
            ellipsoids=np.vstack([crowns, rocks]),
            foliage=np.arange(len(crowns) + len(rocks)) < len(crowns),
            ground=ground,
        ),
        waypoints=path,
        closed=True,
        speed=3.0,
        height=1.2,
        sway=(0.02, 0.02, 0.02, 0.005),
        frames=400,
    )


def build_corridor(seed: int) -> streets.Scene:
    """A corridor of 320 m with doors in recesses, pillars and cupboards at irregular distances."""
    rng = np.random.default_rng([seed, 0, 4])
    boxes = _shell()
    cylinders = []
    for side in (1.0, -1.0):
        s = 3.0
        while s < _CORRIDOR - 4.0:
            # The wall of the shell is 0.2 m behind the panels; what they leave free is a door.
            panel = float(rng.uniform(3.0, 14.0))
            boxes.append(streets.box(s, min(s + panel, _CORRIDOR), side * 1.5, side * 1.7, -1, 4))
            s += panel + float(rng.uniform(0.9, 1.8))
        for s in np.arange(8.0, _CORRIDOR - 8.0, 17.0) + rng.uniform(-4.0, 4.0, 18):
            if rng.random() < 0.5:
                cylinders.append([s, side * 1.35, 0.15, 0.0, 2.8])
            else:
                boxes.append(streets.box(s, s + 0.8, side * 1.15, side * 1.5, 0.0, 1.9))
    return _in_corridor("corridor", Solids(boxes=np.array(boxes), cylinders=np.array(cylinders)))


def build_corridor_bare(seed: int) -> streets.Scene:
    """The corridor with nothing in it: between its ends no beam tells how far along one is."""
    del seed  # nothing here is random
    return _in_corridor("corridor_bare", Solids(boxes=np.array(_shell())))


def build_shaken(seed: int) -> streets.Scene:
    """The room, shaken as in a careless hand: 2 rad/s in yaw, roll, pitch 0.15 rad, 1 to 2 Hz."""
    return replace(build_room(seed), name="shaken", sway=(0.03, 0.15, 0.15, 0.31), frames=120)


def build_open_field(seed: int) -> streets.Scene:
    """Flat ground and nothing else: x, y and yaw show in no beam."""
    del seed  # nothing here is random
    return _along_x("open_field", Solids(), _WAY, wander=2.0)


def build_single_plane(seed: int) -> streets.Scene:
    """A blank facade whose rims and ground no beam reaches: x, z and pitch show in none."""
    del seed
    solids = Solids(boxes=np.array([streets.box(-200.0, 400.0, 8.0, 10.0, 0.0, 130.0)]))
    rest: dict[str, Any] = {"speed": 4.0, "height": 60.0, "sway": (0.02, 0.02, 0.02, 0.02)}
    return _along_x("single_plane", solids, _WAY[:21], wander=1.0, **rest)


def build_single_pole(seed: int) -> streets.Scene:
    """A pole on flat ground, driven round: only a rotation about the pole shows in no beam."""
    del seed
    return streets.Scene(
        name="single_pole",
        solids=Solids(cylinders=np.array([[0.0, 0.0, 0.08, -streets.DEEP, 6.0]])),
        waypoints=_round(6.0, 6.0, 1.0),
        closed=True,
        speed=2.0,
        height=1.5,
        frames=250,
    )


def build_tunnel(seed: int) -> streets.Scene:
    """A round tube of 3 m radius: no beam tells the way along it or a turn about its axis."""
    del seed
    solids = Solids(tubes=np.array([[0.0, 0.0, 3.0, 0.0, 3.0]]))
    sway = (0.005, 0.006, 0.006, 0.004)
    return _along_x("tunnel", solids, _WAY, wander=0.25, sway=sway)


def build_sparse_terrain(seed: int) -> streets.Scene:
    """25 thin poles within 15 m of a winding way of 300 m over gently undulating ground."""
    rng = np.random.default_rng([seed, 0, 6])
    ground = streets.rolling_ground(rng, (0.6, 0.25, 0.08), (75.0, 33.0, 14.0))
    along = np.arange(0.0, _TERRAIN, 8.0)

    def across(x: FloatArray) -> FloatArray:
        return np.asarray(6.0 * np.sin(x / 35.0))

    x = np.linspace(-10.0, _TERRAIN + 10.0, _POLES) + rng.uniform(-4.0, 4.0, _POLES)
    y = across(x) + rng.choice([-1.0, 1.0], _POLES) * rng.uniform(4.0, 15.0, _POLES)
    z = ground.height(x, y)
    radius, top = rng.uniform(0.05, 0.12, _POLES), z + rng.uniform(2.5, 5.0, _POLES)
    return streets.Scene(
        name="sparse_terrain",
        solids=Solids(
            cylinders=np.column_stack([x, y, radius, z - streets.DEEP, top]), ground=ground
        ),
        waypoints=np.stack([along, across(along)], axis=1),
        speed=5.0,
        height=1.5,
        sway=(0.01, 0.01, 0.01, 0.003),
    )


BUILDERS: dict[str, Callable[[int], streets.Scene]] = {
    "room": build_room,
    "street_loop": streets.build_street_loop,
    "trees": build_trees,
    "corridor": build_corridor,
    "corridor_bare": build_corridor_bare,
    "slopes": streets.build_slopes,
    "shaken": build_shaken,
    "open_field": build_open_field,
    "single_plane": build_single_plane,
    "single_pole": build_single_pole,
    "tunnel": build_tunnel,
    "sparse_terrain": build_sparse_terrain,
    "avenue": streets.build_avenue,
    "park": outdoors.build_park,
    "forest": outdoors.build_forest,
    "rooms": indoors.build_rooms,
    "tunnel_pilasters": indoors.build_tunnel_pilasters,
    "garage": indoors.build_garage,
    "stairwell": indoors.build_stairwell,
    "square": outdoors.build_square,
    "bridge": outdoors.build_bridge,
}


def _shell() -> list[list[float]]:
    """Walls at |y| = 1.7, ceiling at 2.8 and ends of a corridor."""
    return [
        streets.box(-2, _CORRIDOR + 2, 1.7, 2.7, -1, 4),
        streets.box(-2, _CORRIDOR + 2, -2.7, -1.7, -1, 4),
        streets.box(-2, _CORRIDOR + 2, -2, 2, 2.8, 4),
        streets.box(-2, 0, -2, 2, -1, 4),
        streets.box(_CORRIDOR, _CORRIDOR + 2, -2, 2, -1, 4),
    ]


def _round(radius_x: float, radius_y: float, x: float = 0.0) -> FloatArray:
    """(24, 2) way points on an ellipse."""
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    return np.stack([x + radius_x * np.cos(angle), radius_y * np.sin(angle)], axis=1)


def _in_corridor(name: str, solids: Solids) -> streets.Scene:
    along = np.arange(6.0, _CORRIDOR - 4.0, 8.0)
    return _along_x(name, solids, along, 0.25, height=1.1, sway=(0.005, 0.006, 0.006, 0.004))


def _along_x(
    name: str, solids: Solids, along: FloatArray, wander: float, speed: float = 5.0, **rest: Any
) -> streets.Scene:
    waypoints = np.stack([along, wander * np.sin(along / 13.0)], axis=1)
    return streets.Scene(name=name, solids=solids, waypoints=waypoints, speed=speed, **rest)
