"""A solver of your own: one Gauss-Newton step per association, beside the package's own solver.

``rematch`` is the loop of all solvers: match, optimise, match again at the new pose. What is left
is the optimum of fixed matches, and what becomes of directions that they do not fix.
"""

import gtsam
import numpy as np

from loam_gtsam import (
    POSE_KEY,
    Config,
    Mapper,
    SimulatedWorld,
    Solution,
    extract_features,
    match_rows,
    scan_match_factor,
)
from loam_gtsam.registration.degeneracy import localizability
from loam_gtsam.registration.solvers import rematch


class GaussNewton:
    """Knows the matches, the caller's priors and the expected motion."""

    def __init__(self, config):
        self.config = config

    def solve(self, associate, guess, priors=(), motion=None) -> Solution:
        """The pose that fits the matches best."""

        def optimise(matches, pose) -> Solution:
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            values.insert(POSE_KEY, pose)
            graph.add(scan_match_factor(POSE_KEY, match_rows(matches, kernel_width=1.345)))
            for factor in priors:
                graph.add(factor)
            scan = weak = None
            if motion is not None:
                scan = localizability(matches, pose)
                weak = scan.projector(self.config.min_aligned)  # None if every direction is fixed
                if weak is not None:
                    graph.add(motion.factor(weak))
            linear = graph.linearize(values)
            step = linear.optimize().at(POSE_KEY)
            moved = gtsam.Values()
            moved.insert(POSE_KEY, pose.retract(step))
            costs = graph.error(values), graph.error(moved)
            small = bool(np.linalg.norm(step) < 1e-3)
            information = linear.hessian()[0]
            return Solution(
                pose.retract(step), True, small, matches, 1, 1, *costs, information, scan, weak
            )

        return rematch(associate, guess, self.config, optimise)


config = Config()
sweeps = [extract_features(scan, config) for scan in SimulatedWorld("room", frames=3)]
poses = []
for mapper in (Mapper(config), Mapper(config, GaussNewton(config.solver))):
    for sweep in sweeps:
        update = mapper.register(sweep)
    print(update.status, update.iterations, update.map_T_lidar.translation())
    poses.append(update.map_T_lidar)
apart = float(np.linalg.norm(poses[0].localCoordinates(poses[1])[3:]))
print(f"{1000 * apart:.1f} mm apart")
