"""What the command line shows: summary, time per stage, what was understood of the input."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from loam_gtsam.config import Config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.frontend.organise import assign_rings, assign_times, usable_columns
from loam_gtsam.io.run_files import stage_seconds
from loam_gtsam.pipeline import ImuSummary, RunResult, effective_config, imu_buffer
from loam_gtsam.types import (
    BadSweep,
    FeatureSweep,
    FrameStatus,
    ImuSamples,
    MapUpdate,
    Scan,
    Sweep,
    SweepError,
)

_EXPECTED = (FrameStatus.OK, FrameStatus.FIRST)
_MESSAGES = 3
_TRIED_SWEEPS = 5
_MIN_PATH = 10.0
"""Metres. An error in per cent of a shorter path says nothing."""


def summary(
    result: RunResult,
    name: str,
    seconds: float,
    accuracy: dict[str, Any],
    problems: Sequence[str] = (),
) -> Group:
    """Frames, statuses, accuracy, and the first messages of what was not fine."""
    table = _table(name)
    frames = len(result.updates)
    table.add_row("frames", f"{frames} in {seconds:.1f} s ({frames / seconds:.1f} frames/s)")
    statuses = ", ".join(f"{count} {status}" for status, count in result.status_counts.items())
    table.add_row("status", statuses)
    if result.faults:
        faults = ", ".join(f"{count} {fault}" for fault, count in result.faults.items())
        table.add_row("not used", faults)
    table.add_row("path", f"{result.trajectory.path_length:.1f} m")
    table.add_row(
        "map", f"{len(result.edge_points)} edge and {len(result.plane_points)} plane points"
    )
    lost = sum(stats.get("dropped_points", 0) for stats in result.map_stats.values())
    if lost:
        table.add_row("map, dropped", f"{lost} points; see map.archive_megabytes, map.archive_dir")
    if "problem" in accuracy:
        table.add_row("accuracy", Text(accuracy["problem"]))
    elif accuracy:
        error, length = accuracy["ate_rmse_m"], accuracy["compared_length_m"]
        share = f" ({100.0 * error / length:.3f} % of the path)" if length >= _MIN_PATH else ""
        text = f"ATE {error:.3f} m{share}, at most {accuracy['ate_max_m']:.3f} m"
        table.add_row("accuracy", text)
    if result.loops is not None:
        counts = result.loops.counts()
        used = f"{counts.pop('on')} of {counts.pop('loops')} found are used"
        others = [f"{count} {name.replace('_', ' ')}" for name, count in counts.items()]
        table.add_row("loops", f"{used}; {', '.join(others)}")
    about_input = [Text(f"  input: {problem}", style="yellow") for problem in problems]
    if result.imu is not None:
        for label, value in imu_facts(result.imu).items():
            table.add_row(label, value)
        about_input += [Text(f"  {line}", style="yellow") for line in _imu_problems(result.imu)]
    return Group(table, *about_input, *_notes(result.updates))


def imu_facts(imu: ImuSummary) -> dict[str, str]:
    """Label -> value, of what was made of an IMU."""
    level = imu.level
    if level is None:
        known = imu.report.orientation != "none"
        up = "unknown: no samples about the first sweep" if known else "unknown: no orientation"
    else:
        angles = f"roll {np.degrees(level.roll):.2f}, pitch {np.degrees(level.pitch):.2f} deg"
        state = "at rest" if level.source == "still" else "moving"
        up = f"{angles}, from {level.samples} samples, {state}"
    rates = " ".join(f"{1e3 * rate:+.2f}" for rate in imu.gyro_bias)
    return {
        "IMU, level": up,
        "IMU, orientation": _ORIENTATIONS[imu.report.orientation],
        "IMU, roll and pitch": f"priors: {_counts(imu.tilt_priors)}",
        "IMU, de-skew": _counts(imu.sweep_motions),
        "IMU, gyro": f"bias {rates} mrad/s",
    }


_ORIENTATIONS = {
    "ahrs": "its own",
    "gravity_filter": "from gyro and acceleration (imu.filter_seconds)",
    "none": "none",
}


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def _imu_problems(imu: ImuSummary) -> list[str]:
    problems = list(imu.report.problems)
    dropped = imu.tilt_priors.get("dropped", 0)
    if dropped and imu.report.orientation != "none":
        problems.append(
            f"IMU: no orientation at {dropped} of {sum(imu.tilt_priors.values())} sweeps: gaps "
            "longer than imu.max_gap, or another clock than that of the sweeps"
        )
    if not imu.gyro_trusted:
        problems.append(
            "IMU: its gyro turned unlike the scans and was given up; check imu.lidar_R_imu_deg, "
            "units and stamps"
        )
    return [*problems, imu.problem] if imu.problem else problems


def _notes(updates: Sequence[MapUpdate]) -> list[Text]:
    odd = [(n, u) for n, u in enumerate(updates) if u.status not in _EXPECTED]
    notes = [
        Text(f"  frame {n}: {u.status}: {u.message}", style="yellow") for n, u in odd[:_MESSAGES]
    ]
    if len(odd) > _MESSAGES:
        notes.append(Text(f"  ... and {len(odd) - _MESSAGES} more: 'messages' in run.npz"))
    return notes


def profile_table(updates: Sequence[MapUpdate]) -> Table:
    """Median and 95th percentile over the frames in which a stage ran, and share of all time."""
    names, seconds = stage_seconds(updates)
    table = Table("stage", title="Time per frame [ms]", title_justify="left", box=None)
    for column in ("median", "95 %", "share"):
        table.add_column(column, justify="right")
    total = float(np.nansum(seconds)) or 1.0
    columns = [*zip(names, seconds.T, strict=True), ("total", np.nansum(seconds, axis=1))]
    for name, column in columns:
        ran = 1e3 * column[~np.isnan(column)]
        median, high = np.percentile(ran, (50.0, 95.0)) if len(ran) else (0.0, 0.0)
        share = 100.0 * ran.sum() * 1e-3 / total
        table.add_row(name, f"{median:.1f}", f"{high:.1f}", f"{share:.0f} %")
    return table


def inspection(dataset: Dataset, config: Config) -> tuple[Group, bool]:
    """What was understood of a data set, and whether it can be run."""
    config = effective_config(config, dataset)
    info = dataset.info()
    table = _table(info.kind)
    table.add_row("path", Text(info.path))
    for label, value in info.facts.items():
        table.add_row(label, Text(value))
    problems = list(info.problems)
    facts: dict[str, str] = {}
    runnable = False
    for number, sweep in enumerate(itertools.islice(dataset, _TRIED_SWEEPS)):
        try:
            facts = sweep_facts(sweep, config)
        except SweepError as error:
            problems.append(f"sweep {number}: {error}")
            continue
        facts = {"shown": f"sweep {number}"} | facts
        problems += _imu_beside(dataset.imu if config.imu.enabled else None, sweep)
        runnable = True
        break
    if len(dataset) == 0:
        problems.append("no sweeps in it")
    parts: list[Any] = [table]
    imu = imu_buffer(dataset, config)
    if imu is not None:
        report = imu.report
        orientation = _ORIENTATIONS[report.orientation]
        used = f"{report.samples} samples at {report.rate:.0f} Hz, orientation {orientation}"
        table.add_row("IMU, used", used)
        problems += report.problems
    if facts:
        sweep_table = _table("First usable sweep")
        for label, value in facts.items():
            sweep_table.add_row(label, Text(value))
        parts.append(sweep_table)
    parts += [Text(f"problem: {problem}", style="yellow") for problem in problems]
    verdict = "can be run" if runnable else "cannot be run: no usable sweep among the first few"
    parts.append(Text(verdict, style="green" if runnable else "red"))
    return Group(*parts), runnable


def _imu_beside(imu: ImuSamples | None, sweep: Sweep) -> list[str]:
    """A problem if the IMU has no samples at a sweep, as on another clock."""
    if imu is None or len(imu.stamps) == 0:
        return []
    stamp = sweep.features.stamp if isinstance(sweep, FeatureSweep) else sweep.stamp
    first, last = int(imu.stamps.min()), int(imu.stamps.max())
    if first <= stamp <= last:
        return []
    return [
        f"IMU: its samples are from {first * 1e-9:.3f} to {last * 1e-9:.3f} s, the sweep shown is "
        f"at {stamp * 1e-9:.3f} s; if they never meet, the clocks differ, and the IMU is not used"
    ]


def sweep_facts(sweep: Sweep, config: Config) -> dict[str, str]:
    """Label -> value, of one sweep.

    Raises
    ------
    SweepError
        If the mapper could not use it, saying why.
    """
    if isinstance(sweep, BadSweep):
        raise SweepError(sweep.message)
    if isinstance(sweep, FeatureSweep):
        features = sweep.features
        cloud = "none" if sweep.cloud is None else f"{len(sweep.cloud)} points"
        return {
            "stamp": _stamp(features.stamp),
            "features": f"{len(features.edges)} edge and {len(features.planes)} plane points",
            "full cloud": cloud,
        }
    return _scan_facts(sweep, config)


def _scan_facts(scan: Scan, config: Config) -> dict[str, str]:
    finite = np.isfinite(scan.points).all(axis=1)
    columns = usable_columns(scan, config)
    ranges = np.linalg.norm(columns.xyz.astype(np.float64), axis=0)
    low, middle, high = np.percentile(ranges, (0.0, 50.0, 100.0))
    rings = assign_rings(columns, config.sensor)
    times = assign_times(columns, rings, config)
    features = extract_features(scan, config)
    not_finite = len(scan.points) - int(finite.sum())
    return {
        "stamp": _stamp(scan.stamp),
        "points": f"{len(scan.points)}, {not_finite} of them not finite, {len(columns)} usable",
        "range": f"{low:.1f} to {high:.1f} m, median {middle:.1f} m",
        "beams": rings.note,
        "times": times.note,
        "features": f"{len(features.edges)} edge and {len(features.planes)} plane points",
    }


def _stamp(stamp: int) -> str:
    return f"{stamp} ns"


def _table(title: str) -> Table:
    table = Table(
        title=Text(title, style="bold"), title_justify="left", box=None, show_header=False
    )
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    return table
