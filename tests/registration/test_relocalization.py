"""Sweeps that do not fit the map: noticed, searched for, found; and none of that otherwise."""

from __future__ import annotations

from copy import copy, deepcopy
from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.quick import PREDICTED, QUICK

from loam_gtsam.config import Config, RelocalizationConfig
from loam_gtsam.datasets.arrays import ArrayDataset
from loam_gtsam.datasets.sim.disturbances import (
    Disturbed,
    Kidnapped,
    MissingSweeps,
    MovingObjects,
    Outliers,
)
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.io.rollback import Before
from loam_gtsam.pipeline import Pipeline, effective_config, run
from loam_gtsam.registration.frame_matcher import Frame, FrameMatcher
from loam_gtsam.registration.matches import (
    EdgeMatches,
    PlaneMatches,
    ScanMatches,
    joined,
    subset,
)
from loam_gtsam.registration.odometry import Moment, predict
from loam_gtsam.registration.relocalization import (
    Doubt,
    Field,
    Fit,
    FitMonitor,
    Found,
    Lost,
    accept,
    any_of,
    doubtful,
    doubtful_sweeps,
    likely_poses,
    one_per_cell,
    sample_features,
    search,
)
from loam_gtsam.registration.relocalization import places as places_module
from loam_gtsam.registration.relocalization.evidence import Evidence, favour
from loam_gtsam.registration.report import Clock
from loam_gtsam.registration.solvers import GtsamSolver, MotionPrior
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import FrameStatus, ImuSamples, TiltPrior, Trajectory

AT = 22
"""The sweep before which the lidar is put somewhere else."""


def with_search(**changes):
    return Config().changed(relocalization=Config().relocalization.changed(**changes))


OFF = with_search(enabled=False)
REACH = 1.0  # metres


@pytest.fixture(scope="module")
def drive():
    """Some sweeps of the room, which it sees from end to end."""
    return SimulatedWorld("room", frames=28, columns=450)


@pytest.fixture(scope="module")
def calm(drive):
    return ArrayDataset(list(drive), truth=drive.truth, sensor=drive.sensor)


def put(drive, calm, move=(0.0, 0.0, 0.0), turn_deg=0.0):
    """The drive with a kidnapping, made of as few new sweeps as possible."""
    moved = Kidnapped(drive, AT, move, turn_deg)
    sweeps = [*list(calm)[:AT], *(moved[i] for i in range(AT, len(drive)))]
    return ArrayDataset(sweeps, truth=moved.truth, sensor=drive.sensor)


@pytest.fixture(scope="module")
def kidnapped(drive, calm):
    """Across the room and turned, out of which no solve finds its way."""
    return put(drive, calm, (-3.0, 2.0, 0.0), 120.0)


@pytest.fixture(scope="module")
def begun(calm):
    """The run up to the sweep AT, with the watch and without: the pipelines, and the updates."""
    pipelines = [Pipeline(effective_config(config, calm)) for config in (Config(), OFF)]
    return [(one, [one.process(sweep) for sweep in list(calm)[:AT]]) for one in pipelines]


def ended(begun, dataset):
    """A run that was begun, with the sweeps from AT on; another can then end it otherwise."""
    pipeline, updates = begun
    before = Before(pipeline)
    rest = [pipeline.process(sweep) for sweep in list(dataset)[AT:]]
    result = pipeline.result([*updates, *rest])
    before.restore()
    return result


def errors(result, dataset):
    away = result.trajectory.positions - dataset.truth.positions
    return np.linalg.norm(away, axis=1)


def matches(edge_distances, plane_distances, sigma=0.1):
    n, m = len(edge_distances), len(plane_distances)
    ones = lambda count: np.ones((count, 3))  # noqa: E731
    return ScanMatches(
        EdgeMatches(
            ones(n), ones(n), ones(n), np.asarray(edge_distances), np.full(n, sigma), np.ones(n),
            np.arange(n),
        ),
        PlaneMatches(
            ones(m), ones(m), np.ones(m), np.asarray(plane_distances), np.full(m, sigma),
            np.ones(m), np.arange(m),
        ),
    )  # fmt: skip


def test_a_fit_counts_matches_within_three_sigmas_on_either_side():
    fit = Fit.of(matches([0.0, 0.29, 0.31], [-0.29, -0.31]), 10, REACH)
    assert fit == Fit(share=0.5, agreement=0.6)
    assert fit.total == pytest.approx(0.3)
    assert Fit.of(matches([], []), 10, REACH) == Fit(0.0, 0.0)


@pytest.mark.parametrize(
    ("away", "lost"),
    [(0.0, False), (0.4, True)],
    ids=["at the right place", "at a wrong one"],
)
def test_matches_that_agree_anywhere_neither_lose_a_sweep_nor_save_it(away, lost):
    """As those of vineyard posts, which are looked for in one sweep and not in the next."""

    def fits(away):
        sure, vague = matches([away] * 7, [away] * 193), matches([0.9] * 1000, [], sigma=0.5)
        both = replace(sure, edges=joined(sure.edges, vague.edges))
        return [Fit.of(some, 1500, REACH) for some in (sure, both, vague)]

    monitor = FitMonitor(RelocalizationConfig(memory=2))
    for _ in range(2):
        monitor.accept(fits(0.0)[1], gtsam.Pose3())
    sure, both, vague = fits(away)
    assert sure == both == Fit(200 / 1500, 0.0 if lost else 1.0)
    assert monitor.misfit(sure) is monitor.misfit(both) is lost
    assert vague == Fit(0.0, 0.0)


def test_the_usual_is_the_median_of_what_went_into_the_map():
    monitor = FitMonitor(RelocalizationConfig(memory=3))
    assert not monitor.ready
    for share in (0.1, 0.5, 0.6, 0.9):
        monitor.accept(Fit(share, 1.0), gtsam.Pose3())
    assert monitor.ready
    assert monitor.usual == Fit(0.6, 1.0)


