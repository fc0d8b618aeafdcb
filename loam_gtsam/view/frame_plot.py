"""A picture of one frame: what was seen, what it was matched with, and how well that fits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from loam_gtsam.types import BoolArray, FloatArray
from loam_gtsam.view.frame_view import LARGE_RESIDUAL, RESIDUAL_COLOURS, FrameView, MapView
from loam_gtsam.view.plots import INK, PATH, empty_figure, save_figure

_REACH = (6.0, 50.0)  # metres around the sensor that are drawn, at least and at most
_SHARE = 0.88  # of the sweep that is drawn, where that is between these limits
_ASIDE_DEG, _ABOVE_DEG = 28.0, 33.0  # of the view: beside the sensor's back, above the ground
_MAP, _SWEEP = "#b9c3cc", "#6b7a88"
_ENLARGED = 10.0  # factor for residuals and the ellipse of the covariance
_SIGMAS = 3.0
_UNSEEN = 0.35  # of the reach; what is enlarged to more than this hides the frame: an arrow instead


def plot_frame(path: str | Path, frame: FrameView, around: MapView) -> None:
    """Draw a frame from behind and above: map, sweep, and matches by their residuals.

    Along directions in which the position is hardly known there is an arrow with the size of the
    uncertainty, and the ellipse is that of the others.

    Raises OutputError if matplotlib is missing or the file cannot be written.
    """
    figure = empty_figure(9.0, 6.0)
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap, to_rgb

    axes = figure.subplots()
    camera = _Camera(frame)
    known = camera.near(np.concatenate([around.edges, around.planes]))
    axes.scatter(*camera(known).T, s=0.7, c=_MAP, lw=0)
    axes.scatter(*camera(camera.near(frame.sweep)).T, s=1.0, c=_SWEEP, lw=0)
    inside = camera.is_near(frame.points)
    order = np.argsort(frame.residuals[inside], kind="stable")  # the large ones on top
    points, feet = frame.points[inside][order], frame.feet[inside][order]
    scale: dict[str, Any] = {
        "array": frame.residuals[inside][order],
        "cmap": LinearSegmentedColormap.from_list("residual", RESIDUAL_COLOURS),
        "clim": (0.0, LARGE_RESIDUAL),
    }
    ends = points + _ENLARGED * (feet - points)
    lines = np.stack([camera(points), camera(ends)], axis=1)
    axes.add_collection(LineCollection([*lines], lw=0.9, **scale))
    dots = axes.scatter(*camera(points).T, s=9.0, lw=0)
    dots.set(**scale)
    path_seen = camera(camera.near(around.path)).T
    axes.plot(*path_seen, color="white", lw=3.5)
    axes.plot(*path_seen, color=PATH, lw=2.0)
    ellipse, unseen = camera.uncertainty(frame.position_covariance)
    axes.fill(*ellipse.T, fc=(*to_rgb(INK), 0.2), ec=INK, lw=1.5)
    for end, sigma in unseen:
        _draw_unseen(axes, end, sigma)
    axes.plot(0.0, 0.0, "o", color=PATH, mec="white", ms=8)
    bar = figure.colorbar(
        dots, ax=axes, location="bottom", extend="max", shrink=0.3, aspect=24, pad=0.01,
        anchor=(0.0, 1.0),
    )  # fmt: skip
    scales = f"lines and {_SIGMAS:g}-sigma ellipse: {_ENLARGED:g} x"
    scales += "; arrows not to scale" if unseen else ""
    bar.set_label(f"residual [standard deviations]; {scales}", color=INK, loc="left")
    bar.ax.tick_params(colors=INK, length=0, labelsize=9)
    bar.outline.set_visible(False)
    reach = camera.reach
    axes.set(xlim=(-reach, reach), ylim=(-0.62 * reach, 0.72 * reach), aspect="equal")
    axes.axis("off")
    save_figure(figure, path)


def _draw_unseen(axes: Any, end: FloatArray, sigma: float) -> None:
    """A double arrow along a direction in which the position is known to ``sigma`` metres."""
    size = np.format_float_positional(_SIGMAS * sigma, 2, fractional=False, trim="-")
    look = {"arrowstyle": "<|-|>", "color": INK, "lw": 2.2, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=tuple(end), xytext=tuple(-end), arrowprops=look)
    axes.annotate(
        f"weakly constrained:\n±{size} m (3 sigma)", xy=tuple(end),
        xytext=(8, 0), textcoords="offset points", color=INK, va="center", fontsize=10,
        bbox={"fc": "white", "ec": "none", "alpha": 0.85, "pad": 2.0},
    )  # fmt: skip


class _Camera:
    """A parallel projection; the sensor's heading points up and to the right."""

    def __init__(self, frame: FrameView) -> None:
        map_T_lidar = frame.map_T_lidar
        self._centre = map_T_lidar[:3, 3]
        far = self._distances(frame.sweep)
        self.reach = float(np.clip(np.quantile(far, _SHARE) if len(far) else 0.0, *_REACH))
        heading = np.arctan2(map_T_lidar[1, 0], map_T_lidar[0, 0]) + np.radians(_ASIDE_DEG)
        above = np.radians(_ABOVE_DEG)
        forward = np.array([np.cos(heading), np.sin(heading), 0.0])
        right = np.array([np.sin(heading), -np.cos(heading), 0.0])
        up = np.sin(above) * forward + np.cos(above) * np.array([0.0, 0.0, 1.0])
        self._axes = np.stack([right, up])

    def __call__(self, points: FloatArray) -> FloatArray:
        across: FloatArray = (points - self._centre) @ self._axes.T
        return across

    def uncertainty(
        self, covariance: FloatArray
    ) -> tuple[FloatArray, list[tuple[FloatArray, float]]]:
        """The ellipse, and (2,) ends of arrows with sigmas in metres where it would hide all."""
        if not np.isfinite(covariance).all():
            return np.zeros((0, 2)), []
        variances, directions = np.linalg.eigh(covariance)
        sigmas = np.sqrt(np.maximum(variances, 0.0))
        wide = _SIGMAS * _ENLARGED * sigmas > _UNSEEN * self.reach
        kept = (directions * np.where(wide, 0.0, variances)) @ directions.T
        arrows = directions[:, wide].T @ self._axes.T * (_UNSEEN * self.reach)
        arrows *= np.where(arrows[:, :1] < 0.0, -1.0, 1.0)  # labels at the right end
        return self._ellipse(kept), list(zip(arrows, sigmas[wide].tolist(), strict=True))

    def _ellipse(self, covariance: FloatArray) -> FloatArray:
        """(N, 2) outline of 3 sigma, enlarged, around the sensor."""
        variances, axes = np.linalg.eigh(self._axes @ covariance @ self._axes.T)
        angles = np.linspace(0.0, 2.0 * np.pi, 61)
        half = _SIGMAS * _ENLARGED * np.sqrt(np.maximum(variances, 0.0))
        outline: FloatArray = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * half @ axes.T
        return outline

    def is_near(self, points: FloatArray) -> BoolArray:
        return self._distances(points) < self.reach

    def near(self, points: FloatArray) -> FloatArray:
        return points[self.is_near(points)]

    def _distances(self, points: FloatArray) -> FloatArray:
        distances: FloatArray = np.linalg.norm((points - self._centre)[:, :2], axis=1)
        return distances
