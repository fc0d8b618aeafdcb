"""Damaged files give data or a LoamError, never another exception."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import lzf
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.bags import KINDS, cloud, imu, loam_recording, store_of, write_bag
from support.strategies import FEW, START, TOKENS, mutated, mutations, replaced

from loam_gtsam.config import Config
from loam_gtsam.datasets import open_dataset
from loam_gtsam.datasets.decode.packed_points import read_pcd
from loam_gtsam.datasets.decode.pointcloud2 import decode_pointcloud2
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.loops.files import read_graph
from loam_gtsam.types import BadSweep, FeatureSweep, LoamError, Scan

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@contextmanager
def folder() -> Iterator[Path]:
    """A new one for every example, which the fixture of pytest is not."""
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def read_all(path: Path, **options: Any) -> int:
    """Everything that a run and ``inspect`` ask of a data set; the number of sweeps."""
    try:
        dataset = open_dataset(path, **options)
        dataset.info()
        assert len(dataset) >= 0
        count = 0
        for sweep in dataset:
            count += 1
            assert isinstance(sweep, (Scan, BadSweep, FeatureSweep))
            if isinstance(sweep, Scan):
                with suppress(LoamError):
                    extract_features(sweep, Config())
        assert dataset.imu is None or len(dataset.imu.stamps)
        assert dataset.truth is None or len(dataset.truth) >= 0
    except LoamError:
        return -1
    return count


def small_bag(kind: str, name: str) -> dict[str, bytes]:
    """Files of a bag with three small sweeps and IMU samples, or with LOAM's topics."""
    store = store_of(kind)
    times, rings = np.linspace(0.0, 0.1, 40).astype("f4"), (np.arange(40) % 4).astype("u2")
    points = np.random.default_rng(0).uniform(-9, 9, (40, 3))
    recording = [
        entry
        for i, stamp in enumerate(range(START, START + 3 * 10**8, 10**8))
        for entry in (
            ("/imu", stamp + 1, imu(store, stamp)),
            ("/points", stamp + i, cloud(store, stamp, points, ring=rings, time=times)),
        )
    ]
    if name == "loam":
        recording = loam_recording(count=2)
    with folder() as place:
        path = write_bag(place / "run", kind, recording)
        files = [path] if path.is_file() else sorted(path.iterdir())
        return {file.name: file.read_bytes() for file in files}


BAGS = {(kind, "plain"): small_bag(kind, "plain") for kind in KINDS}
BAGS["mcap", "loam"] = small_bag("mcap", "loam")


@pytest.mark.parametrize("key", BAGS, ids="-".join)
def test_the_bags_below_are_read_while_they_are_whole(key: tuple[str, str]) -> None:
    with folder() as place:
        for name, content in BAGS[key].items():
            (place / name).write_bytes(content)
        only = place / next(iter(BAGS[key])) if len(BAGS[key]) == 1 else place
        assert read_all(only, **({"axes": "lidar"} if key[1] == "loam" else {})) >= 2


@pytest.mark.parametrize("key", BAGS, ids="-".join)
@FEW
@given(data=st.data())
def test_a_damaged_bag_is_read_or_refused(key: tuple[str, str], data: st.DataObject) -> None:
    files = BAGS[key]
    damaged = data.draw(st.sampled_from(sorted(files)))
    mutant = mutated(files[damaged], data.draw(mutations()))
    with folder() as place:
        for name, content in files.items():
            (place / name).write_bytes(mutant if name == damaged else content)
        whole = len(files) > 1 and data.draw(st.booleans())
        read_all(place if whole else place / sorted(files)[0 if len(files) == 1 else -1])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("message_count: 3", "message_count: 99999999999999999999"),
        ("message_count: 3", "message_count: -3"),
        ("message_count: 3", "message_count: three"),
        ("message_count: 3", "message_count: 3.5"),
        ("nanoseconds_since_epoch: 17", "nanoseconds_since_epoch: -99999999999999999917"),
        ("  name: /points", "  name: null"),
        ("name: /points", "name: [1, 2]"),
    ],
)
def test_metadata_that_lies_is_refused_or_counts_for_nothing(old: str, new: str) -> None:
    with folder() as place:
        for name, content in BAGS["sqlite3", "plain"].items():
            lies = content.replace(old.encode(), new.encode()) if name.endswith("yaml") else content
            assert lies != content or not name.endswith("yaml")
            (place / name).write_bytes(lies)
        read_all(place)


TEXTS = {
    "times.txt": "".join(f"{i / 10:.3f}\n" for i in range(2)),
    "gt.tum": "# t x y z qx qy qz qw\n0.0 1 2 3 0 0 0 1\n0.1 1 2 3 0 0 0.6 0.8\n",
    "imu.csv": "".join(f"{i / 100},0,0,0,1,0.1,0,0,0,0,9.81\n" for i in range(20)),
    "velodyne_points/timestamps.txt": "2011-09-26 13:02:25.594360375\n" * 2,
    "t_ns/0.u64": np.linspace(0, 1e8, 40).astype("<u8").tobytes().decode("latin1"),
    "velodyne/0.bin": np.full((40, 4), 2.0, "<f4").tobytes().decode("latin1"),
}


