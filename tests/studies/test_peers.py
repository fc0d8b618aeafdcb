"""Other systems on the same sweeps."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
from support.contenders import Sweeps

from loam_gtsam.config import Config
from loam_gtsam.studies import peers
from loam_gtsam.studies.comparison import compare_solvers, score
from loam_gtsam.studies.contenders import find_contender, timed_points
from loam_gtsam.studies.peers import PEERS, PeerError, TimedPoints
from loam_gtsam.types import InputError


@pytest.mark.parametrize("name", [*PEERS])
def test_a_peer_that_is_not_installed_is_told_how(name, monkeypatch):
    def missing(module):
        raise ModuleNotFoundError(f"No module named {module!r}")

    monkeypatch.setattr(peers.importlib, "import_module", missing)
    told = rf"{name} cannot be imported .*pip install {PEERS[name].package}"
    with pytest.raises(PeerError, match=told):
        peers.make_peer(name)
    with pytest.raises(PeerError, match=r"unknown peer 'x' \(known: genz-icp, "):
        peers.make_peer("x")


@pytest.mark.parametrize("name", [*PEERS])
def test_peers_find_the_path(name, world, sweeps):
    pytest.importorskip(PEERS[name].module)
    result = compare_solvers(Sweeps(sweeps, world.truth), [find_contender(name)])
    scores = score(result.runs[0], result.truth)
    assert result.runs[0].problem == ""
    assert scores.ate_m < 0.1 * result.truth.path_length + 0.02
    assert scores.map_points > 100
    assert scores.ms_median > 0.0
    assert np.isnan(scores.iterations)


@pytest.mark.parametrize(("name", "moment"), [("kiss-icp", 1.0), ("genz-icp", 0.5)])
def test_peers_de_skew_to_the_moment_their_pose_is_said_to_belong_to(name, moment, sweeps):
    pytest.importorskip(PEERS[name].module)
    peer = peers.make_peer(name)
    package = PEERS[name].module
    preprocess = importlib.import_module(f"{package}.preprocess").get_preprocessor(peer._icp.config)
    forward = np.eye(4)
    forward[0, 3] = 1.0
    # The point at that share of the sweep is left where it was.
    points, times = np.full((5, 3), 5.0), np.linspace(0.0, 1.0, 5)
    kept = preprocess.preprocess(points, times, forward)[:, 0]
    np.testing.assert_allclose(kept, 5.0 + times - moment)
    sweep = timed_points(sweeps[0], Config())
    pose = peer.register(1000, sweep)
    first, last = sweep.times.min(), sweep.times.max()
    assert pose.stamp == 1000 + round((first + moment * (last - first)) * 1e9)
    same = replace(sweep, times=np.zeros(len(sweep.times)))
    with pytest.raises(InputError, match="different times"):
        peer.register(2000, same)


@pytest.mark.parametrize("name", ["small-gicp", "kiss-icp-no-deskew", "genz-icp-no-deskew"])
def test_poses_of_the_others_belong_to_the_middle(name, sweeps):
    pytest.importorskip(PEERS[name].module)
    sweep = timed_points(sweeps[0], Config())
    pose = peers.make_peer(name).register(1000, TimedPoints(
        sweep.points, sweep.times, (0.0, 0.1)))  # fmt: skip
    assert pose.stamp == 1000 + 50_000_000
