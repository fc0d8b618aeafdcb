"""Runs that are killed at random moments: are results ever half, and does ``--resume`` go on.

``python -m benchmarks.kills [--kills 50] [--frames 400] [--seed 0]``
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

from loam_gtsam.io.run_files import RUN_FILES

_BYTES = ("trajectory.tum", "trajectory_kitti.txt", "trajectory_covariance.csv", "map.ply")
"""Files that hold no times."""
_STAGES = ("stage_names", "stage_seconds")


def main() -> None:
    """Kill, go on, compare; exits with 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50, help="half of them of either kind")
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chance = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as scratch:
        faults = _resumed(Path(scratch), options.frames, options.kills // 2, chance)
        faults += _replaced(Path(scratch), (options.kills + 1) // 2, chance)
    for fault in faults:
        print(fault)
    print(f"{options.kills} kills, {len(faults)} faults")
    if faults:
        raise SystemExit(1)


def _resumed(scratch: Path, frames: int, kills: int, chance: random.Random) -> list[str]:
    """One run after another that is killed and gone on with, until it is complete."""
    whole, killed = scratch / "whole", scratch / "killed"
    seconds = _complete(whole, frames)
    faults: list[str] = []
    runs = 0
    while kills:
        if _killed(
            _command(killed, frames, "--resume", "--checkpoint", "0.2"), chance, seconds / 3
        ):
            kills -= 1
            if (killed / "summary.json").exists():
                faults += _differences(killed, whole)
        else:
            runs += 1
            faults += _differences(killed, whole)
            shutil.rmtree(killed)
    _complete(killed, frames, "--resume")
    faults += _differences(killed, whole)
    print(f"{runs + 1} runs of {frames} sweeps came to their ends")
    return faults


def _replaced(scratch: Path, kills: int, chance: random.Random) -> list[str]:
    """Results that are replaced by those of a longer run, which is killed."""
    old, new, killed = (scratch / name for name in ("old", "new", "replaced"))
    _complete(old, 10)
    seconds = _complete(new, 20)
    shutil.copytree(old, killed)
    faults: list[str] = []
    replaced = cut_off = 0
    for _ in range(kills):
        _killed(_command(killed, 20, "--overwrite"), chance, 1.1 * seconds)
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


def _command(folder: Path, frames: int, *options: str) -> list[str]:
    world = f"sim:street_loop?frames={frames}"
    run = [sys.executable, "-m", "loam_gtsam.cli", "run", world, "--output", str(folder)]
    return [*run, "--quiet", "--workers", "0", *options]


def _complete(folder: Path, frames: int, *options: str) -> float:
    """Seconds that a run takes."""
    started = time.monotonic()
    subprocess.run(_command(folder, frames, *options), check=True)
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
