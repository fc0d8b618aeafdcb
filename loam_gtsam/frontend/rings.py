"""Beam numbers of points: from a field, from the order of the points, or from their elevation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from loam_gtsam.types import FloatArray, IntArray

MAX_RINGS = 256
"""Largest number of rings; a field with more distinct values holds no beam numbers."""
ELEVATIONS: dict[str, FloatArray] = {
    # Velodyne VLP-16 user manual, table of laser angles.
    "vlp16": np.linspace(-15.0, 15.0, 16),
    # Velodyne HDL-32E user manual, firing sequence: 4/3 degrees apart, one beam at zero.
    "hdl32": np.linspace(-23.0, 8.0, 32) * 4.0 / 3.0,
    # HDL-64E: 1/3 degree apart in the upper block and 1/2 in the lower, as in A-LOAM.
    "hdl64": np.concatenate((-8.83 - np.arange(31, -1, -1) / 2.0, 2.0 - np.arange(31, -1, -1) / 3)),
}
"""Nominal beam elevations in degrees, ascending."""

_OUSTER_BEAMS = {"os1-16": 16, "os1-32": 32, "os1-64": 64, "os1-128": 128}
"""Ouster calibrates the angles of each unit, so only the number of beams is nominal."""

_BEAM_HEIGHTS = (0.0, 0.03618)
"""Metres of the beams' origin above that of the points: 0, or the z of Ouster's
``lidar_to_sensor_transform`` if the driver reports points in the sensor's own frame."""
_BIN = 0.02
"""Degrees: bin of the histogram; beams in use are at least 0.28 degrees apart (OS1-128)."""
_CORE = 0.25
"""Fraction of the spacing of the beams within which a point counts as on a beam. Elevations that
have nothing to do with the beams lie there half of the time."""
_CORE_SHARE = 0.9
"""Least share of points on the beams for a set of beams to be believed."""
_SMOOTH = np.deg2rad(2.0)
"""Radians by which neighbours on a ring differ in elevation at most, by the median."""
_LEVEL = np.deg2rad(10.0)
"""Radians by which points of a ring differ from its elevation at most, by the median, for it to lie
around the z axis: it is tilted by 14 degrees then, and lines are told from it by 60 degrees."""
_ASKEW = np.deg2rad(5.0)
"""Radians from z beyond which an axis of rings counts: by less, azimuths of beams up to 15 degrees
high are off by 1.3 degrees, and times at 10 Hz by 0.4 ms."""
_SHARP = 0.01
"""Directions scatter so much less along the axis of their rings, squared, than across it."""
_ENOUGH = 4000
"""Points that tell the axis."""
_STRAY = 0.1
"""A peak in the histogram of elevations is a beam if it has this share of the height of the
typical peak (the one the median point belongs to); lower ones are stray returns."""


def beams_of(model: str) -> int | None:
    """Number of beams of a model of a lidar; None if it is not known."""
    if model in ELEVATIONS:
        return len(ELEVATIONS[model])
    return _OUSTER_BEAMS.get(model)


@dataclass(frozen=True, slots=True, eq=False)
class RingAssignment:
    """The beam of each point.

    Attributes
    ----------
    rings : (N,) uint16 beam numbers, 0 to ``count - 1``, in the order of the elevations
    count : number of beams that measured anything
    method : "field", "rows", "file order", "elevation" or "none"
    note : one sentence for the user
    ring_major : whether the points are stored ring after ring
    """

    rings: NDArray[np.uint16]
    count: int
    method: str
    note: str
    ring_major: bool

    @property
    def known(self) -> bool:
        """Whether there are rings: else all points have the number 0, in the order of the scan."""
        return self.method != "none"


def without_rings(count: int, why: str) -> RingAssignment:
    """No rings, for so many points."""
    note = f"no rings ({why}): features are flat patches and posts"
    return RingAssignment(np.zeros(count, np.uint16), 1, "none", note, ring_major=True)


def are_rings(found: RingAssignment, xyz: NDArray[np.float32]) -> bool:
    """Whether the elevation runs smoothly around the fullest ring, as it does in any frame.

    The beams of a Livox are numbered, too, but swing up and down.
    """
    fullest = np.argmax(np.bincount(found.rings))
    x, y, z = xyz[:, found.rings == fullest]
    around = np.argsort(np.arctan2(y, x))
    elevation = np.arctan2(z, np.hypot(x, y))[around]
    return len(around) < 2 or float(np.median(np.abs(np.diff(elevation)))) < _SMOOTH


def are_level(xyz: NDArray[np.float32], ring_starts: IntArray) -> bool:
    """Whether the fullest of rings in a row lies around the z axis, as far as it matters.

    That of a lidar that is mounted askew does not, nor do beams that swing up and down.
    """
    fullest = int(np.argmax(np.diff(ring_starts)))
    x, y, z = xyz[:, ring_starts[fullest] : ring_starts[fullest + 1]]
    elevation = np.arctan2(z, np.hypot(x, y))
    return bool(np.median(np.abs(elevation - np.median(elevation))) < _LEVEL)


