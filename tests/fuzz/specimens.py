"""Small sound files of every format that docs/inputs.md names, to be damaged."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from specimens_maps import maps
from support import bags
from support.layout_writers import write_pcd

from loam_gtsam import config, run
from loam_gtsam.config import Config, parse_config
from loam_gtsam.datasets import SimulatedWorld, open_dataset
from loam_gtsam.datasets.truth import read_truth
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.io.checkpoint import Checkpoint
from loam_gtsam.loops.files import read_graph, write_graph
from loam_gtsam.studies.trial_spec import load_spec
from loam_gtsam.types import LoamError, Scan

START, COUNT = bags.START, 40
RNG = np.random.default_rng(3)
POINTS = RNG.uniform(2.0, 9.0, (COUNT, 3)).astype("<f4")
RINGS = (np.arange(COUNT) % 4).astype("<u2")
TIMES = np.linspace(0.0, 0.1, COUNT).astype("<f4")
STAMPS = [START + i * 100_000_000 for i in range(3)]
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"


@dataclass(frozen=True, slots=True)
class Specimen:
    """Files by name, and a function that reads them, given the folder they are in."""

    files: Mapping[str, bytes]
    read: Callable[[Path], object]


def read_all(path: Path, **options: Any) -> int:
    """Everything that a run and ``inspect`` ask of a data set; the number of sweeps."""
    dataset = open_dataset(path, **options)
    dataset.info()
    count = 0
    for sweep in dataset:
        count += 1
        if isinstance(sweep, Scan):
            with suppress(LoamError):
                extract_features(sweep, Config())
    assert dataset.imu is None or len(dataset.imu.stamps)
    for kind in ("gnss", "wheels"):
        samples = getattr(dataset, kind, None)
        assert samples is None or len(samples)
    assert dataset.truth is None or len(dataset.truth) >= 0
    return count


def at(name: str = ".", **options: Any) -> Callable[[Path], object]:
    """Reads the data set of that name in the folder."""
    return lambda folder: read_all(folder / name, **options)


def rows(stamps: list[Any], *values: Any, separator: str = " ") -> bytes:
    """Lines that begin with a stamp."""
    text = separator.join(map(str, values))
    return "".join(f"{stamp}{separator}{text}\n" for stamp in stamps).encode()


def dates(shift: int = 0) -> bytes:
    """The stamps as KITTI has them."""
    moments = [np.datetime64(stamp + shift, "ns") for stamp in STAMPS]
    return "".join(f"{str(moment).replace('T', ' ')}\n" for moment in moments).encode()


def files_of(folder: Path) -> dict[str, bytes]:
    """All files in a folder, by name."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def made(write: Callable[[Path], object]) -> dict[str, bytes]:
    """The files that a function writes into a folder."""
    with tempfile.TemporaryDirectory() as name:
        write(Path(name))
        return files_of(Path(name))


def columns(*more: np.ndarray) -> bytes:
    """A sweep as float32 columns."""
    return np.column_stack([POINTS, np.full(COUNT, 7.5), *more]).astype("<f4").tobytes()


def records(**fields: tuple[str, Any]) -> np.ndarray:
    """A sweep as records of these fields after x, y, z."""
    kind = [*((axis, "<f4") for axis in "xyz"), *((n, code) for n, (code, _) in fields.items())]
    found = np.zeros(COUNT, kind)
    for axis, column in zip("xyz", POINTS.T, strict=True):
        found[axis] = column
    for name, (_, values) in fields.items():
        found[name] = values
    return found


def pcd(folder: Path, kind: str, name: str = "0.pcd", **more: np.ndarray) -> None:
    """A PCD file of one kind."""
    fields = dict(zip("xyz", POINTS.T, strict=True)) | {"ring": RINGS} | more
    if kind != "ascii":
        write_pcd(folder / name, fields, kind)
        return
    kinds = [array.dtype for array in fields.values()]
    head = {"VERSION": "0.7", "FIELDS": " ".join(fields),
            "SIZE": " ".join(str(kind.itemsize) for kind in kinds),
            "TYPE": " ".join(kind.kind.upper() for kind in kinds),
            "COUNT": " ".join("1" for _ in kinds), "WIDTH": COUNT, "HEIGHT": 1, "POINTS": COUNT,
            "DATA": "ascii"}  # fmt: skip
    lines = [f"{key} {value}" for key, value in head.items()]
    lines += [
        " ".join(map(str, row))
        for row in zip(*map(np.ndarray.tolist, fields.values()), strict=True)
    ]
    (folder / name).write_text("\n".join(lines) + "\n")


