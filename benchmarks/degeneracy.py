"""Who finds unseen motions, and what a policy makes of them: ``python -m benchmarks.degeneracy``.

Sweeps of built-in places whose unseen motions are known exactly, in maps that were put together at
the true poses. Every detector judges the same matches, and every policy takes one step from them:
from a guess that is off by centimetres, with an expected pose of known covariance.

Zhang, Kaess and Singh, On Degeneracy of Optimization-based State Estimation Problems, ICRA 2016;
Tuna et al., X-ICP, arXiv 2211.16335, and Informed, Constrained, Aligned, arXiv 2408.11809; DCReg,
arXiv 2509.06285.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from benchmarks.tables import markdown_table, write_rows
from loam_gtsam.config import Config, preset
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.frontend.deskew import MovingSweep, PosedSweep
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.pipeline import effective_config
from loam_gtsam.registration.association import associate
from loam_gtsam.registration.degeneracy import localizability, spanned
from loam_gtsam.registration.frame_matcher import MapPair
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.registration.solvers import MotionPrior, match_rows
from loam_gtsam.registration.solvers.classical import degeneracy_projector, loam_rows
from loam_gtsam.types import FloatArray

UNSEEN: dict[str, list[list[float]]] = {
    "corridor_bare": [[0, 0, 0, 1, 0, 0]],
    "tunnel": [[0, 0, 0, 1, 0, 0], [1, 0, 0, 0, 3, 0]],
    "open_field": [[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 1, 0]],
    "single_plane": [[0, 1, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, 1]],
    "single_pole": [[0, 0, 1, 0, 0, 0]],
    "room": [],
    "trees": [],
    "street_loop": [],
}
"""Motions about the world's origin that no beam shows, [rotation, translation]."""
FIRST = {"corridor_bare": 250}  # out of sight of the ends; else the platform is under way at 50
MAPPED = 12  # sweeps in the map
TRUE_WITHIN = 15.0  # degrees within which a direction that was found is a true one
GUESS = np.repeat([0.005, 0.05], 3)  # standard deviations of the guess, rad and m
EXPECTED = np.repeat([0.002, 0.02], 3)  # of the expected pose
MISTAKE = 0.1  # metres: the bound on a step along a weak direction, of ``constraint``
CLAMP = 0.1  # least eigenvalue of the preconditioner over the largest, of ``precondition``
ROUNDS = 3  # of conjugate gradients, of ``precondition``


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One linear problem: ``information @ step = right``, and what may help along weak directions.

    Attributes
    ----------
    information, right : (6, 6) and (6,) of the matches at the guess
    weak : (6, 6) projector onto the weak directions along the others
    expected, precision : (6,) step to the expected pose, and its (6, 6) information
    form : (6, 6) mean squared displacement of the points, by which rad and m are compared
    """

    information: FloatArray
    right: FloatArray
    weak: FloatArray
    expected: FloatArray
    precision: FloatArray
    form: FloatArray

    @property
    def rank(self) -> int:
        """Number of weak directions."""
        return round(float(np.trace(self.weak)))


Policy = Callable[[Step], tuple[FloatArray, FloatArray]]
"""Gives the (6,) step and the (6, 6) covariance that it claims; zero where it claims none."""


def off(step: Step) -> tuple[FloatArray, FloatArray]:
    """Believe the scan."""
    covariance = np.linalg.pinv(step.information, hermitian=True).astype(np.float64)
    return covariance @ step.right, covariance


def prior(step: Step) -> tuple[FloatArray, FloatArray]:
    """The expected pose as a factor along weak directions, the scan along the others."""
    keep = np.eye(6) - step.weak
    added = MotionPrior(gtsam.Pose3(), step.precision).along(step.weak).information
    covariance = np.linalg.inv(keep.T @ step.information @ keep + added).astype(np.float64)
    return covariance @ (keep.T @ step.right + added @ step.expected), covariance


def project(step: Step) -> tuple[FloatArray, FloatArray]:
    """Solution remapping (Zhang et al. 2016): the weak part is that of the expected pose."""
    found, covariance = off(step)
    keep = np.eye(6) - step.weak
    expected = step.weak @ np.linalg.inv(step.precision) @ step.weak.T
    return keep @ found + step.weak @ step.expected, keep @ covariance @ keep.T + expected


def tsvd(step: Step) -> tuple[FloatArray, FloatArray]:
    """Truncated eigenvectors of the information: as many as are weak stay at the guess."""
    values, vectors = np.linalg.eigh(step.information)
    inverse = np.where(np.arange(6) < step.rank, 0.0, 1.0 / np.maximum(values, 1e-12))
    covariance = (vectors * inverse) @ vectors.T
    return covariance @ step.right, covariance


def tikhonov(step: Step) -> tuple[FloatArray, FloatArray]:
    """Weak directions are drawn to the guess, with the mean information of all (by hand)."""
    penalty = np.trace(step.information) / np.trace(step.form)
    total = step.information + penalty * step.weak.T @ step.form @ step.weak
    covariance = np.linalg.inv(total)
    return covariance @ step.right, covariance


def constraint(step: Step) -> tuple[FloatArray, FloatArray]:
    """Least squares with the step along weak directions bounded (Tuna et al. 2024)."""
    found, covariance = off(step)
    along = step.weak @ found
    size = float(np.sqrt(along @ step.form @ along))
    if size <= MISTAKE:
        return found, covariance
    held = step.weak @ (along * MISTAKE / size)
    keep = np.eye(6) - step.weak
    inside = np.linalg.pinv(keep.T @ step.information @ keep, hermitian=True)
    return held + keep @ inside @ keep.T @ (step.right - step.information @ held), covariance


def precondition(step: Step) -> tuple[FloatArray, FloatArray]:
    """A few conjugate gradients with clamped eigenvalues of the preconditioner (as DCReg)."""
    root = np.linalg.inv(np.linalg.cholesky(step.form + 1e-9 * np.eye(6)))
    values, vectors = np.linalg.eigh(root @ step.information @ root.T)
    columns = root.T @ vectors
    inverse = (columns / np.maximum(values, CLAMP * values[-1])) @ columns.T
    x, residual = np.zeros(6), step.right
    way = inverse @ residual
    for _ in range(ROUNDS):
        along = step.information @ way
        reduced = float(residual @ inverse @ residual)
        if reduced <= 0.0:
            break
        x = x + reduced / float(way @ along) * way
        residual = residual - reduced / float(way @ along) * along
        way = inverse @ residual + float(residual @ inverse @ residual) / reduced * way
    return x, off(step)[1]


POLICIES: tuple[Policy, ...] = (prior, project, tsvd, tikhonov, constraint, precondition, off)


def by_aligned(matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> FloatArray | None:
    """The weak directions of this package."""
    return localizability(matches, map_T_lidar).projector(Config().solver.min_aligned)


def by_eigenvalue(matches: ScanMatches, map_T_lidar: gtsam.Pose3) -> FloatArray | None:
    """LOAM's: eigenvalues of the normal matrix below 100."""
    jacobian = loam_rows(matches, map_T_lidar).residuals(map_T_lidar)[1]
    kept = degeneracy_projector(jacobian.T @ jacobian, preset("loam").solver.degeneracy_threshold)
    weak: FloatArray = np.eye(6) - kept
    return weak if np.trace(weak) > 0.5 else None


