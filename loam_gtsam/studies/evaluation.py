"""Trajectory errors, absolute and relative, and whether covariances are as large as the errors.

Positions are compared as evo compares them; orientations see :class:`AbsoluteError`. A reference of
positions alone (GPS) has NaN as its orientations; what needs them is then NaN or refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.decode.extrinsics import rigid_transform
from loam_gtsam.errors import check_count
from loam_gtsam.geometry import as_array, five_sigma, inverse_pose, transform
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.trajectory import check_increasing
from loam_gtsam.types import (
    FloatArray,
    FrameStatus,
    InputError,
    IntArray,
    MapUpdate,
    Trajectory,
    check_kind,
    check_updates,
)

_NO_SPREAD = 1e-9
"""Ratio of the second to the first singular value below which positions lie on a line (the ratio
of the spreads is its root: 3 cm across a line of a kilometre)."""
_LENGTHS = 8  # path lengths of the relative error, as in KITTI; multiples of one of these metres:
_LENGTH_UNITS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
_SPARSE_NS = 1_000_000_000  # between the poses of a reference that is not interpolated
FREEDOM = 6
"""Degrees of freedom of a pose."""
FIVE_SIGMA = five_sigma(FREEDOM)
"""Squared Mahalanobis distance of a pose that is as unlikely as five standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class AbsoluteError:
    """Absolute trajectory error (ATE).

    Attributes
    ----------
    rmse, median, maximum : metres, of the positions after alignment
    rotation_rmse_deg : degrees, of the orientations after the rotation that fits *them* best. The
        rotation that fits the positions leaves the roll about a straight path to their noise.
    translations : (N,) metres, error of each pose
    stamps : (N,) nanoseconds of the poses that were compared
    aligned : the N poses as they were compared, to be drawn beside ``reference.at(stamps)``; those
        of the ``point`` of the reference, if it has one
    """

    rmse: float
    median: float
    maximum: float
    rotation_rmse_deg: float
    translations: FloatArray
    stamps: IntArray
    aligned: Trajectory


def align_positions(
    estimate: FloatArray, reference: FloatArray, rotation: FloatArray | None = None
) -> FloatArray:
    """Rigid transform ``reference_T_estimate`` (4, 4) that best maps positions to a reference.

    See Umeyama, Least-squares estimation of transformation parameters, PAMI 13(4), 1991; no scale.

    Parameters
    ----------
    estimate, reference : (N, 3) metres
    rotation : (3, 3) decides what the positions leave open, the roll if they lie on a line or the
        whole rotation if they do not move; :func:`align_rotations` gives a good one; identity if
        None
    """
    mean_e, mean_r = estimate.mean(axis=0), reference.mean(axis=0)
    moments = (reference - mean_r).T @ (estimate - mean_e)
    spread = np.linalg.svd(moments, compute_uv=False)
    if spread[1] <= _NO_SPREAD * spread[0]:
        offered = np.eye(3) if rotation is None else rotation
        moments = moments + (_NO_SPREAD * spread[0] or 1.0) * offered
    result = np.eye(4)
    result[:3, :3] = _nearest_rotation(moments)
    result[:3, 3] = mean_r - result[:3, :3] @ mean_e
    return result


def align_rotations(estimate: FloatArray, reference: FloatArray) -> FloatArray:
    """Rotation ``reference_R_estimate`` (3, 3) that best maps orientations to a reference.

    See Hartley, Trumpf, Dai and Li, Rotation averaging, IJCV 103, 2013 (the chordal L2 mean).
    """
    return _nearest_rotation(np.einsum("nij,nkj->ik", reference, estimate))


def _nearest_rotation(matrix: FloatArray) -> FloatArray:
    u, _, vt = np.linalg.svd(matrix)
    rotation: FloatArray = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation


def matched_truth(trajectory: Trajectory, reference: Trajectory) -> Trajectory:
    """The reference at the stamps of a trajectory, for tools that pair equal stamps (evo).

    Poses outside the time span of the reference have none. Raises InputError if the stamps of the
    reference do not increase.
    """
    _check_both("matched_truth", trajectory, reference)
    stamps = trajectory.stamps
    inside = (stamps >= reference.stamps[0]) & (stamps <= reference.stamps[-1])
    common: IntArray = stamps[inside]
    return reference.at(common)


