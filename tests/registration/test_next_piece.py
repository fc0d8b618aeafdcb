"""Runs that go on in another piece of map, when sweeps fit the one before nowhere."""

from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.quick import begin_quickly

from loam_gtsam.config import Config
from loam_gtsam.datasets.arrays import ArrayDataset
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.io.state import freeze, thaw
from loam_gtsam.pipeline import Pipeline, effective_config, imu_buffer, run
from loam_gtsam.registration.relocalization import (
    CONTINUED,
    FitMonitor,
    Gap,
    NextPiece,
    goes_on,
    places,
)
from loam_gtsam.registration.uncertainty import relative_covariance
from loam_gtsam.studies.evaluation import nees
from loam_gtsam.types import FrameStatus, Trajectory

AT, AGAIN, LOST = 8, 20, 8
"""The first missing sweep, the first one after the gap, and how many are lost then."""
CONFIG = Config().changed(
    f"relocalization.new_piece={LOST}", "relocalization.radius=0", "relocalization.max_radius=0",
    "solver.iterations=5", "matching.trial_edges=50", "matching.trial_planes=150",
)  # fmt: skip
"""With a quick search."""
SOON = 5
QUICK = CONFIG.changed(f"relocalization.new_piece={SOON}")
"""With :func:`support.quick.begin_quickly` a piece is there after as many sweeps."""
FORWARD = np.array([0.0, 0.0, 0.0, 10.0, 0.0, 0.0])
USUAL = np.repeat([0.5, 2.0], 3) ** 2


