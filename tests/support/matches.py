"""Matches with lines and planes that a known pose satisfies."""

import gtsam
import numpy as np

from loam_gtsam.registration.matches import EdgeMatches, PlaneMatches, ScanMatches

TRUTH = gtsam.Pose3.Expmap(np.array([0.1, -0.2, 0.7, 12.0, -5.0, 1.0]))
NO_EDGES = EdgeMatches(*[np.zeros((0, 3))] * 3, *[np.zeros(0)] * 3, np.zeros(0, np.int64))


def unit(rng, count):
    """Random directions, (count, 3)."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def make_matches(pose=TRUTH, n_edges=40, n_planes=120, noise=0.0, seed=0, sigma=None):
    """Matches that ``pose`` satisfies exactly, but for noise across the lines and planes.

    Standard deviations are ``sigma``, or random: 2 to 10 cm.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(-20, 20, (n_edges + n_planes, 3))
    matrix = pose.matrix()
    there = points @ matrix[:3, :3].T + matrix[:3, 3] + noise * rng.normal(size=points.shape)
    directions, normals = unit(rng, n_edges), unit(rng, n_planes)
    centres = there[:n_edges] + directions * rng.uniform(-3, 3, (n_edges, 1))
    offsets = -np.einsum("ij,ij->i", normals, there[n_edges:])

    def rest(count):
        return (
            np.zeros(count),
            rng.uniform(0.02, 0.1, count) if sigma is None else np.full(count, sigma),
            rng.uniform(0.2, 1.0, count),
            np.arange(count),
        )

    return ScanMatches(
        EdgeMatches(points[:n_edges], centres, directions, *rest(n_edges)),
        PlaneMatches(points[n_edges:], normals, offsets, *rest(n_planes)),
    )


def difference(a, b):
    """The largest number in the tangent vector from one pose to another, rad and metres."""
    return np.abs(a.localCoordinates(b)).max()