def recording(kind: str, points: str = "/points", imu: str = "/imu", clock: str = "time") -> Any:
    """Three sweeps, and samples of an IMU."""
    store = bags.store_of(kind)
    entries = []
    for stamp in STAMPS:
        times = {
            "time": TIMES,
            "t": (TIMES * 1e9).astype("<u4"),
            "timestamp": stamp * 1e-9 + TIMES.astype(float),
        }
        cloud = bags.cloud(store, stamp, POINTS, ring=RINGS, **{clock: times[clock]})
        entries.append((points, stamp, cloud))
        entries += [
            (imu, stamp + k * 10_000_000, bags.imu(store, stamp + k * 10_000_000))
            for k in range(10)
        ]
    return entries


def livox(kind: str) -> Any:
    """Three sweeps in Livox's own message."""
    store = bags.store_of(kind)
    return [("/livox", stamp, bags.livox(store, stamp, POINTS, TIMES)) for stamp in STAMPS]


def bag(
    kind: str, entries: Any, name: str = "run", compression: Any = None
) -> Callable[[Path], object]:
    """Writes a bag, compressed as a writer of rosbags does."""

    def write(folder: Path) -> None:
        if compression is None:
            bags.write_bag(folder / name, kind, entries)
            return
        store, first = bags.store_of(kind), kind == "ros1"
        if first:
            writer: Any = Writer1(folder / f"{name}.bag")
            writer.set_compression(compression)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(folder / name, version=9, storage_plugin=plugin)
            writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer:
            known: dict[str, Any] = {}
            for topic, received, message in entries:
                of = message.__msgtype__
                if topic not in known:
                    known[topic] = writer.add_connection(topic, of, typestore=store)
                serialize = store.serialize_ros1 if first else store.serialize_cdr
                writer.write(known[topic], received, serialize(message, of))

    return write


def folders() -> dict[str, Specimen]:
    """Folders of sweeps of no known data set."""
    bins = {
        "times.txt": b"0.000\n0.100\n0.200\n",
        "gt.tum": rows([0.0, 0.1, 0.2], "1 2 3 0 0 0.6 0.8"),
        "imu.csv": rows(
            [i / 100 for i in range(20)], *"0001", 0.1, 0, 0, 0, 0, 9.81, separator=","
        ),
        **{f"t_ns/{i}.u64": np.linspace(0, 1e8, COUNT).astype("<u8").tobytes() for i in range(3)},
        **{f"velodyne/{i}.bin": columns() for i in range(3)},
    }
    nuscenes = f"n015-2018-07-24__LIDAR_TOP__{START // 1000}.pcd.bin"
    found = {
        "bin": Specimen(bins, at()),
        "nuscenes": Specimen({nuscenes: columns(RINGS)}, at()),
    }
    for kind in ("ascii", "binary", "binary_compressed"):
        found[f"pcd {kind}"] = Specimen(made(lambda f, k=kind: pcd(f, k, t=TIMES)), at())
    cloud = records(ring=("<u2", RINGS), t=("<f4", TIMES))
    found["npy"] = Specimen(made(lambda folder: np.save(folder / "0.npy", cloud)), at())
    with suppress(ImportError):
        from plyfile import PlyData, PlyElement

        for text in (False, True):
            ply = PlyData([PlyElement.describe(cloud, "vertex")], text=text, byte_order="<")
            files = made(lambda folder, ply=ply: ply.write(str(folder / "0.ply")))
            found[f"ply {'ascii' if text else 'binary'}"] = Specimen(files, at())
    return found


