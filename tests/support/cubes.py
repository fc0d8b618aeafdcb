"""Small cube maps, what they hold of points, and moves of their points."""

import numpy as np

from loam_gtsam.config import MapConfig
from loam_gtsam.types import FloatArray
from loam_gtsam.voxels.grid import STEP

SMALL = MapConfig(
    cube_size=4.0, window=(5, 5, 3), window_margin=1, neighbourhood=(3, 3, 3), field_of_view=False
)


def stored(points: FloatArray) -> FloatArray:
    """Points as a map holds them."""
    return np.rint(np.asarray(points) / STEP) * STEP


def moved_by(x):
    move = np.eye(4)
    move[0, 3] = x
    return move
