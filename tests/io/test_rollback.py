"""What was before a call that failed: maps, archives, pose graphs."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from loam_gtsam.config import MapConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.io.rollback import Before, whole
from loam_gtsam.io.state import freeze
from loam_gtsam.loops.incremental import IncrementalGraph

SMALL = {"cube_size": 4.0, "window": (3, 3, 3), "window_margin": 1, "neighbourhood": (3, 3, 3)}
NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)


def same(one, other):
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name])


@pytest.mark.parametrize("insertion", ["settled", "centroid"])
@pytest.mark.parametrize("on_disk", [False, True])
def test_a_map_is_brought_back_window_and_archive_and_trees(insertion, on_disk, tmp_path):
    folder = str(tmp_path) if on_disk else None
    megabytes = 0.001 if on_disk else 100.0
    config = MapConfig(
        insertion=insertion, archive_dir=folder, archive_megabytes=megabytes, **SMALL
    )
    cubes, rng = CubeMap(config, 0.2), np.random.default_rng(0)
    points = rng.uniform(-5.0, 5.0, (500, 3))
    cubes.insert(points)
    cubes.recenter(np.array([8.0, 0.0, 0.0]))
    around = cubes.neighbourhood(np.eye(4))
    cubes.nearest(points[:9], 5, 1.0, around)
    was, before = freeze({"map": cubes}, {}), Before(cubes)
    for x in (0.0, 16.0):
        cubes.recenter(np.array([x, 0.0, 0.0]))
        cubes.insert(points + x + 0.05)
        cubes.nearest(points[:9] + x, 5, 1.0, cubes.neighbourhood(np.eye(4)))
    before.restore()
    same(freeze({"map": cubes}, {}), was)


def test_a_pose_graph_is_brought_back_and_goes_on_to_the_same_bits():
    def add(graph, number):
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = gtsam.Pose3(gtsam.Rot3.Yaw(0.1 * number), np.array([number, 0.1, 0.0]))
        if number == 0:
            factors.add(gtsam.PriorFactorPose3(0, pose, NOISE))
        else:
            factors.add(gtsam.BetweenFactorPose3(number - 1, number, pose, NOISE))
        values.insert(number, pose)
        graph.add(factors, values, settle=False)

    graphs = IncrementalGraph(), IncrementalGraph()
    for graph in graphs:
        for number in range(4):
            add(graph, number)
    back = graphs[1].restorer()
    add(graphs[1], 4)
    back()
    assert graphs[1].values.size() == graphs[1].factors.size() == 4
    poses = []
    for graph in graphs:
        add(graph, 4)
        poses.append([graph.values.atPose3(k).matrix() for k in range(5)])
    np.testing.assert_array_equal(*poses)


def test_a_call_that_fails_changes_nothing_and_one_that_does_not_does():
    cubes = CubeMap(MapConfig(**SMALL), 0.2)

    def insert_and(self, fail):
        self.insert(np.ones((1, 3)))
        return 1 / fail

    with pytest.raises(ZeroDivisionError):
        whole(insert_and)(cubes, 0)
    assert cubes.count() == 0
    assert whole(insert_and)(cubes, 1) == 1.0
    assert cubes.count() == 1
