"""Localisation: the poses of a lidar in a saved map, which stays as it is.

A first fix is searched for anywhere in the map; then the mapper tracks the sweeps. A lidar that is
lost is searched for anywhere again. The covariances have the map's own error in them: it is
considered, not estimated (Schmidt, Application of state-space methods to navigation problems,
1966).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Unpack

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from loam_gtsam.config import AidingConfig, Config, ImuConfig, SensorConfig, SolverConfig, as_config
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.errors import PartFaults, SweepFault, check_count, own_code
from loam_gtsam.frontend.workers import Extraction, extract, extract_ahead, timed
from loam_gtsam.geometry import as_vector, checked_pose, symmetric
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.maps.first_fix import PlaceSearch
from loam_gtsam.maps.hypotheses import SWEEPS, Hypotheses, is_alone
from loam_gtsam.maps.map_file import SavedMap, whole, write_map
from loam_gtsam.maps.saved_maps import SavedMaps
from loam_gtsam.pipeline import OnFrame, Parts, Pipeline, effective_config, imu_buffer
from loam_gtsam.registration.odometry import advance
from loam_gtsam.registration.relocalization import RELOCALISED, same
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.types import (
    BadSweep,
    Features,
    FeatureSweep,
    FloatArray,
    FrameStatus,
    InputError,
    LoamError,
    MapUpdate,
    Scan,
    Sweep,
    Trajectory,
    check_kind,
)

_LONGEST = 50
"""Sweeps without a sure pose until it is forgotten how the lidar came there."""
_BEYOND = 1  # cubes that are read on each side of those around the sensor
_AROUND = 10.0
"""Metres around a pose in which the first visit tells the map's error, by its nearest place: voxels
keep the points that were first in them, and a later visit was registered to these."""


class Localizer:
    """Finds sweeps in a saved map, and tracks them there.

    Parameters
    ----------
    saved : the map; must stay open
    config : of the sensor, the solver and so on; what belongs to the map (``map``, and the
        descriptor in ``loops``) is that of the map. That of the map's run if None.
    imu : samples must be in it before the sweeps they belong to; None does without
    extend : add what the map does not have yet, to be saved by :meth:`save`
    inside : the lidar is surely in the map; else it may be in a place that looks like one of those
        in the map, and there is no fix where several of these fit nearly as well
    near : (2,) or (3,) metres, map frame, x, y and z if there are several storeys: the lidar is at
        the first sweep within ``loops.search`` (8 m) of that, at any heading. Then it is surely in
        the map, and what looks the same elsewhere is no rival
    parts : of a user's own, see :class:`~loam_gtsam.pipeline.Parts`, for the tracking

    Attributes
    ----------
    config : as used
    fixed : whether the pose is known
    fixes : number of times that it was found by a search in the whole map

    Raises
    ------
    InputError
        If the map has no places at which it can be recognised, or none about ``near``.
    ConfigError
        If the configured solver has no place for factors of the IMU, or of a user's own.
    """

    def __init__(
        self,
        saved: SavedMap,
        config: Config | None = None,
        *,
        imu: ImuBuffer | None = None,
        extend: bool = False,
        inside: bool = False,
        near: ArrayLike | None = None,
        **parts: Unpack[Parts],
    ) -> None:
        check_kind(saved, SavedMap, "saved", "SavedMap(path) opens one")
        if not saved.places:
            raise InputError(
                f"{saved.path}: the map has no places at which it can be recognised: its run was "
                "too short, or never solved; map more of the place"
            )
        if parts.get("loop_closer") is not None:
            raise InputError(
                "loop_closer: no loops are closed in a map that stays as it is; leave it out, or "
                "map with run(..., loop_closer=...) and merge the maps"
            )
        self.config = config_in(saved, config, extend=extend)
        self._saved, self._parts = saved, parts
        self._extend, self._inside = extend, inside
        self._tracking = Pipeline(self.config, imu=imu, **parts)
        positions = [place.map_T_middle.translation() for place in saved.places]
        self._tree = cKDTree(np.array(positions))
        self.reset(near)

    def reset(self, near: ArrayLike | None = None) -> None:
        """Forget where the lidar is, and what was added to the map; ``near`` as in the class."""
        start = None if near is None else self._about(near)
        self._maps = SavedMaps(self.config, self._saved, keep=self._extend)
        self._places, self._links = list(self._saved.places), list(self._saved.graph.links)
        self._hypotheses: Hypotheses | None = self._new_search(start)  # None while it is known
        self._last: MapUpdate | None = None  # that was solved
        self._seen: MapUpdate | None = None  # the last of some that saw all directions
        self._unsolved = self._sure = 0  # sweeps in a row, and those that saw all directions
        # Sweeps that were tracked since the pose was sure, with the result for each where it was.
        self._recent: list[tuple[Features, MapUpdate | None]] = []
        self.fixes = 0

    def _about(self, near: ArrayLike) -> gtsam.Pose3:
        """A pose at a position, at the height and with the tilt of the nearest place."""
        size = 2 if np.size(near) == 2 else 3
        position = as_vector(near, "near", size)
        away = np.linalg.norm(self._tree.data[:, :size] - position, axis=1)
        most, number = 2.0 * self.config.loops.search, int(away.argmin())
        if away[number] > most:
            raise InputError(
                f"near: expected a position in the frame of {self._saved.path}, within {most:g} m "
                f"of the way of its run, got {position.tolist()}, {away[number]:.0f} m from it"
            )
        place = self._saved.places[number].map_T_middle
        return gtsam.Pose3(place.rotation(), np.array([*position[:2], place.z()]))

    def _new_search(self, start: gtsam.Pose3 | None = None) -> Hypotheses:
        """A search for the lidar in the whole map, which does not grow meanwhile."""
        self._maps.grows = False
        # A fix needs to know which directions are seen, which not every solver tells.
        config = self.config.changed(solver=SolverConfig())
        inside = self._inside or start is not None
        search = PlaceSearch(self._places, self._maps, config, inside=inside)
        return Hypotheses(search, self._maps, config, start)

    @property
    def fixed(self) -> bool:
        """Whether the pose is known."""
        return self._hypotheses is None

    @property
    def faults(self) -> PartFaults:
        """What is done about exceptions in parts of a user's own."""
        return self._tracking.faults

    def process(self, sweep: Sweep, extraction: Extraction | None = None) -> MapUpdate:
        """Localise one sweep; what it contains never raises, see the status of the result.

        The status is ``LOST`` until there is a fix; the pose of such a result means nothing. Only
        results that are solved (:attr:`~loam_gtsam.FrameStatus.solved`) have a covariance.

        Raises
        ------
        DatasetError
            If a cube of the map cannot be read.
        PartError
            If a part of a user's own raises and ``parts.on_error`` is ``stop``.
        """
        if isinstance(sweep, Scan) and extraction is None:
            try:
                extraction = extract(sweep, self.config, self._parts.get("features"))
            except LoamError as error:
                self.faults.take(error)
                extraction = Extraction(None, str(error), 0.0, SweepFault.PART_FAILED)
        features = sweep.features if isinstance(sweep, FeatureSweep) else None
        if extraction is not None:
            features = extraction.features
        if self._hypotheses is None:
            update = self._tracking.process(sweep, extraction)
            if not self._given_up(update):
                if features is not None:
                    self._remember(features, update)
                if self._extend:
                    self._add_places()
                return self._told(update)
            self._hypotheses = self._new_search()
            if sure := [one for _, one in self._recent if one is not None]:
                self._hypotheses.begin([swept for swept, _ in self._recent], sure[-1])
        if features is None:
            problem = sweep.message if isinstance(sweep, BadSweep) else ""
            problem = problem if extraction is None else extraction.problem
            return self._nowhere(sweep.stamp, FrameStatus.UNUSABLE_SCAN, problem)
        near = None if self._last is None else self._last.map_T_lidar
        fix, why = self._hypotheses.add(features, near)
        if fix is None:
            return self._nowhere(features.stamp, FrameStatus.LOST, f"no fix: {why}")
        return self._begin(features, fix)

    def _given_up(self, update: MapUpdate) -> bool:
        """Whether tracking has ended: nothing fits, or another place may be the right one.

        No motion has led to this one, or the scans before it had left so much open that others were
        within reach. One of these may look the same, so the whole map has to be asked.
        """
        self._unsolved = 0 if update.status.solved else self._unsolved + 1
        patience = self.config.relocalization.memory
        if update.message.startswith(RELOCALISED) and self._last is not None:
            last, seconds = self._last, (update.stamp - self._last.stamp) * 1e-9
            if not same(advance(last.map_T_lidar, last.twist, seconds), update.map_T_lidar):
                return True
        is_again_seen = update.status is FrameStatus.OK and not self._extend
        if is_again_seen and self._last is not None and not is_alone(self._last):
            return True
        return update.status is FrameStatus.LOST or self._unsolved >= patience

    def _remember(self, features: Features, update: MapUpdate) -> None:
        """Keep the last sweeps whose poses are sure, and those after them."""
        self._recent.append((features, update if _is_sure(update) else None))
        sure = [number for number, (_, one) in enumerate(self._recent) if one is not None]
        del self._recent[: sure[-SWEEPS] if len(sure) >= SWEEPS else 0]
        if len(self._recent) > _LONGEST:
            self._recent.clear()

    def _begin(self, features: Features, fix: MapUpdate) -> MapUpdate:
        """Track from a fix on."""
        self._maps.grows = self._extend
        self._maps.owners, self._maps.keyframe = [self._nearest(fix.map_T_lidar)[0]], 0
        self._tracking.reset()
        self._tracking.mapper.maps = self._maps
        self._tracking.mapper.register(features, fix.map_T_lidar, fix.twist)
        self._hypotheses, self._recent = None, [(features, fix)]
        self._unsolved, self._sure, self._seen = 0, 0, None
        self.fixes += 1
        again = "" if self.fixes == 1 else " again"
        told = self._told(replace(fix, message=f"found in the map{again}"))
        self._seen = None  # what was seen so far is of another mapper, whose drift is another
        return told

    def _nowhere(self, stamp: int, status: FrameStatus, message: str) -> MapUpdate:
        last = self._last
        pose = gtsam.Pose3() if last is None else last.map_T_lidar
        return MapUpdate(stamp, pose, status, message)

    def _told(self, update: MapUpdate) -> MapUpdate:
        """The update with the covariance of its pose in the frame of the map."""
        if update.uncertainty is None or not update.status.solved:
            return update
        self._last = update
        covariance = update.uncertainty.own
        self._sure = self._sure + 1 if update.status is FrameStatus.OK else 0
        if self._extend:
            covariance = update.covariance  # with the drift since the fix
        elif self._sure >= SWEEPS or self._seen is None:
            self._seen = update
        else:  # what no scan saw since then has drifted
            covariance = relative_covariance(self._seen, update)
        from_map = update.map_T_lidar.inverse().AdjointMap()
        of_map = from_map @ self.map_covariance(update.map_T_lidar) @ from_map.T
        return replace(update, covariance=symmetric(covariance + of_map))

    def _add_places(self) -> None:
        """Take over places of new ground; the error of the map before is in theirs, too."""
        tracked, owners = self._tracking.places, self._maps.owners
        for number in range(len(owners), len(tracked.all)):
            place = tracked.all[number]
            pose = place.map_T_middle
            near, motion = self._nearest(pose)
            new = np.linalg.norm(motion.translation()) >= self.config.pose_graph.keyframe_distance
            owners.append(len(self._places) if new else near)
            if new:
                drift = tracked.links[number - 1].covariance
                self._links.append(LoopClosure(near, owners[-1], motion, drift))
                covariance = place.covariance + self.map_covariance(pose)
                self._places.append(replace(place, covariance=covariance))

    def _nearest(self, pose: gtsam.Pose3) -> tuple[int, gtsam.Pose3]:
        """The nearest place to a pose, with those that were added, and the motion from there."""
        poses = [place.map_T_middle for place in self._places]
        near = min(range(len(poses)), key=lambda number: poses[number].range(pose))
        return near, poses[near].between(pose)

    def save(self, path: str | Path) -> None:
        """Write the map with what was added to it; see :func:`~loam_gtsam.maps.save_map`."""
        saved = self._saved
        graph = replace(saved.graph, places=self._places, links=self._links)
        write_map(path, whole(self._maps), graph, saved.config, saved.frame)

    def map_covariance(self, map_T_lidar: gtsam.Pose3) -> FloatArray:
        """(6, 6) of the saved map's own error at a pose, along its axes, about its origin."""
        position = checked_pose(map_T_lidar, "map_T_lidar").translation()
        near = np.sort(self._tree.query_ball_point(position, _AROUND))
        if not len(near):
            return self._saved.places[int(self._tree.query(position)[1])].covariance
        visit = near[near - np.arange(len(near)) == near[0]]
        away = np.linalg.norm(self._tree.data[visit] - position, axis=1)
        return self._saved.places[int(visit[away.argmin()])].covariance


