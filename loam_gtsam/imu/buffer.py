"""The IMU buffer: samples in any order go in, orientation and rotation at any time come out.

Everything that leaves the buffer is in lidar axes: the configured ``lidar_R_imu_deg`` is applied
when samples enter. Stamps are subtracted as integers before they become seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.imu.at_rest import REST_SAMPLES, RestWindow, find_rest, rest_at_start
from loam_gtsam.imu.attitude_filter import GravityFilter
from loam_gtsam.imu.quaternions import (
    as_rot3,
    exponential,
    from_rot3,
    inverse,
    logarithm,
    quaternion_product,
    rotation_steps,
    running_product,
)
from loam_gtsam.types import MAX_STAMP, FloatArray, ImuSamples, InputError, IntArray

REST_AHEAD = 0.1
"""Seconds after the asked stamp that still count to its still window: one sweep."""
FROZEN_TURN = 0.2
"""rad/s; an orientation that never changes while the gyro says more than this is a placeholder."""
TILT_LIMIT = np.deg2rad(5.0)
"""rad between up by the orientation and up by the accelerometer at rest, from which on one of them
is called wrong: an accelerometer bias of 0.85 m/s^2, ten times that of a consumer MEMS."""
EXTRINSIC_LIMIT = np.deg2rad(5.0)
"""rad from which on a configured rotation is called wrong."""
EXTRINSIC_SIGMA = np.deg2rad(1.5)
"""rad, largest standard deviation of the better rotation about any axis for it to be believed."""
EXTRINSIC_FRAMES = 20
"""Pairs of frames below which nothing is said."""
WRAP = 3.0
"""rad, below pi: rotation vectors are not interpolated across a half turn."""

_FINE = 1e-3
"""Seconds between the nodes of ``turn``: a linear interpolation is then off by 4e-7 rad at
3 rad/s^2."""
_ABSURD = 1e6
"""rad/s and m/s^2 that no IMU measures, and a length that no quaternion has."""
_UNIT = 1e-3
"""Deviation of a quaternion's length from one that is still rounding (float32 has 1e-7)."""


@dataclass(frozen=True, slots=True)
class ImuReport:
    """What came in and what was put right.

    Attributes
    ----------
    samples : in the buffer
    duplicates : dropped because of their stamp; the first to come is kept
    out_of_order : older than one that came before them; sorted in
    not_finite : dropped because of NaN, infinity or an absurd value in stamp, gyro or acceleration
    unnormalised : quaternions brought to unit length
    no_orientation : samples without a quaternion, or with a zero, NaN or absurd one
    gaps : between neighbours, longer than ``max_gap``
    rate : median, Hz; 0 if unknown
    orientation : from the quaternions ("ahrs"), from gyro and acceleration ("gravity_filter"), or
        "none"
    problems : the same and more in sentences, empty if all is well
    """

    samples: int
    duplicates: int
    out_of_order: int
    not_finite: int
    unnormalised: int
    no_orientation: int
    gaps: int
    rate: float
    orientation: str
    problems: tuple[str, ...]


