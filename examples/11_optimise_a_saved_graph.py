"""A saved pose graph, optimised again off-line, with wrong loops in it.

``loam-gtsam optimize city.g2o`` does the same. The graph here is made up: two rounds of a block,
with the drift of an odometry, ten right loops and as many wrong ones.
"""

from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X  # the key of pose i is X(i), in a file the number i

from loam_gtsam import optimize_graph, read_graph, write_graph
from loam_gtsam.loops.batch import SavedGraph

rng = np.random.default_rng(0)
sigmas = np.repeat([0.002, 0.02], 3)  # rad and m, of a step and of a loop
noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)


def measured(one: int, two: int) -> gtsam.Pose3:
    """The motion between two poses, with noise."""
    return truth[one].between(truth[two]).retract(sigmas * rng.normal(size=6))


truth = [gtsam.Pose3()]
for step in range(1, 160):
    turn = gtsam.Rot3.Yaw(np.pi / 2.0 if step % 20 == 0 else 0.0)
    truth.append(truth[-1].compose(gtsam.Pose3(turn, np.array([1.0, 0.0, 0.0]))))
factors, poses = gtsam.NonlinearFactorGraph(), gtsam.Values()
poses.insert(X(0), truth[0])
for step in range(1, 160):
    motion = measured(step - 1, step)
    poses.insert(X(step), poses.atPose3(X(step - 1)).compose(motion))
    factors.add(gtsam.BetweenFactorPose3(X(step - 1), X(step), motion, noise))
for start in range(3, 80, 8):
    right = measured(start, start + 80)
    factors.add(gtsam.BetweenFactorPose3(X(start), X(start + 80), right, noise))
    wrong = gtsam.Pose3(gtsam.Rot3.Yaw(rng.uniform(-3, 3)), rng.normal(0.0, 2.0, 3))
    factors.add(gtsam.BetweenFactorPose3(X(start), X(start + 43), wrong, noise))
write_graph("city.g2o", SavedGraph(factors, poses))

saved = read_graph("city.g2o")  # or one that PoseGraph.saved() gave, or another system wrote
believed, robust = optimize_graph(saved, robust=False), optimize_graph(saved)


def off(values: gtsam.Values) -> float:
    """Metres from the truth, root mean square."""
    found = [values.atPose3(X(k)).translation() for k in range(len(truth))]
    errors = np.array(found) - [pose.translation() for pose in truth]
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


print(f"{len(saved.loops)} loops, {sum(loop.active for loop in robust.loops)} of them used")
print(f"off by {off(saved.poses):.2f} m as saved, {off(believed.poses):.2f} m with all loops,")
print(f"       {off(robust.poses):.2f} m with those that agree")
sigma = np.sqrt(np.diag(robust.covariance(X(159)))[3:])
print(f"standard deviations of the last position: {sigma.round(3)} m")
write_graph("city_optimized.graph", SavedGraph(robust.factors, robust.poses))  # GTSAM's own format
print("written:", *sorted(file.name for file in Path().glob("city*")))
