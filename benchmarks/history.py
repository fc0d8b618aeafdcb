"""Accuracy and time over the versions: one JSON line a run of the benchmarks, and a picture."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cases import CaseResult
from benchmarks.report import machine
from loam_gtsam.io.version import installed_version
from loam_gtsam.types import FloatArray, IntArray
from loam_gtsam.view.plots import available, plot_curves

FILE = "history.jsonl"
_PANELS = {"ate_m": "ATE [mm]", "ms": "ms a frame", "x_kiss_icp": "times of KISS-ICP"}
_SCALES = {"ate_m": 1000.0}


def add(folder: Path, results: Sequence[CaseResult]) -> tuple[Path, ...]:
    """Add a run to the history in a folder, and draw it; returns the paths."""
    line = {
        "date": datetime.now(UTC).date().isoformat(),
        "version": installed_version(),
        "machine": dict(machine()),
        "cases": {result.name: _measured(result) for result in results if not result.problem},
    }
    with (folder / FILE).open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
    return draw(folder)


def draw(folder: Path) -> tuple[Path, ...]:
    """Make the picture, if matplotlib is there, from the lines of a folder."""
    text = (folder / FILE).read_text(encoding="utf-8")
    runs = [json.loads(line) for line in text.splitlines()]
    picture = folder / "history.png"
    if not available():
        return (folder / FILE,)
    numbers = np.arange(1, len(runs) + 1)
    panels: dict[str, dict[str, tuple[IntArray, FloatArray]]] = {}
    for key, label in _PANELS.items():
        curves = {name: [_value(run, name, key) for run in runs] for name in _names(runs)}
        panels[label] = {
            name: (numbers[known], np.array(values)[known])
            for name, values in curves.items()
            for known in [np.isfinite(values)]
        }
    plot_curves(picture, panels, "run", log=True)
    return folder / FILE, picture


def _measured(result: CaseResult) -> dict[str, float | None]:
    values = {
        "ate_m": result.ate,
        "ms": result.stages["wall"][0] if "wall" in result.stages else math.nan,
        "x_kiss_icp": result.ratio,
    }
    return {key: value if math.isfinite(value) else None for key, value in values.items()}


def _names(runs: Sequence[dict[str, Any]]) -> list[str]:
    """The cases with an ATE in any of the runs, those of the last run first."""
    found = [(name, case) for run in reversed(runs) for name, case in run["cases"].items()]
    return list(dict.fromkeys(name for name, case in found if case["ate_m"] is not None))


def _value(run: dict[str, Any], name: str, key: str) -> float:
    value = run["cases"].get(name, {}).get(key)
    return math.nan if value is None else _SCALES.get(key, 1.0) * value
