"""Loop closures during a run, and the map that follows them.

The mapper stays in its continuous frame ``odom`` (ROS REP-105). Where a loop closure says that
older keyframes lie elsewhere, seen from the newest one, their map points move there.
"""

from __future__ import annotations

from copy import deepcopy

import gtsam
import numpy as np

from loam_gtsam.config import Config, as_config
from loam_gtsam.errors import PartFaults, check_kind, is_own, own_code
from loam_gtsam.geometry import transform
from loam_gtsam.loops.closure import LoopCloser, LoopStatistics, NoLoops, ScanLoopCloser
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.mapper import Mapper
from loam_gtsam.registration.frame_matcher import MapPair
from loam_gtsam.types import BoolArray, Features, FloatArray, MapUpdate


class LoopMapping:
    """A pose graph beside a mapper, whose map it keeps in order.

    Parameters
    ----------
    mapper : whose frames are given to :meth:`add`
    config : the mapper's if None
    closer : a :class:`ScanLoopCloser` if None

    Attributes
    ----------
    points_moved : how many map points were moved so far
    """

    def __init__(
        self, mapper: Mapper, config: Config | None = None, closer: LoopCloser | None = None
    ) -> None:
        self._config = mapper.config if config is None else as_config(config)
        self._mapper = mapper
        self.graph = PoseGraph(self._config)
        self.closer: LoopCloser = closer or ScanLoopCloser(self._config)
        self.points_moved = 0
        self._faults = PartFaults(self._config.parts.on_error)
        # odom_T_lidar of the keyframes, to which their map points are fixed.
        self._placed: dict[int, gtsam.Pose3] = {}

    def __repr__(self) -> str:
        return f"LoopMapping({self.graph}, {self.points_moved} map points moved)"

    def reset(self) -> None:
        """Forget everything, as the mapper's reset does; a ``reset()`` of the closer is called."""
        self.graph.reset()
        if (reset_closer := getattr(self.closer, "reset", None)) is not None:
            reset_closer()
        self._faults.reset()
        self.points_moved = self._mapper.maps.keyframe = 0
        self._placed = {}

    @property
    def has_own_parts(self) -> bool:
        """Whether closer or factors of the graph are a user's own."""
        return is_own(self.closer) or self.graph.has_own_factors

    @property
    def map_T_odom(self) -> gtsam.Pose3:
        """What leads from the mapper's poses and points to the corrected ones."""
        return self.graph.correction

    def add(self, update: MapUpdate, features: Features) -> bool:
        """Add a frame that the mapper has just registered; returns whether a loop was closed.

        Raises PartError if the closer raises, or a factor of a user's own in the graph.
        """
        aid = self._mapper.imu
        self.graph.imu = None if aid is None else aid.trusted_gyro  # which the mapper may give up
        with self.graph.own_code():
            keyframe = self.graph.add(update, features)
        if keyframe is None:
            return False
        self._placed[keyframe.index] = keyframe.odom_T_lidar
        self._mapper.maps.keyframe = keyframe.index
        loop: LoopClosure | None = None
        with self._faults.forgiven(), own_code("loop_closer", self.closer):
            found = self.closer.detect(keyframe, self.graph)
            if found is not None:
                check_kind(found, LoopClosure, "what detect returns", "None if there is no loop")
            loop = found
        with self.graph.own_code():
            is_closed = loop is not None and self.graph.add_loop(loop)
        if is_closed:
            config = self._config.pose_graph
            self.correct_map(config.follow_distance, config.follow_angle_deg)
        # What ties a graph without loops, as a receiver does in the end, ties every visit anew.
        with self.graph.own_code():
            place = None if isinstance(self.closer, NoLoops) else self.graph.visit()
        if place is not None:  # the points to come belong to a keyframe that stays
            self._mapper.maps.keyframe = place
            del self._placed[keyframe.index]
        return is_closed

    def correct_map(self, metres: float = 0.0, degrees: float = 0.0) -> None:
        """Move the map points of keyframes that lie elsewhere, seen from the newest, by more.

        One that is far from it may be off by the angle's share of that distance more, for no sweep
        is matched with its points now.
        """
        there = self._misplaced(metres, degrees)
        if there:
            moves, newest = self._moves(there), self.graph.keyframes[-1].odom_T_lidar
            self.points_moved += self._mapper.maps.move(moves)
            nearest = min(there, key=lambda index: newest.range(self._placed[index]))
            self._mapper.errors.moved(gtsam.Pose3(moves[nearest]))
        for index, pose in there.items():
            self._placed[index] = pose

    def _misplaced(self, metres: float, degrees: float) -> dict[int, gtsam.Pose3]:
        """Where the keyframes belong in ``odom``, of those that lie elsewhere by more."""
        to_odom = self.map_T_odom.inverse()
        found = {}
        newest = [keyframe.odom_T_lidar for keyframe in self.graph.keyframes[-1:]]
        for index, placed in self._placed.items():
            there = to_odom.compose(self.graph.pose(index))
            step = placed.localCoordinates(there)
            turned, shifted = np.degrees(np.linalg.norm(step[:3])), np.linalg.norm(step[3:])
            allowed = metres + np.radians(degrees) * newest[0].range(placed)
            if turned > degrees or shifted > allowed:
                found[index] = there
        return found

    def _moves(self, there: dict[int, gtsam.Pose3]) -> dict[int, FloatArray]:
        return {
            index: pose.compose(self._placed[index].inverse()).matrix()
            for index, pose in there.items()
        }

    def counts(self) -> dict[str, int]:
        """Numbers of keyframes, loop closures and active ones, and what the closer counted."""
        graph = self.graph
        counts = {"keyframes": len(graph), "loops": len(graph.loops), "on": sum(graph.active)}
        counts["forgotten"] = len(graph.forgotten)
        statistics = getattr(self.closer, "statistics", None)
        if isinstance(statistics, LoopStatistics):
            counts["candidates"] = statistics.candidates
            rejected = sorted(statistics.rejected.items())
            counts |= {f"rejected_{reason}": count for reason, count in rejected}
        return counts

    def loop_ends(self) -> tuple[FloatArray, BoolArray]:
        """(L, 2, 3) ends of the loop closures in the map, metres, and (L,) which are active."""
        ends = [(loop.earlier, loop.later) for loop in self.graph.loops]
        positions = [[self.graph.pose(index).translation() for index in pair] for pair in ends]
        return np.reshape(positions, (-1, 2, 3)), np.array(self.graph.active, np.bool_)

    def corrected_maps(self) -> MapPair:
        """A copy of the mapper's maps in which all keyframes are where the graph has them."""
        maps = deepcopy(self._mapper.maps)
        maps.move(self._moves({index: self.graph.pose(index) for index in self._placed}))
        return maps

    def map_points(self) -> tuple[FloatArray, FloatArray]:
        """Edge and plane points of the whole corrected map, (E, 3) and (P, 3) metres.

        All keyframes count where the graph has them; the mapper's own map does not change.
        """
        pose = self.map_T_odom.matrix()
        edges, planes = self._mapper.maps.points(self._moves(self._misplaced(0.0, 0.0)))
        return transform(pose, edges), transform(pose, planes)
