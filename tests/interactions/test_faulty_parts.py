"""An exception in a part of a user's own: named, and nothing has changed, or the run goes on."""

from __future__ import annotations

import importlib
import logging
import pickle
import pkgutil
from contextlib import suppress
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from support.quick import PREDICTED

import loam_gtsam
from loam_gtsam.config import Config
from loam_gtsam.config.base import RefusedError
from loam_gtsam.datasets import open_dataset
from loam_gtsam.errors import LoamError, PartError, SweepError, SweepFault, is_own
from loam_gtsam.factors import checked_factor
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.io.checkpoint import Checkpoint
from loam_gtsam.loops.closure import ScanLoopCloser
from loam_gtsam.mapper import Mapper
from loam_gtsam.pipeline import Pipeline, effective_config, imu_buffer, run
from loam_gtsam.registration.odometry import ConstantVelocity, Guess
from loam_gtsam.registration.solvers import POSE_KEY, make_solver
from loam_gtsam.types import FrameStatus, InputError

DATA = open_dataset("sim:room?frames=6&columns=200&imu=mems&speed=3&start=moving")
CONFIG = effective_config(Config().changed("pose_graph.keyframe_distance=0.02"), DATA)
QUICK = CONFIG.changed(PREDICTED)
GOES_ON = CONFIG.changed("parts.on_error=continue")
SWEEPS = list(DATA)
NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 1e3)
MIRROR = gtsam.Pose3(np.diag([1.0, 1.0, -1.0, 1.0]))


class FaultError(Exception):
    """Of the user."""


class Faulty:
    """Parts of a user's own, which fail in one place: once, at a pass, or from one pass on."""

    def __init__(self, place: str = "", passes: int = 0, *, for_good: bool = False) -> None:
        self.place, self.passes, self.for_good = place, passes, for_good
        self.armed, self.inner = False, make_solver(CONFIG.solver)
        self.closer, self.steady = ScanLoopCloser(CONFIG), ConstantVelocity()
        self.reset = self.closer.reset

    def pass_by(self, place: str) -> None:
        if not self.armed or place != self.place:
            return
        self.passes -= 1
        if self.passes >= 0:
            return
        self.armed = self.for_good
        if place == "indeterminate":
            graph = gtsam.GaussianFactorGraph()
            graph.add(0, np.zeros((6, 6)), np.zeros(6), gtsam.noiseModel.Unit.Create(6))
            graph.optimize()
        raise FaultError(place)

    def factors(self, context):
        self.pass_by("factors")

        def residual(values):
            self.pass_by("residual")
            return np.zeros(6), [np.zeros((6, 6))]

        return [checked_factor(NOISE, [context.key], residual)]

    def solve(self, *args):
        self.pass_by("solver")
        self.pass_by("indeterminate")
        return self.inner.solve(*args)

    def detect(self, keyframe, history):
        self.pass_by("loop_closer")
        return self.closer.detect(keyframe, history)

    def guess(self, features, last):
        self.pass_by("odometry")
        return self.steady.guess(features, last)

    def remember(self, features):
        self.pass_by("remember")

    def features(self, scan):
        self.pass_by("features")
        return extract_features(scan, CONFIG)

    def parts(self):
        return {"solver": self, "extra_factors": self.factors, "loop_closer": self,
                "odometry": self, "features": self.features}  # fmt: skip


def poses(part: Faulty, at: int | None = None) -> tuple[list[np.ndarray], list[PartError]]:
    """The run, with a sweep tried again after the fault in it; and the map in the end."""
    pipeline = Pipeline(CONFIG, imu=imu_buffer(DATA, CONFIG), **part.parts())
    found, errors = [], []
    for number, sweep in enumerate(SWEEPS):
        if number == at:
            part.armed = True
            with pytest.raises(PartError) as caught:
                pipeline.process(sweep)
            errors.append(caught.value)
        found.append(pipeline.process(sweep).map_T_lidar.matrix())
    return [*found, pipeline.loops.graph.poses(), *pipeline.map_points()], errors


@pytest.fixture(scope="module")
def undisturbed() -> list[np.ndarray]:
    return poses(Faulty())[0]


