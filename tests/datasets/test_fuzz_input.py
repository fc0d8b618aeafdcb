"""Hostile input: whatever comes gives a result or a LoamError, and the run goes on."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import lzf
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.bags import KINDS, cloud, imu, loam_recording, store_of, write_bag
from support.strategies import (
    FEW,
    START,
    WILD,
    configs,
    generators,
    imu_streams,
    mutated,
    mutations,
    scans,
)

from loam_gtsam.config import (
    Config,
    ImuConfig,
    config_from_dict,
    config_to_dict,
    dump_config,
    parse_config,
)
from loam_gtsam.datasets import SimulatedWorld, open_dataset
from loam_gtsam.datasets.decode.packed_points import read_pcd
from loam_gtsam.datasets.decode.pointcloud2 import decode_pointcloud2
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.frontend.rings import rings_from_labels
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.loops.files import read_graph
from loam_gtsam.pipeline import Pipeline
from loam_gtsam.registration.odometry import ConstantVelocity
from loam_gtsam.types import (
    BadSweep,
    Features,
    FeatureSweep,
    FrameStatus,
    ImuSamples,
    LoamError,
    MapUpdate,
    Scan,
)

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
                try:
                    extract_features(sweep, Config())
                except LoamError:
                    continue
        assert dataset.imu is None or len(dataset.imu.stamps)
        assert dataset.truth is None or len(dataset.truth) >= 0
    except LoamError:
        return -1
    return count


# -- files -----------------------------------------------------------------------------------------


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
TOKENS = ["nan", "inf", "-1", "1e400", "1e9999999", "-1e30", "1e18", "9" * 40, "", "x", "\x00", "#",
          "0001-01-01 00:00:00.1", "9999-12-31 23:59:60"]  # fmt: skip


@st.composite
def texts(draw: st.DrawFn, text: str) -> bytes:
    """A file of numbers in which words were replaced, or whose bytes were mutated."""
    if draw(st.booleans()):
        return mutated(text.encode("latin1"), draw(mutations()))
    words = text.replace(",", " , ").replace("\n", " \n ").split(" ")
    for _ in range(draw(st.integers(1, 3))):
        words[draw(st.integers(0, len(words) - 1))] = draw(st.sampled_from(TOKENS))
    return " ".join(words).replace(" , ", ",").replace(" \n ", "\n").encode("latin1")


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


@pytest.mark.parametrize("word", TOKENS)
@pytest.mark.parametrize("name", ["times.txt", "gt.tum", "imu.csv"])
def test_no_word_in_a_table_ends_a_run_with_a_traceback(name: str, word: str) -> None:
    with folder() as place:
        (place / "velodyne").mkdir()
        for number in range(2):
            np.full((40, 4), 2.0, "<f4").tofile(place / "velodyne" / f"{number}.bin")
        lines = TEXTS[name].splitlines()
        cells = lines[-1].replace(",", " ").split()
        for column in (0, len(cells) - 1):
            changed = [word if i == column else cell for i, cell in enumerate(cells)]
            lines[-1] = ("," if "," in TEXTS[name] else " ").join(changed)
            (place / name).write_text("\n".join(lines), encoding="utf-8")
            read_all(place)
            if name == "gt.tum":
                try:
                    read_tum(place / name)
                except LoamError:
                    continue


GRAPH = (
    "# stamp_ns 0 17\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0.6 0.8\nFIX 0\n"
    "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0.6 0.8 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n"
)


@given(content=texts(GRAPH))
def test_a_damaged_graph_is_read_or_refused(content: bytes) -> None:
    with folder() as place:
        (place / "graph.g2o").write_bytes(content)
        try:
            read_graph(place / "graph.g2o")
        except LoamError:
            return


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
            return len(
                decode_pointcloud2(read_pcd(place / "a.pcd", START), time_field="none").points
            )
        except LoamError:
            return -1


@pytest.mark.parametrize("kind", PCDS)
@given(data=st.data())
def test_a_damaged_pcd_file_is_read_or_refused(kind: str, data: st.DataObject) -> None:
    read_pcd_points(data.draw(texts(PCDS[kind])))


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


# -- configurations --------------------------------------------------------------------------------


@FEW
@given(config=configs())
def test_every_valid_configuration_survives_yaml(config: Config) -> None:
    assert config_from_dict(config_to_dict(config)) == config
    assert parse_config(dump_config(config)) == config


# -- sweeps ----------------------------------------------------------------------------------------

WORLD = SimulatedWorld("room", frames=8, columns=360, sensor="vlp16")
SWEEPS = [WORLD[number] for number in range(8)]


def checked(update: MapUpdate) -> MapUpdate:
    assert np.isfinite(update.map_T_lidar.matrix()).all()
    assert np.isfinite(update.twist).all()
    return update


@given(sweep=scans())
def test_a_hostile_sweep_gives_features_or_a_sweep_error(sweep: Scan) -> None:
    try:
        features = extract_features(sweep, Config())
    except LoamError:
        return
    for column in (features.edges, features.planes, features.edge_times, features.plane_times):
        assert np.isfinite(column).all()


def wrong_by(pipeline: Pipeline, update: MapUpdate, number: int) -> float:
    """Metres from the truth."""
    truth = WORLD.truth.map_T_lidar
    where = np.linalg.inv(truth[0]) @ truth[number]
    return float(np.linalg.norm(update.map_T_lidar.translation() - where[:3, 3]))


@FEW
@given(data=st.data())
def test_hostile_sweeps_never_raise_and_the_next_good_one_is_fine(data: st.DataObject) -> None:
    pipeline = Pipeline(Config())
    begin = data.draw(st.sampled_from([0, 0, 1, 2]))
    for sweep in SWEEPS[:begin]:
        pipeline.process(sweep)
    for _ in range(data.draw(st.integers(1, 2))):
        checked(pipeline.process(data.draw(scans(near=SWEEPS[begin].stamp))))
    after = [checked(pipeline.process(sweep)) for sweep in SWEEPS[begin : begin + 4]]
    assert pipeline.mapper.map_points()[0].shape[1] == 3
    if begin == 2:
        assert after[-1].status.solved, after[-1]
        assert wrong_by(pipeline, after[-1], begin + 3) < 0.2


def test_one_stamp_in_the_far_future_costs_one_sweep() -> None:
    pipeline = Pipeline(Config())
    for sweep in SWEEPS[:3]:
        pipeline.process(sweep)
    lost = pipeline.process(replace(SWEEPS[3], stamp=2**61))
    assert lost.status is FrameStatus.BAD_STAMP
    assert "s after the last" in lost.message
    assert pipeline.process(SWEEPS[3]).status.solved
    assert pipeline.process(BadSweep(2**61, "damaged")).status is FrameStatus.BAD_STAMP
    assert pipeline.process(SWEEPS[4]).status.solved


def test_a_motion_is_not_extrapolated_for_ever() -> None:
    last = MapUpdate(START, gtsam.Pose3(), FrameStatus.OK, twist=np.array([0, 0, 0, 20.0, 0, 0]))
    guess = ConstantVelocity()
    for seconds, metres in ((9, 180.0), (10, 200.0), (300, 200.0)):
        pose = guess.at(START + seconds * 10**9, last).map_T_lidar
        assert pose.translation()[0] == pytest.approx(metres)


@pytest.mark.parametrize("metres", [1e6, np.inf, np.nan])
def test_a_guess_outside_the_grid_is_a_status_and_the_map_stays(metres: float) -> None:
    mapper = Pipeline(Config()).mapper
    features = [extract_features(sweep, Config()) for sweep in SWEEPS[:3]]
    mapper.register(features[0])
    before = mapper.map_points()[1]
    lost = mapper.register(features[1], gtsam.Pose3(gtsam.Rot3(), np.array([metres, 0.0, 0.0])))
    assert lost.status is FrameStatus.UNUSABLE_SCAN
    assert "position" in lost.message
    np.testing.assert_array_equal(mapper.map_points()[1], before)
    assert mapper.register(features[2]).status.solved


@pytest.mark.parametrize("metres", [400.0, -5000.0, 150_000.0])
def test_a_map_may_start_far_from_its_origin(metres: float) -> None:
    mapper = Pipeline(Config()).mapper
    start = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, metres]))
    for number, sweep in enumerate(SWEEPS[:3]):
        features = extract_features(sweep, Config())
        update = mapper.register(features, start if number == 0 else None)
        assert update.status.solved == (number > 0), update.message
    assert mapper.maps.edges.stats.outside == 0
    assert abs(mapper.map_points()[1][:, 2].mean() - metres) < 10.0


def test_a_first_guess_outside_the_grid_is_a_status_and_the_next_sweep_the_first() -> None:
    mapper = Pipeline(Config()).mapper
    features = [extract_features(sweep, Config()) for sweep in SWEEPS[:2]]
    nowhere = gtsam.Pose3(gtsam.Rot3(), np.array([4e6, 0.0, 0.0]))
    refused = mapper.register(features[0], nowhere)
    assert refused.status is FrameStatus.UNUSABLE_SCAN
    assert "start the map nearer" in refused.message
    assert mapper.register(features[1]).status is FrameStatus.FIRST


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e30])
def test_features_without_a_place_are_refused(value: float) -> None:
    points = np.ones((5, 3))
    points[2, 1] = value
    with pytest.raises(LoamError, match=r"planes: expected metres below .*, got 1 points of 5"):
        Features.from_points(START, np.ones((5, 3)), points)


@pytest.mark.parametrize("stamp", [2**62 + 1, -(2**62) - 1, 10**40])
def test_a_sweep_from_beyond_the_year_2116_is_refused(stamp: int) -> None:
    with pytest.raises(LoamError, match=r"Scan\.stamp: expected integer nanoseconds up to 2\^62"):
        Scan(points=np.zeros((0, 3)), stamp=stamp)
    assert Scan(points=np.zeros((0, 3)), stamp=2**62).stamp == 2**62


@pytest.mark.parametrize("span", [(-1e9, 1e9), (1.7e9, 1.7e9 + 0.1), (0.0, np.nan), (0.0, 3.0)])
def test_a_sweep_far_from_its_stamp_is_a_status(span: tuple[float, float]) -> None:
    pipeline = Pipeline(Config())
    pipeline.process(SWEEPS[0])
    update = pipeline.process(replace(SWEEPS[1], span=span))
    assert update.status is FrameStatus.UNUSABLE_SCAN
    assert "s from its stamp" in update.message
    assert pipeline.process(SWEEPS[2]).status.solved


@pytest.mark.parametrize("code", ["u1", "i1", "u2", "i4", "u4", "i8", "u8"])
def test_ring_numbers_may_start_anywhere_in_their_type(code: str) -> None:
    points = SWEEPS[0].points.T.astype(np.float32)
    usual = rings_from_labels(SWEEPS[0].rings, points)
    top = np.iinfo(code).max - 15
    for lowest in (np.iinfo(code).min, top):
        shifted = (SWEEPS[0].rings.astype(object) + int(lowest)).astype(code)
        np.testing.assert_array_equal(rings_from_labels(shifted, points).rings, usual.rings)


def test_a_point_at_the_origin_does_not_put_its_ring_last() -> None:
    rings = np.repeat([0, 1, 2], 4)
    points = np.zeros((3, 12), np.float32)
    points[0], points[2] = 1.0, rings - 1.0
    points[:, 0] = 0.0
    np.testing.assert_array_equal(rings_from_labels(rings, points).rings, rings)


def test_absurd_imu_values_are_left_out_and_quaternions_of_absurd_length_unknown() -> None:
    samples = ImuSamples(
        stamps=np.array([0, 1, 2, 3, 2**62 + 1]) * 1,
        orientation=np.array(
            [[0, 0, 0, 1.0], [0, 0, 0, 1e200], [0, 0, 0, 2.0]] + [[0, 0, 0, 1.0]] * 2
        ),
        gyro=np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [1e300, 0, 0], [0, 0, 0]], float),
        acceleration=np.tile([0.0, 0.0, 9.81], (5, 1)),
    )
    report = ImuBuffer(ImuConfig(), samples).report
    assert (report.samples, report.not_finite, report.no_orientation) == (3, 2, 1)


@FEW
@given(samples=imu_streams(start=SWEEPS[0].stamp), config=st.sampled_from([
    ImuConfig(), ImuConfig(prior="sigma"), ImuConfig(prior="blend"), ImuConfig(preintegration=True)
]))  # fmt: skip
def test_a_hostile_imu_never_raises(samples: Any, config: ImuConfig) -> None:
    buffer = ImuBuffer(config, samples)
    buffer.add(samples)
    assert buffer.report.samples <= len(samples.stamps)
    pipeline = Pipeline(Config().changed(imu=config), imu=buffer)
    for sweep in SWEEPS[:3]:
        checked(pipeline.process(sweep))


@st.composite
def feature_sweeps(draw: st.DrawFn) -> FeatureSweep:
    """What another front end might hand over."""
    rng = draw(generators())
    parts = []
    for _ in range(2):
        points = rng.uniform(-9, 9, (draw(st.sampled_from([0, 1, 200])), 3))
        if draw(st.booleans()):
            points[rng.random(len(points)) < 0.1] = draw(st.sampled_from(WILD))
        parts.append(points)
    stamp = draw(st.integers(START, START + 10**9))
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([draw(st.sampled_from([0.0, 1.0, 1e9, 1e300]))] * 3))
    return FeatureSweep(Features.from_points(stamp, *parts), pose)


@given(data=st.data())
def test_hostile_features_are_refused_or_never_raise(data: st.DataObject) -> None:
    pipeline = Pipeline(Config())
    for _ in range(3):
        try:
            sweep = data.draw(feature_sweeps())
        except LoamError:
            continue
        checked(pipeline.process(sweep))
