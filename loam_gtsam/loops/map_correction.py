"""Loops closed as a run goes, and the map that follows.

The mapper stays in the frame it began in, ``odom``: continuous, for whoever steers by it (ROS
REP-105). Where a loop says that older keyframes lie elsewhere, seen from the newest one, their
points move there, and the next sweep is matched with the corrected map. ``map_T_odom`` says where
it all is.
"""

from __future__ import annotations

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.geometry import transform
from loam_gtsam.loops.closure import LoopCloser, LoopStatistics, ScanLoopCloser
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.mapper import Mapper
from loam_gtsam.types import BoolArray, Features, FloatArray, MapUpdate


class LoopMapping:
    """A pose graph beside a mapper, whose map it keeps in order.

    Parameters
    ----------
    mapper : whose frames are given to :meth:`add`
    config : ``pose_graph`` and ``loops``, and what :class:`PoseGraph` and
        :class:`ScanLoopCloser` use
    closer : finds the loops; a :class:`ScanLoopCloser` if None

    Attributes
    ----------
    graph : keyframes and loops
    closer : finds the loops
    moved : map points moved so far
    """

    def __init__(
        self,
        mapper: Mapper,
        config: Config | None = None,
        closer: LoopCloser | None = None,
    ) -> None:
        self._config = config or Config()
        self._mapper = mapper
        self.graph = PoseGraph(self._config)
        self.closer: LoopCloser = closer or ScanLoopCloser(self._config)
        self.moved = 0
        self._placed: list[gtsam.Pose3] = []
        """``odom_T_lidar`` of the keyframes, to which their map points are fixed."""

    @property
    def map_T_odom(self) -> gtsam.Pose3:
        """What leads from the mapper's poses and points to the corrected ones."""
        return self.graph.correction

    def add(self, update: MapUpdate, features: Features) -> bool:
        """Take a frame that the mapper has just registered.

        Parameters
        ----------
        update : of the frame
        features : of its sweep

        Returns
        -------
        Whether a loop was closed.
        """
        aid = self._mapper.imu
        self.graph.imu = None if aid is None else aid.trusted_gyro  # which the mapper may give up
        keyframe = self.graph.add(update, features)
        if keyframe is None:
            return False
        self._placed.append(keyframe.odom_T_lidar)
        self._mapper.keyframe = keyframe.index
        loop = self.closer.detect(keyframe, self.graph)
        if loop is None or not self.graph.add_loop(loop):
            return False
        config = self._config.pose_graph
        self.follow(config.follow_distance, config.follow_angle_deg)
        return True

    def follow(self, metres: float = 0.0, degrees: float = 0.0) -> None:
        """Move the map points of the keyframes that lie elsewhere by more than this.

        Seen from the newest keyframe: one that is far away may be off by the angle's share more,
        as it is not matched with now.
        """
        if not self._placed:
            return
        here = self._placed[-1]
        to_odom = self.map_T_odom.inverse()
        moves: dict[int, FloatArray] = {}
        for index, placed in enumerate(self._placed):
            there = to_odom.compose(self.graph.pose(index))
            step = placed.localCoordinates(there)
            turned, shifted = np.degrees(np.linalg.norm(step[:3])), np.linalg.norm(step[3:])
            allowed = metres + np.radians(degrees) * here.range(placed)
            if turned > degrees or shifted > allowed:
                moves[index] = there.compose(placed.inverse()).matrix()
                self._placed[index] = there
        if moves:
            self.moved += self._mapper.move_map(moves)

    def counts(self) -> dict[str, int]:
        """Keyframes, loops and how many of them are on; what the closer counted, if it does."""
        graph = self.graph
        counts = {"keyframes": len(graph), "loops": len(graph.loops), "on": sum(graph.active)}
        statistics = getattr(self.closer, "statistics", None)
        if isinstance(statistics, LoopStatistics):
            counts["candidates"] = statistics.candidates
            rejected = sorted(statistics.rejected.items())
            counts |= {f"rejected_{reason}": count for reason, count in rejected}
        return counts

    def ends(self) -> tuple[FloatArray, BoolArray]:
        """(L, 2, 3) where the loops begin and end in the map, metres, and (L,) which are on."""
        positions = self.graph.poses()[:, :3, 3]
        pairs = [(loop.earlier, loop.later) for loop in self.graph.loops]
        indices = np.array(pairs, np.int64).reshape(-1, 2)
        return positions[indices], np.array(self.graph.active, np.bool_)

    def map_points(self) -> tuple[FloatArray, FloatArray]:
        """Edge and plane points of the whole corrected map, (E, 3) and (P, 3) metres."""
        self.follow()
        pose = self.map_T_odom.matrix()
        edges, planes = self._mapper.map_points()
        return transform(pose, edges), transform(pose, planes)
