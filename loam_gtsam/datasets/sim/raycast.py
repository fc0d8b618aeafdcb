"""Exact ranges from a moving, spinning sensor to simple solids.

A sweep is C columns of B beams; every column has its own sensor position. The loop runs over the
few solids near the sensor, never over rays: each is tested against the columns that can see it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from loam_gtsam.datasets.sim.ways import Mover
from loam_gtsam.types import BoolArray, FloatArray

_EPSILON = 1e-12
"""Added to ray directions so that none is exactly parallel to a slab (1e-10 m at 100 m)."""
_TOUCH = 1e-7  # metres above the ground that count as on it
_GROUND_STEPS = 100  # most steps of a ray; ten are typical, only rays that skim crests need many


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Height field ``z = level + sum_k a_k sin(u_k x + v_k y + phase_k)``; flat with no waves.

    Attributes
    ----------
    waves : (K, 4) rows of amplitude (m), u, v (rad/m), phase (rad)
    level : metres
    """

    waves: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    level: float = 0.0

    @property
    def max_slope(self) -> float:
        """Bound of the gradient's norm, metres per metre."""
        return float(np.sum(np.abs(self.waves[:, 0]) * np.hypot(*self.waves[:, 1:3].T)))

    @property
    def max_curvature(self) -> float:
        """Bound of the second derivative in any direction, 1/m."""
        return float(np.sum(np.abs(self.waves[:, 0]) * np.sum(self.waves[:, 1:3] ** 2, axis=1)))

    @property
    def top(self) -> float:
        """Bound of the height of the highest crest, metres."""
        return self.level + float(np.abs(self.waves[:, 0]).sum())

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Metres, of the shape of ``x`` and ``y``."""
        z = np.full_like(x, self.level)
        for amplitude, u, v, phase in self.waves:
            z += amplitude * np.sin(u * x + (v * y + phase))
        return z

    def gradient(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Slopes along x and y, metres per metre."""
        along_x, along_y = np.zeros_like(x), np.zeros_like(x)
        for amplitude, u, v, phase in self.waves:
            wave = amplitude * np.cos(u * x + (v * y + phase))
            along_x += u * wave
            along_y += v * wave
        return along_x, along_y


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """Convex things seen from outside, and the ground; gravity-aligned world frame, metres.

    Attributes
    ----------
    boxes : (N, 7) centre x y z, half sizes along its own x y z, yaw (rad)
    cylinders : (N, 5) vertical: x, y, radius, lowest z, highest z. Mantles without caps.
    ellipsoids : (N, 6) centre x y z, semi-axes along world x y z
    foliage : (N,) which ellipsoids are tree crowns, into which a beam penetrates a little
    tubes : (N, 5) endless, level and seen from inside: x y z of a point on the axis, yaw of the
        axis (rad), radius. The sensor must stay in them.
    movers : cylinders and boxes that are somewhere else at every time
    ground : height field; the sensor must stay above it
    """

    boxes: FloatArray = field(default_factory=lambda: np.zeros((0, 7)))
    cylinders: FloatArray = field(default_factory=lambda: np.zeros((0, 5)))
    ellipsoids: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))
    foliage: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))
    ground: Ground = field(default_factory=Ground)
    tubes: FloatArray = field(default_factory=lambda: np.zeros((0, 5)))
    movers: tuple[Mover, ...] = ()


