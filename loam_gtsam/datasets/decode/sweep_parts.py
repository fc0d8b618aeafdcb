"""Whether the messages of a topic are whole sweeps of one lidar, by the first of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from loam_gtsam.datasets.decode.point_times import SWEEP_SECONDS
from loam_gtsam.types import BoolArray, Scan

_DIRECTIONS = 72  # parts of the horizon in which a message has points or not
_ALIKE = 0.3
"""Share of the directions of two messages in a row that both have, below which they look
elsewhere. Whole sweeps share nearly all, halves nearly none."""
_FEWEST = 3  # messages that tell


def sweep_problem(frames: Mapping[str, int], scans: Sequence[Scan]) -> str:
    """What is wrong with messages that were looked at; empty if nothing is.

    ``frames`` is how often each name of a frame was in their headers.
    """
    if len(frames) > 1:
        counts = ", ".join(f"{name or 'without a name'}: {n}" for name, n in frames.items())
        return (
            f"the first {sum(frames.values())} messages are of several frames ({counts}): sweeps "
            "of several lidars on one topic are mapped as if they were of one; give each lidar a "
            "topic of its own, or join their points in one frame"
        )
    seen = [_directions(scan) for scan in scans if scan.rings is not None or scan.rows]
    shares = [np.sum(a & b) / np.sum(a | b) for a, b in pairwise(seen) if (a | b).any()]
    if len(seen) < _FEWEST or len(shares) < _FEWEST - 1 or np.median(shares) >= _ALIKE:
        return ""
    return (
        "messages in a row look in different directions: they hold parts of a sweep, or sweeps of "
        "several lidars, and each is mapped as if it were a whole one; let the driver publish one "
        "message for each turn of the lidar"
    )


def packets_hint(received: Sequence[int]) -> str:
    """What is added to a refusal if messages, received at these times (ns), come too fast."""
    steps = np.diff(np.asarray(received, np.int64))
    step = float(np.median(steps)) * 1e-9 if len(steps) >= _FEWEST - 1 else 0.0
    if not 0.0 < step < SWEEP_SECONDS[0]:
        return ""
    return (
        f"; a message comes each {step * 1e3:.3g} ms: if they hold parts of a sweep, let the "
        "driver publish one message for each turn of the lidar"
    )


def _directions(scan: Scan) -> BoolArray:
    """In which directions a sweep has points."""
    points = np.asarray(scan.points[:, :2], np.float64)
    points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
    turn = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) + 0.5
    seen = np.bincount(np.minimum((turn * _DIRECTIONS).astype(np.int64), _DIRECTIONS - 1))
    return np.pad(seen, (0, _DIRECTIONS - len(seen))) > 0
