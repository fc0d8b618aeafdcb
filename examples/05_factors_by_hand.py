"""Scan matches in a factor graph of your own: one factor per match, or one per scan.

Both have the same cost and the same optimum. One per scan is far faster; one per match takes
GTSAM's robust noise models.
"""

import time

import gtsam
import numpy as np

from loam_gtsam import (
    Mapper,
    SimulatedWorld,
    associate,
    extract_features,
    match_rows,
    point_to_line_factor,
    point_to_plane_factor,
    scan_match_factor,
)

KEY = gtsam.symbol("x", 7)

mapper = Mapper()
world = SimulatedWorld("room", frames=2, columns=600)
first, second = (extract_features(scan, mapper.config) for scan in world)
mapper.register(first)
guess = gtsam.Pose3()
m = associate(
    second.edges,
    second.planes,
    guess,
    mapper.maps.edges,
    mapper.maps.planes,
    mapper.config.matching,
)
start, optima = gtsam.Values(), []
start.insert(KEY, guess)

for name in ("per match", "per scan"):
    began = time.perf_counter()
    graph = gtsam.NonlinearFactorGraph()
    if name == "per scan":
        graph.add(scan_match_factor(KEY, match_rows(m)))
    else:  # sigma / weight whitens as the one factor does
        for p, c, u, s in zip(m.edges.points, m.edges.centres, m.edges.directions,
                              m.edges.sigmas / m.edges.weights, strict=True):  # fmt: skip
            graph.add(point_to_line_factor(KEY, p, c, u, gtsam.noiseModel.Isotropic.Sigma(2, s)))
        for p, n, d, s in zip(m.planes.points, m.planes.normals, m.planes.offsets,
                              m.planes.sigmas / m.planes.weights, strict=True):  # fmt: skip
            graph.add(point_to_plane_factor(KEY, p, n, d, gtsam.noiseModel.Isotropic.Sigma(1, s)))
    optima.append(gtsam.LevenbergMarquardtOptimizer(graph, start).optimize().atPose3(KEY))
    ms = 1e3 * (time.perf_counter() - began)
    print(f"{name}: {graph.size()} factors, cost {graph.error(start):.6f}, {ms:.1f} ms")

difference = np.linalg.norm(optima[0].localCoordinates(optima[1]))
print(f"the optima differ by {difference:.1e}")