@pytest.fixture
def monitor():
    monitor = FitMonitor(RelocalizationConfig(memory=2))
    for _ in range(2):
        monitor.accept(Fit(0.6, 1.0), gtsam.Pose3())
    return monitor


@pytest.mark.parametrize(
    ("fit", "misfit", "again"),
    [
        (Fit(0.6, 1.0), False, True),
        (Fit(0.6, 0.85), False, False),  # in between: neither
        (Fit(0.6, 0.79), True, False),
        (Fit(0.3, 1.0), False, False),  # new ground
        (Fit(0.2, 1.0), True, False),
    ],
)
def test_two_thresholds_keep_apart_lost_and_found(monitor, fit, misfit, again):
    assert monitor.misfit(fit) is misfit
    assert monitor.fits_again(fit) is again


@pytest.mark.parametrize(("accepted", "known"), [(3, False), (4, True)])
def test_nothing_is_unusual_in_the_first_sweeps(accepted, known):
    monitor = FitMonitor(RelocalizationConfig(memory=10))
    for _ in range(accepted):
        monitor.accept(Fit(0.6, 1.0), gtsam.Pose3())
    assert monitor.misfit(Fit(0.0, 0.0)) is known
    assert monitor.unusual(Fit(0.6, 0.9)) is known
    assert monitor.jumped(np.full(6, 100.0), 0.1) is known


@pytest.mark.parametrize(
    ("agreements", "agreement", "unusual"),
    [
        ([0.99, 0.98, 0.99, 1.0, 0.985], 0.90, True),
        ([0.99, 0.98, 0.99, 1.0, 0.985], 0.97, False),
        ([0.85, 0.95, 0.9, 0.92, 0.87], 0.80, False),  # people pass by
        ([0.99, 0.5, 0.99, 1.0, 0.985], 0.90, True),  # one that did not fit either changes nothing
    ],
)
def test_unusual_is_what_agrees_less_than_the_scatter_of_the_sweeps_before(
    agreements, agreement, unusual
):
    monitor = FitMonitor(RelocalizationConfig())
    for one in agreements:
        monitor.accept(Fit(0.6, one), gtsam.Pose3())
    assert monitor.unusual(Fit(0.6, agreement)) is unusual
    assert not monitor.misfit(Fit(0.6, agreement))


@pytest.mark.parametrize(
    ("step", "seconds", "jumped"),
    [
        ([0, 0, 0, 0.29, 0, 0], 0.1, False),
        ([0, 0, 0, 0.31, 0, 0], 0.1, True),
        ([0, 0, 0.29, 0, 0, 0], 0.1, False),
        ([0, 0, 0.31, 0, 0, 0], 0.1, True),
        ([0, 0, 0, 5.0, 0, 0], 0.6, False),  # five sweeps are missing
    ],
)
def test_a_jump_is_what_no_acceleration_explains(monitor, step, seconds, jumped):
    assert monitor.jumped(np.array(step, float), seconds) is jumped


def test_the_search_grows_and_remembers_where_it_fitted_last():
    config = RelocalizationConfig(memory=1, radius=4.0, radius_growth=2.0, max_radius=9.0)
    monitor = FitMonitor(config)
    here, far = gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3(), np.array([20.0, 0.0, 0.0]))
    assert monitor.around(far) == [far]
    monitor.accept(Fit(0.6, 1.0), here)
    assert monitor.around(here) == [here]
    assert monitor.around(far) == [far, here]
    # A turn from before may have led to a tilt that no search changes.
    tilted = gtsam.Pose3(gtsam.Rot3.Pitch(np.radians(20.0)), np.zeros(3))
    assert monitor.around(tilted) == [tilted, here]
    radii = []
    for monitor.lost in range(4):
        radii.append(monitor.radius)
    assert radii == [4.0, 6.0, 8.0, 9.0]
    monitor.accept(Fit(0.6, 1.0), here)
    assert monitor.lost == 0


@pytest.fixture(scope="module")
def corner():
    """An L of two unlike walls: looks different from everywhere."""
    rng = np.random.default_rng(3)
    long = np.column_stack([rng.uniform(0, 12, 3000), np.zeros(3000), rng.uniform(-1, 2, 3000)])
    short = np.column_stack([np.zeros(1200), rng.uniform(0, 5, 1200), rng.uniform(-1, 2, 1200)])
    return np.concatenate([long, short])


def likely_in(held, seen, centres, radius, *options, **named):
    """The likely poses in a map of these points."""
    fields = [Field.around(held, centre, radius) for centre in centres]
    return likely_poses(seen, fields, centres, *options, **named)


@pytest.mark.parametrize(
    ("away", "turn"), [((0.0, 0.0), 0.0), ((4.0, -3.0), 0.7), ((-6.3, 2.4), -2.6)]
)
def test_the_likeliest_place_is_the_true_one(corner, away, turn):
    predicted = gtsam.Pose3(gtsam.Rot3.Yaw(0.2), np.array([4.0, 3.0, 0.3]))
    step = gtsam.Pose3(gtsam.Rot3.Yaw(turn), np.array([*away, 0.0]))
    truth = predicted.compose(step)
    seen = truth.transformTo(corner[::15].T).T
    found = likely_in(corner, seen, [predicted], 8.0, 4)
    assert 1 <= len(found) <= 4
    error = truth.localCoordinates(found[0])
    assert np.linalg.norm(error[3:]) < 1.0
    assert np.abs(error[:3]).max() < np.radians(6.0)
    nearer = likely_in(corner, seen, [predicted], 8.0, 4, apart=(0.8, 0.2))
    assert nearer[0].equals(found[0], 0.0)
    assert min(nearer[0].range(pose) for pose in nearer[1:]) < 1.5
    few = one_per_cell(corner)
    assert len(few) < 0.1 * len(corner)
    again = likely_in(few, seen, [predicted], 8.0, 4)
    assert all(one.equals(other, 0.0) for one, other in zip(found, again, strict=True))
    for i, first in enumerate(found):
        for second in found[:i]:
            apart = first.localCoordinates(second)
            assert np.linalg.norm(apart[3:]) >= 1.5 or abs(apart[2]) >= np.radians(12.0)


