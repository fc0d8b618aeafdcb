"""Three real sweeps of an Ouster OS1-128, with the time of every point."""

import sys
from pathlib import Path

import numpy as np

from loam_gtsam import open_dataset, run

sample = Path(__file__).parent / "data" / "ouster_os1_128"
dataset = open_dataset(sys.argv[1] if len(sys.argv) > 1 else sample)

info = dataset.info()
for label, value in {"kind": info.kind, **info.facts}.items():
    print(f"{label}: {value}")

result = run(dataset)
positions = result.trajectory.positions
for update, step in zip(result.updates[1:], np.diff(positions, axis=0), strict=True):
    print(f"{update.status}: step {step.round(3)} m, {np.linalg.norm(step):.3f} m")
