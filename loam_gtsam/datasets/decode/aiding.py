"""What other sensors say of the way: fixes of a GNSS receiver, and the odometry of wheels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from loam_gtsam.config import Config
from loam_gtsam.datasets.decode.pointcloud2 import message_stamp
from loam_gtsam.datasets.decode.tables import rows_in_time
from loam_gtsam.geometry import as_array, as_stamps
from loam_gtsam.trajectory import check_poses
from loam_gtsam.types import BoolArray, DatasetError, FloatArray, InputError, IntArray, check_array

FIX = "sensor_msgs/msg/NavSatFix"
TWIST, ODOMETRY = "geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry"
_SYMMETRIC = 1e-6  # of its largest element, by which a covariance may be asymmetric
_STILL = 1e-6  # metres: a pose that changes by less than this has not been filled in


@dataclass(frozen=True, slots=True, eq=False)
class GnssFixes:
    """Positions of the antenna of a GNSS receiver.

    Attributes
    ----------
    stamps : (N,) int64 nanoseconds, ascending
    geodetic : (N, 3) latitude, longitude (degrees), height above the ellipsoid of WGS 84 (metres)
    covariances : (N, 3, 3) m^2 along east, north, up, or one (3, 3) for all; NaN where the receiver
        tells none, which None or nothing stands for

    Raises
    ------
    InputError
        If a shape is wrong, a position is not finite or on no earth, a covariance is none, or
        stamps do not ascend.
    """

    stamps: IntArray
    geodetic: FloatArray
    covariances: FloatArray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        stamps = as_stamps(self.stamps, "GnssFixes.stamps")
        places = as_array(self.geodetic, "GnssFixes.geodetic", (len(stamps), 3))
        told = np.full((3, 3), np.nan) if self.covariances is None else self.covariances
        try:
            shape: object = np.shape(told)
        except ValueError:
            shape = "rows of different lengths"
        if shape not in ((3, 3), (len(stamps), 3, 3)):
            raise InputError(
                f"GnssFixes.covariances: expected ({len(stamps)}, 3, 3), (3, 3) or None, got "
                f"{shape}; variances[:, :, None] * np.eye(3) makes them of variances"
            )
        told = np.broadcast_to(np.asarray(told), (len(stamps), 3, 3))
        check_array(told, "GnssFixes.covariances", (len(stamps), 3, 3), "numbers")
        for name, array in (("stamps", stamps), ("geodetic", places), ("covariances", told)):
            object.__setattr__(self, name, array)
        if (np.diff(stamps) <= 0).any():
            raise InputError("GnssFixes.stamps: expected ascending ones")
        if not is_place(places).all():
            raise InputError(
                "GnssFixes.geodetic: expected latitudes within 90 and longitudes within 360 degrees"
            )
        wrong = ~(_is_covariance(told) | np.isnan(told).all(axis=(1, 2)))
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(
                "GnssFixes.covariances: expected symmetric, positive definite ones, or NaN alone "
                f"where none is known; got {np.asarray(told[row]).tolist()} for fix {row} "
                f"({np.count_nonzero(wrong)} of {len(stamps)} are none)"
            )

    def __len__(self) -> int:
        return len(self.stamps)


def is_place(geodetic: FloatArray) -> Any:
    """(N,) whether latitudes and longitudes in degrees, and heights in metres, can be on earth."""
    return (np.abs(geodetic) <= np.array([90.0, 360.0, 1e5])).all(axis=1)


def _is_covariance(matrices: FloatArray) -> BoolArray:
    """(N,) whether matrices (N, 3, 3) are finite, symmetric and positive definite."""
    finite = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    known = np.where(finite[:, None, None], matrices, 0.0)
    across = known.swapaxes(1, 2)
    apart, largest = (np.abs(part).max(axis=(1, 2)) for part in (known - across, known))
    least = np.linalg.eigvalsh(0.5 * (known + across))[:, 0]
    good: BoolArray = (least > 0.0) & (apart <= _SYMMETRIC * largest)
    return good


@dataclass(frozen=True, slots=True, eq=False)
class WheelSamples:
    """The way by the wheels, as poses of the vehicle in a frame of their own, which drifts.

    Attributes
    ----------
    stamps : (N,) int64 nanoseconds, ascending
    start_T_body : (N, 4, 4) of the vehicle: x ahead, y to the left, z up

    Raises
    ------
    InputError
        If a shape is wrong, a number is not finite, or stamps do not ascend.
    """

    stamps: IntArray
    start_T_body: FloatArray

    def __post_init__(self) -> None:
        stamps = as_stamps(self.stamps, "WheelSamples.stamps")
        poses = as_array(self.start_T_body, "WheelSamples.start_T_body", (len(stamps), 4, 4))
        object.__setattr__(self, "stamps", stamps)
        object.__setattr__(self, "start_T_body", poses)
        if (np.diff(stamps) <= 0).any():
            raise InputError("WheelSamples.stamps: expected ascending ones")
        check_poses(poses, "WheelSamples.start_T_body")

    def __len__(self) -> int:
        return len(self.stamps)

    @classmethod
    def of_twists(cls, stamps: ArrayLike, twists: ArrayLike) -> WheelSamples:
        """Of (N,) nanoseconds and (N, 6) velocities of the vehicle, rad/s then m/s, body frame."""
        times = as_stamps(stamps, "stamps")
        values = as_array(twists, "twists", (len(times), 6))
        pose, poses = gtsam.Pose3(), []
        for number, twist in enumerate(values):
            if number:
                seconds = (int(times[number]) - int(times[number - 1])) * 1e-9
                mean = 0.5 * (twist + values[number - 1])
                pose = pose.compose(gtsam.Pose3.Expmap(mean * seconds))
            poses.append(pose.matrix())
        return cls(times, np.array(poses, np.float64).reshape(-1, 4, 4))


def fixes_of(messages: Sequence[Any], topic: str, problems: list[str]) -> GnssFixes | None:
    """``sensor_msgs/NavSatFix`` messages in order of time; what is left out goes to ``problems``.

    A message without a fix (status below 0), without a finite place or with a repeated stamp is
    left out; a covariance of unknown type, or that is none, is NaN.
    """
    stamps, rows, noise = [], [], []
    for message in messages:
        place = [message.latitude, message.longitude, message.altitude]
        if message.status.status < 0 or not is_place(np.array([place])).all():
            continue
        covariance = np.reshape(np.asarray(message.position_covariance, np.float64), (3, 3))
        if message.position_covariance_type <= 0 or not _is_covariance(covariance[None]).all():
            covariance = np.full((3, 3), np.nan)
        stamps.append(message_stamp(message))
        rows.append(place)
        noise.append(covariance)
    if lost := len(messages) - len(stamps):
        problems.append(f"{topic}: {lost} of {len(messages)} messages have no fix, left out")
    order = _ascending(np.array(stamps, np.int64), topic, problems)
    if not len(order):
        return None
    parts = (np.array(part)[order] for part in (stamps, rows, noise))
    fixes = GnssFixes(*parts)
    unknown = int(np.isnan(fixes.covariances[:, 0, 0]).sum())
    if unknown:
        problems.append(
            f"{topic}: {unknown} of {len(fixes)} fixes without a covariance; they are used only if "
            "aiding.gnss_sigma is set"
        )
    return fixes


def wheels_of(messages: Sequence[Any], topic: str, problems: list[str]) -> WheelSamples | None:
    """``nav_msgs/Odometry`` or ``geometry_msgs/TwistStamped`` messages in order of time.

    Of odometry it is the poses, or the velocities where the poses never change.
    """
    rows, stamps = [], []
    for message in messages:
        twist = message.twist.twist if hasattr(message, "pose") else message.twist
        speed = [getattr(part, axis) for part in (twist.angular, twist.linear) for axis in "xyz"]
        place = [0.0] * 7
        if hasattr(message, "pose"):
            at, turn = message.pose.pose.position, message.pose.pose.orientation
            place = [at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z]
        row = np.array([*speed, *place], np.float64)
        if np.isfinite(row).all():
            stamps.append(message_stamp(message))
            rows.append(row)
    if lost := len(messages) - len(stamps):
        problems.append(f"{topic}: {lost} messages with NaN left out")
    order = _ascending(np.array(stamps, np.int64), topic, problems)
    if len(order) < 2:
        return None
    times, values = np.array(stamps, np.int64)[order], np.array(rows)[order]
    poses, lengths = values[:, 6:], np.linalg.norm(values[:, 9:], axis=1)
    if np.ptp(poses, axis=0).max() < _STILL or not ((lengths > 0.5) & (lengths < 2.0)).all():
        return WheelSamples.of_twists(times, values[:, :6])
    matrices = []
    for pose, length in zip(poses, lengths, strict=True):
        matrices.append(gtsam.Pose3(gtsam.Rot3.Quaternion(*pose[3:] / length), pose[:3]).matrix())
    return WheelSamples(times, np.array(matrices, np.float64))


def _ascending(stamps: IntArray, topic: str, problems: list[str]) -> IntArray:
    """Rows in order of time, each stamp once."""
    if (np.diff(stamps) < 0).any():
        problems.append(f"{topic}: stamps out of order, sorted")
    order = rows_in_time(stamps)
    order = order[stamps[order] >= 0]
    if dropped := len(stamps) - len(order):
        problems.append(f"{topic}: {dropped} messages with a repeated stamp left out")
    return order


def describe_fixes(fixes: GnssFixes | None, topic: str) -> str:
    """Count and topic of fixes as text."""
    return f"{0 if fixes is None else len(fixes)} fixes ({topic}); --gnss uses them"


def aids_of(dataset: Any, config: Config) -> tuple[GnssFixes | None, WheelSamples | None]:
    """What a configuration asks for; DatasetError if the data set does not have it."""
    found: list[Any] = []
    for kind, asked in (("gnss", config.aiding.gnss), ("wheels", config.aiding.wheels)):
        found.append(getattr(dataset, kind, None) if asked else None)
        if asked and found[-1] is None:
            raise _no_samples(kind)
    return found[0], found[1]


def _no_samples(kind: str) -> DatasetError:
    """The error if a configuration asks for what a data set does not have."""
    name, topics = {
        "gnss": ("a GNSS receiver", "NavSatFix"),
        "wheels": ("wheels", "Odometry or TwistStamped"),
    }[kind]
    return DatasetError(
        f"aiding.{kind}: the data have nothing of {name} that can be used; loam-gtsam inspect "
        f"shows the topics ({topics}), --{kind}-topic names one"
    )