@pytest.mark.parametrize(("as_well", "nearest"), [(None, False), (0.75, True)])
def test_along_a_corridor_the_nearest_of_the_poses_that_fit_alike_comes_first(as_well, nearest):
    """Two walls, of which a far part is seen a little better."""
    ends = np.linspace(-20.0, 20.0, 2000)
    walls = [np.column_stack([ends, np.full(2000, y), np.zeros(2000)]) for y in (-1.0, 1.0)]
    points = np.concatenate(walls)[::25]
    known = np.concatenate(walls) - [6.0, 0.0, 0.0]
    found = likely_in(known, points, [gtsam.Pose3()], 8.0, 1, as_well=as_well)[0]
    assert bool(np.linalg.norm(found.translation()[:2]) < 0.1) is nearest


def test_several_centres_are_searched(corner):
    truth = gtsam.Pose3(gtsam.Rot3(), np.array([4.0, 3.0, 0.3]))
    seen = truth.transformTo(corner[::15].T).T
    nowhere = gtsam.Pose3(gtsam.Rot3(), np.array([300.0, 0.0, 0.0]))
    assert likely_in(corner, seen, [nowhere], 3.0, 4) == []
    found = likely_in(corner, seen, [nowhere, truth], 3.0, 4)
    assert truth.range(found[0]) < 1.0


@pytest.mark.parametrize("rare", [True, False])
@pytest.mark.parametrize("radius", [3.0, 8.0])
def test_what_is_ruled_out_unseen_would_not_have_been_likely(corner, radius, rare):
    """Blocks of trial poses are left out by what they score at most: none of it is missed."""
    centres = [gtsam.Pose3(gtsam.Rot3.Yaw(turn), np.array([x, 3.0, 0.3]))
               for turn, x in ((0.3, 4.0), (-2.0, -1.0))]  # fmt: skip
    seen = centres[0].transformTo(corner[::15].T).T
    apart = 0.1, 0.05  # all trial poses
    every = likely_in(corner, seen, centres, radius, 400, rare=rare, apart=apart)
    best = likely_in(corner, seen, centres, radius, 400, rare=rare, apart=apart, least=0.5)
    assert 3 < len(best) < 300
    assert all(one.equals(other, 0.0) for one, other in zip(best, every, strict=False))


def test_of_several_places_those_are_left_out_that_fit_worse(corner):
    """Each has its own part of the map; one above the other is another place."""
    truth, up = gtsam.Pose3(gtsam.Rot3(), np.array([4.0, 3.0, 0.3])), np.array([0.0, 0.0, 3.0])
    centres = [truth, gtsam.Pose3(truth.rotation(), truth.translation() + up)]
    seen = truth.transformTo(corner[::15].T).T

    def found(share, least):
        known = corner, corner[: int(share * len(corner))] + up
        parts = zip(known, centres, strict=True)
        fields = [Field.around(part, centre, 0.0) for part, centre in parts]
        return likely_poses(seen, fields, centres, 9, 0.0, least=least)

    assert len(found(1.0, 0.75)) == 2
    assert len(found(0.5, 0.0)) == 2
    (best,) = found(0.5, 0.75)
    assert truth.equals(best, 1e-9)


@pytest.mark.parametrize("rare", [True, False])
def test_what_is_rare_counts_more_than_ground(rare):
    """The ground that two sweeps see overlaps most at rest; what stands on it says otherwise."""
    rng = np.random.default_rng(5)

    def seen_ground():
        x, y = rng.uniform(-12.0, 12.0, (2, 500))
        return np.column_stack([x, y, np.full(500, -1.5)])[np.hypot(x, y) < 12.0]

    posts = np.repeat(rng.uniform(-15.0, 15.0, (6, 2)), 3, axis=0)
    posts = np.column_stack([posts, np.tile([-1.0, 0.0, 1.0], 6)])
    truth = gtsam.Pose3(gtsam.Rot3(), np.array([4.0, 0.0, 0.0]))
    ground, known = seen_ground(), seen_ground()
    seen = np.concatenate([truth.transformTo(posts.T).T, ground])
    there = np.concatenate([posts, known])
    (found,) = likely_in(there, seen, [gtsam.Pose3()], 5.0, 1, 0.1, rare=rare)
    assert (truth.range(found) < 0.1) == rare


def test_a_few_points_stand_for_a_sweep():
    edges, planes = np.zeros((1000, 3)), np.ones((50, 3))
    assert sample_features(edges, planes).sum() == 3 * 50
    assert 50 < len(sample_features(edges, planes)) < 200
    assert len(sample_features(edges, planes, (500, 20))) == 520
    assert sample_features(edges[:0], planes[:0]).shape == (0, 3)


@pytest.fixture(scope="module")
def before(begun):
    """The mapper when the sweep AT comes."""
    return begun[0][0].mapper


def frame_of(mapper, sweep):
    config, last = mapper.config, mapper.last
    moving = MovingSweep(extract_features(sweep, config), config)
    middle = Moment(last.middle_stamp, last.map_T_middle, True)
    predicted = predict(moving, last, middle, None, config.solver)
    matcher = FrameMatcher.of(predicted.posed, mapper.maps, config, middle, Clock(), refine=True)
    return Frame(matcher, predicted, [])


