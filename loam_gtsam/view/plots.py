"""Pictures of a run as PNG files. Needs the ``plot`` extra; nothing is shown on a screen.

Every function raises OutputError if matplotlib is missing or the file cannot be written.
"""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Mapping, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.io.atomic import atomic_file
from loam_gtsam.io.run_files import stage_seconds
from loam_gtsam.types import BoolArray, FloatArray, IntArray, MapUpdate, OutputError, Trajectory

INK, FAINT, PATH, TRUTH = "#22303c", "#d7dde2", "#e4572e", "#9aa5ae"
_STAGE_COLOURS = ("#4c78a8", "#72b7b2", "#eeca3b", "#f58518", "#e45756", "#b279a2", "#9d755d",
                  "#54a24b", "#bab0ac", "#ff9da6")  # fmt: skip
_RUN_COLOURS = ("#e4572e", "#2f6db3", "#2e9e6b", "#8e5bb5", "#c9920e", "#17a2b8", "#7a5230")
_RUN_LINES = tuple((colour, style) for style in ("-", "--", ":") for colour in _RUN_COLOURS)
"""Colour and style of the line of a run, in the order of the runs."""
_DPI = 110
_HEIGHT_COLOURS = ("#cfdbe3", "#8fc1c9", "#3f8fa6", "#27568a", "#1d2350")
"""Pale ground, dark walls: what stands out of the ground stands out of the page."""
_MAX_BYTES = 300_000  # larger pictures get fewer colours: they are for READMEs and reports
_PALETTE = 255
_LEGEND_COLUMNS = 4
_MAP_CELLS = 700  # along the longer side of the top view; a picture has about as many pixels
_MIN_CELL = 0.1  # metres; the map is voxel-filtered: smaller cells would be mostly empty


def available() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def plot_trajectory(
    path: str | Path,
    trajectory: Trajectory,
    truth: Trajectory | None = None,
    loops: tuple[FloatArray, BoolArray] | None = None,
) -> None:
    """Draw the path from above, and its height.

    Parameters
    ----------
    trajectory : ``map_T_lidar``
    truth : reference poses in the map frame (align them first), or None
    loops : (L, 2, 3) ends of loops in the map and (L,) which are used; the others are dotted
    """
    lines = [] if truth is None else [("truth", truth, (TRUTH, "-"), 3.0)]
    figure, top = _trajectory_figure(7.0, [*lines, ("estimate", trajectory, (PATH, "-"), 1.4)])
    start = trajectory.map_T_lidar[:1, :3, 3]
    top.plot(start[:, 0], start[:, 1], "o", color=INK, ms=6, label="start")
    if loops is not None:
        for name, on, style in (("loops", loops[1], "-o"), ("loops, not used", ~loops[1], ":o")):
            ends = loops[0][on]
            if not len(ends):
                continue
            label = [f"{len(ends)} {name}", *[""] * (len(ends) - 1)]
            top.plot(ends[:, :, 0].T, ends[:, :, 1].T, style, color=INK, lw=0.8, ms=2, label=label)
    top.set_title(f"{trajectory.path_length:.1f} m travelled")
    top.legend(frameon=False)
    save_figure(figure, path)


def plot_map(
    path: str | Path,
    edges: NDArray[np.floating],
    planes: NDArray[np.floating],
    trajectory: Trajectory | None = None,
) -> None:
    """Draw the map from above, coloured by height, with the path.

    ``edges`` and ``planes`` are (E, 3) and (P, 3) metres, map frame.
    """
    figure = empty_figure(9.0, 7.0)
    axes = figure.subplots()
    points = np.concatenate((edges, planes)).astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points):
        bar = figure.colorbar(_top_view(axes, points), ax=axes, shrink=0.55, aspect=30, pad=0.02)
        bar.set_label("height [m]")
        bar.outline.set_visible(False)
    if trajectory is not None and len(trajectory):
        _draw_path(axes, trajectory.map_T_lidar[:, :3, 3])
    axes.set_aspect("equal")
    axes.margins(0.02)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    save_figure(figure, path)


def plot_errors(path: str | Path, stamps: IntArray, errors: FloatArray) -> None:
    """Draw how far positions are off the truth, (N,) metres, over stamps, (N,) nanoseconds."""
    figure = empty_figure(9.0, 3.2)
    axes = figure.subplots()
    seconds = (stamps - stamps[0]) * 1e-9 if len(stamps) else stamps
    axes.fill_between(seconds, errors, color=PATH, alpha=0.15, lw=0)
    axes.plot(seconds, errors, color=PATH, lw=1.4)
    rmse = float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0
    axes.axhline(rmse, color=INK, lw=0.8, ls=":", label=f"{rmse:.3f} m (RMSE)")
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False)
    axes.set(xlabel="time [s]", ylabel="position error [m]")
    save_figure(figure, path)