@st.composite
def texts(draw: st.DrawFn, text: str) -> bytes:
    """A file of numbers in which words were replaced, or whose bytes were mutated."""
    if draw(st.booleans()):
        return mutated(text.encode("latin1"), draw(mutations()))
    place = st.floats(0.0, 1.0, exclude_max=True)
    word = st.tuples(place, st.sampled_from(TOKENS))
    return replaced(text, draw(st.lists(word, min_size=1, max_size=3)))


@given(data=st.data())
def test_a_damaged_folder_of_sweeps_is_read_or_refused(data: st.DataObject) -> None:
    dates = data.draw(st.booleans())
    left_out = {"times.txt"} if dates else {"velodyne_points/timestamps.txt"}
    if data.draw(st.booleans()):
        left_out.add("t_ns/0.u64")
    names = [name for name in TEXTS if name not in left_out]
    damaged = data.draw(st.sampled_from(names))
    with folder() as place:
        for name in [*names, "velodyne/1.bin"]:
            text = TEXTS[name.replace("1.bin", "0.bin")]
            content = data.draw(texts(text)) if name == damaged else text.encode("latin1")
            (place / name).parent.mkdir(exist_ok=True)
            (place / name).write_bytes(content)
        read_all(place)


GRAPH = (
    "# stamp_ns 0 17\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0.6 0.8\nFIX 0\n"
    "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0.6 0.8 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n"
)


@given(content=texts(GRAPH))
def test_a_damaged_graph_is_read_or_refused(content: bytes) -> None:
    with folder() as place:
        (place / "graph.g2o").write_bytes(content)
        with suppress(LoamError):
            saved = read_graph(place / "graph.g2o")
            poses = [saved.poses.atPose3(key).matrix() for key in saved.keys]
            assert 0 < len(poses) <= content.count(b"VERTEX")
            assert saved.factors.size() <= len(content.splitlines())
            assert np.isfinite(poses).all()


def pcd(kind: str) -> str:
    """A small PCD file; bytes as latin-1."""
    points = np.random.default_rng(0).uniform(-9, 9, (30, 4)).astype("<f4")
    text = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH 30\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 30\nDATA {kind}\n"
    )
    if kind == "ascii":
        return text + "".join(" ".join(map(str, row)) + "\n" for row in points.tolist())
    body = points.tobytes()
    if kind == "binary_compressed":
        packed = lzf.compress(points.T.tobytes(), 2 * points.nbytes)
        body = struct.pack("<II", len(packed), points.nbytes) + packed
    return text + body.decode("latin1")


PCDS = {kind: pcd(kind) for kind in ("ascii", "binary", "binary_compressed")}
HUGE = ["2147483648", "99999999999999999999", "-7", "0"]


def read_pcd_points(content: bytes) -> int:
    """Points of a file; -1 if it is refused."""
    with folder() as place:
        (place / "a.pcd").write_bytes(content)
        try:
            cloud_of = read_pcd(place / "a.pcd", START)
            return len(decode_pointcloud2(cloud_of, time_field="none").points)
        except LoamError:
            return -1


@pytest.mark.parametrize("kind", PCDS)
@given(data=st.data())
def test_a_damaged_pcd_file_is_read_or_refused(kind: str, data: st.DataObject) -> None:
    content = data.draw(texts(PCDS[kind]))
    assert read_pcd_points(content) <= len(content)


@pytest.mark.parametrize("kind", PCDS)
@pytest.mark.parametrize("number", HUGE)
@pytest.mark.parametrize("line", ["WIDTH 30", "HEIGHT 1", "SIZE 4", "COUNT 1"])
def test_a_pcd_file_cannot_claim_more_than_it_holds(kind: str, line: str, number: str) -> None:
    assert read_pcd_points(PCDS[kind].encode("latin1")) == 30
    claim = PCDS[kind].replace(line, f"{line.split()[0]} {number}")
    assert read_pcd_points(claim.encode("latin1")) in (-1, 0)


@pytest.mark.parametrize("stamp", ["9" * 40, "-" + "9" * 40, str(2**62 + 1)])
def test_a_sweep_named_by_an_absurd_stamp_is_refused(stamp: str) -> None:
    with folder() as place:
        (place / "LiDAR" / "Velodyne").mkdir(parents=True)
        (place / "LiDAR" / "Velodyne" / f"{stamp}.bin").write_bytes(bytes(22))
        with pytest.raises(LoamError, match="stamp of the sweep"):
            open_dataset(place)