def search_in(mapper, sweep, monitor):
    """Whether the solve is in doubt, the outcome of the search, and the solution in doubt."""
    frame = frame_of(mapper, sweep)
    solution = frame.solve(mapper.solver)
    doubt = doubtful(frame, solution, monitor, mapper.last.twist)
    return doubt, search(frame, solution, monitor, mapper.solver, Doubt.MISFIT), solution


def test_a_search_finds_a_sweep_that_was_carried_away_and_changes_nothing(before, kidnapped):
    points = before.maps.points()
    doubt, found, solution = search_in(before, list(kidnapped)[AT], before.monitor)
    assert doubt is Doubt.MISFIT
    assert isinstance(found, Found)
    assert found.message.startswith("relocalised, moved by 3.")
    truth = kidnapped.truth.map_T_lidar[AT, :3, 3]
    assert np.linalg.norm(found.solution.map_T_lidar.translation() - truth) < 0.15
    assert np.linalg.norm(solution.map_T_lidar.translation() - truth) > 1.0
    assert before.monitor.lost == 0
    assert all(map(np.array_equal, before.maps.points(), points))


class _Watched(GtsamSolver):
    """A solver that notes how far from its start each pose is expected, metres; inf for nowhere."""

    def __init__(self, config):
        super().__init__(config)
        self.away = []

    def solve(self, associate, guess, priors=(), motion=None):
        self.away.append(np.inf if motion is None else motion.map_T_lidar.range(guess))
        return super().solve(associate, guess, priors, motion)


def test_along_what_a_sweep_does_not_show_a_tried_place_stays_where_it_is(before, kidnapped):
    before = copy(before)
    before.solver = _Watched(before.config.solver)
    search_in(before, list(kidnapped)[AT], before.monitor)
    assert len(before.solver.away) > 5
    assert max(before.solver.away) == 0.0


@pytest.mark.parametrize(
    ("fits", "lost", "order"),
    [
        ((0.40, 0.50, 0.45), 0, [0, 1, 2]),  # all as good: the nearest first
        ((0.30, 0.50, 0.45), 0, [1, 2]),
        ((0.40, 0.50, 0.30), 1, [1, 0]),  # it was tried in vain: the best first
        ((0.30, 0.50, 0.30), 0, [1]),
    ],
)
def test_of_places_that_fit_as_well_the_nearest_comes_first(
    fits, lost, order, before, calm, monkeypatch
):
    frame = frame_of(before, list(calm)[AT])
    expected = frame.predicted.map_T_middle
    places = [expected.compose(gtsam.Pose3(gtsam.Rot3(), [x, 0.0, 0.0])) for x in (0.2, 4.0, 8.0)]
    solver = SimpleNamespace(
        solve=lambda matcher, start, *_: SimpleNamespace(solved=True, map_T_lidar=start, matches=0)
    )
    told = iter(fits)
    monkeypatch.setattr(places_module, "likely_poses", lambda *_, **__: places)
    monkeypatch.setattr(Fit, "of", lambda *_: SimpleNamespace(total=next(told)))
    unsolved = SimpleNamespace(solved=False)
    watch = SimpleNamespace(lost=lost, radius=10.0, around=lambda pose: [pose])
    found = places_module.likely_places(frame, unsolved, watch, solver)
    assert [id(pose) for pose in found] == [id(places[k]) for k in order]


@pytest.mark.parametrize(
    ("metres", "measured", "left"),
    [
        ((0.0, 0.05, 4.0, 3.0), True, [0, 1, 2]),
        ((0.0, 0.05, 4.0, 3.0), False, [0, 1, 2, 3]),  # a constant velocity measures nothing
        ((3.0, -3.0), True, [0, 1]),  # an IMU that contradicts every place is not heeded
    ],
)
def test_a_place_that_an_imu_contradicts_is_none(metres, measured, left):
    """By what the IMU allows, 1 cm, and the scan: it knows its y to 4 cm, or at 4 m not at all."""
    told = MotionPrior(gtsam.Pose3(), 1e4 * np.eye(6), measured=measured)
    places = [
        SimpleNamespace(
            solved=True,
            map_T_lidar=gtsam.Pose3(gtsam.Rot3(), [0.0, x, 0.0]),
            information=np.diag([1e8, 1e8, 1e8, 1e8, 0.0 if x == 4.0 else 2500.0, 1e8]),
        )
        for x in metres
    ]
    assert places_module._as_measured(places, told) == [places[k] for k in left]


class _OneStepUp(GtsamSolver):
    """The scan alone ends a step of the stairs too high; beside the IMU it keeps some matches."""

    keeps = 1.0

    def solve(self, associate, guess, priors=(), motion=None):
        found = super().solve(associate, guess, priors, motion)
        if priors:
            kinds = found.matches.edges, found.matches.planes
            kept = [subset(kind, np.arange(len(kind)) < self.keeps * len(kind)) for kind in kinds]
            return replace(found, matches=ScanMatches(*kept))
        return replace(found, map_T_lidar=found.map_T_lidar.retract([0, 0, 0, 0, 0, 0.2]))


