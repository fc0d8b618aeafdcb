"""Sweeps, as points or as features, and IMU data; :mod:`loam_gtsam.types` hands them on."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from loam_gtsam.errors import (
    InputError,
    are_two_numbers,
    as_one_array,
    as_stamps,
    check_array,
    check_kind,
    is_whole,
)
from loam_gtsam.trajectory import FloatArray, IntArray, checked_pose

MAX_STAMP = 1 << 62
"""Nanoseconds up to which a stamp makes sense: the year 2116, and differences fit 64 bits."""
_COLUMNS = {"times": "floats", "rings": "integers", "prominence": "floats", "sigmas": "floats"}
"""What an edge or a plane has beside its position."""
_FARTHEST = 1e5
"""Metres, of a feature; far beyond any lidar, and within the grid of voxels."""


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One sweep of the sensor, as it was measured (not de-skewed).

    Parameters
    ----------
    points : (N, 3) floats, metres, lidar frame. NaN and infinite rows are allowed.
    stamp : nanoseconds; ``times`` count from here.
    times : (N,) seconds from ``stamp`` at which each point was measured, or None if unknown.
    rings : (N,) integer beam number of each point, or None if unknown. Any consistent order.
    span : (first, last) seconds from ``stamp`` covered by the whole sweep. When None, the
        smallest and largest of ``times`` are used.
    rows : number of rows if the points are a full row-major range image (``rows`` x columns),
        else 0.

    Raises
    ------
    InputError
        If a shape or a dtype is wrong.
    """

    points: NDArray[np.floating]
    stamp: int
    times: NDArray[np.floating] | None = None
    rings: NDArray[np.integer] | None = None
    span: tuple[float, float] | None = None
    rows: int = 0

    def __post_init__(self) -> None:
        for name in ("points", "times", "rings"):
            if isinstance(given := getattr(self, name), (list, tuple)):
                object.__setattr__(self, name, as_one_array(given, f"Scan.{name}"))
        check_array(self.points, "Scan.points", ("N", 3))
        _check_stamp(self)
        for name, numbers in (("times", "floats"), ("rings", "integers")):
            column = getattr(self, name)
            if column is not None:
                check_array(column, f"Scan.{name}", (len(self.points),), numbers)
        if self.span is not None:
            _check_span(self, self.span)
        if not (is_whole(self.rows) and self.rows >= 0):
            raise InputError(f"Scan.rows: expected a number of rows, or 0, got {self.rows!r}")
        if self.rows and len(self.points) % self.rows:
            raise InputError(
                f"Scan.rows: {len(self.points)} points do not divide into {self.rows} rows"
            )


def _check_stamp(sweep: Scan | Features | BadSweep) -> None:
    """InputError unless the stamp makes sense, which becomes an int; any may do for a bad sweep."""
    stamp = sweep.stamp
    bounded = not isinstance(sweep, BadSweep)
    if not is_whole(stamp) or (bounded and abs(int(stamp)) > MAX_STAMP):
        raise InputError(
            f"{type(sweep).__name__}.stamp: expected integer nanoseconds up to 2^62 (the year "
            f"2116), got {stamp!r}; round(seconds * 1e9) makes them of seconds"
        )
    object.__setattr__(sweep, "stamp", int(stamp))