DETECTORS = {"aligned": by_aligned, "eigenvalue": by_eigenvalue}


@dataclass(frozen=True, slots=True)
class Detection:
    """A detector in one world: all directions of all sweeps. The angles are in degrees."""

    world: str
    detector: str
    sweeps: int
    unseen: int
    precision: float
    recall: float
    angle: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """A policy in one world: errors as displacements of the points, root mean square, metres.

    ``nees`` are per direction, along the unseen motions and across them; 1 is right.
    """

    world: str
    policy: str
    sweeps: int
    unseen_m: float
    seen_m: float
    unseen_nees: float
    seen_nees: float


class Place:
    """A world, its map from true poses, and the sweeps that are matched with it."""

    def __init__(self, name: str, seed: int, sweeps: int, columns: int | None) -> None:
        self.first = FIRST.get(name, 50)
        frames = self.first + MAPPED + sweeps
        self.world = SimulatedWorld(name, seed=seed, frames=frames, columns=columns)
        self.config = effective_config(Config(), self.world)
        self.unseen = np.array(UNSEEN[name], np.float64).reshape(-1, 6)
        self.maps = MapPair(self.config)
        for number in range(self.first, self.first + MAPPED):
            posed, middle = self.sweep(number)
            self.maps.recenter(middle)
            self.maps.insert(posed, middle, 0)

    def sweep(self, number: int) -> tuple[PosedSweep, gtsam.Pose3]:
        """A sweep, de-skewed with the true motion, and the true pose of its middle."""
        moving = MovingSweep(extract_features(self.world[number], self.config), self.config, None)
        reference, middle = moving.reference_stamp, moving.stamp
        poses = self.world.truth_at(np.array([reference, middle, 2 * middle - reference]))
        first, half, last = (gtsam.Pose3(pose) for pose in poses.map_T_lidar)
        twist = gtsam.Pose3.Logmap(first.between(last)) / (2e-9 * (middle - reference))
        return moving.at(twist), half

    def matches(self, posed: PosedSweep, map_T_lidar: gtsam.Pose3) -> ScanMatches:
        """The matches of a sweep at a pose."""
        maps = self.maps.edges, self.maps.planes
        distinct = posed.sweep.distinct
        return associate(*posed.points, map_T_lidar, *maps, self.config.matching, distinct)

    def unseen_at(self, map_T_lidar: gtsam.Pose3) -> FloatArray:
        """(W, 6) the unseen motions as tangent vectors at a pose."""
        world_T_lidar = gtsam.Pose3(self.world.world_T_start).compose(map_T_lidar)
        return self.unseen @ world_T_lidar.inverse().AdjointMap().T


