"""The smooth path of the simulated sensor, exact at any time."""

from __future__ import annotations

import copy

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.sim.streets import Scene
from loam_gtsam.datasets.sim.ways import distances_along
from loam_gtsam.types import FloatArray

GRAVITY = 9.81
"""m/s^2, along -z of the simulated world."""

_START_UP = 3.0  # seconds over which the platform gathers speed; it is at rest at t = 0
_LATERAL_ACCELERATION = 2.5
"""m/s^2 at which the driver slows down in bends, a comfortable value for a car."""
_BRAKING_LENGTH = 10.0  # metres over which the slowing down is spread
_SPEED_WAVE = (0.1, 60.0)  # relative change of speed along the way, and its wavelength in metres
_SWAY_HZ = ((1.3, 2.1), (0.7, 1.7), (0.9, 1.9), (0.6, 1.1))
"""Frequencies of heave, roll, pitch and yaw sway: typical vehicle body and walking motion."""
_RUN_OUT = 0.5  # seconds of path kept beyond ``Motion.duration`` on an open path
_LEAD = _START_UP + 0.5
"""Seconds from rest to a moving start: at full speed also while an IMU is read before it."""
_STEP = 1e-3  # seconds, for central differences of the analytic path (error below 1e-4 m/s^2)


class Motion:
    """``world_T_lidar`` at any time along the way points of a scene.

    A quintic spline of the nominal distance travelled; heading follows the path, roll and pitch the
    ground, and a sway starts with the motion. It is at rest at ``t = 0``, or ``moving``: the same
    motion, with ``t = 0`` just after it has gathered speed.

    Attributes
    ----------
    duration : seconds to the end of an open path, or once round a closed one
    """

    _lidar_T_moved: FloatArray | None = None

    def __init__(self, scene: Scene, speed: float, moving: bool = False) -> None:
        self._scene, self._speed = scene, speed
        self._lead = _LEAD if moving else 0.0
        way = scene.waypoints
        points = np.vstack([way, way[:1]]) if scene.closed else way
        bounds = "periodic" if scene.closed else "natural"
        chord = distances_along(points)
        rough = CubicSpline(chord, points, bc_type=bounds)
        fine = np.linspace(0.0, chord[-1], max(200, int(chord[-1] / 0.1)))
        length = distances_along(rough(fine))
        velocity, bend = rough(fine, 1), rough(fine, 2)
        curvature = np.abs(velocity[:, 0] * bend[:, 1] - velocity[:, 1] * bend[:, 0])
        curvature /= np.linalg.norm(velocity[:, :2], axis=1) ** 3
        lateral = curvature * speed * speed / _LATERAL_ACCELERATION
        slowness = _smooth((1.0 + lateral**2) ** 0.25, length, scene.closed)
        # Nominal distance: runs at constant speed on a straight, faster than metres in a bend.
        steps = np.diff(length) * 0.5 * (slowness[1:] + slowness[:-1])
        nominal = np.concatenate([[0.0], np.cumsum(steps)])
        self._end = float(nominal[-1])
        knots = np.linspace(0.0, self._end, max(12, int(self._end / scene.bends)))
        samples = rough(np.interp(knots, nominal, fine))
        if scene.closed:
            samples[-1] = samples[0]
        ends = "periodic" if scene.closed else None
        self._path = make_interp_spline(knots, samples, k=5, bc_type=ends)
        self._heading = self._path.derivative()
        times = np.arange(0.0, 2.0 * self._end / speed + _START_UP + self._lead, 0.01)
        # An open path is left before its very end, so that an IMU can look a little further.
        begin = float(self._travelled(np.array([self._lead]))[0])
        goal = begin + self._end if scene.closed else self._end - _RUN_OUT * speed
        self.duration = float(times[np.searchsorted(self._travelled(times), goal)]) - self._lead

    def world_T_lidar(self, times: FloatArray) -> FloatArray:
        """(N, 4, 4) poses at ``times`` (N,) in seconds; at rest before it has begun to move."""
        times = np.asarray(times, dtype=np.float64) + self._lead
        travelled = self._travelled(times)
        if self._scene.closed:
            travelled = travelled % self._end
        x, y, *z = self._path(travelled).T
        along_x, along_y = self._heading(travelled).T[:2]
        norm = np.hypot(along_x, along_y)
        along_x, along_y = along_x / norm, along_y / norm
        heave, roll, pitch, yaw = self._sway(times)
        yaw = yaw + np.arctan2(along_y, along_x)
        poses = np.zeros((len(times), 4, 4))
        if z:
            height = z[0]
        else:
            ground = self._scene.solids.ground
            height = ground.height(x, y) + self._scene.height
            slope_x, slope_y = ground.gradient(x, y)
            # Nose up (negative pitch) uphill; left side up (positive roll) where it rises to the
            # left.
            pitch = pitch - np.arctan(slope_x * along_x + slope_y * along_y)
            roll = roll + np.arctan(slope_y * along_x - slope_x * along_y)
        poses[:, :3, :3] = _rotations(roll, pitch, yaw)
        poses[:, :3, 3] = np.stack([x, y, height + heave], axis=1)
        poses[:, 3, 3] = 1.0
        return poses if self._lidar_T_moved is None else poses @ self._lidar_T_moved

    def seen_from(self, lidar_T_moved: FloatArray) -> Motion:
        """The same motion, of a lidar mounted at another place of the platform, (4, 4)."""
        other = copy.copy(self)
        before = np.eye(4) if self._lidar_T_moved is None else self._lidar_T_moved
        other._lidar_T_moved = before @ lidar_T_moved
        return other

    def inertial(self, times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Poses (N, 4, 4), gyro (N, 3) and specific force (N, 3) of a perfect IMU in the lidar."""
        times = np.asarray(times, dtype=np.float64)
        before, here, after = (self.world_T_lidar(times + h) for h in (-_STEP, 0.0, _STEP))
        turned = np.einsum("nji,njk->nik", before[:, :3, :3], after[:, :3, :3])
        gyro = Rotation.from_matrix(turned).as_rotvec() / (2.0 * _STEP)
        force = (after[:, :3, 3] - 2.0 * here[:, :3, 3] + before[:, :3, 3]) / _STEP**2
        force[:, 2] += GRAVITY
        return here, gyro, np.einsum("nji,nj->ni", here[:, :3, :3], force)

    def _travelled(self, times: FloatArray) -> FloatArray:
        """Nominal distance; its speed rises as 6 x^5 - 15 x^4 + 10 x^3 over the start-up."""
        x = np.clip(times / _START_UP, 0.0, 1.0)
        ramp = _START_UP * x**4 * (x * x - 3.0 * x + 2.5)
        distance = self._speed * (ramp + np.maximum(times - _START_UP, 0.0))
        change, wavelength = _SPEED_WAVE
        wave = 2.0 * np.pi / wavelength
        return np.asarray(distance + change / wave * np.sin(wave * distance))

    def _sway(self, times: FloatArray) -> list[FloatArray]:
        x = np.clip(times / _START_UP, 0.0, 1.0)
        growth = x**3 * (6.0 * x * x - 15.0 * x + 10.0)

        def wave(slow: float, fast: float) -> FloatArray:
            turns = 2.0 * np.pi
            return 0.6 * np.sin(turns * slow * times) + 0.4 * np.sin(turns * fast * times)

        return [
            amplitude * growth * wave(slow, fast)
            for amplitude, (slow, fast) in zip(self._scene.sway, _SWAY_HZ, strict=True)
        ]


def _smooth(values: FloatArray, length: FloatArray, closed: bool) -> FloatArray:
    """Gaussian average along the path (samples are close to evenly spaced)."""
    sigma = 0.5 * _BRAKING_LENGTH / (length[-1] / (len(length) - 1))
    mode = "wrap" if closed else "nearest"
    return np.asarray(gaussian_filter1d(values, min(sigma, len(values) / 10), mode=mode))


def _rotations(roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """(N, 3, 3) matrices Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (np.cos, np.sin))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
