"""Tables and figures of the study: success rates, errors, changes of the default, the corridor."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.study_variants import (
    ALONG,
    CHANGES,
    COLOURS,
    CORRIDOR,
    DEGREES,
    FIRST,
    LABELS,
    MAIN,
    METRES,
    SHARE,
    SHARES,
    Measured,
    Result,
    Trial,
    Variant,
)
from benchmarks.tables import write_csv


@dataclass(frozen=True, slots=True)
class Row:
    """All trials of one kind: share of successes (percent), and errors in metres and degrees."""

    study: str
    scene: str
    solver: str
    level: float
    trials: int
    success: float
    mean_m: float
    median_m: float
    p95_m: float
    median_deg: float
    p95_deg: float
    along_m: float
    across_m: float
    iterations: float
    converged: float


def summary(results: Iterable[Result]) -> list[Row]:
    """One row for each study, scene, solver and level, in the order in which they came."""
    groups: dict[tuple[str, str, str, float], list[Trial]] = {}
    for result in results:
        if isinstance(result, Trial):
            key = (result.study, result.scene, result.solver, result.level)
            groups.setdefault(key, []).append(result)
    rows = []
    for key, trials in groups.items():
        metres, degrees = [t.metres for t in trials], [t.degrees for t in trials]
        rows.append(
            Row(
                *key,
                len(trials),
                100.0 * float(np.mean([t.success for t in trials])),
                float(np.mean(metres)),
                float(np.median(metres)),
                float(np.percentile(metres, 95.0)),
                float(np.median(degrees)),
                float(np.percentile(degrees, 95.0)),
                float(np.median([t.along for t in trials])),
                float(np.median([t.across for t in trials])),
                float(np.mean([t.iterations for t in trials])),
                100.0 * float(np.mean([t.converged for t in trials])),
            )
        )
    return rows


def averages(results: Iterable[Result]) -> list[Measured]:
    """Mean over the targets of each number that is no trial."""
    groups: dict[tuple[str, str, str, str], list[float]] = {}
    for result in results:
        if isinstance(result, Measured):
            key = (result.study, result.scene, result.solver, result.name)
            groups.setdefault(key, []).append(result.value)
    return [Measured(*key, float(np.mean(values))) for key, values in groups.items()]


def write_fields(path: Path, rows: Sequence[Row] | Sequence[Measured]) -> None:
    """Every field with four significant digits."""
    names = [item.name for item in fields(rows[0])]
    write_csv(path, names, ([getattr(row, name) for name in names] for row in rows), digits=4)


def draw(folder: Path, rows: Sequence[Row], numbers: Sequence[Measured]) -> None:
    """The figures ``study_*.png``."""
    mpl.use("Agg")
    mpl.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    folder.mkdir(parents=True, exist_ok=True)
    scenes = list(dict.fromkeys(row.scene for row in rows if row.study == "metres"))
    for name, draw_panel, kinds in (
        ("basin", _draw_basin, (("metres", METRES), ("degrees", DEGREES))),
        ("outliers", _draw_outliers, (("random outliers", SHARES), ("moving outliers", SHARES))),
    ):
        figure, axes = plt.subplots(
            2, len(scenes), figsize=(1.5 + 2.6 * len(scenes), 5.2), squeeze=False, sharey=True
        )
        for line, (study, levels) in zip(axes, kinds, strict=True):
            for panel, scene in zip(line, scenes, strict=True):
                here = [row for row in rows if (row.study, row.scene) == (study, scene)]
                draw_panel(panel, here, levels)
                panel.set(title=scene, xlabel=LABELS[study])
        axes[0, 0].legend(frameon=False)
        for panel in axes[:, 0]:
            panel.set_ylabel(LABELS[name])
        _save(figure, folder / f"study_{name}.png")
    _draw_changes(folder, rows, scenes)
    _draw_corridor(folder, rows, numbers)


def _draw_basin(panel: Axes, rows: Sequence[Row], levels: Sequence[float]) -> None:
    for offset, variant in enumerate((*MAIN, FIRST)):
        own = {row.level: row.success for row in rows if row.solver == variant.name}
        shares = [own.get(level, np.nan) for level in levels]
        # A little apart, or equal rates would hide each other.
        panel.plot(np.arange(len(levels)) + 0.05 * offset, shares, "o-", ms=4, **_style(variant))
    panel.set_xticks(range(len(levels)), [f"{level:g}" for level in levels])
    panel.set_ylim(-5.0, 105.0)


def _draw_outliers(panel: Axes, rows: Sequence[Row], levels: Sequence[float]) -> None:
    for variant in (*MAIN, FIRST):
        own = [row for row in rows if row.solver == variant.name]
        x = [100.0 * row.level for row in own]
        panel.semilogy(x, [row.median_m for row in own], "o-", ms=4, **_style(variant))
        panel.semilogy(x, [row.p95_m for row in own], ":", lw=1.0, color=_style(variant)["color"])
    panel.set_xticks([100.0 * level for level in levels])
    panel.grid(axis="y", alpha=0.3)


def _draw_changes(folder: Path, rows: Sequence[Row], scenes: Sequence[str]) -> None:
    """Errors of the changes of the default, over those of the default itself."""
    kinds = (("from truth", 0.0), ("moving outliers", SHARE), ("random outliers", SHARE))
    names = [v.name for v in (*CHANGES, *MAIN[1:])]
    figure, axes = plt.subplots(1, len(kinds), figsize=(11.0, 3.6), sharey=True)
    for panel, (study, level) in zip(axes, kinds, strict=True):
        error = {
            (r.scene, r.solver): r.mean_m for r in rows if r.study == study and r.level == level
        }
        for mark, scene in zip("os^D", scenes, strict=False):
            ratios = [error[scene, name] / error[scene, "default"] for name in names]
            panel.semilogx(ratios, range(len(names)), mark, ms=5, alpha=0.8, label=scene)
        panel.axvline(1.0, color="0.6", lw=1.0)
        panel.set_xticks([0.25, 0.5, 1, 2, 4], ["1/4", "1/2", "1", "2", "4"])
        panel.minorticks_off()
        panel.grid(axis="x", alpha=0.3)
        panel.set(
            title=f"{study}, {level:.0%}" if level else study, xlabel="mean error over default's"
        )
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    axes[-1].legend(frameon=False, fontsize=8)
    _save(figure, folder / "study_changes.png")


def _draw_corridor(folder: Path, rows: Sequence[Row], numbers: Sequence[Measured]) -> None:
    names = [variant.name for variant in CORRIDOR]
    own = {row.solver: row for row in rows if row.study == "wrong along"}
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 3.4))
    places = np.arange(len(names))
    left.barh(places - 0.2, [own[name].along_m for name in names], 0.4, label="along")
    left.barh(places + 0.2, [own[name].across_m for name in names], 0.4, label="across")
    left.axvline(ALONG, color="0.6", ls="--", lw=1.0, label="guess, along")
    left.set_yticks(places, names)
    left.invert_yaxis()
    left.set(xscale="log", xlabel="median error, m")
    left.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.4, 1.0))
    for variant in (variant for variant in CORRIDOR if variant.name in COLOURS):
        values = [n.value for n in numbers if (n.study, n.solver) == ("eigenvalue", variant.name)]
        right.semilogy(range(1, 7), values, "o-", **_style(variant))
    right.axhline(100.0, color="0.6", ls="--", lw=1.0)
    right.text(4.0, 110.0, "LOAM's threshold", va="bottom", fontsize=8)
    right.set(xlabel="eigenvalue of the information", ylim=(50.0, None))
    right.legend(frameon=False)
    _save(figure, folder / "study_corridor.png")


def _style(variant: Variant) -> dict[str, Any]:
    return {"color": COLOURS[variant.name], "label": variant.name}


def _save(figure: Figure, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)
