"""Frames and a map for viewers to show."""

import gtsam
import numpy as np

from loam_gtsam.types import FrameStatus, MapUpdate
from loam_gtsam.view.frame_view import FrameView, MapView

NONE = np.zeros((0, 3))
STAMP = 1_700_000_000_123_456_789


def frame(number, **changes):
    update = MapUpdate(STAMP + number, gtsam.Pose3(), FrameStatus.OK)
    points = np.random.default_rng(number).normal(size=(50, 3))
    values = {
        "number": number, "update": update, "map_T_lidar": np.eye(4),
        "position_covariance": np.diag([4e-4, 1e-4, 9e-4]), "sweep": points, "edges": points[:5],
        "planes": points[:9], "points": points[:7], "feet": points[:7] + 0.01,
        "residuals": np.linspace(0.0, 4.0, 7),
    }  # fmt: skip
    return FrameView(**(values | changes))


def around():
    points = np.random.default_rng(0).normal(size=(900, 3))
    ends = np.zeros((3, 2, 3))
    return MapView(points[:300], points[300:], points, ends, np.array([True, False, True]))
