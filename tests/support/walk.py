"""A page of the documentation, walked from top to bottom as a reader would."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from support.bags import Recording, cloud, fix, imu, odometry, store_of, twist, write_bag
from support.cli import loam

from loam_gtsam import SimulatedWorld, run
from loam_gtsam.datasets.decode.geodesy import geodetic_of
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.maps import save_map

VENV = ("python3", ".")
"""`python3 -m venv .venv` and `. .venv/bin/activate`."""
ORIGIN = np.array([47.5, 8.5, 450.0])
STUDY = "sequences: {room: 'sim:room?frames=3'}\nconfigs: {default: gtsam, loam: loam}\n"
RUN = ("python", "console", "bash")
NEEDS = "# needs "
"""A block whose first line begins like this is not run: it needs what no test has."""


class Block(NamedTuple):
    """One fenced block of a page."""

    language: str
    text: str

    @property
    def runs(self) -> bool:
        return not self.text.startswith(NEEDS)


def blocks(page: Path, *languages: str) -> list[Block]:
    """The fenced blocks, those of some languages or all, in their order."""
    found = re.findall(r"^ *```(.*?)\n(.*?)^ *```", page.read_text("utf-8"), re.M | re.S)
    return [Block(*block) for block in found if not languages or block[0] in languages]


def recorded(world: SimulatedWorld, kind: str) -> Recording:
    """Clouds, IMU, wheels, fixes and reference poses of a drive."""
    store = store_of(kind)
    recording: Recording = []
    for scan in world:
        columns = {"ring": scan.rings.astype("u2"), "time": scan.times.astype("f4")}
        message = cloud(store, scan.stamp, scan.points, **columns)
        recording.append(("/points", scan.stamp + 120_000_000, message))
    rows = np.hstack([world.imu.orientation, world.imu.gyro, world.imu.acceleration])
    for stamp, row in zip(world.imu.stamps.tolist(), rows, strict=True):
        recording.append(("/imu", stamp, imu(store, stamp, row)))
    places = world.truth.positions
    for stamp, place, (latitude, longitude, height) in zip(
        world.truth.stamps.tolist(), places, geodetic_of(places, ORIGIN), strict=True
    ):
        recording.append(("/odometry/gps", stamp, odometry(store, stamp, place)))
        recording.append(("/gps/fix", stamp, fix(store, stamp, (latitude, longitude, height))))
        recording.append(("/wheels", stamp, twist(store, stamp, 2.0, 0.0)))
    return sorted(recording, key=lambda entry: entry[1])


def write_drive(folder: Path) -> None:
    """drive.bag, PATH, MONDAY, TUESDAY, MAP, poses.tum and spec.yaml, of which the pages speak."""
    world = SimulatedWorld("rooms", frames=4, columns=240, speed=2.0)
    write_bag(folder / "drive", "ros1", recorded(world, "ros1"))
    for name in ("PATH", "MONDAY", "TUESDAY"):
        write_bag(folder / name, "sqlite3", recorded(world, "sqlite3"))
    write_tum(folder / "poses.tum", world.truth)
    save_map(folder / "MAP", run(world).pipeline)
    (folder / "spec.yaml").write_text(STUDY)


def walk(page: Path, elsewhere: str) -> dict[str, Any]:
    """Run the blocks of a page in this folder; returns what its Python blocks have named.

    Commands that the script ``elsewhere`` has are left to it.
    """
    names: dict[str, Any] = {"__name__": page.stem}
    for block in blocks(page, *RUN):
        if not block.runs:
            continue
        if block.language == "python":
            exec(compile(block.text, f"{page.name}: {block.text[:60]}", "exec"), names)
            continue
        for line in re.split(r"\n|&&", block.text):
            words = shlex.split(line, comments=True)
            if not words or f"step {line.strip()}" in elsewhere or words[0] in VENV:
                continue
            assert words[0] == "loam-gtsam", f"{page.name}: {line}"
            done = loam(*words[1:])
            assert done.exit_code == 0, f"{page.name}: {line}\n{done.output}\n{done.exception}"
    return names
