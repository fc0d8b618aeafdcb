"""What moves is taken out of a map, and what stands stays."""

import json
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.cli import loam
from support.quick import QUICK, QUICK_START

from loam_gtsam.config import Config
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.geometry import move_points, run_starts, transform, voxel_keys
from loam_gtsam.maps import SavedMap
from loam_gtsam.maps.cleaning import View, count_votes, views
from loam_gtsam.pipeline import run
from loam_gtsam.types import DatasetError

STEP = 100_000_000


@pytest.fixture(scope="module")
def square():
    """Views of a square full of people, a map of their points, and which points are of people."""
    world = SimulatedWorld("square", frames=250, columns=450)
    solids = replace(world.scene.solids, movers=())
    empty = SimulatedWorld(
        replace(world.scene, solids=solids), frames=250, columns=450, dropout=0.0, range_noise=0.0
    )
    made, points, people = [], [], []
    for number in range(0, 250, 8):
        scan, alone = world.sweep(number), empty.sweep(number)
        ends = np.array([scan.stamp, scan.stamp + STEP])
        poses = [gtsam.Pose3(pose) for pose in world.truth_at(ends).map_T_lidar]
        twist = gtsam.Pose3.Logmap(poses[0].between(poses[1])) / 0.1
        here = move_points(scan.points.astype(np.float64), twist, scan.times)
        made.append(View(number, poses[0].matrix(), here, scan.rings))
        # A beam that ends nearer than in the empty world has met somebody.
        beams = alone.points / np.linalg.norm(alone.points, axis=1)[:, None]
        ranges = np.linalg.norm(scan.points, axis=1)
        away, same = cKDTree(beams).query(scan.points / ranges[:, None])
        beyond = np.linalg.norm(alone.points, axis=1)[same] - ranges
        points.append(transform(poses[0].matrix(), here))
        people.append((beyond > 0.3) & (away < 1e-4))
    whole, met = np.concatenate(points), np.concatenate(people)
    keys = voxel_keys(whole, 0.2)
    order = np.argsort(keys, kind="stable")
    first = order[run_starts(np.diff(keys[order]) != 0)]
    return made, whole[first], met[first]


def test_people_go_and_houses_stay(square):
    made, points, people = square
    votes = count_votes(points, made, Config())
    near = np.linalg.norm(points[:, :2], axis=1) < 40.0
    assert people.sum() > 1000
    assert votes.moved[people & near].mean() > 0.92  # of 32 sweeps; docs/localise.md has 250
    assert votes.moved[~people].mean() < 0.01


def test_sweeps_without_rings_are_refused_with_the_reason():
    world = SimulatedWorld("room", sensor="mid360", frames=3)
    result = run(world, QUICK.changed("imu.coupling=off"))
    poses = np.stack([update.map_T_lidar.matrix() for update in result.updates])
    with pytest.raises(DatasetError, match=r"sweep 1: no rings .*; expected rings, between which"):
        list(views(world, result.updates, poses, result.config))


def test_one_sweep_or_one_ring_votes_for_nothing_that_it_saw(square):
    made, points, _ = square
    own = transform(made[0].map_T_lidar, made[0].points)
    assert not count_votes(own, made[:1], Config()).moved.any()
    ring = made[0].rings == made[0].rings[0]
    single = View(0, made[0].map_T_lidar, made[0].points[ring], made[0].rings[ring])
    assert not count_votes(points, [single], Config()).free.any()


def test_the_command_writes_a_clean_map(tmp_path):
    world = "sim:square?frames=8&columns=300"
    assert loam("run", world, "--output", tmp_path, "--no-plot", "-q", *QUICK_START).exit_code == 0
    done = loam("clean", world, tmp_path, "--plot")
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "cleaned" / "report.json").read_text())
    with SavedMap(tmp_path / "map.lgmap") as old, SavedMap(tmp_path / "cleaned/map.lgmap") as new:
        assert sum(part["points"] for part in report.values()) == len(old)
        assert sum(part["removed"] for part in report.values()) == len(old) - len(new)
        assert 0 < len(new) < len(old)
        assert len(new.places) == len(old.places)
    assert (tmp_path / "cleaned" / "cleaned.png").stat().st_size > 10_000
    other = loam("clean", "sim:square?frames=8&columns=300&rate=5", tmp_path, "--overwrite")
    assert other.exit_code == 1
    assert "give the data set of the run" in " ".join(other.output.split())
    fewer = loam("clean", "sim:square?frames=6&columns=300", tmp_path, "--overwrite")
    assert fewer.exit_code == 1
    assert "expected the 8 sweeps of the run, got 6" in " ".join(fewer.output.split())
    nothing = loam("clean", world, tmp_path / "cleaned")
    assert "expected the folder of a finished run" in " ".join(nothing.output.split())