# The solver fails in the search for the first motion, and in the joint registration of five sweeps.
@pytest.mark.parametrize(
    ("place", "at", "passes", "named"),
    [
        ("factors", 2, 0, "extra_factors"),
        ("residual", 2, 0, "extra_factors"),
        ("residual", 2, 1, "extra_factors"),
        ("residual", 2, 2, "solver"),
        ("solver", 1, 1, "solver"),
        ("solver", 4, 2, "solver"),
        ("indeterminate", 2, 0, "solver"),
        ("loop_closer", 3, 0, "loop_closer"),
        ("odometry", 2, 0, "odometry"),
        ("remember", 4, 0, "odometry"),
        ("features", 2, 0, "features"),
    ],
)
def test_a_sweep_can_be_tried_again_after_a_fault_of_the_user(
    place, at, passes, named, undisturbed
):
    found, (error,) = poses(Faulty(place, passes), at)
    assert error.part == named
    assert error.indeterminate is (place == "indeterminate")
    kind = RuntimeError if place == "indeterminate" else FaultError
    assert isinstance(error.__cause__, kind)
    assert f"{named} of your own (Faulty" in str(error)
    for one, other in zip(found, undisturbed, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_prior_that_fails_is_named_and_the_sweep_can_be_tried_again():
    """Factors given to ``register``, alone and beside ``extra_factors``."""
    features = [extract_features(sweep, CONFIG) for sweep in SWEEPS[:3]]
    part, found = Faulty("residual"), []
    for others in (None, lambda context: []):
        mapper = Mapper(CONFIG, extra_factors=others)
        for sweep in features[:2]:
            mapper.register(sweep)
        priors = part.factors(SimpleNamespace(key=POSE_KEY))
        part.armed, part.passes = True, 0
        with pytest.raises(PartError, match="priors of your own"):  # where they are checked
            mapper.register(features[2], priors=priors)
        part.armed, part.passes = True, 1
        with pytest.raises(PartError, match="raised FaultError") as caught:
            mapper.register(features[2], priors=priors)
        assert caught.value.part == ("priors" if others is None else "extra_factors")
        notes = [] if others is None else ["or raised by one of the priors given to register"]
        assert getattr(caught.value, "__notes__", []) == notes
        found.append(mapper.register(features[2], priors=priors).map_T_lidar.matrix())
        found.append(np.sort(mapper.map_points()[1], axis=0))
    np.testing.assert_array_equal(found[0], found[2])
    mapper = Mapper(CONFIG)
    for sweep in features[:2]:
        mapper.register(sweep)
    alone = gtsam.PriorFactorPose3(POSE_KEY, gtsam.Pose3(), NOISE)
    for wrong in (1, None, [1], alone, [gtsam.PriorFactorPose3(5, gtsam.Pose3(), NOISE)]):
        with pytest.raises(InputError, match="a list of GTSAM factors on POSE_KEY"):
            mapper.register(features[2], priors=wrong)
    nowhere = gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0.0, 0.0]))
    exact = gtsam.noiseModel.Isotropic.Sigma(6, 0.0)
    for pose, noise in ((nowhere, NOISE), (gtsam.Pose3(), exact)):
        with pytest.raises(InputError, match=r"priors: .* PriorFactorPose3 with NaN .*sigma 0"):
            mapper.register(features[2], priors=[gtsam.PriorFactorPose3(POSE_KEY, pose, noise)])
    fixed = gtsam.PriorFactorPose3(POSE_KEY, gtsam.Pose3(), gtsam.noiseModel.Constrained.All(6))
    with pytest.raises(InputError, match=r"priors: expected no constraint, .* use a small sigma"):
        mapper.register(features[2], priors=[fixed])
    undisturbed = mapper.register(features[2], priors=(factor for factor in priors))
    np.testing.assert_array_equal(undisturbed.map_T_lidar.matrix(), found[0])
    np.testing.assert_array_equal(np.sort(mapper.map_points()[1], axis=0), found[1])


@pytest.mark.parametrize(
    ("place", "used"),
    [("solver", False), ("features", False), ("loop_closer", True), ("odometry", True)],
)
def test_a_run_goes_on_without_a_part_that_fails_and_says_so_once(place, used, caplog):
    part = Faulty(place, for_good=True)
    part.armed = True
    with caplog.at_level(logging.WARNING, "loam_gtsam"):
        result = run(DATA, GOES_ON.changed(PREDICTED) if used else GOES_ON, **part.parts())
    assert caplog.text.count("raised FaultError") == 1
    assert f"{place} of your own" in caplog.text
    first = 0 if place == "features" else 1
    statuses = {update.status for update in result.updates[1:]}
    assert statuses == ({FrameStatus.OK} if used else {FrameStatus.UNUSABLE_SCAN})
    assert result.faults == ({} if used else {"part_failed": len(SWEEPS) - first})


@pytest.mark.parametrize("place", ["features", "loop_closer"])
def test_after_a_reset_a_part_that_fails_is_told_anew(place, caplog):
    part = Faulty(place, for_good=True)
    part.armed = True
    pipeline = Pipeline(GOES_ON.changed(PREDICTED), **part.parts())
    for run_number in (1, 2):
        for sweep in SWEEPS[:3]:
            pipeline.process(sweep)
        assert caplog.text.count("raised FaultError") == run_number
        pipeline.reset()


