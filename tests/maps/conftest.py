"""A map of a room, made once: the drive, its pipeline, the file."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from support.quick import begin_quickly
from support.rooms_map import Mapped, world

from loam_gtsam.config import Config
from loam_gtsam.maps.map_file import SavedMap, save_map
from loam_gtsam.pipeline import run


@pytest.fixture(scope="session")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Mapped:
    drive = world()
    config = Config()
    places = config.pose_graph.changed(keyframe_distance=0.5)
    with pytest.MonkeyPatch.context() as patch:
        begin_quickly(patch)
        result = run(drive, config.changed(pose_graph=places))
    path = tmp_path_factory.mktemp("maps") / "rooms.lgmap"
    assert result.pipeline is not None
    save_map(path, result.pipeline)
    return Mapped(drive, result, path)


@pytest.fixture
def saved(mapped: Mapped) -> Iterator[SavedMap]:
    with SavedMap(mapped.path) as opened:
        yield opened
