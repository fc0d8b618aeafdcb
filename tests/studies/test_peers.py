"""Other systems on the same sweeps."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.contenders import Sweeps

from loam_gtsam.config import Config
from loam_gtsam.pipeline import effective_config
from loam_gtsam.studies.comparison import compare_solvers, score
from loam_gtsam.studies.contenders import Group, inertial_of, make_contender, timed_points
from loam_gtsam.studies.peers import (
    PEERS,
    Inertial,
    PeerError,
    PeerProcess,
    TimedPoints,
    base,
    make_peer,
)
from loam_gtsam.types import ImuSamples, InputError


@pytest.mark.parametrize("name", [*PEERS])
def test_a_peer_that_is_not_installed_is_told_how(name, monkeypatch):
    def missing(module):
        raise ModuleNotFoundError(f"No module named {module!r}")

    monkeypatch.setattr(base.importlib, "import_module", missing)
    told = rf"{name} cannot be imported .*pip install {PEERS[name].package}"
    with pytest.raises(PeerError, match=told):
        make_peer(name)
    with pytest.raises(PeerError, match=r"unknown peer 'x' \(known: genz-icp, "):
        make_peer("x")


@pytest.fixture(scope="module")
def inertial(world):
    return inertial_of(world, effective_config(Config(), world))


@pytest.mark.parametrize("name", [*PEERS])
def test_peers_find_the_path(name, world, sweeps):
    pytest.importorskip(PEERS[name].module)
    data = Sweeps(sweeps, world.truth)
    data.imu = world.imu
    result = compare_solvers(data, [make_contender(Group.PEER, name, Config())])
    scores = score(result.runs[0], result.truth)
    assert result.runs[0].problem == ""
    # GenZ-LIO starts with an IMU that is at rest; this world is in motion from the start.
    least = 0.2 if name == "genz-lio" else 0.02
    assert scores.ate_m < 0.1 * result.truth.path_length + least
    assert scores.map_points > 100
    assert scores.ms_median > 0.0
    assert np.isnan(scores.iterations)


def test_settings_are_checked(fake):
    for text, told in (
        ("kiss-icp?voxels=1", r"unknown setting 'voxels'; did you mean 'voxel'\?"),
        ("kiss-icp?voxel=-1", "expected metres above 0, or scene"),
        ("kiss-icp?deskew=maybe", "expected true or false"),
        ("kiss-icp?deskew", "SETTING=VALUE"),
        ("fake?voxel=1", r"known: none"),
    ):
        with pytest.raises(PeerError, match=told):
            make_peer(text)


def test_the_voxel_of_a_scene_is_a_hundredth_of_its_range(fake, monkeypatch):
    monkeypatch.setattr(fake, "knobs", {"voxel": None})
    sweep = TimedPoints(np.array([[3.0, 4.0, 0.0]] * 200), np.zeros(200), (0.0, 0.1))
    sizes = [make_peer(f"fake{query}").voxel(sweep, 1.0) for query in ("", "?voxel=scene")]
    assert sizes == [1.0, pytest.approx(0.05)]
    assert make_peer("fake?voxel=0.3").voxel(sweep, 1.0) == 0.3


def test_a_peer_in_a_process_of_its_own_gives_the_same(sweeps):
    """Two of them at a time: each has its own state."""
    pytest.importorskip("small_gicp")
    kind = PEERS["small-gicp"]
    here, *there = kind(), PeerProcess(kind, {}), PeerProcess(kind, {"voxel": 0.5})
    try:
        for scan in sweeps[:3]:
            points = timed_points(scan, Config())
            same, first, second = (peer.register(scan.stamp, points) for peer in (here, *there))
            assert first.stamp == same.stamp
            np.testing.assert_allclose(first.map_T_lidar.matrix(), same.map_T_lidar.matrix())
        assert not np.allclose(second.map_T_lidar.matrix(), same.map_T_lidar.matrix())
        assert there[0].map_points == here.map_points
    finally:
        for peer in there:
            peer.close()


def test_a_peer_without_the_imu_that_it_needs_ends_with_a_reason(sweeps):
    pytest.importorskip("rko_lio")
    run = compare_solvers(Sweeps(sweeps), [make_contender(Group.PEER, "rko-lio", Config())]).runs[0]
    assert "needs an IMU, and the data set has none" in run.problem


@pytest.mark.parametrize(("name", "moment"), [("kiss-icp", 1.0), ("genz-icp", 0.5)])
def test_peers_de_skew_to_the_moment_their_pose_is_said_to_belong_to(name, moment, sweeps):
    kind = PEERS[name]
    pytest.importorskip(kind.module)
    peer, sweep = kind(), timed_points(sweeps[0], Config())
    pose = peer.register(1000, sweep)
    first, last = sweep.times.min(), sweep.times.max()
    assert pose.stamp == 1000 + round((first + moment * (last - first)) * 1e9)
    preprocess = importlib.import_module(f"{kind.module}.preprocess")
    forward = np.eye(4)
    forward[0, 3] = 1.0
    # The point at that share of the sweep is left where it was.
    points, times = np.full((5, 3), 5.0), np.linspace(0.0, 1.0, 5)
    kept = preprocess.get_preprocessor(peer._icp.config).preprocess(points, times, forward)[:, 0]
    np.testing.assert_allclose(kept, 5.0 + times - moment)
    same = replace(sweep, times=np.zeros(len(sweep.times)))
    with pytest.raises(InputError, match="different times"):
        peer.register(2000, same)


@pytest.mark.parametrize("name", ["small-gicp", "kiss-icp", "genz-icp"])
def test_without_de_skew_poses_belong_to_the_middle(name, sweeps):
    pytest.importorskip(PEERS[name].module)
    sweep = timed_points(sweeps[0], Config())
    peer = PEERS[name]({"deskew": False})
    pose = peer.register(1000, TimedPoints(sweep.points, sweep.times, (0.0, 0.1)))
    assert pose.stamp == 1000 + 50_000_000


def test_the_lidar_is_where_the_extrinsics_say(world, sweeps, inertial):
    """An IMU turned in its mounting, and the extrinsics with it: the poses stay the same."""
    pytest.importorskip("rko_lio")
    turn = Rotation.from_euler("xyz", (90.0, 0.0, 90.0), degrees=True)
    samples = world.imu
    turned = ImuSamples(
        samples.stamps, None, turn.inv().apply(samples.gyro), turn.inv().apply(samples.acceleration)
    )
    mounted = inertial.lidar_T_imu.copy()
    mounted[:3, :3] = turn.as_matrix()
    ways = []
    for imu in (inertial, Inertial(turned, mounted)):
        peer = PEERS["rko-lio"](imu=imu)
        for scan in sweeps:
            peer.register(scan.stamp, timed_points(scan, Config()))
        ways.append(peer.trajectory.map_T_lidar)
    np.testing.assert_allclose(*ways, atol=1e-6)
