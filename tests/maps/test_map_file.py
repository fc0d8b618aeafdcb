"""A map in a file: what comes back, what is read when, and what is wrong with a file."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from loam_gtsam.io.run_files import write_run
from loam_gtsam.maps.localizer import config_in
from loam_gtsam.maps.map_file import LAYERS, SavedMap, save_map
from loam_gtsam.maps.saved_maps import SavedMaps
from loam_gtsam.types import DatasetError, InputError, OutputError


def test_all_of_a_map_comes_back(mapped, saved):
    pipeline = mapped.result.pipeline
    for layer, cubes in pipeline.mapper.maps.layers().items():
        contents = cubes.contents(archived=True)
        assert saved.layers[layer] == {index: len(held.points) for index, held in contents.items()}
        for index, held in contents.items():
            read = saved.cube(layer, index)
            np.testing.assert_array_equal(read.points, held.points)
            np.testing.assert_array_equal(read.tags, held.tags)
    assert saved.config == pipeline.config
    assert len(saved.places) == len(pipeline.places.all) >= 2
    for read, place in zip(saved.places, pipeline.places.all, strict=True):
        assert read.stamp == place.stamp
        np.testing.assert_allclose(read.map_T_middle.matrix(), place.map_T_middle.matrix())
        np.testing.assert_array_equal(read.covariance, place.covariance)
        np.testing.assert_array_equal(read.descriptor, place.descriptor)
    assert len(saved.graph.links) == len(saved.places) - 1
    for read, link in zip(saved.graph.links, pipeline.places.links, strict=True):
        assert (read.earlier, read.later) == (link.earlier, link.later)
        np.testing.assert_allclose(read.earlier_T_later.matrix(), link.earlier_T_later.matrix())
        np.testing.assert_array_equal(read.covariance, link.covariance)
        assert np.linalg.eigvalsh(read.covariance)[0] > 0.0
    assert saved.graph.loops == []
    assert saved.frame.up is not None
    assert abs(np.linalg.norm(saved.frame.up) - 1.0) < 1e-9
    assert len(saved) > 1000


def test_the_same_map_makes_the_same_file(mapped, tmp_path):
    again = tmp_path / "again.lgmap"
    for made_by in (mapped.result.pipeline, mapped.result):
        save_map(again, made_by)
        assert again.read_bytes() == mapped.path.read_bytes()
        again.unlink()


def test_a_map_is_not_written_under_the_name_of_a_cloud(mapped, tmp_path):
    with pytest.raises(OutputError, match=r"x.PLY: expected a name that ends in .lgmap; .*cloud"):
        save_map(tmp_path / "x.PLY", mapped.result)
    assert list(tmp_path.iterdir()) == []


def test_the_folder_of_a_run_is_opened_as_its_map_and_a_closed_map_says_so(mapped, tmp_path):
    save_map(tmp_path / "map.lgmap", mapped.result)
    with SavedMap(tmp_path) as saved:
        cube = next(iter(saved.layers["planes"]))
        assert len(saved.cube("planes", cube)) > 0
        assert repr(saved).endswith(f"map.lgmap': {len(saved)} points, {len(saved.places)} places)")
    with pytest.raises(InputError, match="this map was closed; use it inside its with block"):
        saved.cube("planes", cube)
    with pytest.raises(InputError, match="this map was closed"):
        saved.write_part(tmp_path / "part.lgmap", {})


def test_a_place_has_the_error_of_the_map_and_not_of_its_sweep(mapped):
    update = {u.stamp: u for u in mapped.result.updates}
    for place in mapped.result.pipeline.places.all:
        told = update[place.stamp]
        back = told.map_T_lidar.inverse().AdjointMap()
        of_map = back @ place.covariance @ back.T
        np.testing.assert_allclose(of_map, told.covariance - told.uncertainty.own, atol=1e-10)
        assert np.linalg.eigvalsh(place.covariance)[0] > -1e-15


def test_cubes_are_read_where_the_lidar_is(mapped, saved, monkeypatch):
    read: list[str] = []
    whole = SavedMap.cube

    def counted(self, layer, index):
        read.append(layer)
        return whole(self, layer, index)

    monkeypatch.setattr(SavedMap, "cube", counted)
    config = config_in(saved, None)
    maps = SavedMaps(config, saved)
    in_reach = sum(len(cubes) for cubes in saved.layers.values())
    assert len(read) == in_reach  # a small map
    far = mapped.result.updates[0].map_T_lidar.matrix()[:3, 3] + [5000.0, 0.0, 0.0]
    for cubes in maps.layers().values():
        cubes.recenter(far)
        assert cubes.count() == 0
        assert cubes.points(archived=True).shape[0] == sum(
            saved.layers[{id(c): n for n, c in maps.layers().items()}[id(cubes)]].values()
        )
    before = len(read)
    for cubes in maps.layers().values():
        cubes.recenter(np.zeros(3))
    assert len(read) == before + in_reach
    for layer, cubes in maps.layers().items():
        assert cubes.count() == sum(saved.layers[layer].values())


@pytest.mark.parametrize("emptied", [False, True])
def test_cubes_that_the_file_does_not_have_stay(mapped, saved, emptied):
    if emptied:
        saved.layers["planes"].clear()
    cubes = SavedMaps(config_in(saved, None), saved).layers()["planes"]
    far = np.array([[5000.0, 0.0, 0.0]])
    cubes.recenter(far[0])
    cubes.insert(far)
    cubes.recenter(np.zeros(3))
    cubes.recenter(far[0])
    np.testing.assert_allclose(cubes.points(), far, atol=1e-3)


def edited(path: Path, target: Path, edit: Callable[[dict[str, bytes]], None]) -> Path:
    """The map with other members, whose checksums are right."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    edit(members)
    with zipfile.ZipFile(target, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return target


def header_with(**changes: object) -> Callable[[dict[str, bytes]], None]:
    def edit(members: dict[str, bytes]) -> None:
        header = json.loads(members["map.json"]) | changes
        members["map.json"] = json.dumps(header).encode()

    return edit


def without(part: str) -> Callable[[dict[str, bytes]], None]:
    def edit(members: dict[str, bytes]) -> None:
        del members[next(name for name in members if part in name)]

    return edit


def array_of(name: str, array: np.ndarray) -> Callable[[dict[str, bytes]], None]:
    def edit(members: dict[str, bytes]) -> None:
        target = io.BytesIO()
        np.save(target, array, allow_pickle=True)
        members[name] = target.getvalue()

    return edit


def header_of_array(name: str, header: bytes) -> Callable[[dict[str, bytes]], None]:
    def edit(members: dict[str, bytes]) -> None:
        members[name] = b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header

    return edit


WRONG = {
    "version 99": header_with(version=99),
    "got a picture": header_with(format="a picture"),
    "map.json": without("map.json"),
    "places/stamps": without("places/stamps"),
    "missing": without("cubes/planes"),
    "got (3,)": array_of("places/stamps.npy", np.zeros(3, np.int64)),
    "numbers of the": array_of("links/ends.npy", np.full((3, 2), 99)),
    "places/covariances": array_of("places/covariances.npy", np.zeros((2, 6, 6), np.float32)),
    "places/map_T_middle.npy: expected finite numbers below": array_of(
        "places/map_T_middle.npy", np.full((4, 4, 4), 1e200)
    ),
    "multi-line": header_of_array("places/stamps.npy", b"{'descr': 3L,\n"),
    "pickle": array_of("places/stamps.npy", np.array([{}, {}], object)),
    "there is no 'edges'": header_with(layers={}),
    "damaged": header_with(config={"map": {"cube_size": -1}}),
}


@pytest.mark.parametrize("said", WRONG)
def test_a_file_that_is_not_as_it_should_be_is_refused(mapped, tmp_path, said):
    path = edited(mapped.path, tmp_path / "wrong.lgmap", WRONG[said])
    with pytest.raises(DatasetError, match=r"wrong\.lgmap") as caught:
        SavedMap(path)
    assert said in str(caught.value)


def test_damage_is_found_by_the_checksums(mapped, tmp_path):
    """Wherever bytes are changed: on opening, or when the cube is read; or nothing is lost."""
    whole = mapped.path.read_bytes()
    with SavedMap(mapped.path) as good:
        layer, index = LAYERS[1], next(iter(good.layers[LAYERS[1]]))
        expected = good.cube(layer, index).points
    path, rng, found = tmp_path / "damaged.lgmap", np.random.default_rng(0), 0
    for at in rng.integers(0, len(whole), 60).tolist():
        content = bytearray(whole)
        content[at : at + 4] = bytes(b ^ 0x5A for b in content[at : at + 4])
        path.write_bytes(content)
        try:
            with SavedMap(path) as opened:
                for name, cubes in opened.layers.items():
                    for cube in cubes:
                        opened.cube(name, cube)
                np.testing.assert_array_equal(opened.cube(layer, index).points, expected)
        except DatasetError as error:
            found += str(path) in str(error)
    assert found >= 55
    for end in (0, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:end])
        with pytest.raises(DatasetError, match="expected a map"):
            SavedMap(path)


def test_a_path_that_is_no_map(tmp_path):
    with pytest.raises(DatasetError, match="there is no such file"):
        SavedMap(tmp_path / "none.lgmap")
    with pytest.raises(DatasetError, match="there is no such file"):
        SavedMap(tmp_path)
    (tmp_path / "text.lgmap").write_text("ply")
    with pytest.raises(DatasetError, match="expected a map"):
        SavedMap(tmp_path / "text.lgmap")


def test_a_map_that_cannot_be_written_leaves_the_old_one(mapped, tmp_path):
    folder = tmp_path / "file"
    folder.write_text("no folder")
    with pytest.raises(OutputError):
        save_map(folder / "a.lgmap", mapped.result.pipeline)


def test_a_library_user_writes_a_run_without_a_map(mapped, tmp_path):
    write_run(replace(mapped.result, pipeline=None), tmp_path)
    assert not list(tmp_path.glob("*.lgmap"))