@pytest.mark.parametrize(
    ("solver", "keeps", "measured", "away", "beside"),
    [
        (_OneStepUp, 1.0, True, 0.0, True),
        (_OneStepUp, 0.5, True, 0.0, False),  # there it hardly fits
        (_OneStepUp, 1.0, False, 0.0, False),  # no IMU says so
        (GtsamSolver, 1.0, True, 0.3, False),  # the IMU is wrong: the scan leads away all the same
        (GtsamSolver, 1.0, True, 0.0, False),  # the two agree
    ],
)
def test_a_scan_that_leads_away_from_the_imu_is_solved_beside_it(
    solver, keeps, measured, away, beside, before, calm
):
    frame, solver = frame_of(before, list(calm)[AT]), solver(before.config.solver)
    solver.keeps, right = keeps, frame.solve(before.solver)
    expected = right.map_T_lidar.retract([0.0, 0.0, 0.0, away, 0.0, 0.0])
    told = MotionPrior(expected, np.diag([1e6, 1e6, 1e6, 1e5, 1e5, 1e5]), measured=measured)
    frame = replace(frame, predicted=replace(frame.predicted, motion=told))
    found = doubtful_sweeps._solved(frame, solver)
    assert found.beside_imu is beside
    config = frame.matcher.config.changed("solver.method=loam", "imu.prior=off")
    classical = replace(frame, matcher=replace(frame.matcher, config=config))
    assert not doubtful_sweeps._solved(classical, solver).beside_imu
    if not beside:
        assert found.solution.map_T_lidar.equals(frame.solve(solver).map_T_lidar, 1e-9)
        return
    assert found.solution.map_T_lidar.range(right.map_T_lidar) < 0.005
    # The IMU's part is not in what the scan is told to know.
    assert np.allclose(found.solution.information, right.information, rtol=0.1, atol=1e4)


