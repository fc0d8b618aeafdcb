"""A user's own factors: on the pose of a sweep, and between it and the last one."""

import re
import runpy
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from support.quick import QUICK, begin_quickly
from support.worlds import seen_from_first

from loam_gtsam.config import Config, SolverConfig
from loam_gtsam.datasets.base import PartOf
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.factors import checked_factor
from loam_gtsam.mapper import Mapper
from loam_gtsam.pipeline import run
from loam_gtsam.registration.solvers import POSE_KEY, MotionPrior
from loam_gtsam.registration.solvers.own_factors import LAST_KEY, PoseContext, own_factors
from loam_gtsam.studies.evaluation import absolute_error, nees
from loam_gtsam.types import Features, FrameStatus, InputError

LAST = gtsam.Pose3(gtsam.Rot3.Ypr(0.4, -0.2, 0.1), np.array([3.0, -1.0, 0.5]))
MOVED = gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.05, -0.02), np.array([1.0, 0.2, -0.1]))
SIGMAS = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
NOT_A_NUMBER = gtsam.noiseModel.Isotropic.Sigma(6, np.nan)
NOISE = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
CONTEXT = PoseContext(POSE_KEY, 0, LAST, (0, LAST))


def between(noise=NOISE, *, turned=False):
    if turned:
        return gtsam.BetweenFactorPose3(POSE_KEY, LAST_KEY, MOVED.inverse(), noise)
    return gtsam.BetweenFactorPose3(LAST_KEY, POSE_KEY, MOVED, noise)


def own_between(noise=NOISE):
    """The same as a factor written in Python."""

    def error(values):
        last, pose = values.atPose3(LAST_KEY), values.atPose3(POSE_KEY)
        off = MOVED.between(last.between(pose))
        by_pose = gtsam.Pose3.LogmapDerivative(off)
        by_last = -by_pose @ pose.between(last).AdjointMap()
        return gtsam.Pose3.Logmap(off), [by_last, by_pose]

    return checked_factor(noise, [LAST_KEY, POSE_KEY], error)


def hall_features(pose, stamp, rng):
    """Floor, ceiling and both sides of a hall without ends, and the lines where they meet."""
    planes = rng.uniform(-1.0, 1.0, (6000, 3)) * [20.0, 4.0, 2.0]
    axes, rows = rng.integers(1, 3, 6000), np.arange(6000)
    planes[rows, axes] = np.sign(planes[rows, axes]) * np.array([20.0, 4.0, 2.0])[axes]
    edges = np.sign(rng.uniform(-1.0, 1.0, (300, 3))) * [0.0, 4.0, 2.0]
    edges[:, 0] = rng.uniform(-20.0, 20.0, 300)
    local = pose.inverse()
    return Features.from_points(stamp, *(local.transformFrom(p.T).T for p in (edges, planes)))


def at(pose):
    values = gtsam.Values()
    values.insert(POSE_KEY, pose)
    return values


@pytest.mark.parametrize("make", [between, lambda: between(turned=True), own_between])
@pytest.mark.parametrize("step", [np.zeros(6), np.full(6, 0.01), np.full(6, 0.4)])
def test_with_the_last_pose_held_a_factor_is_a_prior(make, step):
    """Error and information are those of a prior at the last pose moved by the increment."""
    (factor,) = own_factors(lambda context: [make()], CONTEXT).since_last
    assert list(factor.keys()) == [POSE_KEY]
    pose = LAST.compose(MOVED).retract(step)
    both = at(pose)
    both.insert(LAST_KEY, LAST)
    assert factor.error(at(pose)) == pytest.approx(make().error(both), rel=1e-9, abs=1e-12)
    numerical = np.empty((6, 6))
    for column, small in enumerate(1e-6 * np.eye(6)):
        ahead, back = (at(pose.retract(sign * small)) for sign in (1.0, -1.0))
        rows = [-np.asarray(factor.linearize(values).jacobian()[1]) for values in (ahead, back)]
        numerical[:, column] = (rows[0] - rows[1]) / 2e-6
    np.testing.assert_allclose(factor.linearize(at(pose)).jacobian()[0], numerical, atol=1e-4)