def cosines(found: FloatArray, true: FloatArray, form: FloatArray) -> FloatArray:
    """Of the principal angles between the spans of rows (W, 6), by the displacement of points."""
    root = np.linalg.cholesky(form + 1e-12 * np.eye(6))
    spans = [np.linalg.qr((rows @ root).T)[0] for rows in (found, true)]
    return np.clip(np.linalg.svd(spans[0].T @ spans[1], compute_uv=False), 0.0, 1.0)


def span(projector: FloatArray | None) -> FloatArray:
    """(W, 6) rows that span the range of a projector."""
    return np.zeros((0, 6)) if projector is None else spanned(projector).T


def linear(matches: ScanMatches, guess: gtsam.Pose3, expected: gtsam.Pose3) -> Step:
    """The problem of one sweep."""
    residual, jacobian = match_rows(matches, 1.345).residuals(guess)
    seen = localizability(matches, guess)
    weak = seen.projector(Config().solver.min_aligned)
    return Step(
        jacobian.T @ jacobian,
        -jacobian.T @ residual,
        np.zeros((6, 6)) if weak is None else weak,
        guess.localCoordinates(expected),
        np.diag(EXPECTED**-2.0),
        seen.displacement,
    )


def split(error: FloatArray, unseen: FloatArray, form: FloatArray) -> tuple[FloatArray, FloatArray]:
    """An error's part along the unseen motions, and the rest, orthogonal in the displacement."""
    if not len(unseen):
        return np.zeros(6), error
    part = unseen.T @ np.linalg.solve(unseen @ form @ unseen.T, unseen @ form @ error)
    return part, error - part


def nees(error: FloatArray, covariance: FloatArray, basis: NDArray[np.floating]) -> float:
    """Per direction of a basis (W, 6) of dual vectors; NaN if the covariance claims nothing."""
    if not len(basis):
        return float("nan")
    claimed = basis @ covariance @ basis.T
    if np.linalg.eigvalsh(claimed)[0] <= 1e-14 * np.trace(covariance):
        return float("nan")
    along = basis @ error
    return float(along @ np.linalg.solve(claimed, along)) / len(basis)