def azimuths_about_axis(
    xyz: NDArray[np.float32], rings: NDArray[np.integer], about_z: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(N,) rad, of points (3, N) about the axis of their rings (N,), or ``about_z`` if that is it.

    A beam that turns sees all its points at one angle from the axis: directions scatter least
    along it. Azimuths are those about z after the shortest turn of the axis to z.
    """
    step = max(xyz.shape[1] // _ENOUGH, 1)
    some, numbers = xyz[:, ::step].astype(np.float64), rings[::step]
    directions = some / np.maximum(np.linalg.norm(some, axis=0), 1e-6)
    counts = np.maximum(np.bincount(numbers), 1)
    means = np.stack([np.bincount(numbers, part) / counts for part in directions])
    apart = directions - means[:, numbers]
    scatter, axes = np.linalg.eigh(apart @ apart.T)
    axis = axes[:, 0] * np.copysign(1.0, axes[2, 0])
    if axis[2] >= np.cos(_ASKEW) or scatter[0] >= _SHARP * scatter[1]:
        return about_z
    turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [axis])[0].as_matrix()
    x, y, _ = turn.astype(np.float32) @ xyz
    azimuths: NDArray[np.float32] = np.arctan2(y, x)
    return azimuths


def _assignment(rings: NDArray[np.integer], count: int, method: str, note: str) -> RingAssignment:
    short = rings.astype(np.uint16, copy=False)
    major = bool(np.all(short[1:] >= short[:-1]) or np.all(short[1:] <= short[:-1]))
    return RingAssignment(short, count, method, note, major)


def rings_from_labels(labels: NDArray[np.integer], xyz: NDArray[np.float32]) -> RingAssignment:
    """Number the rings of a ring field by their mean elevation, lowest first.

    Scan-to-scan odometry searches adjacent rings, but the numbers in a field need not follow the
    elevation (those of the HDL-64 do not).
    """
    low, high = int(labels.min()), int(labels.max())
    if high - low < 65536:
        # unsigned labels of 64 bits wrap around, and their differences are right
        lowest = labels.min().astype(np.int64)
        compact = (labels.astype(np.int64) - lowest).astype(np.uint16)
    else:
        compact = np.unique(labels, return_inverse=True)[1].astype(np.int64)
    counts = np.bincount(compact)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        # fmin gives a point at the origin (sensor.min_range 0 admits it) the slope zero.
        slope = np.fmin(np.abs(xyz[2]) / np.hypot(xyz[0], xyz[1]), 1e6) * np.sign(xyz[2])
    mean = np.bincount(compact, weights=slope) / np.maximum(counts, 1)
    mean[counts == 0] = np.inf
    rank = np.argsort(np.argsort(mean, kind="stable"), kind="stable")
    count = int(np.count_nonzero(counts))
    note = f"{count} rings from the ring field (values {low} to {high})"
    return _assignment(rank[compact], count, "field", note)


def rings_from_rows(row_of: NDArray[np.integer]) -> RingAssignment:
    """Rings of a range image; empty rows are left out."""
    rings, count = _without_gaps(row_of)
    note = f"{count} rings from the rows of the range image"
    return _assignment(rings, count, "rows", note)


def _without_gaps(numbers: NDArray[np.integer]) -> tuple[IntArray, int]:
    """The same numbers without those that no point has, and how many there are."""
    filled = np.bincount(numbers) > 0
    rank = np.cumsum(filled) - 1
    return rank[numbers], int(rank[-1]) + 1


def azimuth_steps(azimuth: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N - 1,) radians from each point to the next, -pi to pi."""
    step = np.diff(azimuth)
    step -= np.float32(2.0 * np.pi) * np.rint(step * np.float32(0.5 / np.pi))
    return step


def rings_from_file_order(azimuth: NDArray[np.float32]) -> tuple[RingAssignment | None, str]:
    """Rings of points stored ring after ring: a ring begins where the azimuth jumps back.

    KITTI's raw HDL-64E files carry no ring numbers, and their elevations are too irregular for a
    nominal table, but the azimuth runs once around per ring. ``azimuth`` is (N,) radians, in file
    order. Returns None and one sentence why, if the points are not written ring after ring.
    """
    step = azimuth_steps(azimuth)
    sign = 1.0 if np.count_nonzero(step > 0.0) >= np.count_nonzero(step < 0.0) else -1.0
    forward = float(np.mean(step * np.float32(sign) > 0.0))
    if forward < 0.95:
        return None, f"azimuth does not run one way in file order ({forward:.0%} of steps do)"
    # Rings begin at a quarter turn if the file begins near one, for its first point need not be in
    # the first column; otherwise just before the first point.
    first = float(np.rad2deg(azimuth[0]))
    quarter = 90.0 * round(first / 90.0)
    cut = quarter if abs(first - quarter) < 5.0 else first - sign * 0.5
    turned = azimuth * np.float32(sign) - np.float32(sign * np.deg2rad(cut))
    turned -= np.float32(2.0 * np.pi) * np.floor(turned * np.float32(0.5 / np.pi))
    jumps = np.diff(turned) < -np.deg2rad(20.0)
    rings = np.concatenate(([0], np.cumsum(jumps)))
    count = int(rings[-1]) + 1
    if not 2 <= count <= MAX_RINGS:
        return None, f"azimuth runs around {count} time(s) in file order"
    note = f"{count} rings from the order of the points (azimuth runs around once per ring)"
    return _assignment(rings, count, "file order", note), note


def rings_from_elevation(xyz: NDArray[np.float32], model: str) -> tuple[RingAssignment | None, str]:
    """Rings by elevation, from a nominal table or from the peaks in a histogram of elevations.

    Returns None and one sentence why, if nothing fits. ``sensor.model`` "auto" takes the Velodyne
    table that fits, else the beams that stand out in the histogram.
    """
    distance = np.hypot(xyz[0], xyz[1])
    elevation = np.rad2deg(np.arctan2(xyz[2], distance))
    if model in ELEVATIONS:
        table = ELEVATIONS[model]
        inside = float(np.mean((elevation > table[0] - 1.0) & (elevation < table[-1] + 1.0)))
        if inside < _CORE_SHARE:
            return None, (
                f"only {inside:.0%} of the points lie between the lowest and highest beam of "
                f"{model} ({table[0]:g} to {table[-1]:g} degrees)"
            )
        return _by_table(elevation, model)
    if model == "auto":
        shares = {name: _core_share(elevation, table) for name, table in ELEVATIONS.items()}
        best = max(shares, key=lambda name: shares[name])
        if shares[best] >= _CORE_SHARE:
            return _by_table(elevation, best)
    heights = [
        (_core_share(tilted, beams), height, tilted, beams)
        for height in _BEAM_HEIGHTS
        for tilted in [np.rad2deg(np.arctan2(xyz[2] - np.float32(height), distance))]
        for beams in [_beams_in(tilted)]
    ]
    share, height, tilted, beams = max(heights, key=lambda entry: entry[0])
    limit = _OUSTER_BEAMS.get(model, MAX_RINGS)
    if share < _CORE_SHARE or len(beams) > limit:
        return None, (
            f"no table of {', '.join(ELEVATIONS)} fits, and the elevations show no clear beams "
            f"({share:.0%} of the points near one of {len(beams)}, at most {limit} expected)"
        )
    note = (
        f"{len(beams)} rings from the beams in the elevations "
        f"({beams[0]:.2f} to {beams[-1]:.2f} degrees, origin {1000 * height:.0f} mm up)"
    )
    return _assignment(_nearest(tilted, beams), len(beams), "elevation", note), note


def _by_table(elevation: NDArray[np.float32], model: str) -> tuple[RingAssignment, str]:
    rings, count = _without_gaps(_nearest(elevation, ELEVATIONS[model]))
    note = (
        f"{count} rings from elevation by the table of {model}, "
        f"{_core_share(elevation, ELEVATIONS[model]):.0%} of the points well on a beam"
    )
    return _assignment(rings, count, "elevation", note), note


def _nearest(elevation: NDArray[np.float32], beams: FloatArray) -> NDArray[np.integer]:
    """Index of the nearest of ascending beams."""
    between = (0.5 * (beams[1:] + beams[:-1])).astype(np.float32)
    nearest: NDArray[np.integer] = np.searchsorted(between, elevation)
    return nearest


def _core_share(elevation: NDArray[np.float32], beams: FloatArray) -> float:
    """Share of points within a quarter of the beam spacing from a beam."""
    if len(beams) < 2:
        return 0.0
    sample = elevation[:: max(1, len(elevation) // 8192)]
    gaps = np.diff(beams)
    spacing = np.minimum(np.append(gaps, np.inf), np.concatenate(([np.inf], gaps)))
    nearest = _nearest(sample, beams)
    return float(np.mean(np.abs(sample - beams[nearest]) < _CORE * spacing[nearest]))


def _beams_in(elevation: NDArray[np.float32]) -> FloatArray:
    """Elevations of the peaks of the histogram of elevations, degrees, ascending."""
    low = float(elevation.min()) - 10 * _BIN
    histogram = np.bincount(((elevation - low) / _BIN).astype(np.int64))
    padded = np.pad(histogram.astype(np.float64), 10)
    smooth = np.convolve(padded, np.ones(5), "same")
    highest = np.lib.stride_tricks.sliding_window_view(np.pad(smooth, 8), 17).max(axis=1)
    peaks = np.flatnonzero((smooth == highest) & (smooth > 0.0))
    peaks = peaks[np.diff(peaks, prepend=-100) > 8]  # of a flat top only the first bin
    heights = np.sort(smooth[peaks])
    half = heights[np.searchsorted(np.cumsum(heights), 0.5 * heights.sum())]
    peaks = peaks[smooth[peaks] >= _STRAY * half]
    # The mean of the bins around a peak, because a flat top begins off its centre.
    window = peaks[:, None] + np.arange(-5, 6)
    weight = np.pad(padded, 5)[window + 5]
    centre = (weight * window).sum(axis=1) / weight.sum(axis=1)
    beams: FloatArray = low + (centre - 10 + 0.5) * _BIN
    return beams