def absolute_error(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    aligned: bool | Literal["start"] = True,
) -> AbsoluteError:
    """Absolute error (ATE) of the poses inside the reference, interpolated at their stamps.

    Raises InputError if fewer than three poses overlap in time, the reference's stamps do not
    increase, or positions are not finite.

    Parameters
    ----------
    aligned : fit positions by a rigid transform (SE(3), :func:`align_positions`) and orientations
        by a rotation (:func:`align_rotations`) first. ``"start"``: move the estimate so that its
        first common pose is that of the reference, which hides no drift. False: compare the poses
        as they are.
    """
    from_start, fitted = _alignment(aligned)
    stamps, poses, truth = _common("absolute_error", estimate, reference)
    if from_start:
        _need_orientation("absolute_error", truth)
        poses = truth[0] @ inverse_pose(poses[:1]) @ poses
    poses = poses.copy()
    positions, rotations = poses[:, :3, 3], poses[:, :3, :3]
    if fitted and np.isfinite(truth).all():
        rotations[:] = align_rotations(rotations, truth[:, :3, :3]) @ rotations
    if fitted:
        positions[:] = transform(align_positions(positions, truth[:, :3, 3]), positions)
    errors = np.linalg.norm(positions - truth[:, :3, 3], axis=1)
    angles = _angles_deg(np.swapaxes(truth[:, :3, :3], 1, 2) @ rotations)
    median, maximum = float(np.median(errors)), float(errors.max())
    compared = Trajectory(stamps, poses)
    return AbsoluteError(_rms(errors), median, maximum, _rms(angles), errors, stamps, compared)


def _alignment(aligned: object) -> tuple[bool, bool]:
    """Whether the first poses are made one, and whether all are fitted."""
    if isinstance(aligned, (bool, np.bool_)):
        return False, bool(aligned)
    if isinstance(aligned, str) and aligned == "start":
        return True, False
    raise InputError(f"aligned: expected True, False or 'start', got {aligned!r}")


@dataclass(frozen=True, slots=True, eq=False)
class RelativeError:
    """Relative pose error (RPE) over path lengths, as in KITTI's odometry benchmark.

    Attributes
    ----------
    translation_percent, rotation_deg_per_m : mean over all pairs of all lengths
    lengths, pairs : (L,) metres along the reference, and number of pairs
    translations, rotations : (L,) mean of each length; NaN where there is no pair
    """

    translation_percent: float
    rotation_deg_per_m: float
    lengths: FloatArray
    pairs: IntArray
    translations: FloatArray
    rotations: FloatArray


def path_lengths(path: float) -> FloatArray:
    """Lengths in metres over which relative errors are taken on a path of ``path`` metres.

    They are u, 2 u, ... 8 u, where u is the largest of 0.1, 0.2, 0.5, 1, ... 100 m with 16 u <=
    ``path``; from 1600 m on, KITTI's 100, 200, ... 800 m. Raises InputError if the path is shorter
    than 1.6 m.
    """
    fitting = [unit for unit in _LENGTH_UNITS if 2 * _LENGTHS * unit <= path]
    if not fitting:
        raise InputError(
            f"no relative error: a path of {2 * _LENGTHS * _LENGTH_UNITS[0]:g} m or more is needed "
            f"for the usual lengths, this one has {path:.3g} m"
        )
    return fitting[-1] * np.arange(1.0, _LENGTHS + 1.0)