def examine(
    name: str, seed: int, sweeps: int, columns: int | None
) -> tuple[list[Detection], list[Outcome]]:
    """All detectors and policies in one world."""
    place, rng = Place(name, seed, sweeps, columns), np.random.default_rng([seed, 7])
    hits: dict[str, list[tuple[int, int, float]]] = {detector: [] for detector in DETECTORS}
    rows: dict[str, list[tuple[float, ...]]] = {policy.__name__: [] for policy in POLICIES}
    for number in range(place.first + MAPPED, place.first + MAPPED + sweeps):
        posed, truth = place.sweep(number)
        guess = truth.retract(GUESS * rng.standard_normal(6))
        expected = truth.retract(EXPECTED * rng.standard_normal(6))
        matches = place.matches(posed, guess)
        problem, true = linear(matches, guess, expected), place.unseen_at(guess)
        for detector, find in DETECTORS.items():
            found = span(find(matches, guess))
            close = np.zeros(0)
            if len(found) and len(true):
                close = np.degrees(np.arccos(cosines(found, true, problem.form)))
            right = int((close < TRUE_WITHIN).sum())
            hits[detector].append((right, len(found), float(close.max()) if len(close) else np.nan))
        # Dual vectors: coefficients of the unseen motions, and such that vanish on these.
        along = np.linalg.solve(true @ problem.form @ true.T, true @ problem.form)
        across = np.linalg.svd(true)[2][len(true) :] if len(true) else np.eye(6)
        for policy in POLICIES:
            step, covariance = policy(problem)
            error = guess.retract(step).localCoordinates(truth)
            parts = split(error, true, problem.form)
            metres = [float(np.sqrt(part @ problem.form @ part)) for part in parts]
            ratios = nees(error, covariance, along), nees(error, covariance, across)
            rows[policy.__name__].append((*metres, *ratios))
    return (
        [_detection(name, detector, len(place.unseen), hits[detector]) for detector in DETECTORS],
        [_outcome(name, policy, rows[policy]) for policy in rows],
    )


def _detection(
    world: str, detector: str, unseen: int, hits: Sequence[tuple[int, int, float]]
) -> Detection:
    right, found = (sum(part) for part in list(zip(*hits, strict=True))[:2])
    angles = np.array([hit[2] for hit in hits])
    return Detection(
        world, detector, len(hits), unseen,
        right / found if found else (1.0 if not unseen else float("nan")),
        right / (unseen * len(hits)) if unseen else float("nan"),
        float(np.nanmedian(angles)) if np.isfinite(angles).any() else float("nan"),
    )  # fmt: skip


def _outcome(world: str, policy: str, rows: Sequence[tuple[float, ...]]) -> Outcome:
    table = np.array(rows)
    metres = np.sqrt(np.mean(table[:, :2] ** 2, axis=0))
    means = [
        float(column[np.isfinite(column)].mean()) if np.isfinite(column).any() else float("nan")
        for column in table[:, 2:].T
    ]
    return Outcome(world, policy, len(rows), *metres.tolist(), *means)


def table(rows: Sequence[Detection] | Sequence[Outcome]) -> str:
    """Rows of one kind in Markdown."""
    names = [item.name for item in fields(rows[0])]
    cells = (
        [
            ("-" if np.isnan(value) else f"{value:.3g}") if isinstance(value, float) else value
            for value in astuple(row)
        ]
        for row in rows
    )
    return "\n".join(markdown_table(names, cells)) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.degeneracy", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=tuple(UNSEEN), default=list(UNSEEN))
    parser.add_argument("--sweeps", type=int, default=40, help="of each world")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="two worlds, a few coarse sweeps")
    parser.add_argument(
        "--output", type=Path, default=Path("docs/degeneracy"), help="folder of the tables"
    )
    options = parser.parse_args(arguments)
    worlds, sweeps, columns = options.only, options.sweeps, None
    if options.quick:
        worlds, sweeps, columns = ["open_field", "room"], 3, 600
    found = [examine(name, options.seed, sweeps, columns) for name in worlds]
    detections = [row for detected, _ in found for row in detected]
    outcomes = [row for _, outcome in found for row in outcome]
    for name, rows in (("detectors", detections), ("policies", outcomes)):
        write_rows(options.output / f"{name}.csv", rows)
    print(table(detections), table(outcomes), sep="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
