"""IMUs that are wrong: is it said, and what does it cost? ``python -m benchmarks.imu_faults``.

Each world is mapped without an IMU, with a good one, and with one that is wrong in each way.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.config import Config
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.datasets.arrays import ArrayDataset
from loam_gtsam.pipeline import RunResult, run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import FloatArray, ImuSamples

WORLDS = ("street_loop", "park", "shaken", "garage", "room")
FRAMES = 80
_WRONG_FROM = 3.0  # seconds from the first sample at which faults set in that come later
_TURNED = Rotation.from_euler("z", 90.0, degrees=True)
_RESULTS = Path("benchmarks/results/imu_faults")
_HEAD = """# IMUs that are wrong, measured

Made by `python -m benchmarks.imu_faults`. ATE in millimetres of the same sweeps without an IMU,
with a good one, and with one that is wrong in each way; in bold where no sentence named it.

"""

Fault = Callable[[ImuSamples, FloatArray], ImuSamples]


def _late(seconds: float) -> Fault:
    return lambda imu, t: replace(imu, stamps=imu.stamps + round(seconds * 1e9))


def _gyro(change: Callable[[FloatArray, FloatArray], FloatArray]) -> Fault:
    return lambda imu, t: replace(imu, gyro=change(imu.gyro, t))


def _force(change: Callable[[FloatArray, FloatArray], FloatArray]) -> Fault:
    return lambda imu, t: replace(imu, acceleration=change(imu.acceleration, t))


def _orientation(change: Callable[[Rotation], Rotation]) -> Fault:
    return lambda imu, t: replace(imu, orientation=change(_of(imu)).as_quat())


def _of(imu: ImuSamples) -> Rotation:
    assert imu.orientation is not None
    return Rotation.from_quat(imu.orientation)


def _mounted(R: Rotation) -> Fault:
    def change(imu: ImuSamples, t: FloatArray) -> ImuSamples:
        gyro, force = R.inv().apply(imu.gyro), R.inv().apply(imu.acceleration)
        return ImuSamples(imu.stamps, (_of(imu) * R).as_quat(), gyro, force)

    return change


def _frozen(imu: ImuSamples, t: FloatArray) -> ImuSamples:
    row = np.where(t < _WRONG_FROM, np.arange(len(t)), np.searchsorted(t, _WRONG_FROM))
    assert imu.orientation is not None
    return ImuSamples(imu.stamps, imu.orientation[row], imu.gyro[row], imu.acceleration[row])


def _without_gravity(imu: ImuSamples, t: FloatArray) -> ImuSamples:
    return replace(imu, acceleration=imu.acceleration - _of(imu).inv().apply([0.0, 0.0, 9.81]))


def _constant(R: Rotation) -> Rotation:
    return Rotation.identity(len(R))


def _random(R: Rotation) -> Rotation:
    return Rotation.random(len(R), random_state=1)


KINDS: dict[str, Fault] = {
    "frozen from a moment on": _frozen,
    "axes turned by 90 degrees": _mounted(_TURNED),
    "upside down": _mounted(Rotation.from_euler("x", 180.0, degrees=True)),
    "clock 50 ms late": _late(0.05),
    "clock 50 ms early": _late(-0.05),
    "clock 200 ms late": _late(0.2),
    "gyro in degrees": _gyro(lambda gyro, t: np.rad2deg(gyro)),
    "gyro with one sign wrong": _gyro(lambda gyro, t: gyro * [1.0, 1.0, -1.0]),
    "gyro axes turned alone": _gyro(lambda gyro, t: _TURNED.apply(gyro)),
    "gyro off by 1 rad/s later": _gyro(lambda g, t: g + (t > _WRONG_FROM)[:, None] * [0, 0, 1.0]),
    "acceleration in g": _force(lambda force, t: force / 9.81),
    "gravity taken off": _without_gravity,
    "acceleration off by 2 m/s^2": _force(lambda force, t: force + np.array([2.0, 0.0, 0.0])),
    "acceleration of 160 m/s^2 for 1 s": _force(
        lambda force, t: force + (np.abs(t - 3.5) < 0.5)[:, None] * [160.0, 0.0, 0.0]
    ),
    "orientation never changes": _orientation(_constant),
    "orientation is random": _orientation(_random),
    "orientation inverse": _orientation(lambda R: R.inv()),
    "orientation with z down": _orientation(lambda R: Rotation.from_euler("x", np.pi) * R),
}


def with_fault(world: SimulatedWorld, kind: str) -> ArrayDataset:
    """The world with an IMU that is wrong; with "none" without one, with "good" as it is."""
    imu: ImuSamples | None = world.imu
    if kind == "none":
        imu = None
    elif kind != "good":
        imu = KINDS[kind](world.imu, (world.imu.stamps - world.imu.stamps[0]) * 1e-9)
    return ArrayDataset(list(world), imu=imu, truth=world.truth, sensor=world.sensor)


def said(result: RunResult) -> tuple[str, ...]:
    """The sentences of a run about its IMU."""
    if result.imu is None:
        return ()
    given_up = () if result.imu.gyro_trusted else ("gyro given up",)
    return (*result.imu.problems, *given_up)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imu_faults", description=__doc__)
    parser.add_argument("--worlds", nargs="+", default=WORLDS)
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--imu", default="mems", help="white or mems")
    parser.add_argument("--output", type=Path, default=_RESULTS, help="folder for the table")
    options = parser.parse_args(arguments)
    rows = []
    for kind in ("none", "good", *KINDS):
        cells = []
        for scene in options.worlds:
            world = SimulatedWorld(scene, frames=options.frames, imu=options.imu, seed=2)
            result = run(with_fault(world, kind), Config())
            millimetres = 1e3 * absolute_error(result.trajectory, world.truth).rmse
            told = said(result)
            named = bool(told) or kind in ("none", "good")
            cells.append(f"{millimetres:.1f}" if named else f"**{millimetres:.1f}**")
            print(f"{kind}, {scene}: {millimetres:.1f} mm", *told, sep="\n    ", flush=True)
        rows.append(f"| {kind} | {' | '.join(cells)} |")
    head = f"| IMU | {' | '.join(options.worlds)} |\n|---|{'---|' * len(options.worlds)}"
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "imu_faults.md").write_text(
        "\n".join([_HEAD + head, *rows]) + "\n", encoding="utf-8"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
