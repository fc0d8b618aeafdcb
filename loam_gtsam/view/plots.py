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
from loam_gtsam.types import (
    TANGENT,
    BoolArray,
    FloatArray,
    IntArray,
    MapUpdate,
    OutputError,
    Trajectory,
)

INK, FAINT, PATH, TRUTH = "#22303c", "#d7dde2", "#e4572e", "#9aa5ae"
_STAGE_COLOURS = ("#4c78a8", "#72b7b2", "#eeca3b", "#f58518", "#e45756", "#b279a2", "#9d755d",
                  "#54a24b", "#bab0ac", "#ff9da6")  # fmt: skip
_RUN_COLOURS = ("#e4572e", "#2f6db3", "#2e9e6b", "#8e5bb5", "#c9920e", "#17a2b8", "#7a5230")
_RUN_LINES = tuple((colour, style) for style in ("-", "--", ":") for colour in _RUN_COLOURS)
"""Colour and style of the line of a run, in the order of the runs."""
_DPI = 110
_HEIGHT_COLOURS = ("#9fb6c1", "#63adb3", "#2b86a6", "#2b5796", "#2a2463")
"""Pale ground, dark walls, none so pale that it is lost on white, or so dark that on black."""
_OVERHEAD = (1.5, 0.3)
"""Metres from the path, and above it, within which and from which on something is overhead."""
_LAYER = (0.25, 0.12)
"""Metres, height of a layer, and share of the occupied cells of that size that have their highest
point in one layer if it is a ceiling. Walls and fences fill lines of cells, ceilings areas."""
_MAX_BYTES = 300_000  # larger pictures get fewer colours: they are for READMEs and reports
_PALETTE = 255
_LEGEND_COLUMNS = 4
_MAP_CELLS = 700  # along the longer side of the top view; a picture has about as many pixels
_WIDE = 0.45  # height over width of a map below which its colour bar lies under it
_MOST_WAY = 500  # poses of the path that are looked above
_HIGHEST = 6.5  # inches
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
    figure, top = _trajectory_figure([*lines, ("estimate", trajectory, (PATH, "-"), 1.4)])
    start = trajectory.positions[:1]
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
    """Draw the map from above, coloured by height, with the path; indoors without the ceiling.

    ``edges`` and ``planes`` are (E, 3) and (P, 3) metres, map frame.
    """
    points = np.concatenate((edges, planes)).astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    way = np.zeros((0, 3)) if trajectory is None else trajectory.positions
    seen = _below_ceiling(points, way)
    note = "" if len(seen) == len(points) else ", without the ceiling"
    spread = np.concatenate((seen, way))[:, :2]
    width, depth = 1.0, 1.0
    if len(spread):
        width, depth = np.ptp(np.percentile(spread, (0.2, 99.8), axis=0), axis=0)
    share = float(np.clip(depth / max(width, 1e-6), 0.08, 3.0))
    high = min(8.2 * share, _HIGHEST)  # inches of the axes
    figure = empty_figure(min(9.0, high / share + 1.8), high + 1.2)
    axes = figure.subplots()
    if len(seen):
        wide = share < _WIDE
        where, shrink = ("bottom", 0.4) if wide else ("right", 0.6)
        how = {"location": where, "shrink": shrink, "aspect": 30, "pad": 0.02}
        bar = figure.colorbar(_top_view(axes, seen), ax=axes, **how)
        bar.set_label(f"height [m]{note}")
        bar.outline.set_visible(False)
    if len(way):
        _draw_path(axes, way)
    axes.set_aspect("equal")
    axes.margins(0.02)
    axes.locator_params(axis="y", nbins=max(1, round(2.0 * high)), steps=[1, 2, 5, 10])
    axes.set(xlabel="x [m]", ylabel="y [m]")
    save_figure(figure, path)