def plot_loops(
    path: str | Path, panels: Mapping[str, tuple[FloatArray, FloatArray]], loops: FloatArray
) -> None:
    """Draw maps of one run beside each other from above, e.g. without loops and with them.

    Parameters
    ----------
    panels : title -> (N, 3) points of the map and (K, 3) positions of the sensor, metres
    loops : (L, 2, 3) their ends in the last of the maps
    """
    figure = empty_figure(4.6 * len(panels), 3.6)
    row = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (title, (points, way)) in zip(row, panels.items(), strict=True):
        if len(points):
            _top_view(axes, points)
        _draw_path(axes, way)
        axes.set_title(title, loc="left", fontsize=10)
        axes.set_aspect("equal")
        axes.set_xlabel("x [m]")
    row[0].set_ylabel("y [m]")
    row[-1].plot(loops[:, :, 0].T, loops[:, :, 1].T, "-o", color=INK, lw=0.8, ms=1.8)
    save_figure(figure, path)


def plot_timings(path: str | Path, updates: Sequence[MapUpdate]) -> None:
    """Draw the time per stage over the frames of a run, stacked."""
    figure = empty_figure(9.0, 4.0)
    axes = figure.subplots()
    names, seconds = stage_seconds(updates)
    if names:
        milliseconds = 1e3 * np.nan_to_num(seconds)
        colours = list(islice(cycle(_STAGE_COLOURS), len(names)))
        medians = zip(names, np.median(milliseconds, axis=0), strict=True)
        labels = [f"{name}  {median:.1f} ms" for name, median in medians]
        axes.stackplot(np.arange(len(updates)), milliseconds.T, labels=labels, colors=colours, lw=0)
        # A rare slow frame (start-up, a busy machine) would flatten everything else.
        axes.set_ylim(0.0, 1.3 * float(np.percentile(milliseconds.sum(axis=1), 98)) + 1e-9)
        axes.set_xlim(0, max(len(updates) - 1, 1))
        handles, texts = axes.get_legend_handles_labels()
        axes.legend(
            handles[::-1], texts[::-1], frameon=False, title="median",
            loc="center left", bbox_to_anchor=(1.0, 0.5),
        )  # fmt: skip
    axes.set(xlabel="frame", ylabel="time [ms]")
    save_figure(figure, path)


def plot_trajectories(
    path: str | Path, trajectories: Mapping[str, Trajectory], truth: Trajectory | None = None
) -> None:
    """Draw several paths, all in one frame (align them first), from above, and their heights."""
    lines = [] if truth is None else [("truth", truth, (TRUTH, "-"), 4.0)]
    named = zip(trajectories.items(), cycle(_RUN_LINES), strict=False)
    lines += [(name, trajectory, line, 1.3) for (name, trajectory), line in named]
    figure, top = _trajectory_figure(7.5, lines)
    _legend_above(figure, *top.get_legend_handles_labels())
    save_figure(figure, path)


def plot_curves(
    path: str | Path,
    panels: Mapping[str, Mapping[str, tuple[NDArray[Any], FloatArray]]],
    xlabel: str,
    *,
    log: bool = False,
) -> None:
    """Draw one curve per solver, in one or more panels above each other.

    Parameters
    ----------
    panels : label of the vertical axis -> solver -> (N,) x and (N,) y; a solver has the line of
        its place in the first panel
    log : logarithmic vertical axes; values below a millionth of the panel's largest, which are
        rounding, are left out
    """
    figure = empty_figure(9.0, 1.0 + 2.8 * len(panels))
    rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (ylabel, curves) in zip(rows, panels.items(), strict=True):
        largest = max((float(np.nanmax(y)) for _, y in curves.values() if len(y)), default=0.0)
        for (name, (x, y)), (colour, style) in zip(curves.items(), cycle(_RUN_LINES), strict=False):
            axes.plot(x, np.where(y > 1e-6 * largest, y, np.nan) if log else y, color=colour,
                      ls=style, lw=1.4, label=name if len(x) else None)  # fmt: skip
        if log:
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0.0)
        axes.set_ylabel(ylabel)
    _legend_above(figure, *rows[0].get_legend_handles_labels())
    rows[-1].set_xlabel(xlabel)
    save_figure(figure, path)


def plot_stages(path: str | Path, stages: Mapping[str, Mapping[str, float]]) -> None:
    """Draw the time of a frame as one bar per solver; solver -> stage -> milliseconds."""
    figure = empty_figure(9.0, 1.4 + 0.5 * len(stages))
    axes = figure.subplots()
    names = list(dict.fromkeys(stage for row in stages.values() for stage in row))
    left = np.zeros(len(stages))
    for stage, colour in zip(names, cycle(_STAGE_COLOURS), strict=False):
        width = np.array([row.get(stage, 0.0) for row in stages.values()])
        axes.barh(list(stages), width, left=left, color=colour, height=0.6, label=stage)
        left += width
    axes.invert_yaxis()
    axes.set_xlabel("median time per stage [ms]")
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save_figure(figure, path)


