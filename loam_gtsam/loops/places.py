"""Places of a run: where a saved map can be recognised, and how wrong it may be there."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from loam_gtsam.config import Config
from loam_gtsam.geometry import nearest_positive, symmetric
from loam_gtsam.loops.keyframes import LoopClosure, leads_to_keyframe, noise_model, surely_placed
from loam_gtsam.loops.scan_context import scan_context
from loam_gtsam.mapper import Registered
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.types import FloatArray, MapUpdate

Descriptor = NDArray[np.float16]
"""(rings, sectors) metres, see :func:`~loam_gtsam.loops.scan_context.scan_context`, to 1 cm."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A place at which a sweep went into the map.

    Attributes
    ----------
    stamp : nanoseconds of the pose of the sweep
    map_T_middle : pose at the middle of the sweep, from which the descriptor is seen
    covariance : (6, 6) of the map's own error here, as a perturbation on the *left*: along the axes
        of the map, about its origin. What the sweep's own error adds to it is left out.
    descriptor : of the features of the sweep
    """

    stamp: int
    map_T_middle: gtsam.Pose3
    covariance: FloatArray
    descriptor: Descriptor

    @property
    def noise(self) -> gtsam.noiseModel.Gaussian:
        """The map's error as that of the pose, along its own axes."""
        here = self.map_T_middle.inverse().AdjointMap()
        return noise_model(symmetric(here @ self.covariance @ here.T))


class Places:
    """Places along a run, as far apart as keyframes are; of ``config``, their parameters are used.

    Beyond the first one and ``pose_graph.visits`` more at one place, none are kept.

    Attributes
    ----------
    all : the places, in the order in which they were visited
    links : the motion to each place but the first, from the one before it; where places in between
        were not kept, from the one there was at the last of them
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forget all places."""
        self.all: list[Place] = []
        self.links: list[LoopClosure] = []
        self._last: tuple[int, MapUpdate, gtsam.Pose3] | None = None
        self._positions = np.empty((0, 3))

    def add(self, update: MapUpdate, registered: Registered | None) -> int | None:
        """Add the place of a sweep, if it was solved, not in doubt, and far from the last place.

        Returns the number of the place at which the lidar has come; None if it has come to none.
        """
        known = surely_placed(update)
        if known is None or registered is None:
            return None
        pose, last = registered.map_T_middle, self._last
        config = self._config.pose_graph
        if last is not None and not leads_to_keyframe(last[2].between(pose), config):
            return None
        away = np.linalg.norm(self._positions - pose.translation(), axis=1)
        there = [
            number
            for number in np.flatnonzero(away < config.keyframe_distance).tolist()
            if not leads_to_keyframe(self.all[number].map_T_middle.between(pose), config)
        ]
        if len(there) > config.visits:
            number = int(min(there, key=away.__getitem__))
        else:
            number = len(self.all)
            self._positions = np.vstack([self._positions, pose.translation()])
            points = np.concatenate([registered.edges, registered.planes])
            descriptor = scan_context(points, self._config.loops).astype(np.float16)
            to_map = update.map_T_lidar.AdjointMap()
            of_map = nearest_positive(to_map @ (update.covariance - known.own) @ to_map.T)
            self.all.append(Place(update.stamp, pose, of_map, descriptor))
            if last is not None:
                self.links.append(self._link(last[0], last[1], number, update))
        self._last = number, update, pose
        return number

    def _link(self, one: int, before: MapUpdate, two: int, update: MapUpdate) -> LoopClosure:
        """The motion between two places, at both of which the lidar was."""
        pose = self.all[two].map_T_middle
        motion = self.all[one].map_T_middle.between(pose)
        to_middle = pose.between(update.map_T_lidar).AdjointMap()
        covariance = to_middle @ relative_covariance(before, update) @ to_middle.T
        return LoopClosure(one, two, motion, covariance)
