"""What the command line shows: summary, time per stage, what was understood of the input."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from loam_gtsam.aiding.imu_summary import ImuSummary
from loam_gtsam.cli.console import number_table
from loam_gtsam.config import Config
from loam_gtsam.datasets.base import Dataset, PartOf
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.frontend.organise import assign_rings, assign_times, usable_columns
from loam_gtsam.io.run_files import position_sigmas, stage_seconds
from loam_gtsam.io.run_notes import DO_NOT_TRUST
from loam_gtsam.pipeline import RunResult, effective_config, imu_buffer, run
from loam_gtsam.refine.map_quality import map_quality
from loam_gtsam.types import (
    TANGENT,
    BadSweep,
    FeatureSweep,
    FloatArray,
    FrameStatus,
    MapUpdate,
    Sweep,
    SweepError,
)

_EXPECTED = (FrameStatus.OK, FrameStatus.FIRST)
_MESSAGES, _TRIED_SWEEPS = 3, 5
_MAPPED = 50  # sweeps from which the turns of the scans are told; a word needs 20
_TIGHTER = 0.85
"""Share of the scatter: sweeps that were de-skewed before have 0.2 to 0.7 as they are."""
_SOUGHT, _STEP = 30.0, 1.0  # seconds in which a start for them is sought, and between such starts
_VOXELS = 4  # of the map along the edge of a cell in which a plane is looked for
_MIN_PATH = 10.0  # metres: an error in per cent of a shorter path says nothing


def summary(
    result: RunResult,
    name: str,
    seconds: float,
    accuracy: Mapping[str, Any],
    problems: Sequence[str] = (),
) -> Group:
    """Table of a run: frames, statuses, accuracy, IMU; below it the problems and odd frames.

    The name and the ``problems`` are those of the data set, the accuracy is as in ``summary.json``.
    """
    frames, sigmas = len(result.updates), position_sigmas(result.updates)
    rows = {
        "frames": f"{frames} in {seconds:.1f} s ({frames / seconds:.1f} frames/s)",
        "status": _counts(result.status_counts),
        "not used": _counts(result.faults),
        "weakly constrained": _weak_axes(result),
        "path": f"{result.trajectory.path_length:.1f} m",
        "map": f"{len(result.edge_points)} edge and {len(result.plane_points)} plane points",
        "map, planes": _thickness(result),
        "map, dropped": _dropped(result),
        "accuracy": _accuracy(accuracy),
        "positions": _told(sigmas),
        "loops": _loops(result),
        "GNSS": "" if result.fixes is None else str(result.fixes),
    }
    if result.imu is not None:
        rows |= _imu_facts(result.imu)
    notes = [f"input: {problem}" for problem in problems] + _odd_frames(result.updates)
    texts = [
        Text(f"  {note}", style="bold red" if note.startswith(DO_NOT_TRUST) else "yellow")
        for note in (*notes, *result.notes)
    ]
    return Group(_table(name, rows), *texts)


def _told(sigmas: Mapping[str, float] | None) -> str:
    """How well the positions are known, by what is told with them."""
    if sigmas is None:
        return ""
    return f"told to {sigmas['median']:.2g} m (sigma, median), {sigmas['largest']:.2g} m at worst"


def _weak_axes(result: RunResult) -> str:
    """Axes of the lidar that too few matches fixed in degenerate frames, and in how many."""
    least, counts = result.config.solver.min_aligned, Counter[str]()
    for update in result.updates:
        if update.status is FrameStatus.DEGENERATE:
            counts.update(np.array(TANGENT)[update.axis_localizability < least].tolist())
    found = ", ".join(f"{axis} in {counts[axis]} frames" for axis in TANGENT if counts[axis])
    return f"{found} (axes of the lidar)" if found else ""


def _thickness(result: RunResult) -> str:
    """How thick the planes of the map are: what no truth is needed for."""
    size = _VOXELS * result.config.map.plane_voxel
    quality = map_quality(result.plane_points, voxel=size, radius=0.5 * size)
    return f"{1e3 * quality.thickness:.1f} mm thick (sigma)" if quality.planes else ""


def _dropped(result: RunResult) -> str:
    lost = sum(stats.get("dropped_points", 0) for stats in result.map_stats.values())
    return f"{lost} points; see map.archive_megabytes, map.archive_dir" if lost else ""


def _accuracy(accuracy: Mapping[str, Any]) -> str:
    if "problem" in accuracy or not accuracy:
        return str(accuracy.get("problem", ""))
    error, length = accuracy["ate_rmse_m"], accuracy["compared_length_m"]
    share = f" ({100.0 * error / length:.3f} % of the path)" if length >= _MIN_PATH else ""
    text = f"ATE {error:.3f} m{share}, at most {accuracy['ate_max_m']:.3f} m"
    if "not_fitted_rmse_m" in accuracy:
        text += f"; {accuracy['not_fitted_rmse_m']:.3f} m if not fitted"
    if accuracy.get("nees") is not None:
        text += f"; NEES {accuracy['nees']:.2f} a degree of freedom (1 is consistent)"
    if accuracy.get("broken_covariances"):
        text += f"; {accuracy['broken_covariances']} covariances are not positive definite"
    if accuracy.get("ok_beyond_five_sigma"):
        text += f"; {accuracy['ok_beyond_five_sigma']} frames ok are off by more than 5 told sigma"
    return text


def _loops(result: RunResult) -> str:
    config = result.config
    if result.loops is None or (config.aiding.gnss and not config.loops.enabled):
        return ""
    counts = result.loops.counts()
    used = f"{counts.pop('on')} of {counts.pop('loops')} found are used"
    return f"{used}; {_counts({name.replace('_', ' '): n for name, n in counts.items()})}"


def _imu_facts(imu: ImuSummary) -> dict[str, str]:
    level = imu.level
    if level is None:
        known = imu.report.orientation != "none"
        up = "unknown: no " + ("samples about the first sweep" if known else "orientation")
    else:
        angles = f"roll {np.degrees(level.roll):.2f}, pitch {np.degrees(level.pitch):.2f} deg"
        state = "at rest" if level.source == "still" else "moving"
        up = f"{angles}, from {level.samples} samples, {state}"
        if level.felt and imu.map_up is not None:
            off = np.degrees(np.arccos(np.clip(imu.map_up @ level.map_up, -1.0, 1.0)))
            up += f": {off:.1f} deg off, as the scans tell"
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


def _odd_frames(updates: Sequence[MapUpdate]) -> list[str]:
    odd = [f"frame {number}: {update.status}: {update.message}"
           for number, update in enumerate(updates) if update.status not in _EXPECTED]  # fmt: skip
    more = len(odd) - _MESSAGES
    return odd[:_MESSAGES] + [f"... and {more} more: 'messages' in run.npz"] * (more > 0)


def profile_table(updates: Sequence[MapUpdate]) -> Table:
    """Median and 95th percentile over the frames in which a stage ran, and share of all time."""
    names, seconds = stage_seconds(updates)
    table = number_table("stage", "Time per frame [ms]", ("median", "95 %", "share"))
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
    asked, config = config, effective_config(config, dataset)
    info = dataset.info()
    rows = {"path": info.path, **info.facts}
    problems = list(info.problems)
    facts: dict[str, str] = {}
    unusable: dict[str, tuple[str, list[str]]] = {}  # what is wrong, and numbers of the sweeps
    for number, sweep in enumerate(itertools.islice(dataset, _TRIED_SWEEPS)):
        try:
            facts = {"shown": f"sweep {number}"} | _sweep_facts(sweep, config)
        except SweepError as error:
            alike = re.sub(r"\d+", "", str(error))
            unusable.setdefault(alike, (str(error), []))[1].append(str(number))
            continue
        problems += _imu_beside(dataset, config, sweep)
        break
    for text, numbers in unusable.values():
        sweeps = "sweep" if len(numbers) == 1 else "sweeps"
        problems.append(f"{sweeps} {', '.join(numbers)}: {text}")
    if len(dataset) == 0:
        problems.append("no sweeps in it")
    imu = imu_buffer(dataset, config)
    if imu is not None:
        used = f"{imu.report.samples} samples at {imu.report.rate:.0f} Hz"
        rows["IMU, used"] = f"{used}, orientation {_ORIENTATIONS[imu.report.orientation]}"
    found: list[str] = []
    if facts and (imu is not None or config.sensor.times != "none"):
        rows["by the scans"], found = _by_scans(dataset, asked)
    problems += found or ([] if imu is None else imu.report.problems)
    tables = [_table(info.kind, rows), *([_table("First usable sweep", facts)] if facts else [])]
    notes = [Text(f"problem: {problem}", style="yellow") for problem in problems]
    verdict = "can be run" if facts else "cannot be run: no usable sweep among the first few"
    return Group(*tables, *notes, Text(verdict, style="green" if facts else "red")), bool(facts)


def _imu_beside(dataset: Dataset, config: Config, sweep: Sweep) -> list[str]:
    """A problem if the IMU has no samples at a sweep, as on another clock."""
    imu = dataset.imu if config.imu.coupling != "off" else None
    if imu is None or len(imu.stamps) == 0:
        return []
    stamp, offset = sweep.stamp, round(config.imu.time_offset * 1e9)
    first, last = int(imu.stamps.min()) + offset, int(imu.stamps.max()) + offset
    if first <= stamp <= last:
        return []
    return [
        f"IMU: its samples are from {first * 1e-9:.3f} to {last * 1e-9:.3f} s, the sweep shown is "
        f"at {stamp * 1e-9:.3f} s; if they never meet, the clocks differ, and the IMU is not used"
    ]


def _by_scans(dataset: Dataset, config: Config) -> tuple[str, list[str]]:
    """What a short run says: how much was mapped, and problems with times of points and an IMU.

    The sweeps are the first, of the first half minute, over which the gyro's rates vary at least
    half as much as over any: where nothing turns, clock and mounting cannot be told.
    """
    stamps = [sweep.stamp for sweep in itertools.islice(dataset, _TRIED_SWEEPS + 1)]
    period = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else 0.0
    period = period if period > 0.0 else config.sensor.period
    imu = dataset.imu
    begin = 0.0
    if imu is not None and len(imu.stamps):
        order = np.argsort(imu.stamps, kind="stable")
        seconds = (imu.stamps[order] - stamps[0]).astype(np.float64) * 1e-9 + config.imu.time_offset
        begin = where_it_turns(seconds, imu.gyro[order], _MAPPED * period, len(dataset) * period)
    part = PartOf(dataset, 0, 1, begin)
    result = run(part, config, max_frames=_MAPPED, keep_partial=True)
    if result.interrupted:
        raise KeyboardInterrupt
    said, of_imu = result.times_problem, () if result.imu is None else result.imu.problems
    if said:
        as_is = config.changed("sensor.times=none")
        without = run(part, as_is, max_frames=_MAPPED, keep_partial=True)
        if _scatter(without) < _TIGHTER * _scatter(result):
            said = "the sweeps are de-skewed already: they fit better with sensor.times=none"
    mapped = f"{len(result.updates)} sweeps mapped, from {begin:g} s on"
    ranges = "" if result.range_offset is None else result.range_offset.problem
    problems = _not_placed(result.updates), said, ranges, *of_imu
    return mapped, [*filter(None, problems)]


def _not_placed(updates: Sequence[MapUpdate]) -> str:
    """A sentence on sweeps that were not placed in the map; empty if there are none."""
    first = FrameStatus.FIRST
    left = [u for u in updates if not u.status.solved and u.status is not first]
    if not left:
        return ""
    counts = _counts(Counter(str(update.status) for update in left))
    return f"{len(left)} of {len(updates)} sweeps: {counts}, the first: {left[0].message}"


def _scatter(result: RunResult) -> float:
    """Median variance of the whitened residuals of a run; infinite if no sweep was solved."""
    known = [u.uncertainty.residual_variance for u in result.updates if u.uncertainty is not None]
    return float(np.median(known)) if known else np.inf


def where_it_turns(seconds: FloatArray, gyro: FloatArray, length: float, duration: float) -> float:
    """Seconds, within ``_SOUGHT``, from which on the rates vary much over the mapped sweeps.

    ``seconds`` of the rates (N, 3) count from the first sweep; ``length`` is the time that the
    mapped sweeps take, and ``duration`` that of all sweeps.
    """
    starts = np.arange(0.0, np.clip(duration - length, _STEP, _SOUGHT), _STEP)
    windows = [gyro[slice(*np.searchsorted(seconds, [t, t + length]))] for t in starts]
    varied = np.array([w.var(axis=0).sum() * len(w) if len(w) else 0.0 for w in windows])
    return float(starts[np.argmax(varied >= 0.5 * varied.max())])


def _sweep_facts(sweep: Sweep, config: Config) -> dict[str, str]:
    """Label -> value, of one sweep; a SweepError says why the mapper could not use it."""
    if isinstance(sweep, BadSweep):
        raise SweepError(sweep.message)
    if isinstance(sweep, FeatureSweep):
        features = sweep.features
        cloud = "none" if sweep.cloud is None else f"{len(sweep.cloud)} points"
        facts = {"stamp": f"{features.stamp} ns", "full cloud": cloud}
    else:
        columns = usable_columns(sweep, config)
        ranges = np.linalg.norm(columns.xyz.astype(np.float64), axis=0)
        low, middle, high = np.percentile(ranges, (0.0, 50.0, 100.0))
        rings = assign_rings(columns, config.sensor)
        features = extract_features(sweep, config)
        points, finite = len(sweep.points), int(np.isfinite(sweep.points).all(axis=1).sum())
        facts = {
            "stamp": f"{sweep.stamp} ns",
            "points": f"{points}, {points - finite} of them not finite, {len(columns)} usable",
            "range": f"{low:.1f} to {high:.1f} m, median {middle:.1f} m",
            "beams": rings.note,
            "times": assign_times(columns, rings, config).note,
        }
    counts = f"{len(features.edges)} edge and {len(features.planes)} plane points"
    return facts | {"features": counts}


def _table(title: str, rows: Mapping[str, str]) -> Table:
    """A table of labels and texts; empty texts are left out."""
    heading = Text(title, style="bold")
    table = Table(title=heading, title_justify="left", box=None, show_header=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for label, text in rows.items():
        if text:
            table.add_row(label, Text(text))
    return table
