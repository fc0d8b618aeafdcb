"""Keyframes, loop closures between them, their covariances as noise models, and their keys.

The pose of keyframe ``i`` has the key ``gtsam.symbol("x", i)`` in every graph. The frame of the
mapper's poses is ``odom``: continuous, and drifting; ``map`` is the corrected one (ROS REP-105).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from operator import attrgetter

import gtsam
import numpy as np

from loam_gtsam.config import Config, PoseGraphConfig
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.geometry import as_array, checked_pose, symmetric, transform
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.types import BoolArray, Features, FloatArray, InputError, MapUpdate, Uncertainty

_LEAST_SIGMAS = np.repeat([1e-6, 1e-5], 3)  # rad and m: no factor may be infinitely sure


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame whose pose is a variable of the pose graph.

    Attributes
    ----------
    index : number of the keyframe
    update : result of the mapper for the frame; its ``map_T_lidar`` is :attr:`odom_T_lidar`
    travelled : metres travelled from keyframe to keyframe until here
    edges, planes : (E, 3) and (P, 3) metres, de-skewed to the stamp, lidar frame, voxel-filtered
    distinct : (E,) whether an edge stands out of its ring by more than noise makes it
    session : number of the run that the frame is of; no odometry leads from one run to another
    """

    index: int
    update: MapUpdate
    travelled: float
    edges: FloatArray
    planes: FloatArray
    distinct: BoolArray
    session: int = 0

    @property
    def stamp(self) -> int:
        """Nanoseconds the pose belongs to."""
        return self.update.stamp

    @property
    def key(self) -> int:
        """Key of the pose in the graph."""
        return pose_key(self.index)

    @property
    def odom_T_lidar(self) -> gtsam.Pose3:
        """The pose as the mapper found it."""
        return self.update.map_T_lidar


@dataclass(frozen=True, slots=True, eq=False)
class Forgotten:
    """Where a keyframe was that is no variable any more, seen from one that is.

    Attributes
    ----------
    stamp, odom_T_lidar, session : of the keyframe
    base : number of the keyframe that stays
    base_T_lidar : the forgotten pose in its frame
    """

    stamp: int
    odom_T_lidar: gtsam.Pose3
    session: int
    base: int
    base_T_lidar: gtsam.Pose3


class Journal:
    """Forgotten keyframes in the order of time: a list that only grows."""

    def __init__(self) -> None:
        self.all: list[Forgotten] = []

    def restorer(self) -> Callable[[], None]:
        """A function that brings the journal back to what it is now."""
        size = len(self.all)

        def restore() -> None:
            del self.all[size:]

        return restore


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """What leads to a keyframe from another one: motion, (6, 6) covariance, metres of way."""

    base: int
    base_T_lidar: gtsam.Pose3
    covariance: FloatArray
    way: float

    def factor(self, key: int) -> gtsam.BetweenFactorPose3:
        """As a factor on the pose that has the key."""
        noise = noise_model(self.covariance)
        return gtsam.BetweenFactorPose3(pose_key(self.base), key, self.base_T_lidar, noise)


@dataclass(slots=True, eq=False)
class Visits:
    """Which keyframes are at one place, and which of them are forgotten.

    Attributes
    ----------
    place_of : number of the first keyframe of the place, by the number of each keyframe there; a
        keyframe that is not in it is a place of its own
    surplus : number of the newest keyframe if the next one takes its place
    last : what leads to the newest keyframe, and how many factors there were with it
    ties : metres of way to a keyframe from the one that took the place of a forgotten one before it
    journal : the forgotten keyframes
    """

    place_of: dict[int, int] = field(default_factory=dict)
    surplus: int | None = None
    last: tuple[Tie, int] | None = None
    ties: dict[int, tuple[int, float]] = field(default_factory=dict)
    journal: Journal = field(default_factory=Journal)

    def is_place(self, index: int) -> bool:
        """Whether a keyframe is the first one of its place."""
        return self.place_of.get(index, index) == index

    def add(self, newest: int, place: int, most: int) -> bool:
        """The newest keyframe is at a place; whether ``most`` came back to it before."""
        self.place_of.setdefault(place, place)
        back = sum(first == place for first in self.place_of.values()) - 1
        self.place_of[newest] = place
        self.surplus = newest if back >= most else None
        return self.surplus is not None

    def forget(self, last: Keyframe, tie: Tie) -> None:
        """The newest keyframe is forgotten; it was where ``tie`` says."""
        there = last.stamp, last.odom_T_lidar, last.session
        self.journal.all.append(Forgotten(*there, tie.base, tie.base_T_lidar))
        del self.place_of[last.index]
        self.ties.pop(last.index, None)


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """The motion between two keyframes, found by looking at the same place.

    Attributes
    ----------
    earlier, later : numbers of the keyframes
    earlier_T_later : pose of the later keyframe in the frame of the earlier one
    covariance : (6, 6) covariance of that pose, rotation first, perturbation on the right
    share : share of the features off level ground that were matched; NaN if unknown
    agreement : share of those matches within three standard deviations; NaN if unknown
    """

    earlier: int
    later: int
    earlier_T_later: gtsam.Pose3
    covariance: FloatArray
    share: float = np.nan
    agreement: float = np.nan

    def __post_init__(self) -> None:
        for index in (self.earlier, self.later):
            if not isinstance(index, (int, np.integer)):
                got = type(index).__name__
                raise InputError(f"loop: expected numbers of keyframes (keyframe.index), got {got}")
        checked_pose(self.earlier_T_later, "earlier_T_later")

    def factor(self, kernel_width: float = np.inf) -> gtsam.BetweenFactorPose3:
        """The loop closure as a factor, with a Huber kernel of that width on its whitened norm."""
        noise: gtsam.noiseModel.Base = noise_model(self.covariance)
        if np.isfinite(kernel_width):
            kernel = gtsam.noiseModel.mEstimator.Huber.Create(kernel_width)
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        keys = pose_key(self.earlier), pose_key(self.later)
        return gtsam.BetweenFactorPose3(*keys, self.earlier_T_later, noise)