def _trajectory_figure(
    height: float, lines: Sequence[tuple[str, Trajectory, tuple[str, str], float]]
) -> tuple[Any, Any]:
    figure = empty_figure(9.0, height)
    top, side = figure.subplots(2, 1, height_ratios=(4, 1))
    for name, trajectory, (colour, style), width in lines:
        xyz = trajectory.map_T_lidar[:, :3, 3]
        top.plot(xyz[:, 0], xyz[:, 1], color=colour, ls=style, lw=width, label=name)
        travelled = np.cumsum(np.linalg.norm(np.diff(xyz, axis=0, prepend=xyz[:1]), axis=1))
        side.plot(travelled, xyz[:, 2], color=colour, ls=style, lw=width)
    top.set_aspect("equal", adjustable="datalim")
    top.set(xlabel="x [m]", ylabel="y [m]")
    side.set(xlabel="distance travelled [m]", ylabel="z [m]")
    return figure, top


def _legend_above(figure: Any, handles: Sequence[Any], labels: Sequence[str]) -> None:
    """A legend over the panels, off the curves."""
    if handles:
        columns = min(len(labels), _LEGEND_COLUMNS)
        figure.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False)


def _draw_path(axes: Any, xyz: FloatArray) -> None:
    axes.plot(xyz[:, 0], xyz[:, 1], color="white", lw=3.0)
    axes.plot(xyz[:, 0], xyz[:, 1], color=PATH, lw=1.6)
    axes.plot(xyz[:1, 0], xyz[:1, 1], "o", color=PATH, mec="white", ms=7)


def _top_view(axes: Any, points: FloatArray) -> Any:
    """Greatest height per cell; cells with fewer points are fainter."""
    from matplotlib.colors import LinearSegmentedColormap

    # A few stray points far away would leave everything else small and of one colour.
    low, high = np.percentile(points, (0.2, 99.8), axis=0)
    points = points[((points[:, :2] >= low[:2]) & (points[:, :2] <= high[:2])).all(axis=1)]
    size = max(float((high - low)[:2].max()) / _MAP_CELLS, _MIN_CELL)
    columns, rows = ((high - low)[:2] / size).astype(np.int64) + 1
    cells: IntArray = ((points[:, :2] - low[:2]) / size).astype(np.int64)
    flat = cells[:, 1] * columns + cells[:, 0]
    count = np.bincount(flat, minlength=columns * rows)
    height = np.full(columns * rows, np.nan)
    order = np.argsort(points[:, 2], kind="stable")
    height[flat[order]] = points[order, 2]  # the last one written, the highest, stays
    opacity = np.clip(0.4 + 0.3 * np.log1p(count), 0.0, 1.0) * (count > 0)
    return axes.imshow(
        height.reshape(rows, columns),
        alpha=opacity.reshape(rows, columns),
        extent=(low[0], low[0] + columns * size, low[1], low[1] + rows * size),
        origin="lower",
        cmap=LinearSegmentedColormap.from_list("height", _HEIGHT_COLOURS),
        vmin=low[2],
        vmax=max(high[2], low[2] + 1e-3),
        interpolation="nearest",
    )


def empty_figure(width: float, height: float) -> Any:
    """An empty figure, free of matplotlib's global state and of any display."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise OutputError(
            'pictures need matplotlib; install it with: pip install "loam_gtsam[plot]"'
        ) from error
    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, path: str | Path) -> None:
    """Common style, then the PNG."""
    for axes in figure.axes:
        axes.tick_params(colors=INK, length=0, labelsize=9)
        for text in (axes.xaxis.label, axes.yaxis.label, axes.title):
            text.set_color(INK)
        for spine in axes.spines.values():
            spine.set_color(FAINT)
        if axes.get_label() != "<colorbar>":
            axes.grid(True, color=FAINT, lw=0.5)
            axes.set_axisbelow(True)
    png = io.BytesIO()
    figure.savefig(png, format="png", bbox_inches="tight", pad_inches=0.12)
    if png.tell() > _MAX_BYTES:
        png = _with_palette(png)
    with atomic_file(path) as file:
        file.write(png.getvalue())


def _with_palette(png: io.BytesIO) -> io.BytesIO:
    from PIL import Image  # comes with matplotlib

    smaller = io.BytesIO()
    # Maximum coverage keeps a colour that few pixels have: that of the path.
    picture = Image.open(png).convert("RGB").quantize(_PALETTE, Image.Quantize.MAXCOVERAGE)
    picture.save(smaller, format="png", optimize=True)
    return smaller
