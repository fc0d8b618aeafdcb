"""Trials of parameter studies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from loam_gtsam.config import Config
from loam_gtsam.studies.trials import NOT_REPEATABLE, Row, Trial

WORLD = "sim:room?frames=24&columns=300&speed=5"
# No first sweeps are mapped anew with each that follows, which takes most of a short run.
SPEC = f"""
sequences:
  room: {WORLD}
configs:
  gtsam: {{set: {{deskew.model: predicted}}}}
  few: {{set: {{deskew.model: predicted, solver.iterations: 2}}}}
seeds: [0, 1]
frames: 4
"""


def trial_of(path: str = WORLD, **changes: Any) -> Trial:
    return replace(Trial("here", "this", path, {}, None, None, Config()), **changes)


def write_spec(folder: Path, text: str) -> Path:
    file = folder / "spec.yaml"
    file.write_text(text)
    return file


def repeatable(rows: list[Row]) -> list[Row]:
    return [{k: v for k, v in row.items() if k not in NOT_REPEATABLE} for row in rows]