def relative_error(
    estimate: Trajectory, reference: Trajectory, lengths: FloatArray | None = None
) -> RelativeError:
    """Relative error (RPE) of the poses inside the reference, interpolated at their stamps.

    For each length d and each start i, the end j is the first pose more than d along the reference
    after i. With the relative motions Q of the reference and P of the estimate, ``E = Q^-1 P``
    counts ``|translation(E)| / d`` and ``angle(E) / d``. KITTI's development kit takes every tenth
    pose as a start; here every pose is one. Raises InputError if fewer than three poses overlap in
    time, the reference's stamps do not increase, or the path is too short for any pair. See Geiger,
    Lenz and Urtasun, Are we ready for autonomous driving?, CVPR 2012, section 2.4.

    Parameters
    ----------
    lengths : (L,) metres along the reference; :func:`path_lengths` of its path if None
    """
    _, poses, truth = _common("relative_error", estimate, reference)
    _need_orientation("relative_error", truth)
    travelled = distance_travelled(truth[:, :3, 3])
    path = float(travelled[-1])
    lengths = path_lengths(path) if lengths is None else as_array(lengths, "lengths", ("L",))
    translations, rotations = [], []
    for length in lengths:
        ends = np.searchsorted(travelled, travelled + length, side="right")
        starts = np.flatnonzero(ends < len(travelled))
        ends = ends[starts]
        wanted = inverse_pose(truth[starts]) @ truth[ends]
        error = inverse_pose(wanted) @ inverse_pose(poses[starts]) @ poses[ends]
        translations.append(100.0 / length * np.linalg.norm(error[:, :3, 3], axis=1))
        rotations.append(_angles_deg(error[:, :3, :3]) / length)
    pairs = np.array([len(errors) for errors in translations], np.int64)
    if not pairs.sum():
        raise InputError(
            f"relative_error: expected lengths below the path of {path:.3g} m, got "
            f"{', '.join(f'{length:g}' for length in lengths) or 'none'}"
        )
    return RelativeError(
        translation_percent=float(np.mean(np.concatenate(translations))),
        rotation_deg_per_m=float(np.mean(np.concatenate(rotations))),
        lengths=lengths,
        pairs=pairs,
        translations=np.array([e.mean() if len(e) else np.nan for e in translations]),
        rotations=np.array([e.mean() if len(e) else np.nan for e in rotations]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Nees:
    """Normalised estimation error squared: errors of poses held against their covariances.

    Attributes
    ----------
    mean : mean of ``squared`` over the six degrees of freedom: 1 if the covariances are right,
        larger if they are too small, infinite if one is broken; NaN without samples
    frames : (N,) numbers of the frames, solved ones with a covariance, and reference poses at both
        ends of the window
    squared : (N,) squared Mahalanobis distances of the errors; infinite where the covariance is
        not positive definite
    errors, sigmas : (N, 6) errors in rad and m, in the tangent at the pose, and the standard
        deviations that were told of them
    """

    mean: float
    frames: IntArray
    squared: FloatArray
    errors: FloatArray
    sigmas: FloatArray

    @property
    def beyond(self) -> IntArray:
        """(M,) numbers of the frames that are off by more than five told standard deviations."""
        return self.frames[self.squared > FIVE_SIGMA]

    @property
    def broken(self) -> int:
        """Number of covariances that are not positive definite."""
        return int(np.isinf(self.squared).sum())


def nees(updates: Sequence[MapUpdate], reference: Trajectory, *, window: int = 0) -> Nees:
    """Errors of poses, or of motions over a window, held against the covariances that were told.

    See Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation,
    2001, section 5.4.

    Parameters
    ----------
    updates : of a run, in order; without corrections of loop closures, which have no covariance
        here
    reference : interpolated at the stamps of the updates, which costs centimetres where its poses
        are a sweep apart and ``deskew.reference`` is ``middle``: give one at these stamps
        (``SimulatedWorld.truth_at``)
    window : motions over so many frames, with :func:`~loam_gtsam.relative_covariance`; 0 for poses
        since the first frame inside the reference, with ``MapUpdate.covariance``; what is lost
        before the first fix of a localisation is left out

    Raises
    ------
    InputError
        If no update lies inside the reference, its stamps do not increase, or it has positions
        alone.
    """
    check_updates(updates, "nees: updates")
    check_count(window, "nees: window")
    check_kind(reference, Trajectory, "nees: reference", "the truth of a data set is one")
    check_increasing(reference, "nees")
    first, last = reference.stamps[0], reference.stamps[-1]
    inside = [n for n, u in enumerate(updates) if u.status.has_pose and first <= u.stamp <= last]
    if not inside:
        raise InputError(f"nees: expected poses inside {first} to {last} ns, got none")
    statuses = {n: updates[n].status for n in inside}
    placed = (n for n, status in statuses.items() if status.solved or status is FrameStatus.FIRST)
    begin = next(placed, inside[0])  # none is placed before the fix of localise
    inside = [n for n in inside if n >= begin]
    chosen = [updates[n] for n in inside]
    truth = reference.at([update.stamp for update in chosen])
    _need_orientation("nees", truth.map_T_lidar)
    found = dict(_errors(chosen, list(truth), window))
    squared = np.array([_mahalanobis(*pair) for pair in found.values()], np.float64)
    errors = np.array([error for error, _ in found.values()]).reshape(-1, 6)
    variances = np.array([np.diag(covariance) for _, covariance in found.values()]).reshape(-1, 6)
    mean = float(squared.mean()) / FREEDOM if len(squared) else np.nan
    numbers = np.array([inside[k] for k in found], np.int64)
    return Nees(mean, numbers, squared, errors, np.sqrt(np.maximum(variances, 0.0)))


def squared_errors(
    updates: Sequence[MapUpdate], true: Sequence[gtsam.Pose3], window: int = 0
) -> dict[int, float]:
    """Squared Mahalanobis distances by the index of the later frame, as in :class:`Nees`.

    ``true`` are the poses of the updates; the window is that of :func:`nees`.
    """
    return {k: _mahalanobis(*pair) for k, pair in _errors(updates, true, window)}


def _errors(
    updates: Sequence[MapUpdate], true: Sequence[gtsam.Pose3], window: int
) -> Iterator[tuple[int, tuple[FloatArray, FloatArray]]]:
    """Errors (6,) and covariances (6, 6), by the index of the later frame."""
    for k in range(window or 1, len(updates)):
        start = k - window if window else 0
        before, now = updates[start], updates[k]
        if now.uncertainty is None or (window and before.uncertainty is None):
            continue
        covariance = relative_covariance(before, now) if window else now.covariance
        moved = before.map_T_lidar.between(now.map_T_lidar)
        yield k, (moved.localCoordinates(true[start].between(true[k])), covariance)


def _mahalanobis(error: FloatArray, covariance: FloatArray) -> float:
    """Squared; infinite if the covariance is none."""
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return np.inf
    whitened = np.linalg.solve(root, error)
    return float(whitened @ whitened)


def pose_differences(
    estimate: Trajectory, reference: Trajectory
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Distances between two trajectories, pose by pose, both seen from their first common moment.

    Gives stamps, metres and degrees, (N,) each, of the poses inside the reference's time span.
    Raises InputError as :func:`absolute_error` does.
    """
    stamps, poses, others = _common("pose_differences", estimate, reference)
    _need_orientation("pose_differences", others)
    here, there = inverse_pose(poses[:1]) @ poses, inverse_pose(others[:1]) @ others
    metres = np.linalg.norm(here[:, :3, 3] - there[:, :3, 3], axis=1)
    rotation = np.swapaxes(there[:, :3, :3], 1, 2) @ here[:, :3, :3]
    return stamps, metres, _angles_deg(rotation)


def distance_travelled(positions: FloatArray) -> FloatArray:
    """Distances (N,) in metres from the start along positions (N, 3)."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    travelled: FloatArray = np.concatenate(([0.0], np.cumsum(steps)))[: len(positions)]
    return travelled


def _common(
    caller: str, estimate: Trajectory, reference: Trajectory
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Stamps, poses of the estimate where the reference has any, and those of the reference.

    The stamps are those of the estimate inside the reference's time span. A sparse reference, as of
    surveyed points at which the lidar stands, is not interpolated: then they are its own.
    """
    _check_both(caller, estimate, reference)
    if len(reference) > 1 and np.median(np.diff(reference.stamps)) > _SPARSE_NS:
        fine, coarse, which = estimate, reference, "points of the sparse reference, inside the run"
    else:
        fine, coarse, which = reference, estimate, "poses inside the reference"
    inside = (coarse.stamps >= fine.stamps[0]) & (coarse.stamps <= fine.stamps[-1])
    if inside.sum() < 3:
        raise InputError(
            f"{caller}: expected 3 or more {which}'s time span {fine.stamps[0]} to "
            f"{fine.stamps[-1]} ns, got {int(inside.sum())}"
        )
    compared = estimate.map_T_lidar[inside] if coarse is estimate else estimate.map_T_lidar
    unknown = ~np.isfinite(compared).all(axis=(1, 2))
    if unknown.any():
        raise InputError(
            f"{caller}: expected poses of finite numbers, got {int(unknown.sum())} of "
            f"{len(compared)} that are not; leave them out"
        )
    nowhere = np.flatnonzero(~np.isfinite(reference.positions).all(axis=1))
    if len(nowhere):
        raise InputError(
            f"{caller}: expected a reference with positions of finite numbers, got "
            f"{len(nowhere)} of {len(reference)} that are not, the first of them at "
            f"{reference.stamps[nowhere[0]]} ns; leave them out"
        )
    stamps = coarse.stamps[inside]
    poses, truth = compared, fine.at(stamps).map_T_lidar
    if coarse is reference:
        poses, truth = truth, reference.map_T_lidar[inside]
    if reference.point is not None:
        poses = poses @ rigid_transform(Rotation.identity(), reference.point)
    return stamps, poses, truth


def _check_both(caller: str, estimate: Trajectory, reference: Trajectory) -> None:
    for trajectory in (estimate, reference):
        check_kind(trajectory, Trajectory, caller, "a run and a data set have one")
    check_increasing(reference, caller)


def _angles_deg(rotations: FloatArray) -> FloatArray:
    if not len(rotations) or not np.isfinite(rotations).all():
        return np.full(len(rotations), np.nan)
    angles: FloatArray = np.degrees(Rotation.from_matrix(rotations).magnitude())
    return angles


def _need_orientation(caller: str, truth: FloatArray) -> None:
    if not np.isfinite(truth).all():
        raise InputError(
            f"{caller}: expected reference poses with orientation, got positions alone; only the "
            "absolute error of positions can be taken"
        )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