@pytest.fixture(scope="module", autouse=True)
def few_places():
    """What a search tries matters little where it is to find nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(places, "_PLACES", 1)
        yield


@pytest.fixture(scope="module")
def avenue():
    """At 30 m/s, where hardly anything is seen again after a second."""
    world = SimulatedWorld("avenue", frames=33, columns=450, start="moving", speed=30.0)
    return world, list(world)


@pytest.fixture(scope="module")
def result(avenue):
    world, sweeps = avenue
    return run(ArrayDataset(sweeps[:AT] + sweeps[AGAIN:], sensor=world.sensor), CONFIG)


def squared_distance(truth, earlier, later):
    """Squared Mahalanobis distance of the motion between two frames from the true one."""
    return 6.0 * nees([earlier, later], truth, window=1).mean


def test_a_run_goes_on_after_a_gap_and_tells_how_well_it_knows_where(avenue, result):
    truth, updates = avenue[0].truth, result.updates
    lost, after = updates[AT : AT + LOST - 1], updates[AT + LOST - 1 :]
    assert {update.status for update in lost} == {FrameStatus.LOST}
    assert {update.status for update in after} == {FrameStatus.OK}
    assert after[0].message == f"after {LOST} lost sweeps {CONTINUED}"
    assert [note for note in result.notes if CONTINUED in note]
    # Within a piece a motion is known as ever, across the gap as well as a car's is.
    assert squared_distance(truth, after[0], after[-1]) < 25.0
    assert squared_distance(truth, updates[AT - 1], after[0]) < 25.0
    within, across = (
        np.sqrt(np.diag(relative_covariance(*pair)))
        for pair in (after[:2], (updates[AT - 1], after[0]))
    )
    assert (within < np.repeat([2e-3, 0.05], 3)).all()
    assert (across > np.repeat([0.05, 0.3], 3)).all()
    assert (np.sqrt(np.diag(after[-1].covariance))[:3] > 0.05).all()


def test_a_gap_of_which_the_stamps_do_not_tell_is_told(avenue):
    """What is not found so near the last place is elsewhere, for all that the motion says."""
    world, sweeps = avenue
    hidden = sweeps[AGAIN].stamp - sweeps[AT].stamp
    later = [replace(sweep, stamp=sweep.stamp - hidden) for sweep in sweeps[AGAIN:]]
    config = CONFIG.changed("relocalization.radius=12", "relocalization.max_radius=12")
    updates = run(ArrayDataset(sweeps[:AT] + later, sensor=world.sensor), config).updates
    assert CONTINUED in updates[AT + LOST - 1].message
    stamps = np.delete(world.truth.stamps, np.s_[AT:AGAIN])
    stamps[AT:] -= hidden
    truth = Trajectory(stamps, np.delete(world.truth.map_T_lidar, np.s_[AT:AGAIN], axis=0))
    assert squared_distance(truth, updates[AT - 1], updates[-1]) < 25.0
    away = truth.map_T_lidar[-1, :3, 3] - updates[-1].map_T_lidar.translation()
    assert np.linalg.norm(away - truth.map_T_lidar[0, :3, 3]) > 30.0


def test_a_start_that_a_gap_interrupts_ends_with_its_piece(avenue):
    """Its sweeps, of another place, must not be registered with those of the new piece."""
    world, sweeps = avenue
    pipeline = Pipeline(effective_config(CONFIG, world))
    updates = [pipeline.process(sweep) for sweep in sweeps[:4] + sweeps[AGAIN:]]
    after = [update for update in updates[4:] if update.status is FrameStatus.OK]
    assert CONTINUED in after[0].message
    assert pipeline.mapper.start is None
    assert squared_distance(world.truth, after[0], after[-1]) < 25.0


def test_both_pieces_are_in_the_map_and_points_belong_to_keyframes_of_their_own(avenue, result):
    maps = result.pipeline.mapper.maps
    owners, earlier = (
        np.unique(np.concatenate([part.tags[:, 0] for part in piece.planes.contents().values()]))
        for piece in (maps, maps.earlier)
    )
    assert owners.min() > earlier.max()
    for update in (result.updates[0], result.updates[-1]):
        place = update.map_T_lidar.translation()
        assert np.linalg.norm(result.plane_points - place, axis=1).min() < 5.0
    whole = {name: cubes.count() for name, cubes in maps.layers().items()}
    assert whole["planes"] > maps.planes.count()
    assert maps.earlier is not None  # which stays as it was
    assert maps.layers()["planes"].count() == whole["planes"]
    moved = maps.points({0: gtsam.Pose3(gtsam.Rot3(), [0, 0, 50.0]).matrix()})
    assert moved[1][:, 2].max() > result.plane_points[:, 2].max() + 20.0


def test_sweeps_that_do_not_fit_each_other_make_no_piece(avenue):
    rng = np.random.default_rng(1)
    pipeline = Pipeline(effective_config(CONFIG, avenue[0]))
    for sweep in avenue[1][:AT]:
        pipeline.process(sweep)
    for sweep in avenue[1][AT : AT + LOST + 2]:
        turn = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True).as_matrix()
        anyhow = rng.uniform(0.3, 1.0, (len(sweep.points), 1)) * sweep.points @ turn.T
        update = pipeline.process(replace(sweep, points=anyhow))
        assert not update.status.solved
    assert pipeline.mapper.maps.earlier is None


@pytest.fixture(scope="module")
def carried():
    """Back to where it began while nothing is seen, and then the same way once more."""
    options = {"start": "moving", "speed": 5.0, "imu": "mems"}
    world = SimulatedWorld("street_loop", frames=24, columns=450, **options)
    later = [replace(sweep, stamp=sweep.stamp + round(6e9)) for sweep in world]
    return ArrayDataset([*world, *later], sensor=world.sensor, imu=world.imu)


def test_loops_tie_the_pieces(carried, monkeypatch):
    begin_quickly(monkeypatch)
    config = QUICK.changed("loops.enabled=true", "pose_graph.keyframe_distance=1.3")
    result = run(carried, config.changed("imu.coupling=off"))
    assert CONTINUED in result.updates[24 + SOON - 1].message
    before, end = result.updates[24 - 1], result.updates[-1]
    assert end.map_T_lidar.range(before.map_T_lidar) > 20.0
    closed = [gtsam.Pose3(pose) for pose in result.trajectory.map_T_lidar]
    assert closed[-1].range(before.map_T_lidar) < 0.05
    # What is corrected is the gap, and neither the frames before it nor those after.
    for pose, update in zip(closed[:24], result.updates[:24], strict=True):
        assert pose.range(update.map_T_lidar) < 0.02
    for pose, update in zip(closed[24 + SOON - 1 :], result.updates[SOON - 1 : 24], strict=True):
        assert pose.range(update.map_T_lidar) < 0.05


def test_a_checkpoint_holds_the_piece_that_is_not_used_yet(carried, monkeypatch):
    begin_quickly(monkeypatch)
    config, sweeps = effective_config(QUICK, carried), list(carried)
    one, two = (Pipeline(config, imu=imu_buffer(carried, config)) for _ in range(2))
    for sweep in sweeps[12 : 24 + SOON - 1]:
        one.process(sweep)
    thaw(freeze(*one.state()), *two.state())
    for sweep in sweeps[24 + SOON - 1 : 24 + SOON + 1]:
        updates = [pipeline.process(sweep) for pipeline in (one, two)]
        np.testing.assert_array_equal(*(update.map_T_lidar.matrix() for update in updates))
        np.testing.assert_array_equal(*(update.covariance for update in updates))
    assert two.mapper.maps.earlier is not None


@pytest.mark.parametrize(
    ("metres", "turned", "sigmas"),
    [(3.0, None, (1.28, 7.07)), (3.0, gtsam.Rot3(), (0.0, 7.07)), (11.0, None, (0.0, 0.0))],
)
def test_what_is_not_found_where_it_was_searched_may_be_anywhere(metres, turned, sigmas):
    """Farther off than that, the map need not have it."""
    piece = NextPiece(gap())
    piece._turned = turned
    pose = gap().map_T_lidar.compose(gtsam.Pose3(gtsam.Rot3(), [metres, 0.0, 0.0]))
    body = pose.inverse().AdjointMap()
    covariance = body @ piece._carried_off(pose, 10.0) @ body.T
    assert np.allclose(np.sqrt(np.diag(covariance)), np.repeat(sigmas, 3), atol=0.01)


def gap(twist=FORWARD, stamp=0):
    return Gap(stamp, gtsam.Pose3(gtsam.Rot3.Rz(0.3), [1.0, 2.0, 3.0]), twist, USUAL)


def test_both_velocities_lead_across_a_gap():
    start = gap().map_T_lidar
    pose, covariance = gap().bridged(2_000_000_000, FORWARD)
    assert pose.equals(start.compose(gtsam.Pose3(gtsam.Rot3(), [20.0, 0.0, 0.0])), 1e-9)
    # It brakes steadily: the mean of both is exact.
    pose, _ = gap().bridged(2_000_000_000, 0.4 * FORWARD)
    assert pose.equals(start.compose(gtsam.Pose3(gtsam.Rot3(), [14.0, 0.0, 0.0])), 1e-9)
    # One that stops for a while in the middle, at the likely acceleration, is one sigma off.
    aside = gtsam.Pose3(gtsam.Rot3(), start.rotation().rotate([0.25 * 2.0 * 2.0**2, 0, 0]))
    step = gtsam.Pose3.Logmap(aside)
    assert np.isclose(step @ np.linalg.pinv(covariance) @ step, 1.0, rtol=1e-6)
    # A turn in the gap is seen from half way.
    turned = gtsam.Rot3.Rz(0.5)
    pose, known = gap().bridged(1_000_000_000, FORWARD, turned)
    assert pose.rotation().equals(start.rotation().compose(turned), 1e-9)
    assert np.allclose(np.diag(known)[:3], 0.01**2)  # the bias of a gyro, for a second


@pytest.mark.parametrize("seconds", [-5.0, 3600.0])
def test_after_a_gap_of_unknown_length_the_lidar_may_be_anywhere(seconds):
    pose, covariance = gap().bridged(round(seconds * 1e9), FORWARD)
    assert np.isfinite(pose.matrix()).all()
    assert np.sqrt(np.linalg.eigvalsh(covariance)[-1]) > 40.0
    assert np.linalg.eigvalsh(covariance)[-1] < 1e10


def test_when_a_run_goes_on():
    for new_piece, lost, expected in ((3, 2, False), (3, 3, True), (0, 1000, False)):
        monitor = FitMonitor(Config().relocalization.changed(new_piece=new_piece))
        monitor.lost = lost
        assert monitor.gives_up is expected
    sweep = SimpleNamespace(edges=np.zeros((20, 3)), planes=np.zeros((200, 3)))
    mapper = SimpleNamespace(
        config=Config(), start=None, errors=SimpleNamespace(gap=gap()),
        maps=SimpleNamespace(given=False), monitor=SimpleNamespace(lost=0),
    )  # fmt: skip
    assert goes_on(mapper, sweep)
    few = SimpleNamespace(edges=np.zeros((20, 3)), planes=np.zeros((20, 3)))
    assert not goes_on(mapper, few)
    for name, value in (
        ("errors", SimpleNamespace(gap=None)),
        ("start", object()),
        ("maps", SimpleNamespace(given=True)),
        ("config", Config().changed("relocalization.enabled=false")),
        ("config", Config().changed("relocalization.new_piece=0")),
    ):
        assert not goes_on(SimpleNamespace(**{**vars(mapper), name: value}), sweep), name
