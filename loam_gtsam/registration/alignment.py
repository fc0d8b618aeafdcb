"""Alignment of two point clouds in one call."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from loam_gtsam.config import Config, as_config
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.errors import is_number
from loam_gtsam.geometry import as_points, checked_pose, voxel_filter
from loam_gtsam.registration.association import associate
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.relocalization import Fit
from loam_gtsam.registration.solvers import GtsamSolver, MotionPrior, Solution
from loam_gtsam.registration.solvers.scan_error import scan_error
from loam_gtsam.registration.solvers.seen_ground import SeenGround
from loam_gtsam.types import FloatArray, InputError

_NONE = np.empty((0, 3))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Alignment:
    """The outcome of :func:`align`.

    Attributes
    ----------
    target_T_source : pose of the source cloud in the frame of the target cloud; the guess if
        ``solved`` is false
    covariance : (6, 6) of that pose, tangent order of the package, from the scatter of the matches;
        directions that the clouds do not fix keep the spread of what was known before. NaN if
        ``solved`` is false. Between two single sweeps of the built-in worlds the errors are 1.2
        times what it tells (root mean square)
    solved : whether enough points found a plane of the target
    converged : whether the last association still moved the pose by less than the stop rule
    overlap : share of the source points, one a voxel, that found a plane of the target
    agreement : share of these within three standard deviations of the plane; 0 without any. It
        tells a right pose from one that is merely solved: in seven built-in worlds 0.94 to 1 from
        a good guess, and at most 0.9 from one 3 to 6 m off, where ``weak`` is None
    weak : (6, 6) projector onto the directions that the clouds do not fix; None if all are fixed
    matches : matches of the last association
    """

    target_T_source: gtsam.Pose3
    covariance: FloatArray
    solved: bool
    converged: bool
    overlap: float
    agreement: float
    weak: FloatArray | None
    matches: ScanMatches

    def __repr__(self) -> str:
        found = ("converged" if self.converged else "not converged") if self.solved else "unsolved"
        position = self.target_T_source.translation().round(3).tolist()
        fit = f"overlap {self.overlap:.2f}, agreement {self.agreement:.2f}"
        return f"Alignment({found}, at {position} m, {fit})"


def align(
    source: ArrayLike,
    target: ArrayLike,
    guess: gtsam.Pose3 | None = None,
    config: Config | None = None,
    *,
    max_distance: float = 2.0,
) -> Alignment:
    """Align a point cloud with another one, point to plane.

    Parameters
    ----------
    source, target : (N, 3) and (M, 3) metres, each in its own frame, de-skewed; the source was
        seen from its origin, with z up along the axis of the lidar. Points that are not finite are
        left out, and so is a fourth column
    guess : ``target_T_source`` to start from; the identity if None
    config : ``map``, ``matching``, ``solver`` and ``covariance`` are used
    max_distance : metres to the farthest neighbour at first, at least ``matching.max_distance``,
        with which the solve then starts again. The guess must be nearer than that.

    Raises
    ------
    InputError
        If a cloud is no array of points, or has too few to match, or ``max_distance`` is no
        distance.

    Examples
    --------
    >>> found = align(source, target)  # doctest: +SKIP
    >>> found.target_T_source, np.sqrt(np.diag(found.covariance))  # doctest: +SKIP
    """
    config = as_config(config)
    if not (is_number(max_distance) and 0.0 < max_distance < np.inf):
        raise InputError(f"max_distance: expected metres above 0, got {max_distance!r}")
    source, target = _finite_points(source, "source"), _finite_points(target, "target")
    least = config.solver.min_matches
    for name, cloud in (("source", source), ("target", target)):
        if len(cloud) < least:
            raise InputError(f"{name}: expected at least {least} finite points, got {len(cloud)}")
    # Thinned alike, so that what voxels do to edges and curved ground is the same in both.
    points, surfaces = (
        voxel_filter(cloud, config.map.plane_voxel, oblique=True) for cloud in (source, target)
    )
    pose = gtsam.Pose3() if guess is None else checked_pose(guess, "guess")
    edges = CubeMap(config.map, config.map.edge_voxel)
    planes = CubeMap(config.map, config.map.plane_voxel)
    for cubes, cloud in ((edges, _NONE), (planes, surfaces)):
        cubes.recenter(pose.translation())
        cubes.insert(cloud)
    # Nothing is known before but that the clouds overlap.
    extent = max(float(np.ptp(target, axis=0).max()), config.map.plane_voxel)
    sigmas = np.repeat([np.pi, extent], 3)
    solver = GtsamSolver(config.solver)
    first = max(max_distance, config.matching.max_distance)
    for reach in (first, config.matching.max_distance):
        matching = config.matching.changed(max_distance=reach, max_planes=0)
        prior = MotionPrior(pose, np.diag(sigmas**-2.0))
        match = partial(associate, _NONE, points, edge_map=edges, plane_map=planes, config=matching)
        solution = solver.solve(match, pose, (), prior)
        pose = solution.map_T_lidar
    fit = Fit.of(solution.matches, len(points), config.matching.max_distance)
    return Alignment(
        pose,
        _covariance(solution, config),
        solution.solved,
        solution.converged,
        fit.share,
        fit.agreement,
        solution.weak,
        solution.matches,
    )


def _finite_points(cloud: ArrayLike, name: str) -> FloatArray:
    with suppress(ValueError):  # rows of different lengths, which as_points refuses
        cloud = np.asarray(cloud)
        if cloud.ndim == 2 and cloud.shape[1] in (3, 4) and cloud.dtype.kind == "f":
            cloud = cloud[np.isfinite(cloud[:, :3]).all(axis=1), :3]
    return as_points(cloud, name)


def _covariance(solution: Solution, config: Config) -> FloatArray:
    """The error of the source from its residuals, and that of the target, which is as new."""
    error = None
    if solution.solved:
        width, kernel = config.solver.kernel_width, config.solver.kernel
        error = scan_error(solution, width, SeenGround(), config.covariance, kernel=kernel)
    return np.full((6, 6), np.nan) if error is None else error.covariance + error.renewed
