"""Results of a run as files: map, covariances, everything about every frame, and a summary.

Every file is written beside its final name and then renamed, see :mod:`loam_gtsam.io.atomic`; an
:class:`~loam_gtsam.types.OutputError` says that a file could not be written.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.config import dump_config
from loam_gtsam.errors import check_kind
from loam_gtsam.io.atomic import atomic_file, make_folder, write_json, write_text
from loam_gtsam.io.trajectories import stamp_text, write_kitti, write_tum
from loam_gtsam.io.version import installed_version
from loam_gtsam.types import (
    TANGENT,
    FloatArray,
    InputError,
    IntArray,
    MapUpdate,
    Uncertainty,
    check_array,
    check_updates,
    stack_poses,
)

if TYPE_CHECKING:
    from loam_gtsam.aiding.imu_summary import ImuSummary
    from loam_gtsam.pipeline import RunResult

_NS = 10**9
NO_STAMP = int(np.iinfo(np.int64).min)
"""In ``run.npz``: there is no such frame."""
_MAX_MESSAGES = 20  # in summary.json; run.npz has them all
EDGE_COLOUR, PLANE_COLOUR = (214, 96, 32), (110, 125, 140)
"""Red, green, blue of the two kinds of map points in the PLY file."""

_PLY_VERTEX = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3), ("label", "u1")])

RUN_FILES = (
    "trajectory.tum",
    "trajectory_kitti.txt",
    "trajectory_covariance.csv",
    "run.npz",
    "map.ply",
    "config.yaml",
    "summary.json",
)
"""What :func:`write_run` writes."""


def write_covariances(path: str | Path, updates: Sequence[MapUpdate]) -> None:
    """Write the calibrated covariance of every pose that :func:`write_tum` writes, in its order.

    A line has the stamp, the status and the upper triangle of
    :attr:`loam_gtsam.types.MapUpdate.covariance`, row by row: ``rx_rx rx_ry ... z_z`` in rad^2,
    rad m and m^2, along the axes of the lidar; empty where the frame was not solved. Frames with a
    bad stamp are left out.
    """
    check_updates(updates)
    rows, columns = np.triu_indices(6)
    names = [f"{TANGENT[i]}_{TANGENT[j]}" for i, j in zip(rows, columns, strict=True)]
    lines = [",".join(("stamp_s", "status", *names))]
    for update in updates:
        if not update.status.has_pose:
            continue
        values = update.covariance[rows, columns]
        cells = [f"{value:.9g}" if np.isfinite(value) else "" for value in values]
        lines.append(",".join((stamp_text(update.stamp), str(update.status), *cells)))
    write_text(path, "\n".join(lines) + "\n")


def stage_seconds(updates: Sequence[MapUpdate]) -> tuple[tuple[str, ...], FloatArray]:
    """Names of the S stages in order, and (N, S) seconds; NaN where a stage did not run."""
    names = tuple(dict.fromkeys(name for update in updates for name in update.timings))
    rows = [[update.timings.get(name, np.nan) for name in names] for update in updates]
    return names, np.array(rows, np.float64).reshape(len(updates), len(names))


def write_npz(path: str | Path, updates: Sequence[MapUpdate]) -> None:
    """Write everything that is known about each of the N frames; no pickle is needed to read it.

    docs/outputs.md lists the keys; :class:`loam_gtsam.types.MapUpdate` says what the values mean.
    """
    check_updates(updates)
    nothing = np.full((6, 6), np.nan)
    rest = np.nan, np.nan, np.full((6, 10), np.nan), np.full(10, np.nan)
    unknown = Uncertainty(nothing, nothing, None, nothing, *rest)
    parts = [update.uncertainty or unknown for update in updates]
    follows = [NO_STAMP if part.follows is None else part.follows for part in parts]
    nowhere = np.full((4, 4), np.nan)
    middles = [nowhere if (pose := u.map_T_middle) is None else pose.matrix() for u in updates]
    names, seconds = stage_seconds(updates)
    arrays = {
        "stamps": _column(updates, "stamp", np.int64),
        "map_T_lidar": stack_poses(u.map_T_lidar for u in updates),
        "map_T_middle": np.array(middles).reshape(-1, 4, 4),
        "middle_stamps": _column(updates, "middle_stamp", np.int64),
        "status": _column(updates, "status", np.str_),
        "messages": _column(updates, "message", np.str_),
        "covariances": _column(updates, "covariance", shape=(6, 6)),
        "raw_covariances": _column(updates, "raw_covariance", shape=(6, 6)),
        "twists": _column(updates, "twist", shape=(6,)),
        "accelerations": _column(updates, "acceleration", shape=(6,)),
        "sweep_motions": _column(updates, "sweep_motion", np.str_),
        "tilt_priors": _column(updates, "tilt_prior", np.str_),
        "own_covariances": _column(parts, "own", shape=(6, 6)),
        "shared_covariances": _column(parts, "shared", shape=(6, 6)),
        "drift_covariances": _column(parts, "drift", shape=(6, 6)),
        "blind_drifts": _column(parts, "blind", shape=(6, 10)),
        "forgotten": _column(parts, "forgotten", shape=(10,)),
        "follows": np.array(follows, np.int64),
        "residual_variances": _column(parts, "residual_variance"),
        "effective_matches": _column(parts, "effective_matches"),
        "in_doubt": _column(parts, "in_doubt", np.bool_),
        "stage_names": np.array(names, np.str_),
        "stage_seconds": seconds,
    }
    for name in ("information", "directions"):
        arrays[name] = _column(updates, name, shape=(6, 6))
    for name in ("localizability", "direction_information", "axis_localizability"):
        arrays[name] = _column(updates, name, shape=(6,))
    for name in ("n_edges", "n_planes", "n_edge_matches", "n_plane_matches",
                 "iterations", "solver_iterations"):  # fmt: skip
        arrays[name] = _column(updates, name, np.int64)
    for name in ("error_before", "error_after"):
        arrays[name] = _column(updates, name)
    with atomic_file(path) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def _column(
    items: Sequence[object], name: str, kind: type = np.float64, shape: tuple[int, ...] = ()
) -> NDArray[Any]:
    """An attribute of N items: N, and the shape of one."""
    values = [getattr(item, name) for item in items]
    return np.array(values, kind).reshape(len(items), *shape)


def write_ply(path: str | Path, edges: NDArray[np.floating], planes: NDArray[np.floating]) -> None:
    """Write a map as a binary little-endian PLY file.

    Coordinates are double: single precision is down to 1 mm at 10 km and to 0.5 m in UTM
    northings. ``label`` is 0 for edge and 1 for plane points, which also differ in colour.

    Parameters
    ----------
    edges, planes : (E, 3) and (P, 3) metres, map frame

    Raises
    ------
    InputError
        If a shape is wrong.
    """
    for name, points in (("edges", edges), ("planes", planes)):
        check_array(points, f"write_ply: {name}", ("N", 3))
    vertices = np.zeros(len(edges) + len(planes), _PLY_VERTEX)
    vertices["xyz"] = np.concatenate((edges, planes))
    vertices["label"] = np.arange(len(vertices)) >= len(edges)
    vertices["rgb"] = np.array((EDGE_COLOUR, PLANE_COLOUR), np.uint8)[vertices["label"]]
    properties = [f"property double {axis}" for axis in "xyz"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue", "label")]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment map frame, metres; label 0: edge, 1: plane",
        f"element vertex {len(vertices)}",
        *properties,
        "end_header",
    ]
    with atomic_file(path) as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(vertices.data)


def write_run(
    result: RunResult,
    directory: str | Path,
    *,
    dataset: str = "",
    extra: Mapping[str, Any] | None = None,
) -> None:
    """Write all of :data:`RUN_FILES`; files of the same names are replaced.

    ``summary.json`` is removed first and comes last: where it is, the others are complete.

    Parameters
    ----------
    result : complete or interrupted
    directory : made if it does not exist
    dataset : what was run, for the records
    extra : further entries of the summary (plain numbers, strings, lists and mappings)
    """
    if not hasattr(result, "updates"):
        got = type(result).__name__
        raise InputError(f"result: expected a RunResult, got {got}; write_run(result, directory)")
    check_kind(dataset, str, "dataset", "it is a name for the records")
    if extra is not None:
        check_kind(extra, Mapping, "extra", "they are entries of the summary")
    folder = make_folder(directory)
    with suppress(OSError):  # what cannot be removed cannot be replaced, which is told then
        (folder / "summary.json").unlink(missing_ok=True)
    trajectory = result.trajectory
    records = {"made by": f"loam_gtsam {installed_version()}", "data set": dataset}
    moment = result.config.deskew.reference
    records["poses"] = f"at the {moment} of each sweep (deskew.reference), as their stamps"
    if result.interrupted or result.error:
        records["incomplete"] = "the run ended early"
    write_tum(folder / "trajectory.tum", trajectory, comments=records)
    write_kitti(folder / "trajectory_kitti.txt", trajectory)
    write_covariances(folder / "trajectory_covariance.csv", result.updates)
    write_npz(folder / "run.npz", result.updates)
    write_ply(folder / "map.ply", result.edge_points, result.plane_points)
    write_text(folder / "config.yaml", dump_config(result.config))
    summary = summarise(result) | {"dataset": dataset} | dict(extra or {})
    write_json(folder / "summary.json", summary)


def summarise(result: RunResult) -> dict[str, Any]:
    """What ``summary.json`` says about a run; lengths in metres, times in the unit of the name."""
    trajectory = result.trajectory
    seconds = np.nansum(stage_seconds(result.updates)[1], axis=1)
    before = ["", *(update.message for update in result.updates)]
    told = [(n, u) for n, u in enumerate(result.updates) if u.message not in ("", before[n])]
    return {
        "loam_gtsam": installed_version(),
        "frames": len(result.updates),
        "poses": len(trajectory),
        "pose_moment": result.config.deskew.reference,
        "interrupted": result.interrupted,
        "error": None if result.error is None else f"{type(result.error).__name__}: {result.error}",
        "status_counts": result.status_counts,
        "faults": result.faults,
        "sweep_gaps": _gaps(trajectory.stamps),
        "not_finite_points": {
            "sweeps": sum(u.n_not_finite > 0 for u in result.updates),
            "points": sum(u.n_not_finite for u in result.updates),
        },
        "notes": list(result.notes),
        "messages": [f"frame {n}: {u.status}: {u.message}" for n, u in told[:_MAX_MESSAGES]],
        "path_length_m": trajectory.path_length,
        "position_sigma_m": position_sigmas(result.updates),
        "duration_s": float(np.ptp(trajectory.stamps)) / _NS if len(trajectory) else 0.0,
        "frame_ms_median": 1e3 * float(np.median(seconds)) if len(seconds) else None,
        "edge_points": len(result.edge_points),
        "plane_points": len(result.plane_points),
        "map_stats": {name: dict(stats) for name, stats in result.map_stats.items()},
        "localizability": _axes_part(result),
        "point_times": result.times_problem or None,
        "ranges": None if result.range_offset is None else result.range_offset.as_dict(),
        "beams": result.pipeline and result.pipeline.mapper.errors.beam_errors.as_dict(),
        "imu": None if result.imu is None else _imu_part(result.imu),
        "loops": None if result.loops is None else result.loops.counts(),
        "gnss": None if result.fixes is None else result.fixes.as_dict(),
    }


def position_sigmas(updates: Sequence[MapUpdate]) -> dict[str, float] | None:
    """Median and largest standard deviation of the positions that scans gave, as told, metres."""
    squares = [np.trace(u.covariance[3:, 3:]) for u in updates if u.status.solved]
    known = np.sqrt([square for square in squares if np.isfinite(square)])
    if not len(known):
        return None
    return {"median": float(np.median(known)), "largest": float(known.max())}


def _gaps(stamps: IntArray) -> int:
    """From how many sweeps to the next it took more than half as long again as usual."""
    steps = np.diff(stamps)
    return int(np.count_nonzero(steps > 1.5 * np.median(steps))) if len(steps) else 0


def _axes_part(result: RunResult) -> dict[str, Any] | None:
    """How well the frames fixed each axis of the lidar; None if that was not looked at."""
    counts = np.array([u.axis_localizability for u in result.updates], np.float64).reshape(-1, 6)
    counts = counts[np.isfinite(counts).all(axis=1)]
    if len(counts) == 0:
        return None
    least = result.config.solver.min_aligned
    return {
        axis: {
            "median": float(np.median(column)),
            "lowest": float(column.min()),
            "weak_frames": int(np.count_nonzero(column < least)),
        }
        for axis, column in zip(TANGENT, counts.T, strict=True)
    }


def _imu_part(imu: ImuSummary) -> dict[str, Any]:
    level, report = imu.level, imu.report
    counted = ("samples", "gaps", "duplicates", "out_of_order", "not_finite", "orientation")
    return {name: getattr(report, name) for name in counted} | {
        "rate_hz": report.rate,
        "level": level
        and {
            "roll_deg": float(np.degrees(level.roll)),
            "pitch_deg": float(np.degrees(level.pitch)),
            "map_up": None if imu.map_up is None else imu.map_up.tolist(),
            "source": level.source,
            "samples": level.samples,
        },
        "tilt_priors": dict(imu.tilt_priors),
        "sweep_motions": dict(imu.sweep_motions),
        "gyro_bias_rad_s": imu.gyro_bias.tolist(),
        "gyro_trusted": imu.gyro_trusted,
        "gyro_left_out": imu.gyro_left_out,
        "disputed": imu.disputed,
        "problems": list(imu.problems),
    }
