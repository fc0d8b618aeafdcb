"""Runs that are killed at random moments: are results ever half, and does ``--resume`` go on.

``python -m benchmarks.kills [--kills 50] [--frames 100] [--seed 0]``
"""

from __future__ import annotations

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.cases import ROOT
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.datasets.decode.geodesy import geodetic_of
from loam_gtsam.io.run_files import RUN_FILES

_BYTES = ("trajectory.tum", "trajectory_kitti.txt", "trajectory_covariance.csv", "map.ply")
"""Files that hold no times."""
_STAGES = ("stage_names", "stage_seconds")
_ROOM, _BLOCK = "sim:room?columns=300&imu=mems&speed=3", "sim:street_loop?columns=450&imu=mems"
MODES: dict[str, tuple[str, tuple[str, ...]]] = {
    "without IMU": (_BLOCK, ("--set", "imu.coupling=off")),
    "tight IMU": (_BLOCK, ()),
    "loose IMU": (_BLOCK, ("--set", "imu.coupling=loose")),
    "IMU's tilt in the solve": (_BLOCK, ("--set", "imu.prior=sigma")),
    "small places": ("sim:stairwell?columns=300&imu=mems", ()),
    "loops": (_ROOM, ("--loops", "--set", "pose_graph.keyframe_distance=0.3")),
    "loops, loose IMU": (_ROOM, ("--loops", "--set", "imu.coupling=loose")),
    "a process for features": (_ROOM, ("--workers", "1")),
    "scan to scan": (_BLOCK, ("--set", "odometry.method=scan_to_scan")),
    "preset loam": (_BLOCK, ("--preset", "loam")),
    "archive on disk": (_BLOCK, ("--set", "map.cube_size=5.0", "--set", "map.window=[3, 3, 3]",
                        "--set", "map.window_margin=1", "--set", "map.neighbourhood=[3, 3, 3]",
                        "--set", "map.archive_megabytes=0.01",
                        "--set", "map.archive_dir={scratch}/cubes")),
    "receiver and wheels": ("{scratch}/aided.bag", ("--set", "aiding.gnss=true",
                            "--set", "aiding.wheels=true", "--set", "imu.coupling=off")),
}  # fmt: skip
"""World, or a bag of :func:`write_aided`, and options of the runs that are gone on with."""