@pytest.mark.parametrize("make", [between, lambda: between(turned=True), own_between])
@pytest.mark.parametrize("step", [np.zeros(6), np.full(6, 0.3)])
def test_the_last_pose_is_as_well_known_as_it_is_told(make, step):
    """The information is what is left of both poses without the last one."""
    error = np.diag(np.array([0.02, 0.01, 0.03, 0.2, 0.1, 0.4]) ** 2)
    pose = LAST.compose(MOVED).retract(step)
    context = replace(CONTEXT, map_T_middle=pose)
    (factor,) = own_factors(lambda context: [make()], context, error).since_last
    jacobian, right = factor.linearize(at(pose)).jacobian()
    both = at(pose)
    both.insert(LAST_KEY, LAST)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(make())
    graph.add(gtsam.PriorFactorPose3(LAST_KEY, LAST, gtsam.noiseModel.Gaussian.Covariance(error)))
    ordering = gtsam.Ordering()
    for key in (LAST_KEY, POSE_KEY):
        ordering.push_back(key)
    whole, pull = graph.linearize(both).hessian(ordering)
    gain = whole[6:, :6] @ np.linalg.inv(whole[:6, :6])
    np.testing.assert_allclose(
        jacobian.T @ jacobian, whole[6:, 6:] - gain @ whole[:6, 6:], rtol=1e-6
    )
    np.testing.assert_allclose(jacobian.T @ right, pull[6:] - gain @ pull[:6], atol=1e-6)


def test_a_robust_kernel_still_lets_go_of_what_is_wrong():
    huber = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.0), NOISE)
    far = LAST.compose(MOVED).retract(np.array([0, 0, 0, 10.0, 0, 0]))
    (factor,) = own_factors(lambda context: [between(huber)], CONTEXT).since_last
    (firm,) = own_factors(lambda context: [between()], CONTEXT).since_last
    pulls = []
    for one in (factor, firm):
        jacobian, right = one.linearize(at(far)).jacobian()
        pulls.append(np.linalg.norm(jacobian.T @ right))
    assert pulls[0] < 0.02 * pulls[1]


def test_wheels_hold_the_pose_along_a_hall_without_ends():
    """Nothing but a between-factor knows how far the sweep moved along."""
    rng = np.random.default_rng(1)

    def wheels(context):
        moved = gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.0, 0.0]))
        noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
        return [gtsam.BetweenFactorPose3(context.last_key, context.key, moved, noise)]

    found = []
    for extra in (None, wheels):
        mapper = Mapper(QUICK, extra_factors=extra)
        for number in range(6):
            pose = gtsam.Pose3(gtsam.Rot3(), np.array([0.3 * number, 0.0, 0.0]))
            features = hall_features(pose, number * 10**8, rng)
            update = mapper.register(features, guess=gtsam.Pose3())
        found.append(update.map_T_lidar.x())
    assert found[0] < 0.75
    assert found[1] == pytest.approx(1.5, abs=0.05)


def positions(world, context, sigma, rng):
    """Of a receiver."""
    here = world.truth_at(np.array([context.middle_stamp]))[0].translation()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    return [gtsam.GPSFactor(context.key, here + rng.normal(0.0, sigma, 3), noise)]


def steps(world, context, sigma, rng):
    """Of an odometry that drifts."""
    last, now = world.truth_at(np.array([context.last[0], context.middle_stamp]))
    sigmas = np.repeat([0.01, sigma], 3)
    step = last.between(now).retract(rng.normal(0.0, sigmas))
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    return [gtsam.BetweenFactorPose3(context.last_key, context.key, step, noise)]


@pytest.mark.parametrize(("make", "sigma", "grows"), [(positions, 0.1, False), (steps, 0.02, True)])
def test_where_the_scan_is_blind_own_factors_decide(make, sigma, grows):
    """And not the velocity, which the poses before have told: it kept the run where it began."""
    world = SimulatedWorld("corridor_bare", frames=40, columns=240, max_range=6.0)
    rng = np.random.default_rng(5)
    without = Config().changed("imu.coupling=off")
    result = run(world, without, extra_factors=lambda context: make(world, context, sigma, rng))
    assert world.truth.positions[-1, 0] > 10.0
    found = nees(result.updates, world.truth)
    assert len(found.beyond) == 0
    assert 0.2 < found.mean < 2.0
    told = [np.sqrt(update.covariance[3, 3]) for update in result.updates]
    expected = sigma * (np.sqrt(len(told)) if grows else 1.0)
    assert 0.7 * expected < told[-1] < 2.0 * expected


def test_the_expected_motion_stays_where_own_factors_hardly_tell_it():
    expected = MotionPrior(LAST, np.diag([1e6] * 3 + [1e4] * 3))
    sigmas = np.array([1.0, 1e-3, 1.0, 0.2, 50.0, 1.5])
    beside = expected.beside(MotionPrior(LAST, np.diag(sigmas**-2)), 0.1, SolverConfig())
    kept = [True, False, True, False, True, True]
    variances = np.diag(np.linalg.inv(beside.information))
    possible = np.repeat([0.05, 1.0], 3) ** 2  # rad and m within 0.1 s
    before = np.repeat([1e-6, 1e-4], 3)
    np.testing.assert_allclose(variances, np.where(kept, before, before + possible))
    for same in (replace(expected, measured=True), replace(expected, information=np.zeros((6, 6)))):
        assert same.beside(MotionPrior(LAST, 1e6 * np.eye(6)), 0.1, SolverConfig()) is same