class ImuBuffer:
    """IMU samples in lidar axes, in order of time, to be asked at any time.

    Asked twice the same with the same samples in it, it gives the same answer to the last bit,
    however the samples came in.

    Parameters
    ----------
    config : section ``imu``
    samples : the first of them, if they are there already

    Attributes
    ----------
    gyro_bias : (3,) rad/s in lidar axes, subtracted by :meth:`rotations_since` and
        :meth:`rotation_between`. It does not touch :meth:`orientation`, whose filter takes the
        bias of the rest at the start.

    Raises
    ------
    InputError
        If an array has the wrong shape or dtype.
    """

    def __init__(self, config: ImuConfig, samples: ImuSamples | None = None) -> None:
        self._config = config
        self._gap = round(config.max_gap * 1e9)
        roll, pitch, yaw = np.deg2rad(config.lidar_R_imu_deg)
        self._lidar_R_imu = gtsam.Rot3.RzRyRx(roll, pitch, yaw)
        self._bias = np.zeros(3)
        self._waiting: list[tuple[IntArray, FloatArray]] = []
        self._count = 0
        self._room_stamps = np.zeros(0, np.int64)
        # Columns: quaternion x y z w of world_R_lidar (NaN where unknown), gyro, acceleration.
        self._room = np.zeros((0, 10))
        self._filter = GravityFilter(config)
        self._newest_arrival: int | None = None
        self._duplicates = self._out_of_order = self._not_finite = 0
        self._unnormalised = self._no_orientation = 0
        self._first_quaternion: FloatArray | None = None
        self._quaternions, self._frozen, self._fastest = 0, True, 0.0
        if samples is not None:
            self.add(samples)

    @property
    def lidar_R_imu(self) -> gtsam.Rot3:
        """The configured rotation from IMU into lidar axes."""
        return self._lidar_R_imu

    @property
    def gyro_bias(self) -> FloatArray:
        """(3,) rad/s, lidar axes."""
        return self._bias

    @gyro_bias.setter
    def gyro_bias(self, bias: FloatArray) -> None:
        bias = np.array(bias, dtype=np.float64)
        if bias.shape != (3,) or not np.isfinite(bias).all():
            raise InputError(f"gyro_bias: expected 3 finite numbers in rad/s, got {bias!r}")
        self._bias = bias

    def add(self, samples: ImuSamples) -> None:
        """Put in one or many samples, in any order, overlapping others or not.

        Raises
        ------
        InputError
            If an array has the wrong shape or dtype.
        """
        stamps, values = _checked(samples)
        finite = (np.abs(values[:, 4:]) < _ABSURD).all(axis=1)  # NaN compares false
        finite &= (stamps >= -MAX_STAMP) & (stamps <= MAX_STAMP)
        self._not_finite += len(stamps) - int(finite.sum())
        stamps, values = stamps[finite], values[finite]
        if len(stamps) == 0:
            return
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            norms = np.linalg.norm(values[:, :4], axis=1)
            known = (norms > 1.0 / _ABSURD) & (norms < _ABSURD)
            off = known & (np.abs(norms - 1.0) > _UNIT)
            imu = np.where(known, values[:, :4].T / norms, np.nan)
        self._unnormalised += int(off.sum())
        self._no_orientation += len(stamps) - int(known.sum())
        self._watch_for_placeholder(imu[:, known], values[:, 4:7])
        lidar_R_imu = self._lidar_R_imu.matrix()
        turned = np.empty_like(values)
        turned[:, :4] = quaternion_product(imu, inverse(from_rot3(self._lidar_R_imu))).T
        turned[:, 4:7] = values[:, 4:7] @ lidar_R_imu.T
        turned[:, 7:] = values[:, 7:] @ lidar_R_imu.T
        before = np.iinfo(np.int64).min if self._newest_arrival is None else self._newest_arrival
        newest = np.maximum.accumulate(np.concatenate([[before], stamps]))
        self._out_of_order += int((stamps < newest[:-1]).sum())
        self._newest_arrival = int(newest[-1])
        self._waiting.append((stamps, turned))

    def __len__(self) -> int:
        self._merge()
        return self._count

    @property
    def report(self) -> ImuReport:
        """What is in the buffer and what was wrong with it."""
        self._merge()
        stamps = self._stamps
        steps = np.diff(stamps)
        gaps = steps[steps > self._gap]
        source, problems = self._source()
        for number, what in (
            (self._duplicates, "repeat a stamp: the first of each is kept"),
            (self._out_of_order, "came late: sorted in"),
            (self._not_finite, "hold NaN, infinity or absurd values: left out"),
            (self._unnormalised, "have a quaternion that is not of unit length: normalised"),
            (self._no_orientation if source == "ahrs" else 0, "have no orientation: interpolated"),
        ):
            if number:
                problems.append(f"IMU: {number} samples {what}")
        if len(gaps):
            problems.append(
                f"IMU: {len(gaps)} gaps of more than {self._config.max_gap:g} s, the longest "
                f"{gaps.max() * 1e-9:.3g} s: nothing is known inside them"
            )
        return ImuReport(
            samples=self._count,
            duplicates=self._duplicates,
            out_of_order=self._out_of_order,
            not_finite=self._not_finite,
            unnormalised=self._unnormalised,
            no_orientation=self._no_orientation,
            gaps=len(gaps),
            rate=1e9 / float(np.median(steps)) if len(steps) else 0.0,
            orientation=source,
            problems=tuple(problems),
        )

    def orientation(self, stamp: int) -> gtsam.Rot3 | None:
        """``world_R_lidar`` (world z up), interpolated between the neighbours.

        Beyond the newest sample that one is held, for ``max_gap`` at most (LOAM holds it for
        ever). None before the first sample, inside a longer gap, or without any orientation.
        """
        quaternions = self._orientations()
        if quaternions is None:
            return None
        stamps = self._stamps
        low = int(np.searchsorted(stamps, stamp - self._gap, side="left"))
        high = int(np.searchsorted(stamps, stamp + self._gap, side="right"))
        known = low + np.flatnonzero(np.isfinite(quaternions[low:high, 0]))
        split = int(np.searchsorted(stamps[known], stamp, side="right"))
        if split == 0:
            return None
        i = known[split - 1]
        before = as_rot3(quaternions[i])
        if stamps[i] == stamp:
            return before
        if split == len(known):
            ends = not np.isfinite(quaternions[high:, 0]).any()
            return before if ends else None
        j = known[split]
        step = int(stamps[j] - stamps[i])
        if step > self._gap:
            return None
        return before.slerp((stamp - int(stamps[i])) / step, as_rot3(quaternions[j]))

    def rotations_since(self, stamp: int, seconds: FloatArray) -> FloatArray | None:
        """How the lidar has turned since ``stamp``, from the gyro.

        Parameters
        ----------
        stamp : nanoseconds
        seconds : (K,) from ``stamp``, in any order, negative ones too

        Returns
        -------
        (K, 3) rotation vectors of ``at_stamp_R_at(stamp + seconds)``, rad; None if a gap longer
        than ``max_gap`` or the start of the data is in the way, if the end is more than ``max_gap``
        back (until then the last rate is held), or if the lidar turns by more than 3 rad.

        Raises
        ------
        InputError
            If ``seconds`` is no row of finite numbers.
        """
        seconds = np.asarray(seconds, dtype=np.float64)
        if seconds.ndim != 1 or not np.isfinite(seconds).all():
            raise InputError(
                f"seconds: expected a (K,) array of finite numbers, got shape {seconds.shape}"
            )
        earliest, latest = seconds.min(initial=0.0), seconds.max(initial=0.0)
        first, last = stamp + round(earliest * 1e9), stamp + round(latest * 1e9)
        found = self._rates(first, last, stamp)
        if found is None:
            return None
        begin = int(np.floor(earliest / _FINE))
        end = int(np.ceil(latest / _FINE)) + 2
        nodes: FloatArray = _FINE * np.arange(begin, end, dtype=np.float64)
        steps = rotation_steps(nodes, _interpolate(nodes, *found))
        angles = np.concatenate([[0.0], np.cumsum(np.sqrt((steps * steps).sum(axis=0)))])
        if max(angles[-1] - angles[-begin], angles[-begin]) > WRAP:
            return None
        passed = np.column_stack([[0.0, 0.0, 0.0, 1.0], running_product(exponential(steps))])
        vectors = logarithm(quaternion_product(inverse(passed[:, -begin, None]), passed))
        place = seconds / _FINE - begin
        node = place.astype(np.int64)
        place -= node
        turned: FloatArray = np.diff(vectors, axis=1).take(node, axis=1)
        turned *= place
        turned += vectors.take(node, axis=1)
        return turned.T

    def rotation_between(self, first: int, second: int) -> gtsam.Rot3 | None:
        """``first_R_second`` of two stamps from the gyro; None as for :meth:`rotations_since`."""
        if second < first:
            backwards = self.rotation_between(second, first)
            return None if backwards is None else backwards.inverse()
        found = self._rates(first, second, first)
        if found is None:
            return None
        end = (second - first) * 1e-9
        inside = found[0][(found[0] > 0.0) & (found[0] < end)]
        times = np.concatenate([[0.0], inside, [end]])
        steps = rotation_steps(times, _interpolate(times, *found))
        return as_rot3(running_product(exponential(steps))[:, -1])

    def samples_between(self, first: int, last: int) -> ImuSamples:
        """Copy of the samples from ``first`` to ``last``, both included, in lidar axes.

        The orientation is that of :meth:`orientation`, NaN where unknown.
        """
        quaternions = self._orientations()
        stamps = self._stamps
        part = slice(*np.searchsorted(stamps, [first, last + 1]))
        return ImuSamples(
            stamps=stamps[part].copy(),
            orientation=None if quaternions is None else quaternions[part].copy(),
            gyro=self._gyro[part].copy(),
            acceleration=self._acceleration[part].copy(),
        )

    def rest_at(self, stamp: int) -> RestWindow | None:
        """The samples of the last ``still_seconds``, and 0.1 s more, if the lidar is at rest.

        What at rest means is said at :func:`loam_gtsam.imu.at_rest.find_rest`.
        """
        first = stamp - round(self._config.still_seconds * 1e9)
        samples = self.samples_between(first, stamp + round(REST_AHEAD * 1e9))
        return find_rest(
            self._config, samples.stamps, samples.gyro, samples.acceleration, samples.orientation
        )

    # -- the samples -------------------------------------------------------------------------------

    @property
    def _stamps(self) -> IntArray:
        return self._room_stamps[: self._count]

    @property
    def _values(self) -> FloatArray:
        return self._room[: self._count]

    @property
    def _gyro(self) -> FloatArray:
        return self._room[: self._count, 4:7]

    @property
    def _acceleration(self) -> FloatArray:
        return self._room[: self._count, 7:]

    def _merge(self) -> None:
        """Sort in what has been added since the last question."""
        if not self._waiting:
            return
        stamps = np.concatenate([part[0] for part in self._waiting])
        values = np.concatenate([part[1] for part in self._waiting])
        self._waiting.clear()
        earliest = int(stamps.min())
        # Nothing before this place changes; as a rule it is the end.
        at = int(np.searchsorted(self._stamps, earliest))
        # The old ones first: of equal stamps a stable sort then keeps the first to come.
        stamps = np.concatenate([self._stamps[at:], stamps])
        values = np.concatenate([self._values[at:], values])
        order = np.argsort(stamps, kind="stable")
        stamps = stamps[order]
        kept = np.concatenate([[True], stamps[1:] != stamps[:-1]])
        self._duplicates += len(stamps) - int(kept.sum())
        self._count = at + int(kept.sum())
        if self._count > len(self._room):
            # Twice the room: a live stream is then copied a few times in all, not at every merge.
            room = 2 * self._count
            self._room_stamps = np.concatenate([self._room_stamps[:at], np.zeros(room - at, int)])
            self._room = np.concatenate([self._room[:at], np.zeros((room - at, 10))])
        self._room_stamps[at : self._count] = stamps[kept]
        self._room[at : self._count] = values[order][kept]
        self._filter.forget(at, earliest)

    def _rates(self, first: int, last: int, origin: int) -> tuple[FloatArray, FloatArray] | None:
        """Seconds (K,) from ``origin`` and rates (3, K) of the samples around a stretch of time,
        or None where it is not covered.
        """
        self._merge()
        stamps = self._stamps
        low = int(np.searchsorted(stamps, first, side="right")) - 1
        high = int(np.searchsorted(stamps, last, side="left"))
        if low < 0 or (high == len(stamps) and last - int(stamps[-1]) > self._gap):
            return None
        inside = stamps[low : high + 1]
        if (np.diff(inside) > self._gap).any():
            return None
        rates = self._gyro[low : high + 1] - self._bias
        return (inside - origin).astype(np.float64) * 1e-9, rates.T

    # -- the orientation ---------------------------------------------------------------------------

    def _watch_for_placeholder(self, quaternions: FloatArray, gyro: FloatArray) -> None:
        """Note whether the orientation (4, N) ever changes and how fast the gyro (N, 3) turns."""
        self._fastest = max(self._fastest, float(np.linalg.norm(gyro, axis=1).max()))
        self._quaternions += quaternions.shape[1]
        if quaternions.shape[1]:
            if self._first_quaternion is None:
                self._first_quaternion = quaternions[:, :1].copy()
            self._frozen &= bool((quaternions == self._first_quaternion).all())

    @property
    def _placeholder(self) -> bool:
        enough = self._quaternions >= REST_SAMPLES
        return enough and self._frozen and self._fastest > FROZEN_TURN

    def _source(self) -> tuple[str, list[str]]:
        """Where the orientation comes from, and what is wrong with that."""
        problems = []
        quaternions = self._orientations()
        if self._placeholder:
            problems.append(
                f"IMU: the orientation never changes while the gyro says {self._fastest:.2g} "
                "rad/s: it is a placeholder and not used"
            )
        if self._quaternions and not self._placeholder:
            rest = self._rest_at_start(quaternions)
            if rest is not None and rest.disagreement > TILT_LIMIT:
                problems.append(
                    "IMU: at rest at the start, up by the orientation and up by the accelerometer "
                    f"are {np.rad2deg(rest.disagreement):.0f} degrees apart: expected the "
                    "orientation of the IMU in a world with z up (not the north-east-down one) and "
                    "an acceleration that reads +9.8 upwards; correct the driver or set imu.prior "
                    "to off"
                )
            return "ahrs", problems
        if self._count == 0:
            return "none", problems
        if quaternions is None:
            problems.append(
                "IMU: no orientation, and none to be had from the acceleration, whose mean at the "
                f"start is not near {self._config.gravity:g} m/s^2 (imu.gravity): expected m/s^2"
            )
            return "none", problems
        if self._rest_at_start() is None:
            problems.append(
                "IMU: no orientation, and no rest at the start to take the bias of the gyro from: "
                "roll and pitch may be off by several degrees"
            )
        return "gravity_filter", problems

    def _rest_at_start(self, quaternions: FloatArray | None = None) -> RestWindow | None:
        return rest_at_start(
            self._config, self._stamps, self._gyro, self._acceleration, quaternions
        )

    def _orientations(self) -> FloatArray | None:
        """(N, 4) quaternions of ``world_R_lidar``, NaN where unknown; None if all are."""
        self._merge()
        if self._count == 0:
            return None
        if self._quaternions and not self._placeholder:
            return self._values[:, :4]
        return self._filter.orientations(self._stamps, self._gyro, self._acceleration)