def _below_ceiling(points: FloatArray, way: FloatArray) -> FloatArray:
    """The points that are not above the middle between the path and the ceiling over it.

    There is a ceiling if something is overhead along more than half of the path, or if a good part
    of the map has its highest points in one layer.
    """
    if not len(points) or not len(way):
        return points
    from scipy.spatial import cKDTree

    way = way[:: max(1, len(way) // _MOST_WAY)]
    away, nearest = cKDTree(way[:, :2]).query(points[:, :2])
    above = points[:, 2] - way[nearest, 2]
    high: BoolArray = above > _OVERHEAD[1]
    over = high & (away < _OVERHEAD[0])
    if len(np.unique(nearest[over])) > len(way) // 2:
        low: BoolArray = above < 0.5 * float(np.percentile(above[over], 10))
        return points[low]
    size, share = _LAYER
    order = np.argsort(above, kind="stable")[::-1]
    cells = np.floor(points[order, :2] / size).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    tops = above[order][first]
    layers = np.round(tops[tops > _OVERHEAD[1]] / size).astype(np.int64)
    counts = np.bincount(layers) if len(layers) else np.zeros(1, np.int64)
    if counts.max() < share * len(tops):
        return points
    low = above < 0.5 * size * float(counts.argmax())
    return points[low]


def plot_errors(
    path: str | Path,
    stamps: IntArray,
    errors: FloatArray,
    told: tuple[IntArray, FloatArray, FloatArray] | None = None,
) -> None:
    """Draw how far positions are off the truth, over time, and below it what was told of that.

    Parameters
    ----------
    stamps, errors : (N,) nanoseconds and metres
    told : (M,) nanoseconds, (M, 6) errors since the start (rad, m) and their standard deviations;
        None draws none
    """
    figure = empty_figure(9.0, 3.2 if told is None else 7.6)
    axes, *rows = [figure.subplots()] if told is None else _error_panels(figure)
    seconds = (stamps - stamps[0]) * 1e-9 if len(stamps) else stamps
    if told is not None and len(stamps):
        _draw_told(rows, told, int(stamps[0]))
    axes.fill_between(seconds, errors, color=PATH, alpha=0.15, lw=0)
    axes.plot(seconds, errors, color=PATH, lw=1.4)
    rmse = float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0
    axes.axhline(rmse, color=INK, lw=0.8, ls=":", label=f"{rmse:.3f} m (RMSE)")
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False)
    axes.set(xlabel="time [s]", ylabel="position error [m]")
    save_figure(figure, path)


def _error_panels(figure: Any) -> list[Any]:
    """A panel over the whole width, and six below it: positions left, rotations right."""
    grid = figure.add_gridspec(4, 2, height_ratios=(1.5, 1.0, 1.0, 1.0))
    places = [grid[0, :], *(grid[row, column] for column in (1, 0) for row in (1, 2, 3))]
    return [figure.add_subplot(place) for place in places]


def _draw_told(
    panels: Sequence[Any], told: tuple[IntArray, FloatArray, FloatArray], start: int
) -> None:
    """Errors by component in the band of three standard deviations that were told of them."""
    stamps, errors, sigmas = told
    seconds = (stamps - start) * 1e-9
    for k, (axes, name) in enumerate(zip(panels, TANGENT, strict=True)):
        unit, factor = ("deg", np.degrees(1.0)) if k < 3 else ("m", 1.0)
        error, band = factor * errors[:, k], factor * 3.0 * sigmas[:, k]
        axes.fill_between(seconds, -band, band, color=TRUTH, alpha=0.35, lw=0, label="±3 sigma")
        axes.plot(seconds, error, color=PATH, lw=1.1, label="error")
        # A band as wide as an unseen direction would flatten the error to a line.
        high = max(
            float(np.abs(error).max(initial=0.0)), float(np.median(band)) if len(band) else 0
        )
        axes.set_ylim(-1.3 * high - 1e-12, 1.3 * high + 1e-12)
        axes.set_ylabel(f"{name} [{unit}]")
        if k % 3 == 2:
            axes.set_xlabel("time [s]")
        else:
            axes.tick_params(labelbottom=False)
    panels[3].legend(frameon=False, ncols=2, fontsize=8, loc="upper left")


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
        axes.set_ylim(0.0, 1.5 * float(np.percentile(milliseconds.sum(axis=1), 95)) + 1e-9)
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
    figure, top = _trajectory_figure(lines)
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
    lines: Sequence[tuple[str, Trajectory, tuple[str, str], float]],
) -> tuple[Any, Any]:
    """Paths from above over their heights; the figure is as high as the paths, within limits."""
    places = np.concatenate([line[1].map_T_lidar[:, :2, 3] for line in lines])
    places = places[np.isfinite(places).all(axis=1)]
    width, depth = np.ptp(places, axis=0) if len(places) else (1.0, 1.0)
    high = 8.2 * float(np.clip(1.2 * depth / max(width, 1e-6), 0.25, 0.6))  # inches
    figure = empty_figure(9.0, high + 2.4)
    top, side = figure.subplots(2, 1, height_ratios=(high, 1.3))
    for name, trajectory, (colour, style), width in lines:
        xyz = trajectory.positions
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
    opacity = np.clip(0.55 + 0.25 * np.log1p(count), 0.0, 1.0) * (count > 0)
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