def test_a_height_in_a_corridor_leaves_the_way_along_it_alone(monkeypatch):
    """With the tilt it tells where along the corridor, to 50 m; the run was 48 m off with that."""
    begin_quickly(monkeypatch)
    world = SimulatedWorld("corridor", seed=2, frames=150, columns=300)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e2, 1e2, 0.02]))
    rng = np.random.default_rng(2)

    def height(context):
        x, y, z = seen_from_first(world, context.middle_stamp).translation()
        where = np.array([x, y, z + rng.normal(0.0, 0.02)])
        return [gtsam.GPSFactor(context.key, where, noise)]

    config = Config().changed("imu.level=false")
    for update in run(PartOf(world, 0, 1, end_s=5.5), config, extra_factors=height).updates:
        assert update.map_T_lidar.range(seen_from_first(world, update.stamp)) < 0.1
        assert update.status.solved or update.status is FrameStatus.FIRST


def test_a_sweep_that_is_lost_by_factors_says_so():
    """Positions that jump by 10 m for three sweeps; the run goes on as before."""
    world = SimulatedWorld("room", frames=20, columns=300)
    noise, wrong = gtsam.noiseModel.Isotropic.Sigma(3, 0.02), world.truth.stamps[12:15]

    def receiver(context):
        where = seen_from_first(world, context.middle_stamp).translation()
        jump = 10.0 * bool(wrong[0] < context.middle_stamp < wrong[-1] + 10**8)
        return [gtsam.GPSFactor(context.key, where + jump, noise)]

    config = QUICK.changed("imu.level=false")
    result = run(world, config, extra_factors=receiver)
    updates = result.updates
    lost = [update.status is FrameStatus.LOST for update in updates]
    assert np.flatnonzero(lost).tolist() == [13, 14]  # the first one has too few matches
    said = ["without the factors beside the scan" in update.message for update in updates]
    assert said == lost
    assert absolute_error(result.trajectory, world.truth).translations[-1] < 0.02


@pytest.mark.parametrize(
    ("factors", "says"),
    [
        (None, "expected a list of factors.*got NoneType"),
        (["barometer"], r"got str on the keys \[\]"),
        ([between(gtsam.noiseModel.Isotropic.Sigma(6, 0.0))], "got BetweenFactorPose3 with NaN"),
        ([gtsam.PriorFactorPose3(POSE_KEY, LAST, NOISE), between(NOT_A_NUMBER)], "with NaN"),
        ([gtsam.GPSFactor(7, np.zeros(3), gtsam.noiseModel.Unit.Create(3))], r"on the keys \[7\]"),
        ([gtsam.GPSFactor(LAST_KEY, np.zeros(3), gtsam.noiseModel.Unit.Create(3))], "context.key"),
    ],
)
def test_what_is_no_factor_of_the_frame_is_an_error(factors, says):
    with pytest.raises(InputError, match=f"extra_factors: .*{says}"):
        own_factors(lambda context: factors, CONTEXT)


def test_factors_may_be_in_a_graph_or_yielded():
    graph = gtsam.NonlinearFactorGraph()
    graph.add(between())
    graph.add(gtsam.GPSFactor(POSE_KEY, np.zeros(3), gtsam.noiseModel.Unit.Create(3)))
    for factors in (graph, (graph.at(place) for place in range(2))):
        found = own_factors(lambda context, factors=factors: factors, CONTEXT)
        assert (len(found.alone), len(found.since_last)) == (1, 1)


def test_the_solvers_of_the_documentation_keep_degenerate_frames_degenerate(monkeypatch):
    """A hall without ends; a solver that drops ``motion`` would call every frame ok."""
    begin_quickly(monkeypatch)
    root = Path(__file__).resolve().parents[2]
    page = (root / "docs/own_factor.md").read_text("utf-8")
    names = runpy.run_path(str(root / "examples/14_own_solver.py"))
    exec(re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)[-1], names)
    for kind in (names["Loud"], names["GaussNewton"]):
        rng = np.random.default_rng(1)
        mapper = Mapper(QUICK, solver=kind(QUICK.solver))
        for number in range(3):
            update = mapper.register(hall_features(gtsam.Pose3(), number * 10**8, rng))
        assert update.status is FrameStatus.DEGENERATE