@pytest.mark.parametrize("share", [0.9, 0.1])
def test_a_sweep_that_fits_with_no_expected_motion_tells_one_by_itself(share, before, calm):
    """After a blind way the velocity is anything; of what matches nothing, it is not asked."""
    frame, monitor = frame_of(before, list(calm)[AT]), deepcopy(before.monitor)
    solution = frame.solve(before.solver)
    monitor.fits_again = lambda fit: fit.agreement > 0.97
    monitor.might_agree = lambda fit: fit.share > 1.0 - share
    wrong = frame.matcher.posed.twist + np.array([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
    place = solution.map_T_lidar.retract([0.0, 0.0, 0.02, 0.05, 0.0, 0.0])
    args = frame, place, [wrong], monitor, before.solver
    found = doubtful_sweeps._with_motion(*args)
    if share < 0.5:
        assert found is None
        return
    monitor.unusual = lambda fit: True
    assert doubtful_sweeps._with_motion(*args) is None  # it may tell any, and has to fit as usual
    assert np.linalg.norm(found.posed.twist[:3] - frame.posed_for(solution).twist[:3]) < 0.3
    assert found.solution.map_T_lidar.range(solution.map_T_lidar) < 0.01


def test_what_no_motion_solves_is_found_nowhere(before, calm):
    """Nor while nothing is known of what is usual."""
    frame, monitor = frame_of(before, list(calm)[AT]), FitMonitor(before.config.relocalization)
    far = gtsam.Pose3(gtsam.Rot3(), [0.0, 0.0, 500.0])
    twists = [frame.matcher.posed.twist]
    assert doubtful_sweeps._with_motion(frame, far, twists, monitor, before.solver) is None


def test_a_velocity_that_lasts_is_no_jump_from_the_second_sweep_on(before, calm, monkeypatch):
    """A sweep that keeps another one than led to it tells it: who brakes hard does not jump on."""
    frame, monitor = frame_of(before, list(calm)[AT]), deepcopy(before.monitor)
    solution, last = frame.solve(before.solver), frame.matcher.last
    way = last.map_T_lidar.between(solution.map_T_lidar)
    led = gtsam.Pose3.Logmap(way) / last.seconds_to(frame.sweep.stamp)
    kept = led + np.array([0.0, 0.0, 0.0, 8.0, 0.0, 0.0])
    found = Found(solution, frame.sweep.at(kept), "moved by 0.80 m")
    monkeypatch.setattr(doubtful_sweeps, "_with_motion", lambda *_: found)
    assert doubtful(frame, solution, monitor, kept) is Doubt.JUMP
    accept(frame, search(frame, solution, monitor, before.solver, Doubt.JUMP), monitor)
    np.testing.assert_array_equal(monitor.led, led)
    assert doubtful(frame, solution, monitor, kept) is None
    accept(frame, doubtful_sweeps.found_at(frame, solution), monitor)
    assert monitor.led is None
    assert doubtful(frame, solution, monitor, kept) is Doubt.JUMP


@pytest.mark.parametrize(("metres", "doubt"), [(0.3, None), (0.8, Doubt.OPTIMUM)])
def test_a_solve_that_led_far_and_fits_unusually_little_is_in_doubt(metres, doubt, before, calm):
    frame = frame_of(before, list(calm)[AT])
    solution = frame.solve(before.solver)
    monitor = deepcopy(before.monitor)
    assert not doubtful(frame, solution, monitor, before.last.twist)
    far = gtsam.Pose3(gtsam.Rot3(), [metres, 0.0, 0.0]).compose(solution.map_T_lidar)
    expected = replace(frame.predicted, map_T_middle=far)
    away = replace(frame, predicted=expected)
    assert not doubtful(away, solution, monitor, before.last.twist)  # it fits as it should
    monitor.unusual = lambda fit: True
    assert doubtful(away, solution, monitor, before.last.twist) is doubt


def test_what_is_in_doubt_is_believed_elsewhere_only_if_its_features_say_so(before, calm):
    frame = frame_of(before, list(calm)[AT])
    solution = frame.solve(before.solver)
    monitor = deepcopy(before.monitor)
    wrong = replace(solution, map_T_lidar=solution.map_T_lidar.retract([0, 0, 0.2, 0, 0, 0]))
    wrong = replace(wrong, matches=frame.matcher(wrong.map_T_lidar))
    found = search(frame, wrong, monitor, before.solver, Doubt.OPTIMUM)
    assert found.message.startswith("relocalised")
    assert found.solution.map_T_lidar.equals(solution.map_T_lidar, 1e-2)
    kept = search(frame, solution, monitor, before.solver, Doubt.OPTIMUM)
    assert (kept.solution, kept.message, kept.in_vain) == (solution, "", True)


@pytest.mark.parametrize(("doubt", "told"), [(None, 0), (Doubt.OPTIMUM, 1)])
def test_what_was_looked_for_elsewhere_in_vain_may_have_jumped(
    doubt, told, before, calm, monkeypatch
):
    """It fits unusually little where it is, and nobody knows of a better place."""
    mapper, asked = deepcopy(before), []
    mapper.errors.jumped = lambda *_, **__: asked.append(1)
    monkeypatch.setattr(doubtful_sweeps, "doubtful", lambda *_: doubt)
    update = mapper.register(extract_features(list(calm)[AT], mapper.config))
    assert (update.status, update.message) == (FrameStatus.OK, "")
    assert len(asked) == told


def test_a_sweep_that_jumped_and_fits_unusually_is_looked_for(before, calm, monkeypatch):
    """In vain it may be anywhere else. If it fits as usual, only its motion is another one."""
    frame = frame_of(before, list(calm)[AT])
    solution, monitor = frame.solve(before.solver), deepcopy(before.monitor)
    wrong = replace(solution, map_T_lidar=solution.map_T_lidar.retract([0, 0, 0.2, 0, 0, 0]))
    wrong = replace(wrong, matches=frame.matcher(wrong.map_T_lidar))
    assert monitor.unusual(places_module.fit_of(frame.matcher, wrong))
    found = search(frame, wrong, monitor, before.solver, Doubt.JUMP)
    assert found.message.startswith("relocalised")
    assert found.solution.map_T_lidar.equals(solution.map_T_lidar, 1e-2)
    monkeypatch.setattr(doubtful_sweeps, "_elsewhere", lambda *_: None)
    kept = search(frame, wrong, monitor, before.solver, Doubt.JUMP)
    assert (kept.in_vain, kept.searched) == (True, monitor.radius)
    monitor.unusual = lambda fit: False
    kept = search(frame, wrong, monitor, before.solver, Doubt.JUMP)
    assert not kept.message.startswith("relocalised")
    assert (kept.in_vain, kept.searched) == (False, 0.0)


def test_of_places_where_a_sweep_fits_again_its_features_choose(before, calm, monkeypatch):
    """The nearest, unless they speak for another one."""
    frame = frame_of(before, list(calm)[AT])
    solution, monitor = frame.solve(before.solver), deepcopy(before.monitor)
    monitor.fits_again = lambda fit: True
    right = solution.map_T_lidar
    beside = right.retract([0.0, 0.0, 3.0, 0.0, 1.0, 0.0])
    for places in ([right, beside], [beside, right]):
        monkeypatch.setattr(doubtful_sweeps, "likely_places", lambda *_, p=places: p)
        found = search(frame, solution, monitor, before.solver, Doubt.MISFIT)
        assert found.solution.map_T_lidar.range(right) < 0.02


@pytest.mark.parametrize("objects", [True, False])
def test_a_rival_to_which_the_features_object_is_none(objects, before, calm, monkeypatch):
    frame = frame_of(before, list(calm)[AT])
    found = Found(frame.solve(before.solver), frame.sweep.at(np.zeros(6)))
    here = found.solution.map_T_lidar
    places = [here.compose(gtsam.Pose3(gtsam.Rot3(), [x, 0.0, 0.0])) for x in (0.1, 3.0)]
    solver = SimpleNamespace(
        solve=lambda matcher, start, *_: SimpleNamespace(solved=True, map_T_lidar=start)
    )
    monkeypatch.setattr(doubtful_sweeps, "_speaks_for", lambda *_: objects)
    matcher, others = doubtful_sweeps._others(frame, found, places, solver)
    rivals = doubtful_sweeps._rivals(matcher, found, others)
    assert rivals == ([] if objects else places[1:])  # the first is the same place


@pytest.mark.parametrize(("metres", "place"), [(0.2, 0), (3.0, -1), (8.0, None)])
def test_a_drive_is_the_likeliest_motion_unless_no_acceleration_leads_there(
    metres, place, before, calm
):
    """At 80 m/s it is none."""
    frame = frame_of(before, list(calm)[AT])
    there = frame.predicted.map_T_middle.compose(gtsam.Pose3(gtsam.Rot3(), [metres, 0.0, 0.0]))
    motions = doubtful_sweeps._motions(frame, there, np.zeros(6))
    if place is None:
        assert len(motions) == 3
        assert max(np.linalg.norm(motion[3:]) for motion in motions) < 5.0
        return
    assert len(motions) == 4
    np.testing.assert_array_equal(motions[place], frame.matcher.twist_to(there))


def test_the_matches_of_a_far_place_tell_no_speed_that_nothing_has(before, calm, monkeypatch):
    """What they leave open would be as fast as a drive there."""
    frame, monitor = frame_of(before, list(calm)[AT]), deepcopy(before.monitor)
    solution, asked = frame.solve(before.solver), []
    free = replace(frame.matcher, accelerations=before.errors.accelerations)
    frame = replace(frame, matcher=free)
    assert frame.matcher.motion_is_free
    monkeypatch.setattr(doubtful_sweeps, "CLEARLY", 0.0)  # the last that is tried is taken
    monkeypatch.setattr(
        doubtful_sweeps, "_tried", lambda *_: (Fit(1.0, 1.0), asked[-1], frame.matcher.posed)
    )
    for metres, told in ((0.2, True), (8.0, False)):
        far = frame.matcher.last.map_T_lidar.compose(gtsam.Pose3(gtsam.Rot3(), [metres, 0, 0]))
        asked.append(replace(solution, map_T_lidar=far))
        found = doubtful_sweeps._with_motion(
            frame, far, [np.zeros(6)], monitor, before.solver, told=True
        )
        assert (found.posed is not frame.matcher.posed) is told


def test_in_a_dense_map_a_match_that_any_place_would_agree_with_says_nothing(before, calm):
    matcher = frame_of(before, list(calm)[AT]).matcher
    solution = before.solver.solve(matcher, before.last.map_T_middle)
    planes = solution.matches.planes
    spread = np.full(len(planes), 0.4 * matcher.matching.max_distance)
    wide = replace(solution.matches, planes=replace(planes, sigmas=spread))
    sure, chance = (
        Evidence.of(matcher, replace(solution, matches=one), dense=True)
        for one in (solution.matches, wide)
    )
    rows = len(matcher.rows.edges)
    assert sure.signs[rows:].max() > 0.8
    assert not chance.signs[rows:].any()
    # In a thin map it says that there is something to match with, if that was looked for: not if
    # planes fix all translations.
    ground = replace(wide, planes=subset(wide.planes, np.abs(planes.normals[:, 2]) > 0.9))
    for matches, hints in ((wide, False), (ground, True)):
        thin = Evidence.of(matcher, replace(solution, matches=matches))
        assert not thin.signs[rows:].any()
        assert (thin.hints is not None and thin.hints[rows:].any()) == hints
    nowhere = Evidence.of(matcher, replace(solution, solved=False))
    assert not nowhere.signs.any()
    assert not nowhere.axes.any()
    assert not any(favour([sure], [sure]))


def test_rivals_are_told_as_the_mean_squared_error_of_any_of_them():
    pose = gtsam.Pose3(gtsam.Rot3.Yaw(0.5), [3.0, 1.0, 0.0])
    rivals = [pose.compose(gtsam.Pose3(gtsam.Rot3(), [x, 0.0, 0.0])) for x in (2.0, -4.0)]
    spread = any_of(pose, rivals)
    along = np.array([np.cos(0.5), np.sin(0.5), 0.0])
    np.testing.assert_allclose(spread[3:, 3:], (4.0 + 16.0) / 3.0 * np.outer(along, along))
    assert any_of(pose, []) is None


def test_a_search_of_too_small_a_radius_says_that_the_sweep_is_lost(before, kidnapped):
    monitor = deepcopy(before.monitor)
    monitor.config = monitor.config.changed(radius=1.0, max_radius=1.0)
    monitor.lost = 2
    before = copy(before)  # a solver that does not get far by itself
    before.solver = GtsamSolver(before.config.solver.changed(iterations=4))
    _, outcome, _ = search_in(before, list(kidnapped)[AT], monitor)
    assert isinstance(outcome, Lost)
    assert "nothing fits within 1 m; lost for 3 sweeps" in outcome.message
    assert monitor.lost == 2


def test_a_sweep_that_fits_keeps_its_solution_if_the_search_finds_nothing_better(before, calm):
    frame = frame_of(before, list(calm)[AT])
    solution = frame.solve(before.solver)
    assert not doubtful(frame, solution, before.monitor, before.last.twist)
    nothing = GtsamSolver(before.config.solver.changed(min_matches=10**6))
    found = search(frame, solution, before.monitor, nothing, Doubt.JUMP)
    assert isinstance(found, Found)
    assert (found.solution, found.message) == (solution, "")
    np.testing.assert_array_equal(found.posed.twist, frame.posed_for(solution).twist)


def test_an_ordinary_run_is_the_same_without_the_watch(begun, calm):
    watched, bare = (ended(one, calm) for one in begun)
    assert np.array_equal(watched.trajectory.map_T_lidar, bare.trajectory.map_T_lidar)
    assert all(update.message == "" for update in watched.updates[1:] if update.status == "ok")


@pytest.mark.parametrize(
    ("disturbances", "sweeps"),
    [
        ([MissingSweeps((12, 20))], 24),
        ([MissingSweeps((20,), 5)], 28),
        ([Outliers(0.2)], 16),
        ([MovingObjects()], 16),
    ],
    ids=["one missing", "five missing", "outliers", "passing objects"],
)
def test_disturbances_do_not_make_sweeps_lost(calm, disturbances, sweeps):
    disturbed = Disturbed(ArrayDataset(list(calm)[:sweeps], sensor=calm.sensor), disturbances)
    result = run(disturbed, QUICK)
    assert all(update.status.solved for update in result.updates[1:])
    stamps = [sweep.stamp for sweep in disturbed]
    rows = np.searchsorted(calm.truth.stamps, stamps)
    away = result.trajectory.map_T_lidar - calm.truth.map_T_lidar[rows]
    assert np.linalg.norm(away[:, :3, 3], axis=1).max() < 0.2


def test_a_kidnapped_lidar_is_found_at_once(begun, kidnapped):
    result, wrong = (ended(one, kidnapped) for one in begun)
    update = result.updates[AT]
    assert update.status.solved
    assert "relocalised, moved by 3." in update.message
    assert "relocalize" in update.timings
    assert errors(result, kidnapped).max() < 0.15
    # The map may have a place that looks the same: what was found may be off by the 3 m.
    told = np.sqrt(np.linalg.eigvalsh(update.covariance[3:, 3:])[-1])
    assert 1.5 < told < 4.0
    # Without the monitor it is not: a second map grows beside the first.
    assert wrong.updates[AT].status.solved
    assert errors(wrong, kidnapped)[AT] > 1.0


@pytest.mark.parametrize(("move", "turn_deg"), [((0.0, 1.0, 0.0), 0.0), ((0.0, 0.0, 0.0), 30.0)])
def test_a_jump_is_no_motion(begun, drive, calm, move, turn_deg):
    """The solve finds these by itself; what would be wrong is the motion within the sweep."""
    dataset = put(drive, calm, move, turn_deg)
    result, bare = (ended(one, dataset) for one in begun)
    assert "moved by" in result.updates[AT].message
    assert np.linalg.norm(result.updates[AT].twist) < 2.0
    assert np.linalg.norm(bare.updates[AT].twist) > 4.0
    assert errors(result, dataset).max() < 0.05
    assert errors(bare, dataset)[AT:].max() > errors(result, dataset)[AT:].max()


def test_a_lost_lidar_leaves_the_map_alone_until_it_is_found(kidnapped):
    """A search too narrow at first: some sweeps are lost."""
    config = with_search(radius=0.0, radius_growth=1.0)
    config = config.changed("solver.iterations=8", PREDICTED)
    pipeline, sizes, updates = Pipeline(config), [], []
    for sweep in kidnapped:
        updates.append(pipeline.process(sweep))
        sizes.append(pipeline.mapper.maps.planes.count())
    lost = [n for n, update in enumerate(updates) if update.status is FrameStatus.LOST]
    assert lost
    assert lost == list(range(AT, AT + len(lost)))
    assert {sizes[n] for n in lost} == {sizes[AT - 1]}
    first = updates[AT]
    assert np.isnan(first.covariance).all()
    assert not first.information.any()
    assert np.allclose(first.twist, updates[AT - 1].twist)  # predicted
    assert "of the features match" in first.message
    back = updates[AT + len(lost)]
    assert back.status.solved
    assert f"after {len(lost)} lost sweeps" in back.message
    assert sizes[-1] > sizes[AT - 1]
    truth = kidnapped.truth.map_T_lidar[-1, :3, 3]
    assert np.linalg.norm(updates[-1].map_T_lidar.translation() - truth) < 0.15


def test_few_matches_twice_in_a_row_start_a_search(begun, calm):
    """The guess leads away from the map; the sweep is found where the last one was."""
    (pipeline, updates), sweeps = begun[0], list(calm)
    was, last, mapper = Before(pipeline), updates[-1], pipeline.mapper
    here = last.map_T_lidar
    far = gtsam.Pose3(here.rotation(), here.translation() + np.array([40.0, 0.0, 0.0]))
    mapper.last = replace(last, map_T_lidar=far)
    assert pipeline.process(sweeps[AT]).status is FrameStatus.FEW_MATCHES
    found = pipeline.process(sweeps[AT + 1])
    was.restore()
    assert found.status.solved
    assert "relocalised after 1 lost sweeps" in found.message
    away = found.map_T_lidar.translation() - calm.truth.map_T_lidar[AT + 1, :3, 3]
    assert np.linalg.norm(away) < 0.1


# -- an IMU that breaks ----------------------------------------------------------------------------


def broken(samples, kind):
    """The samples of an IMU of which something is wrong, from the middle of the run or always."""
    late = samples.stamps > np.median(samples.stamps)
    gyro, force = samples.gyro.copy(), samples.acceleration.copy()
    orientation = samples.orientation
    if kind == "gyro":
        gyro[late] += [0.0, 0.0, 3.0]
    elif kind == "accelerometer":
        force[late] += [160.0, 0.0, 0.0]
    elif kind == "attitude":
        orientation = Rotation.random(len(orientation), rng=1).as_quat()
    return ImuSamples(samples.stamps, orientation, gyro, force)


@pytest.fixture(scope="module")
def street():
    """A world that is driven through, and the sweeps."""
    world = SimulatedWorld("street_loop", frames=14, columns=300, start="moving")
    return world, list(world)


@pytest.mark.parametrize(
    ("kind", "coupling"),
    [
        ("nothing", "tight"),
        ("accelerometer", "tight"),
        ("gyro", "tight"),
        ("gyro", "loose"),
        ("attitude", "tight"),
        ("attitude", "loose"),
    ],
)
def test_an_imu_that_breaks_is_left_out(street, kind, coupling):
    world, scans = street
    sweeps = ArrayDataset(scans, imu=broken(world.imu, kind), sensor=world.sensor)
    result = run(sweeps, Config().changed({"imu.coupling": coupling}))
    assert all(update.status.solved for update in result.updates[1:])
    assert result.imu.gyro_trusted == (kind != "gyro")
    last = result.updates[-1].tilt_prior
    assert last is (TiltPrior.DROPPED if kind == "attitude" else TiltPrior.EQUIVALENT)
    truth = world.truth.map_T_lidar
    for update, pose in zip(result.updates, truth, strict=True):
        moved = result.updates[0].map_T_lidar.between(update.map_T_lidar)
        assert moved.range(gtsam.Pose3(pose)) < 0.3


def test_a_shaken_lidar_whose_sweeps_are_far_apart_is_not_lost():
    """From one sweep to the next, 0.6 s, it turns by more than any motion foretells."""
    world = SimulatedWorld("shaken", seed=4, frames=72, columns=300)
    truth = Trajectory(world.truth.stamps[:54:6], world.truth.map_T_lidar[:54:6])
    sweeps = ArrayDataset([world[k] for k in range(0, 54, 6)], truth=truth)
    result = run(sweeps, Config())
    assert errors(result, sweeps).max() < 0.2
    # Without the search the eighth is 3 m off.
    assert result.updates[7].message.startswith("relocalised")


@pytest.mark.parametrize(("speed", "begins", "length"), [(30.0, 8, 10), (20.0, 14, 12)])
def test_after_a_gap_in_which_a_car_braked_the_sweep_tells_where_it_is(speed, begins, length):
    """To 10 m/s, 6 and 8 m short of where it was expected: along a street the nearest fit alike."""
    world = SimulatedWorld("street_loop", frames=32, columns=900, start="moving", speed=speed)
    dataset = Disturbed(world, [MissingSweeps((begins,), length)])
    result = run(dataset, Config().changed("imu.coupling=off"))
    assert result.status_counts == {"first": 1, "ok": 31 - length}
    assert result.updates[begins].message.startswith("relocalised, moved by")
    truth = world.truth.at(result.trajectory.stamps)
    assert absolute_error(result.trajectory, truth).rmse < 0.03
