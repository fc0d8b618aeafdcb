"""Points on a wall along x, mapped from one place and matched from another."""

import gtsam
import numpy as np

from loam_gtsam.config import MapConfig, MatchingConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.registration.association import associate
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.types import FloatArray

CONFIG = MatchingConfig(plane_tolerance=0.2)  # planes may lie between two faces
MAP = MapConfig(field_of_view=False)
NONE = np.empty((0, 3))


def face(y: float) -> FloatArray:
    """Points on the wall at this y, on a grid."""
    x, z = np.meshgrid(np.arange(-3.0, 3.0 + 1e-9, 0.4), np.arange(-1.8, 1.81, 0.4))
    return np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()])


def matched(
    planes: CubeMap, points_map: FloatArray, lidar: FloatArray, config: MatchingConfig = CONFIG
) -> ScanMatches:
    """The matches of points as a lidar without rotation sees them."""
    edges = CubeMap(MAP, 0.1)
    pose = gtsam.Pose3(gtsam.Rot3(), lidar)
    return associate(NONE, points_map - lidar, pose, edges, planes, config)


MIDDLE = np.array([[x, 0.0, z] for x in np.arange(-1.3, 1.4, 0.33) for z in (-0.7, 0.1, 0.6)])
"""Points on the front, in the middle of it."""
