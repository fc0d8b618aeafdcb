"""Fixes of a GNSS receiver on a pose graph: what they mend, and what must not bend it."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.pose_graphs import SIGMAS
from support.receiver import ANTENNA, CONFIG, ENU_T_MAP, ORIGIN, Drive

from loam_gtsam.aiding.gnss import tie, write_enu
from loam_gtsam.aiding.placed_fixes import ANTENNA_KEY, MAP_KEY, fix_factor
from loam_gtsam.datasets.decode.aiding import GnssFixes, WheelSamples
from loam_gtsam.datasets.decode.geodesy import east_north_up
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.types import InputError, Trajectory

UP = np.array([0.0, 0.0, 1.0])


def test_the_jacobians_of_a_fix_are_those_of_its_residual():
    rng = np.random.default_rng(0)
    key = gtsam.symbol("x", 3)
    start = gtsam.Values()
    start.insert(key, gtsam.Pose3.Expmap(rng.normal(size=6)))
    start.insert(MAP_KEY, gtsam.Pose3.Expmap(rng.normal(size=6)))
    start.insert(ANTENNA_KEY, rng.normal(size=3))
    moved = gtsam.Pose3.Expmap(rng.normal(size=6))
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    factor = fix_factor(key, rng.normal(size=3), noise, moved)
    ordering = gtsam.Ordering()
    for variable in (key, MAP_KEY, ANTENNA_KEY):
        ordering.push_back(variable)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    jacobian, _ = graph.linearize(start).jacobian(ordering)

    def error(step):
        values = gtsam.Values()
        values.insert(key, start.atPose3(key).retract(step[:6]))
        values.insert(MAP_KEY, start.atPose3(MAP_KEY).retract(step[6:12]))
        values.insert(ANTENNA_KEY, start.atPoint3(ANTENNA_KEY) + step[12:])
        return factor.unwhitenedError(values)

    steps = 1e-6 * np.eye(15)
    numeric = np.stack([(error(d) - error(-d)) / 2e-6 for d in steps], axis=1)
    np.testing.assert_allclose(jacobian, numeric, atol=1e-8)


def test_right_fixes_are_used_and_tell_where_the_map_is():
    drive = Drive()
    before = drive.errors()[40:].mean()
    tied = tie(drive.graph, drive.updates, drive.fixes(), CONFIG, UP)
    assert tied.problem == ""
    assert tied.used.all()
    assert tied.reference is not None
    found = gtsam.Pose3(tied.reference.enu_T_map)
    shift = east_north_up(tied.reference.origin[None], ORIGIN)[0]
    away = found.rotation().between(ENU_T_MAP.rotation())
    error = np.concatenate([gtsam.Rot3.Logmap(away), found.rotation().matrix().T
                            @ (ENU_T_MAP.translation() - found.translation() - shift)])  # fmt: skip
    assert error @ np.linalg.solve(tied.reference.covariance, error) < 22.5  # chi squared, 0.1 %
    assert np.sqrt(tied.reference.covariance[5, 5]) < 0.2
    assert drive.errors()[40:].mean() < 0.5 * before
    np.testing.assert_allclose(tied.antenna, ANTENNA, atol=0.15)


@pytest.fixture(scope="module")
def clean():
    drive = Drive()
    tie(drive.graph, drive.updates, drive.fixes(), CONFIG, UP)
    return drive


@pytest.mark.parametrize("kind", ["jump", "frozen", "one"])
def test_wrong_fixes_are_rejected_and_bend_nothing(kind, clean):
    drive = Drive()
    wrong = {"jump": slice(20, 32), "frozen": slice(50, 65), "one": slice(40, 41)}[kind]
    drive.enu[wrong] = drive.enu[50] if kind == "frozen" else drive.enu[wrong] + [30.0, -8.0, 3.0]
    tied = tie(drive.graph, drive.updates, drive.fixes(), CONFIG, UP)
    rejected = np.flatnonzero(~tied.used)
    away = np.linalg.norm(drive.enu - clean.enu, axis=1) > 2.5  # a frozen one begins right
    assert set(np.flatnonzero(away)) <= set(rejected)
    assert len(rejected) <= away.sum() + 4
    assert np.abs(drive.errors() - clean.errors()).max() < 0.35


@pytest.mark.parametrize(
    ("off", "up"), [([4.0, 3.0, 6.0], None), ([8.0, 3.0, 1.0], UP), ([2.0, 1.0, 2.0], None)]
)
def test_wrong_fixes_that_are_surer_than_the_way_do_not_bend_it(off, up):
    """Multipath of a receiver that tells 2 cm: the way bends to it, by graduated non-convexity."""
    drive = Drive(sigma=0.02, step=3.0 * SIGMAS)
    drive.enu[30:42] += off
    tied = tie(drive.graph, drive.updates, drive.fixes(), CONFIG, up)
    assert np.array_equal(np.flatnonzero(~tied.used), np.arange(30, 42))
    assert drive.errors().max() < 0.6


def test_an_antenna_elsewhere_than_said_is_told_and_believed_less():
    there, elsewhere = Drive(sigma=0.02), Drive(sigma=0.02)
    right = tie(there.graph, there.updates, there.fixes(), CONFIG, UP)
    aside = CONFIG.changed(lidar_t_antenna=tuple(ANTENNA + np.eye(3)[0]))
    wrong = tie(elsewhere.graph, elsewhere.updates, elsewhere.fixes(), aside, UP)
    assert right.antenna_off == 0.0
    assert wrong.antenna_off > 4.0
    np.testing.assert_allclose(wrong.antenna[:2], ANTENNA[:2], atol=0.1)


def test_covariances_that_are_too_small_are_widened():
    drive = Drive()
    drive.covariance = drive.covariance / 16.0
    tied = tie(drive.graph, drive.updates, drive.fixes(), CONFIG, UP)
    assert tied.used.mean() > 0.95
    assert 3.0 < tied.scale < 5.0


def test_a_map_that_is_not_levelled_is_found_too():
    drive = Drive()
    tied = tie(drive.graph, drive.updates, drive.fixes(), CONFIG, None)
    assert tied.reference is not None
    assert abs(np.radians(tied.reference.heading_deg) - 2.2) < 0.03


@pytest.mark.parametrize(
    ("case", "told"),
    [
        ("elsewhere", "fixes agree"),
        ("coarse", "too short"),
        ("no covariance", "0 of them within the run and with a covariance"),
        ("later", "0 keyframes have a fix"),
    ],
)
def test_fixes_that_say_nothing_are_not_used_and_the_graph_stays(case, told):
    drive = Drive()
    if case == "elsewhere":
        drive.enu = np.random.default_rng(1).uniform(-300.0, 300.0, drive.enu.shape)
    if case == "coarse":
        drive.covariance = 400.0 * np.eye(3)
    if case == "later":
        drive.stamps = drive.stamps + 10**12
    before = drive.graph.poses()
    tied = tie(drive.graph, drive.updates, drive.fixes(case == "no covariance"), CONFIG, UP)
    assert tied.reference is None
    assert told in tied.problem
    assert not tied.used.any()
    assert np.array_equal(drive.graph.poses(), before)


def test_a_sigma_stands_for_covariances_that_are_not_told():
    drive = Drive()
    tied = tie(drive.graph, drive.updates, drive.fixes(True), CONFIG.changed(gnss_sigma=0.3), UP)
    assert tied.reference is not None
    assert "fixes used" in str(tied)


def test_errors_that_last_make_the_covariance_wider():
    sigmas = []
    for memory in (0.0, 2.0):
        drive = Drive()
        config = CONFIG.changed(gnss_memory=memory)
        tied = tie(drive.graph, drive.updates, drive.fixes(), config, UP)
        assert tied.reference is not None
        sigmas.append(np.sqrt(tied.reference.covariance[3, 3]))
    assert sigmas[1] > 2.0 * sigmas[0]


def test_poses_in_enu_are_written_with_their_origin(tmp_path):
    drive = Drive()
    tied = tie(drive.graph, drive.updates, drive.fixes(), CONFIG, UP)
    assert tied.reference is not None
    flat = Trajectory(np.array([5]), np.eye(4)[None])
    write_enu(tmp_path / "enu.tum", flat, tied.reference)
    moved = replace(flat, map_T_lidar=tied.reference.enu_T_map[None])
    write_tum(tmp_path / "same.tum", moved)
    lines = (tmp_path / "enu.tum").read_text().splitlines()
    latitude = float(lines[0].split()[3])
    assert abs(latitude - tied.reference.origin[0]) < 1e-9
    assert lines[-1] == (tmp_path / "same.tum").read_text().splitlines()[-1]


@pytest.mark.parametrize("known", [np.diag([1.0, 2.0, 3.0]), np.tile(np.eye(3), (2, 1, 1)), None])
def test_fixes_have_covariances_of_their_own_one_for_all_or_none(known):
    places = np.tile([47.5, 8.5, 450.0], (2, 1))
    fixes = GnssFixes(np.arange(2), places, known)
    wanted = np.broadcast_to(np.full((3, 3), np.nan) if known is None else known, (2, 3, 3))
    np.testing.assert_array_equal(fixes.covariances, wanted)
    with pytest.raises(InputError, match=r"expected \(2, 3, 3\), .* got \(2, 3\); variances"):
        GnssFixes(np.arange(2), places, np.ones((2, 3)))
    with pytest.raises(InputError, match="got rows of different lengths"):
        GnssFixes(np.arange(2), places, [[[1.0]], [[1.0, 2.0]]])


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((3, 3)),
        -np.eye(3),
        np.diag([1.0, 1.0, 0.0]),
        np.diag([np.inf] * 3),
        np.diag([1.0, np.nan, 1.0]),
        [[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    ],
)
def test_covariances_of_fixes_that_are_none_are_refused(wrong):
    places = np.tile([47.5, 8.5, 450.0], (3, 1))
    turn = Rotation.from_euler("xyz", [0.3, 0.2, 1.0]).as_matrix()
    good = turn @ np.diag([0.01, 4.0, 900.0]) @ turn.T
    unknown = np.full((3, 3), np.nan)
    GnssFixes(np.arange(3), places, [good, unknown, good])
    with pytest.raises(InputError, match=r"positive definite .* for fix 2 \(1 of 3 are none"):
        GnssFixes(np.arange(3), places, [good, unknown, wrong])


def test_fixes_and_wheels_keep_arrays_of_what_was_given():
    fixes = GnssFixes([0, 1], [[47.5, 8.5, 450.0]] * 2, [[[1, 0, 0], [0, 1, 0], [0, 0, 1]]] * 2)
    assert fixes.stamps.dtype == np.int64
    assert fixes.geodetic[1:].shape == (1, 3)
    assert fixes.covariances[0, 0, 0] == 1.0
    wheels = WheelSamples([0, 1], np.tile(np.eye(4), (2, 1, 1)).tolist())
    assert (wheels.stamps[1:] - 1).tolist() == [0]
    assert wheels.start_T_body.shape == (2, 4, 4)
    with pytest.raises(InputError, match=r"covariances: expected .* numbers"):
        GnssFixes([0], [[47.5, 8.5, 450.0]], [["a"] * 3] * 3)
