"""Degenerate directions: the motions of the sensor about which the matches of a scan say nothing.

A thousand noisy normals on the bare walls of a corridor seem to fix the position along it. The
noise of the normals tells this false information from the real one: docs/maths/degeneracy.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from loam_gtsam.config import SolverConfig
from loam_gtsam.factors import complement_basis
from loam_gtsam.geometry import cross, cross_matrix, squared_norm
from loam_gtsam.registration.matches import EdgeMatches, ScanMatches, subset
from loam_gtsam.types import FloatArray

_CLEAR = 3.0  # sigmas of a normal by which a displacement must leave its surface to be seen
_MOVED = 0.1
"""Share of the root mean square displacement by which a point must move to count in full: points on
a pole move by millimetres in a turn about the pole, and say nothing about this turn."""
_STILL = 0.01
"""Metres by which a motion of one rad or metre moves the matched points (root mean square), at
least: a turn about the only few points there are does not move them at all."""
_RANK = 1e-6  # singular value over the largest one, below which there is no direction
_PARTS = 6.0
"""Times ``min_aligned`` matches in the weakest direction: then each sixth of a sweep would fix the
pose, and what these parts differ by tells a velocity. Sparse terrain has half of that."""
_HELD = 0.5  # share of ``min_aligned`` that lines alone must reach before planes are left out


@dataclass(frozen=True, slots=True, eq=False)
class Localizability:
    """How well a scan fixes its pose, by direction, the weakest first.

    Attributes
    ----------
    directions : (6, 6) rows, tangent vectors at the pose (rad, m), each scaled to move the matched
        points by 1 m (root mean square), as far as it moves them
    aligned : (6,) number of matches that fix each direction: the sum of squared cosines between
        normal and displacement, over the matches that see the motion at all
    information : (6,) information of the scan along each direction, 1 / m^2, noise included
    displacement : (6, 6) quadratic form: the mean squared displacement of the matched points by a
        motion, m^2
    by_planes : (6,) the part of ``aligned`` that comes from planes
    tilt : standard deviation of the matches' normals, rad (root mean square)
    over_noise : (6,) the same information of all matches that do not see the motion, each by
        itself, over what noise alone would make of it
    """

    directions: FloatArray
    aligned: FloatArray
    information: FloatArray
    displacement: FloatArray
    by_planes: FloatArray
    tilt: float
    over_noise: FloatArray

    def seen_from(self, a_T_b: gtsam.Pose3) -> Localizability:
        """The localizability about frame ``a``, of that about frame ``b``, fixed to each other."""
        to_a, to_b = a_T_b.AdjointMap(), a_T_b.inverse().AdjointMap()
        form: FloatArray = to_b.T @ self.displacement @ to_b
        return replace(self, directions=self.directions @ to_a.T, displacement=form)

    def axes(self) -> FloatArray:
        """(6,) aligned matches that fix rx, ry, rz, x, y, z, with the other five left free.

        The directions v and their counts a make the form ``(sum v v^T / a)^-1``. The result is the
        Schur complement of each axis in this form, for a motion along the axis that displaces the
        matched points by 1 m. A direction counts at least one match. Otherwise an axis a fraction
        of a degree off a direction without matches would have none either. So does a turn about an
        axis on which all points are.
        """
        spread = (self.directions**2 / np.maximum(self.aligned, 1.0)[:, None]).sum(axis=0)
        moved = np.maximum(np.diagonal(self.displacement), _STILL**2)
        counts: FloatArray = 1.0 / (spread * moved)
        return counts

    def weak(self, least: float) -> FloatArray:
        """(W, 6) the directions with fewer aligned matches than ``least``."""
        chosen: FloatArray = self.directions[self.aligned < least]
        return chosen

    def without_noise(self, blind: FloatArray, shared: float) -> FloatArray:
        """(6, 6) what a projector onto blind directions would be without noise of the normals.

        By noise, an eigenvector is a translation with a little of a rotation that the scan sees
        well. Over a long blind way that little would turn the pose. A direction whose rotation is
        within three standard deviations of its noise (:meth:`wander`) is taken for a translation,
        unless it moves the points by turning more than by translation: then it is a turn.

        ``shared`` is the number of matches over that of independent ones.
        """
        form, turns = self.displacement, self.displacement[:3, :3]
        basis = spanned(blind)
        basis = basis @ np.linalg.inv(np.linalg.cholesky(basis.T @ form @ basis)).T
        basis = basis @ np.linalg.eigh(basis[:3].T @ turns @ basis[:3])[1]
        share = np.einsum("ik,ij,jk->k", basis[:3], turns, basis[:3])
        pure = basis.copy()
        limit = _CLEAR**2 * shared * np.trace(turns @ self._turned_by_noise()[:3, :3])
        pure[:3, share < min(limit, 0.5)] = 0.0
        rows = basis.T @ form @ blind
        # The shares that the expected motion decides, the eigenvalues, stay.
        cleaned: FloatArray = pure @ rows @ basis @ np.linalg.solve(rows @ pure, rows)
        return cleaned

    def wander(self, moved: FloatArray) -> FloatArray:
        """(6, 6) covariance of what a motion along a weak direction does along the others.

        The noise of the normals turns a weak direction v towards another one, w, by c, of variance
        ``tilt^2 / aligned`` of w (first-order perturbation of eigenvectors). Of pure translations,
        it can only do so towards other translations. ``moved`` is the (6, 6) covariance of the
        motion.
        """
        spread = self._turned_by_noise()
        turned = float(np.trace(self.displacement[:3, :3] @ moved[:3, :3]))
        shifted = np.zeros((6, 6))
        shifted[3:, 3:] = np.trace(moved[3:, 3:]) * np.linalg.inv(np.linalg.inv(spread)[3:, 3:])
        wander: FloatArray = turned * spread + shifted
        return wander

    def _turned_by_noise(self) -> FloatArray:
        counts = np.maximum(self.aligned, 1.0) / max(self.tilt, _RANK) ** 2
        spread: FloatArray = (self.directions.T / counts) @ self.directions
        return spread

    def projector(self, least: float) -> FloatArray | None:
        """(6, 6) projector onto the weak directions along the others, None if there are none."""
        found = self.between(-1.0, least)
        return None if found is None else found.projector

    def between(self, least: float, most: float) -> Directions | None:
        """Directions with at least ``least`` and fewer than ``most`` aligned matches, if any."""
        mask = (self.aligned >= least) & (self.aligned < most)
        if not mask.any():
            return None
        shares: FloatArray = np.linalg.inv(self.directions.T).astype(np.float64, copy=False)
        return Directions(self.directions[mask], shares[mask], self.over_noise[mask])


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """Some motions, and how each motion is made up of these and of others.

    Attributes
    ----------
    vectors : (W, 6) rows, tangent vectors as in :class:`Localizability`
    shares : (W, 6) rows whose products with a tangent vector are its coefficients
    over_noise : (W,) as of :class:`Localizability`; None if it is not known
    """

    vectors: FloatArray
    shares: FloatArray
    over_noise: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.vectors)

    @property
    def projector(self) -> FloatArray:
        """(6, 6) projector onto these directions along the others."""
        projector: FloatArray = self.vectors.T @ self.shares
        return projector


def localizability(matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> Localizability:
    """Find the directions along which the information stands out least from that of noise alone.

    With u the displacement of a point by a motion, n the normal and s its standard deviation in
    rad, a match contributes ``(n . u)^2`` to the information, of which ``s^2 |u|^2`` is noise. The
    directions are the generalised eigenvectors of the two sums. Matches with
    ``|n . u| > 3 s |u|`` see the motion. A distinct line counts as two planes, others not at all.

    ``map_T_lidar`` is the pose at which the matches were made.
    """
    points, normals, tilts, weights = _as_planes(matches, map_T_lidar)
    rows = np.hstack([cross(points.T, normals.T).T, normals])
    information = rows.T @ (rows * (weights**2)[:, None])
    noise = displacements(points, (weights * tilts) ** 2)
    unit = displacements(points, np.full(len(points), 1.0 / max(len(points), 1)))
    floor = np.finfo(np.float64).eps * (np.trace(noise) + 1.0)
    columns = _eigenvectors(information, noise + floor * (unit + np.eye(6)))
    moved = np.sqrt(np.maximum(np.einsum("ik,ij,jk->k", columns, unit, columns), 0.0))
    directions = columns.T / np.maximum(moved, _STILL * np.linalg.norm(columns, axis=0))[:, None]

    squared, moved = _cosines(points, normals, directions)
    sight = _clear(squared, tilts)
    first = len(sight) - len(matches.planes)
    aligned, by_planes = sight.sum(axis=0), sight[first:].sum(axis=0)
    order = np.argsort(aligned, kind="stable")
    along = np.einsum("ki,ij,kj->k", directions, information, directions)
    told = (np.where(sight > 0.0, 0.0, squared) * moved).T @ weights**2
    of_noise = moved.T @ (weights * tilts) ** 2 + floor
    tilt = float(np.sqrt(np.mean(tilts**2))) if len(tilts) else 0.0
    return Localizability(
        directions[order], aligned[order], along[order],
        unit, by_planes[order], tilt, (told / of_noise)[order],
    )  # fmt: skip


def spanned(projector: FloatArray) -> FloatArray:
    """(6, W) orthonormal columns that span the motions that a (6, 6) projector leaves."""
    columns, sizes, _ = np.linalg.svd(projector)
    basis: FloatArray = columns[:, sizes > _RANK * sizes[0]]
    return basis


def tells_motion(seen: Localizability, config: SolverConfig) -> bool:
    """Whether a sweep of some localizability tells how fast its pose changes."""
    return bool(seen.aligned[0] >= _PARTS * config.min_aligned)


def unseen_by_planes(
    matches: ScanMatches, map_T_lidar: gtsam.Pose3, seen: Localizability, least: float
) -> Directions | None:
    """The motions that planes alone do not fix, if these are to be left to the lines.

    On rough ground the few lines of poles show how far the pose is off. The thousand planes of the
    ground do not show it: by noise they hold the pose where it was, and they outweigh the poles.

    ``seen`` is the same of planes and lines together, ``least`` as in :meth:`Localizability.weak`.
    None if planes alone fix all directions, or do so with lines that see too little on their own.
    """
    if seen.by_planes.min() >= least:
        return None
    no_lines = subset(matches.edges, np.zeros(len(matches.edges), np.bool_))
    planes = localizability(replace(matches, edges=no_lines), map_T_lidar)
    unseen = planes.between(-1.0, least)
    if unseen is None:
        return None
    lines = line_sight(matches.edges, map_T_lidar, unseen.vectors).sum(axis=0)
    held = seen.aligned[0] < least or lines.min() >= _HELD * least
    return unseen if held else None


def by_lines(
    matches: ScanMatches, map_T_lidar: gtsam.Pose3, unseen: Directions, least: float
) -> tuple[Directions | None, Directions | None]:
    """Motions that planes do not fix: those that lines do not fix either, and those that they fix.

    Lines come and go between one association and the next. So this is to be asked for the matches
    of every association: a direction that is left to lines must have some.

    ``unseen`` is of :func:`unseen_by_planes`, ``least`` as in :meth:`Localizability.weak`.
    """
    among = _mixed(matches.edges, map_T_lidar, unseen)
    lines = line_sight(matches.edges, map_T_lidar, among.vectors).sum(axis=0)
    p = matches.planes
    normals = p.normals @ map_T_lidar.rotation().matrix()
    tilts = np.zeros(len(p)) if p.tilts is None else p.tilts
    planes = _sight(p.points, normals, tilts, among.vectors).sum(axis=0)
    left = (lines < _HELD * least) | (lines + planes < least)
    parts = [
        Directions(among.vectors[mask], among.shares[mask]) if mask.any() else None
        for mask in (left, ~left)
    ]
    return parts[0], parts[1]


def _mixed(edges: EdgeMatches, map_T_lidar: gtsam.Pose3, unseen: Directions) -> Directions:
    """The same motions as others that span the same space, of which lines see each as it is."""
    points, normals, tilts = _planes_through(edges)
    normals = normals @ map_T_lidar.rotation().matrix()
    keep = np.repeat(np.ones(len(edges), np.bool_) if edges.distinct is None else edges.distinct, 2)
    points, normals, tilts = points[keep], normals[keep], tilts[keep]
    across = np.hstack([cross(points.T, normals.T).T, normals]) @ unseen.vectors.T
    noise = unseen.vectors @ displacements(points, tilts**2) @ unseen.vectors.T
    columns = _eigenvectors(across.T @ across, noise + np.eye(len(unseen)))
    columns = columns / np.linalg.norm(columns, axis=0)
    vectors: FloatArray = columns.T @ unseen.vectors
    return Directions(vectors, np.linalg.inv(columns) @ unseen.shares)


def line_sight(edges: EdgeMatches, map_T_lidar: gtsam.Pose3, directions: FloatArray) -> FloatArray:
    """(E, W) what each line counts, for each of (W, 6) motions, in ``Localizability.aligned``."""
    points, normals, tilts = _planes_through(edges)
    sight = _sight(points, normals @ map_T_lidar.rotation().matrix(), tilts, directions)
    sight = sight[0::2] + sight[1::2]
    if edges.distinct is not None:
        sight[~edges.distinct] = 0.0
    return sight


def _as_planes(
    matches: ScanMatches, map_T_lidar: gtsam.Pose3
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Points, normals, tilts, weights of distinct lines' rows and of planes; axes of the lidar."""
    e, p = matches.edges, matches.planes
    if e.distinct is not None:
        e = subset(e, e.distinct)
    points, normals, tilts = _planes_through(e)
    points, normals = np.concatenate([points, p.points]), np.concatenate([normals, p.normals])
    tilts = np.concatenate([tilts, np.zeros(len(p)) if p.tilts is None else p.tilts])
    weights = np.concatenate([np.repeat(e.weights / e.sigmas, 2), p.weights / p.sigmas])
    return points, normals @ map_T_lidar.rotation().matrix(), tilts, weights


