"""Scans that are solved in closed form: planes around a pose, off by errors that are given."""

import gtsam
import numpy as np
from support.matches import NO_EDGES

from loam_gtsam.registration.matches import PlaneMatches, ScanMatches
from loam_gtsam.registration.solvers import Solution, match_rows

SIGMA = 0.05
"""Metres: what the matches claim."""
POSE = gtsam.Pose3.Expmap(np.array([0.02, -0.03, 0.4, 3.0, -2.0, 0.5]))


def solved(
    points, normals, errors, pose=POSE, prior=None, weak=None, edges=NO_EDGES, by_range=None
):
    """The optimum of planes whose points are off by ``errors``, in metres, and the step there."""
    count = len(points)
    there = pose.transformFrom(points.T).T
    offsets = errors - np.einsum("ij,ij->i", normals, there)
    planes = PlaneMatches(points, normals, offsets, errors, np.full(count, SIGMA), np.ones(count),
                          np.arange(count), by_range=by_range)  # fmt: skip
    matches = ScanMatches(edges, planes)
    residuals, jacobian = match_rows(matches).residuals(pose)
    keep = np.eye(6) if weak is None else np.eye(6) - weak
    information = keep.T @ jacobian.T @ jacobian @ keep
    if prior is not None:
        information = information + prior
    step = -np.linalg.solve(information, keep.T @ jacobian.T @ residuals)
    return Solution(
        pose.retract(step), True, True, matches, 1, 1, 0.0, 0.0, information, weak=weak,
        unseen=weak, beacons=np.zeros(len(residuals), np.bool_),
    ), step  # fmt: skip


def surroundings(rng, axes=3):
    """Points on walls along ``axes`` of the map, as seen from the pose, and their normals."""
    normals = np.eye(3)[rng.integers(0, axes, 1500) + 3 - axes]
    there = rng.uniform(-15.0, 15.0, (1500, 3)) + POSE.translation()
    return POSE.transformTo(there.T).T, normals, there