def surely_placed(update: MapUpdate) -> Uncertainty | None:
    """The uncertainty of a frame that may be a keyframe or a place: solved, and not in doubt."""
    known = update.uncertainty
    return None if known is None or known.in_doubt or not update.status.solved else known


def leads_to_keyframe(motion: gtsam.Pose3, config: PoseGraphConfig) -> bool:
    """Whether a motion since the last keyframe is so large that the next one is due."""
    turned = np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(motion.rotation())))
    moved = np.linalg.norm(motion.translation())
    return not (moved < config.keyframe_distance and turned < config.keyframe_angle_deg)


def numbered(keyframes: Sequence[Keyframe], index: int) -> Keyframe:
    """The keyframe of a number, of some in their order.

    Raises
    ------
    InputError
        If there is none.
    """
    position = bisect_left(keyframes, index, key=attrgetter("index"))
    if position == len(keyframes) or keyframes[position].index != index:
        raise InputError(
            f"keyframe: expected one of the {len(keyframes)} there are, got {index}"
            + (", which was forgotten" if keyframes and 0 <= index < keyframes[-1].index else "")
        )
    return keyframes[position]


def pose_key(index: int) -> int:
    """Key of the pose of a keyframe."""
    return gtsam.symbol("x", index)


def is_pose_key(key: int) -> bool:
    """Whether a key is one of :func:`pose_key`."""
    return gtsam.symbolChr(key) == ord("x")


def pose_number(key: int) -> int:
    """Number of the keyframe whose pose has the key; other keys stay as they are."""
    return gtsam.symbolIndex(key) if is_pose_key(key) else key


def is_pose(values: gtsam.Values, key: int) -> bool:
    """Whether the variable is a Pose3."""
    try:
        values.atPose3(key)
    except RuntimeError:
        return False
    return True


def keyframe_points(
    update: MapUpdate, features: Features | None, config: Config, imu: ImuBuffer | None
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """``edges``, ``planes`` and ``distinct`` of a :class:`Keyframe`; empty without features.

    Raises
    ------
    InputError
        If the features are those of another stamp.
    """
    if features is None:
        return np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.bool_)
    if features.stamp != update.stamp:
        raise InputError(
            f"features: expected those of the stamp {update.stamp}, got {features.stamp}"
        )
    posed = MovingSweep(features, config, imu).accelerated(update.acceleration).at(update.twist)
    to_reference = posed.middle_T_reference.inverse().matrix()
    edges, planes = (transform(to_reference, part) for part in posed.points)
    return edges, planes, posed.sweep.distinct


def odometry_between(
    one: Keyframe, two: Keyframe, config: PoseGraphConfig
) -> tuple[gtsam.Pose3, FloatArray]:
    """``one_T_two`` according to the mapper, in either order of time, and its (6, 6) covariance."""
    motion = one.odom_T_lidar.between(two.odom_T_lidar)
    if one.index == two.index:
        return motion, np.zeros((6, 6))
    if one.index < two.index:
        covariance = relative_covariance(one.update, two.update)
    else:
        back = motion.inverse().AdjointMap()
        covariance = back @ relative_covariance(two.update, one.update) @ back.T
    return motion, covariance + walk(abs(two.travelled - one.travelled), config)


def walk(way: float, config: PoseGraphConfig) -> FloatArray:
    """(6, 6) covariance of what the odometry drifts in metres of way and does not know of."""
    sigmas = np.repeat([np.radians(config.turn_walk_deg), config.walk], 3)
    return np.diag(sigmas**2 * way)


def check_covariance(covariance: FloatArray) -> None:
    """InputError as of :func:`noise_model`, or if a (6, 6) covariance has no variance of a part."""
    noise_model(covariance)
    if not (np.diagonal(covariance) > 0.0).all():
        raise InputError("covariance: expected a positive definite one, got a variance of zero")


def noise_model(covariance: FloatArray, size: int = 6) -> gtsam.noiseModel.Gaussian:
    """A noise model that is never infinitely sure.

    Raises
    ------
    InputError
        If the matrix is no covariance: GTSAM would make NaN of it in silence.
    """
    matrix = as_array(covariance, "covariance", (size, size))
    if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-12 * np.abs(matrix).max()):
        raise InputError("covariance: expected a symmetric matrix; give 0.5 * (C + C.T)")
    values, vectors = np.linalg.eigh(symmetric(matrix))
    if values[0] < -1e-6 * np.trace(matrix):
        raise InputError(f"covariance: expected no negative eigenvalue, got {values[0]:.3g}")
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T  # rounding, far from the origin
    return gtsam.noiseModel.Gaussian.Covariance(positive + np.diag(_LEAST_SIGMAS[-size:] ** 2))