def kitti() -> dict[str, Specimen]:
    """Raw drives and sequences."""
    drive = "2011_09_26_drive_0002_sync"
    packet = " ".join(
        ["49.01", "8.42", "112.0", *["0.01"] * 8, "0.1", "0.1", "9.8", *["0.02"] * 16]
    )
    raw = {f"{drive}/velodyne_points/data/{i:010d}.bin": columns() for i in range(3)}
    for name, shift in (("", 0), ("_start", -50_000_000), ("_end", 50_000_000)):
        raw[f"{drive}/velodyne_points/timestamps{name}.txt"] = dates(shift)
    raw |= {f"{drive}/oxts/data/{i:010d}.txt": packet.encode() for i in range(3)}
    raw[f"{drive}/oxts/timestamps.txt"] = dates()
    raw["calib_imu_to_velo.txt"] = b"calib_time: 25\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n"
    sequence = {f"sequences/00/velodyne/{i:06d}.bin": columns() for i in range(3)}
    sequence["sequences/00/times.txt"] = b"0.0\n0.1\n0.2\n"
    sequence["sequences/00/calib.txt"] = f"P0: {IDENTITY}\nTr: {IDENTITY}\n".encode()
    sequence["poses/00.txt"] = f"{IDENTITY}\n".encode() * 3
    name = "2013_05_28_drive_0000_sync"
    later = f"data_3d_raw/{name}/velodyne_points"
    kitti_360 = {f"{later}/data/{i:010d}.bin": columns() for i in range(3)}
    kitti_360[f"{later}/timestamps.txt"] = dates()
    kitti_360[f"data_poses/{name}/cam0_to_world.txt"] = rows([0, 2], IDENTITY, "0 0 0 1")
    kitti_360["calibration/calib_cam_to_velo.txt"] = f"{IDENTITY}\n".encode()
    return {
        "KITTI raw": Specimen(raw, at(drive)),
        "KITTI odometry": Specimen(sequence, at("sequences/00")),
        "KITTI-360": Specimen(kitti_360, at(f"data_3d_raw/{name}")),
    }


def known() -> dict[str, Specimen]:
    """Newer College, MulRan, HeLiPR, Oxford Spires."""
    ns = ["1", "2", "3", "0", "0", "0.6", "0.8"]
    parted = [f"{stamp // 10**9},{stamp % 10**9}" for stamp in STAMPS]
    pointed = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in STAMPS]
    rooster = recording("ros1", "/os1_cloud_node/points", "/os1_cloud_node/imu", "t")
    quad = recording("ros1", "/os_cloud_node/points", "/os_cloud_node/imu", "t")
    spires = recording("ros1", "/hesai/pandar", "/alphasense_driver_ros/imu", "timestamp")
    college = made(bag("ros1", rooster, "rooster_2020-03-10-10-30-30_0"))
    college["ground_truth/registered_poses.csv"] = rows(parted, *ns, separator=",")
    later = made(bag("ros1", quad, "2021-07-01-10-37-38-quad-easy"))
    later["ground_truth/gt-nc-quad-easy.csv"] = rows(parted, *ns, separator=",")
    clouds = {f"raw_format/ouster_scan/cloud_{p.replace(',', '_')}.pcd": b"" for p in parted}
    cloud = made(lambda folder: pcd(folder, "binary"))["0.pcd"]
    clouds = dict.fromkeys(clouds, cloud) | {"ground_truth/registered_poses.csv": rows(
        parted, *ns, separator=",")}  # fmt: skip
    hesai = {f"raw/lidar-clouds/{p.replace('.', '_')}.pcd": made(
        lambda folder, s=s: pcd(folder, "binary", timestamp=s * 1e-9 + TIMES.astype(float))
    )["0.pcd"] for p, s in zip(pointed, STAMPS, strict=True)}  # fmt: skip
    samples = [START + i * 5_000_000 for i in range(60)]
    hesai["raw/imu.csv"] = b"#secs,nsecs,acceleration,angular velocity\n" + rows(
        [f"{s // 10**9},{s % 10**9}" for s in samples], 0, 0, 9.81, 0.1, 0, 0, separator=","
    )
    hesai["processed/trajectory/gt-tum.txt"] = rows(pointed, *ns)
    spires_bag = made(bag("ros1", spires, "1710754066_0")) | {"gt-tum.txt": rows(pointed, *ns)}
    xsens = rows(samples, *[0, 0, 0, 1], *[0.0] * 3, *[0.1, 0, 0], *[0, 0, 9.81], *[0.3, 0.1, 0.2],
                 separator=",")  # fmt: skip
    firings = np.zeros((64 * 1024, 4), "<f4")
    firings[:, 0] = 5.0
    mulran = {
        f"Ouster/{START}.bin": firings.tobytes(),
        "global_pose.csv": rows(STAMPS, *IDENTITY.split(), separator=","),
        "xsens_imu.csv": xsens,
        "data_stamp.csv": "".join(f"{stamp},ouster\n" for stamp in STAMPS).encode(),
    }
    helipr = {}
    velodyne = records(intensity=("<f4", 7.0), ring=("<u2", RINGS), time=("<f4", TIMES))
    ouster = records(intensity=("<f4", 7.0), t=("<u4", TIMES * 1e9), reflectivity=("<u2", 1),
                     ring=("<u2", RINGS), ambient=("<u2", 1))  # fmt: skip
    avia = records(intensity=("u1", 7), tag=("u1", 0), laser=("u1", 1),
                   offset_time=("<u4", TIMES * 1e9))  # fmt: skip
    aeva = records(reflectivity=("<f4", 7.0), velocity=("<f4", 1.0),
                   offset_time=("<i4", TIMES * 1e9), laser=("u1", 1),
                   intensity=("<f4", 7.0))  # fmt: skip
    sorts = ("Ouster", ouster), ("Velodyne", velodyne), ("Avia", avia), ("Aeva", aeva)
    for lidar, sweep in sorts:
        files = {f"LiDAR/{lidar}/{stamp}.bin": sweep.tobytes() for stamp in STAMPS}
        files[f"LiDAR_GT/{lidar}_gt.txt"] = rows(STAMPS, *ns)
        files["Inertial_data/xsens_imu.csv"] = xsens
        helipr[f"HeLiPR {lidar}"] = Specimen(files, at(lidar=lidar))
    return {
        "Newer College 2020": Specimen(college, at()),
        "Newer College 2021": Specimen(later, at()),
        "Newer College PCD": Specimen(clouds, at()),
        "Oxford Spires PCD": Specimen(hesai, at()),
        "Oxford Spires bag": Specimen(spires_bag, at()),
        "MulRan": Specimen(mulran, at()),
    } | helipr