def main() -> None:
    """Kill, go on, compare; exits with 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50, help="a fifth of them while replacing")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chance = random.Random(options.seed)
    replaced = -(-options.kills // 5)
    each, more = divmod(options.kills - replaced, len(MODES))
    faults: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        write_aided(Path(scratch) / "aided.bag", options.frames)
        for number, mode in enumerate(MODES):
            kills = each + (number < more)
            found = _resumed(Path(scratch), mode, options.frames, kills, chance)
            print(f"{mode}: {kills} kills, {len(found)} faults", flush=True)
            faults += [f"{mode}: {fault}" for fault in found]
        faults += _replaced(Path(scratch), replaced, chance)
    for fault in faults:
        print(fault)
    print(f"{options.kills} kills, {len(faults)} faults")
    if faults:
        raise SystemExit(1)


def write_aided(path: Path, frames: int) -> None:
    """A bag with sweeps of the block, fixes of a receiver and poses of wheels."""
    sys.path.append(str(ROOT / "tests"))
    from support import bags  # type: ignore[import-not-found]

    world, store = SimulatedWorld("street_loop", frames=frames, columns=450), bags.ROS1
    truth, recording = world.truth, []
    places = geodetic_of(truth.positions, np.array([47.5, 8.5, 450.0]))
    turns = Rotation.from_matrix(truth.map_T_lidar[:, :3, :3]).as_quat()
    for scan, pose, place, turn in zip(world, truth.map_T_lidar, places, turns, strict=True):
        assert scan.times is not None
        assert scan.rings is not None
        rings, times = scan.rings.astype("<u2"), scan.times.astype("<f4")
        cloud = bags.cloud(store, scan.stamp, scan.points, ring=rings, time=times)
        wheels = bags.odometry(store, scan.stamp, pose[:3, 3], turn)
        recording += [("/points", scan.stamp, cloud), ("/wheels", scan.stamp, wheels)]
        recording.append(("/fix", scan.stamp, bags.fix(store, scan.stamp, place)))
    bags.write_bag(path, "ros1", recording)


def _resumed(scratch: Path, mode: str, frames: int, kills: int, chance: random.Random) -> list[str]:
    """One run after another that is killed and gone on with, until it is complete."""
    if not kills:
        return []
    whole, killed = (scratch / name / mode.replace("'", "") for name in ("whole", "killed"))
    command = _command(killed, frames, mode, "--resume", "--checkpoint", "0.2")
    seconds = _complete(_command(whole, frames, mode))
    faults: list[str] = []
    while kills:
        if _killed(command, chance, 1.1 * seconds):
            kills -= 1
            if (killed / "summary.json").exists():
                faults += _differences(killed, whole)
        else:
            faults += _differences(killed, whole)
            shutil.rmtree(killed)
    _complete(command)
    return faults + _differences(killed, whole)


def _replaced(scratch: Path, kills: int, chance: random.Random) -> list[str]:
    """Results that are replaced by those of a longer run, which is killed."""
    old, new, killed = (scratch / name for name in ("old", "new", "replaced"))
    _complete(_command(old, 10))
    seconds = _complete(_command(new, 20))
    shutil.copytree(old, killed)
    faults: list[str] = []
    replaced = cut_off = 0
    for _ in range(kills):
        _killed(_command(killed, 20, "without IMU", "--overwrite"), chance, 1.5 * seconds)
        if not (killed / "summary.json").exists():
            cut_off += 1  # in the milliseconds of the move: nothing says that they are complete
        elif not _differences(killed, new):
            replaced += 1
        else:
            faults += _differences(killed, old)
            continue
        shutil.rmtree(killed)
        shutil.copytree(old, killed)
    print(
        f"{kills} times: {replaced} the new results, {cut_off} marked incomplete, else the old ones"
    )
    return faults


def _command(folder: Path, frames: int, mode: str = "without IMU", *options: str) -> list[str]:
    world, settings = MODES[mode]
    scratch = folder.parent.parent
    path = f"{world}&frames={frames}" if world.startswith("sim:") else world.format(scratch=scratch)
    run = [sys.executable, "-m", "loam_gtsam.cli", "run", path]
    run += ["--output", str(folder), "--quiet", "--no-plot"]
    run += [setting.format(scratch=scratch) for setting in settings]
    return [*run, *(() if "--workers" in settings else ("--workers", "0")), *options]


def _complete(command: list[str]) -> float:
    """Seconds that a run takes."""
    started = time.monotonic()
    subprocess.run(command, check=True)
    return time.monotonic() - started


def _killed(command: list[str], chance: random.Random, most: float) -> bool:
    """Whether a process was killed within so many seconds before it was done."""
    process = subprocess.Popen(command)
    try:
        code = process.wait(chance.uniform(0.0, most))
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True
    if code:
        raise SystemExit(f"exit code {code} of: {' '.join(command)}")
    return False


def _differences(folder: Path, whole: Path) -> list[str]:
    """Files of a run that are not as in another but for the times it took."""
    missing = [name for name in RUN_FILES if not (folder / name).exists()]
    if missing:
        return [f"missing: {name}" for name in missing]
    found = [n for n in _BYTES if (folder / n).read_bytes() != (whole / n).read_bytes()]
    with np.load(folder / "run.npz") as one, np.load(whole / "run.npz") as two:
        for key in set(one.files) - set(_STAGES):
            nan = one[key].dtype.kind == "f"
            if not np.array_equal(one[key], two[key], equal_nan=nan):
                found.append(f"run.npz: {key}")
    return found


if __name__ == "__main__":
    main()