def _planes_through(lines: EdgeMatches) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points, normals in the map frame and tilts of two planes through each line."""
    tilts = np.zeros(len(lines)) if lines.tilts is None else lines.tilts
    normals = complement_basis(lines.directions).reshape(-1, 3)
    return np.repeat(lines.points, 2, axis=0), normals, np.repeat(tilts, 2)


def _sight(
    points: FloatArray, normals: FloatArray, tilts: FloatArray, directions: FloatArray
) -> FloatArray:
    """(N, W) squared cosines between normals and displacements; 0 where noise may make them."""
    return _clear(_cosines(points, normals, directions)[0], tilts)


def _clear(squared: FloatArray, tilts: FloatArray) -> FloatArray:
    return np.where(squared > (_CLEAR * tilts[:, None]) ** 2, squared, 0.0)


def _cosines(
    points: FloatArray, normals: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(N, W) squared cosines between normals and displacements, and squared displacements."""
    turn, shift = directions[:, :3], directions[:, 3:]
    seen = cross(points.T, normals.T).T @ turn.T + normals @ shift.T
    # |shift + turn x p|^2 for all points and directions, as products of small matrices
    moved = np.outer(squared_norm(points.T), squared_norm(turn.T)) - (points @ turn.T) ** 2
    moved += 2.0 * points @ cross(shift.T, turn.T) + squared_norm(shift.T)
    moved = np.maximum(moved, _MOVED**2)
    squared: FloatArray = seen**2 / moved
    return squared, moved


def _eigenvectors(form: FloatArray, noise: FloatArray) -> FloatArray:
    """(6, 6) generalised eigenvectors of two forms, as columns; a third of scipy's time."""
    inverse = np.linalg.inv(np.linalg.cholesky(noise))
    columns: FloatArray = inverse.T @ np.linalg.eigh(inverse @ form @ inverse.T)[1]
    return columns


def displacements(points: FloatArray, weights: FloatArray) -> FloatArray:
    """(6, 6) form: the weighted sum of the points' squared displacements by a motion.

    Parameters
    ----------
    points : (N, 3) metres
    weights : (N,)
    """
    second = (points * weights[:, None]).T @ points
    form = np.zeros((6, 6))
    form[:3, :3] = np.trace(second) * np.eye(3) - second
    form[:3, 3:] = cross_matrix(weights @ points)
    form[3:, :3] = form[:3, 3:].T
    form[3:, 3:] = weights.sum() * np.eye(3)
    return form