@pytest.mark.parametrize(
    ("part", "returned", "said"),
    [
        ("features", None, "expected a Features, got NoneType"),
        ("loop_closer", (0, 1), "expected a LoopClosure, got tuple"),
        ("solver", None, "expected a Solution, got NoneType"),
        ("odometry", gtsam.Pose3(), "expected a Guess, got Pose3"),
        ("odometry", Guess(MIRROR, np.zeros(6)), "what guess returns: expected a rotation"),
    ],
)
def test_a_part_that_returns_something_else_is_named(part, returned, said, caplog):
    own = Faulty()
    parts = {
        "features": lambda scan: returned,
        "loop_closer": SimpleNamespace(detect=lambda *_: returned, reset=own.reset),
        "solver": SimpleNamespace(solve=lambda *_: returned),
        "odometry": SimpleNamespace(
            guess=lambda *_: returned, remember=own.remember, reset=own.reset
        ),
    }
    with pytest.raises(InputError, match=said) as caught:
        run(DATA, QUICK, **{part: parts[part]})
    assert any(f"raised in {part} of your own" in note for note in caught.value.__notes__)
    result = run(DATA, GOES_ON.changed(PREDICTED), **{part: parts[part]})
    assert len(result.updates) == len(SWEEPS)
    assert said in caplog.text


class WithoutReset:
    def guess(self, features, last):
        raise NotImplementedError

    def remember(self, features):
        raise NotImplementedError


@pytest.mark.parametrize(
    ("keywords", "error", "said"),
    [
        ({"extra_factor": None}, TypeError, "'extra_factor'; did you mean 'extra_factors'?"),
        ({"max_frame": 2}, TypeError, "'max_frame'; did you mean 'max_frames'?"),
        ({"loop_closer": ScanLoopCloser}, InputError, "expected an object, got the class"),
        ({"imu": None}, TypeError, r"imu: the data set has it, as ArrayDataset\(\.\.\., imu="),
        ({"wheels": None}, TypeError, "wheels: the data set has it"),
        ({"odometry": WithoutReset()}, InputError, "got WithoutReset without reset"),
    ],
)
def test_a_keyword_that_is_none_and_a_class_for_an_object_are_refused(keywords, error, said):
    with pytest.raises(error, match=said):
        run(DATA, QUICK, **keywords)


@pytest.mark.parametrize("name", ["observe", "on_frame"])
def test_an_observer_that_fails_costs_the_run_or_nothing(name, caplog):
    def broken(*_):
        raise FaultError("picture")

    result = run(DATA, GOES_ON.changed(PREDICTED), max_frames=3, **{name: broken})
    assert len(result.updates) == 3
    assert caplog.text.count("raised FaultError: picture") == 1
    with pytest.raises(PartError, match=rf"{name} of your own \(.*broken\) raised FaultError"):
        run(DATA, QUICK, max_frames=3, **{name: broken})


def test_a_run_that_a_fault_stopped_is_gone_on_with(tmp_path):
    part = Faulty("solver", 15)
    part.armed = True
    with pytest.raises(PartError):
        run(DATA, CONFIG, checkpoint=Checkpoint(tmp_path), solver=part)
    numbers = []
    resumed = run(
        DATA, CONFIG, checkpoint=Checkpoint(tmp_path, resume=True), solver=Faulty(),
        on_frame=lambda number, _: numbers.append(number),
    )  # fmt: skip
    assert 0 < numbers[0] < len(SWEEPS)
    whole = run(DATA, CONFIG)
    for one, other in zip(resumed.updates, whole.updates, strict=True):
        np.testing.assert_array_equal(one.map_T_lidar.matrix(), other.map_T_lidar.matrix())


def test_an_error_of_the_package_itself_is_not_called_the_users(monkeypatch):
    assert is_own(Faulty())
    assert is_own(lambda: 0)
    assert not is_own(make_solver(CONFIG.solver))
    assert not is_own(extract_features)
    pipeline = Pipeline(CONFIG)
    pipeline.process(SWEEPS[0])
    monkeypatch.setattr(type(pipeline.mapper.solver), "solve", lambda *_: 1 / 0)
    before = pipeline.mapper.map_points()[1]
    with pytest.raises(ZeroDivisionError):
        pipeline.process(SWEEPS[1])
    np.testing.assert_array_equal(pipeline.mapper.map_points()[1], before)


def _all_errors(kind):
    yield kind
    for below in kind.__subclasses__():
        yield from _all_errors(below)


def test_every_error_passes_from_one_process_to_another():
    for module in pkgutil.walk_packages(loam_gtsam.__path__, "loam_gtsam."):
        if not module.name.endswith("__main__"):
            with suppress(ImportError):  # of what is not installed
                importlib.import_module(module.name)
    made = {
        PartError: lambda: PartError("solver", print, ValueError("no")),
        RefusedError: lambda: RefusedError("Sensor", ("low", "high"), "no"),
        SweepError: lambda: SweepError("no", SweepFault.EMPTY),
    }
    kinds = list(_all_errors(LoamError))
    assert made.keys() < set(kinds)
    for kind in kinds:
        if kind.__module__.startswith("loam_gtsam"):
            error = made.get(kind, lambda kind=kind: kind("no"))()
            error.add_note("there")
            copy = pickle.loads(pickle.dumps(error))
            assert (type(copy), str(copy)) == (kind, str(error))
            assert vars(copy) == vars(error)
