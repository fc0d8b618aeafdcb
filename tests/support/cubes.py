"""Small cube maps, and moves of their points."""

import numpy as np

from loam_gtsam.config import MapConfig

SMALL = MapConfig(
    cube_size=4.0, window=(5, 5, 3), window_margin=1, neighbourhood=(3, 3, 3), field_of_view=False
)


def moved_by(x):
    move = np.eye(4)
    move[0, 3] = x
    return move
