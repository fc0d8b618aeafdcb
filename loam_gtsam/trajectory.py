"""Poses over time; :mod:`loam_gtsam.types` hands them on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, overload

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from loam_gtsam.errors import InputError, as_stamps, check_all, check_array, check_kind

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
_OF_FILES = 1e-2  # by which the axes of a rotation may be off in a file, which has few digits
_OF_POSES = 1e-5  # and in a pose that a user gives


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory:
    """Poses over time: ``len``, iteration and an integer index go by :class:`gtsam.Pose3`.

    A slice, a mask or an array of indices gives a trajectory of these poses.

    Attributes
    ----------
    stamps : (N,) int64 nanoseconds
    map_T_lidar : (N, 4, 4) float64; NaN as orientations where positions alone are known
    point : (3,) metres along the axes of the lidar: the point, such as a prism, whose positions a
        reference has; None if they are the lidar's

    Raises
    ------
    InputError
        If there is not one pose for each stamp, or a matrix without NaN is no pose.
    """

    stamps: IntArray
    map_T_lidar: FloatArray
    point: FloatArray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "stamps", as_stamps(self.stamps, "Trajectory.stamps"))
        check_array(self.map_T_lidar, "Trajectory.map_T_lidar", (len(self.stamps), 4, 4), "numbers")
        check_poses(self.map_T_lidar, "Trajectory.map_T_lidar")

    @classmethod
    def from_poses(
        cls, stamps: Sequence[int] | IntArray, poses: Iterable[gtsam.Pose3]
    ) -> Trajectory:
        """N poses at N stamps in nanoseconds; InputError for anything else."""
        check_kind(poses, Iterable, "poses", "a list of gtsam.Pose3 is one")
        poses = list(poses)
        how = "Trajectory(stamps, matrices) takes an array of (N, 4, 4)"
        check_all(poses, gtsam.Pose3, "poses", how)
        return cls(as_stamps(stamps, "stamps"), stack_poses(poses))

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[gtsam.Pose3]:
        return map(gtsam.Pose3, self.map_T_lidar)

    @overload
    def __getitem__(self, which: int | np.integer) -> gtsam.Pose3: ...

    @overload
    def __getitem__(self, which: slice | Sequence[int] | NDArray[Any]) -> Trajectory: ...

    def __getitem__(self, which: Any) -> gtsam.Pose3 | Trajectory:
        stamps, map_T_lidar = self.stamps[which], self.map_T_lidar[which]
        if map_T_lidar.ndim == 2:
            return gtsam.Pose3(map_T_lidar)
        return Trajectory(stamps, map_T_lidar, self.point)

    def __repr__(self) -> str:
        if not len(self):
            return "Trajectory(0 poses)"
        seconds = (int(self.stamps[-1]) - int(self.stamps[0])) * 1e-9
        path = f"{seconds:.2f} s from {self.stamps[0]} ns, {self.path_length:.2f} m"
        return f"Trajectory({len(self)} poses: {path})"

    @property
    def positions(self) -> FloatArray:
        """(N, 3) metres, a view of ``map_T_lidar``."""
        return self.map_T_lidar[:, :3, 3]

    @property
    def path_length(self) -> float:
        """Metres travelled."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @overload
    def at(self, stamps: int | np.integer) -> gtsam.Pose3: ...

    @overload
    def at(self, stamps: Sequence[int] | NDArray[np.integer]) -> Trajectory: ...

    def at(self, stamps: ArrayLike) -> gtsam.Pose3 | Trajectory:
        """Poses at other times: linear in position, spherical linear in orientation.

        Parameters
        ----------
        stamps : nanoseconds: one for a pose, (M,) in any order for a trajectory

        Raises
        ------
        InputError
            If a stamp lies outside the trajectory, or the trajectory's own stamps do not increase.
        """
        check_increasing(self, "Trajectory.at")
        asked = as_stamps(np.atleast_1d(stamps), "Trajectory.at")
        first, last = self.stamps[[0, -1]]
        if asked.size and (asked.min() < first or asked.max() > last):
            raise InputError(
                f"Trajectory.at: expected stamps from {first} to {last} ns, where the trajectory "
                f"is, got {asked.min()} to {asked.max()}"
            )
        found = self._interpolated(asked)
        return found[0] if np.ndim(stamps) == 0 else found

    def _interpolated(self, stamps: IntArray) -> Trajectory:
        from scipy.spatial.transform import Rotation, Slerp

        times, queries = ((some - self.stamps[0]) * 1e-9 for some in (self.stamps, stamps))
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        rotations = self.map_T_lidar[:, :3, :3]
        if np.isfinite(rotations).all():
            turned = Slerp(times, Rotation.from_matrix(rotations))(queries)
            poses[:, :3, :3] = turned.as_matrix()
        else:  # positions alone
            poses[:, :3, :3] = np.nan
        for axis in range(3):
            poses[:, axis, 3] = np.interp(queries, times, self.positions[:, axis])
        return Trajectory(stamps, poses, self.point)