def cast_rays(
    solids: Solids,
    origins: FloatArray,
    directions: FloatArray,
    max_range: float,
    times: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Distance (C, B) along each ray to the first surface or inf, and (C, B) whether it is foliage.

    Parameters
    ----------
    origins : (C, 3) sensor position of each column, metres, world frame; within metres of each
        other and outside all solids
    directions : (3, C, B) unit vectors in the world frame, well away from the vertical. Azimuth
        must run monotonically over the columns, about once round.
    max_range : metres
    times : (C,) seconds at which the columns fire, for what moves
    """
    ranges = np.full(directions.shape[1:], max_range)
    view = _View.of(origins, directions, max_range)
    dx, dy, dz = directions
    horizontal = dx * dx + dy * dy
    for i, part in view.facing_boxes(solids.boxes):
        centre, half, yaw = solids.boxes[i, :3], solids.boxes[i, 3:6], solids.boxes[i, 6]
        near = _box_entry(origins[part] - centre, directions[:, part], half, yaw)
        np.minimum(ranges[part], near, out=ranges[part])
    for i, part in view.facing_discs(solids.cylinders[:, :2], solids.cylinders[:, 2]):
        cx, cy, radius, low, high = solids.cylinders[i]
        offsets, rays = origins[part] - (cx, cy, 0.0), directions[:, part]
        near = _cylinder_entry(offsets, rays, horizontal[part], radius, (low, high))
        np.minimum(ranges[part], near, out=ranges[part])
    if solids.movers:
        moving = _cast_movers(solids.movers, view, origins, directions, times)
        np.minimum(ranges, moving, out=ranges)
    soft = np.zeros(ranges.shape, np.bool_)
    widest = solids.ellipsoids[:, 3:5].max(axis=1, initial=0.0)
    for i, part in view.facing_discs(solids.ellipsoids[:, :2], widest):
        scale = 1.0 / solids.ellipsoids[i, 3:]
        x, y, z = ((origins[part] - solids.ellipsoids[i, :3]) * scale).T[:, :, None]
        ex, ey, ez = dx[part] * scale[0], dy[part] * scale[1], dz[part] * scale[2]
        a, b = ex * ex + ey * ey + ez * ez, x * ex + y * ey + z * ez
        near = _entry(a, b, x * x + y * y + z * z - 1.0)
        closer = near < ranges[part]
        ranges[part][closer] = near[closer]
        soft[part][closer] = solids.foliage[i]
    for cx, cy, cz, yaw, radius in solids.tubes:
        cosine, sine = np.cos(yaw), np.sin(yaw)
        x, y, z = (origins - (cx, cy, cz)).T[:, :, None]
        aside, up = cosine * dy - sine * dx, dz
        y = cosine * y - sine * x
        a, b = aside * aside + up * up + _EPSILON, y * aside + z * up
        c = y * y + z * z - radius * radius
        # c < 0 inside: one root lies ahead.
        np.minimum(ranges, (-b + np.sqrt(b * b - a * c)) / a, out=ranges)
    ground = _cast_ground(solids.ground, origins, directions, ranges)
    soft &= ranges <= ground
    np.minimum(ranges, ground, out=ranges)
    ranges[ranges >= max_range] = np.inf
    return ranges, soft


def _cast_movers(
    movers: Sequence[Mover],
    view: _View,
    origins: FloatArray,
    directions: FloatArray,
    times: FloatArray,
) -> FloatArray:
    """Distances (C, B) to what moves or inf, each column with everything where it is by then."""
    ranges = np.full(directions.shape[1:], np.inf)
    middle = times[len(times) // 2 : len(times) // 2 + 1]
    centres = np.concatenate([mover.places(middle)[0] for mover in movers])
    apart = float(np.abs(times - middle).max())
    reaches = np.array([mover.reach + mover.speed * apart for mover in movers])
    for i, part in view.facing_discs(centres, reaches):
        mover, rays = movers[i], directions[:, part]
        places, yaw = mover.places(times[part])
        offsets = origins[part].copy()
        offsets[:, :2] -= places
        if len(mover.footprint) == 1:
            horizontal = rays[0] * rays[0] + rays[1] * rays[1]
            heights = mover.low, mover.high
            near = _cylinder_entry(offsets, rays, horizontal, mover.footprint[0], heights)
        else:
            offsets[:, 2] -= 0.5 * (mover.low + mover.high)
            half = np.array([*mover.footprint, 0.5 * (mover.high - mover.low)])
            near = _box_entry(offsets, rays, half, yaw[:, None])
        np.minimum(ranges[part], near, out=ranges[part])
    return ranges


def _box_entry(
    offsets: FloatArray, rays: FloatArray, half: FloatArray, yaw: float | FloatArray
) -> FloatArray:
    """Distances (P, B) to a box or inf, from (P, 3) sensor positions relative to its centre."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    x, y, z = offsets.T[:, :, None]
    along = cosine * rays[0] + (sine * rays[1] + _EPSILON)
    across = cosine * rays[1] - (sine * rays[0] + _EPSILON)
    near, far = _slab(cosine * x + sine * y, along, half[0])
    for other in (
        _slab(cosine * y - sine * x, across, half[1]),
        _slab(z, rays[2] + _EPSILON, half[2]),
    ):
        np.maximum(near, other[0], out=near)
        np.minimum(far, other[1], out=far)
    near[(near > far) | (near <= 0.0)] = np.inf
    return near


def _cylinder_entry(
    offsets: FloatArray,
    rays: FloatArray,
    horizontal: FloatArray,
    radius: float,
    heights: tuple[float, float],
) -> FloatArray:
    """Distances (P, B) to a mantle or inf, from (P, 3) sensor positions relative to its axis."""
    x, y, z = offsets.T[:, :, None]
    c = x * x + y * y - radius * radius
    near = _entry(horizontal, x * rays[0] + y * rays[1], c)
    height = z + near * rays[2]
    near[(height < heights[0]) | (height > heights[1])] = np.inf
    return near


def _slab(offset: FloatArray, direction: FloatArray, half: float) -> tuple[FloatArray, FloatArray]:
    """Distances at which rays enter and leave ``|coordinate| < half``."""
    inverse = 1.0 / direction
    middle = -offset * inverse
    reach = half * np.abs(inverse)
    return middle - reach, middle + reach


def _entry(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Smaller root of ``a t^2 + 2 b t + c`` if positive, else inf."""
    discriminant = b * b - a * c
    with np.errstate(invalid="ignore"):
        near: FloatArray = (-b - np.sqrt(discriminant)) / a
    near[~(near > 0.0)] = np.inf
    return near


def _cast_ground(
    ground: Ground, origins: FloatArray, directions: FloatArray, limits: FloatArray
) -> FloatArray:
    """Distance to a height field by steps that cannot overshoot, so none misses the first crest."""
    # The second derivative of the gap g above the ground along a ray is at most M, hence
    # g(t + s) >= g + g' s - M s^2 / 2: the positive root in s of the right side is a safe step,
    # and close to the surface it is Newton's.
    dx, dy, dz = directions.reshape(3, -1)
    ranges = np.full(dx.shape, np.inf)
    active = np.flatnonzero(dz < ground.max_slope)
    x0, y0, z0 = np.repeat(origins, directions.shape[2], axis=0).T
    rays = np.stack([x0, y0, z0, dx, dy, dz, limits.ravel()])[:, active]
    distance = np.zeros(len(active))
    curvature, top = ground.max_curvature, ground.top
    for _ in range(_GROUND_STEPS):
        x, y, z, dx, dy, dz, limit = rays
        x, y, z = x + distance * dx, y + distance * dy, z + distance * dz
        gap = z - ground.height(x, y)
        near = gap < _TOUCH
        ranges[active[near]] = distance[near]
        slope_x, slope_y = ground.gradient(x, y)
        change = dz - slope_x * dx - slope_y * dy
        rate = np.sqrt(change * change + 2.0 * curvature * np.maximum(gap, 0.0)) - change
        distance = distance + 2.0 * gap / np.maximum(rate, _EPSILON)
        keep = ~near & (distance < limit) & ((dz < 0.0) | (z < top))
        rays, active, distance = rays[:, keep], active[keep], distance[keep]
        if len(active) == 0:
            break
    return ranges.reshape(directions.shape[1:])


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """Which columns can see what, from the sweep's middle; grown by how far the sensor strays."""

    middle: FloatArray
    stray: float
    azimuths: FloatArray
    """(C,) increasing."""
    sense: float
    """+1 if the sensor spins counter-clockwise, -1 if clockwise."""
    spread: float
    """Largest azimuth difference between a beam and its column, from the sensor's tilt."""
    max_range: float

    @classmethod
    def of(cls, origins: FloatArray, directions: FloatArray, max_range: float) -> _View:
        azimuth = np.arctan2(directions[1], directions[0])
        centre = np.unwrap(azimuth[:, azimuth.shape[1] // 2])
        away = np.abs(azimuth - centre[:, None]) % (2.0 * np.pi)
        sense = 1.0 if centre[-1] > centre[0] else -1.0
        middle = origins[len(origins) // 2, :2]
        stray = float(np.linalg.norm(origins[:, :2] - middle, axis=1).max())
        spread = float(np.minimum(away, 2.0 * np.pi - away).max()) + 1e-6
        return cls(middle, stray, sense * centre, sense, spread, max_range)

    def facing_boxes(self, boxes: FloatArray) -> Iterator[tuple[int, slice]]:
        """(index, columns) of the boxes in reach; a box may come twice."""
        cosine, sine = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
        offset = boxes[:, :2] - self.middle
        half = boxes[:, 3:5] + self.stray
        x, y = offset.T
        local = np.stack([cosine * x + sine * y, cosine * y - sine * x], axis=1)
        distance = np.linalg.norm(np.maximum(np.abs(local) - half, 0.0), axis=1)
        signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
        corners = local[:, None, :] + signs * half[:, None, :]
        middle = np.arctan2(local[:, 1], local[:, 0])
        angles = np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None]
        angles = (angles + np.pi) % (2.0 * np.pi) - np.pi
        low, high = angles.min(axis=1), angles.max(axis=1)
        around = distance <= 0.0
        low[around], high[around] = -np.pi, np.pi
        middle = middle + boxes[:, 6]
        return self._columns(middle + low, middle + high, distance)

    def facing_discs(self, centres: FloatArray, radii: FloatArray) -> Iterator[tuple[int, slice]]:
        """(index, columns) of the upright round things in reach."""
        offset = centres - self.middle
        distance = np.linalg.norm(offset, axis=1)
        radii = radii + self.stray
        seen = np.arcsin(radii / np.maximum(distance, radii + 1e-9))
        half = np.where(distance > radii, seen, np.pi)
        middle = np.arctan2(offset[:, 1], offset[:, 0])
        return self._columns(middle - half, middle + half, distance - radii)

    def _columns(
        self, low: FloatArray, high: FloatArray, distance: FloatArray
    ) -> Iterator[tuple[int, slice]]:
        near = np.flatnonzero(distance < self.max_range)
        if self.sense < 0.0:
            low, high = -high, -low
        turn = 2.0 * np.pi
        low = low[near] - self.spread
        high = np.minimum(high[near] + self.spread, low + turn)
        # Bring each interval to its first lap that reaches the sweep; a sweep is about one lap
        # (more or less as the platform turns), so it can meet an interval in at most three.
        laps = np.ceil((self.azimuths[0] - high) / turn)
        for lap in (laps, laps + 1.0, laps + 2.0):
            begin = np.searchsorted(self.azimuths, low + lap * turn, side="left")
            end = np.searchsorted(self.azimuths, high + lap * turn, side="right")
            for k in np.flatnonzero(end > begin):
                yield int(near[k]), slice(int(begin[k]), int(end[k]))