def rigs() -> dict[str, Specimen]:
    """Boreas, Hilti, NTU VIRAL, and a bag with a receiver and wheels."""
    pose = [1, 2, 3, 0, 0, 0, 0.1, 0.2, 0.3, 0, 0, 0]
    points = records(intensity=("<f4", 7.0), laser=("<f4", RINGS), time=("<f4", TIMES - 0.05))
    boreas = {f"lidar/{stamp // 1000}.bin": points.tobytes() for stamp in STAMPS}
    boreas["applanix/lidar_poses.csv"] = b"GPSTime,easting,northing\n" + rows(
        [stamp // 1000 for stamp in STAMPS], *pose, separator=","
    )
    hesai = recording("ros1", "/hesai/pandar", "/alphasense/imu", "timestamp")
    hilti = made(bag("ros1", hesai, "exp04"))
    hilti["exp04_imu.txt"] = rows([f"{s * 1e-9:.9f}" for s in STAMPS], "1 2 3 0 0 0.6 0.8")
    viral = recording("ros1", "/os1_cloud_node1/points", "/imu/imu", "t")
    store = bags.ROS1
    aided = recording("ros1")
    for stamp in STAMPS:
        aided.append(("/fix", stamp, bags.fix(store, stamp, (49.0, 8.4, 112.0))))
        aided.append(("/twist", stamp, bags.twist(store, stamp, 1.0, 0.1)))
        aided.append(("/odom", stamp, bags.odometry(store, stamp, (1.0, 2.0, 3.0))))
    imu = b"#timestamp [ns],w,a\n" + rows(
        [START + i * 10_000_000 for i in range(40)], 0.1, 0, 0, 0, 0, 9.81, separator=","
    )
    beside = {f"velodyne/{i}.bin": columns() for i in range(3)} | {"imu0/data.csv": imu}
    beside["times.txt"] = "".join(f"{stamp * 1e-9:.9f}\n" for stamp in STAMPS).encode()
    return {
        "Boreas": Specimen(boreas, at()),
        "Hilti": Specimen(hilti, at("exp04.bag")),
        "NTU VIRAL": Specimen(made(bag("ros1", viral, "eee_01")), at("eee_01.bag")),
        "receiver and wheels": Specimen(made(bag("ros1", aided)), at("run.bag")),
        "Livox ros1": Specimen(made(bag("ros1", livox("ros1"))), at("run.bag")),
        "Livox mcap": Specimen(made(bag("mcap", livox("mcap"))), at("run")),
        "wheels' poses": Specimen(
            made(bag("ros1", aided)), at("run.bag", wheels_topic="/odom", gnss_topic="/fix")
        ),
        "EuRoC IMU": Specimen(beside, at()),
    }


def recordings() -> dict[str, Specimen]:
    """Bags with every compression, and LOAM's topics."""
    modes = {
        "ros1": (None, Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4),
        "sqlite3": (None, CompressionMode.FILE, CompressionMode.MESSAGE),
        "mcap": (None, CompressionMode.STORAGE, CompressionMode.MESSAGE),
    }
    found = {}
    for kind, compressions in modes.items():
        for mode in compressions:
            files = made(bag(kind, recording(kind), compression=mode))
            # A folder, or the file in it alone.
            alone = next(n for n in files if not n.endswith(".yaml"))
            name = f"{kind} {getattr(mode, 'name', 'plain').lower()}"
            found[name] = Specimen(files, at("run" if "/" in alone else alone))
            if mode is None and kind != "ros1":
                found[f"{kind} alone"] = Specimen({alone: files[alone]}, at(alone))
    loam = made(bag("ros1", bags.loam_recording(count=2)))
    found["LOAM topics"] = Specimen(loam, at("run.bag", axes="lidar"))
    return found


def poses() -> dict[str, Specimen]:
    """Reference poses of a user's own."""
    pointed = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in STAMPS]
    store = bags.ROS1
    odometry = [("/odom", s, bags.odometry(store, s, (1.0, 2.0, 3.0))) for s in STAMPS]
    texts = {
        "TUM": rows(pointed, "1 2 3 0 0 0.6 0.8"),
        "positions": rows(pointed, "1 2 3"),
        "EuRoC": b"#timestamp, p\n" + rows(STAMPS, *"1231000", 0, 0, separator=","),
        "KITTI poses": f"{IDENTITY}\n".encode() * 3,
    }

    def read(folder: Path) -> object:
        (path,) = folder.iterdir()
        return read_truth(path, stamps=np.array(STAMPS, np.int64))

    found = {name: Specimen({"poses.txt": text}, read) for name, text in texts.items()}
    found["poses in a bag"] = Specimen(made(bag("ros1", odometry)), read)
    return found


