"""How far two machines differ: ``python -m benchmarks.core_types``.

The same runs, each in a process of its own, with the routines that OpenBLAS and numpy choose on
other processors (``OPENBLAS_CORETYPE``, ``NPY_DISABLE_CPU_FEATURES``), compared pose by pose.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

FRAMES = 80
WORLDS = ("street_loop", "room")
IMUS = {
    "none": ("--set", "imu.coupling=off"),
    "tight": (),
    "loose": ("--set", "imu.coupling=loose"),
}
_OLDER, _OLDEST = "X86_V4 AVX512_ICL AVX512_SPR", "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"
"""Without AVX-512; without AVX2 besides."""
MACHINES = {
    "this one": {},
    "this one, again": {},
    "Zen": {"OPENBLAS_CORETYPE": "Zen"},
    "SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "Haswell": {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": _OLDER},
    "Nehalem": {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": _OLDEST},
}


def poses(world: str, imu: str, machine: str, folder: Path) -> np.ndarray:
    """(N, 4, 4) poses of a run."""
    command = [sys.executable, "-W", "ignore", "-m", "loam_gtsam.cli", "run"]
    command += [f"sim:{world}?frames={FRAMES}&imu=mems", *IMUS[imu], "--no-plot", "--quiet"]
    command += ["--workers", "0", "--checkpoint", "0", "--overwrite", "--output", str(folder)]
    subprocess.run(command, check=True, env=os.environ | MACHINES[machine])
    with np.load(folder / "run.npz") as file:
        found: np.ndarray = file["map_T_lidar"]
    return found


def difference(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Largest distance, metres, and angle, degrees, of two poses of the same sweep."""
    metres = np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1).max()
    # The chord of the angle: the trace has no digits left for small ones.
    chord = np.linalg.norm(one[:, :3, :3] - other[:, :3, :3], axis=(1, 2)).max() / np.sqrt(2.0)
    return float(metres), float(np.degrees(chord))


def main() -> None:
    """Print the table of docs/testing.md."""
    print(f"| world, IMU | {' | '.join(list(MACHINES)[1:])} |")
    print(f"|---|{'---|' * (len(MACHINES) - 1)}")
    with tempfile.TemporaryDirectory() as scratch:
        for world in WORLDS:
            for imu in IMUS:
                found = [poses(world, imu, machine, Path(scratch)) for machine in MACHINES]
                cells = []
                for other in found[1:]:
                    metres, degrees = difference(found[0], other)
                    same = np.array_equal(found[0], other)
                    cells.append("0" if same else f"{metres:.0e} m, {degrees:.0e} deg")
                print(f"| {world}, {imu} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
