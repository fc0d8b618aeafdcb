"""Drives with a GNSS receiver: around a block of 40 m without a lidar, and in simulated worlds."""

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np
from support.pose_graphs import FRAME, SIGMAS, drifted, frames, settings, square

from loam_gtsam.config import AidingConfig, Config
from loam_gtsam.datasets import ArrayDataset, SimulatedWorld
from loam_gtsam.datasets.decode.aiding import GnssFixes
from loam_gtsam.datasets.decode.geodesy import GeoReference, east_north_up, geodetic_of
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.types import FloatArray, IntArray, Scan, Trajectory

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


ENU_T_WORLD = gtsam.Pose3(gtsam.Rot3.Yaw(2.2), np.array([20.0, -35.0, 4.0]))
SURVEY_SIGMA = 0.02
SURVEY = Config().changed(
    "pose_graph.keyframe_distance=0.5", "aiding.gnss_memory=0.0", "aiding.gnss=true"
)


def surveyed_parts(
    world: SimulatedWorld, sweeps: Sequence[Scan], cuts: Sequence[tuple[int, int]]
) -> Iterator[ArrayDataset]:
    """Parts of a drive through a world, each with a fix of 2 cm on every sweep."""
    truth, rng = world.truth, np.random.default_rng(0)
    every = in_enu(truth.positions)
    for cut in cuts:
        rows = slice(*cut)
        enu = every[rows] + rng.normal(0.0, SURVEY_SIGMA, every[rows].shape)
        known = np.repeat(SURVEY_SIGMA**2 * np.eye(3)[None], len(enu), axis=0)
        fixes = GnssFixes(truth.stamps[rows], geodetic_of(enu, ORIGIN), known)
        yield ArrayDataset(sweeps[rows], sensor=world.sensor, gnss=fixes)


def in_enu(positions: FloatArray) -> FloatArray:
    """Positions (N, 3) in the world, east, north and up of :data:`ORIGIN`."""
    return np.array([ENU_T_WORLD.transformFrom(position) for position in positions])


def off_in_enu(
    truth: Trajectory, stamps: IntArray, positions: FloatArray, earth: GeoReference | None
) -> FloatArray:
    """(K, 3) metres east, north and up that positions (N, 3) in a map are from where they were.

    Those of stamps after the truth ends are left out.
    """
    assert earth is not None
    inside = stamps <= truth.stamps[-1]
    true = truth.at(stamps[inside]).positions
    enu_T_map = gtsam.Pose3(earth.enu_T_map)
    found = np.array([enu_T_map.transformFrom(position) for position in positions[inside]])
    return found - east_north_up(geodetic_of(in_enu(true), ORIGIN), earth.origin)
