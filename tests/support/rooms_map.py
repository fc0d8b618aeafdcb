"""A drive through rooms, of which a map is made."""

from pathlib import Path
from typing import NamedTuple

from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import RunResult

FRAMES = 30


class Mapped(NamedTuple):
    world: SimulatedWorld
    result: RunResult
    path: Path


def world(scene: str = "rooms", seed: int = 1, frames: int = FRAMES) -> SimulatedWorld:
    return SimulatedWorld(scene, seed=seed, frames=frames, columns=450)