def _check_span(sweep: Scan | Features, span: tuple[float, float]) -> None:
    """InputError unless the span is two numbers, which become floats."""
    if not are_two_numbers(span):
        name = f"{type(sweep).__name__}.span"
        raise InputError(f"{name}: expected (first, last) seconds, got {span!r}")
    object.__setattr__(sweep, "span", tuple(map(float, span)))


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Edge and plane points of one sweep, at the positions they were measured (not de-skewed).

    Attributes
    ----------
    stamp : nanoseconds of the reference time, the time the pose of this frame belongs to.
    edges, planes : (E, 3) and (P, 3) float64, metres, lidar frame at each point's own time.
    edge_times, plane_times : seconds from ``stamp``; all zero if already de-skewed.
    edge_rings, plane_rings : integer beam numbers.
    level_rings : whether beams sweep rings about the lidar's z axis, which edges cross. Those of a
        Livox swing up and down, and a lidar that is mounted askew has others
    sharp, flat : indices of the most pronounced edges and planes, for scan-to-scan odometry.
    span : (first, last) seconds from ``stamp`` covered by the sweep.
    edge_prominence : (E,) metres by which an edge stands out of its ring, scaled so that range
        noise alone gives it the standard deviation of the noise
        (:func:`loam_gtsam.frontend.curvature.prominence`); None if unknown: all edges are real
    edge_sigmas : (E,) metres, standard deviation of the place of an edge along its ring, for beams
        are apart, and pass beside the edge itself; None if unknown: edges are where they were met
    not_finite : points of the sweep that were NaN or infinite
    voxel_sizes : edge lengths in metres of the voxels of which ``edges`` and ``planes`` hold one
        point each (:func:`loam_gtsam.frontend.features.thinned`). None if they hold all points.
    reach : metres; three quarters of the points of the sweep are nearer, which tells whether the
        place is small (``map.small_below``). Infinite if unknown: the place then counts as open.
    ring_elevations : (R,) rad, mean elevations of rings about the lidar's z axis; None if unknown

    Raises
    ------
    InputError
        If a shape or a dtype is wrong, or ``sharp`` or ``flat`` are no rows.
    """

    stamp: int
    edges: FloatArray
    planes: FloatArray
    edge_times: FloatArray
    plane_times: FloatArray
    edge_rings: IntArray
    plane_rings: IntArray
    sharp: IntArray
    flat: IntArray
    span: tuple[float, float] = (0.0, 0.0)
    edge_prominence: FloatArray | None = None
    edge_sigmas: FloatArray | None = None
    level_rings: bool = True
    not_finite: int = 0
    voxel_sizes: tuple[float, float] | None = None
    reach: float = np.inf
    ring_elevations: FloatArray | None = None

    def __post_init__(self) -> None:
        _check_stamp(self)
        _check_span(self, self.span)
        for kind, chosen in {"edge": "sharp", "plane": "flat"}.items():
            points = getattr(self, f"{kind}s")
            check_array(points, f"Features.{kind}s", ("N", 3), "floats")
            for what, numbers in _COLUMNS.items():
                column = getattr(self, f"{kind}_{what}", None)
                if column is not None:
                    check_array(column, f"Features.{kind}_{what}", (len(points),), numbers)
            rows = getattr(self, chosen)
            check_array(rows, f"Features.{chosen}", ("N",), "integers")
            if rows.size and not 0 <= rows.min() <= rows.max() < len(points):
                got = f"got {rows.min()} to {rows.max()} of {len(points)}"
                raise InputError(f"Features.{chosen}: expected rows of {kind}s, {got}")

    @classmethod
    def from_points(
        cls, stamp: int, edges: NDArray[np.floating], planes: NDArray[np.floating]
    ) -> Features:
        """Features, (E, 3) and (P, 3) floats, that are de-skewed already, by another front end.

        Raises
        ------
        InputError
            If a shape, a dtype or the stamp is wrong, or a point is not finite or farther than any
            lidar sees.
        """
        for name, points in {"edges": edges, "planes": planes}.items():
            check_array(points, name, ("N", 3))
            wild = int(np.count_nonzero(~(np.abs(points) < _FARTHEST).all(axis=1)))
            if wild:
                raise InputError(
                    f"{name}: expected metres below {_FARTHEST:g}, got {wild} points of "
                    f"{len(points)} that are NaN, infinite or farther; remove them first"
                )
        edge_numbers, plane_numbers = np.arange(len(edges)), np.arange(len(planes))
        return cls(
            stamp,
            edges.astype(np.float64),
            planes.astype(np.float64),
            edge_times=np.zeros(len(edges)),
            plane_times=np.zeros(len(planes)),
            edge_rings=np.zeros_like(edge_numbers),
            plane_rings=np.zeros_like(plane_numbers),
            sharp=edge_numbers,
            flat=plane_numbers,
        )


@dataclass(frozen=True, slots=True, eq=False)
class FeatureSweep:
    """Features and odometry of one sweep made by another front end (e.g. LOAM's own topics).

    Attributes
    ----------
    features : de-skewed features
    odom_T_lidar : pose of the same moment in that front end's drifting frame
    cloud : (N, 3) de-skewed full-resolution points of the same moment, or None
    """

    features: Features
    odom_T_lidar: gtsam.Pose3
    cloud: NDArray[np.floating] | None = None

    def __post_init__(self) -> None:
        check_kind(self.features, Features, "FeatureSweep.features", "from_points makes them")
        checked_pose(self.odom_T_lidar, "FeatureSweep.odom_T_lidar")
        if self.cloud is not None:
            check_array(self.cloud, "FeatureSweep.cloud", ("N", 3))

    @property
    def stamp(self) -> int:
        """Nanoseconds, of the features."""
        return self.features.stamp


@dataclass(frozen=True, slots=True)
class BadSweep:
    """A sweep its loader could not read; the run goes on with a predicted pose."""

    stamp: int
    message: str

    def __post_init__(self) -> None:
        _check_stamp(self)


Sweep = Scan | FeatureSweep | BadSweep
"""What a data set yields."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """A stretch of IMU data.

    Attributes
    ----------
    stamps : (N,) int64 nanoseconds
    orientation : (N, 4) quaternions x y z w of ``world_R_imu`` (world z up), NaN where unknown, or
        None if the IMU has no attitude output
    gyro : (N, 3) rad/s, imu frame
    acceleration : (N, 3) m/s^2, imu frame, reads +9.8 upwards at rest; zeros, or None, for
        an IMU without an accelerometer

    Raises
    ------
    InputError
        If a shape or a dtype is wrong.
    """

    stamps: IntArray
    orientation: FloatArray | None
    gyro: FloatArray
    acceleration: FloatArray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        stamps = as_stamps(self.stamps, "ImuSamples.stamps")
        object.__setattr__(self, "stamps", stamps)
        if self.acceleration is None:
            object.__setattr__(self, "acceleration", np.zeros((len(stamps), 3)))
        columns = {"orientation": 4, "gyro": 3, "acceleration": 3}
        if self.orientation is None:
            del columns["orientation"]
        for name, width in columns.items():
            column = as_one_array(getattr(self, name), f"ImuSamples.{name}")
            check_array(column, f"ImuSamples.{name}", (len(stamps), width), "numbers")
            object.__setattr__(self, name, column)
