"""Pose graphs as files, and ``loam-gtsam optimize``."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from support.cli import loam
from support.pose_graphs import filled, square

from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.loops.batch import SavedGraph, optimize_graph
from loam_gtsam.loops.files import read_graph, write_graph
from loam_gtsam.types import DatasetError, InputError, OutputError

SIGMAS = np.repeat([0.01, 0.05], 3)


def saved_graph(wrong=0):
    """Two rounds of a square of ten poses, far from the origin, with loops."""
    rng = np.random.default_rng(1)
    turn = gtsam.Pose3(gtsam.Rot3.Yaw(np.pi / 5.0), np.array([10.0, 0.0, 0.3]))
    truth = [gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([5e5, 5.1e6, 1 / 3]))]
    for _ in range(19):
        truth.append(truth[-1].compose(turn))
    graph, poses = gtsam.NonlinearFactorGraph(), gtsam.Values()
    root = rng.normal(size=(6, 6))
    covariance = np.diag(SIGMAS**2) + 1e-5 * root @ root.T
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    graph.add(gtsam.PriorFactorPose3(X(0), truth[0], gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    pose = truth[0]
    poses.insert(X(0), pose)
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(5.0)
    for key in range(1, 20):
        step = truth[key - 1].between(truth[key]).retract(SIGMAS * rng.normal(size=6))
        pose = pose.compose(step)
        poses.insert(X(key), pose)
        graph.add(gtsam.BetweenFactorPose3(X(key - 1), X(key), step, noise))
    for first in (0, 3, 5, 7):
        seen = truth[first].between(truth[first + 10]).retract(SIGMAS * rng.normal(size=6))
        robust = gtsam.noiseModel.Robust.Create(kernel, noise)
        graph.add(gtsam.BetweenFactorPose3(X(first), X(first + 10), seen, robust))
    for first in range(wrong):
        graph.add(gtsam.BetweenFactorPose3(X(first), X(first + 8), gtsam.Pose3(), noise))
    return SavedGraph(graph, poses, {X(n): 1_700_000_000_123_456_789 + n for n in range(20)})


def test_a_pose_graph_is_written_as_what_it_saves(tmp_path):
    graph = filled(square(4, 1))
    write_graph(tmp_path / "one.g2o", graph)
    write_graph(tmp_path / "two.g2o", graph.saved())
    assert (tmp_path / "one.g2o").read_text() == (tmp_path / "two.g2o").read_text()


@pytest.mark.parametrize("name", ["graph.g2o", "graph.graph"])
def test_what_is_written_is_read(tmp_path, name):
    saved = saved_graph()
    write_graph(tmp_path / name, saved)
    again = read_graph(tmp_path / name)
    assert again.stamps == saved.stamps
    assert again.poses.equals(saved.poses, 1e-9)
    assert again.loops == saved.loops == (20, 21, 22, 23)
    assert again.factors.size() == saved.factors.size()
    for place in range(1, saved.factors.size()):
        one, two = saved.factors.at(place), again.factors.at(place)
        assert one.keys() == two.keys()
        assert one.measured().equals(two.measured(), 1e-12)
        noise, read = one.noiseModel(), two.noiseModel()
        noise = noise.noise() if isinstance(noise, gtsam.noiseModel.Robust) else noise
        read = read.noise() if isinstance(read, gtsam.noiseModel.Robust) else read
        np.testing.assert_allclose(read.covariance(), noise.covariance(), rtol=1e-9, atol=1e-15)


def test_gtsam_files_keep_every_factor(tmp_path):
    saved = saved_graph()
    up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
    saved.factors.add(gtsam.GPSFactor(X(4), np.ones(3), gtsam.noiseModel.Isotropic.Sigma(3, 1.0)))
    tilt = gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
    saved.factors.add(gtsam.AttitudeFactorPose3(X(4), up, tilt, up))
    write_graph(tmp_path / "g.graph", saved)
    assert read_graph(tmp_path / "g.graph").factors.equals(saved.factors, 1e-12)
    write_graph(tmp_path / "g.g2o", saved)
    text = (tmp_path / "g.g2o").read_text("ascii")
    assert "# 3 factors are left out" in text
    assert read_graph(tmp_path / "g.g2o").factors.size() == saved.factors.size() - 2
    (tmp_path / "g.stamps").unlink()  # not needed
    assert read_graph(tmp_path / "g.graph").stamps == {}


def test_a_pose_that_only_factors_tie_which_g2o_does_not_know_is_not_in_it(tmp_path):
    """As that of the map on the earth: nothing in the file would hold it."""
    saved = saved_graph()
    earth, noise = gtsam.symbol("g", 0), gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    saved.poses.insert(earth, gtsam.Pose3())
    fix = gtsam.CustomFactor(noise, [X(4), earth], lambda *_: np.zeros(3))
    saved.factors.add(fix)
    write_graph(tmp_path / "g.g2o", saved)
    again = read_graph(tmp_path / "g.g2o")
    assert again.keys == [X(number) for number in range(20)]
    assert len(optimize_graph(again).loops) == 4


def test_gtsam_reads_the_g2o_file_too(tmp_path):
    saved = saved_graph()
    write_graph(tmp_path / "g.g2o", saved)
    graph, poses = gtsam.readG2o(str(tmp_path / "g.g2o"), True)
    assert all(poses.atPose3(n).equals(saved.poses.atPose3(X(n)), 1e-6) for n in range(20))
    assert poses.size() == 20
    assert graph.size() == saved.factors.size() - 1
    read, written = graph.at(0).noiseModel(), saved.factors.at(1).noiseModel()
    np.testing.assert_allclose(read.covariance(), written.covariance(), rtol=1e-9)


POSES = (
    "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n"
    "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n"
)  # fmt: skip
EYE = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
EDGE = f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {EYE}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found none"),
        ("# nothing\n\n", "found none"),
        ("VERTEX_SE2 0 0 0 0\n", ":1: expected VERTEX_SE3:QUAT, EDGE_SE3:QUAT, FIX"),
        ("VERTEX_SE3:QUAT 0 0 0 0\n", ":1: VERTEX_SE3:QUAT takes 8 numbers, this line has 4"),
        (POSES + POSES, ":3: there already is a pose 0"),
        (POSES + EDGE[:-5] + "\n", ":3: EDGE_SE3:QUAT takes 30 numbers"),
        (POSES + EDGE.replace("0 1 1", "0 7 1"), ":3: there is no VERTEX_SE3:QUAT 7"),
        (POSES + EDGE.replace("0 1 1", "0 0 1"), ":3: expected a motion between two poses"),
        (POSES + EDGE.replace(EYE, "-" + EYE), ":3: expected a positive definite information"),
        (POSES + EDGE.replace("0 0 0 1", "0 0 0 2", 1), ":3: expected a quaternion of length 1"),
        (
            POSES + EDGE.replace("0 1 1", "0 1.5 1"),
            ":3: expected a whole number of at most 9223372036854775807, got '1.5'",
        ),
        (POSES + EDGE.replace("0 1 1", f"0 {'9' * 5011} 1"), f"got '{'9' * 40}'"),
        (POSES + f"# stamp_ns 0 {2**62 + 1}", "a whole number of at most 4611686018427387904"),
        (POSES + EDGE.replace("0 1 1", "0 -1 1"), ":3: expected a number of a pose from 0 on"),
        (POSES + EDGE.replace(EYE, EYE.replace("1", "nan")), ":3: expected finite numbers"),
        (POSES + EDGE.replace(EYE, EYE.replace("1", "x")), ":3: could not convert"),
        (POSES + "FIX 3\n", ":3: there is no VERTEX_SE3:QUAT 3"),
        (POSES + "FIX\n", ":3: FIX takes 1 numbers"),
    ],
)
def test_bad_g2o_files_are_refused(tmp_path, text, message):
    path = tmp_path / "bad.g2o"
    path.write_text(text, "ascii")
    with pytest.raises(DatasetError) as caught:
        read_graph(path)
    assert message in str(caught.value)


def test_the_good_g2o_file_is_read(tmp_path):
    path = tmp_path / "good.g2o"
    path.write_text(POSES + "FIX 1\n" + EDGE, "ascii")
    saved = read_graph(path)
    assert saved.factors.size() == 2
    assert optimize_graph(saved).poses.atPose3(X(0)).equals(gtsam.Pose3(), 1e-6)


@pytest.mark.parametrize("suffix", [".graph", ".values"])
@pytest.mark.parametrize("damage", ["empty", "junk", "cut", "other", "missing"])
def test_bad_gtsam_files_are_refused(tmp_path, suffix, damage):
    write_graph(tmp_path / "g.graph", saved_graph())
    part = tmp_path / f"g{suffix}"
    text = part.read_text("ascii")
    other = (tmp_path / f"g{'.values' if suffix == '.graph' else '.graph'}").read_text("ascii")
    if damage == "missing":
        part.unlink()
    else:
        bad = {"empty": "", "junk": "junk", "cut": text[: len(text) // 2], "other": other}
        part.write_text(bad[damage], "ascii")
    with pytest.raises(DatasetError, match=rf"g\{suffix}"):
        read_graph(tmp_path / "g.graph")


def test_other_bad_files_are_refused(tmp_path):
    write_graph(tmp_path / "g.graph", saved_graph())
    (tmp_path / "g.stamps").write_text("1 2\n3\n", "ascii")
    with pytest.raises(DatasetError, match=r"g\.stamps:2: expected a key and a stamp"):
        read_graph(tmp_path / "g.graph")
    with pytest.raises(DatasetError, match="cannot read"):
        read_graph(tmp_path / "none.g2o")
    for name in ("g.txt", "g"):
        with pytest.raises(InputError, match="expected a name that ends in"):
            read_graph(tmp_path / name)
        with pytest.raises(InputError, match="expected a name that ends in"):
            write_graph(tmp_path / name, saved_graph())
    points = gtsam.Values()
    points.insert(0, np.zeros(3))
    write_graph(tmp_path / "p.graph", SavedGraph(gtsam.NonlinearFactorGraph(), points))
    with pytest.raises(DatasetError, match="expected poses only"):
        read_graph(tmp_path / "p.graph")
    graph, unit = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(6)
    graph.add(gtsam.CustomFactor(unit, [0], lambda *_: np.zeros(6)))
    with pytest.raises(OutputError, match="cannot serialise"):
        write_graph(tmp_path / "c.graph", SavedGraph(graph, gtsam.Values()))


def command(*words):
    return loam("optimize", *words)


@pytest.mark.parametrize("suffix", [".g2o", ".graph"])
def test_optimize_writes_a_better_graph(tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    write_graph(path, saved_graph(wrong=2))
    tum = tmp_path / "run.tum"
    done = command(path, "--trajectory", tum)
    assert done.exit_code == 0, done.output
    assert "6, of which 2 contradict the others" in done.output
    assert "0 - 8, chi squared" in done.output
    written = read_graph(tmp_path / f"run_optimized{suffix}")
    assert len(written.loops) == 4
    expected = optimize_graph(read_graph(path)).poses
    assert written.poses.equals(expected, 1e-6)
    assert read_tum(tum).stamps.tolist() == list(written.stamps.values())
    np.testing.assert_allclose(read_tum(tum).map_T_lidar[7], expected.atPose3(X(7)).matrix(),
                               atol=1e-8)  # fmt: skip
    again = command(path)
    assert again.exit_code == 1
    assert "the file exists" in again.output
    assert command(path, "--overwrite", "--quiet").output == ""


def test_optimize_refuses_what_it_cannot_do(tmp_path):
    path = tmp_path / "run.g2o"
    write_graph(path, saved_graph())
    for words, message in (
        ((path, "--output", path, "--overwrite"), "the input must not be replaced"),
        ((tmp_path / "no.g2o",), "cannot read"),
        ((path, "--output", tmp_path / "x.txt"), "expected a name that ends in"),
    ):
        refused = command(*words)
        assert refused.exit_code == 1
        assert message in refused.output
    lines = [line for line in path.read_text("ascii").splitlines() if "stamp_ns" not in line]
    path.write_text("\n".join(lines), "ascii")
    refused = command(path, "--trajectory", tmp_path / "run.tum")
    assert refused.exit_code == 1
    assert "has no stamps" in refused.output
    plain = command(path, "--plain", "--output", tmp_path / "plain.graph")
    assert plain.exit_code == 0
    assert len(read_graph(tmp_path / "plain.graph").loops) == 4