def _is_sure(update: MapUpdate) -> bool:
    """Whether a scan has seen all directions, and no other place is meant."""
    return update.status is FrameStatus.OK and is_alone(update)


def own_settings(saved: SavedMap) -> Config:
    """The configuration of the run that made a map, for a sensor that may be another one."""
    other = ImuConfig()
    mounted = {"lidar_t_imu": other.lidar_t_imu, "lidar_R_imu_deg": other.lidar_R_imu_deg}
    return saved.config.changed(sensor=SensorConfig(), imu=saved.config.imu.changed(**mounted))


def config_in(saved: SavedMap, config: Config | None, *, extend: bool = False) -> Config:
    """The configuration of a mapper in a saved map, which it may extend."""
    config = saved.config if config is None else as_config(config)
    shape = {name: getattr(saved.config.loops, name) for name in ("rings", "sectors", "reach")}
    window = tuple(n + 2 * _BEYOND for n in saved.config.map.neighbourhood)
    margin = max(saved.config.map.neighbourhood) // 2
    cubes = saved.config.map.changed(window=window, window_margin=margin, archive_dir=None)
    return config.changed(
        map=cubes,
        aiding=AidingConfig(),  # fixes tie a run, not a drive in a map that stays
        loops=config.loops.changed(enabled=False, **shape),
        # No ground is new, unless the map is extended.
        covariance=config.covariance if extend else config.covariance.changed(drift=0.0),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Localisation:
    """What became of a data set in a saved map.

    Attributes
    ----------
    config : as used
    updates : one per sweep
    fixes : number of times that the pose was found by a search in the whole map
    interrupted : stopped (Ctrl-C) before the data set ended
    localizer : as it is after the last sweep
    error : what ended it before its end; None if nothing did
    """

    config: Config
    updates: Sequence[MapUpdate]
    fixes: int
    interrupted: bool
    localizer: Localizer
    error: Exception | None = None

    def __repr__(self) -> str:
        counts = ", ".join(f"{n} {status}" for status, n in self.status_counts.items())
        return f"Localisation({len(self.updates)} updates: {counts}; {self.fixes} fixes)"

    @property
    def status_counts(self) -> dict[str, int]:
        """How many sweeps ended in which status."""
        return dict(Counter(str(update.status) for update in self.updates))

    @property
    def solved(self) -> list[MapUpdate]:
        """The updates whose poses were found in the map."""
        return [update for update in self.updates if update.status.solved]

    @property
    def trajectory(self) -> Trajectory:
        """Their poses in the frame of the map."""
        solved = self.solved
        return Trajectory.from_poses([u.stamp for u in solved], [u.map_T_lidar for u in solved])


def localise(
    dataset: Dataset,
    saved: SavedMap,
    config: Config | None = None,
    *,
    max_frames: int | None = None,
    on_frame: OnFrame | None = None,
    keep_partial: bool = False,
    workers: int = 0,
    extend: bool = False,
    inside: bool = False,
    near: ArrayLike | None = None,
    **parts: Unpack[Parts],
) -> Localisation:
    """Localise a data set in a saved map.

    Parameters
    ----------
    dataset, saved : see :func:`~loam_gtsam.open_dataset`, :class:`SavedMap`
    config : see :class:`Localizer`
    max_frames : stop after so many sweeps
    on_frame, keep_partial : see :func:`~loam_gtsam.run`
    workers : processes that extract the features of the sweeps to come
    extend, inside, near, parts : see :class:`Localizer`

    Returns
    -------
    Localisation
        On KeyboardInterrupt, what was computed until then, marked ``interrupted``.
    """
    check_kind(saved, SavedMap, "saved", "SavedMap(path) opens one")
    check_count(max_frames, "max_frames", optional=True)
    check_count(workers, "workers")
    config = own_settings(saved) if config is None else as_config(config)
    config = effective_config(config, dataset)
    imu = imu_buffer(dataset, config)
    localizer = Localizer(saved, config, imu=imu, extend=extend, inside=inside, near=near, **parts)
    if parts.get("features") is not None:
        workers = 0
    updates: list[MapUpdate] = []
    interrupted, error = False, None
    source = islice(timed(dataset), max_frames)
    try:
        for sweep, seconds, extraction in extract_ahead(source, localizer.config, workers):
            update = localizer.process(sweep, extraction)
            updates.append(replace(update, timings={"read": seconds} | dict(update.timings)))
            with localizer.faults.forgiven(), own_code("on_frame", on_frame):
                if on_frame is not None:
                    on_frame(len(updates) - 1, updates[-1])
    except KeyboardInterrupt:
        interrupted = True
    except Exception as caught:
        if not (keep_partial and updates):
            raise
        error = caught
    return Localisation(localizer.config, updates, localizer.fixes, interrupted, localizer, error)