def own() -> dict[str, Specimen]:
    """What the package writes and reads again: configuration, graph, checkpoint, study."""
    lines = config.dump_config(Config()).splitlines()
    settings = "\n".join(line for line in lines if not line.lstrip().startswith("#")).encode()
    world = SimulatedWorld("room", frames=3, columns=60)
    turned = Config().changed("loops.enabled=true", "pose_graph.keyframe_distance=0.001")

    def checkpoint(folder: Path, **options: Any) -> Any:
        return run(world, turned, max_frames=2, checkpoint=Checkpoint(folder, **options))

    def graph(folder: Path) -> None:
        loops = run(world, turned).loops
        assert loops is not None
        write_graph(folder / "graph.g2o", loops.graph.saved())

    study = b"""sequences:
  room: {path: "sim:room?frames=40"}
configs:
  base: {}
  more: {set: {solver.iterations: 40}}
seeds: [0, 1]
frames: 20
"""
    return {
        "configuration": Specimen(
            {"c.yaml": settings},
            lambda f: parse_config((f / "c.yaml").read_bytes().decode("utf-8", "replace")),
        ),
        "pose graph": Specimen(made(graph), lambda folder: read_graph(folder / "graph.g2o")),
        "checkpoint": Specimen(made(checkpoint), lambda f: checkpoint(f, resume=True)),
        "study": Specimen({"s.yaml": study}, lambda folder: load_spec(folder / "s.yaml")),
    }


def all_specimens() -> dict[str, Specimen]:
    """By the name of the format."""
    saved = {name: Specimen(*parts) for name, parts in maps(made).items()}
    return folders() | kitti() | known() | rigs() | recordings() | poses() | own() | saved