def extrinsic_problem(buffer: ImuBuffer, stamps: IntArray, map_T_lidar: FloatArray) -> str:
    """Whether another ``lidar_R_imu_deg`` would fit the motion of the scans better.

    The rotations from frame to frame by the gyro and by the scans are the same vectors in two sets
    of axes; the rotation between the sets is found in closed form (Wahba's problem by SVD:
    Markley, J. Astronautical Sciences 36, 1988).

    Parameters
    ----------
    buffer : with the configured rotation
    stamps : (N,) nanoseconds
    map_T_lidar : (N, 4, 4) poses or (N, 3, 3) rotations, from scans alone

    Returns
    -------
    A sentence if the best rotation is more than :data:`EXTRINSIC_LIMIT` away and known to
    :data:`EXTRINSIC_SIGMA`, else "": then all is well or the motion was too poor to tell.

    Raises
    ------
    InputError
        If the shapes do not fit.
    """
    stamps, poses = np.asarray(stamps), np.asarray(map_T_lidar, dtype=np.float64)
    if stamps.ndim != 1 or poses.shape not in ((len(stamps), 4, 4), (len(stamps), 3, 3)):
        raise InputError(
            f"extrinsic_problem: expected (N,) stamps and (N, 4, 4) or (N, 3, 3) poses, got "
            f"{stamps.shape} and {poses.shape}"
        )
    turns = [buffer.rotation_between(int(a), int(b)) for a, b in pairwise(stamps)]
    known = np.array([turn is not None for turn in turns], dtype=np.bool_)
    if known.sum() < EXTRINSIC_FRAMES:
        return ""
    rotations = poses[:, :3, :3]
    relative = np.einsum("nji,njk->nik", rotations[:-1], rotations[1:])[known]
    by_scan = np.array([gtsam.Rot3.Logmap(gtsam.Rot3(matrix)) for matrix in relative])
    by_gyro = np.array([gtsam.Rot3.Logmap(turn) for turn in turns if turn is not None])
    # How far, unlike about which axis, does not depend on the extrinsics: a pair that disagrees
    # in that is a lost track or a gyro fault, and would only mislead.
    unlike = np.abs(np.linalg.norm(by_scan, axis=1) - np.linalg.norm(by_gyro, axis=1))
    fair = unlike <= 3.0 * np.median(unlike) + 1e-9
    by_scan, by_gyro = by_scan[fair], by_gyro[fair]
    left, strength, right = np.linalg.svd(by_scan.T @ by_gyro)
    sign = float(np.sign(np.linalg.det(left) * np.linalg.det(right)))
    better = gtsam.Rot3(left @ np.diag([1.0, 1.0, sign]) @ right)
    away = float(np.linalg.norm(gtsam.Rot3.Logmap(better)))
    residuals = by_scan - by_gyro @ better.matrix().T
    variance = float((residuals**2).sum()) / (3 * len(residuals) - 3)
    # Information about the axis known least, unit weights. Products of the two, not squares of one:
    # noise, which is not the same in both, must not pass for motion.
    weakest = strength[1] + sign * strength[2]
    if away <= EXTRINSIC_LIMIT or variance > EXTRINSIC_SIGMA**2 * weakest:
        return ""
    angles = np.rad2deg(better.compose(buffer.lidar_R_imu).rpy()).round().astype(int)
    return (
        f"IMU: its rotations fit those of the scans better by {np.rad2deg(away):.0f} degrees with "
        f"imu.lidar_R_imu_deg = {angles.tolist()}; check how the "
        "IMU is mounted"
    )