def stack_poses(poses: Iterable[gtsam.Pose3]) -> FloatArray:
    """(N, 4, 4) matrices of N poses; (0, 4, 4) if there are none."""
    return np.array([pose.matrix() for pose in poses], np.float64).reshape(-1, 4, 4)


def checked_pose(value: gtsam.Pose3, name: str) -> gtsam.Pose3:
    """The pose itself; InputError for anything else, or if its rotation is none."""
    check_kind(value, gtsam.Pose3, name, "gtsam.Pose3(matrix) makes one of a (4, 4) matrix")
    off, determinant = _off_rotations(value.rotation().matrix())
    if not (off <= _OF_POSES and determinant > 0.0):
        raise InputError(
            f"{name}: expected a rotation of orthogonal unit axes and determinant 1, got one that "
            f"is {off:.2g} off, with determinant {determinant:.3g}; gtsam.Rot3.ClosestTo(matrix) "
            "makes one of axes that are rounded"
        )
    return value


def _off_rotations(matrices: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """How far the products of axes of (..., 3, 3) are from those of unit axes; determinants."""
    with np.errstate(over="ignore", invalid="ignore"):
        products = matrices @ matrices.swapaxes(-1, -2)
        return np.abs(products - np.eye(3)).max(axis=(-2, -1)), np.linalg.det(matrices)


def is_rigid(matrices: NDArray[Any]) -> NDArray[np.bool_]:
    """(...,) whether matrices (..., 4, 4) are rigid transforms, as far as a file has their digits.

    A matrix that is not finite is none.
    """
    off, determinants = _off_rotations(matrices[..., :3, :3])
    last = np.abs(matrices[..., 3, :] - [0.0, 0.0, 0.0, 1.0]).max(axis=-1)
    rigid: NDArray[np.bool_] = (off <= _OF_FILES) & (determinants > 0.0) & (last <= _OF_FILES)
    return rigid


def check_poses(poses: NDArray[Any], name: str) -> None:
    """InputError if a matrix of (N, 4, 4) is no pose; NaN stands for what is not known."""
    bad = ~is_rigid(np.where(np.isnan(poses), np.eye(4), poses))
    if bad.any():
        raise InputError(
            f"{name}: expected matrices [R t; 0 0 0 1] with rotations R, got {bad.sum()} others of "
            f"{len(bad)}, first at {bad.argmax()}; are they transposed?"
        )


def check_increasing(trajectory: Trajectory, caller: str) -> None:
    """Raise InputError, ``caller: expected ...``, unless there is something to interpolate."""
    if len(trajectory) < 2:
        raise InputError(
            f"{caller}: expected 2 or more poses to interpolate between, got {len(trajectory)}"
        )
    repeated = np.flatnonzero(np.diff(trajectory.stamps) <= 0)
    if len(repeated):
        at = int(repeated[0]) + 1
        raise InputError(
            f"{caller}: expected increasing stamps, got {trajectory.stamps[at]} at index {at} "
            f"after {trajectory.stamps[at - 1]}; sort the poses and drop repeated ones"
        )
