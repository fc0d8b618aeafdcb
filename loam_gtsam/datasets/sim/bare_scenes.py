"""Places that leave a sweep little or nothing to hold on to in some direction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loam_gtsam.datasets.sim.raycast import Solids
from loam_gtsam.datasets.sim.scenes import CAR, DEEP, Scene, box, rolling_ground
from loam_gtsam.types import FloatArray

_POLES = 25
_TERRAIN = 300.0
"""Metres of way between the first and the last pole."""


def build_open_field(seed: int) -> Scene:
    """Flat ground and nothing else: x, y and yaw show in no beam."""
    del seed  # nothing here is random
    return _along_x("open_field", Solids(), 200.0, wander=2.0)


def build_single_plane(seed: int) -> Scene:
    """A blank facade that a drone flies along, too high for any beam to reach the ground or its
    rims: x, z and the rotation in the plane (of the wall, pitch) show in no beam.
    """
    del seed
    solids = Solids(boxes=np.array([box(-200.0, 400.0, 8.0, 10.0, 0.0, 130.0)]))
    sway = (0.02, 0.02, 0.02, 0.02)
    return _along_x("single_plane", solids, 160.0, wander=1.0, speed=4.0, height=60.0, sway=sway)


def build_single_pole(seed: int) -> Scene:
    """A pole on flat ground, driven round: only a rotation about the pole shows in no beam."""
    del seed
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    return Scene(
        name="single_pole",
        solids=Solids(cylinders=np.array([[0.0, 0.0, 0.08, -DEEP, 6.0]])),
        waypoints=np.stack([1.0 + 6.0 * np.cos(angle), 6.0 * np.sin(angle)], axis=1),
        closed=True,
        speed=2.0,
        height=1.5,
        frames=250,
    )


def build_tunnel(seed: int) -> Scene:
    """A round tube of 3 m radius: neither the way along it nor a turn about its axis, which is
    1.2 m above the sensor, shows in any beam.
    """
    del seed
    solids = Solids(tubes=np.array([[0.0, 0.0, 3.0, 0.0, 3.0]]))
    sway = (0.005, 0.006, 0.006, 0.004)
    return _along_x("tunnel", solids, 200.0, wander=0.25, sway=sway)


def build_sparse_terrain(seed: int) -> Scene:
    """25 thin poles within 15 m of a winding way of 300 m over gently undulating ground."""
    rng = np.random.default_rng([seed, 0, 6])
    ground = rolling_ground(rng, (0.6, 0.25, 0.08), (75.0, 33.0, 14.0))
    along = np.arange(0.0, _TERRAIN, 8.0)

    def across(x: FloatArray) -> FloatArray:
        way: FloatArray = 6.0 * np.sin(x / 35.0)
        return way

    x = np.linspace(-10.0, _TERRAIN + 10.0, _POLES) + rng.uniform(-4.0, 4.0, _POLES)
    side = rng.choice([-1.0, 1.0], _POLES)
    y = across(x) + side * rng.uniform(4.0, 15.0, _POLES)
    z = ground.height(x, y)
    radius, top = rng.uniform(0.05, 0.12, _POLES), z + rng.uniform(2.5, 5.0, _POLES)
    return Scene(
        name="sparse_terrain",
        solids=Solids(cylinders=np.column_stack([x, y, radius, z - DEEP, top]), ground=ground),
        waypoints=np.stack([along, across(along)], axis=1),
        speed=5.0,
        height=1.5,
        sway=(0.01, 0.01, 0.01, 0.003),
    )


BUILDERS: dict[str, Callable[[int], Scene]] = {
    "open_field": build_open_field,
    "single_plane": build_single_plane,
    "single_pole": build_single_pole,
    "tunnel": build_tunnel,
    "sparse_terrain": build_sparse_terrain,
}


def _along_x(
    name: str,
    solids: Solids,
    length: float,
    wander: float,
    speed: float = 5.0,
    height: float = 1.8,
    sway: tuple[float, float, float, float] = CAR,
) -> Scene:
    """A way along x that winds a little."""
    along = np.arange(0.0, length + 8.0, 8.0)
    return Scene(
        name=name,
        solids=solids,
        waypoints=np.stack([along, wander * np.sin(along / 13.0)], axis=1),
        speed=speed,
        height=height,
        sway=sway,
    )
