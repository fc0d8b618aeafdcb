"""What is known of poses in an adjustment, held against numbers."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from loam_gtsam.refine.rounds import Ties
from loam_gtsam.types import FloatArray


def check_gradient(known: Ties, poses: FloatArray) -> None:
    """The gradient at poses (N, 4, 4) is that of the cost."""
    _, gradient = known.equations(poses)
    assert gradient.shape == (6 * len(known.numbers),)
    for place, number in enumerate(known.numbers):
        for axis in range(6):
            costs = []
            for step in (1e-5, -1e-5):
                moved = poses.copy()
                delta = step * np.eye(6)[axis]
                moved[number] = gtsam.Pose3(poses[number]).retract(delta).matrix()
                costs.append(known.cost(moved))
            slope = (costs[0] - costs[1]) / 2e-5
            assert gradient[6 * place + axis] == pytest.approx(slope, rel=1e-4, abs=1e-3)
