"""Pictures of a map before and after: a cross-section that was refined, what was taken out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from loam_gtsam.types import FloatArray
from loam_gtsam.view.plots import INK, PATH, empty_figure, save_figure

_REACH = 1.5
"""Metres shown on either side of the place."""
_MARGIN = 10.0
"""Metres shown around the way and what was taken out."""
_SLAB = 0.2
"""Metres of depth of the cross-section, on either side of the cut."""


def plot_section(
    path: str | Path, before: FloatArray, after: FloatArray, centre: FloatArray, normal: FloatArray
) -> None:
    """Draw the points about a surface, looking along it.

    Parameters
    ----------
    before, after : (N, 3) metres, the same points in the first and in the refined map
    centre, normal : (3,) metres and unit: a place on a surface
    """
    flat = np.eye(3)[np.abs(normal).argmin()]
    along = np.cross(normal, flat)
    along /= np.linalg.norm(along)
    depth = np.cross(along, normal)
    figure = empty_figure(9.0, 3.8)
    for place, (name, points, colour) in enumerate(
        (("before", before, INK), ("after", after, PATH)), start=1
    ):
        axes = figure.add_subplot(1, 2, place)
        away = points - centre
        near = (np.abs(away @ depth) < _SLAB) & (np.abs(away @ along) < _REACH)
        near &= np.abs(away @ normal) < _REACH / 3.0
        axes.plot(away[near] @ along, 1e3 * (away[near] @ normal), ".", ms=2.5, color=colour)
        axes.set_title(name)
        axes.set_xlabel("along the surface [m]")
        axes.set_ylabel("across it [mm]")
    save_figure(figure, path)


def plot_cleaned(path: str | Path, kept: FloatArray, gone: FloatArray, way: FloatArray) -> None:
    """Draw a map from above with what was taken out of it, and without.

    Parameters
    ----------
    kept, gone : (N, 3) metres, points that stay and those that were removed
    way : (M, 3) metres, positions of the lidar
    """
    figure = empty_figure(9.0, 4.8)
    about = np.concatenate([way, gone]) if len(gone) else way
    low, high = about[:, :2].min(axis=0) - _MARGIN, about[:, :2].max(axis=0) + _MARGIN
    for place, name in enumerate(("before: removed points in colour", "after"), start=1):
        axes = figure.add_subplot(1, 2, place)
        axes.plot(kept[:, 0], kept[:, 1], ",", color=INK, alpha=0.35)
        if place == 1:
            axes.plot(gone[:, 0], gone[:, 1], ".", ms=1.5, color=PATH)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        axes.set_title(name)
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
    save_figure(figure, path)
