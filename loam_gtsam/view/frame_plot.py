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


def plot_frame(path: str | Path, frame: FrameView, around: MapView) -> None:
    """Draw a frame from behind and above: map, sweep, and matches by their residuals.

    Raises OutputError if matplotlib is missing or the file cannot be written.
    """
    figure = empty_figure(9.0, 6.0)
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap

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
    axes.fill(*camera.ellipse(frame.position_covariance).T, color=INK, lw=0)
    axes.plot(0.0, 0.0, "o", color=PATH, mec="white", ms=8)
    bar = figure.colorbar(
        dots, cax=axes.inset_axes((0.02, 0.09, 0.24, 0.022)), orientation="horizontal", extend="max"
    )
    bar.set_label(
        f"residual [standard deviations]\nlines and {_SIGMAS:g}-sigma ellipse: {_ENLARGED:g} x",
        color=INK,
    )
    bar.ax.tick_params(colors=INK, length=0, labelsize=9)
    bar.outline.set_visible(False)
    reach = camera.reach
    axes.set(xlim=(-reach, reach), ylim=(-0.62 * reach, 0.72 * reach), aspect="equal")
    axes.axis("off")
    save_figure(figure, path)


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

    def ellipse(self, covariance: FloatArray) -> FloatArray:
        """(N, 2) outline of 3 sigma, enlarged, around the sensor; empty if it is not known."""
        if not np.isfinite(covariance).all():
            return np.zeros((0, 2))
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