def _checked(samples: ImuSamples) -> tuple[IntArray, FloatArray]:
    """Stamps (N,) and values (N, 10): quaternion (zero where unknown), gyro, acceleration."""
    stamps = np.asarray(samples.stamps)
    if stamps.ndim != 1 or (stamps.dtype.kind not in "iu" and len(stamps)):
        raise InputError(
            f"ImuSamples.stamps: expected (N,) integer nanoseconds, got shape {stamps.shape} of "
            f"{stamps.dtype}; np.round(seconds * 1e9).astype(np.int64) makes them of seconds"
        )
    columns = []
    for name, width in (("orientation", 4), ("gyro", 3), ("acceleration", 3)):
        column = getattr(samples, name)
        if column is None and name == "orientation":
            column = np.zeros((len(stamps), 4))
        column = np.asarray(column)
        if column.shape != (len(stamps), width) or column.dtype.kind not in "fiu":
            raise InputError(
                f"ImuSamples.{name}: expected ({len(stamps)}, {width}) numbers, one row per "
                f"stamp, got shape {column.shape} of {column.dtype}"
            )
        columns.append(column)
    return stamps.astype(np.int64), np.hstack(columns).astype(np.float64)


def _interpolate(times: FloatArray, seconds: FloatArray, rates: FloatArray) -> FloatArray:
    """(3, N) rates at ``times``; before the first and after the last they are held."""
    return np.stack([np.interp(times, seconds, rate) for rate in rates])
