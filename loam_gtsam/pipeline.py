"""From sweeps to a trajectory and a map: :class:`Pipeline` one by one, :func:`run` a data set."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from inspect import signature
from itertools import islice
from typing import Any, TypedDict, Unpack

import gtsam

from loam_gtsam.aiding.gnss import TiedFixes, tie
from loam_gtsam.aiding.imu_summary import ImuSummary, imu_summary
from loam_gtsam.aiding.wheels import aided_odometry, wheels_problem
from loam_gtsam.config import Config, as_config, named_sections, with_implied
from loam_gtsam.datasets.base import Dataset, check_dataset
from loam_gtsam.datasets.decode.aiding import GnssFixes, WheelSamples, aids_of
from loam_gtsam.errors import PartFaults, check_count, check_part, is_own, nearest, own_code
from loam_gtsam.frontend.workers import Extraction, FrontEnd, extract, extract_ahead, timed
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.io.checkpoint import Checkpoint, Progress, checksum
from loam_gtsam.io.rollback import whole
from loam_gtsam.io.run_notes import run_notes
from loam_gtsam.loops.closure import LoopCloser, NoLoops
from loam_gtsam.loops.map_correction import LoopMapping
from loam_gtsam.loops.places import Places
from loam_gtsam.mapper import Mapper
from loam_gtsam.registration.odometry import Odometry, checked_guess, make_odometry
from loam_gtsam.registration.solvers import ScanSolver
from loam_gtsam.registration.solvers.own_factors import ExtraFactors
from loam_gtsam.registration.uncertainty.range_offset import RangeOffset
from loam_gtsam.types import (
    BadSweep,
    Features,
    FeatureSweep,
    FloatArray,
    FrameStatus,
    InputError,
    LoamError,
    MapUpdate,
    PartError,
    Scan,
    Sweep,
    SweepFault,
    Trajectory,
)

OnFrame = Callable[[int, MapUpdate], None]
"""Called after each frame with its number and result."""


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """What a run computed, complete or not.

    Attributes
    ----------
    config : as used, with what the data set implied about the sensor
    updates : one per sweep
    edge_points, plane_points : the whole map, (E, 3) and (P, 3) metres
    map_stats : counters of the edge and the plane map (cubes, points, evictions, ...)
    interrupted : the run was stopped (Ctrl-C) before the data set ended
    error : what ended the run early, if it was to be kept (``keep_partial``)
    imu : what was made of the IMU; None without one
    loops : keyframes and loops; None if none were looked for. With loops, ``trajectory`` and the
        map are corrected, and ``updates`` stay in the drifting frame ``odom``
    pipeline : the pipeline after the last sweep, for :func:`loam_gtsam.maps.map_file.save_map`
    fixes : what became of the fixes of a GNSS receiver; None without ``aiding.gnss``
    """

    config: Config
    updates: tuple[MapUpdate, ...]
    edge_points: FloatArray
    plane_points: FloatArray
    map_stats: Mapping[str, Mapping[str, int]]
    interrupted: bool
    error: Exception | None = None
    imu: ImuSummary | None = None
    loops: LoopMapping | None = None
    pipeline: Pipeline | None = None
    fixes: TiedFixes | None = None

    def __repr__(self) -> str:
        """A line: all that is in it would fill the screen for minutes."""
        statuses = ", ".join(f"{count} {status}" for status, count in self.status_counts.items())
        points = f"{len(self.edge_points)} edge and {len(self.plane_points)} plane points"
        return f"RunResult({len(self.updates)} updates: {statuses or 'none'}; {points})"

    @property
    def trajectory(self) -> Trajectory:
        """One pose per sweep with a valid stamp, corrected by the loops if there are any."""
        return self.odometry if self.loops is None else self.loops.graph.trajectory(self.updates)

    @property
    def odometry(self) -> Trajectory:
        """One pose per sweep with a valid stamp, as the mapper found it, without loops."""
        good = [u for u in self.updates if u.status.has_pose]
        return Trajectory.from_poses([u.stamp for u in good], [u.map_T_lidar for u in good])

    @property
    def times_problem(self) -> str:
        """What is wrong with the times of the points, told by how they move; empty if nothing."""
        return "" if self.pipeline is None else self.pipeline.mapper.point_times.problem

    @property
    def wheels_problem(self) -> str:
        """That the scans contradicted the wheels; empty if they did not, or there are none."""
        return "" if self.pipeline is None else wheels_problem(self.pipeline.odometry)

    @property
    def range_offset(self) -> RangeOffset | None:
        """By how much all ranges look too long; None if nothing was mapped."""
        return None if self.pipeline is None else self.pipeline.mapper.errors.range_offset

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what is wrong or in doubt, as the command line shows them below a run."""
        return run_notes(self)

    @property
    def status_counts(self) -> dict[str, int]:
        """How many frames ended in which status."""
        return dict(Counter(str(u.status) for u in self.updates))

    @property
    def faults(self) -> dict[str, int]:
        """How many sweeps were not used for which :class:`~loam_gtsam.types.SweepFault`."""
        return dict(Counter(str(u.fault) for u in self.updates if u.fault is not None))


