"""A short drive through the built-in room, and a peer, for comparisons."""

from __future__ import annotations

import pytest
from support.contenders import FakePeer, Sweeps

from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.studies.peers import PEERS
from loam_gtsam.types import Scan


@pytest.fixture(scope="module")
def world() -> SimulatedWorld:
    return SimulatedWorld("room", frames=6, columns=450)


@pytest.fixture(scope="module")
def sweeps(world) -> list[Scan]:
    return list(world)


@pytest.fixture
def dataset(world, sweeps) -> Sweeps:
    return Sweeps(sweeps, world.truth)


@pytest.fixture
def fake(monkeypatch) -> type[FakePeer]:
    monkeypatch.setitem(PEERS, "fake", FakePeer)
    monkeypatch.setattr(FakePeer, "fails_at", None)
    return FakePeer
