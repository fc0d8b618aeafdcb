"""A built-in world with exact truth: several places, a spinning lidar that moves, an IMU.

Every beam is cast from the exact pose at its own time: sweeps carry real motion distortion.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from loam_gtsam.datasets.base import DatasetInfo, Loader
from loam_gtsam.datasets.sim.inertial import IMUS, Axes, ImuErrors
from loam_gtsam.datasets.sim.motion import Motion
from loam_gtsam.datasets.sim.patterns import PATTERNS, fired, unit_vectors
from loam_gtsam.datasets.sim.raycast import Ground, Solids, cast_rays
from loam_gtsam.datasets.sim.scenes import BUILDERS
from loam_gtsam.datasets.sim.streets import Scene, build_avenue
from loam_gtsam.errors import is_number, nearest
from loam_gtsam.geometry import as_stamps, inverse_pose
from loam_gtsam.types import (
    ConfigError,
    FloatArray,
    ImuSamples,
    InputError,
    IntArray,
    Scan,
    Trajectory,
)

__all__ = ["SCENES", "SENSORS", "Ground", "Scene", "SimulatedWorld", "Solids", "build_avenue"]

SCENES: tuple[str, ...] = tuple(BUILDERS)
SENSORS: dict[str, tuple[FloatArray, int]] = {
    "vlp16": (np.linspace(-15.0, 15.0, 16), 1800),
    "hdl32": (np.linspace(-30.67, 10.67, 32), 1800),
    # Two blocks of lasers: 1/2 degree apart below, 1/3 above.
    "hdl64": (np.concatenate([np.linspace(-24.33, -8.83, 32), np.linspace(-8.33, 2.0, 32)]), 2000),
    "os1-16": (np.linspace(-22.5, 22.5, 16), 1024),
    "os1-32": (np.linspace(-22.5, 22.5, 32), 1024),
    "os1-64": (np.linspace(-22.5, 22.5, 64), 1024),
    "os1-128": (np.linspace(-22.5, 22.5, 128), 1024),
}
"""Elevations in degrees from the lowest beam up, and columns per sweep at 10 Hz (data sheets)."""
STARTS = "rest", "moving"

_EPOCH = 1_700_000_000_000_000_000
"""Nanoseconds of the first sweep: as large as real stamps are, which floats cannot hold."""
_SPIN = {"rings": "field", "times": "field", "spin": "clockwise", "start_azimuth_deg": 180.0}
"""Settings that all sensors have in common."""
_MIN_RANGE = 0.5  # metres
_IMU_PERIOD = 5_000_000  # nanoseconds: 200 Hz
_IMU_MARGIN = 200_000_000  # nanoseconds of IMU data before the first and after the last sweep


class SimulatedWorld(Loader):
    """A data set made on the fly, the same for the same arguments on every run.

    The sensor spins clockwise from straight behind, and all beams of a column fire together; or it
    sweeps no rings, as a Livox. Points come in firing order. It gathers speed within three seconds.
    The IMU has the lidar's axes; where it sits is in ``sensor``.

    Parameters
    ----------
    scene : one of :data:`SCENES`, or a :class:`Scene` of your own
    sensor : one of :data:`SENSORS`, or of :data:`~loam_gtsam.datasets.sim.patterns.PATTERNS`
    frames : sweeps; None is the scene's own number: once round and two seconds more for
        ``street_loop``, to the end for the corridors and the slopes. Closed paths are driven
        round and round, open ones have an end.
    seed : of the place and of all noise
    range_noise : standard deviation along the beam, metres
    dropout : share of returns that are lost
    foliage_noise : mean depth by which a beam enters a tree crown (exponential), metres
    rate : sweeps per second
    speed : m/s on a straight, less in bends; None is the scene's own
    columns : firings per sweep, points if there are no rings; None is the sensor's own
    max_range : metres
    start : ``rest``, or ``moving``: the same way, its first sweep taken at full speed
    imu : ``white``, at the lidar's origin with white noise and constant biases; or ``mems``, beside
        it, with an attitude wrong by 0.4 degrees per axis that changes over half a minute, and
        biases of 0.3 deg/s and 0.05 m/s^2; or ``six_axis``, which is that one without an attitude
    imu_noise : orientation, white, rad per axis; this and the next are the IMU's own if None
    gyro_noise, gyro_bias : rad/s per axis, white and constant
    acceleration_noise, acceleration_bias : m/s^2 per axis, white and constant

    Attributes
    ----------
    scene : the place
    world_T_start : (4, 4) pose of the first sweep in the gravity-aligned world (z up)

    Raises
    ------
    ConfigError
        If a name is unknown, a number out of range, or an open path too short for ``frames``.

    Examples
    --------
    >>> world = SimulatedWorld("room", frames=3, columns=360)
    >>> [scan.points.shape[1] for scan in world]
    [3, 3, 3]
    """

    def __init__(
        self,
        scene: str | Scene = "street_loop",
        *,
        sensor: str = "vlp16",
        frames: int | None = None,
        seed: int = 0,
        range_noise: float = 0.02,
        dropout: float = 0.02,
        foliage_noise: float = 0.15,
        rate: float = 10.0,
        speed: float | None = None,
        columns: int | None = None,
        max_range: float = 100.0,
        start: str = "rest",
        imu: str = "white",
        imu_noise: float | None = None,
        gyro_noise: float | None = None,
        gyro_bias: Axes | None = None,
        acceleration_noise: float | None = None,
        acceleration_bias: Axes | None = None,
    ) -> None:
        if not isinstance(scene, Scene):
            _one_of("scene", scene, SCENES)
        _one_of("sensor", sensor, SENSORS | PATTERNS)
        _one_of("start", start, STARTS)
        _one_of("imu", imu, IMUS)
        _whole_at_least(0, seed=seed)
        _whole_at_least(1, **_given(frames=frames))
        _whole_at_least(8, **_given(columns=columns))
        self.scene = BUILDERS[scene](seed) if isinstance(scene, str) else scene
        self._lidar, self._rings = sensor, sensor in SENSORS
        _, usual = SENSORS[sensor] if self._rings else PATTERNS[sensor]
        self._columns = usual if columns is None else columns
        speed = self.scene.speed if speed is None else speed
        noises = {"gyro_noise": gyro_noise, "acceleration_noise": acceleration_noise}
        _at_least(0.0, range_noise=range_noise, foliage_noise=foliage_noise)
        _at_least(0.0, **_given(imu_noise=imu_noise, **noises))
        _at_least(0.1, rate=rate)
        _at_least(0.01, speed=speed)
        _at_least(_MIN_RANGE, max_range=max_range)
        if not (is_number(dropout) and 0.0 <= dropout < 1.0):
            raise ConfigError(f"dropout: expected a share in [0, 1), got {dropout!r}")
        self._seed, self._rate, self._max_range = seed, float(rate), float(max_range)
        self._range_noise, self._dropout, self._foliage = range_noise, dropout, foliage_noise
        self._imu_kind = imu
        biases = {"gyro_bias": gyro_bias, "acceleration_bias": acceleration_bias}
        given = {"attitude_noise": imu_noise} | noises | biases
        self._imu_errors = ImuErrors.of(imu, seed, given)
        self._motion = Motion(self.scene, float(speed), start == "moving")
        self._frames = self._count(frames)
        self.name = f"{self.scene.name} {sensor}"
        spins = _SPIN | {"model": sensor} if self._rings else {"rings": "none"}
        self.sensor: Mapping[str, Any] = spins | {"period": 1.0 / rate}
        if any(self._imu_errors.lever):
            self.sensor = self.sensor | {"imu.lidar_t_imu": self._imu_errors.lever}
        self.world_T_start: FloatArray = self._motion.world_T_lidar(np.zeros(1))[0]

    def __len__(self) -> int:
        return self._frames

    def __iter__(self) -> Iterator[Scan]:
        return (self.sweep(i) for i in range(self._frames))

    def __getitem__(self, i: int) -> Scan:
        return self.sweep(i + self._frames if i < 0 else i)

    def sweep(self, i: int) -> Scan:
        """Sweep ``i``, the same whether or not others were made: processes can share the work."""
        if not 0 <= i < self._frames:
            raise IndexError(f"sweep {i}: this world has {self._frames} sweeps")
        stamp = self._stamp(i)
        since = (stamp - _EPOCH) * 1e-9
        if self._rings:
            beams, offsets = self._turn
        else:
            beams, offsets = fired(self._lidar, self._columns, since, 1.0 / self._rate)
        times = since + offsets
        world_T_lidar = self._motion.world_T_lidar(times)
        directions = np.einsum("cij,jcb->icb", world_T_lidar[:, :3, :3], beams)
        origins = world_T_lidar[:, :3, 3]
        ranges, soft = cast_rays(self.scene.solids, origins, directions, self._max_range, times)
        rng = np.random.default_rng([self._seed, i])
        lost = rng.random(ranges.shape) < self._dropout
        ranges += self._range_noise * rng.standard_normal(ranges.shape)
        ranges[soft] += self._foliage * rng.standard_exponential(int(soft.sum()))
        seen = np.isfinite(ranges) & ~lost & (ranges > _MIN_RANGE)
        column, ring = np.nonzero(seen)
        points = np.ascontiguousarray((beams[:, seen] * ranges[seen]).T, dtype=np.float32)
        times, rings, span = offsets[column], ring.astype(np.int32), (0.0, 1.0 / self._rate)
        if not self._rings:
            order = np.argsort(times, kind="stable")
            return Scan(points[order], stamp, times=times[order], span=span)
        return Scan(points, stamp, times=times, rings=rings, span=span)

    def seen_from(self, lidar_T_moved: FloatArray) -> SimulatedWorld:
        """The same drive of a lidar at another place (4, 4); poses count from this one's start."""
        other = copy.copy(self)
        for cached in ("truth", "imu"):
            other.__dict__.pop(cached, None)
        other._motion = self._motion.seen_from(lidar_T_moved)
        return other

    @property
    def stamps(self) -> IntArray:
        """(N,) nanoseconds of the sweeps."""
        return np.array([self._stamp(i) for i in range(self._frames)], np.int64)

    @cached_property
    def truth(self) -> Trajectory:
        """Exact poses at the start of every sweep; the first is the identity."""
        return self.truth_at(self.stamps)

    def truth_at(self, stamps: IntArray) -> Trajectory:
        """Exact poses at any ``stamps`` (N,) in nanoseconds, relative to the first sweep's.

        InputError if the stamps are no row of integers, or later than the end of an open path.
        """
        stamps = as_stamps(stamps, "stamps")
        end = _EPOCH + int(self._motion.duration * 1e9) + _IMU_MARGIN
        if not self.scene.closed and np.any(stamps > end):
            name = self.scene.name
            raise InputError(f"stamps: the path of {name!r} ends at {end}, got {stamps.max()}")
        poses = inverse_pose(self.world_T_start) @ self._motion.world_T_lidar(_seconds(stamps))
        if len(stamps) and stamps[0] == _EPOCH and np.allclose(poses[0], np.eye(4)):
            poses[0] = np.eye(4)  # not only up to rounding
        return Trajectory(stamps=stamps, map_T_lidar=poses)

    @cached_property
    def imu(self) -> ImuSamples:
        """200 Hz, from 0.2 s before the first sweep to 0.2 s after the last."""
        last = self._stamp(self._frames) + _IMU_MARGIN
        stamps = np.arange(_EPOCH - _IMU_MARGIN, last + 1, _IMU_PERIOD, dtype=np.int64)
        return self._imu_errors.samples(self._motion, stamps, _seconds(stamps), self._seed)

    def info(self) -> DatasetInfo:
        """Scene, sensor, frames and length of the way; reads nothing."""
        fires = f"{self._columns} points, no rings"
        if self._rings:
            fires = f"{len(SENSORS[self._lidar][0])} beams x {self._columns} columns, clockwise"
        within = math.hypot(self._imu_errors.attitude_noise, self._imu_errors.attitude_drift)
        facts = {
            "scene": self.scene.name,
            "sensor": f"{self._lidar}: {fires}",
            "frames": f"{self._frames} at {self._rate:g} Hz",
            "path": f"{self.truth.path_length:.1f} m, {'closed' if self.scene.closed else 'open'}",
            "noise": f"{self._range_noise:g} m, {100.0 * self._dropout:g} % lost",
            "times": "per point, seconds from the start of the sweep",
            "imu": f"200 Hz, {self._imu_kind}, orientation within {within:.3g} rad",
            "truth": "exact, at the start of each sweep",
            "seed": str(self._seed),
        }
        return DatasetInfo(kind="simulated world", path=self.scene.name, facts=facts)

    @cached_property
    def _turn(self) -> tuple[FloatArray, FloatArray]:
        """Beams (3, columns, B) of a lidar that spins, clockwise from straight behind; seconds."""
        turns = np.arange(self._columns) / self._columns
        elevations = np.deg2rad(SENSORS[self._lidar][0])
        azimuths = np.pi - 2.0 * np.pi * turns[:, None]
        return unit_vectors(azimuths, elevations[None, :]), turns / self._rate

    def _stamp(self, i: int) -> int:
        return _EPOCH + round(i * 1e9 / self._rate)

    def _count(self, frames: int | None) -> int:
        available = math.floor(self._motion.duration * self._rate)
        # A closed path is driven a little past its start, for the loop to be seen to close.
        once = available + self.scene.closed * round(2.0 * self._rate)
        count = frames or self.scene.frames or once
        if not self.scene.closed and count > available:
            ends = f"ends after {available} sweeps at this speed and rate"
            text = f"{ends}, got {count}; ask for fewer or lower the speed"
            raise ConfigError(f"frames: the path of {self.scene.name!r} {text}")
        return count


def _seconds(stamps: IntArray) -> FloatArray:
    """Since the first sweep; the difference is taken in integers."""
    return (stamps - _EPOCH).astype(np.float64) * 1e-9


def _one_of(name: str, value: str, names: Collection[str]) -> None:
    if not isinstance(value, str) or value not in names:
        near = nearest(value, names, listing=False)
        raise ConfigError(f"{name}: expected one of {', '.join(names)}; got {value!r}{near}")


def _given(**values: Any) -> dict[str, Any]:
    """What is not None."""
    return {name: value for name, value in values.items() if value is not None}


def _whole_at_least(least: int, **values: int) -> None:
    for name, value in values.items():
        if not isinstance(value, (int, np.integer)):
            raise ConfigError(f"{name}: expected a whole number, got {value!r}")
    _at_least(least, **values)


def _at_least(least: float, **values: float) -> None:
    for name, value in values.items():
        if not (is_number(value) and least <= value < math.inf):
            raise ConfigError(f"{name}: expected at least {least:g}, got {value!r}")
