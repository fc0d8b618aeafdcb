"""Where a live run is in a saved map, for the frames of REP-105.

The live mapper is the odometry: its frame is continuous, and drifts. Each sweep is localised in the
saved map as well, and what leads from one frame to the other may jump.
"""

from __future__ import annotations

import logging
from collections import deque
from pathlib import Path

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.maps import Localizer, SavedMap
from loam_gtsam.registration.odometry import Guess, Odometry, advance
from loam_gtsam.ros.messages import INITIAL_POSE
from loam_gtsam.types import Features, FloatArray, InputError, MapUpdate, Sweep

_log = logging.getLogger(__name__)
_KEPT = 100  # results of the mapper, between two sweeps that were localised


class InMap(Odometry):
    """Localises the sweeps of a live run.

    Parameters
    ----------
    path : of the saved map, or of the folder of its run
    config : of the live run; what belongs to the map is that of the map
    inside : the lidar is surely in the map, see :class:`~loam_gtsam.maps.Localizer`

    Attributes
    ----------
    map_T_odom : from the frame of the live run to that of the map; None until there is a fix

    Raises
    ------
    DatasetError
        If the map cannot be read.
    """

    def __init__(self, path: str | Path, config: Config, *, inside: bool = False) -> None:
        self._saved = SavedMap(path)
        self._localizer = Localizer(self._saved, config, inside=inside, odometry=self)
        self._asked: deque[FloatArray] = deque(maxlen=1)  # of another thread
        self._past: deque[MapUpdate] = deque(maxlen=_KEPT)
        self.map_T_odom: gtsam.Pose3 | None = None

    def look_near(self, position: FloatArray) -> None:
        """Look about a position (2,) in the saved map from the next sweep on; from any thread."""
        self._asked.append(position)

    def add(self, sweep: Sweep, update: MapUpdate) -> MapUpdate:
        """Localise a sweep that the live mapper has registered; its pose in the saved map."""
        if update.status.has_pose:
            self._past.append(update)
        if self._asked:
            try:
                self._localizer.reset(self._asked.pop())
            except InputError as error:
                _log.warning("%s: %s", INITIAL_POSE, error)
        fixed = self._localizer.fixed
        found = self._localizer.process(sweep)
        if found.status.solved and update.status.has_pose:
            self.map_T_odom = found.map_T_lidar.compose(update.map_T_lidar.inverse())
        if fixed != self._localizer.fixed:
            _log.info("%s: %s", self._saved.path, found.message or found.status)
        return found

    def guess(self, features: Features, last: MapUpdate | None) -> Guess:
        """The last pose in the map, moved as the live mapper moved since."""
        if last is None:  # which tracking never asks
            return Guess(gtsam.Pose3(), np.zeros(6))
        now, then = self._at(features.stamp), self._at(last.stamp)
        if now is None or then is None:
            seconds = (features.stamp - last.stamp) * 1e-9
            return Guess(advance(last.map_T_lidar, last.twist, seconds), last.twist)
        motion = then.map_T_lidar.between(now.map_T_lidar)
        return Guess(last.map_T_lidar.compose(motion), now.twist)

    def close(self) -> None:
        """Close the map."""
        self._saved.close()

    def _at(self, stamp: int) -> MapUpdate | None:
        return next((update for update in self._past if update.stamp == stamp), None)