_REFUSED = (FrameStatus.BAD_STAMP, FrameStatus.UNUSABLE_SCAN)
"""Statuses of sweeps from which no later sweep is predicted."""


class Parts(TypedDict, total=False):
    """Parts of a user's own; one that is left out or None is the package's own.

    Attributes
    ----------
    solver : finds the pose of a sweep, see
        :class:`~loam_gtsam.registration.solvers.base.ScanSolver`
    features : makes the features of a sweep in place of
        :func:`~loam_gtsam.frontend.features.extract_features`; raises SweepError for a sweep
        without any
    odometry : predicts each sweep, see :class:`~loam_gtsam.registration.odometry.Odometry`
    extra_factors : factors of every sweep, see :class:`~loam_gtsam.PoseContext`
    loop_closer : finds loops, see :class:`~loam_gtsam.loops.closure.LoopCloser`; the package's own
        looks for them only with ``loops.enabled``
    """

    solver: ScanSolver | None
    features: FrontEnd | None
    odometry: Odometry | None
    extra_factors: ExtraFactors | None
    loop_closer: LoopCloser | None


class Pipeline:
    """Feature extraction, odometry guess and mapping, one sweep at a time.

    Parameters
    ----------
    imu : samples must be in it before the sweeps they belong to; None does without
    wheels : wheel odometry, which predicts the sweeps if ``aiding.wheels`` is set
    parts : as of :func:`run`

    Attributes
    ----------
    mapper : registers the sweeps
    odometry : predicts them; None leaves it to the mapper (constant velocity, IMU)
    faults : what is done about exceptions in parts of a user's own
    loops : keyframes and loops; None if none are looked for
    places : where a later drive can recognise the saved map; with ``loops`` its keyframes do that
    fixes : what became of the fixes of a GNSS receiver; None if they were not asked for yet
    """

    def __init__(
        self, config: Config | None = None, *, imu: ImuBuffer | None = None,
        wheels: WheelSamples | None = None, **parts: Unpack[Parts],
    ) -> None:  # fmt: skip
        _check_parts(parts, Pipeline)
        self.config = as_config(config)
        self.faults = PartFaults(self.config.parts.on_error)
        solver, factors = parts.get("solver"), parts.get("extra_factors")
        self.mapper = Mapper(self.config, solver, imu=imu, extra_factors=factors)
        self.config = self.mapper.config
        # By way of the mapper, which gives up a gyro that turns unlike the scans.
        chosen = parts.get("odometry") or aided_odometry(self.config, wheels, self.mapper.imu)
        self.odometry = chosen or make_odometry(self.config.odometry, self.mapper.imu)
        self._wheels = wheels
        self._features = parts.get("features")
        self._last_odom: gtsam.Pose3 | None = None
        self._to_reference = 0  # nanoseconds from the stamp of a sweep to that of its features
        self.places = Places(self.config)
        self.loops: LoopMapping | None = None
        self.fixes: TiedFixes | None = None
        closer = parts.get("loop_closer")
        if closer is None and self.config.aiding.gnss and not self.config.loops.enabled:
            closer = NoLoops()
        if self.config.loops.enabled or closer is not None:
            self.loops = LoopMapping(self.mapper, self.config, closer)

    def reset(self) -> None:
        """Forget map, motion, IMU and loops: the next sweep is the first of a new run."""
        self.mapper.reset()
        if self.odometry is not None:
            self.odometry.reset()
        if self.loops is not None:
            self.loops.reset()
        self.places.reset()
        self.faults.reset()
        self._last_odom, self.fixes, self._to_reference = None, None, 0

    def process(self, sweep: Sweep, extraction: Extraction | None = None) -> MapUpdate:
        """Register one sweep. The status tells what is wrong with it; bad data raises nothing.

        Parameters
        ----------
        extraction : its features, if they were extracted before; they are extracted here if None

        Raises
        ------
        PartError
            If a part of a user's own raises and ``parts.on_error`` is ``stop``; then nothing
            has changed, and the sweep can be tried again.
        """
        if isinstance(sweep, BadSweep):
            return self.mapper.skip(sweep.stamp + self._to_reference, sweep.message)
        if not isinstance(sweep, (Scan, FeatureSweep)):
            raise InputError(
                f"sweep: expected a Scan, got {type(sweep).__name__}; Scan(points=..., stamp=...) "
                "makes one of an array"
            )
        # The mapper itself is whole in any case; this is for what runs after it.
        late = is_own(self.odometry) or (self.loops is not None and self.loops.has_own_parts)
        step = self._whole_step if late else self._step
        try:
            return step(sweep, extraction)
        except LoamError as error:
            self.faults.take(error)
            stamp = sweep.stamp + self._to_reference
            return self.mapper.skip(stamp, str(error), SweepFault.PART_FAILED)

    def _step(self, sweep: Scan | FeatureSweep, extraction: Extraction | None) -> MapUpdate:
        if isinstance(sweep, FeatureSweep):
            return self._process_features(sweep)
        if extraction is None:
            extraction = extract(sweep, self.config, self._features)
        features, last = extraction.features, self.mapper.last
        if features is None:
            stamp = sweep.stamp + self._to_reference
            return self.mapper.skip(stamp, extraction.problem, extraction.fault)
        self._to_reference = features.stamp - sweep.stamp
        started, guess = time.perf_counter(), None
        if self.odometry is not None:
            with self.faults.forgiven(), own_code("odometry", self.odometry):
                guess = checked_guess(self.odometry.guess(features, last))
        guessed = time.perf_counter() - started
        if guess is None:
            update = self.mapper.register(features)
        else:
            # The first sweep is where the mapper puts it.
            pose = None if last is None else guess.map_T_lidar
            update = self.mapper.register(features, pose, guess.twist)
        if self.odometry is not None and update.status not in _REFUSED:
            with self.faults.forgiven(), own_code("odometry", self.odometry):
                self.odometry.remember(features)
        update = self._with_loops(update, features)
        timings = {"features": extraction.seconds, "odometry": guessed}
        return replace(update, timings=timings | dict(update.timings))

    _whole_step = whole(_step)

    def _process_features(self, sweep: FeatureSweep) -> MapUpdate:
        """The guess is the last pose, moved by the increment of the recorded odometry (LOAM)."""
        last, last_odom = self.mapper.last, self._last_odom
        if last is None or last_odom is None:
            update = self.mapper.register(sweep.features)
        else:
            pose = last.map_T_lidar.compose(last_odom.between(sweep.odom_T_lidar))
            update = self.mapper.register(sweep.features, pose)
        if update.status.has_pose:  # then the last pose is that of another
            self._last_odom = sweep.odom_T_lidar
        return self._with_loops(update, sweep.features)

    def _with_loops(self, update: MapUpdate, features: Features) -> MapUpdate:
        """Add the frame to the pose graph or, without loops, to the places of the map."""
        if self.loops is None:
            place = self.places.add(update, self.mapper.registered)
            if place is not None:
                self.mapper.maps.keyframe = place
            return update
        if not update.status.solved:
            return update
        started = time.perf_counter()
        self.loops.add(update, features)
        return replace(update, timings={**update.timings, "loops": time.perf_counter() - started})

    def state(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """What changes from frame to frame, and what does not, for :mod:`loam_gtsam.io.state`."""
        mapper, loops = self.mapper, self.loops
        roots: dict[str, Any] = {"pipeline": self, "mapper": mapper}
        if self.odometry is not None:
            roots["odometry"] = self.odometry
        shared = {"solver": mapper.solver, **named_sections("config", self.config)}
        if self._features is not None:
            shared["features"] = self._features
        if self._wheels is not None:
            shared["wheels"] = self._wheels
        if mapper.extra_factors is not None:
            shared["extra_factors"] = mapper.extra_factors
        if mapper.imu is not None:
            roots["imu"] = mapper.imu
            shared["samples"] = mapper.imu.buffer
        if loops is not None:
            roots |= {"loops": loops, "graph": loops.graph, "closer": loops.closer}
        return roots, shared

    def tie_to_earth(self, updates: Sequence[MapUpdate], fixes: GnssFixes) -> None:
        """Tie the keyframes of a run to the fixes of a receiver, once the run is complete."""
        if self.loops is None:
            return
        up = None if self.mapper.imu is None else self.mapper.imu.map_up
        with self.loops.graph.own_code():
            self.fixes = tie(self.loops.graph, updates, fixes, self.config.aiding, up)

    def map_points(self) -> tuple[FloatArray, FloatArray]:
        """Edge and plane points of the whole map, (E, 3) and (P, 3) metres."""
        return (self.mapper if self.loops is None else self.loops).map_points()

    def result(
        self, updates: Sequence[MapUpdate], *, interrupted: bool = False,
        error: Exception | None = None,
    ) -> RunResult:  # fmt: skip
        """A whole run, from what :meth:`process` said about each of its sweeps."""
        mapper = self.mapper
        edges, planes = self.map_points()
        return RunResult(
            config=self.config,
            updates=tuple(updates),
            edge_points=edges,
            plane_points=planes,
            map_stats={
                name: {item.name: getattr(cubes.stats, item.name) for item in fields(cubes.stats)}
                for name, cubes in (("edges", mapper.maps.edges), ("planes", mapper.maps.planes))
            },
            interrupted=interrupted,
            error=error,
            imu=None if mapper.imu is None else imu_summary(mapper.imu, updates),
            loops=self.loops,
            pipeline=self,
            fixes=self.fixes,
        )


Observer = Callable[[Sweep, MapUpdate, Pipeline], None]
"""Called after each frame with the sweep, its result and the pipeline, to look, not to change."""


def effective_config(config: Config, dataset: Dataset) -> Config:
    """The configuration with what the data set's layout says about the sensor and its IMU.

    A field that differs from its default wins. InputError if ``dataset`` is none.
    """
    check_dataset(dataset)
    return with_implied(config, dataset.sensor)


def imu_buffer(dataset: Dataset, config: Config) -> ImuBuffer | None:
    """The data set's IMU, None if there is none or it is not to be used."""
    samples = dataset.imu if config.imu.coupling != "off" else None
    return None if samples is None else ImuBuffer(config.imu, samples)


def _check_parts(parts: Mapping[str, object], of: Callable[..., object]) -> None:
    """TypeError for a keyword that ``of`` does not have; InputError for a part that is none."""
    for name in parts:
        if of is run and name in ("imu", "gnss", "wheels"):
            raise TypeError(f"{name}: the data set has it, as ArrayDataset(..., {name}=...)")
        if name not in Parts.__annotations__:
            hint = nearest(name, [*Parts.__annotations__, *list(signature(of).parameters)[:-1]])
            raise TypeError(f"unexpected keyword argument {name!r}{hint}")
    check_part(parts.get("features"), "features", "a function", "__call__")
    check_part(parts.get("odometry"), "odometry", "an object", "guess", "remember", "reset")
    check_part(parts.get("loop_closer"), "loop_closer", "an object", "detect")


def run(
    dataset: Dataset, config: Config | None = None, *, max_frames: int | None = None,
    on_frame: OnFrame | None = None, keep_partial: bool = False, observe: Observer | None = None,
    workers: int = 0, checkpoint: Checkpoint | None = None, **parts: Unpack[Parts],
) -> RunResult:  # fmt: skip
    """Map a data set.

    Parameters
    ----------
    dataset : see :mod:`loam_gtsam.datasets`
    max_frames : stop after so many sweeps
    on_frame : called as ``on_frame(number, update)`` after each frame, e.g. to show progress
    keep_partial : if an error ends the run, return what was computed before, with ``error`` set
    observe : called as ``observe(sweep, update, pipeline)`` after each frame, to look, not to
        change; e.g. :func:`loam_gtsam.view.observers.record`, for a bag
    workers : processes that extract features ahead, whose ``timings`` count beside the others. The
        result is the same; a script that asks for any needs ``if __name__ == "__main__":``.
    checkpoint : keeps the state of the run, and may begin with that of one that was stopped;
        ``on_frame`` and ``observe`` are then called for the frames that follow. With parts of your
        own, give the same ones again.
    parts : ``solver``, ``features``, ``odometry``, ``extra_factors``, ``loop_closer`` of your own,
        see :class:`loam_gtsam.pipeline.Parts`; ``features`` is called in this process

    Returns
    -------
    RunResult
        On KeyboardInterrupt, what was computed until then, marked ``interrupted``.

    Raises
    ------
    InputError
        If ``dataset`` is none, or ``max_frames`` no number of sweeps.
    DatasetError
        If the data set cannot be read.
    OutputError
        If the checkpoint is of another run.
    PartError
        If a part of your own raises, an observer included, and ``parts.on_error`` is ``stop``.
    """
    _check_parts(parts, run)
    check_count(max_frames, "max_frames", optional=True)
    check_count(workers, "workers")
    config = effective_config(as_config(config), dataset)
    imu = imu_buffer(dataset, config)
    fixes, wheels = aids_of(dataset, config)
    pipeline = Pipeline(config, imu=imu, wheels=wheels, **parts)
    if parts.get("features") is not None:
        workers = 0
    about = {"data set": dataset.name, "configuration": config.model_dump_json()}
    if checkpoint is not None:
        samples = None if imu is None else dataset.imu, fixes, wheels
        about["checksum of IMU, GNSS and wheels"] = f"{checksum(samples):08x}"
    progress = Progress(checkpoint, about, pipeline.state)
    updates = progress.updates
    interrupted, error = False, None
    source = progress.rest(islice(timed(dataset), max_frames))
    try:
        for sweep, seconds, extraction in extract_ahead(source, config, workers):
            progress.whole = False
            update = pipeline.process(sweep, extraction)
            update = replace(update, timings={"read": seconds} | dict(update.timings))
            progress.add(sweep, update)
            with pipeline.faults.forgiven(), own_code("observe", observe):
                if observe is not None:
                    observe(sweep, update, pipeline)
            with pipeline.faults.forgiven(), own_code("on_frame", on_frame):
                if on_frame is not None:
                    on_frame(len(updates) - 1, update)
            progress.save_if_due()
        if max_frames is not None and len(updates) == max_frames:
            progress.save()  # a longer run can go on from here
    except KeyboardInterrupt:
        interrupted = True
        progress.save()
    except Exception as caught:
        progress.whole |= isinstance(caught, PartError)  # the pipeline is as before the sweep
        progress.save()
        if not (keep_partial and updates):
            raise
        error = caught
    finally:
        progress.end()
    try:
        if fixes is not None:
            pipeline.tie_to_earth(updates, fixes)
    except PartError as caught:
        if not keep_partial:
            raise
        error = error or caught
    return pipeline.result(updates, interrupted=interrupted, error=error)
