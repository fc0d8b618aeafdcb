"""A drive around a block of 40 m with a GNSS receiver, and its pose graph, without a lidar."""

import gtsam
import numpy as np
from support.pose_graphs import FRAME, SIGMAS, drifted, frames, settings, square

from loam_gtsam.config import AidingConfig
from loam_gtsam.datasets.decode.aiding import GnssFixes
from loam_gtsam.datasets.decode.geodesy import geodetic_of
from loam_gtsam.loops.pose_graph import PoseGraph

ORIGIN = np.array([47.5, 8.5, 450.0])
ANTENNA = np.array([0.4, -0.3, 1.1])
ENU_T_MAP = gtsam.Pose3(gtsam.Rot3.Yaw(2.2), np.array([120.0, -35.0, 4.0]))
CONFIG = AidingConfig(gnss=True, lidar_t_antenna=tuple(ANTENNA), gnss_memory=0.0)


class Drive:
    """Truth, drifted odometry, its graph, and fixes with noise of ``sigma`` between the frames."""

    def __init__(self, seed=0, sigma=0.3, laps=2, step=SIGMAS):
        rng = np.random.default_rng(seed)
        self.truth = square(10, laps)
        self.updates = frames(drifted(self.truth, rng, step), step)
        self.graph = PoseGraph(settings())
        for update in self.updates:
            self.graph.add(update)
        at = [ENU_T_MAP.compose(p).transformFrom(ANTENNA) for p in self.truth[1:-1]]
        self.enu = np.array(at) + rng.normal(0.0, sigma, (len(at), 3))
        self.stamps = np.arange(1, len(at) + 1) * FRAME
        self.covariance = sigma**2 * np.eye(3)

    def fixes(self, unknown=False):
        noise = np.full((3, 3), np.nan) if unknown else self.covariance
        repeated = np.repeat(noise[None], len(self.enu), axis=0)
        return GnssFixes(self.stamps, geodetic_of(self.enu, ORIGIN), repeated)

    def errors(self):
        """Metres from the truth of every keyframe, in the map."""
        found = self.graph.poses()[:, :3, 3]
        return np.linalg.norm(found - [pose.translation() for pose in self.truth], axis=1)
